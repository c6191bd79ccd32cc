"""The barrier folder: what was saved comes back, and nothing altered, foreign or broken is accepted."""

from __future__ import annotations

import hashlib
import json
import os

import numpy as np
import pytest
from safetensors.numpy import save as save_tensors

from ppcbf_robots.artefact import StoredBarrier, load_barrier, save_barrier
from ppcbf_robots.errors import InputError
from ppcbf_robots.filters import FilterConfig, Status
from ppcbf_robots.problem import load_problem
from ppcbf_robots.resources import find_robot
from ppcbf_robots.safety_filter import SafetyFilter

CONFIG = FilterConfig(kind="qp", metric="kinetic", alpha=7.0)


@pytest.fixture(params=["mlp", "convex"])
def network(request, two_link, random_network):
    return random_network(request.param, two_link.model.nq, two_link.model.nv, seed=3)


@pytest.fixture
def folder(tmp_path, two_link, network):
    """A barrier folder for the 2R."""
    save_barrier(tmp_path / "b", two_link, "pp-ncbf", network.kind, network.params, CONFIG, {"steps": 3})
    return tmp_path / "b"


def refusal(folder) -> str:
    with pytest.raises(InputError) as error:
        load_barrier(folder)
    assert "\n" not in str(error.value)
    return str(error.value)


def edit(folder, **changes):
    """Change keys of barrier.json; None removes one."""
    path = folder / "barrier.json"
    data = {**json.loads(path.read_text()), **changes}
    path.write_text(json.dumps({k: x for k, x in data.items() if x is not None}))


def replace_weights(folder, params):
    """Other weights, with the hash they have."""
    content = save_tensors({k: np.array(w, order="C") for k, w in params.items()})
    (folder / "weights.safetensors").write_bytes(content)
    edit(folder, weights_sha256=hashlib.sha256(content).hexdigest())


def test_what_was_saved_comes_back(folder, two_link, network, states):
    stored = load_barrier(folder)
    assert (stored.kind, stored.network.kind) == ("pp-ncbf", network.kind)
    assert stored.spec == two_link.robot.spec.barrier
    assert stored.filter == {"kind": "qp", "metric": "kinetic", "alpha": 7.0}
    assert stored.data["training"] == {"steps": 3}
    assert (stored.data["robot"], stored.data["world"]) == ("two_link", "circle")
    barrier, original = stored.barrier(two_link), two_link.barrier("pp-ncbf", network)
    for q, v in states(two_link, 5):
        dyn = two_link.model.evaluate(q, v)
        rows = [b.rows(dyn, two_link.safety.evaluate(dyn)) for b in (barrier, original)]
        for name, value in vars(rows[0]).items():
            np.testing.assert_array_equal(value, getattr(rows[1], name))


def test_a_stored_barrier_filters(folder, two_link):
    filter_ = SafetyFilter(two_link.model, two_link.safety, load_barrier(folder).barrier(two_link))
    result = filter_.step(0.0, two_link.robot.start, np.zeros(2), two_link.model.gravity(two_link.robot.start), 0.0)
    assert result.status is Status.FREE


def test_the_folder_holds_two_files_and_no_leftovers(folder):
    assert sorted(p.name for p in folder.iterdir()) == ["barrier.json", "weights.safetensors"]


def test_saving_again_replaces(folder, two_link, network):
    other = {k: 2.0 * np.asarray(w) for k, w in network.params.items()}
    save_barrier(folder, two_link, "ncbf", network.kind, other, CONFIG, {})
    stored = load_barrier(folder)
    assert stored.kind == "ncbf"
    np.testing.assert_array_equal(stored.network.params["W0"], other["W0"])


