"""The runtime filter: nothing bad that comes in (states, torques, solvers, weights) leads to a bad torque, the filter
recovers, and its conventions are what its documentation says."""

from __future__ import annotations

import dataclasses
import gc
import logging
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

import ppcbf_robots
from ppcbf_robots.engines import PinocchioEngine
from ppcbf_robots.errors import InputError
from ppcbf_robots.filters import FilterConfig, Status
from ppcbf_robots.problem import load_problem
from ppcbf_robots.qp import make_solver
from ppcbf_robots.qp_filter import QPRows
from ppcbf_robots.resources import find_world
from ppcbf_robots.rollout import simulate
from ppcbf_robots.safety_filter import SafetyFilter, StepResult
from ppcbf_robots.shapes import Motion
from ppcbf_robots.specs import BarrierSpec

ALARMS = (Status.FAULT, Status.INVALID, Status.STOP)

BAD_ANSWERS = {
    "nothing": lambda p: None,
    "nan": lambda p: np.full(len(p.g), np.nan),
    "infinite": lambda p: np.full(len(p.g), -np.inf),
    "zero": lambda p: np.zeros(len(p.g)),
    "huge": lambda p: np.full(len(p.g), 1e30),
    "wrong side": lambda p: -1e3 * p.C[0],
    "wrong length": lambda p: np.zeros(len(p.g) + 2),
    "scalar": lambda p: np.array(0.0),
}


@pytest.mark.parametrize("answer", BAD_ANSWERS)
@pytest.mark.parametrize("gravity_included", [True, False])
def test_a_bad_solver_never_leads_to_a_bad_torque(panda, answer, gravity_included):
    class Stub:
        def solve(self, problem):
            return BAD_ANSWERS[answer](problem)

    model = panda.model
    barrier = panda.barrier("lb-cbf", spec=BarrierSpec())
    filter_ = SafetyFilter(model, panda.safety, barrier, gravity_included=gravity_included)
    filter_.correction.solver = Stub()
    q, v = panda.robot.start, np.array([2.0, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0])
    towards = model.gravity(q) + 40.0 * np.eye(7)[0]
    result = filter_.step(0.0, q, v, towards, 0.0)
    assert result.status is Status.FAULT  # a claim that does not hold is no answer either
    total = result.u if gravity_included else result.u + model.gravity(q)
    assert np.all(np.isfinite(total))
    assert np.all(np.abs(total) <= model.u_max + 1e-9)
    if result.status is Status.FAULT:
        g = model.gravity(q)
        np.testing.assert_allclose(total, np.clip(g - filter_.damping * v, -model.u_max, model.u_max), atol=1e-9)


def test_unknown_solver_names_the_installed_ones():
    with pytest.raises(InputError) as error:
        make_solver("nosuch")
    assert str(error.value).startswith("QP solver 'nosuch' is not installed (available: ")


# ---------------------------------------------------------------------------------------------- bad input

anything = st.floats(allow_nan=True, allow_infinity=True)
vectors = st.one_of(
    st.lists(anything, min_size=2, max_size=2),
    st.lists(st.floats(-5.0, 5.0), min_size=0, max_size=4),
    st.just([np.nan, 0.0]),
    st.just([[0.0, 0.0]]),
    anything,
)


@pytest.mark.filterwarnings("ignore:overflow", "ignore:invalid value", "ignore:divide by zero")
@settings(max_examples=300)
@given(t=anything, q=vectors, v=vectors, u_des=vectors, d_p=st.none() | anything, included=st.booleans())
@pytest.mark.parametrize("robot", ["cartpole", "two_link"])
def test_whatever_comes_in_a_finite_torque_in_the_box_comes_out(problems, robot, t, q, v, u_des, d_p, included):
    problem = problems[robot]
    model = problem.model
    filter_ = SafetyFilter(model, problem.safety, problem.barrier("lb-cbf"), gravity_included=included)
    start, rest = problem.robot.start, np.zeros(2)
    first = filter_.step(0.0, start, rest, model.gravity(start) * included, 0.0)
    assert first.status is Status.FREE
    result = filter_.step(t, q, v, u_des, d_p)
    state = [np.asarray(x, float) for x in (q, v)]
    valid = np.isfinite(t) and t >= 0.0 and all(x.shape == (2,) and np.all(np.isfinite(x)) for x in state)
    valid = valid and bool(np.all(np.abs(state[0] - start) <= 10.0 * model.v_max * max(t, 1e-3)))  # or it has jumped
    assert np.all(np.isfinite(result.u))
    assert result.u.shape == (2,)
    offset = model.evaluate(*state).g if valid and not included else 0.0
    assert np.all(np.abs(result.u + offset) <= model.u_max * (1 + 1e-12) + 1e-12)
    if not valid:
        assert result.status in (Status.INVALID, Status.STOP)
        assert filter_.step(0.0, start, rest, model.gravity(start) * included, 0.0).status is Status.FREE  # recovered
    usable = np.shape(u_des) == (2,) and np.all(np.isfinite(u_des)) and (d_p is None or np.isfinite(d_p))
    if valid and not usable:
        assert result.status is Status.FAULT
    assert result.status in ALARMS or (valid and usable)


