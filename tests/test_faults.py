"""Faults around the filter: each is survived on its level of the ladder, and the judge sees what is broken."""

from __future__ import annotations

import dataclasses
import json
import logging
import sys

import numpy as np
import pytest
from typer.testing import CliRunner

from ppcbf_robots import artefact_faults, faults
from ppcbf_robots.artefact_faults import artefact_outcomes
from ppcbf_robots.cli.main import app, main
from ppcbf_robots.fault_cases import CASES
from ppcbf_robots.faults import Fault, Loop, inject, judge, onset
from ppcbf_robots.filters import FilterConfig, Status
from ppcbf_robots.resources import find_robot
from ppcbf_robots.safety_filter import SafetyFilter, StepResult

WORST = {
    "none": "CORRECTING", "state NaN": "INVALID", "state NaN, long": "STOP", "state Inf": "INVALID",
    "wrong length": "INVALID", "not numbers": "INVALID", "2 pi wrap": "INVALID", "stale": "STOP", "frozen": "STOP",
    "time backwards": "INVALID", "time NaN": "INVALID", "too old": "INVALID", "delay 1 ms": "CORRECTING",
    "u_des NaN": "FAULT", "d_p NaN": "FAULT", "payload": "CORRECTING", "all by chance": "CORRECTING",
    "obstacle touches": "INFEASIBLE", "obstacle NaN": "FAULT", "obstacle unknown": "FAULT", "solver stalled": "FAULT",
    "solver raises": "FAULT", "solver NaN": "FAULT", "solver false": "FAULT", "solver wild": "FAULT",
    "L_g phi = 0": "INFEASIBLE", "network NaN": "FAULT",
}  # fmt: skip


def test_every_fault_is_survived_on_its_level_of_the_ladder(tmp_path):
    """Through the command: the Panda with the rate of a Franka, 1 N m per ms, and springs that press on the ball."""
    spec = tmp_path / "panda.yaml"
    springs = "[56.4, 15.2, 39.8, 32.0, 4.57, 4.57, 5.99]"  # all that gravity and damping leave
    facts = find_robot("panda").read_text() + "barrier: {gamma: 10.0}\n"
    spec.write_text(facts + f"controller: {{type: bounded_spring, max_spring: {springs}}}\n")
    done = CliRunner().invoke(app, ["faults", str(spec), "sphere", "--effort-rate", "1000", "--json"])
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)
    cases = {x["name"]: x for x in found["cases"]}
    assert found["survived"] is True and found["onset"] > 0.05
    assert list(cases)[: len(CASES)] == [f.name for f in CASES]
    assert {name: cases[name]["worst"] for name in WORST} == WORST
    for name, case in cases.items():
        assert case["survived"], case
        if case["worst"] == "REFUSED":
            continue
        assert case["finite"] and case["box"] and case["rate"] and case["quick"] and case["logged"], name
        if name not in ("obstacle touches", "slow loop"):
            assert case["clearance_mm"] > -1.0 and case["energy_J"] < 1.0, case
        if np.isfinite(next(f.lasts for f in CASES if f.name == name)):
            assert case["back"] and case["back_ms"] is not None, name
    assert sum(case["worst"] == "REFUSED" for case in cases.values()) == len(artefact_faults.CASES) + 1


def test_alarms_are_seen_where_logging_is_off(cartpole):
    """As after `ppcbf bench` in the same process, and left as it was."""
    barrier, config = cartpole.barrier("lb-cbf"), FilterConfig()
    logging.disable(logging.CRITICAL)
    try:
        assert inject(cartpole, barrier, config, CASES[1], 100).logged is True
        assert logging.root.manager.disable == logging.CRITICAL
    finally:
        logging.disable(logging.NOTSET)


def test_the_table_says_what_is_broken_and_exits_with_3(monkeypatch, capsys):
    """No step is quick enough, and two cases will do."""
    monkeypatch.setattr(faults, "LATENCY", 0.0)
    monkeypatch.setattr("ppcbf_robots.cli.faults.CASES", CASES[:2])
    monkeypatch.setattr(sys, "argv", ["ppcbf", "faults", "cartpole", "wall"])
    with pytest.raises(SystemExit) as exit_info:
        main()
    said = capsys.readouterr()
    assert exit_info.value.code == 3
    assert said.err.strip().endswith("error: 2 of 10 faults broke an invariant; the first: none")
    assert "quick" in said.out and "8 of 10 survived" in said.out


def test_without_a_filter_there_is_nothing_to_try(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["ppcbf", "faults", "cartpole", "wall", "--barrier", "none"])
    with pytest.raises(SystemExit) as exit_info:
        main()
    assert exit_info.value.code == 2
    assert "--barrier: nothing to try without a filter" in " ".join(capsys.readouterr().err.split())


