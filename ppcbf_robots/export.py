"""A barrier as one file for other programs: phi and its gradient at (q, v), with no kinematics library inside.

The caller's own kinematics gives one row of the safety function; the file gives the barrier built on it:

* in: q (nq,) in Pinocchio's coordinates (a continuous joint is cos, sin), v (nv,) [rad/s | m/s], momentum (nv,)
  ``M(q) v``, the row's value h [m] and its gradient grad_h (nv,) with respect to the joint velocity coordinates;
* out: ``phi = grad_h·v + gamma h - K(q, v)`` [m/s], K [m/s], dphi_dv = w = grad_h - ∂K/∂v (nv,), which gives
  ``L_g phi = wᵀ M⁻¹``, and dK_dq (nq,), the learned part of ∂phi/∂q.

The rest of ∂phi/∂q, ``vᵀ ∇²h`` and ``gamma grad_h``, is kinematics and stays with the caller.
"""

from __future__ import annotations

import contextlib
import io
import json
import math
import warnings
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, get_args

import numpy as np

from ppcbf_robots.artefact import StoredBarrier
from ppcbf_robots.errors import InputError
from ppcbf_robots.export_c import c_header
from ppcbf_robots.network import NetworkKind, value_and_grad

ExportFormat = Literal["npz", "onnx", "c"]

ONNX_OPSET = 17  # oldest that has every operator in float64
INPUTS = ("q", "v", "momentum", "h", "grad_h")
OUTPUTS = ("phi", "K", "dphi_dv", "dK_dq")

_HIDDEN = "x <- elu(x W_i + b_i) for every hidden layer i, where elu(x) = x if x > 0 else exp(x) - 1"
_K_FORMULA: dict[NetworkKind, tuple[str, ...]] = {
    "mlp": (
        "x = ((q, v) - in_shift) * in_scale",
        _HIDDEN,
        "f(q, v) = x . w_out",
        "d = f(q, v) + (1 - zero_at_rest) b_out - zero_at_rest f(q, 0)",
        "K = d^2",
    ),
    "convex": (
        "x = ((q - in_shift) * in_scale, cos(q * turns), sin(q * turns))",
        _HIDDEN,
        "a = softplus(x Wa + ba), c = x Wc + bc, b = (x Wb + bb) as a (units, nv) matrix",
        "z = b (v * v_scale)",
        "F = softplus(cone_a) (sqrt(|cone_b v * v_scale|^2 + softplus(cone_c)^2) - softplus(cone_c))",
        "G = softplus(bowl_a) (softplus(|bowl_b v * v_scale|^2 - bowl_c) - softplus(-bowl_c))",
        "K = F + G + sum_j a_j (softplus(z_j + c_j) - softplus(c_j) - sigmoid(c_j) z_j)",
    ),
}
_PHI_FORMULA = (
    "energy = softplus(energy_a) energy_scale, or 0 without them; momentum = M v",
    "phi = grad_h . v + gamma h - K,  where K is the one above plus energy 1/2 v . momentum",
    "w = dphi_dv = grad_h - dK/dv - energy momentum,  L_g phi = w^T M^-1",
    "dphi/dt = v^T hessian(h) v + gamma grad_h . v - dK_dq . dq/dt - energy v . C v + w^T M^-1 (u - C v - g)",
    "dq/dt = v, but (-sin, cos) v for the (cos, sin) of a continuous joint",
    "a filter with class-K gain alpha keeps dphi/dt >= -alpha phi",
)


def export_barrier(stored: StoredBarrier, path: Path, format: ExportFormat) -> None:
    """Write a barrier's phi and gradient (see the module) to one file, replacing it only when complete.

    Formats: ``npz`` holds the parameters, each under its name, and ``metadata``, a JSON text with the formula. ``onnx``
    is a float64 graph with a free batch axis on every input and output; h, phi and K have shape (batch,). ``c`` is one
    C99 header that needs ``<math.h>`` alone; its functions carry the file's name as prefix.

    Raises:
        InputError: if the barrier has no learned term, its description is incomplete, the format is unknown, the onnx
            package is missing, or the file cannot be written.
    """
    if format not in get_args(ExportFormat):
        raise InputError(f"unknown export format '{format}' (known: {', '.join(get_args(ExportFormat))})")
    meta = describe(stored)
    if format == "npz":
        content = _npz(stored, meta)
    elif format == "onnx":
        content = _onnx(stored, meta)
    else:
        content = c_header(stored.network, meta, path.stem).encode("ascii", "backslashreplace")
    _write(path, content)


