"""Draws and their file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli.tiny import write_experiment

from reslrb_cli.config.loader import load
from reslrb_cli.errors import ConfigError
from reslrb_cli.measure import draws as module
from reslrb_cli.measure.draws import ARRAYS, Draws, DrawsFile, StoredResults, mixed_sessions, situation, this_session

ABOUT = {"settings": "a", "spp": 4}


def some(*seeds: int, label: str = "prb", origin: str | None = None, **others: Any) -> Draws:
    """Return draws of two entries whose values tell their seeds."""
    rows = np.array([[seed, 10 * seed] for seed in seeds], np.float32)
    return Draws.of(label, rows, seeds, step_ms=[float(seed) for seed in seeds], origin=origin, **others)


def equal(one: Draws, other: Draws) -> bool:
    """True if all fields are equal, NaN included."""
    rest = [{k: v for k, v in vars(each).items() if k not in ARRAYS} for each in (one, other)]
    pairs = [(getattr(one, name), getattr(other, name)) for name in ARRAYS]
    return rest[0] == rest[1] and all(np.array_equal(a, b, equal_nan=a.dtype.kind == "f") for a, b in pairs)


def test_draws_of_one_session() -> None:
    draws = some(4, 2)
    assert (draws.values.dtype, draws.values.shape, len(draws)) == (np.float32, (2, 2), 2)
    assert draws.origin.tolist() == [this_session()] * 2
    assert np.isnan(draws.kernel_ms).all()
    timed = Draws.of("prb", np.zeros((3, 0)), range(3), step_ms=2.0)
    assert (timed.values.shape, timed.step_ms.tolist()) == ((3, 0), [2.0] * 3)


def test_parts_join_by_seed_and_the_first_part_counts() -> None:
    first = some(3, 1, origin="one", peak_mib=5.0)
    later = Draws.of("prb", [[9, 9], [7, 7]], [1, 2], origin="two", peak_mib=6.0, cold_ms=8.0)
    whole = Draws.joined([first, some(), later])
    assert whole.seeds.tolist() == [1, 2, 3]
    assert whole.values.tolist() == [[1, 10], [7, 7], [3, 30]]
    assert whole.origin.tolist() == ["one", "two", "one"]
    assert (whole.peak_mib, whole.cold_ms) == (5.0, 8.0)
    assert equal(Draws.joined([some(), first]), Draws.joined([first]))
    assert len(Draws.joined([some()])) == 0


def test_mixed_sessions_are_named() -> None:
    assert mixed_sessions([some(1, origin="a"), some(2, label="x", origin="a")]) == ""
    line = mixed_sessions([some(1, origin="a"), some(2, label="x", origin="b")])
    assert line.startswith("times are from 2 sessions")
    assert line.endswith(": a; b")
    assert mixed_sessions([Draws.joined([some(1, origin="a"), some(2, origin="b")])]) == line


@pytest.mark.parametrize("path", [None, "draws.npz"])
def test_a_file_has_what_was_added(workplace: Path, path: str | None) -> None:
    place = None if path is None else Path(path)
    file = DrawsFile(place)
    assert file.draws(ABOUT) is None
    file.add(ABOUT, some(1, 2, options={"a": [1, None]}, scratch_bytes=4))
    file.add(ABOUT, some(2, 5))
    file.add(ABOUT | {"spp": 8}, some(1, label="other"))
    file.store(ABOUT, StoredResults({"shapes": {"a": [2]}}, {"mask": np.eye(2)}))
    file.save()
    read = DrawsFile(place) if place is not None else file
    found, stored = read.draws(ABOUT), read.stored(dict(reversed(ABOUT.items())))
    assert found is not None
    assert stored is not None
    assert equal(found, Draws.joined([some(1, 2, options={"a": [1, None]}, scratch_bytes=4), some(5)]))
    assert [one.label for one in read] == ["prb", "other"]
    assert (stored.facts, stored.arrays["mask"].tolist()) == ({"shapes": {"a": [2]}}, np.eye(2).tolist())
    assert [name.name for name in Path().iterdir()] == ([] if place is None else ["draws.npz"])


def test_draws_of_two_processes_are_kept(workplace: Path) -> None:
    one, other = DrawsFile(Path("d.npz")), DrawsFile(Path("d.npz"))
    one.add(ABOUT, some(1))
    one.save()
    other.add(ABOUT, some(2))
    other.add({"of": "other"}, some(1, label="other"))
    other.save()
    one.add(ABOUT, some(3))
    one.save()
    found = DrawsFile(Path("d.npz"))
    assert [one.seeds.tolist() for one in found] == [[1, 2, 3], [1]]


def test_an_unchanged_file_is_not_written(workplace: Path) -> None:
    file = DrawsFile(Path("d.npz"))
    file.save()
    assert not Path("d.npz").exists()
    file.add(ABOUT, some(1))
    file.save()
    before = Path("d.npz").stat().st_mtime_ns
    DrawsFile(Path("d.npz")).save()
    assert Path("d.npz").stat().st_mtime_ns == before


def _written(path: Path) -> None:
    file = DrawsFile(path)
    file.add(ABOUT, some(1, 2))
    file.save()


def _with_header(path: Path, **changes: Any) -> None:
    with np.load(path) as archive:
        arrays = dict(archive)
    header = json.loads(arrays["header"].tobytes()) | changes
    np.savez(path, **arrays | {"header": np.frombuffer(json.dumps(header).encode(), np.uint8)})


FOREIGN = {
    "cut off": lambda path: path.write_bytes(path.read_bytes()[:-40]),
    "a flipped byte": lambda path: path.write_bytes(path.read_bytes().replace(b"\x80?\x00", b"\x81?\x00")),
    "text": lambda path: path.write_text("no archive"),
    "empty": lambda path: path.write_bytes(b""),
    "an archive of something else": lambda path: np.savez(path, a=np.ones(3)),
    "another version": lambda path: _with_header(path, format=99),
    "a header that is a list": lambda path: np.savez(path, header=np.frombuffer(b"[1]", np.uint8)),
    "missing arrays": lambda path: _with_header(path, draws=[{"about": ABOUT, "label": "x"}] * 2),
    "unknown fields": lambda path: _with_header(path, draws=[{"about": ABOUT, "label": "x", "more": 1}]),
    "a folder": lambda path: (path.unlink(), path.mkdir()),
}


@pytest.mark.parametrize("change", FOREIGN)
def test_damaged_and_foreign_files_are_one_located_line(workplace: Path, change: str) -> None:
    path = Path("d.npz")
    _written(path)
    FOREIGN[change](path)
    with pytest.raises(ConfigError) as caught:
        DrawsFile(path)
    line = str(caught.value)
    assert line.startswith("d.npz: is ")
    assert "\n" not in line
    assert caught.value.exit_code == 2


def test_a_situation_has_everything_that_determines_a_draw(
    workplace: Path, llvm: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_experiment(workplace)

    def of(*overrides: str, folder: Path = workplace, variant: str = llvm, **others: Any) -> dict[str, Any]:
        return situation(load(folder / "tiny.yaml", overrides), variant, **{"spp": 4} | others)

    usual = of()
    assert json.loads(json.dumps(usual)) == usual
    same = ["run.iterations=99", "run.output=elsewhere", "optimizer.learning_rate=0.5"]
    assert [of(change) for change in same] == [usual] * 3
    other = ["run.seed=1", "integrator.max_depth=4", "run.adjoint=independent", "parameters[0].initial=0.25",
             "target.render.spp=8", "loss.type=l1"]  # fmt: skip
    found = [of(change) for change in other]
    found += [of(variant="cuda_ad_rgb"), of(spp=8), of(purpose="other")]
    monkeypatch.setattr(module, "versions", lambda: {"reslrb": "x", "mitsuba": "3.9.1", "drjit": "1"})
    found.append(of())
    monkeypatch.undo()
    moved = workplace / "moved"
    moved.mkdir()
    for name in ("tiny.yaml", "scene.xml", "poster.exr"):
        (moved / name).write_bytes((workplace / name).read_bytes())
    assert of(folder=moved) == usual
    (moved / "scene.xml").write_text((moved / "scene.xml").read_text().replace("8, 8, 8", "8, 8, 9"))
    found.append(of(folder=moved))
    texts = [json.dumps(each, sort_keys=True) for each in (usual, *found)]
    assert len(set(texts)) == len(texts)


def test_differences_name_the_parts_of_a_situation() -> None:
    file, usual = DrawsFile(), {"purpose": "prb", "settings": "a", "spp": 4, "files": {}}
    file.add(usual, some(1))
    file.add(usual | {"settings": "b", "spp": 8}, some(1))
    assert file.differences(usual) == []
    assert file.differences(usual | {"spp": 8, "files": {"x": "1"}}) == ["spp", "files"]
    assert file.differences(usual | {"settings": "c", "spp": 8}) == ["settings"]
    assert file.differences(usual | {"settings": "c", "purpose": "ptracer"}) == []
