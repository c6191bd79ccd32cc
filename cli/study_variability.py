"""``ppcbf study variability``: the paper's Fig. 5."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from ppcbf_robots.barriers import Barrier
from ppcbf_robots.cli.output import JsonOption, RobotArgument, WorldArgument
from ppcbf_robots.cli.tasks import (
    RESULTS,
    DaskOption,
    IterationsOption,
    JobsOption,
    OutOption,
    PresetOption,
    TimeLimitOption,
    ended,
    finite,
    preset_with,
    run_tasks,
    seeds,
    show_study,
)
from ppcbf_robots.problem import Problem, load_problem
from ppcbf_robots.resources import portable
from ppcbf_robots.results_file import Record
from ppcbf_robots.specs import Array
from ppcbf_robots.studies.tables import write_table
from ppcbf_robots.studies.training import Training, barriers_of
from ppcbf_robots.studies.variability import overlaps, variability_rows


def variability(
    out_dir: OutOption,
    robot: RobotArgument = "cartpole",
    obstacles: WorldArgument = "wall",
    seed_list: Annotated[str, typer.Option("--seeds", metavar="0-9", help="Seeds, such as 0-4 or 1,3,5.")] = "0-9",
    preset: PresetOption = "default",
    iterations: IterationsOption = None,
    time_limit: TimeLimitOption = 3600.0,
    jobs: JobsOption = 1,
    dask: DaskOption = None,
    json: JsonOption = False,
) -> None:
    """How much the barriers of different seeds differ: the paper's Fig. 5, training curves, overlap of the safe sets.

    Writes results.jsonl, a barrier folder per seed, table.csv, table.md, curves.png and, for two joints or more,
    boundaries.png; the same command goes on after an interrupt. Exits with 3, after the table, if a run ended with an
    error.

    Example: ppcbf study variability --preset paper --jobs 4 --out runs/variability
    """
    problem, limit, chosen = load_problem(robot, obstacles), finite(time_limit), preset_with(preset, iterations)
    trainings = [
        Training(portable(robot), portable(obstacles), preset, chosen, seed, limit, _folder(out_dir, seed).resolve())
        for seed in seeds(seed_list)
    ]
    records = run_tasks([training.task(problem) for training in trainings], out_dir, jobs, dask)
    found = ended(records)
    folders = [_folder(out_dir, record["key"]["seed"]) for record in found]
    barriers = [stored.barrier(problem) for stored in barriers_of(found, folders)]
    rows = variability_rows(found, overlaps(problem, barriers, np.random.default_rng(0)))
    figures = _figures(problem, found, barriers, out_dir)
    files = [out_dir / RESULTS, *write_table(rows, out_dir), *figures]
    title = f"{robot} in {obstacles}, {preset} preset; overlap: of the safe set with those of the other seeds"
    show_study(title, rows, files, json, records)


def _folder(out_dir: Path, seed: int) -> Path:
    return out_dir / f"seed_{seed}"


def _figures(problem: Problem, records: list[Record], barriers: list[Barrier], out_dir: Path) -> list[Path]:
    from ppcbf_robots.studies.figures import plot_boundaries, plot_curves  # matplotlib only where it is needed

    curves, boundaries = out_dir / "curves.png", out_dir / "boundaries.png"
    plot_curves([record["result"]["history"] for record in records], curves)
    if problem.model.nv < 2:
        return [curves]
    plot_boundaries(problem, barriers, _velocities(problem), boundaries)
    return [curves, boundaries]


def _velocities(problem: Problem) -> list[Array]:
    """At rest, at the paper's 0.5 where X allows it, and at half of X's largest where that is another one."""
    v_max = problem.robot.domain.v[:, 1]
    moving = np.unique([0.5 * np.minimum(v_max, 1.0), 0.5 * v_max], axis=0)
    return [np.zeros(len(v_max)), *moving]
