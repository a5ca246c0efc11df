"""The results of a bench as an aligned table."""

from __future__ import annotations

from reslrb_cli.records.bench import BenchRecord, Spread

_HEAD = (
    "depth", "", "step ms", "over baseline", "kernel ms", "over baseline", "codegen", "tracing", "cold ms", "peak MiB",
    "scratch B", "n",
)  # fmt: skip
_WIDTHS = (7, 0, 9, 19, 9, 19, 7, 7, 8, 9, 9, 3)


def table_head(labels: list[str], swept: str = "depth") -> str:
    """The first line; `labels` are all that will stand in the second column, what is `swept` stands in the first."""
    return _line((swept, *_HEAD[1:]), max(map(len, labels)))


def table_line(
    label: str,
    value: int,
    record: BenchRecord,
    step_ratio: Spread | None,
    kernel_ratio: Spread | None,
    labels: list[str],
) -> str:
    """The line of one result, at a value of what is swept: medians, and ratios with their least and greatest."""
    width = max(map(len, labels))
    if record.step_ms is None or record.kernel_ms is None:
        return _line((str(value), label, record.status.value), width)
    cells = (
        str(value),
        label,
        f"{record.step_ms.median:.1f}",
        _ratio(step_ratio),
        f"{record.kernel_ms.median:.1f}",
        _ratio(kernel_ratio),
        _milliseconds(record.codegen_ms),
        _milliseconds(record.tracing_ms),
        f"{record.cold_ms or 0:.0f}",
        f"{record.peak_mib or 0:.1f}",
        str(record.scratch_bytes),
        str(record.repeats),
    )
    return _line(cells, width)


def _milliseconds(time: Spread | None) -> str:
    return "" if time is None else f"{time.median:.1f}"


def _ratio(ratio: Spread | None) -> str:
    return "" if ratio is None else f"{ratio.median:.2f} [{ratio.min:.2f}, {ratio.max:.2f}]"


def _line(cells: tuple[str, ...], label_width: int) -> str:
    parts = [
        f"{cell:<{label_width}}" if column == 1 else f"{cell:>{_WIDTHS[column]}}" for column, cell in enumerate(cells)
    ]
    return "  ".join(parts).rstrip()
