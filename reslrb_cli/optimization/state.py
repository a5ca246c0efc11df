"""The state of a run's iterations, all that one of them hands on to the next, and what was settled before the first.

- `State`: the tree; nothing else decides what the next iteration does: from equal states equal ones follow.
- `standing`, `put`: the state at which a problem stands, and a problem brought to a state.
- `load`: the state that was stored, where it fits the problem.
- `Settled`: what every process of a run has alike: where it began, estimator, passes, masks, how samples are drawn;
  with `begin_as`, `decide_as` and `reach_as`, by which a problem is assembled again.

Outside of a `State` is what Dr.Jit and Mitsuba change in place: the parameters of the scene, the optimiser's leaves,
which receive gradients, and the tables of guided emission. They follow from a state, and `put` writes them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any

import drjit as dr
import numpy as np
from pydantic import Field

from reslrb_cli.config.files import CONFIG_BYTES
from reslrb_cli.guiding.tables import KNOWN, Guiding
from reslrb_cli.integrators.reslrb import Reslrb
from reslrb_cli.optimization.autotune.sampling import as_decided, decided
from reslrb_cli.optimization.memory import in_passes
from reslrb_cli.optimization.optimizers import SUMS
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.records.decisions import Decision, MemoryPlan, Scaled
from reslrb_cli.records.tree import PASSING, Array, Arrays, Stored, entry, expected, like, to_array

Count = Annotated[int, Field(ge=0, lt=2**31)]
FromOne = Annotated[int, Field(ge=1, lt=2**31)]
Number = Annotated[float, Field(ge=0, lt=1e300)]
Positive = Annotated[float, Field(gt=0, lt=1e300)]


@dataclass(frozen=True)
class State:
    """What an iteration begins with; of a run before its first, with `standing`, the default.

    `iteration` is the number of those done, and `standstill` of those in a row, up to the last, in which something sat
    out; `peak_mib` is the allocator's high-water mark, `scaling` what `scale: auto` has measured. By parameter: `units`
    are length and gain of what is moved in its place (`Variable`), where anything is, `clamp` the iterations that the
    clamp knows; `moments` are the optimiser's and `clamp_sums` the clamp's. `guiding` are the gradients that guided
    emission had by sensor, `learned` its arrays by `<sensor>/<what>`. `values` are the scene's, as the optimiser has
    them; in a file as they are shown, and as `halo` where that is less. `stage` is the number of the stage whose
    problem it is a state of, and `base` the run's values when that began, of one with a problem of its own (`stages`).
    `drops` are those of a rate that a plateau has lowered, `since` the iterations before the last of them; `stopped`
    says why the run ends with it as finished, and `end` why it fails, "" where it does not. `gradients` are those of
    the step that led to it, as `values` are, for whoever looks at them.
    """

    iteration: Count
    elapsed_s: Number
    peak_mib: Number
    standstill: Count
    units: dict[str, tuple[Positive, Positive]]
    clamp: dict[str, FromOne]
    scaling: list[Scaled] | None = None
    guiding: dict[str, Count] | None = None
    stage: Count = 0
    drops: Count = 0
    since: Count = 0
    stopped: str = ""
    values: Arrays = field(default_factory=dict, metadata=entry("parameter", "finite"))
    halo: Arrays = field(default_factory=dict, metadata=entry("parameter with halo", "finite"))
    moments: Arrays = field(default_factory=dict, metadata=entry("optimizer"))
    clamp_sums: Arrays = field(default_factory=dict, metadata=entry("clamp"))
    learned: Arrays = field(default_factory=dict, metadata=entry("guiding", "finite"))
    base: Arrays = field(default_factory=dict, metadata=entry("base", "finite"))
    end: str = field(default="", metadata=PASSING)
    gradients: dict[str, Any] = field(default_factory=dict, metadata=PASSING)

    def on_file(self, problem: Problem) -> State:
        """The same with the values as a file has them."""
        values, halo = on_file(problem, self.values)
        return replace(self, values=values, halo=halo)


def standing(problem: Problem, state: State | None = None) -> State:
    """The state at which `problem` stands now, with the plain values of `state`; without one it has done nothing.

    It costs nothing, since no iteration changes the arrays of one before it.
    """
    state = State(0, 0.0, 0.0, 0, {}, {}, stage=len(problem.config.run.stages)) if state is None else state
    optimizer, guiding = problem.optimizer, guiding_of(problem)
    calls, learned = (None, {}) if guiding is None else guiding.state()
    values = {key: dr.detach(optimizer[key]) for key in optimizer.keys()}  # noqa: SIM118 (not a mapping)
    moments = optimizer.moments()
    found = replace(state, values=values, units=optimizer.units(), moments=moments, guiding=calls, learned=learned)
    optimizer.stands_at = found
    return found


def put(problem: Problem, state: State) -> str | None:
    """Bring optimiser, guided emission and scene to `state`; what was not learned of this scene (`restore_tables`)."""
    problem.optimizer.restore(state.values, state.units, state.moments)
    wrong = restore_tables(problem, state.guiding or {}, state.learned)
    problem.apply()
    problem.optimizer.stands_at = state
    return wrong


def load(problem: Problem, stored: Stored, whole: Problem) -> State:
    """The state that was stored, to which `problem`, that of its stage, is brought; `whole` is the run's own.

    Raises ConfigError where it is another experiment's.
    """
    told, optimizer, keys = stored.read(State), problem.optimizer, problem.selection.keys
    for name, found in (("units", told.units), ("clamp", told.clamp)):
        for key in found:
            if key not in keys:
                raise stored.wrong(f"{name}.{key}", "is of a parameter that the run does not have")
    if told.scaling is not None and [row.key for row in told.scaling] != list(keys):
        raise stored.wrong("scaling", "does not have the run's parameters")
    for key in keys:
        if key in told.units:
            optimizer.set_variable(key, replace(optimizer.variable(key), length=told.units[key][0]))
        elif key in optimizer.units():
            raise stored.wrong(f"units.{key}", "is missing")
    if guiding_of(problem) is not None and told.guiding is None:
        raise stored.wrong("guiding", "is missing")
    learned = dict.fromkeys(f"{number}/{name}" for number in told.guiding or () for name in KNOWN)
    sums = {key: dict.fromkeys(SUMS, dr.detach(optimizer[key])) for key in told.clamp}
    values = _stored_values(problem, stored, "parameter")
    base = {} if problem.scene is whole.scene else {key: expected(whole.selection.array(key).shape) for key in keys}
    asked = replace(told, base=base, moments=optimizer.moments(), clamp_sums=sums, learned=learned)
    state = replace(stored.fill(asked), values=values)
    wrong = put(problem, state)
    if wrong is not None:
        raise stored.wrong(wrong, "is not what was learned of this scene")
    return state


def guiding_of(problem: Problem) -> Guiding | None:
    """What the run's integrator has learned of where light paths are to start; None where it does not."""
    return problem.integrator.preparation.guiding if isinstance(problem.integrator, Reslrb) else None


