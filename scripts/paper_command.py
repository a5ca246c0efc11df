"""What the commands of the paper's figures share: their options, the files that they write, and how they end."""

from __future__ import annotations

import argparse
import json
import signal
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

from benchmarks_measure import code_state

from reslrb_cli.backend.doctor import device_name
from reslrb_cli.backend.variant import choose
from reslrb_cli.errors import ExitCode, ReslrbError, one_line
from reslrb_cli.measure.processes import Ended
from reslrb_cli.records.measurement_files import Origin

ROOT = Path(__file__).resolve().parent.parent
#: Measures, given the options, a folder that is removed afterwards, and what tells the user of a line.
Measure = Callable[[argparse.Namespace, Path, Callable[[str], None]], Any]


def figure_parser(name: str, text: str) -> argparse.ArgumentParser:
    """A parser of the options of `scripts/paper NAME`, whose module's docstring is `text`."""
    parser = argparse.ArgumentParser(prog=f"scripts/paper {name}", description=text.split("\n\n")[1])
    parser.add_argument("-o", dest="folder", type=Path, default=ROOT / "build" / "paper", help="default: build/paper")
    return parser


def add_sampling(parser: argparse.ArgumentParser, seeds: int, of: str) -> None:
    """Add the options of a figure that compares gradients."""
    parser.add_argument("--seeds", type=int, default=seeds, help=f"{of}; default: {seeds}")
    parser.add_argument("--set", dest="sets", action="append", default=[], metavar="KEY=VALUE", help="change a setting")


def run(name: str, parser: argparse.ArgumentParser, arguments: list[str], least: int, measure: Measure,
        report: ModuleType) -> int:  # fmt: skip
    """Measure, check, and write NAME.txt, NAME.json and NAME.png; the exit code.

    `report` has `table`, `to_json` and `draw` of what `measure` returns, which knows whether it `holds`. Fewer seeds
    than `least` are refused.
    """
    options = parser.parse_args(arguments)
    if options.seeds < least:
        parser.error(f"--seeds must be at least {least}")
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.default_int_handler)  # so that nothing stays behind

    def say(line: str) -> None:
        print(f"{name}: {line}", file=sys.stderr, flush=True)

    try:
        options.folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f"reslrb-{name}-") as folder:
            result = measure(options, Path(folder), say)
        text = report.table(result)
        print(text)
        (options.folder / f"{name}.txt").write_text(text + "\n", encoding="utf-8")
        (options.folder / f"{name}.json").write_text(
            json.dumps({"origin": _origin(name, options, result)} | report.to_json(result), indent=1) + "\n",
            encoding="utf-8",
        )
        report.draw(result, options.folder / f"{name}.png")
        say(f"{name}.png, {name}.txt and {name}.json are in {options.folder}")
    except KeyboardInterrupt:
        return ExitCode.INTERRUPTED
    except (ReslrbError, Ended, OSError) as error:
        print(one_line(f"{name}: {error}"), file=sys.stderr)
        return int(getattr(error, "exit_code", ExitCode.CHECK_FAILED))
    return ExitCode.DONE if result.holds else ExitCode.CHECK_FAILED


def _origin(name: str, options: argparse.Namespace, result: Any) -> dict[str, Any]:
    """What measured, and the command that does it again, in which the room has no user's path."""
    variant, _ = choose(result.config.variant)
    words = ["scripts/paper", name, *(["ROOM"] if hasattr(options, "room") else []), "--seeds", str(options.seeds)]
    words += [word for setting in options.sets for word in ("--set", setting)]
    return json.loads(Origin(device_name(variant), variant, words).to_json()) | code_state()  # type: ignore[no-any-return]
