"""`rl.load`, and the functions that examine an experiment in a single call, agree with the commands."""

from __future__ import annotations

import copy
import functools
import json
import logging
import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cli import tiny
from cli.tiny import KEY, done, measured
from measure.pretended_steps import Pretended, Stage
from report.measured import make_run
from runs.going_on import LAMP, work_alone, write_experiment

import reslrb_cli as rl
from reslrb_cli.config.loader import changed, dump, load, with_integrator
from reslrb_cli.measure import bench
from reslrb_cli.measure import convergence as session
from reslrb_cli.measure.convergence import Session
from reslrb_cli.measure.methods import MeasurementPlan

#: Settings that make a run cheap and exactly repeatable.
FAST = {"run.certainty": False, "run.iterations": 3}


@pytest.fixture
def folder(llvm: str, workplace: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    write_experiment(workplace)
    work_alone(monkeypatch)
    return workplace


def experiment(**run: Any) -> dict[str, Any]:
    """Return `tiny.yaml` as a mapping in Python."""
    return {
        "variant": "llvm_ad_rgb",
        "scene": {"file": Path("scene.xml")},
        "target": {"render": {"spp": np.int64(16)}},
        "parameters": [
            {"key": KEY, "initial": 0.5, "bounds": (0, 1)},
            {"key": LAMP, "initial": np.array([3, 4, 5]), "bounds": np.float32([0, 20])},
        ],
        "integrator": {"type": "reslrb", "max_depth": 3, "estimator": "stack"},
        "run": {"iterations": 5, "spp": 4, "name": "tiny", **run},
    }


# --- load -------------------------------------------------------------------------------------------------------------


def test_a_mapping_equals_its_yaml(folder: Path) -> None:
    expected = load("tiny.yaml", ["run.spp=8", "parameters[0].bounds=[0, 0.9]"])
    overrides = {"run.spp": 8, "parameters[0].bounds": (0, 0.9)}
    assert dump(rl.load(experiment(), overrides)) == dump(expected)
    assert dump(rl.load("tiny.yaml", overrides)) == dump(expected)
    assert dump(rl.load(rl.load("tiny.yaml"), overrides)) == dump(expected)
    assert rl.load("tiny.yaml", {"run": {"iterations": 6, "spp": 2}, "run.spp": 8}).run.spp == 8
    assert rl.load(experiment(spp=8), {"parameters[0].bounds": [0, 0.9]}) == expected
    unnamed = experiment()
    del unnamed["run"]
    assert rl.load(unnamed).run.name == "run"
    assert rl.load(experiment()).scene.file == folder / "scene.xml"


def test_paths_of_a_mapping_are_relative_to_base(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (folder / "elsewhere").mkdir()
    monkeypatch.chdir(folder / "elsewhere")
    assert rl.load(experiment(), base=folder).scene.file == folder / "scene.xml"
    assert rl.load(experiment(), base="..").scene.file.resolve() == folder / "scene.xml"


@pytest.mark.parametrize(
    ("call", "line"),
    [
        (lambda: rl.load(experiment(iterations=0)), "<dict>: run.iterations: must be at least 1"),
        (lambda: rl.load(experiment(iteration=3)), "<dict>: run.iteration: unknown key; did you mean `iterations`?"),
        (lambda: rl.load(experiment(spp=object)), "<dict>: run.spp: is <class 'object'>; YAML has no such value"),
        (lambda: rl.load(experiment() | {3: 4}), "<dict>: has the key 3; keys are text"),
        (lambda: rl.load("tiny.yaml", {"run.spq": 3}), "overrides: run.spq: unknown key; did you mean `spp`?"),
        (lambda: rl.load("tiny.yaml", {"run..spp": 3}), "overrides: `run..spp` is not a key"),
        (lambda: rl.load("tiny.yaml", {"run.spp": {1, 2}}), "overrides: run.spp: is {1, 2}; YAML has no such value"),
        (lambda: rl.load("tiny.yaml", {"": 4}), "overrides: has the key ''; keys are text"),
        (lambda: rl.load("tiny.yaml", ["run.spp=4"]), "overrides: is ['run.spp=4'], not a mapping"),  # type: ignore[arg-type]
        (
            lambda: rl.load("tiny.yaml", {"run.spp": 4, "run": {"iterations": 6}}),
            "overrides: run: replaces what run.spp sets; give it first",
        ),
        (lambda: rl.load(experiment(), base=3), "base: is 3, not the path of a folder"),  # type: ignore[arg-type]
        (lambda: rl.load_scene(3), "file: is 3, not the path of a scene file, or a Mitsuba dictionary"),  # type: ignore[arg-type]
        (lambda: rl.load(None), "experiment: is None, not a file, a mapping or a run's folder"),  # type: ignore[arg-type]
        (lambda: rl.export(None, "made"), "run: is None, not the folder of a run, which `optimize"),  # type: ignore[arg-type]
        (lambda: rl.optimize("tiny.yaml", folder=3), "folder: is 3, not the path of a folder"),  # type: ignore[arg-type]
        (lambda: rl.optimize(resume=3), "resume: is 3, not the folder of a run"),  # type: ignore[arg-type]
        (
            lambda: rl.gradcheck("tiny.yaml", integrators="own.py:A"),
            "integrators own.py:A: would run with all your rights; allow_code=True permits it",
        ),
        (lambda: rl.load("."), ".: is no run's folder"),
        (lambda: rl.render("tiny.yaml", spp=0), "spp: is 0; it must be at least 1"),
        (lambda: rl.render("tiny.yaml", values={"poster": 1}),
         f"values: poster: `poster` matches no parameter of the scene; did you mean `{KEY}`"),
        (lambda: rl.render("tiny.yaml", values={KEY: np.zeros((3, 4, 3))}),
         f"values: {KEY}: is of shape (3, 4, 3); it must have the parameter's shape (4, 4, 3)"),
        (lambda: rl.render("tiny.yaml", values={KEY: "grey"}),
         f"values: {KEY}: must be a number, a list of numbers, or {{file: IMAGE}}"),
        (lambda: rl.gradient("tiny.yaml", values={KEY: np.nan}),
         f"values: {KEY}: `{KEY}` has nan at texel (0, 0), channel 0; all values must be finite"),
        (lambda: rl.render("tiny.yaml", values={KEY: 1, "*": 1}), f"values: *: `{KEY}` is already matched by `{KEY}`"),
        (lambda: rl.render("tiny.yaml", values={"wall.to_world": 1}), "values: wall.to_world: `wall.to_world` is re"),
        (lambda: rl.render(rl.load("tiny.yaml", {"target.exposure": "auto"}), values={"exposure": 1}),
         "values: exposure: is the exposure; multiply the image by it instead"),
        (lambda: rl.render("tiny.yaml", exposure=True), "exposure: is of a run folder; give the folder, or leave out"),
        (lambda: rl.gradient("tiny.yaml", spp=0), "overrides: run.spp: must be at least 1"),
        (lambda: rl.gradcheck("tiny.yaml", "reslrb:stick"), "integrators reslrb:stick: integrator.estimator: must be"),
        (lambda: rl.convergence("tiny.yaml", "prb,nothing"), "integrators nothing: integrator.type: must be one of"),
        (lambda: rl.convergence("tiny.yaml", reference="prb,ptracer"), "reference: errors are relative to one method"),
        (lambda: rl.convergence("tiny.yaml", objective="mean"), "objective: is 'mean'; there are fixed, loss, image"),
        (lambda: rl.convergence("tiny.yaml", rounds=0), "rounds: is 0; at least 1 is needed"),
        (lambda: rl.convergence(rl.load("tiny.yaml").with_loss(np.mean)), "tiny.yaml: loss: is a function, which the "
         "processes of this measurement do not have; give {type: custom, file: FILE.py:NAME}"),
        (lambda: rl.bench(rl.load("tiny.yaml").with_loss(np.mean)), "tiny.yaml: loss: is a function, which the"),
        (lambda: rl.bench("tiny.yaml", "prb,nothing"), "integrators nothing: integrator.type: must be one of"),
        (lambda: rl.bench("tiny.yaml", sweep="film"), "sweep: is 'film'; there are depth, spp"),  # type: ignore[arg-type]
        (lambda: rl.bench("tiny.yaml", values=[0]), "values: is 0; at least 1 is needed"),
        (lambda: rl.write_report("none", "page.html"), "none: no such file"),
        (lambda: rl.write_report([3], "page.html"), "sources: is 3, not the path of a run folder"),  # type: ignore[list-item]
        (lambda: rl.write_report("tiny.yaml", "page.html"), "tiny.yaml: line 2: is damaged, or no line"),
    ],
)  # fmt: skip
def test_errors_are_located(folder: Path, call: Callable[[], Any], line: str) -> None:
    with pytest.raises(rl.ConfigError) as error:
        call()
    assert str(error.value).startswith(line)


def test_every_copy_keeps_the_own_loss_and_the_permission(folder: Path) -> None:
    given = load("tiny.yaml").with_loss(np.mean).with_code()
    alone = {"type": "reslrb", "estimator": "gather"}
    ways = {
        "overrides": rl.load(given, {"run.spp": 8}),
        "--set": changed(given, ["run.spp=8"]),
        "nothing": rl.load(given),
        "with_code": load("tiny.yaml").with_loss(np.mean).with_code(),
        "with_loss": load("tiny.yaml").with_code().with_loss(np.mean),
        "with_integrator": with_integrator(given, alone, "here", {}),
        "exposures": given.with_exposures_fixed(),
        "model_copy": given.model_copy(update={"variant": "auto"}),
        "copy": copy.copy(given),
        "deepcopy": copy.deepcopy(given),
        "pickle": pickle.loads(pickle.dumps(given)),
    }
    for way, config in ways.items():
        assert (config.own_loss, config.allows_code) == (np.mean, True), way
    assert rl.load(given, {"run.spp": 8}).source == given.source


def test_calls_keep_the_own_loss_and_the_permission(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def own(image: mi.TensorXf, target: mi.TensorXf) -> mi.TensorXf:
        return 2 * dr.mean(dr.square(image - target), axis=None)

    config = rl.load("tiny.yaml", {**FAST, "run.measuring": 0, "run.iterations": 1})
    loss, gradients = rl.gradient(config, spp=8)
    twice, others = rl.gradient(config.with_loss(own), spp=8)
    assert twice == pytest.approx(2 * loss)
    for key, gradient in gradients.items():
        np.testing.assert_allclose(others[key], 2 * gradient, rtol=1e-4, atol=1e-6)
    run = rl.optimize(config.with_loss(own), overrides={"run.spp": 8})
    assert [record.iteration for record in run] == [0]
    (folder / "own.py").write_text("import drjit as dr\n\n\ndef own(a, b):\n    return dr.mean(a - b, axis=None)\n")
    named = rl.load(config, {"loss": {"type": "custom", "file": "own.py:own"}})
    with pytest.raises(rl.ConfigError, match=r"the experiment `load\(\.\.\.\)\.with_code\(\)`$"):
        rl.gradient(named)
    assert np.isfinite(rl.gradient(named.with_code(), spp=8)[0])
    assert rl.optimize(named.with_code(), overrides={"run.spp": 8}).config.allows_code
    with pytest.raises(rl.ConfigError, match=r"none\.py: no such file"):
        rl.gradcheck(config.with_code(), integrators="none.py:A")

    def seen(session: Session) -> None:
        raise LookupError(f"allowed: {session.plan.config.allows_code}")

    monkeypatch.setattr(Session, "run", seen)
    with pytest.raises(LookupError, match="allowed: True"):
        rl.convergence(config.with_code(), integrators="own.py:A")


# --- looking ----------------------------------------------------------------------------------------------------------


def test_an_image_equals_that_of_the_command(folder: Path) -> None:
    done("render", "tiny.yaml", "-o", "command.exr", "--set", "run.spp=8")
    done("render", "tiny.yaml", "-o", "scene.exr", "--scene")
    images = rl.render("tiny.yaml", spp=8)
    assert list(images) == [0]
    assert np.array_equal(images[0], np.array(mi.Bitmap("command.exr")))
    assert images[0].dtype == np.float32
    assert np.array_equal(rl.render(experiment(), initial=False)[0], np.array(mi.Bitmap("scene.exr")))
    views = rl.load("tiny.yaml", {"views": [{"sensor": n} for n in range(3)]})
    assert [(sensor, image.shape) for sensor, image in rl.render(views).items()] == [(n, (8, 8, 3)) for n in range(3)]


def test_given_values_replace_initial_ones(folder: Path) -> None:
    texture = np.random.default_rng(5).uniform(0, 1, (4, 4, 3))
    given = rl.render("tiny.yaml", values={KEY: texture, LAMP: 6})
    assert not np.array_equal(given[0], rl.render("tiny.yaml")[0])
    as_initial = {"parameters[0].initial": 0.25, "parameters[1].initial": 6}
    expected = rl.render(rl.load("tiny.yaml", as_initial))
    assert np.array_equal(rl.render("tiny.yaml", values={KEY: 0.25, LAMP: 6})[0], expected[0])
    # The lamp need not be a parameter
    alone = {"parameters": [{"key": KEY, "initial": 0.25}]}
    assert np.array_equal(rl.render(rl.load("tiny.yaml", alone), values={LAMP: [6, 6, 6]})[0], expected[0])
    mi.Bitmap(np.full((4, 4, 3), 0.25, np.float32)).write("grey.exr")
    from_file = rl.render("tiny.yaml", values={KEY: {"file": "grey.exr"}, LAMP: 6}, initial=False)
    assert np.array_equal(from_file[0], expected[0])


@pytest.mark.long
def test_the_gradient_equals_that_of_the_first_iteration(folder: Path) -> None:
    run = rl.optimize("tiny.yaml", overrides=FAST)
    first = next(iter(run))
    loss, gradient = rl.gradient("tiny.yaml")
    assert loss == first.loss
    assert all(value.tobytes() == run.gradients[key].tobytes() for key, value in gradient.items())
    assert {key: (value.shape, value.dtype.name) for key, value in gradient.items()} == {
        KEY: ((4, 4, 3), "float32"), LAMP: ((3,), "float32")}  # fmt: skip
    other, changed = rl.gradient("tiny.yaml", seed=3)
    assert other != loss
    assert not np.array_equal(changed[KEY], gradient[KEY])
    assert rl.gradient("tiny.yaml", spp=4)[0] == loss
    assert rl.gradient("tiny.yaml", spp=8)[0] != loss


def test_the_gradient_belongs_to_the_loss(folder: Path) -> None:
    """Finite differences along the gradient match the gradient, at equal seeds and many samples. The loss has no
    discontinuity in the values.
    """
    smooth = rl.load("tiny.yaml", {"run.adjoint": "correlated", "run.spp": 256})
    at = {KEY: np.full((4, 4, 3), 0.4, np.float32), LAMP: np.float32([4, 5, 6])}
    _, gradient = rl.gradient(smooth, at)
    for key in at:
        size = float(np.abs(at[key]).mean())
        along = gradient[key] / np.linalg.norm(gradient[key]) * size
        step = 0.02
        sides = [rl.gradient(smooth, at | {key: at[key] + sign * step * along})[0] for sign in (1, -1)]
        assert (sides[0] - sides[1]) / (2 * step) == pytest.approx(float((gradient[key] * along).sum()), rel=0.01)


# --- measuring --------------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_gradcheck_writes_the_records_of_the_command(folder: Path) -> None:
    done("gradcheck", "tiny.yaml", "--integrators", "reslrb:stack", "--seeds", "3", "--spp", "4", "--json", "g.jsonl")
    records = rl.gradcheck("tiny.yaml", "reslrb:stack", seeds=3, spp=4)
    found = [json.loads(record.to_json()) for record in records]
    assert [record.parameter for record in records if record.reference.value == "walk_ad"] == [KEY, LAMP]
    told = measured("g.jsonl")
    assert [{**one, **dict.fromkeys(other)} for one, other in zip(told, found, strict=True)] == [
        dict.fromkeys(each) for each in found
    ]
    names = ("parameter", "reference", "kind", "seeds", "verdict", "holds")
    assert [[each[name] for name in names] for each in found] == [[each[name] for name in names] for each in told]


class Played(Session):
    """Session with simulated processes, and a clock that only these processes advance."""

    def __init__(
        self, plan: MeasurementPlan, stop: Callable[[], bool], say: Callable[[str], None], spent_s: float, **given: Any
    ) -> None:
        stage = Stage()
        super().__init__(plan, stop, say, start=stage.start, now=stage.clock, **given)


def test_convergence_writes_the_records_of_the_command(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(session, "Session", Played)
    given = ["--integrators", "reslrb:stack,ptracer", "--reference", "reslrb:stack", "--rounds", "8", "--spp", "4,8"]
    done("convergence", "tiny.yaml", *given, "--json", "c.jsonl")
    assert (
        ", dL/dI fixed" in done("convergence", "tiny.yaml", "--rounds", "3").stdout
    )  # without a line while it measures
    records = rl.convergence("tiny.yaml", "reslrb:stack,ptracer", rounds=8, spps=[4, 8], reference="reslrb:stack")
    assert records.draws["ptracer, 4 spp"].values.shape == records.draws["ptracer, 8 spp"].values.shape == (16, 63)
    found = [json.loads(record.to_json()) for record in records]
    assert found == measured("c.jsonl")
    assert {"point", "method", "reference", "summary"} <= {each["kind"] for each in found}

    class Interrupted(Played):
        def run(self) -> Iterator[int]:
            os.kill(os.getpid(), signal.SIGINT)
            yield from super().run()
            assert self.rounds < 8

    monkeypatch.setattr(session, "Session", Interrupted)
    with pytest.raises(KeyboardInterrupt):
        rl.convergence("tiny.yaml", "reslrb:stack,ptracer", rounds=8, spps=[4, 8], reference="reslrb:stack")


def test_bench_writes_the_records_of_the_command(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "Bench", functools.partial(bench.Bench, start=Pretended))
    given = ["--integrators", "reslrb:stack,ptracer", "--sweep", "spp", "--values", "8,4", "--rounds", "3"]
    done("bench", "tiny.yaml", *given, "--json", "b.jsonl")
    records = rl.bench("tiny.yaml", "reslrb:stack,ptracer", sweep="spp", values=[8, 4], rounds=3)
    found = [json.loads(record.to_json()) for record in records]
    assert found == measured("b.jsonl")
    assert [(each["label"], each["spp"]) for each in found] == [
        (label, spp) for spp in (4, 8) for label in ("reslrb:stack", "ptracer")
    ]
    make_run(folder / "a")
    assert rl.write_report(["a", "b.jsonl"], "page.html") == Path("page.html")
    page = Path("page.html").read_text()
    assert all(words in page for words in ("Cost of a step: b.jsonl", "Convergence: a"))


class Interrupting(logging.Handler):
    """Log handler that stores all messages and sends an interrupt when a message contains `words`."""

    def __init__(self, words: str) -> None:
        super().__init__(logging.DEBUG)
        self.words, self.said = words, list[str]()

    def emit(self, record: logging.LogRecord) -> None:
        self.said.append(record.getMessage())
        if self.words in self.said[-1]:
            os.kill(os.getpid(), signal.SIGINT)


@pytest.mark.long
def test_an_interrupt_ends_long_calls(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    """An interrupt ends a call before all measurements are done."""
    words = "gradient reslrb:stack"
    handler = Interrupting(words)
    with caplog.at_level(logging.DEBUG, "reslrb_cli"):
        logging.getLogger("reslrb_cli").addHandler(handler)
        try:
            with pytest.raises(KeyboardInterrupt):
                rl.gradcheck("tiny.yaml", "reslrb:stack", seeds=3, spp=4)
        finally:
            logging.getLogger("reslrb_cli").removeHandler(handler)
    assert [line for line in handler.said if words in line]
    assert not [line for line in handler.said if "differences" in line]


@pytest.mark.long
def test_convergence_measures(folder: Path) -> None:
    records = rl.convergence("tiny.yaml", "reslrb:stack", reference="reslrb:stack", rounds=4)
    assert [record.to_json() for record in records][-1].startswith('{"kind": "summary"')


def test_an_export_equals_that_of_the_command(folder: Path) -> None:
    with rl.optimize("tiny.yaml", folder="runs/mine", overrides=FAST) as run:
        list(run)
    assert run.folder is not None
    done("export", str(run.folder), "-o", "command")
    scene = rl.export(run.folder, "mine")
    assert scene == Path("mine/scene.xml")
    assert scene.read_bytes() == Path("command/scene.xml").read_bytes()
    assert tiny.files(Path("mine")) == tiny.files(Path("command"))
    with pytest.raises(rl.ConfigError, match="folder: mine exists; give a new or empty folder"):
        rl.export(run.folder, "mine")
    # A run folder is also an experiment, which starts at the recovered values
    assert np.array_equal(rl.render(run.folder, spp=8)[0], rl.render("tiny.yaml", 8, run.parameters)[0])
    assert rl.load(run.folder, {"run.spp": 2}).run.spp == 2


# --- the package's face -----------------------------------------------------------------------------------------------


#: A user's script. mypy checks the script against the installed packages.
TYPED = """
import drjit as dr
import mitsuba as mi
import numpy as np
import reslrb_cli as rl

config: rl.Config = rl.load({"scene": {}}, overrides={"run.iterations": 3}, base="..")
with rl.optimize(config, folder="x") as run:
    for record in run:
        loss: float = record.loss
        image: np.ndarray[tuple[int, ...], np.dtype[np.float32]] = run.images[0]
        kept: rl.Record = record
    for kept in run.live():
        reveal_type(kept)
one: rl.Run = run
reveal_type((run.config, run.folder, run.status, run.iteration, run.records))
run.close()
rl.register()
reveal_type((run.parameters, run.gradients, run.images, run.targets, run.truth))
reveal_type((rl.gradient(config), rl.render(config, values={"a": 3}), rl.export("x", "y", tolerances=True)))
reveal_type([(check.holds, check.verdict, check.to_json()) for check in rl.gradcheck(config)])
reveal_type([line.to_json() for line in rl.convergence(config, objective="image")])
reveal_type(rl.__version__)


def l2(image: mi.TensorXf, target: mi.TensorXf) -> mi.TensorXf:
    return dr.mean(dr.square(image - target), axis=None)


def weighted(image: mi.TensorXf, target: mi.TensorXf, weights: mi.TensorXf | None) -> mi.Float:
    return dr.mean(image if weights is None else image * weights, axis=None).array


scene = rl.load_scene("scene.xml")
reveal_type(scene)
rl.torch.render(scene, {}, spp=4)
reveal_type([record.holds for record in rl.check_estimator("stack", ["furnace"])])
reveal_type(rl.register_estimator)


class Watch(rl.Callback):
    def iteration(self, run: rl.RunInfo, record: rl.Record) -> None:
        reveal_type((run.folder, run.iterations, record.loss))


rl.optimize(config, callbacks=[Watch(), rl.TensorBoard("x"), rl.MLflow(), rl.WandB(), "wandb"])
reveal_type(rl.step(mi.load_dict({"type": "reslrb"}), scene, 0, lambda image: l2(image, image), seed=1, spp=4).loss)
try:
    rl.optimize("x.yaml", loss=l2)
    rl.optimize("x.yaml", loss=weighted)
except rl.ConfigError as error:
    reveal_type((error.source, error.key, error.message))
except rl.ReslrbError:
    pass
rl.optimize(config, folders="x")
rl.optimize(config, loss=lambda image: image)
rl.render(config)["0"]
"""


@pytest.mark.long
def test_users_type_checkers_see_the_types(tmp_path: Path) -> None:
    (tmp_path / "script.py").write_text(TYPED)
    command = [sys.executable, "-m", "mypy", "--strict", "--follow-imports=silent", "--cache-dir", str(tmp_path / "c"),
               "script.py"]  # fmt: skip
    environment = {**os.environ, "MYPYPATH": str(tiny.ROOT)}
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, timeout=300, env=environment)
    out = done.stdout
    for name in rl.__all__:
        assert f"rl.{name}" in TYPED
    assert (tiny.ROOT / "reslrb_cli/py.typed").exists()
    seen = [line.partition("Revealed type is ")[2] for line in out.splitlines() if "Revealed type" in line]
    assert len(seen) == TYPED.count("reveal_type("), out + done.stderr
    for each in seen:  # only the number of an array's dimensions may be Any
        assert "Any" not in each.replace("numpy.ndarray[Any, ", ""), each
    assert "import-untyped" not in out
    errors = [line.partition(" error: ")[2] for line in out.splitlines() if ": error:" in line]
    assert len(errors) == 3, out
    for words, error in zip(('argument "folders"', 'Argument "loss"', "Invalid index type"), errors, strict=True):
        assert words in error


def test_public_names_have_docstrings() -> None:
    for name in rl.__all__:
        assert getattr(rl, name).__doc__, name
