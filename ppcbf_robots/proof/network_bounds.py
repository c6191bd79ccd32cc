"""Affine forms of K_theta in its convex form and of its gradient, on a box of states.

The layers see q alone: :func:`heads` bounds their outputs and derivatives on a box of joint positions, in forms of as
many symbols as there are joints, and :func:`bounds` what depends on v too. Formulas as in
:mod:`ppcbf_robots.network`, with derivatives by joint angles instead of Pinocchio's coordinates.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ppcbf_robots.kernels import exact_kernel
from ppcbf_robots.network import NumpyNetwork
from ppcbf_robots.proof import affine
from ppcbf_robots.robot import RobotModel

HALF_ULP = 2.0**-53
Net = tuple[Any, ...]  # what pack() returns


def pack(network: NumpyNetwork, robot: RobotModel) -> Net:
    """The convex form's parameters as the kernels here take them."""
    p = network.params
    layers = sum(name.startswith("W") and name[1:].isdigit() for name in p)
    matrices = [p[f"W{i}"] for i in range(layers)]
    biases = [p[f"b{i}"] for i in range(layers)]
    heads = np.concatenate([p["Wa"], p["Wc"], p["Wb"]], axis=1), np.concatenate([p["ba"], p["bc"], p["bb"]])
    widths = np.array([3 * robot.nq, *(len(b) for b in biases)], dtype=np.int64)
    weights = np.concatenate([np.zeros(0), *(x.ravel() for pair in zip(matrices, biases, strict=True) for x in pair)])
    kinds = np.zeros(robot.nq, dtype=np.int64)  # of coordinates: 0 the joint's position, 1 its cosine, 2 its sine
    for first in robot.idx_q[robot.continuous]:
        kinds[first : first + 2] = 1, 2
    units = len(p["ba"])
    cone_a, cone_c, bowl_a, low = (np.logaddexp(0.0, x) for x in (p["cone_a"], p["cone_c"], p["bowl_a"], -p["bowl_c"]))
    speed_terms = np.array([cone_a, cone_c, bowl_a, p["bowl_c"], low])
    return (weights, widths, np.ascontiguousarray(heads[0]), heads[1], p["in_shift"], p["in_scale"], p["turns"], kinds,
            robot.rate_v.astype(np.int64), p["v_scale"], units, speed_terms, p["cone_b"], p["bowl_b"])  # fmt: skip


@exact_kernel
def _layer(x: Any, weights: Any, bias: Any) -> Any:
    """``W x + b`` of forms and their derivatives: x (1 + joints, S + 2, inputs) to (1 + joints, S + 2, outputs)."""
    parts, planes, inputs = x.shape
    outputs = len(bias)
    y = np.zeros((parts, planes, outputs))
    lost = 2.0 * (inputs + 4) * HALF_ULP  # a sum of products loses less, relative to the sum of their sizes
    for part in range(parts):
        for i in range(inputs):
            size = 0.0
            for p in range(planes):
                size += abs(x[part, p, i])
            rest = x[part, planes - 1, i] + lost * size
            if size == 0.0:
                continue
            row = weights[i]
            for p in range(planes - 1):
                factor = x[part, p, i]
                if factor != 0.0:
                    for j in range(outputs):
                        y[part, p, j] += factor * row[j]
            for j in range(outputs):
                y[part, planes - 1, j] += rest * abs(row[j])
        for j in range(outputs):
            if part == 0:
                y[0, 0, j] += bias[j]
                y[0, planes - 1, j] += lost * abs(bias[j])
            y[part, planes - 1, j] = y[part, planes - 1, j] * (1.0 + lost) + affine.TINY
    return y


