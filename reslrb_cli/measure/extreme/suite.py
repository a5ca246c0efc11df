"""The extreme suite: `ExtremeCase` describes a case, and `run_case` compares its estimators with references.

Each case is run with light paths and with camera paths (`WAYS`). Camera paths use the same references as light paths,
except at the film's border (`_seen_by`). Camera paths are also compared with naive AD of the same paths.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import mitsuba as mi
import numpy as np

from reslrb_cli.estimators import ATTACHED, ESTIMATORS
from reslrb_cli.integrators.step import gradient_step
from reslrb_cli.measure.comparison import ALPHA, Family, compare_equal_seeds, compare_expectations, entry_count
from reslrb_cli.measure.gradients import Case, extrapolated, integrator
from reslrb_cli.measure.gradients import seeds as seeds_of
from reslrb_cli.measure.methods import parse_cases, records_of
from reslrb_cli.measure.references import Situation, prb_image
from reslrb_cli.measure.scenes.analytic import KnownScene
from reslrb_cli.measure.scenes.moving import Move, moving_case
from reslrb_cli.records.measurements import Comparison, GradcheckRecord, Kind, Reference, Verdict

Scene = Callable[[], dict]


@dataclass(frozen=True)
class ReferenceGradients:
    """Gradients of a reference.

    The gradients are (N, P) at other seeds, (N, P) at the estimator's seeds (`paired`), or exact values (P,). `along`
    (K, P) are the directions along which the derivative is known, or None for all entries. `bias` bounds the error of
    the reference itself.
    """

    values: np.ndarray
    paired: bool = False
    along: np.ndarray | None = None
    bias: np.ndarray | float = 0.0


@dataclass(frozen=True)
class Stock:
    """A stock integrator, without Russian roulette (docs/method.md).

    It renders the case's scene, or another `scene`. The case's gradients are known multiples of the other scene's
    gradients. `factors` holds the multiple for each parameter. The default multiple is 1.
    """

    name: str
    scene: Scene | None = None
    factors: Mapping[str, float] = field(default_factory=dict)

    @property
    def reference(self) -> Reference:
        return Reference(self.name)

    def directions(self, setup: Case) -> int:
        return 0

    def samples(self, case: ExtremeCase, setup: Case) -> ReferenceGradients:
        other = setup if self.scene is None else Case(self.scene(), case.keys)
        other.weights = setup.weights
        tracer = integrator(self.name, **without_roulette(case))
        values = other.gradients(tracer, seeds_of(case.seeds, 1), case.spp)
        scale = [np.full(len(row), self.factors.get(key, 1.0)) for key, row in other.initial.items()]
        return ReferenceGradients(values * np.concatenate(scale))


@dataclass(frozen=True)
class Differences:
    """Finite differences of the image by `reslrb`, without Russian roulette. The differences are along random
    directions. For one-sided differences, the directions point into the domain.

    The finite differences use the same random numbers as the gradient, unless the case's options set `rr_depth`. The
    differences are exact up to rounding if paths do not depend on the parameters and the image is a polynomial of
    degree 2.
    """

    step: float
    sides: str = "both"
    reference = Reference.FINITE_DIFFERENCE

    def directions(self, setup: Case) -> int:
        return 2

    def samples(self, case: ExtremeCase, setup: Case) -> ReferenceGradients:
        directions = setup.directions(self.directions(setup))
        along = directions if self.sides == "both" else np.abs(directions)
        tracer = integrator("reslrb", **without_roulette(case), **case.way)
        paired = "rr_depth" not in case.options
        chosen = seeds_of(case.seeds, 0 if paired else 1)
        values = setup.differences(tracer, along, chosen, case.spp, self.step, self.sides)
        return ReferenceGradients(values, paired=paired, along=along)


@dataclass(frozen=True)
class Extrapolated:
    """Finite differences of the image for each amplitude of a motion. The differences use the same random numbers as
    the gradient.

    Differences with a step are corrected by differences with twice the step (`extrapolated`). The assumed error has two
    parts: a tenth of the correction, and the fraction `left` of the root mean square of the differences. The `left`
    part covers the faces of a mesh and higher powers of the step.
    """

    step: float
    left: float = 1e-3
    reference = Reference.FINITE_DIFFERENCE

    def directions(self, setup: Case) -> int:
        return setup.size

    def samples(self, case: ExtremeCase, setup: Case) -> ReferenceGradients:
        along = np.eye(setup.size)
        tracer = integrator("reslrb", **without_roulette(case))
        chosen, steps = seeds_of(case.seeds), (self.step, 2 * self.step)
        near, far = (setup.differences(tracer, along, chosen, case.spp, step) for step in steps)
        values = extrapolated(near, far)
        size = float(np.sqrt(np.mean(np.square(values.mean(0)))))
        return ReferenceGradients(values, True, along, bias=np.abs((values - near).mean(0)) / 10 + self.left * size)


@dataclass(frozen=True)
class Exact:
    """Exact values in closed form."""

    known: Callable[[], KnownScene]
    reference = Reference.ANALYTIC

    def directions(self, setup: Case) -> int:
        return 0

    def samples(self, case: ExtremeCase, setup: Case) -> ReferenceGradients:
        return ReferenceGradients(self.known().gradient(setup.weights))


Source = Stock | Differences | Extrapolated | Exact


@dataclass(frozen=True)
class ExtremeCase:
    """One case. `scene` is a function, because building the scene needs Mitsuba. The case uses the scene's first
    sensor.

    - `source` is the reference for gradients, in addition to naive AD at equal seeds. `naive` is true if naive AD fits
        into memory.
    - `image` is the stock integrator for the reference image, or "" if none can render the scene.
    - `options` are options of all integrators. `ours` are options of only `reslrb` and `walk_ad`.
    - `weights` changes the usual dL/dI of mean 1.
    - `signed` is true if derivatives can have either sign. Otherwise, no derivative may be negative.
    - `equal` is the limit of the relative L2 distance at equal seeds. If there is only one seed, the limit also applies
        to the distance from exact values.
    - `open_ended` lists parameters that no z-test can decide, with the reason. These parameters are compared only at
        equal seeds.
    - `moves` has the motions of light. With `moves`, the motions' amplitudes are the only parameters, `keys` is empty,
        and dL/dI is smooth. Only estimators with attached derivatives then take part.
    """

    name: str
    about: str
    scene: Scene
    keys: tuple[str, ...]
    source: Source
    image: str = "path"
    spp: int = 64
    seeds: int = 16
    options: Mapping[str, Any] = field(default_factory=lambda: {"max_depth": 4})
    ours: Mapping[str, Any] = field(default_factory=dict)
    weights: Callable[[np.ndarray], np.ndarray] | None = None
    signed: bool = False
    naive: bool = True
    equal: float = 1e-4
    open_ended: Mapping[str, str] = field(default_factory=dict)
    moves: Callable[[Any], Sequence[Move]] | None = None

    @property
    def way(self) -> dict[str, Any]:
        """The options that set the kinds of paths."""
        return {name: self.ours[name] for name in ("paths", "light_share") if name in self.ours}

    def setup(self) -> Case:
        """Load the scene with its parameters."""
        if self.moves is None:
            return Case(self.scene(), self.keys)
        return moving_case(self.scene(), self.moves)


def exact(
    name: str, about: str, known: Callable[[], KnownScene], keys: Mapping[str, str], max_depth: int, **more: Any
) -> ExtremeCase:
    """Return a case whose image is known in closed form. `keys` are the case's parameters. `more` sets other fields of
    the case.
    """
    shared: dict[str, Any] = {"options": {"max_depth": max_depth}, **more}
    return ExtremeCase(name, about, lambda: known().scene(), tuple(keys.values()), Exact(known), **shared)


_NO_BLACK_LAMP = "Mitsuba loads no lamp without light"
#: Cases that are left out in spectral variants, with the reason.
NOT_SPECTRAL = {
    "lamp_0": _NO_BLACK_LAMP,
    "black_lamp": _NO_BLACK_LAMP,
    "white_box_100": "at equal seeds, a hundred bounces have a larger rounding error than gradients of few bounces",
    "pure_colours": "differences are too large beside colours without a spectrum",
}


def left_out(case: ExtremeCase) -> str | None:
    """Return the reason why the case has no reference in the current variant, or None."""
    if not mi.is_spectral:
        return None
    return "its closed form is that of RGB" if isinstance(case.source, Exact) else NOT_SPECTRAL.get(case.name)


def without_roulette(case: ExtremeCase) -> dict[str, Any]:
    """Return a case's options for integrators whose gradients Russian roulette would bias. The options have no
    `rr_depth`.
    """
    return {key: value for key, value in case.options.items() if key != "rr_depth"}


#: The suite has fewer cases. Each case gets an equal share of the probability that correct gradients fail anywhere.
MOST_CASES = 100

#: The name of images in `ExtremeCase.open_ended`.
IMAGE = "image"

#: Negative values up to this share of the largest entry count as rounding.
BELOW_ZERO = 1e-5


def run_case(
    case: ExtremeCase, estimators: Iterable[str] | None = None, seeds: int | None = None
) -> Iterator[GradcheckRecord]:
    """Run a case with these estimators, by default all. `seeds` replaces the case's number of seeds."""
    case = case if seeds is None else replace(case, seeds=seeds)
    setup = case.setup()
    plain, groups = np.array(setup.weights), dict[str, tuple[dict[str, Any], dict[str, str]]]()
    for label in (*ESTIMATORS, *WAYS) if estimators is None else estimators:
        estimator, way = split(label)
        groups.setdefault(str(way), (way, {}))[1][label] = estimator
    runs = []
    for way, members in groups.values():
        if way and case.moves is not None:
            continue  # moving light has derivatives only on light paths
        reason = _hidden_from(case, setup) if way.get("paths") == "camera" else None
        runs.append((_seen_by(case, setup, way) if way else case, members, reason))
    family = _family(setup, [(seen, members) for seen, members, reason in runs if reason is None])
    for seen, members, reason in runs:
        setup.weights = type(setup.weights)(plain)
        if reason is None:
            yield from _run_way(seen, setup, members, family)
            continue
        none = Comparison(Verdict.NO_REFERENCE, message=reason)
        for label in members:
            yield _record(case, label, None, Reference.PRB, Kind.EXPECTATION, none)


