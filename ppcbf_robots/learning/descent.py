"""What every descent on a barrier's parameters has: rays, parameters, optimiser, band states and volume."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
import torch

from ppcbf_robots.errors import InputError
from ppcbf_robots.filters import FilterConfig
from ppcbf_robots.learning.band import Band
from ppcbf_robots.learning.falsifier import Attack
from ppcbf_robots.learning.parameters import CONSTANTS, Tensors, initial_parameters
from ppcbf_robots.learning.presets import LearnedKind, Preset
from ppcbf_robots.learning.rays import Rays, VolumeStates, build_pool, rays_at, to_tensors
from ppcbf_robots.problem import Problem
from ppcbf_robots.specs import Array

CHECK_STATES = 4_000
VOLUME_STATES = 20_000  # uniform states of X on which the volume is measured
LAST_RATE = 0.1  # of the learning rate, at the end of the planned iterations


class Descent(ABC):
    """One run's parameters and the states they descend on.

    Args:
        problem: robot, world and controller.
        kind: ``pp-ncbf`` trains for torque limits and passivity, ``ncbf`` for torque limits alone.
        preset: all settings.
        seed: fixes every random draw.
        device: where the loop runs.

    Raises:
        InputError: if almost no configuration of X is free of collision.
    """

    def __init__(self, problem: Problem, kind: LearnedKind, preset: Preset, seed: int, device: str) -> None:
        self.problem, self.kind, self.preset = problem, kind, preset
        self.device, self.dtype = torch.device(device), torch.float32
        generator = torch.Generator().manual_seed(seed)  # of the first parameters, equal on every device
        on_cpu = self.device.type == "cpu"
        self.generator = generator if on_cpu else torch.Generator(self.device).manual_seed(seed)
        self.rng = np.random.default_rng(seed)
        self.filter_config = FilterConfig(kind=preset.filter, metric=preset.metric)
        self.rays, self.volume = self._pool()
        params = initial_parameters(problem, preset, float(self.volume.energy.mean()), generator)
        self.params: Tensors = {k: x.to(self.device, self.dtype) for k, x in params.items()}
        self.judged: Tensors = self.params  # what checks and evidence look at
        self.trained = [k for k in self.params if k not in CONSTANTS]
        self.optimizer = torch.optim.Adam([self.params[k].requires_grad_() for k in self.trained])
        passive = kind == "pp-ncbf"
        self.band = Band(problem, preset.network, self.filter_config, passive, self.device, self.dtype)
        self.epsilon = self.band.epsilon
        self.margin = preset.margin
        self.iteration, self.planned = 0, preset.iterations
        self.first_round = self.planned  # iterations before any refinement
        self.evaluated = 0  # band states whose critics were computed in iterations
        self.ended = False  # whether the preset's exit was reached
        self.loss: float | torch.Tensor = float("nan")  # of the last step

    @property
    def refined(self) -> bool:
        """Whether the evidence has asked for more iterations than were planned at first; an early end leaves some."""
        return self.planned > self.first_round

    @abstractmethod
    def iterate(self) -> None:
        """One iteration: states on the band, a gradient step, the weights' update."""

    @abstractmethod
    def check(self) -> tuple[float, float, float]:
        """On fresh band states: share of rays that have one, of states whose torque fails, and whose passivity does."""

    @abstractmethod
    def add_counterexamples(self, q: Array, v: Array) -> None:
        """Rays through violating states (N, nq), (N, nv) join the pool."""

    @abstractmethod
    def demand_more(self) -> None:
        """What is asked for becomes stricter, since the evidence found violations."""

    @abstractmethod
    def attack(self, params: dict[str, Array], known: Attack | None) -> Attack | None:
        """A search for violating states of given parameters, with those known of others; None where there is none."""

    @abstractmethod
    def state(self) -> tuple[Tensors, dict[str, Any]]:
        """What a checkpoint must hold besides parameters, optimiser and random generators."""

    @abstractmethod
    def restore(self, tensors: Tensors, numbers: dict[str, Any]) -> None:
        """Go on from what :meth:`state` gave."""

    def _tensor(self, x: Array) -> torch.Tensor:
        return torch.as_tensor(x, device=self.device, dtype=self.dtype)

    def _pool(self) -> tuple[Rays, VolumeStates]:
        p = self.preset
        rays, volume = build_pool(self.problem, p.rays, p.rows_per_ray, p.random_goals, self.rng)
        free = sum(len(r["q"]) for r in rays)
        if free < 200:
            raise InputError(
                "almost every configuration of the domain X is in collision; shrink X or move the obstacles"
            )
        pool = Rays(**to_tensors(rays, self.device, self.dtype))
        gamma = self.problem.robot.spec.barrier.gamma
        states = {k: x[:VOLUME_STATES] for k, x in to_tensors(volume, self.device, self.dtype).items()}
        return pool.without_far_rows(gamma), VolumeStates(**states)

    def rays_through(self, q: Array, v: Array) -> Rays:
        """Rays through the states (q, v) that are free of collision."""
        arrays, _, free = rays_at(self.problem, q, v, self.rays.h.shape[1])
        return Rays(**to_tensors([{k: x[free] for k, x in arrays.items()}], self.device, self.dtype))

    def set_rate(self) -> None:
        """The learning rate falls linearly over the planned iterations, and from a lower one over a refinement's."""
        p, left = self.preset, self.planned - self.iteration
        first, later = left / self.first_round, p.refinement_rate * left / (p.refinement_share * p.iterations)
        for group in self.optimizer.param_groups:
            group["lr"] = p.learning_rate * max(LAST_RATE, later if self.refined else first)

    def sample(
        self, count: int, pool: torch.Tensor | None = None, params: Tensors | None = None, rising: bool = False
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Band states at random levels of phi on ``count`` random rays (of ``pool``): ray indices and s.

        Only those come back that cross the level, and those along which phi rises through it if asked for. The band is
        that of ``params``, by default those in training.
        """
        rays, generator, device = len(self.rays) if pool is None else len(pool), self.generator, self.device
        index = torch.randint(rays, (count,), generator=generator, device=device)  # nothing comes from the CPU
        index = index if pool is None else pool[index]
        level = self.band.level(torch.rand(count, generator=generator, device=device, dtype=self.dtype))
        found, s = self.band.field.on_band(params or self.params, self.rays.select(index), level, rising)
        return index[found], s

    @torch.no_grad()
    def volume_kept(self) -> float:
        """Volume of the safe set over that of the LB set, on uniform states of X."""
        K = self.band.field.K_of(self.judged, self.volume)
        lb = self.volume.rho >= 0.0
        return float((self.volume.rho - K >= 0.0).sum() / lb.sum().clamp(min=1))

    def snapshot(self) -> dict[str, Array]:
        """The parameters as float64 arrays."""
        return {k: x.detach().cpu().double().numpy().copy() for k, x in self.judged.items()}

    def load(self, params: dict[str, Array]) -> None:
        """Replace the parameters' values."""
        with torch.no_grad():
            for k, x in params.items():
                self.params[k].copy_(self._tensor(x))
                self.judged[k].copy_(self._tensor(x))
