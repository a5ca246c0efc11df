"""Samples of what takes part in a gradcheck, seed by seed, until there are enough or time is up."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable
from typing import Any

import numpy as np

from reslrb_cli.measure.gradients import seeds
from reslrb_cli.measure.participants import Participants, Settings
from reslrb_cli.records.gradcheck import Reference

#: Seeds, where no number is given: so many of everything, then more of what is cheap, as the budget allows.
LEAST_SEEDS, MOST_SEEDS = 8, 64
#: After which seeds the caller is told.
REPORTED = tuple(2**k for k in range(3, 20))
#: Fewer seeds have no standard error worth the name; what is interrupted before is not judged.
FEWEST = 3
#: Bytes that samples may take.
MEMORY = 2**30

Name = tuple[str, str]
Sample = Callable[[], np.ndarray]


class Sampling:
    """Samples by kind and name; `now` is the clock that the budget is measured with, from the beginning."""

    def __init__(self, settings: Settings, now: Callable[[], float] = time.monotonic) -> None:
        self._start, self._now, self.settings = now(), now, settings
        self.participants = Participants(settings)
        self._samples: dict[Name, list[np.ndarray]] = defaultdict(list)

    def of(self, kind: str, name: str) -> np.ndarray:
        """The samples of one kind, (N, P): `gradient` and `image` by an integrator's label, `differences` and
        `tangents` (N, directions) by a parameter."""
        return np.stack(self._samples[kind, name]).astype(np.float64)

    @property
    def enough(self) -> bool:
        """Whether there is something to compare."""
        return bool(self._samples) and all(len(samples) >= FEWEST for samples in self._samples.values())

    def run(self, stop: Callable[[], bool], say: Callable[[str], None]) -> None:
        """Take the samples of one seed after the other; ends with what is done once `stop()`."""
        settings, parts = self.settings, self.participants
        for key in parts.case.keys:
            if stop():
                return
            parts.choose_steps(key)
        least = settings.seeds or LEAST_SEEDS
        most = settings.seeds or max(least, min(MOST_SEEDS, self._seeds_in_memory()))
        for number, seed in enumerate(seeds(most)):
            begin = self._now()
            samples = self._samples_of(seed, everything=number < least)
            if not self._take(samples, stop):
                return
            now = self._now()
            if number == 0:
                say(f"first seed after {now - self._start:.1f} s, compiling included")
            elif number + 1 in REPORTED:
                say(f"seed {number + 1} after {now - self._start:.1f} s")
            if number >= least - 1 and settings.seeds is None and 2 * now - begin - self._start > settings.budget_s:
                return

    def _seeds_in_memory(self) -> int:
        size = sum(len(values) for values in self.participants.case.initial.values())
        return MEMORY // (4 * size * (len(self.participants.integrators) + 2))

    def _take(self, samples: list[tuple[Name, Sample]], stop: Callable[[], bool]) -> bool:
        """Everything at one seed; whether it was done."""
        taken = []
        for name, sample in samples:
            if stop():
                return False
            taken.append((name, sample()))
        for name, value in taken:
            self._samples[name].append(value.astype(np.float32))
        return True

    def _samples_of(self, seed: int, everything: bool) -> list[tuple[Name, Sample]]:
        parts, found = self.participants, []

        def add(kind: str, name: str, function: Callable[..., Any], *arguments: Any) -> None:
            found.append(((kind, name), lambda: np.asarray(function(*arguments))))

        stock = {reference.value for reference in parts.stock.values() if reference is not None}
        naive = ["walk_ad"] if everything else []
        compared = [Reference.WALK_AD, Reference.FINITE_DIFFERENCE, *(r for r in parts.stock.values() if r is not None)]
        ours = dict.fromkeys(parts.sampled(listed.label, other) for listed in parts.listed for other in compared)
        for label in [*ours, *sorted(stock), *naive]:
            add("gradient", label, parts.gradient, label, seed)
        for label in () if parts.image is None else ("walk_ad", parts.image.value):
            add("image", label, parts.picture, label, seed)
        for key in parts.case.keys if everything else ():
            add("differences", key, parts.differences, key, seed)
            if not parts.attached:  # forward mode is the same for all estimators, and has no attached derivatives
                add("tangents", key, parts.tangents, parts.listed[0].label, key, seed)
        return found
