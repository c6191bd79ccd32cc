"""Mutated URDFs: each gives a model with finite, positive definite dynamics or an InputError of one sentence.

What might crash the interpreter runs in a process of its own.
"""

from __future__ import annotations

import copy
import os
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ppcbf_robots.derive import derive_domain
from ppcbf_robots.errors import InputError
from ppcbf_robots.meshes import MAX_BYTES, MAX_TRIANGLES, count_triangles, find_mesh, mesh_problem
from ppcbf_robots.problem import load_robot
from ppcbf_robots.resources import default_package_dirs, find_example
from ppcbf_robots.robot import RobotModel
from ppcbf_robots.specs import DomainSpec

INERTIA = '<inertia ixx="0.002" ixy="0" ixz="0.0001" iyy="0.002" iyz="0" izz="0.001"/>'
INERTIAL = f'<inertial><origin xyz="0.2 0 0" rpy="0 0 0.1"/><mass value="0.5"/>{INERTIA}</inertial>'
CYLINDER = '<collision><geometry><cylinder radius="0.02" length="0.3"/></geometry></collision>'
LIMIT = '<limit lower="-2" upper="2" effort="20" velocity="3"/>'
ARM = f"""<robot name="arm">
<link name="base"/><link name="upper">{INERTIAL}{CYLINDER}</link>
<link name="fore">{INERTIAL}<visual><geometry><mesh filename="fore.stl" scale="1 1 1"/></geometry></visual></link>
<link name="hand"><inertial><mass value="0.1"/>{INERTIA}</inertial></link><link name="slide">{INERTIAL}</link>
<joint name="pan" type="continuous"><parent link="base"/><child link="upper"/><axis xyz="0 0 1"/>
<limit effort="20" velocity="3"/></joint>
<joint name="elbow" type="revolute"><parent link="upper"/><child link="fore"/><origin xyz="0.4 0 0" rpy="0 0 0"/>
<axis xyz="0 1 0"/>{LIMIT}</joint>
<joint name="mount" type="fixed"><parent link="fore"/><child link="hand"/><origin xyz="0.4 0 0" rpy="0 0 0"/></joint>
<joint name="slider" type="prismatic"><parent link="hand"/><child link="slide"/><axis xyz="1 0 0"/>{LIMIT}
<mimic joint="elbow" multiplier="2" offset="0.1"/></joint>
</robot>"""
TETRAHEDRON = """solid t
facet normal 0 0 0 
outer loop
vertex 0 0 0
vertex 0.1 0 0
vertex 0 0.1 0
endloop
endfacet
facet normal 0 0 0 
outer loop
vertex 0 0 0
vertex 0.1 0 0
vertex 0 0 0.1
endloop
endfacet
facet normal 0 0 0 
outer loop
vertex 0 0 0
vertex 0 0.1 0
vertex 0 0 0.1
endloop
endfacet
facet normal 0 0 0 
outer loop
vertex 0.1 0 0
vertex 0 0.1 0
vertex 0 0 0.1
endloop
endfacet
endsolid t
"""
REAL = ["double_pendulum_continuous", "asr_twodof_description", "so101", "panda_collision"]
VALUES = ["nan", "inf", "-inf", "-1", "0", "1e308", "1e-308", "1e9", "-0.5", "", " ", "x", "0x10", "1_0", "١", "1 2 3",
          "0 0 0", "nan nan nan", "1e99 0 0", "base", "upper", "elbow", "universe", "fixed", "revolute", "floating",
          "a" * 5000, "'\"><&", "\u202e\U0001f916", "package://", "file:///dev/zero", "../etc/passwd"]  # fmt: skip
FUZZ = settings(max_examples=120, suppress_health_check=[HealthCheck.function_scoped_fixture])


def real(name: str) -> str:
    found = find_example({"asr_twodof_description": "TwoDofs"}.get(name, name))
    assert found is not None
    return found.read_text(encoding="utf-8").replace("package://", "package://elsewhere_")  # meshes take seconds


