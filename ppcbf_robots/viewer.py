"""Runs in 3D in meshcat's viewer: one robot per trajectory, its path, and what the filter does while it plays."""

from __future__ import annotations

import webbrowser
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import meshcat
import numpy as np
import pinocchio as pin
from meshcat import geometry as mg
from meshcat.animation import Animation, AnimationClip, AnimationTrack

from ppcbf_robots.errors import InputError
from ppcbf_robots.filters import Status
from ppcbf_robots.problem import Problem
from ppcbf_robots.rollout import Trajectory
from ppcbf_robots.specs import Array
from ppcbf_robots.viewer_page import PageServer, Recorder, render
from ppcbf_robots.viewer_shapes import align, beads, drawable, floor_grid, robot_parts
from ppcbf_robots.world import HalfSpace, Obstacle
from ppcbf_robots.world_shapes import coal_shape, surface_points

FPS = 30
ROBOT_COLORS = (0x5B8FD0, 0x63AD72, 0x9B7CC8, 0x3FB0B8, 0xB58A6A, 0x8A93A0)
OBSTACLE_COLOR = 0x4A5058
STATES: tuple[tuple[str, int | None], ...] = (  # None: the robot's own colour
    ("free", None),
    ("correcting", 0xFF9500),
    ("resting", 0x16181C),
    ("alarm", 0xE3001B),
)
_STATE_OF = np.array([min(int(s), int(Status.PASSIVITY_DROPPED)) for s in Status])  # index into STATES


def show(
    problem: Problem,
    trajectories: Sequence[Trajectory],
    labels: Sequence[str],
    port: int = 0,
    open_browser: bool = False,
) -> PageServer:
    """Serve the view on 127.0.0.1 from this process; nothing is printed.

    Args:
        problem: robot and world.
        trajectories: one robot is drawn for each.
        labels: one per trajectory, for the legend.
        port: 0 takes any free port.
        open_browser: also open the page in the user's browser.

    Returns:
        A running server with its ``url``; call ``wait()`` to serve until Ctrl-C, or ``close()``.

    Raises:
        InputError: if a trajectory does not belong to the problem, or the port cannot be used.
    """
    server = PageServer(page(problem, trajectories, labels), port)
    if open_browser:
        webbrowser.open(server.url)
    return server


def write_html(problem: Problem, trajectories: Sequence[Trajectory], labels: Sequence[str], path: Path) -> None:
    """Write the view as one HTML file that plays offline.

    Raises:
        InputError: if a trajectory does not belong to the problem, or the file cannot be written.
    """
    text = page(problem, trajectories, labels)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from None


def check_trajectories(problem: Problem, trajectories: Sequence[Trajectory], labels: Sequence[str]) -> None:
    """InputError unless there is at least one trajectory, one label for each, and all are of the problem's robot."""
    if not trajectories:
        raise InputError("nothing to show: give at least one trajectory")
    if len(labels) != len(trajectories):
        raise InputError(f"expected {len(trajectories)} labels, one per trajectory, got {len(labels)}")
    for trajectory, label in zip(trajectories, labels, strict=True):
        nq, nv = trajectory.q.shape[-1], trajectory.v.shape[-1]
        if (nq, nv, len(trajectory.meta["goal"])) != (problem.model.nq, problem.model.nv, problem.model.nq):
            raise InputError(
                f"trajectory '{label}' is of a robot with {nv} moving joints, nq = {nq}, but '{problem.robot.name}' "
                f"has {problem.model.nv}, nq = {problem.model.nq}: give the robot it was simulated with"
            )
        if not len(trajectory.q) or not np.all(np.isfinite(trajectory.q[0])):
            raise InputError(f"trajectory '{label}' holds no usable configuration")


@dataclass(frozen=True)
class _Run:
    """A trajectory at FPS frames per second."""

    path: str  # in the scene tree
    label: str
    color: int
    ghost: bool  # drawn translucent
    placements: Array  # (frames, joints, 4, 4)
    tip: Array  # (frames, 3) end effector [m]
    goal: Array  # (3,) where the end effector is at the goal [m]
    state: Array  # (frames,) index into STATES, the gravest of each frame
    clearance: Array  # (frames,) least of each frame [m]

    @property
    def state_colors(self) -> Array:
        """(frames, 3) in [0, 1]."""
        palette = np.array([_rgb(self.color if color is None else color) for _, color in STATES])
        return np.asarray(palette[self.state])


@dataclass(frozen=True)
class _View:
    """The ball around everything that is looked at."""

    center: Array  # (3,) [m]
    radius: float  # [m]
    flat: bool  # all motion lies in a plane of constant y


