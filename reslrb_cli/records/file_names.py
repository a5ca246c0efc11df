"""Names of files that are made from the keys of parameters, which are as long as a scene's author likes."""

from __future__ import annotations

import hashlib
import re

#: Bytes of such a name. File systems take 255, of which some are for suffixes and for files that are being written.
MOST_BYTES = 180


def file_stem(key: str) -> str:
    """A file name for the parameter `key`: the key, with what file systems mind replaced by `_`, and not too long."""
    return bounded(re.sub(r"[^\w.\-]", "_", key))


def bounded(stem: str) -> str:
    """`stem`, or where it is too long for a file's name its beginning, and a number that tells it from others."""
    if len(stem.encode()) <= MOST_BYTES:
        return stem
    digest = hashlib.blake2b(stem.encode(), digest_size=6).hexdigest()
    return f"{stem.encode()[: MOST_BYTES - 13].decode(errors='ignore')}-{digest}"
