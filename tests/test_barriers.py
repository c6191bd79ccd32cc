"""One contract for all barriers: phi̇ = L_f phi + L_g phi u along the forward dynamics; and what is claimed of K."""

from __future__ import annotations

import numpy as np
import pytest

from ppcbf_robots.closed_form import ClosedForm
from ppcbf_robots.filters import FilterConfig, Status


@pytest.fixture
def barrier(problem, barrier_name, make_barrier):
    """Every barrier on every robot."""
    return make_barrier(problem, barrier_name)


def rows_at(problem, barrier, dyn):
    return barrier.rows(dyn, problem.safety.evaluate(dyn))


def test_phi_dot_is_lie_derivatives_along_aba(problem, barrier, states, along_motion):
    model, rng, dt = problem.model, np.random.default_rng(1), 1e-6
    for q, v in states(problem, 10):
        dyn = model.evaluate(q, v)
        u = dyn.M @ rng.normal(0.0, 20.0, model.nv) + dyn.b
        rows = rows_at(problem, barrier, dyn)
        motion = along_motion(model, q, v, model.acceleration(q, v, u), dt)
        before, after = (rows_at(problem, barrier, dyn).phi for dyn in motion)
        psi = rows.Lf_phi + rows.Lg_phi @ u
        np.testing.assert_allclose(rows.psi(u), psi, rtol=1e-12, atol=1e-9)
        np.testing.assert_allclose((after - before) / (2 * dt), psi, rtol=1e-4, atol=1e-3)


def test_Lg_phi_is_w_times_inverse_inertia(problem, barrier, states):
    for q, v in states(problem, 5):
        dyn = problem.model.evaluate(q, v)
        rows = rows_at(problem, barrier, dyn)
        np.testing.assert_allclose(rows.Lg_phi, rows.w @ dyn.Minv, rtol=1e-7, atol=1e-9)


def test_w_is_the_velocity_gradient_of_phi(problem, barrier, states):
    model, step = problem.model, 1e-6
    for q, v in states(problem, 5):
        w = rows_at(problem, barrier, model.evaluate(q, v)).w
        for i, e in enumerate(np.eye(model.nv)):
            up, down = (rows_at(problem, barrier, model.evaluate(q, v + s * e)).phi for s in (step, -step))
            np.testing.assert_allclose((up - down) / (2 * step), w[:, i], atol=1e-6)


def test_batch_equals_single(problem, barrier, states):
    q, v = (np.array(x) for x in zip(*states(problem, 3), strict=True))
    batch = rows_at(problem, barrier, problem.model.evaluate_batch(q, v))
    for i in range(3):
        single = rows_at(problem, barrier, problem.model.evaluate(q[i], v[i]))
        for name, value in vars(single).items():
            np.testing.assert_allclose(getattr(batch, name)[i], value, rtol=1e-9, atol=1e-9)


def test_at_rest_the_barrier_is_the_distance(problem, barrier, states):
    """K_theta is zero at rest, so every resting posture free of collision is safe."""
    spec = barrier.spec
    for q, v in states(problem, 5):
        rows = rows_at(problem, barrier, problem.model.evaluate(q, 0.0 * v))
        np.testing.assert_allclose(rows.phi, (spec.alpha_pp if barrier.kind == "pp-cbf" else spec.gamma) * rows.h)


@pytest.mark.parametrize("form", ["mlp", "convex"])
def test_K_is_never_negative_and_zero_at_rest(problem, random_network, states, form):
    model, network = problem.model, random_network(form, problem.model.nq, problem.model.nv)
    q, v = (np.array(x) for x in zip(*states(problem, 200), strict=True))
    K = network.value_and_grad(q, v)[0]
    assert np.all(K >= 0.0)
    assert K.max() > 1e-3
    at_rest, K_q, K_v = network.value_and_grad(q, 0.0 * v)
    for x in (at_rest, K_q, K_v):
        np.testing.assert_allclose(x, 0.0, atol=1e-12)
    assert K_q.shape == (200, model.nq)
    assert K_v.shape == (200, model.nv)


def test_the_letter_of_the_paper_is_a_plain_square(problem, random_network, states):
    """With zero_at_rest = 0, K = f² is the perceptron written out here, and K at rest need not vanish."""
    model = problem.model
    network = random_network("mlp", model.nq, model.nv)
    p = network.params
    p["zero_at_rest"] = np.array(0.0)
    for q, v in states(problem, 10):
        x = (np.concatenate([q, v]) - p["in_shift"]) * p["in_scale"]
        for i in (0, 1):
            x = x @ p[f"W{i}"] + p[f"b{i}"]
            x = np.where(x > 0, x, np.expm1(x))
        assert network.value_and_grad(q, v)[0] == pytest.approx((x @ p["w_out"] + p["b_out"]) ** 2)
    assert network.value_and_grad(q, 0.0 * v)[0] > 1e-6


@pytest.mark.parametrize("form", ["mlp", "convex"])
def test_networks_survive_huge_velocities(random_network, form):
    network = random_network(form, 3, 3)
    values = network.value_and_grad(np.ones(3), np.full(3, 1e6))
    assert all(np.all(np.isfinite(x)) for x in values)


