"""How fast torques may change: kept on every level of the ladder, and the QP as good as that allows."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
import qpsolvers
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog
from typer.testing import CliRunner

from ppcbf_robots import qp_filter
from ppcbf_robots.cli.main import app
from ppcbf_robots.controllers import Gains, NominalController
from ppcbf_robots.errors import InputError
from ppcbf_robots.filters import FilterConfig, Status, free_power
from ppcbf_robots.qp_filter import QPFilter
from ppcbf_robots.robot import RobotModel
from ppcbf_robots.rollout import simulate
from ppcbf_robots.safety_filter import SafetyFilter

DT = 1e-3
RATE = 1000.0
BAD = {
    "none": {},
    "q": {"q": [np.nan, 0.0]},
    "u_des": {"u_des": [np.inf, 0.0]},
    "t": {"t": -1.0},
    "d_p": {"d_p": np.nan},
}


def limited(problem, rate=RATE, barrier="lb-cbf", included=True, **config):
    return SafetyFilter(problem.model, problem.safety, problem.barrier(barrier), FilterConfig(**config),
                        gravity_included=included, rate=rate)  # fmt: skip


steps = st.tuples(
    st.sampled_from([*BAD, "none", "none", "none"]),
    st.lists(st.floats(-1e3, 1e3), min_size=2, max_size=2),
    st.lists(st.floats(-2e-3, 2e-3), min_size=2, max_size=2),
)


@pytest.mark.parametrize("robot", ["cartpole", "two_link"])
@pytest.mark.parametrize("kind", ["qp", "closed-form"])
@settings(max_examples=60)
@given(run=st.lists(steps, min_size=2, max_size=60), included=st.booleans(), rate=st.sampled_from([20.0, 1000.0]))
def test_every_torque_keeps_rate_and_box(problems, robot, kind, run, included, rate):
    """Whatever comes in, in whatever order; with gravity or without, the rate is that of the returned torque."""
    problem = problems[robot]
    model, q = problem.model, problem.robot.start.copy()
    filter_ = limited(problem, rate, included=included, kind=kind)
    g, before, held = model.gravity(q), None, model.gravity(q)
    for i, (bad, u_des, dq) in enumerate(run):
        told = {"t": (i + 1) * DT, "q": q, "v": np.asarray(dq) / DT, "u_des": u_des, "d_p": 0.1} | BAD[bad]
        result = filter_.step(**told)
        if result.status < Status.INVALID:
            held = model.gravity(q)
        total = result.u + (0.0 if included else held)
        assert np.all(np.isfinite(result.u))
        assert np.all(np.abs(total) <= model.u_max * (1 + 1e-12) + 1e-9)
        if result.status is not Status.STOP and (before is None or before.status is not Status.STOP):
            last = before.u if before else np.clip(g, -model.u_max, model.u_max) * included
            moved = 0.0 if included else np.abs(held - g)  # where gravity moves the box
            if before is not None or result.status < Status.INVALID:
                assert np.all(np.abs(result.u - last) <= rate * DT * (1 + 1e-9) + moved + 1e-9)
        before, g, q = result, held, q + np.asarray(dq)


LEANING = np.array([0.0, 0.5])  # the cart-pole far from its wall: no row acts, and gravity pulls at the pole


def test_the_first_torque_is_near_gravity_or_near_the_one_given(cartpole):
    v, u_des = np.zeros(2), np.array([15.0, -9.0])
    g = cartpole.model.gravity(LEANING)
    assert abs(g[1]) > 1.0
    first = limited(cartpole).step(0.0, LEANING, v, u_des)
    np.testing.assert_allclose(first.u, g + np.array([1.0, -1.0]))
    told = limited(cartpole).step(0.0, LEANING, v, u_des, u_last=[10.0, -3.0])
    np.testing.assert_allclose(told.u, [11.0, -4.0])
    without = limited(cartpole, included=False)
    np.testing.assert_allclose(without.step(0.0, LEANING, v, u_des - g).u, [1.0, -1.0])
    np.testing.assert_allclose(without.step(0.001, LEANING, v, u_des - g).u, [2.0, -2.0])
    without.reset()
    np.testing.assert_allclose(without.step(0.0, LEANING, v, u_des - g).u, [1.0, -1.0])


def test_a_last_torque_outside_the_box_leads_back_into_it(two_link):
    model = two_link.model
    result = limited(two_link).step(0.0, two_link.robot.start, np.zeros(2), np.zeros(2), u_last=3.0 * model.u_max)
    np.testing.assert_allclose(result.u, model.u_max)
    filter_ = limited(two_link)
    filter_.step(0.0, two_link.robot.start, np.zeros(2), np.zeros(2))
    bridged = filter_.step(0.001, [np.nan, 0.0], np.zeros(2), np.zeros(2), u_last=3.0 * model.u_max)
    assert bridged.status is Status.INVALID
    np.testing.assert_allclose(bridged.u, model.u_max)


@pytest.mark.parametrize("u_last", [[np.nan, 0.0], [1.0], "x"])
def test_a_last_torque_that_is_none_is_a_fault(two_link, u_last):
    filter_ = limited(two_link)
    q = two_link.robot.start
    result = filter_.step(0.0, q, np.zeros(2), np.zeros(2), u_last=u_last)
    assert (result.status, result.reason) == (Status.FAULT, "u_last is not 2 finite numbers")
    np.testing.assert_allclose(result.u, two_link.model.gravity(q))


def test_fault_and_bridge_are_approached_at_the_rate(cartpole):
    filter_, q = limited(cartpole, metric="torque"), LEANING
    g = cartpole.model.gravity(q)
    away = filter_.step(0.0, q, np.zeros(2), g, u_last=g + 5.0).u
    np.testing.assert_allclose(away, g + 4.0)
    np.testing.assert_allclose(filter_.step(0.001, q, np.zeros(2), [np.nan, 0.0]).u, g + 3.0)  # FAULT
    bridged = filter_.step(0.002, [np.nan, 0.0], np.zeros(2), g)
    assert bridged.status is Status.INVALID
    np.testing.assert_allclose(bridged.u, g + 2.0)
    stopped = filter_.step(1.0, [np.nan, 0.0], np.zeros(2), g)
    assert stopped.status is Status.STOP
    np.testing.assert_array_equal(stopped.u, 0.0)
    np.testing.assert_allclose(filter_.step(1.001, q, np.zeros(2), g).u, np.clip(g, -1.0, 1.0))  # on from zero


def cases(problem, states, rate, count=150, speed=0.6):
    """Random states with random bounds that a rate would leave: (dyn, safety, rows, nominal, bounds)."""
    model, barrier, rng = problem.model, problem.barrier("lb-cbf"), np.random.default_rng(3)
    for q, v in states(problem, count):
        dyn = model.evaluate(q, speed * v)
        safety = problem.safety.evaluate(dyn)
        last = rng.uniform(-1.0, 1.0, model.nv) * model.u_max
        bounds = np.clip(last - rate, -model.u_max, model.u_max), np.clip(last + rate, -model.u_max, model.u_max)
        yield dyn, safety, barrier.rows(dyn, safety), problem.robot.controller.evaluate(dyn), bounds


def inequalities(problem, rows, dyn, config, fastest):
    """``A u >= lower`` of the barrier and of the velocity domain."""
    alpha, speed = min(config.alpha, fastest), min(config.fast_alpha, fastest)
    separating = min(config.fast_alpha, fastest - alpha) * np.maximum(0.0, np.minimum(rows.hdot, rows.phi))
    A, lower = rows.Lg_phi, -rows.Lf_phi - alpha * (rows.phi - config.margin) - separating
    if len(problem.safety.v_domain):
        low, high = problem.safety.v_domain.T
        drift = dyn.Minv @ dyn.b
        A = np.vstack([A, dyn.Minv, -dyn.Minv])
        lower = np.concatenate([lower, drift - speed * (dyn.v - low), -drift - speed * (high - dyn.v)])
    return A, lower


def test_the_answer_is_the_least_correction_within_the_rate(brisk_panda, states):
    """Against an active-set solver that is given every row and the same bounds; and infeasible where it says so."""
    panda = brisk_panda
    model, config, rate = panda.model, FilterConfig(), 0.3 * panda.model.u_max
    qp_filter = QPFilter(panda.barrier("lb-cbf"), panda.safety, config, np.full(7, RATE))
    fastest, seen = RATE / model.u_max.max(), dict.fromkeys(Status, 0)
    for dyn, safety, rows, nominal, bounds in cases(panda, states, rate):
        answer = qp_filter.correct(dyn, safety, rows, nominal.u, float(nominal.d_p), model.u_max, bounds)
        seen[answer.status] += 1
        assert np.all(answer.u >= bounds[0]) and np.all(answer.u <= bounds[1])
        A, lower = inequalities(panda, rows, dyn, config, fastest)
        budget = float(nominal.d_p) + free_power(model)
        A, lower = np.vstack([A, -dyn.v]), np.append(lower, -dyn.v @ nominal.u - budget)
        size = np.linalg.norm(A * model.u_max, axis=1)
        H = dyn.Minv * np.outer(model.u_max, model.u_max)
        z = qpsolvers.solve_problem(
            qpsolvers.Problem(H * 7 / np.trace(H), np.zeros(7), -A * model.u_max / size[:, None],
                              (A @ nominal.u - lower) / size, lb=(bounds[0] - nominal.u) / model.u_max,
                              ub=(bounds[1] - nominal.u) / model.u_max), solver="daqp")  # fmt: skip
        whole = answer.reason in ("constraint active", "all rows hold at u_des")
        assert whole == z.found
        if z.found:
            np.testing.assert_allclose(answer.u, nominal.u + z.x * model.u_max, atol=1e-5 * model.u_max.max())
    assert seen[Status.CORRECTING] > 30 and seen[Status.INFEASIBLE] > 10 and seen[Status.PASSIVITY_DROPPED] > 0


def test_out_of_reach_the_worst_row_is_as_good_as_the_rate_allows(cartpole, states):
    """One obstacle: the torque within the bounds that brakes most, as a linear program finds it."""
    config = FilterConfig(metric="torque")
    qp_filter, tried = QPFilter(cartpole.barrier("lb-cbf"), cartpole.safety, config), 0
    for dyn, safety, rows, nominal, bounds in cases(cartpole, states, 1.0, 300):
        answer = qp_filter.correct(dyn, safety, rows, nominal.u, None, cartpole.model.u_max, bounds)
        if answer.status is not Status.INFEASIBLE or answer.reason.startswith("L_g"):
            continue
        A, lower = inequalities(cartpole, rows, dyn, config, np.inf)
        size = np.linalg.norm(A * cartpole.model.u_max, axis=1)
        # max t  s.t.  (A u - lower) / size >= t
        program = linprog([0.0, 0.0, -1.0], -np.hstack([A / size[:, None], -np.ones((len(A), 1))]), -lower / size,
                          bounds=[*zip(*bounds, strict=True), (None, None)])  # fmt: skip
        found = np.min((A @ answer.u - lower) / size)
        assert found == pytest.approx(-program.fun, abs=2e-3)
        tried += 1
    assert tried > 20


def test_passivity_yields_before_safety_within_the_rate(cartpole):
    """Leaving the wall too slowly: only a push that adds energy keeps the row, and the rate allows it or not."""
    q, v = np.array([1.6, np.pi / 2]), np.array([-0.1, 0.0])
    for rate, status in (
        (np.inf, Status.PASSIVITY_DROPPED),
        (1e5, Status.PASSIVITY_DROPPED),
        (100.0, Status.INFEASIBLE),
    ):
        filter_ = limited(cartpole, rate, alpha=10.0)
        result = filter_.step(0.0, q, v, np.zeros(2), 0.0)
        assert result.status is status
        assert (
            result.reason
            == {
                np.inf: "rows and box allow no passive torque",
                1e5: "rows and box and rate allow no passive torque",
                100.0: "a row is out of reach of the torque box and rate",
            }[rate]
        )
    assert result.u[0] == pytest.approx(-0.1, rel=1e-3)


def test_the_closed_form_is_clipped_and_says_so(cartpole):
    filter_ = limited(cartpole, 100.0, kind="closed-form", metric="torque")
    clipped = filter_.step(0.0, np.array([1.4, np.pi / 2]), np.array([2.0, 0.0]), np.zeros(2))  # the pole lies level
    assert (clipped.status, clipped.reason) == (Status.INFEASIBLE, "the correction is clipped to box and rate")
    assert clipped.u[0] == pytest.approx(-0.1)
    filter_.reset()
    far = filter_.step(0.0, np.zeros(2), np.zeros(2), np.array([5.0, 0.0]))
    assert (far.status, far.reason) == (Status.CORRECTING, "u_des clipped to box and rate")
    np.testing.assert_allclose(far.u, [0.1, 0.0])


# ---------------------------------------------------------------------------------------------- closed loop


@pytest.fixture(scope="module")
def fast_panda(brisk_panda):
    """The Panda with a spring four times as stiff again and up to 60 % of its torque, at full speed."""
    problem = brisk_panda
    model, g = problem.model, problem.robot.controller.gains
    gains = Gains("bounded_spring", 4.0 * g.kp, g.kd, np.minimum(2.0 * g.max_spring, 0.6 * model.u_max))
    controller = NominalController(model, gains, problem.robot.goal)
    return dataclasses.replace(problem, robot=dataclasses.replace(problem.robot, controller=controller))


TASKS = [  # random ones of tests/benchmarks/five_spheres.py: start and goal
    ([0.79, -0.81, -2.66, -3.02, 1.82, 3.42, 0.62], [1.33, 0.15, 2.52, -0.62, -2.88, 3.21, -2.7]),
    ([-1.87, -0.39, -2.53, -0.89, -2.39, 1.47, 2.16], [-0.16, 1.45, 1.54, -0.32, -2.16, 0.26, -2.49]),
]


def run(problem, rate, task=TASKS[0]):
    start, goal = (problem.model.from_angles(np.array(x)) for x in task)
    problem = problem.with_goal(goal)
    filter_ = SafetyFilter(problem.model, problem.safety, problem.barrier("lb-cbf"), FilterConfig(),
                           problem.robot.controller.gains.kd, rate=rate)  # fmt: skip
    return simulate(problem.safety, problem.robot.controller, filter_, start, np.zeros(7), 1.2)


@pytest.mark.parametrize("task", TASKS)
def test_at_full_speed_among_spheres_a_frankas_rate_is_enough(fast_panda, monkeypatch, task):
    """1 N m per ms: nothing touched, no energy put in; rows as quick as without a limit are out of reach."""
    kept = run(fast_panda, RATE, task)
    assert np.abs(np.diff(kept.u, axis=0)).max() <= 1.0 + 1e-9
    assert kept.h.min() > 0.0
    assert kept.status.max() == Status.CORRECTING
    assert np.max(kept.V - np.minimum.accumulate(kept.V)) < 1e-3
    assert np.abs(kept.v).max() > 1.5
    monkeypatch.setattr(qp_filter, "slowest_joint", lambda robot, rate: np.inf)
    quick = run(fast_panda, RATE, task)
    assert np.sum(quick.status >= Status.PASSIVITY_DROPPED) > 10
    assert quick.h.min() < -0.01


def test_simulation_counts_the_steps_over_the_rate(fast_panda, monkeypatch):
    monkeypatch.setattr(fast_panda.model, "u_rate", np.full(7, RATE))
    free, kept = (run(fast_panda, rate) for rate in (np.inf, None))
    for trajectory, broken in ((free, True), (kept, False)):
        summary = trajectory.summary(fast_panda.model)
        over = np.abs(np.diff(trajectory.u, axis=0)).max(axis=1) > 1.0 + 1e-9
        assert summary["rate_violations"] == over.sum()
        assert (summary["rate_violations"] > 0) == broken
        assert summary["max_rate_ratio"] == pytest.approx(np.abs(np.diff(trajectory.u, axis=0)).max())
    monkeypatch.undo()
    assert free.summary(fast_panda.model)["rate_violations"] is None


# ---------------------------------------------------------------------------------------------- settings


def test_rates_of_a_robot_spec(two_link):
    urdf = two_link.model.urdf
    np.testing.assert_array_equal(RobotModel(urdf, effort_rate=50.0).u_rate, [50.0, 50.0])
    names = two_link.model.joint_names
    np.testing.assert_array_equal(RobotModel(urdf, effort_rate={names[1]: 7.0}).u_rate, [np.inf, 7.0])
    np.testing.assert_array_equal(RobotModel(urdf).u_rate, [np.inf, np.inf])
    with pytest.raises(InputError) as error:
        RobotModel(urdf, effort_rate=[1.0, 0.0])
    assert str(error.value) == f"{urdf}: effort_rate: joint '{names[1]}' needs a positive number, got 0"


def test_the_filter_takes_the_robots_rate_unless_told_another(two_link, cartpole, monkeypatch):
    monkeypatch.setattr(cartpole.model, "u_rate", np.array([100.0, np.inf]))
    far = np.array([20.0, -20.0])
    np.testing.assert_allclose(
        limited(cartpole, None, metric="torque").step(0.0, LEANING, np.zeros(2), far).u, [0.1, -20.0]
    )
    np.testing.assert_allclose(limited(cartpole, np.inf).step(0.0, LEANING, np.zeros(2), far).u, far)
    for bad in (0.0, [1.0, -1.0], [1.0, 2.0, 3.0], "x", np.nan):
        with pytest.raises(InputError, match="rate: expected one positive number or 2, got"):
            limited(two_link, bad)


def test_commands_take_the_rate(tmp_path, two_link):
    """simulate keeps the option's or the spec's; info warns of a gamma that the rate cannot follow."""

    def told(*arguments):
        done = CliRunner().invoke(app, [*map(str, arguments), "--json"])
        assert done.exit_code == 0, done.output
        return json.loads(done.stdout)

    brief = ("--duration", 0.1, "--out", tmp_path / "t.npz")
    assert told("simulate", "two_link", "circle", *brief)["rate_violations"] is None
    loose, tight = (told("simulate", "two_link", "circle", "--effort-rate", x, *brief) for x in (1e6, 40.0))
    assert loose["rate_violations"] == tight["rate_violations"] == 0
    assert loose["max_rate_ratio"] < 1e-2 and tight["max_rate_ratio"] == pytest.approx(1.0)
    spec = tmp_path / "slow.yaml"
    spec.write_text(f"urdf: {two_link.model.urdf}\neffort_rate: 40\nbarrier: {{gamma: 15}}\nbody: [{{frame: tip}}]\n")
    found = told("info", spec)
    assert [j["effort_rate"] for j in found["joints"]] == [40.0, 40.0]
    most = 2.0 * 40.0 / two_link.model.u_max.max()
    warning = f"gamma 15 is too fast for effort_rate, rows will often be infeasible: give at most {most:.2g}"
    assert warning in found["warnings"]
    assert told("info", "two_link")["joints"][0]["effort_rate"] is None
    wrong = CliRunner().invoke(app, ["simulate", "two_link", "circle", "--effort-rate", "-1"])
    assert isinstance(wrong.exception, InputError)
    assert str(wrong.exception) == "--effort-rate: must be a positive finite number, got -1"
