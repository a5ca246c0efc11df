"""Motions, heightmaps and tied keys: their effect on a scene, their gradients, and refused settings."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from reslrb_cli.config.parameters import ImageFile, ParameterSpec
from reslrb_cli.errors import ConfigError
from reslrb_cli.scene.deformation import Surroundings, _corners, _Lookup
from reslrb_cli.scene.parameters import select_parameters, set_values

WORDS = ["translation", "rotation", "scale"]
MESH = "box.vertex_positions"


def specs(*parameters: dict[str, Any]) -> list[ParameterSpec]:
    return [ParameterSpec(**parameter) for parameter in parameters]


def select(scene: Any, *parameters: dict[str, Any]) -> Any:
    return select_parameters(scene, specs(*parameters), "c.yaml")


def motion(of: Any, *free: str, pivot: Any = None, **settings: Any) -> dict[str, Any]:
    return {"motion": {"of": of, "free": list(free) or WORDS, "pivot": pivot}, **settings}


def heightmap(mesh: Any, resolution: Any = (4, 3), **settings: Any) -> dict[str, Any]:
    return {"heightmap": {"mesh": mesh, "resolution": resolution}, **settings}


@pytest.fixture
def scene(make_scene):
    """The lit floor with more objects. Among these are a box, a ball, a spot light and a mesh without texture
    coordinates.
    """
    T = mi.ScalarTransform4f
    place = T().translate([1, 0.5, 2]).rotate([0, 1, 0], 20).scale([0.3, 0.2, 0.4])
    bare = mi.Mesh("bare", 3, 1)
    params = mi.traverse(bare)
    params["vertex_positions"], params["faces"] = [0, 0, 9, 1, 0, 9, 0, 1, 9], [0, 1, 2]
    params.update()
    return make_scene(
        box={"type": "cube", "to_world": place},
        other={"type": "cube", "to_world": T().translate([5, 0, 0])},
        ball={"type": "sphere", "center": [-1, 0, 1], "radius": 0.5},
        spot={"type": "spot", "to_world": T().look_at([0, 1, 5], [0, 0, 0], [0, 1, 0])},
        sun={"type": "directional", "direction": [0, 0.6, -0.8]},
        glow={"type": "cube", "to_world": T().translate([0, 9, 0]), "emitter": {"type": "area"}},
        bare=bare,
        wall={"type": "diffuse"},
        panel={"type": "rectangle", "to_world": T().translate([0, 0, -3]), "bsdf": {"type": "ref", "id": "wall"}},
    )


def positions(selection: Any, key: str = MESH) -> np.ndarray:
    return np.array(selection.params[key], np.float64).reshape(-1, 3)


def matrix(selection: Any, key: str) -> np.ndarray:
    return np.array(selection.params[key].matrix, np.float64).reshape(4, 4)


def turn(degrees: Any) -> np.ndarray:
    """Return the rotation Rz Ry Rx."""
    result = np.eye(3)
    for axis, angle in enumerate(np.radians(degrees)):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        R = np.eye(3)
        R[i, i] = R[j, j] = np.cos(angle)
        R[i, j], R[j, i] = -np.sin(angle), np.sin(angle)
        result = R @ result
    return result


POSE = {"translation": [0.1, -0.2, 0.3], "rotation": [20, -30, 40], "scale": 1.5}


def test_a_mesh_is_scaled_rotated_and_translated_in_this_order(scene):
    before = positions(select(scene, motion("box")))
    selection = select(scene, motion("box", pivot=[1, 2, 3], initial=POSE))
    assert selection.keys == ["box.translation", "box.rotation", "box.scale"]
    expected = [1, 2, 3] + np.array(POSE["translation"]) + 1.5 * (before - [1, 2, 3]) @ turn(POSE["rotation"]).T
    assert np.allclose(positions(selection), expected, atol=1e-5)
    assert np.allclose(selection.array("box.rotation"), POSE["rotation"])
    assert selection.array("box.scale").shape == ()


def test_axes_move_alone(scene):
    """Only the free axes move, each by its own number. The derivative of a fixed axis reaches no parameter."""
    before = positions(select(scene, motion("box")))
    selection = select(scene, motion("box", "x", "y", initial={"x": 0.25, "y": -0.5}))
    assert selection.keys == ["box.x", "box.y"]
    assert np.allclose(positions(selection), before + np.array([0.25, -0.5, 0]), atol=1e-5)
    assert [selection.deformation.quantities.get(key) for key in selection.keys] == ["length", "length"]
    leaves = {key: mi.Float(selection.value(key)) for key in selection.keys}
    dr.enable_grad(leaves)
    selection.hand_over({key: mi.Float(leaf) for key, leaf in leaves.items()})
    dr.backward(dr.sum(selection.params[MESH] * mi.Float(np.tile([1, 10, 100], len(before)).astype(np.float32))))
    selection.collect()
    assert [float(dr.grad(leaf)[0]) / len(before) for leaf in leaves.values()] == pytest.approx([1, 10])


def test_angles_turn_alone(scene):
    """Only the free angles turn, in the order of `rotation`, and have the derivatives of these angles."""
    before = positions(select(scene, motion("box"))) - [1, 2, 3]
    start = {"rotation_z": -70, "rotation_x": 20}
    selection = select(scene, motion("box", *start, pivot=[1, 2, 3], initial=start))
    assert selection.keys == ["box.rotation_z", "box.rotation_x"]
    assert [selection.deformation.quantities.get(key) for key in selection.keys] == ["degrees", "degrees"]
    assert np.allclose(positions(selection), [1, 2, 3] + before @ turn([20, 0, -70]).T, atol=1e-5)
    weights = np.random.default_rng(0).normal(size=before.shape).astype(np.float32)
    leaves = {key: mi.Float(selection.value(key)) for key in selection.keys}
    dr.enable_grad(leaves)
    selection.hand_over({key: mi.Float(leaf) for key, leaf in leaves.items()})
    dr.backward(dr.sum(selection.params[MESH] * mi.Float(weights.ravel())))
    selection.collect()

    def objective(x: float, z: float) -> float:
        return float(np.sum(weights * (before @ turn([x, 0, z]).T)))

    expected = [objective(20, -69.5) - objective(20, -70.5), objective(20.5, -70) - objective(19.5, -70)]
    assert [float(dr.grad(leaf)[0]) for leaf in leaves.values()] == pytest.approx(expected, rel=1e-4)


def test_all_parts_rotate_about_the_centre_of_their_box(scene):
    before = {key: positions(select(scene, motion("box")), key) for key in (MESH, "other.vertex_positions")}
    together = np.concatenate(list(before.values()))
    centre = (together.min(0) + together.max(0)) / 2
    selection = select(scene, motion(["box", "other"], "rotation", initial=[0, 0, 90]))
    for key, old in before.items():
        assert np.allclose(positions(selection, key), centre + (old - centre) @ turn([0, 0, 90]).T, atol=1e-4)


def test_shapes_and_emitters_move_with_a_mesh(scene):
    """One motion moves the positions of all objects alike and rotates directions. The transforms of emitters get no
    scale.
    """
    plain = select(scene, motion("box"))
    old = {key: matrix(plain, key) for key in ("ball.to_world", "spot.to_world", "sun.to_world")}
    point = np.array(plain.params["lamp.position"]).reshape(3)
    pivot = np.array([0.5, 0, 1])
    selection = select(scene, motion(["box", "ball", "spot", "lamp", "sun"], pivot=pivot.tolist(), initial=POSE))
    M = np.eye(4)
    M[:3, :3] = 1.5 * turn(POSE["rotation"])
    M[:3, 3] = pivot + POSE["translation"] - M[:3, :3] @ pivot
    assert np.allclose(matrix(selection, "ball.to_world"), M @ old["ball.to_world"], atol=1e-5)
    assert np.allclose(np.array(selection.params["lamp.position"]).reshape(3), (M @ [*point, 1])[:3], atol=1e-5)
    spot = matrix(selection, "spot.to_world")
    assert np.allclose(spot[:3, :3], turn(POSE["rotation"]) @ old["spot.to_world"][:3, :3], atol=1e-5)
    assert np.allclose(spot[:3, 3], (M @ old["spot.to_world"])[:3, 3], atol=1e-5)
    turned = turn(POSE["rotation"]) @ old["sun.to_world"][:3, :3]
    assert np.allclose(matrix(selection, "sun.to_world")[:3, :3], turned, atol=1e-5)


def test_a_heightmap_displaces_along_the_initial_normals(scene):
    plain = select(scene, motion("box"))
    before = positions(plain)
    normals = np.array(plain.params["box.vertex_normals"]).reshape(-1, 3)
    selection = select(scene, heightmap("box", initial=0.25))
    assert selection.keys == ["box.heightmap"]
    assert selection.array("box.heightmap").shape == (3, 4, 1)
    assert np.allclose(positions(selection), before + 0.25 * normals, atol=1e-5)


def test_a_heightmap_is_bilinear_and_clamped_outside(scene):
    texels = np.array([[0, 1, 3], [10, 20, 40]], np.float32)
    u, v = [0.0, 1 / 6, 0.5, 0.4, 5 / 6, 1.0, 0.5], [0.25, 0.25, 0.25, 0.5, 0.75, 0.9, -2.0]
    indices, weights = _corners(mi.Point2f(u, v), 3, 2)
    found = sum(np.array(w) * texels.ravel()[np.array(i)] for i, w in zip(indices, weights, strict=True))
    assert np.allclose(found, [0, 0, 1, (0.3 * 0 + 0.7 * 1 + 0.3 * 10 + 0.7 * 20) / 2, 40, 40, 1], atol=1e-4)


def test_flipped_normals_reverse_the_displacement(make_scene):
    scene = make_scene(box={"type": "cube", "flip_normals": True})
    assert np.abs(positions(select(scene, heightmap("box", initial=0.25)))).max() == pytest.approx(1.0)
    scene = make_scene(box={"type": "cube"})
    assert np.abs(positions(select(scene, heightmap("box", initial=0.25)))).max() == pytest.approx(1.25)


def test_a_heightmap_moves_with_its_mesh_and_can_serve_several(scene):
    plain = select(scene, motion("box"))
    before, normals = positions(plain), np.array(plain.params["box.vertex_normals"]).reshape(-1, 3)
    other = positions(plain, "other.vertex_positions")
    start = {"rotation": [0, 0, 90], "translation": 1}
    shift = motion("box", "rotation", "translation", pivot=[0, 0, 0], initial=start)
    selection = select(scene, heightmap(["box", "other"], initial=0.1), shift)
    assert selection.keys == ["box.heightmap", "box.rotation", "box.translation"]
    expected = 1 + (before + 0.1 * normals) @ turn([0, 0, 90]).T
    assert np.allclose(positions(selection), expected, atol=1e-5)
    assert np.abs(positions(selection, "other.vertex_positions") - other).max() == pytest.approx(0.1, abs=1e-5)


def test_interpolated_normals_follow(scene):
    selection = select(scene, motion("box", "rotation", initial=[0, 0, 90]))
    normals = np.array(selection.params["box.vertex_normals"]).reshape(-1, 3)
    plain = np.array(select(scene, motion("ball")).params["box.vertex_normals"]).reshape(-1, 3)
    assert np.allclose(normals, plain, atol=1e-5)  # the same scene after the motion
    assert not np.allclose(normals[0], [0, -1, 0], atol=0.1)


def test_gradients_reach_the_moving_parameters(scene):
    """The gradients equal central differences of weighted vertex positions and of the ball's weighted transform."""
    selection = select(scene, heightmap("box", (3, 3)), motion(["box", "ball"], pivot=[1, 0, 0], initial=POSE))
    random = np.random.default_rng(1)
    leaves = {}
    for key in selection.keys:
        value = selection.value(key)
        leaves[key] = type(value)(value)
        dr.make_opaque(leaves[key])
        dr.enable_grad(leaves[key])
    selection.hand_over(leaves)
    assert dr.grad_enabled(selection.params["box.vertex_normals"])
    by_vertex = random.normal(size=positions(selection).size)
    by_place = random.normal(size=(4, 4))
    for _ in range(2):  # as with two views
        dr.set_grad(selection.params[MESH], mi.Float(by_vertex))
        dr.set_grad(selection.params["ball.to_world"].matrix, mi.Matrix4f(by_place))
        selection.collect()
    selection.collect()  # no gradient is left to collect
    found = {key: np.array(dr.grad(leaf), np.float64).ravel() / 2 for key, leaf in leaves.items()}
    for key, gradient in found.items():
        base, h = selection.array(key), {"box.rotation": 0.1}.get(key, 1e-2)
        for entry in range(base.size):
            ends = []
            for side in (1, -1):
                moved = base.copy().reshape(-1)
                moved[entry] += side * h
                selection.set_arrays({key: moved.reshape(base.shape)})
                ball = (matrix(selection, "ball.to_world") * by_place).sum()
                ends.append(positions(selection).ravel() @ by_vertex + ball)
            selection.set_arrays({key: base})
            assert gradient[entry] == pytest.approx((ends[0] - ends[1]) / (2 * h), rel=2e-3, abs=2e-3), key


