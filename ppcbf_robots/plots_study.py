"""Pictures of safe sets beside one another: figures 6 and 7 of the paper for any robot."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from ppcbf_robots.barriers import Barrier
from ppcbf_robots.plots import save_figure, slice_states, slice_title
from ppcbf_robots.problem import Problem
from ppcbf_robots.safe_sets import FREE, Mask, levels_at
from ppcbf_robots.specs import Array
from ppcbf_robots.viable_set import ViableSet

GRID = 161  # points per axis
AROUND = 0.05  # of X's width, drawn around X too


def plot_sets(
    problem: Problem, barriers: Mapping[str, Barrier], viable: ViableSet | None, velocities: list[Array], path: Path
) -> None:
    """Boundaries of safe sets over the first two joints at given velocities; other joints at the start (Fig. 7)."""
    fig, axes = plt.subplots(1, len(velocities), figsize=(6 * len(velocities), 5), squeeze=False)
    edges = problem.robot.domain.q[:2] + AROUND * np.diff(problem.robot.domain.q[:2]) * [-1.0, 1.0]
    x, y = (np.linspace(low, high, GRID) for low, high in edges)
    for ax, v in zip(axes[0], velocities, strict=True):
        q = slice_states(problem, x, y)
        levels = levels_at(problem, barriers, viable, q, np.tile(v, (len(q), 1)))
        _draw(ax, problem, x, y, {k: m.reshape(GRID, GRID) for k, m in levels.items()}, v)
    save_figure(fig, path)


def plot_nmpc(
    problem: Problem, x: Array, y: Array, levels: Mapping[str, Array], found: Mask, v: Array, path: Path
) -> None:
    """States x (n,) by y (m,) from which a trajectory was found (m, n), and boundaries of sets (Fig. 6)."""
    fig, ax = plt.subplots(figsize=(7, 5.5))
    X, Y = np.meshgrid(x, y)
    ax.plot(X[found], Y[found], ".", color="0.6", ms=4, label="NMPC finds a trajectory")
    ax.plot(X[~found], Y[~found], "x", color="k", ms=3, label="NMPC finds none")
    _draw(ax, problem, x, y, levels, v)
    save_figure(fig, path)


def _draw(ax: Any, problem: Problem, x: Array, y: Array, levels: Mapping[str, Array], v: Array) -> None:
    ax.contourf(x, y, levels[FREE], levels=[-1e9, 0.0], colors=["0.85"])
    for i, (name, level) in enumerate((k, m) for k, m in levels.items() if k != FREE):
        ax.contour(x, y, level, levels=[0.0], colors=[f"C{i}"])
        ax.plot([], [], color=f"C{i}", label=name)
    ax.set_title(slice_title("safe sets", v))
    ax.set_xlabel(problem.model.joint_names[0])
    ax.set_ylabel(problem.model.joint_names[1])
    ax.legend(frameon=True, fontsize=8)
