"""Parameters that are recovered. Keys or globs select the parameters, which are checked and set to their initial
values.

A `Selection` has the parameters' settings, and transfers values to and from the scene.
"""

from __future__ import annotations

import functools
import logging
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.config.parameters import HEIGHTMAP, REGULARIZERS, WORDS, ParameterSpec, Settings, Thickness, tint_of
from reslrb_cli.errors import did_you_mean
from reslrb_cli.scene.catalog import MARGIN, ParameterInfo, describe, list_parameters, open_domain, unused
from reslrb_cli.scene.deformation import Deformation, Movable, find_movable
from reslrb_cli.scene.load import warn_once
from reslrb_cli.scene.plastic import PlasticTables
from reslrb_cli.scene.tints import Tints, tint_obstacle
from reslrb_cli.scene.upsampling import Upsampling
from reslrb_cli.scene.values import (
    Array,
    ParameterValue,
    Place,
    check_bounds,
    check_transform,
    first_entry,
    initial_array,
    settle,
)


@dataclass(frozen=True)
class Selection:
    """Recovered parameters by key. Records use the same keys.

    `params` is the complete result of `mi.traverse` for the scene. `specs` maps each key to its settings. Keys follow
    the order of the configuration. Keys that match one glob follow the order of the scene. A key is an entry of
    `params`, the name of a tint, or a value of `deformation`, for example a motion's `ID.translation` or a heightmap.
    In a spectral variant, `colours` has the colours whose spectra are in the scene. `tied` maps a key of
    `params` to the other keys of `params` that share its value. `factors` are values outside of the scene that multiply
    its images (`add_factor`).
    """

    params: mi.SceneParameters
    specs: dict[str, Settings]
    tied: dict[str, list[str]]
    deformation: Deformation
    tints: Tints
    colours: Upsampling
    factors: dict[str, Any] = field(default_factory=dict)

    def add_factor(self, key: str, value: Any, settings: Settings) -> None:
        """Recover a factor that is not part of the scene."""
        self.specs[key], self.factors[key] = settings, value

    @property
    def keys(self) -> list[str]:
        """Keys of the recovered values."""
        return list(self.specs)

    @property
    def scene_keys(self) -> list[str]:
        """Entries of `params` that the recovered values determine."""
        own = [key for key in self.keys if self._holder(key) is self.params]
        own += [other for key in own for other in self.tied.get(key, ())]
        return [*own, *self.placed_keys]

    @property
    def placed_keys(self) -> list[str]:
        """Entries of `params` that are functions of recovered values: colours, textures with a tint, and moved
        objects.
        """
        return list(dict.fromkeys([*self.colours.keys, *self.tints.keys, *self.deformation.keys]))

    def kind(self, key: str) -> str:
        """Return the kind of `key` for regularizers: `heightmap`, `bitmap`, `mesh`, or "" for other parameters."""
        slot = self.slot(key)
        if key in self.deformation.values:
            return HEIGHTMAP if key.endswith(f".{HEIGHTMAP}") else ""
        if key.endswith(".vertex_positions"):
            return "mesh"
        return "bitmap" if slot.is_texture and not slot.halo and not slot.is_signed else ""

    def check_regularizers(self, key: str, place: Place) -> None:
        """Raise ConfigError for regularizers that do not apply to `key`, or occur twice."""
        kind, seen = self.kind(key), set()
        for number, each in enumerate(self.specs[key].regularizers):
            at = f"regularizers[{number}].type"
            if not kind:
                raise place.fail(at, f"`{key}` has no surface; heightmaps and bitmaps have one")
            if each.type not in REGULARIZERS[kind]:
                would = ", ".join(REGULARIZERS[kind])
                raise place.fail(at, f"{each.type} is not defined for `{key}`, a {kind}; use {would or 'none'}")
            if each.type in seen:
                raise place.fail(at, f"{each.type} is given twice; give it once, with the sum of the weights")
            seen.add(each.type)

    def value(self, key: str) -> Any:
        """Return the current value of `key` as a Dr.Jit value."""
        return self._holder(key)[key]

    def array(self, key: str) -> np.ndarray[Any, Any]:
        """Return the current value of `key`: a texture (H, W, C), a colour (C,), a buffer (N,), or a number ().

        The array of an environment map lacks the halo columns of its tensor.
        """
        return self.slot(key).get()

    def hand_over(self, values: Mapping[str, Any]) -> None:
        """Write `values`, which maps keys to Dr.Jit values, to the scene. The gradients of a step then reach the
        values.

        The method evaluates all values, so that the first step and all later steps use the same kernels.
        """
        own: list[str] = []
        for key, value in values.items():
            holder = self._holder(key)
            keys = [key, *self.tied.get(key, ())] if holder is self.params else [key]
            for each in keys:
                holder[each] = value
            own += keys if holder is self.params else []
        moved = self._place()
        self.params.update()
        settled = settle(self.params, (*own, *self.placed_keys))
        dr.eval([self.params[key] for key in own], moved, settled, self.factors)

    def collect(self) -> None:
        """Propagate the gradients at moved objects, spectra and texels back to the recovered values."""
        self.deformation.collect()
        self.colours.collect()
        self.tints.collect()

    def push(self) -> None:
        """Propagate tangents to the scene from the values that move objects, from tints, and from colours."""
        self.deformation.push()
        self.tints.push()
        self.colours.push()
        PlasticTables(self.params).push()

    def shown(self, key: str, value: Any) -> np.ndarray[Any, Any]:
        """Convert `value`, a Dr.Jit value of the parameter `key`, to the form that `array` returns."""
        return self.slot(key).shown(value)

    def set_arrays(self, values: Mapping[str, np.ndarray[Any, Any]]) -> None:
        """Set parameters in the scene. The arrays have the form that `array` returns."""
        for key, value in values.items():
            self.slot(key).set(value)
        self.update()

    def update(self) -> None:
        """Update tied keys and moved objects of the scene after values were set."""
        for key, others in self.tied.items():
            for other in others if key not in self.colours else ():
                self.params[other] = type(self.params[other])(self.params[key])
        self._place()
        self.params.update()

    def _place(self) -> list[Any]:
        """Set the entries of `params` that are functions of recovered values. Returns the arrays to evaluate."""
        return self.deformation.place() + self.tints.place() + self.colours.place()

    def slot(self, key: str) -> ParameterValue:
        """Return an object that reads and sets the value of `key`. Call `update` afterwards."""
        return ParameterValue(self._holder(key), key)

    def _holder(self, key: str) -> Any:
        """Return the object that stores the value of `key`."""
        if key in self.factors:
            return self.factors
        if key in self.tints:
            return self.tints
        if key in self.colours:
            return self.colours
        return self.deformation.values if key in self.deformation.values else self.params


