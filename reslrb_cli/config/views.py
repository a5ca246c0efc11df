"""How a target is compared with: the mask that leaves pixels out of it, and its exposure."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, GetJsonSchemaHandler, WithJsonSchema
from pydantic_core import CoreSchema

from reslrb_cli.config.base import ConfigPath, Positive, Section, located, wrong
from reslrb_cli.config.optimizers import AnyLoss

_KINDS = ("specular", "border", "clipped", "alpha", "nonfinite")


class Mask(Section):
    """Which pixels of a target are left out, and what the others weigh.

    Kinds act on a target that is read from a file. `specular` and `border` are what light tracing lacks: they act where
    one of the run's integrator and the target's traces from the light and the other does not, also on a rendered one.
    """

    file: ConfigPath | None = None
    """Image of weights, of the target's size, relative to the config file: 0 leaves a pixel out. Values are taken as
    they stand in it, of 8 and 16 bits as shares of the greatest; of several channels the mean."""
    specular: bool = True
    """Leave out pixels that see smooth glass or mirrors directly, which light tracing cannot render."""
    border: bool = True
    """Leave out pixels within the reconstruction filter's radius of the film's border, where light tracing is
    darker."""
    clipped: bool = True
    """Leave out pixels of 8 and 16 bit files that are at the greatest value in any channel."""
    alpha: bool = Field(default=True, description="Leave out pixels whose alpha is 0.")
    nonfinite: bool = True
    """Leave out pixels that are not finite; false: a file that has any is refused."""


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

MASK = (
    "Pixels that are left out of the loss, and what the others weigh: `auto` (all kinds are left out), `none`, the "
    "path of an image of weights, alone, or a section that switches kinds off and may add weights."
)

MASK_MIXED = (
    "Leave out, with `specular`, the pixels that see a coat, a blend or a thin pane directly, of whose light light "
    "tracing lacks a part; else they stay, and are counted."
)


def _exposure(value: Any) -> Any:
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if (is_number and math.isfinite(value) and value > 0) or value in ("auto", "per_channel"):
        return value
    raise wrong("must be a positive number, `auto` or `per_channel`")


_EXPOSURE = [{"type": "number", "exclusiveMinimum": 0}, {"enum": ["auto", "per_channel"]}]

#: One view's exposure: a number, `auto` (recovered, one factor), or `per_channel` (recovered, one factor a channel).
Exposure = Annotated[
    float | Literal["auto", "per_channel"],
    BeforeValidator(_exposure),
    WithJsonSchema({"anyOf": _EXPOSURE}),
]


def _exposures(value: Any) -> Any:
    return [_exposure(item) for item in value] if isinstance(value, list) else _exposure(value)


#: One exposure that all views share, or a list with one for each.
Exposures = Annotated[
    float | Literal["auto", "per_channel"] | list[Exposure],
    BeforeValidator(_exposures),
    WithJsonSchema({"anyOf": [*_EXPOSURE, {"type": "array", "items": {"anyOf": [{"type": "number"}, _EXPOSURE[1]]}}]}),
]

EXPOSURE = (
    "What the image is multiplied by before it is compared, target = exposure * image: a number, `auto` (recovered "
    "with the parameters, one factor), or `per_channel` (recovered, one for each channel, which is white balance)"
)


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


class ViewSpec(Section):
    """One view: a sensor of the scene, and what it is to see."""

    sensor: Annotated[int, Field(ge=0)] = Field(description="Index of the scene's sensor.")
    target: ConfigPath | None = None
    """Target image, relative to the config file; null: rendered, as `target.render` says."""
    mask: AnyMask | None = Field(default=None, description="As `target.mask`, which it stands in place of.")
    mask_mixed: bool | None = Field(default=None, description="As `target.mask_mixed`, which it stands in place of.")
    weight: Positive = Field(default=1.0, description="The view's part of the loss, relative to the other views'.")
    exposure: Exposure | None = None
    """As `target.exposure`, but recovered for this view alone where it is not a number."""
    loss: AnyLoss | None = Field(default=None, description="How this view is compared; null: as `loss` says.")


def check_views(views: list[ViewSpec], scene: Any, target: Any) -> None:
    """Raise an error, located, where views and the short forms, `scene.sensors` and `target`, contradict each other."""
    places: dict[int, int] = {}
    for number, view in enumerate(views):
        if places.setdefault(view.sensor, number) < number:
            raise located(f"views[{number}].sensor", f"{view.sensor} stands in views[{places[view.sensor]}] already")
        if view.target is None and target.render is None and scene.cameras is None:
            raise located(f"views[{number}].target", "missing; name an image, or have all rendered by target.render")
    if scene.sensors != [0]:
        raise located("scene.sensors", "has no effect beside `views`, which name their sensors")
    if target.file is not None:
        raise located("target.file", "has no effect beside `views`; give each view its own target")
    if isinstance(target.exposure, list):
        raise located("target.exposure", "is a list, but there are `views`: give each view its own exposure")
    if target.render is not None and all(view.target is not None for view in views):
        raise located("target.render", "has no effect: every view has a target of its own")
