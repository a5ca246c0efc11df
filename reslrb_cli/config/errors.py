"""Conversion of pydantic's errors to one located line that also describes a correct value or key."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, get_args

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from reslrb_cli.config.base import MARK, Section
from reslrb_cli.config.schema import Config
from reslrb_cli.config.yaml_text import Location, format_location

_EXPECTED = {
    "int_type": "an integer",
    "int_from_float": "an integer",
    "float_type": "a number",
    "string_type": "text",
    "bool_type": "true or false",
    "list_type": "a list",
    "tuple_type": "a list",
    "model_type": "a mapping (key: value)",
    "dict_type": "a mapping (key: value)",
    "finite_number": "a finite number",
    "greater_than": "above {gt}",
    "greater_than_equal": "at least {ge}",
    "less_than": "below {lt}",
    "less_than_equal": "at most {le}",
    "string_too_short": "nonempty text",
    "string_too_long": "text of at most {max_length} characters",
}


#: Advice for removed settings, by the last two names of the key, with the value if other values remain.
REMOVED = {
    "heightmap.grid": "write the shape as a mesh with about one vertex for each texel, as `reslrb lens` does",
    "fabrication.faces": "name the mesh by fabrication.face; the back is flat",
    "fabrication.min_thickness": "`reslrb export` prints the smallest thickness of the solid; remove it",
    "fabrication.receiver": "give the receiver the id `screen` in the scene file, and remove it",
    "fabrication.tool_radius": "the sheet names the largest ball cutter and the smallest hollow; remove it",
    "fabrication.size": "it is the size of the mesh; remove it",
    "integrator.sppc": "each part has as many samples as the step; remove it",
    "integrator.sppp": "each part has as many samples as the step; remove it",
    "integrator.sppi": "each part has as many samples as the step; remove it",
    "mask.specular": "list the kinds of pixels to leave out, such as mask: {kinds: [border, clipped, alpha]}",
    "mask.border": "list the kinds of pixels to leave out, such as mask: {kinds: [specular, clipped, alpha]}",
    "mask.clipped": "list the kinds of pixels to leave out, such as mask: {kinds: [specular, border, alpha]}",
    "mask.alpha": "list the kinds of pixels to leave out, such as mask: {kinds: [specular, border, clipped]}",
    "run.images_every": "a run saves its first and its last image; in Python, `Run.images` renders those between",
    "scene.sensors": "list them in `views`, such as views: [{sensor: 0}, {sensor: 1}]; all of scene.cameras are used",
    "views.loss": "all views have the loss that `loss` says",
    "render.seed": "the target always has the same samples; remove it",
    "integrator.freeze": "steps are always recorded; remove it",
    "integrator.jacobian_damping": "it is always 0.1; remove it",
    "integrator.stack_size": "64 vertices are stored, and longer paths are traced again; remove it",
    "integrator.light_share: auto": "take 0.5, which is the default",
    "integrator.type: direct_projective": "take prb_projective with max_depth: 2",
    "loss.scale": "set target.exposure: auto, which recovers the factor with the parameters",
    "loss.scales": "start from the values of a run with a smaller scene.size, by initial: {run: RUN}",
    "loss.data_range": "it is always the target's largest value; remove it",
    "loss.type: log_l2": "take relative_l2, or a loss of your own (type: custom)",
    "loss.type: smape": "take relative_l2, or a loss of your own (type: custom)",
    "optimizer.average": "let optimizer.schedule lower the rate; the last values then have as little noise",
    "optimizer.clamp_gradient": "use more samples, or optimizer.type: adam with a larger beta_2",
    "optimizer.schedule: plateau": "take cosine or exponential, and run.max_seconds to end early",
    "optimizer.type: adamw": "take adam; `bounds` and `regularizers` hold values back",
    "optimizer.type: rmsprop": "take adam with beta_1: 0",
    "regularizers.type: curvature": "take total_variation, or a larger precondition; export prints the smallest hollow",
    "regularizers.type: slope": "take total_variation",
    "regularizers.type: laplacian": "take total_variation, or set `precondition`",
    "regularizers.opposite": "only one face is free; the face on the other side is flat",
    "parameters.transform: softplus": "take log, for positive values",
    "run.adjoint: others": "take auto, which does the same",
    "run.first_batch": "the first batch always gives an image alone; remove it",
    "run.memory_budget": "set integrator.samples_per_pass; `reslrb optimize --dry-run` prints the memory of a step",
    "run.reach_spp": "it is always 64; remove it",
    "run.stop": "set run.max_seconds, or end the run by Ctrl-C: its folder is complete, and --resume continues it",
    "run.stages": "start from the values of a coarser run, by initial: {run: RUN}",
}


def _removed(location: Location, value: Any = None) -> str | None:
    """Return the replacement for a removed key, or for a removed `value` of a key. Return None if nothing was
    removed.
    """
    names = ".".join([part for part in location if isinstance(part, str)][-2:])
    advice = REMOVED.get(names if value is None else f"{names}: {value}")
    return None if advice is None else f"was removed; {advice}"


@dataclass(frozen=True)
class SettingError:
    """One error: its location in the notation of `--set`, and its description. `explain` says what would be right.

    `unknown` is pydantic's location of an unknown key. Only `explain` searches for the nearest known key, because the
    search takes time.
    """

    key: str
    message: str
    unknown: tuple[int | str, ...] | None = None

    def explain(self) -> str:
        """Describe the error, and describe a correct value or key."""
        return self.message if self.unknown is None else _unknown_key(self.unknown)


def problems(error: ValidationError, data: Any) -> list[SettingError]:
    """Return the errors that `error` reports for `data`, each once. Unknown keys come first, because unknown keys
    explain missing keys.
    """
    found = dict.fromkeys(_problem(detail, data) for detail in error.errors(include_url=False))
    return sorted(found, key=lambda problem: problem.unknown is None)


def _problem(detail: ErrorDetails, data: Any) -> SettingError:
    kind, value, context = detail["type"], detail["input"], detail.get("ctx", {})
    location = _location(detail["loc"], data)
    key = format_location(location)
    if kind == "extra_forbidden":
        return SettingError(key, "unknown key", unknown=detail["loc"])
    if kind == "located":
        return SettingError(_join(key, context["key"]), context["message"])
    if kind.startswith("union_tag"):
        if not isinstance(value, dict):
            return SettingError(key, _but_is("must be a mapping such as {type: NAME}", value))
        if advice := _removed((*location, "type"), value.get("type")):
            return SettingError(_join(key, "type"), f"{value['type']} {advice}")
        given, known = value.get("type"), [str(_type_name(section)) for section in _candidates(detail["loc"])[0]]
        return SettingError(_join(key, "type"), _but_is("must be " + _one_of(known, given), given))
    if kind == "missing" and isinstance(location[-1], str):
        return SettingError(key, "missing; it has no default")
    if kind == "missing":  # an entry of a pair
        return SettingError(format_location(location[:-1]), "must be a list of two: it has too few entries")
    if kind == "too_long":
        most = {1: "one", 2: "two"}.get(context["max_length"], str(context["max_length"]))
        return SettingError(key, f"must be a list of {most}: it has too many entries")
    if kind == "too_short":
        return SettingError(key, "must have at least one entry")
    if kind == "wrong":
        return SettingError(key, _but_is(context.get("message") or detail["msg"], value))
    if isinstance(value, str) and (advice := _removed(location, value)):
        return SettingError(key, f"{value} {advice}")
    if kind == "literal_error":
        return SettingError(
            key, _but_is("must be " + _one_of(re.findall(r"'([^']*)'", context["expected"]), value), value)
        )
    if kind in _EXPECTED:
        return SettingError(key, _but_is("must be " + _EXPECTED[kind].format(**context), value))
    return SettingError(key, detail["msg"])


# --- where ------------------------------------------------------------------------------------------------------------


def _location(loc: tuple[int | str, ...], data: Any) -> Location:
    """Return pydantic's location without the parts that do not exist in the file, such as tags of unions."""
    location: list[str | int] = []
    for part in loc:
        if _is_tag(part) or (isinstance(part, int) and isinstance(data, str)):
            continue
        location.append(str(part) if isinstance(data, dict) else part)
        try:
            data = data[part]
        except (LookupError, TypeError):
            data = None
    return tuple(location)


