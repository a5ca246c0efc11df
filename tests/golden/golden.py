"""Golden values: the exact bits of three iterations of each run in `RUNS`, and the output of commands.

The golden values protect changes that must not change any result, for example merged, moved or renamed files. Run as a
program, this file rewrites `values.json` in the same folder for this processor and libLLVM. On another machine, run it
on the commit before the change. `tests/test_golden.py` compares the values. One thread computes the kernels, because
sums over several threads are not reproducible.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
VALUES = Path(__file__).with_name("values.json")
SCHEMA = ROOT / "docs" / "config.schema.json"
#: The smallest settings that still exercise every part of a run. Plain gradient descent hides no bit of the gradients.
SMALL = (
    "run.iterations=3", "run.spp=8", "run.final_spp=8", "run.certainty=false",
    "target.render.spp=8", "loss={type: l2}", "optimizer={type: sgd, learning_rate: 10}",
)  # fmt: skip
#: Configuration, seed, and settings of each run, by name of the run.
RUNS: dict[str, tuple[str, int, tuple[str, ...]]] = {}


def _run(name: str, config: str, *settings: str, seed: int = 0) -> None:
    RUNS[name] = (config, seed, settings)


def _ours(estimator: str, adjoint: str, guiding: str = "off", sequence: str = "independent", more: str = "") -> str:
    drawn = f"guiding: {guiding}, sequence: {sequence}{more}"
    return f"integrator={{type: reslrb, max_depth: 4, estimator: {estimator}, {drawn}}}|run.adjoint={adjoint}"


for _number, (_estimator, _adjoint) in enumerate(
    [("stack", "batched"), ("gather", "correlated"), ("reservoir", "independent"), ("event", "batched")]
):
    _run(f"floor_{_estimator}", "cornell_floor", _ours(_estimator, _adjoint), seed=_number)
    _run(f"room_{_estimator}", "grey_room", _ours(_estimator, _adjoint, guiding="on"), seed=_number)
    _run(f"slab_{_estimator}", "caustic_slab", _ours(_estimator, _adjoint, sequence="low_discrepancy"), seed=_number)
_run("floor_guided", "cornell_floor", _ours("stack", "batched", "on", "low_discrepancy"))
_run(
    "floor_not_frozen",
    "cornell_floor",
    _ours(
        "stack",
        "batched",
    ),
)
_run("floor_adjoint", "cornell_floor", _ours("reservoir", "batched", more=", weight: adjoint, capacity: 2"))
_run("heights_stack", "caustic_heightmap", _ours("stack", "independent"))
_run("heights_reservoir", "caustic_heightmap", _ours("reservoir", "independent"))
_POSE = ("run.blur=0", "parameters[0].learning_rate={translation: 0.006, rotation: 0.5}")
_run("pose_stack", "lens_pose", _ours("stack", "independent"), *_POSE)
_run("pose_guided", "lens_pose", _ours("stack", "batched", "on"), *_POSE)
_run("furnace_gather", "furnace", _ours("gather", "independent"))
_run("lamp_event", "stiff/lamp", _ours("event", "independent"))
_run("plate_stack", "stiff/plate", _ours("stack", "batched", "on"))
_run("wall_gather", "stiff/wall", _ours("gather", "correlated"))
for _type in ("ptracer", "prb", "walk_ad", "trajectory"):
    _run(f"floor_{_type}", "cornell_floor", f"integrator={{type: {_type}, max_depth: 4}}|run.adjoint=independent")
#: Commands whose help texts are compared.
COMMANDS = (
    *("", "inspect", "init", "lens", "optimize", "sweep", "example", "render", "export", "gradcheck", "bench"),
    *("convergence", "report", "doctor"),
)
#: Tiny measurements. The structure of their JSON lines is compared: names and types at all depths.
_TINY = ("--set", "scene.options.size=8", "--set", "run.spp=4")
_FLOOR = (
    "configs/cornell_floor.yaml",
    "--set",
    "scene.size=[8, 8]",
    "--set",
    "run.spp=4",
    "--set",
    "target.render.spp=4",
)
MEASUREMENTS = {
    "gradcheck": ("gradcheck", *_TINY, "--seeds", "4", "--integrators", "reslrb:stack"),
    "bench": ("bench", *_TINY, "--max-depth", "2", "--rounds", "1", "--integrators", "reslrb:stack"),
    "convergence": ("convergence", *_FLOOR, "--integrators", "reslrb:stack,prb", "--rounds", "4"),
    "inspect": ("inspect", "configs/cornell_floor.yaml", "--json"),
}
_ALONE = """
import sys
import reslrb_cli
sys.path.insert(0, {tests!r})
from reslrb_cli.backend.variant import set_variant
set_variant("llvm_ad_rgb")
from compilation import compute_alone
compute_alone()
import drjit
drjit.set_flag(drjit.JitFlag.KernelFreezing, {recorded})
from reslrb_cli.optimization import identifiability
identifiability.REACH_SPP = 8  # guided tables learn from these samples, too
from reslrb_cli.cli import main
main.main(sys.argv[1:], prog_name="reslrb")
"""


def machine() -> str:
    """Return what the bits depend on: the name, family and model of the processor, and the version of libLLVM."""
    sys.path.insert(0, str(ROOT))
    import reslrb_cli  # noqa: F401  # chooses libLLVM, so it comes before Dr.Jit

    words, about = reslrb("doctor").stdout, Path("/proc/cpuinfo").read_text()
    # A name such as "AMD EPYC" covers several generations, which compute different bits.
    found = [re.search(rf"^{name}\s*:\s*(.+)$", about, re.MULTILINE) for name in ("model name", "cpu family", "model")]
    name, family, model = (each[1] if each else "unknown" for each in found)
    version = re.search(r"libLLVM[^\n]*?(\d+\.\d+\.\d+)", words)
    return f"{name}, family {family}, model {model}, libLLVM {version[1] if version else 'unknown'}"


def reslrb(*words: str, alone: bool = False, recorded: bool = True) -> subprocess.CompletedProcess[str]:
    """Run the command line in a separate process, and return the finished process. With `alone`, one thread computes
    the kernels, and `recorded` turns the recording of steps on or off.
    """
    program = ["-c", _ALONE.format(tests=str(ROOT / "tests"), recorded=recorded)] if alone else ["-m", "reslrb_cli"]
    environment = os.environ | {"COLUMNS": "100", "NO_COLOR": "1"}
    return subprocess.run(
        [sys.executable, *program, *words], cwd=ROOT, env=environment, capture_output=True, text=True, check=False
    )


def bits(array: np.ndarray[Any, Any]) -> str:
    """Return a short text with an array's shape and a hash of its bits."""
    array = np.ascontiguousarray(array)
    return f"{'x'.join(map(str, array.shape))} {hashlib.sha256(array.tobytes()).hexdigest()[:16]}"


