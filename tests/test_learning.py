"""Training against what it promises: repeatable, resumable, and judged by evidence alone."""

from __future__ import annotations

import dataclasses
import itertools
import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from ray_helpers import draw
from safetensors import safe_open
from safetensors.torch import save_file

from ppcbf_robots.errors import InputError
from ppcbf_robots.evidence import BandCheck, check_band, uniform_band
from ppcbf_robots.filters import FilterConfig, Status
from ppcbf_robots.learning import margin_descent as margin_descent_module
from ppcbf_robots.learning.checkpoint import load_checkpoint, save_checkpoint
from ppcbf_robots.learning.critics import Feasibility
from ppcbf_robots.learning.falsifier import Attack
from ppcbf_robots.learning.margin_descent import (
    EXPLORED,
    HUMBLER,
    LEAST_WEIGHT,
    NEAR,
    SLOWER,
    WEIGHT_FALL,
    WEIGHT_GROWTH,
    MarginDescent,
)
from ppcbf_robots.learning.paper_descent import PaperDescent
from ppcbf_robots.learning.parameters import HELD, INSIDE, MANY_JOINTS, without_term
from ppcbf_robots.learning.presets import DEFAULT, PAPER, PRESETS, Preset, with_gamma
from ppcbf_robots.learning.rays import Rays
from ppcbf_robots.learning.train import (
    CANDIDATES,
    MIN_SAMPLES,
    Monitor,
    Result,
    Trainer,
    settings,
)
from ppcbf_robots.learning.train import Tested as Judged  # pytest would take it for a test
from ppcbf_robots.network import NumpyNetwork
from ppcbf_robots.problem import Problem, load_problem
from ppcbf_robots.safety_filter import SafetyFilter

pytestmark = pytest.mark.usefixtures("one_thread")
TINY = dataclasses.replace(
    DEFAULT, rays=500, samples=100, top=20, hidden=(16, 16), units=4, iterations=8, check_every=2, test_samples=200,
    refinements=1, search_rounds=1, attack_rounds=2, refinement_share=0.5, judge_first=False,
)  # fmt: skip
TINY_PAPER = dataclasses.replace(TINY, network="mlp", filter="closed-form", metric="torque", l2=1e-2)


@pytest.fixture
def network(problem, random_network) -> NumpyNetwork:
    """Random weights for each problem."""
    return random_network("convex", problem.model.nq, problem.model.nv, seed=1)


def margin_descent(problem: Problem, preset: Preset = TINY) -> MarginDescent:
    """A descent that has not begun."""
    return MarginDescent(problem, "pp-ncbf", preset, 0, "cpu")


def train(problem: Problem, preset=TINY, seed: int = 0, kind="pp-ncbf", **arguments) -> tuple[Trainer, Result]:
    trainer = Trainer(problem, kind, preset, seed)
    return trainer, trainer.run(**arguments)


def assert_same_weights(a: dict[str, Any], b: dict[str, Any]) -> None:
    assert a.keys() == b.keys()
    for name, x in a.items():
        np.testing.assert_array_equal(np.asarray(x), np.asarray(b[name]), err_msg=name)


def without_times(history: list[Monitor]) -> list[Monitor]:
    return [
        dataclasses.replace(m, seconds=0.0, loss=np.nan_to_num(m.loss)) for m in history
    ]  # no loss before the first step


@pytest.mark.parametrize("preset", [TINY, TINY_PAPER], ids=["default", "paper"])
def test_a_seed_repeats_a_run_bit_for_bit(cartpole, preset):
    first, second, other = (train(cartpole, preset, seed)[1] for seed in (3, 3, 4))
    assert_same_weights(first.params, second.params)
    assert without_times(first.history) == without_times(second.history)
    assert first.check.tried == second.check.tried
    assert not np.array_equal(first.params["W0"], other.params["W0"])


@pytest.mark.parametrize("kind", ["pp-ncbf", "ncbf"])
@pytest.mark.parametrize("preset", [TINY, TINY_PAPER], ids=["default", "paper"])
def test_every_weight_but_the_constants_is_trained(cartpole, preset, kind):
    trainer = Trainer(cartpole, kind, preset)
    before = trainer.descent.snapshot()
    for _ in range(3):
        trainer.descent.iterate()
    changed = {k for k, x in trainer.descent.snapshot().items() if not np.array_equal(x, before[k])}
    assert before.keys() - changed == {"in_shift", "in_scale"} | ({"zero_at_rest", "b_out"} & before.keys()) | (
        {"turns", "v_scale"} & before.keys()
    )  # at rest f(q, 0) is taken away, and b_out with it


def stop_at(iteration: int, what: Callable[[], None]) -> Callable[[Monitor], None]:
    return lambda monitor: what() if monitor.iteration == iteration else None


@pytest.mark.parametrize("preset", [TINY, TINY_PAPER], ids=["default", "paper"])
def test_a_resumed_run_ends_as_the_uninterrupted_one(cartpole, preset, tmp_path):
    trainer = Trainer(cartpole, "pp-ncbf", preset)
    whole = trainer.run(stop_at(4, lambda: save_checkpoint(trainer, tmp_path)))
    resumed = Trainer(cartpole, "pp-ncbf", preset)
    load_checkpoint(resumed, tmp_path)
    assert resumed.descent.iteration == 4
    result = resumed.run()
    assert_same_weights(result.params, whole.params)
    assert without_times(result.history) == without_times(whole.history)
    assert (result.steps, result.volume_kept, result.reason) == (whole.steps, whole.volume_kept, whole.reason)
    assert dataclasses.astuple(result.check)[:3] == dataclasses.astuple(whole.check)[:3]


