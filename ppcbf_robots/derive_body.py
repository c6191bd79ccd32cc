"""Body spheres of a robot from its URDF's geometry: a cover of every moving link, found once and kept.

The geometry is the collision geometry; a link without one lends its visual geometry. What is fixed to the base is no
part of the body, and covered by itself.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from ppcbf_robots import body_cache, body_fit
from ppcbf_robots.body_fit import Fit
from ppcbf_robots.body_geometry import UnknownShapeError, digest, pieces_of
from ppcbf_robots.robot import RobotModel
from ppcbf_robots.specs import Array, BodySphere, Spec

VERSION = 2  # of the algorithm: another one finds nothing in the cache
MASSLESS = 1e-6  # [kg], links below which are no bodies but steps between joints
STILL = 1e-3  # [m/rad | -], what moves less per unit of every joint stands still
SNAP = 0.015  # [m], how far a centre is moved onto the axis about which it turns
SAMPLES = 20  # configurations in which motion is looked for
SAMPLE_SEED = 0


class LinkCover(Spec):
    """The spheres of one link and what is fixed to it."""

    link: str
    spheres: list[BodySphere]
    left_out: list[BodySphere]  # of a moving link: no joint moves these
    largest: float  # [m], overestimate: farthest point of the spheres' outside from the geometry
    mean: float  # [m], over the outside's area
    area: float  # [m²], of the outside


class Body(Spec):
    """Body spheres of a robot; ``links`` is empty where no geometry could be covered."""

    spheres: list[BodySphere]
    links: list[LinkCover]

    @property
    def largest(self) -> float:
        """Largest overestimate [m] of any link."""
        return max(link.largest for link in self.links)

    @property
    def mean(self) -> float:
        """Mean overestimate [m] over the outside of all links, each by itself."""
        return sum(link.mean * link.area for link in self.links) / sum(link.area for link in self.links)


def derive_body(robot: RobotModel) -> Body:
    """Spheres whose union contains the surface of every moving link, or stands along the links without geometry.

    Spheres that no joint moves are left out, since nothing the controller does moves them: those of a first link on
    its own axis. Centres near that axis are moved onto it where the cover stays nearly as close, so what is left out
    turns within a ball that fits the link; parts that reach farther have spheres of their own, which do move.

    Args:
        robot: the model; what had to be replaced is added to its warnings.
    """
    shapes = _shapes(robot)
    bare = [j for j in range(1, robot.model.njoints) if j not in shapes and robot.model.inertias[j].mass > MASSLESS]
    if not shapes:
        robot.warnings.append(
            "no collision or visual geometry can be read: body spheres stand along the links and may not contain them; "
            "check package_dirs, or give `body`"
        )
        moving, still = _along_links(robot, range(1, robot.model.njoints))
        return Body(spheres=moving or still, links=[])
    covered, (along, _) = _fitted(robot, shapes), _along_links(robot, bare)
    if along:
        names = ", ".join(f"'{_link(robot, joint).name}'" for joint in bare)
        robot.warnings.append(
            f"no geometry can be read at link {names}: body spheres stand along it and may not contain it; "
            "check package_dirs, or give `body`"
        )
    return Body(spheres=[*covered.spheres, *along], links=covered.links)


def derive_fixed(robot: RobotModel) -> Body:
    """Spheres whose union contains the surface of every link that no joint moves: base, torso, a locked arm."""
    shapes = _readable(robot, pin.GeometryType.VISUAL, fixed=True)
    found = _readable(robot, pin.GeometryType.COLLISION, fixed=True)
    lent = sorted(robot.model.frames[frame].name for frame in shapes.keys() - found.keys())
    if lent:
        names = ", ".join(f"'{name}'" for name in lent)
        robot.warnings.append(f"no collision geometry at link {names}: self-collision keeps off the visual geometry")
    shapes |= found
    frames = {frame: robot.model.frames[frame] for frame in shapes}
    facts = [[frames[f].name, frames[f].placement.homogeneous.tolist(), digest(x)] for f, x in shapes.items()]
    return _recalled(facts, lambda: [_fixed_cover(frames[f], x) for f, x in shapes.items()])


def _fixed_cover(frame: pin.Frame, objects: Sequence[pin.GeometryObject]) -> LinkCover:
    fit = body_fit.fit_fixed(body_fit.Surface(pieces_of(objects, frame.placement)))
    return _link_cover(frame.name, fit, np.ones(len(fit.balls.radii), dtype=bool))


def _fitted(robot: RobotModel, shapes: dict[int, list[pin.GeometryObject]]) -> Body:
    """The cover of all shapes, from the cache if it is there."""
    facts = [
        [_link(robot, j).name, _link(robot, j).placement.homogeneous.tolist(), digest(objects),
         [np.round(x, 9).tolist() for x in _motion(robot, j)]]
        for j, objects in shapes.items()
    ]  # fmt: skip
    return _recalled(facts, lambda: [_cover(robot, joint, objects) for joint, objects in shapes.items()])


def _recalled(facts: list[Any], covers: Callable[[], list[LinkCover]]) -> Body:
    """The body of the links' covers, from the cache if all that they depend on, with ``facts``, is as it was."""
    settings = {"version": [VERSION, SNAP, STILL, body_fit.settings()], "links": facts}
    key = hashlib.sha256(json.dumps(settings).encode()).hexdigest()
    body = body_cache.recall(key, Body)
    if body is None:
        links = covers()
        spheres = [s for link in links for s in link.spheres] or [s for link in links for s in link.left_out]
        body = Body(spheres=spheres, links=links)
        body_cache.keep(key, body)
    return body


