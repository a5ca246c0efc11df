"""Calls on the workers of a dask scheduler: available workers, answers, and failures.

dask distributes calls to workers that are ready, and repeats the calls of a worker that died. This module repeats calls
of slow workers. If a worker does not answer within three times the usual time, another worker is asked, and the first
answer counts. If a worker does not answer for much longer than usual, dask restarts the worker. `worker.py` is the
workers' side.

All messages pass through the scheduler, so no direct connection to a worker is needed.
"""

from __future__ import annotations

import logging
import queue
import statistics
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

from distributed import CancelledError, Client, Future, KilledWorker
from distributed.comm import CommClosedError

from reslrb_cli.cluster.worker import (
    Answer,
    Context,
    Fault,
    Lacks,
    Opening,
    Reply,
    open_state,
    perform,
    stand,
    whereabouts,
)
from reslrb_cli.errors import MachineError, OutOfMemory

logger = logging.getLogger(__name__)

T = TypeVar("T")

#: Silence of a worker before another one gets its task: a multiple of the duration of its calls, plus seconds.
LATE, LATE_S = 3.0, 0.2
#: Silence before dask restarts a worker: a multiple if there are other workers, a multiple if there are none, and
#: seconds; then the seconds that dask may take.
HUNG, HUNG_ALONE, HUNG_S, RESTART_S = 30.0, 10.0, 20.0, 20.0
#: Seconds for the first call of a worker, which compiles kernels. Once one worker has answered, the others may take a
#: multiple of its time plus seconds.
OPENING_S, OTHERS, OTHERS_S = 900.0, 2.0, 10.0
#: Seconds without any worker before the run ends, and seconds between two checks.
NOBODY_S, LOOK_S = 60.0, 1.0
#: Faults of workers' machines per call that are tolerated, and restarts of one worker for such faults.
FAULTS, RESTARTS = 3, 3
#: Seconds to wait for a value in each of several attempts.
GATHER_S = (5.0, 15.0, 60.0, 240.0)
#: Number of times that lost tasks are sent again in one round.
LOSSES = 100


@dataclass
class Spent:
    """Time that one worker, or all rounds of calls, have spent, in seconds.

    - `standing`: mean time that a round's workers need to set the context of calls.
    - `computing`: mean time that a round's workers compute.
    - `waiting`: mean time that a round's workers wait for the slowest worker.
    - `wall`: time from the first question to the last answer. The part of `wall` beyond the other three times is
        communication.

    `calls` is the number of answered calls. `again` is the number of repeated calls.
    """

    wall: float = 0.0
    computing: float = 0.0
    standing: float = 0.0
    waiting: float = 0.0
    calls: int = 0
    again: int = 0