@st.composite
def mutants(draw: st.DrawFn) -> str:
    """A small arm, or a real one, with up to four elements or attributes deleted, doubled, moved or changed."""
    text = ARM if draw(st.booleans()) else real(draw(st.sampled_from(REAL)))
    root = ElementTree.fromstring(text)
    for _ in range(draw(st.integers(1, 4))):
        elements = [(parent, child) for parent in root.iter() for child in parent]
        if not elements:
            break
        parent, child = elements[draw(st.integers(0, len(elements) - 1))]
        match draw(st.sampled_from(["delete", "double", "move", "rename", "set", "set", "set", "set", "unset"])):
            case "delete":
                parent.remove(child)
            case "double":
                parent.append(copy.deepcopy(child))
            case "move":
                other = elements[draw(st.integers(0, len(elements) - 1))][1]
                if child not in list(other.iter()) and other not in list(child.iter()):
                    parent.remove(child)
                    other.append(child)
            case "rename":
                child.tag = draw(st.sampled_from(["link", "joint", "limit", "mass", "box", "mesh", "odd"]))
            case "unset" if child.attrib:
                del child.attrib[draw(st.sampled_from(sorted(child.attrib)))]
            case "set" if child.attrib:
                child.set(draw(st.sampled_from(sorted(child.attrib))), draw(st.sampled_from(VALUES)))
    return ElementTree.tostring(root, encoding="unicode")


def model_or_refusal(path: Path, **overrides: object) -> RobotModel | str:
    """A model whose dynamics hold over random states, or the one-line message that names the file."""
    try:
        model = RobotModel(path, default_package_dirs(path), **overrides)  # type: ignore[arg-type]
        domain = derive_domain(model, DomainSpec())
        model.check_mass_matrix(domain.sample_q(np.random.default_rng(0), 30))
    except InputError as error:
        text = str(error)
        assert text.startswith(f"{path}: ") and len(text) > len(f"{path}: ") + 15
        assert "\n" not in text
        return text
    rng = np.random.default_rng(1)
    for q, v in zip(model.from_angles(domain.sample_q(rng, 10)), domain.sample_v(rng, 10), strict=True):
        dyn = model.evaluate(q, v)
        assert all(np.all(np.isfinite(x)) for x in vars(dyn).values())
        np.linalg.cholesky(dyn.M)
        assert np.all(np.isfinite(model.acceleration(q, v, model.u_max)))
    for kind in (pin.GeometryType.VISUAL, pin.GeometryType.COLLISION):
        model.geometry(kind)
    return model


@FUZZ
@given(text=mutants())
def test_mutated_urdfs(tmp_path, text):
    path = tmp_path / "arm.urdf"
    path.write_text(text, encoding="utf-8")
    (tmp_path / "fore.stl").write_text(TETRAHEDRON)
    model_or_refusal(path, effort=10.0, velocity=2.0)


@pytest.mark.parametrize("old", ["0.5", "0.002", "0.0001", "-2", "20", "0 1 0", "0.4 0 0", '"2"', "0.02", "1 1 1"])
def test_every_absurd_value_in_every_kind_of_number(tmp_path, old):
    (tmp_path / "fore.stl").write_text(TETRAHEDRON)
    path = tmp_path / "arm.urdf"
    for value in VALUES:
        new = value.replace("&", "&amp;").replace("<", "&lt;").replace('"', "&quot;")
        assert old in ARM
        path.write_text(ARM.replace(old, f'"{new}"' if old.startswith('"') else new, 1), encoding="utf-8")
        model_or_refusal(path, effort=10.0, velocity=2.0)


def test_the_arm_itself_works(tmp_path):
    """Or the mutations would show nothing."""
    (tmp_path / "fore.stl").write_text(TETRAHEDRON)
    path = tmp_path / "arm.urdf"
    path.write_text(ARM)
    model = model_or_refusal(path)
    assert isinstance(model, RobotModel)
    assert model.joint_names == ["pan", "elbow"]
    assert model.locked == {"slider": 0.1}  # twice the elbow's 0 and 0.1
    assert [len(model.geometry(k).geometryObjects) for k in (pin.VISUAL, pin.COLLISION)] == [1, 1]


def chain(links: int, moving: int) -> str:
    kinds = ["revolute"] * moving + ["fixed"] * (links - 1 - moving)
    parts = [f'<link name="l{i}">{INERTIAL}</link>' for i in range(links)] + [
        f'<joint name="j{i}" type="{kind}"><parent link="l{i}"/><child link="l{i + 1}"/>'
        f'<origin xyz="0 0 0.1"/><axis xyz="0 1 0"/>{LIMIT}</joint>'
        for i, kind in enumerate(kinds)
    ]
    return f'<robot name="chain">{"".join(parts)}</robot>'


