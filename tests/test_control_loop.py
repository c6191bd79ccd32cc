"""What a control loop does to a filter: states that are stale, late or jump, and a plant that slips from the model."""

from __future__ import annotations

import numpy as np
import pytest

from ppcbf_robots.barriers import BarrierRows
from ppcbf_robots.engines import PinocchioEngine
from ppcbf_robots.errors import InputError
from ppcbf_robots.filters import FilterConfig, Status
from ppcbf_robots.plant import perturbed
from ppcbf_robots.safety_filter import SafetyFilter
from ppcbf_robots.slip import SlipObserver
from ppcbf_robots.specs import PayloadSpec

DT = 1e-3


def make(problem, **config):
    gains = problem.robot.controller.gains
    return SafetyFilter(problem.model, problem.safety, problem.barrier("lb-cbf"), FilterConfig(**config), gains.kd)


def states_of(filter_, problem, times, q, v):
    """Statuses and reasons for one state under several times."""
    g = problem.model.gravity(q)
    results = [filter_.step(t, q, v, g, 0.0) for t in times]
    return [r.status for r in results], [r.reason for r in results]


# ---------------------------------------------------------------------------------------------- states


def test_a_state_may_come_twice_but_not_for_longer_than_max_age(two_link):
    """5 ms by default: the first and five repetitions pass; a slow loop may still repeat once."""
    q, v = two_link.robot.start, np.zeros(2)
    statuses, reasons = states_of(make(two_link), two_link, [0.1] * 9, q, v)
    assert statuses == [Status.FREE] * 6 + [Status.INVALID] * 3
    assert reasons[6] == "stale: the same state 7 times in a row"
    slow = states_of(make(two_link, dt=0.02), two_link, [0.1] * 3, q, v)[0]
    assert slow == [Status.FREE] * 2 + [Status.INVALID]


def test_a_moving_arm_that_stays_where_it_is_is_stale_and_a_resting_one_is_not(two_link):
    times, q = np.arange(12) * DT, two_link.robot.start
    assert set(states_of(make(two_link), two_link, times, q, np.zeros(2))[0]) == {Status.FREE}
    statuses, _ = states_of(make(two_link), two_link, times, q, np.array([0.0, -0.01]))
    assert statuses == [Status.FREE] * 6 + [Status.INVALID] * 6


def test_a_fresh_state_after_stale_ones_is_valid_at_once(two_link):
    filter_, q = make(two_link), two_link.robot.start
    states_of(filter_, two_link, [0.1] * 40, q, np.zeros(2))
    assert filter_.counts[Status.STOP] > 0
    assert states_of(filter_, two_link, [0.141], q, np.zeros(2))[0] == [Status.FREE]


@pytest.mark.parametrize(("age", "status"), [(0.0, 0), (0.005, 0), (0.0051, 6), (np.nan, 6), (-1e-3, 6), ("old", 6)])
def test_states_said_to_be_too_old_are_invalid(two_link, age, status):
    filter_, q = make(two_link), two_link.robot.start
    states_of(filter_, two_link, [0.0], q, np.zeros(2))
    assert filter_.step(DT, q, np.zeros(2), two_link.model.gravity(q), age=age).status == status


def test_an_angle_that_wraps_has_jumped_until_it_is_back_or_reset(two_link):
    filter_, q, v = make(two_link), two_link.robot.start, np.zeros(2)
    g, wrapped = two_link.model.gravity(q), q + np.array([2.0 * np.pi, 0.0])
    filter_.step(0.0, q, v, g)
    joint = two_link.model.joint_names[0]
    result = filter_.step(DT, wrapped, v, g)
    assert (result.status, result.reason) == (Status.INVALID, f"joint '{joint}' jumped by 6.28 in 0.001 s")
    assert filter_.step(60.0, wrapped, v, g).status is Status.STOP  # no more room with time, once one was invalid
    assert filter_.step(60.001, q, v, g).status is Status.FREE
    filter_.step(60.002, wrapped, v, g)
    filter_.reset()
    assert filter_.step(60.003, wrapped, v, g).status < Status.FAULT


