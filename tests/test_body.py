"""Body spheres contain the geometry they stand for; every claim is checked by other means than the fit's own."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import coal
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from ppcbf_robots import body_cache, body_fit, derive_body
from ppcbf_robots.body import body_spheres
from ppcbf_robots.body_geometry import UnknownShapeError, pieces_of
from ppcbf_robots.errors import InputError
from ppcbf_robots.problem import Robot, load_problem, load_robot
from ppcbf_robots.specs import Array, BodyPrimitive, BodySphere

PANDA = "urdf: panda\nlocked: {panda_finger_joint1: 0.02, panda_finger_joint2: 0.02}\n"
ARMS = ["panda", "panda_collision", "ur5", "kinova", "talos_left_arm"]
OTHERS = [
    "ur3",
    "ur10",
    "z1",
    "xarm7",
    "so100",
    "so101",
    "double_pendulum",
    "asr_twodof",
    "tiago_no_hand",
    "baxter_left",
]
FEW = settings(max_examples=8, phases=[Phase.explicit, Phase.generate])  # a fit takes a second: no shrinking
SIZE = st.floats(0.01, 0.4)


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Robot]:
    """Robots by name with a fitted body; the bundled Panda's own body is left away."""
    spec = tmp_path_factory.mktemp("specs") / "panda.yaml"
    spec.write_text(PANDA)
    return lambda name: load_robot(str(spec) if name == "panda" else name)


def shape(geometry: coal.CollisionGeometry, placement: pin.SE3 | None = None) -> pin.GeometryObject:
    return pin.GeometryObject("shape", 1, placement or pin.SE3.Identity(), geometry)


def mesh(vertices: Array, faces: Array) -> coal.BVHModelOBBRSS:
    """A triangle mesh for coal."""
    model = coal.BVHModelOBBRSS()
    model.beginModel(len(faces), len(vertices))
    points = coal.StdVec_Vec3s()
    points.extend([np.asarray(v, float) for v in vertices])
    triangles = coal.StdVec_Triangle()
    triangles.extend([coal.Triangle(*(int(i) for i in f)) for f in faces])
    model.addSubModel(points, triangles)
    model.endModel()
    return model


def placed(triangles: Array, placement: pin.SE3) -> Array:
    return triangles @ placement.rotation.T + placement.translation


def triangles_of(geometry: coal.CollisionGeometry) -> Array:
    """(N, 3, 3) of a mesh or a box, by coal's own triangles."""
    if isinstance(geometry, coal.Box):
        corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * geometry.halfSide
        return corners[ConvexHull(corners).simplices]
    found = [geometry.tri_indices(i) for i in range(geometry.num_tris)]
    return np.asarray(geometry.vertices())[np.array([[t[0], t[1], t[2]] for t in found])]


def samples_of(geometry: coal.CollisionGeometry, rng: np.random.Generator, count: int = 4000) -> Array:
    """(count, 3) random points on a sphere, capsule or cylinder."""
    turn, z = rng.uniform(0.0, 2.0 * np.pi, count), rng.uniform(-1.0, 1.0, count)
    ring = np.stack([np.cos(turn), np.sin(turn), 0.0 * turn], axis=1)
    up = np.array([0.0, 0.0, 1.0])
    ball = np.sqrt(1.0 - z**2)[:, None] * ring + z[:, None] * up
    if isinstance(geometry, coal.Sphere):
        return geometry.radius * ball
    side = geometry.radius * ring + geometry.halfLength * z[:, None] * up
    sign = np.sign(z)[:, None]
    if isinstance(geometry, coal.Capsule):
        return np.concatenate([side, geometry.radius * ball + geometry.halfLength * sign * up])
    disc = geometry.radius * np.sqrt(rng.uniform(0.0, 1.0, count))[:, None] * ring
    return np.concatenate([side, disc + geometry.halfLength * sign * up])