DEEP = "<x>" * 200_000 + "</x>" * 200_000
NODES = '<COLLADA><library_visual_scenes><visual_scene id="s">' + '<node id="n">' * 100_000
NODES += "</node>" * 100_000 + "</visual_scene></library_visual_scenes></COLLADA>"
PLY = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
PLY += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
PLY += "0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 2 1000000\n"
CRASHERS = {
    "20,000 links": (chain(20_000, 3), "20000 links; at most 1000 are read"),
    "1,000 moving joints": (chain(1000, 999), "999 joints move, at most 8 can; write a robot spec with this `urdf` "),
    "1,000 links, most of them fixed": (chain(1000, 3), None),
    "deep nesting": (ARM.replace("</robot>", DEEP + "</robot>"), None),
    "deep nesting in a link": (ARM.replace("</link>", DEEP + "</link>", 1), None),
    "zeros": ("\0" * 1000, "not valid XML ("),
    "garbage": (bytes(range(128)).decode() * 100, "not valid XML ("),
    "a joint that is its own mimic": (ARM.replace('joint="elbow"', 'joint="slider"'), None),
    "nested Collada nodes": (ARM.replace("fore.stl", "nodes.dae"), None),
    "a device for a mesh": (ARM.replace("fore.stl", "/dev/zero"), None),
    "a pipe for a mesh": (ARM.replace("fore.stl", "pipe.stl"), None),
    "a huge mesh": (ARM.replace("fore.stl", "huge.stl"), None),
    "a mesh of noise": (ARM.replace("fore.stl", "noise.dae"), None),
    "a mesh of faces without vertices": (ARM.replace("fore.stl", "bad.ply"), None),
    "a mesh that is a folder": (ARM.replace("fore.stl", "folder.stl"), None),
}
RUN = """
import sys
sys.path.insert(0, sys.argv[1])
from pathlib import Path
from test_urdf_fuzz import model_or_refusal
for path in sys.argv[2:]:
    found = model_or_refusal(Path(path))
    print(found if isinstance(found, str) else "model; " + "; ".join(found.warnings), flush=True)
"""


