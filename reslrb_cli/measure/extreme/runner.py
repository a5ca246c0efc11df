"""Runs cases of the extreme suite: every estimator against naive AD of the same paths, and each case's reference."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from reslrb_cli.estimators import ESTIMATORS
from reslrb_cli.integrators import gradient_step, render_image
from reslrb_cli.measure.comparison import Comparison, Family, compare_equal_seeds, compare_expectations
from reslrb_cli.measure.extreme.case import ExtremeCase, Samples, Zero, without_roulette
from reslrb_cli.measure.extreme.residual import residual
from reslrb_cli.measure.gradients import Case, integrator
from reslrb_cli.measure.gradients import seeds as seeds_of
from reslrb_cli.measure.statistics import renders
from reslrb_cli.records.gradcheck import GradcheckRecord, Kind, Reference, Verdict

#: All z scores of the suite are corrected for together; a little more than it has.
FAMILY = Family(rows=1500, entries=30000)
#: What rounding may leave below zero, of the largest entry.
BELOW_ZERO = 1e-5


def run_cases(
    cases: Iterable[ExtremeCase], estimators: Iterable[str] | None = None, seeds: int | None = None
) -> Iterator[GradcheckRecord]:
    """Run `cases` with these estimators (all of them by default); `seeds` replaces each case's own number."""
    names = tuple(estimators) if estimators is not None else tuple(ESTIMATORS)
    for case in cases:
        yield from _run(case if seeds is None else replace(case, seeds=seeds), names)


def _run(case: ExtremeCase, estimators: tuple[str, ...]) -> Iterator[GradcheckRecord]:
    setup = case.setup()
    weights = np.array(setup.weights) if case.weights is None else case.weights(np.array(setup.weights))
    # What is refused of dL/dI counts as zero; references are never shown it.
    setup.weights = type(setup.weights)(np.where(np.isfinite(weights), weights, 0))
    reference = case.source.samples(case, setup)
    walk_ad = integrator("walk_ad", **case.naive_options())
    naive = setup.gradients(walk_ad, seeds_of(case.seeds), case.spp) if case.naive else None
    stock = _stock_images(case, setup) if case.image else None
    setup.weights = type(setup.weights)(weights)
    for name in estimators if case.moves is None else [name for name in estimators if ESTIMATORS[name].attaches]:
        taken = _steps(case, setup, name)
        rows = list(_comparisons(case, setup, name, taken.gradients, naive, reference))
        if stock is not None:
            rows.append((None, Reference(case.image), Kind.IMAGE, _images(taken.images, stock)))
        if not np.isfinite(weights).all():
            rows.append((None, Reference.ANALYTIC, Kind.EQUAL_SEEDS, _refusals(weights, taken.refused)))
        if case.residual and name == "gather":
            rows.append((None, Reference.ANALYTIC, Kind.EQUAL_SEEDS, residual(case, setup)))
        for parameter, other, kind, comparison in rows:
            yield GradcheckRecord(case.name, parameter, "reslrb", name, other, kind, case.seeds, **comparison.figures)


@dataclass(frozen=True)
class _Taken:
    """Of an estimator's steps: gradients (N, P), images (N, H, W, 3), entries of dL/dI that were refused (N,)."""

    gradients: np.ndarray
    images: np.ndarray
    refused: list[int]


def _steps(case: ExtremeCase, setup: Case, name: str) -> _Taken:
    images, refused = [], []

    def step(*arguments: Any, **options: Any) -> None:
        result = gradient_step(*arguments, **options)
        images.append(np.array(result.image, np.float64)[:, :, :3])
        refused.append(int(result.refused.count[0]))

    # Naive AD follows everywhere: at equal seeds it has the same derivatives of what follows alone.
    ours = {"attached_sampling": "follow"} | dict(case.ours)
    tracer = integrator("reslrb", **case.options, **ours, estimator=name)
    gradients = setup.gradients(tracer, seeds_of(case.seeds), case.spp, step=step)
    return _Taken(gradients, np.stack(images), refused)


