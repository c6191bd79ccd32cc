"""The C99 header of an exported barrier: static inline functions, parameters as constants, ``<math.h>`` alone."""

from __future__ import annotations

import re
import textwrap
from string import Template
from typing import Any

from ppcbf_robots.network import NumpyNetwork
from ppcbf_robots.specs import Array

_NUMBERS_PER_LINE = 4

_COMMON = Template("""\
/* y = b + x W; x (n), W (n, m) by rows, b and y (m). Four rows at a time spare loads and stores of y. */
static inline void ${p}_affine(int n, int m, const double *x, const double *W, const double *b, double *y)
{
    int i = 0;
    for (int j = 0; j < m; ++j) y[j] = b[j];
    for (; i + 4 <= n; i += 4, W += 4 * m) {
        const double *r0 = W, *r1 = W + m, *r2 = W + 2 * m, *r3 = W + 3 * m;
        const double x0 = x[i], x1 = x[i + 1], x2 = x[i + 2], x3 = x[i + 3];
        for (int j = 0; j < m; ++j) y[j] += x0 * r0[j] + x1 * r1[j] + x2 * r2[j] + x3 * r3[j];
    }
    for (; i < n; ++i, W += m)
        for (int j = 0; j < m; ++j) y[j] += x[i] * W[j];
}

/* x . y of length n; eight partial sums let the compiler use vector units without reordering a sum. */
static inline double ${p}_dot(int n, const double *x, const double *y)
{
    double s[8] = {0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0};
    int i = 0;
    for (; i + 8 <= n; i += 8)
        for (int k = 0; k < 8; ++k) s[k] += x[i + k] * y[i + k];
    for (; i < n; ++i) s[0] += x[i] * y[i];
    return ((s[0] + s[4]) + (s[1] + s[5])) + ((s[2] + s[6]) + (s[3] + s[7]));
}

/* One hidden layer: y = elu(x W + b) and its slopes; exp of negative numbers only, so that nothing overflows. */
static inline void ${p}_layer(int n, int m, const double *x, const double *W, const double *b, double *y, double *slope)
{
    ${p}_affine(n, m, x, W, b, y);
    for (int j = 0; j < m; ++j) {
        slope[j] = y[j] > 0.0 ? 1.0 : exp(y[j]);
        if (y[j] <= 0.0) y[j] = slope[j] - 1.0;
    }
}

/* Back through one hidden layer: y = W (g * slope); g and slope (m), y (n). */
static inline void ${p}_layer_back(int n, int m, const double *W, const double *g, const double *slope, double *y)
{
    double t[${P}_WIDTH];
    for (int j = 0; j < m; ++j) t[j] = g[j] * slope[j];
    for (int i = 0; i < n; ++i) y[i] = ${p}_dot(m, W + i * m, t);
}
""")

_MLP = Template("""\
/* f(q, v) and its gradient df with respect to (q, v), (NQ + NV). */
static inline double ${p}_f(const double *q, const double *v, double *df)
{
    ${p}_layers L;
    for (int i = 0; i < ${P}_NQ; ++i) L.x0[i] = (q[i] - ${p}_in_shift[i]) * ${p}_in_scale[i];
    for (int i = ${P}_NQ; i < ${P}_NQ + ${P}_NV; ++i)
        L.x0[i] = (v[i - ${P}_NQ] - ${p}_in_shift[i]) * ${p}_in_scale[i];
    ${p}_hidden(&L);
    ${p}_hidden_back(&L, ${p}_w_out, df);
    for (int i = 0; i < ${P}_NQ + ${P}_NV; ++i) df[i] *= ${p}_in_scale[i];
    return ${p}_dot(${P}_LAST, L.${last}, ${p}_w_out);
}

/* The learned part of K, returned, and its gradients dK_dq (NQ) and dK_dv (NV). */
static inline double ${p}_learned(const double *q, const double *v, double *dK_dq, double *dK_dv)
{
    static const double rest[${P}_NV] = {0.0};
    const double zero_at_rest = ${p}_zero_at_rest[0];
    double df[${P}_NQ + ${P}_NV], df0[${P}_NQ + ${P}_NV] = {0.0};
    double d = ${p}_f(q, v, df) + (1.0 - zero_at_rest) * ${p}_b_out[0];
    if (zero_at_rest != 0.0) d -= zero_at_rest * ${p}_f(q, rest, df0);
    for (int i = 0; i < ${P}_NQ; ++i) dK_dq[i] = 2.0 * d * (df[i] - zero_at_rest * df0[i]);
    for (int i = 0; i < ${P}_NV; ++i) dK_dv[i] = 2.0 * d * df[${P}_NQ + i];
    return d * d;
}
""")

