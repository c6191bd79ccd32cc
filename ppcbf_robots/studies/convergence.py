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

    ``converged`` are the runs whose set the evidence passes or, where the paper's exit ends them (``key["exit"]``),
    those that reach it and have not collapsed; ``steps`` is their mean iteration at the end. ``clean_once`` is the
    share of runs with a check without violations, ``first_clean`` the mean iteration of the first such check. Over all
    runs, ``seconds`` is the mean, ``violating`` the mean share of fresh band states that violate at the last check, and
    ``volume_least`` and ``volume_most`` the range of the LB set's volume kept.
    """
    groups: dict[tuple[str, float, float], list[dict[str, Any]]] = {}
    for record in records:
        key = record["key"]["preset"], record["key"]["learning_rate"], record["key"]["exit"]
        groups.setdefault(key, []).append(record["result"])
    return [_row(*key, results) for key, results in groups.items()]


def _row(preset: str, rate: float, exit_at: float, results: list[dict[str, Any]]) -> Row:
    converged = [r for r in results if (r["ended"] and not _collapsed(r) if exit_at else r["converged"])]
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
        "collapsed": sum(map(_collapsed, results)) / len(results),
        "steps": mean([r["steps"] for r in converged]),
        "seconds": mean([r["seconds"] for r in results]),
        "violating": mean([m["torque"] + m["passivity"] for r in results for m in r["history"][-1:]]),
        "volume_least": min(volumes),
        "volume_most": max(volumes),
        "paper_share": paper_share,
        "paper_steps": paper_steps,
    }


def _collapsed(result: dict[str, Any]) -> bool:
    return str(result["reason"]).startswith("collapsed")


def _clean_checks(result: dict[str, Any]) -> list[int]:
    """Iterations of the checks without violations."""
    return [m["iteration"] for m in result["history"] if m["clean"]]
