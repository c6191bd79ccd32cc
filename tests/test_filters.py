"""Torque corrections: the answers are the least ones by independent solvers, every promise is checked on the answer
itself, and problems without a solution are reported as such."""

from __future__ import annotations

import time

import numpy as np
import pytest
import qpsolvers
from hypothesis import given, settings
from hypothesis import strategies as st

from ppcbf_robots import qp_filter
from ppcbf_robots.barriers import EnergyBarrier, RhoBarrier
from ppcbf_robots.closed_form import ClosedForm
from ppcbf_robots.filters import FilterConfig, Status, free_power
from ppcbf_robots.problem import load_problem
from ppcbf_robots.qp import QPProblem, make_solver
from ppcbf_robots.qp_filter import QPFilter
from ppcbf_robots.robot import RobotModel
from ppcbf_robots.rollout import simulate
from ppcbf_robots.safety import SafetyFunction
from ppcbf_robots.safety_filter import SafetyFilter
from ppcbf_robots.specs import BarrierSpec
from ppcbf_robots.world import HalfSpace

METRICS = ["torque", "kinetic"]


def rows_at(problem, barrier, q, v):
    dyn = problem.model.evaluate(q, v)
    safety = problem.safety.evaluate(dyn)
    return dyn, safety, barrier.rows(dyn, safety)


def qp_slack(barrier, rows, u, config):
    """What the QP's rows ask to be >= 0."""
    if barrier.kind == "pp-cbf":
        return rows.psi(u) + barrier.spec.gamma_K * rows.phi
    separating = np.maximum(0.0, np.minimum(rows.hdot, rows.phi))
    return rows.psi(u) + config.alpha * (rows.phi - config.margin) + config.fast_alpha * separating


def weight(dyn, metric):
    return np.eye(len(dyn.v)) if metric == "torque" else dyn.Minv


# ---------------------------------------------------------------------------------------------- closed form


@pytest.mark.parametrize("metric", METRICS)
def test_closed_form_brings_psi_to_zero(problem, states, make_barrier, metric):
    """Eq. (13): psi(u) = 0 on the corrected row, along L_g phi or w, and nothing where psi(u_des) >= 0."""
    barrier, model = make_barrier(problem, "pp-ncbf-convex"), problem.model
    closed_form = ClosedForm(barrier, FilterConfig(kind="closed-form", metric=metric))
    rng, seen = np.random.default_rng(0), dict.fromkeys(Status, 0)
    for q, v in states(problem, 300):
        dyn, safety, rows = rows_at(problem, barrier, q, v)
        u_des = rng.uniform(-1.0, 1.0, model.nv) * model.u_max
        answer = closed_form.correct(dyn, safety, rows, u_des, None, model.u_max)
        seen[answer.status] += 1
        if answer.status is Status.FREE:
            np.testing.assert_array_equal(answer.u, u_des)
            continue
        k, delta = answer.row, answer.u - u_des
        assert rows.psi(u_des)[k] < 0.0
        assert rows.psi(answer.u)[k] == pytest.approx(0.0, abs=1e-6)
        direction = rows.Lg_phi[k] if metric == "torque" else rows.w[k]
        cosine = delta @ direction / (np.linalg.norm(delta) * np.linalg.norm(direction))
        assert cosine == pytest.approx(1.0)
    assert seen[Status.CORRECTING] > 5
    assert seen[Status.FREE] > 5


def test_closed_form_acts_only_in_its_band(cartpole, two_link):
    """phi <= epsilon, also below 0; the 2R's acts by distance too (paper, §5.2)."""
    for problem, q, v, acts in (
        (cartpole, [1.4, 0.0], [2.0, 0.0], True),  # phi = -2 + 5 · 0.1 < 0
        (cartpole, [0.5, 0.0], [2.0, 0.0], False),  # phi = -2 + 5 · 1 > 0.05
        (two_link, [0.3, 0.5], [0.0, 0.0], True),  # h = 0.047, phi = 0.23
        (two_link, [0.3, 0.4], [1.0, 0.0], True),  # h = 0.071, phi < 0
        (two_link, [0.3, 0.4], [0.0, 0.0], False),  # h = 0.071 > 0.05, phi = 0.35
    ):
        barrier = problem.barrier("lb-cbf")
        dyn, safety, rows = rows_at(problem, barrier, np.array(q), np.array(v))
        closed_form = ClosedForm(barrier, FilterConfig(kind="closed-form", metric="torque"))
        towards = dyn.b - 1e3 * rows.Lg_phi[0]
        status = closed_form.correct(dyn, safety, rows, towards, None, problem.model.u_max).status
        assert (status is Status.CORRECTING) == acts


