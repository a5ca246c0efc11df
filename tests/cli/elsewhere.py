"""Scenes and photographs as users find them: without ids, in old spelling, and with clipped pixels."""

from __future__ import annotations

from pathlib import Path

import numpy as np

# Scenes as users have them: without ids, with features that our scenes lack, and in the current and in older spelling.

#: A box lit by an area lamp and a sky, with instances, bumps, spectra, a blend, a mirror, and glass.
STUDIO = """<scene version="3.5.0">
    <default name="spp" value="128"/>
    <default name="res" value="256"/>
    <default name="max_depth" value="6"/>

    <integrator type="path">
        <integer name="max_depth" value="$max_depth"/>
    </integrator>

    <sensor type="perspective">
        <string name="fov_axis" value="smaller"/>
        <float name="near_clip" value="0.001"/>
        <float name="far_clip" value="100.0"/>
        <float name="focus_distance" value="1000"/>
        <float name="fov" value="39.3077"/>
        <transform name="to_world">
            <lookat origin="0, 0.3, 4" target="0, -0.1, 0" up="0, 1, 0"/>
        </transform>
        <sampler type="multijitter">
            <integer name="sample_count" value="$spp"/>
        </sampler>
        <film type="hdrfilm">
            <integer name="width" value="$res"/>
            <integer name="height" value="$res"/>
            <rfilter type="tent"/>
            <string name="pixel_format" value="rgba"/>
            <string name="component_format" value="float16"/>
        </film>
    </sensor>

    <bsdf type="twosided" id="plaster">
        <bsdf type="diffuse">
            <rgb name="reflectance" value="0.7 0.68 0.6"/>
        </bsdf>
    </bsdf>

    <shape type="rectangle">
        <transform name="to_world"><rotate x="1" angle="-90"/><scale value="1.5"/><translate y="-1"/></transform>
        <bsdf type="bumpmap">
            <texture name="bump" type="bitmap">
                <string name="filename" value="bumps.png"/>
                <boolean name="raw" value="true"/>
                <transform name="to_uv"><scale value="4"/></transform>
            </texture>
            <float name="scale" value="0.05"/>
            <bsdf type="diffuse">
                <texture name="reflectance" type="checkerboard">
                    <rgb name="color0" value=".55 .4 .25"/>
                    <rgb name="color1" value="#404850"/>
                    <transform name="to_uv"><scale x="3" y="3"/></transform>
                </texture>
            </bsdf>
        </bsdf>
    </shape>
    <shape type="rectangle">
        <transform name="to_world"><scale value="1.5"/><translate z="-1.2"/></transform>
        <ref id="plaster"/>
    </shape>
    <shape type="rectangle">
        <transform name="to_world"><scale value="0.45"/><translate x="-0.7" y="0.35" z="-1.19"/></transform>
        <bsdf type="conductor"><string name="material" value="none"/></bsdf>
    </shape>
    <shape type="cube">
        <transform name="to_world">
            <scale x="0.3" y="0.5" z="0.3"/><rotate y="1" angle="20"/><translate x="-0.6" y="-0.5" z="-0.4"/>
        </transform>
        <bsdf type="roughplastic">
            <spectrum name="diffuse_reflectance" value="400:0.12, 500:0.2, 600:0.5, 700:0.6"/>
            <float name="alpha" value="0.15"/>
        </bsdf>
    </shape>
    <shape type="sphere">
        <point name="center" x="0.55" y="-0.6" z="0.2"/>
        <float name="radius" value="0.4"/>
        <bsdf type="dielectric">
            <string name="int_ior" value="bk7"/>
            <string name="ext_ior" value="air"/>
        </bsdf>
    </shape>

    <shape type="shapegroup" id="shelf">
        <shape type="ply">
            <string name="filename" value="meshes/pyramid.ply"/>
            <bsdf type="twosided">
                <bsdf type="blendbsdf">
                    <float name="weight" value="0.3"/>
                    <bsdf type="diffuse"><spectrum name="reflectance" value="0.4"/></bsdf>
                    <bsdf type="roughconductor"><string name="material" value="Au"/></bsdf>
                </bsdf>
            </bsdf>
        </shape>
    </shape>
    <shape type="instance">
        <ref id="shelf"/>
        <transform name="to_world"><scale value="0.2"/><translate x="0.3" y="0.4" z="-0.9"/></transform>
    </shape>
    <shape type="instance">
        <ref id="shelf"/>
        <transform name="to_world"><rotate y="1" angle="45"/><scale value="0.25"/><translate x="0.8" y="0.4" z="-0.9"/>
        </transform>
    </shape>

    <shape type="rectangle">
        <transform name="to_world"><scale value="0.35"/><rotate x="1" angle="90"/><translate y="1.4"/></transform>
        <emitter type="area"><rgb name="radiance" value="18.387, 13.9873, 6.75357"/></emitter>
    </shape>
    <emitter type="envmap">
        <string name="filename" value="sky.exr"/>
        <float name="scale" value="0.4"/>
        <transform name="to_world"><rotate x="0" y="1" z="0" angle="-70"/></transform>
    </emitter>
</scene>
"""
#: A terrace under a sun and a sky of one colour, seen through a lens that blurs. The spelling is that of Mitsuba 0.6.
TERRACE = """<?xml version="1.0" encoding="utf-8"?>
<!-- exported by a modeller -->
<scene version="0.6.0">
    <default name="spp" value="64"/>
    <integrator type="bdpt"><integer name="maxDepth" value="-1"/></integrator>
    <sensor type="thinlens">
        <float name="apertureRadius" value="0.03"/>
        <float name="focusDistance" value="5"/>
        <float name="fov" value="35"/>
        <string name="fovAxis" value="x"/>
        <transform name="toWorld"><lookAt origin="0, 2, 5" target="0, 0.4, 0" up="0, 1, 0"/></transform>
        <sampler type="ldsampler"><integer name="sampleCount" value="$spp"/></sampler>
        <film type="ldrfilm">
            <integer name="width" value="320"/><integer name="height" value="240"/>
            <boolean name="banner" value="false"/>
            <rfilter type="mitchell"/>
        </film>
    </sensor>
    <texture type="bitmap" id="tiles">
        <string name="filename" value="tiles.png"/>
        <float name="uscale" value="3"/><float name="vscale" value="3"/>
    </texture>
    <bsdf type="diffuse" id="ground"><ref name="reflectance" id="tiles"/></bsdf>
    <shape type="rectangle">
        <transform name="toWorld"><scale value="4"/><rotate x="1" angle="-90"/></transform>
        <ref id="ground"/>
    </shape>
    <shape type="obj">
        <string name="filename" value="meshes/pyramid.obj"/>
        <boolean name="faceNormals" value="true"/>
        <transform name="toWorld"><scale value="0.6"/><translate x="-1" y="0" z="0.2"/></transform>
        <bsdf type="plastic"><srgb name="diffuseReflectance" value="#c05030"/></bsdf>
    </shape>
    <shape type="sphere">
        <point name="center" x="0.9" y="0.5" z="0"/><float name="radius" value="0.5"/>
        <bsdf type="roughconductor">
            <string name="material" value="Cu"/><string name="distribution" value="ggx"/>
            <float name="alphaU" value="0.1"/><float name="alphaV" value="0.3"/>
        </bsdf>
    </shape>
    <shape type="disk">
        <transform name="toWorld"><scale value="0.5"/><translate y="0.8" z="-0.8"/></transform>
        <bsdf type="mask">
            <float name="opacity" value="0.5"/>
            <bsdf type="twosided"><bsdf type="diffuse"><rgb name="reflectance" value="0.2, 0.5, 0.3"/></bsdf></bsdf>
        </bsdf>
    </shape>
    <shape type="cylinder">
        <point name="p0" x="0" y="0" z="-1"/><point name="p1" x="0" y="0.9" z="-1"/><float name="radius" value="0.2"/>
        <bsdf type="twosided"><bsdf type="diffuse"/></bsdf>
    </shape>
    <emitter type="directional">
        <vector name="direction" x="-0.4" y="-1" z="-0.5"/>
        <spectrum name="irradiance" value="2.5"/>
    </emitter>
    <emitter type="constant"><spectrum name="radiance" value="0.4"/></emitter>
</scene>
"""
#: Vertices and faces of a pyramid.
CORNERS = ((-1, 0, -1), (1, 0, -1), (1, 0, 1), (-1, 0, 1), (0, 1.6, 0))
FACES = ((0, 4, 1), (1, 4, 2), (2, 4, 3), (3, 4, 0), (0, 1, 2), (0, 2, 3))


