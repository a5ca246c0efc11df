"""Check of an experiment's gradients: each estimator is compared with every valid reference.

`Gradcheck.draw` takes one sample of each quantity at a seed, then at the next seed. An early end therefore leaves all
comparisons with about as many seeds. `Gradcheck.records` compares the samples. A sample depends only on the
participants, the finite-difference steps, and its seed.

The objective is sum(G * I) with a fixed random image G, partly negative, so that all integrators estimate the same
gradient. The configuration's loss would bias each estimate, because each estimate's image has noise. Comparisons use
equal seeds.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from reslrb_cli.config.integrators import PLAIN
from reslrb_cli.estimators import ESTIMATORS
from reslrb_cli.measure.comparison import (
    ROUNDING,
    STOCK_ROUNDING,
    TAIL_SEEDS,
    Family,
    compare_equal_seeds,
    compare_expectations,
    entry_count,
)
from reslrb_cli.measure.draws import Draws, DrawsFile, StoredResults
from reslrb_cli.measure.engine import NO_TIME
from reslrb_cli.measure.gradients import seeds
from reslrb_cli.measure.methods import plays_roulette
from reslrb_cli.measure.participants import CheckSettings, Participants, Way
from reslrb_cli.records.measurements import Comparison, GradcheckRecord, Kind, Reference, Verdict
from reslrb_cli.scene.catalog import value_shape

#: Default number of seeds.
SEEDS = 16

#: References that know the gradient only along a few directions.
ALONG_DIRECTIONS = (Reference.FINITE_DIFFERENCE, Reference.FORWARD_MODE)

#: Name of samples: `gradient` or `image` and an integrator's label, or `differences` or `tangents` and a parameter.
Name = tuple[str, str]

#: References by naive AD, which compile much longer than any other.
NAIVE = ("walk_ad", "ptracer")


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
    """Check of one experiment's gradients. `draws` has the samples so far by name: one flat array for each seed.

    Samples that `file` has are not drawn again. The budget starts with the object, and includes loading and
    compilation. `now` is its clock.
    """

    def __init__(
        self, settings: CheckSettings, now: Callable[[], float] = time.monotonic, file: DrawsFile | None = None
    ) -> None:
        self.settings, self._now, self._begin = settings, now, now() - settings.spent_s
        self.seeds, self._budget_s = settings.seeds or SEEDS, settings.budget_s if settings.seeds is None else math.inf
        self.participants, self.file = Participants(settings), file or DrawsFile()
        self.draws: dict[Name, list[np.ndarray]] = {}
        self._about: dict[Name, dict[str, Any]] = {}

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
        # Guiding, a quasi-random sequence and measured pixels make paths differ from those of naive AD at equal seeds.
        names = ("guiding", "sequence", "pixels")
        options = {label: config.integrator.options() for label, config in self.settings.configs.items()}
        plain = [label for label, own in options.items() if all(own.get(n, PLAIN[n]) == PLAIN[n] for n in names)]
        for key in parts.case.keys:
            for listed in parts.listed:
                ours = listed.type == "reslrb" and listed.label in plain
                exact = ours and ESTIMATORS[listed.options["estimator"]].exact
                for reference in parts.references(key, listed):
                    kind = Kind.EQUAL_SEEDS if exact and reference is Reference.WALK_AD else Kind.EXPECTATION
                    found.append(Row(key, listed.label, reference, kind, parts.way(listed, reference)))
        return sorted(found, key=lambda row: row.key is not None and row.reference.value in NAIVE)

    def conditions(self) -> str:
        """Describe the measurement in one line."""
        parts, integrator = self.participants, self.settings.config.integrator
        width, height = parts.film
        plays = plays_roulette(integrator.max_depth, integrator.rr_depth)
        roulette = f"roulette from depth {integrator.rr_depth}" if plays else "no roulette"
        return (
            f"{self.settings.config.source}, film {width}x{height}, {parts.spp} spp "
            f"({width * height * parts.spp} paths a seed), max_depth {integrator.max_depth}, {roulette}{self._lamps()}"
        )

    def _lamps(self) -> str:
        """Return which lamps are on, in words, if views name their lamps."""
        views = self.settings.config.views
        if views is None or not self.settings.config.names_lamps:
            return ""
        lamps = f"the lamps {', '.join(views[0].lamps or ())}" if self.participants.lit else "all lamps"
        return f", the first view with {lamps}"

    def run(
        self, stop: Callable[[], bool], say: Callable[[str], None], between: Callable[[], None] = lambda: None
    ) -> Iterator[GradcheckRecord]:
        """Draw all samples, and compare them. After `stop()`, yield only comparisons that have samples."""
        self.draw(stop, say, between)
        yield from self.records(stop())

    def draw(self, stop: Callable[[], bool], say: Callable[[str], None], between: Callable[[], None]) -> None:
        """Take the samples, in turns seed by seed, until all are taken, the budget is spent, or `stop()`.

        A sample that has started is finished. `between` is called after each sample, and `say` from time to time.
        """
        names = list(dict.fromkeys(name for row in self.rows for name in self._needs(row)))
        self.draws |= {name: self._recall(name) for name in names if name not in self.draws}
        if known := sum(map(len, self.draws.values())):
            say(f"{known} of {len(names) * self.seeds} samples are on file")
        try:
            for number, seed in enumerate(seeds(self.seeds)):
                for name in (name for name in names if len(self.draws[name]) <= number):
                    if stop() or self._now() - self._begin >= self._budget_s:
                        return
                    self._take(name, seed)
                    between()
                if number & (number + 1) == 0:
                    self.file.save()
                    say(f"{number + 1} of {self.seeds} seeds, {self._now() - self._begin:.0f} s")
        finally:
            self.file.save()

    def _recall(self, name: Name) -> list[np.ndarray]:
        """Return the samples on file, and restore their finite-difference steps."""
        if self.file.path is None:
            return []
        self._about[name] = about = self.participants.about(*name)
        found, stored = self.file.draws(about), self.file.stored(about)
        if found is None or found.seeds.tolist() != list(seeds(len(found))):
            return []
        if stored is not None:
            self.participants.restore(name[1], stored.facts["steps"])
        return list(found.values)[: self.seeds]

    def _take(self, name: Name, seed: int) -> None:
        """Take a sample, and add it to the file, with the finite-difference steps if it has any."""
        about = self._about.get(name)
        if name[0] == "differences" and not self.draws[name]:
            self.participants.choose_steps(name[1])
            if about is not None:
                self.file.store(about, StoredResults({"steps": self.participants.steps(name[1])}, {}))
        self.draws[name].append(self.participants.sample(*name, seed).astype(np.float32))
        if about is not None:
            self.file.add(about, Draws.of(about["purpose"], self.draws[name][-1], [seed]))

    def records(self, interrupted: bool = False) -> list[GradcheckRecord]:
        """Return the comparisons of the samples so far, in the order of `rows`, and the parameters without a stock
        reference. If `interrupted`, leave out comparisons without samples.
        """
        rows = [row for row in self.rows if not interrupted or self._count(row)]
        family = self._family()
        why = "interrupted" if interrupted else NO_TIME
        return [self._compared(row, family, why) for row in rows] + (list(self._without_reference()) if rows else [])

    def _count(self, row: Row) -> int:
        """Return the number of seeds that all samples of a comparison have."""
        return min(len(self.draws.get(name, [])) for name in self._needs(row))

    def _needs(self, row: Row) -> tuple[Name, Name]:
        """Return the sample names that a comparison needs: those of the estimator and of the reference."""
        naive = row.way.named("walk_ad")
        if row.key is None:
            return ("image", naive if row.label == "reslrb" else row.label), ("image", row.reference.value)
        ours = "gradient", self.participants.sampled(row.label, row.reference)
        its = {
            Reference.WALK_AD: ("gradient", naive),
            Reference.FINITE_DIFFERENCE: ("differences", row.place),
            Reference.FORWARD_MODE: ("tangents", row.place),
        }
        return ours, its.get(row.reference, ("gradient", row.reference.value))

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
        return entry_count(value_shape(parts.case.values.value(row.key)))

    def _compared(self, row: Row, family: Family, why: str) -> GradcheckRecord:
        """Return the comparison of a row's samples. `why` is the reason if there are too few samples."""
        count = self._count(row)
        if count == 0:
            return self._record(row, Comparison(Verdict.NOT_MEASURED, message=why), 0)
        figures = Comparison(Verdict.UNRESOLVED)
        if count > 1 or row.kind is Kind.EQUAL_SEEDS:
            figures = self._figures(row, count, family)
        if figures.verdict is Verdict.FAILS and row.reference is Reference.FINITE_DIFFERENCE:
            figures = replace(figures, message=self.participants.lacking(row.way) or figures.message)
        if figures.verdict is Verdict.UNRESOLVED and count < min(self.seeds, TAIL_SEEDS):
            figures = replace(figures, message=f"{count} of {self.seeds} seeds are too few to know the noise: {why}")
        return self._record(row, figures, count)

    def _figures(self, row: Row, count: int, family: Family) -> Comparison:
        parts = self.participants
        sides = {name: np.stack(self.draws[name][:count]).astype(np.float64) for name in self._needs(row)}
        ours, reference = (sides[name] for name in self._needs(row))
        shape, bias, rounding = None, np.zeros(1), ROUNDING
        if row.key is None:
            shape = tuple(parts.case.weights.shape)
        else:
            place, chosen = parts.case.places[row.key], parts.directions[row.place]
            at = parts.case.size + parts.case.keys.index(row.key)  # its rounding error
            rounding = max(float(rows[:, at].max()) for name, rows in sides.items() if name[0] == "gradient")
            ours = ours[:, place]
            if row.reference in ALONG_DIRECTIONS:
                ours = ours @ np.array([direction.vector[place] for direction in chosen]).T
            else:
                reference, shape = reference[:, place], value_shape(parts.case.values.value(row.key))
            if row.reference is Reference.FINITE_DIFFERENCE:
                bias = np.array([direction.truncation for direction in chosen])
        if row.kind is Kind.EQUAL_SEEDS:
            return compare_equal_seeds(ours, reference, rounding)
        if shape is not None and row.reference is not Reference.WALK_AD:
            rounding = max(rounding, STOCK_ROUNDING)
        return compare_expectations(ours, reference, family, shape=shape, bias=bias, rounding=rounding)

    def _record(self, row: Row, figures: Comparison, seeds: int) -> GradcheckRecord:
        case, sides = str(self.settings.config.source), (row.reference, row.kind)
        return GradcheckRecord(case, row.key, row.label, row.way.options, *sides, seeds, **vars(figures))

    def _without_reference(self) -> Iterator[GradcheckRecord]:
        """Yield records for parameters without a stock reference."""
        parts = self.participants
        rows = [
            (Row(key, "reslrb", Reference.PTRACER, Kind.EXPECTATION, way), why)
            for way in dict.fromkeys(parts.way(listed, Reference.PTRACER) for listed in parts.listed)
            for key in parts.case.keys for reference, why in [parts.stock[way.named(key)]] if reference is None
        ]  # fmt: skip
        rows += [
            (Row(None, "reslrb", Reference.PATH, Kind.IMAGE, way), why)
            for way, (reference, why) in parts.images.items() if reference is None
        ]  # fmt: skip
        for row, why in rows:
            yield self._record(row, Comparison(Verdict.NO_REFERENCE, message=why), 0)
