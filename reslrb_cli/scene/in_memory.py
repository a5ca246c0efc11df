"""An `mi.Scene` of the caller in place of a scene file."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.config.parameters import is_named
from reslrb_cli.errors import ConfigError
from reslrb_cli.scene.load import check_scene

#: What to do where an experiment needs the description of its scene, or another process needs the scene.
INSTEAD = "give the scene as a file or as a Mitsuba dictionary"
_MERGED = "Mitsuba merges shapes and materials as it loads a scene, unless `optimize=False`"

#: How often each scene, by its `id`, has got its first values again.
_restored: Counter[int] = Counter()


class SceneInMemory:
    """A scene of the caller, and the values that its parameters had when the caller passed it.

    Raises ConfigError, located in `source`, for a scene that no run can use.
    """

    def __init__(self, scene: mi.Scene, source: object) -> None:
        check_scene(source, scene)
        self.scene = scene
        params = mi.traverse(scene)
        self._values = {key: _copied(params[key]) for key in params.properties}

    @property
    def uses(self) -> int:
        """A number that changes if another experiment, or another call, uses the scene."""
        return _restored[id(self.scene)]

    def restore(self) -> mi.Scene:
        """Give the scene its first values, without derivatives, and return it."""
        params = mi.traverse(self.scene)
        for key, value in self._values.items():
            now = params[key]
            if dr.grad_enabled(now) or not _equal(now, value):
                params[key] = _copied(value)
        params.update()
        _restored[id(self.scene)] += 1
        return self.scene

    def check_merged(self, keys: Iterable[str], objects: Iterable[str], source: object) -> None:
        """Raise ConfigError if Mitsuba has merged an object of the parameters `keys` (or globs), or one of the moved
        `objects`, with other objects.
        """
        params, shapes, keys = mi.traverse(self.scene), self.scene.shapes(), list(keys)
        if any(not shape.id() for shape in shapes):
            ids = {shape.id() for shape in shapes} | {emitter.id() for emitter in self.scene.emitters()}
            lost = [name for name in objects if name not in ids]
            lost += [each for each in keys if not any(is_named(key, [each]) for key in params.properties)]
            if lost:
                raise ConfigError(source, "scene", f"has no `{lost[0]}`, but shapes without ids; {_MERGED}")
        users: dict[Any, list[str]] = {}
        for shape in shapes:
            if shape.bsdf() is not None:
                users.setdefault(shape.bsdf(), []).append(shape.id())
        for key in params.properties:
            if is_named(key, keys):
                node = params.properties[key][2]
                while node is not None and node not in users:
                    node = params.hierarchy[node][0]
                names = users.get(node, [])
                if len(names) > 1 and key.partition(".")[0] in names:
                    raise ConfigError(source, "scene", f"has one material for {', '.join(names)}; {_MERGED}")


def _copied(value: Any) -> Any:
    """Return a value that later changes of the scene do not affect."""
    return type(value)(dr.detach(value))


def _equal(first: Any, second: Any) -> bool:
    if dr.is_array_v(first) or dr.is_tensor_v(first):
        a, b = (np.array(getattr(each, "matrix", each) if "Transform" in type(each).__name__ else each)
                for each in (first, second))  # fmt: skip
        return a.shape == b.shape and np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
    return bool(first == second)
