"""The only camera-path loop: film ray, hit emitters, next event estimation, scattering, roulette.

The hooks process the light that is found, as in the light-path loop (`walk.py`). Both loops share the scattering and
the factors. The camera-path loop draws its own random numbers. The two ways to find light are weighted against each
other, and against light paths if there are any (`weights.py`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from reslrb_cli.scene.graph import Lamp
from reslrb_cli.scene.rays import past_lamps, sensor_rays
from reslrb_cli.transport.bsdf import EventNumbers, Scattering, begins_caustic, evaluate, scatter
from reslrb_cli.transport.connection import Connection, film_density, passage
from reslrb_cli.transport.densities import density_of_rays
from reslrb_cli.transport.factors import Product, play
from reslrb_cli.transport.film import Colours
from reslrb_cli.transport.lamps import beam_towards, keep_one
from reslrb_cli.transport.plan import Plan
from reslrb_cli.transport.samples import Samples
from reslrb_cli.transport.walk import Vertex, intersect
from reslrb_cli.transport.weights import Rivals, cosine


@dataclass
class FilmRay:
    """Ray through film position `u` (pixels, relative to the crop window).

    `weight` (C,) is the sensor's importance, normalised so that a sum over lanes gives an image. If `continues` is
    true, the ray is the later part of a path, and the sensor sees a surface that is not specular before it. `depth` is
    the number of the vertex that the ray reaches. It is above 1 behind specular vertices.
    """

    ray: mi.Ray3f
    u: mi.Point2f
    weight: mi.Spectrum
    continues: bool = False
    depth: mi.UInt32 | int = 1

    @property
    def begins_path(self) -> bool:
        """Whether the ray starts at the sensor."""
        return not self.continues and isinstance(self.depth, int) and self.depth == 1


def film_ray(samples: Samples, sampler: mi.Sampler) -> FilmRay:
    """Return a ray for each lane. The rays are distributed over the crop window's pixels, evenly or by pixel weights.

    If there are fewer rays than pixels, each ray goes to a random pixel of its own group of pixels.
    """
    sensor, size = samples.sensor, samples.film.size
    n_pixels = int(dr.prod(size))
    lane = dr.arange(mi.UInt32, samples.width)
    count = dr.opaque(mi.UInt32, samples.width)  # a literal would compile a kernel for every sample count
    time = samples.time(sampler.next_1d)
    if samples.width < n_pixels:
        per_pixel = mi.Float(count) / n_pixels
        pixel, number = one_of_group(lane, count, n_pixels, sampler.next_1d()), mi.UInt32(0)
    elif samples.shares is not None:
        pixel, number = samples.shares.draw(lane)
        per_pixel = samples.shares.count(pixel)
    else:
        pixel, number = lane % n_pixels, lane // n_pixels
        per_pixel = mi.Float(count // n_pixels + dr.select(pixel < count % n_pixels, mi.UInt32(1), 0))
    u = mi.Point2f(pixel % int(size[0]), pixel // int(size[0])) + _within_pixel(samples, number, pixel, per_pixel)
    aperture = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0.5)
    wavelength = sampler.next_1d() if mi.is_spectral else mi.Float(0.5)
    ray, weight = sensor_rays(sensor, time, u / mi.Vector2f(size), aperture, wavelength)
    if samples.plan.needs.disperses:
        weight = keep_one(ray, weight)
    weight = weight * (samples.fraction * dr.rcp(per_pixel))
    return FilmRay(dr.detach(ray), u, dr.detach(weight))


def one_of_group(lane: mi.UInt32, count: mi.UInt32, n_pixels: int, sample: mi.Float) -> mi.UInt32:
    """Return a random pixel of each lane's group, if `n_pixels` pixels are divided into `count` groups of equal size.

    The lane's group begins at pixel lane n / count. In integers, because floats do not tell large numbers of lanes or
    pixels apart.
    """
    begin, whole = mi.UInt64(lane) * n_pixels, mi.UInt64(count)
    rest = mi.Float(mi.UInt32(begin % whole))
    behind = mi.UInt32((rest + sample * n_pixels) / mi.Float(count))
    return dr.minimum(mi.UInt32(begin // whole) + behind, n_pixels - 1)


def _within_pixel(samples: Samples, number: mi.UInt32, pixel: mi.UInt32, per_pixel: mi.Float) -> mi.Point2f:
    """Return positions in [0, 1)^2 within pixels, distributed evenly over the numbered samples of each pixel.

    The positions are Hammersley points, shifted by a random offset for each pixel. Independent positions within a pixel
    would add noise through the reconstruction filter.
    """
    x, y = (mi.Float(word) * 2**-32 for word in mi.sample_tea_32(pixel, samples.seed))
    inverse = mi.Float(dr.brev(number)) * 2**-32
    place = mi.Point2f(x + mi.Float(number) / dr.maximum(per_pixel, 1), y + inverse)
    return dr.minimum(place - dr.floor(place), dr.one_minus_epsilon(mi.Float))


@dataclass
class MetLight:
    """Emission of an emitter that a camera path hits.

    `Le` (C,) is the detached radiance. `weight` is w_H, the weight of hitting an emitter, or 0 if the hit does not
    count.
    """

    Le: mi.Spectrum
    weight: mi.Float
    active: mi.Bool
    emitter: mi.EmitterPtr
    si: mi.SurfaceInteraction3f

    def radiance(self) -> mi.Spectrum:
        """Return the radiance, with its derivative if it has one."""
        return self.emitter.eval(self.si, self.active)


@dataclass(kw_only=True)
class NextEvent(Connection):
    """Connection of a camera path's vertex to a point on an emitter, or to a direction.

    `rest` (C,) is the contribution without BSDF and transmittance: Le w_N / density. `scale` is `rest` without the
    radiance. `Le` (C,) is the detached radiance, `through` (C,) the transmittance, and `target` the point on the
    emitter. `sample` holds the random numbers of this point.
    """

    Le: mi.Spectrum
    scale: mi.Float
    ds: mi.DirectionSample3f
    through: mi.Spectrum

    def radiance(self, si: mi.SurfaceInteraction3f, samples: Samples | None = None) -> mi.Spectrum:
        """Return the arriving radiance, with its derivative if it has one. Forward mode and naive AD pass `samples`."""
        if samples is not None and not _unseen(samples):  # they need Mitsuba's own call
            return samples.scene.eval_emitter_direction(si, self.ds, self.active)

        # Mitsuba's own call fails beside a `directionalarea` in any scene, because Dr.Jit records all emitters.
        def radiance(emitter: mi.Emitter, si: Any, ds: mi.DirectionSample3f, active: mi.Bool) -> mi.Spectrum:
            parallel = emitter.class_name() == "DirectionalArea"
            return mi.Spectrum(0) if parallel else emitter.eval_direction(si, ds, active)

        return dr.dispatch(self.ds.emitter, radiance, si, self.ds, self.active)


class CameraHooks:
    """Hooks of a camera path. The hooks are pure functions, except for the derivatives that they add. Hooks draw no
    random numbers.

    `tracked` hooks keep derivatives of the factors in the loop state. The loop is then evaluated vertex by vertex
    (naive AD).
    """

    tracked: bool = False
    colours: Colours  # of the paths; assigned by the walk before `start`

    def start(self, first: FilmRay) -> Any:
        """Return the state before the first vertex. The state can be any PyTree."""
        return []

    def goes_on(self, state: Any, vertex: Vertex) -> mi.Bool:
        """Return the lanes that the hooks continue from this vertex."""
        return mi.Bool(True)

    def vertex(
        self, state: Any, vertex: Vertex, met: MetLight | None, event: NextEvent | None, scattering: Scattering
    ) -> Any:  # fmt: skip
        """Return the state after a vertex, or after a ray has left the scene.

        `met` is None if camera paths hit no emitter. `event` is None if camera paths sample no emitter.
        """
        return state

    def survived(self, state: Any, factor: mi.Float) -> Any:
        """Return the state after roulette has multiplied the path's product by `factor`, 1/q."""
        return state


