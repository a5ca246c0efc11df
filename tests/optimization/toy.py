"""A problem whose image is its parameter, for tests of the loop."""

from __future__ import annotations

import types

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.config.loader import load
from reslrb_cli.optimization.optimizers import Optimizer
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.views import View, make_loss

CONFIG = """
scene: {file: scene.xml}
target: {render: {}}
parameters: [{key: albedo}]
optimizer: {type: sgd, learning_rate: 2.0, schedule: cosine}
run: {iterations: 20, spp: 3, seed: 5}
"""


class Params(dict):
    """Substitute for `mi.SceneParameters` without a scene."""


def make_problem(tmp_path, views=1, sets=(), keys=("albedo",)):
    path = tmp_path / "config.yaml"
    path.write_text(CONFIG)
    config = load(path, list(sets))
    values = {key: dr.full(mi.TensorXf, 0.5, (2, 2, 3)) for key in keys}
    optimizer = Optimizer(
        config.optimizer.type,
        config.optimizer.learning_rate,
        config.optimizer.own_options(),
        values,
        dict.fromkeys(keys),
        dict.fromkeys(keys, (0.0, 1.0)),
    )
    params = Params(values)
    selection = types.SimpleNamespace(keys=list(keys), params=params, array=lambda key: np.array(params[key]))
    selection.hand_over, selection.collect = params.update, lambda: None
    problem = Problem(
        config=config,
        scene=None,
        views=[View(n, make_loss("l2"), 1 / views, dr.full(mi.TensorXf, 0.8, (2, 2, 3))) for n in range(views)],
        selection=selection,
        integrator=None,
        optimizer=optimizer,
        truth={key: np.full((2, 2, 3), 0.8) for key in keys},
        masks={key: np.array([[True, False], [True, True]]) for key in keys},
    )
    problem.apply()
    return problem
