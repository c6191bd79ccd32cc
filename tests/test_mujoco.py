"""The second engine: its dynamics against Pinocchio's, its shapes against coal's, and contacts in closed loop."""

from __future__ import annotations

import dataclasses
import json
import logging
import sys

import coal
import mujoco
import numpy as np
import pinocchio as pin
import pytest
import yaml
from typer.testing import CliRunner

from ppcbf_robots.cli.main import app, main
from ppcbf_robots.controllers import Gains, NominalController
from ppcbf_robots.engine_mujoco import MujocoEngine
from ppcbf_robots.engines import Contact, ContactLog
from ppcbf_robots.filters import FilterConfig
from ppcbf_robots.problem import Problem, load_problem
from ppcbf_robots.rollout import Trajectory, simulate
from ppcbf_robots.safety_filter import SafetyFilter
from ppcbf_robots.world import WorldSpec

FAR = {"name": "far", "type": "sphere", "center": [50.0, 0.0, 0.0], "radius": 0.1}
BALL = {"name": "ball", "type": "sphere", "center": [0.5, 0.0, 0.5], "radius": 0.1}
BOX = {"name": "box", "type": "box", "xyz": [0.5, 0.0, 0.5], "rpy": [0.0, 0.0, 0.4], "size": [0.2, 0.15, 0.2]}

SPECS = {
    "payload": {"urdf": "panda", "payload": {"frame": "panda_hand", "mass": 2.5, "com": [0.05, -0.02, 0.1]},
                "locked": {"panda_joint3": 0.7, "panda_joint6": 1.9, "panda_finger_joint1": 0.01,
                           "panda_finger_joint2": 0.03}},
    "locked continuous": {"urdf": "kinova", "locked": {"j2s6s200_joint_1": 2.0, "j2s6s200_joint_5": -0.8}},
    "branching": {"urdf": "allegro_left_hand", "moving": [f"joint_{i}.0" for i in range(8)]},
}  # fmt: skip
ROBOTS = ["panda", "ur5", "kinova", "cartpole", "two_link", "xarm7", *SPECS]

TOY = """<robot name="toy"><link name="base"/>
<link name="arm"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
{collision}</link>
<joint name="turn" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>
<limit lower="-3" upper="3" effort="10" velocity="2"/></joint></robot>"""


def in_world(problem: Problem, *obstacles: dict) -> Problem:
    """The problem with other obstacles for MuJoCo alone; its safety function stays."""
    return dataclasses.replace(problem, world=WorldSpec.model_validate({"obstacles": obstacles}))


