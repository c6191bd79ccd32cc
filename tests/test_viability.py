"""The viable set against closed forms, simulation and a finer grid."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ppcbf_robots import viability, viable_set
from ppcbf_robots.barriers import Barrier
from ppcbf_robots.engines import PinocchioEngine
from ppcbf_robots.errors import CheckFailed, InputError
from ppcbf_robots.problem import Problem, load_problem
from ppcbf_robots.safe_sets import FREE, VIABLE, Membership, check_boundary, membership
from ppcbf_robots.specs import Array, BarrierSpec
from ppcbf_robots.viable_set import ViableSet

DATA = Path(__file__).parent / "data"
WALL = 1.5


@pytest.fixture(scope="session")
def gantry(cache_folder: Path) -> tuple[Problem, ViableSet]:
    """Two slides in front of the wall x = 1.5: 6 N move 3 kg along x, so the best it can brake with is 2 m/s²."""
    problem = load_problem(str(DATA / "gantry.yaml"), "wall")
    return problem, viability.solve(problem, 41)


@pytest.fixture(scope="session")
def pole(problems: dict[str, Problem]) -> tuple[Problem, ViableSet]:
    """The paper's cart-pole on a coarse grid."""
    return problems["cartpole"], viability.solve(problems["cartpole"], 31)


def uniform(problem: Problem, count: int, seed: int = 0) -> tuple[Array, Array]:
    rng, domain = np.random.default_rng(seed), problem.robot.domain
    return problem.model.from_angles(domain.sample_q(rng, count)), domain.sample_v(rng, count)


def test_a_slide_can_stop_within_v_squared_over_2a(gantry):
    """V = min(h, h - v²/2a) in closed form: the value, and the set, from which braking with 2 m/s² suffices."""
    problem, found = gantry
    q, v = uniform(problem, 2000)
    gap = WALL - q[:, 0]
    exact = gap - np.maximum(v[:, 0], 0.0) ** 2 / (2.0 * 2.0)
    np.testing.assert_allclose(found.value(q, v), exact, atol=0.025)
    clear = np.abs(exact) > 0.025
    np.testing.assert_array_equal((found.value(q, v) >= 0.0)[clear], exact[clear] >= 0.0)


def test_states_alone_and_beyond_the_grid(gantry):
    problem, found = gantry
    q, v = uniform(problem, 6)
    several = found.value(q.reshape(2, 3, 2), v.reshape(2, 3, 2))
    assert several.shape == (2, 3)
    assert found.value(q[4], v[4]) == pytest.approx(several[1, 1])
    fast = np.array([100.0, 0.0])
    assert np.isnan(found.value(q[0], fast))


def moved(problem: Problem, q: Array, v: Array, u: Array, dt: float = 5e-3) -> tuple[Array, Array]:
    engine = PinocchioEngine(problem.model)
    engine.reset(q, v)
    engine.advance(u, dt, 1)
    return engine.state()


def bang_bang(problem: Problem, found: ViableSet, q: Array, v: Array, seconds: float, dt: float = 5e-3) -> float:
    """Least h on the way under the torque that raises V fastest: ``u_i = u_max sign (M⁻¹ ∂V/∂v)_i``."""
    model, step = problem.model, 0.2
    least = np.inf
    for _ in range(round(seconds / dt)):
        h = problem.safety.least(q)[0]
        least = min(least, h)
        inside = np.abs(v) < found.nodes.high[2:] - step  # beyond the grid nothing is known: brake
        ahead, behind = (
            found.value(
                np.tile(q, (2, 1)), np.clip(v + s * step * np.eye(2), found.nodes.low[2:], found.nodes.high[2:])
            )
            for s in (1.0, -1.0)
        )
        u = model.u_max * np.sign(model.evaluate(q, v).Minv @ (ahead - behind))
        u = np.where(inside, u, -model.u_max * np.sign(v))
        q, v = moved(problem, q, v, u, dt)
    return least


def test_from_inside_the_best_torque_avoids_the_wall(pole):
    problem, found = pole
    q, v = uniform(problem, 4000)
    value = found.value(q, v)
    moving = np.flatnonzero((value > 0.03) & (value < 0.15) & (v[:, 0] > 0.5))[:15]
    assert len(moving) == 15
    for i in moving:
        assert bang_bang(problem, found, q[i], v[i], 0.8) > -0.01


def test_from_outside_no_constant_torque_avoids_the_wall(pole):
    """Also not the torques that brake the cart best at every instant."""
    problem, found = pole
    model = problem.model
    q, v = uniform(problem, 4000, 1)
    lost = np.flatnonzero(found.value(q, v) < -0.06)[:15]
    assert len(lost) == 15
    for i in lost:
        for pull in (-1.0, 0.0, 1.0, np.nan):  # of the pole; nan: whatever brakes the cart
            at_q, at_v, least = q[i], v[i], np.inf
            for _ in range(160):
                best = -np.sign(model.evaluate(at_q, at_v).Minv[0])
                u = model.u_max * np.array([-1.0, best[1] if np.isnan(pull) else pull])
                at_q, at_v = moved(problem, at_q, at_v, u)
                least = min(least, problem.safety.least(at_q)[0])
            assert least < 0.0


def test_a_finer_grid_changes_the_volume_by_less_than_two_percent(pole):
    problem, found = pole
    coarser = viability.solve(problem, 23)
    q, v = uniform(problem, 5000)
    volumes = [(s.value(q, v) >= 0.0).mean() for s in (coarser, found)]
    assert volumes[0] == pytest.approx(volumes[1], rel=0.02)
    assert 0.9 < volumes[1] < 0.97


