"""Which parameters of a scene are being differentiated, and what that asks of a walk."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from reslrb_cli.errors import UnsupportedScene
from reslrb_cli.scene.catalog import parameter_kind
from reslrb_cli.scene.motion import BEAMS, PLACES, moving_emitter_obstacle, moving_shape_obstacle

#: Where a parameter of a BSDF is this small, paths are followed and chosen in spite of it.
NEARLY_ZERO = 1e-2
#: What is a factor of a BSDF's value, where a roughness, say, is none.
FACTORS = ("reflectance", "transmittance", "base_color", "opacity", "weight")


@dataclass(frozen=True)
class Differentiated:
    """What tracks derivatives.

    `bsdf_nodes` are the nodes of BSDFs that have such parameters: textures, nested BSDFs, and meshes whose attributes
    textures read. `emission_nodes` are those of what emitters emit: emitters, and their textures. `zeros` says whether
    any of the parameters is zero, or, of those of BSDFs, nearly so. `shapes` are those that move, `emitters` those
    whose rays do.
    """

    bsdf_nodes: tuple[mi.Object, ...]
    emission_nodes: tuple[mi.Object, ...]
    zeros: bool
    shapes: tuple[mi.Shape, ...]
    emitters: tuple[mi.Emitter, ...]

    @property
    def emission(self) -> bool:
        """Whether what any emitter emits does."""
        return bool(self.emission_nodes)

    @property
    def moves(self) -> bool:
        """Whether anything moves that light leaves from or meets."""
        return bool(self.shapes or self.emitters)


def differentiated(params: mi.SceneParameters) -> Differentiated:
    """Look through a scene's parameters for those with derivatives enabled.

    Raises UnsupportedScene, with the reason, for one that light tracing has no derivative for, and would silently leave
    at zero.
    """
    nodes: dict[mi.Object, None] = {}
    emitting: dict[mi.Object, None] = {}
    shapes: dict[mi.Shape, None] = {}
    emitters: dict[mi.Emitter, None] = {}
    zeros = False
    with dr.resume_grad():  # where gradients are suspended, nothing says that it tracks them
        enabled = {key: value for key, value in params.items() if dr.grad_enabled(value)}
    for key, value in enabled.items():
        kind, node = parameter_kind(params, key), params.properties[key][2]
        if kind in ("bsdf", "attribute"):
            nodes[node] = None
        elif kind == "shape":
            _refuse(key, moving_shape_obstacle(node, key))
            shapes[node] = None
            if node.is_emitter():
                emitters[node.emitter()] = None
        elif kind == "emitter" and key.rpartition(".")[2] in (*PLACES, *BEAMS):
            _refuse(key, moving_emitter_obstacle(node, key))
            emitters[node] = None
            continue  # no factor of a path
        elif kind == "emitter":
            emitting[node] = None
        else:
            _refuse(key, "light tracing has derivatives of what light meets and leaves from, not of the sensor")
        dims = kind == "attribute" or (kind == "bsdf" and any(name in key for name in FACTORS))
        if kind != "shape":
            zeros = zeros or _has_singular(key, value, NEARLY_ZERO if dims else 0)
    return Differentiated(tuple(nodes), tuple(emitting), zeros, tuple(shapes), tuple(emitters))


def _refuse(key: str, reason: str | None) -> None:
    if reason is not None:
        raise UnsupportedScene(f"{key}: {reason}")


def _has_singular(key: str, value: dr.ArrayBase, least: float) -> bool:
    """Whether a factor of this parameter is `least` or less somewhere: near 0, or at 1 where 1 - x is a factor too."""
    flat = dr.detach(value.array if dr.is_tensor_v(value) else dr.ravel(value))
    singular = flat <= least
    if {"opacity", "weight"} & set(key.split(".")):
        singular |= flat == 1
    return bool(dr.any(singular))