@pytest.mark.parametrize(
    ("t", "q", "reason"),
    [
        (0.01, [np.nan, 0.0], "state not finite"),
        (0.01, [0.3], "state of shape (1,), (2,) instead of (2,), (2,)"),
        (-1.0, [0.3, 0.4], "time went backwards, from 0 s to -1 s"),
        (np.nan, [0.3, 0.4], "time not a finite number"),
    ],
)
def test_invalid_states_are_bridged_with_gravity_then_stop(two_link, t, q, reason):
    model = two_link.model
    filter_ = SafetyFilter(model, two_link.safety, two_link.barrier("lb-cbf"))
    start, g = two_link.robot.start, model.gravity(two_link.robot.start)
    filter_.step(0.0, start, np.zeros(2), g, 0.0)
    bridged = filter_.step(t, q, np.zeros(2), g, 0.0)
    assert (bridged.status, bridged.reason) == (Status.INVALID, reason)
    np.testing.assert_allclose(bridged.u, g)
    assert filter_.step(0.0201, [np.nan, 0.0], np.zeros(2), g, 0.0).status is Status.STOP
    assert filter_.step(0.03, start, np.zeros(2), g, 0.0).status is Status.FREE
    assert filter_.counts[Status.STOP] == 1


def test_a_stopped_clock_does_not_stretch_the_bridge(two_link):
    """Without progress of the caller's clock the invalid steps themselves are counted: 20 of 1 ms, then STOP."""
    model, start = two_link.model, two_link.robot.start
    filter_ = SafetyFilter(model, two_link.safety, two_link.barrier("lb-cbf"))
    filter_.step(0.0, start, np.zeros(2), model.gravity(start), 0.0)
    statuses = [filter_.step(0.0, [np.nan, 0.0], np.zeros(2), np.zeros(2)).status for _ in range(30)]
    assert statuses == [Status.INVALID] * 20 + [Status.STOP] * 10
    filter_.reset()
    assert filter_.step(-5.0, start, np.zeros(2), model.gravity(start), 0.0).status is Status.FREE


@pytest.mark.parametrize("case", ["limit", "obstacle"])
def test_noise_near_rest_buys_no_power_with_full_torque(two_link, panda, case):
    """Measured velocity of an arm at rest is noise; the torque must stay smooth and energy must not come in."""
    problem, rng = (panda, np.random.default_rng(0)) if case == "limit" else (two_link, np.random.default_rng(1))
    model = problem.model
    if case == "limit":  # joint 7 pressed against its upper limit
        q, goal = problem.robot.start.copy(), problem.robot.start.copy()
        q[6], goal[6] = model.q_upper[6] - 1e-4, model.q_upper[6] + 0.6
    else:
        q, goal = problem.robot.start, np.array([0.9, 0.5])  # inside the circle
    problem = problem.with_goal(goal)
    if case == "obstacle":  # come to rest at the circle first
        plain = SafetyFilter(model, problem.safety, problem.barrier("lb-cbf"))
        q = simulate(problem.safety, problem.robot.controller, plain, q, np.zeros(2), 6.0, 5e-3).q[-1]
    filter_ = SafetyFilter(model, problem.safety, problem.barrier("lb-cbf"))
    torques = []
    for i in range(300):
        v = 1e-3 * rng.standard_normal(model.nv)
        nominal = problem.robot.controller.evaluate(model.evaluate(q, v))
        torques.append(filter_.step(1e-3 * i, q, v, nominal.u, float(nominal.d_p)).u)
    assert filter_.counts[Status.FREE] < 300
    assert np.max(np.abs(np.diff(torques, axis=0)) / model.u_max) < 0.05


