"""Derivatives of `roughplastic` by its roughness and by its index of refraction.

The diffuse lobe of this BSDF has tables: the transmittance T of the rough boundary, by the cosine of a direction, and
the diffuse reflectance r inside of the boundary. Its value towards wo is

    f = d / (pi eta^2 (1 - d' r)) T(cos wi) T(cos wo) cos wo        d: diffuse reflectance; d' = d if nonlinear, or 1

T and r depend on alpha and eta. Mitsuba 3.9 computes both tables anew for each value, but without derivatives.
`with_tables` puts leaves with the same numbers in their place while an integrator differentiates. The gradient then
also reaches the tables, and goes on to alpha and eta by the slopes of the tables. The slopes are differences of fourth
order between the tables of four BSDFs that Mitsuba makes for neighbouring values.

A smooth `plastic` has a sampling weight that depends on its colours, with derivatives that no estimator needs. In the
second pass of a step, Dr.Jit adds them to other parameters, such as the opacity of a mask over the plastic. They are
cut off for a step as well.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.scene.catalog import entry_value

Array = np.ndarray[Any, Any]

#: Parameters on which the tables depend, and the largest step of their differences. A step is at most a quarter of
#: alpha, or an eighth of the distance of eta from 1. Mitsuba integrates r with few nodes, so r has waves of 1e-5 to
#: 4e-3 over distances of 0.002 and more. Short steps show the slopes of these waves. With a step of 0.008, the slope of
#: r was 8 % off for GGX with alpha = 0.1 (`test_slopes_ignore_the_waves_of_a_table`).
_STEPS = {"alpha": 0.04, "eta": 0.03}
#: Nodes of the differences, in steps, with their coefficients.
_NODES = {1: 2 / 3, -1: -2 / 3, 2: -1 / 12, -2: 1 / 12}


@dataclass
class _Tables:
    """Tables T (64,) and r (1,) of one BSDF as leaves, and their slopes by tracked parameters. `keys` are the keys of
    its alpha and eta.
    """

    node: mi.BSDF
    keys: dict[str, str]
    leaves: tuple[mi.Float, ...] = ()
    slopes: dict[str, tuple[mi.Float, mi.Float]] = field(default_factory=dict)


class PlasticTables:
    """Tables of all `roughplastic` BSDFs among `params`, the result of `mi.traverse` for a scene or a BSDF."""

    def __init__(self, params: mi.SceneParameters) -> None:
        self.params = params
        self._smooth: dict[mi.BSDF, None] = {}
        found: dict[mi.BSDF, _Tables] = {}
        for key, (_, _, node, _) in params.properties.items():
            if node.class_name() == "SmoothPlastic":
                self._smooth[node] = None
            if node.class_name() == "RoughPlastic" and (name := key.rpartition(".")[2]) in _STEPS:
                found.setdefault(node, _Tables(node, {})).keys[name] = key
        self._found = list(found.values())

    def place(self) -> None:
        """Put leaves in place of the tables of BSDFs whose alpha or eta tracks derivatives. Detach sampling weights."""
        for node in self._smooth:
            if (weight := _arrays(node)[-1]) >> 32:  # the upper half of an index is that of its derivative
                made = dr.detach(dr.detail.update_indices(mi.Float(0), [weight]))
                dr.make_opaque(made)
                _put(node, (made,))
        for each in self._found:
            with dr.resume_grad():
                values = {name: entry_value(self.params, key) for name, key in each.keys.items()}
                tracked = [name for name, value in values.items() if dr.grad_enabled(value)]
                each.leaves, each.slopes = (), {}
                if not tracked:
                    continue
                each.leaves = tuple(mi.Float(dr.detach(table)) + dr.opaque(mi.Float, 0) for table in tables(each.node))
                dr.make_opaque(each.leaves)
                dr.enable_grad(each.leaves)
                _put(each.node, each.leaves)
            now = {name: float(value[0]) for name, value in values.items()}
            each.slopes = {name: _slopes(each.node, now, name) for name in tracked}

    def collect(self) -> None:
        """Add the gradient at the tables to the gradient of alpha and eta. Clear the gradient of the tables."""
        for each in self._found:
            gradients = [dr.grad(leaf) for leaf in each.leaves]
            for name, slopes in each.slopes.items():
                parts = [dr.sum(gradient * slope) for gradient, slope in zip(gradients, slopes, strict=True)]
                dr.accum_grad(entry_value(self.params, each.keys[name]), parts[0] + parts[1])
            dr.clear_grad(each.leaves)

    def push(self) -> None:
        """Place the tables, and propagate tangents of alpha and eta to them, for forward mode."""
        self.place()
        for each in self._found:
            for number, leaf in enumerate(each.leaves):
                dr.set_grad(leaf, 0)
                for name, slopes in each.slopes.items():
                    dr.accum_grad(leaf, slopes[number] * dr.grad(entry_value(self.params, each.keys[name])))
                dr.enqueue(dr.ADMode.Forward, leaf)
        if any(each.leaves for each in self._found):
            dr.traverse(dr.ADMode.Forward, dr.ADFlag.ClearEdges)


@contextmanager
def with_tables(params: mi.SceneParameters | None) -> Iterator[None]:
    """Add the part of the gradient of `params` that a step in this context sends to the tables."""
    if params is None:
        yield
        return
    found = PlasticTables(params)
    found.place()
    yield
    found.collect()


def tables(node: mi.BSDF) -> tuple[mi.Float, mi.Float]:
    """Return the current tables T (64,) and r (1,) of a `roughplastic`, which `mi.traverse` does not list."""
    made = dr.detail.update_indices([mi.Float(0), mi.Float(0)], _arrays(node)[-2:])
    return made[0], made[1]


def _put(node: mi.BSDF, arrays: tuple[mi.Float, ...]) -> None:
    """Replace the last arrays of an object."""
    indices = iter([*_arrays(node)[: -len(arrays)], *dr.detail.collect_indices(list(arrays))])
    with dr.scoped_set_flag(dr.JitFlag.EnableObjectTraversal):
        node._traverse_1_cb_rw(lambda *_: next(indices))


def _arrays(node: mi.BSDF) -> list[int]:
    """Return the indices of all arrays of an object. Dr.Jit records launches by this traversal. The tables of a
    `roughplastic`, and the sampling weight of a `plastic`, come last.
    """
    indices: list[int] = []
    with dr.scoped_set_flag(dr.JitFlag.EnableObjectTraversal):
        node._traverse_1_cb_ro(lambda index, *_: indices.append(index))
    return indices


def _slopes(node: mi.BSDF, values: dict[str, float], name: str) -> tuple[mi.Float, mi.Float]:
    """Return the derivatives of the tables by the parameter `name` at `values`."""
    kind = re.search(r"distribution = (\w+)", str(node))
    T, r = _differences(kind[1] if kind else "beckmann", values["alpha"], values["eta"], name)
    slopes = mi.Float(T) + dr.opaque(mi.Float, 0), mi.Float(r) + dr.opaque(mi.Float, 0)
    dr.make_opaque(slopes)
    return slopes


@functools.lru_cache(maxsize=64)
def _differences(distribution: str, alpha: float, eta: float, name: str) -> tuple[Array, Array]:
    at = {"alpha": alpha, "eta": eta}
    step = min(_STEPS[name], alpha / 4 if name == "alpha" else abs(eta - 1) / 8)
    T: Any = 0.0
    r: Any = 0.0
    for place, coefficient in _NODES.items():
        value = at | {name: at[name] + place * step}
        properties = mi.Properties("roughplastic")
        properties["distribution"] = distribution
        properties["alpha"], properties["int_ior"], properties["ext_ior"] = value["alpha"], value["eta"], 1.0
        made = tables(mi.PluginManager.instance().create_object(properties))
        T, r = (
            slope + coefficient / step * np.array(table, np.float64) for slope, table in zip((T, r), made, strict=True)
        )
    return np.asarray(T, np.float32), np.asarray(r, np.float32)
