"""Heightmaps that begin where optimal transport has them throw the target: read from the scene, solved, and set.

What stands where is read from the loaded scene into the coordinates of the face (`lens.throw`), whose longer side is
100 there whatever the scene's unit. All that can be refused is, at `initial.transport`, before anything is rendered
(`prepare`); what takes the target's image comes after (`Start.make`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import mitsuba as mi
import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from reslrb_cli.config.parameters import HEIGHTMAP, TransportStart, TransportValue
from reslrb_cli.errors import ConfigError
from reslrb_cli.lens.throw import Beam, Interface, Receiver, Throw, throw_picture
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.views import View
from reslrb_cli.scene.graph import bounds, triangles
from reslrb_cli.scene.values import Place, check_bounds, check_transform

Array = NDArray[np.float64]

#: The face's longer side in its own coordinates.
_SIDE = 100.0
#: What may be off a plane, of a shape's size, and the sine of light that comes along a face.
_FLAT, _ALONG = 2e-4, 0.05
#: What counts as dark about a target, of its brightest hundredth.
_DARK = 0.005
#: Emitters that have a middle from which light comes, or one direction.
_LAMPS = ("PointLight", "SpotLight", "AreaLight", "DirectionalEmitter", "DirectionalArea")
#: Vertices of a face that are looked at, at most: a fit of a plane takes no more.
_CELLS = 256


@dataclass(frozen=True)
class Frame:
    """The face's coordinates: rows of `axes` (3, 3) are its x, y and z in the scene, `scale` its lengths per scene's.

    `texels`: affine map (2, 2), offset and length along x and y, of texture coordinates (u, v).
    """

    middle: Array
    axes: Array
    scale: float
    texels: Array

    def place(self, points: Array) -> Array:
        """Points (..., 3) of the scene."""
        return (points - self.middle) @ self.axes.T * self.scale

    def turn(self, directions: Array) -> Array:
        """Directions (..., 3) of the scene."""
        return directions @ self.axes.T

    def back(self, points: Array) -> Array:
        """Points (..., 3) in the scene."""
        return points @ self.axes / self.scale + self.middle


@dataclass(frozen=True)
class Start:
    """One heightmap that begins by transport; `throw` has a receiver without a picture yet."""

    key: str
    spec: TransportStart
    place: Place
    frame: Frame
    throw: Throw
    receiver: Any
    view: View
    film: Array  # (3, 3): from places on the film, in pixels, to `plane`, both with a 1
    plane: Array  # (3, 3): a point of the receiver, and two axes in it

    def make(self, problem: Problem, say: Callable[[str], None]) -> np.ndarray[Any, Any]:
        """The heights (H, W, 1) in the scene's unit; raises ConfigError."""
        image = np.array(self.view.target, dtype=np.float64)
        image = image @ np.array([0.2126, 0.7152, 0.0722]) if image.shape[2] == 3 else image.mean(axis=2)
        try:
            receiver, picture = self._picture(problem.scene, image)
            slot = problem.selection.slot(self.key)
            ny, nx = slot.get().shape[:2]
            cells = int(np.clip(min(max(nx, ny), max(picture.shape)), 16, 1024))
            throw = replace(self.throw, receiver=receiver)
            made = throw_picture(throw, picture, cells, self.spec.floor)
        except ConfigError as error:
            raise self.place.fail("initial.transport", error.message) from None
        (u0, du), (v0, dv) = self.frame.texels
        xs, ys = u0 + du * (np.arange(nx) + 0.5) / nx, v0 + dv * (np.arange(ny) + 0.5) / ny
        half = np.array(throw.size) / 2
        xs, ys = np.clip(xs, -half[0], half[0]), np.clip(ys, -half[1], half[1])
        order = np.argsort(ys), np.argsort(xs)  # texture coordinates run along the axes, or against them
        heights = np.empty((ny, nx))
        heights[np.ix_(*order)] = made.at(xs[order[1]], ys[order[0]], throw.size)
        heights /= self.frame.scale
        say(
            f"{self.key} begins by transport of light: {np.ptp(heights):.3g} scene units deep; nothing darker than "
            f"{100 * made.floor:g} % of the brightest; {100 * made.misplaced:.2g} % of the light misplaced"
        )
        return heights[:, :, None].astype(np.float32)

    def _picture(self, scene: mi.Scene, image: Array) -> tuple[Receiver, Array]:
        """The rectangle on the receiver about what is not dark, and the target in it (rows along `up`)."""
        rows, columns = image.shape
        column, row = np.meshgrid(np.arange(columns) + 0.5, np.arange(rows) + 0.5)
        seen = self._on_receiver(scene, self._places(column, row))
        image = np.where(seen & np.isfinite(image), np.maximum(image, 0), 0)
        bright = image[image > 0]
        if not bright.size:
            raise ConfigError("", "", f"has nothing to throw: the target is dark all over `{self.spec.receiver}`")
        lit = image > _DARK * np.percentile(bright, 99)
        if np.ptp(image[lit]) <= 0.02 * image.max() and lit.all():
            raise ConfigError("", "", "has nothing to throw: the target is of one colour")
        corners = np.concatenate(
            [self._places(column[lit] + a, row[lit] + b) for a in (-0.5, 0.5) for b in (-0.5, 0.5)]
        )
        centre = corners.mean(axis=0)
        normal = np.cross(self.plane[1], self.plane[2])
        centre_film = np.array([column[lit].mean()]), np.array([row[lit].mean()])
        along = self._places(centre_film[0] + 0.5, centre_film[1]) - self._places(centre_film[0] - 0.5, centre_film[1])
        px, py = (axis - centre * (axis @ normal) / (centre @ normal) for axis in np.eye(3)[:2])
        best: tuple[float, Array, Array] | None = None
        for axis in (along[0], self.plane[1], px):
            axis = axis / np.linalg.norm(axis)
            other = np.cross(normal, axis)
            across = max((axis, -axis, other, -other), key=lambda each: float(each @ px))
            up = np.cross(normal, across)
            up = up if up @ py > 0 else -up
            if across @ px < 0.93 * np.linalg.norm(px):  # light is to go from edges to edges
                continue
            area = float(np.prod([np.ptp(corners @ each) for each in (across, up)]))
            if best is None or area < 0.99 * best[0]:
                best = area, across, up
        assert best is not None, "the last one is px itself"
        _, across, up = best
        low, high = ([float(end(corners @ axis)) for axis in (across, up)] for end in (np.min, np.max))
        size = (high[0] - low[0], high[1] - low[1])
        middle = (centre @ normal) * normal + (low[0] + high[0]) / 2 * across + (low[1] + high[1]) / 2 * up
        pixel = np.sqrt(abs(float(np.linalg.norm(along))) * self._pixel_height(centre_film))
        n = [max(2, min(1024, round(side / pixel))) for side in size]
        s, t = np.meshgrid(*((np.arange(m) + 0.5) / m * side - side / 2 for m, side in zip(n, size, strict=True)))
        film = self._film(middle + s[..., None] * across + t[..., None] * up) - 0.5
        picture = scipy.ndimage.map_coordinates(image, film[::-1], order=1, mode="constant")
        if np.abs(film - np.round(film)).max() < 0.05:  # the film's own pixels
            return Receiver(middle, across, up, size), picture
        cut = [_blurred(picture.T), _blurred(picture)]
        for axis, (low_cut, high_cut) in zip((across, up), cut, strict=True):
            middle = middle + (low_cut - high_cut) / 2 * pixel * axis
        (left, right), (bottom, top) = cut
        size = (size[0] * (1 - (left + right) / n[0]), size[1] * (1 - (bottom + top) / n[1]))
        return Receiver(middle, across, up, size), picture[bottom : n[1] - top, left : n[0] - right]

    def _pixel_height(self, at: tuple[Array, Array]) -> float:
        return float(np.linalg.norm(self._places(at[0], at[1] + 0.5) - self._places(at[0], at[1] - 0.5)))

    def _places(self, column: Array, row: Array) -> Array:
        """Places (..., 3) on the receiver's plane of places on the film."""
        s, t, w = np.tensordot(self.film, np.stack([column, row, np.ones_like(column)]), 1)
        return self.plane[0] + (s / w)[..., None] * self.plane[1] + (t / w)[..., None] * self.plane[2]

    def _film(self, places: Array) -> Array:
        """Columns and rows (2, ...) of places on the receiver's plane."""
        off = places - self.plane[0]
        at = np.stack([off @ self.plane[1], off @ self.plane[2], np.ones(off.shape[:-1])])
        column, row, w = np.tensordot(np.linalg.inv(self.film), at, 1)
        return np.stack([column / w, row / w])

    def _on_receiver(self, scene: mi.Scene, places: Array) -> NDArray[np.bool_]:
        """Whether the receiver is there: a rectangle or a disk by itself, a mesh by its bounds."""
        points, shape = self.frame.back(places), self.receiver
        if shape.class_name() in ("Rectangle", "Disk"):
            inverse = np.linalg.inv(_matrix(mi.traverse(shape)["to_world"]))
            at = points @ inverse[:3, :3].T + inverse[:3, 3]
            far = np.hypot(at[..., 0], at[..., 1]) if shape.class_name() == "Disk" else np.abs(at[..., :2]).max(axis=-1)
            return np.asarray(far <= 1 + 1e-4)
        low, high = bounds(shape)
        margin = 1e-3 * np.max(high - low)
        return np.asarray(np.all((points >= low - margin) & (points <= high + margin), axis=-1))


