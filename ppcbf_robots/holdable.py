"""The part of a box of configurations in which the motors can hold the arm against gravity."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ppcbf_robots.robot import RobotModel
from ppcbf_robots.specs import Array

SAMPLES = 20_000  # configurations looked at
SAMPLE_SEED = 0
HELD = 0.9  # of an effort limit, that gravity may take where the box has to be narrowed
LEAST_CUT = 0.02  # of the configurations left, that one cut takes away
MOST_CUT = 0.5
LEAST_VOLUME = 0.05  # of the box; less is no room to work in


def holdable(robot: RobotModel, q: Array, given: Array) -> Array:
    """The position ranges q (nv, 2), narrowed until gravity leaves a tenth of every effort limit, if it breaks one.

    Each cut moves one bound of one joint: the one that takes most of the postures that cannot be held for the volume it
    costs. Joints that turn freely are not cut, since nothing keeps them within less than a turn, and configurations
    ``given`` (K, nv) stay inside. The ranges stay as they are where every posture can be held, and where less than a
    twentieth of the volume would be left.
    """
    angles = np.random.default_rng(SAMPLE_SEED).uniform(q[:, 0], q[:, 1], (SAMPLES, robot.nv))
    load = np.max([np.abs(robot.gravity(c)) for c in robot.from_angles(angles)] / robot.u_max, axis=1)
    box, inside, bounded = q.copy(), np.ones(SAMPLES, dtype=bool), np.flatnonzero(~robot.continuous)
    if load.max() <= 1.0 or not len(bounded):
        return box
    while (heavy := load[inside] > HELD).any():
        joint, side, bound = _best_cut(angles[inside], heavy, bounded, given)
        if side < 0:
            return q.copy()
        box[joint, side] = bound
        inside = np.all((angles >= box[:, 0]) & (angles <= box[:, 1]), axis=1)
        if inside.mean() < LEAST_VOLUME:
            return q.copy()
    return box


def _best_cut(
    angles: Array, heavy: NDArray[np.bool_], joints: NDArray[np.int64], given: Array
) -> tuple[int, int, float]:
    """(joint, 0 for its lower and 1 for its upper bound, new bound) from configurations (B, nv), some too heavy.

    The side is -1 where no cut spares all that are given. What is made large is the fall of the share of heavy ones, as
    a logarithm, over that of the volume.
    """
    count = len(angles)
    removed = np.arange(max(1, int(LEAST_CUT * count)), int(MOST_CUT * count) + 1)
    share_left = (count - removed) / count
    best, cut = -np.inf, (0, -1, 0.0)
    for joint in joints:
        for side in (0, 1):
            order = np.argsort(angles[:, joint])[:: 1 - 2 * side]
            left = heavy.sum() - np.cumsum(heavy[order])[removed - 1]
            gain = np.log(np.maximum(left, 0.2) / heavy.sum() / share_left) / np.log(share_left)
            bound = angles[order[removed], joint]
            outside = given[:, joint, None] < bound if side == 0 else given[:, joint, None] > bound
            gain[outside.any(axis=0)] = -np.inf
            if gain.max() > best:
                best, at = gain.max(), int(np.argmax(gain))
                cut = int(joint), side, float(bound[at])
    return cut
