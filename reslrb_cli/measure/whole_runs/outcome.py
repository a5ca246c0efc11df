"""All that whole runs come to: a record of each method, each at the best of its learning rates, and who is the best."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from reslrb_cli.measure.whole_runs.rates import best_of, ratio
from reslrb_cli.measure.whole_runs.run import Run
from reslrb_cli.measure.whole_runs.verdict import Verdict, finals, find_best, method_records
from reslrb_cli.records.whole_runs import Band, RunBestRecord, RunMethodRecord


@dataclass(frozen=True)
class Outcome:
    """`methods` have all rates apart; `bests`, and the verdicts on `loss` and `error`, each method at its best."""

    methods: list[RunMethodRecord]
    bests: list[RunBestRecord]
    loss: Verdict | None
    error: Verdict | None


def outcome(runs: Sequence[Run], limit_s: float, names: Mapping[str, str]) -> Outcome:
    """Of runs of so many seconds; `names` has the method's label by that of each of its rates."""
    bests, verdicts = [], []
    for of in ("loss", "parameter_error"):
        values = finals(runs, limit_s, of)
        # Of a seed that was broken off some have runs: medians over other seeds than the others' would be compared.
        seeds = min(map(len, values.values()), default=0)
        values = {label: found[:seeds] for label, found in values.items()}
        best = best_of(values, names)
        verdicts.append(find_best({name: values[label] for name, label in best.items()}))
        bests += _bests(of, values, best, names)
    return Outcome(method_records(runs, limit_s), bests, *verdicts)


def _bests(
    of: str, values: Mapping[str, Sequence[float]], best: Mapping[str, str], names: Mapping[str, str]
) -> list[RunBestRecord]:
    """Of each method, where there is more to say than its own record does."""
    rows = {name: [values[label] for label in values if names[label] == name] for name in best}
    base = next((name for name in names.values() if name in best), None)
    found = []
    for name, label in best.items():
        of_all = [each for each, method in names.items() if method == name]
        value = Band.of(values[label])
        apart = None if name == base or base is None else ratio(rows[name], rows[base])
        if value is not None and (len(of_all) > 1 or apart is not None):
            outermost = len(of_all) > 1 and label in (of_all[0], of_all[-1])
            at = label if len(of_all) > 1 else None
            to = None if apart is None else base
            found.append(RunBestRecord(name, of, at, outermost, len(values[label]), value, apart, to))
    return found
