"""Callbacks are told of a run with and without a folder, and their errors end it in one line with a complete folder."""

from __future__ import annotations

import contextlib
import functools
import logging
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from cli.tiny import ROOT, manifest, outcome, settings
from runs.going_on import begin_alone

import reslrb_cli as rl
from reslrb_cli.records.images import as_bytes
from reslrb_cli.records.manifest import Manifest
from reslrb_cli.runs import log, loggers
from reslrb_cli.runs.callbacks import Calls
from reslrb_cli.runs.sweep import make_plan

SET = {"run.certainty": False, "run.iterations": 3}
POSTER, LAMP = "poster.reflectance.data", "lamp.emitter.radiance.value"


class Listener(rl.Callback):
    """Keeps the calls. `fails` names the method that raises an error."""

    def __init__(self, fails: str = "") -> None:
        self.calls: list[Any] = []
        self.values: list[dict[str, Any]] = []
        self.images: dict[str, np.ndarray[Any, Any]] = {}
        self.fails = fails
        self.run: rl.RunInfo | None = None

    def _told(self, name: str, *of: Any) -> None:
        self.calls.append((name, *of))
        if name == self.fails:
            raise ValueError("no room")

    def begin(self, run: rl.RunInfo) -> None:
        self.run = run
        self._told("begin", run.done)

    def iteration(self, run: rl.RunInfo, record: rl.Record) -> None:
        self.values.append({key: run.value(key) for key in run.shapes})
        self._told("iteration", record.iteration)

    def image(self, run: rl.RunInfo, name: str, image: Any, exposure: float) -> None:
        self.images[name] = image
        assert exposure > 0
        self._told("image", name)

    def end(self, run: rl.RunInfo, status: str) -> None:
        self._told("end", status)


#: The calls of a whole run.
WHOLE = [("begin", 0), ("image", "target"), ("image", "initial"), *(("iteration", n) for n in range(3)),
         ("image", "final"), ("end", "finished")]  # fmt: skip


@pytest.fixture
def experiment(llvm: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    begin_alone(tmp_path, monkeypatch)
    return tmp_path


@pytest.mark.parametrize("folder", [None, "runs/a"])
def test_a_callback_is_told_of_a_whole_run(experiment: Path, folder: str | None) -> None:
    quiet, heard = rl.optimize("tiny.yaml", overrides=SET), Listener()
    run = rl.optimize("tiny.yaml", folder, overrides=SET, callbacks=[heard])
    expected = list(quiet)
    for number, record in enumerate(run):
        assert record.loss == expected[number].loss
        for key, value in run.parameters.items():
            np.testing.assert_array_equal(heard.values[-1][key], value)
    assert heard.calls == WHOLE
    for key, value in quiet.parameters.items():  # looking has changed nothing
        np.testing.assert_array_equal(run.parameters[key], value)
    np.testing.assert_array_equal(heard.images["target"], run.targets[0])
    told = heard.run
    assert told is not None
    assert (told.name, told.iterations, told.folder) == (
        (folder and "a") or "tiny",
        3,
        folder and Path(folder).absolute(),
    )
    assert told.shapes == {POSTER: (4, 4, 3), LAMP: (3,)}
    assert told.settings["run.iterations"] == 3


def test_a_loop_that_is_left_and_continued(experiment: Path) -> None:
    heard = Listener()
    run = rl.optimize("tiny.yaml", "runs/a", overrides=SET, callbacks=[heard])
    for _ in run:
        break
    assert heard.calls[-2:] == [("image", "final"), ("end", "interrupted")]
    heard.calls.clear()
    list(run)
    assert heard.calls == [("begin", 1), *WHOLE[4:]]
    later = Listener()
    list(rl.optimize(resume="runs/a", overrides={"run.iterations": 4}, callbacks=[later]))
    assert later.calls == [("begin", 3), ("iteration", 3), *WHOLE[-2:]]


@pytest.mark.parametrize("folder", [None, "runs/a"])
@pytest.mark.parametrize("method", ["begin", "image", "iteration", "end"])
def test_an_error_of_a_callback_ends_the_run(experiment: Path, method: str, folder: str | None) -> None:
    bad, good = Listener(method), Listener()
    run = rl.optimize("tiny.yaml", folder, overrides=SET, callbacks=[bad, good])
    with pytest.raises(rl.ConfigError) as caught:
        list(run)
    said = str(caught.value)
    assert said.startswith(f"callbacks: Listener: `{method}` raises in line ")
    assert said.endswith(" ValueError: no room")
    line = Path(__file__).read_text().splitlines()[int(said.split()[6]) - 1]
    assert "raise ValueError" in line
    assert run.status == "failed"
    assert good.calls[-1] == ("end", "finished" if method == "end" else "failed")
    if folder is not None:
        content = manifest(folder)
        assert (content["status"], content["error"]) == ("failed", said)
        assert {"report.html", "config.yaml", "run.log"} <= {path.name for path in Path(folder).iterdir()}
        assert (Path(folder) / "checkpoint" / "state.npz").exists()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["wand"], "callbacks: there is no `wand`; there are mlflow, tensorboard, wandb"),
        ([Listener], "callbacks: has <class "),
        ([print], "callbacks: has <built-in function print>, which is no reslrb_cli.Callback"),
        ("wandb", "callbacks: is 'wandb', not a list of callbacks"),
    ],
)
def test_wrong_callbacks_are_refused(experiment: Path, given: Any, message: str) -> None:
    with pytest.raises(rl.ConfigError) as caught:
        rl.optimize("tiny.yaml", callbacks=given)
    assert str(caught.value).startswith(message)
    assert str(caught.value).endswith("; call it") == (given == [Listener])


