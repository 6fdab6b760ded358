"""Resampling strategies: total weight, gradients, masks."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.beliefs import Particles, resampling
from jaxloc.beliefs.resampling.strategies import Multinomial, OptimalTransport, Residual, Soft, Stratified, Systematic


@pytest.mark.slow
@pytest.mark.parametrize(
    "strategy", [Systematic(), Stratified(), Multinomial(), Residual(), Soft(), OptimalTransport(iterations=10)]
)
def test_strategies_keep_mass_and_have_finite_gradients(strategy):
    values = jnp.linspace(-1.0, 1.0, 16)[:, None]

    def of(log_weights):
        done = strategy.resample(Particles(values, log_weights), key=jax.random.key(0))
        after = done.particles
        return after.log_total + jnp.sum(after.mean()), after.log_total

    gradient = jax.jit(jax.grad(of, has_aux=True))
    for log_weights in (
        jnp.arange(16.0) * 0.3,
        jnp.full(16, -jnp.inf),
        jnp.zeros(16),
        jnp.zeros(16).at[3].set(-jnp.inf).at[5].set(jnp.nan),
        jnp.full(16, -1e4).at[7].set(0.0),
    ):
        slope, total = gradient(log_weights)
        assert bool(jnp.all(jnp.isfinite(slope))) and bool(jnp.isfinite(total))
    total = gradient(jnp.arange(16.0) * 0.3)[1]
    tolerance = 0.6 if isinstance(strategy, Soft) else 1e-4
    assert np.isclose(total, np.logaddexp.reduce(np.arange(16) * 0.3), atol=tolerance)


def test_stop_gradient_is_the_score_of_the_choice(x64):
    """The derivative of the expected value over the draws, by the weights that the draws carry."""
    values = jnp.array([[1.0], [3.0], [-2.0]])

    def of(parameter, key):
        log_weights = jnp.stack([parameter, 0.5 * parameter, -parameter])
        after = (
            Multinomial().resample(Particles(values, log_weights - jax.nn.logsumexp(log_weights)), key=key).particles
        )
        return jnp.sum(jnp.exp(after.log_weights) * after.values[:, 0])

    slopes = jax.jit(jax.vmap(jax.grad(of), in_axes=(None, 0)))(0.7, jax.random.split(jax.random.key(0), 4000))
    exact = jax.grad(lambda p: jnp.sum(jax.nn.softmax(jnp.stack([p, 0.5 * p, -p])) * values[:, 0]))(0.7)
    assert abs(float(slopes.mean() - exact)) < 4.0 * float(slopes.std()) / np.sqrt(4000)


def test_counts_mask_the_rest():
    done = Systematic().resample(Particles(jnp.arange(8.0)[:, None]), key=jax.random.key(0), count=jnp.array(4))
    assert done.particles.valid.tolist() == [True] * 4 + [False] * 4
    assert np.isclose(done.particles.log_total, np.log(8.0)) and len(set(done.ancestors[:4].tolist())) == 4
    for strategy in (Soft(), OptimalTransport()):
        with pytest.raises(ValueError, match="Systematic"):
            strategy.resample(Particles(jnp.zeros((4, 1))), key=jax.random.key(0), count=jnp.array(2))
    assert resampling.Systematic is Systematic
