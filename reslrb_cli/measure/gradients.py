"""Gradients of a scene over many seeds, in reverse and forward mode and by finite differences.

`Case` is a scene with its parameters and the objective sum(image * weights). The weights are fixed, so dL/dI is the
same for every estimator. A gradient is one flat vector over all parameters of a case.

Finite differences use common random numbers, along a few directions of one parameter (`Direction`). `choose_step` takes
the step h with the smallest sum of errors. The truncation error is c h^2 + ..., so two steps give that of the smaller
one (Richardson 1911).

    D(h) - F' ~ (D(r h) - D(h)) / (r^2 - 1)

A change that does not shrink with h is no truncation, and counts in full. Rounding errors of the scene, and waves of a
BSDF's tables, are equal for all seeds. They grow at most as 1 / h, so a change by a shorter step bounds them. Paths
that change discontinuously cause noise that grows as h shrinks, and varies between seeds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.backend.memory import own_memory
from reslrb_cli.config.parameters import ANGLES, tinted_by
from reslrb_cli.integrators.plugin import make_integrator
from reslrb_cli.integrators.protocol import Job, first_channels
from reslrb_cli.integrators.step import gradient_step, known_step, render_image
from reslrb_cli.measure.comparison import ROUNDING
from reslrb_cli.measure.scenes.small import load
from reslrb_cli.scene.catalog import parameter_kind
from reslrb_cli.scene.deformation import Deformation
from reslrb_cli.scene.dispersion import COEFFICIENT, bends_light
from reslrb_cli.scene.parameters import Selection
from reslrb_cli.scene.tints import Tints
from reslrb_cli.scene.upsampling import Upsampling
from reslrb_cli.statistics import rms

#: Size of a direction that moves an object, relative to the object's size.
REACH = 0.1

#: Size of a direction of a heightmap, relative to the scene's size.
RELIEF = 0.02

#: Size of a direction of a motion's component (rotations are in degrees), and of a glass's n_d and V_d. None: `REACH`
#: times the scene's size. A thousandth of the size is a step beyond the rounding of rays: a V_d of 10 was too small.
#: The size of a glass's coefficients is their own value.
UNITS = {"translation": None, "rotation": 10.0, "scale": REACH, "nd": 0.05, "Vd": 50.0} | dict.fromkeys(ANGLES, 10.0)

#: Least number of paths whose values are added to a sum in memory at once.
PACKET = 8

#: Nodes of a difference in steps, with their coefficients, for central and for one-sided differences.
NODES = {"both": {1: 0.5, -1: -0.5}, "up": {0: -1.5, 1: 2, 2: -0.5}, "down": {0: 1.5, -1: -2, -2: 0.5}}

#: Maximum number of wavelengths across a displaced object.
WAVES = 1.5


def moves_light(params: mi.SceneParameters, key: str) -> bool:
    """True if a parameter moves shapes, lights or refracted light. Motions and heightmaps always move shapes or lights.
    `params` does not contain motions or heightmaps.
    """
    if key not in params.properties:
        return tinted_by(key) is None
    kind = parameter_kind(params, key)
    return (
        bends_light(params, key)
        or kind == "shape"
        or (kind == "emitter" and key.rpartition(".")[2] in ("position", "to_world"))
    )


def smooth_weights(height: int, width: int, channels: int = 3) -> np.ndarray:
    """Return a smooth dL/dI of mean 1 that vanishes at the film's border, so that light beyond it has no effect.

    Finite differences of light that moves over the film need a smooth dL/dI. If dL/dI had noise in each pixel, steps
    would have to be much smaller than a pixel.
    """
    y, x = (np.mgrid[0:height, 0:width] + 0.5) / np.array([height, width]).reshape(2, 1, 1)
    value = np.stack([np.sin(5 * x) * np.cos(4 * y) + 1.5, np.cos(3 * x + 2 * y) + 1.2, x + y], -1)[:, :, :channels]
    inside = np.clip((np.minimum.reduce([x, 1 - x, y, 1 - y]) - 0.08) / 0.2, 0, 1)
    value *= (inside**2 * (3 - 2 * inside))[:, :, None]
    return np.asarray(value / value.mean())


def smooth_rows(key: str, value: Any, extent: float, count: int) -> list[np.ndarray]:
    """Return directions in which a parameter moves smoothly, one direction per row. A step is a fraction of a
    direction.

    Vertices move along random directions, with amplitudes that form a wave over the vertex positions. Heightmap texels
    change by waves over the texel grid. For small parameters (a position, a rotation), all entries move. `extent` is
    the scene's size.
    """
    random, found, name = np.random.default_rng(3), [], key.rpartition(".")[2]
    shape = np.shape(value)
    for _ in range(count):
        if name == "vertex_positions":
            points = np.array(value, float).reshape(-1, 3)
            size = float(np.linalg.norm(np.ptp(points, axis=0)))
            wave = _waves(points / (size or 1.0), random)
            towards = random.normal(size=3)
            row = REACH * size * wave[:, None] * towards / np.linalg.norm(towards)
        elif name not in UNITS and len(shape) >= 2:
            grid = np.stack(np.meshgrid(*(np.linspace(0, 1, n) for n in shape[:2]), indexing="ij"), -1)
            wave = _waves(grid.reshape(-1, 2), random).reshape(shape[:2])
            row = RELIEF * extent * np.broadcast_to(wave.reshape(*shape[:2], *(1 for _ in shape[2:])), shape)
        else:
            unit = np.abs(value) if COEFFICIENT.search(key) else UNITS.get(name) or REACH * extent
            row = unit * random.uniform(0.5, 1, shape) * random.choice([-1.0, 1.0], shape)
        found.append(np.ravel(row))
    return found


def _waves(points: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Return a random wave (N,) over points (N, D) of about unit extent."""
    wave = random.normal(size=points.shape[1])
    wave *= random.uniform(0.5, 1) * WAVES * 2 * np.pi / np.linalg.norm(wave)
    return np.asarray(np.cos(points @ wave + random.uniform(0, 2 * np.pi)))


