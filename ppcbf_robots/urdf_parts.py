"""One link or one joint of a URDF: its numbers checked, and written anew with nothing else in it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from ppcbf_robots.errors import InputError
from ppcbf_robots.specs import Array

MOST_LENGTH = 100.0  # [m]; farther than any arm reaches
MOST = 1e6  # of any other number: kg, kg m², rad, mesh scale
UNSPECIFIED = 1e9  # limits from here on say "no limit known"
ROUNDING = 1e-12  # [kg m²]; exporters leave such negative moments
INERTIA_FLOOR = -1e-3  # least eigenvalue of an inertia over its largest that passes as rounding
MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
SHAPES = {"box": {"size": 3}, "sphere": {"radius": 1}, "cylinder": {"radius": 1, "length": 1}}


@dataclass(frozen=True)
class Mimic:
    """``position = multiplier * position of joint + offset``."""

    joint: str
    multiplier: float
    offset: float


@dataclass(frozen=True)
class JointFacts:
    """A joint that is not fixed, as the URDF has it."""

    name: str
    kind: str  # 'revolute', 'continuous' or 'prismatic'
    lower: float  # [rad | m], -inf where the URDF gives no range
    upper: float  # [rad | m], inf where the URDF gives no range
    effort: float  # [N m | N], 0 where the URDF gives none
    velocity: float  # [rad/s | m/s], 0 where the URDF gives none
    mimic: Mimic | None

    @property
    def resting(self) -> float:
        """Where the joint is held unless told otherwise: 0, or mid-range where 0 is out of range [rad | m]."""
        return 0.0 if self.lower <= 0.0 <= self.upper else 0.5 * (self.lower + self.upper)


def clean_joint(path: Path, joint: Element) -> tuple[Element, JointFacts | None]:
    """The joint with only what the method reads, and its facts unless it is fixed; InputError if it cannot be used."""
    name, kind = str(joint.get("name")), joint.get("type") or "none"
    if kind in ("floating", "planar"):
        raise InputError(f"{path}: joint '{name}' is {kind}; only fixed-base arms are supported")
    if kind not in ("fixed", "revolute", "continuous", "prismatic"):
        raise InputError(
            f"{path}: joint '{name}' has the type '{kind}'; write revolute, continuous, prismatic or fixed"
        )
    new = Element("joint", name=name, type=kind)
    for side in ("parent", "child"):
        element = joint.find(side)
        SubElement(new, side, link=str(None if element is None else element.get("link")))
    _origin(path, joint, new, f"joint '{name}'")
    if kind == "fixed":
        return new, None
    SubElement(new, "axis", xyz=_text(_axis(path, joint, name)))
    effort, velocity = (_force_limit(path, joint, name, k) for k in ("effort", "velocity"))
    lower, upper = (-math.inf, math.inf) if kind == "continuous" else _range(path, joint, name)
    low, high = (float(np.clip(x, -MOST, MOST)) for x in (lower, upper))  # the facts hold the infinite ones
    SubElement(new, "limit", lower=repr(low), upper=repr(high), effort=repr(effort), velocity=repr(velocity))
    return new, JointFacts(name, kind, lower, upper, effort, velocity, _mimic(path, joint, name))


def _axis(path: Path, joint: Element, name: str) -> list[float]:
    """Axis of any length but zero; Pinocchio makes it a unit vector."""
    axis = joint.find("axis")
    text = "1 0 0" if axis is None else axis.get("xyz") or "1 0 0"
    values = [number(path, x, f"joint '{name}', axis") for x in text.split()]
    if len(values) != 3 or math.hypot(*values) < 1e-6:
        raise InputError(f"{path}: joint '{name}': the axis must be a vector of three numbers, not all zero")
    return values


def _force_limit(path: Path, joint: Element, name: str, what: str) -> float:
    """Effort or velocity limit; 0, as URDFs write it, for none: missing, negative, infinite or absurdly large."""
    limit = joint.find("limit")
    text = None if limit is None else limit.get(what)
    value = 0.0 if text is None else number(path, text, f"joint '{name}', limit {what}", math.inf, infinite_ok=True)
    return value if 0.0 < value < UNSPECIFIED else 0.0


def _range(path: Path, joint: Element, name: str) -> tuple[float, float]:
    """Position limits; none where both are missing or 0, as URDFs of unknown range have them."""
    limit = joint.find("limit")
    given = [None if limit is None else limit.get(k) for k in ("lower", "upper")]
    low, high = (
        number(path, text or "0", f"joint '{name}', limit {k}", math.inf, infinite_ok=True)
        for k, text in zip(("lower", "upper"), given, strict=True)
    )
    if low > high:
        remedy = "swap them" if None not in given else "a missing one counts as 0, so give both"
        raise InputError(f"{path}: joint '{name}': lower limit {low} is above upper limit {high}; {remedy}")
    if low >= UNSPECIFIED or high <= -UNSPECIFIED:
        raise InputError(f"{path}: joint '{name}': the limits {low} .. {high} leave no position; correct them")
    if low == high == 0.0:
        return -math.inf, math.inf
    return -math.inf if low <= -UNSPECIFIED else low, math.inf if high >= UNSPECIFIED else high


def _mimic(path: Path, joint: Element, name: str) -> Mimic | None:
    mimic = joint.find("mimic")
    if mimic is None:
        return None
    multiplier, offset = (
        number(path, mimic.get(k) or default, f"joint '{name}', mimic {k}")
        for k, default in (("multiplier", "1"), ("offset", "0"))
    )
    return Mimic(mimic.get("joint") or "", multiplier, offset)


def clean_link(path: Path, link: Element, warnings: list[str]) -> Element:
    """The link with its inertia and shapes alone; InputError if a number in it cannot be used."""
    name = str(link.get("name"))
    new = Element("link", name=name)
    inertial = link.find("inertial")
    if inertial is not None:
        _inertial(path, inertial, new, name, warnings)
    for kind in ("visual", "collision"):
        shapes = link.findall(kind)
        unknown = sorted({form.tag for shape in shapes for form in shape.findall("geometry/*")} - {"mesh", *SHAPES})
        if unknown:  # half a link would pass for the whole
            named = ", ".join(f"<{tag}>" for tag in unknown)
            warnings.append(f"link '{name}': its {kind} geometry was left out, since {named} is no shape of URDF")
            continue
        for shape in shapes:
            _shape(path, shape, new, f"link '{name}'")
    return new


def _inertial(path: Path, inertial: Element, link: Element, name: str, warnings: list[str]) -> None:
    element = inertial.find("mass")
    mass = number(path, (None if element is None else element.get("value")) or "0", f"link '{name}', mass")
    if mass < 0.0:
        raise InputError(f"{path}: link '{name}': the mass is {mass} kg; correct it to a positive number")
    inertia = inertial.find("inertia")
    given = {} if inertia is None else inertia.attrib
    moments = {k: number(path, given.get(k) or "0", f"link '{name}', inertia {k}") for k in MOMENTS}
    for k in ("ixx", "iyy", "izz"):
        if moments[k] < -ROUNDING:
            raise InputError(
                f"{path}: link '{name}': the moment of inertia {k} is {moments[k]}; it must not be negative"
            )
    if mass > 0.0 and inertia is None:
        warnings.append(f"link '{name}' has a mass but no <inertia>: taken as a point mass")
    new = SubElement(link, "inertial")
    _origin(path, inertial, new, f"link '{name}'")
    SubElement(new, "mass", value=repr(mass))
    SubElement(new, "inertia", {k: repr(x) for k, x in moments.items()})


def least_eigenvalue(inertia: Array) -> float:
    """Least eigenvalue of an inertia matrix (3, 3) [kg m²]; what may be rounding counts as 0."""
    values = np.linalg.eigvalsh(inertia)
    return float(values[0]) if values[0] < INERTIA_FLOOR * abs(values[-1]) - ROUNDING else max(float(values[0]), 0.0)


def _shape(path: Path, shape: Element, link: Element, where: str) -> None:
    geometry = shape.find("geometry")
    for form in [] if geometry is None else list(geometry)[:1]:
        attributes = {}
        if form.tag == "mesh":
            scale = _numbers(path, form.get("scale") or "1 1 1", f"{where}, mesh scale", 3, MOST)
            attributes = {"filename": (form.get("filename") or "").strip(), "scale": _text(scale)}
        else:
            for key, count in SHAPES[form.tag].items():
                what = f"{where}, {form.tag} {key}"
                sizes = _numbers(path, form.get(key) or "", what, count, MOST_LENGTH)
                if min(sizes) < 0.0:
                    raise InputError(f"{path}: {what}: {min(sizes)} is negative; correct it")
                attributes[key] = _text(sizes)
        new = SubElement(link, shape.tag)
        _origin(path, shape, new, where)
        SubElement(SubElement(new, "geometry"), form.tag, attributes)


def _origin(path: Path, part: Element, new: Element, where: str) -> None:
    origin = part.find("origin")
    if origin is not None:
        xyz = _numbers(path, origin.get("xyz") or "0 0 0", f"{where}, origin xyz", 3, MOST_LENGTH)
        rpy = _numbers(path, origin.get("rpy") or "0 0 0", f"{where}, origin rpy", 3, MOST)
        SubElement(new, "origin", xyz=_text(xyz), rpy=_text(rpy))


def _numbers(path: Path, text: str, where: str, count: int, most: float) -> list[float]:
    values = [number(path, x, where, most) for x in text.split()]
    if len(values) != count:
        raise InputError(f"{path}: {where}: expected {count} number{'s' * (count > 1)}, got '{text[:40]}'")
    return values


def number(path: Path, text: str, where: str, most: float = MOST, infinite_ok: bool = False) -> float:
    """A number of at most ``most`` either way; InputError saying where it stands if it is none."""
    try:
        value = float(text)
    except ValueError:
        raise InputError(f"{path}: {where}: '{text[:40]}' is not a number") from None
    if math.isnan(value) or (math.isinf(value) and not infinite_ok):
        raise InputError(f"{path}: {where}: {value} is not a finite number")
    if abs(value) > most:
        raise InputError(f"{path}: {where}: {value:g} is more than {most:g}, which no arm has; check the units")
    return value


def _text(values: list[float]) -> str:
    return " ".join(map(repr, values))
