"""Rollouts: energy and order of the integrator, records on disk, and the paper's systems in closed loop."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pinocchio as pin
import pytest

from ppcbf_robots import rollout
from ppcbf_robots.controllers import Gains, NominalController
from ppcbf_robots.errors import InputError
from ppcbf_robots.filters import FilterConfig, Status
from ppcbf_robots.problem import load_problem
from ppcbf_robots.rollout import Trajectory, simulate
from ppcbf_robots.safety_filter import SafetyFilter


def free_fall(problem, duration, **options):
    """No torque at all: a spring of stiffness 0 without gravity compensation, whose storage is the energy."""
    nothing = np.zeros(problem.model.nv)
    idle = NominalController(problem.model, Gains("shaping", nothing, nothing, nothing), problem.robot.goal)
    v = 0.2 * problem.model.v_max
    return simulate(problem.safety, idle, None, problem.robot.start, v, duration, **options)


def filtered(problem, duration=2.0, **config):
    """The robot's own start, controller and goal under a filter with the LB-CBF."""
    filter_ = SafetyFilter(problem.model, problem.safety, problem.barrier("lb-cbf"), FilterConfig(**config))
    robot = problem.robot
    return simulate(problem.safety, robot.controller, filter_, robot.start, robot.start_velocity, duration)


def rise(run):
    """Largest rise of the storage above its least value so far [J]."""
    return np.max(run.V - np.minimum.accumulate(run.V))


def test_energy_is_constant_without_torque_and_damping(problem):
    run = free_fall(problem, 1.0)
    assert np.abs(run.V - run.V[0]).max() < 1e-5 * max(1.0, run.V[0])
    assert np.abs(run.q[-1] - run.q[0]).max() > 0.1
    np.testing.assert_array_equal(run.u, 0.0)
    assert run.meta["complete"] is True


def test_integrator_is_of_fourth_order(two_link, monkeypatch):
    """Half the step, a sixteenth of the error."""
    ends = []
    for step in (0.005, 0.0025, 0.0005):
        monkeypatch.setattr(rollout, "RK4_STEP", step)
        run = free_fall(two_link, 0.3, control_dt=0.005)
        ends.append(np.concatenate([run.q[-1], run.v[-1]]))
    coarse, fine = (np.abs(end - ends[-1]).max() for end in ends[:-1])
    assert 12.0 < coarse / fine < 22.0


def test_records_are_on_the_control_grid(two_link):
    seen = []
    run = free_fall(two_link, 0.2, control_dt=2e-3, on_step=seen.append)
    np.testing.assert_allclose(run.t, np.arange(101) * 2e-3, atol=1e-12)
    assert all(len(x) == 101 for name, x in vars(run).items() if name != "meta")
    assert seen == pytest.approx([0.0, 0.1, 0.2])


def test_constant_torque_between_control_steps(cartpole):
    """Zero-order hold: with one long control period the cart moves by ½ a t²."""
    spring = cartpole.robot.controller.with_goal(np.array([2.0, 0.0]))
    run = simulate(cartpole.safety, spring, None, np.zeros(2), np.zeros(2), 0.02, control_dt=0.02)
    acceleration = cartpole.model.acceleration(np.zeros(2), np.zeros(2), np.array([2.0, 0.0]))[0]
    assert run.q[1, 0] == pytest.approx(0.5 * acceleration * 0.02**2, rel=1e-3)


def test_summary_figures(two_link):
    run = filtered(two_link, duration=0.5)
    summary = run.summary(two_link.model)
    assert set(summary) >= {"min_h", "clearance", "max_torque_ratio", "energy_rise", "injected", "reached_goal",
                            "goal_error", "rests_on", "end", "filter_counts"}  # fmt: skip
    assert json.loads(json.dumps(summary)) == summary
    assert summary["min_h"] == run.h.min()
    assert summary["clearance"] == run.clearance.min()
    assert summary["max_torque_ratio"] == pytest.approx(np.abs(run.u / two_link.model.u_max).max())
    assert summary["goal_error"] == pytest.approx(np.abs(run.q[-1] - two_link.robot.goal).max())
    assert summary["reached_goal"] is False
    assert sum(summary["filter_counts"].values()) == len(run.t) == 501