@exact_kernel
def _features(q: Any, net: Any) -> Any:
    """Inputs of the layers and derivatives by the joints, (1 + joints, S + 2, 3 nq), of forms q (joints, S + 2)."""
    shift, scale, turns, kinds, joint_of = net[4], net[5], net[6], net[7], net[8]
    joints, planes = q.shape
    nq = len(shift)
    x = np.zeros((1 + joints, planes, 3 * nq))
    value, rate, form = np.empty(planes), np.empty(planes), np.empty(planes)
    for i in range(nq):
        joint = joint_of[i]
        if kinds[i] == 0:
            value[:] = q[joint]
            affine.constant(1.0, rate)
        elif kinds[i] == 1:
            affine.cos(q[joint], value)
            affine.sin(q[joint], rate)
            affine.scaled(rate, -1.0, rate)
        else:
            affine.sin(q[joint], value)
            affine.cos(q[joint], rate)
        affine.shifted(value, -shift[i], form)
        affine.scaled(form, scale[i], form)
        x[0, :, i] = form
        affine.scaled(rate, scale[i], form)
        x[1 + joint, :, i] = form
        if turns[i] == 0.0:
            x[0, 0, nq + i] = 1.0  # cos 0, and sin 0 beside it
        else:  # an angle: its rate is 1
            affine.scaled(value, turns[i], value)
            affine.cos(value, form)
            x[0, :, nq + i] = form
            affine.scaled(form, turns[i], form)
            x[1 + joint, :, 2 * nq + i] = form
            affine.sin(value, form)
            x[0, :, 2 * nq + i] = form
            affine.scaled(form, -turns[i], form)
            x[1 + joint, :, nq + i] = form
    return x


@exact_kernel
def heads(q: Any, net: Any) -> Any:
    """Bounds on a box of positions q (joints, joints + 2) of what the layers put out.

    Returns (1 + joints, outputs, joints + 2): the values and their derivatives by the joints; outputs are a (units,)
    before its softplus, c (units,) and b (units joints,), unit by unit.
    """
    weights, widths, head, bias = net[0], net[1], net[2], net[3]
    joints, planes = q.shape
    x = _features(q, net)
    form, slope, other = np.empty(planes), np.empty(planes), np.empty(planes)
    at = 0
    for layer in range(len(widths) - 1):
        inputs, outputs = widths[layer], widths[layer + 1]
        W = weights[at : at + inputs * outputs].reshape((inputs, outputs))
        y = _layer(x, W, weights[at + inputs * outputs : at + (inputs + 1) * outputs])
        at += (inputs + 1) * outputs
        for j in range(outputs):
            form[:] = y[0, :, j]
            affine.elu_slope(form, slope)
            affine.elu(form, form)
            y[0, :, j] = form
            for d in range(joints):
                other[:] = y[1 + d, :, j]
                affine.mul(slope, other, other)
                y[1 + d, :, j] = other
        x = y
    return np.ascontiguousarray(_layer(x, head, bias).transpose(0, 2, 1))


@exact_kernel
def _wide(a: Any, joints: int, out: Any) -> None:
    """A form of the joint positions as one of the whole state; positions are its first symbols."""
    out[:] = 0.0
    out[: joints + 1] = a[: joints + 1]
    out[-1] = a[-1]


