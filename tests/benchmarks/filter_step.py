"""Time of one filter step, from (q, v, u_des) to torque, over the states of a rollout.

Run: ``python tests/benchmarks/filter_step.py panda five_spheres --barrier runs/panda_five``
"""

from __future__ import annotations

import argparse
import json
import logging
import time

import numpy as np

from ppcbf_robots import SafetyFilter, load_problem, simulate
from ppcbf_robots.cli.simulate import choose_barrier


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("robot", default="panda", nargs="?")
    parser.add_argument("world", default="sphere", nargs="?")
    parser.add_argument("--barrier", default="lb-cbf", help="barrier folder, lb-cbf or pp-cbf")
    parser.add_argument("--start", help="comma separated angles")
    args = parser.parse_args()
    logging.disable(logging.CRITICAL)
    problem = load_problem(args.robot, args.world)
    barrier, config = choose_barrier(problem, args.barrier, None, None)
    assert barrier is not None
    q = problem.robot.start
    if args.start:
        q = problem.model.parse_angles([float(x) for x in args.start.split(",")], "--start")
    controller = problem.robot.controller
    safe = SafetyFilter(problem.model, problem.safety, barrier, config, controller.gains.kd)
    run = simulate(problem.safety, controller, safe, q, problem.robot.start_velocity, 3.0)
    d_p = (controller.gains.kd * run.v**2).sum(axis=1)
    safe = SafetyFilter(problem.model, problem.safety, barrier, config, controller.gains.kd)
    times = np.zeros(len(run.t))
    for i in range(len(run.t)):
        began = time.perf_counter()
        safe.step(run.t[i], run.q[i], run.v[i], run.u_des[i], float(d_p[i]))
        times[i] = 1e6 * (time.perf_counter() - began)
    acting = times[run.active]
    facts = {
        "pairs": problem.safety.pairs,
        "rows": problem.safety.rows,
        "steps": len(times),
        "median_us": float(np.median(times)),
        "p99_us": float(np.percentile(times, 99)),
        "max_us": float(times.max()),
        "correcting_steps": len(acting),
        "correcting_median_us": float(np.median(acting)) if len(acting) else None,
    }
    print(json.dumps(facts, indent=2))


if __name__ == "__main__":
    main()
