"""Robot specs in YAML, and the strictness that they share with worlds (:mod:`ppcbf_robots.world`).

Lengths are metres, angles radians, masses kilograms, efforts newton-metres or newtons.
"""

from __future__ import annotations

import re
import reprlib
from collections.abc import Hashable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from ppcbf_robots.errors import InputError

Array = NDArray[np.float64]
Coordinate = Annotated[float, Field(ge=-1e4, le=1e4)]  # [m]; farther than any arm reaches
Vector3 = Annotated[list[Coordinate], Field(min_length=3, max_length=3)]
Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
PerJoint = float | list[float] | dict[str, float]
"""One number for all moving joints, a list in joint order, or a mapping by joint name."""


class Spec(BaseModel):
    """Common strictness: no unknown keys, no NaN, no infinity."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)


class ControllerSpec(Spec):
    """Passive nominal controller (see :mod:`ppcbf_robots.controllers`)."""

    type: Literal["pd_gravity", "shaping", "bounded_spring"] = "bounded_spring"
    kp: PerJoint | None = None  # [N m/rad | N/m]
    kd: PerJoint | None = None  # [N m s/rad | N s/m]
    max_spring: PerJoint | None = None  # [N m | N], bounded_spring only


class BodyPrimitive(Spec):
    """A sphere fixed to a link or frame (radius 0 is a point), or with ``to`` a capsule from ``center`` to ``to``."""

    frame: str
    center: Vector3 = [0.0, 0.0, 0.0]
    to: Vector3 | None = None
    radius: NonNegative = 0.0


class BodySphere(Spec):
    """A sphere fixed to a link or frame; what every body primitive becomes."""

    frame: str
    center: Vector3
    radius: NonNegative


class DomainSpec(Spec):
    """The set X on which a barrier is trained, as one (low, high) pair per moving joint.

    With ``guard`` its bounds are rows of the filter too, so that a filtered arm stays in X (Remark 1 of the paper).
    """

    q: list[tuple[float, float]] | None = None
    v: list[tuple[float, float]] | None = None
    guard: bool = True

    @model_validator(mode="after")
    def _ordered(self) -> DomainSpec:
        for name, bounds in (("q", self.q), ("v", self.v)):
            for i, (low, high) in enumerate(bounds or []):
                if not low < high:
                    raise ValueError(f"{name}[{i}]: the lower bound {low} must be below the upper bound {high}")
        for i, (low, high) in enumerate(self.v or []):
            if not low < 0.0 < high:
                raise ValueError(f"v[{i}]: the range ({low}, {high}) must contain 0, or the robot could never rest")
        return self


class PayloadSpec(Spec):
    """A point mass carried rigidly by a frame."""

    frame: str
    mass: NonNegative
    com: Vector3 = [0.0, 0.0, 0.0]


class BarrierSpec(Spec):
    """Constants of the barrier formulas (paper, §5); the defaults suit most arms."""

    gamma: Annotated[float, Field(ge=0.1)] = 5.0  # [1/s], of eq. (25); less would keep an arm metres away
    alpha_pp: Positive = 100.0  # [J/m], the paper's alpha of the PP-CBF
    gamma_K: Positive = 10.0  # [1/s], of the PP-CBF's zeroing condition
    epsilon: Positive = 0.05  # [m/s], width of the band of eq. (21)
    act_within: Positive | None = None  # [m]: closed form acts where h <= this, too


class SelfCollisionSpec(Spec):
    """Body spheres must not touch each other, but for neighbours and links whose collision the SRDF disables."""

    srdf: str | None = None  # path beside the spec


class RobotSpec(Spec):
    """A robot: its URDF and everything the URDF does not say. Only ``urdf`` is required."""

    urdf: str
    package_dirs: list[str] = []
    moving: Annotated[list[str], Field(min_length=1)] | None = None  # all other joints are locked
    locked: dict[str, float] = {}
    effort: PerJoint | None = None
    velocity: PerJoint | None = None
    effort_rate: PerJoint | None = None  # [N m/s | N/s]: how fast the torque may change; None: at once
    position: dict[str, tuple[float, float]] = {}
    controller: ControllerSpec | None = None
    body: list[BodyPrimitive] | None = None
    self_collision: SelfCollisionSpec | None = None  # given: pairs of body spheres are rows too
    domain: DomainSpec = DomainSpec()
    start: list[float] | None = None
    start_velocity: list[float] | None = None
    goal: list[float] | None = None
    payload: PayloadSpec | None = None
    barrier: BarrierSpec = BarrierSpec()
    note: str | None = None  # shown with the warnings, e.g. which data are assumed

    @model_validator(mode="before")
    @classmethod
    def _nothing_empty(cls, data: Any) -> Any:
        for key, value in data.items() if isinstance(data, dict) else ():
            if value is None:
                hint = "; for all pairs write `self_collision: {}`" if key == "self_collision" else ""
                raise ValueError(f"{key}: nothing stands behind the colon; give a value or leave the line out{hint}")
        return data

    @model_validator(mode="after")
    def _ordered(self) -> RobotSpec:
        for joint, (low, high) in self.position.items():
            if not low < high:
                raise ValueError(f"position.{joint}: the lower limit {low} must be below the upper limit {high}")
        return self


class _Loader(yaml.SafeLoader):
    """YAML 1.2's idea of numbers and booleans, and no silent overwriting of repeated keys."""

    yaml_implicit_resolvers = {  # noqa: RUF012 - as the base class has it
        first: [(tag, rx) for tag, rx in resolvers if tag not in ("tag:yaml.org,2002:float", "tag:yaml.org,2002:bool")]
        for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        seen: set[str] = set()
        for key_node in (key for key, _ in node.value if isinstance(key, yaml.ScalarNode)):
            if key_node.value in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"the key '{key_node.value}' stands twice", key_node.start_mark
                )
            seen.add(key_node.value)
        return super().construct_mapping(node, deep)