def _is_tag(part: int | str) -> bool:
    return isinstance(part, str) and part.startswith(MARK)


def _join(key: str, below: str) -> str:
    return f"{key}{'' if below.startswith('[') else '.'}{below}" if key and below else key or below


# --- unknown keys -----------------------------------------------------------------------------------------------------


def _sections(annotation: Any) -> list[type[Section]]:
    """Return the section classes in an annotation, at any depth."""
    if isinstance(annotation, type) and issubclass(annotation, Section):
        return [annotation]
    return [section for argument in get_args(annotation) for section in _sections(argument)]


def _candidates(loc: tuple[int | str, ...]) -> tuple[list[type[Section]], type[Section]]:
    """Return all sections that are possible at `loc`, and the section that was chosen."""
    union: list[type[Section]] = [Config]
    chosen: type[Section] = Config
    for part in loc:
        if _is_tag(part):
            chosen = next((s for s in union if _tag(s) == str(part)[len(MARK) :]), chosen)
        elif part in chosen.model_fields:
            union = _sections(chosen.model_fields[str(part)].annotation)
            chosen = union[0] if union else chosen
    return union, chosen


def _type_name(section: type[Section]) -> str | None:
    return section.model_fields["type"].default if "type" in section.model_fields else None


def _tag(section: type[Section]) -> str | None:
    """Return the tag by which a union identifies a section."""
    return getattr(section, "TAG", None) or _type_name(section)


