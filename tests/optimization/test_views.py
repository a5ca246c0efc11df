"""Views: settings of their section, subsets of views, and held-out views."""

from __future__ import annotations

from pathlib import Path

import colour
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cli.tiny import EYES, KEY, done, outcome, scene_seen, settings, write_experiment
from optimization.toy import make_problem

from reslrb_cli.config.loader import dump, load, loads
from reslrb_cli.errors import ConfigError
from reslrb_cli.measure.gradcheck import Gradcheck
from reslrb_cli.measure.methods import all_estimators, parse_cases, parse_checked
from reslrb_cli.measure.missing import MissingCheck
from reslrb_cli.measure.participants import CheckSettings
from reslrb_cli.optimization import loop
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.optimization.loop import optimize
from reslrb_cli.optimization.sensitivity import sample_gradient, take_gradient
from reslrb_cli.optimization.views import Exposure, View, make_loss
from reslrb_cli.records import run_folder
from reslrb_cli.report.perceptual import ciede2000

CHART = "ColorChecker N Ohta"
ALL = "views=[{sensor: 0}, {sensor: 1}, {sensor: 2}]"


@pytest.fixture
def folder(tmp_path):
    """Folder with the tiny experiment with three sensors."""
    write_experiment(tmp_path, scene_seen(*EYES))
    return tmp_path


def make(folder, *sets):
    return assemble(load(folder / "tiny.yaml", list(sets)))


def gradient(problem, round=0):
    sample_gradient(problem, problem.integrator, round, "test", 4)
    return take_gradient(problem)[KEY]


@pytest.mark.parametrize("alpha", [0, 1])
@pytest.mark.parametrize("channels", [1, 2, 3, 5])
@pytest.mark.parametrize("colours", [1, 3])
def test_an_exposure_scales_all_channels_but_alpha(channels, colours, alpha):
    """For images in Dr.Jit and in NumPy. An exposure for each channel needs three of them."""
    values = {1: mi.Float(2.0), 3: mi.Color3f(2.0, 3.0, 4.0)}[colours]
    if colours == 3 != channels:
        return
    made, exposure = dr.ones(mi.TensorXf, (4, 4, channels)), Exposure(key="e", values={"e": values})
    view = View(0, make_loss("l2"), made=made, exposure=exposure)
    image = np.random.default_rng(0).uniform(size=(4, 4, channels + alpha)).astype(np.float32)
    expected = image * np.array([*([2.0] * channels if colours == 1 else [2.0, 3.0, 4.0]), *[1.0] * alpha], np.float32)
    np.testing.assert_allclose(view.exposed_array(image), expected)
    np.testing.assert_allclose(np.array(view.exposed(mi.TensorXf(image))), expected[:, :, :channels])


def test_a_weight_is_a_share_of_the_loss(folder):
    alone = [gradient(make(folder, f"views=[{{sensor: {index}}}]")) for index in (0, 1)]
    both = gradient(make(folder, "views=[{sensor: 0, weight: 3}, {sensor: 1}]"))
    np.testing.assert_allclose(both, 0.75 * alone[0] + 0.25 * alone[1], rtol=1e-4, atol=1e-7)


def test_a_sensor_is_named_by_index_or_id(folder):
    ids = [sensor.id() for sensor in make(folder).scene.sensors()]
    views = f"views=[{{sensor: 2}}, {{sensor: {ids[0]}}}]"
    assert [view.sensor for view in make(folder, views).views] == [2, 0]
    lit = f"views=[{{sensor: {ids[1]}, lamps: [lamp]}}, {{sensor: {ids[1]}}}]"  # copies of one sensor
    assert [view.sensor for view in make(folder, lit).views] == [0, 1]


def test_settings_of_a_view_replace_common_ones(folder):
    write = np.full((8, 8, 3), 0.5, np.float32)
    mi.Bitmap(write).write(str(folder / "half.exr"))
    views = "views=[{sensor: 1, target: half.exr, exposure: auto}, {sensor: 0, mask: none, exposure: 2}]"
    problem = make(folder, views, "target.exposure=per_channel", "loss.type=l1")
    first, second = problem.views
    assert (first.sensor, first.exposure.key, second.exposure.key, second.exposure.fixed) == (1, "exposure.1", "", 2)
    assert problem.selection.keys == [KEY, "exposure.1"]
    np.testing.assert_array_equal(np.array(first.target), write)
    image = mi.TensorXf(np.full((8, 8, 3), 0.75, np.float32))
    assert float(first.compare(image)[0]) == pytest.approx(0.25)
    again = loads(dump(problem.config), str(folder / "tiny.yaml"))
    assert again == problem.config