def test_energy_barrier_closed_form_rests_without_chatter(two_link):
    """Where L_g phi = -vᵀ vanishes the torque stays smooth: pressed to rest on the obstacle, it changes by mN m."""
    config = FilterConfig(kind="closed-form", metric="torque")
    problem = two_link.with_goal(np.array([0.9, 0.5]))  # inside the obstacle
    filter_ = SafetyFilter(problem.model, problem.safety, problem.barrier("pp-cbf"), config)
    run = simulate(problem.safety, problem.robot.controller, filter_, problem.robot.start, np.zeros(2), 3.0)
    assert run.h.min() > -1e-3
    assert run.active[-200:].all()
    assert np.abs(run.v[-200:]).max() < 0.05
    assert np.abs(np.diff(run.u[-200:], axis=0)).max() < 0.01
    assert np.abs(np.diff(run.u, axis=0)).max() < 3.0


# ---------------------------------------------------------------------------------------------- QP: optimality


def speed_rows(dyn, v_domain, u_des, alpha):
    """``v̇ >= -alpha (v - low)`` and ``-v̇ >= -alpha (high - v)`` as rows of u, and their slack at u_des."""
    if not len(v_domain):
        return np.zeros((0, len(dyn.v))), np.zeros(0)
    a = dyn.Minv @ (u_des - dyn.b)
    slack = np.concatenate([a + alpha * (dyn.v - v_domain[:, 0]), -a + alpha * (v_domain[:, 1] - dyn.v)])
    return np.vstack([dyn.Minv, -dyn.Minv]), slack


def reference_qp(dyn, rows, u_des, d_p, u_max, barrier, config, v_domain=()):
    """The whole QP, every row at once, by DAQP: the torque, or None if infeasible."""
    H = weight(dyn, config.metric) * np.outer(u_max, u_max)
    speed, slack = speed_rows(dyn, v_domain, u_des, config.fast_alpha)
    C = np.vstack([rows.Lg_phi, speed]) * u_max
    lower = -np.concatenate([qp_slack(barrier, rows, u_des, config), slack])
    if d_p is not None:
        C, lower = np.vstack([C, -dyn.v * u_max]), np.append(lower, -d_p)
    scale = np.linalg.norm(C, axis=1)
    box = -1.0 - u_des / u_max, 1.0 - u_des / u_max
    n = len(u_max)
    qp = qpsolvers.Problem(H * n / np.trace(H), np.zeros(n), -C / scale[:, None], -lower / scale, lb=box[0], ub=box[1])
    solution = qpsolvers.solve_problem(qp, solver="daqp")
    return u_des + solution.x * u_max if solution.found else None


