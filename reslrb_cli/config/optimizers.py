"""The losses and the optimisers, each with the options that it knows, and the stages in which a run begins."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    Discriminator,
    Field,
    SerializerFunctionWrapHandler,
    model_serializer,
    model_validator,
)
from typing_extensions import Self

from reslrb_cli.config.base import (
    MARK,
    NEEDS_TYPE,
    ByType,
    Choice,
    CodePlace,
    Positive,
    Section,
    code_file,
    located,
    mark,
)


class Loss(Choice):
    """A mean over pixels and channels of a function of the image I and the target T."""

    type: str
    scale: Literal["none", "fitted"] = "none"
    """`fitted`: in each step, and for each view by itself, the image is multiplied by s = <I, T> / <I, I> before it is
    compared, sums over the pixels inside the mask and all channels: how bright the image is does not matter, and the
    gradient goes through s. <I, I> is taken between two halves of the samples, since noise would make s too small."""
    weight: Positive = 1.0
    """What an entry of a list of losses (`loss: [{type: l2, weight: 1}, {type: ssim, weight: 0.1}]`) is multiplied by
    before they are added up; only there. In a list, `scale` is the same in all entries."""

    @model_serializer(mode="wrap")
    def _without_unasked(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        values: dict[str, Any] = handler(self)
        for name, usual in (("scale", "none"), ("weight", 1.0)):
            if values.get(name) == usual:
                del values[name]
        return values

    def own_options(self) -> dict[str, Any]:
        """Options of the function itself (epsilon, ...): those that not all types share."""
        return {name: value for name, value in self.options().items() if name not in Loss.model_fields}


class L2(Loss):
    """Mean of (I - T)², I the image, T the target, over pixels and channels; so are the others."""

    type: Literal["l2"] = Field(default="l2", description="Mean of (I - T)².")


class L1(Loss, json_schema_extra=NEEDS_TYPE):
    """Mean of |I - T|."""

    type: Literal["l1"] = Field(default="l1", description="Mean of |I - T|.")


class RelativeL2(Loss, json_schema_extra=NEEDS_TYPE):
    """Mean of (I - T)² / (T² + epsilon)."""

    type: Literal["relative_l2"] = Field(default="relative_l2", description="Mean of (I - T)² / (T² + epsilon).")
    epsilon: Positive = 1e-2
    """Added to the denominator, in squared units of radiance; keeps dark pixels from dominating."""


class SSIM(Loss, json_schema_extra=NEEDS_TYPE):
    """1 - mean SSIM (Wang et al. 2004) of windows of 11x11 pixels, Gaussian with a standard deviation of 1.5, each
    channel by itself, of linear radiance. L, the data range of SSIM's constants, is the target's largest value. Windows
    lie within the image, which has 11x11 pixels or more. Pixels that are left out are in a window as if they were the
    target's, and windows about them do not count."""

    type: Literal["ssim"] = Field(default="ssim", description="1 - mean SSIM (Wang et al. 2004).")


class Custom(Loss, json_schema_extra=NEEDS_TYPE):
    """What a function of one's own returns, `file`; only where the command line has `--allow-code`
    ([method.md](method.md#a-loss-of-ones-own))."""

    type: Literal["custom"] = Field(default="custom", description="What a function of one's own returns.")
    file: CodePlace | None = None
    """`FILE.py:NAME`: a file of Python code, relative to the config file, and the function in it:
    `NAME(image: mi.TensorXf, target: mi.TensorXf) -> mi.Float`, or with a third argument, `weights`. A run keeps a
    digest of the file's bytes, not of what it imports, and goes on with no other. null: the function that a caller in
    Python hands over."""

    @property
    def path(self) -> Path | None:
        """The file of code."""
        return None if self.file is None else code_file(self.file)

    @property
    def name(self) -> str:
        """The function's name in it."""
        return "" if self.file is None else self.file.rpartition(":")[2]