def noted_of(problem: Problem) -> dict[str, Array]:
    """How the run's camera paths are shared out over the pixels, by the number of their sensor, (H, W), where that was
    noted before the first iteration; as `LightTracer.shared_out` takes it."""
    given = problem.integrator.preparation.given if isinstance(problem.integrator, Reslrb) else {}
    return {str(number): density for number, density in given.items()}


def restore_tables(problem: Problem, calls: Mapping[str, int], learned: Mapping[str, Array]) -> str | None:
    """Have the tables of the run's integrator, where it has any, go on from what is stored (`State`).

    Returns the name of what is not of this scene, and then nothing has changed.
    """
    guiding = guiding_of(problem)
    if guiding is None:
        return None
    sensors = {str(number) for number in range(len(problem.scene.sensors()))}
    if not set(calls) <= sensors or {f"{number}/{name}" for number in calls for name in KNOWN} != set(learned):
        return "guiding"
    problem.integrator.plan(problem.scene, problem.scene.sensors()[problem.sensors[0]])  # makes the grid
    wrong = guiding.restore(calls, learned.__getitem__)
    return None if wrong is None else f"guiding/{wrong}"


# --- values of parameters in files ------------------------------------------------------------------------------------


def on_file(problem: Problem, values: Mapping[str, Any]) -> tuple[dict[str, Array], dict[str, Array]]:
    """Values of parameters, as the optimiser has them, as they are shown, and those of which that is not all: of an
    environment map, whose halo it leaves out."""
    shown = {key: problem.selection.shown(key, value) for key, value in values.items()}
    return shown, {key: own for key, value in values.items() if (own := to_array(value)).size != shown[key].size}


def _stored_values(problem: Problem, stored: Stored, prefix: str) -> dict[str, Any]:
    """What `on_file` made of values, as the optimiser has them; `prefix` is that of their entries.

    Raises ConfigError for one that is out of its bounds.
    """
    found = {}
    for key in problem.selection.keys:
        now, name, shape = dr.detach(problem.optimizer[key]), f"{prefix}/{key}", problem.selection.array(key).shape
        if math.prod(shape) != math.prod(dr.shape(now)):
            name, shape = f"{prefix} with halo/{key}", tuple(dr.shape(now))
        array = stored.take(name, expected(shape), "finite")
        check_bounds(problem, stored, name, key, array)
        found[key] = like(now, array.reshape(dr.shape(now)))
    return found


