"""The robot as it may really be: the model with other masses, inertias, centres of mass, a payload, and dry friction.

A filter keeps the nominal model; an engine moves the perturbed one. Factors of 1 and no friction leave all as it is.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from ppcbf_robots.errors import InputError
from ppcbf_robots.robot import RobotModel
from ppcbf_robots.specs import Array, PayloadSpec


def perturbed(
    robot: RobotModel,
    mass: ArrayLike = 1.0,
    inertia: ArrayLike = 1.0,
    com: ArrayLike = 1.0,
    payload: PayloadSpec | None = None,
    friction: ArrayLike = 0.0,
) -> RobotModel:
    """A robot that moves differently, with the kinematics, limits and names of ``robot``, which stays as it is.

    A link here is what one joint moves: links fixed to it are part of it.

    Args:
        robot: the nominal robot.
        mass: factor of each link's mass, one number or (nv,).
        inertia: factor of each link's rotational inertia about its centre of mass, one number or (nv,); independent of
            ``mass``, so give both for a link of another density.
        com: factor of the vector from each joint to its link's centre of mass, one number, (nv,), or (nv, 3) for one
            factor per axis of the joint's frame.
        payload: a point mass carried on top.
        friction: Coulomb friction of each joint, one number or (nv,) [N m | N].

    Raises:
        InputError: for factors or friction that are not finite, of a wrong shape, or out of range (mass and inertia
            must be positive), and for a payload whose frame does not exist.
    """
    n = robot.nv
    masses, inertias = (_per_link(x, (n,), what) for x, what in ((mass, "mass"), (inertia, "inertia")))
    column = np.asarray(com, float)
    levers = _per_link(column[:, None] if column.ndim == 1 else column, (n, 3), "com")
    for what, values in (("mass", masses), ("inertia", inertias)):
        if not np.all(values > 0.0):
            raise InputError(f"{what}: factors must be positive, got {values.tolist()}")
    found = robot.with_model(robot.model.copy())
    found.friction = _per_link(friction, (n,), "friction")
    if not np.all(found.friction >= 0.0):
        raise InputError(f"friction: must be at least 0, got {found.friction.tolist()}")
    for i in range(n):
        Y = robot.model.inertias[i + 1]
        found.model.inertias[i + 1] = pin.Inertia(masses[i] * Y.mass, levers[i] * Y.lever, inertias[i] * Y.inertia)
    if payload is not None:
        found.add_payload(payload)
    return found


def _per_link(value: ArrayLike, shape: tuple[int, ...], what: str) -> Array:
    """The values of every link, from one number or an array that broadcasts to ``shape``."""
    try:
        values = np.array(np.broadcast_to(np.asarray(value, float), shape))
    except (TypeError, ValueError):
        raise InputError(f"{what}: expected one number or {shape[0]}, one per moving joint, got {value!r}") from None
    if not np.all(np.isfinite(values)):
        raise InputError(f"{what}: every number must be finite, got {values.tolist()}")
    return values
