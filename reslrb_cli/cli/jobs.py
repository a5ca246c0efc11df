"""Processes of `reslrb` that run at the same time, each with its share of the cores and its GPU.

Each run is `reslrb optimize` in its own process, so runs do not share memory, kernels or failures. If the sweep is
killed, `follow` ends its runs, so the sweep can be continued at once.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field

import click

from reslrb_cli.backend.doctor import ask_gpu, free_bytes
from reslrb_cli.backend.installation import python_command
from reslrb_cli.cli.terminal import Interrupts
from reslrb_cli.errors import ExitCode
from reslrb_cli.measure.processes import Child, last_words
from reslrb_cli.report.format import shorten

#: Maximum wait, in seconds, for the end of runs that must end at once.
END_SECONDS = 5.0

_POLL_SECONDS = 0.1

#: Number of last bytes of a run's output in which its error is searched; start of a line of progress.
MOST_BYTES, _PROGRESS = 1 << 14, re.compile(r"\d+/\d+: ")

#: The program, in a process that ends with this one.
_PROGRAM = "sys.argv[0] = 'reslrb'; from reslrb_cli.cli.jobs import follow; follow()"

#: Environment variable with the GPUs that a process may use.
GPUS = "CUDA_VISIBLE_DEVICES"

#: Exit code and last line of a run.
End = tuple[int, str]


@dataclass
class RunSlot:
    """Place for one run at a time: the cores and the GPU of its process. If empty, the process may use all.

    `line` is the last progress of the current run, and `show` is called when it may have changed. `peak` and `resident`
    are the largest and the current memory of the current run in bytes, or 0 if unknown. `must_end` asks the run to end.
    """

    cores: set[int] = field(default_factory=set)
    gpu: str = ""
    process: subprocess.Popen[bytes] | None = None
    line: str = ""
    peak: int = 0
    resident: int = 0
    must_end: bool = False
    show: Callable[[], None] = lambda: None


class Jobs:
    """Runs at the same time, at most one for each core and, under CUDA, one for each GPU.

    The first run begins alone, and the others after its first line of progress: they then find compiled kernels and
    automatic settings in the caches. A run begins only if the free memory is larger than the memory that the largest
    run has needed so far. At the end of the context, all runs are interrupted and have ended.
    """

    def __init__(self, number: int, variant: str) -> None:
        cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
        gpus = visible_gpus() if number > 1 and variant.startswith("cuda") else []
        self.number = min(number, len(cores) or os.cpu_count() or 1, len(gpus) or number)
        self.slots = [RunSlot(show=self.show) for _ in range(self.number)]
        if self.number > 1:
            for n, slot in enumerate(self.slots):
                first, end = (place * len(cores) // self.number for place in (n, n + 1))
                slot.cores, slot.gpu = set(cores[first:end]), gpus[n] if gpus else ""
        self._free = list(self.slots)
        self._ended: dict[Future[End], tuple[str, RunSlot]] = {}
        self._pool = ThreadPoolExecutor(self.number)
        self._has_begun, self._peak = False, 0

    def __enter__(self) -> Jobs:
        return self

    def __exit__(self, *_: object) -> None:
        for slot in self.slots:
            slot.must_end = True
        self._pool.shutdown()

    @property
    def busy(self) -> bool:
        """Whether a run is at work, or has ended and was not returned yet."""
        return bool(self._ended)

    def may_start(self) -> bool:
        """Whether another run may start now."""
        at_work = [slot for _, slot in self._ended.values()]
        self._peak = max([self._peak, *(slot.peak for slot in at_work)])
        if not self._free or not at_work:
            return not at_work
        self._has_begun = self._has_begun or any(slot.line for slot in at_work)
        coming = sum(self._peak - slot.resident for slot in at_work)
        return self._has_begun and free_bytes("llvm") >= coming + self._peak

    def start(self, name: str, call: Callable[[RunSlot], End]) -> None:
        """Start the run `name` by `call`, which returns at its end. A single slot runs in the calling thread."""
        slot, future = self._free.pop(), Future[End]()
        if self.number > 1:
            future = self._pool.submit(_bound, slot, call)
        else:
            future.set_result(call(slot))
        self._ended[future] = (name, slot)

    def ended(self) -> Iterator[tuple[str, End]]:
        """Wait a moment for runs to end, and yield their names and ends."""
        for future in wait(self._ended, _POLL_SECONDS, FIRST_COMPLETED).done:
            name, slot = self._ended.pop(future)
            self._has_begun, slot.line, slot.resident = True, "", 0
            self._free.append(slot)
            yield name, future.result()

    def show(self) -> None:
        """Show the progress of all runs in place of the terminal's last line. Without a terminal, show nothing."""
        if sys.stderr.isatty():
            line = "; ".join(slot.line for slot in self.slots if slot.line)
            text = shorten(f"  {line}" if line else "", shutil.get_terminal_size().columns - 1)
            click.echo(f"\r\x1b[K{text}", err=True, nl=False)

    def end(self) -> None:
        """End all runs at once with two signals. The manifests of the runs then record the end."""
        processes = [slot.process for slot in self.slots if slot.process is not None]
        latest = time.monotonic() + END_SECONDS
        for number in (signal.SIGTERM, signal.SIGINT):  # the same signal would count once
            for process in processes:
                with contextlib.suppress(OSError):
                    process.send_signal(number)
        for process in processes:
            with contextlib.suppress(OSError, subprocess.TimeoutExpired):
                process.wait(max(latest - time.monotonic(), 0))
            with contextlib.suppress(OSError):
                process.kill()


