"""Catalogue of a scene: its parameters, whether they can be recovered, and the contents for `reslrb inspect`.

The caller prints them.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Container, Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.scene.deformation import BEAMS, PLACES, list_movable, moving_obstacle
from reslrb_cli.scene.graph import SceneGraph
from reslrb_cli.scene.needs import (
    PrimaryHits,
    look,
    paths_obstacle,
    unsupported_part,
)
from reslrb_cli.scene.upsampling import colour_in_scene, is_upsampled

#: Spectra by wavelength, which RGB variants cannot evaluate: there, their numbers only describe the scene file.
_SPECTRA = ("RegularSpectrum", "IrregularSpectrum", "BlackBodySpectrum")
#: Parameters of a mesh besides attributes such as `vertex_color`.
_MESH_GEOMETRY = ("vertex_positions", "vertex_normals", "vertex_texcoords", "vertex_count", "face_count", "faces")
#: Colours of materials, in which a photograph usually differs most from a scene.
COLOUR = re.compile(r"(reflectance|base_color|color\d|vertex_color)(\.(value|data|tint))?$")
#: Roughness of a material.
ROUGHNESS = re.compile(r"\b(alpha\w*|\w*roughness)(\.(value|data))?$")
#: Uniform emission of lamps.
EMISSION = re.compile(r"\b(radiance|irradiance|intensity)(\.values?)?$")
#: Ranges at whose ends Mitsuba's derivative is not that of the image, by the class of the BSDF and the name of the
#: parameter. At the ends Mitsuba leaves a lobe out, differentiates a square root or a ratio at 0, or divides by 0.
_OPEN: dict[str, dict[str, tuple[float, float]]] = {
    "Principled": {"spec_trans": (0, 1), "metallic": (-np.inf, 1), "clearcoat": (0, np.inf), "sheen": (0, np.inf),
                   "base_color": (0, np.inf), "specular": (0, np.inf)},
    "PrincipledThin": {"spec_trans": (0, 1), "diff_trans": (0, 2), "sheen": (0, np.inf), "base_color": (0, np.inf)},
    "SmoothPlastic": {"diffuse_reflectance": (0, np.inf), "specular_reflectance": (0, np.inf)},
    "BlendBSDF": {"weight": (0, 1)},
    "MaskBSDF": {"opacity": (0, 1)},
    "SmoothConductor": {"eta": (0, np.inf), "k": (0, np.inf)},
    "RoughConductor": {"eta": (0, np.inf), "k": (0, np.inf)},
    "Hair": {"longitudinal_roughness": (0, np.inf), "azimuthal_roughness": (0, np.inf)},
}  # fmt: skip
#: Distance from such a bound. Paths find a lobe of this weight, and images do not show it.
MARGIN = 1e-3
#: Parameters without effect while a weight is 0, by class and name of the parameter.
_WEIGHTS = {
    ("Principled", "clearcoat_gloss"): "clearcoat",
    ("Principled", "sheen_tint"): "sheen",
    ("PrincipledThin", "sheen_tint"): "sheen",
    **{("PrincipledThin", name): "spec_trans" for name in ("eta", "anisotropic", "spec_tint")},
    **{(kind, "k"): "eta" for kind in ("SmoothConductor", "RoughConductor")},
}
#: Pigments of hair, which an absorption replaces.
_MELANINS = {("Hair", "eumelanin"), ("Hair", "pheomelanin")}
#: Parameters that only change polarised light, by class and name.
_POLARISED = {("LinearPolarizer", "theta"), ("LinearRetarder", "theta"), ("LinearRetarder", "delta")}
#: Maximum number of printed values; larger arrays show mean and range.
_FEW = 4


@dataclass(frozen=True)
class Value:
    """Current value of a parameter: its `mean`, its minimum, its maximum, and its `numbers` if there are few."""

    numbers: list[float] | None
    mean: float
    low: float
    high: float


@dataclass(frozen=True)
class ParameterInfo:
    """Entry of `mi.traverse`.

    - `kind` is the type of the object that has the parameter: `bsdf`, `emitter`, `attribute` (of a mesh, such as
        `vertex_color`), `shape`, `sensor`, `film`, `medium`, `integrator` or `scene`.
    - `type` and `shape` describe the value. The shape of a texture is (height, width, channels).
    - `obstacle` is the reason why the parameter cannot be recovered, or None if the parameter can be recovered.
    - `value` is None if the value is not a number.
    - `bits` is the number of bits per texel if Mitsuba's precision is too low for gradients. Otherwise, `bits` is None.
        A texture with too low precision must be read as floating point (`keys` of `load_scene`).
    """

    key: str
    kind: str
    type: str
    shape: tuple[int, ...]
    differentiable: bool
    discontinuous: bool
    obstacle: str | None
    value: Value | None = None
    bits: int | None = None

    @property
    def remark(self) -> str | None:
        """Remark for users who want to recover it."""
        return None if self.bits is None else f"{self.bits} bits, read as floats if recovered"


def list_parameters(params: Any, values: bool = False) -> list[ParameterInfo]:
    """Describe every entry of a `mi.traverse` result in order, with its value if `values` is set."""
    infos = [describe(params, key, values) for key in params.properties]
    return [replace(info, obstacle=info.obstacle or unused(params, info.key)) for info in infos]


def unused(params: Any, key: str, recovered: Container[str] = ()) -> str | None:
    """Return the reason why a parameter has no effect at the scene's values, or None if it has an effect. Weights in
    `recovered` leave 0.
    """
    owner, node, names = owner_of(params, key), params.properties[key][2], key.split(".")
    start = ".".join(names[: -1 if isinstance(node, mi.BSDF) else -2])
    if owner == ("SpotLight", "texture") and not node.is_spatially_varying():
        return f"has no effect, because Mitsuba only reads images there; recover `{start}.intensity` instead"
    if owner in _MELANINS and any(other.startswith(f"{start}.sigma_a.") for other in params.properties):
        return f"has no effect, because the scene file gives `sigma_a`; recover `{start}.sigma_a` instead"
    weight = _WEIGHTS.get(owner)
    if weight is None:
        return None
    others = [other for other in params.properties if other.startswith(f"{start}.{weight}.")]
    zero = all(np.all(as_numbers(entry_value(params, other)) == 0) for other in others)
    if not zero or any(other in recovered for other in others):
        return None
    return f"has no effect while `{start}.{weight}` is 0; give it a positive value in the scene file, or recover both"


def describe(params: Any, key: str, values: bool = False) -> ParameterInfo:
    """Describe one entry of a `mi.traverse` result, with its value if `values` is set."""
    value, node, flags = entry_value(params, key), params.properties[key][2], int(params.flags(key))
    differentiable = flags & (int(mi.ParamFlags.NonDifferentiable) | int(mi.ParamFlags.ReadOnly)) == 0
    kind, bits = parameter_kind(params, key), coarse_bits(params, key)
    return ParameterInfo(
        key=key,
        kind=kind,
        type=type(value).__name__,
        shape=value_shape(value, halo(node, value)),
        differentiable=differentiable,
        discontinuous=flags & int(mi.ParamFlags.Discontinuous) != 0,
        obstacle=_wrong_derivative(params, key) or _obstacle(kind, key, value, differentiable, node, bits),
        value=_current_value(params, key) if values else None,
        bits=bits,
    )


def owner_of(params: Any, key: str) -> tuple[str, str]:
    """Return the class of the object to which a parameter belongs, and the parameter's name there.

    A texture or spectrum belongs to the object that uses it: `ball.bsdf.sheen.value` is the `sheen` of a Principled.
    """
    node, names = params.properties[key][2], key.split(".")
    if isinstance(node, mi.Texture) and len(names) > 1:
        node, names = params.hierarchy[node][0], names[:-1]
    return node.class_name(), names[-1]


def open_domain(params: Any, key: str) -> tuple[float, float]:
    """Return the range in which a parameter has a derivative, a `MARGIN` inside of its bounds. The range is infinite
    where Mitsuba's derivative is right at the bound.
    """
    kind, name = owner_of(params, key)
    low, high = _OPEN.get(kind, {}).get(name, (-np.inf, np.inf))
    return low + MARGIN, high - MARGIN


def coarse_bits(params: Any, key: str) -> int | None:
    """Return the bits of a texel of the bitmap `key` if there are fewer than 32, otherwise None."""
    if not key.endswith("data") or not params.properties[key][2].class_name().startswith("BitmapTexture"):
        return None
    bits = _storage_bits(entry_value(params, key))
    return bits if bits is not None and bits < 32 else None


def halo(node: Any, value: Any) -> int:
    """Return the number of columns that Mitsuba adds at each side of a texture. An `envmap` gets one.

    These columns are copies of the columns at the opposite side.
    """
    is_texture = value is not None and dr.is_tensor_v(value) and len(value.shape) == 3
    return 1 if is_texture and node.class_name() == "EnvironmentMapEmitter" else 0


def value_shape(value: Any, halo: int = 0) -> tuple[int, ...]:
    """Return the shape that a parameter has as a NumPy array, without its `halo`. A single number, or a missing value,
    has shape ().
    """
    if value is None or not dr.is_array_v(value):
        return ()
    shape = tuple(int(n) for n in dr.shape(value))
    if halo:
        return (shape[0], shape[1] - 2 * halo, *shape[2:])
    return shape if dr.is_tensor_v(value) or shape[-1:] != (1,) else shape[:-1]


def _current_value(params: Any, key: str) -> Value | None:
    """Return the value of one `mi.traverse` entry, or None if the value is no number."""
    value = entry_value(params, key)
    array = colour_in_scene(params, key) if is_upsampled(params, key) else as_numbers(value)
    if array is None or array.size == 0:
        return None
    if array.dtype == np.uint8 and coarse_bits(params, key) is not None:
        # Lookups divide an 8-bit texture by 255, and decode it from sRGB unless it is raw.
        levels = mi.Float(np.arange(256, dtype=np.float32) / 255)
        is_raw = re.search(r"^ *raw = 1,$", str(params.properties[key][2]), re.MULTILINE)
        array = np.array(levels if is_raw else dr.srgb_to_linear(levels))[array]
    columns = halo(params.properties[key][2], value)
    array = array[:, columns : array.shape[1] - columns] if columns else array
    numbers = [float(number) for number in array.ravel()] if array.size <= _FEW else None
    return Value(numbers, float(array.mean(dtype=np.float64)), float(array.min()), float(array.max()))


def as_numbers(value: Any) -> np.ndarray | None:
    """Return a parameter's value as an array, or None if it is no number. A transform becomes its matrix."""
    try:
        array = np.asarray(value.matrix if "AffineTransform" in type(value).__name__ else value)
    except (RuntimeError, TypeError):
        return None
    return array if array.dtype.kind in "buif" else None


