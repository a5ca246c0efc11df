"""Assembly of a configuration's problem. The problem is loaded and checked, its targets are made, and its open settings
are decided.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any

import mitsuba as mi
import numpy as np

from reslrb_cli.config.loader import check_code
from reslrb_cli.config.parameters import ImageFile
from reslrb_cli.config.schema import Config
from reslrb_cli.errors import ConfigError, UnsupportedScene
from reslrb_cli.integrators.baselines import Projective
from reslrb_cli.integrators.own import OwnIntegrator
from reslrb_cli.integrators.reslrb import LightTracer
from reslrb_cli.optimization.autotune.sampling import decide
from reslrb_cli.optimization.identifiability import check_exposures, find_reached
from reslrb_cli.optimization.loading import (
    check_integrator,
    choose_sensors,
    load_configured,
    make_configured,
    pass_spp,
    paths_of,
    samples_per_pass,
    what_moves,
)
from reslrb_cli.optimization.memory import check_described, check_films, check_step, plans
from reslrb_cli.optimization.optimizers import SMALL_HEIGHTMAP
from reslrb_cli.optimization.problem import Problem, make_optimizer, make_regularizers
from reslrb_cli.optimization.state import begin_as, decide_as, reach_as
from reslrb_cli.optimization.targets import make_targets
from reslrb_cli.optimization.views import expose, make_views, response_costs
from reslrb_cli.records.decisions import DecisionCache
from reslrb_cli.records.tree import Stored
from reslrb_cli.scene.deformation import where_moved
from reslrb_cli.scene.dispersion import bends_light
from reslrb_cli.scene.parameters import put_values, select_parameters, untied
from reslrb_cli.scene.parameters import set_values as set_scene_values

#: Parameters of emission; parameters of the same quantity have the same unit.
_EMITTED = {
    "AreaLight": "radiance",
    "ConstantBackgroundEmitter": "radiance",
    "DirectionalArea": "radiance",
    "EnvironmentMapEmitter": "radiance",
    "PointLight": "intensity",
    "SpotLight": "intensity",
    "DirectionalEmitter": "irradiance",
    "Projector": "irradiance",
}


def quantity(params: Any, key: str) -> str:
    """Return the quantity of a `mi.traverse` entry: `radiance`, `irradiance`, `intensity`, `length`, or "" without a
    unit.

    Parameters of BSDFs, mesh attributes, and factors (`scale`, a spot's `texture`) have no unit. A glass with
    dispersion has the quantities `nd`, `Vd`, `B` and `C`: V_d is far larger than n_d, so their errors cannot be
    combined.
    """
    if key.endswith((".vertex_positions", ".position")):
        return "length"
    if bends_light(params, key):
        return key.rpartition(".")[2].rstrip("123456789")
    node = own = params.properties[key][2]
    while node is not None and not isinstance(node, mi.Emitter):
        node = params.hierarchy[node][0]
    is_factor = own is node and not key.endswith(".data") and key != "data"
    if node is None or is_factor or ".texture." in f".{key}":
        return ""
    return _EMITTED.get(node.class_name(), "")


def assemble(
    config: Config,
    say: Callable[[str], None] = lambda line: None,
    cache: DecisionCache | None = None,
    to_run: bool = False,
    settled: Stored | None = None,
    keys: Iterable[str] = (),
) -> Problem:
    """Load and check the experiment of `config`, make the targets, and decide open settings. A variant must be set.

    All checks happen before anything is rendered. `say` is called with lines about slow work. `cache` has measurements
    of earlier runs, or is None to store nothing. If `to_run` is True, prepare everything for an optimisation. If
    `to_run` is True, check exposures, and find the parameter entries that light and sensor reach. `keys` are further
    parameters whose values will change. With `settled`,
    measure nothing again. With `settled`, the result is a resumed run's problem before the first iteration. Raises
    ConfigError and UnsupportedScene.
    """
    if to_run:
        check_code(config)
    problem = assemble_scene(config, keys=keys)
    if isinstance(problem.integrator, OwnIntegrator):
        problem.integrator.ready()
    if settled is not None:
        begin_as(problem, settled)
    check_step(problem)
    problem = make_targets(problem, say)
    for view in problem.views if to_run else ():
        for own in view.codes:
            own.attempt(view.target, view.weights)
    if settled is not None:
        return reach_as(decide_as(problem, settled), settled)
    problem = decide(problem, say, None if config.own_scene is not None else cache)  # the cache compares files
    if to_run:
        check_exposures(problem)
        problem = find_reached(problem)
    return problem


def load_for_rendering(
    config: Config, initial: bool, values: Mapping[str, Any] | None = None, source: str = "values"
) -> tuple[Any, list[int], Any, int | None]:
    """Load the scene and make the integrator. With `initial`, the parameters get their initial values, otherwise the
    scene is as in its file. Then the given `values` are set. `source` locates errors of these values.

    Returns the scene, the indices of the used sensors, the integrator, and its `samples_per_pass`.
    """
    values = values or {}
    if initial:
        problem = assemble_scene(config, keys=values)
        for key in values:
            if key in problem.selection.factors:
                raise ConfigError(source, key, "is the exposure; multiply the image by it instead")
        if values:
            problem = set_values(problem, values, source)
        return problem.scene, problem.sensors, problem.integrator, samples_per_pass(config)
    scene = load_configured(config, selects=False, keys=values)
    if values:
        set_scene_values(scene, (), _arrays(values, source), source, "")
    sensors = choose_sensors(config, scene)
    check_integrator(config, config.integrator, scene, sensors)
    integrator = make_configured(config, config.integrator, paths_of(config.integrator, scene, sensors), scene)
    return scene, sensors, integrator, samples_per_pass(config)


def check_passes(source: str, spp: int, multiple: int | None) -> None:
    """Raise ConfigError if passes of `multiple` samples do not divide `spp`. `source` locates the error."""
    if spp < 1:
        raise ConfigError(source, "", f"is {spp}; it must be at least 1")
    if multiple is not None and spp % min(multiple, spp):
        raise ConfigError(source, "", f"{spp} is not a multiple of integrator.samples_per_pass, {multiple}")


def set_values(problem: Problem, values: Mapping[str, Any], source: str = "values") -> Problem:
    """Return the problem before its first iteration, with the given values of parameters of the problem or of the
    scene, by key or glob.

    A value is a number, a list with one number for each channel, an array of the parameter's shape, or `{"file":
    IMAGE}`. Raises ConfigError with `source` and the key as location.
    """
    given = put_values(problem.selection, _arrays(values, source), source)
    return replace(problem, selection=untied(problem.selection, given)).afresh(problem.values())


def _arrays(values: Mapping[str, Any], source: str) -> dict[str, Any]:
    """Return each value as an array, or as an image file. Raises ConfigError."""
    found: dict[str, Any] = {}
    for key, value in values.items():
        try:
            if isinstance(value, Mapping):
                found[key] = ImageFile.model_validate(dict(value))
            else:
                found[key] = np.asarray(value, np.float32)
        except (TypeError, ValueError):  # pydantic raises a ValueError
            raise ConfigError(source, key, "must be a number, a list of numbers, or {file: IMAGE}") from None
    return found


def assemble_scene(config: Config, scene: Any = None, keys: Iterable[str] = ()) -> Problem:
    """Load and check the experiment of `config` without its targets.

    `scene` replaces `scene.file`. `keys` are further parameters whose values will change.
    """
    if scene is None:
        scene = load_configured(config, functools.partial(check_described, config), keys=keys)
    views = make_views(config, scene)
    check_films(config, scene, [view.sensor for view in views])
    sensors = [view.sensor for view in views]
    selection = select_parameters(scene, config.parameters, config.source)
    moves = what_moves(config, selection)
    check_integrator(config, config.integrator, scene, sensors, moves)
    paths = paths_of(config.integrator, scene, sensors, moves)
    expose(views, scene, selection)
    motions = selection.deformation.quantities
    problem = Problem(
        config=config,
        scene=scene,
        views=views,
        selection=selection,
        integrator=make_configured(config, config.integrator, paths, scene),
        paths=paths,
        moves=moves,
        optimizer=make_optimizer(config, selection),
        samples_per_pass=samples_per_pass(config),
        regularizers=make_regularizers(selection) | response_costs(views),
        quantities={
            key: ""
            if key in selection.factors or key in selection.tints
            else motions.get(key) or quantity(selection.params, key)
            for key in selection.keys
        },
    )
    if isinstance(problem.integrator, LightTracer):
        problem.integrator.expect(pass_spp(config))
    problem.apply()
    if config.optimizer.type == "auto":
        _check_steps(problem)
    _check_moving(problem)
    return problem


def _check_steps(problem: Problem) -> None:
    """Raise ConfigError if `auto` has no steps for a parameter."""
    selection = problem.selection
    for key in selection.keys:
        if key in problem.optimizer.extents and not problem.optimizer.is_small(key):
            lacks = f"a heightmap of more than {SMALL_HEIGHTMAP} texels"
        elif bends_light(selection.params, key):
            lacks = "the refraction of a glass"
        elif key.endswith((".vertex_positions", ".position")):
            lacks = "places outside of a motion"
        else:
            lacks = ""
        if lacks:
            reason = f"auto has no steps for {lacks}, such as `{key}`; use adam, with a learning_rate and a schedule"
            raise ConfigError(problem.config.source, "optimizer.type", reason)


def _check_moving(problem: Problem) -> None:
    """Raise ConfigError at the faulty setting if the integrator cannot differentiate a moving parameter."""
    if not problem.moves:
        return
    config, moved = problem.config, where_moved(problem.selection.params, problem.selection.scene_keys)
    kind, tracer = config.integrator.type, problem.integrator
    if moved and kind in ("prb", "trajectory"):
        reason = f"{kind} has no derivatives of moving light, which `{moved[0].key}` needs; use reslrb, ptracer or "
        reason += "prb_projective"
        raise ConfigError(config.source, "integrator.type", reason)
    if isinstance(tracer, Projective):
        sensors = [problem.scene.sensors()[index] for index in problem.sensors]
        wrong = tracer.obstacle(problem.scene, sensors, [item.node for item in moved])
        if wrong is not None:
            raise ConfigError(config.source, "integrator.type", wrong)
        return
    if isinstance(tracer, LightTracer):
        try:
            plans(problem, tracer)
        except UnsupportedScene as error:
            key = f"integrator.{error.option}" if error.option else "scene.file"
            raise ConfigError(config.source, key, str(error)) from error
        return
    for index in problem.sensors:  # splats of Mitsuba's own light tracer have no derivative through a box filter
        sensor = problem.scene.sensors()[index]
        if sensor.film().rfilter().is_box_filter():
            reason = f"sensor {sensor.id()} has a box filter, whose splats do not change while they move within a "
            reason += "pixel; use a smooth filter, such as gaussian, for derivatives of moving light"
            raise ConfigError(config.source, "scene.file", reason)
