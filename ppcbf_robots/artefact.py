"""The barrier folder: ``barrier.json`` and ``weights.safetensors``, bound to robot and world by hash."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors

from ppcbf_robots.barriers import Barrier, BarrierKind
from ppcbf_robots.errors import InputError
from ppcbf_robots.filters import FilterConfig
from ppcbf_robots.network import NetworkKind, NumpyNetwork, Params
from ppcbf_robots.problem import Problem
from ppcbf_robots.specs import BarrierSpec, validate

FORMAT = 1
PACKAGES = ("ppcbf-robots", "pin", "numpy", "torch", "proxsuite")


@dataclass(frozen=True)
class StoredBarrier:
    """A barrier read back from its folder."""

    kind: BarrierKind
    spec: BarrierSpec
    network: NumpyNetwork
    filter: dict[str, Any]  # kind, metric and alpha of the filter it was trained for
    data: dict[str, Any]  # barrier.json

    def barrier(self, problem: Problem) -> Barrier:
        """The barrier on a problem it belongs to; refuses another robot or world.

        Raises:
            InputError: if URDF, robot parameters or obstacles are not those of the training.
        """
        expected, found = self.data["fingerprint"], problem.fingerprint()
        words = {
            "urdf": "another robot (its URDF differs)",
            "robot": "other robot parameters (joints, limits, payload or body spheres differ)",
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
    weights = save_tensors({k: np.ascontiguousarray(w, dtype=np.float64) for k, w in params.items()})
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
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        weights = (folder / "weights.safetensors").read_bytes()
    except FileNotFoundError as error:
        raise InputError(f"{folder} is not a barrier folder: {Path(error.filename).name} is missing") from None
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({error})") from None
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise InputError(f"{path}: not a barrier of format {FORMAT}; train it again with this version")
    missing = [k for k in ("kind", "network", "formula", "filter", "fingerprint", "weights_sha256", "robot", "world")
               if k not in data]  # fmt: skip
    if missing:
        raise InputError(f"{path}: the key '{missing[0]}' is missing; the file was altered")
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
    network = NumpyNetwork(data["network"], params)
    _check_shapes(path, data, network)
    spec = validate(data["formula"], BarrierSpec, f"{path}: formula")
    return StoredBarrier(data["kind"], spec, network, data["filter"], data)


def _check_shapes(path: Path, data: dict[str, Any], network: NumpyNetwork) -> None:
    nv = len(data.get("joints", []))
    nq = network.params["in_shift"].shape[0] - (nv if network.kind == "mlp" else 0) if "in_shift" in network.params else 0
    try:
        K, K_q, K_v = network.value_and_grad(np.zeros(nq), np.zeros(nv))
        shapes = np.shape(K), np.shape(K_q), np.shape(K_v)
    except (ValueError, KeyError, IndexError):
        shapes = None
    if shapes != ((), (nq,), (nv,)):
        raise InputError(f"{path}: the weights' shapes do not fit {nv} joints; the files do not belong together")


def _finite(x: float) -> float | None:
    return float(x) if np.isfinite(x) else None


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None