def test_summary_counts_every_rise_of_the_storage(two_link):
    run = filtered(two_link, duration=0.01)
    V = np.array([4.0, 3.0, 3.5, 1.0, 2.0, *np.full(len(run.t) - 5, 0.5)])
    summary = dataclasses.replace(run, V=V).summary(two_link.model)
    assert summary["energy_rise"] == pytest.approx(1.0 / 4.0)  # above the least so far, against V_0
    assert summary["injected"] == pytest.approx(0.5 + 1.0)


def test_a_run_that_explodes_ends_early(cartpole):
    gains = Gains("pd_gravity", np.full(2, -1e7), np.zeros(2), np.ones(2))
    wild = NominalController(cartpole.model, gains, np.array([1.0, 0.0]))
    run = simulate(cartpole.safety, wild, None, np.zeros(2), np.zeros(2), 1.0)
    assert run.meta["complete"] is False
    assert len(run.t) < 1001


def test_trajectories_survive_the_disk(two_link, tmp_path):
    run = filtered(two_link, duration=0.05)
    path = tmp_path / "new" / "run.npz"
    run.save(path)
    again = Trajectory.load(path)
    for name, value in vars(run).items():
        np.testing.assert_array_equal(getattr(again, name), value)
    assert again.summary(two_link.model) == run.summary(two_link.model)


def write_npz(path, **changes):
    """A small valid trajectory with some fields changed; None leaves a field out."""
    fields = {f: np.zeros(2) for f in Trajectory.__dataclass_fields__}
    fields |= {"meta": np.array('{"goal": [0, 0]}'), **changes}
    with path.open("wb") as file:
        np.savez(file, **{k: x for k, x in fields.items() if x is not None})


def test_a_small_trajectory_is_accepted(tmp_path):
    """So that what is refused below is refused for its one fault."""
    write_npz(tmp_path / "run.npz")
    assert Trajectory.load(tmp_path / "run.npz").meta["goal"] == [0, 0]


def write_truncated(path):
    write_npz(path)
    path.write_bytes(path.read_bytes()[:-200])


def write_damaged(path):
    write_npz(path, V=np.arange(1000.0))
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(content)


NOT_TRAJECTORIES = {
    "text": lambda path: path.write_text("hello"),
    "empty": lambda path: path.write_bytes(b""),
    "array": lambda path: np.save(path.open("wb"), np.zeros(3)),
    "pickle": lambda path: write_npz(path, V=np.array([{"a": 1}], dtype=object)),
    "field missing": lambda path: write_npz(path, V=None),
    "meta not JSON": lambda path: write_npz(path, meta=np.array("{")),
    "meta a list": lambda path: write_npz(path, meta=np.array("[]")),
    "meta incomplete": lambda path: write_npz(path, meta=np.array("{}")),
    "lengths differ": lambda path: write_npz(path, V=np.zeros(3)),
    "truncated": write_truncated,
    "damaged": write_damaged,
}


@pytest.mark.parametrize("kind", NOT_TRAJECTORIES)
def test_other_files_are_refused(tmp_path, kind):
    path = tmp_path / "run.npz"
    NOT_TRAJECTORIES[kind](path)
    with pytest.raises(InputError) as error:
        Trajectory.load(path)
    assert str(error.value).startswith(f"{path}: not a trajectory of `ppcbf simulate`")
    assert "\n" not in str(error.value)


def test_missing_files_and_folders_that_cannot_be_written_are_reported(two_link, tmp_path):
    with pytest.raises(InputError) as error:
        Trajectory.load(tmp_path / "none.npz")
    assert str(error.value) == f"trajectory not found: {tmp_path / 'none.npz'}"
    (tmp_path / "file").write_text("")
    run = filtered(two_link, duration=0.01)
    with pytest.raises(InputError, match="cannot be written"):
        run.save(tmp_path / "file" / "run.npz")