def test_a_run_stopped_in_its_evidence_is_not_trained_on(two_link, tmp_path):
    """The last check ended training early; its checkpoint says so."""
    preset = dataclasses.replace(TINY, patience=1, iterations=400, refinements=0, judge_first=False)
    trainer = Trainer(two_link, "pp-ncbf", preset)
    whole = trainer.run(lambda monitor: save_checkpoint(trainer, tmp_path))
    assert whole.steps < 400
    resumed = Trainer(two_link, "pp-ncbf", preset)
    load_checkpoint(resumed, tmp_path)
    result = resumed.run()
    assert result.steps == whole.steps
    assert_same_weights(result.params, whole.params)


def test_counterexamples_that_make_the_pool_overflow(cartpole, monkeypatch):
    """Rays move then, and what is drawn from has to follow."""
    monkeypatch.setattr(margin_descent_module, "POOL_GROWTH", 200)
    descent = margin_descent(cartpole)
    rng, domain = np.random.default_rng(0), cartpole.robot.domain
    for _ in range(2):
        q, v = cartpole.model.from_angles(domain.sample_q(rng, 290)), domain.sample_v(rng, 290)
        descent.add_counterexamples(q, v)
        assert max(descent._crossing.max(), descent._near.max()) < len(descent.rays)
        descent.iterate()


def test_a_resumed_run_still_has_the_barrier_that_stood_before_the_refinement(panda, monkeypatch, tmp_path):
    """Stopped hard while it refined for a larger set: the one that stands, and how often was refined, come back."""
    monkeypatch.setattr("ppcbf_robots.learning.train.check_band", lambda *a: BandCheck(300, 0, 300))
    monkeypatch.setattr(Trainer, "_stands", lambda self, t, share=0.2: t.clean)
    found, none = np.zeros((3, 7)), np.zeros((0, 7))
    attacks = [Attack(-0.1, found, found, 10), Attack(0.3, none, none, 10)]

    def descend(self, on_check, time_limit):
        if self.round == 1:
            save_checkpoint(self, tmp_path)
            raise ConnectionAbortedError  # as if the process had died
        self.clean = [(0.9, self.descent.snapshot()), (0.8, self.descent.snapshot())]

    monkeypatch.setattr(Trainer, "_descend", descend)
    monkeypatch.setattr(MarginDescent, "attack", lambda self, *given: attacks.pop(0))
    dying = Trainer(panda, "pp-ncbf", TINY)
    with pytest.raises(ConnectionAbortedError):
        dying.run()
    monkeypatch.setattr(Trainer, "_descend", lambda self, *given: None)
    resumed = Trainer(panda, "pp-ncbf", TINY)
    load_checkpoint(resumed, tmp_path)
    assert resumed.round == dying.round == 1
    result = resumed.run()  # nothing larger is found
    assert result.converged and (result.attack.worst, result.check.samples) == (0.3, 300)
    assert_same_weights(result.params, dying.best.params)


@pytest.mark.parametrize("preset", [TINY, TINY_PAPER], ids=["default", "paper"])
def test_a_checkpoint_keeps_counterexamples(cartpole, preset, tmp_path):
    """Buffers and lists point at rays, so those that refinement added must come back."""
    trainer, resumed = (Trainer(cartpole, "pp-ncbf", preset) for _ in range(2))
    first = len(trainer.descent.rays)
    trainer.descent.add_counterexamples(*draw(cartpole, 100, seed=5))
    trainer.descent.demand_more()
    for _ in range(3):
        trainer.descent.iterate()
    assert len(trainer.descent.rays) > first == len(resumed.descent.rays)
    if isinstance(trainer.descent, PaperDescent):
        assert trainer.descent.buffer[0].max() >= first
    save_checkpoint(trainer, tmp_path)
    load_checkpoint(resumed, tmp_path)
    for t in (trainer, resumed):
        for _ in range(2):
            t.descent.iterate()
        t.descent.check()
        t.descent.iterate()
    for field in dataclasses.fields(Rays):
        assert torch.equal(getattr(resumed.descent.rays, field.name), getattr(trainer.descent.rays, field.name))
    assert_same_weights(resumed.descent.snapshot(), trainer.descent.snapshot())
    fresh = Trainer(cartpole, "pp-ncbf", preset).descent.state()[1]
    assert resumed.descent.state()[1] == trainer.descent.state()[1] != fresh  # what refinements ask for


