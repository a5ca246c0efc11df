"""Trial of a variant in a separate process. The trial compiles and runs one kernel, and traces one ray.

A faulty driver or libLLVM may crash the process instead of raising an exception. Only a parent process can detect this.
"""

from __future__ import annotations

import functools
import subprocess

from reslrb_cli.backend.installation import MISSING_LIBRARY, python_command
from reslrb_cli.backend.shared_library import missing_library

# A constant that no kernel cache contains makes the compiler run; `minimum` is the instruction that libLLVM 15 and 16
# fail on.
_SCRIPT = """
import sys, time
import reslrb_cli
from reslrb_cli.backend.installation import load_packages, prefer_own_plugins

dr, mi = load_packages()
mi.set_variant(sys.argv[1])
prefer_own_plugins()
salt = (time.time_ns() & 0xFFFFFF) * 1e-6
value = dr.minimum(dr.sin(dr.arange(mi.Float, 1 << 20)) + salt, 0.5)
assert abs(value[0] - min(salt, 0.5)) < 1e-4, f"wrong result {value[0]}"

scene = mi.load_dict({"type": "scene", "shape": {"type": "sphere"}})
t = scene.ray_intersect(mi.Ray3f(mi.Point3f(0, 0, -3), mi.Vector3f(0, 0, 1))).t
assert abs(t[0] - 2) < 1e-4, f"a ray met the unit sphere at {t[0]} instead of 2"
"""

#: Prefix of the line of our own error in a traceback.
_OURS = "reslrb_cli.errors.BackendError: "


@functools.cache
def probe(variant: str) -> str:
    """Run the trial for `variant`. Returns the reason of a failure in one line, or "" if the variant works."""
    command = [*python_command(_SCRIPT), variant]
    try:
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=300, check=False)
    except subprocess.TimeoutExpired:
        return "no result within 300 s"
    except OSError as error:
        return f"could not be tested ({error})"
    if done.returncode == 0:
        return ""
    missing = missing_library(done.stderr)
    if missing:
        return f"Mitsuba needs {missing}, which is missing; {MISSING_LIBRARY}"
    said = [line.strip() for line in done.stderr.splitlines() if line.strip()]
    if done.returncode < 0:
        return f"ended by signal {-done.returncode}: {said[0] if said else 'no message'}"
    return said[-1].removeprefix(_OURS) if said else f"ended with code {done.returncode}"
