"""The parameters to recover: scene parameters by key, tints of textures, heightmaps on meshes, and motions of shapes
and emitters.

Settings of a motion are given for each part (translation, rotation, scale), or for all parts at once.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Annotated, Any, ClassVar, Generic, Literal, TypeVar, get_args

from pydantic import BeforeValidator, Discriminator, Field, WithJsonSchema, model_validator
from typing_extensions import Self

from reslrb_cli.config.base import (
    MARK,
    NEEDS_TYPE,
    ByType,
    Choice,
    ConfigPath,
    Positive,
    Section,
    Size,
    by_kind,
    each_once,
    few,
    kind_tag,
    list_of_one,
    located,
    mark,
    must,
)

Numbers = Annotated[list[float], Field(min_length=1)]

#: The parts of a motion, applied in reverse order. A translation and a rotation have a part for each axis.
Word = Literal["translation", "x", "y", "z", "rotation", "rotation_x", "rotation_y", "rotation_z", "scale"]
WORDS: tuple[Word, ...] = get_args(Word)
AXES: tuple[Word, ...] = ("x", "y", "z")
ANGLES: tuple[Word, ...] = ("rotation_x", "rotation_y", "rotation_z")

#: Name of a heightmap's parameter, appended to the name of its mesh.
HEIGHTMAP = "heightmap"
#: Name of a tint, in place of `data` in the key of its texture.
TINT = "tint"


def tint_of(key: str) -> str:
    """Return the name of the tint of the texture `key`."""
    return f"{key.removesuffix('.data')}.{TINT}"


def tinted_by(name: str) -> str | None:
    """Return the key of the texture whose tint is called `name`, or None if `name` is no tint."""
    return f"{name.removesuffix(f'.{TINT}')}.data" if name.endswith(f".{TINT}") else None


def entry_of(key: str) -> tuple[str, str]:
    """Return the option of an entry of `parameters`, and its value, that recovers `key`: a parameter or a tint."""
    texture = tinted_by(key)
    return ("key", key) if texture is None else (TINT, texture)


# --- settings of a motion, by part ------------------------------------------------------------------------------------


Part = TypeVar("Part")


def is_named(key: str, wanted: Sequence[str]) -> bool:
    """True if `wanted` contains `key`, or a glob that matches `key`."""
    return any(key == each or fnmatchcase(key, each) for each in wanted)


class ByWord(Section, Generic[Part]):
    """Settings of a motion for each of its parts."""

    TAG: ClassVar[str] = "words"

    translation: Part | None = Field(default=None, description="Of the translation, in scene units.")
    x: Part | None = Field(default=None, description="Of the translation along x, in scene units.")
    y: Part | None = Field(default=None, description="Of the translation along y, in scene units.")
    z: Part | None = Field(default=None, description="Of the translation along z, in scene units.")
    rotation: Part | None = Field(default=None, description="Of each angle, in degrees.")
    rotation_x: Part | None = Field(default=None, description="Of the angle about x, in degrees.")
    rotation_y: Part | None = Field(default=None, description="Of the angle about y, in degrees.")
    rotation_z: Part | None = Field(default=None, description="Of the angle about z, in degrees.")
    scale: Part | None = Field(default=None, description="Of the scale factor.")

    def words(self) -> dict[str, Part]:
        """Return the given settings as a mapping from part to setting."""
        return {word: value for word in WORDS if (value := getattr(self, word)) is not None}


def or_words(plain: str) -> Discriminator:
    """Return a discriminator. The discriminator tags a mapping by parts of a motion as `words`, and any other value as
    `plain`.
    """
    return Discriminator(lambda value: MARK + (ByWord.TAG if isinstance(value, (dict, ByWord)) else plain))


_NumberOrList = Annotated[
    Annotated[float, mark("number")] | Annotated[Numbers, mark("list")], by_kind("a number or a list of numbers")
]

_Bound = Annotated[float, Field(allow_inf_nan=True)]
Bounds = Annotated[tuple[_Bound, _Bound], Field(strict=False)]
TransformName = Literal["none", "sigmoid", "log"]


class MotionInitial(ByWord[_NumberOrList]):
    """Initial values of a motion."""


class MotionBounds(ByWord[Bounds]):
    """Bounds [low, high] of a motion."""


class MotionTransform(ByWord[TransformName]):
    """Transforms of a motion."""


class MotionRates(ByWord[Positive]):
    """Learning rates of a motion."""


# --- moving objects ---------------------------------------------------------------------------------------------------

Name = Annotated[str, Field(min_length=1)]
_NAME = {"type": "string", "minLength": 1}
_NAMES = WithJsonSchema({"anyOf": [_NAME, {"type": "array", "items": _NAME, "minItems": 1}]})
_EACH_ONCE = must(each_once, lambda _: "must name each once")

#: One name, or a list of names.
Names = Annotated[list[Name], Field(min_length=1), BeforeValidator(list_of_one), _EACH_ONCE, _NAMES]


class HeightmapSpec(Section):
    """Displacement of a mesh along its initial normals, in scene units. The map is a texture over the mesh's texture
    coordinates."""

    mesh: Names
    """Id of a mesh with texture coordinates, or a list of ids. Meshes in a list share one map, which is named after the
    first mesh."""
    resolution: Annotated[Size, few("texels", least=2)]
    """[width, height] of the map in texels, at least 2 each. Lookups are bilinear, and constant beyond the centres of
    the outermost texels."""


_POINT = must(
    lambda point: len(point) == 3, lambda point: f"must be a point, [x, y, z], not a list of length {len(point)}"
)


class MotionSpec(Section):
    """Common motion of shapes and emitters. Shapes and emitters are scaled, then rotated, then translated."""

    of: Names = Field(description="Ids of the shapes and emitters that move together. The first id names the motion.")
    pivot: Annotated[list[float], _POINT] | None = None
    """Centre of the scale and the rotation, [x, y, z]. null: the centre of the bounding box of these objects."""
    free: Annotated[list[Word], Field(min_length=1), _EACH_ONCE] = Field(default=["translation", "rotation"])
    """Parts of the motion to recover. `translation`: three numbers, in scene units. `x`, `y`, `z`: a translation along
    one axis, as in `free: [x, y]`. `rotation`: three angles in degrees, about the x axis, then the y axis, then the z
    axis of the scene. `rotation_x`, `rotation_y`, `rotation_z`: one of these angles, as in `free: [x, y,
    rotation_z]` for an object that stands on a table. `scale`: one factor for all axes."""

    @model_validator(mode="after")
    def _check_axes(self) -> Self:
        if "translation" in self.free and any(axis in self.free for axis in AXES):
            raise located("free", "has both `translation` and an axis of it; name the axes, or `translation` alone")
        if "rotation" in self.free and any(angle in self.free for angle in ANGLES):
            raise located("free", "has both `rotation` and an angle of it; name the angles, or `rotation` alone")
        return self


ColorSpace = Literal["auto", "linear", "srgb"]
COLOR_SPACE = "Encoding of the values: `linear`, `srgb`, or `auto` (srgb for 8-bit files, linear for float files)."


_RAW = "`auto` is linear for heights, and for textures with `raw` in the scene that are no colours."


class ImageFile(Section):
    """An image file that holds a texture."""

    file: ConfigPath = Field(description="EXR, PNG, JPG or HDR file, relative to the config file.")
    color_space: ColorSpace = Field(default="auto", description=f"{COLOR_SPACE} {_RAW}")


class RunValue(Section):
    """A value that another run recovered."""

    TAG: ClassVar[str] = "run"

    run: ConfigPath
    """Folder of a finished or interrupted run that recovered a parameter with the same key, relative to the config
    file."""


#: A value for a scene parameter: one number, a list such as [r, g, b], or an image file.
Value = Annotated[
    Annotated[float, mark("number")] | Annotated[Numbers, mark("list")] | Annotated[ImageFile, mark("mapping")],
    by_kind("a number, a list of numbers, or {file: IMAGE}"),
]


def _initial_tag(value: Any) -> str | None:
    if isinstance(value, RunValue) or (isinstance(value, dict) and "run" in value):
        return MARK + RunValue.TAG
    if isinstance(value, ByWord) or (isinstance(value, dict) and not {"file", "color_space"} & value.keys()):
        return MARK + ByWord.TAG
    return kind_tag(value, "scene")


#: An initial value. "scene" is the value in the scene file.
Initial = Annotated[
    Annotated[float, mark("number")]
    | Annotated[Numbers, mark("list")]
    | Annotated[ImageFile, mark("mapping")]
    | Annotated[RunValue, mark(RunValue.TAG)]
    | Annotated[MotionInitial, mark(ByWord.TAG)]
    | Annotated[Literal["scene"], mark("text")],
    Discriminator(
        _initial_tag,
        custom_error_type="wrong",
        custom_error_message="must be a number, a list of numbers, {file: IMAGE}, {run: RUN}, or `scene`",
    ),
]

_AnyBounds = Annotated[Annotated[Bounds, mark("list")] | Annotated[MotionBounds, mark(ByWord.TAG)], or_words("list")]
_AnyRate = Annotated[Annotated[Positive, mark("number")] | Annotated[MotionRates, mark(ByWord.TAG)], or_words("number")]

_AnyTransform = Annotated[
    Annotated[TransformName, mark("text")] | Annotated[MotionTransform, mark(ByWord.TAG)], or_words("text")
]

#: One key, or several keys that are tied.
_Key = Annotated[
    Annotated[Name, mark("text")] | Annotated[list[Name], Field(min_length=1), mark("list")],
    Discriminator(lambda value: MARK + ("list" if isinstance(value, list) else "text")),
]


# --- regularizers -----------------------------------------------------------------------------------------------------


class Regularizer(Choice):
    """An integral over the parameter's surface, in scene units, that is added to the loss once per step."""

    type: str
    weight: Positive = 1.0
    """Factor of the integral in the objective."""