def _family(setup: Case, runs: Iterable[tuple[ExtremeCase, Mapping[str, str]]]) -> Family:
    """Return the correction for all comparisons of a case by z scores."""
    sizes = [entry_count(shape) for *_, shape in _parameters(setup)]
    entries: list[int] = []
    for case, members in runs:
        for name in _taking_part(case, members).values():
            entries += sizes if case.naive and not ESTIMATORS[name].exact else []
            along = case.source.directions(setup)
            entries += [along] if along else sizes if case.seeds > 1 else []
            entries += [entry_count(tuple(setup.weights.shape))] if case.image else []
    return Family(len(entries), sum(entries), ALPHA / MOST_CASES)


def _taking_part(case: ExtremeCase, members: Mapping[str, str]) -> dict[str, str]:
    """Return the estimators of `members` that have the derivatives of the case."""
    return {label: name for label, name in members.items() if case.moves is None or name in ATTACHED}


#: Label of camera paths, next to the estimators of light paths, as in `--estimators`.
WAYS = ("stack(paths=both)", "stack(paths=camera)")

#: Radius of a filter, in pixels, that does not reach beyond the film.
BOX = 0.5


def split(label: str) -> tuple[str, dict[str, Any]]:
    """Split a label such as `stack(paths=both)` into estimator and options. Raises ConfigError."""
    [listed] = parse_cases(f"reslrb:{label}")
    options = dict(listed.options)
    return str(options.pop("estimator")), options


