"""Whether guided emission pays here: a table is learned, and held; then steps with it take turns with steps without.

Gradients have dL/dI held at one image's, so that both kinds estimate the same. None of their paths is one that the
table learned from. Times are those of kernels; to a guided step's is added its part of what a run goes on learning:
every EVERY-th gradient one more walk of one pass, with what Python does for a new table.

Short steps make the table less worth than a run's, which has learned from more, and draws more paths from each of its
cells. So the gain is rather more than what is found here, and what pays here pays there.
"""

from __future__ import annotations

import statistics
from dataclasses import dataclass, field
from typing import Protocol

from reslrb_cli.integrators.guiding import EVERY
from reslrb_cli.optimization.gains import CONFIDENCE, Gain, compare
from reslrb_cli.optimization.pilot_records import ITERATIONS, Gradients
from reslrb_cli.records.guided import LEAST_IMAGE, GuidedRecord

#: Share of a run of ITERATIONS that this is planned for, compilation apart; where it is not clear by then, it may take
#: what a pilot has left of its own.
SHARE = 0.025
#: Rounds that are planned for, of gradients of many entries, and of few, which tell less each; fewer than LEAST say
#: nothing. After each so many it is asked whether it is clear, so many times at the most.
ROUNDS, ROUNDS_OF_FEW, LEAST_ROUNDS = 8, 16, 4
FEW_ENTRIES = 64
LOOKS = 3
#: What is on before the last of these looks has to be surer than it would have to be at the end: looking again and
#: again must not make what is worth nothing pass.
CLEAR = 0.99
#: Walks that a table learns from before it is tried, and the samples of each, as a share of a step's.
LEARNINGS, LEARNING_SHARE = 2, 0.4
#: Steps' worth of time that the rounds are planned for; a guided step may take three times as long as another.
PLANNED, LONGER = 3.4, 3.0


@dataclass(frozen=True)
class Sizes:
    """Samples per pixel: of a step of the run (`step`), of each set of its samples that has one dL/dI (`call`), and of
    a pass of these (`part`). `alone`: images have samples of their own. `entries` are those of all gradients."""

    step: int
    call: int
    part: int
    alone: bool
    entries: int

    @property
    def rounds(self) -> int:
        """How many rounds are planned for."""
        return ROUNDS_OF_FEW if self.entries < FEW_ENTRIES else ROUNDS

    @property
    def trial(self) -> int:
        """Samples of each step that is taken here."""
        return max(min(int(PLANNED * self.step / ((1 + LONGER) * self.rounds)), self.part), 1)

    @property
    def learning(self) -> int:
        """Samples of each walk that is learned from here."""
        return max(min(int(LEARNING_SHARE * self.step), self.part), 1)


@dataclass
class Taken:
    """A step, or a walk that was learned from: its gradients, its image by view, and milliseconds: of the kernels, of
    those of an image that has samples of its own, and all that was waited for but for `compile_ms`."""

    gradients: Gradients = field(default_factory=dict)
    images: Gradients = field(default_factory=dict)
    kernel_ms: float = 0.0
    image_ms: float = 0.0
    wall_ms: float = 0.0
    compile_ms: float = 0.0

    @property
    def beside_ms(self) -> float:
        """What was waited for beside the kernels."""
        return max(self.wall_ms - self.kernel_ms - self.image_ms, 0.0)


class Trial(Protocol):
    """What is measured. Equal rounds have equal seeds, others than those of any walk that is learned from."""

    def learn(self, round: int, spp: int) -> Taken:
        """Have the table learn, from a walk of `spp` samples per pixel; what is not given is left at 0."""
        ...

    def take(self, guided: bool, round: int, spp: int) -> Taken:
        """A step, guided by what the table has learned, which stays as it is, or not guided."""
        ...


