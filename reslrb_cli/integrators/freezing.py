"""Recordings of a step's kernel launches (`dr.freeze`). With a recording, no Python code runs between a seed and its
gradient.

Tracing a step in Python takes milliseconds, whatever the size of the image. There is a recording for each kind of call.
Dr.Jit makes another recording if inputs differ in more than their values.
"""

from __future__ import annotations

import gc
import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import drjit as dr
import mitsuba as mi

from reslrb_cli.errors import UnsupportedScene, is_machine_fault, is_out_of_memory
from reslrb_cli.scene.graph import SceneGraph, look_up
from reslrb_cli.transport.film import Film
from reslrb_cli.transport.samples import Samples

logger = logging.getLogger(__name__)

#: Paths above which nothing is recorded: Python's time is hidden there, and the trials of a recording would cost more.
MOST_PATHS = 2**22

#: Paths above which rare calls are not recorded: the trials take as long as three more passes.
MOST_PATHS_APART = 2**17

#: Maximum number of recordings of one kind of call, for inputs that differ in more than their values.
KEPT = 4

#: Maximum number of calls before a recording is used: Dr.Jit makes some twice before it trusts them.
TRIALS = 4

#: A call with more recordings gains nothing and is no longer recorded. Dr.Jit would warn after ten.
MOST_RECORDINGS = 8

#: Maximum number of recorded calls: a script that makes a new sensor for every image would record forever.
MOST_CALLS = 256

#: Thread whose calls are recorded. Recordings of two threads that alternate do not see the objects of their scenes.
_recorder: threading.Thread | None = None


def _may_record() -> bool:
    """Return True if calls of this thread are recorded. Until the recording thread ends, no other thread may record."""
    global _recorder
    if _recorder is None or not _recorder.is_alive():
        _recorder = threading.current_thread()
    return _recorder is threading.current_thread()


class Recordings:
    """Recordings of calls on the samples of one scene, by kind, plan and sensor."""

    def __init__(self) -> None:
        self._functions: dict[Any, Any] = {}  # None if a call is not recorded, or would gain nothing
        self._recordable: bool | None = None  # None before the first call

    def call(self, kind: str, samples: Samples, function: Callable[..., Any], *inputs: Any) -> Any:
        """Call `function(samples, *inputs)`. Uses a recording if there is one. Its results are evaluated.

        `function` must depend only on its inputs. `kind` must determine all values that are no Dr.Jit arrays. The
        derivatives that `function` adds to parameters must be proportional to the first of `inputs`. Calls that cannot
        be recorded are made directly, and so are calls of a second thread. For example, a call cannot be recorded while
        a second scene is alive. The second scene takes part in indirect calls, but is not an input. Calls that were
        recorded too often are also made directly. Raises UnsupportedScene if a recording no longer fits.
        """
        s = samples
        # Sensors that share a recording would remake it at every change of sensor. The key holds the sensor, so no
        # other sensor gets its address.
        widths = tuple(side.width for side in s.sides())
        key = (kind, s.plan, s.spp, widths, tuple(s.film.size), s.sensor)
        # Another integrator's render leaves its whole path loop pending in the sampler's state. Dr.Jit would evaluate
        # the state as an input, and with CUDA read an acceleration structure that may be gone.
        s.sensor.sampler().seed(0, 1)
        plain = _on_samples(samples, function)
        common = (s.scene, s.sensor, *(_arrays(side) for side in s.sides()))
        if self._recordable is None:
            self._recordable = not has_software_textures(s.scene)
        if not _may_record():
            return plain(*common, *inputs)
        if self._recordable and key not in self._functions and len(self._functions) < MOST_CALLS:
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

    Dr.Jit detects a call that cannot be recorded only after it has computed everything and added derivatives. The first
    trial of a recording therefore uses zeros as first input. Zeros add no derivatives. The trial is repeated until the
    recording is used. After the trial, every step runs the same kernels, including the first step.
    """
    recorded = dr.freeze(plain, limit=KEPT)
    if inputs:
        zeros = dr.zeros(type(inputs[0]), inputs[0].shape)
        dr.make_opaque(zeros)
        inputs = (zeros, *inputs[1:])
    gc.collect()  # scenes that are no longer used
    try:
        with _without_garbage_collection():
            for done in range(TRIALS):
                recorded(*common, *inputs)
                dr.sync_thread()  # frees the memory of a trial before the next, so peaks do not vary
                if recorded.n_recordings <= done:
                    break
    except RuntimeError as error:
        if is_out_of_memory(error) or is_machine_fault(error):
            raise
        logger.debug("not recorded (%s): %s", kind, error.__cause__ or error)
        return None
    return recorded


def has_software_textures(scene: mi.Scene) -> bool:
    """True if a bitmap texture of the scene does not use CUDA's texture units, because it has `accel: false`.

    Dr.Jit 1.5 cannot record a call with a texture like that. It reads uninitialised memory when it collects the inputs
    (`Texture.traverse_1_cb_ro`), and may end the process.
    """
    if not mi.variant().startswith("cuda"):
        return False
    with dr.suspend_grad(), dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        for texture in SceneGraph.of(scene).bitmaps():
            dr.kernel_history_clear()
            dr.eval(look_up(texture))
            kernels = [kernel["ir"].getvalue() for kernel in dr.kernel_history([dr.KernelType.JIT])]
            if not any("tex.2d" in code for code in kernels):
                return True
    return False


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
    """Return a version of `function` that takes each input of a recording as a separate argument."""
    # Only these: arrays would become constants of the recording, and a scene would never be freed.
    sides = [(side.plan, side.spp, side.width) for side in samples.sides()]

    def on_samples(scene: mi.Scene, sensor: mi.Sensor, *given: Any) -> Any:
        film, made = Film(sensor, sides[0][0].whole, given[0][-1]), []
        for (plan, spp, width), arrays in zip(sides, given, strict=False):
            seed, *others, _ = arrays
            made.append(Samples(scene, sensor, plan, film, seed, spp, width, *others))
        first, *camera = made
        if camera:
            first.camera = camera[0]
        return function(first, *given[len(sides) :])

    return on_samples


def _arrays(samples: Samples) -> tuple[Any, ...]:
    """Return the arrays in `samples` that a recording takes as inputs, in the order of the members of `Samples`. The
    last one belongs to the film.
    """
    s = samples
    return s.seed, s.scale, s.fraction, s.guide, s.net, s.ratio, s.emitters, s.shares, s.edges, s.film.responses
