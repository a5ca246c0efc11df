"""The first line of a file of measurements: what it says, and what of it survives damage."""

from __future__ import annotations

import json
import sys

import pytest

from reslrb_cli.records.manifest import versions
from reslrb_cli.records.measurement_files import Origin, read_origin

EMPTY = Origin(device="", variant="", command=[], versions={}, platform="", written="")


def test_it_names_the_command_and_the_versions_of_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["/home/me/.venv/bin/reslrb", "bench", "a b.yaml", "\x1b[31m", "--rounds", "3"])
    entry = json.loads(Origin("a machine", "llvm_ad_rgb").to_json())
    assert entry["command"][:3] == ["reslrb", "bench", "a b.yaml"]
    assert "\x1b" not in "".join(entry["command"])
    assert entry["versions"] == versions()
    assert {"reslrb", "python", "mitsuba", "drjit"} <= set(entry["versions"])
    assert (entry["device"], entry["variant"]) == ("a machine", "llvm_ad_rgb")
    assert entry["platform"]
    assert entry["written"].endswith("+00:00")


def test_what_was_written_is_read_again() -> None:
    origin = Origin("a machine", "llvm_ad_rgb", ["reslrb", "bench"])
    assert read_origin(json.loads(origin.to_json())) == origin


@pytest.mark.parametrize("entry", [{}, {"kind": "point"}, {"kind": ["origin"]}, {"versions": {}}])
def test_other_lines_are_none(entry: dict) -> None:
    assert read_origin(entry) is None


@pytest.mark.parametrize(
    "damage",
    [{}, {"command": "rm -r", "versions": [1], "device": 3, "platform": None}, {"written": {"a": 1}, "variant": []}],
)
def test_members_of_other_types_are_empty(damage: dict) -> None:
    assert read_origin({"kind": "origin", **damage}) == EMPTY
