"""Checks of experiments whose parameters move light: located where an integrator, or the scene, cannot follow them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mitsuba as mi

from reslrb_cli.config import Reslrb
from reslrb_cli.errors import ConfigError, UnsupportedScene
from reslrb_cli.integrators import Reslrb as Tracer
from reslrb_cli.integrators.tracer import LightTracer
from reslrb_cli.scene.movable import where_moved

if TYPE_CHECKING:
    from reslrb_cli.optimization.problem import Problem

#: The estimator of those that `auto` chooses from that has derivatives of what moves light.
ATTACHED = "stack"


def is_attached(problem: Problem) -> bool:
    """Whether the parameters of `problem` move anything that light leaves from or meets, or are to be taken so."""
    attached = problem.config.integrator.options().get("attached", "auto")
    return attached is True or bool(where_moved(problem.selection.params, problem.selection.scene_keys))


def check_moving(problem: Problem) -> None:
    """Raise ConfigError, located, where the integrator cannot differentiate what moves."""
    config, params = problem.config, problem.selection.params
    moved = where_moved(params, problem.selection.scene_keys)
    if not is_attached(problem):
        return
    kind = config.integrator.type
    if moved and kind in ("prb", "trajectory"):
        raise ConfigError(
            config.source,
            "integrator.type",
            f"{kind} has no derivatives of what moves light, as `{moved[0].key}` does; take reslrb or ptracer",
        )
    tracer = problem.integrator
    if isinstance(config.integrator, Reslrb) and config.integrator.estimator == "auto":
        tracer = Tracer.of(**config.integrator.chosen(estimator=ATTACHED).options())
    for index in problem.sensors:
        sensor = problem.scene.sensors()[index]
        if not isinstance(tracer, LightTracer):
            _check_filter(problem, sensor)
            continue
        try:
            tracer.plan(problem.scene, sensor, params)
        except UnsupportedScene as error:
            key = f"integrator.{error.option}" if error.option else "scene.file"
            raise ConfigError(config.source, key, str(error)) from error


def _check_filter(problem: Problem, sensor: mi.Sensor) -> None:
    """The same for Mitsuba's own light tracer, whose splats have no derivative through a box filter either."""
    if sensor.film().rfilter().is_box_filter():
        raise ConfigError(
            problem.config.source,
            "scene.file",
            f"sensor {sensor.id()} has a box filter, whose splats do not change while they move inside of a pixel; "
            "take a smooth one, such as gaussian, for derivatives of what moves light",
        )
