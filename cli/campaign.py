"""``ppcbf campaign``: many random runs of the filtered arm, and what went wrong in them."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json as json_module
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from ppcbf_robots.artefact import load_barrier
from ppcbf_robots.barriers import Barrier
from ppcbf_robots.campaign import Drawing, draw, outcome, run_cases, total
from ppcbf_robots.cli.output import JsonOption, RobotArgument, WorldArgument, alarms_expected, emit_json, out, table
from ppcbf_robots.cli.simulate import (
    BarrierOption,
    EffortRateOption,
    EngineOption,
    FilterOption,
    MetricOption,
    certificate_line,
    choose_barrier,
    described,
    limit_rate,
    mujoco_engine,
)
from ppcbf_robots.cli.tasks import DaskOption, all_results, run_tasks
from ppcbf_robots.engines import EngineName
from ppcbf_robots.errors import CheckFailed, InputError
from ppcbf_robots.filters import FilterConfig, FilterKind, Metric
from ppcbf_robots.problem import Problem, load_problem
from ppcbf_robots.resources import portable
from ppcbf_robots.results_file import Record
from ppcbf_robots.rollout import Trajectory
from ppcbf_robots.sweep import Task

CHUNK = {"pinocchio": 50, "mujoco": 10}  # runs of one task
SUMMARY, WORST = "campaign.json", "worst.npz"


@dataclass(frozen=True)
class Chunk:
    """Some of a campaign's runs; small and picklable, so that any worker can do them."""

    robot: str  # names or absolute paths, as the worker may run in another folder
    world: str
    barrier: str
    filter: FilterKind | None
    metric: Metric | None
    engine: EngineName
    effort_rate: float | None
    drawing: Drawing
    numbers: range

    def load(self) -> tuple[Problem, Barrier | None, FilterConfig]:
        """What the runs are about; kept for the next chunk of the same process."""
        return _load(self.robot, self.world, self.barrier, self.filter, self.metric, self.effort_rate)

    def trajectories(self) -> Iterator[tuple[Any, Trajectory]]:
        """Every case with its run."""
        problem, barrier, config = self.load()
        cases = [draw(problem, barrier, self.drawing, index) for index in self.numbers]
        meta = {**described(problem, barrier, config), "barrier": self.barrier}
        meta["campaign"] = dataclasses.asdict(self.drawing)
        other = functools.partial(mujoco_engine, problem) if self.engine == "mujoco" else None
        runs = run_cases(problem, barrier, config, cases, self.drawing.duration, other, meta)
        for index, case, run in zip(self.numbers, cases, runs, strict=True):
            run.meta["case"] = index
            run.meta["pushes"] = [{**dataclasses.asdict(p), "torque": p.torque.tolist()} for p in case.pushes]
            yield case, run

    @alarms_expected()
    def run(self) -> dict[str, Any]:
        """Figures of every run, as JSON."""
        began = time.process_time()
        problem, _, _ = self.load()
        outcomes = [outcome(problem, case, run) for case, run in self.trajectories()]
        return {"outcomes": outcomes, "seconds": round(time.process_time() - began, 3)}

    def task(self) -> Task:
        """The task of a sweep; its key holds all that the outcome depends on, much of it as a hash."""
        problem, _, config = self.load()
        folder = Path(self.barrier)
        trained = (folder / "barrier.json").read_text(encoding="utf-8") if folder.is_dir() else self.barrier
        facts = [problem.fingerprint(), problem.robot.spec.barrier.model_dump(), trained, dataclasses.asdict(config),
                 problem.model.u_rate.tolist()]  # fmt: skip
        key = {
            "robot": self.robot,
            "world": self.world,
            "barrier": self.barrier,
            "engine": self.engine,
            "effort_rate": self.effort_rate,
            **dataclasses.asdict(self.drawing),
            "first": self.numbers.start,
            "count": len(self.numbers),
            "identity": hashlib.sha256(json_module.dumps(facts, sort_keys=True).encode()).hexdigest()[:16],
        }
        return Task(key, self.run)


