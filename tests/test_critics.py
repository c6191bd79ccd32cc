"""Critics and the linear program behind them against independent answers: SciPy and the runtime filters."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import settings as tries
from hypothesis import strategies as st
from ray_helpers import CPU, DOUBLE, make_field, make_rays, tensors
from scipy.optimize import linprog

from ppcbf_robots.barriers import BarrierRows, rho_rows
from ppcbf_robots.closed_form import ClosedForm
from ppcbf_robots.evidence import uniform_band
from ppcbf_robots.filters import FilterConfig, Status
from ppcbf_robots.learning.band import Band
from ppcbf_robots.learning.critics import LEAST_CAPABILITY, Feasibility, closed_form_critics, feasibility
from ppcbf_robots.learning.linear_program import best_worst_row, pivot_together
from ppcbf_robots.learning.rays import Rays, rays_at, to_tensors
from ppcbf_robots.network import NumpyNetwork, random_convex
from ppcbf_robots.problem import Problem
from ppcbf_robots.safety_filter import SafetyFilter

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(params=["mlp", "convex"])
def network(request, problem, random_network) -> NumpyNetwork:
    """Random weights of both forms for each problem."""
    return random_network(request.param, problem.model.nq, problem.model.nv, seed=1)


# The closed form


@pytest.fixture(params=[(None, 0.025), (0.03, 0.1)], ids=["by phi", "by h"])
def on_band(request, problem, network) -> tuple[Problem, Rays, torch.Tensor, BarrierRows]:
    """A problem whose closed form acts on phi, or on near rows above the band; rays, s and rows of states there."""
    act_within, level = request.param
    spec = problem.robot.spec.barrier.model_copy(update={"act_within": act_within})
    field, rays = make_field(problem, network.kind), make_rays(problem, 600)
    found, s = field.on_band(tensors(network.params), rays, torch.full((len(rays),), level, dtype=DOUBLE))
    rays = rays.select(found)
    return problem.with_barrier_spec(spec), rays, s, field.rows(tensors(network.params), rays, s)


@pytest.mark.parametrize("metric", ["torque", "kinetic"])
def test_closed_form_critics_are_the_runtime_filters_excess(on_band, network, metric):
    problem, rays, s, rows = on_band
    robot, u_max = problem.model, problem.model.u_max
    kd, p_ref = torch.as_tensor(problem.robot.controller.gains.kd), 17.0
    v = s[:, None] * rays.d
    found = closed_form_critics(
        rows, v, rays.u_rest - kd * v, (kd * v * v).sum(-1), torch.as_tensor(u_max), metric, 0.0, p_ref,
        problem.robot.spec.barrier,
    )  # fmt: skip
    barrier = problem.barrier("pp-ncbf", network)
    filter_ = ClosedForm(barrier, FilterConfig("closed-form", metric))
    expected = []
    for qi, vi in zip(rays.q.numpy(), v.numpy(), strict=True):
        dyn = robot.evaluate(qi, vi)
        nominal = problem.robot.controller.evaluate(dyn)
        safety = problem.safety.evaluate(dyn)
        c = filter_.correct(dyn, safety, barrier.rows(dyn, safety), nominal.u, None, u_max)
        acts = c.status is not Status.FREE
        excess = max(0.0, float(np.max(np.abs(c.u) / u_max)) - 1.0), max(0.0, vi @ (c.u - nominal.u) - nominal.d_p)
        expected.append((acts * excess[0], acts * excess[1] / p_ref))
    np.testing.assert_allclose(np.stack(found, axis=1), expected, rtol=1e-5, atol=1e-6)


def test_closed_form_critics_ask_for_a_reserve(on_band):
    problem, rays, s, rows = on_band
    kd, v = torch.as_tensor(problem.robot.controller.gains.kd), s[:, None] * rays.d
    arguments = (rows, v, rays.u_rest - kd * v, (kd * v * v).sum(-1), torch.as_tensor(problem.model.u_max), "torque")
    without, with_ = (
        closed_form_critics(*arguments, margin, 1.0, problem.robot.spec.barrier) for margin in (0.0, 0.03)
    )
    for less, more in zip(without, with_, strict=True):
        assert torch.all(more >= less)
    over = without[0] > 0.0
    np.testing.assert_allclose((with_[0] - without[0])[over], 0.03, atol=1e-12)


# The linear program


def programs(n: int, rows: int, seed: int, kind: str, count: int = 6) -> tuple[np.ndarray, ...]:
    """Offsets (B, R), c (B, R, n), p (B, n) and budgets (B,) as the margin makes them, or degenerate in one way."""
    rng = np.random.default_rng(seed)
    c = rng.normal(size=(count, rows, n)) + rng.normal(size=(count, 1, n))
    c /= np.abs(c).sum(-1, keepdims=True)
    offset, p = rng.normal(size=(count, rows)), rng.normal(size=(count, n))
    if kind == "equal rows":
        offset[:], c[:] = offset[:, :1], c[:, :1]
    if kind == "zero rows":
        c[:, ::2] = 0.0
    if kind == "opposite rows":
        c[:, 1::2] = -c[:, : 2 * (rows // 2) : 2]
    if kind == "few values":
        offset, c, p = np.round(offset), np.round(3.0 * c) / 3.0, np.round(p)
    if kind == "one joint moves":
        p[:, 1:] = 0.0
    if kind == "rest":
        p[:] = 0.0
    p /= np.maximum(np.abs(p).sum(-1, keepdims=True), 1e-9)
    least = -np.abs(p).sum(-1)
    budget = rng.uniform(least, 1.0)
    budget[0] = least[0]  # one torque alone is passive
    budget[1] = 1.0
    if kind == "least budget":
        budget = least
    return offset, c, p, budget


def dual(offset: np.ndarray, c: np.ndarray, p: np.ndarray, budget: float, share: np.ndarray) -> float:
    """The bound that a share proves: its least over mu >= 0, which is at a kink."""
    force = c.T @ share
    kinks = [0.0, *(f / x for f, x in zip(force, p, strict=True) if x != 0.0 and f / x > 0.0)]
    return float(share @ offset + min(mu * budget + np.abs(force - mu * p).sum() for mu in kinks))


def largest(offset: np.ndarray, c: np.ndarray, p: np.ndarray, budget: float) -> float:
    """SciPy's answer; NaN if no z is within the budget."""
    A = np.vstack([np.hstack([np.ones((len(c), 1)), -c]), [0.0, *p]])
    bounds = [(None, None), *[(-1.0, 1.0)] * len(p)]
    solution = linprog([-1.0, *np.zeros(len(p))], A, np.append(offset, budget), bounds=bounds)
    return float(-solution.fun) if solution.status == 0 else np.nan


