"""Going on from the samples that an earlier session of a `gradcheck` has taken: the seeds after theirs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from reslrb_cli.measure import earlier
from reslrb_cli.measure.differences import Direction
from reslrb_cli.measure.earlier import Earlier
from reslrb_cli.measure.participants import Settings
from reslrb_cli.records.samples import Kept

#: What is kept says that it is of this.
KIND = "gradcheck"
#: What samples are of: `gradient` or `image` and an integrator's label, `differences` or `tangents` and a parameter.
Name = tuple[str, str]


def settings(checked: Settings, variant: str, device: str) -> dict[str, Any]:
    """What has to be the same in all sessions."""
    labels = [case.label for case in checked.integrators]
    return earlier.settings(checked.config, variant, device, estimators=labels, spp=checked.spp)


def restore(before: Earlier) -> dict[Name, list[np.ndarray]]:
    """The samples of an earlier session, by what they are of."""
    return {
        (kind, of): list(before.arrays[f"samples/{number}"]) for number, (kind, of) in enumerate(before.head["samples"])
    }


def restore_steps(before: Earlier, directions: Mapping[str, Sequence[Direction]]) -> dict[str, list[Direction]]:
    """The directions whose steps were chosen then, by parameter: differences go on with the same ones."""
    return {
        key: [
            replace(direction, step=step, truncation=truncation)
            for direction, (step, truncation) in zip(directions[key], steps, strict=True)
        ]
        for key, steps in before.head["steps"].items()
    }


def kept(
    settings: Mapping[str, Any], samples: Mapping[Name, Sequence[np.ndarray]], chosen: Mapping[str, Sequence[Direction]]
) -> Kept | None:
    """What a later session needs to go on; None where nothing has been sampled."""
    found = {name: np.stack(rows) for name, rows in samples.items() if rows}
    if not found:
        return None
    steps = {key: [[d.step, d.truncation] for d in directions] for key, directions in chosen.items()}
    arrays = {f"samples/{number}": rows for number, rows in enumerate(found.values())}
    return earlier.head(KIND, settings, samples=list(found), steps=steps), arrays
