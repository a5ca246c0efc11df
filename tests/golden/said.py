"""Texts, records and files that tests compare in whole with those of an earlier time, in `said.json`.

If a change is intended, run the tests with RESLRB_GOLDEN=write, and read the difference of `said.json`. Times and names
of the machine are masked (`masked`). With RESLRB_GOLDEN=unstable, `check` puts `UNSTABLE` in place of stored entries
that differ, and accepts any entry there later.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
import re
from functools import cache, partial
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np

FILE, UNSTABLE = Path(__file__).with_name("said.json"), "~"
ROOT = Path(__file__).resolve().parents[2]
#: A number with decimals or an exponent.
_DECIMAL = re.compile(r"(-?\d+\.\d+(?:e[-+]\d+)?|-?\d+e[-+]\d+)")


def check(name: str, found: Any, within: float = 0.01) -> None:
    """Compare a text, or a value for JSON, with the stored one of this `name`. Decimals may differ by the share
    `within`; a hundredth covers rounding in print.
    """
    found = json.loads(json.dumps(found.splitlines() if isinstance(found, str) else found, default=str))
    content = stored()
    if mode := os.environ.get("RESLRB_GOLDEN"):
        content[name] = _stable(found, content.get(name)) if mode == "unstable" else found
        FILE.write_text(_written(content))
    changed = "\n".join(_differences(found, content.get(name), within=within)[:9])
    assert not changed, f"{name} has changed; if intended, run the test with RESLRB_GOLDEN=write\n{changed}"


@cache
def stored() -> dict[str, Any]:
    """Return everything that is stored, by name."""
    found: dict[str, Any] = json.loads(FILE.read_text())
    return found


def _stable(found: Any, known: Any) -> Any:
    """Return the known value with `UNSTABLE` in place of the entries that differ."""
    if isinstance(found, dict) and isinstance(known, dict):
        return {key: _stable(found.get(key), known.get(key)) for key in dict.fromkeys([*known, *found])}
    if isinstance(found, list) and isinstance(known, list) and len(found) == len(known):
        return [_stable(*pair) for pair in zip(found, known, strict=True)]
    return UNSTABLE if _differences(found, known) else known


def _differences(found: Any, known: Any, place: str = "", within: float = 0.01) -> list[str]:
    """Return a line for each difference. Decimals may differ by the share `within`, also in texts."""
    if isinstance(found, dict) and isinstance(known, dict):
        pairs = ((found.get(key), known.get(key), f"{place} {key}") for key in dict.fromkeys([*known, *found]))
        return [line for pair in pairs for line in _differences(*pair, within)]
    if isinstance(found, list) and isinstance(known, list):
        pairs = ((*pair, f"{place} {number}") for number, pair in enumerate(zip_longest(found, known)))
        return [line for pair in pairs for line in _differences(*pair, within)]
    if known == UNSTABLE:
        return []
    parts, others = (_DECIMAL.split(str(each)) for each in (found, known))
    is_alike = type(found) is type(known) and parts[::2] == others[::2]
    is_close = partial(math.isclose, rel_tol=within, abs_tol=1e-6)
    if is_alike and all(is_close(float(a), float(b)) for a, b in zip(parts[1::2], others[1::2], strict=True)):
        return []
    return [f"{place}: {found!r} was {known!r}"]


#: Entries that differ between machines or runs, and times in text.
OTHERS = {
    *("step_ms", "codegen_ms", "elapsed_s", "first_s", "peak_mib", "curvature_s", "at", "started", "ended", "process"),
    *("device", "platform", "versions", "commit", "written", "seconds", "program", "files", "codes"),
    *("command_line", "command"),
}
#: Folders of other fixtures.
_TEMPORARY = re.compile(r"/\S*/pytest-of-\w+/pytest-\d+/(popen-gw\d+/)?")
#: Lines about the variant, and about progress. A slow machine prints the stages of `lens`.
_PASSING = re.compile(r"variant |\d+/\d+: |(grid of \d+x\d+|floor of [\d.]+ %|solid) \.\.\.$")
_TIME = re.compile(r"\d{4}-\d\d-\d\dT[\d:+]+|\b\d+\.\d+ s\b|\b\d+ MiB\b")


def masked(value: Any, folder: Path) -> Any:
    """Return a value of JSON without what differs between machines or runs."""
    if isinstance(value, dict):
        return {key: "..." if key in OTHERS else masked(each, folder) for key, each in value.items()}
    if isinstance(value, list):
        return [masked(each, folder) for each in value]
    if not isinstance(value, str):
        return value
    # A path may be relative to the working directory.
    own = re.sub(rf"[\w./-]*{re.escape(str(folder)[max(str(folder).find('pytest-of-'), 0) :])}", "HERE", value)
    return _TIME.sub("...", _TEMPORARY.sub("", own.replace(str(folder), "HERE").replace(str(ROOT), "ROOT")))


def lines_of(*texts: str) -> list[str]:
    """Return the lines of a command's output, without those that depend on time or on earlier commands."""
    return [line for text in texts for line in text.splitlines() if not _PASSING.match(line)]


def content(file: Path, folder: Path) -> Any:
    """Return the content of a file for comparison."""
    if file.suffix == ".npz":
        with np.load(file) as arrays:
            found = {name: plain(arrays[name]) for name in arrays.files if name != "state"}
            state = json.loads(arrays["state"].tobytes()) if "state" in arrays else None
        return masked(found | ({} if state is None else {"state": state}), folder)
    if file.suffix in (".exr", ".png"):
        import mitsuba as mi

        return plain(np.array(mi.Bitmap(str(file))))
    if file.suffix == ".npy":
        return plain(np.load(file))
    if file.suffix not in (".json", ".jsonl", ".yaml", ".log", ".xml"):
        return "text" if file.suffix == ".html" else f"{file.stat().st_size} bytes"
    text = file.read_text()
    if file.suffix == ".json":
        return masked(json.loads(text), folder)
    if file.suffix == ".jsonl":
        return [json.dumps(masked(json.loads(line), folder)) for line in text.splitlines()]
    return masked(text.splitlines(), folder)


def _written(content: dict[str, Any]) -> str:
    """Return JSON with one line for each entry of each value."""
    parts = []
    for name, value in sorted(content.items()):
        text = json.dumps(value, sort_keys=True)
        if isinstance(value, dict):
            inner = ",\n".join(
                f"  {json.dumps(key)}: {json.dumps(value[key], sort_keys=True)}" for key in sorted(value)
            )
            text = f"{{\n{inner}\n }}"
        elif isinstance(value, list):
            text = "[\n" + ",\n".join(f"  {json.dumps(each, sort_keys=True)}" for each in value) + "\n ]"
        parts.append(f" {json.dumps(name)}: {text}")
    return "{\n" + ",\n".join(parts) + "\n}\n"


def plain(value: Any) -> Any:
    """Return a value for JSON: records as mappings without None and False, arrays as shape, type, sum,
    norm and moment, and objects of scenes as ids.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        entries = ((each.name, plain(getattr(value, each.name))) for each in dataclasses.fields(value))
        return {name: entry for name, entry in entries if entry is not None and entry is not False}
    if isinstance(value, (list, tuple)):
        return [plain(each) for each in value]
    if isinstance(value, np.ndarray):
        wide = value.astype(np.float64).ravel()
        moment = wide @ np.linspace(0, 1, len(wide))  # differs if entries change places
        return [str(value.shape), str(value.dtype), float(wide.sum()), float(np.linalg.norm(wide)), float(moment)]
    return value.id() if hasattr(value, "class_name") else value
