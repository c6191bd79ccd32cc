"""Pictures of runs and safe sets: the paper's figures 2 to 5 and 7 for any robot."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib

matplotlib.use("Agg")
import matplotlib.patches as patches
import matplotlib.pyplot as plt
import numpy as np

from ppcbf_robots.barriers import Barrier
from ppcbf_robots.benchmark import Case
from ppcbf_robots.errors import InputError
from ppcbf_robots.problem import Problem
from ppcbf_robots.robot import Dynamics
from ppcbf_robots.rollout import Trajectory
from ppcbf_robots.safety import SafetyRows
from ppcbf_robots.specs import Array
from ppcbf_robots.world import HalfSpace, Obstacle, Sphere
from ppcbf_robots.world_shapes import surface_points

GRID = 121  # points per axis of a safe-set slice
MAX_JOINTS = 8
MAX_POINTS = 1000  # of a curve over time


def plot_runs(problem: Problem, runs: Mapping[str, Trajectory], path: Path) -> None:
    """Joint positions, storage, clearance and torques of several runs over time (Fig. 2 and 4 of the paper)."""
    model = problem.model
    joints = min(model.nv, MAX_JOINTS)
    fig, axes = plt.subplots(joints + 1, 2, figsize=(12, 2.3 * (joints + 1)), sharex=True, squeeze=False)
    for label, run in runs.items():
        angles = model.to_angles(run.q)
        for i in range(joints):
            axes[i, 0].plot(run.t, angles[:, i], label=label)
            axes[i, 1].plot(run.t, run.u[:, i], label=label)
        axes[joints, 0].plot(run.t, run.V, label=label)
        axes[joints, 1].plot(run.t, run.clearance, label=label)
    for i in range(joints):
        axes[i, 0].set_ylabel(f"{model.joint_names[i]}\nposition")
        axes[i, 1].set_ylabel("torque")
        for side in (-1.0, 1.0):
            axes[i, 1].axhline(side * model.u_max[i], color="k", lw=0.8, ls="--")
    axes[joints, 0].set_ylabel("storage V [J]")
    axes[joints, 1].set_ylabel("clearance [m]")
    axes[joints, 1].axhline(0.0, color="k", lw=0.8, ls="--")
    for ax in axes[-1]:
        ax.set_xlabel("time [s]")
    for ax in axes.flat:
        ax.grid(alpha=0.3)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    fig.legend(handles, labels, loc="upper center", ncols=min(4, len(labels)), frameon=False)
    save_figure(fig, path, top=1.0 - 0.5 / (2.3 * (joints + 1)))


def plot_run(problem: Problem, run: Trajectory, path: Path) -> None:
    """h, phi, V and the torques relative to their limits over time; shaded where the filter corrects."""
    fig, axes = plt.subplots(4, 1, figsize=(10, 9), sharex=True)
    every = max(1, len(run.t) // MAX_POINTS)
    t = run.t[::every]
    curves = {"least h [m | rad]": run.h, "least phi [m/s]": run.phi, "storage V [J]": run.V}
    for ax, (label, values) in zip(axes, curves.items(), strict=False):
        ax.plot(t, values[::every], lw=1.5)
        ax.set_ylabel(label)
        ax.axhline(0.0, color="k", lw=0.8, ls="--")
    share = run.u[::every] / problem.model.u_max
    for i, name in enumerate(problem.model.joint_names):
        axes[3].plot(t, share[:, i], lw=1.2, label=name)
    for side in (-1.0, 1.0):
        axes[3].axhline(side, color="k", lw=0.8, ls="--")
    axes[3].set_ylabel("torque / limit")
    axes[3].set_xlabel("time [s]")
    axes[3].legend(fontsize=8, ncols=4, loc="upper right")
    active = run.active.astype(bool)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], active, [False]])))
    for ax in axes:
        ax.grid(alpha=0.3)
        for first, end in zip(edges[::2], edges[1::2], strict=True):
            ax.axvspan(run.t[first], run.t[end - 1], color="C1", alpha=0.12, lw=0)
    save_figure(fig, path)


def plot_paths(problem: Problem, runs: Mapping[str, Trajectory], path: Path) -> None:
    """Paths of the last body sphere in the (x, z) and (x, y) planes with the obstacles (Fig. 3 of the paper)."""
    fig, axes = plt.subplots(1, 2, figsize=(12, 5.5))
    for label, run in runs.items():
        p = _tip_path(problem, run)
        for ax, k in zip(axes, (2, 1), strict=True):
            ax.plot(p[:, 0], p[:, k], label=label)
    for ax, k, name in zip(axes, (2, 1), "zy", strict=True):
        for o in problem.world.obstacles:
            _draw_obstacle(ax, o, k)
        ax.set_xlabel("x [m]")
        ax.set_ylabel(f"{name} [m]")
        ax.set_aspect("equal", adjustable="datalim")
        ax.grid(alpha=0.3)
    axes[0].legend(frameon=False)
    save_figure(fig, path)


def _draw_obstacle(ax: Any, obstacle: Obstacle, k: int) -> None:
    """Shadow of an obstacle on the plane of x and axis k."""
    match obstacle:
        case Sphere():
            ax.add_patch(patches.Circle((obstacle.center[0], obstacle.center[k]), obstacle.radius, color="0.7"))
        case HalfSpace():
            normal = np.array([obstacle.normal[0], obstacle.normal[k]])
            if np.hypot(*normal) > 0.999:  # stands upright on the drawn plane
                at = normal * obstacle.offset
                ax.axline(tuple(at), tuple(at + np.array([-normal[1], normal[0]])), color="0.5", lw=3)
        case _:
            ax.add_patch(patches.Polygon(outline(surface_points(obstacle)[:, [0, k]]), color="0.7"))


def outline(points: Array) -> Array:
    """Corners (M, 2) of the convex hull of points (N, 2), counter-clockwise."""

    def chain(ordered: Array) -> list[Array]:
        corners: list[Array] = []
        for p in ordered:
            while len(corners) > 1:
                a, b = corners[-1] - corners[-2], p - corners[-1]
                if a[0] * b[1] - a[1] * b[0] > 0.0:
                    break
                corners.pop()
            corners.append(p)
        return corners[:-1]  # the last one begins the other chain

    ordered = np.unique(points, axis=0)
    return np.array(chain(ordered) + chain(ordered[::-1])) if len(ordered) > 1 else ordered


def _tip_path(problem: Problem, run: Trajectory) -> Array:
    model = problem.model
    every = max(1, len(run.t) // 400)
    dyn = model.evaluate_batch(run.q[::every], run.v[::every])
    return problem.safety.points.kinematics(dyn).p[:, -1]


class Slice(NamedTuple):
    """States over the first two joints at one velocity."""

    x: Array  # (N, N) position of the first joint
    y: Array  # (N, N) of the second
    dyn: Dynamics
    safety: SafetyRows

    @property
    def h(self) -> Array:
        """Least h (N, N)."""
        return np.asarray(self.safety.h.min(-1).reshape(self.x.shape))

    def phi(self, barrier: Barrier) -> Array:
        """Least phi of a barrier (N, N)."""
        return np.asarray(barrier.rows(self.dyn, self.safety).phi.min(-1).reshape(self.x.shape))


def safe_set_slices(problem: Problem, velocities: Sequence[Array], beyond: float = 0.0) -> Iterator[Slice]:
    """Slices over the first two joints, reaching ``beyond`` of X's width past its bounds; other joints at the start."""
    domain, model = problem.robot.domain, problem.model
    reach = beyond * (domain.q[:, 1] - domain.q[:, 0])
    x, y = (np.linspace(domain.q[i, 0] - reach[i], domain.q[i, 1] + reach[i], GRID) for i in (0, 1))
    q, (X, Y) = slice_states(problem, x, y), np.meshgrid(x, y)
    for v in velocities:
        dyn = model.evaluate_batch(q, np.tile(v, (len(q), 1)))
        yield Slice(X, Y, dyn, problem.safety.evaluate(dyn))


