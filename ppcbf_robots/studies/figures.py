"""Figures of the studies."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from ppcbf_robots.barriers import Barrier
from ppcbf_robots.plots import safe_set_slices, save_figure, slice_title
from ppcbf_robots.problem import Problem
from ppcbf_robots.specs import Array
from ppcbf_robots.studies.convergence import TABLE_1
from ppcbf_robots.studies.tables import Row
from ppcbf_robots.studies.variability import CURVES, curve

BOUNDARY = 0.05  # |phi| below which the paper's Fig. 5 draws the boundary


def plot_convergence(rows: Sequence[Row], path: Path) -> None:
    """Share of converged runs and steps to converge against the learning rate, with the paper's Table 1."""
    fig, axes = plt.subplots(1, 2, figsize=(10, 3.8))
    for preset in dict.fromkeys(row["preset"] for row in rows):
        mine = sorted((row for row in rows if row["preset"] == preset), key=lambda row: float(row["rate"]))
        rates = [row["rate"] for row in mine]
        (line,) = axes[0].plot(rates, [row["converged"] for row in mine], "o-", label=f"{preset} preset")
        once = [row["clean_once"] for row in mine]
        axes[0].plot(rates, once, "o:", color=line.get_color(), label=f"{preset} preset, a clean check on the way")
        (line,) = axes[1].plot(rates, [_gap(row["steps"]) for row in mine], "o-", label=f"{preset} preset, whole run")
        first = [_gap(row["first_clean"]) for row in mine]
        axes[1].plot(rates, first, "o:", color=line.get_color(), label=f"{preset} preset, first clean check")
    paper = sorted(TABLE_1)
    axes[0].plot(paper, [TABLE_1[rate][0] for rate in paper], "kx--", label="paper, Table 1")
    axes[1].plot(paper, [_gap(TABLE_1[rate][1]) for rate in paper], "kx--", label="paper, Table 1")
    axes[0].set_ylabel("share of converged runs")
    axes[0].set_ylim(-0.05, 1.05)
    axes[1].set_ylabel("iterations to converge, mean")
    for ax in axes:
        ax.set_xscale("log")
        ax.set_xlabel("learning rate")
        ax.grid(alpha=0.3)
        ax.legend(frameon=False, fontsize=8)
    save_figure(fig, path)


def _gap(value: float | None) -> float:
    return np.nan if value is None else value


def plot_curves(histories: Sequence[list[dict[str, Any]]], path: Path, columns: int = len(CURVES)) -> None:
    """Loss, critics and volume of all runs over the iterations: each run, their mean and standard deviation."""
    fig, axes = plt.subplots(len(CURVES) // columns, columns, figsize=(4 * columns, 3.6 * len(CURVES) // columns))
    for ax, (name, label) in zip(axes.flat, CURVES.items(), strict=True):
        found = curve(histories, name)
        ax.plot(found.iteration, found.runs.T, color="C0", lw=0.6, alpha=0.5)
        ax.fill_between(found.iteration, found.mean - found.std, found.mean + found.std, color="C0", alpha=0.2, lw=0)
        ax.plot(found.iteration, found.mean, color="C0", lw=2.0, marker=".")
        ax.set_xlabel("iteration")
        ax.set_title(label, fontsize=10)
        ax.ticklabel_format(useOffset=False)
        ax.grid(alpha=0.3)
    save_figure(fig, path)


def plot_boundaries(problem: Problem, barriers: Sequence[Barrier], velocities: Sequence[Array], path: Path) -> None:
    """Where ``|min_k phi_k| <= 0.05`` over the first two joints, all barriers on top of each other (Fig. 5)."""
    fig, axes = plt.subplots(1, len(velocities), figsize=(5 * len(velocities), 4.4), squeeze=False)
    slices = safe_set_slices(problem, velocities, beyond=0.1)
    for ax, v, cut in zip(axes[0], velocities, slices, strict=True):
        ax.contourf(cut.x, cut.y, cut.h, levels=[-1e9, 0.0], colors=["0.8"])
        for barrier in barriers:
            levels = [-BOUNDARY, BOUNDARY]
            ax.contourf(
                cut.x, cut.y, cut.phi(barrier), levels=levels, colors=["C0"], alpha=max(0.1, 1.0 / len(barriers))
            )
        ax.set_title(slice_title(f"|phi| <= {BOUNDARY:g}, {len(barriers)} seeds", v))
        ax.set_xlabel(problem.model.joint_names[0])
        ax.set_ylabel(problem.model.joint_names[1])
    save_figure(fig, path)
