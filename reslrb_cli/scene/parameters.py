"""The parameters that are recovered: selected by key or glob, checked, and set to where they start."""

from __future__ import annotations

import difflib
import functools
from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from typing import Any

import mitsuba as mi

from ..config import HEIGHTMAP, WORDS, ParameterSpec, Settings
from .catalog import ParameterInfo, describe, list_parameters
from .deformation import Deformation
from .movable import Movable, find_movable, heightmap_obstacle
from .selection import Selection
from .values import Place, check_bounds, check_transform, initial_array


def select_parameters(scene: mi.Scene, specs: Sequence[ParameterSpec], source: object) -> Selection:
    """Select the parameters of `scene` that `specs` name, and set their initial values in the scene.

    A glob selects what it matches and can be recovered. `source` names the configuration in errors. Raises ConfigError
    where a key matches nothing, or nothing that can be recovered, or what another spec has already; where what is to
    move cannot; where an initial value does not fit, is not finite, or lies outside of the bounds or of what the
    transform yields; and where a resolution is given for no texture.
    """
    selection, origin = _choose(mi.traverse(scene), specs, source)
    for key, settings in selection.specs.items():
        at = functools.partial(specs[origin[key]].at, word=settings.word)
        place = Place(source, f"parameters[{origin[key]}]", at)
        slot = selection.slot(key)
        value = initial_array(slot, settings.initial, settings.resolution, place)
        if settings.bounds is not None:
            check_bounds(slot, value, settings.bounds, place)
        check_transform(slot, value, settings, place)
        if settings.initial != "scene" or settings.resolution is not None:
            slot.set(value)
    selection.update()
    return selection


def set_values(
    scene: mi.Scene, specs: Sequence[ParameterSpec], values: Mapping[str, Any], source: object, option: str
) -> Selection:
    """Select the parameters of another load of the scene as `specs` do, and set `values`, of any of its keys, in it.

    What is given no value stays as the scene has it. Values are checked like initial ones are; an error is located at
    `option` and the key. A heightmap may have the resolution of its image file.
    """
    selection, _ = _choose(mi.traverse(scene), specs, source)
    params, names = selection.params, selection.deformation.values
    given: dict[str, str] = {}
    for pattern, value in values.items():
        place = Place(source, f"{option}.{pattern}", _itself)
        for key in [pattern] if pattern in names else _matching(params, pattern, place, [*names]):
            if key in given:
                raise place.fail("", f"`{key}` is matched by `{given[key]}` already")
            if selection.deformation.moves(key):
                raise place.fail("", f"`{key}` follows from {' and '.join(f'`{name}`' for name in names)} here")
            given[key] = pattern
            slot = selection.slot(key)
            array = initial_array(slot, value, None, place, any_size=key in names)
            slot.set(array)
    # What is tied has the value of the first, unless it is given one of its own.
    tied = {key: [other for other in others if other not in given] for key, others in selection.tied.items()}
    tied = {key: others for key, others in tied.items() if key in given}
    chosen = Selection(params, selection.specs, tied, selection.deformation)
    chosen.update()
    return chosen


def _itself(option: str) -> str:
    """Where an error of a value is that has no options: at itself."""
    return ""


def _choose(params: mi.SceneParameters, specs: Sequence[ParameterSpec], source: object
            ) -> tuple[Selection, dict[str, int]]:  # fmt: skip
    """What `specs` select of a scene, as it stands, and the number of the spec that each key comes from."""
    chosen: dict[str, Settings] = {}
    tied: dict[str, list[str]] = {}
    origin: dict[str, int] = {}  # of what is recovered, and of all scene parameters that this determines
    deformation = Deformation(params)
    for index, spec in enumerate(specs):
        place = Place(source, f"parameters[{index}]")
        if spec.motion is not None or spec.heightmap is not None:
            items = _movables(params, spec, place, origin)
            if spec.motion is not None:
                deformation.add_motion(items, spec.motion.pivot, spec.motion.free)
            elif spec.heightmap is not None:
                deformation.add_heightmap(items, spec.heightmap.resolution)
            for name, word in zip(spec.names, spec.motion.free if spec.motion is not None else ("",), strict=True):
                chosen[name], origin[name] = spec.settings(word), index
            continue
        keys = _tied_keys(params, spec.keys, place) if len(spec.keys) > 1 else _matching(params, spec.keys[0], place)
        for number, key in enumerate(keys):
            at = f"key[{number}]" if len(spec.keys) > 1 else "key"
            if key in origin:
                raise place.fail(at, f"`{key}` is matched by parameters[{origin[key]}] already")
            if deformation.moves(key):
                raise place.fail(at, f"`{key}` follows from a motion or a heightmap; remove one of the two")
            origin[key] = index
        if len(spec.keys) > 1:
            tied[keys[0]], keys = keys[1:], keys[:1]
        chosen |= dict.fromkeys(keys, spec.settings())
    return Selection(params, chosen, tied, deformation), origin