def _shapes(robot: RobotModel) -> dict[int, list[pin.GeometryObject]]:
    """Geometry to cover by moving joint, in the order of the joints."""
    joints = range(1, robot.model.njoints)
    found = _readable(robot, pin.GeometryType.COLLISION)
    bare = [joint for joint in joints if joint not in found]
    visual = _readable(robot, pin.GeometryType.VISUAL) if bare else {}
    lent = [joint for joint in bare if joint in visual]
    if lent:
        names = ", ".join(f"'{_link(robot, joint).name}'" for joint in lent)
        robot.warnings.append(f"no collision geometry at link {names}: the body spheres cover the visual geometry")
    shapes = visual | found  # collision geometry where there is any
    return {joint: shapes[joint] for joint in joints if joint in shapes}


def _readable(robot: RobotModel, kind: pin.GeometryType, fixed: bool = False) -> dict[int, list[pin.GeometryObject]]:
    """Shapes of the moving links by joint, or of the fixed ones by frame.

    None, and a warning, if a mesh is missing or a shape cannot be covered.
    """
    try:
        objects = [o for o in robot.geometry(kind).geometryObjects if (o.parentJoint == 0) == fixed]
        digest(objects)
    except (ValueError, RuntimeError, UnknownShapeError) as error:
        what = " ".join(str(error).split())
        robot.warnings.append(f"the {kind.name.lower()} geometry cannot be read ({what[:200]})")
        return {}
    found: dict[int, list[pin.GeometryObject]] = {}
    for o in objects:
        found.setdefault(int(o.parentFrame if fixed else o.parentJoint), []).append(o)
    return found


def _cover(robot: RobotModel, joint: int, objects: Sequence[pin.GeometryObject]) -> LinkCover:
    link, (slope, offset) = _link(robot, joint), _motion(robot, joint)
    surface = body_fit.Surface(pieces_of(objects, link.placement))
    fit = _snapped(surface, body_fit.fit(surface), slope, offset)
    return _link_cover(link.name, fit, np.abs(slope @ fit.balls.centers.T + offset[:, None]).max(axis=0) > STILL)


def _link_cover(link: str, fit: Fit, kept: NDArray[np.bool_]) -> LinkCover:
    order = np.argsort(np.linalg.norm(fit.balls.centers, axis=1), kind="stable")  # the end effector comes last
    spheres = [
        BodySphere(frame=link, center=[round(float(x), 4) for x in c], radius=round(float(r), 4))
        for c, r in zip(fit.balls.centers[order], fit.balls.radii[order], strict=True)
    ]
    return LinkCover(
        link=link,
        spheres=[s for s, k in zip(spheres, kept[order], strict=True) if k],
        left_out=[s for s, k in zip(spheres, kept[order], strict=True) if not k],
        largest=fit.overestimate.largest,
        mean=fit.overestimate.mean,
        area=fit.overestimate.area,
    )