def write_studio(folder: Path) -> Path:
    """Write the studio scene with its files and its sky. A variant must be set."""
    _write_meshes(folder)
    _write_image(folder / "bumps.png", 16, 1)
    import mitsuba as mi

    sky = np.linspace(1.5, 0.2, 16, dtype=np.float32)[:, None, None] * np.float32([0.7, 0.85, 1.0])
    mi.Bitmap(np.broadcast_to(sky, (16, 32, 3)).copy()).write(str(folder / "sky.exr"))
    (folder / "scene.xml").write_text(STUDIO)
    return folder / "scene.xml"


def write_terrace(folder: Path) -> Path:
    """Write the terrace scene with its files. A variant must be set."""
    _write_meshes(folder)
    _write_image(folder / "tiles.png", 32, 3)
    (folder / "scene.xml").write_text(TERRACE)
    return folder / "scene.xml"


def _write_image(path: Path, size: int, channels: int) -> None:
    import mitsuba as mi

    pixels = np.random.default_rng(channels).integers(60, 200, (size, size, channels), dtype=np.uint8)
    mi.Bitmap(pixels).write(str(path))


def _write_meshes(folder: Path) -> None:
    (folder / "meshes").mkdir(exist_ok=True)
    lines = [f"v {x} {y} {z}" for x, y, z in CORNERS]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in FACES]
    (folder / "meshes/pyramid.obj").write_text("\n".join(lines) + "\n")
    head = ["ply", "format ascii 1.0", f"element vertex {len(CORNERS)}", *(f"property float {axis}" for axis in "xyz")]
    head += [f"element face {len(FACES)}", "property list uchar int vertex_indices", "end_header"]
    rows = [" ".join(map(str, corner)) for corner in CORNERS] + [f"3 {a} {b} {c}" for a, b, c in FACES]
    (folder / "meshes/pyramid.ply").write_text("\n".join([*head, *rows]) + "\n")


def write_noise(path: Path, width: int, height: int) -> Path:
    """Write an 8-bit image of random pixels. A variant must be set."""
    import mitsuba as mi

    image = np.random.default_rng(3).uniform(0, 0.9, (height, width, 3)).astype(np.float32)
    mi.Bitmap(image).convert(component_format=mi.Struct.Type.UInt8, srgb_gamma=True).write(str(path))
    return path