def test_one_byte_changed_in_the_weights(folder):
    path = folder / "weights.safetensors"
    content = bytearray(path.read_bytes())
    for position in (9, len(content) // 2, len(content) - 1):
        content[position] ^= 1
        path.write_bytes(content)
        assert refusal(folder) == f"{path}: altered since training (its SHA-256 differs); train again"
        content[position] ^= 1


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_weights_that_are_not_finite(folder, network, value):
    network.params["W1"][2, 3] = value
    replace_weights(folder, network.params)
    assert refusal(folder) == f"{folder}/weights.safetensors: 'W1' holds values that are not finite"


def test_weights_that_are_no_safetensors(folder):
    (folder / "weights.safetensors").write_bytes(b"pickle?")
    edit(folder, weights_sha256=hashlib.sha256(b"pickle?").hexdigest())
    assert refusal(folder).startswith(f"{folder}/weights.safetensors: not a safetensors file (")


def shapes_changed(params):
    """Weights of which one array is missing, cut, of another robot, or of another dimension."""
    for name in params:
        without = dict(params)
        del without[name]
        yield f"{name} missing", without
    cuts = [("W0", 0), ("W0", 1), ("b0", 0), ("W1", 1), ("in_shift", 0), ("in_scale", 0)]
    for name, axis in cuts + [("turns", 0)] * ("turns" in params):
        yield f"{name} cut", {**params, name: np.delete(params[name], 0, axis=axis)}
    yield "in_shift scalar", {**params, "in_shift": np.array(1.0)}
    yield "W0 flat", {**params, "W0": params["W0"].ravel()}
    if "turns" in params:  # as before angles had cosines and sines
        without = {k: w for k, w in params.items() if k != "turns"}
        yield "W0 of q alone", {**without, "W0": params["W0"][: params["in_shift"].size]}
    yield "nothing", {}


def test_shapes_that_do_not_fit(folder, network):
    for what, params in shapes_changed(network.params):
        replace_weights(folder, params)
        expected = f"{folder}/barrier.json: the weights' shapes do not fit 2 joints; the files do not belong together"
        assert refusal(folder) == expected, what


def test_weights_of_a_robot_with_other_joints(folder, network, random_network):
    replace_weights(folder, random_network(network.kind, 7, 7).params)
    assert "do not fit 2 joints" in refusal(folder)


def test_truncated_or_foreign_json(folder):
    path = folder / "barrier.json"
    content = path.read_text()
    path.write_text(content[:500])
    assert refusal(folder).startswith(f"{path}: cannot be read (")
    path.write_bytes(b"\xff\xfe")
    assert refusal(folder).startswith(f"{path}: cannot be read (")
    for other in ("[]", "{}", "null", "3"):
        path.write_text(other)
        assert refusal(folder) == f"{path}: not a barrier of format 4; train it again with this version"


def test_missing_files(folder, tmp_path):
    (folder / "weights.safetensors").unlink()
    assert refusal(folder) == f"{folder} is not a barrier folder: weights.safetensors is missing"
    assert refusal(tmp_path / "none") == f"{tmp_path / 'none'} is not a barrier folder: barrier.json is missing"
    (tmp_path / "file").write_text("")
    assert refusal(tmp_path / "file") == f"{tmp_path / 'file'} is not a barrier folder: barrier.json is missing"
    os.mkfifo(tmp_path / "barrier.json")  # reading it would wait for ever
    assert refusal(tmp_path) == f"{tmp_path} is not a barrier folder: barrier.json is missing"


@pytest.mark.parametrize("key", ["kind", "network", "formula", "filter", "fingerprint", "weights_sha256", "robot",
                                 "world", "joints"])  # fmt: skip
def test_missing_keys(folder, key):
    edit(folder, **{key: None})
    assert refusal(folder) == f"{folder}/barrier.json: the key '{key}' is missing; the file was altered"


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"format": 1}, "a barrier of an earlier version, which this one cannot read; train it again"),
        ({"format": 5}, "not a barrier of format 4; train it again with this version"),
        ({"format": "4"}, "not a barrier of format 4; train it again with this version"),
        ({"format": [1]}, "not a barrier of format 4; train it again with this version"),
        ({"kind": "magic"}, "unknown kind 'magic' or network"),
        ({"network": "transformer"}, "unknown kind 'pp-ncbf' or network 'transformer'"),
        ({"kind": ["pp-ncbf"]}, "the key 'kind' does not hold a str; the file was altered"),
        ({"formula": {"gamma": -1.0}}, "formula: gamma: input should be greater than or equal to 0.1"),
        ({"formula": {"gamma": "x"}}, "formula: gamma: "),
        ({"formula": []}, "the key 'formula' does not hold a dict; the file was altered"),
        ({"joints": 3}, "the key 'joints' does not hold a list; the file was altered"),
        ({"filter": 3}, "the key 'filter' does not hold a dict; the file was altered"),
        ({"filter": {"kind": "qp", "metric": "kinetic", "alpha": -1.0}}, "filter: alpha: input should be greater"),
        ({"fingerprint": "x"}, "the key 'fingerprint' does not hold a dict; the file was altered"),
    ],
)
def test_values_that_make_no_sense(folder, changes, expected):
    edit(folder, **changes)
    assert refusal(folder).startswith(f"{folder}/barrier.json: {expected}")


def belongs(stored: StoredBarrier, robot: str, world: str) -> str:
    with pytest.raises(InputError) as error:
        stored.barrier(load_problem(robot, world))
    return str(error.value)


def test_other_robots_and_worlds_are_refused(folder, tmp_path, two_link):
    stored = load_barrier(folder)
    end = "it is for 'two_link' and 'circle'; train one for this pair"
    another = "this barrier was trained for another"
    assert belongs(stored, "cartpole", "circle") == f"{another} robot (its URDF differs): {end}"
    assert belongs(stored, "two_link", "sphere") == f"{another} world (the obstacles differ): {end}"
    spec = tmp_path / "weak.yaml"
    spec.write_text(f"urdf: {two_link.model.urdf}\neffort: 20.0\nbody: [{{frame: tip}}]\n")
    assert belongs(stored, str(spec), "circle") == (
        f"this barrier was trained for other robot parameters (joints, limits, payload or body spheres differ): {end}"
    )


def test_the_same_robot_under_another_name_is_accepted(folder, tmp_path, two_link):
    spec = tmp_path / "same.yaml"
    text = find_robot("two_link").read_text(encoding="utf-8")
    spec.write_text(text.replace("urdf: two_link.urdf", f"urdf: {two_link.model.urdf}"))
    stored = load_barrier(folder)
    assert stored.barrier(load_problem(str(spec), "circle")).spec == stored.spec


def test_another_controller_or_domain_is_refused(folder, tmp_path, two_link):
    text = find_robot("two_link").read_text(encoding="utf-8")
    text = text.replace("urdf: two_link.urdf", f"urdf: {two_link.model.urdf}")
    for change in (("kd: 6.0", "kd: 0.0"), ("[-1.0, 1.0]]", "[-9.0, 9.0]]")):
        spec = tmp_path / "other.yaml"
        spec.write_text(text.replace(*change))
        with pytest.raises(InputError, match="another controller or domain X"):
            load_barrier(folder).barrier(load_problem(str(spec), "circle"))


def test_folders_that_cannot_be_written(tmp_path, two_link, network):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError) as error:
        save_barrier(tmp_path / "file" / "b", two_link, "ncbf", network.kind, network.params, CONFIG, {})
    assert str(error.value) == f"{tmp_path / 'file' / 'b'}: cannot be written (Not a directory)"