KINDS = ["any", "equal rows", "zero rows", "opposite rows", "few values", "one joint moves", "rest", "least budget"]


SOLVERS = [best_worst_row, pivot_together]  # compiled, and as on other devices


@pytest.mark.parametrize("solve", SOLVERS)
@pytest.mark.parametrize("kind", KINDS)
@tries(max_examples=25)
@given(n=st.integers(1, 8), rows=st.integers(1, 16), seed=st.integers(0, 2**32 - 1))
def test_the_best_worst_row_is_that_of_a_linear_programming_solver(solve, kind, n, rows, seed):
    states = programs(n, rows, seed, kind)
    value, share, z = (x.numpy() for x in solve(*(torch.as_tensor(x) for x in states)))
    for i, (offset, c, p, budget) in enumerate(zip(*states, strict=True)):
        assert value[i] == pytest.approx(largest(offset, c, p, budget + 1e-12), abs=1e-7)
        assert np.all(np.abs(z[i]) <= 1.0 + 1e-8)
        assert p @ z[i] <= budget + 1e-8
        assert np.min(offset + c @ z[i]) == pytest.approx(value[i], abs=1e-7)
        assert np.all(share[i] >= -1e-9)
        assert share[i].sum() == pytest.approx(1.0, abs=1e-9)
        assert dual(offset, c, p, budget, share[i]) == pytest.approx(value[i], abs=1e-7)


@pytest.mark.parametrize("solve", SOLVERS)
@pytest.mark.parametrize("kind", ["zero rows", "opposite rows"])
@pytest.mark.parametrize(("n", "rows"), [(7, 8), (8, 16)])
def test_rounding_does_not_break_one_program_in_thousands(n, rows, kind, solve):
    """Pivots that are noise must not be taken: z is feasible and attains the value that the share proves."""
    offset, c, p, budget = (torch.as_tensor(x) for x in programs(n, rows, 1, kind, count=10_000))
    value, _, z = solve(offset, c, p, budget)
    assert ((p * z).sum(-1) - budget).max() <= 1e-8
    assert z.abs().max() <= 1.0 + 1e-8
    attained = (offset + (c * z[:, None]).sum(-1)).amin(-1)
    np.testing.assert_allclose(attained, value, atol=1e-8)