def test_a_non_finite_gradient_is_not_lost(llvm):
    """Atomic sums would drop the non-finite gradient of a vertex that shares its texels with no other vertex."""
    texels = mi.Float(np.zeros(64, np.float32))
    dr.enable_grad(texels)
    first = mi.UInt32(np.arange(0, 64, 2, dtype=np.uint32))
    heights = dr.custom(_Lookup, texels, [first, first + 1], [mi.Float([0.25] * 32), mi.Float([0.0] * 32)])
    gradient = np.ones(32, np.float32)
    gradient[5] = np.nan
    dr.set_grad(heights, mi.Float(gradient))
    dr.enqueue(dr.ADMode.Backward, heights)
    dr.traverse(dr.ADMode.Backward)
    found = np.array(dr.grad(texels))
    assert list(np.flatnonzero(~np.isfinite(found))) == [10]
    assert found[0] == 0.25


def test_tied_keys_share_one_value(scene):
    keys = ["wall.reflectance.value", "ball.bsdf.reflectance.value"]
    selection = select(scene, {"key": keys, "initial": 0.25})
    assert selection.keys == [keys[0]]
    assert [float(np.array(selection.params[key]).ravel()[0]) for key in keys] == [0.25, 0.25]
    assert selection.scene_keys == keys
    true = set_values(scene, specs({"key": keys}), {keys[0]: 0.75}, "c.yaml", "target.render.parameters")
    assert [float(np.array(true.params[key]).ravel()[0]) for key in keys] == [0.75, 0.75]