def mass_and_bias(engine: MujocoEngine, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """MuJoCo's mass matrix M (nv, nv) and bias torque C v + g (nv,) at (q, v), which becomes the state."""
    engine.reset(q, v)
    mujoco.mj_forward(engine.model, engine.data)
    M = np.empty((engine.robot.nv, engine.robot.nv))
    for column, unit in zip(M, np.eye(engine.robot.nv), strict=True):
        mujoco.mj_mulM(engine.model, engine.data, column, unit)
    return M[np.ix_(engine.dofs, engine.dofs)], np.array(engine.data.qfrc_bias[engine.dofs])


def accelerated(engine: MujocoEngine, q: np.ndarray, v: np.ndarray, u: np.ndarray) -> np.ndarray:
    """MuJoCo's forward dynamics (nv,) at (q, v), which becomes the state; contact forces included."""
    engine.reset(q, v)
    engine.data.qfrc_applied[engine.dofs] = u
    mujoco.mj_forward(engine.model, engine.data)
    return np.array(engine.data.qacc[engine.dofs])


@pytest.fixture
def load(tmp_path):
    """``load(robot, *obstacles)``: a problem from a name, or from a spec given as data."""

    def build(robot: str | dict, *obstacles: dict) -> Problem:
        if isinstance(robot, dict):
            (tmp_path / "robot.yaml").write_text(json.dumps(robot))
            robot = str(tmp_path / "robot.yaml")
        (tmp_path / "world.yaml").write_text(yaml.safe_dump({"obstacles": obstacles or [FAR]}))
        return load_problem(robot, str(tmp_path / "world.yaml"))

    return build


@pytest.fixture
def toy(load, tmp_path):
    """``toy(collision)``: one link about the vertical axis with a body sphere of 0.1 m, 0.5 m away from it."""

    def build(collision: str = "") -> Problem:
        (tmp_path / "toy.urdf").write_text(TOY.format(collision=collision))
        return load({"urdf": "toy.urdf", "body": [{"frame": "arm", "center": [0.5, 0.0, 0.0], "radius": 0.1}]})

    return build


def run(problem: Problem, duration: float, filtered: bool = False) -> Trajectory:
    """The robot's own start, controller and goal in MuJoCo, without filter or under one with the LB-CBF."""
    robot, barrier = problem.robot, problem.barrier("lb-cbf")
    filter_ = SafetyFilter(problem.model, problem.safety, barrier, FilterConfig()) if filtered else None
    engine = MujocoEngine(problem)
    return simulate(problem.safety, robot.controller, filter_, robot.start, robot.start_velocity, duration,
                    engine=engine)  # fmt: skip


# ------------------------------------------------------------------------------------------------------ dynamics


@pytest.mark.parametrize("name", ROBOTS)
def test_dynamics_agree_with_pinocchio(name, load, states):
    problem = load(SPECS.get(name, name))
    engine, model, rng = MujocoEngine(problem), problem.model, np.random.default_rng(1)
    mass = sum(Y.mass for Y in list(model.model.inertias)[1:])
    assert engine.model.body_subtreemass[0] == pytest.approx(mass)  # contacts depend on such derived constants
    for q, v in states(problem, 20):
        dyn, u = model.evaluate(q, v), rng.uniform(-1.0, 1.0, model.nv) * model.u_max
        M, bias = mass_and_bias(engine, q, v)
        acceleration = model.acceleration(q, v, u)
        for found, expected in ((M, dyn.M), (bias, dyn.b), (accelerated(engine, q, v, u), acceleration)):
            np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-10 * np.abs(expected).max())


@pytest.mark.parametrize("name", ["two_link", "kinova", "cartpole"])
def test_free_motion_is_the_same_in_both_engines(name, load):
    problem = load(name)
    nothing = np.zeros(problem.model.nv)
    idle = NominalController(problem.model, Gains("shaping", nothing, nothing, nothing), problem.robot.goal)
    v = 0.3 * problem.model.v_max
    ours, theirs = (
        simulate(problem.safety, idle, None, problem.robot.start, v, 0.5, engine=engine)
        for engine in (None, MujocoEngine(problem))
    )
    assert np.abs(problem.model.difference(ours.q[-1], ours.q[0])).max() > 0.1
    np.testing.assert_allclose(theirs.q, ours.q, atol=1e-9)
    np.testing.assert_allclose(theirs.v, ours.v, atol=1e-8)
    assert (ours.meta["engine"], theirs.meta["engine"]) == ("pinocchio", "mujoco")


def test_a_run_that_explodes_ends_early_and_writes_no_file(cartpole, tmp_path, monkeypatch, capfd, caplog):
    monkeypatch.chdir(tmp_path)
    gains = Gains("pd_gravity", np.full(2, -1e20), np.zeros(2), np.ones(2))
    wild = NominalController(cartpole.model, gains, np.array([1.0, 0.0]))
    with caplog.at_level(logging.WARNING):
        found = simulate(cartpole.safety, wild, None, np.zeros(2), np.zeros(2), 1.0, engine=MujocoEngine(cartpole))
    assert found.meta["complete"] is False
    assert "unstable" in caplog.text
    assert capfd.readouterr().out == ""
    assert list(tmp_path.iterdir()) == []


# -------------------------------------------------------------------------------------------------------- shapes

