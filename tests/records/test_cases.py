"""Results of functions about files of metrics, measurements and decisions, and locks, as a table of cases
(`said.check`).
"""

from __future__ import annotations

import errno
import itertools
import json
import os
import subprocess
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from golden.cases import Cases, ending
from records.test_metrics import make_record

from reslrb_cli.cli import options
from reslrb_cli.records import (
    atomic,
    checkpoint,
    decisions,
    images,
    lock,
    manifest,
    measurement_files,
    measurements,
    metrics,
    sweeps,
    tree,
)  # fmt: skip
from reslrb_cli.records.measurements import Line

Patch = pytest.MonkeyPatch
case = Cases()


class Plain(Line):
    """Line of a file of measurements."""

    def __init__(self, text: str) -> None:
        self.text = text

    def to_json(self) -> str:
        return self.text


def content() -> dict[str, Any]:
    """Return the files of the working directory with their text, and links."""
    return {name: f"link to {os.readlink(name)}" if os.path.islink(name) else Path(name).read_text()
            for name in sorted(os.listdir()) if Path(name).is_file() or os.path.islink(name)}  # fmt: skip


# ---- Metrics ----


@case
def written_metrics(patch: Patch) -> Any:
    """After a torn line, in a new file, on a full disk that takes three bytes, and in a file that was removed."""
    found: list[Any] = []
    for before in (None, b"", b'{"iteration": 0}\n', b'{"iteration": 0}\n{"iter'):
        Path("metrics.jsonl").unlink(missing_ok=True)
        if before is not None:
            Path("metrics.jsonl").write_bytes(before)
        synced: list[int] = []
        patch.setattr(os, "fsync", synced.append)
        with metrics.MetricsWriter(Path()) as writer:
            writer.sync()
            writer.write(make_record(iteration=1))
            writer.write(make_record(iteration=2))
            writer.sync()
            found.append([Path("metrics.jsonl").read_bytes().count(b"\n"), len(synced)])
            write, sizes = os.write, [3]

            def full(number: int, data: bytes, write: Any = write, sizes: Any = sizes) -> int:
                if not sizes:
                    raise OSError(errno.ENOSPC, "No space left on device")
                return int(write(number, data[: sizes.pop()]))

            patch.setattr(os, "write", full)
            found.append([ending(writer.write, make_record(iteration=3)), Path("metrics.jsonl").read_bytes()[-1:]])
            patch.setattr(os, "write", write)
            os.unlink("metrics.jsonl")
            found.append([ending(writer.write, make_record(iteration=3)), os.path.exists("metrics.jsonl")])
    return found


@case
def cut_metrics(patch: Patch) -> Any:
    line = '{{"iteration": {}}}\n'.format
    texts = (None, "", line(0) + line(1) + line(2), line(0) + "x\n" + line(1), line(1) + line(0), line(0) * 2 + line(1),
             line(0) + '{"iteration": 1}', line(0) + line(2), "[0]\n", '{"iteration": 0.0}\n')  # fmt: skip
    found = []
    for text in texts:
        for count in (0, 1, 2, 5):
            Path("metrics.jsonl").unlink(missing_ok=True)
            if text is not None:
                Path("metrics.jsonl").write_text(text)
            found.append([metrics.cut_back(Path(), count), content()])
    return found


@case
def mended_metrics(patch: Patch) -> Any:
    found = []
    for text in ("", "a", "a\n", "a\nb", "a\nb\n", "\n"):
        Path("metrics.jsonl").write_text(text)
        metrics.mend(Path())
        found.append(Path("metrics.jsonl").read_text())
    return [*found, ending(metrics.mend, Path("gone"))]


@case
def iterations_of_lines(patch: Patch) -> Any:
    lines = ('{"iteration": 3}\n', '{"iteration": 3}', '{"iteration": "3"}\n', '{"iteration": null}\n', "{}\n", "[1]\n",
             "3\n", "x\n", "\n", "[" * 100000 + "\n")  # fmt: skip
    return [metrics._iteration_of(line.encode()) for line in lines]


# ---- Measurements ----


@case
def lines_of_measurements(patch: Patch) -> Any:
    texts = (b"", b'{"a": 1}\n', b'{"a": 1}\n{"a": 2}', b'{"a": NaN, "b": [1e999, -Infinity, 2.5]}\n', b"\n \n{}\n",
             b"[1]\n", b'x\n{"a": 1}\n\xff\n', b"[" * 100000 + b"\n")  # fmt: skip
    found = []
    for text in texts:
        Path("a").write_bytes(text)
        lost: list[int] = []
        found.append(
            [ending(measurement_files.read_lines, Path("a")), measurement_files.read_lines(Path("a"), lost), lost]
        )
    return [*found, ending(measurement_files.read_lines, Path("gone"))]


