"""Results of functions about run folders, states and recordings, as a table of cases (`said.check`)."""

from __future__ import annotations

import errno
import itertools
import json
import os
import re
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from cli import tiny
from golden.cases import Cases, ending
from records.test_metrics import make_record

from reslrb_cli.config.loader import loads, parse_override
from reslrb_cli.records import checkpoint, lock, manifest, run_folder
from reslrb_cli.records.manifest import PROGRAM
from reslrb_cli.runs import callbacks, loggers, prepare, recorder
from reslrb_cli.scene import files

Patch = pytest.MonkeyPatch
case = Cases()


def config_of(*sets: str, text: str = tiny.CONFIG) -> Any:
    for name in ("scene.xml", "target.exr", "values.exr", "own.py"):
        if not Path(name).exists():
            Path(name).write_text("<scene/>" if name.endswith("xml") else name)
    return loads(text, Path("tiny.yaml"), sets)


def tell(found: list[Any]) -> Any:
    """Return functions that collect lines."""
    return lambda line: found.append(str(line))


# ---- Settings and files of runs ----


@case
def changed_settings(patch: Patch) -> Any:
    start, found = config_of(), []
    for sets in (
        (), ("run.iterations=9",), ("run.spp=9",), ("optimizer.learning_rate=0.5",), ("optimizer.type=sgd",),
        ("parameters[0].learning_rate=0.5",), ("parameters[0].initial=0.25",), ("run.name=other",), ("run.output=x",),
        ("run.max_seconds=3",), ("run.certainty=false",), ("run.on_nonfinite=stop",),
        ("run.seed=3", "run.iterations=1"),
        ("run.checkpoint_every={iterations: 3}",), ("scene.file=elsewhere/scene.xml",), ("run.held_out=[]",),
    ):  # fmt: skip
        now = config_of(*sets)
        different = prepare.changes(start, now)
        found.append([sets, different, ending(prepare.check_changes, different, "by {}".format, Path("run"), now)])
    return found


@case
def flat_settings(patch: Patch) -> Any:
    """All settings, as JSON, without those that are not set."""
    found = prepare.flat(config_of("target={file: target.exr}", "parameters[0].initial={file: values.exr}"))
    return json.loads(json.dumps(found))


@case
def moved_files(patch: Patch) -> Any:
    config: Any = SimpleNamespace(paths={"scene.file": 1, "loss.file": 1}, codes={"loss.file": 1})
    pairs = (("a.py:own", "b.py:own"), ("a.py:own", "a.py:other"), ("a", None), (None, "a"), ("a", "b"))
    return [[key, *pair, prepare.moves(key, pair, config)]
            for key in ("scene.file", "loss.file", "run.name") for pair in pairs]  # fmt: skip


@case
def files_of_a_run(patch: Patch) -> Any:
    """Files of initial values do not count. Other files must be there, and unchanged."""
    config = config_of("target={file: target.exr}", "parameters[0].initial={file: values.exr}")
    before = prepare.digests(config)
    found: list[Any] = [sorted(before), ending(prepare.check_files, before, config)]
    Path("values.exr").write_text("changed")
    found.append(ending(prepare.check_files, before, config))
    for name in ("target.exr", "scene.xml"):
        kept = Path(name).read_bytes()
        Path(name).write_text("<scene> </scene>")
        found.append(ending(prepare.check_files, before, config, "run 3"))
        Path(name).unlink()
        found.append(ending(prepare.check_files, before, config, "run 3"))
        Path(name).write_bytes(kept)
    return [*found, ending(prepare.check_files, {**before, "other": "x"}, config)]


@case
def digests_of_files(patch: Patch) -> Any:
    Path("a").write_bytes(b"x" * 3_000_000)
    Path("b").write_bytes(b"x" * 3_000_000 + b"y")
    Path("c").touch()
    found = [files.digest_of(Path(name)) for name in "abc"]
    return [*found, ending(files.digest_of, Path("gone")), files.file_digests({"k": Path("a")})]


