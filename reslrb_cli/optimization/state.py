"""The state of a run's iterations, all that one of them hands on to the next; stored, read strictly, and restored.

It is this: the values of the parameters; of the optimiser its moments, and of each parameter what is moved in its
place, with its unit and gain (transforms, `scale: auto`); what the clamp knows of gradients; how long something has not
been finite; what guided emission has learned; the number of iterations done, from which seeds, views and the schedule's
factor follow; the clock and the memory's peak. Nothing else decides what the next iteration does: from equal states
equal ones follow.

- `to_array`, `like`: values of the optimisation as NumPy arrays, and back, bit by bit.
- `Stored`: a state that was stored, read strictly: each value is of the kind, the shape and the range that a run can
  have.
- `State`, and `Snapshot`, which is one at a moment.
- `Settled`: what an earlier process has settled for a run: where it began, estimator, passes, masks, how samples are
  drawn.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Generic, TypeVar

import drjit as dr
import numpy as np
from pydantic import Field, TypeAdapter, ValidationError

from reslrb_cli.backend.memory import own_memory
from reslrb_cli.errors import ConfigError
from reslrb_cli.guiding.tables import Guiding
from reslrb_cli.integrators.reslrb import Reslrb
from reslrb_cli.optimization.autotune.estimators import Candidate
from reslrb_cli.optimization.autotune.race import is_auto
from reslrb_cli.optimization.autotune.sampling import as_decided, with_sides
from reslrb_cli.optimization.decisions import MemoryPlan, Scaled
from reslrb_cli.optimization.nonfinite import NonFinitePolicy
from reslrb_cli.optimization.optimizers import GradientClamp
from reslrb_cli.records.checkpoint import Archive
from reslrb_cli.records.clock import StepClock
from reslrb_cli.records.decisions import EstimatorRecord, Finding, GuidedRecord, PathsRecord, SequenceRecord

if TYPE_CHECKING:
    from reslrb_cli.optimization.problem import Problem


Array = np.ndarray[Any, Any]


def to_array(value: Any) -> Array:
    """A Dr.Jit value, of any type, without derivatives; a number for one that is one."""
    return np.array(dr.detach(value) if dr.is_array_v(value) else value)


def like(value: Any, array: Array) -> Any:
    """`array` as a value of the type of `value`, in Dr.Jit's own memory.

    `value` and `array` have one shape (`to_array`). A number that was part of a kernel's code (a literal, as Adam's
    count of steps) is so again, so that the same kernel results.
    """
    kind = type(value)
    if not dr.is_array_v(value):
        return kind(array)
    if dr.depth_v(kind) == 1 and not dr.is_tensor_v(kind):
        if value.state == dr.VarState.Literal:
            return kind(array.ravel()[0].item())
        return own_memory(kind, array)
    if dr.is_tensor_v(kind):
        return kind(own_memory(dr.array_t(kind), array.ravel()), tuple(array.shape))
    parts = [like(part, np.ascontiguousarray(each)) for part, each in zip(value, array, strict=True)]
    return kind(*parts)


T = TypeVar("T")
_TYPES = {dr.VarType.Float32: "float32", dr.VarType.Float64: "float64", dr.VarType.UInt32: "uint32"}


@dataclass(frozen=True)
class Kind(Generic[T]):
    """What a plain value is, and what is said of one that is not so."""

    adapter: TypeAdapter[T]
    words: str


Positive = Annotated[float, Field(gt=0, lt=1e300)]
COUNT = Kind[int](TypeAdapter(Annotated[int, Field(ge=0, lt=2**31)]), "is no count")
FROM_ONE = Kind[int](TypeAdapter(Annotated[int, Field(ge=1, lt=2**31)]), "is no count")
NUMBER = Kind[float](TypeAdapter(Annotated[float, Field(ge=0, lt=1e300)]), "is no number")
#: With None for what was not finite.
NUMBERS = Kind[list[float | None]](TypeAdapter(list[Annotated[float, Field(lt=1e300)] | None]), "is no list of numbers")
PAIR = Kind[list[float]](
    TypeAdapter(Annotated[list[Positive], Field(min_length=2, max_length=2)]), "is no pair of positive numbers"
)
TEXT, TEXTS = Kind[str](TypeAdapter(str), "is no text"), Kind[list[str]](TypeAdapter(list[str]), "is no list of texts")
MAPPING = Kind[dict[str, Any]](TypeAdapter(dict[str, Any]), "is no mapping")


class Stored:
    """The arrays of an archive and the JSON beside them. Whatever asks for what is not so raises ConfigError, located
    in the file and by the name of the value."""

    def __init__(self, archive: Archive, values: Mapping[str, Any]) -> None:
        self.archive, self._values = archive, values

    @property
    def path(self) -> Path:
        """The file."""
        return self.archive.path

    def wrong(self, name: str, message: str) -> ConfigError:
        """The error for a value."""
        return ConfigError(self.path, name, f"{message}: not as a run writes it")

    # --- arrays -------------------------------------------------------------------------------------------------------

    def take(self, name: str, other: T) -> T:
        """The array of a name, of the type and shape of `other`; what is added up may be infinite, never NaN."""
        wanted = np.dtype(_TYPES[dr.type_v(other)])
        head = self.archive.heads.get(name)
        if head is not None and head.dtype != wanted:
            raise self.wrong(name, f"is {head.dtype} in place of {wanted}")
        result: T = like(other, self.archive.array(name, tuple(dr.shape(other)), values="no NaN"))
        return result

    def scene_value(self, problem: Problem, prefix: str, key: str) -> Any:
        """The value of the parameter `key` that is stored as `<prefix>/<key>`, finite and within its bounds, as the
        optimiser has it."""
        now = dr.detach(problem.optimizer[key])
        name, shape = f"{prefix}/{key}", problem.selection.array(key).shape
        if math.prod(shape) != math.prod(dr.shape(now)):  # an environment map, whose halo the value does not show
            name, shape = f"{prefix} with halo/{key}", tuple(dr.shape(now))
        array = self.archive.array(name, shape, "f")
        if array.dtype != np.float32:
            raise self.wrong(name, f"is {array.dtype} in place of float32")
        self.check_bounds(problem, name, key, array)
        return like(now, array.reshape(dr.shape(now)))

    def check_bounds(self, problem: Problem, name: str, key: str, array: Array) -> None:
        """Raise ConfigError where an entry of the value `name` of the parameter `key` is none that a run comes to.

        A run goes on with the bounds that it began with, and each of its updates ends within them: what lies outside
        was not written by it. (Bounds cannot change: `runs.prepare.changes`.)
        """
        spec = problem.selection.spec(key)
        low, high = spec.bounds or (-math.inf, math.inf)
        if spec.transform in ("log", "softplus"):
            low = max(low, np.finfo(np.float32).tiny)  # these yield nothing else
        outside = (array < np.float32(low)) | (array > np.float32(high))
        if outside.any():
            raise self.wrong(name, f"holds {array[outside].flat[0]:g}, outside of {low:g} to {high:g}, its bounds")

    # --- plain values -------------------------------------------------------------------------------------------------

    def value(self, *path: str) -> Any:
        """What stands at a place of the JSON; None where nothing does."""
        at: Any = self._values
        for part in path:
            at = at.get(part) if isinstance(at, dict) else None
        return at

    def read(self, kind: Kind[T], *path: str) -> T:
        """What stands at a place of the JSON, of a kind."""
        try:
            return kind.adapter.validate_python(self.value(*path), strict=True)
        except ValidationError:
            raise self.wrong(".".join(path), kind.words) from None

    def keys_of(self, name: str, known: Mapping[str, Any]) -> list[str]:
        """The keys of a mapping, all of which are known."""
        mapping = self.read(MAPPING, name)
        found = list(mapping)
        foreign = [key for key in found if key not in known]
        if foreign:
            raise self.wrong(f"{name}.{foreign[0]}", "is of a parameter that the run does not have")
        return found

    def scaling(self, keys: Sequence[str]) -> list[Scaled] | None:
        """What `scale: auto` measured of each parameter; None where it has not."""
        rows = self.value("scaling")
        if rows is None:
            return None
        if not isinstance(rows, list) or [isinstance(row, dict) and row.get("key") for row in rows] != list(keys):
            raise self.wrong("scaling", "does not have the run's parameters")
        found = []
        for row in rows:
            try:
                found.append(Scaled.from_json(row))
            except TypeError:
                raise self.wrong("scaling", f"of {row['key']} is not what is measured") from None
        return found


def stored_value(problem: Problem, prefix: str, key: str, value: Any) -> dict[str, Array]:
    """The arrays that `scene_value` reads, of a value as the optimiser has it."""
    shown: Array = problem.selection.shown(key, value)
    own = to_array(value)
    arrays = {f"{prefix}/{key}": shown}
    return arrays if own.size == shown.size else arrays | {f"{prefix} with halo/{key}": own}


@dataclass
class State:
    """What the iterations of `problem` go on from; a new one is that of a run before its first.

    `iteration` is the number of those done, `sensitivities` are what `scale: auto` has measured, `peak_mib` is the
    allocator's high-water mark. The parameters and what moves them are the problem's optimiser's.
    """

    problem: Problem
    iteration: int = 0
    sensitivities: list[Scaled] | None = None
    peak_mib: float = 0.0
    clock: StepClock = field(default_factory=StepClock)
    policy: NonFinitePolicy = field(init=False)
    clamp: GradientClamp | None = field(init=False)

    def __post_init__(self) -> None:
        config = self.problem.config
        limit = config.optimizer.clamp_gradient
        self.policy = NonFinitePolicy(config.run.on_nonfinite)
        self.clamp = None if limit is None else GradientClamp(limit)

    def capture(self) -> Snapshot:
        """The state as it is now; costs nothing, since no iteration changes the arrays of one before it."""
        problem = self.problem
        optimizer = problem.optimizer
        arrays = {f"optimizer/{name}": value for name, value in optimizer.state().items() if dr.is_array_v(value)}
        counts: dict[str, int] = {}
        if self.clamp is not None:
            counts, sums = self.clamp.state()
            arrays |= {f"clamp/{name}": value for name, value in sums.items()}
        variables = [optimizer.variable(key) for key in optimizer.keys()]  # noqa: SIM118 (not a mapping)
        units = {
            key: [variable.length, variable.gain]
            for key, variable in zip(optimizer.keys(), variables, strict=True)
            if f"optimizer/{key}/variable" in arrays
        }
        guiding = guiding_of(problem)
        gradients, heard = ({}, {}) if guiding is None else guiding.state()
        arrays |= {f"guiding/{name}": value for name, value in heard.items()}
        values = {
            "elapsed_s": self.clock.elapsed_s,
            "peak_mib": self.peak_mib,
            "standstill": self.policy.standstill,
            "clamp": counts,
            "units": units,
            "scaling": None if self.sensitivities is None else [row.to_json() for row in self.sensitivities],
        }
        if guiding is not None:
            values["guiding"] = gradients
        moved = {key: dr.detach(optimizer[key]) for key in optimizer.keys()}  # noqa: SIM118 (not a mapping)
        return Snapshot(self.iteration, moved, arrays, values)

    def restore(self, stored: Stored) -> None:
        """Go on from what a snapshot of the same experiment left. Raises ConfigError where `stored` holds another."""
        problem, optimizer = self.problem, self.problem.optimizer
        values = {key: stored.scene_value(problem, "parameter", key) for key in problem.selection.keys}
        pairs = {key: stored.read(PAIR, "units", key) for key in stored.keys_of("units", values)}
        units = {key: (length, gain) for key, (length, gain) in pairs.items()}
        for key in values:
            if optimizer.is_moved_apart(key) and key not in units:
                raise stored.wrong(f"units.{key}", "is missing")
        optimizer.restore(values, units, lambda name, like: stored.take(f"optimizer/{name}", like))
        counts = {key: stored.read(FROM_ONE, "clamp", key) for key in stored.keys_of("clamp", values)}
        if self.clamp is not None:
            self.clamp.restore(counts, values, lambda name, like: stored.take(f"clamp/{name}", like))
        self.iteration = stored.read(COUNT, "iteration")
        self.clock.elapsed_s, self.peak_mib = stored.read(NUMBER, "elapsed_s"), stored.read(NUMBER, "peak_mib")
        self.policy.standstill = stored.read(COUNT, "standstill")
        guiding = guiding_of(problem)
        if guiding is not None:
            _restore_guiding(problem, guiding, stored)
        self.sensitivities = stored.scaling(list(values))
        problem.apply()


def guiding_of(problem: Problem) -> Guiding | None:
    """What the run's integrator has learned of where light paths are to start; None where it does not."""
    return problem.integrator.preparation.guiding if isinstance(problem.integrator, Reslrb) else None


