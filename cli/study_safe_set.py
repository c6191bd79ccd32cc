"""``ppcbf study safe-set``: how large the safe sets are, beside one another and the viable set."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from ppcbf_robots.cli.output import JsonOption, RobotArgument, WorldArgument, emit_json, out, table
from ppcbf_robots.cli.tasks import DaskOption, JobsOption, OutOption, all_results, run_tasks
from ppcbf_robots.cli.viable import NodesOption, ViableOption, viable_set
from ppcbf_robots.problem import Problem, parse_vector
from ppcbf_robots.resources import portable
from ppcbf_robots.safe_sets import FREE, VIABLE, BoundaryCheck, Membership
from ppcbf_robots.set_tasks import LB, PP, SetsJob, boundary_tasks, counted, volume_tasks
from ppcbf_robots.specs import Array, vector
from ppcbf_robots.studies.tables import cell, write_csv


def safe_set(
    robot: RobotArgument,
    obstacles: WorldArgument,
    out_dir: OutOption,
    barrier: Annotated[list[str] | None, typer.Option(metavar="DIR", help="Trained barrier; may be repeated.")] = None,
    velocity: Annotated[
        list[str] | None, typer.Option(metavar="V,...", help="Velocity of a slice; may be repeated.")
    ] = None,
    samples: Annotated[int, typer.Option(min=100, help="Uniform states of X for the volumes.")] = 20_000,
    boundary: Annotated[int, typer.Option(min=1, help="Boundary states of every set for the QP.")] = 1000,
    viable: ViableOption = True,
    nodes: NodesOption = 41,
    seed: Annotated[int, typer.Option(min=0, max=2**63 - 1, help="Seed of the states.")] = 0,
    jobs: JobsOption = 1,
    dask: DaskOption = None,
    json: JsonOption = False,
) -> None:
    """Volumes and slices of the safe sets of LB-CBF, PP-CBF, trained barriers and the viable set (Fig. 7 of the paper).

    Volumes are shares of the same uniform states of X. "Not viable" is the share of a set from which no torque within
    the limits avoids a collision; "infeasible" the share of states at a set's boundary where no torque within the
    limits satisfies its rows. The PP-CBF's set is a reference only where it is feasible. Writes
    results.jsonl, volumes.csv and safe_set.png; the same command goes on after an interrupt. Exits with 3 if a task
    ended with an error.

    Example: ppcbf study safe-set cartpole wall --barrier runs/cartpole --out runs/sets
    """
    folders = tuple(Path(folder).resolve() for folder in barrier or [])
    job = SetsJob(portable(robot), portable(obstacles), folders, None, seed)
    problem, barriers = job.load()
    velocities = _velocities(problem, velocity)
    reference = viable_set(problem, nodes) if viable and problem.model.nv == 2 else None
    if reference is not None:
        job = dataclasses.replace(job, viable=(reference.nodes, reference.loss, reference.sweeps))
    about = job.about(problem)
    volumes, boundaries = volume_tasks(job, about, samples), boundary_tasks(job, about, list(barriers), boundary)
    results = all_results(run_tasks([*volumes, *boundaries], out_dir, jobs, dask, "states"), "tasks")
    found = counted(results[: len(volumes)])
    checks = {name: BoundaryCheck(**r) for name, r in zip(barriers, results[len(volumes) :], strict=True)}
    rows = [_row(found, name) for name in found.names]
    for row in rows:
        check = checks.get(row["set"])
        row |= {"infeasible": None if check is None else check.share, "boundary": 0 if check is None else check.samples}
        row["gamma"] = None if check is None else barriers[row["set"]].spec.gamma
    if any(row["set"] == PP and row["infeasible"] for row in rows):  # a set that no filter can keep is no measure
        rows = [row | {"of_pp": None, "of_pp_error": None} for row in rows]
    files = [str(out_dir / "volumes.csv"), str(out_dir / "safe_set.png")]
    write_csv(rows, Path(files[0]))
    if problem.model.nv >= 2:
        from ppcbf_robots.plots_study import plot_sets  # matplotlib only where it is needed

        plot_sets(problem, barriers, reference, velocities, Path(files[1]))
    else:
        files.pop()
    if json:
        emit_json({"samples": samples, "rows": rows, "files": files})
    else:
        _print(problem, rows)
        out.print("wrote " + ", ".join(files))


def _velocities(problem: Problem, given: list[str] | None) -> list[Array]:
    """Velocities of the slices, as given or as in the paper's figures."""
    if not given:
        from ppcbf_robots.plots import slice_velocities  # matplotlib only where it is needed

        return slice_velocities(problem)
    return [vector(parse_vector(text, "--velocity") or [], problem.model.nv, "--velocity") for text in given]


def _row(found: Membership, name: str) -> dict[str, Any]:
    """Volume of a set relative to X and the references, each with its standard error."""
    row: dict[str, Any] = {"set": name}
    for key, reference in (("of_X", None), ("of_lb", LB), ("of_pp", PP), ("of_viable", VIABLE)):
        known = reference is None or reference in found.names
        ratio = found.ratio(name, reference) if known else None
        row |= {key: ratio and ratio.value, f"{key}_error": ratio and ratio.error}
    row["not_viable"] = found.outside(name, VIABLE) if VIABLE in found.names and name not in (FREE, VIABLE) else None
    return row


def _print(problem: Problem, rows: list[dict[str, Any]]) -> None:
    columns = ["set", "gamma", "of X", "of LB-CBF", "of PP-CBF", "of viable", "not viable", "infeasible"]
    cells = [
        [r["set"], cell(r["gamma"]),
         *(_percent(r[k], r[f"{k}_error"]) for k in ("of_X", "of_lb", "of_pp", "of_viable")),
         _percent(r["not_viable"]), _percent(r["infeasible"])]
        for r in rows
    ]  # fmt: skip
    table(f"{problem.robot.name} in {problem.world_name}: volumes in X", columns, cells)


def _percent(x: float | None, error: float | None = None) -> str:
    if x is None or np.isnan(x):
        return "-"
    return f"{x:.1%}" if error is None else f"{100 * x:.1f} ± {100 * error:.1f} %"