def _loses_border(case: ExtremeCase, setup: Case) -> bool:
    """True if light paths lose light along the film's border and camera paths do not."""
    return bool(setup.scene.sensors()[0].film().rfilter().radius() > BOX)


def _hidden_from(case: ExtremeCase, setup: Case) -> str | None:
    """Return the reason to leave out camera paths, or None. Camera paths may find no light, or find light too rarely
    for a z-test.
    """
    depth, hidden = case.options["max_depth"], bool(case.options.get("hide_emitters", False))
    at = Situation.of(setup.scene, setup.scene.sensors()[0], setup.params, depth, hidden, paths="both")
    reason = prb_image(at)
    if reason is None and case.image == "ptracer" and not _loses_border(case, setup):
        reason = "paths from the sensor hardly ever find this light"
    return reason


def _seen_by(case: ExtremeCase, setup: Case, way: Mapping[str, Any]) -> ExtremeCase:
    """Return the case for these paths. If `ptracer` loses light at the film's border, `prb` and `path` become
    references.
    """
    changed: dict[str, Any] = {"ours": {**case.ours, **way}}
    if _loses_border(case, setup) and case.source == Stock("ptracer"):
        changed |= {"source": Stock("prb"), "image": "path" if case.image else ""}
    return replace(case, **changed)


