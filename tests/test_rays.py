"""Rays in velocity space against Pinocchio and the runtime barrier."""

from __future__ import annotations

import dataclasses
import threading
from typing import Any

import numpy as np
import pytest
import torch
from ray_helpers import DOUBLE, draw, make_field, make_rays, tensors

from ppcbf_robots.barriers import BarrierRows
from ppcbf_robots.errors import InputError
from ppcbf_robots.learning import threads
from ppcbf_robots.learning.linear_program import best_worst_row
from ppcbf_robots.learning.presets import DEFAULT
from ppcbf_robots.learning.rays import FAR, Rays, build_pool, rays_at
from ppcbf_robots.learning.train import Trainer
from ppcbf_robots.network import NumpyNetwork
from ppcbf_robots.problem import Problem, load_problem

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(params=["mlp", "convex"])
def network(request, problem, random_network) -> NumpyNetwork:
    """Random weights of both forms for each problem."""
    return random_network(request.param, problem.model.nq, problem.model.nv, seed=1)


def runtime_rows(problem: Problem, network: NumpyNetwork, q: Any, v: Any) -> BarrierRows:
    """All rows of the barrier that will run, through Pinocchio."""
    dyn = problem.model.evaluate_batch(np.asarray(q), np.asarray(v))
    return problem.barrier("pp-ncbf", network).rows(dyn, problem.safety.evaluate(dyn))


def test_rows_along_a_ray_are_those_of_the_runtime_barrier(problem, network):
    rays = make_rays(problem)
    s = torch.rand(len(rays), generator=torch.Generator().manual_seed(0), dtype=DOUBLE)
    found = make_field(problem, network.kind).rows(tensors(network.params), rays, s)
    expected = runtime_rows(problem, network, rays.q, s[:, None] * rays.d)
    orders = [np.argsort(np.asarray(rows.phi), axis=-1) for rows in (found, expected)]
    for name in ("phi", "h", "Lf_phi", "Lg_phi", "w"):
        sorted_ = []
        for rows, order in zip((found, expected), orders, strict=True):
            x = np.asarray(getattr(rows, name))
            sorted_.append(np.take_along_axis(x, order[..., None] if x.ndim == 3 else order, 1))
        scale = max(1.0, float(np.abs(sorted_[1]).max()))
        np.testing.assert_allclose(sorted_[0], sorted_[1], rtol=0.0, atol=1e-9 * scale, err_msg=name)


def test_rays_hold_the_nominal_torque_and_reach_the_face_of_the_box(problem):
    q, v = draw(problem, 100)
    goals = problem.robot.domain.sample_q(np.random.default_rng(3), 100)
    ray, least_rho, free = rays_at(problem, q, v, 3, goals)
    np.testing.assert_array_equal(q, ray["q"])
    box = problem.robot.domain.v
    reach = np.where(ray["d"] >= 0.0, ray["d"] / box[:, 1], ray["d"] / box[:, 0]).max(axis=1)
    np.testing.assert_allclose(reach, 1.0, atol=1e-12)
    for i, goal in zip(range(20), goals, strict=False):
        dyn = problem.model.evaluate(ray["q"][i], 0.5 * ray["d"][i])
        nominal = problem.robot.controller.with_goal(problem.model.from_angles(goal)).evaluate(dyn)
        u = ray["u_rest"][i] - problem.robot.controller.gains.kd * dyn.v
        np.testing.assert_allclose(u, nominal.u, atol=1e-9)
        safety = problem.safety.evaluate(problem.model.evaluate(q[i], v[i]))
        assert free[i] == (safety.h.min() >= 0.0)
        rho = safety.grad @ v[i] + problem.robot.spec.barrier.gamma * safety.h
        assert least_rho[i] == pytest.approx(rho.min(), abs=1e-9)


def test_bisection_lands_on_the_level(problem, network):
    field, rays, params = make_field(problem, network.kind), make_rays(problem, 400), tensors(network.params)
    level = torch.rand(len(rays), generator=torch.Generator().manual_seed(0), dtype=DOUBLE) * 0.05
    found, s = field.on_band(params, rays, level)
    assert len(found) > 0.02 * len(rays)
    assert torch.all((s >= 0.0) & (s <= 1.0))
    phi = runtime_rows(problem, network, rays.q[found], s[:, None] * rays.d[found]).phi.min(-1)
    error = np.abs(phi - level[found].numpy())
    assert (np.median(error) < 5e-4) and (np.quantile(error, 0.98) < 5e-3) and (error.max() < 0.02)
    ends = [runtime_rows(problem, network, rays.q, x * rays.d).phi.min(-1) for x in (0.0, 1.0)]
    np.testing.assert_array_equal(found, np.flatnonzero((ends[0] >= level.numpy()) & (ends[1] < level.numpy())))


