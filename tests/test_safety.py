"""Safety functions against an independent geometry engine (Coal) and finite differences."""

from __future__ import annotations

import itertools
from importlib.resources import files
from pathlib import Path

import coal
import numpy as np
import pinocchio as pin
import pytest

from ppcbf_robots.errors import InputError
from ppcbf_robots.problem import Problem, load_problem
from ppcbf_robots.safety import SafetyFunction
from ppcbf_robots.shapes import Motion, Packed, pack, smoothing_gap
from ppcbf_robots.specs import Array, BodySphere
from ppcbf_robots.world import Box, Capsule, ConvexMesh, Cylinder, HalfSpace, Obstacle, Sphere

MIXED = [
    Sphere(type="sphere", name="ball", center=[0.4, 0.3, 0.5], radius=0.15, margin=0.02),
    HalfSpace(type="half_space", name="table", normal=[0.0, 0.0, 1.0], offset=-0.05, margin=0.01),
    Sphere(type="sphere", name="far", center=[-0.6, 0.1, 0.9], radius=0.1),
    HalfSpace(type="half_space", name="tilted", normal=[0.6, 0.0, -0.8], offset=-0.9),
]


@pytest.fixture
def mixed(problem):
    """The robot among spheres and half-spaces, some with a margin."""
    return SafetyFunction(problem.model, problem.robot.body, MIXED)


def coal_distance(model, data, sphere, obstacle) -> float:
    """Signed distance by Coal, less the margin; ``data`` holds the frame placements."""
    T = data.oMf[model.frame_id(sphere.frame)]
    body = coal.Sphere(max(sphere.radius, 1e-9)), coal.Transform3s(np.eye(3), T.act(np.array(sphere.center)))
    if isinstance(obstacle, Sphere):
        solid = coal.Sphere(obstacle.radius), coal.Transform3s(np.eye(3), np.array(obstacle.center))
    else:
        solid = coal.Halfspace(np.array(obstacle.normal), obstacle.offset), coal.Transform3s.Identity()
    return coal.distance(*body, *solid, coal.DistanceRequest(), coal.DistanceResult()) - obstacle.margin


def test_h_is_coals_distance(problem, mixed, states):
    model = problem.model
    data = model.model.createData()
    for q, v in states(problem, 20):
        pin.framesForwardKinematics(model.model, data, q)
        expected = {
            f"{s.frame}#{i} / {o.name}": coal_distance(model, data, s, o)
            for i, s in enumerate(problem.robot.body)
            for o in MIXED
        }
        h = mixed.evaluate(model.evaluate(q, v)).h[: mixed.pairs]
        assert h == pytest.approx([expected[name] for name in mixed.names[: mixed.pairs]], abs=1e-6)
        assert len(expected) == mixed.pairs


def test_gradient_and_curvature_against_finite_differences(problem, mixed, states, along_motion):
    model, rng, dt = problem.model, np.random.default_rng(1), 1e-4
    for q, v in states(problem, 20):
        a = rng.normal(size=model.nv)
        rows = mixed.evaluate(model.evaluate(q, v))
        before, after = (mixed.evaluate(dyn).h for dyn in along_motion(model, q, v, a, dt))
        np.testing.assert_allclose((after - before) / (2 * dt), rows.grad @ v, atol=1e-5)
        np.testing.assert_allclose((after - 2 * rows.h + before) / dt**2, rows.curvature + rows.grad @ a, atol=1e-4)


def test_joint_limit_rows(problem, mixed, states):
    model = problem.model
    q, v = next(states(problem, 1, seed=3))
    rows = mixed.evaluate(model.evaluate(q, v))
    angles = model.to_angles(q)
    for name, h in zip(mixed.names[mixed.pairs :], rows.h[mixed.pairs :], strict=True):
        joint, side, _ = name.split()
        i = model.joint_names.index(joint)
        assert h == pytest.approx(angles[i] - model.q_lower[i] if side == "lower" else model.q_upper[i] - angles[i])
        assert not model.continuous[i]
    assert np.all(rows.curvature[mixed.pairs :] == 0.0)


