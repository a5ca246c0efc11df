"""Sampling of a run, decided before its first iteration: paths, pixels, guided emission, and the sequence of numbers.

Open settings are decided in the order paths, pixels, guiding, sequence. The setting `pixels` distributes the camera
paths over the pixels, and needs no steps (`guiding/pixels.py`). Alternating steps (`race.Turns`) compare two ways of
sampling, with dL/dI fixed at one image (`StepTrial`).

- `PathsPilot` tries other shares of light paths, without guiding. If one kind of paths finds all light, `PathsPilot`
    also tries this kind alone. The first share is one half. Further shares compete with the best share so far, towards
    the better side, as long as they win. If camera paths find all light, camera paths alone are tried first, because
    they may be a thousand times as efficient. Even a run of one second then gains, and a few small steps decide
    (`CameraPilot`). If camera paths win, the run needs their kernels anyway.
- `GuidingPilot` tries guided emission. The table learns first and then stays fixed. The time of a guided step includes
    the step's share of the run's learning: one more walk per lesson, and the Python code for a new table. Short steps
    underestimate the table of a run, because the run's table has learned from more paths. If light paths find all
    light, the guided steps use light paths only. With both kinds of paths, the weights ignore guiding and take away
    most of its benefit.
- `SequencePilot` tries low-discrepancy numbers. If the run is guided, both ways are guided and sample from one table.
    Later learning costs the same for both ways, and is left out. The noise of low-discrepancy numbers falls at least as
    fast as the inverse of the sample count, so short steps underestimate the gain. If guiding pays, low-discrepancy
    numbers without guiding first compete with guiding.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.config.files import in_words
from reslrb_cli.guiding.pixels import noted_part
from reslrb_cli.guiding.tables import Guiding, Purpose
from reslrb_cli.integrators.protocol import Job
from reslrb_cli.integrators.reslrb import Reslrb as Tracer
from reslrb_cli.integrators.step import render_image
from reslrb_cli.optimization.autotune import race
from reslrb_cli.optimization.decisions import Allowance
from reslrb_cli.optimization.losses import QUADRATIC
from reslrb_cli.optimization.memory import pixels_of
from reslrb_cli.optimization.moving import is_attached
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.sensitivity import finite, take_gradient
from reslrb_cli.optimization.views import View, slope, to_tensor
from reslrb_cli.records.cache import PilotCache
from reslrb_cli.records.clock import StepClock, StepTimes
from reslrb_cli.records.decisions import GuidedRecord, PathsRecord, PixelsRecord, SequenceRecord
from reslrb_cli.scene.needs import camera_finds_all, light_finds_all
from reslrb_cli.seeds import seed
from reslrb_cli.statistics import Array
from reslrb_cli.transport.film import PixelShares

#: Planned rounds for gradients with many entries, and with few, which tell less per round.
ROUNDS, ROUNDS_OF_FEW, FEW_ENTRIES = 8, 16, 64
#: Maximum cost of a guided step, and of one with low-discrepancy numbers, relative to another.
GUIDING_LONGER, SEQUENCE_LONGER = 3.0, 1.25
#: The first share of light paths, and the shares to try next: fewer as long as they are better, or a few if none are
#: better; otherwise more. Then the maximum relative cost of a step with another share, and the minimum share of the
#: time that must be left for a trial.
FIRST_SHARE, FEWER, MORE, PATHS_LONGER, LEAST_TURNS = 0.5, (0.2, 0.05), (0.8, 0.95, 1.0), 2.0, 0.1
#: Part of the share for which the sequence's rounds are planned; the first step also takes time, and is no round.
ROUNDS_SHARE = 0.8
#: Views for the comparison, spread over the training views, and values of each image.
MOST_VIEWS, MOST_VALUES = 4, 2**15
#: Samples of the image at which dL/dI is fixed, as a share of a step's.
IMAGE_SHARE = 0.25


def settle(problem: Problem, say: race.Say, cache: PilotCache | None = None) -> Problem:
    """Return `problem` with an integrator whose open sampling options have been decided.

    The problem needs its targets. Fields of the result hold the measurements. `say` receives lines about the
    measurements. `cache` has the measurements of earlier runs.
    """
    tuner = race.Tuner(problem, say, cache)
    settle_paths(tuner)
    settle_pixels(tuner)
    settle_sampling(tuner)
    tuner.tell()
    return tuner.problem


def settle_paths(tuner: race.Tuner) -> None:
    """Decide the integrator's share of light paths, if both kinds of paths can render the scene.

    The configuration must leave the decision open. Either `paths` is `auto`, or `paths` is `both` and `light_share` is
    `auto`.
    """
    problem = tuner.problem
    if not race.is_auto(problem.config, "paths") or problem.paths != "both":
        return
    sides = _paths(tuner)
    tuner.take(sides=sides, integrator=with_sides(problem.integrator, sides))


def settle_pixels(tuner: race.Tuner) -> None:
    """Distribute the camera paths of the problem's integrator over the pixels, for the initial values of the
    parameters.

    The camera paths are distributed if the configuration asks for the distribution, or if `_whether_pixels` decides so.
    The kinds of paths must be decided first.
    """
    problem = tuner.problem
    tracer, asked = problem.integrator, problem.config.integrator.options().get("pixels", "even")
    if asked == "even" or not isinstance(tracer, Tracer) or tracer.paths == "light":
        return
    if asked == "auto":
        record = _whether_pixels(problem)
        tuner.take(pixels=record)
        if not record.measured:
            return
    problem.apply()
    scene, params = problem.scene, problem.selection.params
    jobs = {view.sensor: Job(scene, scene.sensors()[view.sensor], mi.UInt32(0), 0, params) for view in problem.trained}
    known = all(loss.type in QUADRATIC for loss in problem.config.losses)
    curvatures = {view.sensor: view.curvature(known) for view in problem.trained}
    noted = {str(sensor): tracer.note_pixels(job, curvatures[sensor]) for sensor, job in jobs.items()}
    tuner.take(integrator=tracer.shared_out(noted))
    tuner.set_aside(sum(map(PixelShares.bytes, pixels_of(scene, list(jobs)))))


def _whether_pixels(problem: Problem) -> PixelsRecord:
    """Decide whether `auto` distributes camera paths over the pixels.

    `auto` distributes camera paths only if the loss is l2 and the measurement is a small part of the run. With
    relative_l2, a mirror room had twice the variance in some colours (docs/notes/method.md).
    """
    if any(loss.type != "l2" for loss in problem.config.losses):
        return PixelsRecord(measured=False, note="unchanged, because not every loss is l2")
    run, films = problem.config.run, pixels_of(problem.scene, [view.sensor for view in problem.trained])
    each = run.iterations * run.spp * len(problem.drawn(0)) / len(films)
    part = noted_part(each * sum(films), each)
    if part is None:
        return PixelsRecord(measured=False, note="the run is too short for it")
    return PixelsRecord(measured=True, note=f"by noise, measured with {100 * part:.2g} % of this run's samples")


def with_sides(integrator: Any, sides: PathsRecord | None) -> Any:
    """Return an integrator with the decided paths."""
    return integrator if sides is None else integrator.afresh(light_share=sides.light_share)


def settle_sampling(tuner: race.Tuner) -> None:
    """Decide the open options of sampling. Guiding comes first. The sequence comes second, and may replace guiding or
    be added to guiding.
    """
    config, plain, memory = tuner.problem.config, tuner.problem.integrator, tuner.problem.memory
    trials: list[StepTrial] = []  # trials so far
    if race.is_auto(config, "guiding") and (guided := _guided(tuner, trials)) is not None:
        if guided.guided and guides_light_alone(tuner.problem):
            sides, plain = _light_alone(tuner.problem.sides, guided), plain.afresh(light_share=1.0)
            tuner.take(sides=sides)
        tuner.take(guided=guided, integrator=as_decided(plain, guided, None))
        if guided.guided:
            tuner.set_aside(table_bytes(tuner.problem))
    if isinstance(plain, Tracer) and plain.paths == "camera":  # no path starts at the emitters
        return
    if race.is_auto(config, "sequence"):
        sequence, found = _sequence(tuner, trials), tuner.problem.guided
        if found is not None and sequence.alone and sequence.low_discrepancy:
            note = f"low-discrepancy numbers without it have {sequence.gain:.2g} times the efficiency"
            found = replace(found, guided=False, images=False, note=note)
            integrator = tuner.problem.integrator.afresh(guided=False)
            tuner.take(guided=found, integrator=integrator, memory=memory)
        tuner.take(sequence=sequence, integrator=as_decided(tuner.problem.integrator, None, sequence))


def as_decided(integrator: Any, guided: GuidedRecord | None, sequence: SequenceRecord | None) -> Any:
    """Return `integrator` with the decided guiding and the decided sequence."""
    if guided is not None and guided.guided:
        integrator = integrator.afresh(guided=True, images=guided.images)
    if sequence is not None and sequence.low_discrepancy:
        integrator = integrator.afresh(low_discrepancy=True)
    return integrator


def table_bytes(problem: Problem) -> int:
    """Return the size of all sensors' tables in bytes, for `problem.integrator` with guiding."""
    made = problem.integrator.afresh(guided=True, light_share=1.0 if guides_light_alone(problem) else None)
    if made.paths == "camera":
        return 0
    made.plan(problem.scene, problem.scene.sensors()[problem.sensors[0]])  # cuts the grid
    return int(made.preparation.guiding.bytes(len(problem.sensors)))