def describe(stored: StoredBarrier) -> dict[str, Any]:
    """What a reader of an exported file must know, as plain JSON data: joints, units, constants, domain and formula.

    Raises:
        InputError: if the barrier has no learned term, or its description lacks a key.
    """
    if stored.kind not in ("ncbf", "pp-ncbf"):
        raise InputError(f"a barrier of kind '{stored.kind}' has no learned term to export (with one: ncbf, pp-ncbf)")
    data, network = stored.data, stored.network
    try:
        joints, domain, alpha = data["joints"], data["domain"], stored.filter["alpha"]
        origin = {k: data[k] for k in ("robot", "world", "fingerprint")}
    except KeyError as error:
        raise InputError(f"barrier.json: the key {error} is missing; the file was altered") from None
    nv = len(joints)
    nq = network.params["in_shift"].shape[0] - (nv if network.kind == "mlp" else 0)
    return {
        "kind": stored.kind,
        "network": network.kind,
        **origin,
        "gamma": stored.spec.gamma,
        "alpha": alpha,
        "energy": network.energy,
        "nq": nq,
        "nv": nv,
        "joints": joints,
        "q_layout": _q_layout(data, nq),
        "domain": domain,
        "units": {
            "q": "rad | m, or cos and sin of a continuous joint",
            "v": "rad/s | m/s",
            "h": "m (rad for the limit of a rotary joint)",
            "phi": "m/s (rad/s for the limit of a rotary joint)",
            "gamma": "1/s",
            "alpha": "1/s",
            "energy": "m/(s J)",
            "momentum": "kg m^2/s | kg m/s",
            "domain": "q in rad | m, one angle per joint; v in rad/s | m/s",
        },
        "formula": [*_K_FORMULA[network.kind], *_PHI_FORMULA],
    }


def _q_layout(data: dict[str, Any], nq: int) -> list[str] | None:
    """Name of every entry of q, or None if the description does not tell which joints are continuous."""
    joints, limits = data["joints"], data.get("limits", {})
    bounds = zip(limits.get("lower", joints), limits.get("upper", joints), strict=True)
    continuous = [low is None and high is None for low, high in bounds]
    if nq == len(joints):
        continuous = [False] * nq
    if len(joints) + sum(continuous) != nq:
        return None
    names = ([f"cos({j})", f"sin({j})"] if c else [j] for j, c in zip(joints, continuous, strict=True))
    return [name for pair in names for name in pair]


def _npz(stored: StoredBarrier, meta: dict[str, Any]) -> bytes:
    buffer = io.BytesIO()
    arrays: dict[str, Any] = {**stored.network.params, "metadata": np.array(json.dumps(meta))}
    np.savez(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()


def _onnx(stored: StoredBarrier, meta: dict[str, Any]) -> bytes:
    try:
        import onnx
    except ImportError:
        raise InputError('ONNX export needs the onnx package; remedy: pip install "ppcbf-robots[onnx]"') from None
    model = onnx.load_from_string(_trace(stored, meta["nq"], meta["nv"]))
    sizes = {"dphi_dv": meta["nv"], "dK_dq": meta["nq"]}
    for output in model.graph.output:  # the tracer leaves invented names for sizes that are known
        if output.name in sizes:
            output.type.tensor_type.shape.dim[1].dim_value = sizes[output.name]
    texts = {k: x if isinstance(x, str) else json.dumps(x) for k, x in meta.items()}
    onnx.helper.set_model_props(model, {**texts, "precision": "float64"})
    model.doc_string = "\n".join(meta["formula"])
    onnx.checker.check_model(model, full_check=True)
    return bytes(model.SerializeToString())


def _trace(stored: StoredBarrier, nq: int, nv: int) -> bytes:
    """The traced graph of phi and its analytic gradient, before any description is added."""
    import torch

    network, gamma = stored.network, stored.spec.gamma
    params = {k: torch.tensor(w) for k, w in network.params.items()}

    class Ops:
        """torch, but with sines for cosines: onnxruntime has cosines in float64 only since mid-2026."""

        def __getattr__(self, name: str) -> Any:
            return getattr(torch, name)

        def cos(self, x: Any) -> Any:
            return torch.sin(x + 0.5 * math.pi)

    class Phi(torch.nn.Module):
        def forward(self, q: Any, v: Any, momentum: Any, h: Any, grad_h: Any) -> tuple[Any, ...]:
            K, dK_dq, dK_dv = value_and_grad(Ops(), network.kind, params, q, v)
            K = K + 0.5 * network.energy * (v * momentum).sum(-1)
            dK_dv = dK_dv + network.energy * momentum
            return (grad_h * v).sum(-1) + gamma * h - K, K, grad_h - dK_dv, dK_dq

    shapes = ((2, nq), (2, nv), (2, nv), (2,), (2, nv))  # any batch but 1, which the tracer could take for a constant
    example = tuple(torch.zeros(shape, dtype=torch.float64) for shape in shapes)
    with TemporaryDirectory() as folder, warnings.catch_warnings():
        # the tracer is announced to go, but its successor needs one more package and gains nothing here
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.onnx.export(
            Phi(),
            example,
            Path(folder, "model.onnx"),
            dynamo=False,
            opset_version=ONNX_OPSET,
            input_names=INPUTS,
            output_names=OUTPUTS,
            dynamic_axes={name: {0: "batch"} for name in (*INPUTS, *OUTPUTS)},
        )
        return Path(folder, "model.onnx").read_bytes()


def _write(path: Path, content: bytes) -> None:
    if path.is_dir():
        raise InputError(f"{path} is a folder; give the path of the file to write")
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_bytes(content)
        temporary.replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise InputError(f"{path}: cannot be written ({error.strerror})") from None