TURN = {"xyz": [0.6, 0.3, 0.4], "rpy": [0.3, -0.5, 0.9]}
CORNERS = [[x, y, z] for x in (-0.1, 0.1) for y in (-0.2, 0.2) for z in (-0.3, 0.3)]
OBSTACLES = {
    "sphere": (FAR | {"center": TURN["xyz"]}, coal.Sphere(0.1)),
    "box": ({"type": "box", "size": [0.2, 0.4, 0.6], **TURN}, coal.Box(0.2, 0.4, 0.6)),
    "quaternion": ({"type": "box", "size": [0.2, 0.4, 0.6], "xyz": [0.6, 0.3, 0.4], "quat_xyzw": [0.5, 0.1, 0.7, 0.5]},
                   coal.Box(0.2, 0.4, 0.6)),
    "capsule": ({"type": "capsule", "radius": 0.1, "length": 0.5, **TURN}, coal.Capsule(0.1, 0.5)),
    "cylinder": ({"type": "cylinder", "radius": 0.1, "length": 0.5, **TURN}, coal.Cylinder(0.1, 0.5)),
    "mesh": ({"type": "mesh", "vertices": CORNERS, **TURN}, coal.Box(0.2, 0.4, 0.6)),
    "scaled mesh": ({"type": "mesh", "vertices": CORNERS, "scale": 1.5, **TURN}, coal.Box(0.3, 0.6, 0.9)),
    "flat mesh": ({"type": "mesh", "vertices": [[x, y, 0.0] for x, y, z in CORNERS], **TURN}, coal.Box(0.2, 0.4, 2e-4)),
}  # fmt: skip


def coal_distance(a: coal.ShapeBase, Ta: pin.SE3, b: coal.ShapeBase, Tb: pin.SE3) -> float:
    poses = [coal.Transform3s(T.rotation, T.translation) for T in (Ta, Tb)]
    return float(coal.distance(a, poses[0], b, poses[1], coal.DistanceRequest(), coal.DistanceResult()))


def mujoco_distance(engine: MujocoEngine, a: int, b: int) -> float:
    return float(mujoco.mj_geomDistance(engine.model, engine.data, a, b, 10.0, None))


def placement(data: dict) -> pin.SE3:
    """Of an obstacle, by Pinocchio's own conversions."""
    rotation = pin.rpy.rpyToMatrix(*data.get("rpy", [0.0, 0.0, 0.0]))
    if "quat_xyzw" in data:
        rotation = pin.Quaternion(np.array(data["quat_xyzw"])).matrix()
    return pin.SE3(rotation, np.array(data.get("xyz", data.get("center"))))


@pytest.mark.parametrize("kind", OBSTACLES)
def test_obstacles_are_where_coal_has_them(kind, toy, states):
    data, shape = OBSTACLES[kind]
    problem = toy()
    engine = MujocoEngine(in_world(problem, {"name": "thing", **data}))
    for q, v in states(problem, 10):
        mass_and_bias(engine, q, v)
        ball = pin.SE3(np.eye(3), 0.5 * np.array([np.cos(q[0]), np.sin(q[0]), 0.0]))
        expected = coal_distance(coal.Sphere(0.1), ball, shape, placement(data))
        assert mujoco_distance(engine, 0, 1) == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("name", ["panda", "kinova", "ur5"])
def test_links_are_where_coal_has_them(name, load, states):
    """Meshes stand for their convex hulls, made by coal here."""
    problem = load(name)
    engine = MujocoEngine(in_world(problem, FAR | {"center": [0.9, 0.4, 0.9]}))
    geometry = problem.model.geometry(pin.GeometryType.COLLISION)
    placed, data = geometry.createData(), problem.model.model.createData()
    moving = [i for i, o in enumerate(geometry.geometryObjects) if o.parentJoint != 0]
    assert engine.model.ngeom == len(moving) + 1
    for q, v in states(problem, 3):
        mass_and_bias(engine, q, v)
        pin.updateGeometryPlacements(problem.model.model, data, geometry, placed, q)
        ball = pin.SE3(np.eye(3), np.array([0.9, 0.4, 0.9]))
        for geom, i in enumerate(moving, 1):  # the obstacle is geometry 0
            shape = geometry.geometryObjects[i].geometry
            if isinstance(shape, coal.BVHModelBase):
                shape.buildConvexHull(True, "Qt")
                shape = shape.convex
            expected = coal_distance(shape, placed.oMg[i], coal.Sphere(0.1), ball)
            assert mujoco_distance(engine, geom, 0) == pytest.approx(expected, abs=1e-4)