def guides_light_alone(problem: Problem) -> bool:
    """True if guiding is tried with light paths only, instead of with the measured share of camera paths."""
    return problem.sides is not None and problem.sides.light_share < 1 and _light_finds_all(problem)


def _light_finds_all(problem: Problem) -> bool:
    sensors = [problem.scene.sensors()[sensor] for sensor in problem.sensors]
    return light_finds_all(problem.scene, sensors, problem.integrator.hide_emitters)


def _light_alone(sides: PathsRecord | None, guided: GuidedRecord) -> PathsRecord:
    """Return `sides`, changed to light paths only. The caller has found that guided light paths are better."""
    assert sides is not None
    note = f"guided, they have {guided.gain:.2g} times the efficiency of {100 * sides.light_share:g} %"
    return replace(sides, paths="both", light_share=1.0, gain=None, low=None, high=None, note=note)


def suits_even_numbers(problem: Problem) -> str | None:
    """Return why low-discrepancy numbers are probably better than guiding in this scene, or None
    (docs/sequences.md).
    """
    if is_attached(problem):
        return "for moving light, low-discrepancy numbers help most"
    for emitter in problem.scene.emitters():
        if not mi.has_flag(emitter.flags(), mi.EmitterFlags.Delta) and emitter.class_name() != "DirectionalArea":
            return None
    return "for light from points and beams, low-discrepancy numbers help most"


