"""Which joints of a URDF move: locked ones, mimics, grippers, and the limits of the others."""

from __future__ import annotations

import fnmatch
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pinocchio as pin

from ppcbf_robots.errors import InputError
from ppcbf_robots.specs import Array, PerJoint, per_joint
from ppcbf_robots.urdf_parts import JointFacts, least_eigenvalue

MAX_MOVING = 8  # joints; beyond, sampling the domain says little
GRIPPER = re.compile(r"gripper|finger|knuckle|jaw|claw", re.IGNORECASE)
HINT = {"effort": "10.0", "velocity": "2.0"}  # the examples in messages
Facts = Mapping[str, JointFacts]


def locked_joints(
    path: Path,
    model: pin.Model,
    facts: Facts,
    locked: Mapping[str, float],
    moving: Sequence[str] | None,
    warnings: list[str],
) -> dict[str, float]:
    """Position of every joint that is held [rad | m], in Pinocchio's order of joints.

    With ``moving`` all others are held. Without it mimics are, and joints at the end of the arm that a gripper's name
    gives away; both with a warning.

    Raises:
        InputError: for unknown names, none or more than eight joints left.
    """
    names = list(model.names)[1:]
    for joint in locked:
        if joint not in names:
            raise InputError(f"{path}: locked joint '{joint}' is not a moving joint (moving: {', '.join(names)})")
    if moving is not None:
        kept = _selected(path, names, moving)
        for joint in kept & locked.keys():
            raise InputError(f"{path}: joint '{joint}' is both under `moving` and under `locked`; remove it from one")
        held = {n: locked[n] if n in locked else _resting(n, facts, locked) for n in names if n not in kept}
    else:
        held = _held_by_default(model, facts, locked, warnings)
    left = [n for n in names if n not in held]
    if not left:
        raise InputError(f"{path}: no joint moves; check 'locked' and the joint types")
    if len(left) > MAX_MOVING:
        shown = ", ".join(left[:30]) + (", ..." if len(left) > 30 else "")
        raise InputError(
            f"{path}: {len(left)} joints move, at most {MAX_MOVING} can; write a robot spec with this `urdf` and "
            f"`moving: [...]` with those of one arm, the others are then locked (they are: {shown})"
        )
    return held


def _selected(path: Path, names: Sequence[str], moving: Sequence[str]) -> set[str]:
    """Joints that ``moving`` names, one by one or by a pattern such as ``left_*``."""
    kept: set[str] = set()
    for wanted in moving:
        found = {wanted} & set(names) or set(fnmatch.filter(names, wanted))
        if not found:
            raise InputError(f"{path}: moving: no joint is named '{wanted}' (joints: {', '.join(names)})")
        kept |= found
    return kept


def _held_by_default(
    model: pin.Model, facts: Facts, locked: Mapping[str, float], warnings: list[str]
) -> dict[str, float]:
    names, grippers = list(model.names)[1:], _grippers(model)
    held: dict[str, float] = {}
    for n in names:
        if n in locked:
            held[n] = locked[n]
        elif facts[n].mimic is not None:
            held[n] = _resting(n, facts, locked)
            warnings.append(f"joint '{n}' mimics another joint and was locked at {held[n]:g}")
        elif n in grippers:
            held[n] = _resting(n, facts, locked)
            warnings.append(
                f"joint '{n}' looks like a gripper's and was locked at {held[n]:g}; "
                "`moving` or `locked` in a robot spec decides otherwise"
            )
    return held


def _grippers(model: pin.Model) -> set[str]:
    """Joints named like a gripper's that carry no others; none if that is the whole robot, as with a single finger."""
    names = list(model.names)
    alike = {j for j in range(1, model.njoints) if GRIPPER.search(names[j])}
    ends = {j for j in alike if set(model.subtrees[j]) <= alike}
    return {names[j] for j in ends} if len(ends) < model.njoints - 1 else set()


def _resting(name: str, facts: Facts, locked: Mapping[str, float]) -> float:
    """Position of a joint that is held at no given one; a mimic follows its joint there."""
    seen: list[tuple[float, float]] = []
    visited = {name}
    while name not in locked:
        mimic = facts[name].mimic
        if mimic is None or mimic.joint not in facts or mimic.joint in visited:
            break
        seen.append((mimic.multiplier, mimic.offset))
        visited.add(name := mimic.joint)
    position = locked[name] if name in locked else facts[name].resting
    for multiplier, offset in reversed(seen):
        position = multiplier * position + offset
    return position


def lock(
    model: pin.Model, held: Mapping[str, float], geometries: Sequence[pin.GeometryModel] = ()
) -> tuple[pin.Model, list[pin.GeometryModel]]:
    """The model, and geometries of it, with the held joints fixed in place."""
    if not held:
        return model, list(geometries)
    ids = [model.getJointId(n) for n in held]
    model = model.copy()
    _rename_links(model, set(held), "", _TWIN)  # Pinocchio looks joints up among all frames and wants one hit
    reduced, kept = pin.buildReducedModel(model, list(geometries), ids, reference(model, held))
    _rename_links(reduced, {n + _TWIN for n in held}, _TWIN, "")
    return reduced, list(kept)