AnyLoss = Annotated[L2 | L1 | RelativeL2 | SSIM | Custom, ByType("l2")]


def _loss_kind(value: Any) -> str:
    return MARK + "list" if isinstance(value, list) else MARK + "mapping"


def _check_list(losses: list[Loss]) -> list[Loss]:
    for place, loss in enumerate(losses):
        if loss.scale != losses[0].scale:
            raise located(f"[{place}].scale", "must be the same in all entries of a list: all are fitted, or none is")
    return losses


def _check_single(loss: Loss) -> Loss:
    if "weight" in loss.model_fields_set:
        raise located("weight", "goes with a list of losses, `loss: [{type: l2, weight: 1}, ...]`; remove it")
    return loss


#: One loss, or the list of those whose sum is the loss.
Losses = Annotated[
    Annotated[AnyLoss, AfterValidator(_check_single), mark("mapping")]
    | Annotated[list[AnyLoss], Field(min_length=1, max_length=16), AfterValidator(_check_list), mark("list")],
    Discriminator(_loss_kind),
]


def losses_of(given: Loss | Sequence[Loss]) -> list[Loss]:
    """Return the entries of `loss`, a single one as a list of it."""
    return [given] if isinstance(given, Loss) else list(given)


def loss_keys(name: str, given: Loss | Sequence[Loss]) -> list[tuple[str, Loss]]:
    """Return the entries of `loss`, each with the key of its option `name`."""
    if isinstance(given, Loss):
        return [(f"loss.{name}", given)]
    return [(f"loss[{number}].{name}", one) for number, one in enumerate(given)]


def loss_words(given: Loss | Sequence[Loss]) -> str:
    """Of what a loss is made, in short: `l2`, or `l2 + 0.1 ssim`."""
    parts = [f"{loss.type}" if loss.weight == 1 else f"{loss.weight:g} {loss.type}" for loss in losses_of(given)]
    return " + ".join(parts)


_Decay = Annotated[float, Field(ge=0, lt=1)]


class StopRule(Section):
    """When a loss is taken to stand."""

    patience: Annotated[int, Field(ge=5, lt=2**31)] = 20
    """Iterations of a window. The loss is tested at the end of each, from the third on. At least 20 where views are
    held out, whose loss is known every 10 iterations."""
    relative: Annotated[float, Field(ge=0, lt=1)] = 0.01
    """The loss stands where it is shown to fall by less than this share of itself from one window to the next. The
    smaller this is, and the more noise losses have, the more windows the test needs."""