def sizes(problem: Problem, longer: float, planned: float = race.PLANNED) -> race.Sizes:
    """Return the sample counts of the run's steps and of the planned measured steps."""
    run, adjoint = problem.config.run, problem.config.adjoint
    call = run.spp // race.sets_of(problem.config)
    part = min(problem.samples_per_pass or call, call)
    entries = sum(problem.selection.array(key).size for key in problem.selection.keys)
    learned = race.lessons(problem) / (run.spp / call * len(problem.drawn(0)))
    rounds = ROUNDS_OF_FEW if entries < FEW_ENTRIES else ROUNDS
    return race.Sizes(run.spp, call, part, adjoint == "independent", rounds, learned, longer, planned)


def planned(share: float) -> float:
    """Return the planned time for rounds of the sequence decision, in units of steps. Longer steps show more of the
    gain.
    """
    return min(ROUNDS_SHARE * share * race.ITERATIONS, race.PLANNED)


def share_left(problem: Problem, allowance: Allowance, reserved: float = 0.0, kernels: float = 0.0) -> float:
    """Return the remaining time for measurements, as a share of the time of 200 iterations.

    `reserved` is the share that is kept for other measurements. A short run may have less time left. `kernels` is a
    number of steps. Time to compile the kernels of these steps is subtracted.
    """
    spent = sum(each.share for each in (problem.sides, problem.guided) if each is not None)
    return max(min(race.SHARE - spent - reserved, allowance.iterations_left(kernels) / race.ITERATIONS), 0.0)


