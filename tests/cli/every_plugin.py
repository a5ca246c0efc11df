"""Every plugin that Mitsuba 3.9.1 ships, and those of `reslrb` for scenes, in a separate scene, and how the program
treats this scene. This module is docs/plugins.md as data.

`python tests/cli/every_plugin.py` writes the page again. Its table of derivatives is from conformance/every_key.py.
Each plugin has at least one row. Each place or form of the plugin that is treated differently has another row.
"""

from __future__ import annotations

import struct
import sys
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from reslrb_cli.scene.dispersion import GLASS, ILLUMINANT, SENSITIVITY

PAGE = Path(__file__).resolve().parents[2] / "docs" / "plugins.md"
#: Kinds of plugins, and the headings of the page for them.
KINDS = {"bsdf": "BSDFs", "shape": "Shapes", "emitter": "Emitters", "texture": "Textures and spectra",
         "medium": "Media", "phase": "Phase functions", "volume": "Volumes", "sensor": "Sensors", "film": "Films",
         "rfilter": "Reconstruction filters", "sampler": "Samplers", "integrator": "Integrators"}  # fmt: skip

PLACE = '<transform name="to_world"><lookat origin="0, 1, 4" target="0, 0, 0" up="0, 1, 0"/></transform>'
LIGHT = '<shape type="rectangle" id="lamp"><transform name="to_world"><rotate x="1" angle="90"/><translate y="2.5"/>' \
        '</transform><emitter type="area">{}</emitter></shape>'  # fmt: skip
RADIANCE = '<rgb name="radiance" value="8, 7, 6"/>'
FLOOR = """<shape type="rectangle" id="floor"><transform name="to_world"><scale value="2"/><rotate x="1" angle="-90"/>
<translate y="-1"/></transform><bsdf type="diffuse"><rgb name="reflectance" value="0.5, 0.4, 0.3"/></bsdf></shape>"""
WHITE = '<bsdf type="diffuse"><rgb name="reflectance" value="0.6, 0.5, 0.4"/></bsdf>'


def film(inner: str = "", type: str = "hdrfilm", size: int = 16) -> str:
    """Return a film, with a box filter unless `inner` contains a filter."""
    rfilter = "" if "<rfilter" in inner else '<rfilter type="box"/>'
    return f"""<film type="{type}"><integer name="width" value="{size}"/><integer name="height" value="{size}"/>
    {inner}{rfilter}</film>"""


def sensor(type: str = "perspective", inner: str = '<float name="fov" value="50"/>', on: str = "",
           place: str = PLACE) -> str:  # fmt: skip
    """Return a sensor that looks at the scene."""
    return f'<sensor type="{type}" id="camera">{place}{inner}{on or film()}</sensor>'


CAMERA = sensor()


@dataclass(frozen=True)
class Row:
    """How the program treats a scene with a plugin.

    - `where` names the place or form of the plugin.
    - `scene` is XML that is added to the floor, the lamp and the sensor. A lamp or sensor in `scene` replaces the
        default.
    - `light` is the reason why light paths, for example of `reslrb` and `ptracer`, refuse the scene. `camera` is the
        reason why `prb` refuses the scene. Both are parts of the printed message.
    - `loading` is the error of loading the scene, and `mended` is the warning.
    - `note` and `without` are used only for the page. `without` names the part that light paths leave out.
    """

    kind: str
    plugin: str
    where: str = ""
    scene: str = ""
    light: str = ""
    camera: str = ""
    loading: str = ""
    mended: str = ""
    note: str = ""
    without: str = ""

    @property
    def name(self) -> str:
        """Name of the row's test."""
        return f"{self.plugin} {self.where}".strip()

    @property
    def refused(self) -> bool:
        """True if no integrator accepts the scene."""
        return bool(self.loading or (self.light and self.camera))

    def xml(self) -> str:
        """Return the scene's XML."""
        lamp = "" if 'id="lamp"' in self.scene else LIGHT.format(RADIANCE)
        camera = "" if "<sensor" in self.scene else CAMERA
        return f'<scene version="3.0.0">\n{camera}\n{FLOOR}\n{lamp}\n{self.scene}\n</scene>\n'


def thing(bsdf: str, shape: str = "rectangle", more: str = "", place: str = '<rotate x="1" angle="-30"/>') -> str:
    """Return a shape with a BSDF."""
    return f'<shape type="{shape}" id="thing"><transform name="to_world">{place}</transform>{more}{bsdf}</shape>'


def filed(shape: str, file: str, bsdf: str = WHITE) -> str:
    """Return a shape read from a file."""
    return thing(bsdf, shape, f'<string name="filename" value="{file}"/>', '<scale value="0.6"/>')


