"""What is recorded of how certain final values are."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True)
class ParameterCertainty:
    """Of one parameter: its verdict, and the share of its entries that each verdict has.

    `spread` is one standard deviation of the final value about the optimum and `to_go` the estimated way there, in the
    parameter's unit: one number for each entry of a small parameter, else one, the root mean square over the entries
    that have an effect; None where none was measured, and of entries at their bounds. `partner` is the parameter that
    makes up for this one, where one does. `of_target` is what of the spread the noise of rendered targets makes, in the
    same layout.

    `moved` is the root mean square of how far the entries went since the start, and `reach` of how far all steps would
    have taken them one way, None where their length depends on the gradient (`sgd`); `rate` is the learning rate.
    `seen` is the share of a texture's texels that some view shows, None where that is not asked.
    """

    verdict: str
    shares: dict[str, float]
    spread: list[float | None] | None
    to_go: list[float | None] | None
    partner: str | None = None
    of_target: list[float | None] | None = None
    moved: float | None = None
    reach: float | None = None
    rate: float | None = None
    seen: float | None = None


@dataclass(frozen=True)
class CertaintyRecord:
    """All parameters, by key, and what it took: so many gradients, renderings along directions and random probes, in
    `measure_s` seconds, compilation (`compile_s`) apart, and that over the time of the run's iterations (`share`).

    `iterations`, `scale` and `learning_rate` (those of `optimizer`) and `target_spp` are the run's. `target_noise` says
    whether the noise of the targets is in the spreads: `measured` where all of them were rendered, `in part` where some
    were, else `left out`.
    """

    parameters: dict[str, ParameterCertainty]
    gradients: int
    changes: int
    probes: int
    measure_s: float
    compile_s: float
    share: float
    iterations: int
    scale: str
    learning_rate: float
    target_noise: str
    target_spp: int | None = None

    def to_json(self) -> dict[str, Any]:
        """As a mapping for JSON."""
        return asdict(self)
