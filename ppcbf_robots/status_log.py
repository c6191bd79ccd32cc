"""Counts of the filter's statuses, and the log of its changes."""

from __future__ import annotations

import logging

from ppcbf_robots.filters import Status

_NUMBERS = dict.fromkeys(map(ord, "0123456789.e+-"))  # left out where two reasons are compared


class StatusLog:
    """Counts every status and logs each change, an alarm's with its reason, not every tick of one that lasts."""

    def __init__(self, log: logging.Logger) -> None:
        self.counts: dict[Status, int] = dict.fromkeys(Status, 0)
        self._log = log
        self.reset()

    def reset(self) -> None:
        """The next alarm is a new one; the counts stay."""
        self._said: tuple[Status, str] = Status.FREE, ""

    def note(self, status: Status, reason: str, row: str) -> None:
        """One step of the loop."""
        self.counts[status] += 1
        alarm = status >= Status.PASSIVITY_DROPPED
        if not alarm and status is self._said[0]:
            return
        said = status, reason.translate(_NUMBERS) if alarm else ""
        if said != self._said:
            self._log.log(logging.WARNING if alarm else logging.DEBUG, "%s: %s %s", status.name, reason, row)
            self._said = said
