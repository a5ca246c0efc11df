"""Hundreds of states that are nearly right, in processes with limits: the run goes on, or one line says why not."""

from __future__ import annotations

import json
import random
import shutil
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli import tiny
from recording.going_on import left_over, records_of, state_of
from recording.test_states import PREVIOUS, STATE
from scene.mutations import mutate_bytes
from scene.test_mutations import Hostile, judge

from reslrb_cli.records.manifest import read_manifest

pytestmark = [
    pytest.mark.usefixtures("llvm"),
    pytest.mark.skipif(sys.platform != "linux", reason="reads /proc, and limits memory"),
]
Array = np.ndarray[Any, Any]

#: What an array of a state may be in place of what it is.
ARRAYS: tuple[Callable[[Array], Array], ...] = (
    lambda array: array * np.nan,
    lambda array: array * np.inf,
    lambda array: array * 0,
    lambda array: array * -1e30,
    lambda array: array.ravel()[:-1],
    lambda array: array.ravel()[:0],
    lambda array: array[None],
    lambda array: np.asfortranarray(array.T),
    lambda array: np.zeros(2**22, np.float32),
    lambda array: array.astype(np.float64),
    lambda array: array.astype(np.float16),
    lambda array: array.astype(np.int32),
    lambda array: array.astype(bool),
    lambda array: array.astype(">f4"),
    lambda array: array.astype("S8"),
    lambda array: np.array([{}], dtype=object),
)
#: What a value of its JSON may be.
VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 1, 5, 2**31, 10**30, -0.5, 1e308, 1e999, "", "x", "../../etc/passwd", "\x1b[31m"),
    *([], {}, [None], [1e308] * 3, [[1]], {"x": 1}, "a" * 10_000, [0] * 10_000, json.loads("[" * 500 + "]" * 500)),
)


def forge(rng: random.Random, path: Path) -> None:
    """Write a state anew, its checksums right, with another array or value, one left out, or one under another name."""
    with np.load(path) as state:
        arrays = {name: state[name] for name in state.files}
    values = json.loads(arrays.pop("state").tobytes())
    for _ in range(rng.choice((1, 1, 2, 3))):
        if rng.random() < 0.5 and arrays:
            name = rng.choice(sorted(arrays))
            kind = rng.random()
            if kind < 0.6:
                with np.errstate(all="ignore"):
                    arrays[name] = rng.choice(ARRAYS)(arrays[name])
            elif kind < 0.8:
                del arrays[name]
            else:
                arrays[rng.choice(("parameter/x", "../x", f"best/{tiny.KEY}", f"squares/{tiny.KEY}"))] = arrays[name]
        else:
            owner, key = rng.choice(list(_places(values)))
            if rng.random() < 0.8:
                owner[key] = rng.choice(VALUES)
            else:
                del owner[key]
    arrays["state"] = np.frombuffer(json.dumps(values).encode(), np.uint8)
    np.savez(path, **arrays)


def _places(values: Any) -> Any:
    """Every place of a JSON value: what holds it, and its key or index there."""
    for key, value in list(values.items() if isinstance(values, dict) else enumerate(values)):
        yield values, key
        if isinstance(value, (dict, list)):
            yield from _places(value)


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize(("first", "count"), [(0, 6), pytest.param(1000, 200, marks=pytest.mark.long)])
def test_mutated_states(interrupted: Path, tmp_path: Path, first: int, count: int) -> None:
    """Of one in four the newest state alone, so that the run goes on with the one before; of the others both are."""
    hostile, seen, faults = Hostile(tmp_path), Counter[object](), []
    run = tmp_path / "runs/tiny"
    run.parent.mkdir()
    try:
        for seed in range(first, first + count):
            rng = random.Random(seed)
            shutil.rmtree(run, ignore_errors=True)
            shutil.copytree(interrupted, run)
            for name in (STATE,) if seed % 4 == 0 else (STATE, PREVIOUS):
                if rng.random() < 0.5:
                    forge(rng, run / name)
                else:
                    (run / name).write_bytes(mutate_bytes(rng, (run / name).read_bytes(), head=2000))
            before = contents(tmp_path)
            answer = hostile.ask("resume runs/tiny")
            found = judge(seed, answer, seen)
            after = contents(tmp_path)
            if answer["code"] == 2:
                found += [] if after == before else [f"seed {seed}: refused, and changed the folder"]
            elif answer["code"] == 0:
                lines = [record["iteration"] for record in records_of(run)]
                found += [] if lines == list(range(6)) else [f"seed {seed}: {lines}"]
                found += [] if int(state_of(run)["iteration"]) == 6 else [f"seed {seed}: its state is not the last"]
                found += [] if left_over(run) == [] else [f"seed {seed}: left {left_over(run)}"]
                manifest = read_manifest(run)
                found += (
                    [] if manifest is not None and manifest["status"] == "finished" else [f"seed {seed}: {manifest}"]
                )
            outside = {name for name in before.keys() | after.keys() if before.get(name) != after.get(name)}
            found += [f"seed {seed}: wrote {name}" for name in outside if not Path(name).is_relative_to(run)]
            faults += found
    finally:
        hostile.end()
    print(dict(seen))
    assert faults == []
    assert seen[0] >= count / 6
    assert seen[2] >= count / 6