def slice_velocities(problem: Problem) -> list[Array]:
    """Rest, and 0.5 of every joint as in the paper's figures, where X reaches that far."""
    v = problem.robot.domain.v
    return [np.zeros(len(v)), 0.5 * np.minimum(v[:, 1], 1.0)]


def slice_states(problem: Problem, x: Array, y: Array) -> Array:
    """Configurations (m n, nq) over the first two joints, x (n,) fastest; the others at the start."""
    X, Y = np.meshgrid(x, y)
    angles = np.tile(problem.model.to_angles(problem.robot.start), (X.size, 1))
    angles[:, 0], angles[:, 1] = X.ravel(), Y.ravel()
    return problem.model.from_angles(angles)


def slice_title(what: str, v: Array) -> str:
    """The title of a slice at velocity v (nv,)."""
    return f"{what} at v = (" + ", ".join(f"{s:g}" for s in v[:4]) + ("...)" if len(v) > 4 else ")")


def plot_safe_set(problem: Problem, barriers: Mapping[str, Barrier], velocities: list[Array], path: Path) -> None:
    """Slices of safe sets over the first two joints at given velocities (Fig. 5, 7); other joints at the start."""
    fig, axes = plt.subplots(1, len(velocities), figsize=(6 * len(velocities), 5), squeeze=False)
    names = problem.model.joint_names
    for ax, v, cut in zip(axes[0], velocities, safe_set_slices(problem, velocities), strict=True):
        ax.contourf(cut.x, cut.y, cut.h, levels=[-1e9, 0.0], colors=["0.8"])
        for i, (label, barrier) in enumerate(barriers.items()):
            ax.contour(cut.x, cut.y, cut.phi(barrier), levels=[0.0], colors=[f"C{i}"])
            ax.plot([], [], color=f"C{i}", label=label)
        ax.set_title(slice_title("safe sets", v))
        ax.set_xlabel(names[0])
        ax.set_ylabel(names[1])
        ax.legend(frameon=False)
    save_figure(fig, path)


