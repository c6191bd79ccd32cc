"""Table 1 of the paper: how often and how fast training converges, by learning rate."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ppcbf_robots.results_file import Record
from ppcbf_robots.studies.tables import Row, mean

TABLE_1 = {1e-3: (0.0, None), 1e-4: (0.7, 150), 5e-5: (0.85, 200), 1e-5: (1.0, 400), 5e-6: (1.0, 800)}
"""The paper's share of converged runs and steps to converge, by learning rate (20 runs each)."""


def convergence_rows(records: Sequence[Record]) -> list[Row]:
    """One row per preset and learning rate, in their first order, of records with results.

    ``first_clean`` is the iteration of the first check without violations, ``steps`` are those to the end of the run;
    both, the time and the volume are means over the converged runs.
    """
    groups: dict[tuple[str, float], list[dict[str, Any]]] = {}
    for record in records:
        key = record["key"]["preset"], record["key"]["learning_rate"]
        groups.setdefault(key, []).append(record["result"])
    return [_row(preset, rate, results) for (preset, rate), results in groups.items()]


def _row(preset: str, rate: float, results: list[dict[str, Any]]) -> Row:
    converged = [r for r in results if r["converged"]]
    paper_share, paper_steps = TABLE_1.get(rate, (None, None))
    return {
        "preset": preset,
        "rate": rate,
        "runs": len(results),
        "converged": len(converged) / len(results),
        "collapsed": sum(r["reason"].startswith("collapsed") for r in results) / len(results),
        "first_clean": mean([i for r in converged for i in _clean_checks(r)[:1]]),
        "steps": mean([r["steps"] for r in converged]),
        "seconds": mean([r["seconds"] for r in converged]),
        "volume_kept": mean([r["volume_kept"] for r in converged]),
        "paper_converged": paper_share,
        "paper_steps": paper_steps,
    }


def _clean_checks(result: dict[str, Any]) -> list[int]:
    """Iterations of the checks without violations."""
    return [m["iteration"] for m in result["history"] if m["clean"]]
