"""Algorithm 1 of the paper: sample the band, descend on (24), check on fresh states, keep the best that is clean."""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch

from ppcbf_robots.barriers import BarrierRows
from ppcbf_robots.errors import InputError
from ppcbf_robots.evidence import POWER_TOLERANCE, BandCheck, check_band
from ppcbf_robots.filters import FilterConfig
from ppcbf_robots.learning.critics import closed_form_critics, feasibility_margin
from ppcbf_robots.learning.parameters import CONSTANTS, Tensors, initial_parameters
from ppcbf_robots.learning.presets import Preset
from ppcbf_robots.learning.rays import Field, Rays, VolumeStates, build_pool, rays_at, to_tensors
from ppcbf_robots.network import NumpyNetwork
from ppcbf_robots.problem import Problem
from ppcbf_robots.specs import Array

LearnedKind = Literal["ncbf", "pp-ncbf"]
CHECK_STATES = 4_000
MIN_SAMPLES = 200  # uniform band states below which nothing is claimed
CANDIDATES = 3  # clean parameter sets tried in the final check
MARGIN_GROWTH = 1.15  # per refinement
MAX_REFINED_MARGIN = 0.1


@dataclass(frozen=True)
class Monitor:
    """What a check on fresh band states saw."""

    iteration: int
    planned: int
    volume_kept: float  # of the LB safe set's volume in X
    band_yield: float  # share of rays that cross the band
    torque: float  # share of band states whose torque (QP: feasibility) critic is above zero
    passivity: float  # the same for passivity
    weights: tuple[float, float]  # λ of the two critics
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
    start_inside: bool
    steps: int
    seconds: float
    history: list[Monitor]

    def report(self) -> dict[str, Any]:
        """The keys of ``ppcbf train --json``, without the folder."""
        return {
            "converged": self.converged,
            "reason": self.reason,
            "volume_kept": round(self.volume_kept, 5),
            "violations": self.check.violations,
            "samples": self.check.samples,
            "start_inside": self.start_inside,
            "seconds": round(self.seconds, 2),
            "steps": self.steps,
        }


@dataclass(frozen=True)
class Tested:
    """Parameters and what the runtime filter did with them on uniform band states."""

    params: dict[str, Array]
    check: BandCheck
    volume_kept: float


