"""The sampling of a run, settled before its first iteration: guided emission, and the sequence of numbers.

Each is settled where it is left to measurement: which paths there are, guiding, and then the sequence; and before
guiding, without steps, how camera paths are shared out over the pixels (`guiding/pixels.py`). Steps drawn one way take
turns with steps drawn the other (`race.Turns`), with dL/dI held at one image's (`StepTrial`):

- `PathsPilot`: another share of light paths, or paths of one side alone where that finds all light, unguided. One share
  after the other takes its turns with the best so far, from one half on to the side that was found to be the better, as
  long as one is. Camera paths alone come first where they find all: they may have a thousand times the efficiency, so
  that a run of a second is worth it, and a few small steps tell (`CameraPilot`), with kernels that the run needs anyway
  if they win.
- `GuidingPilot`: guided emission, from a table that is learned first, and held. To a guided step's time is added its
  part of what a run of that length learns: each time one more walk of one pass, with what Python does for a new table,
  often at first and then rarely. Short steps make the table less worth than a run's, which has learned from more, and
  draws more paths from each of its cells: what pays here pays there. Where light paths alone find all light they are
  what is guided: weights know nothing of guiding, and take from guided paths what camera paths might have found.
- `SequencePilot`: low-discrepancy numbers, guided if the run is; then both draw from one table. What a run goes on
  learning takes both the same time; it is left out, which makes more of the time that such numbers take. Noise of
  evenly spread numbers falls faster than with one over the samples, or as fast, so that short steps find less of the
  gain than whole ones have. Where guiding pays, they are tried in place of it first.
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

#: Rounds that are planned for, of gradients of many entries, and of few, which tell less each.
ROUNDS, ROUNDS_OF_FEW, FEW_ENTRIES = 8, 16, 64
#: A guided step, or one with low-discrepancy numbers, may take so many times as long as another.
GUIDING_LONGER, SEQUENCE_LONGER = 3.0, 1.25
#: The share of light paths that is begun with, and those that are tried then: fewer, as long as they are better, or,
#: where none at all are, a few after all; else more. Steps of another share may take so many times as long. A share is
#: tried where so much of the time is left for it.
FIRST_SHARE, FEWER, MORE, PATHS_LONGER, LEAST_TURNS = 0.5, (0.2, 0.05), (0.8, 0.95, 1.0), 2.0, 0.1
#: What of the share the rounds of the sequence are planned for; the first step takes a part too, and is no round.
ROUNDS_SHARE = 0.8
#: Views that are looked at, spread over those that are trained on, and values of each one's image.
MOST_VIEWS, MOST_VALUES = 4, 2**15
#: Samples of the image that dL/dI is held at, as a share of a step's.
IMAGE_SHARE = 0.25


def settle(problem: Problem, say: race.Say, cache: PilotCache | None = None) -> Problem:
    """Return `problem` with an integrator that draws samples as pays here, where that is left to measurement.

    Needs the targets. Fields of the problem hold the measurements; `say` is given a line of each, and `cache` holds the
    measurements of earlier runs.
    """
    tuner = race.Tuner(problem, say, cache)
    settle_paths(tuner)
    settle_pixels(tuner)
    settle_sampling(tuner)
    tuner.tell()
    return tuner.problem


def settle_paths(tuner: race.Tuner) -> None:
    """Have the integrator trace the paths that pay here, as far as that is left to
    measurement, and both kinds can render the scene."""
    problem = tuner.problem
    if not race.is_auto(problem.config, "paths") or problem.paths != "both":
        return
    sides = _paths(tuner)
    tuner.take(sides=sides, integrator=with_sides(problem.integrator, sides))


def settle_pixels(tuner: race.Tuner) -> None:
    """Share the camera paths of the problem's integrator out over the pixels, by the parameters' values at the start.

    The configuration asks for it, or leaves it to `_whether_pixels`. The kinds of paths have to be settled.
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
    """Decide whether `auto` shares camera paths out: the loss is l2 alone, and the run has so many paths that the noted
    ones, and their kernel, take a small part of it.

    A mirror room by relative_l2 has twice the variance with shares in some of its colours (docs/method.md).
    """
    if any(loss.type != "l2" for loss in problem.config.losses):
        return PixelsRecord(measured=False, note="left alone where the loss is not l2 alone")
    run, films = problem.config.run, pixels_of(problem.scene, [view.sensor for view in problem.trained])
    each = run.iterations * run.spp * len(problem.drawn(0)) / len(films)
    part = noted_part(each * sum(films), each)
    if part is None:
        return PixelsRecord(measured=False, note="a run as short as this has no time for it")
    return PixelsRecord(measured=True, note=f"where noise weighs most, by {100 * part:.2g} % of this run's samples")


