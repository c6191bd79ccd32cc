"""``ppcbf export``: a trained barrier for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ppcbf_robots.artefact import load_barrier
from ppcbf_robots.cli.output import JsonOption, emit_json, out
from ppcbf_robots.export import ExportFormat, export_barrier


def export(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Barrier folder.")],
    format: Annotated[ExportFormat, typer.Option(help="npz, onnx (phi and gradient in one graph), or a C header.")],
    out_file: Annotated[Path, typer.Option("--out", metavar="F", help="File to write.")],
    json: JsonOption = False,
) -> None:
    """Export phi and its gradient of a trained barrier.

    Example: ppcbf export runs/two_link --format c --out two_link_barrier.h
    """
    export_barrier(load_barrier(folder), out_file, format)
    facts = {"format": format, "out": str(out_file), "bytes": out_file.stat().st_size}
    emit_json(facts) if json else out.print(f"wrote {out_file} ({facts['bytes']} bytes)")
