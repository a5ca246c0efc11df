"""Gradients of an experiment with one common dL/dI, and comparisons of their means and their noise.

The noise of an image biases the gradient. If each method used its own image, gradients with different noise would have
different expectations. Therefore dL/dI is that of one reference image.

Each kind of gradient is sampled in its own process, which may have a memory limit. The gradients belong to the first
parameter, at the parameters' initial values, through the first sensor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats

from reslrb_cli.backend.variant import set_variant
from reslrb_cli.config.integrators import ReslrbConfig
from reslrb_cli.config.loader import dump, with_integrator
from reslrb_cli.config.schema import Config
from reslrb_cli.errors import ConfigError
from reslrb_cli.measure.comparison import ALPHA, Family, compare_expectations, entry_count
from reslrb_cli.measure.engine import start_process
from reslrb_cli.measure.methods import NEVER
from reslrb_cli.measure.participants import ALIKE
from reslrb_cli.measure.processes import Ended
from reslrb_cli.measure.steps import adjoint
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.optimization.views import target_arrays
from reslrb_cli.records.measurements import Comparison, Reference, Verdict
from reslrb_cli.records.metrics import finite
from reslrb_cli.report.tonemap import color_map
from reslrb_cli.scene.visibility import interior, sees_specular
from reslrb_cli.statistics import jackknife_variance

#: On a GPU the address space of a process says nothing about the memory of its arrays.
VARIANT = "llvm_ad_rgb"
#: The integrator of the experiment itself.
OWN = "own"
#: Confidence of the interval of `fall`, and the relative half width of its test above which the ratio is not known.
CONFIDENCE, WIDEST = 0.95, 0.2


@dataclass
class Pictures:
    """The target and the initial image (H, W, C), and the arrays of a process (`steps.Sampler`) with dL/dI at the
    initial image. `shape` is that of the first parameter.
    """

    target: np.ndarray
    initial: np.ndarray
    arrays: dict[str, np.ndarray]
    shape: tuple[int, ...]


@dataclass
class Kind:
    """One kind of gradient: `samples` (N, H, W, C) by the integrator `by` (see `comparable`), and the peak memory of
    arrays.

    `end` is the reason why the process ended before it took all samples. `end` is None otherwise.
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


def own_label(config: Config) -> str:
    """Return the label of the experiment's own estimator. Raises ConfigError if gradients of this experiment cannot be
    compared.
    """
    integrator = config.integrator
    if config.variant not in ("auto", VARIANT):
        raise ConfigError(config.source, "variant", f"must be auto or {VARIANT}: the limit bounds address space alone")
    if not isinstance(integrator, ReslrbConfig) or integrator.estimator == "auto":
        raise ConfigError(config.source, "integrator.estimator", "must name an estimator of `reslrb`")
    if integrator.max_depth < 0:
        raise ConfigError(config.source, "integrator.max_depth", "must be a limit: paths are traced without roulette")
    return f"reslrb:{integrator.estimator}"


def comparable(config: Config, by: str) -> Config:
    """Return the experiment with another integrator: `own` for that of the experiment, `ptracer` or `walk_ad` for naive
    AD of the stock walk or of ours, `prb`, or the name of an estimator. All have the same expectation.

    No integrator uses Russian roulette, because naive AD does not differentiate its decision.
    """
    assert isinstance(config.integrator, ReslrbConfig), "checked by `own_label`"
    own = config.integrator.plain()
    if by in ("ptracer", "prb", "walk_ad"):
        values = {"type": by, "max_depth": own.max_depth, "rr_depth": NEVER, "hide_emitters": own.hide_emitters}
        if by == "walk_ad":
            values |= {"filter_normalization": "detached", "attached": own.attached}
        return with_integrator(config, values, str(config.source), {})
    changed: dict[str, Any] = ALIKE[Reference.PTRACER] | {"rr_depth": NEVER} | ({} if by == OWN else {"estimator": by})
    return config.model_copy(update={"integrator": own.model_copy(update=changed)})