def values_of(name: str, other_seed: bool = False) -> dict[str, Any]:
    """Return the loss and gradient norm of each iteration, and the bits of parameters and images after the last
    iteration.
    """
    config, seed, settings = RUNS[name]
    own = [word for setting in settings for word in setting.split("|")]
    with tempfile.TemporaryDirectory() as folder:
        words = [
            *SMALL,
            f"scene.size={size(config)}",
            f"run.seed={seed + 100 * other_seed}",
            *own,
            f"run.output={folder}",
        ]
        if config == "stiff/lamp":  # its target has its own integrator
            words.append("target.render={spp: 8}")
        sets = [part for word in words for part in ("--set", word)]
        words, recorded = ["--quiet", *sets, "--set", "run.name=run"], name != "floor_not_frozen"
        done = reslrb("optimize", f"configs/{config}.yaml", *words, alone=True, recorded=recorded)
        if done.returncode:
            return {"error": done.stderr.splitlines()[-1:]}
        run = Path(folder) / "run"
        records = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
        found: dict[str, Any] = {key: [record[key] for record in records] for key in ("loss", "grad_norm")}
        with np.load(run / "parameters" / "parameters.npz") as arrays:
            found |= {key: bits(arrays[key]) for key in sorted(arrays)}
        import OpenEXR

        for image in sorted((run / "images").glob("*.exr")):
            channels = OpenEXR.File(str(image)).channels()
            found[image.name] = " ".join(bits(channels[channel].pixels) for channel in sorted(channels))
    return found


def size(config: str) -> list[int]:
    """Return the film size in pixels. The film is small, and is square unless the scene's film is not."""
    return [24, 18] if config == "grey_room" else [16, 16]


def form(value: Any) -> Any:
    """Return the names and types in a JSON value. Lists give the set of the forms of all entries."""
    if isinstance(value, dict):
        return {key: form(inner) for key, inner in sorted(value.items())}
    if isinstance(value, list):
        return sorted({json.dumps(form(inner), sort_keys=True) for inner in value})
    return "number" if isinstance(value, (int, float)) and not isinstance(value, bool) else type(value).__name__


def form_of(name: str) -> list[str]:
    """Return the forms of all JSON lines of a tiny measurement."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "lines.json"
        words = [] if name == "inspect" else ["--json", str(file)]
        done = reslrb(*MEASUREMENTS[name], *words)
        text = done.stdout if name == "inspect" else file.read_text() if file.exists() else done.stderr
        whole = name == "inspect"  # one object on several lines
        lines = (
            [json.loads(text)] if whole else [json.loads(line) for line in text.splitlines() if line.startswith("{")]
        )
    return sorted({json.dumps(form(line), sort_keys=True) for line in lines})


def texts() -> dict[str, str]:
    """Return digests of the help of each command, and of the configuration schema."""
    found = {f"help {command}".strip(): reslrb(*command.split(), "--help").stdout for command in COMMANDS}
    found["schema"] = SCHEMA.read_text(encoding="utf-8")
    return {name: hashlib.sha256(text.encode()).hexdigest()[:16] for name, text in found.items()}


def main() -> None:
    """Rewrite the values of this machine and the values of all machines. With `--texts`, rewrite only the values of the
    printed output.
    """
    content = json.loads(VALUES.read_text()) if VALUES.exists() else {"machines": {}}
    if "--texts" in sys.argv[1:]:
        content["texts"], content["forms"] = texts(), {name: form_of(name) for name in MEASUREMENTS}
        VALUES.write_text(json.dumps(content, indent=1, sort_keys=True) + "\n")
        return
    with ThreadPoolExecutor(2) as pool:
        made = pool.map(lambda pair: values_of(*pair), [(name, other) for name in RUNS for other in (False, True)])
        names = [f"{name}{', another seed' * other}" for name in RUNS for other in (False, True)]
        content["machines"][machine()] = dict(zip(names, made, strict=True))
        content["forms"] = dict(zip(MEASUREMENTS, pool.map(form_of, MEASUREMENTS), strict=True))
    content["texts"] = texts()
    VALUES.write_text(json.dumps(content, indent=1, sort_keys=True) + "\n")


if __name__ == "__main__":
    main()
