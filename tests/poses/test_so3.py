"""Rotations in space against matrix exponentials, SciPy and jaxlie."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from jaxloc.poses import SO3

ANGLES = [0.0, 1e-8, 1e-6, 1e-4, 1e-2, 0.1, 0.4999999, 0.5, 0.5000001, 1.0, 2.0, 3.0, np.pi - 1e-3]
AXIS = np.array([2.0, -1.0, 2.0]) / 3.0
VECTORS = np.array([a * AXIS for a in ANGLES])


def bound(dtype):
    return 1e-13 if dtype == np.float64 else 1e-6


def hat(w):
    return np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])


def mean_exponential(generator):
    """``integral of expm(s A) ds`` over (0, 1), the corner of one larger exponential."""
    n = generator.shape[0]
    return expm(np.block([[generator, np.eye(n)], [np.zeros((n, 2 * n))]]))[:n, n:]


def test_exp_equals_expm(dtype):
    vectors = VECTORS.astype(dtype)
    found = jax.vmap(lambda w: SO3.exp(w).matrix())(jnp.asarray(vectors))
    assert found.dtype == dtype
    expected = np.stack([expm(hat(w.astype(float))) for w in vectors])
    assert np.abs(found - expected).max() <= bound(dtype)


def test_log_returns_what_exp_was_given(dtype):
    vectors = VECTORS.astype(dtype)
    found = jax.vmap(lambda w: SO3.exp(w).log())(jnp.asarray(vectors))
    assert found.dtype == dtype
    assert np.abs(found - vectors).max() <= bound(dtype)


def test_small_rotations_keep_their_relative_precision(dtype):
    tiny = jnp.asarray(1e-8 * AXIS, dtype)
    np.testing.assert_allclose(SO3.exp(tiny).log(), tiny, rtol=10 * np.finfo(dtype).eps)


def test_jacobians_equal_the_mean_of_the_exponential(x64):
    both = jax.jit(lambda w: (SO3.left_jacobian(w), SO3.left_jacobian_inverse(w)))
    for w in VECTORS:
        expected = mean_exponential(hat(w))
        jacobian, inverse = both(jnp.asarray(w))
        assert np.abs(jacobian - expected).max() <= 1e-13
        assert np.abs(inverse - np.linalg.inv(expected)).max() <= 1e-12


def test_left_jacobian_is_the_derivative_of_exp(x64):
    @jax.jit
    def derivative(w):
        return jax.jacfwd(lambda x: SO3.exp(w).inverse().compose(SO3.exp(x)).log())(w), SO3.left_jacobian(-w)

    for w in VECTORS:
        right, expected = derivative(jnp.asarray(w))
        assert np.abs(right - expected).max() <= 1e-10


def test_left_jacobian_is_smooth_to_large_angles(x64):
    for angle in (4.0, 6.0):
        w = angle * AXIS
        assert np.abs(SO3.left_jacobian_inverse(jnp.asarray(w)) @ mean_exponential(hat(w)) - np.eye(3)).max() < 1e-11


@jax.jit
def derivatives_of_log(matrix):
    def log(m):
        return SO3.from_matrix(m).log()

    return [jax.jacfwd(log)(matrix), jax.jacrev(log)(matrix), jax.jacfwd(jax.jacrev(log))(matrix)]


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.5, np.pi, np.pi - 1e-7])
def test_derivatives_of_log_are_finite_to_second_order(angle, dtype):
    forward, backward, second = derivatives_of_log(jnp.asarray(expm(hat(angle * AXIS)), dtype))
    assert forward.dtype == dtype
    assert np.all(np.isfinite(forward)) and np.all(np.isfinite(second))
    np.testing.assert_allclose(forward, backward, atol=1e-5)


@pytest.mark.parametrize("axis", [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], AXIS, -AXIS])
def test_log_at_half_a_turn(axis, dtype):
    axis = np.asarray(axis)
    matrix = 2.0 * np.outer(axis, axis) - np.eye(3)
    found = np.asarray(SO3.from_matrix(jnp.asarray(matrix, dtype)).log())
    assert abs(np.linalg.norm(found) - np.pi) < 5 * np.finfo(dtype).eps
    assert abs(abs(found @ axis) - np.pi) < 5 * np.finfo(dtype).eps


def test_second_derivative_of_exp_at_identity(x64):
    second = jax.jit(jax.jacfwd(jax.jacrev(lambda w: SO3.exp(w).matrix())))(jnp.zeros(3))
    basis = [hat(e) for e in np.eye(3)]
    for i in range(3):
        for j in range(3):
            expected = 0.5 * (basis[i] @ basis[j] + basis[j] @ basis[i])
            np.testing.assert_allclose(second[:, :, i, j], expected, atol=1e-14)


def test_quaternion_equals_scipy(dtype, rng):
    rotations = Rotation.random(200, random_state=0)
    matrices = rotations.as_matrix().astype(dtype)
    found = np.asarray(jax.vmap(lambda m: SO3.from_matrix(m).quaternion())(jnp.asarray(matrices)))
    expected = rotations.as_quat(canonical=True, scalar_first=True)
    assert found.dtype == dtype and np.all(found[:, 0] >= 0)
    assert np.abs(found - expected).max() < (1e-14 if dtype == np.float64 else 1e-6)
    back = jax.vmap(lambda q: SO3.from_quaternion(3.0 * q).matrix())(jnp.asarray(found))
    assert np.abs(back - matrices).max() < (2e-15 if dtype == np.float64 else 1e-6)


def test_quaternion_of_zero_is_the_identity(dtype):
    zero = jnp.zeros(4, dtype)
    assert np.array_equal(SO3.from_quaternion(zero).matrix(), np.eye(3))
    assert np.all(np.isfinite(jax.jacfwd(lambda q: SO3.from_quaternion(q).matrix())(zero)))


def test_exp_and_log_equal_jaxlie(rng):
    vectors = jnp.asarray(rng.uniform(-1.5, 1.5, (50, 3)), jnp.float32)
    ours = jax.vmap(lambda w: SO3.exp(w).matrix())(vectors)
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        theirs = jax.vmap(lambda w: jaxlie.SO3.exp(w).as_matrix())(vectors)
    assert np.abs(ours - theirs).max() < 1e-6


def test_euler_is_the_printed_matrix(x64):  # K-7
    yaw, pitch, roll = 0.7, -0.4, 1.1
    c, s = np.cos, np.sin
    printed = np.array(
        [
            [
                c(yaw) * c(pitch),
                c(yaw) * s(pitch) * s(roll) - s(yaw) * c(roll),
                c(yaw) * s(pitch) * c(roll) + s(yaw) * s(roll),
            ],
            [
                s(yaw) * c(pitch),
                s(yaw) * s(pitch) * s(roll) + c(yaw) * c(roll),
                s(yaw) * s(pitch) * c(roll) - c(yaw) * s(roll),
            ],
            [-s(pitch), c(pitch) * s(roll), c(pitch) * c(roll)],
        ]
    )
    found = SO3.from_euler(yaw, pitch, roll).matrix()
    np.testing.assert_allclose(found, printed, atol=1e-15)
    np.testing.assert_allclose(found, Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix(), atol=1e-15)
    assert abs(np.linalg.det(found) - 1.0) < 1e-14


def test_euler_round_trip_and_jacobian(dtype, rng):  # K-7
    angles = np.stack([rng.uniform(-3.1, 3.1, 50), rng.uniform(-1.5, 1.5, 50), rng.uniform(-3.1, 3.1, 50)], 1)
    trip = jax.vmap(lambda a: SO3.from_euler(a[0], a[1], a[2]).euler())
    found = trip(jnp.asarray(angles, dtype))
    assert np.abs(found - angles).max() < (1e-13 if dtype == np.float64 else 1e-5)
    jacobian = jax.vmap(jax.jacrev(lambda a: SO3.from_euler(a[0], a[1], a[2]).euler()))(jnp.asarray(angles, dtype))
    assert np.abs(np.asarray(jacobian) - np.eye(3)).max() < (1e-11 if dtype == np.float64 else 1e-3)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_euler_at_gimbal_lock(sign, dtype):  # K-7
    tolerance = 2e-15 if dtype == np.float64 else 1e-6
    matrix = jnp.asarray(Rotation.from_euler("ZYX", [0.4, sign * np.pi / 2, -0.2]).as_matrix(), dtype)
    matrix = jnp.where(jnp.abs(matrix) < tolerance, 0.0, matrix)
    rotation = SO3.from_matrix(matrix)
    angles = rotation.euler()
    assert float(angles[0]) == 0.0
    np.testing.assert_allclose(angles[1], sign * np.pi / 2, rtol=1e-6)
    np.testing.assert_allclose(SO3.from_euler(*angles).matrix(), matrix, atol=2 * tolerance)
    assert np.all(np.isfinite(jax.jacrev(lambda m: SO3.from_matrix(m).euler())(matrix)))


def test_normalize_makes_matrices_orthonormal(x64, rng):
    drifted = Rotation.from_rotvec([0.3, 0.2, -0.5]).as_matrix() + 1e-4 * rng.normal(size=(3, 3))
    matrix = SO3.from_matrix(jnp.asarray(drifted)).normalize().normalize().matrix()
    assert np.abs(matrix @ matrix.T - np.eye(3)).max() < 1e-12
    u, _, vt = np.linalg.svd(drifted)
    assert np.abs(matrix - u @ vt).max() < 1e-12


def test_apply_rotates_points(dtype, rng):
    rotation = SO3.exp(jnp.asarray([0.2, -0.3, 0.5], dtype))
    points = jnp.asarray(rng.normal(size=(4, 3)), dtype)
    expected = np.asarray(points) @ Rotation.from_rotvec([0.2, -0.3, 0.5]).as_matrix().T
    assert rotation.apply(points).dtype == dtype
    np.testing.assert_allclose(rotation.apply(points), expected, atol=1e-6)


def test_jit_equals_eager_and_vmap_equals_loop(x64):
    vectors = jnp.asarray(VECTORS)

    def function(w):
        return SO3.exp(w).compose(SO3.exp(0.5 * w)).log()

    batch = jax.vmap(function)(vectors)
    for i, w in enumerate(vectors[::3]):
        np.testing.assert_allclose(function(w), batch[3 * i], atol=1e-14)
        np.testing.assert_allclose(jax.jit(function)(w), batch[3 * i], atol=1e-14)