@dataclass
class _Round:
    """The calls of a round.

    `left` maps the index of each unanswered call to the call's arguments. `flying` maps each future to the call's index
    and to the workers that may answer.
    """

    function: Callable[..., Any]
    context: Context
    left: dict[int, Sequence[Any]]
    flying: dict[Future, tuple[int, frozenset[str]]] = field(default_factory=dict)
    faults: Counter[int] = field(default_factory=Counter)
    cold: str | None = None
    losses: int = 0
    size: int = 0
    computing: dict[str, float] = field(default_factory=dict)
    standing: dict[str, float] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The name of a group of calls that take similar times."""
        return self.function.__name__ if self.cold is None else f"{self.function.__name__} {self.cold}"

    def answerable(self, workers: Mapping[str, Any]) -> set[int]:
        """Return the indices of the calls that at least one of `workers` may answer."""
        return {place for place, allowed in self.flying.values() if not allowed.isdisjoint(workers)}


class Crew:
    """The workers of a dask client that have loaded `opening`. `files` are sent to workers that lack them.

    `threads` is the thread count of each worker. If `threads` is None, each worker gets its share of its allowed cores.
    """

    def __init__(
        self, client: Client, opening: Opening, files: Mapping[str, bytes] | None = None, threads: int | None = None
    ) -> None:  # fmt: skip
        self.client, self.opening, self._files, self._threads = client, opening, files, threads
        self._done: queue.SimpleQueue[Future] = queue.SimpleQueue()
        self._opening: dict[str, tuple[Future, float]] = {}
        self._own_threads: dict[str, int] = {}
        #: Time at which each connected worker last answered or got a task; `_late` are the slow ones.
        self._heard: dict[str, float] = {}
        self._late: set[str] = set()
        self._left_out: dict[str, str] = {}  # with the reason
        self._anew: set[str] = set()  # workers that are being restarted
        self._restarts: Counter[str] = Counter()
        self._looked = -LOOK_S
        self._nobody_since: float | None = None
        self._seconds: dict[str, deque[float]] = {}  # seconds between two answers of a worker, by function
        self._names: dict[str, str] = {}
        self.spent, self.by_worker = Spent(), dict[str, Spent]()

    # --- workers
    # ----------------------------------------------------------------------------------------------------------

    @property
    def ready(self) -> list[str]:
        """The workers that get calls."""
        return [worker for worker in self._heard if worker not in self._late] or [*self._heard]

    def start(self) -> None:
        """Wait until the first worker is ready. Then wait a limited time for all other workers.

        Raises MachineError if no worker can be used, or if the scheduler has ended. If workers were left out, the
        message names the first of these workers, the worker's reason, and the number of these workers.
        """
        begin = time.monotonic()
        first_s: float | None = None
        while first_s is None or (self._opening and time.monotonic() - begin < OTHERS * first_s + OTHERS_S):
            self._look()
            if (future := self._next(LOOK_S / 4)) is not None:
                self._take_opened(future)
            if self._heard and first_s is None:
                first_s = time.monotonic() - begin

    def _next(self, seconds: float) -> Future | None:
        """Return the next finished future, or None if none finishes within `seconds`."""
        try:
            return self._done.get(timeout=seconds)
        except queue.Empty:
            return None

    def _look(self) -> None:
        """Update the list of workers; new workers load the opening. Raises MachineError if there are none."""
        now = time.monotonic()
        if now - self._looked < LOOK_S:
            return
        self._looked = now
        here = self._scheduler(lambda: self.client.scheduler_info(n_workers=-1))["workers"]
        known = {*self._heard, *self._opening, *self._left_out, *self._anew}
        for gone in known.difference(here):
            self._forget(gone)
            self._left_out.pop(gone, None)
            self._anew.discard(gone)
        new = [worker for worker in here if worker not in known]
        if new:
            self._open(new, here)
        for worker, (_, began) in [*self._opening.items()]:
            if now - began > OPENING_S:
                self._leave_out(worker, f"did not load the experiment within {OPENING_S:.0f} s")
        self._nobody_since = None if self._heard or self._opening else self._nobody_since or now
        wait_s = 0 if self._left_out and not self._restarts else NOBODY_S
        if self._nobody_since is not None and now - self._nobody_since > wait_s:
            raise MachineError(self._nobody())

    def _scheduler(self, call: Callable[[], T]) -> T:
        """Return the scheduler's answer. Raises MachineError if the scheduler has ended."""
        try:
            if self.client.status == "running" and self.client.scheduler is not None:
                return call()
        except (OSError, CancelledError, TimeoutError):
            pass
        raise MachineError("--cluster: the scheduler has ended; --resume continues the run")

    def _forget(self, worker: str) -> None:
        self._heard.pop(worker, None)
        self._late.discard(worker)
        if worker in self._opening:
            self._opening.pop(worker)[0].release()

    def _open(self, workers: Sequence[str], here: Mapping[str, Any]) -> None:
        """Make workers load the opening. Unless the crew sets a thread count, each worker uses its share of its allowed
        cores.
        """
        found: dict[str, tuple[str, tuple[int, ...]]] = {}
        if self._threads is None:
            found = self._scheduler(lambda: self.client.run(whereabouts, on_error="ignore", workers=[*here]))
        sharing = Counter(found.values())
        for worker in workers:
            cores = found.get(worker, ("", ()))
            self._own_threads[worker] = self._threads or max(len(cores[1]) // max(sharing[cores], 1), 1)
            self._names[worker] = f"worker {here[worker].get('name', worker)} ({here[worker].get('host', worker)})"
            self._ask_to_open(worker, None)

    def _ask_to_open(self, worker: str, files: Mapping[str, bytes] | None) -> None:
        future = self._send(worker, open_state, self.opening, files, self._own_threads[worker])
        self._opening[worker] = future, time.monotonic()

    def _send(self, worker: str, function: Callable[..., Reply], *arguments: Any) -> Future:
        future = self.client.submit(function, *arguments, pure=False, workers=[worker], priority=10)
        future.add_done_callback(self._done.put)
        return future

    def _nobody(self) -> str:
        if not self._left_out:
            return f"--cluster: no worker within {NOBODY_S:.0f} s"
        worker, reason = next(iter(self._left_out.items()))
        others = len(self._left_out) - 1
        more = f" (left out as well: {others} more)" if others else ""
        return f"--cluster: no worker can be used: {self._name(worker)} {reason}{more}"

    def _name(self, worker: str) -> str:
        return self._names.get(worker, "a worker")

    def _take_opened(self, future: Future) -> bool:
        """Record that a worker has loaded the opening, or why loading failed. Returns False if the future does not load
        an opening.
        """
        worker = next((worker for worker, (own, _) in self._opening.items() if own is future), None)
        if worker is None:
            return False
        del self._opening[worker]
        answer = _reply(future)
        if isinstance(answer, Lacks):
            self._ask_to_open(worker, self._files)
        elif isinstance(answer, Fault) and answer.stays:
            self._leave_out(worker, answer.text)
        elif isinstance(answer, Fault):
            self._start_anew(worker, answer.text)
        elif isinstance(answer, Answer):
            self._heard[worker] = time.monotonic()
            for name, seconds in answer.value.items():
                self._note(name, seconds)
        return True

    def _leave_out(self, worker: str, reason: str) -> None:
        self._forget(worker)
        self._left_out[worker] = reason
        logger.warning(f"--cluster: {self._name(worker)} {reason}; it is not used")

    def _start_anew(self, worker: str, reason: str) -> None:
        """Let dask restart a worker, which takes some time."""
        name = self._name(worker)
        self._restarts[name] += 1
        if self._restarts[name] > RESTARTS:
            self._leave_out(worker, f"{reason}, repeatedly")
            return
        logger.warning(f"--cluster: {name} {reason}; it is restarted")
        self._forget(worker)
        self._anew.add(worker)

        def start_anew() -> None:
            try:
                self.client.restart_workers([worker], timeout=RESTART_S, raise_for_error=False)
            except (ValueError, OSError, TimeoutError):
                if self.client.status == "running":  # otherwise the run has ended
                    self._left_out[worker] = f"{reason}, and nothing can restart it"
                    logger.warning(f"--cluster: nothing can restart {name}; it is not used")
            self._anew.discard(worker)

        threading.Thread(target=start_anew, daemon=True).start()

    # --- calls --------------------------------------------------------------------------------------------------------

    def run(
        self, function: Callable[..., Any], work: Sequence[Sequence[Any]], context: Context, cold: str | None = None
    ) -> Iterator[tuple[int, Any]]:
        """Yield the index and the value of each call as soon as the answer arrives. Raises the errors of calls.

        `cold` names functions whose kernels no worker has compiled. The first calls of these functions include
        compilation, so a slow first call does not count as hanging. Raises MachineError or OutOfMemory if workers fail
        repeatedly, or if there are no workers.
        """
        begin = time.monotonic()
        todo = _Round(function, context, dict(enumerate(work)), cold=cold, size=len(work))
        self._look()
        beside = [self._send(worker, stand, self.opening.digest, context) for worker in self._heard]
        for worker in self.ready:
            self._heard[worker] = begin
        try:
            while todo.left:
                self._submit(todo, [place for place in todo.left if place not in todo.answerable(self._heard)])
                future = self._next(min(max(self._limit(todo, LATE, LATE_S) / 4, 0.05), LOOK_S))
                if future is not None:
                    yield from self._take(todo, future, beside)
                if future is None or time.monotonic() - self._looked > LOOK_S:
                    self._look()
                    self._ask_again(todo)
        finally:
            for future in [*todo.flying, *beside]:
                future.release()
        workers = {*todo.computing, *todo.standing, *self._heard}
        both = [todo.computing.get(worker, 0.0) + todo.standing.get(worker, 0.0) for worker in workers]
        computing, standing = (sum(each.values()) / max(len(workers), 1) for each in (todo.computing, todo.standing))
        self.spent.wall += time.monotonic() - begin
        self.spent.computing += computing
        self.spent.standing += standing
        self.spent.waiting += max(both, default=0.0) - computing - standing

    def _submit(self, todo: _Round, places: Sequence[int]) -> None:
        """Submit calls to the workers that have loaded the opening, if there are any."""
        workers = self.ready
        for place in places if workers else ():
            future = self.client.submit(
                perform, self.opening.digest, todo.context.digest, todo.function, todo.left[place], pure=False,
                workers=workers,
            )  # fmt: skip
            todo.flying[future] = place, frozenset(workers)
            future.add_done_callback(self._done.put)

    def _take(self, todo: _Round, future: Future, beside: list[Future]) -> Iterator[tuple[int, Any]]:
        """Yield the value of the call that `future` holds, or nothing. A call without an answer is repeated."""
        if self._take_opened(future):
            return
        place = todo.flying.pop(future, (None, None))[0]
        answer = _reply(future)
        if answer is None:
            if place is not None:
                self._count_loss(todo)
            time.sleep(min(0.02 * todo.losses, 0.5))  # until the end of a worker is noticed
            return
        if isinstance(answer, Fault):
            self._take_fault(todo, answer, place)
            return
        now = time.monotonic()
        silent_s = 0.0
        if answer.worker in self._heard:
            silent_s = now - self._heard[answer.worker]
            self._heard[answer.worker] = now
            self._late.discard(answer.worker)
        if isinstance(answer, Lacks):
            self._count_loss(todo)
            if answer.what == "opening":  # a worker that was restarted at the same address
                self._forget(answer.worker)
                self._looked = -LOOK_S
            else:
                beside.append(self._send(answer.worker, stand, self.opening.digest, todo.context))
        elif isinstance(answer, Answer) and future in beside:
            todo.standing[answer.worker] = todo.standing.get(answer.worker, 0.0) + answer.seconds
            self.by_worker.setdefault(self._name(answer.worker), Spent()).standing += answer.seconds
        elif isinstance(answer, Answer) and place in todo.left:
            del todo.left[place]
            for other in [other for other, (its, _) in todo.flying.items() if its == place]:
                del todo.flying[other]  # another worker has the answer already
                other.release()
            self._note(todo.name, max(answer.seconds, silent_s))
            todo.computing[answer.worker] = todo.computing.get(answer.worker, 0.0) + answer.seconds
            of_worker = self.by_worker.setdefault(self._name(answer.worker), Spent())
            of_worker.computing += answer.seconds
            of_worker.calls += 1
            self.spent.calls += 1
            yield place, answer.value

    def _count_loss(self, todo: _Round) -> None:
        """Count a call without an answer. Raises MachineError if too many answers were lost."""
        todo.losses += 1
        if todo.losses > LOSSES + todo.size:
            left = len(todo.left)
            raise MachineError(f"--cluster: repeated {todo.losses} calls; calls without an answer: {left}")

    def _take_fault(self, todo: _Round, fault: Fault, place: int | None) -> None:
        """Ask other workers and restart this one. Raises MachineError or OutOfMemory if the same call has failed too
        often.
        """
        if place is not None:
            todo.faults[place] += 1
            if todo.faults[place] >= FAULTS:
                raise (OutOfMemory if fault.memory else MachineError)(f"--cluster: {fault.text}")
        if fault.worker in self._heard:
            self._start_anew(fault.worker, f"failed: {fault.text}")

    def _note(self, name: str, seconds: float) -> None:
        self._seconds.setdefault(name, deque(maxlen=64)).append(seconds)

    # --- silent workers
    # ---------------------------------------------------------------------------------------------------

    def _limit(self, todo: _Round, times: float, beside_s: float) -> float:
        """Return the time limit for a worker's answer, in seconds."""
        known = self._seconds.get(todo.name)
        return times * statistics.median(known) + beside_s if known else OPENING_S

    def _ask_again(self, todo: _Round) -> None:
        """Repeat calls of workers that have not answered for too long, and restart workers that hang."""
        now = time.monotonic()
        late_s = self._limit(todo, LATE, LATE_S)
        silent = [worker for worker, heard in self._heard.items() if now - heard > late_s]
        if not silent:
            return
        holding = self._scheduler(self.client.processing)
        places = {future.key: place for future, (place, _) in todo.flying.items() if place in todo.left}
        held = {worker: [key for key in holding.get(worker, ()) if key in places] for worker in silent}
        self._late |= {worker for worker in silent if held[worker]}
        late = {key for worker in self._late.intersection(silent) for key in held[worker]}
        others = {place for key, place in places.items() if key not in late}
        again = sorted({places[key] for key in late} - others)
        if again and not self._late.issuperset(self._heard):
            self.spent.again += len(again)
            for worker in self._late.intersection(silent):
                of_worker = self.by_worker.setdefault(self._name(worker), Spent())
                of_worker.again += len({places[key] for key in held[worker]}.intersection(again))
            self._submit(todo, again)
        alone = self._late.issuperset(self._heard)
        hung_s = self._limit(todo, HUNG_ALONE if alone else HUNG, HUNG_S)
        compiling = {worker for worker in silent if todo.cold is not None and worker not in todo.computing}
        limits = {worker: OPENING_S if worker in compiling else hung_s for worker in silent if worker in self._late}
        for worker in [worker for worker, limit in limits.items() if now - self._heard[worker] > limit]:
            self._start_anew(worker, f"did not answer for {now - self._heard[worker]:.0f} s")


def _reply(future: Future) -> Reply | None:
    """Return the answer, or None if the answer was lost with a worker. Raises the error of a call.

    If a worker ends before its answer arrives in this process, the answer is lost. Dask then computes the call again.
    """
    try:
        for seconds in GATHER_S:
            if future.status not in ("finished", "error"):
                return None
            try:
                found = future.result(timeout=seconds)
            except TimeoutError:
                continue
            assert isinstance(found, Reply)
            return found
        return None
    except KilledWorker as error:
        return Fault("", f"several workers ended during one shard, the last one at {error.last_worker.address}")
    except (CancelledError, CommClosedError):
        return None
    finally:
        future.release()
