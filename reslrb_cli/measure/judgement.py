"""Results from the samples of a session: errors of averages of n steps, efficiency, the time for a given error,
and biases.

Samples x are (R, P): R steps, P entries. The reference r is the mean of K rows (K, P). The rows are independent
estimates of the same mean, from other steps. tr is the trace of a covariance, which is the sum of all entries'
variances.

    noise   = tr Var(r)                                  the reference's own squared standard error
    signal  = |r|^2 - noise                              the squared size of the estimated quantity
    MSE(n)  = mean over blocks of n steps |mean of a block - r|^2 - noise
    RMSE(n) = sqrt(MSE(n) / signal)                      relative
    bias^2  = |mean(x) - r|^2 - tr Var(x) / R - noise

All these estimates are unbiased, so single values may be negative. Intervals come from the jackknife. The jackknife
leaves out one turn of steps at a time from the samples. For the reference, the jackknife leaves out one row at a time.
The two variances are added.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from reslrb_cli.measure.comparison import (
    STOCK_ROUNDING,
    TAIL,
    Family,
    compare_expectations,
    entry_count,
    tail_weight,
)
from reslrb_cli.measure.convergence import FEWEST, Session
from reslrb_cli.measure.draws import mixed_sessions
from reslrb_cli.measure.engine import Member
from reslrb_cli.measure.gradients import places
from reslrb_cli.measure.methods import ALL, IMAGES
from reslrb_cli.records.measurements import (
    FEWEST_AVERAGES,
    TARGETS,
    BenchStatus,
    Bias,
    Method,
    MethodRecord,
    PointRecord,
    Range,
    ReferenceRecord,
    Verdict,
)
from reslrb_cli.statistics import jackknife_variance, special, squares_without

#: Remark on noise with heavy tails.
HEAVY = "single steps dominate the variance: the intervals are too narrow; take more steps"

#: Message for estimates that are too small for the reference.
_UNSEEN = "nothing exceeds the reference's noise"

#: Confidence level of all intervals.
CONFIDENCE = 0.95


@dataclass(frozen=True)
class JackknifeEstimate:
    """An estimate with its standard error, and the degrees of freedom of the standard error."""

    value: float
    error: float
    freedom: float

    def exponential(self) -> Range:
        """Return exp(value) with its interval by Student's t. The value of this estimate is a logarithm."""
        half = float(special().stdtrit(min(self.freedom, 1e6), (1 + CONFIDENCE) / 2)) * self.error
        value, low, high = np.exp(np.clip(self.value + half * np.array([0, -1, 1]), -700, 700)).tolist()
        return Range(value, low, high)


class ReferenceMean:
    """The reference of errors: the mean of (K, P) rows, with K at least 2.

    `moved` (1 + K, P), `noises` and `signals` (1 + K,) are the change of the mean, the noise and the signal, first for
    all rows, and then without each row.
    """

    def __init__(self, rows: np.ndarray) -> None:
        self.rows, count = rows.astype(np.float64), len(rows)
        self.mean = self.rows.mean(0)
        whole, without = squares_without(self.rows)
        self.noises = np.array([whole / (count - 1) / count, *(without / max(count - 2, 1) / (count - 1))])
        self.moved = np.concatenate([np.zeros_like(self.rows[:1]), (self.mean - self.rows) / (count - 1)])
        self.signals = np.square(self.mean + self.moved).sum(1) - self.noises
        self.noise, self.signal = float(self.noises[0]), float(self.signals[0])

    @property
    def floor(self) -> float | None:
        """The reference's own relative standard error, or None if its signal is not significant."""
        return float(np.sqrt(self.noise / self.signal)) if self.signal > 0 else None


