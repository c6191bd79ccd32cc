"""Fitted bodies kept between runs: one JSON file per content in the user's cache folder, never trusted blindly."""

from __future__ import annotations

import contextlib
import hashlib
import os
import tempfile
from pathlib import Path
from typing import TypeVar

from ppcbf_robots.specs import Spec

S = TypeVar("S", bound=Spec)


def folder() -> Path | None:
    """``$XDG_CACHE_HOME/ppcbf_robots/body``, by default under ``~/.cache``; None where there is no home."""
    given = Path(os.environ.get("XDG_CACHE_HOME", ""))
    try:
        return (given if given.is_absolute() else Path.home() / ".cache") / "ppcbf_robots" / "body"
    except RuntimeError:
        return None


def recall(key: str, kind: type[S]) -> S | None:
    """What was kept under ``key``, or None if there is nothing, it cannot be read, or it was altered."""
    place = folder()
    if place is None:
        return None
    try:
        checksum, text = (place / f"{key}.json").read_text(encoding="utf-8").split("\n", 1)
        return kind.model_validate_json(text) if checksum == _checksum(text) else None
    except (OSError, ValueError):  # pydantic's errors are ValueErrors
        return None


def keep(key: str, value: Spec) -> None:
    """Keep ``value`` under ``key``; a folder that cannot be written is no error."""
    place = folder()
    if place is None:
        return
    text = value.model_dump_json(indent=1)
    with contextlib.suppress(OSError):
        place.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=place, suffix=".part")
        try:
            with os.fdopen(handle, "w", encoding="utf-8") as file:
                file.write(f"{_checksum(text)}\n{text}")
            Path(name).replace(place / f"{key}.json")  # whole or not at all, also beside another process
        except OSError:
            Path(name).unlink(missing_ok=True)


def _checksum(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