def select_parameters(scene: mi.Scene, specs: Sequence[ParameterSpec], source: object) -> Selection:
    """Select the parameters of `scene` that `specs` describes. Set them in the scene to their initial values.

    A glob selects the matching parameters that can be recovered. `source` names the configuration in errors. Raises
    ConfigError for:

    - a key that matches no parameter, no recoverable parameter, or a parameter of another spec;
    - an object that cannot be moved;
    - an initial value that does not fit, is not finite, or lies outside of the bounds or the range of the transform;
    - a resolution for a parameter that is not a texture.
    """
    selection, origin = _choose(mi.traverse(scene), specs, source)
    for key, settings in selection.specs.items():
        at = functools.partial(specs[origin[key]].at, word=settings.word)
        place = Place(source, f"parameters[{origin[key]}]", at)
        slot = selection.slot(key)
        value = known = initial_array(slot, settings.initial, settings.resolution, place)
        if settings.bounds is not None:
            plate = any(isinstance(each, Thickness) for each in settings.regularizers)
            held = Place(place.source, place.key, lambda _: "regularizers") if plate else place
            check_bounds(slot, value, settings.bounds, held)
        check_transform(slot, value, settings, place)
        value = _moved_inside(selection, key, value, place)
        # The sides of an environment map meet.
        is_map = slot.is_texture and not slot.halo and min(slot.get().shape[:2]) > 1
        if settings.smoothing is not None and not is_map:
            instead = "; recover a `heightmap` of the mesh instead" if key.endswith(".vertex_positions") else ""
            raise place.fail("precondition", f"smooths textures and heightmaps, but not `{key}`{instead}")
        selection.check_regularizers(key, place)
        if settings.initial != "scene" or settings.resolution is not None or value is not known:
            slot.set(value)
    selection.update()
    return selection


def _moved_inside(selection: Selection, key: str, value: Array, place: Place) -> Array:
    """Return `value` inside of the range in which `key` has a derivative, and bound `key` to this range.

    Exported scenes have weights of exactly 0. Such a weight would never change.
    """
    keys = [each for each in (key, *selection.tied.get(key, ())) if each in selection.params.properties]
    ranges = [open_domain(selection.params, each) for each in keys] or [(-np.inf, np.inf)]
    settings = selection.specs[key]
    low, high = settings.bounds or (-np.inf, np.inf)
    inner = max(low, *(each[0] for each in ranges)), min(high, *(each[1] for each in ranges))
    if settings.transform != "none" or inner == (low, high) or inner[0] >= inner[1]:
        return value
    selection.specs[key] = replace(settings, bounds=inner)
    moved = np.clip(value, np.float32(inner[0]), np.float32(inner[1]))
    if (at := first_entry(value, moved != value)) is None:
        return value
    why = f"starts {MARGIN:g} inside of its range, because Mitsuba has no derivative at {at}"
    warn_once(f"{place.source}: {place.key}: `{key}` {why}", logging.INFO)
    return moved