# --- decisions --------------------------------------------------------------------------------------------------------


class GuidingPilot(race.Turns[GuidedRecord]):
    """Decision: guided, or not."""

    APART = True

    def _more_ms(self) -> float:
        """Return the additional time of learning, as the mean over the run."""
        sizes = self._sizes
        kernel = self._walk.kernel_ms * sizes.part / sizes.learning
        return (kernel + self._walk.beside_ms) * sizes.lessons * sizes.trial / sizes.call

    def _decide(self, other: bool, images: bool, found: dict[str, Any]) -> GuidedRecord:
        return GuidedRecord(guided=other, images=images, **found)


class SequencePilot(race.Turns[SequenceRecord]):
    """Decision between low-discrepancy numbers and independent numbers."""

    def _decide(self, other: bool, images: bool, found: dict[str, Any]) -> SequenceRecord:
        return SequenceRecord(low_discrepancy=other, **found)


class PathsPilot(race.Turns[PathsRecord]):
    """Decision between other paths and the current paths."""

    def _decide(self, other: bool, images: bool, found: dict[str, Any]) -> PathsRecord:
        return PathsRecord(paths="other" if other else "both", **found)


class CameraPilot(PathsPilot):
    """Decision for or against the use of camera paths only. Runs of any length can make this decision.

    The minimum number of rounds is the planned number. If the samples at the minimum cost allow fewer rounds, the
    smaller number applies. The time of Python code is ignored. If steps take milliseconds, times must not decide
    whether anything is measured.
    """

    def __init__(self, take: race.Take, sizes: race.Sizes, *rest: Any, **more: Any) -> None:
        super().__init__(take, sizes, *rest, **more)
        fits = int(race.CAMERA_NEEDS[1] * sizes.step / ((1 + sizes.longer) * sizes.trial))
        self.LEAST = max(min(sizes.rounds, fits), race.LEAST_ROUNDS)

    def _affords(self, more_ms: float) -> bool:
        return len(self._steps[True]) < self.LEAST or super()._affords(more_ms)


def _paths(tuner: race.Tuner) -> PathsRecord:
    """Decide the share of light paths."""
    problem = tuner.problem
    alone = camera_finds_all(problem.scene, problem.integrator.max_depth)
    needs = race.CAMERA_NEEDS if alone else race.PATHS_NEEDS

    def measure(allowance: Allowance) -> PathsRecord:
        best, records, trials = FIRST_SHARE, list[PathsRecord](), list[StepTrial]()
        left = min(race.PATHS_SHARE, allowance.iterations_left(needs[0]) / race.ITERATIONS)

        def climb(shares: Sequence[float]) -> None:
            """Try the given shares in turn. Stop when a share is not better than the best share so far."""
            nonlocal best
            for share in shares:
                part = (left - sum(record.share for record in records)) / 2
                if part < LEAST_TURNS * race.PATHS_SHARE:
                    return
                own, other = (_of_share(problem, value) for value in (best, share))
                trials.append(StepTrial(problem, f"paths {share:g}", own, other, *trials[-1:]))
                kind = PathsPilot if share else CameraPilot
                record = trials[-1].turns(kind, sizes(problem, PATHS_LONGER, planned(part)), part)
                words = f"over that of {100 * best:g} %" if record.paths == "other" else f"that of {100 * share:g} %"
                records.append(replace(record, note=record.note or words))
                if record.paths != "other":
                    return
                best = share

        climb([0.0] if alone else [])
        climb(FEWER if best else FEWER[::-1])
        if best == FIRST_SHARE:
            climb([share for share in MORE if share < 1 or _light_finds_all(problem)])
        gained = [record for record in records if record.paths == "other"]
        kept = (gained or records or [PathsRecord(paths="both", note="too little time to compare shares")])[-1]
        costs = {name: sum(getattr(each, name) for each in records) for name in ("measure_s", "compile_s", "share")}
        return replace(kept, paths="both" if best else "camera", light_share=best, **costs)

    later = [race.LATER[option] for option in ("guiding", "sequence") if race.is_auto(problem.config, option)]
    return tuner.decide(
        PathsRecord,
        of={"paths": 5},
        # Later measurements concern light paths; if camera paths may replace them, they can wait.
        needs=[needs] if alone else [needs, *later],
        integrator=problem.integrator,
        measure=measure,
        unmeasured=lambda note: PathsRecord(paths="both", note=f"{note}; half of them costs little in any scene"),
        later=later,
    )