@pytest.mark.parametrize("metric", METRICS)
def test_qp_is_the_least_correction_over_all_rows(problem, states, make_barrier, metric, monkeypatch):
    """Against an active-set solver that is given every row, on random states; statuses must agree as well."""
    monkeypatch.setattr(qp_filter, "CUTS", 0)  # rows whose psi is taken as it is
    model, barrier, config = problem.model, make_barrier(problem, "pp-ncbf-convex"), FilterConfig(metric=metric)
    runtime, seen = QPFilter(barrier, problem.safety, config), dict.fromkeys(Status, 0)
    v_domain = problem.safety.v_domain
    for q, v in states(problem, 120):
        dyn, safety, rows = rows_at(problem, barrier, q, 0.5 * v)
        if rows.h.min() < 0.0:
            continue
        nominal = problem.robot.controller.evaluate(dyn)
        answer = runtime.correct(dyn, safety, rows, nominal.u, float(nominal.d_p), model.u_max)
        budget = float(nominal.d_p) + free_power(model)
        expected = reference_qp(dyn, rows, nominal.u, budget, model.u_max, barrier, config, v_domain)
        status = Status.CORRECTING
        if expected is None:
            expected = reference_qp(dyn, rows, nominal.u, budget, model.u_max, barrier, config)
        if expected is None:
            expected = reference_qp(dyn, rows, nominal.u, None, model.u_max, barrier, config)
            status = Status.PASSIVITY_DROPPED
        seen[answer.status] += 1
        if expected is None:
            assert answer.status is Status.INFEASIBLE
        else:
            assert answer.status in (status, Status.FREE)
            np.testing.assert_allclose(answer.u / model.u_max, expected / model.u_max, atol=1e-4)
    assert seen[Status.CORRECTING] > 3


def exact_one_row(c, lower, low, high):
    """min ½|z|² with c·z >= lower in a box, exactly: z(λ) = clip(λ c) and c·z(λ) is piecewise linear and monotone.

    The optimal λ lies on the segment between two breakpoints; None if no point of the box satisfies the row.
    """
    if c @ np.where(c > 0, high, low) < lower:
        return None
    if c @ np.clip(0.0 * c, low, high) >= lower:
        return np.clip(0.0 * c, low, high)
    ends = np.concatenate([low, high]) / np.where(c == 0.0, np.inf, c)[np.r_[: len(c), : len(c)]]
    knots = np.concatenate([[0.0], np.sort(ends[ends > 0.0])])
    values = np.array([c @ np.clip(x * c, low, high) for x in knots])
    i = int(np.argmax(values >= lower))
    share = (lower - values[i - 1]) / (values[i] - values[i - 1])
    return np.clip((knots[i - 1] + share * (knots[i] - knots[i - 1])) * c, low, high)


@settings(max_examples=300)
@given(data=st.data())
def test_solvers_agree_with_the_exact_dual_of_one_row(data):
    """One row, a box and W = I: the dual is one-dimensional and can be solved by hand."""
    n = data.draw(st.integers(1, 7))
    number = st.floats(-1.0, 1.0).map(lambda x: round(x, 3))
    c = np.array(data.draw(st.lists(number, min_size=n, max_size=n)))
    u_des = np.array(data.draw(st.lists(st.floats(-1.5, 1.5), min_size=n, max_size=n)))
    if np.linalg.norm(c) < 0.05:
        return
    c = c / np.linalg.norm(c)
    low, high = -1.0 - u_des, 1.0 - u_des
    reach = c @ np.where(c > 0, high, low)
    lower = reach - data.draw(st.floats(-1.0, 2.0).filter(lambda x: abs(x) > 1e-3))
    expected = exact_one_row(c, lower, low, high)
    for solver in SOLVERS:
        z = solver.solve(QPProblem(np.eye(n), np.zeros(n), c[None], np.array([lower]), low, high))
        if expected is None:
            assert z is None
        else:
            np.testing.assert_allclose(z, expected, atol=1e-5)


SOLVERS = [make_solver(name) for name in ("proxqp", "daqp", "quadprog")]  # the last through qpsolvers