def entry_value(params: Any, key: str) -> Any:
    """Return the value of a `mi.traverse` entry, or None for a missing value such as an optional texture.

    `params[key]` cannot replace the function. `params[key]` would mark every entry as changed for `update()`, and fails
    for missing values.
    """
    value, value_type, node, _ = params.properties[key]
    return value if value_type is None else params.get_property(value, value_type, node)


def parameter_kind(params: Any, key: str) -> str:
    """Return the owner type of a `mi.traverse` entry (`ParameterInfo.kind`)."""
    node, name = params.properties[key][2], key.rpartition(".")[2]
    is_attribute = name.startswith(("vertex_", "face_")) and name not in _MESH_GEOMETRY
    while node is not None:
        for kind in ("BSDF", "Emitter", "Shape", "Sensor", "Film", "Medium", "Integrator"):
            if isinstance(node, getattr(mi, kind)):
                return "attribute" if is_attribute and isinstance(node, mi.Mesh) else kind.lower()
        node = params.hierarchy[node][0]
    return "scene"


def _wrong_derivative(params: Any, key: str) -> str | None:
    """Return the reason why a derivative that Mitsuba offers cannot be used, or None."""
    kind, name = owner_of(params, key)
    if (kind, name) in _POLARISED and not mi.is_polarized:
        return "only changes polarised light, which this variant does not trace"
    node: Any = params.properties[key][2]
    while (kind, name) == ("Principled", "spec_trans") and node is not None:
        if node.class_name() == "TwoSidedBRDF":
            return "lets light through a `twosided` BSDF, which Mitsuba does not load; remove the `twosided`"
        node = params.hierarchy[node][0]
    return None


