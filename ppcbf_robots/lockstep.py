"""Many rollouts at once: what :func:`ppcbf_robots.rollout.simulate` does with one, in a fraction of the time.

The dynamics and the rows of all runs are computed together. Where the filter would leave u_des alone (most states), its
answer is known from the rows; everywhere else the filter itself is asked, state by state.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ppcbf_robots.barriers import Barrier
from ppcbf_robots.batch_dynamics import BatchDynamics
from ppcbf_robots.filters import FilterConfig, Status
from ppcbf_robots.problem import Problem
from ppcbf_robots.pushes import Push, push_torques
from ppcbf_robots.robot import Dynamics, RobotModel
from ppcbf_robots.rollout import FIELDS, RK4_STEP, Trajectory, diverged, ended
from ppcbf_robots.safety_filter import SafetyFilter
from ppcbf_robots.specs import Array


@dataclass(frozen=True)
class Case:
    """One run: where it starts, where it is to go, and what is done to it."""

    q: Array  # (nq,)
    v: Array  # (nv,)
    goal: Array  # (nq,)
    pushes: Sequence[Push] = ()
    plant: RobotModel | None = None  # what moves instead of the problem's robot (see ppcbf_robots.plant)


def simulate_together(
    problem: Problem,
    cases: Sequence[Case],
    barrier: Barrier | None,
    config: FilterConfig,
    duration: float,
    meta: dict[str, Any] | None = None,
) -> list[Trajectory]:
    """The trajectories of all cases, each with a filter of its own, without contact.

    States are taken as valid: what the filter does about stale or torn measurements does not come into it.

    Args:
        problem: robot, world and controller; the goals are those of the cases.
        cases: some dozens; all that is recorded is held in memory.
        barrier: None applies u_des as it is.
        config: filter settings; ``dt`` is the control period, rounded to whole integration steps.
        duration: [s].
        meta: stored with every trajectory.
    """
    model, kd = problem.model, problem.robot.controller.gains.kd
    filters = [SafetyFilter(model, problem.safety, barrier, config, kd) for _ in cases] if barrier else []
    slips = filters[0].slips(len(cases)) if filters else None
    substeps = max(1, round(config.dt / RK4_STEP))
    dt = substeps * RK4_STEP
    t = dt * np.arange(max(1, round(duration / dt)) + 1, dtype=float)
    nominal, moved = (BatchDynamics([x or model for x in robots])
                      for robots in ([None] * len(cases), [c.plant for c in cases]))  # fmt: skip
    q, v, goals = (np.array([getattr(c, name) for c in cases]) for name in ("q", "v", "goal"))
    pushed = np.array([push_torques(c.pushes, t, model.nv) for c in cases])
    record, row = _empty(len(t), q, v), [""] * len(cases)
    length = np.full(len(cases), len(t))  # of each run's record
    for k, now in enumerate(t):
        over = length <= k
        q[over], v[over] = goals[over], 0.0  # a run that diverged waits at its goal
        dyn = nominal.evaluate(q, v)
        wanted = problem.robot.controller.evaluate(dyn, goals)
        u, status = wanted.u.copy(), np.zeros(len(cases), dtype=np.int64)
        if filters:
            screen = filters[0].screen(dyn, wanted.u, float(now), slips)
            h, phi, short = screen.safety.h, screen.rows.phi.min(axis=1), screen.short.copy()
            for i in map(int, np.flatnonzero(~screen.free & ~over)):
                result = filters[i].step_screened(_state(dyn, i), screen, i, wanted.u[i], float(wanted.d_p[i]))
                u[i], status[i], row[i], short[i] = result.u, result.status, result.row, result.short
            if slips is not None:
                slips.applied(float(now), screen.rows, u, short, (status != Status.FAULT) & np.isfinite(short))
        else:
            h, phi = problem.safety.evaluate(dyn).h, np.full(len(cases), np.nan)
        clearance = h[:, : problem.safety.pairs].min(axis=1)
        found = (now, q, v, u, wanted.u, h.min(axis=1), clearance, phi, wanted.V, status != 0, status)
        for name, value in zip(FIELDS, found, strict=True):
            record[name][k] = value
        length[diverged(u, v) & ~over] = k + 1
        moved.advance(q, v, u + pushed[:, k], RK4_STEP, substeps)
    runs = []
    for i, case in enumerate(cases):
        fields = {name: x[: length[i], i].copy() for name, x in record.items()}
        facts = {**(meta or {}), "engine": "pinocchio", "contacts": None}
        complete = bool(length[i] == len(t))
        runs.append(ended(fields, facts, case.goal, problem.safety, row[i], (), complete))
    return runs


def _empty(steps: int, q: Array, v: Array) -> dict[str, Any]:
    """Arrays (steps, B, ...) for every field of a trajectory."""
    shapes = {"q": q.shape, "v": v.shape, "u": v.shape, "u_des": v.shape}
    kinds = {"active": np.bool_, "status": np.int64}
    return {name: np.empty((steps, *shapes.get(name, q.shape[:1])), kinds.get(name, float)) for name in FIELDS}


def _state(dyn: Dynamics, i: int) -> Dynamics:
    """One state of a batch."""
    return Dynamics(**{name: x[i] for name, x in vars(dyn).items()})
