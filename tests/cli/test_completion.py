"""Shell completion: the candidates, and no heavy import."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
from cli.tiny import ROOT
from click.shell_completion import BashComplete

from reslrb_cli.cli import main
from reslrb_cli.cli.example import examples


def offered(*words: str) -> list[tuple[str, str]]:
    """Return the types and texts of the candidates that a shell offers for the last, incomplete word."""
    shell = BashComplete(main, {}, "reslrb", "_RESLRB_COMPLETE")
    return [(item.type, item.value) for item in shell.get_completions(list(words[:-1]), words[-1])]


@pytest.mark.parametrize(
    ("words", "found"),
    [
        (["swe"], [("plain", "sweep")]),
        (["optimize", "--res"], [("plain", "--resume")]),
        (["optimize", ""], [("file", "")]),
        (["optimize", "--resume", "ru"], [("dir", "ru")]),
        (["render", "ru"], [("file", "ru")]),
        (["example", "cornell"], [("plain", "cornell_floor")]),
    ],
)  # fmt: skip
def test_completions(words, found):
    assert offered(*words) == found


def test_every_command_is_completed():
    assert {text for _, text in offered("")} == set(main.list_commands(None))
    assert {text for _, text in offered("example", "")} == set(examples())


def test_completion_loads_nothing_heavy():
    words = "optimize a.yaml --res"
    script = (
        "import sys; sys.argv[0] = 'reslrb'\n"
        "from reslrb_cli.cli import run\n"
        "try:\n    run()\n"
        "finally:\n    print(sorted({'mitsuba', 'drjit', 'numpy', 'scipy', 'matplotlib'} & set(sys.modules)))\n"
    )
    asked = {
        "COMP_WORDS": f"reslrb {words}",
        "COMP_CWORD": str(len(words.split())),
        "_RESLRB_COMPLETE": "bash_complete",
    }
    told = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False, cwd=ROOT,
                          env={**os.environ, **asked, "PYTHONPATH": str(ROOT)})  # fmt: skip
    *offered, heavy = told.stdout.splitlines()
    assert offered
    assert heavy == "[]"
    assert told.stderr == ""
