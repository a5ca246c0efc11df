"""`reslrb inspect`: what a scene contains, and which of its parameters can be recovered."""

from __future__ import annotations

import dataclasses
import json
import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from reslrb_cli.cli.experiment import overrides_option, start_variant
from reslrb_cli.cli.listing import (
    LISTED_SENSORS,
    moving_lines,
    parameter_lines,
    plain,
    plan_lines,
    scene_lines,
    sensor_lines,
)
from reslrb_cli.cli.offending import show_offenders, without_nan
from reslrb_cli.cli.output import echo
from reslrb_cli.cli.subject import Subject, read_subject
from reslrb_cli.errors import ConfigError, UnsupportedScene

if TYPE_CHECKING:
    from reslrb_cli.config import Config
    from reslrb_cli.integrators.plan_report import PlanReport
    from reslrb_cli.measure.conditioning import Conditioning
    from reslrb_cli.scene import SceneSummary, Selection

#: Gradients that `--conditioning` takes.
SAMPLES = 8


@click.command("inspect")
@click.argument("path", metavar="PATH", type=click.Path(path_type=Path))
@overrides_option
@click.option("--all", "everything", is_flag=True, help="List what cannot be recovered, too.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object, with everything, instead of lines.")
@click.option("--no-counts", is_flag=True, help="Do not compile kernels to count their operations (takes seconds).")
@click.option(
    "--nonfinite",
    is_flag=True,
    help="Say where the run in whose folder PATH is first met a value that is not finite: trace that step again.",
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
    path: Path,
    overrides: tuple[str, ...],
    everything: bool,
    as_json: bool,
    no_counts: bool,
    nonfinite: bool,
    conditioning: bool,
    samples: int | None,
) -> int | None:
    """List what of a scene can be recovered, with its current value, and what the scene contains.

    PATH is a scene file (XML), a configuration, which need not be complete, or the folder of a run. The keys that are
    listed first may stand in `parameters` of a configuration; of the others the reasons are given. Where `parameters`
    are, the plan of a step says which features the scene and the parameters call for and which are left out, with the
    number of operations that the kernels of a step have with and without each of them.

    --conditioning says how far apart the parameters' sensitivities lie, where they start: of each the root mean square
    of its values, its gradient and the noise of one step's gradient, the relative change of the image and the curvature
    of the loss per unit of the parameter, and the length by which it would have to change to make up the image where it
    has an effect. `optimizer.scale: auto` makes up for what it shows. Where parameters move light, condition numbers of
    the Jacobians along paths come with it.
    """
    if samples is not None and not conditioning:
        raise click.UsageError("--samples has no effect without --conditioning")
    subject = read_subject(path, overrides)
    config = subject.config
    if conditioning and subject.missing:
        raise ConfigError(path, subject.missing[0], "missing; --conditioning measures a complete experiment")
    start_variant(config)
    if nonfinite:
        return show_offenders(config, as_json)

    from reslrb_cli.optimization.loading import load_configured
    from reslrb_cli.scene import summarise

    scene = load_configured(config, selects="parameters" not in subject.missing)
    summary = summarise(scene, config.integrator.hide_emitters)
    selection = None if "parameters" in subject.missing else select(config, scene)
    plan = None if selection is None else make_plan_report(subject, scene, selection, counts=not no_counts)
    edges = [] if selection is None or isinstance(selection, str) else edges_of(scene, selection)
    measured = measure(subject, overrides, samples or SAMPLES) if conditioning else None
    if as_json:
        report = {"obstacle": plan} if isinstance(plan, str) else plan and dataclasses.asdict(plan)
        extra = {} if measured is None else {"conditioning": measured.to_json()}
        everything_known = {"run": subject.run} | plain(summary) | {"plan": report, "edges": edges} | extra
        click.echo(json.dumps(without_nan(everything_known), indent=2, allow_nan=False))
        return None
    if subject.run is not None:
        echo(run_line(subject))
    echo(f"scene {config.scene.file}")
    for line in scene_lines(summary):
        echo(f"  {line}")
    sensors = summary.sensors if everything else summary.sensors[:LISTED_SENSORS]
    for sensor in sensors:
        echo(f"sensor {sensor.index} ({sensor.id})")
        for line in sensor_lines(sensor):
            echo(f"  {line}")
    if len(sensors) < len(summary.sensors):
        echo(f"and {len(summary.sensors) - len(sensors)} more sensors; --all lists them")
    if plan is not None:
        echo("plan")
        for line in [f"none: {plan}"] if isinstance(plan, str) else plan_lines(plan):
            echo(f"  {line}")
    echo("parameters")
    wanted = [] if "parameters" in subject.missing else [key for spec in config.parameters for key in spec.keys]
    for line in [*parameter_lines(summary.parameters, wanted, everything), *moving_lines(summary.movable, everything)]:
        echo(f"  {line}")
    for name in edges:
        echo(f"  silhouettes and shadow edges of {name} are not in its derivatives")
    if measured is not None:
        from reslrb_cli.report.conditioning_table import chain_lines, conditioning_lines

        echo(f"conditioning ({measured.samples} gradients of {measured.spp} spp, seed {measured.seed})")
        for line in conditioning_lines(measured):
            echo(f"  {line}")
        if measured.chains:
            echo("chains of Jacobians, as estimator reservoir inverts them: condition numbers by number of vertices")
            for line in chain_lines(measured):
                echo(f"  {line}")
    else:
        echo(f"next: {next_step(subject, summary)}")
    return None