def _obstacle(kind: str, key: str, value: Any, differentiable: bool, node: Any, coarse: int | None) -> str | None:
    only = "only materials, emission, shapes and lights have derivatives"
    id, _, name = key.rpartition(".")
    if kind == "shape" or (kind == "emitter" and name in PLACES):
        if kind == "shape" and name not in ("to_world", "vertex_positions"):
            return "belongs to a shape, which has vertices and motions to recover"
        if (reason := moving_obstacle(node, name)) is not None:
            return f"cannot be moved ({reason})"
        return f"is recovered as a motion (`motion: {{of: {id}}}`)" if name == "to_world" else None
    if kind in ("sensor", "film"):
        return f"belongs to the {kind}; {only}"
    if mi.is_spectral and (reason := _spectral_obstacle(node, key)) is not None:
        return reason
    if not mi.is_spectral and node.class_name() in _SPECTRA:
        return "is a constant of a spectrum; give the colour as <rgb>"
    if value is None:
        return "is not in the scene file"
    if kind not in ("bsdf", "emitter", "attribute"):
        return f"is not a property of a material or a light; {only}"
    if kind == "emitter" and name in BEAMS:
        return f"{BEAMS[name]}; only the emission of an emitter has derivatives"
    if coarse is not None:  # not differentiable only for that reason
        return None
    bits = _storage_bits(value)
    if bits is not None and bits < 32:
        return f"is stored with {bits} bits per channel, too few to follow a gradient"
    if not differentiable:
        return f"is not differentiable ({node.class_name()})"
    return f"is not a number with derivatives ({type(value).__name__})" if bits is None else None


