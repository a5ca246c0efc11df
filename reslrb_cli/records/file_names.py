"""Names of files that are made from the keys of parameters, which are as long as a scene's author likes."""

from __future__ import annotations

import hashlib
import re

#: Bytes of such a name. File systems take 255, of which some are for suffixes and for files that are being written.
MOST_BYTES = 180


def file_stem(key: str) -> str:
    """A file name for the parameter `key`, not too long, and another for every key.

    Where file systems mind something of it that is `_` in its place, and a number tells it from others like it.
    """
    stem = re.sub(r"[^\w.\-]", "_", key)
    return bounded(stem) if stem == key else _numbered(stem, key)


def bounded(stem: str) -> str:
    """`stem`, or where it is too long for a file's name its beginning, and a number that tells it from others."""
    return stem if len(stem.encode()) <= MOST_BYTES else _numbered(stem, stem)


def _numbered(stem: str, whole: str) -> str:
    """`stem`, or its beginning, and a number made from `whole`."""
    digest = hashlib.blake2b(whole.encode(errors="surrogatepass"), digest_size=6).hexdigest()
    return f"{stem.encode(errors='replace')[: MOST_BYTES - 13].decode(errors='ignore')}-{digest}"
