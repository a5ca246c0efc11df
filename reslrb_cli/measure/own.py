"""Measurements that diagnose a user's own integrator after a failed `gradcheck`.

The user's integrator is compared with `reslrb` for the same kind of paths. The result is a ratio r with its standard
error. For gradients, r is the ratio of both gradients' projections on u. u is the direction of the reference gradient.
For images, r is the ratio of the image sums.

    r = E<g, u> / E<G, u>,      u from other seeds of G than the denominator

Ratios are measured for paths of 1, 2, 3, ... segments without Russian roulette, and for each parameter. Images are
linear in emission. If both passes trace the same paths and add the same terms, sum(dL/dE E) equals sum(dL/dI I) at each
seed, where I is the image. Each measurement rules out possible faults, and the message names the remaining ones. The
message reports measurements, and is no proof.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from reslrb_cli.integrators.plugin import make_integrator
from reslrb_cli.integrators.protocol import StepIntegrator
from reslrb_cli.measure.gradcheck import Gradcheck
from reslrb_cli.measure.gradients import Case, seeds
from reslrb_cli.measure.methods import NEVER, plays_roulette
from reslrb_cli.measure.participants import Participants
from reslrb_cli.records.measurements import GradcheckRecord, Verdict
from reslrb_cli.scene.catalog import parameter_kind

Array = np.ndarray

#: Seeds of each measurement; the reference has twice as many, and its first half is the direction. If these are
#: inconclusive, there are `MORE` times as many.
SEEDS, MORE = 16, 4

#: Maximum path length that is examined.
DEEPEST = 5

#: A ratio differs from 1 if it is this many standard errors and this much away.
ERRORS, LEAST = 5.0, 0.01

#: Endings of emission parameters in which images are linear.
LINEAR = (".value", "scale")

#: Relative scatter of sums of the same paths in another order.
SAME_PATHS = 1e-3


@dataclass(frozen=True)
class Ratio:
    """An estimate divided by its correct value, and the standard error of this ratio."""

    value: float
    error: float

    @property
    def wrong(self) -> bool:
        """Whether the ratio differs significantly from 1."""
        return not np.isfinite(self.value) or abs(self.value - 1) > max(ERRORS * self.error, LEAST)

    def same(self, other: Ratio) -> bool:
        """True if both ratios agree within their errors."""
        return abs(self.value - other.value) <= max(ERRORS * np.hypot(self.error, other.error), LEAST)

    def __str__(self) -> str:
        return f"{self.value:.3g} +- {self.error:.1g} times"


def look_into(
    check: Gradcheck, records: Sequence[GradcheckRecord], stop: Callable[[], bool], say: Callable[[str], None]
) -> Iterator[str]:
    """Yield a message about the likely fault of each of the user's own integrators that fails. `records` are the
    results of `gradcheck`.

    Raises KeyboardInterrupt after `stop()`. `say` receives the name of the examined integrator.
    """
    for listed in check.participants.listed:
        mine = [record for record in records if record.integrator == listed.label]
        failing = [record for record in mine if record.verdict is Verdict.FAILS]
        if listed.type == "custom" and failing:
            say(f"now examining {listed.label}")
            yield f"{listed.label}: {Looking(check.participants, listed.label, stop).sentence(failing)}"


class Looking:
    """Measurements that search for faults of the integrator `label`, which failed the check."""

    def __init__(self, parts: Participants, label: str, stop: Callable[[], bool]) -> None:
        self.parts, self.label, self._stop = parts, label, stop
        self._seeds = SEEDS
        self._options = parts.options_of(label)
        self.depth = self._options["max_depth"]
        self.deepest = DEEPEST if self.depth == -1 else min(self.depth, DEEPEST)

    # --- measuring ----------------------------------------------------------------------------------------------------

    def _pair(self, **other: int) -> tuple[StepIntegrator, StepIntegrator]:
        """Return the integrator, and `reslrb` with the same kind of paths. `other` may change the depths of both."""
        ours = self._options | other | self.parts.ways[self.label].options
        return self.parts.own_with(self.label, **other), make_integrator("reslrb", estimator="stack", **ours)

    def images(self, **other: int) -> Ratio:
        """Return the ratio of the images, with equal weights in all pixels."""
        mine, ours = (
            np.array([self.parts.case.image(one, seed, self.parts.spp).sum() for seed in self._each(SEEDS, block)])
            for block, one in zip((5, 6), self._pair(**other), strict=True)
        )
        return _over(mine, ours)

    def gradients(self, **other: int) -> dict[str, Ratio]:
        """Return the ratio for each parameter whose reference gradient differs significantly from zero."""
        own, ours = self._pair(**other)
        reference = np.stack([self.parts.gradient(ours, seed) for seed in self._each(2 * self._seeds, 6)])
        mine = np.stack([self.parts.gradient(own, seed) for seed in self._each(self._seeds, 5)])
        found = {}
        for key, place in self.parts.case.places.items():
            first, second = np.split(reference[:, place], 2)
            direction = first.mean(0)
            if not (size := float(np.linalg.norm(direction))):
                continue
            sides = mine[:, place] @ direction / size, second @ direction / size
            if abs(sides[1].mean()) > ERRORS * _error(sides[1]):
                found[key] = _over(*sides)
        return found

    def emission(self, depth: int | None = None, seen: int | None = None) -> tuple[Ratio, float] | None:
        """Return the ratio of sum(dL/dE E) to sum(dL/dI I), where I is the image. The ratio must be 1, because images
        are linear in emission.

        Also returns how much the ratio varies between seeds. At each seed, the image and the derivative sum use the
        same paths. Returns None if the emission of some emitter is not given by a number (`.value`, `scale`). `depth`
        is the gradient's maximum depth. `seen` is the image's maximum depth.
        """
        depth = self.depth if depth is None else depth
        scene = self.parts.case.scene
        params = mi.traverse(scene)
        keys = [key for key, _ in params if parameter_kind(params, key) == "emitter" and key.endswith(LINEAR)]
        if not keys or len(keys) != len(scene.emitters()):
            return None
        own, image = (self.parts.own_with(self.label, max_depth=n) for n in (depth, depth if seen is None else seen))
        case = Case(scene, keys, self.parts.case.sensor)
        case.weigh(np.array(self.parts.case.weights))
        emitted = np.concatenate([case.initial[key] for key in keys])
        found = np.array([
            case.gradient(own, seed, self.parts.spp, step=case.known_step) @ emitted
            / case.weighted(case.image(image, seed, self.parts.spp))
            for seed in self._each(SEEDS, 7)
        ])  # fmt: skip
        return Ratio(float(found.mean()), _error(found)), float(found.std(ddof=1))

    def _each(self, count: int, block: int) -> Iterator[int]:
        """Yield seeds until the user stops."""
        for seed in seeds(count, block):
            if self._stop():
                raise KeyboardInterrupt
            yield seed

    # --- messages -----------------------------------------------------------------------------------------------------

    def sentence(self, failing: Iterable[GradcheckRecord]) -> str:
        """Return a message that names the part of the user's integrator to check."""
        if self.parts.attached:
            return (
                "wrong if light moves: check derivatives of silhouettes, of shadow edges, and of the direction of "
                "light; --missing, without --integrators, measures the first two with --set integrator.edges=off"
            )
        if any(record.parameter is None for record in failing) and (image := self.images()).wrong:
            return self._of_image(image)
        found = self.gradients()
        wrong = {key: ratio for key, ratio in found.items() if ratio.wrong}
        if wrong:
            return "; ".join([self._of_gradient(found, wrong), *self._narrowed(wrong)])
        passes = self._of_passes({})
        if passes is not None:
            return f"its image holds; {passes}"
        if self._seeds == SEEDS:
            self._seeds = MORE * SEEDS
            return self.sentence(failing)
        return (
            f"its gradient is right along the reference's own direction ({_list(found)}), but wrong in single entries: "
            "check where derivatives land (texture coordinates, the pixel of dL/dI)"
        )

    def _of_image(self, ratio: Ratio) -> str:
        where, _ = self._from_depth(lambda depth: self.images(max_depth=depth))
        parts = [f"its image is {ratio} the reference's; check the image first, because the gradient follows it"]
        if where is not None:
            parts.append(_segments(where, self._options["hide_emitters"]))
        if self._roulette() and not self.images(rr_depth=NEVER).wrong:
            parts.append("without roulette it is right: check the weight 1/p of surviving paths")
        return "; ".join(parts)

    def _of_gradient(self, found: dict[str, Ratio], wrong: dict[str, Ratio]) -> str:
        zero = [key for key, ratio in wrong.items() if ratio.value == 0 and ratio.error == 0]
        if zero:
            return (
                f"its image holds; the gradient of {_names(zero)} is exactly 0: no derivative arrives there (a BSDF or "
                "an emitter is evaluated outside of dr.resume_grad, or detached)"
            )
        first, *others = wrong.values()
        if len(wrong) == len(found) and all(first.same(other) for other in others):
            return f"its image holds; its gradient is {first} the reference's"
        right = [key for key in found if key not in wrong]
        beside = f", while {_names(right)} {'holds' if len(right) == 1 else 'hold'}" if right else ""
        return f"its image holds; it has {_list(wrong)} of the reference's gradient{beside}"

    def _narrowed(self, wrong: dict[str, Ratio]) -> list[str]:
        """Return messages about the faults that the measurements do not rule out. Possible faults are differing passes,
        roulette, derivatives from some path length on, and BSDF lobes.
        """
        worst = max(wrong, key=lambda key: abs(wrong[key].value - 1) / max(wrong[key].error, 1e-12))
        passes = self._of_passes(wrong)
        if passes is not None:
            return [passes]
        if self._roulette():
            without = self.gradients(rr_depth=NEVER).get(worst)
            if without is not None and not without.wrong:
                return ["without roulette (rr_depth) it is right: the survival probability is differentiated, or its "
                        "weight is missing in one of the two passes"]  # fmt: skip
        said = []
        at, before = self._from_depth(lambda depth: self.gradients(max_depth=depth).get(worst))
        if at is not None:
            said.append(
                f"{_from(at, before)}, though its derivative by emission, its paths and the terms of their vertices "
                "are right: check the terms that are differentiated there (the BSDF's value over its detached self), "
                "and the light from behind: L minus all that was added up to this vertex, including its own light"
            )
        if lobes := self._lobes(worst):
            said.append(lobes)
        return said

    def _of_passes(self, wrong: dict[str, Ratio]) -> str | None:
        """Describe a difference between the differentiated pass and the image pass, in terms or in paths. Return None
        if no difference is found.
        """
        measured = self.emission()
        if measured is None:
            return None
        ratio, scatter = measured
        if not ratio.wrong:
            return None if scatter <= SAME_PATHS else (
                f"at equal seeds its derivative by all emission varies by {100 * scatter:.2g} % about its image, which "
                "it must equal: the differentiated pass traces other paths than the first one (random numbers out of "
                "step), or it reads dL/dI at another pixel"
            )  # fmt: skip
        begin = f"its derivative by all emission is {ratio} its image, which it must equal: "
        if scatter <= 0.01 * abs(ratio.value - 1) and all(ratio.same(other) for other in wrong.values()):
            return f"{begin}the factor is the same at every seed, so dL/dI is passed on wrongly (its sign, its scale)"
        if self._too_short():
            return f"{begin}the differentiated pass ends paths a segment too soon"
        at, before = self._from_depth(lambda depth: (self.emission(depth) or (None,))[0])
        said = f"{begin}the terms of a vertex, or its dL/dI, differ between the differentiated pass and the first one"
        return said if at is None else f"{said}; {_segments(at, self._options['hide_emitters'], before)}"

    def _too_short(self) -> bool:
        """Whether the differentiated pass has only paths of two segments when it should have paths of three."""
        found = self.emission(3, 2) if self.deepest >= 3 else None
        return found is not None and not found[0].wrong and found[1] <= SAME_PATHS

    def _roulette(self) -> bool:
        return plays_roulette(self.depth, self._options["rr_depth"])

    def _from_depth(self, ratio: Callable[[int], Ratio | None]) -> tuple[int | None, bool]:
        """Return the shortest path length with a wrong ratio. Also return True if shorter paths were measured as
        right.
        """
        seen = False
        for depth in range(1, self.deepest + 1):
            found = ratio(depth)
            if found is not None and found.wrong:
                return depth, seen
            seen = seen or found is not None
        return None, seen

    def _lobes(self, key: str) -> str:
        """Name the lobes of the parameter's BSDF if it has several."""
        for bsdf in self.parts.bsdfs_of(key):
            if bsdf.component_count() > 1 and bsdf.class_name() != "TwoSidedBRDF":
                return (
                    f"it belongs to a {bsdf.class_name()} with {bsdf.component_count()} lobes: the weight of "
                    "`bsdf.sample` contains the probability of the lobe, whose derivative must not be included; use "
                    "the value of `bsdf.eval` over a detached density"
                )
        return ""


