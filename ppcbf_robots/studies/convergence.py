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

    ``clean_once`` is the share of runs with a check without violations, ``first_clean`` the iteration of the first such
    check, a mean over these. ``steps`` are those to the end of the converged runs, a mean; ``seconds`` the mean and
    ``volume_least`` and ``volume_most`` the range over all runs, of the LB set's volume.
    """
    groups: dict[tuple[str, float], list[dict[str, Any]]] = {}
    for record in records:
        key = record["key"]["preset"], record["key"]["learning_rate"]
        groups.setdefault(key, []).append(record["result"])
    return [_row(preset, rate, results) for (preset, rate), results in groups.items()]


def _row(preset: str, rate: float, results: list[dict[str, Any]]) -> Row:
    converged = [r for r in results if r["converged"]]
    first_clean = [i for r in results for i in _clean_checks(r)[:1]]
    volumes = [r["volume_kept"] for r in results]
    paper_share, paper_steps = TABLE_1.get(rate, (None, None))
    return {
        "preset": preset,
        "rate": rate,
        "runs": len(results),
        "clean_once": len(first_clean) / len(results),
        "first_clean": mean(first_clean),
        "converged": len(converged) / len(results),
        "collapsed": sum(r["reason"].startswith("collapsed") for r in results) / len(results),
        "steps": mean([r["steps"] for r in converged]),
        "seconds": mean([r["seconds"] for r in results]),
        "volume_least": min(volumes),
        "volume_most": max(volumes),
        "paper_share": paper_share,
        "paper_steps": paper_steps,
    }


def _clean_checks(result: dict[str, Any]) -> list[int]:
    """Iterations of the checks without violations."""
    return [m["iteration"] for m in result["history"] if m["clean"]]