_CONVEX = Template("""\
#define ${P}_UNITS ${units} /* convex units */

static inline double ${p}_sigmoid(double x) { return 0.5 * (1.0 + tanh(0.5 * x)); }
static inline double ${p}_softplus(double x) { return log1p(exp(-fabs(x))) + (x > 0.0 ? x : 0.0); }

/* The learned part of K, returned, and its gradients dK_dq (NQ) and dK_dv (NV). */
static inline double ${p}_learned(const double *q, const double *v, double *dK_dq, double *dK_dv)
{
    double ra[${P}_UNITS], c[${P}_UNITS], b[${P}_UNITS * ${P}_NV];
    double dra[${P}_UNITS], dc[${P}_UNITS], db[${P}_UNITS * ${P}_NV]; /* dK/dra, dK/dc, dK/db */
    double s[${P}_NV], g[${P}_LAST], dx[3 * ${P}_NQ], K;
    const double rounded = ${p}_softplus(${p}_cone_c[0]);
    const double cone = ${p}_softplus(${p}_cone_a[0]), bowl = ${p}_softplus(${p}_bowl_a[0]);
    double root = rounded * rounded, depth = -${p}_bowl_c[0];
    ${p}_layers L;
    double *const cosine = L.x0 + ${P}_NQ, *const sine = L.x0 + 2 * ${P}_NQ;
    for (int i = 0; i < ${P}_NQ; ++i) {
        L.x0[i] = (q[i] - ${p}_in_shift[i]) * ${p}_in_scale[i];
        cosine[i] = cos(q[i] * ${p}_turns[i]);
        sine[i] = sin(q[i] * ${p}_turns[i]);
    }
    ${p}_hidden(&L);
    ${p}_affine(${P}_LAST, ${P}_UNITS, L.${last}, ${p}_Wa, ${p}_ba, ra);
    ${p}_affine(${P}_LAST, ${P}_UNITS, L.${last}, ${p}_Wc, ${p}_bc, c);
    ${p}_affine(${P}_LAST, ${P}_UNITS * ${P}_NV, L.${last}, ${p}_Wb, ${p}_bb, b);
    for (int i = 0; i < ${P}_NV; ++i) {
        s[i] = v[i] * ${p}_v_scale[i];
        root += ${p}_cone_b[i] * ${p}_cone_b[i] * s[i] * s[i];
        depth += ${p}_bowl_b[i] * ${p}_bowl_b[i] * s[i] * s[i];
    }
    root = sqrt(root);
    K = cone * (root - rounded) + bowl * (${p}_softplus(depth) - ${p}_softplus(-${p}_bowl_c[0]));
    for (int i = 0; i < ${P}_NV; ++i)
        dK_dv[i] = (cone / root * ${p}_cone_b[i] * ${p}_cone_b[i]
                    + 2.0 * bowl * ${p}_sigmoid(depth) * ${p}_bowl_b[i] * ${p}_bowl_b[i]) * s[i] * ${p}_v_scale[i];
    for (int j = 0; j < ${P}_UNITS; ++j) {
        const double z = ${p}_dot(${P}_NV, b + j * ${P}_NV, s), a = ${p}_softplus(ra[j]);
        const double sig = ${p}_sigmoid(z + c[j]), sig0 = ${p}_sigmoid(c[j]);
        const double D = ${p}_softplus(z + c[j]) - ${p}_softplus(c[j]) - sig0 * z;
        const double dz = a * (sig - sig0);
        K += a * D;
        dra[j] = D * ${p}_sigmoid(ra[j]);
        dc[j] = dz - a * sig0 * (1.0 - sig0) * z;
        for (int i = 0; i < ${P}_NV; ++i) {
            db[j * ${P}_NV + i] = dz * s[i];
            dK_dv[i] += dz * b[j * ${P}_NV + i] * ${p}_v_scale[i];
        }
    }
    for (int i = 0; i < ${P}_LAST; ++i)
        g[i] = ${p}_dot(${P}_UNITS, ${p}_Wa + i * ${P}_UNITS, dra) + ${p}_dot(${P}_UNITS, ${p}_Wc + i * ${P}_UNITS, dc)
             + ${p}_dot(${P}_UNITS * ${P}_NV, ${p}_Wb + i * ${P}_UNITS * ${P}_NV, db);
    ${p}_hidden_back(&L, g, dx);
    for (int i = 0; i < ${P}_NQ; ++i)
        dK_dq[i] = dx[i] * ${p}_in_scale[i]
                 + ${p}_turns[i] * (cosine[i] * dx[2 * ${P}_NQ + i] - sine[i] * dx[${P}_NQ + i]);
    return K;
}
""")

