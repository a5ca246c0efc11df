"""The parameters that are recovered: those of the scene by key, heightmaps on meshes, motions of shapes and emitters.

Settings of a motion are said by word (translation, rotation, scale), or for all of it at once.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BeforeValidator, Discriminator, Field, WithJsonSchema, model_validator
from typing_extensions import Self

from reslrb_cli.config.base import (
    MARK,
    NEEDS_TYPE,
    ByType,
    Choice,
    ConfigPath,
    Count,
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
from reslrb_cli.config.files import PIXELS

Numbers = Annotated[list[float], Field(min_length=1)]

#: The parts of a motion, applied in the opposite order. An axis is that part of a translation alone.
Word = Literal["translation", "x", "y", "z", "rotation", "scale"]
WORDS: tuple[Word, ...] = ("translation", "x", "y", "z", "rotation", "scale")
AXES: tuple[Word, ...] = ("x", "y", "z")

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
    x: float | None = Field(default=None, description="In scene units.")
    y: float | None = Field(default=None, description="In scene units.")
    z: float | None = Field(default=None, description="In scene units.")
    rotation: _NumberOrList | None = Field(default=None, description="In degrees.")
    scale: _NumberOrList | None = Field(default=None, description="A factor.")


class MotionBounds(ByWord):
    """Bounds of a motion."""

    translation: Bounds | None = Field(default=None, description="[low, high] of each number, in scene units.")
    x: Bounds | None = Field(default=None, description="[low, high], in scene units.")
    y: Bounds | None = Field(default=None, description="[low, high], in scene units.")
    z: Bounds | None = Field(default=None, description="[low, high], in scene units.")
    rotation: Bounds | None = Field(default=None, description="[low, high] of each number, in degrees.")
    scale: Bounds | None = Field(default=None, description="[low, high] of the factor.")


class MotionTransform(ByWord):
    """Transforms of a motion."""

    translation: TransformName | None = Field(default=None, description="As `transform`.")
    x: TransformName | None = Field(default=None, description="As `transform`.")
    y: TransformName | None = Field(default=None, description="As `transform`.")
    z: TransformName | None = Field(default=None, description="As `transform`.")
    rotation: TransformName | None = Field(default=None, description="As `transform`.")
    scale: TransformName | None = Field(default=None, description="As `transform`.")


class MotionRates(ByWord):
    """Learning rates of a motion."""

    translation: Positive | None = Field(default=None, description="In scene units.")
    x: Positive | None = Field(default=None, description="In scene units.")
    y: Positive | None = Field(default=None, description="In scene units.")
    z: Positive | None = Field(default=None, description="In scene units.")
    rotation: Positive | None = Field(default=None, description="In degrees.")
    scale: Positive | None = Field(default=None, description="Of the factor.")


# --- what moves -------------------------------------------------------------------------------------------------------

Name = Annotated[str, Field(min_length=1)]
_NAME = {"type": "string", "minLength": 1}
_NAMES = WithJsonSchema({"anyOf": [_NAME, {"type": "array", "items": _NAME, "minItems": 1}]})
_EACH_ONCE = must(each_once, lambda _: "must name each once")

#: One name or several.
Names = Annotated[list[Name], Field(min_length=1), BeforeValidator(list_of_one), _EACH_ONCE, _NAMES]

_TEXELS = must(
    lambda size: min(size) >= 2 and size[0] * size[1] <= PIXELS,
    lambda size: f"must be at least [2, 2], and have at most {PIXELS} texels, not {list(size)}",
)


_GRID = must(
    lambda grid: min(size_of(grid)) >= 2 and size_of(grid)[0] * size_of(grid)[1] <= PIXELS,
    lambda grid: f"must be at least 2, and have at most {PIXELS} vertices, not {grid}",
)


def size_of(grid: int | tuple[int, int]) -> tuple[int, int]:
    """[width, height] of what may be one number for both."""
    return (grid, grid) if isinstance(grid, int) else grid


_Grid = Annotated[
    Annotated[Count, mark("number")] | Annotated[Size, mark("list")], by_kind("a number or [width, height]"), _GRID
]


class HeightmapSpec(Section):
    """Displacement of a mesh along its initial normals, in scene units: a texture over its texture coordinates."""

    mesh: Names
    """Id of a mesh with texture coordinates, or a list: one map for all, named by the first."""
    resolution: Annotated[Size, _TEXELS]
    """[width, height] in texels, at least 2 each, looked up bilinearly; beyond the centres of the outermost texels it
    goes on as they are."""
    grid: _Grid | None = None
    """Vertices along each edge, a number or [width, height]: makes a mesh of this size of a `rectangle`, or of a mesh
    that is one, of four vertices. They reach from edge to edge, and their texture coordinates are the centres of as
    many texels. null: the mesh stays as it is."""


_POINT = must(
    lambda point: len(point) == 3, lambda point: f"must be a point, [x, y, z], not a list of length {len(point)}"
)


class MotionSpec(Section):
    """Motion of shapes and emitters together: scaled, then rotated, then translated."""

    of: Names = Field(description="Ids of the shapes and emitters that move together; they are named by the first.")
    pivot: Annotated[list[float], _POINT] | None = None
    """The point about which they are scaled and rotated; null: the centre of their bounding box."""
    free: Annotated[list[Word], Field(min_length=1), _EACH_ONCE] = Field(default=["translation", "rotation"])
    """What is recovered. `translation`: three numbers, in scene units; `x`, `y`, `z`: a translation along this axis
    alone, such as `free: [x, y]`; `rotation`: three angles in degrees, about the x, then the y, then the z axis of the
    scene; `scale`: one factor for all axes."""

    @model_validator(mode="after")
    def _check_axes(self) -> Self:
        if "translation" in self.free and any(axis in self.free for axis in AXES):
            raise located("free", "has both `translation` and an axis of it; name the axes, or `translation` alone")
        return self


ColorSpace = Literal["auto", "linear", "srgb"]
COLOR_SPACE = "How values are encoded: `linear`, `srgb`, or `auto` (8-bit files srgb, float files linear)."


class ImageFile(Section):
    """An image file that holds a texture."""

    file: ConfigPath = Field(description="EXR, PNG, JPG or HDR file, relative to the config file.")
    color_space: ColorSpace = Field(default="auto", description=COLOR_SPACE)


class RunValue(Section):
    """Values to which a run brought parameters."""

    TAG: ClassVar[str] = "run"

    run: ConfigPath
    """Folder of a run, finished or interrupted, that recovered a parameter of the same key; relative to the config
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


