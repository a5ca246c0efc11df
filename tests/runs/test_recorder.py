"""The order of what a recording does, with everything around it pretended."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from reslrb_cli.errors import MachineError
from reslrb_cli.records.manifest import Status
from reslrb_cli.runs import recorder
from reslrb_cli.runs.recorder import Recording


class Pretended:
    """Recording whose parts only note their calls in `seen`. `failing` names parts that raise an error."""

    def __init__(self, failing: str = "", **attributes: Any) -> None:
        self.seen: list[str] = []
        self.failing, self.done = failing, 0
        vars(self).update(attributes)

    def note(self, name: str) -> Callable[..., None]:
        """Return a function that notes its name and its arguments."""

        def noted(*given: Any) -> None:
            self.seen.append(" ".join(map(str, [name, *given])))
            if name in self.failing.split():
                raise ValueError(name)

        return noted

    def __getattr__(self, name: str) -> Any:
        return self.note(name)


def iterated(
    monkeypatch: pytest.MonkeyPatch, scalings: list[Any], done: int = 0, stop: int = 99, fault: Any = None
) -> list[str]:
    """Return the calls of iterations whose states have these measurements for `scale`. A checkpoint is due after 2."""
    made = Pretended(done=done, initial={0: 1}, folder=SimpleNamespace(path=Path("a"), fault=fault))

    class Writer:
        def __init__(self, path: Path) -> None:
            self.write, self.sync = made.note("write"), made.note("sync")

        def __enter__(self) -> Writer:
            return self

        def __exit__(self, *_: object) -> None:
            made.note("closed")()

    def add(state: object, record: object) -> None:
        made.done += 1
        made.note("add")(record)

    every = SimpleNamespace(is_due=lambda iterations, seconds: iterations >= 2)
    config = SimpleNamespace(run=SimpleNamespace(checkpoint_every=every))
    made.problem = SimpleNamespace(config=config, interrupted=lambda: made.done >= stop)
    made.course = SimpleNamespace(state=SimpleNamespace(scaling=None), add=add)
    made.page, made.calls = SimpleNamespace(refresh=made.note("refresh")), SimpleNamespace(iteration=made.note("call"))
    made._iterations = lambda: ((SimpleNamespace(scaling=each), place) for place, each in enumerate(scalings, done))
    monkeypatch.setattr(recorder, "MetricsWriter", Writer)
    with suppress(MachineError):
        for record in Recording._iterate(made):  # type: ignore[arg-type]
            made.note("yielded")(record)
    assert made.initial == ({} if made.done > done else {0: 1})
    return made.seen


def test_the_order_of_iterations(monkeypatch: pytest.MonkeyPatch) -> None:
    """Metrics reach the disk before the checkpoint that needs them. Each measurement for `scale` is reported once."""

    def steps(*numbers: int) -> list[str]:
        return [f"{what} {number}" for number in numbers for what in ("write", "add", "call", "yielded")]

    due = ["sync", "_save_checkpoint", "refresh"]
    assert iterated(monkeypatch, [None] * 3) == [*steps(0), "refresh", *steps(1), *due, *steps(2), "refresh", "closed"]
    assert iterated(monkeypatch, [None] * 2, done=3) == [*steps(3), "refresh", *steps(4), *due, "closed"]
    assert iterated(monkeypatch, [None], stop=0) == []
    assert iterated(monkeypatch, [None, None], stop=1) == [*steps(0), "closed"]
    assert iterated(monkeypatch, [None, None], fault=MachineError("gone")) == [*steps(0), "closed"]
    found = iterated(monkeypatch, [None, "a", "a", "b"])
    assert [line for line in found if "scaling" in line] == ["_tell_scaling a", "_tell_scaling b"]
    assert found.index("_tell_scaling a") < found.index("write 1")


#: Failing parts, the status of the iterations, their error, the parts that are called, and the error in the end.
SAVED = ["_save_last_checkpoint", "_write_parameters", "_note_results"]
IMAGES = [*SAVED, "_write_final_images"]
LAST = ["report", "parts a"]
ENDS = [
    ("", Status.INTERRUPTED, None, [*IMAGES, "call interrupted", "manifest a interrupted None", *LAST], None),
    ("", Status.FINISHED, None, [*IMAGES, "call finished", "_add certainty", "_add perceptual",
                                 "manifest a finished None", *LAST], None),
    ("", Status.FAILED, ValueError("x"), [*SAVED, "call failed", "manifest a failed x", *LAST], "x"),
    ("_write_parameters", Status.FINISHED, None, [*IMAGES, "call failed", "manifest a failed _write_parameters", *LAST],
     "_write_parameters"),
    ("call _note_results", Status.FINISHED, None, [*IMAGES, "call failed", "manifest a failed _note_results", *LAST],
     "_note_results"),
    ("call", Status.INTERRUPTED, None, [*IMAGES, "call interrupted", "manifest a failed call", *LAST], "call"),
]  # fmt: skip


@pytest.mark.parametrize(("failing", "status", "failure", "seen", "error"), ENDS)
def test_the_order_of_the_end(
    monkeypatch: pytest.MonkeyPatch, failing: str, status: Status, failure: Any, seen: list[str], error: str | None
) -> None:
    made = Pretended(failing, folder=SimpleNamespace(path=Path("a"), fault=None))
    config = SimpleNamespace(fabrication=None)
    made.calls, made.problem = SimpleNamespace(end=made.note("call")), SimpleNamespace(config=config)

    def end(folder: Path, status: Status, error: str | None) -> None:
        made.note("manifest")(folder, status.value, error and error.partition(": ")[2])

    made.manifest = SimpleNamespace(end=end)
    made._add = lambda failed, measure: made.note("_add")(
        next(word for word in ("certainty", "perceptual", "solid") if word in failed)
    )
    monkeypatch.setattr(recorder, "write_report", lambda folder: made.note("report")())
    monkeypatch.setattr(recorder, "remove_parts", made.note("parts"))
    try:
        result, found = Recording._end(made, status, failure), None  # type: ignore[arg-type]
        assert result == status
    except ValueError as raised:
        found = str(raised)
    assert (made.seen, found) == (seen, error)


@pytest.mark.parametrize("done", [0, 3])
def test_initial_images_are_rendered_once(monkeypatch: pytest.MonkeyPatch, done: int) -> None:
    """If the run ends before its first iteration, they are the final ones."""
    view = SimpleNamespace(sensor=4, shown_array=lambda image: 2 * image, target=[[[1.0]]])
    made = Pretended(done=done, initial={}, error_maps={}, folder=SimpleNamespace(images=Path("i")))

    def render(*given: Any) -> np.ndarray:
        made.note("render")(*given)
        return np.ones((1, 1, 1))

    def mapped(folder: Path, suffix: str, image: np.ndarray, target: np.ndarray, towards: str) -> str:
        return f"{folder} {image.sum()} {target.sum()} {towards}"

    made.problem = SimpleNamespace(render=render, views=[view], image_gradient=lambda view, image: f"G{image.sum()}")
    made.course = SimpleNamespace(results=SimpleNamespace(see=lambda name, view, image: made.note("see")(name)))
    made._write_image = lambda name, sensor, image: made.note("write")(name, sensor, image.sum())
    made._image_name = lambda name, sensor: f"{name}-{sensor}"
    monkeypatch.setattr(recorder, "saved_spp", lambda problem: 64)
    monkeypatch.setattr(recorder, "write_error_map", mapped)
    rendered = f"render 4 64 {done} saved image"
    for name in ("initial", "final"):
        Recording._write_images(made, name)  # type: ignore[arg-type]
    again = [] if done == 0 else [rendered]
    assert made.seen == [rendered, "write initial 4 2.0", "see initial", *again, "write final 4 2.0", "see final"]
    assert (list(made.initial), made.error_maps) == ([4] if done == 0 else [], {"error-4": "i 2.0 1.0 G1.0"})


def test_a_state_is_saved_once(tmp_path: Path) -> None:
    """A second save would replace the earlier state."""
    folder = SimpleNamespace(checkpoint=tmp_path)
    for saved, file, calls in ((3, True, 0), (3, False, 1), (2, True, 1), (None, False, 1)):
        (tmp_path / "state.npz").unlink(missing_ok=True)
        if file:
            (tmp_path / "state.npz").touch()
        made = Pretended(done=3, _saved=saved, folder=folder)
        Recording._save_last_checkpoint(made)  # type: ignore[arg-type]
        assert made.seen == ["_save_checkpoint"] * calls


@pytest.mark.parametrize(
    ("done", "after", "stopped", "raised", "seen", "status", "failure"),
    [
        (0, 5, "", None, ["begin", "_begin"], Status.FINISHED, None),
        (2, 5, "", None, ["begin"], Status.FINISHED, None),
        (0, 4, "", None, ["begin", "_begin"], Status.INTERRUPTED, None),
        (0, 4, "no time", None, ["begin", "_begin"], Status.FINISHED, None),
        (0, 5, "", KeyboardInterrupt(), ["begin", "_begin", "stand"], Status.INTERRUPTED, None),
        (0, 3, "", ValueError("x"), ["begin", "_begin"], Status.FAILED, "x"),
        (0, 4, "", GeneratorExit(), ["begin", "_begin"], Status.INTERRUPTED, None),
    ],
)  # fmt: skip
def test_how_a_run_ends(
    tmp_path: Path,
    done: int,
    after: int,
    stopped: str,
    raised: BaseException | None,
    seen: list[str],
    status: Status,
    failure: str | None,
) -> None:
    """A run of 5 iterations. It is interrupted if some are left, unless a criterion has stopped it."""
    (tmp_path / "fabrication.json").touch()
    made = Pretended(done=done, folder=SimpleNamespace(path=tmp_path), _saved=None)
    made.page = SimpleNamespace(refresh=made.note("refresh"))
    made.calls = SimpleNamespace(begin=made.note("begin"))
    made.course = SimpleNamespace(state=SimpleNamespace(stopped=stopped), stand=made.note("stand"))
    made.problem = SimpleNamespace(config=SimpleNamespace(run=SimpleNamespace(iterations=5)))
    ended: list[Any] = []

    def iterate() -> Any:
        assert not (tmp_path / "fabrication.json").exists()
        yield "record"
        made.done = after
        if raised is not None:
            raise raised

    def end(status: Status, failure: BaseException | None) -> Status:
        ended.append(failure and str(failure))
        return status

    made._iterate, made._end = iterate, end
    assert list(Recording._records(made)) == ["record"]  # type: ignore[arg-type]
    assert (made.seen, made.status, ended) == (["refresh", *seen], status, [failure])
    assert made._saved == (done or None)
