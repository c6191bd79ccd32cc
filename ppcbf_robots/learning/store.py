"""A training's result as a barrier folder."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from ppcbf_robots.artefact import save_barrier
from ppcbf_robots.learning.presets import settings
from ppcbf_robots.learning.train import Result, Trainer

HISTORY = ("iteration", "volume_kept", "band_yield", "torque", "passivity", "loss", "start_inside", "seconds")


def store(trainer: Trainer, result: Result, folder: Path, facts: dict[str, Any]) -> bool:
    """Write the barrier with its report, to which ``facts`` join, and say whether that was done.

    What nothing is known of, as after an early Ctrl-C, takes no other barrier's place.

    Raises:
        InputError: if the folder cannot be written.
    """
    unknown = result.attack is None and not result.check.tried
    if unknown and (folder / "barrier.json").is_file():
        return False
    details = {**result.report(), **facts, "settings": settings(trainer.preset), "history": _history(result)}
    network, config = trainer.preset.network, trainer.filter_config
    save_barrier(folder, trainer.problem, trainer.kind, network, result.params, config, details)
    return True


def _history(result: Result) -> list[dict[str, Any]]:
    rows = [{k: getattr(m, k) for k in HISTORY} for m in result.history]
    return [row | {"loss": row["loss"] if math.isfinite(row["loss"]) else None} for row in rows]  # JSON has no NaN
