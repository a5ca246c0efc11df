"""The extreme suite: `run_case` compares the estimators with the references of a case of the catalogue.

Each case is run with light paths and with camera paths (`WAYS`). Camera paths use the same references as light paths,
except at the film's border (`_seen_by`). Camera paths are also compared with naive AD of the same paths.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from itertools import takewhile
from typing import Any

import mitsuba as mi
import numpy as np

from reslrb_cli.estimators import ATTACHED, ESTIMATORS
from reslrb_cli.integrators.step import gradient_step
from reslrb_cli.measure.comparison import ALPHA, Family, compare_equal_seeds, compare_expectations, entry_count
from reslrb_cli.measure.gradients import Case, integrator
from reslrb_cli.measure.gradients import seeds as seeds_of
from reslrb_cli.measure.methods import parse_cases
from reslrb_cli.measure.references import Situation, prb_image
from reslrb_cli.measure.scenes.case import Differences, ReferenceGradients, SceneCase
from reslrb_cli.measure.scenes.catalogue import CASES, IMAGE, PRB, PTRACER
from reslrb_cli.records.measurements import Comparison, GradcheckRecord, Kind, Reference, Verdict

#: The suite has fewer cases. Each case gets an equal share of the probability that correct gradients fail anywhere.
MOST_CASES = 100

#: Methods with camera paths, which the suite runs beside the estimators of light paths.
WAYS = ("stack(paths=both)", "stack(paths=camera)")

#: Radius of a filter, in pixels, that does not reach beyond the film.
BOX = 0.5

#: Negative values up to this share of the largest entry count as rounding.
BELOW_ZERO = 1e-5

#: Parameter, reference, kind and result of a comparison.
Row = tuple[str | None, Reference, Kind, Comparison]


def case_records(
    stop: Callable[[], bool], name: str, estimators: Iterable[str] | None, seeds: int | None
) -> list[GradcheckRecord]:
    """Return the records of one case. Some records are missing if `stop()` became true."""
    return list(takewhile(lambda _: not stop(), run_case(CASES[name], estimators, seeds)))


def run_case(
    case: SceneCase, estimators: Iterable[str] | None = None, seeds: int | None = None
) -> Iterator[GradcheckRecord]:
    """Run a case with these estimators, by default all. `seeds` replaces the case's number of seeds."""
    case = case if seeds is None else replace(case, seeds=seeds)
    setup = case.setup()
    plain, groups = np.array(setup.weights), dict[str, tuple[dict[str, Any], dict[str, str]]]()
    for label in (*ESTIMATORS, *WAYS) if estimators is None else estimators:
        estimator, way = split(label)
        # Moving light has derivatives only on light paths, and only by estimators with attached derivatives.
        if case.moves is None or (not way and estimator in ATTACHED):
            groups.setdefault(str(way), (way, {}))[1][label] = estimator
    runs = []
    for way, members in groups.values():
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


def _family(setup: Case, runs: Iterable[tuple[SceneCase, Mapping[str, str]]]) -> Family:
    """Return the correction for all comparisons of a case by z scores."""
    sizes = [entry_count(shape) for *_, shape in _parameters(setup)]
    entries: list[int] = []
    for case, members in runs:
        for name in members.values():
            entries += sizes if case.naive and not ESTIMATORS[name].exact else []
            along = case.source.directions(setup) if isinstance(case.source, Differences) else 0
            entries += [along] if along else sizes if case.seeds > 1 else []
            entries += [entry_count(tuple(setup.weights.shape))] if case.image else []
    return Family(len(entries), sum(entries), ALPHA / MOST_CASES)


def split(label: str) -> tuple[str, dict[str, Any]]:
    """Split a label such as `stack(paths=both)` into estimator and options. Raises ConfigError."""
    [listed] = parse_cases(f"reslrb:{label}")
    options = dict(listed.options)
    return str(options.pop("estimator")), options


def _loses_border(case: SceneCase, setup: Case) -> bool:
    """True if light paths lose light along the film's border and camera paths do not."""
    return bool(setup.scene.sensors()[0].film().rfilter().radius() > BOX)


def _hidden_from(case: SceneCase, setup: Case) -> str | None:
    """Return why camera paths find no light, or find light too rarely for a z-test, or None."""
    depth, hidden = case.options["max_depth"], bool(case.options.get("hide_emitters", False))
    at = Situation.of(setup.scene, setup.scene.sensors()[0], setup.params, depth, hidden, paths="both")
    reason = prb_image(at)
    if reason is None and case.image == "ptracer" and not _loses_border(case, setup):
        reason = "paths from the sensor hardly ever find this light"
    return reason


def _seen_by(case: SceneCase, setup: Case, way: Mapping[str, Any]) -> SceneCase:
    """Return the case for these paths. If `ptracer` loses light at the film's border, `prb` and `path` become
    references.
    """
    changed: dict[str, Any] = {"ours": {**case.ours, **way}}
    if _loses_border(case, setup) and case.source == PTRACER:
        changed |= {"source": PRB, "image": "path" if case.image else ""}
    return replace(case, **changed)


