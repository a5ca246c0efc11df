"""Figure 1: gradients of a caustic's loss by naive AD and by ours, with few samples and with many, and their memory.

Each kind of gradient is sampled in a process of its own under the same limit of memory (`processes.py`), and all have
the same dL/dI (`held.py`), so that their means are to agree within standard errors, and the noise of ours is to fall
with the root of the samples. Seeds differ between kinds. This module knows no Mitsuba: the processes do.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from reslrb_cli.backend.python import python_command
from reslrb_cli.config import Config, Reslrb, dump
from reslrb_cli.errors import ConfigError
from reslrb_cli.measure.comparison import Comparison, Family, compare_expectations
from reslrb_cli.measure.entries import entry_count
from reslrb_cli.measure.noise import Fall, fall, relative_noise
from reslrb_cli.measure.processes import Ended, Process
from reslrb_cli.records.bench import BenchStatus
from reslrb_cli.records.gradcheck import Verdict
from reslrb_cli.seeds import seed

MIB = 2**20
#: On a GPU address space says nothing of the memory that arrays take.
VARIANT = "llvm_ad_rgb"
_COMMAND = "from reslrb_cli.measure.worker import held_gradients, run\nrun(held_gradients)"


@dataclass(frozen=True)
class Plan:
    """Samples per pixel, seeds, and the limit of each process in bytes."""

    few_spp: int = 32
    many_spp: int = 1024
    reference_spp: int = 4096
    seeds: int = 32
    many_seeds: int = 8
    limit: int = 2 << 30

    @property
    def half_spp(self) -> int:
        """Samples at which naive AD's memory is looked at too, to see how it grows."""
        return max(self.few_spp // 2, 1)


@dataclass
class Kind:
    """One kind of gradient: `samples` (N, H, W, C), the peak of Dr.Jit's arrays, and of the process's address space.

    `end` is how a process ended that did not come to its first gradient.
    """

    name: str
    spp: int
    naive: bool
    samples: np.ndarray | None = None
    arrays_mib: float | None = None
    address_mib: float = 0.0
    end: Ended | None = None

    @property
    def label(self) -> str:
        """Its name and samples."""
        return f"{self.name}, {self.spp} spp"

    @property
    def rows(self) -> np.ndarray:
        """The samples in rows, (N, P), in double precision."""
        assert self.samples is not None, "asked of kinds that have been sampled"
        return self.samples.reshape(len(self.samples), -1).astype(np.float64)


@dataclass
class Result:
    """What was measured; `asked_mib` is what naive AD takes with many samples, by its growth with few."""

    config: Config
    plan: Plan
    key: str
    pictures: dict[str, np.ndarray]
    naive: Kind
    ours: Kind
    many: Kind
    failing: Kind
    asked_mib: float
    comparisons: dict[tuple[str, str], Comparison] = field(default_factory=dict)
    fall: Fall | None = None

    @property
    def kinds(self) -> list[Kind]:
        """All, in the order of the table."""
        return [self.naive, self.ours, self.many, self.failing]

    def noise(self, kind: Kind) -> float:
        """The noise of one gradient of a kind, over the gradient itself as the most samples show it."""
        return relative_noise(kind.rows, self.many.rows.mean(0))

    @property
    def does_not_fit(self) -> bool:
        """Whether naive AD with many samples ran out of memory."""
        return self.failing.end is not None and self.failing.end.status is BenchStatus.OUT_OF_MEMORY

    @property
    def holds(self) -> bool:
        """Whether all does that the figure is to show."""
        agree = all(figures.verdict is Verdict.HOLDS for figures in self.comparisons.values())
        return agree and self.fall is not None and self.fall.verdict is Verdict.HOLDS and self.does_not_fit


def measure(config: Config, plan: Plan, folder: Path, say: Callable[[str], None]) -> Result:
    """Sample everything and check it; arrays go by way of `folder`, which is the caller's to remove.

    Raises ConfigError, processes.Refused, and Ended where a gradient that has to be there is not.
    """
    _check_config(config)
    say(f"target and initial image, {plan.reference_spp} spp")
    pictures = _take_pictures(config, plan, folder)
    np.save(folder / "adjoint.npy", pictures["adjoint"])
    estimator = f"reslrb:{config.integrator.options().get('estimator')}"
    naive, failing = (Kind("naive AD", spp, True) for spp in (plan.few_spp, plan.many_spp))
    ours, many = (Kind(estimator, spp, False) for spp in (plan.few_spp, plan.many_spp))
    # Twice the samples take so much more memory: what does not depend on samples drops out.
    half = Kind("naive AD", plan.half_spp, True)
    key = ""
    for kind, count in ((half, 1), (naive, plan.seeds), (ours, plan.seeds), (many, plan.many_seeds), (failing, 1)):
        say(f"{kind.label}: {count} seed{'s' if count > 1 else ''}")
        key = _sample(kind, count, config, plan, folder) or key
        if kind.end is not None and kind is not failing:
            raise kind.end
    assert half.arrays_mib is not None, "else it has ended"
    assert naive.arrays_mib is not None, "else it has ended"
    growth = (naive.arrays_mib - half.arrays_mib) / (naive.spp - half.spp)
    asked = naive.arrays_mib + growth * (plan.many_spp - naive.spp)
    result = Result(config, plan, key, pictures, naive, ours, many, failing, asked)
    check(result)
    return result


def check(result: Result) -> None:
    """Compare the means of the kinds with each other, and the noise of ours with few samples and with many."""
    naive, ours, many = result.naive, result.ours, result.many
    assert ours.samples is not None
    shape = ours.samples.shape[1:]
    pairs = [(ours, naive), (many, naive), (many, ours)]
    family = Family(len(pairs), len(pairs) * entry_count(shape))
    for one, other in pairs:
        result.comparisons[one.label, other.label] = compare_expectations(
            one.rows, other.rows, family, shape=shape, paired=False
        )
    result.fall = fall(ours.rows, many.rows, float(np.sqrt(many.spp / ours.spp)))


def _check_config(config: Config) -> None:
    """Raise ConfigError where the gradients could not be compared, or shown."""
    integrator = config.integrator
    if config.variant not in ("auto", VARIANT):
        raise ConfigError(config.source, "variant", f"must be auto or {VARIANT}: the limit bounds address space alone")
    if not isinstance(integrator, Reslrb) or integrator.estimator == "auto":
        raise ConfigError(config.source, "integrator.estimator", "must name an estimator of `reslrb`")
    if integrator.max_depth < 0:
        raise ConfigError(config.source, "integrator.max_depth", "must be a limit: paths are traced without roulette")
    if config.parameters[0].heightmap is None:
        raise ConfigError(config.source, "parameters[0]", "must be a heightmap, whose gradient is shown")


def _start(config: Config, limit: int | None, naive: bool, adjoint: Path | None) -> Process:
    first = {
        "config": dump(config),
        "source": str(config.source),
        "variant": VARIANT,
        "memory_limit": limit,
        "naive": naive,
        "adjoint": None if adjoint is None else str(adjoint),
    }
    return Process(first, python_command(_COMMAND))


def _take_pictures(config: Config, plan: Plan, folder: Path) -> dict[str, np.ndarray]:
    process = _start(config, None, False, None)
    try:
        process.answer(_never)
        process.ask({"spp": plan.reference_spp, "out": str(folder / "pictures.npz")})
        process.answer(_never)
    finally:
        process.close()
    with np.load(folder / "pictures.npz") as arrays:
        return {name: arrays[name] for name in arrays.files}


def _sample(kind: Kind, count: int, config: Config, plan: Plan, folder: Path) -> str:
    """Take `count` gradients of a kind; what ends their process is the kind's end. Returns the parameter's key."""
    process, out, taken = _start(config, plan.limit, kind.naive, folder / "adjoint.npy"), folder / "gradient.npy", []
    key = ""
    try:
        key = str(process.answer(_never)["key"])
        for number in range(count):
            purpose = f"figure1, {'naive' if kind.naive else 'ours'}, {kind.spp} spp"
            process.ask({"seed": seed(config.run.seed, number, 0, purpose), "spp": kind.spp, "out": str(out)})
            answer: dict[str, Any] = process.answer(_never)
            kind.arrays_mib = max(kind.arrays_mib or 0.0, float(answer["peak_mib"]))
            taken.append(np.load(out))
        kind.samples = np.stack(taken)
    except Ended as end:
        kind.end = end
    finally:
        process.close()
        kind.address_mib = process.peak_bytes / MIB
    return key


def _never() -> bool:
    return False
