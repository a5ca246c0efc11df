"""The targets that images are compared with, their masks and exposures, and the views."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    GetJsonSchemaHandler,
    WithJsonSchema,
    model_validator,
)
from pydantic_core import CoreSchema
from typing_extensions import Self

from reslrb_cli.config.base import ConfigPath, Count, Positive, Section, each_once, located, must, wrong
from reslrb_cli.config.integrators import AnyIntegrator
from reslrb_cli.config.parameters import Value
from reslrb_cli.config.response import AnyResponse, response_of_color_space

MaskKind = Literal["specular", "border", "clipped", "alpha"]


class Mask(Section):
    """The pixels of a target that the loss leaves out, and the weights of all other pixels.

    All kinds apply to targets that are read from files. `specular` and `border` leave out pixels that light tracing
    cannot render. They matter only if exactly one of the run's integrator and the target's integrator traces from the
    lights, and then also apply to rendered targets. Pixels of a file that are not finite are always left out.
    """

    file: ConfigPath | None = None
    """Image of weights, with the size of the target, relative to the config file. 0 leaves a pixel out. Values are used
    as stored; those of 8 and 16 bits are divided by the largest possible value. Several channels are averaged, and
    alpha is ignored."""
    kinds: Annotated[list[MaskKind], must(each_once, lambda _: "must name each kind once")] = Field(
        default=["specular", "border", "clipped", "alpha"]
    )
    """Kinds of pixels to leave out. `specular`: pixels that see smooth glass or mirrors directly, which light tracing
    cannot render; if shapes move, each iteration finds these pixels anew. `border`: pixels within the radius of the
    reconstruction filter from the film's border, where light tracing is darker. `clipped`: pixels of 8- and 16-bit
    files with the largest possible value in any channel, and the pixels that the film's reconstruction filter mixes
    with them; lamps near white as well, because cameras compress them to values below white. `alpha`: pixels with an
    alpha of 0."""


def _mask(value: Any) -> Any:
    if value == "auto":
        return {}
    if value == "none":
        return {"kinds": []}
    if isinstance(value, (str, Path)):
        return {"kinds": [], "file": value}
    if not isinstance(value, (dict, Mask)):
        raise wrong("must be `auto`, `none`, the path of an image of weights, or a section such as {kinds: [border]}")
    return value


class _OrText:
    """JSON Schema annotation for a section that may also be text, its short form."""

    def __get_pydantic_json_schema__(self, core: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        return {"anyOf": [handler(core), {"type": "string"}]}


#: `auto`, `none`, an image of weights, or a section.
AnyMask = Annotated[Mask, BeforeValidator(_mask), _OrText()]


def _view_mask(value: Any) -> Any:
    if isinstance(value, dict) and value.keys() <= {"kinds", "file"} and value.get("kinds") == []:
        return value  # as in the config.yaml of a run
    if not isinstance(value, (str, Path, Mask)) or value == "auto":
        raise wrong("must be `none` or the path of an image of weights (`target.mask` sets the kinds)")
    return _mask(value)


#: `none`, or an image of weights.
ViewMask = Annotated[Mask, BeforeValidator(_view_mask), WithJsonSchema({"type": "string"})]


def _is_factor(value: Any) -> bool:
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return is_number and math.isfinite(value) and value > 0


def _exposure(value: Any) -> Any:
    if _is_factor(value) or value in ("auto", "per_channel"):
        return value
    if isinstance(value, dict) and len(value) == 1:
        [(word, start)] = value.items()
        factors = start if isinstance(start, list) and word == "per_channel" else [start]
        if len(factors) == {"auto": 1, "per_channel": 3}.get(word) and all(map(_is_factor, factors)):
            return value
    raise wrong("must be a positive number, `auto`, `per_channel`, {auto: NUMBER} or {per_channel: [R, G, B]}")


_FACTOR = {"type": "number", "exclusiveMinimum": 0}
_FACTORS = {"type": "array", "items": _FACTOR, "minItems": 3, "maxItems": 3}
_EXPOSURE = [
    _FACTOR,
    {"enum": ["auto", "per_channel"]},
    *(
        {"type": "object", "patternProperties": {f"^{word}$": start}, "additionalProperties": False, "minProperties": 1}
        for word, start in (("auto", _FACTOR), ("per_channel", _FACTORS))
    ),
]

#: An exposure: a number, `auto` (one recovered factor), or `per_channel` (one recovered factor per channel). A mapping
#: of one of these words gives the start.
Exposure = Annotated[
    float | Literal["auto", "per_channel"] | dict[str, float | list[float]],
    BeforeValidator(_exposure),
    WithJsonSchema({"anyOf": _EXPOSURE}),
]


def recovered_exposure(exposure: Any) -> tuple[str, list[float]]:
    """Return how an `Exposure` is recovered, as `auto` or `per_channel`, and its start: one number, or three for
    `per_channel`. The word is empty for a number.
    """
    if isinstance(exposure, dict):
        [(word, start)] = exposure.items()
        return word, start if isinstance(start, list) else [start]
    return {"auto": ("auto", [1.0]), "per_channel": ("per_channel", [1.0] * 3)}.get(exposure, ("", [exposure]))


def _illuminant(value: str) -> str:
    from reslrb_cli.colorimetry import find_illuminant  # late, because it needs NumPy

    try:
        return find_illuminant(value)
    except ValueError as error:
        raise wrong(str(error)) from None


#: A standard illuminant of colour-science.
Illuminant = Annotated[str, AfterValidator(_illuminant)]


class WhiteBalance(Section):
    """Chromatic adaptation of photographs to the lamps of the scene. Surfaces with the colour of the illuminant
    `photograph` get the colour of the illuminant `scene`.
    """

    scene: Illuminant = "D65"
    """Illuminant of the scene's lamps, such as `A` or `LED-B3`. D65 is white in linear sRGB."""
    photograph: Illuminant | None = None
    """Illuminant whose colour white surfaces have in the photographs. null: they are white, because the camera has
    balanced the colours."""


