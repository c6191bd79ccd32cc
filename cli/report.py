"""``ppcbf report``: everything that is known of a barrier, as one HTML page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from ppcbf_robots.artefact import load_barrier
from ppcbf_robots.certificate import load_certificate
from ppcbf_robots.cli.output import JsonOption, alarms_expected, emit_json, err, out
from ppcbf_robots.cli.simulate import run
from ppcbf_robots.errors import InputError
from ppcbf_robots.problem import load_problem


def report(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Barrier folder.")],
    campaign: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Figures of `ppcbf campaign`: campaign.json or its folder.")
    ] = None,
    duration: Annotated[float, typer.Option(min=0.1, max=600.0, help="Simulated seconds of the run shown.")] = 15.0,
    steps: Annotated[int, typer.Option(min=100, help="Filter steps that are timed.")] = 2000,
    robot: Annotated[str | None, typer.Option(help="Where the robot is now, if it was moved.")] = None,
    obstacles: Annotated[str | None, typer.Option(help="Where the world is now, if it was moved.")] = None,
    out_file: Annotated[Path, typer.Option("--out", metavar="F.html")] = Path("report.html"),
    json: JsonOption = False,
) -> None:
    """Write a report on a trained barrier: one HTML file that needs no network.

    It holds the certificate, a run from the specified start, a campaign's figures, training curves, slices of the safe
    set, the filter's speed on this machine, robot and world, and the run in 3-D.

    Example: ppcbf report runs/panda --campaign runs/campaign --out runs/panda_report.html
    """
    stored = load_barrier(folder)
    problem = load_problem(robot or stored.data["robot"], obstacles or stored.data["world"])
    barrier, certificate = stored.barrier(problem), load_certificate(folder, stored.data)
    from ppcbf_robots import report as page  # matplotlib and meshcat only where they are needed

    figures = None if campaign is None else page.read_campaign(campaign, problem)
    if out_file.is_dir():
        raise InputError(f"--out: {out_file} is a folder; give a file such as {out_file}/report.html")
    with alarms_expected():  # the run's are in the report
        start = problem.robot.start, problem.robot.start_velocity
        problem.check_start(start[0])
        trajectory = run(problem, barrier, stored.filter_config(), *start, duration, {"barrier": str(folder)})
        columns = (TextColumn("{task.description}"), BarColumn(bar_width=24), TimeElapsedColumn())
        with Progress(*columns, console=err, transient=True) as progress:
            bar = progress.add_task("timing the filter", total=2 + len(page.PARTS))
            case = page.time_filter(problem, barrier, stored, steps)
            material = page.Material(folder, problem, stored, barrier, trajectory, case, certificate, figures)
            page.write_report(material, out_file, lambda what: progress.update(bar, advance=1, description=what))
    facts = trajectory.summary(problem.model)
    if json:
        verdict = None if certificate is None else certificate.verdict
        emit_json({"out": str(out_file), "bytes": out_file.stat().st_size, "verdict": verdict, "run": facts,
                   "median_us": case.median_us})  # fmt: skip
    else:
        out.print(f"wrote {out_file} ({out_file.stat().st_size / 1e6:.1f} MB)")
