"""The learned term K_theta against independent oracles, and its exports against the numpy evaluation."""

from __future__ import annotations

import ctypes
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ppcbf_robots.artefact import StoredBarrier
from ppcbf_robots.errors import InputError
from ppcbf_robots.export import describe, export_barrier
from ppcbf_robots.network import NumpyNetwork, value_and_grad
from ppcbf_robots.specs import BarrierSpec

CONTINUOUS = {
    "two_link": [False] * 2,
    "panda": [False] * 7,
    "kinova": [True, False, False, True, False, True],  # nq 9, nv 6
}
KINDS = ("mlp", "convex")
CASES = [(robot, kind) for robot in CONTINUOUS for kind in KINDS]
seeds = st.integers(0, 2**32 - 1)
kinds = st.sampled_from(KINDS)


def sizes(robot: str) -> tuple[int, int]:
    """(nq, nv)."""
    return len(CONTINUOUS[robot]) + sum(CONTINUOUS[robot]), len(CONTINUOUS[robot])


def random_network(kind: str, nq: int, nv: int, rng: np.random.Generator, widths=(13, 10), units=3) -> NumpyNetwork:
    """K_theta with weights of order one; the widths are no multiples of the unrolled loops of the C header."""
    n_in = nq + nv if kind == "mlp" else nq
    params: dict[str, Any] = {"in_shift": rng.normal(size=n_in), "in_scale": rng.uniform(0.3, 1.5, n_in)}
    n = n_in if kind == "mlp" else 3 * nq
    for i, m in enumerate(widths):
        params[f"W{i}"], params[f"b{i}"] = rng.normal(size=(n, m)) / np.sqrt(n), rng.normal(size=m)
        n = m
    if kind == "mlp":
        params |= {"w_out": rng.normal(size=n) / np.sqrt(n), "b_out": rng.normal(), "zero_at_rest": 1.0}
    else:
        for name, m in (("a", units), ("c", units), ("b", units * nv)):
            params[f"W{name}"], params[f"b{name}"] = rng.normal(size=(n, m)) / np.sqrt(n), rng.normal(size=m)
        params |= {"v_scale": rng.uniform(0.3, 1.5, nv), "turns": rng.integers(0, 2, nq)}
        for form in ("cone", "bowl"):
            params |= {f"{form}_a": rng.normal(), f"{form}_b": rng.normal(size=nv), f"{form}_c": rng.normal()}
        params |= {"energy_a": rng.normal(), "energy_scale": rng.uniform(0.1, 1.0)} if nv > 2 else {}
    return NumpyNetwork(kind, params)


def stored_barrier(robot: str, kind: str, seed: int = 0, **changes: Any) -> StoredBarrier:
    """A barrier as if read from its folder, with random weights."""
    nq, nv = sizes(robot)
    free = [None if c else -1.5 for c in CONTINUOUS[robot]]
    data = {
        "joints": [f"joint_{i}" for i in range(1, nv + 1)],
        "limits": {"lower": free, "upper": [x and -x for x in free]},
        "domain": {"q": [[-1.5, 1.5]] * nv, "v": [[-2.0, 2.0]] * nv},
        "robot": robot,
        "world": "sphere",
        "fingerprint": {"urdf": "00", "robot": "11", "world": "22"},
    } | changes
    network = random_network(kind, nq, nv, np.random.default_rng(seed))
    return StoredBarrier("pp-ncbf", BarrierSpec(gamma=4.3), network, {"alpha": 7.0}, data)


