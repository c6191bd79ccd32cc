"""The 3D view: the page in a real browser, the server's manners, and what is refused."""

from __future__ import annotations

import dataclasses
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

import coal
import numpy as np
import pytest

from ppcbf_robots.errors import InputError
from ppcbf_robots.filters import FilterConfig, Status
from ppcbf_robots.problem import Problem, load_problem
from ppcbf_robots.rollout import Trajectory, simulate
from ppcbf_robots.safety_filter import SafetyFilter
from ppcbf_robots.viewer import check_trajectories, show, write_html
from ppcbf_robots.viewer_page import PageServer
from ppcbf_robots.viewer_shapes import drawable
from ppcbf_robots.world import HalfSpace
from ppcbf_robots.world_files.load import load_world
from ppcbf_robots.world_shapes import coal_shape


def run(problem: Problem, filtered: bool, duration: float) -> Trajectory:
    """From the robot's start; with the lb-cbf filter, or without any."""
    robot = problem.robot
    safety_filter = SafetyFilter(problem.model, problem.safety, problem.barrier("lb-cbf"), FilterConfig())
    return simulate(
        problem.safety, robot.controller, safety_filter if filtered else None, robot.start, robot.start_velocity,
        duration, control_dt=5e-3,
    )  # fmt: skip


@pytest.fixture(scope="module")
def two_link() -> tuple[Problem, Trajectory]:
    problem = load_problem("two_link", "circle")
    return problem, run(problem, True, 2.0)


def seek(browser: Any, time: float) -> None:
    """Stop the playback at a time [s] and wait until that is shown."""
    browser.evaluate(f"viewer.animator.pause(); viewer.animator.time = {time}; viewer.animator.seek({time})")
    clock = "document.getElementById('clock').textContent"
    browser.until(
        lambda: browser.evaluate(clock).startswith(f"{time:.2f} ") and not browser.evaluate("viewer.needs_render")
    )