class Trainer:
    """Trains K_theta for one problem.

    Args:
        problem: robot, world and controller.
        kind: ``pp-ncbf`` trains for torque limits and passivity, ``ncbf`` for torque limits alone.
        preset: all settings.
        seed: fixes every random draw; the same seed on the same machine gives the same weights.
        device: where the loop runs.

    Raises:
        InputError: if almost no configuration of X is free of collision.
    """

    def __init__(self, problem: Problem, kind: LearnedKind, preset: Preset, seed: int = 0, device: str = "cpu") -> None:
        self.problem, self.kind, self.preset, self.seed = problem, kind, preset, seed
        self.spec = problem.robot.spec.barrier
        self.device, self.dtype = torch.device(device), torch.float32
        self.generator = torch.Generator().manual_seed(seed)
        self.rng = np.random.default_rng(seed)
        self.filter_config = FilterConfig(kind=preset.filter, metric=preset.metric)
        self.rays, self.volume = self._pool()
        params = initial_parameters(problem, preset, self.generator)
        self.params: Tensors = {k: x.to(self.device, self.dtype) for k, x in params.items()}
        self.trained = [k for k in self.params if k not in CONSTANTS]
        self.optimizer = torch.optim.Adam([self.params[k].requires_grad_() for k in self.trained])
        self.field = Field(problem.model, preset.network, self.spec.gamma, self.device, self.dtype)
        self._u_max = self._tensor(problem.model.u_max)
        self._kd = self._tensor(problem.robot.controller.gains.kd)
        self._p_ref = float(problem.model.u_max @ np.abs(problem.robot.domain.v).max(axis=1))
        self.weights = [preset.critic_weight, preset.critic_weight]
        self.margin = preset.margin
        self.iteration, self.planned = 0, preset.iterations
        self.buffer = (torch.zeros(0, dtype=torch.long, device=self.device), self._tensor(np.zeros(0)))
        self.loss = float("nan")
        self.history: list[Monitor] = []
        self.clean: list[tuple[float, dict[str, Array]]] = []  # (volume kept, parameters), best first
        self.counterexamples: list[tuple[Array, Array]] = []  # q, v whose rays joined the pool
        self.started = time.monotonic()

    def _tensor(self, x: Array) -> torch.Tensor:
        return torch.as_tensor(x, device=self.device, dtype=self.dtype)

    def _pool(self) -> tuple[Rays, VolumeStates]:
        p = self.preset
        rays, volume = build_pool(self.problem, p.rays, p.rows_per_ray, p.random_goals, self.rng)
        free = sum(len(r["q"]) for r in rays)
        if free < 200:
            raise InputError(
                "almost every configuration of the domain X is in collision; shrink X or move the obstacles"
            )
        pool = Rays(**to_tensors(rays, self.device, self.dtype))
        return pool.without_far_rows(self.spec.gamma), VolumeStates(**to_tensors(volume, self.device, self.dtype))

    def identity(self) -> str:
        """What a checkpoint must share with this run to be resumed."""
        problem = [self.problem.fingerprint(), self.problem.robot.goal.tolist(), self.spec.model_dump()]
        return json.dumps([*problem, self.kind, settings(self.preset), self.seed])

    def run(
        self,
        on_check: Callable[[Monitor], None] | None = None,
        time_limit: float = float("inf"),
        on_refine: Callable[[str], None] | None = None,
    ) -> Result:
        """Train until the planned iterations are done and the final check is clean, or time is up.

        KeyboardInterrupt ends training and checks the best barrier so far.
        """
        interrupted = False
        tested: list[Tested] = []
        for round_ in range(self.preset.refinements + 1):
            try:
                self._descend(on_check, time_limit)
            except KeyboardInterrupt:
                interrupted = True
            try:
                found = self._final_check()
            except KeyboardInterrupt:
                found, interrupted = [], True
            tested = sorted([*tested, *found], key=lambda t: (t.check.share, -t.volume_kept))
            out_of_time = time.monotonic() - self.started > time_limit
            done = bool(tested) and tested[0].check.violations == 0
            if done or interrupted or out_of_time or round_ == self.preset.refinements:
                break
            self._refine(found)
            if on_refine is not None:
                share = f"{found[-1].check.violations} of {found[-1].check.samples}" if found else "too many"
                on_refine(f"{share} uniform band states violate: refining")
        best = tested[0] if tested else Tested(self._snapshot(), BandCheck(0, 0, 0), 0.0)
        return self._result(best.params, best.check, interrupted)

    def _descend(self, on_check: Callable[[Monitor], None] | None, time_limit: float) -> None:
        """Lines 2 to 12 of Algorithm 1."""
        while self.iteration < self.planned and time.monotonic() - self.started < time_limit:
            self._iterate()
            if self.iteration % self.preset.check_every == 0 or self.iteration == self.planned:
                monitor = self._check()
                if on_check is not None:
                    on_check(monitor)
                if self._settled():
                    return

    def _iterate(self) -> None:
        """Sample N band states, descend for E epochs, drop what left the band, adapt the weights."""
        p, eps = self.preset, self.spec.epsilon
        rate = p.learning_rate * max(0.1, 1.0 - self.iteration / p.iterations)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        index, s, _ = self._sample(p.samples)
        index, s = (torch.cat([new, old])[: 2 * p.samples] for new, old in zip((index, s), self.buffer, strict=True))
        for _ in range(p.epochs):
            if not len(index):
                break  # the band is empty: the set has collapsed, and the checks will say so
            rays = self.rays.select(index)
            rows, torque, passivity = self._critics(rays, s, self.margin)
            phi = rows.phi.amin(-1)
            self._step(phi, torque, passivity)
            inside = ((phi >= 0.0) & (phi <= eps)).detach()
            index, s = index[inside], s[inside]
        self.buffer = (index, s)
        self.iteration += 1

    def _sample(self, count: int) -> tuple[torch.Tensor, torch.Tensor, float]:
        """Ray indices and s of band states at random levels of phi, and the share of rays that had one."""
        index = torch.randint(len(self.rays), (count,), generator=self.generator).to(self.device)
        level = torch.rand(count, generator=self.generator).to(self.device, self.dtype) * self.spec.epsilon
        s, crosses = self.field.on_band(self.params, self.rays.select(index), level)
        return index[crosses], s[crosses], float(crosses.float().mean())

    def _critics(self, rays: Rays, s: torch.Tensor, margin: float) -> tuple[BarrierRows, torch.Tensor, torch.Tensor]:
        """Rows, torque (or feasibility) critic (B,) and passivity critic (B,), zero where ``margin`` is kept."""
        p = self.preset
        v = s[:, None] * rays.d
        rows = self.field.rows(self.params, rays, s)
        u_des, d_p = rays.u_rest - self._kd * v, (self._kd * v * v).sum(-1)
        if p.filter == "closed-form":
            torque, passivity = closed_form_critics(rows, v, u_des, d_p, self._u_max, p.metric, margin, self._p_ref)
        else:
            passive = self.kind == "pp-ncbf"
            row, box = feasibility_margin(rows, v, u_des, d_p, self._u_max, self.filter_config.alpha, passive)
            torque, passivity = torch.relu(margin - row), torch.relu(-box)
        if self.kind == "ncbf":
            passivity = torch.zeros_like(passivity)
        return rows, torque, passivity

    def _step(self, phi: torch.Tensor, torque: torch.Tensor, passivity: torch.Tensor) -> None:
        """One gradient step on the loss (24) with R = 1 - sigmoid(phi), then the weights' update."""
        p = self.preset
        R = 1.0 - torch.sigmoid(phi)
        C = self.weights[0] * torque + self.weights[1] * passivity
        loss = p.volume_weight * R.mean() + C.topk(min(p.top, len(C))).values.mean()
        if p.l2:
            matrices = [w for k, w in self.params.items() if k.startswith("W")]
            loss = loss + p.l2 * sum(((w * w).mean() for w in matrices), start=torch.zeros((), device=self.device))
        self.optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        self.optimizer.step()
        self.loss = float(loss.detach())
        for j, critic in enumerate((torque, passivity)):
            violated = float((critic > 0.0).float().mean()) > 5e-4
            factor = p.critic_growth if violated else p.critic_decay
            self.weights[j] = float(np.clip(self.weights[j] * factor, *p.critic_bounds))

    @torch.no_grad()
    def _check(self) -> Monitor:
        """Fresh band states without the training margin, volume and start state."""
        index, s, found = self._sample(CHECK_STATES)
        torque = passivity = 0.0
        if len(index):
            _, t, e = self._critics(self.rays.select(index), s, 0.0)
            torque, passivity = (float((x > limit).float().mean()) for x, limit in ((t, 1e-4), (e, POWER_TOLERANCE)))
        snapshot = self._snapshot()
        monitor = Monitor(
            self.iteration, self.planned, self._volume_kept(), found, torque, passivity,
            (self.weights[0], self.weights[1]), self.loss, self._start_inside(snapshot),
            time.monotonic() - self.started,
        )  # fmt: skip
        self.history.append(monitor)
        if monitor.clean:
            self.clean = sorted([*self.clean, (monitor.volume_kept, snapshot)], key=lambda c: -c[0])[:CANDIDATES]
        return monitor

    def _volume_kept(self) -> float:
        """Volume of the safe set over that of the LB set, on uniform states of X."""
        K = self.field.K(self.params, self.volume.q, self.volume.v)[0]
        lb = self.volume.rho >= 0.0
        return float((self.volume.rho - K >= 0.0).sum() / lb.sum().clamp(min=1))

    def _start_inside(self, params: dict[str, Array]) -> bool:
        robot = self.problem.robot
        barrier = self.problem.barrier(self.kind, NumpyNetwork(self.preset.network, params))
        dyn = robot.model.evaluate(robot.start, robot.start_velocity)
        return bool(barrier.rows(dyn, self.problem.safety.evaluate(dyn)).phi.min() >= 0.0)

    def _snapshot(self) -> dict[str, Array]:
        return {k: x.detach().cpu().double().numpy().copy() for k, x in self.params.items()}

    def _settled(self) -> bool:
        """The last ``patience`` checks were clean and gained no volume."""
        last = [m for m in self.history if m.planned == self.planned][-self.preset.patience :]
        if len(last) < self.preset.patience or not all(m.clean for m in last):
            return False
        return max(m.volume_kept for m in last) - last[0].volume_kept < 2e-3

    def _final_check(self) -> list[Tested]:
        """Run the filter on uniform band states for the largest clean candidates until one has no violation."""
        tested = []
        for volume, params in self.clean:
            check = self._draw_check(params)
            if check.samples and not check.violations:  # selected by this draw, so only a fresh one is evidence
                check = self._draw_check(params)
            if check.samples:
                tested.append(Tested(params, check, volume))
            if check.samples and not check.violations:
                break
        return tested

    def _draw_check(self, params: dict[str, Array]) -> BandCheck:
        barrier = self.problem.barrier(self.kind, NumpyNetwork(self.preset.network, params))
        passive = self.kind == "pp-ncbf"
        return check_band(self.problem, barrier, self.filter_config, self.preset.test_samples, self.rng, passive)

    def _refine(self, tested: list[Tested]) -> None:
        """Counterexamples join the pool, the margin grows, and training goes on for half as long."""
        self.clean = []
        self.margin = min(MAX_REFINED_MARGIN, MARGIN_GROWTH * self.margin)
        self.planned = self.iteration + self.preset.iterations // 2
        if any(t.check.violations for t in tested):
            q, v = (np.concatenate([getattr(t.check, k) for t in tested]) for k in ("bad_q", "bad_v"))
            self.add_counterexamples(q, v)

    def add_counterexamples(self, q: Array, v: Array) -> None:
        """Rays through states (q, v) join the pool, many times over."""
        rays, _ = rays_at(self.problem, q, v, self.rays.h.shape[1])
        found = Rays(**to_tensors([rays], self.device, self.dtype))
        copies = torch.arange(len(found), device=self.device).repeat(self.preset.counterexample_copies)
        self.rays = self.rays.join(found.select(copies))
        self.counterexamples.append((q, v))

    def _result(self, params: dict[str, Array], check: BandCheck, interrupted: bool) -> Result:
        tensors = {k: self._tensor(x) for k, x in params.items()}
        with torch.no_grad():
            self.params = tensors
            volume = self._volume_kept()
        start_inside = self._start_inside(params)
        if volume < self.preset.min_volume or not check.tried:
            why = "collapsed" if volume < self.preset.min_volume else "no clean barrier was found"
            reason = f"{why}: the safe set keeps {volume:.1%} of the LB set"
        elif check.samples < MIN_SAMPLES:
            reason = f"only {check.samples} states were found on the band, too few to tell"
        elif check.violations:
            reason = f"{check.violations} of {check.samples} uniform band states violate the limits"
        elif not start_inside and self.problem.safety.least(self.problem.robot.start)[0] >= 0.0:
            reason = "the start state lies outside the safe set"
        else:
            reason = "interrupted; the best barrier so far is clean" if interrupted else "clean"
        converged = reason == "clean" or reason.startswith("interrupted")
        seconds = time.monotonic() - self.started
        return Result(params, converged, reason, volume, check, start_inside, self.iteration, seconds, self.history)


def settings(preset: Preset) -> dict[str, Any]:
    """A preset as plain JSON data, for the training report."""
    return {k: list(x) if isinstance(x, tuple) else x for k, x in dataclasses.asdict(preset).items()}
