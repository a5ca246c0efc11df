"""Samples of `gradcheck`, and cases of its suite, on workers (`calls.Workers`).

A sample depends on the experiment's files, on the steps of finite differences, and on its seed. Only the process of
`gradcheck` chooses the steps. A case depends only on its name.

The module imports dask, so it is imported only for `--cluster`.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from reslrb_cli.backend.variant import set_variant
from reslrb_cli.cluster.bundle import CONFIG_FILE, Bundle, Values, bundle_of, read_bundle
from reslrb_cli.cluster.calls import Workers
from reslrb_cli.cluster.connection import Place, connected
from reslrb_cli.cluster.worker import Workload, set_threads
from reslrb_cli.config.loader import dump, loads
from reslrb_cli.config.schema import Config
from reslrb_cli.errors import ConfigError
from reslrb_cli.measure.methods import Case as Listed
from reslrb_cli.measure.participants import CheckSettings, Participants
from reslrb_cli.measure.sampling import Steps
from reslrb_cli.measure.scenes import small

Stop = Callable[[], bool]


# --- on a worker ------------------------------------------------------------------------------------------------------


def participants_in(
    folder: Path, threads: int | None, variant: str, allows_code: bool, settings: Mapping[str, Any]
) -> tuple[Participants, dict[str, float]]:
    """Return the participants of the experiment in `folder`. `settings` holds further `CheckSettings`. No kernels are
    warm.
    """
    set_variant(variant)
    listed = [_with_file(case, lambda file: f"{folder / file}") for case in settings["integrators"]]
    config, initial = _read(folder)
    told = {**settings, "integrators": listed, "initial": initial}
    participants = Participants(CheckSettings(config.with_code(allows_code), **told))
    set_threads(threads)
    return participants, {}


def nothing_in(folder: Path, threads: int | None, variant: str) -> tuple[Stop, dict[str, float]]:
    """Return the argument that a case needs besides its name. The argument is a `stop` function that always returns
    False.
    """
    set_variant(variant)
    set_threads(threads)
    return lambda: False, {}


def _read(folder: Path) -> tuple[Config, Values | None]:
    text = (folder / CONFIG_FILE).read_text(encoding="utf-8")
    return (loads(text, small.CORNELL_BOX_SOURCE), None) if f"file: {small.FILE}" in text else read_bundle(folder)


def _with_file(case: Listed, put: Callable[[str], str]) -> Listed:
    """Return the integrator with its code file's path replaced. An integrator without a code file stays unchanged."""
    if case.type != "custom":
        return case
    file, _, name = str(case.options["file"]).rpartition(":")
    return replace(case, options={**case.options, "file": f"{put(file)}:{name}"})


# --- on the process that runs `gradcheck` -----------------------------------------------------------------------------


def check_shareable(settings: CheckSettings) -> None:
    """Raise ConfigError if samples depend on time or on the process that takes the samples."""
    if settings.seeds is None:
        reason = "a budget of seconds has no meaning on other machines; give the number of seeds with --seeds"
        raise ConfigError("--cluster", "", reason)
    for label, config in settings.configs().items():
        if config.integrator.options().get("guiding", "off") != "off":
            reason = f"{label} learns from earlier samples; use --set integrator.guiding=off, or remove --cluster"
            raise ConfigError(config.source, "integrator.guiding", reason)


@contextlib.contextmanager
def samples_at(
    settings: CheckSettings, participants: Participants, place: Place, variant: str, threads: int | None = None
) -> Iterator[Workers]:
    """Take samples of `participants` on the workers at a place, as a `sampling.Engine`. Raises as `Workers` does."""
    config = settings.config
    values = {key: participants.selection.array(key) for key in participants.selection.keys}
    built_in = config.scene.file == small.FILE
    bundle = Bundle({CONFIG_FILE: dump(config).encode()}) if built_in else bundle_of(config, values)
    sent = {
        "integrators": [_with_file(case, lambda file: bundle.add(Path(file))) for case in settings.integrators],
        "budget_s": settings.budget_s,
        "seeds": settings.seeds,
        "spp": settings.spp,
        "named": settings.named,
    }
    arguments, asks = (variant, config.allows_code, sent), config.allows_code and place.address is not None
    workload = Workload(bundle.files, participants_in, arguments, threads or place.threads, asks)
    with connected(place) as (client, _):
        yield Workers(client, workload, str(place), Steps.of)


@contextlib.contextmanager
def cases_at(place: Place, variant: str, threads: int | None = None) -> Iterator[Workers]:
    """Run cases (`extreme.case_records`) on the workers at a place, as `shards.serially` does in this process. Raises
    as `Workers` does.
    """
    with connected(place) as (client, _):
        yield Workers(client, Workload({}, nothing_in, (variant,), threads or place.threads), str(place))