@pytest.mark.parametrize("solver", ["proxqp", "daqp", "quadprog"])
def test_one_row_filter_against_the_exact_dual(panda, states, solver):
    """The filter itself with one pair, torque metric and equal torque limits."""
    base = panda.model
    model = RobotModel(base.urdf, base.package_dirs, base.locked, effort=40.0)
    safety = SafetyFunction(model, panda.robot.body[-1:], panda.safety.obstacles, joint_limits=False)
    barrier, config = RhoBarrier("lb-cbf", model, BarrierSpec()), FilterConfig(metric="torque", solver=solver)
    qp_filter, rng, seen = QPFilter(barrier, safety, config), np.random.default_rng(1), set()
    for q, v in states(panda, 200):
        dyn = model.evaluate(q, rng.uniform(0.0, 12.0) * v)
        h = safety.evaluate(dyn)
        rows, u_des = barrier.rows(dyn, h), rng.uniform(-60.0, 60.0, 7)
        answer = qp_filter.correct(dyn, h, rows, u_des, None, model.u_max)
        slack = qp_slack(barrier, rows, u_des, config)[0]
        z = exact_one_row(rows.Lg_phi[0] * 40.0, -slack, -1.0 - u_des / 40.0, 1.0 - u_des / 40.0)
        seen.add(answer.status)
        if z is None:
            assert answer.status is Status.INFEASIBLE
        else:
            np.testing.assert_allclose(answer.u, u_des + 40.0 * z, atol=4e-3)
    assert {Status.CORRECTING, Status.INFEASIBLE} <= seen


def test_one_row_in_the_kinetic_metric_pushes_along_w(two_link, states):
    """Far from the torque bounds, δ = -w slack / (wᵀ M⁻¹ w): a contact force along w."""
    model, config = two_link.model, FilterConfig(metric="kinetic")
    safety = SafetyFunction(model, two_link.robot.body, two_link.safety.obstacles, joint_limits=False)
    barrier, corrected = RhoBarrier("lb-cbf", model, BarrierSpec()), 0
    qp_filter = QPFilter(barrier, safety, config)
    for q, v in states(two_link, 300):
        dyn = model.evaluate(q, v)
        h = safety.evaluate(dyn)
        rows = barrier.rows(dyn, h)
        slack, w = qp_slack(barrier, rows, dyn.b, config)[0], rows.w[0]
        expected = -w * slack / (w @ dyn.Minv @ w)
        if slack < 0.0 and np.all(np.abs(dyn.b + expected) < model.u_max):
            answer = qp_filter.correct(dyn, h, rows, dyn.b, None, model.u_max)
            np.testing.assert_allclose(answer.u - dyn.b, expected, atol=5e-3)
            corrected += 1
    assert corrected > 10


# ---------------------------------------------------------------------------------------------- QP: promises


@pytest.mark.parametrize("metric", METRICS)
@pytest.mark.parametrize("solver", ["proxqp", "daqp", "quadprog"])
def test_promises_hold_on_every_answer(problem, states, barrier_name, make_barrier, metric, solver):
    """In the box always; all rows and the passivity row where the status says so; u_des unchanged where it is FREE."""
    model, barrier = problem.model, make_barrier(problem, barrier_name)
    config, rng = FilterConfig(metric=metric, solver=solver), np.random.default_rng(2)
    qp_filter = QPFilter(barrier, problem.safety, config)
    for q, v in states(problem, 40):
        dyn, safety, rows = rows_at(problem, barrier, q, rng.uniform(0.0, 1.5) * v)
        nominal = problem.robot.controller.evaluate(dyn)
        u_des = nominal.u + rng.normal(0.0, 0.3, model.nv) * model.u_max
        d_p = float(nominal.d_p) if rng.uniform() < 0.7 else None
        answer = qp_filter.correct(dyn, safety, rows, u_des, d_p, model.u_max)
        if answer.status is Status.FAULT:  # a solver may give up on a hard problem, which SafetyFilter answers
            continue
        assert np.all(np.abs(answer.u) <= model.u_max)
        scale = np.linalg.norm(rows.Lg_phi * model.u_max, axis=1)
        if answer.status in (Status.FREE, Status.CORRECTING, Status.PASSIVITY_DROPPED):
            before, after = (qp_slack(barrier, rows, u, config) for u in (u_des, answer.u))
            usable = scale > 1e-9
            assert np.all(after >= -1e-5 * np.maximum(scale, np.abs(before)) - 1e-9 * ~usable)
        if answer.status is Status.CORRECTING and d_p is not None:
            power = dyn.v @ (answer.u - u_des)
            assert power <= d_p + free_power(model) + 1e-5 * max(np.linalg.norm(dyn.v * model.u_max), abs(d_p))
        if answer.status is Status.FREE:
            np.testing.assert_array_equal(answer.u, u_des)


