"""Resampling schemes: unbiased counts with the variance of the scheme, exact for a million particles."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.beliefs.resampling.indices import multinomial, residual, soft, stratified, systematic

SCHEMES = {scheme.__name__: scheme for scheme in (systematic, stratified, multinomial, residual)}
WEIGHTS = np.array([0.05, 0.3, 0.0, 0.15, 0.02, 0.28, 0.2])


@pytest.fixture(scope="module")
def counts():
    """Counts of 4000 draws of ten from seven, for each scheme."""
    keys = jax.random.split(jax.random.key(0), 4000)
    log_weights = jnp.log(jnp.asarray(WEIGHTS, jnp.float32)) + 70.0

    @jax.jit
    def draw(keys):
        return {name: jax.vmap(lambda key, s=s: s(key, log_weights, 10))(keys) for name, s in SCHEMES.items()}

    drawn = {name: np.asarray(indices) for name, indices in draw(keys).items()}
    assert all(np.all(np.diff(indices, axis=1) >= 0) for indices in drawn.values())
    return {n: np.stack([np.bincount(row, minlength=7) for row in indices]) for n, indices in drawn.items()}


@pytest.mark.parametrize("name", SCHEMES)
def test_counts_are_unbiased(counts, name):
    found = counts[name]
    error = (found.mean(0) - 10 * WEIGHTS) / np.maximum(found.std(0) / np.sqrt(len(found)), 1e-9)
    error[np.isclose(found.mean(0), 10 * WEIGHTS, atol=1e-6)] = 0.0
    assert np.all(np.abs(error) < 4.0), error
    assert np.all(found.sum(1) == 10) and np.all(found[:, 2] == 0)


def test_counts_have_the_variance_of_their_scheme(counts):
    assert np.all(np.abs(counts["systematic"] - 10 * WEIGHTS[None]) < 1.0)
    assert np.all(np.abs(counts["stratified"] - 10 * WEIGHTS[None]) < 2.0)
    assert np.all(counts["residual"] >= np.floor(10 * WEIGHTS + 1e-6)[None])
    independent = counts["multinomial"]
    assert np.allclose(np.cov(independent.T), 10 * (np.diag(WEIGHTS) - np.outer(WEIGHTS, WEIGHTS)), atol=0.2)
    order = [counts[name].var(0).sum() for name in ("systematic", "stratified", "multinomial")]
    assert order[0] <= order[1] < order[2] and counts["residual"].var(0).sum() < order[2]


@pytest.mark.parametrize("name", SCHEMES)
def test_a_million_particles_in_single_precision(name, rng):  # a plain cumulative sum is off by whole particles
    n = 1_000_000
    log_weights = (-2.0 * rng.normal(size=n) ** 2).astype(np.float32)
    weights = np.exp(np.float64(log_weights))
    weights /= weights.sum()
    indices = np.asarray(jax.jit(SCHEMES[name], static_argnums=2)(jax.random.key(1), jnp.asarray(log_weights), n))
    running = np.cumsum(np.bincount(indices, minlength=n) - n * weights)
    bound = {"systematic": 1.001, "stratified": 2.0, "multinomial": 4e3, "residual": 4e3}[name]
    assert np.abs(running).max() < bound
    if name == "systematic":  # all shares are cut at the same fraction: the offset never drifts
        assert np.ptp(running) < 1.01


def test_systematic_equals_searchsorted(x64, rng):
    weights = rng.uniform(size=200)
    indices = np.asarray(systematic(jax.random.key(3), jnp.log(jnp.asarray(weights)), 500))
    offset = float(jax.random.bits(jax.random.key(3), (), jnp.uint32)) / 2**32
    running = np.cumsum(weights / weights.sum())
    expected = np.searchsorted(running, (np.arange(500) + offset) / 500, side="right")
    assert np.mean(indices != expected) < 0.005 and np.abs(indices - expected).max() <= 1


@pytest.mark.slow
@pytest.mark.parametrize("name", SCHEMES)
def test_nonfinite_weights_and_counts(name):
    scheme = jax.jit(SCHEMES[name], static_argnums=2)
    key = jax.random.key(0)
    some = scheme(key, jnp.array([jnp.nan, 0.0, -jnp.inf, jnp.inf, 0.0]), 64)
    assert set(some.tolist()) == {1, 4}
    for value in (-jnp.inf, jnp.nan):
        assert len(set(scheme(key, jnp.full(5, value), 64).tolist())) == 5
    part = scheme(key, jnp.array([0.0, 0.0, -jnp.inf, 0.0, -jnp.inf]), 64, count=jnp.array(30))
    assert set(part[:30].tolist()) == {0, 1, 3} and int(part.max()) <= 4
    batch = jax.jit(jax.vmap(lambda k: SCHEMES[name](k, jnp.arange(5.0), 64)))(jax.random.split(key, 3))
    loop = [scheme(k, jnp.arange(5.0), 64) for k in jax.random.split(key, 3)]
    assert np.array_equal(batch, loop)


def test_multinomial_of_few_cells_counts_exactly():
    # All points fall between the boundaries of one heavy particle: the comparison within a cell is exercised in full.
    log_weights = jnp.log(jnp.array([0.5 + 1e-4, 0.5 - 1e-4]))
    keys = jax.random.split(jax.random.key(0), 20_000)
    ones = jax.jit(jax.vmap(lambda key: jnp.sum(multinomial(key, log_weights, 3))))(keys)
    expected = [1 / 8, 3 / 8, 3 / 8, 1 / 8]
    assert np.allclose(np.bincount(ones, minlength=4) / 20_000, expected, atol=0.012)


def test_soft_weights_are_unbiased():
    log_weights = jnp.log(jnp.asarray(WEIGHTS, jnp.float32))

    def estimate(key):
        indices, fresh = soft(key, log_weights, 10, alpha=0.3)
        return jnp.zeros(7).at[indices].add(jnp.exp(fresh))

    found = np.asarray(jax.jit(jax.vmap(estimate))(jax.random.split(jax.random.key(0), 4000)))
    error = found.mean(0) - WEIGHTS
    assert np.all(np.abs(error) < 4.0 * found.std(0) / np.sqrt(4000) + 1e-6)
    with pytest.raises(ValueError, match="alpha"):
        soft(jax.random.key(0), log_weights, 10, alpha=0.0)
    everything = soft(jax.random.key(0), log_weights, 10, alpha=1.0)[1]
    assert np.allclose(everything, -np.log(10.0), atol=1e-5)
