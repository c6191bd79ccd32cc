"""Samples of a band and attacks on it as tasks for many processes, and the conditions that they add up to."""

from __future__ import annotations

import math
import time
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ppcbf_robots.artefact import StoredBarrier, load_barrier
from ppcbf_robots.band_statistics import (
    CONDITIONS,
    BandCounts,
    clopper_pearson,
    count_violations,
    independent_band,
)
from ppcbf_robots.certificate import Condition, Verdict
from ppcbf_robots.filters import band_width
from ppcbf_robots.problem import Problem, load_problem
from ppcbf_robots.results_file import Record
from ppcbf_robots.sweep import Task

CHUNK = 2_500  # states per task
JUDGED = 2_000  # states of an attack that the filter looks at: the last ones, which the search has deepened
STATEMENTS = {
    "input_bounds": "the filter's torque lies within the limits",
    "feasibility": "a torque within the limits satisfies all rows",
    "passivity": "v·(u - u_des) <= d_p + 2e-3 u_max·v_max (closed form: 5e-4)",
}


@dataclass(frozen=True)
class BandJob:
    """What every task is told; paths and numbers alone, so that it can be sent to another process."""

    robot: str
    world: str
    folder: Path
    about: str  # SHA-256 of what the certificate is about: fixes the draws, so that no barrier was trained on them
    seed: int

    def load(self) -> tuple[Problem, StoredBarrier]:
        """The problem with the goal of the training, and its barrier."""
        stored = load_barrier(self.folder)
        problem = load_problem(self.robot, self.world)
        goal = problem.model.parse_angles(stored.data["goal"], "the goal in barrier.json")
        return problem.with_goal(goal).with_barrier_spec(stored.spec), stored

    def rng(self, *stream: int) -> np.random.Generator:
        """Random numbers of one task."""
        return np.random.default_rng([self.seed, int(self.about[:16], 16), *stream])

    def key(self, **more: Any) -> dict[str, Any]:
        """Key of a task."""
        return {"robot": self.robot, "world": self.world, "about": self.about, "seed": self.seed, **more}


def sample_tasks(job: BandJob, samples: int) -> list[Task]:
    """Tasks that draw so many independent states of the band between them."""
    sizes = [min(CHUNK, samples - first) for first in range(0, samples, CHUNK)]
    return [Task(job.key(chunk=i, states=n), partial(_sample, job, i, n)) for i, n in enumerate(sizes)]


def attack_tasks(job: BandJob, count: int, seconds: float) -> list[Task]:
    """Tasks that search for states of negative margin, each for so long and with starts of its own."""
    return [Task(job.key(attack=i, seconds=seconds), partial(_attack, job, i, seconds)) for i in range(count)]


def _sample(job: BandJob, chunk: int, count: int) -> dict[str, Any]:
    began = time.monotonic()
    problem, stored = job.load()
    barrier = stored.barrier(problem)
    config = stored.filter_config()
    width = band_width(barrier.spec, config.kind)
    q, v, tried = independent_band(problem, barrier, count, job.rng(0, chunk), width)
    counts = count_violations(problem, barrier, config, stored.kind == "pp-ncbf", q, v)
    counts.tried = tried
    return {**asdict(counts), "seconds": time.monotonic() - began}


def _attack(job: BandJob, index: int, seconds: float) -> dict[str, Any]:
    """States that the search found count only where the filter itself fails."""
    import torch  # takes seconds: only where it is needed

    from ppcbf_robots.learning.falsifier import falsify

    began = time.monotonic()
    torch.set_num_threads(1)
    problem, stored = job.load()
    barrier, config = stored.barrier(problem), stored.filter_config()
    found = falsify(problem, barrier, config, job.rng(1, index), seconds)
    counts = count_violations(problem, barrier, config, stored.kind == "pp-ncbf", found.q[-JUDGED:], found.v[-JUDGED:])
    worst = float(found.worst) if math.isfinite(found.worst) else None
    searched = {"samples": 0, "worst_margin": worst, "evaluated": found.evaluated}
    return {**asdict(counts), **searched, "seconds": time.monotonic() - began}


def conditions(
    stored: StoredBarrier, records: list[Record], confidence: float
) -> tuple[dict[str, Condition], dict[str, list[list[float]]], dict[str, Any]]:
    """Conditions, states that break them, and further figures, from the records of all tasks.

    ``seconds`` among the figures are those of all tasks together.
    """
    drawn, attacked = BandCounts(), BandCounts()
    margins, evaluated, seconds = [], 0, 0.0
    for record in records:
        result = dict(record["result"])
        seconds += result.pop("seconds")
        is_attack = "evaluated" in result
        if is_attack:
            margin, evaluated = result.pop("worst_margin"), evaluated + result.pop("evaluated")
            margins += [] if margin is None else [margin]
        (attacked if is_attack else drawn).add(BandCounts(**result))
    worst = min(margins, default=None)
    judged = "passivity" if stored.kind == "pp-ncbf" else "feasibility"  # what the attack's margin is about
    found, states = {}, {}
    for name in CONDITIONS:
        if name == "passivity" and stored.kind != "pp-ncbf":
            continue
        bad = drawn.violations[name] + attacked.violations[name]
        p = clopper_pearson(drawn.violations[name], drawn.samples, confidence)
        unclear = name == judged and worst is not None and worst < 0.0 and not any(attacked.violations.values())
        verdict: Verdict = "refuted" if bad else "undecided" if unclear else "bounded"
        said = (
            f"{STATEMENTS[name]}: on the band, violation measure <= {p:.3g} with {100 * confidence:g} % confidence"
            + (
                f"; the attack found {attacked.violations[name]} states that break it"
                if attacked.violations[name]
                else ""
            )
        )
        margin = worst if name == judged else None
        found[name] = Condition(verdict, said, p, confidence, drawn.samples, drawn.violations[name], margin)
        states[name] = drawn.states[name] + attacked.states[name]
    band = drawn.samples / drawn.tried if drawn.tried else 0.0
    details = {"band_volume": band, "states_of_X": drawn.tried, "attacked": evaluated, "seconds": seconds}
    return found, states, details
