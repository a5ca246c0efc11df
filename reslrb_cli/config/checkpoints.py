"""How often a run keeps its state."""

from __future__ import annotations

from typing import Any

from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator
from typing_extensions import Self

from .base import Count, Positive, Section, located


class CheckpointEvery(Section):
    """Exactly one of `iterations` and `seconds`."""

    iterations: Count | None = Field(default=None, description="Iterations between two checkpoints.")
    seconds: Positive | None = Field(default=None, description="Seconds between two checkpoints, at least.")

    @model_validator(mode="after")
    def _check_one(self) -> Self:
        if (self.iterations is None) == (self.seconds is None):
            has = "none" if self.seconds is None else "both"
            raise located("", f"must have exactly one of `iterations` and `seconds`, and has {has}")
        return self

    @model_serializer(mode="wrap")
    def _without_unused(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return {key: value for key, value in handler(self).items() if value is not None}

    def is_due(self, iterations: int, seconds: float) -> bool:
        """Whether it is time for one, so many iterations and seconds after the last."""
        return iterations >= self.iterations if self.iterations is not None else seconds > (self.seconds or 0.0)
