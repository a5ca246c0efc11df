"""The only module that makes seeds.

Every random number of a run derives from `run.seed` through `seed`, so a run can be repeated. Two uses share random
numbers only if they ask for the same (iteration, view, purpose).
"""

from __future__ import annotations

import hashlib


def seed(run_seed: int, iteration: int, view: int, purpose: str) -> int:
    """Return the seed of one use of random numbers, an integer in [0, 2**32).

    `iteration` and `view` are the iteration and the sensor for which the numbers are drawn, or 0 if there is none.
    `purpose` names the use (`"image"`, `"target"`, ...). The four arguments are hashed together (BLAKE2b). A sum would
    give neighbouring iterations and views the same seeds and therefore the same noise. The seeds of two different uses
    are equal with a probability of 2**-32.
    """
    text = f"{run_seed:d}/{iteration:d}/{view:d}/{purpose}"
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=4).digest(), "little")
