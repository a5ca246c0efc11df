"""Members of a `convergence` measurement, the facts that precede the measurement (`survey`), and the steps of a member
(`Sampler`).

Survey and sampler run in separate processes (`processes.py`), which `begin_survey` and `begin_sampling` start.
"""

from __future__ import annotations

import enum
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.config.loader import dump, told
from reslrb_cli.config.schema import Config
from reslrb_cli.integrators.protocol import first_channels
from reslrb_cli.integrators.step import render_image
from reslrb_cli.measure.arena import Contestant
from reslrb_cli.measure.methods import IMAGES
from reslrb_cli.measure.participants import ALIKE
from reslrb_cli.measure.processes import Begun, Ended
from reslrb_cli.measure.references import CAMERA_PATHS, Situation, choose, of_gradient, of_image
from reslrb_cli.measure.stepper import Steps, multiple_of
from reslrb_cli.optimization.assemble import assemble_scene
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.targets import make_targets
from reslrb_cli.optimization.views import View, set_targets, target_arrays, to_tensor
from reslrb_cli.records.clock import StepTimes, reset_peak
from reslrb_cli.records.measurements import Method, Reference
from reslrb_cli.scene.catalog import value_shape
from reslrb_cli.scene.visibility import interior
from reslrb_cli.seeds import seed

#: A turn lasts as long as a step of the slowest method, but at most this many seconds.
TURN_S = 2.0

#: A turn has at least two steps that are shorter than this many seconds: the first one refills the caches.
SHORT_S = 1.0

#: Maximum number of steps of one turn.
MOST_STEPS = 8

#: Turns of references, per turn of the compared methods.
SHARES = {"reference": 0.5, "independent": 0.35}

#: Steps of a turn if their number must not depend on time.
FIXED = {"case": 2, "reference": 8, "independent": 4}

#: Maximum number of steps of a reference's turn.
MOST_REFERENCE_STEPS = 64


class Role(str, enum.Enum):
    """Role of a member."""

    CASE = "case"
    REFERENCE = "reference"
    INDEPENDENT = "independent"


@dataclass(kw_only=True)
class Member(Contestant):
    """Process of one member, with its steps so far and its number of steps per turn.

    `rows` are samples (P,), `turns` are their rounds, and `seconds` has the time of one step in each turn. `count` is
    the number of steps in a turn. `taken` is the number of all requested steps, which determines the seeds.
    """

    role: Role
    method: Method
    config: Config
    spp: int
    out: Path
    count: int = 1
    taken: int = 0
    step_s: float = 0.0
    rows: list[np.ndarray] = field(default_factory=list)
    turns: list[int] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    message: str = ""

    @property
    def label(self) -> str:
        """Name of the method."""
        return self.method.label

    @property
    def cold_s(self) -> float | None:
        """Seconds of the first step, which includes compilation."""
        return None if self.cold is None else self.cold["step_ms"][0] / 1e3

    @property
    def name(self) -> str:
        """Role and label."""
        return f"{self.role.value} {self.label}"

    def question(self, round: int | None) -> dict[str, Any]:
        """Return the request for the steps of a turn, with the round's dL/dI. During warm-up, a turn has one step."""
        start, count = self.taken, 1 if round is None else self.count
        self.taken += count
        return {"start": start, "count": count, "spp": self.spp, "image": round or 0, "out": str(self.out)}

    def keep(self, round: int, answer: dict[str, Any]) -> None:
        """Record a turn's steps."""
        rows = np.load(self.out)
        if not np.isfinite(rows).all() and not self.message:
            self.message = f"{np.count_nonzero(~np.isfinite(rows))} entries of step {len(self.rows) + 1} are not finite"
        self.rows += list(rows)
        self.turns += [round] * len(rows)
        times = answer["step_ms"]
        self.seconds.append(float(np.mean(times[1:] if len(times) > 1 else times)) / 1e3)

    def kept(self, rounds: int) -> tuple[dict[str, Any], np.ndarray]:
        """Return the data of the first `rounds` rounds for a later session: a JSON object, and the samples (N, P).

        An interrupted round is left out. The next session repeats the interrupted round with other seeds.
        """
        turns = [turn for turn in self.turns if turn < rounds]
        entry = {"name": self.name, "config": dump(self.config), "taken": self.taken, "turns": turns,
                 "seconds": self.seconds[: len(set(turns))], "message": self.message, "cold": self.cold,
                 "end": self.end and vars(self.end)}  # fmt: skip
        return entry, np.array(self.rows[: len(turns)], np.float32)

    def restore(self, entry: dict[str, Any], rows: np.ndarray) -> None:
        """Restore the result of `kept`. Members that have ended are not tried again."""
        for name in ("taken", "turns", "seconds", "message", "cold"):
            setattr(self, name, entry[name])
        self.rows, self.end = list(rows), entry["end"] and Ended(**entry["end"])
        if self.end is not None:
            self.close()

    def means(self, key: slice, groups: int | None = None) -> np.ndarray:
        """Return the means of the entries `key` for each turn, or for each group of turns: (K, P)."""
        turns, rows = np.array(self.turns), np.stack(self.rows)[:, key].astype(np.float64)
        if groups is not None:
            turns = turns % groups
        return np.stack([rows[turns == turn].mean(0) for turn in np.unique(turns)])


