"""Calls on the workers of a dask scheduler.

dask hands calls out to its workers, sends those again that a worker has died of, tries those again that fail, and
starts workers anew. Ours are the time limit, after which workers that do not answer are started anew,
and the pairing of results with calls. What a worker does: `worker.py`.

Everything goes by way of the scheduler: nobody needs a way to a worker.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

from distributed import CancelledError, Client, Future, KilledWorker, wait
from distributed.comm import CommClosedError

from reslrb_cli.cluster.worker import Answer, Context, Files, Lacks, Opening, keep_context, perform
from reslrb_cli.errors import MachineError, OutOfMemory
from reslrb_cli.records.clock import WorkerTime

logger = logging.getLogger(__name__)

#: Seconds without any answer after which workers are started anew: until there was one (kernels are compiled), and
#: then so many, and so many times as long as calls, and opening the experiment, have taken at most.
FIRST_S, SILENT_S, CALLS, OPENINGS = 900.0, 10.0, 10.0, 2.0
#: How often that is done for one round of calls, and the seconds that dask has for it.
RESTARTS, RESTART_S = 3, 20.0
#: Seconds for which nobody may be there, between looks, and for which a result may be on its way.
NOBODY_S, LOOK_S, RESULT_S = 60.0, 1.0, 60.0
#: How often dask tries a call again that has failed.
RETRIES = 3


class Workers:
    """The workers of a client; `files` are the files of `opening`.

    `wall`, `computing` and `waiting` are seconds of all rounds, as in `SharedTime`; `by_worker` has each worker's time.
    """

    def __init__(self, client: Client, opening: Opening, files: Mapping[str, bytes]) -> None:
        self.client, self._opening = client, opening
        self._longest, self._opening_s, self._sent = 0.0, 0.0, ""
        self._warm: set[str] = set()
        self.wall = self.computing = self.waiting = 0.0
        self.by_worker: dict[str, WorkerTime] = {}
        self._plugin = Files(opening.digest, files)
        try:
            client.wait_for_workers(1, timeout=NOBODY_S)
            client.register_plugin(self._plugin)
        except (TimeoutError, asyncio.TimeoutError):
            raise MachineError(f"--cluster: no worker was there for {NOBODY_S:.0f} s") from None

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, *_: object) -> None:
        """Have the scheduler forget the files."""
        with contextlib.suppress(Exception):  # it may have gone
            self.client.unregister_worker_plugin(self._plugin.name)

    def run(
        self, function: Callable[..., Any], work: Sequence[Sequence[Any]], context: Context | None = None
    ) -> Iterator[tuple[int, Any]]:
        """Yield place and value of each call, as they come.

        Raises what a call raised, and MachineError if workers fail again and again, or none is there.
        """
        begin = heard = time.monotonic()
        digest, seconds, restarts = "" if context is None else context.digest, dict[str, float](), 0

        def submit(place: int) -> Future:
            return self.client.submit(
                perform, self._opening, digest, function, work[place], pure=False, retries=RETRIES
            )

        here, sent = self._here(), list[Future]()
        if context is not None and digest != self._sent:  # later rounds of a step have the same
            sent, self._sent = self._send(context, here), digest
        flying = {submit(place): place for place in range(len(work))}
        try:
            while flying:
                answered, lacking, again = False, set[str](), list[int]()
                for future in self._done(flying):
                    place = flying.pop(future)
                    answer = self._result(future)
                    if isinstance(answer, Answer):
                        answered = True
                        self._note(function.__name__, answer, seconds)
                        yield place, answer.value
                        continue
                    if isinstance(answer, Lacks):
                        lacking.add(answer.worker)
                    again.append(place)
                sent += [] if context is None else self._send(context, lacking)
                flying |= {submit(place): place for place in again}
                now = time.monotonic()
                if answered:
                    heard, restarts = now, 0
                elif now - heard > self._limit(function.__name__):
                    restarts += 1
                    self._restart(flying, now - heard, restarts)
                    heard = time.monotonic()
        finally:
            for future in [*flying, *sent]:
                future.release()
        mean = sum(seconds.values()) / max(len(seconds), 1)
        self.wall += time.monotonic() - begin
        self.computing += mean
        self.waiting += max(seconds.values(), default=0.0) - mean

    def _here(self) -> list[str]:
        """Return the addresses of the workers. Raises MachineError if there is none for long."""
        begin = time.monotonic()
        while time.monotonic() - begin < NOBODY_S:
            with _scheduler(self.client):
                if found := list(self.client.scheduler_info(n_workers=-1)["workers"]):
                    return found
            time.sleep(LOOK_S)
        raise MachineError(f"--cluster: no worker was there for {NOBODY_S:.0f} s")

    def _send(self, context: Context, workers: Iterable[str]) -> list[Future]:
        """Send a context to workers, ahead of their calls."""
        options: dict[str, Any] = {"pure": False, "priority": 10}
        return [self.client.submit(keep_context, context, workers=[worker], **options) for worker in workers]

    def _done(self, flying: Mapping[Future, int]) -> list[Future]:
        """Return the futures that are done, after a while if there are none yet."""
        with _scheduler(self.client):
            wait([*flying], timeout=LOOK_S, return_when="FIRST_COMPLETED")
        return [future for future in flying if future.done()]

    def _result(self, future: Future) -> Answer | Lacks | None:
        """Return what came back; None if it was lost with a worker. Raises what the call did."""
        try:
            found = future.result(timeout=RESULT_S)
            assert isinstance(found, Answer | Lacks)
            return found
        except KilledWorker as error:
            last = error.last_worker.address
            raise MachineError(f"--cluster: worker after worker ended over one call, the last one {last}") from None
        except (MachineError, OutOfMemory) as error:
            raise type(error)(f"--cluster: {error}") from None
        except (CancelledError, CommClosedError, TimeoutError, asyncio.TimeoutError):
            _check(self.client)
            return None
        finally:
            future.release()

    def _note(self, name: str, answer: Answer, seconds: dict[str, float]) -> None:
        self._warm.add(name)
        self._longest, self._opening_s = max(self._longest, answer.seconds), max(self._opening_s, answer.opening_s)
        seconds[answer.worker] = seconds.get(answer.worker, 0.0) + answer.seconds
        one = WorkerTime(1, answer.seconds)
        self.by_worker[answer.name] = self.by_worker.get(answer.name, WorkerTime()) + one

    def _limit(self, name: str) -> float:
        """Return the seconds for which no answer may come."""
        if name not in self._warm:
            return FIRST_S
        return SILENT_S + CALLS * self._longest + OPENINGS * self._opening_s

    def _restart(self, flying: Mapping[Future, int], silent_s: float, restarts: int) -> None:
        """Have dask start those workers anew that have calls and do not answer. Raises MachineError if that is of no
        use."""
        if restarts > RESTARTS:
            raise MachineError(f"--cluster: {len(flying)} calls have no answer, whoever is asked")
        keys = {future.key for future in flying}
        self._here()
        with _scheduler(self.client):
            holding = self.client.processing()
            silent = [worker for worker, held in holding.items() if keys.intersection(held)]
            logger.warning(f"--cluster: no answer for {silent_s:.0f} s; starting anew: {', '.join(silent) or 'nobody'}")
            if silent:
                self.client.restart_workers(silent, timeout=RESTART_S, raise_for_error=False)


@contextlib.contextmanager
def _scheduler(client: Client) -> Iterator[None]:
    """Ask the scheduler; what fails on the way is left to be tried again. Raises MachineError if it has gone."""
    with contextlib.suppress(OSError, CancelledError, ValueError, TimeoutError, asyncio.TimeoutError):
        yield
    _check(client)


def _check(client: Client) -> None:
    if client.status != "running" or client.scheduler is None:
        raise MachineError("--cluster: the scheduler has gone; --resume goes on where the run was")
