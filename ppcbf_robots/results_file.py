"""The file of a sweep: one JSON object per line, on the disk before the sweep goes on."""

from __future__ import annotations

import fcntl
import json
import os
from pathlib import Path
from types import TracebackType
from typing import Any

from ppcbf_robots.errors import InputError

Record = dict[str, Any]  # {"key": ..., "result": ...} or {"key": ..., "error": one sentence}


def name_of(key: dict[str, Any]) -> str:
    """A key as text: the same for equal keys."""
    return json.dumps(key, sort_keys=True)


class ResultsFile:
    """Records that only ever grow in number; one process writes at a time.

    A last line without an end, which a killed run leaves behind, is dropped: its task has no record.

    Raises:
        InputError: if the file cannot be written, is being written by another sweep, or holds something else.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("a+b", buffering=0)
        except OSError as error:
            raise InputError(f"{path}: cannot be written ({error.strerror})") from None
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self.finished = self._read()
        except BlockingIOError:
            self._file.close()
            raise InputError(f"{path}: another sweep is writing it; wait for its end, or give another folder") from None
        except InputError:
            self._file.close()
            raise

    def __enter__(self) -> ResultsFile:
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self._file.close()

    def _read(self) -> dict[str, Record]:
        """Records with a result, by name, after cutting off a half-written line."""
        self._file.seek(0)
        content = self._file.read()
        whole = content.rfind(b"\n") + 1
        finished = {}
        for number, line in enumerate(content[:whole].splitlines(), start=1):
            try:
                record = json.loads(line)
                if "result" in record:
                    finished[name_of(record["key"])] = record
                else:
                    assert "error" in record
            except (ValueError, TypeError, KeyError, AssertionError, RecursionError):
                raise InputError(f"{self.path}: line {number} is no result of a sweep; give another folder") from None
        self._file.truncate(whole)
        return finished

    def append(self, key: dict[str, Any], outcome: dict[str, Any]) -> Record:
        """Write one record with a single write, and wait until it is on the disk."""
        record = {"key": key, **outcome}
        line = (json.dumps(record, allow_nan=False) + "\n").encode()
        try:
            if self._file.write(line) != len(line):
                raise OSError(0, "the disk is full")
            os.fsync(self._file.fileno())
        except OSError as error:
            raise InputError(f"{self.path}: cannot be written ({error.strerror})") from None
        return record