def page(problem: Problem, trajectories: Sequence[Trajectory], labels: Sequence[str]) -> str:
    """The view as HTML; InputError if a trajectory does not belong to the problem."""
    check_trajectories(problem, trajectories, labels)
    runs = _runs(problem, trajectories, labels)
    view = _view(problem, runs)
    recorder = Recorder()
    scene = meshcat.Visualizer(window=recorder)
    _draw_stage(scene, view)
    for obstacle in problem.world.obstacles:
        _draw_obstacle(scene["obstacles"][_path_part(obstacle.name)], obstacle, view)
    animation = Animation(default_framerate=FPS)
    for run in runs:
        _draw_robot(scene[run.path], problem, run, view)
        _draw_trail(scene[run.path], run, view)
        _animate(animation, scene[run.path], run)
    scene.set_animation(animation, play=True, repetitions=10**6)
    title = f"{Path(problem.robot.name).stem} · {Path(problem.world_name).stem}"
    return render(title, recorder, _facts(runs, view))


def _tip(problem: Problem) -> tuple[int, Array]:
    """End effector: joint and position in its frame, of the last body sphere."""
    last = problem.robot.body[-1]
    points = problem.model.points([last.frame], np.array([last.center]))
    return int(points.joints[0]), np.asarray(points.offsets[0])


def _runs(problem: Problem, trajectories: Sequence[Trajectory], labels: Sequence[str]) -> list[_Run]:
    joint, offset = _tip(problem)
    frames = max(2, *(_frame_count(t.t) for t in trajectories))
    runs = []
    for i, (trajectory, label) in enumerate(zip(trajectories, labels, strict=True)):
        rows, state, clearance = _resample(trajectory, frames)
        placements = problem.model.evaluate_batch(rows, np.zeros((frames, problem.model.nv))).placements
        goal = problem.model.evaluate(np.asarray(trajectory.meta["goal"]), np.zeros(problem.model.nv)).placements
        path, color = f"{i + 1} {_path_part(label)}", ROBOT_COLORS[i % len(ROBOT_COLORS)]
        tip, goal_tip = (placements[:, joint] @ offset)[:, :3], (goal[joint] @ offset)[:3]
        runs.append(_Run(path, label, color, i > 0, placements, tip, goal_tip, state, clearance))
    return runs


def _frame_count(t: Array) -> int:
    return 1 + int(FPS * (t[-1] - t[0]) + 1e-6)


def _resample(trajectory: Trajectory, frames: int) -> tuple[Array, Array, Array]:
    """Configurations, states and clearances at FPS; a run that ends early holds its last row."""
    usable = np.all(np.isfinite(trajectory.q), axis=1)
    count = len(usable) if usable.all() else int(np.argmin(usable))  # a run that blew up is shown until it did
    t = trajectory.t[:count] - trajectory.t[0]
    rows = np.minimum(np.searchsorted(t, np.arange(_frame_count(t)) / FPS - 1e-9), count - 1)
    state = np.maximum.reduceat(_STATE_OF[trajectory.status[:count].astype(int)], rows)
    clearance = np.minimum.reduceat(trajectory.clearance[:count], rows)
    hold = np.minimum(np.arange(frames), len(rows) - 1)
    return trajectory.q[rows][hold], state[hold], clearance[hold]


def _view(problem: Problem, runs: Sequence[_Run]) -> _View:
    points = [r.placements[:, :, :3, 3].reshape(-1, 3) for r in runs] + [r.tip for r in runs]
    flat = bool(np.ptp(np.concatenate(points)[:, 1]) < 1e-3)
    points += [surface_points(o) for o in problem.world.obstacles if not isinstance(o, HalfSpace)]
    seen = np.concatenate(points)
    low, high = seen.min(axis=0), seen.max(axis=0)
    return _View((low + high) / 2.0, max(float(np.linalg.norm(high - low)) / 2.0, 0.05), flat)


def _draw_stage(scene: meshcat.Visualizer, view: _View) -> None:
    scene["/Background"].set_property("top_color", [0.98, 0.98, 0.99])
    scene["/Background"].set_property("bottom_color", [0.80, 0.83, 0.87])
    scene["/Grid"].set_property("visible", False)  # 20 m wide, whatever the robot's size
    grid = floor_grid(view.center, view.radius)
    scene["floor grid"].set_object(mg.LineSegments(grid, mg.LineBasicMaterial(color=0x9AA2AC)))
    scene["/Axes/<object>"].set_property("scale", [0.5 * view.radius] * 3)


def _draw_obstacle(node: meshcat.Visualizer, obstacle: Obstacle, view: _View) -> None:
    """The solid itself, or a thin plate on the solid side of a plane, next to what is looked at."""
    if not isinstance(obstacle, HalfSpace):
        shape, placement = coal_shape(obstacle)
        opacity = 0.8 if obstacle.type == "sphere" else 0.45  # boxes and pillars hide what is behind them
        node.set_object(drawable(shape), _material(OBSTACLE_COLOR, opacity))
        node.set_transform(placement)
        return
    normal, size = np.array(obstacle.normal), 2.6 * view.radius
    foot = view.center - (normal @ view.center - obstacle.offset) * normal
    node.set_object(mg.Box([size, size, 0.01 * size]), _material(OBSTACLE_COLOR, 0.35))
    node.set_transform(align(normal, foot - 0.005 * size * normal))


