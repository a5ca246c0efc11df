"""What moves, as a configuration says it: heightmaps on meshes, and motions with their settings by word."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from pydantic import BeforeValidator, Discriminator, Field, WithJsonSchema, field_validator

from .base import MARK, Count, Positive, Section, by_kind, mark, wrong
from .limits import KEY_LENGTH, PIXELS

Numbers = Annotated[list[float], Field(min_length=1)]
#: What a motion has; it is applied in the opposite order.
Word = Literal["translation", "rotation", "scale"]
WORDS: tuple[Word, ...] = ("translation", "rotation", "scale")
#: The name, below its mesh's, of what a heightmap recovers.
HEIGHTMAP = "heightmap"


# --- settings of a motion, by what of it is free ----------------------------------------------------------------------


class ByWord(Section):
    """Settings of a motion, each by its word."""

    TAG: ClassVar[str] = "words"

    def words(self) -> dict[str, Any]:
        """What is set, by word."""
        return {word: value for word in WORDS if (value := getattr(self, word)) is not None}


def or_words(plain: str) -> Discriminator:
    """Tells a mapping by the words of a motion (`words`) from what is tagged `plain`, which is anything else."""
    return Discriminator(lambda value: MARK + (ByWord.TAG if isinstance(value, (dict, ByWord)) else plain))


_NumberOrList = Annotated[
    Annotated[float, mark("number")] | Annotated[Numbers, mark("list")], by_kind("a number or a list of numbers")
]
_Bound = Annotated[float, Field(allow_inf_nan=True)]
Bounds = Annotated[tuple[_Bound, _Bound], Field(strict=False)]
TransformName = Literal["none", "sigmoid", "log", "softplus"]


class MotionInitial(ByWord):
    """Initial values of a motion."""

    translation: _NumberOrList | None = Field(default=None, description="In scene units.")
    rotation: _NumberOrList | None = Field(default=None, description="In degrees.")
    scale: _NumberOrList | None = Field(default=None, description="A factor.")


class MotionBounds(ByWord):
    """Bounds of a motion."""

    translation: Bounds | None = Field(default=None, description="[low, high] of each number, in scene units.")
    rotation: Bounds | None = Field(default=None, description="[low, high] of each number, in degrees.")
    scale: Bounds | None = Field(default=None, description="[low, high] of the factor.")


class MotionTransform(ByWord):
    """Transforms of a motion."""

    translation: TransformName | None = Field(default=None, description="As `transform`.")
    rotation: TransformName | None = Field(default=None, description="As `transform`.")
    scale: TransformName | None = Field(default=None, description="As `transform`.")


class MotionRates(ByWord):
    """Learning rates of a motion."""

    translation: Positive | None = Field(default=None, description="In scene units.")
    rotation: Positive | None = Field(default=None, description="In degrees.")
    scale: Positive | None = Field(default=None, description="Of the factor.")


# --- what moves -------------------------------------------------------------------------------------------------------


def _list_of_one(value: Any) -> Any:
    return [value] if isinstance(value, str) else value


def _names(value: list[str]) -> list[str]:
    if len(set(value)) < len(value):
        raise wrong("must name each once")
    return value


Name = Annotated[str, Field(min_length=1, max_length=KEY_LENGTH)]
_NAME = {"type": "string", "minLength": 1, "maxLength": KEY_LENGTH}
_NAMES = WithJsonSchema({"anyOf": [_NAME, {"type": "array", "items": _NAME, "minItems": 1}]})
#: One name or several.
Names = Annotated[list[Name], Field(min_length=1), BeforeValidator(_list_of_one), _NAMES]


class HeightmapSpec(Section):
    """Displacement of a mesh along its initial normals, in scene units: a texture over its texture coordinates."""

    mesh: Names = Field(
        description="Id of a mesh with texture coordinates, or a list: one map for all, named by the first."
    )
    resolution: Annotated[tuple[Count, Count], Field(strict=False)] = Field(
        description="[width, height] in texels, at least 2 each, looked up bilinearly; beyond the centres of the "
        "outermost texels it goes on as they are."
    )

    @field_validator("mesh")
    @classmethod
    def _check_mesh(cls, value: list[str]) -> list[str]:
        return _names(value)

    @field_validator("resolution")
    @classmethod
    def _check_resolution(cls, value: tuple[int, int]) -> tuple[int, int]:
        if min(value) < 2 or value[0] * value[1] > PIXELS:
            raise wrong(f"must be at least [2, 2], and have at most {PIXELS} texels, not {list(value)}")
        return value


class MotionSpec(Section):
    """Motion of shapes and emitters together: scaled, then rotated, then translated."""

    of: Names = Field(description="Ids of the shapes and emitters that move together; they are named by the first.")
    pivot: list[float] | None = Field(
        default=None,
        description="The point about which they are scaled and rotated; null: the centre of their bounding box.",
    )
    free: Annotated[list[Word], Field(min_length=1)] = Field(
        default=["translation", "rotation"],
        description="What is recovered. `translation`: three numbers, in scene units; `rotation`: three angles in "
        "degrees, about the x, then the y, then the z axis of the scene; `scale`: one factor for all axes.",
    )

    @field_validator("pivot")
    @classmethod
    def _check_pivot(cls, value: list[float] | None) -> list[float] | None:
        if value is not None and len(value) != 3:
            raise wrong(f"must be a point, [x, y, z], not a list of length {len(value)}")
        return value

    @field_validator("of", "free")
    @classmethod
    def _check_names(cls, value: list[str]) -> list[str]:
        return _names(value)