def test_a_recovered_exposure_starts_at_the_given_numbers(folder):
    views = "views=[{sensor: 0}, {sensor: 1, exposure: {per_channel: [0.5, 2, 3]}}]"
    problem = make(folder, views, "target.exposure={auto: 0.25}")
    found = {key: np.array(value).ravel() for key, value in problem.values().items()}
    np.testing.assert_allclose(found["exposure"], [0.25])
    np.testing.assert_allclose(found["exposure.1"], [0.5, 2, 3])
    assert loads(dump(problem.config), str(folder / "tiny.yaml")) == problem.config
    fixed = problem.config.with_exposures_fixed()
    assert fixed.target.exposure == fixed.views[1].exposure == 1


@pytest.mark.parametrize(
    ("sets", "is_shared"),
    [
        (["target.exposure=auto", "optimizer.type=adam"], True),
        (["target.exposure={auto: 2}", "optimizer.type=adam"], True),
        (["target.exposure=auto", "optimizer.type=adam", "views=[{sensor: 0}, {sensor: 1}]"], True),
        (["target.exposure=auto", "optimizer.type=adam", "views=[{sensor: 0}, {sensor: 1, exposure: 1}]"], False),
        (["target.exposure=per_channel", "optimizer.type=adam"], False),
        (["target.exposure=auto", "optimizer={type: sgd, learning_rate: 1}"], False),
    ],
)
def test_colours_move_only_with_an_exposure_that_all_views_share(folder, sets, is_shared):
    optimizer = make(folder, *sets).optimizer
    colour, exposure = (np.array(optimizer[key]) for key in (KEY, "exposure"))
    dr.backward(optimizer["exposure"][0] if exposure.size > 1 else optimizer["exposure"])
    dr.accum_grad(optimizer[KEY], dr.ones(type(optimizer[KEY]), dr.shape(optimizer[KEY])) * 1e-20)
    optimizer.step(1.0)
    assert np.all(np.array(optimizer["exposure"]).ravel()[0] < exposure.ravel()[0])
    products = np.array(optimizer[KEY]) * np.array(optimizer["exposure"]).ravel()[0]
    assert np.allclose(products, colour * exposure.ravel()[0], rtol=1e-3) is is_shared


BAD = [
    ("views=[{sensor: 0}, {sensor: 0}]", "views[1].sensor", "is already in views[0]"),
    ("views=[{lamps: [lamp]}, {lamps: [lamp]}]", "views[1].sensor", "views of one sensor need different `lamps`"),
    ("views=[{lamps: [lmp]}]", "views[0].lamps[0]", "no lamp of the scene; did you mean `lamp`?"),
    ("views=[{lamps: []}]", "views[0].lamps", "must name a lamp"),
    ("views=[{sensor: 4}, {sensor: 4, lamps: [lamp]}]", "views[0].sensor", "is 4, but the scene has 3 sensors"),
    ("views=[{sensor: 7}]", "views[0].sensor", "3 sensors"),
    ("views=[{sensor: Perspective_9}]", "views[0].sensor", "no sensor of the scene; did you mean `Perspective_"),
    ("views=[{sensor: xyz}]", "views[0].sensor", "no sensor of the scene; did you mean `Perspective_"),
    ("views=[{sensor: 0}, {sensor: Perspective_1}]", "views[1].sensor", "is also the sensor of views[0]"),
    ("views=[{sensor: 0, target: missing.exr}, {sensor: 1}]", "views[0].target", "no such file"),
    ("views=[{sensor: 0, target: a.exr}]", "target.render", "every view has its own target"),
    ("run.held_out=[2]", "run.held_out[0]", "not the sensor of a view"),
    ("run.held_out=[0]", "run.held_out", "no view for training"),
    ("run.views_per_iteration=2", "run.views_per_iteration", "training views: 1"),
    ("target.exposure=[auto, 1]", "target.exposure", "is a list; give each view its own in `views`"),
    ("views=[{sensor: 0, mask: {kinds: [alpha]}}]", "views[0].mask", "must be `none` or the path of an image"),
    ("views=[{sensor: 0, mask: auto}]", "views[0].mask", "must be `none` or the path of an image"),
    *(
        (
            f"target.exposure={wrong}",
            "target.exposure",
            "must be a positive number, `auto`, `per_channel`, {auto: NUMBER}",
        )
        for wrong in (
            "-1",
            "{auto: 0}",
            "{auto: [1, 1, 1]}",
            "{per_channel: 2}",
            "{per_channel: [1, .inf, 1]}",
            "{}",
            "{auto: 1, per_channel: [1, 1, 1]}",
            "{curve: 1}",
        )
    ),
    ("target.mask=3", "target.mask", "must be `auto`, `none`"),
    ("target.white_balance={scene: D64}", "target.white_balance.scene", "did you mean `D65` or"),
    ("target.white_balance={photograph: A}", "target.white_balance", "has no effect on a rendered target"),
]


