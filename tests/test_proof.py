"""Bounds on boxes hold at every state of the box; a proof ends, and ends right."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linprog

from ppcbf_robots.artefact import load_barrier, save_barrier
from ppcbf_robots.band_statistics import independent_band
from ppcbf_robots.derive import Domain
from ppcbf_robots.errors import CheckFailed, InputError
from ppcbf_robots.filters import FilterConfig, free_power
from ppcbf_robots.learning.falsifier import no_network
from ppcbf_robots.network import NumpyNetwork
from ppcbf_robots.plant import perturbed
from ppcbf_robots.problem import load_problem
from ppcbf_robots.proof import affine, network_bounds
from ppcbf_robots.proof.boxes import OFF_BAND, PROVED, BoxJudge
from ppcbf_robots.proof.branch_and_bound import load_search
from ppcbf_robots.proof.model import row_program
from ppcbf_robots.proof.prove import prove, state_name
from ppcbf_robots.proof.witness import best_torque, least

S = 3  # symbols of the random forms
number = st.floats(-3.0, 3.0).filter(lambda x: x == 0.0 or abs(x) > 1e-90)  # cubes of others underflow
small = st.one_of(st.just(0.0), st.floats(-0.7, 0.7))
form = st.tuples(number, small, small, small, st.floats(0.0, 0.3)).map(lambda x: np.array(x))
L = np.longdouble


def sigmoid(x):
    return 1 / (1 + np.exp(-x))


ONE = {
    "sin": (affine.sin, np.sin),
    "cos": (affine.cos, np.cos),
    "elu": (affine.elu, lambda x: np.where(x > 0, x, np.expm1(np.minimum(x, 0)))),
    "elu_slope": (affine.elu_slope, lambda x: np.exp(np.minimum(x, 0))),
    "softplus": (affine.softplus, lambda x: np.log1p(np.exp(x))),
    "sigmoid": (affine.sigmoid, sigmoid),
    "inverse": (affine.inverse, lambda x: 1 / x),
    "sqrt": (affine.sqrt, np.sqrt),
}
TWO = {"mul": (affine.mul, np.multiply), "divided": (affine.divided, np.divide)}


def members(a, e, rest):
    """Values that a form allows: at symbols e (n, S), with its remainder used up to the share ``rest`` (n,)."""
    return L(a[0]) + L(e) @ L(a[1:-1]) + L(rest) * L(a[-1])


def points(seed):
    rng = np.random.default_rng(seed)
    e = rng.uniform(-1.0, 1.0, (64, S))
    return np.concatenate([e, np.sign(e)]), np.sign(rng.uniform(-1.0, 1.0, (128, 2)))


def assert_holds(out, truth, e):
    if np.isfinite(out[-1]):
        assert np.all(
            np.abs(truth - members(out, e, np.zeros(len(e)))) <= L(out[-1]) * (1 + L(1e-15)) + L(1e-18)
        )  # rounding of long doubles


@pytest.mark.parametrize("name", ONE)
@given(a=form, seed=st.integers(0, 99))
def test_a_function_stays_in_its_form(name, a, seed):
    bounded, exact = ONE[name]
    e, rest = points(seed)
    out = np.empty(S + 2)
    bounded(a, out)
    if np.isfinite(out[-1]):
        assert_holds(out, exact(members(a, e, rest[:, 0])), e)
    else:
        assert affine.low(a) <= 0.0 and name in ("inverse", "sqrt")
    bounded(a, a)  # in place
    np.testing.assert_array_equal(a, out)


@pytest.mark.parametrize("name", TWO)
@given(a=form, b=form, seed=st.integers(0, 99))
def test_an_operation_stays_in_its_form(name, a, b, seed):
    bounded, exact = TWO[name]
    e, rest = points(seed)
    out = np.empty(S + 2)
    bounded(a, b, out)
    with np.errstate(divide="ignore", invalid="ignore"):
        assert_holds(out, exact(members(a, e, rest[:, 0]), members(b, e, rest[:, 1])), e)


@given(a=form, b=form, factor=number)
def test_linear_operations_lose_only_rounding(a, b, factor):
    total, product, moved = np.empty(S + 2), np.empty(S + 2), np.empty(S + 2)
    affine.add(a, b, -1.0, total)
    affine.scaled(a, factor, product)
    affine.shifted(a, factor, moved)
    assert 0.0 <= total[-1] - (a[-1] + b[-1]) < 1e-13
    assert 0.0 <= product[-1] - abs(factor) * a[-1] < 1e-13
    assert 0.0 <= moved[-1] - a[-1] < 1e-13


def boxed(x, radii):
    """Forms of coordinates x (n,) with radii (n,)."""
    forms = np.zeros((len(x), len(x) + 2))
    forms[:, 0] = x
    forms[np.arange(len(x)), 1 + np.arange(len(x))] = radii
    return forms


@pytest.mark.parametrize("size", [1e-3, 0.03, 0.2])
@pytest.mark.parametrize("robot", ["cartpole", "kinova"])
def test_the_network_stays_in_its_forms(problems, random_network, robot, size):
    """kinova has continuous joints, which the layers see as cosine and sine."""
    model = problems[robot].model
    network = random_network("convex", model.nq, model.nv, seed=5)
    turns = np.zeros(model.nq)
    turns[model.idx_q[model.revolute]] = 1.0
    network.params["turns"] = turns
    net, nv, rng = network_bounds.pack(network, model), model.nv, np.random.default_rng(1)
    for _ in range(10):
        x, radii = rng.uniform(-1.5, 1.5, 2 * nv), size * rng.uniform(0.2, 1.0, 2 * nv)
        state = boxed(x, radii)
        head = network_bounds.heads(boxed(x[:nv], radii[:nv]), net)
        K, rate, K_v = np.empty(2 * nv + 2), np.empty(2 * nv + 2), np.empty((nv, 2 * nv + 2))
        network_bounds.bounds(head, np.ascontiguousarray(state[nv:]), net, K, rate, K_v)
        e = rng.uniform(-1.0, 1.0, (60, 2 * nv))
        e[::2] = np.sign(e[::2])
        q, v = model.from_angles((x + radii * e)[:, :nv]), (x + radii * e)[:, nv:]
        value, K_q, slope = network.value_and_grad(q, v)
        q_rate = np.array([model.q_rate(a, b) for a, b in zip(q, v, strict=True)])
        for bound, truth in [(K, value), (rate, (K_q * q_rate).sum(-1)), *zip(K_v, slope.T, strict=True)]:
            miss = np.abs(truth - bound[0] - e @ bound[1:-1])
            assert np.all(miss <= bound[-1] + 1e-12 * (1.0 + np.abs(truth)))
            if size == 1e-3:
                assert bound[-1] < 1e-2  # says something


@pytest.mark.parametrize("robot", ["cartpole", "two_link", "panda"])
@pytest.mark.parametrize("size", [0.0, 0.01])
def test_rows_stay_in_their_forms(problems, robot, size):
    """The three controllers of these robots are of three kinds."""
    problem = problems[robot]
    model, gamma, nv = problem.model, problem.robot.spec.barrier.gamma, problem.model.nv
    program, rng = row_program(problem), np.random.default_rng(2)
    for q, v in zip(problem.robot.domain.sample_q(rng, 12), problem.robot.domain.sample_v(rng, 12), strict=True):
        x, radii = np.concatenate([q, v]), size * rng.uniform(0.2, 1.0, 2 * nv)
        forms = program(boxed(x, radii))
        for e in rng.uniform(-1.0, 1.0, (10, 2 * nv)):
            y = x + radii * e
            dyn = model.evaluate(model.from_angles(y[:nv]), y[nv:])
            s, a0 = problem.safety.evaluate(dyn), -dyn.Minv @ dyn.b
            hdot, u_rest = s.hdot(dyn.v), problem.robot.controller.u_rest(dyn.q, dyn.g)
            rows = np.column_stack([s.h, hdot, s.curvature + gamma * hdot + s.grad @ a0, s.grad @ dyn.Minv])
            truth = np.concatenate([rows.ravel(), dyn.Minv.ravel(), a0, [dyn.v @ u_rest], u_rest])
            said = np.isfinite(forms[:, -1])
            miss = np.abs(truth - forms[:, 0] - forms[:, 1:-1] @ e)[said]
            assert np.all(miss <= forms[said, -1] + 1e-9 * (1.0 + np.abs(truth[said])))
            assert said.all() or nv > 2  # on a box of 14 dimensions little can be said
            assert size or np.all(forms[:, -1] < 1e-6 * (1.0 + np.abs(truth)))


def test_rows_stay_in_their_forms_whatever_the_links_weigh(problems):
    problem, size, nv = problems["two_link"], 0.01, 2
    model, program, rng = problem.model, row_program(problem, with_densities=True), np.random.default_rng(2)
    for q, v in zip(problem.robot.domain.sample_q(rng, 12), problem.robot.domain.sample_v(rng, 12), strict=True):
        x, radii = np.concatenate([q, v, np.ones(nv)]), np.append(np.full(2 * nv, size), np.full(nv, 0.2))
        forms = program(boxed(x, radii))
        for e in rng.uniform(-1.0, 1.0, (10, 3 * nv)):
            y = x + radii * e
            robot = perturbed(model, mass=y[2 * nv :], inertia=y[2 * nv :])
            dyn = robot.evaluate(y[:nv], y[nv : 2 * nv])
            s = problem.safety.evaluate(dyn)
            Lg = s.grad @ dyn.Minv
            truth = np.concatenate([np.column_stack([Lg, dyn.Minv[None, 0].repeat(len(Lg), 0)]).ravel()])
            rows = forms[: len(Lg) * (3 + nv)].reshape(len(Lg), 3 + nv, -1)
            Minv = forms[len(Lg) * (3 + nv) :][:nv]
            found = np.concatenate([rows[:, 3:], np.broadcast_to(Minv, (len(Lg), *Minv.shape))], axis=1)
            found = found.reshape(-1, found.shape[-1])
            miss = np.abs(truth - found[:, 0] - found[:, 1:-1] @ e)
            assert np.all(miss <= found[:, -1] + 1e-9 * (1.0 + np.abs(truth)))
            a0 = forms[len(Lg) * (3 + nv) + nv * nv :][:nv]
            miss = np.abs(-dyn.Minv @ dyn.b - a0[:, 0] - a0[:, 1:-1] @ e)
            assert np.all(miss <= a0[:, -1] + 1e-9)


def test_the_best_torque_is_that_of_a_linear_program():
    rng = np.random.default_rng(3)
    for _ in range(150):
        m = int(rng.integers(1, 6))
        A, B, u_max = 3.0 * rng.normal(size=m), rng.normal(size=(m, 2)), np.array([2.0, 3.0])
        weight = np.where(rng.random(m) < 0.2, 0.0, rng.uniform(0.1, 1.0, m))
        weight[0] = 1.0
        u = np.zeros(2)
        t = best_torque(A, B, weight, m, u_max, u)
        bounds = [(-2.0, 2.0), (-3.0, 3.0), (None, None)]
        expected = linprog([0.0, 0.0, -1.0], np.column_stack([-B, weight]), A, bounds=bounds)
        assert (expected.status == 0) == np.isfinite(t)
        if np.isfinite(t):
            assert t == pytest.approx(expected.x[2], abs=1e-7)
            assert np.all(A + B @ u - t * weight >= -1e-7) and np.all(np.abs(u) <= u_max)


def test_the_least_value_on_the_band_is_that_of_a_linear_program():
    rng, epsilon = np.random.default_rng(4), 0.3
    for _ in range(150):
        f, phi = rng.normal(size=6), rng.normal(size=6)
        f[-1], phi[-1] = abs(f[-1]) * 0.1, abs(phi[-1]) * 0.1
        value, _ = least(f, phi, True, True, epsilon)
        A = np.array([phi[1:-1], -phi[1:-1]])
        bound = [epsilon - phi[0] + phi[-1], phi[0] + phi[-1]]
        expected = linprog(f[1:-1], A, bound, bounds=[(-1.0, 1.0)] * 4)
        if expected.status == 0:
            assert value == pytest.approx(f[0] - f[-1] + expected.fun, abs=1e-7)
            assert least(f, phi, True, False, epsilon)[0] <= value + 1e-12  # knowing less


def small_problem(effort=None, q=((1.1, 1.5), (-0.4, 0.4)), v=((0.8, 3.0), (-1.5, 1.5))):
    """The cart-pole before its wall, X a small part of its own; with other force limits if wanted."""
    problem = load_problem("cartpole", "wall")
    problem.model.u_max[:] = problem.model.u_max if effort is None else effort
    robot = dataclasses.replace(problem.robot, domain=Domain(np.array(q), np.array(v)))
    return dataclasses.replace(problem, robot=robot)


def stored(problem, folder, network=None):
    params = no_network(problem) if network is None else network.params
    save_barrier(folder, problem, "pp-ncbf", "convex", params, FilterConfig(), {})
    return load_barrier(folder)


def feasible(problem, barrier, x, config, passive=True):
    """Whether some torque in the box satisfies all rows, by scipy's linear program on the runtime's own rows."""
    nv = problem.model.nv
    dyn = problem.model.evaluate(problem.model.from_angles(x[:nv]), x[nv:])
    rows = barrier.rows(dyn, problem.safety.evaluate(dyn))
    nominal = problem.robot.controller.evaluate(dyn)
    separating = config.fast_alpha * np.maximum(0.0, np.minimum(rows.hdot, rows.phi))
    A, b = -rows.Lg_phi, rows.Lf_phi + config.alpha * (rows.phi - config.margin) + separating
    if passive:
        A, b = np.vstack([A, dyn.v]), np.append(b, dyn.v @ nominal.u + nominal.d_p + free_power(problem.model))
    return linprog(np.zeros(nv), A, b + 1e-9, bounds=[(-u, u) for u in problem.model.u_max]).status == 0


def on_band(problem, barrier, x):
    nv = problem.model.nv
    dyn = problem.model.evaluate(problem.model.from_angles(x[:nv]), x[nv:])
    safety = problem.safety.evaluate(dyn)
    return safety.h.min() >= 0.0 and 0.0 <= barrier.rows(dyn, safety).phi.min() <= barrier.spec.epsilon


@pytest.mark.parametrize("effort", [25.0, 6.0])
def test_verdicts_hold_at_every_state_of_a_box(random_network, effort):
    problem = small_problem(effort)
    network = mild_network(random_network)
    barrier, config = problem.barrier("pp-ncbf", network), FilterConfig()
    judge, rng = BoxJudge(problem, network, config, 0.0), np.random.default_rng(0)
    low = rng.uniform(judge.low, judge.high, (4000, 4))
    high = np.minimum(judge.high, low + rng.uniform(0.0, 0.06, (4000, 1)) * (judge.high - judge.low))
    found = judge(np.stack([low, high], 1), np.ones(4000, np.bool_))
    proved, off = np.flatnonzero(found.status == PROVED), np.flatnonzero(found.status == OFF_BAND)
    assert len(proved) > 20 and len(off) > 1000
    for b in [*proved[:100], *off[:100]]:
        for x in rng.uniform(low[b], high[b], (10, 4)):
            if on_band(problem, barrier, x):
                assert found.status[b] == PROVED
                assert feasible(problem, barrier, x, config)
                dyn = problem.model.evaluate(x[:2], x[2:])
                rows = barrier.rows(dyn, problem.safety.evaluate(dyn))
                near = rows.phi <= barrier.spec.epsilon
                assert np.all(np.linalg.norm(rows.Lg_phi[near], axis=-1) >= found.Lg[b] - 1e-12)


def mild_network(random_network):
    """A K that takes away some of the safe set, not all."""
    network = random_network("convex", 2, 2, seed=1)
    network.params |= {"ba": network.params["ba"] - 3.0, "cone_a": np.array(-4.0), "bowl_a": np.array(-4.0)}
    return network


def test_a_proof_ends_and_goes_on_after_a_stop(tmp_path, random_network):
    problem = small_problem()
    barrier = stored(problem, tmp_path, mild_network(random_network))
    shares = []
    whole = prove(problem, barrier, tmp_path, 0.0, 1, 600.0, lambda s: shares.append(s.share))
    assert whole.complete and not (tmp_path / state_name()).exists()
    assert {name: c.verdict for name, c in whole.conditions.items()} == dict.fromkeys(
        ("feasibility", "passivity", "boundary_passivity", "Lg_phi"), "proved"
    )
    assert shares == sorted(shares) and shares[-1] == 1.0
    assert whole.conditions["feasibility"].bound == 0.0
    q, v, _ = independent_band(problem, barrier.barrier(problem), 200, np.random.default_rng(0))
    for x in np.concatenate([q, v], axis=1):
        assert feasible(problem, barrier.barrier(problem), x, FilterConfig())

    judged = []
    while not judged or (tmp_path / state_name()).exists():
        part = prove(problem, barrier, tmp_path, 0.0, 1, 1e-9, lambda s: judged.append(s.judged))
        assert part.complete or part.conditions["feasibility"].verdict == "undecided"
        assert part.complete or part.conditions["Lg_phi"].bound is None
    assert len(judged) > 2  # one round each time
    assert part.search.judged == whole.search.judged and part.search.Lg == whole.search.Lg
    assert part.conditions == whole.conditions


@pytest.mark.parametrize("learned", [False, True])
def test_a_planted_violation_is_never_certified(tmp_path, random_network, learned):
    """Too little force: states come back that an independent program finds to have no torque."""
    problem = small_problem(6.0)
    saved = stored(problem, tmp_path, mild_network(random_network) if learned else None)
    proof = prove(problem, saved, tmp_path, 0.0, 1, 20.0, lambda s: None)
    barrier = saved.barrier(problem)
    assert proof.conditions["feasibility"].verdict == "refuted" and proof.search.infeasible
    for x in proof.search.infeasible[:50]:
        assert on_band(problem, barrier, x)
        assert not feasible(problem, barrier, x, FilterConfig(), passive=False)
    for x in proof.search.impassive[:50]:
        assert on_band(problem, barrier, x) and not feasible(problem, barrier, x, FilterConfig())


def serves_all(problem, barrier, x, config, mass_error, passive):
    """Whether one torque satisfies the rows of robots with links as light, as heavy, and anything between, by scipy."""
    nv, A, b = problem.model.nv, [], []
    rng = np.random.default_rng(0)
    draws = [*itertools.product((-1.0, 1.0), repeat=nv), *rng.uniform(-1.0, 1.0, (10, nv))]
    for draw in draws:
        factors = 1.0 + mass_error * np.array(draw)
        dyn = perturbed(problem.model, mass=factors, inertia=factors).evaluate(x[:nv], x[nv:])
        rows = barrier.rows(dyn, problem.safety.evaluate(dyn))
        separating = config.fast_alpha * np.maximum(0.0, np.minimum(rows.hdot, rows.phi))
        A.append(-rows.Lg_phi)
        b.append(rows.Lf_phi + config.alpha * (rows.phi - config.margin) + separating)
    if passive:
        nominal = problem.robot.controller.evaluate(problem.model.evaluate(x[:nv], x[nv:]))
        A.append(x[None, nv:])
        b.append(np.array([x[nv:] @ nominal.u + nominal.d_p + free_power(problem.model)]))
    bounds = [(-u, u) for u in problem.model.u_max]
    return linprog(np.zeros(nv), np.vstack(A), np.concatenate(b) + 1e-9, bounds=bounds).status == 0


def test_a_proof_for_all_masses_within_an_interval(tmp_path, random_network):
    """One torque for all of them: proved at 3 %; at 20 %, and with little force, refuted."""
    problem = small_problem()
    saved = stored(problem, tmp_path, mild_network(random_network))
    barrier, config = saved.barrier(problem), FilterConfig()
    proof = prove(problem, saved, tmp_path, 0.0, 1, 600.0, lambda s: None, 0.03)
    assert proof.complete and {c.verdict for c in proof.conditions.values()} == {"proved"}
    assert "lighter by up to 3 %" in proof.conditions["feasibility"].statement
    q, v, _ = independent_band(problem, barrier, 100, np.random.default_rng(0))
    assert all(serves_all(problem, barrier, x, config, 0.03, True) for x in np.concatenate([q, v], axis=1))

    weak = small_problem(7.5)
    saved = stored(weak, tmp_path, mild_network(random_network))
    refuted = prove(weak, saved, tmp_path, 0.0, 1, 10.0, lambda s: None, 0.2)
    assert refuted.conditions["feasibility"].verdict == "refuted" and refuted.search.infeasible
    for x in refuted.search.infeasible[:30]:
        assert on_band(weak, barrier, x) and not serves_all(weak, barrier, x, config, 0.2, passive=False)


def test_boxes_that_are_proved_for_the_model_alone_are_not_for_other_masses(random_network):
    weak, network, config = small_problem(7.5), mild_network(random_network), FilterConfig()
    barrier, rng = weak.barrier("pp-ncbf", network), np.random.default_rng(0)
    q, v, _ = independent_band(weak, barrier, 600, rng)
    states = [x for x in np.concatenate([q, v], axis=1) if not serves_all(weak, barrier, x, config, 0.2, False)]
    boxes, rows = np.array([[x - 1e-5, x + 1e-5] for x in states]), np.zeros(len(states), np.bool_)
    alone, among = (BoxJudge(weak, network, config, 0.0, share)(boxes, rows) for share in (0.0, 0.2))
    assert np.sum(alone.status == PROVED) >= 2 and not np.any(among.status == PROVED)
    assert among.suspect.all()


def test_a_separating_pair_that_the_spring_pulls_back_lacks_passivity(tmp_path):
    """Without the power that the filter allows itself it cannot be proved; with it it can."""
    problem = small_problem(q=((1.4, 1.5), (0.4, 0.8)), v=((-0.2, 0.5), (-0.2, 0.2)))
    saved = stored(problem, tmp_path)
    strict = prove(problem, saved, tmp_path, -free_power(problem.model), 1, 10.0, lambda s: None)
    assert strict.conditions["feasibility"].verdict != "refuted"
    assert strict.conditions["passivity"].verdict != "proved" and strict.conditions["passivity"].bound > 0.0
    (tmp_path / state_name()).unlink(missing_ok=True)
    allowed = prove(problem, saved, tmp_path, 0.0, 1, 60.0, lambda s: None)
    assert {allowed.conditions[name].verdict for name in ("feasibility", "passivity")} == {"proved"}


def test_an_empty_band_proves_nothing(tmp_path, random_network):
    problem, network = small_problem(), random_network("convex", 2, 2, seed=1)
    network.params["ba"] += 20.0  # K swallows the safe set
    with pytest.raises(CheckFailed, match="on the band"):
        prove(problem, stored(problem, tmp_path, network), tmp_path, 0.0, 1, 60.0, lambda s: None)


def test_the_state_of_another_proof_is_left_alone_and_garbage_refused(tmp_path):
    problem = small_problem()
    prove(problem, stored(problem, tmp_path), tmp_path, 0.0, 1, 1e-9, lambda s: None)
    assert load_search(tmp_path / state_name(), "another") is None
    (tmp_path / state_name()).write_bytes(b"garbage")
    with pytest.raises(InputError, match="remove it"):
        load_search(tmp_path / state_name(), "another")


def test_a_network_without_units_is_the_lb_barrier():
    problem = load_problem("cartpole", "wall")
    network = NumpyNetwork("convex", no_network(problem))
    head = network_bounds.heads(boxed(np.ones(2), np.zeros(2)), network_bounds.pack(network, problem.model))
    assert head.shape == (3, 0, 4)