def _unknown_key(loc: tuple[int | str, ...]) -> str:
    key = str(loc[-1])
    if advice := _removed(tuple(part for part in loc if not _is_tag(part))):
        return advice
    union, chosen = _candidates(loc[:-1])
    owners = list(dict.fromkeys(str(_type_name(each)) for each in union if key in each.model_fields))
    if owners:
        return f"not an option of {_type_name(chosen)} but of {', '.join(owners)}; remove it, or change the type"
    here = format_location(tuple(part for part in loc[:-1] if not _is_tag(part)))
    meant = _nearest(key, chosen.model_fields) or _below(chosen, here, key) or _below(Config, "", key)
    if meant:
        return f"unknown key; did you mean `{meant[0]}`?"
    return f"unknown key; known here: {', '.join(chosen.model_fields)}"


def _nearest(word: str, known: Iterable[str]) -> list[str]:
    """Return the most similar known word, if there is one."""
    return difflib.get_close_matches(word.lower(), list(known), n=1)


def _below(section: type[Section], name: str, key: str) -> list[str]:
    """Return the places one level below `section` where `key` is valid. `name` is the name of the section."""
    return [
        _join(name, f"{child}.{key}")
        for child, field in section.model_fields.items()
        if any(key in candidate.model_fields for candidate in _sections(field.annotation))
    ]


# --- values -----------------------------------------------------------------------------------------------------------


def _one_of(known: list[str], value: Any) -> str:
    known = list(dict.fromkeys(known))  # a union within a union names its members twice
    near = _nearest(value, known) if isinstance(value, str) else []
    choices = " or ".join(known) if len(known) < 3 else "one of " + ", ".join(known)
    return choices + (f" (did you mean {near[0]}?)" if near else "")


def _but_is(message: str, value: Any) -> str:
    """Add the actual value to `message`, unless the message names it."""
    if isinstance(value, bool):
        shown = str(value).lower()
    elif value is None:
        shown = "null (empty)"
    elif isinstance(value, float) and not math.isfinite(value):
        shown = ".nan" if math.isnan(value) else ".inf"
    elif isinstance(value, (int, float)):
        shown = repr(value) if abs(value) < 1e300 else "a number that large"
    elif isinstance(value, str):
        shown = f"the text {value[:60]!r}" + ("..." if len(value) > 60 else "")
    elif isinstance(value, list):
        shown = "a list"
    elif isinstance(value, dict):
        shown = "a mapping"
    else:
        shown = f"a {type(value).__name__}"
    return message if " not " in message or message.endswith("?") else f"{message}, not {shown}"