def uncovered(triangles: Array, centers: Array, radii: Array) -> Array:
    """What is not covered of triangles (N, 3, 3): they are halved until each part lies in one ball.

    Parts with a corner outside all balls, or still in no ball at a micrometre, are returned.
    """
    while len(triangles):
        inside = np.linalg.norm(triangles[:, :, None] - centers, axis=3) <= radii + 1e-6  # (N, 3, balls)
        if not inside.any(axis=2).all():
            return triangles[~inside.any(axis=2).all(axis=1)]
        triangles = triangles[~inside.all(axis=1).any(axis=1)]
        edges = np.linalg.norm(triangles - np.roll(triangles, -1, axis=1), axis=2)
        if np.any(edges.max(axis=1, initial=0.0) < 1e-6):
            return triangles
        order = (edges.argmax(axis=1)[:, None] + np.arange(3)) % 3
        a, b, c = np.moveaxis(np.take_along_axis(triangles, order[:, :, None], axis=1), 1, 0)
        triangles = np.concatenate([np.stack([a, (a + b) / 2, c], 1), np.stack([(a + b) / 2, b, c], 1)])
    return triangles


def gap(points: Array, centers: Array, radii: Array) -> float:
    """How far the farthest point sticks out of the union of balls; negative inside."""
    return float((np.linalg.norm(points[:, None] - centers, axis=2) - radii).min(axis=1).max())


def assert_contains(geometry: coal.CollisionGeometry, placement: pin.SE3, centers: Array, radii: Array) -> None:
    """All of the shape's surface lies in the union of the balls, all in one frame."""
    if isinstance(geometry, coal.Sphere | coal.Capsule | coal.Cylinder):
        points = samples_of(geometry, np.random.default_rng(0))
        assert gap(placed(points, placement), centers, radii) <= 1e-7
    else:
        assert not len(uncovered(placed(triangles_of(geometry), placement), centers, radii))


def balls_in_joint(robot: Robot, spheres: list[BodySphere]) -> tuple[Array, Array]:
    points = robot.model.points([s.frame for s in spheres], np.array([s.center for s in spheres]))
    assert len(set(points.joints)) == 1
    return points.offsets[:, :3], np.array([s.radius for s in spheres])


def links(robot: Robot) -> dict[int, derive_body.LinkCover]:
    assert robot.cover is not None
    joints = [robot.model.points([x.link], np.zeros((1, 3))).joints[0] for x in robot.cover.links]
    return dict(zip(map(int, joints), robot.cover.links, strict=True))


# Real arms


@pytest.mark.slow
@pytest.mark.parametrize("name", [*ARMS, *OTHERS])
def test_every_moving_link_is_contained(name, arm):
    robot = arm(name)
    covers = links(robot)
    shapes, visual = (
        [o for o in robot.model.geometry(kind).geometryObjects if o.parentJoint]
        for kind in (pin.GeometryType.COLLISION, pin.GeometryType.VISUAL)
    )
    collides = {int(o.parentJoint) for o in shapes}
    shapes += [o for o in visual if int(o.parentJoint) not in collides]
    for o in shapes:
        cover = covers[int(o.parentJoint)]
        assert_contains(o.geometry, o.placement, *balls_in_joint(robot, cover.spheres + cover.left_out))
    checked = {int(o.parentJoint) for o in shapes}
    assert checked == set(range(1, robot.model.model.njoints))
    assert robot.body == [s for cover in covers.values() for s in cover.spheres]
    assert "body" in robot.derived


@pytest.mark.slow
@pytest.mark.parametrize("name", ARMS)
def test_few_spheres_stay_close(name, arm):
    robot = arm(name)
    assert 12 <= len(robot.body) <= 30
    assert robot.cover is not None and robot.cover.largest < 0.055
    assert robot.cover.mean < 0.0185