def test_rows_are_named_and_counted(problem, mixed):
    finite = np.isfinite(problem.model.q_lower).sum() + np.isfinite(problem.model.q_upper).sum()
    assert mixed.pairs == len(problem.robot.body) * len(MIXED)
    assert mixed.rows == len(mixed.names) == len(set(mixed.names)) == mixed.pairs + finite
    without = SafetyFunction(problem.model, problem.robot.body, MIXED, joint_limits=False)
    assert without.names == mixed.names[: mixed.pairs]


def test_batch_equals_single(problem, mixed, states):
    q, v = (np.array(x) for x in zip(*states(problem, 3), strict=True))
    batch = mixed.evaluate(problem.model.evaluate_batch(q, v))
    for i in range(3):
        single = mixed.evaluate(problem.model.evaluate(q[i], v[i]))
        for name, array in vars(single).items():
            np.testing.assert_allclose(getattr(batch, name)[i], array, atol=1e-12)


@pytest.mark.parametrize("count", [1, 7, 1000])
def test_the_nearest_rows_are_the_least_of_all(panda, count):
    """In the order of ``gamma h + min(ḣ, 0)``, of pairs with obstacles and with each other, and of joint limits."""
    model, rng, gamma = panda.model, np.random.default_rng(0), 3.0
    safety = SafetyFunction(model, panda.robot.body, MIXED, self_pairs=[(0, 12), (1, 9)])
    q = model.from_angles(panda.robot.domain.sample_q(rng, 40))
    v, share = panda.robot.domain.sample_v(rng, 40), rng.uniform(0.1, 1.0, 40)
    dyn = model.evaluate_batch(q, v)
    rows, near = safety.evaluate(dyn), safety.nearest(dyn, gamma, share, count)
    hdot = (rows.grad @ v[..., None])[..., 0]
    order = np.argsort(gamma * rows.h + np.minimum(hdot, 0.0))[:, :count]
    assert near.h.shape == (40, min(count, safety.rows))
    for found, every in ((near.h, rows.h), (near.curvature, rows.curvature)):
        np.testing.assert_allclose(found, np.take_along_axis(every, order, 1), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(near.grad, np.take_along_axis(rows.grad, order[..., None], 1), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(near.least_h, rows.h.min(1), rtol=1e-9)
    np.testing.assert_allclose(near.least_rho, (share[:, None] * hdot + gamma * rows.h).min(1), rtol=1e-9)


def test_the_papers_safety_functions(cartpole, two_link):
    h = cartpole.safety.evaluate(cartpole.model.evaluate(np.array([0.4, 1.0]), np.zeros(2))).h
    assert cartpole.safety.names[0] == "cart#0 / wall"
    assert h[0] == pytest.approx(1.5 - 0.4)
    q1, q2, l = 0.3, 0.4, 0.35
    tip = l * np.array([np.cos(q1) + np.cos(q1 + q2), np.sin(q1) + np.sin(q1 + q2)])
    least, name = two_link.safety.least(np.array([q1, q2]))
    assert name == "tip#0 / circle"
    assert least == pytest.approx(np.linalg.norm(tip - 0.6) - 0.2)


def test_at_a_spheres_centre_everything_is_finite(two_link):
    ball = Sphere(type="sphere", name="ball", center=[0.7, 0.0, 0.0], radius=0.1)
    safety = SafetyFunction(two_link.model, two_link.robot.body, [ball])
    rows = safety.evaluate(two_link.model.evaluate(np.zeros(2), np.array([1.0, -1.0])))
    assert rows.h[0] == pytest.approx(-0.1)
    assert all(np.all(np.isfinite(x)) for x in vars(rows).values())


def test_no_body_and_an_obstacle_over_the_base_are_refused(two_link):
    with pytest.raises(InputError) as error:
        SafetyFunction(two_link.model, [], MIXED)
    assert str(error.value) == "the robot has no body spheres; give `body` in the robot spec"
    over = Sphere(type="sphere", name="over", center=[0.0, 0.0, 0.05], radius=0.1)
    with pytest.raises(InputError) as error:
        SafetyFunction(two_link.model, [BodySphere(frame="tip", center=[0, 0, 0], radius=0)], [over])
    assert str(error.value) == "obstacle 'over' contains the robot's base (the origin); move or shrink it"


# Shapes

WEDGE = [[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.0, 0.2, 0.0], [0.3, 0.2, 0.0], [0.15, 0.1, 0.25]]
POSE = {"xyz": [0.5, -0.1, 0.3], "rpy": [0.4, -0.7, 1.1]}
SHAPES: list[Obstacle] = [
    MIXED[2],
    MIXED[3],
    Box(type="box", name="box", size=[0.3, 0.2, 0.1], margin=0.01, **POSE),
    Box(type="box", name="plate", size=[0.3, 0.2, 0.004], **POSE),
    Capsule(type="capsule", name="capsule", radius=0.05, length=0.3, **POSE),
    Cylinder(type="cylinder", name="cylinder", radius=0.07, length=0.2, margin=0.02, **POSE),
    ConvexMesh(type="mesh", name="mesh", vertices=WEDGE, **POSE),
]
IDS = [o.name for o in SHAPES]


def true_distance(o: Obstacle, p: Array) -> float:
    """Distance of a point to the obstacle itself by Coal; negative where Coal sees a penetration."""
    ball = coal.Sphere(1e-6)
    pose = coal.Transform3s(o.rotation, np.array(o.xyz)) if hasattr(o, "xyz") else coal.Transform3s.Identity()
    match o:
        case Sphere():
            solid, pose = coal.Sphere(o.radius), coal.Transform3s(np.eye(3), np.array(o.center))
        case HalfSpace():
            solid = coal.Halfspace(np.array(o.normal), o.offset)
        case Box():
            solid = coal.Box(*o.size)
        case Capsule():
            solid = coal.Capsule(o.radius, o.length)
        case Cylinder():
            solid = coal.Cylinder(o.radius, o.length)
        case ConvexMesh():
            points = coal.StdVec_Vec3s()
            for x in o.vertices:
                points.append(np.array(x))
            solid = coal.Convex.convexHull(points, True, "Qt")
    at = coal.Transform3s(np.eye(3), p)
    return coal.distance(ball, at, solid, pose, coal.DistanceRequest(), coal.DistanceResult()) + 1e-6


def around(o: Obstacle, count: int, reach: float, seed: int = 0) -> Array:
    """Points (count, 3) in a cube about the obstacle."""
    center = pack([o]).frames[0, :, 3]
    return center + np.random.default_rng(seed).uniform(-reach, reach, (count, 3))


@pytest.mark.parametrize("o", SHAPES, ids=IDS)
def test_the_smoothed_distance_is_never_above_the_true_one_and_close_at_the_surface(o):
    packed, gaps = pack([o]), []
    for p in around(o, 4000, 0.3):
        true, smooth = true_distance(o, p), packed.distance(0, p)
        if true > 1e-4:
            assert smooth <= true + 1e-5, p
            assert smooth >= 0.8 * true - smoothing_gap(o) - 1e-5, p
            if true < 0.003:
                gaps.append(true - smooth)
    assert len(gaps) > 2
    if o.name != "mesh":  # beyond a mesh's sharp corners the supporting planes lie a little farther out
        assert max(gaps) <= smoothing_gap(o) + 1e-4


def test_gaps_stay_below_a_centimetre():
    assert all(smoothing_gap(o) <= 0.0051 for o in SHAPES)
    assert smoothing_gap(SHAPES[0]) == smoothing_gap(SHAPES[1]) == 0.0
    assert smoothing_gap(SHAPES[2]) == pytest.approx(0.5 * (np.sqrt(3) - 1) * 0.01)
    assert smoothing_gap(SHAPES[3]) == pytest.approx(0.5 * (np.sqrt(3) - 1) * 0.002)


@pytest.mark.parametrize("o", SHAPES, ids=IDS)
def test_margin_and_radius_are_taken_off(two_link, o):
    body = [BodySphere(frame="tip", center=[0.0, 0.0, 0.0], radius=0.02)]
    safety = SafetyFunction(two_link.model, body, [o], joint_limits=False)
    q = np.array([0.2, -1.0])
    p = safety.points.kinematics(two_link.model.evaluate(q, np.zeros(2))).p[0]
    assert safety.least(q)[0] == pytest.approx(safety.packed.distance(0, p) - 0.02 - o.margin)


@pytest.mark.parametrize("o", SHAPES, ids=IDS)
def test_shapes_have_exact_first_and_second_order_terms(panda, states, along_motion, o):
    model, rng, dt = panda.model, np.random.default_rng(1), 2e-5
    safety = SafetyFunction(model, panda.robot.body[-3:], [o], joint_limits=False)
    for q, v in states(panda, 30):
        a = rng.normal(size=model.nv)
        rows = safety.evaluate(model.evaluate(q, v))
        before, after = (safety.evaluate(dyn) for dyn in along_motion(model, q, v, a, dt))
        free = rows.h > -0.03
        np.testing.assert_allclose((after.h - before.h)[free] / (2 * dt), (rows.grad @ v)[free], atol=1e-5)
        rate = np.array([x.grad @ (v + s * dt * a) for x, s in ((after, 1), (before, -1))])
        expected = (rate[0] - rate[1]) / (2 * dt)
        np.testing.assert_allclose(expected[free], (rows.curvature + rows.grad @ a)[free], atol=2e-2, rtol=1e-3)


def largest_jump(packed: Packed, p0: Array, w: Array, steps: int) -> float:
    """Largest change of the second order term between neighbouring points outside the obstacle on a line."""
    R, origin = packed.frames[0, :, :3], packed.frames[0, :, 3]
    x0, along = R.T @ (p0 - origin), R.T @ w
    points = x0 + np.linspace(0.0, 1.0, steps + 1)[:, None] * along
    d, second = np.array([packed.core(0, tuple(x), tuple(along))[:2] for x in points]).T
    outside = np.minimum(d[1:], d[:-1]) > 0.0
    return float(np.abs(np.diff(second))[outside].max(initial=0.0))


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("o", SHAPES[2:], ids=IDS[2:])
def test_the_second_derivative_does_not_jump(o, seed):
    """C²: with steps a quarter as long, the largest change of the second order term shrinks with them."""
    packed = pack([o])
    p0, p1 = around(o, 2, 0.25, seed)
    coarse, fine = (largest_jump(packed, p0, p1 - p0, n) for n in (8_000, 32_000))
    assert fine < 0.5 * coarse + 1e-3


# Obstacles that move


@pytest.mark.parametrize("o", SHAPES, ids=IDS)
def test_motion_enters_with_first_and_second_order(panda, states, o):
    """h along the motion of arm and obstacle together, by finite differences."""
    model, rng, dt = panda.model, np.random.default_rng(2), 2e-5
    safety = SafetyFunction(model, panda.robot.body[-3:], [o], joint_limits=False)
    frame = safety.packed.frames[0]

    def at(s, q, v, a, velocity, acceleration, omega):
        """The rows and the arm's velocity at time s."""
        turned = pin.exp3(omega * s) @ frame[:, :3]
        origin = frame[:, 3] + s * velocity + 0.5 * s * s * acceleration
        motion = Motion(origin, turned, velocity + s * acceleration, acceleration, omega)
        dyn = model.evaluate(model.integrate(q, s * v + 0.5 * s * s * a), v + s * a)
        return safety.evaluate(dyn, safety.packed.moved({o.name: motion})), dyn.v

    for q, v in states(panda, 20):
        a, *motion = (rng.normal(size=n) for n in (model.nv, 3, 3, 3))
        (before, v0), (now, _), (after, v1) = (at(s, q, v, a, *motion) for s in (-dt, 0.0, dt))
        free = now.h > -0.03
        np.testing.assert_allclose((after.h - before.h)[free] / (2 * dt), now.hdot(v)[free], atol=1e-5)
        expected = (after.hdot(v1) - before.hdot(v0)) / (2 * dt)
        np.testing.assert_allclose(expected[free], (now.curvature + now.grad @ a)[free], atol=2e-2, rtol=1e-3)


def test_motion_of_an_unknown_obstacle_and_nan_are_refused(panda):
    with pytest.raises(InputError) as error:
        panda.safety.packed.moved({"cat": Motion()})
    assert str(error.value) == "no obstacle is named 'cat' (obstacles: ball)"
    with pytest.raises(InputError) as error:
        panda.safety.packed.moved({"ball": Motion(velocity=np.array([np.nan, 0, 0]))})
    assert str(error.value) == "obstacle 'ball': velocity must be finite numbers of shape (3,)"


def test_moving_leaves_the_world_as_it_is(panda):
    before = panda.safety.packed.frames.copy()
    moved = panda.safety.packed.moved({"ball": Motion(xyz=np.array([1.0, 2.0, 3.0]))})
    assert moved.frames[0, :, 3].tolist() == [1.0, 2.0, 3.0]
    np.testing.assert_array_equal(panda.safety.packed.frames, before)


# Pairs of body spheres


def test_self_collision_pairs_against_finite_differences(panda, states, along_motion):
    model, dt = panda.model, 2e-5
    body = panda.robot.body
    safety = SafetyFunction(model, body, panda.safety.obstacles, joint_limits=False, self_pairs=[(0, 12), (1, 9)])
    assert safety.pairs == len(body) + 2 and safety.names[-1] == f"{body[1].frame}#1 / {body[9].frame}#9"
    for q, v in states(panda, 10):
        a = np.ones(model.nv)
        dyn = model.evaluate(q, v)
        rows = safety.evaluate(dyn)
        p = safety.points.kinematics(dyn).p
        assert rows.h[-1] == pytest.approx(np.linalg.norm(p[1] - p[9]) - body[1].radius - body[9].radius)
        before, after = (safety.evaluate(x) for x in along_motion(model, q, v, a, dt))
        np.testing.assert_allclose((after.h - before.h)[-2:] / (2 * dt), (rows.grad @ v)[-2:], atol=1e-5)
        rate = (after.grad @ (v + dt * a) - before.grad @ (v - dt * a))[-2:] / (2 * dt)
        np.testing.assert_allclose(rate, (rows.curvature + rows.grad @ a)[-2:], atol=1e-3)


def test_a_domain_tighter_than_the_limits_gives_rows(two_link):
    domain = np.array([[0.1, 1.0], [-9.0, 9.0]])
    safety = SafetyFunction(two_link.model, two_link.robot.body, two_link.safety.obstacles, domain=domain)
    h = dict(
        zip(safety.names, safety.evaluate(two_link.model.evaluate(np.array([0.3, 0.2]), np.zeros(2))).h, strict=True)
    )
    name = two_link.model.joint_names[0]
    assert h[f"{name} lower limit"] == pytest.approx(0.2) and h[f"{name} upper limit"] == pytest.approx(0.7)


SRDF = """<robot name="panda">
  <disable_collisions link1="panda_link7" link2="panda_link3" reason="Never"/>
  <disable_collisions link1="panda_link3" link2="panda_hand" reason="Never"/>
  <disable_collisions link1="panda_link3" link2="panda_leftfinger" reason="Never"/>
  <disable_collisions link1="panda_link3" link2="panda_rightfinger" reason="Never"/>
</robot>"""


def test_self_collision_on_request(tmp_path):
    """Pairs of a spec with ``self_collision``: no neighbours, nothing disabled, and h is the spheres' distance."""
    (tmp_path / "arm.srdf").write_text(SRDF)
    text = Path(str(files("ppcbf_robots.robots") / "panda.yaml")).read_text()
    (tmp_path / "all.yaml").write_text(text + "self_collision: {}\n")
    (tmp_path / "some.yaml").write_text(text + "self_collision: {srdf: arm.srdf}\n")
    (tmp_path / "none.yaml").write_text(text + "self_collision: {srdf: missing.srdf}\n")
    everything, some = (load_problem(str(tmp_path / f"{name}.yaml"), "sphere") for name in ("all", "some"))
    spheres = [*everything.robot.body, *everything.robot.fixed.spheres]
    links = [{spheres[i].frame for i in pair} for pair in everything.robot.self_pairs]
    assert {"panda_link7", "panda_link3"} in links and {"panda_link3", "panda_link4"} not in links
    kept = [{spheres[i].frame for i in pair} for pair in some.robot.self_pairs]
    assert {"panda_link7", "panda_link3"} not in kept and 0 < len(kept) < len(links)
    q = everything.robot.start
    p = everything.safety.points.kinematics(everything.model.evaluate(q, np.zeros(7))).p
    rows = everything.safety.evaluate(everything.model.evaluate(q, np.zeros(7)))
    i, j = max(pair for pair in everything.robot.self_pairs if pair[1] < len(p))
    gap = np.linalg.norm(p[i] - p[j]) - everything.robot.body[i].radius - everything.robot.body[j].radius
    row = everything.safety.pairs - len(everything.robot.self_pairs) + everything.robot.self_pairs.index((i, j))
    assert rows.h[row] == pytest.approx(gap)
    assert everything.fingerprint()["robot"] != some.fingerprint()["robot"]
    with pytest.raises(InputError, match="SRDF not found"):
        load_problem(str(tmp_path / "none.yaml"), "sphere")


def test_the_base_is_kept_off_too(tmp_path):
    """Spheres of the links that no joint moves: contained like the body, met by what reaches them, no obstacle row."""
    spec = "urdf: ur5\nself_collision: {}\n"
    (tmp_path / "arm.yaml").write_text(spec)
    problem, plain = load_problem(str(tmp_path / "arm.yaml"), "pillar"), load_problem("ur5", "pillar")
    body, fixed = problem.robot.body, problem.robot.fixed.spheres
    assert fixed and {s.frame for s in fixed} == {"base_link"}
    every = [*body, *fixed]
    met = [(every[i].frame, every[j].frame) for i, j in problem.robot.self_pairs if j >= len(body)]
    assert ("wrist_3_link", "base_link") in met and ("shoulder_link", "base_link") not in met
    # the arm folded down onto its own base: h of a pair is the distance of the spheres in the world
    q = np.array([0.0, 0.9, 2.2, 0.0, 0.0, 0.0])
    dyn = problem.model.evaluate(q, np.array([0.3, -0.5, 0.7, 0.2, -0.4, 0.6]))
    rows = problem.safety.evaluate(dyn)
    assert len(rows.h) == len(plain.safety.evaluate(dyn).h) + len(problem.robot.self_pairs)
    points = problem.model.points([s.frame for s in every], np.array([s.center for s in every])).kinematics(dyn)
    first = problem.safety.pairs - len(problem.robot.self_pairs)
    np.testing.assert_allclose(rows.h[:first], plain.safety.evaluate(dyn).h[:first])
    for k, (i, j) in enumerate(problem.robot.self_pairs, start=first):
        gap = np.linalg.norm(points.p[i] - points.p[j]) - every[i].radius - every[j].radius
        assert rows.h[k] == pytest.approx(gap)
        assert problem.safety.names[k].startswith(f"{every[i].frame}#{i} / {every[j].frame}#{j}")
    step = 1e-6
    h = [problem.safety.evaluate(problem.model.evaluate(q + s * dyn.v, dyn.v)).h for s in (-step, step)]
    np.testing.assert_allclose((h[1] - h[0]) / (2 * step), rows.hdot(dyn.v), atol=1e-6)
    near = problem.safety.nearest(problem.model.evaluate_batch(q[None], dyn.v[None]), 5.0, np.ones(1), 8)
    order = np.argsort(5.0 * rows.h + np.minimum(rows.hdot(dyn.v), 0.0))[:8]
    np.testing.assert_allclose(near.h[0], rows.h[order])
    np.testing.assert_allclose(near.grad[0], rows.grad[order], atol=1e-12)
    assert plain.fingerprint()["robot"] != problem.fingerprint()["robot"]


POST = """<link name="post"><collision><geometry><sphere radius="0.1"/></geometry></collision></link>
<joint name="foot" type="fixed"><parent link="base"/><child link="post"/><origin xyz="{x} 0 0"/></joint></robot>"""


@pytest.mark.parametrize(("x", "pairs"), [(5.0, 0), (0.8, 1)])
def test_fixed_spheres_out_of_reach_make_no_pairs(tmp_path, x, pairs):
    """A post that stands 5 m away is no business of the arm; one that it reaches is."""
    text = (files("ppcbf_robots.robots") / "two_link.urdf").read_text()
    (tmp_path / "arm.urdf").write_text(text.replace("</robot>", POST.format(x=x)))
    body = "body: [{frame: fore, center: [0.35, 0, 0], radius: 0.05}]"
    (tmp_path / "arm.yaml").write_text(f"urdf: arm.urdf\n{body}\nstart: [1.5, 0]\nself_collision: {{}}\n")
    robot = load_problem(str(tmp_path / "arm.yaml"), "circle").robot
    posts = [k for k, s in enumerate(robot.fixed.spheres, start=1) if s.frame == "post"]
    assert len(posts) == 1 and sum(j in posts for _, j in robot.self_pairs) == pairs


def test_the_first_link_keeps_off_what_is_fixed(tmp_path):
    """All fixed links but the one that carries the joint: the upper link of a planar arm against a post."""
    text = (files("ppcbf_robots.robots") / "two_link.urdf").read_text()
    (tmp_path / "arm.urdf").write_text(text.replace("</robot>", POST.format(x=0.3)))
    body = "body: [{frame: upper, center: [0.2, 0, 0], radius: 0.05}]"
    (tmp_path / "arm.yaml").write_text(f"urdf: arm.urdf\n{body}\nself_collision: {{}}\n")
    robot = load_problem(str(tmp_path / "arm.yaml"), "circle").robot
    met = [robot.fixed.spheres[j - 1].frame for i, j in robot.self_pairs if i == 0]
    assert met == ["post"]
    lent = [w for w in robot.model.warnings if "no collision geometry at link 'base'" in w]
    assert lent and any(s.frame == "base" for s in robot.fixed.spheres)


@pytest.mark.parametrize("name", ["panda", "ur5"])
def test_clear_postures_do_not_collide(tmp_path, name):
    """Where all rows are positive, collision geometry of links that are no neighbours does not meet, says Coal."""
    (tmp_path / "arm.yaml").write_text(f"urdf: {name}\nself_collision: {{}}\n")
    (tmp_path / "far.yaml").write_text("obstacles: [{name: ball, type: sphere, center: [9, 0, 0], radius: 0.1}]\n")
    problem = load_problem(str(tmp_path / "arm.yaml"), str(tmp_path / "far.yaml"))
    model, shapes = problem.model, problem.model.geometry(pin.GeometryType.COLLISION)
    parents, joints = list(model.model.parents), [o.parentJoint for o in shapes.geometryObjects]
    for i, j in itertools.combinations(range(len(joints)), 2):
        low, high = sorted((joints[i], joints[j]))
        if low != high and parents[high] != low:
            shapes.addCollisionPair(pin.CollisionPair(i, j))
    data = shapes.createData()
    q = model.from_angles(problem.robot.domain.sample_q(np.random.default_rng(3), 1500))
    clear = problem.safety.first_order(q)[0].min(axis=1) >= 0.0
    collides = np.array([pin.computeCollisions(model.model, model.data, shapes, data, x, True) for x in q])
    assert 0.2 < clear.mean() < 0.9 and collides.mean() > 0.05
    assert not np.any(clear & collides)


def test_an_srdf_and_fitted_spheres_that_cover_several_links(tmp_path):
    """The spheres of joint 7 cover link7 and the hand: they are left out where both are disabled, and not before."""
    plain = "urdf: panda\nlocked: {panda_finger_joint1: 0.02, panda_finger_joint2: 0.02}\nself_collision: "
    links = ["panda_link7", "panda_hand", "panda_leftfinger", "panda_rightfinger"]

    def load(name: str, disabled: list[str]) -> Problem:
        lines = [f'<disable_collisions link1="panda_link5" link2="{link}" reason="Never"/>' for link in disabled]
        (tmp_path / f"{name}.srdf").write_text(f'<robot name="panda">{"".join(lines)}</robot>')
        (tmp_path / f"{name}.yaml").write_text(f"{plain}{{srdf: {name}.srdf}}\n")
        return load_problem(str(tmp_path / f"{name}.yaml"), "sphere")

    (tmp_path / "all.yaml").write_text(plain + "{}\n")
    everything = load_problem(str(tmp_path / "all.yaml"), "sphere")
    half, whole = load("half", links[:1]), load("whole", links)
    assert half.robot.self_pairs == everything.robot.self_pairs
    gone = set(everything.robot.self_pairs) - set(whole.robot.self_pairs)
    assert gone and {frozenset(everything.robot.body[i].frame for i in pair) for pair in gone} == {
        frozenset(("panda_link5", "panda_link7"))
    }
    empty, foreign = load("empty", []), load("foreign", ["panda_foot"])
    assert any("disables no pair of links" in w for w in empty.model.warnings)
    assert any("the robot has no link named panda_foot" in w for w in foreign.model.warnings)
