"""``ppcbf simulate``: one closed-loop run with or without a filter."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.progress import track

from ppcbf_robots.artefact import load_barrier
from ppcbf_robots.barriers import Barrier
from ppcbf_robots.cli.output import JsonOption, RobotArgument, WorldArgument, emit_json, err, out, warn
from ppcbf_robots.engines import Engine, EngineName
from ppcbf_robots.errors import CheckFailed, InputError
from ppcbf_robots.filters import FilterConfig, FilterKind, Metric
from ppcbf_robots.problem import Problem, load_problem, parse_vector
from ppcbf_robots.resources import portable
from ppcbf_robots.robot import RobotModel
from ppcbf_robots.rollout import RK4_STEP, Trajectory
from ppcbf_robots.rollout import simulate as rollout
from ppcbf_robots.safety_filter import SafetyFilter
from ppcbf_robots.specs import Array, vector

BarrierOption = Annotated[str, typer.Option(help="Barrier folder, or lb-cbf, pp-cbf, none.")]
FilterOption = Annotated[
    FilterKind | None, typer.Option(help="Default: what the barrier was trained for; pp-cbf closed-form, others qp.")
]
MetricOption = Annotated[Metric | None, typer.Option(help="Default: what the barrier was trained for, else kinetic.")]
EngineOption = Annotated[
    EngineName, typer.Option(help="mujoco: another simulator, in which the robot can touch the obstacles.")
]
EffortRateOption = Annotated[
    float | None, typer.Option(help="How fast torques may change [N m/s]; else the robot spec's `effort_rate`.")
]


def simulate(
    robot: RobotArgument,
    obstacles: WorldArgument,
    barrier: BarrierOption = "lb-cbf",
    filter: FilterOption = None,
    metric: MetricOption = None,
    solver: Annotated[
        str, typer.Option(help="daqp, proxqp, or a solver installed for qpsolvers.")
    ] = FilterConfig.solver,
    start: Annotated[str | None, typer.Option(metavar="Q,...", help="One number per moving joint.")] = None,
    velocity: Annotated[str | None, typer.Option(metavar="V,...", help="Start velocity.")] = None,
    goal: Annotated[str | None, typer.Option(metavar="Q,...", help="One number per moving joint.")] = None,
    duration: Annotated[float, typer.Option(min=0.001, max=3600.0, help="Simulated seconds.")] = 10.0,
    rate: Annotated[float, typer.Option(min=10.0, max=2000.0, help="Control rate [Hz].")] = 1000.0,
    effort_rate: EffortRateOption = None,
    engine: EngineOption = "pinocchio",
    out_file: Annotated[Path, typer.Option("--out", metavar="T.npz")] = Path("trajectory.npz"),
    json: JsonOption = False,
) -> None:
    """Simulate the filtered arm and write the trajectory.

    Example: ppcbf simulate panda sphere --barrier runs/panda --duration 5 --out runs/panda.npz
    """
    problem = limit_rate(load_problem(robot, obstacles), effort_rate)
    model = problem.model
    q = _angles(problem, start, "--start", problem.robot.start)
    given = parse_vector(velocity, "--velocity")
    rest = start is not None  # the spec's start velocity belongs to the spec's start
    v = vector(given, model.nv, "--velocity") if given is not None else problem.robot.start_velocity * (not rest)
    if goal is not None:
        problem = problem.with_goal(_angles(problem, goal, "--goal", problem.robot.goal))
    problem.check_start(q)
    warn([*model.warnings, *problem.blocked_goal()])
    if out_file.is_dir():
        raise InputError(f"--out: {out_file} is a folder; give a file such as {out_file}/trajectory.npz")
    dt = RK4_STEP * max(1, round(1.0 / (rate * RK4_STEP)))  # whole integration steps
    if abs(dt * rate - 1.0) > 1e-6:
        err.print(f"--rate {rate:g} is rounded to {1.0 / dt:.5g} Hz, whole integration steps of {RK4_STEP} s")
    chosen, config = choose_barrier(problem, barrier, filter, metric, solver, dt)
    trajectory = run(problem, chosen, config, q, v, duration, {"barrier": barrier}, engine)
    trajectory.save(out_file)
    facts = trajectory.summary(model) | {"outside_domain": outside_domain(problem, trajectory), "out": str(out_file)}
    said = certificate_line(problem, barrier, config, problem.model.to_angles(problem.robot.goal).tolist())
    facts |= {"certificate": said}
    emit_json(facts) if json else _print(facts, trajectory, problem)
    if chosen is not None and facts["outside_domain"] > 0.0:
        err.print(
            f"warning: {facts['outside_domain']:.1%} of the states lie outside X, where nothing was trained or checked"
        )
    if not trajectory.meta["complete"]:
        raise CheckFailed(f"the simulation diverged at {trajectory.t[-1]:.3f} s; {out_file} holds what there is")


def limit_rate(problem: Problem, effort_rate: float | None) -> Problem:
    """The problem just loaded with another limit of how fast every torque may change [N m/s | N/s]."""
    if effort_rate is not None:
        if not 0.0 < effort_rate < math.inf:
            raise InputError(f"--effort-rate: must be a positive finite number, got {effort_rate:g}")
        problem.model.u_rate = np.full(problem.model.nv, effort_rate)
    return problem


def outside_domain(problem: Problem, trajectory: Trajectory) -> float:
    """Share of a trajectory's states outside X (angles of continuous joints are taken as they wrap)."""
    domain, q = problem.robot.domain, problem.model.to_angles(trajectory.q)
    out_q = (q < domain.q[:, 0] - 1e-9) | (q > domain.q[:, 1] + 1e-9)
    out_v = (trajectory.v < domain.v[:, 0] - 1e-9) | (trajectory.v > domain.v[:, 1] + 1e-9)
    return float(np.mean((out_q | out_v).any(axis=1)))