def visible_gpus() -> list[str]:
    """Return the GPUs that this process may use, in the form of CUDA_VISIBLE_DEVICES."""
    given = os.environ.get(GPUS)
    return ask_gpu("uuid") if given is None else [each.strip() for each in given.split(",") if each.strip()]


def _bound(slot: RunSlot, call: Callable[[RunSlot], End]) -> End:
    """Call `call(slot)` in a thread that has the cores of `slot`. Its processes inherit these cores."""
    if slot.cores:
        os.sched_setaffinity(0, slot.cores)
    return call(slot)


def call(arguments: Sequence[str], interrupts: Interrupts, slot: RunSlot, fresh: bool = False) -> End:
    """Run `reslrb` with these arguments in its own process. Returns its exit code and its last line.

    The first signal in `interrupts` is passed on to the process. The run folder contains the warnings of the process. A
    `fresh` process has no cached kernels or decisions. Runs with equal time limits therefore start under equal
    conditions.
    """
    child = Child(
        [*python_command(_PROGRAM), *arguments], {GPUS: slot.gpu} if slot.gpu else {}, fresh,
        stdin=subprocess.PIPE,  # closes when this process ends
    )  # fmt: skip
    process = slot.process = child.process
    told, code = False, None
    try:
        while code is None:
            if (interrupts.requested or slot.must_end) and not told:
                process.terminate()
                told = True
            with contextlib.suppress(subprocess.TimeoutExpired):
                code = process.wait(_POLL_SECONDS)
            slot.line = next(filter(_PROGRESS.match, reversed(_last_lines(child))), "")
            slot.resident, slot.peak = child.memory("VmRSS"), child.memory("VmHWM")
            slot.show()
        said = _last_lines(child)
    finally:
        slot.process, slot.line = None, ""
        slot.show()
        child.close()
    if code < 0:
        name = signal.Signals(-code).name
        memory = " (often sent when memory runs out)" if -code == signal.SIGKILL else ""
        return (ExitCode.INTERRUPTED if told else code), f"ended by {name}{memory}: {last_words(chr(10).join(said))}"
    return code, said[-1] if said else f"ended with exit code {code}, without a message"


def _last_lines(child: Child) -> list[str]:
    """Return the last lines of a run's output."""
    return [line for line in child.tail(MOST_BYTES).splitlines() if line.strip()]


def follow() -> None:
    """Run the program `reslrb` in a process that ends when its standard input closes. The end of the sweep closes this
    input, even if the sweep is killed.
    """

    def end_with_input() -> None:
        os.read(0, 1)
        os._exit(ExitCode.INTERRUPTED)

    threading.Thread(target=end_with_input, daemon=True).start()
    from reslrb_cli.cli import run

    run()
