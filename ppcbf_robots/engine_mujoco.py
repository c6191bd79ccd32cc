"""MuJoCo as engine: the same robot and world in another simulator, with contact between the two.

The robot is built from Pinocchio's reduced model, joint by joint, not from the URDF: locked joints, payloads and merged
links are then the same by construction. Joints have neither limits nor damping. Each link has the shapes of
its collision geometry, meshes as their convex hulls; links without readable geometry have the robot's body spheres.
Where a hull touches, the mesh itself is looked at, and the contact says whether it is the hull's alone.
Robot and obstacles touch; the robot's links pass through each other, and what is fixed to the base touches nothing.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from typing import NamedTuple

import coal
import mujoco
import numpy as np
import pinocchio as pin

from ppcbf_robots.engines import Contact, EngineName
from ppcbf_robots.mesh_contact import MeshContact
from ppcbf_robots.problem import Problem
from ppcbf_robots.robot import RobotModel
from ppcbf_robots.specs import Array, BodySphere
from ppcbf_robots.world import Box, Capsule, ConvexMesh, Cylinder, HalfSpace, Sphere

log = logging.getLogger(__name__)

_POINT = 1e-6  # [m], radius of body spheres without one; MuJoCo has no points
_THIN = 2e-4  # [m], least extent of a mesh: a flat one has no convex hull
_HARD = 0.9999  # impedance of dry friction
_PLANE_SIZE = [0.0, 0.0, 1.0]  # without end; the last is the spacing of a drawn grid


if mujoco.get_mju_user_warning() is None:  # else they go to stdout and to a file in the working folder
    mujoco.set_mju_user_warning(log.warning)


class _Shape(NamedTuple):
    """A solid in its own frame, in MuJoCo's terms: a mesh has points, all others a size (half lengths)."""

    kind: mujoco.mjtGeom
    size: list[float]
    points: Array | None = None


class _Placed(NamedTuple):
    """A shape at a place of the body that carries it; ``label`` is the name of its link or obstacle."""

    label: str
    shape: _Shape
    rotation: Array  # (3, 3)
    xyz: Array  # (3,) [m]
    mesh: coal.BVHModelBase | None = None  # in the shape's frame, whose hull the shape is


class MujocoEngine:
    """A problem's robot and world in MuJoCo (see :class:`ppcbf_robots.engines.Engine`), integrated by RK4.

    ``plant`` moves instead of the problem's robot (see :mod:`ppcbf_robots.plant`), with its dry friction. ``model`` and
    ``data`` are MuJoCo's own; ``dofs`` (nv,) holds the address of each of the robot's joints there.
    """

    name: EngineName = "mujoco"

    def __init__(self, problem: Problem, plant: RobotModel | None = None) -> None:
        self.robot = plant or problem.model
        spec = mujoco.MjSpec()
        _set_options(spec, self.robot)
        links = _add_links(spec, self.robot)
        parts = _robot_parts(self.robot, problem.robot.body)
        geoms = [(_add_geom(spec, links[joint], p, robot=True), p) for joint, p in parts]
        geoms += [(_add_geom(spec, spec.worldbody, p, robot=False), p) for p in _obstacles(problem)]
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self._set_inertias()
        joints = [self.model.joint(_name(i)) for i in range(1, len(links))]
        self.dofs = np.array([int(j.dofadr[0]) for j in joints])
        self._qpos = np.array([int(j.qposadr[0]) for j in joints])
        self.model.dof_frictionloss[self.dofs] = self.robot.friction
        self.model.dof_solimp[self.dofs, :2] = _HARD  # by default friction gives way and the joint creeps
        self._placed = {self.model.geom(name).id: part for name, part in geoms}
        self._mesh_contact = MeshContact(problem.world.obstacles)

    def _set_inertias(self) -> None:
        """Masses and inertias, past the compiler, which refuses point masses and links without mass."""
        for i in range(1, self.robot.model.njoints):
            body = self.model.body(_name(i)).id
            self.model.body_mass[body] = self.robot.model.inertias[i].mass
            self.model.body_inertia[body] = _principal_inertia(self.robot.model.inertias[i])[0]
        mujoco.mj_setConst(self.model, self.data)

    def reset(self, q: Array, v: Array) -> None:
        """Put the robot into the state (q, v); q (nq,) in Pinocchio's coordinates, v (nv,)."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[self._qpos] = self.robot.to_angles(q)
        self.data.qvel[self.dofs] = v

    def state(self) -> tuple[Array, Array]:
        """(q, v) now, as in :meth:`reset`."""
        return self.robot.from_angles(self.data.qpos[self._qpos]), np.array(self.data.qvel[self.dofs])

    def advance(self, u: Array, dt: float, count: int) -> None:
        """``count`` integration steps of ``dt`` [s] under the torque u (nv,), held."""
        self.model.opt.timestep = dt
        self.data.qfrc_applied[self.dofs] = u
        mujoco.mj_step(self.model, self.data, count)

    def contacts(self) -> list[Contact]:
        """What touches in the present state, the deepest point of each pair of link and obstacle."""
        mujoco.mj_fwdPosition(self.model, self.data)
        deepest: dict[tuple[str, str], float] = {}
        real: dict[tuple[str, str], bool] = {}  # not of convex hulls alone
        for pair, distance in zip(self.data.contact.geom, self.data.contact.dist, strict=True):
            obstacle, part = sorted(pair, key=lambda geom: int(self.model.geom_bodyid[geom]))  # obstacles: body 0
            key = self._placed[int(part)].label, self._placed[int(obstacle)].label
            deepest[key] = max(deepest.get(key, 0.0), -float(distance))
            real[key] = real.get(key, False) or self._touches(int(part), key[1])
        return [Contact(*key, depth, not real[key]) for key, depth in deepest.items()]

    def _touches(self, geom: int, obstacle: str) -> bool:
        """Whether a shape of the robot that MuJoCo has in contact with an obstacle really is."""
        part, body = self._placed[geom], self.model.geom_bodyid[geom]
        if part.mesh is None:
            return True
        turn, origin = self.data.xmat[body].reshape(3, 3), self.data.xpos[body]
        return self._mesh_contact.touches(part.mesh, turn @ part.rotation, origin + turn @ part.xyz, obstacle)


def _name(joint: int) -> str:
    """Name of a joint and its body: numbers cannot clash with MuJoCo's own names."""
    return f"joint{joint}"


