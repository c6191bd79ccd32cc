"""Fig. 5 of the paper: how much the learned barriers of different seeds differ."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ppcbf_robots.barriers import Barrier
from ppcbf_robots.problem import Problem
from ppcbf_robots.results_file import Record
from ppcbf_robots.specs import Array
from ppcbf_robots.studies.tables import Row

CURVES = {"loss": "loss (24)", "torque": "share with torque critic > 0", "passivity": "share with passivity critic > 0",
          "volume_kept": "volume / LB volume"}  # fmt: skip
"""What a history holds, and how a figure calls it."""


class Curve(NamedTuple):
    """One monitored value of all runs over the iterations."""

    iteration: Array  # (T,)
    runs: Array  # (runs, T), NaN before the first check of a run
    mean: Array  # (T,)
    std: Array  # (T,)


def curve(histories: Sequence[list[dict[str, Any]]], name: str) -> Curve:
    """A value of the histories on their common iterations; a run keeps its last value until the others have ended."""
    grid = np.unique([m["iteration"] for history in histories for m in history])
    runs = np.full((len(histories), len(grid)), np.nan)
    for values, history in zip(runs, histories, strict=True):
        for m in history:
            values[grid >= m["iteration"]] = np.nan if m[name] is None else m[name]
    there = ~np.isnan(runs)
    count = np.maximum(there.sum(axis=0), 1)
    mean = np.where(there, runs, 0.0).sum(axis=0) / count
    spread = np.where(there, runs - mean, 0.0)
    blank = np.where(there.any(axis=0), 0.0, np.nan)
    return Curve(grid, runs, mean + blank, np.sqrt((spread**2).sum(axis=0) / count) + blank)


def overlaps(problem: Problem, barriers: Sequence[Barrier], rng: np.random.Generator, count: int = 10_000) -> Array:
    """Volume in X of the intersection of two safe sets over that of their union, for every pair: (S, S).

    1 means the same set; uniform states, of which those with ``h >= 0`` count.
    """
    q = problem.model.from_angles(problem.robot.domain.sample_q(rng, count))
    dyn = problem.model.evaluate_batch(q, problem.robot.domain.sample_v(rng, count))
    safety = problem.safety.evaluate(dyn)
    free = safety.h.min(axis=-1) >= 0.0
    inside = np.array([free & (b.rows(dyn, safety).phi.min(axis=-1) >= 0.0) for b in barriers]).astype(float)
    both = inside @ inside.T
    sizes = np.diag(both)
    either = sizes[:, None] + sizes - both
    return np.asarray(np.where(either > 0.0, both / np.maximum(either, 1.0), 1.0))


def variability_rows(records: Sequence[Record], overlap: Array) -> list[Row]:
    """One row per seed, then mean and standard deviation over the seeds.

    Args:
        records: with results.
        overlap: of their safe sets (S, S).
    """
    rows: list[Row] = []
    for i, record in enumerate(records):
        result = record["result"]
        others = np.delete(overlap[i], i)
        rows.append(
            {
                "seed": record["key"]["seed"],
                "converged": result["converged"],
                "volume_kept": result["volume_kept"],
                "overlap": float(others.mean()) if len(others) else None,
                "violations": result["violations"],
                "steps": result["steps"],
                "seconds": result["seconds"],
            }
        )
    return [*rows, _over_seeds("mean", rows, np.mean), _over_seeds("std", rows, np.std)]


def _over_seeds(name: str, rows: Sequence[Row], statistic: Any) -> Row:
    def value(column: str) -> float | None:
        values = [float(row[column]) for row in rows if row[column] is not None]
        return float(statistic(values)) if values else None

    return {"seed": name, **{column: value(column) for column in rows[0] if column != "seed"}}
