"""Training: descend, check on fresh states, and keep the largest barrier that stands the evidence."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ppcbf_robots.evidence import BandCheck, check_band
from ppcbf_robots.learning.descent import Descent
from ppcbf_robots.learning.falsifier import Attack
from ppcbf_robots.learning.margin_descent import MarginDescent
from ppcbf_robots.learning.paper_descent import PaperDescent
from ppcbf_robots.learning.parameters import without_term
from ppcbf_robots.learning.presets import LearnedKind, Preset, settings, with_gamma
from ppcbf_robots.network import NumpyNetwork
from ppcbf_robots.problem import Problem
from ppcbf_robots.specs import Array

MIN_SAMPLES = 200  # uniform band states below which nothing is claimed
RESERVE_SHARE = 0.2  # of the reserve that training asks for, left of an arm's set by the evidence's search
GAIN_ROUNDS = 1  # refinements that a larger set is worth, where a smaller one stands
CANDIDATES = 3  # clean parameter sets tried by the evidence
APART = 5e-3  # of the LB set's volume, by which they differ at least: what is wrong with one is so with its like
DESCENTS: dict[str, type[Descent]] = {"closed-form": PaperDescent, "qp": MarginDescent}  # by the filter that will run


@dataclass(frozen=True)
class Monitor:
    """What a check on fresh band states saw."""

    iteration: int
    planned: int
    volume_kept: float  # of the LB safe set's volume in X
    band_yield: float  # share of rays that cross the band
    torque: float  # share of band states whose torque (QP: feasibility) critic is above zero
    passivity: float  # the same for passivity
    loss: float
    start_inside: bool
    seconds: float

    @property
    def clean(self) -> bool:
        """No violation on the fresh states, and a band to look at."""
        return self.torque == 0.0 and self.passivity == 0.0 and self.band_yield > 0.0


@dataclass(frozen=True)
class Result:
    """A trained barrier and how far it can be trusted."""

    params: dict[str, Array]
    converged: bool
    reason: str
    volume_kept: float
    check: BandCheck
    attack: Attack | None
    start_inside: bool
    steps: int
    seconds: float
    history: list[Monitor]
    interrupted: bool  # by Ctrl-C
    ended: bool  # by the preset's exit

    def report(self) -> dict[str, Any]:
        """The keys of ``ppcbf train --json``, without the folder."""
        worst = np.inf if self.attack is None else self.attack.worst
        return {
            "converged": self.converged,
            "reason": self.reason,
            "volume_kept": round(self.volume_kept, 5),
            "violations": self.check.violations,
            "samples": self.check.samples,
            "worst_margin": round(worst, 6) if np.isfinite(worst) else None,
            "attacked": 0 if self.attack is None else self.attack.evaluated,
            "start_inside": self.start_inside,
            "seconds": round(self.seconds, 2),
            "steps": self.steps,
            "interrupted": self.interrupted,
        }


@dataclass(frozen=True)
class Tested:
    """Parameters, what the runtime filter did with them on uniform band states, and what the falsifier found."""

    params: dict[str, Array]
    check: BandCheck
    attack: Attack | None  # None if it was not asked for, or the check failed already
    volume_kept: float

    @property
    def clean(self) -> bool:
        """Whether there were states and none was seen to violate."""
        survived = self.attack is None or self.attack.worst >= 0.0
        return self.check.samples > 0 and not self.check.violations and survived

    @property
    def order(self) -> tuple[float, ...]:
        """The least is the best: clean and large; else with few violating states, found in either way, and large."""
        failures = self.check.violations + (0 if self.attack is None else len(self.attack.q))
        return not self.clean, failures, -self.volume_kept


class Trainer:
    """Trains K_theta for one problem.

    Args:
        problem: robot, world and controller.
        kind: ``pp-ncbf`` trains for torque limits and passivity, ``ncbf`` for torque limits alone.
        preset: all settings.
        seed: fixes every random draw; on the CPU, the same seed on the same machine gives the same weights.
        device: where the loop runs.

    Raises:
        InputError: if almost no configuration of X is free of collision.
    """

    def __init__(self, problem: Problem, kind: LearnedKind, preset: Preset, seed: int = 0, device: str = "cpu") -> None:
        self.problem, self.kind, self.preset, self.seed = with_gamma(problem, preset), kind, preset, seed
        self.descent = DESCENTS[preset.filter](self.problem, kind, preset, seed, device)
        self.filter_config = self.descent.filter_config
        self.history: list[Monitor] = []
        self.clean: list[tuple[float, dict[str, Array]]] = []  # (volume kept, parameters), best first
        self.round = -1 if preset.judge_first else 0  # before the first one the LB-CBF is judged
        self.best: Tested | None = None
        self.gained = 0  # rounds that left a set that stands
        self.started = time.monotonic()

    def identity(self) -> str:
        """What a checkpoint must share with this run to be resumed."""
        spec = self.problem.robot.spec.barrier
        problem = [self.problem.fingerprint(), self.problem.robot.goal.tolist(), spec.model_dump()]
        return json.dumps([*problem, self.kind, settings(self.preset), self.seed, self.descent.device.type])

    def run(
        self,
        on_check: Callable[[Monitor], None] | None = None,
        time_limit: float = float("inf"),
        on_refine: Callable[[str], None] | None = None,
    ) -> Result:
        """Train until the planned iterations are done and the evidence is clean, or time is up.

        The LB-CBF, whose set is the largest, is judged first where the preset says so: it may need no learned term.
        KeyboardInterrupt ends training and judges the best barrier so far.
        """
        interrupted = over = False
        if self.round < 0:
            try:
                over = self._lb_stands() or self._late(time_limit)
            except KeyboardInterrupt:
                interrupted = True
        while not (over or interrupted):
            try:
                self._descend(on_check, time_limit)
            except KeyboardInterrupt:
                interrupted = True
            try:
                found = self._evidence()
            except KeyboardInterrupt:
                found, interrupted = [], True
            candidates = found if self.best is None else [self.best, *found]
            best = self.best = min(candidates, key=lambda t: (not self._stands(t), *t.order), default=None)
            enough = best is not None and self._stands(best)
            self.gained += enough
            larger = best is not None and any(t.volume_kept > best.volume_kept for t in found)  # that did not stand
            last = self.round == self.preset.refinements or (enough and not (larger and self.gained <= GAIN_ROUNDS))
            collapsed = not enough and self.descent.volume_kept() < self.preset.min_volume  # refined, it only shrinks
            over = last or collapsed or self._late(time_limit)
            if over or interrupted:
                break
            self.round += 1
            self._refine(found, demanding=not enough)
            if on_refine is not None:
                wrong = _said(found[0]) if found else "no clean barrier was found"
                on_refine(f"{wrong}: refining{', for a larger set than the one that stands' if enough else ''}")
        unknown = Tested(self.descent.snapshot(), BandCheck(0, 0, 0), None, 0.0)
        return self._result(self.best or unknown, interrupted)

    def _lb_stands(self) -> bool:
        """Whether the LB-CBF passes the evidence with all the reserve that is asked for; else what was found joins.

        Nothing of it was trained: where less is left, a short search was lucky.
        """
        self.clean = [(1.0, without_term(self.descent.snapshot()))]
        found = self._evidence()
        self.best = next((t for t in found if self._stands(t, 1.0)), None)
        if self.best is None:
            self.round = 0
            self._join(found)
        return self.best is not None

    def _late(self, time_limit: float) -> bool:
        """Whether time is up."""
        return time.monotonic() - self.started > time_limit

    def _stands(self, tested: Tested, share: float = RESERVE_SHARE) -> bool:
        """Whether it is clean and, where states cannot be covered, keeps that share of the reserve training asks for.

        What an arm's set has left of a short search by luck, a longer one takes.
        """
        covered = self.problem.model.nv <= self.preset.covered_joints
        ample = covered or tested.attack is None or tested.attack.worst >= share * self.descent.margin
        return tested.clean and ample

    def _descend(self, on_check: Callable[[Monitor], None] | None, time_limit: float) -> None:
        """Lines 2 to 12 of Algorithm 1."""
        descent = self.descent
        if self._settled():  # resumed after its last check
            return
        while descent.iteration < descent.planned and not self._late(time_limit):
            descent.iterate()
            last = descent.ended or descent.iteration == descent.planned
            if last or descent.iteration % self.preset.check_every == 0:
                monitor = self._check()
                if on_check is not None:
                    on_check(monitor)
                if last or self._settled():
                    break

    def _check(self) -> Monitor:
        """Fresh band states without the training margin, volume and start state."""
        descent = self.descent
        found, torque, passivity = descent.check()
        snapshot = descent.snapshot()
        monitor = Monitor(
            descent.iteration, descent.planned, descent.volume_kept(), found, torque, passivity, float(descent.loss),
            self._start_inside(snapshot), time.monotonic() - self.started,
        )  # fmt: skip
        self.history.append(monitor)
        if monitor.clean:
            kept: list[tuple[float, dict[str, Array]]] = []
            for volume, params in sorted([*self.clean, (monitor.volume_kept, snapshot)], key=lambda c: -c[0]):
                if not kept or volume <= kept[-1][0] - APART:
                    kept.append((volume, params))
            self.clean = kept[:CANDIDATES]
        return monitor

    def _start_inside(self, params: dict[str, Array]) -> bool:
        robot = self.problem.robot
        barrier = self.problem.barrier(self.kind, NumpyNetwork(self.preset.network, params))
        dyn = robot.model.evaluate(robot.start, robot.start_velocity)
        return bool(barrier.rows(dyn, self.problem.safety.evaluate(dyn)).phi.min() >= 0.0)

    def _settled(self) -> bool:
        """The last ``patience`` checks were clean and gained no volume."""
        last = [m for m in self.history if m.planned == self.descent.planned][-self.preset.patience :]
        if len(last) < self.preset.patience or not all(m.clean for m in last):
            return False
        return max(m.volume_kept for m in last) - last[0].volume_kept < 2e-3

    def _evidence(self) -> list[Tested]:
        """Judge the largest clean candidates by the falsifier and by the filter on uniform states, until one stands."""
        tested: list[Tested] = []
        for volume, params in self.clean:
            attack = self.descent.attack(params, tested[-1].attack if tested else None)
            if attack is not None and attack.worst < 0.0:
                tested.append(Tested(params, BandCheck(0, 0, 0), attack, volume))
                continue
            check = self._draw_check(params, self.preset.test_samples // 5)
            if check.samples and not check.violations:  # selected by this draw, so only a fresh one is evidence
                check = self._draw_check(params, self.preset.test_samples)
            if check.samples:
                tested.append(Tested(params, check, attack, volume))
            if tested and tested[-1].clean:  # smaller ones can only be cleaner, which a refinement is better for
                break
        return tested

    def _draw_check(self, params: dict[str, Array], count: int) -> BandCheck:
        barrier = self.problem.barrier(self.kind, NumpyNetwork(self.preset.network, params))
        passive = self.kind == "pp-ncbf"
        return check_band(self.problem, barrier, self.filter_config, count, self.descent.rng, passive)

    def _refine(self, tested: list[Tested], demanding: bool) -> None:
        """The states found join and training goes on for a while, ``demanding`` more or not."""
        self._join(tested)
        if demanding:
            self.descent.demand_more()
        self.descent.planned = self.descent.iteration + int(self.preset.refinement_share * self.preset.iterations)

    def _join(self, tested: list[Tested]) -> None:
        """The states found join what is trained on; candidates so far are done with."""
        self.clean = []
        states = [(t.check.bad_q, t.check.bad_v) for t in tested if t.check.violations]
        states += [(t.attack.q, t.attack.v) for t in tested if t.attack is not None]
        if states:
            q, v = (np.concatenate(x) for x in zip(*states, strict=True))
            self.descent.add_counterexamples(q, v)

    def _result(self, best: Tested, interrupted: bool) -> Result:
        check, descent = best.check, self.descent
        descent.load(best.params)
        volume = descent.volume_kept()
        start_inside, converged = self._start_inside(best.params), False
        if volume < self.preset.min_volume:
            reason = f"collapsed: the safe set keeps {volume:.1%} of the LB set"
        elif best.attack is not None and best.attack.worst < 0.0:
            reason = _said(best)
        elif not check.tried:
            reason = f"no clean barrier was found: the safe set keeps {volume:.1%} of the LB set"
        elif check.samples < MIN_SAMPLES:
            reason = f"only {check.samples} states were found on the band, too few to tell"
        elif best.check.violations:
            reason = _said(best)
        elif not start_inside and self.problem.safety.least(self.problem.robot.start)[0] >= 0.0:
            reason = "the start state lies outside the safe set"
        else:
            converged = True
            reason = "interrupted; the best barrier so far is clean" if interrupted else "clean"
        seconds = time.monotonic() - self.started
        return Result(best.params, converged, reason, volume, check, best.attack, start_inside, descent.iteration,
                      seconds, self.history, interrupted, descent.ended)  # fmt: skip


def _said(tested: Tested) -> str:
    """What the evidence found wrong, or little of, in words."""
    check, attack = tested.check, tested.attack
    if check.violations or attack is None:
        return f"{check.violations} of {check.samples} uniform band states violate the limits"
    if attack.worst >= 0.0:
        return f"the falsifier found states of a reserve of {attack.worst:.4f} only"
    return f"the falsifier found violating states, of a reserve of {attack.worst:.4f} at least"