#: A value to start from; "scene" is the one that the scene file gives.
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

#: One key, or several that are tied.
_Key = Annotated[
    Annotated[Name, mark("text")] | Annotated[list[Name], Field(min_length=1), mark("list")],
    Discriminator(lambda value: MARK + ("list" if isinstance(value, list) else "text")),
]


# --- what its value costs besides -------------------------------------------------------------------------------------


class Regularizer(Choice):
    """An integral over the parameter's surface, in scene units, that is added to the loss once a step."""

    type: str
    weight: Positive = 1.0
    """Factor of the integral in what is minimised."""


class Curvature(Regularizer, json_schema_extra={"required": ["type", "radius"]}):
    """The concave curvature k of a heightmap, seen from outside, beyond a tool's: integral of max(0, k - 1/radius)²."""

    type: Literal["curvature"] = "curvature"
    """Of a heightmap: integral of max(0, k - 1/radius)², k the larger principal curvature, positive in hollows."""
    radius: Positive = Field(description="Radius of the tool's ball, in scene units.")


class Slope(Regularizer, json_schema_extra={"required": ["type", "degrees"]}):
    """The slope of a heightmap beyond an angle: integral of max(0, slope - tan(degrees))²."""

    type: Literal["slope"] = Field(default="slope", description="Of a heightmap: integral of max(0, slope - tan)².")
    degrees: float = Field(ge=0, lt=90, description="Angle up to which slopes cost nothing.")


class Thickness(Regularizer, json_schema_extra={"required": ["type", "thickness", "least"]}):
    """A plate that is too thin: integral of max(0, least - (thickness + h))²."""

    type: Literal["thickness"] = "thickness"
    """Of a heightmap h: integral of max(0, least - (thickness + h))². After each step heights are held where the plate
    has a tenth of `least`, so that its faces never cross; how many were is recorded."""
    thickness: Positive = Field(description="Of the plate where the heightmap is 0, in scene units.")
    least: Positive = Field(description="Below this it costs, in scene units.")
    opposite: Annotated[str, Field(min_length=1)] | None = None
    """Id of the mesh on the other side, where that has a heightmap as well: its heights, outwards where each texel
    stands, are part of the thickness, and it is pushed and held back as this one is. null: the other side is flat."""

    @property
    def thinnest(self) -> float:
        """The thickness at which it is held."""
        return _HELD * self.least

    @property
    def lowest(self) -> float:
        """The height at which it is held, over a flat back."""
        return self.thinnest - self.thickness