LED = """<emitter type="point" id="led{0}"><point name="position" x="{0}" y="1" z="2"/></emitter>"""
ONE_BY_ONE = "views=[{lamps: [led0]}, {lamps: ['l*d1']}, {sensor: 0}]"


@pytest.fixture
def lamps(folder):
    """Folder with an experiment in which two point lamps light the scene beside the area lamp."""
    text = scene_seen(EYES[0]).replace("</scene>", LED.format(0) + LED.format(1) + "</scene>")
    (folder / "scene.xml").write_text(text)
    return folder


def test_views_of_one_sensor_have_their_own_lamps(lamps):
    precise = "target.render.spp=4096"
    problem = make(lamps, ONE_BY_ONE, precise)
    assert [view.sensor for view in problem.views] == problem.sensors == [0, 1, 2]
    assert [sensor.id() for sensor in problem.scene.sensors()][1:] == ["Perspective_1_view1", "Perspective_1_view2"]
    first, second, whole = (np.array(view.target) for view in problem.views)
    lamp = np.array(make(lamps, "views=[{lamps: [lamp]}]", precise).views[0].target)
    assert np.abs(first - second).max() > 0.1 * first.mean()
    np.testing.assert_allclose((first + second + lamp).mean(), whole.mean(), rtol=0.02)
    alone = [gradient(make(lamps, f"views=[{{lamps: [led{number}]}}]", "run.shards=1")) for number in (0, 1)]
    assert all(np.isfinite(each).all() and each.any() for each in alone)


@pytest.mark.parametrize(("setting", "place", "words"), [
    ("integrator.type=prb", "views[0].lamps", "prb cannot do; use integrator.type: reslrb"),
    ("integrator.guiding=on", "integrator.guiding", "cannot share its tables"),
])  # fmt: skip
def test_settings_without_lamps_of_a_view(lamps, setting, place, words):
    more = ["integrator={type: prb, max_depth: 3}"] if "prb" in setting else [setting]
    with pytest.raises(ConfigError) as error:
        make(lamps, ONE_BY_ONE, *more)
    assert place in str(error.value)
    assert words in str(error.value)


@pytest.mark.parametrize("method", ["prb", "reslrb:stack"])
def test_measurements_have_the_first_view_with_all_lamps(lamps, method):
    """Stock integrators cannot switch lamps off."""
    problem = make(lamps, ONE_BY_ONE, "run.held_out=[1]", "run.shards=1")
    [case] = parse_cases(method)
    measured = assemble(loads(dump(case.at(problem.config, 3, known=True)), str(lamps / "tiny.yaml")))
    plain = assemble(loads(dump(case.at(make(lamps, "run.shards=1").config, 3, known=True)), str(lamps / "tiny.yaml")))
    assert len(measured.views) == 1
    np.testing.assert_array_equal(np.array(measured.views[0].target), np.array(plain.views[0].target))
    whole = case.at(problem.config, 3, known=False, auto=True)
    assert whole.views == problem.config.views


def test_gradcheck_has_the_lamps_of_the_first_view(lamps):
    """The images are those of the view, and naive AD traces the same paths."""
    problem = make(lamps, ONE_BY_ONE, "run.shards=1", "target.render.spp=256", "integrator.guiding=auto")
    size = np.array(problem.views[0].target).mean()
    check = Gradcheck(CheckSettings(problem.config, parse_checked("reslrb:stack"), 0, 3, spp=64))
    parts = check.participants
    # Views with different lamps share no tables.
    assert "reslrb:stack(guiding=on)" not in [case.label for case in all_estimators(problem.config)]
    assert check.conditions().endswith(", the first view with the lamps led0")
    assert [(one, why.count("it cannot switch lamps off")) for one, why in parts.images.values()] == [(None, 3)]
    for name in ("walk_ad", "differenced", "reslrb:stack"):
        assert parts.sample("image", name, 1).mean() == pytest.approx(size, rel=0.1)
    ours, naive = (parts.sample("gradient", name, 1) for name in ("reslrb:stack", "walk_ad"))
    np.testing.assert_allclose(ours, naive, rtol=1e-4, atol=1e-5 * np.abs(naive).max())
    missing = MissingCheck.of_config(problem.config, 64).tracing
    for tracer in (missing.images, missing.gradients):
        assert missing.cases[0].image(tracer, 1, 64).mean() == pytest.approx(size, rel=0.1)