# --- the command ------------------------------------------------------------------------------------------------------


def test_a_callback_of_another_package_has_a_name(experiment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    heard: list[Listener] = []
    monkeypatch.setattr(
        sys.modules[__name__], "made_here", lambda: heard.append(Listener()) or heard[-1], raising=False
    )
    point = EntryPoint("own", f"{__name__}:made_here", loggers.GROUP)
    monkeypatch.setattr(loggers, "entry_points", lambda group: [point] if group == loggers.GROUP else [])
    assert (
        outcome("optimize", "tiny.yaml", "--log", "own", *settings("run.certainty=false", "run.iterations=3"))[0] == 0
    )
    assert heard[0].calls == WHOLE
    code, _, err = outcome("optimize", "tiny.yaml", "--log", "other")
    assert code == 2
    assert "--log: there is no `other`; there are mlflow, own, tensorboard, wandb" in err


WATCH = """
import reslrb_cli as rl

print("the code was run")

class Watch(rl.Callback):
    def iteration(self, run, record):
        print("saw", record.iteration)

class Broken(rl.Callback):
    def __init__(self):
        raise ValueError("no room")

def other():
    return 3
"""
SHORT = settings("run.certainty=false", "run.iterations=2")


def errors(text: str) -> list[str]:
    """Return the lines of the standard error, without the line about the variant."""
    return [line for line in text.splitlines() if not line.startswith("variant ")]


def name_callbacks(*names: str) -> None:
    """Write `run.callbacks` into the configuration."""
    text = Path("tiny.yaml").read_text()
    assert text.count("\nrun: {") == 1
    Path("tiny.yaml").write_text(text.replace("\nrun: {", f"\nrun: {{callbacks: [{', '.join(names)}], "))
    Path("watch.py").write_text(WATCH)


def test_a_configuration_names_callbacks(experiment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    heard: list[Listener] = []
    monkeypatch.setitem(loggers.LOGGERS, "own", lambda: heard.append(Listener()) or heard[-1])
    name_callbacks("watch.py:Watch", "own")
    code, out, err = outcome("optimize", "tiny.yaml", *SHORT)
    assert (code, out) == (2, "")
    file = experiment / "watch.py"
    said = f"tiny.yaml: run.callbacks[0]: would run the code of {file} with all your rights; --allow-code permits it"
    assert errors(err) == [said]
    code, out, _ = outcome("optimize", "tiny.yaml", "--allow-code", "--log", "own", *SHORT)
    assert (code, out.splitlines()[:3]) == (0, ["the code was run", "saw 0", "saw 1"])
    assert len(heard) == 1  # although it is named twice
    assert heard[0].calls[-1] == ("end", "finished")
    # The folder continues with the same callbacks, or with others, and after a change of the file.
    longer = settings("run.iterations=3")
    assert outcome("optimize", "--resume", "runs/tiny", *longer)[0] == 2
    Path("watch.py").write_text(WATCH.replace("saw", "sees"))
    assert "sees 2\n" in outcome("optimize", "--resume", "runs/tiny", "--allow-code", *longer)[1]
    without = settings("run.iterations=4", "run.callbacks=[]")
    code, out, _ = outcome("optimize", "--resume", "runs/tiny", *without)
    assert (code, "the code was run" in out) == (0, False)


def test_callbacks_of_a_configuration_in_python(experiment: Path, capsys: pytest.CaptureFixture[str]) -> None:
    name_callbacks("watch.py:Watch")
    with pytest.raises(rl.ConfigError, match=r"run.callbacks\[0\]: would run .*; allow_code=True permits it"):
        rl.optimize("tiny.yaml", overrides=SET)
    heard = Listener()
    run = rl.optimize("tiny.yaml", "runs/a", overrides=SET, callbacks=[heard], allow_code=True)
    next(iter(run))
    run.close()
    list(run)  # a second loop has the same callbacks
    assert capsys.readouterr().out == "the code was run\nsaw 0\nsaw 1\nsaw 2\n"
    assert [name for name, *_ in heard.calls].count("iteration") == 3
    list(rl.optimize(resume="runs/a", overrides={"run.iterations": 4}, allow_code=True))
    assert capsys.readouterr().out == "the code was run\nsaw 3\n"
    rl.gradient("tiny.yaml")  # needs none of them
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("watch.py:Nobody", "watch.py has nothing of the name `Nobody`"),
        ("watch.py:other", "run.callbacks[0]: has 3, which is no reslrb_cli.Callback"),
        ("watch.py:Broken", "run.callbacks[0]: the callback raises in line 12 ValueError: no room"),
        ("gone.py:Watch", "gone.py: no such file"),
        ("wand", "run.callbacks[0]: there is no `wand`; there are mlflow, tensorboard, wandb"),
        ("watch.py", "run.callbacks[0]: must be FILE.py:NAME"),
        ("''", "run.callbacks[0]: must be a name, or FILE.py:NAME"),
        ("3", "run.callbacks[0]: must be a name, or FILE.py:NAME"),
    ],
)
def test_wrong_callbacks_of_a_configuration(experiment: Path, name: str, message: str) -> None:
    name_callbacks(f'"{name}"' if ":" in name else name)
    code, _, err = outcome("optimize", "tiny.yaml", "--allow-code", *SHORT)
    said = errors(err)
    assert (code, len(said)) == (2, 1), err
    assert message in said[0]
    assert not Path("runs").exists()


