"""Features that light tracing of a scene needs, and scene parts that light paths or camera paths do not support."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import permutations, product
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.errors import UnsupportedScene
from reslrb_cli.scene.dispersion import GLASS_CLASS
from reslrb_cli.scene.graph import Lamp, SceneGraph, bent_faces, bounds, face_normals, small_lamps, triangles
from reslrb_cli.scene.rays import emitted_rays, failure, grid, sensor_rays

#: Sensors to which light paths can connect: they have `sample_direction`, with the density of `sample_ray`.
SENSORS = ("PerspectiveCamera", "ThinLensCamera")
#: Shapes with equal shading and geometric normals.
_PLAIN_SHAPES = ("Rectangle", "Disk", "Sphere", "Cylinder")

_SIMPLE_BSDFS = (
    *("SmoothDiffuse", "SmoothConductor", "RoughConductor", "SmoothDielectric", "RoughDielectric", "ThinDielectric"),
    *("TwoSidedBRDF", "Null", GLASS_CLASS),
)
#: BSDFs that read only texture coordinates and local directions of a surface.
_PLAIN_BSDFS = (
    *_SIMPLE_BSDFS,
    "SmoothPlastic",
    "RoughPlastic",
    "Principled",
    "PrincipledThin",
    "BlendBSDF",
    "MaskBSDF",
)
#: BSDFs whose samples have the derivative of the sampled function (`transport.bsdf.following`), and BSDFs that only
#: wrap others.
_FOLLOWED_BSDFS = (*_SIMPLE_BSDFS, "BumpMap", "NormalMap")
#: Texture classes that read only texture coordinates.
_PLAIN_TEXTURES = re.compile(r"BitmapTexture.*|.*Spectrum|Checkerboard")
#: Rounding error of a depth between the clip planes, in 0 to 1.
_DEPTH_ROUNDING = 1e-5
#: Classes of BSDFs that are not symmetric: camera paths evaluate them as intended, light paths do not.
_ONE_WAY = {"Hair": "hair", "Measured": "measured", "MeasuredPolarized": "measured_polarized"}
#: Shapes on which Mitsuba cannot sample points: light cannot start there, but paths from the sensor find it.
_NO_POINTS = {"SDFGrid": "sdfgrid", "Ellipsoids": "ellipsoids", "EllipsoidsMesh": "ellipsoidsmesh"}
#: Shapes that Mitsuba does not allow to emit.
_NO_LAMPS = {"BSplineCurve": "bsplinecurve", "LinearCurve": "linearcurve"}
_MEDIUM = (
    " a participating medium; no integrator here supports media (nor do Mitsuba's prb, path and ptracer): remove it "
    "from the scene file"
)
#: Maximum number of surfaces along a primary ray in `surfaces_met`.
CROSSINGS = 32
#: Primary rays per side of the grid that samples a scene.
LOOK = 128


@dataclass(frozen=True)
class SceneNeeds:
    """Static facts of a scene for one sensor. Features that are false or absent need not be compiled.

    `emitters` holds the class names of the lit emitters, in the order of `scene.emitters()`. `environment` is the class
    name of the surrounding emitter, or None.

    `near_clip` tells whether an object may be between the sensor and its near clip plane. `lens_clip` tells whether a
    thin lens may see objects outside of its clip planes, or nothing because of its focus. `disperses` tells whether a
    smooth boundary refracts each wavelength into another direction.
    """

    emitters: tuple[str, ...]
    environment: str | None
    has_visible_emitters: bool
    has_glossy: bool
    has_delta_lobes: bool
    has_null: bool
    has_instances: bool
    has_shading_normals: bool
    has_perturbed_normals: bool
    bsdfs_read_geometry: bool
    disperses: bool
    moving_shutter: bool
    thin_lens: bool
    principal_point: bool
    near_clip: bool
    lens_clip: bool
    unfollowed: tuple[mi.BSDF, ...] = ()  # BSDFs of surfaces whose sampling cannot be differentiated
    blends: tuple[mi.BSDF, ...] = ()  # BSDFs of surfaces with a blend of singular and smooth lobes
    # BSDFs of surfaces that are masks, with their opacity, and BSDFs with a mask nested in them, with None.
    masks: tuple[tuple[mi.BSDF, mi.Texture | None], ...] = ()
    null_halves: tuple[mi.BSDF, ...] = ()  # blends without masks, and masks over a BSDF with null lobes
    lamps: tuple[Lamp, ...] = ()  # shapes that emit
    small_lamps: tuple[Lamp, ...] = ()  # emitting shapes smaller than a pixel in view


@dataclass(frozen=True)
class PrimaryHits:
    """Surfaces that primary rays meet after they pass see-through surfaces. `smooth`, `specular` and `nothing` are
    fractions of the film that sum to 1.

    `smooth` surfaces can be connected to the sensor by light paths. `specular` surfaces are only smooth specular
    (glass, mirrors), and stay black. `nothing` is no surface. `emission` is the fraction of the film with a directly
    visible emitter. `emission` overlaps with the other fractions.
    """

    smooth: float
    specular: float
    nothing: float
    emission: float


def scene_needs(scene: Any, sensor: Any, lit: Sequence[int] | None = None) -> SceneNeeds:
    """Return the features that light tracing of `scene` for `sensor` needs. `lit` has the indices of the emitters that
    emit; None: all.
    """
    graph = SceneGraph.of(scene)
    flags = 0
    for bsdf in graph.surface_bsdfs():
        flags |= int(bsdf.flags())
    emitters, environment = list(scene.emitters()), scene.environment()
    emitters = emitters if lit is None else [emitters[index] for index in lit]
    delta = int(mi.BSDFFlags.Delta) & ~int(mi.BSDFFlags.Null)  # `Delta` includes it
    lamps = tuple(lamp for lamp in graph.find_lamps(scene) if lamp.emitter in emitters)
    is_projective = sensor.class_name() in SENSORS
    near_clip, lens_clip = _clip_planes(scene, sensor) if is_projective else (False, False)
    params = mi.traverse(sensor)
    blends, masks = uneven_blends(graph), _masks(graph)
    others = [bsdf for bsdf in graph.of_type(mi.BSDF) if bsdf.class_name() not in _FOLLOWED_BSDFS]
    unfollowed = {owner for bsdf in others for owner in graph.owning_bsdfs(bsdf)}
    return SceneNeeds(
        emitters=tuple(emitter.class_name() for emitter in emitters),
        environment=environment.class_name() if environment in emitters else None,
        has_visible_emitters=any(not int(emitter.flags()) & int(mi.EmitterFlags.Delta) for emitter in emitters),
        has_glossy=flags & int(mi.BSDFFlags.Glossy) != 0,
        has_delta_lobes=flags & delta != 0,
        has_null=flags & int(mi.BSDFFlags.Null) != 0,
        has_instances=graph.has_instances(),
        has_shading_normals=any(
            is_bent(shape) if shape.is_mesh() else shape.class_name() not in _PLAIN_SHAPES for shape in graph.shapes()
        ),
        has_perturbed_normals=any(bsdf.class_name() in ("BumpMap", "NormalMap") for bsdf in graph.of_type(mi.BSDF)),
        bsdfs_read_geometry=_read_geometry(graph),
        disperses=mi.is_spectral
        and any(bsdf.class_name() == GLASS_CLASS and int(bsdf.flags()) & delta for bsdf in graph.of_type(mi.BSDF)),
        moving_shutter=float(sensor.shutter_open_time()) > 0,
        thin_lens=bool(sensor.needs_aperture_sample()),
        principal_point=any(
            key.startswith("principal_point_offset") and np.any(np.array(value) != 0) for key, value in params
        ),
        near_clip=near_clip,
        lens_clip=lens_clip,
        unfollowed=tuple(bsdf for bsdf in graph.surface_bsdfs() if bsdf in unfollowed),
        blends=blends,
        masks=masks,
        null_halves=_null_halves(graph, blends, masks),
        lamps=lamps,
        small_lamps=small_lamps(scene, sensor, lamps) if is_projective else (),
    )


def uneven_blends(graph: SceneGraph) -> tuple[Any, ...]:
    """Return the BSDFs of surfaces that contain a blend of singular and smooth lobes (delta or null lobes in one half,
    smooth lobes in the other half), or of two halves with null lobes. Mitsuba's samples of the former are wrong
    (`transport.bsdf.sample_bsdf`), and its transmission of the latter is that of both halves.
    """
    singular, smooth, null = (int(flag) for flag in (mi.BSDFFlags.Delta, mi.BSDFFlags.Smooth, mi.BSDFFlags.Null))
    found: set[Any] = set()
    for blend in graph.of_type(mi.BSDF):
        if blend.class_name() == "BlendBSDF":
            flags = [int(half.flags()) for half in graph.children[blend] if isinstance(half, mi.BSDF)]
            if any((a & singular and b & smooth) or (a & null and b & null) for a, b in permutations(flags, 2)):
                found |= set(graph.owning_bsdfs(blend))
    return tuple(bsdf for bsdf in graph.surface_bsdfs() if bsdf in found)


def blend_warning(graph: SceneGraph, blends: Iterable[Any]) -> str | None:
    """Return a warning of a blend whose singular lobes stay wrong, or None.

    Singular and smooth lobes of one half must be sampled apart from those of the other half. In `plastic`, and in a
    mask over a BSDF with smooth transmission, one half has both in the same direction, and only Mitsuba knows the half.
    """
    through = int(mi.BSDFFlags.DiffuseTransmission) | int(mi.BSDFFlags.GlossyTransmission)
    for bsdf in blends:
        for nested in graph.nested_bsdfs(bsdf):
            name = nested.class_name()
            if name == "SmoothPlastic" or (name == "MaskBSDF" and int(nested.flags()) & through):
                what = "plastic" if name == "SmoothPlastic" else "a mask over a BSDF that transmits light"
                return f"bsdf {bsdf.id()} blends {what} with other lobes, which Mitsuba samples slightly wrongly"
    return None


def _masks(graph: SceneGraph) -> tuple[tuple[Any, Any], ...]:
    found: dict[Any, Any] = {}
    for mask in (bsdf for bsdf in graph.of_type(mi.BSDF) if bsdf.class_name() == "MaskBSDF"):
        opacity = next(child for child in graph.children[mask] if isinstance(child, mi.Texture))
        found |= {owner: opacity if owner is mask else None for owner in graph.owning_bsdfs(mask)}
    return tuple((bsdf, found[bsdf]) for bsdf in graph.surface_bsdfs() if bsdf in found)


def _null_halves(graph: SceneGraph, blends: Iterable[Any], masks: Iterable[tuple[Any, Any]]) -> tuple[Any, ...]:
    """Return the BSDFs in which a null event may belong to one of two parts. A blend with a mask in it is left out."""
    opacities = dict(masks)
    parts = {mask: [part for part in graph.children[mask] if isinstance(part, mi.BSDF)]
             for mask, opacity in opacities.items() if opacity is not None}  # fmt: skip
    layered = [mask for mask in parts if int(parts[mask][0].flags()) & int(mi.BSDFFlags.Null)]
    return (*(blend for blend in blends if blend not in opacities), *layered)


def is_bent(mesh: Any) -> bool:
    """Whether the interpolated normals of a mesh differ from its geometric normals."""
    return bool(bent_faces(mesh, 1 - 1e-5).any())


def check_paths(scene: Any, sensor: Any, paths: str, hide_emitters: bool = False) -> None:
    """Raise UnsupportedScene if the `paths` cannot render `scene`. The error gives the reason and the remedy.

    `paths` is as in `paths_obstacle`.
    """
    obstacle = paths_obstacle(scene, sensor, paths, hide_emitters)
    if obstacle is None:
        return
    others = {"light": ("both", "camera"), "both": ("light", "camera")}.get(paths, ("light",))
    reasons = {kind: paths_obstacle(scene, sensor, kind, hide_emitters) for kind in others}
    kind = next((kind for kind, reason in reasons.items() if reason is None), None)
    if kind is not None:
        is_set = paths in ("camera", "both")  # the integrator has the option
        way = f"use integrator.paths: {kind}" if is_set else f"use integrator: {{type: reslrb, paths: {kind}}}"
        has_its_own = any(f"; {word} " in obstacle for word in ("give", "let", "load", "take", "remove"))
        raise UnsupportedScene(f"{obstacle}{', or' if has_its_own else ';'} {way}")
    other = next((reason for reason in reasons.values() if reason != obstacle), None)
    raise UnsupportedScene(obstacle + (f"; other paths cannot render it either: {other}" if other else ""))


def paths_obstacle(scene: Any, sensor: Any, paths: str, hide_emitters: bool = False) -> str | None:
    """Return the reason why `scene` cannot be rendered for `sensor`, or None if it can be.

    `paths` is `light`, `camera` or `both`, as in `reslrb`, or `prb` for camera paths of Mitsuba's own integrators.
    """
    if paths == "prb":
        return _camera_obstacle(scene, sensor)
    if paths != "light":
        obstacle = _film_obstacle(sensor) or _camera_obstacle(scene, sensor, beside_light=paths == "both")
        if paths == "camera" or obstacle is not None:
            return obstacle
    obstacle = unsupported_part(scene, sensor) or _unsampled(scene)
    if paths == "both" or obstacle is not None:
        return obstacle or scaled_emitter(scene)
    view = look(scene, sensor)
    if view.specular > 0 and view.smooth == 0 and (hide_emitters or view.emission == 0):
        return (
            f"sensor {sensor.id()} sees only smooth specular surfaces (glass, mirrors), to which light paths cannot "
            "connect; let it see a rough surface"
        )
    return None


def scaled_emitter(scene: Any) -> str | None:
    """Return the reason, as text, why light paths and camera paths render different light, or None if they render the
    same light.

    With a scale in `to_world`, the directions of a `directional` or `projector` emitter do not have length 1. Mitsuba's
    `sample_ray` and `sample_direction` treat such directions differently.
    """
    plugins = {"DirectionalEmitter": "directional", "Projector": "projector"}
    for emitter in scene.emitters():
        if (plugin := plugins.get(emitter.class_name())) is None:
            continue
        columns = np.array(emitter.world_transform().matrix, dtype=float).reshape(4, 4, -1)[:3, :3]
        if np.any(np.abs(np.linalg.norm(columns, axis=0) - 1) > 1e-4):
            why = "for which light and camera paths of Mitsuba disagree"
            return f"emitter {emitter.id()} is a `{plugin}` with a scale in `to_world`, {why}; remove the scale"
    return None


def camera_finds_all(scene: Any, max_depth: int, gloss: bool = False) -> bool:
    """True if camera paths of up to `max_depth` segments find all light with good probability. A `max_depth` of -1
    means any number.

    Camera paths find all light if no surface is specular or glossy, or if all light comes straight from the emitters.
    An emitter that emits only along its normal is not allowed. With `gloss`, surfaces may have a glossy lobe beside a
    diffuse one.
    """
    if any(emitter.class_name() == "DirectionalArea" for emitter in scene.emitters()):
        return False
    if 0 <= max_depth <= 2:  # light goes straight from an emitter to a visible surface
        return True
    delta, glossy, diffuse = (int(flag) for flag in (mi.BSDFFlags.Delta, mi.BSDFFlags.Glossy, mi.BSDFFlags.Diffuse))
    delta &= ~int(mi.BSDFFlags.Null)
    flags = [int(bsdf.flags()) for bsdf in SceneGraph.of(scene).surface_bsdfs()]
    return not any(each & delta or (each & glossy and not (gloss and each & diffuse)) for each in flags)


def light_finds_all(scene: Any, sensors: Sequence[Any], hide_emitters: bool) -> bool:
    """Whether light paths find all light for these sensors.

    Light paths find all light if no sensor sees a mirror or clear glass, and no hidden lamp blocks connections.
    """
    if hide_emitters and any(shape.is_emitter() for shape in scene.shapes()):
        return False
    return all(
        paths_obstacle(scene, sensor, "light", hide_emitters) is None and not look(scene, sensor).specular
        for sensor in sensors
    )


def usual_paths(scene: Any, sensors: Sequence[Any], max_depth: int, hide_emitters: bool, moves: bool) -> str:
    """Return the kinds of paths for `paths: auto` without a measurement: `both`, or the only kind that can render
    `scene` for these sensors. If shapes move (`moves`), it is the kind with the least noise.
    """
    if camera_finds_nothing(scene) or scaled_emitter(scene) is not None:
        return "light"
    kinds = ["both", "camera"]
    if moves:
        kinds = ["camera"]
        if not camera_finds_all(scene, max_depth, gloss=True):
            kinds = [] if light_finds_all(scene, sensors, hide_emitters) else ["both"]
    for kind in kinds:
        if all(paths_obstacle(scene, sensor, kind) is None for sensor in sensors):
            return kind
    return "light"


def camera_finds_nothing(scene: Any) -> bool:
    """Whether all emitters of `scene` emit only along their normal. No camera path finds such light."""
    return all(emitter.class_name() == "DirectionalArea" for emitter in scene.emitters())


def _unsampled(scene: Any) -> str | None:
    """Return the reason why Mitsuba cannot sample rays of some emitter, or None if it can."""
    children = SceneGraph.of(scene).children
    for emitter in scene.emitters() if mi.is_spectral else ():
        if any(child.class_name() == "BlackBodySpectrum" for child in children.get(emitter, ())):
            instead = "load the scene with `reslrb_cli.load_scene`, or give the light as a `regular` spectrum"
            return f"Mitsuba cannot sample the wavelengths of emitter {emitter.id()}, a `blackbody`; {instead}"
    try:
        emitted_rays(scene, mi.Float(0.5), mi.Point2f(0.5), mi.Point2f(0.5))
    except UnsupportedScene as error:
        return str(error)
    return None


def _film_obstacle(sensor: Any) -> str | None:
    if sensor.film().class_name() not in ("HDRFilm", "SpecFilm"):
        return f"sensor {sensor.id()} has a {sensor.film().class_name()}; paths are splatted on an `hdrfilm`"
    return None


def stock_clip(needs: SceneNeeds) -> str | None:
    """Return the error, as text, that a sensor's clip planes cause in Mitsuba's own light tracing. Return None if there
    is no error.
    """
    if needs.lens_clip:
        return "does not clip the view of a `thinlens`, and loses light if it focuses on a clip plane or beyond"
    if needs.near_clip:
        return "lets objects before the sensor's near clip plane hide objects behind it"
    return None


def _camera_obstacle(scene: Any, sensor: Any, beside_light: bool = False) -> str | None:
    """Return the reason why camera paths cannot render `scene` for `sensor`, or None if they can. Traces no ray.

    With `beside_light`, light paths are also traced. The light paths add the light that camera paths cannot find.
    """
    graph = SceneGraph.of(scene)
    if (obstacle := _unknown_part(scene, sensor, graph)) is not None:
        return obstacle
    for emitter in scene.emitters():
        if emitter.class_name() == "DirectionalArea" and not beside_light:
            what = "which camera paths cannot find and `prb` cannot evaluate"
            return f"emitter {emitter.id()} is a `directionalarea`, {what}"
    half, si = mi.Point2f(0.5), _somewhere()
    calls = [(f"send rays from sensor {sensor.id()}", partial(sensor.sample_ray_differential, 0, 0.5, half, half))]
    found = [emitter for emitter in scene.emitters() if emitter.class_name() != "DirectionalArea"]
    for emitter in _one_of_a_kind(graph, found):
        calls.append((f"find emitter {emitter.id()} from a surface", partial(emitter.sample_direction, si, half)))
    return _first_failure(calls)


def unsupported_part(scene: Any, sensor: Any) -> str | None:
    """Return a part of the scene that light paths do not support, or None. Traces no ray."""
    graph, name = SceneGraph.of(scene), sensor.id()
    if (obstacle := _unknown_part(scene, sensor, graph)) is not None:
        return obstacle
    if sensor.class_name() not in SENSORS:
        return f"sensor {name} is a {sensor.class_name()}; light paths connect to `perspective` and `thinlens` sensors"
    if (obstacle := _film_obstacle(sensor)) is not None:
        return obstacle
    for bsdf in graph.of_type(mi.BSDF):
        if (plugin := _ONE_WAY.get(bsdf.class_name())) is not None:
            why = "which changes if light and view are exchanged: light paths would render another material"
            return f"bsdf {bsdf.id()} is `{plugin}`, {why}"
    if (lamp := _lamp_on(graph, _NO_POINTS)) is not None:
        return f"{lamp}, on which Mitsuba samples no points for light to start from; use a mesh as lamp"
    return None


def _unknown_part(scene: Any, sensor: Any, graph: SceneGraph) -> str | None:
    """Return a part of the scene that no integrator supports, or None. Traces no ray."""
    for shape in graph.shapes():
        if shape.is_medium_transition() and graph.is_shown(shape):
            return f"shape {shape.id() or 'of a group'} bounds{_MEDIUM}"
    for held in (sensor, *(child for child in graph.of_type(mi.Sensor) if sensor in graph.parents[child])):
        if held.get_medium() is not None:
            return f"sensor {held.id()} is inside{_MEDIUM}"
    for emitter in scene.emitters():
        if emitter.get_medium() is not None:
            return f"emitter {emitter.id()} is inside{_MEDIUM}"
        if emitter.class_name() == "TimedSunskyEmitter":
            why = "which evaluates arrays during tracing: Mitsuba 3.9 cannot render it in a kernel; use a `sunsky`"
            return f"emitter {emitter.id()} is a `timed_sunsky`, {why}"
    if (lamp := _lamp_on(graph, _NO_LAMPS)) is not None:
        return f"{lamp}, which Mitsuba does not allow to emit; use a `cylinder` or a mesh as lamp"
    # An example is a BSDF whose texture has too many channels.
    si, half, context = _somewhere(), mi.Point2f(0.5), mi.BSDFContext()
    calls = []
    for bsdf in _one_of_a_kind(graph, graph.surface_bsdfs()):
        calls.append((f"evaluate bsdf {bsdf.id()}", partial(bsdf.sample, context, si, 0.5, half)))
        calls.append((f"evaluate bsdf {bsdf.id()}", partial(bsdf.eval, context, si, si.wi)))
    for emitter in _one_of_a_kind(graph, scene.emitters()):
        calls.append((f"evaluate emitter {emitter.id()}", partial(emitter.eval, si)))
    return _first_failure(calls)


def _first_failure(calls: Iterable[tuple[str, Callable[[], object]]]) -> str | None:
    """Find the first call in `calls` that Mitsuba refuses. Return the call's purpose and the reason for the refusal."""
    found = ((what, failure(call)) for what, call in calls)
    return next((f"Mitsuba cannot {what}: {reason}" for what, reason in found if reason is not None), None)


