"""``ppcbf study nmpc``: where a predictive controller finds a safe trajectory, beside the safe sets."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from ppcbf_robots.cli.extras import needs
from ppcbf_robots.cli.output import JsonOption, RobotArgument, WorldArgument, emit_json, out, table
from ppcbf_robots.cli.tasks import DaskOption, JobsOption, OutOption, all_results, run_tasks
from ppcbf_robots.cli.viable import NodesOption, ViableOption, viable_set
from ppcbf_robots.errors import InputError
from ppcbf_robots.problem import Problem, load_problem, parse_vector
from ppcbf_robots.resources import portable
from ppcbf_robots.safe_sets import Mask, levels_at
from ppcbf_robots.set_tasks import known_barriers
from ppcbf_robots.specs import Array, vector
from ppcbf_robots.studies.tables import write_csv
from ppcbf_robots.sweep import Task

Point = dict[str, Any]


def nmpc(
    robot: RobotArgument,
    obstacles: WorldArgument,
    out_dir: OutOption,
    barrier: Annotated[list[str] | None, typer.Option(metavar="DIR", help="Trained barrier; may be repeated.")] = None,
    velocity: Annotated[str, typer.Option(metavar="V,...", help="Initial velocity.")] = "0.5,0.5",
    grid: Annotated[int, typer.Option(min=2, max=501, help="Initial states per axis, over X in q.")] = 41,
    steps: Annotated[int, typer.Option(min=1, help="Horizon N.")] = 80,
    dt: Annotated[float, typer.Option(min=1e-3, max=1.0, help="Seconds per step.")] = 0.025,
    iterations: Annotated[int, typer.Option(min=1, help="Iterations of IPOPT that a state is given.")] = 50,
    viable: ViableOption = True,
    nodes: NodesOption = 41,
    jobs: JobsOption = 1,
    dask: DaskOption = None,
    json: JsonOption = False,
) -> None:
    """Solve a predictive controller's problem from a grid of configurations and compare with the safe sets (Fig. 6).

    A state counts as safe for the NMPC if IPOPT finds a trajectory of N steps within torque limits, joint limits and
    clear of the obstacles, which may be spheres and half-spaces. The paper leaves the cost open; here it is the
    distance to the robot's goal, its speed and a little of its torque. Writes results.jsonl, points.csv, overlaps.csv
    and nmpc.png; the same command goes on after an interrupt. Exits with 3 if a plan ended with an error.

    Example: ppcbf study nmpc cartpole wall --out runs/nmpc --jobs 2
    """
    problem = load_problem(robot, obstacles)
    if problem.model.nv < 2:
        raise InputError("the study is over the first two joints, this robot has one")
    v = vector(parse_vector(velocity, "--velocity") or [], problem.model.nv, "--velocity")
    x, y = (np.linspace(low, high, grid) for low, high in problem.robot.domain.q[:2])
    from ppcbf_robots.plots import slice_states  # matplotlib only where it is needed
    from ppcbf_robots.plots_study import plot_nmpc

    q = slice_states(problem, x, y)
    barriers = known_barriers(problem, [Path(folder).resolve() for folder in barrier or []])
    tasks = planning_tasks(problem, (robot, obstacles), (steps, dt, iterations), problem.model.to_angles(q), v)
    reference = viable_set(problem, nodes) if viable and problem.model.nv == 2 else None
    points = all_results(run_tasks(tasks, out_dir, jobs, dask, "plans"), "plans")
    found = np.array([p["safe"] for p in points])
    levels = levels_at(problem, barriers, reference, q, np.tile(v, (len(q), 1)))
    sets = {name: level >= 0.0 for name, level in levels.items()}
    rows = overlaps(found, sets)
    files = [str(out_dir / name) for name in ("points.csv", "overlaps.csv", "nmpc.png")]
    write_csv(_flat(problem, q, points, sets), Path(files[0]))
    write_csv(rows, Path(files[1]))
    square = {name: level.reshape(grid, grid) for name, level in levels.items()}
    plot_nmpc(problem, x, y, square, found.reshape(grid, grid), v, Path(files[2]))
    if json:
        emit_json({"points": len(points), "safe": int(found.sum()), "rows": rows, "files": files})
    else:
        _print(problem, v, found, rows)
        out.print("wrote " + ", ".join(files))


def planning_tasks(
    problem: Problem, names: tuple[str, str], settings: tuple[int, float, int], angles: Array, v: Array
) -> list[Task]:
    """One task per configuration (n, nv) at velocity v (nv,).

    ``names`` are the robot's and the world's, ``settings`` are N, dt and the iterations. Raises InputError for a world
    that the planner does not know.
    """
    with needs("study", "the predictive controller"):
        from ppcbf_robots.nmpc import Settings, judge, planner
    chosen = Settings(*settings)
    planner(*names, chosen)  # bad input ends here, not in a worker
    shared = {"fingerprint": problem.fingerprint(), "goal": problem.robot.goal.tolist(), "settings": settings}
    robot, obstacles = map(portable, names)
    return [
        Task(
            {"plan": shared, "angles": a, "v": v.tolist()}, partial(judge, robot, obstacles, chosen, tuple(a), tuple(v))
        )
        for a in angles.tolist()
    ]


def overlaps(found: Mask, sets: dict[str, Mask]) -> list[dict[str, Any]]:
    """Area of the NMPC's set relative to every other, and the share of each that is outside the other."""
    rows = []
    for name, mask in sets.items():
        rows.append({
            "set": name,
            "share": float(mask.mean()),
            "nmpc_of_set": float(found.sum() / mask.sum()) if mask.any() else None,
            "set_not_nmpc": float(np.mean(~found[mask])) if mask.any() else None,
            "nmpc_not_set": float(np.mean(~mask[found])) if found.any() else None,
        })  # fmt: skip
    return rows


def _flat(problem: Problem, q: Array, points: list[Point], sets: dict[str, Mask]) -> list[dict[str, Any]]:
    """One row per initial state: its angles, the NMPC's answer, and which sets it lies in."""
    names, angles = problem.model.joint_names, problem.model.to_angles(q).tolist()
    return [
        dict(zip(names, angles[i], strict=True)) | p | {name: bool(mask[i]) for name, mask in sets.items()}
        for i, p in enumerate(points)
    ]


def _print(problem: Problem, v: Array, found: Mask, rows: list[dict[str, Any]]) -> None:
    at = ", ".join(f"{s:g}" for s in v)
    cells = [
        [r["set"], *("-" if r[k] is None else f"{r[k]:.1%}" for k in list(r)[1:])]
        for r in rows
    ]  # fmt: skip
    columns = ["set", "of the slice", "NMPC / set", "set without NMPC", "NMPC outside set"]
    table(f"{problem.robot.name} in {problem.world_name} at v = ({at})", columns, cells)
    out.print(f"the NMPC finds a trajectory from {found.sum()} of {len(found)} states ({found.mean():.1%})")
