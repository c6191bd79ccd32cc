"""Every error a user can meet, with the exit code the command line gives it."""

from __future__ import annotations


class PPCBFError(Exception):
    """Base of all errors raised on purpose; the message is one sentence for a person."""

    exit_code = 1


class InputError(PPCBFError):
    """Wrong use or bad input: what was wrong, where, and what to do about it (exit 2)."""

    exit_code = 2


class CheckFailed(PPCBFError):
    """A training run that did not converge, or a check that did not hold (exit 3)."""

    exit_code = 3
