"""Which parameters of a scene are being differentiated, and what that asks of a walk."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from reslrb_cli.errors import UnsupportedScene
from reslrb_cli.scene.catalog import parameter_kind

#: Where a parameter of a BSDF is this small, paths are followed and chosen in spite of it.
NEARLY_ZERO = 1e-2
#: What is a factor of a BSDF's value, where a roughness, say, is none.
FACTORS = ("reflectance", "transmittance", "base_color", "opacity", "weight")


@dataclass(frozen=True)
class Differentiated:
    """What tracks derivatives.

    `bsdf_nodes` are the nodes of BSDFs that have such parameters: textures, nested BSDFs, and meshes whose attributes
    textures read. `emission` says whether emission does, `zeros` whether any of the parameters is zero, or, of
    those of BSDFs, nearly so.
    """

    bsdf_nodes: tuple[Any, ...]
    emission: bool
    zeros: bool


def differentiated(params: Any) -> Differentiated:
    """Look through `mi.SceneParameters` for parameters with derivatives enabled.

    Raises UnsupportedScene where one of them moves the geometry or the sensor: detached light tracing has no derivative
    for that, and would silently leave it at zero.
    """
    nodes: dict[Any, None] = {}
    emission = zeros = False
    with dr.resume_grad():  # where gradients are suspended, nothing says that it tracks them
        enabled = {key: value for key, value in params.items() if dr.grad_enabled(value)}
    for key, value in enabled.items():
        kind = parameter_kind(params, key)
        if kind in ("bsdf", "attribute"):
            nodes[params.properties[key][2]] = None
        elif kind == "emitter":
            emission = True
        else:
            raise UnsupportedScene(
                f"{key}: detached light tracing has derivatives of BSDFs and emission only, not of what moves the "
                "geometry or the sensor"
            )
        dims = kind == "attribute" or (kind == "bsdf" and any(name in key for name in FACTORS))
        zeros = zeros or _has_singular(key, value, NEARLY_ZERO if dims else 0)
    return Differentiated(tuple(nodes), emission, zeros)


def _has_singular(key: str, value: Any, least: float) -> bool:
    """Whether a factor of this parameter is `least` or less somewhere: near 0, or at 1 where 1 - x is a factor too."""
    flat = dr.detach(value.array if dr.is_tensor_v(value) else dr.ravel(value))
    singular = flat <= least
    if {"opacity", "weight"} & set(key.split(".")):
        singular |= flat == 1
    return bool(dr.any(singular))
