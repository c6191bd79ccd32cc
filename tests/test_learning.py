"""The learner against independent answers: Pinocchio, the runtime filters and a linear programming solver."""

from __future__ import annotations

import dataclasses
import itertools
import json
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import torch
from scipy.optimize import linprog

from ppcbf_robots.barriers import BarrierRows
from ppcbf_robots.errors import InputError
from ppcbf_robots.evidence import BandCheck, check_band, uniform_band
from ppcbf_robots.filters import ClosedForm, FilterConfig, Status
from ppcbf_robots.learning.checkpoint import load_checkpoint, save_checkpoint
from ppcbf_robots.learning.critics import closed_form_critics, feasibility_margin
from ppcbf_robots.learning.parameters import initial_parameters
from ppcbf_robots.learning.presets import DEFAULT, PAPER, PRESETS
from ppcbf_robots.learning.rays import FAR, Field, Rays, build_pool, rays_at, to_tensors
from ppcbf_robots.learning.train import MARGIN_GROWTH, MIN_SAMPLES, Monitor, Result, Trainer, settings
from ppcbf_robots.network import NumpyNetwork
from ppcbf_robots.problem import Problem, load_problem
from ppcbf_robots.safety_filter import SafetyFilter

CPU, DOUBLE = torch.device("cpu"), torch.float64
TINY = dataclasses.replace(
    DEFAULT, rays=500, samples=100, top=20, hidden=(16, 16), units=4, iterations=8, check_every=2, test_samples=200,
    refinements=1,
)  # fmt: skip
TINY_PAPER = dataclasses.replace(TINY, network="mlp", filter="closed-form", metric="torque", l2=1e-2)


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Iterator[None]:
    """On a busy machine more threads only wait for each other."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(params=["mlp", "convex"])
def network(request, problem, random_network) -> NumpyNetwork:
    """Random weights of both forms for each problem."""
    return random_network(request.param, problem.model.nq, problem.model.nv, seed=1)


def tensors(params: dict[str, Any]) -> dict[str, torch.Tensor]:
    return {k: torch.as_tensor(x, dtype=DOUBLE) for k, x in params.items()}


def draw(problem: Problem, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Uniform states of X."""
    rng, domain = np.random.default_rng(seed), problem.robot.domain
    return problem.model.from_angles(domain.sample_q(rng, count)), domain.sample_v(rng, count)


def make_rays(problem: Problem, count: int = 200, rows: int = 1000, seed: int = 0) -> Rays:
    """Rays in double precision, with all rows unless fewer are asked for."""
    return Rays(**to_tensors([rays_at(problem, *draw(problem, count, seed), rows)[0]], CPU, DOUBLE))


def make_field(problem: Problem, kind: str) -> Field:
    return Field(problem.model, kind, problem.robot.spec.barrier.gamma, CPU, DOUBLE)


def runtime_rows(problem: Problem, network: NumpyNetwork, q: Any, v: Any) -> BarrierRows:
    """All rows of the barrier that will run, through Pinocchio."""
    dyn = problem.model.evaluate_batch(np.asarray(q), np.asarray(v))
    return problem.barrier("pp-ncbf", network).rows(dyn, problem.safety.evaluate(dyn))


# Rays


def test_rows_along_a_ray_are_those_of_the_runtime_barrier(problem, network):
    rays = make_rays(problem)
    s = torch.rand(len(rays), generator=torch.Generator().manual_seed(0), dtype=DOUBLE)
    found = make_field(problem, network.kind).rows(tensors(network.params), rays, s)
    expected = runtime_rows(problem, network, rays.q, s[:, None] * rays.d)
    orders = [np.argsort(np.asarray(rows.phi), axis=-1) for rows in (found, expected)]
    for name in ("phi", "h", "Lf_phi", "Lg_phi", "w"):
        sorted_ = []
        for rows, order in zip((found, expected), orders, strict=True):
            x = np.asarray(getattr(rows, name))
            sorted_.append(np.take_along_axis(x, order[..., None] if x.ndim == 3 else order, 1))
        scale = max(1.0, float(np.abs(sorted_[1]).max()))
        np.testing.assert_allclose(sorted_[0], sorted_[1], rtol=0.0, atol=1e-9 * scale, err_msg=name)


