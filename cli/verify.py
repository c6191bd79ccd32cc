"""``ppcbf verify``: a certificate for a trained barrier."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import typer
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from ppcbf_robots.artefact import StoredBarrier, load_barrier
from ppcbf_robots.band_tasks import BandJob, attack_tasks, conditions, sample_tasks
from ppcbf_robots.certificate import Certificate, Condition, digest, overall, save_certificate, subject, suffix
from ppcbf_robots.cli.extras import needs
from ppcbf_robots.cli.output import JsonOption, emit_json, err, out, table
from ppcbf_robots.cli.tasks import all_results, finite
from ppcbf_robots.errors import CheckFailed, InputError
from ppcbf_robots.problem import Problem, load_problem
from ppcbf_robots.results_file import Record
from ppcbf_robots.sweep import run_sweep

Method = Literal["auto", "proof", "samples"]
RECORDS = "verify.jsonl"  # of unfinished samples, in the barrier's folder
MODEL = "errors of the model: masses, friction, delays, noise"
MASSES = (
    "other errors of the model: mass and inertia of a link by different factors, centres of mass, friction, delays, "
    "noise; that the filter, which knows the model alone, finds the torque that serves all robots; what the energy of "
    "those does, whose gravity the controller does not know"
)
NEVER = [
    "states outside X, below phi = 0, or above the band",
    "the rows that keep the velocity domain: the filter gives them up first",
    "obstacles that move, limits of the torque's rate, and what happens between two control instants",
    MODEL,
    "another goal or controller than the one named under `subject`, as far as passivity is concerned",
]


def verify(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Barrier folder.")],
    method: Annotated[
        Method, typer.Option(help="auto: a proof where there can be one (one or two joints), else samples.")
    ] = "auto",
    power: Annotated[
        float,
        typer.Option(min=0.0, help="Allowed in the passivity row beyond what the filter allows itself [W]; proof."),
    ] = 0.0,
    mass_error: Annotated[
        float,
        typer.Option(
            min=0.0,
            max=30.0,
            metavar="PERCENT",
            help="One torque for all robots whose links weigh up to so much more or less; proof.",
        ),
    ] = 0.0,
    samples: Annotated[int, typer.Option(min=1, help="Independent states of the band.")] = 69_075,
    confidence: Annotated[float, typer.Option(help="Of the bound of the violation measure.")] = 0.999,
    seconds: Annotated[float, typer.Option(min=0.0, help="Of the attack.")] = 60.0,
    time_limit: Annotated[float, typer.Option(min=1.0, help="Stop a proof after so many seconds.")] = 3600.0,
    jobs: Annotated[int, typer.Option(min=1, help="Cores to use.")] = max(1, (os.cpu_count() or 1)),
    seed: Annotated[int, typer.Option(min=0, help="Seed of samples and attack.")] = 0,
    robot: Annotated[str | None, typer.Option(help="Where the robot is now, if it was moved.")] = None,
    obstacles: Annotated[str | None, typer.Option(help="Where the world is now, if it was moved.")] = None,
    json: JsonOption = False,
) -> None:
    """Prove or estimate what a trained barrier promises, and write DIR/certificate.json.

    For one or two joints: a proof by branch and bound on the whole band. For more: independent samples with a
    confidence bound, and an attack by a search. States that break a condition go to DIR/counterexamples.npz, which
    `ppcbf train --counterexamples` reads; with --mass-error both names end in _mass_PERCENT. Exits with 3 unless
    everything was proved or bounded. The same command goes on after Ctrl-C or the time limit.

    Example: ppcbf verify runs/two_link
    """
    if not 0.0 < confidence < 1.0:
        raise InputError(f"--confidence must lie between 0 and 1, got {confidence}")
    if not math.isfinite(power):
        raise InputError(f"--power must be finite, got {power}")
    seconds, stored = finite(seconds, "--seconds"), load_barrier(folder)
    problem = _problem(stored, robot, obstacles)
    reason = _no_proof(problem, stored) if method != "samples" else "samples were asked for"
    if method == "proof" and reason:
        raise InputError(f"--method proof: {reason}; use --method samples")
    if reason and mass_error > 0.0:
        raise InputError(f"--mass-error is for proofs: {reason}; try masses out with `ppcbf campaign --mass-error`")
    began = time.monotonic()
    if reason:
        if method == "auto":
            err.print(f"samples instead of a proof: {reason}", style="dim", soft_wrap=True)
        found = _sample(problem, stored, folder, samples, confidence, seconds, seed, jobs)
    else:
        found = _prove(problem, stored, folder, power, mass_error / 100.0, jobs, time_limit)
    judged, states, details = found
    # also by earlier runs that this one went on from
    seconds_spent = max(time.monotonic() - began, details.pop("seconds", 0.0))
    certificate = Certificate(
        overall(judged), judged, _subject(stored), _not_covered(mass_error), round(seconds_spent, 2),
        "samples" if reason else "proof", details,
    )  # fmt: skip
    ending = suffix(mass_error / 100.0)
    path = save_certificate(folder, certificate, f"certificate{ending}.json")
    files = [str(path), *_save_states(problem, folder / f"counterexamples{ending}.npz", states)]
    if json:
        emit_json(certificate.report() | {"files": files})
    else:
        _print(certificate, files)
    if not certificate.certified:
        raise CheckFailed(f"not certified: {certificate.line()}")


def _problem(stored: StoredBarrier, robot: str | None, obstacles: str | None) -> Problem:
    """The problem a barrier was trained for, with the goal it was trained with."""
    problem = load_problem(robot or stored.data["robot"], obstacles or stored.data["world"])
    stored.barrier(problem)  # refuses another
    goal = problem.model.parse_angles(stored.data["goal"], "the goal in barrier.json")
    return problem.with_goal(goal).with_barrier_spec(stored.spec)


def _no_proof(problem: Problem, stored: StoredBarrier) -> str:
    """Why no proof can be tried, as a clause; "" if one can."""
    if problem.model.nv > 2:
        return f"the robot has {problem.model.nv} joints, and proofs reach up to 2"
    with needs("verify", "a proof"):
        from ppcbf_robots.proof.prove import check_symbolic, obstacle_to_proof
    return obstacle_to_proof(problem, stored) or check_symbolic(problem)


def _subject(stored: StoredBarrier) -> dict[str, Any]:
    config = stored.filter_config()
    return subject(stored.data, config.margin, config.dt)


def _not_covered(mass_error: float) -> list[str]:
    return [MASSES if mass_error > 0.0 and x is MODEL else x for x in NEVER]


Found = tuple[dict[str, Any], list[tuple[str, list[list[float]]]], dict[str, Any]]


def _prove(
    problem: Problem, stored: StoredBarrier, folder: Path, power: float, mass_error: float, jobs: int, time_limit: float
) -> Found:
    from ppcbf_robots.proof.prove import Search, prove

    with _bar("band decided") as show:

        def on_round(search: Search) -> None:
            bad = len(search.infeasible) + len(search.impassive)
            known = f", {bad} counterexamples" if bad else ""
            show(search.share, f"{search.judged:,} boxes, {len(search.boxes):,} open{known}")

        proof = prove(problem, stored, folder, power, jobs, time_limit, on_round, mass_error)
    search = proof.search
    states = [("feasibility", [x.tolist() for x in search.infeasible])]
    states.append(("passivity", [x.tolist() for x in search.impassive]))
    details = proof.details | {"power": power, "complete": proof.complete, "seconds": search.seconds}
    return proof.conditions, states, details


def _sample(
    problem: Problem, stored: StoredBarrier, folder: Path, samples: int, confidence: float, seconds: float, seed: int,
    jobs: int,
) -> Found:  # fmt: skip
    about = digest(_subject(stored))
    job = BandJob(problem.robot.name, problem.world_name, folder.resolve(), about, seed)
    attacks = jobs if seconds > 0.0 and stored.filter["kind"] == "qp" else 0
    tasks = [*attack_tasks(job, attacks, seconds), *sample_tasks(job, samples)]
    done = 0
    with _bar("samples") as show:

        def on_record(record: Record) -> None:
            nonlocal done
            done += 1
            show(done / len(tasks), f"{done} of {len(tasks)} tasks")

        records = run_sweep(tasks, folder / RECORDS, jobs, on_record=on_record)
    all_results(records, "tasks")
    found, states, details = conditions(stored, records, confidence)
    details["seconds"] /= jobs
    if not attacks:
        details["no_attack"] = "the attack knows the QP filter alone" if seconds > 0.0 else "--seconds 0"
    (folder / RECORDS).unlink()
    return found, list(states.items()), details


@contextmanager
def _bar(what: str) -> Iterator[Callable[[float, str], None]]:
    """A bar on stderr that is told a share and some words."""
    columns = (TextColumn("{task.description}"), BarColumn(bar_width=24), TextColumn("{task.percentage:>5.1f} %"),
               TextColumn("{task.fields[words]}"), TimeElapsedColumn())  # fmt: skip
    try:
        with Progress(*columns, console=err) as progress:
            task = progress.add_task(what, total=1.0, words="")
            yield lambda share, words: progress.update(task, completed=share, words=words)
    except KeyboardInterrupt:
        err.print("what is done so far is kept; the same command goes on from there")
        raise


def _save_states(problem: Problem, path: Path, states: list[tuple[str, list[list[float]]]]) -> list[str]:
    """Write states that break a condition: q (n, nq) in Pinocchio's coordinates, v (n, nv), condition (n,)."""
    x = np.array([s for _, found in states for s in found])
    if not len(x):
        path.unlink(missing_ok=True)
        return []
    nv, broken = problem.model.nv, [name for name, found in states for _ in found]
    try:
        np.savez(path, q=problem.model.from_angles(x[:, :nv]), v=x[:, nv:], condition=np.array(broken))
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from None
    return [str(path)]


