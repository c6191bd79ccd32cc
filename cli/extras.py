"""Packages that only some commands need."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from ppcbf_robots.errors import InputError

PACKAGES = {"study": ("hj_reachability", "jax", "casadi"), "verify": ("casadi",)}


@contextmanager
def needs(extra: str, what: str) -> Iterator[None]:
    """Around imports: a package of the extra that is missing becomes one sentence with the remedy."""
    try:
        yield
    except ModuleNotFoundError as error:
        if error.name not in PACKAGES[extra]:
            raise
        remedy = f'pip install "ppcbf-robots[{extra}]"'
        raise InputError(f"{what} needs the package {error.name}; remedy: {remedy}") from None
