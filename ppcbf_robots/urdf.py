"""Checks on a URDF before Pinocchio sees it: Pinocchio accepts most of what is refused here, and then returns NaN."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path

from ppcbf_robots.errors import InputError
from ppcbf_robots.specs import read_text

MAX_LINKS = 1000
XACRO = "this is a xacro file; expand it first with `xacro file.xacro > robot.urdf`"
NUMERIC = ("xyz", "rpy", "size", "radius", "length", "scale")


@dataclass(frozen=True)
class UrdfFacts:
    """What the checks learned on the way."""

    name: str
    mimic_joints: tuple[str, ...]


def check_urdf(path: Path) -> UrdfFacts:
    """Refuse what would crash or poison the dynamics; return what the model builder needs.

    Raises:
        InputError: naming the link or joint and the remedy.
    """
    text = read_text(path, "URDF")
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise InputError(f"{path}: a URDF must not contain DOCTYPE or ENTITY declarations; remove them")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise InputError(f"{path}: {XACRO if '<xacro:' in text else f'not valid XML ({error})'}") from None
    if any("xacro" in element.tag for element in root.iter()):
        raise InputError(f"{path}: {XACRO}")
    if root.tag != "robot":
        raise InputError(f"{path}: the root element is <{root.tag}>, a URDF's is <robot>")
    links = root.findall("link")
    if not links:
        raise InputError(f"{path}: the URDF has no <link>")
    if len(links) > MAX_LINKS:
        raise InputError(f"{path}: {len(links)} links; at most {MAX_LINKS} are read")
    _check_tree(path, root, [str(link.get("name")) for link in links])
    for part in root:
        _check_geometry(path, part)
    for link in links:
        _check_inertial(path, link)
    mimics = tuple(str(j.get("name")) for j in root.findall("joint") if j.find("mimic") is not None)
    return UrdfFacts(root.get("name") or path.stem, mimics)


def _check_tree(path: Path, root: ElementTree.Element, links: list[str]) -> None:
    parents: dict[str, str] = {}
    for joint in root.findall("joint"):
        name = str(joint.get("name"))
        ends = []
        for side in ("parent", "child"):
            element = joint.find(side)
            link = None if element is None else element.get("link")
            if link not in links:
                raise InputError(f"{path}: joint '{name}': its {side} link '{link}' does not exist")
            ends.append(str(link))
        if ends[1] in parents:
            raise InputError(f"{path}: link '{ends[1]}' is the child of two joints; closed loops are not supported")
        parents[ends[1]] = ends[0]
        if joint.get("type") in ("floating", "planar"):
            raise InputError(f"{path}: joint '{name}' is {joint.get('type')}; only fixed-base arms are supported")
        _check_axis_and_limits(path, joint, name)
    roots = [link for link in links if link not in parents]
    if len(roots) != 1:
        shown = ", ".join(f"'{r}'" for r in roots[:3]) or "none"
        raise InputError(f"{path}: a URDF has one root link, this one has {len(roots)} ({shown})")
    reached = {roots[0]}
    for _ in links:
        reached |= {child for child, parent in parents.items() if parent in reached}
    for link in links:
        if link not in reached:
            raise InputError(f"{path}: link '{link}' hangs in a loop of joints that does not start at '{roots[0]}'")


def _check_axis_and_limits(path: Path, joint: ElementTree.Element, name: str) -> None:
    if joint.get("type") == "fixed":
        return
    axis = joint.find("axis")
    if axis is not None:
        values = [_number(path, x, f"joint '{name}', axis") for x in (axis.get("xyz") or "1 0 0").split()]
        if len(values) != 3 or math.sqrt(sum(x * x for x in values)) < 1e-6:
            raise InputError(f"{path}: joint '{name}': the axis must be a vector of three numbers, not all zero")
    limit = joint.find("limit")
    if limit is None:
        if joint.get("type") in ("revolute", "prismatic"):
            raise InputError(
                f"{path}: joint '{name}' has no <limit>; give it one with lower, upper, effort and velocity"
            )
        return
    for k in ("effort", "velocity"):
        if limit.get(k) is None:
            raise InputError(f"{path}: joint '{name}': its <limit> has no {k}; write one, such as {k}=\"10\"")
        _number(path, str(limit.get(k)), f"joint '{name}', limit {k}")
    low, high = (_number(path, limit.get(k) or "0", f"joint '{name}', limit {k}", True) for k in ("lower", "upper"))
    if low > high:
        raise InputError(f"{path}: joint '{name}': lower limit {low} is above upper limit {high}; swap them")


def _check_geometry(path: Path, part: ElementTree.Element) -> None:
    """Placements and shapes of a link or joint: numbers only, for NaN in one of them would spread unseen."""
    for element in part.iter():
        for key in NUMERIC:
            for text in (element.get(key) or "").split():
                _number(path, text, f"{part.tag} '{part.get('name')}', {element.tag} {key}")


def _check_inertial(path: Path, link: ElementTree.Element) -> None:
    inertial = link.find("inertial")
    if inertial is None:
        return
    name = link.get("name")
    mass_element = inertial.find("mass")
    mass = _number(
        path, (mass_element.get("value") if mass_element is not None else None) or "0", f"link '{name}', mass"
    )
    if mass < 0.0:
        raise InputError(f"{path}: link '{name}': the mass is {mass} kg; correct it to a positive number")
    inertia = inertial.find("inertia")
    if inertia is None:
        return
    moments = {k: _number(path, inertia.get(k) or "0", f"link '{name}', inertia {k}") for k in inertia.attrib}
    for k in ("ixx", "iyy", "izz"):
        if moments.get(k, 0.0) < 0.0:
            raise InputError(
                f"{path}: link '{name}': the moment of inertia {k} is {moments[k]}; it must not be negative"
            )


def _number(path: Path, text: str, where: str, infinite_ok: bool = False) -> float:
    try:
        value = float(text)
    except ValueError:
        raise InputError(f"{path}: {where}: '{text}' is not a number") from None
    if math.isnan(value) or (math.isinf(value) and not infinite_ok):
        raise InputError(f"{path}: {where}: {value} is not a finite number")
    return value
