"""Fixed-base robots through Pinocchio: kinematics and dynamics at (q, v) as one immutable evaluation.

Conventions: q (nq,) is Pinocchio's configuration, where a continuous joint is stored as (cos, sin); v (nv,) is the
joint velocity [rad/s | m/s]; torque u (nv,) [N m | N]; ``M(q) a + C(q, v) v + g(q) = u``. Positions are in metres in
the base frame. Every array of an evaluation may carry a leading batch axis.
"""

from __future__ import annotations

import copy
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin

from ppcbf_robots.errors import InputError
from ppcbf_robots.joints import check_inertias, force_limits, lock, locked_joints, position_limits, rate_limits
from ppcbf_robots.kernels import mirror, points_at
from ppcbf_robots.meshes import Meshes
from ppcbf_robots.rigid_tree import RigidTree, bodies_of
from ppcbf_robots.specs import Array, PayloadSpec, PerJoint, vector
from ppcbf_robots.urdf import check_urdf

PD_RELATIVE_FLOOR = 1e-10  # least over largest eigenvalue of M below which M counts as singular


@dataclass(frozen=True)
class Dynamics:
    """Everything the method needs at one (q, v); arrays are read-only.

    J is the spatial Jacobian in the base frame at its origin, rows (linear, angular); dJ is its time derivative.
    """

    q: Array  # (..., nq)
    v: Array  # (..., nv)
    M: Array  # (..., nv, nv) mass matrix
    Minv: Array  # (..., nv, nv)
    Cv: Array  # (..., nv) Coriolis and centrifugal torque C(q, v) v
    g: Array  # (..., nv) gravity torque
    placements: Array  # (..., joints, 4, 4) of the moving joints
    J: Array  # (..., 6, nv)
    dJ: Array  # (..., 6, nv)

    @property
    def b(self) -> Array:
        """Bias torque ``C v + g``, (..., nv)."""
        return self.Cv + self.g

    @property
    def kinetic_energy(self) -> Array:
        """½ vᵀ M v [J], (...)."""
        return np.asarray(0.5 * np.einsum("...i,...ij,...j->...", self.v, self.M, self.v))


@dataclass(frozen=True)
class PointKinematics:
    """Positions of body points with first and second order terms: ṗ = J v, p̈ = J a + Jdot_v."""

    p: Array  # (..., points, 3)
    J: Array  # (..., points, 3, nv)
    Jdot_v: Array  # (..., points, 3)


class BodyPoints:
    """Points fixed to moving joints (parent joint, offset in the joint's frame [m])."""

    def __init__(self, robot: RobotModel, joints: Sequence[int], offsets: Array) -> None:
        self.joints = np.asarray(joints, dtype=np.int64)
        self.offsets = np.concatenate(
            [np.asarray(offsets, float).reshape(-1, 3), np.ones((len(self.joints), 1))], axis=1
        )
        self.mask = robot.ancestors[self.joints]  # (points, nv): which joints move which point

    def __len__(self) -> int:
        return len(self.joints)

    def kinematics(self, dyn: Dynamics) -> PointKinematics:
        """Position, Jacobian and J̇ v of every point; leading batch axes follow ``dyn``."""
        lead, nv = dyn.v.shape[:-1], dyn.v.shape[-1]
        count, points = int(np.prod(lead, dtype=int)), len(self)
        p, Jdot_v, J = np.empty((count, points, 3)), np.empty((count, points, 3)), np.empty((count, points, 3, nv))
        points_at(
            dyn.placements.reshape(count, *dyn.placements.shape[-3:]), dyn.J.reshape(count, 6, nv),
            dyn.dJ.reshape(count, 6, nv), dyn.v.reshape(count, nv), self.joints, self.offsets, self.mask, p, J, Jdot_v,
        )  # fmt: skip
        shape = (*lead, points, 3)
        return PointKinematics(p.reshape(shape), J.reshape(*shape, nv), Jdot_v.reshape(shape))


