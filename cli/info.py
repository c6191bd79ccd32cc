"""``ppcbf info``: what was loaded, what was derived, and whether training is needed."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
import typer
from rich.text import Text

from ppcbf_robots.cli.output import JsonOption, RobotArgument, emit_json, number, obstacle_rows, out, table
from ppcbf_robots.derive_body import Body
from ppcbf_robots.evidence import check_band
from ppcbf_robots.filters import FilterConfig, too_fast_for_rate
from ppcbf_robots.problem import Problem, Robot, load_problem, load_robot
from ppcbf_robots.shapes import smoothing_gap

STATES = 2_000
BAND_STATES = 1_000
MANY_PLANES = 500  # of a convex mesh, with which a step takes twice as long


def info(
    robot: RobotArgument,
    obstacles: Annotated[str | None, typer.Argument(metavar="OBSTACLES", help="World to check the robot in.")] = None,
    json: JsonOption = False,
) -> None:
    """Show what a robot (in a world) looks like to the tool, and whether it needs training.

    Example: ppcbf info panda five_spheres
    """
    problem = load_problem(robot, obstacles) if obstacles else None
    loaded = problem.robot if problem else load_robot(robot)
    facts = _facts(loaded, problem)
    if json:
        emit_json(facts)
        return
    _print_robot(loaded, facts)
    if problem:
        _print_world(problem, facts)
    for warning in facts["warnings"]:
        out.print(f"warning: {warning}")


def _facts(robot: Robot, problem: Problem | None) -> dict[str, Any]:
    model, gains = robot.model, robot.controller.gains
    rng = np.random.default_rng(0)
    outside, joint = u_des_outside(robot, rng)
    warnings = list(model.warnings)
    if outside > 0.0:
        warnings.append(
            f"u_des leaves the torque box on {outside:.1%} of X, most at '{joint}': "
            "there the filter must change it even without an obstacle, and the closed form exceeds the box"
        )
    for name, turns, (low, high) in zip(model.joint_names, model.continuous, robot.domain.q, strict=True):
        if turns and high - low < 2.0 * np.pi - 1e-6:
            warnings.append(f"joint '{name}' turns freely: nothing keeps it in the range {low:g} .. {high:g} of X")
    slow = too_fast_for_rate(model, robot.spec.barrier.gamma)
    warnings += [slow] if slow else []
    facts: dict[str, Any] = {
        "robot": model.name,
        "urdf": str(model.urdf),
        "nq": model.nq,
        "nv": model.nv,
        "joints": [
            {"name": n, "lower": _limit(model.q_lower[i]), "upper": _limit(model.q_upper[i]), "effort": model.u_max[i],
             "velocity": model.v_max[i], "kp": gains.kp[i], "kd": gains.kd[i], "max_spring": gains.max_spring[i],
             "effort_rate": _limit(model.u_rate[i]), "continuous": bool(model.continuous[i])}
            for i, n in enumerate(model.joint_names)
        ],
        "locked": model.locked,
        "controller": gains.kind,
        "derived": robot.derived,
        "body": [s.model_dump() for s in robot.body],
        "body_overestimate_mm": _overestimate(robot),
        "body_links": _links(robot.cover),
        "fixed_links": _links(robot.fixed),
        "start": model.to_angles(robot.start).tolist(),
        "goal": model.to_angles(robot.goal).tolist(),
        "domain": {"q": robot.domain.q.tolist(), "v": robot.domain.v.tolist()},
        "warnings": warnings,
        "u_des_outside": outside,
        "lb_infeasible": None,
    }  # fmt: skip
    if problem:
        check = check_band(problem, problem.barrier("lb-cbf"), FilterConfig(), BAND_STATES, rng)
        h, row = problem.safety.least(robot.start)
        facts["smoothing_gap_mm"] = {o.name: 1e3 * smoothing_gap(o) for o in problem.world.obstacles}
        facts |= {"pairs": problem.safety.pairs, "lb_infeasible": check.share, "lb_samples": check.samples,
                  "start_clearance": h, "start_nearest": row}  # fmt: skip
        if h < 0.0:
            warnings.append(f"the start configuration violates '{row}' by {-h:.4f}; give another with --start")
        for name, planes in zip(problem.safety.packed.names, np.diff(problem.safety.packed.plane_start), strict=True):
            if planes > MANY_PLANES:
                warnings.append(
                    f"obstacle '{name}' has {planes} supporting planes, and every body sphere is held against each of "
                    "them in every step: simplify the mesh"
                )
        warnings += problem.blocked_goal()
    return facts


def _overestimate(robot: Robot) -> dict[str, float] | None:
    """How far the spheres' outside lies from the geometry [mm]; None where they were not fitted to it."""
    cover = robot.cover
    return None if cover is None else {"largest": _mm(cover.largest), "mean": _mm(cover.mean)}


