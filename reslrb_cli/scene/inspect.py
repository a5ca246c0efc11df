"""What a scene contains, for `reslrb inspect`; printing is up to the caller."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mitsuba as mi

from .catalog import ParameterInfo, list_parameters
from .graph import SceneGraph
from .movable import Movable, heightmap_obstacle, list_movable
from .needs import SceneNeeds, View, camera_obstacle, light_obstacle, look, scene_needs, unsupported_part


@dataclass(frozen=True)
class SensorSummary:
    """One sensor: its film in pixels (`crop` is offset and size), what it sees, and what light tracing needs for it.

    `obstacle` is the reason why light tracing cannot render for it, or None, and `camera_obstacle` the same of paths
    from the sensor (`prb`). `view` is None where the reason lies
    in the scene's parts and not in what the sensor sees.
    """

    index: int
    id: str
    type: str
    film: str
    size: tuple[int, int]
    crop: tuple[tuple[int, int], tuple[int, int]]
    filter: str
    channels: int
    needs: SceneNeeds
    view: View | None
    obstacle: str | None
    camera_obstacle: str | None


@dataclass(frozen=True)
class MovableSummary:
    """A shape or an emitter by its id, and what can move it: `motion`, `heightmap`."""

    id: str
    by: list[str]


@dataclass(frozen=True)
class SceneSummary:
    """What a scene contains: class names and how often each occurs, sensors, all parameters, and what can be moved."""

    emitters: dict[str, int]
    bsdfs: dict[str, int]
    shapes: dict[str, int]
    triangles: int
    sensors: list[SensorSummary]
    parameters: list[ParameterInfo]
    movable: list[MovableSummary]


def summarise(scene: Any, hide_emitters: bool = False, sensors: Sequence[int] | None = None) -> SceneSummary:
    """Look `scene` over; `sensors` are the indices of those to describe, None for all."""
    graph = SceneGraph.of(scene)
    shapes = graph.shapes()
    indices = range(len(scene.sensors())) if sensors is None else sensors
    params = mi.traverse(scene)
    return SceneSummary(
        emitters=_count(scene.emitters()),
        bsdfs=_count(graph.of_type(mi.BSDF)),
        shapes=_count(shapes),
        triangles=sum(int(shape.face_count()) for shape in shapes if shape.is_mesh()),
        sensors=[_sensor(scene, index, hide_emitters) for index in indices],
        parameters=list_parameters(params, values=True),
        movable=[MovableSummary(item.id, _moved_by(item)) for item in list_movable(params)],
    )


def _moved_by(item: Movable) -> list[str]:
    return ["motion"] if heightmap_obstacle(item) else ["motion", "heightmap"]


def _count(objects: Sequence[Any]) -> dict[str, int]:
    return dict(Counter(item.class_name() for item in objects).most_common())


def _sensor(scene: Any, index: int, hide_emitters: bool) -> SensorSummary:
    sensor = scene.sensors()[index]
    film = sensor.film()
    return SensorSummary(
        index=index,
        id=sensor.id(),
        type=sensor.class_name(),
        film=film.class_name(),
        size=_pair(film.size()),
        crop=(_pair(film.crop_offset()), _pair(film.crop_size())),
        filter=film.rfilter().class_name(),
        channels=int(film.base_channels_count()),
        needs=scene_needs(scene, sensor),
        view=look(scene, sensor) if unsupported_part(scene, sensor) is None else None,
        obstacle=light_obstacle(scene, sensor, hide_emitters),
        camera_obstacle=camera_obstacle(scene, sensor),
    )


def _pair(values: Any) -> tuple[int, int]:
    return int(values[0]), int(values[1])
