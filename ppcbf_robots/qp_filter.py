"""The runtime filter's correction: the least one that a QP over all rows, torque box and passivity allows."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ppcbf_robots.barriers import Barrier, BarrierRows
from ppcbf_robots.condense import accept, dimensionless, falling_short, hold_at, inside, near, nearest, pick, power_row
from ppcbf_robots.cutting_planes import EndOfPeriod, hold_to_the_end
from ppcbf_robots.filters import Box, Correction, FilterConfig, Status, free_power, slowest_joint
from ppcbf_robots.qp import QPProblem, QPSolver, make_solver
from ppcbf_robots.robot import Dynamics
from ppcbf_robots.safety import SafetyFunction, SafetyRows
from ppcbf_robots.specs import Array

log = logging.getLogger(__name__)

Row = tuple[Array, float]  # (n,) of length 1 and its lower bound
Solution = tuple[Array, int]  # dimensionless correction and the row that it rests on, -1 if none

_TINY = 1e-12
_FLAT = 1e-9  # length of a row, in units of phi̇ per full torque, below which no torque steers it
ROW_TOLERANCE = 1e-6  # of the dimensionless rows, when a solver's claim is checked
TIGHT = 1e-4  # residual of a dimensionless row below which the correction rests on it
LOOSE = 1e-3  # by which a solver's answer may be outside its bounds
ROUNDS = 4  # in which rows that an answer misses join those handed to the solver
CUTS = 8  # times that a torque is asked for again because of what K does over the period; three light joints took six
SHORT = 0.4  # of alpha margin, by which a row may fall short over the period: phi still settles above 0. Far from
# there it may fall twice as fast as alpha says
LEAST_VIOLATION_WEIGHT = 1e4  # of the squared violation against the squared correction in the fallback QP


@dataclass(frozen=True)
class QPRows:
    """The QP but for its passivity row: of the dimensionless correction z, rows ``C z >= lower`` and a box.

    The barrier's rows come before the velocity domain's.
    """

    C: Array  # (rows, nv), of length 1
    lower: Array  # (rows,)
    norm: Array  # (rows,) length before, in units of phi̇ per full torque
    binding: NDArray[np.bool_]  # (rows,) whether some torque in the box breaks the row
    source: NDArray[np.int_]  # (rows,) number of each in the safety function, the velocity domain's last
    barrier_rows: int
    H: Array  # (nv, nv) metric of z
    box: Box  # (nv,) bounds of z
    limits: str  # what the box holds, in words

    def without_speed(self) -> QPRows:
        """The barrier's rows alone."""
        n = self.barrier_rows
        C, lower, norm, binding, source = (x[:n] for x in self._arrays())
        return QPRows(C, lower, norm, binding, source, n, self.H, self.box, self.limits)

    def after(self, cuts: QPRows) -> QPRows:
        """More rows of the barrier, and then these."""
        pairs = zip(cuts._arrays(), self._arrays(), strict=True)
        C, lower, norm, binding, source = (np.concatenate(pair) for pair in pairs)
        count = cuts.barrier_rows + self.barrier_rows
        return QPRows(C, lower, norm, binding, source, count, self.H, self.box, self.limits)

    def _arrays(self) -> tuple[Any, ...]:
        return self.C, self.lower, self.norm, self.binding, self.source


