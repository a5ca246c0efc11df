"""Experiments of a script: loaded from wherever they are described, and looked at in single calls.

- `load`: a configuration, of a file, a mapping or a run's folder.
- `render`, `gradient`, `gradcheck`, `convergence`, `export`: the commands, or what they are made of, as functions.
- `held`: an interrupt that waits until it is safe to stop.
"""

from __future__ import annotations

import contextlib
import gc
import logging
import os
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import Any, Literal, TypeAlias

import numpy as np

from reslrb_cli.backend.variant import keep_variant
from reslrb_cli.config import loader
from reslrb_cli.config.files import as_path
from reslrb_cli.config.loader import Override
from reslrb_cli.config.schema import Config
from reslrb_cli.errors import ConfigError
from reslrb_cli.records.measurement_files import Line
from reslrb_cli.records.measurements import GradcheckRecord
from reslrb_cli.records.run_folder import recovered

Array: TypeAlias = "np.ndarray[Any, np.dtype[np.float32]]"
#: Whatever describes an experiment: a configuration's file, a run's folder, what YAML would have been, or a `Config`.
Experiment: TypeAlias = "Config | str | os.PathLike[str] | Mapping[str, Any]"

#: What errors say of an experiment that was no file.
NAMELESS = "<dict>"

#: What errors advise on the command line, and what that is in a script.
ARGUMENTS = {
    "add --set run.output=FOLDER": "give folder=FOLDER",
    "--allow-code has it run": "allow_code=True has it run, or the experiment `load(...).with_code()`",
}

logger = logging.getLogger(__name__)


@contextlib.contextmanager
def held() -> Iterator[Callable[[], bool]]:
    """Have Ctrl-C, and a notebook's interrupt, wait until the block is done, which then raises KeyboardInterrupt.

    In the midst of what Mitsuba and Dr.Jit are doing it would end in a crash, or in an error that names something else.
    Yields what says whether one waits, for blocks that take long. In another thread than the main one, and within
    another such block, nothing is done.
    """
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or before is not signal.default_int_handler:
        yield lambda: False
        return
    came = False

    def mark(number: int, frame: FrameType | None) -> None:
        nonlocal came
        came = True

    signal.signal(signal.SIGINT, mark)
    try:
        yield lambda: came
    finally:
        signal.signal(signal.SIGINT, before)
    if came:
        raise KeyboardInterrupt


@contextlib.contextmanager
def called() -> Iterator[Callable[[], bool]]:
    """The same, with errors of what is a command's option located by the argument, which has its name."""
    with held() as stop:
        try:
            yield stop
        except ConfigError as error:
            name, message = error.source, error.message
            for option, argument in ARGUMENTS.items():
                message = message.replace(option, argument)
            if name.startswith("--"):
                name = name.removeprefix("--").replace("-", "_")
                name, message = {"output": "folder"}.get(name, name), message.replace("--output", "folder")
            raise ConfigError(name, error.key, message) from None


def load(
    experiment: Experiment,
    overrides: Mapping[str, object] | None = None,
    base: str | os.PathLike[str] | None = None,
) -> Config:
    """The experiment that a file, a mapping or a run describes, checked, with every default.

    `experiment` is a YAML file; a mapping that is what YAML would have been (paths, tuples, and NumPy's numbers and
    arrays may stand in it); the folder of a run, whose parameters then begin where the run has brought them; or a
    `Config`. `overrides` are values by key, as `--set` names them: `{"run.iterations": 5, "parameters[0].bounds": [0,
    1]}`. Paths are relative to the file, those of a mapping to `base`, the working directory unless it is given.

    Nothing that the experiment names is opened yet, and no Mitsuba variant is set.

    Raises ConfigError, located by file and key, for what is unknown, missing or of a wrong kind; an override that is at
    fault is located by `overrides`.
    """
    return load_with(experiment, loader.overrides_of(overrides), base)


def load_with(experiment: Experiment, put_in: Sequence[Override], base: str | os.PathLike[str] | None = None) -> Config:
    """The same with overrides that were read already."""
    if isinstance(experiment, Config):
        return loader.changed(experiment, put_in)
    if isinstance(experiment, Mapping):
        path = Path(NAMELESS) if base is None else as_path(base, "base", "the path of a folder") / NAMELESS
        data = loader.plain(experiment, NAMELESS)
        run = {} if data.get("run") is None else data["run"]
        data["run"] = {"name": "run", **run} if isinstance(run, dict) else run
        return loader.resolve(data, path, put_in)
    path = as_path(experiment, "experiment", "a file, a mapping or a run's folder")
    if path.is_dir():
        return recovered(path, put_in)
    return loader.load(path, put_in)