def _draw_robot(node: meshcat.Visualizer, problem: Problem, run: _Run, view: _View) -> None:
    """Shapes and the spheres of the body and of what is fixed, under one animated node per joint each."""
    joint, offset = _tip(problem)
    for i, part in enumerate(robot_parts(problem.model, joint, offset[:3])):
        child = node["robot"][str(part.joint)][str(i)]
        child.set_object(part.shape, _material(run.color, 0.45 if run.ghost else 1.0))
        child.set_transform(part.placement)
    body = [*problem.robot.body, *problem.robot.fixed.spheres]
    points = problem.model.points([s.frame for s in body], np.array([s.center for s in body]))
    for i, (parent, center, sphere) in enumerate(zip(points.joints, points.offsets, body, strict=True)):
        child = node["body spheres"][str(parent)][str(i)]
        radius = max(sphere.radius, 0.01 * view.radius)  # a point is shown as a small ball
        child.set_object(mg.Sphere(radius), _material(run.color, 0.22, depthWrite=False))
        child.set_transform(pin.SE3(np.eye(3), center[:3]).homogeneous)


def _draw_trail(node: meshcat.Visualizer, run: _Run, view: _View) -> None:
    """The end effector's path, one bead per frame, in the colours of the filter's states."""
    colors = run.state_colors
    line = mg.PointsGeometry(run.tip.T.astype(np.float32), colors.T.astype(np.float32))
    dots = beads(run.tip, 0.008 * view.radius, colors)
    node["trail"]["line"].set_object(mg.Line(line, mg.LineBasicMaterial(vertexColors=True)))
    node["trail"]["beads"].set_object(dots, mg.MeshBasicMaterial(vertexColors=True))
    node["marker"].set_object(mg.Sphere(0.04 * view.radius), mg.MeshPhongMaterial())
    diamond = beads(run.goal[None, :], 0.05 * view.radius, colors[:1])
    node["goal"].set_object(diamond, mg.MeshBasicMaterial(color=run.color, wireframe=True))


def _animate(animation: Animation, node: meshcat.Visualizer, run: _Run) -> None:
    poses = np.array([[pin.SE3ToXYZQUAT(pin.SE3(T)) for T in row] for row in run.placements])
    for j in range(1, poses.shape[1]):  # joint 0 is the base
        for group in ("robot", "body spheres"):
            tracks = {"position": ("vector3", poses[:, j, :3]), "quaternion": ("quaternion", poses[:, j, 3:])}
            _add_clip(animation, node[group][str(j)], tracks)
    _add_clip(animation, node["marker"], {"position": ("vector3", run.tip)})
    _add_clip(animation, node["marker"]["<object>"], {"material.color": ("color", run.state_colors)})


def _add_clip(animation: Animation, node: meshcat.Visualizer, tracks: dict[str, tuple[str, Array]]) -> None:
    clip = AnimationClip(fps=FPS)
    for name, (kind, values) in tracks.items():
        clip.tracks[name] = AnimationTrack(name, kind, list(range(len(values))), np.round(values, 6).tolist())
    animation.clips[node.path] = clip


def _facts(runs: Sequence[_Run], view: _View) -> dict[str, Any]:
    """What the page's own script needs (see viewer_page)."""
    side = np.array([0.1, -1.0, 0.15] if view.flat else [1.0, -0.75, 0.6])
    eye = view.center + 2.3 * view.radius * side / np.linalg.norm(side)
    return {
        "fps": FPS,
        "frames": len(runs[0].tip),
        "camera": {"eye": _y_up(eye), "target": _y_up(view.center)},
        "states": [{"name": name, "color": None if color is None else _css(color)} for name, color in STATES],
        "runs": [_run_facts(run) for run in runs],
    }


def _run_facts(run: _Run) -> dict[str, Any]:
    facts = {"label": run.label, "color": _css(run.color), "body": ["meshcat", run.path, "body spheres"]}
    return {**facts, "states": run.state.tolist(), "clearance": np.round(run.clearance, 4).tolist()}


def _material(color: int, opacity: float = 1.0, **more: object) -> mg.MeshPhongMaterial:
    """Where surfaces coincide, as two robots' do at their start, the offset lets the solid one be seen, unmixed."""
    back = {"polygonOffset": True, "polygonOffsetFactor": 1, "polygonOffsetUnits": 1} if opacity < 1.0 else {}
    return mg.MeshPhongMaterial(color=color, opacity=opacity, **back, **more)


def _y_up(p: Array) -> list[float]:
    return [float(p[0]), float(p[2]), float(-p[1])]


def _rgb(color: int) -> list[float]:
    return [(color >> shift & 0xFF) / 255.0 for shift in (16, 8, 0)]


def _css(color: int) -> str:
    return f"#{color:06x}"


def _path_part(name: str) -> str:
    """A name that is one level of the scene tree."""
    return name.replace("/", "∕")