def bitmap(name: str, file: str = "texture.exr") -> str:
    """Return a texture read from a file."""
    raw = '<boolean name="raw" value="true"/><string name="format" value="variant"/>'
    return f'<texture type="bitmap" name="{name}"><string name="filename" value="{file}"/>{raw}</texture>'


def painted(texture: str) -> str:
    """Return a shape whose reflectance is `texture`."""
    return thing(f'<bsdf type="diffuse">{texture.format("reflectance")}</bsdf>')


def lit(texture: str) -> str:
    """Return a lamp whose radiance is `texture`."""
    return LIGHT.format(texture.format("radiance"))


def fog(inner: str = "", type: str = "homogeneous", name: str = "interior", bsdf: str = '<bsdf type="null"/>') -> str:
    """Return a sphere with a medium."""
    return f'<shape type="sphere" id="fog">{bsdf}<medium name="{name}" type="{type}">{inner}</medium></shape>'


def phase(inner: str) -> str:
    """Return a sphere filled with a medium that has this phase function."""
    return fog(inner)


MEDIUM = "a participating medium; no integrator here supports media"
ONE_WAY = "which changes if light and view are exchanged"
NO_POINTS = "on which Mitsuba samples no points for light to start from"
NO_RAYS = "Mitsuba cannot sample the rays of emitter"
PINHOLE = "light paths connect to `perspective` and `thinlens` sensors"
OWN_INTEGRATOR = "replaced by the integrator of the configuration"
ABOVE = '<transform name="to_world"><lookat origin="0, 2, 1" target="0, 0, 0" up="0, 0, 1"/></transform>'
IRREGULAR = """<spectrum type="irregular" name="{}"><string name="wavelengths" value="400, 500, 700"/>
<string name="values" value="0.1, 0.4, 0.8"/></spectrum>"""
REGULAR = """<spectrum type="regular" name="{}"><float name="wavelength_min" value="400"/>
<float name="wavelength_max" value="700"/><string name="values" value="0.1, 0.4, 0.6"/></spectrum>"""
BLACK_BODY = '<spectrum type="blackbody" name="{}"><float name="temperature" value="5000"/></spectrum>'
CHECKS = '<texture type="checkerboard" name="{}"/>'
ATTRIBUTE = '<texture type="mesh_attribute" name="{}"><string name="name" value="vertex_color"/></texture>'
SOLID = """<texture type="volume" name="{}"><volume type="gridvolume" name="volume">
<string name="filename" value="albedo.vol"/><boolean name="raw" value="true"/></volume></texture>"""
EVEN = """<texture type="volume" name="{}"><volume type="constvolume" name="volume">
<rgb name="value" value="0.3, 0.4, 0.5"/></volume></texture>"""
RAW = '<texture type="rawconstant" name="{}"><vector name="value" value="0.3, 0.4, 0.5"/></texture>'
SHAPES = {"bsplinecurve": "curve.txt", "linearcurve": "curve.txt", "sdfgrid": "sdf.vol", "ellipsoids": "ellipsoids.ply",
          "ellipsoidsmesh": "ellipsoids.ply", "obj": "mesh.obj", "ply": "mesh.ply",
          "serialized": "mesh.serialized"}  # fmt: skip
SOME = '<shape type="sphere"><float name="radius" value="0.4"/>{}</shape>'
MATERIALS = {
    "diffuse": WHITE,
    "conductor": '<bsdf type="conductor"><string name="material" value="Au"/></bsdf>',
    "roughconductor": '<bsdf type="roughconductor"><string name="material" value="Cu"/></bsdf>',
    "dielectric": '<bsdf type="dielectric"/>',
    "thindielectric": '<bsdf type="thindielectric"/>',
    "roughdielectric": '<bsdf type="roughdielectric"><float name="alpha" value="0.3"/></bsdf>',
    "plastic": '<bsdf type="plastic"/>',
    "roughplastic": '<bsdf type="roughplastic"/>',
    "pplastic": '<bsdf type="pplastic"><float name="alpha" value="0.3"/></bsdf>',
    "principled": '<bsdf type="principled"/>',
    "principledthin": '<bsdf type="principledthin"><float name="diff_trans" value="1"/></bsdf>',
    "blendbsdf": f'<bsdf type="blendbsdf"><float name="weight" value="0.4"/>{WHITE}<bsdf type="roughconductor"/>'
    "</bsdf>",
    "mask": f'<bsdf type="mask"><float name="opacity" value="0.4"/>{WHITE}</bsdf>',
    "twosided": f'<bsdf type="twosided">{WHITE}</bsdf>',
    "null": '<bsdf type="null"/>',
    "bumpmap": f'<bsdf type="bumpmap">{bitmap("texture")}{WHITE}</bsdf>',
    "normalmap": f'<bsdf type="normalmap">{bitmap("normalmap", "normals.exr")}{WHITE}</bsdf>',
    "polarizer": '<bsdf type="polarizer"/>',
    "retarder": '<bsdf type="retarder"/>',
    "circular": '<bsdf type="circular"/>',
}
#: Notes of the page on some BSDFs: `SMOOTH` states what light paths leave out, and `SAID_OF` applies to all paths.
SMOOTH = dict.fromkeys(("conductor", "dielectric", "thindielectric", "plastic"),
                       "its smooth lobe is black where the sensor sees it directly")  # fmt: skip