def _refusals(weights: np.ndarray, refused: list[int]) -> Comparison:
    """Whether every step counted just the entries of dL/dI that are not finite."""
    expected = int(np.count_nonzero(~np.isfinite(weights)))
    holds = set(refused) == {expected}
    message = f"refused {', '.join(map(str, sorted(set(refused))))} entries of dL/dI, of {expected} not finite"
    return Comparison(Verdict.HOLDS if holds else Verdict.FAILS, None, message=message)


def _stock_images(case: ExtremeCase, setup: Case) -> np.ndarray:
    tracer = integrator(case.image, **without_roulette(case))
    return renders(lambda seed: render_image(tracer, setup.scene, 0, seed, case.spp), seeds_of(case.seeds, 2))[..., :3]


def _comparisons(
    case: ExtremeCase, setup: Case, name: str, ours: np.ndarray, naive: np.ndarray | None, reference: Samples
) -> Iterator[tuple[str | None, Reference, Kind, Comparison]]:
    for parameter, columns, shape in _parameters(setup):
        if naive is not None:
            mine, its = ours[:, columns], naive[:, columns]
            if ESTIMATORS[name].exact:
                kind, found = Kind.EQUAL_SEEDS, compare_equal_seeds(mine, its, case.equal)
            elif parameter in case.elsewhere:
                continue
            else:
                kind, found = Kind.EXPECTATION, compare_expectations(mine, its, FAMILY, shape=shape)
            yield parameter, Reference.WALK_AD, kind, _settled(case, parameter, found, mine)
        if reference.along is None and parameter not in case.elsewhere:
            mine, its = ours[:, columns], reference.values[..., columns]
            if len(ours) == 1:  # nothing to take a standard error of
                found = compare_equal_seeds(mine, np.atleast_2d(its), case.equal)
            else:
                found = compare_expectations(mine, its, FAMILY, shape=shape, paired=reference.paired)
            yield parameter, case.source.reference, Kind.EXPECTATION, _settled(case, parameter, found, mine)
    if reference.along is not None:
        mine = ours @ reference.along.T
        found = compare_expectations(mine, reference.values, FAMILY, paired=reference.paired, bias=reference.bias)
        yield None, case.source.reference, Kind.EXPECTATION, _settled(case, None, found, mine)


def _parameters(setup: Case) -> Iterator[tuple[str, slice, tuple[int, ...]]]:
    """Each parameter: its name, where it stands in a gradient, and its shape."""
    at = 0
    for key, value in setup.initial.items():
        shape = np.shape(setup.values.value(key))
        yield key, slice(at, at + len(value)), shape if np.prod(shape, dtype=int) == len(value) else (len(value),)
        at += len(value)


def _settled(case: ExtremeCase, parameter: str | None, found: Comparison, ours: np.ndarray) -> Comparison:
    """The comparison with what else has to hold; in a suite nothing is left open without a reason."""
    if found.verdict is Verdict.UNREACHED and isinstance(case.source, Zero):
        return replace(found, verdict=Verdict.HOLDS, message="exactly zero")
    if found.verdict is Verdict.UNREACHED and parameter in case.open_ended:
        return replace(found, verdict=Verdict.HOLDS, message="exactly zero, as the reference")
    if found.verdict in (Verdict.UNREACHED, Verdict.HEAVY_TAILED, Verdict.UNRESOLVED):
        reason = case.open_ended.get(parameter or "")
        if reason is None:
            return replace(found, verdict=Verdict.FAILS, message=f"{found.verdict.value}: {found.message}")
        return replace(found, message=reason)
    if found.verdict is Verdict.HOLDS and not case.signed and ours.min() < -BELOW_ZERO * np.abs(ours).max():
        return replace(found, verdict=Verdict.FAILS, message=f"negative: {ours.min():.3g}")
    return found


def _images(ours: np.ndarray, stock: np.ndarray) -> Comparison:
    shape = ours.shape[1:]
    flat, other = ours.reshape(len(ours), -1), stock.reshape(len(stock), -1)
    found = compare_expectations(flat, other, FAMILY, shape=shape, paired=False)
    if found.verdict is Verdict.HOLDS and ours.min() < 0:
        return replace(found, verdict=Verdict.FAILS, message=f"negative: {ours.min():.3g}")
    if found.verdict is Verdict.UNREACHED:
        return replace(found, verdict=Verdict.HOLDS, message="black")
    return found