def test_checkpoints_that_cannot_be_resumed(cartpole, two_link, tmp_path):
    trainer = Trainer(cartpole, "pp-ncbf", TINY)
    with pytest.raises(InputError, match=r"nothing to resume: .*checkpoint\.safetensors does not exist"):
        load_checkpoint(trainer, tmp_path)
    save_checkpoint(trainer, tmp_path)
    faster = cartpole.with_barrier_spec(cartpole.robot.spec.barrier.model_copy(update={"gamma": 6.0}))
    others = [
        Trainer(cartpole, "pp-ncbf", TINY, seed=1),
        Trainer(cartpole, "ncbf", TINY),
        Trainer(cartpole, "pp-ncbf", dataclasses.replace(TINY, margin=0.01)),
        Trainer(two_link, "pp-ncbf", TINY),
        Trainer(faster, "pp-ncbf", TINY),
    ]
    for other in others:
        with pytest.raises(InputError, match="belongs to another robot, world, preset, barrier, seed or device"):
            load_checkpoint(other, tmp_path)
    path = tmp_path / "checkpoint.safetensors"
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(InputError, match="not a checkpoint"):
        load_checkpoint(trainer, tmp_path)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda tensors, state: state.pop("format"), "a checkpoint of another version; train from the start"),
        (lambda tensors, state: state.update(format=1), "a checkpoint of another version; train from the start"),
        (
            lambda tensors, state: tensors.update({"param/W0": torch.zeros(2, 16)}),
            "its network has another form; train",
        ),
        (lambda tensors, state: tensors.pop("param/turns"), "its network has another form; train"),
    ],
    ids=["no format", "format 1", "other shape", "no turns"],
)
def test_a_checkpoint_of_an_earlier_version_is_refused_in_one_sentence(cartpole, tmp_path, change, said):
    trainer, path = Trainer(cartpole, "pp-ncbf", TINY), tmp_path / "checkpoint.safetensors"
    save_checkpoint(trainer, tmp_path)
    with safe_open(path, "pt") as file:
        state, stored = json.loads(file.metadata()["state"]), {k: file.get_tensor(k) for k in file.keys()}  # noqa: SIM118
    change(stored, state)
    save_file(stored, path, metadata={"state": json.dumps(state)})
    before = trainer.descent.snapshot()
    with pytest.raises(InputError, match=said) as refused:
        load_checkpoint(trainer, tmp_path)
    assert str(refused.value).endswith("train from the start without --resume") and "\n" not in str(refused.value)
    assert_same_weights(trainer.descent.snapshot(), before)


def test_ctrl_c_keeps_the_best_barrier(two_link):
    def interrupt() -> None:
        raise KeyboardInterrupt

    trainer, result = train(two_link, on_check=stop_at(4, interrupt))
    assert (result.converged, result.steps) == (True, 4)
    assert result.reason == "interrupted; the best barrier so far is clean"
    assert_same_weights(result.params, trainer.clean[0][1])
    assert result.check.samples == 200 and not result.check.violations


def test_of_clean_barriers_the_largest_is_kept(two_link, monkeypatch):
    trainer = Trainer(two_link, "pp-ncbf", TINY)
    volumes = iter([0.5, 0.9, 0.7, 0.6, 0.9])  # of four checks and of the result
    monkeypatch.setattr(trainer.descent, "volume_kept", lambda: next(volumes))
    seen: dict[int, Any] = {}
    result = trainer.run(lambda monitor: seen.update({monitor.iteration: trainer.descent.snapshot()}))
    assert sorted(seen) == [2, 4, 6, 8]
    assert [volume for volume, _ in trainer.clean] == [0.9, 0.7, 0.6]
    assert_same_weights(result.params, seen[4])


def test_the_time_limit_ends_training(two_link):
    preset = dataclasses.replace(TINY, iterations=1_000_000, patience=1_000_000)
    _, result = train(two_link, preset, time_limit=0.5)
    assert 0 < result.steps < preset.iterations
    assert result.seconds < 5.0
    assert result.converged
    _, none = train(two_link, time_limit=0.0)
    assert (none.steps, none.converged) == (0, False)


def test_training_ends_early_once_clean_checks_gain_nothing(two_link):
    _, result = train(two_link, dataclasses.replace(TINY, iterations=1000, patience=3, learning_rate=1e-9))
    assert (result.steps, len(result.history)) == (6, 3)


def test_a_collapsed_set_is_not_converged(cartpole):
    trainer = Trainer(cartpole, "pp-ncbf", TINY_PAPER)
    trainer.descent.planned = 0
    with torch.no_grad():
        trainer.descent.params["w_out"] *= 1e4
    result = trainer.run()
    assert not result.converged and trainer.preset.refinements > trainer.round == 0  # there is nothing to refine
    assert result.volume_kept < trainer.preset.min_volume
    assert result.reason == f"collapsed: the safe set keeps {result.volume_kept:.1%} of the LB set"


def test_nothing_clean_is_not_converged(cartpole):
    _, result = train(cartpole, dataclasses.replace(TINY, iterations=1))
    assert not result.converged
    assert result.reason.startswith("no clean barrier was found: the safe set keeps 9")


def test_violations_are_not_converged_and_refined(two_link, monkeypatch):
    q, v = draw(two_link, 3, seed=2)
    monkeypatch.setattr("ppcbf_robots.learning.train.check_band", lambda *a: BandCheck(300, 3, 9000, q, v))
    notes: list[str] = []
    trainer, result = train(two_link, on_refine=notes.append)
    assert (result.converged, result.reason) == (False, "3 of 300 uniform band states violate the limits")
    assert notes == ["3 of 300 uniform band states violate the limits: refining"]
    assert trainer.descent._max_weight == pytest.approx(HUMBLER * TINY.volume_weight / 2)
    assert trainer.descent.planned == TINY.iterations + int(TINY.refinement_share * TINY.iterations)


