"""Gradcheck holds for the unchanged code, and finds planted faults."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import takewhile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from agreement import compare, renders
from conformance.edge_cases import ball
from conformance.gradient_cases import CASES, IN_EXPECTATION
from conformance.guiding_faults import without_weight
from conformance.moving import mesh
from measure.faults import checked, estimators_of
from measure.faults import room as room_moving
from turns import a_few

from reslrb_cli.config.loader import load, loads
from reslrb_cli.config.schema import Config
from reslrb_cli.errors import ConfigError
from reslrb_cli.estimators import reservoir, stack
from reslrb_cli.integrators import forward
from reslrb_cli.integrators.reslrb import LightTracer
from reslrb_cli.measure.draws import DrawsFile
from reslrb_cli.measure.gradcheck import Gradcheck
from reslrb_cli.measure.gradients import (
    Case,
    choose_step,
    directions,
    integrator,
    moves_light,
    natural_bounds,
    smooth_rows,
    smooth_weights,
)
from reslrb_cli.measure.methods import all_estimators
from reslrb_cli.measure.participants import CheckSettings, Participants, Way
from reslrb_cli.measure.references import (
    Situation,
    of_image,
    path_image,
    prb_gradient,
    prb_image,
    ptracer_gradient,
    ptracer_image,
)
from reslrb_cli.measure.scenes import small
from reslrb_cli.measure.scenes.case import Differences
from reslrb_cli.measure.scenes.small import camera, diffuse, lamp, rgb, room, transform
from reslrb_cli.measure.scenes.small import room as corner
from reslrb_cli.records.measurements import Comparison, GradcheckRecord, Kind, Reference, Verdict, record_of
from reslrb_cli.report.tables import summary_lines
from reslrb_cli.scene.visibility import interior
from reslrb_cli.transport import walk as segment

# Gradcheck on a small Cornell box: the current code passes, and planted faults are found and named.

SMALL = ["scene.options.size=32", "scene.options.texture=4", "run.spp=8", "integrator.max_depth=4"]
SMALL += ["integrator.guiding=off"]  # guided steps have their own test
#: A quarter of the pixels, with twice the samples, for faults that show at equal seeds or in the whole gradient.
SMALLER = ("scene.options.size=16", "run.spp=16")

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
SMALL_BOX = ["run.spp=4", "target={render: {spp: 4}}"]


def box(*overrides: str) -> Config:
    """Return the experiment of the small Cornell box."""
    return loads(small.CORNELL_BOX, small.CORNELL_BOX_SOURCE, [*SMALL, *overrides])


def situation(made: Case, depth: int = 4, hidden: bool = False, **options: Any) -> Situation:
    """Return the situation of a case with its first sensor."""
    return Situation.of(made.scene, made.scene.sensors()[0], made.params, depth, hidden, **options)


def check(*overrides: str, estimators: str = "reservoir,event,gather,stack", seeds: int = 8) -> list[GradcheckRecord]:
    made = Gradcheck(CheckSettings(box(*overrides), estimators_of(estimators), 0, seeds))
    return list(made.run(lambda: False, lambda line: None))


def failures(records: list[GradcheckRecord]) -> set[tuple[str | None, str]]:
    return {
        (one.label.partition(":")[2] or None, one.reference.value)
        for one in records
        if one.verdict is not Verdict.HOLDS
    }


@pytest.mark.long  # tests of faults show that it holds without them
def test_it_holds():
    records = check("integrator.rr_depth=2", *SMALLER)
    assert failures(records) == set()
    assert [record.kind for record in records].count(Kind.IMAGE) == 1
    for name in ("reservoir", "event", "gather", "stack"):
        of = {record.reference: record for record in records if record.label == f"reslrb:{name}"}
        assert list(of) == [Reference.FINITE_DIFFERENCE, Reference.FORWARD_MODE, Reference.WALK_AD, Reference.PTRACER]
        exact = name in ("gather", "stack")
        assert (of[Reference.WALK_AD].kind is Kind.EQUAL_SEEDS) is exact
        assert of[Reference.WALK_AD].relative_l2 < (1e-5 if exact else 0.5)
        assert of[Reference.FINITE_DIFFERENCE].relative_l2 < (1e-3 if exact else 0.5)
        assert all(record.seeds == 8 and record.detectable < 0.5 for record in of.values())
        assert all(record.cosine > 0.9 for record in of.values())
        assert 0.8 < of[Reference.PTRACER].variance_ratio < 3


@pytest.mark.long
@pytest.mark.parametrize(
    "drawn",
    a_few(["guiding=on", "sequence=low_discrepancy", "paths=both,pixels=measured"],
          ["sequence=low_discrepancy"]),
)  # fmt: skip
def test_differently_sampled_paths_agree_with_naive_ad_in_expectation(drawn: str):
    records = check(estimators=f"stack({drawn})", seeds=16)
    assert [(record.reference.value, record.verdict) for record in records if record.verdict is not Verdict.HOLDS] == []
    kinds = {record.kind for record in records if record.reference is Reference.WALK_AD}
    assert kinds == {Kind.EXPECTATION}


def test_guided_steps_are_checked_if_a_run_may_guide(monkeypatch: pytest.MonkeyPatch):
    """A fault of the tables shows in guided steps alone."""
    config = box("integrator.guiding=auto", *SMALLER)
    labels = [case.label for case in all_estimators(config)]
    assert labels[-1] == "reslrb:stack(guiding=on)"
    for changes in ("integrator.guiding=off", "integrator.guiding=on", "integrator.paths=camera"):
        assert labels[-1] not in [case.label for case in all_estimators(box("integrator.guiding=auto", changes))]
    assert failures(check(*SMALLER, estimators="stack(guiding=on)")) == set()

    without_weight(monkeypatch)
    found = failures(check(*SMALLER, estimators="stack,stack(guiding=on)"))
    assert {name for name, _ in found} == {"stack(guiding=on)"}
    assert {"walk_ad", "ptracer", "finite_difference"} <= {reference for _, reference in found}


def stronger(right: Any) -> Any:
    def connect(*arguments):
        connection = right(*arguments)
        connection.rest = connection.rest * 1.3
        return connection

    return connect


@pytest.mark.parametrize(
    ("module", "name", "wrong", "estimators", "settings", "fails"),
    [
        # The reservoir is wrong by a fifth. All of its references fail.
        (reservoir, "slot_adjoint", lambda right: lambda p, W, *rest: right(p, W * 1.2, *rest), "reservoir", (),
         [("reservoir", name) for name in ("walk_ad", "ptracer", "finite_difference", "forward_mode")]),
        # A slightly wrong derivative.
        (stack, "pass_vertex", lambda right: lambda *given: right(*given[:-1], given[-1] * 1.001), "stack,gather", (),
         [("stack", name) for name in ("walk_ad", "finite_difference", "forward_mode")]),
        # Forward mode lacks the weight of roulette.
        (forward.TangentSplat, "survived", lambda right: lambda self, state, weight: state, "stack",
         ("integrator.rr_depth=1",), [("stack", "forward_mode")]),
        # Connections are too strong by 30 %. The image and the gradient differ from the stock reference, and agree with
        # naive AD and finite differences, which share the fault.
        (segment, "connect", stronger, "stack", (), [(None, "ptracer"), ("stack", "ptracer")]),
    ],
    ids=["selection", "derivative", "roulette", "connection"],
)  # fmt: skip
def test_a_fault_fails_against_the_references_that_do_not_share_it(
    module: Any, name: str, wrong: Any, estimators: str, settings: tuple[str, ...], fails: list[Any],
    monkeypatch: pytest.MonkeyPatch,
):  # fmt: skip
    monkeypatch.setattr(module, name, wrong(getattr(module, name)))
    seeds = 16 if estimators == "reservoir" else 8
    assert failures(check(*settings, *SMALLER, estimators=estimators, seeds=seeds)) == set(fails)


def pretended(settings: CheckSettings, monkeypatch: pytest.MonkeyPatch, load_s: float = 2.0) -> Gradcheck:
    """Return a check whose samples only pretend. Each takes a second on the check's clock, and compiling 5 s more."""
    clock, known = [1000.0], set()

    def sample(kind: str, of: str, seed: int) -> np.ndarray:
        clock[0] += 1 if (kind, of) in known else 6
        known.add((kind, of))
        found = np.random.default_rng(seed).normal(1, 0.1, 4 if kind in ("gradient", "image") else 2)
        return np.append(found, 1e-4) if kind == "gradient" else found

    made = Gradcheck(settings, lambda: clock[0])
    monkeypatch.setattr(made.participants, "sample", sample)
    monkeypatch.setattr(made.participants, "choose_steps", lambda of: None)
    clock[0] += load_s
    return made


