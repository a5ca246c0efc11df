"""Pixels that are left out of a view's loss, each kind counted, and what the others weigh."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import mitsuba as mi
import numpy as np

from reslrb_cli.config import Config, Mask
from reslrb_cli.errors import ConfigError
from reslrb_cli.optimization.loading import LIGHT_TRACERS, are_upright
from reslrb_cli.scene import Photo, read_weights
from reslrb_cli.scene.seen import interior, sees_specular

Array = np.ndarray[Any, Any]

#: What pixels of each kind are said to do.
WORDS = {
    "specular": "see smooth glass or mirrors",
    "mixed": "see coats, blends or thin panes",
    "border": "lie at the film's border",
    "clipped": "are clipped",
    "alpha": "have alpha 0",
    "nonfinite": "are not finite",
    "file": "have weight 0 in the mask's file",
}


@dataclass
class Masked:
    """The pixels of one view, boolean (H, W) by kind, that `left_out` leaves out; a pixel may be of several kinds.

    `weights` (H, W) are what the file gives, None without one; `stay` are the pixels of a kind that was only counted.
    """

    left_out: dict[str, Array] = field(default_factory=dict)
    stay: dict[str, int] = field(default_factory=dict)
    weights: Array | None = None

    def total(self, shape: tuple[int, int]) -> Array:
        """What each pixel weighs, float32 (H, W): 0 where it is left out, and 1 elsewhere without a file."""
        total = np.ones(shape, np.float32) if self.weights is None else self.weights.astype(np.float32)
        for pixels in self.left_out.values():
            total = np.where(pixels, np.float32(0), total)
        return total

    def counts(self) -> dict[str, int]:
        """How many pixels each kind leaves out, of those that leave out any."""
        return {kind: count for kind, pixels in self.left_out.items() if (count := int(pixels.sum()))}


def mask_of(config: Config, mask: Mask, mixed: bool, key: str, scene: mi.Scene, sensor: int, photo: Photo | None
            ) -> Masked:  # fmt: skip
    """Find the pixels of the view through `sensor` that `mask` leaves out; `key` is where it stands in `config`.

    `photo` is the target's file, None of a rendered one. Raises ConfigError where the file of weights is wrong.
    """
    film = scene.sensors()[sensor].film()
    width, height = (int(n) for n in film.crop_size())
    found = Masked()
    if _lacks_light(config, photo is None):
        if mask.specular or mixed:
            seen = sees_specular(scene, scene.sensors()[sensor])
            if mask.specular:
                found.left_out["specular"] = seen.alone
            if mixed:
                found.left_out["mixed"] = seen.mixed
            elif (count := int(seen.mixed.sum())) > 0:
                found.stay["mixed"] = count
        if mask.border:
            found.left_out["border"] = ~interior((height, width), scene.sensors()[sensor])
    if photo is not None:
        kinds = {"clipped": photo.clipped, "alpha": photo.transparent, "nonfinite": photo.nonfinite}
        found.left_out |= {kind: pixels for kind, pixels in kinds.items() if getattr(mask, kind)}
    if mask.file is not None:
        try:
            found.weights = read_weights(mask.file, (width, height), are_upright(config))
        except ConfigError as error:
            raise ConfigError(config.source, f"{key}.file", error.message) from None
        found.left_out["file"] = found.weights == 0
    return found


def mask_line(name: str, masked: Masked, weights: Array) -> str | None:
    """What the user is told of a view's mask, None where nothing is left out, weighed or counted."""
    counts = masked.counts()
    stay = [f"{count} {WORDS[kind]} and stay (mask_mixed: true leaves them out)" for kind, count in masked.stay.items()]
    if not counts and not stay and masked.weights is None:
        return None
    left, total = int((weights == 0).sum()), weights.size
    parts = [f"{count} {WORDS[kind]}" for kind, count in counts.items()]
    line = f"{name}: {left} of {total} pixels ({left / total:.1%}) are left out"
    return "; ".join([line + (f": {', '.join(parts)}" if parts else ""), *stay])


def _lacks_light(config: Config, rendered: bool) -> bool:
    """Whether target and image differ by what light tracing lacks: one of the two is light traced, the other is not.

    A photograph has all light.
    """
    render = config.target.render
    maker = (render.integrator or config.integrator).type if rendered and render is not None else "camera"
    return (maker in LIGHT_TRACERS) != (config.integrator.type in LIGHT_TRACERS)
