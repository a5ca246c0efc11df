"""Scenes that are recognised as one whose gradient is known in closed form."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from reslrb_cli.measure.analytic import furnace
from reslrb_cli.measure.references import Situation
from reslrb_cli.scene.catalog import parameter_kind


def known_gradient(at: Situation, sensor: mi.Sensor, key: str, weights: np.ndarray) -> np.ndarray | None:
    """Gradient of sum(image * weights), in a row, with respect to the parameter `key`; None where it is not known.

    Known is the furnace: a sphere around the sensor that emits and reflects diffusely, everywhere the same.
    `weights` are (H, W, C).
    """
    shapes, emitters = at.graph.shapes(), at.scene.emitters()
    if len(shapes) != 1 or len(emitters) != 1 or shapes[0].class_name() != "Sphere" or weights.shape[2] != 3:
        return None
    bsdf, emitter = mi.traverse(shapes[0].bsdf()), mi.traverse(emitters[0])
    uniform = "reflectance.value" in bsdf and shapes[0].bsdf().class_name() == "SmoothDiffuse" and (
        "radiance.value" in emitter and emitters[0].class_name() == "AreaLight"
    )  # fmt: skip
    if not uniform or at.hide_emitters or (at.view.smooth, at.view.emission) != (1, 1):
        return None
    if float(sensor.film().rfilter().radius()) > 0.5 or not _is_inside(shapes[0], sensor):
        return None
    rho, Le = (np.array(value).ravel() for value in (bsdf["reflectance.value"], emitter["radiance.value"]))
    if at.max_depth == -1 and np.any(rho >= 1):
        return None
    names = {"bsdf": "albedo", "emitter": "emission"}
    name = (
        names.get(parameter_kind(at.params, key)) if key.endswith((".reflectance.value", ".radiance.value")) else None
    )
    if name is None:
        return None
    gradient = furnace(rho, Le, at.max_depth, 1).derivatives[name][0, 0] * weights.sum((0, 1))
    return gradient if np.array(at.params[key]).size == 3 else np.array([gradient.sum()])


def _is_inside(sphere: mi.Shape, sensor: mi.Sensor) -> bool:
    box = sphere.bbox()
    centre, radius = np.array(box.center()).ravel(), np.array(box.extents()).min() / 2
    origin = np.array(mi.traverse(sensor)["to_world"].translation()).ravel()
    return bool(np.linalg.norm(origin - centre) < radius)