def test_own_integrators_are_checked_with_all_lamps(lamps):
    config = make(lamps, ONE_BY_ONE, "run.shards=1").config.with_code(True)
    own = Path(__file__).parents[1] / "measure" / "own_replay.py"
    for names, lit in ((f"reslrb:stack,{own}:Replay", None), ("reslrb:stack", ["led0"])):
        configs = CheckSettings(config, parse_checked(names), 0).configs
        assert [each.views[0].lamps for each in configs.values()] == [lit] * len(configs)


SPOT = """<emitter type="spot" id="spot{0}"><float name="cutoff_angle" value="8"/>
    <transform name="to_world"><lookat origin="{0}, {0}, 3" target="{0}, {0}, 0" up="0, 1, 0"/></transform></emitter>"""


def test_texels_that_only_unlit_lamps_reach_do_not_count(folder):
    """Each spot lights one corner of the wall."""
    text = scene_seen(EYES[0]).replace("</scene>", SPOT.format(-0.5) + SPOT.format(0.5) + "</scene>")
    (folder / "scene.xml").write_text(text)
    mask = assemble(load(folder / "tiny.yaml", ["views=[{lamps: [spot0.5]}]"]), to_run=True).masks[KEY]
    assert mask.any()
    assert not (mask[:, :2].any() and mask[:, 2:].any())


def test_render_shows_a_view_with_its_lamps(lamps, monkeypatch):
    monkeypatch.chdir(lamps)
    images = []
    for number in range(2):
        done("render", "tiny.yaml", *settings(ONE_BY_ONE), "--sensor", number, "-o", f"{number}.exr")
        images.append(np.array(mi.Bitmap(f"{number}.exr")))
    assert np.abs(images[0] - images[1]).max() > 0.1 * images[0].mean()
    code, _, shown = outcome("render", "tiny.yaml", *settings(ONE_BY_ONE), "--sensor", 3, "-o", "3.exr")
    assert (code, "--sensor: is 3, but the experiment has 3 views" in shown) == (2, True)
    config = load("tiny.yaml", [ONE_BY_ONE])  # as if it were that of a run
    monkeypatch.setattr(run_folder, "recovered", lambda run, overrides: config)
    monkeypatch.setattr(run_folder, "exposures", lambda run: {0: np.float32(2), 1: np.float32(3)})
    assert "times 3, the run's exposure" in done("render", ".", "--sensor", 1, "-o", "b.exr").stdout
    np.testing.assert_allclose(np.array(mi.Bitmap("b.exr")), 3 * images[1], rtol=1e-5)


@pytest.mark.parametrize(("setting", "key", "words"), BAD)
def test_errors_are_located(folder, setting, key, words):
    with pytest.raises(ConfigError) as error:
        make(folder, setting)
    assert words in str(error.value)
    assert key in str(error.value)


