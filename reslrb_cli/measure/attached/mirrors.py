"""Light by way of mirrors onto a receiver: what reflects it is displaced, and rough."""

from __future__ import annotations

from reslrb_cli.measure.attached.amplitudes import Number, Pose
from reslrb_cli.measure.attached.glass import bent, setting, spot, waving
from reslrb_cli.measure.attached.meshes import ball, grid, mesh, waves
from reslrb_cli.measure.attached.scene import AttachedScene
from reslrb_cli.measure.small_scenes import diffuse, rgb, transform

MIRROR = {"type": "conductor", "material": "none", "specular_reflectance": rgb(0.9, 0.8, 0.7)}
BRUSHED = {"type": "roughconductor", "material": "none", "alpha": 0.2, "distribution": "ggx"}


def ceiling(bsdf: dict = MIRROR) -> dict:
    """A mirror with waves that faces down, lit from below."""
    positions, faces, uv = grid(64, lambda x, z: 1.9 + waves(x, z))
    return setting(lamp=spot(origin=(0.03, 0.6, -0.02), target=(0, 1.9, 0)),
                   mirror=mesh(positions, faces[:, ::-1], bsdf, uv))  # fmt: skip


def convex(bsdf: dict = MIRROR) -> dict:
    """A mirror that is a ball, lit from below by a cone that it contains."""
    return setting(lamp=spot(origin=(0.03, 0.6, -0.02), target=(0, 2, 0), cutoff=9),
                   mirror={"type": "sphere", "center": [0, 2.1, 0], "radius": 0.6, "bsdf": bsdf})  # fmt: skip


def two_mirrors() -> dict:
    """The ceiling over a ball that faces it: what the one sends down the other sends up again, and so on."""
    scene = ceiling()
    scene["lamp"] = spot(origin=(0, 0.9, 0), target=(0.25, 1.9, 0), cutoff=6)
    scene["second"] = mesh(*ball(0.25, (0.62, 0.75, 0.0), 4), BRUSHED)
    scene["floor"] = {"type": "rectangle", "to_world": transform(rotate=([1, 0, 0], -90), scale=50),
                      "bsdf": diffuse(0.8, 0.7, 0.6)}  # fmt: skip
    return scene


SCENES = [
    AttachedScene("mirror", "a mirror with waves", ceiling, lambda scene: waving(scene, "mirror", 1.9), step=0.002),
    AttachedScene("mirror_ball", "a mirror that is a ball, moved and scaled", convex,
                  lambda scene: [Pose("mirror.to_world", ("tx", "ty", "tz", "s"), (0, 2.1, 0))]),
    AttachedScene("rough_mirror", "a rough metal with waves", lambda: ceiling(BRUSHED),
                  lambda scene: waving(scene, "mirror", 1.9)),
    AttachedScene("rough_mirror_alpha", "the roughness of a metal", lambda: ceiling(BRUSHED),
                  lambda scene: [Number("mirror.bsdf.alpha.value")], options={"max_depth": 4, "attached": True}),
    AttachedScene("two_mirrors", "a mirror with waves, then a ball of rough metal that is bent", two_mirrors,
                  lambda scene: [*waving(scene, "mirror", 1.9), *bent(scene, "second", 4, 0.3)],
                  options={"max_depth": 4}),
]  # fmt: skip
