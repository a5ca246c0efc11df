"""`reslrb inspect`: what a scene contains, and which of its parameters can be recovered."""

from __future__ import annotations

import dataclasses
import json
import logging
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from reslrb_cli.cli.experiment import experiment_arguments, read_config, start_variant
from reslrb_cli.errors import ConfigError, ExitCode, UnsupportedScene

if TYPE_CHECKING:
    from reslrb_cli.config import Config
    from reslrb_cli.integrators.plan_report import PlanReport
    from reslrb_cli.measure.conditioning import Conditioning
    from reslrb_cli.records.offender import Offender
    from reslrb_cli.scene import ParameterInfo, SceneSummary, SensorSummary

#: Gradients that `--conditioning` takes.
SAMPLES = 8


@click.command("inspect")
@experiment_arguments
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object instead of lines.")
@click.option("--no-counts", is_flag=True, help="Do not compile kernels to count their operations (takes seconds).")
@click.option(
    "--nonfinite",
    is_flag=True,
    help="Say where the run whose folder CONFIG lies in first met a value that is not finite: trace that step again.",
)
@click.option(
    "--conditioning", is_flag=True, help="Measure how sensitive image and loss are to each parameter (renders)."
)
@click.option(
    "--samples",
    type=click.IntRange(min=2),
    help=f"Gradients that --conditioning takes, each of run.spp samples per pixel.  [default: {SAMPLES}]",
)
def command(
    config_file: Path,
    overrides: tuple[str, ...],
    as_json: bool,
    no_counts: bool,
    nonfinite: bool,
    conditioning: bool,
    samples: int | None,
) -> int | None:
    """List the parameters of the scene of CONFIG with their flags, what the scene contains, and the plan of a step.

    A parameter that says "can be recovered" may stand in `parameters` of the configuration; of the others the reason
    is given. The plan says which features the scene and the parameters call for and which are left out, with the number
    of operations that the kernels of a step have with and without each of them.

    --conditioning says how far apart the parameters' sensitivities lie, where they start: of each the root mean square
    of its values, its gradient and the noise of one step's gradient, the relative change of the image and the curvature
    of the loss per unit of the parameter, and the length by which it would have to change to make up the image where it
    has an effect. `optimizer.scale: auto` makes up for what it shows.
    """
    if samples is not None and not conditioning:
        raise click.UsageError("--samples has no effect without --conditioning")
    config = read_config(config_file, overrides)
    start_variant(config)
    if nonfinite:
        return show_offenders(config, as_json)

    from reslrb_cli.scene import load_scene, summarise

    scene = load_scene(config.scene.file, config.scene.options)
    summary = summarise(scene, config.integrator.hide_emitters)
    plan = make_plan_report(config, scene, counts=not no_counts)
    measured = measure(config_file, overrides, config, samples or SAMPLES) if conditioning else None
    if as_json:
        report = {"obstacle": plan} if isinstance(plan, str) else dataclasses.asdict(plan)
        extra = {} if measured is None else {"conditioning": measured.to_json()}
        click.echo(json.dumps(dataclasses.asdict(summary) | {"plan": report} | extra, indent=2))
        return None
    click.echo(f"scene {config.scene.file}")
    for line in scene_lines(summary):
        click.echo(f"  {line}")
    for sensor in summary.sensors:
        click.echo(f"sensor {sensor.index} ({sensor.id})")
        for line in sensor_lines(sensor):
            click.echo(f"  {line}")
    click.echo("plan")
    for line in [f"none: {plan}"] if isinstance(plan, str) else plan_lines(plan):
        click.echo(f"  {line}")
    click.echo("parameters")
    for line in parameter_lines(summary.parameters):
        click.echo(f"  {line}")
    if summary.unnamed:
        click.echo("  keys that begin with object_ change from run to run: give those objects an id in the scene file")
    if measured is not None:
        from reslrb_cli.report.conditioning_table import conditioning_lines

        click.echo(f"conditioning ({measured.samples} gradients of {measured.spp} spp, seed {measured.seed})")
        for line in conditioning_lines(measured):
            click.echo(f"  {line}")
    return None


