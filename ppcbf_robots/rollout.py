"""Closed-loop simulation: an engine between control steps, torque held, energy and contacts accounted for."""

from __future__ import annotations

import dataclasses
import json
import zipfile
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ppcbf_robots.controllers import NominalController
from ppcbf_robots.ending import GOAL_TOLERANCE, Ending, judge
from ppcbf_robots.engines import ContactLog, Engine, PinocchioEngine
from ppcbf_robots.errors import InputError
from ppcbf_robots.filters import Status
from ppcbf_robots.robot import RobotModel
from ppcbf_robots.safety import SafetyFunction
from ppcbf_robots.safety_filter import SafetyFilter, StepResult
from ppcbf_robots.specs import Array

RK4_STEP = 5e-4  # [s], the paper's T_s
NEAR = 0.05  # [m], clearance below which an arm counts as passing an obstacle
FASTEST = 1e4  # [rad/s | m/s], above which a run counts as diverged
V_FLOOR = 0.01  # [J], least storage that energy rises are compared with


@dataclass(frozen=True)
class Trajectory:
    """One row per control step; h and phi are the least over the rows."""

    t: Array  # (T,) [s]
    q: Array  # (T, nq)
    v: Array  # (T, nv)
    u: Array  # (T, nv) applied torque
    u_des: Array  # (T, nv)
    h: Array  # (T,)
    clearance: Array  # (T,) least h over obstacles and self-collision pairs, without limits [m]
    phi: Array  # (T,)
    V: Array  # (T,) storage [J]
    active: Array  # (T,) bool: the filter changed the torque
    status: Array  # (T,) see filters.Status
    meta: dict[str, Any]

    def save(self, path: Path) -> None:
        """Write an .npz; meta is stored as JSON text."""
        arrays = {k: x for k, x in vars(self).items() if k != "meta"}
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with path.open("wb") as file:
                np.savez_compressed(file, **arrays, meta=np.array(json.dumps(self.meta)))
        except OSError as error:
            raise InputError(f"{path}: cannot be written ({error.strerror})") from None

    @staticmethod
    def load(path: Path) -> Trajectory:
        """Read an .npz written by :meth:`save`; InputError if it is not one."""
        try:
            with np.load(path, allow_pickle=False) as file:
                data = {k: file[k] for k in FIELDS}
                meta = json.loads(str(file["meta"]))
        except FileNotFoundError:
            raise InputError(f"trajectory not found: {path}") from None
        except (KeyError, ValueError, TypeError, OSError, EOFError, zipfile.BadZipFile, zlib.error):
            raise InputError(f"{path}: not a trajectory of `ppcbf simulate`") from None
        fits = isinstance(meta, dict) and "goal" in meta
        if not fits or len({x.shape[:1] for x in data.values()}) != 1:
            raise InputError(f"{path}: not a trajectory of `ppcbf simulate` (its fields do not belong together)")
        return Trajectory(**data, meta=meta)

    def summary(self, model: RobotModel) -> dict[str, Any]:
        """Figures of the whole run; keys and units as documented for ``ppcbf simulate --json``."""
        V0 = max(float(self.V[0]), V_FLOOR)
        rise = float(np.max(self.V - np.minimum.accumulate(self.V)))
        goal = np.asarray(self.meta["goal"])
        error = float(np.max(np.abs(model.difference(self.q[-1], goal))))
        end = self.ending()
        contacts = self.meta.get("contacts")  # absent in files of version 0.1.0
        rates = self.rate_ratios(model)
        return {
            "min_h": float(self.h.min()),
            "clearance": float(self.clearance.min()),
            "max_torque_ratio": float(np.max(np.abs(self.u) / model.u_max)),
            "max_rate_ratio": None if rates is None else float(rates.max(initial=0.0)),
            "rate_violations": None if rates is None else int(np.sum(rates > 1.0 + 1e-9)),
            "energy_rise": rise / V0,
            "injected": float(np.maximum(np.diff(self.V), 0.0).sum()),
            "reached_goal": error < GOAL_TOLERANCE,
            "goal_error": error,
            "end": None if end is None else dataclasses.asdict(end) | {"remaining": end.remaining},
            "cleared_at": self._cleared_at(),
            "rests_on": next(iter(end.held_by)) if end is not None and end.state == "held" else None,
            "contacts": None if contacts is None else contacts["steps"],
            "hull_contacts": None if contacts is None else contacts.get("hull_steps", 0),  # 0.2.0 did not tell
            "contact_with": None
            if contacts is None
            else [f"{c['link']} / {c['obstacle']}" for c in contacts["pairs"] if not c.get("hull_only", False)],
            "filter_counts": {Status(s).name.lower(): int(np.sum(self.status == s)) for s in np.unique(self.status)},
        }

    def rate_ratios(self, model: RobotModel) -> Array | None:
        """Largest ``|u̇_i| / u_rate_i`` of each step (T - 1,), 0 to and from a STOP; None without rate limits."""
        if not np.any(np.isfinite(model.u_rate)):
            return None
        ratios = np.max(np.abs(np.diff(self.u, axis=0)) / (np.diff(self.t)[:, None] * model.u_rate), axis=1)
        stopped = self.status == Status.STOP
        return np.asarray(np.where(stopped[1:] | stopped[:-1], 0.0, ratios))

    def ending(self) -> Ending | None:
        """How the run ended; None if it diverged, or in files of version 0.2.0."""
        end = self.meta.get("end")
        return None if end is None else Ending(**end)

    def _cleared_at(self) -> float | None:
        """Time [s] after which the clearance stays above 5 cm; None if it never fell below, or never rose again."""
        near = np.flatnonzero(self.clearance <= NEAR)
        return float(self.t[near[-1] + 1]) if near.size and near[-1] + 1 < len(self.t) else None


