"""Which pairs of spheres must not touch each other: not neighbours, and not those an SRDF disables."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from itertools import combinations, product
from pathlib import Path

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from ppcbf_robots.robot import BodyPoints, RobotModel
from ppcbf_robots.specs import Array, BodySphere
from ppcbf_robots.urdf import parse_xml

OFTEN = 0.1  # of random postures, in which spheres overlap, or
CLOSE = 0.03  # [m], nearer than which they always are: is it the links, or are the spheres too coarse?
ALWAYS = 0.9  # of all postures, in which spheres overlap or links meet that are built that way
RARELY = 0.1  # of the postures that a row would forbid: less, in which the links meet, is not worth it


def self_pairs(
    robot: RobotModel,
    body: Sequence[BodySphere],
    fixed: Sequence[BodySphere],
    start: Array | None,
    postures: Array,
    srdf: Path | None,
    fitted: bool,
) -> list[tuple[int, int]]:
    """Pairs (i, j) of spheres that become rows; those of ``fixed``, which no joint moves, follow the body's.

    Left out are spheres of neighbours (one joint, a joint and its parent, the first joints and the link that carries
    them), links whose collision the SRDF disables, fixed ones that a sphere cannot reach, and pairs that overlap in a
    given ``start`` (nq,). So are pairs that overlap in a tenth of ``postures`` (B, nq), random ones, or never part by
    more than 3 cm, where that says more of the cover than of the links: these never meet, or hardly ever where the
    spheres do, or always, being built that way. A fitted body sphere covers any of the links that its joint carries: a
    pair is left out where all of theirs are disabled.
    """
    spheres = [*body, *fixed]
    radii = np.array([s.radius for s in spheres])
    points = robot.points([s.frame for s in spheres], np.array([s.center for s in spheres]))
    disabled = set() if srdf is None else disabled_links(srdf)
    _warn_of_strangers(robot, srdf, disabled)
    carried = _carried(robot) if fitted else {}
    links = [carried.get(int(j), {s.frame}) if j else {s.frame} for s, j in zip(spheres, points.joints, strict=True)]
    p = points.kinematics(robot.evaluate_batch(postures, np.zeros((len(postures), robot.nv)))).p
    at_start = None if start is None else points.kinematics(robot.evaluate(start, np.zeros(robot.nv))).p
    root, reach = _reach(robot, points)
    meetings = _Meetings(robot, postures)
    found: list[tuple[int, int]] = []
    left_out: dict[str, set[str]] = {}
    for i, j in _apart(robot, spheres, points.joints.tolist()):
        if all(frozenset(pair) in disabled for pair in product(links[i], links[j])):
            continue
        both = radii[i] + radii[j]
        if points.joints[j] == 0 and np.linalg.norm(p[0, j] - root) - reach[i] > both:
            continue
        why, gap = "", np.linalg.norm(p[:, i] - p[:, j], axis=1) - both
        if at_start is not None and np.linalg.norm(at_start[i] - at_start[j]) <= both:
            why = "overlap at the start"
        elif np.mean(gap <= 0.0) > OFTEN or gap.max() < CLOSE:
            why = _coarse(gap <= 0.0, meetings.of(frozenset(links[i]), frozenset(links[j])))
        if why:
            left_out.setdefault(why, set()).add(f"{spheres[i].frame} / {spheres[j].frame}")
        else:
            found.append((i, j))
    robot.warnings += [
        f"self-collision: spheres of {', '.join(sorted(names))} {why}, and are left out"
        for why, names in left_out.items()
    ]
    return found


def _apart(robot: RobotModel, spheres: Sequence[BodySphere], joints: Sequence[int]) -> Iterator[tuple[int, int]]:
    """Pairs of spheres that are no neighbours; ``joints`` move them, 0 none."""
    parents = list(robot.model.parents)
    carriers = {j: _carrier(robot, j) for j in set(joints) if j and parents[j] == 0}
    for i, j in combinations(range(len(spheres)), 2):
        a, b = joints[i], joints[j]  # what is fixed comes last
        neighbours = a == b or (a and b and parents[a] == b) or (b and parents[b] == a)
        if not neighbours and not (b == 0 and carriers.get(a) == spheres[j].frame):
            yield i, j


def _coarse(overlap: NDArray[np.bool_], meets: NDArray[np.bool_] | None) -> str:
    """Why spheres that often overlap (B,) say nothing of links that do or do not meet (B,); empty where they do."""
    if np.mean(overlap) > ALWAYS or (meets is not None and np.mean(meets) > ALWAYS):
        return "nearly always overlap"
    if meets is None:  # no geometry: nothing is known of the links
        return ""
    if not meets.any() or (overlap.any() and np.mean(meets[overlap]) < RARELY):
        return "are too coarse for links that hardly meet"
    return ""


def _carrier(robot: RobotModel, joint: int) -> str:
    """The link that carries a joint."""
    model = robot.model
    return str(model.frames[model.frames[model.getFrameId(model.names[joint])].parentFrame].name)


class _Meetings:
    """In which postures (B, nq) links meet; every question is answered once.

    As for the body's cover, a link without collision geometry lends its visual geometry.
    """

    def __init__(self, robot: RobotModel, postures: Array) -> None:
        self._robot, self._postures = robot, postures
        self._known: dict[tuple[frozenset[str], frozenset[str]], NDArray[np.bool_] | None] = {}

    @cached_property
    def _shapes(self) -> pin.GeometryModel:
        shapes = self._robot.geometry(pin.GeometryType.COLLISION)
        there = {o.parentFrame for o in shapes.geometryObjects}
        for o in self._robot.geometry(pin.GeometryType.VISUAL).geometryObjects:
            if o.parentFrame not in there:
                o.name = f"visual {o.name}"
                shapes.addGeometryObject(o)
        return shapes

    def of(self, one: frozenset[str], other: frozenset[str]) -> NDArray[np.bool_] | None:
        """Whether shapes of two sets of links meet (B,); None where there are none."""
        if (one, other) not in self._known:
            self._known[one, other] = self._computed(one, other)
        return self._known[one, other]

    def _computed(self, one: frozenset[str], other: frozenset[str]) -> NDArray[np.bool_] | None:
        shapes, model = self._shapes, self._robot.model
        of = {i: model.frames[o.parentFrame].name for i, o in enumerate(shapes.geometryObjects)}
        pairs = [(i, j) for i in of for j in of if of[i] in one and of[j] in other]
        if not pairs:
            return None
        shapes.removeAllCollisionPairs()
        for pair in pairs:
            shapes.addCollisionPair(pin.CollisionPair(*pair))
        data, scratch = shapes.createData(), model.createData()
        return np.array([pin.computeCollisions(model, scratch, shapes, data, q, True) for q in self._postures])


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
