"""Before anything is measured: the images that dL/dI is held at, and which stock integrators count as references.

Runs in a process of its own (`worker.py`), with the integrator that errors are taken from.
"""

from __future__ import annotations

import time
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.config import Config, loads
from reslrb_cli.integrators import first_channels
from reslrb_cli.measure.convergence.plan import IMAGES
from reslrb_cli.measure.moving import moves_light
from reslrb_cli.measure.participants import ALIKE
from reslrb_cli.measure.references import Situation, interior, prb_gradient, prb_image, ptracer_gradient, ptracer_image
from reslrb_cli.measure.worker import Begun
from reslrb_cli.optimization.problem import Problem, assemble_scene
from reslrb_cli.optimization.targets import make_targets
from reslrb_cli.optimization.views import View, target_arrays
from reslrb_cli.records.gradcheck import Reference
from reslrb_cli.scene.catalog import value_shape

#: Light paths of the target, and of all images that dL/dI is held at together, where time does not count.
PATHS = {"fixed": 2**21, "loss": 2**23}
#: The most of them where it does.
MOST_PATHS = 2**24
#: Share of the time that they may take, target and images.
SHARE = {"fixed": 0.1, "loss": 0.25}
#: Light paths that their speed is measured with.
TRIAL = 2**16
#: The purpose of those images' samples.
_PURPOSE = "convergence, dL/dI"


def begin(first: dict[str, Any]) -> Begun:
    """Begin the process. The one question names the file for arrays, `out`; its answer is `survey`'s facts."""
    problem = assemble_scene(loads(first["config"], first["source"]).with_exposures_fixed())

    def answer(question: dict[str, Any]) -> dict[str, Any]:
        facts, arrays = survey(problem, first["objective"], **question["ask"])
        np.savez(question["out"], **arrays)  # type: ignore[arg-type]
        return facts

    return {}, answer