def _blurred(rows: Array) -> tuple[int, int]:
    """How many rows at either end are none of a picture's: stray light, then its edge between pixels, of which up to
    three are less than half as bright as the next."""
    mean, found = rows.mean(axis=1), []
    least = 0.05 * float(np.median(mean))
    for each in (mean, mean[::-1]):
        first = min(int(np.argmax(each > least)), len(each) // 4)
        found.append(
            next((i for i in range(first, min(first + 3, len(each) // 3)) if each[i] >= 0.5 * each[i + 1]), first)
        )
    return found[0], found[1]


def prepare(problem: Problem) -> list[Start]:
    """The heightmaps that are to begin by transport, with all that the scene says of them. Raises ConfigError."""
    found: list[Start] = []
    for number, spec in enumerate(problem.config.parameters):
        if not isinstance(spec.initial, TransportValue):
            continue
        place = Place(problem.config.source, f"parameters[{number}]")
        if found:
            first = found[0].key
            raise place.fail("initial.transport", f"is asked for by `{first}` already; one face throws the picture")
        try:
            found.append(_read(problem, spec.names[0], spec.initial.transport, place))
        except _Wrong as error:
            raise place.fail(f"initial.transport{error.option}", str(error)) from None
        except ConfigError as error:
            raise error if error.key else place.fail("initial.transport", error.message) from None
    return found


def begin(problem: Problem, starts: list[Start], say: Callable[[str], None]) -> Problem:
    """The problem with these heightmaps as transport has them; its views have targets. Raises ConfigError."""
    values = {}
    for start in starts:
        say(f"{start.key}: looking for a face that throws the target")
        values[start.key] = value = start.make(problem, say)
        slot, settings = problem.selection.slot(start.key), problem.selection.spec(start.key)
        if settings.bounds is not None:
            check_bounds(slot, value, settings.bounds, start.place)
        check_transform(slot, value, settings, start.place)
    if not values:
        return problem
    problem.selection.set_arrays(values)
    for key in values:
        current = problem.selection.value(key)
        problem.optimizer.set_value(key, type(current)(current))
    problem.apply()
    return problem


class _Wrong(Exception):
    """What is wrong with the scene, and at which option below `transport` that is."""

    def __init__(self, message: str, option: str = "") -> None:
        super().__init__(message)
        self.option = option


def _read(problem: Problem, key: str, spec: TransportStart, place: Place) -> Start:
    scene, selection = problem.scene, problem.selection
    mesh, positions, texcoords, normals = selection.deformation.displaced(key)
    id = key.removesuffix(f".{HEIGHTMAP}")
    frame, size, ellipse = _frame(id, mesh, positions, texcoords, normals)
    eta = _material(mesh)
    if eta == 0:
        raise _Wrong(f"takes a face of glass or metal, and `{id}` has a {mesh.bsdf().class_name()}")
    toward, lamp, beam, lamp_name = _lamp(scene, spec, frame)
    receiver = next((shape for shape in scene.shapes() if shape.id() == spec.receiver), None)
    if receiver is None or receiver is mesh or receiver.id() == mesh.id():
        ids = ", ".join(f"`{shape.id()}`" for shape in scene.shapes() if shape.id() not in (mesh.id(), lamp_name))
        what = "is the face itself" if receiver is not None else f"`{spec.receiver}` is no shape of the scene"
        raise _Wrong(f"{what}; it has {ids}", ".receiver")
    plane = _plane(receiver)
    if plane is None:
        raise _Wrong(f"`{spec.receiver}` is a {receiver.class_name()} that is not plane; a rectangle would do",
                     ".receiver")  # fmt: skip
    point, axes = frame.place(plane[0]), frame.turn(plane[1])
    view, film, base = _camera(problem, spec.receiver, frame, point, axes)
    to = -toward if toward is not None else lamp / np.linalg.norm(lamp) if lamp is not None else np.zeros(3)
    if abs(to[2]) < _ALONG:
        raise _Wrong(f"cannot be: the light of `{lamp_name}` comes along `{id}`; turn one of the two")
    rectangle = Receiver(base[0], base[1], base[2], (_SIDE, _SIDE))
    side = float(rectangle.middle[2] * to[2])
    if eta is None and side <= 0:
        raise _Wrong(f"cannot be: `{spec.receiver}` stands behind the mirror `{id}`, seen from `{lamp_name}`")
    if eta is not None and side >= 0:
        raise _Wrong(f"cannot be: `{spec.receiver}` stands on the side of `{id}` that `{lamp_name}` is on, and glass "
                     "sends light through")  # fmt: skip
    before = after = None
    ratio = None
    if eta is not None:
        enters = to[2] > 0  # from outside, where z points
        ratio = eta if enters else 1 / eta
        reach = np.inf if lamp is None else float(np.linalg.norm(lamp))
        before = _interface(scene, mesh, frame, to, reach, 1 / ratio, "before", eta)
        way = rectangle.middle / np.linalg.norm(rectangle.middle)
        after = _interface(scene, mesh, frame, way, float(np.linalg.norm(rectangle.middle)), 1 / ratio, "behind", eta)
    throw = Throw(size, ratio, rectangle, toward, lamp, before, after, beam, ellipse)
    light, _ = throw.incoming(*(np.zeros(()),) * 3)
    if not np.all(np.isfinite(light)):
        raise _Wrong("cannot be: light is totally reflected before it comes to the face")
    x, y = np.meshgrid(*((np.arange(32) + 0.5) / 32 * side - side / 2 for side in size))
    arrives = throw.arriving(x, y, 0 * x, 0 * x, 0 * x)
    if not np.any(arrives > 0):
        raise _Wrong(f"cannot be: the light of `{lamp_name}` does not come to `{id}`")
    return Start(key, spec, place, frame, throw, receiver, view, film, base)


def _frame(id: str, mesh: mi.Mesh, positions: Array, texcoords: Array, normals: Array
           ) -> tuple[Frame, tuple[float, float], bool]:  # fmt: skip
    """Coordinates of a face, its size in them, and whether its outline is an ellipse."""
    extent = float(np.linalg.norm(np.ptp(positions, axis=0)))
    middle = positions.mean(axis=0)
    singular = np.linalg.svd((positions - middle)[:: max(1, len(positions) // 4096)], full_matrices=False)
    if np.abs((positions - middle) @ singular[2][2]).max() > _FLAT * extent:
        raise _Wrong(f"takes a heightmap over a plane, and `{id}` is curved")
    unknowns = np.column_stack([texcoords, np.ones(len(texcoords))])
    fit = np.linalg.lstsq(unknowns, positions, rcond=None)[0]
    if np.abs(unknowns @ fit - positions).max() > 10 * _FLAT * extent:
        raise _Wrong(f"takes a face with even texture coordinates, and those of `{id}` are none")
    lengths = np.linalg.norm(fit[:2], axis=1)
    x, y = fit[:2] / lengths[:, None]
    if abs(x @ y) > 1e-3:
        raise _Wrong(f"takes a rectangle, and the edges of `{id}` are not across each other")
    z = np.cross(x, y)
    z = z if z @ normals.mean(axis=0) > 0 else -z
    low, high = texcoords.min(axis=0), texcoords.max(axis=0)
    centre, sides = (low + high) / 2, (high - low) * lengths
    scale = _SIDE / float(sides.max())
    texels = np.stack([-centre * lengths * scale, lengths * scale], axis=1)
    corners = triangles(mesh)
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    filled = float(areas.sum() / np.prod(sides))
    ellipse = abs(filled - np.pi / 4) < 0.02
    if filled < 0.98 and not ellipse:
        raise _Wrong(f"takes a rectangle or an ellipse, and `{id}` fills {100 * filled:.0f} % of its rectangle")
    frame = Frame(centre @ fit[:2] + fit[2], np.stack([x, y, z]), scale, texels)
    return frame, (float(sides[0] * scale), float(sides[1] * scale)), ellipse


def _material(shape: mi.Shape) -> float | None:
    """Index within glass over that without; None of metal, 0 of anything else."""
    bsdf = shape.bsdf()
    kind = bsdf.class_name()
    if kind in ("SmoothDielectric", "RoughDielectric"):
        return float(np.ravel(mi.traverse(bsdf)["eta"])[0])
    metals = ("SmoothConductor", "RoughConductor")
    keys = [str(key) for key in mi.traverse(bsdf).keys()]  # noqa: SIM118 (not a mapping)
    wraps = kind == "TwoSidedBRDF" and any(".k." in key for key in keys)
    return None if kind in metals or wraps else 0.0


def _matrix(transform: Any) -> Array:
    """A transform (4, 4)."""
    return np.array(transform.matrix, dtype=np.float64).reshape(4, 4, -1)[:, :, 0]


def _plane(shape: mi.Shape) -> tuple[Array, Array] | None:
    """The middle of a plane shape, and two axes in it (2, 3), across each other; None of one that is not plane."""
    kind = shape.class_name()
    if kind in ("Rectangle", "Disk"):
        matrix = _matrix(mi.traverse(shape)["to_world"])
        first = matrix[:3, 0] / np.linalg.norm(matrix[:3, 0])
        second = matrix[:3, 1] - first * (first @ matrix[:3, 1])
        return matrix[:3, 3], np.stack([first, second / np.linalg.norm(second)])
    if not shape.is_mesh():
        return None
    points = np.unique(triangles(shape).reshape(-1, 3), axis=0)
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    spread = np.linalg.svd((points - points.mean(axis=0))[:: max(1, len(points) // 4096)], full_matrices=False)[2]
    off = np.abs((points - points.mean(axis=0)) @ spread[2]).max()
    if off > _FLAT * np.linalg.norm(np.ptp(points, axis=0)):
        return None
    middle = middle - spread[2] * (spread[2] @ (middle - points.mean(axis=0)))
    return middle, spread[:2]


def _interface(scene: mi.Scene, face: mi.Shape, frame: Frame, way: Array, reach: float, eta: float, where: str,
               glass: float) -> Interface | None:  # fmt: skip
    """The plane of glass that light meets along `way` from the face's middle, at less than `reach`."""
    found: list[tuple[str, Interface]] = []
    for shape in scene.shapes():
        index = None if shape.id() == face.id() else _material(shape)
        if not index:
            continue
        low, high = bounds(shape)
        radius = float(np.linalg.norm(high - low)) / 2 * frame.scale
        middle, plane = frame.place((low + high) / 2), _plane(shape)
        t = float(middle @ way)
        if plane is None:
            if 0 < t < reach and np.linalg.norm(middle - t * way) < radius:
                raise _Wrong(f"takes plane faces of glass besides its own, and `{shape.id()}`, {where} it, is curved")
            continue
        point, axes = frame.place(plane[0]), frame.turn(plane[1])
        normal = np.cross(axes[0], axes[1])
        facing = float(normal @ way)
        if abs(facing) < 1e-6:
            continue
        t = float(normal @ point) / facing
        if not 1e-6 * _SIDE < t < reach or np.linalg.norm(t * way - point) > radius:
            continue
        if abs(index / glass - 1) > 1e-3:
            raise _Wrong(f"takes one kind of glass, and `{shape.id()}` has an index of {index:g}, not {glass:g}")
        # along the light's way, which comes from the lamp and goes to the receiver
        sign = np.sign(facing) * (-1 if where == "before" else 1)
        found.append((shape.id(), Interface(point, sign * normal, eta)))
    if len(found) > 1:
        ids = " and ".join(f"`{id}`" for id, _ in found)
        raise _Wrong(f"takes one plane face of glass {where} its own, and there are {ids}")
    return found[0][1] if found else None


def _lamp(scene: mi.Scene, spec: TransportStart, frame: Frame) -> tuple[Array | None, Array | None, Beam | None, str]:
    """Direction of parallel light or the place of a lamp, its beam, and its name."""
    lamps = [(emitter, _name(emitter)) for emitter in scene.emitters() if _shines(emitter)]
    names = ", ".join(f"`{name}`" for _, name in lamps)
    if spec.lamp is not None:
        shape_of = {name: emitter.get_shape() for emitter, name in lamps}
        chosen = [pair for pair in lamps if spec.lamp in (pair[1], getattr(shape_of[pair[1]], "id", lambda: "")())]
        if not chosen:
            raise _Wrong(f"`{spec.lamp}` is no lamp that has light; there is {names or 'none'}", ".lamp")
        lamps = chosen
    if not lamps:
        raise _Wrong("takes a lamp, and the scene has none that has light")
    if len(lamps) > 1:
        raise _Wrong(f"takes the light of one lamp, and there are {names}; name one by `lamp`")
    emitter, name = lamps[0]
    kind, shape = emitter.class_name(), emitter.get_shape()
    if kind not in _LAMPS:
        raise _Wrong(f"takes a lamp with a place or a direction, and `{name}` is a {kind}")
    if kind == "DirectionalEmitter":
        return _unit(frame.turn(_matrix(mi.traverse(emitter)["to_world"])[:3, 2])), None, None, name
    if kind == "PointLight":
        return None, frame.place(np.ravel(mi.traverse(emitter)["position"]).astype(np.float64)), None, name
    if kind == "SpotLight":
        params = mi.traverse(emitter)
        matrix = _matrix(params["to_world"])
        axis = _unit(frame.turn(matrix[:3, 2]))
        cut, wide = (np.radians(float(np.ravel(params[key])[0])) for key in ("cutoff_angle", "beam_width"))

        def cone(source: Array, out: Array) -> Array:
            angle = np.arccos(np.clip(np.tensordot(axis, out, 1), -1, 1))
            return np.clip((cut - angle) / max(cut - wide, 1e-6), 0, 1)

        return None, frame.place(matrix[:3, 3]), cone, name
    normal = _lamp_normal(shape)
    if kind == "AreaLight":
        low, high = bounds(shape)
        facing = None if normal is None else frame.turn(normal)

        def lambertian(source: Array, out: Array) -> Array:
            return np.ones(out.shape[1:]) if facing is None else np.maximum(np.tensordot(facing, out, 1), 0)

        return None, frame.place((low + high) / 2), lambertian, name
    plane = _plane(shape)
    if normal is None or plane is None:
        raise _Wrong(f"takes parallel light, and `{shape.id()}`, a {shape.class_name()}, sends it in many directions")
    toward = _unit(frame.turn(normal))
    if shape.class_name() not in ("Rectangle", "Disk"):
        return toward, None, None, name
    inverse, is_disk = np.linalg.inv(_matrix(mi.traverse(shape)["to_world"])), shape.class_name() == "Disk"

    def ray(source: Array, out: Array) -> Array:
        """Whether it comes from the lamp: back from where it comes through the first plane, along its direction."""
        points = np.moveaxis(source, 0, -1)
        at = frame.back(points) @ inverse[:3, :3].T + inverse[:3, 3]
        far = np.hypot(at[..., 0], at[..., 1]) if is_disk else np.abs(at[..., :2]).max(axis=-1)
        return (far <= 1 + 1e-3).astype(np.float64)  # the normal is along the lamp's z: x and y stay on the way

    return toward, None, ray, name


def _lamp_normal(shape: mi.Shape) -> Array | None:
    """The direction in which a plane shape emits; None of one that is not plane."""
    plane = _plane(shape)
    if plane is None:
        return None
    sample = shape.sample_position(0.0, mi.Point2f(0.3, 0.4))
    return np.ravel(sample.n).astype(np.float64)


def _unit(vector: Array) -> Array:
    return vector / np.linalg.norm(vector)


def _name(emitter: mi.Emitter) -> str:
    shape = emitter.get_shape()
    return str(emitter.id() or (shape.id() if shape is not None else emitter.class_name()))


def _shines(emitter: mi.Emitter) -> bool:
    """Whether it sends any light, as far as its numbers say."""
    params = mi.traverse(emitter)
    keys = [key for key in params.keys() if key.endswith((".value", ".data"))]  # noqa: SIM118 (not a mapping)
    values = [key for key in keys if not key.startswith("texture")]
    return not values or any(np.any(np.array(params[key]) > 0) for key in values)


def _camera(problem: Problem, id: str, frame: Frame, point: Array, axes: Array) -> tuple[View, Array, Array]:
    """The view that sees the receiver, the map (3, 3) from its film to places in the plane, and these places' base.

    A camera's rays meet a plane by a projective map; it is fitted to some of them.
    """
    normal = np.cross(axes[0], axes[1])
    for view in problem.views:
        if view.held_out:
            continue
        sensor = problem.scene.sensors()[view.sensor]
        width, height = (int(n) for n in sensor.film().crop_size())
        a, b = (each.ravel() for each in np.meshgrid(np.linspace(0.02, 0.98, 6), np.linspace(0.02, 0.98, 6)))
        half = mi.Point2f(0.5, 0.5)
        ray, _ = sensor.sample_ray(0.0, 0.5, mi.Point2f(mi.Float(a), mi.Float(b)), half)
        origin, way = frame.place(np.array(ray.o).T.reshape(-1, 3)), frame.turn(np.array(ray.d).T.reshape(-1, 3))
        t = ((point - origin) @ normal) / (way @ normal)
        hit = np.isfinite(t) & (t > 0)
        if hit.sum() < 12:
            continue
        places = (origin + t[:, None] * way)[hit] - point
        s, u = places @ axes[0] / _SIDE, places @ axes[1] / _SIDE
        column, row = a[hit] * width, b[hit] * height
        film = _projective(a[hit], b[hit], s, u) @ np.diag([1 / width, 1 / height, 1])
        film = np.diag([_SIDE, _SIDE, 1]) @ film
        back = np.linalg.inv(film) @ np.stack([s * _SIDE, u * _SIDE, np.ones_like(s)])
        off = np.hypot(back[0] / back[2] - column, back[1] / back[2] - row)
        if off.max() < 0.25:
            return view, film, np.stack([point, axes[0], axes[1]])
    raise _Wrong(f"takes a camera that sees `{id}` in perspective, and no view has one", ".receiver")


def _projective(a: Array, b: Array, s: Array, t: Array) -> Array:
    """The matrix (3, 3) that takes (a, b, 1) to a multiple of (s, t, 1), by least squares."""
    one, zero = np.ones_like(a), np.zeros_like(a)
    first = np.stack([a, b, one, zero, zero, zero, -s * a, -s * b, -s], axis=1)
    second = np.stack([zero, zero, zero, a, b, one, -t * a, -t * b, -t], axis=1)
    return np.linalg.svd(np.concatenate([first, second]))[2][-1].reshape(3, 3)
