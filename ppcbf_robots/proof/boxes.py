"""The verdict on boxes of states: off the band, proved by a torque that serves the whole box, or to be cut in two."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ppcbf_robots.filters import FilterConfig, free_power
from ppcbf_robots.kernels import exact_kernel
from ppcbf_robots.network import NumpyNetwork
from ppcbf_robots.problem import Problem
from ppcbf_robots.proof import affine, network_bounds
from ppcbf_robots.proof.model import row_program, run
from ppcbf_robots.proof.witness import JOINTS, best_torque, least, point_on_band
from ppcbf_robots.specs import Array

OPEN, OFF_BAND, PROVED = 0, 1, 2
LEAST_SHARE = 0.5  # of |L_g phi| at a box's centre that its bound has to reach: smaller boxes raise the reported bound
CLEAR = 0.5  # of a constraint's reach in the torque box that its remainder may take up where a point is judged
FAIL = -1e-9  # least slack of a torque at a point, below which the point may be a counterexample


@dataclass(frozen=True)
class Verdicts:
    """What was found out about B boxes."""

    status: NDArray[np.int8]  # (B,) OPEN, OFF_BAND or PROVED
    cut: NDArray[np.int64]  # (B,) coordinate along which an open box should be cut
    Lg: Array  # (B,) lower bound of |L_g phi| of the rows in the band, of proved boxes; else infinite
    suspect: NDArray[np.bool_]  # (B,) whether no torque was found at ``point``
    excess: Array  # (B,) [W] by which every torque at ``point`` that suits the other rows breaks passivity; else 0
    point: Array  # (B, 2 nv) a state of the box, on the band as far as can be told


class BoxJudge:
    """Judges boxes of one problem and barrier.

    Args:
        problem: of one or two joints, with the barrier's constants.
        network: convex form of K_theta.
        config: the QP filter.
        power: [W] that the passivity row is given beyond what the filter allows itself.
        mass_error: largest share by which each link may be heavier or lighter than the model's, mass and inertia by the
            same factor. The one torque that a box needs then serves all; they are symbols that are never cut.

    Raises:
        InputError: for obstacles that have no symbolic form.
    """

    def __init__(
        self, problem: Problem, network: NumpyNetwork, config: FilterConfig, power: float, mass_error: float = 0.0
    ) -> None:
        model, spec, domain = problem.model, problem.robot.spec.barrier, problem.robot.domain
        assert model.nv <= JOINTS and network.kind == "convex"
        self._program = row_program(problem, with_densities=mass_error > 0.0)
        self._net = network_bounds.pack(network, model)
        self.low = np.concatenate([domain.q[:, 0], domain.v[:, 0]])  # (2 nv,) of X
        self.high = np.concatenate([domain.q[:, 1], domain.v[:, 1]])
        u_max = np.ones(JOINTS)
        u_max[: model.nv] = model.u_max
        self._settings = (problem.safety.rows, spec.gamma, config.alpha, config.margin, spec.epsilon, u_max,
                          free_power(model) + power, 1.0 / (self.high - self.low), config.fast_alpha,
                          model.nv if mass_error > 0.0 else 0, mass_error)  # fmt: skip

    def __call__(self, boxes: Array, passive: NDArray[np.bool_]) -> Verdicts:
        """Verdicts on boxes (B, 2, 2 nv) of lower and upper corners (angles, velocities).

        ``passive`` (B,) says where the passivity row counts.
        """
        count, size = len(boxes), boxes.shape[2]
        found = Verdicts(np.zeros(count, np.int8), np.zeros(count, np.int64), np.full(count, np.inf),
                         np.zeros(count, np.bool_), np.zeros(count), np.zeros((count, size)))  # fmt: skip
        p = self._program
        judge(boxes, passive, p.code, p.constants, p.registers, p.outputs, self._net, self._settings,
              found.status, found.cut, found.Lg, found.suspect, found.excess, found.point)  # fmt: skip
        return found


@exact_kernel
def judge(
    boxes: Any, passive: Any, code: Any, constants: Any, registers: int, outputs: int, net: Any, settings: Any,
    status: Any, cut: Any, Lg: Any, suspect: Any, excess: Any, point: Any,
) -> None:  # fmt: skip
    """Fill the arrays of :class:`Verdicts`; boxes that follow each other with equal q share their layers' bounds."""
    rows, inverse_width, densities, mass_error = settings[0], settings[7], settings[9], settings[10]
    size = boxes.shape[2]
    nv, planes = size // 2, size + densities + 2
    state, positions = np.zeros((size + densities, planes)), np.zeros((nv, nv + 2))
    for i in range(size, size + densities):
        state[i, 0], state[i, 1 + i] = 1.0, mass_error * affine.UP
    work, model = np.empty((registers, planes)), np.empty((outputs, planes))
    phi, A, B = np.empty((rows, planes)), np.empty((rows + 1, planes)), np.zeros((rows + 1, JOINTS, planes))
    known, head = False, np.empty((0, 0, 0))
    for b in range(len(boxes)):
        box = boxes[b]
        known = known and b > 0 and np.array_equal(box[:, :nv], boxes[b - 1, :, :nv])
        for i in range(size):
            state[i] = 0.0
            state[i, 0] = 0.5 * (box[0, i] + box[1, i])
            state[i, 1 + i] = max(box[1, i] - state[i, 0], state[i, 0] - box[0, i]) * affine.UP
        if not known:
            positions[:, : nv + 1], positions[:, nv + 1] = state[:nv, : nv + 1], 0.0
            head, known = network_bounds.heads(positions, net), True
        run(code, constants, state, work, model)
        _rows(model, state, head, net, settings, phi, A, B)
        half = 0.5 * (box[1] - box[0]) * inverse_width
        _decide(b, model, phi, A, B, state, box, half, passive[b], settings, status, cut, Lg, suspect, excess, point)