def _from(depth: int, before: bool) -> str:
    shorter = f"right up to {depth - 1} and " if depth > 1 and before else ""
    return f"{shorter}wrong from paths of {depth} segment{'s' if depth > 1 else ''} on"


def _segments(depth: int, hides: bool, before: bool = True) -> str:
    """Describe the features of paths with this number of segments that shorter paths lack."""
    what = "throughput, and the BSDF's value over its density"
    if depth == 1:
        hidden = " (hide_emitters is on here)" if hides else ""
        what = f"emission seen directly by the sensor{hidden}, the film, or the sample count"
    if depth == 2:
        what = (
            "direct light of a lamp: the BSDF's value with its cosine, over the density of the emitter's sample "
            "including the choice of the emitter, times a weight of multiple importance sampling"
        )
    return f"{_from(depth, before)}: {what}"


def _over(own: Array, reference: Array) -> Ratio:
    """Return the ratio of two means with its standard error. The ratio is 1 if both means are zero. The ratio is
    infinite if only the reference is zero.
    """
    if not reference.any():
        return Ratio(np.inf if own.any() else 1.0, 0.0)
    value = own.mean() / reference.mean()
    return Ratio(float(value), float(np.hypot(_error(own), value * _error(reference)) / abs(reference.mean())))


def _error(samples: Array) -> float:
    return float(samples.std(ddof=1) / np.sqrt(len(samples)))


def _names(keys: Sequence[str]) -> str:
    return keys[0] if len(keys) == 1 else f"{', '.join(keys[:-1])} and {keys[-1]}"


def _list(ratios: dict[str, Ratio]) -> str:
    return ", ".join(f"{ratio} of {key}" for key, ratio in ratios.items())