def test_bad_settings_are_refused(two_link):
    for bad in ({"kind": "foo"}, {"metric": "Kinetic"}, {"alpha": np.nan}, {"alpha": -1.0}, {"margin": np.nan}):
        with pytest.raises(InputError, match=f"filter {next(iter(bad))}: "):
            FilterConfig(**bad)
    with pytest.raises(InputError, match="damping: expected 2 finite numbers"):
        SafetyFilter(two_link.model, two_link.safety, two_link.barrier("lb-cbf"), damping=np.full(2, np.nan))


def test_an_invalid_first_state_stops(two_link):
    filter_ = SafetyFilter(two_link.model, two_link.safety, two_link.barrier("lb-cbf"))
    result = filter_.step(0.0, [np.nan, 0.0], [0.0, 0.0], [0.0, 0.0])
    assert result.status is Status.STOP
    np.testing.assert_array_equal(result.u, 0.0)


def test_a_continuous_joint_off_the_unit_circle_is_invalid(kinova):
    filter_ = SafetyFilter(kinova.model, kinova.safety, kinova.barrier("lb-cbf"))
    q = kinova.robot.start.copy()
    q[kinova.model.idx_q[kinova.model.continuous][0]] += 0.1
    result = filter_.step(0.0, q, np.zeros(6), np.zeros(6))
    assert result.reason == "a continuous joint's (cos, sin) is not of length 1: engage the brakes"


@pytest.mark.parametrize(
    ("u_des", "d_p"), [([np.nan, 0.0], 0.0), ([0.0], 0.0), ([0.0, 0.0], np.nan), ([0.0, 0.0], np.inf)]
)
def test_bad_torques_are_answered_with_damping(two_link, u_des, d_p):
    model, damping = two_link.model, np.array([3.0, 2.0])
    filter_ = SafetyFilter(model, two_link.safety, two_link.barrier("lb-cbf"), damping=damping)
    q, v = two_link.robot.start, np.array([0.5, -0.5])
    result = filter_.step(0.0, q, v, u_des, d_p)
    assert result.status is Status.FAULT
    np.testing.assert_allclose(result.u, model.gravity(q) - damping * v)


def test_a_network_that_returns_nan_is_a_fault(panda, make_barrier):
    barrier = make_barrier(panda, "pp-ncbf-mlp")
    barrier.network.params["w_out"][0] = np.nan
    filter_ = SafetyFilter(panda.model, panda.safety, barrier)
    result = filter_.step(0.0, panda.robot.start, np.full(7, 0.1), np.zeros(7), 0.0)
    assert result.status is Status.FAULT
    assert np.all(np.isfinite(result.u))


# ---------------------------------------------------------------------------------------------- conventions


@pytest.mark.parametrize("kind", ["qp", "closed-form"])
def test_without_gravity_the_same_torque_less_gravity(panda, states, kind):
    """libfranka's convention: u_des and the returned torque leave g out."""
    config = FilterConfig(kind=kind)
    barrier = panda.barrier("lb-cbf", spec=BarrierSpec())
    both = [SafetyFilter(panda.model, panda.safety, barrier, config, gravity_included=x) for x in (True, False)]
    for i, (q, v) in enumerate(states(panda, 150)):
        dyn = panda.model.evaluate(q, 0.6 * v)
        nominal = panda.robot.controller.evaluate(dyn)
        with_g, without = (f.step(float(i), q, 0.6 * v, nominal.u - x, float(nominal.d_p))
                           for f, x in zip(both, (0.0, dyn.g), strict=True))  # fmt: skip
        assert with_g.status is without.status
        np.testing.assert_allclose(without.u, with_g.u - dyn.g, atol=1e-6 * panda.model.u_max.max())
    assert both[0].counts[Status.CORRECTING] > 5


