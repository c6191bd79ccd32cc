"""What a plain URDF does not say, derived from the model: domain X, gains, start and goal."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ppcbf_robots.controllers import Gains
from ppcbf_robots.errors import InputError
from ppcbf_robots.holdable import holdable
from ppcbf_robots.robot import RobotModel
from ppcbf_robots.specs import Array, ControllerSpec, DomainSpec, per_joint

SAMPLES = 1000  # configurations over which gravity and inertia are bounded; with 200 rare light postures are missed
SAMPLE_SEED = 0
DAMPING_SHARE = 0.2  # of the torque left beside gravity, taken by damping at the fastest velocity of X
SPRING_SHARE = 0.09  # of what then is left, taken by the spring; with all of it hardly a torque is passive that brakes
DAMPING_RATE = 20.0  # [1/s], of the mean joint inertia, at most: light joints need no more
SPRING_TIME = 0.15  # [s], in which the spring alone may bring the mean joint inertia to full speed, at least
SPRING_RATE = 4.0  # [1/s], K_p / K_d: the rate at which a heavily damped joint closes its error
DT = 1e-3  # [s], control period the derived damping must suit
DAMPING_LIMIT = 0.7  # of λ_max(M⁻¹ K_d) dt; 1 would overshoot within one period
WIDE_TURN = np.pi  # [rad], half range given to joints without position limits
CORNERED = 0.25  # of the joints run into a bound, in states drawn so
FAST = 0.7  # of its full speed, at which such a joint moves at least, in half of these states
CLOSE = 1.5  # times |v| / gamma: the largest distance from it


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

    def sample_cornered(self, rng: np.random.Generator, count: int, gamma: float) -> tuple[Array, Array]:
        """States, angles and velocities (count, nv) each, of which some joints run into a bound of X.

        Every joint does with a probability of 1/4, so close to its bound that ``gamma h + ḣ`` is small, and in half of
        the states at 0.7 of its full speed or more; the rest is uniform. Several rows meet there more often than at
        uniform states, and torque runs short where fast ones do.
        """
        q, v = self.sample_q(rng, count), self.sample_v(rng, count)
        near = rng.random(q.shape) < CORNERED
        fast = rng.uniform(FAST, 1.0, q.shape) * np.where(v >= 0.0, self.v[:, 1], self.v[:, 0])
        v = np.where(near & (rng.random((count, 1)) < 0.5), fast, v)
        bound = np.where(v >= 0.0, self.q[:, 1], self.q[:, 0])
        close = bound - rng.uniform(0.0, CLOSE, q.shape) * v / gamma
        return np.where(near, np.clip(close, self.q[:, 0], self.q[:, 1]), q), v


def derive_domain(robot: RobotModel, spec: DomainSpec, kept: Sequence[Array] = ()) -> Domain:
    """Given bounds, else the URDF's position limits (half a turn where there are none) and ± the velocity limits.

    Derived position ranges leave out postures that the motors cannot hold, and keep the configurations ``kept`` (nv,):
    see :func:`ppcbf_robots.holdable.holdable`.
    """
    low, high = robot.q_lower, robot.q_upper
    lower = np.where(np.isfinite(low), low, np.minimum(-WIDE_TURN, high - 2.0 * WIDE_TURN))
    upper = np.where(np.isfinite(high), high, np.maximum(WIDE_TURN, low + 2.0 * WIDE_TURN))
    q, v = np.stack([lower, upper], 1), np.stack([-robot.v_max, robot.v_max], 1)
    for name, given in (("q", spec.q), ("v", spec.v)):
        if given is not None and len(given) != robot.nv:
            raise InputError(f"domain.{name}: expected {robot.nv} pairs, one per moving joint, got {len(given)}")
    q = _narrowed(robot, q, np.reshape(kept, (-1, robot.nv))) if spec.q is None else np.asarray(spec.q, float)
    v = v if spec.v is None else np.asarray(spec.v, float)
    return Domain(q, v)


def _narrowed(robot: RobotModel, q: Array, kept: Array) -> Array:
    """q (nv, 2) without the postures that cannot be held, which a warning names."""
    box = holdable(robot, q, kept)
    for i in np.flatnonzero(np.any(box != q, axis=1)):
        robot.warnings.append(
            f"X has joint '{robot.joint_names[i]}' between {box[i, 0]:.2f} and {box[i, 1]:.2f} only, instead of "
            f"{q[i, 0]:.2f} to {q[i, 1]:.2f}: beyond, gravity alone takes more than an effort limit in some postures; "
            "give the true effort, or another domain.q"
        )
    return box


def derive_gains(robot: RobotModel, spec: ControllerSpec | None, domain: Domain) -> Gains:
    """Given gains, else a well damped bounded spring that fits beside gravity in the torque box.

    Damping at the fastest velocity of X takes 0.2 of the torque beside gravity, less where ``λ_max(M⁻¹ K_d) dt`` would
    exceed 0.7 over sampled configurations, and no more than ``20/s`` of the mean joint inertia. The spring is as stiff
    as a damping ratio of 0.5 on that inertia allows. Its bound leaves room for gravity, damping and the filter, and
    suits the inertia too: whatever takes over from a stretching spring must, to be passive, take out the power that
    the spring would. The motors of a wrist, by their torque alone, would have springs of thousands of rad/s², whose
    power only the joints below could take out, while they hold the arm off a limit.
    """
    spec = spec or ControllerSpec()
    rng = np.random.default_rng(SAMPLE_SEED)
    inertia, gravity, Minvs = np.zeros(robot.nv), [], []
    for q in robot.from_angles(domain.sample_q(rng, SAMPLES)):
        dyn = robot.evaluate(q, np.zeros(robot.nv))
        inertia += np.diag(dyn.M) / SAMPLES
        gravity.append(np.abs(dyn.g))
        Minvs.append(dyn.Minv)
    g_max, too_heavy = np.max(gravity, axis=0), np.mean(gravity > robot.u_max, axis=0)
    for i in np.flatnonzero(too_heavy):
        robot.warnings.append(
            f"gravity alone takes up to {g_max[i]:.3g} of joint '{robot.joint_names[i]}', whose effort limit is "
            f"{robot.u_max[i]:.3g}, and more than that in {too_heavy[i]:.1%} of X's postures: these cannot be held, "
            "and no barrier is feasible where one rests at an obstacle; narrow domain.q, or give the true effort"
        )
    fastest = np.abs(domain.v).max(axis=1)
    room = np.maximum(robot.u_max - g_max, 0.05 * robot.u_max)
    kd = _stable_damping(np.minimum(DAMPING_SHARE * room / fastest, DAMPING_RATE * inertia), Minvs)
    names, derived = robot.joint_names, kd
    kd = kd if spec.kd is None else per_joint(spec.kd, names, "controller.kd", kd)
    damping = np.where(kd > 0.0, kd, derived)  # an undamped joint may have a spring
    kp = np.minimum(SPRING_RATE * damping, damping**2 / inertia)
    kp = kp if spec.kp is None else per_joint(spec.kp, names, "controller.kp", kp)
    f_max = SPRING_SHARE * np.maximum(robot.u_max - g_max - kd * fastest, 0.05 * robot.u_max)
    f_max = np.minimum(f_max, inertia * fastest / SPRING_TIME)
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
