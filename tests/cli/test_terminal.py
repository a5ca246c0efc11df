"""Tests of output on the terminal. Names appear as text and never as commands, progress bars fit any width, and a run
continues if the terminal cannot be written.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import io
import json
import logging
import os
import re
import struct
import sys
import termios
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from cli.test_nonfinite import CONFIG, SCENE
from cli.tiny import outcome
from records.test_metrics import make_record
from tqdm import tqdm

from reslrb_cli.cli import lens, optimize
from reslrb_cli.cli.lens import show_stages
from reslrb_cli.cli.optimize import Progress
from reslrb_cli.cli.terminal import LogLines
from reslrb_cli.optimization.problem import ErrorMeter
from reslrb_cli.report.run_summary import descriptions

# Names from scenes, files and arguments reach the terminal and the log as text, never as commands.

ESC, TURNED = "\x1b[31m", "\u202e"


@pytest.fixture
def experiment(llvm, tmp_path, monkeypatch):
    """Experiment with an escape sequence in its folder's name. The name of its material has a character that turns the
    writing direction.
    """
    import mitsuba as mi

    folder = tmp_path / f"f{ESC}"
    folder.mkdir()
    mi.Bitmap(np.full((8, 8, 3), 0.5, np.float32)).write(str(folder / "wall.exr"))
    mi.Bitmap(np.full((8, 8, 3), 0.2, np.float32)).write(str(folder / "target.exr"))
    scene = SCENE.replace("REFLECTANCE", '<rgb name="reflectance" value="0.6, 0.5, 0.4"/>')
    # XML cannot hold control characters. In a key, a mark that reverses the writing direction does as much harm.
    (folder / "scene.xml").write_text(scene.replace('"poster"', f'"pos{TURNED}ter"'))
    (folder / "c.yaml").write_text(CONFIG.replace("poster.", "Diffuse_1."))
    monkeypatch.chdir(tmp_path)
    return folder


def test_inspect(experiment):
    code, out, err = outcome("inspect", experiment / "c.yaml")
    assert code == 0
    assert not {"\x1b", TURNED} & set(out + err)
    assert "id `pos\\u202eter` cannot be part of a key: named Diffuse_1" in err
    assert "Diffuse_1.reflectance.value" in out
    code, out, _ = outcome("inspect", experiment / "c.yaml", "--json")
    assert not {"\x1b", TURNED} & set(out)
    assert "Diffuse_1.reflectance.value" in [entry["key"] for entry in json.loads(out)["parameters"]]


def test_a_run_and_its_errors(experiment):
    arguments = ("--set", "run.iterations=1", "--set", 'run.output="o\\e[31m"', "--set", "run.name=n")
    code, out, err = outcome("optimize", experiment / "c.yaml", *arguments)
    assert code == 0
    assert "\x1b" not in out + err
    assert "look at o\\x1b[31m/n/report.html" in out
    assert "\x1b" not in Path(f"o{ESC}/n/report.html").read_text().partition("</title>")[0]
    manifest = json.loads(Path(f"o{ESC}/n/manifest.json").read_text())
    assert "\x1b" not in manifest["config"] + "".join(manifest["command_line"])
    for wrong in ("c.yaml", "none.yaml"):
        code, out, err = outcome("optimize", experiment / wrong, "--set", 'parameters[0].key="x\\e[31m"')
        assert code == 2
        assert "\x1b" not in out + err


def test_the_log(capsys):
    code, out, err = outcome("optimize", f"--{ESC}")
    assert (code, "\x1b" in out + err) == (2, False)
    assert "No such option" in err
    outcome("optimize", "none.yaml")
    logging.getLogger("reslrb_cli.x").warning("%s: %s", f"a{ESC}", "b\nc")
    assert capsys.readouterr().err == "a\\x1b[31m: b\\nc\n"


@pytest.mark.parametrize(
    ("arguments", "what"),
    [
        (("render", "c.yaml", "-o", "pipe.png"), "--output: pipe.png is not a regular file"),
        (("gradcheck", "c.yaml", "--spp", "99999999999999"), "is not in the range 1<=x<=2147483647."),
        (("gradcheck", "c.yaml", "--json", "pipe.png"), "--json: cannot write pipe.png: the pipe has no reader"),
    ],
)
def test_outputs_and_counts(experiment, monkeypatch, arguments, what):
    monkeypatch.chdir(experiment)
    os.mkfifo("pipe.png")
    code, out, err = outcome(*arguments)
    assert (code, out) == (2, "")
    assert what in err


def test_a_removed_working_directory(experiment, monkeypatch):
    gone = experiment / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    code, _, err = outcome("inspect", experiment / "c.yaml")
    assert code in (2, 6)
    assert err == "the working directory: No such file or directory\n"


def test_losing_the_terminal_does_not_end_a_run(monkeypatch: pytest.MonkeyPatch) -> None:
    class Terminal(io.StringIO):
        there = True

        def write(self, text: str) -> int:
            if not self.there:
                raise OSError(errno.EIO, "hung up")
            return super().write(text)

    for is_terminal in (False, True):
        stream = Terminal()
        monkeypatch.setattr(stream, "isatty", lambda is_terminal=is_terminal: is_terminal)
        monkeypatch.setattr(sys, "stderr", stream)
        with Progress(10, quiet=False, meter=make_meter(1)) as progress:
            stream.there = False
            progress.show(record(1, 1))
            progress.show(record(9, 1))


def show_iterations() -> None:
    with Progress(10, quiet=False, meter=make_meter(1)) as progress:
        for number in range(10):
            progress.show(record(number, 1))


def show_a_stage() -> None:
    with show_stages(2) as tell:
        tell("the solid")


@pytest.mark.parametrize(("show", "line"), [(show_iterations, "10/10: loss"), (show_a_stage, "the solid ...")])
@pytest.mark.parametrize("columns", [0, 1, 80])
def test_progress_is_shown_on_terminals_of_any_size(
    columns: int, show: Callable[[], None], line: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Terminals of containers and scripts may have no size, so that a bar has no room."""
    monkeypatch.setattr(lens, "SECONDS_PER_LINE", 0.0)
    ours, theirs = os.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 0 if columns == 0 else 24, columns, 0, 0))
    with os.fdopen(theirs, "w") as stream:
        monkeypatch.setattr(sys, "stderr", stream)
        show()
    shown = ""
    with contextlib.suppress(OSError):  # the end of the terminal
        while part := os.read(ours, 10_000):
            shown += part.decode()
    os.close(ours)
    assert (line in shown) == (columns == 0)
    assert shown.strip()