def _run_way(case: ExtremeCase, setup: Case, members: Mapping[str, str], family: Family) -> Iterator[GradcheckRecord]:
    """Run estimators that trace the same kinds of paths. `members` has the name of each estimator by its label."""
    weights = np.array(setup.weights) if case.weights is None else case.weights(np.array(setup.weights))
    # Refused values of dL/dI count as zero, and references never get them.
    setup.weights = type(setup.weights)(np.where(np.isfinite(weights), weights, 0))
    reference = case.source.samples(case, setup)
    attached = {} if case.moves is None else {"attached": True}
    walk_ad = integrator("walk_ad", **{**case.options, **case.ours, **attached})
    naive = setup.gradients(walk_ad, seeds_of(case.seeds), case.spp) if case.naive else None
    stock = None
    if case.image:
        tracer = integrator(case.image, **without_roulette(case))
        stock = np.stack([setup.image(tracer, seed, case.spp) for seed in seeds_of(case.seeds, 2)])
    setup.weights = type(setup.weights)(weights)
    for label, name in _taking_part(case, members).items():
        gradients, images, refused = _steps(case, setup, name)
        rows = list(_comparisons(case, setup, name, gradients, naive, reference, family))
        if stock is not None:
            rows.append((None, Reference(case.image), Kind.IMAGE, _images(case, images, stock, family)))
        if not np.isfinite(weights).all():
            rows.append((None, Reference.ANALYTIC, Kind.EQUAL_SEEDS, _refusals(weights, refused)))
        for row in rows:
            yield _record(case, label, *row)


def _record(
    case: ExtremeCase, label: str, parameter: str | None, other: Reference, kind: Kind, found: Comparison
) -> GradcheckRecord:
    way = records_of(split(label)[1])
    return GradcheckRecord(case.name, parameter, "reslrb", label, other, kind, case.seeds, **vars(found), **way)


def _steps(case: ExtremeCase, setup: Case, name: str) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """Return an estimator's gradients (N, P), images (N, H, W, 3), and numbers (N,) of refused dL/dI entries."""
    images, refused = [], []

    def step(*arguments: Any, **options: Any) -> None:
        result = gradient_step(*arguments, **options)
        images.append(np.array(result.image, np.float64)[:, :, :3])
        refused.append(int(result.refused.count[0]))

    # Naive AD follows everywhere: at equal seeds, it has the same derivatives as an integrator that follows everywhere.
    ours = {"attached_sampling": "follow"} | dict(case.ours)
    tracer = integrator("reslrb", **case.options, **ours, estimator=name)
    gradients = setup.gradients(tracer, seeds_of(case.seeds), case.spp, step=step)
    return gradients, np.stack(images), refused


def _refusals(weights: np.ndarray, refused: list[int]) -> Comparison:
    """Compare the numbers of refused dL/dI entries with the number of entries that are not finite."""
    expected, counts = int(np.count_nonzero(~np.isfinite(weights))), sorted(set(refused))
    message = f"refused {', '.join(map(str, counts))} entries of dL/dI, of {expected} not finite"
    return Comparison(Verdict.HOLDS if counts == [expected] else Verdict.FAILS, message=message)