def test_only_a_fresh_draw_is_evidence(two_link, monkeypatch):
    """The candidate was chosen for being clean on the first draw."""
    draws = itertools.cycle([BandCheck(300, 0, 9000), BandCheck(300, 3, 9000, *draw(two_link, 3, seed=2))])
    monkeypatch.setattr("ppcbf_robots.learning.train.check_band", lambda *a: next(draws))
    _, result = train(two_link)
    assert (result.converged, result.check.violations) == (False, 3)


def test_too_few_states_are_no_evidence(two_link):
    _, result = train(two_link, dataclasses.replace(TINY, test_samples=MIN_SAMPLES - 1))
    assert (result.converged, result.check.violations) == (False, 0)
    assert result.reason == f"only {MIN_SAMPLES - 1} states were found on the band, too few to tell"


def test_a_start_outside_is_not_converged(two_link):
    robot = dataclasses.replace(two_link.robot, start_velocity=10.0 * two_link.robot.domain.v[:, 1])
    start = two_link.model.evaluate(robot.start, robot.start_velocity)
    assert (two_link.safety.evaluate(start).grad @ start.v).min() < -1.0
    _, result = train(dataclasses.replace(two_link, robot=robot))
    assert (result.converged, result.start_inside) == (False, False)
    assert result.reason == "the start state lies outside the safe set"


def test_the_default_preset_converges(two_link):
    preset = dataclasses.replace(DEFAULT, iterations=100, rays=5000, test_samples=2000)
    trainer, result = train(two_link, preset)
    assert (result.converged, result.reason, result.start_inside) == (True, "clean", True)
    assert (result.check.samples, result.check.violations) == (2000, 0)
    assert result.volume_kept > 0.95
    barrier = two_link.barrier("pp-ncbf", NumpyNetwork("convex", result.params))
    again = check_band(two_link, barrier, trainer.filter_config, 500, np.random.default_rng(99))
    assert (again.samples, again.violations) == (500, 0)


@pytest.mark.slow
def test_the_default_preset_removes_the_cartpoles_violations(cartpole):
    preset = dataclasses.replace(DEFAULT, iterations=200, rays=5000, test_samples=1000)
    before = check_band(cartpole, cartpole.barrier("lb-cbf"), FilterConfig(), 1000, np.random.default_rng(0))
    _, result = train(cartpole, preset)
    assert before.violations > 20
    assert (result.converged, result.check.violations) == (True, 0)
    assert result.volume_kept > 0.9
    assert result.history[0].torque > 0.0


# The exact margin's descent


def test_only_rays_of_small_margin_are_explored_and_join(cartpole):
    descent = margin_descent(cartpole)
    first, wanted = len(descent.rays), NEAR + descent.margin
    share = descent._explore()
    added = descent.rays.select(slice(first, None))
    assert 0 < len(added) < 2 * EXPLORED
    least = descent.band.least_reserve(descent.params, added)
    assert torch.equal(least, descent._noted[first:])
    assert least.max() < wanted
    assert 0.0 <= share <= (least < 0.0).sum() / 10
    assert share == pytest.approx(float((least < 0.0).sum()) / (2 * EXPLORED), rel=0.2)


def test_where_all_margins_are_large_nothing_joins(two_link):
    descent = margin_descent(two_link, dataclasses.replace(TINY, margin=1e-9))
    first = len(descent.rays)
    assert descent._explore() == 0.0
    assert len(descent.rays) == first


def test_states_that_leave_an_obstacle_are_trained_on_too(two_link, monkeypatch):
    """Along their rays phi rises through the band: they say nothing of the volume, and their margins count."""
    descent, model = margin_descent(two_link), two_link.model
    rng, domain = np.random.default_rng(0), two_link.robot.domain
    q, v = model.from_angles(domain.sample_q(rng, 20_000)), domain.sample_v(rng, 20_000)
    rays = descent.rays_through(q, v)
    leaving, rising = descent.band.field.crosses(descent.params, rays, torch.full((len(rays),), descent.epsilon))
    assert leaving.sum() > 1000 and rising.sum() > 10 and not (leaving & rising).any()
    found = rays.select(rising.nonzero()[:, 0])
    on, s = descent.band.field.on_band(descent.params, found, torch.full((len(found),), 0.9 * descent.epsilon), True)
    phi = descent.band.field.rows(descent.params, found.select(on), s).phi.amin(-1).detach()
    assert len(on) > 0.5 * len(found)
    np.testing.assert_allclose(phi.numpy(), 0.9 * descent.epsilon, atol=1e-4)
    count, known = len(descent.rays), len(descent._crossing)
    monkeypatch.setattr(descent.band, "least_reserve", lambda params, rays: torch.zeros(len(rays)))
    descent.add_counterexamples(found.q.double().numpy(), found.d.double().numpy())
    descent._look()
    assert len(descent._crossing) == known
    added = torch.arange(count, len(descent.rays))
    assert set(added.tolist()) <= set(descent._near.tolist())
    index, _ = descent.sample(200, added, rising=True)
    assert len(index) > 20 and not len(descent.sample(200, added)[0])