_PHI = Template("""\
/* K >= 0, returned, the gradient dK_dq (NQ) of its learned part, and dK_dv (NV); momentum (NV) is M(q) v. */
static inline double ${p}_K(const double *q, const double *v, const double *momentum, double *dK_dq, double *dK_dv)
{
    const double K = ${p}_learned(q, v, dK_dq, dK_dv);
    for (int i = 0; i < ${P}_NV; ++i) dK_dv[i] += ${P}_ENERGY * momentum[i];
    return K + 0.5 * ${P}_ENERGY * ${p}_dot(${P}_NV, v, momentum);
}

/* phi of one row, returned, and dphi_dv (NV), from K and dK_dv of the same state. */
static inline double ${p}_row(double K, const double *dK_dv, const double *v, double h, const double *grad_h,
                              double *dphi_dv)
{
    for (int i = 0; i < ${P}_NV; ++i) dphi_dv[i] = grad_h[i] - dK_dv[i];
    return ${p}_dot(${P}_NV, grad_h, v) + ${P}_GAMMA * h - K;
}

/* phi of one row, returned, with all it is made of.
 *   in:  q (NQ), v (NV), momentum (NV), h, grad_h (NV)
 *   out: K (one number), dphi_dv (NV), dK_dq (NQ); none may overlap another argument
 */
static inline double ${p}_phi(const double *q, const double *v, const double *momentum, double h,
                              const double *grad_h, double *K, double *dphi_dv, double *dK_dq)
{
    double dK_dv[${P}_NV];
    *K = ${p}_K(q, v, momentum, dK_dq, dK_dv);
    return ${p}_row(*K, dK_dv, v, h, grad_h, dphi_dv);
}
""")

_FILE = Template("""\
/*
${about}
 */
#ifndef ${P}_H
#define ${P}_H

#include <math.h>

#define ${P}_NQ ${nq}
#define ${P}_NV ${nv}
#define ${P}_GAMMA ${gamma} /* [1/s] */
#define ${P}_ALPHA ${alpha} /* [1/s] */
#define ${P}_ENERGY ${energy} /* what the kinetic energy weighs in K [m/(s J)] */
#define ${P}_WIDTH ${widest} /* units of the widest hidden layer */
#define ${P}_LAST ${width} /* units of the last hidden layer */

${arrays}

${code}
#endif /* ${P}_H */
""")


def c_header(network: NumpyNetwork, meta: dict[str, Any], name: str) -> str:
    """Text of the header.

    Args:
        network: K_theta of either kind.
        meta: the barrier's description, as :func:`ppcbf_robots.export.describe` gives it.
        name: prefix of all identifiers; characters C does not allow become underscores.
    """
    prefix = c_name(name)
    layers = [network.params[f"W{i}"].shape for i in range(_depth(network))]
    n_in = network.params["in_shift"].shape[0] * (1 if network.kind == "mlp" else 3)
    sizes = {"p": prefix, "P": prefix.upper(), "last": f"x{len(layers)}", "width": layers[-1][1] if layers else n_in}
    body = _MLP if network.kind == "mlp" else _CONVEX
    if network.kind == "convex":
        sizes["units"] = network.params["ba"].shape[0]
    code = [_COMMON.substitute(sizes), _hidden(prefix, n_in, layers), body.substitute(sizes), _PHI.substitute(sizes)]
    return _FILE.substitute(
        sizes,
        about=_about(meta, prefix),
        nq=meta["nq"],
        nv=meta["nv"],
        gamma=_number(meta["gamma"]),
        alpha=_number(meta["alpha"]),
        energy=_number(meta["energy"]),
        widest=max([m for _, m in layers], default=1),
        arrays="\n".join(_array(f"{prefix}_{k}", w) for k, w in sorted(network.params.items())),
        code="\n".join(code),
    )


def c_name(name: str) -> str:
    """An identifier from any text: letters, digits and single underscores, not starting with a digit."""
    clean = re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_") or "barrier"
    return f"b_{clean}" if clean[0].isdigit() else clean


def _depth(network: NumpyNetwork) -> int:
    depth = 0
    while f"W{depth}" in network.params:
        depth += 1
    return depth


def _number(x: float) -> str:
    """Shortest decimal that any correct compiler reads back as the same double."""
    return repr(float(x))


def _array(name: str, w: Array) -> str:
    numbers = [_number(x) for x in w.ravel()]
    lines = [", ".join(numbers[i : i + _NUMBERS_PER_LINE]) for i in range(0, len(numbers), _NUMBERS_PER_LINE)]
    shape = f" /* {w.shape[0]} x {w.shape[1]}, by rows */" if w.ndim == 2 else ""
    return f"static const double {name}[{w.size}] = {{{shape}\n    " + ",\n    ".join(lines) + "\n};"