def with_sides(integrator: Any, sides: PathsRecord | None) -> Any:
    """An integrator that traces the paths that were decided on, where they were."""
    return integrator if sides is None else integrator.afresh(light_share=sides.light_share)


def settle_sampling(tuner: race.Tuner) -> None:
    """Have the integrator draw samples as pays here, as far as that is left to
    measurement: guided or not; then from which sequence, in place of being guided, or else as the integrator is then.
    """
    config, plain, memory = tuner.problem.config, tuner.problem.integrator, tuner.problem.memory
    trials: list[StepTrial] = []  # what was measured on so far
    if race.is_auto(config, "guiding") and (guided := _guided(tuner, trials)) is not None:
        if guided.guided and guides_light_alone(tuner.problem):
            sides, plain = _light_alone(tuner.problem.sides, guided), plain.afresh(light_share=1.0)
            tuner.take(sides=sides)
        tuner.take(guided=guided, integrator=as_decided(plain, guided, None))
        if guided.guided:
            tuner.set_aside(table_bytes(tuner.problem))
    if isinstance(plain, Tracer) and plain.paths == "camera":  # nothing begins at the emitters
        return
    if race.is_auto(config, "sequence"):
        sequence, found = _sequence(tuner, trials), tuner.problem.guided
        if found is not None and sequence.alone and sequence.low_discrepancy:
            note = f"low-discrepancy numbers without it have {sequence.gain:.2g} times that"
            found = replace(found, guided=False, images=False, note=note)
            integrator = tuner.problem.integrator.afresh(guided=False)
            tuner.take(guided=found, integrator=integrator, memory=memory)
        tuner.take(sequence=sequence, integrator=as_decided(tuner.problem.integrator, None, sequence))


def as_decided(integrator: Any, guided: GuidedRecord | None, sequence: SequenceRecord | None) -> Any:
    """Return `integrator` with the ways of drawing samples that were decided."""
    if guided is not None and guided.guided:
        integrator = integrator.afresh(guided=True, images=guided.images)
    if sequence is not None and sequence.low_discrepancy:
        integrator = integrator.afresh(low_discrepancy=True)
    return integrator


def table_bytes(problem: Problem) -> int:
    """Bytes of the tables of all sensors, if `problem.integrator` is guided, or were."""
    made = problem.integrator.afresh(guided=True, light_share=1.0 if guides_light_alone(problem) else None)
    if made.paths == "camera":
        return 0
    made.plan(problem.scene, problem.scene.sensors()[problem.sensors[0]])  # cuts the grid
    return int(made.preparation.guiding.bytes(len(problem.sensors)))


def guides_light_alone(problem: Problem) -> bool:
    """Whether it is light paths alone that guiding is tried with, where there are camera paths beside or in place of
    them, of a share that was left to measurement."""
    return problem.sides is not None and problem.sides.light_share < 1 and _light_finds_all(problem)


def _light_finds_all(problem: Problem) -> bool:
    sensors = [problem.scene.sensors()[sensor] for sensor in problem.sensors]
    return light_finds_all(problem.scene, sensors, problem.integrator.hide_emitters)


def _light_alone(sides: PathsRecord | None, guided: GuidedRecord) -> PathsRecord:
    """What `sides` becomes where guided light paths alone do better."""
    assert sides is not None
    note = f"guided, they have {guided.gain:.2g} times the efficiency of {100 * sides.light_share:g} %"
    return replace(sides, paths="both", light_share=1.0, gain=None, low=None, high=None, note=note)


def suits_even_numbers(problem: Problem) -> str | None:
    """Why evenly spread numbers are likely to do better here than guided paths, by what the scene has; None where it is
    not known. docs/sequences.md has what this was seen on."""
    if is_attached(problem):
        return "of what moves light, evenly spread numbers say most"
    for emitter in problem.scene.emitters():
        if not mi.has_flag(emitter.flags(), mi.EmitterFlags.Delta) and emitter.class_name() != "DirectionalArea":
            return None
    return "of light from points and beams, evenly spread numbers say most"


def sizes(problem: Problem, longer: float, planned: float = race.PLANNED) -> race.Sizes:
    """The samples of the run's steps, and what is planned of those that are taken here."""
    run, adjoint = problem.config.run, problem.config.adjoint
    call = run.spp // race.sets_of(problem.config)
    part = min(problem.samples_per_pass or call, call)
    entries = sum(problem.selection.array(key).size for key in problem.selection.keys)
    learned = race.lessons(problem) / (run.spp / call * len(problem.drawn(0)))
    rounds = ROUNDS_OF_FEW if entries < FEW_ENTRIES else ROUNDS
    return race.Sizes(run.spp, call, part, adjoint == "independent", rounds, learned, longer, planned)


def planned(share: float) -> float:
    """Steps' worth of time that the sequence's rounds are planned for: the longer, the more of the gain is seen."""
    return min(ROUNDS_SHARE * share * race.ITERATIONS, race.PLANNED)


