import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.beliefs import Gaussian, compose, propagate_linear, propagate_sampled, propagate_unscented
from jaxloc.poses import SE2, SE3, local

A = np.array([[1.0, 2.0, -0.5], [0.3, -1.0, 0.7]])


def spd(rng, size, dtype, scale=1.0):
    a = rng.normal(size=(size, size))
    return jnp.asarray(scale * (a @ a.T + 0.1 * np.eye(size)), dtype)


def affine(x):
    return jnp.matmul(jnp.asarray(A, x.dtype), x, precision="highest") + 1.0


def quadratic(x):
    return jnp.stack([x @ x, x[0] * x[1] + 2.0 * x[2], x[1] ** 2])


def polar(x):
    return jnp.stack([x[0] * jnp.cos(x[1]), x[0] * jnp.sin(x[1])])


def drive(x):
    return {"pose": x["pose"] @ SE2.exp(jnp.concatenate([x["step"], x["step"][:1]])), "speed": x["step"] ** 2}


def methods(key=0, n=20000):
    return {
        "linear": propagate_linear,
        "unscented": propagate_unscented,
        "sampled": lambda f, g: propagate_sampled(f, g, key=jax.random.key(key), num_samples=n),
    }


@pytest.mark.parametrize("name", ["linear", "unscented", "sampled"])
def test_affine_functions(dtype, rng, name):
    gaussian = Gaussian(jnp.asarray(rng.normal(size=3), dtype), spd(rng, 3, dtype))
    image = methods()[name](affine, gaussian)
    tolerance = 0.06 if name == "sampled" else 1e-5
    assert image.covariance.dtype == dtype
    assert np.allclose(image.mean, A @ np.asarray(gaussian.mean) + 1.0, atol=tolerance)
    expected = A @ np.asarray(gaussian.covariance) @ A.T
    assert np.allclose(image.covariance, expected, atol=tolerance * np.abs(expected).max())


def test_unscented_mean_of_a_quadratic_is_exact(x64, rng):
    gaussian = Gaussian(jnp.asarray(rng.normal(size=3)), spd(rng, 3, np.float64))
    m, P = np.asarray(gaussian.mean), np.asarray(gaussian.covariance)
    expected = [m @ m + np.trace(P), m[0] * m[1] + P[0, 1] + 2 * m[2], m[1] ** 2 + P[1, 1]]
    for options in ({}, {"alpha": 0.5, "beta": 2.0}, {"kappa": 1.0}, {"alpha": 1e-3, "beta": 2.0, "kappa": 0.0}):
        assert np.allclose(propagate_unscented(quadratic, gaussian, **options).mean, expected, atol=1e-6)


def test_unscented_variance_of_a_square_is_exact(dtype):
    gaussian = Gaussian(jnp.array([0.7], dtype), jnp.array([[0.3]], dtype))
    expected = 4 * 0.7**2 * 0.3 + 2 * 0.3**2
    assert np.isclose(propagate_unscented(jnp.square, gaussian).covariance[0, 0], expected, rtol=1e-5)
    same = propagate_unscented(jnp.square, gaussian, beta=2.0, kappa=0.0)
    assert np.isclose(same.covariance[0, 0], expected, rtol=1e-5)


def test_unscented_beats_linear_in_polar_coordinates(x64):
    gaussian = Gaussian(jnp.array([10.0, 0.4]), jnp.diag(jnp.array([0.02, 0.15]) ** 2))
    draws = np.random.default_rng(1).multivariate_normal(gaussian.mean, gaussian.covariance, 200000)
    truth = np.c_[draws[:, 0] * np.cos(draws[:, 1]), draws[:, 0] * np.sin(draws[:, 1])]
    errors = {}
    for name, method in methods().items():
        image = method(polar, gaussian)
        errors[name] = np.linalg.norm(image.mean - truth.mean(0)), np.linalg.norm(image.covariance - np.cov(truth.T))
    assert errors["unscented"][0] < 0.1 * errors["linear"][0]
    assert errors["unscented"][1] < 0.5 * errors["linear"][1]
    assert errors["sampled"][0] < 0.03


