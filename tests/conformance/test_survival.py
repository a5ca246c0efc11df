"""Roulette by what paths can still say: means stay, whatever the table, and replays follow the same paths."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from agreement import compare
from conformance.test_guiding import SPP, guided, sample, samples, seeds
from turns import a_few

from reslrb_cli.estimators import ESTIMATORS
from reslrb_cli.guiding.tables import Guiding, Purpose
from reslrb_cli.measure.gradients import Case, relative
from reslrb_cli.transport.guide import Table
from reslrb_cli.transport.roulette import CELLS, Survival

pytestmark = pytest.mark.usefixtures("llvm")
NAMES = ("texture", "two_emitters", "envmap", "roulette", "glass", "mask", "mask_texture_in_view")
BOX = np.array([[-1.0, -2.0, 0.0], [3.0, 2.0, 0.0]], np.float32)  # flat


def harsh(scene: Case, ours: Any, factor: float = 1.0) -> Any:
    """Have an integrator play roulette by a table of large contrasts, which has nothing to do with the scene."""
    ours.preparation.plan(scene.scene, scene.scene.sensors()[0], scene.params)
    by_harsh_table(ours.preparation.guiding, factor)
    return ours


def by_harsh_table(guiding: Guiding, factor: float = 1.0) -> None:
    """The same of its tables, from which the first sensor's samples are drawn until they next learn."""
    onward = guiding.learned[0].onward if 0 in guiding.learned else None
    light = 1.0 if onward is None else onward.light
    survival = Survival.of(guiding.box, factor / light * np.random.default_rng(1).lognormal(-1, 1.5, CELLS))
    for purpose in Purpose:
        table, counts = guiding._table(0, purpose)
        guiding._tables[0, purpose] = replace(table, survival=survival), counts


# ---- The means -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", a_few(NAMES, ["two_emitters"]))
def test_means_are_those_of_unguided_samples(name: str) -> None:
    assert means_hold(name, 32)


def means_hold(name: str, count: int) -> Any:
    scene, ours, plain = guided(name, 1)
    result = compare(samples(scene, harsh(scene, ours), count), samples(scene, plain, count, 1), block=None)
    print(name, result)
    return result


@pytest.mark.parametrize("estimator", a_few(ESTIMATORS, ["reservoir", "event"]))
@pytest.mark.parametrize("adjoint", a_few(["correlated", "independent", "batched"], ["correlated"]))
def test_every_way_of_a_step_has_the_mean_of_the_unguided(estimator: str, adjoint: str) -> None:
    scene, ours, plain = guided("two_emitters", 1, estimator=estimator)
    harsh(scene, ours)
    found = [scene.gradients(each, seeds(24, block), SPP, adjoint=adjoint) for block, each in enumerate((ours, plain))]
    result = compare(*found, block=None)
    print(estimator, adjoint, result)
    assert result


def without_weight(patch: pytest.MonkeyPatch) -> None:
    """What lives on counts for no more than before."""
    from reslrb_cli.transport.factors import Product

    patch.setattr(Product, "scaled", lambda self, scale: self)


def of_another_cell(patch: pytest.MonkeyPatch) -> None:
    """The weight is that of one probability, what is ended that of another."""
    import drjit as dr

    from reslrb_cli.transport import walk

    right = dr.rcp
    patch.setattr(walk.dr, "rcp", lambda q: right(dr.clip(1.1 * q, 0, 1)))


@pytest.mark.parametrize("fault", [without_weight, of_another_cell])
def test_what_would_bias_is_found(fault: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    fault(monkeypatch)
    assert not means_hold("two_emitters", 32)


# ---- Replays ---------------------------------------------------------------------------------------------------------


def replayed_from(patch: pytest.MonkeyPatch, other: Callable[[Table], Table]) -> None:
    """The replay draws from what `other` makes of its table."""
    from reslrb_cli.integrators import reslrb as lt
    from reslrb_cli.integrators.reslrb import Reslrb

    right = Reslrb._replay

    def wrong(self: Reslrb, trace: Any, gradient: Any, params: Any) -> None:
        [samples] = trace.samples
        again = replace(samples, guide=replace(samples.guide, table=other(samples.guide.table)))
        right(self, lt.Trace([again], trace.image, trace.state), gradient, params)

    patch.setattr(Reslrb, "_replay", wrong)


def replays_agree(make: Callable[[str], tuple[Case, Any]]) -> bool:
    """At equal seeds `gather`, which traces twice, has the gradient of `stack` by dL/dI that is known beforehand.

    `make` makes a case and an integrator of an estimator. A `stack` that traces twice has it, too, or `gather` has not.
    """
    found = {}
    for kind in ("gather", "stack"):
        scene, ours = make(kind)
        found[kind] = scene.gradient(ours, 5, SPP, adjoint="correlated")
    known = sample(scene, ours, 5)[: len(found["gather"])]  # by `stack`, in one traversal
    agree = {kind: relative(gradient, known) < 1e-4 for kind, gradient in found.items()}
    assert agree["stack"] or not agree["gather"]
    return agree["gather"]


@pytest.mark.parametrize("fault", [False, True])
@pytest.mark.parametrize("name", a_few(["two_emitters", "mask_texture_in_view"], ["two_emitters"]))
def test_a_replay_follows_the_paths_that_were_traced(name: str, fault: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    def make(estimator: str) -> tuple[Case, Any]:
        scene, ours, _ = guided(name, 1, estimator=estimator)
        return scene, harsh(scene, ours)

    def other(table: Table) -> Table:
        return replace(table, survival=replace(table.survival, chances=1.2 * table.survival.chances))

    if fault:
        replayed_from(monkeypatch, other)
    assert replays_agree(make) is not fault


def test_a_recorded_step_is_the_step() -> None:
    """Recordings have the table that there is, not the one that they were made with."""
    (scene, ours, _), (_, frozen, _) = (guided("envmap", 0, freeze=freeze) for freeze in (False, True))
    for factor in (1.0, 0.3, 3.0):
        both = [sample(scene, harsh(scene, each, factor), 5) for each in (ours, frozen)]
        assert relative(*both) < 1e-4
    assert frozen.preparation.recordings.counts()["fused"] > 0
