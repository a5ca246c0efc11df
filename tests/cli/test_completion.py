"""Shell completion: the candidates for each shell, Click's script in a bash, and no heavy import."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
from cli.tiny import ROOT
from click.shell_completion import BashComplete, FishComplete, ShellComplete, ZshComplete

from reslrb_cli.cli import main
from reslrb_cli.cli.example import examples
from reslrb_cli.cli.options import setting_keys
from reslrb_cli.config.loader import parse_override
from reslrb_cli.config.yaml_text import format_location


def offered(kind: type[ShellComplete], *words: str) -> list[tuple[str, str]]:
    """Return the types and texts of the candidates that a shell offers for the last, incomplete word."""
    shell = kind(main, {}, "reslrb", "_RESLRB_COMPLETE")
    return [(item.type, item.value) for item in shell.get_completions(list(words[:-1]), words[-1])]


@pytest.mark.parametrize("kind", [BashComplete, ZshComplete, FishComplete])
@pytest.mark.parametrize(
    ("words", "found"),
    [
        (["swe"], [("plain", "sweep")]),
        (["optimize", "--res"], [("plain", "--resume")]),
        (["optimize", ""], [("file", "")]),
        (["optimize", "--resume", "ru"], [("dir", "ru")]),
        (["sweep", "--resume", "ru"], [("dir", "ru")]),
        (["export", "ru"], [("dir", "ru")]),
        (["render", "ru"], [("file", "ru")]),
        (["optimize", "a.yaml", "--set", "run.sp"], [("plain", "run.spp=")]),
        (["sweep", "a.yaml", "--vary", "optimizer.learn"], [("plain", "optimizer.learning_rate=")]),
        (["bench", "--set", "parameters[3].learning_rate.s"], [("plain", "parameters[3].learning_rate.scale=")]),
        (["optimize", "a.yaml", "--set", "run.nothing"], []),
        (["example", "cornell"], [("plain", "cornell_floor")]),
    ],
)  # fmt: skip
def test_completions(kind, words, found):
    assert offered(kind, *words) == found


def test_every_command_is_completed():
    assert {text for _, text in offered(BashComplete, "")} == set(main.list_commands(None))
    assert {text for _, text in offered(BashComplete, "example", "")} == set(examples())


def test_completed_keys_are_valid_overrides():
    keys = setting_keys()
    assert {"run.spp", "optimizer.learning_rate", "integrator.estimator", "target.render.integrator.max_depth",
            "parameters[0].regularizers[0].weight", "run.checkpoint_every.seconds"} <= set(keys)  # fmt: skip
    assert all(format_location(parse_override(f"{key}=1").location) == key for key in keys)


def test_bash_completes():
    """A bash evaluates the line of docs/commands.md, and then calls the function that this line defines, as the Tab key
    does.
    """
    program = (
        'eval "$(_RESLRB_COMPLETE=bash_source reslrb)"\n'
        "COMP_WORDS=(reslrb optimize a.yaml --set run.sp) COMP_CWORD=4\n"
        "_reslrb_completion reslrb\necho ${COMPREPLY[*]}\n"
        "COMPREPLY=() COMP_WORDS=(reslrb swe) COMP_CWORD=1\n_reslrb_completion reslrb\necho ${COMPREPLY[*]}\n"
    )
    path = os.pathsep.join([os.path.dirname(sys.executable), os.environ["PATH"]])
    told = subprocess.run(["bash", "--norc", "-c", program], capture_output=True, text=True, check=False, cwd=ROOT,
                          env={**os.environ, "PATH": path})  # fmt: skip
    assert told.stdout.splitlines() == ["run.spp=", "sweep"], told.stderr


@pytest.mark.parametrize("words", ["optimize a.yaml --set run.sp", "swe", "example c"])
def test_completion_loads_nothing_heavy(words):
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
