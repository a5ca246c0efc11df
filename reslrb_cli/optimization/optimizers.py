"""One interface to Dr.Jit's optimisers. Each parameter has its own optimiser, with a `Variable` and bounds.

Updates (`Optimizer`): each parameter has its own optimiser. A parameter whose gradient is not finite can therefore keep
its moments and its number of steps.

    adam      m, v running means of g and g²; p -= lr · √(1-β₂ᵗ)/(1-β₁ᵗ) · m / (√v + ε)    Kingma and Ba 2015
    sgd       v = momentum · v + g; p -= lr · v
    auto      steps from measured curvature, without a rate (`newton.py`, and `block.py` for small parameters)

Exposure (`balance`): an image hardly changes if an exposure E rises and the colours c of the surfaces fall by the same
factor. Separate steps in E and c would cross this valley of the loss again and again. Therefore a step of E divides the
colours by the change of E, and E moves by the derivative along the valley.

    dL/dE with constant E c  =  dL/dE - sum of c dL/dc / E

Parameters must be finite and within their bounds (`clamp`, `count_nonfinite`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import drjit as dr
import numpy as np

from reslrb_cli.backend.memory import flat
from reslrb_cli.optimization.block import Block, JointState
from reslrb_cli.optimization.newton import DISPLACEMENT, AdamRule, Descent, Joint, Newton, fine_part
from reslrb_cli.optimization.nonfinite import count_nonfinite
from reslrb_cli.optimization.variables import Smoother, Transform, Variable
from reslrb_cli.statistics import Array, rms

OPTIMIZERS: dict[str, Callable[..., Any]] = {
    "adam": AdamRule,
    "sgd": Descent,
    "auto": Newton,
}

#: Extent of a parameter with a transform, in units of u.
EXTENT_OF_TRANSFORM = 2.0
#: Largest number of entries of a parameter that `auto` moves together with others, and of texels of a heightmap.
SMALL, SMALL_HEIGHTMAP = 4, 32
#: Longest step of these parameters and of motions as a share of the extent, and in the unit of a transform.
LONGEST_OF_SMALL, LONGEST_OF_MOTION, LONGEST_OF_TRANSFORM = 0.25, 0.1, 0.3


class Optimizer:
    """Optimiser that holds and updates the parameters. Gradients accumulate in the values that the optimiser returns.

    `rates`, `bounds`, `transforms` and `smoothers` have the parameters' keys. A rate of None stands for
    `learning_rate`. Bounds of None set no bounds. Transforms and smoothers may be missing. `small` names
    parameters that are small, whatever their size. Values and gradients belong to the scene's parameters, not to the
    optimiser's variables. The optimiser moves a parameter through its `Variable`, if any. Raises KeyError for an
    unknown `type`.
    """

    def __init__(
        self,
        type: str,
        learning_rate: float,
        options: Mapping[str, float],
        values: Mapping[str, Any],
        rates: Mapping[str, float | None],
        bounds: Mapping[str, tuple[float, float] | None],
        transforms: Mapping[str, Transform | None] | None = None,
        smoothers: Mapping[str, Smoother] | None = None,
        small: Collection[str] = (),
    ) -> None:
        self._rates = {key: float(rates[key] or learning_rate) for key in values}
        self._bounds = {key: bounds[key] for key in values}
        named = {"alpha" if name == "decay" else name: value for name, value in options.items()}
        sizes = {key: np.array(dr.detach(value)).size for key, value in values.items()}
        self._small = {key for key, size in sizes.items() if size <= SMALL or key in small}
        #: Joint steps of small parameters, for `auto`.
        self.block = Block({key: sizes[key] for key in values if key in self._small} if type == "auto" else {})
        self._own = {
            key: Joint(self.block) if key in self.block.at else OPTIMIZERS[type](lr=self._rates[key], **named)
            for key in values
        }
        self._measures = type == "auto"
        #: Extents of motions and heightmaps, by key (`displace`).
        self.extents: Mapping[str, float] = {}
        #: Textures whose brightness is part of the joint steps of `auto` (`balance`).
        self.textures: list[str] = []
        self._variables: dict[str, Variable] = {}
        #: The scene's values of the parameters with variables.
        self._scene: dict[str, Any] = {}
        #: The state of the run that it holds; None during a step, and if no state was requested.
        self.stands_at: object = None
        self._balanced: tuple[str, list[str]] | None = None
        for key, value in values.items():
            self._own[key][key] = value
            transform, smoother = (transforms or {}).get(key), (smoothers or {}).get(key)
            if transform is not None or smoother is not None:
                self.set_variable(key, Variable(transform, bounds[key], smoother=smoother))

    def keys(self) -> list[str]:
        """Return the keys of the parameters."""
        return list(self._own)

    def __getitem__(self, key: str) -> Any:
        """Return the value of a parameter, with enabled gradients."""
        return self._scene[key] if key in self._scene else self._own[key][key]

    def variable(self, key: str) -> Variable:
        """Return the variable of a parameter."""
        return self._variables.get(key) or Variable(None, self._bounds[key])

    def set_value(self, key: str, value: Any) -> None:
        """Set another value of the scene. The moments stay."""
        self.stands_at = None
        variable = self._variables.get(key)
        if variable is None:
            self._own[key][key] = value
        else:
            self._scene[key] = _leaf(value)
            self._own[key][key] = variable.from_scene(value)

    def set_variable(self, key: str, variable: Variable) -> None:
        """Move a parameter through `variable` from now on. Call this before the first step."""
        self.stands_at, value = None, dr.detach(self[key])
        self._variables[key], self._scene[key] = variable, _leaf(value)
        self._own[key][key] = variable.from_scene(value)

    def displace(self, extents: Mapping[str, float]) -> None:
        """Set the extents of motions and heightmaps. `auto` moves small heightmaps together with other small
        parameters. Call this before the first step.
        """
        self.extents = extents
        for key in extents if self._measures else ():
            if key not in self.block.at and self.is_small(key):
                value = self._own[key][key]
                self._own[key] = Joint(self.block)
                self._own[key][key] = value
                self.block.add({key: dr.prod(dr.shape(value))})

    def balance(self, exposure: str, colours: Sequence[str]) -> None:
        """From now on, divide `colours` by the change of `exposure` in each step. The arguments are keys. Entries
        without a gradient stay, because no image shows them.

        The joint steps of `auto` include the brightness of each channel of textures among `colours` instead. Call this
        before the first step.
        """
        self._balanced = exposure, list(colours)
        large = [key for key in colours if key in self._large and key not in self._variables]
        self.textures = [key for key in large if len(dr.shape(self[key])) == 3]
        self.block.add({key: dr.shape(self[key])[2] for key in self.textures})

    def forget(self) -> None:
        """Set the moments of all parameters to zero. `auto` has no long memory, and keeps its measured curvature."""
        for own in self._own.values():
            own.forget()

    def gradient(self, key: str) -> Any:
        """Return the gradient that has been accumulated into `self[key]`."""
        return dr.grad(self[key])

    def clear_gradient(self, key: str) -> None:
        """Clear the gradient accumulated into `self[key]`."""
        dr.clear_grad(self[key])

    def step(self, factor: float, skip: Collection[str] = ()) -> dict[str, int]:
        """Update all parameters except those in `skip`, with learning rates times `factor`, and clamp them.

        Even a finite gradient can make an update overflow. A parameter whose update overflows keeps its old value and
        its old optimiser state. Returns the number of non-finite entries of updates by key.
        """
        self.stands_at = None
        exposure, colours = self._moving(skip) if not self._measures else ("", [])
        reached = {key: self.gradient(key) != 0 for key in colours}
        if colours:
            old = dr.detach(self[exposure])
            products = [dr.sum(flat(dr.detach(self[key]) * self.gradient(key))) for key in colours]
            dr.set_grad(self[exposure], self.gradient(exposure) - sum(products) / old)
        # Dr.Jit makes the rate opaque, so a changing rate compiles no new kernel.
        moved, before, counts = [key for key in self._own if key not in skip], {}, {}
        joint = self._joint_steps(skip)
        for key in moved:
            own = self._own[key]
            before[key] = own.state[key], self[key]
            own.set_learning_rate(self._rates[key] * factor if own.longest is None else own.longest * self.extent(key))
            if key in joint and key not in self.textures:
                self._move_variable(key, joint[key])
            elif key in self._variables:
                self._step_variable(key)
            else:
                own.step(eval=False)
                value = dr.detach(own[key])
                if key in self.textures:
                    factors = type(flat(value))(np.exp(joint[key]).tolist())
                    dr.make_opaque(factors)
                    value = value * type(value)(factors, (1, 1, len(factors)))
                own[key] = clamp(value, self._bounds[key])
            counts[key] = count_nonfinite(self[key])
        dr.eval(counts)
        overflowed = {key: int(count[0]) for key, count in counts.items() if count[0]}
        for key in overflowed:
            self._own[key].state[key], value = before[key]
            dr.clear_grad(self._own[key][key])
            if key in self._variables:
                self._scene[key] = value
        for key in (*skip, *overflowed):
            self.clear_gradient(key)
        for key in colours if exposure not in overflowed else ():
            value = dr.detach(self[key])
            moved = clamp(value * (old / dr.detach(self[exposure])), self._bounds[key])
            self.set_value(key, dr.select(reached[key], moved, value))
        return overflowed

    def _joint_steps(self, skip: Collection[str]) -> dict[str, Array]:
        """Return the changes of the variables of small parameters, for `auto`, and of the logarithms of the channels'
        means of `textures`.
        """
        block, M = self.block, len(self.block.rows)
        known, exposure = np.ones(M, bool), np.full(M, -1)
        gradient, value, longest, low, high = np.zeros((5, M))
        balanced, colours = self._balanced or ("", [])
        for key, at in block.at.items():
            variable, v = self.variable(key), dr.detach(self._own[key][key])
            known[at] = key not in skip
            if key in self.textures:
                # The logarithms contain the texture's own steps, so the next joint step knows of them.
                texels, most = np.array(v, dtype=np.float64), (self._bounds[key] or (0, math.inf))[1]
                value[at], longest[at] = np.log(np.maximum(texels.mean((0, 1)), 1e-6)), LONGEST_OF_TRANSFORM
                low[at], high[at] = -math.inf, np.log(max(most, 1e-6))
                if key not in skip:
                    gradient[at] = np.sum(texels * np.array(self.gradient(key)), axis=(0, 1))
                continue
            value[at] = np.array(v).ravel()
            if key not in skip:
                gradient[at] = np.array(variable.chain(v, self.gradient(key))).ravel()
            longest[at] = self._longest(key)
            low[at], high[at] = variable.ends or (-math.inf, math.inf)
            if key in colours and variable.transform is None:
                place = block.at[balanced]
                own = np.arange(place.start, place.stop)
                exposure[at] = own if len(own) in (1, at.stop - at.start) else -1
        change = block.steps(JointState(value, gradient, longest, low, high, known, exposure))
        return {key: change[at] for key, at in block.at.items() if key not in skip}

    def _move_variable(self, key: str, change: Array) -> None:
        """Add `change` to the optimiser's variable of a small parameter, within its bounds."""
        own, variable = self._own[key], self.variable(key)
        old = dr.detach(own[key])
        row = np.array(old, dtype=np.float64).ravel() + change
        # A list is copied, but NumPy's memory is not, and kernels depend on its alignment.
        entries = type(flat(old))(row.tolist())
        new = type(old)(entries, dr.shape(old)) if dr.is_tensor_v(old) else dr.unravel(type(old), entries)
        dr.make_opaque(new)
        own[key] = variable.clamp(new)
        if key in self._variables:
            self._scene[key] = _leaf(variable.to_scene(dr.detach(own[key])))

    def slopes(self, key: str) -> Array:
        """Return dx/dv of each entry of a parameter's variable as a flat array, or 1 for a channel of `textures`."""
        if key in self.textures:
            return np.ones(dr.shape(self[key])[2])
        variable, v = self.variable(key), dr.detach(self._own[key][key])
        ones = dr.zeros(type(v), dr.shape(v)) + 1
        return np.array(variable.chain(v, ones), dtype=np.float64).ravel() / variable.gain

    def _moving(self, skip: Collection[str]) -> tuple[str, list[str]]:
        """Return the exposure and the colours that move together in this step, or no colours."""
        exposure, colours = self._balanced or ("", [])
        return exposure, [] if exposure in skip else [key for key in colours if key not in skip]

    def extent(self, key: str) -> float:
        """Return the size of the values that the optimiser's variable may have: the distance of the bounds, or twice
        the root mean square of the current values. A motion has its own extent, if the bounds are not closer.
        """
        low, high = self._bounds[key] or (-math.inf, math.inf)
        if self.variable(key).transform is not None:
            return EXTENT_OF_TRANSFORM
        if key in self.extents:
            return min(self.extents[key], high - low)
        return high - low if math.isfinite(high - low) else 2 * rms(np.array(dr.detach(self[key]))) or 1.0

    def is_small(self, key: str) -> bool:
        """Return whether the entries of a parameter are few, so that they are examined one by one."""
        size = dr.prod(dr.shape(self[key]))
        return key in self._small or bool(size <= (SMALL_HEIGHTMAP if key in self.extents else SMALL))

    def _longest(self, key: str) -> float:
        """Return the longest step of a small parameter, in the unit of the optimiser's variable."""
        if self.variable(key).transform is not None:
            return LONGEST_OF_TRANSFORM
        return (LONGEST_OF_MOTION if key in self.extents else LONGEST_OF_SMALL) * self.extent(key)

    @contextmanager
    def displaced(self, random: np.random.Generator) -> Iterator[None]:
        """Displace all entries of large parameters in the directions of their next steps, by equal amounts, and measure
        the curvature for `auto`. Entries that do not move have random directions. A texture is also displaced by the
        fine part of random directions (`newton.py`).

        Accumulate the gradient before, and within the block the gradient at the displaced values, with the same
        samples. Afterwards, values and gradients are as before.
        """
        large = self._large
        kept = self.stands_at, {key: (own.state[key], self._scene.get(key)) for key, own in self._own.items()}
        before, steps = self._descents(), {}
        for key in self.block.at:  # otherwise, the block would add to the gradients of small parameters
            self.set_value(key, dr.detach(self[key]))
        for key, own in large.items():
            v, variable = dr.detach(own[key]), self.variable(key)
            toward = own.toward(key, before[key])
            signs = random.choice([-1.0, 1.0], size=toward.shape)
            signs, far = np.where(toward != 0, np.sign(toward), signs), DISPLACEMENT * self.extent(key)
            ahead = v + type(v)((signs * far).astype(np.float32))
            ahead = variable.clamp(dr.select(variable.clamp(ahead) == ahead, ahead, 2 * v - ahead))
            step, fine = (ahead - v).array, None
            if len(dr.shape(v)) == 3:
                fine = type(step)((far * random.choice([-1.0, 1.0], size=signs.size)).astype(np.float32))
                ahead = variable.clamp(ahead + type(v)(fine_part(fine, dr.shape(v)), dr.shape(v)))
            steps[key] = step, fine
            dr.eval(ahead, steps[key])
            self.set_value(key, variable.to_scene(ahead))
        yield
        after = self._descents()
        self.stands_at = kept[0]
        for key, own in self._own.items():
            own.state[key], value = kept[1][key]
            if value is not None:
                self._scene[key] = value
        for key, own in large.items():
            own.bend(key, (after[key] - before[key]).array, *steps[key])

    def _descents(self) -> dict[str, Any]:
        """Return the accumulated gradients by the optimiser's variables, evaluated."""
        found = {
            key: self.variable(key).chain(dr.detach(own[key]), self.gradient(key)) for key, own in self._own.items()
        }
        dr.eval(found)
        return found

    def to_go(self, key: str) -> float:
        """Return an upper limit of the distance to the optimum as a share of the extent. Only for `auto`; infinity
        otherwise.
        """
        distance = self._own[key].to_go(key)
        if key in self.textures:
            distance = max(distance, self.block.to_go(key) * rms(np.array(dr.detach(self[key]))))
        return float(distance / self.extent(key))

    def averaged(self, key: str) -> float:
        """Return the number of gradients that a step of `auto` averages. It rises if noise dominates."""
        return self._own[key].averaged(key)

    def _step_variable(self, key: str) -> None:
        own, variable = self._own[key], self._variables[key]
        gradient = variable.chain(dr.detach(own[key]), self.gradient(key))
        dr.set_grad(own[key], gradient)
        own.step(eval=False)
        own[key] = variable.clamp(dr.detach(own[key]))
        self._scene[key] = _leaf(variable.to_scene(dr.detach(own[key])))

    def response(self, key: str) -> np.ndarray[Any, Any]:
        """Return how far each entry of the scene's value moves per unit of the entry's gradient, as a flat array.

        The movement is that of a step with a learning rate of 1 and the current moments. The movement includes
        momentum, because the response to a gradient is summed over many steps. The next step is the returned movement
        times the schedule's factor and the parameter's rate (`rate`). It is 0 if no step was taken.
        """
        steepness = self._own[key].steepness(key)
        if key not in self._variables:
            return 1 / steepness
        variable, moved = self._variables[key], dr.detach(self._own[key][key])
        slope = np.array(variable.chain(moved, dr.zeros(type(moved), dr.shape(moved)) + 1), dtype=np.float64).ravel()
        result = slope**2 / variable.gain / steepness
        return result if variable.smoother is None else result * variable.smoother.gain

    @property
    def measures_curvature(self) -> bool:
        """True for `auto`."""
        return self._measures

    @property
    def has_large(self) -> bool:
        """True if the curvature of textures or other large parameters is measured for `auto`."""
        return bool(self._large)

    @property
    def _large(self) -> dict[str, Newton]:
        return {key: own for key, own in self._own.items() if isinstance(own, Newton)}

    def rate(self, key: str) -> float:
        """Return the learning rate of a parameter, before any schedule."""
        return self._rates[key]

    def first_step(self, key: str) -> float | None:
        """Return the root mean square change of the scene's current value in one step at the parameter's learning rate.
        Return None if the step length depends on the gradient.
        """
        if not self._own[key].keeps_length:
            return None
        if key not in self._variables:
            return self._rates[key]
        return self._variables[key].reach(dr.detach(self._own[key][key]), self._rates[key])

    def gains(self) -> dict[str, float]:
        """Return the gain of each parameter that moves through a `Variable`."""
        return {key: variable.gain for key, variable in self._variables.items()}

    def moments(self) -> dict[str, dict[str, Any]]:
        """Return the optimiser's data for each parameter, without the parameter's value.

        The data are arrays in Dr.Jit's order. If a parameter has a `Variable`, the data include the value of the
        optimiser's variable as `variable`. No step changes these arrays, so they are not copied.
        """
        found = {}
        for key, own in self._own.items():
            kept = {str(place): entry for place, entry in enumerate(_entries(own, key)) if dr.is_array_v(entry)}
            moved = {"variable": dr.detach(own[key])} if key in self._variables else {}
            joint = {"block": self.block.rows[self.block.at[key]]} if key in self.block.at else {}
            found[key] = moved | kept | joint
        return found

    def restore(self, values: Mapping[str, Any], gains: Mapping[str, float], moments: Mapping[str, Any]) -> None:
        """Continue from stored values of the scene, and from earlier results of `gains` and `moments`."""
        for key, own in self._own.items():
            kept = moments[key]
            if key in gains:
                self._variables[key] = replace(self.variable(key), gain=gains[key])
                self._scene[key] = _leaf(values[key])
            elif key in self._variables:
                del self._variables[key], self._scene[key]
            own[key] = kept.get("variable", values[key])
            value, promoted, rate, extra = own.state[key]
            entries = tuple(kept.get(str(place), entry) for place, entry in enumerate(_entries(own, key)))
            own.state[key] = value, promoted, rate, entries if isinstance(extra, tuple) else entries[0]
        if self.block.at:
            self.block.rows = np.concatenate([np.asarray(moments[key]["block"]) for key in self.block.at])


def _entries(own: Any, key: str) -> tuple[Any, ...]:
    """Return the data of parameter `key` in the Dr.Jit optimiser `own`, without the parameter's value."""
    extra = own.state[key][3]
    return extra if isinstance(extra, tuple) else (extra,)


def _leaf(value: Any) -> Any:
    """Return a copy that receives gradients."""
    copy = type(value)(value)
    dr.make_opaque(copy)
    dr.enable_grad(copy)
    return copy


def clamp(value: Any, bounds: tuple[float, float] | None) -> Any:
    """Project `value` onto `bounds` (low, high) after an update. Bounds of None, or an infinite bound on one side, set
    no limit.
    """
    return value if bounds is None else dr.clip(value, bounds[0], bounds[1])
