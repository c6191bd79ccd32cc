"""Every command, Python block and YAML block of the README runs; long commands at reduced size."""

from __future__ import annotations

import dataclasses
import re
import shlex
import sys
from pathlib import Path

import pytest
import yaml

from ppcbf_robots.cli.main import main
from ppcbf_robots.learning.presets import PRESETS
from ppcbf_robots.specs import RobotSpec
from ppcbf_robots.world import WorldSpec

README = (Path(__file__).parent.parent / "README.md").read_text(encoding="utf-8")
SMALLER = {
    "train": ["--iterations", "40", "--time-limit", "10"],
    "simulate": ["--duration", "0.2"],
    "bench": ["--steps", "100"],
    "bench train": ["--iterations", "10"],
    "compare": ["--iterations", "30", "--duration", "0.3"],
    "campaign": ["--rollouts", "2", "--duration", "0.2"],
    "report": ["--duration", "0.2", "--steps", "100"],
    "sweep": ["--robots", "two_link", "--worlds", "circle", "--seeds", "0", "--iterations", "10"],
    "verify": ["--time-limit", "2", "--samples", "50", "--seconds", "1", "--jobs", "2"],
    "study convergence": ["--runs", "1", "--rates", "1e-4", "--preset", "default", "--iterations", "10"],
    "study variability": ["--seeds", "0", "--iterations", "10"],
    "study safe-set": ["--samples", "200", "--boundary", "10", "--nodes", "9"],
    "study nmpc": ["--grid", "3", "--steps", "10", "--nodes", "9"],
}


LESS = {"rays": 3000, "test_samples": 500, "refinements": 1}  # of what training looks at
SHORTER = {"search_rounds": 1, "attack_rounds": 5}  # searches, where there are any


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, flags=re.DOTALL)


def commands() -> list[list[str]]:
    """Arguments of every `ppcbf` command, also of those behind `&&`, without comments."""
    lines = [part.strip() for block in blocks("bash") for line in block.splitlines() for part in line.split("&&")]
    words = [shlex.split(line, comments=True) for line in lines]
    return [w[1:] for w in words if w and Path(w[0]).name == "ppcbf"]


def name_of(arguments: list[str]) -> str:
    """The command, with the one below it if it is a group."""
    return " ".join(arguments[: 2 if arguments[0] == "study" or arguments[:2] == ["bench", "train"] else 1])


def test_the_readme_names_every_command() -> None:
    one = {
        "info",
        "train",
        "simulate",
        "view",
        "export",
        "compare",
        "convert",
        "bench",
        "bench train",
        "sweep",
        "faults",
        "campaign",
        "report",
        "verify",
    }
    studies = {f"study {name}" for name in ("convergence", "variability", "safe-set", "nmpc")}
    assert {name_of(c) for c in commands()} == one | studies


@pytest.mark.slow
def test_commands_and_python_run_in_their_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name, preset in PRESETS.items():
        fewer = LESS | {k: n for k, n in SHORTER.items() if getattr(preset, k)}
        monkeypatch.setitem(PRESETS, name, dataclasses.replace(preset, **fewer))
    for arguments in commands():
        monkeypatch.setattr(sys, "argv", ["ppcbf", *arguments, *SMALLER.get(name_of(arguments), [])])
        with pytest.raises(SystemExit) as exit_info:
            main()
        unsure = ("train", "compare", "sweep", "campaign", "verify")  # reduced training may not converge
        allowed = {0, 3} if arguments[0] in unsure else {0}
        assert exit_info.value.code in allowed, arguments
        for option in ("--out", "--html"):
            if option in arguments:
                assert Path(arguments[arguments.index(option) + 1]).exists(), arguments
    names: dict[str, object] = {}  # each block goes on from the one before
    for block in blocks("python"):
        exec(compile(block, "README.md", "exec"), names)


def test_yaml_examples_are_valid() -> None:
    world, robot = (yaml.safe_load(block) for block in blocks("yaml"))
    WorldSpec.model_validate(world)
    assert set(RobotSpec.model_validate(robot).model_fields_set) == set(RobotSpec.model_fields)


def test_both_set_up_commands_stand_on_the_first_screen() -> None:
    first, second = re.findall(r"^python3 -m venv .*$", README, flags=re.MULTILINE)
    assert "ppcbf view" in first and second.endswith("pytest")
    assert README[: README.index(second)].count("\n") < 40
