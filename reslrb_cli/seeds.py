"""The only place where a seed is made.

Every random number of a run descends from `run.seed` through `seed`, so a run can be repeated, and two uses share
random numbers only where they ask for the same (iteration, view, purpose).
"""

from __future__ import annotations

import hashlib


def seed(run_seed: int, iteration: int, view: int, purpose: str) -> int:
    """Return the seed of one use of random numbers, an integer in [0, 2**32).

    `iteration` and `view` say when and for which sensor the numbers are drawn (0 where that means nothing), `purpose`
    says what for (`"image"`, `"target"`, ...). The four are hashed together (BLAKE2b) rather than added up:
    neighbouring iterations and views would otherwise share seeds, and so their noise. Two different uses collide
    with a probability of 2**-32.
    """
    text = f"{run_seed:d}/{iteration:d}/{view:d}/{purpose}"
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=4).digest(), "little")
