"""Results of small functions at their bounds, as a table of calls (`said.check`)."""

# ruff: noqa: F401  # the table uses the modules
from __future__ import annotations

import contextlib
import io
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from golden import said
from golden.cases import shown
from kit import work_in
from records.test_metrics import make_record

from reslrb_cli import errors
from reslrb_cli.cli import example, gradcheck, init, inspect, jobs, optimize, options, render, report, serve, terminal
from reslrb_cli.cluster import connection
from reslrb_cli.config.loader import parse_override
from reslrb_cli.records import (
    decisions,
    images,
    lock,
    measurement_files,
    measurements,
    metrics,
    run_folder,
    sweeps,
    tree,
)
from reslrb_cli.records import manifest as manifests
from reslrb_cli.report import run_summary
from reslrb_cli.runs import export as exports
from reslrb_cli.runs import log, loggers, prepare, search, workshop
from reslrb_cli.runs import sweep as planned
from reslrb_cli.scene import (
    cameras,
    catalog,
    deformation,
    dispersion,
    edges,
    graph,
    needs,
    proposal,
    rays,
    upsampling,
    values,
    visibility,
)
from reslrb_cli.scene import export as exporting
from reslrb_cli.scene import images as pictures
from reslrb_cli.scene import response as responses

#: Expressions. Names are those of modules here.
CALLS = """
decisions.Decision(setting="a", value="b", why="c").line(True)
decisions.Decision(setting="a", value="b", why="c", seconds=1.25).line(True)
decisions.Decision(setting="a", value="b", why="c", seconds=1.25, cached=True).line(True)
decisions.Decision(setting="a", value="b", why="c", seconds=1.25).line()
[images.file_stem(key) for key in ("a.b-c_d", "a b", "a/b", "ä", "x" * 180, "x" * 181, "x y" * 90)]
[images._place(name) for name in ("R", "A", "B", "0", "10", "Z", "ch1")]
images.in_range(np.array([1.0, 2, 3]), 1, 3), images.in_range(np.array([2.0]), 2, 2)
images.finite_range([np.array([1.0, np.nan]), np.array([-2.0, np.inf])]), images.finite_range([])
images.luminance(np.arange(12.0).reshape(1, 3, 4)), images.luminance(np.arange(6.0).reshape(1, 3, 2))
images.as_bytes(np.array([[[0.0, 0.5, 1.5, 9], [np.nan, -1, np.inf, 9]]])), images.as_bytes(np.full((1, 1, 2), 0.2))
[lock.Holder.from_json(data) for data in (None, {}, {"host": "a", "pid": "x", "boot": None, "locked": False})]
str(lock.Holder("a", 3, None, False))
measurement_files._finite("1e999"), measurement_files._finite("2.5"), measurement_files._command()[0]
measurements.Spread.of([3, 1, 2]), measurements.Band.of([3.0, 1.0]), measurements.Band.of([])
[measurements._percent(share) for share in (0.0, 0.0994, 0.0995, 0.1, 0.5, 1.234)]
[round(measurements.student(n, d), 3) for n, d in ((2, 1), (4, 1), (4, 3), (64, 3))]
[[share, error, *judged(share, error)] for share in (None, 0.0, 0.049, 0.051, 0.3, 0.52, 0.9) for error in (0.001, 0.029, 0.031, 0.2)]
[missing(share, 0.01, n).line() for share in (None, 0.0, 5e-5, 0.3) for n in (0, 2, 8)]
missing(0.3, None, 8).line(), missing(0.3, None, 8).percent(), missing(0.3, 0.02, 1).margin
[missing(0.3, 0.01).is_reduced_to(missing(other, error)) for other, error in ((0.2, 0.01), (0.28, 0.01), (0.3, 0.1), (None, None))]
[[share, error, *judged(share, error)] for share, error in ((0.0, 0.0), (0.0, 0.03), (0.05, 0.0), (0.5, 0.0), (1e-4, 0.0))]
[missing(share, 0.0).line() for share in (0.0, 1e-4, 1.1e-4)], missing(0.25, 0.06).is_reduced_to(missing(0.05, 0.08))
[str(missing(0.3, error, n).margin) for error, n in ((0.01, 0), (0.01, 1), (0.01, 2), (None, 9), (0.0, 2))]
missing(0.3, 0.01).is_reduced_to(None), missing(None, None).is_reduced_to(missing(0.3, 0.01))
[metrics.finite({"a": [1.0, math.inf, (math.nan, 2)], "b": "x"}), metrics.finite(math.inf, str)]
[metrics._iteration_of(line) for line in (b'{"iteration": 3}', b'{"iteration": 3}\\n', b'{"iteration": "3"}\\n', b"[1]\\n", b"{}\\n")]
tally(metrics.NonFiniteTally(), dict(nonfinite=3, nonfinite_by_parameter={"a": 2}), dict(nonfinite=0), dict(nonfinite=2))
tally(metrics.RegularizedTally(), dict(regularized=costs({"a": 1})), dict(regularized=costs({"a": 0})), dict())
tally(metrics.RegularizedTally(), dict()), tally(metrics.NonFiniteTally())
make_record(loss=math.nan, held_out=None).to_json()
[run_folder.workshop_file(name) for name in ("Light of 0.5 degrees", "index +0.005", "a/b")]
[run_folder._sets_initial(parse_override(text)) for text in ("run.spp=4", "parameters=[{key: a}]", "parameters=[{initial: 3}]", "parameters[0]={initial: 3}", "parameters[0].initial=3", "parameters[0].initial.run=a", "parameters[0].key=a")]
run_folder.exposed(np.ones((1, 1, 4)), np.array([2.0, 3, 4]), 3), run_folder.exposed(np.ones((1, 1, 2)), 2.0, 1)
[sweeps.in_words(value) for value in (0.1, 1e-5, 0.1234567, 3, True, None, "a b", "a: b", "reslrb:stack(paths=both)", {"a": [1, 2.5]}, [])]
[sweeps.in_words(value) for value in ("größe/片.exr", "word " * 40, "it's", "a\\nb", "", " ", "yes", "3", "null", "[a]", "#", float("inf"), float("nan"), -0.0, {"größe": "é"}, ["é", {}], ("a", 1), 10**20, 1e20)]
sweeps.short_keys(["a.b.c", "a.x.c", "d"]), sweeps.short_keys(["spp"]), sweeps.short_keys(["run.spp", "target.render.spp"])
sweeps.short_keys(["run.spp", "run.xspp"])
sweeps.label({"run.spp": 4, "optimizer.type": "sgd"}), sweeps.label({})
[sweeps.run_name(sweeps.Combination(name, {}), 3) for name in ("a", "")]
[str(sweeps.config_file(Path("s"), sweeps.Combination(name, {}))) for name in ("a", "")]
[[plan.size, plan.keys, [(c.name, s) for c, s in plan.runs]] for plan in plans()]
[planned._named(value) for value in (0.5, "a", {"type": "b", "c": [1, 2]}, {"x": True}, None)]
planned.named({"a.b": 3}, []), planned.named({"a.b": 3}, [sweeps.Combination("B=3", {}), sweeps.Combination("b=3-2", {})])
[search._from_optuna(planned.parse_vary(text, True), value) for text, value in (("a={low: 0.1, high: 0.2}", 0.123456), ("a={low: 0.1, high: 0.2}", 0.2000001), ("a={low: 1, high: 3}", 2), ("a=[[1], x]", "[1]"))]
[prepare._shown(value) for value in (None, 3, "x" * 60, "x" * 61)]
loggers._plain("a b/c.d-e_f(g)[0]")
log.log_line("a\\nb", "ERROR")[26:]
[workshop.allowed_error(fall, 2.0) for fall in (-1.0, 0.0, 0.02, 0.05, 0.2)]
workshop.allowed_errors({}, "lens", {}), workshop.allowed_errors(errors_of(0.9, 0.8), "lens", dict(turn=1.0, index=0.005, distance=4.0))
workshop.allowed_errors(errors_of(0.9, 0.89), "mirror", dict(turn=0.2, index=0.001)), workshop.allowed_errors(errors_of(0.9, 0.95), "lens", dict(turn=1.0, index=0.005))
[workshop.picture_within(np.pad(np.ones((2, 3)), ((1, 2), (3, 1)))), workshop._unit(np.array([0.0, -2, 2]))]
workshop.figures(CHECKS, CHECKS.T + 0.1), workshop.as_picture(CHECKS, CHECKS + 1, (slice(1, 7), slice(0, 8)))
workshop.as_picture(CHECKS, np.pad(CHECKS[1:7], 1, constant_values=5)[:, 1:-1], (slice(1, 7), slice(0, 8)))
workshop.shift_between(np.roll(SPOT, (2, -3), (0, 1)), SPOT)
workshop.shift_between(np.exp(-((np.indices((16, 16)) - [[[7.3]], [[5.4]]]) ** 2).sum(0) / 4), SPOT)
[workshop.beam(POINTS, directions, 2.0) for directions in (towards(5.0), towards(5000.0), towards(900.0))]
[inspect._counted(counts) for counts in ({}, {"A": 2, "B": 1})]
[inspect._value(info(value, shape)) for value, shape in ((V([1.5], 1.5, 1, 2), ()), (V([1, 2], 1, 1, 2), (2,)), (V(None, 1, 0, 3), (4, 5, 3)), (V(None, 1, 0, 3), (4, 5, 1)), (V(None, 1, 0, 3), (7, 3)), (None, ()), (None, (3,)))]
[inspect._flags(info(None, (), differentiable=d, discontinuous=c)) for d in (True, False) for c in (True, False)]
inspect._reasons([info(None, (), obstacle=o) for o in ("b (1)", "b (2)", "a; c", "a")])
[inspect.run_words(run) for run in ({}, {"status": "failed", "error": "x", "results": {"iterations": 3}}, {"status": "running"})]
inspect.moving_lines([{"id": f"s{n}", "by": ["motion"] if n % 2 else ["motion", "heightmap"]} for n in range(25)], False)
[inspect.moving_lines([{"id": f"s{n}", "by": ["motion"]} for n in range(count)], every) for count in (9, 10, 11) for every in (False, True)]
[len(inspect.parameter_lines([info(None, (), key=f"k{n:02d}") for n in range(count)], [], False)) for count in (29, 30, 31)]
[printed(init._tell_sensor, 0, [f"s{n}" for n in range(count)]) for count in (1, 2, 3, 4, 5)]
[printed(init._tell_sensor, 9, [f"s{n}" for n in range(count)]) for count in (1, 2, 3, 4, 5)], printed(init._tell_sensor, 2, ["a", "b"])
[shown_together(count) for count in (99, 100, 101)]
[share_left(seeds, budget) for seeds in (0, 2) for budget in (-1.0, 100.0)]
inspect.moving_lines([], False), inspect.moving_lines([{"id": "a", "by": ["motion"]}], True)
inspect.parameter_lines([info(None, (), key=f"k{n:02d}") for n in range(40)], ["k35", "k3[01]"], False)
inspect.parameter_lines([info(None, (), obstacle="x", bits=8), info(None, (), key="b", bits=16)], [], True)
[init._word(text) for text in ("a.b", "12", "-1.5", "1e3", "a b", "x: y", "#", "../a/b")], [init._text(text) for text in ("a.b", "12", "ä b")]
[init._path(Path(path), Path("/x/y/z")) for path in ("/x/y/z/a.xml", "/x/y/a.xml", "/x/a.xml", "/a.xml")]
[init._entry(suggested(**more)) for more in ({}, {"bounds": "[0, 1]"}, {"resolution": (4, 3)})]
[init._note(suggested(share=share, value=value, shape=shape)) for share in (0.0049, 0.005, 0.5) for value, shape in ((None, ()), (V([0.123456], 0, 0, 1), ()), (V(None, 1, 0.25, 3), (4, 5, 3)))]
[init.choose_size(size, None) for size in ((100, 100), (128, 128), (129, 128), (4000, 1), (1920, 1080))], init.choose_size((4000, 3000), None, True)
[options.allowance(240.0, number, "round") for number in (None, 1, 3)]
[render.ExposureType().convert(value, None, None) for value in ("auto", None, "0.5", 2.0)]
render.parse_values([" a = [1, 2] ", "b={file: x}"])
[serve._number(value) for value in (1, 2.5, True, math.nan, math.inf, "1", None)]
[bool(serve.LOCAL.fullmatch(host)) for host in ("localhost", "127.0.0.1:80", "[::1]:8", "LOCALHOST", "127.0.0.1.x", "a", "", "localhost:")]
[terminal.tell(error) for error in (errors.ConfigError("a", "b", "c"), KeyboardInterrupt(), ZeroDivisionError())]
[connection.Cluster.parse(text) for text in ("local:1", "local:1024", "tls://a:1", "tls://[::1]:65535")]
[connection.Cluster.parse(text) for text in ("local:01025",)], 0
[connection.Cluster.parse(text) for text in ("remote:3",)], 0
sweeps.SweepPlan("c", [], [], [1]).keys, [plan.keys for plan in plans()]
[connection.Cluster.parse(text) for text in ("tls://a:65536",)], 0
connection.Cluster(10**6).threads, connection.Cluster(address="a").threads
[cameras.sensor_id(name) for name in ("a-b.c", "", "--", "é1")]
[proposal.usual_bounds(info(value, (), key=key)) for key in ("a.reflectance.value", "m.vertex_color", "a.alpha.value", "a.eta.value", "a.eta", "a.nd", "a.Vd", "l.radiance.value", "sky.scale", "sky.turbidity", "a.weight.value", "a.other", "g.B1", "g.C1") for value in (None, V([0.5], 0.5, 0.5, 0.5), V([2], 2, 2, 2))]
proposal.usual_bounds(info(None, ()), ("PrincipledThin", "eta")), proposal.usual_bounds(info(V([0.01], 0.01, 0.01, 0.01), (), key="g.C1"))
[proposal._resolution(info(None, shape)) for shape in ((64, 64, 3), (65, 64, 3), (1000, 10, 3), (10, 1000, 1), (65, 1, 3), (70,))]
proposal._means(np.arange(24.0).reshape(2, 4, 3), (2, 1)), proposal._means(np.array([[[np.nan], [1], [2], [3]]]), (2, 1))
[visibility.widened(np.eye(5, dtype=bool), n) for n in (0, 1, 2)]
[catalog.value_shape(value, halo) for value, halo in ((None, 0), (mi.Float(1), 0), (mi.Color3f(1), 0), (dr.zeros(mi.TensorXf, (2, 6, 3)), 1), (dr.zeros(mi.Float, 7), 0))]
[values.first_entry(np.arange(size).reshape(shape), np.arange(size).reshape(shape) > 4) for size, shape in ((6, (6,)), (6, (2, 3)), (12, (2, 2, 3)), (3, (3,)))]
values.resample(np.arange(12.0, dtype=np.float32).reshape(2, 2, 3), (4, 3)), values.resample(np.arange(48.0).reshape(4, 4, 3), (2, 2))
[exporting.numbers(np.float32(number)) for number in (1, 0.1, 1e-30, 3e30)], exporting._free(Path("/h/a/b.png"), Path("/h"), {"a/b.png", "a/b-2.png"})
exporting._free(Path("/other/B.png"), Path("/h"), {"assets/b.png"}), exporting._free(Path("/other/c.png"), Path("/h"), set())
[exporting.same_values(*pair) for pair in ((1.0, 1.000009), (1.0, 1.0001), (np.ones(3), 1.0), (np.array([1, 2.0]), 1.0), (None, None), (np.ones(2), np.ones(3)), (0.0, 1e-36))]
[pictures.turn(np.arange(6).reshape(2, 3), n) for n in range(1, 9)]
responses.decode_srgb(np.array([-0.1, 0.0, 0.04, 0.04045, 0.0405, 0.5, 1, 2]))
[pictures.find_colours(names) for names in (["B", "G", "R"], ["Y"], ["x"], ["a.r", "a.g", "a.b", "Z"], ["a.R", "a.G", "a.B", "b.RGBA.R", "b.RGBA.G", "b.RGBA.B"], ["Y", "A"])]
pictures.find_colours([f"{layer}.{letter}" for layer in ("a.Combined", "b.Combined") for letter in "RGB"])
pictures.find_colours([f"{layer}.{letter}" for layer in ("a", "b") for letter in "RGB"])
[notices(quiet) for quiet in (True, False)]
[[name, example._about(path)] for name, path in example.examples().items()]
[bar_text(columns) for columns in (None, 59, 60, 61, 79, 80, 81)]
pictures._to_xyz([0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329])
[pictures._ends(data) for data in (b"\\xff\\xd8\\xff\\xd9", b"\\xff\\xd8\\xff\\xe0\\x00\\x04\\xff\\xd9", b"\\xff\\xd8\\xff\\xd0\\xff\\xff\\xd9", b"\\xff\\xd8")]
edges.welded_edges(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 0, 1]]), np.array([[0, 1, 2], [1, 3, 2], [0, 1, 4]]))
edges.angle_between(mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)), edges.turned(mi.Vector3f(2, 0, 0), mi.Vector3f(1, 1, 0), mi.Vector3f(0, 0, 3)), edges.across(mi.Vector3f(2, 0, 0), mi.Vector3f(1, 1, 0))
visibility._texels_met([], [[1, 0, 0.1], [0, -1, 0.2], [0, 0, 1]], (4, 3), SimpleNamespace(uv=mi.Point2f([-2.3, -0.9, -0.1, 0.3, 0.99, 1.7], [2.6, 1.3, 0.5, 0, -0.4, -1.9]), is_valid=lambda: True))[0]
[needs._film_obstacle(SimpleNamespace(id=lambda: "s", film=lambda name=name: SimpleNamespace(class_name=lambda: name))) for name in ("HDRFilm", "SpecFilm", "Other")]
edges.outline_direction(mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0), mi.Vector3f(0, 0, 1), mi.Point2f([0.1, 0.5, 0.9, 0.3], [0.2, 0.4, 0.6, 0.9]), 0.25)
ball().cosine(mi.Point3f([0, 5, 9], 0, 0)), ball().center, ball().radius
graph.face_normals(np.array([[[0.0, 0, 0], [2, 0, 0], [0, 1, 0]]])), rays.grid(2), rays.ray_offset(mi.Point3f(1, -3, 2)), rays.visible(100)
deformation._corners(mi.Point2f([0, 0.3, 1], [0.5, 0.9, 1]), 4, 3)
deformation.Motion((1, 2, 3), {"x": "a", "rotation": "r", "scale": "s"}).matrix({"a": mi.Float(2), "r": mi.Vector3f(10, 20, 30), "s": mi.Float(2)}).matrix
deformation.Motion((1, 2, 3), {"rotation_y": "r"}).matrix({"r": mi.Float(10)}, scaled=False).matrix
HORIZON.holds(mi.ScalarBoundingBox3f([-1, -1, -1], [1, 1, 1])), HORIZON.holds(mi.ScalarBoundingBox3f([-1, -1, -1], [1, 1, 1.1]))
[values._channels(MESH, key, value, False) for key, value in (("a.vertex_color", dr.zeros(mi.Float, 12)), ("a.face_color", dr.zeros(mi.Float, 6)), ("a.face_w", dr.zeros(mi.Float, 2)), ("a.radii", dr.zeros(mi.Float, 6)), ("a.vertex_x", mi.Color3f(1)))]
[catalog._current_value(params_of(value), "k") for value in (mi.Float(1, 2, 3, 4), mi.Float(1, 2, 3, 4, 5), mi.Float(2), dr.zeros(mi.Float, 0))]
[sweeps.SweepRunRecord("a", {}, 0, status).is_done for status in ("finished", "interrupted", "running", "failed", "waiting")]
[terminal_line(is_terminal) for is_terminal in (True, False)]
tree.to_array(mi.Float(3)), tree.like(2.0, np.array(3)), tree.like(mi.Color3f(0), np.float32([[1], [2], [3]])), tree.expected((2, 3))
[exported(*given) for given in ((".", False), (".", True), ("new", False), ("full", False), ("file", False), ("link", False), ("a.STL", False))]
[started_by(**given) for given in ({}, dict(codes={"a": "b"}), dict(manifest={}), dict(manifest={}, state=True), dict(state=True), dict(manifest={}, state=True, codes={"a": "b"}), dict(other=True), dict(statuses=["running"] * 2 + ["failed"]), dict(statuses=["running"] * 9))]
[grown(*given) for given in ((None, None), (3, None), (2, None), (1, None), (334, None), (333, None), (None, 4), (4, 300))]
[grown(*given, searched=True) for given in ((None, None), (None, 4), (None, 5), (None, 3), (None, 500), (None, 501), (3, 5))]
[left(*given) for given in ((None, False), ("finished", False), ("interrupted", False), ("failed", False), ("failed", True))]
[planned._bounded(name)[-9:] for name in ("a" * 400, "ä" * 400, "a/b")], len(planned._bounded("a" * 400))
[catalog._spectral_obstacle(node(kind), key) for kind, key in (("D65Spectrum", "a.d65.values"), ("IrregularSpectrum", "a.wavelengths"), ("IrregularSpectrum", "a.values"), ("BlackBodySpectrum", "a.temperature"), ("EnvironmentMapEmitter", "a.data"), ("EnvironmentMapEmitter", "a.scale"), ("Sphere", "a.vertex_color"))]
[edges.has_edges(SimpleNamespace(is_mesh=lambda: mesh, class_name=lambda: kind)) for mesh, kind in ((True, "PLYMesh"), (False, "Cylinder"), (False, "Instance"), (False, "BSplineCurve"))]
[needs.stock_clip(SimpleNamespace(lens_clip=lens, near_clip=near)) for lens in (True, False) for near in (True, False)]
[[kind, key, dispersion.bends_light(SimpleNamespace(properties={"a.n_d": (0, 0, node(kind), 0), "a.alpha": (0, 0, node(kind), 0)}), key)] for kind in ("DispersiveDielectric", "SmoothDielectric") for key in ("a.n_d", "a.alpha", "a.gone")]
[str(manifests.commit_of(Path(folder))) for folder in ("/", "/gone", "a" + chr(0))]
jobs._PROGRESS.match("3/40: loss") is not None, jobs._PROGRESS.match("loss 3/4: x") is None
""".strip().split("\n")  # noqa: E501
CHECKS = np.indices((8, 8)).sum(0) % 3 + 0.5
SPOT = np.exp(-((np.indices((16, 16)) - 7.0) ** 2).sum(0) / 4)
POINTS = np.stack([*np.meshgrid(np.linspace(-1, 1, 4), np.linspace(-1, 1, 4)), np.zeros((4, 4))], -1).reshape(-1, 3)
MESH = SimpleNamespace(vertex_count=lambda: 4, face_count=lambda: 2)
HORIZON = deformation.Horizon((0.0, 0.0, 0.0), 3**0.5)


