"""Results of functions that read, mend, check and write scene files, as a table of cases (`said.check`)."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from golden.cases import Cases, ending
from kit import with_wavelengths
from scene.test_cases import FILM, ROOM, described, lines, made_room, picture

from reslrb_cli.integrators.plugin import register
from reslrb_cli.scene import catalog, load
from reslrb_cli.scene.export import Replacing
from reslrb_cli.scene.xml import build, mend, read
from reslrb_cli.scene.xml.read import read_description

pytestmark = pytest.mark.usefixtures("combined")
Patch = pytest.MonkeyPatch
case = Cases()


# ---- Reading ----

#: Contents of scenes, with the values of their variables.
READ = (
    r"""
<default name="a" value="1"/><default name="a" value="2"/><float name="x" value="$a"/>
<default name="a" value="1"/><float name="x" value="$a$ab-$abc"/> ~ {"ab": 5}
<float name="x" value="$a"/>
<float name="x" value="$a"/> ~ {"a": true, "b": 3}
<string value="\$a $"/>
<string value="$"/>
<default name="a"/>
<default value="3"/>
<a><b></a>
<include filename="part.xml"/>
<include filename="gone.xml"/>
<include/>
<shape type="sphere"><include filename="bsdf.xml" name="n"/></shape>
<include filename="bad.xml"/>
<include filename="self.xml"/>
<include filename="parts\more.xml"/>
<path value="parts"/><include filename="more.xml"/><string name="filename" value="more.xml"/>
<shape type="sphere"><path value="parts"/></shape>
<path value="gone"/>
<path/>
<string name="filename" value="parts\more.xml"/><string name="other" value="parts\more.xml"/>
<spectrum name="s" filename="parts/more.xml"/><spectrum name="s" filename="gone"/>
<integrator type="path"><boolean name="hideEmitters" value="TRUE"/></integrator>
<shape type="sphere"><integrator type="path"><boolean name="hide_emitters" value="true"/></integrator></shape>
<!-- <a> --><b/>
""".strip().split("\n")
    + ["<a>" * depth + "</a>" * depth for depth in (98, 99)]
)


@case
def descriptions_of_scenes(patch: Patch) -> Any:
    Path("parts").mkdir()
    inner = '<scene version="2.1"><float name="x" value="1"/><ref id="a"/><shape type="cube"/>{}</scene>'
    files = {"part.xml": inner.format('<include filename="parts/more.xml"/>'), "parts/more.xml": inner.format(""),
             "bsdf.xml": '<bsdf type="diffuse" name="m" version="3"/>', "bad.xml": "<a>", "self.xml": inner.format(
             '<include filename="self.xml"/>')}  # fmt: skip
    for name, text in files.items():
        Path(name).write_text(text)
    found = []
    for row in READ:
        text, _, given = row.partition(" ~ ")
        made = ending(described, text, "3.0.0", json.loads(given or "{}"))
        if not isinstance(made, str):
            shown = lines(made.root)
            folders = [os.path.relpath(folder) for folder in made.folders]
            versions = {os.path.relpath(file): version for file, version in made.files.items()}
            made = [len(shown) if len(shown) > 50 else shown, made.variables, made.hides_emitters, folders, versions]
        found.append([text[:80], made])
    for data in (b"\xef\xbb\xbf<scene/>", b"<scene a='\xe4'/>", "<scene a='ä'/>".encode(), b"", b"<scene/>x"):
        Path("scene.xml").write_bytes(data)
        made = ending(lambda: lines(read_description(Path("scene.xml"), {}).root))
        found.append([str(data), made])
    return found


@case
def elements_of_a_description(patch: Patch) -> Any:
    text = """<bsdf type="diffuse" id="a"><spectrum name="r" value="1"/><spectrum name="s" type="d65" id="d"/>
        <spectrum name="t" filename="f"/><string name="filename" value="g"/><string name="other" value="h"/></bsdf>
        <alias id="a" as="b"/><alias id="gone" as="c"/><shape type="sphere" id="ball"><ref id="b" name="n"/></shape>"""
    root = described(text).root
    known = {id: f"{each.tag} {each.id}" for id, each in root.by_id().items()}
    names = ("tag", "name", "value", "id", "type", "is_object", "is_value", "file_attribute", "place")
    rows = [[getattr(each, name) for name in names] for each in root.walk()]
    root.children[0].drop("r", "s")
    return known, rows, [each.tag for each in root.objects()], [each.tag for each in root.walk("ref", "string")], str(
        root.find("gone")), lines(root)  # fmt: skip


@case
def names_of_files(patch: Patch) -> Any:
    for name in ("a/b/c.png", "d/c.png", "e\\f.png", "a/e/f.png"):
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).touch()
    folders = [Path("a"), Path("d")]
    names = ("c.png", "b/c.png", "b\\c.png", "d/c.png", "d\\c.png", "e\\f.png", "gone\\c.png", "b", "x" * 300, "")
    return [[name[:20], str(read._find(name, folders)), read._with_slashes(name, folders)] for name in names]


SPECTRA: list[tuple[str, dict[str, str]]] = [
    *(("blackbody", {"temperature": each}) for each in ("5000", "0", "-1", "x", "", "nan", "1000 2000", "1")),
    *(("blackbody", {"temperature": "3000", "wavelength_min": low, "wavelength_max": high})
      for low, high in (("400", "412"), ("400", "400"), ("500", "400"), ("0", "400"), ("1", "1e9"))),
    ("blackbody", {}), ("blackbody", {"temperature": "3000", "wavelength_min": "825"}),
    *(("regular", {"values": each, "wavelength_min": "400", "wavelength_max": "700"})
      for each in ("1 2 3", "1", "", "1 -2", "0 0")),
    ("regular", {"values": "1 2"}), ("regular", {"values": "1 2", "wavelength_min": "400"}),
    *(("irregular", {"wavelengths": at, "values": each})
      for at, each in (("400 500", "1 2"), ("400 400", "1 2"), ("500 400", "1 2"), ("4 5 6", "1 2"), ("400", "1"))),
    ("irregular", {"wavelengths": "400 500"}), ("irregular", {"values": "1 2"}),
]  # fmt: skip


@case
def spectra_by_wavelength(patch: Patch) -> Any:
    owners = described('<emitter type="point"/><bsdf type="diffuse"/>').root.children
    found = []
    for type, parameters in SPECTRA:
        for owner in owners if parameters == SPECTRA[0][1] else owners[:1]:
            parts = [owner.new("string", name=name, value=value) for name, value in parameters.items()]
            made = ending(mend._by_wavelength, owner.new("spectrum", *parts, type=type), owner)
            text = made if isinstance(made, str) else made["value"]
            found.append([type, owner.tag, [*parameters.values()], len(text), text[:200]])
    return found


# ---- Checks before a scene is built ----

EYE = '<sensor type="perspective"/><emitter type="point"/>'
BALL = '<shape type="sphere">{}</shape>'
#: Contents of a sphere, and other contents, that are refused, changed or reported before a scene is built.
IN_BALL = """
<bsdf type="phong"/>
<bsdf type="nothing"/>
<bsdf type="sphere"/>
<bsdf/>
<bsdf type="diffuze"/>
<bsdf type="diffuse"><rgb name="reflectance" value="1 nan 1"/></bsdf>
<float name="radius" value="nan"/>
<string name="radius" value="nan"/>
<bsdf type="diffuse" id="nan"/>
<emitter type="sky"/>
<float name="radios" value="1"/>
<bsdf type="diffuse"><texture type="bitmap" name="reflectance"/></bsdf>
<bsdf type="diffuse"><texture type="bitmap" name="reflectance"><string name="filename" value="gone.png"/></texture></bsdf>
<bsdf type="diffuse"><texture type="bitmap" name="reflectance"><string name="filename" value="."/></texture></bsdf>
<bsdf type="diffuse"><ref id="t" name="reflectance"/></bsdf>
<ref id="gone"/>
<bsdf type="diffuse"/><bsdf type="diffuse"/>
""".strip().split("\n")  # noqa: E501
BESIDE_BALL = """
<film type="specfilm"/>
<sensor type="perspective"><spectrum name="srf" value="1"/></sensor>
<shape type="blender"/>
<shape/>
<shape type="obj"><string name="filename" value="a.obj"/></shape>
<shape type="obj"><string name="filename" value="b.obj"/></shape>
<texture type="checkerboard" id="t"/><bsdf type="diffuse"><ref id="t" name="reflectance"/></bsdf><bsdf type="diffuse"><ref id="t" name="reflectance"/></bsdf>
<texture type="checkerboard" id="t" name="q"/><alias id="t" as="u"/><bsdf type="diffuse"><ref id="t"/></bsdf>
<bsdf type="twosided" id="a"><ref id="b"/></bsdf><bsdf type="twosided" id="b"><ref id="a"/></bsdf>
<emitter type="constant"/><emitter type="constant"/><shape type="sphere"/>
""".strip().split("\n")  # noqa: E501
DEEP = ['<bsdf type="twosided">' * depth + '<bsdf type="diffuse"/>' + "</bsdf>" * depth for depth in (8, 9)]


@case
def checked_scenes(patch: Patch) -> Any:
    Path("a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl x y\nf 1 2 3\nusemtl z\nf 1 3 2\nusemtl x y\n")
    Path("b.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n" + "".join(f"usemtl {n}\nf 1 2 3\n" for n in range(5)))
    found = []
    for text in [*map(BALL.format, [*IN_BALL, *DEEP]), *BESIDE_BALL]:
        description = described(EYE + text)
        mend.mend(description, [])
        made = ending(build.build, description)
        if isinstance(made, str):
            found.append([text[:90], made])
        else:
            told = [[each.element.tag, each.wrong, each.done, each.level, str(each.owner)[:20]] for each in made[1]]
            shown = lines(description.root)[3:-1]
            found.append([text[:90], told, shown if len(shown) < 20 else 0])
    return found


@case
def sizes_of_films(patch: Patch) -> Any:
    sensor = '<sensor type="perspective"><film type="hdrfilm">{}</film></sensor>'
    number = '<integer name="{}" value="{}"/>'
    crop = number.format("crop_width", 3) + number.format("crop_height", 2) + number.format("crop_offset_x", 1)
    both = number.format("width", 8) + number.format("height", 6)
    found = []
    width, height, wrong = (number.format(*each) for each in (("width", 8), ("height", 6), ("width", "x")))
    for inside in ("", both, both + crop, width, height, wrong):
        for size in ((4, 4), (8, 6), (16, 12)):
            description = described(sensor.format(inside) * 2)
            sizes = ending(build.film_sizes, description)
            fault = ending(build.resize_films, description, size)
            resized = lines(description.root)[1:-1]
            build.restore_films(description)
            found.append([inside[:20], size, sizes, fault, resized, lines(description.root)[1:-1] == resized])
    return found


@case
def lines_of_mitsuba(patch: Patch) -> Any:
    said = [
        '2026-01-01 00:00:00 WARN  main [Mesh] "a.ply": no normals.', '2026 WARN main [Mesh] "b.ply": no normals',
        "INFO [x] hello", "2026 WARN  wrk2 [Scene] performance warning.", "WARN", "2026 WARN main [X] " + "long " * 60,
    ]  # fmt: skip
    notes = build._warnings_of_mitsuba(said, described("").root)
    return [[note.wrong, note.done, note.level] for note in notes]


# ---- Exported values and mended scenes, as text ----


@case
def exported_values(patch: Patch) -> Any:
    """For each parameter: the lines of the scene that differ after it was written, and the files of its values."""
    scene = made_room()
    params, found = mi.traverse(scene), {}
    known = catalog.list_parameters(params)
    for info in [each for each in known if each.obstacle is None or re.search(r"(to_world|position)$", each.key)]:
        description = read_description(Path("scene.xml"), {})
        mend.mend(description, [])
        before = lines(description.root)
        replacing = Replacing(description, params, "c.yaml")
        fault, after = ending(replacing.put, info.key), lines(description.root)
        gone, new = ([line for line in a if line not in b] for a, b in ((before, after), (after, before)))
        found[info.key] = [fault, gone, new, [*replacing.writers]]
    return found


BY_WAVELENGTH = f"""<sensor type="perspective">{FILM}</sensor>
<shape type="sphere" id="a"><bsdf type="conductor"><string name="material" value="Au"/></bsdf></shape>
<shape type="sphere" id="b"><bsdf type="diffuse"><spectrum name="reflectance" value="400:0.3, 700:0.5"/></bsdf></shape>
<shape type="sphere" id="c"><bsdf type="diffuse"><spectrum type="regular" name="reflectance">
<string name="values" value="0.1 0.2 0.3"/><float name="wavelength_min" value="400"/>
<float name="wavelength_max" value="700"/></spectrum></bsdf></shape>
<shape type="sphere" id="d"><bsdf type="roughconductor"><spectrum name="eta" value="400:0.3, 700:0.5"/>
<spectrum name="k" value="2"/></bsdf></shape>
<emitter type="point" id="lamp"><spectrum name="intensity" value="400:3, 700:5"/></emitter>
<emitter type="point" id="spot"><rgb name="intensity" value="1 2 3"/></emitter>
<emitter type="point" id="grey"><spectrum name="intensity" value="3"/></emitter>
<emitter type="point" id="day"><texture type="d65" name="intensity" id="light"><rgb name="color" value="0.2 0.9 0.4"/>
<float name="scale" value="3"/></texture></emitter>"""


@case
def exported_spectra(patch: Patch) -> Any:
    """Spectra by wavelength of surfaces, metals and lamps, in a spectral variant: as `exported_values`."""
    variant = mi.variant()
    mi.set_variant(with_wavelengths(variant))
    try:
        register()
        described(BY_WAVELENGTH)
        params = mi.traverse(load.load_scene(Path("scene.xml")))
        found: list[Any] = []
        for key in sorted(params.properties):
            if key.endswith((".values", ".value")):
                description = read_description(Path("scene.xml"), {})
                before, replacing = lines(description.root), Replacing(description, params, "c.yaml")
                fault = ending(replacing.put, key)
                found.append([key, fault, [line for line in lines(description.root) if line not in before]])
    finally:
        mi.set_variant(variant)
    return found


@case
def bitmaps_of_colours(patch: Patch) -> Any:
    """`raw` is removed from colours only. Colours need files of linear colours."""
    picture("rgb.exr", 2, 2, 3)
    picture("bytes.png", 2, 2, 3, kind=np.uint8)
    picture("grey.png", 2, 2, 1, kind=np.uint8)
    texture = '<texture type="bitmap" name="{}">{}<string name="filename" value="{}"/></texture>'
    found = []
    for name in ("reflectance", "roughness"):
        for file in ("rgb.exr", "bytes.png", "grey.png", "gone.png"):
            for raw in ("", '<boolean name="raw" value="true"/>', '<boolean name="raw" value="false"/>'):
                description = described(f'<bsdf type="diffuse" id="a">{texture.format(name, raw, file)}</bsdf>')
                fault = ending(mend.upsample_bitmaps, description)
                found.append([name, file, raw[27:31], fault, any("raw" in line for line in lines(description.root))])
    return found


@case
def raw_colours(patch: Patch) -> Any:
    """Colours that the scene calls raw stay as they are in variants of RGB."""
    picture("bytes.png", 2, 2, 3, kind=np.uint8)
    texture = '<texture type="bitmap" name="reflectance"><boolean name="raw" value="true"/>{}</texture>'
    file = '<string name="filename" value="bytes.png"/>'
    description = described(f'<bsdf type="diffuse">{texture.format(file)}</bsdf>')
    return ending(mend.mend, description, []), lines(description.root)


@case
def resized_films(patch: Patch) -> Any:
    """Films with other sizes and with crop windows, and a sensor without a film."""
    crop = '<film type="specfilm" id="f"><integer name="width" value="5"/><integer name="crop_width" value="2"/></film>'
    found = []
    for text in (f"<sensor type='perspective'>{FILM}</sensor><sensor type='thinlens'>{crop}</sensor>",
                 "<sensor type='perspective'/>"):  # fmt: skip
        description = described(text)
        build.resize_films(description, (7, 3))
        kept = [[child.name for child in sizes] for sizes in description.own_sizes.values()]
        found.append([lines(description.root), kept])
    return found


@case
def copied_files(patch: Patch) -> Any:
    """The scene is itself an export, so that its folder has a file of the same name as that of the recovered values."""
    params = mi.traverse(made_room())
    Path("recovered").mkdir()
    picture("recovered/floor.bsdf.reflectance.data.exr", 3, 4, 3)
    Path("../aside.exr").write_bytes(Path("rgb.exr").read_bytes())
    found = []
    for filename in ("rgb.exr", "recovered/floor.bsdf.reflectance.data.exr", "../aside.exr"):
        for keys in ((), ("floor.bsdf.reflectance.data",), ("sky.data", "quilt.vertex_color")):
            description = described(ROOM.replace("rgb.exr", filename).replace("grey.exr", filename))
            mend.mend(description, [])
            replacing = Replacing(description, params, "c.yaml")
            for key in keys:
                replacing.put(key)
            replacing.copy_assets()
            found.append([*replacing.writers, *(line for line in lines(description.root) if "filename" in line)])
    return found


OLD = """<sensor type="perspective"><film type="hdrfilm"/></sensor><emitter type="constant"/>{}"""
#: Elements of a sphere, and elements beside it.
INSIDE = """
<ref id="m"/></shape><bsdf type="roughplastic" id="m"><float name="intIOR" value="1.4"/></bsdf><shape type="cube">
<transform name="toWorld"><lookAt origin="0,0,1" target="0,0,0" up="0,1,0"/></transform>
<bsdf type="diffuse"><srgb name="reflectance" value="#ff8000"/></bsdf>
<bsdf type="diffuse"><spectrum name="reflectance" value="0.3"/></bsdf>
<bsdf type="diffuse"><spectrum name="reflectance" value="400:0.3 700:0.5"/></bsdf>
<bsdf type="conductor"/>
<bsdf type="ward"><float name="alphaU" value="0.2"/></bsdf>
<bsdf type="diffuse"><texture type="bitmap" name="reflectance"><string name="filename" value="a.png"/><float name="uscale" value="3"/></texture></bsdf>
<bsdf type="diffuse"><texture type="checkerboard" name="reflectance"><float name="vscale" value="3"/><float name="uoffset" value="1"/></texture></bsdf>
<bsdf type="diffuse"><texture type="bitmap" name="reflectance"><string name="wrapMode" value="clamp"/><float name="gamma" value="1"/></texture></bsdf>
<emitter type="area"><blackbody name="radiance" temperature="5000K"/></emitter>
<emitter type="area"><spectrum name="radiance" value="2"/><float name="samplingWeight" value="2"/></emitter>
<medium type="homogeneous" name="interior"/><bsdf type="null"/>
""".strip().split("\n")  # noqa: E501
BESIDE = """
<shape type="obj"><string name="filename" value="x/gone 1.obj"/><boolean name="faceNormals" value="true"/></shape>
<luminaire type="point"><point name="position" x="1"/><spectrum name="intensity" value="3"/></luminaire>
<emitter type="sunsky"/>
<emitter type="spot"><float name="cutoffAngle" value="3"/><spectrum name="intensity" value="3"/></emitter>
<shape type="sphere" id="a b"/><shape type="sphere" id="a.b"/><shape type="sphere" id="c"/>
<integrator type="volpath"><boolean name="hideEmitters" value="true"/></integrator>
<sensor type="perspective"><float name="nearClip" value="0.1"/><string name="fovAxis" value="x"/></sensor>
<sensor type="perspective"><sampler type="ldsampler"><integer name="sampleCount" value="4"/></sampler></sensor>
<shape type="serialized"><string name="filename" value="a.serialized"/><integer name="shapeIndex" value="1"/></shape>
""".strip().split("\n")


@case
def mended_scenes(patch: Patch) -> Any:
    picture("a.png", 2, 2, 3, kind=np.uint8)
    found = []
    texts = [*(f'<shape type="sphere">{text}</shape>' for text in INSIDE), *BESIDE]
    for version in ("0.5.0", "0.6.0", "3.0.0"):
        for text in texts:
            description = ending(described, OLD.format(text), version)
            notes = description if isinstance(description, str) else ending(mend.mend, description, [])
            if isinstance(notes, str):
                found.append([version, notes])
                continue
            told = [f"{note.element.tag}: {note.wrong}: {note.done} {note.level}" for note in notes]
            found.append([version, lines(description.root)[4:-1], told, description.hides_emitters])
    return found


test_cases = pytest.mark.usefixtures("llvm")(case.test())