@pytest.mark.parametrize("world", ["sphere", "five_spheres"])
def test_a_few_near_rows_decide_on_the_band(world, random_network):
    """With K = 0 bisection is exact but for kinks; of the Panda's rows six nearly always hold the least one there."""
    problem = load_problem("panda", world)
    params = random_network("mlp", problem.model.nq, problem.model.nv).params
    params["w_out"] = np.zeros_like(params["w_out"])
    rays, field = make_rays(problem, 2000, rows=6), make_field(problem, "mlp")
    found, s = field.on_band(tensors(params), rays, torch.full((len(rays),), 0.025, dtype=DOUBLE))
    on = rays.select(found)
    phi = runtime_rows(problem, NumpyNetwork("mlp", params), on.q, s[:, None] * on.d).phi.min(-1)
    assert len(found) > 100
    assert (phi < 0.025 - 1e-9).mean() < 0.01
    assert (np.abs(phi - 0.025) < 1e-9).mean() > 0.9


def test_only_rows_that_stay_far_are_dropped(panda):
    gamma = panda.robot.spec.barrier.gamma
    rays = make_rays(panda, 500)
    fewer = rays.without_far_rows(gamma)
    count = fewer.h.shape[1]
    assert 0 < count < rays.h.shape[1]
    assert fewer.grad.shape[1] == fewer.eta.shape[1] == count
    dropped = gamma * rays.h[:, count:] - torch.relu(-(rays.grad @ rays.d[..., None])[..., 0])[:, count:]
    assert dropped.min() > FAR


def test_pools_join_and_select(two_link):
    a, b = make_rays(two_link, 20), make_rays(two_link, 20, seed=1)
    both = a.join(b)
    assert len(both) == len(a) + len(b)
    for field in dataclasses.fields(Rays):
        picked = getattr(both.select(torch.tensor([len(a), 0])), field.name)
        assert torch.equal(picked, torch.stack([getattr(b, field.name)[0], getattr(a, field.name)[0]]))


def test_the_pool_is_as_large_as_asked_for(two_link):
    rays, volume = build_pool(two_link, 3000, 6, 0.5, np.random.default_rng(0))
    count = sum(len(r["q"]) for r in rays)
    assert 3000 <= count == sum(len(states["q"]) for states in volume)


def test_threads_change_nothing(panda, monkeypatch):
    """Rays and linear programs in one piece and in three, to the last bit; the pieces are worked on at once."""
    rng, count, working = np.random.default_rng(0), 3 * threads.LEAST + 7, set()
    q = panda.model.from_angles(panda.robot.domain.sample_q(rng, count))
    v, goals = panda.robot.domain.sample_v(rng, count), panda.robot.domain.sample_q(rng, count)
    offset, c = rng.normal(size=(count, 5)), rng.normal(size=(count, 5, 7))
    program = [torch.as_tensor(x) for x in (offset, c, 0.1 * rng.normal(size=(count, 7)), rng.uniform(size=count))]
    found = []
    for number in (1, 3):
        monkeypatch.setattr(threads, "_threads", number)
        rays = [rays_at(panda, q, v, 6, g) for g in (None, goals)]
        found.append([*(x for r in rays for x in (*r[0].values(), *r[1:])), *best_worst_row(*program)])
    for one, three in zip(*found, strict=True):
        assert np.array_equal(np.asarray(one), np.asarray(three))
    barrier = threading.Barrier(3, timeout=20.0)
    parts = threads.in_threads(count, lambda part: (barrier.wait(), working.add(threading.get_ident()), part)[2])
    assert len(working) == 3 and [i for part in parts for i in range(*part.indices(count))] == list(range(count))


def test_a_domain_in_collision_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("ppcbf_robots.learning.rays.CHUNK", 200)
    world = tmp_path / "world.yaml"
    world.write_text("obstacles: [{name: all, type: half_space, normal: [0, 0, 1], offset: -0.1, margin: 3.0}]\n")
    with pytest.raises(InputError, match="almost every configuration of the domain X is in collision"):
        Trainer(load_problem("two_link", str(world)), "pp-ncbf", dataclasses.replace(DEFAULT, rays=500))