@case
def files_of_measurements(patch: Patch) -> Any:
    """Into a new file, a file, a link, a link to nowhere, a pipe, and a file that cannot be replaced."""
    Path("old").write_text("old")
    Path("link").symlink_to("target")
    Path("target").write_text("old")
    Path("lost").symlink_to("nowhere")
    os.mkfifo("pipe")
    reader = os.open("pipe", os.O_RDONLY | os.O_NONBLOCK)
    lines = [Plain("1"), Plain("2")]
    found = [
        ending(measurement_files.write_lines, Path(name), lines)
        for name in ("new", "old", "link", "lost", "pipe", "a/b")
    ]
    read = os.read(reader, 99).decode()
    os.close(reader)

    def refuse(*_: object) -> None:
        raise OSError(errno.EBUSY, "Device or resource busy")

    def fill(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    for failure in (refuse, fill):
        patch.setattr(measurement_files, "write_atomically", failure)
        found.append(ending(measurement_files.write_lines, Path("old"), [Plain("3")]))
    streams = [measurement_files.is_stream(Path(name)) for name in ("old", "pipe", "gone", "link", ".")]
    return found, read, content(), streams


@case
def kept_measurements(patch: Patch) -> Any:
    """A measurement that ends or is interrupted. The earlier file is missing, empty, or has lines."""
    now = [100.0]
    patch.setattr(measurement_files, "time", SimpleNamespace(monotonic=lambda: now[0]))
    told: list[str] = []
    patch.setattr(options, "echo", told.append)
    found: list[Any] = []
    for before in (None, "", "old\n"):
        for interrupted in (False, True):
            for name in list(content()):
                os.unlink(name)
            if before is not None:
                Path("m.jsonl").write_text(before)
            lines: list[Any] = []
            keeper = options.Keeper(Path("m.jsonl"), Plain("origin"), lambda lines=lines: lines)  # type: ignore[misc]
            for second in (0, 1, 10):
                now[0] += second
                lines.append(Plain(str(second)))
                keeper.refresh()
                found.append(content())
            keeper.finish(interrupted)
            found.append([content(), told.copy()])
            told.clear()
    nothing = options.Keeper(None, Plain("origin"), list)
    nothing.refresh()
    nothing.finish(True)
    return found, content()


@case
def records_of_lines(patch: Patch) -> Any:
    """Records as they are written, with more keys, of older versions, and damaged."""
    missing = {"case": "c", "parameter": "k", "share": 0.25, "standard_error": 0.01, "directions": 2, "seeds": 8}
    bench = {"label": "a", "options": {"x": 1}, "spp": 4, "status": "ok", "width": 8, "height": None, "texels": 3}
    old = {name: each for name, each in bench.items() if name not in ("label", "options")}
    found = []
    for kind, entry in (
        (measurements.MissingRecord, missing), (measurements.BenchRecord, bench),
        (measurements.BenchRecord, bench | {"later": 3, "step_ms": {"median": 1, "min": 0.5, "max": 2}}),
        (measurements.BenchRecord, old),
        (measurements.BenchRecord, old | {"integrator": "reslrb", "estimator": "stack"}),
        (measurements.BenchRecord, old | {"integrator": "prb", "estimator": None}), (measurements.BenchRecord, {}),
        (measurements.BenchRecord, bench | {"spp": "x"}), (measurements.BenchRecord, bench | {"status": "odd"}),
    ):  # fmt: skip
        found.append(str(measurements.record_of(kind, entry)))
    entries = [missing, missing | {"share": 0.0}, missing | {"share": None}, {"odd": 3}]
    return found, [record.share for record in measurements.incomplete_records(entries)]


@case
def pages_in_progress(patch: Patch) -> Any:
    """The times at which a page is written that takes 0.1 or 2 seconds, with different shares, until it fails."""
    now, found = [0.0], []
    patch.setattr(measurement_files, "time", SimpleNamespace(monotonic=lambda: now[0]))
    for takes, share in ((0.1, None), (2.0, None), (2.0, 5.0), (0.5, 30.0)):
        now[0], written = 0.0, list[float]()

        def write(takes: float = takes, written: list[float] = written) -> None:
            written.append(round(now[0], 3))
            now[0] += takes
            if len(written) == 4:
                raise OSError

        page = measurement_files.LivePage(write, share=share)
        while now[0] < 300:
            page.refresh()
            now[0] += 0.5
        found.append(written)
    return found


# ---- Masks and commits ----


@case
def masks_of_parameters(patch: Patch) -> Any:
    """Masks of a texture and of a mesh, with letters that a name of a file cannot have, and damaged ones."""
    found: list[Any] = []
    for key, mask in (("a.b", np.array([True, False, True])), ("a/b c", np.array([[True, False], [False, True]]))):
        found.append(images.read_mask(Path(), key))
        images.write_mask(Path(), key, mask)
        found += [images.read_mask(Path(), key), sorted(os.listdir())]
    for name, content in (("empty", b""), ("torn", Path("a.b.mask.npy").read_bytes()[:-1]), ("pickle", b"\x80\x04")):
        Path(f"{name}.mask.npy").write_bytes(content)
        found.append(images.read_mask(Path(), name))
    np.save("numbers.mask.npy", np.ones(3))
    return [*found, images.read_mask(Path(), "numbers")]


@case
def commits_of_folders(patch: Patch) -> Any:
    """Git answers, finds no commit, is missing, or is too slow."""
    asked: list[Any] = []

    def answer(words: Any, given: Any = None, **more: Any) -> Any:
        asked.append([words, more])
        if isinstance(given, Exception):
            raise given
        return SimpleNamespace(stdout=given)

    found = []
    for given in ("abc\n", "", FileNotFoundError("git"), subprocess.TimeoutExpired("git", 10), ValueError("null byte")):
        patch.setattr(manifest.subprocess, "run", partial(answer, given=given))
        found.append(manifest.commit_of(Path("a")))
    return found, asked[0]


# ---- Decisions, locks and unfinished files ----


@case
def decisions_in_files(patch: Patch) -> Any:
    cache = decisions.DecisionCache(Path("a/b"))
    made = decisions.Decision(setting="s", value="v", why="w", gain=1.5, seconds=2.0)
    found: list[Any] = [cache.get("k")]
    patch.setattr(decisions, "MOST", 3)
    for key in ("k", "l", "m", "k", "n"):
        cache.put(key, made)
        found.append([*cache._read()])
    found += [cache.get("k") == made, cache.get("l"), sorted(os.listdir("a/b"))]
    for text in ("", "[]", '{"k": 3}', '{"k": {"setting": "s"}}', '{"k": null}'):
        Path("a/b/decisions.json").write_text(text)
        found.append([cache.get("k"), len(cache._read())])
    Path("file").touch()
    decisions.DecisionCache(Path("file/x")).put("k", made)
    keys = [decisions.key_of(what) for what in ({"a": 1, "b": 2}, {"b": 2, "a": 1}, {"a": 1, "b": 3}, {"a": Path("x")})]
    return found, keys[0] == keys[1], keys


@case
def holders_of_locks(patch: Patch) -> Any:
    """For each kind of holder: whether it has certainly ended, with and without a lock on the folder."""
    here = lock.Holder.here(locked=False)
    patch.setattr(lock, "_is_alive", lambda process: process > 0)
    patch.setattr(lock, "READER_WAIT_SECONDS", 0)
    Path("run").mkdir()
    found = []
    rows = itertools.product((here.host, "other"), (1, -1), (here.boot, "another", None), (False, True), (False, True))
    for host, pid, boot, locked, held in rows:
        holding = lock.FolderLock(Path("run")) if held else None
        for major in (8, 0):  # a disk of this machine, and one of a network
            patch.setattr(lock.os, "major", lambda device, major=major: major)
            is_gone = lock.Holder(host, pid, boot, locked).is_gone(Path("run"))
            found.append([host == here.host, pid, boot == here.boot, locked, held, major, is_gone])
        if holding is not None:
            holding.release()
    return [*found, lock.Holder(here.host, -1, here.boot, True).is_gone(Path("gone"))]


@case
def unfinished_files(patch: Patch) -> Any:
    known = atomic.unfinished.copy()
    found: list[Any] = []
    for fails in (False, True):
        for durable in (False, True):

            def write(file: Any, fails: bool = fails) -> None:
                found.append([len(atomic.unfinished - known), sorted(os.listdir())[0].endswith(".part")])
                file.write(b"x")
                if fails:
                    raise OSError(errno.ENOSPC, "No space left on device")

            found.append(ending(atomic.write_atomically, Path("a"), write, durable))
            found.append([sorted(os.listdir()), atomic.unfinished == known])
    with atomic.unfinished_folder(Path()) as folder:
        found.append([folder.name.startswith(".reslrb-"), atomic.unfinished - known == {folder}])
        (folder / "x").touch()
        atomic.remove_unfinished()
        found.append(folder.exists())
    with pytest.raises(ZeroDivisionError), atomic.unfinished_folder(Path()):
        raise ZeroDivisionError
    with atomic.unfinished_folder(Path()) as folder:
        folder.rename("named")
    for name in (".a.3.part", "named/.b.4.part", ".c.x.part", "d.3.part", "named/.e.5.part.x"):
        Path(name).touch()
    atomic.remove_parts(Path())
    return [*found, sorted(map(str, Path().rglob("*"))), atomic.unfinished == known]


@case
def errors_of_writing(patch: Patch) -> Any:
    denied = (errno.EACCES, "Permission denied")
    failures = (OSError(*denied, "x"), OSError(*denied), RuntimeError("no"),
                OSError(errno.ENOSPC, "No space left on device"), ValueError("no"))  # fmt: skip

    def fail(error: Exception) -> None:
        with atomic.writing("--json", Path("f")):
            raise error

    return [ending(fail, error) for error in failures]


# ---- States ----


@case
def states_of_a_folder(patch: Patch) -> Any:
    Path("c").mkdir()
    found = [str(checkpoint.newest_checkpoint(Path("c")))]
    for number in (1, 2, 3):
        checkpoint.save_checkpoint(Path("c"), number, {"x": np.full(2, number)}, {"y": number} if number > 1 else None)
        found.append([name, ending(checkpoint.read_state, Path("c", name))] for name in sorted(os.listdir("c")))
        found[-1] = list(found[-1])
    sizes: list[str] = []
    patch.setattr(checkpoint.os, "replace", lambda a, b: sizes.append(f"{Path(a).suffix} to {Path(b).name}"))
    checkpoint.save_checkpoint(Path("c"), 4, {})
    return [*found, sizes, str(checkpoint.newest_checkpoint(Path("c")))]


@dataclass
class Branch:
    """Tree with fields of each kind."""

    number: float
    word: str = "w"
    arrays: dict[str, Any] = field(default_factory=dict, metadata=tree.entry("arrays of it"))
    aside: Any = field(default=None, metadata=tree.PASSING)


@case
def trees_in_files(patch: Patch) -> Any:
    leaves = {"a": mi.Float([1, 2, 3]), "b": {"c": mi.Color3f(1, 2, 3), "d": mi.Float(7)},
              "e": mi.TensorXf(np.arange(6.0).reshape(2, 3))}  # fmt: skip
    arrays, values = tree.entries(Branch(float("inf"), arrays=leaves, aside=object()), Branch(2.0, "last"))
    checkpoint.save_checkpoint(Path(), 3, arrays, values)
    stored = tree.Stored(Path(checkpoint.STATE_FILE))
    back = stored.fill(Branch(0.0, arrays=leaves)).arrays
    literal = [each.state == dr.VarState.Literal for each in (back["b"]["d"], back["a"])]
    found: list[Any] = [sorted(arrays), values, stored.read(Branch), back["b"]["c"], type(back["e"]).__name__, literal]
    others = ({"z": None}, {"a": mi.Float([1, 2])}, {"a": np.zeros((3, 1))}, {"a": None}, {"e": tree.expected((2, 3))})
    for other in others:
        found.append(ending(lambda other=other: stored.fill(Branch(0.0, arrays=other)).arrays))
    checkpoint.save_checkpoint(Path(), 3, {}, {"number": "x"})
    return [*found, ending(tree.Stored(Path(checkpoint.STATE_FILE)).read, Branch)]


@case
def sweeps_in_files(patch: Patch) -> Any:
    Path("s").mkdir()
    two = [sweeps.Combination("a", {"x": 1}), sweeps.Combination("b", {"x": 2})]
    plan = sweeps.SweepPlan(
        "c.yaml", ["y=1"], two, [3, 4], {"a-seed=3": sweeps.Failure(5, "no")}, {"f": "1"}, {"g": "2"}
    )
    found = [ending(sweeps.read_sweep, Path(name)) for name in ("s", "gone")]
    plan.write(Path("s"))
    found += [sweeps.read_sweep(Path("s")) == plan, sweeps.is_sweep(Path("s"))]
    content = json.loads(Path("s/sweep.json").read_text())
    names = [{"name": name, "settings": {}} for name in ("a", "A", "../x", "a/b", "")]
    for change in ({"version": 0, "program": "0.0.9"}, {"seeds": "x"}, {"more": 3}, {"seeds": []},
                   {"combinations": names[:2]}, *({"combinations": [each]} for each in names[2:])):  # fmt: skip
        Path("s/sweep.json").write_text(json.dumps(content | change))
        read = ending(sweeps.read_sweep, Path("s"))
        found.append(read if isinstance(read, str) else [each.name for each in read.combinations])
    return found


test_cases = pytest.mark.usefixtures("llvm")(case.test())
