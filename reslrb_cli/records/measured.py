"""Lines of `gradcheck --json` as the records that they were, where they are whole."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, fields
from typing import Any

from reslrb_cli.records.gradcheck import GradcheckRecord, Kind, Reference, Verdict
from reslrb_cli.records.missing import MissingRecord


def gradcheck_record(entry: Mapping[str, Any]) -> GradcheckRecord | None:
    """The record that a line holds; None where it holds none."""
    kinds: dict[str, tuple[type, ...]] = {"int": (int,), "str": (str,)}
    found: dict[str, Any] = {}
    try:
        for field in fields(GradcheckRecord):
            if field.name not in entry and field.default is not MISSING:
                continue
            value = entry[field.name]
            enums: dict[str, Any] = {"reference": Reference, "kind": Kind, "verdict": Verdict}
            optional = "None" in str(field.type)
            if field.name in enums:
                value = enums[field.name](value)
            elif not (optional and value is None):
                name = str(field.type).partition(" ")[0]
                if not isinstance(value, kinds.get(name, (int, float))):
                    return None
            found[field.name] = value
    except (KeyError, ValueError):
        return None
    return GradcheckRecord(**found)


def missing_record(entry: Mapping[str, Any]) -> MissingRecord | None:
    """The record that a line holds; None where it holds none."""
    if entry.get("kind") != "missing":
        return None
    texts = [entry.get(name) for name in ("case", "parameter")]
    figures = [entry.get(name) for name in ("share", "standard_error")]
    counts = [entry.get(name) for name in ("directions", "seeds")]
    whole = all(isinstance(text, str) for text in texts) and all(isinstance(count, int) for count in counts)
    if not whole or any(not isinstance(figure, int | float | None) for figure in figures):
        return None
    return MissingRecord(*texts, *figures, *counts)  # type: ignore[arg-type]
