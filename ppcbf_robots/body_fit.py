"""The fewest balls that contain a surface and stay close to it.

Centres are searched with a few hundred points of the surface; the radii are then computed from all its pieces, so the
cover holds by construction and the search decides only how tight it is. Every step is seeded: the same surface gives
the same balls.
"""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from ppcbf_robots.body_geometry import SIDES, SPACING, SPACING_SHARE, Pieces, principal_axes
from ppcbf_robots.specs import Array

LARGEST = 0.040  # [m], overestimate aimed at
THICKNESS_SHARE = 0.4  # of the middle extent: less is aimed at on thin links,
SMALLEST = 0.020  # [m], but not less than this
MEAN = 0.016  # [m], what the mean overestimate of a link should stay below,
MEAN_SHARE = 0.45  # or this share of the largest one aimed at, if that is less
MAX_BALLS = 8  # per joint
MORE_BALLS = (12, 20)  # for a link that no joint moves,
ROOMY = 0.06  # [m], unless its largest overestimate is less
POINTS = 400  # of the surface, that the search looks at
TRIALS = 100  # moves tried per ball
GRID_POINTS = 20_000  # of the grid of distances that the search uses
HOPELESS = 4.0  # times the aim: a start that costs more is not improved
WORTH = 1.25  # times the least cost is accepted for fewer balls
DIRECTIONS = 96  # of a ball's surface looked at in the search
FINE_DIRECTIONS = 600  # and for the figures reported
ROUND = 1e-4  # [m], of centres and radii; radii are rounded up
_SKIN = 1e-9  # [m], so that a ball contains what its radius was computed from in spite of rounding


@dataclass(frozen=True)
class Balls:
    """Balls in the frame of their surface [m]."""

    centers: Array  # (k, 3)
    radii: Array  # (k,)


@dataclass(frozen=True)
class Overestimate:
    """How far the outside of a union of balls lies from the surface within [m]."""

    largest: float
    mean: float  # over the area
    area: float  # [m²], of the outside


@dataclass(frozen=True)
class Fit:
    """Balls that contain a surface, and how tightly."""

    balls: Balls
    overestimate: Overestimate
    aim: float  # [m], the largest overestimate aimed at

    @property
    def good(self) -> bool:
        """Whether the overestimate is as small as aimed at."""
        return self.overestimate.largest <= self.aim and self.overestimate.mean <= min(MEAN, MEAN_SHARE * self.aim)

    @property
    def cost(self) -> float:
        """What the search makes small [m]."""
        return _cost(self.overestimate, self.aim)


class Surface:
    """A surface with what the search asks of it again and again."""

    def __init__(self, pieces: Pieces) -> None:
        self.pieces = pieces
        self.aim = float(np.clip(THICKNESS_SHARE * pieces.extent[1], SMALLEST, LARGEST))
        self._tree = cKDTree(pieces.samples) if len(pieces.samples) else None
        rounded = np.flatnonzero(pieces.growth > 0.0)  # these are segments, perhaps of length 0
        self._ends = pieces.vertices[rounded][:, [0, -1]]
        self._growth = pieces.growth[rounded]
        self.coarse = _thinned(pieces, POINTS)
        self._field = _Field(self)

    def distance(self, points: Array) -> Array:
        """(N,): distance of points (N, 3) to the surface, at most its sample spacing too large."""
        found = np.full(len(points), np.inf)
        if self._tree is not None:
            found = np.asarray(self._tree.query(points)[0])
        for (a, b), growth in zip(self._ends, self._growth, strict=True):
            span = b - a
            share = np.clip((points - a) @ span / max(float(span @ span), 1e-18), 0.0, 1.0)
            found = np.minimum(found, np.abs(np.linalg.norm(points - a - share[:, None] * span, axis=1) - growth))
        return found

    def overestimate(self, balls: Balls, coarse: bool = False) -> Overestimate:
        """Of the union of ``balls`` over this surface; ``coarse`` is quick and inexact."""
        points, area = outside(balls, DIRECTIONS if coarse else FINE_DIRECTIONS)
        if not len(points):
            return Overestimate(0.0, 0.0, 0.0)
        distance = self._field.distance(points) if coarse else self.distance(points)
        return Overestimate(float(distance.max()), float(distance @ area / area.sum()), float(area.sum()))


