"""Branch and bound over the domain X: boxes are judged, those left open are cut in two, until none is left."""

from __future__ import annotations

import io
import time
import zipfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ppcbf_robots.errors import InputError
from ppcbf_robots.proof.boxes import OFF_BAND, OPEN, PROVED, BoxJudge, Verdicts
from ppcbf_robots.specs import Array

BATCH = 8192  # boxes per thread and round
LEAST_VOLUME = 1e-14  # of X; smaller boxes are given up
REFUTED_VOLUME = 1e-10  # the same for passivity once it is refuted, where only the size of the rest is still asked for
ENOUGH = 300  # states without a feasible torque after which the search ends, and as many that lack passivity are kept
SAVE_EVERY = 30.0  # [s]
CONFIRMED_AT_ONCE = 100  # suspects looked at per round

Confirm = Callable[[Array, bool], bool]


@dataclass
class Search:
    """All that is known of a proof on its way.

    Boxes are (n, 2, 2 nv): lower and upper corner in joint angles and velocities. Volumes are relative to X.
    """

    boxes: Array  # (n, 2, 2 nv) still open
    passive: NDArray[np.bool_]  # (n,) whether passivity is still asked for there
    markers: Array  # (m, 2 nv) uniform states of the band: those in decided boxes say how far the search is
    home: NDArray[np.int64]  # (m,) index of the marker's open box, or -1
    judged: int = 0
    proved: int = 0
    seconds: float = 0.0
    Lg: float = np.inf  # least bound of |L_g phi| so far
    impassive_volume: float = 0.0  # of boxes that were no longer asked for passivity
    impassive_markers: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, np.bool_))
    undecided_volume: float = 0.0  # of boxes given up
    excess: float = 0.0  # [W] largest seen at a state that lacks passivity
    infeasible: list[Array] = field(default_factory=list)  # states (2 nv,) without a torque for rows and box
    impassive: list[Array] = field(default_factory=list)  # states (2 nv,) with one, but none that is passive

    @property
    def share(self) -> float:
        """Of the band's volume, that lies in decided boxes, as far as the markers tell."""
        return float(np.mean(self.home < 0)) if len(self.home) else 0.0

    @property
    def complete(self) -> bool:
        """Whether every box was decided or given up."""
        return len(self.boxes) == 0

    @property
    def done(self) -> bool:
        """Whether the search goes no further: it is complete, or knows enough counterexamples."""
        return self.complete or len(self.infeasible) >= ENOUGH


def begin(judge: BoxJudge, passive: bool, markers: Array) -> Search:
    """A search that has X before it as one box."""
    boxes = np.stack([judge.low, judge.high])[None]
    return Search(boxes, np.array([passive]), markers, np.zeros(len(markers), np.int64),
                  impassive_markers=np.zeros(len(markers), np.bool_))  # fmt: skip


def run(
    search: Search,
    judge: BoxJudge,
    confirm: Confirm,
    threads: int,
    seconds: float,
    on_round: Callable[[Search], None],
    save: Callable[[Search], None],
) -> None:
    """Search until nothing is left, enough counterexamples are known, or the time is over.

    Args:
        search: goes on from where it is.
        judge: of boxes.
        confirm: whether a state (2 nv,) is one where the filter itself fails, with the passivity row or without.
        threads: boxes are judged by so many at once.
        seconds: from now.
        on_round: called after every round.
        save: called now and then, and at the end, also after an interrupt.
    """
    began = saved = last = time.monotonic()
    with ThreadPoolExecutor(threads) as pool:
        try:
            while not search.done and last - began < seconds:
                _round(search, judge, confirm, threads, pool)
                now = time.monotonic()
                search.seconds, last = search.seconds + now - last, now
                on_round(search)
                if now - saved > SAVE_EVERY:
                    save(search)
                    saved = now
        finally:
            save(search)


