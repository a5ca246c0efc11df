"""Proposals of likely parameters for recovering a scene from a photograph. Parameters that are large in view come
first.

The module also reads the photograph's properties, and writes a copy with fewer pixels.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import yaml

from reslrb_cli.config.parameters import ParameterSpec, entry_of, tint_of
from reslrb_cli.lens.transport import resized
from reslrb_cli.records.images import write_bitmap
from reslrb_cli.scene.catalog import COLOUR, ROUGHNESS, ParameterInfo, list_parameters, owner_of
from reslrb_cli.scene.deformation import list_movable, where_moved
from reslrb_cli.scene.dispersion import COEFFICIENT
from reslrb_cli.scene.graph import SceneGraph
from reslrb_cli.scene.images import StoredImage
from reslrb_cli.scene.needs import surfaces_met
from reslrb_cli.scene.rays import grid, sensor_rays
from reslrb_cli.scene.response import decode_srgb
from reslrb_cli.scene.tints import tint_obstacle
from reslrb_cli.scene.values import COLOURS

Image = np.ndarray[Any, Any]

#: Lobes of `principled` and `principledthin` that a scene does not have if their weight is 0.
_LOBES = (
    *("anisotropic", "clearcoat", "diff_trans", "flatness", "metallic"),
    *("sheen", "sheen_tint", "spec_tint", "spec_trans"),
)


def write_smaller(photo: StoredImage, size: tuple[int, int], path: Path, is_raw: bool = False) -> None:
    """Write the photograph to `path` with fewer pixels. `size` is the new (width, height). Each new pixel is a mean of
    linear values. Integers are encoded in sRGB, or linear if the photograph `is_raw`.

    Integers become a PNG of 16 bits. A PNG pixel is clipped (at the maximum) if any photograph pixel within its area is
    clipped. A PNG pixel is transparent (alpha 0) if any photograph pixel within its area is transparent. Floats become
    an EXR, which keeps non-finite values. Raises OSError.
    """
    if is_raw and photo.white is None:
        pixels, kind = _means(photo.pixels, size), mi.Bitmap.PixelFormat.MultiChannel
        write_bitmap(path, mi.Bitmap(np.ascontiguousarray(pixels), kind, list(photo.names)))
        return
    photo = photo if is_raw else photo.in_srgb()
    colours, alpha = photo.colours(), photo.alpha()
    if photo.white is None:
        raw = colours if alpha is None else np.concatenate([colours, alpha[:, :, None]], axis=2)
        write_bitmap(path, mi.Bitmap(np.ascontiguousarray(_means(raw, size))))
        return
    values = colours.astype(np.float32) / np.float32(photo.white)
    linear = _means(values if is_raw else decode_srgb(values), size)
    clipped = _means(colours == photo.white, size) > 0
    encoded = mi.Bitmap(np.ascontiguousarray(linear, dtype=np.float32)).convert(
        component_format=mi.Struct.Type.UInt16, srgb_gamma=not is_raw
    )
    pixels = np.where(clipped, np.uint16(65535), np.array(encoded).reshape(linear.shape)).astype(np.uint16)
    if alpha is not None:
        opaque = (_means(alpha[:, :, None] == 0, size) == 0) * np.uint16(65535)
        pixels = np.concatenate([pixels, opaque.astype(np.uint16)], axis=2)
    bitmap = mi.Bitmap(np.ascontiguousarray(pixels))
    bitmap.set_srgb_gamma(not is_raw)
    write_bitmap(path, bitmap)


def _means(image: Image, size: tuple[int, int]) -> Image:
    """Resample an (H, W, C) image to `size` (width, height) by area-weighted means."""
    values = image.astype(np.float32)
    known = np.isfinite(values)
    if not known.all():  # otherwise NaN would spread over whole rows
        lost = _means(~known, size) > 0
        return np.where(lost, np.float32(np.nan), _means(np.where(known, values, 0), size))
    return np.asarray(resized(values, size[::-1]))


#: A rough surface without a diffuse lobe shows its material's colour; users do not choose its specular factor of 1 as a
#: colour.
_ROUGHNESS, _FACTOR = re.compile(r"\balpha(_u|_v)?\.value$"), re.compile(r"\bspecular_\w+\.value$")
#: Parameter that a visible lamp shows directly.
_RADIANCE = re.compile(r"\bradiance\.value$")

#: Bounds by the end of a key, and the quantity; the first match counts.
_BOUNDS = (
    (r"(reflectance|transmittance|base_color|color\d)\.(values?|data)$", "[0, 1]"),
    (r"\b(vertex|face)_\w*$", "[0, 1]"),
    (ROUGHNESS, "[0.02, 1]"),
    (r"\b(eta|k)\.(values?|data)$", "[0, 10]"),
    (r"\b(eta|nd)$", "[1.01, 3]"),
    (r"\bVd$", "[10, 100]"),
    (r"\b(radiance|irradiance|intensity)\.(values?|data)$", "[0, .inf]"),
    (r"^[^.]*\.(data|scale|sun_scale|sky_scale)$", "[0, .inf]"),
    (r"\bturbidity$", "[1, 10]"),
    (r"\.values?$|\.data$|\.specular$", "[0, 1]"),
)

#: Textures that are the index of a dielectric, by class and name. The `eta` of a metal is another quantity.
_INDICES = (("PrincipledThin", "eta"), ("PolarizedPlastic", "eta"))

#: Bounds of a glass's coefficient C in µm² with a pole in the ultraviolet.
_ULTRAVIOLET = "[0, 0.08]"

#: Rays per axis of the film, for measuring shares.
_RAYS = 64
#: Minimum share of the picture, and maximum number of parameters; the rest can be added later. A lamp needs few pixels.
LEAST_SHARE, LEAST_LAMP, MOST_FIRST = 0.02, 0.002, 8
#: A shape with a larger share of the picture is probably a floor or a wall.
MOST_MOVED = 0.5
#: Texels per axis of a recovered texture at the start.
TEXELS = 64


@dataclass(frozen=True)
class Proposal:
    """Parameter that could be recovered. `share` is the share of the picture that the parameter colours, or 0 if the
    parameter is not visible.

    A texture with a pattern is recovered by its tint (`is_tint`). `bounds` are YAML, or None. `resolution` is the
    (width, height) of a texture with many texels, or None. `first` is true if the parameter is recovered by default.
    """

    info: ParameterInfo
    share: float
    bounds: str | None
    resolution: tuple[int, int] | None
    first: bool
    is_tint: bool = False

    @property
    def key(self) -> str:
        """Name of the recovered parameter: the key of `info`, or the name of its tint."""
        return tint_of(self.info.key) if self.is_tint else self.info.key


def propose(scene: mi.Scene, sensor: int, lamps: bool = False) -> list[Proposal]:
    """Return the recoverable parameters of `scene`, seen through the sensor with this index. Mesh vertices are
    excluded.

    They are sorted by their shares. The parameters recovered by default are those that are large in view. Lamps are
    also recovered by default if the photograph shows the lamps' brightness (`lamps`). At least one parameter is
    recovered by default if the scene has any recoverable parameter.
    """
    params = mi.traverse(scene)
    shares = _shares(scene, sensor)
    found, smooth = [], set[str]()
    for info in list_parameters(params, values=True):
        is_kind = info.kind in ("bsdf", "emitter", "attribute")
        if info.obstacle is None and is_kind and not _is_left_out(params, info):
            chain = _above(params, info.key)
            found.append((info, max((shares.get(item, 0.0) for item in chain), default=0.0)))
            bsdfs = [item for item in chain if isinstance(item, mi.BSDF)]
            if bsdfs and not any(int(bsdf.flags()) & int(mi.BSDFFlags.Smooth) for bsdf in bsdfs):
                smooth.add(info.key)
    found.sort(key=lambda pair: -pair[1])
    keys = [info.key for info, _ in found]
    # A mask excludes pixels that see mirrors and smooth glass, so only materials that other pixels show are proposed.
    shown = [info for info, share in found if share >= LEAST_SHARE and info.key not in smooth]
    # The scene knows a texture with a pattern, and noise would replace it.
    patterns = {info.key for info, _ in found if is_pattern(params, info)}
    shown = [info for info in shown if info.key not in patterns]
    tinted = {key for key in patterns if COLOURS.search(key) and tint_obstacle(params, key) is None}
    seen = {info.key for info in shown if _is_foremost(params, info)}
    if lamps:
        seen |= {info.key for info, share in found if share >= LEAST_LAMP and _RADIANCE.search(info.key)}
    placed = {moved.key for moved in where_moved(params, keys)}  # recovered by a motion
    emitters = [info.key for info, _ in found if info.kind == "emitter" and info.key not in placed]
    first = [key for key in keys if key in seen][:MOST_FIRST] or emitters[:1] or keys[:1]
    return [
        Proposal(info, share, bounds_of(params, info, is_tint), None if is_tint else _resolution(info),
                 info.key in first, is_tint)
        for info, share in found for is_tint in [info.key in tinted]
    ]  # fmt: skip


def is_pattern(params: mi.SceneParameters, info: ParameterInfo) -> bool:
    """True if the texels of a texture differ."""
    texels = np.array(params[info.key]) if len(info.shape) == 3 else np.zeros((1, 1, 1))
    return bool((texels != texels[:1, :1]).any())


def find_movable_in_view(scene: mi.Scene, sensor: int) -> list[tuple[str, float, str, str]]:
    """Return the ids of the shapes that can be moved, their shares of the picture, the names of their files, or "", and
    their free motions. Only a texture would show how a sphere turns. Larger shares come first. Shapes that fill most of
    the picture are left out, and so are shapes that enclose the scene.
    """
    params, shares = mi.traverse(scene), _shares(scene, sensor)
    items = [item for item in list_movable(params) if item.casts_edges(scene)]
    found = [(item.id, shares.get(item.node, 0.0), _file_name(item.node),
              "translation" if item.node.class_name() == "Sphere" else "translation, rotation")
             for item in items]  # fmt: skip
    return sorted((row for row in found if LEAST_SHARE <= row[1] < MOST_MOVED), key=lambda row: -row[1])


def _file_name(shape: mi.Shape) -> str:
    """Return the name of a mesh's file, or "". Mitsuba tells it only in the description of the shape."""
    name = re.search(r'^  name = "(.+\.\w+)",$', str(shape), re.MULTILINE)
    return name[1] if name else ""