def test_programs_of_one_batch_do_not_see_each_other():
    states = [torch.as_tensor(x) for x in programs(5, 9, 0, "any", count=30)]
    together = pivot_together(*states)
    for i in range(30):
        alone = best_worst_row(*(x[i : i + 1] for x in states))
        for a, b in zip(alone, together, strict=True):
            np.testing.assert_allclose(a[0], b[i], atol=1e-12)


def test_no_programs_have_no_solutions():
    found = best_worst_row(torch.zeros(0, 3), torch.zeros(0, 3, 2), torch.zeros(0, 2), torch.zeros(0))
    assert [x.shape for x in found] == [(0,), (0, 3), (0, 2)]


# The feasibility margin


@dataclasses.dataclass(frozen=True)
class Rows:
    """Rows, box and passivity budget of ``feasibility``, and the linear program that they mean."""

    hdot: Any
    phi: Any
    Lf: Any
    Lg: Any
    v: Any
    u_des: Any
    d_p: Any
    u_max: Any
    config: FilterConfig

    @staticmethod
    def random(rows: int, nv: int, seed: int, count: int = 60) -> Rows:
        """Rows that look somewhat alike, as those of a world do; one state is at rest."""
        rng = np.random.default_rng(seed)
        phi, Lf = rng.uniform(0.0, 0.05, (count, rows)), rng.normal(0.0, 3.0, (count, rows))
        Lg = rng.normal(size=(count, rows, nv)) + rng.normal(size=(count, 1, nv))
        v, u_des = rng.normal(size=(count, nv)), rng.normal(size=(count, nv))
        v[0] = 0.0
        hdot = rng.normal(0.0, 0.02, (count, rows))
        return Rows(
            hdot,
            phi,
            Lf,
            Lg,
            v,
            u_des,
            0.3 * (v**2).sum(-1),
            rng.uniform(0.5, 2.0, nv),
            FilterConfig(alpha=3.0, dt=0.1),
        )

    def programs(self, passive: bool, Lf: Any = None, Lg: Any = None, phi: Any = None) -> Feasibility:
        """What the learner solves, of other rows if they are given."""
        given = [torch.as_tensor(a if b is None else b) for a, b in ((self.phi, phi), (self.Lf, Lf), (self.Lg, Lg))]
        others = [torch.as_tensor(x) for x in (self.v, self.u_des, self.d_p, self.u_max)]
        rows = BarrierRows(None, torch.as_tensor(self.hdot), *given, None)
        return feasibility(rows, *others, self.config, passive)

    def margin(self, passive: bool, *rows: Any) -> torch.Tensor:
        """What the learner computes, of other rows if they are given."""
        programs = self.programs(passive, *rows)
        margin: torch.Tensor = programs.margin(programs.solve())
        return margin

    def exact(self, passive: bool, demands: bool = True) -> np.ndarray:
        """``max t``, ``t <= offset_k + c_k u`` for all k, u in the box and ``vᵀ(u - u_des) <= d_p``; NaN if empty.

        Without ``demands`` no offset is below zero.
        """
        authority = np.abs(self.Lg) @ self.u_max
        separating = np.maximum(0.0, np.minimum(self.hdot, self.phi))
        allowed = self.config.alpha * (self.phi - self.config.margin) + self.config.fast_alpha * separating
        offset = (self.Lf + allowed) / authority
        offset = offset if demands else np.maximum(offset, 0.0)
        c, p = self.Lg * self.u_max / authority[..., None], self.v * self.u_max
        budget = np.where(passive, (self.v * self.u_des).sum(-1) + self.d_p, np.abs(p).sum(-1))
        return np.array([largest(*state) for state in zip(offset, c, p, budget, strict=True)])


@pytest.mark.parametrize("passive", [True, False])
@pytest.mark.parametrize(("rows", "nv"), [(1, 1), (1, 7), (2, 2), (6, 7), (16, 3)])
def test_the_feasibility_margin_is_exact(rows, nv, passive):
    states = Rows.random(rows, nv, seed=rows + nv)
    exact, margin = states.exact(passive), states.margin(passive).numpy()
    possible = np.isfinite(exact)
    np.testing.assert_allclose(margin[possible], exact[possible], atol=1e-6)
    assert possible[0] and possible.mean() > 0.6
    assert passive or possible.all()
    box = ((states.v * states.u_des).sum(-1) + states.d_p) / (np.abs(states.v) @ states.u_max + 1e-9)
    np.testing.assert_allclose(margin[~possible], box[~possible])  # no passive torque in the box
    assert np.all(margin[~possible] < -1.0)
    Lf, Lg = (torch.as_tensor(x).requires_grad_() for x in (states.Lf, states.Lg))
    states.margin(passive, Lf, Lg).sum().backward()
    assert torch.isfinite(Lf.grad).all() and torch.isfinite(Lg.grad).all()