def test_what_might_crash_the_interpreter(tmp_path):
    for name, content in (("nodes.dae", NODES), ("noise.dae", "<COLLADA>\x01\x02"), ("fore.stl", TETRAHEDRON)):
        (tmp_path / name).write_text(content)
    (tmp_path / "bad.ply").write_text(PLY)
    os.mkfifo(tmp_path / "pipe.stl")
    (tmp_path / "folder.stl").mkdir()
    with (tmp_path / "huge.stl").open("wb") as file:
        file.truncate(10 * MAX_BYTES)  # sparse
    paths = [tmp_path / f"arm{i}.urdf" for i in range(len(CRASHERS))]
    for path, (text, _) in zip(paths, CRASHERS.values(), strict=True):
        path.write_text(text, encoding="utf-8")
    before = sorted(tmp_path.iterdir())
    command = [sys.executable, "-c", RUN, str(Path(__file__).parent), *map(str, paths)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    said = dict(zip(CRASHERS, done.stdout.splitlines(), strict=False))
    assert done.returncode == 0, (list(said)[-1:], done.stderr[-500:])
    for (name, (_, refusal)), path in zip(CRASHERS.items(), paths, strict=True):
        assert said[name].startswith("model; " if refusal is None else f"{path}: {refusal}"), said[name]
    assert "'nodes.dae' has 100000 nodes, more than 1000; merge them" in said["nested Collada nodes"]
    assert "'bad.ply' has an unknown format" in said["a mesh of faces without vertices"]
    assert "'huge.stl' is larger than 50 MB; simplify it" in said["a huge mesh"]
    assert "'noise.dae' cannot be read" in said["a mesh of noise"]
    for name in ("a pipe for a mesh", "a mesh that is a folder", "a device for a mesh"):
        assert "is not there" in said[name]
    assert sorted(tmp_path.iterdir()) == before


# ------------------------------------------------------------------------------------- wild, but usable


def written(folder: Path, text: str) -> Path:
    path = folder / "arm.urdf"
    path.write_text(text, encoding="utf-8")
    (folder / "fore.stl").write_text(TETRAHEDRON)
    return path


def test_joints_without_limits_take_the_specs(tmp_path):
    path = written(tmp_path, ARM.replace(LIMIT, "", 1))
    text = model_or_refusal(path)
    assert text == (
        f"{path}: joint 'elbow' has no usable effort and velocity limit (got 0); give them in a robot spec, "
        "e.g. `effort: {elbow: 10.0}` and `velocity: {elbow: 2.0}`, or lock the joint"
    )
    model = RobotModel(path, effort={"elbow": 7.0}, velocity={"elbow": 1.5})
    np.testing.assert_array_equal(model.u_max, [20.0, 7.0])
    np.testing.assert_array_equal(model.q_upper, [np.inf, np.inf])
    np.testing.assert_allclose(derive_domain(model, DomainSpec()).q[1], [-np.pi, np.pi])
    assert "joint 'elbow' has no position limits: taken to turn freely, half a turn either way in X" in model.warnings
    bounded = RobotModel(path, effort=7.0, velocity=1.5, position={"elbow": (-1.0, 2.0)})
    assert (bounded.q_lower[1], bounded.q_upper[1]) == (-1.0, 2.0)
    whole = RobotModel(written(tmp_path, ARM))
    q, v = whole.from_angles(np.array([0.3, 0.4])), np.array([0.5, -0.6])
    np.testing.assert_array_equal(model.evaluate(q, v).M, whole.evaluate(q, v).M)


def test_position_limits_that_do_not_fit(tmp_path):
    path = written(tmp_path, ARM.replace('<mimic joint="elbow" multiplier="2" offset="0.1"/>', ""))
    bare = written(tmp_path, path.read_text().replace('xyz="1 0 0"/>' + LIMIT, 'xyz="1 0 0"/>'))
    for overrides, expected in (
        ({}, "joint 'slider' has no position range; give one in a robot spec, e.g. `position: {slider: [0.0, 0.5]}`, "
         "or lock the joint"),
        ({"position": {"pan": (0.0, 1.0)}}, "position: joint 'pan' is continuous and has no limits; remove them"),
        ({"position": {"wrist": (0.0, 1.0)}},
         "position: no moving joint is named 'wrist' (moving joints: pan, elbow, slider)"),
    ):  # fmt: skip
        assert model_or_refusal(bare, effort=9.0, velocity=1.0, **overrides) == f"{bare}: {expected}"
    assert isinstance(
        model_or_refusal(bare, effort=9.0, velocity=1.0, position={"slider": (0.0, 0.3)}), RobotModel
    )  # fmt: skip


def test_one_sided_limits_leave_a_domain_of_one_turn(tmp_path):
    model = RobotModel(written(tmp_path, ARM.replace('lower="-2" upper="2"', 'lower="4" upper="1e308"', 1)))
    np.testing.assert_allclose(derive_domain(model, DomainSpec()).q[1], [4.0, 4.0 + 2.0 * np.pi])


def test_mimics_stand_where_their_locked_joint_puts_them(tmp_path):
    model = RobotModel(written(tmp_path, ARM), locked={"elbow": 0.3})
    assert model.locked == {"elbow": 0.3, "slider": pytest.approx(0.7)}
    assert RobotModel(model.urdf, moving=["pan", "slider"]).joint_names == ["pan", "slider"]  # by the user's will


def test_axes_of_any_length_turn_alike(tmp_path):
    q, v = np.array([1.0, 0.0, 0.7]), np.array([0.3, -0.2])
    unit, long = (RobotModel(written(tmp_path, ARM.replace("0 1 0", axis))) for axis in ("0 0.6 0.8", "0 6 8"))
    for a, b in zip(vars(unit.evaluate(q, v)).values(), vars(long.evaluate(q, v)).values(), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-12)


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("0.4 0 0", "400 0 0", "joint 'elbow', origin xyz: 400 is more than 100, which no arm has; check the units"),
        ('value="0.5"', 'value="1e9"',
         "link 'upper', mass: 1e+09 is more than 1e+06, which no arm has; check the units"),
        ('name="elbow"', 'name=" "', "a <joint> has no name; give it one"),
        ('link name="hand"', 'link name="fore"', "2 links are named 'fore'; give each its own name"),
        ('type="continuous"', 'type="screw"',
         "joint 'pan' has the type 'screw'; write revolute, continuous, prismatic or fixed"),
        ('lower="-2" upper="2"', 'lower="1"',
         "joint 'elbow': lower limit 1.0 is above upper limit 0.0; a missing one counts as 0, so give both"),
        ('radius="0.02"', 'radius="-1"', "link 'upper', cylinder radius: -1.0 is negative; correct it"),
    ],
)  # fmt: skip
def test_messages(tmp_path, old, new, expected):
    path = written(tmp_path, ARM.replace(old, new, 1))
    assert model_or_refusal(path) == f"{path}: {expected}"


