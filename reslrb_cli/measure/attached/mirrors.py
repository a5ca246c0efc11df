"""Light by way of mirrors onto a receiver: what reflects it is displaced, and rough."""

from __future__ import annotations

from reslrb_cli.measure.attached.amplitudes import Number, Pose
from reslrb_cli.measure.attached.glass import setting, spot, waving
from reslrb_cli.measure.attached.meshes import grid, mesh, waves
from reslrb_cli.measure.attached.scene import AttachedScene
from reslrb_cli.measure.small_scenes import rgb

MIRROR = {"type": "conductor", "material": "none", "specular_reflectance": rgb(0.9, 0.8, 0.7)}
#: Its samples do not depend on the incident direction: those of visible normals have derivatives of heavy tails.
BRUSHED = {"type": "roughconductor", "material": "none", "alpha": 0.1, "sample_visible": False}


def ceiling(bsdf: dict = MIRROR) -> dict:
    """A mirror with waves that faces down, lit from below."""
    positions, faces, uv = grid(64, lambda x, z: 1.9 + waves(x, z))
    return setting(lamp=spot(origin=(0.03, 0.6, -0.02), target=(0, 1.9, 0)),
                   mirror=mesh(positions, faces[:, ::-1], bsdf, uv))  # fmt: skip


def convex(bsdf: dict = MIRROR) -> dict:
    """A mirror that is a ball, lit from below by a cone that it contains."""
    return setting(lamp=spot(origin=(0.03, 0.6, -0.02), target=(0, 2, 0), cutoff=9),
                   mirror={"type": "sphere", "center": [0, 2.1, 0], "radius": 0.6, "bsdf": bsdf})  # fmt: skip


SCENES = [
    AttachedScene("mirror", "a mirror with waves", ceiling, lambda scene: waving(scene, "mirror", 1.9), step=0.002),
    AttachedScene("mirror_ball", "a mirror that is a ball, moved and scaled", convex,
                  lambda scene: [Pose("mirror.to_world", ("tx", "ty", "tz", "s"), (0, 2.1, 0))], spp=128),
    AttachedScene("rough_mirror", "a rough metal with waves", lambda: ceiling(BRUSHED),
                  lambda scene: waving(scene, "mirror", 1.9), step=0.003, options={"max_depth": 3}),
    AttachedScene("rough_mirror_alpha", "the roughness of a metal",
                  lambda: ceiling(BRUSHED | {"sample_visible": True}),
                  lambda scene: [Number("mirror.bsdf.alpha.value")], spp=256,
                  options={"max_depth": 3, "attached": True}),
]  # fmt: skip
