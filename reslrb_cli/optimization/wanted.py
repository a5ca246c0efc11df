"""What an experiment says of its views, in `views` or in the short forms, `scene.sensors` and `target`."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import mitsuba as mi

from reslrb_cli.config import Config, Loss, Mask
from reslrb_cli.errors import ConfigError
from reslrb_cli.optimization.exposure import SHARED
from reslrb_cli.optimization.loading import choose_sensors
from reslrb_cli.scene.cameras import read_cameras


@dataclass(frozen=True)
class Wanted:
    """What an experiment says of the view through `sensor`: its target's file, None of a rendered one, and its mask.

    `file_key` and `mask_key` are where they stand in the configuration. `exposure` is a number, or how it is recovered,
    by which key; `weight` is the view's part of the loss, relative to the others', and `loss` its own, if it has one.
    """

    sensor: int = 0
    file: Path | None = None
    file_key: str = "target.file"
    mask: Mask = field(default_factory=Mask)
    mask_mixed: bool = False
    mask_key: str = "target.mask"
    exposure: float | str = 1.0
    exposure_key: str = SHARED
    weight: float = 1.0
    loss: Loss | None = None
    held_out: bool = False


def wanted_views(config: Config, scene: mi.Scene) -> list[Wanted]:
    """What is wanted of every view. Raises ConfigError for a sensor that is not there, or cannot be held out."""
    sensors = choose_sensors(config, scene)
    wanted = _of_views(config) if config.views is not None else _of_sensors(config, sensors)
    if config.scene.cameras is not None and config.target.render is None:
        images = [camera.image for camera in read_cameras(config.scene.cameras)]
        wanted = [
            replace(one, file=images[one.sensor], file_key="scene.cameras") if one.file is None else one
            for one in wanted
        ]
    held_out = _held_out(config, scene, sensors)
    if held_out == set(sensors):
        raise ConfigError(config.source, "run.held_out", "leaves no view to train on")
    for one in wanted:
        if one.sensor in held_out and isinstance(one.exposure, str) and one.exposure_key != SHARED:
            raise ConfigError(
                config.source,
                "run.held_out",
                f"has sensor {one.sensor}, whose own exposure nothing else tells; give it a number, or all views one",
            )
    trained = len(wanted) - len(held_out)
    if (config.run.views_per_iteration or 1) > trained:
        raise ConfigError(
            config.source,
            "run.views_per_iteration",
            f"is {config.run.views_per_iteration}; views that are trained on: {trained}",
        )
    return [replace(one, held_out=one.sensor in held_out) for one in wanted]


def _held_out(config: Config, scene: mi.Scene, sensors: list[int]) -> set[int]:
    """The indices of the sensors that `run.held_out` names. Raises ConfigError for one that has no view."""
    names, found = {scene.sensors()[sensor].id(): sensor for sensor in sensors}, set()
    for place, given in enumerate(config.run.held_out):
        sensor = names.get(given, -1) if isinstance(given, str) else given
        if sensor not in sensors:
            raise ConfigError(config.source, f"run.held_out[{place}]", f"is {given}, which is the sensor of no view")
        found.add(sensor)
    return found


def _of_sensors(config: Config, sensors: list[int]) -> list[Wanted]:
    """What the short forms, `scene.sensors` and `target`, say of each view."""
    target = config.target
    files, exposures = target.file or [], target.exposure
    if isinstance(exposures, list) and len(exposures) != len(sensors):
        raise ConfigError(
            config.source,
            "target.exposure",
            f"must have one entry for each sensor; entries: {len(exposures)}, sensors: {len(sensors)}",
        )
    return [
        Wanted(
            sensor,
            file=files[number] if number < len(files) else None,
            file_key="target.file" if len(files) == 1 else f"target.file[{number}]",
            mask=target.mask,
            mask_mixed=target.mask_mixed,
            exposure=exposures[number] if isinstance(exposures, list) else exposures,
            exposure_key=f"{SHARED}.{sensor}" if isinstance(exposures, list) else SHARED,
        )
        for number, sensor in enumerate(sensors)
    ]


def _of_views(config: Config) -> list[Wanted]:
    """What `views` say of each view, and `target` of what they leave open."""
    assert config.views is not None
    assert not isinstance(config.target.exposure, list), "checked with the configuration"
    target, found = config.target, []
    for number, spec in enumerate(config.views):
        own = spec.exposure is not None
        found.append(
            Wanted(
                spec.sensor,
                file=spec.target,
                file_key=f"views[{number}].target",
                mask=target.mask if spec.mask is None else spec.mask,
                mask_mixed=target.mask_mixed if spec.mask_mixed is None else spec.mask_mixed,
                mask_key="target.mask" if spec.mask is None else f"views[{number}].mask",
                exposure=config.target.exposure if spec.exposure is None else spec.exposure,
                exposure_key=f"{SHARED}.{spec.sensor}" if own else SHARED,
                weight=spec.weight,
                loss=spec.loss,
            )
        )
    return found
