"""Training settings: the paper's and the recommended ones. No setting names a robot."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any, Literal

from ppcbf_robots.filters import FilterKind, Metric
from ppcbf_robots.network import NetworkKind
from ppcbf_robots.problem import Problem

PresetName = Literal["default", "paper"]
LearnedKind = Literal["pp-ncbf", "ncbf"]


@dataclass(frozen=True)
class Preset:
    """Everything the learner can be told."""

    network: NetworkKind
    hidden: tuple[int, ...]
    filter: FilterKind  # what the critic assumes will run; it decides how the learner descends
    metric: Metric
    learning_rate: float
    gamma: float | None = None  # [1/s], where the robot spec gives none and X is small enough to be covered
    covered_joints: int = 2  # up to which it is: beyond, the spec's default gamma leaves K less to learn
    units: int = 0  # convex network: number of terms
    samples: int = 1000  # N, new band states per iteration
    epochs: int = 1  # closed form: E, gradient steps per iteration
    top: int = 100  # closed form: k of Top_k
    exit: float = 0.0  # closed form: the paper's ξ, mean of the Top_k critics without λ below which training ends
    l2: float = 0.0  # closed form: weight of the L2 penalty (mean square of the weights)
    simplicity: float = 0.0  # QP: weight of the mean square of the rate of K along the motion
    volume_weight: float = 1.0  # of the regularisation term R, eq. (16); QP: its largest, over nv
    worst_weight: float = 0.0  # QP: of the mean over violations, beside their sum over the batch
    critic_weight: float = 10.0  # closed form: initial λ of both constraints
    critic_growth: float = 1.01  # closed form: factor on λ after an iteration with violations
    critic_decay: float = 0.99  # closed form: factor on λ after one without
    critic_bounds: tuple[float, float] = (1.0, 10_000.0)  # closed form
    margin: float = 0.03  # dimensionless reserve the critics ask for in training; QP: for each joint but one
    random_goals: float = 0.0  # share of rays whose nominal torque aims at a random goal
    rays: int = 20_000
    rows_per_ray: int = 8
    iterations: int = 800  # planned; the learning rate falls to a tenth over them
    check_every: int = 50  # iterations between checks on fresh states
    patience: int = 6  # clean checks in a row, without gain of volume, that end training early
    counterexample_copies: int = 15  # closed form: how often a counterexample's ray stands in the pool
    search_rounds: int = 0  # QP: of the falsifier at every check, per joint
    judge_first: bool = False  # whether the evidence looks at the LB-CBF before training
    refinements: int = 4  # further rounds when the evidence finds violations
    refinement_share: float = 0.5  # of the planned iterations, added by each
    refinement_rate: float = 0.0  # of the learning rate, with which each begins; at least the last one
    min_volume: float = 0.2  # of the LB set; less counts as collapsed
    test_samples: int = 5_000  # uniform band states of the evidence
    attack_rounds: int = 0  # QP: of the falsifier in the evidence, for each joint but one
    changes: tuple[str, ...] = field(default=())  # departures from the paper, shown to the user


PAPER = Preset(
    network="mlp",
    hidden=(100, 100, 100),
    filter="closed-form",
    metric="torque",
    learning_rate=3e-4,
    top=200,
    l2=1e-2,
    iterations=2_000,
    changes=(
        "K is zero at rest: K = (f(q, v) - f(q, 0))^2 instead of f(q, v)^2, which lets every resting posture stay safe",
        "critics are dimensionless: torque relative to its limit, power relative to u_max . v_max",
        "the weights of the two critics adapt between 1 and 10,000 instead of staying at 100; Top_k averages k = 200",
        "learning rate 3e-4 instead of 1e-5, annealed to a tenth",
        "states on the band come from rays in v instead of rejection, which finds 1 % of them",
        "the exit looks at violations on fresh states and at the volume kept, since L < 0.01 cannot be met on the band",
    ),
)

DEFAULT = Preset(
    network="convex",
    hidden=(64, 64),
    units=12,
    filter="qp",
    metric="kinetic",
    learning_rate=3e-3,
    gamma=15.0,
    volume_weight=0.6,
    rows_per_ray=12,
    worst_weight=0.5,
    simplicity=10.0,
    random_goals=0.5,
    rays=60_000,
    iterations=500,
    check_every=40,
    margin=0.008,
    patience=8,
    search_rounds=16,
    judge_first=True,
    refinements=8,
    refinement_share=0.4,
    refinement_rate=0.2,
    test_samples=10_000,
    attack_rounds=100,
)

PRESETS: dict[PresetName, Preset] = {"paper": PAPER, "default": DEFAULT}


def with_gamma(problem: Problem, preset: Preset) -> Problem:
    """The problem with the preset's gamma, where the robot spec gives none and the robot has few joints."""
    spec = problem.robot.spec.barrier
    if preset.gamma is None or "gamma" in spec.model_fields_set or problem.model.nv > preset.covered_joints:
        return problem
    return problem.with_barrier_spec(spec.model_copy(update={"gamma": preset.gamma}))


def settings(preset: Preset) -> dict[str, Any]:
    """A preset as plain JSON data, for the training report."""
    return {k: list(x) if isinstance(x, tuple) else x for k, x in dataclasses.asdict(preset).items()}
