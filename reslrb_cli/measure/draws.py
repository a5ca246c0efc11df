"""Draws: samples of a quantity by one method at numbered seeds, and the file that keeps them.

All statistics are functions of draws. A draw on file is not drawn again, so more seeds, another method or another
statistic cost only the missing draws.

A file is an `.npz` archive. `header` is JSON with one entry for each set of draws: its label and options, and `about`,
which names everything that determines a draw. The arrays of entry N are `N/values`, `N/seeds` and so on. Results that
draws depend on, such as dL/dI, are stored beside the draws (`StoredResults`). Does not import Mitsuba.
"""

from __future__ import annotations

import functools
import json
import os
import platform
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from reslrb_cli.config.files import as_path
from reslrb_cli.config.schema import Config
from reslrb_cli.errors import ConfigError
from reslrb_cli.records.checkpoint import entries_below, open_archive, write_archive
from reslrb_cli.records.decisions import key_of
from reslrb_cli.records.manifest import now, versions

Array = np.ndarray[Any, Any]

#: Version of the file format. It changes when the meaning of an entry changes.
FORMAT = 1

#: Arrays of draws, with one row for each draw.
ARRAYS = ("values", "seeds", "step_ms", "kernel_ms", "codegen_ms", "origin")

#: Figures of the first step of a process.
FIRST_STEP = ("peak_mib", "cold_ms", "scratch_bytes")

#: Packages whose versions determine a draw.
PACKAGES = ("reslrb", "mitsuba", "drjit")

#: Sections of a configuration that determine a draw, besides the seed and the options of a step in `run`.
SECTIONS = {"scene", "target", "views", "parameters", "integrator", "loss"}


@functools.cache
def this_session() -> str:
    """Return the origin of draws by this process: the host, and the time of the first call."""
    return f"{platform.node() or 'unknown host'}, {now()}"


@dataclass(frozen=True, kw_only=True)
class Draws:
    """Samples of one quantity by one method.

    - `values` (N, P) are the samples in single precision. P is 0 if only times are measured.
    - `seeds` (N,) are the numbers of the draws, which select their random numbers, and dL/dI if there are several.
    - `step_ms`, `kernel_ms` and `codegen_ms` (N,) are times as in a `BenchRecord`. NaN stands for no measurement.
    - `origin` (N,) names the session of each draw (`this_session`). Times of different sessions are not comparable.
    - `peak_mib`, `cold_ms` and `scratch_bytes` belong to the first step of a process, as in a `BenchRecord`.
    - `label` is the method as the user wrote it, and `options` are the options in it.
    """

    label: str
    values: Array
    seeds: Array
    step_ms: Array
    kernel_ms: Array
    codegen_ms: Array
    origin: Array
    options: Mapping[str, Any] = field(default_factory=dict)
    peak_mib: float | None = None
    cold_ms: float | None = None
    scratch_bytes: int | None = None

    @classmethod
    def of(
        cls, label: str, values: Any, seeds: Sequence[int] | range, *, step_ms: Any = np.nan, kernel_ms: Any = np.nan,
        codegen_ms: Any = np.nan, origin: str | None = None, **others: Any,
    ) -> Draws:  # fmt: skip
        """Return draws of one session, by default of this session. `values` has a row for each of the `seeds`. Times
        are arrays, or one number for all draws.
        """
        count, session = len(seeds), this_session() if origin is None else origin
        times = {"step_ms": step_ms, "kernel_ms": kernel_ms, "codegen_ms": codegen_ms}
        filled: dict[str, Any] = {
            name: np.broadcast_to(np.asarray(time, np.float64), count) for name, time in times.items()
        }
        rows = np.asarray(values, np.float32).reshape(count, -1) if count else np.zeros((0, 0), np.float32)
        return cls(label=label, values=rows, seeds=np.array(seeds, np.int64).reshape(-1), **filled,
                   origin=np.full(count, session), **others)  # fmt: skip

    def __len__(self) -> int:
        return len(self.seeds)

    @staticmethod
    def joined(parts: Sequence[Draws]) -> Draws:
        """Return the draws of all parts, which belong to one method, by increasing seed. If several parts have a seed,
        the first part counts. Figures of the first step are from the first part that has them.
        """
        filled = [part for part in parts if len(part)] or [parts[0]]
        chosen = np.unique(np.concatenate([part.seeds for part in filled]), return_index=True)[1]
        fields: dict[str, Any] = {
            name: np.concatenate([getattr(part, name) for part in filled])[chosen] for name in ARRAYS
        }
        for name in FIRST_STEP:
            fields[name] = next((value for part in parts if (value := getattr(part, name)) is not None), None)
        return replace(parts[0], **fields)


def mixed_sessions(draws: Iterable[Draws]) -> str:
    """Return a warning if times of several sessions are compared, or an empty text."""
    found = sorted({session for one in draws for session in one.origin.tolist()})
    if len(found) < 2:
        return ""
    return f"times are from {len(found)} sessions, so ratios of times may compare machines: {'; '.join(found)}"


def situation(config: Config, variant: str, **others: Any) -> dict[str, Any]:
    """Return everything that determines a draw as plain values, for `DrawsFile`.

    These are the settings that matter for a step, the contents of their files, versions, the variant, and `others`,
    such as the quantity, the sample count and the purpose of the random numbers. Places of files do not count, so a
    moved experiment has the same draws. Raises ConfigError if a file cannot be read.
    """
    from reslrb_cli.scene.files import file_digests, files_of  # late, because it imports Mitsuba

    settings = config.model_dump(mode="json", include=SECTIONS)
    for parameter in settings["parameters"]:
        parameter.pop("learning_rate", None)
    text = json.dumps(settings, sort_keys=True, default=str)
    for path in sorted(map(str, config.paths.values()), key=len, reverse=True):
        text = text.replace(json.dumps(path)[1:-1], Path(path).name)
    known = versions()
    found = {
        "settings": key_of({"text": text}),
        "files": file_digests(files_of(config)),
        "step": config.step_options(),
        "seed": config.run.seed,
        "versions": {name: known[name] for name in PACKAGES},
        "variant": variant,
        **others,
    }
    plain: dict[str, Any] = json.loads(json.dumps(found, default=str))  # as it is read back from a file
    return plain


