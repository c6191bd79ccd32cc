"""``ppcbf sweep`` and ``ppcbf study``: from the command line to files and figures, and the numbers in between."""

from __future__ import annotations

import csv
import dataclasses
import json
import logging
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from ppcbf_robots.artefact import load_barrier
from ppcbf_robots.cli import tasks
from ppcbf_robots.cli.main import main
from ppcbf_robots.errors import InputError
from ppcbf_robots.learning.presets import PRESETS
from ppcbf_robots.problem import load_problem
from ppcbf_robots.studies.convergence import TABLE_1, convergence_rows
from ppcbf_robots.studies.tables import write_table
from ppcbf_robots.studies.training import Training
from ppcbf_robots.studies.variability import curve, overlaps, variability_rows

SMALL = ["--iterations", "8"]
FEW: dict[str, Any] = {"rays": 500, "samples": 100, "top": 20, "hidden": (16, 16), "test_samples": 200,
                       "refinements": 1, "search_rounds": 1, "attack_rounds": 2, "judge_first": False}  # fmt: skip
BALL = "{name: b, type: sphere, center: [0.6, 0, 0.6], radius: 0.2}"


class Done(NamedTuple):
    """What a command left behind."""

    code: int
    stdout: str
    stderr: str


Cli = Callable[..., Done]