def take_pictures(config: Config, spp: int, masked: bool = False) -> Pictures:
    """Render the target, and the initial image with `spp` samples per pixel.

    If `masked`, dL/dI is 0 where light paths find less light than camera paths. These pixels see smooth specular lobes
    or lie at the film's border.
    """
    set_variant(VARIANT)
    problem = assemble(config.with_exposures_fixed())
    view, shape = problem.views[0], problem.selection.array(problem.selection.keys[0]).shape
    initial = problem.render(view.sensor, spp, 0, "reference")
    mask = np.ones(initial.shape[:2], bool)
    if masked:
        sensor = problem.scene.sensors()[view.sensor]
        mask = interior(mask.shape, sensor) & ~sees_specular(problem.scene, sensor, partly=True)
    derivative = adjoint(problem, initial, mask[:, :, None].astype(np.float32))
    arrays = {"adjoints": derivative[None], **target_arrays(problem.views[:1])}
    return Pictures(np.array(view.target), initial, arrays, shape)


def sample(kind: Kind, count: int, config: Config, pictures: Pictures, series: str, limit: int | None = None) -> None:
    """Take `count` gradients in a separate process. `limit` bounds the address space of the process in bytes.

    Kinds with the same `series` have the same seeds.
    """
    first = {"config": dump(comparable(config, kind.by)), "source": str(config.source), "variant": VARIANT,
             "memory_limit": limit, "allow_code": False, "quantity": "fixed", "purpose": series,
             "arrays": pictures.arrays}  # fmt: skip
    process, taken = start_process(first, "reslrb_cli.measure.steps:begin"), []
    try:
        process.answer(lambda: False)
        for number in range(count):
            process.ask({"numbers": [number], "spp": kind.spp, "image": 0, "cold": True, "release": False})
            answer = process.answer(lambda: False)
            kind.arrays_mib = max(kind.arrays_mib or 0.0, float(answer["peak_mib"]))
            taken.append(answer["values"][0, : np.prod(pictures.shape)].reshape(pictures.shape))
        kind.samples = np.stack(taken)
    except Ended as end:
        kind.end = end
    finally:
        process.close()


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

    The logarithm of the ratio has the jackknife's standard error, and the degrees of freedom of Welch and
    Satterthwaite. A correct ratio lies outside of the test's interval with probability `ALPHA`. The verdict is `holds`
    if the expected ratio lies in this interval. Instead of `holds`, the verdict is `unresolved` if the relative half
    width of the interval exceeds `WIDEST`.
    """
    (a, var_a), (b, var_b) = (_log_deviation(samples) for samples in (coarse, fine))
    error = np.sqrt(var_a + var_b)
    freedom = error**4 / (var_a**2 / (len(coarse) - 1) + var_b**2 / (len(fine) - 1))
    half, most = (stats.t.isf(level / 2, freedom) * error for level in (1 - CONFIDENCE, ALPHA))
    verdict = Verdict.HOLDS if abs(a - b - np.log(expected)) <= most else Verdict.FAILS
    if verdict is Verdict.HOLDS and most > np.log1p(WIDEST):
        verdict = Verdict.UNRESOLVED
    low, ratio, high = np.exp([a - b - half, a - b, a - b + half]).tolist()
    return {"ratio": ratio, "low": low, "high": high, "expected": expected, "verdict": verdict}


def _log_deviation(samples: np.ndarray) -> tuple[float, float]:
    """Return the logarithm of the standard deviation of (N, P) samples, and the jackknife variance of this
    logarithm.
    """
    count = len(samples)
    deviations = np.square(samples - samples.mean(0)).sum(1)
    total = deviations.sum()
    # Leave-one-out: dropping row k lowers the sum of squares by n / (n - 1) times its squared distance.
    left = 0.5 * np.log((total - deviations * count / (count - 1)) / (count - 2))
    return float(0.5 * np.log(total / (count - 1))), float(jackknife_variance(left))


def colored(values: np.ndarray, end: float) -> np.ndarray:
    """Return values (H, W) as colours (H, W, 3). Values up to -`end` are blue, 0 is grey, and values from `end` on are
    red.
    """
    return np.asarray(color_map(signed=True)(np.clip(values / end / 2 + 0.5, 0, 1))[:, :, :3])