class Optimizer(Choice):
    """Options that all optimisers share: the learning rate and its schedule."""

    type: str
    learning_rate: Positive = 0.02
    """Step size at the first iteration, in the parameter's units; in those of its `transform`, where it has one; with
    `scale: auto`, as a share of the measured length."""
    scale: Literal["none", "auto", "curvature"] = "none"
    """`auto`: before the first iteration, measure for each parameter the length by which it would have to change to
    make up the image where it has an effect, and how large its gradient is, and let the optimizer move each in units of
    its own: one learning rate serves parameters that differ by orders of magnitude, and `epsilon` does not matter.
    Learning rates are then shares of that length: 0.02 is 2 % a step.
    `curvature`, for `sgd`: measure the largest curvature of the loss by each parameter, and divide gradients by it. A
    learning rate of 1 is then the step that ends at the bottom in the steepest direction; the default is 0.5."""
    schedule: Literal["constant", "cosine", "exponential", "plateau"] = "constant"
    """How the learning rate runs from its first value to its last. `plateau`: the rate is halved each time that the
    loss stands, as `run.stop` defines it."""
    final_fraction: float = Field(default=0.01, gt=0, le=1)
    """Last learning rate over the first; only with a schedule other than `constant`."""
    clamp_gradient: Annotated[float, Field(ge=1)] | None = None
    """Clamp each entry of a gradient at so many times its usual size: the larger of the running means of its own
    absolute value and of those of all entries of the parameter. Takes the noise of rare bright paths, and is biased by
    what it takes, which the run reports. null: no clamp."""

    @model_validator(mode="after")
    def _check_schedule(self) -> Self:
        if self.schedule == "constant" and "final_fraction" in self.model_fields_set:
            raise located("final_fraction", "has no effect on a constant learning rate; set `schedule` or remove it")
        return self

    @model_validator(mode="before")
    @classmethod
    def _fill_rate(cls, values: Any) -> Any:
        if isinstance(values, dict) and values.get("scale") == "curvature":
            return {"learning_rate": 0.5, **values}
        return values

    @model_validator(mode="after")
    def _check_scale(self) -> Self:
        if self.scale == "curvature" and self.type != "sgd":
            raise located("scale", f"curvature goes with type: sgd; steps of {self.type} do not grow with gradients")
        return self

    @model_serializer(mode="wrap")
    def _without_unused(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        values: dict[str, Any] = handler(self)
        if self.schedule == "constant":
            values.pop("final_fraction", None)
        return values

    def own_options(self) -> dict[str, Any]:
        """Options of the update rule itself (beta_1, momentum, ...): those that not all types share."""
        return {name: value for name, value in self.options().items() if name not in Optimizer.model_fields}


class Adam(Optimizer):
    """Adam (Kingma and Ba 2015)."""

    type: Literal["adam"] = Field(default="adam", description="Adam (Kingma and Ba 2015).")
    beta_1: _Decay = Field(default=0.9, description="Decay of the running mean of the gradient.")
    beta_2: _Decay = Field(
        default=0.9,
        description="Decay of the running mean of the squared gradient. A larger decay suits textures whose gradients "
        "are noisy. It also remembers the large gradients of a bad start for longer, and steps stay short meanwhile: "
        "0.999 for a thousand iterations.",
    )
    epsilon: Positive = Field(default=1e-8, description="Added to the root of the mean squared gradient.")


class SGD(Optimizer, json_schema_extra=NEEDS_TYPE):
    """Gradient descent with momentum."""

    type: Literal["sgd"] = Field(default="sgd", description="Gradient descent, with momentum if that is above 0.")
    momentum: _Decay = Field(default=0.0, description="Decay of the running sum of gradients; 0: none.")


AnyOptimizer = Annotated[Adam | SGD, ByType("adam")]


_Share = Annotated[float, Field(gt=0, le=1)]


class Stage(Section):
    """A part of a run, until a share of its iterations is done; what it leaves out is as the run has it."""

    until: Annotated[float, Field(gt=0, lt=1)]
    """Share of the run's iterations after which the next stage begins, or, after the last one, the run as it is
    configured."""
    resolution: _Share = 1.0
    """Of heightmaps and textures, width and height, and of a heightmap's mesh that is a flat grid with a vertex for
    each texel. What several keys share, and textures that only a mesh's file has, keep theirs."""
    film: _Share = 1.0
    """Width and height of the films: one over a whole number that divides them. The target's pixels are means of as
    many, by their weights."""

    @property
    def grain(self) -> tuple[float, float]:
        """What makes it another problem than the run's: the resolution and the film."""
        return self.resolution, self.film


#: What a run is when its stages are over.
AS_CONFIGURED = Stage.model_construct(until=1.0)


def check_stages(stages: list[Stage]) -> None:
    """Raise an error, located, where stages are not in their order, or one is coarser than another before
    it."""
    for place, (before, stage) in enumerate(pairwise(stages), 1):
        if stage.until <= before.until:
            raise located(f"run.stages[{place}].until", f"must be above {before.until:g}, that of the stage before it")
        for name in ("resolution", "film"):
            if getattr(stage, name) < getattr(before, name):
                reason = f"must be at least {getattr(before, name):g}, that of the stage before it"
                raise located(f"run.stages[{place}].{name}", reason)
