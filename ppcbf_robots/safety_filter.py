"""The runtime filter for any torque control loop: state and desired torque in, safe torque and status out."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ppcbf_robots.barriers import Barrier, BarrierRows, RhoBarrier
from ppcbf_robots.closed_form import ClosedForm
from ppcbf_robots.condense import survey
from ppcbf_robots.errors import InputError
from ppcbf_robots.filters import NEAR_REST, Box, Correction, FilterConfig, Status, stays_slow
from ppcbf_robots.qp_filter import QPFilter
from ppcbf_robots.robot import Dynamics, RobotModel
from ppcbf_robots.safety import SafetyFunction, SafetyRows
from ppcbf_robots.sent_torques import SentTorques
from ppcbf_robots.shapes import Motion, Packed
from ppcbf_robots.slip import SlipBatch, SlipObserver
from ppcbf_robots.specs import Array
from ppcbf_robots.state_check import StateCheck, is_finite_number
from ppcbf_robots.status_log import StatusLog

log = logging.getLogger(__name__)

RESTING_TIME = 0.02  # [s]
_NOT_FINITE = "u_des, d_p or the barrier is not finite"


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
    short: float = 0.0  # [m/s²] by which phi changes less over the period than psi(u) says, K being convex in v


@dataclass(frozen=True)
class Screen:
    """What is known of a batch of states before any QP is solved."""

    free: NDArray[np.bool_]  # (B,) u_des needs no correction
    short: Array  # (B,) as in StepResult, where it does not
    safety: SafetyRows
    rows: BarrierRows
    wary: BarrierRows  # lowered by the slip of phi, or the same rows

    def at(self, i: int) -> tuple[SafetyRows, BarrierRows, BarrierRows]:
        """The rows of one state."""
        rows, wary = (BarrierRows(*(x[i] for x in vars(r).values())) for r in (self.rows, self.wary))
        return SafetyRows(*(x[i] for x in vars(self.safety).values())), rows, rows if self.wary is self.rows else wary


class SafetyFilter:
    """Corrects a desired torque as little as its metric allows so that every row of the barrier holds.

    Args:
        robot: the robot the barrier was made for.
        safety: its safety function in this world.
        barrier: one of the four barriers.
        config: filter settings.
        damping: K_d (nv,) of the fallback torque ``sat(g - K_d v)``; by default 1 % of u_max per v_max.
        gravity_included: False if u_des leaves gravity out and the returned torque must too (libfranka).
        rate: how fast the returned torque may change, one number or (nv,) [N m/s | N/s]; by default the robot's
            ``u_rate``, infinite for none. One control period ``config.dt`` counts per step, however late it comes.

    Where the rate is limited, every returned torque but STOP's zero lies within ``rate dt`` of the last one, and inside
    the box. Before the first step and after :meth:`reset` the last one is taken to be the gravity torque (zero without
    ``gravity_included``), that of an arm held at rest; give ``u_last`` if it is another.

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
        rate: ArrayLike | None = None,
    ) -> None:
        self.robot, self.safety, self.barrier = robot, safety, barrier
        self.config = config = config or FilterConfig()
        self.damping = 0.01 * robot.u_max / robot.v_max if damping is None else np.asarray(damping, float)
        self.gravity_included = gravity_included
        closed = config.kind == "closed-form"
        self._sent = SentTorques(robot, config.dt, config.max_age, gravity_included, rate)
        learned = isinstance(barrier, RhoBarrier)
        self._blind: Barrier = RhoBarrier("lb-cbf", robot, barrier.spec) if learned else barrier  # K = 0
        self.correction, self._blind_correction = (
            ClosedForm(b, config) if closed else QPFilter(b, safety, config, self._sent.rate)
            for b in (barrier, self._blind)
        )
        self._log = StatusLog(log)
        self.counts = self._log.counts
        self._slow = NEAR_REST * robot.v_max
        self._check = StateCheck(robot, config.dt, config.max_age, config.max_hold)
        self._last_g: Array | None = None  # gravity torque of the last valid state
        self._invalid_steps = 0  # in a row
        watched = not closed and learned and math.isfinite(config.slip_time)
        self._slip = SlipObserver(config.dt, config.slip_time) if watched else None
        self._moved = False  # whether obstacles were elsewhere in the last step
        if self.damping.shape != (robot.nv,) or not np.all(np.isfinite(self.damping) & (self.damping >= 0.0)):
            raise InputError(f"damping: expected {robot.nv} finite numbers of at least 0, got {self.damping.tolist()}")

    def reset(self) -> None:
        """Forget the last state and torque, for a clock that starts anew or an arm that was moved by other means."""
        self._check.reset()
        self._last_g, self._invalid_steps = None, 0
        self._log.reset()
        self._sent.clear()
        if self._slip is not None:
            self._slip.reset()

    def step(
        self,
        t: float,
        q: ArrayLike,
        v: ArrayLike,
        u_des: ArrayLike,
        d_p: float | None = None,
        motions: Mapping[str, Motion] | None = None,
        u_last: ArrayLike | None = None,
        age: float = 0.0,
    ) -> StepResult:
        """One control step.

        Args:
            t: time of this step [s], also where the state is older; must not go backwards.
            q: configuration (nq,), continuous joints as (cos, sin).
            v: joint velocity (nv,) [rad/s | m/s].
            u_des: desired torque (nv,) [N m | N].
            d_p: dissipation of the desired torque [W], the budget of the passivity row ``vᵀ(u - u_des) <= d_p``;
                None leaves that row out (for controllers that are not passive).
            motions: obstacles, by name, that are elsewhere than in the world's file or moving. K_theta was not trained
                for that: while any is given, the filter runs on the LB-CBF (K = 0). Where one comes closer, the
                passivity row yields to it, and what that puts in is ``port_power``. An unknown name or NaN is a FAULT.
            u_last: torque (nv,) in force until now, commanded or measured, in the convention of u_des; only a limited
                rate looks at it. None: the torque that the last step returned. NaN is a FAULT.
            age: how old the state is [s], if the caller knows; the filter predicts it to now with the torques returned
                since. Older than ``config.max_age`` it is invalid.

        Returns:
            A finite torque and its status. It lies inside the box unless the filter is the closed form without a rate
            limit, and keeps the rate.
        """
        q, v, u_des = (_numbers(x) for x in (q, v, u_des))
        d_p = d_p.item() if isinstance(d_p, np.ndarray) and d_p.ndim == 0 else d_p
        problem = self._check.problem(t, q, v, age)
        unknown = "" if u_last is None else self._tell(u_last)
        if problem:
            self._invalid_steps += 1
            return self._count(self._hold(t, problem))
        self._check.accept(t, q.copy(), v.copy())
        dyn = self.robot.evaluate(*(self._sent.predict(q, v, age) if age > 0.0 else (q, v)))
        self._last_g, self._invalid_steps = dyn.g, 0
        allowed = self._sent.allowed(dyn.g)
        try:
            obstacles = self.safety.packed.moved(motions) if motions else None
        except InputError as error:
            unknown = str(error)
        if unknown:
            return self._count(self._fault(dyn, unknown, allowed=allowed))
        return self._count(self.filter(dyn, u_des, d_p, obstacles, allowed, t))

    def _tell(self, u_last: ArrayLike) -> str:
        """Take over the caller's last torque; in words why not, if it cannot be used."""
        u = _numbers(u_last)
        if u.shape != (self.robot.nv,) or not np.isfinite(u).all():
            return f"u_last is not {self.robot.nv} finite numbers"
        self._sent.correct(u)
        return ""

    def filter(
        self,
        dyn: Dynamics,
        u_des: Array,
        d_p: float | None,
        obstacles: Packed | None = None,
        allowed: Box | None = None,
        t: float | None = None,
    ) -> StepResult:
        """The step for a valid state, with the obstacles where they are now.

        ``allowed`` are the bounds of the torque, gravity included, where they are tighter than the box. Without ``t``
        the state stands on its own: nothing is learned from it of the slip of phi.
        """
        safety = self.safety.evaluate(dyn, obstacles)
        if t is not None and self._moved != (obstacles is not None):
            self._change_barrier(obstacles is not None)
        rows = (self.barrier if obstacles is None else self._blind).rows(dyn, safety)
        usable, h, phi = self._survey(rows, u_des, d_p)
        if not usable:
            return self._fault(dyn, _NOT_FINITE, h, phi, allowed=allowed)
        if self._slip is None or t is None:
            return self._answer(dyn, safety, rows, rows, h, phi, u_des, d_p, obstacles is not None, allowed)
        wary = self._slip.wary(t, rows)
        result = self._answer(dyn, safety, rows, wary, h, phi, u_des, d_p, obstacles is not None, allowed)
        if not math.isfinite(result.short):
            self._forget_step()
        elif result.status is not Status.FAULT:
            self._slip.applied(t, rows, result.u if self.gravity_included else result.u + dyn.g, result.short)
        return result

    def _change_barrier(self, moved: bool) -> None:
        """From the trained barrier to the LB-CBF where obstacles are elsewhere, and back."""
        self._moved = moved
        self._forget_step()
        if getattr(self.barrier, "network", None) is not None:
            log.warning("obstacles %s", "are elsewhere: K = 0 until they are back" if moved else "are back: K is, too")

    def _forget_step(self) -> None:
        """The next state cannot be compared with what the last step predicted: torque or obstacles are others."""
        if self._slip is not None:
            self._slip.forget_step()

    def _survey(self, rows: BarrierRows, u_des: Array, d_p: float | None) -> tuple[bool, float, float]:
        """Whether a correction can be sought at all, and the least h and phi."""
        if u_des.shape == (self.robot.nv,) and (d_p is None or is_finite_number(d_p)):
            finite, h, phi = survey(rows.h, rows.phi, rows.Lf_phi, rows.Lg_phi, u_des)
            if finite:
                return True, h, phi
        return False, float(rows.h.min()), float(rows.phi.min())

    def _answer(
        self,
        dyn: Dynamics,
        safety: SafetyRows,
        rows: BarrierRows,
        wary: BarrierRows,
        h: float,
        phi: float,
        u_des: Array,
        d_p: float | None,
        moving: bool,
        allowed: Box | None,
    ) -> StepResult:
        """The step for finite rows, the least of which are ``h`` and ``phi``.

        ``wary`` are the same rows lowered by the slip of phi; ``moving`` says that they are of obstacles which are not
        where the file has them.
        """
        offset = 0.0 if self.gravity_included else dyn.g
        correction, total = self._blind_correction if moving else self.correction, u_des + offset
        pushed = moving and bool((correction.violated(rows, total, allowed is not None) & (safety.drift < 0.0)).any())
        content = Status.PASSIVITY_DROPPED if pushed else Status.CORRECTING
        c = self._correct(correction, dyn, safety, rows, wary, total, d_p, allowed, content)
        if c.status is Status.FAULT:
            return self._fault(dyn, c.reason, h, phi, self._name(c.row), allowed)
        status, reason = c.status, c.reason
        if pushed and status is Status.PASSIVITY_DROPPED:
            status, reason = Status.CORRECTING, "passivity yields to an obstacle that comes closer"
        if status is Status.CORRECTING and c.row >= 0 and self._rests(dyn, c.u):
            status = Status.RESTING
        u = c.u - offset
        port = max(0.0, float(dyn.v @ (u - u_des)) - (d_p or 0.0)) if pushed else 0.0
        return StepResult(u, status, reason, h, phi, self._name(c.row), port, c.short)

    def _correct(
        self, correction: ClosedForm | QPFilter, dyn: Dynamics, safety: SafetyRows, rows: BarrierRows,
        wary: BarrierRows, u_des: Array, d_p: float | None, allowed: Box | None, content: Status,
    ) -> Correction:  # fmt: skip
        """The correction that makes up for the slip of phi, or where that is too much to ask, the one that does not.

        Up to the status ``content`` it is not.
        """
        u_max = self.robot.u_max
        c = correction.correct(dyn, safety, wary, u_des, d_p, u_max, allowed)
        if wary is not rows and c.status > content:
            plain = correction.correct(dyn, safety, rows, u_des, d_p, u_max, allowed)
            c = plain if plain.status < c.status else c
        return c

    def slips(self, count: int) -> SlipBatch | None:
        """What is learned of the slip of phi in so many runs, for :meth:`screen`; None if this filter does not look."""
        return None if self._slip is None else SlipBatch(self._slip.dt, self._slip.time, count)

    def screen(self, dyn: Dynamics, u_des: Array, t: float = 0.0, slips: SlipBatch | None = None) -> Screen:
        """The rows of a batch of valid states at time t, and at which of them the filter leaves u_des (B, nv) as it is.

        At the others, and at all where the rate is limited, :meth:`step_screened` has to be asked.
        """
        safety = self.safety.evaluate(dyn)
        rows = self.barrier.rows(dyn, safety)
        wary = rows if slips is None else slips.wary(t, rows)
        total = u_des if self.gravity_included else u_des + dyn.g
        free, short = self.correction.passes(dyn, wary, total, self.robot.u_max)
        return Screen(free & (not self._sent.rate_limited), short, safety, rows, wary)

    def step_screened(self, dyn: Dynamics, screen: Screen, i: int, u_des: Array, d_p: float | None) -> StepResult:
        """The step for a valid state ``dyn``, number i of a screened batch, after the last one that this filter saw."""
        safety, rows, wary = screen.at(i)
        allowed = self._sent.allowed(dyn.g)
        usable, h, phi = self._survey(rows, u_des, d_p)
        if not usable:
            return self._count(self._fault(dyn, _NOT_FINITE, h, phi, allowed=allowed))
        return self._count(self._answer(dyn, safety, rows, wary, h, phi, u_des, d_p, False, allowed))

    def _fault(
        self,
        dyn: Dynamics,
        reason: str,
        h: float = np.nan,
        phi: float = np.nan,
        row: str = "",
        allowed: Box | None = None,
    ) -> StepResult:
        """``sat(g - K_d v)`` for a valid state without a usable answer: kinetic energy cannot grow under it.

        With a limited rate it is approached at that rate, and may grow on the way.
        """
        self._forget_step()
        u = np.clip(dyn.g - self.damping * dyn.v, *(allowed or (-self.robot.u_max, self.robot.u_max)))
        return StepResult(u if self.gravity_included else u - dyn.g, Status.FAULT, reason, h, phi, row)

    def _rests(self, dyn: Dynamics, u: Array) -> bool:
        """Hardly any speed, now and RESTING_TIME ahead under u."""
        return stays_slow(dyn.v, dyn.Minv, dyn.b, u, RESTING_TIME, self._slow)

    def _name(self, row: int) -> str:
        return self.safety.names[row] if row >= 0 else ""

    def _hold(self, t: float, problem: str) -> StepResult:
        """Gravity torque of the last valid state for at most max_hold, approached at a limited rate; then STOP.

        STOP is zero torque at once. Time is the caller's clock or the count of steps, whichever is longer: the clock
        may be what failed.
        """
        self._forget_step()
        held = self._invalid_steps * self.config.dt
        if self._check.last is not None and is_finite_number(t):
            held = max(held, t - self._check.last[0])
        g, u_max = self._last_g, self.robot.u_max
        if g is not None and held <= self.config.max_hold:
            u = np.clip(g, *(self._sent.allowed(g) or (-u_max, u_max)))
            return StepResult(u if self.gravity_included else u - g, Status.INVALID, problem, np.nan, np.nan, "")
        return StepResult(np.zeros(self.robot.nv), Status.STOP, f"{problem}: engage the brakes", np.nan, np.nan, "")

    def _count(self, result: StepResult) -> StepResult:
        self._log.note(result.status, result.reason, result.row)
        self._sent.append(result.u)
        return result


def _numbers(x: ArrayLike) -> Array:
    """Floats, or an array of no length for what is not numbers, which the checks then refuse."""
    try:
        return np.asarray(x, dtype=float)
    except (TypeError, ValueError):
        return np.zeros(0)