def _hidden(p: str, n_in: int, layers: list[tuple[int, ...]]) -> str:
    """The part whose length depends on the number of hidden layers."""
    fields = [f"double x{i}[{m}], slope{i}[{m}];" for i, (_, m) in enumerate(layers, 1)]
    there = [f"{p}_layer({n}, {m}, L->x{i}, {p}_W{i}, {p}_b{i}, L->x{i + 1}, L->slope{i + 1});"
             for i, (n, m) in enumerate(layers)]  # fmt: skip
    back, g = [], "g"
    for i, (n, m) in reversed(list(enumerate(layers))):
        back += [f"double g{i}[{n}];"] if i else []
        to = f"g{i}" if i else "dx"
        back.append(f"{p}_layer_back({n}, {m}, {p}_W{i}, {g}, L->slope{i + 1}, {to});")
        g = to
    return "\n".join([
        f"/* x0: input; x1, x2, ...: values of the hidden layers, with their slopes. */\ntypedef struct {{\n"
        f"    double x0[{n_in}];", *_indent(fields), f"}} {p}_layers;\n",
        "/* All hidden layers, from x0 on. */",
        f"static inline void {p}_hidden({p}_layers *L)\n{{", *_indent(there or ["(void)L;"]), "}\n",
        "/* Gradient dx with respect to x0, from the gradient g with respect to the last layer. */",
        f"static inline void {p}_hidden_back(const {p}_layers *L, const double *g, double *dx)\n{{",
        *_indent(back or ["(void)L;", f"for (int i = 0; i < {n_in}; ++i) dx[i] = g[i];"]), "}\n",
    ])  # fmt: skip


def _indent(lines: list[str]) -> list[str]:
    return [f"    {line}" for line in lines]


def _about(meta: dict[str, Any], prefix: str) -> str:
    """The opening comment: units, constants, joint order, domain, formula, usage."""
    P, units = prefix.upper(), meta["units"]
    bounds = zip(meta["joints"], meta["domain"]["q"], meta["domain"]["v"], strict=True)
    layout = ", ".join(meta["q_layout"] or ["Pinocchio's configuration vector"])
    lines = [
        f"Barrier phi(q, v) of kind {meta['kind']} ({meta['network']} network) for robot '{meta['robot']}' in world "
        f"'{meta['world']}'.",
        "C99, no dependencies but <math.h>, no allocation, no state: safe to call from several threads.",
        "",
        f"Constants: gamma = {meta['gamma']} 1/s, alpha = {meta['alpha']} 1/s, energy = {meta['energy']:.6g} m/(s J).",
        f"q ({meta['nq']}) [{units['q']}]: {layout}",
        f"v ({meta['nv']}) [{units['v']}]: {', '.join(meta['joints'])}",
        f"momentum ({meta['nv']}): M(q) v with the mass matrix M.",
        f"h [{units['h']}]: one row of the safety function, h >= 0 is safe.",
        f"grad_h ({meta['nv']}): its gradient with respect to the velocity coordinates, so that dh/dt = grad_h . v.",
        f"phi and K [{units['phi']}].",
        "",
        "Trained on this domain, outside of which K means nothing (q as one angle or length per joint):",
        *(f"  {j}: q in [{q[0]:g}, {q[1]:g}], v in [{v[0]:g}, {v[1]:g}]" for j, q, v in bounds),
        "",
        "Formula (products of arrays and vectors as in numpy):",
        *(f"  {line}" for line in meta["formula"]),
        "",
        "Usage, one row:",
        f"  double K, dphi_dv[{P}_NV], dK_dq[{P}_NQ];",
        f"  double phi = {prefix}_phi(q, v, momentum, h, grad_h, &K, dphi_dv, dK_dq);",
        "Usage, many rows of one state (K does not depend on the row):",
        f"  double K = {prefix}_K(q, v, momentum, dK_dq, dK_dv);",
        f"  for each row k: phi[k] = {prefix}_row(K, dK_dv, v, h[k], grad_h[k], dphi_dv[k]);",
    ]
    wrapped = [part for line in lines for part in _wrap(_comment(line))]
    return "\n".join(f" * {part}".rstrip() for part in wrapped)


def _wrap(line: str) -> list[str]:
    indent = " " * (len(line) - len(line.lstrip()) + 2)
    return textwrap.wrap(line, 116, subsequent_indent=indent, break_on_hyphens=False) or [""]


def _comment(text: str) -> str:
    """Text that neither ends nor opens a comment, whatever a robot or joint is called."""
    head = " " * (len(text) - len(text.lstrip()))
    return head + " ".join(text.split()).replace("*/", "* /").replace("/*", "/ *")
