"""Campaigns and what they run on: compiled dynamics against Pinocchio, runs together against runs alone, the counts."""

from __future__ import annotations

import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ppcbf_robots.batch_dynamics import BatchDynamics
from ppcbf_robots.campaign import CLEAR, Drawing, draw, outcome, run_cases, total
from ppcbf_robots.cli.campaign import Chunk, _load
from ppcbf_robots.cli.main import main
from ppcbf_robots.engines import PinocchioEngine
from ppcbf_robots.errors import InputError
from ppcbf_robots.filters import FilterConfig, Status
from ppcbf_robots.lockstep import Case, simulate_together
from ppcbf_robots.plant import perturbed
from ppcbf_robots.problem import load_problem
from ppcbf_robots.pushes import Push, PushedEngine, push_torques
from ppcbf_robots.resources import find_robot
from ppcbf_robots.rollout import FIELDS, Trajectory, simulate
from ppcbf_robots.safety_filter import SafetyFilter
from ppcbf_robots.viewer import check_trajectories


def plants(problem, count, seed=0):
    rng = np.random.default_rng(seed)
    return [perturbed(problem.model, mass=rng.uniform(0.7, 1.3, problem.model.nv)) for _ in range(count)]


def alone(problem, barrier, config, case, duration):
    """The run of a case by the one-run simulator."""
    runtime = SafetyFilter(problem.model, problem.safety, barrier, config, problem.robot.controller.gains.kd)
    engine = PushedEngine(PinocchioEngine(case.plant or problem.model), case.pushes)
    controller = problem.robot.controller.with_goal(case.goal)
    return simulate(problem.safety, controller, runtime, case.q, case.v, duration, config.dt, engine=engine)


def test_batch_terms_are_pinocchios(problem, states):
    q, v = (np.array(x) for x in zip(*states(problem, 40), strict=True))
    robots = plants(problem, 40)
    found = BatchDynamics(robots).evaluate(q, v)
    for i, robot in enumerate(robots):
        for name, expected in vars(robot.evaluate(q[i], v[i])).items():
            scale = max(1.0, np.abs(expected).max())
            np.testing.assert_allclose(getattr(found, name)[i], expected, atol=1e-10 * scale, err_msg=name)


def test_batch_motion_is_the_engines(problem, states):
    q, v = (np.array(x) for x in zip(*states(problem, 20), strict=True))
    robots, u = plants(problem, 20), np.random.default_rng(1).uniform(-0.3, 0.3, v.shape) * problem.model.u_max
    moved_q, moved_v = q.copy(), v.copy()
    BatchDynamics(robots).advance(moved_q, moved_v, u, 5e-4, 10)
    for i, robot in enumerate(robots):
        engine = PinocchioEngine(robot)
        engine.reset(q[i], v[i])
        engine.advance(u[i], 5e-4, 10)
        np.testing.assert_allclose(moved_q[i], engine.state()[0], atol=1e-9)
        np.testing.assert_allclose(moved_v[i], engine.state()[1], atol=1e-8 * max(1.0, np.abs(v[i]).max()))


@pytest.mark.parametrize("kind", ["qp", "closed-form"])
def test_runs_together_are_the_runs_alone(problem, make_barrier, barrier_name, kind):
    """With pushes and another plant, for every barrier: every recorded value, the status of every step, the ending.

    Not longer than 0.06 s: with random weights a filter may part runs tenfold every 5 ms.
    """
    barrier, config = make_barrier(problem, barrier_name), FilterConfig(kind=kind)
    if "convex" in barrier_name:  # less steep, or the runs part where a row's shortfall is just tolerated or not
        barrier.network.params |= {name: np.array(-3.0) for name in ("cone_a", "bowl_a")}
        barrier.network.params["ba"] -= 3.0
    drawing = Drawing(seed=1, duration=0.06, pushes=True, mass_error=0.2)
    cases = [draw(problem, problem.barrier("lb-cbf"), drawing, i) for i in range(3)]
    for case, run in zip(cases, run_cases(problem, barrier, config, cases, 0.06), strict=True):
        other = alone(problem, barrier, config, case, 0.06)
        usual = int(np.cumprod(other.status < Status.INVALID).sum())  # until no real arm would move so fast
        assert usual == len(other.t) or (kind == "closed-form" and usual > 20)
        for name in FIELDS:
            found, expected = (getattr(x, name)[:usual].astype(float) for x in (run, other))
            np.testing.assert_allclose(found, expected, atol=1e-6 * max(1.0, np.abs(expected).max()), err_msg=name)
        assert run.meta["end"]["state"] == other.meta["end"]["state"] or usual < len(other.t)
        assert run.meta["complete"] and run.meta["goal"] == case.goal.tolist()


