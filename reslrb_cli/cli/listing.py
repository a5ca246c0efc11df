"""What `inspect` says of a scene, its sensors, the plan of a step and the parameters, in lines."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from reslrb_cli.integrators.plan_report import PlanReport
    from reslrb_cli.scene import ParameterInfo, SceneSummary, SensorSummary
    from reslrb_cli.scene.inspect import MovableSummary

#: Sensors, and parameters that can be recovered, without `--all`.
LISTED_SENSORS, _LISTED = 3, 30
#: And what can be moved.
_MOVED = 10


def scene_lines(summary: SceneSummary) -> list[str]:
    """What the scene contains."""
    lines = [
        f"{name}: {', '.join(f'{count} {kind}' for kind, count in counts.items()) or 'none'}"
        for name, counts in (("emitters", summary.emitters), ("bsdfs", summary.bsdfs), ("shapes", summary.shapes))
    ]
    return [*lines, f"triangles: {summary.triangles}"]


def sensor_lines(sensor: SensorSummary) -> list[str]:
    """What one sensor is and sees."""
    (x, y), (width, height) = sensor.crop
    crop = "" if (x, y) == (0, 0) and (width, height) == sensor.size else f", crop {width}x{height} at ({x}, {y})"
    lines = [f"{sensor.type}, {sensor.film} {sensor.size[0]}x{sensor.size[1]}{crop}, {sensor.filter}"]
    if sensor.view is not None:
        shares = dataclasses.asdict(sensor.view)
        lines.append("sees " + ", ".join(f"{name} {100 * share:.0f} %" for name, share in shares.items()))
    needs = [field.name for field in dataclasses.fields(sensor.needs) if getattr(sensor.needs, field.name) is True]
    lines.append(
        f"needs {', '.join(name.removeprefix('has_').replace('_', ' ') for name in needs) or 'nothing special'}"
    )
    if sensor.obstacle is not None and sensor.obstacle == sensor.camera_obstacle:
        lines.append(f"cannot be rendered: {sensor.obstacle}")
    else:
        lines += [f"no light tracing: {sensor.obstacle}"] if sensor.obstacle is not None else []
        lines += [f"no prb: {sensor.camera_obstacle}"] if sensor.camera_obstacle is not None else []
    return lines


def plan_lines(report: PlanReport) -> list[str]:
    """The plan as a table: what is needed first."""
    lines = []
    if report.kernels is not None:
        each = " + ".join(map(str, report.kernels))
        lines.append(f"estimator {report.estimator}, kernels of {each} operations")
    rows = [
        (
            "needed" if row.needed else "left out",
            row.feature,
            "" if row.operations_with is None else str(row.operations_with),
            "" if row.operations_without is None else str(row.operations_without),
            row.reason + (f" ({row.note})" if row.note else ""),
        )
        for row in sorted(report.rows, key=lambda row: not row.needed)
    ]
    table = [("", "", "with", "without", "")] * (report.kernels is not None) + rows
    widths = [max(len(row[column]) for row in table) for column in range(4)]
    for a, b, c, d, reason in table:
        counts = f"  {c.rjust(widths[2])}  {d.rjust(widths[3])}" if report.kernels is not None else ""
        lines.append(f"{a.ljust(widths[0])}  {b.ljust(widths[1])}{counts}  {reason}".rstrip())
    return lines


# --- parameters -------------------------------------------------------------------------------------------------------


def parameter_lines(infos: Sequence[ParameterInfo], wanted: Sequence[str], everything: bool) -> list[str]:
    """The parameters that can be recovered, with their values, then how many others there are, and why.

    Those that a key or glob in `wanted` names are marked. `everything` lists the others, too.
    """
    usable = [info for info in infos if info.obstacle is None]
    others = [info for info in infos if info.obstacle is not None]
    marked = {info.key for info in usable if any(info.key == key or fnmatchcase(info.key, key) for key in wanted)}
    shown = usable if everything else sorted(usable, key=lambda info: info.key not in marked)[:_LISTED]
    rows = [("* " * (info.key in marked) + info.key, _noted(info)) for info in shown]
    note = " (* in `parameters`)" if marked else ""
    lines = [f"can be recovered: {len(usable) or 'none'}{note}", *(f"  {line}" for line in _columns(rows))]
    if len(shown) < len(usable):
        lines.append(f"  and {len(usable) - len(shown)} more; --all lists them")
    if everything:
        table = [(info.key, _value(info), _flags(info), str(info.obstacle)) for info in others]
        return [*lines, f"others: {len(others)}", *(f"  {line}" for line in _columns(table))]
    if others:
        lines.append(f"others: {len(others)}; --all lists them")
        lines += [f"  {line}" for line in _reasons(others)]
    return lines


def moving_lines(movable: Sequence[MovableSummary], everything: bool) -> list[str]:
    """What can be moved, and by what."""
    lines = [f"can be moved: {len(movable) or 'nothing'}"]
    if everything:
        return lines + [f"  {line}" for line in _columns([(item.id, ", ".join(item.by)) for item in movable])]
    groups: dict[str, list[str]] = {}
    for item in movable:
        groups.setdefault(" and ".join(item.by), []).append(item.id)
    for by, ids in groups.items():
        more = f" and {len(ids) - _MOVED} more; --all lists them" if len(ids) > _MOVED else ""
        lines.append(f"  by {by}: {', '.join(ids[:_MOVED])}{more}")
    return lines


def _reasons(others: Sequence[ParameterInfo]) -> list[str]:
    """How many there are with each reason."""
    groups: dict[str, list[str]] = {}
    for info in others:
        # What comes in brackets differs from one to the next.
        groups.setdefault(str(info.obstacle).partition(" (")[0].partition(";")[0], []).append(info.key)
    width = len(str(max(map(len, groups.values()))))
    counted = sorted(groups.items(), key=lambda group: -len(group[1]))
    return [f"{len(keys):{width}}  {reason}" for reason, keys in counted]


def _columns(rows: Sequence[tuple[str, ...]]) -> list[str]:
    if not rows:
        return []
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return ["  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def _value(info: ParameterInfo) -> str:
    """The value as far as it fits: numbers as `initial` takes them, of more their count, mean and range."""
    value = info.value
    if value is not None and value.numbers is not None:
        words = [f"{number:.4g}" for number in value.numbers]
        return f"[{', '.join(words)}]" if info.shape else words[0]
    if len(info.shape) == 3:
        height, width, channels = info.shape
        size = f"{width}x{height} texels" + (f" of {channels}" if channels > 1 else "")
    else:
        size = f"{'x'.join(map(str, info.shape))} numbers" if info.shape else info.type
    if value is None or info.kind == "shape" or "AffineTransform" in info.type:
        return size if info.shape else info.type
    return f"{size}, mean {value.mean:.4g}, {value.low:.4g} to {value.high:.4g}"


def _noted(info: ParameterInfo) -> str:
    """The value, and what is to be known of it."""
    return _value(info) + (f"; {info.remark}" if info.remark is not None else "")


def _flags(info: ParameterInfo) -> str:
    flags = ["differentiable" if info.differentiable else "not differentiable"]
    return ", ".join([*flags, *(["discontinuous"] if info.discontinuous else [])])


def plain(value: object) -> Any:
    """What a dataclass holds as JSON can have it; objects of the scene, which cannot be copied, by their ids."""
    if dataclasses.is_dataclass(value):
        return {field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {key: plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(entry) for entry in value]
    return value.id() if hasattr(value, "id") else value
