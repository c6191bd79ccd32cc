"""What a plain URDF does not say, derived from the model: domain X, gains, body spheres, start and goal."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from ppcbf_robots.controllers import Gains
from ppcbf_robots.errors import InputError
from ppcbf_robots.robot import RobotModel
from ppcbf_robots.specs import Array, BodySphere, ControllerSpec, DomainSpec, per_joint

SAMPLES = 1000  # configurations over which gravity and inertia are bounded; with 200 rare light postures are missed
SAMPLE_SEED = 0
DAMPING_SHARE = 0.5  # of the torque left beside gravity, taken by damping at the fastest velocity of X
SPRING_RATE = 4.0  # [1/s], K_p / K_d: the rate at which a heavily damped joint closes its error
DT = 1e-3  # [s], control period the derived damping must suit
DAMPING_LIMIT = 0.7  # of λ_max(M⁻¹ K_d) dt; 1 would overshoot within one period
WIDE_TURN = np.pi  # [rad], half range given to joints without position limits


class Domain:
    """The box X = {low <= (q, v) <= high}; q in angles, one per moving joint."""

    def __init__(self, q: Array, v: Array) -> None:
        self.q, self.v = q, v  # (nv, 2) each

    def sample_q(self, rng: np.random.Generator, count: int) -> Array:
        """Uniform angles (count, nv)."""
        return rng.uniform(self.q[:, 0], self.q[:, 1], (count, len(self.q)))

    def sample_v(self, rng: np.random.Generator, count: int) -> Array:
        """Uniform velocities (count, nv)."""
        return rng.uniform(self.v[:, 0], self.v[:, 1], (count, len(self.v)))


def derive_domain(robot: RobotModel, spec: DomainSpec) -> Domain:
    """Given bounds, else the URDF's position limits (half a turn where there are none) and ± the velocity limits."""
    low, high = robot.q_lower, robot.q_upper
    lower = np.where(np.isfinite(low), low, np.minimum(-WIDE_TURN, high - 2.0 * WIDE_TURN))
    upper = np.where(np.isfinite(high), high, np.maximum(WIDE_TURN, low + 2.0 * WIDE_TURN))
    q, v = np.stack([lower, upper], 1), np.stack([-robot.v_max, robot.v_max], 1)
    for name, given in (("q", spec.q), ("v", spec.v)):
        if given is not None and len(given) != robot.nv:
            raise InputError(f"domain.{name}: expected {robot.nv} pairs, one per moving joint, got {len(given)}")
    q = q if spec.q is None else np.asarray(spec.q, float)
    v = v if spec.v is None else np.asarray(spec.v, float)
    return Domain(q, v)


def derive_gains(robot: RobotModel, spec: ControllerSpec | None, domain: Domain) -> Gains:
    """Given gains, else a well damped bounded spring that fits beside gravity in the torque box.

    Damping at the fastest velocity of X takes half of the torque beside gravity, less where ``λ_max(M⁻¹ K_d) dt``
    would exceed 0.7 over sampled configurations; the spring is as stiff as a damping ratio of 0.5 on the mean joint
    inertia allows, and its bound leaves room for gravity and damping.
    """
    spec = spec or ControllerSpec()
    rng = np.random.default_rng(SAMPLE_SEED)
    inertia, g_max, Minvs = np.zeros(robot.nv), np.zeros(robot.nv), []
    for q in robot.from_angles(domain.sample_q(rng, SAMPLES)):
        dyn = robot.evaluate(q, np.zeros(robot.nv))
        inertia += np.diag(dyn.M) / SAMPLES
        g_max = np.maximum(g_max, np.abs(dyn.g))
        Minvs.append(dyn.Minv)
    for i in np.flatnonzero(g_max > robot.u_max):
        robot.warnings.append(
            f"gravity alone takes up to {g_max[i]:.3g} of joint '{robot.joint_names[i]}', whose effort limit is "
            f"{robot.u_max[i]:.3g}: such postures cannot be held; narrow domain.q"
        )
    fastest = np.abs(domain.v).max(axis=1)
    room = np.maximum(robot.u_max - g_max, 0.05 * robot.u_max)
    kd = _stable_damping(DAMPING_SHARE * room / fastest, Minvs)
    kp = np.minimum(SPRING_RATE * kd, kd**2 / inertia)
    names = robot.joint_names
    kp = kp if spec.kp is None else per_joint(spec.kp, names, "controller.kp", kp)
    kd = kd if spec.kd is None else per_joint(spec.kd, names, "controller.kd", kd)
    f_max = np.maximum(robot.u_max - g_max - kd * fastest, 0.05 * robot.u_max)
    f_max = f_max if spec.max_spring is None else per_joint(spec.max_spring, names, "controller.max_spring", f_max)
    for what, values, least in (("kp", kp, 0.0), ("kd", kd, 0.0), ("max_spring", f_max, 1e-9)):
        if np.any(values < least):
            cause = " (too little effort for gravity and damping?)" if what == "max_spring" else ""
            raise InputError(f"controller.{what}: must not be negative, got {values.tolist()}{cause}")
    fastest_mode = max(float(_damping_modes(kd, Minv)[0][-1]) for Minv in Minvs)
    if fastest_mode * DT > 1.0:
        robot.warnings.append(
            f"kd is too large for a 1 kHz loop: λ_max(M⁻¹ K_d) dt reaches {fastest_mode * DT:.2g}, must stay below 1"
        )
    return Gains(spec.type, kp, kd, f_max)