#: Candidate steps, as fractions of the direction.
STEPS = (0.1, 0.01, 0.001)

#: Assumed number of seeds of the comparison, which scales the noise of a single seed.
PLANNED_SEEDS = 16


@dataclass(frozen=True)
class Direction:
    """A direction in the space of all parameters (P,), in the parameters' own units.

    `sides` is as in `Case.difference`. `step` is a fraction of `vector`. `truncation` bounds the absolute error that is
    equal for all seeds, in units of the difference.
    """

    vector: np.ndarray
    sides: str
    step: float = STEPS[0]
    truncation: float = 0.0

    def difference(self, case: Case, integrator: Any, seed: int, spp: int) -> float:
        """Return the finite difference of the objective along the direction."""
        return case.difference(integrator, self.vector, seed, spp, self.step, self.sides)


def directions(case: Case, key: str, bounds: tuple[float, float], count: int) -> list[Direction]:
    """Return up to `count` directions that change only the parameter `key` and stay within its `bounds`.

    If the largest step would take an entry beyond a bound, differences are one-sided, and in all directions every entry
    moves away from its nearer bound. Otherwise, all entries grow in the first direction, so nothing cancels. The other
    directions have random signs.
    Entries are 0.5 to 1 times the width of the bounds. With infinite bounds, entries are 0.5 to 1 times the parameter's
    size.
    """
    random, found = np.random.default_rng(3), []
    values, (low, high) = case.initial[key], bounds
    scale = high - low if np.isfinite(high - low) else rms(values) or 1.0
    reach = STEPS[0] * scale
    near_a_bound = bool(np.any(values - reach < low) or np.any(values + reach > high))
    inward = np.where(high - values >= values - low, 1.0, -1.0)
    for number in range(min(count, len(values))):
        size = scale * random.uniform(0.5, 1.0, len(values))
        signs = np.ones(len(values)) if number == 0 else random.choice([-1.0, 1.0], len(values))
        row = size * (inward if near_a_bound else signs)
        found.append(Direction(embed(case, key, row), "up" if near_a_bound else "both"))
    return found


def all_directions(case: Case, selection: Selection, moving: int, others: int) -> dict[str, list[Direction]]:
    """Return directions by parameter. A parameter that moves light gets `moving` smooth directions. Any other parameter
    gets `others` directions.
    """
    box, found = case.scene.bbox(), {}
    extent = float(np.linalg.norm(np.array(box.max - box.min)))
    for key in case.keys:
        if moves_light(case.params, key):
            rows = smooth_rows(key, case.values.value(key), extent, moving)
            found[key] = [Direction(embed(case, key, row), "both") for row in rows]
            continue
        bounds = selection.specs[key].bounds
        if bounds is None or not np.all(np.isfinite(bounds)):
            bounds = natural_bounds(parameter_kind(case.params, key), case.initial[key])
        found[key] = directions(case, key, bounds, others)
    return found


