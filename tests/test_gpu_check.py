"""`scripts/gpu_check`: all parts run on a CPU too; what fails or takes too long is named, and the rest goes on."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import gpu_check as check
import gpu_steps
import pytest
from gpu_report import gpu_section

ROOT = Path(__file__).resolve().parents[1]


def test_quick_on_a_cpu(tmp_path: Path, llvm: str) -> None:
    command = [ROOT / "scripts" / "gpu_check", "--variant", "llvm_ad_rgb", "--quick", "-o", tmp_path]
    environment = os.environ | {"PYTHON": sys.executable}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads((tmp_path / "gpu_check.json").read_text())
    assert {part["status"] for part in found["parts"]} == {"ok"}
    assert len(found["parts"]) == len(done.stdout.splitlines()) - 1
    results = {part["name"]: part["results"] for part in found["parts"]}
    assert {row["estimator"] for row in results["steps"]["steps"]} == {"reservoir", "stack"}
    assert {row["max_depth"] for row in results["figure 6"]} == {2, 4}
    assert results["demo"]["last"]["loss"] < results["demo"]["first"]["loss"]
    page = (tmp_path / "gpu_check.md").read_text()
    assert "| `reslrb:reservoir` |" in page
    for part in found["parts"]:
        assert f"| {part['name']} | ok |" in page


def test_what_fails_is_named_and_the_rest_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    sleeper = tmp_path / "pid"
    slow = f"import os, time; open({str(sleeper)!r}, 'w').write(str(os.getpid())); time.sleep(60)"

    def tasks(variant: str, quick: bool, folder: Path) -> list:
        return [
            check.Task("broken", ["-c", "print('why'); raise SystemExit(3)"], 20),
            check.Task("slow", ["-c", slow], 1.5),
            check.Task("unread", ["-c", ""], 20, check._rows("nothing.jsonl")),
            check.Task("absent", ["-c", ""], 20, skip="pytest is not installed here"),
            check.Task("fine", ["-c", ""], 20),
        ]

    monkeypatch.setattr(check, "_tasks", tasks)
    assert check.main(["--variant", "llvm_ad_rgb", "-o", str(tmp_path / "out")]) == 1
    parts = {part["name"]: part for part in json.loads((tmp_path / "out" / "gpu_check.json").read_text())["parts"]}
    assert [part["status"] for part in parts.values()] == ["failed", "timed out", "failed", "skipped", "ok"]
    assert parts["broken"]["output"] == ["why"]
    assert "its results cannot be read" in parts["unread"]["reason"]
    with pytest.raises(ProcessLookupError):
        os.kill(int(sleeper.read_text()), 0)
    assert "timed out" in capsys.readouterr().out


def test_bench_rows_that_failed_fail(tmp_path: Path) -> None:
    rows = [{"status": "ok"}, {"status": "out_of_memory"}]
    (tmp_path / "a.jsonl").write_text("\n".join(map(json.dumps, rows)))
    assert check._rows("a.jsonl")(tmp_path) == (rows, "")
    (tmp_path / "b.jsonl").write_text(json.dumps({"holds": False}))
    assert check._rows("b.jsonl")(tmp_path)[1] == "1 of 1 rows failed"


def test_steps_that_compile_or_grow_are_problems() -> None:
    def row(depth: int, peak: float, new: list[int], apart: float | None = None) -> object:
        return gpu_steps.Steps("room", "stack", depth, 1.0, 1.0, 1.0, peak, 0, None, new, apart)

    assert gpu_steps._problems([row(4, 10.0, [1, 0, 0], 1e-7), row(64, 10.1, [0, 0, 0])]) == []
    assert "compile" in gpu_steps._problems([row(4, 10.0, [1, 0, 1])])[0]
    assert "grows" in gpu_steps._problems([row(4, 10.0, [0, 0, 0]), row(64, 11.0, [0, 0, 0])])[0]
    assert "recorded" in gpu_steps._problems([row(4, 10.0, [0, 0, 0], float("nan"))])[0]


def test_the_section_is_made_of_what_was_kept_last(tmp_path: Path) -> None:
    assert gpu_section(tmp_path).startswith("No figure")
    for device in ("One", "Two"):
        part = {"name": "doctor", "status": "failed", "seconds": 3.0, "reason": "why", "results": [1], "output": ["x"]}
        found = {"variant": "cuda_ad_rgb", "device": device, "quick": False, "parts": [part]}
        check.record(found, tmp_path)
    assert gpu_section(tmp_path) == check.section(found).rstrip()
    assert "### Two" in gpu_section(tmp_path)
    assert "| doctor | failed: why | 3 |" in gpu_section(tmp_path)
    assert '"x"' not in (tmp_path / "gpu.json").read_text()
