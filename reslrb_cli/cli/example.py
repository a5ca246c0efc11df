"""`reslrb example`: list the experiments that come with the program, and copy them.

The experiments are in `configs/` and `scenes/` of the repository. `reslrb_cli/examples` links to these folders. In a
wheel, `reslrb_cli/examples` contains copies.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
from pathlib import Path

import click
from click.shell_completion import CompletionItem

import reslrb_cli
from reslrb_cli.cli.terminal import echo
from reslrb_cli.errors import ConfigError, ExitCode, did_you_mean
from reslrb_cli.records.atomic import write_atomically

FOLDER = Path(reslrb_cli.__file__).parent / "examples"

#: Relative path from a configuration to the folder of a scene.
_SCENE = re.compile(r"(?:\.\./)+scenes/(\w+)/")


def examples() -> dict[str, Path]:
    """Return the configurations by name, e.g. `cornell_floor` or `stiff/lamp`. The result is empty if the example
    configurations are not installed.
    """
    configs = FOLDER / "configs"
    found = [*configs.glob("*.yaml"), *configs.glob("*/*.yaml")]
    return {path.relative_to(configs).with_suffix("").as_posix(): path for path in sorted(found)}


def _complete(_context: click.Context, _parameter: click.Parameter, begun: str) -> list[CompletionItem]:
    return [CompletionItem(name, help=_about(path)) for name, path in examples().items() if name.startswith(begun)]


def _about(path: Path) -> str:
    """Return the first sentence of the comment at the head of an example."""
    lines = path.read_text(encoding="utf-8").splitlines()
    ends = next((place for place, line in enumerate(lines) if not line.startswith("#")), len(lines))
    words = " ".join(line.lstrip("# ") for line in lines[:ends])
    return re.split(r"(?<=[.:])\s", words, maxsplit=1)[0].rstrip(".:")


@click.command("example")
@click.argument("name", required=False, shell_complete=_complete)
@click.option("-o", "--output", "folder", type=click.Path(path_type=Path, file_okay=False), metavar="FOLDER",
              help="Folder to copy to. Default: a folder with the name of the experiment.")  # fmt: skip
def command(name: str | None, folder: Path | None) -> int:
    """Copy the experiment NAME (configuration and scene) to a folder. Without NAME, list the experiments.

    Existing files are never replaced.
    """
    known = examples()
    if not known:
        raise ConfigError(FOLDER, "", "has no examples: the installation is incomplete; install reslrb again")
    if name is None:
        width = max(map(len, known))
        for each, path in known.items():
            echo(f"{each:{width}}  {_about(path)}")
        return ExitCode.DONE
    if name not in known:
        hint = did_you_mean(name, known, otherwise=f"there are {', '.join(known)}")
        raise ConfigError("NAME", "", f"no example is called `{name}`; {hint}")
    config = copy(known[name], folder or Path(name.rpartition("/")[2]))
    echo(f"look at {os.path.relpath(config)}, then: reslrb optimize {shlex.quote(os.path.relpath(config))}")
    return ExitCode.DONE


def copy(path: Path, folder: Path) -> Path:
    """Copy the configuration `path` and the folders of its scenes into `folder`; return the path of the copy.

    Raises ConfigError before anything is written if a file exists already. Also raises ConfigError if `folder` cannot
    be written to.
    """
    text = path.read_text(encoding="utf-8")
    scenes = [FOLDER / "scenes" / name for name in dict.fromkeys(_SCENE.findall(text))]
    files = {folder / "scenes" / scene.name / file.name: file for scene in scenes for file in sorted(scene.iterdir())}
    config = folder / path.name
    if taken := next((each for each in (config, *files) if os.path.lexists(each)), None):
        raise ConfigError(taken, "", "exists; give another folder with -o, or remove it")
    try:
        for target, file in files.items():
            target.parent.mkdir(parents=True, exist_ok=True)
            with file.open("rb") as source:
                write_atomically(target, lambda copied, source=source: shutil.copyfileobj(source, copied))  # type: ignore[misc]
        mended = _SCENE.sub(r"scenes/\1/", text).encode()
        write_atomically(config, lambda copied: copied.write(mended))
    except OSError as error:
        raise ConfigError("-o", "", f"cannot write to {folder}: {error.strerror}") from None
    return config
