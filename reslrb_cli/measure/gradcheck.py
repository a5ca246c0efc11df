"""Check of an experiment's gradients: each estimator is compared with every valid reference.

`Sampling` takes the samples on demand until they suffice or the time is up. A sample depends only on the participants,
the finite-difference steps, and its seed.

The objective is sum(G * I) with a fixed random image G, partly negative, so that all integrators estimate the same
gradient. The configuration's loss would bias each estimate, because each estimate's image has noise. Comparisons use
equal seeds. Each comparison is made as soon as its samples are available.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from reslrb_cli.config.integrators import PLAIN
from reslrb_cli.config.schema import Config
from reslrb_cli.estimators import ESTIMATORS
from reslrb_cli.measure.arena import NO_TIME
from reslrb_cli.measure.comparison import (
    ROUNDING,
    STOCK_ROUNDING,
    Family,
    compare_equal_seeds,
    compare_expectations,
    entry_count,
)
from reslrb_cli.measure.gradients import seeds
from reslrb_cli.measure.methods import plays_roulette, records_of
from reslrb_cli.measure.participants import CheckSettings, Participants, Way
from reslrb_cli.records.measurements import Comparison, GradcheckRecord, Kind, Reference, Verdict

#: References that know the gradient only along a few directions.
ALONG_DIRECTIONS = (Reference.FINITE_DIFFERENCE, Reference.FORWARD_MODE)


#: Name of samples: `gradient` or `image` and an integrator's label, or `differences` or `tangents` and a parameter.
Name = tuple[str, str]


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
    """

    def __init__(self, settings: CheckSettings, now: Callable[[], float] = time.monotonic) -> None:
        self._now, self.settings = now, settings
        self._end = now() - settings.spent_s + settings.budget_s
        self.participants = Participants(settings)
        self._samples: dict[Name, list[np.ndarray]] = {}
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
        if kind == "differences":
            self.participants.choose_steps(name[1])
        before, most = begin, self._most(name)
        for seed in seeds(most):
            samples.append(self.participants.sample(*name, seed).astype(np.float32))
            self.between()
            now = self._now()
            next_s, before = now - before, now
            if len(samples) == 1:
                first_s, next_s = now - begin, 0.0  # it does not predict the next one
                self._first_s[_kind(name)] = max(first_s, self._first_s.get(_kind(name), 0.0))
                ends = self._ends(name, now)
            if limited and now + next_s >= next(end for least, end in ends if len(samples) < least):
                break
            if len(samples) < most and stop():
                break
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
        """Return the maximum number of seeds of `name`."""
        if self.settings.seeds is not None:
            return self.settings.seeds
        if not self._is_cheap(name):
            return LEAST_SEEDS
        fitting = MEMORY // (4 * self.participants.case.size * (len(self.participants.integrators) + 2))
        most = max(LEAST_SEEDS, min(MOST_SEEDS, fitting))
        if name[0] == "gradient" and not self.participants.exact:
            # Only samples with a stock reference are compared.
            stock = sorted({reference.value for reference in self.participants.stock.values() if reference is not None})
            names = [("gradient", label) for label in stock]
            counts = [len(self._samples[name]) for name in names if name in self._taken]
            most = min(most, max(LEAST_SEEDS, *counts)) if any(counts) else most
        return most


def _kind(name: Name) -> tuple[str, bool]:
    """Return the kind of the samples `name`, and True for gradients by naive AD. Samples with the same result have
    similar compile times.
    """
    kind, of = name
    return kind, kind == "gradient" and of.startswith(NAIVE)


@dataclass(frozen=True)
class Row:
    """A comparison for the integrator `label` with the paths `way`. The compared quantity is the parameter `key`, or
    the image if `key` is None.
    """

    key: str | None
    label: str
    reference: Reference
    kind: Kind
    way: Way

    @property
    def place(self) -> str:
        """Name of the parameter for these paths. `Participants` stores the parameter's data under this name."""
        return self.way.named(str(self.key))