def test_rays_hold_the_nominal_torque_and_reach_the_face_of_the_box(problem):
    q, v = draw(problem, 100)
    goals = problem.robot.domain.sample_q(np.random.default_rng(3), 100)
    ray, volume = rays_at(problem, q, v, 3, goals)
    kept = np.flatnonzero((q[:, None, :] == ray["q"]).all(-1).any(1))
    np.testing.assert_array_equal(q[kept], ray["q"])
    np.testing.assert_array_equal(v[kept], volume["v"])
    box = problem.robot.domain.v
    reach = np.where(ray["d"] >= 0.0, ray["d"] / box[:, 1], ray["d"] / box[:, 0]).max(axis=1)
    np.testing.assert_allclose(reach, 1.0, atol=1e-12)
    for i, goal in zip(range(10), goals[kept], strict=False):
        dyn = problem.model.evaluate(ray["q"][i], 0.5 * ray["d"][i])
        nominal = problem.robot.controller.with_goal(problem.model.from_angles(goal)).evaluate(dyn)
        u = ray["u_rest"][i] - problem.robot.controller.gains.kd * dyn.v
        np.testing.assert_allclose(u, nominal.u, atol=1e-9)
        safety = problem.safety.evaluate(problem.model.evaluate(volume["q"][i], volume["v"][i]))
        assert safety.h.min() >= 0.0
        rho = safety.grad @ volume["v"][i] + problem.robot.spec.barrier.gamma * safety.h
        assert volume["rho"][i] == pytest.approx(rho.min(), abs=1e-9)


def test_bisection_lands_on_the_level(problem, network):
    field, rays, params = make_field(problem, network.kind), make_rays(problem, 400), tensors(network.params)
    level = torch.rand(len(rays), generator=torch.Generator().manual_seed(0), dtype=DOUBLE) * 0.05
    s, crosses = field.on_band(params, rays, level)
    assert crosses.double().mean() > 0.02
    assert torch.all((s >= 0.0) & (s <= 1.0))
    phi = runtime_rows(problem, network, rays.q, s[:, None] * rays.d).phi.min(-1)
    error = np.abs(phi - level.numpy())[crosses]
    assert (np.median(error) < 5e-4) and (np.quantile(error, 0.98) < 5e-3) and (error.max() < 0.02)
    ends = [runtime_rows(problem, network, rays.q, x * rays.d).phi.min(-1) for x in (0.0, 1.0)]
    np.testing.assert_array_equal(crosses, (ends[0] >= level.numpy()) & (ends[1] < level.numpy()))


@pytest.mark.parametrize("world", ["sphere", "five_spheres"])
def test_a_few_near_rows_decide_on_the_band(world, random_network):
    """With K = 0 bisection is exact but for kinks; of the Panda's rows six nearly always hold the least one there."""
    problem = load_problem("panda", world)
    params = random_network("mlp", problem.model.nq, problem.model.nv).params
    params["w_out"] = np.zeros_like(params["w_out"])
    rays, field = make_rays(problem, 2000, rows=6), make_field(problem, "mlp")
    s, crosses = field.on_band(tensors(params), rays, torch.full((len(rays),), 0.025, dtype=DOUBLE))
    phi = runtime_rows(problem, NumpyNetwork("mlp", params), rays.q, s[:, None] * rays.d).phi.min(-1)[crosses]
    assert crosses.sum() > 100
    assert (phi < 0.025 - 1e-9).mean() < 0.01
    assert (np.abs(phi - 0.025) < 1e-9).mean() > 0.9


def test_only_rows_that_stay_far_are_dropped(panda):
    gamma = panda.robot.spec.barrier.gamma
    rays = make_rays(panda, 500)
    fewer = rays.without_far_rows(gamma)
    count = fewer.h.shape[1]
    assert 0 < count < rays.h.shape[1]
    assert fewer.grad.shape[1] == fewer.eta.shape[1] == count
    dropped = gamma * rays.h[:, count:] - torch.relu(-(rays.grad @ rays.d[..., None])[..., 0])[:, count:]
    assert dropped.min() > FAR


def test_pools_join_and_select(two_link):
    a, b = make_rays(two_link, 20), make_rays(two_link, 20, seed=1)
    both = a.join(b)
    assert len(both) == len(a) + len(b)
    for field in dataclasses.fields(Rays):
        picked = getattr(both.select(torch.tensor([len(a), 0])), field.name)
        assert torch.equal(picked, torch.stack([getattr(b, field.name)[0], getattr(a, field.name)[0]]))


