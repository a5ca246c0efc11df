"""`reslrb doctor`: report the backends and packages of this machine, and what to install."""

from __future__ import annotations

import click

from reslrb_cli.backend.doctor import Backend, Report, examine
from reslrb_cli.cli.terminal import echo
from reslrb_cli.errors import BackendError


@click.command("doctor")
def command() -> None:
    """Show the variant, device, libLLVM and versions in use, and test them.

    Each backend compiles and runs one kernel and traces one ray. The exit code is 3 if no backend works.
    """
    report = examine()
    for name, value in _lines(report):
        echo(f"{name:14} {value}")
    missing = [name for name, version in report.packages.items() if version is None and name != "reslrb"]
    if missing:
        raise BackendError(f"missing packages; install them with `pip install {' '.join(missing)}`")
    if report.variant is None:
        raise BackendError("no backend works; install one of those above")


def _lines(report: Report) -> list[tuple[str, str]]:
    lines = [("variant", f"auto is {report.variant}" if report.variant else "none works")]
    lines += [pair for backend in report.backends for pair in _backend_lines(backend)]
    lines += [("python", report.python), ("platform", report.platform)]
    lines += [(name, version or "not installed") for name, version in report.packages.items()]
    return lines


def _backend_lines(backend: Backend) -> list[tuple[str, str]]:
    if backend.missing:
        return [(backend.variant, f"not usable: {backend.missing}")]
    trial = backend.trial
    return [
        (backend.variant, f"works on {backend.device}"),
        *([("", backend.library)] if backend.library else []),
        (
            "",
            f"a kernel compiled and ran in {trial.compile_ms:.0f} ms, again in {trial.run_ms:.1f} ms; "
            f"the first ray took {trial.ray_ms:.0f} ms",
        ),
    ]
