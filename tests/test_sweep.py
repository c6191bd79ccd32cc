"""The sweep engine on this machine and on a Dask cluster: what runs, what does not run again, what the file holds.

Task functions are made inside other functions: cloudpickle sends them as they are, and workers need not import tests.
"""

from __future__ import annotations

import json
import logging
import os
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from ppcbf_robots.errors import InputError
from ppcbf_robots.results_file import ResultsFile
from ppcbf_robots.sweep import MAX_ATTEMPTS, Task, run_sweep


class Work:
    """Tasks that leave a mark in a folder each time they begin."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.file = folder / "results.jsonl"

    def task(self, i: int, then: Callable[[int], Any] = lambda begun: None, seconds: float = 0.0) -> Task:
        """Task i: after its mark it calls ``then`` with how often it has begun, and returns the double of i."""
        folder = self.folder

        def run() -> dict[str, Any]:
            import os
            import time

            with (folder / f"{i}.begun").open("a") as file:
                file.write(f"{os.getpid()}\n")
            then(len((folder / f"{i}.begun").read_text().splitlines()))
            time.sleep(seconds)
            return {"double": 2 * i}

        return Task({"i": i}, run)

    def begun(self, i: int) -> list[int]:
        """Processes in which task i has begun."""
        path = self.folder / f"{i}.begun"
        return [int(pid) for pid in path.read_text().splitlines()] if path.exists() else []

    def lines(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in self.file.read_text().splitlines()]


@pytest.fixture
def work(tmp_path: Path) -> Work:
    return Work(tmp_path)


@pytest.fixture(scope="module")
def scheduler() -> Iterator[str]:
    """Address of a Dask cluster of two worker processes."""
    from distributed import LocalCluster

    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # the tests kill its workers
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        yield cluster.scheduler_address


@pytest.fixture(params=["loky", "dask"])
def where(request: pytest.FixtureRequest) -> dict[str, Any]:
    """Arguments that run the same tasks in two processes here, or on the cluster."""
    return {"dask": request.getfixturevalue("scheduler")} if request.param == "dask" else {"jobs": 2}


def die(begun: int) -> None:
    import os

    os.kill(os.getpid(), 9)


def die_once(begun: int) -> None:
    import os

    if begun == 1:
        os.kill(os.getpid(), 9)


def fail(begun: int) -> None:
    raise ValueError("no luck\nand a second line")


for function in (die, die_once, fail):
    function.__module__ = "__main__"  # sent as it is, see above


def test_results_come_back_in_order_and_are_in_the_file(work, where):
    seen = []
    records = run_sweep([work.task(i) for i in range(5)], work.file, on_record=seen.append, **where)
    assert records == [{"key": {"i": i}, "result": {"double": 2 * i}} for i in range(5)]
    assert sorted(seen, key=lambda r: r["key"]["i"]) == records
    assert seen == work.lines()
    assert all(pids != [os.getpid()] for pids in map(work.begun, range(5)))


def test_the_next_sweep_runs_only_what_is_new(work, where):
    run_sweep([work.task(i) for i in range(2)], work.file, **where)
    records = run_sweep([work.task(i) for i in range(4)], work.file, **where)
    assert [r["result"]["double"] for r in records] == [0, 2, 4, 6]
    assert [len(work.begun(i)) for i in range(4)] == [1, 1, 1, 1]
    assert len(work.lines()) == 4


def test_a_killed_worker_costs_only_what_it_was_doing(work, where):
    """Task 2 kills its worker after the first two have long been done."""
    tasks = [work.task(0), work.task(1), work.task(2, die_once), work.task(3), work.task(4)]
    run_sweep(tasks[:2], work.file, **where)
    records = run_sweep(tasks, work.file, **where)
    assert [r["result"]["double"] for r in records] == [0, 2, 4, 6, 8]
    assert [len(work.begun(i)) for i in range(3)] == [1, 1, 2]
    assert len(work.lines()) == 5


def test_a_worker_killed_late_does_not_bring_finished_tasks_back(work, where):
    """Within one sweep: 0 to 3 are finished, and their results handed over, when 4 kills its worker."""
    folder = work.folder

    def die_when_others_are_done(begun: int) -> None:
        import os
        import time

        while begun == 1 and len((folder / "results.jsonl").read_text().splitlines()) < 4:
            time.sleep(0.02)
        if begun == 1:
            os.kill(os.getpid(), 9)

    tasks = [*(work.task(i, seconds=0.05) for i in range(4)), work.task(4, die_when_others_are_done)]
    records = run_sweep(tasks, work.file, **where)  # both workers have finished some of 0 to 3, whichever dies
    assert [r["result"]["double"] for r in records] == [0, 2, 4, 6, 8]
    assert [len(work.begun(i)) for i in range(5)] == [1, 1, 1, 1, 2]


def test_a_task_that_always_kills_its_worker_is_given_up(work, where):
    """The others are not blamed, although they have shared its fate."""
    records = run_sweep([work.task(0, die), work.task(1, seconds=0.3), work.task(2)], work.file, **where)
    assert "worker process died every time" in records[0]["error"]
    assert [r["result"]["double"] for r in records[1:]] == [2, 4]
    assert len(work.begun(0)) == (MAX_ATTEMPTS if "jobs" in where else 4)  # 4: Dask's own setting


def test_a_task_that_raises_is_recorded_and_run_again_next_time(work, where):
    records = run_sweep([work.task(0, fail), work.task(1)], work.file, **where)
    assert records[0] == {"key": {"i": 0}, "error": "ValueError: no luck"}
    assert records[1]["result"] == {"double": 2}
    again = run_sweep([work.task(0), work.task(1)], work.file, **where)
    assert [r["result"]["double"] for r in again] == [0, 2]
    assert [len(work.begun(i)) for i in range(2)] == [2, 1]


def test_a_result_that_is_no_json_is_an_error_of_its_task(work):
    def run() -> dict[str, Any]:
        return {"x": float("nan")}

    [record] = run_sweep([Task({"i": 0}, run)], work.file)
    assert record["error"].startswith("ValueError: Out of range float")


def test_one_job_is_one_process_with_one_thread_and_one_task_at_once(work, monkeypatch):
    monkeypatch.setattr(
        "joblib._parallel_backends.cpu_count", lambda: 8
    )  # so that joblib would give a worker 4 threads
    folder = work.folder

    def alone(begun: int) -> None:
        import os
        import time

        lock = os.open(folder / "lock", os.O_CREAT | os.O_EXCL)  # raises if another task is at work
        time.sleep(0.05)
        os.close(lock)
        (folder / "lock").unlink()
        assert os.environ["OMP_NUM_THREADS"] == os.environ["NUMBA_NUM_THREADS"] == "1"

    records = run_sweep([work.task(i, alone) for i in range(4)], work.file, jobs=1)
    assert all("result" in r for r in records), records
    assert os.getpid() not in work.begun(0)


def test_an_interrupt_does_not_reach_a_worker(work):
    def run() -> dict[str, Any]:
        import signal

        return {"blocked": signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, [])}

    assert run() == {"blocked": False}
    [record] = run_sweep([Task({"i": 0}, run)], work.file)
    assert record["result"] == {"blocked": True}
    assert run() == {"blocked": False}


def test_a_half_written_last_line_is_run_again(work):
    run_sweep([work.task(i) for i in range(3)], work.file)
    work.file.write_bytes(work.file.read_bytes()[:-9])
    records = run_sweep([work.task(i) for i in range(3)], work.file)
    assert sorted(len(work.begun(i)) for i in range(3)) == [1, 1, 2]
    assert [r["result"]["double"] for r in records] == [0, 2, 4]
    assert len(work.lines()) == 3


@pytest.mark.parametrize("line", ["nonsense", "[]", '{"key": 1}', '{"result": {}}', "3"])
def test_a_file_that_is_something_else_is_left_alone(work, line):
    work.file.write_text(f'{line}\n{{"key"')
    with pytest.raises(InputError, match=r"results.jsonl: line 1 is no result of a sweep; give another folder"):
        run_sweep([work.task(0)], work.file)
    assert work.file.read_text() == f'{line}\n{{"key"'


def test_two_sweeps_do_not_write_the_same_file(work):
    with ResultsFile(work.file), pytest.raises(InputError, match="another sweep is writing it"):
        run_sweep([work.task(0)], work.file)
    assert not work.begun(0)
    assert run_sweep([work.task(0)], work.file)


def test_a_file_that_cannot_be_written(work):
    work.file.mkdir()
    with pytest.raises(InputError, match=r"results.jsonl: cannot be written \(Is a directory\)"):
        run_sweep([work.task(0)], work.file)


def test_a_cluster_that_does_not_answer(work, monkeypatch):
    monkeypatch.setattr("ppcbf_robots.sweep.CONNECT_SECONDS", 0.2)
    for address in ("tcp://127.0.0.1:9", "nonsense"):
        with pytest.raises(InputError, match=f"no Dask scheduler answers at '{address}'"):
            run_sweep([work.task(0)], work.file, dask=address)


def test_a_cluster_that_goes_away(work):
    from distributed import LocalCluster

    cluster = LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None)
    address = cluster.scheduler_address
    with pytest.raises(InputError, match=f"the Dask scheduler at '{address}' is gone"):
        run_sweep(
            [work.task(0), work.task(1, seconds=30)], work.file, dask=address, on_record=lambda _: cluster.close()
        )
    assert len(work.lines()) == 1


def test_dask_is_asked_for_by_name(work, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r'pip install "ppcbf-robots\[dask\]"'):
        run_sweep([work.task(0)], work.file, dask="tcp://127.0.0.1:9")


def test_ctrl_c_ends_the_workers_and_keeps_what_is_done(work):
    """As a terminal does it: SIGINT to the whole process group, workers included."""
    script = textwrap.dedent("""
        import sys, time
        from pathlib import Path
        from ppcbf_robots.sweep import Task, run_sweep

        def run(i):
            def task():
                Path(f"{i}.begun").open("a").write("x")
                time.sleep(0 if i == 0 else 60)
                return {}
            return Task({"i": i}, task)

        try:
            run_sweep([run(i) for i in range(3)], Path("results.jsonl"), jobs=2)
        except KeyboardInterrupt:
            print("interrupted")
    """)
    process = subprocess.Popen(
        [sys.executable, "-c", script], cwd=work.folder, text=True, start_new_session=True, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )  # fmt: skip
    deadline = time.monotonic() + 30.0
    while not (work.folder / "2.begun").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGINT)
    stdout, stderr = process.communicate(timeout=20)
    assert stdout == "interrupted\n"
    assert "Traceback" not in stderr  # on a busy machine loky may warn of a semaphore that it cleans up itself
    assert [line["key"]["i"] for line in work.lines()] == [0]
    deadline = time.monotonic() + 10.0
    with pytest.raises(ProcessLookupError):
        while time.monotonic() < deadline:
            os.killpg(process.pid, 0)  # is anybody of the group left?
            time.sleep(0.05)