def _stable_damping(kd: Array, Minvs: list[Array]) -> Array:
    """kd (nv,), lowered joint by joint until ``λ_max(M⁻¹ K_d) dt <= 0.7`` for every given M⁻¹."""
    kd = kd.copy()
    for Minv in Minvs:
        for _ in range(100):
            values, vectors = _damping_modes(kd, Minv)
            excess = values[-1] * DT / DAMPING_LIMIT
            if excess <= 1.0:
                break
            kd *= 1.0 - vectors[:, -1] ** 2 * (1.0 - 0.95 / excess)  # those joints give way that make the mode fast
    return kd


def _damping_modes(kd: Array, Minv: Array) -> tuple[Array, Array]:
    """Rates [1/s], rising, and shares of the joints of the modes of M⁻¹ K_d, by the similar √K_d M⁻¹ √K_d."""
    root = np.sqrt(kd)
    values, vectors = np.linalg.eigh(root[:, None] * Minv * root)
    return values, vectors


def derive_body(robot: RobotModel) -> list[BodySphere]:
    """Spheres along every moving link: along the principal axis of its collision geometry, as thick as most of it.

    Links without readable geometry get spheres from their joint to the next one. Spheres that no joint moves (a first
    link turning about its own axis) are left out: nothing the controller does moves them.
    """
    vertices = _collision_vertices(robot)
    reach = sum(float(np.linalg.norm(T.translation)) for T in list(robot.model.jointPlacements)[1:])
    thickness = float(np.clip(0.06 * reach, 0.01, 0.08))
    spheres: list[BodySphere] = []
    for joint in range(1, robot.model.njoints):
        frame = _joint_frame(robot, joint)
        points = vertices.get(joint)
        segments = [_principal_segment(points)] if points is not None and len(points) > 3 else [
            (np.zeros(3), end, thickness) for end in _segment_ends(robot, joint)]  # fmt: skip
        for start, end, radius in segments:
            count = 1 + int(np.ceil(np.linalg.norm(end - start) / max(1.4 * radius, 0.02)))
            for s in np.linspace(0.0, 1.0, count):
                center = [round(float(x), 4) for x in frame.placement.actInv(start + s * (end - start))]
                spheres.append(BodySphere(frame=frame.name, center=center, radius=round(radius, 4)))
    return _without_still_ones(robot, spheres)


def _principal_segment(points: Array) -> tuple[Array, Array, float]:
    """Segment and radius of the capsule along the points' principal axis that holds 90 % of their cross-section."""
    mean = points.mean(axis=0)
    axis = np.linalg.svd(points - mean, full_matrices=False)[2][0]
    along = (points - mean) @ axis
    off = points - mean - along[:, None] * axis
    middle = (off.max(axis=0) + off.min(axis=0)) / 2.0
    radius = float(np.percentile(np.linalg.norm(off - middle, axis=1), 90))
    radius = max(radius, 0.005)
    low, high = float(along.min()) + radius, float(along.max()) - radius
    if high < low:
        low = high = 0.5 * (low + high)
    return mean + middle + low * axis, mean + middle + high * axis, radius


def _joint_frame(robot: RobotModel, joint: int) -> pin.Frame:
    bodies = [f for f in robot.model.frames if f.parentJoint == joint and f.type == pin.FrameType.BODY]
    return bodies[0] if bodies else robot.model.frames[robot.model.getFrameId(robot.model.names[joint])]


def _segment_ends(robot: RobotModel, joint: int) -> list[Array]:
    """Where the link leads to, in the joint's frame: its child joints, else its farthest frame or centre of mass."""
    model = robot.model
    children = [model.jointPlacements[c].translation for c in range(1, model.njoints) if model.parents[c] == joint]
    if children:
        return [np.array(c) for c in children]
    ends = [np.array(f.placement.translation) for f in model.frames if f.parentJoint == joint]
    ends.append(np.array(model.inertias[joint].lever))
    return [max(ends, key=lambda e: float(np.linalg.norm(e)))]


def _collision_vertices(robot: RobotModel) -> dict[int, Array]:
    """Vertices of the collision geometry per joint, in the joint's frame; empty where none can be read."""
    try:
        geometry = robot.geometry(pin.GeometryType.COLLISION)
    except (ValueError, RuntimeError):
        return {}
    found: dict[int, list[Array]] = {}
    for shape in geometry.geometryObjects:
        points = _shape_vertices(shape)
        placed = points @ shape.placement.rotation.T + shape.placement.translation
        found.setdefault(int(shape.parentJoint), []).append(placed)
    return {joint: np.concatenate(parts) for joint, parts in found.items()}


def _shape_vertices(shape: pin.GeometryObject) -> Array:
    if hasattr(shape.geometry, "vertices") and callable(shape.geometry.vertices):
        return np.asarray(shape.geometry.vertices())  # already scaled by meshScale
    shape.geometry.computeLocalAABB()
    box = shape.geometry.aabb_local
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    low: Array = np.asarray(box.min_)
    return low + corners * (np.asarray(box.max_) - low)


def _without_still_ones(robot: RobotModel, spheres: list[BodySphere]) -> list[BodySphere]:
    points = robot.points([s.frame for s in spheres], np.array([s.center for s in spheres]))
    rng = np.random.default_rng(SAMPLE_SEED)
    motion = np.zeros(len(spheres))
    for angles in rng.uniform(-1.0, 1.0, (20, robot.nv)):
        J = points.kinematics(robot.evaluate(robot.from_angles(angles), np.zeros(robot.nv))).J
        motion = np.maximum(motion, np.abs(J).max(axis=(1, 2)))
    moving = [s for s, m in zip(spheres, motion, strict=True) if m > 1e-3]
    return moving or spheres
