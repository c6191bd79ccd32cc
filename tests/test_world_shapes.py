"""Obstacles as coal shapes and surface points, as drawings, and the bundled worlds."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path
from typing import Any

import coal
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from meshcat import geometry as mg

from ppcbf_robots import plots
from ppcbf_robots.errors import InputError
from ppcbf_robots.plots import outline
from ppcbf_robots.problem import load_problem
from ppcbf_robots.resources import bundled, find_world
from ppcbf_robots.rollout import simulate
from ppcbf_robots.viewer_shapes import drawable
from ppcbf_robots.world import Box, Capsule, ConvexMesh, Cylinder, HalfSpace, Sphere
from ppcbf_robots.world_files.load import load_world, read_world
from ppcbf_robots.world_shapes import Solid, coal_shape, surface_points

DATA = Path(__file__).parent / "data" / "worlds"


SOLIDS: list[Solid] = [
    o for path in sorted(DATA.glob("*.*")) for o in load_world(path).obstacles if not isinstance(o, HalfSpace)
]  # fmt: skip


@pytest.mark.parametrize("solid", SOLIDS, ids=lambda o: f"{o.type} {o.name}")
def test_shape_and_surface_agree(solid: Solid) -> None:
    """Every surface point touches coal's shape; a point above the topmost one does not."""
    shape, T = coal_shape(solid)
    placed = coal.Transform3s(T[:3, :3], T[:3, 3])
    points = surface_points(solid)
    for p in points[:: max(1, len(points) // 40)]:
        speck = coal.Transform3s(np.eye(3), p)
        d = coal.distance(coal.Sphere(1e-6), speck, shape, placed, coal.DistanceRequest(), coal.DistanceResult())
        assert abs(d) < 1e-4
    shape.computeLocalAABB()
    corners = np.array(list(itertools.product(*zip(shape.aabb_local.min_, shape.aabb_local.max_, strict=True))))
    reach = np.linalg.norm(corners, axis=1).max()
    assert np.linalg.norm(points - T[:3, 3], axis=1).max() <= reach + 1e-9


def test_measures_are_full_lengths() -> None:
    turned = {"xyz": [1.0, 2.0, 3.0], "rpy": [np.pi / 2, 0.0, 0.0]}  # z turns to -y, y to z
    for solid, widths in (
        (Box(name="a", type="box", size=[0.2, 0.4, 0.6], **turned), [0.2, 0.6, 0.4]),
        (Cylinder(name="a", type="cylinder", radius=0.1, length=0.6, **turned), [0.2, 0.6, 0.2]),
        (Capsule(name="a", type="capsule", radius=0.1, length=0.6, **turned), [0.2, 0.8, 0.2]),
        (Sphere(name="a", type="sphere", center=[1, 2, 3], radius=0.1), [0.2, 0.2, 0.2]),
    ):
        points = surface_points(solid)
        np.testing.assert_allclose(np.ptp(points, axis=0), widths, atol=1e-6)
        np.testing.assert_allclose(0.5 * (points.max(axis=0) + points.min(axis=0)), [1, 2, 3], atol=1e-6)


@pytest.mark.parametrize("name", ["table_boxes", "shelf", "pillar"])
def test_bundled_worlds_keep_clear_of_the_arms_foot(name: str) -> None:
    foot = coal.Cylinder(0.15, 0.4), coal.Transform3s(np.eye(3), np.array([0.0, 0.0, 0.1]))
    for o in load_world(find_world(name)).obstacles:
        assert not isinstance(o, HalfSpace)
        shape, T = coal_shape(o)
        placed = coal.Transform3s(T[:3, :3], T[:3, 3])
        assert coal.distance(*foot, shape, placed, coal.DistanceRequest(), coal.DistanceResult()) > 0.1
        shoulder = coal.Sphere(0.7), coal.Transform3s(np.eye(3), np.array([0.0, 0.0, 0.33]))
        assert coal.distance(*shoulder, shape, placed, coal.DistanceRequest(), coal.DistanceResult()) < 0.25, o.name


def test_every_bundled_world_loads() -> None:
    for path in bundled("obstacles").values():
        assert read_world(path).notes == []


def test_a_mesh_that_was_not_read_has_no_shape() -> None:
    mesh = ConvexMesh(name="m", type="mesh", file="m.stl")
    with pytest.raises(InputError, match=r"^obstacle 'm': its file 'm\.stl' was not read"):
        coal_shape(mesh)


# Drawings


@pytest.mark.parametrize("solid", SOLIDS, ids=lambda o: f"{o.type} {o.name}")
def test_a_drawing_has_the_size_of_the_solid(solid: Solid) -> None:
    shape, T = coal_shape(solid)
    drawn = drawable(shape)
    if isinstance(drawn, mg.Box):
        vertices = np.array(list(itertools.product(*[(-0.5 * x, 0.5 * x) for x in drawn.lengths])))
    else:
        vertices = drawn.vertices
    placed = vertices @ T[:3, :3].T + T[:3, 3]
    points = surface_points(solid)
    size = np.ptp(points, axis=0).max()
    np.testing.assert_allclose(placed.min(axis=0), points.min(axis=0), atol=0.01 * size)
    np.testing.assert_allclose(placed.max(axis=0), points.max(axis=0), atol=0.01 * size)


def test_a_hull_is_drawn_closed_and_with_edges() -> None:
    """Each edge of the triangles is met by another one the other way round, if corners in one place are one."""
    hull = ConvexMesh(name="m", type="mesh", vertices=list(itertools.product((0.0, 0.1), (0.0, 0.2), (0.0, 0.3))))
    drawn = drawable(coal_shape(hull)[0])
    assert len(drawn.faces) == 12 and len(drawn.vertices) == 36
    corners = np.unique(np.round(drawn.vertices, 9), axis=0, return_inverse=True)[1].reshape(-1, 3)
    edges = {frozenset(e) for t in corners for e in ((t[0], t[1]), (t[1], t[2]), (t[2], t[0]))}
    assert len(edges) == 18  # of a closed surface: half of three per triangle


def test_every_obstacle_casts_a_shadow_in_plots(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    problem = load_problem("two_link", "circle")
    problem = dataclasses.replace(problem, world=load_world(DATA / "ours.yaml"))
    run = simulate(problem.safety, problem.robot.controller, None, problem.robot.start, np.zeros(2), 0.05)
    figures: list[Any] = []
    monkeypatch.setattr(plots, "save", lambda figure, path: figures.append(figure))
    plots.plot_paths(problem, {"free": run}, tmp_path / "paths.png")
    solids = [o for o in problem.world.obstacles if not isinstance(o, HalfSpace)]
    for ax, k in zip(figures[0].axes, (2, 1), strict=True):
        assert len(ax.patches) == len(solids) == 6
        for patch, solid in zip(ax.patches, solids, strict=True):
            box, points = patch.get_extents().transformed(ax.transData.inverted()), surface_points(solid)[:, [0, k]]
            np.testing.assert_allclose([box.min, box.max], [points.min(axis=0), points.max(axis=0)], atol=1e-3)


@given(st.lists(st.tuples(st.integers(-5, 5), st.integers(-5, 5)), min_size=1, max_size=30))
@settings(deadline=None)
def test_an_outline_is_convex_and_holds_all_points(points: list[tuple[int, int]]) -> None:
    cloud = np.array(points, dtype=float)
    corners = outline(cloud)
    assert {tuple(c) for c in corners} <= {tuple(p) for p in cloud}
    for a, b in itertools.pairwise([*corners, corners[0]]):
        side = (b - a)[0] * (cloud - a)[:, 1] - (b - a)[1] * (cloud - a)[:, 0]
        assert side.min() >= 0.0
