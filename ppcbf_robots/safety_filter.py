"""The runtime filter for any torque control loop: state and desired torque in, safe torque and status out."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ppcbf_robots.barriers import Barrier, BarrierRows, RhoBarrier
from ppcbf_robots.errors import InputError
from ppcbf_robots.filters import ClosedForm, FilterConfig, QPFilter, Status, is_slow
from ppcbf_robots.robot import Dynamics, RobotModel
from ppcbf_robots.safety import SafetyFunction, SafetyRows
from ppcbf_robots.shapes import Motion, Packed
from ppcbf_robots.specs import Array

log = logging.getLogger(__name__)

RESTING_TIME = 0.02  # [s]


@dataclass(frozen=True)
class StepResult:
    """What one control step produced."""

    u: Array  # (nv,) torque to command [N m | N]
    status: Status
    reason: str
    h: float  # least over the rows [m | rad]
    phi: float  # least over the rows
    row: str  # name of the row that decided, "" if none
    port_power: float = 0.0  # [W] beyond d_p that a moving obstacle puts in through the arm's evasion


@dataclass(frozen=True)
class Screen:
    """What is known of a batch of states before any QP is solved."""

    free: NDArray[np.bool_]  # (B,) u_des needs no correction
    safety: SafetyRows
    rows: BarrierRows

    def at(self, i: int) -> tuple[SafetyRows, BarrierRows]:
        """The rows of one state."""
        return SafetyRows(*(x[i] for x in vars(self.safety).values())), BarrierRows(
            *(x[i] for x in vars(self.rows).values())
        )


class SafetyFilter:
    """Corrects a desired torque as little as its metric allows so that every row of the barrier holds.

    Args:
        robot: the robot the barrier was made for.
        safety: its safety function in this world.
        barrier: one of the four barriers.
        config: filter settings.
        damping: K_d (nv,) of the fallback torque ``sat(g - K_d v)``; by default 1 % of u_max per v_max.
        gravity_included: False if u_des leaves gravity out and the returned torque must too (libfranka).

    The filter keeps counts of every status in ``counts`` and logs each step down its ladder with the reason. Python is
    not a safety-rated function: keep the robot's own monitored limits on.
    """

    def __init__(
        self,
        robot: RobotModel,
        safety: SafetyFunction,
        barrier: Barrier,
        config: FilterConfig | None = None,
        damping: Array | None = None,
        gravity_included: bool = True,
    ) -> None:
        self.robot, self.safety, self.barrier = robot, safety, barrier
        self.config = config or FilterConfig()
        self.damping = 0.01 * robot.u_max / robot.v_max if damping is None else np.asarray(damping, float)
        self.gravity_included = gravity_included
        closed = self.config.kind == "closed-form"
        self.correction = ClosedForm(barrier, self.config) if closed else QPFilter(barrier, safety, self.config)
        learned = isinstance(barrier, RhoBarrier)
        self._blind: Barrier = RhoBarrier("lb-cbf", robot, barrier.spec) if learned else barrier  # K = 0
        self.counts: dict[Status, int] = dict.fromkeys(Status, 0)
        self._last_status = Status.FREE
        self._last: tuple[float, Array] | None = None  # (time, gravity torque) of the last valid state
        self._invalid_steps = 0  # in a row
        if self.damping.shape != (robot.nv,) or not np.all(np.isfinite(self.damping) & (self.damping >= 0.0)):
            raise InputError(f"damping: expected {robot.nv} finite numbers of at least 0, got {self.damping.tolist()}")

    def reset(self) -> None:
        """Forget the last state, for a clock that starts anew."""
        self._last, self._invalid_steps = None, 0

    def step(
        self,
        t: float,
        q: ArrayLike,
        v: ArrayLike,
        u_des: ArrayLike,
        d_p: float | None = None,
        motions: Mapping[str, Motion] | None = None,
    ) -> StepResult:
        """One control step.

        Args:
            t: time of the state [s]; must not go backwards.
            q: configuration (nq,), continuous joints as (cos, sin).
            v: joint velocity (nv,) [rad/s | m/s].
            u_des: desired torque (nv,) [N m | N].
            d_p: dissipation of the desired torque [W], the budget of the passivity row ``vᵀ(u - u_des) <= d_p``;
                None leaves that row out (for controllers that are not passive).
            motions: obstacles, by name, that are elsewhere than in the world's file or moving. K_theta was not trained
                for that: while any is given, the filter runs on the LB-CBF (K = 0). Where one comes closer, the
                passivity row yields to it, and what that puts in is ``port_power``. An unknown name or NaN is a FAULT.

        Returns:
            A finite torque, inside the box unless the filter is the closed form, and its status.
        """
        q, v, u_des = (_numbers(x) for x in (q, v, u_des))
        problem = self._invalid(t, q, v)
        if problem:
            self._invalid_steps += 1
            return self._count(self._hold(t, problem))
        dyn = self.robot.evaluate(q, v)
        try:
            obstacles = self.safety.packed.moved(motions) if motions else None
        except InputError as error:
            self._remember(t, dyn)
            return self._count(self._fault(dyn, str(error)))
        return self._count(self.filter(t, dyn, u_des, d_p, obstacles))

    def filter(
        self, t: float, dyn: Dynamics, u_des: Array, d_p: float | None, obstacles: Packed | None = None
    ) -> StepResult:
        """The step for a state that was already evaluated (and checked), with the obstacles where they are now."""
        safety = self.safety.evaluate(dyn, obstacles)
        rows = (self.barrier if obstacles is None else self._blind).rows(dyn, safety)
        return self.filter_rows(t, dyn, safety, rows, u_des, d_p, obstacles is not None)

    def filter_rows(
        self,
        t: float,
        dyn: Dynamics,
        safety: SafetyRows,
        rows: BarrierRows,
        u_des: Array,
        d_p: float | None,
        moving: bool = False,
    ) -> StepResult:
        """The step for a state whose rows are known too; ``moving`` if they are of obstacles that move."""
        self._remember(t, dyn)
        offset = 0.0 if self.gravity_included else dyn.g
        h, phi = float(rows.h.min()), float(rows.phi.min())
        wanted = u_des.shape == (self.robot.nv,) and bool(np.isfinite(u_des).all()) and math.isfinite(d_p or 0.0)
        if not (wanted and math.isfinite(rows.Lf_phi.sum() + rows.Lg_phi.sum())):
            return self._fault(dyn, "u_des, d_p or the barrier is not finite", h, phi)
        pushed = moving and bool(np.any((safety.drift < 0.0) & (rows.psi(u_des + offset) < 0.0)))
        budget = None if pushed else d_p
        c = self.correction.correct(dyn, safety, rows, u_des + offset, budget, self.robot.u_max)
        if c.status is Status.FAULT:
            return self._fault(dyn, c.reason, h, phi, self._name(c.row))
        status = c.status
        if status is Status.CORRECTING and c.row >= 0 and self._at_rest(dyn, c.u):
            status = Status.RESTING
        u = c.u - offset
        port = max(0.0, float(dyn.v @ (u - u_des)) - (d_p or 0.0)) if pushed else 0.0
        return StepResult(u, status, c.reason, h, phi, self._name(c.row), port)

    def screen(self, dyn: Dynamics, u_des: Array) -> Screen:
        """The rows of a batch of valid states, and at which of them the filter leaves u_des (B, nv) as it is.

        For the others :meth:`filter_rows` has to be asked. Counts and the last valid state are left alone.
        """
        safety = self.safety.evaluate(dyn)
        rows = self.barrier.rows(dyn, safety)
        total = u_des if self.gravity_included else u_des + dyn.g
        free = self.correction.passes(dyn, rows, total, self.robot.u_max)
        return Screen(free, safety, rows)

    def _remember(self, t: float, dyn: Dynamics) -> None:
        """This state is valid: what an invalid one after it is bridged with."""
        self._last, self._invalid_steps = (t, dyn.g), 0

    def _fault(self, dyn: Dynamics, reason: str, h: float = np.nan, phi: float = np.nan, row: str = "") -> StepResult:
        """``sat(g - K_d v)`` for a valid state without a usable answer: kinetic energy cannot grow under it."""
        u = np.clip(dyn.g - self.damping * dyn.v, -self.robot.u_max, self.robot.u_max)
        return StepResult(u if self.gravity_included else u - dyn.g, Status.FAULT, reason, h, phi, row)

    def _at_rest(self, dyn: Dynamics, u: Array) -> bool:
        """Hardly any speed, now and RESTING_TIME ahead under u."""
        return is_slow(self.robot, dyn.v) and is_slow(self.robot, dyn.v + RESTING_TIME * dyn.Minv @ (u - dyn.b))

    def _name(self, row: int) -> str:
        return self.safety.names[row] if row >= 0 else ""

    def _invalid(self, t: float, q: Array, v: Array) -> str:
        if q.shape != (self.robot.nq,) or v.shape != (self.robot.nv,):
            return f"state of shape {q.shape}, {v.shape} instead of ({self.robot.nq},), ({self.robot.nv},)"
        if not isinstance(t, int | float | np.number) or not np.isfinite(t):
            return "time not a finite number"
        if not (np.isfinite(q).all() and np.isfinite(v).all()):
            return "state not finite"
        c = self.robot.idx_q[self.robot.continuous]
        if len(c) and np.any(np.abs(q[c] ** 2 + q[c + 1] ** 2 - 1.0) > 1e-2):
            return "a continuous joint's (cos, sin) is not of length 1"
        if self._last is not None and t < self._last[0]:
            return f"time went backwards, from {self._last[0]:g} s to {t:g} s"
        return ""

    def _hold(self, t: float, problem: str) -> StepResult:
        """Gravity torque of the last valid state for at most max_hold, then STOP with zero torque.

        Time is the caller's clock or the count of steps, whichever is longer: the clock may be what failed.
        """
        held = self._invalid_steps * self.config.dt
        if self._last is not None and isinstance(t, int | float | np.number) and np.isfinite(t):
            held = max(held, t - self._last[0])
        if self._last is not None and held <= self.config.max_hold:
            g = np.clip(self._last[1], -self.robot.u_max, self.robot.u_max)
            u = g if self.gravity_included else np.zeros_like(g)
            return StepResult(u, Status.INVALID, problem, np.nan, np.nan, "")
        return StepResult(np.zeros(self.robot.nv), Status.STOP, f"{problem}: engage the brakes", np.nan, np.nan, "")

    def _count(self, result: StepResult) -> StepResult:
        self.counts[result.status] += 1
        if result.status is not self._last_status:  # a change, not every tick of a lasting alarm
            level = logging.WARNING if result.status >= Status.PASSIVITY_DROPPED else logging.DEBUG
            log.log(level, "%s: %s %s", result.status.name, result.reason, result.row)
            self._last_status = result.status
        return result


def _numbers(x: ArrayLike) -> Array:
    """Floats, or an array of no length for what is not numbers, which the checks then refuse."""
    try:
        return np.asarray(x, dtype=float)
    except (TypeError, ValueError):
        return np.zeros(0)
