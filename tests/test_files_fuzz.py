"""Robot specs, worlds and barrier folders with absurd contents.

Each is refused in one sentence, or the filter that comes of it still answers with a finite torque inside the box.
"""

from __future__ import annotations

import copy
import hashlib
import json
import shutil
import time

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors

from ppcbf_robots.artefact import load_barrier, save_barrier
from ppcbf_robots.certificate import Certificate, Condition, save_certificate, subject
from ppcbf_robots.errors import InputError
from ppcbf_robots.filters import FilterConfig
from ppcbf_robots.problem import load_problem
from ppcbf_robots.safety_filter import SafetyFilter

FUZZ = settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
LONGEST = 5.0  # [s] for one file, however absurd

ABSURD = [
    None, True, False, 0, -1, 1, 7, 10**30, -(10**400), 0.0, -0.0, 1e-308, 5e-324, 1e308, -1e308, 1e9, float("nan"),
    float("inf"), -float("inf"), "", " ", "nan", "x", "1e999", "\x00", "é" * 300, "../../etc/passwd", "/dev/zero",
    "tip", [], [[]], [None], ["x"], [0.0], [1e308, -1e308], [float("nan")] * 2, [1.0] * 5, [[0.0, 0.0]],
    [[1.0, -1.0], [2.0, 1.0]], [[-1e308, 1e308]] * 2, list(range(2000)), {}, {"": 0}, {"x": {}}, {"type": "sphere"},
    {1: 2},
]  # fmt: skip

ROBOT = {
    "urdf": "two_link.urdf",
    "effort": [40.0, 40.0],
    "velocity": 2.0,
    "effort_rate": {"shoulder": 500.0},
    "controller": {"type": "bounded_spring", "kp": 10.0, "kd": [2.0, 1.0], "max_spring": 5.0},
    "body": [{"frame": "tip", "center": [0.0, 0.0, 0.0], "radius": 0.02}],
    "domain": {"q": [[0.0, 1.5], [-1.5, 1.5]], "v": [[-0.5, 1.0], [-1.0, 1.0]], "guard": True},
    "start": [0.3, 0.4],
    "start_velocity": [0.0, 0.1],
    "goal": [1.0, 1.2],
    "payload": {"frame": "tip", "mass": 0.5, "com": [0.0, 0.0, 0.1]},
    "barrier": {"gamma": 5.0, "alpha_pp": 100.0, "gamma_K": 1.0, "epsilon": 0.05, "act_within": 0.05},
    "locked": {},
    "moving": ["shoulder", "elbow"],
    "note": "masses are guessed",
}
WORLD = {
    "obstacles": [
        {"name": "ball", "type": "sphere", "center": [0.6, 0.0, 0.6], "radius": 0.2, "margin": 0.01},
        {"name": "floor", "type": "half_space", "normal": [0.0, 0.0, 1.0], "offset": -2.0},
        {"name": "crate", "type": "box", "xyz": [1.0, 0.3, 0.1], "rpy": [0.0, 0.0, 0.4], "size": [0.3, 0.2, 0.2]},
        {"name": "pipe", "type": "capsule", "xyz": [0.4, 1.0, 0.7], "quat_xyzw": [0.6, 0.0, 0.0, 0.8], "radius": 0.03,
         "length": 0.6},
        {"name": "ramp", "type": "mesh", "xyz": [0.3, -1.0, 0.0], "scale": 1.0,
         "vertices": [[0.0, 0.0, 0.0], [0.2, 0.0, 0.0], [0.0, 0.2, 0.0], [0.0, 0.0, 0.1]]},
    ]
}  # fmt: skip


def places(data, at=()):
    """Paths of everything inside nested lists and mappings."""
    items = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    for key, value in items:
        yield (*at, key)
        yield from places(value, (*at, key))


@st.composite
def absurd(draw, sound):
    """The data with one to three of its values replaced, dropped, doubled or put elsewhere."""
    data = copy.deepcopy(sound)
    for _ in range(draw(st.integers(1, 3))):
        *way, last = draw(st.sampled_from(list(places(data)) or [()])) or ("",)
        inside = data
        for key in way:
            inside = inside[key]
        match draw(st.sampled_from(["replace", "replace", "replace", "drop", "double", "rename"])):
            case "replace":
                inside[last] = copy.deepcopy(draw(st.sampled_from(ABSURD)))
            case "drop":
                del inside[last]
            case "double" if isinstance(inside, list):
                inside.append(copy.deepcopy(inside[last]))
            case "rename" if isinstance(inside, dict):
                inside[draw(st.sampled_from(["urdf", "type", "radius", "odd", ""]))] = inside.pop(last)
    return data


