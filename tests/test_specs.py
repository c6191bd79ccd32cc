"""Bad input: every mistake gives an InputError of one sentence that names the file, the place and the remedy."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ppcbf_robots.errors import InputError
from ppcbf_robots.problem import load_problem, load_robot, parse_vector
from ppcbf_robots.resources import find_world
from ppcbf_robots.safety import SafetyFunction
from ppcbf_robots.specs import RobotSpec, load_spec, per_joint, vector
from ppcbf_robots.world import WorldSpec

INERTIAL = """<inertial><origin xyz="0.2 0 0" rpy="0 0 0"/><mass value="1"/>
    <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial>"""
ARM = f"""<robot name="arm">
  <link name="base"/>
  <link name="upper">{INERTIAL}</link>
  <link name="fore">{INERTIAL}</link>
  <link name="tip"/>
  <joint name="shoulder" type="revolute">
    <parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="20" velocity="3"/>
  </joint>
  <joint name="elbow" type="revolute">
    <parent link="upper"/><child link="fore"/><origin xyz="0.4 0 0" rpy="0 0 0"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="20" velocity="3"/>
  </joint>
  <joint name="tip_mount" type="fixed">
    <parent link="fore"/><child link="tip"/><origin xyz="0.4 0 0" rpy="0 0 0"/>
  </joint>
</robot>
"""
ROBOT = """urdf: arm.urdf
effort: {shoulder: 30.0}
controller: {type: bounded_spring, kp: 5.0, kd: [1.0, 1e-1]}
body:
  - {frame: fore, center: [0.2, 0.0, 0.0], radius: 5e-2}
  - {frame: tip}
domain:
  q: [[-1.5, 1.5], [-1.5, 1.5]]
  v: [[-2.0, 2.0], [-2.0, 2.0]]
start: [0.1, 0.2]
goal: [0.5, 0.6]
payload: {frame: tip, mass: 0.5}
"""
WORLD = """obstacles:
  - {name: ball, type: sphere, center: [0.5, 0.0, 0.6], radius: 0.1}
  - {name: floor, type: half_space, normal: [0.0, 0.0, 1.0], offset: -0.9, margin: 0.01}
