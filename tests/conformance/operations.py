"""Counts of operations in a step's kernels, for a given plan. They show that kernels lack code that a scene does not
need.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi

from reslrb_cli.guiding.tables import apportion
from reslrb_cli.integrators import reslrb as lt
from reslrb_cli.integrators.reslrb import Reslrb
from reslrb_cli.transport.aim import Aim, Blocks, film_blocks
from reslrb_cli.transport.plan import Grid, Plan
from reslrb_cli.transport.samples import Table, passes

PATHS = 64  # paths that are traced to compile kernels
LARGE = 100  # operations: smaller kernels only develop images or prepare textures


def even_table(grid: Grid, film: Blocks | None = None) -> Table:
    """Return the table of a run that has learned nothing. If `film` is given, paths are aimed at all of the film."""
    aim = None if film is None else Aim.of(film, film.areas())
    return Table.of(grid, apportion(grid, grid.measures()), aim=aim)


def count(integrator: Reslrb, plan: Plan, scene: mi.Scene, sensor: mi.Sensor) -> list[int]:
    """Count the operations of each large kernel of a step with this plan. dL/dI is known before the step."""
    with dr.suspend_grad():
        table = None if plan.grid is None else even_table(plan.grid, film_blocks(sensor) if plan.aimed else None)
        emitters = integrator.preparation.emitters(plan, scene) if plan.weighs else None
        [samples] = passes(plan, scene, sensor, 0, 1, None, table, integrator.light_share, emitters)
        camera = samples.camera and replace(samples.camera, width=PATHS)
        samples = replace(samples, width=PATHS, camera=camera)
        width, height = (int(n) for n in samples.film.size)
        gradient = dr.full(mi.TensorXf, 1.0, (height, width, int(samples.film.film.base_channels_count())))
        dr.make_opaque(gradient)
    dr.kernel_history_clear()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True), dr.suspend_grad():
        lt.fused(integrator.estimator, True, [samples], gradient)
        dr.eval()
        dr.sync_thread()
        history = dr.kernel_history((dr.KernelType.JIT,))
    return [kernel["operation_count"] for kernel in history if kernel["operation_count"] >= LARGE]


@contextmanager
def tracking(params: mi.SceneParameters, keys: Iterable[str]) -> Iterator[None]:
    """Make parameters `keys` of the scene track derivatives within the context."""
    values = {key: type(params[key])(dr.detach(params[key])) for key in keys}
    for key, value in values.items():
        leaf = type(value)(value)
        dr.enable_grad(leaf)
        params[key] = leaf
    _update(params, values)
    try:
        yield
    finally:
        for key, value in values.items():
            params[key] = value
        _update(params, values)


def with_change(plan: Plan, **members: Any) -> Plan:
    """Return the plan with other values of its members, or of the members of its `needs`."""
    needs = {name: value for name, value in members.items() if hasattr(plan.needs, name)}
    own = {name: value for name, value in members.items() if name not in needs}
    return replace(plan, needs=replace(plan.needs, **needs), **own)


def nothing_is_compiled_without(feature: str, scene: Any, ours: Any, plain: Any) -> None:
    """Check that the number of operations of a step depends only on `feature`, and is smaller without `feature`.

    `feature` is a member of the plan. It is None in the plan of `plain`, but not in the plan of `ours`.
    """
    sensor = scene.scene.sensors()[0]
    # In the spectral variant, Dr.Jit's history lacks kernels with derivatives of an environment map.
    keys = [key for key in scene.keys if key != "sky.data"]
    with tracking(scene.params, keys):
        plans = [each.plan(scene.scene, sensor, scene.params) for each in (ours, plain)]
        values = [getattr(plan, feature) for plan in plans]
        assert [value is None for value in values] == [False, True]
        (present, absent), others = [
            [sum(count(each, with_change(plan, **{feature: value}), scene.scene, sensor)) for value in values]
            for each, plan in zip((ours, plain), plans, strict=True)
        ]
    assert [present, absent] == others
    assert absent < present


def _update(params: mi.SceneParameters, keys: Iterable[str]) -> None:
    """Update the parameters and have textures do the work of their first look-up now. The step must not count this
    work.
    """
    params.update()
    for key in keys:
        node = params.properties[key][2]
        if isinstance(node, mi.Texture):
            node.eval(dr.zeros(mi.SurfaceInteraction3f))
    dr.eval([params[key] for key in keys])