#: Share of `least` that a plate always keeps.
_HELD = 0.1


class TotalVariation(Regularizer, json_schema_extra=NEEDS_TYPE):
    """Integral of sqrt(|gradient|² + epsilon²) - epsilon, channels together."""

    type: Literal["total_variation"] = "total_variation"
    """Of a heightmap or a bitmap: integral of sqrt(g² + epsilon²) - epsilon, g the gradient of all channels."""
    epsilon: Positive = Field(default=1e-3, description="Gradients well below this cost as their square.")


class Laplacian(Regularizer, json_schema_extra=NEEDS_TYPE):
    """Integral of the square of the Laplacian."""

    type: Literal["laplacian"] = "laplacian"
    """Of a heightmap, a bitmap or a mesh's vertex positions: integral of the square of the Laplacian; of a mesh over
    its surface as it begins, by cotangents, vertices at its rim left out."""


AnyRegularizer = Annotated[Curvature | Slope | Thickness | TotalVariation | Laplacian, ByType("")]

#: What has a meaning for each kind of parameter.
REGULARIZERS = {
    "heightmap": ("curvature", "slope", "thickness", "total_variation", "laplacian"),
    "bitmap": ("total_variation", "laplacian"),
    "mesh": ("laplacian",),
}


# --- what is recovered ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Settings:
    """What is said of one array that is recovered; `word` is that of a motion, "" otherwise."""

    initial: Any = "scene"
    bounds: tuple[float, float] | None = None
    transform: TransformName = "none"
    learning_rate: float | None = None
    resolution: tuple[int, int] | None = None
    word: str = ""
    smoothing: float | None = None
    regularizers: tuple[Regularizer, ...] = ()


class Precondition(Section):
    """Smooth steps ("large steps", Nicolet, Jacobson and Jakob 2021): the optimizer moves v, the parameter is
    (1 - l² Δ)⁻¹ v."""

    laplacian: Annotated[float, Field(gt=0, le=10)]
    """l, as a share of the longer side of a map, a texture or a mesh: the same on a finer one. What is finer than l
    goes less far in a step; of gradient descent, by the fourth power of its size over l."""


