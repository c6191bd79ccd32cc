"""A sweep: independent tasks whose results go into one file as they arrive; what is in the file is not run again.

Tasks run in worker processes: on this machine with joblib (loky), or on a Dask cluster. There Dask's own futures are
used: joblib's Dask backend leaves finished results on the workers, runs them again when such a worker dies, and waits
for ever for a task that Dask has given up.
"""

from __future__ import annotations

import json
import signal
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import CancelledError
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager
from dataclasses import dataclass
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any

from ppcbf_robots.errors import InputError
from ppcbf_robots.results_file import Record, ResultsFile, name_of

MAX_ATTEMPTS = 3  # to run a task whose worker dies; the last one runs alone, so that no other task can be the cause
CONNECT_SECONDS = 10.0


@dataclass(frozen=True)
class Task:
    """One piece of work.

    The function is sent to a worker process (cloudpickle) and returns what goes into the file as JSON.
    """

    key: dict[str, Any]  # JSON; identifies the task among all that ever go into the file
    function: Callable[[], dict[str, Any]]

    @property
    def name(self) -> str:
        """The key as text."""
        return name_of(self.key)


Outcome = dict[str, Any]  # {"result": ...} or {"error": one sentence}


def run_sweep(
    tasks: Sequence[Task],
    path: Path,
    jobs: int = 1,
    dask: str | None = None,
    on_record: Callable[[Record], None] = lambda record: None,
) -> list[Record]:
    """Run the tasks whose results are not in the file yet, and return the records of all, in the tasks' order.

    A task that raises, or whose worker dies every time, is recorded with an ``error`` and run again by the next sweep
    into the same file. An interrupt leaves a file that the next sweep goes on from.

    Args:
        tasks: with different keys.
        path: the file, one JSON object per line; made if it does not exist.
        jobs: tasks at once on this machine, each in a process of its own with one thread.
        dask: address of a Dask scheduler; its workers then run the tasks, and ``jobs`` counts for nothing.
        on_record: called with every record, first with those that are in the file already.

    Raises:
        InputError: if the file cannot be used, or the cluster does not answer.
    """
    by_name = {task.name: task for task in tasks}
    assert len(by_name) == len(tasks), "two tasks have the same key"
    with ResultsFile(path) as results:
        done = {name: results.finished[name] for name in by_name if name in results.finished}
        for record in done.values():
            on_record(record)
        todo = [task for name, task in by_name.items() if name not in done]
        if todo:
            with closing(_on_dask(todo, dask) if dask else _locally(todo, jobs)) as outcomes:
                for task, outcome in outcomes:
                    done[task.name] = results.append(task.key, outcome)
                    on_record(done[task.name])
    return [done[name] for name in by_name]


def _locally(tasks: Sequence[Task], jobs: int) -> Generator[tuple[Task, Outcome]]:
    """Outcomes in the order of completion; a dead worker breaks joblib's pool, and a new one takes what is left."""
    waiting = {task.name: task for task in tasks}
    attempts: Counter[str] = Counter()
    while waiting:
        last_try = [task for task in waiting.values() if attempts[task.name] == MAX_ATTEMPTS - 1]
        try:
            for name, outcome in _pool(last_try[:1] or list(waiting.values()), 1 if last_try else jobs, attempts):
                yield waiting.pop(name), outcome
        except BrokenProcessPool:
            for task in [t for t in waiting.values() if attempts[t.name] == MAX_ATTEMPTS]:
                yield waiting.pop(task.name), _died()


def _pool(tasks: Sequence[Task], jobs: int, attempts: Counter[str]) -> Iterator[tuple[str, Outcome]]:
    """Names and outcomes from a pool of worker processes; counts every task that it hands out."""
    from joblib import Parallel, delayed, parallel_config  # every command would start a fifth of a second later

    def hand_out() -> Iterator[Any]:
        for task in tasks:
            attempts[task.name] += 1
            yield delayed(_named_outcome)(task.name, task.function)

    # joblib runs everything in this process if n_jobs is 1, so pre_dispatch says how many tasks there are at once
    pool = {"n_jobs": max(jobs, 2), "pre_dispatch": jobs, "batch_size": 1, "return_as": "generator_unordered"}
    # a terminal's Ctrl-C reaches all processes, but this one ends its workers itself
    with parallel_config(backend="loky", inner_max_num_threads=1), _interrupts_blocked():
        outcomes = Parallel(**pool)(hand_out())
    yield from outcomes


@contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Ctrl-C waits until the end, and never comes to threads and processes that are started here."""
    resource_tracker.ensure_running()  # its first start unblocks them
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def _on_dask(tasks: Sequence[Task], address: str) -> Generator[tuple[Task, Outcome]]:
    """Outcomes in the order of completion; Dask itself gives the task of a dead worker to another one."""
    try:
        from distributed import Client, KilledWorker, as_completed  # only where it is asked for
    except ModuleNotFoundError as error:
        if error.name != "distributed":
            raise
        raise InputError('a Dask cluster needs the distributed package: pip install "ppcbf-robots[dask]"') from None
    try:
        client = Client(address, timeout=CONNECT_SECONDS, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(f"no Dask scheduler answers at '{address}' ({_sentence(error)})") from None
    gone = InputError(f"the Dask scheduler at '{address}' is gone; the results so far are kept")
    try:
        with client:
            waiting = {client.submit(_outcome, task.function, pure=False): task for task in tasks}
            for future in as_completed(list(waiting), loop=client.loop):
                try:
                    outcome = future.result()
                except KilledWorker:
                    outcome = _died()
                except CancelledError:
                    raise gone from None
                task = waiting.pop(future)
                future.release()  # else Dask runs the task again if the worker that holds its result dies
                yield task, outcome
    except (AssertionError, OSError):  # what a client that lost its scheduler in the wrong moment ends with
        if client.status == "running":
            raise
        raise gone from None


def _named_outcome(name: str, function: Callable[[], dict[str, Any]]) -> tuple[str, Outcome]:
    return name, _outcome(function)


def _outcome(function: Callable[[], dict[str, Any]]) -> Outcome:
    """What a worker sends back: plain JSON in any case."""
    try:
        result = function()
        json.dumps(result, allow_nan=False)
    except Exception as error:
        return {"error": _sentence(error)}
    return {"result": result}


def _sentence(error: Exception) -> str:
    """An exception in one line; the errors of this package are sentences already."""
    text = (str(error).strip().splitlines() or [""])[0]
    return text if isinstance(error, InputError) else f"{type(error).__name__}: {text}".removesuffix(": ")


def _died() -> Outcome:
    return {"error": "the worker process died every time; perhaps the machine has too little memory"}
