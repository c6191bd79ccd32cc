"""Barrier folders that were cut, altered or made for something else: every one must be refused in one sentence."""

from __future__ import annotations

import hashlib
import json
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors

from ppcbf_robots.artefact import load_barrier, save_barrier
from ppcbf_robots.errors import InputError
from ppcbf_robots.faults import Outcome
from ppcbf_robots.filters import FilterConfig
from ppcbf_robots.network import random_convex
from ppcbf_robots.problem import Problem, load_problem

TRAP = "trap"  # a file that the pickle below would make if anything unpickled it
WEIGHTS, FACTS = "weights.safetensors", "barrier.json"


def _cut(folder: Path) -> None:
    content = (folder / WEIGHTS).read_bytes()
    (folder / WEIGHTS).write_bytes(content[: len(content) // 2])


def _flipped(folder: Path) -> None:
    content = bytearray((folder / WEIGHTS).read_bytes())
    content[-1] ^= 1
    (folder / WEIGHTS).write_bytes(bytes(content))


def _replaced(folder: Path, weights: bytes) -> None:
    """Other weights with the hash they have, as one who forges them would do."""
    facts = json.loads((folder / FACTS).read_text(encoding="utf-8"))
    (folder / WEIGHTS).write_bytes(weights)
    facts["weights_sha256"] = hashlib.sha256(weights).hexdigest()
    (folder / FACTS).write_text(json.dumps(facts), encoding="utf-8")


def _nan(folder: Path) -> None:
    params = load_tensors((folder / WEIGHTS).read_bytes())
    _replaced(folder, save_tensors({k: np.full_like(w, np.nan) for k, w in params.items()}))


def _reshaped(folder: Path) -> None:
    params = load_tensors((folder / WEIGHTS).read_bytes())
    _replaced(folder, save_tensors({k: np.ravel(w) for k, w in params.items()}))


def _pickled(folder: Path) -> None:
    """Unpickled, this text opens a file to write."""
    _replaced(folder, f"cbuiltins\nopen\n(S'{folder / TRAP}'\nS'w'\ntR.".encode())


def _cut_facts(folder: Path) -> None:
    content = (folder / FACTS).read_text(encoding="utf-8")
    (folder / FACTS).write_text(content[: len(content) // 2], encoding="utf-8")


CASES: tuple[tuple[str, str, Callable[[Path], object]], ...] = (
    ("artefact cut", "half of the weights", _cut),
    ("artefact altered", "one bit of the weights", _flipped),
    ("artefact forged", "flat weights, with their hash", _reshaped),
    ("artefact NaN", "NaN weights, with their hash", _nan),
    ("artefact pickled", "a pickle as weights, with its hash", _pickled),
    ("artefact incomplete", "no weights", lambda folder: (folder / WEIGHTS).unlink()),
    ("artefact facts cut", "half of barrier.json", _cut_facts),
)


def artefact_outcomes(problem: Problem, folder: Path | None) -> Iterator[Outcome]:
    """What becomes of spoiled copies of a barrier folder; without one, of a folder with random weights."""
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        sound = work / "sound"
        if folder is None:
            rng, model = np.random.default_rng(0), problem.model
            params = random_convex(model.nq, model.nv, (8, 8), 2, rng)
            save_barrier(sound, problem, "pp-ncbf", "convex", params, FilterConfig(), {})
        else:
            shutil.copytree(folder, sound)
        for i, (case, injected, spoil) in enumerate(CASES):
            shutil.copytree(sound, work / str(i))
            spoil(work / str(i))
            yield _load(case, injected, work / str(i), problem)
        other = load_problem("two_link" if problem.model.nv != 2 else "panda", "sphere")
        yield _load("artefact of another", "the barrier of another robot", sound, other)


def _load(name: str, injected: str, folder: Path, problem: Problem) -> Outcome:
    """Refused as it should be, or not."""
    try:
        load_barrier(folder).barrier(problem)
        worst, reason, refused = "LOADED", "a spoiled barrier was loaded", False
    except InputError as error:
        worst, reason = "REFUSED", str(error).replace(f"{folder}/", "").replace(str(folder), folder.name)
        refused = "\n" not in reason and not (folder / TRAP).exists()
    return Outcome(name, injected, worst, reason, None, None, None, None, refused, None)