@exact_kernel
def _rows(model: Any, state: Any, head: Any, net: Any, settings: Any, phi: Any, A: Any, B: Any) -> None:
    """Forms of phi_k, and of A and B such that every constraint on the torque reads ``A_k + B_k u >= 0``.

    Row k is ``psi_k(u) + alpha (phi_k - margin) + fast_alpha max(0, min(ḣ_k, phi_k))``, the last term from below
    and with phi_k >= 0, as it is on the band; the one after the last row ``power + v · (u_rest - u)``.
    """
    rows, gamma, alpha, margin, fast_alpha = settings[0], settings[1], settings[2], settings[3], settings[8]
    nv, planes = (len(state) - settings[9]) // 2, state.shape[1]
    K, K_q_rate, K_v = np.empty(planes), np.empty(planes), np.empty((nv, planes))
    v = state[nv : 2 * nv]
    network_bounds.bounds(head, v, net, K, K_q_rate, K_v)
    Minv, a0, power = rows * (3 + nv), rows * (3 + nv) + nv * nv, rows * (3 + nv) + nv * nv + nv
    form, learned, pushed = np.empty(planes), K_q_rate.copy(), np.zeros((nv, planes))
    for i in range(nv):
        affine.mul(K_v[i], model[a0 + i], form)
        affine.add(learned, form, 1.0, learned)  # ∂K/∂q q̇ - ∂K/∂v M⁻¹ b
        for j in range(nv):
            affine.mul(K_v[i], model[Minv + i * nv + j], form)
            affine.add(pushed[j], form, 1.0, pushed[j])
    for k in range(rows):
        at = k * (3 + nv)
        affine.scaled(model[at], gamma, phi[k])
        affine.add(phi[k], model[at + 1], 1.0, phi[k])
        affine.add(phi[k], K, -1.0, phi[k])
        affine.shifted(phi[k], -margin, form)
        affine.scaled(form, alpha, form)
        affine.add(model[at + 2], learned, -1.0, A[k])
        affine.add(A[k], form, 1.0, A[k])
        least_hdot, least_phi = affine.low(model[at + 1]), max(0.0, affine.low(phi[k]))
        if least_hdot > 0.0 and affine.high(model[at + 1]) <= least_phi:
            affine.scaled(model[at + 1], fast_alpha, form)
            affine.add(A[k], form, 1.0, A[k])
        elif least_hdot > 0.0 and affine.high(phi[k]) <= least_hdot and least_phi > 0.0:
            affine.scaled(phi[k], fast_alpha, form)
            affine.add(A[k], form, 1.0, A[k])
        else:
            affine.shifted(A[k], fast_alpha * max(0.0, min(least_hdot, least_phi)) * (1.0 - 1e-14), A[k])
        for j in range(nv):
            affine.add(model[at + 3 + j], pushed[j], -1.0, B[k, j])
    affine.shifted(model[power], settings[6], A[rows])
    for j in range(nv):
        affine.scaled(v[j], -1.0, B[rows, j])


