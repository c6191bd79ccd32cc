"""Which pairs of spheres must not touch each other: not neighbours, and not those an SRDF disables."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, product
from pathlib import Path

import numpy as np
import pinocchio as pin

from ppcbf_robots.robot import BodyPoints, RobotModel
from ppcbf_robots.specs import Array, BodySphere
from ppcbf_robots.urdf import parse_xml

OFTEN = 0.2  # of random postures, in which spheres that overlap say more of the cover than of the links


def self_pairs(
    robot: RobotModel,
    body: Sequence[BodySphere],
    fixed: Sequence[BodySphere],
    postures: Array,
    srdf: Path | None,
    fitted: bool,
) -> list[tuple[int, int]]:
    """Pairs (i, j) of spheres that become rows; those of ``fixed``, which no joint moves, follow the body's.

    Left out are spheres of one joint or of a joint and its parent, links whose collision the SRDF disables, fixed ones
    that a sphere cannot reach, and pairs that overlap in the first of ``postures`` (B, nq), the start, or in a fifth of
    the others, random ones: there the spheres are coarser than the links. A fitted body sphere covers any of the links
    that its joint carries: a pair is left out where all of theirs are disabled.
    """
    spheres = [*body, *fixed]
    points = robot.points([s.frame for s in spheres], np.array([s.center for s in spheres]))
    joints, parents = points.joints, list(robot.model.parents)
    disabled = set() if srdf is None else disabled_links(srdf)
    _warn_of_strangers(robot, srdf, disabled)
    carried = _carried(robot) if fitted else {}
    links = [carried.get(int(j), {s.frame}) for s, j in zip(spheres, joints, strict=True)]
    p = points.kinematics(robot.evaluate_batch(postures, np.zeros((len(postures), robot.nv)))).p
    root, reach = _reach(robot, points)
    found, touching = [], 0
    for i, j in combinations(range(len(spheres)), 2):
        a, b = int(joints[i]), int(joints[j])
        if a == b or parents[a] == b or parents[b] == a:
            continue
        if all(frozenset(pair) in disabled for pair in product(links[i], links[j])):
            continue
        both = spheres[i].radius + spheres[j].radius
        if b == 0 and np.linalg.norm(p[0, j] - root) - reach[i] > both:
            continue
        overlap = np.linalg.norm(p[:, i] - p[:, j], axis=1) <= both
        if overlap[0] or overlap[1:].mean() > OFTEN:
            touching += 1
            continue
        found.append((i, j))
    if touching:
        robot.warnings.append(
            f"self-collision: {touching} pairs of spheres overlap at the start, or in a fifth of all postures, and are "
            "left out"
        )
    return found


def _reach(robot: RobotModel, points: BodyPoints) -> tuple[Array, Array]:
    """Where the first joint sits, and how far from there each point can get at most [m]: all links in line."""
    model, root = robot.model, np.array(robot.model.jointPlacements[1].translation)
    far = np.zeros(model.njoints)
    turns = robot.revolute | robot.continuous
    for joint in range(1, model.njoints):
        parent, at = model.parents[joint], model.jointPlacements[joint].translation
        far[joint] = far[parent] + np.linalg.norm(at if parent else at - root)
        i = model.joints[joint].idx_v
        far[joint] += 0.0 if turns[i] else max(abs(robot.q_lower[i]), abs(robot.q_upper[i]))
    last = np.linalg.norm(points.offsets[:, :3], axis=1)
    return root, far[points.joints] + last


def _carried(robot: RobotModel) -> dict[int, set[str]]:
    """Links with collision geometry by the joint that moves them."""
    found: dict[int, set[str]] = {}
    for o in (o for o in robot.geometry(pin.GeometryType.COLLISION).geometryObjects if o.parentJoint):
        found.setdefault(int(o.parentJoint), set()).add(robot.model.frames[o.parentFrame].name)
    return found


def _warn_of_strangers(robot: RobotModel, srdf: Path | None, disabled: set[frozenset[str]]) -> None:
    """An SRDF that does not fit the robot would leave out other pairs than its author meant."""
    strangers = sorted({link for pair in disabled for link in pair if not robot.model.existFrame(link)})
    if srdf is not None and not disabled:
        robot.warnings.append(f"{srdf}: disables no pair of links; is it the SRDF of this robot?")
    if strangers:
        robot.warnings.append(f"{srdf}: the robot has no link named {', '.join(strangers[:5])}; is it its SRDF?")


def disabled_links(srdf: Path) -> set[frozenset[str]]:
    """Pairs of links named by ``<disable_collisions link1=... link2=...>``; InputError if the file is not an SRDF."""
    root = parse_xml(srdf, "SRDF")
    return {frozenset((str(e.get("link1")), str(e.get("link2")))) for e in root.iter("disable_collisions")}
