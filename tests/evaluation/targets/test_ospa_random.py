"""OSPA and GOSPA of many small random sets, some of them empty, against Stone Soup and every permutation."""

import itertools
from datetime import datetime

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.evaluation import targets

CUTOFF, FEW, MANY = 3.0, 100, 1000
COUNTS = pytest.mark.parametrize("count", [FEW, pytest.param(MANY, marks=pytest.mark.slow)])


def random_sets(count):
    rng = np.random.default_rng(7)
    x, y = rng.uniform(0, 6, (2, count, 5, 2))
    near, far = rng.uniform(size=(2, count)) < np.array([[0.4], [0.1]])
    y[near] = x[near] + 0.3 * rng.standard_normal(x[near].shape)
    y[far] += 100.0
    valid_x, valid_y = (rng.uniform(size=(count, 5)) < rng.choice([0.0, 0.3, 0.7, 1.0], (count, 1)) for _ in range(2))
    return x, valid_x, y, valid_y


def by_permutations(x, y, order, extra):
    """Least sum of capped distances to a power over all matchings, plus what each point more of one set costs."""
    few, many = (x, y) if len(x) <= len(y) else (y, x)
    costs = np.minimum(np.linalg.norm(few[:, None] - many[None], axis=2), CUTOFF) ** order
    matchings = itertools.permutations(range(len(many)), len(few))
    return min(sum(costs[i, j] for i, j in enumerate(columns)) for columns in matchings) + extra * (
        len(many) - len(few)
    )


@COUNTS
def test_every_permutation(count, x64):
    sets = random_sets(count)
    ospa = jax.jit(jax.vmap(lambda *s: targets.ospa(*s, cutoff=CUTOFF, order=2.0)))(*sets)
    gospa = jax.jit(jax.vmap(lambda *s: targets.gospa(*s, cutoff=CUTOFF, order=2.0, alpha=1.5)))(*sets)
    for k, (x, valid_x, y, valid_y) in enumerate(zip(*sets, strict=True)):
        inner, size = (x[valid_x], y[valid_y]), max(valid_x.sum(), valid_y.sum(), 1)
        expected = (by_permutations(*inner, 2.0, CUTOFF**2) / size) ** 0.5
        assert float(ospa.distance[k]) == pytest.approx(expected, abs=1e-9)
        expected = by_permutations(*inner, 2.0, CUTOFF**2 / 1.5) ** 0.5
        assert float(gospa.distance[k]) == pytest.approx(expected, abs=1e-9)
    np.testing.assert_allclose(ospa.localization**2 + ospa.cardinality**2, ospa.distance**2, atol=1e-9)
    np.testing.assert_allclose(gospa.localization + gospa.missed + gospa.false, gospa.distance**2, atol=1e-9)


@COUNTS
def test_stone_soup(count, x64):
    states = pytest.importorskip("stonesoup.types.state")
    metrics = pytest.importorskip("stonesoup.metricgenerator.ospametric")
    sets, time = random_sets(count), datetime(2020, 1, 1)
    ospa = jax.jit(jax.vmap(lambda *s: targets.ospa(*s, cutoff=CUTOFF, order=1.0)))(*sets)
    gospa = jax.jit(jax.vmap(lambda *s: targets.gospa(*s, cutoff=CUTOFF)))(*sets)
    for k, (x, valid_x, y, valid_y) in enumerate(zip(*sets, strict=True)):
        if not (valid_x.any() or valid_y.any()):
            assert float(ospa.distance[k]) == float(gospa.distance[k]) == 0.0
            continue
        one, other = ([states.State(point[:, None], time) for point in points] for points in (x[valid_x], y[valid_y]))
        expected = metrics.OSPAMetric(c=CUTOFF, p=1.0).compute_OSPA_distance(one, other).value
        assert float(ospa.distance[k]) == pytest.approx(float(expected), abs=1e-9)
        expected = metrics.GOSPAMetric(c=CUTOFF, p=2.0).compute_gospa_metric(one, other)[0].value
        for ours, theirs in (("distance",) * 2, ("localization", "localisation"), ("missed",) * 2, ("false",) * 2):
            assert float(getattr(gospa, ours)[k]) == pytest.approx(float(expected[theirs]), abs=1e-9)