def _lamp_on(graph: SceneGraph, plugins: dict[str, str]) -> str | None:
    """Return the first emitter on a shape with a class in `plugins`, and the shape. Some emitters do not know their
    shape.
    """
    for shape in graph.shapes():
        if shape.is_emitter() and shape.class_name() in plugins:
            return f"emitter {shape.emitter().id()} is on a shape `{plugins[shape.class_name()]}`"
    return None


def _somewhere() -> Any:
    """Return one surface point, seen from straight above."""
    si = dr.zeros(mi.SurfaceInteraction3f)
    if mi.is_spectral:
        si.wavelengths = mi.Spectrum(460, 520, 580, 640)
    si.wi, si.n, si.sh_frame = mi.Vector3f(0, 0, 1), mi.Normal3f(0, 0, 1), mi.Frame3f(mi.Vector3f(0, 0, 1))
    return si


def _one_of_a_kind(graph: SceneGraph, items: Sequence[Any]) -> list[Any]:
    """Return the first of each group of objects with equal structure. Thousands of objects may differ only in
    numbers.
    """
    found: dict[tuple[Any, ...], Any] = {}
    for item in items:
        found.setdefault(_kind(item, graph), item)
    return list(found.values())


def _kind(item: Any, graph: SceneGraph) -> tuple[Any, ...]:
    """Return the structure of an object. A recursive closure would keep the scene alive."""
    name = item.class_name()
    # The only texture with one or three channels, depending on its value.
    size = np.size(mi.traverse(item)["value"]) if name == "RawConstantTexture" else 0
    used = (child for child in graph.children.get(item, ()) if isinstance(child, (mi.BSDF, mi.Texture, mi.Volume)))
    return (name, size, *(_kind(child, graph) for child in used))