def render(
    experiment: Experiment,
    spp: int | None = None,
    values: Mapping[str, Any] | None = None,
    initial: bool = True,
) -> dict[int, Array]:
    """The image of each view's sensor, by its index: (height, width, channels) float32, in linear units of radiance.

    The scene is rendered by the experiment's integrator with `spp` samples per pixel (`run.spp` unless it is given);
    its parameters have their initial values, of a run those that it recovered. `values` are taken in their place, by
    key: arrays of the parameter's shape, or what NumPy makes such of, as a number; what is not named stays. With
    `initial=False` the scene is as it stands in its file.

    Sets the Mitsuba variant of the experiment where none is set. Raises ConfigError, also where another one is set, and
    UnsupportedScene.
    """
    with called():
        config = load(experiment)
        if values is not None and not initial:
            raise ConfigError("values", "", "are those of parameters; leave out `initial=False`")
        keep_variant(config.variant, config.source)
        from reslrb_cli.optimization.assemble import check_passes, load_for_rendering
        from reslrb_cli.optimization.loading import render_in_passes

        scene, sensors, integrator, multiple = load_for_rendering(config, initial, values)
        samples = config.run.spp if spp is None else spp
        check_passes("spp", samples, multiple)
        return {
            sensor: render_in_passes(integrator, scene, sensor, samples, config.run.seed, 0, "render", multiple)
            for sensor in sensors
        }


def gradient(
    experiment: Experiment,
    values: Mapping[str, Any] | None = None,
    spp: int | None = None,
    seed: int | None = None,
) -> tuple[float, dict[str, Array]]:
    """The loss of an experiment and its gradient by key, each in its parameter's shape and per its unit, float32.

    It is that of the first iteration of a run: of the images that `run.adjoint` takes, at the parameters' initial
    values, or at `values`, as for `render`. `spp` stands in for `run.spp`, and `seed` for the `run.seed` of the
    samples; the target, and what is measured before (`guiding: auto`, ...), stay those of the experiment.
    Regularizers are in the gradient, and not in the loss. Entries that are not finite are left as they are.

    Sets the Mitsuba variant of the experiment where none is set. Raises ConfigError, UnsupportedScene.
    """
    with called():
        config = load(experiment, None if spp is None else {"run.spp": spp})
        reseeded = config if seed is None else load(config, {"run.seed": seed})
        keep_variant(config.variant, config.source)
        from reslrb_cli.optimization.assemble import assemble, set_values
        from reslrb_cli.optimization.loop import Split
        from reslrb_cli.optimization.loop import gradient as step_gradient
        from reslrb_cli.records.decisions import DecisionCache

        problem = assemble(config, logger.info, DecisionCache())
        if values is not None:
            problem = set_values(problem, values)
        problem = replace(problem, config=reseeded)
        loss = step_gradient(problem, 0, Split())[0]
        found = {key: problem.optimizer.gradient(key) for key in problem.selection.keys}
        return float(loss[0]), {key: problem.selection.shown(key, value) for key, value in found.items()}