SAID_OF = {
    **dict.fromkeys(("polarizer", "retarder", "circular"), "no polarisation: it only attenuates light"),
    "pplastic": "no polarisation",
}  # fmt: skip
FILTERS = ("box", "catmullrom", "gaussian", "lanczos", "mitchell", "tent")
PHASES = {
    "hg": '<phase type="hg"/>',
    "isotropic": '<phase type="isotropic"/>',
    "rayleigh": '<phase type="rayleigh"/>',
    "tabphase": '<phase type="tabphase"><string name="values" value="0.5, 1, 0.5"/></phase>',
    "blendphase": '<phase type="blendphase"><float name="weight" value="0.5"/><phase type="hg"/>'
                  '<phase type="isotropic"/></phase>',
    "sggx": '<phase type="sggx"><volume type="gridvolume" name="S"><string name="filename" value="sggx.vol"/></volume>'
            "</phase>",
}  # fmt: skip
INTEGRATORS = ("aov", "depth", "direct", "moment", "path", "ptracer", "stokes", "volpath", "volpathmis", "prb",
               "prb_basic", "prb_projective", "prbvolpath", "volprim_rf_basic", "direct_projective")  # fmt: skip
STOCK_IS_WRONG = "by `reslrb`; wrong by Mitsuba's `path`, `prb` and `ptracer`"
OWN = "a plugin of `reslrb`"
OWN_INDEX = f"{OWN}; without wavelengths, its index is that at 587.6 nm"
OWN_GLASS = f'<bsdf type="{GLASS}"><string name="material" value="N-BK7"/>{{}}</bsdf>'
MENDED = "RGB variants have no spectrum `{}`: read as its colour"
SPECTRAL = "needs wavelengths"

