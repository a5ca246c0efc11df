"""Rendering as an operation of PyTorch. Needs the package torch: `pip install 'reslrb[torch]'`.

`render` returns an image that autograd differentiates. Forward is one rendering without a graph of Dr.Jit's AD, and
backward is the second half of a gradient step (`integrators/step.py`), with the dL/dI that autograd passes. Parameters
are copied into Dr.Jit's memory, because the scene keeps them. Images and gradients are shared through DLPack.
"""

from __future__ import annotations

import functools
import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import drjit as dr
import mitsuba as mi

from reslrb_cli.api.experiment import held
from reslrb_cli.backend.memory import own_memory
from reslrb_cli.errors import ConfigError
from reslrb_cli.estimators.base import one_of
from reslrb_cli.integrators.protocol import Job, StepIntegrator
from reslrb_cli.integrators.step import Refused, interface_of, make_job, second_seed
from reslrb_cli.runs.loggers import package
from reslrb_cli.scene.parameters import matching_keys
from reslrb_cli.scene.plastic import with_tables
from reslrb_cli.scene.values import ParameterValue, Place, settle

if TYPE_CHECKING:
    import torch

logger = logging.getLogger(__name__)


def render(
    scene: mi.Scene,
    params: Mapping[str, torch.Tensor],
    sensor: mi.Sensor | int = 0,
    integrator: mi.Integrator | None = None,
    seed: int = 0,
    spp: int = 0,
    adjoint: Literal["independent", "correlated"] = "independent",
) -> torch.Tensor:
    """Render an image in PyTorch. Autograd differentiates the image with respect to `params`.

    Returns a float32 tensor (height, width, channels) in linear radiance, on the device of the variant.

    - `params` maps keys of `mi.traverse(scene)` to tensors: textures (height, width, channels) in any resolution,
        colours (channels,), numbers (), buffers such as `vertex_positions` with all their entries in any shape. Tensors
        that require a gradient get one. The scene keeps the values.
    - `sensor` is a sensor of the scene, or its index.
    - `integrator` is `reslrb` or a stock integrator, by default the scene's own.
    - `seed` selects the random numbers. Give each step another seed.
    - `spp` is the number of samples per pixel. 0 means the sensor's sample count.
    - `adjoint` selects the samples of the gradient, as in `step`: `independent` (with a seed of their own) or
        `correlated` (those of the image). With `independent`, gradients of an L2 loss are unbiased.

    Between `render` and the backward pass, do not change other values of the scene. Entries of dL/dI that are not
    finite count as 0, and the log (`logging.WARNING`) has their number. Gradients of gradients are not supported.

    Raises ConfigError for a key or a shape that the scene does not have, or if the package torch is missing. Also
    raises UnsupportedScene, ValueError for other invalid arguments, and BackendError under an unsupported variant.
    """
    pytorch = package("torch", "torch")
    one_of("adjoint", adjoint, ("independent", "correlated"))
    chosen = scene.integrator() if integrator is None else integrator
    if chosen is None:
        raise ConfigError("integrator", "", 'is missing, and the scene has none; give mi.load_dict({"type": "reslrb"})')
    job = make_job(scene, sensor, seed, spp, None)
    tensors, slots = [], []
    for key, value in params.items():
        slots.append(_Slot.of(job.params, key))
        tensors.append(slots[-1].shaped(pytorch.as_tensor(value)))
    tracked = [pytorch.is_grad_enabled() and tensor.requires_grad for tensor in tensors]
    step = _Step(interface_of(chosen), job, slots, tracked, adjoint == "independent")
    image: torch.Tensor = _operation().apply(step, *tensors)
    return image


@dataclass(frozen=True)
class _Slot:
    """Parameter of a scene that a tensor determines."""

    key: str
    value: ParameterValue

    @classmethod
    def of(cls, params: mi.SceneParameters, key: str) -> _Slot:
        """Return the slot of `key`. Raises ConfigError if the parameter cannot be differentiated."""
        place = Place("params", "", lambda _: "")
        keys = matching_keys(params, key, place)
        if keys != [key]:
            raise place.fail("", f"`{key}` is a glob; name each parameter")
        return cls(key, ParameterValue(params, key))

    def shaped(self, tensor: torch.Tensor) -> torch.Tensor:
        """Return the tensor in the form of the scene's parameter, as float32. Raises ConfigError if it does not fit."""
        now = self.value.get().shape
        if self.value.is_texture:
            fits = tensor.ndim == 3 and tensor.shape[2] == now[2] and min(tensor.shape) > 0
        else:
            fits = tensor.numel() == math.prod(now)
        if not fits:
            shapes = [" x ".join(map(str, shape)) or "one number" for shape in (tensor.shape, now)]
            raise ConfigError("params", self.key, f"has the shape {shapes[0]}, but the scene's parameter {shapes[1]}")
        pytorch = package("torch", "torch")
        tensor = tensor.to("cuda" if dr.backend_v(mi.Float) == dr.JitBackend.CUDA else "cpu", pytorch.float32)
        if self.value.halo:
            columns = self.value.halo
            tensor = pytorch.cat([tensor[:, -columns:], tensor, tensor[:, :columns]], 1)
        return tensor

    def value_of(self, tensor: torch.Tensor) -> Any:
        """Return the value for the scene."""
        flat = own_memory(mi.Float, tensor.detach().contiguous().reshape(-1))
        if self.value.is_tensor:
            return self.value.type(flat, tuple(tensor.shape))
        return flat if dr.depth_v(self.value.type) == 1 else dr.unravel(self.value.type, flat)