_FLOAT = re.compile(r"^[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?$|^[-+]?\.(inf|Inf|INF)$|^\.(nan|NaN|NAN)$")
_Loader.add_implicit_resolver("tag:yaml.org,2002:float", _FLOAT, list("-+0123456789."))
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:bool", re.compile(r"^(true|True|TRUE|false|False|FALSE)$"), list("tTfF")
)

SHAPES = ("sphere", "half_space", "box", "capsule", "cylinder", "mesh")  # of obstacles, also in pydantic's locations
S = TypeVar("S", bound=Spec)
MAX_SPEC_BYTES = 4_000_000
LARGEST = 1e12  # whatever the unit; beyond, squares and products soon overflow
_XML_ENCODING = re.compile(rb"""<\?xml[^>]*\sencoding=["']([A-Za-z][A-Za-z0-9._-]*)["']""")


def read_text(path: Path, what: str) -> str:
    """Text of a file, or an :class:`InputError` that says why not."""
    try:
        if path.exists() and not (path.is_file() or path.is_dir()):
            raise InputError(f"{path} is a pipe or a device; give the path of a {what}")
        if path.stat().st_size > MAX_SPEC_BYTES * 10:
            raise InputError(f"{path}: larger than {MAX_SPEC_BYTES * 10 // 10**6} MB, which no {what} is")
        return _decoded(path.read_bytes())
    except FileNotFoundError:
        raise InputError(f"{what} not found: {path}") from None
    except IsADirectoryError:
        raise InputError(f"{path} is a folder; give the path of a {what}") from None
    except (UnicodeError, LookupError):
        raise InputError(f"{path}: not a text file in UTF-8, nor in what its first line declares") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None


def _decoded(content: bytes) -> str:
    """Text whose lines end with a newline alone; XML may say how it is encoded, all else is UTF-8."""
    declared = _XML_ENCODING.match(content)
    text = content.decode(declared[1].decode() if declared else "utf-8")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def load_spec(path: Path, kind: type[S], what: str) -> S:
    """Read and validate a YAML file.

    Raises:
        InputError: one sentence naming the file, the line or the key, and what was expected.
    """
    return validate(read_mapping(path, what, list(kind.model_fields)[:3]), kind, str(path))