# ---------------------------------------------------------------------------------------------- the judge


@pytest.fixture
def ran(cartpole, monkeypatch):
    """``ran(changes, fault)``: the outcome of 20 sound steps, of which step 10 has other fields."""
    monkeypatch.setattr(cartpole.model, "u_rate", np.full(2, 1000.0))

    def build(changes, messages=("a reason",), lasts=np.inf):
        loop = Loop(cartpole, cartpole.barrier("lb-cbf"), FilterConfig(), Fault("f", "i", lasts))
        sound = StepResult(np.array([5.0, 0.0]), Status.CORRECTING, "constraint active", 0.1, 0.1, "")
        loop.results = [sound] * 10 + [dataclasses.replace(sound, **changes)] + [sound] * 9
        loop.times, loop.V, loop.clearance = [1e-4] * 20, [1.0] * 20, [0.1] * 20
        return judge(loop, list(messages), 10)

    return build


@pytest.mark.parametrize(
    ("changes", "broken"),
    [
        ({}, []),
        ({"u": np.array([5.9, 0.0])}, []),
        ({"u": np.array([6.1, 0.0])}, ["rate"]),
        ({"u": np.array([99.0, 0.0])}, ["box", "rate"]),
        ({"u": np.array([99.0, 0.0]), "status": Status.STOP, "reason": "a reason"}, ["box"]),
        ({"u": np.array([np.nan, 0.0])}, ["finite", "box", "rate"]),
        ({"status": Status.FAULT, "reason": "a reason"}, []),
        ({"status": Status.FAULT, "reason": "another"}, ["logged"]),
        ({"status": Status.FAULT, "reason": ""}, ["logged"]),
    ],
)
def test_the_judge_sees_every_broken_invariant(ran, changes, broken):
    outcome = ran(changes)
    assert [k for k in ("finite", "box", "rate", "quick", "logged", "back") if getattr(outcome, k) is False] == broken
    assert outcome.survived == (not broken)
    assert outcome.back is None


def test_a_filter_that_does_not_come_back_is_seen(cartpole, monkeypatch):
    """As if STOP lasted for ever, or a bridge returned anything."""
    barrier, config, fault = cartpole.barrier("lb-cbf"), FilterConfig(), CASES[1]
    assert fault.name == "state NaN"
    first = onset(cartpole, barrier, config)
    assert 50 < first < 1000
    assert inject(cartpole, barrier, config, fault, first).survived
    bridge = SafetyFilter._hold
    monkeypatch.setattr(SafetyFilter, "_hold", lambda self, t, problem: dataclasses.replace(
        bridge(self, t, problem), u=np.full(2, np.nan)))  # fmt: skip
    assert inject(cartpole, barrier, config, fault, first).finite is False
    monkeypatch.setattr(SafetyFilter, "_hold", bridge)
    step = SafetyFilter.step

    def stuck(self, **told):
        return self._count(self._hold(told["t"], "stuck")) if self._invalid_steps else step(self, **told)

    monkeypatch.setattr(SafetyFilter, "step", stuck)
    assert inject(cartpole, barrier, config, fault, first).back is False


# ---------------------------------------------------------------------------------------------- artefacts


def test_spoiled_folders_are_refused_and_no_pickle_is_loaded(two_link, tmp_path):
    outcomes = {x.name: x for x in artefact_outcomes(two_link, None)}
    assert len(outcomes) == len(artefact_faults.CASES) + 1
    assert {x.worst for x in outcomes.values()} == {"REFUSED"} and all(x.survived for x in outcomes.values())
    expected = {"cut": "SHA-256 differs", "NaN": "not finite", "pickled": "not a safetensors file",
                "incomplete": "weights.safetensors is missing", "forged": "shapes do not fit",
                "of another": "another robot"}  # fmt: skip
    for name, text in expected.items():
        assert text in outcomes[f"artefact {name}"].reason


def test_a_loader_that_unpickles_would_be_caught(two_link, monkeypatch):
    """The trap works: whoever unpickles the weights opens a file, and the case is broken."""
    import pickle

    real = artefact_faults.load_barrier

    def careless(folder):
        content = (
            (folder / artefact_faults.WEIGHTS).read_bytes() if (folder / artefact_faults.WEIGHTS).exists() else b""
        )
        if content.startswith(b"c"):
            pickle.loads(content)
        return real(folder)

    monkeypatch.setattr(artefact_faults, "load_barrier", careless)
    broken = [x.name for x in artefact_outcomes(two_link, None) if not x.survived]
    assert broken == ["artefact pickled"]