def test_steps_report_h_phi_and_row(two_link):
    model = two_link.model
    filter_ = SafetyFilter(model, two_link.safety, two_link.barrier("lb-cbf"), FilterConfig(alpha=10.0))
    q = np.array([0.3, 0.541])
    dyn = model.evaluate(q, np.zeros(2))
    rows = filter_.barrier.rows(dyn, two_link.safety.evaluate(dyn))
    result = filter_.step(0.0, q, np.zeros(2), dyn.b - 5.0 * rows.Lg_phi[0], 0.0)
    assert (result.h, result.phi) == (pytest.approx(rows.h.min()), pytest.approx(rows.phi.min()))
    assert result.status is Status.CORRECTING
    assert result.row == "tip#0 / circle"
    assert filter_.counts == {**dict.fromkeys(Status, 0), Status.CORRECTING: 1}


def test_alarms_are_logged_once_per_change(two_link, caplog):
    filter_ = SafetyFilter(two_link.model, two_link.safety, two_link.barrier("lb-cbf"))
    q, bad = two_link.robot.start, [np.nan, 0.0]
    with caplog.at_level("WARNING", logger="ppcbf_robots"):
        for i in range(5):
            filter_.step(0.001 * i, q, np.zeros(2), bad)
    assert [r.getMessage() for r in caplog.records] == ["FAULT: u_des, d_p or the barrier is not finite "]


def test_config_is_frozen():
    with pytest.raises(dataclasses.FrozenInstanceError):
        FilterConfig().alpha = 3.0


# ---------------------------------------------------------------------------------------------- obstacles that move


def drive_ball(problem, start, velocity, goal, duration):
    """The ball of the world moves from ``start`` at constant velocity while the arm holds or seeks its goal.

    Returns least h, largest torque over its limit, statuses, energy put in at the obstacle's port and rise of V [J].
    """
    model, barrier = problem.model, problem.barrier("lb-cbf")
    controller = problem.robot.controller.with_goal(goal)
    filter_ = SafetyFilter(model, problem.safety, barrier, damping=controller.gains.kd)
    engine = PinocchioEngine(model)
    engine.reset(problem.robot.start, np.zeros(model.nv))
    least, torque, port, statuses, V = np.inf, 0.0, 0.0, [], []
    for i in range(round(duration / 1e-3)):
        t = i * 1e-3
        q, v = engine.state()
        ball = Motion(xyz=start + t * velocity, velocity=velocity)
        nominal = controller.evaluate(model.evaluate(q, v))
        result = filter_.step(t, q, v, nominal.u, float(nominal.d_p), {"ball": ball})
        least, torque = min(least, result.h), max(torque, float(np.max(np.abs(result.u) / model.u_max)))
        port += 1e-3 * result.port_power
        statuses.append(result.status)
        V.append(float(nominal.V))
        engine.advance(result.u, 5e-4, 2)
    rise = float(np.max(np.array(V) - np.minimum.accumulate(V)))
    return least, torque, statuses, port, rise


def test_a_ball_driven_at_a_resting_arm_is_evaded(panda):
    """The arm rests at its goal; a ball comes at its hand with 0.2 m/s and pushes it away without touching it."""
    hand = panda.safety.points.kinematics(panda.model.evaluate(panda.robot.start, np.zeros(7))).p[-1]
    away = np.array([0.0, 0.35, 0.0])
    start = panda.robot.start
    least, torque, statuses, port, rise = drive_ball(panda, hand + away, np.array([0.0, -0.2, 0.0]), start, 2.0)
    assert least > -1e-3
    assert torque <= 1.0 + 1e-9
    assert Status.CORRECTING in statuses and Status.INFEASIBLE not in statuses
    assert rise > 0.05  # the obstacle does work on the arm,
    assert port == pytest.approx(rise, rel=0.5)  # and it is accounted at its port


def test_a_ball_driven_across_a_moving_arm_is_avoided(panda):
    velocity = np.array([0.0, -0.15, 0.0])
    least, torque, statuses, _, _ = drive_ball(panda, np.array([0.5, 0.3, 0.5]), velocity, panda.robot.goal, 4.0)
    assert least > -1e-3
    assert torque <= 1.0 + 1e-9
    assert Status.CORRECTING in statuses