@case
def calls_of_a_run(patch: Patch) -> Any:
    given = []
    patch.setattr(prepare, "Calls", lambda *parts: given.append(parts))
    selection = SimpleNamespace(keys=["a", "b"], array=lambda key: np.zeros((2, 3)))
    course = SimpleNamespace(problem=SimpleNamespace(config=config_of("run.name=mine"), selection=selection), done=3,
                             state=SimpleNamespace(values={"a": 1, "b": 2}),
                             shown=lambda values: {key: 10 * value for key, value in values.items()})  # fmt: skip
    prepare.PreparedRun(course, "manifest", nullcontext).calls(["callback"], Path("f"))  # type: ignore[arg-type,list-item]
    [(passed, run, written)] = given
    return [passed, written, run.name, str(run.folder), run.iterations, run.done, run.shapes, run.value("b"),
            run.settings["run.iterations"], len(run.settings)]  # fmt: skip


@dataclass(frozen=True)
class Stage:
    """State after some iterations."""

    iteration: int
    stopped: str = ""
    values: dict[str, int] = field(default_factory=dict)


@case
def progress_of_runs(patch: Patch) -> Any:
    """A state that is put back after an interrupt, cleared of its stop, shown, saved and replaced."""
    done: list[Any] = []
    patch.setattr(prepare, "put", lambda problem, state: done.append(["put", state.iteration]))
    patch.setattr(prepare, "save_checkpoint", lambda *given: done.append(given))
    found = []
    for stopped in ("", "enough"):
        now, other = Stage(3, stopped, {"a": 2}), Stage(4)
        for stands in (now, other, None):
            made = prepare.RunProgress.__new__(prepare.RunProgress)
            made.state, made._settled = now, SimpleNamespace(files={"f": "digest"})  # type: ignore[assignment]
            selection = SimpleNamespace(shown=lambda key, value: f"{key} {value}")
            config = SimpleNamespace(optimizer=SimpleNamespace(learning_rate=0.5))
            made.problem = SimpleNamespace(  # type: ignore[assignment]
                optimizer=SimpleNamespace(stands_at=stands), selection=selection, config=config
            )
            patch.setattr(made, "_entries", lambda state: ({"array": state.iteration}, {"value": 1}), raising=False)
            made.stand()
            made.go_on()
            found.append(
                [made.values(), made.save(Path("x")), made.files, made.state == Stage(3, "", {"a": 2}), made.done]
            )
    notes: list[Any] = []
    made.results = made.nonfinite = made.regularized = SimpleNamespace(add=notes.append)  # type: ignore[assignment]
    see = notes.append
    made.certainty = SimpleNamespace(rates=[], see=lambda *states: see([each.iteration for each in states]))  # type: ignore[assignment]
    made.add(other, make_record(lr=0.25, iteration=3))
    return (
        found,
        done,
        [each if isinstance(each, list) else each.iteration for each in notes],
        made.certainty.rates,
        made.done,
    )


# ---- Run folders ----


def made_run(name: str, values: bool = True, **content: Any) -> Path:
    run = Path(name)
    (run / "checkpoint").mkdir(parents=True)
    (run / "manifest.json").write_text(json.dumps({"program": PROGRAM, "status": "finished", **content}))
    (run / "config.yaml").write_text(tiny.CONFIG.replace("scene.xml", str(Path("scene.xml").absolute())))
    if values:
        checkpoint.save_checkpoint(run / "checkpoint", 2, {"parameter/a.b": np.ones(3), "parameter/c": np.array(2.0)})
    return run


@case
def values_of_runs(patch: Patch) -> Any:
    config_of()
    made_run("run", views=[{"sensor": 0, "exposure": "a.b"}, {"sensor": 2, "exposure": 0.5}, {"sensor": 3}])
    made_run("unsaved", values=False)
    made_run("plain", values=False)
    Path("plain/parameters").mkdir()
    np.savez("plain/parameters/parameters.npz", **{"a.b": np.zeros(3), "parameter/c": np.zeros(1)})
    made_run("old")
    os.rename("old/checkpoint/state.npz", "old/checkpoint/previous.npz")
    made_run("damaged")
    Path("damaged/checkpoint/state.npz").write_bytes(b"PK\x03\x04")
    Path("file").touch()
    Path("empty").mkdir()
    found = []
    for name in ("run", "unsaved", "plain", "old", "damaged", "file", "gone", "empty"):
        found.append([name, ending(lambda name=name: str(run_folder.checkpoint_of(Path(name)))),
                      *(ending(run_folder.read_value, Path(name), key) for key in ("a.b", "c", "a.c")),
                      ending(run_folder.exposures, Path(name))])  # fmt: skip
    return found