def survey(
    problem: Problem, objective: str, camera: bool, named: bool, budget_s: float | None
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """What is known of a problem, targets not made yet, and arrays that its samples are taken with.

    The facts: `keys`, `shapes` of what is estimated (of the parameters, or `image`), `independent` (key to the name of
    a stock integrator, or None), `why` (key to what keeps others from it), `without` (stock integrators that are right
    for nothing here, with the reason), `masked` (whether pixels along the border are left out), `pixels`, and in words
    what was rendered, `pictures`. The arrays: `mask` (H, W, 1), and unless the image is the objective the first
    view's `target_arrays` and `adjoints` (B, H, W, C). `camera`: paths from the camera take part, where they are right
    or `named`, which lose nothing by the film's border; `budget_s` is the time of the whole measurement, if it
    counts.
    """
    film = problem.scene.sensors()[problem.sensors[0]].film()
    width, height = (int(n) for n in film.crop_size())
    facts = find_references(problem, objective)
    inside = np.ones((height, width), bool)
    pixels = width * height
    if (camera and (named or "prb" not in facts["without"])) or Reference.PRB.value in facts["independent"].values():
        inside = interior((height, width), problem.scene.sensors()[problem.sensors[0]])
    mask = inside[:, :, None].astype(np.float32)
    facts |= {"masked": not inside.all(), "pictures": "", "pixels": pixels}
    if objective == "image":
        return facts | {"shapes": {"image": [height, width, int(film.base_channels_count())]}}, {"mask": mask}
    paths = PATHS[objective] if budget_s is None else affordable_paths(problem, pixels, SHARE[objective] * budget_s / 2)
    shortened = shorten_target(problem, paths // pixels)
    make_targets(problem, lambda line: None)
    count = IMAGES if objective == "loss" else 1
    spp = multiple_of(paths // (count * pixels), problem.samples_per_pass)
    adjoints = []
    for number in range(count):
        image = problem.render(problem.sensors[0], spp, number, _PURPOSE)
        adjoints.append(adjoint(problem, image, mask))
    facts["pictures"] = f"dL/dI at {'an image' if count == 1 else f'{count} images'} of {spp} spp{shortened}"
    return facts, {"mask": mask, "adjoints": np.stack(adjoints), **target_arrays(problem.views[:1])}


def adjoint(problem: Problem, image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """dL/dI (H, W, C) at an image of that shape, the pixels that `mask` (H, W, 1) has as 0 left out of the loss."""
    leaf = mi.TensorXf(image)
    dr.enable_grad(leaf)
    dr.backward(masked_loss(problem.views[0], leaf, None if mask.all() else mi.TensorXf(mask)))
    return np.array(dr.grad(leaf))


def masked_loss(view: View, image: mi.TensorXf, mask: mi.TensorXf | None) -> mi.Float:
    """The view's loss of an attached image (H, W, C): what `mask` (H, W, 1) has as 0 is as the target has it."""
    if mask is None:
        return view.compare(image)
    target = view.target
    return view.compare(first_channels(image, target.shape[2]) * mask + target * (1 - mask))


def find_references(problem: Problem, objective: str) -> dict[str, Any]:
    """Keys, shapes, and which stock integrator counts for each."""
    params, config = problem.selection.params, problem.config
    moved = tuple(key for key in problem.selection.scene_keys if moves_light(params, key))
    attached = config.integrator.options().get("attached") is True or bool(moved)
    sensor = problem.scene.sensors()[problem.sensors[0]]
    at = Situation.of(
        problem.scene, sensor, params, config.integrator.max_depth, config.integrator.hide_emitters, attached, moved
    )
    keys = ["image"] if objective == "image" else list(problem.selection.keys)
    independent: dict[str, str | None] = {}
    why, reasons = {}, {}
    for key in keys:
        if objective == "image":
            found = {"ptracer": ptracer_image(at), "prb": prb_image(at)}
        else:
            unlike = _unlike(config) if attached else None
            found = {"ptracer": unlike or ptracer_gradient(at, key), "prb": prb_gradient(at, key)}
        reasons[key] = found
        independent[key] = next((name for name, reason in found.items() if reason is None), None)
        why[key] = "; ".join(f"not {name}: {reason}" for name, reason in found.items() if reason is not None)
    without = {
        name: str(reasons[keys[0]][name])
        for name in ("ptracer", "prb")
        if all(found[name] is not None for found in reasons.values())
    }
    shapes = {key: list(value_shape(problem.selection.value(key))) for key in keys if key != "image"}
    return {"keys": keys, "shapes": shapes, "independent": independent, "why": why, "without": without}


def _unlike(config: Config) -> str | None:
    """Why naive AD has other derivatives of what moves light than the experiment asks for."""
    options, alike = config.integrator.options(), ALIKE[Reference.PTRACER]
    if all(options.get(name, value) == value for name, value in alike.items()):
        return None
    return "its attached derivatives are those of " + ", ".join(f"{name}: {value}" for name, value in alike.items())


def affordable_paths(problem: Problem, pixels: int, seconds: float) -> int:
    """So many light paths take so long: a power of 2, so that machines of about the same speed have the same images."""
    spp = multiple_of(TRIAL // pixels, problem.samples_per_pass)
    for _ in range(2):  # the first one compiles
        began = time.perf_counter()
        problem.render(problem.sensors[0], spp, 0, "convergence, trial")
        taken = time.perf_counter() - began
    paths = pixels * spp * seconds / max(taken, 1e-6)
    return 2 ** int(np.log2(np.clip(paths, TRIAL, MOST_PATHS)))


def shorten_target(problem: Problem, most: int) -> str:
    """Bound the samples per pixel of a target that has to be rendered; returns what to say of it."""
    render = problem.config.target.render
    if render is None:
        return ""
    own = (render.integrator or problem.config.integrator).options().get("samples_per_pass")
    spp = multiple_of(most, own)
    if spp >= render.spp:
        return ""
    target = problem.config.target.model_copy(update={"render": render.model_copy(update={"spp": spp})})
    problem.config = problem.config.model_copy(update={"target": target})
    return f", the target of {spp}, not {render.spp}"


def multiple_of(spp: int, unit: int | None) -> int:
    """The greatest multiple of a pass's samples up to `spp`, at least one."""
    unit = unit or 1
    return max(spp // unit, 1) * unit