def set_values(
    scene: mi.Scene, specs: Sequence[ParameterSpec], values: Mapping[str, Any], source: object, option: str
) -> Selection:
    """Select the parameters of `specs` in another load of the scene, and set `values`. Any of their keys can be used.

    Other parameters keep the values of the scene. Values are checked like initial values. Errors name `option` and the
    key. A heightmap may have the resolution of its image file.
    """
    selection, _ = _choose(mi.traverse(scene), specs, source)
    given = put_values(selection, values, source, option)
    # Tied parameters get the value of the first one, unless they have their own.
    tied = {key: others for key, others in selection.tied.items() if key in given}
    return untied(replace(selection, tied=tied), given)


def put_values(selection: Selection, values: Mapping[str, Any], source: object, option: str = "") -> set[str]:
    """Set `values` of any parameters of a scene, by key or glob, and return their keys. Call `untied` afterwards.

    Values are checked like initial values. Errors name `option` and the key. A heightmap may have the resolution of its
    image file.
    """
    names = [*selection.tints.names, *selection.deformation.values, *selection.factors]
    given: dict[str, str] = {}
    for pattern, value in values.items():
        place = Place(source, f"{option}.{pattern}" if option else pattern, lambda _: "")  # a number has no options
        for key in [pattern] if pattern in names else matching_keys(selection.params, pattern, place, names):
            if key in given:
                raise place.fail("", f"`{key}` is already matched by `{given[key]}`")
            by = [*selection.deformation.values] if key in selection.deformation.keys else []
            by += [tint_of(key)] if key in selection.tints.keys else []
            if by:
                raise place.fail("", f"`{key}` depends on {' and '.join(f'`{name}`' for name in by)} here")
            given[key] = pattern
            selection.colours.add(key)
            slot = selection.slot(key)
            slot.set(initial_array(slot, value, None, place, any_size=key in names))
    return set(given)


def untied(selection: Selection, given: Collection[str]) -> Selection:
    """Return the selection in which the keys `given` follow no other key, and update the scene."""
    tied = {key: [other for other in others if other not in given] for key, others in selection.tied.items()}
    selection = replace(selection, tied=tied)
    selection.update()
    return selection


def _choose(params: mi.SceneParameters, specs: Sequence[ParameterSpec], source: object
            ) -> tuple[Selection, dict[str, int]]:  # fmt: skip
    """Return the selection for `specs` in an unchanged scene, and the index of each key's spec."""
    chosen: dict[str, Settings] = {}
    tied: dict[str, list[str]] = {}
    origin: dict[str, int] = {}  # of recovered parameters, and of all scene parameters that they determine
    deformation, colours = Deformation(params), Upsampling(params)
    tints = Tints(params, colours)
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
        if spec.tint is not None:
            key = _tinted_key(params, spec.tint, place, origin)
            origin[key] = origin[name := tints.add(key)] = index
            chosen[name] = spec.settings()
            continue
        is_tied = len(spec.keys) > 1
        keys = _tied_keys(params, spec.keys, place) if is_tied else matching_keys(params, spec.keys[0], place)
        for number, key in enumerate(keys):
            at = f"key[{number}]" if is_tied else "key"
            if key in origin:
                raise place.fail(at, f"`{key}` is already matched by parameters[{origin[key]}]")
            if key in deformation.keys:
                raise place.fail(at, f"`{key}` depends on a motion or a heightmap; remove one of the two")
            origin[key] = index
        if is_tied:
            tied[keys[0]], keys = keys[1:], keys[:1]
        chosen |= dict.fromkeys(keys, spec.settings())
    for key in [key for key in chosen if key in params.properties]:
        if (why := unused(params, key, chosen)) is not None:
            del chosen[key]  # a glob may select others
            if origin[key] not in {origin[other] for other in chosen if other in origin}:
                raise Place(source, f"parameters[{origin[key]}]").fail("key", f"`{key}` {why}")
    for key in chosen:
        colours.add(key, tied.get(key, ()))
    return Selection(params, chosen, tied, deformation, tints, colours), origin


def _tinted_key(params: mi.SceneParameters, key: str, place: Place, origin: Mapping[str, int]) -> str:
    """Return the key of a texture that has no other entry. Raises ConfigError."""
    at = Place(place.source, f"{place.key}.tint", lambda _: "")
    [found, *more] = matching_keys(params, key, at)
    if more:
        raise at.fail("", f"`{key}` matches {1 + len(more)} parameters; give each texture its own tint")
    if (obstacle := tint_obstacle(params, found)) is not None:
        raise at.fail("", f"`{found}` {obstacle}")
    if found in origin:
        raise at.fail("", f"`{found}` is already matched by parameters[{origin[found]}]")
    return found


