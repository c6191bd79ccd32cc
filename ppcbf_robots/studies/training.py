"""One training as a task of a sweep."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from ppcbf_robots.artefact import StoredBarrier, load_barrier
from ppcbf_robots.errors import InputError
from ppcbf_robots.learning.presets import Preset, PresetName, with_gamma
from ppcbf_robots.problem import Problem, load_problem
from ppcbf_robots.results_file import Record
from ppcbf_robots.sweep import Task

KIND: Final = "pp-ncbf"


def barriers_of(records: Sequence[Record], folders: Sequence[Path]) -> list[StoredBarrier]:
    """The barriers of the records with results, from the folders of all.

    Raises:
        InputError: if a folder holds the barrier of another training, as when another sweep has written there since.
    """
    barriers = []
    for record, folder in zip(records, folders, strict=True):
        if "result" in record:
            barriers.append(load_barrier(folder))
            found, expected = barriers[-1].data["training"], record["result"]
            if (found["steps"], found["seconds"]) != (expected["steps"], round(expected["seconds"], 2)):
                raise InputError(f"{folder}: holds the barrier of another training than the results say; "
                                 "give another --out")  # fmt: skip
    return barriers


@dataclass(frozen=True)
class Training:
    """How to train a PP-NCBF for a robot in a world; small and picklable, so that any worker can do it."""

    robot: str  # names or absolute paths, as the worker may run in another folder
    world: str
    preset_name: PresetName
    preset: Preset
    seed: int
    time_limit: float  # [s]
    folder: Path | None = None  # absolute; where to write the barrier, if it is wanted

    def task(self, problem: Problem) -> Task:
        """The task of a sweep; its key holds all that the outcome depends on: robot, world and preset as a hash."""
        robot = problem.robot
        facts = [problem.fingerprint(), robot.start.tolist(), robot.start_velocity.tolist(), robot.goal.tolist(),
                 with_gamma(problem, self.preset).robot.spec.barrier.model_dump(),
                 dataclasses.asdict(self.preset)]  # fmt: skip
        key = {
            "robot": self.robot,
            "world": self.world,
            "preset": self.preset_name,
            "learning_rate": self.preset.learning_rate,
            "iterations": self.preset.iterations,
            "exit": self.preset.exit,
            "seed": self.seed,
            "time_limit": self.time_limit,
            "folder": self.folder and self.folder.name,
            "identity": hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:16],
        }
        return Task(key, self.run)

    def run(self) -> dict[str, Any]:
        """Train with one thread, write the barrier if it is wanted, and report as JSON."""
        import torch  # in the worker alone

        from ppcbf_robots.learning.store import store
        from ppcbf_robots.learning.threads import use_threads
        from ppcbf_robots.learning.train import Trainer

        torch.set_num_threads(1)
        use_threads(1)
        trainer = Trainer(load_problem(self.robot, self.world), KIND, self.preset, self.seed, "cpu")
        result = trainer.run(time_limit=self.time_limit)
        report = {
            "converged": result.converged,
            "reason": result.reason,
            "volume_kept": result.volume_kept,
            "violations": result.check.violations,
            "samples": result.check.samples,
            "steps": result.steps,
            "ended": result.ended,
            "seconds": result.seconds,
            "history": [
                {
                    "iteration": m.iteration,
                    "loss": m.loss if math.isfinite(m.loss) else None,
                    "volume_kept": m.volume_kept,
                    "torque": m.torque,
                    "passivity": m.passivity,
                    "clean": m.clean,
                }
                for m in result.history
            ],
        }
        if self.folder is not None:
            facts = {"preset": self.preset_name, "seed": self.seed, "device": "cpu", "kind": KIND,
                     "iterations": self.preset.iterations}  # fmt: skip
            store(trainer, result, self.folder, facts)
        return report