@case
def killed_runs(patch: Patch) -> Any:
    """Readers correct the status of a run that was killed, and store it. Others only see it."""
    here = lock.Holder.here(locked=False)
    readers = {
        "folder": run_folder._manifest_of,
        "reader": manifest.read_manifest,
        "guest": partial(manifest.read_manifest, mend=False),
        "opened": opened_content,
    }
    found = []
    for pid in (os.getpid(), 2**22 + 1):
        for name, read in readers.items():
            run = made_run(f"{name} {pid == os.getpid()}", status="running", process={**vars(here), "pid": pid})
            Path(run, "metrics.jsonl").write_text('{"iteration": 0}\n{"iter')
            Path(run, ".x.3.part").touch()
            content = ending(read, run)
            stored = manifest.read_content(run) or {}
            told = content if isinstance(content, str) else [content["status"], content.get("error")]
            left = [Path(run, "metrics.jsonl").read_text()[-5:], Path(run, ".x.3.part").exists()]
            found.append([run.name, told, stored["status"], *left])
    return found


def opened_content(run: Path) -> Any:
    with run_folder.opened(run) as (_, content):
        return content


@case
def recovered_configurations(patch: Patch) -> Any:
    config_of()
    made_run("run")
    found = []
    for sets in ([], ["run.spp=3"], ["parameters[0].initial=3"], [parse_override("parameters=[{key: a, initial: 3}]")],
                 ["parameters=[{key: a}]"]):  # fmt: skip
        config = ending(run_folder.recovered, Path("run"), sets)
        if not isinstance(config, str):
            config = [config.run.spp, [[spec.key, str(spec.initial.run)] for spec in config.parameters]]
        found.append(config)
    return found


@case
def moved_configurations(patch: Patch) -> Any:
    """Settings name the new places only of files that have moved with the run."""
    Path("old/data").mkdir(parents=True)
    os.chdir("old")
    for name in ("data/scene.xml", "data/stays.exr"):
        Path(name).write_text("<scene/>")
    text = prepare.dump(config_of("scene.file=data/scene.xml", "target={file: data/stays.exr}", "run.output=runs"))
    made_run("runs/tiny")
    Path("runs/tiny/config.yaml").write_text(text)
    os.chdir("..")
    os.rename("old", "new")
    Path("old/data").mkdir(parents=True)
    os.rename("new/data/stays.exr", "old/data/stays.exr")
    config = run_folder.read_config(Path("new/runs/tiny"), ["run.spp=3"])
    return {key: str(path) for key, path in config.paths.items()}, config.run.spp


@case
def users_of_folders(patch: Patch) -> Any:
    here = lock.Holder.here(locked=True)
    processes = (None, vars(here), {**vars(here), "locked": False}, {**vars(here), "pid": -3, "host": "h"}, {"host": 3})
    found = [run_folder._who_works({"process": each, "started": "then"}) for each in processes]
    for number in (errno.EACCES, errno.ENOSPC, errno.EROFS):
        error = run_folder._output_error("c.yaml", Path("x"), OSError(number, os.strerror(number)))
        found.append(f"{type(error).__name__}: {error}")
    return found