def share_left(problem: Problem, allowance: Allowance, reserved: float = 0.0, kernels: float = 0.0) -> float:
    """What earlier measurements left of the share of 200 iterations that all of them may cost, but for what is
    `reserved`, and no more than there is time for in a run as short as this, with `kernels` to compile."""
    spent = sum(each.share for each in (problem.sides, problem.guided) if each is not None)
    return max(min(race.SHARE - spent - reserved, allowance.iterations_left(kernels) / race.ITERATIONS), 0.0)


# --- what is decided --------------------------------------------------------------------------------------------------


class GuidingPilot(race.Turns[GuidedRecord]):
    """One decision: guided, or not."""

    APART = True

    def _more_ms(self) -> float:
        """What learning adds, in the mean over the run."""
        sizes = self._sizes
        kernel = self._walk.kernel_ms * sizes.part / sizes.learning
        return (kernel + self._walk.beside_ms) * sizes.lessons * sizes.trial / sizes.call

    def _decide(self, other: bool, images: bool, found: dict[str, Any]) -> GuidedRecord:
        return GuidedRecord(guided=other, images=images, **found)


class SequencePilot(race.Turns[SequenceRecord]):
    """One decision: low-discrepancy numbers, or independent ones."""

    def _decide(self, other: bool, images: bool, found: dict[str, Any]) -> SequenceRecord:
        return SequenceRecord(low_discrepancy=other, **found)


class PathsPilot(race.Turns[PathsRecord]):
    """One decision: other paths, or those that there are."""

    def _decide(self, other: bool, images: bool, found: dict[str, Any]) -> PathsRecord:
        return PathsRecord(paths="other" if other else "both", **found)


class CameraPilot(PathsPilot):
    """The same, of camera paths alone, in a run however short.

    As many rounds are taken as are planned for, or as there are samples for in what that may cost at least, whatever
    Python takes: of steps of milliseconds times are not to decide whether anything is measured.
    """

    def __init__(self, take: race.Take, sizes: race.Sizes, *rest: Any, **more: Any) -> None:
        super().__init__(take, sizes, *rest, **more)
        fits = int(race.CAMERA_NEEDS[1] * sizes.step / ((1 + sizes.longer) * sizes.trial))
        self.LEAST = max(min(sizes.rounds, fits), race.LEAST_ROUNDS)

    def _affords(self, more_ms: float) -> bool:
        return len(self._steps[True]) < self.LEAST or super()._affords(more_ms)


def _paths(tuner: race.Tuner) -> PathsRecord:
    """Which share of the paths are to be light paths."""
    problem = tuner.problem
    alone = camera_finds_all(problem.scene, problem.integrator.max_depth)
    needs = race.CAMERA_NEEDS if alone else race.PATHS_NEEDS

    def measure(allowance: Allowance) -> PathsRecord:
        best, records, trials = FIRST_SHARE, list[PathsRecord](), list[StepTrial]()
        left = min(race.PATHS_SHARE, allowance.iterations_left(needs[0]) / race.ITERATIONS)

        def climb(shares: Sequence[float]) -> None:
            """Take these shares in turn, as long as each is better than what there is."""
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
        # What is measured later is of light paths: where camera paths may do without, it can wait.
        needs=[needs] if alone else [needs, *later],
        integrator=problem.integrator,
        measure=measure,
        unmeasured=lambda note: PathsRecord(paths="both", note=f"{note}; half of them cost little anywhere"),
        later=later,
    )


def _of_share(problem: Problem, share: float) -> Tracer:
    """The problem's integrator with this share of light paths; none of them leaves camera paths alone."""
    tracer: Tracer = problem.integrator.afresh(light_share=share)
    return tracer


def _guided(tuner: race.Tuner, trials: list[StepTrial]) -> GuidedRecord | None:
    """Whether the problem's integrator is to be guided, or light paths in place of it;
    `trials` gets the steps of it. None where nothing begins at the emitters."""
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
        # Learning is a larger part of a short run, where tables learn most often at first.
        of={"guiding": 6, "lessons": plan.lessons} | _sides(problem),
        # Where even numbers are likely to do better, to measure guiding alone would mislead.
        needs=(race.GUIDING_NEEDS, *([] if why is None else 2 * [race.SEQUENCE_NEEDS])),
        integrator=problem.integrator,
        measure=measure,
        unmeasured=lambda note: GuidedRecord(guided=False, note=f"{note}; {why or 'it pays in long runs'}"),
        later=[(0.0, race.LATER["sequence"][1])] if sequence else [],
    )


def _sides(problem: Problem) -> dict[str, Any]:
    """Of what the integrator traces, what a decision depends on."""
    sides = problem.sides
    return {} if sides is None else {"sides": [sides.paths, sides.light_share]}


