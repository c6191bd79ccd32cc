"""The learned term K_theta(q, v) >= 0 with its exact gradient, in one implementation for numpy and torch.

Every function takes the array module as ``xp`` (numpy at run time, torch in training and export), so the runtime needs
no torch and cannot drift from what was trained. q stands for Pinocchio's coordinates (cos, sin of continuous joints).

Two forms:

* ``mlp``: the paper's perceptron with ELU units and squared output, made zero at rest,
  ``K = (f(q, v) - f(q, 0))²`` (``zero_at_rest = 0`` gives the paper's letter, ``f²``).
* ``convex``: ``K = F(v) + G(v) + Σ_j a_j(q) D_j``. D_j is the Bregman divergence of ``z -> softplus(z + c_j(q))``
  between 0 and ``z_j = b_j(q) · v / v_scale``, with ``a_j >= 0``. F is a rounded cone ``a (sqrt(|s|² + c²) - c)`` and G
  a bowl ``a (softplus(|s|² - c) - softplus(-c))`` of the scaled velocity ``s = b v / v_scale``, with ``a >= 0`` and
  weights b for each joint: they slow all motions and, without q, cannot be steep in it. All are smooth, zero with zero
  gradient at rest and convex in v, so ``v · ∂K/∂v >= K >= 0``: the corrections of the kinetic metric dissipate (see the
  README, Method in short).
  Its layers see q scaled to X and, as the dynamics do, the cosine and sine of every angle (``turns`` is 1 for angles
  and 0 for lengths and for the cos and sin of continuous joints).

To either a share of the kinetic energy may be added (:func:`energy_weight`). That needs the mass matrix, so it is left
to those who have it: the functions here give K without.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple

import numpy as np

from ppcbf_robots import network_kernel

NetworkKind = Literal["mlp", "convex"]
Params = Mapping[str, Any]


def _elu(xp: Any, x: Any) -> tuple[Any, Any]:
    """ELU and its derivative, as ``max(x, 0) + exp(min(x, 0)) - 1`` and ``exp(min(x, 0))``: nothing overflows."""
    low = 0.5 * (x - xp.abs(x))
    slope = xp.exp(low)
    return x - low + slope - 1.0, slope


def _hidden(xp: Any, p: Params, x: Any) -> tuple[Any, list[Any]]:
    slopes = []
    i = 0
    while f"W{i}" in p:
        x, slope = _elu(xp, x @ p[f"W{i}"] + p[f"b{i}"])
        slopes.append(slope)
        i += 1
    return x, slopes


def _pull_back(p: Params, g: Any, slopes: list[Any]) -> Any:
    """Gradient with respect to the input from the gradient g with respect to the last hidden layer."""
    for i in reversed(range(len(slopes))):
        g = (g * slopes[i]) @ p[f"W{i}"].T
    return g


def _sigmoid(xp: Any, x: Any) -> Any:
    return 0.5 * (1.0 + xp.tanh(0.5 * x))


def _softplus(xp: Any, x: Any) -> Any:
    return xp.log1p(xp.exp(-xp.abs(x))) + xp.clip(x, 0.0, None)


def _mlp(xp: Any, p: Params, q: Any, v: Any) -> tuple[Any, Any, Any]:
    nq = q.shape[-1]
    scale = p["in_scale"]

    def f(v: Any) -> tuple[Any, Any]:
        x, slopes = _hidden(xp, p, (xp.concatenate([q, v], -1) - p["in_shift"]) * scale)
        return x @ p["w_out"], _pull_back(p, xp.zeros_like(x) + p["w_out"], slopes) * scale

    y, dy = f(v)
    y0, dy0 = f(xp.zeros_like(v))
    rest = p["zero_at_rest"]
    d = y + (1.0 - rest) * p["b_out"] - rest * y0
    two_d = 2.0 * d[..., None]
    return d * d, two_d * (dy[..., :nq] - rest * dy0[..., :nq]), two_d * dy[..., nq:]


def _features(xp: Any, p: Params, q: Any) -> tuple[Any, Any, Any]:
    """Input (..., 3 nq) of the convex form's layers, and the cosines and sines (..., nq) in it."""
    angle = q * p["turns"]
    cos, sin = xp.cos(angle), xp.sin(angle)
    return xp.concatenate([(q - p["in_shift"]) * p["in_scale"], cos, sin], -1), cos, sin