ROWS: tuple[Row, ...] = (
    *(Row("bsdf", name, scene=thing(xml), note=SAID_OF.get(name, ""), without=SMOOTH.get(name, ""))
      for name, xml in MATERIALS.items()),
    Row("bsdf", GLASS, scene=thing(OWN_GLASS.format("")), note=OWN_INDEX, without=SMOOTH["dielectric"]),
    Row("bsdf", GLASS, "with `alpha`", thing(OWN_GLASS.format('<float name="alpha" value="0.3"/>')), note=OWN_INDEX),
    Row("bsdf", "twosided", "with a blend of rough BSDFs",
        thing(f'<bsdf type="twosided">{MATERIALS["blendbsdf"]}</bsdf>')),
    Row("bsdf", "blendbsdf", "of a mirror and a rough BSDF",
        thing(f'<bsdf type="blendbsdf"><float name="weight" value="0.4"/>{WHITE}<bsdf type="conductor"/></bsdf>'),
        note=STOCK_IS_WRONG),
    Row("bsdf", "roughconductor", "with spectra", thing(
        '<bsdf type="roughconductor"><spectrum name="eta" value="400:1.5, 700:0.2"/>'
        '<spectrum name="k" filename="spectrum.spd"/></bsdf>')),
    Row("bsdf", "hair", scene=filed("bsplinecurve", "curve.txt", '<bsdf type="hair"/>'), light=ONE_WAY),
    Row("bsdf", "hair", "with `sigma_a`, in a mask", thing(
        '<bsdf type="mask"><float name="opacity" value="0.5"/><bsdf type="hair">'
        '<rgb name="sigma_a" value="0.2, 0.3, 0.4"/></bsdf></bsdf>'), light=ONE_WAY),
    Row("bsdf", "measured", scene=thing(
        '<bsdf type="measured"><string name="filename" value="paint.bsdf"/></bsdf>'), light=ONE_WAY,
        note="RGB files; Mitsuba refuses spectral files"),
    Row("bsdf", "measured", "without its file", thing(
        '<bsdf type="measured"><string name="filename" value="none.bsdf"/></bsdf>'),
        loading='`none.bsdf`: no such file'),
    Row("bsdf", "measured_polarized", scene=thing(
        '<bsdf type="measured_polarized"><string name="filename" value="paint.pbsdf"/>'
        '<float name="wavelength" value="500"/></bsdf>'), light=ONE_WAY, note="at its single wavelength"),
    Row("bsdf", "measured_polarized", "without `wavelength`", thing(
        '<bsdf type="measured_polarized"><string name="filename" value="paint.pbsdf"/></bsdf>'),
        loading="can only render a specific wavelength specified by the `wavelength` parameter"),
    *(Row("shape", name, scene=thing(WHITE, name, place='<scale value="0.6"/>'))
      for name in ("rectangle", "disk", "sphere", "cylinder", "cube")),
    *(Row("shape", name, scene=filed(name, file)) for name, file in SHAPES.items()),
    *(Row("shape", name, "that emits", filed(name, SHAPES[name], '<emitter type="area"/>'),
          light=NO_POINTS) for name in ("sdfgrid", "ellipsoids", "ellipsoidsmesh")),
    *(Row("shape", name, "that emits", filed(name, SHAPES[name], '<emitter type="area"/>'),
          light="which Mitsuba does not allow to emit", camera="which Mitsuba does not allow to emit")
      for name in ("bsplinecurve", "linearcurve")),
    Row("shape", "shapegroup", "with `instance`", f'<shape type="shapegroup" id="g">{SOME.format(WHITE)}</shape>'
        '<shape type="instance"><ref id="g"/></shape><shape type="instance"><ref id="g"/>'
        '<transform name="to_world"><translate x="1"/></transform></shape>'),
    Row("shape", "instance", scene=f'<shape type="shapegroup" id="g">{SOME.format(WHITE)}</shape>'
        '<shape type="instance"><ref id="g"/></shape>'),
    Row("shape", "merge", scene=f'<shape type="merge">{filed("ply", "mesh.ply")}</shape>'),
    Row("shape", "blender", scene='<shape type="blender"/>', loading="reads the memory of a running Blender"),
    Row("emitter", "area", scene=lit(RADIANCE)),
    Row("emitter", "area", "with an image", lit(bitmap("radiance"))),
    Row("emitter", "area", "with an image, on a `cube`", LIGHT.replace("rectangle", "cube").format(bitmap("radiance")),
        note=STOCK_IS_WRONG),
    Row("emitter", "area", "with a texture other than an image", lit(CHECKS), light=NO_RAYS),
    Row("emitter", "point", scene='<emitter type="point"><point name="position" x="0" y="1" z="0"/></emitter>'),
    Row("emitter", "constant", scene='<emitter type="constant"/>'),
    Row("emitter", "directional", scene='<emitter type="directional"><vector name="direction" value="0, -1, -0.2"/>'
        "</emitter>"),
    Row("emitter", "directionalarea", scene=LIGHT.replace('"area"', '"directionalarea"').format(RADIANCE),
        camera="camera paths cannot find"),
    Row("emitter", "envmap", scene='<emitter type="envmap"><string name="filename" value="sky.exr"/></emitter>'),
    Row("emitter", "spot", scene=f'<emitter type="spot">{ABOVE}</emitter>'),
    Row("emitter", "spot", "with an image", f'<emitter type="spot">{ABOVE}{bitmap("texture")}</emitter>'),
    Row("emitter", "projector", scene=f'<emitter type="projector">{ABOVE}{bitmap("irradiance")}</emitter>'),
    Row("emitter", "sunsky", scene='<emitter type="sunsky"/>'),
    Row("emitter", "timed_sunsky", scene='<emitter type="timed_sunsky"/>', light="use a `sunsky`",
        camera="use a `sunsky`"),
    Row("texture", "bitmap", scene=painted(bitmap("reflectance"))),
    Row("texture", "checkerboard", scene=painted(CHECKS)),
    Row("texture", "mesh_attribute", scene=filed("ply", "mesh.ply", f'<bsdf type="diffuse">'
        f'{ATTRIBUTE.format("reflectance")}</bsdf>')),
    Row("texture", "volume", scene=painted(SOLID)),
    Row("texture", "volume", "on a lamp", lit(EVEN), light=NO_RAYS),
    *(Row("texture", name, form, place(xml), mended=MENDED.format(name), note=note)
      for name, xml in (("regular", REGULAR), ("irregular", IRREGULAR))
      for form, place, note in (("on a lamp", lit, ""), ("in a material", painted, "its colour under D65"))),
    Row("texture", "irregular", "by reference", IRREGULAR.replace('name="{}"', 'id="s"')
        + painted('<ref id="s" name="{}"/>'), mended=MENDED.format("irregular")),
    Row("texture", "irregular", "with lists of different lengths", painted(IRREGULAR.replace("0.1, ", "")),
        loading="irregular has 3 wavelengths and 2 values"),
    Row("texture", "blackbody", "on a lamp", lit(BLACK_BODY), mended=MENDED.format("blackbody"),
        note="in W/(m² sr), so its values are in the thousands"),
    Row("texture", "blackbody", "in a material", painted(BLACK_BODY),
        loading="only emitters can have a blackbody; a bsdf can have <rgb>"),
    Row("texture", "d65", "on a lamp", lit('<spectrum type="d65" name="{}"/>')),
    Row("texture", "d65", "in a material",
        painted('<spectrum type="d65" name="{}"><float name="scale" value="0.5"/></spectrum>')),
    Row("texture", ILLUMINANT, "on a lamp",
        lit('<spectrum type="illuminant" name="{}"><string name="name" value="A"/></spectrum>'), note=OWN),
    Row("texture", SENSITIVITY, scene=painted('<spectrum type="sensitivity" name="{}"><string name="camera" '
        'value="Nikon 5100"/><string name="channel" value="red"/></spectrum>'), loading=SPECTRAL),
    Row("texture", "uniform", scene=painted('<spectrum type="uniform" name="{}"><float name="value" '
        'value="0.4"/></spectrum>')),
    Row("texture", "srgb", scene=painted('<spectrum type="srgb" name="{}"><rgb name="color" '
        'value="0.3, 0.4, 0.5"/></spectrum>')),
    Row("texture", "rawconstant", scene=painted(RAW)),
    Row("texture", "rawconstant", "with three numbers in place of one",
        thing(f'<bsdf type="roughconductor">{RAW.format("alpha")}</bsdf>'), light="eval_1() is not defined",
        camera="eval_1() is not defined"),
    Row("texture", "spectrum", "on a lamp", lit('<spectrum name="{}" value="400:1, 700:9"/>')),
    Row("texture", "spectrum", "in a material", painted('<spectrum name="{}" value="400:0.1, 700:0.9"/>')),
    Row("texture", "rgb", scene=painted('<rgb name="{}" value="0.3, 0.4, 0.5"/>')),
    Row("medium", "homogeneous", scene=fog(), light=MEDIUM, camera=MEDIUM),
    Row("medium", "homogeneous", "around a shape", fog(name="exterior"), light=MEDIUM, camera=MEDIUM),
    Row("medium", "homogeneous", "in glass", fog(bsdf='<bsdf type="dielectric"/>'), light=MEDIUM, camera=MEDIUM),
    Row("medium", "homogeneous", "in a group with instances",
        f'<shape type="shapegroup" id="g">{fog()}</shape><shape type="instance"><ref id="g"/></shape>',
        light=MEDIUM, camera=MEDIUM),
    Row("medium", "homogeneous", "in a group without instances", f'<shape type="shapegroup" id="g">{fog()}</shape>'),
    Row("medium", "homogeneous", "around the sensor",
        sensor(inner='<float name="fov" value="50"/><medium type="homogeneous"/>'), light=MEDIUM, camera=MEDIUM),
    Row("medium", "homogeneous", "around a lamp", '<emitter type="point"><medium type="homogeneous"/></emitter>',
        light=MEDIUM, camera=MEDIUM),
    Row("medium", "homogeneous", "that is not used", '<medium type="homogeneous" id="m"/>'),
    Row("medium", "heterogeneous", scene=fog('<volume type="gridvolume" name="sigma_t"><string name="filename" '
        'value="density.vol"/></volume>', "heterogeneous"), light=MEDIUM, camera=MEDIUM),
    *(Row("phase", name, scene=phase(xml), light=MEDIUM, camera=MEDIUM) for name, xml in PHASES.items()),
    Row("volume", "constvolume", "in a texture", painted(EVEN)),
    Row("volume", "gridvolume", "in a texture", painted(SOLID)),
    Row("volume", "constvolume", "in a medium", fog('<volume type="constvolume" name="albedo"><float name="value" '
        'value="0.5"/></volume>'), light=MEDIUM, camera=MEDIUM),
    Row("sensor", "perspective", scene=CAMERA),
    Row("sensor", "thinlens", scene=sensor("thinlens", '<float name="fov" value="50"/><float name="focus_distance" '
        'value="4"/><float name="aperture_radius" value="0.05"/>')),
    Row("sensor", "orthographic", scene=sensor("orthographic", ""), light=PINHOLE),
    Row("sensor", "distant", light=PINHOLE,
        scene=sensor("distant", '<vector name="direction" value="0.1, -1, -0.1"/>', film(size=1), "")),
    Row("sensor", "radiancemeter", light=PINHOLE,
        scene=sensor("radiancemeter", "", film(size=1), PLACE.replace("0, 0, 0", "0, -1, 1"))),
    Row("sensor", "irradiancemeter", light=PINHOLE,
        scene='<shape type="disk"><transform name="to_world"><rotate x="1" angle="-90"/><translate y="-0.9"/>'
        f'</transform>{sensor("irradiancemeter", "", film(size=1), "")}</shape>'),
    Row("sensor", "batch", light=PINHOLE,
        scene=sensor("batch", 2 * f'<sensor type="perspective">{PLACE}{film()}</sensor>', film(size=32), "")),
    Row("sensor", "flat_sensor", scene=sensor("flat_sensor", ""), loading="belongs to Mitsuba's own RayDataLoader"),
    Row("film", "hdrfilm", scene=sensor(on=film('<string name="pixel_format" value="luminance"/>'))),
    Row("film", "specfilm", scene=sensor(on=film(REGULAR.format("band1"), "specfilm")),
        loading=SPECTRAL),
    *(Row("rfilter", name, scene=sensor(on=film(f'<rfilter type="{name}"/>'))) for name in FILTERS),
    *(Row("sampler", name, scene=sensor(inner=f'<float name="fov" value="50"/><sampler type="{name}"/>'),
          note="" if name == "independent" else "replaced by `independent` with `run.spp` samples")
      for name in ("independent", "ldsampler", "multijitter", "orthogonal", "stratified")),
    *(Row("integrator", name, scene=f'<integrator type="{name}"/>', note=OWN_INTEGRATOR)
      for name in INTEGRATORS),
)  # fmt: skip
#: Rows that the default suite also takes through three iterations: one row of each kind, and rows with special
#: behaviour.
FEW = ("diffuse", "irregular in a material", "blackbody on a lamp", "rawconstant", "orthogonal")


