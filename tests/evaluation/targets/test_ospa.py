"""T-65: distances between sets of targets, against Stone Soup, SciPy and closed forms."""

from datetime import datetime

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from jaxloc.evaluation import targets

CUTOFF = 50.0
ospa = jax.jit(jax.vmap(lambda *sets: targets.ospa(*sets, cutoff=CUTOFF)))
gospa = jax.jit(jax.vmap(lambda *sets: targets.gospa(*sets, cutoff=CUTOFF)))


@pytest.fixture(scope="module")
def pairs():
    """Sixty pairs of sets, some of which are empty, with numbers that must not matter where nothing is valid."""
    rng = np.random.default_rng(3)
    y = rng.uniform(0.0, 200.0, (60, 6, 2))
    x = np.concatenate([y + 20.0 * rng.standard_normal(y.shape), rng.uniform(0.0, 200.0, (60, 2, 2))], axis=1)
    valid_x, valid_y = rng.uniform(size=(60, 8)) < 0.7, rng.uniform(size=(60, 6)) < 0.8
    valid_x[0], valid_y[1], valid_x[2], valid_y[2] = False, False, False, False
    x[~valid_x], y[~valid_y] = 1e3, np.nan
    return x, valid_x, y, valid_y


def stone_soup(pairs, metric):
    states = pytest.importorskip("stonesoup.types.state")
    time = datetime(2020, 1, 1)
    for x, valid_x, y, valid_y in zip(*pairs, strict=True):
        if valid_x.any() or valid_y.any():
            one, other = ([states.State(p[:, None], time) for p in s] for s in (x[valid_x], y[valid_y]))
            yield metric(one, other)


def test_ospa_is_stone_soups(pairs, x64):
    ospametric = pytest.importorskip("stonesoup.metricgenerator.ospametric")
    found = ospa(*(jnp.asarray(a) for a in pairs))
    metric = ospametric.OSPAMetric(c=CUTOFF, p=1.0)
    expected = [m.value for m in stone_soup(pairs, metric.compute_OSPA_distance)]
    some = pairs[1].any(axis=1) | pairs[3].any(axis=1)
    np.testing.assert_allclose(found.distance[some], expected, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(found.distance[~some], 0.0)
    np.testing.assert_allclose(found.localization + found.cardinality, found.distance, atol=1e-12)


def test_gospa_is_stone_soups(pairs, x64):
    ospametric = pytest.importorskip("stonesoup.metricgenerator.ospametric")
    found = gospa(*(jnp.asarray(a) for a in pairs))
    metric = ospametric.GOSPAMetric(c=CUTOFF, p=2.0)
    expected = [m[0].value for m in stone_soup(pairs, metric.compute_gospa_metric)]
    some = pairs[1].any(axis=1) | pairs[3].any(axis=1)
    for ours, theirs in (("distance", "distance"), ("localization", "localisation"), ("missed",) * 2, ("false",) * 2):
        values = np.array([float(value[theirs]) for value in expected])
        np.testing.assert_allclose(getattr(found, ours)[some], values, rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(np.asarray(found.num_missed) * CUTOFF**2 / 2.0, found.missed)
    np.testing.assert_array_equal(found.distance[~some], 0.0)


def brute(x, y, order, extra):
    """Sum over the best pairs of the capped distances to a power, plus what each point more of one set costs."""
    gaps = np.minimum(np.linalg.norm(x[:, None] - y[None], axis=2), CUTOFF) ** order
    return gaps[linear_sum_assignment(gaps)].sum() + extra * abs(len(x) - len(y))


def test_other_orders_and_alphas(pairs, x64):
    for x, valid_x, y, valid_y in list(zip(*pairs, strict=True))[3:8]:
        sets = [jnp.asarray(a) for a in (x, valid_x, y, valid_y)]
        inner = x[valid_x], y[valid_y]
        more = max(len(inner[0]), len(inner[1]))
        found = targets.ospa(*sets, cutoff=CUTOFF, order=2.0)
        assert float(found.distance) == pytest.approx((brute(*inner, 2.0, CUTOFF**2) / more) ** 0.5, rel=1e-12)
        found = targets.gospa(*sets, cutoff=CUTOFF, order=1.0, alpha=1.0)
        assert float(found.distance) == pytest.approx(brute(*inner, 1.0, CUTOFF), rel=1e-12)
        assert float(found.localization + found.missed + found.false) == pytest.approx(float(found.distance))


def test_precision_follows_the_input_and_a_metric_is_symmetric(pairs, dtype):
    x, valid_x, y, valid_y = (jnp.asarray(a, dtype if a.dtype != bool else bool) for a in pairs)
    found = ospa(x, valid_x, y, valid_y)
    assert found.distance.dtype == dtype
    back = jax.vmap(lambda *sets: targets.ospa(*sets, cutoff=CUTOFF))(y, valid_y, x, valid_x)
    np.testing.assert_allclose(found.distance, back.distance, rtol=1e-5, atol=1e-4)
    one = targets.ospa(x[5], valid_x[5], y[5], valid_y[5], cutoff=CUTOFF)
    assert float(one.distance) == pytest.approx(float(found.distance[5]), rel=1e-5)


def test_gradients_are_right_and_finite(pairs, x64):
    x, valid_x, y, valid_y = (jnp.asarray(a[7]) for a in pairs)

    def value(points, cutoff):
        sets = points, valid_x, y, valid_y
        return targets.ospa(*sets, cutoff=cutoff).distance + targets.gospa(*sets, cutoff=cutoff).distance

    slope = jax.jit(jax.grad(value, argnums=(0, 1)))
    by_points, by_cutoff = slope(x, jnp.array(CUTOFF))
    step = 1e-5
    change = jnp.asarray(np.random.default_rng(0).standard_normal(x.shape))
    ends = [float(value(x + s * change, jnp.array(CUTOFF))) for s in (step, -step)]
    assert float(jnp.sum(by_points * change)) == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-6)
    ends = [float(value(x, jnp.array(CUTOFF + s))) for s in (step, -step)]
    assert float(by_cutoff) == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-6)
    exact = jnp.zeros_like(x).at[:6].set(jnp.where(valid_y[:, None], y, 0.0))
    for points in (exact, x.at[0].set(jnp.nan)):
        assert all(bool(jnp.all(jnp.isfinite(part))) for part in slope(points, jnp.array(CUTOFF)))