def towards(distance: float) -> np.ndarray:
    """Return the unit directions (n, 3) from a lamp at `distance` above the origin to `POINTS`."""
    directions = POINTS - [0.1, 0.2, distance]
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def missing(share: float | None, error: float | None, seeds: int = 8) -> measurements.MissingRecord:
    return measurements.MissingRecord("c", "k", share, error, 2, seeds)


def judged(share: float | None, error: float | None) -> list[bool]:
    record = missing(share, None if share is None else error)
    return [record.is_unknown, record.is_incomplete, record.is_for_the_most_part, record.is_decided]


def costs(held: dict[str, int]) -> metrics.Regularized:
    return metrics.Regularized({"a": {"total_variation": 0.25, "thickness": 0.0}}, held)


def tally(found: Any, *records: dict[str, Any]) -> Any:
    for record in records:
        found.add(make_record(**record))
    return [found.to_json(), str(found)]


def plans() -> list[sweeps.SweepPlan]:
    two = [sweeps.Combination(name, {"run.spp": place}) for place, name in enumerate("ab")]
    return [sweeps.SweepPlan("c", [], two, [3, 4], search=found)
            for found in (None, sweeps.SweepSearch(5, {"x": [1]}))]  # fmt: skip


def errors_of(first: float, other: float) -> dict[str, dict[str, float]]:
    kinds = ("distance +2 %", "light turned by 1 degree about x", "lens turned by 1 degree about y", "index +0.005")
    return {"as planned": {"ssim": first}, **{kind: {"ssim": other} for kind in kinds}}


