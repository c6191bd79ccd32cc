"""The faults that ``ppcbf faults`` injects, one line each (see :mod:`ppcbf_robots.faults`)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from ppcbf_robots.barriers import Barrier, BarrierRows
from ppcbf_robots.faults import Fault, Scene, Told
from ppcbf_robots.plant import perturbed
from ppcbf_robots.qp import QPProblem, QPSolver
from ppcbf_robots.robot import Dynamics, RobotModel
from ppcbf_robots.safety import SafetyRows
from ppcbf_robots.shapes import Motion
from ppcbf_robots.specs import Array, PayloadSpec

BRIEF, LONG = 0.01, 0.05  # [s]; an invalid state is bridged for 20 ms by default
SHARE = 0.2  # of mass, inertia and centres of mass
LOAD, FRICTION = 0.1, 0.05  # of the moving mass, of u_max


class _Rows:
    """A barrier whose rows are spoiled."""

    def __init__(self, sound: Barrier, change: Callable[[BarrierRows], BarrierRows]) -> None:
        self.kind, self.spec, self._sound, self._change = sound.kind, sound.spec, sound, change

    def rows(self, dyn: Dynamics, safety: SafetyRows) -> BarrierRows:
        return self._change(self._sound.rows(dyn, safety))


def rows(change: Callable[[BarrierRows], BarrierRows]) -> Callable[[Barrier], Barrier]:
    """The barrier with changed rows."""
    return lambda sound: _Rows(sound, change)


def first(x: Array, value: float) -> Array:
    """The array with another first entry."""
    return np.concatenate([[value], x[1:]])


def wrapped(told: Told, scene: Scene) -> Told:
    """The first joint's angle a turn further; a continuous joint, which knows no turns, half a turn."""
    joint = scene.problem.model
    if joint.continuous[0]:
        return told._replace(q=np.concatenate([-told.q[:2], told.q[2:]]))
    return told._replace(q=first(told.q, told.q[0] + 2.0 * np.pi))


def late(steps: int, age: bool) -> Callable[[Told, Scene], Told]:
    """State and desired torque of some steps ago, with or without their age being told."""

    def tell(told: Told, scene: Scene) -> Told:
        old = scene.history[max(0, len(scene.history) - 1 - steps)]
        return told._replace(q=old.q, v=old.v, u_des=old.u_des, d_p=old.d_p, age=steps * scene.dt if age else 0.0)

    return tell


def frozen(told: Told, scene: Scene) -> Told:
    """The state in which the fault began, under times that go on."""
    old = scene.history[-1 - scene.since]
    return told._replace(q=old.q, v=old.v)


def stale(told: Told, scene: Scene) -> Told:
    """The state in which the fault began, with its own time."""
    return frozen(told, scene)._replace(t=scene.history[-1 - scene.since].t)


def noisy(told: Told, scene: Scene) -> Told:
    """0.1 mrad (mm) on every position, 1 % of v_max on every speed, one standard deviation."""
    model, rng = scene.problem.model, scene.rng
    q = model.integrate(told.q, 1e-4 * rng.standard_normal(model.nv))
    return told._replace(q=q, v=told.v + 0.01 * model.v_max * rng.standard_normal(model.nv))


def biased(told: Told, scene: Scene) -> Told:
    """Every position 5 mrad (mm) too large, every speed 1 % of v_max."""
    model = scene.problem.model
    return told._replace(q=model.integrate(told.q, np.full(model.nv, 5e-3)), v=told.v + 0.01 * model.v_max)


def dropping(share: float) -> Callable[[Told, Scene], Told | None]:
    """A share of the steps is left out at random; the torque is held."""
    return lambda told, scene: None if scene.rng.random() < share else told


def every(steps: int) -> Callable[[Told, Scene], Told | None]:
    """Only every so many-th step is done."""
    return lambda told, scene: told if scene.since % steps == 0 else None


def heavy(robot: RobotModel) -> RobotModel:
    """A tenth of the moving mass more, on the last link."""
    moving = sum(Y.mass for Y in list(robot.model.inertias)[1:])
    frame = next(f.name for f in robot.model.frames if f.parentJoint == robot.model.njoints - 1)
    return perturbed(robot, payload=PayloadSpec(frame=frame, mass=LOAD * moving))


def shaken(robot: RobotModel) -> RobotModel:
    """Every link's mass, inertia and centre of mass up to a fifth off, by chance."""
    rng, n = np.random.default_rng(0), robot.nv
    mass, inertia, com = rng.uniform(1.0 - SHARE, 1.0 + SHARE, (3, n))
    return perturbed(robot, mass, inertia, com)


def other(mass: float = 1.0, inertia: float = 1.0, com: float = 1.0) -> Callable[[RobotModel], RobotModel]:
    """The plant with factors of :func:`ppcbf_robots.plant.perturbed`."""
    return lambda robot: perturbed(robot, mass, inertia, com)


def misplaced(xyz: list[float]) -> Callable[[Told, Scene], Told]:
    """The nearest obstacle is said to be at xyz."""
    return lambda told, scene: told._replace(motions={scene.nearest[0]: Motion(xyz=np.array(xyz))})


def failing(problem: QPProblem, solver: QPSolver) -> Array:
    """A solver that raises."""
    raise RuntimeError("the solver broke down")


def wrong(answer: Callable[[QPProblem], Any]) -> Callable[[QPProblem, QPSolver], Any]:
    """A solver that claims any answer."""
    return lambda problem, solver: answer(problem)


