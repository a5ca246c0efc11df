"""Calls of commands within the tests' own process, and an experiment of 8x8 pixels that takes a second."""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result
from compilation import search_path
from kit import POSTER_BSDF, ref, scene, sensor, shape

from reslrb_cli.cli import main
from reslrb_cli.records.manifest import read_content, read_manifest
from reslrb_cli.runs import prepare
from reslrb_cli.runs import recorder as recording

# The commands of `reslrb`, called within the test process.


def reslrb(*arguments: object) -> Result:
    """Run `reslrb ARGUMENTS` and return its output and exit code."""
    return CliRunner().invoke(main, [str(argument) for argument in arguments], prog_name="reslrb")


def done(*arguments: object) -> Result:
    """Run `reslrb ARGUMENTS`, which has to succeed, and return the result."""
    result = reslrb(*arguments)
    assert result.exit_code == 0, result.output
    return result


def outcome(*arguments: object) -> tuple[int, str, str]:
    """Run `reslrb ARGUMENTS` and return the exit code, standard output and standard error."""
    result = reslrb(*arguments)
    return result.exit_code, result.stdout, result.stderr


def settings(*given: str) -> list[str]:
    """Return `--set SETTING` for each of the settings."""
    return [word for setting in given for word in ("--set", setting)]


def read_metrics(folder: Path | str) -> list[dict[str, Any]]:
    """Return the lines of a run's metrics, oldest first."""
    return [json.loads(line) for line in (Path(folder) / "metrics.jsonl").read_text().splitlines()]


def manifest(folder: Path | str = "runs/tiny") -> dict[str, Any]:
    """Return the manifest of a run."""
    content: dict[str, Any] = json.loads((Path(folder) / "manifest.json").read_text())
    return content


# Failures during a tiny run, and the messages of the run about them.

RUN = Path("runs/tiny")


def full(*args, **options):
    raise OSError(errno.ENOSPC, "No space left on device", "runs/tiny/x")


def lines(text):
    """Return the lines of standard error that do not report progress."""
    return [
        line for line in text.splitlines() if not line.startswith(("variant ", "rendering ", "finding ", *"123456789"))
    ]


def failing_last(monkeypatch, name, failure=full, calls=1):
    """Make `recording.<name>` fail after its first `calls` calls. The name `save_checkpoint` stands for the function in
    `prepare` instead.
    """
    holder = prepare if name == "save_checkpoint" else recording
    real, seen = getattr(holder, name), []

    def sometimes(*args, **options):
        seen.append(args)
        return real(*args, **options) if len(seen) <= calls else failure()

    monkeypatch.setattr(holder, name, sometimes)


# An experiment of 8x8 pixels that takes a second, and helpers that the tests of run endings share.

ROOT = Path(__file__).resolve().parents[2]
KEY = "poster.reflectance.data"
DESCENT = "optimizer={type: sgd, scale: curvature}"
#: Three positions of the camera.
EYES = ("0, 0, 4", "1, 0.5, 4", "-1, 1, 3")


def scene_seen(*eyes: str, rfilter: str = "box") -> str:
    """Return the scene with a sensor at each of the positions `eyes`."""
    return scene(
        *(sensor(eye, rfilter=rfilter) for eye in eyes), POSTER_BSDF, shape("rectangle", "wall", ref("poster")),
        """<shape type="rectangle" id="lamp">
        <transform name="to_world"><rotate x="1" angle="180"/><translate z="5"/></transform>
        <emitter type="area"><rgb name="radiance" value="8, 8, 8"/></emitter>
    </shape>""",
    )  # fmt: skip


SCENE = scene_seen("0, 0, 4")
CONFIG = f"""
variant: llvm_ad_rgb
scene: {{file: scene.xml}}
target: {{render: {{spp: 16}}}}
parameters:
  - {{key: {KEY}, initial: 0.5, bounds: [0, 1]}}
integrator: {{type: reslrb, max_depth: 3, estimator: stack}}
run: {{iterations: 5, spp: 4}}
"""
#: Files of a run folder after a successful run.
COMPLETE = {
    "checkpoint/state.npz", "config.yaml", "manifest.json", "metrics.jsonl", "report.html", "parameters/parameters.npz",
    "parameters/parameters.json", *(f"images/{name}.{kind}" for name in ("initial", "final", "target")
    for kind in ("exr", "png")), *(f"parameters/{folder}{KEY}.{kind}" for folder in ("", "initial/", "true/")
    for kind in ("exr", "png")),
}  # fmt: skip