@case
def new_folders(patch: Patch) -> Any:
    found: list[Any] = []
    patch.setattr(run_folder, "FolderLock", partial(run_folder.FolderLock, wait_s=0))
    Path("runs/b").mkdir(parents=True)
    Path("runs/b-2").symlink_to("gone")
    for name in ("a", "a", "b", "a", "x" * 300):
        made = manifest.Manifest("v", "d", 3, "c.yaml")
        made.process = lock.Holder("other", 1, None, False)
        run = ending(run_folder.RunFolder.create, "c.yaml", Path("runs"), name, "text", made)
        if isinstance(run, str):
            found.append(run)
            continue
        found.append([str(run.path), sorted(os.listdir(run.path)), made.process == lock.Holder.here(locked=True),
                      run.is_there, run.fault, (run.path / "config.yaml").read_text()])  # fmt: skip
        os.rename(run.path, "away")
        Path(run.path).mkdir()
        found.append([run.is_there, str(run.fault)])
        os.rmdir(run.path)
        os.rename("away", run.path)
        run_folder.link_latest(run.path)
        found.append([os.readlink("runs/latest"), ending(lambda path=run.path: run_folder.opened(path).__enter__())])
        with run:
            pass
        with run_folder.opened(Path("runs/latest")) as (again, content):
            found.append([again.path.name, again.path.is_absolute(), content["seed"], again == run])
    return found, sorted(os.listdir("runs"))


@case
def links_to_the_newest_run(patch: Patch) -> Any:
    for name in ("a", "b", "latest"):
        Path("plain", name).mkdir(parents=True)
        Path("runs", name).mkdir(parents=True) if name != "latest" else None
    run_folder.link_latest(Path("plain/a"))
    run_folder.link_latest(Path("runs/a"))
    first = os.readlink("runs/latest")
    run_folder.link_latest(Path("runs/b"))
    return Path("plain/latest").is_symlink(), first, os.readlink("runs/latest"), sorted(os.listdir("runs"))


@case
def folders_that_are_continued(patch: Patch) -> Any:
    """Subfolders are made, unfinished files and lines are removed, and the process is noted."""
    run = made_run("run")
    for name in (".x.3.part", "images/.y.4.part", "images/kept"):
        Path(run / name).parent.mkdir(exist_ok=True)
        Path(run / name).touch()
    Path("run/metrics.jsonl").write_text('{"iteration": 0}\n{"iter')
    with lock.FolderLock(run) as held:
        folder = run_folder.RunFolder(run, held)
        run_folder.check_writable(folder)
        made = manifest.Manifest("v", "d", 3, "c.yaml")
        run_folder.write_beginning(folder, "new: text", made)
        inside = sorted(str(path) for path in run.rglob("*"))
        alone = manifest.Manifest("v", "d", 3, "c.yaml")
        run_folder.write_beginning(run_folder.RunFolder(run), "new: text", alone)
    texts = [Path("run", name).read_text() for name in ("metrics.jsonl", "config.yaml")]
    processes = [made.process == lock.Holder.here(locked=True), alone.process.locked]
    return [inside, texts, processes, sorted(manifest.read_content(run) or ())]


@case
def folders_without_writing(patch: Patch) -> Any:
    """Each subfolder may be read-only, full, or a file."""
    found: list[Any] = []
    made = run_folder.tempfile.TemporaryFile
    for place in (".", *run_folder.SUBFOLDERS):
        for code in (errno.EROFS, errno.EACCES, errno.ENOSPC, errno.EIO):

            def refused(dir: Path, place: str = place, code: int = code) -> Any:
                if Path(dir) == Path("run", place):
                    raise OSError(code, os.strerror(code))
                return made(dir=dir)

            Path("run").mkdir(exist_ok=True)
            patch.setattr(run_folder.tempfile, "TemporaryFile", refused)
            ended = ending(run_folder.check_writable, run_folder.RunFolder(Path("run")))
            found.append([place, errno.errorcode[code], ended])
        patch.setattr(run_folder.tempfile, "TemporaryFile", made)
        if place != ".":
            os.rename(Path("run", place), "aside")
            Path("run", place).touch()
            found.append([place, "file", ending(run_folder.check_writable, run_folder.RunFolder(Path("run")))])
            Path("run", place).unlink()
    return found


