"""Tests of configurations that are nearly correct or too large. Each of them loads, or gives one error line with a
location, at once.
"""

from __future__ import annotations

import os
import random
import socket
import time
from pathlib import Path

import pytest
from config import mutations
from config.test_config_bad_input import GOOD, line_of

from reslrb_cli.config.integrators import Prb
from reslrb_cli.config.loader import dump, load, loads
from reslrb_cli.errors import LINE_LENGTH, ConfigError

# Thousands of nearly valid configurations in one process. Each configuration loads or gives one located line, without
# delay.

SECONDS, MIB = 5.0, 200.0


def _memory(name: str) -> float:
    """Return a value of this process's memory in MiB. `VmRSS` is the current size, and `VmHWM` is the largest size so
    far.
    """
    status = Path("/proc/self/status").read_text()
    return int(next(line for line in status.splitlines() if line.startswith(name)).split()[1]) / 1024


@pytest.mark.parametrize("count", [50, pytest.param(10_000, marks=pytest.mark.long)])
def test_mutated_configurations(count: int, tmp_path: Path) -> None:
    texts, path = mutations.good_texts(), tmp_path / "x.yaml"
    Path("/proc/self/clear_refs").write_text("5")  # resets the largest size so far
    before, loaded, slowest = _memory("VmRSS"), 0, 0.0
    for seed in range(count):
        data, overrides = mutations.mutate(random.Random(seed), texts)
        path.write_bytes(data)
        begin = time.process_time()  # excludes other processes on the machine
        try:
            config = load(path, overrides)
        except ConfigError as error:
            line = str(error)
            assert line.startswith((str(path), "--set")), f"seed {seed}: {line}"
            assert line.isprintable(), f"seed {seed}"
            assert len(line) <= LINE_LENGTH, f"seed {seed}"
        except Exception as error:
            raise AssertionError(f"seed {seed}: {error!r}") from error
        else:
            assert loads(dump(config), path) == config, f"seed {seed}"
            loaded += 1
        slowest = max(slowest, time.process_time() - begin)
        assert slowest < SECONDS, f"seed {seed}"
    assert _memory("VmHWM") - before < MIB
    assert count / 100 < loaded < count / 2  # some configurations load, but fewer than half


# Large input and special files are refused at once.

#: Processor seconds for one input. A quiet machine needs a second or two. Without limits, an input would take half a
#: minute to hours.
SECONDS_OF_ONE = 10


LARGE = {
    "depth": ("a: " + "[" * 1000, "are nested too deeply"),
    "unknown keys": (GOOD + "".join(f"k{i}: 1\n" for i in range(9_000)), "unknown key; known here: variant"),
    "a word": (GOOD + f"? {'x' * 100_000}\n: 1\n", "unknown key; known here: variant"),
}


@pytest.mark.parametrize("case", LARGE)
def test_large_input_is_refused_at_once(case: str, tmp_path: Path) -> None:
    text, what = LARGE[case]
    begin = time.process_time()
    line = line_of(tmp_path, text)
    assert time.process_time() - begin < SECONDS_OF_ONE
    assert what in line
    assert len(line) < 1200


def test_the_faulty_override_is_found_among_many(tmp_path: Path) -> None:
    good = [f"scene.options.a{i}=1" for i in range(200)]
    for place in (0, 1, 77, 199, 200):
        overrides = (*good[:place], "run.spp=0", *good[place:])
        assert line_of(tmp_path, GOOD, overrides).startswith("--set run.spp=0: run.spp: ")


def test_an_override_does_not_change_shared_aliases(tmp_path: Path) -> None:
    text = GOOD.replace("{render: {}}", "{render: {integrator: &i {type: prb}}}") + "integrator: *i\n"
    (tmp_path / "x.yaml").write_text(text)
    config = load(tmp_path / "x.yaml", ["integrator.rr_depth=2"])
    assert config.target.render is not None
    assert config.integrator.rr_depth == 2
    assert config.target.render.integrator == Prb()


@pytest.mark.parametrize("kind", ["pipe", "socket", "device"])
def test_only_regular_files_are_read(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "x"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as server:
            server.bind(str(path))
    else:
        path = Path("/dev/zero")
    with pytest.raises(ConfigError, match=f"{path}: is a pipe, a socket or a device, not a regular file"):
        load(path)


def test_paths_with_invalid_utf8(tmp_path: Path) -> None:
    folder = tmp_path / "d\udcff"
    folder.mkdir()
    for place in (folder / "x.yaml", tmp_path / "x\udcff.yaml"):
        place.write_text(GOOD)
    with pytest.raises(
        ConfigError, match=r"d\\udcff/x\.yaml: scene\.file: names a file or a folder whose name is not UTF-8"
    ):
        load(folder / "x.yaml")
    assert load(tmp_path / "x\udcff.yaml").run.folder_name == "x"