def _snapped(surface: body_fit.Surface, fit: Fit, slope: Array, offset: Array) -> Fit:
    """The same number of balls, with centres near points that no joint moves put onto these where that costs little."""
    centers = fit.balls.centers
    still = centers - (slope @ centers.T + offset[:, None]).T @ np.linalg.pinv(slope, rcond=1e-6).T
    way = np.linalg.norm(still - centers, axis=1)
    rests = np.abs(slope @ still.T + offset[:, None]).max(axis=0) < 0.1 * STILL
    for i in np.argsort(way, kind="stable"):
        if rests[i] and way[i] <= SNAP and len(fit.balls.centers) == len(centers):
            moved = fit.balls.centers.copy()
            moved[i] = still[i]
            other = body_fit.refitted(surface, moved, lead=fit.balls.radii)
            fit = other if other.cost <= body_fit.WORTH * fit.cost else fit
    return fit


def _motion(robot: RobotModel, joint: int) -> tuple[Array, Array]:
    """(slope, offset): a point c of the link moves by ``slope @ c + offset`` per unit of each joint [m/rad | -].

    The rows are all joints' directions x, y, z in sampled configurations.
    """
    name = _link(robot, joint).name
    points = robot.points([name] * 4, np.concatenate([np.zeros((1, 3)), np.eye(3)]))
    rows = []
    for angles in np.random.default_rng(SAMPLE_SEED).uniform(-1.0, 1.0, (SAMPLES, robot.nv)):
        J = points.kinematics(robot.evaluate(robot.from_angles(angles), np.zeros(robot.nv))).J
        rows.append(J.reshape(4, -1))
    at = np.concatenate(rows, axis=1)  # (4, rows): at the link's origin and one metre along each axis
    return (at[1:] - at[0]).T, at[0]


def _link(robot: RobotModel, joint: int) -> pin.Frame:
    bodies = [f for f in robot.model.frames if f.parentJoint == joint and f.type == pin.FrameType.BODY]
    return bodies[0] if bodies else robot.model.frames[robot.model.getFrameId(robot.model.names[joint])]


def _along_links(robot: RobotModel, joints: Sequence[int]) -> tuple[list[BodySphere], list[BodySphere]]:
    """Spheres from joints to the next ones, as thick as suits the reach: those that a joint moves, and the others."""
    reach = sum(float(np.linalg.norm(T.translation)) for T in list(robot.model.jointPlacements)[1:])
    radius = float(np.clip(0.06 * reach, 0.01, 0.08))
    moving: list[BodySphere] = []
    still: list[BodySphere] = []
    for joint in joints:
        link, (slope, offset) = _link(robot, joint), _motion(robot, joint)
        for end in _segment_ends(robot, joint):
            for s in np.linspace(0.0, 1.0, 1 + int(np.ceil(np.linalg.norm(end) / max(1.4 * radius, 0.02)))):
                center = np.round(link.placement.actInv(s * end), 4)
                sphere = BodySphere(frame=link.name, center=center.tolist(), radius=round(radius, 4))
                (moving if np.abs(slope @ center + offset).max() > STILL else still).append(sphere)
    return moving, still


def _segment_ends(robot: RobotModel, joint: int) -> list[Array]:
    """Where the link leads to, in the joint's frame: its child joints, else its farthest frame or centre of mass."""
    model = robot.model
    children = [model.jointPlacements[c].translation for c in range(1, model.njoints) if model.parents[c] == joint]
    if children:
        return [np.array(c) for c in children]
    ends = [np.array(f.placement.translation) for f in model.frames if f.parentJoint == joint]
    ends.append(np.array(model.inertias[joint].lever))
    return [max(ends, key=lambda e: float(np.linalg.norm(e)))]
