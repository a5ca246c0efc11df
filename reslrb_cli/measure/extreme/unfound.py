"""Lamps that no sample finds, or one in a thousand: smaller than a pixel in view, and with black texels."""

from __future__ import annotations

import numpy as np

from reslrb_cli.measure.analytic_lamps import RADIANCE, speck_in_view, texels_over_plane
from reslrb_cli.measure.analytic_scenes import KnownScene
from reslrb_cli.measure.extreme.case import Exact, ExtremeCase

PLANE = "plane.bsdf.reflectance.value"


def speck() -> KnownScene:
    """A lamp of a thousandth of a pixel, and bright enough to make that a grey one."""
    return speck_in_view(side=0.0037, radiance=(300, 200, 400))


def spots() -> KnownScene:
    """Three bright texels of sixteen, all others black."""
    texels = np.zeros((4, 4, 3))
    texels[0, 0], texels[1, 2], texels[2, 2] = (9, 8, 7), (3, 4, 5), (30, 20, 10)
    return texels_over_plane(texels)


def black() -> KnownScene:
    """No texel that is not black."""
    return texels_over_plane(np.zeros((2, 2, 3)))


CASES = [
    ExtremeCase("lamp_of_a_thousandth_of_a_pixel", "a lamp in view that one primary ray in a thousand hits",
                lambda: speck().scene(), (f"{RADIANCE}.value",), Exact(speck), image="ptracer",
                options={"max_depth": 1}),
    ExtremeCase("black_texels", "a lamp with texels that are black, and drawn in proportion to their radiance: never",
                lambda: spots().scene(), (PLANE, f"{RADIANCE}.data"), Exact(spots), spp=256, options={"max_depth": 2}),
    ExtremeCase("black_lamp", "a lamp with nothing but black texels: there is no density in proportion to them",
                lambda: black().scene(), (PLANE, f"{RADIANCE}.data"), Exact(black), spp=256, options={"max_depth": 2},
                open_ended={PLANE: "there is no light that it could reflect"}),
]  # fmt: skip
