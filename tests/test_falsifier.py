"""The search for states without a feasible torque: what it finds is real, and it finds what was planted."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from ppcbf_robots.filters import FilterConfig, Status
from ppcbf_robots.learning import falsifier as module
from ppcbf_robots.learning.band import Band
from ppcbf_robots.learning.falsifier import CULLED, CULLING, FIRST_STEP, LAST_STEP, STARTS, Attack, Falsifier
from ppcbf_robots.learning.rays import Rays, rays_at, to_tensors
from ppcbf_robots.network import NumpyNetwork, random_convex
from ppcbf_robots.problem import Problem, load_problem
from ppcbf_robots.safety_filter import SafetyFilter

pytestmark = pytest.mark.usefixtures("one_thread")
CPU = torch.device("cpu")


@pytest.fixture
def weak(tmp_path: Path, cartpole: Problem) -> Problem:
    """The cart-pole with motors of 8 N, for which a quarter of the LB band is infeasible."""
    urdf = cartpole.model.urdf
    spec = tmp_path / "weak.yaml"
    spec.write_text((urdf.parent / "cartpole.yaml").read_text().replace(urdf.name, str(urdf)) + "effort: 8\n")
    return load_problem(str(spec), "wall")


def nothing_learned(problem: Problem) -> dict[str, Any]:
    """Parameters with K = 0: the LB barrier."""
    model = problem.model
    params = random_convex(model.nq, model.nv, (8,), 2, np.random.default_rng(0))
    return params | {"ba": np.full(2, -1e3), "cone_a": np.array(-1e3), "bowl_a": np.array(-1e3)}


def make(problem: Problem, seed: int = 0, passive: bool = True, dtype: torch.dtype = torch.float64) -> Falsifier:
    band = Band(problem, "convex", FilterConfig(), passive, CPU, dtype)
    return Falsifier(problem, band, 8, np.random.default_rng(seed))


def attack(problem: Problem, seed: int = 0, passive: bool = True, **limits: Any) -> Attack:
    params = {k: torch.as_tensor(x, dtype=torch.float64) for k, x in nothing_learned(problem).items()}
    return make(problem, seed, passive).search(params, **limits)


def statuses(problem: Problem, q: Any, v: Any, passive: bool = True) -> list[Status]:
    """What the filter that will run says of states."""
    barrier = problem.barrier("pp-ncbf", NumpyNetwork("convex", nothing_learned(problem)))
    runtime = SafetyFilter(problem.model, problem.safety, barrier, FilterConfig())
    found = []
    for qi, vi in zip(q, v, strict=True):
        dyn = problem.model.evaluate(qi, vi)
        nominal = problem.robot.controller.evaluate(dyn)
        found.append(runtime.filter(dyn, nominal.u, float(nominal.d_p) if passive else None).status)
    return found


def evaluated(problem: Problem, q: Any, v: Any) -> Any:
    dyn = problem.model.evaluate_batch(q, v)
    return dyn, problem.safety.evaluate(dyn)


def reserves(problem: Problem, q: Any, v: Any) -> np.ndarray:
    """Reserves of states themselves, with all rows."""
    arrays, _, free = rays_at(problem, q, v, 1000)
    assert free.all()
    rays = Rays(**to_tensors([arrays], CPU, torch.float64))
    s = torch.as_tensor(np.linalg.norm(v, axis=1) / np.linalg.norm(arrays["d"], axis=1))
    params = {k: torch.as_tensor(x, dtype=torch.float64) for k, x in nothing_learned(problem).items()}
    return np.asarray(make(problem).band.reserve(params, rays, s))


@pytest.mark.parametrize("passive", [True, False])
def test_a_planted_violation_is_found_and_is_one_for_the_runtime_filter(weak, passive):
    found = attack(weak, passive=passive, rounds=2)
    assert found.worst < -1.0
    assert len(found.q) == len(found.v) > 50
    assert found.evaluated > 2 * STARTS
    some = np.random.default_rng(0).choice(len(found.q), 100)
    assert min(statuses(weak, found.q[some], found.v[some], passive)) >= Status.PASSIVITY_DROPPED
    dyn, safety = evaluated(weak, found.q, found.v)
    phi = weak.barrier("lb-cbf").rows(dyn, safety).phi.min(-1)
    assert safety.h.min() >= 0.0
    assert phi.min() > -0.01 and phi.max() < weak.robot.spec.barrier.epsilon + 0.01


def test_it_also_finds_what_few_states_of_the_band_violate(brisk_panda):
    """The LB barrier drops passivity somewhere."""
    found = attack(brisk_panda, rounds=30)
    assert found.worst < 0.0
    clear = reserves(brisk_panda, found.q, found.v) < -1e-6
    assert clear.mean() > 0.9
    assert min(statuses(brisk_panda, found.q[clear], found.v[clear])) >= Status.PASSIVITY_DROPPED


def test_nothing_is_found_where_there_is_torque_enough(two_link):
    found = attack(two_link, rounds=4)
    assert found.worst > 0.1
    assert found.q.shape == found.v.shape == (0, 2)


@pytest.mark.parametrize("rounds", [0, 1, 5])
def test_the_worst_is_the_least_reserve_of_what_is_returned(weak, rounds):
    """The points it starts from included."""
    found = attack(weak, rounds=rounds)
    assert len(found.q)
    assert reserves(weak, found.q, found.v).min() == pytest.approx(found.worst, rel=1e-6)


def test_descent_goes_below_the_random_points(two_link):
    start, end = (attack(two_link, rounds=rounds) for rounds in (0, 10))
    assert end.worst < start.worst - 0.005
    assert end.evaluated > start.evaluated > 0


def test_points_that_are_spent_are_replaced_and_count(weak, monkeypatch):
    monkeypatch.setattr(module, "LAST_STEP", 1.0)  # all of them in every round
    found, without = attack(weak, rounds=3), attack(weak, rounds=0)
    assert found.evaluated > 4 * without.evaluated - 1
    assert reserves(weak, found.q, found.v).min() == pytest.approx(found.worst, rel=1e-6)


def test_a_seed_repeats_a_search(weak):
    first, second, other = (attack(weak, seed, rounds=3) for seed in (1, 1, 2))
    for x, y in zip(dataclasses.astuple(first), dataclasses.astuple(second), strict=True):
        np.testing.assert_array_equal(x, y)
    assert first.worst != other.worst


def test_it_ends_in_time(weak):
    began = time.monotonic()
    attack(weak, seconds=0.5)
    assert 0.5 <= time.monotonic() - began < 5.0
    assert attack(weak, seconds=0.0, rounds=1000).evaluated == attack(weak, rounds=0).evaluated


def test_a_search_goes_on_where_it_was(weak):
    """Starts are judged anew, never move to a larger margin, and are replaced where their step is used up."""
    params = {k: torch.as_tensor(x, dtype=torch.float64) for k, x in nothing_learned(weak).items()}
    falsifier = make(weak)
    starts = falsifier.start()
    falsifier.search(params, rounds=3, starts=starts)
    assert starts.points.shape == (STARTS, 5) and (starts.age <= 3).all() and (starts.step >= LAST_STEP).all()
    before, value = starts.points.copy(), starts.value.copy()
    np.testing.assert_allclose(falsifier.reserves(params, before)[0], value)
    starts.value[:] = 7.0
    found = falsifier.search(params, rounds=0, starts=starts)
    assert found.evaluated == STARTS and found.worst == value.min()
    np.testing.assert_array_equal(starts.value, value)
    starts.step[:10] = 0.5 * LAST_STEP
    falsifier.search(params, rounds=1, starts=starts)
    assert (starts.value[10:] <= value[10:]).all()
    assert (starts.age[:10] == 0).all() and (starts.step[:10] == FIRST_STEP).all()


def test_those_behind_give_way(two_link):
    """After CULLING rounds a third of the starts is new."""
    params = {k: torch.as_tensor(x, dtype=torch.float64) for k, x in nothing_learned(two_link).items()}
    falsifier = make(two_link)
    starts = falsifier.start()
    falsifier.search(params, rounds=CULLING - 1, starts=starts)
    old = (starts.age == CULLING - 1).sum()
    assert old > 0.8 * STARTS
    starts = falsifier.start()
    falsifier.search(params, rounds=CULLING, starts=starts)
    assert (starts.age == 0).sum() >= int(CULLED * STARTS)
    assert (starts.age == CULLING).sum() > 0.4 * STARTS


def test_it_ends_when_it_has_enough(weak):
    params = {k: torch.as_tensor(x, dtype=torch.float64) for k, x in nothing_learned(weak).items()}
    few, many = (make(weak).search(params, rounds=5, enough=n) for n in (100, np.inf))
    assert 100 <= len(few.q) < len(many.q)
    assert few.evaluated < many.evaluated


def test_off_the_band_there_is_nothing(weak):
    """Points in collision or that never reach the band have no margin."""
    params = {k: torch.as_tensor(x, dtype=torch.float64) for k, x in nothing_learned(weak).items()}
    falsifier, domain = make(weak), weak.robot.domain
    away = np.hstack([domain.q[:, :1].T, np.array([[-4.0, 0.0, 0.5]])])
    least, _, v = falsifier.reserves(params, away)
    assert np.isinf(least[0]) and not v.any()
    assert falsifier.reserves(params, np.zeros((0, 5)))[0].shape == (0,)


def test_violating_states_come_back_and_end_the_search(weak):
    """By their number, or so many rounds after the first."""
    found, few = (attack(weak, rounds=8, **ends) for ends in ({}, {"enough": 1}))
    assert len(found.q) > 100 and len(found.q) > len(few.q) > 0
    soon = attack(weak, rounds=8, linger=2)
    assert few.evaluated < soon.evaluated < found.evaluated
    assert np.all(np.abs(found.v) <= np.abs(weak.robot.domain.v).max(axis=1) + 1e-9)
    assert reserves(weak, found.q, found.v).max() < 1e-6


def test_cornered_states_run_into_bounds_of_X(panda):
    """A quarter of the joints are within 1.5 |v| / gamma of the bound they move to, half of those fast; all in X."""
    domain, gamma = panda.robot.domain, 4.0
    q, v = domain.sample_cornered(np.random.default_rng(0), 20_000, gamma)
    for x, box in ((q, domain.q), (v, domain.v)):
        assert np.all((x >= box[:, 0]) & (x <= box[:, 1]))
    distance = np.where(v >= 0.0, domain.q[:, 1] - q, q - domain.q[:, 0])
    uniform = domain.sample_v(np.random.default_rng(1), 20_000)
    by_chance = np.minimum(1.0, 1.5 * np.abs(uniform) / gamma / np.ptp(domain.q, axis=1))
    close = np.mean(distance <= 1.5 * np.abs(v) / gamma + 1e-12, axis=0)
    np.testing.assert_allclose(close, 0.25 + 0.75 * by_chance.mean(axis=0), atol=0.02)
    fast = np.mean(np.abs(v) >= 0.7 * np.abs(domain.v).max(axis=1), axis=0)
    np.testing.assert_allclose(fast, 0.3 + 0.25 * 0.5 * 0.7, atol=0.02)