def test_a_far_obstacle_that_comes_closer_is_no_reason_to_give_up_passivity(two_link, tmp_path):
    """Only rows that u_des really breaks are; where the world's own circle asks for energy, that is an alarm."""
    far = {"name": "far", "type": "sphere", "center": [8.0, 0.0, 0.0], "radius": 0.1}
    world = yaml.safe_load(find_world("circle").read_text())
    (tmp_path / "w.yaml").write_text(yaml.safe_dump({"obstacles": [*world["obstacles"], far]}))
    problem = load_problem("two_link", str(tmp_path / "w.yaml"))
    model, rng, dropped = problem.model, np.random.default_rng(0), 0
    motion = {"far": Motion(xyz=np.array([8.0, 0.0, 0.0]), velocity=np.array([-0.14, 0.0, 0.0]))}
    for _ in range(500):
        q, v = model.from_angles(problem.robot.domain.sample_q(rng, 1)[0]), problem.robot.domain.sample_v(rng, 1)[0]
        u = model.gravity(q) + rng.uniform(-1.0, 1.0, 2) * model.u_max
        alone, beside = (
            SafetyFilter(model, problem.safety, problem.barrier("lb-cbf")).step(0.0, q, v, u, 0.0, motions)
            for motions in (None, motion)
        )
        assert beside.port_power == 0.0 and beside.status == alone.status
        np.testing.assert_allclose(beside.u, alone.u, atol=1e-6)
        dropped += alone.status is Status.PASSIVITY_DROPPED
    assert dropped > 3


def test_the_least_violation_is_that_of_all_rows(panda):
    """Sixteen rows ask z0 for 0.8 and above, one more for -0.5 and below: the middle serves all of them best."""
    filter_ = SafetyFilter(panda.model, panda.safety, panda.barrier("lb-cbf")).correction
    C, ones = np.zeros((17, 7)), np.ones(17)
    C[:, 0], lower = np.append(ones[:16], -1.0), np.append(0.8 + 0.01 * np.arange(16), 0.5)
    box = -np.ones(7), np.ones(7)
    qp = QPRows(C, lower, ones, ones > 0.0, np.arange(17), 17, np.eye(7), box, "box")
    z = filter_._least_violation(qp)
    assert float((lower - C @ z).max()) == pytest.approx(0.5 * (0.95 + 0.5), abs=1e-3)


def test_without_its_motion_the_same_ball_hits(panda, monkeypatch):
    """Told only where the ball is, not how it moves, the filter comes too late: the terms of the motion are needed."""
    hand = panda.safety.points.kinematics(panda.model.evaluate(panda.robot.start, np.zeros(7))).p[-1]
    monkeypatch.setattr("ppcbf_robots.shapes.Packed.moved", without_velocity(type(panda.safety.packed).moved))
    start = hand + np.array([0.0, 0.35, 0.0])
    least, *_ = drive_ball(panda, start, np.array([0.0, -1.0, 0.0]), panda.robot.start, 0.4)
    monkeypatch.undo()
    told, *_ = drive_ball(panda, start, np.array([0.0, -1.0, 0.0]), panda.robot.start, 0.4)
    assert least < told - 5e-3


def without_velocity(moved):
    """``Packed.moved`` that forgets velocities."""
    return lambda packed, motions: moved(
        packed, {k: dataclasses.replace(m, velocity=np.zeros(3)) for k, m in motions.items()}
    )


BAD_MOTIONS = {
    "of no obstacle": {"cat": Motion()},
    "not finite": {"ball": Motion(velocity=np.array([np.nan, 0.0, 0.0]))},
    "lost by the tracker": {"ball": None},
    "one number": {"ball": Motion(xyz=np.array([0.5]))},
    "two numbers": {"ball": Motion(xyz=np.array([0.5, 0.0]))},
    "no velocity": {"ball": Motion(velocity=None)},
    "words": {"ball": Motion(xyz="here")},
    "flat": {"ball": Motion(rotation=np.zeros((3, 3)))},
    "stretched": {"ball": Motion(rotation=2.0 * np.eye(3))},
    "mirrored": {"ball": Motion(rotation=np.diag([1.0, 1.0, -1.0]))},
    "small": {"ball": Motion(rotation=np.eye(2))},
    "a list": [("obstacle", Motion())],
}