class _Step:
    """One rendering, and the gradient step that belongs to it. `tracked` tells which parameters need a gradient."""

    def __init__(
        self, integrator: StepIntegrator, job: Job, slots: list[_Slot], tracked: list[bool], independent: bool
    ) -> None:
        self._integrator, self._job, self._slots, self._independent = integrator, job, slots, independent
        self._tracked = tracked
        self._values: dict[str, Any] = {}
        self._current: list[Any] = []

    def image(self, tensors: tuple[torch.Tensor, ...]) -> mi.TensorXf:
        """Set the parameters, and return the image."""
        for slot, tensor, is_tracked in zip(self._slots, tensors, self._tracked, strict=True):
            self._values[slot.key] = value = slot.value_of(tensor)
            if is_tracked:
                dr.enable_grad(value)
        self._set()
        image = dr.detach(self._integrator.image(self._job))
        dr.eval(image)
        return image

    def _set(self) -> None:
        params = self._job.params
        assert params is not None
        for key, value in self._values.items():
            params[key] = value
        params.update()
        settled = settle(params, self._values)
        self._current = [type(params[key])(params[key]) for key in self._values]  # copies: the originals change
        dr.eval(self._current, settled)

    def gradients(self, adjoint_image: mi.TensorXf) -> list[Any]:
        """Return the gradient of each parameter for dL/dI, or None for a parameter that needs none."""
        params = self._job.params
        assert params is not None
        variables = dr.detail.collect_indices  # numbers of the variables that hold a value: they change with it
        if variables([params[key] for key in self._values]) != variables(self._current):
            self._set()  # a later rendering, or the caller, has set other values
            self._job = replace(self._job, plans={})
        seed = second_seed(self._job.seed) if self._independent else self._job.seed
        refused = Refused()
        adjoint_image = refused.take(adjoint_image)
        dr.eval(adjoint_image, refused)
        tracked = {key: value for key, value in self._values.items() if dr.grad_enabled(value)}
        dr.clear_grad(tracked)
        with with_tables(params):
            self._integrator.backward(replace(self._job, seed=seed), adjoint_image)
        found = {key: dr.grad(value) for key, value in tracked.items()}
        dr.eval(found)
        dr.clear_grad(tracked)
        if count := int(refused.count[0]):
            x, y, channel = refused.entry() or (0, 0, 0)
            logger.warning(f"{count} entries of dL/dI are not finite and count as 0; the first: ({x}, {y}), {channel}")
        return [found.get(key) for key in self._values]


@functools.cache
def _operation() -> Any:
    """Return the class of the operation, which derives from a class of torch."""
    pytorch = package("torch", "torch")

    def given(tensor: torch.Tensor) -> None:
        """Wait until torch has computed a tensor that Dr.Jit will read."""
        if tensor.is_cuda:
            pytorch.cuda.current_stream(tensor.device).synchronize()

    def taken(value: Any, shape: tuple[int, ...]) -> torch.Tensor:
        """Return an evaluated value of Dr.Jit as a tensor that shares its memory."""
        flat = value.array if dr.is_tensor_v(value) else value if dr.depth_v(value) == 1 else dr.ravel(value)
        dr.eval(flat)
        dr.sync_thread()  # torch has a stream of its own
        return flat.torch().reshape(shape)

    class TorchImage(pytorch.autograd.Function):  # type: ignore[name-defined]
        """Image of a scene as a function of parameters."""

        @staticmethod
        def forward(ctx: Any, step: _Step, *tensors: torch.Tensor) -> torch.Tensor:
            ctx.step, ctx.shapes = step, [tensor.shape for tensor in tensors]
            with held():
                for tensor in tensors:
                    given(tensor)
                image = step.image(tensors)
                return taken(image, image.shape)

        @staticmethod
        @pytorch.autograd.function.once_differentiable
        def backward(ctx: Any, gradient: torch.Tensor) -> Any:
            with held():
                given(gradient)
                flat = own_memory(mi.Float, gradient.contiguous().reshape(-1))
                found = ctx.step.gradients(mi.TensorXf(flat, tuple(gradient.shape)))
                shaped = zip(found, ctx.shapes, strict=True)
                return None, *(None if each is None else taken(each, shape) for each, shape in shaped)

    return TorchImage
