"""Meshes of a URDF: where they lie, and which of them are safe to read.

Dynamics need none. A mesh that is missing, of an unknown format or too large is left out and named in a warning.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.etree.ElementTree import Element, tostring

import coal
import numpy as np
import pinocchio as pin

from ppcbf_robots.body_geometry import longest
from ppcbf_robots.joints import lock
from ppcbf_robots.resources import is_file
from ppcbf_robots.specs import Array

MAX_BYTES = 50_000_000
MAX_TRIANGLES = 200_000  # five seconds of reading
MAX_NODES = 1000  # of a Collada scene; its reader recurses into them and runs out of stack
NEGLIGIBLE = 1e-4  # [m], length of a shape that counts as none
MAX_SIZE = 100.0  # [m], of a scaled mesh
FORMATS = (".stl", ".dae", ".obj")  # the reader of PLY crashes on faces of vertices that are not there


class Meshes:
    """Reads the meshes of one URDF, each once.

    Args:
        urdf: path of the URDF, from whose folder relative names start.
        package_dirs: folders that hold packages, or are one.
        root: the clean ``<robot>`` of :class:`ppcbf_robots.urdf.UrdfFacts`.
    """

    def __init__(self, urdf: Path, package_dirs: Sequence[Path], root: Element) -> None:
        self.urdf, self.package_dirs, self.root = urdf, package_dirs, root
        self.loader = coal.CachedMeshLoader()
        self._known: dict[tuple[str, str], tuple[Path | None, str]] = {}

    def geometry(
        self, kind: pin.GeometryType, full_model: pin.Model, locked: Mapping[str, float]
    ) -> tuple[pin.GeometryModel, dict[str, str]]:
        """Shapes of one kind with the locked joints fixed, and by link what is wrong with a mesh of it.

        Of collision geometry a moving joint keeps all or nothing, lest half of a link pass for the whole.
        """
        root, wrong = self._resolved("collision" if kind == pin.GeometryType.COLLISION else "visual")
        xml = tostring(root, encoding="unicode")
        full = pin.buildGeomFromUrdfString(full_model, xml, kind, None, [], self.loader)
        model, (shapes,) = lock(full_model, locked, [full])
        for name in [o.name for o in shapes.geometryObjects if longest(o.geometry) < NEGLIGIBLE]:
            shapes.removeGeometryObject(name)  # dummy links have such, to please a parser
        if kind == pin.GeometryType.COLLISION:
            joints = {model.frames[model.getFrameId(link, pin.FrameType.BODY)].parentJoint for link in wrong}
            for name in [o.name for o in shapes.geometryObjects if o.parentJoint in joints]:
                shapes.removeGeometryObject(name)
        return shapes, wrong

    def _resolved(self, kind: str) -> tuple[Element, dict[str, str]]:
        """A copy of the robot with the shapes of one kind, absolute mesh paths, and without the unreadable meshes."""
        root, wrong = copy.deepcopy(self.root), dict[str, str]()
        for link in root.findall("link"):
            for shape in link.findall("visual") + link.findall("collision"):
                mesh = shape.find("geometry/mesh")
                path, problem = (None, "") if mesh is None or shape.tag != kind else self._read(mesh)
                if problem:
                    wrong.setdefault(str(link.get("name")), problem)
                if problem or shape.tag != kind:
                    link.remove(shape)
                elif mesh is not None:
                    mesh.set("filename", str(path))
        return root, wrong

    def _read(self, mesh: Element) -> tuple[Path | None, str]:
        """Path of a mesh that could be read, and the problem of one that could not."""
        name, scale = str(mesh.get("filename")), str(mesh.get("scale"))
        if (name, scale) not in self._known:
            path = find_mesh(name, self.urdf, self.package_dirs)
            problem = "is not there" if path is None else mesh_problem(path)
            if path is not None and not problem:
                problem = self._load(path, np.array([float(x) for x in scale.split()]))
            self._known[name, scale] = path, f"'{name}' {problem}" if problem else ""
        return self._known[name, scale]

    def _load(self, path: Path, scale: Array) -> str:
        try:
            vertices = np.asarray(self.loader.load(str(path), scale).vertices())
        except (ValueError, RuntimeError, MemoryError):
            return "cannot be read"
        size = float(np.abs(vertices).max(initial=0.0)) if np.all(np.isfinite(vertices)) else np.inf
        return "" if size <= MAX_SIZE else f"reaches {size:.3g} m from its origin; check its scale"


def find_mesh(name: str, urdf: Path, package_dirs: Sequence[Path]) -> Path | None:
    """The file that a mesh name of a URDF stands for, or None.

    ``package://name/rest`` is tried as name/rest in every package folder, and then as rest, for a package kept under
    another name; other names are paths, relative ones from the URDF's folder and then from the package folders.
    """
    name = name.replace("\\", "/")
    if not name:
        return None
    package = re.match(r"(?:package|model)://(.*)", name)
    if package:
        inside = package[1].split("/", 1)[-1]
        candidates = [folder / rest for rest in (package[1], inside) for folder in package_dirs]
    else:
        plain = name.removeprefix("file://")
        candidates = [folder / plain for folder in (urdf.resolve().parent, *package_dirs)]
    return next((c for c in candidates if is_file(c)), None)


def mesh_problem(path: Path) -> str:
    """Why a mesh is not given to the loader, or an empty text."""
    if path.suffix.lower() not in FORMATS:
        return f"has an unknown format; convert it to {', '.join(f[1:] for f in FORMATS)}"
    try:
        if path.stat().st_size > MAX_BYTES:
            return f"is larger than {MAX_BYTES // 10**6} MB; simplify it"
        content = path.read_bytes()
    except OSError as error:
        return f"cannot be read ({error.strerror})"
    triangles = count_triangles(path.suffix.lower(), content)
    if triangles > MAX_TRIANGLES:
        return f"has {triangles} triangles, more than {MAX_TRIANGLES}; simplify it"
    nodes = len(re.findall(rb"<(?:[\w.-]+:)?node\b", content))
    return f"has {nodes} nodes, more than {MAX_NODES}; merge them" if nodes > MAX_NODES else ""


def count_triangles(suffix: str, content: bytes) -> int:
    """Triangles (or faces) that a mesh announces, without building them."""
    match suffix:
        case ".stl":
            binary = len(content) >= 84 and len(content) == 84 + 50 * int.from_bytes(content[80:84], "little")
            return (len(content) - 84) // 50 if binary else content.count(b"endfacet")
        case ".obj":
            return content.count(b"\nf ")
    found = re.findall(rb"<(?:triangles|polylist|polygons)\b[^>]{0,200}?\bcount=[\"'](\d{1,18})", content)
    return sum(map(int, found))
