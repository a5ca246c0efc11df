"""Parts of scene files, from which many tests build their small scenes, and the folder in which a test works."""

from __future__ import annotations

import struct
import time
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest


def with_wavelengths(variant: str) -> str:
    """Return the spectral variant of the same backend."""
    return f"{variant.rpartition('_')[0]}_spectral"


def work_in(folder: Path, patch: pytest.MonkeyPatch) -> None:
    """Make `folder` the working directory, with a cache of its own."""
    patch.chdir(folder)
    patch.setenv("RESLRB_CACHE", str(folder / "cache"))


def wait_for(happened: Callable[[], bool], seconds: float = 60.0) -> None:
    """Wait until `happened()` is true. Fail after `seconds`."""
    end = time.monotonic() + seconds
    while not happened():
        assert time.monotonic() < end
        time.sleep(0.02)


def count_iterations(run: Path) -> int:
    """Return the number of complete lines in the metrics of a run."""
    try:
        return (run / "metrics.jsonl").read_bytes().count(b"\n")
    except OSError:  # there is no file yet
        return 0


#: The reflectance of a surface that shows `poster.exr` with nearest-texel lookup.
TEXTURE = """<texture type="bitmap" name="reflectance">
            <string name="filename" value="{}"/> <boolean name="raw" value="true"/>
            <string name="format" value="variant"/> <string name="filter_type" value="nearest"/>
        </texture>"""
POSTER_BSDF = f'<bsdf type="diffuse" id="poster">\n        {TEXTURE.format("poster.exr")}\n    </bsdf>'


def named(id: str) -> str:
    """Return the attribute with an object's name. An empty `id` gives an empty text."""
    return f' id="{id}"' if id else ""


def scene(*parts: str) -> str:
    """Return the text of a scene file with these parts."""
    return "\n".join(['<scene version="3.0.0">', *(f"    {part}" for part in parts), "</scene>", ""])


def sensor(
    origin: str = "0, 0, 4", target: str = "0, 0, 0", up: str = "0, 1, 0", size: object = 8, fov: float = 50,
    id: str = "", rfilter: str = "box", pixels: str = "rgb",
) -> str:  # fmt: skip
    """Return a perspective sensor. `size` is the film's size in pixels: a number, a variable, or (width, height)."""
    width, height = size if isinstance(size, tuple) else (size, size)
    return f"""<sensor type="perspective"{named(id)}>
        <float name="fov" value="{fov:g}"/>
        <transform name="to_world"><lookat origin="{origin}" target="{target}" up="{up}"/></transform>
        <film type="hdrfilm"{named(id and f"{id}_film")}>
            <integer name="width" value="{width}"/> <integer name="height" value="{height}"/>
            <string name="pixel_format" value="{pixels}"/> <rfilter type="{rfilter}"/>
        </film>
    </sensor>"""


def diffuse(color: str, id: str = "") -> str:
    """Return a diffuse BSDF of one colour."""
    return f'<bsdf type="diffuse"{named(id)}><rgb name="reflectance" value="{color}"/></bsdf>'


def ref(id: str) -> str:
    """Return a reference to an object that is defined elsewhere in the file."""
    return f'<ref id="{id}"/>'


def area(radiance: str, id: str = "") -> str:
    """Return an area emitter, which makes a shape a lamp."""
    return f'<emitter type="area"{named(id)}><rgb name="radiance" value="{radiance}"/></emitter>'


def shape(kind: str, id: str, *parts: str, place: str = "") -> str:
    """Return a shape. `place` contains the steps of its `to_world`, in the order of execution."""
    moved = f'<transform name="to_world">{place}</transform>' if place else ""
    return f'<shape type="{kind}"{named(id)}>{moved}{"".join(parts)}</shape>'


def profile_of(space: str, gamma: float) -> bytes:
    """Return an ICC profile with the primaries of an RGB space of colour-science, and a power as its curve. With
    `space="grey"`, it is a profile of grey images.
    """
    import colour

    is_grey = space == "grey"
    to_xyz = colour.RGB_COLOURSPACES["sRGB" if is_grey else space].matrix_RGB_to_XYZ
    white = to_xyz.sum(axis=1)
    adapted = colour.adaptation.matrix_chromatic_adaptation_VonKries(white, [0.9642, 1, 0.8249], "Bradford") @ to_xyz

    def fixed(numbers: Iterable[float]) -> bytes:
        numbers = list(numbers)
        return struct.pack(f">{len(numbers)}i", *(round(65536 * number) for number in numbers))

    text = space.encode() + b"\0"
    tags = {b"desc": b"desc\0\0\0\0" + struct.pack(">I", len(text)) + text + bytes(78)}
    for name, column in zip((b"rXYZ", b"gXYZ", b"bXYZ"), adapted.T, strict=True):
        tags[name] = b"XYZ \0\0\0\0" + fixed(column)
    tags |= {b"wtpt": b"XYZ \0\0\0\0" + fixed([0.9642, 1, 0.8249])}
    curve = b"curv\0\0\0\0" + struct.pack(">IH", 1, round(256 * gamma)) + b"\0\0"
    tags |= dict.fromkeys((b"rTRC", b"gTRC", b"bTRC"), curve)
    if is_grey:
        tags = {name: tags[name] for name in (b"desc", b"wtpt")} | {b"kTRC": curve}
    table, body, start = b"", b"", 132 + 12 * len(tags)
    for name, content in tags.items():
        content += bytes(-len(content) % 4)
        table += name + struct.pack(">II", start + len(body), len(content))
        body += content
    body = struct.pack(">I", len(tags)) + table + body
    kind = b"GRAY" if is_grey else b"RGB "
    head = struct.pack(">I4sI4s4s4s", 128 + len(body), b"lcms", 0x02100000, b"mntr", kind, b"XYZ ")
    head = head + bytes(12) + b"acsp" + bytes(28) + fixed([0.9642, 1, 0.8249]) + bytes(48)
    return head + body