class RobotModel:
    """A fixed-base robot whose moving joints all have one degree of freedom.

    Args:
        urdf: path of the URDF.
        package_dirs: folders against which ``package://`` is resolved (meshes only; the dynamics need none).
        locked: joints held at a position, by name [rad | m].
        moving: joints that are not held, by name or pattern; None means all but mimics and grippers.
        effort: torque limits, overriding the URDF's [N m | N].
        velocity: velocity limits, overriding the URDF's [rad/s | m/s].
        position: position limits by joint, overriding the URDF's [rad | m].
        effort_rate: how fast torques may change [N m/s | N/s]; joints without one are not limited.
        payload: a point mass added to a frame.

    Raises:
        InputError: for every URDF or override the method cannot use, with the reason and the remedy.
    """

    def __init__(
        self,
        urdf: Path,
        package_dirs: Sequence[Path] = (),
        locked: Mapping[str, float] | None = None,
        effort: PerJoint | None = None,
        velocity: PerJoint | None = None,
        payload: PayloadSpec | None = None,
        moving: Sequence[str] | None = None,
        position: Mapping[str, tuple[float, float]] | None = None,
        effort_rate: PerJoint | None = None,
    ) -> None:
        self.urdf = Path(urdf)
        self.package_dirs = [Path(p) for p in package_dirs]
        facts = check_urdf(self.urdf)
        self.warnings = list(facts.warnings)
        self.name = facts.name
        self.urdf_sha256 = hashlib.sha256(self.urdf.read_bytes()).hexdigest()
        try:
            self.full_model = pin.buildModelFromXML(facts.xml)
        except (ValueError, RuntimeError) as error:
            raise InputError(f"{self.urdf}: Pinocchio cannot read it ({' '.join(str(error).split())})") from None
        if self.full_model.nv == 0:
            raise InputError(f"{self.urdf}: no joint moves; check the joint types")
        self._meshes = Meshes(self.urdf, self.package_dirs, facts.root)
        self.locked = locked_joints(self.urdf, self.full_model, facts.joints, locked or {}, moving, self.warnings)
        self.model = lock(self.full_model, self.locked)[0]
        self.joint_names = list(self.model.names)[1:]
        if payload is not None:
            self.add_payload(payload)
        self.data = self.model.createData()
        self.nq, self.nv = int(self.model.nq), int(self.model.nv)
        self.friction = np.zeros(self.nv)  # Coulomb [N m | N], of a plant alone: `evaluate` and the filter know none
        self._oMi = _strided(self.data.oMi)
        self._index_joints()
        self.tree = RigidTree(self.model)
        names = self.joint_names
        self.u_max, self.v_max = force_limits(self.urdf, names, facts.joints, effort, velocity)
        self.u_rate = rate_limits(self.urdf, names, effort_rate)
        self.q_lower, self.q_upper = position_limits(self.urdf, names, facts.joints, position or {}, self.warnings)

    def with_model(self, model: pin.Model) -> RobotModel:
        """This robot on another Pinocchio model of the same joints and frames."""
        other = copy.copy(self)
        other.model, other.data = model, model.createData()
        other._oMi = _strided(other.data.oMi)
        return other

    def add_payload(self, payload: PayloadSpec) -> None:
        """Add a point mass to a frame; InputError if there is none by that name."""
        frame = self.model.frames[self.frame_id(payload.frame)]
        if payload.mass > 0.0:
            inertia = pin.Inertia(payload.mass, np.asarray(payload.com, float), np.zeros((3, 3)))
            self.model.appendBodyToJoint(frame.parentJoint, inertia, frame.placement)

    def _index_joints(self) -> None:
        joints = list(self.model.joints)[1:]
        self.idx_q = np.array([j.idx_q for j in joints])
        self.continuous = np.array([j.nq == 2 for j in joints])
        self.revolute = np.array([j.nq == 1 and j.shortname().startswith("JointModelR") for j in joints])  # angles in q
        self._any_continuous = bool(self.continuous.any())
        # q̇ = (rate_const + rate_sign * q[rate_partner]) * v[rate_v]: 1 for scalar joints, (-sin, cos) for continuous
        self.rate_const, self.rate_sign = np.ones(self.nq), np.zeros(self.nq)
        self.rate_partner, self.rate_v = np.arange(self.nq), np.zeros(self.nq, dtype=int)
        for i, j in enumerate(joints):
            self.rate_v[j.idx_q : j.idx_q + j.nq] = i
            if j.nq == 2:
                c, s = j.idx_q, j.idx_q + 1
                self.rate_const[[c, s]] = 0.0
                self.rate_partner[[c, s]] = s, c
                self.rate_sign[[c, s]] = -1.0, 1.0
        self.ancestors = np.zeros((self.model.njoints, self.nv))
        for joint in range(1, self.model.njoints):
            for support in list(self.model.supports[joint])[1:]:
                self.ancestors[joint, self.model.joints[support].idx_v] = 1.0

    def frame_id(self, name: str) -> int:
        """Pinocchio's id of a link or frame; InputError if there is none by that name."""
        if not self.model.existFrame(name):
            bodies = [f.name for f in self.model.frames if f.type == pin.FrameType.BODY]
            raise InputError(f"{self.urdf}: no link or frame is named '{name}' (links: {', '.join(bodies[:20])})")
        if self.model.existFrame(name, pin.FrameType.BODY):  # a joint may bear the same name
            return int(self.model.getFrameId(name, pin.FrameType.BODY))
        return int(self.model.getFrameId(name))

    def points(self, frames: Sequence[str], centers: Array) -> BodyPoints:
        """Body points given in link or frame coordinates [m]."""
        joints, offsets = [], []
        for name, center in zip(frames, np.asarray(centers, float).reshape(-1, 3), strict=True):
            frame = self.model.frames[self.frame_id(name)]
            joints.append(frame.parentJoint)
            offsets.append(frame.placement.act(center))
        return BodyPoints(self, joints, np.asarray(offsets))

    def evaluate(self, q: Array, v: Array) -> Dynamics:
        """Kinematics and dynamics at one state; q (nq,), v (nv,)."""
        model, data = self.model, self.data
        pin.computeAllTerms(model, data, q, v)
        Minv = np.array(pin.computeMinverse(model, data, q))
        pin.computeJointJacobiansTimeVariation(model, data, q, v)
        M, g = data.M.copy(), data.g.copy()
        mirror(M)  # Pinocchio fills the upper triangles
        mirror(Minv)
        dyn = Dynamics(
            q=q.copy(),
            v=v.copy(),
            M=M,
            Minv=Minv,
            Cv=data.nle - g,
            g=g,
            placements=self._placements(),
            J=data.J.reshape(6, -1).copy(),  # a single joint's comes flat
            dJ=data.dJ.reshape(6, -1).copy(),
        )
        for array in vars(dyn).values():
            array.flags.writeable = False
        return dyn

    def kinematics(self, q: Array) -> tuple[Array, Array]:
        """Placements (B, joints, 4, 4) and spatial Jacobians (B, 6, nv) of configurations q (B, nq) alone."""
        placements, J = np.empty((len(q), self.model.njoints, 4, 4)), np.empty((len(q), 6, self.nv))
        for i, qi in enumerate(q):
            pin.computeJointJacobians(self.model, self.data, qi)
            placements[i] = self._placements()
            J[i] = self.data.J.reshape(6, -1)
        return placements, J

    def _placements(self) -> Array:
        """(joints, 4, 4) of ``data.oMi``, through one strided view where its memory allows: 13 µs faster."""
        out = np.zeros((self.model.njoints, 4, 4))
        out[:, 3, 3] = 1.0
        if self._oMi is None:
            out[:] = [T.homogeneous for T in self.data.oMi]
        else:
            out[:, :3] = self._oMi
        return out

    def evaluate_batch(self, q: Array, v: Array) -> Dynamics:
        """The same for a batch, compiled: q (B, nq), v (B, nv); every array gains a leading axis B."""
        bodies = np.repeat(bodies_of(self.model)[None], len(v), axis=0)
        return Dynamics(**self.tree.terms(q, v, bodies))

    def acceleration(self, q: Array, v: Array, u: Array) -> Array:
        """Forward dynamics by the articulated-body algorithm, (nv,)."""
        return np.asarray(pin.aba(self.model, self.data, q, v, u))

    def gravity(self, q: Array) -> Array:
        """g(q), (nv,) [N m | N]."""
        return np.array(pin.computeGeneralizedGravity(self.model, self.data, q))

    def potential_energy(self, q: Array) -> float:
        """Gravitational potential [J]."""
        return float(pin.computePotentialEnergy(self.model, self.data, q))

    def integrate(self, q: Array, dq: Array) -> Array:
        """q ⊕ dq on the configuration manifold."""
        return np.asarray(pin.integrate(self.model, q, dq))

    def difference(self, q0: Array, q1: Array) -> Array:
        """q1 ⊖ q0, (nv,)."""
        return np.asarray(pin.difference(self.model, q0, q1))

    def from_angles(self, angles: Array) -> Array:
        """Configuration (..., nq) from one number per moving joint (..., nv)."""
        angles = np.asarray(angles, float)
        q = np.zeros((*angles.shape[:-1], self.nq))
        scalar = ~self.continuous
        q[..., self.idx_q[scalar]] = angles[..., scalar]
        q[..., self.idx_q[self.continuous]] = np.cos(angles[..., self.continuous])
        q[..., self.idx_q[self.continuous] + 1] = np.sin(angles[..., self.continuous])
        return q

    def to_angles(self, q: Array) -> Array:
        """One number per moving joint (..., nv); continuous joints in (-π, π]."""
        angles = np.array(q[..., self.idx_q])
        if not self._any_continuous:
            return angles
        c = self.idx_q[self.continuous]
        angles[..., self.continuous] = np.arctan2(q[..., c + 1], q[..., c])
        return angles

    def q_rate(self, q: Array, v: Array) -> Array:
        """q̇ in Pinocchio's coordinates (..., nq): v for scalar joints, (-sin, cos) v for continuous ones."""
        if not self._any_continuous:
            return v
        return np.asarray((self.rate_const + self.rate_sign * q[..., self.rate_partner]) * v[..., self.rate_v])

    def parse_angles(self, values: Sequence[float], what: str) -> Array:
        """Configuration from one finite number per moving joint, or an InputError."""
        return self.from_angles(vector(values, self.nv, what))

    def geometry(self, kind: pin.GeometryType) -> pin.GeometryModel:
        """Visual or collision geometry of the reduced model; shapes without a readable mesh are left out."""
        what = "collision" if kind == pin.GeometryType.COLLISION else "visual"
        shapes, wrong = self._meshes.geometry(kind, self.full_model, self.locked)
        if wrong:
            link, problem = next(iter(wrong.items()))
            more = f", and {len(wrong) - 1} more links have such a mesh" if len(wrong) > 1 else ""
            warning = f"link '{link}' lacks {what} geometry: the mesh {problem}{more}"
            self.warnings += [] if warning in self.warnings else [warning]
        return shapes

    def check_mass_matrix(self, angles: Array) -> None:
        """Refuse a mass matrix that is not positive definite at any of ``angles`` (B, nv)."""
        check_inertias(self.urdf, self.model)
        for q in self.from_angles(angles):
            M = np.triu(pin.crba(self.model, self.data, q))
            M = M + np.triu(M, 1).T
            values, vectors = (
                np.linalg.eigh(M) if np.all(np.isfinite(M)) else (np.array([np.nan]), np.ones((self.nv, 1)))
            )
            if not values[0] > PD_RELATIVE_FLOOR * max(values[-1], 1e-6):
                joint = self.joint_names[int(np.argmax(np.abs(vectors[:, 0])))]
                raise InputError(
                    f"{self.urdf}: the mass matrix is not positive definite (least eigenvalue {values[0]:.3g}): "
                    f"the link moved by joint '{joint}' has no mass or inertia; give it one in the URDF, "
                    "or lock the joint"
                )


def _strided(placements: Sequence[pin.SE3]) -> Array | None:
    """View (joints, 3, 4) of Pinocchio's placements (rotation, translation); None if they do not lie evenly in memory.

    Valid as long as the ``pin.Data`` that owns them.
    """
    at = np.array([[x.__array_interface__["data"][0] for x in (T.rotation, T.translation)] for T in placements])
    first = placements[0].rotation
    steps = set(np.diff(at[:, 0]))
    if len(steps) != 1 or set(at[:, 1] - at[:, 0]) != {72} or first.strides != (8, 24):
        return None
    view = np.lib.stride_tricks.as_strided(first, (len(placements), 3, 4), (int(steps.pop()), 8, 24), writeable=False)
    return np.asarray(view)
