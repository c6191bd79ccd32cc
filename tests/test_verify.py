"""Samples and their bounds, the certificate and what it is bound to, and the command."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import shutil
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import binom, kstest

from ppcbf_robots.artefact import load_barrier, save_barrier
from ppcbf_robots.band_statistics import clopper_pearson, count_violations, independent_band
from ppcbf_robots.band_tasks import conditions
from ppcbf_robots.certificate import NAME, Condition, overall
from ppcbf_robots.cli.main import main
from ppcbf_robots.cli.train import load_states
from ppcbf_robots.evidence import uniform_band
from ppcbf_robots.filters import FilterConfig, Status
from ppcbf_robots.learning.falsifier import no_network
from ppcbf_robots.learning.margin_descent import MarginDescent
from ppcbf_robots.problem import load_problem
from ppcbf_robots.safety_filter import SafetyFilter
from ppcbf_robots.specs import BarrierSpec


def run_cli(*arguments):
    """``ppcbf arguments...`` in this process: its exit code, and what it wrote."""
    out, err = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        patch.setattr(sys, "argv", ["ppcbf", *map(str, arguments)])
        try:
            code = main() or 0
        except SystemExit as end:
            code = int(end.code or 0)
    return SimpleNamespace(code=code, stdout=out.getvalue(), stderr=err.getvalue())


def facts(*arguments, code=0):
    done = run_cli(*arguments, "--json")
    assert done.code == code, done.stderr
    return json.loads(done.stdout)


def test_the_confidence_bound():
    assert clopper_pearson(0, 69_075, 0.999) <= 1e-4 < clopper_pearson(0, 69_074, 0.999)
    for k, n in [(0, 50), (3, 200), (17, 60)]:
        p = clopper_pearson(k, n, 0.99)
        assert binom.cdf(k, n, p) == pytest.approx(0.01, rel=1e-6)  # so few or fewer are that unlikely
    assert clopper_pearson(5, 5, 0.9) == 1.0


@pytest.mark.parametrize("learned", [False, True])
def test_independent_states_are_uniform_on_the_band(two_link, random_network, learned):
    """Against plain rejection through the barrier's own rows; no configuration comes twice."""
    network = random_network("convex", 2, 2, seed=2) if learned else None
    barrier = two_link.barrier("pp-ncbf", network)
    q, v, tried = independent_band(two_link, barrier, 400, np.random.default_rng(0))
    assert len(q) == len(np.unique(q[:, 0])) == 400
    rng, domain, kept, drawn = np.random.default_rng(1), two_link.robot.domain, [], 0
    while len(kept) < 400:
        x, drawn = np.concatenate([domain.sample_q(rng, 1)[0], domain.sample_v(rng, 1)[0]]), drawn + 1
        dyn = two_link.model.evaluate(x[:2], x[2:])
        safety = two_link.safety.evaluate(dyn)
        if safety.h.min() >= 0.0 and 0.0 <= barrier.rows(dyn, safety).phi.min() <= barrier.spec.epsilon:
            kept.append(x)
    for i, (a, b) in enumerate(zip(np.concatenate([q, v], 1).T, np.array(kept).T, strict=True)):
        assert kstest(a, b).pvalue > 1e-4, i
    assert 400 / tried == pytest.approx(400 / drawn, rel=0.35)


def test_first_order_terms_are_those_of_the_full_evaluation(panda, states):
    q, v = (np.array(x) for x in zip(*states(panda, 5), strict=True))
    full, (h, grad) = panda.safety.evaluate(panda.model.evaluate_batch(q, v)), panda.safety.first_order(q)
    np.testing.assert_allclose(h, full.h, atol=1e-12)
    np.testing.assert_allclose(grad, full.grad, atol=1e-12)


