"""The command line through its entry point: results on stdout, errors as one line on stderr, and the exit codes."""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import io
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch

from ppcbf_robots.artefact import load_barrier
from ppcbf_robots.cli import output
from ppcbf_robots.cli.compare import LEARNED
from ppcbf_robots.cli.main import main
from ppcbf_robots.learning.presets import PRESETS
from ppcbf_robots.resources import bundled

WORLDS = {"cartpole": "wall", "two_link": "circle", "panda": "sphere"}
URDF = Path(__file__).parent.parent / "robots" / "two_link.urdf"
TRAJECTORY = {"t", "q", "v", "u", "u_des", "h", "clearance", "phi", "V", "active", "status", "meta"}


class Done(NamedTuple):
    """What a command left behind."""

    code: int
    stdout: str
    stderr: str


def run_cli(*args: object) -> Done:
    """``ppcbf args...`` in this process, through the same ``main`` as the installed command."""
    out, err = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        patch.setattr(sys, "argv", ["ppcbf", *map(str, args)])
        try:
            main()
            code = 0
        except SystemExit as end:
            code = int(end.code or 0)
    return Done(code, out.getvalue(), err.getvalue())


def facts(*args: object, code: int = 0) -> dict[str, Any]:
    """The JSON object that is all of stdout."""
    done = run_cli(*args, "--json")
    assert done.code == code, done.stderr
    found = json.loads(done.stdout, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    assert isinstance(found, dict)
    return found


@pytest.fixture(scope="module", autouse=True)
def small_presets() -> Iterator[None]:
    """Presets that train and check on few states, and one thread: more only wait for each other on a busy machine."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    with pytest.MonkeyPatch.context() as patch:
        for name, preset in PRESETS.items():
            small = {"rays": 1000, "samples": 100, "top": 20, "hidden": (16, 16), "test_samples": 200,
                     "search_rounds": 1, "attack_rounds": 2, "judge_first": False}  # fmt: skip
            patch.setitem(PRESETS, name, dataclasses.replace(preset, **small))
        yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def training(tmp_path_factory) -> dict[str, Any]:
    """What ``train two_link circle --json`` said; its 'out' is the barrier folder."""
    folder = tmp_path_factory.mktemp("training") / "two_link"
    return facts("train", "two_link", "circle", "--iterations", 50, "--out", folder)


@pytest.fixture(scope="module")
def barrier(training) -> Path:
    return Path(training["out"])


@pytest.fixture(scope="module")
def trajectory(barrier) -> Path:
    """A run of the 2R under the trained barrier."""
    path = barrier.parent / "two_link.npz"
    facts("simulate", "two_link", "circle", "--barrier", barrier, "--duration", 0.2, "--out", path)
    return path


@pytest.fixture(scope="module")
def cartpole_trajectory(barrier) -> Path:
    """A run of another robot."""
    path = barrier.parent / "cartpole.npz"
    facts("simulate", "cartpole", "wall", "--duration", 0.01, "--out", path)
    return path


@pytest.fixture(autouse=True)
def in_tmp_path(tmp_path, monkeypatch) -> None:
    """Whatever a command writes by default lands here."""
    monkeypatch.chdir(tmp_path)


# Information


@pytest.mark.parametrize(("robot", "nv"), [("cartpole", 2), ("two_link", 2), ("panda", 7), ("ur5", 6), ("kinova", 6)])
def test_info_of_a_robot(robot, nv):
    found = facts("info", robot)
    assert found.keys() >= {"robot", "urdf", "nq", "nv", "joints", "locked", "controller", "derived", "body", "start",
                            "body_overestimate_mm", "body_links", "goal", "domain", "warnings", "u_des_outside",
                            "lb_infeasible"}  # fmt: skip
    assert found["nv"] == len(found["joints"]) == len(found["start"]) == len(found["goal"]) == nv
    assert found["nq"] == nv + sum(j["continuous"] for j in found["joints"])
    assert all((j["lower"] is None) == (j["upper"] is None) == j["continuous"] for j in found["joints"])
    assert found["lb_infeasible"] is None
    assert 0.0 <= found["u_des_outside"] < 1.0
    text = run_cli("info", robot)
    assert (text.code, text.stderr) == (0, "")
    assert text.stdout.startswith(f"{found['robot']}  {found['urdf']}\nnq {found['nq']}, nv {nv}")
    assert f"body: {len(found['body'])} spheres" in text.stdout
    assert all(f"warning: {w}" in text.stdout for w in found["warnings"])


def test_info_says_how_far_the_fitted_body_reaches_beyond_the_geometry():
    found = facts("info", "ur5")
    total, links = found["body_overestimate_mm"], found["body_links"]
    assert [x["link"] for x in links] == ["shoulder_link", "upper_arm_link", "forearm_link"] + [
        f"wrist_{i}_link" for i in (1, 2, 3)
    ]
    assert sum(x["spheres"] for x in links) == len(found["body"])
    assert total["largest"] == max(x["largest"] for x in links) < 45.0
    assert min(x["mean"] for x in links) < total["mean"] < max(x["mean"] for x in links)
    line = f"body reaches {total['largest']:.1f} mm beyond the geometry at most, {total['mean']:.1f} mm on average"
    assert line in run_cli("info", "ur5").stdout
    given = facts("info", "two_link")
    assert (given["body_overestimate_mm"], given["body_links"]) == (None, [])


def test_every_bundled_robot_is_tested():
    arms = {"asr_twodof", "baxter_left", "baxter_right", "double_pendulum", "tiago_arm", "ur3"}  # in test_arms.py
    assert set(bundled("robots")) == set(WORLDS) | arms


def test_info_of_a_plain_urdf(tmp_path):
    path = shutil.copy(URDF, tmp_path / "arm.urdf")
    found = facts("info", path)
    assert found["urdf"] == str(path)
    assert [j["name"] for j in found["joints"]] == ["shoulder", "elbow"]
    assert found["derived"] == ["controller", "body", "start", "goal", "domain.q", "domain.v"]
    assert f"derived, not given: {', '.join(found['derived'])}" in run_cli("info", path).stdout


def test_info_of_a_robot_in_a_world():
    found = facts("info", "two_link", "circle")
    assert (found["pairs"], found["lb_samples"], found["lb_infeasible"]) == (1, 1000, 0.0)
    assert found["start_nearest"] == "tip#0 / circle"
    assert found["start_clearance"] == pytest.approx(0.0711, abs=1e-4)
    text = run_cli("info", "two_link", "circle").stdout
    assert "world circle: 1 pairs with the body" in text
    assert "training is hardly needed" in text


def test_info_tells_where_training_is_needed():
    """The cart-pole's nominal torque and the wall ask for more than 25 N on part of the boundary."""
    found = facts("info", "cartpole", "wall")
    assert 0.0 < found["lb_infeasible"] < 1.0
    assert "train a PP-NCBF" in run_cli("info", "cartpole", "wall").stdout


def test_info_warns_of_a_start_and_goal_in_an_obstacle(tmp_path):
    world = tmp_path / "world.yaml"
    wall = "{name: everywhere, type: half_space, normal: [0, 0, 1], offset: -0.1, margin: 3.0}"
    world.write_text(f"obstacles: [{wall}]\n")
    start, goal = facts("info", "two_link", world)["warnings"][-2:]
    assert start.startswith("the start configuration violates 'tip#0 / everywhere' by ")
    assert goal.startswith("the goal violates 'tip#0 / everywhere' by ")


def test_simulate_warns_of_a_goal_in_an_obstacle(tmp_path):
    world = tmp_path / "world.yaml"
    world.write_text("obstacles: [{name: ball, type: sphere, center: [-0.017, 0, 0.577], radius: 0.05}]\n")
    run = run_cli("simulate", "two_link", world, "--duration", "0.01", "--out", tmp_path / "run.npz")
    assert re.search(r"warning: the goal violates 'tip#0 / ball' by 0\.\d+: the arm will rest before it", run.stderr)


# From training to export


def test_train(training, barrier):
    assert set(training) == {"converged", "reason", "volume_kept", "violations", "samples", "start_inside", "seconds",
                             "worst_margin", "attacked", "steps", "preset", "seed", "device", "kind", "iterations",
                             "interrupted", "saved", "out"}  # fmt: skip
    assert (training["converged"], training["violations"], training["start_inside"]) == (True, 0, True)
    assert (training["samples"], training["steps"]) == (200, 50)
    assert 0.9 < training["volume_kept"] <= 1.0
    assert {p.name for p in barrier.iterdir()} == {"barrier.json", "weights.safetensors", "checkpoint.safetensors"}
    stored = json.loads((barrier / "barrier.json").read_text())["training"]
    told = {k: x for k, x in training.items() if k not in ("out", "saved")}
    assert training["saved"] and {k: stored[k] for k in told} == told
    assert [m["iteration"] for m in stored["history"]] == [40, 50]


def test_train_resumes_and_says_so_in_words(barrier, tmp_path):
    folder = Path(shutil.copytree(barrier, tmp_path / "copy"))
    done = run_cli("train", "two_link", "circle", "--iterations", 50, "--out", folder, "--resume")
    assert done.code == 0
    assert done.stdout.startswith("pp-ncbf converged after 50 steps, ")
    assert done.stdout.endswith(f"wrote {folder}/barrier.json and {folder}/weights.safetensors\n")
    weights = [(f / "weights.safetensors").read_bytes() for f in (barrier, folder)]
    assert weights[0] == weights[1]


def test_train_checks_the_last_iteration_of_a_short_run(tmp_path):
    found = facts("train", "two_link", "circle", "--iterations", 3, "--out", tmp_path / "b")
    assert (found["converged"], found["steps"]) == (True, 3)


def test_train_says_where_no_learned_term_is_needed(tmp_path, monkeypatch):
    monkeypatch.setitem(PRESETS, "default", dataclasses.replace(PRESETS["default"], judge_first=True))
    done = run_cli("train", "two_link", "circle", "--out", tmp_path / "b")
    assert done.code == 0 and "no learned term is needed here: K_theta = 0" in done.stdout
    assert load_barrier(tmp_path / "b").data["training"]["history"] == []
    assert run_cli("report", tmp_path / "b", "--duration", 0.2, "--steps", 100, "--out", tmp_path / "r.html").code == 0


def test_training_that_does_not_converge_exits_3_with_the_barrier_written(tmp_path):
    folder = tmp_path / "cartpole"
    done = run_cli("train", "cartpole", "wall", "--iterations", 1, "--out", folder, "--json")
    found = json.loads(done.stdout)
    assert (done.code, found["converged"]) == (3, False)
    last = done.stderr.splitlines()[-1]
    assert last == f"error: not converged: {found['reason']}; the best barrier so far is in {folder}"
    assert facts("simulate", "cartpole", "wall", "--barrier", folder, "--duration", 0.01)["filter_counts"]


def test_train_ncbf_with_the_papers_settings(tmp_path):
    done = run_cli("train", "two_link", "circle", "--preset", "paper", "--barrier", "ncbf", "--iterations", 1,
                   "--gamma", 7, "--out", tmp_path / "b", "--tensorboard", tmp_path / "log")  # fmt: skip
    stored = json.loads((tmp_path / "b" / "barrier.json").read_text())
    assert (stored["kind"], stored["network"], stored["formula"]["gamma"]) == ("ncbf", "mlp", 7.0)
    assert done.stderr.count("changed from the paper: ") == len(PRESETS["paper"].changes)
    assert list((tmp_path / "log").glob("events.*"))


def test_simulate_a_trained_barrier(trajectory, barrier):
    with np.load(trajectory, allow_pickle=False) as file:
        data = {k: file[k] for k in file.files}
    assert set(data) == TRAJECTORY
    assert {k: x.shape for k, x in data.items() if k != "meta"} == {
        k: (201, 2) if k in ("q", "v", "u", "u_des") else (201,) for k in TRAJECTORY - {"meta"}
    }
    np.testing.assert_allclose(data["t"], 1e-3 * np.arange(201), atol=1e-12)
    assert data["active"].dtype == bool
    np.testing.assert_array_equal(data["active"], data["status"] > 0)
    meta = json.loads(str(data["meta"]))
    assert meta.items() >= {"robot": "two_link", "obstacles": "circle", "barrier": str(barrier), "filter": "qp",
                            "barrier_kind": "pp-ncbf", "metric": "kinetic", "goal": [1.0, 1.2],
                            "complete": True}.items()  # fmt: skip


def test_simulate_reports_what_the_trajectory_holds(tmp_path, two_link):
    path = tmp_path / "new" / "t.npz"
    found = facts("simulate", "two_link", "circle", "--duration", 0.1, "--rate", 200, "--out", path)
    assert set(found) == {"min_h", "clearance", "max_torque_ratio", "max_rate_ratio", "rate_violations", "energy_rise",
                          "injected", "reached_goal", "goal_error", "cleared_at", "rests_on", "end", "contacts",
                          "hull_contacts", "contact_with",
                          "filter_counts", "outside_domain", "certificate", "out"}  # fmt: skip
    with np.load(path) as file:
        assert len(file["t"]) == sum(found["filter_counts"].values()) == 21
        assert found["min_h"] == file["h"].min()
        assert found["max_torque_ratio"] == np.max(np.abs(file["u"]) / two_link.model.u_max)
        assert found["injected"] == pytest.approx(np.maximum(np.diff(file["V"]), 0.0).sum())
    assert (found["reached_goal"], found["rests_on"], found["out"]) == (False, None, str(path))


@pytest.mark.parametrize("metric", ["torque", "kinetic"])
@pytest.mark.parametrize("kind", ["closed-form", "qp"])
@pytest.mark.parametrize("name", ["lb-cbf", "pp-cbf", "trained"])
def test_simulate_every_filter(name, kind, metric, barrier, tmp_path):
    chosen = barrier if name == "trained" else name
    found = facts("simulate", "two_link", "circle", "--barrier", chosen, "--filter", kind, "--metric", metric,
                  "--duration", 0.03, "--out", tmp_path / "t.npz")  # fmt: skip
    with np.load(tmp_path / "t.npz") as file:
        meta = json.loads(str(file["meta"]))
    assert (meta["filter"], meta["metric"]) == (kind, metric)
    assert meta["barrier_kind"] == ("pp-ncbf" if name == "trained" else name)
    assert found["min_h"] > 0.0


@pytest.mark.parametrize(
    ("name", "expected"),
    [("lb-cbf", ("qp", "kinetic")), ("pp-cbf", ("closed-form", "kinetic")), ("none", ("none", "none"))],
)
def test_simulate_without_saying_which_filter(name, expected, tmp_path):
    done = run_cli("simulate", "two_link", "circle", "--barrier", name, "--duration", 0.01)
    assert done.code == 0
    assert done.stdout.splitlines()[0] == f"two_link in circle: {', '.join((name, *expected))}"
    assert done.stdout.endswith("wrote trajectory.npz; look at it with: ppcbf view trajectory.npz\n")
    assert (tmp_path / "trajectory.npz").is_file()


def first_state(path: Path) -> tuple[list[float], list[float], list[float]]:
    with np.load(path) as file:
        return file["q"][0].tolist(), file["v"][0].tolist(), json.loads(str(file["meta"]))["goal"]


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ((), ([0.0, 0.0], [3.5, 0.0], [1.0, 0.0])),
        (("--start", "0.1,-0.2"), ([0.1, -0.2], [0.0, 0.0], [1.0, 0.0])),  # the spec's velocity belongs to its start
        (("--start", "0.1, -0.2", "--velocity", "-1,2e-1"), ([0.1, -0.2], [-1.0, 0.2], [1.0, 0.0])),
        (("--velocity", "1,2", "--goal", "0.5,0.1"), ([0.0, 0.0], [1.0, 2.0], [0.5, 0.1])),
    ],
)
def test_start_velocity_and_goal(options, expected, tmp_path):
    facts("simulate", "cartpole", "wall", *options, "--duration", 0.01, "--out", tmp_path / "t.npz")
    for found, wanted in zip(first_state(tmp_path / "t.npz"), expected, strict=True):
        np.testing.assert_allclose(found, wanted, atol=1e-12)


