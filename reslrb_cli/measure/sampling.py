"""Samples of a gradcheck's participants. Samples are taken on demand until they suffice or the time is up.

A session can continue from an earlier session's samples, with the next seeds. A sample depends only on the
participants, the finite-difference steps, and its seed.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from reslrb_cli.measure.gradients import seeds
from reslrb_cli.measure.methods import code_files, kept_settings
from reslrb_cli.measure.participants import CheckSettings, Participants
from reslrb_cli.records.measurement_files import Earlier, Kept, kept

#: Kind of measurement in the file of samples.
KIND = "gradcheck"

#: Name of samples: `gradient` or `image` and an integrator's label, or `differences` or `tangents` and a parameter.
Name = tuple[str, str]


@dataclass(frozen=True)
class Steps:
    """Steps of finite differences by way, and their errors: a pair for each direction."""

    chosen: Mapping[str, Sequence[tuple[float, float]]]

    @classmethod
    def of(cls, participants: Participants) -> Steps:
        """Return the steps of all parameters."""
        return cls({key: [(one.step, one.truncation) for one in ds] for key, ds in participants.directions.items()})

    def take(self, participants: Participants) -> None:
        """Set these steps."""
        for key, chosen in self.chosen.items():
            along = zip(participants.directions[key], chosen, strict=True)
            participants.directions[key] = [replace(one, step=step, truncation=error) for one, (step, error) in along]


def settings(checked: CheckSettings, variant: str, device: str) -> dict[str, Any]:
    """Return the settings that must be the same in all sessions."""
    labels, codes = [case.label for case in checked.integrators], code_files(checked.integrators)
    return kept_settings(checked.config, codes, variant, device, estimators=labels, spp=checked.spp)


#: Default seeds: the same number of everything, and more of cheap samples as the budget allows.
LEAST_SEEDS, MOST_SEEDS = 8, 64

#: Fewer seeds give no useful standard error and are not judged.
FEWEST = 3

#: References by naive AD, which compile much longer than any other.
NAIVE = ("walk_ad", "ptracer")

#: Maximum memory of samples in bytes.
MEMORY = 2**30


class Sampling:
    """Samples by kind and name. `now` is the clock for the budget. The clock starts when the object is created.

    The budget includes loading and compilation. The remaining budget is divided among the remaining samples. Time that
    one name leaves unused goes to the other names. A sample that has started is always finished. The first sample of a
    name includes compilation. The first sample of a name is skipped if it would probably exceed the remaining time.
    Earlier samples of the same kind, or else of other kinds, predict the duration.

    Samples of an `earlier` session count. New samples use the seeds that follow.
    """

    def __init__(
        self, settings: CheckSettings, now: Callable[[], float] = time.monotonic, earlier: Earlier | None = None
    ) -> None:
        self._now, self.settings = now, settings
        self._end = now() - settings.spent_s + settings.budget_s
        self.participants = Participants(settings)
        self._samples: dict[Name, list[np.ndarray]] = {}
        if earlier is not None:
            self._samples = {(kind, of): list(rows) for (kind, of), rows in earlier.samples.items()}
            Steps(earlier.head["steps"]).take(self.participants)
        self._before = {name: len(samples) for name, samples in self._samples.items()}
        #: Called after each sample.
        self.between: Callable[[], None] = lambda: None
        self._taken: set[Name] = set()
        self._expected: list[Name] = []
        self._first_s: dict[tuple[str, bool], float] = {}  # longest duration of a first sample, by kind

    def expect(self, names: Iterable[Name]) -> None:
        """Announce names before sampling, so that each name gets its share of the time."""
        self._expected = list(dict.fromkeys(names))

    @property
    def _to_do(self) -> list[Name]:
        """The expected names that are still to be sampled."""
        return [name for name in self._expected if name not in self._taken]

    def kept(self, settings: dict[str, Any]) -> Kept | None:
        """Return the state for a later session with the same `settings`, or None if there are no samples."""
        taken = [of for (kind, of), rows in self._samples.items() if kind == "differences" and rows]
        steps = Steps.of(self.participants).chosen
        return kept(KIND, settings, self._samples, steps={of: steps[of] for of in taken})

    def take(self, name: Name, stop: Callable[[], bool], say: Callable[[str], None]) -> bool:
        """Take the samples of `name`, unless an earlier call has taken the samples. Returns True if there are enough
        samples for a comparison.

        After `stop()`, the method ends with the samples taken so far.
        """
        if name not in self._taken and not stop():
            self._taken.add(name)
            self._samples.setdefault(name, [])
            self._measure(name, stop, say)
        return len(self._samples.get(name, [])) >= FEWEST

    def of(self, name: Name) -> np.ndarray:
        """Return the samples: (N, P) for gradients and images, (N, directions) for differences and tangents."""
        return np.stack(self._samples[name]).astype(np.float64)

    def _measure(self, name: Name, stop: Callable[[], bool], say: Callable[[str], None]) -> None:
        kind, samples = name[0], self._samples[name]
        limited, begin = self.settings.seeds is None, self._now()
        if limited and begin + self._expected_s(name) >= self._end:
            return
        before = first_s = 0.0
        begun = len(samples)
        left = seeds(self._most(name))[begun:]
        if not left or stop():
            return
        if kind == "differences" and not samples:
            self.participants.choose_steps(name[1])
        for seed in left:
            samples.append(self.participants.sample(*name, seed).astype(np.float32))
            self.between()
            now = self._now()
            next_s = now - before
            before = now
            if len(samples) == begun + 1:
                first_s, next_s = now - begin, 0.0  # it does not predict the next one
                self._first_s[_kind(name)] = max(first_s, self._first_s.get(_kind(name), 0.0))
                ends = self._ends(name, now)
            if limited and now + next_s >= next(end for least, end in ends if len(samples) < least):
                break
            if len(samples) < begun + len(left) and stop():
                break
        if len(samples) > begun:
            say(f"{kind} {name[1]}: seeds {len(samples)}, {now - begin:.1f} s, of which the first {first_s:.1f} s")

    def _expected_s(self, name: Name) -> float:
        """Return the estimated time of a first sample, from earlier samples."""
        return self._first_s.get(_kind(name), max(self._first_s.values(), default=0.0))

    def _ends(self, name: Name, now: float) -> list[tuple[float, float]]:
        """Return the times at which sampling of `name` ends. Each item has a sample count, and the time that applies
        below this count.

        Samples that a comparison needs may use all the remaining time. Samples beyond the minimum for a comparison
        leave time for the first samples of all remaining names. Samples beyond LEAST_SEEDS get a share of the rest.
        """
        kept = self._end - sum(self._expected_s(other) for other in self._to_do)
        share = now + max(kept - now, 0.0) / (1 + len(self._to_do))
        return [(FEWEST, self._end), (LEAST_SEEDS, kept), (math.inf, share)]

    def _is_cheap(self, name: Name) -> bool:
        """Whether more than LEAST_SEEDS are taken. Estimators and stock references get more than LEAST_SEEDS, because
        their samples have the most noise.
        """
        return name[0] == "image" or (name[0] == "gradient" and not name[1].startswith("walk_ad"))

    def _most(self, name: Name) -> int:
        """Return the maximum number of seeds of `name`. With a budget, seeds of an earlier session do not count."""
        if self.settings.seeds is not None:
            return self.settings.seeds
        return self._before.get(name, 0) + self._most_more(name)

    def _most_more(self, name: Name) -> int:
        if not self._is_cheap(name):
            return LEAST_SEEDS
        fitting = MEMORY // (4 * self.participants.case.size * (len(self.participants.integrators) + 2))
        most = max(LEAST_SEEDS, min(MOST_SEEDS, fitting))
        if name[0] == "gradient" and not self.participants.exact:
            # Only samples with a stock reference are compared.
            stock = sorted({reference.value for reference in self.participants.stock.values() if reference is not None})
            names = [("gradient", label) for label in stock]
            counts = [len(self._samples[name]) - self._before.get(name, 0) for name in names if name in self._taken]
            most = min(most, max(LEAST_SEEDS, *counts)) if any(counts) else most
        return most


def _kind(name: Name) -> tuple[str, bool]:
    """Return the kind of the samples `name`, and True for gradients by naive AD. Samples with the same result have
    similar compile times.
    """
    kind, of = name
    return kind, kind == "gradient" and of.startswith(NAIVE)