# ------------------------------------------------------------------------------------------------------ contacts


def contacts_at(problem: Problem, angle: float, *obstacles: dict) -> list[Contact]:
    engine = MujocoEngine(in_world(problem, *obstacles))
    engine.reset(np.array([angle]), np.zeros(1))
    return engine.contacts()


def test_contacts_name_link_obstacle_and_depth(toy):
    near = FAR | {"name": "near", "center": [0.0, 0.66, 0.0]}
    floor = {"name": "floor", "type": "half_space", "normal": [0.0, 0.6, 0.8], "offset": 0.23}
    assert contacts_at(toy(), 0.0, near, FAR) == []
    quarter = {c.obstacle: c for c in contacts_at(toy(), np.pi / 2, near, FAR)}
    assert set(quarter) == {"near"} and quarter["near"].link == "arm"
    assert quarter["near"].depth == pytest.approx(0.5 + 0.1 + 0.1 - 0.66)
    (ground,) = contacts_at(toy(), np.pi / 2, floor)
    assert ground.depth == pytest.approx(0.1 - (0.6 * 0.5 - 0.23))
    assert contacts_at(toy(), np.pi / 2, floor | {"offset": 0.19}) == []


def test_a_margin_is_not_solid(toy):
    near = FAR | {"center": [0.71, 0.0, 0.0], "margin": 0.1}
    assert contacts_at(toy(), 0.0, near) == []
    assert contacts_at(toy(), 0.0, near | {"radius": 0.12})


BEAM = '<collision name="beam"><origin xyz="0.3 0 0" rpy="0 1.57079632679 0"/><geometry>{}</geometry></collision>'
LINKS = {
    "box": ('<box size="0.1 0.1 0.2"/>', 0.4),
    "sphere": ('<sphere radius="0.15"/>', 0.45),
    "cylinder": ('<cylinder radius="0.05" length="0.4"/>', 0.5),
    "mesh": ('<mesh filename="{tmp}/wedge.obj" scale="2 2 2"/>', 0.4),
    "unreadable": ('<mesh filename="missing.stl"/>', 0.6),  # the body sphere stands for the link
}
WEDGE = "v 0 0 0.05\nv 0.05 -0.05 -0.05\nv -0.05 -0.05 -0.05\nv 0 0.05 -0.05\nf 1 2 3\nf 1 3 4\nf 1 4 2\nf 2 4 3\n"


@pytest.mark.parametrize("kind", LINKS)
def test_shapes_of_links(kind, toy, tmp_path):
    """``reach`` is where along x the link ends."""
    (tmp_path / "wedge.obj").write_text(WEDGE)
    shape, reach = LINKS[kind]
    problem = toy(BEAM.format(shape.format(tmp=tmp_path)))
    (contact,) = contacts_at(problem, 0.0, FAR | {"center": [reach + 0.099, 0.0, 0.0]})
    assert contact.depth == pytest.approx(0.001, abs=1e-5)
    assert contacts_at(problem, 0.0, FAR | {"center": [reach + 0.101, 0.0, 0.0]}) == []


