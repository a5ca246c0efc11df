"""All that has to be known about reslrb on a GPU, in parts of which each has a process and a limit of its own.

Writes gpu_check.json, gpu_check.md (a section of docs/benchmarks.md; `--record` puts it there), and the output of every
part into FOLDER. Exit code 1 where a part failed; what could not be tried, for want of pytest, is named and skipped.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "scripts"))

from gpu_report import Part, record, section, tail  # noqa: E402

#: Seconds for everything; a part gets what is left, where that is less than its own limit.
WHOLE = 535
#: What shows most in least time: every emitter, every estimator's gradient, replays, zeros, masks, recordings, memory.
CONFORMANCE = [
    "test_image_emitters.py",
    "test_gradient_reference.py",
    "test_replay.py",
    "test_gradient_zero.py",
    "test_freezing.py",
    "test_kernels.py",
    "test_memory.py",
    "test_attached.py",
]
QUICK_CONFORMANCE = [
    "test_replay.py::test_replay_meets_the_same_vertices[mask]",
    "test_replay.py::test_no_light_no_replay",
    "test_freezing.py::test_a_recorded_step_is_the_step[texture-reservoir]",
]
#: Cases of the extreme suite; the rest is the CPU's to try.
EXTREME = ("furnace", "albedo_0_in_one_channel", "opacity_texture_0_and_1", "emission_1e-25_and_1e+25", "slope_0.3")
ROOM, GLASS = "configs/cornell_floor.yaml", "configs/caustic_heightmap.yaml"


@dataclass(frozen=True)
class Task:
    """A part that is to be run: `command` follows the interpreter; `check` reads FOLDER and names what did not hold."""

    name: str
    command: Sequence[str]
    limit: float
    check: Callable[[Path], tuple[Any, str]] | None = None
    skip: str = ""
    environment: dict[str, str] = field(default_factory=dict)


def main(arguments: list[str]) -> int:
    """Run the parts, write the files; the exit code."""
    parser = argparse.ArgumentParser(prog="scripts/gpu_check", description=__doc__.split("\n\n")[0])
    parser.add_argument("--variant", default="cuda_ad_rgb", choices=["cuda_ad_rgb", "llvm_ad_rgb"],
                        help="default: cuda_ad_rgb; the other runs the same on a CPU")  # fmt: skip
    parser.add_argument("--quick", action="store_true", help="a few seconds of each part: shows that they run")
    parser.add_argument("--only", metavar="NAMES", help="these parts alone, separated by commas")
    parser.add_argument("--record", action="store_true", help="put the section into docs/benchmarks.md")
    parser.add_argument("-o", dest="folder", type=Path, default=ROOT / "build" / "gpu_check",
                        help="default: build/gpu_check")  # fmt: skip
    options = parser.parse_args(arguments)
    tasks = _tasks(options.variant, options.quick, options.folder)
    if options.only:
        names = options.only.split(",")
        unknown = [name for name in names if name not in [task.name for task in tasks]]
        if unknown:
            parser.error(f"--only: there is no part {unknown[0]}; there are {', '.join(task.name for task in tasks)}")
        tasks = [task for task in tasks if task.name in names]
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.default_int_handler)  # so that no part outlives this process
    options.folder.mkdir(parents=True, exist_ok=True)
    parts: list[Part] = []
    start = time.monotonic()
    interrupted = False
    for task in tasks:
        try:
            part = _run(task, options.variant, options.folder, WHOLE - (time.monotonic() - start))
        except KeyboardInterrupt:
            interrupted = True
            break
        parts.append(part)
        print(
            f"{part.status:9} {part.seconds:6.1f} s  {part.name}{': ' + part.reason if part.reason else ''}", flush=True
        )
        _write(options.folder, options.variant, options.quick, parts)
    if options.record and parts:
        from benchmarks_page import write

        record(json.loads((options.folder / "gpu_check.json").read_text(encoding="utf-8")))
        write()
    recorded = "; docs/benchmarks.md has them" if options.record else ""
    print(f"gpu_check.json and gpu_check.md are in {options.folder}{recorded}")
    if interrupted:
        return 130
    return 1 if any(part.status in ("failed", "timed out") for part in parts) else 0


def _tasks(variant: str, quick: bool, folder: Path) -> list[Task]:
    """All parts, those that tell most first: they are not to be what no time is left for."""
    reslrb, on = ["-m", "reslrb_cli"], ["--set", f"variant={variant}"]
    small = ["--set", "scene.options={resx: 24, resy: 24}", "--set", "run.spp=4", "--set", "target.render.spp=16"]

    def file(name: str) -> list[str]:
        return ["--json", str(folder / name)]

    steps = ["scripts/gpu_steps.py", "--variant", variant, "--out", str(folder / "steps.json")]
    gradients = [*reslrb, "gradcheck", ROOM, *on, *file("gradients.jsonl"), "--budget", "45"]
    moving = [*reslrb, "gradcheck", GLASS, *on, *file("moving.jsonl"), "--budget", "40"]
    moving += ["--estimators", "stack,reservoir", "--set", "parameters.0.heightmap.resolution=[8,8]"]
    sweep = [*reslrb, "bench", ROOM, *on, *file("figure6.jsonl"), "--max-depth", "128", "--budget", "100"]
    demo = [*reslrb, "optimize", ROOM, *on, "--set", f"run.output={folder}", "--set", "run.name=demo", "--force"]
    extreme = [*reslrb, "gradcheck", "--suite", "extreme", *file("extreme.jsonl"), "--seeds", "8"]
    cases, tests = EXTREME, CONFORMANCE
    if quick:
        steps += ["--quick"]
        gradients += [*small, "--estimators", "reservoir", "--seeds", "4"]
        moving += [*small, "--estimators", "stack", "--seeds", "4"]
        sweep += [*small, "--max-depth", "4", "--integrators", "ptracer,reslrb:reservoir", "--rounds", "3"]
        demo += [*small, "--set", "run.iterations=12", "--set", "integrator.estimator=reservoir"]
        extreme += ["--estimators", "stack", "--seeds", "4"]
        cases, tests = EXTREME[:1], QUICK_CONFORMANCE
    extreme += [word for case in cases for word in ("--case", case)]
    workers = ["-n", str(min(8, os.cpu_count() or 1))] if find_spec("xdist") and not quick else []
    conformance = ["-m", "pytest", "-q", "-p", "no:cacheprovider", *workers]
    conformance += [f"tests/conformance/{name}" for name in tests]
    return [
        Task("doctor", [*reslrb, "doctor", "--json"], 40, _check_doctor(variant)),
        Task("steps", steps, 100, lambda found: (_json(found / "steps.json"), "")),
        Task("gradients", gradients, 75, _rows("gradients.jsonl")),
        Task("gradients of what moves light", moving, 75, _rows("moving.jsonl")),
        Task("figure 6", sweep, 130, _rows("figure6.jsonl")),
        Task("demo", demo, 60, _check_demo),
        Task("extreme cases", extreme, 60, _rows("extreme.jsonl")),
        Task(
            "conformance tests",
            conformance,
            150,
            skip="" if find_spec("pytest") else "pytest is not installed here",
            environment={"RESLRB_TEST_VARIANT": variant},
        ),
    ]


def _run(task: Task, variant: str, folder: Path, left: float) -> Part:
    """One part in a process group of its own, which ends with it."""
    shown = ["python3", *task.command]
    if task.skip:
        return Part(task.name, shown, "skipped", 0.0, task.skip)
    if left < 5:
        return Part(task.name, shown, "skipped", 0.0, "no time is left")
    limit, start = min(task.limit, left), time.monotonic()
    environment = os.environ | {"PYTHONUNBUFFERED": "1"} | task.environment
    if not variant.startswith("cuda"):
        environment["CUDA_VISIBLE_DEVICES"] = ""  # so that `auto` is the CPU too
    log = folder / f"{task.name.replace(' ', '_')}.log"
    with log.open("wb") as output:
        process = subprocess.Popen([sys.executable, *task.command], cwd=ROOT, env=environment, stdout=output,
                                   stderr=subprocess.STDOUT, start_new_session=True)  # fmt: skip
        try:
            code: int | None = process.wait(limit)
        except subprocess.TimeoutExpired:
            code = None
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
    seconds = time.monotonic() - start
    results, problem = None, ""
    if task.check is not None:
        try:
            results, problem = task.check(folder)
        except (OSError, ValueError, KeyError, IndexError) as error:
            problem = f"its results cannot be read: {type(error).__name__}: {error}"
    if code is None:
        return Part(task.name, shown, "timed out", seconds, f"it took more than {limit:.0f} s", tail(log), results)
    if code:
        return Part(task.name, shown, "failed", seconds, problem or f"exit code {code}", tail(log), results)
    return Part(
        task.name, shown, "failed" if problem else "ok", seconds, problem, tail(log) if problem else [], results
    )


def _write(folder: Path, variant: str, quick: bool, parts: list[Part]) -> None:
    from reslrb_cli.backend.doctor import device_name

    found = {"variant": variant, "device": device_name(variant), "quick": quick, "parts": [asdict(p) for p in parts]}
    (folder / "gpu_check.json").write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    (folder / "gpu_check.md").write_text(section(found), encoding="utf-8")


def _json(file: Path) -> Any:
    return json.loads(file.read_text(encoding="utf-8"))


def _rows(name: str) -> Callable[[Path], tuple[Any, str]]:
    """A check that there are rows in a file of one object a line."""

    def check(folder: Path) -> tuple[Any, str]:
        lines = [json.loads(line) for line in (folder / name).read_text(encoding="utf-8").splitlines()]
        rows = [line for line in lines if line.get("kind") != "origin"]  # the first says what wrote them
        failed = [row for row in rows if row.get("holds") is False or row.get("status") == "failed"]
        return rows, "" if rows and not failed else f"{len(failed)} of {len(rows)} rows failed"

    return check


def _check_doctor(variant: str) -> Callable[[Path], tuple[Any, str]]:
    def check(folder: Path) -> tuple[Any, str]:
        text = (folder / "doctor.log").read_text(encoding="utf-8")
        found = json.loads(text[text.index("{") : text.rindex("}") + 1])
        [backend] = [backend for backend in found["backends"] if backend["variant"] == variant]
        return found, backend["missing"]

    return check


def _check_demo(folder: Path) -> tuple[Any, str]:
    """The demo's loss is to fall."""
    rows = [json.loads(line) for line in (folder / "demo" / "metrics.jsonl").read_text(encoding="utf-8").splitlines()]
    first, last = rows[0], rows[-1]
    keys = ("iteration", "loss", "step_ms", "elapsed_s", "peak_mib", "parameter_rmse")
    found = {"first": {key: first.get(key) for key in keys}, "last": {key: last.get(key) for key in keys}}
    return found, "" if last["loss"] < first["loss"] else f"the loss went from {first['loss']} to {last['loss']}"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