@pytest.mark.parametrize(("rows", "nv"), [(1, 7), (2, 2), (6, 7)])
def test_the_capability_is_the_margin_where_nothing_is_asked_for(rows, nv):
    states = Rows.random(rows, nv, seed=rows + nv)
    programs = states.programs(passive=True)
    capability, margin = programs.capability().numpy(), states.margin(True).numpy()
    expected = np.maximum(states.exact(passive=False, demands=False), LEAST_CAPABILITY)
    np.testing.assert_allclose(capability, expected, atol=1e-7)
    assert np.all(margin <= capability + 1e-9)
    if rows == 1:
        np.testing.assert_allclose(capability, np.maximum(1.0, 1.0 + programs.offset[:, 0].numpy()))


def test_joints_in_line_that_run_into_their_limits_can_do_little_and_are_asked_for_nothing():
    """The torques of one row are the opposite of the other's: the margin is small, and the reserve is all there is."""
    Lg = np.array([[[1.0, -0.98], [-0.98, 1.0]]]) * 100.0
    at_rest = Rows(np.zeros((1, 2)), np.zeros((1, 2)), np.zeros((1, 2)), Lg, *np.zeros((2, 1, 2)), np.zeros(1),
                   np.ones(2), FilterConfig(alpha=3.0, margin=0.0, dt=0.1))  # fmt: skip
    margin, capability = float(at_rest.margin(True)), float(at_rest.programs(True).capability())
    assert margin == pytest.approx(0.02 / 1.98) and capability == pytest.approx(margin)
    hard = dataclasses.replace(at_rest, Lf=np.full((1, 2), -1.0))  # half of what there is
    assert float(hard.margin(True)) / capability == pytest.approx(0.5)


def test_the_passivity_row_counts_where_it_is_asked_for():
    states = Rows.random(4, 3, seed=8)
    with_, without = (states.margin(p).numpy() for p in (True, False))
    assert np.all(with_ <= without + 1e-9) and np.any(with_ < without - 1e-3)
    assert with_[0] == pytest.approx(without[0])  # at rest any torque is passive


@pytest.mark.parametrize("passive", [True, False])
@pytest.mark.parametrize("rows", [1, 2, 5])
def test_the_gradient_of_the_feasibility_margin(rows, passive):
    """By finite differences; phi is a level that the margin must not move."""
    states = Rows.random(rows, 3, seed=5, count=20)
    phi, Lf, Lg = (torch.as_tensor(x).requires_grad_() for x in (states.phi, states.Lf, states.Lg))
    possible = torch.as_tensor(np.isfinite(states.exact(passive)))
    assert possible.double().mean() > 0.6
    assert torch.autograd.gradcheck(
        lambda Lf, Lg: states.margin(passive, Lf, Lg)[possible], (Lf, Lg), eps=1e-7, atol=1e-5
    )
    states.margin(passive, Lf, Lg, phi).sum().backward()
    assert phi.grad is None
    assert torch.all(Lg.grad[possible].abs().sum((-1, -2)) > 0.0)
    np.testing.assert_allclose((Lf.grad > 0.0).sum(-1)[possible] >= 1, True)


