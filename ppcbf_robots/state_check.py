"""Whether a measured state may be used: complete, finite, fresh, and where the arm can have got since the last one."""

from __future__ import annotations

import numpy as np

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
        self._reach = JUMP * robot.v_max
        self._scalar = not robot.continuous.any()

    def reset(self) -> None:
        """Forget the last state."""
        self.last, self._repeats, self._lost = None, 0, False

    def accept(self, t: float, q: Array, v: Array) -> None:
        """This state is valid: the next one is judged by it."""
        self.last, self._lost = (t, q, v), False

    def problem(self, t: float, q: Array, v: Array, age: float) -> str:
        """What is wrong with a state of so many seconds ago, in words; empty if it may be used."""
        found = self._alone(t, q, v, age) or ("" if self.last is None else self._against_last(t, q, v, *self.last))
        self._lost = self._lost or bool(found)
        return found

    def _alone(self, t: float, q: Array, v: Array, age: float) -> str:
        if q.shape != (self.robot.nq,) or v.shape != (self.robot.nv,):
            return f"state of shape {q.shape}, {v.shape} instead of ({self.robot.nq},), ({self.robot.nv},)"
        if not is_finite_number(t):
            return "time not a finite number"
        if not (is_finite_number(age) and age >= 0.0):
            return "age of the state not a finite number of at least 0"
        if not (np.isfinite(q).all() and np.isfinite(v).all()):
            return "state not finite"
        c = self.robot.idx_q[self.robot.continuous]
        if len(c) and np.any(np.abs(q[c] ** 2 + q[c + 1] ** 2 - 1.0) > UNIT_TOLERANCE):
            return "a continuous joint's (cos, sin) is not of length 1"
        if age > self.max_age:
            return f"the state is {age:g} s old, more than {self.max_age:g} s"
        return ""

    def _against_last(self, t: float, q: Array, v: Array, t_last: float, q_last: Array, v_last: Array) -> str:
        if t < t_last:
            return f"time went backwards, from {t_last:g} s to {t:g} s"
        same = q.tobytes() == q_last.tobytes() and v.tobytes() == v_last.tobytes()
        frozen = same and (t == t_last or np.abs(v).max() * self.dt > MOVING)
        self._repeats = self._repeats + 1 if frozen else 0
        if self._repeats > 1 and self._repeats * self.dt > self.max_age:
            return f"stale: the same state {self._repeats + 1} times in a row"
        moved = np.abs(q - q_last if self._scalar else self.robot.difference(q_last, q))
        elapsed = max(self.dt, min(t - t_last, self.max_hold) if self._lost else t - t_last)
        if np.any(moved > self._reach * elapsed):
            i = int(np.argmax(moved - self._reach * elapsed))
            return f"joint '{self.robot.joint_names[i]}' jumped by {moved[i]:.3g} in {t - t_last:.3g} s"
        return ""


def is_finite_number(x: object) -> bool:
    """Whether x is a real number, neither NaN nor infinite."""
    return isinstance(x, int | float | np.number) and bool(np.isfinite(x))
