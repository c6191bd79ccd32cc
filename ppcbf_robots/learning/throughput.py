"""How fast the learner's inner loop runs: band states per second, and how much of the machine that uses."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch.utils.flop_counter import FlopCounterMode

from ppcbf_robots.learning.presets import Preset
from ppcbf_robots.learning.train import Trainer
from ppcbf_robots.problem import Problem

WARM_UP = 20  # iterations before timing
SQUARE = 1024  # rows of the matrices whose product is the machine's limit
PRODUCTS = 10


@dataclass(frozen=True)
class Throughput:
    """The inner loop of one preset on one device."""

    preset: str
    device: str
    threads: int
    iterations_per_s: float
    states_per_s: float  # band states whose critic was evaluated
    products_per_s: float  # floating-point operations of matrix products in the loop [1/s]
    limit_per_s: float  # of products of large square float32 matrices on this device [1/s]
    pool_s: float  # drawing the pool of rays, before the loop [s]

    @property
    def share(self) -> float:
        """Of the machine's limit of matrix products."""
        return self.products_per_s / self.limit_per_s

    def as_json(self) -> dict[str, Any]:
        """Plain data."""
        return asdict(self) | {"share": self.share}


def measure_training(problem: Problem, name: str, preset: Preset, device: str, iterations: int) -> Throughput:
    """Time the iterations of a preset, from its start, without checks and evidence.

    Args:
        problem: robot and world.
        name: of the preset.
        preset: its settings.
        device: ``cpu`` or ``cuda``.
        iterations: timed.
    """
    began = time.perf_counter()
    descent = Trainer(problem, "pp-ncbf", preset, 0, device).descent
    pool = time.perf_counter() - began
    for _ in range(WARM_UP):
        descent.iterate()
    with FlopCounterMode(display=False) as counter:
        descent.iterate()
    states = descent.evaluated
    _wait(device)
    began = time.perf_counter()
    for _ in range(iterations):
        descent.iterate()
    _wait(device)
    seconds = time.perf_counter() - began
    return Throughput(
        name, device, torch.get_num_threads(), iterations / seconds, (descent.evaluated - states) / seconds,
        counter.get_total_flops() * iterations / seconds, _limit(device), pool,
    )  # fmt: skip


def _limit(device: str) -> float:
    """Operations per second of large matrix products, the best of several."""
    a = torch.randn(SQUARE, SQUARE, device=device)
    best = float("inf")
    for _ in range(PRODUCTS):
        _wait(device)
        began = time.perf_counter()
        a @ a
        _wait(device)
        best = min(best, time.perf_counter() - began)
    return 2.0 * SQUARE**3 / best


def _wait(device: str) -> None:
    if device == "cuda":
        torch.cuda.synchronize()