def run_line(subject: Subject) -> str:
    """How far the run came whose folder was named."""
    run = subject.run or {}
    iterations = run.get("results", {}).get("iterations")
    words = [
        str(run.get("status")),
        "" if iterations is None else f"{iterations} iterations",
        str(run.get("error") or ""),
    ]
    return f"run {subject.path}: {', '.join(word for word in words if word)}"


def next_step(subject: Subject, summary: SceneSummary) -> str:
    """What someone who has read all this may want to do now."""
    keys = [info.key for info in summary.parameters if info.obstacle is None]
    if summary.sensors and all(sensor.obstacle == sensor.camera_obstacle is not None for sensor in summary.sensors):
        return "change what cannot be rendered; the reason above says how"
    if not keys:
        return "nothing here can be recovered as it stands; the reasons above say what may be changed in the scene file"
    sections = {"target": "target: {file: IMAGE}", "parameters": f"parameters: [{{key: {json.dumps(keys[0])}}}]"}
    missing = " and ".join(f"`{sections[section]}`" for section in subject.missing)
    if subject.is_scene:
        return f"`reslrb init {subject.path} --target PHOTO` writes a configuration of it"
    if missing:
        return f"add {missing} to {subject.path}, and run `reslrb optimize {subject.path}`"
    return f"`reslrb optimize {subject.config.source}`" + (" runs it again" if subject.run else " runs it")


def measure(subject: Subject, overrides: tuple[str, ...], samples: int) -> Conditioning:
    """The conditioning of the experiment; an estimator that is to be measured first makes no difference to it."""
    from reslrb_cli.measure.conditioning import measure_conditioning
    from reslrb_cli.optimization import assemble

    config = subject.config
    if config.integrator.options().get("estimator") == "auto":
        config = read_subject(subject.path, (*overrides, "integrator.estimator=stack")).config
    return measure_conditioning(assemble(config, logging.getLogger(__name__).info), samples)


def select(config: Config, scene: Any) -> Selection | str:
    """What the configuration recovers, or why that cannot be. Sets initial values in `scene`."""
    from reslrb_cli.scene import select_parameters

    try:
        return select_parameters(scene, config.parameters, config.source)
    except ConfigError as error:
        return str(error)


def edges_of(scene: Any, selection: Selection) -> list[str]:
    """The shapes that the configuration moves whose edges move, too."""
    from reslrb_cli.scene.movable import casts_edges, where_moved

    moved = where_moved(selection.params, selection.scene_keys)
    return [item.id for item in moved if casts_edges(scene, item)]


def make_plan_report(subject: Subject, scene: Any, selection: Selection | str, counts: bool) -> PlanReport | str:
    """The plan of a step for the first sensor that is used, or why there is none."""
    from reslrb_cli.integrators import Reslrb
    from reslrb_cli.integrators.features import GUIDED, SEQUENCE
    from reslrb_cli.integrators.plan_report import report_plan, with_reason
    from reslrb_cli.optimization.loading import choose_sensors, pass_spp

    config = subject.config
    if isinstance(selection, str):
        return selection
    if config.integrator.type != "reslrb":
        return f"integrator.type is {config.integrator.type}; `reslrb` alone plans its kernels"
    options = config.integrator.options()
    if options.get("estimator") == "auto":
        options["estimator"] = "stack"  # `auto` is chosen by a run
    reasons = {}
    for feature, option in ((GUIDED, "guiding"), (SEQUENCE, "sequence")):
        options[option], reasons[feature] = sampling_of(subject, option)
    known = config.adjoint == "batched" or options.get("weight") == "adjoint"
    try:
        [sensor, *_] = choose_sensors(config, scene)
        integrator = Reslrb.of(**options)
        integrator.expect(pass_spp(config))
        params, keys = selection.params, selection.scene_keys
        report = report_plan(integrator, scene, scene.sensors()[sensor], params, keys, known=known, counts=counts)
    except (ConfigError, UnsupportedScene) as error:
        return str(error)
    for feature, why in reasons.items():
        report = dataclasses.replace(report, rows=with_reason(report.rows, feature, why)) if why else report
    return report


def sampling_of(subject: Subject, option: str) -> tuple[str, str]:
    """`integrator.guiding`, or `sequence`, as it is, and why, where that was or is left to a run (else empty)."""
    from reslrb_cli.config.integrators import UNDECIDED
    from reslrb_cli.records.paid import GuidedRecord, PaidRecord, SequenceRecord

    asked = str(subject.config.integrator.options()[option])
    if asked != "auto":
        return asked, ""
    kinds: dict[str, tuple[type[PaidRecord], str]] = {
        "guiding": (GuidedRecord, "guided"),
        "sequence": (SequenceRecord, "sequence"),
    }
    kind, name = kinds[option]
    try:
        record = kind.from_json(dict((subject.run or {}).get(name) or {}))
    except (TypeError, ValueError):  # there is no run yet, or its manifest is damaged
        return UNDECIDED[option], f"{option}: auto, which a run decides by measurement"
    return record.setting, f"{option}: auto, {record.why()}"
