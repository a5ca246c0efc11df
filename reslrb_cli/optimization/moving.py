"""Checks of experiments whose parameters move light."""

from __future__ import annotations

from reslrb_cli.config.schema import Config
from reslrb_cli.errors import ConfigError, UnsupportedScene
from reslrb_cli.integrators.baselines import Projective
from reslrb_cli.integrators.reslrb import LightTracer
from reslrb_cli.optimization.memory import plans
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.scene.deformation import where_moved
from reslrb_cli.scene.parameters import Selection


def is_attached(problem: Problem) -> bool:
    """True if the parameters of `problem` move surfaces or lights, or if the integrator option `attached` is true."""
    return moves_anything(problem.config, problem.selection)


def moves_anything(config: Config, selection: Selection) -> bool:
    """True if the selected parameters move surfaces or lights, or if the integrator option `attached` is true."""
    attached = config.integrator.options().get("attached", "auto")
    return attached is True or bool(where_moved(selection.params, selection.scene_keys))


def check_moving(problem: Problem) -> None:
    """Raise ConfigError at the faulty setting if the integrator cannot differentiate a moving parameter."""
    if not is_attached(problem):
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