def restore_tables(
    problem: Problem, guiding: Guiding, calls: Mapping[str, int], take: Callable[[str], Array]
) -> str | None:
    """Have the tables of the run's integrator go on from what is stored, as `Guiding.restore` does."""
    problem.integrator.plan(problem.scene, problem.scene.sensors()[problem.sensors[0]])  # makes the grid
    return guiding.restore(calls, take)


def _restore_guiding(problem: Problem, guiding: Guiding, stored: Stored) -> None:
    names = [str(number) for number in range(len(problem.scene.sensors()))]
    gradients = stored.value("guiding")
    if not isinstance(gradients, dict) or not all(name in names for name in gradients):
        raise stored.wrong("guiding", "does not have the gradients of sensors by their numbers")
    counts = {name: stored.read(COUNT, "guiding", name) for name in gradients}
    wrong = restore_tables(problem, guiding, counts, lambda name: stored.archive.array(f"guiding/{name}", kind="f"))
    if wrong is not None:
        raise stored.wrong(f"guiding/{wrong}", "is not what was learned of this scene")


@dataclass(frozen=True)
class Snapshot:
    """A state at one moment: iterations done, the scene's values and other arrays by name, and plain values."""

    iteration: int
    moved: dict[str, Any]
    arrays: dict[str, Any]
    values: dict[str, Any]

    def parameters(self, problem: Problem) -> dict[str, Array]:
        """The parameters' values, as `problem.values()` has them."""
        return {key: problem.selection.shown(key, value) for key, value in self.moved.items()}

    def others(self, problem: Problem) -> dict[str, Array]:
        """All other arrays, those of `parameters` left out."""
        found = {name: to_array(value) for name, value in self.arrays.items()}
        for key, value in self.moved.items():
            stored = stored_value(problem, "parameter", key, value)
            found |= {name: array for name, array in stored.items() if name != f"parameter/{key}"}
        return found