@pytest.mark.parametrize(
    ("total", "done", "seconds", "shown"),
    [
        (30, 0, 0.0, [3, 6, 9, 12, 15, 18, 21, 24, 27, 30]),
        (5, 0, 0.0, [1, 2, 3, 4, 5]),
        (30, 4, 0.0, [6, 9, 12, 15, 18, 21, 24, 27, 30]),
        (30, 24, 4.0, [27, 30]),
        (30, 24, 5.0, [26, 27, 29, 30]),
        (30, 24, 9.9, [26, 27, 29, 30]),
        (30, 24, 10.0, [25, 26, 27, 28, 29, 30]),
    ],
)
def test_a_line_for_each_tenth_and_each_ten_seconds(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], total: int, done: int, seconds: float,
    shown: list[int],
) -> None:  # fmt: skip
    now = [100.0]
    monkeypatch.setattr(optimize.time, "monotonic", lambda: now[0])
    with Progress(total, quiet=False, meter=make_meter(1), done=done) as progress:
        for number in range(done, total):
            now[0] += seconds
            progress.show(record(number, 1))
    lines = capsys.readouterr().err.splitlines()
    assert [int(line.partition(f"/{total}: loss")[0]) for line in lines] == shown


# Progress on terminals of any width: a bar, the percentage, the loss, and no truncated number.

LAMP = "a_lamp_with_a_name_of_some_length.emitter.radiance.value"


def make_meter(units):
    truth = {"wall.reflectance.value": np.full(3, 0.5), LAMP: np.full(3, 2e6)}
    masks = {key: np.ones(3, dtype=bool) for key in truth}
    return ErrorMeter(truth, masks, {LAMP: "radiance"} if units == 2 else None)