@dataclass
class CameraPath:
    """Loop state of one camera path.

    `before` is the last vertex that is not a null event. `events` counts the vertices that are not null events. Without
    light paths, `M` is 1 / p of the last event that is not a null event. After the sensor or a delta event, `M` is 0.
    """

    active: mi.Bool
    depth: mi.UInt32
    ray: mi.Ray3f
    pi: mi.PreliminaryIntersection3f
    product: Product
    eta: mi.Float
    before: mi.Point3f
    events: mi.UInt32
    M: list[mi.Float]
    rivals: list[Rivals]
    classes: list[PathClass]


@dataclass
class PathClass:
    """Class of a camera path, if paths are divided by class. `before` is 1 if the sensor sees a surface before the
    current vertex that is not specular. `last` is 1 if light that arrives at the current vertex from an emitter would
    begin a caustic at the last vertex.
    """

    before: mi.UInt32
    last: mi.UInt32

    def excludes_hit(self) -> mi.Bool:
        """Return the lanes in which an emitter that the path hits belongs to light paths."""
        return (self.before & self.last) != 0

    def past(self, depth: mi.UInt32, bsdf: mi.BSDFPtr, scattering: Scattering, continues: bool) -> PathClass:
        """Return the class behind a vertex. The first vertex itself never begins the light of light paths, unless the
        path `continues`.
        """
        first = (depth == 1) if not continues else mi.Bool(False)
        before = dr.select(first, dr.select(scattering.is_delta, mi.UInt32(0), 1), self.before)
        last = begins_caustic(bsdf, scattering.is_delta) & ~first
        return PathClass(before, dr.select(last, mi.UInt32(1), 0))


