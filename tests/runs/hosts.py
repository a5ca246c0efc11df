"""Hosts on this machine, each in a network namespace of its own. One host runs the scheduler. Every other host reaches
only the scheduler.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

PORT = 8786
PREFIX = "reslrb-test"


def missing() -> str:
    """Return the reason why hosts cannot be made here, or an empty text if they can."""
    if shutil.which("ip") is None or shutil.which("openssl") is None:
        return "needs iproute2 and openssl"
    done = subprocess.run(["ip", "netns", "add", f"{PREFIX}-try"], capture_output=True, text=True)
    if done.returncode:
        return f"no network namespaces: {done.stderr.strip()}"
    subprocess.run(["ip", "netns", "del", f"{PREFIX}-try"], check=True)
    return ""


def make_certificates(folder: Path) -> dict[str, str]:
    """Write a key and a self-signed certificate, which is also the authority, as in docs/cluster.md. Return dask's
    variables for them.
    """
    request = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "1", "-subj", "/CN=reslrb",
               "-keyout", folder / "key.pem", "-out", folder / "cert.pem"]  # fmt: skip
    subprocess.run(request, check=True, capture_output=True)
    names = {"CA_FILE": "cert.pem"}
    for role in ("SCHEDULER", "WORKER", "CLIENT"):
        names |= {f"{role}__CERT": "cert.pem", f"{role}__KEY": "key.pem"}
    found = {f"DASK_DISTRIBUTED__COMM__TLS__{name}": str(folder / file) for name, file in names.items()}
    return found | {"DASK_DISTRIBUTED__COMM__REQUIRE_ENCRYPTION": "True"}


class Hosts:
    """Namespace `s` of the scheduler, and namespaces `0`, `1`, ... Each of these is connected only to `s`."""

    def __init__(self, count: int, folder: Path) -> None:
        self.folder, self.count = folder, count
        self.environment = {**os.environ, **make_certificates(folder), "RESLRB_CACHE": str(folder / "cache"),
                            "PYTHONPATH": os.pathsep.join(sys.path)}  # fmt: skip
        self.running: list[subprocess.Popen[bytes]] = []

    def address(self, host: int) -> str:
        """Return the address of the scheduler as seen from a host."""
        return f"tls://10.77.{host}.1:{PORT}"

    def make(self) -> None:
        """Make the namespaces and the links between them."""
        _ip("netns", "add", f"{PREFIX}-s")
        _ip("-n", f"{PREFIX}-s", "link", "set", "lo", "up")
        for host in range(self.count):
            name, ends = f"{PREFIX}-{host}", (f"rt{host}", f"rs{host}")
            _ip("netns", "add", name)
            _ip("-n", name, "link", "set", "lo", "up")
            _ip("link", "add", ends[0], "netns", name, "type", "veth", "peer", "name", ends[1], "netns", f"{PREFIX}-s")
            for space, end, last in ((name, ends[0], 2), (f"{PREFIX}-s", ends[1], 1)):
                _ip("-n", space, "addr", "add", f"10.77.{host}.{last}/24", "dev", end)
                _ip("-n", space, "link", "set", end, "up")

    def cut(self, host: int, whether: bool = True) -> None:
        """Disconnect a host, or connect a host again."""
        _ip("-n", f"{PREFIX}-s", "link", "set", f"rs{host}", "down" if whether else "up")

    def start(
        self, host: int | str, command: Sequence[object], core: int | None = None, **variables: str
    ) -> subprocess.Popen[bytes]:
        """Start a command on a host, on one core of this machine or on all cores. Its output goes to a log file."""
        pinned = [] if core is None else ["taskset", "-c", str(core)]
        words = ["ip", "netns", "exec", f"{PREFIX}-{host}", *pinned, *map(str, command)]
        log = (self.folder / f"log-{len(self.running)}-{host}.txt").open("wb")
        made = subprocess.Popen(words, stdout=log, stderr=subprocess.STDOUT, env={**self.environment, **variables},
                                cwd=self.folder, start_new_session=True)  # fmt: skip
        self.running.append(made)
        return made

    def scheduler(self) -> subprocess.Popen[bytes]:
        """Start dask's scheduler."""
        made = self.start("s", [sys.executable, "-m", "distributed.cli.dask_scheduler", "--protocol", "tls",
                                "--port", PORT, "--no-dashboard", "--no-show"])  # fmt: skip
        time.sleep(3)
        return made

    def worker(self, host: int, core: int | None = None, *options: object, **variables: str) -> subprocess.Popen[bytes]:
        """Start dask's worker on a host."""
        return self.start(host, [sys.executable, "-m", "distributed.cli.dask_worker", self.address(host), "--nthreads",
                                 1, "--no-dashboard", "--local-directory", self.folder / f"worker-{host}",
                                 "--name", f"host {host}", *options], core, **variables)  # fmt: skip

    def remove(self) -> None:
        """End all processes in the namespaces, and remove the namespaces."""
        for process in self.running:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, 9)
            process.wait()
        for name in ["s", *range(self.count)]:
            pids = subprocess.run(["ip", "netns", "pids", f"{PREFIX}-{name}"], capture_output=True, text=True)
            for pid in pids.stdout.split():
                with suppress(ProcessLookupError):
                    os.kill(int(pid), 9)
            subprocess.run(["ip", "netns", "del", f"{PREFIX}-{name}"], capture_output=True)


def _ip(*words: object) -> None:
    subprocess.run(["ip", *map(str, words)], check=True, capture_output=True)


@contextmanager
def hosts(count: int, folder: Path) -> Iterator[Hosts]:
    """Yield `count` hosts in addition to the scheduler's host."""
    made = Hosts(count, folder)
    try:
        made.make()
        yield made
    finally:
        made.remove()