def test_continuous_joints_are_given_as_angles(tmp_path, kinova):
    angles = [2.0, 3.5, 2.5, -2.0, 1.0, 4.0]
    facts("simulate", "kinova", "five_spheres", "--start", ",".join(map(str, angles)), "--goal", "2,3,2.5,-2,1,4",
          "--duration", 0.01, "--out", tmp_path / "t.npz")  # fmt: skip
    q, v, goal = first_state(tmp_path / "t.npz")
    np.testing.assert_allclose(q, kinova.model.from_angles(np.array(angles)), atol=1e-12)
    assert (len(q), len(v), len(goal)) == (kinova.model.nq, 6, kinova.model.nq)


def test_how_a_run_ends_is_stated():
    """At the goal at once, under way, and at rest where the spring points straight into the circle."""
    command = ("simulate", "two_link", "circle", "--start", "0.3,0.6", "--goal")
    found = facts(*command, "0.3,0.6", "--duration", 0.1)
    assert (found["reached_goal"], found["rests_on"], found["end"]["state"]) == (True, None, "goal")
    found = facts(*command, "1.0,1.2", "--duration", 0.5)
    assert (found["reached_goal"], found["rests_on"], found["end"]["state"]) == (False, None, "moving")
    assert found["end"]["power"] > 0.0
    found = facts(*command, "0.53,0.677", "--duration", 15.0)
    assert (found["reached_goal"], found["rests_on"]) == (False, "tip#0 / circle")
    assert found["end"]["held_by"].keys() == {"tip#0 / circle"} and found["end"]["constrained_minimum"]
    done = run_cli(*command, "0.3,0.6", "--duration", 0.1)
    assert "\nend                goal reached at 0.00 s (largest joint error " in done.stdout


