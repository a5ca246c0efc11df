"""The plan of a step in numbers: how many operations its kernels have with each feature, and how many without."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from reslrb_cli.integrators import light_tracer as lt
from reslrb_cli.integrators.features import FEATURES, Feature
from reslrb_cli.integrators.reslrb import Reslrb
from reslrb_cli.scene.catalog import list_parameters
from reslrb_cli.transport.blocks import film_blocks
from reslrb_cli.transport.guide import even_table
from reslrb_cli.transport.plan import Plan
from reslrb_cli.transport.samples import passes

PATHS = 64  # traced to have kernels compiled
LARGE = 100  # operations; smaller kernels develop images and prepare textures


@dataclass(frozen=True)
class PlanRow:
    """One feature: whether the plan has it and why, and the operations of the step's large kernels with and without it.

    Counts are None where there is none; `note` says why.
    """

    feature: str
    needed: bool
    reason: str
    operations_with: int | None = None
    operations_without: int | None = None
    note: str = ""


@dataclass(frozen=True)
class PlanReport:
    """A plan, feature by feature; `kernels` are the operations of each large kernel of the step as it is."""

    estimator: str
    kernels: list[int] | None
    rows: list[PlanRow]


def report_plan(integrator: Reslrb, scene: mi.Scene, sensor: mi.Sensor, params: mi.SceneParameters,
                keys: Iterable[str], *, known: bool, counts: bool = True, limit_s: float = 20.0
                ) -> PlanReport:  # fmt: skip
    """What a step of `integrator` (`reslrb`) has to do to differentiate the parameters `keys` of `params`.

    `known`: dL/dI is known before the paths are traced. With `counts`, every feature is compiled both ways, until
    `limit_s` seconds have passed.
    """
    keys, start = list(keys), time.perf_counter()
    with tracking(params, keys):
        plan = integrator.plan(scene, sensor, params)
        estimator = type(integrator.estimator).__name__.removesuffix("Estimator").lower()
        if not counts:
            return PlanReport(estimator, None, plan_rows(plan))
        kernels = count(integrator, plan, scene, sensor, known)
    rows = []
    for feature in FEATURES:
        row = _row(feature, plan)
        if time.perf_counter() - start > limit_s:
            rows.append(replace(row, note=f"not counted: {limit_s:.0f} s have passed"))
            continue
        other = _toggled(integrator, feature, plan, scene, sensor, params, keys, known)
        if isinstance(other, str):
            rows.append(replace(row, note=f"cannot be {'left out' if row.needed else 'forced'}: {other}"))
            continue
        here, there = sum(kernels), sum(other)
        both = (here, there) if row.needed else (there, here)
        rows.append(replace(row, operations_with=both[0], operations_without=both[1]))
    return PlanReport(estimator, kernels, rows)


def with_reason(rows: Iterable[PlanRow], feature: str, reason: str) -> list[PlanRow]:
    """The rows with a reason of one's own for a feature; beside that of the plan where it has it."""
    return [
        replace(row, reason=f"{row.reason}; {reason}" if row.needed else reason) if row.feature == feature else row
        for row in rows
    ]


def plan_rows(plan: Plan) -> list[PlanRow]:
    """The features of a plan, without counts."""
    return [_row(feature, plan) for feature in FEATURES]


def count(integrator: Reslrb, plan: Plan, scene: mi.Scene, sensor: mi.Sensor, known: bool) -> list[int]:
    """Operations of each large kernel of a step by this plan."""
    with dr.suspend_grad():
        table = None if plan.grid is None else even_table(plan.grid, film_blocks(sensor) if plan.aimed else None)
        [samples] = passes(plan, scene, sensor, 0, 1, None, table)
        samples = replace(samples, width=PATHS)
        channels = samples.film.film.base_channels_count()
        size = samples.film.size
        gradient = dr.full(mi.TensorXf, 1.0, (int(size.y), int(size.x), int(channels)))
        dr.make_opaque(gradient)
    dr.kernel_history_clear()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True), dr.suspend_grad():
        if known:
            lt.fused([samples], integrator.estimator, gradient)
        else:
            trace = lt.trace_image([samples], integrator.estimator)
            lt.replay_all(trace, integrator.estimator, gradient)
        dr.eval()
        dr.sync_thread()
        history = dr.kernel_history((dr.KernelType.JIT,))
    return [kernel["operation_count"] for kernel in history if kernel["operation_count"] >= LARGE]


@contextmanager
def tracking(params: mi.SceneParameters, keys: Iterable[str]) -> Iterator[None]:
    """Parameters `keys` of the scene track derivatives, for as long as the context lasts."""
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


def _update(params: mi.SceneParameters, keys: Iterable[str]) -> None:
    """Have textures do now what they do when they are first looked up: it is no part of the step."""
    params.update()
    for key in keys:
        node = params.properties[key][2]
        if isinstance(node, mi.Texture):
            node.eval(dr.zeros(mi.SurfaceInteraction3f))
    dr.eval([params[key] for key in keys])


def _row(feature: Feature, plan: Plan) -> PlanRow:
    if not feature.needed(plan):
        return PlanRow(feature.name, False, feature.absent)
    return PlanRow(feature.name, True, feature.present if isinstance(feature.present, str) else feature.present(plan))


def _toggled(integrator: Reslrb, feature: Feature, plan: Plan, scene: mi.Scene, sensor: mi.Sensor,
             params: mi.SceneParameters, keys: list[str], known: bool) -> list[int] | str:  # fmt: skip
    """Kernels of the step with the feature the other way round, or the reason why there are none."""
    toggled = feature.toggle(plan)
    if isinstance(toggled, str):
        return toggled
    if toggled is None:
        infos = [info for info in list_parameters(params) if info.kind == feature.parameters]
        more = [info.key for info in infos if info.obstacle is None and info.key not in keys]
        if not more:
            return f"no {feature.parameters} has a parameter that can be differentiated"
        keys = [*keys, *more]
    with tracking(params, keys):
        if toggled is None:
            toggled = replace(integrator.plan(scene, sensor, params), track_zeros=plan.track_zeros)
        return count(integrator, toggled, scene, sensor, known)