@pytest.mark.parametrize("motion", BAD_MOTIONS.values(), ids=BAD_MOTIONS)
def test_a_motion_that_cannot_be_used_is_a_fault(panda, motion):
    filter_ = SafetyFilter(panda.model, panda.safety, panda.barrier("lb-cbf"))
    result = filter_.step(0.0, panda.robot.start, np.zeros(7), np.zeros(7), 0.0, motion)
    assert result.status is Status.FAULT
    assert np.all(np.abs(result.u) <= panda.model.u_max)
    assert "obstacle" in result.reason


@pytest.mark.parametrize("d_p", ["x", [0.1, 0.2], np.array([0.1]), np.inf, 10**400, 1j])
def test_a_dissipation_that_is_no_number_is_a_fault(two_link, d_p):
    model, q = two_link.model, two_link.robot.start
    filter_ = SafetyFilter(model, two_link.safety, two_link.barrier("lb-cbf"))
    result = filter_.step(0.0, q, np.zeros(2), model.gravity(q), d_p)
    assert result.status is Status.FAULT and np.all(np.abs(result.u) <= model.u_max)
    assert filter_.step(0.001, q, np.zeros(2), model.gravity(q), np.array(0.1)).status is Status.FREE
    assert filter_.step(10**400, q, np.zeros(2), model.gravity(q)).status is Status.INVALID


def test_every_new_reason_of_an_alarm_is_logged_and_lasting_ones_once(two_link, caplog):
    model, q = two_link.model, two_link.robot.start
    filter_ = SafetyFilter(model, two_link.safety, two_link.barrier("lb-cbf"))
    g, rest = model.gravity(q), np.zeros(2)
    for i in range(3):
        filter_.step(1e-3 * i, q, rest, [np.nan, 0.0])
    for i in range(3, 6):
        filter_.step(1e-3 * i, q, rest, g, motions={"cat": Motion()})
    for i in range(3):
        filter_.step(0.001 - 1e-4 * i, q, rest, g)  # backwards, by another number every time
    filter_.reset()
    filter_.step(0.0, q, rest, [np.nan, 0.0])
    said = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert [" ".join(line.split()[:3]) for line in said] == [
        "FAULT: u_des, d_p", "FAULT: no obstacle", "INVALID: time went", "FAULT: u_des, d_p"
    ]  # fmt: skip


def test_the_way_to_the_lb_barrier_and_back_is_logged(panda, make_barrier, caplog):
    filter_ = SafetyFilter(panda.model, panda.safety, make_barrier(panda, "pp-ncbf-convex"))
    q, v, g = panda.robot.start, np.zeros(7), panda.model.gravity(panda.robot.start)
    for i, motions in enumerate((None, {"ball": Motion()}, {"ball": Motion()}, None)):
        filter_.step(1e-3 * i, q, v, g, None, motions)
    said = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert said == ["obstacles are elsewhere: K = 0 until they are back", "obstacles are back: K is, too"]


def test_learned_terms_are_left_out_while_an_obstacle_moves(panda, make_barrier):
    learned = SafetyFilter(panda.model, panda.safety, make_barrier(panda, "pp-ncbf-convex"))
    blind = SafetyFilter(panda.model, panda.safety, panda.barrier("lb-cbf"))
    v = np.full(7, 0.3)
    u = panda.model.gravity(panda.robot.start)
    args = 0.0, panda.robot.start, v, u, None, {"ball": Motion(xyz=np.array([0.5, 0.1, 0.5]))}
    np.testing.assert_allclose(learned.step(*args).u, blind.step(*args).u)


