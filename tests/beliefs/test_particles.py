import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.beliefs import Gaussian, Particles
from jaxloc.poses import SE2, SE3, SO2, SO3, local, retract


def planar(x, y, theta, dtype=np.float32):
    return jax.vmap(SE2)(*(jnp.asarray(axis, dtype) for axis in (x, y, theta)))


def test_estimates_equal_numpy(dtype, rng):
    values, log_weights = rng.normal(size=(50, 3)), 2.0 * rng.normal(size=50) + 300.0
    weights = np.exp(log_weights - log_weights.max())
    weights /= weights.sum()
    cloud = Particles(jnp.asarray(values, dtype), jnp.asarray(log_weights, dtype))
    tolerance = 1e-4 if dtype == np.float32 else 1e-12
    gaussian = cloud.gaussian()
    assert gaussian.mean.dtype == gaussian.covariance.dtype == cloud.ess.dtype == dtype
    assert np.allclose(gaussian.mean, weights @ values, atol=tolerance)
    expected = np.cov(values.T, aweights=weights, ddof=0)
    assert np.allclose(gaussian.covariance, expected, atol=tolerance)
    assert np.isclose(cloud.ess, 1.0 / np.sum(weights**2), rtol=tolerance)
    assert np.allclose(cloud.best(), values[weights.argmax()])
    assert np.isclose(cloud.log_total, np.logaddexp.reduce(log_weights), rtol=1e-6)
    assert np.isclose(cloud.log_mean_weight, np.logaddexp.reduce(log_weights) - np.log(50), rtol=1e-6)


def test_headings_are_averaged_around_the_circle():  # the mean of 179 and -179 degrees is 180, not 0
    cloud = Particles(planar([0.0, 2.0], [0.0, 0.0], np.radians([179.0, -179.0])))
    mean = cloud.mean()
    assert np.isclose(abs(float(mean.theta)), np.pi, atol=1e-5) and np.isclose(mean.x, 1.0)
    assert np.isclose(mean.rotation.cos**2 + mean.rotation.sin**2, 1.0)
    assert np.allclose(np.asarray(cloud.covariance())[2, 2], np.radians(1.0) ** 2, rtol=1e-3)
    # Opposite headings have no mean: the best particle's stands for it.
    opposed = Particles(planar([0.0, 1.0], [0.0, 0.0], [0.0, np.pi]), jnp.log(jnp.array([0.5, 0.5])))
    assert np.isfinite(float(opposed.mean().theta))


def test_mean_rotation_minimizes_quaternion_distance(x64, rng):
    from scipy.spatial.transform import Rotation

    rotations, weights = Rotation.from_rotvec(rng.normal(size=(30, 3))), rng.uniform(size=30)
    poses = jax.vmap(lambda m, t: SE3(SO3(m), t))(
        jnp.asarray(rotations.as_matrix()), jnp.asarray(rng.normal(size=(30, 3)))
    )
    mean = Particles(poses, jnp.log(jnp.asarray(weights))).mean()
    expected = rotations.mean(weights=weights).as_matrix()
    # Five squarings leave the 32nd power of the second eigenvalue's part.
    assert np.allclose(mean.rotation.matrix(), expected, atol=1e-3)
    near = Rotation.from_rotvec(0.1 * rng.normal(size=(30, 3)))
    poses = jax.vmap(SO3)(jnp.asarray(near.as_matrix()))
    assert np.allclose(Particles(poses, jnp.log(jnp.asarray(weights))).mean().matrix(), near.mean(weights).as_matrix())


def test_two_modes_separate_the_three_estimates():
    left, right = np.full(60, -5.0), np.full(40, 5.0)
    x = np.concatenate([left, right]) + np.linspace(-0.2, 0.2, 100)
    log_weights = jnp.zeros(100).at[80].set(0.5)
    cloud = Particles(planar(x, np.zeros(100), np.zeros(100)), log_weights)
    assert abs(float(cloud.mean().x)) < 1.5  # between the modes, where there is no particle
    assert np.isclose(float(cloud.best().x), x[80])
    near = cloud.local_mean(jnp.array([1.0, 1.0, 1.0]))
    assert abs(float(near.x) - 5.0) < 0.2
    weights = np.asarray(cloud.weights) * np.exp(-0.5 * (x - x[80]) ** 2)
    assert np.isclose(float(near.x), weights @ x / weights.sum(), atol=1e-4)


def test_zero_and_nonfinite_weights():
    values = jnp.arange(4.0)[:, None]
    degenerate = Particles(values, jnp.array([jnp.nan, -jnp.inf, jnp.inf, jnp.nan]))
    assert not degenerate.ok and np.allclose(degenerate.mean(), 1.5) and np.isclose(degenerate.ess, 4.0)
    masked = Particles(values, None, jnp.array([True, False, True, False]))
    assert np.allclose(masked.weights, [0.5, 0.0, 0.5, 0.0]) and int(masked.count) == 2
    assert np.allclose(masked.covariance(), 1.0) and np.isclose(masked.log_mean_weight, 0.0)
    nothing = Particles(values, jnp.full(4, -jnp.inf), jnp.array([True, True, False, False])).normalize()
    assert np.allclose(nothing.weights, [0.5, 0.5, 0.0, 0.0]) and bool(jnp.all(jnp.isfinite(nothing.log_weights)))

    def of(log_weights):
        cloud = Particles(planar(jnp.arange(3.0), jnp.zeros(3), jnp.zeros(3)), log_weights)
        return cloud.mean().x + cloud.ess + cloud.covariance()[0, 0] + cloud.local_mean(jnp.ones(3)).x

    slopes = jax.jit(jax.vmap(jax.grad(of)))(jnp.array([[0.0, -jnp.inf, 1.0], [-jnp.inf] * 3, [jnp.nan, 0.0, -1e38]]))
    assert bool(jnp.all(jnp.isfinite(slopes)))


