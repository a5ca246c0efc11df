"""Calls on the workers of a dask scheduler.

dask distributes the calls, repeats the calls of workers that end, and restarts workers. A call during which several
workers end is given up (`distributed.scheduler.allowed-failures`). So is a scheduler without workers
(`no-workers-timeout`). `worker.py` is the workers' side, and has the time limit of a call.

All messages pass through the scheduler, so no direct connection to a worker is needed.
"""

from __future__ import annotations

import contextlib
import logging
import pickle
from collections.abc import Callable, Iterator, Sequence
from time import monotonic
from typing import Any

from distributed import CancelledError, Client, KilledWorker, as_completed
from distributed.comm import CommClosedError
from distributed.scheduler import NoWorkerError

from reslrb_cli.cluster.connection import NOBODY_S
from reslrb_cli.cluster.worker import TOPIC, Answer, Context, Workload, perform
from reslrb_cli.errors import MachineError
from reslrb_cli.records.clock import SharedTime, WorkerTime

logger = logging.getLogger(__name__)


class Workers:
    """The workers of a client, as an `Engine` of `shards.py` and `sampling.py`. `where` names the workers' place.

    `context_of` returns the context of the calls for the state of this process. Raises MachineError if there are no
    workers, or if one cannot load the workload.
    """

    def __init__(
        self, client: Client, workload: Workload, where: str, context_of: Callable[[Any], Context] | None = None
    ) -> None:  # fmt: skip
        self._client, self._key, self._context_of = client, workload.key, context_of
        self._spent = SharedTime((where,))
        client.subscribe_topic(TOPIC, lambda event: logger.warning(f"--cluster: {event[1]}"))
        with self._explained():
            client.wait_for_workers(1, timeout=NOBODY_S)
            client.register_plugin(workload)
            loads = [()] * len(client.scheduler_info(n_workers=-1)["workers"])
            for _ in self._answers(_load, loads, b""):
                pass

    def __call__(
        self, state: Any, function: Callable[..., Any], work: Sequence[tuple[Any, ...]]
    ) -> Iterator[tuple[int, Any]]:
        """Yield the index and the value of each call as soon as the answer arrives.

        Raises the errors of calls. Raises MachineError if workers fail repeatedly, or if there are no workers.
        """
        begin, times = monotonic(), dict[str, WorkerTime]()
        context = b"" if self._context_of is None else pickle.dumps(self._context_of(state))
        with self._explained():
            for place, (value, worker, seconds) in self._answers(function, work, context):
                times[worker] = times.get(worker, WorkerTime()) + WorkerTime(1, seconds)
                yield place, value
        computing = [time.computing_s for time in times.values()]
        mean = sum(computing) / max(len(times), 1)
        waiting = max(computing, default=0.0) - mean
        self._spent += SharedTime(self._spent.places, monotonic() - begin, mean, waiting, times)

    def _answers(
        self, function: Callable[..., Any], work: Sequence[tuple[Any, ...]], context: bytes
    ) -> Iterator[tuple[int, Answer]]:
        places = {
            self._client.submit(perform, self._key, context, function, given, pure=False): place
            for place, given in enumerate(work)
        }
        for future in as_completed(places, loop=self._client.loop):
            yield places[future], future.result()
            future.release()

    @contextlib.contextmanager
    def _explained(self) -> Iterator[None]:
        """Raise failures of workers and of the scheduler as MachineError."""
        try:
            yield
        except KilledWorker as error:
            count, last = error.allowed_failures + 1, error.last_worker.address
            text = f"the same call ended {count} workers, the last one at {last}; see their warnings and memory limits"
            raise MachineError(f"--cluster: {text}") from None
        except (NoWorkerError, TimeoutError):
            raise MachineError(f"--cluster: no worker within {NOBODY_S} s") from None
        except MachineError as error:
            raise MachineError(f"--cluster: {error}") from None
        except Exception as error:
            if isinstance(error, CancelledError | CommClosedError) or self._client.status != "running":
                raise MachineError("--cluster: the scheduler has ended; --resume continues the run") from None
            raise

    def spent(self) -> SharedTime:
        """Return the times so far."""
        return self._spent


def _load(state: object) -> None:
    """Call that only lets a worker load the workload."""