"""


@pytest.fixture
def files(tmp_path):
    """``files(name=text, ...)`` writes the small arm, its spec and its world, some of them changed."""

    def write(urdf=ARM, robot=ROBOT, world=WORLD):
        for name, text in (("arm.urdf", urdf), ("arm.yaml", robot), ("world.yaml", world)):
            (tmp_path / name).write_text(text, encoding="utf-8")
        return tmp_path

    return write


def message(call, *arguments):
    """The message of the InputError that the call must raise; one line, ending without a full stop."""
    with pytest.raises(InputError) as error:
        call(*arguments)
    text = str(error.value)
    assert "\n" not in text
    assert error.value.exit_code == 2
    return text


def changed(text, old, new, count=1):
    assert old in text
    return text.replace(old, new, count)


def test_the_examples_themselves_are_good(files):
    folder = files()
    problem = load_problem(str(folder / "arm.yaml"), str(folder / "world.yaml"))
    assert problem.model.joint_names == ["shoulder", "elbow"]
    np.testing.assert_array_equal(problem.model.u_max, [30.0, 20.0])
    np.testing.assert_array_equal(problem.robot.controller.gains.kd, [1.0, 0.1])  # 1e-1 is a number
    assert problem.robot.body[0].radius == 0.05
    problem.check_start(problem.robot.start)
    plain = load_robot(str(folder / "arm.urdf"))
    assert set(plain.derived) == {"controller", "body", "start", "goal", "domain.q", "domain.v"}


# --------------------------------------------------------------------------------------------------- URDF

URDF_MISTAKES = {
    "negative mass": ('<mass value="1"/>', '<mass value="-1"/>',
                      "link 'upper': the mass is -1.0 kg; correct it to a positive number"),
    "NaN mass": ('<mass value="1"/>', '<mass value="nan"/>', "link 'upper', mass: nan is not a finite number"),
    "words for mass": ('<mass value="1"/>', '<mass value="heavy"/>', "link 'upper', mass: 'heavy' is not a number"),
    "negative inertia": ('iyy="0.01"', 'iyy="-2"',
                         "link 'upper': the moment of inertia iyy is -2.0; it must not be negative"),
    "no effort limit": (' effort="20"', "",
                        "joint 'shoulder' has no usable effort limit (got 0); "
                        "give one in a robot spec, e.g. `effort: {shoulder: 10.0}`, or lock the joint"),
    "zero effort limit": ('effort="20"', 'effort="0"', "joint 'shoulder' has no usable effort limit (got 0); "
                          "give one in a robot spec, e.g. `effort: {shoulder: 10.0}`, or lock the joint"),
    "no limit": ('<limit lower="-2" upper="2" effort="20" velocity="3"/>', "",
                 "joint 'shoulder' has no usable effort and velocity limit (got 0); give them in a robot spec, "
                 "e.g. `effort: {shoulder: 10.0}` and `velocity: {shoulder: 2.0}`, or lock the joint"),
    "zero velocity limit": ('velocity="3"', 'velocity="0"', "joint 'shoulder' has no usable velocity limit (got 0); "
                            "give one in a robot spec, e.g. `velocity: {shoulder: 2.0}`, or lock the joint"),
    "infinite velocity": ('velocity="3"', 'velocity="inf"',
                          "joint 'shoulder' has no usable velocity limit (got 0); "
                          "give one in a robot spec, e.g. `velocity: {shoulder: 2.0}`, or lock the joint"),
    "swapped limits": ('lower="-2" upper="2"', 'lower="2" upper="-2"',
                       "joint 'shoulder': lower limit 2.0 is above upper limit -2.0; swap them"),
    "DOCTYPE": ("<robot", '<!DOCTYPE robot [<!ENTITY a "b">]><robot',
                "a URDF must not contain DOCTYPE or ENTITY declarations; remove them"),
    "two roots": ('<link name="base"/>', '<link name="base"/><link name="loose"/>',
                  "a URDF has one root link, this one has 2 ('base', 'loose')"),
    "loop": ('<link name="tip"/>',
             '<link name="tip"/><joint name="back"><parent link="tip"/><child link="upper"/></joint>',
             "link 'upper' is the child of two joints; closed loops are not supported"),
    "floating joint": ('type="revolute"', 'type="floating"',
                       "joint 'shoulder' is floating; only fixed-base arms are supported"),
    "planar joint": ('type="revolute"', 'type="planar"',
                     "joint 'shoulder' is planar; only fixed-base arms are supported"),
    "unknown child": ('<child link="upper"/>', '<child link="uper"/>',
                      "joint 'shoulder': its child link 'uper' does not exist"),
    "no parent": ('<parent link="base"/>', "", "joint 'shoulder': its parent link 'None' does not exist"),
    "zero axis": ('xyz="0 1 0"', 'xyz="0 0 0"',
                  "joint 'shoulder': the axis must be a vector of three numbers, not all zero"),
    "short axis": ('xyz="0 1 0"', 'xyz="0 1"',
                   "joint 'shoulder': the axis must be a vector of three numbers, not all zero"),
}  # fmt: skip


@pytest.mark.parametrize("mistake", URDF_MISTAKES)
def test_mistakes_in_a_urdf(files, mistake):
    old, new, expected = URDF_MISTAKES[mistake]
    path = files(urdf=changed(ARM, old, new)) / "arm.urdf"
    assert message(load_robot, str(path)) == f"{path}: {expected}"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "not valid XML (no element found: line 1, column 0)"),
        ("hello", "not valid XML (syntax error: line 1, column 0)"),
        (ARM[:300], "not valid XML ("),
        ("<sdf/>", "the root element is <sdf>, a URDF's is <robot>"),
        ("<robot name='empty'/>", "the URDF has no <link>"),
        ('<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:include filename="arm.xacro"/></robot>',
         "this is a xacro file; expand it first with `xacro file.xacro > robot.urdf`"),
        ("<robot><xacro:arm/></robot>", "this is a xacro file; expand it first with `xacro file.xacro > robot.urdf`"),
        ("<robot>" + "".join(f"<link name='l{i}'/>" for i in range(1001)) + "</robot>",
         "1001 links; at most 1000 are read"),
    ],
    ids=["empty", "words", "cut", "sdf", "no link", "xacro", "xacro without namespace", "many links"],
)  # fmt: skip
def test_files_that_are_no_urdf(files, text, expected):
    path = files(urdf=text) / "arm.urdf"
    assert message(load_robot, str(path)).startswith(f"{path}: {expected}")


def test_moving_link_without_mass(files):
    path = files(urdf=ARM.replace(INERTIAL, "")) / "arm.urdf"
    text = message(load_robot, str(path))
    assert text.startswith(f"{path}: the mass matrix is not positive definite (least eigenvalue 0): the link moved by ")
    assert text.endswith("has no mass or inertia; give it one in the URDF, or lock the joint")
    one = files(urdf=ARM[: ARM.rindex(INERTIAL)] + ARM[ARM.rindex(INERTIAL) + len(INERTIAL) :]) / "arm.urdf"
    assert "the link moved by joint 'elbow' has no mass or inertia" in message(load_robot, str(one))


NUMBERS = [(m.start(), m.end()) for m in re.finditer(r'(?<=[ "])-?[0-9.]+(?=[ "])', ARM)]


@pytest.mark.parametrize("value", ["nan", "inf", "-inf"])
@pytest.mark.parametrize("where", NUMBERS, ids=lambda span: ARM[: span[0]].rsplit("<", 1)[1] + str(span[0]))
def test_no_number_of_a_urdf_may_be_infinite_or_nan(files, where, value):
    """But for limits, where infinity means none."""
    text = ARM[: where[0]] + value + ARM[where[1] :]
    key = ARM[: where[0]].rsplit(" ", 1)[1]
    if key.startswith(("lower", "upper")) and value != "nan":
        return
    path = files(urdf=text) / "arm.urdf"
    assert message(load_robot, str(path)).startswith(f"{path}: ")


def test_mimic_joints_are_locked_with_a_warning(files):
    joint = '<joint name="elbow" type="revolute">'
    folder = files(urdf=changed(ARM, joint, joint + '<mimic joint="shoulder"/>'))
    model = load_robot(str(folder / "arm.urdf")).model
    assert model.joint_names == ["shoulder"]
    assert model.warnings[0] == "joint 'elbow' mimics another joint and was locked at 0"


def test_joints_in_a_circle_are_refused(files):
    """Beside a proper root, so that counting roots alone does not see them."""
    joint = '<joint name="{0}{1}" type="fixed"><parent link="{0}"/><child link="{1}"/></joint>'
    circle = '<link name="x"/><link name="y"/>' + joint.format("x", "y") + joint.format("y", "x")
    path = files(urdf=changed(ARM, '<link name="base"/>', '<link name="base"/>' + circle)) / "arm.urdf"
    text = message(load_robot, str(path))
    assert text == f"{path}: link 'x' hangs in a loop of joints that does not start at 'base'"


@pytest.mark.parametrize("kind", ["link", "joint"])
def test_two_of_one_name_are_refused(files, kind):
    names = {"link": ('link name="tip"', 'link name="fore"'), "joint": ('joint name="elbow"', 'joint name="shoulder"')}
    path = files(urdf=changed(ARM, *names[kind])) / "arm.urdf"
    assert message(load_robot, str(path)).startswith(f"{path}: ")


# --------------------------------------------------------------------------------------------- robot specs

KNOWN = ", ".join(RobotSpec.model_fields)
ROBOT_MISTAKES = {
    "malformed": ("[0.1, 0.2]", "[0.1, 0.2", "not valid YAML at line 11, column 5: expected ',' or ']', but got ':'"),
    "duplicate key": ("goal:", "start:", "not valid YAML at line 11, column 1: the key 'start' stands twice"),
    "unknown key": ("goal:", "gaol:", f"unknown key 'gaol' (known: {KNOWN})"),
    "unknown inner key": ("mass: 0.5", "weight: 0.5", "the key 'payload.mass' is missing"),
    "no urdf": ("urdf: arm.urdf\n", "", "the key 'urdf' is missing"),
    "urdf not there": ("arm.urdf", "leg.urdf", None),
    "NaN": ("kp: 5.0", "kp: .nan", None),
    "infinity": ("radius: 5e-2", "radius: .inf", "body.0.radius: input should be a finite number, got inf"),
    "negative radius": ("radius: 5e-2", "radius: -1",
                        "body.0.radius: input should be greater than or equal to 0, got -1"),
    "words": ("radius: 5e-2", "radius: wide",
              "body.0.radius: input should be a valid number, unable to parse string as a number, got 'wide'"),
    "short vector": ("center: [0.2, 0.0, 0.0]", "center: [0.2, 0.0]",
                     "body.0.center: list should have at least 3 items after validation, not 2, got [0.2, 0.0]"),
    "unordered domain": ("q: [[-1.5, 1.5]", "q: [[1.5, -1.5]",
                         "domain: q[0]: the lower bound 1.5 must be below the upper bound -1.5"),
    "domain without rest": ("v: [[-2.0, 2.0]", "v: [[1.0, 2.0]",
                            "domain: v[0]: the range (1.0, 2.0) must contain 0, or the robot could never rest"),
}  # fmt: skip


@pytest.mark.parametrize("mistake", ROBOT_MISTAKES)
def test_mistakes_in_a_robot_spec(files, mistake):
    old, new, expected = ROBOT_MISTAKES[mistake]
    path = files(robot=changed(ROBOT, old, new)) / "arm.yaml"
    text = message(load_robot, str(path))
    assert text.startswith(f"{path}: ")
    if expected is not None:
        assert text == f"{path}: {expected}"


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("start: [0.1, 0.2]", "start: [0.1]", "{yaml}: start: expected 2 numbers, one per moving joint, got 1"),
        ("goal: [0.5, 0.6]", "goal: [1, 2, 3]", "{yaml}: goal: expected 2 numbers, one per moving joint, got 3"),
        ("q: [[-1.5, 1.5], [-1.5, 1.5]]", "q: [[-1.5, 1.5]]",
         "domain.q: expected 2 pairs, one per moving joint, got 1"),
        ("{shoulder: 30.0}", "{wrist: 30.0}",
         "effort: no moving joint is named 'wrist' (moving joints: shoulder, elbow)"),
        ("{shoulder: 30.0}", "[1.0, 2.0, 3.0]", "effort: expected 2 numbers, one per moving joint, got 3"),
        ("{shoulder: 30.0}", "-5.0", "{urdf}: joints 'shoulder', 'elbow' have no usable effort limit (got -5); give "
         "them in a robot spec, e.g. `effort: {{shoulder: 10.0, elbow: 10.0}}`, or lock the joint"),
        ("kp: 5.0", "kp: -5.0", "controller.kp: must not be negative, got [-5.0, -5.0]"),
        ("effort:", "locked: {wrist: 0.0}\neffort:",
         "{urdf}: locked joint 'wrist' is not a moving joint (moving: shoulder, elbow)"),
        ("{frame: tip}", "{frame: hand}",
         "{urdf}: no link or frame is named 'hand' (links: base, upper, fore, tip)"),
        ("frame: tip, mass", "frame: hand, mass",
         "{urdf}: no link or frame is named 'hand' (links: base, upper, fore, tip)"),
        ("body:\n  - {frame: fore, center: [0.2, 0.0, 0.0], radius: 5e-2}\n  - {frame: tip}", "body: []",
         "the robot has no body spheres; give `body` in the robot spec"),
    ],
)  # fmt: skip
def test_specs_that_do_not_fit_their_robot(files, old, new, expected):
    folder = files(robot=changed(ROBOT, old, new))
    text = message(load_problem, str(folder / "arm.yaml"), str(folder / "world.yaml"))
    assert text == expected.format(yaml=folder / "arm.yaml", urdf=folder / "arm.urdf")


def test_a_mapping_without_default_must_name_every_joint():
    assert message(per_joint, {"a": 1.0}, ["a", "b"], "gain") == "gain: no value for joint 'b'"
    assert message(vector, [1.0, np.nan], 2, "gain") == "gain: every number must be finite, got [1.0, nan]"


# --------------------------------------------------------------------------------------------- worlds

WORLD_MISTAKES = {
    "unit normal": ("[0.0, 0.0, 1.0]", "[0.0, 0.0, 2.0]", "obstacles.1.normal: the normal must have length 1, got 2"),
    "two names": ("name: floor", "name: ball",
                  "obstacles: two obstacles are named 'ball'; give each its own name"),
    "unknown type": ("type: sphere", "type: box", None),
    "no type": ("type: sphere, ", "", None),
    "unknown key": ("radius: 0.1", "radius: 0.1, colour: red",
                    "unknown key 'obstacles.0.colour' (known: see the README's list of keys)"),
    "zero radius": ("radius: 0.1", "radius: 0", "obstacles.0.radius: input should be greater than 0, got 0"),
    "negative margin": ("margin: 0.01", "margin: -0.01",
                        "obstacles.1.margin: input should be greater than or equal to 0, got -0.01"),
    "NaN centre": ("[0.5, 0.0, 0.6]", "[0.5, .nan, 0.6]",
                   "obstacles.0.center.1: input should be a finite number, got nan"),
    "infinite offset": ("offset: -0.9", "offset: -.inf",
                        "obstacles.1.offset: input should be a finite number, got -inf"),
    "no number": ("offset: -0.9", "offset: yes", None),
    "anchors": ("obstacles:", "a: &a [*a]\nobstacles:", None),
}  # fmt: skip


@pytest.mark.parametrize("mistake", WORLD_MISTAKES)
def test_mistakes_in_a_world(files, mistake):
    old, new, expected = WORLD_MISTAKES[mistake]
    path = files(world=changed(WORLD, old, new)) / "world.yaml"
    text = message(load_problem, str(path.parent / "arm.yaml"), str(path))
    assert text.startswith(f"{path}: ")
    if expected is not None:
        assert text == f"{path}: {expected}"


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"", "expected a mapping with keys such as obstacles"),
        (b"[1, 2]", "expected a mapping with keys such as obstacles"),
        (b"? [1]\n: 2", "not valid YAML at line 1, column 3: found unhashable key"),
        (b"obstacles: []", "obstacles: list should have at least 1 item after validation, not 0, got []"),
        (b"\xff\xfe\x00", "not a text file in UTF-8"),
        (b"a: !!python/object/apply:os.system [ls]", "not valid YAML at line 1, column 4: could not "
         "determine a constructor for the tag 'tag:yaml.org,2002:python/object/apply:os.system'"),
        (b"obstacles: " + b"[" * 3000, "not valid YAML"),
        (b"#" * 4_000_001, "larger than 4 MB, which no obstacle spec is"),
    ],
    ids=["empty", "list", "list as key", "none", "binary", "python", "deep", "huge"],
)  # fmt: skip
def test_files_that_are_no_world(tmp_path, content, expected):
    path = tmp_path / "world.yaml"
    path.write_bytes(content)
    assert message(load_spec, path, WorldSpec, "obstacle spec").startswith(f"{path}: {expected}")


def test_aliases_that_multiply_are_refused_at_once(tmp_path):
    """Ten lists of ten of ten ...: a kilobyte that nobody may write out."""
    lists = "\n".join(f"k{i + 1}: &k{i + 1} [{', '.join([f'*k{i}'] * 10)}]" for i in range(12))
    path = tmp_path / "world.yaml"
    path.write_text(f"k0: &k0 [x, x]\n{lists}\nobstacles: [*k12]\n")
    assert message(load_spec, path, WorldSpec, "obstacle spec").startswith(f"{path}: obstacles.0: ")


def test_missing_files_and_unknown_names(tmp_path):
    (tmp_path / "ARM.URDF").write_text("<robot/>")
    assert message(load_robot, str(tmp_path / "ARM.URDF")).startswith(f"{tmp_path / 'ARM.URDF'}: a robot is a .urdf")
    assert message(load_robot, "nope.yaml") == "robot file not found: nope.yaml"
    assert message(load_robot, "nope.urdf") == "robot file not found: nope.urdf"
    assert message(load_robot, "nope") == (
        "no robot named 'nope': give a URDF or YAML path, a bundled name (asr_twodof, baxter_left, baxter_right, "
        "cartpole, double_pendulum, panda, tiago_arm, two_link, ur3), "
        "or the name of a URDF in example-robot-data, such as ur5, z1 or xarm7"
    )
    assert message(find_world, "nope.yaml") == "obstacle file not found: nope.yaml"
    assert message(find_world, "nope") == (
        "no world named 'nope': give a YAML, .scene or URDF path or a bundled name "
        "(circle, five_spheres, pillar, shelf, sphere, table_boxes, wall)"
    )
    for path, expected in (
        (tmp_path / "nope.yaml", f"robot spec not found: {tmp_path / 'nope.yaml'}"),
        (tmp_path, f"{tmp_path} is a folder; give the path of a robot spec"),
    ):
        assert message(load_spec, path, RobotSpec, "robot spec") == expected


def test_obstacle_over_the_base(files):
    folder = files(world=changed(WORLD, "[0.5, 0.0, 0.6]", "[0.0, 0.0, 0.05]"))
    text = message(load_problem, str(folder / "arm.yaml"), str(folder / "world.yaml"))
    assert text == "obstacle 'ball' contains the robot's base (the origin); move or shrink it"


def test_start_inside_an_obstacle_or_beyond_a_limit(files):
    folder = files(world=changed(WORLD, "[0.5, 0.0, 0.6]", "[0.8, 0.0, 0.0]"))
    problem = load_problem(str(folder / "arm.yaml"), str(folder / "world.yaml"))
    assert message(problem.check_start, np.zeros(2)) == (
        "the start configuration violates 'tip#1 / ball' by 0.1000: give another with --start or in the spec"
    )
    assert message(problem.check_start, np.array([-2.5, 0.0])).startswith(
        "the start configuration violates 'shoulder lower limit' by 1.0000: "
    )


def test_a_derived_start_gives_way_to_what_stands_there(files, tmp_path):
    """The nearest of many clear ones, the same every time; a start that is given stays where it is."""
    at_zero = "{name: post, type: sphere, center: [0.46, 0.05, 0.15], radius: 0.1}"
    (tmp_path / "post.yaml").write_text(f"obstacles: [{at_zero}]\n")
    free, problem, again = (load_problem("ur3", w) for w in ("sphere", *2 * [str(tmp_path / "post.yaml")]))
    model = problem.model
    blocked = problem.safety.least(free.robot.start)
    assert blocked[0] < 0.0 and problem.safety.least(problem.robot.start)[0] >= 0.05
    np.testing.assert_array_equal(problem.robot.start, again.robot.start)
    np.testing.assert_array_equal(problem.robot.controller.goal, free.robot.controller.goal)
    assert problem.fingerprint()["task"] == free.fingerprint()["task"]
    said = f"the start that suits most worlds violates '{blocked[1]}' by {-blocked[0]:.4f}: another one was taken"
    assert model.warnings[-1] == said and said not in free.model.warnings
    (tmp_path / "given.yaml").write_text(f"urdf: ur3_robot\nstart: {[0.0] * 6}\neffort: 50\n")
    given = load_problem(str(tmp_path / "given.yaml"), str(tmp_path / "post.yaml"))
    np.testing.assert_array_equal(model.to_angles(given.robot.start), 0.0)


@pytest.mark.parametrize("ground", ["type: box, xyz: [0, 0, -0.05], size: [1.5, 1.5, 0.1]",
                                    "type: half_space, normal: [0, 0, 1], offset: 0"])  # fmt: skip
def test_an_arm_may_stand_on_a_table(tmp_path, ground):
    """Flush with its base, which is the most common of scenes; its shoulder is always closer than 5 cm to it."""
    (tmp_path / "table.yaml").write_text(f"obstacles: [{{name: ground, {ground}}}]\n")
    problem = load_problem("ur5", str(tmp_path / "table.yaml"))
    for q in (problem.robot.start, problem.robot.goal):
        assert problem.safety.least(q)[0] >= 0.0
    assert np.abs(problem.model.difference(problem.robot.start, problem.robot.goal)).max() > 0.5
    sunk = ground.replace("-0.05]", "-0.045]").replace("offset: 0", "offset: 0.005")
    (tmp_path / "sunk.yaml").write_text(f"obstacles: [{{name: ground, {sunk}}}]\n")
    with pytest.raises(InputError, match="contains the robot's base"):
        load_problem("ur5", str(tmp_path / "sunk.yaml"))


def test_a_key_without_a_value_is_refused(tmp_path):
    (tmp_path / "arm.yaml").write_text("urdf: ur5\nself_collision:\n")
    with pytest.raises(InputError, match="self_collision: nothing stands behind the colon"):
        load_robot(str(tmp_path / "arm.yaml"))


def test_a_derived_goal_gives_way_too(tmp_path):
    free = load_problem("ur3", "sphere")
    model, goal = free.model, free.robot.goal
    hand = free.safety.points.kinematics(model.evaluate(goal, np.zeros(6))).p[-1]
    ball = f"{{name: ball, type: sphere, center: {hand.round(3).tolist()}, radius: 0.05}}"
    (tmp_path / "ball.yaml").write_text(f"obstacles: [{ball}]\n")
    problem = load_problem("ur3", str(tmp_path / "ball.yaml"))
    assert problem.safety.least(goal)[0] < 0.0 < 0.05 <= problem.safety.least(problem.robot.goal)[0]
    assert np.linalg.norm(model.to_angles(problem.robot.goal) - model.to_angles(goal)) < 2.5  # rad, of six joints
    np.testing.assert_array_equal(problem.robot.start, free.robot.start)
    assert "the goal that suits most worlds violates" in problem.model.warnings[-1]
    given = f"urdf: ur3_robot\ngoal: {model.to_angles(goal).tolist()}\neffort: 50\n"
    (tmp_path / "given.yaml").write_text(given)
    kept = load_problem(str(tmp_path / "given.yaml"), str(tmp_path / "ball.yaml"))
    np.testing.assert_allclose(kept.robot.goal, goal)


@pytest.mark.parametrize(
    ("text", "values"),
    [("1, 2", [1.0, 2.0]), ("-1e-3", [-0.001]), ("1.5,-2,", [1.5, -2.0]), (None, None)],
)
def test_numbers_of_an_option(text, values):
    assert parse_vector(text, "--start") == values


def test_bad_numbers_of_an_option():
    assert message(parse_vector, "1,x", "--start") == "--start: expected numbers separated by commas, got '1,x'"


def test_a_number_that_no_robot_has_is_refused(files):
    """Beyond, products overflow and what is derived of it is not a number."""
    path = files(robot=changed(ROBOT, "5e-2", "1e300")) / "arm.yaml"
    assert "1e+300 is no quantity of a robot; the largest allowed is 1e+12" in message(load_robot, str(path))
    path = files(robot=ROBOT + "locked: {nothing: -2e12}\n") / "arm.yaml"
    assert message(load_robot, str(path)).startswith(f"{path}: locked.nothing: -2e+12 is no quantity")


def test_a_urdf_in_the_encoding_that_it_declares(files):
    text = ARM.replace("<robot", "<!-- Müller --><robot", 1)
    latin = '<?xml version="1.0" encoding="ISO-8859-1"?>\r\n' + text
    path = files(urdf="") / "arm.urdf"
    path.write_bytes(latin.encode("latin-1"))
    assert load_robot(str(path)).model.nv == 2
    for wrong in (text, *(latin.replace("ISO-8859-1", code) for code in ("no-such-code", "undefined", "punycode"))):
        path.write_bytes(wrong.encode("latin-1"))
        assert message(load_robot, str(path)) == (
            f"{path}: not a text file in UTF-8, nor in what its first line declares"
        )


@pytest.mark.parametrize("number", ["1e-3", "1E-3", "0.001", ".001", "1.e-3", "+1e-3"])
def test_every_way_to_write_a_number(files, number):
    folder = files(robot=changed(ROBOT, "5e-2", number))
    assert load_robot(str(folder / "arm.yaml")).body[0].radius == pytest.approx(1e-3)


# --------------------------------------------------------------------------------------------- fuzzing

FUZZ = settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
WORDS = ["nan", "inf", "-1", "0", "1e308", "1e999", "&a", "*a", "link", "joint", "revolute", "continuous", "prismatic",
         "fixed", "floating", "base", "fore"]  # fmt: skip
SNIPPETS = [*WORDS, "", "\x00", "\n", "é", "- ", ": ", "[", "{", "}", "<", "/>", '"', "'"]


@st.composite
def mutations(draw, text):
    """The text with a few stretches replaced, most often whole words or numbers."""
    for _ in range(draw(st.integers(1, 3))):
        words = [m.span() for m in re.finditer(r"[\w.+-]+", text)]
        cut = draw(st.integers(0, len(text)))
        span = draw(st.sampled_from(words)) if words and draw(st.booleans()) else (cut, cut + draw(st.integers(0, 20)))
        text = text[: span[0]] + draw(st.sampled_from(SNIPPETS) | st.text(max_size=3)) + text[span[1] :]
    return text.encode("utf-8", "replace")


def accepts_or_refuses(call, *arguments):
    """Whatever the input, either it works or an InputError of one line says why not."""
    try:
        call(*arguments)
    except InputError as error:
        assert "\n" not in str(error)
        assert str(error)


@FUZZ
@given(content=st.binary(max_size=200) | mutations(ROBOT) | st.text(max_size=100).map(lambda s: s.encode()))
def test_fuzzed_robot_specs(files, content):
    folder = files()
    (folder / "arm.yaml").write_bytes(content)
    accepts_or_refuses(load_robot, str(folder / "arm.yaml"))


@FUZZ
@given(content=st.binary(max_size=200) | mutations(WORLD))
def test_fuzzed_worlds(two_link, tmp_path, content):
    path = tmp_path / "world.yaml"
    path.write_bytes(content)

    def build():
        obstacles = load_spec(path, WorldSpec, "obstacle spec").obstacles
        SafetyFunction(two_link.model, two_link.robot.body, obstacles).least(two_link.robot.start)

    accepts_or_refuses(build)


@FUZZ
@given(content=st.binary(max_size=200) | mutations(ARM) | mutations(ARM))
def test_fuzzed_urdfs(files, content):
    folder = files()
    (folder / "arm.urdf").write_bytes(content)
    accepts_or_refuses(load_problem, str(folder / "arm.urdf"), str(folder / "world.yaml"))
