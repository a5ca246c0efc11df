"""The losses, each with the options that it knows."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from .base import NEEDS_TYPE, Choice, Positive, by_type, mark


class Loss(Choice):
    """A mean over pixels and channels of a function of the image I and the target T."""

    type: str


class L2(Loss):
    """Mean of (I - T)², I the image, T the target, over pixels and channels; so are the others."""

    type: Literal["l2"] = Field(default="l2", description="Mean of (I - T)².")


class L1(Loss):
    """Mean of |I - T|."""

    model_config = NEEDS_TYPE
    type: Literal["l1"] = Field(default="l1", description="Mean of |I - T|.")


class RelativeL2(Loss):
    """Mean of (I - T)² / (T² + epsilon)."""

    model_config = NEEDS_TYPE
    type: Literal["relative_l2"] = Field(default="relative_l2", description="Mean of (I - T)² / (T² + epsilon).")
    epsilon: Positive = Field(
        default=1e-2,
        description="Added to the denominator, in squared units of radiance; keeps dark pixels from dominating.",
    )


class LogL2(Loss):
    """Mean of (log(I + epsilon) - log(T + epsilon))², negative values as 0."""

    model_config = NEEDS_TYPE
    type: Literal["log_l2"] = Field(default="log_l2", description="Mean of (log(I + epsilon) - log(T + epsilon))².")
    epsilon: Positive = Field(default=1e-2, description="Added inside both logarithms, in units of radiance.")


AnyLoss = Annotated[
    Annotated[L2, mark("l2")]
    | Annotated[L1, mark("l1")]
    | Annotated[RelativeL2, mark("relative_l2")]
    | Annotated[LogL2, mark("log_l2")],
    by_type("l2"),
]
