"""One robot in one world with its controller: everything a barrier, a filter or a rollout is about."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ppcbf_robots.barriers import Barrier, BarrierKind, EnergyBarrier, RhoBarrier
from ppcbf_robots.body import body_spheres
from ppcbf_robots.controllers import NominalController
from ppcbf_robots.derive import SAMPLE_SEED, Domain, derive_domain, derive_gains
from ppcbf_robots.derive_body import Body, derive_body, derive_fixed
from ppcbf_robots.errors import InputError
from ppcbf_robots.network import NumpyNetwork
from ppcbf_robots.resources import default_package_dirs, find_example, find_robot, find_world, is_file
from ppcbf_robots.robot import RobotModel
from ppcbf_robots.safety import SafetyFunction
from ppcbf_robots.self_collision import self_pairs
from ppcbf_robots.specs import Array, BarrierSpec, BodySphere, RobotSpec, load_spec, vector
from ppcbf_robots.world import Obstacle, WorldSpec
from ppcbf_robots.world_files.load import load_world

CLEAR = 0.05  # [m | rad] of everything, where a start or goal is looked for,
ATTAINABLE = 0.2  # or this share of what a row ever has: a shoulder may always be closer to the floor
COARSE = 0.1  # [m], overestimate of what is fixed to the base, that is told
APART = 0.2  # shares of X, between start and goal
TRIED = 2_000  # configurations among which it is
POSTURES = 500  # in which spheres of the body are looked at for overlap
GUARDED = 0.99  # of X's velocities, where the filter's rows hold them: room for what happens within a control period


@dataclass(frozen=True)
class Robot:
    """A robot as specified and derived, before any world."""

    name: str  # as the user wrote it
    model: RobotModel
    spec: RobotSpec
    body: list[BodySphere]
    domain: Domain
    controller: NominalController
    start: Array  # (nq,)
    start_velocity: Array  # (nv,)
    derived: list[str]  # what was not in the spec and was derived
    self_pairs: list[tuple[int, int]]  # spheres that must not touch each other; those of `fixed` follow the body's
    fixed: Body  # what no joint moves, if self-collision is asked for
    cover: Body | None = None  # how the body was fitted, if it was

    @property
    def goal(self) -> Array:
        """Goal configuration (nq,)."""
        return self.controller.goal

    def safety(self, obstacles: Sequence[Obstacle]) -> SafetyFunction:
        """Its safety function among obstacles, with the bounds of X as rows if the spec guards them."""
        q, v = (self.domain.q, GUARDED * self.domain.v) if self.spec.domain.guard else (None, None)
        return SafetyFunction(self.model, self.body, obstacles, True, q, v, self.self_pairs, self.fixed.spheres)


@dataclass(frozen=True)
class Problem:
    """A robot, a world and the safety function of the two."""

    robot: Robot
    world_name: str
    world: WorldSpec
    safety: SafetyFunction

    @property
    def model(self) -> RobotModel:
        """The robot's model."""
        return self.robot.model

    def barrier(
        self, kind: BarrierKind, network: NumpyNetwork | None = None, spec: BarrierSpec | None = None
    ) -> Barrier:
        """A barrier of one of the four kinds with the robot's constants, or with those of ``spec``."""
        spec = spec or self.robot.spec.barrier
        return EnergyBarrier(spec) if kind == "pp-cbf" else RhoBarrier(kind, self.model, spec, network)

    def with_goal(self, goal: Array) -> Problem:
        """The same problem towards another goal (nq,)."""
        robot = dataclasses.replace(self.robot, controller=self.robot.controller.with_goal(goal))
        return dataclasses.replace(self, robot=robot)

    def with_barrier_spec(self, spec: BarrierSpec) -> Problem:
        """The same problem with other barrier constants."""
        robot = dataclasses.replace(self.robot, spec=self.robot.spec.model_copy(update={"barrier": spec}))
        return dataclasses.replace(self, robot=robot)

    def attainable(self, clear: float) -> Array:
        """(rows,): ``clear`` [m | rad], or a fifth of the largest h that a row has in random configurations of X."""
        return np.clip(ATTAINABLE * self._largest_h, 0.0, clear)

    @functools.cached_property
    def _largest_h(self) -> Array:
        angles = self.robot.domain.sample_q(np.random.default_rng(SAMPLE_SEED), TRIED)
        return np.asarray(self.safety.first_order(self.model.from_angles(angles))[0].max(axis=0))

    def check_start(self, q: Array) -> None:
        """Refuse a start configuration inside an obstacle or beyond a joint limit."""
        h, row = self.safety.least(q)
        if h < 0.0:
            raise InputError(
                f"the start configuration violates '{row}' by {-h:.4f}: give another with --start or in the spec"
            )

    def blocked_goal(self) -> list[str]:
        """What to tell of a goal that violates a row; empty where it does not."""
        h, row = self.safety.least(self.robot.goal)
        return [] if h >= 0.0 else [f"the goal violates '{row}' by {-h:.4f}: the arm will rest before it"]

    def fingerprint(self) -> dict[str, str]:
        """SHA-256 of what a barrier depends on: URDF, robot parameters, controller and domain, world."""
        m = self.model
        robot = {
            "joints": m.joint_names,
            "locked": m.locked,
            "u_max": m.u_max.tolist(),
            "v_max": m.v_max.tolist(),
            **({"position": self.robot.spec.position} if self.robot.spec.position else {}),
            "payload": None if self.robot.spec.payload is None else self.robot.spec.payload.model_dump(),
            "body": [s.model_dump() for s in self.robot.body],
            **({"self_pairs": self.robot.self_pairs} if self.robot.self_pairs else {}),
            **({"fixed": [s.model_dump() for s in self.robot.fixed.spheres]} if self.robot.fixed.spheres else {}),
        }
        gains, domain = self.robot.controller.gains, self.robot.domain
        task = {
            "controller": [gains.kind, *(_rounded(x) for x in (gains.kp, gains.kd, gains.max_spring))],
            "domain": [_rounded(domain.q), _rounded(domain.v), self.robot.spec.domain.guard],
        }
        world = [o.model_dump() for o in self.world.obstacles]
        digest = {
            k: hashlib.sha256(json.dumps(x, sort_keys=True).encode()).hexdigest()
            for k, x in (("robot", robot), ("task", task), ("world", world))
        }
        return {"urdf": m.urdf_sha256, **digest}


