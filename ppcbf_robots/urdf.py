"""Checks on a URDF before Pinocchio sees it, and the clean copy that Pinocchio reads.

Pinocchio accepts most of what is refused here, and then returns NaN or crashes. The copy holds only what the method
needs, numbers written out in full, so that extensions, deep nesting and odd notation never reach a C++ parser.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ppcbf_robots.errors import InputError
from ppcbf_robots.specs import read_text
from ppcbf_robots.urdf_parts import JointFacts, clean_joint, clean_link

MAX_LINKS = 1000
XACRO = "this is a xacro file; expand it first with `xacro file.xacro > robot.urdf`"


@dataclass(frozen=True)
class UrdfFacts:
    """What the checks learned, and the clean copy."""

    name: str
    joints: dict[str, JointFacts]  # all but the fixed ones
    root: ElementTree.Element  # the clean <robot>, with mesh names as the URDF has them
    warnings: list[str]

    @property
    def xml(self) -> str:
        """The clean URDF without shapes, for the dynamics."""
        bare = ElementTree.Element("robot", self.root.attrib)
        for part in self.root:
            kept = bare if part.tag == "joint" else ElementTree.SubElement(bare, part.tag, part.attrib)
            kept.extend([part] if part.tag == "joint" else part.findall("inertial"))
        return ElementTree.tostring(bare, encoding="unicode")


def check_urdf(path: Path) -> UrdfFacts:
    """Refuse what would crash or poison the dynamics; return what the model builder needs.

    Raises:
        InputError: naming the link or joint and the remedy.
    """
    root = parse_xml(path)
    links, joints = root.findall("link"), root.findall("joint")
    if not links:
        raise InputError(f"{path}: the URDF has no <link>")
    if len(links) > MAX_LINKS:
        raise InputError(f"{path}: {len(links)} links; at most {MAX_LINKS} are read")
    link_names = _names(path, links)
    _names(path, joints)
    _check_tree(path, joints, link_names)
    clean = ElementTree.Element("robot", name=root.get("name") or path.stem)
    facts = {}
    for joint in joints:
        element, fact = clean_joint(path, joint)
        clean.append(element)
        if fact is not None:
            facts[fact.name] = fact
    warnings: list[str] = []
    clean.extend([clean_link(path, link, warnings) for link in links])
    return UrdfFacts(str(clean.get("name")), facts, clean, warnings)


def parse_xml(path: Path, what: str = "URDF") -> ElementTree.Element:
    """Root element of a URDF or SRDF (``what``), or an InputError that says why not."""
    text = read_text(path, what).lstrip("\ufeff")  # some editors begin a file with this mark
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise InputError(f"{path}: a {what} must not contain DOCTYPE or ENTITY declarations; remove them")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise InputError(f"{path}: {XACRO if '<xacro:' in text else f'not valid XML ({error})'}") from None
    if any("xacro" in element.tag for element in root.iter()):
        raise InputError(f"{path}: {XACRO}")
    if root.tag != "robot":
        raise InputError(f"{path}: the root element is <{root.tag}>, a {what}'s is <robot>")
    return root


def _names(path: Path, parts: Sequence[ElementTree.Element]) -> list[str]:
    names = [part.get("name") or "" for part in parts]
    for part, name in zip(parts, names, strict=True):
        if not name.strip():
            raise InputError(f"{path}: a <{part.tag}> has no name; give it one")
        if name == "universe":
            raise InputError(f"{path}: the {part.tag} '{name}' bears Pinocchio's name for the ground; rename it")
    for name, count in Counter(names).items():
        if count > 1:
            raise InputError(f"{path}: {count} {parts[0].tag}s are named '{name}'; give each its own name")
    return names


def _check_tree(path: Path, joints: Sequence[ElementTree.Element], links: list[str]) -> None:
    """One root, every link hanging from it, by joints whose ends exist."""
    known, parents = set(links), dict[str, str]()
    for joint in joints:
        name, ends = joint.get("name"), []
        for side in ("parent", "child"):
            element = joint.find(side)
            link = None if element is None else element.get("link")
            if link is None or link not in known:
                raise InputError(f"{path}: joint '{name}': its {side} link '{link}' does not exist")
            ends.append(link)
        if ends[1] in parents:
            raise InputError(f"{path}: link '{ends[1]}' is the child of two joints; closed loops are not supported")
        parents[ends[1]] = ends[0]
    roots = [link for link in links if link not in parents]
    if len(roots) != 1:
        shown = ", ".join(f"'{r}'" for r in roots[:3]) or "none"
        raise InputError(f"{path}: a URDF has one root link, this one has {len(roots)} ({shown})")
    reached, waiting = {roots[0]}, True
    while waiting:
        new = {child for child, parent in parents.items() if parent in reached} - reached
        reached, waiting = reached | new, bool(new)
    for link in links:
        if link not in reached:
            raise InputError(f"{path}: link '{link}' hangs in a loop of joints that does not start at '{roots[0]}'")