def _sensor_name(value: Any) -> Any:
    if isinstance(value, int) and not isinstance(value, bool):
        if value < 0:
            raise wrong(f"must be at least 0, not {value}")
        return value
    if isinstance(value, str) and value:
        return value
    raise wrong("must be a sensor's index, or its id")


#: A sensor, by its index or its id.
SensorName = Annotated[
    int | str,
    BeforeValidator(_sensor_name),
    WithJsonSchema({"anyOf": [{"type": "integer", "minimum": 0}, {"type": "string"}]}),
]


class Rendering(Section):
    """A target that is rendered from the scene itself, with other values of its parameters."""

    parameters: Annotated[
        dict[str, Value],
        must(lambda values: all(values), lambda _: "must have keys that are not empty"),
    ] = Field(default={})
    """True values by key, as in `parameters`. A value is a number, a list of numbers, or an image file. Empty: the
    values in the scene file."""
    spp: Count = Field(default=1024, description="Samples per pixel of the target.")
    integrator: AnyIntegrator | None = None
    """Integrator of the target. null: the integrator of the run."""


class TargetConfig(Section):
    """Target that the image is compared with: exactly one of `file` and `render`. If all views have their own targets,
    neither `file` nor `render` is needed.
    """

    file: ConfigPath | None = None
    """Target image (EXR, PNG, JPG, HDR), relative to the config file. The image is turned by its EXIF orientation,
    unless `scene.cameras` is given. With several views, set the `target` of each view instead."""
    response: AnyResponse | None = None
    """Response of the camera: `srgb`, `linear`, `{gamma: NUMBER}`, or `{curve: NUMBERS}`. `{gamma: auto}` and
    `{curve: auto}` are recovered with the parameters. All views share it, unless `views` gives a view its own. null:
    srgb for files of 8 and 16 bits, linear for files of floats. Only for files. `color_space` is a former name."""
    truth: bool = False
    """Whether the target files show the scene with the values in its scene file, as images of another renderer do. The
    run then reports the error of each parameter. Only with files."""
    render: Rendering | None = Field(default=None, description="Render the target from the scene.")
    white_balance: WhiteBalance | None = None
    """Illuminants of photograph and scene, if they differ. null: colours stay as they are."""
    mask: AnyMask = Mask()
    """Pixels that the loss leaves out, and weights of the others. `auto`: leave out all kinds of pixels below. `none`:
    leave out none. The path of an image of weights: use only these weights. A section lists the kinds, and may add
    weights."""
    exposure: Exposure = 1.0
    """Factor of the image before it is compared: target = exposure * image. A number, `auto` (one factor, recovered
    with the parameters), or `per_channel` (one recovered factor per channel, for the white balance). Recovered factors
    start at 1, or at the numbers of `{auto: NUMBER}` or `{per_channel: [R, G, B]}`. All views share the exposure,
    unless `views` gives a view its own."""

    @model_validator(mode="before")
    @classmethod
    def _check_lists(cls, values: Any) -> Any:
        values = response_of_color_space(values)
        for name in ("file", "exposure") if isinstance(values, dict) else ():
            if isinstance(values.get(name), list):
                raise located(name, "is a list; give each view its own in `views`")
        return values

    @model_validator(mode="after")
    def _check_one(self) -> Self:
        if self.file is not None and self.render is not None:
            raise located("", "must have exactly one of `file` and `render`, and has both")
        if self.render is not None and self.response is not None:
            raise located("response", "has no effect on a rendered target; remove it")
        if self.render is not None and self.white_balance is not None:
            raise located("white_balance", "has no effect on a rendered target; remove it")
        if self.render is not None and self.truth:
            raise located("truth", "has no effect on a rendered target, which has it; remove it")
        return self

    def idle(self) -> set[str]:
        return set() if self.render is None else {"response", "truth", "white_balance"}


