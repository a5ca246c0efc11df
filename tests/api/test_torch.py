"""`rl.torch.render` gives autograd the gradients of `rl.step`. Most tests need torch, in any build."""

from __future__ import annotations

import gc
import logging
import re
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cli.tiny import ROOT

import reslrb_cli as rl
from reslrb_cli.records.clock import reset_peak

FLOOR, BALL, LAMP = "floor.bsdf.reflectance.data", "ball.bsdf.reflectance.value", "lamp.emitter.radiance.value"
SHAPE, ENVIRONMENT = "box.vertex_positions", "sky.data"
SPP = 8
RANDOM = np.random.default_rng(1)


@pytest.fixture
def torch(llvm: str) -> Any:
    module = pytest.importorskip("torch")
    rl.register()
    return module


def bitmap(height: int, width: int) -> mi.Bitmap:
    return mi.Bitmap(np.random.default_rng(2).uniform(0.2, 0.8, (height, width, 3)).astype(np.float32))


def room(**more: Any) -> mi.Scene:
    move = mi.ScalarTransform4f()
    film = {"type": "hdrfilm", "width": 12, "height": 10, "filter": {"type": "gaussian"}}
    texture = {"type": "bitmap", "raw": True, "format": "variant", "bitmap": bitmap(4, 6)}
    return rl.load_scene({
        "type": "scene",
        "camera": {"type": "perspective", "fov": 40, "film": film,
                   "to_world": move.look_at([0, 0, 5], [0, 0, 0], [0, 1, 0])},
        "floor": {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": texture}},
        "ball": {"type": "sphere", "radius": 0.3, "center": [0.3, 0, 0.5],
                 "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.2, 0.2]}}},
        "lamp": {"type": "rectangle", "to_world": move.translate([-1, 1, 3]).rotate([1, 0, 0], 180),
                 "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [4, 5, 6]}}},
    } | more)  # fmt: skip


def box() -> dict[str, Any]:
    to_world = mi.ScalarTransform4f().translate([-0.5, 0, 0.5]).rotate([1, 1, 0], 30).scale(0.2)
    return {"type": "cube", "to_world": to_world, "bsdf": {"type": "diffuse"}}


def sky() -> dict[str, Any]:
    return {"type": "envmap", "bitmap": bitmap(4, 8)}


def reslrb(**options: Any) -> mi.Integrator:
    return mi.load_dict({"type": "reslrb", "max_depth": 4, "estimator": "stack", **options})


def objective(image: mi.TensorXf) -> mi.Float:
    return dr.mean(dr.square(image - 0.3), axis=None)


def l2(image: Any) -> Any:
    return ((image - 0.3) ** 2).mean()


def stepped(scene: mi.Scene, integrator: mi.Integrator, values: dict[str, Any], seed: int = 3, **options: Any
            ) -> tuple[Any, dict[str, Any]]:  # fmt: skip
    """Return the result of `rl.step` at `values` (as in the scene), and its gradients."""
    params = mi.traverse(scene)
    leaves = {}
    for key, value in values.items():
        kind = type(params[key])
        flat = mi.Float(np.asarray(value, np.float32).ravel()) + dr.opaque(mi.Float, 0)
        leaves[key] = kind(flat, value.shape) if dr.is_tensor_v(kind) else dr.unravel(kind, flat)
        dr.make_opaque(leaves[key])
        dr.enable_grad(leaves[key])
        params[key] = leaves[key]
    params.update()
    result = rl.step(integrator, scene, 0, objective, seed=seed, spp=SPP, params=params, **options)
    return result, {key: np.array(dr.grad(leaf)).reshape(values[key].shape) for key, leaf in leaves.items()}


def now(scene: mi.Scene, *keys: str) -> dict[str, np.ndarray[Any, Any]]:
    params = mi.traverse(scene)
    return {key: np.array(params[key], dtype=np.float32).squeeze() for key in keys}


def check_equal(found: Any, expected: np.ndarray[Any, Any]) -> None:
    """Equal up to rounding, because threads add in any order, and not 0."""
    assert np.abs(expected).max() > 0
    np.testing.assert_allclose(found.detach().numpy(), expected, rtol=2e-5, atol=2e-5 * np.abs(expected).max())


@pytest.mark.long
@pytest.mark.parametrize("adjoint", ["independent", "correlated"])
@pytest.mark.parametrize(
    "make",
    [reslrb, lambda: reslrb(estimator="reservoir"), lambda: reslrb(paths="camera"),
     lambda: mi.load_dict({"type": "ptracer", "max_depth": 4}), lambda: mi.load_dict({"type": "prb", "max_depth": 4})],
    ids=["stack", "reservoir", "camera paths", "ptracer", "prb"],
)  # fmt: skip
def test_gradients_are_those_of_a_step(torch: Any, make: Callable[[], mi.Integrator], adjoint: Any) -> None:
    scene, integrator = room(), make()
    values = now(scene, FLOOR, BALL, LAMP)
    tensors = {key: torch.tensor(value, requires_grad=True) for key, value in values.items()}
    image = rl.torch.render(scene, tensors, integrator=integrator, seed=3, spp=SPP, adjoint=adjoint)
    loss = l2(image)
    loss.backward()
    result, gradients = stepped(room(), integrator, values, adjoint=adjoint)
    assert (image.shape, image.dtype) == ((10, 12, 3), torch.float32)
    check_equal(image, np.array(result.image))
    check_equal(loss, np.array(result.loss).squeeze())
    for key, gradient in gradients.items():
        check_equal(tensors[key].grad, gradient)


@pytest.mark.long
def test_geometry_moves(torch: Any) -> None:
    scene = room(box=box())
    values = now(scene, SHAPE)
    vertices = torch.tensor(values[SHAPE].reshape(-1, 3), requires_grad=True)
    loss = l2(rl.torch.render(scene, {SHAPE: vertices}, integrator=reslrb(), seed=3, spp=SPP))
    loss.backward()
    _, gradients = stepped(room(box=box()), reslrb(), values, adjoint="independent")
    check_equal(vertices.grad, gradients[SHAPE].reshape(-1, 3))


@pytest.mark.long
def test_an_environment_map_lacks_the_columns_that_mitsuba_adds(torch: Any) -> None:
    scene = room(sky=sky(), lamp={"type": "sphere", "center": [0, 0, -9]})
    whole = now(scene, ENVIRONMENT)[ENVIRONMENT]
    texels = torch.tensor(whole[:, 1:-1], requires_grad=True)
    integrator = mi.load_dict({"type": "prb", "max_depth": 4})
    l2(rl.torch.render(scene, {ENVIRONMENT: texels}, integrator=integrator, seed=3, spp=SPP)).backward()
    _, gradients = stepped(room(sky=sky(), lamp={"type": "sphere", "center": [0, 0, -9]}), integrator,
                           {ENVIRONMENT: whole}, adjoint="independent")  # fmt: skip
    expected = gradients[ENVIRONMENT]
    expected[:, 1] += expected[:, -1]
    expected[:, -2] += expected[:, 0]
    check_equal(texels.grad, expected[:, 1:-1])


@pytest.mark.long
def test_a_texture_from_a_network(torch: Any) -> None:
    torch.manual_seed(1)
    grid = torch.stack(torch.meshgrid(torch.linspace(-1, 1, 8), torch.linspace(-1, 1, 8), indexing="ij"), -1)
    network = torch.nn.Sequential(torch.nn.Linear(2, 16), torch.nn.Tanh(), torch.nn.Linear(16, 3), torch.nn.Sigmoid())
    scene, integrator = room(), reslrb()
    truth = 0.5 + 0.4 * grid[..., :1] * torch.tensor([1.0, 0, -1])
    target = rl.torch.render(scene, {FLOOR: truth}, integrator=integrator, spp=512)
    # the chain rule: the gradient of the weights from that of the texels
    texture = network(grid)
    _, gradients = stepped(room(), integrator, {FLOOR: texture.detach().numpy()}, adjoint="independent")
    expected = torch.autograd.grad(texture, list(network.parameters()), torch.from_numpy(gradients[FLOOR]))
    l2(rl.torch.render(scene, {FLOOR: network(grid)}, integrator=integrator, seed=3, spp=SPP)).backward()
    for parameter, gradient in zip(network.parameters(), expected, strict=True):
        check_equal(parameter.grad, gradient.numpy())

    optimizer = torch.optim.Adam(network.parameters(), 0.02)
    errors = []
    for seed in range(60):
        optimizer.zero_grad()
        image = rl.torch.render(scene, {FLOOR: network(grid)}, integrator=integrator, seed=seed, spp=64)
        loss = ((image - target) ** 2).mean()
        loss.backward()
        optimizer.step()
        errors.append((network(grid) - truth).square().mean().sqrt().item())
    assert errors[-1] < 0.2 * errors[0], errors


@pytest.mark.long
def test_each_image_keeps_its_own_values(torch: Any) -> None:
    """Backward passes come after both renderings, and after the caller has changed the scene."""
    scene, integrator = room(), reslrb()
    first, second = (torch.full((4, 6, 3), value, requires_grad=True) for value in (0.2, 0.7))
    images = [rl.torch.render(scene, {FLOOR: each}, integrator=integrator, seed=3, spp=SPP) for each in (first, second)]
    loss = l2(images[0]) + l2(images[1])
    with torch.no_grad():
        first.add_(1)  # as an optimiser's update does
    params = mi.traverse(scene)
    params[LAMP] = mi.Color3f(4, 5, 6)
    params[FLOOR] = dr.full(mi.TensorXf, 0.9, (4, 6, 3))
    params.update()
    loss.backward()
    for value, tensor in ((0.2, first), (0.7, second)):
        texture = np.full((4, 6, 3), value, np.float32)
        check_equal(tensor.grad, stepped(room(), integrator, {FLOOR: texture}, adjoint="independent")[1][FLOOR])
    # a second backward pass gives the same
    tensor = torch.full((4, 6, 3), 0.2, requires_grad=True)
    loss = l2(rl.torch.render(scene, {FLOOR: tensor}, integrator=integrator, seed=3, spp=SPP))
    loss.backward(retain_graph=True)
    once = tensor.grad.clone()
    loss.backward()
    check_equal(tensor.grad, 2 * once.numpy())


@pytest.mark.long
def test_tensors_of_any_kind(torch: Any) -> None:
    scene, integrator = room(), reslrb()
    expected = stepped(room(), integrator, {FLOOR: np.full((4, 6, 3), 0.5, np.float32)}, adjoint="independent")[1]
    double = torch.full((4, 6, 3), 0.5, dtype=torch.float64, requires_grad=True)
    turned = torch.full((6, 4, 3), 0.5, requires_grad=True)
    for tensor, given in ((double, double), (turned, turned.transpose(0, 1))):
        l2(rl.torch.render(scene, {FLOOR: given}, integrator=integrator, seed=3, spp=SPP)).backward()
        assert tensor.grad.dtype == tensor.dtype
        check_equal((tensor.grad if tensor is double else tensor.grad.transpose(0, 1)).float(), expected[FLOOR])
    coarse = torch.full((2, 2, 3), 0.5, requires_grad=True)  # another resolution
    fixed = torch.tensor([0.8, 0.2, 0.2])
    image = rl.torch.render(scene, {FLOOR: coarse, BALL: fixed}, integrator=integrator, seed=3, spp=SPP)
    image.sum().backward()  # dL/dI without strides
    assert coarse.grad.shape == (2, 2, 3)
    assert fixed.grad is None
    assert not dr.grad_enabled(mi.traverse(scene)[BALL])
    with torch.no_grad():
        assert not rl.torch.render(scene, {FLOOR: coarse}, integrator=integrator, spp=SPP).requires_grad
    assert not dr.grad_enabled(mi.traverse(scene)[FLOOR])
    held = [rl.torch.render(scene, {}, integrator=integrator, seed=seed, spp=SPP) for seed in (1, 1, 2)]
    gc.collect()  # images share the memory of Dr.Jit's arrays, which must live as long
    for _ in range(3):
        rl.torch.render(scene, {}, integrator=integrator, seed=9, spp=SPP)
    check_equal(held[0], held[1].numpy())
    assert (held[0] - held[2]).abs().max() > 0.01


@pytest.mark.long
def test_backward_on_another_thread(torch: Any) -> None:
    """Autograd differentiates on a thread of its own if the device is a GPU."""
    scene, grads = room(), []
    for on_thread in (False, True):
        tensor = torch.full((4, 6, 3), 0.5, requires_grad=True)
        loss = l2(rl.torch.render(scene, {FLOOR: tensor}, integrator=reslrb(), seed=3, spp=SPP))
        thread = threading.Thread(target=loss.backward)
        (thread.start if on_thread else loss.backward)()
        if on_thread:
            thread.join()
        grads.append(tensor.grad)
    check_equal(grads[1], grads[0].numpy())


@pytest.mark.long
def test_memory_and_kernels_stay_the_same(torch: Any) -> None:
    scene, integrator = room(), reslrb()
    tensor = torch.full((64, 64, 3), 0.5, requires_grad=True)
    optimizer = torch.optim.Adam([tensor], 0.02)
    backend = dr.backend_v(mi.Float)
    peaks, compiled = [], []
    for seed in range(12):
        dr.kernel_history_clear()
        reset_peak()
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            optimizer.zero_grad()
            l2(rl.torch.render(scene, {FLOOR: tensor}, integrator=integrator, seed=seed, spp=SPP)).backward()
            optimizer.step()
        compiled.append({each["hash"] for each in dr.kernel_history((dr.KernelType.JIT,))})
        peaks.append(dr.detail.malloc_watermark(backend))
    assert peaks[2] > 4 * 3 * 64 * 64
    assert len(set(peaks[2:])) == 1, peaks
    assert all(each <= compiled[0] | compiled[1] for each in compiled[2:])
    # and as in a step
    texture = np.full((64, 64, 3), 0.5, np.float32)
    for _ in range(2):
        reset_peak()
        stepped(scene, integrator, {FLOOR: texture}, adjoint="independent")
    own = dr.detail.malloc_watermark(backend)
    assert peaks[-1] <= 1.1 * own


@pytest.mark.long
def test_values_that_are_not_finite_are_counted(torch: Any, caplog: pytest.LogCaptureFixture) -> None:
    scene = room()
    grads = []
    for wrong in (False, True):
        tensor = torch.full((4, 6, 3), 0.5, requires_grad=True)
        image = rl.torch.render(scene, {FLOOR: tensor}, integrator=reslrb(), seed=3, spp=SPP)
        weights = torch.ones_like(image)
        weights[2, 5, 1] = weights[0, 0, 0] = np.nan if wrong else 0
        with caplog.at_level(logging.WARNING, "reslrb_cli"):
            (image * weights).sum().backward()
        grads.append(tensor.grad)
    check_equal(grads[1], grads[0].numpy())
    assert caplog.messages == ["2 entries of dL/dI are not finite and count as 0; the first: (0, 0), 0"]


@pytest.mark.long
@pytest.mark.parametrize(
    ("key", "shape", "message"),
    [
        ("floor.bsdf.reflectance.dat", (4, 6, 3), "params: `floor.bsdf.reflectance.dat` matches no parameter of the "
         "scene; did you mean `floor.bsdf.reflectance.data`"),
        ("floor.bsdf.*data", (4, 6, 3), "params: `floor.bsdf.*data` is a glob; name each parameter"),
        ("camera.film.size", (2,), "params: `camera.film.size` "),
        (FLOOR, (4, 6, 1), f"params: {FLOOR}: has the shape 4 x 6 x 1, but the scene's parameter 4 x 6 x 3"),
        (FLOOR, (72,), f"params: {FLOOR}: has the shape 72, but"),
        (BALL, (4,), f"params: {BALL}: has the shape 4, but the scene's parameter 3"),
        (BALL, (), f"params: {BALL}: has the shape one number, but the scene's parameter 3"),
    ],
)  # fmt: skip
def test_wrong_parameters_are_refused(torch: Any, key: str, shape: tuple[int, ...], message: str) -> None:
    with pytest.raises(rl.ConfigError) as caught:
        rl.torch.render(room(), {key: torch.ones(shape)}, integrator=reslrb(), spp=SPP)
    assert str(caught.value).startswith(message), str(caught.value)


@pytest.mark.long
def test_a_step_takes_little_longer_than_that_of_reslrb(torch: Any) -> None:
    """At most 1.1 times as long, if torch's threads do not keep the cores busy. To be measured on an idle machine:
    `scripts/test -n 0 -s -m long tests/api/test_torch.py -k longer`.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    scenes = [rl.load_scene(str(ROOT / "scenes/cornell_floor/scene.xml"), resx=128, resy=128) for _ in range(2)]
    key, integrator = "floor.reflectance.data", reslrb()
    params = mi.traverse(scenes[0])
    dr.enable_grad(params[key])
    params.update()
    tensor = torch.full((64, 64, 3), 0.5, requires_grad=True)

    def ours(seed: int) -> None:
        rl.step(integrator, scenes[0], 0, objective, seed=seed, spp=16, adjoint="independent", params=params)
        assert np.array(dr.grad(params[key])).any()
        dr.clear_grad(params[key])

    def by_torch(seed: int) -> None:
        image = rl.torch.render(scenes[1], {key: tensor}, integrator=integrator, seed=seed, spp=16)
        l2(image).backward()
        assert tensor.grad.any()
        tensor.grad = None

    taken: dict[Any, list[float]] = {ours: [], by_torch: []}
    for seed in range(40):
        for step, times in taken.items():
            start = time.perf_counter()
            step(seed)
            times.append(time.perf_counter() - start)
    torch.set_num_threads(threads)
    first, second = (1e3 * np.median(times[10:]) for times in taken.values())
    print(f"rl.step {first:.1f} ms, torch {second:.1f} ms")
    assert second < 1.1 * first


@pytest.mark.long
def test_other_errors_say_why(torch: Any) -> None:
    scene = room()
    with pytest.raises(rl.ConfigError, match=r"^integrator: is missing, and the scene has none; give mi.load_dict"):
        rl.torch.render(scene, {}, spp=SPP)
    for wrong in ({"spp": -1}, {"seed": -1}, {"adjoint": "batched"}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            rl.torch.render(scene, {}, integrator=reslrb(), **wrong)
    fog = {"type": "cube", "interior": {"type": "homogeneous"}, "bsdf": {"type": "null"}}
    with pytest.raises(rl.ReslrbError, match=r"medium|media"):
        rl.torch.render(room(fog=fog), {}, integrator=reslrb(), spp=SPP)
    tensor = torch.full((4, 6, 3), 0.5, requires_grad=True)
    loss = l2(rl.torch.render(scene, {FLOOR: tensor}, integrator=reslrb(), spp=SPP))
    (gradient,) = torch.autograd.grad(loss, tensor, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        gradient.sum().backward()


@pytest.mark.long
def test_the_example_of_the_docs_runs(torch: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    (block,) = re.findall(r"^```python\n(.*?)^```", (ROOT / "docs/pytorch.md").read_text(), re.MULTILINE | re.DOTALL)
    (tmp_path / "scenes").symlink_to(ROOT / "scenes")
    monkeypatch.chdir(tmp_path)
    exec(compile(block, "example.py", "exec"), {"__name__": "__main__"})
    losses = [float(line.split()[1]) for line in capsys.readouterr().out.splitlines()]
    assert losses[-1] < losses[0] / 3, losses


def test_a_missing_torch_is_named(llvm: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(rl.ConfigError) as caught:
        rl.torch.render(room(), {})
    assert str(caught.value).startswith("torch: needs the package torch (")
    assert str(caught.value).endswith("; `pip install 'reslrb[torch]'` installs it")
