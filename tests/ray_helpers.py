"""Rays and fields of random states for the tests of the learner's parts, in double precision."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from ppcbf_robots.learning.rays import Field, Rays, rays_at, to_tensors
from ppcbf_robots.problem import Problem

CPU, DOUBLE = torch.device("cpu"), torch.float64


def tensors(params: dict[str, Any]) -> dict[str, torch.Tensor]:
    return {k: torch.as_tensor(x, dtype=DOUBLE) for k, x in params.items()}


def draw(problem: Problem, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Uniform states of X."""
    rng, domain = np.random.default_rng(seed), problem.robot.domain
    return problem.model.from_angles(domain.sample_q(rng, count)), domain.sample_v(rng, count)


def make_rays(problem: Problem, count: int = 200, rows: int = 1000, seed: int = 0) -> Rays:
    """Free rays in double precision, with all rows unless fewer are asked for."""
    arrays, _, free = rays_at(problem, *draw(problem, count, seed), rows)
    return Rays(**to_tensors([{k: x[free] for k, x in arrays.items()}], CPU, DOUBLE))


def make_field(problem: Problem, kind: str) -> Field:
    return Field(problem.model, kind, problem.robot.spec.barrier.gamma, CPU, DOUBLE)