_TWIN = " (link)"


def _rename_links(model: pin.Model, names: set[str], old_end: str, new_end: str) -> None:
    for frame in model.frames:
        if frame.type == pin.FrameType.BODY and frame.name in names:
            frame.name = frame.name.removesuffix(old_end) + new_end


def reference(model: pin.Model, held: Mapping[str, float]) -> Array:
    """Configuration (nq,) of the full model with the held joints in place and the others at neutral."""
    q = pin.neutral(model)
    for name, position in held.items():
        j = model.joints[model.getJointId(name)]
        q[j.idx_q : j.idx_q + j.nq] = [np.cos(position), np.sin(position)] if j.nq == 2 else [position]
    return np.asarray(q)


def check_inertias(path: Path, model: pin.Model) -> None:
    """Refuse a moving link whose inertia, with the links fixed to it, has a negative eigenvalue.

    A small fixed link whose inertia makes no sense does no harm beside the others; several real URDFs have one.
    """
    for joint in range(1, model.njoints):
        least = least_eigenvalue(model.inertias[joint].inertia)
        if least < 0.0:
            raise InputError(
                f"{path}: the link moved by joint '{model.names[joint]}' has an inertia with the negative eigenvalue "
                f"{least:.3g}; its products of inertia are too large, correct them in the URDF"
            )


def force_limits(
    path: Path, names: Sequence[str], facts: Facts, effort: PerJoint | None, velocity: PerJoint | None
) -> tuple[Array, Array]:
    """Effort [N m | N] and velocity [rad/s | m/s] limits (nv,), the spec's before the URDF's.

    Raises:
        InputError: asking for all that is missing at once.
    """
    found, missing = [], dict[str, list[str]]()
    for what, override in (("effort", effort), ("velocity", velocity)):
        limits = np.array([getattr(facts[n], what) for n in names])
        if override is not None:
            limits = per_joint(override, names, what, default=limits)
        wrong = [(n, x) for n, x in zip(names, limits, strict=True) if not x > 0.0]
        if wrong:
            missing[what] = [n for n, _ in wrong]
            got = wrong[0][1]
        found.append(limits)
    if missing:
        joints = list(dict.fromkeys(n for listed in missing.values() for n in listed))
        remedy = " and ".join(
            f"`{what}: {{{', '.join(f'{n}: {HINT[what]}' for n in listed)}}}`" for what, listed in missing.items()
        )
        raise InputError(
            f"{path}: {_listed(joints)} no usable {' and '.join(missing)} limit (got {got:g}); "
            f"give {'one' if len(joints) == len(missing) == 1 else 'them'} in a robot spec, e.g. {remedy}, "
            "or lock the joint"
        )
    return found[0], found[1]


def rate_limits(path: Path, names: Sequence[str], rate: PerJoint | None) -> Array:
    """How fast the effort of each joint may change (nv,) [N m/s | N/s], infinite for joints not named.

    Raises:
        InputError: unless every rate is positive.
    """
    free = np.full(len(names), np.inf)
    if rate is None:
        return free
    rates = per_joint(rate, names, "effort_rate", default=free)
    wrong = [(n, x) for n, x in zip(names, rates, strict=True) if not x > 0.0]
    if wrong:
        raise InputError(f"{path}: effort_rate: joint '{wrong[0][0]}' needs a positive number, got {wrong[0][1]:g}")
    return rates


def position_limits(
    path: Path,
    names: Sequence[str],
    facts: Facts,
    override: Mapping[str, tuple[float, float]],
    warnings: list[str],
) -> tuple[Array, Array]:
    """Lower and upper position limits (nv,) [rad | m], infinite for joints that turn freely.

    Raises:
        InputError: for a prismatic joint without limits, and limits that do not fit the joint.
    """
    limits = {n: (facts[n].lower, facts[n].upper) for n in names}
    for n, pair in override.items():
        if n not in limits:
            raise InputError(f"{path}: position: no moving joint is named '{n}' (moving joints: {', '.join(names)})")
        if facts[n].kind == "continuous":
            raise InputError(f"{path}: position: joint '{n}' is continuous and has no limits; remove them")
        limits[n] = pair
    for n, (lower, upper) in limits.items():
        free = not (np.isfinite(lower) or np.isfinite(upper))
        if (free and facts[n].kind == "prismatic") or lower == upper:
            raise InputError(
                f"{path}: joint '{n}' has no position range; give one in a robot spec, "
                f"e.g. `position: {{{n}: [0.0, 0.5]}}`, or lock the joint"
            )
        if free and facts[n].kind == "revolute":
            warnings.append(f"joint '{n}' has no position limits: taken to turn freely, half a turn either way in X")
        elif facts[n].kind == "revolute" and any(8.0 * np.pi < abs(x) < np.inf for x in (lower, upper)):
            warnings.append(f"joint '{n}' turns from {lower:g} to {upper:g} rad; are these degrees?")
    return np.array([x for x, _ in limits.values()]), np.array([x for _, x in limits.values()])


def _listed(names: Sequence[str]) -> str:
    quoted = ", ".join(f"'{n}'" for n in names)
    return f"joint {quoted} has" if len(names) == 1 else f"joints {quoted} have"
