"""``ppcbf bench``: how long one filter step takes on this machine."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import qpsolvers
import typer
from rich.progress import track

from ppcbf_robots.benchmark import STAGES, Case, crowd, default_barrier, measure
from ppcbf_robots.cli.output import JsonOption, alarms_expected, emit_json, err, out, table
from ppcbf_robots.cli.simulate import choose_barrier
from ppcbf_robots.errors import InputError
from ppcbf_robots.filters import FilterConfig
from ppcbf_robots.problem import load_problem, load_robot

PAIRS = (26, 126, 256, 546, 1000)
ROBOTS = ("two_link", "so100", "ur5", "panda")  # 2, 5, 6 and 7 joints
SOLVERS = ("daqp", "proxqp")


def bench(
    robot: Annotated[
        str, typer.Argument(metavar="ROBOT", help="Robot of the cases that grow with the pairs.")
    ] = "panda",
    obstacles: Annotated[str | None, typer.Argument(metavar="OBSTACLES", help="Time this world alone.")] = None,
    barrier: Annotated[str, typer.Option(help="With OBSTACLES: barrier folder, lb-cbf or pp-cbf.")] = "lb-cbf",
    steps: Annotated[int, typer.Option(min=100, help="Steps per case.")] = 10_000,
    pairs: Annotated[
        list[int] | None, typer.Option(min=1, max=20_000, help="Pairs with the body; give it once per case.")
    ] = None,
    figure: Annotated[Path | None, typer.Option(help="Write the growth with pairs and joints as a picture.")] = None,
    json: JsonOption = False,
) -> None:
    """Time the filter step, from (q, v) to torque, on states where the QP has to be solved.

    Without OBSTACLES: growing crowds of balls around ROBOT, several robots at about 126 pairs, and every solver that is
    installed. The barrier is then a PP-NCBF of the default preset's size, random but about as curved as trained ones.

    Example: ppcbf bench panda --steps 2000
    """
    with alarms_expected():  # random weights make some states infeasible, which is not what is looked at
        cases = _world(robot, obstacles, barrier, steps) if obstacles else _crowds(robot, pairs or list(PAIRS), steps)
    if figure is not None:
        from ppcbf_robots import plots  # matplotlib only where it is needed

        if obstacles:
            raise InputError("--figure shows the growth with pairs and joints: leave OBSTACLES out")
        plots.plot_bench(cases, robot, figure)
    if json:
        emit_json({"cases": [case.as_json() for case in cases]})
    else:
        _print(cases, steps)
    if figure is not None:
        (err if json else out).print(f"wrote {figure}")


def _world(robot: str, obstacles: str, barrier: str, steps: int) -> list[Case]:
    problem = load_problem(robot, obstacles)
    chosen, config = choose_barrier(problem, barrier, None, None)
    if chosen is None:
        raise InputError("--barrier: nothing to time without a filter; give a folder, lb-cbf or pp-cbf")
    return [measure(problem, chosen, config, steps)]


def _crowds(robot: str, pairs: list[int], steps: int) -> list[Case]:
    others = [name for name in qpsolvers.available_solvers if name not in SOLVERS]
    plan = [(robot, count, SOLVERS[0]) for count in pairs]
    plan += [(name, 126, SOLVERS[0]) for name in ROBOTS if name != robot]
    plan += [(robot, 126, name) for name in (*SOLVERS[1:], *others)]
    cases = []
    for name, count, solver in track(plan, "timing", console=err, transient=True):
        problem = crowd(load_robot(name), count)
        cases.append(measure(problem, default_barrier(problem), FilterConfig(solver=solver), steps))
    return cases


def _print(cases: list[Case], steps: int) -> None:
    rows = [
        [c.robot, str(c.joints), str(c.pairs), c.filter, c.solver, f"{c.median_us:.0f}", f"{c.p99_us:.0f}",
         f"{c.max_us:.0f}", *(f"{c.stages[s]:.0f}" for s in STAGES)]
        for c in cases
    ]  # fmt: skip
    columns = ["robot", "joints", "pairs", "filter", "solver", "median", "p99", "max", "dynamics", *STAGES[1:]]
    table(f"one filter step over {steps} steps, microseconds", columns, rows)