@dataclass(frozen=True)
class StoredResults:
    """Results that draws depend on: `facts` as JSON, and arrays."""

    facts: Mapping[str, Any]
    arrays: Mapping[str, Array]


class DrawsFile:
    """Draws by the situation that determines them, in a file, or in memory alone if `path` is None.

    Raises ConfigError if the file exists, but is damaged or not a file of draws.
    """

    def __init__(self, path: Path | None = None) -> None:
        self.path = None if path is None else as_path(path, "draws", "a file")
        self._about: dict[str, dict[str, Any]] = {}
        self._parts: dict[str, list[Draws]] = {}
        self._stored: dict[str, StoredResults] = {}
        self._changed, self._seen = False, self._state()
        if self._seen is not None:
            self._read()

    def draws(self, about: Mapping[str, Any]) -> Draws | None:
        """Return the draws of a situation, or None if there are none."""
        key = key_of(dict(about))
        return self._whole(key) if key in self._parts else None

    def __iter__(self) -> Iterator[Draws]:
        """Yield all draws of the file."""
        return map(self._whole, self._parts)

    def _whole(self, key: str) -> Draws:
        parts = self._parts[key]
        parts[:] = [Draws.joined(parts)] if len(parts) > 1 else parts
        return parts[0]

    def add(self, about: Mapping[str, Any], draws: Draws) -> None:
        """Add draws of a situation. Draws with seeds that are on file already are dropped."""
        key = key_of(dict(about))
        self._about.setdefault(key, dict(about))
        self._parts.setdefault(key, []).append(draws)
        self._changed = True

    def stored(self, about: Mapping[str, Any]) -> StoredResults | None:
        """Return the results that are stored for a situation, or None."""
        return self._stored.get(key_of(dict(about)))

    def store(self, about: Mapping[str, Any], stored: StoredResults) -> None:
        """Store results for a situation."""
        self._stored[key_of(dict(about))] = stored
        self._changed = True

    def differences(self, about: Mapping[str, Any]) -> list[str]:
        """Return the parts of a situation that differ from the most similar draws of the same `purpose`. The list is
        empty if there are draws of this situation, or none of the purpose.
        """
        found = [
            [name for name in about if other.get(name) != about[name]]
            for other in self._about.values()
            if other.get("purpose") == about.get("purpose")
        ]
        return min(found, key=len, default=[])

    # --- the file -----------------------------------------------------------------------------------------------------

    def save(self) -> None:
        """Write the file atomically if draws were added. Draws that another process wrote meanwhile are kept. Raises
        OSError, and ConfigError if the file was damaged meanwhile.
        """
        if self.path is None or not self._changed:
            return
        if self._state() not in (None, self._seen):
            self._read()
        entries, arrays = [], dict[str, Array]()
        for number, (key, one) in enumerate(zip(self._parts, self, strict=True)):
            arrays |= {f"{number}/{name}": getattr(one, name) for name in ARRAYS}
            first = {name: getattr(one, name) for name in FIRST_STEP}
            entries.append({"about": self._about[key], "label": one.label, "options": dict(one.options), **first})
        for number, one_stored in enumerate(self._stored.values()):
            arrays |= {f"stored {number}/{name}": array for name, array in one_stored.arrays.items()}
        header = {
            "program": "reslrb", "format": FORMAT, "written": now(), "draws": entries,
            "stored": [{"key": key, "facts": one.facts} for key, one in self._stored.items()],
        }  # fmt: skip
        text = json.dumps(header, default=str).encode()
        write_archive(Path(os.path.realpath(self.path)), {"header": np.frombuffer(text, np.uint8), **arrays})
        self._changed, self._seen = False, self._state()

    def _state(self) -> tuple[int, int, int] | None:
        """Return values that change whenever the file is replaced, or None if there is no file."""
        if self.path is None or not self.path.exists():
            return None
        found = self.path.stat()
        return found.st_ino, found.st_mtime_ns, found.st_size

    def _read(self) -> None:
        """Add the draws in the file to those in memory."""
        assert self.path is not None, "in memory alone"
        with open_archive(self.path) as archive:
            header = json.loads(archive["header"].tobytes()) if "header" in archive else None
            if not isinstance(header, dict) or header.get("program") != "reslrb" or header.get("format") != FORMAT:
                reason = "is no file of draws, or of another version of reslrb; name another file"
                raise ConfigError(self.path, "", reason)
            arrays = dict(archive)
            for number, entry in enumerate(header["draws"]):
                about = entry.pop("about")
                own: dict[str, Any] = {name: arrays[f"{number}/{name}"] for name in ARRAYS}
                if {len(array) for array in own.values()} != {len(own["seeds"])} or own["values"].ndim != 2:
                    raise ValueError(f"entry {number} has arrays of different lengths")
                key = key_of(about)
                self._about.setdefault(key, about)
                self._parts.setdefault(key, []).append(Draws(**entry, **own))
            for number, entry in enumerate(header["stored"]):
                found = StoredResults(entry["facts"], entries_below(arrays, f"stored {number}/"))
                self._stored.setdefault(entry["key"], found)
        self._seen = self._state()