@case
def folders_that_are_there(patch: Patch) -> Any:
    """A folder is there under its name and behind links, but not in another place, nor another folder of its name."""
    Path("link").symlink_to("run")
    Path("above").symlink_to(".")
    found = []
    for name in ("run", "link", "above/run", "above/link"):
        for locked in (True, False):
            Path("run").mkdir()
            with lock.FolderLock(Path("run")) if locked else nullcontext(None) as held:
                folder, seen = run_folder.RunFolder(Path(name), held), []
                for change in (lambda: None, lambda: os.rename("run", "moved"), Path("run").mkdir, Path("run").rmdir,
                               lambda: os.rename("moved", "run"), Path("run").rmdir, Path("run").touch):  # fmt: skip
                    change()
                    seen.append([folder.is_there, str(folder.fault)])
            Path("run").unlink()
            found.append([name, locked, seen])
    return found


@case
def beginnings_of_recordings(patch: Patch) -> Any:
    """All that a recording writes before the first iteration, with and without weights and true values."""
    found: list[Any] = []

    def noted(name: str) -> Any:
        return lambda *given: found.append([name, *(str(each) if isinstance(each, Path) else each for each in given)])

    for name in ("write_image", "write_parameters", "write_mask"):
        patch.setattr(recorder, name, noted(name))
    for weights, truth in ((None, {}), (np.array([[0.0, 0.5]]), {"a": 1.0})):
        views = [SimpleNamespace(sensor=sensor, target=[[sensor, 2.0]], weights=weights) for sensor in (0, 3)]
        problem = SimpleNamespace(views=views, truth=truth, masks={"a": "mask"}, values=lambda: "values")
        names = {name: noted(name) for name in ("_save_checkpoint", "_write_image", "_write_images")}
        stub: Any = SimpleNamespace(
            **names, problem=problem, _image_name=lambda name, sensor: f"{name} {sensor}",
            folder=SimpleNamespace(parameters=Path("p"), images=Path("i")),
        )  # fmt: skip
        recorder.Recording._begin(stub)
        found.append("end")
    return found


@case
def failures_at_the_end(patch: Patch) -> Any:
    """Each measurement that fails is told once, and the results so far are kept after each."""
    found: list[Any] = []
    patch.setattr(recorder.logger, "warning", found.append)
    stub: Any = SimpleNamespace(unmeasured=[], _note_results=lambda: found.append("kept"))
    for text in ("first", "", "second"):
        recorder.Recording._add(
            stub, f"{text} failed", lambda text=text: int(text) if text else found.append("measured")
        )
    return found, stub.unmeasured


@case
def outputs_of_runs(patch: Patch) -> Any:
    Path("file").touch()
    Path("link").symlink_to("gone")
    names = ("a/b/c", ".", "file", "file/x", "link", "link/x")
    found = [ending(run_folder.check_output, "c.yaml", Path(name)) for name in names]
    patch.setattr(run_folder, "unfinished_folder", full_disk)
    return [*found, ending(run_folder.check_output, "c.yaml", Path()), sorted(os.listdir())]


@contextmanager
def full_disk(folder: Path) -> Any:
    raise OSError(errno.ENOSPC, "No space left on device")
    yield folder


# ---- Recordings ----


def recording(**more: Any) -> Any:
    """Return a recording of a pretended run."""
    found = recorder.Recording.__new__(recorder.Recording)
    parts = {"folder": run_folder.RunFolder(Path("run")), "manifest": manifest.Manifest("v", "d", 3, "c.yaml"),
             "said": [],
             "unmeasured": [], "certainty": None, "error_maps": {}, "seen": {}, "initial": {}, "_saved": None,
             "_told_nonfinite": False, "calls": SimpleNamespace(image=lambda *_: None)}  # fmt: skip
    vars(found).update(parts | more)
    return found


def course_of(*sets: str, done: int = 3, stopped: str = "", **problem: Any) -> Any:
    views = [SimpleNamespace(sensor=0), SimpleNamespace(sensor=2)]
    tallies = {name: SimpleNamespace(iterations=2, to_json=lambda name=name: f"the {name}") for name in
               ("nonfinite", "regularized")}  # fmt: skip
    ended: list[bool] = []
    results = SimpleNamespace(end=lambda: ended.append(True), to_json=lambda: {"loss_trend": len(ended)})
    last = make_record(iteration=done - 1, loss=float("nan"))
    return SimpleNamespace(
        problem=SimpleNamespace(config=config_of(*sets), **{"views": views, "masks": {}, **problem}), done=done,
        state=SimpleNamespace(stopped=stopped), results=results, last=last if done else None, **tallies,
    )  # fmt: skip