def _rounded(x: Array) -> list[str]:
    """Six digits: derived numbers differ in the last ones from machine to machine."""
    return [f"{y:.6g}" for y in x.ravel()]


def load_robot(name: str) -> Robot:
    """A robot from a bundled name, a YAML spec, a URDF path or a name in example-robot-data.

    Raises:
        InputError: for anything the method cannot use, with the remedy.
    """
    path = find_robot(name)
    if path.suffix in (".yaml", ".yml"):
        spec = load_spec(path, RobotSpec, "robot spec")
        urdf = _spec_urdf(path, spec)
    else:
        spec, urdf = RobotSpec(urdf=str(path)), path
    dirs = [(path.parent / d).resolve() for d in spec.package_dirs] + default_package_dirs(urdf)
    model = RobotModel(
        urdf, dirs, spec.locked, spec.effort, spec.velocity, spec.payload, spec.moving, spec.position, spec.effort_rate
    )
    model.warnings += [spec.note] if spec.note else []
    start, goal = (None if x is None else vector(x, model.nv, f"{path}: {what}")
                   for what, x in (("start", spec.start), ("goal", spec.goal)))  # fmt: skip
    domain = derive_domain(model, spec.domain, [x for x in (start, goal) if x is not None])
    model.check_mass_matrix(domain.sample_q(np.random.default_rng(SAMPLE_SEED), 100))
    derived = [k for k in ("controller", "body", "start", "goal") if getattr(spec, k) is None]
    derived += [f"domain.{k}" for k in ("q", "v") if getattr(spec.domain, k) is None]
    model.points([s.frame for s in spec.body or []], np.array([s.center for s in spec.body or []]))  # the frames exist
    cover = derive_body(model) if spec.body is None else None
    body = body_spheres(spec.body or []) if cover is None else cover.spheres
    start = _default_start(model, domain) if start is None else start
    goal = _default_goal(start, domain) if goal is None else goal
    velocity = spec.start_velocity or [0.0] * model.nv
    gains = derive_gains(model, spec.controller, domain)
    controller = NominalController(model, gains, model.from_angles(goal))
    start_velocity = vector(velocity, model.nv, f"{path}: start_velocity")
    cover = cover if cover and cover.links else None
    q_start = model.from_angles(start)
    fixed, pairs = _self_collision(model, spec, path, body, domain, q_start)
    return Robot(name, model, spec, body, domain, controller, q_start, start_velocity, derived, pairs, fixed, cover)


