"""Textures that compensate for small parameters or for each other: simulated maps with known errors, and runs on two
small scenes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from kit import area, scene, sensor, shape
from optimization.judged import CONFIG, Toy, run

from reslrb_cli.config.loader import load
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.uncertainty import coupling, measuring
from reslrb_cli.optimization.uncertainty.coupling import (
    MOST_NOISE,
    Maps,
    _cells,
    followed,
    make_maps,
    measure_maps,
    with_followed,
)
from reslrb_cli.optimization.uncertainty.curvature import (
    EntryCurvature,
    LossCurvature,
    ParameterChange,
    ParameterDirection,
    plan_changes,
    row_of,
)
from reslrb_cli.optimization.uncertainty.posterior import Measured
from reslrb_cli.optimization.uncertainty.verdicts import weigh
from reslrb_cli.statistics import rms

CELLS = 400
KEYS = ("colour", "roughness", "metallic")
#: The key of each map: a colour has three.
CHANNELS = ("colour", "colour", "colour", "roughness", "metallic")


SIGMA, PRIOR, COUNT = 0.05, 12**-0.5, 4
PLACES = {key: np.nonzero(np.equal(CHANNELS, key))[0] for key in KEYS}


def by_key(rows: np.ndarray) -> dict[str, np.ndarray]:
    """Return the entries of each parameter from the last two axes of `rows` (..., n, K) as flat arrays."""
    return {key: rows[..., maps].reshape(*rows.shape[:-2], -1) for key, maps in PLACES.items()}


def simulate(observations: int, noise: float) -> tuple[Maps, dict[str, Measured], dict[str, float]]:
    """Return maps of `CELLS` cells with an image of `observations` values each, their measurements, and the root mean
    square error of each parameter. `noise` is the relative noise of one sample of M.
    """
    random, K = np.random.default_rng(0), len(CHANNELS)
    J = random.normal(size=(CELLS, observations, K)) * np.exp(0.5 * random.normal(size=(CELLS, 1, 1)))
    J *= np.array([1.0, 0.8, 0.9, 0.4, 0.6])
    M = np.einsum("nok,nol->nkl", J, J)
    covariance = np.linalg.inv(M / SIGMA**2 + np.eye(K) / PRIOR**2)
    errors = np.array([random.multivariate_normal(np.zeros(K), each) for each in covariance])
    image = np.einsum("nok,nk->no", J, errors) + SIGMA * COUNT**0.5 * random.normal(size=(COUNT, CELLS, observations))
    gradients, value = by_key(np.einsum("nok,bno->bnk", J, image)), by_key(np.full((CELLS, K), 0.5))
    size = np.sqrt(np.einsum("nkk->nk", M))
    samples = M + noise * (size[:, :, None] * size[:, None, :]) * random.normal(size=(2, *M.shape))
    cells = {key: (np.tile(maps, CELLS), np.repeat(np.arange(CELLS), len(maps))) for key, maps in PLACES.items()}
    names = [(key, number) for key, maps in PLACES.items() for number in range(len(maps))]
    found = make_maps(names, 0.5 * (samples + samples.swapaxes(2, 3)), np.full((CELLS, K), 0.5), cells)
    measured = {
        key: Measured(value[key], (0.0, 1.0), 0.5, gradients[key], value[key], False, value[key]) for key in KEYS
    }
    return found, measured, {key: rms(row) for key, row in by_key(errors).items()}


@pytest.mark.parametrize("noise", [0.0, 0.1, 0.3])
@pytest.mark.parametrize(("observations", "is_determined"), [(2, False), (3, False), (4, False), (8, True), (24, True)])
def test_the_spread_of_maps_contains_what_other_maps_make_up_for(observations, is_determined, noise):
    """Five unknown values of a cell need at least five observations."""
    maps, measured, errors = simulate(observations, noise)
    left = maps.undetermined(measured, dict.fromkeys(KEYS, 0.0))
    for key in KEYS:
        h = np.einsum("nkk->nk", maps.matrix)[:, PLACES[key]]
        alone = np.sqrt(np.mean(1 / (h / SIGMA**2 + 1 / PRIOR**2)))  # if the other maps were known
        spread = np.sqrt(alone**2 + left[key].mean())
        assert errors[key] < (1.3 if noise <= MOST_NOISE else 1.4) * spread
        if noise <= MOST_NOISE:  # more noise hides small eigenvalues, and spreads are too large
            assert errors[key] > 0.6 * spread
            assert (spread > 2 * alone) is not is_determined
        assert maps.partner(key) in set(KEYS) - {key}


@pytest.mark.parametrize("observations", [3, 24])
def test_verdicts_name_the_map_that_makes_up_for_another(observations):
    maps, measured, _ = simulate(observations, 0.0)
    by_entry = {key: EntryCurvature(np.einsum("nkk->nk", maps.matrix)[:, PLACES[key]].ravel(), None) for key in KEYS}
    none = np.zeros((0, 0))
    alone, found = (weigh(measured, [], none, none, by_entry, None, each) for each in ((), [maps]))
    for key in KEYS:
        assert alone[key].partner is None
        assert found[key].spread[0] >= alone[key].spread[0]
    judged = found["metallic"].verdict, found["metallic"].partner in ("colour", "roughness")
    assert judged == (("not determined", True) if observations == 3 else ("settled", False))


def test_a_texture_that_follows_makes_a_value_uncertain():
    """Without the texture, the curvature of the value is 100. If the texture follows, it is almost zero."""
    g = 0.1 * np.random.default_rng(5).normal(size=(12, 1))
    own = {"tint": Measured(np.full(1, 0.5), (0.0, 1.0), 0.5, g, np.full(1, 1e-3), True, np.full(1, 0.3))}
    one, zero = np.ones((1, 1)), np.zeros((1, 1))
    alone = weigh(own, [ParameterDirection("tint", np.ones(1), None, 0)], 100 * one, zero, {})["tint"]
    direction = ParameterDirection("tint", np.ones(1), None, 0, "floor")
    found = weigh(own, [direction], 1e-3 * one, zero, {}, np.array([100.0]))["tint"]
    assert (alone.verdict, found.verdict, found.partner) == ("settled", "not determined", "floor")
    assert found.spread[0] > 100 * alone.spread[0]


def make_valley(size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the Jacobian (pixels, 1 + size) of a tint and of texels that the image shows through a blur. A third of
    the pixels shows texels without the tint.
    """
    random, at = np.random.default_rng(3), np.linspace(0, size - 1, 3 * size)
    texels = np.exp(-0.5 * (np.subtract.outer(at, np.arange(size)) / 0.7) ** 2)
    tint = np.where(at < 2 * size / 3, texels @ random.uniform(0.5, 1, size), 0.0)
    return np.column_stack([tint, texels]), random.uniform(0.3, 0.9, size)


