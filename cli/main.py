"""Entry point of the ``ppcbf`` command."""

from __future__ import annotations

import logging
import sys

import typer
from rich.text import Text

from ppcbf_robots.cli.bench import bench
from ppcbf_robots.cli.campaign import campaign
from ppcbf_robots.cli.compare import compare
from ppcbf_robots.cli.convert import convert
from ppcbf_robots.cli.export import export
from ppcbf_robots.cli.faults import faults
from ppcbf_robots.cli.info import info
from ppcbf_robots.cli.output import err
from ppcbf_robots.cli.report import report
from ppcbf_robots.cli.simulate import simulate
from ppcbf_robots.cli.study import study
from ppcbf_robots.cli.sweep import sweep
from ppcbf_robots.cli.train import train
from ppcbf_robots.cli.verify import verify
from ppcbf_robots.cli.view import view
from ppcbf_robots.errors import PPCBFError

app = typer.Typer(
    name="ppcbf",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    help="Train and run passivity-preserving neural control barrier functions for torque-controlled robot arms.\n\n"
    "Exit codes: 0 done, 1 the reader of a pipe has gone, 2 wrong use or bad input, 3 not converged or a check failed, "
    "130 stopped by Ctrl-C.",
)
for command in (info, train, simulate, campaign, compare, view, export, convert, sweep, verify, report, faults):
    app.command()(command)
app.add_typer(bench, name="bench")
app.add_typer(study, name="study")


def main() -> None:
    """Run the command line; every expected error ends as one sentence and its exit code."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(message)s", stream=sys.stderr)
    try:
        app(prog_name="ppcbf")
    except PPCBFError as error:
        err.print(Text.assemble(("error:", "bold red"), " ", str(error)), soft_wrap=True)
        sys.exit(error.exit_code)


if __name__ == "__main__":
    main()