@exact_kernel
def _decide(
    b: int, model: Any, phi: Any, A: Any, B: Any, state: Any, box: Any, half: Any, passive: bool, settings: Any,
    status: Any, cut: Any, Lg: Any, suspect: Any, excess: Any, point: Any,
) -> None:  # fmt: skip
    """Verdict on box b, with ``half`` its half widths relative to X."""
    rows, epsilon, u_max = settings[0], settings[4], settings[5]
    size, planes, widest = len(half), state.shape[1], np.argmax(half)
    nv = size // 2
    cut[b] = widest
    on_band, only = 0, -1  # rows whose phi may be in the band, and one of them
    for k in range(rows):
        if affine.high(phi[k]) < 0.0 or affine.high(model[k * (3 + nv)]) < 0.0:
            status[b] = OFF_BAND
            return
        if not affine.low(phi[k]) > epsilon:
            on_band += 1
            only = k
    if on_band == 0:
        status[b] = OFF_BAND
        return
    if not (np.isfinite(A).all() and np.isfinite(B).all() and np.isfinite(phi).all()):
        return
    alone = on_band == 1
    if not alone:
        for k in range(rows):
            if phi[k, 0] < phi[only, 0]:
                only = k
    counted = rows + 1 if passive else rows

    binding, count = np.empty(rows + 1, np.int64), 0  # constraints that some torque in the box breaks
    for k in range(counted):
        reach, sizes = affine.low(A[k]), abs(affine.low(A[k]))
        for j in range(nv):
            most = max(abs(affine.low(B[k, j])), abs(affine.high(B[k, j]))) * u_max[j]
            reach, sizes = reach - most, sizes + most
        if not reach >= affine.ROUNDING * sizes:
            binding[count] = k
            count += 1

    e = np.empty(planes - 2)
    point_on_band(phi[only], epsilon, e)
    u, at, forms = np.zeros(JOINTS), np.zeros((rows + 1, 1 + JOINTS)), np.empty(planes)
    weight, scale, blurred = np.ones(rows + 1), np.ones(rows + 1), phi[only, planes - 1] > CLEAR * epsilon
    for c in range(count):
        k = binding[c]
        at[c, 0] = _value(A[k], e)
        rest = A[k, planes - 1]
        for j in range(nv):
            at[c, 1 + j] = _value(B[k, j], e)
            rest += B[k, j, planes - 1] * u_max[j]
        scale[c] = abs(at[c, 1]) * u_max[0] + abs(at[c, 2]) * u_max[1] + affine.TINY
        weight[c] = scale[c]
        blurred = blurred or rest > CLEAR * scale[c]
    proved, cost = count == 0, np.zeros(size)
    for attempt in range(3):  # the second weighs the constraints by how far they reach under the first's torque
        if count == 0:
            break
        slack = best_torque(at[:, 0], at[:, 1:], weight, count, u_max, u)
        if attempt == 0:
            suspect[b] = slack < FAIL and not blurred
            if suspect[b] and binding[count - 1] == rows:  # the least of the power alone
                alone_weight = np.zeros(rows + 1)
                alone_weight[count - 1] = 1.0
                excess[b] = max(0.0, -best_torque(at[:, 0], at[:, 1:], alone_weight, count, u_max, u))
        worst = np.inf
        cost[:] = 0.0
        for c in range(count):
            k = binding[c]
            _under(A[k], B[k], u, forms)
            cuts = phi[only] if alone or k == rows else phi[k]
            value, factor = least(forms, cuts, True, alone, epsilon)
            if not value >= 0.0:
                _add_cost(forms, cuts, factor, epsilon, half, 1.0 / scale[c], cost)
            spread = at[c, 0] + at[c, 1] * u[0] + at[c, 2] * u[1] - value
            weight[c] = max(spread, 1e-9 * scale[c])
            worst = min(worst, value)
        proved = worst >= 0.0
        if proved or slack < 0.0:
            break
        if attempt == 2 and size < planes - 2 and not phi[only, planes - 1] > CLEAR * epsilon:
            for c in range(count):  # at the point itself, for all densities
                k = binding[c]
                _under(A[k], B[k], u, forms)
                value = _value(forms, e) - forms[planes - 1]
                for i in range(size, planes - 2):
                    value -= abs(forms[1 + i])
                suspect[b] = suspect[b] or value < FAIL
    for i in range(size):
        point[b, i] = min(box[1, i], max(box[0, i], state[i, 0] + e[i] * state[i, 1 + i]))
    if not proved:
        cut[b] = np.argmax(cost)
        return
    lowest = np.inf
    for k in range(rows):
        if not affine.low(phi[k]) > epsilon:
            length = np.sqrt(B[k, 0, 0] ** 2 + B[k, 1, 0] ** 2)
            if not length > 0.0:
                return
            forms[:] = 0.0
            for j in range(nv):  # |L_g phi| is at least its part along its direction at the centre
                n = B[k, j, 0] / length * (1.0 - 1e-14)
                forms[: planes - 1] += n * B[k, j, : planes - 1]
                forms[planes - 1] += (
                    abs(n) * B[k, j, planes - 1] + affine.ROUNDING * (abs(B[k, j, 0]) + affine.radius(B[k, j]))
                ) * affine.UP
            value, factor = least(forms, phi[only] if alone else phi[k], True, alone, epsilon)
            if not value >= LEAST_SHARE * length:
                cost[:] = 0.0
                _add_cost(forms, phi[only] if alone else phi[k], factor, epsilon, half, 1.0, cost)
                cut[b] = np.argmax(cost)
                return
            lowest = min(lowest, value)
    status[b], Lg[b] = PROVED, lowest