NAN = float("nan")
CASES: tuple[Fault, ...] = (
    Fault("none", "nothing"),
    Fault("state NaN", "q_1 NaN for 10 ms", BRIEF, lambda x, s: x._replace(q=first(x.q, NAN))),
    Fault("state NaN, long", "q_1 NaN for 50 ms", LONG, lambda x, s: x._replace(q=first(x.q, NAN))),
    Fault("state Inf", "v_1 infinite for 10 ms", BRIEF, lambda x, s: x._replace(v=first(x.v, np.inf))),
    Fault("wrong length", "q one short for 10 ms", BRIEF, lambda x, s: x._replace(q=x.q[1:])),
    Fault("not numbers", "v None for 10 ms", BRIEF, lambda x, s: x._replace(v=None)),
    Fault("2 pi wrap", "q_1 a turn off for 10 ms", BRIEF, wrapped),
    Fault("stale", "the same state and time for 50 ms", LONG, stale),
    Fault("frozen", "the same state under new times for 50 ms", LONG, frozen),
    Fault("time backwards", "t 1 s back for 10 ms", BRIEF, lambda x, s: x._replace(t=x.t - 1.0)),
    Fault("time NaN", "t NaN for 10 ms", BRIEF, lambda x, s: x._replace(t=NAN)),
    Fault("too old", "a state said to be 10 ms old, for 10 ms", BRIEF, lambda x, s: x._replace(age=0.01)),
    Fault("noise", "1 % of v_max on v, 0.1 mrad on q", tell=noisy),
    Fault("bias", "1 % of v_max on v, 5 mrad on q", tell=biased),
    Fault("delay 1 ms", "state and u_des 1 ms late", tell=late(1, False)),
    Fault("delay 5 ms", "state and u_des 5 ms late", tell=late(5, False)),
    Fault("delay 5 ms, told", "the same, with `age`", tell=late(5, True)),
    Fault("u_des NaN", "u_des NaN for 10 ms", BRIEF, lambda x, s: x._replace(u_des=x.u_des * NAN)),
    Fault("u_des huge", "u_des 1e6 times too large for 50 ms", LONG, lambda x, s: x._replace(u_des=1e6 * x.u_des)),
    Fault("d_p NaN", "d_p NaN for 10 ms", BRIEF, lambda x, s: x._replace(d_p=NAN)),
    Fault("mass +20 %", "every link", plant=other(mass=1.0 + SHARE)),
    Fault("mass -20 %", "every link", plant=other(mass=1.0 - SHARE)),
    Fault("inertia +20 %", "every link", plant=other(inertia=1.0 + SHARE)),
    Fault("inertia -20 %", "every link", plant=other(inertia=1.0 - SHARE)),
    Fault("CoM +20 %", "every link's lever", plant=other(com=1.0 + SHARE)),
    Fault("CoM -20 %", "every link's lever", plant=other(com=1.0 - SHARE)),
    Fault("all by chance", "mass, inertia, CoM within 20 %", plant=shaken),
    Fault("payload", "10 % of the moving mass on the last link", plant=heavy),
    Fault("friction", "Coulomb, 5 % of u_max", plant=lambda r: perturbed(r, friction=FRICTION * r.u_max)),
    Fault("dropped ticks", "30 % of the steps", tell=dropping(0.3)),
    Fault("slow loop", "every fifth step only", tell=every(5)),
    Fault("obstacle moves", "at the arm with 0.1 m/s for 50 ms", LONG,
          world=lambda s: s.shifted(0.1 * s.since * s.dt, 0.1)),
    Fault("obstacle jumps", "1 cm at once", world=lambda s: s.shifted(0.01)),
    Fault("obstacle touches", "1 cm deep in the arm", LONG, world=lambda s: s.shifted(s.nearest[2] + 0.01)),
    Fault("obstacle NaN", "position NaN for 10 ms", BRIEF, misplaced([NAN, 0.0, 0.0])),
    Fault("obstacle unknown", "a name not in the world for 10 ms", BRIEF,
          lambda x, s: x._replace(motions={"no such obstacle": Motion()})),
    Fault("solver stalled", "no answer within its iterations, 10 ms", BRIEF, solver=lambda p, s: None),
    Fault("solver raises", "an exception, 10 ms", BRIEF, solver=failing),
    Fault("solver NaN", "NaN as answer, 10 ms", BRIEF, solver=wrong(lambda p: np.full(len(p.g), NAN))),
    Fault("solver false", "zero as solution, 10 ms", BRIEF, solver=wrong(lambda p: np.zeros(len(p.g)))),
    Fault("solver wild", "1e30 as solution, 10 ms", BRIEF, solver=wrong(lambda p: np.full(len(p.g), 1e30))),
    Fault("not converged", "half of the solution, 10 ms", BRIEF,
          solver=lambda p, s: None if (z := s.solve(p)) is None else 0.5 * z),
    Fault("L_g phi = 0", "no torque steers any row, 10 ms", BRIEF,
          barrier=rows(lambda r: replace(r, Lg_phi=0.0 * r.Lg_phi, w=0.0 * r.w))),
    Fault("network NaN", "phi and its gradient NaN, 10 ms", BRIEF,
          barrier=rows(lambda r: replace(r, phi=NAN * r.phi, Lf_phi=NAN * r.Lf_phi, Lg_phi=NAN * r.Lg_phi))),
)  # fmt: skip
