"""Gradients of a scene over many seeds, derivatives in forward mode, and finite differences.

An objective is sum(image * weights) with fixed random weights, so dL/dI is the same for every estimator. A gradient is
one flat vector over all parameters of a case.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from reslrb_cli.integrators import Job, first_channels, gradient_step, make_integrator, render_image
from reslrb_cli.measure.small_scenes import load
from reslrb_cli.measure.values import SceneValues, Values


class Case:
    """A scene, its parameters, and a linear objective."""

    @classmethod
    def of(cls, loaded: Any, keys: Iterable[str], sensor: int = 0, values: Values | None = None) -> Case:
        """A case of a scene that is loaded already, seen through one of its sensors.

        `keys` are of `values`, where these are given, and of the scene otherwise.
        """
        return cls(loaded, keys, sensor=sensor, values=values)

    def __init__(
        self, scene: Any, keys: Iterable[str], seed: int = 7, sensor: int = 0, values: Values | None = None
    ) -> None:
        self.scene = load(scene) if isinstance(scene, dict) else scene
        self.sensor = sensor
        self.values: Values = SceneValues(self.scene) if values is None else values
        self.params = self.values.params
        self.keys = list(keys)
        self.initial = {key: self.flat(key) for key in self.keys}
        film = self.scene.sensors()[sensor].film()
        width, height = film.crop_size()
        self.channels = int(film.base_channels_count())
        shape = (int(height), int(width), 1 if self.channels <= 2 else 3)
        # Mean 1, so that entries do not cancel; random, so that a wrong film position shows.
        self.weigh(np.random.default_rng(seed).uniform(0.2, 1.8, shape))

    def weigh(self, weights: np.ndarray) -> None:
        """Set the weights of the objective, (H, W, C) without alpha: dL/dI."""
        import mitsuba as mi

        self.weights = mi.TensorXf(np.ascontiguousarray(weights, np.float32))

    @property
    def adjoint(self) -> Any:
        """dL/dI, (H, W, C) with as many channels as the film has: none of its alpha counts."""
        import mitsuba as mi

        weights = np.array(self.weights)
        return mi.TensorXf(np.pad(weights, ((0, 0), (0, 0), (0, self.channels - weights.shape[2]))))

    def flat(self, key: str) -> np.ndarray:
        """The parameter's values in a row; colours that are stored by channel come channel by channel."""
        return np.array(self.values.value(key), dtype=np.float64).ravel()

    def shaped(self, key: str, row: np.ndarray) -> Any:
        """A row of values as the parameter's type."""
        import drjit as dr

        from reslrb_cli.backend.own_memory import own_memory

        now, array = self.values.value(key), np.asarray(row, np.float32)
        kind = type(now)
        if dr.is_tensor_v(kind):
            return kind(own_memory(dr.array_t(kind), array.ravel()), now.shape)
        return kind(*array.tolist()) if dr.depth_v(kind) > 1 else own_memory(kind, array)

    def set(self, values: dict[str, np.ndarray]) -> None:
        """Set parameters from rows of values."""
        import drjit as dr

        shaped = {key: self.shaped(key, value) for key, value in values.items()}
        dr.make_opaque(shaped)
        self.values.hand_over(shaped)

    def objective(self, image: Any) -> Any:
        """sum(image * weights) over the colour channels."""
        import drjit as dr

        return dr.sum(first_channels(image, self.weights.shape[2]) * self.weights, axis=None)

    def gradient(self, integrator: Any, seed: int, spp: int, objective: Callable | None = None,
                 step: Callable = gradient_step, **options: Any) -> np.ndarray:  # fmt: skip
        """The gradient of all parameters in a row, by one step; `options` are the step's."""
        import drjit as dr

        leaves = self.leaves()
        objective = objective or self.objective
        step(integrator, self.scene, self.sensor, objective, seed=seed, spp=spp, params=self.params, **options)
        self.values.collect()
        result = [np.array(dr.grad(leaf), dtype=np.float64).ravel() for leaf in leaves.values()]
        self.release(leaves)
        return np.concatenate(result)

    def leaves(self) -> dict[str, Any]:
        """The parameters with derivatives enabled, handed over to the scene.

        They are leaves of our own: the scene may put something derived in their place (an environment map pads its
        columns).
        """
        import drjit as dr

        leaves = {}
        for key in self.keys:
            value = self.values.value(key)
            leaves[key] = type(value)(dr.detach(value))
            dr.enable_grad(leaves[key])
        self.values.hand_over({key: type(leaf)(leaf) for key, leaf in leaves.items()})
        return leaves

    def release(self, leaves: dict[str, Any]) -> None:
        """Have the scene forget the derivatives that `leaves` gave it."""
        import drjit as dr

        self.values.hand_over({key: dr.detach(leaf) for key, leaf in leaves.items()})

    def gradients(self, integrator: Any, seeds: Iterable[int], spp: int, **step: Any) -> np.ndarray:
        """Gradients at all seeds: (N, P)."""
        return np.stack([self.gradient(integrator, seed, spp, **step) for seed in seeds])

    def value(self, integrator: Any, seed: int, spp: int) -> float:
        """The objective."""
        return self.weighted(self.image(integrator, seed, spp))

    def image(self, integrator: Any, seed: int, spp: int) -> np.ndarray:
        """The image, (H, W, C) float64, without alpha."""
        image = np.array(render_image(integrator, self.scene, self.sensor, seed, spp), np.float64)
        return image[:, :, : self.weights.shape[2]]

    def weighted(self, image: np.ndarray) -> float:
        """The objective of an image, or its derivative where `image` is one."""
        return float(np.sum(image[:, :, : self.weights.shape[2]] * np.array(self.weights)))

    def along(self, direction: np.ndarray, tangent: Callable[[], Any]) -> np.ndarray:
        """What `tangent()` returns, an image, while the parameters carry the tangent `direction` (P,); float64.

        For forward mode: `tangent` is to render the derivative of the image along that direction.
        """
        import drjit as dr

        leaves, at = self.leaves(), 0
        for key, leaf in leaves.items():
            size = len(self.initial[key])
            dr.set_grad(leaf, self.shaped(key, direction[at : at + size]))
            dr.enqueue(dr.ADMode.Forward, leaf)
            at += size
        dr.traverse(dr.ADMode.Forward, dr.ADFlag.ClearEdges)
        self.values.push()
        image = np.array(tangent(), dtype=np.float64)
        self.release(leaves)
        return image

    def tangent(self, integrator: Any, direction: np.ndarray, seed: int, spp: int) -> float:
        """The objective's derivative along `direction` (P,) in forward mode."""
        import drjit as dr
        import mitsuba as mi

        sensor, opaque = self.scene.sensors()[self.sensor], dr.opaque(mi.UInt32, seed)
        return self.weighted(
            self.along(direction, lambda: integrator.tangent(Job(self.scene, sensor, opaque, spp, self.params)))
        )

    def directions(self, count: int, seed: int = 3) -> np.ndarray:
        """Random directions in the space of parameters, (count, P): entries of size 0.5 to 1, either sign."""
        random = np.random.default_rng(seed)
        size = sum(len(value) for value in self.initial.values())
        return random.uniform(0.5, 1.0, (count, size)) * random.choice([-1.0, 1.0], (count, size))

    def difference(self, integrator: Any, direction: np.ndarray, seed: int, spp: int, step: float, sides: str = "both"
                   ) -> float:  # fmt: skip
        """Finite difference of the objective along `direction`, at common random numbers.

        `sides`: `both` (second order), or `up` / `down`, also second order, where the domain ends here.
        """
        nodes = {"both": (1, -1), "up": (0, 1, 2), "down": (0, -1, -2)}[sides]
        coefficients = {"both": (0.5, -0.5), "up": (-1.5, 2, -0.5), "down": (1.5, -2, 0.5)}[sides]
        total = 0.0
        for node, coefficient in zip(nodes, coefficients, strict=True):
            at, values = 0, {}
            for key, value in self.initial.items():
                values[key] = value + step * node * direction[at : at + len(value)]
                at += len(value)
            self.set(values)
            total += coefficient * self.value(integrator, seed, spp)
        self.set(self.initial)
        return total / step


def seeds(count: int, block: int = 0) -> range:
    """`count` seeds; another `block` has others."""
    return range(1000 * block + 100, 1000 * block + 100 + count)


def integrator(name: str, max_depth: int = 4, rr_depth: int = 1000, **options: Any) -> Any:
    """An integrator without roulette unless asked for, as `gradient_step` takes it."""
    return make_integrator(name, max_depth=max_depth, rr_depth=rr_depth, **options)


def relative(a: np.ndarray, b: np.ndarray) -> float:
    """Relative L2 distance of a from b."""
    return float(np.linalg.norm(a - b) / np.linalg.norm(b))