def V(numbers: list[float] | None, mean: float, low: float, high: float) -> catalog.Value:
    return catalog.Value(numbers, mean, low, high)


def info(value: catalog.Value | None, shape: tuple[int, ...], **more: Any) -> catalog.ParameterInfo:
    plain = {"key": "a.data", "kind": "bsdf", "type": "Float", "differentiable": True, "discontinuous": False}
    return catalog.ParameterInfo(**{**plain, "obstacle": None, "shape": shape, "value": value, **more})


def suggested(
    share: float = 0.5, value: Any = None, shape: Any = (), bounds: Any = None, resolution: Any = None
) -> Any:
    return proposal.Proposal(info(value, shape), share, bounds, resolution, True)


def ball() -> edges.Ball:
    return edges.Ball.around(mi.Point3f([0, 4], [1, -1], 0), mi.Float(1, 2))


def params_of(value: Any) -> Any:
    return SimpleNamespace(properties={"k": (value, None, None, 0)})


def exported(name: str, tolerances: bool) -> str:
    """Return why the folder `name` is refused for an export, or an empty text."""
    Path("full/a").mkdir(parents=True, exist_ok=True)
    Path("file").touch()
    if not Path("link").is_symlink():
        Path("link").symlink_to("full/a")
    try:
        exports.check_export(SimpleNamespace(fabrication=None), Path("full/a") / name if name == "." else Path(name),
                             tolerances)  # type: ignore[arg-type]  # fmt: skip
    except errors.ConfigError as error:
        return str(error)
    return ""