def test_true_values_move_the_scene(scene, tmp_path):
    before = positions(select(scene, motion("box", "translation")))
    heights = np.linspace(-0.1, 0.2, 12, dtype=np.float32).reshape(2, 6, 1)
    mi.Bitmap(np.tile(heights, 3)).write(str(tmp_path / "h.exr"))
    parameters = specs(motion("box", "translation"), heightmap("box"))
    values = {"box.translation": [0, 0, 1], "box.heightmap": ImageFile(file=tmp_path / "h.exr")}
    true = set_values(scene, parameters, values, "c.yaml", "target.render.parameters")
    assert np.array_equal(true.array("box.heightmap"), heights)
    assert np.abs(positions(true) - before - [0, 0, 1]).max() == pytest.approx(0.2, abs=1e-2)
    nothing = set_values(scene, parameters, {}, "c.yaml", "target.render.parameters")
    assert np.array_equal(nothing.array("box.translation"), [0, 0, 0])


@pytest.mark.parametrize(
    ("parameters", "where", "what"),
    [
        ([motion("bx")], "[0].motion.of", "there is no `bx` in the scene; did you mean `box`"),
        ([motion(["box", "camera"])], "[0].motion.of[1]", "`camera` is a PerspectiveCamera; shapes and emitters"),
        ([motion("floor")], "[0].motion.of", "`floor` has neither vertices nor a position"),
        ([heightmap("ball")], "[0].heightmap.mesh", "`ball` is a Sphere; a heightmap displaces the vertices"),
        ([heightmap(["box", "bare"])], "[0].heightmap.mesh[1]", "`bare` has no texture coordinates"),
        ([motion("sun", "translation")], "[0].motion.free", "translation does not move `sun`, which is a direction"),
        ([motion("lamp", "rotation")], "[0].motion.free", "rotation about itself does not move `lamp`"),
        ([motion("spot", "scale")], "[0].motion.free", "scale about itself does not move `spot`"),
        ([{"key": MESH}, motion("box")], "[1].motion.of", "is already recovered by parameters[0]"),
        ([motion("box"), {"key": MESH}], "[1].key", "depends on a motion or a heightmap"),
        ([motion("box"), {"key": "*.vertex_positions"}], "[1].key", "depends on a motion or a heightmap"),
        ([{"key": "ball.to_world"}], "[0].key", "is recovered as a motion (`motion: {of: ball}`)"),
        ([{"key": "box.faces"}], "[0].key", "belongs to a shape"),
        ([{"key": ["wall.reflectance.value", "floor.reflectance.data"]}], "[0].key[1]", "their shapes differ"),
        ([{"key": ["wall.reflectance.value", "*.reflectance.value"]}], "[0].key[1]", "is a glob"),
        ([{"key": ["wall.reflectance.value", "nothing"]}], "[0].key[1]", "matches no parameter"),
        (
            [{"key": "wall.reflectance.value"}, {"key": ["ball.bsdf.reflectance.value", "wall.reflectance.value"]}],
            "[1].key[1]",
            "is already matched by parameters[0]",
        ),
        ([motion("box", initial={"translation": [1, 2]})], "[0].initial.translation", "takes 3 numbers"),
        ([motion("box", "scale", initial=[1, 2])], "[0].initial", "takes 1 number"),
        ([motion("box", bounds={"scale": [2, 3]})], "[0].bounds.scale", "exclude the initial value of `box.scale`, 1"),
        ([motion("box", transform={"rotation": "log"})], "[0].initial", "`box.rotation` starts at 0"),
        ([heightmap("box", bounds=(1, 2))], "[0].bounds", "exclude the initial value of `box.heightmap`, 0"),
    ],
)
def test_refused(scene, parameters, where, what):
    with pytest.raises(ConfigError) as error:
        select(scene, *parameters)
    assert error.value.key == f"parameters{where}"
    assert what in error.value.message


