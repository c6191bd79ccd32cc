"""``ppcbf train``: train a barrier for a robot and a world."""

from __future__ import annotations

import contextlib
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import typer
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from ppcbf_robots.cli.output import JsonOption, RobotArgument, WorldArgument, check_folder, emit_json, err, out, warn
from ppcbf_robots.cli.tasks import IterationsOption, PresetOption, preset_with
from ppcbf_robots.errors import CheckFailed, InputError
from ppcbf_robots.learning.presets import LearnedKind, PresetName
from ppcbf_robots.problem import Problem, load_problem
from ppcbf_robots.robot import RobotModel
from ppcbf_robots.specs import Array, BarrierSpec, validate

if TYPE_CHECKING:
    from ppcbf_robots.learning.train import Monitor

Device = Literal["auto", "cpu", "cuda"]


def train(
    robot: RobotArgument,
    obstacles: WorldArgument,
    out_dir: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the barrier.")],
    barrier: Annotated[LearnedKind, typer.Option(help="PP-NCBF (limits and passivity) or NCBF (limits).")] = "pp-ncbf",
    preset: PresetOption = "default",
    seed: Annotated[int, typer.Option(min=0, max=2**63 - 1, help="Seed of every random draw.")] = 0,
    device: Annotated[Device, typer.Option(help="Where to train.")] = "auto",
    gamma: Annotated[
        float | None,
        typer.Option(help="gamma of phi = dh/dt + gamma h - K [1/s]; by default the robot spec's, else the preset's."),
    ] = None,
    iterations: IterationsOption = None,
    time_limit: Annotated[float, typer.Option(min=1.0, help="Stop training after so many seconds.")] = 3600.0,
    resume: Annotated[bool, typer.Option("--resume", help="Continue from the checkpoint in DIR.")] = False,
    counterexamples: Annotated[
        Path | None, typer.Option(metavar="FILE", help="States (q, v) to learn from, as `ppcbf verify` writes them.")
    ] = None,
    tensorboard: Annotated[Path | None, typer.Option(help="Folder for a TensorBoard log.")] = None,
    json: JsonOption = False,
) -> None:
    """Train a barrier and write it to a folder. Ctrl-C keeps the best barrier so far.

    Exits with 3, after writing, if the barrier did not converge or collapsed.

    Example: ppcbf train two_link circle --out runs/two_link
    """
    problem = load_problem(robot, obstacles)
    if gamma is not None:
        given = problem.robot.spec.barrier.model_dump(exclude_unset=True) | {"gamma": gamma}
        problem = problem.with_barrier_spec(validate(given, BarrierSpec, "--gamma"))
    check_folder(out_dir)
    warn(problem.model.warnings)
    states = None if counterexamples is None else load_states(counterexamples, problem.model)
    report = train_barrier(
        problem, barrier, preset, seed, out_dir, device, iterations, time_limit, resume, tensorboard, states
    )
    if json:
        emit_json(report)
    else:
        _print(report)
    if not report["converged"]:
        where = f"the best barrier so far is in {out_dir}" if report["saved"] else f"nothing was written to {out_dir}"
        raise CheckFailed(f"not converged: {report['reason']}; {where}")


