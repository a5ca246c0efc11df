"""Rays as the emitters of a scene send them out, where Mitsuba can sample them."""

from __future__ import annotations

import mitsuba as mi

from ..errors import UnsupportedScene


def emitted_rays(
    scene: mi.Scene, wavelength: mi.Float, place: mi.Point2f, direction: mi.Point2f
) -> tuple[mi.Ray3f, mi.Spectrum]:
    """Rays from all emitters, and their weights, of random numbers in [0, 1).

    Raises UnsupportedScene, which names it, where there is an emitter that Mitsuba cannot sample, such as a lamp or a
    spot with a checkerboard.
    """
    try:
        ray, weight, _ = scene.sample_emitter_ray(0, wavelength, place, direction, True)
    except RuntimeError as error:
        if "not implemented" not in str(error):
            raise
        names = ", ".join(emitter.id() for emitter in scene.emitters() if not _can_be_sampled(emitter))
        reason = " ".join(str(error).split())
        raise UnsupportedScene(
            f"Mitsuba cannot sample the rays of emitter {names}: {reason}; give it a `bitmap`"
        ) from None
    return ray, weight


def _can_be_sampled(emitter: mi.Emitter) -> bool:
    try:
        emitter.sample_ray(0, 0.5, mi.Point2f(0.5), mi.Point2f(0.5), True)
    except RuntimeError:
        return False
    return True
