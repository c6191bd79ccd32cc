"""Campaigns: closed-loop runs from random safe states to random goals, and what is counted in them.

A case is drawn from the campaign's seed and its own number, so that any of them can be run again by itself.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ppcbf_robots.barriers import Barrier
from ppcbf_robots.engines import Engine
from ppcbf_robots.errors import InputError
from ppcbf_robots.filters import FilterConfig, Status
from ppcbf_robots.lockstep import Case, simulate_together
from ppcbf_robots.plant import perturbed
from ppcbf_robots.problem import Problem
from ppcbf_robots.pushes import Push, PushedEngine, push_torques
from ppcbf_robots.robot import RobotModel
from ppcbf_robots.rollout import Trajectory, simulate
from ppcbf_robots.safety_filter import SafetyFilter
from ppcbf_robots.specs import Array

CLEAR = 0.01  # [m | rad], least h of starts and goals
TRIES = 20_000  # configurations for one start or goal
SPEEDS = 10  # velocities tried per start configuration
MAX_PUSHES = 3
PUSH_SPEED = 0.1  # of v_max, by which a push changes the speed of each joint at most, at the start configuration
PUSH_SECONDS = (0.05, 0.2)
ENERGY_FLOOR = 1e-3  # [J] of V0, below which shares of it say nothing
TORQUE_TOLERANCE = 1e-9  # of u_max
LIMIT_TOLERANCE = 1e-4  # [rad | m] beyond a joint limit: less is what a held torque slips within a control period
RATE_TOLERANCE = 1e-6  # of the largest step

EngineFor = Callable[[RobotModel | None], Engine]  # the engine that moves the problem's robot, or another plant


@dataclass(frozen=True)
class Drawing:
    """How cases are drawn; small and plain, as it is part of what identifies a result."""

    seed: int = 0
    duration: float = 5.0  # [s]
    pushes: bool = False  # up to MAX_PUSHES pulses of torque
    mass_error: float = 0.0  # largest share by which masses and inertias of the plant's links differ from the model's


def draw(problem: Problem, barrier: Barrier | None, drawing: Drawing, index: int) -> Case:
    """Case number ``index``: a start with ``h >= 1 cm`` and ``phi >= 0`` at a random speed, a goal with ``h >= 1 cm``.

    Pushes and masses are drawn apart, so starts and goals are the same with and without them.

    Raises:
        InputError: if no such start or goal is found.
    """
    where, outside, inside = np.random.default_rng([drawing.seed, index]).spawn(3)
    q, v = _start(problem, barrier, where)
    goal = next(_clear(problem, where))
    pushes = list(_pushes(problem.model, q, drawing.duration, outside)) if drawing.pushes else []
    plant = None
    if drawing.mass_error > 0.0:
        factors = inside.uniform(1.0 - drawing.mass_error, 1.0 + drawing.mass_error, problem.model.nv)
        plant = perturbed(problem.model, mass=factors, inertia=factors)
    return Case(q, v, goal, pushes, plant)


def _clear(problem: Problem, rng: np.random.Generator) -> Iterator[Array]:
    """Uniform configurations (nq,) of X with ``h >= CLEAR``, as far as a row has that; InputError if they are rare."""
    wanted, rest = problem.attainable(CLEAR), np.zeros(problem.model.nv)
    for _ in range(TRIES):
        q = problem.model.from_angles(problem.robot.domain.sample_q(rng, 1)[0])
        if np.all(problem.safety.evaluate(problem.model.evaluate(q, rest)).h >= wanted):
            yield q
    raise InputError(
        f"no start or goal found in {TRIES:,} uniform configurations of X (least h of {CLEAR:g} m or rad, and phi >= 0 "
        "at some speed): the obstacles fill the workspace, or the barrier's safe set is empty"
    )


def _start(problem: Problem, barrier: Barrier | None, rng: np.random.Generator) -> tuple[Array, Array]:
    """A safe state: a direction uniform in the velocity domain at a uniform share of its length."""
    domain = problem.robot.domain
    for q in _clear(problem, rng):
        for _ in range(SPEEDS):
            v = rng.uniform() * domain.sample_v(rng, 1)[0]
            if barrier is None:
                return q, v
            dyn = problem.model.evaluate(q, v)
            if barrier.rows(dyn, problem.safety.evaluate(dyn)).phi.min() >= 0.0:
                return q, v
    raise AssertionError("_clear ends with an error")


def _pushes(model: RobotModel, q: Array, duration: float, rng: np.random.Generator) -> Iterator[Push]:
    """Pulses ``M(q) Δv / lasting`` of torque: shares of u_max would be far too much for a light wrist."""
    M = model.evaluate(q, np.zeros(model.nv)).M
    for _ in range(int(rng.integers(1, MAX_PUSHES + 1))):
        lasting = float(np.round(rng.uniform(*PUSH_SECONDS), 3))
        start = float(np.round(rng.uniform(0.0, max(0.0, duration - lasting)), 3))
        yield Push(start, lasting, M @ (rng.uniform(-PUSH_SPEED, PUSH_SPEED, model.nv) * model.v_max) / lasting)


def run_cases(
    problem: Problem,
    barrier: Barrier | None,
    config: FilterConfig,
    cases: Sequence[Case],
    duration: float,
    engine_for: EngineFor | None = None,
    meta: dict[str, Any] | None = None,
) -> list[Trajectory]:
    """The runs of all cases, by Pinocchio's dynamics together, or one by one in another engine.

    Args:
        problem: robot, world and controller.
        cases: some dozens (see :func:`ppcbf_robots.lockstep.simulate_together`).
        barrier: None applies u_des as it is.
        config: filter settings.
        duration: [s].
        engine_for: makes the other engine.
        meta: stored with every trajectory.
    """
    if engine_for is None:
        return simulate_together(problem, cases, barrier, config, duration, meta)
    runs, kd = [], problem.robot.controller.gains.kd
    nominal = engine_for(None) if any(case.plant is None for case in cases) else None
    for case in cases:
        engine = PushedEngine(nominal if case.plant is None and nominal else engine_for(case.plant), case.pushes)
        runtime = SafetyFilter(problem.model, problem.safety, barrier, config, kd) if barrier else None
        controller = problem.robot.controller.with_goal(case.goal)
        run = simulate(problem.safety, controller, runtime, case.q, case.v, duration, config.dt, meta, engine=engine)
        runs.append(run)
    return runs


def outcome(problem: Problem, case: Case, run: Trajectory) -> dict[str, Any]:
    """Figures of one run as JSON.

    ``min_h`` (least h over all rows [m | rad]), ``clearance`` (over obstacles and self-collision pairs [m]),
    ``contact`` (where the engine knows contacts, of the links themselves; else a clearance below 0), ``beyond_limit``
    (a joint more than 0.1 mrad or mm beyond its limit), ``torque`` (largest |u_i| / u_max,i), ``rate`` (largest change
    of torque over its limit, 0 without limits), ``above_V0`` [J] (the most by which V exceeds V0 and the pushes'
    work so far), ``above_V0_share`` (that, of V0), ``largest_rise`` [J] (of V less that work, over its running
    minimum), ``push_work`` [J], ``qp_failures`` (steps in which no torque satisfies all rows, or the solver gave none),
    ``fallbacks`` (steps below the QP with all its rows), ``state`` (how it ended, or ``diverged``), ``goal_error``.
    """
    contacts, end = run.meta["contacts"], run.ending()
    known = np.isfinite(run.h) & np.isfinite(run.V) & np.isfinite(run.u).all(axis=1)  # not all of a run that diverges
    work, rates = _push_work(problem.model, case, run)[known], run.rate_ratios(problem.model)
    unexplained = run.V[known] - work
    rise = float(np.max(unexplained) - unexplained[0])
    h, clearance = run.h[known], float(run.clearance[known].min())
    steps = {status: int(np.sum(run.status == status)) for status in Status}
    failures = steps[Status.INFEASIBLE] + steps[Status.FAULT]
    angles = problem.model.to_angles(run.q[known])
    beyond = [sign * (angles[:, i] - bound) < -LIMIT_TOLERANCE for i, sign, bound in problem.safety.limits]
    return {
        "min_h": float(h.min()),
        "clearance": clearance,
        "contact": clearance < 0.0 if contacts is None else contacts["steps"] > 0,
        "beyond_limit": bool(np.any(beyond)),
        "torque": float(np.max(np.abs(run.u[known]) / problem.model.u_max)),
        "rate": 0.0 if rates is None else float(rates[known[1:] & known[:-1]].max(initial=0.0)),
        "above_V0": rise,
        "above_V0_share": rise / max(float(unexplained[0]), ENERGY_FLOOR),
        "largest_rise": float(np.max(unexplained - np.minimum.accumulate(unexplained))),
        "push_work": float(work[-1]),
        "qp_failures": failures,
        "fallbacks": sum(n for status, n in steps.items() if status >= Status.PASSIVITY_DROPPED),
        "state": "diverged" if end is None else end.state,
        "goal_error": None if end is None else end.goal_error,
    }


def _push_work(model: RobotModel, case: Case, run: Trajectory) -> Array:
    """Work (T,) [J] done by the pushes until each control step: their torque is constant in between."""
    moved = np.diff(model.to_angles(run.q), axis=0)
    moved = np.where(model.continuous, (moved + np.pi) % (2.0 * np.pi) - np.pi, moved)
    pushed = push_torques(case.pushes, run.t, model.nv)[:-1]
    return np.concatenate([[0.0], np.cumsum((pushed * moved).sum(axis=1))])


def total(outcomes: Mapping[int, dict[str, Any]]) -> dict[str, Any]:
    """Figures of a campaign from those of its runs, by their numbers.

    ``contacts``, ``limit_violations``, ``torque_violations``, ``rate_violations`` and ``diverged`` count runs,
    ``qp_failures`` and ``fallbacks`` control steps. ``worst`` holds the runs of least h, largest rise and most torque.
    """
    runs = list(outcomes.values())

    def values(name: str) -> list[Any]:
        return [run[name] for run in runs]

    def worst(name: str, sign: float) -> int:
        return max(outcomes, key=lambda index: sign * outcomes[index][name])

    states = values("state")
    return {
        "rollouts": len(runs),
        "contacts": sum(values("contact")),
        "limit_violations": sum(values("beyond_limit")),
        "torque_violations": sum(x > 1.0 + TORQUE_TOLERANCE for x in values("torque")),
        "rate_violations": sum(x > 1.0 + RATE_TOLERANCE for x in values("rate")),
        "diverged": states.count("diverged"),
        "qp_failures": sum(values("qp_failures")),
        "fallbacks": sum(values("fallbacks")),
        "max_above_V0": max(values("above_V0")),
        "max_above_V0_share": max(values("above_V0_share")),
        "max_rise": max(values("largest_rise")),
        "median_rise": float(np.median(values("largest_rise"))),
        "min_h": min(values("min_h")),
        "median_min_h": float(np.median(values("min_h"))),
        "min_clearance": min(values("clearance")),
        "max_torque_ratio": max(values("torque")),
        "goals_reached": states.count("goal"),
        "resting": states.count("held"),
        "stalled": states.count("stalled"),
        "moving": states.count("moving"),
        "failed": sorted(index for index, run in outcomes.items() if _failed(run)),
        "worst": {
            "min_h": worst("min_h", -1.0),
            "largest_rise": worst("largest_rise", 1.0),
            "torque": worst("torque", 1.0),
        },
    }


def _failed(run: dict[str, Any]) -> bool:
    """Whether a run touched something, left a bound or diverged."""
    bounds = run["torque"] > 1.0 + TORQUE_TOLERANCE or run["rate"] > 1.0 + RATE_TOLERANCE or run["beyond_limit"]
    return bool(run["contact"] or bounds or run["state"] == "diverged")