def test_the_screen_lets_pass_what_the_filter_lets_pass(panda, states, make_barrier):
    """Fast states, so that many need a correction; the controller's torque and torques beyond the box."""
    barrier, rng = make_barrier(panda, "pp-ncbf-convex"), np.random.default_rng(2)
    runtime = SafetyFilter(panda.model, panda.safety, barrier)
    q, v = (np.array(x) for x in zip(*states(panda, 200), strict=True))
    v *= rng.uniform(0.0, 0.2, (200, 1))
    dyn = BatchDynamics([panda.model] * 200).evaluate(q, v)
    u_des = panda.robot.controller.evaluate(dyn).u
    outward = np.arange(200) % 10 == 0
    u_des[outward, 0] = 0.99 * panda.model.u_max[0]
    assert runtime.screen(dyn, u_des).free[outward].any()
    u_des[outward, 0] = 1.01 * panda.model.u_max[0]
    free = runtime.screen(dyn, u_des).free
    expected = [
        runtime.filter(panda.model.evaluate(q[i], v[i]), u_des[i], 0.0).status is Status.FREE for i in range(len(q))
    ]
    assert free.tolist() == expected
    assert 20 < free.sum() < 180
    assert not free[outward].any()


def test_a_run_that_diverges_ends_alone(two_link):
    """Unfiltered, with a push beyond all measure, beside an ordinary run."""
    q, goal = two_link.robot.start, two_link.robot.goal
    kick = Push(0.02, 0.05, np.array([1e7, 0.0]))
    cases = [Case(q, np.zeros(2), goal), Case(q, np.zeros(2), goal, [kick])]
    calm, lost = simulate_together(two_link, cases, None, FilterConfig(), 0.2)
    assert calm.meta["complete"] and len(calm.t) == 201
    assert not lost.meta["complete"] and lost.meta["end"] is None and 21 < len(lost.t) < 40
    found = outcome(two_link, cases[1], lost)
    assert found["state"] == "diverged"
    json.dumps(found, allow_nan=False)
    assert total({0: outcome(two_link, cases[0], calm), 1: found})["failed"] == [1]


def test_starts_are_safe_and_reproducible(problem):
    barrier = problem.barrier("lb-cbf")
    drawing = Drawing(seed=3)
    speeds = []
    for i in range(20):
        case = draw(problem, barrier, drawing, i)
        dyn = problem.model.evaluate(case.q, case.v)
        rows = barrier.rows(dyn, problem.safety.evaluate(dyn))
        assert rows.h.min() >= CLEAR and rows.phi.min() >= 0.0
        assert problem.safety.least(case.goal)[0] >= CLEAR
        assert np.all(np.abs(case.v) <= np.abs(problem.robot.domain.v).max(axis=1))
        speeds.append(np.abs(case.v).max())
        same, pushed = draw(problem, barrier, drawing, i), draw(problem, barrier, Drawing(3, 5.0, True, 0.2), i)
        for other in (same, pushed):
            np.testing.assert_array_equal(np.concatenate([case.q, case.v, case.goal]),
                                          np.concatenate([other.q, other.v, other.goal]))  # fmt: skip
        assert 1 <= len(pushed.pushes) <= 3 and pushed.plant is not None
    assert len(set(speeds)) == 20