@pytest.mark.parametrize(("passive", "strength"), [(True, 0.1), (False, 0.01)])
def test_the_margin_is_negative_exactly_where_the_runtime_filter_has_no_answer(
    problem, random_network, monkeypatch, passive, strength
):
    """On uniform band states of a random steep network, with weak motors, so that both are common."""
    model = problem.model
    monkeypatch.setattr(model, "u_max", strength * model.u_max)
    network = random_network("convex", model.nq, model.nv, seed=1)
    for name in ("W0", "Wb"):
        network.params[name] *= 5.0
    barrier, config = problem.barrier("pp-ncbf", network), FilterConfig()
    q, v, _ = uniform_band(problem, barrier, 150, np.random.default_rng(0), 20_000)
    arrays, _, free = rays_at(problem, q, v, 1000)
    assert free.all()
    rays = Rays(**to_tensors([arrays], CPU, DOUBLE))
    s = torch.as_tensor(np.linalg.norm(v, axis=1) / np.linalg.norm(arrays["d"], axis=1))
    band = Band(problem, "convex", config, passive, CPU, DOUBLE)
    margin = band.margin(tensors(network.params), rays, s)
    runtime = SafetyFilter(model, problem.safety, barrier, config)
    failed = np.zeros(len(q), dtype=bool)
    for i in range(len(q)):
        dyn = model.evaluate(q[i], v[i])
        nominal = problem.robot.controller.evaluate(dyn)
        result = runtime.filter(dyn, nominal.u, float(nominal.d_p) if passive else None)
        failed[i] = result.status >= Status.PASSIVITY_DROPPED
    clear = margin.abs().numpy() > 1e-5
    assert clear.mean() > 0.95
    np.testing.assert_array_equal((margin.numpy() < 0.0)[clear], failed[clear])
    assert failed.any() and not failed.all()


def test_near_rest_the_band_asks_for_no_passivity(two_link, random_network):
    """No torque of the box has more power there than is free."""
    params = tensors(random_network("convex", 2, 2).params)
    rays = make_rays(two_link, 300)
    with_, without = (Band(two_link, "convex", FilterConfig(), passive, CPU, DOUBLE) for passive in (True, False))
    slow = 0.4 * with_.free_power / (rays.d.abs() * with_.u_max).sum(-1)
    torch.testing.assert_close(with_.margin(params, rays, slow), without.margin(params, rays, slow))
    fast = torch.full((len(rays),), 0.9, dtype=DOUBLE)
    assert not torch.equal(with_.margin(params, rays, fast), without.margin(params, rays, fast))


# Passivity by construction


@tries(max_examples=60)
@given(nv=st.integers(2, 8), seed=st.integers(0, 2**32 - 1))
def test_convex_weights_take_energy_out_on_the_boundary(nv, seed):
    """``v · w_k <= -gamma h_k`` on ``phi_k = 0``, for any weights, number of joints and rows with ``h_k >= 0``.

    With a share of the kinetic energy or without.
    """
    rng, count, rows = np.random.default_rng(seed), 40, 6
    params = random_convex(nv, nv, (16, 16), 5, rng)
    params |= {k: x * rng.uniform(0.5, 8.0) for k, x in params.items() if k[0] in "Wb" and k not in ("Wa", "ba")}
    params |= {"ba": rng.normal(0.0, 3.0, 5), "v_scale": rng.uniform(0.2, 3.0, nv)}
    network, gamma = NumpyNetwork("convex", params), float(rng.uniform(0.5, 20.0))
    q, v = rng.uniform(-3.0, 3.0, (count, nv)), rng.normal(0.0, 2.0, (count, nv))
    A = rng.normal(size=(count, nv, nv))
    Minv = A @ A.transpose(0, 2, 1) + 0.1 * np.eye(nv)
    K, _, K_v = network.value_and_grad(q, v)
    energy, Mv = rng.uniform(0.0, 3.0) * (rng.random() < 0.7), np.linalg.solve(Minv, v[..., None])[..., 0]
    K, K_v = K + 0.5 * energy * (v * Mv).sum(-1), K_v + energy * Mv
    assert np.all(K >= -1e-12)
    h = rng.uniform(0.0, 1.0, (count, rows)) * (rng.random((count, rows)) < 0.8)
    grad = rng.normal(size=(count, rows, nv))
    missing = K[:, None] - gamma * h - (grad @ v[..., None])[..., 0]  # of ḣ, for phi = 0
    grad += missing[..., None] * v[:, None] / (v * v).sum(-1)[:, None, None]
    hdot = (grad @ v[..., None])[..., 0]
    b, zero = rng.normal(size=(count, nv)), np.zeros(count)
    found = rho_rows(h, hdot, grad, np.zeros_like(h), Minv, b, gamma, K, zero, K_v)
    scale = 1.0 + np.abs(K)[:, None] + gamma * h
    assert np.all(np.abs(found.phi) <= 1e-9 * scale)
    assert np.all((found.w @ v[..., None])[..., 0] <= -gamma * h + 1e-9 * scale)
    multipliers = rng.exponential(size=(count, rows))
    power = (multipliers[..., None] * found.w * v[:, None]).sum((-1, -2))
    assert np.all(power <= -gamma * (multipliers * h).sum(-1) + 1e-8 * scale.max(-1))