def _of_share(problem: Problem, share: float) -> Tracer:
    """Return the problem's integrator with this share of light paths. A share of 0 leaves only camera paths."""
    tracer: Tracer = problem.integrator.afresh(light_share=share)
    return tracer


def _guided(tuner: race.Tuner, trials: list[StepTrial]) -> GuidedRecord | None:
    """Decide whether the problem's integrator is guided, or replaced by guided light paths.

    `trials` receives the steps. Returns None if no path starts at an emitter.
    """
    problem = tuner.problem
    alone = guides_light_alone(problem)
    if isinstance(problem.integrator, Tracer) and problem.integrator.paths == "camera" and not alone:
        return None
    if problem.memory is not None:
        free, needed = problem.memory.budget_bytes - problem.memory.expected_bytes.total, table_bytes(problem)
        if needed > free:
            return GuidedRecord(guided=False, note=f"run.memory_budget has no room for tables of {in_words(needed)}")
    sequence = race.is_auto(problem.config, "sequence")
    why = suits_even_numbers(problem) if sequence else None
    plan = sizes(problem, GUIDING_LONGER)

    def measure(allowance: Allowance) -> GuidedRecord:
        share = share_left(problem, allowance, race.SEQUENCE_SHARE if sequence else 0.0, race.GUIDING_NEEDS[0])
        plain = problem.integrator.afresh(guided=False)
        guided = problem.integrator.afresh(guided=True, light_share=1.0 if alone else None)
        trials.append(StepTrial(problem, "guiding", plain, guided))
        record = trials[-1].turns(GuidingPilot, plan, share)
        if alone and record.guided and not record.images and plan.alone:
            return replace(record, guided=False, note="images would have less")
        return record

    return tuner.decide(
        GuidedRecord,
        # Learning is a larger part of a short run, because tables learn most often at the start.
        of={"guiding": 6, "lessons": plan.lessons} | _sides(problem),
        # If low-discrepancy numbers are likely to win, measuring only guiding would mislead.
        needs=(race.GUIDING_NEEDS, *([] if why is None else 2 * [race.SEQUENCE_NEEDS])),
        integrator=problem.integrator,
        measure=measure,
        unmeasured=lambda note: GuidedRecord(guided=False, note=f"{note}; {why or 'it pays in long runs'}"),
        later=[(0.0, race.LATER["sequence"][1])] if sequence else [],
    )


def _sides(problem: Problem) -> dict[str, Any]:
    """Return the path settings that a decision depends on."""
    sides = problem.sides
    return {} if sides is None else {"sides": [sides.paths, sides.light_share]}


