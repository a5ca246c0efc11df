"""Connections to workers for `--cluster`. The workers are processes of this machine that dask starts, or workers that
have joined an existing scheduler.

All connections use TLS. For `local:N`, dask makes certificates for this run. These certificates are never stored. For
`tls://HOST:PORT`, the certificates come from dask's settings `distributed.comm.tls`. The scheduler and the workers were
started with these certificates. Anyone who holds one of these certificates can run any code on the workers.
"""

from __future__ import annotations

import contextlib
import importlib.util
import logging
import os
import re
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from reslrb_cli.errors import ConfigError, MachineError, one_line
from reslrb_cli.records.atomic import unfinished

if TYPE_CHECKING:
    from distributed import Client

logger = logging.getLogger(__name__)

#: Maximum number of processes on one machine.
MOST_WORKERS = 1024
_ADDRESS = re.compile(r"tls://(\[[0-9A-Fa-f:.]+\]|[^\s:/\[\]]+):([0-9]{1,5})")

#: Seconds without any worker before the run ends.
NOBODY_S = 60

#: dask's settings. A call fails after 60 seconds without any worker. A connection is given up after 30 silent seconds.
#: Large arguments need no warning.
SETTINGS = {
    "distributed.scheduler.no-workers-timeout": NOBODY_S,
    "distributed.comm.timeouts.connect": "30s",
    "distributed.comm.timeouts.tcp": "30s",
    "distributed.admin.large-graph-warning-threshold": "1TB",
    # Nobody reads this history.
    "distributed.admin.log-length": 100,
    "distributed.admin.low-level-log-length": 100,
    "distributed.admin.system-monitor.log-length": 60,
    "distributed.admin.system-monitor.gil.enabled": False,
    "distributed.diagnostics.computations.max-history": 1,
    "distributed.worker.profile.enabled": False,
}
#: Local workers: they accept connections only from each other, no task is written to disk, and Ctrl-C, which reaches
#: all processes of a terminal, leaves them to the run, which stops after its iteration.
OWN_SETTINGS = {
    "distributed.scheduler.http.routes": [],
    "distributed.worker.http.routes": [],
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.preload": ["import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"],
}


