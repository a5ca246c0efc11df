"""What every estimator offers, and the step that all share: from an adjoint contribution to derivatives at a vertex."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from reslrb_cli.transport.factors import NO_ZERO, Product
from reslrb_cli.transport.plan import Plan
from reslrb_cli.transport.splat import AdjointImage, Film
from reslrb_cli.transport.walk import Hooks


class Estimator(ABC):
    """One way to estimate the gradient of a path's contributions in constant memory.

    The image pass runs `image_hooks`, whose final state is all that is kept of each path; once dL/dI is known,
    `replay_hooks` runs over the same paths and adds the derivatives.
    """

    @abstractmethod
    def image_hooks(self, plan: Plan, scene: Any, film: Film, block: Any, scale: float) -> Hooks:
        """Hooks of the image pass: keep what a replay needs, and splat `scale` C_i into `block` (None: no image)."""

    def finish_image(self, film: Film, block: Any, state: Any) -> None:
        """Splat what the final state of the image pass holds, where the image is made of that."""
        return

    @abstractmethod
    def adjoint(self, state: Any, image: AdjointImage) -> PathAdjoint:
        """What the kept state and dL/dI say of each path."""

    @abstractmethod
    def replay_hooks(self, plan: Plan, scene: Any, state: Any, adjoint: PathAdjoint) -> Hooks:
        """Hooks of the replay, from the image pass's final state."""


@dataclass
class PathAdjoint:
    """Sensitivity of the objective to one path as a whole.

    `value` is (C,): delta times the product of the nonzero factors, estimator weight included; `product` says which
    factor is zero, if any; `active` in which lanes there is anything to replay.
    """

    value: Any
    product: Product
    active: Any


def adjoint_of_factor(adjoint: PathAdjoint, index: Any, f: Any, rest: Any) -> Any:
    """d(objective)/df (C,), for the factor `f * rest` that stands at position `index` of the path; detached.

    A factor that is not zero gets adjoint / f where no factor is zero; one that is, adjoint * rest where it is the only
    one.
    """
    f, zeros = dr.detach(f), adjoint.product.zero
    if not zeros:
        return dr.select(f != 0, adjoint.value / f, 0)
    result, rest = mi.Spectrum(0), mi.Spectrum(rest)
    for c, zero in enumerate(zeros):
        at_zero = dr.select(zero == mi.Int32(index), adjoint.value[c] * rest[c], 0)
        result[c] = dr.select((zero == NO_ZERO) & (f[c] != 0), adjoint.value[c] / f[c], at_zero)
    return result