@pytest.mark.parametrize(
    ("values", "what"),
    [
        ({"box.rotation": 1.0}, "`box.rotation` belongs to a motion of `box`, and `parameters` has none of this kind"),
        ({"box.translation": [1.0, 2.0]}, "takes 3 numbers"),
        ({MESH: 0.0}, "depends on `box.translation`"),
    ],
)
def test_refused_true_values_are_located(scene, values, what):
    with pytest.raises(ConfigError) as error:
        set_values(scene, specs(motion("box", "translation")), values, "c.yaml", "target.render.parameters")
    assert error.value.key == f"target.render.parameters.{next(iter(values))}"
    assert what in error.value.message


def test_an_emitting_mesh_moves(scene):
    before = positions(select(scene, motion("box", "translation")))
    selection = select(scene, motion("glow", "translation"))
    assert selection.keys == ["glow.translation"]
    assert selection.scene_keys == ["glow.vertex_positions"]
    assert np.array_equal(positions(selection), before)  # the box does not move


@pytest.mark.usefixtures("llvm")
def test_the_sphere_around_a_scene_changes_as_seldom_as_possible() -> None:
    """Each size compiles kernels. A sphere that has become too small grows with a margin; one that is much too large
    shrinks. Only emitters at infinity use it.
    """
    told: list[tuple[str, float]] = []

    def emitter(name: str, flag: mi.EmitterFlags) -> SimpleNamespace:
        return SimpleNamespace(
            flags=lambda: int(flag), set_scene=lambda scene: told.append((name, scene.bbox().bounding_sphere().radius))
        )

    emitters = [emitter("sky", mi.EmitterFlags.Infinite), emitter("lamp", mi.EmitterFlags.Surface)]
    around, half = Surroundings(), 3**-0.5
    found = []
    for size, shift in ((1, 0), (0.9, 0), (1, 0.5), (0.9, 0.5), (0.5, 0.5), (0.1, 0.5)):
        low, high = ([sign * half * size + shift for _ in range(3)] for sign in (-1, 1))
        box = mi.ScalarBoundingBox3f(low, high)
        scene: Any = SimpleNamespace(bbox=lambda box=box: box, emitters=lambda: emitters)
        horizon = around.follow(scene)
        found.append(horizon.radius)
        assert horizon.holds(box)
    assert found == pytest.approx([1, 1, 1.25, 1.25, 0.625, 0.125], rel=1e-5)
    assert [name for name, _ in told] == ["sky"] * 4
    assert [radius for _, radius in told] == pytest.approx([1, 1.25, 0.625, 0.125], rel=1e-5)