def test_a_white_balance_adapts_the_colours_of_a_photograph(folder):
    """The photograph shows a colour chart under the illuminant A. Adapted, it has almost the colours under D65."""
    observer, nm = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"], np.arange(380.0, 781.0, 5.0)
    matching = np.stack([np.interp(nm, observer.wavelengths, observer.values[:, i]) for i in range(3)], -1)
    chart = [np.interp(nm, each.wavelengths, each.values) for each in colour.SDS_COLOURCHECKERS[CHART].values()]
    space, xyz, whites = colour.RGB_COLOURSPACES["sRGB"], {}, {}
    for name in ("A", "D65"):
        light = np.interp(nm, colour.SDS_ILLUMINANTS[name].wavelengths, colour.SDS_ILLUMINANTS[name].values)
        light /= matching[:, 1] @ light
        xyz[name], whites[name] = np.array(chart) * light @ matching, light @ matching
    linear = np.ones((64, 3), np.float32)
    linear[:24] = xyz["A"] @ np.linalg.inv(space.matrix_RGB_to_XYZ).T
    mi.Bitmap(np.maximum(linear, 0).reshape(8, 8, 3)).write(str(folder / "chart.exr"))

    def seen(balance):
        problem = make(folder, "target={file: chart.exr, mask: none}", f"target.white_balance={balance}")
        return np.array(problem.views[0].target).reshape(64, 3)[:24]

    wanted = colour.adaptation.chromatic_adaptation_VonKries(xyz["A"], whites["A"], whites["D65"], transform="Bradford")
    inside = (wanted @ np.linalg.inv(space.matrix_RGB_to_XYZ).T > 0.01).all(1) & (linear[:24] > 0).all(1)
    np.testing.assert_allclose(seen("{photograph: a}")[inside] @ space.matrix_RGB_to_XYZ.T, wanted[inside], atol=1e-3)
    np.testing.assert_allclose(seen("{scene: A, photograph: A}"), np.maximum(linear[:24], 0), atol=1e-5)
    factors = np.linalg.inv(space.matrix_RGB_to_XYZ) @ np.stack([whites["D65"], whites["A"]], -1)
    under_d65 = xyz["D65"] @ np.linalg.inv(space.matrix_RGB_to_XYZ).T
    differences = [
        ciede2000(found[inside], under_d65[inside]).mean()
        for found in (seen("{photograph: A}"), linear[:24] * factors[:, 0] / factors[:, 1])
    ]
    assert differences == pytest.approx([1.9, 3.1], abs=0.1)  # as `adaptation` says


def test_separate_views_need_no_target_section(folder):
    text = (folder / "tiny.yaml").read_text().replace("target: {render: {spp: 16}}\n", "")
    mi.Bitmap(np.full((8, 8, 3), 0.5, np.float32)).write(str(folder / "half.exr"))
    config = loads(text + "views: [{sensor: 0, target: half.exr}]\n", str(folder / "tiny.yaml"))
    assert not assemble(config).truth
    with pytest.raises(ConfigError, match="target: missing"):
        loads(text, str(folder / "tiny.yaml"))


def test_a_subset_of_the_views_is_unbiased(tmp_path):
    """Every view is drawn equally often, and on average counts as much as if all views were taken. Another seed draws
    other views.
    """
    problem = make_problem(tmp_path, views=5, sets=["run.views_per_iteration=2"])
    counts, total = np.zeros(5), 4000
    for iteration in range(total):
        drawn = problem.drawn(iteration)
        assert len({view.sensor for view, _ in drawn}) == 2
        for view, scale in drawn:
            counts[view.sensor] += scale / 2.5
            assert scale == 2.5
    z = (counts - 0.4 * total) / np.sqrt(total * 0.4 * 0.6)
    assert np.abs(z).max() < 4
    assert [v.sensor for v, _ in problem.drawn(3)] == [v.sensor for v, _ in problem.drawn(3)]
    other = make_problem(tmp_path, views=5, sets=["run.views_per_iteration=2", "run.seed=9"])
    assert [problem.drawn(i)[0][0].sensor for i in range(20)] != [other.drawn(i)[0][0].sensor for i in range(20)]


def test_an_iteration_uses_the_drawn_views(tmp_path, steps):
    problem = make_problem(tmp_path, views=3, sets=["run.views_per_iteration=1", "run.iterations=6"])
    losses = [record.loss for record in optimize(problem)]
    assert [call.sensor for call in steps.calls] == [problem.drawn(iteration)[0][0].sensor for iteration in range(6)]
    assert losses[0] == pytest.approx(0.3**2)  # not divided by three


def test_held_out_views_are_recorded_and_not_trained_on(folder):
    problem = make(folder, ALL, "run.held_out=[1]", "run.iterations=12")
    assert [view.share for view in problem.trained] == [0.5, 0.5]
    before = gradient(problem)
    problem.views[1].see(np.zeros((8, 8, 3), np.float32))
    np.testing.assert_allclose(gradient(problem), before, rtol=1e-5, atol=1e-6 * np.abs(before).max())
    sets = [ALL, "run.held_out=[1]", "run.iterations=22", "run.spp=64", "optimizer.learning_rate=0.05"]
    problem = assemble(
        load(folder / "tiny.yaml", [*sets, "target.render.spp=1024", "parameters[0].initial=0.1"]), to_run=True
    )
    records = list(optimize(problem))
    seen = [record.iteration for record in records if record.held_out is not None]
    assert seen == list(range(0, 22, loop.HELD_OUT_EVERY))
    assert records[20].held_out < 0.5 * records[0].held_out
    assert make(folder).held_out_loss() is None
