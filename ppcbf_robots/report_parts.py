"""The parts of a report, each from the same material."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ppcbf_robots import plots
from ppcbf_robots.artefact import StoredBarrier
from ppcbf_robots.barriers import Barrier
from ppcbf_robots.benchmark import Case
from ppcbf_robots.certificate import Certificate
from ppcbf_robots.problem import Problem
from ppcbf_robots.report_page import Figure, Section, Table, Tone
from ppcbf_robots.rollout import Trajectory
from ppcbf_robots.studies.figures import plot_curves

VERDICTS: dict[str, tuple[Tone, str]] = {
    "proved": ("good", "Every condition holds on the whole band: proved, with rounding errors accounted for."),
    "bounded": (
        "good",
        "Not proved, but bounded: independent random states of the band show that violations, if any, are rare.",
    ),
    "refuted": ("bad", "Refuted: states are known in which a condition does not hold."),
    "undecided": ("warn", "Undecided: neither proved nor refuted with the time or samples given."),
}


@dataclass(frozen=True)
class Material:
    """What a report is made of."""

    folder: Path
    problem: Problem
    stored: StoredBarrier
    barrier: Barrier
    run: Trajectory
    case: Case  # time of a filter step
    certificate: Certificate | None
    campaign: dict[str, Any] | None  # campaign.json


def _robot(m: Material) -> Section:
    model, gains, domain = m.problem.model, m.problem.robot.controller.gains, m.problem.robot.domain
    rates = [f"{x:.4g}" if np.isfinite(x) else "none" for x in model.u_rate]
    rows = [
        [name, _interval(domain.q[i]), *(f"{x[i]:.4g}" for x in (model.v_max, model.u_max)), rates[i],
         *(f"{x[i]:.4g}" for x in (gains.kp, gains.kd))]
        for i, name in enumerate(model.joint_names)
    ]  # fmt: skip
    columns = ["joint", "domain X [rad | m]", "speed limit", "torque limit", "rate limit", "K_p", "K_d"]
    spheres, controller = len(m.problem.robot.body), gains.kind.replace("_", " ")
    text = [f"{model.nv} moving joints; {spheres} body spheres; controller {controller}."]
    return Section(
        "robot",
        "Robot",
        text,
        [Table("Moving joints (SI units)", columns, rows)],
        notes=model.warnings,
        noted="Warnings",
    )


def _world(m: Material) -> Section:
    rows = []
    for o in m.problem.world.obstacles:
        facts = o.model_dump(exclude={"name", "type", "vertices"}, exclude_defaults=True)
        rows.append([o.name, o.type.replace("_", " "), ", ".join(f"{k} {_numbers(x)}" for k, x in facts.items())])
    text = [f"{m.problem.safety.pairs} pairs of body sphere and obstacle are watched, each as a row of the filter."]
    return Section(
        "world", "World", text, [Table("Obstacles (metres, base frame)", ["name", "type", "measures"], rows)]
    )


def _training(m: Material) -> Section:
    training = m.stored.data["training"]
    said = (
        "converged" if training.get("converged") else f"did not converge ({training.get('reason', 'no reason given')})"
    )
    text = [
        f"Training {said} after {training.get('steps', '?')} iterations and {_seconds(training.get('seconds'))}.",
        f"The safe set keeps {percent(training.get('volume_kept'))} of that of the untrained LB-CBF. "
        f"{training.get('violations', '?')} of {training.get('samples', '?')} uniform states of the band violate a "
        "condition of the filter.",
    ]
    if training.get("worst_margin") is not None:
        text.append(
            f"The falsifier's least reserve is {training['worst_margin']:.4f} "
            f"in {training.get('attacked', '?')} states; below 0 there is no feasible torque."
        )
    history = training.get("history") or []
    figures = []
    if len(history) > 1:
        last = history[-1]
        alt = (
            f"Four curves over {last['iteration']} iterations. At the end: loss {_number(last['loss'])}, share of band "
            f"states that violate the torque condition {percent(last['torque'])}, the passivity condition "
            f"{percent(last['passivity'])}, volume kept {percent(last['volume_kept'])}."
        )
        svg = _drawn(lambda path: plot_curves([history], path, columns=2))
        figures.append(Figure(svg, alt, "Training: loss, violated shares of the band and volume kept."))
    return Section("training", "Training", text, figures=figures)


def _safe_set(m: Material) -> Section:
    if m.problem.model.nv < 2:
        return Section("safe-set", "Safe set", ["Slices need two joints; this robot has one."])
    shown = {"LB-CBF": m.problem.barrier("lb-cbf"), m.stored.kind.upper(): m.barrier}
    svg = _drawn(lambda path: plots.plot_safe_set(m.problem, shown, plots.slice_velocities(m.problem), path))
    first, second = m.problem.model.joint_names[:2]
    alt = (
        f"Two slices over {first} and {second}, the other joints at the start: boundaries of the safe sets of the "
        "LB-CBF and of the trained barrier, at rest and in motion; collisions in grey."
    )
    caption = "Boundaries of the safe sets (lines) and configurations in collision or beyond limits (grey)."
    text = ["Inside a boundary the filter finds a torque. The faster the arm, the smaller the set."]
    return Section("safe-set", "Safe set", text, figures=[Figure(svg, alt, caption)])


def _certificate(m: Material) -> Section:
    found = m.certificate
    if found is None:
        return Section("certificate", "Certificate", [f"Not verified: run ppcbf verify {m.folder}"])
    rows = [[name, c.statement, c.verdict, _certainty(c.verdict, vars(c)), _number(c.worst_margin)]
            for name, c in found.conditions.items()]  # fmt: skip
    table = Table("Conditions", ["condition", "what it says", "verdict", "how certain", "least reserve"], rows)
    text = [VERDICTS[found.verdict][1], f"Found by {found.method} in {_seconds(found.seconds)}."]
    if found.method == "samples":
        without, tried = found.details.get("no_attack"), found.details.get("attacked", 0)
        known = sum(c.verdict == "refuted" for c in found.conditions.values())
        result = "some that are known break a condition" if known else "none breaks a condition"
        search = (
            f"No search went after single states: {without}." if without else f"A search tried {tried:,}: {result}."
        )
        text.append(search)
    return Section("certificate", "Certificate", text, [table], notes=found.not_covered, noted="Not covered")


def _certainty(verdict: str, c: Mapping[str, Any]) -> str:
    """How far a condition is certain, in words."""
    if verdict == "proved":
        return "on the whole band"
    if verdict == "refuted" and c["confidence"] is None:
        return "a counterexample is known" if c["violations"] is None else f"{c['violations']} violating states known"
    if c["bound"] is None or c["confidence"] is None:
        return "not known" if c["bound"] is None else f"open on at most {percent(c['bound'])} of the band"
    sure = f"fails on at most {c['bound']:.2g} of the band, with {100.0 * c['confidence']:.4g} % confidence"
    sure += "" if c["samples"] is None else f" ({c['violations'] or 0} of {c['samples']:,} samples)"
    return f"{sure}, and at states that are known" if verdict == "refuted" else sure


def _one_run(m: Material) -> Section:
    facts, end = m.run.summary(m.problem.model), m.run.ending()
    counts = ", ".join(f"{name.replace('_', ' ')} {n}" for name, n in facts["filter_counts"].items())
    rows = [
        ["least h", f"{facts['min_h']:.5f}"],
        ["least clearance to an obstacle", f"{facts['clearance']:.5f} m"],
        ["largest torque", f"{facts['max_torque_ratio']:.1%} of its limit"],
        ["storage V rises by", f"{facts['energy_rise']:.2g} of its first value"],
        ["control steps", counts],
    ]
    said = "The run diverged." if end is None else f"At the end: {end.text()}."
    svg = _drawn(lambda path: plots.plot_run(m.problem, m.run, path))
    alt = (
        f"Four curves over {m.run.t[-1]:.3g} s: least h, at least {facts['min_h']:.4f}; least phi; storage V, from "
        f"{m.run.V[0]:.3g} to {m.run.V[-1]:.3g} J; torques relative to their limits, at most "
        f"{facts['max_torque_ratio']:.2f}."
    )
    caption = "From the specified start to the goal. Shaded: the filter corrects. Dashed: 0, and the torque limits."
    return Section("run", "Run", [said], [Table("Figures of the run", [], rows)], [Figure(svg, alt, caption)])


def _campaign(m: Material) -> Section:
    facts = m.campaign
    if facts is None:
        hint = f"ppcbf campaign {m.problem.robot.name} {m.problem.world_name} --barrier {m.folder}"
        return Section("campaign", "Campaign", [f"None given: run {hint} and give its campaign.json with --campaign."])
    given = ["pushes that the filter does not know of"] if facts.get("pushes") else []
    given += [f"masses off by up to {facts['mass_error']:.0%}"] if facts.get("mass_error") else []
    text = [
        f"{facts['rollouts']:,} runs of {facts['duration']:g} s from random safe states to random goals in "
        f"{facts['engine'].capitalize()}, with the {facts['barrier_kind'].upper()} barrier"
        + (f"; {' and '.join(given)}." if given else ".")
    ]
    if not same_barrier(m):
        here = facts["barrier"] == str(m.folder.resolve())
        text.append(f"These runs used another barrier: {'one that was here before' if here else facts['barrier']}.")
    if facts["certificate"] is not None:
        text.append(f"Certificate of the barrier then: {facts['certificate']}.")
    rows = [
        ["runs with a contact", str(facts["contacts"])],
        ["runs beyond a torque limit", str(facts["torque_violations"])],
        ["runs beyond a torque rate limit", str(facts["rate_violations"])],
        ["runs beyond a joint limit", str(facts["limit_violations"])],
        ["runs that diverged", str(facts["diverged"])],
        ["least h", f"{facts['min_h']:.6f} (median of the runs {facts['median_min_h']:.4f})"],
        ["least clearance", f"{facts['min_clearance']:.6f} m"],
        [
            "most energy above V0 and pushes",
            f"{facts['max_above_V0']:.3g} J ({facts['max_above_V0_share']:.2g} of V0)",
        ],
        ["largest rise of V", f"{facts['max_rise']:.3g} J"],
        ["largest torque", f"{facts['max_torque_ratio']:.1%} of its limit"],
        ["control steps without a solution", str(facts["qp_failures"])],
        ["control steps below the full QP", str(facts["fallbacks"])],
        ["goals reached", f"{facts['goals_reached']} ({facts['goals_reached'] / facts['rollouts']:.0%})"],
        ["held by an obstacle or limit", str(facts["resting"])],
        ["at rest elsewhere", str(facts["stalled"])],
        ["still moving at the end", str(facts["moving"])],
    ]
    return Section("campaign", "Campaign", text, [Table("What was counted", [], rows)])


def same_barrier(m: Material) -> bool:
    """Whether the campaign ran with the barrier of the report, as it is now."""
    return m.campaign is not None and m.campaign["barrier_sha256"] == m.stored.digest


def _latency(m: Material) -> Section:
    c = m.case
    rows = [["whole step", f"{c.median_us:.0f}", f"{c.p99_us:.0f}", f"{c.max_us:.0f}"]]
    rows += [[stage, f"{us:.0f}", "", ""] for stage, us in c.stages.items()]
    text = [
        f"One step, from (q, v) to torque, over {c.steps:,} states on the band where the QP has to be solved, on the "
        f"machine that made this report ({c.pairs} pairs, solver {c.solver})."
    ]
    return Section("speed", "Speed of the filter", text,
                   [Table("Microseconds", ["stage", "median", "99 %", "largest"], rows)])  # fmt: skip


PARTS: dict[str, Callable[[Material], Section]] = {
    "certificate": _certificate,
    "run": _one_run,
    "campaign": _campaign,
    "training": _training,
    "safe set": _safe_set,
    "speed": _latency,
    "robot": _robot,
    "world": _world,
}


def _drawn(draw: Callable[[Path], None]) -> bytes:
    """A picture as SVG."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "figure.svg"
        draw(path)
        return path.read_bytes()


def _interval(x: Any) -> str:
    return f"{x[0]:.4g} to {x[1]:.4g}"


def _number(x: float | None) -> str:
    return "-" if x is None else f"{x:.4g}"


def percent(x: float | None) -> str:
    """A share in words."""
    return "an unknown share" if x is None else f"{x:.1%}"


def _seconds(x: float | None) -> str:
    return "an unknown time" if x is None else f"{x:.0f} s" if x < 120.0 else f"{x / 60.0:.1f} min"


def _numbers(x: Any) -> str:
    if isinstance(x, list | tuple):
        return "(" + ", ".join(map(_numbers, x)) + ")"
    return f"{x:.4g}" if isinstance(x, float) else str(x)