FIELDS = [name for name in Trajectory.__dataclass_fields__ if name != "meta"]


def simulate(
    safety: SafetyFunction,
    controller: NominalController,
    safety_filter: SafetyFilter | None,
    q: Array,
    v: Array,
    duration: float,
    control_dt: float = 1e-3,
    meta: dict[str, Any] | None = None,
    on_step: Callable[[float], None] | None = None,
    engine: Engine | None = None,
) -> Trajectory:
    """Roll out from (q, v); ``safety_filter`` None applies u_des as it is.

    Args:
        safety: gives h for the record.
        controller: nominal controller.
        safety_filter: runtime filter, or None.
        q: start configuration (nq,).
        v: start velocity (nv,).
        duration: [s].
        control_dt: control period [s], rounded to whole integration steps of 5e-4 s.
        meta: stored with the trajectory.
        on_step: called with the time of every 50th step, for progress bars.
        engine: what moves the robot; by default Pinocchio, which knows no contact.
    """
    model = safety.robot
    engine = engine or PinocchioEngine(model)
    engine.reset(q, v)
    touched = ContactLog()
    substeps = max(1, round(control_dt / RK4_STEP))
    steps = max(1, round(duration / (substeps * RK4_STEP)))
    record: list[tuple[Any, ...]] = []
    last = StepResult(np.zeros(model.nv), Status.FREE, "", np.nan, np.nan, "")
    for i in range(steps + 1):
        t = i * substeps * RK4_STEP
        q, v = engine.state()
        touching = engine.contacts()
        touched.add(t, touching)
        dyn = model.evaluate(q, v)
        nominal = controller.evaluate(dyn)
        rows = safety.evaluate(dyn)
        if safety_filter is None:
            last = StepResult(nominal.u, Status.FREE, "no filter", float(rows.h.min()), np.nan, "")
        else:
            last = safety_filter.step(t, q, v, nominal.u, float(nominal.d_p))
        clearance = float(rows.h[: safety.pairs].min())
        record.append((t, q, v, last.u, nominal.u, float(rows.h.min()), clearance, last.phi, float(nominal.V),
                       last.status != Status.FREE, int(last.status)))  # fmt: skip
        if diverged(last.u, v):
            break
        engine.advance(last.u, RK4_STEP, substeps)
        if on_step is not None and i % 50 == 0:
            on_step(t)
    fields: dict[str, Any] = {k: np.array(x) for k, x in zip(FIELDS, zip(*record, strict=True), strict=True)}
    complete = len(record) == steps + 1
    touches = [f"{c.link} / {c.obstacle}" for c in touching or ()]
    extra = {"engine": engine.name, "contacts": touched.report()}
    return ended(fields, {**(meta or {}), **extra}, controller.goal, safety, last.row, touches, complete)


def diverged(u: Array, v: Array) -> NDArray[np.bool_]:
    """Whether a run ends here, (...): u and v (..., nv)."""
    lost = ~np.isfinite(u).all(axis=-1) | ~np.isfinite(v).all(axis=-1) | (np.abs(v) > FASTEST).any(axis=-1)
    return np.asarray(lost)


def ended(
    fields: dict[str, Any], meta: dict[str, Any], goal: Array, safety: SafetyFunction, row: str,
    touches: Sequence[str], complete: bool,
) -> Trajectory:  # fmt: skip
    """A record as a trajectory that says how it ends.

    Args:
        fields: arrays of :class:`Trajectory`, without meta.
        meta: of the caller.
        goal: (nq,).
        safety: the safety function of the run.
        row: that decided the last control step, "" if none.
        touches: contacts of the last state, "link / obstacle".
        complete: whether the run went on to its planned end.
    """
    deciding = row if Status(int(fields["status"][-1])) not in (Status.FREE, Status.STOP) else ""
    end = dataclasses.asdict(judge(fields, goal, safety, deciding, touches)) if complete else None
    return Trajectory(**fields, meta={**meta, "goal": goal.tolist(), "end": end, "complete": complete})