@pytest.fixture
def valley(llvm, monkeypatch):
    """A tint and texels with the curvature of `make_valley`, in place of a problem, and a change of the tint."""
    J, values = make_valley(24)
    H = J.T @ J
    rows = {"tint": np.full(1, 0.5), "floor": values}
    arrays = {"tint": np.full(1, 0.5), "floor": values.reshape(4, 6, 1)}
    specs = dict.fromkeys(rows, SimpleNamespace(bounds=(-10.0, 10.0)))
    selection = SimpleNamespace(array=lambda key: arrays[key], specs=specs)
    problem = SimpleNamespace(selection=selection, optimizer={key: mi.TensorXf(row) for key, row in rows.items()})

    def products(change):
        moved = [(np.ravel(change.values.get(key, row)) - row) / change.amount for key, row in rows.items()]
        product = H @ np.concatenate(moved)
        return [{"tint": (product[:1],) * 2, "floor": (product[1:],) * 2}]

    monkeypatch.setattr(coupling, "separates", lambda problem, key: True)
    changes = [
        ParameterChange({"tint": np.full(1, 0.55)}, 0.05, [ParameterDirection("tint", np.ones(1), None, 0)]),
        ParameterChange({"floor": 0.95 * arrays["floor"]}, -0.05, [ParameterDirection("floor", values, 0)]),
    ]
    return SimpleNamespace(problem=problem, products=products), changes, H, rows