class ParameterSpec(Section):
    """What is recovered, by exactly one of `key`, `heightmap` and `motion`."""

    key: _Key | None = None
    """Key as `reslrb inspect` lists it: the names of `mi.traverse`, in which an object without an id goes by its kind
    and number in the scene file, such as `Sphere_3`. Or a glob such as `*.reflectance.data`. A list of keys ties them
    to one value, which is recorded by the first."""
    heightmap: HeightmapSpec | None = None
    """A displacement of a mesh, recorded as `MESH.heightmap`."""
    motion: MotionSpec | None = None
    """A motion of shapes and emitters, recorded as `ID.translation`, `ID.x`, `ID.rotation` and so on. With several
    `free`, `initial`, `bounds`, `transform` and `learning_rate` are mappings by these words, such as `bounds:
    {rotation: [-10, 10]}`; `transform` and `learning_rate` may also be one for all."""
    initial: Initial = "scene"
    """Value to start from: a number (all entries), a list of numbers (one per channel), an image file, the value to
    which a run brought the same key, or `scene` (the scene's own value; a heightmap is flat there, and nothing is
    moved). `transport` makes a heightmap that throws the view's target onto the plane shape `receiver`, nothing darker
    than `floor` (a share of its maximum, or `auto`, the least with which light is not torn apart); `lamp` names the
    lamp where several have light: docs/lens.md."""
    bounds: _AnyBounds | None = None
    """[low, high], in the parameter's units; values are clamped to them after each step. `-.inf` and `.inf` leave a
    side open."""
    transform: _AnyTransform = "none"
    """What the optimizer moves in place of the value x: `sigmoid`: the logit of x between its `bounds`, which it never
    reaches; `log`: log(x), for positive values known to an order of magnitude at best; `softplus`: log(exp(x) - 1), for
    positive values; as `log` well below 1, as `none` well above. Learning rates are in units of that variable."""
    learning_rate: _AnyRate | None = None
    """Step size of this parameter, in the optimizer's units; null: the optimizer's."""
    resolution: Annotated[Size, few("texels")] | None = None
    """[width, height] in texels to which a texture is resampled before the start."""
    precondition: Precondition | None = None
    """Smooth steps, for textures, heightmaps and the vertices of meshes; null: none."""
    regularizers: list[AnyRegularizer] = Field(default=[], max_length=16)
    """What the value itself costs: integrals over its surface, added to the loss once a step, and recorded beside it.
    Lengths are the scene's; of a bitmap they are those of its texture coordinates. The value hardly depends on the
    resolution."""

    @property
    def names(self) -> list[str]:
        """Keys and globs, or the names by which a heightmap or a motion is recorded."""
        if self.heightmap is not None:
            return [f"{self.heightmap.mesh[0]}.{HEIGHTMAP}"]
        if self.motion is not None:
            return [f"{self.motion.of[0]}.{word}" for word in self.motion.free]
        return self.keys

    @property
    def keys(self) -> list[str]:
        """The keys and globs in `key`."""
        return [self.key] if isinstance(self.key, str) else list(self.key or ())

    def objects(self) -> list[tuple[str, int | None, str]]:
        """What it names, each with its option and, in a list, its place there."""
        lists: list[tuple[str, Any]] = [("key", self.key)]
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
        """The plates whose other side is flat: their thickness bounds the heights."""
        return [each for each in self.regularizers if isinstance(each, Thickness) and each.opposite is None]

    def at(self, option: str, word: str) -> str:
        """Where in this section `option` is set for what `word` names."""
        return f"{option}.{word}" if isinstance(getattr(self, option, None), ByWord) else option

    def settings(self, word: str = "") -> Settings:
        """What is said of the array of a motion that `word` names; "": of what is no motion."""

        def of(option: str, default: Any = None) -> Any:
            value = getattr(self, option)
            return value.words().get(word, default) if isinstance(value, ByWord) else value

        resolution = self.resolution if self.heightmap is None else self.heightmap.resolution
        bounds, lowest = of("bounds"), [each.lowest for each in self._plates]
        if lowest:
            low, high = bounds or (-math.inf, math.inf)
            bounds = max(low, *lowest), high
        smoothing = None if self.precondition is None else self.precondition.laplacian
        rest = of("transform", "none"), of("learning_rate"), resolution, word, smoothing, tuple(self.regularizers)
        return Settings(of("initial", "scene"), bounds, *rest)

    @model_validator(mode="after")
    def _check_kind(self) -> Self:
        has = [option for option in ("key", "heightmap", "motion") if getattr(self, option) is not None]
        if not has:
            raise located("", "must have one of `key`, `heightmap` and `motion`")
        if len(has) > 1:
            raise located(has[1], f"cannot stand beside `{has[0]}`; make two parameters of them")
        if len(self.keys) > 1:
            if len(set(self.keys)) < len(self.keys):
                raise located("key", "must name each once")
            if self.resolution is not None:
                raise located("resolution", "goes with one key alone, not with a list that ties several together")
        if self.heightmap is not None and self.resolution is not None:
            raise located("resolution", "belongs into `heightmap`, which has its own; remove it here")
        if self.motion is not None and self.resolution is not None:
            raise located("resolution", "has no effect on a motion, which is no texture; remove it")
        if self.motion is not None and self.precondition is not None:
            raise located("precondition", "has no effect on a motion; remove it")
        return self

    @model_validator(mode="after")
    def _check_words(self) -> Self:
        free: list[Word] = self.motion.free if self.motion is not None else []
        for option in ("initial", "bounds", "transform", "learning_rate"):
            value = getattr(self, option)
            if isinstance(value, ByWord):
                if self.motion is None:
                    raise located(option, "is a mapping by the words of a motion, and this is none")
                for word in value.words():
                    if word not in free:
                        raise located(f"{option}.{word}", f"has no effect: `motion.free` has {', '.join(free)} alone")
            elif isinstance(value, ImageFile) and self.motion is not None:
                raise located(option, "is an image file, and a motion is no texture; give numbers")
            elif value in (None, "scene") or isinstance(value, RunValue):
                continue
            elif len(free) > 1 and option in ("initial", "bounds"):
                words = ", ".join(f"{word}: ..." for word in free)
                raise located(option, f"must be a mapping by what is free, {{{words}}}")
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
            if said.transform in ("log", "softplus") and high <= 0:
                reason = f"leave no positive value, and transform: {said.transform} yields nothing else"
                raise located(at("bounds"), reason)
            numbers = [said.initial] if isinstance(said.initial, float) else said.initial
            for number in numbers if isinstance(numbers, list) else ():
                if any(number < each.lowest for each in self._plates):
                    reason = f"{number:g} leaves less than a tenth of the least thickness in `regularizers`; raise it"
                    raise located(at("initial"), reason)
                if not low <= number <= high:
                    raise located(at("initial"), f"{number:g} is outside of the bounds [{low:g}, {high:g}]")
        return self