THINGS = {
    "sphere": FAR | {"center": [0.0, 0.0, 0.0], "radius": 0.02},
    "box": {"type": "box", "size": [0.04, 0.04, 0.04]},
    "capsule": {"type": "capsule", "radius": 0.02, "length": 0.01},
    "cylinder": {"type": "cylinder", "radius": 0.02, "length": 0.04},
    "mesh": {"type": "mesh", "scale": 0.02, "vertices": [[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]},
}


@pytest.mark.parametrize("kind", THINGS)
def test_a_hull_that_touches_is_told_from_its_mesh(kind, toy, tmp_path):
    """Two tetrahedra 0.3 m apart are one mesh: its hull is solid in between, the mesh is not."""
    second = WEDGE.replace("v 0 ", "v 0.3 ").replace("v 0.05 ", "v 0.35 ").replace("v -0.05 ", "v 0.25 ")
    triangles = ((1, 2, 3), (1, 3, 4), (1, 4, 2), (2, 4, 3))
    faces = "".join(f"f {a + k} {b + k} {c + k}\n" for k in (0, 4) for a, b, c in triangles)
    vertices = [line for line in (WEDGE + second).splitlines() if line.startswith("v")]
    (tmp_path / "pair.obj").write_text("\n".join(vertices) + "\n" + faces)
    problem = toy(f'<collision><geometry><mesh filename="{tmp_path}/pair.obj"/></geometry></collision>')
    place = "center" if kind == "sphere" else "xyz"
    for x, angle, hull_only in ((0.15, 0.0, True), (0.3, 0.0, False), (0.15, np.pi / 2, True), (0.3, np.pi / 2, False)):
        at = [x * np.cos(angle), x * np.sin(angle), -0.02]
        (contact,) = contacts_at(problem, angle, {"name": "thing"} | THINGS[kind] | {place: at})
        assert contact.hull_only is hull_only


def test_a_half_space_meets_the_mesh_where_it_meets_the_hull(toy, tmp_path):
    (tmp_path / "wedge.obj").write_text(WEDGE)
    problem = toy(f'<collision><geometry><mesh filename="{tmp_path}/wedge.obj"/></geometry></collision>')
    floor = {"name": "floor", "type": "half_space", "normal": [0.0, 0.0, 1.0], "offset": -0.049}
    assert [c.hull_only for c in contacts_at(problem, 0.3, floor)] == [False]


def test_links_pass_through_each_other(panda):
    """Folded up, the Panda's hand is inside its shoulder."""
    engine, model = MujocoEngine(in_world(panda, FAR)), panda.model
    folded = np.array([0.0, -1.7, 0.0, -3.0, 0.0, -0.01, 0.0])
    mass_and_bias(engine, folded, np.zeros(7))
    pairs = [(a, b) for a in range(1, engine.model.ngeom) for b in range(1, a)]
    body = engine.model.geom_bodyid
    assert min(mujoco_distance(engine, a, b) for a, b in pairs if abs(body[a] - body[b]) > 1) < -0.01
    assert engine.contacts() == []
    u = model.gravity(folded)
    assert np.abs(accelerated(engine, folded, np.zeros(7), u)).max() < 1e-9


def test_contact_stops_the_arm(toy):
    """A constant torque of 1 N m presses the link against a ball."""
    problem = toy()
    engine = MujocoEngine(in_world(problem, FAR | {"center": [0.0, 0.5, 0.0]}))
    engine.reset(np.zeros(1), np.zeros(1))
    engine.advance(np.ones(1), 5e-4, 10_000)
    (q, v), free = engine.state(), np.pi / 2 - 2.0 * np.arcsin(0.2 / 2.0 / 0.5)
    assert abs(q[0] - free) < 0.02
    assert abs(v[0]) < 0.05
    assert [c.obstacle for c in engine.contacts()] == ["far"]


def test_the_log_keeps_first_time_and_largest_depth():
    log = ContactLog()
    assert log.report() is None
    hand, arm = Contact("hand", "ball", 0.001), Contact("arm", "ball", 0.002)
    hull = Contact("arm", "ball", 0.002, hull_only=True)
    for t, contacts in ((0.1, [hull]), (0.2, [hand]), (0.3, [hull, Contact("hand", "ball", 0.004)]), (0.4, [hand])):
        log.add(t, contacts)
    pairs = [{"link": "arm", "obstacle": "ball", "first": 0.1, "depth": 0.002, "hull_only": True},
             {"link": "hand", "obstacle": "ball", "first": 0.2, "depth": 0.004, "hull_only": False}]  # fmt: skip
    assert log.report() == {"steps": 3, "hull_steps": 1, "pairs": pairs}
    log.add(0.5, [arm])
    assert log.report()["pairs"][0]["hull_only"] is False


# --------------------------------------------------------------------------------------------------- closed loop


def test_the_panda_touches_a_ball_only_without_the_filter(load):
    problem = load("panda", BALL)
    passed, hit = run(problem, 8.0, filtered=True), run(problem, 2.0)
    assert passed.active.sum() > 500
    assert passed.clearance.min() > 0.0
    assert passed.summary(problem.model)["cleared_at"] < 7.9
    assert passed.meta["contacts"] == {"steps": 0, "hull_steps": 0, "pairs": []}
    assert hit.meta["contacts"]["steps"] > 300
    (pair,) = hit.meta["contacts"]["pairs"]
    assert (pair["link"], pair["obstacle"]) == ("panda_link5", "ball")
    assert 0.0 < pair["first"] < 1.0 and 0.001 < pair["depth"] < 0.05


def test_the_panda_touches_a_box_without_the_filter(panda):
    found = run(in_world(panda, BOX), 2.0).summary(panda.model)
    assert found["contacts"] > 300
    assert found["contact_with"] == ["panda_link5 / box"]


def test_the_panda_passes_a_box_with_the_filter(load):
    problem = load("panda", BOX)
    passed = run(problem, 3.0, filtered=True)
    assert passed.active.sum() > 500
    assert passed.h.min() > 0.0
    assert passed.meta["contacts"] == {"steps": 0, "hull_steps": 0, "pairs": []}


# ---------------------------------------------------------------------------------------------------------- command

TOUCH = ["simulate", "panda", "sphere", "--barrier", "none", "--duration", "1.2", "--engine"]


def test_simulate_reports_contacts(tmp_path):
    path = tmp_path / "t.npz"
    text = CliRunner().invoke(app, [*TOUCH, "mujoco", "--out", str(path)])
    facts = json.loads(CliRunner().invoke(app, [*TOUCH, "mujoco", "--json", "--out", str(path)]).stdout)
    contacts = Trajectory.load(path).meta["contacts"]
    assert text.exit_code == 0
    assert facts["contacts"] == contacts["steps"] > 0
    assert facts["contact_with"] == ["panda_link5 / ball"]
    assert facts["hull_contacts"] < 5  # at first touch only
    assert "engine mujoco" in text.stdout
    assert f"CONTACT            in {contacts['steps']} of 1201 steps" in text.stdout
    assert f"panda_link5 / ball from {contacts['pairs'][0]['first']:.3f} s" in text.stdout


def test_simulate_says_that_nothing_was_touched(tmp_path):
    command = ["simulate", "two_link", "circle", "--duration", "0.02", "--out", str(tmp_path / "t.npz"), "--engine"]
    assert "contact            none\n" in CliRunner().invoke(app, [*command, "mujoco"]).stdout
    assert "contact" not in CliRunner().invoke(app, [*command, "pinocchio"]).stdout.lower()
    facts = json.loads(CliRunner().invoke(app, [*command, "pinocchio", "--json"]).stdout)
    assert facts["contacts"] is None and facts["contact_with"] is None  # not 0: Pinocchio does not look


def test_without_the_extra_the_remedy_is_named(monkeypatch, capsys):
    monkeypatch.delitem(sys.modules, "ppcbf_robots.engine_mujoco", raising=False)
    monkeypatch.setitem(sys.modules, "mujoco", None)
    monkeypatch.setattr(sys, "argv", ["ppcbf", *TOUCH, "mujoco"])
    with pytest.raises(SystemExit) as exit_info:
        main()
    assert exit_info.value.code == 2
    expected = 'error: --engine mujoco needs the mujoco package; remedy: pip install "ppcbf-robots[mujoco]"'
    assert expected in capsys.readouterr().err