def test_a_world_without_room_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("ppcbf_robots.campaign.TRIES", 50)
    wall = "{name: everywhere, type: half_space, normal: [0, 0, 1], offset: -0.1, margin: 3.0}"
    (tmp_path / "world.yaml").write_text(f"obstacles: [{wall}]\n")
    problem = load_problem("two_link", str(tmp_path / "world.yaml"))
    with pytest.raises(InputError, match="no start or goal found in 50 uniform configurations"):
        draw(problem, None, Drawing(), 0)


def test_pushes_act_in_their_time_and_their_work_is_known(two_link):
    """The undamped, unactuated arm's energy changes by the pushes' work and by nothing else."""
    pushes = [Push(0.01, 0.02, np.array([2.0, -1.0])), Push(0.02, 0.03, np.array([0.0, 3.0]))]
    at = push_torques(pushes, np.array([0.0, 0.009, 0.01, 0.02, 0.03, 0.049, 0.05]), 2)
    assert at.tolist() == [[0, 0], [0, 0], [2, -1], [2, 2], [0, 3], [0, 3], [0, 0]]
    model, q = two_link.model, two_link.robot.start
    engine = PushedEngine(PinocchioEngine(model), pushes)
    engine.reset(q, np.zeros(2))
    t, states = 1e-3 * np.arange(101), []
    for _ in t:
        states.append(engine.state())
        engine.advance(np.zeros(2), 5e-4, 2)
    path = np.array([s[0] for s in states])
    energy = np.array([model.evaluate(*s).kinetic_energy + model.potential_energy(s[0]) for s in states])
    zeros, none = np.zeros(len(t)), np.zeros_like(path)
    meta = {"goal": q.tolist(), "contacts": None, "end": None}
    run = Trajectory(t, path, none, none, none, zeros + 1, zeros + 1, zeros, energy, zeros, zeros, meta)
    found = outcome(two_link, Case(q, np.zeros(2), q, pushes), run)
    assert abs(found["push_work"]) > 0.01
    assert found["push_work"] == pytest.approx(energy[-1] - energy[0], rel=1e-6)
    assert found["largest_rise"] < 1e-6
    assert outcome(two_link, Case(q, np.zeros(2), q), run)["largest_rise"] > 0.01


def test_what_goes_wrong_is_counted(two_link):
    """Figures of a run with known faults, one by one."""
    case = draw(two_link, None, Drawing(), 0)
    [good] = simulate_together(two_link, [case], two_link.barrier("lb-cbf"), FilterConfig(), 0.05)
    steps = len(good.t)

    def found(**changes: Any) -> dict[str, Any]:
        return outcome(two_link, case, dataclasses.replace(good, **changes))

    bump = np.zeros(steps)
    bump[10] = 1.0
    clean = found()
    assert not clean["contact"] and clean["torque"] <= 1.0 and clean["fallbacks"] == 0
    assert found(clearance=good.clearance - 10.0 * bump, h=good.h - 10.0 * bump)["contact"]
    assert not clean["beyond_limit"] and not found(h=good.h - 10.0 * bump)["contact"]
    assert found(q=good.q + 10.0 * bump[:, None])["beyond_limit"]  # whatever else is nearer
    assert found(u=good.u + 1e3 * bump[:, None])["torque"] > 1.0
    assert found(V=good.V + 7.0 * bump)["largest_rise"] == pytest.approx(7.0, abs=0.1)
    failed = found(status=np.where(bump > 0, Status.INFEASIBLE, 0))
    assert (failed["qp_failures"], failed["fallbacks"]) == (1, 1)
    dropped = found(status=np.where(bump > 0, Status.PASSIVITY_DROPPED, 0))
    assert (dropped["qp_failures"], dropped["fallbacks"]) == (0, 1)
    contacts = {"steps": 2, "hull_steps": 0, "pairs": []}
    assert found(meta=good.meta | {"contacts": contacts})["contact"]
    assert not found(meta=good.meta | {"contacts": contacts | {"steps": 0}}, clearance=good.clearance - 10)["contact"]
    runs = {0: clean, 1: found(u=good.u + 1e3 * bump[:, None]), 2: failed}
    sums = total(runs)
    assert (sums["rollouts"], sums["contacts"], sums["torque_violations"], sums["qp_failures"]) == (3, 0, 1, 1)
    assert sums["failed"] == [1] and sums["worst"]["torque"] == 1


