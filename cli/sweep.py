"""``ppcbf sweep``: a barrier for every robot, world and seed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from ppcbf_robots.cli.output import JsonOption, emit_json, out, table
from ppcbf_robots.cli.tasks import (
    RESULTS,
    DaskOption,
    IterationsOption,
    JobsOption,
    OutOption,
    PresetOption,
    TimeLimitOption,
    finite,
    names,
    preset_with,
    run_tasks,
    seeds,
)
from ppcbf_robots.errors import CheckFailed, InputError
from ppcbf_robots.problem import load_problem
from ppcbf_robots.resources import portable
from ppcbf_robots.results_file import Record
from ppcbf_robots.studies.tables import cell
from ppcbf_robots.studies.training import Training, barriers_of
from ppcbf_robots.sweep import Task

KEYS = ("converged", "volume_kept", "violations", "samples", "seconds", "reason")


def sweep(
    robots: Annotated[str, typer.Option(metavar="A,B", help="Robots: names or paths, as for train.")],
    worlds: Annotated[str, typer.Option(metavar="X,Y", help="Worlds: names or paths, as for train.")],
    out_dir: OutOption,
    seed_list: Annotated[str, typer.Option("--seeds", metavar="0-4", help="Seeds, such as 0-4 or 1,3,5.")] = "0",
    preset: PresetOption = "default",
    iterations: IterationsOption = None,
    time_limit: TimeLimitOption = 3600.0,
    jobs: JobsOption = 1,
    dask: DaskOption = None,
    json: JsonOption = False,
) -> None:
    """Train a PP-NCBF for every robot in every world with every seed, each into a folder of its own below DIR.

    Results are kept in DIR/results.jsonl as they arrive. The same command goes on after an interrupt, and runs again
    what ended with an error. Exits with 3, after the table, if a training failed or did not converge.

    Example: ppcbf sweep --robots two_link,cartpole --worlds circle,wall --seeds 0-4 --jobs 4 --out runs/sweep
    """
    pairs = [(robot, world) for robot in names(robots, "--robots") for world in names(worlds, "--worlds")]
    chosen, limit, tasks = preset_with(preset, iterations), finite(time_limit), dict[Path, Task]()
    for robot, world in pairs:
        problem = load_problem(robot, world)
        for seed in seeds(seed_list):
            folder = out_dir.resolve() / f"{Path(robot).stem}_{Path(world).stem}_{seed}"
            if folder in tasks:
                raise InputError(f"two of the robots and worlds would be written into {folder}; rename a file")
            training = Training(portable(robot), portable(world), preset, chosen, seed, limit, folder)
            tasks[folder] = training.task(problem)
    records = run_tasks(list(tasks.values()), out_dir, jobs, dask)
    barriers_of(records, list(tasks))  # or refuse
    rows = [_row(record, folder) for record, folder in zip(records, tasks, strict=True)]
    if json:
        emit_json({"rows": rows, "results": str(out_dir / RESULTS)})
    else:
        _print(rows, out_dir)
    missed = sum(not row["converged"] for row in rows)
    if missed:
        raise CheckFailed(f"{missed} of {len(rows)} trainings failed or did not converge; the table says why")


def _row(record: Record, folder: Path) -> dict[str, Any]:
    """What is known of one training; after an error, the reason alone."""
    result = record.get("result", {"converged": False, "reason": record.get("error")})
    names = {key: record["key"][key] for key in ("robot", "world", "seed")}
    return {**names, **{key: result.get(key) for key in KEYS}, "out": str(folder)}


def _print(rows: Sequence[dict[str, Any]], out_dir: Path) -> None:
    columns = ["robot", "world", "seed", "converged", "volume", "violations", "seconds", "reason"]
    cells = [
        [r["robot"], r["world"], str(r["seed"]), cell(r["converged"]),
         "-" if r["volume_kept"] is None else f"{r['volume_kept']:.1%}",
         "-" if r["samples"] is None else f"{r['violations']} of {r['samples']}",
         cell(r["seconds"]), r["reason"]]
        for r in rows
    ]  # fmt: skip
    table(f"{len(rows)} trainings", columns, cells)
    out.print(f"wrote {out_dir / RESULTS} and the barrier folders beside it")
