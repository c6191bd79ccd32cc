"""Rays v = s d in velocity space: everything independent of theta, computed once with Pinocchio.

Along a ray ``b = g + s² beta(d)`` and ``vᵀ ∇²h v = s² eta(d)``, so a pool of rays gives unlimited states without
another call of Pinocchio, and bisection in s lands on any level of phi.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from ppcbf_robots.barriers import BarrierRows, rho_rows
from ppcbf_robots.learning.threads import in_threads
from ppcbf_robots.network import Along, NetworkKind, Params, energy_weight, value_along, value_and_grad
from ppcbf_robots.problem import Problem
from ppcbf_robots.robot import RobotModel
from ppcbf_robots.specs import Array

RayArrays = dict[str, Array]
CHUNK = 2000  # configurations evaluated at once, to bound memory
BISECTIONS = 8  # before the last step, which is a secant
FAR = 5.0  # [m/s], rho above which a row cannot matter


@dataclass(frozen=True)
class Rays:
    """A pool (or selection) of B rays with R near rows each; tensors on one device."""

    q: torch.Tensor  # (B, nq)
    d: torch.Tensor  # (B, nv), from the origin to the face of X's velocity box
    h: torch.Tensor  # (B, R)
    grad: torch.Tensor  # (B, R, nv)
    eta: torch.Tensor  # (B, R)
    Minv: torch.Tensor  # (B, nv, nv)
    g: torch.Tensor  # (B, nv)
    beta: torch.Tensor  # (B, nv)
    u_rest: torch.Tensor  # (B, nv)
    Md: torch.Tensor  # (B, nv)

    def __len__(self) -> int:
        return len(self.q)

    def without_far_rows(self, gamma: float) -> Rays:
        """Drop trailing rows whose phi stays far above the band on every ray, such as limits nobody comes near."""
        closest = (gamma * self.h + torch.relu(-(self.grad @ self.d[..., None])[..., 0]).neg()).amin(0)
        count = max(1, int((closest <= FAR).sum()))
        return dataclasses.replace(self, h=self.h[:, :count], grad=self.grad[:, :count], eta=self.eta[:, :count])

    def join(self, other: Rays) -> Rays:
        """Both pools as one."""
        return Rays(
            **{f.name: torch.cat([getattr(self, f.name), getattr(other, f.name)]) for f in dataclasses.fields(self)}
        )

    def select(self, index: torch.Tensor | slice) -> Rays:
        """Some of the rays."""
        return Rays(**{f.name: getattr(self, f.name)[index] for f in dataclasses.fields(self)})


@dataclass(frozen=True)
class VolumeStates:
    """Uniform states of X with h >= 0 and their least rho; phi_min there is ``rho - K``."""

    q: torch.Tensor
    v: torch.Tensor
    rho: torch.Tensor
    energy: torch.Tensor  # (B,) [J], kinetic


class Field:
    """K_theta and phi on torch states of one robot."""

    def __init__(self, model: RobotModel, kind: NetworkKind, gamma: float, device: torch.device, dtype: torch.dtype):
        self.kind, self.gamma = kind, gamma
        self._const = torch.as_tensor(model.rate_const, device=device, dtype=dtype)
        self._sign = torch.as_tensor(model.rate_sign, device=device, dtype=dtype)
        self._partner = torch.as_tensor(model.rate_partner, device=device)
        self._v_index = torch.as_tensor(model.rate_v, device=device)

    def K(self, params: Params, rays: Rays, s: torch.Tensor) -> tuple[Any, Any, Any]:
        """K (B,), ∂K/∂q · q̇ (B,), ∂K/∂v (B, nv) at v = s d."""
        v, energy = s[:, None] * rays.d, energy_weight(torch, params)
        K, K_q, K_v = value_and_grad(torch, self.kind, params, rays.q, v)
        rate = (self._const + self._sign * rays.q[..., self._partner]) * v[..., self._v_index]
        K_q_rate, Mv = (K_q * rate).sum(-1), s[:, None] * rays.Md
        work = s * s * (v * rays.beta).sum(-1)  # ½ vᵀ Ṁ v = vᵀ C v
        return K + 0.5 * energy * (v * Mv).sum(-1), K_q_rate + energy * work, K_v + energy * Mv

    def K_along(self, params: Params, rays: Rays) -> Along:
        """The function ``s -> K(q, s d)`` of all rays."""
        full = 0.5 * energy_weight(torch, params) * (rays.d * rays.Md).sum(-1)
        return value_along(torch, self.kind, params, rays.q, rays.d).plus(full)

    def K_of(self, params: Params, states: VolumeStates) -> torch.Tensor:
        """K (B,)."""
        K: torch.Tensor = value_along(torch, self.kind, params, states.q, states.v)(torch.ones_like(states.rho))
        K = K + energy_weight(torch, params) * states.energy
        return K

    def rows(self, params: Params, rays: Rays, s: torch.Tensor) -> BarrierRows:
        """All near rows at v = s d."""
        v = s[:, None] * rays.d
        K, K_q_rate, K_v = self.K(params, rays, s)
        s2 = (s * s)[:, None]
        hdot = (rays.grad @ v[..., None])[..., 0]
        return rho_rows(
            rays.h, hdot, rays.grad, s2 * rays.eta, rays.Minv, rays.g + s2 * rays.beta, self.gamma, K, K_q_rate, K_v
        )

    @torch.no_grad()
    def crosses(self, params: Params, rays: Rays, level: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Which rays start above a level (B,) of ``min_k phi_k`` and end below it, and which the other way about."""
        hdot = (rays.grad * rays.d[:, None, :]).sum(-1)
        K = self.K_along(params, rays)(torch.ones_like(level))
        ends: torch.Tensor = (hdot + self.gamma * rays.h).amin(-1) - K
        starts: torch.Tensor = self.gamma * rays.h.amin(-1)
        return (starts >= level) & (ends < level), (starts < level) & (ends >= level)

    @torch.no_grad()
    def on_band(
        self, params: Params, rays: Rays, level: torch.Tensor, rising: bool = False
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Indices (N,) of the rays that cross a level (B,) of ``min_k phi_k``, and s (N,) where, by bisection.

        They fall through it on the way out; with ``rising`` also those count that are below it at rest, closer than
        ``level / gamma``, and end above it, as where an arm leaves an obstacle.
        """
        hdot, gap = (rays.grad * rays.d[:, None, :]).sum(-1), self.gamma * rays.h
        K = self.K_along(params, rays)

        def excess(s: torch.Tensor) -> torch.Tensor:
            value: torch.Tensor = (s[:, None] * hdot + gap).amin(-1) - K(s) - level
            return value

        at_low, at_high = excess(torch.zeros_like(level)), excess(torch.ones_like(level))
        falls, rises = (at_low >= 0.0) & (at_high < 0.0), (at_low < 0.0) & (at_high >= 0.0)
        found = ((falls | rises) if rising else falls).nonzero()[:, 0]
        hdot, gap, level, K = hdot[found], gap[found], level[found], K.select(found)
        sign = torch.where(rises[found], -1.0, 1.0)
        low, high = torch.zeros_like(level), torch.ones_like(level)
        at_low, at_high = sign * at_low[found], sign * at_high[found]
        for _ in range(BISECTIONS):
            middle = 0.5 * (low + high)
            value = sign * excess(middle)
            ok = value >= 0.0
            low, at_low = torch.where(ok, middle, low), torch.where(ok, value, at_low)
            high, at_high = torch.where(ok, high, middle), torch.where(ok, at_high, value)
        return found, low + (high - low) * at_low / (at_low - at_high).clamp(min=1e-9)


def build_pool(
    problem: Problem, count: int, rows: int, random_goals: float, rng: np.random.Generator
) -> tuple[list[RayArrays], list[RayArrays]]:
    """Sample rays, and the states on which volumes are measured, uniformly in q: two lists of chunks of arrays.

    Args:
        problem: robot and world.
        count: free configurations wanted; fewer come back if X is almost all in collision.
        rows: near rows kept per ray.
        random_goals: share of rays whose nominal controller aims at a goal drawn from X instead of the problem's.
        rng: source of randomness.
    """
    rays, volume = [], []
    kept = tried = 0
    domain = problem.robot.domain
    while kept < count and (tried < 50 * CHUNK or kept > 0.002 * tried):
        angles, v = domain.sample_q(rng, CHUNK), domain.sample_v(rng, CHUNK)
        goals = np.where(
            rng.random((CHUNK, 1)) < random_goals,
            domain.sample_q(rng, CHUNK),
            problem.model.to_angles(problem.robot.goal),
        )
        q = problem.model.from_angles(angles)
        ray, rho, free = rays_at(problem, q, v, rows, goals)
        rays.append({k: x[free] for k, x in ray.items()})
        speed = (v * v).sum(-1) / (ray["d"] * ray["d"]).sum(-1)  # squared, relative to that of d
        energy = 0.5 * speed * (ray["d"] * ray["Md"]).sum(-1)
        volume.append({"q": q[free], "v": v[free], "rho": rho[free], "energy": energy[free]})
        kept, tried = kept + int(free.sum()), tried + CHUNK
    return rays, volume


def rays_at(
    problem: Problem, q: Array, v: Array, rows: int, goal_angles: Array | None = None
) -> tuple[RayArrays, Array, Array]:
    """Rays through B states (q, v), the states' least rho (B,), and whether each is free of collision (B,)."""
    goals = goal_angles
    parts = in_threads(len(v), lambda i: _rays_at(problem, q[i], v[i], rows, None if goals is None else goals[i]))
    if len(parts) == 1:
        return parts[0]
    rays = {k: np.concatenate([found[0][k] for found in parts]) for k in parts[0][0]}
    return rays, np.concatenate([found[1] for found in parts]), np.concatenate([found[2] for found in parts])


def _rays_at(
    problem: Problem, q: Array, v: Array, rows: int, goal_angles: Array | None
) -> tuple[RayArrays, Array, Array]:
    d, share = _to_face(v, problem.robot.domain.v)
    dyn = problem.model.evaluate_batch(q, d)
    near = problem.safety.nearest(dyn, problem.robot.spec.barrier.gamma, share, rows)
    rays = {
        "q": q, "d": d, "Minv": dyn.Minv, "g": dyn.g, "beta": dyn.Cv, "Md": (dyn.M @ d[..., None])[..., 0],
        "h": near.h, "eta": near.curvature, "grad": near.grad,
        "u_rest": problem.robot.controller.u_rest(q, dyn.g, goal_angles),
    }  # fmt: skip
    return rays, near.least_rho, np.asarray(near.least_h >= 0.0)


def to_tensors(parts: list[RayArrays], device: torch.device, dtype: torch.dtype) -> dict[str, torch.Tensor]:
    """Chunks of arrays as tensors by name."""
    arrays = parts[0] if len(parts) == 1 else {k: np.concatenate([p[k] for p in parts]) for k in parts[0]}
    return {k: torch.as_tensor(x, device=device, dtype=dtype) for k, x in arrays.items()}


def _to_face(v: Array, box: Array) -> tuple[Array, Array]:
    """Every v (B, nv) scaled outwards until it touches the box (nv, 2), and the share (B,) of that which v is."""
    limit = np.where(v >= 0.0, box[:, 1], box[:, 0])
    share = np.maximum(np.max(v / limit, axis=1), 1e-9)
    return v / share[:, None], share
