import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from jaxloc.poses import SE2, SE3, chain

ANGLES = [0.0, 1e-8, 1e-6, 1e-4, 1e-2, 0.1, 0.4999999, 0.5, 0.5000001, 1.0, 2.0, 3.0, np.pi - 1e-3]
AXIS = np.array([2.0, -1.0, 2.0]) / 3.0
TWISTS = np.array([[0.0, 0.6, -0.8, *(a * AXIS)] for a in ANGLES])


def skew(w):
    return np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])


def hat(xi):
    return np.block([[skew(xi[3:]), xi[:3, None]], [np.zeros((1, 4))]])


def small_adjoint(xi):
    return np.block([[skew(xi[3:]), skew(xi[:3])], [np.zeros((3, 3)), skew(xi[3:])]])


def mean_exponential(generator):
    n = generator.shape[0]
    return expm(np.block([[generator, np.eye(n)], [np.zeros((n, 2 * n))]]))[:n, n:]


def random_pose(rng):
    return SE3.exp(jnp.asarray(rng.uniform(-1.5, 1.5, 6)))


def test_exp_equals_expm(dtype):
    twists = TWISTS.astype(dtype)
    found = jax.vmap(lambda xi: SE3.exp(xi).matrix())(jnp.asarray(twists))
    assert found.dtype == dtype
    expected = np.stack([expm(hat(xi.astype(float))) for xi in twists])
    assert np.abs(found - expected).max() <= (1e-13 if dtype == np.float64 else 1e-6)


def test_log_returns_what_exp_was_given(dtype):
    twists = jnp.asarray(TWISTS, dtype)
    found = jax.vmap(lambda xi: SE3.exp(xi).log())(twists)
    assert found.dtype == dtype
    assert np.abs(found - twists).max() <= (1e-13 if dtype == np.float64 else 1e-6)


def test_jacobians_equal_the_mean_adjoint(x64):
    both = jax.jit(lambda xi: (SE3.left_jacobian(xi), SE3.left_jacobian_inverse(xi)))
    for xi in TWISTS:
        expected = mean_exponential(small_adjoint(xi))
        jacobian, inverse = both(jnp.asarray(xi))
        assert np.abs(jacobian - expected).max() <= 1e-13
        assert np.abs(inverse - np.linalg.inv(expected)).max() <= 1e-12


def test_right_jacobian_is_the_derivative_of_exp(x64):
    @jax.jit
    def derivative(xi):
        return jax.jacfwd(lambda x: SE3.exp(xi).local(SE3.exp(x)))(xi), SE3.left_jacobian(-xi)

    for xi in TWISTS:
        found, expected = derivative(jnp.asarray(xi))
        assert np.abs(found - expected).max() <= 1e-10


def test_adjoint_equals_expm_of_the_small_adjoint(x64):
    adjoint = jax.jit(lambda xi: SE3.exp(xi).adjoint())
    for xi in TWISTS:
        assert np.abs(adjoint(jnp.asarray(xi)) - expm(small_adjoint(xi))).max() <= 1e-13


def test_log_equals_jaxlie(rng):
    twists = jnp.asarray(rng.uniform(-1.5, 1.5, (50, 6)), jnp.float32)
    ours = jax.vmap(lambda xi: SE3.exp(xi).matrix())(twists)
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        theirs = jax.vmap(lambda xi: jaxlie.SE3.exp(xi).as_matrix())(twists)
    assert np.abs(ours - theirs).max() < 2e-6


@jax.jit
def derivatives_of_log(pose):
    def log(delta):
        return pose.retract(delta).log()

    zero = jnp.zeros(6, pose.translation.dtype)
    return jax.jacfwd(log)(zero), jax.jacrev(log)(zero), jax.jacfwd(jax.jacrev(log))(zero)


@pytest.mark.slow
@pytest.mark.parametrize("angle", [0.0, 1e-9, np.pi])
def test_derivatives_are_finite_to_second_order(angle, dtype):
    forward, backward, second = derivatives_of_log(SE3.exp(jnp.asarray([1.0, 2.0, 3.0, *(angle * AXIS)], dtype)))
    assert forward.dtype == dtype
    assert np.all(np.isfinite(forward)) and np.all(np.isfinite(second))
    np.testing.assert_allclose(forward, backward, atol=1e-4)


