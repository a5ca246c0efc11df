"""Shards: unbiased in every form, equal sums in any order, and refused where they are invalid."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from agreement import compare
from cli.tiny import EYES, KEY, scene_seen, write_experiment
from runs.going_on import one_thread
from turns import a_few

from reslrb_cli.config.loader import dump, load, loads
from reslrb_cli.errors import ConfigError
from reslrb_cli.optimization import loop, shards
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.sensitivity import sample_gradient, take_gradient
from reslrb_cli.optimization.state import guiding_of
from reslrb_cli.records.clock import peak_mib, reset_peak

ROUNDS = "run.adjoint=auto"
#: Two views, each with an exposure of its own.
TWO_VIEWS = "views=[{sensor: 0, weight: 3, exposure: 1}, {sensor: 1, exposure: auto}]"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Folder with the tiny experiment with three sensors."""
    write_experiment(tmp_path, scene_seen(*EYES))
    return tmp_path


def make(folder: Path, *sets: str) -> Problem:
    return assemble(load(folder / "tiny.yaml", list(sets)))


def rows(problem: Problem, iterations: int) -> np.ndarray:
    """Return the gradients of several iterations at the same values, of shape (iterations, entries). Each row holds all
    parameters.
    """
    found = []
    for iteration in range(iterations):
        shards.add_gradient(problem, iteration)
        found.append(np.concatenate(list(take_gradient(problem).values())))
    return np.array(found, np.float64)


#: Gradients of `independent` that were computed before, by the loss and the targets.
FOUND: dict[tuple[Any, ...], np.ndarray] = {}


def independent(problem: Problem) -> np.ndarray:
    """Return the gradients of 16 steps with `run.adjoint: independent` and without shards, of shape (16, entries).

    With 256 samples each, their mean has a fifth of the variance, or less, of the means that are compared with it.
    """
    views = [(view.sensor, view.share, np.array(view.target).tobytes()) for view in problem.views]
    of = (str(problem.config.loss), *views)
    if of not in FOUND:
        found = []
        for round in range(16):
            sample_gradient(problem, problem.integrator, round, "reference", 256)
            found.append(np.concatenate(list(take_gradient(problem).values())))
        FOUND[of] = np.array(found, np.float64)
    return FOUND[of]


# --- unbiased ---------------------------------------------------------------------------------------------------------

WAYS = {
    "2 in rounds": (["run.spp=2", "run.shards=2", ROUNDS], 250),
    "4 in rounds": (["run.spp=4", "run.shards=4", ROUNDS], 200),
    "16 in rounds": (["run.spp=16", "run.shards=16", ROUNDS], 100),
    "2 in batches": (["run.spp=4", "run.shards=2", "run.batches=2", "run.adjoint=batched"], 200),
    "4 by themselves": (["run.spp=4", "run.shards=4", "run.adjoint=independent"], 200),
    "guided": (["run.spp=4", "run.shards=4", ROUNDS, "integrator.guiding=on"], 120),
    "relative": (["run.spp=4", "run.shards=4", ROUNDS, "loss.type=relative_l2"], 200),
}


@pytest.mark.parametrize("way", a_few(WAYS, ["2 in rounds"]))
def test_gradients_are_unbiased(folder, way):
    """The reference consists of steps of 256 samples with a second set for dL/dI. Each shard has one or two samples per
    pixel.
    """
    sets, iterations = WAYS[way]
    loss = [each for each in sets if each.startswith("loss")]
    problem, plain = make(folder, *sets), make(folder, "run.adjoint=independent", *loss)
    plain.views[0].see(np.array(problem.views[0].target))  # a guided problem renders another target
    found = compare(rows(problem, iterations), independent(plain), block=None)
    assert found, found


@pytest.mark.long
def test_a_single_set_of_samples_would_be_found(folder):
    """The comparison of `test_gradients_are_unbiased` has enough power to detect the bias of a single set."""
    reference = independent(make(folder, "run.adjoint=independent"))
    found = compare(rows(make(folder, "run.spp=2", "run.shards=2", "run.adjoint=correlated"), 250), reference, None)
    assert not found, found