Found = TypeVar("Found", bound=Finding)


@dataclass(frozen=True)
class Settled:
    """By `stored`, a run's state; its parts are taken up as a problem is assembled again, in the same order."""

    stored: Stored

    def begin(self, problem: Problem) -> None:
        """Give the parameters the values that the run began with."""
        keys = problem.selection.keys
        found = [name for name in self.stored.archive.names("parameter/") if name not in keys]
        if found:
            raise self.stored.wrong(f"parameter/{found[0]}", "is no parameter of this run")
        values = {key: self.stored.scene_value(problem, "initial", key) for key in keys}
        problem.selection.set_arrays({key: problem.selection.shown(key, value) for key, value in values.items()})
        for key in keys:
            problem.optimizer.set_value(key, values[key])
        problem.apply()

    def settle(self, problem: Problem, options: Sequence[Candidate]) -> Problem:
        """Choose what the run had chosen: the pilot's estimator, the samples of a pass, and how samples are drawn."""
        problem, guided, sequence = self._estimator(problem, options), None, None
        if is_auto(problem.config, "paths"):
            sides = self._found(PathsRecord, "paths", "is not what measuring which paths pay finds")
            problem = replace(problem, sides=sides, integrator=with_sides(problem.integrator, sides))
        if is_auto(problem.config, "guiding"):
            guided = self._found(GuidedRecord, "guided", "is not what measuring whether guiding pays finds")
        if is_auto(problem.config, "sequence"):
            sequence = self._found(SequenceRecord, "sequence", "is not what measuring whether the sequence pays finds")
        integrator = as_decided(problem.integrator, guided, sequence)
        return replace(problem, guided=guided, sequence=sequence, integrator=integrator)

    def _found(self, kind: type[Found], name: str, wrong: str) -> Found | None:
        """What was measured, where it was."""
        try:
            return None if self.stored.value(name) is None else kind.from_json(self.stored.value(name))
        except TypeError:
            raise self.stored.wrong(name, wrong) from None

    def _estimator(self, problem: Problem, options: Sequence[Candidate]) -> Problem:
        chosen = options[0] if options else None
        pilot = self._found(EstimatorRecord, "pilot", "is not what a pilot finds")
        if pilot is not None:
            chosen = next((option for option in options if option.options == pilot.chosen), None)
            if chosen is None:
                raise self.stored.wrong("pilot.chosen", "is nothing that this run can choose")
        if chosen is None:
            return replace(problem, pilot=pilot)
        if chosen.memory is None:
            return replace(problem, pilot=pilot, integrator=chosen.integrator, memory=None)
        memory = self._memory(chosen.memory)
        size = memory.samples_per_pass if memory.passes > 1 else None
        integrator = chosen.integrator.with_options(samples_per_pass=size, freeze=chosen.integrator.freeze)
        return replace(
            problem, pilot=pilot, integrator=integrator, memory=memory, samples_per_pass=memory.samples_per_pass
        )

    def reach(self, problem: Problem) -> Problem:
        """Take up what light and sensor reach, of the parameters whose true value is known."""
        masks = {}
        for key in problem.truth:
            shape = problem.selection.array(key).shape
            masks[key] = self.stored.archive.array(f"mask/{key}", shape[:2] if len(shape) == 3 else shape, "b")
        return replace(problem, masks=masks)

    def _memory(self, now: MemoryPlan) -> MemoryPlan:
        """The plan of the run, whose passes decide in what order samples are summed up."""
        size, passes = (self.stored.read(FROM_ONE, "memory", name) for name in ("samples_per_pass", "passes"))
        if size * passes != now.samples_per_pass * now.passes:
            raise self.stored.wrong("memory", f"has {passes} passes of {size} samples")
        try:
            stored = MemoryPlan.from_json(self.stored.value("memory"))
        except TypeError:
            raise self.stored.wrong("memory", "is no plan") from None
        return MemoryPlan(now.budget_bytes, size, passes, stored.expected_bytes)