def test_the_search_finds_the_texels_that_make_up_for_a_tint(valley):
    """The curvature that remains is at most 1.3 times the Schur complement of H. One step leaves more."""
    curvature, changes, H, _ = valley
    free = {"floor": np.ones(24, dtype=bool)}
    least = H[0, 0] - H[0, 1:] @ np.linalg.solve(H[1:, 1:], H[1:, 0])
    left = []
    for ends in (iter([True, True, False]), iter([True] * 20)):
        (change,) = followed(curvature, changes, free, lambda ends=ends: next(ends))
        (direction,) = change.directions
        d = np.concatenate([[1.0], direction.followers["floor"]])
        left.append(d @ H @ d)
        np.testing.assert_allclose(change.values["floor"].ravel(), make_valley(24)[1] + 0.05 * d[1:], rtol=1e-4)
        assert direction.partner == "floor"
    assert least < left[1] < 1.3 * least < left[0] < 0.5 * H[0, 0]
    free["floor"][:12] = False
    (change,) = followed(curvature, changes, free, lambda: True)
    assert not change.directions[0].followers["floor"][:12].any()


@pytest.mark.parametrize("recorded", [True, False])
def test_offsets_of_texels_do_not_change_that_of_the_tint_along_the_valley(recorded, valley):
    """The texels are off. The gradient by the tint alone pulls it away from its true value. The texels are uncertain
    by their part of the tint's spread.
    """
    curvature, changes, H, rows = valley
    (change,) = followed(curvature, changes, {"floor": np.ones(24, dtype=bool)}, lambda: True)
    (direction,) = change.directions
    random, x = np.random.default_rng(4), np.concatenate([rows["tint"], rows["floor"]])
    off = np.concatenate([[0.02], 0.04 * random.normal(size=24)])
    root = np.linalg.cholesky(H)
    series = H @ off + 0.01 * random.normal(size=(44, 25)) @ root.T
    last = np.stack([series[:40], np.tile(x, (40, 1))], axis=1) if recorded else None
    tint = Measured(x[:1], (0.0, 1.0), 0.5, series[40:, :1], np.full(1, 1e-3), True, np.full(1, 0.3),
                    last=None if last is None else last[:, :, :1])  # fmt: skip
    floor = Measured(x[1:], (0.0, 1.0), 0.5, series[40:, 1:], np.full(24, 1e-3), False, np.full(24, 0.3),
                     rows=None if last is None else last[:, :, 1:])  # fmt: skip
    measured = {"tint": tint, "floor": floor}
    d = np.concatenate([[1.0], direction.followers["floor"]])
    S = np.array([[d @ H @ d]])
    by_entry = {"floor": EntryCurvature(np.diag(H)[1:], None)}
    zero = np.zeros((1, 1))
    found = weigh(measured, [direction], S, zero, by_entry, np.diag(H)[:1])
    assert found["tint"].to_go[0] == pytest.approx(0.02, abs=0.03)
    alone = weigh(measured, [replace(direction, followers={})], S, zero, by_entry, np.diag(H)[:1])
    assert abs(alone["tint"].to_go[0]) > 0.1
    known = weigh(measured, [replace(direction, followers={})], 1e6 * S, zero, by_entry)
    added = found["floor"].spread[0] ** 2 - known["floor"].spread[0] ** 2
    assert added == pytest.approx(found["tint"].spread[0] ** 2 * np.mean(np.square(d[1:])), rel=1e-3)


def test_noise_of_the_measurement_couples_no_maps():
    """The maps are independent, and the samples of M are mostly noise."""
    random = np.random.default_rng(1)
    M = np.eye(3) * np.exp(0.3 * random.normal(size=(CELLS, 1, 1)))
    samples = M + random.normal(size=(2, *M.shape))
    found = make_maps([], 0.5 * (samples + samples.swapaxes(2, 3)), np.ones((CELLS, 3)), {})
    assert found.noise == pytest.approx(0.6, abs=0.1)
    assert np.abs(found.matrix - np.eye(3)).mean() < 0.1
    np.testing.assert_allclose(found.matrix, found.matrix.swapaxes(1, 2), atol=1e-12)


