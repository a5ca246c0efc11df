"""Gradcheck on a small Cornell box: it holds as the code stands, and what is broken on purpose is found and named."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from conformance.gradient_cases import CASES
from turns import a_few

from reslrb_cli.config.loader import loads
from reslrb_cli.errors import ConfigError
from reslrb_cli.integrators import forward
from reslrb_cli.measure.gradcheck import Gradcheck, Result
from reslrb_cli.measure.gradients import Case, choose_step, directions, integrator, natural_bounds
from reslrb_cli.measure.methods import all_estimators, parse_estimators
from reslrb_cli.measure.participants import Participants, Settings
from reslrb_cli.measure.references import (
    Situation,
    path_image,
    prb_gradient,
    prb_image,
    ptracer_gradient,
    ptracer_image,
)
from reslrb_cli.measure.scenes import small
from reslrb_cli.measure.scenes.small import camera, diffuse, rgb, room, transform
from reslrb_cli.records.measurements import Kind, Reference, Verdict
from reslrb_cli.report.tables import summary_lines
from reslrb_cli.scene.visibility import interior

pytestmark = pytest.mark.usefixtures("llvm")
SMALL = ["scene.options.size=32", "scene.options.texture=4", "run.spp=8", "integrator.max_depth=4"]


def check(*overrides: str, estimators: str = "reservoir,event,gather,stack", seeds: int = 8) -> list[Result]:
    config = loads(small.CORNELL_BOX, small.CORNELL_BOX_SOURCE, [*SMALL, *overrides])
    made = Gradcheck(Settings(config, parse_estimators(estimators), 0, seeds))
    return list(made.run(lambda: False, lambda line: None))


def failures(results: list[Result]) -> set[tuple[str | None, str]]:
    found = [result.record for result in results if result.record.verdict is not Verdict.HOLDS]
    return {(record.estimator, record.reference.value) for record in found}


def test_it_holds():
    results = check("integrator.rr_depth=2")
    assert failures(results) == set()
    records = [result.record for result in results]
    assert [record.kind for record in records].count(Kind.IMAGE) == 1
    for name in ("reservoir", "event", "gather", "stack"):
        of = {record.reference: record for record in records if record.estimator == name}
        assert list(of) == [Reference.FINITE_DIFFERENCE, Reference.FORWARD_MODE, Reference.WALK_AD, Reference.PTRACER]
        exact = name in ("gather", "stack")
        assert (of[Reference.WALK_AD].kind is Kind.EQUAL_SEEDS) is exact
        assert of[Reference.WALK_AD].relative_l2 < (1e-5 if exact else 0.5)
        assert of[Reference.FINITE_DIFFERENCE].relative_l2 < (1e-3 if exact else 0.5)
        assert all(record.seeds == 8 and record.detectable < 0.5 for record in of.values())
        assert all(record.cosine > 0.9 for record in of.values())
        assert 0.8 < of[Reference.PTRACER].variance_ratio < 3
    maps = [result.maps for result in results if result.maps is not None]
    assert len(maps) == 8
    assert maps[0].gradient.shape == maps[0].reference.shape == (4, 4, 3)
    assert maps[0].z.shape == (4, 4)


@pytest.mark.parametrize("drawn", a_few(["guiding=on", "sequence=low_discrepancy"], ["guiding=on"]))
def test_paths_that_are_drawn_otherwise_agree_with_naive_ad_in_expectation(drawn: str):
    records = [result.record for result in check(f"integrator.{drawn}", estimators="stack", seeds=16)]
    assert [(record.reference.value, record.verdict) for record in records if record.verdict is not Verdict.HOLDS] == []
    kinds = {record.kind for record in records if record.reference is Reference.WALK_AD}
    assert kinds == {Kind.EXPECTATION}


def test_a_selection_weight_that_is_wrong(monkeypatch: pytest.MonkeyPatch):
    """The reservoir alone is wrong, by a fifth: all references of it say so, and none of the others'."""
    from reslrb_cli.estimators import reservoir

    right = reservoir.slot_adjoint
    monkeypatch.setattr(reservoir, "slot_adjoint", lambda p, W, *rest: right(p, W * 1.2, *rest))
    found = failures(check(estimators="reservoir,stack", seeds=16))
    assert found == {("reservoir", name) for name in ("walk_ad", "ptracer", "finite_difference", "forward_mode")}


def test_a_derivative_that_is_wrong_by_little(monkeypatch: pytest.MonkeyPatch):
    from reslrb_cli.estimators import stack

    right = stack.adjoint_of_connection
    monkeypatch.setattr(stack, "adjoint_of_connection", lambda *arguments: right(*arguments) * 1.001)
    found = failures(check(estimators="stack,gather"))
    assert found == {("stack", name) for name in ("walk_ad", "finite_difference", "forward_mode")}