def test_far_away_the_desired_torque_passes_bit_for_bit(panda):
    filter_ = SafetyFilter(panda.model, panda.safety, panda.barrier("lb-cbf"))
    rng, q = np.random.default_rng(3), panda.robot.start
    g = panda.model.gravity(q)
    for i in range(50):
        u_des = g + rng.normal(0.0, 0.1, 7)
        result = filter_.step(0.001 * i, q, rng.normal(0.0, 1e-3, 7), u_des, 0.0)
        assert result.status is Status.FREE
        assert result.u.tobytes() == u_des.tobytes()
    assert filter_.counts[Status.FREE] == 50


def test_u_des_outside_the_box_is_brought_inside(cartpole):
    filter_ = SafetyFilter(cartpole.model, cartpole.safety, cartpole.barrier("lb-cbf"), FilterConfig(metric="torque"))
    result = filter_.step(0.0, [0.0, 0.0], [0.0, 0.0], [40.0, -30.0])
    assert result.status is not Status.FREE
    np.testing.assert_allclose(result.u, [25.0, -25.0], atol=1e-3)


# ---------------------------------------------------------------------------------------------- QP: no solution


def cart_between(margin_left, margin_right, effort=None):
    """The cart-pole between walls at x = ±1.5, with a safety function and an LB-CBF."""
    problem = load_problem("cartpole", "wall")
    walls = [HalfSpace(type="half_space", name=name, normal=[sign, 0, 0], offset=-1.5, margin=margin)
             for name, sign, margin in (("left", 1.0, margin_left), ("right", -1.0, margin_right))]  # fmt: skip
    model = RobotModel(problem.model.urdf, effort=effort)
    return model, SafetyFunction(model, problem.robot.body, walls), RhoBarrier("lb-cbf", model, BarrierSpec())


@pytest.mark.parametrize("metric", METRICS)
@pytest.mark.parametrize("d_p", [None, 0.0])
def test_contradictory_rows_are_reported_and_balanced(metric, d_p):
    """Margins that overlap leave no admissible place; the least violation is shared between the two walls."""
    model, safety, barrier = cart_between(2.0, 2.0)
    filter_ = SafetyFilter(model, safety, barrier, FilterConfig(metric=metric))
    result = filter_.step(0.0, np.zeros(2), np.zeros(2), [3.0, 0.0], d_p)
    assert result.status is Status.INFEASIBLE
    assert result.reason in ("no torque in the box satisfies all rows", "a row is out of reach of the torque box")
    assert np.all(np.abs(result.u) <= model.u_max)
    acceleration = model.acceleration(np.zeros(2), np.zeros(2), result.u)
    assert acceleration[0] == pytest.approx(0.0, abs=0.1)


@pytest.mark.parametrize("speed", [3.0, 3e4])
@pytest.mark.parametrize("metric", METRICS)
def test_too_little_torque_is_reported_and_all_of_it_used(metric, speed):
    model, safety, barrier = cart_between(0.0, 0.0, effort=0.5)
    filter_ = SafetyFilter(model, safety, barrier, FilterConfig(metric=metric))
    result = filter_.step(0.0, [1.4, 0.0], [speed, 0.0], [0.2, 0.0], 0.0)
    assert result.status is Status.INFEASIBLE
    assert result.row == "cart#0 / right"
    assert np.all(np.abs(result.u) <= 0.5)
    assert result.u[0] == pytest.approx(-0.5, abs=1e-3)


@pytest.mark.parametrize("metric", METRICS)
def test_passivity_yields_to_safety(metric):
    """Moving away from a wall too slowly while inside it: only a push that adds energy keeps the row.

    The pole lies level, where its torque does not move the cart.
    """
    model, safety, barrier = cart_between(0.0, 0.0)
    filter_ = SafetyFilter(model, safety, barrier, FilterConfig(metric=metric, alpha=10.0))
    q, v = [1.6, np.pi / 2], [-0.1, 0.0]
    result = filter_.step(0.0, q, v, [0.0, 0.0], 0.0)
    assert result.status is Status.PASSIVITY_DROPPED
    assert result.reason == "rows and box allow no passive torque"
    assert -0.1 * result.u[0] > 0.0
    filter_.reset()
    again = filter_.step(0.001, q, v, [0.0, 0.0], None)
    assert again.status is Status.CORRECTING  # without a budget the same torque is simply the answer
    np.testing.assert_allclose(again.u, result.u, atol=1e-3)


