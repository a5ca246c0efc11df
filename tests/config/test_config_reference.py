"""The reference pages in docs/ say what the schema says."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from make_reference import DOCS, EXAMPLE, json_schema, markdown, write

from reslrb_cli.config.loader import load

HINT = "run `python scripts/make_reference.py`"


def test_pages_are_up_to_date() -> None:
    assert (DOCS / "config.md").read_text(encoding="utf-8") == markdown(), HINT
    assert json.loads((DOCS / "config.schema.json").read_text(encoding="utf-8")) == json_schema(), HINT


def test_pages_can_be_written(tmp_path: Path) -> None:
    write(tmp_path)
    assert (tmp_path / "config.md").read_text(encoding="utf-8") == markdown()
    assert json.loads((tmp_path / "config.schema.json").read_text(encoding="utf-8")) == json_schema()


def test_example_loads(tmp_path: Path) -> None:
    assert EXAMPLE in markdown()
    (tmp_path / "example.yaml").write_text(EXAMPLE)
    config = load(tmp_path / "example.yaml")
    assert (DOCS.parent / "configs" / config.scene.file.relative_to(tmp_path)).is_file()


@pytest.mark.parametrize(
    "key", ["variant", "scene", "target", "target.render", "parameters", "integrator", "loss", "optimizer", "run"]
)
def test_every_section_has_its_place(key: str) -> None:
    assert f"`{key}`" in markdown()


def test_every_key_has_a_meaning() -> None:
    schema, page = json_schema(), markdown()
    for name, section in [("Config", schema), *schema["$defs"].items()]:
        assert section["description"]
        for key, value in section["properties"].items():
            assert value.get("description"), f"{name}.{key}"
            assert f"`{key}`" in page