# ------------------------------------------------------------------------- the paper's systems in closed loop


def test_cartpole_papers_filter_breaks_limit_and_passivity(cartpole):
    """LB-CBF with the paper's metric (§5.1): more than 25 N, and joules of storage out of nothing."""
    run = filtered(cartpole, kind="closed-form", metric="torque")
    assert np.abs(run.u).max() > 25.0
    assert run.V.max() > run.V[0] + 5.0
    assert run.h.min() > 0.0


def test_cartpole_kinetic_qp_keeps_limit_and_passivity(cartpole):
    run = filtered(cartpole, metric="kinetic")
    assert np.abs(run.u).max() < 25.0
    assert rise(run) < 1e-3 * run.V[0]
    assert run.h.min() > 0.0
    assert run.active.sum() > 100


def test_two_link_papers_filter_injects_energy(two_link):
    run = filtered(two_link, duration=5.0, kind="closed-form", metric="torque")
    assert rise(run) > run.V[0]
    assert run.clearance.min() > 0.0


def test_two_link_kinetic_qp_is_passive_and_passes_with_the_elbow_up(two_link):
    run = filtered(two_link, duration=8.0, metric="kinetic")
    assert run.clearance.min() >= 0.0
    assert rise(run) < 1e-6
    assert run.q[:, 1].min() > 0.0
    assert run.active.sum() > 1000
    assert run.summary(two_link.model)["goal_error"] < 0.4


def test_panda_passes_a_ball_without_contact_or_energy(panda):
    run = filtered(panda, duration=3.0)
    assert run.clearance.min() > 0.0
    assert rise(run) < 1e-3
    assert np.all(np.abs(run.u) <= panda.model.u_max)
    assert set(run.status) == {Status.FREE, Status.CORRECTING}


def test_an_arm_keeps_off_its_own_base(tmp_path):
    """A UR5 whose goal lies in its own base: it gets there without a filter, and rests before it with one.

    Distances are those of the collision meshes, by another library than the rows'.
    """
    (tmp_path / "arm.yaml").write_text("urdf: ur5\nself_collision: {}\n")
    problem = load_problem(str(tmp_path / "arm.yaml"), "sphere")
    model = problem.model
    shapes = model.geometry(pin.GeometryType.COLLISION)
    base = [i for i, o in enumerate(shapes.geometryObjects) if o.parentJoint == 0]
    wrist = [i for i, o in enumerate(shapes.geometryObjects) if o.parentJoint >= 4]
    for pair in ((i, j) for i in base for j in wrist):
        shapes.addCollisionPair(pin.CollisionPair(*pair))
    data = shapes.createData()

    def distance(q):
        pin.computeDistances(model.model, model.data, shapes, data, q)
        return min(r.min_distance for r in data.distanceResults)

    start = np.array([0.0, -1.0, 2.0, -1.0, 0.0, 0.0])
    goal = np.array([0.0, 0.3, 2.7, 0.3, 0.0, 0.0])
    assert distance(goal) <= 0.0 < 0.2 < distance(start)
    stiff = Gains("bounded_spring", 0.2 * model.u_max, 0.1 * model.u_max, 0.2 * model.u_max)
    controller = NominalController(model, stiff, goal)
    filter_ = SafetyFilter(model, problem.safety, problem.barrier("lb-cbf"))
    least = []
    for chosen in (None, filter_):
        run = simulate(problem.safety, controller, chosen, start, np.zeros(6), 5.0)
        least.append(min(distance(q) for q in run.q[::20]))
    assert least[0] <= 0.0 and 0.0 < least[1] < 0.1
    assert run.h.min() >= 0.0 and np.abs(run.v[-1]).max() < 0.05
    nearest = problem.safety.names[int(np.argmin(problem.safety.evaluate(model.evaluate(run.q[-1], 0 * start)).h))]
    assert "base_link" in nearest
