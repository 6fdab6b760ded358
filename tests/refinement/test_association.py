"""Association of features [K-55, K-58, K-59, K-62]: every permutation, and the truth, judge."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.distance import cdist
from scipy.stats import multivariate_normal

from jaxloc.beliefs import Gaussian
from jaxloc.poses import SE2
from jaxloc.refinement.association import (
    Blocks,
    Conditioning,
    CornerStrength,
    Curvature,
    Features,
    Identity,
    PairConsensus,
    PoseGate,
    Richness,
    Separation,
    Sources,
    associate,
    pair_costs,
)

SIGMA = 0.1
SPREAD = np.array([0.3, 0.3, 0.05])
NOTHING = Sources(None, None, None, None, None)


def world(rng, seen_count=6, known_count=6, clutter=0, dtype=np.float32, size=4.0, unread=0.5):
    """A map, a believed pose that is off, and features seen from the true one in another order."""
    places = rng.uniform(-size, size, (known_count, 2))
    blocks, corners = rng.normal(size=(known_count, 16)), rng.uniform(1.0, 9.0, (known_count, 2))
    truth = SPREAD * rng.normal(size=3)
    order = rng.permutation(known_count)[:seen_count]
    cos, sin = np.cos(truth[2]), np.sin(truth[2])
    local = (places[order] - truth[:2]) @ np.array([[cos, -sin], [sin, cos]]) + SIGMA * rng.normal(size=(seen_count, 2))
    local[seen_count - clutter :] = rng.uniform(-size, size, (clutter, 2))
    codes = np.where(rng.uniform(size=seen_count) < unread, -1, order)
    codes[seen_count - clutter :] = -1
    looks = blocks[order] + 0.5 * rng.normal(size=(seen_count, 16))
    looks[seen_count - clutter :] = rng.normal(size=(clutter, 16))
    strengths = corners[order] * np.exp(0.2 * rng.normal(size=(seen_count, 2)))
    cast = lambda *a: [jnp.asarray(x, dtype) for x in a]  # noqa: E731
    known = Features(cast(places)[0], (Identity(jnp.arange(known_count)), *_looks(*cast(blocks, corners))))
    seen = Features(cast(local)[0], (Identity(jnp.asarray(codes)), *_looks(*cast(looks, strengths))))
    answer = np.where(np.arange(seen_count) < seen_count - clutter, order, -1)
    pose = Gaussian(SE2(*cast(0.0, 0.0, 0.0)), jnp.diag(cast(SPREAD**2)[0]))
    return pose, seen, known, answer


def _looks(blocks, corners):
    return Blocks(blocks, 0.2), CornerStrength(corners, 0.3)


def exhaustive(values, feasible):
    """Least cost over all one-to-one matchings with as many pairs as possible."""
    best = (0, 0.0)
    columns = range(values.shape[1])
    for perm in itertools.permutations(columns, values.shape[0]):
        picked = [(i, j) for i, j in enumerate(perm) if feasible[i, j]]
        best = min(best, (-len(picked), float(sum(values[i, j] for i, j in picked))))
    return best


def test_gated_assignment_is_the_exhaustive_optimum(rng):  # K-58
    for seed in range(10):
        pose, seen, known, _ = world(np.random.default_rng(seed), 6, 6, clutter=1, size=1.0)
        found = associate(pose, seen, known, sources=Sources(separation=None, conditioning=None), sigma=SIGMA)
        values, feasible = np.asarray(found.costs.values), np.asarray(found.costs.feasible)
        number, total = exhaustive(values, feasible)
        columns = np.asarray(found.columns)
        assert np.sum(columns >= 0) == -number and all(feasible[i, j] for i, j in enumerate(columns) if j >= 0)
        np.testing.assert_allclose(found.total, total, rtol=1e-4, atol=1e-4)


def test_pose_cost_is_the_mahalanobis_distance(x64, rng):
    pose, seen, known, _ = world(rng, dtype=np.float64)
    sources = eqx.tree_at(lambda s: s.pose, NOTHING, PoseGate(1e9), is_leaf=lambda x: x is None)
    found = pair_costs(pose, seen, known, sources=sources, sigma=SIGMA)
    for i, place in enumerate(np.asarray(seen.points)):
        slope = np.array([[1.0, 0.0, -place[1]], [0.0, 1.0, place[0]]])  # the believed pose is the identity
        spread = slope @ np.diag(SPREAD**2) @ slope.T + SIGMA**2 * np.eye(2)
        density = multivariate_normal(place, spread)
        squared = -2.0 * (density.logpdf(np.asarray(known.points)) - density.logpdf(place))
        np.testing.assert_allclose(found.values[i], squared, rtol=1e-8)


def test_distances_of_attributes_equal_scipy(dtype, rng):  # K-55
    a, b = (rng.uniform(1.0, 5.0, (n, 8)) for n in (4, 5))
    cast = lambda x: jnp.asarray(x, dtype)  # noqa: E731
    tolerance = {"rtol": 1e-3 if dtype == np.float32 else 1e-9, "atol": 1e-4 if dtype == np.float32 else 1e-12}
    found = Blocks(cast(a), 0.5).squared_distance(Blocks(cast(b), 0.5))
    np.testing.assert_allclose(found, (cdist(a, b, "correlation") / 0.5) ** 2, **tolerance)
    found = CornerStrength(cast(a[:, :2]), 0.2).squared_distance(CornerStrength(cast(b[:, :2]), 0.2))
    np.testing.assert_allclose(found, cdist(np.log(a[:, :2]), np.log(b[:, :2]), "sqeuclidean") / 0.04, **tolerance)
    found = Curvature(cast(a[:, 0]), 2.0).squared_distance(Curvature(cast(b[:, 0]), 2.0))
    np.testing.assert_allclose(found, cdist(a[:, :1], b[:, :1], "sqeuclidean") / 4.0, **tolerance)
    codes = Identity(jnp.array([1, 2, -1])).squared_distance(Identity(jnp.array([2, -1])))
    assert codes.tolist() == [[np.inf, 0.0], [0.0, 0.0], [0.0, 0.0]]


def test_attributes_cut_candidates(rng):  # K-55
    pose, seen, known, answer = world(rng, 12, 12, size=1.0)
    with_all = pair_costs(pose, seen, known, sigma=SIGMA)
    without = pair_costs(pose, seen, known, sources=Sources(richness=None), sigma=SIGMA)
    assert float(np.sum(with_all.feasible)) < 0.5 * float(np.sum(without.feasible))
    assert np.mean(np.asarray(with_all.feasible)[np.arange(12), answer]) > 0.8


@eqx.filter_jit
def run(pose, seen, known, sources):
    return associate(pose, seen, known, sources=sources, sigma=SIGMA).columns


def wrong(sources, worlds):
    """Pairs that are not the truth, over worlds of one size."""
    columns = [np.asarray(run(*w[:3], sources)) for w in worlds]
    return sum(int(np.sum((c >= 0) & (c != w[3]))) for c, w in zip(columns, worlds, strict=True))


RECORDS = {
    "richness": Richness(),
    "pose": PoseGate(),
    "separation": Separation(),
    "consensus": PairConsensus(),
    "conditioning": Conditioning(),
}


@pytest.mark.parametrize("name", RECORDS)
def test_each_source_lowers_wrong_associations(name):  # K-59
    worlds = [world(np.random.default_rng(seed), 12, 14, clutter=1, size=2.5) for seed in range(25)]
    base = (
        NOTHING
        if name in ("pose", "richness")
        else Sources(Richness() if name == "pose" else None, PoseGate(), None, None, None)
    )
    more = eqx.tree_at(lambda s: getattr(s, name), base, RECORDS[name], is_leaf=lambda x: x is None)
    before, after = wrong(base, worlds), wrong(more, worlds)
    assert after < 0.8 * before, (before, after)


def test_all_sources_together_are_nearly_always_right():
    worlds = [world(np.random.default_rng(seed), 12, 14, clutter=3, size=2.5) for seed in range(25)]
    columns = [np.asarray(run(*w[:3], Sources())) for w in worlds]
    right = sum(int(np.sum((c >= 0) & (c == w[3]))) for c, w in zip(columns, worlds, strict=True))
    assert wrong(Sources(), worlds) <= 0.01 * right and right > 0.5 * 9 * 25


def test_masked_equals_absent_and_nothing_is_nothing(rng):
    pose, seen, known, _ = world(rng, 6, 6)
    whole = associate(pose, seen, known, sigma=SIGMA)
    arrays, rest = eqx.partition(seen, eqx.is_array)
    more = eqx.combine(jax.tree.map(lambda a: jnp.concatenate([a, a[:2] * 0 - 1]), arrays), rest)
    padded = Features(more.points.at[6:].set(jnp.nan), more.attributes, jnp.arange(8) < 6)
    found = associate(pose, padded, known, sigma=SIGMA)
    assert found.columns.tolist() == [*whole.columns.tolist(), -1, -1]
    nothing = Features(seen.points, seen.attributes, jnp.zeros(6, bool))
    assert associate(pose, nothing, known, sigma=SIGMA).columns.tolist() == [-1] * 6


def test_gradient_of_the_cost_is_finite_and_right(x64, rng):
    pose, seen, known, _ = world(rng, dtype=np.float64)
    sources = Sources(separation=None, conditioning=None)

    @jax.jit
    def total(points):
        return associate(pose, Features(points, seen.attributes), known, sources=sources, sigma=SIGMA).total

    gradient, direction = jax.grad(total)(seen.points), jnp.asarray(rng.normal(size=seen.points.shape))
    expected = float(jnp.sum(gradient * direction))
    slope = float(total(seen.points + 1e-6 * direction) - total(seen.points - 1e-6 * direction)) / 2e-6
    assert abs(slope - expected) <= 1e-4 * abs(expected)


def test_different_attributes_are_named(rng):
    pose, seen, known, _ = world(rng)
    with pytest.raises(ValueError, match="give the same"):
        pair_costs(pose, seen, Features(known.points))
