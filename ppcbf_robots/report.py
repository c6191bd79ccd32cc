"""A report on a barrier: robot, world, training, certificate, a run, a campaign, and the filter's speed, as HTML."""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, PositiveInt

from ppcbf_robots import viewer
from ppcbf_robots.artefact import StoredBarrier
from ppcbf_robots.barriers import Barrier
from ppcbf_robots.benchmark import Case, measure
from ppcbf_robots.errors import InputError
from ppcbf_robots.problem import Problem
from ppcbf_robots.report_page import Badge, Tone, render_report
from ppcbf_robots.report_parts import PARTS, VERDICTS, Material, percent, same_barrier
from ppcbf_robots.resources import portable


class Figures(BaseModel):
    """What a report shows of ``campaign.json``."""

    model_config = ConfigDict(extra="allow", allow_inf_nan=False)

    robot: str
    obstacles: str
    barrier: str
    barrier_sha256: str | None
    certificate: str | None
    barrier_kind: str
    engine: str
    duration: float
    pushes: bool
    mass_error: float
    rollouts: PositiveInt
    contacts: int
    limit_violations: int
    torque_violations: int
    rate_violations: int
    diverged: int
    qp_failures: int
    fallbacks: int
    goals_reached: int
    resting: int
    stalled: int
    moving: int
    min_h: float
    median_min_h: float
    min_clearance: float
    max_above_V0: float
    max_above_V0_share: float
    max_rise: float
    max_torque_ratio: float
    failed: list[int]


def read_campaign(path: Path, problem: Problem) -> dict[str, Any]:
    """The figures of a campaign of the same robot and world.

    Args:
        path: its folder, or campaign.json in it.
        problem: robot and world.

    Raises:
        InputError: if it is something else.
    """
    path = path / "campaign.json" if path.is_dir() else path
    try:
        facts = Figures.model_validate_json(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"campaign not found: {path}; make one with `ppcbf campaign`") from None
    except (OSError, ValueError):  # pydantic's errors are of the latter
        raise InputError(f"{path}: not the campaign.json of `ppcbf campaign`") from None
    names = facts.robot, facts.obstacles
    if names != (portable(problem.robot.name), portable(problem.world_name)):
        raise InputError(
            f"{path}: a campaign of '{names[0]}' in '{names[1]}', but the report is about "
            f"'{problem.robot.name}' in '{problem.world_name}'"
        )
    return facts.model_dump()


def time_filter(problem: Problem, barrier: Barrier, stored: StoredBarrier, steps: int) -> Case:
    """Time of a step of the filter that the barrier was trained for."""
    return measure(problem, barrier, stored.filter_config(), steps)


def write_report(material: Material, path: Path, on_part: Callable[[str], None] = lambda what: None) -> None:
    """Write the report as one HTML file.

    Args:
        material: its contents.
        path: the file.
        on_part: called with the name of each part before it is made.

    Raises:
        InputError: if the file cannot be written.
    """
    sections = []
    for name, part in PARTS.items():
        on_part(name)
        sections.append(part(material))
    on_part("3-D view")
    problem, training = material.problem, material.stored.data["training"]
    view = viewer.page(problem, [material.run], ["filtered run"])
    title = f"{Path(problem.robot.name).stem} in {Path(problem.world_name).stem}"
    kind = material.stored.kind.upper()
    subtitle = f"{kind} barrier in {material.folder}, trained with the {training.get('preset', '?')} preset"
    footer = (
        f"Made by ppcbf_robots {version('ppcbf-robots')}. All claims are about the modelled robot. This is no "
        "safety-rated function: keep the robot's own monitored limits and the emergency stop on."
    )
    page = render_report(title, subtitle, _badges(material), sections, view, footer)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(page, encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from None


def _badges(m: Material) -> list[Badge]:
    training, end = m.stored.data["training"], m.run.ending()
    good = bool(training.get("converged"))
    badges = [
        Badge("Training", "converged" if good else "not converged",
              f"{percent(training.get('volume_kept'))} of the LB safe set kept", "good" if good else "bad")
    ]  # fmt: skip
    if m.certificate is None:
        badges.append(Badge("Certificate", "not verified", "run ppcbf verify", "none"))
    else:
        verdict = m.certificate.verdict
        badges.append(
            Badge("Certificate", verdict, f"{len(m.certificate.conditions)} conditions", VERDICTS[verdict][0])
        )
    if m.campaign is None:
        badges.append(Badge("Campaign", "none", "run ppcbf campaign", "none"))
    else:
        failed = len(m.campaign["failed"])
        word, runs = "clean" if failed == 0 else f"{failed} failed", f"{m.campaign['rollouts']:,} runs"
        other = "" if same_barrier(m) else ", of another barrier"
        badges.append(Badge("Campaign", word, runs + other, "bad" if failed else "warn" if other else "good"))
    facts = m.run.summary(m.problem.model)
    hit = facts["clearance"] < 0.0
    names = {"goal": "goal reached", "held": "rests", "stalled": "at rest", "moving": "still moving"}
    word = "diverged" if end is None else "contact" if hit else names[end.state]
    tone: Tone = "bad" if hit or end is None else "good" if end.state == "goal" else "warn"
    badges.append(Badge("Run", word, f"least h {facts['min_h']:.4f}", tone))
    badges.append(Badge("Filter step", f"{m.case.median_us:.0f} µs", "median on this machine", "none"))
    return badges
