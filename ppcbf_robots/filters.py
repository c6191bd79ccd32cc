"""What every filter has in common: settings, what it may answer, and the powers and speeds that count as none.

``u = u_des + δ``. The metric W decides how δ is measured: ``torque`` is the paper's W = I; ``kinetic`` is W = M⁻¹
(Gauss' principle of least constraint), whose correction ``δ = Σ λ_k w_k`` acts like contact forces and takes energy out
wherever K_theta is convex in v.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Literal, get_args

import numpy as np

from ppcbf_robots.errors import InputError
from ppcbf_robots.kernels import kernel
from ppcbf_robots.robot import RobotModel
from ppcbf_robots.specs import Array, BarrierSpec

Metric = Literal["torque", "kinetic"]
FilterKind = Literal["closed-form", "qp"]

Box = tuple[Array, Array]  # (n,) bounds of a torque, or of the dimensionless correction

FAST_SHARE = 0.5  # of the way to a bound that one control period may go, where acting late costs nothing
NEAR_REST = 5e-3  # of v_max: slower than this on every joint, an arm counts as at rest
FREE_POWER = 2e-3  # of u_max · v_max, by which a correction may exceed d_p: near rest (9) cannot hold exactly
GAMMA_PER_RATE = 2.0  # times the least rate / u_max: with more, rows were infeasible in trials


class Status(IntEnum):
    """What the filter did in one step; stored in trajectories as its number."""

    FREE = 0  # u_des passed unchanged
    CORRECTING = 1  # at least one constraint changed the torque
    RESTING = 2  # correcting while the arm stands still against an obstacle or limit
    PASSIVITY_DROPPED = 3  # rows and box hold only without the passivity row: energy may enter
    INFEASIBLE = 4  # no torque in the box satisfies all rows: the least violation was applied
    FAULT = 5  # no usable answer for a valid state: damping and gravity compensation only
    INVALID = 6  # state not usable: gravity torque of the last valid state
    STOP = 7  # state invalid for too long: engage the brakes


@dataclass(frozen=True)
class FilterConfig:
    """Settings of a filter; the defaults are the recommended runtime filter."""

    kind: FilterKind = "qp"
    metric: Metric = "kinetic"
    solver: str = "daqp"  # 15 times faster than proxqp here, and it tells infeasible problems
    alpha: float = 50.0  # [1/s], class-K gain of the QP's rows: psi >= -alpha (phi - margin)
    margin: float = 1e-3  # [m/s], phi kept above by the QP, for the control period's discretisation
    near_rows: int = 16  # rows handed to the QP; the rest are checked afterwards
    max_hold: float = 0.02  # [s], how long an invalid state is bridged before STOP
    max_age: float = 0.005  # [s], how old or how often repeated a state may be before it is invalid
    slip_time: float = 0.01  # [s], over which the slip of phi is averaged that the QP makes up for; infinite for none
    dt: float = 1e-3  # [s], control period

    @property
    def fast_alpha(self) -> float:
        """Class-K gain [1/s] of rows that act late, yet within a few control periods.

        Those of the velocity domain have it, and pairs that separate on top of ``alpha``: a damped spring between arm
        and obstacle, as ``psi >= -alpha phi`` is, would hold back a motion that leads away, and pay for it with energy.
        """
        return FAST_SHARE / self.dt

    def __post_init__(self) -> None:
        """Refuse what would disable a constraint without a word."""
        for name, allowed in (("kind", get_args(FilterKind)), ("metric", get_args(Metric))):
            if getattr(self, name) not in allowed:
                raise InputError(f"filter {name}: expected one of {', '.join(allowed)}, got '{getattr(self, name)}'")
        for name in ("alpha", "dt", "max_hold", "max_age", "near_rows"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise InputError(f"filter {name}: must be a positive number, got {getattr(self, name)}")
        if not self.slip_time > 0.0:
            raise InputError(f"filter slip_time: must be a positive number, got {self.slip_time}")
        if not (np.isfinite(self.margin) and self.margin >= 0.0):
            raise InputError(f"filter margin: must be a number of at least 0, got {self.margin}")


@dataclass(frozen=True)
class Correction:
    """A filtered torque and why it is what it is."""

    u: Array  # (nv,)
    status: Status
    reason: str
    row: int  # index of the row that decided, -1 if none
    short: float = 0.0  # [m/s²] by which phi changes less over the period than psi(u) says, K being convex in v


@kernel
def stays_slow(v: Any, Minv: Any, b: Any, u: Any, ahead: float, slow: Any) -> bool:
    """Whether every joint is slower than ``slow`` (nv,), now and so long ahead [s] under a torque u (nv,)."""
    found = True
    for i in range(len(v)):
        then = v[i]
        for j in range(len(v)):
            then += ahead * Minv[i, j] * (u[j] - b[j])
        found = found and abs(v[i]) <= slow[i] and abs(then) <= slow[i]
    return found


def acts_on(spec: BarrierSpec, h: Any, phi: Any) -> Any:
    """Which rows the closed form of a barrier with K looks at: in the band or below it, and near ones if asked for."""
    within = phi <= spec.epsilon
    return within if spec.act_within is None else within | (h <= spec.act_within)


def band_width(spec: BarrierSpec, kind: FilterKind) -> float:
    """Largest phi [m/s] of the states that a filter of this kind is trained and checked on.

    Up to there the closed form acts on rows that do not separate (:func:`acts_on`).
    """
    if kind == "qp" or spec.act_within is None:
        return spec.epsilon
    return max(spec.epsilon, spec.gamma * spec.act_within)


def free_power(robot: RobotModel) -> float:
    """Power [W] by which a correction may exceed d_p.

    As v -> 0 the left side of the paper's (9) is O(|v|) and the right side O(|v|²): there a milliwatt would be bought
    with full torque on joints that hardly move.
    """
    return FREE_POWER * float(robot.u_max @ robot.v_max)


def slowest_joint(robot: RobotModel, rate: Array) -> float:
    """Least ``rate / u_max`` of all joints [1/s], infinite where no rate is limited."""
    return float(np.min(rate / robot.u_max))


def too_fast_for_rate(robot: RobotModel, gamma: float) -> str:
    """A warning if the barrier brakes faster than torques can be built up, empty otherwise."""
    most = GAMMA_PER_RATE * slowest_joint(robot, robot.u_rate)
    if gamma <= most:
        return ""
    return f"gamma {gamma:g} is too fast for effort_rate, rows will often be infeasible: give at most {most:.2g}"