def test_continuous_joints_wrap_without_a_jump_and_jump_half_a_turn(kinova):
    model, filter_, v = kinova.model, make(kinova), np.zeros(6)
    at = kinova.model.to_angles(kinova.robot.start)
    joint = int(np.flatnonzero(model.continuous)[0])
    told = []
    for t, angle in ((0.0, np.pi - 1e-3), (DT, -np.pi + 1e-3), (2 * DT, 0.0)):
        at[joint] = angle
        q = model.from_angles(at)
        told.append(filter_.step(t, q, v, model.gravity(q)))
    assert [r.status < Status.FAULT for r in told] == [True, True, False]
    assert told[2].reason.startswith(f"joint '{model.joint_names[joint]}' jumped by 3.14")


def test_late_states_are_predicted_with_the_torques_sent_since(panda):
    """With their age told, the filter sees what an undelayed one sees, up to the integration error of some ms."""
    for included in (True, False):
        model, engine = panda.model, PinocchioEngine(panda.model)
        filter_ = SafetyFilter(model, panda.safety, panda.barrier("lb-cbf"), gravity_included=included)
        engine.reset(panda.robot.start, np.array([0.8, 0.2, -0.3, 0.1, 0.4, 0.3, -0.5]))
        history, errors, untold = [], [], []
        for i in range(60):
            q, v = engine.state()
            history.append((q, v))
            old_q, old_v = history[max(0, i - 3)]
            push = 8.0 * np.sin(0.1 * i + np.arange(7))
            age = 2.5 * DT if i >= 3 else 0.0
            result = filter_.step(i * DT, old_q, old_v, push + (model.gravity(old_q) if included else 0.0), age=age)
            halfway = history[max(0, i - 1)]  # 2.5 ms after the one of 3 ms ago: half a period before now
            truth = [panda.safety.evaluate(model.evaluate(*s)).h.min() for s in (halfway, (q, v), (old_q, old_v))]
            if i > 10:
                errors.append(abs(result.h - 0.5 * (truth[0] + truth[1])))
                untold.append(abs(truth[2] - 0.5 * (truth[0] + truth[1])))
            total = result.u + (0.0 if included else model.gravity(q))
            engine.advance(total, 5e-4, 2)
        assert max(errors) < 0.02 * max(untold), included
        assert max(untold) > 2e-4


# ---------------------------------------------------------------------------------------------- slip


def rows_with(phi, Lf, Lg):
    phi = np.asarray(phi, float)
    return BarrierRows(phi, phi, phi, np.asarray(Lf, float), np.asarray(Lg, float), np.asarray(Lg, float))


def test_the_slip_is_the_average_of_what_was_predicted_less_what_came():
    """phi falls by 0.3 /s more than the model says, from whatever psi: the average follows as 1 - (1 - dt/T)^n."""
    rng, observer = np.random.default_rng(0), SlipObserver(DT, 0.01)
    phi, slip = rng.normal(size=4), np.array([0.3, -0.2, 0.0, 5.0])
    for n in range(30):
        rows = rows_with(phi, rng.normal(size=4), rng.normal(size=(4, 2)))
        u = rng.normal(size=2)
        wary = observer.wary(n * DT, rows)
        share = 1.0 - 0.9**n
        np.testing.assert_allclose(rows.Lf_phi - wary.Lf_phi, np.maximum(share * slip, 0.0), atol=1e-9)
        assert wary.phi is rows.phi and wary.Lg_phi is rows.Lg_phi
        short = rng.uniform()  # what is known beforehand is no slip
        observer.applied(n * DT, rows, u, short)
        phi = phi + DT * (rows.psi(u) - short - slip)
    observer.reset()
    np.testing.assert_array_equal(observer.wary(1.0, rows).Lf_phi, rows.Lf_phi)


def test_nothing_is_learned_across_a_gap_or_another_barrier():
    rows, later = rows_with([1.0], [0.0], [[0.0]]), rows_with([0.0], [0.0], [[0.0]])
    for t, forget in ((1.0, False), (0.0, False), (DT, True)):
        observer = SlipObserver(DT, 0.01)
        observer.wary(0.0, rows)
        observer.applied(0.0, rows, np.zeros(1), 0.0)
        if forget:
            observer.forget_step()
        np.testing.assert_array_equal(observer.wary(t, later).Lf_phi, 0.0)


