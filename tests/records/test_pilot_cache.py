"""The cache of pilots' outcomes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from reslrb_cli.records.cache import MOST, PilotCache, cache_folder, key_of


def test_entries_are_kept(tmp_path: Path) -> None:
    PilotCache(tmp_path / "new").put("a", {"x": 1})
    PilotCache(tmp_path / "new").put("b", {"x": 2})
    cache = PilotCache(tmp_path / "new")
    assert cache.get("a") == {"x": 1}
    assert cache.get("b") == {"x": 2}
    assert cache.get("c") is None


def test_the_oldest_go(tmp_path: Path) -> None:
    cache = PilotCache(tmp_path)
    (tmp_path / "pilot.json").write_text(json.dumps({str(k): {"x": k} for k in range(MOST)}))
    cache.put("new", {"x": -1})
    assert cache.get("0") is None
    assert cache.get("1") == {"x": 1}
    assert cache.get("new") == {"x": -1}


@pytest.mark.parametrize("content", ["", "{", "[1]", '{"a": 3}', "\xff"])
def test_a_broken_file_is_empty_and_mended(tmp_path: Path, content: str) -> None:
    (tmp_path / "pilot.json").write_bytes(content.encode("latin-1"))
    cache = PilotCache(tmp_path)
    assert cache.get("a") is None
    cache.put("a", {"x": 1})
    assert cache.get("a") == {"x": 1}


def test_no_place_to_write_is_no_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    PilotCache(tmp_path / "file" / "deeper").put("a", {})
    assert PilotCache(tmp_path / "file" / "deeper").get("a") is None


def test_where_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RESLRB_CACHE", "/own")
    assert cache_folder() == Path("/own")
    monkeypatch.delenv("RESLRB_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", "/xdg")
    assert cache_folder() == Path("/xdg/reslrb")
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert cache_folder() == Path.home() / ".cache" / "reslrb"


def test_keys_tell_apart_what_differs() -> None:
    assert key_of({"a": 1, "b": [2]}) == key_of({"b": [2], "a": 1})
    assert key_of({"a": 1}) != key_of({"a": 2})