def random_inputs(robot: str, batch: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    nq, nv = sizes(robot)
    return {"q": rng.normal(size=(batch, nq)), "v": 2.0 * rng.normal(size=(batch, nv)),
            "momentum": rng.normal(size=(batch, nv)), "h": rng.normal(size=batch),
            "grad_h": rng.normal(size=(batch, nv))}  # fmt: skip


def expected(network: NumpyNetwork, gamma: float, q, v, momentum, h, grad_h) -> dict[str, np.ndarray]:
    """The numpy evaluation of everything an export gives."""
    K, dK_dq, dK_dv = network.value_and_grad(q, v)
    energy = np.logaddexp(0.0, network.params["energy_a"]) * network.params["energy_scale"] if network.energy else 0.0
    K, dK_dv = K + 0.5 * energy * (v * momentum).sum(-1), dK_dv + energy * momentum
    return {"phi": (grad_h * v).sum(-1) + gamma * h - K, "K": K, "dphi_dv": grad_h - dK_dv, "dK_dq": dK_dq}


def assert_close(got: Any, wanted: Any, tolerance: float) -> None:
    """Equal up to ``tolerance`` of the largest magnitude (at least 1)."""
    assert np.shape(got) == np.shape(wanted)
    assert np.abs(got - wanted).max() <= tolerance * max(1.0, np.abs(wanted).max())


# ---- the learned term itself ----


@settings(max_examples=40, deadline=None)
@given(seed=seeds, kind=kinds, rest=st.sampled_from([0.0, 1.0]))
def test_gradients_equal_central_differences(seed: int, kind: str, rest: float) -> None:
    rng = np.random.default_rng(seed)
    network = random_network(kind, 5, 4, rng)
    if kind == "mlp":
        network.params["zero_at_rest"] = np.asarray(rest)
    x, step = rng.normal(size=9), 1e-6
    moved = np.concatenate([x + step * np.eye(9), x - step * np.eye(9)])
    K = network.value_and_grad(moved[:, :5], moved[:, 5:])[0]
    _, dK_dq, dK_dv = network.value_and_grad(x[:5], x[5:])
    assert_close(np.concatenate([dK_dq, dK_dv]), (K[:9] - K[9:]) / (2.0 * step), 2e-5)


@settings(max_examples=40, deadline=None)
@given(seed=seeds, kind=kinds)
def test_numpy_equals_torch(seed: int, kind: str) -> None:
    rng = np.random.default_rng(seed)
    network = random_network(kind, 5, 4, rng)
    q, v = rng.normal(size=(3, 5)), rng.normal(size=(3, 4)) * 10.0 ** rng.uniform(-3, 3)
    params = {k: torch.tensor(w) for k, w in network.params.items()}
    from_torch = value_and_grad(torch, kind, params, torch.tensor(q), torch.tensor(v))
    for a, b in zip(network.value_and_grad(q, v), from_torch, strict=True):
        assert_close(b.numpy(), a, 1e-9)


@settings(max_examples=40, deadline=None)
@given(seed=seeds, kind=kinds)
def test_zero_with_zero_gradient_at_rest(seed: int, kind: str) -> None:
    rng = np.random.default_rng(seed)
    for term in random_network(kind, 5, 4, rng).value_and_grad(rng.normal(size=5), np.zeros(4)):
        assert np.all(term == 0.0)


@settings(max_examples=60, deadline=None)
@given(seed=seeds)
def test_convex_form_is_convex_along_rays_and_dissipates(seed: int) -> None:
    rng = np.random.default_rng(seed)
    network = random_network("convex", 5, 4, rng)
    t = np.linspace(-4.0, 4.0, 81)[:, None]
    v = t * rng.normal(size=4)
    K, _, dK_dv = network.value_and_grad(np.broadcast_to(rng.normal(size=5), (81, 5)), v)
    rounding = 1e-12 * K.max()
    assert K.min() >= -rounding and K.max() > 0.0
    assert np.all(K[:-2] + K[2:] - 2.0 * K[1:-1] >= -rounding)
    assert np.all((v * dK_dv).sum(-1) >= K - rounding)


# ---- exports ----


@pytest.mark.parametrize(("robot", "kind"), CASES)
def test_npz_round_trip_is_exact(robot: str, kind: str, tmp_path: Path) -> None:
    stored = stored_barrier(robot, kind)
    export_barrier(stored, tmp_path / "barrier.npz", "npz")
    with np.load(tmp_path / "barrier.npz", allow_pickle=False) as file:
        arrays = dict(file)
    meta = json.loads(str(arrays.pop("metadata")))
    assert (meta["kind"], meta["network"], meta["gamma"], meta["alpha"]) == ("pp-ncbf", kind, 4.3, 7.0)
    assert (meta["joints"], meta["domain"]) == (stored.data["joints"], stored.data["domain"])
    inputs = random_inputs(robot, 5, np.random.default_rng(1))
    got = expected(NumpyNetwork(meta["network"], arrays), meta["gamma"], **inputs)
    for name, wanted in expected(stored.network, stored.spec.gamma, **inputs).items():
        assert np.array_equal(got[name], wanted), name


@pytest.mark.parametrize(("robot", "kind"), CASES)
def test_onnx_equals_numpy_for_any_batch(robot: str, kind: str, tmp_path: Path) -> None:
    onnx = pytest.importorskip("onnx")
    runtime = pytest.importorskip("onnxruntime")
    stored, path = stored_barrier(robot, kind), tmp_path / "barrier.onnx"
    export_barrier(stored, path, "onnx")
    session = runtime.InferenceSession(path, providers=["CPUExecutionProvider"])
    for batch in (1, 7):
        inputs = random_inputs(robot, batch, np.random.default_rng(batch))
        wanted = expected(stored.network, stored.spec.gamma, **inputs)
        for name, got in zip(wanted, session.run(list(wanted), inputs), strict=True):
            assert got.dtype == np.float64
            assert_close(got, wanted[name], 1e-12)
    operators = {node.op_type for node in onnx.load(path).graph.node}
    assert "Cos" not in operators and ("Sin" in operators) == (kind == "convex")
    props = session.get_modelmeta().custom_metadata_map
    assert json.loads(props["joints"]) == stored.data["joints"] and float(props["gamma"]) == 4.3
    assert [o.shape for o in session.get_outputs()] == [["batch"]] * 2 + [["batch", n] for n in sizes(robot)[::-1]]


SHARED = """\
#include "my-arm.h"
double phi(const double *q, const double *v, const double *momentum, double h, const double *grad_h, double *K,
           double *w, double *dK_dq)
{
    return my_arm_phi(q, v, momentum, h, grad_h, K, w, dK_dq);
}
"""


def compiled(stored: StoredBarrier, folder: Path) -> Any:
    """The exported header behind one exported symbol, loaded into this process."""
    gcc = shutil.which("gcc")
    if gcc is None:
        pytest.skip("needs gcc")
    export_barrier(stored, folder / "my-arm.h", "c")
    (folder / "shared.c").write_text(SHARED)
    flags = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-O2", "-fPIC", "-shared"]
    subprocess.run([gcc, *flags, "shared.c", "-o", "shared.so", "-lm"], cwd=folder, check=True)
    library = ctypes.CDLL(str(folder / "shared.so"))
    array, number = np.ctypeslib.ndpointer(np.float64, flags="C_CONTIGUOUS"), ctypes.c_double
    library.phi.restype, library.phi.argtypes = number, [array, array, array, number, array, array, array, array]
    return library


def run_c(library: Any, q, v, momentum, h, grad_h) -> dict[str, Any]:
    K, w, dK_dq = np.full(1, np.nan), np.full(v.shape, np.nan), np.full(q.shape, np.nan)
    phi = library.phi(q, v, momentum, h, grad_h, K, w, dK_dq)
    return {"phi": np.float64(phi), "K": K[0], "dphi_dv": w, "dK_dq": dK_dq}


@pytest.mark.parametrize(("robot", "kind"), CASES)
def test_c_equals_numpy(robot: str, kind: str, tmp_path: Path) -> None:
    stored = stored_barrier(robot, kind)
    library = compiled(stored, tmp_path)
    rng = np.random.default_rng(2)
    for scale in (0.0, 1e-3, 1.0, 1.0, 1.0, 1e3):  # at rest; small; usual; where exp would overflow
        one = {k: x[0] for k, x in random_inputs(robot, 1, rng).items()}
        one["v"], one["momentum"] = one["v"] * scale, one["momentum"] * scale
        wanted = expected(stored.network, stored.spec.gamma, **one)
        for name, got in run_c(library, **one).items():
            assert_close(got, wanted[name], 1e-9)


@pytest.mark.parametrize("widths", [(), (1,), (8, 3, 5)])
@pytest.mark.parametrize("kind", KINDS)
def test_c_equals_numpy_for_other_depths_and_the_paper_form(kind: str, widths: tuple[int, ...], tmp_path: Path) -> None:
    stored, rng = stored_barrier("two_link", kind), np.random.default_rng(3)
    stored.network.params = random_network(kind, 2, 2, rng, widths, units=1).params
    if kind == "mlp":
        stored.network.params["zero_at_rest"] = np.asarray(0.0)
    one = {k: x[0] for k, x in random_inputs("two_link", 1, rng).items()}
    wanted = expected(stored.network, stored.spec.gamma, **one)
    for name, got in run_c(compiled(stored, tmp_path), **one).items():
        assert_close(got, wanted[name], 1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_c_holds_every_parameter_exactly(kind: str, tmp_path: Path) -> None:
    stored = stored_barrier("kinova", kind)
    export_barrier(stored, tmp_path / "1 barrier.h", "c")
    text = (tmp_path / "1 barrier.h").read_text("ascii")
    for name, w in stored.network.params.items():
        body = re.search(rf"double b_1_barrier_{name}\[{w.size}\] = {{(?: /\*.*?\*/)?(.*?)}};", text, re.DOTALL)
        assert body and np.array_equal(np.array(body[1].split(","), dtype=float), w.ravel()), name
    assert "q (9)" in text and "cos(joint_1), sin(joint_1), joint_2" in text
    assert "gamma = 4.3 1/s" in text and "joint_6: q in [-1.5, 1.5], v in [-2, 2]" in text


def test_c_survives_hostile_names(tmp_path: Path) -> None:
    joints = ["a */ int", "ß /* \\"]
    stored = stored_barrier("two_link", "convex", joints=joints, world='"*/ \n/*')
    stored.data["robot"] = "folder/*.urdf */ ??/"
    compiled(stored, tmp_path)


def test_description_names_no_layout_it_does_not_know() -> None:
    assert describe(stored_barrier("kinova", "mlp", limits={}))["q_layout"] is None
    unlimited = {"lower": [None] * 2, "upper": [None] * 2}
    assert describe(stored_barrier("two_link", "mlp", limits=unlimited))["q_layout"] == ["joint_1", "joint_2"]


# ---- refusals ----


def test_missing_onnx_is_told_with_the_remedy(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(InputError, match=re.escape('pip install "ppcbf-robots[onnx]"')):
        export_barrier(stored_barrier("two_link", "mlp"), tmp_path / "barrier.onnx", "onnx")
    assert not list(tmp_path.iterdir())


def test_paths_that_cannot_be_written(tmp_path: Path) -> None:
    stored = stored_barrier("two_link", "mlp")
    (tmp_path / "file").write_text("kept")
    with pytest.raises(InputError, match=r"barrier\.npz: cannot be written \("):
        export_barrier(stored, tmp_path / "file" / "barrier.npz", "npz")
    with pytest.raises(InputError, match="is a folder; give the path of the file to write"):
        export_barrier(stored, tmp_path, "c")
    assert [p.name for p in tmp_path.iterdir()] == ["file"] and (tmp_path / "file").read_text() == "kept"


def test_a_failed_replacement_keeps_the_old_file(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    path = tmp_path / "barrier.npz"
    path.write_text("old")

    def fail(self: Path, target: Path) -> Path:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(Path, "replace", fail)
    with pytest.raises(InputError, match="cannot be written"):
        export_barrier(stored_barrier("two_link", "mlp"), path, "npz")
    assert path.read_text() == "old" and [p.name for p in tmp_path.iterdir()] == ["barrier.npz"]


def test_refuses_what_has_no_learned_term_or_description(tmp_path: Path) -> None:
    stored = stored_barrier("two_link", "mlp")
    plain = StoredBarrier("pp-cbf", stored.spec, stored.network, stored.filter, stored.data)
    with pytest.raises(InputError, match="'pp-cbf' has no learned term"):
        export_barrier(plain, tmp_path / "x", "npz")
    del stored.data["domain"]
    with pytest.raises(InputError, match="the key 'domain' is missing"):
        export_barrier(stored, tmp_path / "x", "npz")
    with pytest.raises(InputError, match=r"unknown export format 'zip' \(known: npz, onnx, c\)"):
        export_barrier(stored, tmp_path / "x", "zip")