@functools.lru_cache(maxsize=1)
def _load(
    robot: str, world: str, barrier: str, kind: FilterKind | None, metric: Metric | None, effort_rate: float | None
) -> tuple[Problem, Barrier | None, FilterConfig]:
    problem = limit_rate(load_problem(robot, world), effort_rate)
    return problem, *choose_barrier(problem, barrier, kind, metric)


def campaign(
    robot: RobotArgument,
    obstacles: WorldArgument,
    rollouts: Annotated[int, typer.Option(min=1, max=1_000_000, help="Number of runs.")] = 100,
    barrier: BarrierOption = "lb-cbf",
    filter: FilterOption = None,
    metric: MetricOption = None,
    engine: EngineOption = "pinocchio",
    duration: Annotated[float, typer.Option(min=0.01, max=600.0, help="Simulated seconds of each run.")] = 5.0,
    pushes: Annotated[
        bool, typer.Option("--pushes", help="Push the arm 1 to 3 times a run; a joint gains up to 10 % of v_max.")
    ] = False,
    mass_error: Annotated[
        float,
        typer.Option(min=0.0, max=90.0, metavar="PERCENT", help="Links heavier or lighter than the filter's model."),
    ] = 0.0,
    effort_rate: EffortRateOption = None,
    jobs: Annotated[int, typer.Option(min=1, help="Processes at once on this machine, one core each.")] = 1,
    dask: DaskOption = None,
    seed: Annotated[int, typer.Option(min=0, help="Of starts, goals, pushes and masses.")] = 0,
    replay: Annotated[
        int | None, typer.Option(min=0, metavar="N", help="Run case N alone and write its trajectory to --out.")
    ] = None,
    out_path: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Folder for results, by default ./campaign; with --replay, T.npz."),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Run the filtered arm from random safe states to random goals and count what must not happen.

    Results are kept in DIR/results.jsonl as they arrive; the same command goes on after an interrupt. DIR/campaign.json
    has the figures, DIR/worst.npz the run of least h. Exits with 3, after the table, if a run touched something, left a
    torque, rate or joint limit, or diverged.

    Example: ppcbf campaign panda five_spheres --rollouts 1000 --jobs 2 --out runs/campaign
    """
    if Path(barrier).is_dir():
        barrier = str(Path(barrier).resolve())
    drawing = Drawing(seed, duration, pushes, mass_error / 100.0)
    whole = Chunk(
        portable(robot), portable(obstacles), barrier, filter, metric, engine, effort_rate, drawing, range(rollouts)
    )
    problem, chosen, _ = whole.load()
    draw(problem, chosen, drawing, 0)  # what cannot be drawn is said at once
    if engine == "mujoco":
        mujoco_engine(problem)
    if replay is not None:
        _replay(dataclasses.replace(whole, numbers=range(replay, replay + 1)), out_path or Path("trajectory.npz"), json)
        return
    folder = out_path or Path("campaign")
    if folder.suffix in (".json", ".jsonl", ".npz"):
        raise InputError(f"--out: expected a folder, got {folder}; the figures go to FOLDER/{SUMMARY}")
    size = CHUNK[engine]
    parts = [range(i, min(i + size, rollouts)) for i in range(0, rollouts, size)]
    tasks = [dataclasses.replace(whole, numbers=part).task() for part in parts]
    records = run_tasks(tasks, folder, jobs, dask, "rollouts")
    all_results(records, "parts")
    facts = _facts(whole, records)
    worst = dataclasses.replace(whole, numbers=range(facts["worst"]["min_h"], facts["worst"]["min_h"] + 1))
    _write(folder, facts, worst)
    emit_json(facts) if json else _print(problem, facts, folder)
    if facts["failed"]:
        raise CheckFailed(f"{len(facts['failed'])} of {rollouts} runs broke what must hold; the figures say what")


def _facts(whole: Chunk, records: Sequence[Record]) -> dict[str, Any]:
    outcomes = {}
    for record in records:
        outcomes.update(enumerate(record["result"]["outcomes"], start=record["key"]["first"]))
    problem, barrier, config = whole.load()
    made = {**described(problem, barrier, config), "barrier": whole.barrier, "engine": whole.engine}
    made["effort_rate"] = whole.effort_rate
    made["certificate"] = certificate_line(problem, whole.barrier, config, None)
    made["barrier_sha256"] = load_barrier(Path(whole.barrier)).digest if Path(whole.barrier).is_dir() else None
    seconds = round(sum(record["result"]["seconds"] for record in records), 1)
    return {**made, **dataclasses.asdict(whole.drawing), **total(outcomes), "seconds": seconds}


@alarms_expected()
def _write(folder: Path, facts: dict[str, Any], worst: Chunk) -> None:
    """The figures, by an atomic rename, and the worst run."""
    [(_, run)] = worst.trajectories()
    run.save(folder / WORST)
    temporary = folder / f".{SUMMARY}.tmp"
    try:
        temporary.write_text(json_module.dumps(facts, indent=1), encoding="utf-8")
        temporary.replace(folder / SUMMARY)
    except OSError as error:
        raise InputError(f"{folder / SUMMARY}: cannot be written ({error.strerror})") from None


def _replay(one: Chunk, path: Path, json: bool) -> None:
    if path.is_dir():
        raise InputError(f"--out: {path} is a folder; give a file such as {path}/trajectory.npz")
    problem, _, _ = one.load()
    [(case, run)] = one.trajectories()
    run.save(path)
    facts = {"case": one.numbers.start, **outcome(problem, case, run), "out": str(path)}
    if json:
        emit_json(facts)
        return
    out.print(f"case {facts['case']}: least h {facts['min_h']:.5f}, torque at most {facts['torque']:.3f} of its limit")
    if (end := run.ending()) is not None:
        out.print(f"end  {end.text()}")
    out.print(f"wrote {path}; look at it with: ppcbf view {path}")


def _print(problem: Problem, facts: dict[str, Any], folder: Path) -> None:
    given = ["pushes of up to 10 % of v_max"] if facts["pushes"] else []
    given += [f"masses off by up to {facts['mass_error']:.0%}"] if facts["mass_error"] else []
    title = f"{problem.robot.name} in {problem.world_name}: {facts['rollouts']} runs of {facts['duration']:g} s"
    title += f", {facts['barrier_kind']}, {facts['filter']}, {facts['engine']}" + "".join(f", {x}" for x in given)
    worst = facts["worst"]
    torque = f"(most {facts['max_torque_ratio']:.4f} of it, run {worst['torque']})"
    rise = f"(run {worst['largest_rise']}; median {facts['median_rise']:.2g})"
    rows = [
        ["runs with a contact", str(facts["contacts"])],
        ["runs beyond a torque limit", f"{facts['torque_violations']} {torque}"],
        ["runs beyond a torque rate limit", str(facts["rate_violations"])],
        ["runs beyond a joint limit", str(facts["limit_violations"])],
        ["runs that diverged", str(facts["diverged"])],
        ["least h", f"{facts['min_h']:.6f} (run {worst['min_h']}; median of the runs {facts['median_min_h']:.4f})"],
        ["least clearance [m]", f"{facts['min_clearance']:.6f}"],
        ["most energy above V0 and pushes [J]", f"{facts['max_above_V0']:.3g}"],
        ["the same as a share of V0", f"{facts['max_above_V0_share']:.2g}"],
        ["largest rise of V [J]", f"{facts['max_rise']:.3g} {rise}"],
        ["steps without a solution", str(facts["qp_failures"])],
        ["steps below the full QP", str(facts["fallbacks"])],
        ["ended at the goal", str(facts["goals_reached"])],
        ["ended held by an obstacle or limit", str(facts["resting"])],
        ["ended at rest elsewhere", str(facts["stalled"])],
        ["still moving", str(facts["moving"])],
        ["CPU time [s]", f"{facts['seconds']:.1f}"],
    ]  # fmt: skip
    table(title, ["what", "figure"], rows)
    if facts["certificate"] is not None:
        out.print(f"certificate: {facts['certificate']}")
    if facts["failed"]:
        shown = ", ".join(map(str, facts["failed"][:10])) + (", ..." if len(facts["failed"]) > 10 else "")
        out.print(f"failed: {shown}; the same command with --replay N --out T.npz writes one of them")
    out.print(f"wrote {folder / SUMMARY} and {folder / WORST}; look at the run of least h: ppcbf view {folder / WORST}")
