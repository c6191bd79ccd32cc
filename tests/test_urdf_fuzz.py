"""Mutated URDFs: each gives a model with finite, positive definite dynamics or an InputError of one sentence.

What might crash the interpreter runs in a process of its own.
"""

from __future__ import annotations

import copy
import os
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
facet normal 0 0 0 outer loop vertex 0 0 0 vertex 0.1 0 0 vertex 0 0.1 0 endloop endfacet
facet normal 0 0 0 outer loop vertex 0 0 0 vertex 0.1 0 0 vertex 0 0 0.1 endloop endfacet
facet normal 0 0 0 outer loop vertex 0 0 0 vertex 0 0.1 0 vertex 0 0 0.1 endloop endfacet
facet normal 0 0 0 outer loop vertex 0.1 0 0 vertex 0 0.1 0 vertex 0 0 0.1 endloop endfacet
endsolid t
"""
REAL = ["double_pendulum_continuous", "asr_twodof_description", "so101", "panda_collision"]
VALUES = ["nan", "inf", "-inf", "-1", "0", "1e308", "1e-308", "1e9", "-0.5", "", " ", "x", "0x10", "1_0", "١", "1 2 3",
          "0 0 0", "nan nan nan", "1e99 0 0", "base", "upper", "elbow", "universe", "fixed", "revolute", "floating",
          "a" * 5000, "'\"><&", "\u202e\U0001f916", "package://", "file:///dev/zero", "../../../etc/passwd", "/", "."]  # fmt: skip
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