def _sequence(tuner: race.Tuner, trials: list[StepTrial]) -> SequenceRecord:
    """Which sequence the problem's integrator, guided or not, is to have; `trials`: what guiding was measured on."""
    problem, found = tuner.problem, tuner.problem.guided
    plain, is_guided = problem.integrator, problem.integrator.preparation.guiding is not None

    def pilot(name: str, guided: bool | None, share: float) -> SequenceRecord:
        """What is found in that share of the run; `guided`: with the other numbers, None: as the run is."""
        even = plain.afresh(guided=guided, low_discrepancy=True)
        trials.append(StepTrial(problem, name, plain.afresh(low_discrepancy=False), even, *trials[-1:]))
        return trials[-1].turns(SequencePilot, sizes(problem, SEQUENCE_LONGER, planned(share)), share)

    def measure(allowance: Allowance) -> SequenceRecord:
        if found is None or not found.guided:
            return pilot("sequence", None, share_left(problem, allowance, kernels=race.SEQUENCE_NEEDS[0]))
        # Guided paths start in cells of their own, within which little is left to spread evenly: where numbers
        # that are say nearly all, as under a beam through glass, they do better alone.
        share = share_left(problem, allowance, kernels=2 * race.SEQUENCE_NEEDS[0])
        alone = replace(pilot("sequence alone", False, share / 2), alone=True)
        if alone.low_discrepancy:
            return alone
        record = pilot("sequence", None, share_left(problem, allowance, alone.share, race.SEQUENCE_NEEDS[0]))
        costs = ("measure_s", "compile_s", "share")
        return replace(record, **{name: getattr(record, name) + getattr(alone, name) for name in costs})

    def unmeasured(note: str) -> SequenceRecord:
        why = "guided paths gain little by others" if is_guided else suits_even_numbers(problem)
        note = f"{note}; {why or 'evenly spread ones have been no loss in any scene'}"
        return SequenceRecord(low_discrepancy=not is_guided, note=note)

    guided = None if found is None else [found.guided, found.images]
    of = {"sequence": 2, "of": guided} | _sides(problem)
    return tuner.decide(SequenceRecord, of, [race.SEQUENCE_NEEDS], plain, measure, unmeasured)


# --- steps ------------------------------------------------------------------------------------------------------------


class StepTrial:
    """Steps of a problem by `plain`, or by `other`; they leave neither gradient nor change behind.

    `views` are those that are looked at. Where either is guided, both that are draw from one table: that of `earlier`,
    if it has learned, else one that `learn` has learn. `what` is decided here, and `earlier` what was before, with the
    same estimator; dL/dI is held where it was held there.
    """

    def __init__(
        self, problem: Problem, what: str, plain: Tracer, other: Tracer, earlier: StepTrial | None = None
    ) -> None:
        self._problem, self._what, self._clock = problem, what, StepClock()
        self._adjoint = problem.config.adjoint
        # Of their own: tables and recordings of other sample counts end with them.
        self._tracers = [one.with_options(samples_per_pass=None, freeze=one.freeze) for one in (plain, other)]
        self._guided = [one for one in self._tracers if one.preparation.guiding is not None]
        self.table: Guiding | None = earlier.table if earlier is not None and self._guided else None
        if self._guided:
            own = self._guided[0].preparation.guiding
            assert own is not None
            self.table = self.table or own
            self.table.images, self.table.held = own.images, True  # steps are not to teach it
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
        take_gradient(problem)  # recovered exposures have some of these

    def turns(self, kind: type[race.Turns[race.Record]], sizes: race.Sizes, share: float) -> race.Record:
        """What is found by these steps in turns."""
        part_of_views = len(self._problem.drawn(0)) / len(self.views)
        return kind(self.take, sizes, part_of_views, share, learn=self.learn if self._learns else None).run()

    @property
    def _learns(self) -> bool:
        """Whether there is a table that has yet to learn."""
        return self.table is not None and not self.table.learned

    def _slope(self, view: View) -> mi.TensorXf:
        """dL/dI, which is held; 0 where it is not finite."""
        spp = max(int(IMAGE_SHARE * self._problem.config.run.spp), 1)
        image = render_image(self._tracers[False], self._problem.scene, view.sensor, self._seed(0, view, "image"), spp)
        return to_tensor(finite(slope(view.objective, np.array(image))))

    def learn(self, round: int, spp: int) -> race.Step:
        """Have the table learn, and be ready to be drawn from, as it is from then on.

        The first time all of it is done before as well, and forgotten: what that compiles and records is no part of the
        time.
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
        """One step of all views."""
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
        """Add the gradient of a job's samples, as a step of the run does; their image, where there is one."""
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
    """Values of an image, spread over it, 0 where they are not finite."""
    values = np.array(image, dtype=np.float32).ravel()
    return finite(values[:: -(-values.size // MOST_VALUES)])