def camera_walk(
    samples: Samples, hooks: CameraHooks, active: mi.Bool | bool = True, first: FilmRay | None = None
) -> tuple[FilmRay, Any]:  # fmt: skip
    """Trace one camera path per lane of `samples`, in `active` lanes. Returns the rays and the final state of
    `hooks`. The paths start with the rays `first` if they are given.
    """
    plan, scene, sensor = samples.plan, samples.scene, samples.sensor
    sampler = samples.sampler()
    surrounded = plan.needs.environment is not None
    first = film_ray(samples, sampler) if first is None else first
    hooks.colours = samples.film.colours(first.ray.wavelengths)
    state = hooks.start(first)
    active = mi.Bool(active) & (plan.max_depth > 0)

    begun = first.ray.o
    if plan.sees_through_lamps and first.begins_path:
        first.ray = past_lamps(scene, first.ray, active)
    pi, active = intersect(plan, scene, first.ray, active, surrounded)
    M, rivals = [mi.Float(0)], []
    if plan.weighs:
        axis = dr.normalize(dr.detach(sensor.world_transform() @ mi.Vector3f(0, 0, 1)))  # the sensor looks along it
        cos = dr.dot(first.ray.d, axis)
        near = mi.Float(mi.traverse(sensor)["near_clip"]) / cos  # from the aperture to the ray's origin
        if plan.sees_through_lamps:
            near = near + dr.norm(first.ray.o - begun)
        M, rivals = [], [Rivals(samples.ratio_at(first.u) / film_density(sensor, cos), mi.Float(0), mi.Float(near))]
    divided = plan.by_class and not plan.only_beams
    path = CameraPath(
        active, mi.UInt32(first.depth), first.ray, pi, Product.one(plan.track_zeros, hooks.tracked), mi.Float(1),
        mi.Point3f(first.ray.o), mi.UInt32(first.depth) - 1, M, rivals,
        [PathClass(mi.UInt32(1 if first.continues else 0), mi.UInt32(0))] if divided else [],
    )  # fmt: skip

    def body(path: CameraPath, state: Any, sampler: mi.Sampler) -> tuple[CameraPath, Any, mi.Sampler]:
        si = path.pi.compute_surface_interaction(path.ray, mi.RayFlags.All, path.active)
        bsdf = si.bsdf()
        vertex = Vertex(si, bsdf, path.ray, path.pi, path.depth, path.product, path.active)
        hit = path.active & si.is_valid() if surrounded else path.active
        goes_on = hooks.goes_on(state, vertex)

        # ---- Light from hit emitters ----
        met = _meet(samples, path, si) if plan.needs.has_visible_emitters else None

        # ---- Sample an emitter, and scatter ----
        active = hit & (path.depth + 1 <= plan.max_depth)
        numbers = sampler.next_2d(active)
        bsdf_1d = sampler.next_1d(active)
        own = EventNumbers(sampler.next_2d(active), bsdf_1d)
        event = _next_event(samples, si, bsdf, numbers, active) if plan.samples_emitters else None
        if event is not None:
            for own_class in path.classes:
                event.active = event.active & ~((own_class.before != 0) & begins_caustic(bsdf, False))
        scattered = active & goes_on & (path.depth + 1 <= plan.max_depth - int(not plan.needs.has_visible_emitters))
        scattering, f = scatter(plan, vertex, own, scattered, event)
        arrived = [own.arrive(si, path.ray) for own in path.rivals]
        if hooks.tracked:
            scattering.track(plan, vertex)
        if event is not None:
            _weigh(samples, path, arrived, si, event, scattering)
            event.f = f
            if not (hooks.tracked or plan.track_zeros):
                event.active = event.active & ~dr.all(f * event.rest == 0)  # passes NaN on
            with dr.suspend_grad(when=not plan.differentiate_null):
                seen = passage(plan, scene, si, path.depth, event, loop_mode=mode)
            event.active, event.through = seen
            weight = event.rest
            if hooks.tracked:
                event.f = evaluate(plan, si, bsdf, event.wo, event.active)
                weight = event.radiance(si, samples) * event.scale
            else:
                event.f = dr.select(event.active, event.f, 0)
            event.c = dr.select(event.active, event.f * event.through * weight, 0)
        state = hooks.vertex(state, vertex, met, event, scattering)
        product = path.product.times(scattering.s, path.depth)
        eta = path.eta * dr.detach(scattering.eta)
        active = scattering.active & product.alive()

        # ---- Russian roulette ----
        number = sampler.next_1d(active)
        if plan.roulette:
            throughput = dr.max(dr.abs(product.magnitude()))
            survives, factor = play(plan, path.depth, throughput, eta, number)
            active &= survives
            product, state = product.scaled(factor), hooks.survived(state, factor)

        path = _behind(plan, path, arrived, si, scattering)
        path.classes = [each.past(path.depth, bsdf, scattering, first.continues) for each in path.classes]
        ray = dr.detach(si.spawn_ray(scattering.d))
        pi, active = intersect(plan, scene, ray, active, surrounded)
        path = replace(
            path, active=active, depth=path.depth + 1, ray=ray, pi=pi, product=product, eta=eta
        )  # fmt: skip
        return path, state, sampler

    mode = "evaluated" if hooks.tracked else "symbolic"
    _, state, _ = dr.while_loop(
        state=(path, state, sampler),
        cond=lambda path, state, sampler: path.active,
        body=body,
        labels=("path", "state", "sampler"),
        label="camera path",
        mode=mode,
    )
    return first, state


