"""The default preset where torque is short: cart-pole at 8 N, two-link at ±4 rad/s, a weak Panda, a UR5 with 4 kg.

Each case is trained with the one default preset, then judged by 100,000 fresh uniform band states given to the runtime
filter and by 60 s of the falsifier. Volumes are shares of X: of the barrier's set, and of the largest LB set that the
same evidence passes (gamma tuned over a grid, fewer states); ``ppcbf study safe-set`` gives that of the viable set. One
JSON object per case is appended to the output; cases already there are skipped.

Run: ``python tests/benchmarks/hard_cases.py --out runs/hard.jsonl``, then ``--table`` for the README's table.
"""

from __future__ import annotations

import argparse
import json
import logging
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from ppcbf_robots import load_problem
from ppcbf_robots.barriers import Barrier
from ppcbf_robots.cli.simulate import choose_barrier
from ppcbf_robots.cli.train import train_barrier
from ppcbf_robots.evidence import check_band
from ppcbf_robots.filters import FilterConfig
from ppcbf_robots.learning.falsifier import falsify
from ppcbf_robots.problem import Problem, load_robot
from ppcbf_robots.resources import find_robot
from ppcbf_robots.safe_sets import FREE, membership

Spec = dict[str, Any]
LB_GAMMAS = (20.0, 15.0, 10.0, 8.0, 6.0, 5.0, 4.0, 3.0, 2.5, 2.0, 1.5, 1.0)  # [1/s], tried from above
LB_STATES, LB_SECONDS = 10_000, 15.0
RATIO = 1.3  # of the weak Panda's least torque limit over gravity
VOLUME_STATES = 40_000


def bundled(name: str) -> Spec:
    """A bundled spec as plain data, its URDF findable from elsewhere and gamma left to the preset."""
    path = find_robot(name)
    spec: Spec = yaml.safe_load(path.read_text())
    if (path.parent / spec["urdf"]).is_file():
        spec["urdf"] = str((path.parent / spec["urdf"]).resolve())
    spec.get("barrier", {}).pop("gamma", None)
    return spec


def cartpole() -> Spec:
    """u_max = 8 N instead of 25."""
    return bundled("cartpole") | {"effort": {"slide": 8.0}, "start_velocity": [1.0, 0.0]}


def two_link() -> Spec:
    """Both joints of X up to 4 rad/s either way."""
    spec = bundled("two_link")
    spec["domain"] |= {"v": [[-4.0, 4.0], [-4.0, 4.0]]}
    return spec


def panda() -> Spec:
    """All torque limits scaled by one factor, so that the least of u_max / max|g| is 1.3; derived controller."""
    robot = load_robot("panda")
    model, rng = robot.model, np.random.default_rng(0)
    q = model.from_angles(robot.domain.sample_q(rng, 20_000))
    g = np.abs(model.evaluate_batch(q, np.zeros((len(q), model.nv))).g).max(axis=0)
    factor = RATIO / (model.u_max / np.maximum(g, 1e-9)).min()
    limits = {n: float(factor * u) for n, u in zip(model.joint_names, model.u_max, strict=True)}
    spec = bundled("panda") | {"effort": limits}
    spec.pop("controller", None)
    return spec


def ur5() -> Spec:
    """4 kg at the flange."""
    return {"urdf": "ur5", "payload": {"frame": "tool0", "mass": 4.0}}


CASES: dict[str, tuple[Callable[[], Spec], str]] = {
    "cartpole 8 N": (cartpole, "wall"),
    "two_link 4 rad/s": (two_link, "circle"),
    "panda 1.3 g": (panda, "five_spheres"),
    "ur5 4 kg": (ur5, "table_boxes"),
}


