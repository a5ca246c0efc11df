"""Scenes and images that are nearly right, and a process that is handed them."""

from __future__ import annotations

import contextlib
import io
import json
import os
import random
import re
import struct
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

# Scenes and images that are nearly right: what a damaged disk, a bad exporter or an enemy may hand in.

#: Values of attributes that most likely are wrong where they come to stand.
VALUES = (
    *("", " ", "0", "-1", "1", "0.5", "1e-40", "1e30", "1e400", "-1e38", "nan", "inf", "-inf", "99999999999999999999"),
    *("2147483647", "-2147483648", "100000", "0,0,0", "1 2", "nan, nan, nan", "1e30,1e30,1e30", "0, 0, 0, 0", "#ff"),
    *("true", "x", "$x", "\\$", "../../../etc/passwd", "/dev/zero", "/", ".", "scene.xml", "poster.exr", "a" * 5000),
    *("\u202e", "%s%n", "<", "&amp;", "[0]", "poster", "wall", "lamp", "rgb", "luminance", "srgb", "uint8"),
)
#: Plugins, of every kind.
PLUGINS = (
    *("scene", "rectangle", "sphere", "cylinder", "disk", "cube", "obj", "ply", "serialized", "instance", "shapegroup"),
    *("diffuse", "dielectric", "roughdielectric", "thindielectric", "conductor", "roughconductor", "plastic", "null"),
    *("roughplastic", "principled", "principledthin", "mask", "twosided", "blendbsdf", "bumpmap", "normalmap", "hair"),
    *("area", "point", "spot", "projector", "directional", "directionalarea", "constant", "envmap", "sunsky"),
    *("perspective", "thinlens", "orthographic", "irradiancemeter", "hdrfilm", "specfilm", "box", "gaussian", "tent"),
    *("bitmap", "checkerboard", "mesh_attribute", "volume", "independent", "multijitter", "path", "homogeneous", "hg"),
    *("linearcurve", "bsplinecurve", "sdfgrid", "ellipsoids", "heterogeneous", "gridvolume", "measured", "sggx"),
)
_NAMES = ("width", "height", "fov", "radiance", "reflectance", "to_world", "filename", "alpha", "int_ior", "value")


def mutate_scene(rng: random.Random, text: str) -> bytes:
    """The XML of a scene, with some changes."""
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        text = rng.choices((_as_text, _as_elements), (1, 4))[0](rng, text)
    data = text.encode("utf-8", "surrogatepass")
    return mutate_bytes(rng, data) if rng.random() < 0.05 else data


def mutate_bytes(rng: random.Random, data: bytes, head: int = 200) -> bytes:
    """The bytes of a file, damaged: most of the time near its beginning, where it says what it holds."""
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        within = min(len(data), head) if rng.random() < 0.7 else len(data)
        at = rng.randrange(within + 1)
        kind = rng.randrange(8)
        if kind == 0:
            data = data[:at]
        elif kind == 1:
            data = data[:at] + rng.randbytes(rng.choice((1, 2, 4, 40))) + data[at:]
        elif kind == 2:
            data = data[:at] + data[at + rng.choice((1, 2, 4, 40, 400)) :]
        elif kind == 3:
            number = rng.choice((0, 1, 0x7FFFFFFF, 0xFFFFFFFF, 0x80000000, 0x10000, 0xFFFF, 20000))
            data = data[:at] + struct.pack(rng.choice("<>") + "I", number) + data[at + 4 :]
        elif kind == 4:
            data = data[:at] + data[at : at + 100] * rng.choice((2, 50)) + data[at:]
        elif kind == 5 and at < len(data):
            data = data[:at] + bytes([data[at] ^ 1 << rng.randrange(8)]) + data[at + 1 :]
        elif kind == 6:
            data = data + rng.randbytes(rng.choice((1, 1000)))
        else:
            digits = [m.span() for m in re.finditer(rb"\d+", data[:head])]
            if digits:
                start, end = rng.choice(digits)
                data = data[:start] + rng.choice((b"0", b"-1", b"99999", b"4294967296", b"1e9", b"")) + data[end:]
    return data


def _as_text(rng: random.Random, text: str) -> str:
    start = rng.randrange(len(text) + 1)
    end = min(len(text), start + rng.choice((1, 3, 20, 200)))
    return rng.choice((text[:start] + text[end:], text[:end] + text[start:end] + text[end:], text[:start],
                       text[:start] + rng.choice(VALUES) + text[end:]))  # fmt: skip