class Gradcheck:
    """Check of one experiment's gradients, with the scene of `participants`."""

    def __init__(self, settings: CheckSettings, now: Callable[[], float] = time.monotonic) -> None:
        self.settings, self.sampling = settings, Sampling(settings, now)
        self.participants = self.sampling.participants

    @cached_property
    def rows(self) -> list[Row]:
        """The comparisons in the order of the table. Comparisons with naive AD come last, because they take longest to
        compile.
        """
        parts = self.participants
        shown = [("reslrb", way) for way in parts.images]
        shown += [(listed.label, parts.ways[listed.label]) for listed in parts.listed if listed.type == "custom"]
        images = [(label, way, parts.images[way][0]) for label, way in shown]
        found = [Row(None, label, one, Kind.IMAGE, way) for label, way, one in images if one is not None]
        plain = [label for label, config in self.settings.configs().items() if _draws_plainly(config)]
        for key in parts.case.keys:
            for listed in parts.listed:
                ours = listed.type == "reslrb" and listed.label in plain
                exact = ours and ESTIMATORS[listed.options["estimator"]].exact
                for reference in parts.references(key, listed):
                    kind = Kind.EQUAL_SEEDS if exact and reference is Reference.WALK_AD else Kind.EXPECTATION
                    found.append(Row(key, listed.label, reference, kind, parts.ways[listed.label]))
        return sorted(found, key=lambda row: row.key is not None and row.reference.value in NAIVE)

    def conditions(self) -> str:
        """Describe the measurement in one line."""
        parts, integrator = self.participants, self.settings.config.integrator
        width, height = parts.film
        plays = plays_roulette(integrator.max_depth, integrator.rr_depth)
        roulette = f"roulette from depth {integrator.rr_depth}" if plays else "no roulette"
        return (
            f"{self.settings.config.source}, film {width}x{height}, {parts.spp} spp "
            f"({width * height * parts.spp} paths a seed), max_depth {integrator.max_depth}, {roulette}"
        )

    def expected(self) -> list[GradcheckRecord]:
        """Return a record without results for every line of the table."""
        return [self._record(row, Comparison(Verdict.NOT_MEASURED), 0) for row in self.rows] + list(
            self._without_reference()
        )

    def run(
        self, stop: Callable[[], bool], say: Callable[[str], None], between: Callable[[], None] = lambda: None
    ) -> Iterator[GradcheckRecord]:
        """Measure and compare, row by row. After `stop()`, compare only finished samples.

        If the budget is too small for a comparison, its record says so. `between` is called after each sample.
        """
        self.sampling.between = between
        self.sampling.expect(name for row in self.rows for name in self._needs(row))
        family, compared = self._family(), False
        for row in self.rows:
            if all(self.sampling.take(name, stop, say) for name in self._needs(row)):
                compared = True
                yield self._result(row, family)
            elif not stop():
                yield self._record(row, Comparison(Verdict.NOT_MEASURED, message=NO_TIME), 0)
        if compared or not stop():
            yield from self._without_reference()

    def _needs(self, row: Row) -> list[Name]:
        """Return the sample names that a comparison needs. The samples are those of the estimator and, unless the
        reference is exact, of the reference.
        """
        naive = row.way.named("walk_ad")
        if row.key is None:
            return [("image", naive if row.label == "reslrb" else row.label), ("image", row.reference.value)]
        ours = "gradient", self.participants.sampled(row.label, row.reference)
        its = {
            Reference.ANALYTIC: [],
            Reference.WALK_AD: [("gradient", naive)],
            Reference.FINITE_DIFFERENCE: [("differences", row.place)],
            Reference.FORWARD_MODE: [("tangents", row.place)],
            Reference.UNGUIDED: [("gradient", self.participants.unguided.get(row.label, row.label))],
        }
        return [ours, *its.get(row.reference, [("gradient", row.reference.value)])]

    # --- comparing ----------------------------------------------------------------------------------------------------

    def _family(self) -> Family:
        rows = [row for row in self.rows if row.kind is not Kind.EQUAL_SEEDS]
        return Family(len(rows), sum(self._entries(row) for row in rows))

    def _entries(self, row: Row) -> int:
        parts = self.participants
        if row.key is None:
            return entry_count(tuple(parts.case.weights.shape))
        if row.reference in ALONG_DIRECTIONS:
            return len(parts.directions[row.place])
        if row.reference is Reference.ANALYTIC:
            return len(parts.exact[row.key])
        return entry_count(parts.shape(row.key))

    def _result(self, row: Row, family: Family) -> GradcheckRecord:
        parts, (mine, *its) = self.participants, self._needs(row)
        ours, shape, bias = self.sampling.of(mine), None, np.zeros(1)
        rounding = ROUNDING if row.key is None else parts.case.rounding(row.key)
        reference = self.sampling.of(its[0]) if its else parts.exact[str(row.key)]
        if row.key is None:
            shape = tuple(parts.case.weights.shape)
        else:
            place, chosen = parts.case.places[row.key], parts.directions[row.place]
            ours = ours[:, place]
            if row.reference in ALONG_DIRECTIONS:
                ours = ours @ np.array([direction.vector[place] for direction in chosen]).T
            elif its:
                reference, shape = reference[:, place], parts.shape(row.key)
            if row.reference is Reference.FINITE_DIFFERENCE:
                bias = np.array([direction.truncation for direction in chosen])
        if its:
            least = min(len(ours), len(reference))
            ours, reference = ours[:least], reference[:least]
        if row.kind is Kind.EQUAL_SEEDS:
            figures = compare_equal_seeds(ours, reference, rounding)
        else:
            ours_too = row.reference in (Reference.WALK_AD, Reference.UNGUIDED)
            share = rounding if shape is None or ours_too else max(rounding, STOCK_ROUNDING)
            figures = compare_expectations(ours, reference, family, shape=shape, bias=bias, rounding=share)
        return self._record(row, figures, len(ours))

    def _record(self, row: Row, figures: Comparison, seeds: int) -> GradcheckRecord:
        kind, _, estimator = row.label.partition(":") if row.label.startswith("reslrb") else (row.label, "", "")
        return GradcheckRecord(
            str(self.settings.config.source), row.key, kind, estimator or None, row.reference, row.kind, seeds,
            **vars(figures), **records_of(row.way.options),
        )  # fmt: skip

    def _without_reference(self) -> Iterator[GradcheckRecord]:
        """Yield records for parameters without a stock reference."""
        parts = self.participants
        rows = [
            (Row(key, "reslrb", Reference.PTRACER, Kind.EXPECTATION, way), parts.why[way.named(key)])
            for way in parts.each_way for key in parts.case.keys if parts.stock[way.named(key)] is None
        ]  # fmt: skip
        rows += [
            (Row(None, "reslrb", Reference.PATH, Kind.IMAGE, way), why)
            for way, (reference, why) in parts.images.items() if reference is None
        ]  # fmt: skip
        for row, why in rows:
            yield self._record(row, Comparison(Verdict.NO_REFERENCE, message=why), 0)


def _draws_plainly(config: Config) -> bool:
    """True if an integrator's paths equal the paths of naive AD at equal seeds. Guiding, a quasi-random sequence and
    `pixels: measured` make the paths differ.
    """
    options = config.integrator.options()
    return all(options.get(name, PLAIN[name]) == PLAIN[name] for name in ("guiding", "sequence", "pixels"))