def run(*arguments: object, monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setattr(sys, "argv", ["ppcbf", "campaign", *map(str, arguments)])
    with pytest.raises(SystemExit) as exit_info:
        main()
    return int(exit_info.value.code or 0)


def test_campaign_goes_on_and_replays(tmp_path: Path, monkeypatch, capsys):
    monkeypatch.setattr("ppcbf_robots.cli.campaign.CHUNK", {"pinocchio": 2, "mujoco": 2})
    base = ("two_link", "circle", "--duration", 0.2, "--seed", 5)
    here = ("--out", tmp_path / "c", "--json")
    assert run(*base, "--rollouts", 4, *here, monkeypatch=monkeypatch) == 0
    first = json.loads(capsys.readouterr().out)
    assert (first["rollouts"], first["contacts"], first["torque_violations"], first["rate_violations"]) == (4, 0, 0, 0)
    assert first["min_h"] > 0.0 and first["qp_failures"] == first["fallbacks"] == 0
    lines = (tmp_path / "c" / "results.jsonl").read_text().splitlines()
    assert run(*base, "--rollouts", 6, *here, monkeypatch=monkeypatch) == 0  # only what is new runs
    assert (tmp_path / "c" / "results.jsonl").read_text().splitlines()[:2] == lines
    assert len((tmp_path / "c" / "results.jsonl").read_text().splitlines()) == 3
    more = json.loads(capsys.readouterr().out)
    assert more == json.loads((tmp_path / "c" / "campaign.json").read_text())
    worst = Trajectory.load(tmp_path / "c" / "worst.npz")
    assert worst.h.min() == pytest.approx(more["min_h"], abs=1e-9)
    number = more["worst"]["min_h"]
    assert worst.meta["case"] == number
    replay = ("--replay", number, "--out", tmp_path / "t.npz", "--json")
    assert run(*base, *replay, monkeypatch=monkeypatch) == 0
    again = Trajectory.load(tmp_path / "t.npz")
    np.testing.assert_allclose(again.q, worst.q, atol=1e-9)
    check_trajectories(_two_link(), [again], ["again"])  # as the viewer does
    assert run(*base, "--rollouts", 4, "--barrier", "none", *here, monkeypatch=monkeypatch) in (0, 3)
    assert len((tmp_path / "c" / "results.jsonl").read_text().splitlines()) == 5  # another barrier, other results


def test_results_with_other_torque_rates_are_other_results(tmp_path: Path):
    spec = tmp_path / "slow.yaml"
    text = find_robot("two_link").read_text().replace("urdf: ", f"urdf: {find_robot('two_link').parent}/")
    keys = []
    for rate in (1000, 50):
        spec.write_text(f"{text}\neffort_rate: {rate}\n")
        chunk = Chunk(str(spec), "circle", "lb-cbf", None, None, "pinocchio", None, Drawing(), range(2))
        keys.append(chunk.task().key)
        _load.cache_clear()
    assert keys[0] != keys[1] and keys[0]["robot"] == keys[1]["robot"]


def _two_link():

    return load_problem("two_link", "circle")


def test_campaign_ends_with_3_where_the_unfiltered_arm_runs_into_things(tmp_path: Path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert (
        run("panda", "table_boxes", "--rollouts", 4, "--barrier", "none", "--duration", 3, monkeypatch=monkeypatch) == 3
    )
    shown = capsys.readouterr()
    facts = json.loads((tmp_path / "campaign" / "campaign.json").read_text())
    assert facts["contacts"] > 0 and facts["failed"]
    assert "runs with a contact" in shown.out and "--replay N" in shown.out
    assert "of 4 runs broke what must hold" in shown.err.replace("\n", " ")


def test_campaign_in_mujoco_with_pushes_and_wrong_masses(tmp_path: Path, monkeypatch, capsys):
    pytest.importorskip("mujoco")
    options = ("--engine", "mujoco", "--pushes", "--mass-error", 20, "--duration", 0.3, "--rollouts", 2)
    code = run("two_link", "circle", *options, "--out", tmp_path, "--json", monkeypatch=monkeypatch)
    facts = json.loads(capsys.readouterr().out)
    assert code == (3 if facts["failed"] else 0)
    assert (facts["engine"], facts["mass_error"], facts["pushes"]) == ("mujoco", 0.2, True)
    worst = Trajectory.load(tmp_path / "worst.npz")
    assert worst.meta["contacts"] is not None and worst.meta["pushes"]


def test_campaign_limits_the_torques_rate(tmp_path: Path, monkeypatch, capsys):
    """Limited, no run breaks it; what the same torques would have broken shows that it matters."""
    options = ("--duration", 0.5, "--rollouts", 3, "--json")
    assert run("two_link", "circle", *options, "--effort-rate", 500, "--out", tmp_path, monkeypatch=monkeypatch) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["effort_rate"] == 500.0 and facts["rate_violations"] == 0
    assert 0.0 <= facts["max_above_V0_share"] < 1e-3
    worst = Trajectory.load(tmp_path / "worst.npz")
    assert np.max(np.abs(np.diff(worst.u, axis=0))) <= 0.5 * (1.0 + 1e-9)
    assert np.max(np.abs(np.diff(worst.u, axis=0))) > 0.01
    assert run("two_link", "circle", *options, "--effort-rate", -1, "--out", tmp_path, monkeypatch=monkeypatch) == 2


@pytest.mark.parametrize(
    "arguments, said",
    [
        (["--out", "runs/figures.json"], "--out: expected a folder"),
        (["--barrier", "nowhere"], "neither a barrier folder nor one of"),
        (["--replay", "3", "--out", "."], "is a folder; give a file"),
    ],
)
def test_wrong_use_is_said_in_one_sentence(tmp_path, monkeypatch, capsys, arguments, said):
    monkeypatch.chdir(tmp_path)
    assert run("two_link", "circle", *arguments, monkeypatch=monkeypatch) == 2
    assert said in capsys.readouterr().err.replace("\n", " ")
    assert not list(tmp_path.iterdir())


def test_a_limited_torque_rate_is_kept_and_counted(two_link, monkeypatch):
    """The filter's memory of its last torque goes along in runs together; without a filter the rate is broken."""
    monkeypatch.setattr(two_link.model, "u_rate", np.array([20.0, 20.0]))
    barrier, config, drawing = two_link.barrier("lb-cbf"), FilterConfig(), Drawing(duration=0.3)
    cases = [draw(two_link, barrier, drawing, i) for i in range(3)]
    for case, run_ in zip(cases, run_cases(two_link, barrier, config, cases, 0.3), strict=True):
        other = alone(two_link, barrier, config, case, 0.3)
        np.testing.assert_allclose(run_.u, other.u, atol=1e-8)
        assert run_.status.tolist() == other.status.tolist()
        assert 0.9 < outcome(two_link, case, run_)["rate"] <= 1.0 + 1e-6
    [case] = cases[:1]
    [free] = run_cases(two_link, None, config, [case], 0.3)
    jerk = dataclasses.replace(free, u=free.u + 5.0 * (free.t > 0.1)[:, None])
    found = outcome(two_link, case, jerk)
    assert found["rate"] > 100.0 and total({0: found})["rate_violations"] == 1