def started_by(
    manifest: dict[str, Any] | None = None, statuses: list[str] | None = None, **more: Any
) -> tuple[list[str], bool, str]:
    """Return the words that start the run of a sweep, whether its folder is there, and the error."""
    reads = [*({"status": status} for status in statuses or ())]
    clock = iter(range(0, 1000, 5))
    combination = sweeps.Combination("a=1", {})
    run = Path("s/a=1-seed=3")
    if run.exists():
        run.rmdir()
    if manifest is not None or more.get("state") or more.get("other"):
        run.mkdir(parents=True)
    plan: Any = SimpleNamespace(codes=more.get("codes", {}))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(planned, "newest_checkpoint", lambda folder: folder if more.get("state") else None)
        patch.setattr(planned, "read_manifest", lambda folder: reads.pop(0) if reads else manifest)
        patch.setattr(planned, "time", SimpleNamespace(monotonic=lambda: next(clock), sleep=lambda seconds: None))
        try:
            words, error = planned.command(Path("s"), plan, combination, 3), ""
        except errors.ConfigError as raised:
            words, error = [], str(raised)
    here = str(Path.cwd())
    return [word.replace(here, "HERE") for word in words], run.exists(), error.replace(here, "HERE")


def grown(seeds: int | None, trials: int | None, searched: bool = False) -> Any:
    """Return the seeds and the trials of a sweep of 3 combinations and 2 seeds that gets more, or the error."""
    asked = sweeps.SweepSearch(4, {}) if searched else None
    three = [sweeps.Combination(name, {}) for name in "abc"]
    try:
        found = planned._grown(sweeps.SweepPlan("c", [], three, [3, 4], search=asked), seeds, trials)
    except errors.ConfigError as error:
        return str(error)
    return [len(found.seeds), found.seeds[0], found.search and found.search.trials]


