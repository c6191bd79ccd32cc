"""Imports point one way, heavy libraries stay where they belong, and the runtime starts without them."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from importlib.metadata import packages_distributions
from importlib.resources import files
from pathlib import Path

import pytest

LAYERS = [
    ["errors"],
    ["results_file", "certificate"],
    ["sweep"],
    ["specs", "resources", "kernels"],
    ["network_kernel", "dynamics_kernel"],
    ["urdf", "urdf_parts", "world", "body", "body_geometry", "body_fit", "body_cache"],
    ["shapes", "world_shapes", "joints", "meshes", "mesh_contact", "rigid_tree"],
    ["robot", "world_files"],
    ["safety", "controllers", "network", "engines", "plant", "pushes", "batch_dynamics"],
    ["condense", "ending"],
    ["barriers", "derive", "derive_body", "holdable", "qp", "self_collision"],
    ["cutting_planes", "filters", "state_check", "slip"],
    ["closed_form", "qp_filter", "sent_torques", "status_log"],
    ["safety_filter", "problem"],
    ["rollout", "artefact", "evidence", "engine_mujoco", "viable_set", "symbolic"],
    ["lockstep"],
    ["campaign"],
    ["viability", "safe_sets", "nmpc", "faults", "band_statistics", "proof"],
    ["fault_cases", "artefact_faults"],
    ["learning"],
    ["band_tasks", "set_tasks", "benchmark"],
    ["export", "export_c", "plots", "plots_study", "viewer", "viewer_page", "viewer_shapes"],
    ["studies"],
    ["report", "report_page", "report_parts"],
    ["cli"],
]
"""From the bottom up, some of them packages. A module imports from lower layers and its own."""

OWNERS = {
    "numba": ["kernels"],
    "scipy": ["shapes", "body_fit", "ending", "viable_set", "band_statistics"],
    "proxsuite": ["qp"],
    "daqp": ["qp"],
    "qpsolvers": ["qp", "cli"],
    "meshcat": ["viewer", "viewer_page", "viewer_shapes"],
    "jinja2": ["report_page"],
    "matplotlib": ["plots", "plots_study", "studies.figures"],
    "mujoco": ["engine_mujoco"],
    "hj_reachability": ["viability"],
    "jax": ["viability"],
    "casadi": ["symbolic", "nmpc", "proof"],
    "pydantic": ["specs", "world", "certificate", "report"],
    "yaml": ["specs"],
    "typer": ["cli"],
    "torch": ["learning", "export", "studies", "cli", "band_tasks"],
    "joblib": ["sweep", "cli"],
    "distributed": ["sweep"],
}
LAZY = {
    "torch": ["export", "studies", "cli", "band_tasks"],
    "distributed": ["sweep"],
    "joblib": ["sweep", "cli"],
}  # there only inside functions

PACKAGE = "ppcbf_robots"
ROOT = Path(__file__).parent.parent
SOURCES = {
    **{p.stem: p for p in (ROOT / PACKAGE).glob("*.py")},
    **{f"learning.{p.stem}": p for p in (ROOT / PACKAGE / "learning").glob("*.py")},
    **{f"world_files.{p.stem}": p for p in (ROOT / PACKAGE / "world_files").glob("*.py")},
    **{f"proof.{p.stem}": p for p in (ROOT / PACKAGE / "proof").glob("*.py")},
    **{f"studies.{p.stem}": p for p in (ROOT / PACKAGE / "studies").glob("*.py")},
    **{f"cli.{p.stem}": p for p in (ROOT / "cli").glob("*.py")},
}
MODULES = sorted(name for name in SOURCES if name.split(".")[-1] != "__init__")


def imports(module: str) -> Iterator[tuple[str, bool]]:
    """(imported name in full, whether inside a function) of every import of a module."""
    tree = ast.parse(SOURCES[module].read_text(encoding="utf-8"))
    functions = [n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef)]
    inner = {id(n) for f in functions for n in ast.walk(f)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, id(node) in inner) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: relative import"
            yield from ((f"{node.module}.{alias.name}", id(node) in inner) for alias in node.names)


def own_imports(module: str) -> set[str]:
    """Modules of this package that a module imports, as in SOURCES."""
    found = set()
    for name, _ in imports(module):
        if name.split(".")[0] == PACKAGE:
            inside = name.removeprefix(f"{PACKAGE}.")
            parents = [inside, inside.rpartition(".")[0], f"{inside}.__init__"]
            found |= {next((p for p in parents if p in SOURCES), f"unknown: {name}")}
    return found


def layer(module: str) -> int:
    matches = [i for i, names in enumerate(LAYERS) if module in names or module.split(".")[0] in names]
    assert matches, f"{module} has no layer: give it one in {Path(__file__).name}"
    return matches[0]


def test_the_sources_are_found_and_installed():
    assert {"errors", "robot", "filters"} <= set(MODULES)
    assert Path(str(files(PACKAGE))) == ROOT / PACKAGE


@pytest.mark.parametrize("module", MODULES)
def test_imports_point_downwards(module):
    for other in own_imports(module):
        assert layer(other) <= layer(module), f"{module} imports {other}, which is above it"


def test_there_are_no_cycles():
    waiting = {module: own_imports(module) for module in MODULES}
    while waiting:
        free = [m for m, needs in waiting.items() if not needs & waiting.keys()]
        assert free, f"a cycle among {sorted(waiting)}"
        for module in free:
            del waiting[module]


def test_nothing_imports_through_the_package_itself():
    """The names that ``ppcbf_robots`` offers are for users; inside, each comes from its own module."""
    for module in MODULES:
        assert not {name for name in own_imports(module) if name.startswith("unknown")}, module


@pytest.mark.parametrize("library", OWNERS)
def test_libraries_stay_with_their_owners(library):
    users = set()
    for module in MODULES:
        owner = module if module in OWNERS[library] else module.split(".")[0]
        for name, lazy in imports(module):
            if name.split(".")[0] == library:
                users.add(owner)
                assert owner in OWNERS[library], f"{module} imports {library}"
                assert lazy or owner not in LAZY.get(library, []), f"{module} imports {library} at its top"
    assert users, f"nothing imports {library} any more: take it out of the table"


def test_every_library_imported_is_a_declared_one():
    """What another library happens to bring (typer once brought click) may be gone with its next version."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    required = [*project["dependencies"], *(r for extra in project["optional-dependencies"].values() for r in extra)]

    def normal(name: str) -> str:
        return re.sub(r"[-_.]+", "-", name).lower()

    declared = {normal(re.split(r"[\[<>=!~; ]", requirement)[0]) for requirement in required}
    providers = {**packages_distributions(), "pinocchio": ["pin"]}  # cmeel's packages are not listed there
    for module in MODULES:
        for library in {name.split(".")[0] for name, _ in imports(module)} - sys.stdlib_module_names - {PACKAGE}:
            brought = {normal(name) for name in providers.get(library, [library])}
            assert brought & declared, f"{module} imports {library}, which pyproject.toml does not ask for"


@pytest.mark.parametrize("module", ["safety_filter", "rollout", "artefact", "problem", "cli.main"])
def test_the_runtime_starts_without_heavy_libraries(module):
    heavy = ["torch", "meshcat", "matplotlib", "onnx", "mujoco", "hj_reachability", "casadi", "joblib", "distributed"]
    code = f"import sys, {PACKAGE}.{module}; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "[]"
