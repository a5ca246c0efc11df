"""Conditioning as an aligned table."""

from __future__ import annotations

from reslrb_cli.measure.conditioning import QUANTITIES, Conditioning

_CHAIN_HEAD = ("vertices", "paths", "median", "99 %", "largest")
_HEAD = ("parameter", "entries", "value", "gradient", "noise", "image / unit", "curvature", "length")


def conditioning_lines(measured: Conditioning) -> list[str]:
    """One line a parameter, in its units, and the spread of what differs between them; `-` where nothing was seen."""
    rows: list[tuple[str, ...]] = [_HEAD]
    for row in measured.rows:
        numbers = (row.value, row.gradient, row.noise, row.change, row.curvature, row.length)
        rows.append((row.key, str(row.entries), *map(_number, numbers)))
    gradient, change, curvature, length = (_number(measured.spread(quantity)) for quantity in QUANTITIES)
    rows.append(("largest / smallest", "", "", gradient, "", change, curvature, length))
    return _aligned(rows)


def chain_lines(measured: Conditioning) -> list[str]:
    """One line for each length of a chain of Jacobians: how many, and their condition numbers."""
    rows: list[tuple[str, ...]] = [_CHAIN_HEAD]
    for chain in measured.chains:
        numbers = (chain.median, chain.percentile_99, chain.largest)
        rows.append((str(chain.vertices), str(chain.paths), *map(_number, numbers)))
    return _aligned(rows)


def _aligned(rows: list[tuple[str, ...]]) -> list[str]:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            [row[0].ljust(widths[0]), *(text.rjust(width) for text, width in zip(row[1:], widths[1:], strict=True))]
        ).rstrip()
        for row in rows
    ]


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"