def _movables(params: mi.SceneParameters, spec: ParameterSpec, place: Place, origin: dict[str, int]
              ) -> tuple[Movable, ...]:  # fmt: skip
    """Return the objects that a motion or a heightmap moves."""
    found, named = [], spec.objects()
    for option, number, name in named:
        at = option if len(named) == 1 else f"{option}[{number}]"
        item = find_movable(params, name)
        if isinstance(item, Movable) and spec.heightmap is not None:
            item = item.heightmap_obstacle() or item
        if isinstance(item, str):
            raise place.fail(at, item)
        if item.key in origin:
            raise place.fail(at, f"`{item.key}` is already recovered by parameters[{origin[item.key]}]")
        found.append(item)
    if spec.motion is not None:
        for word in spec.motion.free:
            _check_effect(found, word, spec.motion.pivot is not None, place)
    return tuple(found)


def _check_effect(items: list[Movable], word: str, pivot: bool, place: Place) -> None:
    """Raise ConfigError if the free part of a motion moves nothing."""
    id, alone = f"`{items[0].id}`", len(items) == 1 and not pivot
    obstacle = None
    turns = word.startswith("rotation")
    if not turns and all(item.node.class_name() == "DirectionalEmitter" for item in items):
        obstacle = f"{word} does not move {id}, which is a direction; free: [rotation]"
    elif alone and items[0].is_point and (turns or word == "scale"):
        obstacle = f"{word} about itself does not move {id}, which is a point"
    elif alone and not items[0].is_shape and word == "scale":
        obstacle = f"scale about itself does not move {id}, which has no size"
    if obstacle is not None:
        raise place.fail("motion.free", obstacle)


def _tied_keys(params: mi.SceneParameters, keys: list[str], place: Place) -> list[str]:
    """Return keys that share one value. Each key names one parameter, and all these parameters have one shape."""
    found: list[str] = []
    for number, key in enumerate(keys):
        at = Place(place.source, f"{place.key}.key[{number}]", lambda _: "")
        if key not in params.properties and any(fnmatchcase(name, key) for name in params.properties):
            raise at.fail("", f"`{key}` is a glob; name each key that is tied")
        [name] = matching_keys(params, key, at)
        first, this = describe(params, keys[0]), describe(params, name)
        if (this.shape, this.type) != (first.shape, first.type):
            shapes = " and ".join("x".join(map(str, info.shape)) or "one number" for info in (first, this))
            raise at.fail("", f"`{name}` cannot have the value of `{keys[0]}`: their shapes differ ({shapes})")
        found.append(name)
    return found


def matching_keys(params: mi.SceneParameters, pattern: str, place: Place, names: Sequence[str] = ()) -> list[str]:
    """Return the keys that match `pattern`. They must be recoverable. `names` are other suggestions.

    Raises ConfigError at `place`.
    """
    is_key = pattern in params.properties
    matches = [pattern] if is_key else [key for key in params.properties if fnmatchcase(key, pattern)]
    if not matches:
        recoverable = [info.key for info in list_parameters(params) if _obstacle(info) is None]
        nearest = did_you_mean(pattern, recoverable, 3, 0)
        hint = did_you_mean(pattern, [*names, *recoverable], 3, 0.5, otherwise=nearest)
        id, _, word = pattern.rpartition(".")
        if word in (*WORDS, HEIGHTMAP) and isinstance(find_movable(params, id), Movable):
            kind = "heightmap" if word == HEIGHTMAP else "motion"
            raise place.fail(
                "key", f"`{pattern}` belongs to a {kind} of `{id}`, and `parameters` has none of this kind"
            )
        raise place.fail("key", f"`{pattern}` matches no parameter of the scene; {hint}")
    infos = [describe(params, key) for key in matches]
    usable = [info.key for info in infos if _obstacle(info) is None]
    if not usable:
        first = f"`{infos[0].key}` {_obstacle(infos[0])}"
        if is_key:
            raise place.fail("key", first)
        more = f", nor can the other {len(infos) - 1}" if len(infos) > 1 else ""
        raise place.fail("key", f"`{pattern}` matches nothing that can be recovered: {first}{more}")
    return usable


def _obstacle(info: ParameterInfo) -> str | None:
    """Return the reason why a parameter cannot be recovered. For example, a texture has few bits per channel, and
    loading has not converted the texture.
    """
    if info.bits is None:
        return info.obstacle
    return (
        f'is stored with {info.bits} bits per channel, too few to follow a gradient; add <string name="format" '
        'value="variant"/> to the texture in the scene file'
    )