def choose_step(case: Case, integrator: Any, direction: Direction, seeds: Sequence[int], spp: int) -> Direction:
    """Return `direction` with the step whose estimated error is the smallest. This needs at least two seeds."""
    samples = {
        step: np.array([replace(direction, step=step).difference(case, integrator, seed, spp) for seed in seeds])
        for step in STEPS
    }
    best, least, before = direction, np.inf, np.inf
    for larger, smaller, shorter in zip(STEPS, STEPS[1:], (*STEPS[2:], None), strict=False):
        change = samples[larger] - samples[smaller]
        spread = float(change.std(ddof=1))
        changed = abs(float(change.mean())) + spread / np.sqrt(len(seeds))
        # Truncation shrinks at least as fast as h, even at kinks.
        truncation = changed / ((larger / smaller) ** 2 - 1) if changed <= before * smaller / larger else changed
        if shorter is not None:
            further = samples[smaller] - samples[shorter]
            certain = abs(float(further.mean())) - float(further.std(ddof=1)) / np.sqrt(len(seeds))
            truncation += max(certain, 0.0) * shorter / smaller
        before = changed
        error = truncation + spread / np.sqrt(PLANNED_SEEDS)
        if error < least:
            best, least = replace(direction, step=smaller, truncation=truncation), error
    return best


def natural_bounds(kind: str, values: np.ndarray) -> tuple[float, float]:
    """Return plausible bounds for a parameter with this `kind` (`ParameterInfo.kind`) and these `values`.

    The bounds are 0 to 1 if all values are in this range, except for emitters. Otherwise, the bounds are 0 to infinity
    if no value is negative.
    """
    if kind != "emitter" and np.all((values >= 0) & (values <= 1)):
        return 0.0, 1.0
    return (0.0, np.inf) if np.all(values >= 0) else (-np.inf, np.inf)


def embed(case: Case, key: str, row: np.ndarray) -> np.ndarray:
    """Return a vector (P,) with the given `row` for one parameter, and zeros for all other parameters."""
    whole = np.zeros(case.size)
    whole[case.places[key]] = row
    return whole