def test_all_quantities_take_turns(monkeypatch: pytest.MonkeyPatch):
    """The order does not depend on time. At the end, all quantities have as many seeds as were asked for."""
    taken, made = [], pretended(CheckSettings(box(), estimators_of("stack,event"), 0, 5), monkeypatch)
    right = made.participants.sample
    made.participants.sample = lambda *name: taken.append(name) or right(*name)
    said: list[str] = []
    made.draw(lambda: False, said.append, lambda: None)
    names = [name[:2] for name in taken[: len(taken) // 5]]
    assert len(set(names)) == len(names) == 8
    assert taken == [(*name, seed) for seed in range(100, 105) for name in names]
    assert said == ["1 of 5 seeds, 50 s", "2 of 5 seeds, 58 s", "4 of 5 seeds, 74 s"]


@pytest.mark.parametrize(
    ("budget_s", "seeds", "counts"),
    [(0, None, {0}), (20, None, {0, 1}), (53, None, {1, 2}), (110, None, {8, 9}), (1e6, None, {16}), (0, 5, {5})],
)
def test_a_budget_ends_early(budget_s: float, seeds: int | None, counts: set[int], monkeypatch: pytest.MonkeyPatch):
    """A sample that has started is finished. Comparisons with fewer than 8 seeds are unresolved and say how many they
    had, and comparisons without any are named. If no more seeds were asked for, the advice is to use more.
    """
    made = pretended(CheckSettings(box(), estimators_of("stack,event"), budget_s, seeds), monkeypatch)
    monkeypatch.setattr("reslrb_cli.measure.gradcheck.value_shape", lambda value: (4,))
    monkeypatch.setattr(made.participants.case, "weights", np.zeros(4))
    made.participants.case.size = 4
    made.participants.case.places = dict.fromkeys(made.participants.case.places, slice(0, 4))
    for chosen in made.participants.directions.values():
        chosen[:] = [replace(direction, vector=np.ones(4)) for direction in chosen]
    records = list(made.run(lambda: False, lambda line: None))
    assert {len(samples) for samples in made.draws.values()} <= counts
    spent = "the budget was spent; allow more with --budget"
    for record in records:
        assert record.seeds in counts
        if record.seeds == 0:
            assert (record.verdict, record.message) == (Verdict.NOT_MEASURED, spent)
        elif record.seeds < 8 and record.kind is not Kind.EQUAL_SEEDS:
            assert (record.verdict, record.detectable is None) == (Verdict.UNRESOLVED, record.seeds == 1)
            few = (
                "{} seeds are too few to know the noise: use at least 8"
                if seeds
                else "{} of 16 seeds are too few to know"
            )
            assert record.message.startswith(few.format(record.seeds))
            assert seeds or record.message.endswith(f": {spent}")
        else:
            assert record.verdict in (Verdict.HOLDS, Verdict.FAILS)
    left = [record for record in records if record.seeds == 0]
    assert (f"open: {len(left)} not measured: {spent}" in summary_lines(records)) == bool(left)


def test_an_interrupt_compares_the_finished_samples():
    config = box(*SMALLER)
    asked = iter(range(10_000))
    made = Gradcheck(CheckSettings(config, estimators_of("stack"), 0, 8))
    records = list(made.run(lambda: next(asked) > 10, lambda line: None))
    assert [(record.reference, record.seeds) for record in records] == [
        (Reference.PTRACER, 2), (Reference.FINITE_DIFFERENCE, 2), (Reference.FORWARD_MODE, 1),
        (Reference.WALK_AD, 1), (Reference.PTRACER, 1),
    ]  # fmt: skip
    fresh = Gradcheck(CheckSettings(config, estimators_of("stack"), 0, 8))
    assert list(fresh.run(lambda: True, lambda line: None)) == []


@pytest.mark.parametrize("variant", a_few(["llvm_ad_rgb", "llvm_ad_spectral"], ["llvm_ad_rgb"]))
def test_samples_on_file_are_not_drawn_again(variant: str, tmp_path: Path, request: pytest.FixtureRequest):
    """More seeds, and other estimators, draw only what is missing. A complete file gives the same table. Samples of
    another experiment do not count.
    """
    request.getfixturevalue("spectral" if "spectral" in variant else "llvm")
    file = tmp_path / "draws.npz"

    def records(seeds: int, estimators: str = "stack", *overrides: str) -> tuple[list[GradcheckRecord], int]:
        config = box("scene.options.size=8", f"variant={variant}", *overrides)
        made = Gradcheck(CheckSettings(config, estimators_of(estimators), 0, seeds), file=DrawsFile(file))
        taken, right = [], made.participants.sample

        def sample(*name: Any) -> np.ndarray:
            taken.append(name)
            found = right(*name)
            if name[0] == "gradient":  # rounding errors grow with the seeds
                found[-1] = 1e-4 * (name[2] - 98)
            return found

        made.participants.sample = sample  # type: ignore[method-assign]
        return list(made.run(lambda: False, lambda line: None)), len(taken)

    first, taken = records(3)
    assert taken == 21
    more, taken = records(4)
    assert taken == 7
    assert records(4) == (more, 0)
    assert records(3) == (first, 0)
    assert records(4, "stack,event")[1] == 4
    assert records(4, "stack", "run.spp=16")[1] == 28
    assert records(4) == (more, 0)


def test_every_parameter_has_its_own_rounding_error():
    two = "parameters=[{key: red.reflectance.value}, {key: green.reflectance.value}]"
    made = Gradcheck(CheckSettings(box(two, "scene.options.size=8"), estimators_of("stack"), 0, 1))
    made.rows = [row for row in made.rows if row.kind is Kind.EQUAL_SEEDS]
    sample = np.append(np.ones(made.participants.case.size), [1e-4, 0.5])
    made.draws = {name: [sample] for row in made.rows for name in made._needs(row)}
    found = {record.parameter: record.relative_l2_limit for record in made.records() if record.seeds}
    assert found == {"red.reflectance.value": 1e-4, "green.reflectance.value": 0.5}


def test_estimators_have_the_options_of_the_configuration():
    config = box("integrator.estimator=reservoir", "integrator.capacity=4")
    assert [case.label for case in all_estimators(config)] == [
        "reslrb:reservoir(capacity=4)", "reslrb:gather", "reslrb:event", "reslrb:stack"
    ]  # fmt: skip
    assert [case.label for case in all_estimators(box("integrator.paths=camera"))] == ["reslrb:stack"]
    assert [case.options for case in estimators_of("event(capacity=2)")] == [{"estimator": "event", "capacity": 2}]
    for text, message in (
        ("stack,stack", "given twice"), ("stack(max_depth=3)", "--set integrator.max_depth=3"),
        ("stack(adjoint=batched)", "all share one adjoint; use --set run.adjoint"),
    ):  # fmt: skip
        with pytest.raises(ConfigError, match=message):
            estimators_of(text)


@pytest.mark.parametrize("case", a_few(CASES, [*IN_EXPECTATION, "plastic", "envmap"]))
def test_references_match_the_conformance_tests(case):
    """The rules permit the reference of each case. Where a case has only differences, the rules refuse `ptracer`, and
    also `prb` except for keys of `floor.brdf`.
    """
    scene = Case(case.scene(), case.keys)
    at = situation(scene, case.options["max_depth"])
    reasons = {"ptracer": ptracer_gradient, "prb": prb_gradient}
    for key in case.keys:
        if isinstance(case.source, Differences):
            assert ptracer_gradient(at, key) is not None
            assert prb_gradient(at, key) is not None or key.startswith("floor.brdf")
        else:
            assert reasons[case.source.name](at, key) is None


def test_references_refuse_unsupported_parameters():
    scene = Case(room(floor={"type": "twosided", "bsdf": diffuse(0, 0, 0)}), ["floor.brdf_0.reflectance.value"])
    [key], at = scene.keys, situation(scene)
    assert "throughput 0" in ptracer_gradient(at, key)
    assert "exactly 0" in prb_gradient(at, key)
    assert ptracer_image(at) is path_image(at) is None
    assert "without roulette" in ptracer_image(situation(scene, -1))
    lit = Case(room(lamp=None, light={"type": "point", "position": [0.5, 0.9, 0.8], "intensity": rgb(1, 2, 3)},
                    ball={"type": "sphere", "radius": 0.2, "bsdf": {"type": "dielectric"}}), [])  # fmt: skip
    assert "point or parallel lights" in path_image(situation(lit))


def test_ptracer_is_no_reference_with_cutting_clip_planes():
    lens = {"type": "thinlens", "aperture_radius": 0.05, "focus_distance": 4.0}

    def why(**changes: object) -> str | None:
        return ptracer_image(situation(Case(room(camera=camera() | changes), [])))

    assert why() is why(**lens) is why(far_clip=4.1) is None  # stock light tracing supports a pinhole's far plane
    assert "`thinlens`" in why(**lens | {"far_clip": 4.1})
    assert "`thinlens`" in why(**lens | {"focus_distance": 2e4})
    assert "before the sensor's near clip" in why(near_clip=4.0)


def test_path_loses_light_reflected_by_masks():
    """The scene has a lamp and a mask of opacity 0.4. The stock `path` renders 0.4 of the correct image. `prb` and ours
    render all of it.
    """
    veil = {"type": "mask", "opacity": 0.4, "bsdf": {"type": "twosided", "bsdf": diffuse(0.7, 0.6, 0.3)}}
    pane = {"type": "rectangle", "to_world": transform(rotate=([1, 0, 0], -45)), "bsdf": veil}
    scene = Case(room(floor_shape=None, wall_shape=None, side_shape=None, pane=pane), [])
    at = situation(scene)
    assert "reflected by masks" in path_image(at)
    assert prb_image(at) is None
    ours, path, prb = (scene.image(integrator(name, 4), 1, 256).sum() for name in ("reslrb", "path", "prb"))
    assert abs(prb / ours - 1) < 0.02
    assert abs(path / ours - 0.4) < 0.02


def test_a_wide_filter_has_no_weights_along_the_border():
    sensor = Case(room(camera=camera("gaussian")), []).scene.sensors()[0]
    inside = interior((16, 16, 3), sensor)
    assert inside[2:-2, 2:-2].all()
    assert inside.sum() == 12 * 12
    assert interior((16, 16, 3), Case(room(), []).scene.sensors()[0]).all()


@pytest.mark.parametrize("dark", [True, False])
def test_images_are_compared_without_the_border(dark):
    case = Case(room(camera=camera("gaussian")), [])
    sensor, integrators = case.scene.sensors()[0], {"walk_ad": integrator("walk_ad", 4)}
    parts = SimpleNamespace(case=case, sensor=sensor, integrators=integrators, masked=dark, spp=16)
    parts._tracer = lambda kind, of: of
    image = Participants.sample(parts, "image", "walk_ad", 1).reshape(16, 16, 3)
    inside = interior(image.shape, sensor)
    assert (image[~inside] == 0).all() == dark
    np.testing.assert_allclose(image[inside], case.image(integrators["walk_ad"], 1, 16)[inside], rtol=1e-3, atol=1e-5)


@pytest.mark.long
def test_a_step_has_the_stated_truncation_error():
    """The image is cubic in the albedo, so that differences have an error of h^2 times the third derivative."""
    key = "side.brdf_0.reflectance.value"
    scene, walk = Case(room(), [key]), integrator("walk_ad", 4)
    [first, second] = directions(scene, key, (0.0, 1.0), 2)
    assert first.sides == "both"
    assert (first.vector > 0).all()
    for direction in (first, second):
        chosen = choose_step(scene, walk, direction, (1, 2, 3), 64)
        for seed in (7, 8):
            exact = scene.gradient(walk, seed, 64) @ chosen.vector
            error = abs(chosen.difference(scene, walk, seed, 64) - exact)
            assert error < 10 * chosen.truncation + 1e-4 * abs(exact)
            assert chosen.truncation < 1e-3 * abs(exact)


def test_a_step_lost_in_rounding_is_not_used():
    """Rounding of the scene is equal for all seeds and grows as the step shrinks, so this error is not truncation."""

    class Rounded:
        def difference(self, _integrator, _vector, seed, _spp, step, _sides):
            return 1 + step**2 + 1e-5 / step + 1e-6 * np.random.default_rng(seed).normal()

    [first] = directions(Case(room(), ["side.brdf_0.reflectance.value"]), "side.brdf_0.reflectance.value", (0, 1), 1)
    chosen = choose_step(Rounded(), None, first, (1, 2, 3), 64)  # type: ignore[arg-type]
    assert chosen.step == 0.01
    error = Rounded().difference(None, None, 4, 64, chosen.step, "both") - 1
    assert 0.8 * error < chosen.truncation < 2 * error


def test_directions_stay_within_the_bounds():
    key = "floor.brdf_0.reflectance.value"
    scene = Case(room(floor={"type": "twosided", "bsdf": diffuse(0, 0.5, 1)}), [key])
    for direction in directions(scene, key, (0.0, 1.0), 2):
        assert direction.sides == "up"
        assert direction.vector[0] > 0 > direction.vector[2]
    assert natural_bounds("bsdf", np.array([0.2, 1.0])) == (0, 1)
    assert natural_bounds("bsdf", np.array([1.5])) == (0, np.inf)
    assert natural_bounds("emitter", np.array([0.2])) == (0, np.inf)
    assert natural_bounds("bsdf", np.array([-1.5])) == (-np.inf, np.inf)


# Camera paths, compared with integrators that see the same light, and with naive AD of the same paths at equal seeds.

WAYS = "stack,stack(paths=both,light_share=0.25)"


@pytest.mark.long
def test_paths_are_compared_with_their_naive_ad_at_equal_seeds():
    records = check("scene.options.size=8", estimators=WAYS, seeds=4)
    assert not [record for record in records if record.holds is False]
    alike = [record for record in records if record.kind is Kind.EQUAL_SEEDS]
    both = {"paths": "both", "light_share": 0.25}
    assert [(r.options, r.holds) for r in alike] == [({}, True), (both, True)]
    assert [(r.options, r.reference) for r in records if r.kind is Kind.IMAGE] == [
        ({}, Reference.PTRACER), (both, Reference.PATH)
    ]  # fmt: skip
    assert [r.options for r in records if r.reference is Reference.PRB] == [both]
    entry = json.loads(alike[1].to_json())
    assert entry["label"] == "reslrb:stack(paths=both,light_share=0.25)"
    assert record_of(GradcheckRecord, entry) == alike[1]
    old = {name: value for name, value in entry.items() if name not in ("label", "options")}
    assert record_of(GradcheckRecord, old | {"integrator": "reslrb", "estimator": "stack"}).label == "reslrb:stack"


@pytest.mark.long
def test_a_wrong_weight_of_camera_paths_is_found(monkeypatch: pytest.MonkeyPatch):
    """Beside camera paths, light paths keep their full weight. Naive AD has the same fault, but `path` does not."""
    monkeypatch.setattr("reslrb_cli.transport.walk.weight_of_connection", lambda *_: mi.Float(1))
    made = Gradcheck(CheckSettings(box("scene.options.size=8", "run.spp=64"), estimators_of("stack(paths=both)"), 0, 8))
    rows = made.run(lambda: False, lambda line: None)
    images = list(takewhile(lambda record: record.parameter is None, rows))
    assert [record.reference for record in images if record.holds is False] == [Reference.PATH]


def test_moving_lamps_have_only_light_paths():
    config = room_moving("lamp_over_floor.xml", "lamp.position")
    with pytest.raises(ConfigError, match="only light paths have derivatives of moving lamps"):
        Gradcheck(CheckSettings(config, estimators_of("stack(paths=both)"), 0, 3))


@pytest.mark.parametrize(("asked", "paths"), [("auto", "camera"), ("both", "both"), ("light", "light")])
def test_differences_of_moving_shapes_have_the_paths_of_a_run(asked: str, paths: str):
    """Light paths lack terms that a run's camera paths have. All other references follow light paths alone."""
    config = load(CONFIGS / "moved_box.yaml", [*SMALL_BOX, f"integrator.paths={asked}"])
    made = Gradcheck(CheckSettings(config, None, 0, 3))
    parts, labels = made.participants, ["reslrb:reservoir", "reslrb:stack"]
    guided = [*labels, "reslrb:stack(guiding=on)"]
    assert [case.label for case in parts.listed] == (guided if paths != "camera" else ["reslrb:stack"])
    found = {(row.reference, row.way.paths) for row in made.rows if row.key is not None}
    assert found == {
        (Reference.FINITE_DIFFERENCE, paths),
        *((reference, "light") for reference in (Reference.WALK_AD, Reference.PTRACER, Reference.FORWARD_MODE)),
    }
    for reference, kind in found:
        tracer = parts.integrators[parts.sampled("reslrb:stack", reference)]
        assert isinstance(tracer, LightTracer)
        assert tracer.paths == kind
    [place] = {
        row.place for row in made.rows if row.reference is Reference.FINITE_DIFFERENCE and row.key == "box.rotation"
    }
    for kind, of, wanted in (("differences", place, paths), ("tangents", "box.rotation", "light")):
        tracer = parts.integrators[parts._tracer(kind, of)]
        assert isinstance(tracer, LightTracer)
        assert tracer.paths == wanted


def test_different_paths_have_different_names():
    ways = [Way(), Way("camera"), Way("both", 0.25), Way("both", 0.5)]
    assert len({way.named("walk_ad") for way in ways}) == len(ways)
    assert ways[0].named("walk_ad") == "walk_ad"


def test_an_estimator_without_camera_paths_names_its_own():
    config = load(CONFIGS / "moved_box.yaml", SMALL_BOX)
    with pytest.raises(ConfigError, match=r"reservoir has none; use reslrb:reservoir\(paths=light\)"):
        Gradcheck(CheckSettings(config, estimators_of("reservoir"), 0, 3))
    named = Gradcheck(CheckSettings(config, estimators_of("reservoir(paths=light)"), 0, 3))
    assert {row.way.paths for row in named.rows} == {"light"}


def smooth_ball(tmp_path: Path) -> Config:
    """Return the experiment that moves a coarse ball with interpolated normals, in front of a wall."""
    mesh(*ball((0, 0, 0), 0.6), diffuse(0.5, 0.5, 0.5), normals=True).write_ply(str(tmp_path / "ball.ply"))
    (tmp_path / "scene.xml").write_text("""\
<scene version="3.0.0">
    <sensor type="perspective">
        <float name="fov" value="40"/>
        <transform name="to_world"><lookat origin="0, -4, 1" target="0, 0, 0" up="0, 0, 1"/></transform>
        <film type="hdrfilm">
            <integer name="width" value="32"/><integer name="height" value="32"/>
            <string name="pixel_format" value="rgb"/><rfilter type="gaussian"/>
        </film>
    </sensor>
    <shape type="ply" id="ball"><string name="filename" value="ball.ply"/><bsdf type="diffuse"/></shape>
    <shape type="rectangle" id="wall">
        <transform name="to_world"><rotate x="1" angle="90"/><scale value="3"/><translate y="2"/></transform>
        <bsdf type="diffuse"/>
    </shape>
    <shape type="rectangle" id="lamp">
        <transform name="to_world"><lookat origin="2, -2, 3" target="0, 0, 0" up="0, 0, 1"/></transform>
        <emitter type="area"><rgb name="radiance" value="20"/></emitter>
    </shape>
</scene>
""")  # fmt: skip
    text = f"""\
scene: {{file: {tmp_path}/scene.xml}}
target: {{render: {{}}}}
parameters: [{{motion: {{of: ball, free: [z]}}}}]
integrator: {{max_depth: 2, guiding: off}}
run: {{spp: 256}}
"""
    return loads(text, str(tmp_path / "config.yaml"), [])


@pytest.mark.long
def test_a_moved_mesh_with_interpolated_normals(tmp_path: Path):
    """The camera paths of a run have the terms of interpolated normals."""
    made = Gradcheck(CheckSettings(smooth_ball(tmp_path), estimators_of("stack"), 0, 16, spp=1024))
    made.rows = [row for row in made.rows if row.reference is Reference.FINITE_DIFFERENCE]
    record = next(made.run(lambda: False, print))
    assert (record.options["paths"], record.verdict) == ("camera", Verdict.HOLDS)


def test_a_known_cause_of_a_deviation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Light paths lack terms of interpolated normals. Only failures against differences name this cause."""
    monkeypatch.setattr(Gradcheck, "_figures", lambda *_: Comparison(Verdict.FAILS))
    for config, paths, known in (
        (smooth_ball(tmp_path), "light", True),
        (smooth_ball(tmp_path), "camera", False),
        (room_moving("lamp_over_floor.xml", "lamp.position"), "light", False),
    ):
        made = Gradcheck(CheckSettings(config, estimators_of(f"stack(paths={paths})"), 0, 3))
        made.draws = {name: [np.zeros(1)] * 3 for row in made.rows for name in made._needs(row)}
        named = {record.reference for record in made.records() if "interpolated normals" in record.message}
        assert named == ({Reference.FINITE_DIFFERENCE} if known else set())


@pytest.mark.parametrize("shape", a_few(["sphere", "disk", "cylinder", "cube", "rectangle"], ["sphere", "cube"]))
def test_stock_camera_paths_are_no_reference_behind_hidden_lamps(shape: str):
    """A hidden lamp stands in front of a shape. Stock `path` and `prb` start behind the lamp, and take the distance of
    an analytic shape from there for its distance from the sensor. The rules refuse them exactly where they are wrong.
    """
    behind = {"type": shape, "to_world": transform(translate=[0.1, 0, 0.1], scale=0.35), "bsdf": {
        "type": "twosided", "bsdf": diffuse(0.5, 0.3, 0.2)}}  # fmt: skip
    sign = lamp(radiance=rgb(1, 1, 1)) | {"to_world": transform(translate=[0.5, 0.2, 1.6], scale=0.5)}
    made = Case(room(thing=behind, sign=sign), [])
    for paths in ("light", "camera", "both"):
        at = situation(made, paths=paths)
        assert path_image(at) is prb_image(at) is None
        at = replace(at, hide_emitters=True)
        reasons = [path_image(at), prb_image(at), prb_gradient(at, "wall.brdf_0.reflectance.value")]
        assert all(reason is None for reason in reasons) == (paths != "light" and shape in ("cube", "rectangle"))
        assert paths != "light" or all(reasons)
    options = {"max_depth": 3, "hide_emitters": True}
    ours = integrator("reslrb", paths="camera", **options)
    images = [
        renders(lambda seed, each=each: made.image(each, seed, 512), range(first, first + 8))
        for first, each in ((0, ours), (100, integrator("path", **options)))
    ]
    assert bool(compare(*images)) == (shape in ("cube", "rectangle"))


def test_references_depend_on_the_paths():
    def lit(paths: str, **more: Any) -> Situation:
        return situation(Case(room(**more), []), paths=paths)

    mirror = {"wall": {"type": "twosided", "bsdf": {"type": "conductor"}}}
    assert prb_image(lit("light", **mirror)) is not None
    assert ptracer_image(lit("light", **mirror)) is None
    for paths in ("camera", "both"):
        assert prb_image(lit(paths, **mirror)) is None
        assert ptracer_image(lit(paths, **mirror)) is not None
    ball = {"ball": {"type": "sphere", "radius": 0.1, "center": [0, 9, 0], "bsdf": {"type": "dielectric"}}}
    bulb = {"bulb": {"type": "point", "position": [0, 8, 0], "intensity": rgb(1, 1, 1)}}
    assert prb_image(lit("both", **ball, **bulb)) is not None
    assert ptracer_image(lit("both", **ball, **bulb)) is None
    assert prb_image(lit("camera", **ball, **bulb)) is None
    assert ptracer_image(lit("camera", **ball, **bulb)) is not None
    assert list(of_image(lit("light"))) == [Reference.PTRACER, Reference.PRB]
    assert list(of_image(lit("both"))) == [Reference.PRB, Reference.PTRACER]


# Gradcheck of parameters that move light: which references count, and which estimators take part.


@pytest.mark.long
def test_a_moving_lamp():
    records = checked(room_moving("lamp_over_floor.xml", "lamp.position"), "stack", 8)
    of = {record.reference: record for record in records if record.parameter is not None}
    assert of[Reference.WALK_AD].kind is Kind.EQUAL_SEEDS
    assert of[Reference.WALK_AD].holds
    assert of[Reference.FINITE_DIFFERENCE].holds
    assert of[Reference.FINITE_DIFFERENCE].relative_l2 < 5e-3
    assert of[Reference.PTRACER].verdict is Verdict.NO_REFERENCE
    assert "a moving emitter" in of[Reference.PTRACER].message
    assert Reference.FORWARD_MODE not in of


def test_participants():
    config = room_moving("lamp_over_floor.xml", "lamp.position")
    some = Gradcheck(CheckSettings(config, None, 0, 3))
    assert [case.label for case in some.participants.listed] == ["reslrb:reservoir", "reslrb:stack"]
    assert {row.label for row in some.rows if row.key is not None} == {"reslrb:reservoir", "reslrb:stack"}
    with pytest.raises(ConfigError, match="gather has no derivatives of moving light; use reservoir, stack"):
        Gradcheck(CheckSettings(config, estimators_of("gather,stack"), 0, 3))
    still = room_moving("lamp_over_floor.xml", "floor.bsdf.reflectance.value")
    all_of_them = Gradcheck(CheckSettings(still, None, 0, 3))
    assert [case.label for case in all_of_them.participants.listed] == [
        *(f"reslrb:{name}" for name in ("reservoir", "gather", "event", "stack")), "reslrb:stack(paths=both)"
    ]  # fmt: skip
    asked = room_moving("lamp_over_floor.xml", "floor.bsdf.reflectance.value", overrides=["integrator.paths=light"])
    assert len(Gradcheck(CheckSettings(asked, None, 0, 3)).participants.listed) == 4


def test_derivatives_of_the_film():
    """The filter's normalisation is differentiated for comparison with differences, and detached for `ptracer`. Naive
    AD is compared with the option `follow`. Edges are differentiated only for comparison with differences.
    """
    parts = Gradcheck(
        CheckSettings(room_moving("wavy_glass.xml", "top.vertex_positions"), estimators_of("stack"), 0, 3)
    ).participants
    assert [(key, one) for key, (one, _) in parts.stock.items()] == [("top.vertex_positions", Reference.PTRACER)]
    assert parts.sampled("reslrb:stack", Reference.WALK_AD) == "reslrb:stack, as walk_ad"
    assert parts.sampled("reslrb:stack", Reference.FINITE_DIFFERENCE) == "reslrb:stack, as finite_difference"
    assert parts.sampled("reslrb:stack", Reference.PTRACER) == "reslrb:stack, as ptracer"
    assert set(parts.integrators) >= {"reslrb:stack", "reslrb:stack, as walk_ad", "reslrb:stack, as ptracer"}
    assert parts.forward_mode


@pytest.mark.parametrize("name", a_few(["caustic_heightmap", "lens_pose"], ["caustic_heightmap"]))
def test_forward_mode_of_functions(name: str):
    """Heights and motions are not scene parameters. Tangents must reach the scene's parameters, from which gradients
    return to heights and motions.
    """
    small = ["scene.options={resx: 16, resy: 16}", "run.spp=4", "target.render.spp=4"]
    parts = Participants(CheckSettings(load(CONFIGS / f"{name}.yaml", small), estimators_of("stack"), 0, 3))
    [label] = (case.label for case in parts.listed)
    gradient, slices = parts.sample("gradient", label, 1)[: parts.case.size], parts.case.places
    for key in parts.case.keys:
        along = [gradient @ direction.vector for direction in parts.directions[key]]
        print(key, along, parts.sample("tangents", key, 1))
        assert gradient[slices[key]].any()
        np.testing.assert_allclose(parts.sample("tangents", key, 1), along, rtol=1e-3, atol=1e-4 * np.abs(along).max())


def test_references_of_moving_scenes():
    scene = corner(camera=camera("gaussian"), ball={"type": "sphere", "radius": 0.3, "bsdf": diffuse(0.5, 0.5, 0.5)},
                   lamp=lamp(radiance=1.0))  # fmt: skip
    case = Case(scene, [])

    def at(*moved: str) -> Situation:
        return situation(case, 4, True, attached=True, moved=moved)

    assert moves_light(case.params, "ball.to_world")
    assert moves_light(case.params, "lamp.translation")
    assert not moves_light(case.params, "ball.bsdf.reflectance.value")
    assert ptracer_gradient(at("ball.to_world"), "ball.to_world") is None
    assert "emitter" in (ptracer_gradient(at("lamp.to_world"), "lamp.to_world") or "")
    assert "emitter" in (ptracer_gradient(at("ball.to_world", "lamp.to_world"), "ball.translation") or "")
    assert "moving light" in (prb_gradient(at("ball.to_world"), "ball.to_world") or "")


def test_smooth_directions():
    """Neighbouring entries move alike, because even a very small step would otherwise fold a mesh."""
    points = np.stack(np.meshgrid(np.linspace(0, 1, 50), [0.0], np.linspace(0, 1, 50)), -1).reshape(-1)
    for row in smooth_rows("top.vertex_positions", points, 5.0, 3):
        field = row.reshape(50, 50, 3)
        assert 0.01 < np.abs(field).max() < 0.5
        assert np.abs(np.diff(field, axis=0)).max() < 0.1 * np.abs(field).max() + 1e-12
    [relief] = smooth_rows("top.heightmap", np.zeros((20, 30)), 5.0, 1)
    assert relief.shape == (600,)
    [turn] = smooth_rows("top.rotation", np.zeros(3), 5.0, 1)
    assert 5 <= np.abs(turn).max() <= 10
    weights = smooth_weights(16, 24)
    assert weights.mean() == pytest.approx(1)
    assert weights[0].max() == weights[:, -1].max() == 0