def _set_options(spec: mujoco.MjSpec, robot: RobotModel) -> None:
    spec.option.gravity = robot.model.gravity.linear
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
    # a run that diverges is to be seen as such, not to start anew
    spec.option.disableflags = int(spec.option.disableflags) | int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE


def _add_links(spec: mujoco.MjSpec, robot: RobotModel) -> list[mujoco.MjsBody]:
    """One body with one joint per joint of the robot, by joint; the first is the world."""
    model, data = robot.model, robot.model.createData()
    pin.computeJointJacobians(model, data, pin.neutral(model))
    bodies = [spec.worldbody]
    for i in range(1, model.njoints):
        place = model.jointPlacements[i]
        _, rotation = _principal_inertia(model.inertias[i])
        body = bodies[model.parents[i]].add_body(name=_name(i), pos=place.translation, quat=_quaternion(place.rotation))
        body.explicitinertial = True
        body.mass, body.inertia = 1.0, np.ones(3)  # the true ones follow after compilation
        body.ipos, body.iquat = model.inertias[i].lever, _quaternion(rotation)
        J = pin.getJointJacobian(model, data, i, pin.ReferenceFrame.LOCAL)
        S = J.reshape(6, -1)[:, model.joints[i].idx_v]  # a single joint's Jacobian comes flat
        turns = bool(np.linalg.norm(S[3:]) > 0.5)
        kind = mujoco.mjtJoint.mjJNT_HINGE if turns else mujoco.mjtJoint.mjJNT_SLIDE
        body.add_joint(name=_name(i), type=kind, axis=S[3:] if turns else S[:3])
        bodies.append(body)
    return bodies


def _principal_inertia(inertia: pin.Inertia) -> tuple[Array, Array]:
    """Principal moments (3,) about the centre of mass, and the rotation (3, 3) of their axes."""
    moments, axes = np.linalg.eigh(inertia.inertia)
    return moments, axes * np.sign(np.linalg.det(axes))


def _quaternion(rotation: Array) -> Array:
    """(4,), w first."""
    x, y, z, w = pin.Quaternion(np.asarray(rotation, float)).normalized().coeffs()
    return np.array([w, x, y, z])