def test_the_pool_is_bounded_and_keeps_what_matters(cartpole, monkeypatch):
    monkeypatch.setattr(margin_descent_module, "POOL_GROWTH", 200)
    descent = margin_descent(cartpole)
    first, rays = len(descent.rays), descent.rays
    for margin in np.arange(15) / 15.0:
        joining = rays.select(slice(50))
        descent._join(joining, torch.full((50,), 1.0 - float(margin)))
        assert len(descent.rays) == len(descent._noted) <= first + 200
    assert torch.equal(descent.rays.select(slice(first)).q, rays.q)
    assert descent._noted[first:].max() < 0.5  # of margins from 1 down to 1/15 the small ones stay
    for _ in range(4):
        descent.check()
        descent.iterate()
        assert len(descent.rays) == len(descent._noted) <= first + 200
        assert int(descent._near.max()) < len(descent.rays)


def test_half_of_a_batch_is_drawn_where_margins_are_small(cartpole, monkeypatch):
    descent = margin_descent(cartpole)
    pools: list[torch.Tensor] = []
    sample = descent.sample
    monkeypatch.setattr(
        descent,
        "sample",
        lambda count, pool=None, rising=False: (pools.append(pool), sample(count, pool, rising=rising))[1],
    )
    descent.iterate()
    assert [len(p) for p in pools] == [len(descent._crossing), len(descent._near)]
    assert torch.all(descent._noted[descent._near] < NEAR + descent.margin) or descent.iteration == 1
    assert set(descent._near.tolist()) <= set(descent._crossing.tolist())


