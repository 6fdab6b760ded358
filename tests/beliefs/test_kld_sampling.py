import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import chi2, norm

from jaxloc.beliefs import KLDSize, Particles
from jaxloc.beliefs.kld_sampling import coordinates
from jaxloc.poses import SE2, SE3


def test_needed_is_the_chi_square_bound():  # Fox 2001, eq. 7 approximates the quantile over 2 e
    size = KLDSize(jnp.ones(1), error=0.05, quantile=float(norm.ppf(0.99)), minimum=1)
    for bins in (2, 10, 100, 1000):
        assert np.isclose(size.needed(jnp.array(bins)), chi2.ppf(0.99, bins - 1) / 0.1, rtol=0.02 if bins > 2 else 0.06)
    assert int(size.needed(jnp.array(1))) == 1


def test_wide_clouds_need_more(rng):
    size = KLDSize(jnp.array([0.5, 0.5, 0.2]), minimum=50)

    @jax.jit
    def count(scale):
        x, y, theta = scale * jax.random.normal(jax.random.key(0), (3, 4000))
        return size.count(Particles(jax.vmap(SE2)(x, y, 0.1 * theta)))

    narrow, middle, wide = (int(count(jnp.float32(scale))) for scale in (0.01, 0.5, 20.0))
    assert narrow < 300 < middle < 3000 and wide == 4000


def test_count_equals_the_sequential_algorithm(rng):
    size = KLDSize(jnp.array([0.5, 0.5]), minimum=20)
    values = rng.normal(size=(2000, 2)).astype(np.float32)
    found = int(size.count(Particles(jnp.asarray(values))))
    stride = next(s for s in range(int(2000 * 0.6180339887498949), 2000) if np.gcd(s, 2000) == 1)
    bins, n = set(), 0
    for visit in (np.arange(2000) * stride) % 2000:
        n += 1
        bins.add(tuple(np.floor(values[visit] / 0.5).astype(int)))
        if n >= int(size.needed(jnp.array(len(bins)))):
            break
    assert abs(found - n) <= 0.05 * n  # two bins may share a slot of the table


def test_coordinates():
    poses = jax.vmap(SE3.exp)(jnp.arange(12.0).reshape(2, 6) * 0.1)
    stacked = coordinates((poses, jnp.ones((2, 2, 1)), jnp.array([1, 2])))
    assert stacked.shape == (2, 8) and np.allclose(stacked[0, 3:6], [0.3, 0.4, 0.5], atol=1e-6)
