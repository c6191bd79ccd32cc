"""``ppcbf study``: the paper's comparisons, over many runs or states."""

from __future__ import annotations

import typer

from ppcbf_robots.cli.study_convergence import convergence
from ppcbf_robots.cli.study_nmpc import nmpc
from ppcbf_robots.cli.study_safe_set import safe_set
from ppcbf_robots.cli.study_variability import variability

study = typer.Typer(
    no_args_is_help=True, rich_markup_mode="rich", help="The paper's studies over many runs, for any robot and world."
)
for command in (convergence, variability, nmpc, safe_set):
    study.command()(command)
