"""The commands as they are called, within the tests' own process."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from click.testing import CliRunner, Result

from reslrb_cli.cli import main


def reslrb(*arguments: object) -> Result:
    """What `reslrb ARGUMENTS` said, and its exit code."""
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


def done(*arguments: object) -> Result:
    """The same of a call that has to succeed."""
    result = reslrb(*arguments)
    assert result.exit_code == 0, result.output
    return result


def settings(*given: str) -> list[str]:
    """`--set` for each of them."""
    return [word for setting in given for word in ("--set", setting)]


def read_metrics(folder: Path | str) -> list[dict[str, Any]]:
    """The lines of a run's metrics, oldest first."""
    return [json.loads(line) for line in (Path(folder) / "metrics.jsonl").read_text().splitlines()]
