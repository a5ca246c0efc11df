#!/usr/bin/env python3
"""Make `scenes/mixed_room/target.exr`, the picture that configs/mixed_room.yaml recovers from, by Mitsuba's `path`.

    scripts/make_mixed_target.py [--spp 65536] [OUT.exr]

Nothing of `reslrb` but its choice of libLLVM takes part. Parts of 256 samples have seeds 0, 1, ...; their mean is
written in half floats. Needs the environment that `scripts/setup` makes: run it with `.venv/bin/python`.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import OpenEXR

import reslrb_cli  # noqa: F401  # chooses libLLVM, so it comes before Mitsuba
from reslrb_cli.backend.variant import set_variant

FOLDER = Path(__file__).resolve().parent.parent / "scenes" / "mixed_room"
PART = 256  # samples per pixel that are traced at once


def main() -> None:
    """Parse the command line, render and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--spp", type=int, default=65536)
    parser.add_argument("out", type=Path, nargs="?", default=FOLDER / "target.exr")
    arguments = parser.parse_args()
    set_variant("llvm_ad_rgb")
    import mitsuba as mi

    scene, parts = mi.load_file(str(FOLDER / "scene.xml")), -(-arguments.spp // PART)
    image = sum(np.array(mi.render(scene, spp=PART, seed=part), dtype=np.float64) for part in range(parts)) / parts
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"RGB": np.ascontiguousarray(image.astype(np.float16))}).write(str(arguments.out))


if __name__ == "__main__":
    main()
