"""Scenes, and gradients over many seeds, for the gradient conformance tests.

An objective is sum(image * weights) with fixed random weights, so dL/dI is the same for every estimator. A gradient is
one flat vector over all parameters of a case.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from reslrb_cli.integrators import gradient_step, make_integrator, render_image

SIZE = 16


def texture(height: int, width: int, low: float = 0.2, high: float = 0.8, seed: int = 1, channels: int = 3) -> dict:
    """A bitmap of random texels, by nearest neighbour so that each texel is a parameter of its own."""
    data = np.random.default_rng(seed).uniform(low, high, (height, width, channels)).astype(np.float32)
    return bitmap(data)


def bitmap(data: np.ndarray, filter_type: str = "nearest") -> dict:
    """A bitmap texture that holds `data` (H, W, C) as it is."""
    import mitsuba as mi

    return {"type": "bitmap", "data": mi.TensorXf(np.ascontiguousarray(data, np.float32)), "raw": True,
            "filter_type": filter_type, "wrap_mode": "clamp"}  # fmt: skip


def rgb(*value: float) -> dict:
    """A colour."""
    return {"type": "rgb", "value": list(value)}


def diffuse(*value: float) -> dict:
    """A diffuse BSDF of this colour."""
    return {"type": "diffuse", "reflectance": rgb(*value)}


def transform(**steps: Any) -> Any:
    """A transform of `translate`, `rotate` (axis, angle) and `scale`, applied in reverse order of naming."""
    import mitsuba as mi

    result = mi.ScalarTransform4f()
    for name, value in steps.items():
        if name == "rotate":
            axis, angle = value
            result = result @ mi.ScalarTransform4f().rotate(np.divide(axis, np.linalg.norm(axis)).tolist(), angle)
        else:
            result = result @ getattr(mi.ScalarTransform4f(), name)(value)
    return result


def camera(rfilter: str = "box", size: int = SIZE, sensor: str = "perspective", **film: Any) -> dict:
    """A camera that looks at the corner of the room."""
    import mitsuba as mi

    lens = {"aperture_radius": 0.1, "focus_distance": 4.0} if sensor == "thinlens" else {}
    return {
        "type": sensor,
        "fov": 45,
        **lens,
        "to_world": mi.ScalarTransform4f().look_at(origin=[1.2, 0.6, 4], target=[-0.1, -0.2, 0], up=[0, 1, 0]),
        "film": {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "rgb",
                 "rfilter": {"type": rfilter}, **film},
        "sampler": {"type": "independent"},
    }  # fmt: skip


def room(**changes: Any) -> dict:
    """A corner of a room, floor and two walls, under an area light that the camera does not see.

    `changes` replace or add objects; None takes one away.
    """
    scene = {
        "type": "scene",
        "camera": camera(),
        "floor": {"type": "twosided", "bsdf": diffuse(0.7, 0.5, 0.6)},
        "wall": {"type": "twosided", "bsdf": diffuse(0.5, 0.7, 0.4)},
        "side": {"type": "twosided", "bsdf": diffuse(0.6, 0.4, 0.7)},
        "floor_shape": {"type": "rectangle", "to_world": transform(translate=[0, -1, 0], rotate=([1, 0, 0], -90)),
                        "bsdf": {"type": "ref", "id": "floor"}},
        "wall_shape": {"type": "rectangle", "to_world": transform(translate=[0, 0, -1]),
                       "bsdf": {"type": "ref", "id": "wall"}},
        "side_shape": {"type": "rectangle", "to_world": transform(translate=[-1, 0, 0], rotate=([0, 1, 0], 90)),
                       "bsdf": {"type": "ref", "id": "side"}},
        "lamp": lamp(radiance=rgb(3.0, 4.0, 5.0)),
    }  # fmt: skip
    scene.update(changes)
    return {key: value for key, value in scene.items() if value is not None}


def lamp(**emitter: Any) -> dict:
    """A square area light above the room that shines down into it; `emitter` are options of its `area` emitter."""
    return {
        "type": "rectangle",
        "to_world": transform(translate=[0.2, 1.6, 0.2], rotate=([1, 0, 0], 90), scale=0.6),
        "bsdf": diffuse(0.0, 0.0, 0.0),
        "emitter": {"type": "area", **emitter},
    }


def load(scene: dict) -> Any:
    """The scene, its objects as they stand."""
    import mitsuba as mi

    return mi.load_dict(scene, optimize=False)


class Case:
    """A scene, its parameters, and a linear objective."""

    @classmethod
    def of(cls, loaded: Any, keys: Iterable[str]) -> Case:
        """A case of a scene that is loaded already."""
        return cls(loaded, keys)

    def __init__(self, scene: Any, keys: Iterable[str], seed: int = 7) -> None:
        import mitsuba as mi

        self.scene = load(scene) if isinstance(scene, dict) else scene
        self.params = mi.traverse(self.scene)
        self.keys = list(keys)
        self.initial = {key: self.flat(key) for key in self.keys}
        # mean 1, so that entries do not cancel; random, so that a wrong film position shows
        size = self.scene.sensors()[0].film().crop_size()
        shape = (int(size[1]), int(size[0]), 3)
        self.weights = mi.TensorXf(np.random.default_rng(seed).uniform(0.2, 1.8, shape).astype(np.float32))

    def flat(self, key: str) -> np.ndarray:
        """The parameter's values in a row; colours that are stored by channel come channel by channel."""
        return np.array(self.params[key], dtype=np.float64).ravel()

    def shaped(self, key: str, row: np.ndarray) -> Any:
        """A row of values as the parameter's type."""
        import drjit as dr

        kind, array = type(self.params[key]), np.asarray(row, np.float32)
        if dr.is_tensor_v(kind):
            # A sum, since NumPy's own memory would be used as it is: kernels depend on its alignment, which is random.
            return kind(array.reshape(self.params[key].shape)) + dr.opaque(dr.array_t(kind), 0)
        return kind(*array.tolist()) if dr.depth_v(kind) > 1 else kind(array) + dr.opaque(kind, 0)

    def set(self, values: dict[str, np.ndarray]) -> None:
        """Set parameters from rows of values."""
        import drjit as dr

        for key, value in values.items():
            shaped = self.shaped(key, value)
            dr.make_opaque(shaped)
            self.params[key] = shaped
        self.settle()

    def settle(self) -> None:
        """Run what parameters still have to do after a change (textures pad their storage), ahead of the next step."""
        import drjit as dr
        import mitsuba as mi

        self.params.update()
        for key in self.keys:
            node = self.params.properties[key][2]
            if isinstance(node, mi.Texture):
                node.eval(dr.zeros(mi.SurfaceInteraction3f))
        dr.eval([self.params[key] for key in self.keys])

    def objective(self, image: Any) -> Any:
        """sum(image * weights) over the colour channels."""
        import drjit as dr

        return dr.sum(image[:, :, :3] * self.weights, axis=None)

    def gradient(self, integrator: Any, seed: int, spp: int, objective: Callable | None = None,
                 step: Callable = gradient_step, **options: Any) -> np.ndarray:  # fmt: skip
        """The gradient of all parameters in a row, by one step; `options` are the step's."""
        import drjit as dr

        # Leaves of our own: `update` may put something derived in their place (an environment map pads its columns).
        leaves = {key: type(self.params[key])(dr.detach(self.params[key])) for key in self.keys}
        for key, leaf in leaves.items():
            dr.enable_grad(leaf)
            self.params[key] = type(leaf)(leaf)
        self.settle()
        objective = objective or self.objective
        step(integrator, self.scene, 0, objective, seed=seed, spp=spp, params=self.params, **options)
        result = [np.array(dr.grad(leaf), dtype=np.float64).ravel() for leaf in leaves.values()]
        for key in self.keys:
            self.params[key] = dr.detach(leaves[key])
        self.settle()
        return np.concatenate(result)

    def gradients(self, integrator: Any, seeds: Iterable[int], spp: int, **step: Any) -> np.ndarray:
        """Gradients at all seeds: (N, P)."""
        return np.stack([self.gradient(integrator, seed, spp, **step) for seed in seeds])

    def value(self, integrator: Any, seed: int, spp: int) -> float:
        """The objective."""
        image = render_image(integrator, self.scene, 0, seed, spp)
        return float(np.sum(np.array(image, np.float64)[:, :, :3] * np.array(self.weights)))

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
    """An integrator without roulette unless asked for."""
    return make_integrator(name, max_depth=max_depth, rr_depth=rr_depth, **options)


def relative(a: np.ndarray, b: np.ndarray) -> float:
    """Relative L2 distance of a from b."""
    return float(np.linalg.norm(a - b) / np.linalg.norm(b))