def test_second_derivative_of_exp_at_identity(x64):
    second = jax.jit(jax.jacfwd(jax.jacrev(lambda xi: SE3.exp(xi).translation)))(jnp.zeros(6))
    assert float(second[0, 2, 4]) == 0.5  # x by v_z and omega_y: half the cross product
    assert float(second[2, 0, 4]) == -0.5
    assert float(second[0, 4, 2]) == 0.5


def test_derivative_of_log_equals_the_inverse_jacobian(x64, rng):
    xi = jnp.asarray(rng.uniform(-1.0, 1.0, 6))
    pose = SE3.exp(xi)
    found = derivatives_of_log(pose)[1]
    np.testing.assert_allclose(found, SE3.left_jacobian_inverse(-xi), atol=1e-13)


def test_matrix_of_six_numbers(dtype):  # K-7
    pose = SE3.from_euler(jnp.asarray([1.0, 2.0, 3.0], dtype), yaw=0.3, pitch=-0.2, roll=0.1)
    expected = np.eye(4)
    expected[:3, :3] = Rotation.from_euler("ZYX", [0.3, -0.2, 0.1]).as_matrix()
    expected[:3, 3] = [1.0, 2.0, 3.0]
    assert pose.matrix().dtype == dtype
    np.testing.assert_allclose(pose.matrix(), expected, atol=1e-6)
    np.testing.assert_allclose(SE3.from_matrix(pose.matrix()).matrix(), pose.matrix())
    points = jnp.asarray([[1.0, 0.0, -1.0], [0.0, -2.0, 5.0]], dtype)
    np.testing.assert_allclose(pose.apply(points), np.asarray(points) @ expected[:3, :3].T + expected[:3, 3], atol=2e-6)
    assert SE3.identity(dtype).translation.dtype == dtype


@jax.jit
def violations(xs):
    a, b, c = (SE3.exp(x) for x in xs)
    one, delta = SE3.identity(xs.dtype), 0.3 * xs[1]
    pairs = [
        ((a @ b) @ c, a @ (b @ c)),
        (a @ one, a),
        (one @ a, a),
        (a @ a.inverse(), one),
        ((a @ b).inverse(), b.inverse() @ a.inverse()),
        (a @ SE3.exp(delta), SE3.exp(a.adjoint() @ delta) @ a),
        (a.retract(a.local(b)), b),
        (a.normalize(), a),
    ]
    return jnp.stack([jnp.max(jnp.abs(p.matrix() - q.matrix())) for p, q in pairs])


@settings(max_examples=40, deadline=None)
@given(values=st.lists(st.floats(-2.0, 2.0, width=32), min_size=18, max_size=18))
def test_group_axioms(values):
    assert float(violations(jnp.asarray(values, jnp.float32).reshape(3, 6)).max()) < 3e-5


def test_mapping_localization_and_motion(x64, rng):  # K-1, K-2, K-3
    T_world_sensor, T_sensor_object = random_pose(rng), random_pose(rng)
    T_world_object = T_world_sensor @ T_sensor_object
    product = np.asarray(T_world_sensor.matrix()) @ np.asarray(T_sensor_object.matrix())
    np.testing.assert_allclose(T_world_object.matrix(), product, atol=1e-14)
    localized = T_world_object @ T_sensor_object.inverse()
    np.testing.assert_allclose(localized.matrix(), T_world_sensor.matrix(), atol=1e-14)
    later = random_pose(rng)
    for T_world_object in (random_pose(rng), random_pose(rng)):
        first, second = T_world_sensor.inverse() @ T_world_object, later.inverse() @ T_world_object
        motion = first @ second.inverse()
        np.testing.assert_allclose(motion.matrix(), (T_world_sensor.inverse() @ later).matrix(), atol=1e-13)


