"""The conditioning of an experiment where it starts: chains of Jacobians, and sensitivities of its parameters.

How well conditioned the chains are that `reservoir` inverts where parameters move light (`measure_chains`): the inverse
of a chain with condition number kappa has lost log10(kappa) of the 16 digits of double precision; and where that number
is large, small noise in a connection's derivatives becomes large at the first vertex. Coordinates are those of
`estimators.jacobian`, lengths in units of the scene's diagonal, angles in radians.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.estimators.base import Pass
from reslrb_cli.estimators.chain import AXES, ChainSelection, ChainState
from reslrb_cli.estimators.reservoir import JACOBIAN_DAMPING
from reslrb_cli.estimators.selection import selection_weight
from reslrb_cli.integrators.protocol import Job
from reslrb_cli.integrators.reslrb import Reslrb
from reslrb_cli.optimization.decisions import Sensitivity
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.sensitivity import measure_sensitivities
from reslrb_cli.seeds import seed
from reslrb_cli.transport.bsdf import Scattering
from reslrb_cli.transport.connection import Connection
from reslrb_cli.transport.factors import Product
from reslrb_cli.transport.walk import Hooks, Vertex

#: Light paths that are looked at.
PATHS = 2**16
_PURPOSE = "conditions"


@dataclass(frozen=True)
class ChainConditions:
    """Condition numbers of J_{0->I} of kept connections, of chains with `vertices` vertices before the connection's."""

    vertices: int
    paths: int
    median: float
    percentile_99: float
    largest: float


@dataclass
class WatchedState:
    """What selection keeps; J of the connection that is kept, and vertices that have gone into it: in the end, so far
    on the way."""

    chain: ChainState
    J: mi.Matrix4d
    kept: mi.UInt32
    vertices: mi.UInt32


class Watched(Hooks):
    """Selection as `reservoir` does it, with one slot, of which J is kept."""

    def __init__(self, selection: ChainSelection) -> None:
        self.selection, self.numbers = selection, selection.numbers

    def start(self, product: Product) -> WatchedState:
        return WatchedState(self.selection.start(product), mi.Matrix4d(1), mi.UInt32(0), mi.UInt32(0))

    def connection(
        self, state: WatchedState, vertex: Vertex, connection: Connection, numbers: list[mi.Float]
    ) -> WatchedState:
        return replace(state, chain=self.selection.connection(state.chain, vertex, connection, numbers))

    def scattering(
        self, state: WatchedState, vertex: Vertex, connection: Connection, scattering: Scattering
    ) -> WatchedState:
        before, chain = state.chain, self.selection.scattering(state.chain, vertex, connection, scattering)
        taken = connection.active & (chain.slots[0].number == vertex.depth)
        J = dr.select(taken, before.J[0], state.J)
        kept = dr.select(taken, state.vertices, state.kept)
        # A chain begins with the first vertex that has a part, and anew with a block.
        anew = dr.all(dr.all(chain.J[0] == mi.Matrix4d(1)))
        return WatchedState(chain, J, kept, dr.select(anew, mi.UInt32(0), state.vertices + 1))


def measure_chains(problem: Problem) -> list[ChainConditions]:
    """Of the first view's paths, where the parameters stand; empty where nothing moves light, and without `reslrb`."""
    if problem.config.integrator.type != "reslrb":
        return []
    options = problem.config.integrator.options()
    damping = options.get("jacobian_damping", JACOBIAN_DAMPING)
    shared = {name: value for name, value in options.items() if name in Reslrb.OPTIONS}
    own = {"estimator": "reservoir", "guiding": "off", "sequence": "independent", "freeze": False}
    own |= {"paths": "light", "light_share": 0.5}  # chains are those of light paths
    tracer = Reslrb.of(**(shared | own))
    scene, sensor = problem.scene, problem.scene.sensors()[problem.sensors[0]]
    problem.apply()
    width, height = sensor.film().crop_size()
    at = dr.opaque(mi.UInt32, seed(problem.config.run.seed, 0, problem.sensors[0], _PURPOSE))
    job = Job(scene, sensor, at, max(PATHS // int(width * height), 1), problem.selection.params)
    with dr.suspend_grad():
        [samples, *_] = tracer.passes(job)
        if not samples.plan.attached:
            return []
        p = Pass(samples, None, None)

        def weigh(connection: Connection, C: Product, W: mi.Float) -> mi.Float:
            return selection_weight(p, "luminance", connection, C)

        state = p.walk(Watched(ChainSelection(p, 1, damping, False, weigh)))
        found = state.chain.slots[0].number > 0
        dr.eval(state.J, state.kept, found)
    box = scene.bbox()
    return _by_length(state, np.array(found), float(dr.norm(box.max - box.min)))


def _by_length(state: WatchedState, found: np.ndarray, diagonal: float) -> list[ChainConditions]:
    lengths = np.array([diagonal, diagonal, 1, 1])
    J = np.moveaxis(np.array(state.J), -1, 0).reshape(-1, AXES, AXES) * lengths / lengths[:, None]
    kept, rows = np.array(state.kept), []
    for vertices in range(1, int(kept[found].max(initial=0)) + 1):
        chains = J[found & (kept == vertices)]
        if len(chains):
            conditions = np.linalg.cond(chains)
            median, high = np.quantile(conditions, [0.5, 0.99])
            rows.append(ChainConditions(vertices, len(chains), float(median), float(high), float(conditions.max())))
    return rows


#: What a spread is taken of.
QUANTITIES = ("gradient", "change", "curvature", "length")


@dataclass(frozen=True)
class Conditioning:
    """What was measured of each parameter, from `samples` gradients of `spp` samples per pixel, of the run's `seed`.

    `chains` are those of Jacobians, where parameters move light.
    """

    rows: list[Sensitivity]
    samples: int
    spp: int
    seed: int
    chains: list[ChainConditions] = field(default_factory=list)

    def spread(self, quantity: str) -> float | None:
        """The largest value of one of QUANTITIES over its smallest, of those above 0; None of fewer than two.

        That of `curvature` is the condition number of the Gauss-Newton matrix's diagonal, by parameters.
        """
        values = [getattr(row, quantity) for row in self.rows]
        positive = [value for value in values if value is not None and value > 0]
        return max(positive) / min(positive) if len(positive) > 1 else None

    def to_json(self) -> dict[str, Any]:
        """As a mapping for JSON."""
        values = asdict(self)
        rows, chains, spread = values.pop("rows"), values.pop("chains"), map(self.spread, QUANTITIES)
        return values | {"parameters": rows, "spread": dict(zip(QUANTITIES, spread, strict=True)), "chains": chains}


def measure_conditioning(problem: Problem, samples: int) -> Conditioning:
    """Measure every parameter of `problem`, which has its targets, where it stands; at least 2 `samples`."""
    run = problem.config.run
    return Conditioning(measure_sensitivities(problem, samples), samples, run.spp, run.seed, measure_chains(problem))
