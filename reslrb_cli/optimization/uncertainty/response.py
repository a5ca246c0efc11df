"""Score test of the response of the camera: how much a recovered curve would reduce the misfit.

The derivatives along the numbers of a curve are -B_k I (`optimization/response.py`), so no image is rendered. All views
share the curve, as with `target.response: {curve: auto}`.
"""

from __future__ import annotations

import numpy as np

from reslrb_cli.config.response import MOST
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.uncertainty.curvature import LossCurvature
from reslrb_cli.optimization.uncertainty.fit import Candidate
from reslrb_cli.optimization.views import RESPONSE
from reslrb_cli.scene.response import basis, start
from reslrb_cli.statistics import Array

#: Endings of files that cameras do not write.
LINEAR_FILES = (".exr", ".hdr", ".pfm")


def may_have_response(problem: Problem) -> bool:
    """Return whether a curve could be recovered: all targets are files that are decoded as sRGB, and all exposures are
    recovered.
    """
    return problem.config.target.white_balance is None and all(
        view.file is not None
        and view.file.suffix.lower() not in LINEAR_FILES
        and view.exposure.key
        and view.response is None
        and (view.decoded_by is None or view.decoded_by.encoding == "srgb")
        for view in problem.trained
    )


def response_derivatives(problem: Problem, curvature: LossCurvature) -> tuple[Array, Array]:
    """Return the derivatives (K, N) of the images along the numbers of a curve, by each set of samples."""
    parts = [basis("curve", np.array(view.target, dtype=np.float64)) for view in problem.trained]
    one, other = (
        np.stack([
            curvature.in_a_row([-part[k] * image for part, image in zip(parts, images, strict=True)])
            for k in range(start("curve").size)
        ])
        for images in curvature.images
    )  # fmt: skip
    return one, other


def response_candidate(places: Array, offsets: Array, p: float) -> Candidate:
    """Return the record of a curve whose numbers at `places` would change by `offsets`."""
    value = start("curve")
    proposed = value.copy()
    proposed[places] += offsets
    is_inside = bool(np.all((proposed > 0) & (proposed < MOST)))
    return Candidate(RESPONSE, p, 0.0, value.tolist(), proposed.tolist() if is_inside else [])
