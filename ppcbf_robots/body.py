"""Body primitives as spheres: the safety function knows points with a radius."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ppcbf_robots.errors import InputError
from ppcbf_robots.specs import BodyPrimitive, BodySphere

CAPSULE_GROWTH = 0.05  # of its radius: how much larger the spheres are that stand for a capsule
MAX_SPHERES = 200  # for one capsule
CAPSULE_SPACING = 0.01  # [m], at least this far apart, or a thin capsule would be thousands of spheres


def body_spheres(primitives: Sequence[BodyPrimitive]) -> list[BodySphere]:
    """Spheres whose union contains the primitives; a sphere stays as it is."""
    return [sphere for p in primitives for sphere in _spheres(p)]


def _spheres(p: BodyPrimitive) -> list[BodySphere]:
    """A capsule of radius r is covered by spheres of radius R, 1.05 r or more, at most ``2 sqrt(R² - r²)`` apart."""
    if p.to is None:
        return [BodySphere(frame=p.frame, center=p.center, radius=p.radius)]
    start, end = np.array(p.center), np.array(p.to)
    R = max((1.0 + CAPSULE_GROWTH) * p.radius, float(np.hypot(p.radius, 0.5 * CAPSULE_SPACING)))
    spacing = 2.0 * np.sqrt(R**2 - p.radius**2)
    length = float(np.linalg.norm(end - start))
    if length > MAX_SPHERES * spacing:
        raise InputError(
            f"body: the capsule at '{p.frame}' of {length:g} m and a radius of {p.radius:g} m would be more than "
            f"{MAX_SPHERES} spheres; lengths are metres"
        )
    count = 1 + int(np.ceil(length / spacing))
    return [
        BodySphere(frame=p.frame, center=[float(x) for x in start + s * (end - start)], radius=R)
        for s in np.linspace(0.0, 1.0, count)
    ]
