"""State of a run's iterations, and the decisions before the first iteration.

- `State` has everything that determines the next iteration. Equal states lead to equal next states.
- `standing` returns the current state of a problem, and `put` sets a problem to a state.
- `load` reads a stored state if it fits the problem.
- `Settled` has the data common to all processes of a run: initial values, estimator, masks, ways of sampling.
    `begin_as`, `decide_as` and `reach_as` assemble a problem from it.

Dr.Jit and Mitsuba change some data in place: the parameters of the scene, the optimiser's leaves, and the tables of
guided emission. A state determines all data that are changed in place. `put` writes the data of a state.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr

from reslrb_cli.guiding.tables import KNOWN, Guiding
from reslrb_cli.integrators.reslrb import Reslrb
from reslrb_cli.optimization.autotune.sampling import as_decided, blur_decision, decided
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.records.checkpoint import entries_below
from reslrb_cli.records.decisions import Decision, Scaled
from reslrb_cli.records.tree import PASSING, Array, Arrays, Stored, entry, expected, like, to_array


@dataclass(frozen=True)
class State:
    """State at the start of an iteration. For a new run, `standing` without a state returns the initial state.

    - `iteration` is the number of finished iterations. `standstill` counts the latest consecutive iterations in which
        some update was skipped.
    - `peak_mib` is the allocator's peak memory. `scaling` is the result of `scale: curvature`.
    - `gains` has the gain of each parameter's variable (`Variable`). `moments` are the optimiser's
        moments.
    - `guiding` has the gradient count of guided emission for each sensor. `learned` has the arrays of guided emission,
        named `<sensor>/<what>`.
    - `values` are the scene's, in the optimiser's form. A file has their displayed form. In a file, `halo` has the
        complete arrays of parameters whose displayed form lacks data.
    - `stopped` is the reason why the run ends as finished. `end` is the reason why the run fails. Without a reason, the
        field is "".
    - `first_s` is `elapsed_s` after the first iteration.
    - `level` is the loss at which the moments were last zero, above that of the targets, or 0 if the first loss was not
        large (`loop.step`).
    - `gradients` are the gradients of the previous step, in the form of `values`.
    """

    iteration: int
    elapsed_s: float
    peak_mib: float
    standstill: int
    gains: dict[str, float]
    scaling: list[Scaled] | None = None
    guiding: dict[str, int] | None = None
    stopped: str = ""
    first_s: float = 0.0
    level: float = 0.0
    values: Arrays = field(default_factory=dict, metadata=entry("parameter"))
    halo: Arrays = field(default_factory=dict, metadata=entry("parameter with halo"))
    moments: Arrays = field(default_factory=dict, metadata=entry("optimizer"))
    learned: Arrays = field(default_factory=dict, metadata=entry("guiding"))
    end: str = field(default="", metadata=PASSING)
    gradients: dict[str, Any] = field(default_factory=dict, metadata=PASSING)

    def on_file(self, problem: Problem) -> State:
        """Return the state with the values in their displayed form, for a file."""
        values, halo = on_file(problem, self.values)
        return replace(self, values=values, halo=halo)


def standing(problem: Problem, state: State | None = None) -> State:
    """Return the current state of `problem`. Plain values come from `state`. Without `state`, the result precedes the
    first iteration.

    The function copies nothing, because no iteration changes the arrays of an earlier iteration.
    """
    state = State(0, 0.0, 0.0, 0, {}) if state is None else state
    optimizer, guiding = problem.optimizer, guiding_of(problem)
    calls, learned = (None, {}) if guiding is None else guiding.state()
    values = {key: dr.detach(optimizer[key]) for key in optimizer.keys()}  # noqa: SIM118 (not a mapping)
    moments = optimizer.moments()
    found = replace(state, values=values, gains=optimizer.gains(), moments=moments, guiding=calls, learned=learned)
    optimizer.stands_at = found
    return found


def put(problem: Problem, state: State) -> str | None:
    """Set optimiser, guided emission and scene to `state`. Returns the name of a table that does not fit
    (`restore_tables`).
    """
    problem.optimizer.restore(state.values, state.gains, state.moments)
    wrong = restore_tables(problem, state.guiding or {}, state.learned)
    problem.apply()
    problem.optimizer.stands_at = state
    return wrong


def load(problem: Problem, stored: Stored) -> State:
    """Set `problem` to the stored state and return the state. Raises ConfigError if the state belongs to another
    experiment.
    """
    told, optimizer = stored.read(State), problem.optimizer
    for key, gain in told.gains.items():
        optimizer.set_variable(key, replace(optimizer.variable(key), gain=gain))
    learned = dict.fromkeys(f"{number}/{name}" for number in told.guiding or () for name in KNOWN)
    values = _stored_values(problem, stored, "parameter")
    asked = replace(told, moments=optimizer.moments(), learned=learned)
    state = replace(stored.fill(asked), values=values)
    wrong = put(problem, state)
    if wrong is not None:
        raise stored.wrong(wrong, "does not match the learned tables of this scene")
    return state


def guiding_of(problem: Problem) -> Guiding | None:
    """Return the tables of guided emission of the run's integrator, or None."""
    return problem.integrator.preparation.guiding if isinstance(problem.integrator, Reslrb) else None