def test_an_estimate_with_bad_numbers_is_a_false_one():
    x, y, here = jnp.array([[jnp.nan, 0.0]]), jnp.zeros((1, 2)), jnp.ones(1, bool)
    found = targets.gospa(x, here, y, here, cutoff=CUTOFF)
    assert (int(found.num_missed), int(found.num_false)) == (1, 1) and float(found.distance) == CUTOFF
    with pytest.raises(ValueError, match="order"):
        targets.ospa(x, here, y, here, cutoff=CUTOFF, order=0.5)


def tracks_distance(x, valid_x, y, valid_y):
    """OSPA(2) of order 1 by loops."""
    table = np.zeros((len(x), len(y)))
    for i, j in np.ndindex(table.shape):
        either, both = valid_x[i] | valid_y[j], valid_x[i] & valid_y[j]
        gaps = np.minimum(np.linalg.norm(x[i] - y[j], axis=1), CUTOFF)
        table[i, j] = np.where(both, gaps, CUTOFF)[either].sum() / max(either.sum(), 1)
    table = table[valid_x.any(axis=1)][:, valid_y.any(axis=1)]
    if not max(table.shape):
        return 0.0
    total = table[linear_sum_assignment(table)].sum() + CUTOFF * abs(table.shape[0] - table.shape[1])
    return total / max(table.shape)


def test_distances_of_tracks(rng, x64):
    window = 4
    y = np.cumsum(rng.standard_normal((4, 12, 2)), axis=1) * 20.0
    x = np.concatenate([y, y[:1]]) + rng.standard_normal((5, 12, 2))
    valid_y = rng.uniform(size=(4, 12)) < 0.8
    valid_x = np.concatenate([valid_y, valid_y[:1]]) & (rng.uniform(size=(5, 12)) < 0.7)
    sets = [jnp.asarray(a) for a in (x, valid_x, y, valid_y)]
    found = targets.ospa2(*sets, cutoff=CUTOFF, window=window)
    for end in range(12):
        part = slice(max(end + 1 - window, 0), end + 1)
        expected = tracks_distance(x[:, part], valid_x[:, part], y[:, part], valid_y[:, part])
        assert float(found.distance[end]) == pytest.approx(expected, abs=1e-9)
    # Over one instant it is the OSPA distance.
    single = targets.ospa2(*sets, cutoff=CUTOFF, window=1)
    each = [targets.ospa(*(a[:, 3] for a in sets), cutoff=CUTOFF)]
    assert float(single.distance[3]) == pytest.approx(float(each[0].distance), abs=1e-9)
    slope = jax.grad(lambda points: targets.ospa2(points, *sets[1:], cutoff=CUTOFF, window=4).distance.sum())(sets[0])
    assert bool(jnp.all(jnp.isfinite(slope))) and bool(jnp.any(slope != 0))
    with pytest.raises(ValueError, match="window"):
        targets.ospa2(*sets, cutoff=CUTOFF, window=0)
