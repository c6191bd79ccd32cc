"""Every arm in every world: train, then move from one side of the obstacle to the other in MuJoCo with contacts on.

The bundled worlds are scaled to each arm's reach and set before its first joint. Start and goal are drawn on opposite
sides (left and right of the arm's middle plane), clear of everything by 2 cm, with an obstacle on the straight path
between them. A run takes 15 s, or 60 s where the arm still moves then. One JSON object per case is appended to the
output; cases already there are skipped. Without the output file all run again, with the barriers that are there.

Run: ``python tests/benchmarks/arms_and_worlds.py --out runs/arms.jsonl``, then ``--table`` for the README's table.
"""

from __future__ import annotations

import argparse
import json
import logging
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from ppcbf_robots import load_problem
from ppcbf_robots.benchmark import measure
from ppcbf_robots.cli.simulate import choose_barrier, run
from ppcbf_robots.cli.train import train_barrier
from ppcbf_robots.evidence import check_band
from ppcbf_robots.filters import FilterConfig
from ppcbf_robots.problem import Problem, Robot, load_robot
from ppcbf_robots.resources import find_world
from ppcbf_robots.specs import Array
from ppcbf_robots.world_files.load import load_world
from ppcbf_robots.world_files.write import write_world

ARMS = ("panda", "panda_collision", "ur3", "ur5", "ur10", "kinova", "z1", "xarm7", "talos_left_arm", "baxter_left",
        "tiago_no_hand", "so101")  # fmt: skip
WORLDS = ("table_boxes", "shelf", "pillar")
SIZED_FOR = 0.92  # [m], reach of the Panda, which the bundled worlds suit
SHOULDER = 0.333  # [m], height of its first joint
LB_STATES = 5_000
STILL = 1e-4  # [rad/s], of the largest joint error: slower is no approach
DURATIONS = (15.0, 60.0)  # [s]; the longer one where the arm still moves after the shorter


def reach(robot: Robot) -> float:
    """How far from the first joint some body sphere's centre gets in all but 5 % of X's configurations [m]."""
    model, body = robot.model, robot.body
    q = model.from_angles(robot.domain.sample_q(np.random.default_rng(0), 500))
    dyn = model.evaluate_batch(q, np.zeros((500, model.nv)))
    p = model.points([s.frame for s in body], np.array([s.center for s in body])).kinematics(dyn).p
    return float(np.percentile(np.linalg.norm(p - dyn.placements[:, 1, None, :3, 3], axis=-1).max(axis=1), 95))


def fitted_world(robot: Robot, world: str, folder: Path) -> Path:
    """The bundled world, scaled and moved to the arm, as a file."""
    model, scale = robot.model, reach(robot) / SIZED_FOR
    first = model.evaluate(model.from_angles(np.zeros(model.nv)), np.zeros(model.nv)).placements[1, :3, 3]
    origin = first - np.array([0.0, 0.0, scale * SHOULDER])
    spec = load_world(find_world(world))
    moved = []
    for o in spec.obstacles:
        change: dict[str, Any] = {k: scale * getattr(o, k) for k in ("radius", "length") if hasattr(o, k)}
        if hasattr(o, "size"):
            change["size"] = [scale * x for x in o.size]
        for key in ("xyz", "center"):
            if hasattr(o, key):
                change[key] = (origin + scale * np.array(getattr(o, key))).tolist()
        if hasattr(o, "normal"):
            change["offset"] = scale * o.offset + float(origin @ np.array(o.normal))
        moved.append(o.model_copy(update=change))
    path = folder / f"{world}.yaml"
    write_world(spec.model_copy(update={"obstacles": moved}), path, f"{world} for this arm", overwrite=True)
    return path


def clearance(problem: Problem, q: Array) -> tuple[float, float, float]:
    """Least distance to an obstacle, least h of all rows, and y of the tip against the first joint [m]."""
    model = problem.model
    dyn = model.evaluate(q, np.zeros(model.nv))
    h = problem.safety.evaluate(dyn).h
    tip = problem.safety.points.kinematics(dyn).p[-1]
    return float(h[: problem.safety.pairs].min()), float(h.min()), float(tip[1] - dyn.placements[1, 1, 3])


def draw_task(problem: Problem, rng: np.random.Generator, tries: int = 4000) -> tuple[Array, Array] | None:
    """Start and goal (nq,) on opposite sides, or None if no straight path between such meets an obstacle."""
    model, domain, side = problem.model, problem.robot.domain, 0.15 * reach(problem.robot)
    left, right = [], []
    for q in model.from_angles(domain.sample_q(rng, tries)):
        distance, least, y = clearance(problem, q)
        if distance >= 0.02 and least > 0.0 and abs(y) > side:
            (left if y > 0 else right).append(q)
    for start, goal in zip(left, right, strict=False):
        way = model.difference(start, goal)  # continuous joints take the shorter one
        if min(clearance(problem, model.integrate(start, s * way))[0] for s in np.linspace(0.0, 1.0, 31)) <= -0.02:
            return start, goal
    return None


