"""`reslrb gradcheck --json FILE`: one object a line, one line for each comparison of a gradient with a reference."""

from __future__ import annotations

import enum
import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any


class Reference(str, enum.Enum):
    """What a gradient is compared with; `forward_mode` by the dot product <w, J v> = <J^T w, v>."""

    PTRACER = "ptracer"
    WALK_AD = "walk_ad"
    PATH = "path"
    PRB = "prb"
    FINITE_DIFFERENCE = "finite_difference"
    ANALYTIC = "analytic"
    FORWARD_MODE = "forward_mode"


class Kind(str, enum.Enum):
    """How it is compared.

    `equal_seeds`: by relative L2, where both compute the same numbers but for rounding. `expectation`: by z scores over
    many seeds. `image`: so too, but not the gradient, the image it belongs to.
    """

    EQUAL_SEEDS = "equal_seeds"
    EXPECTATION = "expectation"
    IMAGE = "image"


class Verdict(str, enum.Enum):
    """What came of it. All but `holds` and `fails` leave the question open, and `message` says why.

    `heavy_tailed`: single seeds carry the variance, so that z scores prove nothing. `unresolved`: noise hides
    deviations as large as the gradient itself. `unreached`: gradient and reference are exactly zero.
    `no_reference`: nothing here counts as one. `not_measured`: time was up before there were samples.
    """

    HOLDS = "holds"
    FAILS = "fails"
    HEAVY_TAILED = "heavy_tailed"
    UNRESOLVED = "unresolved"
    UNREACHED = "unreached"
    NO_REFERENCE = "no_reference"
    NOT_MEASURED = "not_measured"


@dataclass(frozen=True)
class GradcheckRecord:
    """One comparison: the gradient of a parameter by an integrator, against a reference.

    `case` names the scene: the configuration, or a case of a suite. `parameter` is None where all are compared
    together, or the image; `estimator` where the integrator has none. `seeds` is how many gradients each side has.
    `relative_l2` is the distance from the reference over its norm: at equal seeds of the samples, else of the
    means. `z_rms` and `z_max` are in standard errors; each has its limit, corrected for the number of comparisons.
    `cosine` is that of the angle between the means, `variance_ratio` the variance over that of the reference.
    `detectable` is the least deviation, as a fraction of the reference, that would have been seen. `message` says what
    the figures do not. What does not apply is None.
    """

    case: str
    parameter: str | None
    integrator: str
    estimator: str | None
    reference: Reference
    kind: Kind
    seeds: int
    verdict: Verdict
    relative_l2: float | None = None
    relative_l2_limit: float | None = None
    z_rms: float | None = None
    z_rms_limit: float | None = None
    z_max: float | None = None
    z_max_limit: float | None = None
    cosine: float | None = None
    variance_ratio: float | None = None
    detectable: float | None = None
    message: str = ""

    @property
    def holds(self) -> bool | None:
        """True or False where the comparison decides; None where it does not."""
        return {Verdict.HOLDS: True, Verdict.FAILS: False}.get(self.verdict)

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> GradcheckRecord:
        """The record of these values, by name. Raises TypeError and ValueError where they are none of a record."""
        names = {"reference": Reference, "kind": Kind, "verdict": Verdict}
        return cls(**{key: names[key](value) if key in names else value for key, value in values.items()})

    def to_json(self) -> str:
        """The record as one line of JSON; figures that are not finite become null."""
        values = {key: _finite(value) for key, value in asdict(self).items()}
        return json.dumps(values | {"holds": self.holds}, allow_nan=False)


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value
