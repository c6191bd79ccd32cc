"""``ppcbf view``: trajectories in the browser."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ppcbf_robots.cli.output import JsonOption, emit_json, err, out
from ppcbf_robots.errors import InputError
from ppcbf_robots.problem import load_problem
from ppcbf_robots.rollout import Trajectory


def view(
    trajectories: Annotated[
        list[Path], typer.Argument(metavar="T.npz...", help="Trajectories of one robot and world.")
    ],
    html: Annotated[Path | None, typer.Option(metavar="F", help="Write one self-contained HTML file instead.")] = None,
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="Loopback port of the live page; 0 takes a free one.")
    ] = 0,
    open_browser: Annotated[bool, typer.Option("--open/--no-open", help="Open the browser.")] = True,
    json: JsonOption = False,
) -> None:
    """Show trajectories in meshcat: a live page on loopback, or one HTML file that plays offline.

    Example: ppcbf view runs/panda.npz runs/panda_none.npz --html runs/panda.html
    """
    loaded = [Trajectory.load(path) for path in trajectories]
    names = {(t.meta.get("robot"), t.meta.get("obstacles")) for t in loaded}
    if len(names) != 1:
        raise InputError("the trajectories belong to different robots or worlds; view them one by one")
    robot, world = names.pop()
    problem = load_problem(str(robot), str(world))
    labels = [f"{path.stem} ({t.meta.get('barrier_kind', '?')})" for path, t in zip(trajectories, loaded, strict=True)]
    from ppcbf_robots import viewer  # meshcat only where it is needed

    if html is not None:
        viewer.write_html(problem, loaded, labels, html)
        emit_json({"html": str(html), "bytes": html.stat().st_size}) if json else out.print(f"wrote {html}")
        return
    with viewer.show(problem, loaded, labels, port=port, open_browser=open_browser) as server:
        emit_json({"url": server.url}) if json else out.print(f"{server.url}")
        err.print("Ctrl-C ends the server")
        server.wait()
