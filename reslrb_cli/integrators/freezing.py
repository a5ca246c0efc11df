"""Recordings of the kernel launches of a step: no Python code between a seed and its gradient (`dr.freeze`).

Tracing a step takes milliseconds for any image. There is a recording for each kind of call. Dr.Jit makes another one if
inputs change in more than their values.
"""

from __future__ import annotations

import gc
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import drjit as dr
import mitsuba as mi

from reslrb_cli.errors import UnsupportedScene, is_machine_fault, is_out_of_memory
from reslrb_cli.transport.film import Film
from reslrb_cli.transport.samples import Samples

logger = logging.getLogger(__name__)

#: Paths beyond which nothing is recorded: Python does not show beside them, and the trials of a recording would.
MOST_PATHS = 2**22

#: Paths beyond which what comes once in a while is not: the trials take as long as three more passes.
MOST_PATHS_APART = 2**17

#: Recordings of one kind of call that are kept, for inputs that change in more than their values.
KEPT = 4

#: Calls after which a recording is in use, at most: Dr.Jit makes some twice before it trusts them.
TRIALS = 4

#: A call that is recorded more often than that gains nothing by it, and is made plainly from then on. Dr.Jit would warn
#: after ten.
MOST_RECORDINGS = 8

#: Calls that are recorded: a script that makes a new sensor for every image would go on for ever.
MOST_CALLS = 256


class Recordings:
    """Recordings of calls on the samples of one scene, by kind, plan and sensor."""

    def __init__(self) -> None:
        self._functions: dict[Any, Any] = {}  # None where a call is not recorded: it cannot be, or gains nothing by it

    def clear(self) -> None:
        """Clear all recordings, for a new scene."""
        self._functions.clear()

    def call(self, kind: str, samples: Samples, function: Callable[..., Any], *inputs: Any) -> Any:
        """Call `function(samples, *inputs)`, from a recording if there is one; its results are evaluated.

        `function` depends only on its inputs and, for values that are no Dr.Jit arrays, on `kind`. The derivatives that
        it adds to parameters are proportional to the first of `inputs`. Calls that cannot be recorded are made
        directly: for example, other living scenes take part in indirect calls, but are no inputs. So are calls that had
        to be recorded again and again. Raises UnsupportedScene if a recording exists but does not fit any more.
        """
        s = samples
        # Sensors that share a recording have it made anew whenever another one's turn comes. The key holds its sensor:
        # no other sensor gets its address.
        widths = tuple(side.width for side in s.sides())
        key = (kind, s.plan, s.spp, widths, tuple(s.film.size), s.sensor)
        plain = _on_samples(samples, function)
        common = (s.scene, s.sensor, *(_arrays(side) for side in s.sides()))
        if key not in self._functions and len(self._functions) < MOST_CALLS:
            self._functions[key] = _record(kind, plain, common, inputs)
        recorded = self._functions.get(key)
        if recorded is not None and recorded.n_recordings >= MOST_RECORDINGS:
            logger.debug("no longer recorded (%s): recorded %d times", kind, recorded.n_recordings)
            recorded = self._functions[key] = None
        if recorded is None:
            return plain(*common, *inputs)
        try:
            with _without_garbage_collection():
                return recorded(*common, *inputs)
        except RuntimeError as error:
            if is_out_of_memory(error) or is_machine_fault(error):
                raise
            reason = str(error.__cause__ or error).splitlines()[0]
            raise UnsupportedScene(
                f"freeze: a recorded step no longer fits, possibly because another scene was loaded since ({reason}); "
                "switch off recordings with drjit.set_flag(drjit.JitFlag.KernelFreezing, False)"
            ) from error

    def counts(self) -> dict[str, int]:
        """Return how often each kind of call was recorded."""
        counts: dict[str, int] = {}
        for (kind, *_), function in self._functions.items():
            if function is not None:
                counts[kind] = counts.get(kind, 0) + function.n_recordings
        return counts


def _record(
    kind: str, plain: Callable[..., Any], common: tuple[Any, ...], inputs: tuple[Any, ...],
) -> Any:  # fmt: skip
    """Return a recording, or None if the call cannot be recorded.

    Dr.Jit detects this after it has computed everything and added derivatives. The recording is therefore tried with a
    first input of zeros, which adds none, and repeated until it is used, so that later work has the same kernels from
    the first step on.
    """
    recorded = dr.freeze(plain, limit=KEPT)
    if inputs:
        zeros = dr.zeros(type(inputs[0]), inputs[0].shape)
        dr.make_opaque(zeros)
        inputs = (zeros, *inputs[1:])
    gc.collect()  # scenes that are done with
    try:
        with _without_garbage_collection():
            for done in range(TRIALS):
                recorded(*common, *inputs)
                dr.sync_thread()  # else a trial's memory may or may not be free for the next one, and peaks vary
                if recorded.n_recordings <= done:
                    break
    except RuntimeError as error:
        if is_out_of_memory(error) or is_machine_fault(error):
            raise
        logger.debug("not recorded (%s): %s", kind, error.__cause__ or error)
        return None
    return recorded


@contextmanager
def _without_garbage_collection() -> Iterator[None]:
    """Suspend garbage collection: freeing a scene during a recording ends the process."""
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()


def _on_samples(samples: Samples, function: Callable[..., Any]) -> Callable[..., Any]:
    """Return `function` with every input of a recording as a separate argument."""
    # Only these: arrays would be constants of the recording, and a scene would never be freed.
    sides = [(side.plan, side.spp, side.width) for side in samples.sides()]

    def on_samples(scene: mi.Scene, sensor: mi.Sensor, *given: Any) -> Any:
        film, made = Film(sensor, sides[0][0].whole), []
        for (plan, spp, width), arrays in zip(sides, given, strict=False):
            seed, *others = arrays
            made.append(Samples(scene, sensor, plan, film, seed, spp, width, *others))
        first, *camera = made
        if camera:
            first.camera = camera[0]
        return function(first, *given[len(sides) :])

    return on_samples


def _arrays(samples: Samples) -> tuple[Any, ...]:
    """Return the arrays of samples that are inputs of a recording, in the order of their members."""
    s = samples
    return s.seed, s.scale, s.fraction, s.guide, s.net, s.ratio, s.emitters, s.shares
