"""From a configuration to the problem that it states: loaded, checked, targets made, what is measured settled."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from reslrb_cli.config.schema import Config
from reslrb_cli.integrators.reslrb import LightTracer
from reslrb_cli.optimization import start
from reslrb_cli.optimization.autotune.estimators import find_options
from reslrb_cli.optimization.autotune.sampling import settle
from reslrb_cli.optimization.errors import quantity
from reslrb_cli.optimization.identifiability import check_exposures, find_reached
from reslrb_cli.optimization.loading import (
    check_integrator,
    choose_sensors,
    load_configured,
    make_configured,
    pass_spp,
    paths_of,
    samples_per_pass,
)
from reslrb_cli.optimization.memory import check_announced, check_described, check_films, outlook
from reslrb_cli.optimization.moving import check_moving, moves_anything
from reslrb_cli.optimization.problem import Problem, make_optimizer, make_regularizers
from reslrb_cli.optimization.state import begin_as, decide_as, reach_as
from reslrb_cli.optimization.targets import make_targets
from reslrb_cli.optimization.views import expose, make_views
from reslrb_cli.records.cache import PilotCache
from reslrb_cli.records.tree import Stored
from reslrb_cli.scene.parameters import Selection, select_parameters

Array = np.ndarray[Any, Any]


def assemble(
    config: Config,
    say: Callable[[str], None] = lambda line: None,
    cache: PilotCache | None = None,
    to_run: bool = False,
    settled: Stored | None = None,
) -> Problem:
    """Load and check what `config` names, make the targets, and settle the integrator; a variant must be set.

    Everything that can be checked is, before anything is rendered. `say` is told what takes long, `cache` holds what
    earlier pilots learned (None: nothing is kept). With `to_run` all that an optimisation needs is there: exposures
    are checked, and what light and sensor reach is known. With `settled` nothing is measured anew: it is the problem of
    a run that goes on, as it was before its first iteration. Raises ConfigError and UnsupportedScene.
    """
    problem = assemble_scene(config)
    if settled is not None:
        begin_as(problem, settled)
    options = find_options(problem)
    line = outlook(config, problem.scene, problem.sensors) if to_run else None
    if line is not None:
        say(line)
    starts = start.prepare(problem) if settled is None else []
    problem = make_targets(problem, say)
    problem = start.begin(problem, starts, say)
    if settled is not None:
        return reach_as(decide_as(problem, settled, options), settled)
    problem = settle(problem, options, say, cache)
    if to_run:
        check_exposures(problem)
        problem = find_reached(problem)
    return problem


def load_for_rendering(
    config: Config, initial: bool, say: Callable[[str], None] = lambda line: None
) -> tuple[Any, list[int], Any, int | None]:
    """Load the scene (with the parameters' initial values, if `initial`), and make the integrator.

    Returns both, between them the indices of the sensors in use, and the integrator's `samples_per_pass`.
    """
    if initial:
        problem = assemble_scene(config)
        starts = start.prepare(problem)
        if starts:
            start.begin(make_targets(problem, say), starts, say)
        return problem.scene, problem.sensors, problem.integrator, samples_per_pass(config)
    scene = load_configured(config, selects=False)
    sensors = choose_sensors(config, scene)
    check_integrator(config, config.integrator, scene, sensors)
    integrator = make_configured(config.integrator, paths_of(config.integrator, scene, sensors))
    return scene, sensors, integrator, samples_per_pass(config)


def assemble_scene(config: Config, scene: Any = None, values: Mapping[str, Array] | None = None) -> Problem:
    """Load and check what `config` names, targets left out.

    `scene` is used in place of `scene.file`, `values` in place of the parameters' initial ones. Raises ValueError where
    these are not one finite array for each parameter, of its shape.
    """
    check_announced(config)
    scene = load_configured(config, functools.partial(check_described, config)) if scene is None else scene
    views = make_views(config, scene)
    check_films(config, scene, [view.sensor for view in views])
    sensors = [view.sensor for view in views]
    selection = select_parameters(scene, config.parameters, config.source)
    moves = moves_anything(config, selection)
    check_integrator(config, config.integrator, scene, sensors, moves)
    paths = paths_of(config.integrator, scene, sensors, moves)
    expose(views, scene, selection)
    if values is not None:
        _check_values(selection, values)
        selection.set_arrays(values)
    problem = Problem(
        config=config,
        scene=scene,
        views=views,
        selection=selection,
        integrator=make_configured(config.integrator, paths),
        paths=paths,
        moves=moves,
        optimizer=make_optimizer(config, selection),
        samples_per_pass=samples_per_pass(config),
        regularizers=make_regularizers(selection),
        quantities={
            key: "" if key in selection.factors else selection.quantity(key) or quantity(selection.params, key)
            for key in selection.keys
        },
    )
    if isinstance(problem.integrator, LightTracer):
        problem.integrator.expect(pass_spp(config))
    problem.apply()
    check_moving(problem)
    return problem


def _check_values(selection: Selection, values: Mapping[str, Array]) -> None:
    foreign = sorted(set(values) ^ set(selection.keys))
    if foreign:
        raise ValueError(f"it {'has' if foreign[0] in values else 'lacks'} `{foreign[0]}`")
    for key, value in values.items():
        shape = selection.array(key).shape
        if value.shape != shape or value.dtype.kind != "f":
            raise ValueError(f"`{key}` is {value.dtype} of shape {value.shape}, not numbers of shape {shape}")
        if not np.isfinite(value).all():
            raise ValueError(f"`{key}` holds a value that is not finite")