@pytest.mark.parametrize("name", ["ur5", "panda_collision"])
def test_overestimate_against_coal(name, arm):
    """Points on the outside of the union, drawn at random, and coal's distance from there to the shapes."""
    robot, rng = arm(name), np.random.default_rng(0)
    shapes = robot.model.geometry(pin.GeometryType.COLLISION).geometryObjects
    for joint, cover in links(robot).items():
        centers, radii = balls_in_joint(robot, cover.spheres + cover.left_out)
        pick = rng.choice(len(radii), 400, p=radii**2 / (radii**2).sum())
        way = rng.normal(size=(400, 3))
        points = centers[pick] + radii[pick, None] * way / np.linalg.norm(way, axis=1)[:, None]
        inside = np.linalg.norm(points[:, None] - centers, axis=2) < radii - 1e-9
        points = points[~inside.any(axis=1)]
        found = [min(coal_distance(o, p) for o in shapes if o.parentJoint == joint) for p in points]
        assert max(found) <= cover.largest + 1e-3, cover.link
        assert max(found) >= 0.8 * cover.largest - 1e-3, cover.link
        assert np.mean(found) == pytest.approx(cover.mean, abs=2.5e-3), cover.link


def coal_distance(o: pin.GeometryObject, point: Array) -> float:
    pose = coal.Transform3s(o.placement.rotation, o.placement.translation)
    ball = coal.Sphere(1e-9), coal.Transform3s(np.eye(3), point)
    return coal.distance(o.geometry, pose, *ball, coal.DistanceRequest(), coal.DistanceResult())


# Single shapes


def fitted(*shapes: pin.GeometryObject) -> body_fit.Fit:
    return body_fit.fit(body_fit.Surface(pieces_of(shapes)))


POSES = st.builds(
    lambda rpy, p: pin.SE3(pin.rpy.rpyToMatrix(np.array(rpy)), np.array(p)),
    st.tuples(*[st.floats(-3.0, 3.0)] * 3),
    st.tuples(*[st.floats(-0.5, 0.5)] * 3),
)
ROUND_OR_BOX = st.one_of(
    st.builds(coal.Box, SIZE, SIZE, SIZE),
    st.builds(coal.Cylinder, st.floats(0.01, 0.15), SIZE),
    st.builds(coal.Capsule, st.floats(0.01, 0.15), SIZE),
    st.builds(coal.Sphere, SIZE),
)


@given(geometry=ROUND_OR_BOX, pose=POSES)
@FEW
def test_primitives_are_contained(geometry, pose):
    fit = fitted(shape(geometry, pose))
    assert_contains(geometry, pose, fit.balls.centers, fit.balls.radii)


@given(seed=st.integers(0, 2**32 - 1), stretch=st.tuples(SIZE, SIZE, SIZE), corners=st.integers(4, 40))
@FEW
def test_random_convex_meshes_are_contained(seed, stretch, corners):
    points = np.random.default_rng(seed).normal(size=(corners, 3)) * 0.3 * np.array(stretch)
    geometry = mesh(points, ConvexHull(points).simplices)
    fit = fitted(shape(geometry))
    assert_contains(geometry, pin.SE3.Identity(), fit.balls.centers, fit.balls.radii)


def test_several_shapes_of_a_link_are_contained_together():
    pose = pin.SE3(pin.rpy.rpyToMatrix(0.3, 0.5, -1.0), np.array([0.2, 0.0, 0.1]))
    shapes = [shape(coal.Box(0.1, 0.2, 0.05)), shape(coal.Cylinder(0.05, 0.3), pose), shape(coal.Sphere(0.06), pose)]
    fit = fitted(*shapes)
    for o in shapes:
        assert_contains(o.geometry, o.placement, fit.balls.centers, fit.balls.radii)


def test_a_sphere_is_itself():
    fit = fitted(shape(coal.Sphere(0.07), pin.SE3(np.eye(3), np.array([0.1, -0.2, 0.3]))))
    np.testing.assert_allclose(fit.balls.centers, [[0.1, -0.2, 0.3]], atol=1e-9)
    assert 0.07 <= fit.balls.radii[0] <= 0.0702
    assert fit.overestimate.largest <= 2e-4