@pytest.mark.long
def test_views_and_exposures_are_unbiased(folder):
    """Two views with different weights have two shards each. The second view's exposure is recovered."""
    reference = independent(make(folder, TWO_VIEWS, "run.adjoint=independent"))
    found = compare(rows(make(folder, TWO_VIEWS, "run.spp=2", "run.shards=4", ROUNDS), 180), reference, block=None)
    assert found, found


# --- one sum ----------------------------------------------------------------------------------------------------------


def shuffled(problem: Problem, function: Callable[..., Any], work: Any) -> Iterator[tuple[int, Any]]:
    """Compute even shards from the last to the first, then odd ones. Compute each twice, the second time from a pickled
    task.
    """
    for place in sorted(range(len(work)), key=lambda place: (place % 2, -place)):
        task, *more = work[place]
        function(problem, task, *more)
        yield place, pickle.loads(pickle.dumps(function(problem, pickle.loads(pickle.dumps(task)), *more)))


@pytest.mark.parametrize(
    "sets",
    [
        pytest.param(["run.spp=8", "run.shards=4", ROUNDS, "target.exposure=1.5"], marks=pytest.mark.long),
        ["run.spp=16", "run.shards=4", "run.adjoint=batched", "integrator.guiding=on"],
        pytest.param(
            ["run.spp=4", "run.shards=2", "views=[{sensor: 0}, {sensor: 1}, {sensor: 2}]", "integrator.guiding=on"],
            marks=pytest.mark.long,
        ),
        pytest.param(["run.spp=8", "run.shards=4", ROUNDS, TWO_VIEWS.replace("auto", "2")], marks=pytest.mark.long),
    ],
)
def test_the_order_of_evaluation_does_not_matter(folder, sets):
    """Results are equal bit by bit, over iterations in which tables learn."""
    sets, results = [*sets, "run.iterations=3"], []
    for engine in (None, shuffled):
        problem = make(folder, *sets)
        object.__setattr__(problem, "engine", engine)
        with one_thread():
            records = list(loop.optimize(unmeasured(problem)))
        guiding = guiding_of(problem)
        learned = {} if guiding is None else guiding.state()[1]
        results.append(([record.loss for record in records], problem.values(), learned))
    (losses, values, learned), (other_losses, other_values, other_learned) = results
    assert losses == other_losses
    assert values[KEY].tobytes() == other_values[KEY].tobytes()
    assert bool(learned) == ("integrator.guiding=on" in sets)
    assert all(array.tobytes() == other_learned[name].tobytes() for name, array in learned.items())


def unmeasured(problem: Problem) -> Problem:
    """Return the problem without true values, which these tests do not use."""
    problem.truth.clear()
    return problem


def test_shards_of_whole_views_sum_up(folder):
    """The sum equals the sum of separate steps of each view with the same samples."""
    problem = make(folder, "views=[{sensor: 0, weight: 2}, {sensor: 1}, {sensor: 2}]", "run.spp=8", "run.shards=2")
    tasks = shards.make_tasks(problem, 3)
    assert [[part.sensor for part in task.parts] for task in tasks] == [[0], [1, 2]]
    expected = np.zeros(48)
    loss = 0.0
    for part in (part for task in tasks for part in task.parts):
        view = next(view for view in problem.views if view.sensor == part.sensor)
        step = loop.gradient_step(
            problem.integrator, problem.scene, part.sensor, view.objective, seed=part.seed,
            **problem.config.step_options(), params=problem.selection.params,
        )  # fmt: skip
        expected += take_gradient(problem)[KEY]
        loss += float(step.loss[0])
    found, _ = shards.add_gradient(problem, 3)
    assert found == pytest.approx(loss, rel=1e-5)
    np.testing.assert_allclose(take_gradient(problem)[KEY], expected, rtol=1e-4, atol=1e-6 * np.abs(expected).max())