def test_a_simulation_that_diverges_exits_3_and_still_prints_json():
    found = facts("simulate", "two_link", "circle", "--barrier", "none", "--velocity", "1e9,1e9", "--duration", 0.01,
                  code=3)  # fmt: skip
    assert found["reached_goal"] is False and found["end"] is None


def test_view_writes_one_file(trajectory, tmp_path):
    page = tmp_path / "new" / "page.html"
    found = facts("view", trajectory, trajectory, "--html", page)
    assert found == {"html": str(page), "bytes": page.stat().st_size}
    assert page.read_text(encoding="utf-8").lstrip().lower().startswith("<!doctype html>")
    assert run_cli("view", trajectory, "--html", page).stdout == f"wrote {page}\n"


@pytest.mark.parametrize("format", ["npz", "onnx", "c"])
def test_export(format, barrier, tmp_path):
    path = tmp_path / f"barrier.{format}"
    found = facts("export", barrier, "--format", format, "--out", path)
    assert found == {"format": format, "out": str(path), "bytes": path.stat().st_size}
    assert found["bytes"] > 1000
    done = run_cli("export", barrier, "--format", format, "--out", path)
    assert (done.code, done.stdout) == (0, f"wrote {path} ({found['bytes']} bytes)\n")


@pytest.mark.slow
def test_compare(tmp_path, monkeypatch):
    folder = tmp_path / "compare"
    command = ("compare", "two_link", "circle", "--out", folder, "--iterations", 50, "--duration", 0.1)
    first = run_cli(*command, "--json")
    assert first.code == (3 if "error: not converged: " in first.stderr else 0)  # written in either case
    found = json.loads(first.stdout)
    assert [r["label"] for r in found["rows"]] == [
        "LB-CBF", "NCBF", "PP-CBF", "PP-NCBF", "PP-CBF kinetic", "LB-CBF kinetic QP", "PP-NCBF kinetic QP",
    ]  # fmt: skip
    assert [Path(f).name for f in found["files"]] == ["table.csv", "runs.png", "paths.png", "safe_set.png"]
    assert all(Path(f).stat().st_size > 100 for f in found["files"])
    with (folder / "table.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    assert [r["label"] for r in table] == [r["label"] for r in found["rows"]]
    monkeypatch.setattr(output.out, "width", 200)
    again = run_cli(*command)
    assert all(f"{name}: taken from {folder / name}" in again.stderr for name in LEARNED)
    assert all(f"│ {r['label']} " in again.stdout for r in found["rows"])


# What a person may write


def test_brackets_in_names_are_shown(tmp_path):
    path = tmp_path / "a[red]b" / "t[s].npz"
    assert f"wrote {path};" in run_cli("simulate", "two_link", "circle", "--duration", 0.01, "--out", path).stdout
    missing = tmp_path / r"y\[x].npz"
    assert run_cli("view", missing).stderr == f"error: trajectory not found: {missing}\n"


@pytest.mark.parametrize("command", ["info", "train", "simulate", "compare", "view", "export"])
def test_help(command):
    done = run_cli(command, "--help")
    assert done.code == 0
    assert f"Example: ppcbf {command}" in done.stdout


def test_the_installed_module_runs():
    command = [sys.executable, "-m", "ppcbf_robots.cli.main", "info", "two_link", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")
    assert json.loads(done.stdout)["robot"] == "two_link"


def test_ctrl_c_ends_without_a_traceback(monkeypatch):
    def stopped(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr("ppcbf_robots.cli.simulate.rollout", stopped)
    done = run_cli("simulate", "two_link", "circle")
    assert done.code == 130
    assert "Traceback" not in done.stderr


# What is refused

FILES = {
    "malformed.yaml": "obstacles:\n  - {name: a, type: sphere}\n  - name: b: c\n",
    "unknown.yaml": "obstacles:\n  - {name: a, type: sphere, center: [1, 0, 1], radius: 0.1, colour: red}\n",
    "negative.yaml": f"urdf: {URDF}\nbarrier: {{gamma: -1.0}}\n",
    "robot.yaml": f"urdf: {URDF}\nmass: 3\n",
    "arm.urdf": "<robot name='x'><link name='base'></robot>",
    "file": "",
    "text.npz": "not an archive",
    "folder/inside": "",
}


@pytest.fixture
def scene(tmp_path, barrier, trajectory, cartpole_trajectory) -> dict[str, Path]:
    """Files to be refused, beside a trained barrier: places that commands can name in braces."""
    for name, content in FILES.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(content)
    changed = shutil.copytree(barrier, tmp_path / "changed")
    weights = changed / "weights.safetensors"
    content = bytearray(weights.read_bytes())
    content[-1] ^= 1
    weights.write_bytes(content)
    (tmp_path / "cut.npz").write_bytes(trajectory.read_bytes()[:2000])
    return {"tmp": tmp_path, "barrier": barrier, "trajectory": trajectory, "cartpole": cartpole_trajectory,
            "changed": changed}  # fmt: skip


def tree(folder: Path) -> dict[str, bytes | None]:
    return {str(p.relative_to(folder)): p.read_bytes() if p.is_file() else None for p in sorted(folder.rglob("*"))}


SIMULATE = "simulate two_link circle"
TRAIN = "train two_link circle --iterations 50"
REFUSED = [
    ("info nope", "no robot named 'nope'"),
    ("info {tmp}/nope.urdf", "robot file not found"),
    ("info {tmp}/robot.yaml", "{tmp}/robot.yaml: unknown key 'mass'"),
    ("info {tmp}/arm.urdf", "{tmp}/arm.urdf: "),
    ("info {tmp}", "no robot named '{tmp}'"),
    ("info two_link nope", "no world named 'nope'"),
    ("simulate two_link {tmp}/nope.yaml", "obstacle file not found: {tmp}/nope.yaml"),
    ("simulate two_link {tmp}/malformed.yaml", "{tmp}/malformed.yaml: not valid YAML at line 3, column 12"),
    ("simulate two_link {tmp}/unknown.yaml", "{tmp}/unknown.yaml: unknown key 'obstacles.0.colour'"),
    ("simulate {tmp}/negative.yaml circle", "{tmp}/negative.yaml: barrier.gamma: input should be greater than or"),
    (f"{SIMULATE} --start 1,2,3", "--start: expected 2 numbers, one per moving joint, got 3"),
    (f"{SIMULATE} --start one,two", "--start: expected numbers separated by commas, got 'one,two'"),
    (f"{SIMULATE} --start nan,0", "--start: every number must be finite"),
    (f"{SIMULATE} --velocity 0,inf", "--velocity: every number must be finite"),
    (f"{SIMULATE} --goal 1", "--goal: expected 2 numbers, one per moving joint, got 1"),
    ("simulate kinova five_spheres --start 1,2,3,4,5,6,7,8,9", "--start: expected 6 numbers"),
    (f"{SIMULATE} --start 0.785,0", "the start configuration violates 'tip#0 / circle' by 0.0515"),
    (f"{SIMULATE} --barrier nope", "--barrier: 'nope' is neither a barrier folder nor one of lb-cbf, pp-cbf, none"),
    (f"{SIMULATE} --barrier {{tmp}}/folder", "{tmp}/folder is not a barrier folder: barrier.json is missing"),
    (f"{SIMULATE} --barrier {{changed}}", "{changed}/weights.safetensors: altered since training"),
    ("simulate cartpole wall --barrier {barrier}", "this barrier was trained for another robot"),
    ("simulate two_link five_spheres --barrier {barrier}", "this barrier was trained for another world"),
    (f"{SIMULATE} --solver nope", "QP solver 'nope' is not installed"),
    (f"{SIMULATE} --out {{tmp}}/folder", "--out: {tmp}/folder is a folder"),
    (f"{TRAIN} --out {{tmp}}/file", "--out: {tmp}/file is a file; give a folder"),
    (f"{TRAIN} --out new --gamma=-1", "--gamma: gamma: input should be greater than or equal to 0.1"),
    (f"{TRAIN} --out new --gamma nan", "--gamma: gamma: input should be a finite number"),
    (f"{TRAIN} --out new --gamma inf", "--gamma: gamma: input should be a finite number"),
    (f"{TRAIN} --out new --gamma 0.05", "--gamma: gamma: input should be greater than or equal to 0.1, got 0.05"),
    (f"{TRAIN} --out new --resume", "nothing to resume: new/checkpoint.safetensors does not exist"),
    (f"{TRAIN} --out {{barrier}} --seed 1 --resume", "{barrier}/checkpoint.safetensors: belongs to another"),
    (f"{TRAIN} --out {{tmp}}/damaged --resume", "{tmp}/damaged/checkpoint.safetensors: not a checkpoint"),
    ("compare two_link circle --out {tmp}/file", "--out: {tmp}/file is a file; give a folder"),
    ("view {tmp}/nope.npz --html page", "trajectory not found: {tmp}/nope.npz"),
    ("view {tmp}/text.npz --html page", "{tmp}/text.npz: not a trajectory of `ppcbf simulate`"),
    ("view {tmp}/cut.npz --html page", "{tmp}/cut.npz: not a trajectory of `ppcbf simulate`"),
    ("view {tmp}/folder --html page", "{tmp}/folder: not a trajectory of `ppcbf simulate`"),
    ("view {trajectory} {cartpole} --html page", "the trajectories belong to different robots or worlds"),
    ("view {trajectory} --html {tmp}/folder", "{tmp}/folder: cannot be written"),
    ("export {tmp}/folder --format c --out x.h", "{tmp}/folder is not a barrier folder"),
    ("export {changed} --format c --out x.h", "{changed}/weights.safetensors: altered since training"),
    ("export {barrier} --format c --out {tmp}/folder", "{tmp}/folder is a folder"),
]


@pytest.mark.parametrize(("command", "message"), REFUSED)
def test_bad_input_is_one_line_and_writes_nothing(command, message, scene):
    damaged = scene["tmp"] / "damaged"
    damaged.mkdir()
    (damaged / "checkpoint.safetensors").write_bytes(b"\0" * 100)
    before = [tree(folder) for folder in (scene["tmp"], scene["barrier"].parent)]
    done = run_cli(*command.format(**scene).split())
    assert (done.code, done.stdout) == (2, "")
    assert done.stderr.startswith(f"error: {message.format(**scene)}")
    assert done.stderr.count("\n") == 1
    assert [tree(folder) for folder in (scene["tmp"], scene["barrier"].parent)] == before


def test_cuda_where_there_is_none(monkeypatch, tmp_path):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    done = run_cli(*TRAIN.split(), "--out", tmp_path / "b", "--device", "cuda")
    assert done == (2, "", "error: --device cuda: no CUDA device is available here; use --device cpu\n")
    assert not (tmp_path / "b").exists()


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("nonsense", "No such command"),
        ("info", "Missing argument"),
        ("info two_link --colour", "No such option"),
        ("train two_link circle", "Missing option"),
        ("train two_link circle --out b --iterations 0", "Invalid value"),
        ("train two_link circle --out b --time-limit nan", "Invalid value"),
        ("train two_link circle --out b --seed x", "Invalid value"),
        (f"{SIMULATE} --filter magic", "Invalid value"),
        (f"{SIMULATE} --metric magic", "Invalid value"),
        (f"{SIMULATE} --duration nan", "Invalid value"),
        (f"{SIMULATE} --duration -1", "Invalid value"),
        (f"{SIMULATE} --rate 0", "Invalid value"),
        ("view", "Missing argument"),
        ("export b --format magic --out x", "Invalid value"),
    ],
)
def test_wrong_use_is_explained(command, message, tmp_path):
    done = run_cli(*command.split())
    assert (done.code, done.stdout) == (2, "")
    assert done.stderr.startswith("Usage: ") and message in done.stderr
    assert not list(tmp_path.iterdir())
