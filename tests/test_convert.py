"""Worlds written as YAML, and the command that does it."""

from __future__ import annotations

import contextlib
import io
import json
import re
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from ppcbf_robots.cli.main import main
from ppcbf_robots.resources import find_world
from ppcbf_robots.world import Obstacle, WorldSpec
from ppcbf_robots.world_files.load import load_world
from ppcbf_robots.world_files.write import world_yaml

DATA = Path(__file__).parent / "data" / "worlds"
SAMPLES = sorted(p.name for p in DATA.glob("*.*"))


def reread(world: WorldSpec) -> WorldSpec:
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "w.yaml"
        path.write_text(world_yaml(world, "title\nwith: 'signs'\x00"), encoding="utf-8")
        return load_world(path)


def same(got: Obstacle, expected: Obstacle) -> None:
    """Equal types, names and numbers up to what is written."""
    assert (got.type, got.name) == (expected.type, expected.name)
    for key, value in expected.model_dump(exclude={"name", "type"}).items():
        if value is None:
            assert getattr(got, key) is None
        else:
            np.testing.assert_allclose(getattr(got, key), value, rtol=1e-6 if key == "vertices" else 1e-8)


@pytest.mark.parametrize("name", SAMPLES)
def test_a_written_world_is_the_same_world(name: str) -> None:
    world = load_world(DATA / name)
    again = reread(world)
    for a, b in zip(again.obstacles, world.obstacles, strict=True):
        same(a, b)
    assert world_yaml(reread(again), "x") == world_yaml(again, "x")
    assert not re.search(r"[0-9]e[-+]?[0-9]", world_yaml(world, "x")), "a number that PyYAML reads as text"


NAMES = st.text(min_size=1, max_size=12) | st.sampled_from(["true", "null", "~", "1e3", "- a", "a: b", "#", "\ud7ff"])
COORDINATES = st.lists(st.floats(-1e4, 1e4), min_size=3, max_size=3)
SIZES = st.floats(1e-6, 1e3)


@st.composite
def worlds(draw: st.DrawFn) -> WorldSpec:
    names = draw(st.lists(NAMES, min_size=1, max_size=4, unique=True))
    found: list[dict[str, Any]] = []
    for name in names:
        pose = {"xyz": draw(COORDINATES), "rpy": draw(st.none() | COORDINATES)}
        radius, length = draw(SIZES), draw(SIZES)
        found.append(
            draw(
                st.sampled_from(
                    [
                        {"type": "sphere", "center": draw(COORDINATES), "radius": radius},
                        {"type": "box", "size": [radius, length, 1.0], **pose},
                        {"type": "capsule", "radius": radius, "length": length, **pose},
                        {"type": "cylinder", "radius": radius, "length": length, **pose},
                    ]
                )
            )
            | {"name": name, "margin": draw(st.sampled_from([0.0, 0.01, 1e-7]))}
        )
    return WorldSpec.model_validate({"obstacles": found})


@given(worlds())
@settings(max_examples=60, deadline=None)
def test_any_world_survives_writing(world: WorldSpec) -> None:
    again = reread(world)
    for a, b in zip(again.obstacles, world.obstacles, strict=True):
        same(a, b)
    text = world_yaml(world, "t")
    assert [o["name"] for o in yaml.safe_load(text)["obstacles"]] == [o.name for o in world.obstacles]


# The command


def convert(*arguments: object) -> tuple[int, str, str]:
    """Exit code, stdout and stderr of ``ppcbf convert``."""
    out, err = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        patch.setattr(sys, "argv", ["ppcbf", "convert", *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            main()
    return int(end.value.code or 0), out.getvalue(), err.getvalue()


def test_convert_writes_and_says_what(tmp_path: Path) -> None:
    target = tmp_path / "deep" / "cell.yaml"
    code, said, notes = convert(DATA / "cell.urdf", target)
    assert (code, said.splitlines()[0]) == (0, f"{DATA / 'cell.urdf'}: URDF")
    assert said.endswith(f"wrote {target} (4 obstacles)\n")
    assert notes.splitlines() == [
        "note: 'wedge' is a mesh: its convex hull is taken, which fills what is hollow",
        "note: link 'camera' is left out: it has visual geometry, but none for collisions",
    ]
    assert target.read_text().startswith(
        "# Converted from cell.urdf (URDF).\n# Metres and radians, in the robot's base frame.\nobstacles:\n"
        "  - {name: table, type: box, xyz: [0.8, 0.0, -0.075], quat_xyzw: [0.0, 0.0, 0.707106781, 0.707106781], "
        "size: [1.2, 0.8, 0.05]}\n"
    )
    for got, expected in zip(load_world(target).obstacles, load_world(DATA / "cell.urdf").obstacles, strict=True):
        same(got, expected)


def test_convert_for_programs(tmp_path: Path) -> None:
    target = tmp_path / "w.yaml"
    code, said, notes = convert(DATA / "motion_bench_maker.yaml", target, "--json")
    assert (code, notes) == (0, "")
    assert json.loads(said) == {
        "format": "MoveIt YAML", "obstacles": {"box": 1, "cylinder": 1}, "notes": [], "out": str(target),
    }  # fmt: skip


def test_convert_does_not_overwrite_unasked(tmp_path: Path) -> None:
    target = tmp_path / "w.yaml"
    target.write_text("mine")
    code, said, err = convert("pillar", target)
    assert (code, said, err) == (2, "", f"error: {target} exists; give --force to overwrite it\n")
    assert target.read_text() == "mine"
    assert convert("pillar", target, "--force")[0] == 0
    assert load_world(target) == load_world(find_world("pillar"))


def test_convert_refuses_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "bad.scene").write_text("s\n* a\nmany\n")
    for arguments, expected in (
        (("pillar", tmp_path / "w.json"),
         f"{tmp_path / 'w.json'}: a world is written as YAML; give a name that ends in .yaml"),
        ((tmp_path / "bad.scene", tmp_path / "w.yaml"),
         f"{tmp_path / 'bad.scene'}: line 3: expected a number of shapes, at most 10000, got 'many'"),
        (("pillar", tmp_path / "bad.scene" / "w.yaml"),
         f"{tmp_path / 'bad.scene' / 'w.yaml'}: cannot be written (File exists)"),
    ):  # fmt: skip
        assert convert(*arguments) == (2, "", f"error: {expected}\n")
    assert not (tmp_path / "w.yaml").exists()
