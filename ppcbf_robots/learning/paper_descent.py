"""Algorithm 1 of the paper: sample the band into a buffer, descend on (24), adapt the weights of the two critics."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from ppcbf_robots.barriers import BarrierRows
from ppcbf_robots.evidence import POWER_TOLERANCE
from ppcbf_robots.learning.critics import closed_form_critics
from ppcbf_robots.learning.descent import CHECK_STATES, Descent
from ppcbf_robots.learning.falsifier import Attack
from ppcbf_robots.learning.parameters import Tensors
from ppcbf_robots.learning.presets import LearnedKind, Preset
from ppcbf_robots.learning.rays import Rays
from ppcbf_robots.problem import Problem
from ppcbf_robots.specs import Array

MARGIN_GROWTH = 1.15  # per refinement
MAX_REFINED_MARGIN = 0.1
VIOLATED = 5e-4  # share of states with a positive critic above which its weight grows


class PaperDescent(Descent):
    """Descent on the closed form's critics; see :class:`Descent`."""

    def __init__(self, problem: Problem, kind: LearnedKind, preset: Preset, seed: int, device: str) -> None:
        super().__init__(problem, kind, preset, seed, device)
        self.weights = [preset.critic_weight, preset.critic_weight]
        self.buffer = (torch.zeros(0, dtype=torch.long, device=self.device), self._tensor(np.zeros(0)))
        self._p_ref = float(problem.model.u_max @ np.abs(problem.robot.domain.v).max(axis=1))
        self._counterexamples: list[tuple[Array, Array]] = []

    def iterate(self) -> None:
        """Sample, descend for E epochs, drop what left the band, adapt the weights."""
        p, eps = self.preset, self.epsilon
        self.set_rate()
        index, s = self.sample(p.samples)
        index, s = (torch.cat([new, old])[: 2 * p.samples] for new, old in zip((index, s), self.buffer, strict=True))
        for _ in range(p.epochs):
            if not len(index):
                break  # the band is empty: the set has collapsed, and the checks will say so
            rows, torque, passivity = self._critics(self.rays.select(index), s, self.margin)
            self.evaluated += len(index)
            phi = rows.phi.amin(-1)
            self._step(phi, torque, passivity)
            inside = ((phi >= 0.0) & (phi <= eps)).detach()
            index, s = index[inside], s[inside]
        self.buffer = (index, s)
        self.iteration += 1

    def _critics(self, rays: Rays, s: torch.Tensor, margin: float) -> tuple[BarrierRows, torch.Tensor, torch.Tensor]:
        """Rows, torque critic (B,) and passivity critic (B,), zero where ``margin`` is kept."""
        band = self.band
        rows, n = band.field.rows(self.params, rays, s), band.nominal(rays, s)
        torque, passivity = closed_form_critics(
            rows, n.v, n.u_des, n.d_p, band.u_max, self.preset.metric, margin, self._p_ref, band.spec
        )
        return rows, torque, passivity if self.kind == "pp-ncbf" else torch.zeros_like(passivity)

    def _step(self, phi: torch.Tensor, torque: torch.Tensor, passivity: torch.Tensor) -> None:
        """One gradient step on the loss (24) with R = 1 - sigmoid(phi), then the weights' update."""
        p = self.preset
        R = 1.0 - torch.sigmoid(phi)
        C, top = self.weights[0] * torque + self.weights[1] * passivity, min(p.top, len(phi))
        matrices = [w for k, w in self.params.items() if k.startswith("W")]
        l2 = sum(((w * w).mean() for w in matrices), start=torch.zeros((), device=self.device))
        loss = p.volume_weight * R.mean() + C.topk(top).values.mean() + p.l2 * l2
        self.optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        self.optimizer.step()
        self.loss = float(loss.detach())
        self.ended = bool((torque + passivity).detach().topk(top).values.mean() < p.exit)
        for j, critic in enumerate((torque, passivity)):
            violated = float((critic > 0.0).float().mean()) > VIOLATED
            factor = p.critic_growth if violated else p.critic_decay
            self.weights[j] = float(np.clip(self.weights[j] * factor, *p.critic_bounds))

    @torch.no_grad()
    def check(self) -> tuple[float, float, float]:
        """Shares of the critics above zero, without the training margin."""
        index, s = self.sample(CHECK_STATES)
        torque = passivity = 0.0
        if len(index):
            _, t, e = self._critics(self.rays.select(index), s, 0.0)
            torque, passivity = (float((x > limit).float().mean()) for x, limit in ((t, 1e-4), (e, POWER_TOLERANCE)))
        return len(index) / CHECK_STATES, torque, passivity

    def demand_more(self) -> None:
        """The margin grows."""
        self.margin = min(MAX_REFINED_MARGIN, MARGIN_GROWTH * self.margin)

    def add_counterexamples(self, q: Array, v: Array) -> None:
        """Their rays join many times over."""
        found = self.rays_through(q, v)
        copies = torch.arange(len(found), device=self.device).repeat(self.preset.counterexample_copies)
        self.rays = self.rays.join(found.select(copies))
        self._counterexamples.append((q, v))

    def attack(self, params: dict[str, Array], known: Attack | None) -> Attack | None:
        """The closed form has no margin to descend on."""
        return None

    def state(self) -> tuple[Tensors, dict[str, Any]]:
        """Buffer and counterexamples; weights and margin."""
        tensors = {"buffer/index": self.buffer[0], "buffer/s": self.buffer[1]}
        for j, states in enumerate(self._counterexamples):
            tensors |= {f"counterexamples/{j}/{k}": torch.as_tensor(x) for k, x in zip("qv", states, strict=True)}
        return tensors, {"weights": self.weights, "margin": self.margin}

    def restore(self, tensors: Tensors, numbers: dict[str, Any]) -> None:
        """See :meth:`state`."""
        self.buffer = (tensors["buffer/index"].to(self.device), tensors["buffer/s"].to(self.device))
        for j in range(sum(k.startswith("counterexamples/") for k in tensors) // 2):
            self.add_counterexamples(*(tensors[f"counterexamples/{j}/{k}"].numpy() for k in "qv"))
        self.weights, self.margin = numbers["weights"], numbers["margin"]
