"""Whether a measured state may be used: complete, finite, fresh, and where the arm can have got since the last one."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ppcbf_robots.kernels import kernel
from ppcbf_robots.robot import RobotModel
from ppcbf_robots.specs import Array

UNIT_TOLERANCE = 1e-2  # of cos² + sin² of a continuous joint
JUMP = 10.0  # times v_max: faster than this between two states, no joint moves
MOVING = 1e-9  # [rad | m] of motion per control period, above which q cannot stay the same to the last bit


class StateCheck:
    """Judges states one after the other.

    A state is *stale* if q and v are those of the state before to the last bit, although its time did not advance or v
    says that the arm moves, for longer than ``max_age`` (at least twice in a row: once is no fault). It has *jumped* if
    a joint is farther from where it last was than ``JUMP v_max`` times the time in between allows, as an angle does
    that wraps; from then on no state is valid until the arm is back there, or :meth:`reset`, for after a state that was
    not valid no more time than ``max_hold`` counts.

    Args:
        robot: the robot.
        dt: control period [s].
        max_age: how old a state may be [s].
        max_hold: how long invalid states are bridged [s].
    """

    def __init__(self, robot: RobotModel, dt: float, max_age: float, max_hold: float) -> None:
        self.robot, self.dt, self.max_age, self.max_hold = robot, dt, max_age, max_hold
        self.last: tuple[float, Array, Array] | None = None  # (t, q, v) of the last valid state
        self._repeats, self._lost = 0, False
        self._joints = (robot.idx_q, robot.continuous, JUMP * robot.v_max)

    def reset(self) -> None:
        """Forget the last state."""
        self.last, self._repeats, self._lost = None, 0, False

    def accept(self, t: float, q: Array, v: Array) -> None:
        """This state is valid: the next one is judged by it."""
        self.last, self._lost = (t, q, v), False

    def problem(self, t: float, q: Array, v: Array, age: float) -> str:
        """What is wrong with a state of so many seconds ago, in words; empty if it may be used."""
        found = self._problem(t, q, v, age)
        self._lost = self._lost or found != ""
        return found

    def _problem(self, t: float, q: Array, v: Array, age: float) -> str:
        if q.shape != (self.robot.nq,) or v.shape != (self.robot.nv,):
            return f"state of shape {q.shape}, {v.shape} instead of ({self.robot.nq},), ({self.robot.nv},)"
        if not is_finite_number(t):
            return "time not a finite number"
        if not (is_finite_number(age) and age >= 0.0):
            return "age of the state not a finite number of at least 0"
        t_last, q_last, v_last = (t, q, v) if self.last is None else self.last
        passed = t - t_last
        elapsed = max(self.dt, min(passed, self.max_hold) if self._lost else passed)
        usable, turning, same, fastest, jumped, distance = look(q, v, q_last, v_last, *self._joints, elapsed)
        if not usable:
            return "state not finite"
        if not turning:
            return "a continuous joint's (cos, sin) is not of length 1"
        if age > self.max_age:
            return f"the state is {age:g} s old, more than {self.max_age:g} s"
        if self.last is None:
            return ""
        if passed < 0.0:
            return f"time went backwards, from {t_last:g} s to {t:g} s"
        self._repeats = self._repeats + 1 if same and (passed == 0.0 or fastest * self.dt > MOVING) else 0
        if self._repeats > 1 and self._repeats * self.dt > self.max_age:
            return f"stale: the same state {self._repeats + 1} times in a row"
        return (
            "" if jumped < 0 else f"joint '{self.robot.joint_names[jumped]}' jumped by {distance:.3g} in {passed:.3g} s"
        )


@kernel
def look(
    q: Any, v: Any, q_last: Any, v_last: Any, idx_q: Any, continuous: Any, reach: Any, elapsed: float
) -> tuple[bool, bool, bool, float, int, float]:
    """Facts of a state (q, v) beside the one before.

    Returns:
        (whether all is finite, whether every continuous joint's (cos, sin) is of length 1, whether both states are the
        same, largest speed, a joint that went farther than ``reach elapsed`` or -1, how far it went).
    """
    usable = turning = same = True
    fastest, jumped, distance = 0.0, -1, 0.0
    for i in range(len(q)):
        usable = usable and math.isfinite(q[i])
        same = same and q[i] == q_last[i]
    for i in range(len(v)):
        usable = usable and math.isfinite(v[i])
        same = same and v[i] == v_last[i]
        fastest = max(fastest, abs(v[i]))
        k = idx_q[i]
        moved = abs(q[k] - q_last[k])
        if continuous[i]:
            c, s, c_last, s_last = q[k], q[k + 1], q_last[k], q_last[k + 1]
            turning = turning and abs(c * c + s * s - 1.0) <= UNIT_TOLERANCE
            moved = abs(math.atan2(s * c_last - c * s_last, c * c_last + s * s_last))
        if moved > reach[i] * elapsed:
            jumped, distance = i, moved
    return usable, turning, same, fastest, jumped, distance


def is_finite_number(x: object) -> bool:
    """Whether x is a real number, neither NaN nor infinite, and no larger than a float can be."""
    try:
        return isinstance(x, int | float | np.integer | np.floating) and math.isfinite(x)
    except OverflowError:
        return False