class GuidingPilot:
    """One decision. `views` is how many times the views of an iteration are those of a step here, `share` what of
    ITERATIONS this may cost."""

    def __init__(self, trial: Trial, sizes: Sizes, views: float = 1.0, share: float = SHARE) -> None:
        self._trial, self._sizes, self._views, self._share = trial, sizes, views, share
        self._spent_ms = self._compile_ms = self._iteration_ms = 0.0
        self._steps: dict[bool, list[Taken]] = {False: [], True: []}
        self._walk = Taken()

    def run(self) -> GuidedRecord:
        """Measure, and decide."""
        spp = self._sizes.trial
        self._first(self._trial.take(False, 0, spp))
        plain = self._spend(self._trial.take(False, 0, spp))
        scale = self._sizes.step / spp
        self._iteration_ms = self._views * ((plain.kernel_ms + plain.image_ms) * scale + plain.beside_ms)
        walk = self._first(self._trial.learn(0, self._sizes.learning))  # an estimate: it compiled
        self._spent_ms += walk.kernel_ms
        if not self._affords((LEARNINGS - 1) * walk.wall_ms + LEAST_ROUNDS * (1 + LONGER) * plain.wall_ms):
            return self._off(f"to measure it would cost more than {100 * self._share:.2g} % of {ITERATIONS} iterations")
        for number in range(1, LEARNINGS):
            self._walk = self._spend(self._trial.learn(number, self._sizes.learning))
        self._first(self._trial.take(True, 0, spp))
        for round in range(1, 1 + LOOKS * self._sizes.rounds):
            both = [self._spend(self._trial.take(guided, round, spp)) for guided in (False, True)]
            for guided, step in zip((False, True), both, strict=True):
                self._steps[guided].append(step)
            if not self._affords(sum(step.wall_ms for step in both)):
                break
            if round % self._sizes.rounds == 0 and self._is_clear():
                break
        return self._decided()

    # --- cost ---------------------------------------------------------------------------------------------------------

    def _first(self, taken: Taken) -> Taken:
        """A step that had its kernels compiled, whose times are not counted."""
        self._compile_ms += taken.wall_ms + taken.compile_ms
        return taken

    def _spend(self, taken: Taken) -> Taken:
        self._spent_ms += taken.wall_ms
        self._compile_ms += taken.compile_ms
        return taken

    def _affords(self, more_ms: float) -> bool:
        return self._spent_ms + more_ms <= self._share * ITERATIONS * self._iteration_ms

    # --- judgement ----------------------------------------------------------------------------------------------------

    def _learning_ms(self) -> float:
        """What learning adds to a guided step of `trial` samples, in the long run."""
        sizes = self._sizes
        kernel = self._walk.kernel_ms * sizes.part / sizes.learning
        return (kernel + self._walk.beside_ms) / EVERY * sizes.trial / sizes.call

    def _gain(self, images: bool, confidence: float = CONFIDENCE) -> Gain:
        """Of the gradient, as part of steps whose images, where they have samples of their own, are guided or not."""
        plain, guided = self._steps[False], self._steps[True]
        beside = 0.0, self._learning_ms()
        if self._sizes.alone:
            own = [statistics.median(step.image_ms for step in steps) for steps in (plain, guided)]
            beside = own[0], own[images] + beside[1]
        times = [[s.kernel_ms + more for s in steps] for steps, more in zip((plain, guided), beside, strict=True)]
        gradients = [[step.gradients for step in steps] for steps in (plain, guided)]
        return compare(gradients[0], times[0], gradients[1], times[1], confidence)

    def _image_gain(self) -> Gain:
        """Of the image: of samples of its own, where it has them, else of those that serve the gradient too."""
        plain, guided = self._steps[False], self._steps[True]
        images = [[step.images for step in steps] for steps in (plain, guided)]
        times = [[s.image_ms if self._sizes.alone else s.kernel_ms for s in steps] for steps in (plain, guided)]
        learning = 0.0 if self._sizes.alone else self._learning_ms()  # it counts once
        return compare(images[0], times[0], images[1], [ms + learning for ms in times[1]])

    def _is_clear(self) -> bool:
        """Whether no more steps are needed: it is not on by accident, or off at all events."""
        _, low, high = self._gain(self._sizes.alone and self._images(self._image_gain()), CLEAR)
        return low is None or high is None or low > 1 or high < 1

    def _images(self, gain: Gain) -> bool:
        """Whether images that have samples of their own are to be guided."""
        return gain[1] is not None and gain[1] > 1

    def _decided(self) -> GuidedRecord:
        if len(self._steps[False]) < LEAST_ROUNDS:
            return self._off(f"{len(self._steps[False])} steps of both are too few to tell")
        picture = self._image_gain()
        images = self._images(picture) if self._sizes.alone else picture[0] is None or picture[0] >= LEAST_IMAGE
        gain = self._gain(images)
        if gain[1] is None:
            return self._off("gradients have no noise")
        note = ""
        if gain[1] > 1 and not (images or self._sizes.alone):
            note = f"the image, of the same samples, has {picture[0]:.2g} times the efficiency"
        on = gain[1] > 1 and not note
        return self._record(on, on and images, gain, picture, note)

    def _off(self, note: str) -> GuidedRecord:
        return self._record(False, False, (None, None, None), (None, None, None), note)

    def _record(
        self,
        guided: bool,
        images: bool,
        gain: Gain,
        picture: Gain,
        note: str,
    ) -> GuidedRecord:
        return GuidedRecord(
            guided=guided,
            images=images,
            gain=gain[0],
            low=gain[1],
            high=gain[2],
            image_gain=picture[0],
            image_low=picture[1],
            image_high=picture[2],
            rounds=len(self._steps[True]),
            spp=self._sizes.trial,
            measure_s=self._spent_ms / 1e3,
            compile_s=self._compile_ms / 1e3,
            share=self._spent_ms / (ITERATIONS * self._iteration_ms),
            note=note,
        )