def read_mapping(path: Path, what: str, keys: Sequence[str]) -> dict[str, Any]:
    """Plain data of a YAML file whose top level is a mapping with keys such as ``keys``; InputError as for a spec."""
    text = read_text(path, what)
    if len(text) > MAX_SPEC_BYTES:
        raise InputError(f"{path}: larger than {MAX_SPEC_BYTES // 10**6} MB, which no {what} is")
    try:
        documents = [x for x in yaml.load_all(text, Loader=_Loader) if x is not None]  # ROS ends one with ---
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        where = f"line {mark.line + 1}, column {mark.column + 1}" if mark else "unknown line"
        raise InputError(f"{path}: not valid YAML at {where}: {error.problem}") from None
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        raise InputError(f"{path}: not valid YAML ({' '.join(str(error).split())})") from None
    if len(documents) > 1:
        raise InputError(f"{path}: holds {len(documents)} YAML documents; keep one")
    data = documents[0] if documents else None
    if not isinstance(data, dict):
        raise InputError(f"{path}: expected a mapping with keys such as {', '.join(keys)}")
    return data


def validate(data: dict[str, Any], kind: type[S], where: str) -> S:
    """Validated spec from plain data; raises InputError with the first problem in words."""
    try:
        spec = kind.model_validate(data)
    except ValidationError as error:
        raise InputError(f"{where}: {_first_problem(error, kind)}") from None
    for key, number in _numbers(spec.model_dump()):
        if abs(number) > LARGEST:
            raise InputError(
                f"{where}: {key}: {number:g} is no quantity of a robot; the largest allowed is {LARGEST:g}"
            )
    return spec


def _numbers(data: Any, key: str = "") -> Iterator[tuple[str, float]]:
    """All numbers of plain data, with their keys."""
    if isinstance(data, float | int):
        yield key, data
    parts = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list | tuple) else ()
    for name, part in parts:
        yield from _numbers(part, f"{key}.{name}" if key else str(name))


def _first_problem(error: ValidationError, kind: type[Spec]) -> str:
    problem = error.errors(include_url=False)[0]
    loc = [str(x) for x in problem["loc"] if str(x) not in (*SHAPES, "float", "list[float]", "dict[str,float]")]
    key = ".".join(loc) or "file"
    if problem["type"] == "extra_forbidden":
        known = ", ".join(kind.model_fields) if len(loc) == 1 else "see the README's list of keys"
        return f"unknown key '{key}' (known: {known})"
    if problem["type"] == "missing":
        return f"the key '{key}' is missing"
    got = problem.get("input")
    shown = "" if isinstance(got, dict) or got is None else f", got {reprlib.repr(got)}"[:80]
    message = problem["msg"].removeprefix("Value error, ")
    if problem["type"] == "value_error":
        return f"{key}: {message}" if loc else message  # of the whole spec: it names the key itself
    return f"{key}: {message[0].lower()}{message[1:]}{shown}"


def per_joint(value: PerJoint, names: Sequence[str], what: str, default: Array | None = None) -> Array:
    """(nv,) array from one number, a list in joint order, or a mapping by joint name.

    Joints a mapping leaves out keep ``default``; without one they must all be named.
    """
    n = len(names)
    if isinstance(value, dict):
        unknown = [k for k in value if k not in names]
        if unknown:
            raise InputError(f"{what}: no moving joint is named '{unknown[0]}' (moving joints: {', '.join(names)})")
        missing = [k for k in names if k not in value]
        if missing and default is None:
            raise InputError(f"{what}: no value for joint '{missing[0]}'")
        base = np.zeros(n) if default is None else default.copy()
        for k, x in value.items():
            base[names.index(k)] = x
        return base
    if isinstance(value, list):
        return vector(value, n, what)
    return np.full(n, float(value))


def vector(value: Sequence[float], n: int, what: str) -> Array:
    """(n,) finite array, or an InputError that says what was expected and what came."""
    array = np.asarray(value, dtype=float)
    if array.shape != (n,):
        raise InputError(f"{what}: expected {n} numbers, one per moving joint, got {array.size}")
    if not np.all(np.isfinite(array)):
        raise InputError(f"{what}: every number must be finite, got {array.tolist()}")
    return array
