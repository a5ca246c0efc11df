"""`reslrb serve`: the pages of runs and sweeps in a browser, on this machine only.

The server reads. It has no other methods than GET and HEAD, and answers only names of this machine in `Host`, so that
no web page can read the runs through a name of its own. A path is never joined to a folder: it is looked up among the
pages that were found in the folder, without following links.
"""

from __future__ import annotations

import math
import os
import re
import threading
from dataclasses import dataclass
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, quote, unquote, urlencode, urlsplit

import click

from reslrb_cli.cli.options import FOLDER
from reslrb_cli.cli.terminal import echo
from reslrb_cli.config.files import tail
from reslrb_cli.errors import ConfigError, describe

#: Names of this machine in the header `Host`.
LOCAL = re.compile(r"(127\.0\.0\.1|localhost|\[::1\])(:\d+)?", re.IGNORECASE)

#: Number of last bytes of a file of metrics in which the last line is searched.
LAST_BYTES = 1 << 16

#: Names of folders need not be UTF-8.
_BYTES = "surrogateescape"

#: Folders within folders in which runs are found: the runs of a sweep, in a folder of sweeps.
DEPTH = 2


@dataclass(frozen=True)
class Served:
    """Run or sweep on the list: its path relative to the served folder, the file of its page, and the address of the
    page. A run without a page has no file, and the address is empty.
    """

    name: str
    folder: Path
    file: Path | None
    page: str
    is_run: bool


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Print nothing: the browser has left before its answer was complete."""


@click.command("serve")
@click.argument("folder", metavar="[RUNS]", default="runs", type=FOLDER)
@click.option(
    "--port", type=click.IntRange(0, 65535), default=8000, show_default=True, metavar="N",
    help="Port of the server; 0 chooses a free one.",
)  # fmt: skip
def command(folder: Path, port: int) -> int:
    """Show the runs of a folder in a browser, while they are running.

    RUNS is a folder with run folders and sweeps, by default `runs`. The first page lists them, and compares two runs.
    Pages reload every 5 seconds until their run ends. Only programs on this machine can reach the server, and it
    changes nothing. Ctrl-C ends it.
    """
    if not folder.is_dir():
        raise ConfigError(folder, "", "no such file or folder; give the folder that contains the run folders")
    from reslrb_cli.backend.installation import load_packages

    load_packages()  # Mitsuba reads the images
    with make_server(folder, port) as server:
        echo(f"http://127.0.0.1:{server.server_port}/ shows {os.path.relpath(folder)}; Ctrl-C ends it")
        server.serve_forever()
    return 0


def make_server(folder: Path, port: int) -> ThreadingHTTPServer:
    """Return a server of the runs in `folder`. Raises ConfigError if the port is in use."""
    try:
        server = _Server(("127.0.0.1", port), partial(_Handler, folder.resolve()))
    except OSError as error:
        raise ConfigError("--port", "", f"{port}: {error.strerror}; give another port, or 0 for a free one") from None
    return server


def find_served(root: Path) -> list[Served]:
    """Return the runs and sweeps in `root` and its folders, sorted by name.

    Links to folders, hidden folders, and folders with a link that leaves `root` are left out.
    """
    from reslrb_cli.records.manifest import MANIFEST_FILE
    from reslrb_cli.records.sweeps import PAGE_FILE, SWEEP_FILE

    found = []
    for place, folders, files in os.walk(root):
        folder = Path(place)
        depth = len(folder.relative_to(root).parts)
        is_run = MANIFEST_FILE in files
        folders[:] = [] if is_run or depth >= DEPTH else sorted(name for name in folders if not name.startswith("."))
        inside = (path for path in (folder.rglob("*") if is_run else folder.iterdir()) if path.is_symlink())
        if (is_run or SWEEP_FILE in files) and all(_stays(path, root) for path in inside):
            page = folder / ("report.html" if is_run else PAGE_FILE)
            file = page if page.is_file() and not page.is_symlink() else None
            address = "" if file is None else quote(f"/{file.relative_to(root).as_posix()}", errors=_BYTES)
            name = root.name if folder == root else folder.relative_to(root).as_posix()
            found.append(Served(name, folder, file, address, is_run))
    return found


def _stays(link: Path, root: Path) -> bool:
    """Whether a link leads into `root`. False for links that form a loop."""
    try:
        return link.resolve(strict=True).is_relative_to(root)
    except FileNotFoundError:
        return link.resolve().is_relative_to(root)
    except (OSError, RuntimeError):  # Python before 3.13 raises a RuntimeError for loops
        return False


def _number(value: Any) -> float | int | None:
    """Return `value` if it is a finite number, and None for the content of a damaged file."""
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
    return value if is_number else None


def _row(run: Served, first: str) -> dict[str, Any]:
    """Return the line of a run on the list. `first` is the run to compare with, or empty."""
    from reslrb_cli.records.manifest import read_manifest

    manifest = read_manifest(run.folder, mend=False) or {}
    last = {key: _number(value) for key, value in _last_record(run.folder).items()}
    iteration = last.get("iteration")
    query = {"run": [first, run.name]} if first else {"with": run.name}
    target = "compare" if first else ""
    return {
        "name": run.name, "page": run.page, "status": str(manifest.get("status", "")),
        "started": str(manifest.get("started") or ""), "iterations": 0 if iteration is None else int(iteration) + 1,
        "loss": last.get("loss"), "error": last.get("parameter_rmse"),
        "compare": "" if run.name == first else f"/{target}?{urlencode(query, doseq=True, errors=_BYTES)}",
    }  # fmt: skip


def _last_record(folder: Path) -> dict[str, Any]:
    """Return the last complete line of a run's metrics. The result is empty without one."""
    import json

    from reslrb_cli.records.metrics import METRICS_FILE

    try:
        with (folder / METRICS_FILE).open("rb") as file:
            found = json.loads(tail(file, LAST_BYTES).rpartition(b"\n")[0].rpartition(b"\n")[2])
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