@pytest.mark.parametrize("form", ["mlp", "convex"])
def test_gradients_of_K_equal_central_differences(problem, random_network, states, form):
    """In every coordinate of q, the cos and sin of continuous joints included, compiled and for many states."""
    model, step = problem.model, 1e-6
    network = random_network(form, model.nq, model.nv)
    q, v = (np.array(x) for x in zip(*states(problem, 20), strict=True))
    K, K_q, K_v = network.value_and_grad(q, v)
    for i in range(20):
        for got, wanted in zip(network.value_and_grad(q[i], v[i]), (K[i], K_q[i], K_v[i]), strict=True):
            np.testing.assert_allclose(got, wanted, rtol=1e-12, atol=1e-12)
    for i, e in enumerate(np.eye(model.nq)):
        up, down = (network.value(q + s * e, v) for s in (step, -step))
        np.testing.assert_allclose((up - down) / (2 * step), K_q[:, i], rtol=1e-6, atol=1e-6)
    for i, e in enumerate(np.eye(model.nv)):
        up, down = (network.value(q, v + s * e) for s in (step, -step))
        np.testing.assert_allclose((up - down) / (2 * step), K_v[:, i], rtol=1e-6, atol=1e-6)


def test_convex_layers_see_cosines_and_sines_of_angles_alone(random_network, states, problems):
    """A whole turn of an angle changes the scaled angle only; other coordinates have no cosine."""
    for problem in problems.values():
        model = problem.model
        network = random_network("convex", model.nq, model.nv)
        p = network.params
        p["W0"][: model.nq] = 0.0
        for q, v in states(problem, 3):
            K, K_q, _ = network.value_and_grad(q, v)
            assert network.value_and_grad(q + 2.0 * np.pi * p["turns"], v)[0] == pytest.approx(K, rel=1e-12)
            assert network.value_and_grad(q + 1.0 - p["turns"], v)[0] == pytest.approx(K, rel=1e-12)
            assert np.array_equal(K_q != 0.0, p["turns"] == 1.0)


def test_convex_K_grows_at_least_linearly_along_rays(problem, random_network, states):
    """v · ∂K/∂v >= K >= 0 and midpoint convexity in v, on which passivity by construction rests."""
    network = random_network("convex", problem.model.nq, problem.model.nv)
    q, v = (np.array(x) for x in zip(*states(problem, 300), strict=True))
    other = np.roll(v, 1, axis=0)
    K, _, K_v = network.value_and_grad(q, v)
    assert np.all((v * K_v).sum(-1) >= K - 1e-12)
    middle, K_other = (network.value_and_grad(q, x)[0] for x in (0.5 * (v + other), other))
    assert np.all(middle <= 0.5 * (K + K_other) + 1e-12)


def in_a_band(problem):
    """The problem with corrections wherever phi <= epsilon, not by distance as the paper's 2R."""
    return problem.with_barrier_spec(problem.robot.spec.barrier.model_copy(update={"act_within": None}))


def boundary_states(problem, barrier, states, count):
    """(evaluation, row) on phi_k = 0: the speed along a closing direction is found by bisection."""
    model, found = problem.model, 0
    for q, v in states(problem, 20 * count):

        def phi(s, q=q, v=v):
            return rows_at(problem, barrier, model.evaluate(q, s * v)).phi

        positive = np.flatnonzero((phi(0.0) > 0.0) & (phi(20.0) < 0.0))
        if not positive.size:
            continue
        k, low, high = int(positive[found % positive.size]), 0.0, 20.0
        for _ in range(60):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if phi(middle)[k] > 0.0 else (low, middle)
        yield model.evaluate(q, high * v), k
        found += 1
        if found == count:
            return


@pytest.mark.parametrize("name", ["lb-cbf", "pp-ncbf-convex"])
def test_kinetic_corrections_dissipate_on_the_boundary(problem, make_barrier, states, name):
    """Passivity by construction: on phi_k = 0, vᵀ w_k <= -gamma h_k <= 0, so every push along w_k takes energy out."""
    barrier, corrected = make_barrier(in_a_band(problem), name), 0
    closed_form = ClosedForm(barrier, FilterConfig(kind="closed-form", metric="kinetic"))
    for dyn, k in boundary_states(problem, barrier, states, 15):
        rows = rows_at(problem, barrier, dyn)
        assert rows.phi[k] == pytest.approx(0.0, abs=1e-6)
        assert dyn.v @ rows.w[k] <= -barrier.spec.gamma * rows.h[k] + 1e-6
        one_row = type(rows)(*(x[[k]] for x in vars(rows).values()))
        u_des = dyn.b - 1e3 * rows.Lg_phi[k]  # towards the obstacle
        answer = closed_form.correct(dyn, problem.safety.evaluate(dyn), one_row, u_des, None, problem.model.u_max)
        assert dyn.v @ (answer.u - u_des) <= 1e-6
        corrected += answer.status is Status.CORRECTING
    assert corrected >= 3


def test_the_papers_metric_does_inject_energy_somewhere(problem, make_barrier, states):
    """What the kinetic metric prevents is real: with W = I some correction on the boundary raises V."""
    if problem.robot.name == "cartpole":
        pytest.skip("needs a body whose contact force is not along one joint")
    barrier, injected = make_barrier(in_a_band(problem), "lb-cbf"), 0
    closed_form = ClosedForm(barrier, FilterConfig(kind="closed-form", metric="torque"))
    for dyn, k in boundary_states(problem, barrier, states, 40):
        rows = rows_at(problem, barrier, dyn)
        one_row = type(rows)(*(x[[k]] for x in vars(rows).values()))
        u_des = dyn.b - 1e3 * rows.Lg_phi[k]
        answer = closed_form.correct(dyn, problem.safety.evaluate(dyn), one_row, u_des, None, problem.model.u_max)
        injected += dyn.v @ (answer.u - u_des) > 1e-6
    assert injected > 0
