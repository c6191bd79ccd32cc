"""How long one filter step takes, from (q, v) to torque, whole and by stage, where the QP has to be solved."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ppcbf_robots.barriers import Barrier
from ppcbf_robots.errors import InputError
from ppcbf_robots.evidence import uniform_band
from ppcbf_robots.filters import FilterConfig, Status
from ppcbf_robots.learning.presets import DEFAULT
from ppcbf_robots.network import NumpyNetwork, random_convex
from ppcbf_robots.problem import Problem, Robot
from ppcbf_robots.safety_filter import SafetyFilter
from ppcbf_robots.specs import Array
from ppcbf_robots.world import Obstacle, Sphere, WorldSpec

STATES = 400  # different ones, cycled through
STAGES = ("kinematics and dynamics", "geometry", "network", "QP")
REACH = (0.45, 1.1)  # [m], where the obstacles of a synthetic world stand


@dataclass(frozen=True)
class Case:
    """Figures of one robot in one world; times in microseconds."""

    robot: str
    joints: int
    pairs: int
    filter: str
    solver: str
    steps: int
    median_us: float
    p99_us: float
    max_us: float
    stages: dict[str, float]  # median of each stage

    def as_json(self) -> dict[str, Any]:
        """Plain data, times to a tenth of a microsecond."""
        data = dataclasses.asdict(self)
        times = {k: round(x, 1) for k, x in data.items() if k.endswith("_us")}
        return data | times | {"stages": {k: round(x, 1) for k, x in self.stages.items()}}


def crowd(robot: Robot, pairs: int, seed: int = 0) -> Problem:
    """The robot among as many random balls as give about ``pairs`` pairs with its body."""
    rng = np.random.default_rng(seed)
    balls: list[Obstacle] = []
    while len(balls) < max(1, round(pairs / len(robot.body))):
        center = rng.normal(size=3)
        center *= rng.uniform(*REACH) / np.linalg.norm(center)
        balls.append(Sphere(type="sphere", name=f"ball {len(balls)}", center=center.tolist(), radius=0.03))
    world = WorldSpec(obstacles=balls)
    return Problem(robot, f"{len(balls)} random balls", world, robot.safety(balls))


def default_barrier(problem: Problem) -> Barrier:
    """A PP-NCBF of the default preset's size, random but about as curved as trained ones are.

    Where K bends more within a control period, the QP is solved more often (:mod:`ppcbf_robots.cutting_planes`).
    """
    model, rng = problem.model, np.random.default_rng(0)
    units = DEFAULT.units
    params = random_convex(model.nq, model.nv, DEFAULT.hidden, units, rng)
    params |= {"v_scale": 1.0 / model.v_max, "ba": np.full(units, -3.0), "bb": rng.normal(0.0, 1.0, units * model.nv)}
    params |= {"cone_a": np.array(-2.5), "cone_b": np.full(model.nv, 0.2), "cone_c": np.array(-3.4)}
    params |= {"bowl_a": np.array(-3.2), "bowl_b": np.full(model.nv, 1.1), "bowl_c": np.array(5.5)}
    if model.nv > DEFAULT.covered_joints:
        params |= {"energy_a": np.array(-1.6), "energy_scale": np.array(0.2)}
    return problem.barrier("pp-ncbf", NumpyNetwork("convex", params))


def measure(problem: Problem, barrier: Barrier, config: FilterConfig, steps: int) -> Case:
    """Time ``steps`` filter steps on band states, at rest in none, where the filter has to correct.

    Raises:
        InputError: if no such state is found.
    """
    runtime = SafetyFilter(
        problem.model, problem.safety, barrier, config, problem.robot.controller.gains.kd, rate=np.inf
    )
    states = _states(problem, barrier, runtime)
    whole = np.empty(steps)
    runtime.reset()
    for i in range(steps):
        q, v, u_des, d_p = states[i % len(states)]
        began = time.perf_counter_ns()
        runtime.step(float(i), q, v, u_des, d_p)
        whole[i] = 1e-3 * (time.perf_counter_ns() - began)
    name, body = problem.robot.name, len(problem.robot.body)
    return Case(
        name, problem.model.nv, body * len(problem.safety.obstacles), f"{config.kind}, {config.metric}", config.solver,
        steps, float(np.median(whole)), float(np.percentile(whole, 99)), float(whole.max()),
        _stages(problem, barrier, runtime, states, min(steps, 2000)),
    )  # fmt: skip


def _states(problem: Problem, barrier: Barrier, runtime: SafetyFilter) -> Sequence[tuple[Array, Array, Array, float]]:
    """States of the band with the nominal torque towards a random goal, where the filter corrects."""
    rng, model = np.random.default_rng(0), problem.model
    found: list[tuple[Array, Array, Array, float]] = []
    q, v, _ = uniform_band(problem, barrier, 4 * STATES, rng)
    for i, (qi, vi) in enumerate(zip(q, v, strict=True)):
        goal = model.from_angles(problem.robot.domain.sample_q(rng, 1)[0])
        nominal = problem.robot.controller.with_goal(goal).evaluate(model.evaluate(qi, vi))
        if runtime.step(float(i), qi, vi, nominal.u, float(nominal.d_p)).status is Status.CORRECTING:
            found.append((qi, vi, nominal.u, float(nominal.d_p)))
        if len(found) == STATES:
            break
    if not found:
        raise InputError("no state was found where the filter corrects: the obstacles are out of reach")
    return found


def _stages(
    problem: Problem,
    barrier: Barrier,
    runtime: SafetyFilter,
    states: Sequence[tuple[Array, Array, Array, float]],
    steps: int,
) -> dict[str, float]:
    """Median time of each stage [µs], measured apart from the whole."""
    model, clock = problem.model, time.perf_counter_ns
    times = np.empty((steps, len(STAGES)))
    for i in range(steps):
        q, v, u_des, d_p = states[i % len(states)]
        at = [clock()]
        dyn = model.evaluate(q, v)
        at.append(clock())
        safety = problem.safety.evaluate(dyn)
        at.append(clock())
        rows = barrier.rows(dyn, safety)
        at.append(clock())
        runtime.correction.correct(dyn, safety, rows, u_des, d_p, model.u_max)
        at.append(clock())
        times[i] = 1e-3 * np.diff(at)
    return dict(zip(STAGES, np.median(times, axis=0).tolist(), strict=True))