@exact_kernel
def bounds(head: Any, v: Any, net: Any, K: Any, K_q_rate: Any, K_v: Any) -> None:
    """K (S + 2,), ``∂K/∂q · q̇`` (S + 2,) and ∂K/∂v (joints, S + 2), from :func:`heads` and forms v (joints, S + 2)."""
    joints, planes = v.shape
    v_scale, units = net[9], net[10]
    K[:], K_q_rate[:], K_v[:] = 0.0, 0.0, 0.0
    speed = np.empty((joints, planes))
    for j in range(joints):
        affine.scaled(v[j], v_scale[j], speed[j])
    _speed_terms(speed, net, K, K_v)
    form, rate, x = np.empty(planes), np.empty(planes), np.empty(planes)
    a, a_rate, c, c_rate = np.empty(planes), np.empty(planes), np.empty(planes), np.empty(planes)
    z, z_rate, b = np.empty(planes), np.empty(planes), np.empty((joints, planes))
    s, s0, D, E = np.empty(planes), np.empty(planes), np.empty(planes), np.empty(planes)
    for unit in range(units):
        _wide(head[0, unit], joints, form)
        _along(head, unit, v, x, rate)
        affine.softplus(form, a)
        affine.sigmoid(form, a_rate)
        affine.mul(a_rate, rate, a_rate)
        _wide(head[0, units + unit], joints, c)
        _along(head, units + unit, v, x, c_rate)
        z[:], z_rate[:] = 0.0, 0.0
        for j in range(joints):
            at = 2 * units + unit * joints + j
            _wide(head[0, at], joints, b[j])
            affine.mul(b[j], speed[j], form)
            affine.add(z, form, 1.0, z)
            _along(head, at, v, x, rate)
            affine.mul(rate, speed[j], form)
            affine.add(z_rate, form, 1.0, z_rate)
        # D = softplus(z + c) - softplus(c) - σ(c) z, its derivatives E by z, and F = E - σ'(c) z by c
        affine.add(z, c, 1.0, form)
        affine.sigmoid(form, s)
        affine.softplus(form, D)
        affine.softplus(c, form)
        affine.add(D, form, -1.0, D)
        affine.sigmoid(c, s0)
        affine.mul(s0, z, form)
        affine.add(D, form, -1.0, D)
        affine.add(s, s0, -1.0, E)
        affine.mul(s0, s0, form)
        affine.add(s0, form, -1.0, form)  # σ'(c)
        affine.mul(form, z, form)
        affine.add(E, form, -1.0, form)  # F
        affine.mul(form, c_rate, form)
        affine.mul(E, z_rate, x)
        affine.add(form, x, 1.0, form)
        affine.mul(form, a, form)
        affine.add(K_q_rate, form, 1.0, K_q_rate)
        affine.mul(a_rate, D, form)
        affine.add(K_q_rate, form, 1.0, K_q_rate)
        affine.mul(a, D, form)
        affine.add(K, form, 1.0, K)
        affine.mul(a, E, form)
        for j in range(joints):
            affine.mul(form, b[j], x)
            affine.scaled(x, v_scale[j], x)
            affine.add(K_v[j], x, 1.0, K_v[j])


@exact_kernel
def _speed_terms(speed: Any, net: Any, K: Any, K_v: Any) -> None:
    """Add the cone F and the bowl G of forms ``speed = v v_scale`` (joints, S + 2), and their gradients."""
    v_scale, terms, cone_b, bowl_b = net[9], net[11], net[12], net[13]
    cone_a, cone_c, bowl_a, bowl_c, low = terms[0], terms[1], terms[2], terms[3], terms[4]
    joints, planes = speed.shape
    form, squares = np.empty(planes), np.zeros((2, planes))
    root, slope, x = np.empty(planes), np.empty(planes), np.empty(planes)
    for j in range(joints):
        for term in range(2):
            affine.scaled(speed[j], cone_b[j] if term == 0 else bowl_b[j], form)
            affine.mul(form, form, form)
            affine.add(squares[term], form, 1.0, squares[term])
    floor = cone_c * cone_c
    affine.shifted(squares[0], floor, form)
    affine.root_above(form, floor * (1.0 - 1e-13), root, slope)
    affine.shifted(root, -cone_c, form)
    affine.scaled(form, cone_a, form)
    affine.add(K, form, 1.0, K)
    affine.scaled(slope, cone_a, slope)  # of F by |s|²/2
    affine.shifted(squares[1], -bowl_c, form)
    affine.sigmoid(form, root)
    affine.softplus(form, form)
    affine.shifted(form, -low, form)
    affine.scaled(form, bowl_a, form)
    affine.add(K, form, 1.0, K)
    affine.scaled(root, 2.0 * bowl_a, root)  # of G by |s|²/2
    for j in range(joints):
        affine.scaled(slope, cone_b[j] * cone_b[j], form)
        affine.scaled(root, bowl_b[j] * bowl_b[j], x)
        affine.add(form, x, 1.0, form)
        affine.mul(form, speed[j], form)
        affine.scaled(form, v_scale[j], form)
        affine.add(K_v[j], form, 1.0, K_v[j])


@exact_kernel
def _along(head: Any, output: int, v: Any, work: Any, out: Any) -> None:
    """Rate of an output of the layers under the motion v."""
    joints = len(v)
    out[:] = 0.0
    for d in range(joints):
        _wide(head[1 + d, output], joints, work)
        affine.mul(work, v[d], work)
        affine.add(out, work, 1.0, out)
