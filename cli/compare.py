"""``ppcbf compare``: the four barriers side by side on one robot and world."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer

from ppcbf_robots.artefact import load_barrier
from ppcbf_robots.barriers import Barrier
from ppcbf_robots.cli.output import (
    JsonOption,
    RobotArgument,
    WorldArgument,
    check_folder,
    emit_json,
    err,
    number,
    out,
    table,
    yes,
)
from ppcbf_robots.cli.simulate import choose_barrier, run
from ppcbf_robots.cli.tasks import IterationsOption
from ppcbf_robots.cli.train import Device, train_barrier
from ppcbf_robots.errors import CheckFailed, InputError
from ppcbf_robots.evidence import volume_ratio
from ppcbf_robots.filters import FilterKind, Metric
from ppcbf_robots.learning.presets import LearnedKind, PresetName
from ppcbf_robots.problem import Problem, load_problem
from ppcbf_robots.rollout import Trajectory
from ppcbf_robots.studies.tables import write_csv

KEYS = ("volume_kept", "min_h", "max_torque_ratio", "energy_rise", "injected", "cleared_at", "reached_goal", "rests_on")


LEARNED: dict[str, tuple[LearnedKind, PresetName]] = {
    "ncbf": ("ncbf", "paper"),
    "pp-ncbf": ("pp-ncbf", "paper"),
    "pp-ncbf-default": ("pp-ncbf", "default"),
}


class Case(NamedTuple):
    """One row of the table."""

    label: str
    barrier: str  # kind, or folder
    filter: FilterKind
    metric: Metric


def compare(
    robot: RobotArgument,
    obstacles: WorldArgument,
    out_dir: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for table, plots, barriers, runs.")],
    seed: Annotated[int, typer.Option(min=0, max=2**63 - 1, help="Seed of the training.")] = 0,
    duration: Annotated[float, typer.Option(min=0.1, help="Simulated seconds of every run.")] = 15.0,
    device: Annotated[Device, typer.Option(help="Where to train.")] = "auto",
    iterations: IterationsOption = None,
    reuse: Annotated[bool, typer.Option(help="Take barriers already in DIR if they fit.")] = True,
    json: JsonOption = False,
) -> None:
    """Train NCBF and PP-NCBF, run all four barriers from the same start, write a table and the paper's plots.

    LB-CBF, NCBF, PP-CBF and PP-NCBF run as in the paper (paper preset, closed form, torque metric). Beside them stand
    the PP-CBF in the kinetic metric, and LB-CBF and a PP-NCBF of the default preset as the QP in the kinetic metric.
    Exits with 3 if a training did not converge.

    Example: ppcbf compare cartpole wall --out runs/compare
    """
    problem = load_problem(robot, obstacles)
    problem.check_start(problem.robot.start)
    check_folder(out_dir)
    failed = []
    for name, (kind, preset) in LEARNED.items():
        folder = out_dir / name
        report = _earlier(folder, problem, kind, preset, seed, iterations) if reuse else None
        if report is None:
            report = train_barrier(problem, kind, preset, seed, folder, device, iterations)
            if report["interrupted"]:
                raise KeyboardInterrupt
            if not report["saved"]:
                raise CheckFailed(f"{name}: {report['reason']}; what is in {folder} is another barrier")
        else:
            err.print(f"{name}: taken from {folder}", style="dim", soft_wrap=True)
        failed += [] if report["converged"] else [f"{name}: {report['reason']}"]
    rows, runs, barriers = _run_all(problem, out_dir, duration)
    files = _write(problem, rows, runs, barriers, out_dir)
    if json:
        emit_json({"rows": rows, "files": files})
    else:
        _print(problem, rows, files)
    if failed:
        raise CheckFailed(f"not converged: {'; '.join(failed)}")


def _earlier(
    folder: Path, problem: Problem, kind: LearnedKind, preset: PresetName, seed: int, iterations: int | None
) -> dict[str, Any] | None:
    """Training report of a barrier in the folder that this very training would give; None if there is none."""
    try:
        stored = load_barrier(folder)
        stored.barrier(problem)
    except InputError:
        return None
    from ppcbf_robots.learning.presets import PRESETS, with_gamma

    training = stored.data["training"]
    wanted = {"preset": preset, "seed": seed, "kind": kind, "iterations": iterations, "interrupted": False}
    goal = problem.model.to_angles(problem.robot.goal).tolist()
    same = stored.spec == with_gamma(problem, PRESETS[preset]).robot.spec.barrier and stored.data.get("goal") == goal
    return training if same and wanted == {k: training.get(k) for k in wanted} else None


def _cases(out_dir: Path) -> list[Case]:
    ncbf, pp, default = (str(out_dir / name) for name in LEARNED)
    return [
        Case("LB-CBF", "lb-cbf", "closed-form", "torque"),
        Case("NCBF", ncbf, "closed-form", "torque"),
        Case("PP-CBF", "pp-cbf", "closed-form", "torque"),
        Case("PP-NCBF", pp, "closed-form", "torque"),
        Case("PP-CBF kinetic", "pp-cbf", "closed-form", "kinetic"),
        Case("LB-CBF kinetic QP", "lb-cbf", "qp", "kinetic"),
        Case("PP-NCBF kinetic QP", default, "qp", "kinetic"),
    ]


def _run_all(
    problem: Problem, out_dir: Path, duration: float
) -> tuple[list[dict[str, Any]], dict[str, Trajectory], dict[str, Barrier]]:
    rows, runs, barriers = [], {}, {}
    robot = problem.robot
    for case in _cases(out_dir):
        barrier, config = choose_barrier(problem, case.barrier, case.filter, case.metric)
        assert barrier is not None
        meta = {"barrier": case.barrier, "label": case.label}
        trajectory = run(problem, barrier, config, robot.start, robot.start_velocity, duration, meta)
        name = case.label.lower().replace(" ", "_")
        trajectory.save(out_dir / f"{name}.npz")
        facts = trajectory.summary(problem.model)
        facts["volume_kept"] = volume_ratio(problem, barrier, problem.barrier("lb-cbf"), np.random.default_rng(0))
        rows.append({"label": case.label, "filter": case.filter, "metric": case.metric} | {k: facts[k] for k in KEYS})
        runs[case.label], barriers[case.label] = trajectory, barrier
    return rows, runs, barriers


def _write(
    problem: Problem,
    rows: list[dict[str, Any]],
    runs: dict[str, Trajectory],
    barriers: dict[str, Barrier],
    out_dir: Path,
) -> list[str]:
    from ppcbf_robots import plots  # matplotlib only where it is needed

    write_csv(rows, out_dir / "table.csv")
    plots.plot_runs(problem, runs, out_dir / "runs.png")
    plots.plot_paths(problem, runs, out_dir / "paths.png")
    files = ["table.csv", "runs.png", "paths.png"]
    if problem.model.nv >= 2:
        shown = {k: b for k, b in barriers.items() if k in ("LB-CBF", "NCBF", "PP-CBF", "PP-NCBF")}
        plots.plot_safe_set(problem, shown, plots.slice_velocities(problem), out_dir / "safe_set.png")
        files.append("safe_set.png")
    return [str(out_dir / f) for f in files]


def _print(problem: Problem, rows: list[dict[str, Any]], files: list[str]) -> None:
    columns = ["barrier", "filter", "metric", "volume", "least h", "|u|/u_max", "V rise / V0", "injected J", "clear s",
               "goal", "rests on"]  # fmt: skip
    cells = [
        [r["label"], r["filter"], r["metric"], "-" if r["volume_kept"] is None else f"{r['volume_kept']:.1%}",
         number(r["min_h"]), number(r["max_torque_ratio"], 3), f"{r['energy_rise']:.1e}", number(r["injected"], 3),
         number(r["cleared_at"]), yes(r["reached_goal"]), r["rests_on"] or ""]
        for r in rows
    ]  # fmt: skip
    table(f"{problem.robot.name} in {problem.world_name}", columns, cells)
    out.print("wrote " + ", ".join(files))
