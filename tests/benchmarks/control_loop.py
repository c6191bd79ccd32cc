"""What a control loop costs a filter: control period, a plant that is not the model, delays, and limited torque rates.

The LB-CBF under the default filter; clearances and phi are the least at and between the control instants.
Run: ``python tests/benchmarks/control_loop.py``, or with the names of some parts: sampling, plant, rate, delay
"""

from __future__ import annotations

import argparse
import dataclasses
import logging
from collections.abc import Iterator
from typing import Any

import numpy as np
from five_spheres import draw_task

from ppcbf_robots import FilterConfig, Problem, RobotModel, SafetyFilter, Status, load_problem, qp_filter
from ppcbf_robots.controllers import Gains, NominalController
from ppcbf_robots.engines import PinocchioEngine
from ppcbf_robots.plant import perturbed
from ppcbf_robots.specs import PayloadSpec

TASKS = 8
BETWEEN = 4  # looks per control period
GAMMA = 20.0  # [1/s]
BRISK = Gains(
    "bounded_spring",
    np.array([120.0, 90.0, 110.0, 110.0, 18.0, 18.0, 8.0]),
    np.array([14.0, 11.0, 12.0, 11.0, 1.6, 1.6, 0.8]),
    np.array([60.0, 30.0, 50.0, 50.0, 8.0, 8.0, 8.0]),
)  # far stiffer than the derived ones, which ask too little of the loop to tell anything


def run(
    problem: Problem, config: FilterConfig, duration: float, plant: RobotModel | None = None,
    rate: float = np.inf, delay: int = 0, told: bool = False, filtered: bool = True,
) -> dict[str, Any]:  # fmt: skip
    """Figures of one run from the robot's start; ``delay`` in control periods, of state and u_des."""
    model, controller, barrier = problem.model, problem.robot.controller, problem.barrier("lb-cbf")
    safe = SafetyFilter(model, problem.safety, barrier, config, controller.gains.kd, rate=rate)
    engine, dt = PinocchioEngine(plant or model), config.dt
    engine.reset(problem.robot.start, problem.robot.start_velocity)
    history, V, u = [], [], np.zeros(model.nv)
    least = {"h": np.inf, "phi": np.inf}
    for i in range(round(duration / dt)):
        history.append(engine.state())
        q, v = history[max(0, i - delay)]
        nominal = controller.evaluate(model.evaluate(q, v))
        V.append(float(controller.evaluate(model.evaluate(*history[-1])).V))
        age = min(i, delay) * dt if told else 0.0
        u = safe.step(i * dt, q, v, nominal.u, float(nominal.d_p), age=age).u if filtered else nominal.u
        for _ in range(BETWEEN):
            engine.advance(u, dt / BETWEEN, 1)
            dyn = model.evaluate(*engine.state())
            safety = problem.safety.evaluate(dyn)
            least["h"] = min(least["h"], float(safety.h.min()))
            least["phi"] = min(least["phi"], float(barrier.rows(dyn, safety).phi.min()))
        if not np.all(np.abs(engine.state()[1]) < 1e3):
            break
    rise = float(np.max(np.array(V) - np.minimum.accumulate(V)))
    worst = max((s for s, n in safe.counts.items() if n), default=Status.FREE)
    alarms = sum(n for s, n in safe.counts.items() if s >= Status.PASSIVITY_DROPPED)
    return least | {"rise": rise, "V0": V[0], "worst": worst, "alarms": alarms}


def five_spheres(fast: bool) -> Iterator[Problem]:
    """Random tasks of the Panda with BRISK gains; fast: four times the stiffness, up to 60 % of the torque."""
    problem, rng = load_problem("panda", "five_spheres"), np.random.default_rng(0)
    problem = problem.with_barrier_spec(problem.robot.spec.barrier.model_copy(update={"gamma": GAMMA}))
    model, gains = problem.model, BRISK
    if fast:
        gains = Gains("bounded_spring", 4.0 * gains.kp, gains.kd, np.minimum(2.0 * gains.max_spring, 0.6 * model.u_max))
    for _ in range(TASKS):
        start, goal = (model.from_angles(x) for x in draw_task(problem, rng))
        robot = dataclasses.replace(problem.robot, start=start, controller=NominalController(model, gains, goal))
        yield dataclasses.replace(problem, robot=robot)


