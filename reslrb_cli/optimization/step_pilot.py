"""Whether another way of drawing samples pays here: steps that draw so take turns with steps as they are.

Gradients have dL/dI held at one image's, so that both kinds estimate the same. Times are those of kernels, and, alike
for both kinds, what goes on beside them in a run for as many samples: it counts where iterations take milliseconds.
Where steps draw from a table that paths before them have made, it is learned first, and held: none of the steps' paths
is one that it learned from.
"""

from __future__ import annotations

import statistics
from dataclasses import dataclass, field
from typing import Any, Generic, Protocol, TypeVar

from reslrb_cli.optimization.gains import CONFIDENCE, Gain, compare
from reslrb_cli.optimization.pilot_records import ITERATIONS, Gradients
from reslrb_cli.optimization.step_sizes import Sizes
from reslrb_cli.records.paid import LEAST_IMAGE, PaidRecord

Record = TypeVar("Record", bound=PaidRecord)

#: Fewer rounds than these say nothing.
LEAST_ROUNDS = 4
#: Whenever as many rounds have been taken as are planned for it is asked whether it is clear, so often at the most.
LOOKS = 3
#: What is on before the last of these looks has to be surer than it would have to be at the end: looking again and
#: again must not make what is worth nothing pass.
CLEAR = 0.99
#: Walks that a table learns from before it is tried, where there is time for more than one.
LEARNINGS = 2


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

    @property
    def learns(self) -> bool:
        """Whether there is a table that has yet to learn."""
        ...

    def learn(self, round: int, spp: int) -> Taken:
        """Have the table learn, from a walk of `spp` samples per pixel; what is not given is left at 0."""
        ...

    def take(self, other: bool, round: int, spp: int) -> Taken:
        """A step as it is, or one that draws the other way; from what the table has learned, which stays as it is."""
        ...


