"""What an experiment works with: scene, sensors and integrator, loaded and checked."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mitsuba as mi

from reslrb_cli.config import Config, Integrator, Reslrb
from reslrb_cli.errors import ConfigError, UnsupportedScene
from reslrb_cli.integrators import StepIntegrator, make_integrator
from reslrb_cli.scene import check_camera_paths, check_supported, load_scene
from reslrb_cli.scene.description import Description

#: Types of integrators that trace from the light, and so cannot render every scene.
LIGHT_TRACERS = ("reslrb", "ptracer", "walk_ad", "trajectory")


def load_configured(config: Config, look: Callable[[Description], object] | None = None) -> mi.Scene:
    """Load the scene that `config` names; `look` sees its description before it is built. Raises ConfigError."""
    scene = config.scene
    return load_scene(scene.file, scene.options, scene.strict, scene.size, scene.cameras, look)


def choose_sensors(config: Config, scene: mi.Scene) -> list[int]:
    """Return the index of each view's sensor. Raises ConfigError for one that is not there."""
    count = len(scene.sensors())
    if config.views is not None:
        named = {f"views[{place}].sensor": view.sensor for place, view in enumerate(config.views)}
    elif config.scene.sensors == "all":
        return list(range(count))
    else:
        named = {f"scene.sensors[{place}]": sensor for place, sensor in enumerate(config.scene.sensors)}
    for key, sensor in named.items():
        if sensor >= count:
            has = "one sensor, index 0" if count == 1 else f"{count} sensors, indices 0 to {count - 1}"
            raise ConfigError(config.source, key, f"is {sensor}, but the scene has {has}")
    return list(named.values())


def check_integrator(config: Config, integrator: Integrator, scene: mi.Scene, sensors: list[int]) -> None:
    """Raise ConfigError, located in the scene's file, where `integrator` cannot render `scene` through `sensors`."""
    try:
        for sensor in sensors:
            if integrator.type in LIGHT_TRACERS:
                check_supported(scene, scene.sensors()[sensor], integrator.hide_emitters)
            else:
                check_camera_paths(scene, scene.sensors()[sensor])
    except UnsupportedScene as error:
        raise ConfigError(config.source, "scene.file", str(error)) from error


def make_configured(integrator: Integrator) -> StepIntegrator:
    """The integrator that a configuration describes; all estimators have the same image, so for `auto` any will do.

    What is not decided yet (`guiding`, `sequence`) is off.
    """
    if isinstance(integrator, Reslrb):
        auto = integrator.estimator == "auto"
        integrator = integrator.chosen(estimator="reservoir") if auto else integrator.undecided_off()
    options: dict[str, Any] = integrator.options()
    return make_integrator(integrator.type, **options)


def pass_spp(config: Config) -> int:
    """Samples per pixel of each pass of a step's gradient; where passes are chosen by `run.memory_budget`, at most."""
    call = config.run.spp // config.run.batches if config.adjoint == "batched" else config.run.spp
    return min(samples_per_pass(config) or call, call)


def samples_per_pass(config: Config) -> int | None:
    """The integrator's own bound on the samples of a pass."""
    value = config.integrator.options().get("samples_per_pass")
    return None if value is None else int(value)