def test_violations_are_counted_by_kind(cartpole):
    """LB-CBF and PP-CBF of the cart-pole: states known to break the one or the other condition."""
    rng = np.random.default_rng(0)
    lb = cartpole.barrier("lb-cbf")
    q, v, _ = uniform_band(cartpole, lb, 300, rng)
    qp = count_violations(cartpole, lb, FilterConfig(), True, q, v)
    torque = count_violations(cartpole, lb, FilterConfig(kind="closed-form", metric="torque"), True, q, v)
    assert qp.samples == 300 and 5 < qp.violations["feasibility"] < 60  # 6.5 % of the boundary
    assert qp.violations["input_bounds"] == 0 and qp.violations["passivity"] >= qp.violations["feasibility"]
    assert torque.violations["input_bounds"] > 0 and torque.violations["passivity"] > 0
    blind = count_violations(cartpole, lb, FilterConfig(), False, q, v)
    assert blind.violations["passivity"] == 0 and blind.violations["feasibility"] == qp.violations["feasibility"]
    assert len(qp.states["feasibility"][0]) == 4


def test_the_weakest_verdict_is_the_whole_one():
    def verdict(*names):
        return overall({str(i): Condition(name, "") for i, name in enumerate(names)})

    assert verdict("proved", "bounded") == "bounded"
    assert verdict("proved", "undecided", "bounded") == "undecided"
    assert verdict("undecided", "refuted", "proved") == "refuted"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The LB-CBF of the two-link in a barrier folder, as a network without units, with its certificate of samples."""
    path = tmp_path_factory.mktemp("verify") / "b"
    problem = load_problem("two_link", "circle")
    save_barrier(path, problem, "pp-ncbf", "convex", no_network(problem), FilterConfig(), {})
    done = facts("verify", path, "--method", "samples", "--samples", "300", "--seconds", "1", "--jobs", "2")
    assert done["method"] == "samples" and done == json.loads((path / NAME).read_text()) | {"files": done["files"]}
    return path


def copy(folder, tmp_path):
    shutil.copytree(folder, tmp_path / "b")
    return tmp_path / "b"


def test_samples_end_with_bounds(folder):
    certificate = load_barrier(folder).certificate
    assert certificate is not None and set(certificate.conditions) == {"input_bounds", "feasibility", "passivity"}
    for name, c in certificate.conditions.items():
        assert (c.samples, c.confidence) == (300, 0.999)
        assert c.bound == pytest.approx(clopper_pearson(c.violations, 300, 0.999))
        assert (c.verdict == "bounded") == (c.violations == 0), name
    assert certificate.details["attacked"] > 0
    assert not (folder / "verify.jsonl").exists()


def test_a_certificate_of_other_weights_is_ignored_with_a_sentence(folder, tmp_path, caplog):
    path = copy(folder, tmp_path)
    problem = load_problem("two_link", "circle")
    other = problem.with_barrier_spec(BarrierSpec(gamma=3.0))
    save_barrier(path, other, "pp-ncbf", "convex", no_network(problem), FilterConfig(), {})
    with caplog.at_level("WARNING"):
        assert load_barrier(path).certificate is None
    assert "belongs to another barrier" in caplog.text and "ppcbf verify" in caplog.text


BROKEN = [
    "", "[]", '{"format": 1}', '{"format": 1, "conditions": {}, "verdict": "proved"}', "[" * 100_000,
    {"subject": []}, {"subject": None}, {"details": None}, {"details": {"power": "x"}},
    {"conditions": {"passivity": 1}}, {"not_covered": 1}, {"seconds": "x"}, {"verdict": "certain"},
]  # fmt: skip


@pytest.mark.parametrize("content", BROKEN, ids=lambda x: str(x)[:40])
def test_a_broken_certificate_is_ignored_with_a_sentence(folder, tmp_path, caplog, content):
    path = copy(folder, tmp_path)
    if isinstance(content, dict):  # a good one but for this
        content = json.dumps(json.loads((path / NAME).read_text()) | content)
    (path / NAME).write_text(content)
    with caplog.at_level("WARNING"):
        assert load_barrier(path).certificate is None
    assert "not a certificate" in caplog.text


def test_a_verdict_that_its_conditions_do_not_bear_out_is_refused(folder, tmp_path):
    path = copy(folder, tmp_path)
    data = json.loads((path / NAME).read_text())
    data["verdict"] = "proved"
    (path / NAME).write_text(json.dumps(data))
    assert load_barrier(path).certificate is None


def test_the_line_names_an_allowance(folder):
    certificate = load_barrier(folder).certificate
    allowed = dataclasses.replace(certificate, details={"power": 0.3})
    assert "0.3 W beyond d_p" in allowed.line() and "W" not in certificate.line()


def test_simulate_shows_the_certificate_and_what_it_is_not_about(folder, tmp_path):
    run = ("simulate", "two_link", "circle", "--barrier", folder, "--duration", "0.01", "--out", tmp_path / "t.npz")
    said = load_barrier(folder).certificate.line()
    assert f"certificate        {said}" in run_cli(*run).stdout
    assert facts(*run)["certificate"] == said
    assert "for another goal, not for this run" in facts(*run, "--goal", "0.5,0.5")["certificate"]
    assert "for the qp filter" in facts(*run, "--metric", "torque")["certificate"]
    assert facts(*run[:3], *run[5:])["certificate"] is None


def test_samples_of_a_barrier_that_was_there_before_do_not_count(folder, tmp_path, monkeypatch):
    """The same weights with another gamma are another barrier, for which what is half done is no evidence."""
    path, short = copy(folder, tmp_path), ("--method", "samples", "--samples", "100", "--seconds", "0", "--jobs", "1")
    monkeypatch.setattr("ppcbf_robots.cli.verify.conditions", lambda *a: (_ for _ in ()).throw(KeyboardInterrupt))
    assert run_cli("verify", path, *short).code == 130
    monkeypatch.undo()
    record = json.loads((path / "verify.jsonl").read_text())
    record["result"]["seconds"] = 1000.0
    half_done = json.dumps(record) + "\n"
    (path / "verify.jsonl").write_text(half_done)
    problem = load_problem("two_link", "circle")
    drawn = []
    monkeypatch.setattr(
        "ppcbf_robots.cli.verify.conditions",
        lambda stored, records, c: drawn.append(records) or conditions(stored, records, c),
    )
    resumed = facts("verify", path, *short)  # goes on: nothing is drawn again, and its time counts
    assert resumed["seconds"] >= 1000.0
    save_barrier(path, problem.with_barrier_spec(BarrierSpec(gamma=3.0)), "pp-ncbf", "convex", no_network(problem),
                 FilterConfig(), {})  # fmt: skip
    (path / "verify.jsonl").write_text(half_done)
    facts("verify", path, *short)
    assert [json.loads(half_done)["key"]] == [r["key"] for r in drawn[0]]
    assert json.loads(half_done)["key"] not in [r["key"] for r in drawn[1]]


def test_a_proof_stops_in_time_and_says_what_is_open(folder, tmp_path):
    path = copy(folder, tmp_path)
    found = facts("verify", path, "--time-limit", "1", "--jobs", "1", code=3)
    assert found["method"] == "proof" and not found["details"]["complete"]
    assert found["conditions"]["boundary_passivity"]["verdict"] == "proved"
    assert found["conditions"]["feasibility"]["verdict"] in ("undecided", "refuted")
    assert (path / "verify.npz").is_file()


ONE_JOINT = """<robot name="one"><link name="base"/><link name="arm"><inertial><mass value="1"/>
  <origin xyz="0.5 0 0"/><inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="j" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>
  <limit lower="-1.5" upper="1.5" effort="{effort}" velocity="2"/></joint></robot>"""


@pytest.mark.parametrize(("effort", "verdict", "code"), [(20, "proved", 0), (0.3, "refuted", 3)])
def test_a_robot_of_one_joint_from_urdf_to_verdict(tmp_path, effort, verdict, code):
    """Strong enough it is proved; too weak to brake it is refuted, with states that training can begin with."""
    (tmp_path / "one.urdf").write_text(ONE_JOINT.format(effort=effort))
    (tmp_path / "one.yaml").write_text(
        "urdf: one.urdf\nbody:\n  - {frame: arm, center: [1, 0, 0], radius: 0.05}\n"
        "controller: {type: bounded_spring, kp: 0.1, kd: 0.01, max_spring: 0.1}\n"
    )
    (tmp_path / "w.yaml").write_text("obstacles:\n  - {name: ball, type: sphere, center: [0, 1.2, 0], radius: 0.1}\n")
    problem = load_problem(str(tmp_path / "one.yaml"), str(tmp_path / "w.yaml"))
    save_barrier(tmp_path / "b", problem, "pp-ncbf", "convex", no_network(problem), FilterConfig(), {})
    found = facts("verify", tmp_path / "b", "--jobs", "1", code=code)
    assert (found["verdict"], found["method"]) == (verdict, "proof")
    assert load_barrier(tmp_path / "b").certificate.verdict == verdict
    states = tmp_path / "b" / "counterexamples.npz"
    assert states.exists() == (code == 3)
    if code:
        q, v = load_states(states, problem.model)
        dyn = problem.model.evaluate(q[0], v[0])
        lb = problem.barrier("lb-cbf")
        runtime = SafetyFilter(problem.model, problem.safety, lb)
        nominal = problem.robot.controller.evaluate(dyn)
        assert runtime.filter(dyn, nominal.u, float(nominal.d_p)).status >= Status.PASSIVITY_DROPPED


def test_learning_takes_counterexamples_and_refuses_what_is_none(tmp_path, monkeypatch):
    taken = []
    monkeypatch.setattr(MarginDescent, "add_counterexamples", lambda self, q, v: taken.append((q, v)))
    q, v, _ = uniform_band(p := load_problem("two_link", "circle"), p.barrier("lb-cbf"), 5, np.random.default_rng(0))
    np.savez(tmp_path / "good.npz", q=q, v=v)
    np.savez(tmp_path / "bad.npz", q=q, v=v[:, :1])
    np.savez(tmp_path / "nan.npz", q=q * np.nan, v=v)
    (tmp_path / "text.npz").write_text("text")
    train = ("train", "two_link", "circle", "--out", tmp_path / "b", "--iterations", "2")
    train = (*train, "--time-limit", "1", "--counterexamples")
    for name, words in (("bad", "this robot needs"), ("nan", "not finite"), ("text", "arrays q and v"), ("no", "npz")):
        done = run_cli(*train, tmp_path / f"{name}.npz")
        assert done.code == 2 and words in " ".join(done.stderr.split()), done.stderr
    assert not taken
    assert run_cli(*train, tmp_path / "good.npz").code in (0, 3)
    np.testing.assert_array_equal(taken[0][0], q)
    np.testing.assert_array_equal(taken[0][1], v)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--confidence", "1.5"], "between 0 and 1"),
        (["--power", "inf"], "finite"),
        (["--robot", "cartpole"], "another"),
    ],
)
def test_wrong_use_is_one_sentence(folder, arguments, words):
    done = run_cli("verify", folder, *arguments)
    assert done.code == 2 and words in " ".join(done.stderr.split())
    assert "Traceback" not in done.stderr


def test_a_proof_that_cannot_be_is_refused_or_replaced(folder, tmp_path):
    problem = load_problem("two_link", "table_boxes")
    save_barrier(tmp_path / "b", problem, "pp-ncbf", "convex", no_network(problem), FilterConfig(), {})
    done = run_cli("verify", tmp_path / "b", "--method", "proof")
    assert done.code == 2 and "'table' is neither" in " ".join(done.stderr.split())


def test_a_proof_for_other_masses_stands_beside_that_of_the_model(folder, tmp_path):
    copied = tmp_path / "barrier"
    shutil.copytree(folder, copied)
    before = {p.name: p.read_bytes() for p in copied.iterdir()}
    found = facts("verify", copied, "--mass-error", 2.5, "--time-limit", 1, "--jobs", 1, code=3)
    assert found["details"]["mass_error"] == 0.025 and found["details"]["largest_excess_power"] is None
    assert "up to 2.5 %" in found["conditions"]["feasibility"]["statement"]
    assert any("different factors" in x for x in found["not_covered"])
    assert found["files"][0].endswith("certificate_mass_2.5.json")
    assert all((copied / name).read_bytes() == content for name, content in before.items())
    refused = run_cli("verify", copied, "--mass-error", 2.5, "--method", "samples")
    assert refused.code == 2 and "--mass-error is for proofs" in refused.stderr