@contextmanager
def held_tables(problem: Problem) -> Iterator[None]:
    """Keep the tables of guided emission from learning, so that equal seeds give equal samples."""
    guiding = guiding_of(problem)
    before = guiding is not None and guiding.held
    if guiding is not None:
        guiding.held = True
    try:
        yield
    finally:
        if guiding is not None:
            guiding.held = before


def noted_of(problem: Problem) -> dict[str, Array]:
    """Return the recorded pixel densities (H, W) of camera paths, for each sensor number.

    The recorded densities are the argument of `LightTracer.shared_out`.
    """
    given = problem.integrator.preparation.sampling.given if isinstance(problem.integrator, Reslrb) else {}
    return {str(number): density for number, density in given.items()}


def restore_tables(problem: Problem, calls: Mapping[str, int], learned: Mapping[str, Array]) -> str | None:
    """Restore the tables of the run's integrator from stored data (`State`), if the integrator has tables.

    If an array does not fit this scene, the function returns the array's name and changes nothing.
    """
    guiding = guiding_of(problem)
    if guiding is None:
        return None
    sensors = {str(number) for number in range(len(problem.scene.sensors()))}
    if not set(calls) <= sensors or {f"{number}/{name}" for number in calls for name in KNOWN} != set(learned):
        return "guiding"
    problem.integrator.plan(problem.scene, problem.scene.sensors()[problem.sensors[0]])  # creates the grid
    wrong = guiding.restore(calls, learned.__getitem__)
    return None if wrong is None else f"guiding/{wrong}"


# --- values of parameters in files ------------------------------------------------------------------------------------


def on_file(problem: Problem, values: Mapping[str, Any]) -> tuple[dict[str, Array], dict[str, Array]]:
    """Convert values of parameters from the optimiser's form to their displayed form.

    Also returns the complete arrays of the parameters that lose data in the conversion. For example, an environment map
    loses its halo.
    """
    shown = {key: problem.selection.shown(key, value) for key, value in values.items()}
    return shown, {key: own for key, value in values.items() if (own := to_array(value)).size != shown[key].size}


def _stored_values(problem: Problem, stored: Stored, prefix: str) -> dict[str, Any]:
    """Return the values of a stored `on_file` result in the optimiser's form. `prefix` is the prefix of their names."""
    found = {}
    for key in problem.selection.keys:
        now, name, shape = dr.detach(problem.optimizer[key]), f"{prefix}/{key}", problem.selection.array(key).shape
        if math.prod(shape) != math.prod(dr.shape(now)):
            name, shape = f"{prefix} with halo/{key}", tuple(dr.shape(now))
        found[key] = like(now, stored.take(name, expected(shape)).reshape(dr.shape(now)))
    return found


# --- decisions before the first iteration -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Settled:
    """Data common to all processes of a run.

    `Settled` has the settings in the form of a file, `variant`, and the digests of the `files`. `Settled` also has the
    `decisions`, the parameters' initial values, and the `masks` of a `Problem`.
    """

    config: str
    variant: str
    files: dict[str, str] = field(default_factory=dict)
    decisions: list[Decision] = field(default_factory=list)
    initial: Arrays = field(default_factory=dict, metadata=entry("initial"))
    initial_halo: Arrays = field(default_factory=dict, metadata=entry("initial with halo"))
    masks: Arrays = field(default_factory=dict, metadata=entry("mask"))
    #: Distribution of camera paths over the pixels (H, W), by the number of the sensor.
    shares: Arrays = field(default_factory=dict, metadata=entry("pixels"))


def begin_as(problem: Problem, stored: Stored) -> None:
    """Set the parameters to the initial values of the run."""
    values = _stored_values(problem, stored, "initial")
    problem.selection.set_arrays({key: problem.selection.shown(key, value) for key, value in values.items()})
    for key, value in values.items():
        problem.optimizer.set_value(key, value)
    problem.apply()


def decide_as(problem: Problem, stored: Stored) -> Problem:
    """Return `problem` with the run's decisions about the sampling methods."""
    settled = stored.read(Settled)
    try:
        decisions = decided(problem.config, settled.decisions)
    except TypeError as error:
        raise stored.wrong("decisions", str(error)) from None
    integrator = as_decided(problem.integrator, decisions)
    if shares := entries_below(stored.arrays, "pixels/"):
        integrator = integrator.shared_out(shares)
    return replace(problem, decisions=[*blur_decision(problem), *decisions], integrator=integrator)


def reach_as(problem: Problem, stored: Stored) -> Problem:
    """Restore the masks for parameters with known true values. A mask marks the entries that light and sensor reach."""
    shapes = {key: problem.selection.array(key).shape for key in problem.truth}
    asked = {key: expected(shape[:2] if len(shape) == 3 else shape) for key, shape in shapes.items()}
    return replace(problem, masks={key: stored.take(f"mask/{key}", mask) for key, mask in asked.items()})