class QPFilter:
    """The QP over near rows, torque box and passivity row, with its ladder of answers when there is no solution.

    Rows are ``psi_k(u) >= -alpha (phi_k - margin) - fast_alpha max(0, min(ḣ_k, phi_k))`` (of the PP-CBF
    ``psi_k(u) >= -gamma_K phi_k``), the velocity domain's, and ``vᵀ δ <= d_p + FREE_POWER u_max · v_max``. The near
    rows are those closest to violation by u_des, each in units of the correction it needs; the others are checked
    afterwards and join if they are violated, so the answer satisfies all rows. Where there is no
    solution, the velocity domain is given up first, then passivity; then the least violation is sought.

    Where K_theta is convex in v, a torque under which K rises further by the end of the control period than its rate
    says, be it u_des, is asked for again with K's tangent there (see :mod:`ppcbf_robots.cutting_planes`), as long as a
    solution is found.

    Under a limited rate no class-K gain is above the least ``rate / u_max`` of all joints: a row that comes into force
    faster than a torque can be built up finds no solution, and what then follows throws the arm about.

    Args:
        barrier: gives the rows.
        safety: what they are rows of.
        config: settings.
        rate: of the torques (nv,) [N m/s | N/s]; matters where ``correct`` is given bounds of the torque.
    """

    def __init__(
        self, barrier: Barrier, safety: SafetyFunction, config: FilterConfig, rate: Array | None = None
    ) -> None:
        self.barrier, self.safety, self.config = barrier, safety, config
        self.fastest = np.inf if rate is None else slowest_joint(safety.robot, rate)
        self.solver: QPSolver = make_solver(config.solver)
        network = getattr(barrier, "network", None)
        self._convex = network if network is not None and network.kind == "convex" else None
        self._gains = self._class_k(False), self._class_k(True)
        self._free_power, self._kinetic = free_power(safety.robot), config.metric == "kinetic"
        self._every_row = np.arange(safety.rows + 2 * len(safety.v_domain))

    def _class_k(self, limited: bool) -> tuple[float, float, float, float]:
        """Class-K gains [1/s]: of the barrier's rows, added where pairs separate, of the velocity domain; margin."""
        fastest, fast = self.fastest if limited else np.inf, self.config.fast_alpha
        if self.barrier.kind == "pp-cbf":
            return min(self.barrier.spec.gamma_K, fastest), 0.0, min(fast, fastest), 0.0
        alpha = min(self.config.alpha, fastest)
        return alpha, min(fast, fastest - alpha), min(fast, fastest), self.config.margin

    def violated(self, rows: BarrierRows, u: Array, limited: bool) -> NDArray[np.bool_]:
        """(rows,): whether a torque u (nv,) breaks the barrier's rows; ``limited`` if its rate is."""
        alpha, release, _, margin = self._gains[limited]
        class_k = alpha * (rows.phi - margin) + release * np.maximum(0.0, np.minimum(rows.hdot, rows.phi))
        return np.asarray(rows.psi(u) < -class_k)

    def passes(self, dyn: Dynamics, rows: BarrierRows, u_des: Array, u_max: Array) -> tuple[NDArray[np.bool_], Array]:
        """For a batch of states and no limited rate: whether :meth:`correct` leaves u_des (B, nv) as it is, (B,).

        And where it does, ``short`` (B,) of its answer.
        """
        hold, short = np.empty(len(u_des), dtype=np.bool_), np.zeros(len(u_des))
        alpha, release, _, margin = gains = self._gains[False]
        hold_at(
            rows.hdot, rows.phi, rows.Lf_phi, rows.Lg_phi, dyn.Minv, dyn.b, dyn.v, self.safety.v_domain, u_des, u_max,
            *gains, _FLAT, ROW_TOLERANCE, hold,
        )  # fmt: skip
        if self._convex is not None:
            layers, form = self._convex.compiled()
            hold_to_the_end(
                dyn.q, dyn.v, u_des, dyn.M, dyn.Minv, dyn.b, self.config.dt, self._convex.energy, layers, form,
                rows.hdot, rows.phi, rows.Lf_phi, rows.Lg_phi, alpha, release, margin, SHORT, hold, short,
            )  # fmt: skip
        return hold, short

    def _condense(
        self,
        dyn: Dynamics,
        rows: BarrierRows,
        source: NDArray[np.int_],
        u_des: Array,
        u_max: Array,
        allowed: Box | None,
    ) -> tuple[QPRows, int, bool]:
        """The QP's rows, those of the velocity domain too where ``source`` counts them."""
        count, nv = len(source), len(u_max)
        C, lower, norm = np.empty((count, nv)), np.empty(count), np.empty(count)
        binding, low, high = np.empty(count, dtype=np.bool_), np.empty(nv), np.empty(nv)
        lowest, highest = allowed or (-u_max, u_max)
        hopeless, hold, H = dimensionless(
            rows.hdot, rows.phi, rows.Lf_phi, rows.Lg_phi, dyn.Minv, dyn.b, dyn.v, self.safety.v_domain, u_des, u_max,
            lowest, highest, self._kinetic, *self._gains[allowed is not None], _FLAT, ROW_TOLERANCE,
            C, lower, norm, binding, low, high,
        )  # fmt: skip
        limits = "box" if allowed is None else "box and rate"
        return QPRows(C, lower, norm, binding, source, len(rows.phi), H, (low, high), limits), hopeless, hold

    def correct(
        self,
        dyn: Dynamics,
        safety: SafetyRows,
        rows: BarrierRows,
        u_des: Array,
        d_p: float | None,
        u_max: Array,
        allowed: Box | None = None,
    ) -> Correction:
        """The least correction in the configured metric, checked before it is returned; ``rows`` say all of safety.

        ``allowed`` are the bounds of the torque where they are tighter than u_max, as by its rate.
        """
        qp, hopeless, hold = self._condense(dyn, rows, self._every_row, u_des, u_max, allowed)
        passivity = None if hold else self._passivity_row(dyn, d_p, u_max)
        answer = (
            Correction(u_des, Status.FREE, "all rows hold at u_des", -1)
            if hold
            else self._ladder(qp, hopeless, passivity, u_des, u_max)
        )
        if self._convex is not None:
            K = EndOfPeriod(self._convex, dyn, self.config.dt)
            answer = self._to_the_end(K, answer, dyn, rows, qp, u_des, d_p, u_max, allowed)
        return answer if allowed is None else replace(answer, u=np.clip(answer.u, *allowed))

    def _to_the_end(
        self, K: EndOfPeriod, answer: Correction, dyn: Dynamics, rows: BarrierRows, qp: QPRows, u_des: Array,
        d_p: float | None, u_max: Array, allowed: Box | None,
    ) -> Correction:  # fmt: skip
        """The answer for the K that the period ends with, where ``answer`` lets rows of ``qp`` fall short."""
        alpha, _, _, margin = self._gains[allowed is not None]
        first, tangent = qp, K.tangent(answer.u)
        for _ in range(CUTS if answer.status <= Status.CORRECTING else 0):
            z = (answer.u - u_des) / u_max
            which = falling_short(
                first.C, first.lower, first.norm, rows.phi, z, tangent.short, alpha, margin, SHORT, _FLAT
            )
            if not len(which):
                break
            cuts, hopeless, _ = self._condense(dyn, tangent.of(rows, which), which, u_des, u_max, allowed)
            if hopeless >= 0:
                break
            solved, qp = self._with_or_without_speed(qp.after(cuts), self._passivity_row(dyn, d_p, u_max))
            if solved is None:
                break
            answer = self._answer(solved[0], u_des, u_max, Status.CORRECTING, self._said(qp), solved[1])
            tangent = K.tangent(answer.u)
        return Correction(answer.u, answer.status, answer.reason, answer.row, tangent.short)

    def _ladder(self, qp: QPRows, hopeless: int, passivity: Row | None, u_des: Array, u_max: Array) -> Correction:
        """The QP, and what takes its place where it has no solution."""
        if hopeless >= 0:
            flat = qp.norm[hopeless] < _FLAT
            reason = "L_g phi is zero on a violated row" if flat else f"a row is out of reach of the torque {qp.limits}"
            z = self._least_violation(qp)
            return self._answer(z, u_des, u_max, Status.INFEASIBLE, reason, int(qp.source[hopeless]))
        solved, qp = self._with_or_without_speed(qp, passivity)
        if solved is not None:
            return self._answer(solved[0], u_des, u_max, Status.CORRECTING, self._said(qp), solved[1])
        if passivity is not None:
            solved = self._solve(qp, None)
        if solved is not None:
            reason = f"rows and {qp.limits} allow no passive torque"
            return self._answer(solved[0], u_des, u_max, Status.PASSIVITY_DROPPED, reason, solved[1])
        z = self._least_violation(qp)
        k = int(qp.source[np.argmax(qp.lower[: qp.barrier_rows])])
        return self._answer(z, u_des, u_max, Status.INFEASIBLE, f"no torque in the {qp.limits} satisfies all rows", k)

    def _with_or_without_speed(self, qp: QPRows, passivity: Row | None) -> tuple[Solution | None, QPRows]:
        """The QP, or where that has no solution, the one that may leave the velocity domain: the least evil."""
        solved = self._solve(qp, passivity)
        if solved is None and len(qp.lower) > qp.barrier_rows:
            qp = qp.without_speed()
            solved = self._solve(qp, passivity)
        return solved, qp

    def _said(self, qp: QPRows) -> str:
        given_up = len(self.safety.v_domain) and len(qp.lower) == qp.barrier_rows
        return "constraint active, the velocity domain given up" if given_up else "constraint active"

    def _passivity_row(self, dyn: Dynamics, d_p: float | None, u_max: Array) -> Row | None:
        """vᵀ δ <= d_p + free_power as (row, lower) of length 1; None where every torque satisfies it."""
        if d_p is None:
            return None
        row, lower, binds = power_row(dyn.v, u_max, d_p + self._free_power, _TINY)
        return (row, lower) if binds else None

    def _solve(self, qp: QPRows, passivity: Row | None) -> Solution | None:
        """The QP over the near rows, checked against all rows; None if there is no solution or the check fails."""
        zero, passive = np.zeros(len(qp.H)), passivity is not None
        one_more = passivity or (zero, 0.0)
        chosen, rows, bounds = near(qp.C, qp.lower, qp.binding, self.config.near_rows, *one_more, passive)
        missed = np.empty(len(qp.lower), dtype=np.bool_)
        for _ in range(ROUNDS):
            answer = self._ask(QPProblem(qp.H, zero, rows, bounds, *qp.box))
            if answer is None:
                return None
            z, count, tightest, least = accept(
                qp.C, qp.lower, qp.binding, *qp.box, *one_more, passive, ROW_TOLERANCE, answer, missed
            )
            if count == 0:
                return z, int(qp.source[tightest]) if least < TIGHT else -1
            if count < 0 or missed[chosen].any():
                return None  # the solver claims what does not hold
            chosen = np.union1d(chosen, np.flatnonzero(missed))
            rows, bounds = pick(qp.C, qp.lower, chosen, *one_more, passive)
        return None

    def _least_violation(self, qp: QPRows) -> Array | None:
        """Torque in the box with the least worst violation of the barrier's rows: one slack, heavily weighted."""
        n, box = len(qp.H), qp.box
        steerable = np.flatnonzero(qp.binding[: qp.barrier_rows] & (qp.norm[: qp.barrier_rows] >= _FLAT))
        best = np.clip(np.zeros(n), *box)
        if not len(steerable):
            return best
        C, lower = qp.C[steerable], qp.lower[steerable]
        reach = np.maximum(C * box[0], C * box[1]).sum(-1)
        lower = np.minimum(lower, reach)  # each row falls short by what is out of its own reach in any case
        few = nearest(lower, np.ones(len(lower), dtype=np.bool_), self.config.near_rows)
        H = np.zeros((n + 1, n + 1))
        H[:n, :n] = qp.H
        H[n, n] = LEAST_VIOLATION_WEIGHT
        rows, enough = np.hstack([C, np.ones((len(C), 1))]), lower - LOOSE * np.maximum(1.0, np.abs(lower))
        low, high = np.append(box[0], 0.0), np.append(box[1], 1e6)
        for _ in range(ROUNDS):
            z = self._ask(QPProblem(H, np.zeros(n + 1), rows[few], lower[few], low, high))
            if z is None:
                return None
            best, missed = np.clip(z[:n], *box), rows @ z < enough
            if missed[few].any():
                return None  # the solver claims less of a violation than there is
            if not missed.any():
                break
            few = np.union1d(few, np.flatnonzero(missed))
        return best

    def _ask(self, problem: QPProblem) -> Array | None:
        """The solver's answer if it is one: of the right length and in the box. Whatever a solver raises is none."""
        try:
            z = self.solver.solve(problem)
        except Exception as error:
            log.warning("the QP solver failed: %s", error)
            return None
        if z is None or np.shape(z) != problem.g.shape:
            return None
        return z if inside(z, problem.box_low, problem.box_high, LOOSE) else None

    @staticmethod
    def _answer(z: Array | None, u_des: Array, u_max: Array, status: Status, reason: str, row: int) -> Correction:
        if z is None:
            return Correction(u_des, Status.FAULT, "the QP solver gave no usable answer", row)
        return Correction(np.minimum(np.maximum(u_des + z * u_max, -u_max), u_max), status, reason, row)