def certificate_line(problem: Problem, name: str, config: FilterConfig, goal: Sequence[float] | None) -> str | None:
    """What the certificate of a barrier folder says, and about what else if not this; None for other barriers.

    ``goal`` has one number per joint; None stands for many goals.
    """
    if not Path(name).is_dir():
        return None
    certificate = load_barrier(Path(name)).certificate
    if certificate is None:
        return "none; ppcbf verify makes one"
    limited = bool(np.isfinite(problem.model.u_rate).any())
    gap = certificate.gap(goal, config.kind, config.metric, config.alpha, config.margin, config.dt, limited)
    subject = "these runs" if goal is None else "this run"
    return certificate.line() + (f"; {gap}, not for {subject}" if gap else "")


def choose_barrier(
    problem: Problem,
    name: str,
    kind: FilterKind | None,
    metric: Metric | None,
    solver: str = FilterConfig.solver,
    dt: float = 1e-3,
) -> tuple[Barrier | None, FilterConfig]:
    """A barrier by name or folder, and the filter settings that go with it unless others are asked for."""
    if name == "none":
        return None, FilterConfig(dt=dt)
    if name == "lb-cbf" or name == "pp-cbf":
        kind = kind or ("closed-form" if name == "pp-cbf" else "qp")  # the PP-CBF knows nothing of a torque box
        return problem.barrier(name), FilterConfig(kind=kind, metric=metric or "kinetic", solver=solver, dt=dt)
    if not Path(name).is_dir():
        raise InputError(f"--barrier: '{name}' is neither a barrier folder nor one of lb-cbf, pp-cbf, none")
    stored = load_barrier(Path(name))
    asked = {k: x for k, x in (("kind", kind), ("metric", metric)) if x is not None}
    config = stored.filter_config(solver=solver, dt=dt, **asked)
    return stored.barrier(problem), config


