"""How other versions of Mitsuba, and exporters for them, say what Mitsuba 3 says in another way: tables."""

from __future__ import annotations

import re

#: Spellings of elements.
ELEMENTS = {"lookAt": "lookat", "srgb": "rgb"}
#: Elements of Mitsuba 0.x that mean what Mitsuba 3 cannot be told, and what to do.
LOST_ELEMENTS = {
    "camera": "an element of Mitsuba before 0.4, whose axes pointed elsewhere; save the scene with Mitsuba 0.6",
    "luminaire": "an element of Mitsuba before 0.4, whose axes pointed elsewhere; save the scene with Mitsuba 0.6",
    "subsurface": "an element of Mitsuba 0.6 that Mitsuba 3 does not have; remove it, or take a medium",
    "blackbody": "an element of Mitsuba 0.6 that Mitsuba 3 does not have; write its colour as <rgb>",
    "animation": "an element of Mitsuba 0.6; nothing moves in Mitsuba 3: write one of its transforms",
}

#: Attributes of elements other than objects.
ATTRIBUTES = {
    **dict.fromkeys(("float", "integer", "boolean", "string", "rgb"), ("name", "value")),
    **dict.fromkeys(("point", "vector"), ("name", "value", "x", "y", "z")),
    **dict.fromkeys(("translate", "scale"), ("value", "x", "y", "z")),
    "spectrum": ("name", "value", "filename"),
    "ref": ("id", "name"),
    "alias": ("id", "as"),
    "transform": ("name",),
    "rotate": ("angle", "value", "x", "y", "z"),
    "lookat": ("origin", "target", "up"),
    "matrix": ("value",),
}
OBJECT_ATTRIBUTES = ("type", "id", "name")

#: Plugins by other names, for elements of one kind.
PLUGINS = {
    ("bsdf", "bump"): "bumpmap",
    ("film", "exrfilm"): "hdrfilm",
    ("film", "pngfilm"): "hdrfilm",
    ("film", "ldrfilm"): "hdrfilm",
    ("film", "tiledhdrfilm"): "hdrfilm",
    ("film", "mfilm"): "hdrfilm",
}
#: Objects without which the same light reaches the same film, and what takes their place.
REPLACEABLE = {
    "sampler": "an `independent` one takes its place",
    "rfilter": "the film's default takes its place",
}
#: Plugins of Mitsuba 0.6 that Mitsuba 3 does not have, and what comes near them.
LOST_PLUGINS = {
    ("bsdf", "coating"): "`principled` with a clearcoat comes near",
    ("bsdf", "roughcoating"): "`principled` with a clearcoat comes near",
    ("bsdf", "mixturebsdf"): "nested `blendbsdf` say the same",
    ("bsdf", "phong"): "`roughplastic` comes near",
    ("bsdf", "ward"): "`roughconductor` or `roughplastic` comes near",
    ("bsdf", "roughdiffuse"): "`diffuse` comes near",
    ("bsdf", "difftrans"): "`principledthin` comes near",
    ("bsdf", "hk"): "a medium comes near",
    ("bsdf", "irawan"): "a texture comes near",
    ("emitter", "sky"): "`sunsky` comes near, with z for its up axis in place of y",
    ("emitter", "sun"): "`sunsky` comes near, with z for its up axis in place of y",
    ("emitter", "collimated"): "`directionalarea` comes near",
    ("shape", "heightfield"): "write it as a mesh",
    ("texture", "scale"): "multiply the texture itself",
    ("texture", "gridtexture"): "`bitmap` or `checkerboard` comes near",
    ("texture", "wireframe"): "`bitmap` comes near",
    ("texture", "curvature"): "`mesh_attribute` comes near",
    ("texture", "vertexcolors"): "`mesh_attribute` says the same",
}

#: Plugins that Mitsuba 3 has, and that no scene file can use here.
REFUSED_PLUGINS = {
    ("shape", "hair"): "is a plugin of Mitsuba 0.6 that Mitsuba 3 does not have; `bsplinecurve` draws strands",
    ("shape", "blender"): "reads the memory of a running Blender; export the mesh as `ply` or `obj`",
    ("sensor", "flat_sensor"): "belongs to Mitsuba's own RayDataLoader; take a `perspective` one",
}

#: Values of text parameters, by plugin and parameter.
VALUES = {
    ("bitmap", "filter_type"): {"trilinear": "bilinear", "ewa": "bilinear"},
    ("hdrfilm", "pixel_format"): {
        "spectrum": "rgb",
        "spectrumAlpha": "rgba",
        "luminanceAlpha": "luminance_alpha",
        "xyzAlpha": "xyza",
    },
}
#: Formats of files that `hdrfilm` knows; nothing here is written by the film, so that another can be left out.
FORMATS = {
    "file_format": frozenset({"openexr", "exr", "rgbe", "pfm"}),
    "component_format": frozenset({"float16", "float32", "uint32"}),
}


def snake_case(name: str) -> str:
    """A parameter's name as it is spelled since Mitsuba 2: `toWorld` is `to_world`, `intIOR` is `int_ior`."""
    return re.sub(r"(?<=[a-z])[A-Z]+", lambda capitals: "_" + capitals[0].lower(), name)
