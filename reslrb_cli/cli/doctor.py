"""`reslrb doctor`: report the backends and packages of this machine, and what to install."""

from __future__ import annotations

import platform
import sys

import click

from reslrb_cli.backend.doctor import backends, packages
from reslrb_cli.cli.terminal import echo
from reslrb_cli.errors import BackendError


@click.command("doctor")
def command() -> None:
    """Show the variant, device, libLLVM and versions in use, and test them.

    Each backend compiles and runs one kernel and traces one ray. The exit code is 3 if no backend works.
    """
    found, versions = backends(), packages()
    works = [backend.variant for backend in found if not backend.missing]
    lines = [("variant", f"auto is {works[0]}" if works else "none works")]
    for each in found:
        lines.append((each.variant, f"not usable: {each.missing}" if each.missing else f"works on {each.device}"))
        lines += [("", each.library)] if each.library and not each.missing else []
    lines += [("python", f"{platform.python_version()} ({sys.executable})"), ("platform", platform.platform())]
    lines += [(name, version or "not installed") for name, version in versions.items()]
    for name, value in lines:
        echo(f"{name:14} {value}")
    missing = [name for name, version in versions.items() if version is None and name != "reslrb"]
    if missing:
        raise BackendError(f"missing packages; install them with `pip install {' '.join(missing)}`")
    if not works:
        raise BackendError("no backend works; install one of those above")