def show_offenders(config: Config, as_json: bool) -> int:
    """Print where the run of `config` first met a value that is not finite; exit code 1 where it does not again."""
    from reslrb_cli.cli.replaying import load_replay
    from reslrb_cli.measure.offender import find_offenders

    replay = load_replay(config)
    found = find_offenders(replay.problem, replay.iteration)
    if as_json:
        report = {"iteration": replay.iteration, "offenders": [dataclasses.asdict(entry) for entry in found]}
        click.echo(json.dumps(_named(report), indent=2, allow_nan=False))
    else:
        lines = [line for entry in found for line in offender_lines(entry, replay.iteration)]
        for line in lines or [f"iteration {replay.iteration}: all is finite this time"]:
            click.echo(line)
    return ExitCode.DONE if found else ExitCode.CHECK_FAILED


def offender_lines(offender: Offender, iteration: int) -> list[str]:
    """One view's offender, in lines."""
    place = "" if offender.pixel is None else f", pixel {offender.pixel}"
    value = f": {_numbers(offender.value)}" if offender.value else ""
    lines = [f"iteration {iteration}, sensor {offender.sensor}{place}", f"  {offender.quantity}{value}"]
    at = offender.where
    if at is not None:
        on = "" if at.surface is None else f", on {at.surface}"
        lines.append(f"  path {at.path} of {at.paths}, samples of {at.samples}, sampler seed {at.seed}")
        lines.append(f"  vertex {at.vertex}, at {_numbers(list(at.position))}{on}")
    if offender.image is not None and offender.target is not None:
        lines.append(f"  image {_numbers(offender.image)}, target {_numbers(offender.target)}")
    return lines


def _named(value: Any) -> Any:
    """The same with numbers that are not finite as text, "nan", "inf" and "-inf": JSON has none."""
    if isinstance(value, dict):
        return {key: _named(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_named(entry) for entry in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def _numbers(values: list[float]) -> str:
    return f"({', '.join(f'{value:.6g}' for value in values)})"


def measure(config_file: Path, overrides: tuple[str, ...], config: Config, samples: int) -> Conditioning:
    """The conditioning of the experiment; an estimator that is to be measured first makes no difference to it."""
    from reslrb_cli.measure.conditioning import measure_conditioning
    from reslrb_cli.optimization import assemble

    if config.integrator.options().get("estimator") == "auto":
        config = read_config(config_file, (*overrides, "integrator.estimator=stack"))
    return measure_conditioning(assemble(config, logging.getLogger(__name__).info), samples)


def make_plan_report(config: Config, scene: Any, counts: bool) -> PlanReport | str:
    """The plan of a step for the first sensor that is used, or why there is none. Sets initial values in `scene`."""
    from reslrb_cli.integrators import Reslrb
    from reslrb_cli.integrators.plan_report import report_plan
    from reslrb_cli.optimization.problem import choose_sensors
    from reslrb_cli.scene import select_parameters

    if config.integrator.type != "reslrb":
        return f"integrator.type is {config.integrator.type}; `reslrb` alone plans its kernels"
    options = config.integrator.options()
    if options.get("estimator") == "auto":
        options["estimator"] = "stack"  # `auto` is chosen by a run
    known = config.adjoint == "batched" or options.get("weight") == "adjoint"
    try:
        [sensor, *_] = choose_sensors(config, scene)
        selection = select_parameters(scene, config.parameters, config.source)
        integrator = Reslrb.of(**options)
        return report_plan(
            integrator, scene, scene.sensors()[sensor], selection.params, selection.keys, known=known, counts=counts
        )
    except (ConfigError, UnsupportedScene) as error:
        return str(error)


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
