"""The work of worker processes (`processes.run`): timed steps of an experiment (`Sampler`), and the facts that a
`convergence` needs (`survey`).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.config.loader import told
from reslrb_cli.config.schema import Config
from reslrb_cli.integrators.protocol import first_channels
from reslrb_cli.integrators.step import StepResult, given_step, gradient_step, known_step, render_image
from reslrb_cli.measure.methods import IMAGES
from reslrb_cli.measure.participants import ALIKE
from reslrb_cli.measure.processes import Begun
from reslrb_cli.measure.references import Situation, choose, of_gradient, of_image
from reslrb_cli.measure.scenes import small
from reslrb_cli.optimization.assemble import assemble_scene
from reslrb_cli.optimization.loading import load_configured
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.targets import make_targets, multiple_of, with_short_target
from reslrb_cli.optimization.views import View, set_targets, target_arrays, to_tensor
from reslrb_cli.records.clock import StepClock, StepTimes, peak_mib, reset_peak
from reslrb_cli.records.measurements import Reference
from reslrb_cli.scene.catalog import value_shape
from reslrb_cli.scene.visibility import interior
from reslrb_cli.seeds import seed


class Sampler:
    """Timed steps of an experiment with its first sensor. The parameters keep their initial values.

    `quantity` is the sampled quantity.

    - `step`: nothing. The step has an image G that is known before the image I, and the objective is sum(G * I). G is
        noise, because its content does not affect the time.
    - `fixed`: the gradient with dL/dI fixed at one of `adjoints`.
    - `loss`: the gradient of the experiment's loss with its `run.adjoint`.
    - `image`: the image.

    `arrays` are the arrays of the survey. A `step` needs none.
    """

    def __init__(self, config: Config, quantity: str, arrays: Mapping[str, np.ndarray]) -> None:
        scene = None
        if quantity == "step":  # without the check of memory, because memory is measured
            built_in = config.scene.file == small.FILE
            scene = small.build(config.scene.options) if built_in else load_configured(config)
        self.problem, self.clock = assemble_scene(config.with_exposures_fixed(), scene), StepClock()
        self.quantity, self.sensor, self.view = quantity, self.problem.sensors[0], self.problem.views[0]
        film = self.problem.scene.sensors()[self.sensor].film()
        width, height = (int(n) for n in film.crop_size())
        textures = [self.problem.selection.array(key).shape for key in self.problem.selection.keys]
        texels = sum(shape[0] * shape[1] for shape in textures if len(shape) == 3)
        self.size = {"width": width, "height": height, "texels": texels}
        if "adjoints" in arrays:
            set_targets([self.view], arrays)
        inside = arrays.get("mask", np.ones((1, 1, 1), np.float32))
        self.inside, self.mask = inside != 0, None if inside.all() else to_tensor(inside)
        self.adjoints = [to_tensor(array) for array in arrays.get("adjoints", ())]
        if quantity == "step":
            noise = np.random.default_rng(1).uniform(0.5, 1.5, (height, width, int(film.base_channels_count())))
            if noise.shape[2] in (2, 4):
                noise[:, :, -1] = 0  # of alpha
            self.adjoints = [mi.TensorXf(noise.astype(np.float32))]
            dr.make_opaque(self.adjoints)

    def step(self, seed: int, spp: int, image: int = 0) -> tuple[np.ndarray, StepTimes]:
        """Return one sample as a flat float32 array of all parameters (or pixels), and the times of the step alone.
        `image` selects dL/dI.
        """
        problem = self.problem
        if self.quantity == "image":
            with dr.suspend_grad(), self.clock.step() as times:
                picture = render_image(problem.integrator, problem.scene, self.sensor, seed, spp)
                dr.eval(picture)
            return (np.array(picture, np.float32) * self.inside).ravel(), times
        problem.apply()
        for key in problem.selection.keys:
            dr.clear_grad(problem.optimizer[key])
        seen = problem.integrator, problem.scene, self.sensor
        common: dict[str, Any] = {"seed": seed, "spp": spp, "params": problem.selection.params}
        with self.clock.step() as times:
            result: StepResult | None = None
            if self.quantity == "loss":
                options = problem.config.step_options() | common
                result = gradient_step(*seen, lambda seen: masked_loss(self.view, seen, self.mask), **options)
            elif self.quantity == "fixed":  # the image is not used, so it is not rendered
                given_step(*seen, self.adjoints[image % len(self.adjoints)], **common)
            else:
                result = known_step(*seen, self.adjoints[0], **common)
            gradients = problem.gradients()
            dr.eval(gradients, () if result is None else (result.image, result.loss))
        keys = problem.selection.keys if self.quantity != "step" else ()
        rows = [np.array(gradients[key], np.float32).ravel() for key in keys]
        return np.concatenate([np.zeros(0, np.float32), *rows]), times

    def answer(self, question: dict[str, Any], purpose: str) -> dict[str, Any]:
        """Return `values` (N, P) of steps with the given `numbers`, their times, and the number of `new_kernels`.

        `purpose` selects the seeds. If `cold` is set, the answer also has the peak memory of Dr.Jit's arrays and the
        thread-local memory of a path. `release` frees the allocator's cache afterwards.
        """
        if question["cold"]:
            reset_peak()
        run_seed, found = self.problem.config.run.seed, []
        for number in question["numbers"]:
            at = seed(run_seed, number, self.sensor, purpose)
            found.append(self.step(at, question["spp"], question["image"]))
        answer: dict[str, Any] = {"values": np.stack([row for row, _ in found])}
        for name, of in (("step_ms", "wall_ms"), ("kernel_ms", "kernel_ms"), ("codegen_ms", "codegen_ms")):
            answer[name] = [getattr(times, of) for _, times in found]
        answer["new_kernels"] = sum(times.new_kernels for _, times in found)
        if question["cold"]:
            answer |= {"peak_mib": peak_mib(dr.backend_v(mi.Float)), "scratch_bytes": scratch_bytes(self.clock.history)}
        self.clock.history = []
        if question["release"]:
            dr.flush_malloc_cache()
        return answer


def begin(first: dict[str, Any]) -> Begun:
    """Start a case. A process of a `Member` first reports the size of film and textures. Each question then asks for
    steps (`Sampler.answer`). With the quantity `survey`, the process reports the facts and the arrays of `survey`, and
    answers no questions.
    """
    if first["quantity"] == "survey":
        facts, arrays = survey(assemble_scene(told(first).with_exposures_fixed()), first["objective"])
        return {"facts": facts, "arrays": arrays}, dict
    sampler = Sampler(told(first), first["quantity"], first["arrays"])
    return sampler.size, lambda question: sampler.answer(question, first["purpose"])


_BITS = {"i1": 8, "half": 16, "float": 32, "double": 64, "ptr": 64}

#: One array of its entries for all lanes of a vector (LLVM): `alloca float, i32 112`.
_LLVM_ARRAY = re.compile(r"%arr_\w+ = alloca (\w+), i32 (\d+)")
_LLVM_LANES = re.compile(r"%index_next = add i64 %index, (\d+)")

#: ... or for one thread (CUDA): `.local .align 4 .b32 arr_12[7];`.
_PTX_ARRAY = re.compile(r"\.local \.align \d+ \.[a-z]+(\d+) arr_\w+\[(\d+)\]")


def scratch_bytes(history: Iterable[dict[str, Any]]) -> int:
    """Return the largest thread-local memory of a path in bytes, over all kernels of a `dr.kernel_history()`."""
    texts = [entry["ir"] for entry in history if entry.get("ir") is not None]
    return max((_of_kernel(text if isinstance(text, str) else str(text.getvalue())) for text in texts), default=0)


def _of_kernel(ir: str) -> int:
    bits = sum(int(size) * int(count) for size, count in _PTX_ARRAY.findall(ir))
    arrays = _LLVM_ARRAY.findall(ir)
    if arrays:
        lanes = _LLVM_LANES.search(ir)
        assert lanes is not None, "a kernel says how many lanes it handles at a time"
        sizes = [_BITS.get(kind) or int(kind.removeprefix("i")) for kind, _ in arrays]
        bits += sum(size * int(count) for size, (_, count) in zip(sizes, arrays, strict=True)) // int(lanes[1])
    return bits // 8


# --- survey -----------------------------------------------------------------------------------------------------------

#: Light paths of the target, and of all images with a fixed dL/dI together.
PATHS = {"fixed": 2**21, "loss": 2**23}

#: Purpose of the samples of these images.
_PURPOSE = "convergence, dL/dI"


def survey(problem: Problem, objective: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return the facts of a problem that has no targets, and the arrays that the problem's samples need.

    The facts have these keys.

    - `shapes`: the shapes of the estimated quantities by key. A quantity is a parameter or `image`.
    - `independent`: the valid stock integrator for each key, or None. `why`: the reasons against other stock
        integrators for each key.
    - `without`: stock integrators that are valid for no key, with the reason.
    - `paths`: the kinds of paths in the reference, which determine the reference's light.
    - `masked`: true if pixels along the film's border are left out, because light paths lose light there and camera
        paths do not. `pixels`: the number of pixels.
    - `pictures`: a description of the rendered images.

    The arrays are `mask` (H, W, 1), the first view's `target_arrays`, and `adjoints` (B, H, W, C). If the image is the
    objective, `mask` is the only array.
    """
    sensor = problem.scene.sensors()[problem.sensors[0]]
    width, height = (int(n) for n in sensor.film().crop_size())
    pixels, inside = width * height, interior((height, width), sensor)
    mask = inside[:, :, None].astype(np.float32)
    facts = find_references(problem, objective) | {"masked": not inside.all(), "pictures": "", "pixels": pixels}
    if objective == "image":
        return facts | {"shapes": {"image": [height, width, int(sensor.film().base_channels_count())]}}, {"mask": mask}
    paths = PATHS[objective]
    config = with_short_target(problem.config, paths // pixels)
    full, short = problem.config.target.render, config.target.render
    problem = make_targets(replace(problem, config=config), lambda line: None)
    count = IMAGES if objective == "loss" else 1
    spp = multiple_of(paths // (count * pixels), problem.samples_per_pass)
    adjoints = []
    for number in range(count):
        image = problem.render(problem.sensors[0], spp, number, _PURPOSE)
        adjoints.append(adjoint(problem, image, mask))
    facts["pictures"] = f"dL/dI at {'an image' if count == 1 else f'{count} images'} of {spp} spp"
    if full and short and short.spp < full.spp:
        facts["pictures"] += f", the target of {short.spp}, not {full.spp}"
    return facts, {"mask": mask, "adjoints": np.stack(adjoints), **target_arrays(problem.views[:1])}


def adjoint(problem: Problem, image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return dL/dI (H, W, C) at the given image (H, W, C). Pixels whose `mask` (H, W, 1) is 0 are left out."""
    leaf = mi.TensorXf(image)
    dr.enable_grad(leaf)
    dr.backward(masked_loss(problem.views[0], leaf, None if mask.all() else mi.TensorXf(mask)))
    return np.array(dr.grad(leaf))


def masked_loss(view: View, image: mi.TensorXf, mask: mi.TensorXf | None) -> mi.Float:
    """Return the view's loss of an attached image (H, W, C). Pixels whose `mask` (H, W, 1) is 0 are replaced by the
    target's pixels.
    """
    if mask is None:
        return view.compare(image)
    target = view.target
    return view.compare(first_channels(image, target.shape[2]) * mask + target * (1 - mask))


def find_references(problem: Problem, objective: str) -> dict[str, Any]:
    """Return the shape and the valid stock integrator for each key."""
    at = Situation.of_problem(problem, problem.sensors[0])
    keys = ["image"] if objective == "image" else list(problem.selection.keys)
    found = {key: of_image(at) if objective == "image" else of_gradient(at, key) for key in keys}
    own, alike = problem.config.integrator.options(), ALIKE[Reference.PTRACER]
    if objective != "image" and at.attached and any(own.get(name, value) != value for name, value in alike.items()):
        words = ", ".join(f"{name}: {value}" for name, value in alike.items())
        for reasons in found.values():
            reasons[Reference.PTRACER] = f"its attached derivatives are those of {words}"
    chosen = {key: choose(reasons) for key, reasons in found.items()}
    return {
        "shapes": {key: list(value_shape(problem.selection.value(key))) for key in keys if key != "image"},
        "independent": {key: None if name is None else name.value for key, (name, _) in chosen.items()},
        "why": {key: reason for key, (_, reason) in chosen.items()},
        "without": {name.value: reason for name, reason in found[keys[0]].items()
                    if all(reasons[name] is not None for reasons in found.values())},
        "paths": problem.paths,
    }  # fmt: skip
