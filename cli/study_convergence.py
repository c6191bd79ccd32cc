"""``ppcbf study convergence``: the paper's Table 1."""

from __future__ import annotations

from typing import Annotated, Literal

import typer

from ppcbf_robots.cli.output import JsonOption, RobotArgument, WorldArgument
from ppcbf_robots.cli.tasks import (
    RESULTS,
    DaskOption,
    IterationsOption,
    JobsOption,
    OutOption,
    TimeLimitOption,
    ended,
    finite,
    preset_with,
    rates,
    run_tasks,
    show_study,
)
from ppcbf_robots.learning.presets import PresetName
from ppcbf_robots.problem import load_problem
from ppcbf_robots.resources import portable
from ppcbf_robots.studies.convergence import TABLE_1, convergence_rows
from ppcbf_robots.studies.tables import write_table
from ppcbf_robots.studies.training import Training

EXIT = 1e-2  # the paper's ξ
RATES = ",".join(f"{rate:g}" for rate in TABLE_1)


def convergence(
    out_dir: OutOption,
    robot: RobotArgument = "cartpole",
    obstacles: WorldArgument = "wall",
    runs: Annotated[int, typer.Option(min=1, max=10_000, help="Runs per learning rate; run i has seed i.")] = 20,
    rate_list: Annotated[str, typer.Option("--rates", metavar="R,...", help="Learning rates; the paper's.")] = RATES,
    preset: Annotated[Literal["both", PresetName], typer.Option(help="Settings of the runs.")] = "both",
    exit_at: Annotated[
        float, typer.Option("--exit", min=0.0, help="Ends the paper's runs, as in the paper; 0: evidence ends them.")
    ] = EXIT,
    iterations: IterationsOption = None,
    time_limit: TimeLimitOption = 3600.0,
    jobs: JobsOption = 1,
    dask: DaskOption = None,
    json: JsonOption = False,
) -> None:
    """How often and how fast training converges, by learning rate, beside the paper's Table 1.

    A run of the default preset, or with --exit 0, has converged if the evidence passes a set that it found; one of the
    paper's if the mean of its Top_k critics fell below --exit, as in the paper, and the set has not collapsed. `clean
    once` counts the runs that had a check without violations, after `first clean` iterations. Writes results.jsonl,
    table.csv, table.md and convergence.png; the same command goes on after an interrupt. Exits with 3, after the table,
    if a run ended with an error.

    Example: ppcbf study convergence --runs 20 --jobs 4 --out runs/convergence
    """
    problem, limit = load_problem(robot, obstacles), finite(time_limit)
    ends = {"exit": exit_at, "refinements": 0} if exit_at else {}
    chosen: list[PresetName] = ["paper", "default"] if preset == "both" else [preset]
    trainings = [
        Training(
            portable(robot),
            portable(obstacles),
            name,
            preset_with(name, iterations, learning_rate=rate, **(ends if name == "paper" else {})),
            seed,
            limit,
        )
        for name in chosen
        for rate in rates(rate_list)
        for seed in range(runs)
    ]
    records = run_tasks([training.task(problem) for training in trainings], out_dir, jobs, dask)
    rows = convergence_rows(ended(records))
    from ppcbf_robots.studies.figures import plot_convergence  # matplotlib only where it is needed

    figure = out_dir / "convergence.png"
    plot_convergence(rows, figure)
    files = [out_dir / RESULTS, *write_table(rows, out_dir), figure]
    title = f"{robot} in {obstacles}: shares of the runs, steps of the converged ones, and the paper's Table 1"
    show_study(title, rows, files, json, records)
