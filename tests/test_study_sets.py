"""``ppcbf study safe-set`` and ``ppcbf study nmpc`` at tiny size."""

from __future__ import annotations

import csv
import json
import pickle
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from ppcbf_robots.cli.main import app
from ppcbf_robots.cli.study_nmpc import overlaps
from ppcbf_robots.errors import InputError
from ppcbf_robots.nmpc import Settings, judge
from ppcbf_robots.set_tasks import known_barriers

DATA = Path(__file__).parent / "data"
GANTRY = str(DATA / "gantry.yaml")


def run(*arguments: str) -> dict[str, object]:
    done = CliRunner().invoke(app, ["study", *arguments, "--json"])
    assert done.exit_code == 0, (done.output, done.exception)
    return json.loads(done.stdout)


def refused(*arguments: str) -> str:
    done = CliRunner().invoke(app, ["study", *arguments])
    assert isinstance(done.exception, InputError), done.output
    return str(done.exception)


def test_safe_set_writes_table_and_figure(tmp_path):
    facts = run("safe-set", GANTRY, "wall", "--out", str(tmp_path), "--samples", "2000", "--boundary", "50",
                "--nodes", "21", "--velocity", "1,0")  # fmt: skip
    rows = {row["set"]: row for row in facts["rows"]}
    assert list(rows) == ["h >= 0", "viable", "LB-CBF", "PP-CBF"]
    assert rows["h >= 0"]["of_X"] == 1.0
    assert rows["LB-CBF"]["of_lb"] == rows["viable"]["of_viable"] == 1.0
    assert rows["PP-CBF"]["infeasible"] > 0.0 and all(row["of_pp"] is None for row in rows.values())
    assert rows["viable"]["of_X"] == pytest.approx(1.0 - 1.0 / 9.0, abs=0.03)  # v <= 2 sqrt(h) over X
    assert 0.04 < rows["LB-CBF"]["not_viable"] < 0.08  # 0.051 in closed form
    assert rows["LB-CBF"]["infeasible"] > 0.5
    assert rows["LB-CBF"]["boundary"] == 50 and rows["viable"]["infeasible"] is None
    with (tmp_path / "volumes.csv").open() as file:
        read = list(csv.DictReader(file))
    assert float(read[1]["of_X"]) == rows["viable"]["of_X"]
    assert (tmp_path / "safe_set.png").stat().st_size > 5_000


def test_safe_set_without_a_viable_set(tmp_path, panda):
    facts = run("safe-set", "panda", "sphere", "--out", str(tmp_path), "--samples", "100", "--boundary", "3")
    assert [row["set"] for row in facts["rows"]] == ["h >= 0", "LB-CBF", "PP-CBF"]
    assert facts["rows"][0]["of_viable"] is None
    assert facts["rows"][2]["infeasible"] == 0.0 and facts["rows"][2]["of_pp"] == 1.0


def test_safe_set_is_counted_in_pieces_by_many_processes(tmp_path):
    """What is in the file is not counted again, and the pieces add up to the same sets however many there are."""
    arguments = ("safe-set", GANTRY, "wall", "--out", str(tmp_path), "--samples", "11000", "--boundary", "20",
                 "--nodes", "9", "--jobs", "2")  # fmt: skip
    first = run(*arguments)
    lines = (tmp_path / "results.jsonl").read_text().splitlines()
    records = [json.loads(line) for line in lines]
    pieces = {r["key"]["chunk"]: r["result"] for r in records if "chunk" in r["key"]}
    assert sorted(r["samples"] for r in pieces.values()) == [1000, 5000, 5000]
    assert pieces[0]["both"] != pieces[1]["both"]
    lb = pieces[0]["names"].index("LB-CBF")
    total = sum(r["both"][lb][lb] for r in pieces.values())
    assert {row["set"]: row["of_X"] for row in first["rows"]}["LB-CBF"] == total / 11_000
    done = [line for line in lines if '"chunk": 1' not in line]
    (tmp_path / "results.jsonl").write_text("".join(f"{line}\n" for line in done))
    assert run(*arguments) == first
    again = (tmp_path / "results.jsonl").read_text().splitlines()
    assert again[:-1] == done and json.loads(again[-1])["result"] == pieces[1]


