"""The largest viable set of a robot with two joints, as a function of the state (found by ``viability``).

``value(q, v)`` is the least h that remains, at best, on the way from (q, v): ``max_u min_t min_k h_k(q(t))`` over all
torques in the box, for all time to come. The state is viable where it is not negative.
"""

from __future__ import annotations

import contextlib
import os
import tempfile
import zipfile
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator

from ppcbf_robots import body_cache
from ppcbf_robots.safety import SafetyFunction
from ppcbf_robots.specs import Array


@dataclass(frozen=True)
class Nodes:
    """A regular grid over angles and velocities, joint by joint: (q1, q2, v1, v2)."""

    low: Array  # (4,) [rad | m] and [rad/s | m/s]
    high: Array  # (4,) the last node, or where the first one comes again on a periodic axis
    count: tuple[int, int, int, int]
    periodic: tuple[bool, bool, bool, bool]  # joints that turn through the grid

    @property
    def axes(self) -> list[Array]:
        """The nodes along each axis."""
        four = zip(self.low, self.high, self.count, self.periodic, strict=True)
        return [np.linspace(low, high, n, endpoint=not periodic) for low, high, n, periodic in four]


@dataclass(frozen=True)
class ViableSet:
    """States from which some torque in the box keeps h >= 0 for ever, interpolated between the nodes of a grid."""

    safety: SafetyFunction
    nodes: Nodes
    loss: NDArray[np.float32]  # of nodes.count, at most 0: the value minus h [m]
    sweeps: int  # that the computation took

    @cached_property
    def _interpolator(self) -> RegularGridInterpolator:
        axes, loss = self.nodes.axes, self.loss
        for i in np.flatnonzero(self.nodes.periodic):  # the first node once more at the end
            axes[i] = np.append(axes[i], self.nodes.high[i])
            loss = np.concatenate([loss, loss.take([0], axis=i)], axis=i)
        return RegularGridInterpolator(axes, loss, bounds_error=False, fill_value=np.nan)

    def value(self, q: Array, v: Array) -> Array:
        """Least h that remains at best [m], (...), at q (..., nq) and v (..., nv): viable where it is not
        negative, NaN beyond the grid."""
        lead, robot = v.shape[:-1], self.safety.robot
        dyn = robot.evaluate_batch(q.reshape(-1, robot.nq), np.zeros((int(np.prod(lead, dtype=int)), robot.nv)))
        return self.value_from(self.safety.evaluate(dyn).h.min(-1).reshape(lead), q, v)

    def value_from(self, h: Array, q: Array, v: Array) -> Array:
        """The same where the least h (...) of every configuration is known."""
        x = np.concatenate([self.safety.robot.to_angles(q), v], axis=-1)
        turning = np.array(self.nodes.periodic)
        low, turn = self.nodes.low, self.nodes.high - self.nodes.low
        x = np.where(turning, low + (x - low) % turn, x)
        return np.asarray(h + self._interpolator(x.reshape(-1, 4)).reshape(x.shape[:-1]))


def recall(key: str, shape: tuple[int, ...]) -> tuple[NDArray[np.float32], int] | None:
    """Loss and sweeps kept under ``key``, or None if there is nothing of that shape that can be read."""
    place = _folder()
    if place is None:
        return None
    try:
        with np.load(place / f"{key}.npz", allow_pickle=False) as file:
            loss, sweeps = file["loss"], int(file["sweeps"])
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):  # zip members carry checksums
        return None
    return (loss, sweeps) if loss.shape == shape and loss.dtype == np.float32 and np.all(loss <= 0.0) else None


def keep(key: str, loss: NDArray[np.float32], sweeps: int) -> None:
    """Keep a result under ``key``; a folder that cannot be written is no error."""
    place = _folder()
    if place is None:
        return
    with contextlib.suppress(OSError):
        place.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=place, suffix=".part")
        try:
            with os.fdopen(handle, "wb") as file:
                arrays: dict[str, Any] = {"loss": loss, "sweeps": np.array(sweeps)}
                np.savez_compressed(file, **arrays)
            Path(name).replace(place / f"{key}.npz")  # whole or not at all
        except OSError:
            Path(name).unlink(missing_ok=True)


def _folder() -> Path | None:
    """The cache folder of viable sets, beside that of the bodies."""
    bodies = body_cache.folder()
    return None if bodies is None else bodies.with_name("viable")