@exact_kernel
def _value(a: Any, e: Any) -> float:
    """The linear part of a form at a point."""
    total = a[0]
    for i in range(len(e)):
        total += a[1 + i] * e[i]
    return float(total)


@exact_kernel
def _under(A: Any, B: Any, u: Any, out: Any) -> None:
    """The form ``A + B u`` under one torque."""
    out[:] = A
    form = np.empty(len(A))
    for j in range(len(u)):
        affine.scaled(B[j], u[j], form)
        affine.add(out, form, 1.0, out)


@exact_kernel
def _add_cost(f: Any, phi: Any, multiplier: float, epsilon: float, half: Any, factor: float, cost: Any) -> None:
    """What each coordinate takes from a bound: what is linear in it, and its shares of phi's range and the remainders.

    What phi explains of a form ranges over the band's width all the same, unless the box is smaller.
    """
    n, last, squares, reach = len(half), len(f) - 1, 0.0, affine.TINY
    for i in range(n):
        squares += half[i] * half[i]
        reach += abs(phi[1 + i])
    rest = f[last] + abs(multiplier) * phi[last]
    across = abs(multiplier) * min(0.5 * epsilon, reach) / reach
    for i in range(n):
        linear = abs(f[1 + i] - multiplier * phi[1 + i]) + across * abs(phi[1 + i])
        cost[i] += factor * (linear + rest * half[i] * half[i] / squares)
