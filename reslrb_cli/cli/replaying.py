"""The problem of a run as it stood in the first iteration with a value that was not finite."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.config import Config, Reslrb
from reslrb_cli.errors import ConfigError
from reslrb_cli.optimization.problem import Problem, assemble_scene
from reslrb_cli.records.checkpoint import load_nonfinite
from reslrb_cli.records.manifest import read_manifest
from reslrb_cli.records.run_folder import RunFolder

OPTION = "--nonfinite"


@dataclass
class Replay:
    """A problem whose parameters and targets are those of the step of `iteration`."""

    problem: Problem
    iteration: int


def load_replay(config: Config) -> Replay:
    """The replay of the run in whose folder `config` lies. Raises ConfigError where there is none."""
    path = config.source.parent
    manifest = read_manifest(path)
    if manifest is None:
        raise ConfigError(config.source, OPTION, "is not in a run folder; give the config.yaml of a run")
    folder = RunFolder(path)
    saved = load_nonfinite(folder.checkpoint)
    if saved is None:
        raise ConfigError(config.source, OPTION, "this run met no value that was not finite")
    iteration, values = saved
    problem = assemble_scene(_chosen(config, manifest), values=values)
    if manifest.get("memory"):
        problem.samples_per_pass = int(manifest["memory"]["samples_per_pass"])
        problem.integrator = problem.integrator.with_options(
            samples_per_pass=problem.samples_per_pass, freeze=problem.integrator.freeze
        )
    for sensor in problem.sensors:
        name = "target" if len(problem.sensors) == 1 else f"target-{sensor}"
        problem.targets.append(_read(folder.images / f"{name}.exr", config))
    return Replay(problem, iteration)


def _chosen(config: Config, manifest: dict[str, Any]) -> Config:
    """The configuration with the estimator that the run's pilot chose."""
    if not manifest.get("pilot") or not isinstance(config.integrator, Reslrb):
        return config
    return config.model_copy(update={"integrator": config.integrator.chosen(**manifest["pilot"]["chosen"])})


def _read(path: Path, config: Config) -> Any:
    if not path.exists():
        raise ConfigError(config.source, OPTION, f"needs {path}, which the run wrote")
    array = np.array(mi.Bitmap(str(path)), dtype=np.float32)
    target = mi.TensorXf(np.ascontiguousarray(array if array.ndim == 3 else array[:, :, None]))
    dr.make_opaque(target)
    return target