@dataclass(frozen=True)
class Cluster:
    """A number of `workers` on this machine, or the scheduler at `address`."""

    workers: int = 0
    address: str | None = None

    @classmethod
    def parse(cls, text: str) -> Cluster:
        """Parse `local:N` or `tls://HOST:PORT`. Raises ConfigError if the text has another form, or if dask is not
        installed.
        """
        kind, _, count = text.partition(":")
        address = _ADDRESS.fullmatch(text)
        if address and 0 < int(address[2]) < 2**16:
            place = cls(address=text)
        elif kind == "local" and count.isdecimal() and 1 <= int(count[:9]) <= MOST_WORKERS:
            place = cls(int(count))
        else:
            what = "local:N, N processes on this machine, such as local:2, or tls://HOST:PORT, a dask scheduler"
            raise ConfigError("--cluster", "", f"must be {what}, not {one_line(text, 60)}")
        if any(importlib.util.find_spec(name) is None for name in ("distributed", "cryptography")):
            raise ConfigError("--cluster", "", "dask.distributed is not installed; run `pip install reslrb[cluster]`")
        return place

    @property
    def threads(self) -> int | None:
        """The share of the cores of each worker of this machine. None for other workers."""
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        return max(cores // self.workers, 1) if self.workers else None

    def check(self) -> None:
        """Raise ConfigError if certificates are missing, and MachineError if the scheduler does not answer."""
        if self.address is not None:
            with connected(self):
                pass


@contextlib.contextmanager
def connected(place: Cluster) -> Iterator[tuple[Client, Path]]:
    """Connect to the workers at a place. Yields a client, and a folder that is removed at the end.

    Raises MachineError if no worker can be started or the scheduler does not answer. Raises ConfigError without
    certificates.
    """
    import dask
    from distributed import Client

    for name in (
        "distributed",
        "tornado",
        "asyncio",
    ):  # we report these events in our own words, or they do not concern users
        logging.getLogger(name).setLevel(logging.CRITICAL)
    with contextlib.ExitStack() as stack:
        folder = Path(tempfile.mkdtemp(prefix="reslrb-cluster-"))
        unfinished.add(folder)  # a second signal ends the process at once
        stack.callback(unfinished.discard, folder)
        stack.callback(shutil.rmtree, folder, ignore_errors=True)
        stack.enter_context(dask.config.set({**SETTINGS, "temporary-directory": str(folder)}))
        if place.address is None:
            stack.enter_context(dask.config.set(OWN_SETTINGS))
            address, security = stack.enter_context(_started(place.workers, folder))
        else:
            address, security = place.address, _certificates()
        try:
            client = Client(
                address, security=security, direct_to_workers=False, set_as_default=False, timeout="30s",
                heartbeat_interval="2s",
            )  # fmt: skip
        except (OSError, RuntimeError, TimeoutError) as error:
            where, said = place.address or "this machine", one_line(str(error.__cause__ or error), 200)
            refused = f"the scheduler at {where} cannot be reached, or refuses this certificate: {said}"
            raise MachineError(f"--cluster: {refused}") from None
        stack.callback(_close, client)
        yield client, folder


@contextlib.contextmanager
def _started(workers: int, folder: Path) -> Iterator[tuple[object, object]]:
    """Start a scheduler in this process, and `workers` worker processes. Yields address and security."""
    from distributed import LocalCluster

    from reslrb_cli.backend.doctor import free_bytes

    try:
        cluster = LocalCluster(
            n_workers=workers, threads_per_worker=1, processes=True, security=True, protocol="tls://",
            dashboard_address="127.0.0.1:0", silence_logs=logging.CRITICAL,
            scheduler_kwargs={"dashboard": False, "extensions": _extensions()}, local_directory=str(folder),
            memory_limit=free_bytes("llvm") // workers,
        )  # fmt: skip
    except (OSError, RuntimeError, TimeoutError) as error:
        raise MachineError(f"--cluster: no workers could be started: {error}") from None
    try:
        yield cluster, cluster.security
    finally:
        with contextlib.suppress(OSError, RuntimeError, TimeoutError):
            cluster.close(timeout=10)


def _extensions() -> dict[str, Any]:
    """Return dask's extensions of a scheduler. The extension that would record every call is replaced by a version that
    records nothing.
    """
    from distributed.scheduler import DEFAULT_EXTENSIONS
    from distributed.spans import SpansSchedulerExtension

    class Forgetting(SpansSchedulerExtension):
        def observe_tasks(self, *_: object, **__: object) -> dict[Any, Any]:
            return {}

        def heartbeat(self, *_: object, **__: object) -> None:
            pass

    return {**DEFAULT_EXTENSIONS, "spans": Forgetting}


def _certificates() -> object:
    """Return the certificates of dask's settings. Raises ConfigError if a file is not named or does not exist."""
    from distributed import Security

    try:
        security = Security(require_encryption=True)
        files = {
            "ca-file": security.tls_ca_file,
            "client.cert": security.tls_client_cert,
            "client.key": security.tls_client_key,
        }
    except (TypeError, ValueError) as error:
        raise ConfigError("--cluster", "distributed.comm.tls", f"{error}") from None
    for name, file in files.items():
        variable = f"DASK_DISTRIBUTED__COMM__TLS__{name.upper().replace('-', '_').replace('.', '__')}"
        if not file:
            reason = f"is not set; give the file, for example by {variable}=FILE (docs/cluster.md)"
            raise ConfigError("--cluster", f"distributed.comm.tls.{name}", reason)
        if "\n" not in file and not os.access(file, os.R_OK):
            raise ConfigError("--cluster", f"distributed.comm.tls.{name}", f"{file} cannot be read")
    return security


def _close(client: Client) -> None:
    with contextlib.suppress(OSError, RuntimeError, TimeoutError):
        client.close(timeout=5)