def _add_geom(spec: mujoco.MjSpec, body: mujoco.MjsBody, part: _Placed, robot: bool) -> str:
    """Add a shape to a body, and give the name that identifies it; robot and obstacles touch, like and like do not."""
    name = f"geom{len(spec.geoms)}"
    geom = body.add_geom(name=name, type=part.shape.kind, pos=part.xyz, quat=_quaternion(part.rotation))
    geom.contype, geom.conaffinity = (1, 0) if robot else (0, 1)
    if part.shape.points is None:
        geom.size[: len(part.shape.size)] = np.maximum(part.shape.size, 0.5 * _THIN)
    else:
        convex = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
        spec.add_mesh(name=name, uservert=part.shape.points.ravel(), inertia=convex)
        geom.meshname = name
    return name


def _robot_parts(robot: RobotModel, body: list[BodySphere]) -> Iterator[tuple[int, _Placed]]:
    """(joint, shape in the joint's frame) of everything that moves."""
    objects = _collision_objects(robot)
    for o in objects:
        link = robot.model.frames[o.parentFrame].name
        mesh = o.geometry if isinstance(o.geometry, coal.BVHModelBase) else None
        T = o.placement
        yield o.parentJoint, _Placed(link, _link_shape(o.geometry), T.rotation, T.translation, mesh)
    covered = {o.parentJoint for o in objects}
    points = robot.points([s.frame for s in body], np.array([s.center for s in body]))
    for sphere, joint, offset in zip(body, points.joints, points.offsets, strict=True):
        if joint != 0 and joint not in covered:
            yield int(joint), _Placed(sphere.frame, _ball(max(sphere.radius, _POINT)), np.eye(3), offset[:3])


def _collision_objects(robot: RobotModel) -> list[pin.GeometryObject]:
    """Collision geometry of the links that move; none if the meshes are missing or cannot be read."""
    try:
        return [o for o in robot.geometry(pin.GeometryType.COLLISION).geometryObjects if o.parentJoint != 0]
    except (ValueError, RuntimeError):
        return []


def _link_shape(shape: coal.CollisionGeometry) -> _Shape:
    """A box, sphere, cylinder, capsule or mesh of a URDF."""
    match shape:
        case coal.Box():
            return _Shape(mujoco.mjtGeom.mjGEOM_BOX, list(shape.halfSide))
        case coal.Sphere():
            return _ball(shape.radius)
        case coal.Cylinder():
            return _Shape(mujoco.mjtGeom.mjGEOM_CYLINDER, [shape.radius, shape.halfLength])
        case coal.Capsule():
            return _Shape(mujoco.mjtGeom.mjGEOM_CAPSULE, [shape.radius, shape.halfLength])
        case coal.ConvexBase():
            return _hull(np.array(shape.points()))
    return _hull(np.array(shape.vertices()))


def _obstacles(problem: Problem) -> Iterator[_Placed]:
    for o in problem.world.obstacles:
        match o:
            case Sphere():
                yield _Placed(o.name, _ball(o.radius), np.eye(3), np.array(o.center))
            case HalfSpace():
                normal = np.array(o.normal)
                turn = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), normal).matrix()
                plane = _Shape(mujoco.mjtGeom.mjGEOM_PLANE, _PLANE_SIZE)
                yield _Placed(o.name, plane, turn, o.offset * normal)
            case _:
                yield _Placed(o.name, _posed_shape(o), o.rotation, np.array(o.xyz))


def _posed_shape(o: Box | Capsule | Cylinder | ConvexMesh) -> _Shape:
    match o:
        case Box():
            return _Shape(mujoco.mjtGeom.mjGEOM_BOX, [0.5 * x for x in o.size])
        case Capsule():
            return _Shape(mujoco.mjtGeom.mjGEOM_CAPSULE, [o.radius, 0.5 * o.length])
        case Cylinder():
            return _Shape(mujoco.mjtGeom.mjGEOM_CYLINDER, [o.radius, 0.5 * o.length])
    return _hull(o.scale * np.array(o.vertices))


def _ball(radius: float) -> _Shape:
    return _Shape(mujoco.mjtGeom.mjGEOM_SPHERE, [radius])


def _hull(points: Array) -> _Shape:
    """The convex hull of points (N, 3), thickened to 0.2 mm along the axes in which it is thinner."""
    axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
    for axis in axes[np.ptp(points @ axes.T, axis=0) < _THIN]:
        points = np.concatenate([points - 0.5 * _THIN * axis, points + 0.5 * _THIN * axis])
    return _Shape(mujoco.mjtGeom.mjGEOM_MESH, [], points)