class Case:
    """A scene (or a dictionary to load) with one sensor, parameters, and a linear objective.

    `keys` are keys of `values`, or of the scene if `values` is not given. `values` is a `Selection`, or has its
    `params`, `value`, `hand_over`, `collect` and `push`.
    """

    def __init__(self, scene: Any, keys: Iterable[str], sensor: int = 0, values: Any = None) -> None:
        self.scene = load(scene) if isinstance(scene, dict) else scene
        self.sensor = sensor
        if values is None:
            params = mi.traverse(self.scene)
            colours = Upsampling(params)
            values = Selection(params, {}, {}, Deformation(params), Tints(params, colours), colours)
            for key in keys:
                values.colours.add(key)
        self.values, self.params = values, values.params
        self.keys = list(keys)
        #: Relative rounding errors of the gradients so far by colours, by parameter.
        self.roundings: dict[str, float] = {}
        self.initial = {key: np.array(values.value(key), dtype=np.float64).ravel() for key in self.keys}
        self.places = places({key: len(row) for key, row in self.initial.items()})
        self.size = sum(map(len, self.initial.values()))
        film = self.scene.sensors()[sensor].film()
        width, height = film.crop_size()
        self.channels = int(film.base_channels_count())
        colors = self.channels if mi.has_flag(film.flags(), mi.FilmFlags.Spectral) else 1 if self.channels <= 2 else 3
        shape = (int(height), int(width), colors)
        # The mean is 1, so that entries do not cancel. Random weights reveal wrong film positions.
        self.weigh(np.random.default_rng(7).uniform(0.2, 1.8, shape))

    def weigh(self, weights: np.ndarray) -> None:
        """Set the objective's weights dL/dI, (H, W, C) without alpha."""
        self.weights = mi.TensorXf(np.ascontiguousarray(weights, np.float32))

    @property
    def adjoint(self) -> Any:
        """dL/dI (H, W, C) with the channels of the film. It is 0 for alpha."""
        weights = np.array(self.weights)
        return mi.TensorXf(np.pad(weights, ((0, 0), (0, 0), (0, self.channels - weights.shape[2]))))

    def shaped(self, key: str, row: np.ndarray) -> Any:
        """Convert a flat array of values to the parameter's type."""
        now, array = self.values.value(key), np.asarray(row, np.float32)
        kind = type(now)
        if dr.is_tensor_v(kind):
            return kind(own_memory(dr.array_t(kind), array.ravel()), now.shape)
        return kind(*array.tolist()) if dr.depth_v(kind) > 1 else own_memory(kind, array)

    def set(self, values: dict[str, np.ndarray]) -> None:
        """Set parameters from rows of values."""
        self.values.hand_over(self._all_shaped(values))

    def _all_shaped(self, values: dict[str, np.ndarray]) -> dict[str, Any]:
        shaped = {key: self.shaped(key, value) for key, value in values.items()}
        dr.make_opaque(shaped)
        return shaped

    def objective(self, image: Any) -> Any:
        """Return sum(image * weights) over the colour channels."""
        return dr.sum(first_channels(image, self.weights.shape[2]) * self.weights, axis=None)

    def gradient(self, integrator: Any, seed: int, spp: int, objective: Callable | None = None,
                 step: Callable = gradient_step, **options: Any) -> np.ndarray:  # fmt: skip
        """Return the gradient of all parameters from one step, as a flat array. `options` are the step's options."""
        leaves = self.leaves()
        result = self.gradient_of(leaves, integrator, seed, spp, objective, step, **options)
        self.release(leaves)
        return result

    def gradient_of(self, leaves: dict[str, Any], integrator: Any, seed: int, spp: int,
                    objective: Callable | None = None, step: Callable = gradient_step, **options: Any
                    ) -> np.ndarray:  # fmt: skip
        """Return the gradient of `leaves` from one step, as a flat array, and clear it. The scene has the `leaves`."""
        objective = objective or self.objective
        step(integrator, self.scene, self.sensor, objective, seed=seed, spp=spp, params=self.params, **options)
        if mi.is_spectral and isinstance(self.values, Selection):  # before the gradients are collected
            sums = dr.prod(self.weights.shape[:2]) * spp / PACKET
            for key, condition in self.values.colours.cancellation().items():
                self.roundings[key] = max(self.rounding(key), 2.0**-24 * np.sqrt(sums) * condition)
        self.values.collect()
        result = [np.array(dr.grad(leaf), dtype=np.float64).ravel() for leaf in leaves.values()]
        dr.clear_grad(leaves)
        return np.concatenate(result)

    def rounding(self, key: str | None = None) -> float:
        """Return the relative error of single precision in the gradients so far by the parameter `key`, or by all.

        In a spectral variant, gradients by colours are sums of gradients by coefficients, which cancel
        (`Upsampling.cancellation`). Each coefficient's gradient is a sum of k values in single precision. If the values
        are similar, the rounding errors of its partial sums add up to a standard error of about 2^-24 sqrt(k) / 4. Four
        of them are the limit.
        """
        return max([ROUNDING, *(value for name, value in self.roundings.items() if key in (None, name))])

    def known_step(self, integrator: Any, scene: Any, sensor: Any, _objective: Any, **options: Any) -> Any:
        """Take a step with dL/dI known before the image, as the `step` argument of `gradient`."""
        return known_step(integrator, scene, sensor, self.adjoint, **options)

    def leaves(self, values: dict[str, np.ndarray] | None = None) -> dict[str, Any]:
        """Create leaves with derivatives for all parameters, and set them in the scene. The leaves have the current
        values, or rows of `values`.

        The leaves are copies, because the scene may replace values by derived values. For example, an environment map
        pads its columns.
        """
        now = {key: self.values.value(key) for key in self.keys} if values is None else self._all_shaped(values)
        leaves = {key: type(value)(dr.detach(value)) for key, value in now.items()}
        dr.enable_grad(leaves)
        self.values.hand_over({key: type(leaf)(leaf) for key, leaf in leaves.items()})
        return leaves

    def release(self, leaves: dict[str, Any]) -> None:
        """Detach the scene's values from `leaves`."""
        self.values.hand_over({key: dr.detach(leaf) for key, leaf in leaves.items()})

    def gradients(self, integrator: Any, seeds: Iterable[int], spp: int, **step: Any) -> np.ndarray:
        """Return the gradients at all seeds, (N, P)."""
        return np.stack([self.gradient(integrator, seed, spp, **step) for seed in seeds])

    def image(self, integrator: Any, seed: int, spp: int) -> np.ndarray:
        """Render an image, (H, W, C) float64, without alpha."""
        image = np.array(render_image(integrator, self.scene, self.sensor, seed, spp), np.float64)
        return image[:, :, : self.weights.shape[2]]

    def weighted(self, image: np.ndarray) -> float:
        """Return the objective of an image. If `image` is the derivative of an image, return the objective's
        derivative.
        """
        return float(np.sum(image[:, :, : self.weights.shape[2]] * np.array(self.weights)))

    def along(self, direction: np.ndarray, tangent: Callable[[], Any]) -> np.ndarray:
        """Set the parameters' tangent to `direction` (P,), and return the image of `tangent()` as float64.

        For forward mode, `tangent` renders the derivative of the image along this direction.
        """
        leaves = self.leaves()
        for key, leaf in leaves.items():
            dr.set_grad(leaf, self.shaped(key, direction[self.places[key]]))
            dr.enqueue(dr.ADMode.Forward, leaf)
        dr.traverse(dr.ADMode.Forward, dr.ADFlag.ClearEdges)
        self.values.push()
        image = np.array(tangent(), dtype=np.float64)
        self.release(leaves)
        return image

    def tangent(self, integrator: Any, direction: np.ndarray, seed: int, spp: int) -> float:
        """Return the objective's derivative along `direction` (P,) in forward mode."""
        sensor, opaque = self.scene.sensors()[self.sensor], dr.opaque(mi.UInt32, seed)
        return self.weighted(
            self.along(direction, lambda: integrator.tangent(Job(self.scene, sensor, opaque, spp, self.params)))
        )

    def directions(self, count: int) -> np.ndarray:
        """Return random directions (count, P) in the space of parameters. Entries have magnitudes from 0.5 to 1 and
        random signs.
        """
        random, shape = np.random.default_rng(3), (count, self.size)
        return random.uniform(0.5, 1.0, shape) * random.choice([-1.0, 1.0], shape)

    def difference(self, integrator: Any, direction: np.ndarray, seed: int, spp: int, step: float, sides: str = "both"
                   ) -> float:  # fmt: skip
        """Return the finite difference of the objective along `direction`, at common random numbers.

        `sides` is `both` for central differences. At the edge of the domain, `up` or `down` selects one-sided
        differences. All three have an error of second order.
        """
        total = 0.0
        for node, coefficient in NODES[sides].items():
            self.set({key: self.initial[key] + step * node * direction[at] for key, at in self.places.items()})
            total += coefficient * self.weighted(self.image(integrator, seed, spp))
        self.set(self.initial)
        return total / step

    def differences(
        self, integrator: Any, directions: np.ndarray, seeds: Iterable[int], spp: int, step: float, sides: str = "both"
    ) -> np.ndarray:
        """Return finite differences (N, K) along each of K directions at each of N seeds."""
        return np.array(
            [[self.difference(integrator, d, seed, spp, step, sides) for d in directions] for seed in seeds]
        )


def places(sizes: Mapping[str, int]) -> dict[str, slice]:
    """Return the slices of consecutive blocks of these sizes."""
    ends = np.cumsum([0, *sizes.values()]).tolist()
    return {key: slice(*ends[number : number + 2]) for number, key in enumerate(sizes)}


def seeds(count: int, block: int = 0) -> range:
    """Return `count` seeds. Different blocks have different seeds."""
    return range(1000 * block + 100, 1000 * block + 100 + count)


def integrator(name: str, max_depth: int = 4, rr_depth: int = 1000, **options: Any) -> Any:
    """Create an integrator for `gradient_step`, by default without roulette. Without an `estimator`, `reslrb` has no
    automatic settings: it traces light paths for the reservoir, unless other `paths` are given.
    """
    if name == "reslrb":
        options = {"estimator": "stack" if options.get("paths") == "camera" else "reservoir", **options}
    return make_integrator(name, max_depth=max_depth, rr_depth=rr_depth, **options)


def relative(a: np.ndarray, b: np.ndarray) -> float:
    """Return the relative L2 distance of a from b."""
    return float(np.linalg.norm(a - b) / np.linalg.norm(b))