def test_shares_sum_up_to_a_gradient_at_their_mean(folder):
    """In one round, the gradient is the mean of the shards' gradients. The loss is that of their mean image."""
    problem = make(folder, "run.spp=8", "run.shards=4", "run.adjoint=independent")
    found = [shards.shard_gradient(problem, task) for task in shards.make_tasks(problem, 0)]
    mean = np.mean([one.images[0] for one in found], axis=0, dtype=np.float64)
    loss, _ = shards.add_gradient(problem, 0)
    assert loss == pytest.approx(float(problem.views[0].objective(mi.TensorXf(mean.astype(np.float32)))[0]), rel=1e-5)
    expected = np.mean([one.gradients[KEY] for one in found], axis=0).ravel()
    np.testing.assert_allclose(take_gradient(problem)[KEY], expected, rtol=1e-4, atol=1e-6 * np.abs(expected).max())


def test_no_two_shards_share_a_seed(folder):
    problem = make(folder, "views=[{sensor: 0}, {sensor: 1}]", "run.spp=32", "run.shards=32", ROUNDS)
    tasks = [task for iteration in range(20) for task in shards.make_tasks(problem, iteration)]
    seeds = [part.seed for task in tasks for part in task.parts]
    assert len(seeds) == 20 * 32
    assert len(set(seeds)) == len(seeds)
    images = [shards.shard_image(problem, task) for task in tasks[:4]]
    assert len({image.tobytes() for image in images}) == 4


def test_a_subset_of_the_views_is_sharded(folder):
    """Each shard has dL/dI at the mean image of the other shards. The drawn view counts for all three views."""
    views = "views=[{sensor: 0}, {sensor: 1}, {sensor: 2}]"
    problem = make(folder, views, "run.views_per_iteration=1", "run.spp=8", "run.shards=4", ROUNDS)
    for iteration in range(4):
        [(view, scale)] = problem.drawn(iteration)
        assert scale == 3
        tasks = shards.make_tasks(problem, iteration)
        assert [(*part[:2], task.spp) for task in tasks for part in task.parts] == [(view.sensor, 3, 2)] * 4
        images, expected = [shards.shard_image(problem, task).astype(np.float64) for task in tasks], np.zeros(48)
        for task, image in zip(tasks, images, strict=True):
            others = (sum(images) - image) / 3
            delta = scale / 3 * 2 * (others - np.array(view.target)) / others.size
            leaf = problem.optimizer[KEY]
            dr.accum_grad(leaf, dr.full(type(leaf), 1, leaf.shape))  # must not show in the result
            expected += shards.shard_gradient(problem, task, delta).gradients[KEY].ravel() / 4
        shards.add_gradient(problem, iteration)
        np.testing.assert_allclose(take_gradient(problem)[KEY], expected, rtol=1e-4, atol=1e-6 * np.abs(expected).max())


def test_sums_are_in_double_precision():
    total = shards.Sum()
    for value in (1.0, 2.0**-40, -1.0):
        total.add(np.full((2, 2), value, np.float32), 0.5)
    np.testing.assert_array_equal(total.total, 2.0**-41)
    assert list(shards.in_order([(2, "c"), (0, "a"), (1, "b")])) == ["a", "b", "c"]


def test_without_shards_nothing_changes(folder, monkeypatch):
    """Without shards, the loop, its seeds and its options stay as before."""
    monkeypatch.setattr(loop, "add_gradient", lambda *args: pytest.fail("shards"))
    given, step = [], loop.gradient_step
    monkeypatch.setattr(loop, "gradient_step", lambda *args, **kept: given.append(kept) or step(*args, **kept))
    problem = make(folder, "run.spp=8")
    list(loop.optimize(unmeasured(problem)))
    assert given[2]["seed"] == loop.seed(0, 2, 0, "image")
    assert {name: given[0][name] for name in ("spp", "adjoint", "batches")} == {
        "spp": 8, "adjoint": "batched", "batches": 4,
    }  # fmt: skip


def test_memory_does_not_grow_with_the_shards(folder):
    """The peak memory of the backend's allocator does not grow from 2 to 16 shards of equal size."""
    peaks = []
    for count in (2, 16):
        problem = make(folder, f"run.spp={64 * count}", f"run.shards={count}", ROUNDS, "scene.size=[32, 32]")
        rows(problem, 1)
        reset_peak()
        rows(problem, 1)
        peaks.append(peak_mib(dr.backend_v(mi.Float)))
    assert peaks[1] < 1.05 * peaks[0]


