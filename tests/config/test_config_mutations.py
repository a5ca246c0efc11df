"""Thousands of configurations that are nearly right, in one process: each loads, or is one located line, at once."""

from __future__ import annotations

import random
import time
from pathlib import Path

import pytest
from config import mutations

from reslrb_cli.config.loader import dump, load, loads
from reslrb_cli.errors import LINE_LENGTH, ConfigError

SECONDS, MIB = 5.0, 200.0


def _memory(name: str) -> float:
    """MiB of this process's memory: `VmRSS` now, `VmHWM` at most so far."""
    status = Path("/proc/self/status").read_text()
    return int(next(line for line in status.splitlines() if line.startswith(name)).split()[1]) / 1024


@pytest.mark.parametrize("count", [100, pytest.param(10_000, marks=pytest.mark.long)])
def test_mutated_configurations(count: int, tmp_path: Path) -> None:
    texts, path = mutations.good_texts(), tmp_path / "x.yaml"
    Path("/proc/self/clear_refs").write_text("5")  # the most so far begins anew
    before, loaded, slowest = _memory("VmRSS"), 0, 0.0
    for seed in range(count):
        data, overrides = mutations.mutate(random.Random(seed), texts)
        path.write_bytes(data)
        begin = time.process_time()  # of this process, so that others on the machine do not count
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
    assert count / 100 < loaded < count / 2  # neither all wrong at the first look, nor hardly any
