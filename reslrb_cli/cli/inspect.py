"""`reslrb inspect`: what a scene contains, and which of its parameters can be recovered."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from reslrb_cli.cli.experiment import experiment_arguments, read_config, start_variant

if TYPE_CHECKING:
    from reslrb_cli.scene import ParameterInfo, SceneSummary, SensorSummary


@click.command("inspect")
@experiment_arguments
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object instead of lines.")
def command(config_file: Path, overrides: tuple[str, ...], as_json: bool) -> None:
    """List the parameters of the scene of CONFIG with their flags, and what the scene contains.

    A parameter that says "can be recovered" may stand in `parameters` of the configuration; of the others the reason
    is given.
    """
    config = read_config(config_file, overrides)
    start_variant(config)

    from reslrb_cli.scene import load_scene, summarise

    scene = load_scene(config.scene.file, config.scene.options)
    summary = summarise(scene, config.integrator.hide_emitters)
    if as_json:
        click.echo(json.dumps(dataclasses.asdict(summary), indent=2))
        return
    click.echo(f"scene {config.scene.file}")
    for line in scene_lines(summary):
        click.echo(f"  {line}")
    for sensor in summary.sensors:
        click.echo(f"sensor {sensor.index} ({sensor.id})")
        for line in sensor_lines(sensor):
            click.echo(f"  {line}")
    click.echo("parameters")
    for line in parameter_lines(summary.parameters):
        click.echo(f"  {line}")
    if summary.unnamed:
        click.echo("  keys that begin with object_ change from run to run: give those objects an id in the scene file")


def scene_lines(summary: SceneSummary) -> list[str]:
    """What the scene contains, in lines."""
    lines = [
        f"{name}: {', '.join(f'{count} {kind}' for kind, count in counts.items()) or 'none'}"
        for name, counts in (("emitters", summary.emitters), ("bsdfs", summary.bsdfs), ("shapes", summary.shapes))
    ]
    return [*lines, f"triangles: {summary.triangles}"]


def sensor_lines(sensor: SensorSummary) -> list[str]:
    """What one sensor is and sees, in lines."""
    (x, y), (width, height) = sensor.crop
    crop = "" if (x, y) == (0, 0) and (width, height) == sensor.size else f", crop {width}x{height} at ({x}, {y})"
    lines = [f"{sensor.type}, {sensor.film} {sensor.size[0]}x{sensor.size[1]}{crop}, {sensor.filter}"]
    if sensor.view is not None:
        shares = dataclasses.asdict(sensor.view)
        lines.append("sees " + ", ".join(f"{name} {100 * share:.0f} %" for name, share in shares.items()))
    needs = [name for name, value in dataclasses.asdict(sensor.needs).items() if value is True]
    lines.append(
        f"needs {', '.join(name.removeprefix('has_').replace('_', ' ') for name in needs) or 'nothing special'}"
    )
    if sensor.obstacle is not None:
        lines.append(f"no light tracing: {sensor.obstacle}")
    return lines


def parameter_lines(parameters: list[ParameterInfo]) -> list[str]:
    """The parameters as a table, those that can be recovered first."""
    first = sorted(parameters, key=lambda info: info.obstacle is not None)
    rows = [(info.key, _value(info), _flags(info), info.obstacle or "can be recovered") for info in first]
    widths = [max((len(row[column]) for row in rows), default=0) for column in range(3)]
    return [
        "  ".join([*(text.ljust(width) for text, width in zip(row[:3], widths, strict=True)), row[3]]) for row in rows
    ]


def _value(info: Any) -> str:
    size = "x".join(map(str, info.shape))
    return f"{info.type} {size}" if size else info.type


def _flags(info: Any) -> str:
    flags = ["differentiable" if info.differentiable else "not differentiable"]
    return ", ".join([*flags, *(["discontinuous"] if info.discontinuous else [])])