def test_overestimate_of_a_ball_around_a_box():
    """The circumscribed ball of a cube of edge 2a lies (√3 - 1) a from the middle of a face, at most."""
    surface = body_fit.Surface(pieces_of([shape(coal.Box(0.08, 0.08, 0.08))]))
    fit = body_fit.refitted(surface, np.zeros((1, 3)), np.zeros(1))
    assert fit.balls.radii[0] == pytest.approx(3**0.5 * 0.04, abs=1.1e-4)
    assert fit.overestimate.largest == pytest.approx((3**0.5 - 1.0) * 0.04, abs=2e-3)
    assert fit.overestimate.area == pytest.approx(4.0 * np.pi * 3.0 * 0.04**2, rel=0.02)


def test_the_fit_is_repeatable():
    first, second = (fitted(shape(coal.Box(0.3, 0.1, 0.05))) for _ in range(2))
    np.testing.assert_array_equal(first.balls.centers, second.balls.centers)
    np.testing.assert_array_equal(first.balls.radii, second.balls.radii)


@pytest.mark.filterwarnings("ignore:overflow", "ignore:invalid value")
@pytest.mark.parametrize("bad", [coal.Cone(0.1, 0.2), mesh(np.full((3, 3), np.nan), [[0, 1, 2]])])
def test_what_has_no_usable_triangles_is_refused(bad):
    with pytest.raises(UnknownShapeError):
        pieces_of([shape(bad)])


@settings(max_examples=50)
@given(
    ends=st.tuples(*[st.floats(-0.5, 0.5)] * 6), radius=st.floats(0.0, 0.2), seed=st.integers(0, 2**32 - 1)
)  # fmt: skip
def test_the_spheres_of_a_capsule_contain_it(ends, radius, seed):
    a, b = np.array(ends[:3]), np.array(ends[3:])
    spheres = body_spheres([BodyPrimitive(frame="link", center=list(a), to=list(b), radius=radius)])
    rng = np.random.default_rng(seed)
    way = rng.normal(size=(500, 3))
    points = a + rng.uniform(0.0, 1.0, (500, 1)) * (b - a) + radius * way / np.linalg.norm(way, axis=1)[:, None]
    assert gap(points, np.array([s.center for s in spheres]), np.array([s.radius for s in spheres])) <= 1e-9


# From a URDF


def urdf(folder: Path, upper: str, fore: str, kind: str = "collision", base: str = "") -> str:
    """Path of an arm of two links; its joints turn about z and x, 0.3 m apart."""
    tensor = '<inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/>'
    inertial = f'<inertial><origin xyz="0 0 0.15"/><mass value="1"/>{tensor}</inertial>'
    limit = '<limit lower="-2" upper="2" effort="40" velocity="2"/>'
    shapes = {"base": base, "upper": upper, "fore": fore}
    text = '<robot name="arm">' + "".join(
        f'<link name="{n}">{inertial}{f"<{kind}>{s}</{kind}>" if s else ""}</link>' for n, s in shapes.items()
    )
    for name, parent, child, axis, height in (
        ("j1", "base", "upper", "0 0 1", 0),
        ("j2", "upper", "fore", "1 0 0", 0.3),
    ):
        text += f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>'
        text += f'<origin xyz="0 0 {height}"/><axis xyz="{axis}"/>{limit}</joint>'
    path = folder / "arm.urdf"
    path.write_text(text + "</robot>")
    return str(path)


def box(x: float, y: float, z: float, at: str = "0 0 0.15") -> str:
    return f'<origin xyz="{at}"/><geometry><box size="{x} {y} {z}"/></geometry>'


MESH = '<geometry><mesh filename="{}"/></geometry>'
TETRAHEDRON = "v 0 0 0\nv {0} 0 0\nv 0 {0} 0\nv 0 0 {0}\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"