def look(scene: Any, sensor: Any) -> PrimaryHits:
    """Cast primary rays through the centres of a grid of LOOK^2 cells of the film's crop window."""
    smooth, specular, emission = what_is_seen(scene, sensor)
    masks = (smooth, specular, ~(smooth | specular), emission)
    return PrimaryHits(*(float(dr.count(mask)[0]) / LOOK**2 for mask in masks))


def what_is_seen(scene: Any, sensor: Any, aperture: tuple[float, float] | None = None) -> tuple[Any, Any, Any]:
    """Return masks of the rays that meet smooth surfaces, specular surfaces, and emission. A grid of LOOK^2 cells has
    one ray per cell, row by row.

    `PrimaryHits` defines the three kinds. The rays start at a point of the `aperture`, by default its middle.
    """
    lens = mi.Point2f(0.5) if aperture is None else mi.Point2f(*(dr.opaque(mi.Float, place) for place in aperture))
    ray, _ = sensor_rays(sensor, sensor.shutter_open(), grid(LOOK), lens)
    active = dr.full(mi.Mask, True, LOOK**2)
    smooth, specular, emission = (dr.zeros(mi.Mask, LOOK**2) for _ in range(3))
    for si, reached in surfaces_met(scene, ray, active):
        reached = reached & ~smooth  # a mask is smooth, whatever is behind it
        emission = emission | (reached & dr.any(si.emitter(scene, reached).eval(si, reached) > 0))
        hit = reached & si.is_valid()
        flags = si.bsdf().flags()
        specular = specular | (hit & ~mi.has_flag(flags, mi.BSDFFlags.Smooth) & ~mi.has_flag(flags, mi.BSDFFlags.Null))
        smooth = smooth | (hit & mi.has_flag(flags, mi.BSDFFlags.Smooth))
        dr.schedule(smooth, specular, emission)
    return smooth, specular, emission


