"""What a row of the filter is made of, apart from K_theta, as a list of operations that affine forms can follow.

The formulas are CasADi's: dynamics and distances of :mod:`ppcbf_robots.symbolic`, and their derivatives.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ppcbf_robots.controllers import NominalController
from ppcbf_robots.errors import InputError
from ppcbf_robots.kernels import exact_kernel
from ppcbf_robots.problem import Problem
from ppcbf_robots.proof import affine
from ppcbf_robots.specs import Array
from ppcbf_robots.symbolic import acceleration, potential_energy, safety_rows

OPERATIONS = (
    "CONST", "INPUT", "OUTPUT", "ASSIGN", "ADD", "SUB", "MUL", "NEG", "TWICE", "SQ", "DIV", "INV", "SQRT", "SIN", "COS",
)  # fmt: skip
(_CONST, _INPUT, _OUTPUT, _ASSIGN, _ADD, _SUB, _MUL, _NEG, _TWICE, _SQ, _DIV, _INV, _SQRT, _SIN, _COS) = range(
    len(OPERATIONS)
)


@dataclass(frozen=True)
class Program:
    """Operations in order, on registers that hold one form each."""

    code: NDArray[np.int64]  # (n, 4): operation, target, first and second operand
    constants: Array  # (n,)
    registers: int
    outputs: int

    def __call__(self, inputs: Array) -> Array:
        """Outputs (outputs, S + 2) of forms (inputs, S + 2)."""
        out = np.empty((self.outputs, inputs.shape[1]))
        run(self.code, self.constants, np.asarray(inputs, float), np.empty((self.registers, inputs.shape[1])), out)
        return out


def row_program(problem: Problem, with_densities: bool = False) -> Program:
    """Program of inputs (q, v), joint angles, whose outputs are the rows' and the dynamics'.

    Per row k, from output ``k (3 + nv)`` on: h, ``ḣ = ∇h v``, ``L_f rho = vᵀ ∇²h v + gamma ḣ - ∇h M⁻¹ b`` and
    ``L_g rho = ∇h M⁻¹``. Then M⁻¹, ``-M⁻¹ b``, ``v · u_rest`` and u_rest, the nominal torque at rest; the passivity row
    is ``v · (u - u_rest) <= 0``.
    ``with_densities`` adds factors (nv,) of each link's mass and inertia to the inputs, of which the controller and so
    u_rest know nothing.

    Raises:
        InputError: for obstacles or body pairs that :func:`ppcbf_robots.symbolic.safety_rows` does not know.
    """
    model, nv, gamma = problem.model, problem.model.nv, problem.robot.spec.barrier.gamma
    q, v, u, densities = (ca.SX.sym(name, nv) for name in ("q", "v", "u", "densities"))
    h = safety_rows(problem.safety)(q)
    a = acceleration(model, q, v, u, densities if with_densities else None)
    Minv, a0 = ca.jacobian(a, u), ca.substitute(a, u, ca.SX.zeros(nv))
    grad = ca.jacobian(h, q)
    hdot = grad @ v
    drift = ca.jtimes(hdot, q, v) + gamma * hdot + grad @ a0
    rows = ca.horzcat(h, hdot, drift, grad @ Minv).T
    gravity = ca.gradient(potential_energy(model)(q), q)
    u_rest = rest_torque(problem.robot.controller, q, gravity)
    outputs = [ca.vec(rows), ca.vec(Minv), a0, ca.dot(v, u_rest), u_rest]
    inputs = ca.vertcat(q, v, densities) if with_densities else ca.vertcat(q, v)
    return compiled(ca.Function("rows", [inputs], ca.cse([ca.vertcat(*outputs)])))


def rest_torque(controller: NominalController, angles: Any, gravity: Any) -> Any:
    """``u_des + K_d v`` (nv,) of a controller: see :meth:`NominalController.u_rest`."""
    gains, robot = controller.gains, controller.robot
    e = angles - ca.DM(robot.to_angles(controller.goal))
    force = []
    for i in range(robot.nv):
        kp, f_max = float(gains.kp[i]), float(gains.max_spring[i])
        if robot.continuous[i]:
            force.append(min(kp, f_max) * ca.sin(e[i]))
        elif gains.kind == "bounded_spring":
            force.append(kp * e[i] / ca.sqrt(1.0 + (kp / f_max * e[i]) ** 2))
        else:
            force.append(kp * e[i])
    spring = ca.vertcat(*force)
    return -spring if gains.kind == "shaping" else gravity - spring


def compiled(function: Any) -> Program:
    """A CasADi function of one vector, with one vector as output, as a program.

    Raises:
        InputError: for an operation that has no affine form.
    """
    numbers = {getattr(ca, f"OP_{name}"): i for i, name in enumerate(OPERATIONS) if name not in ("INPUT", "OUTPUT")}
    numbers |= {ca.OP_INPUT: _INPUT, ca.OP_OUTPUT: _OUTPUT}
    count = function.n_instructions()
    code, constants = np.zeros((count, 4), dtype=np.int64), np.zeros(count)
    for k in range(count):
        operation = numbers.get(function.instruction_id(k))
        if operation is None:
            raise InputError(
                f"the model holds an operation without affine form (CasADi's {function.instruction_id(k)})"
            )
        out, read = function.instruction_output(k), function.instruction_input(k)
        if operation == _CONST:
            constants[k] = function.instruction_constant(k)
            code[k] = operation, out[0], 0, 0
        elif operation == _INPUT:
            code[k] = operation, out[0], function.sparsity_in(0).find()[read[1]], 0
        elif operation == _OUTPUT:
            code[k] = operation, function.sparsity_out(0).find()[out[1]], read[0], 0
        else:
            code[k] = operation, out[0], read[0], read[-1]
    return Program(code, constants, function.sz_w(), function.numel_out(0))


@exact_kernel
def run(code: Any, constants: Any, inputs: Any, registers: Any, out: Any) -> None:
    """Follow a program: forms ``inputs`` (n, S + 2) to ``out`` (m, S + 2)."""
    out[:] = 0.0
    for k in range(len(code)):
        operation, target, a, b = code[k]
        if operation == _CONST:
            affine.constant(constants[k], registers[target])
        elif operation == _INPUT:
            registers[target] = inputs[a]
        elif operation == _OUTPUT:
            out[target] = registers[a]
        elif operation == _ASSIGN:
            registers[target] = registers[a]
        elif operation == _ADD:
            affine.add(registers[a], registers[b], 1.0, registers[target])
        elif operation == _SUB:
            affine.add(registers[a], registers[b], -1.0, registers[target])
        elif operation == _MUL:
            affine.mul(registers[a], registers[b], registers[target])
        elif operation == _NEG:
            affine.scaled(registers[a], -1.0, registers[target])
        elif operation == _TWICE:
            affine.scaled(registers[a], 2.0, registers[target])
        elif operation == _SQ:
            affine.mul(registers[a], registers[a], registers[target])
        elif operation == _DIV:
            affine.divided(registers[a], registers[b], registers[target])
        elif operation == _INV:
            affine.inverse(registers[a], registers[target])
        elif operation == _SQRT:
            affine.sqrt(registers[a], registers[target])
        elif operation == _SIN:
            affine.sin(registers[a], registers[target])
        else:
            affine.cos(registers[a], registers[target])