def answers(problem, barrier, config=None):
    """The filter's torque at the start, and in full motion, is finite and inside the box."""
    filter_ = SafetyFilter(problem.model, problem.safety, barrier, config)
    v = problem.robot.start_velocity
    for t, dq in ((0.0, 0.0), (1e-3, 1e-3 * v)):
        q = problem.model.integrate(problem.robot.start, np.full(problem.model.nv, dq) if np.isscalar(dq) else dq)
        u = filter_.step(t, q, v, 0.5 * problem.model.u_max, 0.0).u
        assert np.all(np.isfinite(u)) and np.all(np.abs(u) <= problem.model.u_max * (1 + 1e-12))


def refused(call):
    """Whether the call ends with an InputError of one sentence; nothing else may come, nor may it take long."""
    began = time.process_time()
    try:
        call()
        return False
    except InputError as error:
        assert str(error) and "\n" not in str(error) and len(str(error)) < 1000
        return True
    finally:
        assert time.process_time() - began < LONGEST


@pytest.fixture(scope="module")
def place(tmp_path_factory, problems):
    """``place(robot, world)`` writes both and gives their paths; the URDF lies beside them."""
    folder = tmp_path_factory.mktemp("fuzz")
    shutil.copy(problems["two_link"].model.urdf, folder / "two_link.urdf")

    def write(robot, world):
        paths = folder / "robot.yaml", folder / "world.yaml"
        for path, data in zip(paths, (robot, world), strict=True):
            path.write_text(data if isinstance(data, str) else yaml.safe_dump(data), encoding="utf-8")
        return [str(path) for path in paths]

    return write


def whole(names):
    problem = load_problem(*names)
    answers(problem, problem.barrier("lb-cbf"))


def test_the_sound_files_work(place):
    """Or the mutations would show nothing."""
    assert not refused(lambda: whole(place(ROBOT, WORLD)))


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@FUZZ
@given(robot=absurd(ROBOT))
def test_absurd_robot_specs(place, robot):
    names = place(robot, WORLD)
    refused(lambda: whole(names))


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@settings(FUZZ, max_examples=80)
@given(world=absurd(WORLD))
def test_absurd_worlds(place, world):
    names = place(ROBOT, world)
    refused(lambda: whole(names))


LAUGHS = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 10)
)
BOMBS = {
    "a billion laughs": LAUGHS + "urdf: *a9\n",
    "a billion laughs as obstacles": LAUGHS + "obstacles: *a9\n",
    "itself": "urdf: &a [*a]\nobstacles: *a\n",
    "a tower of brackets": "urdf: " + "[" * 50_000,
    "a tower of mappings": "urdf: " + "{a: " * 20_000,
    "a python object": "urdf: !!python/object/apply:os.system [touch trap]\n",
    "many documents": "urdf: x\n---\nurdf: y\n",
    "a long integer": "urdf: x\nvelocity: " + "9" * 20_000 + "\n",
    "a long word": "urdf: " + "x" * 1_000_000 + "\n",
    "a merge": "a: &a {urdf: x}\n<<: *a\n",
}


@pytest.mark.parametrize("bomb", BOMBS)
def test_yaml_that_blows_up(place, bomb):
    for files in ((BOMBS[bomb], WORLD), (ROBOT, BOMBS[bomb])):
        names = place(*files)
        assert refused(lambda names=names: whole(names))


# ---------------------------------------------------------------------------------------------- barrier folders


@pytest.fixture(scope="module")
def sound(problems, random_network, tmp_path_factory):
    """A barrier folder of the 2R, and another one to spoil."""
    folder, problem = tmp_path_factory.mktemp("barrier"), problems["two_link"]
    network = random_network("convex", 2, 2, seed=1)
    save_barrier(folder / "sound", problem, "pp-ncbf", "convex", network.params, FilterConfig(), {"steps": 3})
    (folder / "spoiled").mkdir()
    return folder / "sound", folder / "spoiled"


def used(folder, problem):
    stored = load_barrier(folder)
    answers(problem, stored.barrier(problem), stored.filter_config())


def spoiled(sound, weights=None, facts=None, forge=False):
    """The folder with other contents; ``forge`` writes the hash that the weights have."""
    original, copy_ = sound
    weights = (original / "weights.safetensors").read_bytes() if weights is None else weights
    facts = json.loads((original / "barrier.json").read_text()) if facts is None else facts
    if forge:
        facts["weights_sha256"] = hashlib.sha256(weights).hexdigest()
    (copy_ / "weights.safetensors").write_bytes(weights)
    (copy_ / "barrier.json").write_bytes(facts if isinstance(facts, bytes) else json.dumps(facts).encode())
    return copy_


def test_the_sound_folder_works(sound, two_link):
    assert not refused(lambda: used(spoiled(sound), two_link))


