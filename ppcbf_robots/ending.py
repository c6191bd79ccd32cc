"""How a run ends: at its goal, held at rest by rows of the safety function, at rest without them, or in motion.

At rest the controller's spring pulls with ``-∂P/∂q``, and the filter's correction takes it up. If that correction is a
sum of the rows' own forces, ``Σ λ_k ∇h_k`` with ``λ_k >= 0``, the storage V has a constrained minimum there (to first
order): any way on needs energy, which a passive filter does not add.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from scipy.optimize import nnls

from ppcbf_robots.robot import RobotModel
from ppcbf_robots.safety import SafetyFunction, SafetyRows
from ppcbf_robots.specs import Array

GOAL_TOLERANCE = 0.05  # [rad | m]
WINDOW = 1.0  # [s] at the end of a run, over which rest and progress are judged
STILL = 1e-3  # [rad/s | m/s]; a joint that strays by no more over the window is at rest
CLOSE = 5e-3  # [m | rad], h above which a row carries no load
NO_LOAD = 1e-3  # of the largest torque share, below which a correction or a row's part in it does not count
BALANCED = 0.1  # share of the correction that the rows' forces may leave over at a constrained minimum

State = Literal["goal", "held", "stalled", "moving"]


@dataclass(frozen=True)
class Ending:
    """The last second of a run; what is stored in a trajectory and printed by ``ppcbf simulate --json``."""

    state: State
    goal_error: float  # largest joint error [rad | m]
    reached_at: float | None = None  # [s], since when the goal error is below GOAL_TOLERANCE
    held_by: Mapping[str, float | None] = field(default_factory=dict)  # row to load λ [N | N m], the largest first
    constrained_minimum: bool = False  # whether these loads balance the spring
    at_limit: Sequence[str] = field(default_factory=list)  # joints at their torque limit
    touches: Sequence[str] = field(default_factory=list)  # "link / obstacle" in contact, if the engine knows any
    fastest: str = ""  # joint
    unit: str = ""  # of that joint, rad or m
    speed: float = 0.0  # its mean over the window [rad/s | m/s]
    approach: float = 0.0  # by which goal_error falls [rad/s | m/s]
    power: float = 0.0  # by which V falls [W]

    @property
    def remaining(self) -> float | None:
        """Seconds to the goal at the present rate; None if it does not come closer."""
        left = self.goal_error - GOAL_TOLERANCE
        return left / self.approach if self.state == "moving" and self.approach > STILL else None

    def text(self) -> str:
        """The statement for the user."""
        error = f"largest joint error {self.goal_error:.2g}"
        if self.state == "goal":
            return f"goal reached at {self.reached_at:.2f} s ({error})"
        if self.state == "moving":
            return self._motion(error)
        rows = ", ".join(f"{row}{'' if load is None else f' (load {load:.2g})'}" for row, load in self.held_by.items())
        if self.constrained_minimum:
            return (
                f"at rest, goal not reached ({error}): rests against {rows}. The storage V has a constrained minimum "
                "there, and a passive filter cannot climb out of it. Give another start or goal, or a via point: a "
                "goal on the way, from which this one is free"
            )
        if self.state == "held":
            return (
                f"at rest, goal not reached ({error}): held by {rows}, though V has no constrained minimum there. "
                "The kinetic metric would slide along it"
            )
        causes = [f"joints at their torque limit: {', '.join(self.at_limit)}"] if self.at_limit else []
        causes += [f"in contact: {', '.join(self.touches)}"] if self.touches else []
        cause = "; ".join(causes) or "it is an equilibrium of the controller itself"
        return f"at rest, goal not reached ({error}), and no row of the filter holds it: {cause}"

    def _motion(self, error: str) -> str:
        along = "".join(f" along {row}" for row in self.held_by)
        along += f" in contact with {', '.join(self.touches)}" if self.touches else ""
        way = (
            "towards"
            if self.approach > STILL
            else "away from"
            if self.approach < -STILL
            else "neither towards nor from"
        )
        text = f"still moving{along}, {way} the goal ({error}), {self.fastest} at {self.speed:.2g} {self.unit}/s; "
        if self.power <= 0.0:
            return text + "V does not fall, so it would not come to rest"
        if self.remaining is None:
            return text + f"V falls at {self.power:.2g} W: run longer (--duration)"
        seconds = max(self.remaining, 1.0)
        return text + f"V falls at {self.power:.2g} W: run {seconds:.0f} s longer (--duration) at this rate"


def judge(
    run: Mapping[str, Array], goal: Array, safety: SafetyFunction, deciding: str, touches: Sequence[str]
) -> Ending:
    """How a run ended.

    Args:
        run: its record, one row per control step: t, q, v, u, u_des and V as in a trajectory.
        goal: (nq,).
        safety: the safety function of the run.
        deciding: row that decided the last correction, "" if none.
        touches: contacts of the last state.
    """
    model, t, q = safety.robot, run["t"], run["q"]
    errors = _largest_difference(model, q, goal)
    error = float(errors[-1])
    if error < GOAL_TOLERANCE:
        outside = np.flatnonzero(errors >= GOAL_TOLERANCE)
        return Ending("goal", error, float(t[outside[-1] + 1] if len(outside) else t[0]))
    first = int(np.searchsorted(t, t[-1] - WINDOW - 1e-9))
    span = max(float(t[-1] - t[first]), 1e-9)
    strayed = float(_largest_difference(model, q[first:], q[-1]).max())
    if strayed > STILL * span or len(t) == 1:
        speeds = np.abs(run["v"][first:]).mean(axis=0)
        joint = int(speeds.argmax())
        unit = "m" if model.model.joints[joint + 1].shortname().startswith("JointModelP") else "rad"  # prismatic
        approach, power = (float(x[first] - x[-1]) / span for x in (errors, run["V"]))
        along, name, speed = {deciding: None} if deciding else {}, model.joint_names[joint], float(speeds[joint])
        return Ending("moving", error, None, along, touches=touches, fastest=name, unit=unit, speed=speed,
                      approach=approach, power=power)  # fmt: skip
    delta, u_max = run["u"][-1] - run["u_des"][-1], model.u_max
    loads = bearing_rows(safety.evaluate(model.evaluate(q[-1], np.zeros(model.nv))), delta / u_max, u_max)
    if loads:
        named = {safety.names[k]: load for k, load in loads}
        return Ending("held", error, None, named, True, touches=touches)
    at_limit = [model.joint_names[i] for i in np.flatnonzero(np.abs(run["u"][-1]) >= (1.0 - NO_LOAD) * u_max)]
    if deciding and np.abs(delta / u_max).max() > NO_LOAD:
        return Ending("held", error, None, {deciding: None}, at_limit=at_limit, touches=touches)
    return Ending("stalled", error, at_limit=at_limit, touches=touches)


def _largest_difference(model: RobotModel, q: Array, other: Array) -> Array:
    """Largest joint difference (T,) of configurations (T, nq) to another one (nq,)."""
    apart = model.to_angles(q) - model.to_angles(other)
    turned = (apart + np.pi) % (2.0 * np.pi) - np.pi
    return np.asarray(np.abs(np.where(model.continuous, turned, apart)).max(axis=1))


def bearing_rows(rows: SafetyRows, share: Array, u_max: Array) -> list[tuple[int, float]]:
    """Rows k and loads λ_k with ``delta = Σ λ_k ∇h_k``, the largest first; empty if no such loads balance it.

    share (nv,): the correction at rest in units of u_max.
    """
    near = np.flatnonzero(rows.h < CLOSE)
    size = float(np.linalg.norm(share))
    if size <= NO_LOAD or not len(near):
        return []
    forces = (rows.grad[near] / u_max).T
    loads, left_over = nnls(forces, share)
    if left_over > BALANCED * size:
        return []
    part = loads * np.linalg.norm(forces, axis=0)
    return [(int(near[i]), float(loads[i])) for i in np.argsort(-part) if part[i] > NO_LOAD * part.max()]
