"""Tangents of K at the end of a control period: exact there, never too strict, and used by the QP where they matter."""

from __future__ import annotations

import numpy as np
import pytest

from ppcbf_robots import qp_filter
from ppcbf_robots.cutting_planes import EndOfPeriod
from ppcbf_robots.filters import FilterConfig, Status
from ppcbf_robots.qp_filter import QPFilter

DT = 1e-3


def state(problem, barrier, q, v):
    dyn = problem.model.evaluate(q, v)
    safety = problem.safety.evaluate(dyn)
    return dyn, safety, barrier.rows(dyn, safety)


def rise(network, dyn, u):
    """Change of K over one period at a fixed q, divided by it."""
    end = dyn.v + DT * dyn.Minv @ (u - dyn.b)
    K, K_end = (network.value(dyn.q, v) + 0.5 * network.energy * v @ dyn.M @ v for v in (dyn.v, end))
    return (K_end - K) / DT


def test_the_tangent_touches_K_at_the_end_of_the_period_and_lies_below_it_elsewhere(problem, states, make_barrier):
    barrier, rng = make_barrier(problem, "pp-ncbf-convex"), np.random.default_rng(0)
    u_max = problem.model.u_max
    for q, v in states(problem, 40):
        dyn, _, rows = state(problem, barrier, q, v)
        u, other = rng.uniform(-1.0, 1.0, (2, problem.model.nv)) * u_max
        tangent = EndOfPeriod(barrier.network, dyn, DT).tangent(u)
        short, cut = tangent.short, tangent.of(rows, np.arange(len(rows.phi)))
        slope = barrier.network.value_and_grad(q, v)[2] + barrier.network.energy * dyn.M @ v

        def true_psi(torque, dyn=dyn, rows=rows, slope=slope):
            linear = slope @ dyn.Minv @ (torque - dyn.b)
            return rows.psi(torque) + linear - rise(barrier.network, dyn, torque)

        scale = 1e-6 * (1.0 + np.abs(rows.psi(u)).max())
        assert short >= -scale
        np.testing.assert_allclose(rows.psi(u) - short, true_psi(u), atol=scale)
        np.testing.assert_allclose(cut.psi(u), true_psi(u), atol=scale)
        assert np.all(cut.psi(other) >= true_psi(other) - scale)
        np.testing.assert_allclose(cut.w @ dyn.Minv, cut.Lg_phi, atol=1e-9 * np.abs(cut.Lg_phi).max())


def falls_short(problem, barrier, config, count, reach=None, given_up=False):
    """By how much each correction lets a row fall short by the end of the period [m/s²], with K's true rise.

    ``reach`` limits the rate: torques stay within that share of u_max about gravity. ``given_up`` looks at corrections
    that leave the velocity domain, not at those that keep it.
    """
    domain, u_max, rng, found = problem.robot.domain, problem.model.u_max, np.random.default_rng(1), []
    runtime = QPFilter(barrier, problem.safety, config, None if reach is None else reach * u_max / config.dt)
    for angles, v in zip(domain.sample_q(rng, count), 0.03 * domain.sample_v(rng, count), strict=True):
        dyn, safety, rows = state(problem, barrier, problem.model.from_angles(angles), v)
        if not 0.0 <= rows.phi.min() <= 0.3:
            continue
        u_des = dyn.g + rng.uniform(-0.5, 0.5, problem.model.nv) * u_max
        allowed = None
        if reach is not None:
            allowed = np.maximum(dyn.g - reach * u_max, -u_max), np.minimum(dyn.g + reach * u_max, u_max)
        answer = runtime.correct(dyn, safety, rows, u_des, None, u_max, allowed)
        assert -1 <= answer.row < len(problem.safety.names)
        if allowed is not None:
            assert np.all(answer.u >= allowed[0]) and np.all(answer.u <= allowed[1])
        if answer.status is Status.CORRECTING and ("given up" in answer.reason) == given_up:
            short = EndOfPeriod(barrier.network, dyn, config.dt).tangent(answer.u).short
            assert answer.short == short
            separating = np.maximum(0.0, np.minimum(rows.hdot, rows.phi))
            bound = config.alpha * (rows.phi - config.margin) + config.fast_alpha * separating
            bound += config.alpha * np.maximum(0.0, rows.phi - config.margin)  # what is tolerated far from phi = 0
            found.append(short - float((rows.psi(answer.u) + bound).min()))
    return np.array(found)


@pytest.mark.parametrize("case", [{}, {"reach": 0.3}, {"given_up": True}], ids=str)
def test_corrections_keep_the_rows_with_the_K_that_the_period_ends_with(two_link, make_barrier, monkeypatch, case):
    """With tangents, up to what the margin covers; without them, K's kink lets rows fall short by far more."""
    barrier, config = make_barrier(two_link, "pp-ncbf-convex"), FilterConfig()
    barrier.network.params |= {"cone_a": np.array(0.0), "cone_c": np.array(-8.0)}  # a sharp kink at rest
    if "given_up" in case:  # a velocity domain that no torque leads to
        monkeypatch.setattr(two_link.safety, "v_domain", np.array([[1.0, 2.0]] * 2))
    tolerated = qp_filter.SHORT * config.alpha * config.margin
    found = falls_short(two_link, barrier, config, 600, **case)
    monkeypatch.setattr(qp_filter, "CUTS", 0)
    without = falls_short(two_link, barrier, config, 600, **case)
    assert len(found) > 20
    assert np.mean(found > 1.1 * tolerated) < 0.1 < 0.2 < np.mean(without > 1.1 * tolerated)


def test_a_desired_torque_passes_only_if_the_rows_hold_to_the_end_of_the_period(two_link, make_barrier, monkeypatch):
    """One state and a batch agree; without the look at the end, some torques pass under which a row falls short."""
    barrier, config, model = make_barrier(two_link, "pp-ncbf-convex"), FilterConfig(), two_link.model
    barrier.network.params |= {"cone_a": np.array(0.0), "cone_c": np.array(-8.0)}  # a sharp kink at rest
    runtime, rng, domain = QPFilter(barrier, two_link.safety, config), np.random.default_rng(3), two_link.robot.domain
    q, v = model.from_angles(domain.sample_q(rng, 1500)), 0.03 * domain.sample_v(rng, 1500)
    dyn = model.evaluate_batch(q, v)
    u_des = dyn.g + rng.uniform(-0.5, 0.5, v.shape) * model.u_max
    rows = barrier.rows(dyn, two_link.safety.evaluate(dyn))
    passes, short = runtime.passes(dyn, rows, u_des, model.u_max)
    wrong = 0
    for i in np.flatnonzero(rows.h.min(axis=1) > 0.0):
        one, safety, at = state(two_link, barrier, q[i], v[i])
        answer = runtime.correct(one, safety, at, u_des[i], None, model.u_max)
        assert passes[i] == (answer.status is Status.FREE)
        if passes[i]:
            assert short[i] == pytest.approx(answer.short, rel=1e-6, abs=1e-9)
        with monkeypatch.context() as patch:
            patch.setattr(qp_filter, "CUTS", 0)
            wrong += (
                runtime.correct(one, safety, at, u_des[i], None, model.u_max).status is Status.FREE and not passes[i]
            )
    assert passes.sum() > 100 and wrong > 5
