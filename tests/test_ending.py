"""How a run ends: every statement against a run made for it, and loads against the controller's own spring."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence

import numpy as np
import pytest

from ppcbf_robots.controllers import Gains, NominalController
from ppcbf_robots.ending import Ending, bearing_rows, judge
from ppcbf_robots.filters import Status
from ppcbf_robots.problem import Problem
from ppcbf_robots.rollout import simulate
from ppcbf_robots.safety_filter import SafetyFilter

T = 2001  # control steps of 1 ms
GOAL = np.array([1.0, 1.2])


def judged(
    problem: Problem, errors: np.ndarray, row: str = "", touches: Sequence[str] = (), **changes: np.ndarray
) -> Ending:
    """The end of a run of the two-link whose first joint is short of the goal by ``errors`` (T,), the other there."""
    q, zero = GOAL - np.column_stack([errors, np.zeros(T)]), np.zeros((T, 2))
    run = {"t": 1e-3 * np.arange(T), "q": q, "v": np.gradient(q, 1e-3, axis=0), "u": zero, "u_des": zero}
    return judge({**run, "V": np.zeros(T), **changes}, GOAL, problem.safety, row, touches)


def test_the_goal_counts_from_when_the_arm_stays_there(two_link):
    errors = np.full(T, 0.01)
    errors[:300], errors[500:700] = 0.3, 0.06
    end = judged(two_link, errors, "tip#0 / circle")
    assert (end.state, end.reached_at) == ("goal", pytest.approx(0.7))
    assert end.text() == "goal reached at 0.70 s (largest joint error 0.01)"
    assert judged(two_link, np.zeros(T)).reached_at == 0.0


def test_motion_is_told_with_its_direction_and_the_time_left(two_link):
    t = 1e-3 * np.arange(T)
    end = judged(two_link, 0.85 - 0.1 * t, V=3.0 - 0.5 * t)
    assert (end.state, end.fastest, end.unit) == ("moving", "shoulder", "rad")
    assert (end.speed, end.approach, end.power) == pytest.approx((0.1, 0.1, 0.5))
    assert end.remaining == pytest.approx((0.65 - 0.05) / 0.1)
    assert "towards the goal" in end.text() and end.text().endswith("run 6 s longer (--duration) at this rate")
    near = judged(two_link, 0.27 - 0.1 * t, V=3.0 - 0.5 * t)
    assert near.remaining == pytest.approx(0.2) and "run 1 s longer" in near.text()
    away = judged(two_link, 0.65 + 0.1 * t, "tip#0 / circle", V=3.0 - 0.5 * t)
    assert away.remaining is None and "moving along tip#0 / circle, away from the goal" in away.text()
    swinging = judged(two_link, 0.5 + 0.1 * np.sin(20.0 * t))
    assert swinging.state == "moving" and "V does not fall" in swinging.text()


def test_rest_without_a_row_names_its_cause(two_link):
    errors, u_max = np.full(T, 0.4), two_link.model.u_max
    weak = {"u": np.tile([u_max[0], 1.0], (T, 1)), "u_des": np.tile([2.0 * u_max[0], 1.0], (T, 1))}
    end = judged(two_link, errors, **weak)
    assert (end.state, end.at_limit) == ("stalled", ["shoulder"])
    assert end.text().endswith("no row of the filter holds it: joints at their torque limit: shoulder")
    touching = judged(two_link, errors, touches=["tip / circle"])
    assert touching.state == "stalled" and touching.text().endswith("in contact: tip / circle")
    idle = judged(two_link, errors)
    assert idle.text().endswith("it is an equilibrium of the controller itself")


def test_a_correction_that_no_row_balances_is_no_constrained_minimum(two_link):
    """A damper that holds the arm far from every row, as the PP-CBF's does in the torque metric."""
    end = judged(two_link, np.full(T, 0.4), "tip#0 / circle", u_des=np.full((T, 2), 5.0))
    assert (end.state, end.constrained_minimum) == ("held", False)
    assert "held by tip#0 / circle, though V has no constrained minimum" in end.text()


def test_loads_are_those_that_make_up_the_correction(panda, states):
    u_max = panda.model.u_max
    for q, v in states(panda, 5):
        rows = panda.safety.evaluate(panda.model.evaluate(q, v))
        rows = dataclasses.replace(rows, h=np.ones_like(rows.h))
        rows.h[[3, 8, 11]] = 1e-4
        loads = dict(bearing_rows(rows, (7.0 * rows.grad[3] + 2.0 * rows.grad[11]) / u_max, u_max))
        assert loads == pytest.approx({3: 7.0, 11: 2.0}, rel=1e-6)
        assert bearing_rows(rows, -rows.grad[8] / u_max, u_max) == []  # a row pushes, it does not pull
        assert bearing_rows(rows, 1e-6 * rows.grad[8] / u_max, u_max) == []


def test_the_loads_of_an_arm_at_rest_balance_its_spring(two_link):
    """With a goal inside the obstacle the filtered arm stops at its surface and says what keeps it there."""
    gains = Gains("pd_gravity", np.full(2, 20.0), np.full(2, 20.0), np.ones(2))
    controller = NominalController(two_link.model, gains, np.array([0.7, 0.6]))
    filter_ = SafetyFilter(two_link.model, two_link.safety, two_link.barrier("lb-cbf"))
    run = simulate(two_link.safety, controller, filter_, two_link.robot.start, np.zeros(2), 8.0)
    assert run.clearance.min() >= 0.0
    assert run.status[-1] == Status.RESTING
    assert np.abs(np.diff(run.u[-500:], axis=0)).max() < 0.01
    end = run.ending()
    assert end is not None and end.state == "held" and end.constrained_minimum
    assert list(end.held_by) == ["tip#0 / circle"]
    grad = two_link.safety.evaluate(two_link.model.evaluate(run.q[-1], np.zeros(2))).grad[0]
    np.testing.assert_allclose(end.held_by["tip#0 / circle"] * grad, controller.spring(run.q[-1])[0], rtol=0.02)
    assert "rests against tip#0 / circle (load" in end.text() and "via point" in end.text()
    assert Ending(**json.loads(json.dumps(dataclasses.asdict(end)))) == end