def test_passes_divide_a_shard(folder):
    sets = [
        "run.spp=128",
        "run.shards=4",
        "run.adjoint=correlated",
        "integrator.estimator=event",
        "scene.size=[64, 64]",
    ]
    split = make(folder, *sets, "integrator.samples_per_pass=8")
    assert split.config.set_spp == 32
    assert np.isfinite(rows(split, 2)).all()


@pytest.mark.parametrize("adjoint", ["auto", "independent"])
def test_non_finite_values_are_counted_in_each_shard(folder, adjoint):
    problem = make(folder, "run.spp=8", "run.shards=4", f"run.adjoint={adjoint}")
    target = np.array(problem.views[0].target)
    target[2, 5, 1] = np.nan
    problem.views[0].see(target)
    _, refused = shards.add_gradient(problem, 0)
    [(sensor, found)] = refused
    assert (sensor, int(found.count[0]), found.entry()) == (0, 4, (5, 2, 1))
    assert np.isfinite(take_gradient(problem)[KEY]).all()


# --- settings ---------------------------------------------------------------------------------------------------------

VIEWS = "views=[{sensor: 0}, {sensor: 1}, {sensor: 2}]"
CAMERAS = "scene.cameras=transforms.json"
SETTLED = [
    (["run.spp=16"], (1, 1, "batched", False)),
    (["run.spp=16", ROUNDS], (1, 1, "batched", False)),
    (["run.spp=16", "run.shards=4"], (4, 4, "independent", True)),
    (["run.spp=16", "run.shards=4", ROUNDS], (4, 4, "independent", True)),
    (["run.spp=16", "run.shards=4", "run.adjoint=batched"], (4, 4, "batched", False)),
    (["run.spp=16", "run.shards=16", "run.adjoint=independent"], (16, 16, "independent", False)),
    (["run.spp=16", "run.shards=auto"], (16, 16, "independent", True)),
    (["run.spp=16", "run.shards=auto", "run.adjoint=batched"], (4, 4, "batched", False)),
    (["run.spp=24", "run.shards=auto", "integrator.samples_per_pass=2"], (4, 4, "independent", True)),
    ([VIEWS, "run.spp=16", "run.shards=2", ROUNDS], (2, 1, "batched", False)),
    ([VIEWS, "run.spp=16", "run.shards=6", ROUNDS], (6, 2, "independent", True)),
    ([VIEWS, "run.spp=16", "run.shards=auto"], (12, 4, "independent", True)),
    ([VIEWS, "run.held_out=[1]", "run.spp=16", "run.shards=4"], (4, 2, "independent", True)),
    ([CAMERAS, "run.spp=16", "run.shards=3", ROUNDS], (3, 1, "batched", False)),
    ([CAMERAS, "run.spp=16", "run.shards=auto"], (16, 1, "batched", False)),
]


@pytest.mark.parametrize(("sets", "settled"), SETTLED)
def test_shards_follow_from_the_settings(folder, sets, settled):
    config = load(folder / "tiny.yaml", sets)
    assert (config.shards, config.shares, config.adjoint, config.in_rounds) == settled
    assert loads(dump(config), str(folder / "tiny.yaml")) == config


BAD = [
    (["run.shards=0"], "run.shards"),
    (["run.shards=some"], "run.shards: must be a number of shards, or `auto`"),
    (["run.spp=6", "run.shards=4"], "run.shards: 4 per view do not divide run.spp, 6"),
    ([VIEWS, "run.shards=4"], "run.shards: is 4; with 3 views in an iteration it must be at most 3, or a multiple"),
    (["run.spp=8", "run.shards=4", "run.adjoint=batched"], "run.batches: 4 does not divide the samples of a shard"),
    (["run.spp=8", "run.shards=4", "integrator.samples_per_pass=4"], None),
    (["run.spp=24", "run.shards=4", "integrator.samples_per_pass=4"], "integrator.samples_per_pass: 4 does not divide"),
]


@pytest.mark.parametrize(("sets", "message"), BAD)
def test_invalid_shards_are_refused(folder, sets, message):
    if message is None:
        make(folder, *sets)
        return
    with pytest.raises(ConfigError) as error:
        make(folder, *sets)
    assert message in str(error.value)
    assert len(str(error.value).splitlines()) == 1