#: Matplotlib and Mitsuba draw one page at a time.
_drawing = threading.Lock()


class _Handler(BaseHTTPRequestHandler):
    """Answers to GET and HEAD. `root` is the served folder."""

    timeout = 30
    server_version = "reslrb"
    sys_version = ""

    def __init__(self, root: Path, *given: object) -> None:
        self._root = root
        super().__init__(*given)  # type: ignore[arg-type]

    def do_GET(self) -> None:
        self._answer(with_body=True)

    def do_HEAD(self) -> None:
        self._answer(with_body=False)

    def log_message(self, format: str, *given: object) -> None:
        """Print nothing about requests."""

    def _answer(self, with_body: bool) -> None:
        if not LOCAL.fullmatch(self.headers.get("Host", "")):
            self.send_error(HTTPStatus.FORBIDDEN, explain="This server answers only to 127.0.0.1 and localhost.")
            return
        try:
            page = self._page()
        except Exception as error:  # files of users can have any content
            self.send_error(HTTPStatus.INTERNAL_SERVER_ERROR, explain=describe(error))
            return
        if page is None:
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", "text/html; charset=utf-8")
        self.send_header("Content-Length", str(len(page)))
        self.end_headers()
        if with_body:
            self.wfile.write(page)

    def end_headers(self) -> None:
        """Add the headers that all answers have. The policy is that of the pages, also for pages that lack it."""
        from reslrb_cli.report.page.layout import policy

        self.send_header("Content-Security-Policy", f"{policy()}; base-uri 'none'; form-action 'none'")
        for name, value in (("X-Content-Type-Options", "nosniff"), ("X-Frame-Options", "DENY"),
                            ("Referrer-Policy", "no-referrer"), ("Cache-Control", "no-store"),
                            ("Cross-Origin-Resource-Policy", "same-origin")):  # fmt: skip
            self.send_header(name, value)
        super().end_headers()

    def _page(self) -> bytes | None:
        """Return the page at the requested address, or None if there is none."""
        try:
            address = urlsplit(self.path)
        except ValueError:  # http://[
            return None
        path, query = unquote(address.path, errors=_BYTES), parse_qs(address.query, errors=_BYTES)
        served = find_served(self._root)
        runs = [each for each in served if each.is_run]
        if path == "/":
            return self._list(served, next(iter(query.get("with", [])), ""))
        if path == "/compare":
            chosen = [each for name in query.get("run", []) for each in runs if each.name == name]
            return self._compare(chosen) if len(chosen) == 2 else None
        for each in served:
            if each.file is not None and path == unquote(each.page, errors=_BYTES):
                with os.fdopen(os.open(each.file, os.O_RDONLY | os.O_NOFOLLOW), "rb") as file:
                    return file.read()
        return None

    def _list(self, served: list[Served], first: str) -> bytes:
        from reslrb_cli.report.page import REFRESH_SECONDS
        from reslrb_cli.report.page.layout import document, lay_out

        first = first if any(each.name == first for each in served) else ""
        rows = [_row(each, first) for each in served if each.is_run]
        rows.sort(key=lambda row: str(row["started"]), reverse=True)
        sweeps = [each for each in served if not each.is_run and each.file is not None]
        parts = [("Sweeps", lay_out("served.sweeps", sweeps)), ("Runs", lay_out("served.runs", rows, first))]
        title = self._root.name or "/"
        return document(title, lay_out("header", title), parts, REFRESH_SECONDS).encode("utf-8", "replace")

    def _compare(self, chosen: list[Served]) -> bytes:
        from reslrb_cli.report.page import REFRESH_SECONDS
        from reslrb_cli.report.page.compare import compare_parts
        from reslrb_cli.report.page.layout import document, lay_out
        from reslrb_cli.report.sources import read_run

        with _drawing:
            shown = [read_run(each.folder, each.name, mend=False) for each in chosen]
            parts = list(compare_parts(shown).items())
        title = " and ".join(each.name for each in chosen)
        refresh = REFRESH_SECONDS if any(run.at_work for run in shown) else None
        return document(title, lay_out("header", title), parts, refresh).encode("utf-8", "replace")
