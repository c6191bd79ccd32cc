"""Initial parameters of K_theta, scaled to the domain X."""

from __future__ import annotations

import math

import numpy as np
import torch

from ppcbf_robots.learning.presets import Preset
from ppcbf_robots.problem import Problem
from ppcbf_robots.specs import Array

Tensors = dict[str, torch.Tensor]
# Training begins next to the LB-CBF, whose set is the largest, and K grows where margins ask for it. First a [m/s] of
# the terms that slow all motions, for robots whose X is covered by samples, and for those where more is unseen. There
# the share of the kinetic energy is as large as leaves hardly a state without a torque by itself (README, Training):
FEW_JOINTS = {"cone_a": 0.005, "bowl_a": 0.002}
MANY_JOINTS = {"cone_a": 0.005, "bowl_a": 0.005, "energy_a": 0.12}
HELD = "energy_a"  # not trained: training would give back what states yet unseen need
UNIT = -6.5  # first a of the units, before its softplus
INSIDE = {"cone_a": 0.15, "bowl_a": 0.06, "ba": 0.05, "energy_a": 0.5}  # [m/s], each a of a set well inside the largest
NOTHING = -40.0  # any a, before its softplus, of a K that is zero to rounding
CONSTANTS = ("in_shift", "in_scale", "turns", "v_scale", "energy_scale", "zero_at_rest")  # not trained


def initial_parameters(problem: Problem, preset: Preset, energy: float, generator: torch.Generator) -> Tensors:
    """Parameters for the preset's network; K starts near zero, that is, near the LB barrier.

    ``energy`` [J] is the mean kinetic energy over X; robots with few joints get no term of it.
    """
    shift, scale = _q_scaling(problem)
    v_max = torch.tensor(abs(problem.robot.domain.v).max(axis=1), dtype=torch.float64)
    if preset.network == "mlp":
        shift = torch.cat([shift, torch.zeros(problem.model.nv, dtype=torch.float64)])
        scale = torch.cat([scale, 1.0 / v_max])
    p: Tensors = {"in_shift": shift, "in_scale": scale}
    width = len(shift)
    if preset.network == "convex":
        p["turns"] = _angles(problem)
        width *= 3
    for i, units in enumerate(preset.hidden):
        p[f"W{i}"], p[f"b{i}"] = _linear(width, units, generator)
        width = units
    if preset.network == "mlp":
        p["w_out"] = _linear(width, 1, generator)[0][:, 0]
        p["b_out"] = torch.zeros((), dtype=torch.float64)
        p["zero_at_rest"] = torch.ones((), dtype=torch.float64)
        return p
    nv, units = problem.model.nv, preset.units
    p["v_scale"] = 1.0 / v_max
    mean_square = nv / 3.0  # of |v / v_max| over X
    for form, b, c in (("cone", 1.0, before_softplus(0.05)), ("bowl", math.sqrt(5.0 / mean_square), 5.0)):
        p[f"{form}_b"], p[f"{form}_c"] = torch.full((nv,), b, dtype=torch.float64), torch.tensor(c, dtype=torch.float64)
    for name, a in (MANY_JOINTS if nv > preset.covered_joints else FEW_JOINTS).items():
        p[name] = torch.tensor(before_softplus(a), dtype=torch.float64)
    if "energy_a" in p:
        p["energy_scale"] = torch.tensor(1.0 / energy, dtype=torch.float64)
    p["Wa"], p["ba"] = 0.1 * _linear(width, units, generator)[0], torch.full((units,), UNIT, dtype=torch.float64)
    p["Wc"], p["bc"] = 0.1 * _linear(width, units, generator)[0], torch.full((units,), -1.0, dtype=torch.float64)
    p["Wb"], _ = _linear(width, units * nv, generator)
    p["bb"] = torch.randn(units * nv, generator=generator, dtype=torch.float64) * 2.0
    return p


def before_softplus(a: float) -> float:
    """The x of ``a = log(1 + exp(x))``, a > 0."""
    return math.log(math.expm1(a))


def without_term(params: dict[str, Array]) -> dict[str, Array]:
    """Parameters of the same shapes with K = 0: the LB-CBF."""
    off = {name: np.full_like(x, NOTHING) for name, x in params.items() if name in INSIDE}
    flat = {name: np.zeros_like(x) for name, x in params.items() if name in ("w_out", "b_out")}
    return params | off | flat


def _angles(problem: Problem) -> torch.Tensor:
    """1 for every coordinate of q that is an angle, else 0."""
    turns = torch.zeros(problem.model.nq, dtype=torch.float64)
    turns[problem.model.idx_q[problem.model.revolute]] = 1.0
    return turns


def _linear(inputs: int, outputs: int, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    """PyTorch's default initialisation of a linear layer, stored as (inputs, outputs)."""
    bound = 1.0 / math.sqrt(inputs)
    W = (2.0 * torch.rand(inputs, outputs, generator=generator, dtype=torch.float64) - 1.0) * bound
    b = (2.0 * torch.rand(outputs, generator=generator, dtype=torch.float64) - 1.0) * bound
    return W, b


def _q_scaling(problem: Problem) -> tuple[torch.Tensor, torch.Tensor]:
    """Shift and scale that map X to about [-1, 1]; cos and sin of continuous joints stay as they are."""
    model, domain = problem.model, problem.robot.domain
    shift, scale = torch.zeros(model.nq, dtype=torch.float64), torch.ones(model.nq, dtype=torch.float64)
    for i in range(model.nv):
        if not model.continuous[i]:
            low, high = domain.q[i]
            shift[model.idx_q[i]], scale[model.idx_q[i]] = 0.5 * (low + high), 2.0 / (high - low)
    return shift, scale