def _meet(samples: Samples, path: CameraPath, si: mi.SurfaceInteraction3f) -> MetLight:
    """Return the light at `si`, or from the environment if the ray has left the scene."""
    plan, scene = samples.plan, samples.scene
    emitter = samples.emitter_of(si, path.active)
    active = path.active & (emitter != dr.zeros(mi.EmitterPtr))
    direct = path.events == 0
    if plan.hide_emitters:
        active &= ~direct
    for lamp in plan.small_lamps:  # `emission.py` renders their direct light
        active &= ~(direct & (emitter == mi.EmitterPtr(lamp.emitter)))
    for lamp in plan.needs.lamps:
        if lamp.parallel:
            active &= emitter != mi.EmitterPtr(lamp.emitter)
    for own_class in path.classes:
        active &= ~own_class.excludes_hit()
    with dr.suspend_grad():
        Le = emitter.eval(si, active)
        reference = dr.zeros(mi.Interaction3f)
        reference.p, reference.time, reference.wavelengths = path.before, path.ray.time, path.ray.wavelengths
        ds = mi.DirectionSample3f(scene, si, reference)
        indirect = active & ~direct
        number = dr.reinterpret_array(mi.UInt32, emitter)
        if plan.lit is None:
            p_D = scene.pdf_emitter_direction(reference, ds, indirect)
        else:
            assert samples.emitters is not None
            p_D = emitter.pdf_direction(reference, ds, indirect)
            p_D *= dr.gather(mi.Float, samples.emitters.choice, number, indirect)
        spheres = _spheres(samples)
        for lamp in plan.needs.lamps:
            if lamp.surrounds or lamp.shared or lamp in spheres:
                area = lamp.shape.surface_area()
                if lamp in spheres:
                    area = 0.5 * area * (1 - _sphere_seen_from(mi.traverse(lamp.shape)["to_world"], path.before)[3])
                even = dr.square(ds.dist) / (dr.abs(dr.dot(ds.n, ds.d)) * area)
                here = indirect & (emitter == mi.EmitterPtr(lamp.emitter))
                p_D = dr.select(here, samples.chance_of(lamp) * even, p_D)
        # Points of a lamp with a black texture have no density: paths only hit them.
        sampled = dr.select(dr.isfinite(p_D), p_D, 0)
        if not path.rivals:
            rivals = sampled * path.M[0]
        else:
            [own] = path.rivals
            table = samples.emitters
            assert table is not None
            place = p_D / dr.gather(mi.Float, table.choice, number, indirect)
            if plan.needs.lamps:
                cos = dr.abs(dr.dot(ds.n, ds.d))
                place = dr.select(emitter.is_environment(), place, place * cos / dr.square(ds.dist))
            e = density_of_rays(plan, table, emitter, place, si.uv, -path.ray.d, indirect)
            rivals = sampled * own.M + dr.select(dr.isfinite(e), e, 0) * own.V
        weight = dr.select(active, dr.select(direct, 1, dr.rcp(1 + rivals)), 0)
    return MetLight(dr.select(active, Le, 0), weight, active, emitter, si)