def surfaces_met(scene: Any, ray: Any, active: Any, random: Any = None) -> Iterator[tuple[Any, Any]]:
    """Follow rays through see-through surfaces. Yields each interaction with the mask of its rays.

    If a ray leaves the scene, its last interaction is invalid. With a generator of `random` numbers, rays also follow
    mirrors and clear glass. Callers schedule the collected results, so that one kernel evaluates the results with the
    next rays.
    """
    for _ in range(CROSSINGS):
        si = scene.ray_intersect(ray, active)
        yield si, active
        bsdf, d = si.bsdf(), ray.d
        flags, hit = bsdf.flags(), active & si.is_valid()
        active = hit & mi.has_flag(flags, mi.BSDFFlags.Null)
        if random is not None:
            specular = hit & ~active & ~mi.has_flag(flags, mi.BSDFFlags.Smooth)
            lobe, place = random.next_float32(), mi.Point2f(random.next_float32(), random.next_float32())
            sample, weight = bsdf.sample(mi.BSDFContext(), si, lobe, place, specular)
            specular = specular & dr.any(weight > 0)
            active, d = active | specular, dr.select(specular, si.to_world(sample.wo), d)
        ray = si.spawn_ray(d)
        dr.eval(ray, active, random)
        if dr.none(active):
            return