def worst_of(problems: Iterator[Problem], config: FilterConfig, duration: float, **how: Any) -> str:
    """The worst figures over several tasks, as a line of a table."""
    runs = [run(problem, config, duration, **how) for problem in problems]
    h, phi = (min(r[k] for r in runs) for k in ("h", "phi"))
    rise, alarms = max(r["rise"] for r in runs), sum(r["alarms"] for r in runs)
    return f"{1e3 * h:9.3f} mm | phi {phi:8.4f} | V rises by {rise:8.2g} J | {alarms} steps without a full solution"


def sampling() -> None:
    """Control periods, with and without making up for the slip of phi."""
    for dt in (1e-3, 2e-3, 4e-3, 5e-3):
        for slip_time in (np.inf, 0.01):
            config = FilterConfig(dt=dt, alpha=min(50.0, 0.1 / dt), slip_time=slip_time)
            print(f"{1e3 * dt:g} ms | slip {slip_time:4g} s | {worst_of(five_spheres(True), config, 1.2)}", flush=True)


def plant() -> None:
    """Plants that are not the filter's model."""
    model = load_problem("panda", "five_spheres").model
    plants = {
        "nominal": model,
        "mass, inertia -20 %": perturbed(model, 0.8, 0.8),
        "mass, inertia, CoM +20 %": perturbed(model, 1.2, 1.2, 1.2),
        "payload 2 kg": perturbed(model, payload=PayloadSpec(frame="panda_hand", mass=2.0)),
        "friction 5 % of u_max": perturbed(model, friction=0.05 * model.u_max),
    }
    for name, other in plants.items():
        for slip_time in (np.inf, 0.01):
            figures = worst_of(five_spheres(False), FilterConfig(slip_time=slip_time), 1.5, plant=other)
            print(f"{name} | slip {slip_time:4g} s | {figures}", flush=True)


def rate() -> None:
    """A Franka's 1 N m per ms and less, with class-K gains bounded by the rate and without."""
    bounded = qp_filter.slowest_joint
    for limit in (np.inf, 1000.0, 500.0):
        for name, slowest in (("bounded", bounded), ("as without", lambda robot, rate: np.inf)):
            qp_filter.slowest_joint = slowest
            print(f"{limit:g} N m/s | gains {name} | {worst_of(five_spheres(True), FilterConfig(), 1.2, rate=limit)}",
                  flush=True)  # fmt: skip
    qp_filter.slowest_joint = bounded


def delay() -> None:
    """Delays of state and u_des, told to the filter or not, beside the controller alone."""
    for robot, world, duration in (("cartpole", "wall", 4.0), ("two_link", "circle", 4.0), ("panda", "sphere", 2.5)):
        problem = load_problem(robot, world)
        for steps in (0, 1, 2, 5):
            alone, untold, told = (
                run(problem, FilterConfig(), duration, delay=steps, **how)
                for how in ({"filtered": False}, {}, {"told": True})
            )
            print(f"{robot} | {steps} ms | alone V rises by {alone['rise'] / alone['V0']:.2g} V0", end="")
            for name, r in (("not told", untold), ("told", told)):
                print(f" | {name}: h {1e3 * r['h']:.3f} mm, {r['rise'] / r['V0']:.2g} V0, {r['worst'].name}", end="")
            print(flush=True)


PARTS = {"sampling": sampling, "plant": plant, "rate": rate, "delay": delay}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []], help="all without")
    logging.disable(logging.CRITICAL)
    for part in parser.parse_args().parts or PARTS:
        PARTS[part]()


if __name__ == "__main__":
    main()
