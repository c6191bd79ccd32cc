"""The band of a barrier in training: states on it, and how they fare with the filter that will run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch

from ppcbf_robots.filters import FilterConfig, band_width, free_power
from ppcbf_robots.learning.critics import Feasibility, feasibility
from ppcbf_robots.learning.rays import Field, Rays
from ppcbf_robots.network import NetworkKind, Params
from ppcbf_robots.problem import Problem

LEVELS = (0.0, 0.5, 1.0)  # of the band's width, at which a ray's least reserve is sought


@dataclass(frozen=True)
class Nominal:
    """States v = s d of B rays under the nominal controller."""

    v: torch.Tensor  # (B, nv)
    u_des: torch.Tensor  # (B, nv)
    d_p: torch.Tensor  # (B,) [W]


class Band:
    """Everything of a problem that a band state is judged by, on one device.

    Args:
        problem: robot, world and controller.
        network: form of K_theta.
        config: the runtime filter.
        passive: whether the passivity row counts.
        device, dtype: of all tensors.
    """

    def __init__(
        self, problem: Problem, network: NetworkKind, config: FilterConfig, passive: bool, device: torch.device,
        dtype: torch.dtype,
    ) -> None:  # fmt: skip
        model, spec = problem.model, problem.robot.spec.barrier
        self.field = Field(model, network, spec.gamma, device, dtype)
        self.config, self.passive, self.epsilon = config, passive, band_width(spec, config.kind)
        self.spec = spec
        self.u_max = torch.as_tensor(model.u_max, device=device, dtype=dtype)
        self.kd = torch.as_tensor(problem.robot.controller.gains.kd, device=device, dtype=dtype)
        self.free_power = free_power(model)
        self.floor = config.margin if config.kind == "qp" else 0.0  # its rows keep the state above that level

    def level(self, share: Any) -> Any:
        """The level of phi at a share of the band's width."""
        return self.floor + share * (self.epsilon - self.floor)

    def nominal(self, rays: Rays, s: torch.Tensor) -> Nominal:
        """The nominal torque at v = s d and its dissipation."""
        v = s[:, None] * rays.d
        return Nominal(v, rays.u_rest - self.kd * v, (self.kd * v * v).sum(-1))

    def feasibility(
        self, params: Params, rays: Rays, s: torch.Tensor, passive: bool | None = None, free: float = 1.0
    ) -> Feasibility:
        """The linear programs of the runtime QP's margin, with the passivity row or without.

        ``free`` is the share of the filter's free power that is made use of.
        """
        rows, nominal = self.field.rows(params, rays, s), self.nominal(rays, s)
        wanted, budget = self.passive if passive is None else passive, nominal.d_p + free * self.free_power
        return feasibility(rows, nominal.v, nominal.u_des, budget, self.u_max, self.config, wanted)

    def margin(self, params: Params, rays: Rays, s: torch.Tensor, passive: bool | None = None) -> torch.Tensor:
        """The QP's exact feasibility margin (B,), with the passivity row or without."""
        programs = self.feasibility(params, rays, s, passive)
        margin: torch.Tensor = programs.margin(programs.solve())
        return margin

    @torch.no_grad()
    def reserve(self, params: Params, rays: Rays, s: torch.Tensor) -> torch.Tensor:
        """Margin over capability (B,), see :meth:`ppcbf_robots.learning.critics.Feasibility.capability`."""
        programs = self.feasibility(params, rays, s)
        reserve: torch.Tensor = programs.margin(programs.solve()) / programs.capability()
        return reserve

    @torch.no_grad()
    def least_reserve(self, params: Params, rays: Rays) -> torch.Tensor:
        """Least reserve over the band along every ray (B,), infinite where it has none of it."""
        least = torch.full_like(rays.d[:, 0], torch.inf)
        for level in LEVELS:
            found, s = self.field.on_band(params, rays, torch.full_like(least, self.level(level)), rising=True)
            if len(found):
                least[found] = torch.minimum(least[found], self.reserve(params, rays.select(found), s))
        return least