def _is_foremost(params: mi.SceneParameters, info: ParameterInfo) -> bool:
    """True if a surface parameter is the surface's most visible parameter: its colour, or a metal's roughness."""
    bsdf = next((item for item in _above(params, info.key) if isinstance(item, mi.BSDF)), None)
    diffuse = int(mi.BSDFFlags.DiffuseReflection) | int(mi.BSDFFlags.DiffuseTransmission)
    is_glossy = bsdf is not None and int(bsdf.flags()) & diffuse == 0
    if is_glossy and _ROUGHNESS.search(info.key):
        return True
    if is_glossy and _FACTOR.search(info.key) and info.value is not None and info.value.low == info.value.high == 1:
        return False
    return bool(COLOUR.search(info.key)) and (info.value is None or info.value.high > 0)  # a lamp's material is black


def _is_left_out(params: mi.SceneParameters, info: ParameterInfo) -> bool:
    """True for the weight of a lobe that the scene does not have. Users can still recover it."""
    owner, name = params.hierarchy[params.properties[info.key][2]][0], info.key.split(".")[-2]
    is_principled = owner is not None and owner.class_name().startswith("Principled")
    return is_principled and name in _LOBES and info.value is not None and info.value.high == 0


def _above(params: mi.SceneParameters, key: str) -> list[Any]:
    """Return the object that has the parameter `key`, and all objects above that object except the scene."""
    node: Any = params.properties[key][2]
    chain: list[Any] = []
    kinds = (mi.BSDF, mi.Emitter)
    while node is not None and not isinstance(node, mi.Scene):
        # A material belongs to all shapes that use it, and each has its share; a lamp may have a back.
        if isinstance(node, kinds) or not any(isinstance(item, kinds) for item in chain):
            chain.append(node)
        node = params.hierarchy[node][0]
    return chain