def _convex(xp: Any, p: Params, q: Any, v: Any) -> tuple[Any, Any, Any]:
    features, cos, sin = _features(xp, p, q)
    x, slopes = _hidden(xp, p, features)
    units = p["ba"].shape[-1]
    ra = x @ p["Wa"] + p["ba"]
    a = _softplus(xp, ra)
    c = x @ p["Wc"] + p["bc"]
    b = (x @ p["Wb"] + p["bb"]).reshape(*x.shape[:-1], units, v.shape[-1])  # (..., units, nv)
    s = v * p["v_scale"]
    z = (b * s[..., None, :]).sum(-1)
    sig, sig0 = _sigmoid(xp, z + c), _sigmoid(xp, c)
    D = _softplus(xp, z + c) - _softplus(xp, c) - sig0 * z
    F, dF_dv = _speed_terms(xp, p, s)
    K = (a * D).sum(-1) + F
    dz = a * (sig - sig0)  # dK/dz
    dc = dz - a * sig0 * (1.0 - sig0) * z
    dK_dv = ((dz[..., None] * b).sum(-2) + dF_dv) * p["v_scale"]
    db = (dz[..., None] * s[..., None, :]).reshape(*x.shape[:-1], units * v.shape[-1])
    g = (D * _sigmoid(xp, ra)) @ p["Wa"].T + dc @ p["Wc"].T + db @ p["Wb"].T
    g, nq = _pull_back(p, g, slopes), q.shape[-1]
    dK_dq = g[..., :nq] * p["in_scale"] + p["turns"] * (cos * g[..., 2 * nq :] - sin * g[..., nq : 2 * nq])
    return K, dK_dq, dK_dv


def _speed_terms(xp: Any, p: Params, s: Any) -> tuple[Any, Any]:
    """F + G (...) of the scaled velocity s (..., nv) and their gradient (..., nv)."""
    cone_square, bowl_square = p["cone_b"] * p["cone_b"], p["bowl_b"] * p["bowl_b"]
    shape = _speed_shape(xp, p)
    value, root, z = _speed_value(xp, shape, (cone_square * s * s).sum(-1), (bowl_square * s * s).sum(-1))
    by_cone, by_bowl = shape.cone_a / root, 2.0 * shape.bowl_a * _sigmoid(xp, z)  # by |s|², twice
    return value, (by_cone[..., None] * cone_square + by_bowl[..., None] * bowl_square) * s


class _SpeedShape(NamedTuple):
    """What F and G have besides their weights b, all of it positive but ``bowl_c``."""

    cone_a: Any
    cone_c: Any
    bowl_a: Any
    bowl_c: Any
    bowl_rest: Any  # softplus(-bowl_c)


def _speed_shape(xp: Any, p: Params) -> _SpeedShape:
    cone_a, cone_c, bowl_a = _softplus(xp, p["cone_a"]), _softplus(xp, p["cone_c"]), _softplus(xp, p["bowl_a"])
    return _SpeedShape(cone_a, cone_c, bowl_a, p["bowl_c"], _softplus(xp, -p["bowl_c"]))


def _speed_value(xp: Any, shape: _SpeedShape, cone: Any, bowl: Any) -> tuple[Any, Any, Any]:
    """F + G (...) of the squared lengths |s|² (...) that each sees, the root of F and the argument of G's softplus."""
    root, z = xp.sqrt(cone + shape.cone_c * shape.cone_c), bowl - shape.bowl_c
    return shape.cone_a * (root - shape.cone_c) + shape.bowl_a * (_softplus(xp, z) - shape.bowl_rest), root, z


def _mlp_out(xp: Any, p: Params, q: Any, v: Any) -> Any:
    return _hidden(xp, p, (xp.concatenate([q, v], -1) - p["in_shift"]) * p["in_scale"])[0] @ p["w_out"]