def _read_geometry(graph: SceneGraph) -> bool:
    """True if any BSDF, or any texture of a BSDF, may read surface data other than texture coordinates and local
    directions.
    """
    textures = [texture.class_name() for texture in graph.of_type(mi.Texture) if graph.owning_bsdfs(texture)]
    is_plain = all(bsdf.class_name() in _PLAIN_BSDFS for bsdf in graph.of_type(mi.BSDF))
    return not is_plain or not all(map(_PLAIN_TEXTURES.fullmatch, textures))


def _clip_planes(scene: Any, sensor: Any) -> tuple[bool, bool]:
    """Return `near_clip` and `lens_clip` of `SceneNeeds` for a perspective or thin-lens sensor.

    Between the sensor and its near plane, only objects in the sensor's view count. The test uses bounding boxes, and
    triangles near the sensor. A result of false is certain, and a result of true may be wrong.
    """
    params = mi.traverse(sensor)
    names = ("near_clip", "far_clip", "aperture_radius", "focus_distance")
    near, far, radius, focus = (float(np.ravel(params[name])[0]) if name in params else 0.0 for name in names)
    to_world = np.array(sensor.world_transform().matrix, np.float64).reshape(4, 4)
    axes, eye = to_world[:3, :3], to_world[:3, 3]

    # The box, in sensor coordinates, that contains everything between the aperture and the near plane.
    width, height = (int(n) for n in sensor.film().size())
    shift = max((float(np.abs(value).max()) for key, value in params if key.startswith("principal_point")), default=0.0)
    tangent = np.tan(np.deg2rad(float(params["x_fov"][0])) / 2) * max(1, height / width) * (1 + 2 * shift)
    side = near * tangent + radius * (1 + near / focus if focus > 0 else 1)
    half, middle = np.array([side, side, near / 2]), np.array([0, 0, near / 2])
    is_before = any(_touches(shape, axes, eye, middle, half) for shape in scene.shapes())
    if not sensor.needs_aperture_sample():
        return is_before, False

    corners = np.array(list(product(*zip(*bounds(scene), strict=True))))
    is_beyond = bool(((corners - eye) @ axes[:, 2]).max() > far)
    # Mitsuba sees nothing if `sample_direction`, in single precision, considers the focus outside of the clip planes.
    # By default, the lens focuses on the far plane.
    depth = (1 - near / focus) * far / (far - near) if focus > 0 else -np.inf  # projected depth: 0 at near, 1 at far
    return is_before, is_before or is_beyond or not _DEPTH_ROUNDING < depth < 1 - _DEPTH_ROUNDING


def _touches(shape: Any, axes: np.ndarray, eye: np.ndarray, middle: np.ndarray, half: np.ndarray) -> bool:
    """Whether a shape may touch a box. `middle` and `half` are the box's centre and half sizes in the coordinates of
    `axes` (columns) and `eye`.
    """
    low, high = bounds(shape)
    centre, extent = (low + high) / 2, (high - low) / 2
    apart = centre - (eye + axes @ middle)
    beside = (np.abs(apart) > extent + np.abs(axes) @ half) | (np.abs(apart @ axes) > half + extent @ np.abs(axes))
    if beside.any():
        return False
    if shape.class_name() == "Sphere":  # a sensor may be inside it
        return bool(np.linalg.norm(apart) + np.linalg.norm(half) > extent.min() * 0.999)
    if not shape.is_mesh():
        return True
    corners = (triangles(shape) - eye) @ axes - middle
    corners = corners[((corners.min(1) <= half) & (corners.max(1) >= -half)).all(1)]
    normals = face_normals(corners)
    return bool((np.abs((normals * corners[:, 0]).sum(1)) <= np.abs(normals) @ half).any())