def check_page(browser: Any, path: Path, end: float) -> None:
    """The page plays: it starts by itself, something is drawn and moves, nothing complains, nothing is fetched."""
    browser.open(path.as_uri())
    seen = browser.evaluate("viewer.animator.time")
    browser.until(lambda: abs(browser.evaluate("viewer.animator.time") - seen) > 0.2)
    pictures = []
    for t in (0.0, end):
        seek(browser, t)
        pictures.append(browser.pixels()[150:380].astype(int))  # between the legend and the player
    first, last = pictures
    assert len(np.unique((first // 32).reshape(-1, 3), axis=0)) > 12, "the scene is blank"
    assert np.sum(np.abs(first - last).max(axis=-1) > 40) > 300, "nothing moves"
    assert browser.complaints == []
    assert [u for u in browser.requests if not u.startswith(("file:", "data:", "blob:"))] == []


def test_page_of_one_run_plays(browser: Any, two_link: tuple[Problem, Trajectory], tmp_path: Path) -> None:
    problem, trajectory = two_link
    write_html(problem, [trajectory], ["filtered"], tmp_path / "deep" / "run.html")
    check_page(browser, tmp_path / "deep" / "run.html", 2.0)


@pytest.mark.slow
def test_page_of_two_runs_with_meshes_plays(browser: Any, tmp_path: Path) -> None:
    problem = load_problem("panda", "sphere")
    path = tmp_path / "panda.html"
    label = "</script><script>console.error('injected')</script>/"
    write_html(problem, [run(problem, True, 1.2), run(problem, False, 0.8)], ["lb-cbf", label], path)
    assert path.stat().st_size < 6e6  # the meshes are stored once for both robots
    check_page(browser, path, 1.2)
    assert browser.evaluate("[...document.querySelectorAll('#rows tr td:nth-child(2)')].map(x => x.textContent)") == [
        "lb-cbf", label,
    ]  # fmt: skip


def test_states_are_shown_when_they_happen(browser: Any, two_link: tuple[Problem, Trajectory], tmp_path: Path) -> None:
    problem, trajectory = two_link
    quarter = len(trajectory.t) // 4
    status = np.repeat([Status.FREE, Status.CORRECTING, Status.RESTING, Status.FAULT], quarter)
    status = np.append(status, np.full(len(trajectory.t) - len(status), Status.FAULT))
    write_html(problem, [dataclasses.replace(trajectory, status=status)], ["a"], tmp_path / "a.html")
    browser.open((tmp_path / "a.html").as_uri())
    shown, colors = [], []
    for t in (0.25, 0.75, 1.25, 1.75):
        seek(browser, t)
        shown.append(browser.evaluate("document.querySelector('#rows td:nth-child(3)').textContent"))
        marker = "viewer.scene_tree.find(['meshcat', '1 a', 'marker', '<object>']).object.material.color.toArray()"
        colors.append("".join(f"{round(255 * x):02x}" for x in browser.evaluate(marker)))
    assert shown == ["free", "correcting", "resting", "alarm"]
    assert colors == ["5b8fd0", "ff9500", "16181c", "e3001b"]


def test_robot_and_marker_are_where_the_run_was(
    browser: Any, two_link: tuple[Problem, Trajectory], tmp_path: Path
) -> None:
    problem, trajectory = two_link
    write_html(problem, [trajectory], ["a"], tmp_path / "a.html")
    browser.open((tmp_path / "a.html").as_uri())
    seek(browser, 1.5)
    q1, q2 = trajectory.q[np.argmin(np.abs(trajectory.t - 1.5))]
    elbow = 0.35 * np.array([np.cos(q1), 0.0, np.sin(q1)])
    tip = elbow + 0.35 * np.array([np.cos(q1 + q2), 0.0, np.sin(q1 + q2)])
    for path, expected in ((["robot", "2"], elbow), (["marker"], tip)):
        node = f"viewer.scene_tree.find({['meshcat', '1 a', *path]}).object"
        assert browser.evaluate(f"{node}.position.toArray()") == pytest.approx(expected, abs=1e-4)
    turn = browser.evaluate("viewer.scene_tree.find(['meshcat', '1 a', 'robot', '2']).object.quaternion.toArray()")
    assert turn == pytest.approx([0.0, -np.sin((q1 + q2) / 2.0), 0.0, np.cos((q1 + q2) / 2.0)], abs=1e-4)


@pytest.mark.parametrize(
    "shape", [coal.Cylinder(0.2, 0.5), coal.Capsule(0.2, 0.5), coal.Sphere(0.3)], ids=lambda s: type(s).__name__
)
def test_shapes_keep_their_size(shape: coal.ShapeBase) -> None:
    shape.computeLocalAABB()
    vertices = drawable(shape).vertices
    assert vertices.max(axis=0) == pytest.approx(shape.aabb_local.max_, rel=0.01)
    assert vertices.min(axis=0) == pytest.approx(shape.aabb_local.min_, rel=0.01)


def test_every_kind_of_obstacle_is_drawn_where_it_stands(
    browser: Any, two_link: tuple[Problem, Trajectory], tmp_path: Path
) -> None:
    problem, trajectory = two_link
    world = load_world(Path(__file__).parent / "data" / "worlds" / "ours.yaml")
    assert {o.type for o in world.obstacles} == {"sphere", "half_space", "box", "capsule", "cylinder", "mesh"}
    write_html(dataclasses.replace(problem, world=world), [trajectory], ["a"], tmp_path / "a.html")
    browser.open((tmp_path / "a.html").as_uri())
    assert browser.complaints == []
    for o in world.obstacles:
        node = f"viewer.scene_tree.find(['meshcat', 'obstacles', '{o.name}']).object"
        assert browser.evaluate(f"{node}.children[0].geometry.attributes.position.count") > 0, o.name
        if not isinstance(o, HalfSpace):
            expected = coal_shape(o)[1][:3, 3]
            assert browser.evaluate(f"{node}.position.toArray()") == pytest.approx(expected, abs=1e-6)


def test_body_spheres_can_be_hidden(browser: Any, two_link: tuple[Problem, Trajectory], tmp_path: Path) -> None:
    problem, trajectory = two_link
    write_html(problem, [trajectory], ["a"], tmp_path / "a.html")
    browser.open((tmp_path / "a.html").as_uri())
    visible = "viewer.scene_tree.find(['meshcat', '1 a', 'body spheres']).object.visible"
    assert browser.evaluate(visible) is True
    browser.evaluate("document.querySelector('#key input').click()")
    assert browser.evaluate(visible) is False


def test_robot_without_readable_meshes_is_drawn_as_bones(browser: Any, tmp_path: Path) -> None:
    inertial = '<inertial><mass value="1"/><inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial>'
    visual = '<visual><geometry><mesh filename="gone.dae"/></geometry></visual>'
    rest = '<origin xyz="0 0 0.4"/><axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="50" velocity="2"/>'
    links = "".join(f'<link name="l{i}">{inertial}{visual}</link>' for i in range(3))
    joints = "".join(
        f'<joint name="j{i}" type="revolute"><parent link="l{i}"/><child link="l{i + 1}"/>{rest}</joint>'
        for i in range(2)
    )
    urdf = tmp_path / "arm.urdf"
    urdf.write_text(f'<robot name="arm">{links}{joints}</robot>')
    world = tmp_path / "floor.yaml"
    world.write_text("obstacles: [{name: floor, type: half_space, normal: [0, 0, 1], offset: -0.2}]")
    problem = load_problem(str(urdf), str(world))
    write_html(problem, [run(problem, False, 1.5)], ["free"], tmp_path / "arm.html")
    check_page(browser, tmp_path / "arm.html", 1.5)


def test_run_that_blew_up_is_shown_until_then(two_link: tuple[Problem, Trajectory], tmp_path: Path) -> None:
    problem, trajectory = two_link
    q, clearance = trajectory.q.copy(), trajectory.clearance.copy()
    q[200:], clearance[200:] = np.nan, np.nan
    write_html(problem, [dataclasses.replace(trajectory, q=q, clearance=clearance)], ["a"], tmp_path / "a.html")
    with pytest.raises(InputError, match="no usable configuration"):
        check_trajectories(problem, [dataclasses.replace(trajectory, q=q * np.nan)], ["a"])


def test_server_listens_on_loopback_alone_and_goes(two_link: tuple[Problem, Trajectory]) -> None:
    problem, trajectory = two_link
    with show(problem, [trajectory], ["a"]) as server:
        port = int(server.url.rsplit(":", 1)[1].strip("/"))
        with urllib.request.urlopen(server.url) as answer:
            assert b"two_link" in answer.read()
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(server.url + "etc/passwd")
        assert listening_addresses(port) == {"127.0.0.1"}
        with pytest.raises(InputError, match=f"cannot listen on port {port} of 127.0.0.1"):
            PageServer("", port)
    assert listening_addresses(port) == set()
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", port), timeout=2)


def listening_addresses(port: int) -> set[str]:
    """Local addresses on which a socket listens at a port, from the kernel's tables."""
    found = set()
    for table in (Path("/proc/net/tcp"), Path("/proc/net/tcp6")):
        for line in table.read_text().splitlines()[1:] if table.exists() else []:
            address, state = line.split()[1], line.split()[3]
            host, _, number = address.partition(":")
            if state == "0A" and int(number, 16) == port:
                found.add(socket.inet_ntoa(bytes.fromhex(host)[::-1]) if len(host) == 8 else host)
    return found


def test_ctrl_c_ends_it_and_stdout_stays_empty(two_link: tuple[Problem, Trajectory], tmp_path: Path) -> None:
    two_link[1].save(tmp_path / "run.npz")
    program = f"""
import signal, sys, pathlib
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs inherit that it is ignored
from ppcbf_robots.problem import load_problem
from ppcbf_robots.rollout import Trajectory
from ppcbf_robots.viewer import show
run = Trajectory.load(pathlib.Path({str(tmp_path / "run.npz")!r}))
server = show(load_problem("two_link", "circle"), [run], ["a"])
print(server.url, file=sys.stderr, flush=True)
server.wait()
"""
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stderr is not None
        url = process.stderr.readline().decode().strip()
        with urllib.request.urlopen(url) as answer:
            assert answer.status == 200
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
        assert not children.exists() or children.read_text() == ""
        time.sleep(1.0)  # so that the interrupt comes while the program waits, not just before
        process.send_signal(signal.SIGINT)
        try:
            out, err = process.communicate(timeout=10)
        finally:
            process.kill()  # or leaving the block would wait for ever
    assert (process.returncode, out, err) == (0, b"", b"")


def test_trajectories_of_another_robot_are_refused(two_link: tuple[Problem, Trajectory], tmp_path: Path) -> None:
    problem, trajectory = two_link
    other = load_problem("panda", "sphere")
    with pytest.raises(InputError, match="'a' is of a robot with 2 moving joints, nq = 2, but 'panda' has 7"):
        write_html(other, [trajectory], ["a"], tmp_path / "x.html")
    with pytest.raises(InputError, match="at least one trajectory"):
        check_trajectories(problem, [], [])
    with pytest.raises(InputError, match="expected 1 labels, one per trajectory, got 2"):
        check_trajectories(problem, [trajectory], ["a", "b"])
    with pytest.raises(InputError, match="cannot be written"):
        write_html(problem, [trajectory], ["a"], tmp_path)