class MethodSamples:
    """Steps (R, P) of one method and their reference. `turns` (R,) is the turn of each step.

    `seconds` (T,) has the time of one step in each turn, and `step_s` is their mean. `variance` is the trace of the
    variance of one step. Both `variance` and `squared_bias` are relative to the signal. An estimate of the squared bias
    below 0 counts as 0.
    """

    def __init__(self, values: np.ndarray, turns: np.ndarray, seconds: np.ndarray, reference: ReferenceMean) -> None:
        self.reference, self.seconds = reference, np.asarray(seconds, np.float64)
        self.deviations = values.astype(np.float64) - reference.mean
        self.turns, self.count = np.unique(turns, return_inverse=True)[1], len(values)
        self.step_s = float(self.seconds.mean())
        mean, variance = self.deviations.mean(0), float(self.deviations.var(0, ddof=1).sum())
        squared_bias = float(mean @ mean) - variance / self.count - reference.noise
        self.variance, self.squared_bias = variance / reference.signal, max(0.0, squared_bias) / reference.signal

    def _levels(self) -> list[tuple[int, np.ndarray, float]]:
        """Return averages of 1, 2, 4, ... steps, up to the number of steps: the length, the deviations of the averages
        (N, P), and their mean squared error. The squared error of the reference is subtracted.
        """
        found, averages, steps = [], self.deviations, 1
        while len(averages):
            found.append((steps, averages, float(np.square(averages).sum(1).mean()) - self.reference.noise))
            pairs = len(averages) // 2
            averages, steps = 0.5 * (averages[0 : 2 * pairs : 2] + averages[1 : 2 * pairs : 2]), 2 * steps
        return found

    def points(self, method: Method, parameter: str) -> list[PointRecord]:
        """Return the errors of averages. An error is None if the reference's own error is larger."""
        signal, floor = self.reference.signal, self.reference.floor
        return [
            PointRecord(method, parameter, steps, steps * self.step_s,
                        float(np.sqrt(squared / signal)) if squared > 0 else None, floor, len(averages),
                        *self._interval(averages, squared))
            for steps, averages, squared in self._levels()
        ]  # fmt: skip

    def _interval(self, averages: np.ndarray, squared: float) -> tuple[float, float] | tuple[None, None]:
        """Return the interval of the relative error of averages whose mean squared error is `squared`. Return None for
        both ends if there are too few averages, or if `squared` is not positive.

        The interval is that of the error's logarithm, because the squared errors of a few entries are skewed.
        """
        count, reference = len(averages), self.reference
        if squared <= 0 or count < FEWEST_AVERAGES:
            return None, None
        squares, mean = np.square(averages).sum(1), averages.mean(0)
        own = np.array([squares.mean(), *(squares.sum() - squares) / (count - 1)]) - reference.noise
        moved = np.square(reference.moved).sum(1) - 2 * reference.moved @ mean
        other = (squares.mean() + moved - reference.noises) * reference.signal / reference.signals
        # the delta method, because leaving out a row may lower an error below 0
        value = np.log(squared / reference.signal) - 1
        found = jackknife(value + own / squared, value + other / squared).exponential()
        return float(np.sqrt(found.low)), float(np.sqrt(found.high))

    def efficiency(self) -> JackknifeEstimate | None:
        """Return the logarithm of 1 / ((variance + squared bias) * seconds of a step). Without noise or with too few
        turns, return None.
        """
        turns, reference = int(self.turns.max()) + 1, self.reference
        if turns < FEWEST or len(self.seconds) != turns or self.variance <= 0 or reference.signal <= 0:
            return None
        # Each array has the value of all turns first, then the values without each turn.
        counts = self.count - np.array([0, *np.bincount(self.turns, minlength=turns)])
        if counts.min() < 2:
            return None
        sums = np.zeros((1 + turns, self.deviations.shape[1]))
        np.add.at(sums, 1 + self.turns, self.deviations)
        means = (self.deviations.sum(0) - sums) / counts[:, None]
        total, squares = np.square(self.deviations).sum(1), np.zeros(1 + turns)
        np.add.at(squares, 1 + self.turns, total)
        distances = np.square(means).sum(1)
        variances = (total.sum() - squares - counts * distances) / (counts - 1)
        seconds = np.array([self.step_s, *(self.seconds.sum() - self.seconds) / (turns - 1)])
        own = np.maximum(distances - variances / counts - reference.noise, 0.0) + variances
        other = np.square(means[0] - reference.moved).sum(1) - variances[0] / self.count - reference.noises
        other = np.maximum(other, 0.0) + variances[0]
        if min(own.min(), other.min(), reference.signals.min()) <= 0:
            return None
        return jackknife(np.log(reference.signal / own / seconds), np.log(reference.signals / other / self.step_s))

    def seconds_to(self, error: float, biased: bool) -> tuple[float | None, bool]:
        """Return the seconds until the relative error is `error`. Also return a boolean that is true if the seconds are
        extrapolated.

        The seconds are None if a bias keeps the error above `error`. At least one step is needed. The boolean is true
        if more steps are needed than were measured. The boolean is also true if the reference's own error (`floor`) is
        unknown or larger than `error`. If the seconds are None, the boolean is false.
        """
        room = error**2 - (self.squared_bias if biased else 0.0)
        if room <= 0:
            return None, False
        steps = max(self.variance / room, 1.0)
        floor = self.reference.floor
        return steps * self.step_s, bool(steps > self.count or floor is None or error < floor)


