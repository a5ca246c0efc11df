"""Images and gradients of several passes, added up.

In single precision a sum over all samples would lose the last of them (1e8 samples: a quarter of a pixel), so each pass
has a block and gradients of its own, and these are added to one another.
"""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi

from reslrb_cli.transport.samples import Samples


def in_passes(
    samples: list[Samples],
    work: Callable[[Samples, mi.ImageBlock | None], None],
    block: mi.ImageBlock | None,
    params: mi.SceneParameters | None = None,
) -> None:
    """Call `work(part, block)` for each pass. It splats into the block (None: nothing), and differentiates `params`
    (None: nothing)."""
    if len(samples) == 1:
        work(samples[0], block)
        return
    sums = None if params is None else GradientSum(params)
    for part in samples:
        own = None if block is None else part.film.block()
        work(part, own)
        if block is not None:
            block.put_block(own)
        finish_pass([] if block is None else block.tensor())
        if sums is not None:
            sums.take()
    if sums is not None:
        sums.put()


class GradientSum:
    """Sums the parameters' gradients over passes, apart from where each pass adds its own."""

    def __init__(self, params: mi.SceneParameters) -> None:
        with dr.resume_grad():  # where gradients are suspended, nothing says that it tracks them
            enabled = [value for _, value in params.items() if dr.grad_enabled(value)]
            self.values = [array for value in enabled for array in _arrays(value)]
        self.totals: list[dr.ArrayBase] = []

    def take(self) -> None:
        """Take what has been added to the gradients since the last time."""
        with dr.resume_grad():
            found = [dr.detach(dr.grad(value)) for value in self.values]
            self.totals = [a + b for a, b in zip(self.totals, found, strict=True)] if self.totals else found
            for value in self.values:
                dr.clear_grad(value)
        finish_pass(self.totals)

    def put(self) -> None:
        """Give the sums to the parameters."""
        with dr.resume_grad():
            for value, total in zip(self.values, self.totals, strict=True):
                dr.accum_grad(value, total)


def _arrays(value: dr.ArrayBase | mi.AffineTransform4f) -> list[dr.ArrayBase]:
    """The arrays of a parameter that gradients can be added to: a transform, which cannot be added, has two."""
    return [value.matrix, value.inverse_transpose] if isinstance(value, mi.AffineTransform4f) else [value]


def finish_pass(*results: object) -> None:
    """Evaluate what a pass yields, and wait for it: memory of passes that are still queued would pile up."""
    dr.eval(*results)
    dr.sync_thread()