def _shares(scene: mi.Scene, index: int) -> dict[Any, float]:
    """Return the visible share of the picture for each BSDF, shape and emitter.

    An object's share is the fraction of the sensor's rays that meet this object first. Rays also pass mirrors and clear
    glass. A material does not count where it is seen from its black back.
    """
    sensor = scene.sensors()[index]
    # One for each ray: an irradiance meter would give one direction for a single ray, which Dr.Jit fails to compile.
    aperture = dr.opaque(mi.Point2f, 0.5, shape=_RAYS**2)
    ray, _ = sensor_rays(sensor, sensor.shutter_open(), grid(_RAYS), aperture)
    graph, smooth = SceneGraph.of(scene), dr.zeros(mi.Bool, _RAYS**2)
    shares: dict[Any, float] = {}
    for si, reached in surfaces_met(scene, ray, dr.full(mi.Bool, True, _RAYS**2), mi.PCG32(_RAYS**2)):
        active = reached & ~smooth  # a mask counts, but nothing behind it
        emitter = si.emitter(scene, active)  # an area light has a back
        shining = dr.select(dr.any(emitter.eval(si, active) > 0), emitter, dr.zeros(mi.EmitterPtr))
        flags = si.bsdf().flags()
        lit = active & ((mi.Frame3f.cos_theta(si.wi) > 0) | mi.has_flag(flags, mi.BSDFFlags.BackSide))
        bsdf = dr.select(lit, si.bsdf(), dr.zeros(mi.BSDFPtr))
        for pointers, kind, items in (
            (bsdf, mi.BSDFPtr, graph.surface_bsdfs()),
            (dr.select(active, si.shape, dr.zeros(mi.ShapePtr)), mi.ShapePtr, graph.shapes()),
            (shining, mi.EmitterPtr, scene.emitters()),
        ):
            numbers = np.bincount(np.array(dr.reinterpret_array(mi.UInt32, pointers)))
            for item in items:
                own = int(np.array(dr.reinterpret_array(mi.UInt32, kind(item)))[0])
                more = float(numbers[own]) / _RAYS**2 if own < len(numbers) else 0.0
                shares[item] = min(shares.get(item, 0.0) + more, 1.0)
        smooth = smooth | (active & mi.has_flag(flags, mi.BSDFFlags.Smooth))
        dr.schedule(smooth)
    for bsdf in graph.of_type(mi.BSDF):  # nested BSDFs are visible together with their parent
        shares[bsdf] = max((shares.get(owner, 0.0) for owner in graph.owning_bsdfs(bsdf)), default=0.0)
    return shares


