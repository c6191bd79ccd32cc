"""Descent on the exact feasibility margin of the runtime QP, for the largest set that keeps it positive.

The loss is ``weight E[-log s*] + E[(margin wanted - margin)₊] + simplicity E[(rate of K along the motion)²]``, where
the margin wanted is a share of what the torque limits can do: a *reserve* is asked for, see
:meth:`ppcbf_robots.learning.critics.Feasibility.capability`. The first term moves the set's boundary outwards along
every ray v = s d, relative to its distance, so that slow motions weigh as much as fast ones. Of the second, half the
states are drawn where the reserve was small so far. The third keeps K from answering a violation with a steep bump in
q, which would be a violation elsewhere. While nothing violates, the weight grows and the set with it. At every check
the surroundings of the smallest reserves are explored with new rays, and the falsifier searches beyond; both need
Pinocchio, the iterations between them do not.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from ppcbf_robots.learning.descent import CHECK_STATES, Descent
from ppcbf_robots.learning.falsifier import Attack, Falsifier, Starts
from ppcbf_robots.learning.parameters import HELD, INSIDE, MANY_JOINTS, Tensors, before_softplus, without_term
from ppcbf_robots.learning.presets import LearnedKind, Preset
from ppcbf_robots.learning.rays import Rays
from ppcbf_robots.problem import Problem
from ppcbf_robots.specs import Array

AVERAGING = 0.03  # of the parameters per iteration, in the average that checks and evidence look at
NEAR = 0.3  # above the wanted margin: rays below it are drawn as often as all others together
FAR_AWAY = 1.0  # reserve noted for rays that do not cross the band
EXPLORED = 1_600  # new rays per check around those of small margin, and as many with joints that run into bounds
SPREAD = (0.01, 0.3)  # of X's width, of the new rays about the old ones
POOL_GROWTH = 20_000  # rays kept beyond the first pool, those of least reserve
WEIGHT_GROWTH, WEIGHT_FALL = 1.01, 0.95  # of the volume's weight, per iteration without and with violations
LEAST_WEIGHT = 0.05  # of the largest
VIOLATED = 5e-4  # share of violations in a batch above which the weight falls
THRIFT = 0.5  # of the power that the filter may spend freely, used in training: what is left is passivity's reserve
MIN_MARGIN = 0.02
SLOWER = 1.5  # factor on the terms that slow all motions, per refinement; they are held then
SIMPLER = 1.25  # factor on the penalty of what depends on q, per refinement
TAKEN = 300  # states at most that join from one search
HUNTING = 48  # starts of the search that goes along with training
ENOUGH = 100  # violating states that end the evidence's search
LINGER = 0.15  # of its rounds, that it goes on after the first of them
LOOKED_AT = 4_000  # rays, for the share that the LB-CBF violates
MANY = 0.2  # of it, from where on training begins with a large K: growing it from outside ends with smaller sets
GROWING = 2  # times the iterations for that: with half as many, sets end where they could have grown on
THOROUGH = 3  # times the evidence's search of a set that was refined: what still violates are small pockets
HUMBLER = 0.7  # factor on the largest weight of the volume per refinement


class MarginDescent(Descent):
    """See the module and :class:`Descent`."""

    def __init__(self, problem: Problem, kind: LearnedKind, preset: Preset, seed: int, device: str) -> None:
        super().__init__(problem, kind, preset, seed, device)
        self.falsifier = Falsifier(problem, self.band, self.rays.h.shape[1], self.rng)
        self._joints = problem.model.nv
        self.margin = max(MIN_MARGIN, preset.margin * (self._joints - 1))
        self._held = [HELD] if HELD in self.params else []  # parameters that are not, or no longer, trained
        self._hunt = self.falsifier.start(HUNTING)  # goes on from check to check
        self._first_pool = len(self.rays)
        if self._violated_without_term() > MANY:
            self._begin_inside()
        self._max_weight, self._simplicity = preset.volume_weight / self._joints, preset.simplicity
        self._weight: torch.Tensor = torch.tensor(self._max_weight, device=self.device)
        self._noted = torch.full((len(self.rays),), torch.inf, device=self.device)  # last reserve seen on each ray
        self.judged = {k: x.detach().clone() for k, x in self.params.items()}
        self._look()

    @torch.no_grad()
    def _violated_without_term(self) -> float:
        """Share of rays that violate somewhere on the LB-CBF's band, of those that cross it."""
        params = without_term({k: x.detach().cpu().numpy() for k, x in self.params.items()})
        tensors = {k: self._tensor(x) for k, x in params.items()}
        least = self.band.least_reserve(tensors, self.rays.select(slice(LOOKED_AT)))
        return float((least < 0.0).sum() / torch.isfinite(least).sum().clamp(min=1))

    @torch.no_grad()
    def _begin_inside(self) -> None:
        """A K so large that the set begins well inside the largest one; all of it is trained, and for longer."""
        self._held = []
        self.planned = self.first_round = GROWING * self.planned
        for name, a in INSIDE.items():
            if name in self.params:
                self.params[name].fill_(before_softplus(a))

    def iterate(self) -> None:
        """A batch of band states, half of them where reserves are small; one step; the weight's update."""
        count = self.preset.samples
        self.set_rate()
        if not len(self._crossing):
            self.iteration += 1
            return  # the band is empty: the set has collapsed, and the checks will say so
        index, s = self.sample(count, self._crossing)
        drawn = len(index)
        if len(self._near):
            near, s_near = self.sample(count, self._near, rising=True)
            index, s = torch.cat([index, near]), torch.cat([s, s_near])
        self.iteration += 1
        if not drawn:
            return
        rays = self.rays.select(index)
        self.evaluated += len(index)
        with torch.no_grad():
            programs = self.band.feasibility(self.params, rays, s, free=THRIFT)
            optimum = programs.solve()
            margin, capability = programs.margin(optimum), programs.capability()
            wanted = self.margin * capability
            self._noted[index] = margin / capability
        shrinkage, unrest = self._shrinkage(rays.select(slice(drawn)), s[:drawn])
        loss = self._weight * shrinkage + self._simplicity * unrest
        short = (margin < wanted).nonzero()[:, 0]  # the others have no gradient
        if len(short):
            programs = self.band.feasibility(self.params, rays.select(short), s[short], free=THRIFT)
            wanting = torch.relu(wanted[short] - programs.margin(optimum.select(short)))
            loss = loss + wanting.sum() / len(index) + self.preset.worst_weight * wanting.mean()
        self.optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        for name in self._held:
            self.params[name].grad = None
        self.optimizer.step()
        self.loss = loss.detach()
        with torch.no_grad():
            for k in self.trained:
                self.judged[k].lerp_(self.params[k], AVERAGING)
        violated = (margin[:drawn] < 0.0).to(self.dtype).mean() > VIOLATED
        factor = torch.where(violated, WEIGHT_FALL, WEIGHT_GROWTH)
        self._weight = (self._weight * factor).clamp(LEAST_WEIGHT * self._max_weight, self._max_weight)

    def _shrinkage(self, rays: Rays, s: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean of -log s*, of the boundary's s* on each ray, and the mean square of K's change along the motion.

        The first is given up to a constant: its gradient is that of ``K / |∂phi/∂log s|``. The second has no dimension.
        """
        v = s[:, None] * rays.d
        K, K_q_rate, K_v = self.band.field.K(self.params, rays, s)
        hdot = (rays.grad @ v[..., None])[..., 0]
        row = (hdot + self.band.field.gamma * rays.h).argmin(-1, keepdim=True)
        slope = ((v * K_v).sum(-1) - hdot.gather(-1, row)[:, 0]).detach().clamp(min=1e-3)
        return (K / slope).mean(), ((K_q_rate / (self.band.field.gamma * slope)) ** 2).mean()

    def check(self) -> tuple[float, float, float]:
        """Explore, then fresh states on the band without the wanted margin; passivity fails where only its row does."""
        found = self._explore()
        attack = self.falsifier.search(self.judged, rounds=self.preset.search_rounds * self._joints, starts=self._hunt)
        self.add_counterexamples(attack.q, attack.v)
        self._join(self._hunted())
        self._look()
        with torch.no_grad():
            index, s = self.sample(CHECK_STATES, params=self.judged, rising=True)
            if not len(index):
                return 0.0, 0.0, 0.0
            rays = self.rays.select(index)
            fails = self.band.margin(self.judged, rays, s) < 0.0
            alone = self.band.margin(self.judged, rays, s, passive=False) < 0.0
            torque = max(float(alone.float().mean()), found, float(attack.worst < 0.0) / CHECK_STATES)
            return len(index) / CHECK_STATES, torque, float((fails & ~alone).float().mean())

    @torch.no_grad()
    def _look(self) -> None:
        """Which rays leave the set through the band now, and which have band states of small reserve.

        Rays never seen on the band are looked at, also those along which phi rises: they say nothing of the volume.
        """
        level = torch.full_like(self._noted, self.epsilon)
        leaving, rising = self.band.field.crosses(self.params, self.rays, level)
        crossing = leaving | rising
        self._crossing = leaving.nonzero()[:, 0]
        new = (crossing & torch.isinf(self._noted)).nonzero()[:, 0]
        if len(new):
            self._noted[new] = self.band.least_reserve(self.params, self.rays.select(new)).clamp(max=FAR_AWAY)
        self._near = (crossing & (self._noted < NEAR + self.margin)).nonzero()[:, 0]

    def _hunted(self) -> Rays:
        """Rays on which the falsifier now sees less than the reserve wanted."""
        points, nv = self._hunt.points[self._hunt.value < self.margin], self.problem.model.nv
        return self.rays_through(self.problem.model.from_angles(points[:, :nv]), points[:, nv:-1])

    def _explore(self) -> float:
        """New rays about those of least reserve, and where joints run into bounds; the share of them that violate."""
        near, count = self._near, EXPLORED // 4
        chosen = (
            near[torch.randint(len(near), (count // 2,), generator=self.generator, device=self.device)]
            if len(near)
            else near
        )
        rest = self._crossing[self._noted[self._crossing].argsort()[: count - len(chosen)]]
        old = self.rays.select(torch.cat([chosen, rest]))
        domain, model = self.problem.robot.domain, self.problem.model
        angles = np.repeat(model.to_angles(old.q.cpu().double().numpy()), 4, 0)
        d = np.repeat(old.d.cpu().double().numpy(), 4, 0)
        size = np.exp(self.rng.uniform(np.log(SPREAD[0]), np.log(SPREAD[1]), (len(d), 1)))
        angles = angles + size * self.rng.normal(size=d.shape) * np.ptp(domain.q, axis=1)
        d = d + size * self.rng.normal(size=d.shape) * np.ptp(domain.v, axis=1)
        cornered, into = domain.sample_cornered(self.rng, EXPLORED, self.band.field.gamma)
        angles, d = np.concatenate([angles, cornered]), np.concatenate([d, into])
        rays = self.rays_through(model.from_angles(np.clip(angles, domain.q[:, 0], domain.q[:, 1])), d)
        if not len(rays):
            return 0.0
        least = self.band.least_reserve(self.judged, rays)
        small = (least < NEAR + self.margin).nonzero()[:, 0]
        self._join(rays.select(small), least[small])
        return float((least < 0.0).float().mean())

    def _join(self, rays: Rays, reserves: torch.Tensor | None = None) -> None:
        """New rays join the pool; beyond its growth, those of largest reserve leave."""
        noted = torch.full((len(rays),), torch.inf, device=self.device) if reserves is None else reserves
        self.rays, self._noted = self.rays.join(rays), torch.cat([self._noted, noted])
        added = len(self.rays) - self._first_pool
        if added > POOL_GROWTH:
            order = torch.nan_to_num(self._noted[self._first_pool :], posinf=-1.0).argsort()[: POOL_GROWTH * 4 // 5]
            kept = torch.cat(
                [torch.arange(self._first_pool, device=self.device), self._first_pool + order.sort().values]
            )
            self.rays, self._noted = self.rays.select(kept), self._noted[kept]
            self._look()  # rays have moved

    def attack(self, params: dict[str, Array], known: Attack | None) -> Attack:
        """See :meth:`Descent.attack`; states that are known and violate these parameters too make a search needless."""
        tensors = {k: self._tensor(x) for k, x in params.items()}
        if known is not None and len(known.q):
            least = self.band.least_reserve(tensors, self.rays_through(known.q, known.v)).cpu().numpy()
            if least.min() < 0.0:
                return Attack(float(least.min()), known.q[least < 0.0], known.v[least < 0.0], len(least))
        rounds, times = self.preset.attack_rounds * max(1, self._joints - 1), THOROUGH if self.refined else 1
        return self.falsifier.search(tensors, times * rounds, enough=ENOUGH, linger=LINGER * rounds)

    def add_counterexamples(self, q: Array, v: Array) -> None:
        """Their rays join, and are trained on from the next check on."""
        if len(q) > TAKEN:
            chosen = self.rng.choice(len(q), TAKEN, replace=False)
            q, v = q[chosen], v[chosen]
        self._join(self.rays_through(q, v))

    def demand_more(self) -> None:
        """All motions become slower, and stay so; volume weighs less, and what depends on q more.

        What a search finds now and then of an arm are single spots, in states that training has never seen. To train on
        these alone leaves others; the terms without q help everywhere.
        """
        self._max_weight *= HUMBLER
        self._simplicity *= SIMPLER
        self._weight = self._weight.clamp(max=self._max_weight)
        self._held = [name for name in MANY_JOINTS if name in self.params]
        with torch.no_grad():
            for name in self._held:
                a = SLOWER * float(torch.nn.functional.softplus(self.judged[name]))
                for params in (self.params, self.judged):
                    params[name].fill_(before_softplus(a))

    def state(self) -> tuple[Tensors, dict[str, Any]]:
        """Rays that joined and the reserves noted; weights."""
        added = self.rays.select(slice(self._first_pool, None))
        tensors = {f"rays/{k}": x for k, x in vars(added).items()}
        tensors |= {f"judged/{k}": self.judged[k] for k in self.trained}
        tensors |= {f"hunt/{k}": torch.as_tensor(x) for k, x in vars(self._hunt).items()}
        tensors |= {"noted": self._noted, "weight": self._weight, "crossing": self._crossing, "near": self._near}
        return tensors, {"max_weight": self._max_weight, "simplicity": self._simplicity, "held": self._held}

    def restore(self, tensors: Tensors, numbers: dict[str, Any]) -> None:
        """See :meth:`state`."""
        added = Rays(
            **{k.removeprefix("rays/"): x.to(self.device) for k, x in tensors.items() if k.startswith("rays/")}
        )
        self.rays = self.rays.select(slice(self._first_pool)).join(added)
        self._hunt = Starts(
            **{k.removeprefix("hunt/"): x.numpy().copy() for k, x in tensors.items() if k.startswith("hunt/")}
        )
        self.judged |= {k: tensors[f"judged/{k}"].to(self.device) for k in self.trained}
        self._noted, self._weight, self._crossing, self._near = (
            tensors[k].to(self.device) for k in ("noted", "weight", "crossing", "near")
        )
        self._max_weight, self._simplicity, self._held = (numbers[k] for k in ("max_weight", "simplicity", "held"))
