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
from typing import Any

import drjit as dr

from reslrb_cli.guiding.tables import KNOWN, Guiding
from reslrb_cli.integrators.reslrb import Reslrb
from reslrb_cli.optimization.autotune.race import is_auto
from reslrb_cli.optimization.autotune.sampling import as_decided, with_sides
from reslrb_cli.optimization.decisions import MemoryPlan, Scaled
from reslrb_cli.optimization.memory import in_passes
from reslrb_cli.optimization.optimizers import SUMS
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.records.checkpoint import entries_below
from reslrb_cli.records.decisions import GuidedRecord, PathsRecord, PixelsRecord, SequenceRecord
from reslrb_cli.records.tree import PASSING, Array, Arrays, Stored, entry, expected, like, to_array


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
    says why the run ends with it as finished, and `end` why it fails, "" where it does not. `first_s` is `elapsed_s`
    after the first iteration. `gradients` are those of the step that led to it, as `values` are, for whoever looks at
    them.
    """

    iteration: int
    elapsed_s: float
    peak_mib: float
    standstill: int
    units: dict[str, tuple[float, float]]
    clamp: dict[str, int]
    scaling: list[Scaled] | None = None
    guiding: dict[str, int] | None = None
    stage: int = 0
    drops: int = 0
    since: int = 0
    stopped: str = ""
    first_s: float = 0.0
    values: Arrays = field(default_factory=dict, metadata=entry("parameter"))
    halo: Arrays = field(default_factory=dict, metadata=entry("parameter with halo"))
    moments: Arrays = field(default_factory=dict, metadata=entry("optimizer"))
    clamp_sums: Arrays = field(default_factory=dict, metadata=entry("clamp"))
    learned: Arrays = field(default_factory=dict, metadata=entry("guiding"))
    base: Arrays = field(default_factory=dict, metadata=entry("base"))
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
    for key, (length, _) in told.units.items():
        optimizer.set_variable(key, replace(optimizer.variable(key), length=length))
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
    """What `on_file` made of values, as the optimiser has them; `prefix` is that of their entries."""
    found = {}
    for key in problem.selection.keys:
        now, name, shape = dr.detach(problem.optimizer[key]), f"{prefix}/{key}", problem.selection.array(key).shape
        if math.prod(shape) != math.prod(dr.shape(now)):
            name, shape = f"{prefix} with halo/{key}", tuple(dr.shape(now))
        found[key] = like(now, stored.take(name, expected(shape)).reshape(dr.shape(now)))
    return found


# --- what was settled before the first iteration ----------------------------------------------------------------------


@dataclass(frozen=True)
class Settled:
    """What every process of a run has alike: its settings, in a file's words, and `variant`, the digests of the `files`
    that they name, what was decided by measurement, the parameters' values at the start, and `masks` as a `Problem`
    has them."""

    config: str
    variant: str
    files: dict[str, str] = field(default_factory=dict)
    guided: GuidedRecord | None = None
    sequence: SequenceRecord | None = None
    paths: PathsRecord | None = None
    memory: MemoryPlan | None = None
    initial: Arrays = field(default_factory=dict, metadata=entry("initial"))
    initial_halo: Arrays = field(default_factory=dict, metadata=entry("initial with halo"))
    masks: Arrays = field(default_factory=dict, metadata=entry("mask"))
    pixels: PixelsRecord | None = None
    #: How camera paths are shared out over the pixels, by the number of their sensor, (H, W).
    shares: Arrays = field(default_factory=dict, metadata=entry("pixels"))


def begin_as(problem: Problem, stored: Stored) -> None:
    """Give the parameters the values that the run began with."""
    values = _stored_values(problem, stored, "initial")
    problem.selection.set_arrays({key: problem.selection.shown(key, value) for key, value in values.items()})
    for key, value in values.items():
        problem.optimizer.set_value(key, value)
    problem.apply()


def decide_as(problem: Problem, stored: Stored) -> Problem:
    """Return `problem` with the decisions of the run: the samples of a pass, and how samples are drawn."""
    settled = stored.read(Settled)
    guided = settled.guided if is_auto(problem.config, "guiding") else None
    sequence = settled.sequence if is_auto(problem.config, "sequence") else None
    sides = settled.paths if is_auto(problem.config, "paths") else None
    pixels = settled.pixels if is_auto(problem.config, "pixels") else None
    if problem.memory is not None and settled.memory is not None:
        before = settled.memory  # the passes decide in what order samples are summed up
        plan = MemoryPlan(problem.memory.budget_bytes, before.samples_per_pass, before.passes, before.expected_bytes)
        problem = in_passes(problem, plan)
    integrator = as_decided(with_sides(problem.integrator, sides), guided, sequence)
    if shares := entries_below(stored.arrays, "pixels/"):
        integrator = integrator.shared_out(shares)
    return replace(problem, sides=sides, guided=guided, sequence=sequence, pixels=pixels, integrator=integrator)


def reach_as(problem: Problem, stored: Stored) -> Problem:
    """Take up what light and sensor reach, of the parameters whose true value is known."""
    shapes = {key: problem.selection.array(key).shape for key in problem.truth}
    asked = {key: expected(shape[:2] if len(shape) == 3 else shape) for key, shape in shapes.items()}
    return replace(problem, masks={key: stored.take(f"mask/{key}", mask) for key, mask in asked.items()})