def test_energy_barrier_at_rest_in_a_violated_place_is_infeasible():
    """There L_g phi = -vᵀ = 0: no torque changes phi, and the filter must say so."""
    model, safety, _ = cart_between(2.0, 0.0)
    filter_ = SafetyFilter(model, safety, EnergyBarrier(BarrierSpec()))
    result = filter_.step(0.0, np.zeros(2), np.zeros(2), [1.0, 0.0], 0.0)
    assert result.status is Status.INFEASIBLE
    assert result.reason == "L_g phi is zero on a violated row"
    np.testing.assert_allclose(result.u, [1.0, 0.0], atol=1e-6)


def test_contradictions_do_not_hold_up_the_loop():
    """Rows that almost contradict each other, such as safety and passivity: unlimited iterations take up to 0.3 s."""
    rng, solver, longest = np.random.default_rng(0), make_solver("proxqp"), 0.0
    for _ in range(200):
        angle = rng.uniform(0.0, 2.0 * np.pi)
        c, d = ([np.cos(x), np.sin(x)] for x in (angle, angle + np.pi + rng.normal(0.0, 0.005)))
        root, u = rng.normal(size=(2, 2)), rng.uniform(-0.9, 0.9, 2)
        H = root @ root.T + 0.05 * np.eye(2)
        lower = np.array([rng.uniform(0.0, 0.8), rng.uniform(-0.3, 0.1)])
        start = time.process_time()
        solver.solve(QPProblem(H * 2.0 / np.trace(H), np.zeros(2), np.array([c, d]), lower, -1.0 - u, 1.0 - u))
        longest = max(longest, time.process_time() - start)
    assert longest < 0.03


# ---------------------------------------------------------------------------------------------- ladder


def test_the_velocity_domain_gives_way_first(panda):
    """Far beyond X's speeds no torque obeys its rows: the rest of the QP is solved without them, still passive."""
    model, config = panda.model, FilterConfig()
    barrier = panda.barrier("lb-cbf")
    v = np.zeros(7)
    v[0] = 2.0 * panda.robot.domain.v[0, 1]
    dyn, safety, rows = rows_at(panda, barrier, panda.robot.start, -v)
    nominal = panda.robot.controller.evaluate(dyn)
    qp_filter, d_p = QPFilter(barrier, panda.safety, config), float(nominal.d_p)
    answer = qp_filter.correct(dyn, safety, rows, nominal.u, d_p, model.u_max)
    assert answer.status is Status.CORRECTING and answer.reason.endswith("the velocity domain given up")
    assert np.all(np.abs(answer.u) <= model.u_max)
    assert -v @ (answer.u - nominal.u) <= d_p + 1e-6
    assert qp_slack(barrier, rows, answer.u, config).min() >= -1e-3


def test_proxqp_stands_in_where_daqp_neither_solves_nor_refutes(monkeypatch):
    problem = QPProblem(np.eye(2), np.zeros(2), np.array([[1.0, 0.0]]), np.array([0.5]), -np.ones(2), np.ones(2))
    expected = [0.5, 0.0]
    solver = make_solver("daqp")
    np.testing.assert_allclose(solver.solve(problem), expected, atol=1e-9)
    for flag, answer in ((-4, expected), (-2, expected), (-1, None)):
        monkeypatch.setattr("ppcbf_robots.qp.daqp.solve", lambda *a, flag=flag: (np.full(2, 9.0), 0.0, flag, {}))
        found = solver.solve(problem)
        if answer is None:
            assert found is None
        else:
            np.testing.assert_allclose(found, answer, atol=1e-6)
