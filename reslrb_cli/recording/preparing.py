"""From a configuration to a problem that is ready to run, and the manifest that says what was settled on the way."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from reslrb_cli.backend.device import device_name
from reslrb_cli.config import Config, dump
from reslrb_cli.config.files import read_file
from reslrb_cli.config.limits import IMAGE_BYTES
from reslrb_cli.errors import printable
from reslrb_cli.measure.rival import measure_rival
from reslrb_cli.optimization import Problem, assemble
from reslrb_cli.optimization.border import warn_of_border
from reslrb_cli.optimization.correlated_rounds import measure_correlated_bias
from reslrb_cli.optimization.planning import plan_record
from reslrb_cli.optimization.views import view_records
from reslrb_cli.recording.course import Course
from reslrb_cli.records.manifest import Manifest
from reslrb_cli.records.pilot_cache import PilotCache
from reslrb_cli.report.tone import exposure_for
from reslrb_cli.scene.needs import unsupported_part
from reslrb_cli.scene.seen import sees_lamps

Say = Callable[[str], None]


def prepare(config: Config, variant: str, say: Say, warn: Say) -> tuple[Course, Manifest]:
    """Assemble a new run, and measure what is to be known before it; a variant must be set.

    `say` is told what takes long, `warn` what to look at. Raises ConfigError and UnsupportedScene.
    """
    cache = PilotCache()
    problem = assemble(config, say, cache, to_run=True)
    bias = measure_correlated_bias(problem, say)
    line = None if bias is None else bias.line()
    if line is not None:
        warn(line)
    warn_of_border(problem, warn)
    rival = measure_rival(problem, cache, say)
    if problem.allowance is not None and problem.allowance.spent_s:
        say(problem.allowance.line())
    if rival is not None and rival.is_better:
        warn(f"{rival.line()}; --set integrator.type={rival.integrator}")
    manifest = manifest_of(problem, variant, config.source)
    manifest.rival = None if rival is None else rival.to_json()
    manifest.correlated_bias = None if bias is None else bias.to_json()
    return Course(problem, fixed_of(problem, variant)), manifest


def manifest_of(problem: Problem, variant: str, config_file: Path) -> Manifest:
    """The manifest of a run of `problem`, as far as the problem tells."""
    manifest = Manifest(
        variant=variant, device=device_name(variant), seed=problem.config.run.seed, config=printable(config_file)
    )
    manifest.plan = plan_record(problem)
    manifest.views = view_records(problem.views)
    for record, view in zip(manifest.views, problem.views, strict=True):
        sensor = problem.scene.sensors()[view.sensor]
        # What no light path can deal with, primary rays may not either.
        lamps = sees_lamps(problem.scene, sensor) if unsupported_part(problem.scene, sensor) is None else None
        record["shown"] = exposure_for(np.array(view.target), lamps)
    manifest.pilot = None if problem.pilot is None else problem.pilot.to_json()
    manifest.guided = None if problem.guided is None else problem.guided.to_json()
    manifest.sequence = None if problem.sequence is None else problem.sequence.to_json()
    manifest.memory = None if problem.memory is None else problem.memory.to_json()
    return manifest


def fixed_of(problem: Problem, variant: str) -> dict[str, Any]:
    """What every checkpoint says of the experiment: by it another process assembles the same problem."""
    return {
        "config": dump(problem.config),
        "variant": variant,
        "files": digests(problem.config),
        "pilot": None if problem.pilot is None else problem.pilot.to_json(),
        "guided": None if problem.guided is None else problem.guided.to_json(),
        "sequence": None if problem.sequence is None else problem.sequence.to_json(),
        "memory": None if problem.memory is None else problem.memory.to_json(),
    }


def digests(config: Config) -> dict[str, str]:
    """What is in the files that the experiment names, in short, by the keys that name them: scene, cameras, targets."""
    named: dict[str, Path | None] = {"scene.file": config.scene.file, "scene.cameras": config.scene.cameras}
    named |= {f"target.file[{place}]": path for place, path in enumerate(config.target.file or ())}
    named |= {f"views[{place}].target": view.target for place, view in enumerate(config.views or ())}
    return {
        key: hashlib.blake2b(read_file(path, IMAGE_BYTES), digest_size=16).hexdigest()
        for key, path in named.items()
        if path is not None and path.is_file()
    }
