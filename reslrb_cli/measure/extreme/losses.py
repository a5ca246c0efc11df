"""Losses whose derivative changes sign or is not finite, and sums over very many samples."""

from __future__ import annotations

from typing import Any

import numpy as np

from reslrb_cli.measure.analytic_scenes import furnace_scene
from reslrb_cli.measure.extreme.case import Exact, ExtremeCase, Stock
from reslrb_cli.measure.small_scenes import room

FLOOR = "floor.brdf_0.reflectance.value"
LAMP = "lamp.emitter.radiance.value"
FURNACE = ("walls.bsdf.reflectance.value", "walls.emitter.radiance.value")


def negative(weights: np.ndarray) -> np.ndarray:
    return -weights


def mixed(weights: np.ndarray) -> np.ndarray:
    """Of either sign, by channel and pixel, with a mean that is not zero."""
    return weights * np.random.default_rng(4).choice([-1.0, 1.0], weights.shape, p=[0.35, 0.65]).astype(np.float32)


def spoilt(value: float) -> Any:
    """`value` in one channel each of three pixels."""

    def spoil(weights: np.ndarray) -> np.ndarray:
        weights = weights.copy()
        for channel, (row, column) in enumerate(((5, 9), (8, 8), (11, 3))):
            weights[row, column, channel] = value
        return weights

    return spoil


def one_pixel() -> Any:
    """A furnace seen by a film of one pixel, so that all samples go into the same few sums."""
    return furnace_scene((0.5, 0.8, 0.9), (1, 2, 0.5), 2, 1)


def _sums(name: str, spp: int) -> ExtremeCase:
    return ExtremeCase(name, f"{spp:.0e} samples in one pixel, in single precision", lambda: one_pixel().scene(),
                       FURNACE, Exact(one_pixel), image="", spp=spp, seeds=1, options={"max_depth": 2}, naive=False,
                       equal=5e-3)  # fmt: skip


CASES = [
    ExtremeCase("negative_loss", "a loss with negative derivatives", room, (FLOOR, LAMP), Stock("ptracer"),
                weights=negative, signed=True),
    ExtremeCase("mixed_loss", "a loss with derivatives of either sign, by channel and pixel", room, (FLOOR, LAMP),
                Stock("ptracer"), weights=mixed, signed=True, spp=256),
    ExtremeCase("nan_loss", "NaN in the loss's derivative: refused and counted", room, (FLOOR, LAMP),
                Stock("ptracer"), weights=spoilt(np.nan)),
    ExtremeCase("infinite_loss", "infinity in the loss's derivative: refused and counted", room, (FLOOR, LAMP),
                Stock("ptracer"), weights=spoilt(-np.inf)),
    _sums("sums_1e7", 10**7),
    _sums("sums_1e8", 10**8),
]  # fmt: skip
