"""The filter's quadratic program, apart from who solves it.

``min ½ zᵀ H z + gᵀ z  s.t.  C z >= lower,  box_low <= z <= box_high`` in the dimensionless correction z = δ / u_max,
with rows of C of length 1. Solvers return ``None`` unless they claim an optimum; the filter checks the claim itself.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import daqp
import numpy as np
from proxsuite import proxqp

from ppcbf_robots.errors import InputError
from ppcbf_robots.specs import Array

NO_BOUND = 1e20  # ProxQP's infinity
DAQP_NO_BOUND = 1e30  # DAQP's
DAQP_OPTIMAL, DAQP_INFEASIBLE = 1, -1  # its exit flags


class QPProblem(NamedTuple):
    """One QP; see the module's formula."""

    H: Array  # (n, n)
    g: Array  # (n,)
    C: Array  # (m, n)
    lower: Array  # (m,)
    box_low: Array  # (n,)
    box_high: Array  # (n,)


class QPSolver(Protocol):
    """Solves one QP; None when no optimum was found."""

    def solve(self, problem: QPProblem) -> Array | None:
        """(n,) solution or None."""
        ...


class ProxQPSolver:
    """ProxQP, dense, updated in place; one workspace per problem size.

    Every problem starts cold: a start from the last solution saves at most a fifth of the time and, where the problem
    changed, ends "solved" up to 2 % of u_max away from the optimum, or reports a feasible problem as infeasible.
    """

    def __init__(self, eps: float = 1e-8, max_iter: int = 100) -> None:
        self.eps, self.max_iter = eps, max_iter
        self._workspaces: dict[tuple[int, int], Any] = {}

    def solve(self, problem: QPProblem) -> Array | None:
        """(n,) solution, or None unless ProxQP ends with PROXQP_SOLVED."""
        m, n = problem.C.shape
        qp = self._workspaces.get((n, m))
        arguments = (
            problem.H,
            problem.g,
            None,
            None,
            problem.C,
            problem.lower,
            np.full(m, NO_BOUND),
            problem.box_low,
            problem.box_high,
        )
        if qp is None:
            qp = proxqp.dense.QP(n, 0, m, True, proxqp.dense.HessianType.Dense)
            qp.settings.eps_abs, qp.settings.eps_rel = self.eps, 0.0
            qp.settings.check_duality_gap = True  # or it stops with active rows 1e-3 loose, up to 2 % of u_max off
            qp.settings.eps_duality_gap_abs = qp.settings.eps_duality_gap_rel = self.eps
            qp.settings.max_iter, qp.settings.max_iter_in = self.max_iter, 50  # infeasible problems use them up
            qp.settings.initial_guess = proxqp.InitialGuess.EQUALITY_CONSTRAINED_INITIAL_GUESS
            qp.settings.compute_timings = False
            qp.init(*arguments)
            self._workspaces[(n, m)] = qp
        else:
            qp.update(*arguments)
        qp.solve()
        if qp.results.info.status != proxqp.QPSolverOutput.PROXQP_SOLVED:
            return None
        return np.array(qp.results.x)


class DAQPSolver:
    """DAQP, a dense dual active-set solver: exact to rounding, and it tells infeasible problems.

    Where it ends with neither an optimum nor a proof of infeasibility, ProxQP is asked.
    """

    def __init__(self) -> None:
        self._second = ProxQPSolver()

    def solve(self, problem: QPProblem) -> Array | None:
        """(n,) solution, or None unless DAQP ends with an optimum."""
        m, n = problem.C.shape
        upper, lower = np.empty(n + m), np.empty(n + m)
        upper[:n], upper[n:] = problem.box_high, DAQP_NO_BOUND
        lower[:n], lower[n:] = problem.box_low, problem.lower
        x, _, exit_flag, _ = daqp.solve(problem.H, problem.g, problem.C, upper, lower, np.zeros(n + m, dtype=np.int32))
        if exit_flag in (DAQP_OPTIMAL, DAQP_INFEASIBLE):
            return np.asarray(x) if exit_flag == DAQP_OPTIMAL else None
        return self._second.solve(problem)


class QPSolversSolver:
    """Any dense solver installed for the qpsolvers package, by name (``daqp``, ``quadprog``, ...)."""

    def __init__(self, name: str) -> None:
        import qpsolvers

        if name not in qpsolvers.available_solvers:
            available = ", ".join(qpsolvers.available_solvers)
            raise InputError(f"QP solver '{name}' is not installed (available: {available}); pip install it")
        self._name, self._qpsolvers = name, qpsolvers

    def solve(self, problem: QPProblem) -> Array | None:
        """(n,) solution or None."""
        p = problem
        qp = self._qpsolvers.Problem(p.H, p.g, -p.C, -p.lower, lb=p.box_low, ub=p.box_high)
        try:
            solution = self._qpsolvers.solve_problem(qp, solver=self._name)
        except (self._qpsolvers.exceptions.SolverError, ValueError):
            return None
        return np.asarray(solution.x) if solution.found and solution.x is not None else None


def make_solver(name: str) -> QPSolver:
    """``daqp`` and ``proxqp`` through their own interfaces, everything else through qpsolvers."""
    return DIRECT[name]() if name in DIRECT else QPSolversSolver(name)


DIRECT: dict[str, type[DAQPSolver | ProxQPSolver]] = {"daqp": DAQPSolver, "proxqp": ProxQPSolver}