def share_turns(members: list[Member], fixed: bool) -> None:
    """Set the number of steps per turn of each member so that turns take about equal times.

    With `fixed`, each member takes the `FIXED` number of steps for its role.
    """
    for member in members if fixed else ():
        member.count = FIXED[member.role.value]
    if fixed:
        return
    cases = [member for member in members if member.role is Role.CASE]
    turn_s = min(max((member.step_s for member in cases), default=0.0), TURN_S)
    for member in cases:
        least = 2 if member.step_s < SHORT_S else 1
        member.count = _fitting(turn_s, member.step_s, least, MOST_STEPS)
    together = sum(member.count * member.step_s for member in cases)
    for member in members:
        if member.role is not Role.CASE:
            member.count = _fitting(SHARES[member.role.value] * together, member.step_s, 1, MOST_REFERENCE_STEPS)


def _fitting(turn_s: float, step_s: float, least: int, most: int) -> int:
    return min(max(round(turn_s / max(step_s, 1e-4)), least), most)


#: Light paths of the target, and of all images with a fixed dL/dI together, without a time limit.
PATHS = {"fixed": 2**21, "loss": 2**23}

#: Their maximum with a time limit.
MOST_PATHS = 2**24

#: Share of the time for the target and the images.
SHARE = {"fixed": 0.1, "loss": 0.25}

#: Light paths for measuring their speed.
TRIAL = 2**16

#: Purpose of the samples of these images.
_PURPOSE = "convergence, dL/dI"


def begin_survey(first: dict[str, Any]) -> Begun:
    """Start the process. The process gets only one request. The request's `out` is the name of the file for arrays. The
    answer has the facts of `survey`.
    """
    problem = assemble_scene(told(first).with_exposures_fixed())

    def answer(question: dict[str, Any]) -> dict[str, Any]:
        facts, arrays = survey(problem, first["objective"], **question["ask"])
        np.savez(question["out"], **arrays)  # type: ignore[arg-type]
        return facts

    return {}, answer