def check_bounds(problem: Problem, stored: Stored, name: str, key: str, array: Array) -> None:
    """Raise ConfigError where an entry of the value `name` of the parameter `key` is none that a run comes to.

    A run goes on with the bounds that it began with, and each of its updates ends within them: what lies outside was
    not written by it. (Bounds cannot change: `runs.prepare.changes`.)
    """
    spec = problem.selection.spec(key)
    low, high = spec.bounds or (-math.inf, math.inf)
    if spec.transform in ("log", "softplus"):
        low = max(low, np.finfo(np.float32).tiny)  # these yield nothing else
    outside = (array < np.float32(low)) | (array > np.float32(high))
    if outside.any():
        raise stored.wrong(name, f"holds {array[outside].flat[0]:g}, outside of {low:g} to {high:g}, its bounds")


# --- what was settled before the first iteration ----------------------------------------------------------------------


@dataclass(frozen=True)
class Settled:
    """What every process of a run has alike: its settings, in a file's words, and `variant`, the digests of the `files`
    that they name, `decisions`, the parameters' values at the start, and `masks` as a `Problem` has them."""

    #: With every default written out, so that it is longer than a file may be.
    config: Annotated[str, Field(max_length=4 * CONFIG_BYTES)]
    variant: str
    files: dict[str, str] = field(default_factory=dict)
    decisions: list[Decision] = field(default_factory=list)
    memory: MemoryPlan | None = None
    initial: Arrays = field(default_factory=dict, metadata=entry("initial", "finite"))
    initial_halo: Arrays = field(default_factory=dict, metadata=entry("initial with halo", "finite"))
    masks: Arrays = field(default_factory=dict, metadata=entry("mask"))
    #: How camera paths are shared out over the pixels, by the number of their sensor, (H, W).
    shares: Arrays = field(default_factory=dict, metadata=entry("pixels", "finite"))


def begin_as(problem: Problem, stored: Stored) -> None:
    """Give the parameters the values that the run began with."""
    keys = problem.selection.keys
    found = [name for name in stored.archive.names("parameter/") if name not in keys]
    if found:
        raise stored.wrong(f"parameter/{found[0]}", "is no parameter of this run")
    values = _stored_values(problem, stored, "initial")
    problem.selection.set_arrays({key: problem.selection.shown(key, value) for key, value in values.items()})
    for key in keys:
        problem.optimizer.set_value(key, values[key])
    problem.apply()


def decide_as(problem: Problem, stored: Stored) -> Problem:
    """Return `problem` with the decisions of the run: the samples of a pass, and how samples are drawn."""
    settled = stored.read(Settled)
    decisions = decided(problem.config, settled.decisions)
    if problem.memory is not None:
        problem = in_passes(problem, _as_planned(stored, settled.memory, problem.memory))
    integrator = as_decided(problem.integrator, decisions)
    if names := stored.archive.names("pixels/"):
        films = {str(k): sensor.film().crop_size() for k, sensor in enumerate(problem.scene.sensors())}
        for name in names:
            if name not in films:
                raise stored.wrong(f"pixels/{name}", "is of a sensor that the scene does not have")
        sizes = {name: expected((int(films[name][1]), int(films[name][0]))) for name in names}
        integrator = integrator.shared_out(
            {name: stored.take(f"pixels/{name}", size, "finite") for name, size in sizes.items()}
        )
    return replace(problem, decisions=decisions, integrator=integrator)


def _as_planned(stored: Stored, before: MemoryPlan | None, now: MemoryPlan) -> MemoryPlan:
    """The plan of the run, whose passes decide in what order samples are summed up."""
    if before is None:
        raise stored.wrong("memory", "is missing")
    size, passes = before.samples_per_pass, before.passes
    if min(size, passes) < 1 or size * passes != now.samples_per_pass * now.passes:
        raise stored.wrong("memory", f"has {passes} passes of {size} samples")
    return MemoryPlan(now.budget_bytes, size, passes, before.expected_bytes)


def reach_as(problem: Problem, stored: Stored) -> Problem:
    """Take up what light and sensor reach, of the parameters whose true value is known."""
    shapes = {key: problem.selection.array(key).shape for key in problem.truth}
    asked = {key: expected(shape[:2] if len(shape) == 3 else shape, bool) for key, shape in shapes.items()}
    return replace(problem, masks={key: stored.take(f"mask/{key}", mask) for key, mask in asked.items()})