def test_forward_mode_without_the_weight_of_roulette(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(forward.TangentSplat, "survived", lambda self, state, weight: state)
    assert failures(check("integrator.rr_depth=1", estimators="stack")) == {("stack", "forward_mode")}


def test_a_fault_of_the_walk_is_none_of_its_own_references(monkeypatch: pytest.MonkeyPatch):
    """Connections that are a third too strong: image and stock reference differ, naive AD and differences do not."""
    from reslrb_cli.transport import walk as segment

    right = segment.connect

    def connect(*arguments):
        connection = right(*arguments)
        connection.weight = connection.weight * 1.3
        return connection

    monkeypatch.setattr(segment, "connect", connect)
    assert failures(check(estimators="stack")) == {(None, "ptracer"), ("stack", "ptracer")}


def test_rows_come_as_they_are_measured():
    """The first is there before the last estimator has taken a step, and what one row measured the next one uses."""
    config = loads(small.CORNELL_BOX, small.CORNELL_BOX_SOURCE, SMALL)
    made = Gradcheck(Settings(config, parse_estimators("event,stack"), 0, 3))
    said: list[str] = []
    rows = made.run(lambda: False, said.append)
    next(rows)
    assert [line.partition(":")[0] for line in said] == ["image walk_ad", "image ptracer"]
    next(rows)
    assert not any("reslrb:stack" in line for line in said)
    list(rows)
    assert len(said) == len(set(said)) == 8
    expected, found = made.expected(), [result.record for result in made.run(lambda: False, said.append)]
    assert [(r.parameter, r.estimator, r.reference) for r in expected] == [
        (r.parameter, r.estimator, r.reference) for r in found
    ]


def test_what_the_budget_does_not_suffice_for_is_named():
    config = loads(small.CORNELL_BOX, small.CORNELL_BOX_SOURCE, SMALL)
    ticks = iter(range(10_000))
    made = Gradcheck(Settings(config, parse_estimators("stack,event"), 40), now=lambda: next(ticks))
    records = [result.record for result in made.run(lambda: False, lambda line: None)]
    assert next(ticks) < 50
    assert [record.verdict for record in records[:2]] == [Verdict.HOLDS] * 2
    left = [record for record in records if record.verdict is Verdict.NOT_MEASURED]
    assert left
    assert {(record.seeds, record.holds) for record in left} == {(0, None)}
    assert (
        summary_lines(records)[1] == f"open: {len(left)} not measured: the budget was spent; allow more with --budget"
    )


def test_what_is_interrupted_is_compared_with_what_is_done():
    config = loads(small.CORNELL_BOX, small.CORNELL_BOX_SOURCE, SMALL)
    asked = iter(range(10_000))
    made = Gradcheck(Settings(config, parse_estimators("stack"), 0, 8))
    records = [result.record for result in made.run(lambda: next(asked) > 32, lambda line: None)]
    assert [(record.reference, record.seeds) for record in records] == [
        (Reference.PTRACER, 8), (Reference.FINITE_DIFFERENCE, 5)
    ]  # fmt: skip
    assert list(made.run(lambda: True, lambda line: None)) != []
    fresh = Gradcheck(Settings(config, parse_estimators("stack"), 0, 8))
    assert list(fresh.run(lambda: True, lambda line: None)) == []


def test_estimators_have_the_options_of_the_configuration():
    config = loads(
        small.CORNELL_BOX, small.CORNELL_BOX_SOURCE, ["integrator.estimator=reservoir", "integrator.capacity=4"]
    )
    assert [case.label for case in all_estimators(config)] == [
        "reslrb:reservoir(capacity=4)", "reslrb:gather", "reslrb:event", "reslrb:stack"
    ]  # fmt: skip
    assert [case.options for case in parse_estimators("event(capacity=2)")] == [{"estimator": "event", "capacity": 2}]
    for text, message in (
        ("", "is no estimator"),
        ("stack,stack", "named twice"),
        ("stack(max_depth=3)", "--set integrator.max_depth=3"),
        ("stack(adjoint=independent)", "--set run.adjoint=independent"),
    ):
        with pytest.raises(ConfigError, match=message):
            parse_estimators(text)


# ---- What counts as a reference ----


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_references_are_those_of_the_conformance_tests(case):
    """The rules allow what each case was judged by, and refuse both stock integrators where differences alone were."""
    scene = Case(case.scene(), case.keys)
    at = Situation.of(scene.scene, scene.scene.sensors()[0], scene.params, case.both.get("max_depth", 4), False)
    reasons = {"ptracer": ptracer_gradient, "prb": prb_gradient}
    for key in case.keys:
        if case.reference == "fd":
            assert ptracer_gradient(at, key) is not None
            assert prb_gradient(at, key) is not None or key.startswith("floor.brdf")
        else:
            assert reasons[case.reference](at, key) is None


def test_references_refuse_what_they_cannot_do():
    scene = Case(room(floor={"type": "twosided", "bsdf": diffuse(0, 0, 0)}), ["floor.brdf_0.reflectance.value"])
    [key], sensor = scene.keys, scene.scene.sensors()[0]

    def at(depth: int = 4, hidden: bool = False) -> Situation:
        return Situation.of(scene.scene, sensor, scene.params, depth, hidden)

    assert "throughput is 0" in ptracer_gradient(at(), key)
    assert "exactly 0" in prb_gradient(at(), key)
    assert ptracer_image(at()) is path_image(at()) is None
    assert "without roulette" in ptracer_image(at(-1))
    lit = Case(room(lamp=None, light={"type": "point", "position": [0.5, 0.9, 0.8], "intensity": rgb(1, 2, 3)},
                    ball={"type": "sphere", "radius": 0.2, "bsdf": {"type": "dielectric"}}), [])  # fmt: skip
    assert "point or parallel lights" in path_image(
        Situation.of(lit.scene, lit.scene.sensors()[0], lit.params, 4, False)
    )


def test_ptracer_is_no_reference_where_clip_planes_cut():
    lens = {"type": "thinlens", "aperture_radius": 0.05, "focus_distance": 4.0}

    def why(**changes: object) -> str | None:
        scene = Case(room(camera=camera() | changes), [])
        return ptracer_image(Situation.of(scene.scene, scene.scene.sensors()[0], scene.params, 4, False))

    assert why() is why(**lens) is why(far_clip=4.1) is None  # stock light tracing has a pinhole's far plane
    assert "`thinlens`" in why(**lens | {"far_clip": 4.1})
    assert "`thinlens`" in why(**lens | {"focus_distance": 2e4})
    assert "before the sensor's near clip" in why(near_clip=4.0)


def test_path_loses_what_masks_reflect_before_nothing():
    """A veil of opacity 0.4 and a lamp: the stock `path` shows 0.4 of what it is to show, `prb` and ours all of it."""
    veil = {"type": "mask", "opacity": 0.4, "bsdf": {"type": "twosided", "bsdf": diffuse(0.7, 0.6, 0.3)}}
    pane = {"type": "rectangle", "to_world": transform(rotate=([1, 0, 0], -45)), "bsdf": veil}
    scene = Case(room(floor_shape=None, wall_shape=None, side_shape=None, pane=pane), [])
    at = Situation.of(scene.scene, scene.scene.sensors()[0], scene.params, 4, False)
    assert "masks reflect" in path_image(at)
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


@pytest.mark.parametrize(
    ("reference", "dark"), [(Reference.PATH, True), (Reference.PRB, True), (Reference.PTRACER, False)]
)
def test_images_are_compared_without_the_border_that_paths_from_the_lights_leave_dark(reference, dark):
    case = Case(room(camera=camera("gaussian")), [])
    sensor, integrators = case.scene.sensors()[0], {"walk_ad": integrator("walk_ad", 4)}
    parts = SimpleNamespace(case=case, sensor=sensor, integrators=integrators, image=reference, spp=16)
    image = Participants.picture(parts, "walk_ad", 1).reshape(16, 16, 3)
    inside = interior(image.shape, sensor)
    assert (image[~inside] == 0).all() == dark
    np.testing.assert_allclose(image[inside], case.image(integrators["walk_ad"], 1, 16)[inside], rtol=1e-3, atol=1e-5)


# ---- Finite differences ----


def test_a_step_has_the_truncation_error_that_it_says():
    """The image is a cubic in the albedo, whose differences are wrong by h^2 times the third derivative."""
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


def test_a_step_that_is_lost_in_rounding_is_not_taken():
    """Rounding of the scene, the same for all seeds, is no truncation: it grows as the step shrinks."""

    class Rounded:
        def difference(self, _integrator, _vector, seed, _spp, step, _sides):
            return 1 + step**2 + 1e-5 / step + 1e-6 * np.random.default_rng(seed).normal()

    [first] = directions(Case(room(), ["side.brdf_0.reflectance.value"]), "side.brdf_0.reflectance.value", (0, 1), 1)
    chosen = choose_step(Rounded(), None, first, (1, 2, 3), 64)  # type: ignore[arg-type]
    assert chosen.step == 0.01


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
