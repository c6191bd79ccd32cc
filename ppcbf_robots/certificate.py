"""What was proved or estimated about a trained barrier: ``certificate.json`` beside it, bound to it by hash."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from pydantic import TypeAdapter

from ppcbf_robots.errors import InputError

NAME = "certificate.json"
FORMAT = 2
GOAL_TOLERANCE = 1e-9  # [rad | m]
CERTIFIED = ("proved", "bounded")

Verdict = Literal["proved", "bounded", "refuted", "undecided"]


@dataclass(frozen=True)
class Condition:
    """One condition and how far it is certain.

    ``bound`` depends on the verdict. Of a proof: for ``Lg_phi`` the proved lower bound of |L_g phi|, for ``passivity``
    and ``feasibility`` an upper bound of the share of the band where they may fail. Of samples: the upper confidence
    bound of the violation measure.
    """

    verdict: Verdict
    statement: str
    bound: float | None = None
    confidence: float | None = None  # of a bound that is not proved
    samples: int | None = None
    violations: int | None = None  # among the samples, or states known in all
    worst_margin: float | None = None  # the attack's least reserve


@dataclass(frozen=True)
class Certificate:
    """Verdicts on all conditions, and what they are about."""

    verdict: Verdict
    conditions: dict[str, Condition]
    subject: dict[str, Any]  # hashes of weights, robot, task and world, constants, filter and goal
    not_covered: list[str]
    seconds: float
    method: Literal["proof", "samples"]
    details: dict[str, Any] = field(default_factory=dict)

    @property
    def certified(self) -> bool:
        """Whether every condition was proved or bounded."""
        return self.verdict in CERTIFIED

    def line(self) -> str:
        """One line for people."""
        power = self.details.get("power", 0.0)
        allowance = {"passivity": f" with {power:g} W beyond d_p"} if power else {}
        parts = ", ".join(f"{name} {c.verdict}{allowance.get(name, '')}" for name, c in self.conditions.items())
        masses = self.details.get("mass_error", 0.0)
        return f"{self.verdict} ({parts}{f'; masses within {masses:.3g} of the model' if masses else ''})"

    def gap(
        self, goal: Sequence[float] | None, filter_kind: str, metric: str, alpha: float, margin: float, dt: float,
        rate_limited: bool,
    ) -> str:  # fmt: skip
        """Why it does not speak about a filter and a goal (one number per joint), as a clause; "" if it does.

        Without a goal it is asked about many.
        """
        known = self.subject["filter"]
        if (filter_kind, metric, alpha) != (known["kind"], known["metric"], known["alpha"]):
            return f"for the {known['kind']} filter in the {known['metric']} metric with alpha = {known['alpha']:g}"
        if (margin, dt) != (self.subject["margin"], self.subject["dt"]):
            return f"for a control period of {self.subject['dt']:g} s and a margin of {self.subject['margin']:g}"
        if rate_limited:
            return "for torques whose rate is not limited"
        if goal is None:
            return "passivity for one goal alone"
        if any(abs(a - b) > GOAL_TOLERANCE for a, b in zip(goal, self.subject["goal"], strict=True)):
            return "passivity for another goal"
        return ""

    def report(self) -> dict[str, Any]:
        """As JSON."""
        return {"format": FORMAT, **asdict(self)}


def overall(conditions: Mapping[str, Condition]) -> Verdict:
    """The weakest of the verdicts."""
    order: tuple[Verdict, ...] = ("refuted", "undecided", "bounded", "proved")
    return min((c.verdict for c in conditions.values()), key=order.index)


def subject(barrier: Mapping[str, Any], margin: float, dt: float) -> dict[str, Any]:
    """What a certificate is about, from the contents of ``barrier.json``, and the filter's margin and period."""
    keys = ("kind", "network", "formula", "filter", "fingerprint", "weights_sha256", "goal")
    return {key: barrier.get(key) for key in keys} | {"margin": margin, "dt": dt}


def digest(about: Mapping[str, Any]) -> str:
    """SHA-256 of a :func:`subject`."""
    return hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()


def suffix(mass_error: float) -> str:
    """What the files of a proof for other masses have behind their names; they stand beside those of the model's."""
    return f"_mass_{100.0 * mass_error:g}" if mass_error > 0.0 else ""


def save_certificate(folder: Path, certificate: Certificate, name: str = NAME) -> Path:
    """Write it beside the barrier by an atomic rename."""
    path, temporary = folder / name, folder / f".{name}.tmp"
    try:
        temporary.write_text(json.dumps(certificate.report(), indent=1, allow_nan=False), encoding="utf-8")
        temporary.replace(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from None
    return path


def load_certificate(folder: Path, barrier: Mapping[str, Any]) -> Certificate | None:
    """The certificate of a barrier folder; None if there is none.

    Raises:
        InputError: if the file is not a certificate, or one of another barrier.
    """
    path = folder / NAME
    if not path.is_file():
        return None
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        assert data.pop("format") == FORMAT
        found = TypeAdapter(Certificate).validate_python(data)
        assert found.verdict == overall(found.conditions)
        margin, dt, *_ = numbers = [found.subject["margin"], found.subject["dt"]]
        numbers += [found.details.get(key, 0.0) for key in ("power", "mass_error")]
        assert all(isinstance(x, int | float) and math.isfinite(x) for x in numbers)
    except (OSError, ValueError, TypeError, KeyError, AttributeError, AssertionError, RecursionError, OverflowError):
        raise InputError(f"{path}: not a certificate of this version; run `ppcbf verify {folder}` again") from None
    if found.subject != subject(barrier, margin, dt):
        raise InputError(f"{path}: belongs to another barrier (its hashes differ); run `ppcbf verify {folder}` again")
    return found