def _sequence(tuner: race.Tuner, trials: list[StepTrial]) -> SequenceRecord:
    """Decide the sequence of the problem's integrator. `trials` has the trials of the decision on guiding."""
    problem, found = tuner.problem, tuner.problem.guided
    plain, is_guided = problem.integrator, problem.integrator.preparation.guiding is not None

    def pilot(name: str, guided: bool | None, share: float) -> SequenceRecord:
        """Return the result for this share of the run. `guided` overrides the guiding of the run."""
        even = plain.afresh(guided=guided, low_discrepancy=True)
        trials.append(StepTrial(problem, name, plain.afresh(low_discrepancy=False), even, *trials[-1:]))
        return trials[-1].turns(SequencePilot, sizes(problem, SEQUENCE_LONGER, planned(share)), share)

    def measure(allowance: Allowance) -> SequenceRecord:
        if found is None or not found.guided:
            return pilot("sequence", None, share_left(problem, allowance, kernels=race.SEQUENCE_NEEDS[0]))
        # Guided paths start in their own cells, which leave little to spread evenly. Low-discrepancy numbers without
        # guiding do better where they determine nearly everything, as in a beam through glass.
        share = share_left(problem, allowance, kernels=2 * race.SEQUENCE_NEEDS[0])
        alone = replace(pilot("sequence alone", False, share / 2), alone=True)
        if alone.low_discrepancy:
            return alone
        record = pilot("sequence", None, share_left(problem, allowance, alone.share, race.SEQUENCE_NEEDS[0]))
        costs = ("measure_s", "compile_s", "share")
        return replace(record, **{name: getattr(record, name) + getattr(alone, name) for name in costs})

    def unmeasured(note: str) -> SequenceRecord:
        why = "guided paths gain little from others" if is_guided else suits_even_numbers(problem)
        note = f"{note}; {why or 'evenly spread ones have been no loss in any scene'}"
        return SequenceRecord(low_discrepancy=not is_guided, note=note)

    guided = None if found is None else [found.guided, found.images]
    of = {"sequence": 2, "of": guided} | _sides(problem)
    return tuner.decide(SequenceRecord, of, [race.SEQUENCE_NEEDS], plain, measure, unmeasured)


# --- steps ------------------------------------------------------------------------------------------------------------


