"""Random reaching tasks through obstacles: contacts, torques, energy and goals reached, with and without the filter.

Starts and goals are uniform in joint space, clear of all obstacles by 2 cm, and their straight joint-space path enters
an obstacle by 3 cm or more. Run: ``python tests/benchmarks/five_spheres.py --barrier runs/panda_five``
"""

from __future__ import annotations

import argparse
import json
import logging
import sys
import time

import numpy as np

from ppcbf_robots import SafetyFilter, load_problem, simulate
from ppcbf_robots.cli.simulate import choose_barrier
from ppcbf_robots.problem import Problem
from ppcbf_robots.specs import Array


def clearance(problem: Problem, angles: Array) -> float:
    """Least distance to an obstacle [m], joint limits not counted."""
    q = problem.model.from_angles(angles)
    dyn = problem.model.evaluate(q, np.zeros(problem.model.nv))
    return float(problem.safety.evaluate(dyn).h[: problem.safety.pairs].min())


def draw_task(problem: Problem, rng: np.random.Generator) -> tuple[Array, Array]:
    """Start and goal angles of one task."""
    domain = problem.robot.domain
    while True:
        start, goal = domain.sample_q(rng, 2)
        if min(clearance(problem, start), clearance(problem, goal)) < 0.02:
            continue
        path = start + np.linspace(0.0, 1.0, 41)[:, None] * (goal - start)
        if min(clearance(problem, x) for x in path) <= -0.03:
            return start, goal


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robot", default="panda")
    parser.add_argument("--world", default="five_spheres")
    parser.add_argument("--barrier", default="lb-cbf", help="barrier folder, lb-cbf or none")
    parser.add_argument("--rollouts", type=int, default=50)
    parser.add_argument("--duration", type=float, default=3.0)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    logging.disable(logging.CRITICAL)
    problem, rng = load_problem(args.robot, args.world), np.random.default_rng(args.seed)
    barrier, config = choose_barrier(problem, args.barrier, None, None)
    results, began = [], time.monotonic()
    for i in range(args.rollouts):
        start, goal = draw_task(problem, rng)
        task = problem.with_goal(problem.model.from_angles(goal))
        gains = task.robot.controller.gains
        safe = SafetyFilter(task.model, task.safety, barrier, config, gains.kd) if barrier else None
        q, v = task.model.from_angles(start), np.zeros(task.model.nv)
        run = simulate(task.safety, task.robot.controller, safe, q, v, args.duration)
        results.append(run.summary(task.model))
        print(f"\r{i + 1}/{args.rollouts}", end="", file=sys.stderr)
    print(file=sys.stderr)
    counts: dict[str, int] = {}
    for r in results:
        for k, n in r["filter_counts"].items():
            counts[k] = counts.get(k, 0) + n
    summary = {
        "rollouts": len(results),
        "contacts": sum(r["clearance"] < 0.0 for r in results),
        "min_clearance": min(r["clearance"] for r in results),
        "max_torque_ratio": max(r["max_torque_ratio"] for r in results),
        "max_injected": max(r["injected"] for r in results),
        "max_energy_rise": max(r["energy_rise"] for r in results),
        "reached": sum(r["reached_goal"] for r in results),
        "resting": sum(r["rests_on"] is not None for r in results),
        "steps": counts,
        "seconds": round(time.monotonic() - began, 1),
    }
    print(json.dumps(summary, indent=2))


if __name__ == "__main__":
    main()