def _self_collision(
    model: RobotModel, spec: RobotSpec, path: Path, body: Sequence[BodySphere], domain: Domain, start: Array
) -> tuple[Body, list[tuple[int, int]]]:
    """What is fixed to the base, and the pairs of spheres that keep off each other: nothing if it is not asked for."""
    if spec.self_collision is None:
        return Body(spheres=[], links=[]), []
    fixed, srdf = derive_fixed(model), spec.self_collision.srdf
    file = None if srdf is None else path.parent / srdf
    postures = model.from_angles(domain.sample_q(np.random.default_rng(SAMPLE_SEED), POSTURES))
    given = None if spec.start is None else start
    pairs = self_pairs(model, body, fixed.spheres, given, postures, file, fitted=spec.body is None)
    model.warnings += [
        f"link '{x.link}' is fixed to the base, and the spheres that keep off it reach {x.largest:.2f} m beyond: "
        "a box among the obstacles fits closer"
        for x in fixed.links if x.largest > COARSE
    ]  # fmt: skip
    return fixed, pairs


def load_problem(robot: str, world: str) -> Problem:
    """A robot and a world by name or path; InputError where they do not fit.

    A derived start or goal that violates a row of this world gives way to the nearest of some random configurations
    that do not.
    """
    loaded = load_robot(robot)
    spec = load_world(find_world(world))
    problem = Problem(loaded, world, spec, loaded.safety(spec.obstacles))
    if "start" in loaded.derived and (start := _clear_one(problem, loaded.start, "start", None)) is not None:
        problem = dataclasses.replace(problem, robot=dataclasses.replace(loaded, start=start))
    if "goal" in loaded.derived and (goal := _clear_one(problem, loaded.goal, "goal", problem.robot.start)) is not None:
        problem = problem.with_goal(goal)
    return problem


def _clear_one(problem: Problem, q: Array, what: str, other: Array | None) -> Array | None:
    """The clear configuration (nq,) nearest to q and apart from ``other``, or None where q is clear; with a warning."""
    model, domain = problem.model, problem.robot.domain
    h, row = problem.safety.least(q)
    if h >= 0.0:
        return None
    angles = domain.sample_q(np.random.default_rng(SAMPLE_SEED), TRIED)

    def way(to: Array) -> Array:
        """(TRIED,): length of the way between the configurations and one of them, in shares of X."""
        change = angles - model.to_angles(to)
        change = np.where(model.continuous, (change + np.pi) % (2.0 * np.pi) - np.pi, change)
        return np.asarray(np.linalg.norm(change / np.ptp(domain.q, axis=1), axis=1))

    rows, apart = problem.safety.first_order(model.from_angles(angles))[0], other is None or way(other) >= APART
    clear = apart & np.all(rows >= problem.attainable(CLEAR), axis=1)
    clear = clear if clear.any() else apart & np.all(rows >= 0.0, axis=1)
    said = f"the {what} that suits most worlds violates '{row}' by {-h:.4f}"
    if not clear.any():
        model.warnings.append(f"{said}, and none of {TRIED:,} others is clear: give one")
        return None
    model.warnings.append(f"{said}: another one was taken")
    return model.from_angles(angles[np.argmin(np.where(clear, way(q), np.inf))])


def _spec_urdf(path: Path, spec: RobotSpec) -> Path:
    """The URDF of a spec: relative to the spec's folder, else a name in example-robot-data."""
    found = path.parent / spec.urdf if is_file(path.parent / spec.urdf) else find_example(spec.urdf)
    if found is None:
        raise InputError(
            f"{path}: urdf: neither the file {str(path.parent / spec.urdf)[:300]} nor a URDF of example-robot-data"
        )
    return found


def _default_start(model: RobotModel, domain: Domain) -> Array:
    """Zero where X allows it, else the middle of X."""
    zero = np.zeros(model.nv)
    inside = (domain.q[:, 0] < zero) & (zero < domain.q[:, 1])
    return np.where(inside, zero, domain.q.mean(axis=1))


def _default_goal(start: Array, domain: Domain) -> Array:
    """The start moved by at most 0.8 rad towards the farther bound of X, joint by joint."""
    room_up, room_down = domain.q[:, 1] - start, start - domain.q[:, 0]
    step = np.minimum(0.8, 0.5 * np.maximum(room_up, room_down))
    return np.asarray(start + np.where(room_up >= room_down, step, -step))


def parse_vector(text: str | None, what: str) -> Sequence[float] | None:
    """Numbers of a comma separated option, or None if it was not given."""
    if text is None:
        return None
    try:
        return [float(x) for x in text.replace(" ", "").split(",") if x]
    except ValueError:
        raise InputError(f"{what}: expected numbers separated by commas, got '{text}'") from None