def test_what_is_fixed_to_the_base_is_no_part_of_the_body(tmp_path):
    robot = load_robot(urdf(tmp_path, box(0.1, 0.1, 0.1), box(0.1, 0.1, 0.1), base=box(2.0, 2.0, 2.0)))
    assert max(s.radius for s in robot.body) < 0.15
    assert {s.frame for s in robot.body} <= {"upper", "fore"}


def test_a_first_link_on_its_axis_is_left_out_and_what_reaches_out_is_not(tmp_path):
    on_axis = '<origin xyz="0 0 0.15"/><geometry><cylinder radius="0.05" length="0.3"/></geometry>'
    robot = load_robot(urdf(tmp_path, on_axis, box(0.1, 0.1, 0.1)))
    upper, fore = links(robot).values()
    assert upper.left_out and not upper.spheres and fore.spheres
    assert {s.frame for s in robot.body} == {"fore"}
    arm_out = load_robot(urdf(tmp_path, f"{box(0.5, 0.08, 0.1, '0.2 0 0.1')}", box(0.1, 0.1, 0.1)))
    upper = links(arm_out)[1]
    centers, radii = balls_in_joint(arm_out, upper.spheres)
    assert gap(np.array([[0.45, 0.04, 0.15], [0.45, -0.04, 0.05]]), centers, radii) <= 1e-9
    for s in upper.left_out:
        assert np.linalg.norm(s.center[:2]) < 1.1e-3
    for s in upper.spheres:
        assert np.linalg.norm(s.center[:2]) > 1e-3


def test_a_body_in_the_spec_overrides_the_fit(tmp_path):
    path = tmp_path / "arm.yaml"
    path.write_text(
        f"urdf: {urdf(tmp_path, box(0.1, 0.1, 0.3), box(0.1, 0.1, 0.3))}\nbody: [{{frame: fore, radius: 0.2}}]\n"
    )
    robot = load_robot(str(path))
    assert [s.radius for s in robot.body] == [0.2]
    assert robot.cover is None and "body" not in robot.derived


def test_visual_geometry_is_covered_where_there_is_no_other(tmp_path):
    robot = load_robot(urdf(tmp_path, box(0.1, 0.06, 0.3), box(0.1, 0.05, 0.3), kind="visual"))
    assert robot.model.warnings == [
        "no collision geometry at link 'upper', 'fore': the body spheres cover the visual geometry"
    ]
    centers, radii = balls_in_joint(robot, links(robot)[2].spheres)
    assert gap(np.array([[0.05, 0.025, 0.3], [-0.05, -0.025, 0.0]]), centers, radii) <= 1e-9


@pytest.mark.parametrize(
    "nothing", ['<box size="0 0 0"/>', '<sphere radius="0"/>', '<cylinder radius="1e-6" length="1e-5"/>',
                '<mesh filename="t.obj" scale="0 0 0"/>', '<mesh filename="t.obj" scale="1e-9 1e-9 1e-9"/>']
)  # fmt: skip
@pytest.mark.parametrize("kind", ["collision", "visual"])
def test_a_dummy_shape_counts_as_none(tmp_path, nothing, kind):
    (tmp_path / "t.obj").write_text(TETRAHEDRON.format(1))
    robot = load_robot(urdf(tmp_path, box(0.1, 0.1, 0.3), f"<geometry>{nothing}</geometry>", kind))
    assert {s.frame for s in robot.body} == {"upper", "fore"}
    assert any("no geometry can be read at link 'fore': body spheres stand along it" in w for w in robot.model.warnings)


def test_flat_shapes_are_covered_and_touch_in_mujoco(tmp_path):
    mujoco = pytest.importorskip("ppcbf_robots.engine_mujoco")
    disc = '<geometry><cylinder radius="0.1" length="0"/></geometry>'
    robot = urdf(tmp_path, box(0.1, 0.1, 0.0), disc)
    problem = load_problem(robot, "sphere")
    assert {s.frame for s in problem.robot.body} == {"upper", "fore"}
    engine = mujoco.MujocoEngine(problem)
    engine.reset(problem.robot.start, np.zeros(2))
    engine.advance(np.zeros(2), 1e-3, 10)
    assert np.all(np.isfinite(engine.state()[0]))