class Thickness(Regularizer, json_schema_extra={"required": ["type", "thickness", "least"]}):
    """A plate that is too thin: integral of max(0, least - (thickness + h))², with the heightmap h. After each step,
    heights are clamped so that the plate keeps a tenth of `least`, and its faces never cross. The run records the
    number of clamped heights.
    """

    type: Literal["thickness"] = "thickness"
    """For a heightmap h: integral of max(0, least - (thickness + h))². After each step, heights are clamped so that the
    plate keeps a tenth of `least`."""
    thickness: Positive = Field(description="Thickness of the plate where the heightmap is 0, in scene units.")
    least: Positive = Field(description="Smallest thickness without a cost, in scene units.")

    @property
    def lowest(self) -> float:
        """The smallest height of the plate after clamping."""
        return _HELD * self.least - self.thickness


#: Fraction of `least` that a plate keeps at all times.
_HELD = 0.1


class TotalVariation(Regularizer, json_schema_extra=NEEDS_TYPE):
    """Total variation of a heightmap or a bitmap: integral of sqrt(|gradient|² + epsilon²) - epsilon. The gradient is
    computed over all channels together.
    """

    type: Literal["total_variation"] = "total_variation"
    """For a heightmap or a bitmap: integral of sqrt(g² + epsilon²) - epsilon, with the gradient g of all channels."""
    epsilon: Positive = Field(default=1e-3, description="Gradients well below this value have a quadratic cost.")