class ViewSpec(Section):
    """A view: a sensor of the scene, the lamps that are on, and the target."""

    sensor: SensorName = Field(default=0, description="The sensor in the scene, by index or id.")
    lamps: Annotated[list[str], must(bool, lambda _: "must name a lamp")] | None = None
    """Lamps that are on in this view, by id; globs are allowed. The id of an area light is the id of its shape. null:
    all lamps are on. Views with other lamps may share a sensor. Then the scene gets a copy of the sensor for each view,
    and the index of a view's sensor is the view's number. Needs integrator.type: reslrb."""
    target: ConfigPath | None = None
    """Target image, relative to the config file. null: rendered, as `target.render` describes."""
    mask: ViewMask | None = None
    """Mask that replaces `target.mask`: `none`, or the path of an image of weights. null: `target.mask`."""
    weight: Positive = Field(default=1.0, description="Weight of the view in the loss, relative to the other views.")
    exposure: Exposure | None = None
    """As `target.exposure`, for this view. `auto` and `per_channel` recover an exposure for this view alone. null:
    `target.exposure`."""
    response: AnyResponse | None = None
    """As `target.response`, for this view. `{gamma: auto}` and `{curve: auto}` recover a response for this view alone.
    null: `target.response`."""


Fixable = TypeVar("Fixable", TargetConfig, ViewSpec)


def check_views(views: list[ViewSpec], scene: Any, target: TargetConfig) -> None:
    """Raise an error that names the key if views contradict each other or `target`."""
    places: dict[tuple[int | str, frozenset[str] | None], int] = {}
    for number, view in enumerate(views):
        key = view.sensor, None if view.lamps is None else frozenset(view.lamps)
        if places.setdefault(key, number) < number:
            reason = f"{view.sensor} is already in views[{places[key]}]; views of one sensor need different `lamps`"
            raise located(f"views[{number}].sensor", reason)
        if view.target is None and target.render is None and scene.cameras is None:
            raise located(f"views[{number}].target", "missing; give an image, or render all targets with target.render")
    if target.file is not None:
        raise located("target.file", "has no effect beside `views`; give each view its own target")
    if target.render is not None and all(view.target is not None for view in views):
        raise located("target.render", "has no effect: every view has its own target")


def check_responses(views: list[ViewSpec] | None, target: TargetConfig) -> None:
    """Raise an error that names the key if a response cannot be recovered with the other settings."""
    places = [("target", target)] if views is None else [(f"views[{n}]", view) for n, view in enumerate(views)]
    for place, each in places:
        response = each.response or target.response
        if response is None or not response.recovered:
            continue
        if target.white_balance is not None:
            reason = "cannot be combined with a recovered response; use exposure: per_channel instead"
            raise located("target.white_balance", reason)
        if response.recovered == "curve" and not recovered_exposure(each.exposure or target.exposure)[0]:
            owner = "target" if each.response is None else place
            reason = "is recovered only up to a factor, and so needs a recovered exposure"
            raise located(f"{owner}.response.curve", f"{reason}; set {place}.exposure to auto")


def fixed(section: Fixable) -> Fixable:
    """Return `target`, or an entry of `views`, with an exposure of 1 and the first response in place of recovered
    ones.
    """
    update: dict[str, Any] = (
        {"exposure": 1.0} if section.exposure is not None and recovered_exposure(section.exposure)[0] else {}
    )
    if section.response is not None and section.response.recovered:
        update["response"] = section.response.fixed()
    return section.model_copy(update=update)