def _comparisons(
    case: ExtremeCase,
    setup: Case,
    name: str,
    ours: np.ndarray,
    naive: np.ndarray | None,
    reference: ReferenceGradients,
    family: Family,
) -> Iterator[tuple[str | None, Reference, Kind, Comparison]]:
    for parameter, columns, shape in _parameters(setup):
        rounding = setup.rounding(parameter)
        equal = max(case.equal, rounding)
        if naive is not None:
            mine, its = ours[:, columns], naive[:, columns]
            if ESTIMATORS[name].exact:
                kind, found = Kind.EQUAL_SEEDS, compare_equal_seeds(mine, its, equal)
            else:
                kind = Kind.EXPECTATION
                found = compare_expectations(mine, its, family, shape=shape, rounding=rounding)
            yield parameter, Reference.WALK_AD, kind, _settled(case, parameter, found, mine)
        if reference.along is None:
            mine, its = ours[:, columns], reference.values[..., columns]
            if len(ours) == 1:  # no samples for a standard error
                found = compare_equal_seeds(mine, np.atleast_2d(its), equal)
            else:
                found = compare_expectations(mine, its, family, shape=shape, paired=reference.paired, rounding=rounding)
            yield parameter, case.source.reference, Kind.EXPECTATION, _settled(case, parameter, found, mine)
    if reference.along is not None:
        mine = ours @ reference.along.T
        found = compare_expectations(
            mine, reference.values, family, paired=reference.paired, bias=reference.bias, rounding=setup.rounding()
        )
        yield None, case.source.reference, Kind.EXPECTATION, _settled(case, None, found, mine)


def _parameters(setup: Case) -> Iterator[tuple[str, slice, tuple[int, ...]]]:
    """Yield the name, the slice of a gradient, and the shape of each parameter."""
    for key, place in setup.places.items():
        shape, size = np.shape(setup.values.value(key)), len(setup.initial[key])
        yield key, place, shape if np.prod(shape, dtype=int) == size else (size,)


def _settled(case: ExtremeCase, parameter: str | None, found: Comparison, ours: np.ndarray) -> Comparison:
    """Return the comparison `found`, adjusted to the case's special conditions. A comparison of the suite stays
    undecided only if the case gives a reason.
    """
    if found.verdict is Verdict.UNREACHED and parameter in case.open_ended:
        return replace(found, verdict=Verdict.HOLDS, message="exactly zero, like the reference")
    if found.verdict in (Verdict.UNREACHED, Verdict.HEAVY_TAILED, Verdict.UNRESOLVED):
        reason = case.open_ended.get(parameter or "")
        if reason is None:
            return replace(found, verdict=Verdict.FAILS, message=f"{found.verdict.value}: {found.message}")
        return replace(found, message=reason)
    return found if case.signed else _not_negative(found, ours, BELOW_ZERO)


def _not_negative(found: Comparison, ours: np.ndarray, share: float) -> Comparison:
    """Return the comparison. The comparison fails if an entry is negative by more than `share` of the largest entry. In
    a spectral variant, values may be negative, because the film's responses are.
    """
    if mi.is_spectral:
        return found
    if found.verdict is Verdict.HOLDS and ours.min() < -share * np.abs(ours).max():
        return replace(found, verdict=Verdict.FAILS, message=f"negative: {ours.min():.3g}")
    return found


def _images(case: ExtremeCase, ours: np.ndarray, stock: np.ndarray, family: Family) -> Comparison:
    flat, other = ours.reshape(len(ours), -1), stock.reshape(len(stock), -1)
    found = compare_expectations(flat, other, family, shape=ours.shape[1:], paired=False)
    if found.verdict is Verdict.UNREACHED:
        return replace(found, verdict=Verdict.HOLDS, message="black")
    return _not_negative(_settled(case, IMAGE, found, flat), flat, 0)