@case
def results_of_a_recording(patch: Patch) -> Any:
    patch.setattr(recorder, "warnings", lambda results: sorted(results))
    certainty = SimpleNamespace(to_json=lambda: {"share": float("inf")})
    made = recording(course=course_of())
    made.manifest.incomplete = [{"parameter": "a"}]
    full = recording(course=course_of(stopped="enough"), certainty=certainty, unmeasured=["b"], seen={"-0": 1})
    recordings = [made, full, recording(course=course_of(done=0))]
    for design, certain in itertools.product((None, "lens"), (False, True)):
        course = course_of()
        course.problem.config = SimpleNamespace(fabrication=design, run=SimpleNamespace(certainty=certain))
        recordings.append(recording(course=course))
    return [each._found() for each in recordings]


@case
def final_images(patch: Patch) -> Any:
    """The manifest gets the results after the images are written."""
    made = recording(course=course_of(), _found=lambda: found.copy(), _write_images=lambda name: found.append(name))
    found: list[str] = []
    made._write_final_images()
    return made.manifest.results


@case
def measured_scales(patch: Patch) -> Any:
    lines: list[Any] = []
    patch.setattr(recorder.logger, "log", lambda level, line: lines.append([level, line]))
    patch.setattr(recorder, "scale_line", lambda row: f"curvature {row.curvature}")
    made = recording(course=course_of("optimizer={type: sgd, scale: curvature}"))
    rows = [SimpleNamespace(curvature=each, to_json=lambda each=each: {"curvature": each}) for each in (None, 0.0, 2.0)]
    made._tell_scaling(rows)
    return lines, made.manifest.scaling


# ---- Callbacks ----


def callback_of(module: str, optional: bool) -> Any:
    """Return a callback from a module of this name that fails."""

    def fail(self: object, *given: object) -> None:
        raise ValueError("no")

    parts = {"__module__": module, "optional": optional, "begin": fail, "iteration": fail}
    return type("Own", (callbacks.Callback,), parts)()


@case
def failing_callbacks(patch: Patch) -> Any:
    """Callbacks from a file, and from a module without a file. The run goes on without optional ones."""
    lines: list[Any] = []
    patch.setattr(callbacks.logger, "warning", lambda *given: lines.append([*map(str, given)]))
    found = []
    for module, optional, name in itertools.product((__name__, "nowhere"), (False, True), ("begin", "iteration")):
        one = callback_of(module, optional)
        calls = callbacks.Calls([one, callbacks.Callback()], "run", "manifest")  # type: ignore[arg-type]
        end = str(ending(calls._call, one, name))
        found.append([module != "nowhere", optional, name, end, len(calls._callbacks)])
    return json.loads(re.sub(r"line \d+", "line N", json.dumps([found, lines])))


@case
def given_callbacks(patch: Patch) -> Any:
    own = callback_of("nowhere", False)
    found = []
    for given in ("text", 3, (), [own], [own, own], [callbacks.Callback], [int], [3], ["nobody"], ["a.py:Own"]):
        made = ending(loggers.callbacks_of, config_of(), given, "--log")
        found.append(made.split(" at 0x")[0] if isinstance(made, str) else [type(each).__name__ for each in made])
    return found


@case
def names_of_images(patch: Patch) -> Any:
    one = course_of(views=[SimpleNamespace(sensor=2)])
    return [[recording(course=course)._image_name(name, 2) for name in ("final", "")] for course in (course_of(), one)]


@case
def the_saved_state_of_a_recording(patch: Patch) -> Any:
    made = recording(course=course_of())
    found = [made._kept()]
    made._saved = 2
    found.append(made._kept())
    made_run("run")
    return [*found, made._kept()]