def test_a_map_without_curvature_adds_nothing():
    """Nothing is added to the spread of the other map, and nothing is divided by zero."""
    M = np.zeros((2, CELLS, 2, 2))
    M[:, :, 0, 0] = 4.0
    places = {key: (np.full(CELLS, k), np.arange(CELLS)) for k, key in enumerate("ab")}
    g, value = np.random.default_rng(2).normal(size=(4, CELLS)), np.full(CELLS, 0.5)
    rows = {"a": g, "b": 0 * g}
    measured = {key: Measured(value, (0.0, 1.0), 0.5, rows[key], value, False, value) for key in rows}
    maps = make_maps([("a", 0), ("b", 0)], M, np.ones((CELLS, 2)), places)
    left = maps.undetermined(measured, {"a": 0.0, "b": 0.0})
    np.testing.assert_allclose([left["a"], left["b"]], 0.0, atol=1e-12)


MIRROR = """<bsdf type="principled"><rgb name="base_color" value="0.8, 0.6, 0.6"/>
    <float name="metallic" value="1"/><float name="roughness" value="0.05"/></bsdf>"""
FLOOR, POSTER, TINT = "floor.bsdf.reflectance.data", "poster.bsdf.reflectance.data", "mirror.bsdf.base_color.value"


def bitmap(name: str, file: str) -> str:
    return (f'<texture type="bitmap" name="{name}"><string name="filename" value="{file}"/>'
            '<boolean name="raw" value="true"/></texture>')  # fmt: skip


def write(folder, text: str) -> None:
    (folder / "scene.xml").write_text(text)
    (folder / "toy.yaml").write_text(CONFIG)


def write_map(folder, name: str, *size: int, low: float = 0.2, high: float = 0.8) -> None:
    values = np.random.default_rng(len(name)).uniform(low, high, size).astype(np.float32)
    mi.Bitmap(values).write(str(folder / name))


def assembled(folder, keys: Sequence[str], *settings: str) -> Problem:
    """Return the problem with the true values of the scene in `folder`, and with targets."""
    parameters = ", ".join(f"{{key: {key}, bounds: [0, 1]}}" for key in keys)
    problem = assemble(load(folder / "toy.yaml", [f"parameters=[{parameters}]", "target.render.spp=64", *settings]))
    problem.apply()
    return problem


@pytest.mark.parametrize("key", [FLOOR, POSTER])
def test_texels_that_only_a_mirror_shows_make_up_for_its_tint(key, llvm, tmp_path):
    """The image shows only their product. Texels beside the mirror, which the mirror does not show, change nothing."""
    write_map(tmp_path, "floor.exr", 8, 8, 3)
    textured = f'<bsdf type="diffuse">{bitmap("reflectance", "floor.exr")}</bsdf>'
    write(tmp_path, scene(
        sensor("0, 1, 3", "0, 0.5, 0" if key == FLOOR else "0, 1, 0", size=24, fov=30 if key == FLOOR else 45),
        shape("rectangle", "mirror", MIRROR, place='<scale value="0.6"/><translate y="0.6" z="-0.8"/>'),
        shape("rectangle", "floor", textured, place='<rotate x="1" angle="-90"/><scale value="4"/>'),
        shape("rectangle", "poster", textured, place='<scale value="0.5"/><translate y="1.8" z="-0.8"/>'),
        '<emitter type="constant"><rgb name="radiance" value="1"/></emitter>',
    ))  # fmt: skip
    problem = assembled(tmp_path, [key, TINT])
    curvature, free = LossCurvature(problem, 64), {key: np.ones(192, dtype=bool)}
    plan = plan_changes(problem, dict.fromkeys([key, TINT], 0.5), 0.05)
    extra = followed(curvature, plan, free, lambda: True)
    again = LossCurvature(problem, 64, round=1)
    directions, H, _ = again.along([*plan, *extra], lambda: True)
    places = with_followed(directions, H, 6)
    chosen = [directions[place] for place in places]
    shares = np.diag(H)[places[:3]] / np.diag(H)[:3]
    # Verdicts use lower eigenvalues.
    left = again.for_verdicts(chosen, places)
    np.testing.assert_allclose(left, left.T, rtol=1e-6)
    assert np.all(np.diag(left) > 0.5 * np.diag(H)[places])
    assert [each.partner for each in chosen[3:]] == [None] * 3
    if key == FLOOR:
        assert np.all(shares < 0.5), shares
        assert [each.partner for each in chosen[:3]] == [FLOOR] * 3
    else:
        assert np.all(shares > 0.9), shares
    # Without time for the search, the texels move by one step. Without any time, nothing changes.
    times = iter([True, True, False])
    (short,) = followed(curvature, plan, free, lambda: next(times))
    assert len(short.directions) == 3
    assert followed(curvature, plan, free, lambda: False) == []
    assert with_followed(directions[:6], H[:6, :6], 6) == list(range(6))
    # Entries whose curvature is mostly noise hardly follow.
    rows = {key: (np.full(192, 1.0), np.full(192, -0.9)), TINT: (np.ones(3), np.ones(3))}
    noisy = SimpleNamespace(problem=problem, products=lambda change: [rows] * len(change.directions))
    times = iter([True, True, False])
    (first, *_) = followed(noisy, plan, free, lambda: next(times))
    assert 0 < np.abs(first.values[key] - problem.selection.array(key)).max() < 0.05 * first.amount


