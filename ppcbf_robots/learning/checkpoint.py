"""Checkpoints of a training run: everything needed to go on, in safetensors (no pickle)."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from ppcbf_robots.errors import InputError
from ppcbf_robots.learning.train import Monitor, Trainer

FILE = "checkpoint.safetensors"


def save_checkpoint(trainer: Trainer, folder: Path) -> None:
    """Write the checkpoint of a trainer into a folder, replacing the last one."""
    tensors = {f"param/{k}": x.detach().cpu().contiguous() for k, x in trainer.params.items()}
    for k, name in enumerate(trainer.trained):
        for key, x in trainer.optimizer.state_dict()["state"].get(k, {}).items():
            tensors[f"adam/{name}/{key}"] = x.detach().cpu().reshape(x.shape).clone()
    tensors["generator"] = trainer.generator.get_state()
    tensors["buffer/index"], tensors["buffer/s"] = (x.detach().cpu().contiguous() for x in trainer.buffer)
    for j, (volume, params) in enumerate(trainer.clean):
        tensors |= {f"clean/{j}/{k}": torch.as_tensor(x) for k, x in params.items()}
        tensors[f"clean/{j}/volume"] = torch.tensor(volume)
    for j, states in enumerate(trainer.counterexamples):
        tensors |= {f"counterexamples/{j}/{k}": torch.as_tensor(x) for k, x in zip("qv", states, strict=True)}
    state = {
        "identity": trainer.identity(),
        "iteration": trainer.iteration,
        "planned": trainer.planned,
        "weights": trainer.weights,
        "margin": trainer.margin,
        "rng": trainer.rng.bit_generator.state,
        "history": [dataclasses.asdict(monitor) for monitor in trainer.history],
    }
    try:
        folder.mkdir(parents=True, exist_ok=True)
        save_file(tensors, folder / f".{FILE}.tmp", metadata={"state": json.dumps(state)})
        (folder / f".{FILE}.tmp").replace(folder / FILE)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror})") from None


def load_checkpoint(trainer: Trainer, folder: Path) -> None:
    """Continue from a folder's checkpoint.

    Raises:
        InputError: if there is none, or it belongs to another problem, preset or seed.
    """
    path = folder / FILE
    if not path.is_file():
        raise InputError(f"nothing to resume: {path} does not exist")
    try:
        with safe_open(path, "pt") as file:
            state = json.loads(file.metadata()["state"])
            tensors = {k: file.get_tensor(k) for k in file.keys()}  # noqa: SIM118 - not a dict
    except (SafetensorError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: not a checkpoint ({error}); train from the start without --resume") from None
    if state["identity"] != trainer.identity():
        raise InputError(
            f"{path}: belongs to another robot, world, preset, barrier or seed; resume with the same options"
        )
    for k in trainer.trained:
        with torch.no_grad():
            trainer.params[k].copy_(tensors[f"param/{k}"])
    adam = trainer.optimizer.state_dict()
    for i, name in enumerate(trainer.trained):
        prefix = f"adam/{name}/"
        found = {k.removeprefix(prefix): x for k, x in tensors.items() if k.startswith(prefix)}
        if found:
            adam["state"][i] = found
    trainer.optimizer.load_state_dict(adam)
    trainer.generator.set_state(tensors["generator"])
    trainer.buffer = (tensors["buffer/index"].to(trainer.device), tensors["buffer/s"].to(trainer.device))
    for j in range(sum(k.startswith("counterexamples/") for k in tensors) // 2):
        trainer.add_counterexamples(*(tensors[f"counterexamples/{j}/{k}"].numpy() for k in "qv"))
    count = sum(k.endswith("/volume") for k in tensors)
    trainer.clean = [
        (
            float(tensors[f"clean/{j}/volume"]),
            {k.split("/", 2)[2]: x.numpy() for k, x in tensors.items()
             if k.startswith(f"clean/{j}/") and not k.endswith("/volume")},
        )
        for j in range(count)
    ]  # fmt: skip
    trainer.iteration, trainer.planned = state["iteration"], state["planned"]
    trainer.weights, trainer.margin = state["weights"], state["margin"]
    trainer.rng.bit_generator.state = state["rng"]
    trainer.history = [Monitor(**{**monitor, "weights": tuple(monitor["weights"])}) for monitor in state["history"]]