class StepTrial:
    """Steps of a problem, taken by the integrator `plain` or by the integrator `other`. The steps leave no gradients,
    and do not change the problem.

    `views` are the used views. If either integrator is guided, the guided integrators sample from one table. The shared
    table comes from `earlier` if `earlier` has a table. Otherwise, the table is new. `what` is the name of the current
    decision. `earlier` is the trial of the previous decision with the same estimator. Both trials have the same fixed
    dL/dI.
    """

    def __init__(
        self, problem: Problem, what: str, plain: Tracer, other: Tracer, earlier: StepTrial | None = None
    ) -> None:
        self._problem, self._what, self._clock = problem, what, StepClock()
        self._adjoint = problem.config.adjoint
        # Separate integrators, because other sample counts would drop the tables and recordings of the run.
        self._tracers = [one.with_options(samples_per_pass=None, freeze=one.freeze) for one in (plain, other)]
        self._guided = [one for one in self._tracers if one.preparation.guiding is not None]
        self.table: Guiding | None = earlier.table if earlier is not None and self._guided else None
        if self._guided:
            own = self._guided[0].preparation.guiding
            assert own is not None
            self.table = self.table or own
            self.table.images, self.table.held = own.images, True  # steps must not update it
            for tracer in self._guided:
                tracer.preparation.draw_from(self.table, problem.scene)
        problem.apply()
        if earlier is not None:
            self.views: list[View] = earlier.views
            self._slopes: list[mi.TensorXf] = earlier._slopes
            return
        trained = problem.trained
        count = min(len(trained), MOST_VIEWS)
        self.views = [trained[k * len(trained) // count] for k in range(count)]
        self._slopes = [self._slope(view) for view in self.views]
        take_gradient(problem)  # recovered exposures have some of these entries

    def turns(self, kind: type[race.Turns[race.Record]], sizes: race.Sizes, share: float) -> race.Record:
        """Return the result of alternating steps."""
        part_of_views = len(self._problem.drawn(0)) / len(self.views)
        return kind(self.take, sizes, part_of_views, share, learn=self.learn if self._learns else None).run()

    @property
    def _learns(self) -> bool:
        """Whether a table must still learn."""
        return self.table is not None and not self.table.learned

    def _slope(self, view: View) -> mi.TensorXf:
        """Return the fixed dL/dI. Non-finite values become 0."""
        spp = max(int(IMAGE_SHARE * self._problem.config.run.spp), 1)
        image = render_image(self._tracers[False], self._problem.scene, view.sensor, self._seed(0, view, "image"), spp)
        return to_tensor(finite(slope(view.objective, np.array(image))))

    def learn(self, round: int, spp: int) -> race.Step:
        """Let the table learn, and prepare it for sampling. It stays unchanged from then on.

        The first call does all work twice, and drops the first result. The learning time then excludes compilation and
        recording.
        """
        jobs = [self._job(view, self._seed(round, view, "learned from"), spp) for view in self.views]
        compile_ms = 0.0
        assert self.table is not None
        if self._learns:
            compile_ms = self._teach(self.table, jobs).wall_ms
            self.table.forget()
        taken = race.timed(self._teach(self.table, jobs))
        taken.compile_ms += compile_ms
        return taken

    def _teach(self, table: Guiding, jobs: list[Job]) -> StepTimes:
        with self._clock.step() as times:
            for view, job, gradient in zip(self.views, jobs, self._slopes, strict=True):
                self._guided[0].learn_now(job, gradient)
                for purpose in Purpose if self._adjoint == "independent" else (Purpose.BOTH, Purpose.IMAGE):
                    table.table(view.sensor, purpose)
        return times

    def take(self, other: bool, round: int, spp: int) -> race.Step:
        """Take one step of all views."""
        problem, images = self._problem, {}
        tracer, name = self._tracers[other], "on" if other else "off"
        problem.apply()
        with self._clock.step() as times:
            for view, gradient in zip(self.views, self._slopes, strict=True):
                job = self._job(view, self._seed(round, view, name), spp)
                image = self._differentiate(tracer, view, job, gradient)
                gradients = problem.gradients()
                dr.eval(image, gradients)
                images[str(view.sensor)] = image
        taken = race.timed(times)
        taken.gradients = take_gradient(problem)
        if self._adjoint == "independent":
            with self._clock.step() as times:
                for view in self.views:
                    job = self._job(view, self._seed(round, view, f"image, {name}"), spp)
                    images[str(view.sensor)] = tracer.image(job)
            apart = race.timed(times)
            taken.image_ms = apart.kernel_ms
            taken.wall_ms, taken.compile_ms = taken.wall_ms + apart.wall_ms, taken.compile_ms + apart.compile_ms
        taken.images = {name: _few(image) for name, image in images.items()}
        return taken

    def _differentiate(self, tracer: Tracer, view: View, job: Job, gradient: mi.TensorXf) -> mi.TensorXf | None:
        """Add the gradient of a job's samples as in a step of the run. Returns their image if there is one."""
        on_samples = self._problem.on_samples(view)
        if self._adjoint == "correlated":
            image = tracer.correlated(job, lambda image: gradient)
        elif self._adjoint == "independent" and on_samples is None:
            tracer.backward(job, gradient)
            return None
        else:
            image = tracer.known(job, gradient)
        if on_samples is not None:
            on_samples(image, gradient)
        return image

    def _job(self, view: View, number: int, spp: int) -> Job:
        scene = self._problem.scene
        opaque = dr.opaque(mi.UInt32, number)
        return Job(scene, scene.sensors()[view.sensor], opaque, spp, self._problem.selection.params)

    def _seed(self, round: int, view: View, what: str) -> int:
        return seed(self._problem.config.run.seed, round, view.sensor, f"{self._what}, {what}")


def _few(image: mi.TensorXf) -> Array:
    """Return some values, distributed over an image. Non-finite values become 0."""
    values = np.array(image, dtype=np.float32).ravel()
    return finite(values[:: -(-values.size // MOST_VALUES)])