def test_masked_particles_are_absent(rng):
    values, log_weights = (
        jnp.asarray(rng.normal(size=(6, 2)), jnp.float32),
        jnp.asarray(rng.normal(size=6), jnp.float32),
    )
    valid = jnp.array([True, True, True, False, False, True])
    kept = np.asarray(valid)
    few = Particles(values[kept], log_weights[kept])
    # What lies in an unused place does not matter.
    masked = Particles(values.at[3].set(jnp.nan), log_weights.at[4].set(jnp.inf), valid)
    for read in (Particles.mean, Particles.best, Particles.covariance, lambda c: c.ess, lambda c: c.log_mean_weight):
        assert np.allclose(read(masked), read(few), atol=1e-6)
    assert np.allclose(masked.local_mean(jnp.ones(2)), few.local_mean(jnp.ones(2)), atol=1e-6)


def test_gradients_equal_differences(x64, rng):
    log_weights = jnp.asarray(rng.normal(size=8))
    x, y, theta = rng.normal(size=(3, 8))

    def of(parameters):
        cloud = Particles(
            (planar(x, y, theta + parameters[0] * y, float), jnp.asarray(x)[:, None]), log_weights * parameters[1]
        )
        mean, near = cloud.mean(), cloud.local_mean(jnp.ones(4))
        return mean[0].theta + mean[1][0] + near[0].x + cloud.ess + cloud.log_total + jnp.sum(cloud.covariance())

    point = jnp.array([0.3, 1.2])
    gradient = jax.jit(jax.grad(of))(point)
    jitted = jax.jit(of)
    for i in range(2):
        step = 1e-6 * np.eye(2)[i]
        assert np.isclose(gradient[i], (jitted(point + step) - jitted(point - step)) / 2e-6, rtol=1e-6)


def test_draws(dtype):
    gaussian = Gaussian(
        SE2(*(jnp.asarray(v, dtype) for v in (1.0, 2.0, 3.0))), jnp.diag(jnp.array([1.0, 0.5, 0.01], dtype))
    )
    cloud = Particles.from_gaussian(gaussian, 4000, key=jax.random.key(0))
    assert cloud.log_weights.dtype == dtype and np.isclose(cloud.ess, 4000.0)
    assert np.allclose(local(gaussian.mean, cloud.mean()), 0.0, atol=0.06)
    assert np.allclose(cloud.covariance(), gaussian.covariance, atol=0.06)
    box = Particles.uniform(jnp.array([0.0, 5.0], dtype), jnp.array([1.0, 7.0], dtype), 4000, key=jax.random.key(1))
    assert box.values.dtype == dtype and np.allclose(box.mean(), [0.5, 6.0], atol=0.05)
    flat = Particles.uniform_planar(
        jnp.array([0.0, 5.0], dtype), jnp.array([1.0, 7.0], dtype), 4000, key=jax.random.key(2)
    )
    theta = np.arctan2(flat.values.rotation.sin, flat.values.rotation.cos)
    assert theta.dtype == dtype and np.allclose(np.histogram(theta, 4, (-np.pi, np.pi))[0], 1000, atol=150)


def test_convergence_of_moments():  # errors shrink as the root of the number
    def error(count, key):
        draws = jax.random.normal(key, (count, 1))
        log_weights = -0.5 * (draws[:, 0] - 1.0) ** 2 / 0.5 + 0.0 * draws[:, 0]
        return Particles(draws, log_weights).mean()[0] - 2.0 / 3.0  # N(0, 1) times N(1, 0.5)

    keys = jax.random.split(jax.random.key(0), 200)
    small, large = (float(jnp.sqrt(jnp.mean(jax.vmap(lambda k, n=n: error(n, k))(keys) ** 2))) for n in (100, 1600))
    assert 2.8 < small / large < 5.6


def test_stacks_are_refused_and_integers_kept():
    cloud = Particles(
        {"count": jnp.array([3, 4, 5]), "pose": jax.vmap(SO2)(jnp.ones(3), jnp.zeros(3))}, jnp.array([0.0, 1.0, 0.0])
    )
    assert int(cloud.mean()["count"]) == 4
    with pytest.raises(ValueError, match="one pose per particle"):
        Particles(jax.vmap(jax.vmap(SO2))(jnp.ones((3, 2)), jnp.zeros((3, 2)))).mean()


def test_vmap_equals_loop(rng):
    values, log_weights = (
        jnp.asarray(rng.normal(size=(3, 5, 2)), jnp.float32),
        jnp.asarray(rng.normal(size=(3, 5)), jnp.float32),
    )
    batched = jax.vmap(lambda v, w: Particles(v, w).mean())(values, log_weights)
    assert np.allclose(batched, [Particles(v, w).mean() for v, w in zip(values, log_weights, strict=True)], atol=1e-6)
    moved = retract(batched[0], jnp.ones(2))
    assert moved.shape == (2,)