def spec_of(key: str, bounds: str | None = None) -> ParameterSpec:
    """Return the entry of `parameters` that recovers `key` within the `bounds` of `bounds_of`. `key` may be the name of
    a tint.
    """
    option, name = entry_of(key)
    return ParameterSpec.model_validate({option: name, "bounds": None if bounds is None else yaml.safe_load(bounds)})


def bounds_of(params: mi.SceneParameters, info: ParameterInfo, is_tint: bool) -> str | None:
    """Return the usual bounds of a parameter as YAML, or None. Those of its tint keep the texels within the bounds."""
    bounds = usual_bounds(info, owner_of(params, info.key))
    if not is_tint or bounds is None:
        return bounds
    low, high = yaml.safe_load(bounds)
    return f"[{low}, {high / info.value.high:.4g}]" if info.value is not None and np.isfinite(high) else "[0, .inf]"


def usual_bounds(info: ParameterInfo, owner: tuple[str, str] = ("", "")) -> str | None:
    """Return the usual bounds of a parameter as YAML, or None. `owner` is that of `catalog.owner_of`."""
    text = (
        "[1.01, 3]"
        if owner in _INDICES
        else next((bounds for pattern, bounds in _BOUNDS if re.search(pattern, info.key)), None)
    )
    if (name := COEFFICIENT.search(info.key)) and info.value is not None:
        # The index stays above 1, and the poles stay outside of the visible wavelengths.
        value = info.value.mean
        text = _ULTRAVIOLET if name[1] == "C" and value < 0.1 else f"[{value / 2:.4g}, {2 * value:.4g}]"
    if text is None or info.value is None:
        return text
    low, high = (np.float32(word.strip(" []").replace(".inf", "inf")) for word in text.split(","))
    return text if low <= info.value.low and info.value.high <= high else None


def _resolution(info: ParameterInfo) -> tuple[int, int] | None:
    if len(info.shape) != 3 or max(info.shape[:2]) <= TEXELS:
        return None
    height, width = info.shape[:2]
    scale = TEXELS / max(height, width)
    return max(round(width * scale), 3), max(round(height * scale), 3)
