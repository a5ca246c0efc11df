"""Trial of a variant in a separate process. The trial compiles and runs one kernel, traces one ray, and times both.

A faulty driver or libLLVM may crash the process instead of raising an exception. Only a parent process can detect this.
"""

from __future__ import annotations

import functools
import json
import subprocess
from dataclasses import dataclass

from reslrb_cli.backend.installation import MISSING_LIBRARY, python_command
from reslrb_cli.backend.shared_library import missing_library

# A constant that no kernel cache contains makes the compiler run; `minimum` is the instruction that libLLVM 15 and 16
# fail on.
_SCRIPT = """
import json, sys, time
import reslrb_cli
from reslrb_cli.backend.installation import load_packages
from reslrb_cli.backend.installation import prefer_own_plugins

dr, mi = load_packages()
mi.set_variant(sys.argv[1])
prefer_own_plugins()
salt = (time.time_ns() & 0xFFFFFF) * 1e-6

def timed(work):
    start = time.perf_counter()
    value = work()
    dr.eval(value)
    dr.sync_thread()
    return 1e3 * (time.perf_counter() - start), value

def kernel():
    x = dr.arange(mi.Float, 1 << 20)
    return dr.minimum(dr.sin(x) + salt, 0.5)

compile_ms, value = timed(kernel)
run_ms, value = timed(kernel)
assert abs(value[0] - min(salt, 0.5)) < 1e-4, f"wrong result {value[0]}"

scene = mi.load_dict({"type": "scene", "shape": {"type": "sphere"}})
ray = mi.Ray3f(mi.Point3f(0, 0, -3), mi.Vector3f(0, 0, 1))
ray_ms, t = timed(lambda: scene.ray_intersect(ray).t)
assert abs(t[0] - 2) < 1e-4, f"a ray met the unit sphere at {t[0]} instead of 2"
print(json.dumps({"compile_ms": compile_ms, "run_ms": run_ms, "ray_ms": ray_ms}))
"""

#: Prefix of the line of our own error in a traceback.
_OURS = "reslrb_cli.errors.BackendError: "


@dataclass(frozen=True)
class Probe:
    """Result of the trial of a variant. `failure` describes the fault in one line, or is empty.

    `compile_ms` is the time to compile and run a kernel of a million entries. `run_ms` is the time to run the kernel
    again. `ray_ms` is the time of the first ray through a scene, including compilation.
    """

    failure: str = ""
    compile_ms: float | None = None
    run_ms: float | None = None
    ray_ms: float | None = None


@functools.cache
def probe(variant: str) -> Probe:
    """Run the trial for `variant`; never raises."""
    command = [*python_command(_SCRIPT), variant]
    try:
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=300, check=False)
    except subprocess.TimeoutExpired:
        return Probe("no result within 300 s")
    except OSError as error:
        return Probe(f"could not be tested ({error})")
    if done.returncode == 0:
        try:
            return Probe(**json.loads(done.stdout.splitlines()[-1]))
        except (ValueError, TypeError, IndexError):
            return Probe("ended without a result")
    missing = missing_library(done.stderr)
    if missing:
        return Probe(f"Mitsuba needs {missing}, which is missing; {MISSING_LIBRARY}")
    said = [line.strip() for line in done.stderr.splitlines() if line.strip()]
    if done.returncode < 0:
        return Probe(f"ended by signal {-done.returncode}: {said[0] if said else 'no message'}")
    return Probe(said[-1].removeprefix(_OURS) if said else f"ended with code {done.returncode}")
