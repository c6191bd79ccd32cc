"""``ppcbf bench train``: how fast the learner runs on this machine."""

from __future__ import annotations

from typing import Annotated

import typer

from ppcbf_robots.cli.output import JsonOption, RobotArgument, WorldArgument, emit_json, out, table
from ppcbf_robots.problem import load_problem


def train(
    robot: RobotArgument = "panda",
    obstacles: WorldArgument = "five_spheres",
    iterations: Annotated[int, typer.Option(min=10, help="Timed iterations per case.")] = 200,
    json: JsonOption = False,
) -> None:
    """Time the learner's inner loop for both presets, on the CPU and, where there is one, on CUDA.

    Prints band states per second and the share of the machine's limit of matrix products.

    Example: ppcbf bench train cartpole wall --iterations 100
    """
    import torch  # takes seconds: only where it is needed

    from ppcbf_robots.learning.presets import PRESETS
    from ppcbf_robots.learning.threads import use_threads
    from ppcbf_robots.learning.throughput import measure_training

    problem = load_problem(robot, obstacles)
    torch.set_num_threads(1)  # as in training
    use_threads(1)  # to be compared with a core's matrix product
    devices = ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]
    cases = [measure_training(problem, k, p, device, iterations) for k, p in PRESETS.items() for device in devices]
    if json:
        emit_json({"cases": [{"robot": robot, "world": obstacles} | c.as_json() for c in cases]})
        return
    columns = ["preset", "device", "iterations/s", "band states/s", "GFLOP/s", "of the limit", "pool [s]"]
    rows = [
        [c.preset, c.device, f"{c.iterations_per_s:.1f}", f"{c.states_per_s:,.0f}", f"{1e-9 * c.products_per_s:.2f}",
         f"{c.share:.1%}", f"{c.pool_s:.1f}"]
        for c in cases
    ]  # fmt: skip
    table(f"training on {robot} and {obstacles}, one thread on the CPU", columns, rows)
    if len(devices) == 1:
        out.print("no CUDA device here")