def weights_over(descent: MarginDescent, margin: float, count: int, monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The weight of the volume over iterations in which all states have a margin."""
    real = Feasibility.margin
    monkeypatch.setattr(Feasibility, "margin", lambda self, optimum: 0.0 * real(self, optimum) + margin)
    found = []
    for _ in range(count):
        descent.iterate()
        found.append(float(descent._weight))
    return found


def test_the_volumes_weight_falls_with_violations_and_grows_without(two_link, monkeypatch):
    descent, largest = margin_descent(two_link), TINY.volume_weight / 2
    falling = weights_over(descent, -0.1, 80, monkeypatch)
    assert falling[0] == pytest.approx(WEIGHT_FALL * largest)
    assert np.all(np.diff(falling) <= 0.0)
    assert falling[-1] == pytest.approx(LEAST_WEIGHT * largest)
    growing = weights_over(descent, 0.5, 350, monkeypatch)
    assert growing[0] == pytest.approx(WEIGHT_GROWTH * falling[-1])
    assert np.all(np.diff(growing) >= 0.0)
    assert growing[-1] == pytest.approx(largest)
    descent.demand_more()
    assert float(descent._weight) == pytest.approx(HUMBLER * largest)


def test_what_slows_all_motions_grows_with_every_demand_and_is_held(panda):
    descent = margin_descent(panda)
    for _ in range(2):
        descent.iterate()
    before = descent.snapshot()
    descent.demand_more()
    lifted = descent.snapshot()
    for name in MANY_JOINTS:
        a, more = (np.log1p(np.exp(p[name])) for p in (before, lifted))
        assert more == pytest.approx(SLOWER * a, rel=1e-4)
    assert_same_weights({k: x for k, x in lifted.items() if k not in MANY_JOINTS},
                        {k: x for k, x in before.items() if k not in MANY_JOINTS})  # fmt: skip
    for _ in range(3):
        descent.iterate()
    after = descent.snapshot()
    assert all(after[name] == lifted[name] == descent.params[name].double().item() for name in MANY_JOINTS)
    assert np.abs(after["Wa"] - lifted["Wa"]).max() > 0.0


def test_the_share_of_the_energy_is_not_trained_unless_training_begins_inside(panda, monkeypatch):
    """From inside the set has further to grow, so it is given twice the iterations."""

    def trained() -> tuple[float, int]:
        descent = margin_descent(panda)
        for _ in range(2):
            descent.iterate()
        return float(np.log1p(np.exp(descent.params[HELD].double().item()))), descent.planned

    assert trained() == (pytest.approx(MANY_JOINTS[HELD], rel=1e-5), TINY.iterations)
    monkeypatch.setattr(MarginDescent, "_violated_without_term", lambda self: 1.0)
    share, planned = trained()
    assert share != pytest.approx(INSIDE[HELD], rel=1e-5) and planned == 2 * TINY.iterations


def test_an_arm_stands_only_with_reserve_and_its_lb_barrier_with_all_that_training_asks_for(panda, two_link):
    check, none = BandCheck(10, 0, 10), np.zeros((0, 7))
    for problem, covered in ((panda, False), (two_link, True)):
        trainer = Trainer(problem, "pp-ncbf", TINY)
        left = [Judged({}, check, Attack(x * trainer.descent.margin, none, none, 10), 1.0) for x in (1.1, 0.5, 0.1)]
        assert [trainer._stands(t, 1.0) for t in left] == [True, covered, covered]
        assert [trainer._stands(t) for t in left] == [True, True, covered]


def test_a_set_with_little_reserve_is_refined_and_counts_where_nothing_better_is_found(panda, monkeypatch):
    monkeypatch.setattr("ppcbf_robots.learning.train.check_band", lambda *a: BandCheck(300, 0, 300))
    reserves, none = iter([0.001, -0.2]), np.zeros((0, 7))
    monkeypatch.setattr(MarginDescent, "attack", lambda self, *given: Attack(next(reserves), none, none, 10))
    monkeypatch.setattr(
        Trainer, "_descend", lambda self, *given: setattr(self, "clean", [(0.9, self.descent.snapshot())])
    )
    notes: list[str] = []
    _, result = train(panda, dataclasses.replace(TINY, refinements=1), on_refine=notes.append)
    assert notes == ["the falsifier found states of a reserve of 0.0010 only: refining"]
    assert result.converged and result.attack.worst == 0.001


def test_a_set_without_a_band_is_told_and_does_not_crash(cartpole, monkeypatch):
    descent = margin_descent(cartpole)
    monkeypatch.setattr(descent, "_explore", lambda: 0.0)
    descent.band.field.gamma = 1e6  # h alone decides: no ray of the pool ends outside
    descent._look()
    assert not len(descent._crossing)
    before = descent.snapshot()
    descent.iterate()
    assert descent.check() == (0.0, 0.0, 0.0)
    assert_same_weights(descent.snapshot(), before)


def test_a_candidate_that_the_falsifier_breaks_is_not_converged(two_link, monkeypatch):
    """Its states join, and the reason counts them; what the falsifier breaks is not drawn from."""
    q, v = draw(two_link, 7, seed=2)
    joined: list[int] = []
    join = MarginDescent.add_counterexamples
    monkeypatch.setattr(
        MarginDescent, "add_counterexamples", lambda self, q, v: (joined.append(len(q)), join(self, q, v))[1]
    )
    monkeypatch.setattr("ppcbf_robots.learning.train.check_band", lambda *a: pytest.fail("not needed"))
    notes: list[str] = []
    tried: list[int] = []  # candidates attacked until the refinement
    real = Attack(-0.25, q, v, 1234)
    calls: list[int] = []
    monkeypatch.setattr(MarginDescent, "attack", lambda self, *given: (calls.append(1), real)[1])
    _, result = train(two_link, on_refine=lambda note: (notes.append(note), tried.append(len(calls))))
    assert not result.converged
    assert result.reason == "the falsifier found violating states, of a reserve of -0.2500 at least"
    assert notes == [f"{result.reason}: refining"]
    (states,) = filter(None, joined)  # at the refinement, and none at the checks
    assert 1 <= tried[0] <= CANDIDATES and states == 7 * tried[0]
    report = result.report()
    assert (report["worst_margin"], report["attacked"], report["samples"]) == (-0.25, 1234, 0)
    assert json.loads(json.dumps(report, allow_nan=False)) == report


@pytest.mark.parametrize(("worst", "rounds"), [(0.003, 1), (-0.01, 4)])
def test_violations_are_refined_as_long_as_planned(two_link, monkeypatch, worst, rounds):
    """Each time more is demanded; a barrier in which the search finds nothing ends the run."""
    q, v = draw(two_link, 5, seed=2)
    found = Attack(worst, *((q, v) if worst < 0.0 else (q[:0], v[:0])), 1000)
    attacked: list[int] = []
    monkeypatch.setattr(MarginDescent, "attack", lambda self, *given: (attacked.append(self.planned), found)[1])
    asked: list[float] = []
    monkeypatch.setattr(MarginDescent, "demand_more", lambda self: asked.append(self.margin))
    _, result = train(two_link, dataclasses.replace(TINY, refinements=3))
    assert len(set(attacked)) == rounds
    assert result.converged == (worst > 0.0) and result.report()["worst_margin"] == worst
    assert len(asked) == rounds - 1


def test_a_larger_candidate_that_failed_is_worth_one_refinement(two_link, monkeypatch):
    """The smaller one stands meanwhile, nothing more is demanded, and the end is the largest that stands."""
    trainer = Trainer(two_link, "pp-ncbf", dataclasses.replace(TINY, refinements=3))
    volumes = iter([0.5, 0.9, 0.7, 0.6, 0.9, 0.8, 0.8])  # of six checks, two of them in the refinement, and the result
    monkeypatch.setattr(trainer.descent, "volume_kept", lambda: next(volumes))
    q, v = draw(two_link, 1, seed=2)
    attacks = itertools.cycle([Attack(-0.1, q, v, 10), Attack(0.02, q[:0], v[:0], 10)])
    monkeypatch.setattr(MarginDescent, "attack", lambda self, *given: next(attacks))
    monkeypatch.setattr(MarginDescent, "demand_more", lambda self: pytest.fail("a barrier stands"))
    notes: list[str] = []
    seen: list[Any] = []
    result = trainer.run(lambda monitor: seen.append(trainer.descent.snapshot()), on_refine=notes.append)
    assert notes == [
        "the falsifier found violating states, of a reserve of -0.1000 at least: refining, "
        "for a larger set than the one that stands"
    ]
    assert result.converged and result.attack is not None and result.attack.worst == 0.02
    assert_same_weights(result.params, seen[5])  # 0.8, not the 0.7 of before the refinement


def test_states_known_to_violate_make_a_search_needless(panda, monkeypatch):
    """They are looked at first; only if the parameters stand them the falsifier searches."""
    descent = margin_descent(panda)
    params, (q, v) = descent.snapshot(), draw(panda, 40, seed=3)
    known = Attack(-0.1, q, v, 99)
    searched: list[int] = []
    monkeypatch.setattr(descent.falsifier, "search", lambda *a, **k: (searched.append(1), known)[1])
    margins = torch.linspace(-0.2, 0.19, 40)
    monkeypatch.setattr(descent, "rays_through", lambda q, v: None)
    monkeypatch.setattr(descent.band, "least_reserve", lambda params, rays: margins)
    found = descent.attack(params, known)
    assert not searched and found.worst == pytest.approx(-0.2) and found.evaluated == 40
    np.testing.assert_array_equal(found.q, q[:20])
    np.testing.assert_array_equal(found.v, v[:20])
    margins = margins.abs()
    assert descent.attack(params, known) is known and descent.attack(params, None) is known
    assert len(searched) == 2


def test_the_rate_warms_up_for_a_refinement(two_link):
    descent = margin_descent(two_link)
    p = dataclasses.replace(DEFAULT, iterations=100, refinement_share=0.5, refinement_rate=0.4)
    descent.preset, descent.planned, descent.first_round = p, 100, 100

    def rate(iteration: int, planned: int) -> float:
        descent.iteration, descent.planned = iteration, planned
        descent.set_rate()
        return descent.optimizer.param_groups[0]["lr"] / p.learning_rate

    assert [rate(i, 100) for i in (0, 50, 99)] == pytest.approx([1.0, 0.5, 0.1])
    assert [rate(i, 150) for i in (100, 125, 149)] == pytest.approx([0.4, 0.2, 0.1])


def test_the_papers_exit_ends_training_where_its_critics_are_small(cartpole):
    """As the critics stand, not as the weights make them; the default is to leave the end to the evidence."""
    never, always, at_first = (
        Trainer(cartpole, "pp-ncbf", dataclasses.replace(TINY_PAPER, exit=exit_at, iterations=6, refinements=0)).run()
        for exit_at in (0.0, 10.0, 0.2)
    )
    assert (never.steps, never.ended) == (6, False)
    assert (always.steps, always.ended, len(always.history)) == (1, True, 1)
    assert at_first.ended == (at_first.steps < 6)


def test_the_report_of_a_clean_run_names_the_attack(two_link):
    _, result = train(two_link)
    report = result.report()
    assert result.converged and result.attack is not None
    assert report["worst_margin"] == round(result.attack.worst, 6) > 0.0
    assert report["attacked"] == result.attack.evaluated > 1000
    nothing = dataclasses.replace(result, attack=Attack(float("inf"), *draw(two_link, 0), 10)).report()
    assert (nothing["worst_margin"], nothing["attacked"]) == (None, 10)
    without = dataclasses.replace(result, attack=None).report()
    assert (without["worst_margin"], without["attacked"]) == (None, 0)


def test_the_presets_gamma_counts_where_the_robot_gives_none(two_link):
    spec = two_link.robot.spec.barrier
    silent = two_link.with_barrier_spec(type(spec)(epsilon=0.04))
    preset = dataclasses.replace(TINY, gamma=7.5)
    told = with_gamma(silent, preset).robot.spec.barrier
    assert (told.gamma, told.epsilon) == (7.5, 0.04)
    assert with_gamma(with_gamma(silent, preset), TINY).robot.spec.barrier.gamma == 7.5
    assert with_gamma(two_link, preset) is two_link
    assert with_gamma(silent, dataclasses.replace(TINY, gamma=None)) is silent
    trainer = Trainer(silent, "pp-ncbf", preset)
    assert trainer.problem.robot.spec.barrier.gamma == trainer.descent.band.field.gamma == 7.5


# Devices


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
@pytest.mark.parametrize("preset", [TINY, TINY_PAPER], ids=["default", "paper"])
def test_losses_agree_between_devices(cartpole, preset):
    """On the same band states; every device draws its own."""
    cpu, cuda = (Trainer(cartpole, "pp-ncbf", preset, device=device).descent for device in ("cpu", "cuda"))
    drawn, draw = [], cpu.sample
    cpu.sample = lambda *args, **options: drawn.append(draw(*args, **options)) or drawn[-1]
    cpu.iterate()
    again = iter(drawn)
    cuda.sample = lambda *args, **options: tuple(x.to("cuda") for x in next(again))
    cuda.iterate()
    assert cuda.rays.q.device.type == cuda.generator.device.type == "cuda" and drawn
    assert float(cuda.loss) == pytest.approx(float(cpu.loss), rel=1e-4, abs=1e-4)


def test_presets():
    assert set(PRESETS) == {"default", "paper"}
    assert (PAPER.network, PAPER.hidden, PAPER.filter, PAPER.metric) == ("mlp", (100,) * 3, "closed-form", "torque")
    assert (PAPER.samples, PAPER.l2, PAPER.random_goals) == (1000, 1e-2, 0.0)
    assert PAPER.changes and not DEFAULT.changes
    told = " ".join(PAPER.changes)
    for change in ("zero at rest", "dimensionless", "adapt", "learning rate 3e-4", "rays", "exit"):
        assert change in told
    for preset in PRESETS.values():
        assert json.loads(json.dumps(settings(preset))).keys() == {f.name for f in dataclasses.fields(preset)}


# Evidence


def test_uniform_band_states_are_on_the_band(problem, network):
    for barrier in (problem.barrier("lb-cbf"), problem.barrier("pp-ncbf", network)):
        q, v, tried = uniform_band(problem, barrier, 30, np.random.default_rng(0), 20_000)
        assert 10 < len(q) == len(v) <= 30 < tried
        dyn = problem.model.evaluate_batch(q, v)
        safety = problem.safety.evaluate(dyn)
        phi = barrier.rows(dyn, safety).phi.min(axis=-1)
        assert np.all((phi >= 0.0) & (phi <= barrier.spec.epsilon))
        assert np.all(safety.h >= 0.0)
        angles, domain = problem.model.to_angles(q), problem.robot.domain
        for x, box in ((angles, domain.q), (v, domain.v)):
            turned = x - 2.0 * np.pi * np.floor((x - box[:, 0]) / (2.0 * np.pi)) if x is angles else x
            assert np.all((turned >= box[:, 0] - 1e-9) & (turned <= box[:, 1] + 1e-9))


def test_a_thin_band_gives_fewer_states(two_link):
    thin = two_link.with_barrier_spec(two_link.robot.spec.barrier.model_copy(update={"epsilon": 1e-5}))
    q, _, tried = uniform_band(thin, thin.barrier("lb-cbf"), 1000, np.random.default_rng(0), 3000)
    assert len(q) < 100
    assert tried == 3 * 1000 * 20
    nothing = check_band(thin, thin.barrier("lb-cbf"), FilterConfig(), 0, np.random.default_rng(0))
    assert nothing.samples == nothing.violations == 0 and np.isnan(nothing.share)


@pytest.fixture
def weak(tmp_path, two_link) -> Problem:
    """The 2R with motors that hardly move it."""
    spec = tmp_path / "weak.yaml"
    spec.write_text(f"urdf: {two_link.model.urdf}\neffort: 0.5\nbody: [{{frame: tip}}]\n")
    return load_problem(str(spec), "circle")


@pytest.mark.parametrize("config", [FilterConfig(), FilterConfig("closed-form", "torque")], ids=["qp", "closed form"])
def test_check_band_finds_torques_beyond_the_limits(two_link, weak, config):
    strong = check_band(two_link, two_link.barrier("lb-cbf"), FilterConfig(), 200, np.random.default_rng(0))
    assert (strong.samples, strong.violations) == (200, 0)
    barrier = weak.barrier("lb-cbf")
    check = check_band(weak, barrier, config, 100, np.random.default_rng(0), passive=False)
    assert check.share > 0.3
    assert check.bad_q.shape == check.bad_v.shape == (check.violations, 2)
    runtime = SafetyFilter(weak.model, weak.safety, barrier, config)
    for q, v in zip(check.bad_q, check.bad_v, strict=True):
        dyn = weak.model.evaluate(q, v)
        result = runtime.filter(dyn, weak.robot.controller.evaluate(dyn).u, None)
        assert result.status is Status.INFEASIBLE or np.any(np.abs(result.u) > weak.model.u_max)


def test_check_band_finds_energy_that_enters(cartpole):
    """The LB-CBF of the paper injects energy on the cart-pole; without the passivity claim only torque counts."""
    barrier, config = cartpole.barrier("lb-cbf"), FilterConfig("closed-form", "torque")
    passive, free = (
        check_band(cartpole, barrier, config, 300, np.random.default_rng(0), passive=p) for p in (True, False)
    )
    assert passive.samples == free.samples == 300
    assert passive.violations > free.violations


def test_a_robot_that_needs_no_learned_term_is_done_at_once(two_link, cartpole, monkeypatch):
    """Torque is ample for the two-link: the LB-CBF stands, and K is zero. The cart-pole's does not."""
    _, result = train(two_link, PRESETS["default"], on_check=lambda m: pytest.fail("not needed"))
    assert result.converged and result.steps == 0
    assert result.volume_kept == 1.0 and result.attack.worst > 5e-3 and result.check.violations == 0
    q, v = draw(two_link, 100, seed=1)
    for params in (result.params, without_term({**result.params, "ba": np.ones(12)})):
        assert NumpyNetwork("convex", params).value(q, v).max() < 1e-12

    joined: list[int] = []
    join = MarginDescent.add_counterexamples
    monkeypatch.setattr(
        MarginDescent, "add_counterexamples", lambda self, q, v: (joined.append(self.iteration), join(self, q, v))[1]
    )
    preset = dataclasses.replace(TINY, judge_first=True, refinements=0)
    trainer, result = train(cartpole, preset)
    assert result.steps == TINY.iterations and joined[0] == 0
    assert (
        trainer.descent.margin == Trainer(cartpole, "pp-ncbf", preset).descent.margin
    )  # nothing more is asked for yet


def test_an_lb_barrier_that_violates_is_no_result(two_link, monkeypatch):
    """Its search was cut short: where everything else violates, that is what comes out, and not the LB-CBF."""
    q, v = draw(two_link, 1, seed=2)

    def attack(self, *given):
        return Attack(-0.1 if self.iteration else -0.003, q, v, 10)

    monkeypatch.setattr(MarginDescent, "attack", attack)
    _, result = train(two_link, dataclasses.replace(TINY, judge_first=True, refinements=2))
    assert not result.converged and result.volume_kept < 1.0
    assert result.attack is not None and result.attack.worst == -0.1