@case
def measurements_of_certainty(patch: Patch) -> Any:
    found = []
    for sets, done, by_pixel in (((), 20, True), ((), 1, True), (("run.certainty=false",), 20, True), ((), 20, False),
                                 ((), 0, True)):  # fmt: skip
        asked: list[Any] = []
        measured = SimpleNamespace(without_derivatives=lambda keys, asked=asked: asked.append(keys) or "certain")
        course = course_of(*sets, done=done, take_left_out=lambda: {"a": 2}, masks={"k": 1}, interrupted="asks")
        course.problem.config = SimpleNamespace(run=course.problem.config.run, by_pixel=by_pixel)
        course.certainty = SimpleNamespace(
            measure=lambda *given, asked=asked, measured=measured: asked.append(given) or measured,
            shown={"k": 1, "l": 2}, misfits={2: "the misfit of 2"},
        )  # fmt: skip
        patch.setattr(recorder, "write_mask", lambda folder, key, mask, asked=asked: asked.append([key, mask]))
        patch.setattr(recorder, "write_file", lambda *given, asked=asked, **more: asked.append([*given, more]))
        made = recording(course=course)
        Path("run/images").mkdir(parents=True, exist_ok=True)
        for sensor in (0, 2):
            Path(f"run/images/{made._image_name('misfit', sensor)}.exr").touch()
        made._measure_certainty()
        left = sorted(os.listdir("run/images"))
        found.append([asked, made.certainty, made.unmeasured, left])
    return found


@case
def values_that_are_not_finite(patch: Patch) -> Any:
    lines: list[str] = []
    patch.setattr(recorder.logger, "warning", tell(lines))
    for sets in ((), ("run.on_nonfinite=stop",)):
        made = recording(course=course_of(*sets))
        for number in (1, 2):
            made._on_nonfinite(f"{number} of {sets}")
    return lines


@case
def stopped_runs(patch: Patch) -> Any:
    """The line about a run that has stopped by itself."""
    lines: list[str] = []
    patch.setattr(recorder.logger, "info", tell(lines))
    patch.setattr(recorder, "iterate", lambda *given: iter([len(given)]))
    found = [[*recording(course=course_of(stopped=why))._iterations()] for why in ("", "enough")]
    return found, lines


@case
def live_pages(patch: Patch) -> Any:
    written: list[Any] = []
    patch.setattr(recorder, "write_report", lambda *given: written.append([str(given[0]), *given[1:]]))
    for done in (0, 3):
        made = recording(course=course_of(done=done, values=lambda: {"a": 1}), _found=lambda: {"b": 2})
        made.manifest = SimpleNamespace(content=lambda: {"results": {}, "seed": 3})
        made._write_live_page()
    return written


@case
def abandoned_recordings(patch: Patch) -> Any:
    ends: list[Any] = []
    for done, results, is_there in ((3, {}, True), (0, {}, True), (3, {"a": 1}, True), (3, {}, False)):
        made = recording(course=course_of(done=done), folder=SimpleNamespace(path="p", is_there=is_there))
        made.manifest = SimpleNamespace(results=results, end_for_good=lambda *given: ends.append(given))
        made.abandon()
        ends.append(sorted(made.manifest.results))
    return ends


@case
def engines_of_clusters(patch: Patch) -> Any:
    """The threads of a worker, and whether the workers belong to the run."""
    engine = pytest.importorskip("reslrb_cli.cluster.engine")
    patch.setattr(os, "sched_getaffinity", lambda process: set(range(8)), raising=False)
    patch.setattr(engine, "connected", lambda place: nullcontext(("client", Path("folder"))))
    patch.setattr(engine, "workload_of", lambda course, folder, threads, own: [course, str(folder), threads, own])
    patch.setattr(engine, "Workers", lambda *given: list(given[:2]))
    found = []
    for place in (engine.Cluster(2), engine.Cluster(9), engine.Cluster(address="tls://a:1")):
        for threads in (None, 1, 3):
            with engine.engine_at("course", place, threads) as workers:
                found.append(workers)
    return found


test_cases = pytest.mark.usefixtures("llvm")(case.test())
