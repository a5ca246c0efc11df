"""The graph of a scene's objects: what there is, and what uses what."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import mitsuba as mi


@dataclass
class SceneGraph:
    """All objects below a scene, each once, in order of traversal.

    Unlike `mi.traverse`, which lists an object below the first that uses it, it knows all parents of each.
    """

    objects: list[Any] = field(default_factory=list)
    parents: dict[Any, list[Any]] = field(default_factory=dict)

    @classmethod
    def of(cls, scene: Any) -> SceneGraph:
        """The graph of `scene`."""

        class Children(mi.TraversalCallback):
            def __init__(self) -> None:
                super().__init__()
                self.found: list[Any] = []

            def put(self, name: str, value: Any, flags: int, cpptype: Any = None) -> None:
                if isinstance(value, mi.Object):
                    self.found.append(value)

        graph, waiting = cls(), [scene]
        while waiting:
            parent = waiting.pop()
            callback = Children()
            parent.traverse(callback)
            for child in callback.found:
                if child not in graph.parents:
                    graph.objects.append(child)
                    graph.parents[child] = []
                    waiting.append(child)
                graph.parents[child].append(parent)
        return graph

    def of_type(self, kind: Any) -> list[Any]:
        """All objects that are instances of `kind`, such as `mi.BSDF`."""
        return [item for item in self.objects if isinstance(item, kind)]

    def shapes(self) -> list[Any]:
        """All shapes that rays can hit, also those inside of groups that are instanced."""
        return [shape for shape in self.of_type(mi.Shape) if shape.class_name() not in ("Instance", "ShapeGroupPlugin")]

    def is_shown(self, shape: Any) -> bool:
        """Whether rays may meet a shape: it does not stand in a group alone, where nothing is instanced."""
        grouped = all(parent.class_name() == "ShapeGroupPlugin" for parent in self.parents[shape])
        return not grouped or any(item.class_name() == "Instance" for item in self.objects)

    def surface_bsdfs(self) -> list[Any]:
        """The BSDFs that shapes have (not those nested in others), each once."""
        found: dict[Any, None] = {}
        for shape in self.shapes():
            if shape.bsdf() is not None:
                found[shape.bsdf()] = None
        return list(found)

    def owning_bsdfs(self, item: Any) -> list[Any]:
        """The outermost BSDFs that use `item` (a texture, or a nested BSDF) at any depth."""
        owners: dict[Any, None] = {}
        waiting = [item]
        while waiting:
            current = waiting.pop()
            above = [p for p in self.parents.get(current, []) if isinstance(p, (mi.BSDF, mi.Texture))]
            if isinstance(current, mi.BSDF) and len(above) < len(self.parents.get(current, [])):
                owners[current] = None
            waiting += above
        return list(owners)
