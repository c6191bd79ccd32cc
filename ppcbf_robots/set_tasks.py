"""Volumes of safe sets, and the QP at their boundaries, as tasks for many processes."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ppcbf_robots.artefact import load_barrier
from ppcbf_robots.barriers import Barrier
from ppcbf_robots.errors import InputError
from ppcbf_robots.problem import Problem, load_problem
from ppcbf_robots.safe_sets import FREE, VIABLE, BoundaryCheck, Membership, check_boundary, membership
from ppcbf_robots.sweep import Task
from ppcbf_robots.viable_set import Nodes, ViableSet

CHUNK = 5_000  # states per task
LB, PP = "LB-CBF", "PP-CBF"


@dataclass(frozen=True)
class SetsJob:
    """What every task is told, so that it can be sent to another process."""

    robot: str
    world: str
    folders: tuple[Path, ...]  # of trained barriers, whose sets have the folders' names
    viable: tuple[Nodes, NDArray[np.float32], int] | None  # of a :class:`ViableSet`
    seed: int

    def load(self) -> tuple[Problem, dict[str, Barrier]]:
        """The problem and :func:`known_barriers`."""
        problem = load_problem(self.robot, self.world)
        return problem, known_barriers(problem, self.folders)

    def key(self, about: str, **more: Any) -> dict[str, Any]:
        """Key of a task."""
        return {"robot": self.robot, "world": self.world, "about": about, "seed": self.seed, **more}

    def about(self, problem: Problem) -> str:
        """A hash of all that decides the sets: robot, world, barriers and viable set."""
        facts = [problem.fingerprint(), problem.robot.spec.barrier.model_dump(), self.viable and str(self.viable[0]),
                 [[folder.name, load_barrier(folder).digest] for folder in self.folders]]  # fmt: skip
        loss = b"" if self.viable is None else np.ascontiguousarray(self.viable[1]).tobytes()
        return hashlib.sha256(json.dumps(facts, sort_keys=True).encode() + loss).hexdigest()[:16]


def known_barriers(problem: Problem, folders: Sequence[Path]) -> dict[str, Barrier]:
    """LB-CBF, PP-CBF and, by the names of their folders, trained barriers.

    Raises:
        InputError: if a folder holds a barrier of another problem, or two have the same name.
    """
    found: dict[str, Barrier] = {LB: problem.barrier("lb-cbf"), PP: problem.barrier("pp-cbf")}
    for folder in folders:
        if folder.name in (*found, FREE, VIABLE):
            raise InputError(f"--barrier: there is another set named '{folder.name}'; rename the folder")
        found[folder.name] = load_barrier(folder).barrier(problem)
    return found


def volume_tasks(job: SetsJob, about: str, samples: int) -> list[Task]:
    """Tasks that count so many uniform states of X between them; ``Membership(**result)`` is what each found."""
    sizes = [min(CHUNK, samples - first) for first in range(0, samples, CHUNK)]
    return [Task(job.key(about, chunk=i, count=n), partial(_count, job, i, n)) for i, n in enumerate(sizes)]


def boundary_tasks(job: SetsJob, about: str, names: Sequence[str], states: int) -> list[Task]:
    """One task per set; ``BoundaryCheck(**result)`` is what each found."""
    return [Task(job.key(about, boundary=name, count=states), partial(_check, job, name, states)) for name in names]


def counted(results: Sequence[dict[str, Any]]) -> Membership:
    """What all volume tasks found."""
    parts = [Membership(tuple(r["names"]), r["samples"], np.array(r["both"])) for r in results]
    return sum(parts[1:], start=parts[0])


def _count(job: SetsJob, chunk: int, states: int) -> dict[str, Any]:
    problem, barriers = job.load()
    viable = None if job.viable is None else ViableSet(problem.safety, *job.viable)
    found = membership(problem, barriers, viable, states, np.random.default_rng([job.seed, 0, chunk]))
    return {"names": found.names, "samples": found.samples, "both": found.both.tolist()}


def _check(job: SetsJob, name: str, states: int) -> dict[str, Any]:
    problem, barriers = job.load()
    rng = np.random.default_rng([job.seed, 1, *name.encode()])
    found: BoundaryCheck = check_boundary(problem, barriers[name], states, rng)
    return {"samples": found.samples, "infeasible": found.infeasible}