MAPS = {f"sample.bsdf.{name}.data": name for name in ("base_color", "roughness", "metallic")}


def write_sample(folder, side: int, size: int) -> None:
    for name, channels in zip(MAPS.values(), (3, 1, 1), strict=True):
        write_map(folder, f"{name}.exr", side, side, channels)
    textures = "".join(bitmap(name, f"{name}.exr") for name in MAPS.values())
    write(folder, scene(
        sensor("0, 3, 2.5", size=size, fov=40),
        shape("rectangle", "sample", f'<bsdf type="principled">{textures}</bsdf>', place='<rotate x="1" angle="-90"/>'),
        shape("rectangle", "lamp", area("12, 12, 12"),
              place='<rotate x="1" angle="90"/><scale value="0.6"/><translate x="1" y="3"/>'),
        '<emitter type="constant"><rgb name="radiance" value="0.3"/></emitter>',
    ))  # fmt: skip


def test_maps_have_the_curvature_of_differences_by_texel(llvm, tmp_path, monkeypatch):
    """The reference changes one texel at a time. A texel's curvature contains that of every second texel."""
    write_sample(tmp_path, 3, 16)
    keys = list(MAPS)[1:]
    problem = assembled(tmp_path, keys)
    (maps,), left = measure_maps(LossCurvature(problem, 512), keys, 0.05, 512, lambda: True)
    assert not left
    assert maps.noise < MOST_NOISE
    assert [name for name, _ in maps.names] == keys
    half, values = np.indices((3, 3)).sum(axis=0).ravel() % 2, [row_of(problem, key) for key in keys]
    changes = []
    for key, value in zip(keys, values, strict=True):
        for texel in range(9):
            vector = np.eye(9)[texel] * value
            changed = (value - 0.05 * vector).reshape(3, 3, 1)
            changes.append(ParameterChange({key: changed}, -0.05, [ParameterDirection(key, vector)]))
    curvature = LossCurvature(problem, 512, of_target=False, round=5)
    curvature.along(changes, lambda: True)
    a, b = curvature.slopes
    H = 0.5 * (a @ b.T + b @ a.T).reshape(2, 9, 2, 9)
    expected = np.einsum("kilj,ij->ikl", H, np.equal.outer(half, half).astype(float))
    expected = 0.5 * (expected + expected.swapaxes(1, 2))
    size = np.abs(np.array(values).T)
    expected /= size[:, :, None] * size[:, None, :]
    scale = np.sqrt(np.einsum("ikk->k", expected) / 9)
    error = (maps.matrix - expected) / np.outer(scale, scale)
    assert rms(error) < 2.5 * maps.noise, error
    assert np.abs(expected / np.outer(scale, scale))[:, 0, 1].max() > 0.3
    assert measure_maps(curvature, keys, 0.05, 512, lambda: False) == ([], set(keys))
    # Noise that is too large is measured again, up to a limit of the samples.
    spps = []
    monkeypatch.setattr(coupling, "MOST_NOISE", 0.0)
    monkeypatch.setattr(coupling, "LossCurvature", lambda problem, spp, **options: (
        spps.append(spp), LossCurvature(problem, spp, **options))[1])  # fmt: skip
    assert len(measure_maps(LossCurvature(problem, 2), keys, 0.05, 40, lambda: True)[0]) == 1
    assert spps == [8, 32]
    alone = assembled(tmp_path, keys[:1])
    assert measure_maps(LossCurvature(alone, 4), keys[:1], 0.05, 4, lambda: True) == ([], set())


