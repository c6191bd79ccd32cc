"""Which states a nonlinear model predictive controller finds safe: section 5.4 and Fig. 6 of the paper.

From each initial state one optimal control problem is solved by IPOPT: N steps of dt (RK4, torque held, multiple
shooting), ``|u| <= u_max`` and ``h_k >= 0`` at every step. A state counts as safe if a trajectory that meets all of
this is found within the allowed iterations. The paper leaves open what is minimised; here it is

    Σ |q - q_d|² + 0.1 |v|² + 0.001 |u / u_max|²

with the robot's goal q_d (the cart at 1 m, the pole hanging), and it does not say what is iterated 50 times; here it is
IPOPT. There is no terminal set: an answer says nothing of what comes after N dt, unlike a barrier or the viable set.

Needs the extra ``study`` (casadi).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from ppcbf_robots.problem import Problem, load_problem
from ppcbf_robots.specs import Array
from ppcbf_robots.symbolic import forward_dynamics, safety_rows

SPEED_WEIGHT, TORQUE_WEIGHT = 0.1, 1e-3  # [s²], [-]
VIOLATION = 1e-4  # [m | rad | their rates], of a constraint, below which a trajectory counts as found


@dataclass(frozen=True)
class Settings:
    """What the paper gives of its predictive controller."""

    steps: int = 80  # N
    dt: float = 0.025  # [s]
    iterations: int = 50  # of IPOPT


class Planner:
    """The optimal control problem of a robot in its world, for any initial state.

    Raises:
        InputError: for obstacles or pairs that the symbolic rows do not know.
    """

    def __init__(self, problem: Problem, settings: Settings) -> None:
        model, nv = problem.model, problem.model.nv
        self.nv, self.steps = nv, settings.steps
        a, h = forward_dynamics(model), safety_rows(problem.safety)
        self.h = h
        step = _rk4(a, nv, settings.dt)
        goal = ca.DM(model.to_angles(problem.robot.goal))
        start = ca.SX.sym("start", 2 * nv)
        x = [start, *(ca.SX.sym(f"x{k}", 2 * nv) for k in range(1, settings.steps + 1))]
        u = [ca.SX.sym(f"u{k}", nv) for k in range(settings.steps)]  # in units of u_max
        cost, gaps = ca.SX(0.0), []
        for k in range(settings.steps):
            gaps.append(x[k + 1] - step(x[k], u[k] * ca.DM(model.u_max)))
            offset, v = x[k + 1][:nv] - goal, x[k + 1][nv:]
            cost += ca.dot(offset, offset) + SPEED_WEIGHT * ca.dot(v, v) + TORQUE_WEIGHT * ca.dot(u[k], u[k])
        kept = [h(xk[:nv]) for xk in x[1:]]
        self.shooting, self.rows = 2 * nv * settings.steps, problem.safety.rows * settings.steps
        nlp: dict[str, Any] = {"x": ca.vertcat(*x[1:], *u), "p": start, "f": cost, "g": ca.vertcat(*gaps, *kept)}
        options: dict[str, Any] = {"ipopt.max_iter": settings.iterations, "ipopt.print_level": 0, "print_time": False,
                   "ipopt.sb": "yes", "error_on_fail": False}  # fmt: skip
        self.solver = ca.nlpsol("nmpc", "ipopt", nlp, options)

    def plan(self, angles: Array, v: Array) -> tuple[bool, str, int]:
        """Whether a trajectory was found from angles (nv,), v (nv,), IPOPT's word and its iterations.

        IPOPT starts from the robot resting at the initial configuration, without torque.
        """
        if self.h(angles).full().min() < 0.0:
            return False, "Collides_At_Start", 0
        start = np.concatenate([angles, v])
        resting = np.concatenate([angles, np.zeros(self.nv)])
        torques = self.steps * self.nv
        free = np.full(self.shooting, np.inf)
        solution = self.solver(
            x0=np.concatenate([np.tile(resting, self.steps), np.zeros(torques)]),
            p=start,
            lbx=np.concatenate([-free, -np.ones(torques)]),
            ubx=np.concatenate([free, np.ones(torques)]),
            lbg=np.zeros(self.shooting + self.rows),
            ubg=np.concatenate([np.zeros(self.shooting), np.full(self.rows, np.inf)]),
        )
        g = solution["g"].full()[:, 0]
        worst = max(float(np.abs(g[: self.shooting]).max()), -float(g[self.shooting :].min()))
        stats = self.solver.stats()
        return bool(worst <= VIOLATION), str(stats["return_status"]), int(stats["iter_count"])


def _rk4(a: ca.Function, nv: int, dt: float) -> ca.Function:
    """The state dt later under a torque that is held."""
    x, u = ca.SX.sym("x", 2 * nv), ca.SX.sym("u", nv)

    def rate(x: Any) -> Any:
        return ca.vertcat(x[nv:], a(x[:nv], x[nv:], u))

    k1 = rate(x)
    k2 = rate(x + dt / 2.0 * k1)
    k3 = rate(x + dt / 2.0 * k2)
    k4 = rate(x + dt * k3)
    return ca.Function("step", [x, u], [x + dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)])


@lru_cache(maxsize=1)
def planner(robot: str, world: str, settings: Settings) -> Planner:
    """The planner of a robot and a world by name or path, built once per process."""
    return Planner(load_problem(robot, world), settings)


def judge(
    robot: str, world: str, settings: Settings, angles: tuple[float, ...], v: tuple[float, ...]
) -> dict[str, Any]:
    """One point of Fig. 6 as plain data, for a worker process: ``safe``, ``status`` (IPOPT's), ``iterations``."""
    safe, status, iterations = planner(robot, world, settings).plan(np.array(angles), np.array(v))
    return {"safe": safe, "status": status, "iterations": iterations}