def test_relative_chain_and_its_growing_error(x64, rng):  # K-4
    steps = 30
    motions = jax.vmap(SE3.exp)(jnp.asarray(np.tile([1.0, 0.0, 0.0, 0.0, 0.0, 0.05], (steps, 1))))
    noise = jnp.asarray(rng.normal(size=(400, steps, 6)) * np.array([0.02, 0.02, 0.02, 0.01, 0.01, 0.01]))

    @jax.jit
    def errors(noise):
        noisy = jax.vmap(lambda motion, d: motion.retract(d))(motions, noise)
        initial = SE3.identity(noise.dtype)
        return jax.vmap(lambda a, b: a.local(b))(chain(initial, motions), chain(initial, noisy))

    found = np.asarray(jax.vmap(errors)(noise))
    dispersion = np.array([np.trace(np.cov(found[:, k].T)) for k in range(1, steps + 1)])
    # To first order the error after k steps is the sum of the noises carried to the last frame by adjoints.
    step = expm(small_adjoint(np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.05])))
    covariance, predicted = np.zeros((6, 6)), []
    for _ in range(steps):
        back = np.linalg.inv(step)
        covariance = back @ covariance @ back.T + np.diag([4e-4] * 3 + [1e-4] * 3)
        predicted.append(np.trace(covariance))
    assert np.all(np.diff(predicted) > 0)
    np.testing.assert_allclose(dispersion, predicted, rtol=0.25)


def test_a_loop_does_not_close(x64, rng):  # K-5
    """An object seen again after 100 steps: the chain of relative poses disagrees with what is seen."""
    steps = 100
    perfect = jax.vmap(SE3.exp)(jnp.asarray(np.tile([0.5, 0.0, 0.0, 0.0, 0.0, 2 * np.pi / steps], (steps, 1))))
    home = chain(SE3.identity(), perfect)
    assert np.abs(np.asarray(jax.tree.map(lambda x: x[-1], home).matrix()) - np.eye(4)).max() < 1e-12
    noisy = jax.vmap(lambda motion, d: motion.retract(d))(perfect, jnp.asarray(0.01 * rng.normal(size=(steps, 6))))
    closure = jax.tree.map(lambda x: x[-1], chain(SE3.identity(), noisy))
    assert float(jnp.linalg.norm(closure.log())) > 0.05


def test_object_and_robot_localization_are_inverse(x64, rng):  # K-15
    """One solver, two frames: the object's pose in the robot's frame is the inverse of the robot's in the object's."""
    points_object = rng.normal(size=(6, 3))
    truth = random_pose(rng)
    seen = np.asarray(truth.apply(jnp.asarray(points_object)))

    def kabsch(a, b):
        u, _, vt = np.linalg.svd((b - b.mean(0)).T @ (a - a.mean(0)))
        rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        return np.block([[rotation, (b.mean(0) - rotation @ a.mean(0))[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])

    T_robot_object, T_object_robot = kabsch(points_object, seen), kabsch(seen, points_object)
    np.testing.assert_allclose(truth.matrix(), T_robot_object, atol=1e-12)
    np.testing.assert_allclose(truth.inverse().matrix(), T_object_robot, atol=1e-12)


def test_dead_reckoning_of_a_kilometer_in_float32():
    """1000 steps of 1 m with 3 mrad of yaw: small-angle branches that cancel drift by a meter here."""
    steps, yaw = 1000, 3e-3
    twist = np.array([1.0, 0.0, 0.0, 0.0, 0.0, yaw], np.float32)
    motions = jax.vmap(SE3.exp)(jnp.asarray(np.tile(twist, (steps, 1))))
    path = np.asarray(jax.jit(chain)(SE3.identity(jnp.float32), motions).translation)
    exact, expected, step = np.eye(4), [np.zeros(3)], expm(hat(twist.astype(float)))
    for _ in range(steps):
        exact = exact @ step
        expected.append(exact[:3, 3])
    drift = np.linalg.norm(path - np.stack(expected), axis=1).max()
    assert drift <= 0.02

    planar = jax.vmap(SE2.exp)(jnp.asarray(np.tile(twist[[0, 1, 5]], (steps, 1))))
    path = np.asarray(jax.jit(chain)(SE2.identity(jnp.float32), planar).translation)
    assert np.linalg.norm(path - np.stack(expected)[:, :2], axis=1).max() <= 0.02


def test_stacks_and_jit(x64):
    twists = jnp.asarray(TWISTS)
    stack = jax.vmap(SE3.exp)(twists)
    assert stack.batch_shape == (len(TWISTS),)
    logs = jax.vmap(lambda pose: pose.log())(stack)
    jitted = jax.jit(lambda xi: SE3.exp(xi).log())
    for i in (0, 7, 12):
        np.testing.assert_allclose(logs[i], SE3.exp(twists[i]).log(), atol=1e-14)
        np.testing.assert_allclose(logs[i], jitted(twists[i]), atol=1e-14)