def _links(cover: Body | None) -> list[dict[str, Any]]:
    """The same for every link, with the number of its spheres and of those that are left out."""
    links = [] if cover is None else cover.links
    return [{"link": x.link, "spheres": len(x.spheres), "left_out": len(x.left_out), "largest": _mm(x.largest),
             "mean": _mm(x.mean)} for x in links]  # fmt: skip


def _mm(metres: float) -> float:
    return round(1e3 * metres, 2)


def u_des_outside(robot: Robot, rng: np.random.Generator) -> tuple[float, str]:
    """Share of X where the nominal torque leaves the torque box, and the joint that does so most."""
    model = robot.model
    q = model.from_angles(robot.domain.sample_q(rng, STATES))
    v = robot.domain.sample_v(rng, STATES)
    g = np.stack([model.gravity(x) for x in q])
    u = robot.controller.u_rest(q, g) - robot.controller.gains.kd * v
    over = np.abs(u) > model.u_max
    return float(over.any(axis=1).mean()), model.joint_names[int(over.mean(axis=0).argmax())]


def _limit(x: float) -> float | None:
    return float(x) if np.isfinite(x) else None


def _print_robot(robot: Robot, facts: dict[str, Any]) -> None:
    out.print(Text.assemble((facts["robot"], "bold"), "  ", facts["urdf"]))
    locked = "".join(f", {n} locked at {x:g}" for n, x in facts["locked"].items())
    out.print(f"nq {facts['nq']}, nv {facts['nv']}{locked}; controller {facts['controller']}")
    rows = [
        [j["name"], f"{number(j['lower'])} .. {number(j['upper'])}", number(j["velocity"]), number(j["effort"]),
         number(j["kp"]), number(j["kd"]), number(j["max_spring"])]
        for j in facts["joints"]
    ]  # fmt: skip
    table("moving joints", ["joint", "position", "max speed", "max effort", "kp", "kd", "max spring"], rows)
    spheres = [[s["frame"], ", ".join(f"{x:.3f}" for x in s["center"]), f"{s['radius']:.3f}"] for s in facts["body"]]
    table(f"body: {len(spheres)} spheres, metres", ["frame", "centre", "radius"], spheres)
    if facts["body_overestimate_mm"]:
        fits = [[x["link"], str(x["spheres"]), str(x["left_out"]), f"{x['largest']:.1f}", f"{x['mean']:.1f}"]
                for x in facts["body_links"]]  # fmt: skip
        total = facts["body_overestimate_mm"]
        title = f"body reaches {total['largest']:.1f} mm beyond the geometry at most, {total['mean']:.1f} mm on average"
        table(title, ["link", "spheres", "left out", "largest", "mean"], fits)
    if facts["fixed_links"]:
        fits = [[x["link"], str(x["spheres"]), f"{x['largest']:.1f}", f"{x['mean']:.1f}"] for x in facts["fixed_links"]]
        title = f"fixed to the base, {len(robot.self_pairs)} pairs of self-collision; beyond the geometry, mm"
        table(title, ["link", "spheres", "largest", "mean"], fits)
    out.print("derived, not given: " + (", ".join(facts["derived"]) or "nothing"))
    out.print("start " + " ".join(f"{x:.3f}" for x in facts["start"]))
    out.print("goal  " + " ".join(f"{x:.3f}" for x in facts["goal"]))
    out.print(f"u_des outside the torque box on {facts['u_des_outside']:.2%} of X")


def _print_world(problem: Problem, facts: dict[str, Any]) -> None:
    title = f"world {problem.world_name}: {problem.safety.obstacle_pairs} pairs with the body"
    gaps = [f"{facts['smoothing_gap_mm'][o.name]:.1f}" for o in problem.world.obstacles]
    rows = [[*row, gap] for row, gap in zip(obstacle_rows(problem.world), gaps, strict=True)]
    table(title, ["obstacle", "type", "", "smoothing gap [mm]"], rows)
    out.print(f"start clearance {facts['start_clearance']:.4f} ({facts['start_nearest']})")
    share, n = facts["lb_infeasible"], facts["lb_samples"]
    if not n:
        out.print("no state was found on the boundary of the LB safe set in X: obstacles are out of reach")
    elif share == 0.0:
        out.print(f"the plain LB barrier was feasible on all {n} boundary states tried: training is hardly needed")
    else:
        out.print(f"the plain LB barrier is infeasible on {share:.2%} of {n} boundary states: train a PP-NCBF")