def test_a_pole_that_turns_is_periodic_and_a_slide_is_not(gantry, pole, problems):
    assert pole[1].nodes.periodic == (False, True, False, False)
    assert gantry[1].nodes.periodic == (False,) * 4
    assert viability.place_nodes(problems["two_link"], (7,) * 4, 1.0).periodic == (False,) * 4
    q, v = uniform(pole[0], 20)
    np.testing.assert_allclose(pole[1].value(q + np.array([0.0, 2.0 * np.pi]), v), pole[1].value(q, v), atol=1e-6)


def test_tables_give_pinocchio_s_acceleration(two_link):
    grid = viability.place_nodes(two_link, (7, 8, 9, 10), 1.0)
    tables = viability.tabulate(two_link, grid)
    rng = np.random.default_rng(0)
    for _ in range(20):
        i, j = rng.integers(7), rng.integers(8)
        q, v, u = np.array([grid.axes[0][i], grid.axes[1][j]]), rng.normal(size=2), rng.normal(size=2)
        powers = np.array([1.0, v[0] ** 2, v[0] * v[1], v[1] ** 2])
        np.testing.assert_allclose(
            tables.a_0[i, j] @ powers + tables.Minv[i, j] @ u, two_link.model.acceleration(q, v, u), atol=1e-9
        )


def test_results_are_kept_and_altered_ones_are_not_used(gantry, cache_folder, monkeypatch):
    problem, found = gantry
    monkeypatch.setattr(viability, "_settle", lambda *_: pytest.fail("computed again"))
    again = viability.solve(problem, 41)
    np.testing.assert_array_equal(again.loss, found.loss)
    assert again.sweeps == found.sweeps
    key = viability._digest(found.nodes, viability.tabulate(problem, found.nodes))
    path = cache_folder / "ppcbf_robots" / "viable" / f"{key}.npz"
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    assert viable_set.recall(key, found.nodes.count) is None
    path.write_bytes(whole)
    assert viable_set.recall(key, (1, 2, 3, 4)) is None


def test_bad_input_and_no_convergence(panda, two_link, monkeypatch):
    with pytest.raises(InputError, match="2 moving joints, this one has 7"):
        viability.solve(panda)
    with pytest.raises(InputError, match="at least 7 nodes"):
        viability.solve(two_link, 5)
    monkeypatch.setattr(viability, "MAX_SWEEPS", viability.SWEEPS)
    monkeypatch.setattr(viability, "TOLERANCE", 0.0)
    with pytest.raises(CheckFailed, match="has not settled after 25 sweeps"):
        viability.solve(two_link, 7)


def test_ratios_and_their_standard_error():
    rng, p = np.random.default_rng(0), 0.3
    estimates = []
    for _ in range(300):
        b = rng.random(1000) < 0.5
        a = b & (rng.random(1000) < p)
        estimates.append(Membership.of({"a": a, "b": b}).ratio("a", "b"))
    values = np.array([e.value for e in estimates])
    assert values.mean() == pytest.approx(p, abs=0.005)
    assert values.std() == pytest.approx(np.mean([e.error for e in estimates]), rel=0.15)
    empty = Membership.of({"a": np.zeros(3, bool), "b": np.ones(3, bool)})
    assert empty.ratio("a", "b").value == 0.0 and np.isnan(empty.ratio("b", "a").value)
    assert np.isnan(empty.outside("a", "b")) and empty.outside("b", "a") == 1.0


def test_sets_of_the_slide_have_their_closed_form_volumes(gantry):
    """LB-CBF ``v <= gamma h``, viable ``v <= 2 sqrt(h)``, PP-CBF ``1.5 vx² + 0.5 vy² <= 100 h`` with h = 1.5 - x."""
    problem, found = gantry
    barriers: dict[str, Barrier] = {"lb": problem.barrier("lb-cbf"), "pp": problem.barrier("pp-cbf")}
    sets = membership(problem, barriers, found, 20_000, np.random.default_rng(0))
    x, vx, vy = np.meshgrid(*(np.linspace(*b, 201) for b in ((0.0, 1.5), (-2.0, 2.0), (-2.0, 2.0))), indexing="ij")
    gap = WALL - x
    expected = {
        FREE: np.ones_like(x), "lb": vx <= 5.0 * gap, VIABLE: vx <= 2.0 * np.sqrt(gap),
        "pp": 1.5 * vx**2 + 0.5 * vy**2 <= 100.0 * gap,
    }  # fmt: skip
    for name, mask in expected.items():
        assert sets.ratio(name).value == pytest.approx(mask.mean(), abs=0.01), name
    doomed = np.mean(~expected[VIABLE][expected["lb"]])
    assert sets.outside("lb", VIABLE) == pytest.approx(doomed, abs=0.01)


def test_the_boundary_of_a_slide_is_feasible_below_its_best_braking(gantry):
    """On ``v = gamma h`` the LB-CBF needs ``a = -gamma v``, which 2 m/s² give up to ``v = 2 / gamma``."""
    problem = gantry[0]
    rng = np.random.default_rng(0)
    gentle, hard = (problem.barrier("lb-cbf", spec=BarrierSpec(gamma=g, epsilon=0.01)) for g in (0.9, 5.0))
    found = check_boundary(problem, gentle, 100, rng)
    assert (found.samples, found.infeasible) == (100, 0)
    assert check_boundary(problem, hard, 200, rng).share == pytest.approx(1.0 - 0.4 / 2.0, abs=0.08)
