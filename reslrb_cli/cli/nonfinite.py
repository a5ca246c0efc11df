"""`reslrb inspect --nonfinite`: where a run first met a value that is not finite."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import mitsuba as mi
import numpy as np

from reslrb_cli.cli.terminal import echo
from reslrb_cli.config.optimizers import AS_CONFIGURED
from reslrb_cli.config.schema import Config
from reslrb_cli.errors import ConfigError, ExitCode
from reslrb_cli.optimization.assemble import assemble_scene, at_stage
from reslrb_cli.optimization.autotune.sampling import as_decided, decided
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.state import guiding_of, restore_tables
from reslrb_cli.optimization.views import color_channels, to_tensor
from reslrb_cli.records.checkpoint import NONFINITE_FILE_NAME, NonFiniteStep, load_nonfinite
from reslrb_cli.records.decisions import Decision
from reslrb_cli.records.manifest import MANIFEST_FILE as MANIFEST
from reslrb_cli.records.manifest import read_manifest
from reslrb_cli.records.metrics import finite
from reslrb_cli.records.run_folder import RunFolder
from reslrb_cli.scene.images import read_bitmap

if TYPE_CHECKING:
    from reslrb_cli.measure.nonfinite_trace import Offender


OPTION = "--nonfinite"


@dataclass
class Replay:
    """A problem whose parameters and targets are those of the step of `iteration`."""

    problem: Problem
    iteration: int


def load_replay(config: Config) -> Replay:
    """The replay of the run in whose folder `config` lies. Raises ConfigError where there is none.

    What lies in the folder may be damaged, or of another run: whatever is read is checked against the configuration.
    """
    path = config.source.parent
    manifest = read_manifest(path)
    if manifest is None:
        raise ConfigError(config.source, OPTION, "is not in a run folder; give the config.yaml of a run")
    folder = RunFolder(path)
    saved = load_nonfinite(folder.checkpoint)
    if saved is None:
        raise ConfigError(config.source, OPTION, "this run met no value that was not finite")
    if config.codes:
        raise ConfigError(config.source, OPTION, f"runs no code of your own, which {next(iter(config.codes))} names")
    iteration, values = saved.iteration, saved.parameters
    archive, written = folder.checkpoint / NONFINITE_FILE_NAME, path / MANIFEST
    if not 0 <= iteration < config.run.iterations:
        raise ConfigError(archive, "iteration", f"is {iteration}; the run has {config.run.iterations} iterations")
    try:
        decisions = decided(config, map(Decision.from_json, manifest.get("decisions", ())))
    except TypeError:
        raise ConfigError(written, "decisions", "is not what a run decided, as it writes it") from None
    number = config.stage_number(iteration / config.run.iterations)
    coarse = config.stage(number).grain != AS_CONFIGURED.grain
    with _fitting(archive, config):
        problem = assemble_scene(config, values=None if coarse else values)
    integrator, size = problem.integrator, problem.samples_per_pass
    if manifest.get("memory"):
        size = _samples_per_pass(manifest["memory"], written)
        integrator = integrator.with_options(samples_per_pass=size, freeze=integrator.freeze)
    integrator = as_decided(integrator, decisions)
    if saved.shares:
        integrator = integrator.shared_out(saved.shares)
    problem = replace(problem, decisions=decisions, integrator=integrator, samples_per_pass=size)
    for view in problem.views:
        suffix = "" if len(problem.views) == 1 else f"-{view.sensor}"
        view.made = _read_image(folder.images / f"target{suffix}.exr", problem, view.sensor)
        weights = folder.images / f"weights{suffix}.exr"
        view.weights = _read_image(weights, problem, view.sensor) if weights.exists() else None
    if coarse:
        with _fitting(archive, config):
            problem = at_stage(problem, number, values)
    else:
        problem = replace(problem, config=config.at_stage(number))
    _teach(problem, saved, archive)
    return Replay(problem, iteration)


@contextmanager
def _fitting(archive: Path, config: Config) -> Iterator[None]:
    """Raise ConfigError where the values in the archive are not the experiment's."""
    try:
        yield
    except ValueError as error:
        raise ConfigError(archive, "", f"does not fit to {config.source}: {error}") from None


def _teach(problem: Problem, saved: NonFiniteStep, archive: Path) -> None:
    """Have the tables of a guided run's integrator know what they knew when the step began."""
    if guiding_of(problem) is None:
        return
    if saved.calls is None:
        raise ConfigError(archive, "calls", "is missing: what the paths of a guided step were drawn from")
    wrong = restore_tables(problem, saved.calls, saved.learned)
    if wrong is not None:
        raise ConfigError(archive, wrong, "is not what was learned of this scene")


def _samples_per_pass(memory: Any, path: Path) -> int:
    count = memory.get("samples_per_pass") if isinstance(memory, dict) else None
    if type(count) is not int or not 1 <= count < 2**31:
        raise ConfigError(path, "memory.samples_per_pass", "is not a number of samples, as a run writes it")
    return count


def _read_image(path: Path, problem: Problem, sensor: int) -> mi.TensorXf:
    """The target, or its weights, that a run wrote. Raises ConfigError where it is not one for this sensor."""
    film = problem.scene.sensors()[sensor].film()
    width, height = film.crop_size()
    array = np.array(read_bitmap(path, (int(width), int(height))), dtype=np.float32)
    array = array if array.ndim == 3 else array[:, :, None]
    colors = color_channels(film)
    if array.shape[2] != colors:
        raise ConfigError(path, "", f"must have the film's channels; its own: {array.shape[2]}, the film's: {colors}")
    return to_tensor(array)


def show_offenders(config: Config, as_json: bool) -> int:
    """Print where the run of `config` first met a value that is not finite; exit code 1 where it does not again."""
    from reslrb_cli.measure.nonfinite_trace import find_offenders

    replay = load_replay(config)
    found = find_offenders(replay.problem, replay.iteration)
    if as_json:
        report = {"iteration": replay.iteration, "offenders": [dataclasses.asdict(entry) for entry in found]}
        click.echo(json.dumps(finite(report, str), indent=2, allow_nan=False))
    else:
        lines = [line for entry in found for line in offender_lines(entry, replay.iteration)]
        for line in lines or [f"iteration {replay.iteration}: all is finite this time"]:
            echo(line)
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


def _numbers(values: list[float]) -> str:
    return f"({', '.join(f'{value:.6g}' for value in values)})"
