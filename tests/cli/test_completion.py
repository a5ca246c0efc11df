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
from reslrb_cli.cli.options import setting_keys
from reslrb_cli.config.loader import parse_override
from reslrb_cli.config.yaml_text import format_location


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
        (["optimize", "a.yaml", "--set", "run.sp"], [("plain", "run.spp=")]),
        (["sweep", "a.yaml", "--vary", "optimizer.learn"], [("plain", "optimizer.learning_rate=")]),
        (["bench", "--set", "parameters[3].learning_rate.s"], [("plain", "parameters[3].learning_rate.scale=")]),
        (["optimize", "a.yaml", "--set", "run.nothing"], []),
        (["example", "cornell"], [("plain", "cornell_floor")]),
    ],
)  # fmt: skip
def test_completions(words, found):
    assert offered(*words) == found


def test_every_command_is_completed():
    assert {text for _, text in offered("")} == set(main.list_commands(None))
    assert {text for _, text in offered("example", "")} == set(examples())


def test_completed_keys_are_valid_overrides():
    keys = setting_keys()
    assert {"run.spp", "optimizer.learning_rate", "integrator.estimator", "target.render.integrator.max_depth",
            "parameters[0].regularizers[0].weight", "run.checkpoint_every.seconds"} <= set(keys)  # fmt: skip
    assert all(format_location(parse_override(f"{key}=1").location) == key for key in keys)


def test_completion_loads_nothing_heavy():
    words = "optimize a.yaml --set run.sp"
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