def test_a_small_fixed_link_with_odd_products_of_inertia_passes_but_not_a_moving_one(tmp_path):
    tiny = INERTIA.replace("0.002", "1e-7").replace("0.0001", "2e-7").replace('izz="0.001"', 'izz="1e-7"')
    hand = f'<link name="hand"><inertial><mass value="0.1"/>{INERTIA}'
    assert isinstance(model_or_refusal(written(tmp_path, ARM.replace(hand, hand.replace(INERTIA, tiny)))), RobotModel)
    text = model_or_refusal(written(tmp_path, ARM.replace('ixz="0.0001"', 'ixz="0.1"', 1)))
    assert "the link moved by joint 'pan' has an inertia with the negative eigenvalue -0.0985" in str(text)


@pytest.mark.parametrize("name", ["package://arm/fore.stl", "package://other/fore.stl", "fore.stl", "./fore.stl",
                                  "sub/../fore.stl", "{folder}/fore.stl", "file://{folder}/fore.stl"])  # fmt: skip
def test_meshes_are_found(tmp_path, name):
    folder = tmp_path / "arm"
    (folder / "sub").mkdir(parents=True)
    path = written(folder, ARM.replace("fore.stl", name.format(folder=folder)))
    model = RobotModel(path, default_package_dirs(path))
    assert [len(o.geometry.vertices()) for o in model.geometry(pin.GeometryType.VISUAL).geometryObjects] == [4]
    assert model.warnings == ["joint 'slider' mimics another joint and was locked at 0.1"]


@pytest.mark.parametrize("shape", ['<capsule radius="0.05" length="0.3"/>', '<ellipsoid radius="0.1 0.1 0.2"/>'])
def test_a_shape_that_urdf_does_not_know_takes_the_others_of_its_link_along(tmp_path, shape):
    upper = f'<link name="upper">{INERTIAL}{CYLINDER}'
    more = f"<collision><geometry>{shape}</geometry></collision>"
    robot = load_robot(str(written(tmp_path, ARM.replace(upper, upper + more))))
    tag = re.findall(r"<\w+", shape)[0] + ">"
    said = f"link 'upper': its collision geometry was left out, since {tag} is no shape of URDF"
    assert said in robot.model.warnings
    assert not robot.model.geometry(pin.GeometryType.COLLISION).geometryObjects  # half of a link is not the link


def test_missing_meshes_leave_the_dynamics_and_the_other_links(tmp_path):
    mesh = '<collision><geometry><mesh filename="package://nowhere/a.stl"/></geometry></collision>'
    upper = f'<link name="upper">{INERTIAL}{CYLINDER}'
    path = written(tmp_path, ARM.replace(upper, upper + mesh))
    robot = load_robot(str(path))
    assert (
        "link 'upper' lacks collision geometry: the mesh 'package://nowhere/a.stl' is not there"
        in robot.model.warnings
    )  # fmt: skip
    assert not robot.model.geometry(pin.GeometryType.COLLISION).geometryObjects  # half of a link is not the link
    assert len(robot.model.geometry(pin.GeometryType.VISUAL).geometryObjects) == 1
    assert {s.frame for s in robot.body} <= {"upper", "fore", "hand"}
    assert robot.body


def test_triangles_are_counted_before_loading(tmp_path):
    binary = bytes(80) + (3).to_bytes(4, "little") + bytes(150)
    polylist = b"<mesh><triangles material='a' count=\"7\"></triangles><polylist count='5'/></mesh>"
    for suffix, content, count in ((".stl", TETRAHEDRON.encode(), 4), (".stl", binary, 3),
                                   (".obj", b"v 0 0 0\nf 1 2 3\nf 1 2 3\n", 2), (".dae", polylist, 12)):  # fmt: skip
        assert count_triangles(suffix, content) == count
    many = tmp_path / "many.dae"
    many.write_bytes(b"<mesh><triangles count='999999999999'/></mesh>")
    assert mesh_problem(many) == f"has 999999999999 triangles, more than {MAX_TRIANGLES}; simplify it"
    many.write_bytes(b"<c:node/>" * 1001)
    assert mesh_problem(many) == "has 1001 nodes, more than 1000; merge them"
    assert "unknown format" in mesh_problem(tmp_path / "a.ply")  # its reader takes faces of vertices that are not there
    assert "unknown format" in mesh_problem(tmp_path / "a.blend")
    assert find_mesh("a" * 5000, tmp_path / "arm.urdf", []) is None