class _Field:
    """Distance to a surface by interpolation in a grid around it."""

    def __init__(self, surface: Surface) -> None:
        points = surface.coarse.vertices.reshape(-1, 3)
        room = float(surface.coarse.growth.max(initial=0.0)) + 2.0 * surface.aim
        self._low, high = points.min(axis=0) - room, points.max(axis=0) + room
        self._cell = float(np.prod(high - self._low) / GRID_POINTS) ** (1.0 / 3.0)
        axes = [self._low[i] + self._cell * np.arange(2 + int((high - self._low)[i] / self._cell)) for i in range(3)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        self._values = surface.distance(grid.reshape(-1, 3)).reshape(grid.shape[:3])

    def distance(self, points: Array) -> Array:
        """(N,): as :meth:`Surface.distance`; beyond the grid that of its nearest edge and the way there."""
        index = (points - self._low) / self._cell
        inside = np.clip(index, 0.0, np.array(self._values.shape) - 1.0)
        beyond = self._cell * np.linalg.norm(index - inside, axis=1)
        return np.asarray(map_coordinates(self._values, inside.T, order=1) + beyond)


def outside(balls: Balls, directions: int) -> tuple[Array, Array]:
    """Points (N, 3) of the balls' surfaces that lie in no other ball, and the area (N,) [m²] each stands for."""
    c, r = balls.centers, balls.radii
    points = c[:, None] + r[:, None, None] * _fibonacci(directions)
    gaps = (points**2).sum(axis=2)[:, :, None] - 2.0 * points @ c.T + (c**2).sum(axis=1) - r**2  # (k, directions, k)
    gaps[np.arange(len(r)), :, np.arange(len(r))] = np.inf
    free = gaps.min(axis=2) >= 0.0
    area = np.broadcast_to((4.0 * np.pi * r**2 / directions)[:, None], free.shape)
    return points[free], area[free]


def settings() -> list[float]:
    """The numbers above, on which the result depends."""
    aims = [LARGEST, THICKNESS_SHARE, SMALLEST, MEAN, MEAN_SHARE, MAX_BALLS, *MORE_BALLS, ROOMY]
    search = [POINTS, TRIALS, GRID_POINTS, HOPELESS, WORTH, DIRECTIONS, FINE_DIRECTIONS, ROUND]
    return [*aims, *search, SPACING, SPACING_SHARE, SIDES]


def fit(surface: Surface) -> Fit:
    """Ever more balls, at most MAX_BALLS, until the overestimate is as small as aimed at; of these the ones worth it.

    Every ball is a row more in every control step, so the fewest are taken whose cost is within a quarter of the least.
    """
    tried: list[Fit] = []
    for count in range(_first_count(surface), MAX_BALLS + 1):
        tried.append(_fit_count(surface, count, tried[-1] if tried else None))
        if tried[-1].good:
            break
    least = min(f.cost for f in tried)
    return next(f for f in tried if f.cost <= WORTH * least)


def fit_fixed(surface: Surface) -> Fit:
    """For what no joint moves, a torso or a table: more balls where it is large, since a few leave too little room."""
    found = fit(surface)
    for count in MORE_BALLS:
        if found.overestimate.largest <= ROOMY:
            break
        found = min(found, _fit_count(surface, count, None), key=lambda f: f.cost)
    return found


def _first_count(surface: Surface) -> int:
    """One less than a chain of balls takes that grows a round bar of this length and thickness by the aim."""
    length, thickness, _ = surface.pieces.extent
    chord = 2.0 * float(np.sqrt(surface.aim * (thickness + surface.aim)))
    return int(np.clip(round(length / chord) - 1, 1, MAX_BALLS))


def _fit_count(surface: Surface, count: int, fewer: Fit | None) -> Fit:
    """The best of ``count`` balls from several starts, one of them the best of fewer and one ball more."""
    rng = np.random.default_rng(count)
    starts = [_along_axis(surface.coarse, count), _clustered(surface.coarse, count, rng)]
    if fewer is not None and len(fewer.balls.radii) == count - 1:
        points = outside(fewer.balls, DIRECTIONS)[0]
        worst = points[surface.distance(points).argmax()]
        starts.append(np.concatenate([fewer.balls.centers, worst[None]]))
    zero = np.zeros(count)
    costs = [_search_cost(surface, c, surface.coarse.required(c), zero) for c in starts]
    promising = [c for c, x in zip(starts, costs, strict=True) if x <= HOPELESS * surface.aim]
    found = [refitted(surface, starts[int(np.argmin(costs))], zero)]
    found += [refitted(surface, *_improved(surface, c, rng)) for c in promising]
    return min(found, key=lambda f: f.cost)


def refitted(surface: Surface, centers: Array, lead: Array) -> Fit:
    """Balls about ``centers`` (k, 3), rounded, that contain every piece, and what they overestimate."""
    centers = np.round(centers / ROUND) * ROUND
    radii = np.ceil((_radii(surface.pieces.required(centers), lead) + _SKIN) / ROUND) * ROUND
    used = radii > ROUND
    balls = Balls(centers[used], radii[used])
    return Fit(balls, surface.overestimate(balls), surface.aim)


def _radii(required: Array, lead: Array) -> Array:
    """(k,) radii so that every row of ``required`` (rows, k) is met by a ball; 0 where a ball is not needed.

    A row goes to the ball with the least required radius, less what each ball leads by (k,) [m].
    """
    nearest = (required - lead).argmin(axis=1)
    radii = np.zeros(required.shape[1])
    np.maximum.at(radii, nearest, required[np.arange(len(required)), nearest])
    holders = (required <= radii).sum(axis=1)  # (rows,): how many balls hold each
    for i in np.argsort(-radii, kind="stable"):  # shrink to what no other ball holds
        column = required[:, i]
        alone = holders == (column <= radii[i])
        smaller = column[alone].max(initial=0.0)
        holders -= (column <= radii[i]) & (column > smaller)
        radii[i] = smaller
    return radii


def _cost(found: Overestimate, aim: float) -> float:
    return found.mean + found.largest / 3.0 + 2.0 * max(0.0, found.largest - aim)


def _search_cost(surface: Surface, centers: Array, required: Array, lead: Array) -> float:
    balls = Balls(centers, _radii(required, lead))
    return round(_cost(surface.overestimate(balls, coarse=True), surface.aim), 7)


def _improved(surface: Surface, centers: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Centres and leads, changed one ball at a time as long as that helps, in ever smaller steps."""
    lead = np.zeros(len(centers))
    required = surface.coarse.required(centers)
    best, step = _search_cost(surface, centers, required, lead), 0.25 * float(surface.pieces.extent[1])
    trials = TRIALS * len(centers)
    for trial in range(trials):
        moved, led, need, i = centers.copy(), lead.copy(), required.copy(), trial % len(centers)
        change = rng.normal(0.0, step * 0.03 ** (trial / trials), 4)
        moved[i] += change[:3]
        led[i] += 0.5 * change[3]
        need[:, i] = surface.coarse.required(moved[i : i + 1])[:, 0]
        cost = _search_cost(surface, moved, need, led)
        if cost < best:
            best, centers, required, lead = cost, moved, need, led
    return centers, lead


def _along_axis(pieces: Pieces, count: int) -> Array:
    """Centres (count, 3) of slices across the principal axis."""
    points = pieces.vertices.reshape(-1, 3)
    mean = points.mean(axis=0)
    along = (points - mean) @ principal_axes(points)[0]
    edges = np.linspace(along.min(), along.max(), count + 1)
    slices = np.clip(np.searchsorted(edges, along, side="right") - 1, 0, count - 1)
    return _middles(points, slices, count, np.tile(mean, (count, 1)))


def _clustered(pieces: Pieces, count: int, rng: np.random.Generator) -> Array:
    """Centres (count, 3) of clusters: farthest points first, then Lloyd's steps towards the middles."""
    points = pieces.vertices.mean(axis=1)
    centers: Array = points[[int(rng.integers(len(points)))]]
    while len(centers) < count:
        far = np.linalg.norm(points[:, None] - centers, axis=2).min(axis=1).argmax()
        centers = np.concatenate([centers, points[[far]]])
    for _ in range(15):
        nearest = np.linalg.norm(points[:, None] - centers, axis=2).argmin(axis=1)
        centers = _middles(points, nearest, count, centers)
    return centers


def _middles(points: Array, member: Array, count: int, default: Array) -> Array:
    """Centres of the nearly smallest ball around each group of points (Badoiu and Clarkson)."""
    centers: Array = default.copy()
    for i in range(count):
        group = points[member == i]
        if not len(group):
            continue
        c = 0.5 * (group.min(axis=0) + group.max(axis=0))
        for n in range(1, 60):
            c = c + (group[np.linalg.norm(group - c, axis=1).argmax()] - c) / (n + 1.0)
        centers[i] = c
    return centers


def _thinned(pieces: Pieces, count: int) -> Pieces:
    """About ``count`` points of the pieces, one per cell of a grid, and every grown piece as it is."""
    grown = pieces.growth > 0.0
    points = pieces.vertices[~grown].reshape(-1, 3)
    points = kept = points[:: 1 + len(points) // 20_000]
    cell = float(pieces.extent[0]) / 40.0
    while len(kept) > count:
        cell *= 1.2
        index = np.floor((points - points.min(axis=0)) / cell).astype(np.int64)
        kept = points[np.sort(np.unique(index @ np.array([1, 1_000, 1_000_000]), return_index=True)[1])]
    width = pieces.vertices.shape[1] if grown.any() else 1
    vertices = np.concatenate([np.repeat(kept[:, None], width, axis=1), pieces.vertices[grown][:, :width]])
    growth = np.concatenate([np.zeros(len(kept)), pieces.growth[grown]])
    return dataclasses.replace(pieces, vertices=vertices, growth=growth)


@functools.cache
def _fibonacci(count: int) -> Array:
    """(count, 3) unit vectors, evenly spread."""
    i = np.arange(count) + 0.5
    z, turn = 1.0 - 2.0 * i / count, np.pi * (1.0 + 5.0**0.5) * i
    flat = np.sqrt(1.0 - z**2)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1)
