import math
from fractions import Fraction

import jax.numpy as jnp
import numpy as np

from jaxloc.beliefs.resampling.cumulative_weights import boundaries, bounded_values


def test_sums_are_exact_for_a_million(rng):
    values = rng.uniform(size=1_000_000).astype(np.float32) ** 4
    values /= values.max()
    count = 1_000_000
    bounds = boundaries(jnp.asarray(values), jnp.asarray(count))
    sums = np.asarray(bounds.whole, float) + np.asarray(bounds.fraction, float) / 2**32
    exact = np.cumsum(np.float64(values)) * (count / np.sum(np.float64(values)))
    # Shares are rounded to 2^-24 of themselves, at random; a sum in single precision is off by 0.03 and more.
    assert np.abs(sums - exact).max() < 2e-3
    assert np.all(np.diff(sums) >= -1e-6)
    assert abs(sums[-1] - count) < 1e-6


def test_small_sums_equal_fractions(rng):
    values = rng.uniform(size=7).astype(np.float32)
    values[[2, 6]] = 0.0
    values[0] = 1.0
    bounds = boundaries(jnp.asarray(values), jnp.asarray(5))
    parts = [Fraction(float(value)) for value in values]
    running = np.cumsum([float(5 * part / sum(parts)) for part in parts])
    sums = np.asarray(bounds.whole, float) + np.asarray(bounds.fraction, float) / 2**32
    assert np.allclose(sums, running, atol=2e-6)
    assert int(bounds.last) == 5


def test_order_and_scale_do_not_matter(rng):
    # The total is the same in any order, so that shards may be summed as they come.
    values = rng.uniform(size=4096).astype(np.float32)
    values[0] = 1.0
    forward, backward = (boundaries(jnp.asarray(v), jnp.asarray(100)).share for v in (values, values[::-1].copy()))
    assert np.array_equal(forward, np.asarray(backward)[::-1])


def test_nonfinite_weights():
    assert bounded_values(jnp.array([jnp.nan, jnp.inf, -jnp.inf])).tolist() == [1.0, 1.0, 1.0]
    assert bounded_values(jnp.array([-1e30, -1e30])).tolist() == [1.0, 1.0]
    assert bounded_values(jnp.array([0.0, -math.log(2.0), jnp.nan])).round(6).tolist() == [1.0, 0.5, 0.0]
    empty = boundaries(jnp.zeros(4), jnp.asarray(0))
    assert empty.whole.tolist() == [0, 0, 0, 0]
    one = boundaries(jnp.array([0.0, 1.0, 0.0]), jnp.asarray(3))
    assert one.whole.tolist() == [0, 3, 3]
