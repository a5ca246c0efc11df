"""Where a scene stands and how large it is, as far as single precision cares."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

#: The largest ray offset, as a fraction of the scene's size, with which no loss of light is to be seen: that of a room
#: of size 3 that stands about 150 from the origin, or measures a fiftieth across.
LARGEST_OFFSET = 5e-3


def lost_light(scene: Any) -> str | None:
    """What is wrong with a scene that is far from the origin, or tiny, and what to do; None where nothing is.

    Mitsuba starts rays off their surface by RayEpsilon (1 + max |p|), in the scene's units, so that they jump over what
    is nearer: light is lost in corners, in all integrators.
    """
    box = scene.bbox()
    low, high = np.array(box.min, float), np.array(box.max, float)
    size = float(np.linalg.norm(high - low))
    reach = float(np.maximum(np.abs(low), np.abs(high)).max())
    offset = mi.math.RayEpsilon * (1 + reach)
    if not np.isfinite(size) or offset <= LARGEST_OFFSET * size:
        return None
    centre = float(np.linalg.norm((low + high) / 2))
    if centre > size:
        place, advice = f"stands {centre:.3g} from the origin and measures {size:.3g} across", "move it to the origin"
    else:
        place, advice = f"measures {size:.3g} across", "scale it to about 1"
    return f"the scene {place}: Mitsuba starts rays {offset:.2g} off surfaces there, and light is lost; {advice}"
