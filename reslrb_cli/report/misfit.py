"""Words about a model that does not fit its targets. The functions take the `results` of the manifest."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from reslrb_cli.report.format import number


def misfit_words(results: Mapping[str, Any]) -> str:
    """Return the size of the difference between the images and their targets that noise does not explain. The result is
    empty if noise explains the difference.
    """
    fit = (results.get("certainty") or {}).get("fit") or {}
    if not fit.get("is_significant"):
        return ""
    return f"images and targets differ by {100 * fit['misfit']:.2g} % more than by noise"


def candidates_of(results: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the parameters that would reduce the misfit, as recorded (`candidates.Candidate`)."""
    return list(((results.get("certainty") or {}).get("fit") or {}).get("candidates") or ())


def spec_of(candidate: Mapping[str, Any]) -> str:
    """Return the entry of `parameters` that recovers a candidate."""
    bounds = f", bounds: {candidate['bounds']}" if candidate.get("bounds") else ""
    return f"- {{key: {candidate['key']}{bounds}}}"


def misfit_lines(results: Mapping[str, Any]) -> list[str]:
    """Return lines about a model that does not fit the targets, and entries of `parameters` that would reduce the
    misfit. The result is empty if the model fits.
    """
    words = misfit_words(results)
    if not words:
        return []
    lines = [f"misfit: {words}; the spreads include as large a misfit that the values may hide"]
    found = candidates_of(results)
    lines += ["these entries of `parameters` would reduce it:"] if found else []
    for each in found:
        old, new = (" ".join(number(value, 3) for value in each[name]) for name in ("value", "proposed"))
        change = f"; {old} would become about {new}" if new else ""
        lines.append(f"  {spec_of(each)}  # {100 * each['explained']:.0f} % of the misfit{change}")
    return lines
