"""The commands of `scripts/gpu_check` run on a CPU at the smallest sizes. All files and tests that the script names
exist.
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
NAMES = ["doctor", "bench", "gradcheck", "gradcheck_moving", "demo", "conformance"]


def gpu_check(*words: object, python: object = sys.executable) -> subprocess.CompletedProcess[str]:
    """Run `scripts/gpu_check` on the CPU."""
    command = [ROOT / "scripts/gpu_check", "--variant", "llvm_ad_rgb", *words]
    environment = os.environ | {"PYTHON": str(python)}
    return subprocess.run(command, capture_output=True, text=True, check=False, env=environment)


@pytest.mark.long  # takes as long as twenty other tests, and its commands have their own tests
def test_its_commands_run_at_the_smallest_sizes(tmp_path: Path, llvm: str) -> None:
    done = gpu_check("--small", "-o", tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    said = (tmp_path / "summary.md").read_text()
    assert re.findall(r"^### (\w+): exit code 0 after", said, re.MULTILINE) == NAMES
    assert re.match(r"Commit \w{12}(-dirty)?, llvm_ad_rgb, ", said)
    assert len(re.findall(r"^(\d+) of \1 comparisons hold", said, re.MULTILINE)) == 2
    assert "1 passed" in said
    for record in ("bench.jsonl", "gradcheck.jsonl", "gradcheck_moving.jsonl", "demo/metrics.jsonl"):
        assert (tmp_path / record).stat().st_size > 0


@pytest.mark.parametrize("small", [[], ["--small"]])
def test_all_named_commands_exist(small: list[str]) -> None:
    listed = [line.split("\t") for line in gpu_check("--list", *small).stdout.splitlines()]
    assert [name for name, _, _ in listed] == NAMES
    assert all(0 < int(limit) <= 3600 for _, limit, _ in listed)
    words = [word for _, _, command in listed for word in shlex.split(command)]
    named = [word for word in words if word.startswith(("configs/", "tests/"))]
    assert len(named) == 4
    for file, _, test in (word.partition("::") for word in named):
        assert (ROOT / file).exists(), file
        assert not test or f"def {test}(" in (ROOT / file).read_text(), test


def test_a_failing_command_is_named_and_the_others_run(tmp_path: Path) -> None:
    python = tmp_path / "python"
    python.write_text('#!/bin/sh\necho "$@"\ncase "$*" in *bench*) exit 3 ;; *optimize*) exit 124 ;; esac\n')
    python.chmod(0o755)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "bench.samples.npz").write_bytes(b"of an earlier check")
    done = gpu_check("-o", tmp_path / "out", python=python)
    assert done.returncode == 1
    assert not list((tmp_path / "out").glob("*.npz"))
    lines = done.stdout.splitlines()
    assert [line.split(":")[0] for line in lines[:-1]] == NAMES
    assert lines[1].startswith("bench: exit code 3 after")
    assert lines[4] == "demo: stopped at its limit of 900 s"
    assert "--max-depth 128" in (tmp_path / "out" / "bench.out").read_text()
    assert gpu_check("-o", tmp_path / "out", "doctor", "conformance", python=python).returncode == 0
    assert gpu_check("docter").returncode == 2


def test_a_named_variant_is_tested_or_fails() -> None:
    """A requested variant that is not available fails the test run. Skipped tests would look like tests that pass on a
    GPU.
    """
    test = "tests/conformance/test_replay.py::test_without_light_there_is_no_replay"
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", test]
    environment = os.environ | {"RESLRB_TEST_VARIANT": "cuda_ad_rgb", "DRJIT_LIBCUDA_PATH": "/nonexistent.so"}
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 1
    assert "1 error" in done.stdout