def write_experiment(folder: Path, text: str = SCENE) -> None:
    """Write scene, texture and `tiny.yaml` to `folder`. A variant must be set."""
    import mitsuba as mi
    import numpy as np

    texture = np.random.default_rng(2).uniform(0.1, 0.9, (4, 4, 3)).astype(np.float32)
    mi.Bitmap(texture).write(str(folder / "poster.exr"))
    (folder / "scene.xml").write_text(text)
    (folder / "tiny.yaml").write_text(CONFIG)


def write_photo(path: Path, image: Any) -> None:
    """Write linear values as an 8-bit image. A variant must be set."""
    import mitsuba as mi
    import numpy as np

    bitmap = mi.Bitmap(np.ascontiguousarray(image[:, :, :3], dtype=np.float32))
    bitmap.convert(component_format=mi.Struct.Type.UInt8, srgb_gamma=True).write(str(path))


def start(
    folder: Path, *args: str, command: str = "optimize", details: bool = False, config: bool = True, **options: Any
) -> subprocess.Popen[str]:
    """Start `reslrb COMMAND tiny.yaml` in its own process, with `folder` as its working directory. With `details`, it
    prints all messages. Without `config`, `tiny.yaml` is left out.
    """
    # Start the program like its entry point, so that its name is `reslrb` from the first line on.
    script = "import logging, sys; sys.argv[0] = 'reslrb'; from reslrb_cli.cli import LogLines, run; "
    if details:  # without the tracebacks of --debug
        script += "log = logging.getLogger('reslrb_cli'); log.addHandler(LogLines()); log.setLevel('DEBUG'); "
    script += "run()"
    words = [sys.executable, "-c", script, command, *(["tiny.yaml"] if config else []), *args]
    environment = {**os.environ, "PYTHONPATH": search_path(ROOT), "RESLRB_CACHE": str(folder / "cache")}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, **options}
    return subprocess.Popen(words, cwd=folder, env=environment, **pipes)


def files(folder: Path) -> set[str]:
    """Return all files in `folder`, with relative paths."""
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def faults(folder: Path, code: int, err: str) -> list[str]:
    """Return the faults of a run folder whose process ended with `code` and printed `err`. The list is empty if there
    are none.
    """
    found = ["a traceback"] if "Traceback" in err or "Exception ignored" in err else []
    found += [] if code in (0, 130, 6, -signal.SIGKILL) or not folder.exists() else [f"exit code {code}"]
    if not folder.exists():
        return found
    stored, read = read_content(folder), read_manifest(folder)
    if stored is None or read is None:
        return [*found, "no manifest"]
    status = read["status"]
    found += [f"empty: {name}" for name in files(folder) if (folder / name).stat().st_size == 0]
    found += [f"left: {name}" for name in files(folder) if Path(name).name.startswith(".")]
    expected = {0: "finished", 130: "interrupted", 6: "failed", -signal.SIGKILL: read_content(folder)["status"]}.get(
        code
    )  # type: ignore[index]
    found += [] if status == expected and status != "running" else [f"{status} after exit code {code}"]
    found += [] if stored["status"] != "running" or code < 0 else ["left as running"]
    if (folder / "metrics.jsonl").exists():
        lines = (folder / "metrics.jsonl").read_text().splitlines(keepends=True)
        iterations = [json.loads(line)["iteration"] for line in lines]
        found += [] if iterations == list(range(len(iterations))) and lines[-1].endswith("\n") else ["torn metrics"]
    absent = {name for name in COMPLETE if not (folder / name).exists()}
    absent -= {"report.html"} if code == -signal.SIGKILL else set()  # the page can be written again later
    if status == "finished" and absent - {"report.html"}:
        found.append(f"absent: {sorted(absent)}")
    return found


def ended(*words: str) -> int:
    """Run a command in this process, and return its exit code."""
    with pytest.raises(SystemExit) as end:
        main([*words], prog_name="reslrb")
    return int(end.value.code or 0)


def measured(file: Path | str) -> list[dict[str, Any]]:
    """Return the lines of a `--json` file without the first line, which describes the origin of the measurement."""
    origin, *lines = [json.loads(line) for line in Path(file).read_text().splitlines()]
    assert origin["kind"] == "origin"
    return lines
