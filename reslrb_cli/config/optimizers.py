"""The losses and the optimisers of a run, with their options."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    Discriminator,
    Field,
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
    code_file,
    located,
    mark,
)


class Loss(Choice):
    """A mean over pixels and channels of a function of the image I and the target T."""

    type: str
    weight: Positive = 1.0
    """Factor of an entry in a list of losses, such as `loss: [{type: l2, weight: 1}, {type: ssim, weight: 0.1}]`. Only
    in a list."""

    def idle(self) -> set[str]:
        return {"weight"} if self.weight == 1 else set()

    def own_options(self) -> dict[str, Any]:
        """Return the options of the function itself (epsilon, ...), without those that all losses share."""
        return {name: value for name, value in self.options().items() if name not in Loss.model_fields}


class L2(Loss):
    """Mean of (I - T)² over pixels and channels. I is the image, T the target. The other losses are means, too."""

    type: Literal["l2"] = Field(default="l2", description="Mean of (I - T)².")


class L1(Loss, json_schema_extra=NEEDS_TYPE):
    """Mean of |I - T|."""

    type: Literal["l1"] = Field(default="l1", description="Mean of |I - T|.")


class RelativeL2(Loss, json_schema_extra=NEEDS_TYPE):
    """Mean of (I - T)² / (T² + epsilon)."""

    type: Literal["relative_l2"] = Field(default="relative_l2", description="Mean of (I - T)² / (T² + epsilon).")
    epsilon: Positive = 1e-2
    """Added to the denominator, in squared units of radiance. Keeps dark pixels from dominating the loss."""


class SSIM(Loss, json_schema_extra=NEEDS_TYPE):
    """1 - mean SSIM (Wang et al. 2004) of linear radiance, computed for each channel. Windows have 11x11 pixels and
    Gaussian weights with a standard deviation of 1.5. All windows lie within the image, so the image needs at least
    11x11 pixels. The data range L in SSIM's constants is the largest value of the target. In a window, masked pixels
    count as equal to the target. Windows centred at masked pixels are left out.
    """

    type: Literal["ssim"] = Field(default="ssim", description="1 - mean SSIM (Wang et al. 2004).")


class Custom(Loss, json_schema_extra=NEEDS_TYPE):
    """Your own loss, a Python function. Needs `--allow-code` on the command line
    ([A loss of one's own](losses.md#a-loss-of-ones-own))."""

    type: Literal["custom"] = Field(default="custom", description="Your own loss, a Python function.")
    file: CodePlace | None = None
    """`FILE.py:NAME`: a Python file, relative to the config file, and a function in it:
    `NAME(image: mi.TensorXf, target: mi.TensorXf) -> mi.Float`. The function may take a third argument, `weights`. A
    run stores a digest of the file, without the modules that it imports, and resumes only with the same file. null: the
    function that was passed in Python."""

    @property
    def path(self) -> Path | None:
        """The file of code."""
        return None if self.file is None else code_file(self.file)

    @property
    def name(self) -> str:
        """The name of the function in the file."""
        return "" if self.file is None else self.file.rpartition(":")[2]


AnyLoss = Annotated[L2 | L1 | RelativeL2 | SSIM | Custom, ByType("l2")]


def _loss_kind(value: Any) -> str:
    return MARK + "list" if isinstance(value, list) else MARK + "mapping"


def _check_single(loss: Loss) -> Loss:
    if "weight" in loss.model_fields_set:
        raise located("weight", "needs a list of losses, `loss: [{type: l2, weight: 1}, ...]`; remove it")
    return loss


#: One loss, or a list of losses that are summed.
Losses = Annotated[
    Annotated[AnyLoss, AfterValidator(_check_single), mark("mapping")]
    | Annotated[list[AnyLoss], Field(min_length=1, max_length=16), mark("list")],
    Discriminator(_loss_kind),
]


def loss_keys(name: str, given: Loss | Sequence[Loss]) -> list[tuple[str, Loss]]:
    """Return the entries of `loss`. Each entry comes with the key of its option `name`."""
    if isinstance(given, Loss):
        return [(f"loss.{name}", given)]
    return [(f"loss[{number}].{name}", one) for number, one in enumerate(given)]


def loss_words(losses: Sequence[Loss]) -> str:
    """Return the losses in short: `l2`, or `l2 + 0.1 ssim`."""
    parts = [f"{loss.type}" if loss.weight == 1 else f"{loss.weight:g} {loss.type}" for loss in losses]
    return " + ".join(parts)


_Decay = Annotated[float, Field(ge=0, lt=1)]


class OptimizerSettings(Choice):
    """Options of all optimisers: the learning rate and its schedule."""

    type: str
    learning_rate: Positive = 0.02
    """Step size at the first iteration, in the units of the parameter, or of its transformed variable if it has a
    `transform`."""
    scale: Literal["none", "curvature"] = "none"
    """Units in which `sgd` moves each parameter. `none`: its own. `curvature`: the gradient of each parameter is
    divided by the largest curvature of the loss, which a run measures before its first iteration. A learning rate of 1
    is then the step that reaches the minimum along the steepest direction; the default is 0.5."""
    schedule: Literal["constant", "cosine", "exponential"] = "constant"
    """How the learning rate changes from its first to its last value."""
    final_fraction: float = Field(default=0.01, gt=0, le=1)
    """Last learning rate divided by the first. Only with a schedule other than `constant`."""

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
            raise located("scale", f"curvature needs type: sgd; steps of {self.type} do not grow with gradients")
        return self

    def idle(self) -> set[str]:
        return {"final_fraction"} if self.schedule == "constant" else set()

    def own_options(self) -> dict[str, Any]:
        """Return the options of the update rule itself (beta_1, ...), without those that all optimisers share."""
        return {name: value for name, value in self.options().items() if name not in OptimizerSettings.model_fields}


class Adam(OptimizerSettings):
    """Adam (Kingma and Ba 2015)."""

    type: Literal["adam"] = Field(default="adam", description="Adam (Kingma and Ba 2015).")
    beta_1: _Decay = Field(default=0.9, description="Decay of the running mean of the gradient.")
    beta_2: _Decay = Field(
        default=0.9,
        description="Decay of the running mean of the squared gradient. A larger decay suits textures with noisy "
        "gradients. It also remembers the large gradients of a bad start for longer, and steps are short until then: "
        "with 0.999, for a thousand iterations.",
    )
    epsilon: Positive = Field(default=1e-8, description="Added to the root of the mean squared gradient.")


class SGD(OptimizerSettings, json_schema_extra=NEEDS_TYPE):
    """Gradient descent with momentum."""

    type: Literal["sgd"] = Field(default="sgd", description="Gradient descent, with momentum if it is above 0.")
    momentum: _Decay = Field(default=0.0, description="Decay of the running sum of gradients. 0: no momentum.")


class Auto(OptimizerSettings, json_schema_extra=NEEDS_TYPE):
    """Steps from measured curvature ([Optimizers](optimizers.md)). Needs no learning rate and no schedule, and ends the
    run when every parameter is close to the optimum. `run.iterations` is the limit. Not for heightmaps of more than 32
    texels, places outside of a `motion`, the refraction of a glass, and `precondition`."""

    type: Literal["auto"] = Field(default="auto", description="Steps from measured curvature, without a rate.")
    learning_rate: Positive = Field(default=1.0, description="Not with `auto`.")

    @model_validator(mode="before")
    @classmethod
    def _check_alone(cls, values: Any) -> Any:
        for name in OptimizerSettings.model_fields:
            if isinstance(values, dict) and name in values and name != "type":
                raise located(name, "has no effect with type: auto, which measures its steps; remove it, or take adam")
        return values

    def idle(self) -> set[str]:
        return set(OptimizerSettings.model_fields) - {"type"}


AnyOptimizer = Annotated[Adam | SGD | Auto, ByType("adam")]