def gradcheck(
    experiment: Experiment,
    estimators: str | None = None,
    budget: float = 45.0,
    seeds: int | None = None,
    spp: int | None = None,
    integrators: str | None = None,
    allow_code: bool = False,
) -> list[GradcheckRecord]:
    """The comparisons of `reslrb gradcheck`, one record each, as `--json` writes them (docs/gradcheck.md).

    `estimators` is the list that `--estimators` takes (all four, unless it is given), `budget` the seconds for the
    whole, `seeds` their number whatever time they take, at least 3, `spp` the samples per pixel of one gradient.
    `record.holds` is False where a comparison fails. `integrators` are Mitsuba integrators of your own,
    `FILE.py:CLASS[(OPTION=VALUE,...)]`, in place of ours; `allow_code` has their files run (docs/your_integrator.md).
    How noisy and dear they are, and where to look in one that is wrong, is logged (`logging.INFO`). An interrupt ends
    it after the gradient that is at work, in KeyboardInterrupt.

    Sets the Mitsuba variant of the experiment where none is set. Raises ConfigError, UnsupportedScene.
    """
    began = time.monotonic()
    with called() as stop:
        config = load(experiment)
        config = config.with_code(allow_code or config.allows_code)
        for name, value, least in (("seeds", seeds, 3), ("spp", spp, 1)):
            if value is not None and value < least:
                raise ConfigError(name, "", f"is {value}; at least {least} are needed")
        keep_variant(config.variant, config.source)
        from reslrb_cli.measure.gradcheck import Gradcheck
        from reslrb_cli.measure.participants import settings_of

        gc.collect()  # scenes that are done with would take part, and their parameters' gradients be in the way
        checked = settings_of(config, estimators, budget, seeds, spp, time.monotonic() - began, integrators)
        check = Gradcheck(checked)
        records = [result.record for result in check.run(stop, logger.info)]
        if integrators is not None:
            from reslrb_cli.measure.own import look_into

            for line in look_into(check, records, stop, logger.debug):
                logger.info(line)
        return records


def convergence(
    experiment: Experiment,
    integrators: str | None = None,
    objective: Literal["fixed", "loss", "image"] = "fixed",
    budget: float = 240.0,
    rounds: int | None = None,
    spps: Sequence[int] = (),
    reference: str | None = None,
    allow_code: bool = False,
) -> list[Line]:
    """What `reslrb convergence --json` writes: points, methods, references, and a sentence (docs/convergence.md).

    The arguments are the command's options: `integrators` and `reference` as `--integrators` and `--reference` take
    them, `budget` the seconds for the whole, `rounds` the number of turns whatever time they take, `spps` samples per
    pixel that are compared; `allow_code` has the files of integrators of your own run. Each method computes in a
    process of its own, under the experiment's variant; none is set in this one. An interrupt ends it soon, in
    KeyboardInterrupt.

    Raises ConfigError.
    """
    began = time.monotonic()
    with called() as stop:
        config = load(experiment)
        config = config.with_code(allow_code or config.allows_code)
        from reslrb_cli.measure.convergence.judgement import Judgement
        from reslrb_cli.measure.convergence.session import Session
        from reslrb_cli.measure.methods import DEFAULTS, Plan, compared, machine_of
        from reslrb_cli.report.convergence_tables import result_lines

        if objective not in DEFAULTS:
            raise ConfigError("objective", "", f"is {objective!r}; there are {', '.join(DEFAULTS)}")
        for option, count in [("rounds", rounds), *(("spps", each) for each in spps)]:
            if count is not None and count < 1:
                raise ConfigError(option, "", f"is {count}; at least 1 is needed")
        plan = Plan(
            **machine_of(config, None), **compared(integrators, reference, DEFAULTS[objective], {}), config=config,
            objective=objective, budget_s=budget, rounds=rounds, spps=tuple(dict.fromkeys(spps)),
        )  # fmt: skip
        plan.check()
        with tempfile.TemporaryDirectory(prefix="reslrb-measuring-") as name:
            spent_s = time.monotonic() - began
            session = Session(plan, Path(name), stop, logger.info, spent_s=spent_s)
            for _ in session.run():
                pass
            if stop():
                raise KeyboardInterrupt
            return result_lines(Judgement(session).results())


def export(run: str | os.PathLike[str], folder: str | os.PathLike[str], tolerances: bool = False) -> Path:
    """Write the scene of a run with the values that it recovered, for Mitsuba alone; returns the path of `scene.xml`.

    `run` is the run's folder, `folder` one that does not exist yet, or is empty. Of a lens or a mirror it also holds
    the solid, in millimetres, and with `tolerances` what the scene throws where something is not as planned, as
    `reslrb export` has it. `mi.load_file` reads what is returned.

    Sets the Mitsuba variant of the run's experiment where none is set. Raises ConfigError, UnsupportedScene.
    """
    with called():
        begun = "the folder of a run, which `optimize(..., folder=...)` makes as its loop begins"
        path, out = as_path(run, "run", begun), as_path(folder, "folder", "the path of a folder")
        config = recovered(path, ())
        from reslrb_cli.runs.export import check_export, write_export

        check_export(config, out, tolerances)
        keep_variant(config.variant, config.source)
        write_export(config, path, out, tolerances, logger.info)
        return out / "scene.xml"