def _next_event(
    samples: Samples, si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, numbers: mi.Point2f, active: mi.Bool
) -> NextEvent:  # fmt: skip
    """Sample a point on an emitter, or a direction. `rest` and `scale` do not include w_N yet."""
    active = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
    ds, weight = sample_lamp(samples, si, numbers, active)
    active = active & (ds.pdf > 0) & dr.isfinite(ds.pdf)
    weight = dr.select(active, weight, 0)
    return NextEvent(
        weight, mi.Point2f(0), ds.p, si.to_local(ds.d), active, numbers,
        Le=dr.select(active, weight * ds.pdf, 0), scale=dr.select(active, dr.rcp(ds.pdf), 0), ds=ds,
        through=mi.Spectrum(1),
    )  # fmt: skip


def next_event_again(
    samples: Samples, si: mi.SurfaceInteraction3f, numbers: mi.Point2f, active: mi.Bool
) -> NextEvent:  # fmt: skip
    """Return the next event with the random `numbers`, with attached derivatives. A point on an emitter stays at its
    place on the emitter. `rest` (C,) is the arriving radiance.

    Call the function under `dr.resume_grad()`. The density is detached. In its place, `rest` has the derivative of
    |cos| / distance^2 at the emitter.
    """
    with dr.suspend_grad():
        ds, _ = sample_lamp(samples, dr.detach(si), numbers, active)
        distant = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite)
    there = ds.p - si.p
    distance = dr.norm(there)
    ds.d = dr.select(distant, ds.d, there / distance)
    ds.dist = dr.select(distant, ds.dist, distance)
    measure = dr.abs(dr.dot(ds.n, ds.d)) / dr.square(distance)
    on_surface = active & ~distant & ~ds.delta & (measure > 0)
    event = NextEvent(
        mi.Spectrum(0), mi.Point2f(0), ds.p, si.to_local(ds.d), active, numbers,
        Le=mi.Spectrum(0), scale=mi.Float(0), ds=ds, through=mi.Spectrum(1),
    )  # fmt: skip
    event.rest = event.radiance(si) * dr.select(on_surface, measure / dr.detach(measure), 1)
    return event


