"""The experiment of a run with the values to which the run brought its parameters, for what goes on from there."""

from __future__ import annotations

from pathlib import Path

from reslrb_cli.cli.experiment import read_config
from reslrb_cli.config import Config, RunValue
from reslrb_cli.records.run_values import checkpoint_of


def read_recovered(run: Path, overrides: tuple[str, ...]) -> Config:
    """The configuration of the run in the folder `run`, its parameters beginning where that run has brought them.

    Raises ConfigError, located in the folder, where it is no run's or holds no values.
    """
    checkpoint_of(run)
    config = read_config(run / "config.yaml", overrides)
    start = RunValue(run=run.absolute())
    specs = [spec.model_copy(update={"initial": start}) for spec in config.parameters]
    return config.model_copy(update={"parameters": specs})