def _print(certificate: Certificate, files: list[str]) -> None:
    rows = [[name, c.verdict, _bound(name, c), "-" if c.violations is None else str(c.violations)]
            for name, c in certificate.conditions.items()]  # fmt: skip
    title = f"{certificate.verdict} by {certificate.method} in {certificate.seconds:.0f} s"
    table(title, ["condition", "verdict", "bound", "states that break it"], rows)
    for name, c in certificate.conditions.items():
        out.print(f"{name}: {c.statement}")
    passivity, excess = certificate.conditions.get("passivity"), certificate.details.get("largest_excess_power") or 0.0
    if passivity is not None and passivity.verdict == "refuted" and excess > 0.0:
        separate = certificate.details["separating"]
        out.print(
            f"passivity lacks up to {excess:.3g} W in the states found, in {separate:.0%} of which the nearest row "
            f"separates; --power {2.0 * excess:.1g} would ask for a proof with so much more"
        )
    out.print("not covered: " + "; ".join(certificate.not_covered))
    out.print("wrote " + ", ".join(files))


def _bound(name: str, c: Condition) -> str:
    if c.bound is None or name == "boundary_passivity":
        return "-"
    if c.confidence is not None:
        return f"fails on {c.bound:.2g} of the band at most, {100 * c.confidence:g} % confidence"
    return f"at least {c.bound:.3g}" if name == "Lg_phi" else f"fails on {c.bound:.2g} of the band at most"