def survey(
    problem: Problem, objective: str, camera: bool, named: bool, budget_s: float | None, light: bool = True
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return the facts of a problem that has no targets, and the arrays that the problem's samples need.

    The facts have these keys.

    - `keys` and `shapes`: the keys and shapes of the estimated quantities. A quantity is a parameter or `image`.
    - `independent`: the valid stock integrator for each key, or None. `why`: the reasons against other stock
        integrators for each key.
    - `without`: stock integrators that are valid for no key, with the reason.
    - `paths`: the kinds of paths in the reference, which determine the reference's light.
    - `masked`: true if pixels along the film's border are left out, because some of the compared images are dark there
        and others are not. `pixels`: the number of pixels.
    - `pictures`: a description of the rendered images.

    The arrays are `mask` (H, W, 1), the first view's `target_arrays`, and `adjoints` (B, H, W, C). If the image is the
    objective, `mask` is the only array. `camera` is true if some method may have camera paths. These methods take part
    if `named`, or if `prb` is valid for some key. Images with camera paths have no dark film border. `light` is true if
    methods with a dark film border take part. `budget_s` is the time of the whole measurement, if it is limited.
    """
    film = problem.scene.sensors()[problem.sensors[0]].film()
    width, height = (int(n) for n in film.crop_size())
    facts = find_references(problem, objective)
    inside = np.ones((height, width), bool)
    pixels = width * height
    sides = {name in CAMERA_PATHS for name in facts["independent"].values() if name is not None}
    sides |= {True} if camera and (named or "prb" not in facts["without"]) else set()
    if len(sides | ({False} if light else set())) > 1:
        inside = interior((height, width), problem.scene.sensors()[problem.sensors[0]])
    mask = inside[:, :, None].astype(np.float32)
    facts |= {"masked": not inside.all(), "pictures": "", "pixels": pixels}
    if objective == "image":
        return facts | {"shapes": {"image": [height, width, int(film.base_channels_count())]}}, {"mask": mask}
    paths = PATHS[objective] if budget_s is None else affordable_paths(problem, pixels, SHARE[objective] * budget_s / 2)
    problem, shortened = shorten_target(problem, paths // pixels)
    problem = make_targets(problem, lambda line: None)
    count = IMAGES if objective == "loss" else 1
    spp = multiple_of(paths // (count * pixels), problem.samples_per_pass)
    adjoints = []
    for number in range(count):
        image = problem.render(problem.sensors[0], spp, number, _PURPOSE)
        adjoints.append(adjoint(problem, image, mask))
    facts["pictures"] = f"dL/dI at {'an image' if count == 1 else f'{count} images'} of {spp} spp{shortened}"
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
    """Return the keys, the shapes, and the valid stock integrator for each key."""
    at = Situation.of_problem(problem, problem.sensors[0])
    keys = ["image"] if objective == "image" else list(problem.selection.keys)
    found: dict[str, dict[Reference, str | None]] = {}
    for key in keys:
        found[key] = of_image(at) if objective == "image" else of_gradient(at, key)
        if objective != "image" and at.attached:
            found[key][Reference.PTRACER] = _unlike(problem.config) or found[key][Reference.PTRACER]
    chosen = {key: choose(reasons) for key, reasons in found.items()}
    independent = {key: None if name is None else name.value for key, (name, _) in chosen.items()}
    why = {key: reason for key, (_, reason) in chosen.items()}
    without = {
        name.value: reason
        for name, reason in found[keys[0]].items()
        if all(reasons[name] is not None for reasons in found.values())
    }
    shapes = {key: list(value_shape(problem.selection.value(key))) for key in keys if key != "image"}
    return {"keys": keys, "shapes": shapes, "independent": independent, "why": why, "without": without,
            "paths": problem.paths}  # fmt: skip


def _unlike(config: Config) -> str | None:
    """Return why naive AD's derivatives of moving parameters differ from the derivatives that the experiment requests,
    or None.
    """
    options, alike = config.integrator.options(), ALIKE[Reference.PTRACER]
    if all(options.get(name, value) == value for name, value in alike.items()):
        return None
    return "its attached derivatives are those of " + ", ".join(f"{name}: {value}" for name, value in alike.items())


def affordable_paths(problem: Problem, pixels: int, seconds: float) -> int:
    """Return the number of light paths that can be traced in `seconds` seconds. The number of paths is a power of 2, so
    similar machines have the same images.
    """
    spp = multiple_of(TRIAL // pixels, problem.samples_per_pass)
    for _ in range(2):  # the first one compiles kernels
        began = time.perf_counter()
        problem.render(problem.sensors[0], spp, 0, "convergence, trial")
        taken = time.perf_counter() - began
    paths = pixels * spp * seconds / max(taken, 1e-6)
    return 2 ** int(np.log2(np.clip(paths, TRIAL, MOST_PATHS)))


def shorten_target(problem: Problem, most: int) -> tuple[Problem, str]:
    """Return the problem with limited samples per pixel for a rendered target, and a message about the limit."""
    render = problem.config.target.render
    if render is None:
        return problem, ""
    own = (render.integrator or problem.config.integrator).options().get("samples_per_pass")
    spp = multiple_of(most, own)
    if spp >= render.spp:
        return problem, ""
    target = problem.config.target.model_copy(update={"render": render.model_copy(update={"spp": spp})})
    shorter = replace(problem, config=problem.config.model_copy(update={"target": target}))
    return shorter, f", the target of {spp}, not {render.spp}"


class Sampler(Steps):
    """Steps of `convergence`.

    `mode` is the sampled quantity. `known` is the gradient with dL/dI fixed at one of `adjoints`. `loss` is the
    gradient of the experiment's loss with its `run.adjoint`. `image` is the image. `arrays` are the arrays of the
    survey.
    """

    def __init__(self, config: Config, mode: str, arrays: dict[str, np.ndarray]) -> None:
        super().__init__(config)
        self.mode, self.view = mode, self.problem.views[0]
        if "adjoints" in arrays:
            set_targets([self.view], arrays)
        self.mask = None if arrays["mask"].all() else to_tensor(arrays["mask"])
        self.adjoints = [to_tensor(array) for array in arrays.get("adjoints", ())]
        self.inside = arrays["mask"] != 0

    def step(self, seed: int, spp: int, image: int) -> tuple[np.ndarray, StepTimes]:
        """Return one sample as a flat float32 array of all parameters (or pixels), and the times of the step alone."""
        problem = self.problem
        if self.mode == "image":
            with dr.suspend_grad(), self.clock.step() as times:
                picture = render_image(problem.integrator, problem.scene, self.sensor, seed, spp)
                dr.eval(picture)
            return (np.array(picture, np.float32) * self.inside).ravel(), times
        if self.mode == "known":
            gradients, times = self.gradient(seed, self.adjoints[image % len(self.adjoints)], spp)
        else:
            gradients, times = self.gradient(seed, lambda seen: masked_loss(self.view, seen, self.mask), spp)
        row = [np.array(gradients[key], np.float32).ravel() for key in problem.selection.keys]
        return np.concatenate(row), times


def begin_sampling(first: dict[str, Any]) -> Begun:
    """Start the process. A request asks for `count` steps from number `start` on, with `spp` samples per pixel.

    The answer has `step_ms` of each step and the number of `new_kernels`. The samples (count, P) go to the file `out`.
    If `cold` is set, the answer also has the peak memory of Dr.Jit's arrays. `purpose` selects the seeds, and `image`
    selects dL/dI.
    """
    config = told(first)
    with np.load(first["arrays"]) as arrays:
        sampler = Sampler(config, first["mode"], {name: arrays[name] for name in arrays.files})

    def answer(question: dict[str, Any]) -> dict[str, Any]:
        if question["cold"]:
            reset_peak()
        rows, taken = [], []
        for number in range(question["start"], question["start"] + question["count"]):
            number_seed = seed(config.run.seed, number, sampler.sensor, first["purpose"])
            row, times = sampler.step(number_seed, question["spp"], question["image"])
            rows.append(row)
            taken.append(times)
        np.save(question["out"], np.stack(rows))
        reply = {"step_ms": [times.wall_ms for times in taken], "new_kernels": sum(t.new_kernels for t in taken)}
        return sampler.told(reply, question["cold"], question["release"])

    return {}, answer
