"""Checkpoints of a training run: everything needed to go on, in safetensors (no pickle)."""

from __future__ import annotations

import dataclasses
import json
import time
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from ppcbf_robots.errors import InputError
from ppcbf_robots.evidence import BandCheck
from ppcbf_robots.learning.falsifier import Attack
from ppcbf_robots.learning.train import Monitor, Tested, Trainer

FILE = "checkpoint.safetensors"
FORMAT = 4  # of the file; one of another format belongs to another version
AGAIN = "train from the start without --resume"


def save_checkpoint(trainer: Trainer, folder: Path) -> None:
    """Write the checkpoint of a trainer into a folder, replacing the last one."""
    descent = trainer.descent
    tensors = {f"param/{k}": x for k, x in descent.params.items()}
    for k, name in enumerate(descent.trained):
        for key, x in descent.optimizer.state_dict()["state"].get(k, {}).items():
            tensors[f"adam/{name}/{key}"] = x
    tensors["generator"] = descent.generator.get_state()
    own, numbers = descent.state()
    tensors |= {f"descent/{k}": x for k, x in own.items()}
    for j, (volume, params) in enumerate(trainer.clean):
        tensors |= {f"clean/{j}/{k}": torch.as_tensor(x) for k, x in params.items()}
        tensors[f"clean/{j}/volume"] = torch.tensor(volume)
    best = trainer.best
    if best is not None:
        tensors |= {f"best/params/{k}": torch.as_tensor(x) for k, x in best.params.items()}
    if best is not None and best.attack is not None:
        tensors |= {"best/q": torch.as_tensor(best.attack.q), "best/v": torch.as_tensor(best.attack.v)}
    state = {
        "format": FORMAT,
        "identity": trainer.identity(),
        "iteration": descent.iteration,
        "planned": descent.planned,
        "descent": numbers,
        "rng": descent.rng.bit_generator.state,
        "round": trainer.round,
        "gained": trainer.gained,
        "seconds": time.monotonic() - trainer.started,
        "best": None if best is None else _numbers_of(best),
        "history": [dataclasses.asdict(monitor) for monitor in trainer.history],
    }
    tensors = {k: x.detach().cpu().contiguous().clone() for k, x in tensors.items()}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        save_file(tensors, folder / f".{FILE}.tmp", metadata={"state": json.dumps(state)})
        (folder / f".{FILE}.tmp").replace(folder / FILE)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror})") from None


def load_checkpoint(trainer: Trainer, folder: Path) -> None:
    """Continue from a folder's checkpoint.

    Raises:
        InputError: if there is none, or it belongs to another version, problem, preset, seed or device.
    """
    path = folder / FILE
    if not path.is_file():
        raise InputError(f"nothing to resume: {path} does not exist")
    try:
        with safe_open(path, "pt") as file:
            state = json.loads(file.metadata()["state"])
            tensors = {k: file.get_tensor(k) for k in file.keys()}  # noqa: SIM118 - not a dict
    except (SafetensorError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: not a checkpoint ({error}); {AGAIN}") from None
    if not isinstance(state, dict) or state.get("format") != FORMAT:
        raise InputError(f"{path}: a checkpoint of another version; {AGAIN}")
    if state["identity"] != trainer.identity():
        raise InputError(
            f"{path}: belongs to another robot, world, preset, barrier, seed or device; resume with the same options"
        )
    descent = trainer.descent
    if any(getattr(tensors.get(f"param/{k}"), "shape", None) != x.shape for k, x in descent.params.items()):
        raise InputError(f"{path}: a checkpoint of another version, its network has another form; {AGAIN}")
    for k in descent.trained:
        with torch.no_grad():
            descent.params[k].copy_(tensors[f"param/{k}"])
    adam = descent.optimizer.state_dict()
    for i, name in enumerate(descent.trained):
        found = _below(tensors, f"adam/{name}/")
        if found:
            adam["state"][i] = found
    descent.optimizer.load_state_dict(adam)
    descent.restore(_below(tensors, "descent/"), state["descent"])
    descent.generator.set_state(tensors["generator"])
    trainer.clean = []
    while clean := _below(tensors, f"clean/{len(trainer.clean)}/"):
        volume = float(clean.pop("volume"))
        trainer.clean.append((volume, {k: x.numpy() for k, x in clean.items()}))
    descent.iteration, descent.planned = state["iteration"], state["planned"]
    descent.rng.bit_generator.state = state["rng"]
    trainer.history = [Monitor(**monitor) for monitor in state["history"]]
    trainer.round, trainer.gained = state["round"], state["gained"]
    trainer.started = time.monotonic() - state["seconds"]
    trainer.best = None if state["best"] is None else _tested(state["best"], _below(tensors, "best/"))


def _numbers_of(best: Tested) -> dict[str, Any]:
    """What is known of the best barrier so far; its violating states have joined the rays."""
    check, attack = best.check, best.attack
    return {
        "volume_kept": best.volume_kept,
        "check": [check.samples, check.violations, check.tried],
        "attack": None if attack is None else [attack.worst, attack.evaluated],
    }


def _tested(numbers: dict[str, Any], tensors: dict[str, torch.Tensor]) -> Tested:
    params = {k: x.numpy() for k, x in _below(tensors, "params/").items()}
    attack = None
    if numbers["attack"] is not None:
        worst, evaluated = numbers["attack"]
        attack = Attack(worst, tensors["q"].numpy(), tensors["v"].numpy(), evaluated)
    return Tested(params, BandCheck(*numbers["check"]), attack, numbers["volume_kept"])


def _below(tensors: dict[str, torch.Tensor], prefix: str) -> dict[str, torch.Tensor]:
    """Tensors whose name starts with a prefix, without it."""
    return {k.removeprefix(prefix): x for k, x in tensors.items() if k.startswith(prefix)}