def _convex_units(xp: Any, p: Params, q: Any) -> tuple[Any, Any, Any]:
    """a (..., units), c (..., units) and b (..., units, nv) of the convex form."""
    x = _hidden(xp, p, _features(xp, p, q)[0])[0]
    nv = p["v_scale"].shape[-1]
    b = (x @ p["Wb"] + p["bb"]).reshape(*x.shape[:-1], p["ba"].shape[-1], nv)
    return _softplus(xp, x @ p["Wa"] + p["ba"]), x @ p["Wc"] + p["bc"], b


class Along:
    """The function ``s -> K(q, s d)`` along many rays (...), with everything that depends on q and d alone done once.

    Args:
        of: of s (...) and ``terms``.
        terms: of every ray, each (..., any).
    """

    def __init__(self, of: Callable[..., Any], *terms: Any) -> None:
        self._of, self._terms = of, terms

    def __call__(self, s: Any) -> Any:
        """K (...) at s (...)."""
        return self._of(s, *self._terms)

    def select(self, index: Any) -> Along:
        """The function along some of the rays."""
        return Along(self._of, *(x[index] for x in self._terms))

    def plus(self, square: Any) -> Along:
        """The function with ``s² square`` (...) added."""
        of = self._of
        return Along(lambda s, square, *terms: of(s, *terms) + s * s * square, square, *self._terms)


def value_along(xp: Any, kind: NetworkKind, params: Params, q: Any, d: Any) -> Along:
    """K, without energy, along the rays through rest in q (..., nq) of direction d (..., nv)."""
    p = params
    if kind == "mlp":
        y0 = p["zero_at_rest"] * _mlp_out(xp, p, q, xp.zeros_like(d)) - (1.0 - p["zero_at_rest"]) * p["b_out"]
        return Along(lambda s, q, d, y0: (_mlp_out(xp, p, q, s[..., None] * d) - y0) ** 2, q, d, y0)
    a, c, b = _convex_units(xp, p, q)
    slope = (b * (d * p["v_scale"])[..., None, :]).sum(-1)
    rest, tangent = (a * _softplus(xp, c)).sum(-1), (a * _sigmoid(xp, c) * slope).sum(-1)
    cone, bowl = ((p[f"{form}_b"] * d * p["v_scale"]) ** 2 for form in ("cone", "bowl"))
    shape = _speed_shape(xp, p)

    def K(s: Any, a: Any, c: Any, slope: Any, rest: Any, tangent: Any, cone: Any, bowl: Any) -> Any:
        units = (a * _softplus(xp, s[..., None] * slope + c)).sum(-1) - rest - s * tangent
        return units + _speed_value(xp, shape, s * s * cone, s * s * bowl)[0]

    return Along(K, a, c, slope, rest, tangent, cone.sum(-1), bowl.sum(-1))


def energy_weight(xp: Any, params: Params) -> Any:
    """What the kinetic energy [J] weighs in K [m/(s J)]: 0 where there is no such term.

    The energy is zero at rest and convex in v as well, and its rate needs no derivative of M:
    ``d/dt ½ vᵀ M v = vᵀ (u - g)``. It is largest where an arm is stretched and all its joints move one way, which is
    where torque runs short; of the posture alone the layers would have to learn that.
    """
    return _softplus(xp, params["energy_a"]) * params["energy_scale"] if "energy_a" in params else 0.0


_OF_Q = 11  # arguments of the compiled convex form that belong to its layers
_FORMS = {"mlp": _mlp, "convex": _convex}


def value_and_grad(xp: Any, kind: NetworkKind, params: Params, q: Any, v: Any) -> tuple[Any, Any, Any]:
    """K (...), ∂K/∂q (..., nq) in Pinocchio's coordinates, ∂K/∂v (..., nv), for q (..., nq) and v (..., nv)."""
    return _FORMS[kind](xp, params, q, v)


