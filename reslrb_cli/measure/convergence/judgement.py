"""Results from the samples of a session: errors, slopes, efficiencies, and biases."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from reslrb_cli.measure.comparison import ROUNDING, TAIL, Family, compare_expectations, entry_count, tail_weight
from reslrb_cli.measure.convergence.session import Session
from reslrb_cli.measure.convergence.setup import Member, Role
from reslrb_cli.measure.convergence.statistics import FEWEST, MethodSamples, ReferenceMean
from reslrb_cli.measure.methods import ALL, IMAGES
from reslrb_cli.records.measurements import (
    TARGETS,
    BenchStatus,
    Comparison,
    MethodRecord,
    PointRecord,
    ReferenceRecord,
    Verdict,
)

#: Relative difference of a stock integrator on the same paths: it rounds the visibility of points differently.
STOCK_ROUNDING = 1e-3

#: Remark on noise with heavy tails.
HEAVY = "single steps dominate the variance: the intervals are too narrow; take more steps"


@dataclass(frozen=True)
class ConvergenceResults:
    """All records of a session."""

    points: list[PointRecord]
    methods: list[MethodRecord]
    references: list[ReferenceRecord]


@dataclass(frozen=True)
class _Bias:
    """Bias of one parameter, or the worst bias of all parameters. The fields are as in a `MethodRecord`."""

    biased: bool | None = None
    bias_z: float | None = None
    bias_z_limit: float | None = None
    bias_reference: str | None = None
    independent: bool = False
    message: str = ""


class Judgement:
    """Evaluation of the samples of a session so far."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._slices = session.slices() if session.facts else {}
        #: References of the errors, by parameter and for all; empty if there are too few steps of the reference.
        self._whole: dict[str, ReferenceMean] = {}
        for found in session.of(Role.REFERENCE):
            if len(set(found.turns)) >= FEWEST and not found.message:
                self._whole = {key: ReferenceMean(self._rows(found, place)) for key, place in self._places().items()}

    def _places(self) -> dict[str, slice]:
        """Return each parameter's slice, and the slice of all parameters together. Images have only the latter."""
        if "image" in self._slices:
            return self._slices
        return self._slices | {ALL: slice(None)}

    def _rows(self, member: Member, place: slice) -> np.ndarray:
        """Return the independent estimates that a reference member has made. If there are several dL/dI, steps with the
        same dL/dI are combined.
        """
        several = self._session.plan.objective == "loss" and len(set(member.turns)) > IMAGES
        return member.means(place, IMAGES if several else None)

    @property
    def ready(self) -> bool:
        """Whether there is any result."""
        return bool(self._whole)

    def overall(self, member: Member) -> MethodRecord:
        """Return the figures of all parameters together, or of the image, without biases."""
        key = next(reversed(self._places()))
        return self._method(member, key, self._places()[key], _Bias())

    def results(self) -> ConvergenceResults:
        """Return all records."""
        session = self._session
        cases, references = session.of(Role.CASE), session.of(Role.REFERENCE)
        points: list[PointRecord] = []
        methods: list[MethodRecord] = []
        judged = {member.label: self._biases(member) for member in cases if self._measured(member)}
        own = self._biases(references[0]) if self.ready else {}
        for member in cases:
            if member.refusal is not None:
                continue
            for key, place in self._places().items():
                if key == ALL and len(self._slices) == 1:  # there are no others
                    methods.append(replace(methods[-1], parameter=ALL))
                    points += [replace(point, parameter=ALL) for point in points if point.method == member.method]
                    continue
                methods.append(self._method(member, key, place, judged.get(member.label, {}).get(key, _Bias()), own))
                points += self._points(member, key, place)
        stood = [self._stood(references[0], key, own[key]) for key in self._places()] if self.ready else []
        return ConvergenceResults(points, methods, stood)

    def _measured(self, member: Member) -> bool:
        """Whether a member has figures."""
        return self.ready and member.end is None and not member.message and len(member.rows) >= FEWEST

    # --- bias ---------------------------------------------------------------------------------------------------------

    def _judge(self, member: Member, key: str) -> Member | None:
        """Return the member that tests for bias: an independent stock integrator if there is one, otherwise the
        reference.
        """
        session = self._session
        reference = session.of(Role.REFERENCE)[0]
        stock = session.judges.get(session.facts["independent"][key] or "")
        usable = stock is not None and stock.end is None and not stock.message and len(set(stock.turns)) >= FEWEST
        if usable and stock is not member and stock.method.integrator != member.method.integrator:  # type: ignore[union-attr]
            return stock
        return None if member is reference else reference

    def _biases(self, member: Member) -> dict[str, _Bias]:
        """Return the bias for each parameter, and the worst bias of all parameters together."""
        found = {key: self._bias(member, key) for key in self._slices}
        if "image" in found:
            return found
        biases = list(found.values())
        worst = max(biases, key=lambda bias: -1.0 if bias.bias_z is None else bias.bias_z)
        biased = True if any(b.biased for b in biases) else None if any(b.biased is None for b in biases) else False
        judges = ", ".join(dict.fromkeys(b.bias_reference for b in biases if b.bias_reference is not None)) or None
        message, independent = next((b.message for b in biases if b.message), ""), all(b.independent for b in biases)
        found[ALL] = replace(worst, biased=biased, bias_reference=judges, independent=independent, message=message)
        return found

    def _bias(self, member: Member, key: str) -> _Bias:
        judge, place = self._judge(member, key), self._slices[key]
        if judge is None:
            return _Bias(message="there is no independent reference")
        independent = _kin(judge) != _kin(member)
        ours, theirs = np.stack(member.rows)[:, place].astype(np.float64), self._rows(judge, place)
        if member.role is not Role.CASE:
            ours = self._rows(member, place)
        figures = compare_expectations(
            ours,
            theirs,
            self._family(),
            shape=tuple(self._session.facts["shapes"][key]),
            paired=False,
            rounding=STOCK_ROUNDING if independent else ROUNDING,
        )
        biased = {Verdict.HOLDS: False, Verdict.FAILS: True}.get(figures.verdict)
        return _Bias(biased, figures.z_max, figures.z_max_limit, judge.label, independent, _words(figures))

    def _family(self) -> Family:
        """Return all comparisons of the session, which have a common correction."""
        members = len(self._session.of(Role.CASE)) + 1
        shapes = self._session.facts["shapes"].values()
        return Family(members * len(shapes), members * sum(entry_count(tuple(shape)) for shape in shapes))

    # --- records ------------------------------------------------------------------------------------------------------

    def _samples(self, member: Member, key: str, place: slice) -> MethodSamples:
        rows = np.stack(member.rows)[:, place]
        return MethodSamples(rows, np.array(member.turns), np.array(member.seconds), self._whole[key])

    def _points(self, member: Member, key: str, place: slice) -> list[PointRecord]:
        if not self._measured(member) or self._whole[key].floor is None:
            return []
        points = self._samples(member, key, place).points()
        return [PointRecord(member.method, key, reference_rmse=self._whole[key].floor, **vars(p)) for p in points]

    def _method(
        self, member: Member, key: str, place: slice, bias: _Bias, references: dict[str, _Bias] | None = None
    ) -> MethodRecord:
        status = BenchStatus.OK if member.end is None else member.end.status
        if not self._measured(member) or self._whole[key].floor is None:
            reason = member.message or ("" if member.end is None else member.end.reason)
            reason = reason or ("the budget was spent" if member.late or not self._measured(member) else _UNSEEN)
            return MethodRecord(member.method, key, status, len(member.rows), cold_s=member.cold_s, message=reason)
        samples, biased = self._samples(member, key, place), bias.biased is True
        magnitude = samples
        if biased and references is not None and references[key].biased and key != ALL:
            judge = self._judge(member, key)
            if judge is not None:  # the reference is biased itself
                magnitude = MethodSamples(samples.deviations + samples.reference.mean, samples.turns, samples.seconds,
                                    ReferenceMean(self._rows(judge, place)))  # fmt: skip
        message = bias.message
        if not message and tail_weight(samples.deviations) > TAIL:
            message = HEAVY
        times = {f"{target:g}": magnitude.seconds_to(target, biased) for target in TARGETS}
        slope, efficiency = samples.slope(), magnitude.efficiency(biased)
        return MethodRecord(
            method=member.method,
            parameter=key,
            status=status,
            repeats=samples.count,
            step_s=samples.step_s,
            cold_s=member.cold_s,
            relative_rmse=float(np.sqrt(samples.variance)),
            reference_rmse=samples.reference.floor,
            slope=None if slope is None else slope.interval(),
            efficiency=None if efficiency is None else efficiency.exponential(),
            bias=float(np.sqrt(magnitude.squared_bias)) if biased else None,
            seconds_to={name: seconds for name, (seconds, _) in times.items()},
            extrapolated=[name for name, (_, beyond) in times.items() if beyond],
            **vars(replace(bias, message=message)),
        )

    def _stood(self, member: Member, key: str, bias: _Bias) -> ReferenceRecord:
        floor, known = self._whole[key].floor, vars(bias).copy()
        del known["independent"]
        if floor is None:
            known["message"] = _UNSEEN
        return ReferenceRecord(member.method, key, len(member.rows), floor, **known)


_UNSEEN = "nothing exceeds the reference's noise"


def _kin(member: Member) -> str:
    """Return the source of the code that traces a member's paths: `reslrb` or a stock integrator."""
    name = member.method.integrator
    return name if name in ("ptracer", "prb") else "ours"


def _words(figures: Comparison) -> str:
    return figures.message or ("gradient and reference differ" if figures.verdict is Verdict.FAILS else "")
