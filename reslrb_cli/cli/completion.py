"""`reslrb completion`: what has a shell complete commands, options, paths and keys of settings, by click's own means.

`setting_keys` has the keys of `--set` and `--vary` from the schema of configurations: no scene is read, and nothing
heavy is loaded.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any

import click
from click.shell_completion import BashComplete, CompletionItem, ShellComplete, ZshComplete, get_completion_class

from reslrb_cli.errors import ExitCode

SHELLS = ("bash", "zsh", "fish")

#: Sections within sections whose keys are offered: a schema may hold itself.
_DEEPEST = 6


class Bash(BashComplete):
    """As click has it, but no space comes behind what ends as a key that goes on: `run.` and `run.spp=`."""

    source_template = BashComplete.source_template.replace(
        "COMPREPLY+=($value)", "COMPREPLY+=($value)\n            [[ $value == *[.=] ]] && compopt -o nospace"
    )

    def source(self) -> str:
        """The script; click's own would run a bash first, to see how old that is."""
        return str(self.source_template % self.source_vars())


class Zsh(ZshComplete):
    """As click has it, with the same exception."""

    source_template = ZshComplete.source_template.replace(
        "        compadd -U -V unsorted -a completions\n",
        "        local -a goes_on=(${(M)completions:#*[.=]}) ends=(${completions:#*[.=]})\n"
        "        (( $#goes_on )) && compadd -U -S '' -V unsorted -a goes_on\n"
        "        (( $#ends )) && compadd -U -V unsorted -a ends\n",
    )


@click.command("completion")
@click.argument("shell", type=click.Choice(SHELLS))
def command(shell: str) -> int:
    """Print the script by which SHELL completes what begins with reslrb.

    For the shell that runs: eval "$(reslrb completion bash)", or the same with zsh; in fish, reslrb completion fish |
    source. In ~/.bashrc, ~/.zshrc or ~/.config/fish/config.fish that is for every one.
    """
    from reslrb_cli.cli import COMPLETE_VARIABLE, main

    ours: dict[str, type[ShellComplete]] = {"bash": Bash, "zsh": Zsh}
    kind = ours.get(shell) or get_completion_class(shell)
    assert kind is not None
    click.echo(kind(main, {}, "reslrb", COMPLETE_VARIABLE).source())
    return ExitCode.DONE


def complete_setting(_context: click.Context, _parameter: click.Parameter, begun: str) -> list[CompletionItem]:
    """What a key that is `begun` may go on with, a section at a time: `run.` of `r`, then `run.spp=` of `run.sp`."""
    plain = re.sub(r"\[\d+\]", "[0]", begun)
    section = plain.rpartition(".")[0]
    start = len(section) + bool(section)
    own = begun.rpartition(".")[0]  # with the user's own indices
    found = [key[start:] for key in setting_keys() if key.startswith(plain)]
    parts = [f"{rest.partition('.')[0]}." if "." in rest else f"{rest}=" for rest in found]
    return [CompletionItem(f"{own}.{part}" if own else part) for part in dict.fromkeys(parts)]


def setting_keys() -> list[str]:
    """Every key that a configuration may have, of lists of sections those of the first: `parameters[0].bounds`."""
    from reslrb_cli.config.schema import Config

    schema = Config.model_json_schema()
    return list(dict.fromkeys(_keys(schema, schema["$defs"], "", _DEEPEST)))


def _keys(schema: Mapping[str, Any], known: Mapping[str, Any], at: str, deep: int) -> Iterator[str]:
    """The keys below `at`, of all that a value may be which `schema` describes."""
    if "$ref" in schema:
        schema = known[schema["$ref"].rpartition("/")[2]]
    for other in (*schema.get("anyOf", ()), *schema.get("oneOf", ())):
        yield from _keys(other, known, at, deep)
    if "items" in schema and _is_section(schema["items"], known):
        yield from _keys(schema["items"], known, f"{at}[0]", deep)
    for name, value in (schema.get("properties") or {}).items() if deep else ():
        key = f"{at}.{name}" if at else name
        yield key
        yield from _keys(value, known, key, deep - 1)


def _is_section(schema: Mapping[str, Any], known: Mapping[str, Any]) -> bool:
    return next(_keys(schema, known, "", 1), None) is not None