def save_figure(fig: Any, path: Path, top: float = 1.0) -> None:
    """Write a figure, with its folder, and close it; InputError if that cannot be done."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        fig.tight_layout(rect=(0, 0, 1, top))
        fig.savefig(path, dpi=110)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from None
    finally:
        plt.close(fig)


def plot_bench(cases: Sequence[Case], robot: str, path: Path) -> None:
    """Median and 99th percentile of a filter step against pairs (``robot``) and joints (all robots at 126 pairs)."""
    fast = [c for c in cases if c.solver == cases[0].solver]
    grown = sorted((c for c in fast if c.robot == robot), key=lambda c: c.pairs)
    near = min(grown, key=lambda c: abs(c.pairs - 126))
    wide = sorted([near, *(c for c in fast if c.robot != robot)], key=lambda c: c.joints)
    fig, axes = plt.subplots(1, 2, figsize=(9, 3.4), sharey=True)
    for ax, shown, key in zip(axes, (grown, wide), ("pairs", "joints"), strict=True):
        x = [getattr(c, key) for c in shown]
        bottom = np.zeros(len(shown))
        for stage in shown[0].stages:
            top = bottom + [c.stages[stage] for c in shown]
            ax.fill_between(x, bottom, top, alpha=0.5, label=stage)
            bottom = top
        ax.plot(x, [c.median_us for c in shown], "k.-", label="whole step, median")
        ax.plot(x, [c.p99_us for c in shown], "k.:", label="whole step, 99 %")
        ax.set_xlabel("pairs of body sphere and obstacle" if key == "pairs" else "moving joints, at about 126 pairs")
        ax.grid(alpha=0.3)
    axes[0].set_ylim(0.0, 1.05 * max(c.p99_us for c in (*grown, *wide)))  # of both
    axes[0].set_ylabel("filter step [µs]")
    fig.legend(*axes[0].get_legend_handles_labels(), loc="upper center", ncols=6, frameon=False, fontsize=8)
    save_figure(fig, path, top=0.93)