def _round(search: Search, judge: BoxJudge, confirm: Confirm, threads: int, pool: ThreadPoolExecutor) -> None:
    """Judge the boxes that came last, put the halves of the open ones in their place."""
    first = max(0, len(search.boxes) - BATCH * threads)
    order = np.lexsort(search.boxes[first:, :, : len(judge.low) // 2].reshape(len(search.boxes) - first, -1).T)
    boxes, passive = search.boxes[first:][order], search.passive[first:][order]
    parts = np.array_split(np.arange(len(boxes)), threads)
    found = list(pool.map(lambda part: judge(boxes[part], passive[part]), parts))
    verdict = Verdicts(*(np.concatenate([getattr(v, name) for v in found]) for name in Verdicts.__annotations__))
    search.judged += len(boxes)
    search.proved += int(np.sum(verdict.status == PROVED))
    search.Lg = min(search.Lg, float(verdict.Lg.min()))

    volume = np.prod((boxes[:, 1] - boxes[:, 0]) / (judge.high - judge.low), axis=1)
    failed = _counterexamples(search, verdict, passive, confirm)
    still = verdict.status == OPEN
    given_up = still & ~passive & (failed | (volume < LEAST_VOLUME))
    demoted = still & passive & (failed | (volume < (REFUTED_VOLUME if search.impassive else LEAST_VOLUME)))
    search.undecided_volume += float(volume[given_up].sum())
    search.impassive_volume += float(volume[demoted].sum())

    cut = np.flatnonzero(still & ~given_up & ~demoted)
    at = _cuts(boxes[cut], verdict.cut[cut])
    lower, upper, along = boxes[cut].copy(), boxes[cut].copy(), np.arange(len(cut))
    lower[along, 1, verdict.cut[cut]] = at
    upper[along, 0, verdict.cut[cut]] = at
    kept = np.flatnonzero(demoted)
    target = np.full(len(boxes), -1)  # index of what became of a box: itself, or its lower half
    target[kept] = first + np.arange(len(kept))
    target[cut] = first + len(kept) + along

    here = np.flatnonzero(search.home >= first)
    position = np.empty(len(boxes), np.int64)
    position[order] = np.arange(len(boxes))
    old = position[search.home[here] - first]
    assert not np.any(verdict.status[old] == OFF_BAND), "a state of the band lies in a box that was judged to be off it"
    search.impassive_markers[here] |= demoted[old]
    home = target[old]
    split = np.flatnonzero(np.isin(old, cut))
    index = np.searchsorted(cut, old[split])
    above = search.markers[here[split], verdict.cut[cut][index]] > at[index]
    home[split] += np.where(above, len(cut), 0)
    search.home[here] = home
    search.boxes = np.concatenate([search.boxes[:first], boxes[kept], lower, upper])
    flags = [search.passive[:first], np.zeros(len(kept), np.bool_), passive[cut], passive[cut]]
    search.passive = np.concatenate(flags)


def _counterexamples(
    search: Search, verdict: Verdicts, passive: NDArray[np.bool_], confirm: Confirm
) -> NDArray[np.bool_]:
    """Which boxes (B,) hold a state where the filter itself fails; such states are kept.

    Beyond those looked at, suspects that lack passivity count without a look: nothing is claimed of their boxes then.
    """
    failed = np.zeros(len(passive), np.bool_)
    for asked in (True, False):
        suspects = np.flatnonzero(verdict.suspect & (passive == asked))
        known = search.impassive if asked else search.infeasible
        for b in suspects[:CONFIRMED_AT_ONCE]:
            if confirm(verdict.point[b], asked):
                failed[b] = True
                if len(known) < ENOUGH:
                    known.append(verdict.point[b].copy())
                if asked:
                    search.excess = max(search.excess, float(verdict.excess[b]))
        if asked and known:
            failed[suspects[CONFIRMED_AT_ONCE:]] = True
    return failed


def _cuts(boxes: Array, coordinate: NDArray[np.int64]) -> Array:
    """The middle of each box along its coordinate."""
    rows = np.arange(len(boxes))
    middle: Array = 0.5 * (boxes[rows, 0, coordinate] + boxes[rows, 1, coordinate])
    return middle


def save_search(search: Search, identity: str, path: Path) -> None:
    """Write a search, bound to what it is about, by an atomic rename."""
    arrays = {name: np.asarray(value) for name, value in vars(search).items()}
    buffer = io.BytesIO()
    np.savez(buffer, identity=identity, **arrays)  # type: ignore[arg-type]
    try:
        temporary = path.with_name(f".{path.name}.tmp")
        temporary.write_bytes(buffer.getvalue())
        temporary.replace(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from None


def load_search(path: Path, identity: str) -> Search | None:
    """A search about the same as ``identity``; None if there is none, or another's.

    Raises:
        InputError: if the file is not one of a search.
    """
    if not path.is_file():
        return None
    try:
        with np.load(path, allow_pickle=False) as file:
            if str(file["identity"]) != identity:
                return None
            found = {name: file[name] for name in Search.__annotations__}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        raise InputError(f"{path}: not the state of a proof; remove it to start anew") from None
    values = {k: x.item() if x.ndim == 0 else x for k, x in found.items()}
    return Search(**values | {k: list(found[k]) for k in ("infeasible", "impassive")})