def _movables(params: mi.SceneParameters, spec: ParameterSpec, place: Place, origin: dict[str, int]
              ) -> tuple[Movable, ...]:  # fmt: skip
    """What a motion or a heightmap moves."""
    found, named = [], spec.objects()
    for option, number, name in named:
        at = option if len(named) == 1 else f"{option}[{number}]"
        item = find_movable(params, name)
        if isinstance(item, Movable) and spec.heightmap is not None:
            item = heightmap_obstacle(item) or item
        if isinstance(item, str):
            raise place.fail(at, item)
        if item.key in origin:
            raise place.fail(at, f"`{item.key}` is what parameters[{origin[item.key]}] recovers")
        found.append(item)
    if spec.motion is not None:
        for word in spec.motion.free:
            _check_effect(found, word, spec.motion.pivot is not None, place)
    return tuple(found)


def _check_effect(items: list[Movable], word: str, pivot: bool, place: Place) -> None:
    """Raise ConfigError where what is free moves nothing."""
    nowhere = all(item.node.class_name() == "DirectionalEmitter" for item in items)
    if nowhere and word != "rotation":
        raise place.fail("motion.free", f"{word} does not move `{items[0].id}`, which is a direction; free: [rotation]")
    if len(items) == 1 and items[0].is_point and not pivot and word != "translation":
        raise place.fail("motion.free", f"{word} about itself does not move `{items[0].id}`, which is a point")
    if len(items) == 1 and not items[0].is_shape and word == "scale" and not pivot:
        raise place.fail("motion.free", f"scale about itself does not move `{items[0].id}`, which has no size")


def _tied_keys(params: mi.SceneParameters, keys: list[str], place: Place) -> list[str]:
    """Keys that share one value; each names one parameter, and all have one shape."""
    found: list[str] = []
    for number, key in enumerate(keys):
        at = Place(place.source, f"{place.key}.key[{number}]", _itself)
        if key not in params.properties and any(fnmatchcase(name, key) for name in params.properties):
            raise at.fail("", f"`{key}` is a glob; name each key that is tied")
        [name] = _matching(params, key, at)
        first, this = describe(params, keys[0]), describe(params, name)
        if (this.shape, this.type) != (first.shape, first.type):
            shapes = " and ".join("x".join(map(str, info.shape)) or "one number" for info in (first, this))
            raise at.fail("", f"`{name}` cannot have the value of `{keys[0]}`: their shapes differ ({shapes})")
        found.append(name)
    return found


def _matching(params: mi.SceneParameters, pattern: str, place: Place, names: Sequence[str] = ()) -> list[str]:
    """The keys that `pattern` names, all of which can be recovered; `names` are others that could be meant."""
    if pattern in params.properties:
        info = describe(params, pattern)
        if (obstacle := _obstacle(info)) is not None:
            raise place.fail("key", f"`{pattern}` {obstacle}")
        return [pattern]
    matches = [key for key in params.properties if fnmatchcase(key, pattern)]
    if not matches:
        near = difflib.get_close_matches(pattern, [*names, *params.properties], n=3, cutoff=0.5)
        near = near or difflib.get_close_matches(pattern, _recoverable(params), n=3, cutoff=0)
        hint = " or ".join(f"`{key}`" for key in near)
        id, _, word = pattern.rpartition(".")
        if word in (*WORDS, HEIGHTMAP) and isinstance(find_movable(params, id), Movable):
            kind = "heightmap" if word == HEIGHTMAP else "motion"
            raise place.fail("key", f"`{pattern}` belongs to a {kind} of `{id}`, and `parameters` have none that is so")
        raise place.fail("key", f"`{pattern}` matches no parameter of the scene; did you mean {hint}?")
    infos = [describe(params, key) for key in matches]
    usable = [info.key for info in infos if _obstacle(info) is None]
    if not usable:
        more = f", nor can the other {len(infos) - 1}" if len(infos) > 1 else ""
        raise place.fail(
            "key",
            f"`{pattern}` matches nothing that can be recovered: `{infos[0].key}` {_obstacle(infos[0])}{more}",
        )
    return usable


def _obstacle(info: ParameterInfo) -> str | None:
    """Why a parameter cannot be recovered as the scene is: a texture of few bits, too, which loading has not mended."""
    if info.bits is None:
        return info.obstacle
    return (
        f"is stored with {info.bits} bits a channel, too few to follow a gradient; give the texture in the scene file "
        '<string name="format" value="variant"/>'
    )


def _recoverable(params: mi.SceneParameters) -> list[str]:
    return [info.key for info in list_parameters(params) if _obstacle(info) is None]