class NumpyNetwork:
    """K_theta for the runtime: float64 numpy parameters, no torch."""

    def __init__(self, kind: NetworkKind, params: Mapping[str, Any]) -> None:
        self.kind: NetworkKind = kind
        self.params = {k: np.asarray(w, dtype=np.float64) for k, w in params.items()}
        self.energy = float(energy_weight(np, self.params))
        self._packed: tuple[Any, ...] | None = None
        self._last: tuple[Any, Any] = (None, ())  # the last single q, if it cannot change, and the units there

    def value(self, q: Any, v: Any) -> Any:
        """K (...) alone, without energy, for q (..., nq) and v (..., nv)."""
        return value_along(np, self.kind, self.params, q, v)(np.ones(np.shape(v)[:-1]))

    def value_and_grad(self, q: Any, v: Any) -> tuple[Any, Any, Any]:
        """See :func:`value_and_grad`; a single state is evaluated compiled, ten times faster."""
        if np.ndim(v) > 1:
            return value_and_grad(np, self.kind, self.params, q, v)
        if self.kind == "mlp":
            K, K_q, K_v = network_kernel.mlp(q, v, *self._arguments())
        else:
            K, K_q, K_v, units = network_kernel.convex(q, v, *self._arguments())
            self._last = (None if q.flags.writeable else q, units)
        return np.float64(K), K_q, K_v

    def compiled(self) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        """The convex form's layers and what remains of it at a given q, as ``network_kernel`` takes them."""
        packed = self._arguments()
        return packed[:_OF_Q], packed[_OF_Q:]

    def of_velocity(self, q: Any) -> tuple[Any, ...]:
        """The convex form at q (nq,) as a function of v alone: the last arguments of ``network_kernel.rise``."""
        layers, form = self.compiled()
        last_q, units = self._last
        if last_q is not q:
            units = network_kernel.convex_units(q, *layers)
        return *units, *form

    def _arguments(self) -> tuple[Any, ...]:
        if self._packed is None:
            self._packed = self._pack()
        return self._packed

    def _pack(self) -> tuple[Any, ...]:
        """Arguments of the compiled form behind q and v."""
        p = self.params
        layers = [(p[f"W{i}"], p[f"b{i}"]) for i in range(sum(f"W{i}" in p for i in range(len(p))))]
        weights = np.concatenate([np.zeros(0), *(x.ravel() for layer in layers for x in layer)])
        inputs = len(p["in_shift"]) * (1 if self.kind == "mlp" else 3)
        widths = np.array([inputs, *(len(b) for _, b in layers)])
        common = weights, widths, p["in_shift"], p["in_scale"]
        if self.kind == "mlp":
            return *common, p["w_out"], float(p["b_out"]), float(p["zero_at_rest"])
        heads = (np.ascontiguousarray(p[f"W{k}"].T) if w else p[f"b{k}"] for k in "abc" for w in (True, False))
        return (
            *common,
            p["turns"],
            *heads,
            p["v_scale"],
            *(p[f"{form}_{k}"] for form in ("cone", "bowl") for k in "abc"),
        )


def random_convex(nq: int, nv: int, hidden: tuple[int, ...], units: int, rng: np.random.Generator) -> dict[str, Any]:
    """Small random parameters of the convex form; for benchmarks and examples, not a barrier to rely on."""
    widths = (3 * nq, *hidden)
    params: dict[str, Any] = {"in_shift": np.zeros(nq), "in_scale": np.ones(nq), "v_scale": np.ones(nv)}
    params["turns"] = np.ones(nq)
    params |= {"cone_a": np.array(-2.0), "cone_b": np.ones(nv), "cone_c": np.array(-3.0)}
    params |= {"bowl_a": np.array(-3.0), "bowl_b": np.ones(nv), "bowl_c": np.array(1.0)}
    for i, (a, b) in enumerate(itertools.pairwise(widths)):
        params |= {f"W{i}": rng.normal(0.0, a**-0.5, (a, b)), f"b{i}": np.zeros(b)}
    for name, outputs, bias in (("a", units, -4.0), ("b", units * nv, 0.0), ("c", units, -1.0)):
        params |= {f"W{name}": rng.normal(0.0, 0.1, (widths[-1], outputs)), f"b{name}": np.full(outputs, bias)}
    return params
