"""Faults on purpose: what goes wrong around a filter in a control loop, and what the filter then does.

Every case runs the robot from its start towards its goal, and goes wrong from the first step on in which an obstacle's
row acts. Torques are checked step by step; clearance and energy are those of the plant. STOP is answered by brakes that
hold the arm at once.
"""

from __future__ import annotations

import dataclasses
import gc
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from ppcbf_robots.barriers import Barrier
from ppcbf_robots.engines import PinocchioEngine
from ppcbf_robots.filters import FilterConfig, Status
from ppcbf_robots.problem import Problem
from ppcbf_robots.qp import QPProblem, QPSolver
from ppcbf_robots.qp_filter import QPFilter
from ppcbf_robots.robot import RobotModel
from ppcbf_robots.safety_filter import SafetyFilter, StepResult
from ppcbf_robots.shapes import Motion
from ppcbf_robots.specs import Array

SUBSTEP = 5e-4  # [s], of the plant
AFTER = 0.6  # [s], how long a run goes on once a fault has begun
LATEST = 3.0  # [s], when it begins if the filter has not corrected by then
LATENCY = 0.02  # [s] of CPU time that no step may exceed
BACK_WITHIN = 0.05  # [s] after a fault that ends, the filter must solve its QP again
ROUNDING = 1e-9


class Told(NamedTuple):
    """What the filter is told in one step (see :meth:`SafetyFilter.step`), by right or wrong."""

    t: Any
    q: Any
    v: Any
    u_des: Any
    d_p: Any
    motions: Mapping[str, Motion] | None = None
    age: float = 0.0


@dataclass
class Scene:
    """Where a fault happens: the run so far."""

    problem: Problem
    rng: np.random.Generator
    dt: float  # [s], control period
    history: list[Told] = field(default_factory=list)  # what was true, step by step
    since: int = 0  # steps since the fault began
    nearest: tuple[str, Array, float] = ("", np.zeros(3), 0.0)  # then: obstacle, way from it to the arm (3,), h [m]

    def shifted(self, distance: float, speed: float = 0.0) -> dict[str, Motion]:
        """The nearest obstacle moved by ``distance`` [m] towards the arm as it stood, at ``speed`` [m/s]."""
        name, towards, _ = self.nearest
        packed = self.problem.safety.packed
        origin = packed.frames[packed.names.index(name), :, 3]
        return {name: Motion(xyz=origin + distance * towards, velocity=speed * towards)}


@dataclass(frozen=True)
class Fault:
    """One thing that goes wrong; what it leaves alone is None."""

    name: str
    injected: str  # in words
    lasts: float = np.inf  # [s]
    tell: Callable[[Told, Scene], Told | None] | None = None  # what the filter is told; None: the step is dropped
    plant: Callable[[RobotModel], RobotModel] | None = None
    world: Callable[[Scene], dict[str, Motion]] | None = None  # obstacles that really are elsewhere
    solver: Callable[[QPProblem, QPSolver], Array | None] | None = None
    barrier: Callable[[Barrier], Barrier] | None = None


@dataclass(frozen=True)
class Outcome:
    """What became of one fault; an invariant that does not apply is None."""

    name: str
    injected: str
    worst: str  # status
    reason: str  # its reason
    finite: bool | None
    box: bool | None
    rate: bool | None
    quick: bool | None
    logged: bool | None
    back: bool | None
    latency_ms: float | None = None  # longest step, CPU time
    back_ms: float | None = None  # from the fault's end to the next solved QP
    clearance_mm: float | None = None  # least, to the obstacles
    energy_J: float | None = None  # largest rise of the nominal storage V above its least value so far

    @property
    def survived(self) -> bool:
        """Whether every invariant held."""
        return all(x is not False for x in (self.finite, self.box, self.rate, self.quick, self.logged, self.back))

    def as_json(self) -> dict[str, Any]:
        """Plain data."""
        return dataclasses.asdict(self) | {"survived": self.survived}


class _Unsound:
    """A QP solver that may be spoiled while a fault lasts."""

    def __init__(self, sound: QPSolver, spoil: Callable[[QPProblem, QPSolver], Array | None]) -> None:
        self.sound, self.spoil, self.spoiled = sound, spoil, False

    def solve(self, problem: QPProblem) -> Array | None:
        return self.spoil(problem, self.sound) if self.spoiled else self.sound.solve(problem)