@pytest.mark.parametrize("wrong", ["u_des", "state"])
def test_nothing_is_learned_from_a_step_whose_torque_was_another(two_link, wrong):
    """After one step of FAULT or INVALID the next state is no slip of what the step before had predicted."""
    filter_, engine = make(two_link), PinocchioEngine(two_link.model)
    engine.reset(two_link.robot.start, np.array([0.5, -0.5]))
    slips = []
    for i in range(30):
        q, v = engine.state()
        nominal = two_link.robot.controller.evaluate(two_link.model.evaluate(q, v))
        bad = i == 20
        u_des = np.full(2, np.nan) if bad and wrong == "u_des" else nominal.u + 20.0 * np.sin(i)
        result = filter_.step(i * DT, np.full(2, np.nan) if bad and wrong == "state" else q, v, u_des)
        assert (result.status >= Status.FAULT) == bad
        slips.append(float(np.abs(filter_._slip._slip).max(initial=0.0)))
        engine.advance(result.u, 5e-4, 2)
    assert max(slips[21:]) < 1.5 * max(slips[:20])


def least_phi(problem, plant, dt, **config):
    """Least phi and h between and at the control instants, and the rise of V, of the robot's own run of 1.2 s."""
    filter_, engine = make(problem, dt=dt, **config), PinocchioEngine(plant)
    barrier, least, V = filter_.barrier, np.full(2, np.inf), []
    engine.reset(problem.robot.start, problem.robot.start_velocity)
    for i in range(round(1.2 / dt)):
        q, v = engine.state()
        nominal = problem.robot.controller.evaluate(problem.model.evaluate(q, v))
        V.append(float(nominal.V))
        u = filter_.step(i * dt, q, v, nominal.u, float(nominal.d_p)).u
        for _ in range(4):
            engine.advance(u, dt / 4, 1)
            dyn = problem.model.evaluate(*engine.state())
            safety = problem.safety.evaluate(dyn)
            least = np.minimum(least, [barrier.rows(dyn, safety).phi.min(), safety.h.min()])
    assert filter_.counts[Status.CORRECTING] > 50
    return (*least, float(np.max(V - np.minimum.accumulate(V))))


@pytest.mark.parametrize("dt", [1e-3, 5e-3])
def test_between_the_steps_the_slip_leaves_more_of_the_margin(cartpole, dt):
    kept, without = (least_phi(cartpole, cartpole.model, dt, slip_time=x, alpha=20.0)[0] for x in (0.01, np.inf))
    assert 9e-4 < kept < 1.1e-3
    assert without < kept - 5e-5


def test_a_payload_the_filter_does_not_know_of_does_no_harm(make_brisk_panda):
    panda = make_brisk_panda("sphere")
    plant = perturbed(panda.model, payload=PayloadSpec(frame="panda_hand", mass=2.0))
    phi, h, rise = least_phi(panda, plant, DT)
    blind = least_phi(panda, plant, DT, slip_time=np.inf)
    assert h > 0.0 and phi > -5e-3
    assert blind[0] < -0.05  # 50 times the margin
    assert rise <= blind[2] + 1e-3


def test_slip_that_asks_too_much_is_not_made_up_for(cartpole):
    """The torque is then that of the filter without; the step does not count as infeasible."""
    q, v = np.array([1.0, 0.0]), np.array([2.4, 0.0])
    wary, plain = make(cartpole), make(cartpole, slip_time=np.inf)
    expected = plain.step(0.0, q, v, np.zeros(2), 0.0)
    wary._slip._slip = np.full(cartpole.safety.rows, 1e4)
    found = wary.step(0.0, q, v, np.zeros(2), 0.0)
    assert expected.status is Status.CORRECTING
    assert found.status is Status.CORRECTING
    np.testing.assert_allclose(found.u, expected.u)


def test_states_on_their_own_teach_nothing(cartpole):
    """As evidence looks at them, one by one in no order."""
    filter_ = make(cartpole)
    dyn = cartpole.model.evaluate(np.array([1.2, 0.0]), np.array([1.0, 0.0]))
    first, second = (filter_.filter(dyn, np.zeros(2), 0.0).u for _ in range(2))
    np.testing.assert_array_equal(first, second)
    assert filter_._slip._before is None


@pytest.mark.parametrize("bad", [{"slip_time": 0.0}, {"slip_time": np.nan}, {"max_age": -1.0}, {"max_age": np.inf}])
def test_settings_that_make_no_sense(bad):
    with pytest.raises(InputError, match=f"filter {next(iter(bad))}: must be a positive number"):
        FilterConfig(**bad)
