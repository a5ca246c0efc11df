"""Words about spreads, and about noise and misfits of the model in them.

The functions take the `results` of the manifest, which may lack `certainty`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from reslrb_cli.config.parameters import entry_of
from reslrb_cli.report.format import number

#: Verdict of a value that has not converged (`verdicts.Verdict`).
MOVING = "still moving"
#: Share of a misfit that leaves nothing to explain, and maximum number of parameters that a command recovers for it.
EXPLAINED, MOST_FREED = 0.9, 3


def spread_words(results: Mapping[str, Any], key: str, sign: str = "+-") -> str:
    """Return one standard deviation, for each entry of a small parameter or for a typical entry of a large parameter.
    The result is empty if unknown.
    """
    spread = (certainties(results).get(key) or {}).get("spread")
    if not spread:
        return ""
    if all(value == spread[0] for value in spread):
        return f"{sign} {number(spread[0], 2)}"
    return f"{sign} " + " ".join("-" if value is None else number(value, 2) for value in spread)


def noise_line(results: Mapping[str, Any]) -> str:
    """Return a line that says that the spreads exclude the target's noise. The result is empty if they include it."""
    measured = certainty_of(results)
    if measured.get("target_noise") not in ("left out", "in part"):
        return ""
    which = "" if measured["target_noise"] == "left out" else " that are files"
    return f"spread: by the noise of the run; noise and errors of targets{which} are not in it"


def misfit_words(results: Mapping[str, Any]) -> str:
    """Return the size of the difference between the images and their targets that noise does not explain. The result is
    empty if noise explains the difference.
    """
    fit = certainty_of(results).get("fit") or {}
    if not fit.get("is_significant"):
        return ""
    return f"images and targets differ by {100 * fit['misfit']:.2g} % more than noise explains"


def leading_keys(results: Mapping[str, Any]) -> list[str]:
    """Return the parameters that would reduce the misfit most: those that together explain nearly all of it, or the
    first `MOST_FREED`.
    """
    found, explained = [], 0.0
    for each in _candidates(results)[:MOST_FREED]:
        if explained >= EXPLAINED:
            break
        found.append(str(each["key"]))
        explained += each["explained"]
    return found


def misfit_lines(results: Mapping[str, Any]) -> list[str]:
    """Return lines about a model that does not fit the targets, and entries of `parameters` that would reduce the
    misfit. The result is empty if the model fits.
    """
    words = misfit_words(results)
    if not words:
        return []
    is_moving = any(about.get("verdict") == MOVING for about in certainties(results).values())
    cause = "values that are still moving may be the cause"
    lines = [f"misfit: {words}; {cause if is_moving else 'the spreads allow for a hidden misfit of the same size'}"]
    found = _candidates(results)
    lines += ["these entries of `parameters` would reduce it:"] if found else []
    for each in found:
        old, new = (" ".join(number(value, 3) for value in each[name]) for name in ("value", "proposed"))
        change = f"; {old} would become about {new}" if new else ""
        lines.append(f"  {_spec(each)}  # {100 * each['explained']:.0f} % of the misfit{change}")
    return lines


def certainty_of(results: Mapping[str, Any]) -> dict[str, Any]:
    """Return the record of the certainty of the values. The result is empty if nothing was measured."""
    return dict(results.get("certainty") or {})


def certainties(results: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the certainty of each parameter, by key."""
    return dict(certainty_of(results).get("parameters") or {})


def _candidates(results: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the parameters that would reduce the misfit, as recorded (`fit.Candidate`)."""
    return list((certainty_of(results).get("fit") or {}).get("candidates") or ())


def _spec(candidate: Mapping[str, Any]) -> str:
    """Return the entry of `parameters` that recovers a candidate, or the setting that recovers the response."""
    if candidate["key"] == "response":
        return "target.response: {curve: auto}"
    bounds = f", bounds: {candidate['bounds']}" if candidate.get("bounds") else ""
    option, name = entry_of(candidate["key"])
    return f"- {{{option}: {name}{bounds}}}"
