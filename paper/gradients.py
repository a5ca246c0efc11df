"""Gradients of an experiment with one common dL/dI, and comparisons of their means and their noise.

The noise of an image biases the gradient. If each method used its own image, gradients with different noise would have
different expectations. Therefore dL/dI is that of one reference image.

Each kind of gradient is sampled in its own process, which may have a memory limit. The gradients belong to the first
parameter, at the parameters' initial values, through the first sensor.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from reslrb_cli.backend.variant import set_variant
from reslrb_cli.config.integrators import ReslrbConfig
from reslrb_cli.config.loader import with_integrator
from reslrb_cli.config.schema import Config
from reslrb_cli.errors import ConfigError
from reslrb_cli.measure.comparison import ALPHA, Family, compare_expectations, entry_count
from reslrb_cli.measure.engine import start_process
from reslrb_cli.measure.judgement import jackknife
from reslrb_cli.measure.methods import NEVER, first_message
from reslrb_cli.measure.participants import ALIKE
from reslrb_cli.measure.processes import Ended
from reslrb_cli.measure.steps import adjoint
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.optimization.views import target_arrays
from reslrb_cli.records.measurements import Comparison, Reference, Verdict
from reslrb_cli.records.metrics import finite
from reslrb_cli.report.tonemap import color_map
from reslrb_cli.scene.visibility import interior, sees_specular
from reslrb_cli.statistics import special, squares_without

#: On a GPU the address space of a process says nothing about the memory of its arrays.
VARIANT = "llvm_ad_rgb"
#: The integrator of the experiment itself.
OWN = "own"
#: Relative half width of the test of `fall` above which the ratio is not known.
WIDEST = 0.2


@dataclass
class Kind:
    """One kind of gradient: `samples` (N, H, W, C) by the integrator `by` (see `comparable`), and the peak memory of
    arrays. `end` is the reason why the process ended before it took all samples, or None.
    """

    name: str
    spp: int
    by: str
    samples: np.ndarray | None = None
    arrays_mib: float | None = None
    end: Ended | None = None

    @property
    def label(self) -> str:
        """Name and samples per pixel."""
        return f"{self.name}, {self.spp} spp"

    @property
    def rows(self) -> np.ndarray:
        """Samples as rows (N, P) in double precision."""
        assert self.samples is not None, "has been sampled"
        return self.samples.reshape(len(self.samples), -1).astype(np.float64)

    def record(self, mean: np.ndarray) -> dict[str, Any]:
        """Return the figures of this kind. The noise is relative to the gradient `mean` (P,)."""
        count = 0 if self.samples is None else len(self.samples)
        return {
            "gradient": self.name, "spp": self.spp, "seeds": count,
            "relative_noise": relative_noise(self.rows, mean) if count > 1 else None, "arrays_mib": self.arrays_mib,
            "status": "ok" if self.end is None else self.end.status.value,
            "reason": None if self.end is None else self.end.reason,
        }  # fmt: skip


class Sampling:
    """Samples of an experiment's gradients. `own` is the label of its estimator.

    `target` and `initial` (H, W, C) are the target and the initial image, and `arrays` belong to a process
    (`steps.Sampler`), with dL/dI at the initial image. `shape` is that of the first parameter. If `masked`, dL/dI is 0
    where light paths find less light than camera paths. These pixels see smooth specular lobes or lie at the film's
    border. `limit` bounds the address space of each process in bytes. Raises ConfigError if gradients of this
    experiment cannot be compared.
    """

    def __init__(
        self, config: Config, spp: int, say: Callable[[str], None], masked: bool = False, limit: int | None = None
    ) -> None:
        self.config, self._say, self._limit, integrator = config, say, limit, config.integrator
        if config.variant not in ("auto", VARIANT):
            reason = f"must be auto or {VARIANT}: the limit bounds address space alone"
            raise ConfigError(config.source, "variant", reason)
        if not isinstance(integrator, ReslrbConfig) or integrator.estimator == "auto":
            raise ConfigError(config.source, "integrator.estimator", "must name an estimator of `reslrb`")
        if integrator.max_depth < 0:
            reason = "must be a limit: paths are traced without roulette"
            raise ConfigError(config.source, "integrator.max_depth", reason)
        self.own = f"reslrb:{integrator.estimator}"
        say(f"target, and initial image with {spp} spp")
        set_variant(VARIANT)
        problem = assemble(config.with_exposures_fixed())
        view, self.shape = problem.views[0], problem.selection.array(problem.selection.keys[0]).shape
        self.target, self.initial = np.array(view.target), problem.render(view.sensor, spp, 0, "reference")
        mask = np.ones(self.initial.shape[:2], bool)
        if masked:
            sensor = problem.scene.sensors()[view.sensor]
            mask = interior(mask.shape, sensor) & ~sees_specular(problem.scene, sensor, partly=True)
        derivative = adjoint(problem, self.initial, mask[:, :, None].astype(np.float32))
        self.arrays = {"adjoints": derivative[None], **target_arrays(problem.views[:1])}

    def take(self, kind: Kind, count: int, series: str, may_end: bool = False) -> Kind:
        """Take `count` gradients in a separate process. Kinds with the same `series` have the same seeds. Raises Ended
        if the process ends, unless it `may_end`.
        """
        self._say(f"{kind.label}: {count} seed{'s' if count > 1 else ''}")
        config, sampled = comparable(self.config, kind.by), {"quantity": "fixed", "arrays": self.arrays}
        first = first_message(config, VARIANT, self._limit, purpose=series, **sampled)
        process, taken = start_process(first), []
        try:
            process.answer(lambda: False)
            for number in range(count):
                process.ask({"numbers": [number], "spp": kind.spp, "image": 0, "cold": True, "release": False})
                answer = process.answer(lambda: False)
                kind.arrays_mib = max(kind.arrays_mib or 0.0, float(answer["peak_mib"]))
                taken.append(answer["values"][0, : np.prod(self.shape)].reshape(self.shape))
            kind.samples = np.stack(taken)
        except Ended as end:
            kind.end = end
            if not may_end:
                raise
        finally:
            process.close()
        return kind


def comparable(config: Config, by: str) -> Config:
    """Return the experiment with another integrator: `own` for that of the experiment, `ptracer` or `walk_ad` for naive
    AD of the stock walk or of ours, `prb`, or the name of an estimator. All have the same expectation.

    No integrator uses Russian roulette, because naive AD does not differentiate its decision.
    """
    assert isinstance(config.integrator, ReslrbConfig), "checked by `Sampling`"
    own = config.integrator.plain()
    if by in ("ptracer", "prb", "walk_ad"):
        values = {"type": by, "max_depth": own.max_depth, "rr_depth": NEVER, "hide_emitters": own.hide_emitters}
        if by == "walk_ad":
            values |= {"filter_normalization": "detached", "attached": own.attached}
        return with_integrator(config, values, str(config.source), {})
    changed: dict[str, Any] = ALIKE[Reference.PTRACER] | {"rr_depth": NEVER} | ({} if by == OWN else {"estimator": by})
    return config.model_copy(update={"integrator": own.model_copy(update=changed)})


def compare(pairs: Sequence[tuple[Kind, Kind]]) -> list[dict[str, Any]]:
    """Return a record for each pair of kinds. The means of each pair are compared in standard errors. All pairs form
    one family of comparisons.
    """
    shape = np.shape(pairs[0][0].samples)[1:]
    family = Family(len(pairs), len(pairs) * entry_count(shape))
    found = [compare_expectations(one.rows, other.rows, family, shape=shape, paired=False) for one, other in pairs]
    return [compared(*pair, figures) for pair, figures in zip(pairs, found, strict=True)]


def compared(one: Kind, other: Kind, figures: Comparison) -> dict[str, Any]:
    """Return the record of one comparison."""
    return {"gradient": one.label, "reference": other.label, **finite(vars(figures))}


def relative_noise(samples: np.ndarray, mean: np.ndarray) -> float:
    """Return the L2 norm of the standard deviation of (N, P) samples, divided by the L2 norm of the mean (P,)."""
    return float(np.sqrt(samples.var(0, ddof=1).sum()) / np.linalg.norm(mean))


def fall(coarse: np.ndarray, fine: np.ndarray, expected: float) -> dict[str, Any]:
    """Return the ratio of the noise of (N, P) samples to the noise of (M, P) others, its interval, and a verdict.

    A correct ratio lies outside of the test's interval with probability `ALPHA`. The verdict is `holds` if the expected
    ratio lies in this interval. Instead of `holds`, the verdict is `unresolved` if the relative half width of the
    interval exceeds `WIDEST`.
    """
    logs = []
    for samples in (coarse, fine):
        (whole, without), count = squares_without(samples), len(samples)
        logs.append(0.5 * np.log([whole / (count - 1), *(without / (count - 2))]))
    found = jackknife(*logs)
    found = replace(found, value=found.value - float(logs[1][0]))
    most = -float(special().stdtrit(found.freedom, ALPHA / 2)) * found.error
    verdict = Verdict.HOLDS if abs(found.value - np.log(expected)) <= most else Verdict.FAILS
    if verdict is Verdict.HOLDS and most > np.log1p(WIDEST):
        verdict = Verdict.UNRESOLVED
    ratio = found.exponential()
    return {"ratio": ratio.value, "low": ratio.low, "high": ratio.high, "expected": expected, "verdict": verdict}


def colored(values: np.ndarray, end: float) -> np.ndarray:
    """Return values (H, W) as colours (H, W, 3). Values up to -`end` are blue, 0 is grey, and values from `end` on are
    red.
    """
    return np.asarray(color_map(signed=True)(np.clip(values / end / 2 + 0.5, 0, 1))[:, :, :3])
