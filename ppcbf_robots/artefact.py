"""The barrier folder: ``barrier.json`` and ``weights.safetensors``, bound to robot and world by hash."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors

from ppcbf_robots.barriers import Barrier, BarrierKind
from ppcbf_robots.certificate import Certificate, digest, load_certificate, subject
from ppcbf_robots.errors import InputError
from ppcbf_robots.filters import FilterConfig, FilterKind, Metric
from ppcbf_robots.network import NetworkKind, NumpyNetwork, Params
from ppcbf_robots.problem import Problem
from ppcbf_robots.specs import BarrierSpec, Positive, Spec, validate

log = logging.getLogger(__name__)

FORMAT = 4
KEYS = {"kind": str, "network": str, "formula": dict, "filter": dict, "fingerprint": dict, "weights_sha256": str,
        "robot": str, "world": str, "joints": list, "training": dict}  # fmt: skip
PACKAGES = ("ppcbf-robots", "pin", "numpy", "torch", "proxsuite")


class TrainedFilter(Spec):
    """The filter a barrier was trained for."""

    kind: FilterKind
    metric: Metric
    alpha: Positive  # [1/s]


@dataclass(frozen=True)
class StoredBarrier:
    """A barrier read back from its folder."""

    kind: BarrierKind
    spec: BarrierSpec
    network: NumpyNetwork
    filter: dict[str, Any]  # kind, metric and alpha of the filter it was trained for
    data: dict[str, Any]  # barrier.json
    certificate: Certificate | None = None  # what `ppcbf verify` found out; None if it was not asked, or of another

    @property
    def digest(self) -> str:
        """SHA-256 of weights, constants, filter, robot, world and goal."""
        return digest(subject(self.data, 0.0, 0.0))

    def filter_config(self, **changes: Any) -> FilterConfig:
        """Settings of the filter the barrier was trained for, with changes such as ``dt`` or ``solver``."""
        return FilterConfig(**(self.filter | changes))

    def barrier(self, problem: Problem) -> Barrier:
        """The barrier on a problem it belongs to; refuses another robot, controller, domain or world.

        Raises:
            InputError: if URDF, robot parameters, gains, domain or obstacles are not those of the training.
        """
        expected, found = self.data["fingerprint"], problem.fingerprint()
        words = {
            "urdf": "another robot (its URDF differs)",
            "robot": "other robot parameters (joints, limits, payload or body spheres differ)",
            "task": "another controller or domain X (gains or ranges differ)",
            "world": "another world (the obstacles differ)",
        }
        for key, what in words.items():
            if expected.get(key) != found[key]:
                trained = f"'{self.data['robot']}' and '{self.data['world']}'"
                raise InputError(f"this barrier was trained for {what}: it is for {trained}; train one for this pair")
        return problem.barrier(self.kind, self.network, self.spec)


def save_barrier(
    folder: Path,
    problem: Problem,
    kind: BarrierKind,
    network_kind: NetworkKind,
    params: Params,
    filter_config: FilterConfig,
    report: dict[str, Any],
) -> None:
    """Write the folder: weights first, then barrier.json by an atomic rename."""
    weights = save_tensors({k: np.asarray(w, dtype=np.float64, order="C") for k, w in params.items()})
    robot, model = problem.robot, problem.model
    gains = robot.controller.gains
    data = {
        "format": FORMAT,
        "kind": kind,
        "network": network_kind,
        "formula": robot.spec.barrier.model_dump(),
        "filter": {"kind": filter_config.kind, "metric": filter_config.metric, "alpha": filter_config.alpha},
        "robot": robot.name,
        "world": problem.world_name,
        "joints": model.joint_names,
        "locked": model.locked,
        "limits": {"effort": model.u_max.tolist(), "velocity": model.v_max.tolist(),
                   "lower": [_finite(x) for x in model.q_lower], "upper": [_finite(x) for x in model.q_upper]},
        "controller": {"type": gains.kind, "kp": gains.kp.tolist(), "kd": gains.kd.tolist(),
                       "max_spring": gains.max_spring.tolist()},
        "domain": {"q": robot.domain.q.tolist(), "v": robot.domain.v.tolist()},
        "start": model.to_angles(robot.start).tolist(),
        "goal": model.to_angles(robot.goal).tolist(),
        "payload": None if robot.spec.payload is None else robot.spec.payload.model_dump(),
        "body": [s.model_dump() for s in robot.body],
        "obstacles": [o.model_dump() for o in problem.world.obstacles],
        "fingerprint": problem.fingerprint(),
        "urdf_sha256": model.urdf_sha256,
        "weights_sha256": hashlib.sha256(weights).hexdigest(),
        "training": report,
        "versions": {name: _version(name) for name in PACKAGES},
    }  # fmt: skip
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, content in (("weights.safetensors", weights), ("barrier.json", json.dumps(data, indent=1).encode())):
            temporary = folder / f".{name}.tmp"
            temporary.write_bytes(content)
            temporary.replace(folder / name)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror})") from None


def load_barrier(folder: Path) -> StoredBarrier:
    """Read a barrier folder and check its hashes, shapes and values.

    Raises:
        InputError: if anything is missing, altered or not finite.
    """
    path = folder / "barrier.json"
    for file in (path, folder / "weights.safetensors"):
        if not file.is_file():
            raise InputError(f"{folder} is not a barrier folder: {file.name} is missing")
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        weights = (folder / "weights.safetensors").read_bytes()
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: cannot be read ({error})") from None
    if isinstance(data, dict) and data.get("format") in range(1, FORMAT):
        raise InputError(f"{path}: a barrier of an earlier version, which this one cannot read; train it again")
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise InputError(f"{path}: not a barrier of format {FORMAT}; train it again with this version")
    for key, kind in KEYS.items():
        if key not in data:
            raise InputError(f"{path}: the key '{key}' is missing; the file was altered")
        if not isinstance(data[key], kind):
            raise InputError(f"{path}: the key '{key}' does not hold a {kind.__name__}; the file was altered")
    if hashlib.sha256(weights).hexdigest() != data["weights_sha256"]:
        raise InputError(f"{folder}/weights.safetensors: altered since training (its SHA-256 differs); train again")
    if data["kind"] not in get_args(BarrierKind) or data["network"] not in get_args(NetworkKind):
        raise InputError(f"{path}: unknown kind '{data['kind']}' or network '{data['network']}'")
    try:
        params = load_tensors(weights)
    except (SafetensorError, ValueError) as error:
        raise InputError(f"{folder}/weights.safetensors: not a safetensors file ({error})") from None
    for name, w in params.items():
        if not np.all(np.isfinite(w)):
            raise InputError(f"{folder}/weights.safetensors: '{name}' holds values that are not finite")
    if not _shapes_fit(data["network"], params, len(data["joints"])):
        joints = len(data["joints"])
        raise InputError(f"{path}: the weights' shapes do not fit {joints} joints; the files do not belong together")
    trained = validate(data["filter"], TrainedFilter, f"{path}: filter")
    spec = validate(data["formula"], BarrierSpec, f"{path}: formula")
    try:
        certificate = load_certificate(folder, data)
    except InputError as error:
        log.warning("the certificate is ignored: %s", error)
        certificate = None
    network = NumpyNetwork(data["network"], params)
    return StoredBarrier(data["kind"], spec, network, trained.model_dump(), data, certificate)


def _shapes_fit(kind: NetworkKind, params: Params, nv: int) -> bool:
    """Whether every array is there, and no other, with the shape that the layers before it and nv joints ask for."""
    inputs = np.size(params.get("in_shift", ()))
    nq, width = (inputs - nv, inputs) if kind == "mlp" else (inputs, 3 * inputs)
    shapes: dict[str, tuple[int, ...]] = {"in_shift": (inputs,), "in_scale": (inputs,)}
    for i in range(sum(name.startswith("W") and name[1:].isdigit() for name in params)):
        units = np.size(params.get(f"b{i}", ()))
        shapes |= {f"W{i}": (width, units), f"b{i}": (units,)}
        width = units
    units = np.size(params.get("ba", ()))
    if kind == "mlp":
        shapes |= {"w_out": (width,), "b_out": (), "zero_at_rest": ()}
    else:
        shapes |= {"turns": (nq,), "Wa": (width, units), "Wb": (width, units * nv), "Wc": (width, units)}
        shapes |= {"ba": (units,), "bb": (units * nv,), "bc": (units,), "v_scale": (nv,)}
        for form in ("cone", "bowl"):
            shapes |= {f"{form}_a": (), f"{form}_b": (nv,), f"{form}_c": ()}
        if "energy_a" in params:
            shapes |= {"energy_a": (), "energy_scale": ()}
    return nv <= nq <= 2 * nv and {name: w.shape for name, w in params.items()} == shapes


def _finite(x: float) -> float | None:
    return float(x) if np.isfinite(x) else None


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None
