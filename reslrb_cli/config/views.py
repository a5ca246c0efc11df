"""What images are compared with: targets, the masks that leave pixels out of them, their exposures; and views."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    BeforeValidator,
    Field,
    GetJsonSchemaHandler,
    SerializerFunctionWrapHandler,
    WithJsonSchema,
    model_serializer,
    model_validator,
)
from pydantic_core import CoreSchema
from typing_extensions import Self

from reslrb_cli.config.base import ConfigPath, Count, Positive, Section, located, must, wrong
from reslrb_cli.config.integrators import AnyIntegrator
from reslrb_cli.config.parameters import COLOR_SPACE, ColorSpace, Value

_KINDS = ("specular", "border", "clipped", "alpha")


class Mask(Section):
    """Which pixels of a target are left out, and what the others weigh.

    Kinds act on a target that is read from a file. `specular` and `border` are what light tracing lacks: they act where
    one of the run's integrator and the target's traces from the light and the other does not, also on a rendered one.
    Pixels of a file that are not finite are always left out.
    """

    file: ConfigPath | None = None
    """Image of weights, of the target's size, relative to the config file: 0 leaves a pixel out. Values are taken as
    they stand in it, of 8 and 16 bits as shares of the greatest; of several channels the mean."""
    specular: bool = True
    """Leave out pixels that see smooth glass or mirrors directly, which light tracing cannot render. Where shapes move,
    each iteration finds these pixels anew."""
    border: bool = True
    """Leave out pixels within the reconstruction filter's radius of the film's border, where light tracing is
    darker."""
    clipped: bool = True
    """Leave out pixels of 8 and 16 bit files that are at the greatest value in any channel, and those that the film's
    reconstruction filter mixes with them."""
    alpha: bool = Field(default=True, description="Leave out pixels whose alpha is 0.")


def _mask(value: Any) -> Any:
    if value == "auto":
        return {}
    if value == "none":
        return dict.fromkeys(_KINDS, False)
    if isinstance(value, (str, Path)):
        return dict.fromkeys(_KINDS, False) | {"file": value}
    if not isinstance(value, (dict, Mask)):
        raise wrong("must be `auto`, `none`, the path of an image of weights, or a section such as {clipped: false}")
    return value


class _OrText:
    """For JSON Schema: a section, or text that stands for one."""

    def __get_pydantic_json_schema__(self, core: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        return {"anyOf": [handler(core), {"type": "string"}]}


#: `auto`, `none`, an image of weights, or a section that says what is left out.
AnyMask = Annotated[Mask, BeforeValidator(_mask), _OrText()]


def _view_mask(value: Any) -> Any:
    if isinstance(value, dict) and {**value, "file": None} == {**dict.fromkeys(_KINDS, False), "file": None}:
        return value  # as a run's own configuration has it
    if not isinstance(value, (str, Path, Mask)) or value == "auto":
        raise wrong("must be `none` or the path of an image of weights; which kinds are left out is in `target.mask`")
    return _mask(value)


#: `none`, or an image of weights.
ViewMask = Annotated[Mask, BeforeValidator(_view_mask), WithJsonSchema({"type": "string"})]


def _exposure(value: Any) -> Any:
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if (is_number and math.isfinite(value) and value > 0) or value in ("auto", "per_channel"):
        return value
    raise wrong("must be a positive number, `auto` or `per_channel`")


_EXPOSURE = [{"type": "number", "exclusiveMinimum": 0}, {"enum": ["auto", "per_channel"]}]

#: An exposure: a number, `auto` (recovered, one factor), or `per_channel` (recovered, one factor a channel).
Exposure = Annotated[
    float | Literal["auto", "per_channel"],
    BeforeValidator(_exposure),
    WithJsonSchema({"anyOf": _EXPOSURE}),
]


def _sensor_name(value: Any) -> Any:
    if (isinstance(value, int) and not isinstance(value, bool) and value >= 0) or (isinstance(value, str) and value):
        return value
    raise wrong("must be a sensor's index, or its id")


#: A sensor, by its index or its id.
SensorName = Annotated[
    int | str,
    BeforeValidator(_sensor_name),
    WithJsonSchema({"anyOf": [{"type": "integer", "minimum": 0}, {"type": "string"}]}),
]


class Rendering(Section):
    """A target that is rendered from the scene itself, with other parameter values."""

    parameters: Annotated[
        dict[str, Value],
        must(lambda values: all(values), lambda _: "must have keys that are not empty"),
    ] = Field(default={})
    """True values by key, as in `parameters`: a number, a list of numbers, or an image file. Empty: the scene as it
    stands."""
    spp: Count = Field(default=1024, description="Samples per pixel of the target.")
    integrator: AnyIntegrator | None = None
    """Integrator of the target; null: that of the run."""


class TargetConfig(Section):
    """What the image is compared with: exactly one of `file` and `render`; views with own targets need none."""

    file: ConfigPath | None = None
    """Target image (EXR, PNG, JPG, HDR), relative to the config file. It is turned as its EXIF orientation says, unless
    `scene.cameras` is given. Several views have theirs in `views`."""
    color_space: ColorSpace = Field(default="auto", description=f"{COLOR_SPACE} Only with `file`.")
    truth: bool = False
    """Whether files show the scene with its own values, as pictures of another renderer do: the error of each parameter
    is then known and told. Only with files."""
    render: Rendering | None = Field(default=None, description="Render the target from the scene.")
    mask: AnyMask = Mask()
    """Pixels that are left out of the loss, and what the others weigh: `auto` (all kinds are left out), `none`, the
    path of an image of weights, alone, or a section that switches kinds off and may add weights."""
    exposure: Exposure = 1.0
    """What the image is multiplied by before it is compared, target = exposure * image: a number, `auto` (recovered
    with the parameters, one factor), or `per_channel` (recovered, one for each channel, which is white balance). All
    views have the same; `views` may give each its own."""

    @model_validator(mode="before")
    @classmethod
    def _check_lists(cls, values: Any) -> Any:
        for name in ("file", "exposure") if isinstance(values, dict) else ():
            if isinstance(values.get(name), list):
                raise located(name, "is a list; give each view its own in `views`")
        return values

    @model_validator(mode="after")
    def _check_one(self) -> Self:
        if self.file is not None and self.render is not None:
            raise located("", "must have exactly one of `file` and `render`, and has both")
        if self.render is not None and self.color_space != "auto":
            raise located("color_space", "has no effect on a rendered target; it goes with `file`")
        if self.render is not None and self.truth:
            raise located("truth", "is known of a rendered target; it goes with files")
        return self

    @model_serializer(mode="wrap")
    def _without_unused(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        values: dict[str, Any] = handler(self)
        if self.render is not None:
            values.pop("color_space", None)
            values.pop("truth", None)
        return values


class ViewSpec(Section):
    """One view: a sensor of the scene, and what it is to see."""

    sensor: Annotated[int, Field(ge=0)] = Field(description="Index of the scene's sensor.")
    target: ConfigPath | None = None
    """Target image, relative to the config file; null: rendered, as `target.render` says."""
    mask: ViewMask | None = None
    """What stands in place of `target.mask`: `none`, or the path of an image of weights, alone."""
    weight: Positive = Field(default=1.0, description="The view's part of the loss, relative to the other views'.")
    exposure: Exposure | None = None
    """As `target.exposure`, but recovered for this view alone where it is not a number."""


def check_views(views: list[ViewSpec], scene: Any, target: TargetConfig) -> None:
    """Raise an error, located, where views contradict each other or `target`."""
    places: dict[int, int] = {}
    for number, view in enumerate(views):
        if places.setdefault(view.sensor, number) < number:
            raise located(f"views[{number}].sensor", f"{view.sensor} stands in views[{places[view.sensor]}] already")
        if view.target is None and target.render is None and scene.cameras is None:
            raise located(f"views[{number}].target", "missing; name an image, or have all rendered by target.render")
    if target.file is not None:
        raise located("target.file", "has no effect beside `views`; give each view its own target")
    if target.render is not None and all(view.target is not None for view in views):
        raise located("target.render", "has no effect: every view has a target of its own")