def run(
    problem: Problem,
    barrier: Barrier | None,
    config: FilterConfig,
    q: Array,
    v: Array,
    duration: float,
    meta: dict[str, Any],
    engine: EngineName = "pinocchio",
) -> Trajectory:
    """A rollout with a progress bar; meta names robot, world, barrier and filter."""
    moved_by = mujoco_engine(problem) if engine == "mujoco" else None
    runtime = None
    if barrier is not None:
        runtime = SafetyFilter(problem.model, problem.safety, barrier, config, problem.robot.controller.gains.kd)
    ticks = iter(track(range(max(1, round(duration / config.dt) // 50)), "simulating", console=err, transient=True))
    trajectory = rollout(
        problem.safety, problem.robot.controller, runtime, q, v, duration, config.dt,
        described(problem, barrier, config) | meta, on_step=lambda t: next(ticks, None), engine=moved_by,
    )  # fmt: skip
    for _ in ticks:
        pass
    return trajectory


def described(problem: Problem, barrier: Barrier | None, config: FilterConfig) -> dict[str, Any]:
    """What a trajectory's meta says of how it was made."""
    return {
        "robot": portable(problem.robot.name),
        "obstacles": portable(problem.world_name),
        "barrier_kind": barrier.kind if barrier else "none",
        "filter": config.kind if barrier else "none",
        "metric": config.metric if barrier else "none",
    }


def mujoco_engine(problem: Problem, plant: RobotModel | None = None) -> Engine:
    """MuJoCo with the problem's robot, or another plant; InputError where it is not installed."""
    try:
        from ppcbf_robots.engine_mujoco import MujocoEngine  # MuJoCo only where it is asked for
    except ModuleNotFoundError as error:
        if error.name != "mujoco":
            raise
        raise InputError(
            '--engine mujoco needs the mujoco package; remedy: pip install "ppcbf-robots[mujoco]"'
        ) from None
    return MujocoEngine(problem, plant)


def _angles(problem: Problem, text: str | None, what: str, default: Array) -> Array:
    values = parse_vector(text, what)
    return default if values is None else problem.model.parse_angles(values, what)


def _print(facts: dict[str, Any], trajectory: Trajectory, problem: Problem) -> None:
    meta = trajectory.meta
    out.print(
        f"{problem.robot.name} in {problem.world_name}: {meta['barrier_kind']}, {meta['filter']}, {meta['metric']}"
        + (f"; engine {meta['engine']}" if meta["engine"] != "pinocchio" else "")
    )
    out.print(f"least h            {facts['min_h']:.4f}  (without joint limits {facts['clearance']:.4f} m)")
    out.print(f"largest torque     {facts['max_torque_ratio']:.3f} of its limit")
    if facts["rate_violations"] is not None:
        over = f", over it in {facts['rate_violations']} steps" if facts["rate_violations"] else ""
        out.print(f"fastest torque     {facts['max_rate_ratio']:.3f} of its rate limit{over}")
    out.print(
        f"energy             rises by {facts['energy_rise']:.2g} of V0, {facts['injected']:.3g} J injected in all"
    )
    if (end := trajectory.ending()) is not None:
        out.print(f"end                {end.text()}")
    if meta["contacts"] is not None:
        _print_contacts(meta["contacts"], len(trajectory.t))
    if facts["certificate"] is not None:
        out.print(f"certificate        {facts['certificate']}")
    out.print("filter             " + ", ".join(f"{k} {n}" for k, n in facts["filter_counts"].items()))
    out.print(f"wrote {facts['out']}; look at it with: ppcbf view {facts['out']}")


def _print_contacts(contacts: dict[str, Any], steps: int) -> None:
    out.print(f"CONTACT            in {contacts['steps']} of {steps} steps" if contacts["steps"]
              else "contact            none")  # fmt: skip
    if contacts["hull_steps"]:
        out.print(f"                   in {contacts['hull_steps']} more steps only a mesh's convex hull touches")
    for c in contacts["pairs"]:
        pair, depth = f"{c['link']} / {c['obstacle']}", 1e3 * c["depth"]
        hull = ", the hull alone" if c["hull_only"] else ""
        out.print(f"                   {pair} from {c['first']:.3f} s, {depth:.2g} mm deep{hull}")
