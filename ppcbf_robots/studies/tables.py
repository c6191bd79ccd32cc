"""Tables of a study as files."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ppcbf_robots.errors import InputError

Row = dict[str, Any]


def write_table(rows: Sequence[Row], folder: Path) -> list[Path]:
    """``table.csv`` with all digits and ``table.md`` for reading, of rows that have the same keys."""
    columns = list(rows[0])
    lines = [columns, ["---"] * len(columns), *([cell(row[c]) for c in columns] for row in rows)]
    write_csv(rows, folder / "table.csv")
    path = folder / "table.md"
    try:
        path.write_text("".join(f"| {' | '.join(line)} |\n" for line in lines), encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from None
    return [folder / "table.csv", path]


def write_csv(rows: Sequence[Row], path: Path) -> None:
    """Rows that have the same keys, these as columns; InputError where it cannot be written."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, fieldnames=list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from None


def cell(value: Any) -> str:
    """A value for reading: four digits, a dash for what is not there."""
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def mean(values: Sequence[float]) -> float | None:
    """The mean, or None of nothing."""
    return sum(values) / len(values) if values else None