def left(status: str | None, has_failed: bool) -> bool:
    """Return whether a run of a sweep is left to do."""
    plan: Any = SimpleNamespace(failures={"a": 1} if has_failed else {})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(planned, "read_manifest", lambda folder: status and {"status": status})
        return planned.is_left(Path("s"), plan, "a")


def node(kind: str) -> Any:
    return SimpleNamespace(class_name=lambda: kind)


def printed(function: Any, *given: Any) -> str:
    """Return what a function prints on both streams, or its error."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            function(*given)
        except errors.ReslrbError as error:
            return f"{type(error).__name__}: {error}"
    return out.getvalue() + err.getvalue()


def shown_together(count: int) -> str:
    """Return why the command `report` refuses this number of runs."""
    with pytest.raises(errors.ConfigError) as refused:
        report.command.callback(tuple(Path("gone") for _ in range(count)), None)  # type: ignore[misc]
    return str(refused.value)


def share_left(seeds: int, budget: float) -> list[Any]:
    """Return the exit code and the output of `gradcheck --missing` if a measurement takes this number of seeds."""
    check: Any = SimpleNamespace(
        conditions=lambda: "conditions", keys=["a", "b"], source="c.yaml",
        measured=lambda key, affords, count, looks: missing(0.3, 0.01, seeds),
    )  # fmt: skip
    found: list[Any] = []
    asked: Any = SimpleNamespace(spp=None, json_file=None, seeds=None, budget=budget)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("reslrb_cli.measure.missing.MissingCheck.of_config", lambda config, spp: check)
        said = printed(lambda: found.append(int(gradcheck.run_missing(asked, None, "llvm_ad_rgb"))))  # type: ignore[arg-type]
    return [*found, said]


def bar_text(columns: int | None) -> list[Any]:
    """Return the calls of a bar in a terminal with this width. The time left takes 12 characters."""
    bar = MagicMock(format_dict={"ncols": columns})
    bar.format_interval.return_value = "01:23:4"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run_summary, "descriptions", lambda *_: ["x" * 40, "y" * 20, "z" * 30])
        progress = optimize.Progress(4, False, None)  # type: ignore[arg-type]
        progress._bar = bar
        progress.show(make_record(iteration=2))
    return [str(call) for call in bar.mock_calls]


def notices(quiet: bool) -> list[Any]:
    """Return the notice that a run would print at the first signal."""
    found: list[Any] = []

    def begin(**given: Any) -> None:
        found.append(given)
        raise KeyboardInterrupt

    course = SimpleNamespace(problem=SimpleNamespace(config=SimpleNamespace(run=SimpleNamespace(iterations=3))))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(terminal, "Interrupts", begin)
        with pytest.raises(KeyboardInterrupt):
            optimize._run(SimpleNamespace(course=course, manifest=None), None, [], quiet)
    return found


def terminal_line(is_terminal: bool) -> list[bytes]:
    """Return what the last line of a program writes."""
    written: list[bytes] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(terminal.os, "isatty", lambda number: is_terminal and number == 2)
        patch.setattr(terminal.os, "write", lambda number, text: written.append(text if number == 2 else b""))
        patch.setattr(terminal.select, "select", lambda read, write, _, wait=9: ([], [] if wait else write, []))
        terminal._say("interrupted")
    return written


@pytest.mark.usefixtures("llvm")
@pytest.mark.parametrize("number", range(len(CALLS)))
def test_calls(number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    work_in(tmp_path, monkeypatch)
    try:
        found = shown(eval(CALLS[number], globals()))
    except (errors.ConfigError, ValueError) as error:
        found = f"{type(error).__name__}: {error}"
    said.check(CALLS[number], [found], within=1e-3)