def load_states(path: Path, model: RobotModel) -> tuple[Array, Array]:
    """States q (n, nq), v (n, nv) of an npz file.

    Raises:
        InputError: if it cannot be read, or does not hold finite states of this robot.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            q, v = (np.asarray(file[name], dtype=float) for name in "qv")
    except (OSError, ValueError, TypeError, KeyError, EOFError, zipfile.BadZipFile):
        raise InputError(f"--counterexamples: {path} is not an npz file with the arrays q and v") from None
    if q.ndim != 2 or not len(q) or q.shape[1] != model.nq or v.shape != (len(q), model.nv):
        expected = f"q (n, {model.nq}) and v (n, {model.nv})"
        raise InputError(f"--counterexamples: {path} holds q {q.shape} and v {v.shape}, this robot needs {expected}")
    if not (np.isfinite(q).all() and np.isfinite(v).all()):
        raise InputError(f"--counterexamples: {path} holds numbers that are not finite")
    return q, v


def train_barrier(
    problem: Problem,
    kind: LearnedKind,
    preset_name: PresetName,
    seed: int,
    folder: Path,
    device: Device = "auto",
    iterations: int | None = None,
    time_limit: float = float("inf"),
    resume: bool = False,
    tensorboard: Path | None = None,
    counterexamples: tuple[Array, Array] | None = None,
) -> dict[str, Any]:
    """Train with a progress bar, save the barrier, and return the keys of ``ppcbf train --json``."""
    import torch  # takes seconds: only where it is needed

    from ppcbf_robots.learning.checkpoint import load_checkpoint, save_checkpoint
    from ppcbf_robots.learning.store import store
    from ppcbf_robots.learning.train import Trainer

    chosen = preset_with(preset_name, iterations)
    for change in chosen.changes:
        err.print(f"changed from the paper: {change}", style="dim")
    where = ("cuda" if torch.cuda.is_available() else "cpu") if device == "auto" else device
    if where == "cuda" and not torch.cuda.is_available():
        raise InputError("--device cuda: no CUDA device is available here; use --device cpu")
    if where == "cpu":
        torch.set_num_threads(1)  # the tensors are small: more threads stall each other on a busy machine
    trainer = Trainer(problem, kind, chosen, seed, where)
    if resume:
        load_checkpoint(trainer, folder)
    if counterexamples is not None:
        trainer.descent.add_counterexamples(*counterexamples)
    with _progress(kind, chosen.iterations) as show, _tensorboard(tensorboard) as record:

        def on_check(monitor: Monitor) -> None:
            show(monitor)
            record(monitor)
            save_checkpoint(trainer, folder)

        result = trainer.run(on_check, time_limit, on_refine=lambda text: err.print(text, style="yellow"))
    facts = {"preset": preset_name, "seed": seed, "device": where, "kind": kind, "iterations": iterations}
    saved = store(trainer, result, folder, facts)
    return {**result.report(), **facts, "saved": saved, "out": str(folder)}


@contextlib.contextmanager
def _progress(kind: LearnedKind, planned: int) -> Iterator[Callable[[Monitor], None]]:
    """A bar with the monitors: volume kept, band yield, share of band states that violate, start inside."""
    columns = (TextColumn("{task.description}"), BarColumn(bar_width=24), TextColumn("{task.fields[monitors]}"),
               TimeElapsedColumn())  # fmt: skip
    with Progress(*columns, console=err) as progress:
        task = progress.add_task(kind, total=planned, monitors="")

        def show(m: Monitor) -> None:
            monitors = (
                f"{m.iteration}/{m.planned} volume {m.volume_kept:.1%} band {m.band_yield:.0%} "
                f"torque {m.torque:.2%} passivity {m.passivity:.2%} start {'in' if m.start_inside else 'OUT'}"
            )
            progress.update(task, completed=m.iteration, total=m.planned, monitors=monitors)

        yield show


@contextlib.contextmanager
def _tensorboard(folder: Path | None) -> Iterator[Callable[[Monitor], None]]:
    """Writes the monitors as TensorBoard scalars, if a folder was given."""
    if folder is None:
        yield lambda monitor: None
        return
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        raise InputError(
            '--tensorboard needs the tensorboard package: pip install "ppcbf-robots[tensorboard]"'
        ) from None
    try:
        writer = SummaryWriter(str(folder))  # type: ignore[no-untyped-call]
    except OSError as error:
        raise InputError(f"--tensorboard: {folder} cannot be written ({error.strerror})") from None

    def record(m: Monitor) -> None:
        for name in ("volume_kept", "band_yield", "torque", "passivity", "loss"):
            writer.add_scalar(name, getattr(m, name), m.iteration)  # type: ignore[no-untyped-call]

    try:
        yield record
    finally:
        writer.close()  # type: ignore[no-untyped-call]


def _print(report: dict[str, Any]) -> None:
    state = "converged" if report["converged"] else f"NOT converged: {report['reason']}"
    out.print(
        f"{report['kind']} {state} after {report['steps']} steps, {report['seconds']:.0f} s on {report['device']}"
    )
    out.print(
        f"volume kept {report['volume_kept']:.1%} of the LB safe set; "
        f"{report['violations']} violations in {report['samples']} uniform band states"
    )
    if report["converged"] and report["steps"] == 0:
        out.print("no learned term is needed here: K_theta = 0, the set is that of the LB-CBF")
    if report["worst_margin"] is not None:
        what = "no state" if report["worst_margin"] >= 0.0 else "states"
        out.print(
            f"the falsifier found {what} without a feasible torque; least reserve {report['worst_margin']:.4f} "
            f"of {report['attacked']} tried"
        )
    folder = report["out"]
    out.print(f"wrote {folder}/barrier.json and {folder}/weights.safetensors" if report["saved"]
              else f"kept the barrier that was in {folder}: of the new one nothing is known")  # fmt: skip