def test_a_capsule_in_millimetres_is_refused():
    with pytest.raises(InputError, match=r"capsule at 'b' of 300 m and a radius of 0\.02 m .* lengths are metres"):
        body_spheres([BodyPrimitive(frame="b", to=[300.0, 0.0, 0.0], radius=0.02)])


def test_without_readable_geometry_spheres_stand_along_the_links(tmp_path):
    """Each link that moves keeps spheres: one whose mesh is missing, and an arm that has none at all."""
    robot = load_robot(urdf(tmp_path, MESH.format("gone.stl"), MESH.format("gone.stl")))
    assert any("gone.stl" in w for w in robot.model.warnings)
    assert robot.model.warnings[-1].startswith("no collision or visual geometry can be read: body spheres stand along")
    assert robot.cover is None and {s.frame for s in robot.body} == {"fore"}  # the upper one turns about its own axis
    robot = load_robot(urdf(tmp_path, box(0.1, 0.1, 0.3), MESH.format("gone.stl")))
    assert robot.model.warnings[-1].startswith("no geometry can be read at link 'fore': body spheres stand along it")
    assert {s.frame for s in robot.body} >= {"fore"}


# Cache


@pytest.fixture
def cached(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache folder of the test's own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "ppcbf_robots" / "body"


@pytest.fixture
def meshed(tmp_path: Path) -> str:
    """An arm whose second link is the mesh fore.obj beside it."""
    (tmp_path / "fore.obj").write_text(TETRAHEDRON.format(0.05))
    return urdf(
        tmp_path,
        '<origin xyz="0.1 0 0"/><geometry><sphere radius="0.05"/></geometry>',
        MESH.format(tmp_path / "fore.obj"),
    )


def refuse(*_: object) -> None:
    raise AssertionError("fitted again")


def test_a_fit_is_found_again(cached, meshed, monkeypatch):
    first = load_robot(meshed)
    assert len(list(cached.iterdir())) == 1
    monkeypatch.setattr(derive_body, "_cover", refuse)
    second = load_robot(meshed)
    assert (second.body, second.cover) == (first.body, first.cover)


def damage(text: str) -> str:
    return text.replace('"radius":0.', '"radius":0.0').replace('"radius": 0.', '"radius": 0.0')


@pytest.mark.parametrize("spoil", [damage, lambda text: text[:-20], lambda _: "", lambda _: "{}\n{}"])
def test_a_spoilt_entry_is_fitted_again(cached, meshed, spoil):
    first = load_robot(meshed)
    (entry,) = cached.iterdir()
    whole = entry.read_text()
    assert spoil(whole) != whole
    entry.write_text(spoil(whole))
    assert load_robot(meshed).body == first.body
    assert entry.read_text() == whole


def test_bytes_that_are_no_text_are_fitted_again(cached, meshed):
    first = load_robot(meshed)
    (entry,) = cached.iterdir()
    entry.write_bytes(b"\xff\xfe\n\x00")
    assert load_robot(meshed).body == first.body


def test_another_mesh_is_another_entry(cached, meshed, tmp_path):
    small = load_robot(meshed)
    (tmp_path / "fore.obj").write_text(TETRAHEDRON.format(0.08))
    large = load_robot(meshed)
    assert len(list(cached.iterdir())) == 2
    assert max(s.radius for s in large.body if s.frame == "fore") > max(
        s.radius for s in small.body if s.frame == "fore"
    )


def test_a_cache_that_cannot_be_written_is_no_error(tmp_path, meshed, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert load_robot(meshed).body
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    monkeypatch.setattr(Path, "home", lambda: (_ for _ in ()).throw(RuntimeError("no home")))
    assert body_cache.folder() is None
    assert load_robot(meshed).body