def test_log_names_no_file(experiment: Path) -> None:
    code, _, err = outcome("optimize", "tiny.yaml", "--log", "watch.py:Watch", "--allow-code")
    assert (code, errors(err)) == (
        2,
        ["--log: a file is named by the setting `run.callbacks: [watch.py:Watch]`"],
    )


def test_a_sweep_needs_permission_for_callbacks(experiment: Path) -> None:
    name_callbacks("watch.py:Watch")
    code, _, err = outcome("sweep", "tiny.yaml", "-o", "sweep")
    assert code == 2
    assert "run.callbacks[0]: would run the code of" in err
    plan = make_plan(Path("tiny.yaml"), [], 1, [], allow_code=True)
    assert list(plan.sweep.codes) == [str(experiment / "watch.py")]


# --- packages and the folder ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "package"), [("tensorboard", "tensorboardX"), ("mlflow", "mlflow"), ("wandb", "wandb")]
)
def test_a_missing_package_is_named(experiment: Path, name: str, package: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    code, _, err = outcome("optimize", "tiny.yaml", "--log", name)
    assert code == 2
    assert f"{name}: needs the package {package} (" in err
    assert f"; `pip install 'reslrb[{name}]'` installs it" in err
    assert not Path("runs").exists()


# --- the folder -------------------------------------------------------------------------------------------------------


def test_the_log_file_has_the_lines_of_its_run(experiment: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "reslrb_cli")
    runs = [rl.optimize("tiny.yaml", f"runs/{name}", overrides=SET) for name in "ab"]
    for one, _ in zip(*runs, strict=True):
        logging.getLogger("reslrb_cli").info("said between iterations %s", one.iteration)
    texts = [Path(f"runs/{name}/run.log").read_text() for name in "ab"]
    for text in texts:
        assert text.count("rendering the final image") == 1
        assert "rendering the target image" in text  # before the folder existed
        assert "between iterations" not in text
        assert all(line[:2] == "20" for line in text.splitlines())
    caplog.clear()
    list(rl.optimize(resume="runs/a", overrides={"run.iterations": 4}))
    assert Path("runs/a/run.log").read_text().startswith(texts[0])
    assert Path("runs/a/run.log").read_text().count("rendering the final image") == 2


def test_warnings_are_printed_without_any_logging(
    monkeypatch: pytest.MonkeyPatch, capsys: Any, caplog: pytest.LogCaptureFixture
) -> None:
    logger = logging.getLogger("reslrb_cli")
    for each in (logger, logging.getLogger()):
        monkeypatch.setattr(each, "handlers", [])
    with caplog.at_level(logging.INFO, logger.name), log.collected() as lines:
        logger.warning("seen once")
        logger.info("not printed")
    assert capsys.readouterr().err == "seen once\n"
    assert [line.partition(" ")[2] for line in lines] == ["WARNING seen once", "INFO not printed"]


def test_the_manifest_names_the_commit_of_the_configuration(experiment: Path) -> None:
    list(rl.optimize("tiny.yaml", "runs/a", overrides=SET))
    assert manifest("runs/a")["commit"] is None
    for words in (
        ["init", "-q"],
        ["add", "tiny.yaml"],
        ["-c", "user.name=a", "-c", "user.email=b", "commit", "-qm", "c"],
    ):
        subprocess.run(["git", *words], check=True)
    commit = subprocess.run(["git", "rev-parse", "HEAD"], check=True, capture_output=True, text=True).stdout.strip()
    list(rl.optimize("tiny.yaml", "runs/b", overrides=SET))
    assert manifest("runs/b")["commit"] == commit
    list(rl.optimize(resume="runs/b", overrides={"run.iterations": 4}))
    assert manifest("runs/b")["commit"] == commit


# --- the time of callbacks --------------------------------------------------------------------------------------------


class Reader(rl.Callback):
    """Reads all values after each iteration."""

    def iteration(self, run: rl.RunInfo, record: rl.Record) -> None:
        for key in run.shapes:
            run.value(key)


@pytest.mark.long
@pytest.mark.parametrize("name", ["reader", "tensorboard"])
def test_callbacks_take_less_than_a_millisecond_or_a_hundredth(
    experiment: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The time in the calls of an iteration of about 10 ms. It includes the wait for the values of the update. To be
    measured on an idle machine: `scripts/test -n 0 -s -m long tests/runs/test_callbacks.py -k millisecond`.
    """
    spent, ends, real = [], [], Calls.iteration

    def timed(self: Calls, record: rl.Record) -> None:
        start = time.perf_counter()
        real(self, record)
        ends.append(time.perf_counter())
        spent.append(ends[-1] - start)

    monkeypatch.setattr(Calls, "iteration", timed)
    callback = Reader() if name == "reader" else name
    list(rl.optimize("tiny.yaml", "runs/a", overrides=SET | {"run.iterations": 300}, callbacks=[callback]))
    call, iteration = np.median(spent[50:]), np.median(np.diff(ends)[50:])
    print(f"{name}: {1e3 * call:.3f} ms (mean {1e3 * np.mean(spent[50:]):.3f}) of {1e3 * iteration:.3f} ms")
    assert call < max(1e-3, 0.01 * iteration)


# --- loggers with stand-ins for their packages ------------------------------------------------------------------------


class Entry(SimpleNamespace):
    """Entry of one run on the stand-in for a server."""

    def __init__(self, name: str) -> None:
        super().__init__(name=name, status="RUNNING", params={}, losses={}, images=set())
        self.info = SimpleNamespace(run_id=name + "-id")
        self.id = self.info.run_id


class FakeMLflow:
    """The part of mlflow that is used. `entries` are the runs on the server; `lost` is true without a network."""

    def __init__(self) -> None:
        self.entries: dict[str, Entry] = {}
        self.active: Entry | None = None
        self.lost = False
        self.entities = SimpleNamespace(Metric=lambda *given: given)

    def active_run(self) -> Entry | None:
        return self.active

    @contextlib.contextmanager
    def start_run(self, run_name: str) -> Iterator[Entry]:
        assert self.active is None
        self.active = Entry(f"{run_name}-{len(self.entries)}")
        self.entries[self.active.id] = self.active
        yield self.active
        self.active.status, self.active = "FINISHED", None

    def MlflowClient(self) -> FakeMLflow:
        return self

    def update_run(self, which: str, status: str) -> None:
        self.entries[which].status = status

    def log_param(self, which: str, key: str, value: str) -> None:
        assert self.entries[which].params.setdefault(key, value) == value, "MLflow refuses to change a parameter"

    def log_batch(self, which: str, metrics: list[tuple[str, float, int, int]]) -> None:
        if self.lost:
            raise ConnectionError("no route to host")
        for name, value, at, step in metrics:
            assert abs(at / 1000 - time.time()) < 60
            if name == "loss":
                self.entries[which].losses[step] = value

    def log_image(self, which: str, pixels: Any, file: str) -> None:
        self.entries[which].images.add(file.removesuffix(".png"))

    def set_terminated(self, which: str, status: str) -> None:
        self.entries[which].status = status


class FakeWandB:
    """The part of wandb that is used. Only a run without `create_new` becomes the active `run`."""

    def __init__(self) -> None:
        self.entries: dict[str, Entry] = {}
        self.run: Any = None
        self.lost = False
        self.Image = np.array

    def init(self, project: str, name: str, config: Any, reinit: str, dir: str, id: str = "", resume: str = "") -> Any:
        assert (project, reinit) == ("reslrb", "create_new")
        entry = self.entries[id] if id and resume == "allow" else Entry(f"{name}-{len(self.entries)}")
        self.entries[entry.id], entry.status = entry, "RUNNING"
        entry.params |= config
        entry.log, entry.finish = functools.partial(self._log, entry), functools.partial(self._finish, entry)
        return entry

    def _log(self, entry: Entry, values: dict[str, Any], step: int) -> None:
        if self.lost:
            raise ConnectionError("no route to host")
        entry.images |= {name for name in values if name.startswith(("image/", "value/")) and np.ndim(values[name]) > 1}
        entry.losses |= {step: values["loss"]} if "loss" in values else {}

    def _finish(self, entry: Entry, code: int) -> None:
        entry.status = "FINISHED" if code == 0 else "FAILED"


FAKES = {"mlflow": FakeMLflow, "wandb": FakeWandB}
RECORD = rl.Record(iteration=0, loss=1.0, step_ms=1, codegen_ms=0, elapsed_s=1, peak_mib=1, spp=1, lr=1, grad_norm=1,
                   nonfinite=0, parameter_rmse=None)  # fmt: skip


@pytest.fixture(params=FAKES)
def server(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Any:
    """A stand-in for the package of a logger. `make` makes the logger."""
    fake: Any = FAKES[request.param]()
    monkeypatch.setitem(sys.modules, request.param, fake)
    fake.make = loggers.LOGGERS[request.param]
    return fake


def calls_of(name: str, done: int, *callbacks: rl.Callback, shape: tuple[int, ...] = (1,)) -> Calls:
    settings = {"run.iterations": 9, "run.name": name}
    info = rl.RunInfo(name, Path("runs") / name, settings, 9, done, {"k": shape}, lambda key: np.zeros(shape))
    return Calls(callbacks, info, Manifest("v", "d", 0, "c"))


def iterate(calls: Calls, *iterations: int) -> None:
    for n in iterations:
        calls.iteration(replace(RECORD, iteration=n, loss=float(10 * len(calls._run.name) + n)))


def test_each_run_has_its_entry(server: Any) -> None:
    """Two runs at the same time, of which one is continued in the same process."""
    first, second = server.make(), server.make()
    runs = [calls_of("a", 0, first), calls_of("bb", 0, second)]
    for each in runs:
        each.begin()
        each.image("initial", "", np.zeros((2, 2, 1), np.float32))
    for n in range(3):
        for each in runs:
            iterate(each, n)
    runs[0].end("interrupted")
    again = calls_of("a", 2, first)
    again.begin()
    assert next(iter(server.entries.values())).status == "RUNNING"
    iterate(again, 2, 3)
    iterate(runs[1], 3)
    for each in (again, runs[1]):
        each.end("finished")
    a, b = server.entries.values()
    assert (a.losses, b.losses) == ({n: 10.0 + n for n in range(4)}, {n: 20.0 + n for n in range(4)})
    assert (a.status, b.status) == ("FINISHED", "FINISHED")
    assert (a.params["run.name"], b.params["run.name"]) == ("a", "bb")
    assert len(a.images) == len(b.images) == 1
    calls_of("a", 0, first).begin()  # another run by the same name
    assert len(server.entries) == 3


def test_each_end_has_its_status(server: Any) -> None:
    for status in ("finished", "interrupted", "failed"):
        calls = calls_of(status, 0, server.make())
        calls.begin()
        calls.end(status)
    ended = "KILLED" if isinstance(server, FakeMLflow) else "FAILED"  # W&B knows no interruption
    assert [entry.status for entry in server.entries.values()] == ["FINISHED", ended, "FAILED"]


def test_an_active_run_of_the_script_is_used(server: Any) -> None:
    own = Entry("own")
    server.entries[own.id] = server.active = server.run = own
    own.log = functools.partial(FakeWandB._log, server, own)
    calls = calls_of("a", 0, server.make())
    calls.begin()
    iterate(calls, 0, 1)
    calls.end("finished")
    assert (list(server.entries.values()), sorted(own.losses), own.status) == ([own], [0, 1], "RUNNING")
    assert ("run.name" in own.params) is isinstance(server, FakeMLflow)


@pytest.mark.parametrize(
    ("shape", "names"),
    [
        ((), {"value/k"}),
        ((1,), {"value/k"}),
        ((2,), {"value/k/0", "value/k/1"}),
        ((2, 2, 1), {f"value/k/{n}" for n in range(4)}),
        ((5,), set()),
    ],
)
def test_few_entries_and_the_final_texture_are_logged(server: Any, shape: tuple[int, ...], names: set[str]) -> None:
    logger, found = server.make(), list[set[str]]()
    calls = calls_of("a", 0, logger, shape=shape)
    calls.begin()
    logger._scalars = lambda values, iteration: found.append({name for name in values if name.startswith("value/")})
    iterate(calls, 0)
    assert found == [names]
    calls.end("finished")
    (entry,) = server.entries.values()
    assert entry.images == ({"value/k"} if len(shape) == 3 else set())


def test_a_lost_network_does_not_end_a_run(server: Any, caplog: pytest.LogCaptureFixture) -> None:
    other = Listener()
    calls = calls_of("a", 0, server.make(), other)
    calls.begin()
    iterate(calls, 0)
    server.lost = True
    iterate(calls, 1, 2)
    calls.end("finished")
    (line,) = (each.getMessage() for each in caplog.records)
    assert "no route to host" in line
    assert line.endswith("; the run goes on without this callback")
    assert [each[0] for each in other.calls] == ["begin", "iteration", "iteration", "iteration", "end"]
    (entry,) = server.entries.values()
    assert sorted(entry.losses) == [0]


def test_a_logger_that_cannot_begin_ends_the_run(server: Any) -> None:
    """Nothing is lost yet, and the user can mend it."""
    calls = calls_of("a", 0, server.make())
    server.log_param = server.init = lambda *_, **given: 1 / 0
    with pytest.raises(rl.ConfigError, match="`begin`"):
        calls.begin()


def test_known_errors_and_held_out_losses_are_logged(server: Any) -> None:
    """Values that a run does not have are left out."""
    logger, found = server.make(), list[set[str]]()
    calls = calls_of("a", 0, logger)
    calls.begin()
    logger._scalars = lambda values, iteration: found.append(set(values))
    for known in ({}, {"held_out": 0.5}, {"parameter_rmse": 0.0, "parameter_errors": {"k": 0.0}}):
        calls.iteration(replace(RECORD, **known))
    plain, held_out, errors = found
    assert held_out - plain == {"held_out"}
    assert errors - plain == {"parameter_rmse", "error/k"}


def test_images_of_several_views_are_named_by_their_sensors() -> None:
    for sensors, names in (((3,), {"final"}), ((0, 3), {"final-0", "final-3"})):
        listener = Listener()
        calls_of("a", 0, listener).images("final", dict.fromkeys(sensors, np.zeros((2, 2, 1), np.float32)))
        assert set(listener.images) == names


def test_the_first_error_at_the_end_is_raised() -> None:
    """Every callback is called at the end."""

    class Other(Listener):
        """Another class, which the message names."""

    both = Listener("end"), Other("end")
    with pytest.raises(rl.ConfigError, match="Listener"):
        calls_of("a", 0, *both).end("finished")
    assert [each.calls for each in both] == [[("end", "finished")]] * 2


def test_an_end_without_a_beginning_logs_nothing(server: Any) -> None:
    for each in (server.make(), loggers.TensorBoard("here")):
        calls_of("a", 0, each).end("failed")
    assert server.entries == {}


def test_tensorboard_needs_a_folder() -> None:
    calls = calls_of("a", 0, loggers.TensorBoard())
    calls._run = replace(calls._run, folder=None)
    with pytest.raises(
        rl.ConfigError, match=r"TensorBoard: needs a folder: give the run one, or TensorBoard\(FOLDER\)"
    ):
        calls.begin()


def test_a_name_that_is_given_twice_counts_once(experiment: Path) -> None:
    names = ["tensorboard", "tensorboard"]
    assert len(loggers.callbacks_of(rl.load("tiny.yaml"), names, "--log")) == 1
    both = rl.load("tiny.yaml", {"run.callbacks": ["tensorboard"]})
    assert len(loggers.callbacks_of(both, names, "--log")) == 1
    own = Listener()
    assert loggers.callbacks_of(both, [own, *names, own], "--log")[1:] == [own, own]


def test_tensorboard_hides_the_iterations_that_are_computed_again(tmp_path: Path) -> None:
    from tensorboardX.proto.event_pb2 import Event, SessionLog

    for done in (0, 2):
        calls = calls_of("a", done, loggers.TensorBoard(tmp_path / str(done)))
        calls.begin()
        iterate(calls, done)
        calls.end("finished")
    starts = {}
    for done in (0, 2):
        (file,) = (tmp_path / str(done)).iterdir()
        events = [Event.FromString(content) for content in tf_records(file.read_bytes())]
        starts[done] = [event.step for event in events if event.session_log.status == SessionLog.START]
    assert starts == {0: [], 2: [2]}


# --- the packages -----------------------------------------------------------------------------------------------------


def log_a_run(name: str) -> rl.Run:
    run = rl.optimize("tiny.yaml", "runs/a", overrides=SET, callbacks=[name])
    list(run)
    return run


def test_tensorboard_reads_the_events(experiment: Path) -> None:
    from tensorboardX.proto.event_pb2 import Event
    from tensorboardX.record_writer import masked_crc32c  # noqa: F401  # the format below is TFRecord

    run = log_a_run("tensorboard")
    (file,) = Path("runs/a").glob("events.out.tfevents.*")
    scalars: dict[str, list[float]] = {}
    images: dict[str, bytes] = {}
    for content in tf_records(file.read_bytes()):
        for value in Event.FromString(content).summary.value:
            if value.HasField("image"):
                images[value.tag] = value.image.encoded_image_string
            elif value.HasField("simple_value"):
                scalars.setdefault(value.tag, []).append(value.simple_value)
    np.testing.assert_allclose(scalars["loss"], [record.loss for record in run.records], rtol=1e-6)
    assert scalars[f"value/{LAMP}/1"][-1] == run.parameters[LAMP][1]
    assert set(images) == {"image/target", "image/initial", "image/final", f"value/{POSTER}"}
    np.testing.assert_array_equal(pixels(images[f"value/{POSTER}"]), as_bytes(run.parameters[POSTER]))


@pytest.mark.long
def test_the_tutorial_ends_with_recovered_values_in_tensorboard(
    llvm: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from tensorboardX.proto.event_pb2 import Event

    monkeypatch.chdir(tmp_path)
    page = (ROOT / "docs/tensorboard.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    exec(compile("\n".join(blocks), "tutorial.py", "exec"), {"__name__": "__main__"})
    assert capsys.readouterr().out.splitlines()[-1].startswith("finished ")
    (file,) = Path("runs/room").glob("events.out.tfevents.*")
    values = {value.tag: value for content in tf_records(file.read_bytes())
              for value in Event.FromString(content).summary.value}  # fmt: skip
    red, green, blue = (values[f"value/wall.bsdf.reflectance.value/{n}"].simple_value for n in range(3))
    np.testing.assert_allclose([red, green, blue], [0.8, 0.3, 0.2], atol=0.02)
    assert values["error/floor.bsdf.reflectance.data"].simple_value < 0.03
    assert values["value/floor.bsdf.reflectance.data"].HasField("image")


def tf_records(data: bytes) -> Iterator[bytes]:
    """Yield the contents of the records of a TFRecord file: length, its checksum, content, its checksum."""
    at = 0
    while at < len(data):
        length = int.from_bytes(data[at : at + 8], "little")
        yield data[at + 12 : at + 12 + length]
        at += length + 16


def pixels(png: bytes) -> Any:
    import io

    from PIL import Image

    return np.array(Image.open(io.BytesIO(png)))


@pytest.mark.long
def test_mlflow_has_the_run(experiment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mlflow = pytest.importorskip("mlflow")
    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")  # its database needs more packages
    mlflow.set_tracking_uri((experiment / "mlruns").as_uri())
    run = log_a_run("mlflow")
    assert mlflow.active_run() is None
    (found,) = mlflow.search_runs(output_format="list", search_all_experiments=True)
    assert (found.info.status, found.info.run_name) == ("FINISHED", "a")
    assert found.data.params["run.iterations"] == "3"
    history = mlflow.MlflowClient().get_metric_history(found.info.run_id, "loss")
    assert [(each.step, each.value) for each in history] == [(each.iteration, each.loss) for each in run.records]
    images = {path.name for path in (experiment / "mlruns").rglob("*.png")}
    assert images == {"target.png", "initial.png", "final.png", f"{POSTER}.png"}


@pytest.mark.long
def test_wandb_has_the_run(experiment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wandb = pytest.importorskip("wandb")
    for name, value in {"MODE": "offline", "SILENT": "true", "CONSOLE": "off"}.items():
        monkeypatch.setenv(f"WANDB_{name}", value)
    kept: dict[str, Any] = {}
    finish = wandb.sdk.wandb_run.Run.finish
    monkeypatch.setattr(wandb.sdk.wandb_run.Run, "finish",
                        lambda self, *code: (kept.update(dict(self.summary)), finish(self, *code))[1])  # fmt: skip
    run = log_a_run("wandb")
    assert wandb.run is None
    assert kept["loss"] == run.records[-1].loss
    assert kept[f"value/{LAMP}/0"] == pytest.approx(float(run.parameters[LAMP][0]))
    (written,) = Path("runs/a/wandb").glob("offline-run-*/*.wandb")
    images = {path.name.partition("_")[0] for path in written.parent.rglob("*.png")}
    assert images == {"target", "initial", "final", POSTER}