def test_bad_input_of_safe_set(tmp_path):
    out = ["--out", str(tmp_path)]
    assert "not a barrier folder" in refused("safe-set", GANTRY, "wall", "--barrier", str(tmp_path), *out)
    assert "expected 2 numbers" in refused("safe-set", GANTRY, "wall", "--velocity", "1", *out)


def test_a_barrier_does_not_take_the_name_of_another_set(two_link, tmp_path):
    for name in ("viable", "h >= 0", "LB-CBF"):
        with pytest.raises(InputError, match=f"there is another set named '{name}'; rename the folder"):
            known_barriers(two_link, [tmp_path / name])


def test_missing_packages_are_named_with_the_remedy(tmp_path, monkeypatch):
    monkeypatch.delitem(sys.modules, "ppcbf_robots.nmpc")
    monkeypatch.setitem(sys.modules, "casadi", None)
    monkeypatch.delitem(sys.modules, "ppcbf_robots.symbolic", raising=False)
    assert 'pip install "ppcbf-robots[study]"' in refused("nmpc", "cartpole", "wall", "--out", str(tmp_path))


def test_a_slide_is_planned_where_it_can_stop_and_nowhere_else():
    """2 m/s² stop 1.6 m/s within 0.64 m."""
    task = pickle.loads(pickle.dumps(partial(judge, GANTRY, "wall", Settings())))
    for x, safe in ((0.0, True), (0.82, True), (0.9, False), (1.4, False)):
        answer = task((x, 0.0), (1.6, 0.0))
        assert answer["safe"] is safe, (x, answer)
        json.dumps(answer)


def test_a_start_inside_an_obstacle_is_not_safe():
    """The straight arm at 45 degrees ends at 15 cm from the circle's centre."""
    inside, outside = (
        judge("two_link", "circle", Settings(steps=3), q, (0.0, 0.0)) for q in ((np.pi / 4, 0.0), (0.3, 0.4))
    )
    assert inside == {"safe": False, "status": "Collides_At_Start", "iterations": 0}
    assert outside["safe"] and outside["iterations"] > 0


def test_nmpc_compares_with_the_sets(tmp_path):
    facts = run("nmpc", GANTRY, "wall", "--out", str(tmp_path), "--grid", "5", "--velocity", "1.6,0", "--nodes", "21",
                "--steps", "40", "--jobs", "2")  # fmt: skip
    assert facts["points"] == 25 and facts["safe"] == 15  # x = 0, 0.375, 0.75 of 0 ... 1.5
    rows = {row["set"]: row for row in facts["rows"]}
    assert rows["viable"] == {
        "set": "viable", "share": 0.6, "nmpc_of_set": 1.0, "set_not_nmpc": 0.0, "nmpc_not_set": 0.0
    }  # fmt: skip
    with (tmp_path / "points.csv").open() as file:
        points = list(csv.DictReader(file))
    assert {(float(p["x"]), p["safe"]) for p in points if float(p["y"]) == 0.0} == {
        (0.0, "True"), (0.375, "True"), (0.75, "True"), (1.125, "False"), (1.5, "False")
    }  # fmt: skip
    assert (tmp_path / "nmpc.png").stat().st_size > 5_000


def test_overlaps_of_known_masks():
    found = np.array([True, True, False, False])
    (row,) = overlaps(found, {"a": np.array([True, False, True, True])})
    assert row == {"set": "a", "share": 0.75, "nmpc_of_set": pytest.approx(2 / 3),
                   "set_not_nmpc": pytest.approx(2 / 3), "nmpc_not_set": 0.5}  # fmt: skip


def test_nmpc_goes_on_from_the_plans_that_are_there(tmp_path):
    """The second run finds all results in the file: nothing is planned again, and the tables are the same."""
    arguments = ("nmpc", GANTRY, "wall", "--out", str(tmp_path), "--grid", "2", "--steps", "5", "--no-viable")
    first = run(*arguments)
    written = (tmp_path / "results.jsonl").read_text()
    assert len(written.splitlines()) == 4
    (tmp_path / "results.jsonl").write_text(written.replace('"safe": true', '"safe": false'))
    assert run(*arguments)["safe"] == 0 < first["safe"]