def _as_elements(rng: random.Random, text: str) -> str:
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError):
        return _as_text(rng, text)
    parents = [(parent, child) for parent in root.iter() for child in parent]
    if not parents:
        return text
    for _ in range(rng.choice((1, 1, 2, 3))):
        parent, child = rng.choice(parents)
        kind = rng.randrange(7)
        if kind == 0 and child in parent:
            parent.remove(child)
        elif kind == 1:
            parent.append(child)
        elif kind == 2:
            other, _ = rng.choice(parents)
            if other not in child.iter():
                other.append(child)
        elif kind == 3 and "type" in child.attrib:
            child.set("type", rng.choice(PLUGINS))
        elif kind == 4 and "name" in child.attrib:
            child.set("name", rng.choice(_NAMES))
        elif child.attrib:
            child.set(rng.choice(sorted(child.attrib)), rng.choice(VALUES))
    return ElementTree.tostring(root, encoding="unicode")


def write_images(folder: Path) -> list[Path]:
    """Good images of every format, of 8x8 pixels, or 5x7; a variant must be set."""
    import mitsuba as mi
    import numpy as np
    from PIL import Image  # comes with matplotlib

    rng, made = np.random.default_rng(3), []
    floats = rng.uniform(0, 2, (8, 8, 3)).astype(np.float32)
    for suffix in ("exr", "hdr", "pfm"):
        made.append(folder / f"good.{suffix}")
        mi.Bitmap(floats).write(str(made[-1]))
    for suffix, kind in (("png", np.uint8), ("jpg", np.uint8), ("bmp", np.uint8), ("ppm", np.uint8)):
        made.append(folder / f"good.{suffix}")
        Image.fromarray(rng.integers(0, 255, (8, 8, 3)).astype(kind)).save(made[-1])
    made.append(folder / "good16.png")
    mi.Bitmap(rng.integers(0, 60000, (7, 5, 4)).astype(np.uint16)).write(str(made[-1]))
    return made


# A process that is handed scenes and images that may be wrong, one a line, and says what came of each.
#
# It works in a folder of its own, under a limit of memory. Each line names a command (`scene FILE`, `photo FILE`,
# `run FILE`, `resume RUN`), each answer is one JSON object. What ends the process in the midst of a case is seen by
# who waits for the answer.

#: Bytes that a case may have beside what the process has before the first.
ROOM = 6 * 2**30


def limit_memory() -> None:
    """Let the process have no more than it has now, and ROOM."""
    import resource

    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + ROOM
    resource.setrlimit(resource.RLIMIT_AS, (most, most))


def call(arguments: Sequence[str]) -> dict[str, object]:
    """`reslrb` with these arguments: exit code, and what it printed to standard error."""
    from reslrb_cli.cli import main

    said = io.StringIO()
    code: object = 0
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
        try:
            main(list(arguments), prog_name="reslrb")
        except SystemExit as end:
            code = end.code
        except BaseException:
            import traceback

            traceback.print_exc(file=said)
            code = "traceback"
    return {"code": code, "said": said.getvalue()[-3000:]}


def resume(run: str) -> dict[str, object]:
    """Go on with a run, whose page is not drawn: that takes longer than all else."""
    from unittest.mock import patch

    from reslrb_cli.runs import recorder as recording

    with patch.object(recording, "write_report", lambda folder, *now: None):
        return call(["optimize", "--resume", run, "--quiet"])


def main_loop() -> None:
    """Answer until there are no more questions."""
    import reslrb_cli  # noqa: F401
    from reslrb_cli.backend.variant import set_variant

    answers = os.fdopen(os.dup(1), "w")
    below = tempfile.TemporaryFile()  # noqa: SIM115  # what libraries print themselves, past Python
    for stream in (1, 2):
        os.dup2(below.fileno(), stream)
    set_variant("llvm_ad_rgb")
    limit_memory()
    for line in sys.stdin:
        start = os.fstat(below.fileno()).st_size
        kind, _, name = line.strip().partition(" ")
        if kind == "scene":
            answer = call(["inspect", name])
        elif kind == "run":
            answer = call(["optimize", name, "--quiet", "--force"])
        elif kind == "resume":
            answer = resume(name)
        else:
            answer = call(["optimize", "photo.yaml", "--quiet", "--force", "--set", f"target.file={name}"])
        below.seek(start)
        answer["below"] = below.read().decode(errors="surrogateescape")
        answers.write(json.dumps(answer) + "\n")
        answers.flush()


if __name__ == "__main__":
    main_loop()