def test_the_pool_is_as_large_as_asked_for(two_link):
    rays, volume = build_pool(two_link, 3000, 6, 0.5, np.random.default_rng(0))
    count = sum(len(r["q"]) for r in rays)
    assert 3000 <= count == sum(len(states["q"]) for states in volume)


def test_a_domain_in_collision_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("ppcbf_robots.learning.rays.CHUNK", 200)
    world = tmp_path / "world.yaml"
    world.write_text("obstacles: [{name: all, type: half_space, normal: [0, 0, 1], offset: -0.1, margin: 3.0}]\n")
    with pytest.raises(InputError, match="almost every configuration of the domain X is in collision"):
        Trainer(load_problem("two_link", str(world)), "pp-ncbf", TINY)


# Critics


@pytest.fixture
def on_band(problem, network) -> tuple[Problem, Rays, torch.Tensor, BarrierRows]:
    """A problem whose closed form acts on phi, rays, s and rows of states on the band."""
    spec = problem.robot.spec.barrier.model_copy(update={"act_within": None})
    field, rays = make_field(problem, network.kind), make_rays(problem, 600)
    s, crosses = field.on_band(tensors(network.params), rays, torch.full((len(rays),), 0.025, dtype=DOUBLE))
    rays, s = rays.select(crosses), s[crosses]
    return problem.with_barrier_spec(spec), rays, s, field.rows(tensors(network.params), rays, s)


@pytest.mark.parametrize("metric", ["torque", "kinetic"])
def test_closed_form_critics_are_the_runtime_filters_excess(on_band, network, metric):
    problem, rays, s, rows = on_band
    robot, u_max = problem.model, problem.model.u_max
    kd, p_ref = torch.as_tensor(problem.robot.controller.gains.kd), 17.0
    v = s[:, None] * rays.d
    found = closed_form_critics(
        rows, v, rays.u_rest - kd * v, (kd * v * v).sum(-1), torch.as_tensor(u_max), metric, 0.0, p_ref
    )
    barrier = problem.barrier("pp-ncbf", network)
    filter_ = ClosedForm(barrier, FilterConfig("closed-form", metric))
    expected = []
    for qi, vi in zip(rays.q.numpy(), v.numpy(), strict=True):
        dyn = robot.evaluate(qi, vi)
        nominal = problem.robot.controller.evaluate(dyn)
        safety = problem.safety.evaluate(dyn)
        c = filter_.correct(dyn, safety, barrier.rows(dyn, safety), nominal.u, None, u_max)
        acts = c.status is not Status.FREE
        excess = max(0.0, float(np.max(np.abs(c.u) / u_max)) - 1.0), max(0.0, vi @ (c.u - nominal.u) - nominal.d_p)
        expected.append((acts * excess[0], acts * excess[1] / p_ref))
    np.testing.assert_allclose(np.stack(found, axis=1), expected, rtol=1e-5, atol=1e-6)


def test_closed_form_critics_ask_for_a_reserve(on_band):
    problem, rays, s, rows = on_band
    kd, v = torch.as_tensor(problem.robot.controller.gains.kd), s[:, None] * rays.d
    arguments = (rows, v, rays.u_rest - kd * v, (kd * v * v).sum(-1), torch.as_tensor(problem.model.u_max), "torque")
    without, with_ = (closed_form_critics(*arguments, margin, 1.0) for margin in (0.0, 0.03))
    for less, more in zip(without, with_, strict=True):
        assert torch.all(more >= less)
    over = without[0] > 0.0
    np.testing.assert_allclose((with_[0] - without[0])[over], 0.03, atol=1e-12)