@pytest.mark.parametrize("forge", [False, True])
@FUZZ
@given(cut=st.floats(0.0, 1.0), flips=st.lists(st.tuples(st.floats(0.0, 1.0), st.integers(1, 255)), max_size=4))
def test_weights_cut_and_flipped(sound, two_link, forge, cut, flips):
    """With their hash beside them too, as one who forges it would write: the torque stays in the box all the same."""
    content = bytearray((sound[0] / "weights.safetensors").read_bytes())
    original = bytes(content)
    for at, mask in flips:
        content[min(int(at**3 * len(content)), len(content) - 1)] ^= mask  # most often in the header
    content = content[: int(cut * len(content))] if cut < 0.5 else content
    folder = spoiled(sound, bytes(content), forge=forge)
    found = refused(lambda: used(folder, two_link))
    assert found or forge or bytes(content) == original


VALUES = st.sampled_from([0.0, 1e308, -1e308, 1e150, 5e-324, np.nan, np.inf, -np.inf, 1e12, -1.0])


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@FUZZ
@given(data=st.data())
def test_weights_of_absurd_values_and_shapes(sound, two_link, data):
    params = dict(load_tensors((sound[0] / "weights.safetensors").read_bytes()))
    for _ in range(data.draw(st.integers(1, 3))):
        name = data.draw(st.sampled_from(sorted(params)))
        w = np.array(params[name])
        match data.draw(st.sampled_from(["value", "value", "all", "shape", "type", "drop", "add"])):
            case "value" if w.size:
                w.flat[data.draw(st.integers(0, w.size - 1))] = data.draw(VALUES)
            case "all":
                w = np.full_like(w, data.draw(VALUES))
            case "shape":
                w = data.draw(
                    st.sampled_from([w.T, w.ravel(), w[None], w.ravel()[:0], np.concatenate([w.ravel()] * 2)])
                )
            case "type":
                w = w.astype(data.draw(st.sampled_from([np.float32, np.float16, np.int64, np.bool_])))
            case "drop":
                del params[name]
                continue
            case "add":
                name = "W9"
        params[name] = np.ascontiguousarray(w)
    folder = spoiled(sound, save_tensors(params), forge=True)
    refused(lambda: used(folder, two_link))


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@FUZZ
@given(data=st.data())
def test_absurd_facts(sound, two_link, data):
    facts = data.draw(absurd(json.loads((sound[0] / "barrier.json").read_text())))
    folder = spoiled(sound, facts=facts)
    refused(lambda: used(folder, two_link))


def test_facts_nested_beyond_all_depth(sound, two_link):
    folder = spoiled(sound, facts=b"[" * 100_000)
    assert refused(lambda: used(folder, two_link))


@FUZZ
@given(content=st.binary(max_size=300), at=st.floats(0.0, 1.0))
def test_facts_of_noise(sound, two_link, content, at):
    original = (sound[0] / "barrier.json").read_bytes()
    cut = int(at * len(original))
    for noise in (content, original[:cut] + content):
        folder = spoiled(sound, facts=noise)
        assert refused(lambda folder=folder: used(folder, two_link)) or noise.startswith(original.rstrip())


@pytest.fixture(scope="module")
def certified(sound):
    """The contents of a certificate of the sound folder."""
    folder = spoiled(sound)
    about = subject(json.loads((folder / "barrier.json").read_text()), 1e-3, 1e-3)
    held = Condition("proved", "some torque serves all rows", 0.0, None, 10, 0, 0.1)
    found = Certificate("proved", {"feasibility": held}, about, ["errors"], 1.5, "proof", {"power": 0.5})
    return json.loads(save_certificate(folder, found).read_text())


def shown(folder, problem):
    """What the commands do with a certificate."""
    certificate = load_barrier(folder).certificate
    if certificate is not None:
        line, goal = certificate.line(), problem.model.to_angles(problem.robot.goal)
        gap = certificate.gap(goal.tolist(), "qp", "kinetic", 50.0, 1e-3, 1e-3, False)
        assert line and isinstance(gap, str)
    return certificate


def test_the_sound_certificate_counts(sound, certified, two_link):
    (sound[1] / "certificate.json").write_text(json.dumps(certified))
    assert shown(spoiled(sound), two_link).verdict == "proved"


@FUZZ
@given(data=st.data())
def test_absurd_certificates(sound, certified, two_link, data):
    facts = data.draw(absurd(certified))
    (sound[1] / "certificate.json").write_text(json.dumps(facts))
    shown(spoiled(sound), two_link)


@FUZZ
@given(content=st.binary(max_size=300), at=st.floats(0.0, 1.0))
def test_certificates_of_noise(sound, certified, two_link, content, at):
    whole = json.dumps(certified).encode()
    (sound[1] / "certificate.json").write_bytes(whole[: int(at * len(whole))] + content)
    shown(spoiled(sound), two_link)