def evidence(problem: Problem, barrier: Barrier, states: int, seconds: float, seed: int = 99) -> Spec:
    """Violations of the runtime filter on uniform band states, and the least reserve that the falsifier finds."""
    rng = np.random.default_rng(seed)
    check = check_band(problem, barrier, FilterConfig(), states, rng, max_configurations=6_000_000)
    attack = falsify(problem, barrier, FilterConfig(), rng, seconds)
    return {"violations": check.violations, "samples": check.samples, "worst_margin": attack.worst,
            "found": len(attack.q), "attacked": attack.evaluated}  # fmt: skip


def largest_lb(problem: Problem) -> tuple[float, Barrier] | None:
    """The largest gamma of the grid whose LB set passes the evidence."""
    for gamma in LB_GAMMAS:
        tuned = problem.with_barrier_spec(problem.robot.spec.barrier.model_copy(update={"gamma": gamma}))
        barrier = tuned.barrier("lb-cbf")
        if check_band(tuned, barrier, FilterConfig(), LB_STATES, np.random.default_rng(7)).violations:
            continue
        if not len(falsify(tuned, barrier, FilterConfig(), np.random.default_rng(7), LB_SECONDS).q):
            return gamma, barrier
    return None


def case(name: str, folder: Path, states: int, seconds: float) -> Spec:
    """Train and judge one case."""
    make, world = CASES[name]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "robot.yaml").write_text(yaml.safe_dump(make()))
    problem = load_problem(str(folder / "robot.yaml"), world)
    began = time.process_time()
    report = train_barrier(problem, "pp-ncbf", "default", 0, folder / "barrier", "cpu", None, 3600.0)
    cpu = time.process_time() - began
    barrier, _ = choose_barrier(problem, str(folder / "barrier"), None, None)
    assert barrier is not None
    problem = problem.with_barrier_spec(barrier.spec)
    facts: Spec = {"case": name, "world": world, "gamma": barrier.spec.gamma, "cpu_s": round(cpu, 1)}
    facts |= {k: report[k] for k in ("converged", "reason", "volume_kept", "steps")}
    facts |= evidence(problem, barrier, states, seconds)
    lb = largest_lb(problem)
    sets = {"trained": barrier} | ({} if lb is None else {"lb": lb[1]})
    volumes = membership(problem, sets, None, VOLUME_STATES, np.random.default_rng(1))
    names = {"free": FREE, "volume": "trained"} | ({} if lb is None else {"lb_volume": "lb"})
    facts |= {k: round(volumes.ratio(n).value, 4) for k, n in names.items()}
    return facts | {"lb_gamma": None if lb is None else lb[0]}


def table(path: Path) -> None:
    """The README's table from the output file, but for the share of the viable set."""
    print("| case | gamma | set / X | largest LB that passes the same | violations "
          "| least reserve in 60 s (states tried) | trained, CPU |\n|---|---|---|---|---|---|---|")  # fmt: skip
    for c in map(json.loads, path.read_text().splitlines()):
        lb = f"{c['lb_volume']:.1%} (gamma = {c['lb_gamma']:g})" if c["lb_gamma"] else "none down to gamma = 1"
        print(f"| {c['case']}, {c['world']} | {c['gamma']:g} | {c['volume']:.1%} | {lb} "
              f"| {c['violations']:,} of {c['samples']:,} | {c['worst_margin']:+.2g} ({c['attacked']:,}) "
              f"| {c['cpu_s']:.0f} s |")  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/hard.jsonl"))
    parser.add_argument("--cases", nargs="*", default=list(CASES))
    parser.add_argument("--states", type=int, default=100_000)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--table", action="store_true", help="print the table of what is there")
    args = parser.parse_args()
    logging.disable(logging.CRITICAL)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    if args.table:
        table(args.out)
        return
    done = {json.loads(x)["case"] for x in args.out.read_text().splitlines()} if args.out.exists() else set()
    for name in args.cases:
        if name in done:
            continue
        facts = case(name, args.out.parent / name.replace(" ", "_").replace("/", "_"), args.states, args.seconds)
        print(json.dumps(facts), file=sys.stderr)
        with args.out.open("a") as file:
            file.write(json.dumps(facts) + "\n")


if __name__ == "__main__":
    main()