@pytest.mark.parametrize("metric", ["torque", "kinetic"])
def test_the_energy_barriers_damper_is_told_of_a_moving_obstacle(two_link, metric):
    """At the velocity v⁺ that the period ends with, ``phi̇ = -gamma_K phi`` for the circle where it is, as it moves."""
    model, barrier = two_link.model, two_link.barrier("pp-cbf")
    config = FilterConfig(kind="closed-form", metric=metric)
    q, v = two_link.robot.start, np.array([-0.3, -0.3])
    dyn = model.evaluate(q, v)
    tip = two_link.safety.points.kinematics(dyn).p[-1]
    velocity = np.array([-0.02, 0.01, 0.0])

    def h(t: float, center: np.ndarray) -> tuple[float, np.ndarray]:
        """Distance and gradient with the circle t [s] ahead."""
        rows = two_link.safety.evaluate(dyn, two_link.safety.packed.moved({"circle": Motion(center + t * velocity)}))
        return rows.h[0], rows.grad[0]

    def step(center: np.ndarray) -> StepResult:
        filter_ = SafetyFilter(model, two_link.safety, barrier, config)
        return filter_.step(0.0, q, v, dyn.g, 0.0, {"circle": Motion(center, velocity=velocity)})

    near = tip + np.array([0.24, 0.0, 0.0])
    u = step(near).u
    assert step(tip + np.array([2.0, 0.0, 0.0])).status is Status.FREE
    distance, grad = h(0.0, near)
    h_t = (h(1e-6, near)[0] - h(-1e-6, near)[0]) / 2e-6
    after = v + config.dt * dyn.Minv @ (u - dyn.b)
    spec = barrier.spec
    phi_dot = spec.alpha_pp * (grad @ after + h_t) - after @ (u - dyn.g)
    phi = spec.alpha_pp * distance - 0.5 * after @ dyn.M @ after
    assert not np.allclose(u, dyn.g)
    assert phi_dot + spec.gamma_K * phi == pytest.approx(0.0, abs=1e-2 * spec.alpha_pp * abs(h_t))


def test_a_state_with_a_bad_motion_still_counts_as_valid(two_link):
    """The state was good: an invalid one after it is bridged with its gravity, not answered by STOP."""
    filter_ = SafetyFilter(two_link.model, two_link.safety, two_link.barrier("lb-cbf"))
    q, g = two_link.robot.start, two_link.model.gravity(two_link.robot.start)
    assert filter_.step(1.0, q, np.zeros(2), g, 0.0, {"cat": Motion()}).status is Status.FAULT
    bridged = filter_.step(1.001, [np.nan, 0.0], np.zeros(2), g, 0.0)
    assert bridged.status is Status.INVALID
    np.testing.assert_allclose(bridged.u, g)


# ---------------------------------------------------------------------------------------------- the domain X


def test_a_filtered_arm_stays_in_its_domain(panda):
    """Torques that would race through the velocity and position ranges of X: every state stays inside."""
    model, domain = panda.model, panda.robot.domain
    filter_ = SafetyFilter(model, panda.safety, panda.barrier("lb-cbf"))
    rng = np.random.default_rng(0)
    engine = PinocchioEngine(model)
    engine.reset(panda.robot.start, np.zeros(7))
    fastest = np.zeros(7)
    for i in range(2000):
        q, v = engine.state()
        if i % 400 == 0:
            push = rng.choice([-1.0, 1.0], 7) * model.u_max
        u = filter_.step(i * 1e-3, q, v, push).u
        engine.advance(u, 5e-4, 2)
        fastest = np.maximum(fastest, np.abs(v) / domain.v[:, 1])
        assert np.all(np.abs(v) <= domain.v[:, 1])
        assert np.all((q >= domain.q[:, 0] - 1e-3) & (q <= domain.q[:, 1] + 1e-3))
    assert fastest.max() > 0.9  # it was tried


def test_no_memory_grows_from_step_to_step(panda, make_barrier, states, monkeypatch):
    model, controller = panda.model, panda.robot.controller
    safe = SafetyFilter(model, panda.safety, make_barrier(panda, "pp-ncbf-convex"))
    asked = [(q, v, controller.evaluate(model.evaluate(q, v))) for q, v in states(panda, 50)]

    def run(rounds: int) -> None:
        for i in range(rounds):
            for q, v, nominal in asked:
                safe.filter(model.evaluate(q, v), nominal.u, float(nominal.d_p), t=1e-3 * i)
                safe.step(1e-3 * i, q, v, nominal.u, float(nominal.d_p))

    def held() -> int:
        gc.collect()
        own = tracemalloc.Filter(True, str(Path(ppcbf_robots.__file__).parent / "*"))  # not other tests' threads
        return sum(x.size for x in tracemalloc.take_snapshot().filter_traces([own]).traces)

    monkeypatch.setattr(logging.root.manager, "disable", logging.CRITICAL)  # pytest keeps every record
    run(1)
    tracemalloc.start()
    grown = []
    for _ in range(4):
        before = held()
        run(5)
        grown.append(held() - before)
    tracemalloc.stop()
    assert min(grown) < 5_000  # of 500 steps, once all is warm; 7 numbers a step would be 28,000
