"""Progress on terminals of any width: a bar, the percentage and the loss, and no number that is cut."""

from __future__ import annotations

import fcntl
import os
import re
import select
import struct
import sys
import termios

import numpy as np
import pytest
from records.test_metrics import make_record

from reslrb_cli.cli import progress as module
from reslrb_cli.cli.progress import Progress, Reading, descriptions
from reslrb_cli.optimization.errors import ErrorMeter
from reslrb_cli.records.measurement_files import read_lines

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
    """What stood on a terminal of that width, frame by frame."""
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


@pytest.mark.parametrize("units", [1, 2])
@pytest.mark.parametrize("width", [40, 60, 80, 120, 200])
def test_every_width_has_a_bar_the_percentage_and_the_loss(monkeypatch, width, units):
    frames = shown(monkeypatch, width, units)
    assert len(frames) >= 30
    assert max(map(len, frames)) <= width
    for number in range(30):
        loss = f"loss {record(number, units).loss:.4g}"
        assert any(re.search(rf"^ *\d+%\|.{{8,}}\|.*{re.escape(loss)}(,|$)", frame) for frame in frames), loss
    words = frames[-1].partition("loss")[2]
    if width >= 60:
        error = "relative error 0.679" if units == 2 else f"RMSE {0.2468 / 30:.4g}"
        assert error in words
    assert ("00:00 left" in frames[-1] or "<00:00" in frames[-1]) == (width >= 80)
    assert (LAMP[-14:] in words) == (units == 2 and width >= 120)


def test_a_terminal_that_changes_its_width(monkeypatch):
    frames = shown(monkeypatch, 120, 2, resize=40)
    assert len(frames[3]) > 110
    for frame in frames[-8:]:
        assert len(frame) <= 40
        assert re.search(r"\d%\|.{8,}\| loss [\d.e-]+$", frame), frame
    frames = shown(monkeypatch, 40, 2, resize=120)
    assert "at worst" not in frames[3]
    assert "at worst" in frames[-1]


def test_hardly_any_room(monkeypatch):
    frames = shown(monkeypatch, 14, 1)
    assert max(map(len, frames)) <= 14
    assert all(re.fullmatch(r" *\d+%\|.*\|", frame) for frame in frames)


def test_an_error_is_told_where_it_is_known():
    meter = make_meter(2)
    assert descriptions(make_record(), meter) == ["loss 0.5"]
    long, short, loss = descriptions(record(0, 2), meter)
    assert long.startswith("loss 0.01235, relative error 0.8642 at worst (wall.reflectance.value)")
    assert (short, loss) == ("loss 0.01235, relative error 0.8642", "loss 0.01235")
    assert descriptions(record(0, 1), make_meter(1))[0] == "loss 0.01235, parameter RMSE 0.2468"


def test_keys_are_shortened_in_the_middle_and_cannot_steer_the_terminal():
    key = "\x1b[31mred" + "x" * 60 + ".value"
    meter = ErrorMeter(
        {key: np.ones(3), "b": np.ones(1)}, {key: np.ones(3, bool), "b": np.ones(1, bool)}, {"b": "radiance"}
    )
    text = descriptions(make_record(parameter_errors={key: 0.5, "b": 0.1}), meter)[0]
    assert "\x1b" not in text
    assert re.search(r"\(\\x1b\S+\.\.\.\S+\.value\)$", text)
    assert len(text) < 90


# --- reading ----------------------------------------------------------------------------------------------------------


def write_metrics(folder, lines=20_000):
    file = folder / "metrics.jsonl"
    file.write_text('{"iteration": 1, "loss": 0.25}\n' * lines)
    return file


def test_reading_a_long_file_has_a_bar(monkeypatch, tmp_path):
    monkeypatch.setattr(module, "LEAST_SECONDS", 0.0)
    master, slave = os.openpty()
    fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 100, 0, 0))
    with os.fdopen(slave, "w") as terminal:
        monkeypatch.setattr(sys, "stderr", terminal)
        with Reading() as tell:
            assert len(read_lines(write_metrics(tmp_path), tell).objects) == 20_000
        text = ""
        while not text.endswith("\n") and select.select([master], [], [], 5)[0]:  # what was written arrives in pieces
            text += os.read(master, 1 << 16).decode()
    os.close(master)
    assert re.search(r"reading .*metrics.jsonl: +\d+%\|.*/605k ", text)
    assert text.endswith("drawing\r\n")


def test_without_a_terminal_a_line_is_written_now_and_then(monkeypatch, tmp_path, capsys):
    file = write_metrics(tmp_path)
    with Reading() as tell:
        read_lines(file, tell)
    assert capsys.readouterr().err == ""  # it took no time
    monkeypatch.setattr(module, "SECONDS_PER_LINE", 0.0)
    with Reading() as tell:
        read_lines(file, tell)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 4
    assert re.fullmatch(r"reading .*metrics.jsonl: 124 KiB of 605.5 KiB", lines[0])