@pytest.mark.parametrize("name", ["linear", "unscented", "sampled"])
def test_poses_agree_with_monte_carlo(x64, rng, name):
    mean = {"pose": SE2(1.0, 2.0, 3.1), "step": jnp.array([0.8, -0.2])}
    gaussian = Gaussian(mean, spd(rng, 5, np.float64, 0.003))
    image = methods()[name](drive, gaussian)
    draws = jax.vmap(drive)(gaussian.sample(40000, key=jax.random.key(7)))
    deltas = np.asarray(jax.vmap(lambda x: local(image.mean, x))(draws))
    expected = np.cov(deltas.T)
    assert np.linalg.norm(image.covariance - expected) < 0.08 * np.linalg.norm(expected)
    if name != "linear":
        assert np.abs(deltas.mean(0)).max() < 0.05 * np.sqrt(np.trace(expected))


def test_linear_equals_compounding(x64, rng):  # K-4
    a, b = (Gaussian(SE3.exp(jnp.asarray(rng.normal(size=6))), spd(rng, 6, np.float64, 0.001)) for _ in range(2))
    zero = jnp.zeros((6, 6))
    joint = Gaussian((a.mean, b.mean), jnp.block([[a.covariance, zero], [zero, b.covariance]]))
    image = propagate_linear(lambda pair: pair[0] @ pair[1], joint)
    assert np.allclose(image.covariance, compose(a, b).covariance, atol=1e-12)


def test_nees_of_the_unscented_image_is_chi_square(x64):
    gaussian = Gaussian(jnp.array([10.0, 0.4]), jnp.diag(jnp.array([0.3, 0.03]) ** 2))
    draws = jax.vmap(polar)(gaussian.sample(5000, key=jax.random.key(3)))
    nees = np.asarray(jax.vmap(propagate_unscented(polar, gaussian).mahalanobis_squared)(draws))
    assert abs(nees.mean() - 2.0) < 4 * 2.0 / np.sqrt(5000)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["linear", "unscented", "sampled"])
def test_gradients_vmap_and_eager(x64, name):
    method = methods(n=16)[name]
    gaussian = Gaussian(jnp.array([10.0, 0.4]), jnp.diag(jnp.array([0.3, 0.03]) ** 2))

    def total(mean):
        image = method(polar, Gaussian(mean, gaussian.covariance))
        return image.mean.sum() + image.covariance.sum()

    gradient = jax.grad(total)(gaussian.mean)
    for i in range(2):
        step = 1e-6 * jnp.eye(2)[i]
        assert np.isclose(gradient[i], (total(gaussian.mean + step) - total(gaussian.mean - step)) / 2e-6, rtol=1e-5)
    stack = jnp.stack([gaussian.mean, 2 * gaussian.mean])
    assert np.allclose(jax.vmap(total)(stack), [total(m) for m in stack])
    with jax.disable_jit():
        assert np.isclose(total(gaussian.mean), jax.jit(total)(gaussian.mean))


def test_certain_input_stays_finite(dtype):
    gaussian = Gaussian(jnp.array([1.0, 0.5], dtype), jnp.zeros((2, 2), dtype))
    for method in methods(n=16).values():
        image = method(polar, gaussian)
        assert np.allclose(image.covariance, 0.0, atol=1e-6) and np.isfinite(image.mean).all()


def test_wrong_options_are_refused():
    gaussian = Gaussian(jnp.zeros(2), jnp.eye(2))
    with pytest.raises(ValueError, match="alpha"):
        propagate_unscented(affine, gaussian, kappa=-3.0)
    with pytest.raises(ValueError, match="2 samples"):
        propagate_sampled(affine, gaussian, key=jax.random.key(0), num_samples=1)