@dataclasses.dataclass(frozen=True)
class Program:
    """Rows, box and passivity budget of ``feasibility_margin``, and the linear program that they mean."""

    phi: Any
    Lf: Any
    Lg: Any
    v: Any
    u_des: Any
    d_p: Any
    u_max: Any
    alpha: float = 3.0

    @staticmethod
    def random(rows: int, nv: int, seed: int, count: int = 60) -> Program:
        """Rows that look somewhat alike, as those of a world do; one state is at rest."""
        rng = np.random.default_rng(seed)
        phi, Lf = rng.uniform(0.0, 0.05, (count, rows)), rng.normal(0.0, 3.0, (count, rows))
        Lg = rng.normal(size=(count, rows, nv)) + rng.normal(size=(count, 1, nv))
        v, u_des = rng.normal(size=(count, nv)), rng.normal(size=(count, nv))
        v[0] = 0.0
        return Program(phi, Lf, Lg, v, u_des, 0.3 * (v**2).sum(-1), rng.uniform(0.5, 2.0, nv))

    def tensors(self) -> list[torch.Tensor]:
        """Everything but alpha."""
        return [torch.as_tensor(x) for x in dataclasses.astuple(self)[:-1]]

    def margins(self, passive: bool) -> tuple[Any, Any]:
        """What the learner computes."""
        phi, Lf, Lg, *others = self.tensors()
        margin, box = feasibility_margin(BarrierRows(None, phi, Lf, Lg, None), *others, self.alpha, passive)
        return margin.numpy(), box.numpy()

    def exact(self, passive: bool) -> Any:
        """``max t``, ``t <= offset_k + c_k u`` for all k, u in the box and ``vᵀ(u - u_des) <= d_p``; NaN if empty."""
        found = []
        for phi, Lf, Lg, v, u_des, d_p in zip(*dataclasses.astuple(self)[:-2], strict=True):
            authority = np.abs(Lg) @ self.u_max
            A = np.hstack([np.ones((len(authority), 1)), -Lg / authority[:, None]])
            b = (Lf + self.alpha * phi) / authority
            if passive:
                A, b = np.vstack([A, [0.0, *v]]), np.append(b, v @ u_des + d_p)
            bounds = [(None, None), *((-u, u) for u in self.u_max)]
            solution = linprog([-1.0, *np.zeros(len(v))], A, b, bounds=bounds)
            found.append(-solution.fun if solution.status == 0 else np.nan)
        return np.array(found)


@pytest.mark.parametrize("passive", [True, False])
@pytest.mark.parametrize("nv", [1, 2, 7])
def test_the_feasibility_margin_of_one_row_is_exact(nv, passive):
    program = Program.random(1, nv, seed=nv)
    exact, (margin, box) = program.exact(passive), program.margins(passive)
    possible = np.isfinite(exact)
    np.testing.assert_allclose(margin[possible], exact[possible], atol=1e-7)
    np.testing.assert_array_equal(box >= 0.0, possible)  # no passive torque in the box: the other margin says so
    assert possible.mean() > 0.7
    assert passive or possible.all()


def assert_tight_upper_bound(program: Program, passive: bool, loosest: float) -> None:
    exact, (margin, _) = program.exact(passive), program.margins(passive)
    possible = np.isfinite(exact)
    gap = (margin - exact)[possible]
    assert gap.min() > -1e-7
    assert (np.median(gap) < 0.02) and (np.quantile(gap, 0.95) < 0.05) and (gap.max() < loosest)
    assert ((margin > 0.0) == (exact > 0.0))[possible].mean() > 0.95


@pytest.mark.parametrize("passive", [True, False])
@pytest.mark.parametrize(("rows", "nv"), [(2, 2), (6, 7)])
def test_the_feasibility_margin_of_several_rows_is_a_tight_upper_bound(rows, nv, passive):
    assert_tight_upper_bound(Program.random(rows, nv, seed=rows), passive, loosest=0.25)


def test_the_feasibility_margin_of_real_rows_is_a_tight_upper_bound(problem):
    """On the band of an untrained network, with as many rows as in training."""
    params = initial_parameters(problem, DEFAULT, torch.Generator().manual_seed(0))
    rays, field = make_rays(problem, 300, DEFAULT.rows_per_ray), make_field(problem, DEFAULT.network)
    s, crosses = field.on_band(params, rays, torch.full((len(rays),), 0.025, dtype=DOUBLE))
    rays, s = rays.select(crosses), s[crosses]
    rows, v = field.rows(params, rays, s), s[:, None] * rays.d
    kd = torch.as_tensor(problem.robot.controller.gains.kd)
    states = (rows.phi, rows.Lf_phi, rows.Lg_phi, v, rays.u_rest - kd * v, (kd * v * v).sum(-1))
    program = Program(*(x.numpy() for x in states), problem.model.u_max, FilterConfig().alpha)
    assert_tight_upper_bound(program, passive=True, loosest=0.15)