class _Said(logging.Handler):
    """Keeps what the filter logs as alarms."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.messages: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.messages.append(record.getMessage())


class Loop:
    """A control loop with a filter, in which one fault happens.

    Args:
        problem: robot and world.
        barrier: the filter's.
        config: the filter's.
        fault: what goes wrong.
    """

    def __init__(self, problem: Problem, barrier: Barrier, config: FilterConfig, fault: Fault) -> None:
        self.problem, self.fault, self.dt = problem, fault, config.dt
        self.runtime = SafetyFilter(problem.model, problem.safety, barrier, config, problem.robot.controller.gains.kd)
        self._sound = barrier
        self._solver: _Unsound | None = None
        if fault.solver is not None and isinstance(self.runtime.correction, QPFilter):
            self._solver = _Unsound(self.runtime.correction.solver, fault.solver)
            self.runtime.correction.solver = self._solver
        self.engine = PinocchioEngine(fault.plant(problem.model) if fault.plant else problem.model)
        self.engine.reset(problem.robot.start, problem.robot.start_velocity)
        self.scene = Scene(problem, np.random.default_rng(0), config.dt)
        self.results: list[StepResult] = []
        self.times: list[float] = []
        self.V: list[float] = []
        self.clearance: list[float] = []

    def begin(self) -> None:
        """The fault happens from the next step on."""
        safety, q = self.problem.safety, self.engine.state()[0]
        rows = safety.evaluate(self.problem.model.evaluate(q, np.zeros(self.problem.model.nv)))
        k = int(np.argmin(rows.h[: safety.obstacle_pairs]))
        i, o = divmod(k, len(safety.obstacles))
        p = safety.points.kinematics(self.problem.model.evaluate(q, np.zeros(self.problem.model.nv))).p[i]
        turn, origin = safety.packed.frames[o, :, :3], safety.packed.frames[o, :, 3]
        x, y, z = turn.T @ (p - origin)
        normal = np.array(safety.packed.core(o, (x, y, z), (0.0, 0.0, 0.0))[2:])
        self.scene.nearest = (safety.packed.names[o], turn @ normal, float(rows.h[k]))

    def step(self, i: int, faulty: bool) -> None:
        """Control step i and the control period after it."""
        scene, fault, model = self.scene, self.fault, self.problem.model
        q, v = self.engine.state()
        dyn = model.evaluate(q, v)
        nominal = self.problem.robot.controller.evaluate(dyn)
        motions = fault.world(scene) if faulty and fault.world else None
        true = Told(i * self.dt, q, v, nominal.u, float(nominal.d_p), motions)
        scene.history.append(true)
        told = fault.tell(true, scene) if faulty and fault.tell else true
        if fault.barrier is not None:
            self.runtime.barrier = fault.barrier(self._sound) if faulty else self._sound
        if self._solver is not None:
            self._solver.spoiled = faulty
        if told is not None:
            began = time.thread_time()
            self.results.append(self.runtime.step(**told._asdict()))
            self.times.append(time.thread_time() - began)
        obstacles = self.problem.safety.packed.moved(motions) if motions else None
        self.clearance.append(float(self.problem.safety.evaluate(dyn, obstacles).h[: self.problem.safety.pairs].min()))
        self.V.append(float(nominal.V))
        scene.since += faulty
        if self.results[-1].status is Status.STOP:
            self.engine.reset(q, np.zeros_like(v))
        elif np.isfinite(self.results[-1].u).all():
            self.engine.advance(self.results[-1].u, SUBSTEP, round(self.dt / SUBSTEP))


def onset(problem: Problem, barrier: Barrier, config: FilterConfig) -> int:
    """First step in which an obstacle's row acts without any fault; the one at LATEST if there is none."""
    acting = set(problem.safety.names[: problem.safety.pairs])
    loop = Loop(problem, barrier, config, Fault("", ""))
    for i in range(round(LATEST / config.dt)):
        loop.step(i, False)
        if loop.results[-1].row in acting:
            return i
    return round(LATEST / config.dt)


def inject(problem: Problem, barrier: Barrier, config: FilterConfig, fault: Fault, first: int) -> Outcome:
    """Run the robot with a fault from step ``first`` on, and judge what the filter does."""
    loop, log, said = Loop(problem, barrier, config, fault), logging.getLogger("ppcbf_robots"), _Said()
    lasts = fault.lasts / config.dt
    log.addHandler(said)
    propagate, log.propagate = log.propagate, False  # alarms are expected here
    silenced = log.manager.disable
    logging.disable(logging.NOTSET)
    gc.disable()  # Python's collector stops a large program for 50 ms, whatever it was doing
    try:
        for i in range(first + round(AFTER / config.dt)):
            if i == first:
                loop.begin()
            loop.step(i, first <= i < first + lasts)
    finally:
        gc.enable()
        logging.disable(silenced)
        log.removeHandler(said)
        log.propagate = propagate
    return judge(loop, said.messages, first)


def judge(loop: Loop, messages: Sequence[str], first: int) -> Outcome:
    """The invariants of a run whose fault began in step ``first``, and its figures."""
    model, fault, dt = loop.problem.model, loop.fault, loop.dt
    u = np.array([r.u for r in loop.results])
    statuses = np.array([r.status for r in loop.results])
    worst = loop.results[int(np.argmax(statuses))]
    kept = (statuses[1:] != Status.STOP) & (statuses[:-1] != Status.STOP)
    limited = bool(np.isfinite(model.u_rate).any())
    steps = np.abs(np.diff(u, axis=0))[kept]
    clips = limited or isinstance(loop.runtime.correction, QPFilter)
    alarms = [r for a, r in zip([None, *loop.results], loop.results, strict=False)
              if r.status >= Status.PASSIVITY_DROPPED and (a is None or a.status is not r.status)]  # fmt: skip
    back_ms = None
    if np.isfinite(fault.lasts):
        later = np.flatnonzero(statuses[first + round(fault.lasts / dt) :] <= Status.PASSIVITY_DROPPED)
        back_ms = 1e3 * dt * float(later[0]) if len(later) else np.inf
    V = np.array(loop.V)
    return Outcome(
        name=fault.name,
        injected=fault.injected,
        worst=worst.status.name,
        reason=worst.reason,
        finite=bool(np.isfinite(u).all()),
        box=bool(np.all(np.abs(u) <= model.u_max * (1.0 + ROUNDING))) if clips else None,
        rate=bool(np.all(steps <= model.u_rate * dt * (1.0 + ROUNDING) + ROUNDING)) if limited else None,
        quick=max(loop.times) <= LATENCY,
        logged=all(r.reason and any(r.reason in m for m in messages) for r in alarms),
        back=None if back_ms is None else back_ms <= 1e3 * BACK_WITHIN,
        latency_ms=1e3 * max(loop.times),
        back_ms=back_ms,
        clearance_mm=1e3 * min(loop.clearance),
        energy_J=float(np.max(V - np.minimum.accumulate(V))),
    )