def places_of(**sizes: tuple[int, ...]) -> dict[str, tuple[np.ndarray, ...]]:
    """Return the cells of parameters with arrays of these sizes. `__` stands for a dot in a key."""
    arrays = {key.replace("__", "."): np.ones(size, np.float32) for key, size in sizes.items()}
    values = {key: mi.TensorXf(array) for key, array in arrays.items()}
    problem = SimpleNamespace(selection=SimpleNamespace(array=lambda key: arrays[key]), optimizer=values)
    return _cells(problem, list(arrays))


def test_cells_are_texels_of_the_coarsest_map_or_vertices(llvm):
    found = places_of(a=(2, 3, 3), b=(4, 6, 1))
    channels, cells, halves = found["a"]
    np.testing.assert_array_equal(channels, np.tile([0, 1, 2], 6))
    np.testing.assert_array_equal(cells, np.repeat(np.arange(6), 3))
    np.testing.assert_array_equal(halves[::3], [0, 1, 0, 1, 0, 1])
    fine, same, _ = found["b"]
    assert not fine.any()
    np.testing.assert_array_equal(np.bincount(same), [4] * 6)
    np.testing.assert_array_equal(same.reshape(4, 6)[:2, 4:], 2)
    for key, (_, at, half) in found.items():
        assert set(zip(at, half, strict=True)) == set(enumerate([0, 1, 0, 1, 0, 1])), key
    found = places_of(m__vertex_color=(15,), m__vertex_rough=(5,), m__vertex_odd=(7,), m__vertices=(5,))
    assert set(found) == {"m.vertex_color", "m.vertex_rough"}
    channels, cells, halves = found["m.vertex_color"]
    np.testing.assert_array_equal(channels, np.tile([0, 1, 2], 5))
    np.testing.assert_array_equal(cells, np.repeat(np.arange(5), 3))
    np.testing.assert_array_equal(halves[::3], found["m.vertex_rough"][2])
    assert len(places_of(a=(2, 3, 3))) < 2
    assert len(places_of(a=(2, 3, 3), m__vertex_color=(15,))) < 2


def test_runs_measure_maps(llvm, tmp_path, monkeypatch):
    write_sample(tmp_path, 4, 8)
    given = []
    monkeypatch.setattr(measuring, "weigh", lambda *parts: (given.append(parts), weigh(*parts))[1])
    sets = ("optimizer={type: auto}", "run.iterations=20", "run.spp=4", "target.render.spp=64")
    toy = Toy("maps", dict.fromkeys(MAPS, "initial: 0.5, bounds: [0.05, 1]"), {}, sets)
    run(tmp_path, toy)
    ((_, directions, H, _, _, alone, (maps,)),) = given
    assert [key for key, _ in maps.names] == [*[next(iter(MAPS))] * 2, *MAPS]
    assert maps.matrix.shape == (16, 5, 5)
    assert len(alone) == len(H)
    assert len(directions) == len(H)
    # Maps that were not measured are not settled, and have no spread.
    monkeypatch.setattr(measuring, "measure_maps", lambda *parts: ([], set(MAPS)))
    for about in run(tmp_path, toy).certainty.parameters.values():
        assert about.verdict in ("below the noise", "not determined")
        assert about.spread is None


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
def test_maps_of_one_surface_make_up_for_each_other(seed, llvm, tmp_path):
    """One image does not determine the colour, the roughness and the metallic weight of each texel."""
    write_sample(tmp_path, 8, 64)
    toy = Toy("maps", dict.fromkeys(MAPS, "initial: 0.5, bounds: [0.05, 1]"), {},
              ("optimizer={type: auto}", "run.iterations=300", "run.spp=32", "target.render.spp=1024"))  # fmt: skip
    found = run(tmp_path, toy, seed)
    for key, about in found.certainty.parameters.items():
        error = rms(found.errors[key])
        assert error < 2 * about.spread[0], (key, about, error)
        assert about.verdict in ("not determined", "below the noise"), (key, about, error)
        assert about.verdict == "below the noise" or about.partner in set(MAPS) - {key}
    assert "not determined" in {about.verdict for about in found.certainty.parameters.values()}