@pytest.mark.parametrize("passive", [True, False])
def test_the_gradient_of_the_feasibility_margin(passive):
    """Of one row, by finite differences; phi is a level that the margin must not move."""
    program = Program.random(1, 3, seed=5, count=20)
    phi, Lf, Lg, *x = program.tensors()
    for a in (phi, Lf, Lg):
        a.requires_grad_()

    def margin(Lf: torch.Tensor, Lg: torch.Tensor) -> torch.Tensor:
        return feasibility_margin(BarrierRows(None, phi, Lf, Lg, None), *x, program.alpha, passive)[0]

    assert torch.autograd.gradcheck(margin, (Lf, Lg), eps=1e-7, atol=1e-5)
    margin(Lf, Lg).sum().backward()
    assert phi.grad is None
    assert torch.all(Lg.grad.abs().sum(-1) > 0.0)


# Training


def train(problem: Problem, preset=TINY, seed: int = 0, kind="pp-ncbf", **arguments) -> tuple[Trainer, Result]:
    trainer = Trainer(problem, kind, preset, seed)
    return trainer, trainer.run(**arguments)


def assert_same_weights(a: dict[str, Any], b: dict[str, Any]) -> None:
    assert a.keys() == b.keys()
    for name, x in a.items():
        np.testing.assert_array_equal(np.asarray(x), np.asarray(b[name]), err_msg=name)


def without_times(history: list[Monitor]) -> list[Monitor]:
    return [dataclasses.replace(m, seconds=0.0) for m in history]


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
    before = trainer._snapshot()
    for _ in range(3):
        trainer._iterate()
    changed = {k for k, x in trainer._snapshot().items() if not np.array_equal(x, before[k])}
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
    assert resumed.iteration == 4
    result = resumed.run()
    assert_same_weights(result.params, whole.params)
    assert without_times(result.history) == without_times(whole.history)
    assert (result.steps, result.volume_kept, result.reason) == (whole.steps, whole.volume_kept, whole.reason)
    assert dataclasses.astuple(result.check)[:3] == dataclasses.astuple(whole.check)[:3]


def test_a_checkpoint_keeps_counterexamples(cartpole, tmp_path):
    """The buffer points at rays, so those that refinement added must come back."""
    trainer, resumed = (Trainer(cartpole, "pp-ncbf", TINY) for _ in range(2))
    trainer.add_counterexamples(*draw(cartpole, 20, seed=5))
    for _ in range(3):
        trainer._iterate()
    assert trainer.buffer[0].max() >= len(resumed.rays)
    save_checkpoint(trainer, tmp_path)
    load_checkpoint(resumed, tmp_path)
    for t in (trainer, resumed):
        t._iterate()
    assert len(resumed.rays) == len(trainer.rays)
    assert_same_weights(resumed._snapshot(), trainer._snapshot())


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
        with pytest.raises(InputError, match="belongs to another robot, world, preset, barrier or seed"):
            load_checkpoint(other, tmp_path)
    path = tmp_path / "checkpoint.safetensors"
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(InputError, match="not a checkpoint"):
        load_checkpoint(trainer, tmp_path)


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
    monkeypatch.setattr(trainer, "_volume_kept", lambda: next(volumes))
    seen: dict[int, Any] = {}
    result = trainer.run(lambda monitor: seen.update({monitor.iteration: trainer._snapshot()}))
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
    trainer.planned = 0
    with torch.no_grad():
        trainer.params["w_out"] *= 1e4
    result = trainer.run()
    assert not result.converged
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
    assert notes == ["3 of 300 uniform band states violate: refining"]
    assert trainer.margin == pytest.approx(MARGIN_GROWTH * TINY.margin)
    assert trainer.planned == TINY.iterations * 3 // 2
    assert len(trainer.counterexamples) == 1


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
        result = runtime.filter(0.0, dyn, weak.robot.controller.evaluate(dyn).u, None)
        assert result.status is Status.INFEASIBLE or np.any(np.abs(result.u) > weak.model.u_max)


def test_check_band_finds_energy_that_enters(cartpole):
    """The LB-CBF of the paper injects energy on the cart-pole; without the passivity claim only torque counts."""
    barrier, config = cartpole.barrier("lb-cbf"), FilterConfig("closed-form", "torque")
    passive, free = (
        check_band(cartpole, barrier, config, 300, np.random.default_rng(0), passive=p) for p in (True, False)
    )
    assert passive.samples == free.samples == 300
    assert passive.violations > free.violations