def jackknife(own: np.ndarray, other: np.ndarray) -> JackknifeEstimate:
    """Return an estimate with the jackknife variances of the samples and of the reference. Welch and Satterthwaite's
    rule combines the two variances.

    Both arrays have the estimate first. The other values of `own` leave out some samples, and those of `other` leave
    out a row of the reference.
    """
    sides = [side[1:] for side in (own, other) if len(side) > 2]
    variances = [float(jackknife_variance(side)) for side in sides]
    total = sum(variances)
    spread = sum(v**2 / (len(side) - 1) for v, side in zip(variances, sides, strict=True))
    freedom = total**2 / spread if spread > 0 else float(len(own) - 2)
    return JackknifeEstimate(float(own[0]), float(np.sqrt(total)), freedom)


# --- results of a session ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ConvergenceResults:
    """All records of a session. `remark` is a warning about compared times, or empty."""

    points: list[PointRecord]
    methods: list[MethodRecord]
    references: list[ReferenceRecord]
    remark: str = ""


class Judgement:
    """Evaluation of the samples of a session so far."""

    def __init__(self, session: Session) -> None:
        self._session = session
        shapes: Mapping[str, Sequence[int]] = session.facts.get("shapes", {})
        self._shapes = {key: tuple(shape) for key, shape in shapes.items()}
        self._slices = places({key: int(np.prod(shape, dtype=int)) for key, shape in shapes.items()})
        #: All comparisons of the session have a common correction.
        entries, members = sum(map(entry_count, self._shapes.values())), len(session.of("case")) + 1
        self._family = Family(members * len(shapes), members * entries)
        #: Each parameter's slice, and the slice of all parameters together if there are several.
        self._places = self._slices if len(self._slices) == 1 else self._slices | {ALL: slice(None)}
        #: References of the errors, by parameter and for all; empty if there are too few steps of the reference.
        self._whole = {
            key: ReferenceMean(self._rows(found, place))
            for found in session.of("reference") if _is_usable(found) for key, place in self._places.items()
        }  # fmt: skip

    def _rows(self, member: Member, place: slice) -> np.ndarray:
        """Return the independent estimates that a reference member has made, (K, P): the means of its turns. If there
        are several dL/dI, turns with the same dL/dI are combined.
        """
        turns, rows = member.turns, member.draws.values[:, place].astype(np.float64)
        if self._session.plan.quantity == "loss" and len(member.kept) > IMAGES:
            turns = turns % IMAGES
        return np.stack([rows[turns == turn].mean(0) for turn in np.unique(turns)])

    @property
    def ready(self) -> bool:
        """Whether there is any result."""
        return bool(self._whole)

    def overall(self, member: Member) -> MethodRecord:
        """Return the figures of all parameters together, or of the image, without biases."""
        key = next(reversed(self._places))
        return self._method(member, key, Bias())

    def results(self) -> ConvergenceResults:
        """Return all records."""
        session, points, methods = self._session, list[PointRecord](), list[MethodRecord]()
        reference = next(iter(session.of("reference")), None)
        own = self._biases(reference) if reference is not None and self.ready else {}
        for member in session.of("case"):
            if member.status is BenchStatus.REFUSED:
                continue
            biases = self._biases(member) if self._is_measured(member) else {}
            for key in self._places:
                methods.append(self._method(member, key, biases.get(key, Bias()), own))
                if self._has_figures(member, key):
                    points += self._samples(member, key).points(member.method, key)
        stood = []
        for key, bias in own.items():
            assert reference is not None
            figures = vars(bias) | ({"message": _UNSEEN} if self._whole[key].floor is None else {})
            figures |= {"repeats": len(reference.draws), "reference_rmse": self._whole[key].floor}
            stood.append(ReferenceRecord(method=reference.method, parameter=key, **figures))
        return ConvergenceResults(points, methods, stood, mixed_sessions(member.draws for member in session.of("case")))

    def _is_measured(self, member: Member) -> bool:
        """Whether a member has enough finite samples."""
        return self.ready and member.status is BenchStatus.OK and _is_usable(member)

    def _has_figures(self, member: Member, key: str) -> bool:
        return self._is_measured(member) and self._whole[key].floor is not None

    # --- bias ---------------------------------------------------------------------------------------------------------

    def _judge(self, member: Member, key: str) -> Member | None:
        """Return the member that tests for bias: an independent stock integrator if there is one, otherwise the
        reference.
        """
        session = self._session
        reference = session.of("reference")[0]
        stock = session.judges.get(session.facts["independent"][key] or "")
        if stock is not None and stock is not member and _is_usable(stock) and stock.case.type != member.case.type:
            return stock
        return None if member is reference else reference

    def _biases(self, member: Member) -> dict[str, Bias]:
        """Return the bias for each parameter, and the worst bias if there are several parameters."""
        found = {key: self._bias(member, key) for key in self._slices}
        if len(found) == 1:
            return found
        biases = list(found.values())
        worst = max(biases, key=lambda bias: -1.0 if bias.bias_z is None else bias.bias_z)
        biased = True if any(b.biased for b in biases) else None if any(b.biased is None for b in biases) else False
        judges = ", ".join(dict.fromkeys(b.bias_reference for b in biases if b.bias_reference is not None)) or None
        message = next((b.message for b in biases if b.message), "")
        found[ALL] = replace(worst, biased=biased, bias_reference=judges, message=message)
        return found

    def _bias(self, member: Member, key: str) -> Bias:
        judge, place = self._judge(member, key), self._slices[key]
        if judge is None:
            return Bias(message="there is no independent reference")
        ours, theirs = member.draws.values[:, place].astype(np.float64), self._rows(judge, place)
        if member.role != "case":
            ours = self._rows(member, place)
        # The source of the code that traces a member's paths: `reslrb`, or a stock integrator.
        kin = {one.case.type if one.case.type in ("ptracer", "prb") else "ours" for one in (judge, member)}
        figures = compare_expectations(
            ours, theirs, self._family, shape=self._shapes[key], paired=False,
            reference_error=0.0 if len(kin) == 1 else STOCK_ROUNDING,
        )  # fmt: skip
        biased = {Verdict.HOLDS: False, Verdict.FAILS: True}.get(figures.verdict)
        message = figures.message or ("gradient and reference differ" if biased else "")
        return Bias(figures.z_max, figures.z_max_limit, judge.label, biased, message)

    # --- records ------------------------------------------------------------------------------------------------------

    def _samples(self, member: Member, key: str) -> MethodSamples:
        return MethodSamples(member.draws.values[:, self._places[key]], member.turns, member.seconds, self._whole[key])

    def _method(self, member: Member, key: str, bias: Bias, references: dict[str, Bias] | None = None) -> MethodRecord:
        draws = member.draws
        figures: dict[str, Any] = {"method": member.method, "parameter": key, "status": member.status}
        figures |= {"repeats": len(draws), "cold_s": None if draws.cold_ms is None else draws.cold_ms / 1e3}
        if not self._has_figures(member, key):
            reason = _flaw(member) or member.reason
            if (rounds := self._session.plan.rounds) is not None and rounds < FEWEST:
                reason = reason or f"results need {FEWEST} rounds; set --rounds"
            reason = reason or (_UNSEEN if self._is_measured(member) else "the budget was spent")
            return MethodRecord(**figures, message=reason)
        samples, biased = self._samples(member, key), bias.biased is True
        magnitude = samples
        if biased and references is not None and references[key].biased and key != ALL:
            judge = self._judge(member, key)
            if judge is not None:  # the reference is biased itself
                magnitude = MethodSamples(samples.deviations + samples.reference.mean, samples.turns, samples.seconds,
                                    ReferenceMean(self._rows(judge, self._places[key])))  # fmt: skip
        message = bias.message
        if not message and tail_weight(samples.deviations) > TAIL:
            message = HEAVY
        times = {f"{target:g}": magnitude.seconds_to(target, biased) for target in TARGETS}
        efficiency = magnitude.efficiency()
        return MethodRecord(
            **figures,
            step_s=samples.step_s,
            relative_rmse=float(np.sqrt(samples.variance)),
            reference_rmse=samples.reference.floor,
            efficiency=None if efficiency is None else efficiency.exponential(),
            efficiency_freedom=None if efficiency is None else efficiency.freedom,
            bias=float(np.sqrt(magnitude.squared_bias)) if biased else None,
            seconds_to={name: seconds for name, (seconds, _) in times.items()},
            extrapolated=[name for name, (_, beyond) in times.items() if beyond],
            **vars(replace(bias, message=message)),
        )


def _is_usable(member: Member) -> bool:
    """Whether a member has enough finite samples for a standard error."""
    return len(member.kept) >= FEWEST and not _flaw(member)


def _flaw(member: Member) -> str:
    """Return why draws cannot be used, or an empty text."""
    wrong = np.count_nonzero(~np.isfinite(member.draws.values), axis=1)
    if not wrong.any():
        return ""
    first = int(np.argmax(wrong > 0))
    return f"{wrong[first]} entries of step {first + 1} are not finite"