def record(number, units):
    errors = {"wall.reflectance.value": 0.4321 / (1 + number), LAMP: 1.357913e6}
    return make_record(
        iteration=number,
        loss=0.0123456 * 10 ** -(number % 4),
        parameter_errors=errors,
        parameter_rmse=None if units == 2 else 0.2468 / (1 + number),
    )


def shown(monkeypatch, width, units, iterations=30, resize=None):
    """Return the frames that a progress bar shows on a terminal of `width` columns."""
    master, slave = os.openpty()
    fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", 24, width, 0, 0))
    with os.fdopen(slave, "w") as terminal:
        monkeypatch.setattr(sys, "stderr", terminal)
        text = b""
        with Progress(iterations, quiet=False, meter=make_meter(units)) as progress:
            progress._bar.mininterval = 0
            for number in range(iterations):
                if resize and number == iterations // 2:
                    fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", 24, resize, 0, 0))
                progress.show(record(number, units))
                text += os.read(master, 1 << 16)
    os.close(master)
    return [frame for frame in re.split(r"[\r\n]+", text.decode()) if frame.strip()]


@pytest.mark.parametrize(("width", "units"), [(40, 1), (40, 2), (80, 1), (80, 2), (120, 2), (200, 1)])
def test_every_width_shows_a_bar_the_percentage_and_the_loss(monkeypatch, width, units):
    frames = shown(monkeypatch, width, units)
    assert len(frames) >= 30
    assert max(map(len, frames)) <= width
    for number in range(30):
        loss = f"loss {record(number, units).loss:.4g}"
        assert any(re.search(rf"^ *\d+%\|.+\| {re.escape(loss)}(,|$)", frame) for frame in frames), loss
    words = frames[-1].partition("loss")[2]
    if width >= 80:
        assert ("relative error 0.679" if units == 2 else f"RMSE {0.2468 / 30:.4g}") in words
        assert words.endswith(", 30/30, 00:00 left")
    assert (LAMP[-14:] in words) == (units == 2 and width >= 120)


def test_log_lines_appear_once_above_the_bar(monkeypatch):
    logger = logging.Logger("lines")
    logger.addHandler(LogLines())
    master, slave = os.openpty()
    with os.fdopen(slave, "w") as terminal:
        monkeypatch.setattr(sys, "stderr", terminal)
        with Progress(3, quiet=False, meter=make_meter(1)):
            logger.warning("beware of \x1b[31m")
        text = os.read(master, 1 << 16).decode()
    os.close(master)
    assert text.count("beware") == 1
    assert re.search(r"(^|[\r\n])beware of \\x1b\[31m\r\n", text)
    assert "\x1b[31m" not in text


def test_the_remaining_time_of_a_resumed_run(monkeypatch):
    """Iterations of 2 s. The time before the first one of this process does not count."""
    progress = Progress(10, quiet=True, meter=make_meter(1), done=5)
    progress._bar = SimpleNamespace(format_interval=tqdm.format_interval)
    for number, seconds in ((5, 8), (6, 6)):
        record = make_record(iteration=number, elapsed_s=100.0 + 2 * number, step_ms=2000.0, codegen_ms=0.0)
        assert progress._left(record) == f"00:0{seconds} left"


def test_a_terminal_that_changes_width(monkeypatch):
    frames = shown(monkeypatch, 120, 2, resize=80)
    assert "at worst" in frames[3]
    for frame in frames[-8:]:
        assert len(frame) <= 80
        assert re.search(r"\d%\|.{8,}\| loss [\d.e-]+, relative error [\d.]+, \d+/30, 00:00 left$", frame), frame


def test_keys_are_shortened_and_cannot_control_the_terminal():
    assert descriptions(make_record(), make_meter(2)) == ["loss 0.5"]
    key = "\x1b[31mred" + "x" * 60 + ".value"
    meter = ErrorMeter(
        {key: np.ones(3), "b": np.ones(1)}, {key: np.ones(3, bool), "b": np.ones(1, bool)}, {"b": "radiance"}
    )
    text = descriptions(make_record(parameter_errors={key: 0.5, "b": 0.1}), meter)[0]
    assert "\x1b" not in text
    assert re.search(r"\(\\x1b\S+\.\.\.\S+\.value\)$", text)
    assert len(text) < 90