def _spectral_obstacle(node: Any, key: str) -> str | None:
    """Return the reason why a parameter cannot be recovered in a spectral variant, or None."""
    kind, name = node.class_name(), key.rpartition(".")[2]
    if key.endswith(".d65.values"):
        return f"belongs to the colour `{key.removesuffix('.d65.values')}.value`, if the scene gives one, such as <rgb>"
    if kind == "IrregularSpectrum" and name == "wavelengths":
        return "has the wavelengths of a spectrum; its `values` have derivatives"
    if kind == "BlackBodySpectrum":
        return (
            "is the temperature of a black body; give the light as a `regular` spectrum, whose values have derivatives"
        )
    if kind == "EnvironmentMapEmitter" and name == "data":
        return "has the spectra of an environment map; recover it in an RGB variant"
    if isinstance(node, mi.Mesh) and name.startswith(("vertex_", "face_")) and name not in _MESH_GEOMETRY:
        return "has the colours of a mesh, whose spectra have no derivatives; use a bitmap, or an RGB variant"
    return None


def _storage_bits(value: Any) -> int | None:
    """Return the number of bits per entry of a JIT array that could be a parameter. For other values, return None."""
    bits = {dr.VarType.UInt8: 8, dr.VarType.Float16: 16, dr.VarType.Float32: 32, dr.VarType.Float64: 64}
    is_number = dr.is_jit_v(value) and dr.is_arithmetic_v(value) and not dr.is_matrix_v(value)
    return bits.get(dr.type_v(value)) if is_number else None


@dataclass(frozen=True)
class SensorSummary:
    """Sensor with its film in pixels, and its view. `crop` is offset and size.

    `obstacle` is the reason why light tracing cannot render the scene for the sensor, or None. `camera_obstacle` is the
    reason why camera paths (`prb`) cannot render the scene for the sensor, or None. `view` is None if an unsupported
    part of the scene is the reason.
    """

    index: int
    id: str
    type: str
    film: str
    size: tuple[int, int]
    crop: tuple[tuple[int, int], tuple[int, int]]
    filter: str
    channels: int
    view: PrimaryHits | None
    obstacle: str | None
    camera_obstacle: str | None


@dataclass(frozen=True)
class SceneSummary:
    """Contents of a scene: class names with counts, sensors, all parameters, and movable objects.

    `movable` has the `id` of each shape or emitter, and `by`, the parameters that can move it: `motion`, `heightmap`.
    """

    emitters: dict[str, int]
    bsdfs: dict[str, int]
    shapes: dict[str, int]
    triangles: int
    sensors: list[SensorSummary]
    parameters: list[ParameterInfo]
    movable: list[dict[str, Any]]


def summarise(scene: Any, hide_emitters: bool = False) -> SceneSummary:
    """Return the contents of `scene`."""
    graph, params = SceneGraph.of(scene), mi.traverse(scene)
    shapes = graph.shapes()
    return SceneSummary(
        emitters=_count(scene.emitters()),
        bsdfs=_count(graph.of_type(mi.BSDF)),
        shapes=_count(shapes),
        triangles=sum(int(shape.face_count()) for shape in shapes if shape.is_mesh()),
        sensors=[_sensor(scene, index, hide_emitters) for index in range(len(scene.sensors()))],
        parameters=list_parameters(params, values=True),
        movable=[
            {"id": item.id, "by": ["motion"] if item.heightmap_obstacle() else ["motion", "heightmap"]}
            for item in list_movable(params)
        ],
    )


def _count(objects: Sequence[Any]) -> dict[str, int]:
    return dict(Counter(item.class_name() for item in objects).most_common())


def _sensor(scene: Any, index: int, hide_emitters: bool) -> SensorSummary:
    sensor = scene.sensors()[index]
    film = sensor.film()
    return SensorSummary(
        index=index,
        id=sensor.id(),
        type=sensor.class_name(),
        film=film.class_name(),
        size=_pair(film.size()),
        crop=(_pair(film.crop_offset()), _pair(film.crop_size())),
        filter=film.rfilter().class_name(),
        channels=int(film.base_channels_count()),
        view=look(scene, sensor) if unsupported_part(scene, sensor) is None else None,
        obstacle=paths_obstacle(scene, sensor, "light", hide_emitters),
        camera_obstacle=paths_obstacle(scene, sensor, "prb"),
    )


def _pair(values: Any) -> tuple[int, int]:
    return int(values[0]), int(values[1])