def write_files(folder: Path) -> None:
    """Write the files that the scenes name into `folder`. A variant must be set."""
    import mitsuba as mi
    from mitsuba.python.tensor_io import write

    rng = np.random.default_rng(0)

    def save(name: str, *shape: int, high: float = 0.8) -> None:
        mi.Bitmap(rng.uniform(0.2, high, shape).astype(np.float32)).write(str(folder / name))

    save("texture.exr", 4, 4, 3)
    save("sky.exr", 8, 16, 3, high=2)
    mi.Bitmap(np.tile(np.float32([0.5, 0.5, 1]), (4, 4, 1))).write(str(folder / "normals.exr"))
    places = np.float32([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    lines = [" ".join(f"{x:g}" for x in place) for place in places]
    (folder / "mesh.obj").write_text("".join(f"v {line}\n" for line in lines) + "f 1 2 3\nf 1 3 4\n")
    head = "".join(f"property float {name}\n" for name in "xyzrgb")
    faces = "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
    vertices = "".join(f"{line} 0.5 0.4 0.2\n" for line in lines)
    (folder / "mesh.ply").write_text(
        f"ply\nformat ascii 1.0\nelement vertex 4\n{head}{faces}{vertices}3 0 1 2\n3 0 2 3\n"
    )
    body = struct.pack("<I", 0x1000) + b"mesh\0" + struct.pack("<QQ", 4, 2) + places.tobytes()
    body = zlib.compress(body + np.uint32([0, 1, 2, 0, 2, 3]).tobytes())
    (folder / "mesh.serialized").write_bytes(struct.pack("<HH", 0x041C, 4) + body + struct.pack("<QI", 0, 1))
    (folder / "curve.txt").write_text("".join(f"{0.4 * i - 1:g} {0.2 * (-1) ** i:g} 0 0.1\n" for i in range(6)))
    names = (
        "x",
        "y",
        "z",
        "nx",
        "ny",
        "nz",
        "opacity",
        "scale_0",
        "scale_1",
        "scale_2",
        "rot_0",
        "rot_1",
        "rot_2",
        "rot_3",
    )
    head = "".join(f"property float {name}\n" for name in names)
    one = "{} 0 0 0 0 0 0.9 -1.5 -2 -1.5 1 0 0 0\n"
    text = f"ply\nformat ascii 1.0\nelement vertex 2\n{head}end_header\n{one.format(0)}{one.format(0.6)}"
    (folder / "ellipsoids.ply").write_text(text)
    grid = np.stack(np.meshgrid(*3 * [np.linspace(-0.5, 0.5, 8)], indexing="ij"), axis=-1)
    volumes = {
        "density.vol": rng.uniform(0.2, 0.8, (3, 3, 3, 1)),
        "albedo.vol": rng.uniform(0.2, 0.8, (3, 3, 3, 3)),
        "sdf.vol": np.linalg.norm(grid, axis=-1, keepdims=True) - 0.35,
        "sggx.vol": np.tile([0.2, 0.5, 0.7, 0, 0, 0], (2, 2, 2, 1)),
    }
    for name, values in volumes.items():
        mi.VolumeGrid(values.astype(np.float32)).write(str(folder / name))
    (folder / "spectrum.spd").write_text("400 2\n500 3\n700 4\n")
    angles, ones = np.linspace(0, np.pi / 2, 8).astype(np.float32), np.ones((1, 8, 8, 8), np.float32)
    write(str(folder / "paint.bsdf"), description=np.frombuffer(b"paint", np.uint8), theta_i=angles,
          phi_i=np.float32([0]), ndf=ones[0, 0], sigma=ones[0, 0], vndf=ones, luminance=ones, jacobian=np.uint8([1]),
          rgb=np.full((1, 8, 3, 8, 8), 0.3, np.float32))  # fmt: skip
    turns, matrix = np.linspace(0, np.pi, 4).astype(np.float32), np.zeros((4, 8, 8, 5, 4, 4), np.float32)
    matrix[..., 0, 0] = 0.2
    write(str(folder / "paint.pbsdf"), theta_h=angles[None], theta_d=angles[None], phi_d=turns[None], M=matrix,
          wvls=np.uint16([450, 500, 550, 600, 650]))  # fmt: skip


#: Reasons as the page gives them, by a part of the error message.
REASONS = {
    MEDIUM: "participating media are not supported",
    ONE_WAY: "not the same if light and view are exchanged",
    NO_POINTS: "Mitsuba cannot sample points on it for light to start from",
    NO_RAYS: "Mitsuba cannot sample rays from this emitter",
    PINHOLE: "light paths need a `perspective` or `thinlens` sensor",
    "which Mitsuba does not allow to emit": "Mitsuba does not support it as an emitter",
    "camera paths cannot find": "camera paths cannot find its light",
    "use a `sunsky`": "use `sunsky` instead",
    "eval_1() is not defined": "this parameter takes one number",
    "`none.bsdf`: no such file": "the file does not exist",
    "can only render a specific wavelength specified by the `wavelength` parameter": "it needs `wavelength`",
    "reads the memory of a running Blender": "it reads the memory of a running Blender",
    "belongs to Mitsuba's own RayDataLoader": "it belongs to Mitsuba's own RayDataLoader",
    "irregular has 3 wavelengths and 2 values": "both lists must have the same length",
    "only emitters can have a blackbody; a bsdf can have <rgb>": "only emitters can have it; use `rgb` instead",
    SPECTRAL: "it needs a spectral variant of Mitsuba",
}

HEAD = """# Mitsuba's plugins

This page lists every plugin of Mitsuba 3.9.1, and whether `reslrb` supports it. It also lists the two plugins that
`reslrb` adds ([Wavelengths](spectral.md)). Each row is a scene that a test runs
through `inspect`, `init`, three iterations of `optimize`, and `export`.

- **light paths**: the integrators `reslrb`, `ptracer`, `walk_ad` and `trajectory`. **`prb`**: paths from the sensor.
    `init` uses light paths if they work, and paths from the sensor otherwise.
- **works**: supported, with the restriction in brackets. `reslrb inspect` lists the parameters that can be recovered.
- **refused**: every command prints the reason in one line and ends with exit code 2. If both columns refuse a plugin,
    or loading refuses it, change the scene file.
- **converted**: read as an RGB colour, with a warning, because RGB variants of Mitsuba do not have this spectrum.

`python tests/cli/every_plugin.py` writes this page. `pytest -m long tests/cli/test_every_plugin.py` runs all rows;
without `-m long` it runs the refused plugins and a few others.
"""


def page() -> str:
    """Return docs/plugins.md."""
    parts = [HEAD]
    for kind, heading in KINDS.items():
        parts.append(f"\n## {heading}\n\n| plugin | light paths | `prb` |\n|---|---|---|\n")
        for row in (row for row in ROWS if row.kind == kind):
            note = f" ({row.note})" if row.note else ""
            name = f"`{row.plugin}`{f' {row.where}' if row.where else ''}"
            if row.loading:
                parts.append(f"| {name} | refused on loading: {REASONS[row.loading]} | the same |\n")
            elif row.mended:
                parts.append(f"| {name} | converted{note} | the same |\n")
            elif row.light and row.light == row.camera:
                parts.append(f"| {name} | refused: {REASONS[row.light]} | the same |\n")
            else:
                without = f" ({row.without})" if row.without else ""
                light, camera = (
                    f"refused: {REASONS[why]}" if why else f"works{note}" for why in (row.light, row.camera)
                )
                parts.append(f"| {name} | {light}{without} | {camera} |\n")
    return "".join([*parts, DERIVATIVES, *derivatives()])


DERIVATIVES = """
## Derivatives

Each parameter that `reslrb inspect` lists as recoverable is tested: its derivative by `reslrb` is compared with
differences of images at the same random numbers, inside of its range and at both bounds. The objective is a weighted
sum of pixels. A cell has the difference, the derivative, the standard error of their distance, and in brackets their
distance in standard errors (z). Differences have an error of up to 2 % by their step, so z is large where the standard
error is tiny. A derivative that is 10 % off fails the test. `pytest -m long tests/conformance/test_every_key.py`
repeats all comparisons; without `-m long` it repeats a few. Parameters that move light have tests of their own.

Cells marked "noisy" cannot show a derivative that is 10 % off. For smooth `plastic` and `thindielectric`, samples
change between mirrored and other light, and closed forms test the derivative instead. The peak of a clearcoat of gloss
1 is too narrow for single precision: its derivative agrees with closed forms up to a gloss of 0.97. The effect of
`anisotropic` at 0 nearly cancels in the objective. The derivative by `eta` of a rough GGX glass is 3 % off
([Limits](limits.md#derivatives-that-are-lost-or-biased)).

Stock Mitsuba 3.9.1 fails some of these comparisons. `reslrb` corrects or refuses:

- `alpha` and `eta` of `roughplastic`. Mitsuba's tables of the transmittance have no derivatives, so the sign or the
    size is wrong. `reslrb` adds the derivative of the tables.
- `spec_trans`, `metallic`, `clearcoat` and `sheen` of `principled`; `spec_trans`, `diff_trans` and `sheen` of
    `principledthin`; blend weight; opacity; the colours of a smooth `plastic`. Mitsuba leaves out a lobe of weight 0,
    so the derivative at a bound is 0. A run keeps these parameters 0.001 away from such a bound.
- `eta` and `k` of conductors have the derivative 0 at 0. `base_color` and `specular` of `principled`, and `base_color`
    of `principledthin`, have an infinite derivative there. A run keeps them at 0.001 or more.
- `longitudinal_roughness` and `azimuthal_roughness` of `hair`. At 0 Mitsuba divides by 0, and the hair is black. A run
    keeps them at 0.001 or more, and `init` at 0.02 or more.
- All parameters of a `mask` over a BSDF that lets light straight through, such as `thindielectric`. The derivative of
    light through the mask was counted twice. `reslrb` corrects this.
- `k` of conductors has no effect while `eta` is 0 (without a `material`, `eta` is 0), `eumelanin` and `pheomelanin` of
    `hair` if the scene file gives `sigma_a`, and `texture` of a `spot` without an image. They are refused.
- `clearcoat_gloss` and `sheen_tint`; `eta`, `anisotropic` and `spec_tint` of `principledthin`. They have no effect
    while the weight of their lobe is 0, and are refused if the weight is not recovered as well.
- `theta` and `delta` of polarisers and retarders have no effect without polarised light, and are refused.
- `spec_trans` of a `principled` in a `twosided` is refused: Mitsuba does not load such a file.

| plugin | parameter | inside, light paths | inside, camera paths | at the lower bound | at the upper bound |
|---|---|---|---|---|---|
"""


def derivatives() -> list[str]:
    """Return the rows of the table of derivatives."""
    from conformance.every_key import stored  # needs this module

    found: dict[tuple[str, str], dict[str, str]] = {}
    for one in stored():
        place = f"inside {one.paths}" if one.at == "inside" else one.at
        noisy = "" if one.resolved else ", noisy"
        cell = f"{one.fd:.3g} / {one.ad:.3g} ± {one.error:.0e} ({one.z:+.1f}{noisy})"
        found.setdefault((one.form, one.key), {})[place] = cell
    rows = []
    for (form, key), cells in found.items():
        plugin, _, options = form.partition(" ")
        name = key.removeprefix("thing.").removeprefix("bsdf.")
        values = [cells.get(place, "") for place in ("inside light", "inside camera", "low", "high")]
        rows.append(f"| `{plugin}`{f' {options}' if options else ''} | `{name}` | {' | '.join(values)} |\n")
    measured = {form.partition(" ")[0] for form, _ in found}
    tested = dict.fromkeys(row.plugin for row in ROWS if row.kind in ("bsdf", "emitter", "texture") and not row.refused)
    others = [f"`{name}`" for name in tested if name not in measured]
    note = f"\nThese plugins have no parameter that can be recovered: {', '.join(others)}.\n"
    return [*rows, note] if others else rows


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
    PAGE.write_text(page(), encoding="utf-8")