def case(arm: str, world: str, folder: Path, time_limit: float, untrained: bool) -> dict[str, Any]:
    """Train (or take the LB-CBF) and run one arm in one world."""
    folder.mkdir(parents=True, exist_ok=True)
    began = time.monotonic()
    problem = load_problem(arm, str(fitted_world(load_robot(arm), world, folder)))
    task = draw_task(problem, np.random.default_rng(0))
    facts: dict[str, Any] = {"arm": arm, "world": world, "pairs": problem.safety.pairs}
    if task is None:
        return facts | {"note": "no task found"}
    start, goal = task
    problem = problem.with_goal(goal)
    report = judged_lb(problem) if untrained else trained(problem, folder / "barrier", time_limit)
    name = "lb-cbf" if untrained else str(folder / "barrier")
    barrier, config = choose_barrier(problem, name, None, None)
    assert barrier is not None
    for duration in DURATIONS:
        trajectory = run(problem, barrier, config, start, np.zeros(problem.model.nv), duration, {}, "mujoco")
        end = trajectory.ending()
        if end is None or end.state != "moving":
            break
    trajectory.save(folder / "run.npz")
    keep = ("clearance", "contacts", "hull_contacts", "max_torque_ratio", "energy_rise", "end")
    summary = trajectory.summary(problem.model)
    times = measure(problem, barrier, config, 1000)
    return facts | {k: summary[k] for k in keep} | {
        "duration": duration, "barrier": barrier.kind,
        "converged": report["converged"], "violations": report["violations"], "samples": report["samples"],
        "volume_kept": report["volume_kept"], "train_s": report["seconds"], "filter_us": times.median_us,
        "seconds": round(time.monotonic() - began, 1),
    }  # fmt: skip


def trained(problem: Problem, folder: Path, time_limit: float) -> dict[str, Any]:
    """The training report, of a barrier that is there already if there is one."""
    path = folder / "barrier.json"
    if path.exists():
        report: dict[str, Any] = json.loads(path.read_text())["training"]
        return report
    return train_barrier(problem, "pp-ncbf", "default", 0, folder, "cpu", None, time_limit)


def judged_lb(problem: Problem) -> dict[str, Any]:
    """What a training report would say of the LB-CBF."""
    check = check_band(problem, problem.barrier("lb-cbf"), FilterConfig(), LB_STATES, np.random.default_rng(0))
    return {"converged": not check.violations, "violations": check.violations, "samples": check.samples,
            "volume_kept": 1.0, "seconds": 0.0}  # fmt: skip


def goal_column(c: dict[str, Any]) -> str:
    """When the goal was reached, or how the run ended instead."""
    end = c["end"]
    match end and end["state"]:
        case None:
            return "diverged"
        case "goal":
            return f"{end['reached_at']:.1f} s"
        case "held":
            return ("rests on " if end["constrained_minimum"] else "held by ") + ", ".join(end["held_by"])
        case "stalled":
            return f"at rest, {end['goal_error']:.2f} rad off"
    if end["held_by"] and abs(end["approach"]) < STILL:
        return (
            f"rests on {', '.join(end['held_by'])}; {end['fastest']} still turns at {end['speed']:.2f} {end['unit']}/s"
        )
    return f"{end['goal_error']:.2f} rad off after {c['duration']:.0f} s, {end['approach']:.4f} rad/s closer"


def set_column(c: dict[str, Any]) -> str:
    """Volume of the set that ran, as a share of the LB set's, and whether it stood the evidence."""
    return f"{c['volume_kept']:.1%}{'' if c['converged'] else ' (not converged)'}"


def table(path: Path) -> None:
    """The README's table from the output file."""
    print("| arm | world | pairs | least clearance [mm] | contacts | largest torque | V rise / V0 | goal | trained [s] "
          "| set / LB | violations | filter [µs] |\n|---|---|---|---|---|---|---|---|---|---|---|---|")  # fmt: skip
    for line in path.read_text().splitlines():
        c = json.loads(line)
        if "note" in c:
            print(f"| {c['arm']} | {c['world']} | {c['pairs']} | {c['note']} | | | | | | | | |")
            continue
        hull = f" (hull: {c['hull_contacts']})" if c["hull_contacts"] else ""
        print(f"| {c['arm']} | {c['world']} | {c['pairs']} | {1e3 * c['clearance']:.1f} | {c['contacts']}{hull} "
              f"| {c['max_torque_ratio']:.2f} | {c['energy_rise']:.0e} | {goal_column(c)} | {c['train_s']:.0f} "
              f"| {set_column(c)} "
              f"| {c['violations']} of {c['samples']} | {c['filter_us']:.0f} |")  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/arms.jsonl"))
    parser.add_argument("--arms", nargs="*", default=list(ARMS))
    parser.add_argument("--worlds", nargs="*", default=list(WORLDS))
    parser.add_argument("--time-limit", type=float, default=240.0)
    parser.add_argument("--untrained", action="store_true", help="the LB-CBF instead of a trained barrier")
    parser.add_argument("--table", action="store_true", help="print the table of what is there")
    args = parser.parse_args()
    logging.disable(logging.CRITICAL)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    if args.table:
        table(args.out)
        return
    done = set()
    if args.out.exists():
        done = {(c["arm"], c["world"]) for c in map(json.loads, args.out.read_text().splitlines())}
    for world in args.worlds:
        for arm in args.arms:
            if (arm, world) in done:
                continue
            facts = case(arm, world, args.out.parent / f"{arm}_{world}", args.time_limit, args.untrained)
            print(json.dumps(facts), file=sys.stderr)
            with args.out.open("a") as file:
                file.write(json.dumps(facts) + "\n")


if __name__ == "__main__":
    main()