class StepPilot(Generic[Record]):
    """One decision. `views` is how many times the views of an iteration are those of a step here, `share` what of
    ITERATIONS this may cost."""

    def __init__(self, trial: Trial, sizes: Sizes, views: float, share: float) -> None:
        self._trial, self._sizes, self._views, self._share = trial, sizes, views, share
        self._spent_ms = self._compile_ms = 0.0
        self._plain: list[Taken] = []  # all steps as they are whose times count
        self._steps: dict[bool, list[Taken]] = {False: [], True: []}
        self._walk = Taken()

    def run(self) -> Record:
        """Measure, and decide."""
        spp = self._sizes.trial
        self._first(self._trial.take(False, 0, spp))
        plain = self._spend(self._trial.take(False, 0, spp))
        self._plain.append(plain)
        # What Python takes is the same for both.
        kernels = (1 + self._sizes.longer) * (plain.kernel_ms + plain.image_ms)
        if not self._learned(kernels + 2 * plain.beside_ms):
            return self._off(f"to measure it would cost more than {100 * self._share:.2g} % of {ITERATIONS} iterations")
        self._first(self._trial.take(True, 0, spp))
        for round in range(1, 1 + LOOKS * self._sizes.rounds):
            both = [self._spend(self._trial.take(other, round, spp)) for other in (False, True)]
            for other, step in zip((False, True), both, strict=True):
                self._steps[other].append(step)
            self._plain.append(both[0])
            if not self._affords(sum(step.wall_ms for step in both)):
                break
            if round % self._sizes.rounds == 0 and self._is_clear():
                break
        return self._decided()

    def _learned(self, round_ms: float) -> bool:
        """Have the table learn, if it has not; False where that, and rounds of so long, cannot be afforded."""
        if not self._trial.learns:
            return self._affords(LEAST_ROUNDS * round_ms)
        walk = self._trial.learn(0, self._sizes.learning)
        if not self._affords(walk.wall_ms + LEAST_ROUNDS * round_ms):
            self._first(walk)
            return False
        self._walk = self._spend(walk)
        # What one walk more would gain is little beside what rounds that are too few leave open.
        rounds = max(self._sizes.rounds // 2, LEAST_ROUNDS)
        for number in range(1, LEARNINGS):
            if self._affords(self._walk.wall_ms + rounds * round_ms):
                self._walk = self._spend(self._trial.learn(number, self._sizes.learning))
        return True

    # --- cost ---------------------------------------------------------------------------------------------------------

    def _first(self, taken: Taken) -> Taken:
        """A step that had its kernels compiled, whose times are not counted."""
        self._compile_ms += taken.wall_ms + taken.compile_ms
        return taken

    def _spend(self, taken: Taken) -> Taken:
        self._spent_ms += taken.wall_ms
        self._compile_ms += taken.compile_ms
        return taken

    @property
    def _iteration_ms(self) -> float:
        """Of the run: kernels of all its samples, and what goes on beside them for each set that has one dL/dI."""
        kernels = statistics.median(step.kernel_ms + step.image_ms for step in self._plain)
        return self._views * (kernels + self._python_ms) * self._sizes.step / self._sizes.trial

    @property
    def _python_ms(self) -> float:
        """What goes on beside the kernels of `trial` samples in a run, which has it once for each `call`."""
        beside = statistics.median(step.beside_ms for step in self._plain)
        return beside * self._sizes.trial / self._sizes.call

    def _affords(self, more_ms: float) -> bool:
        return self._spent_ms + more_ms <= self._share * ITERATIONS * self._iteration_ms

    # --- judgement ----------------------------------------------------------------------------------------------------

    @property
    def _apart(self) -> bool:
        """Whether it is decided apart for images that have samples of their own."""
        return False

    def _more_ms(self) -> float:
        """What a step of the other kind, of `trial` samples, takes in a run beside its own kernels."""
        return 0.0

    def _decide(self, other: bool, images: bool, found: dict[str, Any]) -> Record:
        """The record of a decision, `found` what all of them hold."""
        raise NotImplementedError

    def _gain(self, images: bool, confidence: float = CONFIDENCE) -> Gain:
        """Of the gradient, as part of steps whose images, where they have samples of their own, are drawn so or not."""
        plain, other = self._steps[False], self._steps[True]
        beside = self._python_ms, self._python_ms + self._more_ms()
        if self._sizes.alone:
            own = [statistics.median(step.image_ms for step in steps) for steps in (plain, other)]
            beside = beside[0] + own[0], beside[1] + own[images]
        times = [[s.kernel_ms + more for s in steps] for steps, more in zip((plain, other), beside, strict=True)]
        gradients = [[step.gradients for step in steps] for steps in (plain, other)]
        return compare(gradients[0], times[0], gradients[1], times[1], confidence)

    def _image_gain(self) -> Gain:
        """Of the image: of samples of its own, where it has them, else of those that serve the gradient too."""
        plain, other = self._steps[False], self._steps[True]
        images = [[step.images for step in steps] for steps in (plain, other)]
        times = [[s.image_ms if self._sizes.alone else s.kernel_ms for s in steps] for steps in (plain, other)]
        if not self._sizes.alone:  # else both count once, with the gradient
            more = self._python_ms, self._python_ms + self._more_ms()
            times = [[ms + one for ms in row] for row, one in zip(times, more, strict=True)]
        return compare(images[0], times[0], images[1], times[1])

    def _is_clear(self) -> bool:
        """Whether no more steps are needed: it is not on by accident, or off at all events."""
        _, low, high = self._gain(not self._apart or self._images(self._image_gain()), CLEAR)
        return low is None or high is None or low > 1 or high < 1

    def _images(self, gain: Gain) -> bool:
        """Whether images are to be drawn so too; where that is not decided apart, whether no harm to them is seen."""
        if self._apart:
            return gain[1] is not None and gain[1] > 1
        return gain[2] is None or gain[2] >= LEAST_IMAGE

    def _decided(self) -> Record:
        if len(self._steps[False]) < LEAST_ROUNDS:
            return self._off(f"{len(self._steps[False])} steps of both are too few to tell")
        picture = self._image_gain()
        images = self._images(picture)
        gain = self._gain(images or not self._apart)
        if gain[1] is None:
            return self._off("gradients have no noise")
        note = ""
        if gain[1] > 1 and not (images or self._apart):
            whose = "images have" if self._sizes.alone else "the image, of the same samples, has"
            note = f"{whose} {picture[0]:.2g} times the efficiency"
        on = gain[1] > 1 and not note
        return self._record(on, on and images, gain, picture, note)

    def _off(self, note: str) -> Record:
        return self._record(False, False, (None, None, None), (None, None, None), note)

    def _record(self, other: bool, images: bool, gain: Gain, picture: Gain, note: str) -> Record:
        found = dict(zip(("gain", "low", "high"), gain, strict=True))
        found |= dict(zip(("image_gain", "image_low", "image_high"), picture, strict=True))
        rounds, share = len(self._steps[True]), self._spent_ms / (ITERATIONS * self._iteration_ms)
        seconds = {"measure_s": self._spent_ms / 1e3, "compile_s": self._compile_ms / 1e3}
        beside = {"rounds": rounds, "spp": self._sizes.trial, "share": share, "note": note}
        return self._decide(other, images, {**found, **seconds, **beside})