def _unseen(samples: Samples) -> frozenset[mi.Emitter]:
    """Return the emitters without next event estimation."""
    return frozenset(lamp.emitter for lamp in samples.plan.needs.lamps if lamp.parallel)


def sample_lamp(
    samples: Samples, si: mi.SurfaceInteraction3f, numbers: mi.Point2f, active: mi.Bool
) -> tuple[mi.DirectionSample3f, mi.Spectrum]:  # fmt: skip
    """Return a sampled place on an emitter as seen from `si`, or a direction, and radiance / density (C,). Visibility
    is not tested. Emitters that Mitsuba cannot sample have weight 0.
    """
    scene, unseen = samples.scene, _unseen(samples)
    spheres = {lamp.emitter: lamp.shape for lamp in _spheres(samples)}
    shared = {lamp.emitter: lamp.shape for lamp in samples.plan.needs.lamps if lamp.shared}
    beams = {lamp.emitter: lamp for lamp in samples.plan.needs.lamps if lamp.is_beam and samples.plan.beams}
    with dr.suspend_grad():
        if not (unseen or spheres or shared or samples.plan.lit):
            return scene.sample_emitter_direction(si, numbers, False, active)
        index, weight, reused = samples.choose_emitter(numbers.x, active)
        emitter = dr.gather(mi.EmitterPtr, scene.emitters_dr(), index, active)

        def sample(
            self: mi.Emitter, si: mi.SurfaceInteraction3f, sample: mi.Point2f, active: mi.Bool
        ) -> tuple[mi.DirectionSample3f, mi.Spectrum]:  # fmt: skip
            if self in beams:
                return beam_towards(beams[self], si, sample.x, active)
            if self in unseen or samples.plan.only_beams:
                return dr.zeros(mi.DirectionSample3f), mi.Spectrum(0)
            if self in spheres:
                return _sample_sphere(self, spheres[self], si, sample, active)
            if self in shared:
                ds = shared[self].sample_direction(si, sample, active)
                ds.emitter = mi.EmitterPtr(self)
                radiance = self.eval_direction(si, ds, active)
                return ds, dr.select(ds.pdf > 0, radiance / ds.pdf, 0)
            return self.sample_direction(si, sample, active)

        ds, radiance = dr.dispatch(emitter, sample, si, mi.Point2f(reused, numbers.y), active)
        ds.pdf /= weight
        return ds, radiance * weight


def _spheres(samples: Samples) -> list[Lamp]:
    """Return the lamps that are spheres, if directions have attached derivatives.

    Mitsuba samples their directions evenly. The derivative of |cos| / distance^2 at the lamp would then have infinite
    variance, because it is large near the sphere's outline. Camera paths therefore sample places on the sphere.
    """
    lamps = samples.plan.needs.lamps
    return [lamp for lamp in lamps if lamp.is_sphere and not lamp.surrounds] if samples.plan.attached else []


def _sphere_seen_from(
    to_world: mi.AffineTransform4f, p: mi.Point3f
) -> tuple[mi.Point3f, mi.Float, mi.Vector3f, mi.Float]:
    """Return the centre and the radius of a sphere, the direction from the centre to `p`, and the cosine of half the
    opening angle of the cap that `p` sees.
    """
    center = to_world @ mi.Point3f(0)
    radius = dr.norm(to_world @ mi.Vector3f(1, 0, 0))
    out = p - center
    distance = dr.norm(out)
    return center, radius, out / distance, dr.minimum(radius / distance, 1)


