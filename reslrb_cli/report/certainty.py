"""How certain the values of a run are, in words; `results` is the manifest's, whose `certainty` may be missing."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from reslrb_cli.records.paid import PaidRecord
from reslrb_cli.records.rival import RivalRecord
from reslrb_cli.report.words import count, duration, number, shorten

#: The verdict on a value that can be relied on, as recorded; all others say what keeps it from that.
SETTLED, MOVING, UNDETERMINED = "settled", "still moving", "not determined"
#: Parameters with one verdict that are named.
MOST_NAMED = 3
#: A key in a line of text has at most so many characters, and beside a verdict.
KEY_WIDTH, PARTNER_WIDTH = 60, 40


def is_settled(results: Mapping[str, Any], key: str) -> bool:
    """Whether the value of a parameter can be relied on, as far as was measured."""
    return bool(_about(results, key).get("verdict") == SETTLED)


def verdict_words(results: Mapping[str, Any], key: str) -> str:
    """The verdict on a parameter, with the share of its entries that have it; empty where nothing was measured."""
    about = _about(results, key)
    verdict, shares = about.get("verdict", ""), about.get("shares") or {}
    words = str(verdict)
    if verdict == UNDETERMINED and about.get("partner"):
        words += f": {shorten(about['partner'], PARTNER_WIDTH)} makes up for it"
    share = shares.get(verdict)
    return words if share is None or share == 1 else f"{words} ({100 * share:.3g} %)"


def spread_words(results: Mapping[str, Any], key: str, sign: str = "+-") -> str:
    """One standard deviation of each entry of a small parameter, or of a typical entry; empty where none is known."""
    spread = _about(results, key).get("spread")
    if not spread:
        return ""
    if all(value == spread[0] for value in spread):
        return f"{sign} {number(spread[0], 2)}"
    return f"{sign} " + " ".join("-" if value is None else number(value, 2) for value in spread)


def certainty_lines(results: Mapping[str, Any]) -> list[str]:
    """For each verdict but the good one a line that names the parameters that have it."""
    found: dict[str, list[str]] = {}
    for key, about in _parameters(results).items():
        verdict = about.get("verdict", SETTLED)
        if verdict != SETTLED:
            found.setdefault(verdict, []).append(key)
    lines = []
    for verdict, keys in found.items():
        named = ", ".join(shorten(key, KEY_WIDTH) for key in keys[:MOST_NAMED])
        rest = f" and {count(len(keys) - MOST_NAMED, 'more parameter')}" if len(keys) > MOST_NAMED else ""
        lines.append(f"{'not converged, ' if verdict == MOVING else ''}{verdict}: {named}{rest}")
    return lines


def certainty_words(results: Mapping[str, Any]) -> str:
    """What spreads and verdicts rest on; empty where there are none."""
    measured = results.get("certainty")
    if not measured:
        return ""
    parts = [count(measured["gradients"], "gradient")]
    parts += [count(measured["changes"], "pair") + " of images"] if measured["changes"] else []
    parts += [count(measured["probes"], "random probe")] if measured["probes"] else []
    cost = f"{duration(measured['measure_s'])}, {100 * measured['share']:.2g} % of the iterations' time"
    return (
        "Spread is one standard deviation of a final value about the optimum, by the noise of gradients and the "
        f"curvature of the loss, where it ended (of a texture that of a typical entry, the others known); from "
        f"{', '.join(parts)}, in {cost}."
    )


def rival_line(measured: Mapping[str, Any] | None) -> str:
    """How another integrator did beside the run's own; empty where none was tried."""
    try:
        return RivalRecord.from_json(dict(measured or {})).line()
    except TypeError:  # there was none, or another version's
        return ""


def paid_line(kind: type[PaidRecord], measured: Mapping[str, Any] | None) -> str:
    """Whether another way of drawing samples paid; empty where that was not left to measurement."""
    try:
        return kind.from_json(dict(measured or {})).line()
    except TypeError:  # as above
        return ""


def _parameters(results: Mapping[str, Any]) -> dict[str, Any]:
    return dict((results.get("certainty") or {}).get("parameters") or {})


def _about(results: Mapping[str, Any], key: str) -> dict[str, Any]:
    return dict(_parameters(results).get(key) or {})
