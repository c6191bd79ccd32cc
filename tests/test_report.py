"""The report in a real browser: what stands in it, what it needs, and what is refused."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ppcbf_robots.artefact import load_barrier, save_barrier
from ppcbf_robots.certificate import Certificate, Condition, overall, save_certificate, subject
from ppcbf_robots.cli.main import main
from ppcbf_robots.filters import FilterConfig
from ppcbf_robots.problem import load_problem


def run(*arguments: object, monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setattr(sys, "argv", ["ppcbf", *map(str, arguments)])
    with pytest.raises(SystemExit) as exit_info:
        main()
    return int(exit_info.value.code or 0)


@pytest.fixture
def trained(tmp_path, random_network) -> Path:
    """A barrier with small random weights, and what a training would have said of it."""
    two_link = load_problem("two_link", "circle")
    network = random_network("convex", two_link.model.nq, two_link.model.nv)
    params = {name: 0.1 * w if name.startswith("W") else w for name, w in network.params.items()}
    history = [
        {"iteration": i, "volume_kept": 0.9 + 0.01 * i, "torque": 0.0, "passivity": 0.0, "loss": 1.0 / (1 + i)}
        for i in range(5)
    ]
    training = {"converged": False, "reason": "stopped <early>", "steps": 40, "seconds": 3.0, "volume_kept": 0.94,
                "violations": 3, "samples": 1000, "worst_margin": -0.25, "attacked": 500, "preset": "default",
                "history": history}  # fmt: skip
    folder = tmp_path / "barrier"
    save_barrier(folder, two_link, "pp-ncbf", "convex", params, FilterConfig(), training)
    return folder


def certify(folder: Path, **conditions: Condition) -> None:
    data = load_barrier(folder).data
    found = Certificate(
        overall(conditions),
        conditions,
        subject(data, 1e-3, 1e-3),
        ["errors of the model"],
        12.0,
        "samples",
        {"attacked": 500_000},
    )
    save_certificate(folder, found)


SHORT = ("--duration", 1, "--steps", 100)


def test_report_says_what_is_known(trained, tmp_path, browser, monkeypatch, capsys):
    certify(
        trained,
        feasibility=Condition("bounded", "some torque serves all rows", 1.5e-4, 0.999, 69_075, 2, 0.01),
        passivity=Condition("refuted", "d_p is enough", None, None, None, 7, -0.3),
        input_bounds=Condition("refuted", "torque keeps its limits", 1e-4, 0.999, 69_075, 0, -0.1),
    )
    campaign = ("campaign", "two_link", "circle", "--barrier", trained, "--rollouts", 3, "--duration", 0.2)
    assert run(*campaign, "--out", tmp_path / "c", "--json", monkeypatch=monkeypatch) == 0
    facts = json.loads(capsys.readouterr().out)
    out = tmp_path / "report.html"
    given = ("report", trained, "--campaign", tmp_path / "c" / "campaign.json", *SHORT, "--out", out, "--json")
    assert run(*given, monkeypatch=monkeypatch) == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["verdict"], said["bytes"]) == ("refuted", out.stat().st_size)
    assert out.stat().st_size < 3e6
    browser.open(out.as_uri())
    text = re.sub(r"\s+", " ", browser.evaluate("document.body.innerText"))
    for expected in (
        "two_link in circle", "Training did not converge (stopped <early>) after 40 iterations",
        "keeps 94.0% of that of the untrained LB-CBF", "3 of 1000 uniform states",
        "least reserve is -0.2500 in 500 states",
        "Refuted: states are known", "at most 0.00015 of the band, with 99.9 % confidence (2 of 69,075 samples)",
        "7 violating states known", "A search tried 500,000: some",
        "(0 of 69,075 samples), and at states that are known",
        "passivity for one goal alone, not for these runs",
        "errors of the model", "3 runs of 0.2 s from random safe states to random goals",
        f"least h {facts['min_h']:.6f}", "runs with a contact 0", "still moving", "shoulder", "elbow", "sphere",
        f"least clearance to an obstacle {said['run']['clearance']:.5f} m", f"{said['median_us']:.0f} µs",
        "no safety-rated function",
    ):  # fmt: skip
        assert expected in text, f"{expected!r} is not in {text!r}"
    assert "another barrier" not in text
    other = tmp_path / "other.json"
    other.write_text(json.dumps(facts | {"barrier_sha256": "0" * 64}))  # trained again since, in the same folder
    given = ("report", trained, "--campaign", other, *SHORT, "--out", tmp_path / "other.html")
    assert run(*given, monkeypatch=monkeypatch) == 0
    assert "another barrier: one that was here before" in (tmp_path / "other.html").read_text("utf-8")
    pictures = browser.evaluate("[...document.images].map((x) => [x.decode && x.alt.length > 40, x.src.slice(0, 26)])")
    assert pictures == [[True, "data:image/svg+xml;base64,"]] * 3
    browser.evaluate("for (const x of document.images) x.loading = 'eager'")
    browser.until(lambda: browser.evaluate("[...document.images].every((x) => x.complete && x.naturalWidth > 300)"))
    browser.evaluate("document.getElementById('view').scrollIntoView()")
    frame = "document.getElementById('frame').contentDocument"
    browser.until(lambda: browser.evaluate(f"{frame} && {frame}.body && {frame}.body.dataset.ready") == "yes")
    assert "filtered run" in browser.evaluate(f"{frame}.body.innerText")
    headings = browser.evaluate("[...document.querySelectorAll('nav a')].map((a) => !!document.querySelector(a.hash))")
    assert len(headings) == 9 and all(headings)
    assert not browser.complaints
    assert not [url for url in browser.requests if not url.startswith(("file:", "data:", "about:", "blob:"))]


def test_a_dark_screen_gets_a_dark_page(trained, tmp_path, browser, monkeypatch):
    """And without certificate and campaign the report says how to get them."""
    out = tmp_path / "report.html"
    assert run("report", trained, *SHORT, "--out", out, monkeypatch=monkeypatch) == 0
    light, dark = (_background(browser, out, scheme) for scheme in ("light", "dark"))
    assert light > 200 and dark < 60
    text = browser.evaluate("document.body.innerText")
    assert f"Not verified: run ppcbf verify {trained}" in text
    assert f"ppcbf campaign two_link circle --barrier {trained}" in text


def _background(browser: Any, page: Path, scheme: str) -> float:
    browser.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])
    browser.open(page.as_uri())
    return float(np.median(browser.pixels()[:, :10]))


def test_a_robot_of_one_joint_has_no_slices(tmp_path, monkeypatch, capsys, random_network):
    """And a proved certificate is said to be one."""
    urdf = tmp_path / "one.urdf"
    urdf.write_text("""<robot name="one"><link name="base"/><link name="arm"><inertial><mass value="1"/>
      <origin xyz="0.5 0 0"/><inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
      <joint name="j" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>
      <limit lower="-1.5" upper="1.5" effort="20" velocity="2"/></joint></robot>""")
    spec, world = tmp_path / "one.yaml", tmp_path / "w.yaml"
    spec.write_text(
        "urdf: one.urdf\nbody:\n  - {frame: arm, center: [1, 0, 0], radius: 0.05}\n"
        "controller: {type: bounded_spring, kp: 40, kd: 4, max_spring: 10}\n"
    )
    world.write_text("obstacles:\n  - {name: <b>ball</b>, type: sphere, center: [0, 1.2, 0], radius: 0.1}\n")
    problem = load_problem(str(spec), str(world))
    network = random_network("convex", problem.model.nq, problem.model.nv)
    save_barrier(tmp_path / "b", problem, "pp-ncbf", "convex", network.params, FilterConfig(), {"converged": True})
    certify(tmp_path / "b", feasibility=Condition("proved", "some torque serves all rows", 0.0))
    out = tmp_path / "report.html"
    assert run("report", tmp_path / "b", *SHORT, "--out", out, monkeypatch=monkeypatch) == 0, capsys.readouterr().err
    page = out.read_text("utf-8")
    assert "this robot has one" in page and "on the whole band" in page and "Every condition holds" in page
    assert "&lt;b&gt;ball&lt;/b&gt;" in page and "<b>ball" not in page


def test_what_does_not_belong_is_refused(trained, tmp_path, monkeypatch, capsys):
    out = tmp_path / "report.html"
    wrong = tmp_path / "campaign.json"

    def refused(*arguments: object) -> str:
        assert run("report", *arguments, *SHORT, "--out", out, monkeypatch=monkeypatch) == 2
        assert not out.exists()
        return capsys.readouterr().err.replace("\n", " ")

    assert "campaign not found" in refused(trained, "--campaign", tmp_path / "nothing.json")
    wrong.write_text("[1]")
    assert "not the campaign.json of `ppcbf campaign`" in refused(trained, "--campaign", wrong)
    keys = ("rollouts", "contacts", "limit_violations", "torque_violations", "rate_violations", "diverged")
    wrong.write_text(json.dumps(dict.fromkeys(keys, 0) | {"robot": "two_link", "obstacles": "circle"}))
    assert "not the campaign.json of `ppcbf campaign`" in refused(trained, "--campaign", wrong)  # not whole
    wrong.write_text("[" * 100_000)
    assert "not the campaign.json of `ppcbf campaign`" in refused(trained, "--campaign", wrong)
    runs = ("campaign", "two_link", "circle", "--rollouts", 1, "--duration", 0.05, "--out", tmp_path / "c")
    assert run(*runs, monkeypatch=monkeypatch) == 0
    facts = json.loads((tmp_path / "c" / "campaign.json").read_text())
    wrong.write_text(json.dumps(facts | {"robot": "panda", "obstacles": "sphere"}))
    assert "a campaign of 'panda' in 'sphere'" in refused(trained, "--campaign", wrong)
    assert "is not a barrier folder" in refused(tmp_path)
    (trained / "certificate.json").write_text("{}")
    assert "not a certificate of this version" in refused(trained)
    (trained / "certificate.json").unlink()
    assert run("report", trained, "--out", tmp_path, monkeypatch=monkeypatch) == 2
    assert "is a folder; give a file" in capsys.readouterr().err.replace("\n", " ")