def _sample_sphere(
    emitter: mi.Emitter, shape: mi.Shape, si: mi.SurfaceInteraction3f, sample: mi.Point2f, active: mi.Bool
) -> tuple[mi.DirectionSample3f, mi.Spectrum]:  # fmt: skip
    """Return a place on the visible cap of a sphere, uniform by area, and radiance / density (C,)."""
    to_world = mi.traverse(shape)["to_world"]
    center, radius, axis, cos = _sphere_seen_from(to_world, si.p)
    n = mi.Frame3f(axis).to_world(mi.warp.square_to_uniform_cone(sample, cos))
    p = center + radius * n
    offset = p - si.p
    distance = dr.norm(offset)
    ds = dr.zeros(mi.DirectionSample3f)
    ds.p, ds.n, ds.dist, ds.d, ds.time = p, n, distance, offset / distance, si.time
    facing = -dr.dot(n, ds.d)
    area = dr.two_pi * dr.square(radius) * (1 - cos)
    ds.pdf = dr.select((facing > 0) & (cos < 1), dr.square(distance) / (facing * area), 0)
    ds.emitter = mi.EmitterPtr(emitter)
    local = to_world.inverse() @ p
    longitude = dr.atan2(local.y, local.x) * dr.inv_two_pi
    ds.uv = mi.Point2f(dr.select(longitude < 0, longitude + 1, longitude), dr.safe_acos(local.z) * dr.inv_pi)
    radiance = emitter.eval_direction(si, ds, active)
    return ds, dr.select(ds.pdf > 0, radiance / ds.pdf, 0)


def _weigh(
    samples: Samples, path: CameraPath, arrived: list[Rivals], si: mi.SurfaceInteraction3f, event: NextEvent,
    scattering: Scattering,
) -> None:  # fmt: skip
    """Multiply a next event by w_N."""
    plan, ds, ways = samples.plan, event.ds, scattering.ways
    p = dr.select(ds.delta, 0, ways.ahead)
    rivals = p / ds.pdf
    if arrived:
        [own] = arrived
        table = samples.emitters
        assert table is not None
        choice = dr.gather(mi.Float, table.choice, dr.reinterpret_array(mi.UInt32, ds.emitter), event.active)
        place, g = ds.pdf / choice, mi.Float(1)
        if plan.needs.lamps:
            on_lamp = ~ds.delta & ~ds.emitter.is_environment()
            place = dr.select(on_lamp, place * dr.abs(dr.dot(ds.n, ds.d)) / dr.square(ds.dist), place)
        if plan.has_light_at_points:
            distant = mi.Bool(False)
            if "DirectionalEmitter" in plan.needs.emitters:
                distant = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite)
            g = dr.select(ds.delta & ~distant, dr.square(ds.dist), 1)
        e = density_of_rays(plan, table, ds.emitter, place, ds.uv, -ds.d, event.active)
        m = dr.select(path.events == 0, own.M, own.V * ways.ahead_back)
        m = dr.select(ways.ahead_valid, m, 0)
        joined = m * e * cosine(si, ds.d) / (ds.pdf * g)
        rivals += dr.select(joined > 0, joined, 0)
    weight = dr.detach(dr.select(event.active, dr.rcp(1 + rivals), 0))
    event.rest, event.scale = event.rest * weight, event.scale * weight


def _behind(
    plan: Plan, path: CameraPath, arrived: list[Rivals], si: mi.SurfaceInteraction3f, scattering: Scattering
) -> CameraPath:  # fmt: skip
    """Return the path after the event of a vertex, with updated weights."""
    ways = scattering.ways
    renewed = dr.rcp(ways.p)
    null = scattering.is_null
    M = [dr.select(scattering.is_delta, 0, renewed) for _ in path.M]
    rivals = []
    for here in arrived:
        m = dr.select(path.events == 0, here.M, here.V * ways.back)
        # Light paths pass no vertex with directions on inconsistent sides.
        m = dr.select(ways.valid, m, 0)
        rivals.append(replace(here, V=dr.select(ways.valid, here.V, 0)).after(
            renewed, m, scattering, cosine(si, scattering.d)))  # fmt: skip
    before, events = mi.Point3f(si.p), path.events + 1
    if plan.needs.has_null:
        M = [dr.select(null, old, new) for old, new in zip(path.M, M, strict=True)]
        rivals = [
            dr.select(null, own.after_null(here), new)
            for own, here, new in zip(path.rivals, arrived, rivals, strict=True)
        ]
        before, events = dr.select(null, path.before, before), dr.select(null, path.events, events)
    return replace(path, before=before, events=events, M=M, rivals=rivals)
