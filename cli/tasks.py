"""What ``sweep`` and the studies share: options, lists on the command line, and running tasks with a progress bar."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from ppcbf_robots.cli.output import check_folder, emit_json, err, out, table
from ppcbf_robots.errors import CheckFailed, InputError
from ppcbf_robots.learning.presets import PRESETS, Preset, PresetName
from ppcbf_robots.results_file import Record
from ppcbf_robots.studies.tables import Row, cell
from ppcbf_robots.sweep import Task, run_sweep

Value = TypeVar("Value")
RESULTS = "results.jsonl"
MAX_SEEDS = 10_000

OutOption = Annotated[
    Path, typer.Option("--out", metavar="DIR", help="Folder for results; with some, goes on from there.")
]
JobsOption = Annotated[int, typer.Option(min=1, help="Tasks at once on this machine, one core each.")]
DaskOption = Annotated[
    str | None, typer.Option(metavar="ADDRESS", help="Run on the workers of this Dask scheduler instead.")
]
IterationsOption = Annotated[int | None, typer.Option(min=1, help="Planned iterations instead of the preset's.")]
PresetOption = Annotated[PresetName, typer.Option(help="Recommended settings, or the paper's.")]
TimeLimitOption = Annotated[float, typer.Option(min=1.0, help="Stop each training after so many seconds.")]


def run_tasks(
    tasks: Sequence[Task], folder: Path, jobs: int, dask: str | None, what: str = "trainings"
) -> list[Record]:
    """Records of all tasks, with a bar on stderr; Ctrl-C says how to go on.

    A task whose key has a ``count`` does as many of what the bar counts.
    """
    path, found, failed = folder / RESULTS, 0, 0

    def size(key: dict[str, Any]) -> int:
        return int(key.get("count", 1))

    total = sum(size(task.key) for task in tasks)
    check_folder(folder)
    columns = (TextColumn(what), BarColumn(bar_width=24), MofNCompleteColumn(),
               TextColumn("{task.fields[failed]}"), TimeElapsedColumn())  # fmt: skip
    with Progress(*columns, console=err) as progress:
        bar = progress.add_task("", total=total, failed="")

        def on_record(record: Record) -> None:
            nonlocal found, failed
            count = size(record["key"])
            found, failed = found + count, failed + count * ("error" in record)
            progress.update(bar, completed=found, failed=f"{failed} failed" if failed else "")

        try:
            return run_sweep(tasks, path, jobs, dask, on_record)
        except KeyboardInterrupt:
            progress.stop()
            said = f"stopped: {found} of {total} are in {path}; the same command goes on from there"
            err.print(said, soft_wrap=True)
            raise


def ended(records: Sequence[Record]) -> list[Record]:
    """The records with a result; CheckFailed if there is none."""
    found = [record for record in records if "result" in record]
    if not found:
        raise CheckFailed(f"every run ended with an error; the first: {records[0]['error']}")
    return found


def all_results(records: Sequence[Record], what: str) -> list[Any]:
    """The results of all records; CheckFailed if one has none."""
    failed = [record["error"] for record in records if "error" in record]
    if failed:
        raise CheckFailed(f"{len(failed)} of {len(records)} {what} ended with an error; the first: {failed[0]}")
    return [record["result"] for record in records]


def show_study(title: str, rows: Sequence[Row], files: Sequence[Path], json: bool, records: Sequence[Record]) -> None:
    """The result of a study on stdout; CheckFailed afterwards if some of its records hold an error."""
    if json:
        emit_json({"rows": list(rows), "files": [str(path) for path in files]})
    else:
        table(title, [name.replace("_", " ") for name in rows[0]], [[cell(x) for x in row.values()] for row in rows])
        out.print(f"wrote {', '.join(map(str, files))}")
    errors = [record["error"] for record in records if "error" in record]
    if errors:
        raise CheckFailed(f"{len(errors)} of {len(records)} runs ended with an error; the first: {errors[0]}")


def preset_with(name: PresetName, iterations: int | None, **changes: Any) -> Preset:
    """A preset with other settings; ``iterations`` None leaves its own."""
    given = {} if iterations is None else {"iterations": iterations}
    return dataclasses.replace(PRESETS[name], **given, **changes)


def finite(value: float, option: str = "--time-limit") -> float:
    """The value of an option: the command line knows nan and inf, the key of a task does not."""
    if not math.isfinite(value):
        raise InputError(f"{option} must be finite, got {value}")
    return value


def names(text: str, option: str) -> list[str]:
    """Names of a comma separated option, each once."""
    return _parts(text, option, str, "names separated by commas")


def rates(text: str, option: str = "--rates") -> list[float]:
    """Learning rates of a comma separated option, each once."""

    def parse(part: str) -> float:
        if not 0.0 < float(part) < math.inf:
            raise ValueError
        return float(part)

    return _parts(text, option, parse, "positive numbers such as 1e-3,1e-4")


def seeds(text: str, option: str = "--seeds") -> list[int]:
    """Seeds such as ``0-4,7``, each once."""

    def parse(part: str) -> range:
        first, dash, last = part.partition("-")
        found = range(int(first), int(last if dash else first) + 1)
        if not 0 < len(found) <= MAX_SEEDS or found[-1] >= 2**63:
            raise ValueError
        return found

    ranges = _parts(text, option, parse, f"at most {MAX_SEEDS:,} seeds such as 0-4 or 1,3,5")
    return list(dict.fromkeys(seed for found in ranges for seed in found))


def _parts(text: str, option: str, parse: Callable[[str], Value], expected: str) -> list[Value]:
    try:
        found = [parse(part.strip()) for part in text.split(",") if part.strip()]
    except (ValueError, OverflowError):
        found = []
    if not found:
        raise InputError(f"{option}: expected {expected}, got '{text}'")
    return list(dict.fromkeys(found))
