"""Plan of a walk, made before tracing. Features that a scene does not need are not compiled."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import Any

import mitsuba as mi
import numpy as np

from reslrb_cli.scene.deformation import Horizon
from reslrb_cli.scene.graph import Lamp, is_one_of
from reslrb_cli.scene.needs import SceneNeeds
from reslrb_cli.transport.sobol import Coordinates

Array = np.ndarray[Any, Any]
SLOTS_PER_CELL = 4  # one of them for the uniform share
SLOTS_OF_SEVERAL = 8  # if emitters have unequal shares, which are rounded up to whole slots


@dataclass(frozen=True)
class Grid:
    """Grid of cells in the four-dimensional unit cube. Each of the four coordinates is divided into 2^bits parts. The
    coordinates of the place come first.

    `edges` (E + 1) divide the range of the number that selects an emitter. Each part belongs to one emitter or one
    group of emitters.
    """

    bits: tuple[int, int, int, int]
    edges: tuple[float, ...]

    @property
    def emitters(self) -> int:
        """Number of emitters, or groups of emitters, with their own cells."""
        return len(self.edges) - 1

    @property
    def cells(self) -> int:
        """Number of cells of all emitters. The cells of one emitter are contiguous."""
        return self.emitters << sum(self.bits)

    @property
    def slots(self) -> int:
        """Number of slots, a power of two."""
        each = SLOTS_PER_CELL if self.emitters == 1 else SLOTS_OF_SEVERAL
        return 1 << (each * self.cells - 1).bit_length()

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of an array with one entry for each cell. The emitter is the first axis, and the four coordinates
        follow in reverse order.

        The order is reversed because the first number varies fastest in a cell's index.
        """
        return (self.emitters, *(1 << bits for bits in reversed(self.bits)))

    def measures(self) -> Array:
        """Return v_k of all cells, float64, read-only. They sum to 1."""
        return _measures(self)

    def coarser(self, cells: float) -> Grid:
        """Return a coarser grid with at most `cells` cells, but at least one cell for each emitter. Each is a union of
        cells of this grid.
        """
        bits = list(self.bits)
        while sum(bits) > 0 and self.emitters << sum(bits) > cells:
            bits[3 - bits[::-1].index(max(bits))] -= 1  # the last one that was cut
        return Grid((bits[0], bits[1], bits[2], bits[3]), self.edges)

    def summed(self, values: Array, coarser: Grid) -> Array:
        """Return the sum of `values` (cells,) in each cell of the grid `coarser`. The sums have the type of
        `values`.
        """
        result = values.reshape(self.shape)
        for axis, few in enumerate(coarser.shape):
            while result.shape[axis] > few:
                rows = np.moveaxis(result, axis, 0)
                result = np.moveaxis(rows[::2] + rows[1::2], 0, axis)
        return result.ravel()

    def shared_out(self, values: Array, coarser: Grid) -> Array:
        """Return the `values` of the grid `coarser`, each distributed evenly over the cells in its coarser cell. This
        is the inverse of `summed`.
        """
        result = values.reshape(coarser.shape) * (coarser.cells / self.cells)
        for axis, (fine, few) in enumerate(zip(self.shape, coarser.shape, strict=True)):
            result = result.repeat(fine // few, axis)
        return result.ravel()


@functools.lru_cache(maxsize=4)
def _measures(grid: Grid) -> Array:
    # Every new table asks for them several times.
    result = np.repeat(np.diff(grid.edges) / (1 << sum(grid.bits)), 1 << sum(grid.bits))
    result.setflags(write=False)
    return result


UNBOUNDED = 0xFFFFFFFF


@dataclass(frozen=True)
class Plan:
    """Static choices of a walk: Python values that are not part of a kernel's data.

    `max_depth` and `rr_depth` count path edges as in Mitsuba's `ptracer`. A `max_depth` of -1 becomes UNBOUNDED.
    """

    needs: SceneNeeds
    max_depth: int
    rr_depth: int
    hide_emitters: bool = False
    # Indices of the emitters that are lit for this sensor, if not all are.
    lit: tuple[int, ...] | None = None
    track_zeros: bool = False
    differentiate_bsdfs: bool = False
    differentiate_emission: bool = False
    # Lamps with a differentiated texture: black texels are sampled, too, because their derivatives can be as large as
    # any.
    evened_lamps: tuple[Lamp, ...] = ()
    # Emitters with a differentiated spectrum in proportion to which their wavelengths are sampled, and the spectrum.
    sampled_spectra: tuple[tuple[mi.Emitter, mi.Texture], ...] = ()
    # The BSDFs of differentiated surfaces, if not all are.
    only_bsdfs: tuple[mi.BSDF, ...] = ()
    # Whether any differentiated BSDF has delta lobes, or lets light pass straight through.
    differentiate_delta: bool = False
    differentiate_null: bool = False
    # Whether directions, hit points and film positions have derivatives, too, and the moving objects: shapes, and the
    # rays of emitters.
    attached: bool = False
    # Whether, behind a nonspecular vertex, the next vertex stays at its place on its surface; otherwise directions
    # rotate with the surface. `glossy_follows`: directions rotate at BSDFs with glossy lobes anyway.
    stays: bool = False
    glossy_follows: bool = False
    moving_shapes: tuple[mi.Shape, ...] = ()
    moving_emitters: tuple[mi.Emitter, ...] = ()
    # Moving shapes whose edges cover and uncover light, with a derivative. `occluders` do the same and do not move.
    edged: tuple[mi.Shape, ...] = ()
    occluders: tuple[mi.Shape, ...] = ()
    # Distance of two vertices below which most of the light between them is differentiated with fixed directions. It
    # is 0 without edges.
    near: float = 0.0
    # Whether the normalisation of the reconstruction filter has a derivative and the correction for shading normals has
    # none, as in finite differences; otherwise as in `ptracer`.
    attached_normalization: bool = True
    # Settings of the integrator that are on (`SamplingOptions.on`). `pixels` needs camera paths, and is off in motion.
    on: frozenset[str] = frozenset()
    # The sphere that infinite emitters light.
    horizon: Horizon | None = None
    # The cells of guided emission, if emission is guided.
    grid: Grid | None = None
    # Kinds of paths: `light`, `camera`, or `both`; and whether the paths of this walk start at the sensor.
    paths: str = "light"
    camera: bool = False
    # Whether each path belongs to one side, by its class, if there are both kinds. Otherwise both sides are weighted.
    # Light paths then have the light that begins at a specular or glossy surface (`begins_caustic`).
    by_class: bool = False
    # Whether each pixel is divided by the part of its filter on the film, as always if camera paths may run.
    whole: bool = False
    # How the sensor sees: whether lamps are hidden and do not block its view. With light paths alone they do.
    sees_through_lamps: bool = False
    # Whether guided paths may be aimed at visible surfaces (`aim.py`), if nothing moves.
    aims: bool = False
    # Whether next events find the parallel light of lamps (`Lamp.is_beam`), for edges of light paths; and whether they
    # find no other light.
    beams: bool = False
    only_beams: bool = False
    # The low-discrepancy numbers, if there are any.
    sequence: Coordinates | None = None

    @property
    def aimed(self) -> bool:
        """Whether guided paths are aimed at visible points."""
        return self.aims and not self.attached

    @property
    def weighs(self) -> bool:
        """True if contributions of light paths and camera paths are weighted against each other."""
        return self.paths == "both" and not self.by_class

    @property
    def passes_lamps(self) -> bool:
        """Whether connections of this walk pass through lamps, because they lead to a sensor that sees through them."""
        return self.sees_through_lamps and not self.camera

    @property
    def samples_emitters(self) -> bool:
        """Whether next event estimation can find an emitter."""
        return self.beams or any(name != "DirectionalArea" for name in self.needs.emitters)

    @property
    def has_light_at_points(self) -> bool:
        """True if any emitter is not a shape. Lights at points and in one direction count, and so do environments."""
        return any(name not in ("AreaLight", "DirectionalArea") for name in self.needs.emitters)

    @property
    def has_edges(self) -> bool:
        """Whether the derivative includes light that edges cover and uncover."""
        return bool(self.edged or self.occluders)

    @property
    def moving_emission(self) -> bool:
        """Whether any emitter moves."""
        return bool(self.moving_emitters)

    @property
    def roulette(self) -> bool:
        """Whether roulette can end a path before the depth limit."""
        return self.rr_depth < self.max_depth - 1

    @property
    def visible_emission(self) -> bool:
        """Whether any emitter can be seen directly, and is not hidden."""
        return self.needs.has_visible_emitters and not self.hide_emitters and self.max_depth > 0

    @property
    def small_lamps(self) -> tuple[Lamp, ...]:
        """Lamps smaller than a pixel. For lamps smaller than a pixel, points on the lamps show the light, instead of
        rays through the pixels.

        The tuple is empty if masks have derivatives, because derivatives of masks need primary rays.
        """
        return self.needs.small_lamps if self.visible_emission and not self.differentiate_null else ()

    @property
    def environment_map(self) -> bool:
        """Whether an environment map emits. `lamps.py` samples its rays."""
        return self.needs.environment == "EnvironmentMapEmitter"

    @property
    def placed_lamps(self) -> tuple[Lamp, ...]:
        """Shapes whose light `lamps.py` samples."""
        return tuple(
            lamp
            for lamp in self.needs.lamps
            if lamp.parallel
            or lamp.is_sphere
            or lamp.shared
            or lamp in self.evened_lamps
            or (lamp.has_faces and lamp.shape in self.moving_shapes)
        )

    @property
    def reshaped_lamps(self) -> tuple[Lamp, ...]:
        """Placed lamps that are meshes with moving faces. The faces are sampled in proportion to their areas."""
        return tuple(lamp for lamp in self.needs.lamps if lamp.faces_by_area and lamp.shape in self.moving_shapes)

    @property
    def visible_moving_lamps(self) -> tuple[Lamp, ...]:
        """Moving shapes that emit in all directions and may be directly visible."""
        if not (self.visible_emission and self.moving_emission):
            return ()
        return tuple(lamp for lamp in self.needs.lamps if lamp.shape in self.moving_shapes and not lamp.parallel)

    @property
    def passage_in_gradient(self) -> bool:
        """Whether a gradient needs the masks between a vertex and the sensor.

        The gradient needs the masks' derivative, or the masks' transmittance if another factor is zero.
        """
        return self.needs.has_null and (self.differentiate_null or self.track_zeros)

    @property
    def keep_geometry(self) -> bool:
        """True if a stored vertex must contain the data with which the vertex is found again on its surface."""
        return self.attached or self.needs.bsdfs_read_geometry or self.passage_in_gradient

    @property
    def sole_bsdf(self) -> mi.BSDFPtr | None:
        """Pointer to the differentiated BSDF if there is exactly one, otherwise None."""
        return mi.BSDFPtr(self.only_bsdfs[0]) if len(self.only_bsdfs) == 1 else None

    def differentiates(self, bsdf: mi.BSDFPtr) -> mi.Bool:
        """Return the lanes in which the BSDF (a pointer) has a differentiated parameter."""
        if not self.only_bsdfs:
            return mi.Bool(self.differentiate_bsdfs)
        result = bsdf == mi.BSDFPtr(self.only_bsdfs[0])
        for other in self.only_bsdfs[1:]:
            result |= bsdf == mi.BSDFPtr(other)
        return result

    def concerns(self, bsdf: mi.BSDFPtr) -> mi.Bool:
        """Return the lanes in which a vertex with this BSDF (a pointer) depends on a differentiated parameter.

        Masks on its connection count, too.
        """
        return mi.Bool(True) if self.differentiate_null else self.differentiates(bsdf)

    def moves(self, shape: mi.ShapePtr) -> mi.Bool:
        """Return the lanes in which the shape itself moves."""
        return is_one_of(shape, self.moving_shapes)

    def finding_beams(self) -> Plan:
        """Return the plan for edges of its paths. Light paths have all light of `beams`, and no other light that camera
        paths find.
        """
        beams = not self.camera and any(lamp.is_beam for lamp in self.needs.lamps)
        return replace(self, beams=beams, only_beams=beams and self.by_class)

    def for_camera(self) -> Plan:
        """Return the plan of the camera paths of a pass. Their vertices stay behind all surfaces that are not
        specular.
        """
        return replace(self, camera=True, stays=self.attached, glossy_follows=False)

    def differentiating(
        self, bsdfs: bool, emission: bool, track_zeros: bool, only_bsdfs: tuple[mi.BSDF, ...] = ()
    ) -> Plan:
        """Return a copy of this plan for a step that differentiates BSDFs (`bsdfs`), emission (`emission`), or both.
        With `track_zeros`, some differentiated factors may be zero.
        """
        delta, null = self.needs.has_delta_lobes, self.needs.has_null
        if only_bsdfs:
            flags = [int(bsdf.flags()) for bsdf in only_bsdfs]
            delta = any(flag & (int(mi.BSDFFlags.Delta) & ~int(mi.BSDFFlags.Null)) for flag in flags)
            null = any(flag & int(mi.BSDFFlags.Null) for flag in flags)
        return replace(
            self,
            differentiate_bsdfs=bsdfs,
            differentiate_emission=emission,
            track_zeros=track_zeros,
            only_bsdfs=only_bsdfs,
            differentiate_delta=bsdfs and delta,
            differentiate_null=bsdfs and null,
        )


def make_plan(needs: SceneNeeds, max_depth: int, rr_depth: int, hide_emitters: bool) -> Plan:
    """Return the plan of a walk through a scene with the features in `needs`. `max_depth` may be -1."""
    return Plan(needs, UNBOUNDED if max_depth < 0 else max_depth, rr_depth, hide_emitters)
