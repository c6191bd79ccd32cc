"""The benchmark of the filter step: what it measures and how it says so (not how fast the machine is)."""

from __future__ import annotations

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from ppcbf_robots.benchmark import STAGES, crowd, default_barrier, measure
from ppcbf_robots.cli.main import app
from ppcbf_robots.errors import InputError
from ppcbf_robots.filters import FilterConfig
from ppcbf_robots.problem import load_robot
from ppcbf_robots.world import Sphere


def test_a_case_is_about_solved_qps(two_link):
    problem = crowd(load_robot("two_link"), 126)
    case = measure(problem, default_barrier(problem), FilterConfig(), 200)
    assert (case.robot, case.joints, case.pairs, case.steps) == ("two_link", 2, 126, 200)
    assert 0.0 < case.median_us <= case.p99_us <= case.max_us
    assert tuple(case.stages) == STAGES and min(case.stages.values()) > 0.0


def test_obstacles_out_of_reach_are_refused(two_link):
    robot = load_robot("two_link")
    far = Sphere(type="sphere", name="far", center=[50.0, 0.0, 0.0], radius=0.1)
    problem = crowd(robot, 1)
    problem = type(problem)(robot, "far", problem.world, robot.safety([far]))
    with pytest.raises(InputError, match="out of reach"):
        measure(problem, problem.barrier("lb-cbf"), FilterConfig(), 100)


def test_command(tmp_path):
    picture = tmp_path / "bench.png"
    arguments = ["bench", "two_link", "--steps", "100", "--pairs", "126", "--figure", str(picture), "--json"]
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 0, done.output
    cases = json.loads(done.stdout)["cases"]
    assert {"robot", "pairs", "filter", "solver", "median_us", "p99_us", "max_us", "stages"} <= set(cases[0])
    assert {c["solver"] for c in cases} >= {"daqp", "proxqp", "quadprog"}
    assert {c["joints"] for c in cases} == {2, 5, 6, 7}
    assert picture.stat().st_size > 5_000


def test_one_world_alone():
    done = CliRunner().invoke(app, ["bench", "two_link", "circle", "--steps", "100", "--json"])
    (case,) = json.loads(done.stdout)["cases"]
    assert (case["robot"], case["pairs"], case["solver"]) == ("two_link", 1, "daqp")
    assert np.isfinite(case["median_us"])


def test_the_learners_throughput() -> None:
    done = CliRunner().invoke(app, ["bench", "train", "two_link", "circle", "--iterations", "10", "--json"])
    assert done.exit_code == 0, done.output
    cases = json.loads(done.stdout)["cases"]
    assert {c["preset"] for c in cases} == {"paper", "default"}
    for c in cases:
        assert c["states_per_s"] > 100.0 * c["iterations_per_s"] > 0.0  # hundreds of states an iteration
        assert 0.0 < c["share"] < 1.0


def test_bench_times_the_filter_unless_told_otherwise() -> None:
    texts = [CliRunner().invoke(app, ["bench", *words, "--help"]).output for words in ([], ["filter"], ["train"])]
    assert "filter" in texts[0] and "train" in texts[0]
    assert "pairs" in texts[1] and "iterations" in texts[2]