def numbers(x, cutoff, *, y=None, valid=None):
    y = jnp.array([[0.5, 0.0], [2.0, 2.0], [4.0, 1.0]], x.dtype) if y is None else y
    valid = jnp.ones(3, bool) if valid is None else valid
    sets = x, jnp.ones(x.shape[0], bool), y, valid
    once, general = targets.ospa(*sets, cutoff=cutoff, order=2.0), targets.gospa(*sets, cutoff=cutoff, alpha=1.5)
    tracks = targets.ospa2(x[:, None], sets[1][:, None], y[:, None], valid[:, None], cutoff=cutoff, window=1, order=2.0)
    parts = (once.localization, once.cardinality, general.localization, general.missed, general.false)
    return jnp.stack([once.distance, general.distance, tracks.distance[0], *parts])


def test_slopes_by_the_cutoff_are_differences(x64):
    x = jnp.array([[0.0, 0.0], [2.5, 2.0], [9.0, 9.0], [-4.0, 2.7]])
    slope = jax.jit(jax.jacrev(numbers, argnums=(0, 1)))
    for cutoff in (0.3, 1.0, 3.0, 50.0):
        by_points, by_cutoff = slope(x, cutoff)
        step = 1e-6
        np.testing.assert_allclose(
            by_cutoff, (numbers(x, cutoff + step) - numbers(x, cutoff - step)) / (2 * step), rtol=1e-6, atol=1e-6
        )
        change = jnp.asarray(np.random.default_rng(1).standard_normal(x.shape))
        difference = (numbers(x + step * change, cutoff) - numbers(x - step * change, cutoff)) / (2 * step)
        np.testing.assert_allclose(jnp.sum(by_points * change[None], axis=(1, 2)), difference, rtol=1e-6, atol=1e-6)


BAD = [np.nan, np.inf, -np.inf, 1e30, -1e30, 3.4e38, 1e-30, 0.0]


@pytest.mark.parametrize("side", ["positions", "truth", "cutoff"])
def test_extreme_numbers_stay_finite(side):
    """Values and slopes; a point that is not finite or far away is one that matches none."""
    x, truth = jnp.array([[0.0, 0.0], [2.5, 2.0]]), jnp.array([[0.5, 0.0], [2.0, 2.0], [4.0, 1.0]])
    there = jnp.array([True, True, True])
    both = jax.jit(lambda x, c, y: (numbers(x, c, y=y, valid=there), jax.jacrev(numbers, argnums=(0, 1))(x, c, y=y)))
    for value in BAD:
        inputs = dict(positions=(x.at[0, 1].set(value), 3.0, truth), truth=(x, 3.0, truth.at[1, 0].set(value)))
        found = both(*inputs.get(side, (x, jnp.asarray(value, x.dtype), truth)))
        for part in jax.tree.leaves(found):
            assert bool(jnp.all(jnp.isfinite(part))), (value, found)
        if side == "positions" and not abs(value) < 1e20:
            lost = targets.gospa(inputs[side][0], jnp.ones(2, bool), truth, there, cutoff=3.0)
            assert (int(lost.num_false), int(lost.num_missed)) == (1, 2) and bool(lost.ok)


@pytest.mark.parametrize("value, ok", [(3.0, True), *((v, False) for v in (np.nan, np.inf, -1.0, 0.0, 1e30, 1e-30))])
def test_a_cutoff_that_is_none_is_not_ok(value, ok):
    x, here = jnp.array([[0.0, 0.0], [2.5, 2.0]]), jnp.ones(2, bool)
    assert bool(targets.ospa(x, here, x, here, cutoff=value, order=2.0).ok) is ok
    assert bool(targets.gospa(x, here, x, here, cutoff=value).ok) is ok
    for alpha in (0.0, -1.0, np.nan, np.inf, 3.0):
        found = targets.gospa(x, here, x[:1], here[:1], cutoff=3.0, alpha=alpha)
        assert not bool(found.ok) and np.isfinite(float(found.distance))
