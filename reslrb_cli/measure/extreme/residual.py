"""What `gather`'s replay leaves of its sum: nothing but rounding, once every contribution has been taken off again."""

from __future__ import annotations

import numpy as np

from reslrb_cli.estimators.base import Pass
from reslrb_cli.estimators.gather import Gathering, Taking
from reslrb_cli.integrators import Job, Reslrb
from reslrb_cli.measure.comparison import Comparison
from reslrb_cli.measure.extreme.case import ExtremeCase
from reslrb_cli.measure.gradients import Case
from reslrb_cli.records.gradcheck import Verdict

#: Of the root mean square of the sums.
LIMIT = 1e-5


def residual(case: ExtremeCase, setup: Case, seed: int = 1) -> Comparison:
    """The root mean square of what is left, over that of S_0, as `relative_l2`."""
    import drjit as dr
    import mitsuba as mi

    leaves = setup.leaves()
    tracer = Reslrb.of(**{"rr_depth": 1000, **case.options, **case.ours, "estimator": "gather"})
    with dr.suspend_grad(), dr.isolate_grad():
        [samples] = tracer.passes(Job(setup.scene, setup.scene.sensors()[0], mi.UInt32(seed), case.spp, setup.params))
        p = Pass(samples, None, samples.film.adjoint(setup.weights))
        state = p.walk(Gathering(p))
        dr.eval(state)
        [S] = state.S
        left = p.walk(Taking(p, state.visibility, S), state.visibility.last > 0)
        sizes = [np.linalg.norm(np.array(value, np.float64)) for value in (left.value + left.rest, S.value)]
    setup.release(leaves)
    found = float(sizes[0] / sizes[1])
    verdict = Verdict.HOLDS if found < LIMIT else Verdict.FAILS
    return Comparison(verdict, None, relative_l2=found, relative_l2_limit=LIMIT, message="residual of the replay")