AnyRegularizer = Annotated[Thickness | TotalVariation, ByType("")]

#: The regularizers of each kind of parameter.
REGULARIZERS = {
    "heightmap": ("thickness", "total_variation"),
    "bitmap": ("total_variation",),
    "mesh": (),
}


# --- parameters -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Settings:
    """The settings of one recovered array. `word` is the part of a motion, or ""."""

    initial: Any = "scene"
    bounds: tuple[float, float] | None = None
    transform: TransformName = "none"
    learning_rate: float | None = None
    resolution: tuple[int, int] | None = None
    word: str = ""
    smoothing: float | None = None
    regularizers: tuple[Regularizer, ...] = ()


class ParameterSpec(Section):
    """A parameter to recover. Exactly one of `key`, `tint`, `heightmap` and `motion` must be given."""

    key: _Key | None = None
    """Key as `reslrb inspect` lists it. Keys are the names of `mi.traverse`. A shape without an id is named after its
    file, as in `Lamp` for `Lamp.ply`, and another object after its kind and its number, as in `Sphere_3`. A glob such
    as `*.reflectance.data` selects several parameters. A list of keys ties them to one value, which is recorded under
    the first key."""
    tint: Name | None = None
    """Key of a bitmap texture whose texels are multiplied by one number for each channel, 1 at the start. The pattern
    of the texture stays. The numbers are recorded as the key with `tint` in place of `data`."""
    heightmap: HeightmapSpec | None = None
    """Displacement of a mesh, recorded as `MESH.heightmap`."""
    motion: MotionSpec | None = None
    """Motion of shapes and emitters, recorded as `ID.translation`, `ID.x`, `ID.rotation` and so on. If several parts
    are `free`, then `initial`, `bounds`, `transform` and `learning_rate` are mappings by part, as in `bounds:
    {rotation: [-10, 10]}`. `transform` and `learning_rate` may also be one value for all parts."""
    initial: Initial = "scene"
    """Value at the start. A number (for all entries), a list of numbers (one per channel), an image file, `{run: RUN}`
    (the value that this run recovered for the same key), or `scene` (the value in the scene file; a heightmap is then
    flat, and a motion at rest)."""
    bounds: _AnyBounds | None = None
    """[low, high], in the units of the parameter. Values are clamped to the bounds after each step. `-.inf` and `.inf`
    leave a side open."""
    transform: _AnyTransform = "none"
    """Variable that the optimizer moves instead of the value x. `sigmoid`: the logit of x between its `bounds`, which x
    never reaches. `log`: log(x), for positive values that are known to an order of magnitude at best. Learning rates
    are in units of this variable. `optimizer: auto` takes `log` for a lamp's emission that has no upper bound."""
    learning_rate: _AnyRate | None = None
    """Step size of this parameter, in the units of `optimizer.learning_rate`. null: `optimizer.learning_rate`."""
    resolution: Annotated[Size, few("texels")] | None = None
    """[width, height] in texels. The texture is resampled to this size before the start. null: it keeps its size."""
    precondition: Annotated[float, Field(gt=0, le=10)] | None = None
    """Smooth steps ("large steps", Nicolet, Jacobson and Jakob 2021), for textures and heightmaps: a length l, as a
    fraction of the longer side. The optimizer moves v, and the parameter is (1 - l² Δ)⁻¹ v. Details smaller than l move
    less in a step: with gradient descent, by the fourth power of their size divided by l. The effect does not depend on
    the resolution. null: off."""
    regularizers: list[AnyRegularizer] = Field(default=[], max_length=16)
    """Costs of the value itself. They are integrals over its surface, added to the loss once per step and recorded
    separately. Lengths are in scene units, and for a bitmap in units of its texture coordinates. The integrals hardly
    depend on the resolution."""

    @property
    def names(self) -> list[str]:
        """The keys and globs of the parameters. For a tint, a heightmap or a motion, the property gives the names under
        which the run records its values.
        """
        if self.tint is not None:
            return [tint_of(self.tint)]
        if self.heightmap is not None:
            return [f"{self.heightmap.mesh[0]}.{HEIGHTMAP}"]
        if self.motion is not None:
            return [f"{self.motion.of[0]}.{word}" for word in self.motion.free]
        return self.keys

    @property
    def keys(self) -> list[str]:
        """The keys and globs of scene parameters: those in `key`, or the texture of a tint."""
        if self.tint is not None:
            return [self.tint]
        return [self.key] if isinstance(self.key, str) else list(self.key or ())

    def objects(self) -> list[tuple[str, int | None, str]]:
        """Return the named keys and ids. Each key or id comes with the name of its option. If the option is a list,
        each entry comes with its index, too.
        """
        lists: list[tuple[str, Any]] = [("key", self.key)]
        lists += [] if self.tint is None else [("tint", self.tint)]
        lists += [] if self.heightmap is None else [("heightmap.mesh", self.heightmap.mesh)]
        lists += [] if self.motion is None else [("motion.of", self.motion.of)]
        found: list[tuple[str, int | None, str]] = []
        for option, names in lists:
            if isinstance(names, str):
                found.append((option, None, names))
            else:
                found += [(option, i, name) for i, name in enumerate(names or ())]
        return found

    @property
    def _plates(self) -> list[Thickness]:
        """The thickness regularizers. A plate's thickness bounds the heights."""
        return [each for each in self.regularizers if isinstance(each, Thickness)]

    def at(self, option: str, word: str) -> str:
        """Return the key that sets `option` for the part `word`, relative to this section."""
        return f"{option}.{word}" if isinstance(getattr(self, option, None), ByWord) else option

    def settings(self, word: str = "") -> Settings:
        """Return the settings for the part `word` of a motion. For any other parameter, `word` is ""."""

        def of(option: str, default: Any = None) -> Any:
            value = getattr(self, option)
            return value.words().get(word, default) if isinstance(value, ByWord) else value

        resolution = self.resolution if self.heightmap is None else self.heightmap.resolution
        bounds, lowest = of("bounds"), [each.lowest for each in self._plates]
        if lowest:
            low, high = bounds or (-math.inf, math.inf)
            bounds = max(low, *lowest), high
        rest = (
            of("transform", "none"),
            of("learning_rate"),
            resolution,
            word,
            self.precondition,
            tuple(self.regularizers),
        )
        return Settings(of("initial", "scene"), bounds, *rest)

    @model_validator(mode="after")
    def _check_kind(self) -> Self:
        kinds = ("key", "tint", "heightmap", "motion")
        has = [option for option in kinds if getattr(self, option) is not None]
        if not has:
            raise located("", "must have one of `key`, `tint`, `heightmap` and `motion`")
        if len(has) > 1:
            raise located(has[1], f"cannot be combined with `{has[0]}`; make two parameters")
        if len(self.keys) > 1:
            if len(set(self.keys)) < len(self.keys):
                raise located("key", "must list each key once")
            if self.resolution is not None:
                raise located("resolution", "needs a single key, not a list of tied keys")
        if self.heightmap is not None and self.resolution is not None:
            raise located("resolution", "has no effect here; set `heightmap.resolution` instead")
        kind = "motion" if self.motion is not None else TINT if self.tint is not None else ""
        for option in ("resolution", "precondition") if kind else ():
            if getattr(self, option) is not None:
                raise located(option, f"has no effect on a {kind}; remove it")
        return self

    @model_validator(mode="after")
    def _check_words(self) -> Self:
        free: list[Word] = self.motion.free if self.motion is not None else []
        for option in ("initial", "bounds", "transform", "learning_rate"):
            value = getattr(self, option)
            if isinstance(value, ByWord):
                if self.motion is None:
                    raise located(option, "is a mapping for a motion, but this is not a motion")
                for word in value.words():
                    if word not in free:
                        raise located(f"{option}.{word}", f"has no effect: `motion.free` has only {', '.join(free)}")
            elif isinstance(value, ImageFile) and self.motion is not None:
                raise located(option, "is an image file, but a motion needs numbers")
            elif value in (None, "scene") or isinstance(value, RunValue):
                continue
            elif len(free) > 1 and option in ("initial", "bounds"):
                words = ", ".join(f"{word}: ..." for word in free)
                raise located(option, f"must be a mapping for `motion.free`, {{{words}}}")
        return self

    @model_validator(mode="after")
    def _check_values(self) -> Self:
        for word in self.motion.free if self.motion is not None else ("",):
            said, at = self.settings(word), functools.partial(self.at, word=word)
            low, high = said.bounds or (-math.inf, math.inf)
            if not low < high:
                raise located(at("bounds"), f"must be [low, high] with low < high, not [{low:g}, {high:g}]")
            if said.transform == "sigmoid" and not (math.isfinite(low) and math.isfinite(high)):
                has = "has none" if said.bounds is None else f"has [{low:g}, {high:g}]"
                raise located(at("transform"), f"sigmoid maps to finite `bounds`, [low, high]; this parameter {has}")
            if said.transform == "log" and high <= 0:
                reason = f"exclude positive values, but transform: {said.transform} yields only these"
                raise located(at("bounds"), reason)
            numbers = [said.initial] if isinstance(said.initial, float) else said.initial
            for number in numbers if isinstance(numbers, list) else ():
                if any(number < each.lowest for each in self._plates):
                    reason = f"{number:g} leaves less than a tenth of the least thickness in `regularizers`; raise it"
                    raise located(at("initial"), reason)
                if not low <= number <= high:
                    raise located(at("initial"), f"{number:g} is outside of the bounds [{low:g}, {high:g}]")
        return self