def _run_way(case: SceneCase, setup: Case, members: Mapping[str, str], family: Family) -> Iterator[GradcheckRecord]:
    """Run estimators that trace the same kinds of paths. `members` has the name of each estimator by its label."""
    weights = np.array(setup.weights) if case.weights is None else case.weights(np.array(setup.weights))
    # Refused values of dL/dI count as zero, and references never get them.
    setup.weights = type(setup.weights)(np.where(np.isfinite(weights), weights, 0))
    reference = case.source.samples(case, setup)
    walk_ad = integrator("walk_ad", **case.own | ({} if case.moves is None else {"attached": True}))
    naive = setup.gradients(walk_ad, seeds_of(case.seeds), case.spp) if case.naive else None
    stock = None
    if case.image:
        tracer = integrator(case.image, **case.without_roulette)
        stock = np.stack([setup.image(tracer, seed, case.spp) for seed in seeds_of(case.seeds, 2)])
    setup.weights = type(setup.weights)(weights)
    for label, name in members.items():
        gradients, images, refused = _steps(case, setup, name)
        rows = list(_comparisons(case, setup, name, gradients, naive, reference, family))
        if stock is not None:
            rows.append((None, Reference(case.image), Kind.IMAGE, _images(case, images, stock, family)))
        if expected := int(np.count_nonzero(~np.isfinite(weights))):
            message = f"refused {', '.join(map(str, sorted(set(refused))))} entries of dL/dI, of {expected} not finite"
            verdict = Verdict.HOLDS if set(refused) == {expected} else Verdict.FAILS
            rows.append((None, Reference.ANALYTIC, Kind.EQUAL_SEEDS, Comparison(verdict, message=message)))
        for row in rows:
            yield _record(case, label, *row)


def _record(
    case: SceneCase, label: str, parameter: str | None, other: Reference, kind: Kind, found: Comparison
) -> GradcheckRecord:
    name, way = f"reslrb:{label}", split(label)[1]
    return GradcheckRecord(case.name, parameter, name, way, other, kind, case.seeds, **vars(found))


def _steps(case: SceneCase, setup: Case, name: str) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """Return an estimator's gradients (N, P), images (N, H, W, 3), and numbers (N,) of refused dL/dI entries."""
    images, refused = [], []

    def step(*arguments: Any, **options: Any) -> None:
        result = gradient_step(*arguments, **options)
        images.append(np.array(result.image, np.float64)[:, :, :3])
        refused.append(int(result.refused.count[0]))

    # Naive AD follows everywhere: at equal seeds, it has the same derivatives as an integrator that follows everywhere.
    tracer = integrator("reslrb", **{"attached_sampling": "follow"} | case.own, estimator=name)
    gradients = setup.gradients(tracer, seeds_of(case.seeds), case.spp, step=step)
    return gradients, np.stack(images), refused


def _comparisons(
    case: SceneCase,
    setup: Case,
    name: str,
    ours: np.ndarray,
    naive: np.ndarray | None,
    reference: ReferenceGradients,
    family: Family,
) -> Iterator[Row]:
    source, expected = case.source.reference, reference.values
    for parameter, columns, shape in _parameters(setup):
        mine, rounding = ours[:, columns], setup.rounding(parameter)
        by_z: dict[str, Any] = {"family": family, "shape": shape, "rounding": rounding}
        equal = max(case.equal, rounding)
        if naive is not None:
            its = naive[:, columns]
            if ESTIMATORS[name].exact:
                kind, found = Kind.EQUAL_SEEDS, compare_equal_seeds(mine, its, equal)
            else:
                kind, found = Kind.EXPECTATION, compare_expectations(mine, its, **by_z)
            yield parameter, Reference.WALK_AD, kind, _settled(case, parameter, found, mine)
        if reference.along is None:
            its = expected[..., columns]
            if len(ours) == 1:  # no samples for a standard error
                found = compare_equal_seeds(mine, np.atleast_2d(its), equal)
            else:
                found = compare_expectations(mine, its, paired=reference.paired, **by_z)
            yield parameter, source, Kind.EXPECTATION, _settled(case, parameter, found, mine)
    if reference.along is not None:
        mine, paired = ours @ reference.along.T, reference.paired
        found = compare_expectations(
            mine, expected, family, paired=paired, bias=reference.bias, rounding=setup.rounding()
        )
        yield None, source, Kind.EXPECTATION, _settled(case, None, found, mine)


def _parameters(setup: Case) -> Iterator[tuple[str, slice, tuple[int, ...]]]:
    """Yield the name, the slice of a gradient, and the shape of each parameter."""
    for key, place in setup.places.items():
        shape, size = np.shape(setup.values.value(key)), len(setup.initial[key])
        yield key, place, shape if np.prod(shape, dtype=int) == size else (size,)


def _settled(case: SceneCase, parameter: str | None, found: Comparison, ours: np.ndarray) -> Comparison:
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
    if found.verdict is Verdict.HOLDS and not mi.is_spectral and ours.min() < -share * np.abs(ours).max():
        return replace(found, verdict=Verdict.FAILS, message=f"negative: {ours.min():.3g}")
    return found


def _images(case: SceneCase, ours: np.ndarray, stock: np.ndarray, family: Family) -> Comparison:
    flat, other = ours.reshape(len(ours), -1), stock.reshape(len(stock), -1)
    found = compare_expectations(flat, other, family, shape=ours.shape[1:], paired=False)
    if found.verdict is Verdict.UNREACHED:
        return replace(found, verdict=Verdict.HOLDS, message="black")
    return _not_negative(_settled(case, IMAGE, found, flat), flat, 0)
