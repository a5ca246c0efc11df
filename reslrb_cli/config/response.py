"""The response of a camera: how the values in a file depend on the light."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, WithJsonSchema, model_validator
from typing_extensions import Self

from reslrb_cli.config.base import Section, located, wrong
from reslrb_cli.errors import did_you_mean

Encoding = Literal["srgb", "linear"]
ENCODINGS: tuple[Encoding, ...] = ("srgb", "linear")
#: Number of slopes of a curve. They belong to equally spaced values of the file, from 0 to 1.
KNOTS = 6
#: Numbers of a response are below this limit.
MOST = 100
#: The exponent at which the recovery of `gamma` starts.
START_GAMMA = 2.2


def _is_positive(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and 0 < value < MOST


def _number_or_auto(value: Any) -> Any:
    if value is None or value == "auto" or _is_positive(value):
        return value
    raise wrong(f"must be a positive number below {MOST}, or `auto`")


def _numbers_or_auto(value: Any) -> Any:
    if value is None or value == "auto":
        return value
    if isinstance(value, (list, tuple)) and len(value) == KNOTS and all(_is_positive(each) for each in value):
        return list(value)
    raise wrong(f"must be a list of {KNOTS} positive numbers below {MOST}, or `auto`")


_NUMBER = {"type": "number", "exclusiveMinimum": 0, "exclusiveMaximum": MOST}
_GAMMA = WithJsonSchema({"anyOf": [_NUMBER, {"const": "auto"}]})
_LIST = {"type": "array", "items": _NUMBER, "minItems": KNOTS, "maxItems": KNOTS}
_CURVE = WithJsonSchema({"anyOf": [_LIST, {"const": "auto"}]})


class Response(Section):
    """Response of the camera: the curve from the light to the values in the file. Exactly one of the settings is given.
    A name alone, such as `srgb`, is short for `{encoding: srgb}`.

    `auto` recovers the curve with the parameters. A recovered `curve` needs a recovered exposure, because a curve is
    determined only up to a factor.
    """

    encoding: Encoding | None = None
    """A known curve. `srgb` is also the view transform "Standard" of Blender. `linear`: values are proportional to the
    light, and colour profiles are ignored."""
    gamma: Annotated[float | Literal["auto"] | None, BeforeValidator(_number_or_auto), _GAMMA] = None
    """The light is the value of the file to the power of this number. `auto` recovers the number, starting at 2.2."""
    curve: Annotated[list[float] | Literal["auto"] | None, BeforeValidator(_numbers_or_auto), _CURVE] = None
    """A monotone curve, given by its contrast at the values 0, 0.2, 0.4, 0.6, 0.8 and 1 of the file. The contrast is
    the relative change of the light, divided by that of sRGB. It is 1 at all values for sRGB, and larger than 1 where a
    film curve compresses highlights. Between these values, it is interpolated. At a linear value of 0.18, the curve
    equals sRGB. `auto` recovers the contrasts, starting at sRGB."""

    @model_validator(mode="after")
    def _check_one(self) -> Self:
        given = [name for name in ("encoding", "gamma", "curve") if getattr(self, name) is not None]
        if len(given) != 1:
            has = "has none" if not given else f"has {' and '.join(f'`{name}`' for name in given)}"
            raise located("", f"must have exactly one of `encoding`, `gamma` and `curve`, and {has}")
        return self

    def idle(self) -> set[str]:
        return {name for name in ("encoding", "gamma", "curve") if getattr(self, name) is None}

    @property
    def recovered(self) -> str:
        """`gamma` or `curve` if it is recovered, otherwise ""."""
        return "gamma" if self.gamma == "auto" else "curve" if self.curve == "auto" else ""

    @property
    def is_linear(self) -> bool:
        """Whether values are proportional to the light."""
        return self.encoding == "linear"

    def fixed(self) -> Response:
        """Return the response with which a recovery starts. Other responses are returned unchanged."""
        starts = {"gamma": Response(gamma=START_GAMMA), "curve": Response(encoding="srgb")}
        return starts.get(self.recovered, self)


def _response(value: Any) -> Any:
    if isinstance(value, str) and value in ENCODINGS:
        return {"encoding": value}
    if isinstance(value, (dict, Response)) or value is None:
        return value
    if value == "auto":
        raise wrong("is auto; write {curve: auto} or {gamma: auto} to recover it, or null for the usual encoding")
    hint = did_you_mean(value, ENCODINGS, cutoff=0.6, otherwise="") if isinstance(value, str) else ""
    forms = f"{', '.join(ENCODINGS)}, {{gamma: NUMBER}}, {{gamma: auto}}, {{curve: NUMBERS}}, {{curve: auto}}"
    raise wrong(f"must be one of {forms}" + (f" ({hint})" if hint else ""))


class _OrName:
    """JSON Schema annotation for a section that may also be a name."""

    def __get_pydantic_json_schema__(self, core: Any, handler: Any) -> dict[str, Any]:
        return {"anyOf": [handler(core), {"enum": list(ENCODINGS)}]}


#: A response, or the name of an encoding.
AnyResponse = Annotated[Response, BeforeValidator(_response), _OrName()]


def response_of_color_space(values: Any) -> Any:
    """Return a section with `response` in place of `color_space`, its former name. Raises a validator's error."""
    if not isinstance(values, dict) or "color_space" not in values:
        return values
    given = values["color_space"]
    if values.get("response") is not None:
        raise located("color_space", "is a former name of `response`, which is given too; remove it")
    known = ("auto", "linear", "srgb")
    if given not in known:
        hint = f" ({did_you_mean(given, known)})" if isinstance(given, str) else ""
        raise located("color_space", f"must be one of {', '.join(known)}{hint}")
    rest = {name: value for name, value in values.items() if name != "color_space"}
    return rest if given == "auto" else {**rest, "response": given}