@pytest.fixture
def cli(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Cli:
    """``cli(*arguments)`` runs ``ppcbf`` in a folder of its own, with presets that train on few states."""
    monkeypatch.chdir(tmp_path)
    for name, preset in PRESETS.items():
        monkeypatch.setitem(PRESETS, name, dataclasses.replace(preset, **FEW))

    def run(*arguments: object) -> Done:
        monkeypatch.setattr(sys, "argv", ["ppcbf", *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            main()
        return Done(int(end.value.code or 0), *capsys.readouterr())

    return run


def lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def is_picture(path: Path) -> bool:
    """A PNG with something on it."""
    import matplotlib.image

    return float(np.ptp(matplotlib.image.imread(path))) > 0.5


# Sweep


def test_a_sweep_trains_every_robot_in_every_world_with_every_seed_and_goes_on(cli, tmp_path):
    first = ["sweep", "--robots", "two_link,cartpole", "--worlds", "circle", *SMALL, "--out", "runs"]
    done = cli(*first, "--seeds", "0", "--jobs", 2, "--json")
    rows = json.loads(done.stdout)["rows"]
    assert [(r["robot"], r["world"], r["seed"]) for r in rows] == [("two_link", "circle", 0), ("cartpole", "circle", 0)]
    assert done.code == (0 if all(r["converged"] for r in rows) else 3)
    records = lines(tmp_path / "runs" / "results.jsonl")
    assert len(records) == 2
    assert all(len(r["result"]["history"]) > 0 for r in records)
    for row in rows:
        training = load_barrier(Path(row["out"])).data["training"]
        assert (training["seed"], training["preset"], training["iterations"]) == (row["seed"], "default", 8)
        assert training["volume_kept"] == round(row["volume_kept"], 5)
    written = (tmp_path / "runs" / "two_link_circle_0" / "barrier.json").stat().st_mtime_ns
    again = cli(*first, "--seeds", "0-1")
    assert again.code in (0, 3)
    assert lines(tmp_path / "runs" / "results.jsonl")[:2] == records
    assert len(lines(tmp_path / "runs" / "results.jsonl")) == 4
    assert (tmp_path / "runs" / "two_link_circle_0" / "barrier.json").stat().st_mtime_ns == written
    assert "4 trainings" in again.stdout and "4/4" in again.stderr


def test_a_sweeps_barrier_has_the_gamma_that_it_was_trained_with(tmp_path):
    """The preset's, where the robot spec gives none: that of `ppcbf train`."""
    preset = dataclasses.replace(PRESETS["default"], **FEW, iterations=4)
    Training("double_pendulum", "circle", "default", preset, 0, 60.0, tmp_path / "b").run()
    stored = load_barrier(tmp_path / "b")
    assert stored.spec.gamma == preset.gamma != load_problem("double_pendulum", "circle").robot.spec.barrier.gamma
    assert stored.data["training"]["settings"]["iterations"] == 4


def test_other_settings_are_other_tasks(cli, tmp_path):
    """A result is only taken for the very training it came from: of the same robot, world and settings."""
    (tmp_path / "ball.yaml").write_text(f"obstacles: [{BALL}]\n")
    command = ["sweep", "--robots", "two_link", "--worlds", "ball.yaml", "--out", "runs"]
    cli(*command, "--iterations", 4)
    cli(*command, "--iterations", 5)
    cli(*command, "--iterations", 5)
    assert len(lines(tmp_path / "runs" / "results.jsonl")) == 2
    (tmp_path / "ball.yaml").write_text(f"obstacles: [{BALL.replace('0.2', '0.1')}]\n")
    cli(*command, "--iterations", 5)
    assert len(lines(tmp_path / "runs" / "results.jsonl")) == 3


def test_a_barrier_of_other_settings_is_not_taken_for_that_of_a_result(cli, tmp_path):
    """The folder holds the last training that went there."""
    command = ["sweep", "--robots", "two_link", "--worlds", "circle", "--out", "runs"]
    for iterations in (4, 5):
        cli(*command, "--iterations", iterations)
    again = cli(*command, "--iterations", 4)
    assert again.code == 2
    assert "two_link_circle_0: holds the barrier of another training than the results say; give" in again.stderr
    assert cli(*command, "--iterations", 5).code in (0, 3)


def test_a_task_knows_where_the_gamma_comes_from(two_link):
    """A gamma that is given is kept, the same one by default gives way to the preset's."""
    spec = type(two_link.robot.spec.barrier)
    silent, given = (two_link.with_barrier_spec(x) for x in (spec(), spec(gamma=5.0)))
    training = Training("r", "w", "default", PRESETS["default"], 0, 60.0)
    assert training.task(silent).name != training.task(given).name


def test_a_training_that_cannot_be_done_does_not_end_the_sweep(cli, tmp_path):
    ball = "{name: b, type: sphere, center: [5, 0, 5], radius: 7.07}"
    (tmp_path / "everywhere.yaml").write_text(f"obstacles: [{ball}]\n")
    done = cli("sweep", "--robots", "two_link", "--worlds", "everywhere.yaml,circle", *SMALL, "--out", "runs")
    assert done.code == 3
    assert "of 2 trainings failed or did not converge" in done.stderr
    errors = [r["error"] for r in lines(tmp_path / "runs" / "results.jsonl") if "error" in r]
    assert len(errors) == 1
    assert errors[0].startswith("almost every configuration of the domain X is in collision")
    study = cli("study", "convergence", "two_link", "everywhere.yaml", "--runs", 1, "--rates", "1e-3", "--out", "study")
    assert study.code == 3
    assert "error: every run ended with an error; the first: almost every configuration" in study.stderr


def test_the_same_task_gives_the_same_on_dask(cli, tmp_path):
    from distributed import LocalCluster

    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    command = ["sweep", "--robots", "two_link", "--worlds", "circle", *SMALL, "--json"]
    [here] = json.loads(cli(*command, "--out", "here").stdout)["rows"]
    with LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as cluster:
        [there] = json.loads(cli(*command, "--out", "there", "--dask", cluster.scheduler_address).stdout)["rows"]
    same = ("converged", "volume_kept", "violations", "samples", "reason")
    assert {k: here[k] for k in same} == {k: there[k] for k in same}
    assert (tmp_path / "there" / "two_link_circle_0" / "barrier.json").is_file()


def test_ctrl_c_says_how_to_go_on(tmp_path):
    command = ["sweep", "--robots", "two_link", "--worlds", "circle", "--seeds", "0-9", "--out", "runs"]
    process = subprocess.Popen(
        [sys.executable, "-m", "ppcbf_robots.cli.main", *command], cwd=tmp_path, text=True, start_new_session=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip
    deadline = time.monotonic() + 60.0
    while not (tmp_path / "runs" / "results.jsonl").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    time.sleep(0.5)  # the first training has begun
    os.killpg(process.pid, signal.SIGINT)
    stdout, stderr = process.communicate(timeout=30)
    assert (process.returncode, stdout) == (130, "")
    assert "stopped: 0 of 10 are in runs/results.jsonl; the same command goes on from there" in stderr
    assert "Traceback" not in stderr
    assert (tmp_path / "runs" / "results.jsonl").read_text() == ""


SWEEP = ["sweep", "--robots", "two_link", "--worlds", "circle", "--out", "runs"]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ([*SWEEP, "--robots", ","], "--robots: expected names separated by commas, got ','"),
        ([*SWEEP, "--robots", "r2d2"], "no robot named 'r2d2'"),
        ([*SWEEP, "--worlds", "circle,moon"], "no world named 'moon'"),
        ([*SWEEP, "--seeds", "1-x"], "--seeds: expected at most 10,000 seeds such as 0-4 or 1,3,5, got '1-x'"),
        ([*SWEEP, "--time-limit", "inf"], "--time-limit must be finite, got inf"),
        ([*SWEEP, "--dask", "nowhere"], "no Dask scheduler answers at 'nowhere'"),
        ([*SWEEP, "--out", "a_file"], "--out: a_file is a file; give a folder"),
        ([*SWEEP, "--out", "used"], "used/results.jsonl: line 1 is no result of a sweep; give another folder"),
        (["study", "convergence", "--rates", "0", "--out", "runs"], "--rates: expected positive numbers such as 1e-3"),
        (["study", "variability", "--seeds", "-1", "--out", "runs"], "--seeds: expected at most 10,000 seeds"),
        (["study", "variability", "two_link", "moon", "--out", "runs"], "no world named 'moon'"),
    ],
)
def test_bad_input_is_one_sentence_and_exit_code_2(cli, tmp_path, arguments, sentence):
    (tmp_path / "a_file").touch()
    (tmp_path / "used").mkdir()
    (tmp_path / "used" / "results.jsonl").write_text("something else\n")
    done = cli(*arguments)
    assert (done.code, done.stdout) == (2, "")
    [line] = [line for line in done.stderr.splitlines() if line.startswith("error:")]
    assert line.startswith(f"error: {sentence}")
    assert "Traceback" not in done.stderr


def test_two_worlds_of_one_name_would_share_folders(cli, tmp_path):
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "w.yaml").write_text(f"obstacles: [{BALL}]\n")
    done = cli("sweep", "--robots", "two_link", "--worlds", "a/w.yaml,b/w.yaml", "--out", "runs")
    assert done.code == 2
    assert "would be written into" in done.stderr and "two_link_w_0; rename a file" in done.stderr


# Studies


def test_the_study_of_convergence(cli, tmp_path):
    """The table holds the runs' own results beside the paper's numbers; the second time nothing is trained."""
    command = [
        "study",
        "convergence",
        "two_link",
        "circle",
        "--runs",
        1,
        "--rates",
        "3e-3,1e-4",
        *SMALL,
        "--out",
        "runs",
    ]
    done = cli(*command, "--json")
    assert done.code == 0, done.stderr
    found = json.loads(done.stdout)
    assert [(r["preset"], r["rate"], r["paper_share"], r["paper_steps"]) for r in found["rows"]] == [
        ("paper", 3e-3, None, None), ("paper", 1e-4, 0.7, 150),
        ("default", 3e-3, None, None), ("default", 1e-4, 0.7, 150),
    ]  # fmt: skip
    results = tmp_path / "runs" / "results.jsonl"
    assert [r["converged"] for r in convergence_rows(lines(results))] == [r["converged"] for r in found["rows"]]
    assert [Path(f).name for f in found["files"]] == ["results.jsonl", "table.csv", "table.md", "convergence.png"]
    assert is_picture(tmp_path / "runs" / "convergence.png")
    with (tmp_path / "runs" / "table.csv").open() as file:
        assert [row["rate"] for row in csv.DictReader(file)] == ["0.003", "0.0001", "0.003", "0.0001"]
    before = results.read_text()
    text = cli(*command)
    assert text.code == 0
    assert results.read_text() == before
    assert "paper" in text.stdout and "wrote runs/results.jsonl, runs/table.csv" in text.stdout


def test_the_study_of_variability(cli, tmp_path):
    command = ["study", "variability", "two_link", "circle", "--seeds", "3,5", *SMALL, "--out", "runs"]
    done = cli(*command, "--json")
    assert done.code == 0, done.stderr
    found = json.loads(done.stdout)
    assert [row["seed"] for row in found["rows"]] == [3, 5, "mean", "std"]
    assert 0.5 < found["rows"][0]["overlap"] == found["rows"][1]["overlap"] <= 1.0
    names = ["results.jsonl", "table.csv", "table.md", "curves.png", "boundaries.png"]
    assert [Path(f).name for f in found["files"]] == names
    assert is_picture(tmp_path / "runs" / "curves.png")
    assert is_picture(tmp_path / "runs" / "boundaries.png")
    before = (tmp_path / "runs" / "results.jsonl").read_text()
    assert "overlap" in cli(*command).stdout
    assert (tmp_path / "runs" / "results.jsonl").read_text() == before


# Numbers


def record(
    rate: float,
    converged: bool,
    reason: str = "clean",
    steps: int = 400,
    first_clean: int = 100,
    volume: float = 0.9,
    ended: bool | None = None,
) -> dict[str, Any]:
    history = [{"iteration": i, "clean": i >= first_clean, "torque": 0.01, "passivity": 0.03}
               for i in range(50, steps + 1, 50)]  # fmt: skip
    result = {"converged": converged, "reason": reason, "steps": steps, "seconds": steps / 200, "volume_kept": volume,
              "history": history, "ended": bool(ended)}  # fmt: skip
    return {"key": {"preset": "paper", "learning_rate": rate, "exit": 0.0 if ended is None else 0.01}, "result": result}


def test_convergence_counts_and_means():
    collapsed = "collapsed: the safe set keeps 3.0% of the LB set"
    rows = convergence_rows(
        [record(1e-5, True), record(1e-5, True, steps=600, first_clean=200), record(1e-5, False, "3 of 500 violate"),
         record(1e-5, False, collapsed, first_clean=500, volume=0.1), record(1e-3, False, collapsed, first_clean=500)]
    )  # fmt: skip
    assert rows[0] == {"preset": "paper", "rate": 1e-5, "runs": 4, "converged": 0.5, "collapsed": 0.25,
                       "clean_once": 0.75, "first_clean": pytest.approx(400 / 3), "steps": 500, "seconds": 2.25,
                       "violating": pytest.approx(0.04), "volume_least": 0.1, "volume_most": 0.9,
                       "paper_share": 1.0, "paper_steps": 400}  # fmt: skip
    assert (rows[1]["converged"], rows[1]["collapsed"], rows[1]["steps"]) == (0.0, 1.0, None)
    assert (rows[1]["clean_once"], rows[1]["first_clean"]) == (0.0, None)


def test_with_the_papers_exit_those_converge_that_reach_it_and_have_not_collapsed():
    """What the evidence says of them does not count: most violate still."""
    runs = [record(1e-5, False, "3 violate", ended=True), record(1e-5, False, "collapsed: ...", ended=True),
            record(1e-5, True, ended=False), record(1e-5, False, "3 violate", steps=600, ended=True)]  # fmt: skip
    row, other = convergence_rows([*runs, record(1e-5, True)])
    assert (row["converged"], row["collapsed"], row["steps"], row["runs"]) == (0.5, 0.25, 500, 4)
    assert (other["converged"], other["runs"]) == (1.0, 1)


def test_the_papers_table():
    assert list(TABLE_1) == [1e-3, 1e-4, 5e-5, 1e-5, 5e-6]
    assert list(TABLE_1) == tasks.rates("1e-3,1e-4,5e-5,1e-5,5e-6")


def test_a_curve_holds_a_runs_last_value():
    histories = [
        [{"iteration": 10, "loss": 1.0}, {"iteration": 20, "loss": 2.0}],
        [{"iteration": 20, "loss": 4.0}, {"iteration": 30, "loss": None}],
    ]
    found = curve(histories, "loss")
    assert found.iteration.tolist() == [10, 20, 30]
    np.testing.assert_array_equal(found.runs, [[1.0, 2.0, 2.0], [np.nan, 4.0, np.nan]])
    np.testing.assert_array_equal(found.mean, [1.0, 3.0, 2.0])
    np.testing.assert_array_equal(found.std, [0.0, 1.0, 0.0])


def test_runs_that_ended_before_their_first_check_have_no_curve():
    assert curve([[], []], "loss").mean.shape == (0,)


def test_overlaps_of_safe_sets(cartpole, make_barrier):
    """The LB set contains every learned one, so their overlap is the volume kept."""
    lb, learned = make_barrier(cartpole, "lb-cbf"), make_barrier(cartpole, "pp-ncbf-mlp")
    found = overlaps(cartpole, [lb, learned, lb], np.random.default_rng(0))
    np.testing.assert_array_equal(found, found.T)
    np.testing.assert_array_equal(np.diag(found), 1.0)
    assert found[0, 2] == 1.0
    assert 0.0 < found[0, 1] < 0.999
    rng = np.random.default_rng(0)
    inside = np.zeros(2)
    q, v = cartpole.robot.domain.sample_q(rng, 10_000), cartpole.robot.domain.sample_v(rng, 10_000)
    dyn = cartpole.model.evaluate_batch(cartpole.model.from_angles(q), v)
    safety = cartpole.safety.evaluate(dyn)
    for i, barrier in enumerate((learned, lb)):
        inside[i] = np.sum((safety.h.min(-1) >= 0.0) & (barrier.rows(dyn, safety).phi.min(-1) >= 0.0))
    assert found[0, 1] == pytest.approx(inside[0] / inside[1])


def test_variability_over_seeds():
    records = [
        {"key": {"seed": i}, "result": {"converged": i == 0, "volume_kept": 0.8 + 0.1 * i, "violations": i, "steps": 10,
                                        "seconds": 1.0}}
        for i in range(2)
    ]  # fmt: skip
    first, second, mean, std = variability_rows(records, np.array([[1.0, 0.7], [0.7, 1.0]]))
    assert (first["seed"], first["overlap"], second["violations"]) == (0, 0.7, 1)
    assert (mean["converged"], mean["volume_kept"], std["volume_kept"]) == pytest.approx((0.5, 0.85, 0.05))
    [alone, *_] = variability_rows(records[:1], np.ones((1, 1)))
    assert alone["overlap"] is None


def test_tables_as_files(tmp_path):
    write_table([{"a": 1.23456789, "b": None, "c": True}, {"a": 2, "b": "x", "c": False}], tmp_path / "new")
    assert (tmp_path / "new" / "table.csv").read_text() == "a,b,c\n1.23456789,,True\n2,x,False\n"
    assert (tmp_path / "new" / "table.md").read_text() == (
        "| a | b | c |\n| --- | --- | --- |\n| 1.235 | - | yes |\n| 2 | x | no |\n"
    )
    (tmp_path / "table.csv").mkdir()
    with pytest.raises(InputError, match=r"table.csv: cannot be written \(Is a directory\)"):
        write_table([{"a": 1}], tmp_path)


@pytest.mark.parametrize(("text", "expected"), [("0-3", [0, 1, 2, 3]), ("7", [7]), ("1,3-4, 3", [1, 3, 4])])
def test_seeds_on_the_command_line(text, expected):
    assert tasks.seeds(text) == expected


@pytest.mark.parametrize("text", ["", "a", "3-1", "-1", "1-", "0-10000", "0-99999999999999999999999", "1.5"])
def test_seeds_that_are_none(text):
    with pytest.raises(InputError, match="--seeds: expected at most 10,000 seeds such as"):
        tasks.seeds(text)


@pytest.mark.parametrize("text", ["", "x", "0", "-1e-3", "nan", "inf", "1e-3,0"])
def test_rates_that_are_none(text):
    with pytest.raises(InputError, match="--rates: expected positive numbers such as"):
        tasks.rates(text)


def test_a_task_is_known_by_all_that_its_outcome_depends_on(cartpole):
    training = Training("cartpole", "wall", "default", PRESETS["default"], 0, 60.0)
    names = {training.task(cartpole).name, training.task(cartpole.with_goal(cartpole.robot.start)).name}
    spec = cartpole.robot.spec.barrier.model_copy(update={"gamma": 3.0})
    names.add(training.task(cartpole.with_barrier_spec(spec)).name)
    for change in ({"seed": 1}, {"time_limit": 61.0}, {"preset": dataclasses.replace(PRESETS["default"], margin=0.5)}):
        names.add(dataclasses.replace(training, **change).task(cartpole).name)
    assert len(names) == 6
    with_barrier = {dataclasses.replace(training, folder=Path(x)).task(cartpole).name for x in ("a/x", "b/x")}
    assert len(with_barrier) == 1 and not with_barrier & names  # a result without a barrier is no result here
