"""``ppcbf faults``: what the filter does when something goes wrong around it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.progress import track

from ppcbf_robots.artefact_faults import artefact_outcomes
from ppcbf_robots.cli.output import JsonOption, RobotArgument, WorldArgument, emit_json, err, out, table
from ppcbf_robots.cli.simulate import EffortRateOption, choose_barrier, limit_rate
from ppcbf_robots.errors import CheckFailed, InputError
from ppcbf_robots.fault_cases import CASES
from ppcbf_robots.faults import Outcome, inject, onset
from ppcbf_robots.filters import FilterConfig
from ppcbf_robots.problem import load_problem

COLUMNS = ["case", "injected", "worst status", "broken", "longest [ms]", "clearance [mm]", "V rises [J]"]
INVARIANTS = ("finite", "box", "rate", "quick", "logged", "back")


def faults(
    robot: RobotArgument,
    obstacles: WorldArgument,
    barrier: Annotated[str, typer.Option(help="Barrier folder, lb-cbf or pp-cbf.")] = "lb-cbf",
    solver: Annotated[
        str, typer.Option(help="daqp, proxqp, or a solver installed for qpsolvers.")
    ] = FilterConfig.solver,
    effort_rate: EffortRateOption = None,
    json: JsonOption = False,
) -> None:
    """Inject faults into a simulated control loop and check what the filter answers.

    Bad states, plants that are not the model, obstacles, solvers and barrier folders, one after the other. Whatever
    happens, every torque must be finite, inside the box and within its rate, no step may take more than 20 ms of CPU
    time, every alarm must be logged with its reason, and after a fault that ends the QP must be solved again within
    50 ms; spoiled folders must be refused. Exit code 3 if anything of that is broken.

    Example: ppcbf faults panda sphere --barrier runs/panda --effort-rate 1000
    """
    problem = limit_rate(load_problem(robot, obstacles), effort_rate)
    chosen, config = choose_barrier(problem, barrier, None, None, solver)
    if chosen is None:
        raise InputError("--barrier: nothing to try without a filter; give a folder, lb-cbf or pp-cbf")
    folder = Path(barrier) if Path(barrier).is_dir() else None
    problem.check_start(problem.robot.start)
    cases = [fault for fault in CASES if fault.solver is None or config.kind == "qp"]
    if len(cases) < len(CASES):
        err.print("the faults of a QP solver are left out: the closed form has none", style="dim")
    first = onset(problem, chosen, config)
    outcomes = [
        inject(problem, chosen, config, fault, first)
        for fault in track(cases, "injecting", console=err, transient=True)
    ]
    outcomes += artefact_outcomes(problem, folder)
    broken = [x for x in outcomes if not x.survived]
    if json:
        emit_json({"onset": first * config.dt, "survived": not broken, "cases": [x.as_json() for x in outcomes]})
    else:
        _print(outcomes, first * config.dt)
    if broken:
        raise CheckFailed(f"{len(broken)} of {len(outcomes)} faults broke an invariant; the first: {broken[0].name}")


def _print(outcomes: list[Outcome], onset: float) -> None:
    rows = [
        [x.name, x.injected, x.worst, ", ".join(k for k in INVARIANTS if getattr(x, k) is False) or "-",
         *("-" if v is None else f"{v:.{digits}g}" for v, digits in
           ((x.latency_ms, 2), (x.clearance_mm, 3), (x.energy_J, 2)))]
        for x in outcomes
    ]  # fmt: skip
    table(f"faults from {onset:.3f} s on, where the first obstacle acts", COLUMNS, rows)
    out.print(f"{sum(x.survived for x in outcomes)} of {len(outcomes)} survived")
