import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm, logm
from scipy.spatial.transform import Rotation, Slerp

from jaxloc.poses import SE2, SE3, Trajectory, chain, interpolate


def matrices(count=5):
    rng = np.random.default_rng(3)
    result = np.tile(np.eye(4), (count, 1, 1))
    result[:, :3, :3] = Rotation.from_rotvec(rng.uniform(-1.0, 1.0, (count, 3))).as_matrix()
    result[:, :3, 3] = rng.uniform(-5.0, 5.0, (count, 3))
    return result


@pytest.fixture
def trajectory(dtype):
    return Trajectory.from_matrices(jnp.asarray([0.0, 0.5, 1.0, 2.0, 4.0], dtype), jnp.asarray(matrices(), dtype))


def test_parts(trajectory, dtype):
    expected = matrices()
    assert len(trajectory) == 5 and trajectory.matrices().dtype == dtype
    np.testing.assert_allclose(trajectory.matrices(), expected, atol=1e-6)
    np.testing.assert_allclose(trajectory.positions, expected[:, :3, 3], atol=1e-6)
    length = np.linalg.norm(np.diff(expected[:, :3, 3], axis=0), axis=1).sum()
    np.testing.assert_allclose(trajectory.length(), length, rtol=1e-6)
    np.testing.assert_allclose(trajectory[2].matrix(), expected[2], atol=1e-6)
    assert trajectory[1:3].batch_shape == (2,)
    relative = trajectory.relative()
    for k in range(4):
        motion = jax.tree.map(lambda x, k=k: x[k], relative).matrix()
        np.testing.assert_allclose(motion, np.linalg.inv(expected[k]) @ expected[k + 1], atol=1e-5)


def test_chain_of_the_relative_motions_returns(trajectory, dtype):
    again = chain(trajectory[0], trajectory.relative())
    tolerance = 1e-12 if dtype == np.float64 else 1e-4
    np.testing.assert_allclose(again.translation, trajectory.positions, atol=tolerance)


def test_at_follows_the_geodesic(x64):
    poses = matrices()
    path = Trajectory.from_matrices(jnp.array([0.0, 0.5, 1.0, 2.0, 4.0]), jnp.asarray(poses))
    at = jax.jit(lambda time: path.at(time).matrix())
    for time, k, fraction in ((0.25, 0, 0.5), (0.6, 1, 0.2), (3.5, 3, 0.75)):
        expected = poses[k] @ expm(fraction * np.real(logm(np.linalg.inv(poses[k]) @ poses[k + 1])))
        np.testing.assert_allclose(at(jnp.array(time)), expected, atol=1e-12)
        slerp = Slerp([0.0, 1.0], Rotation.from_matrix(poses[k : k + 2, :3, :3]))(fraction).as_matrix()
        np.testing.assert_allclose(at(jnp.array(time))[:3, :3], slerp, atol=1e-12)
    for time, k in ((0.0, 0), (0.5, 1), (4.0, 4), (-3.0, 0), (9.0, 4)):
        np.testing.assert_allclose(at(jnp.array(time)), poses[k], atol=1e-12)
    times = jnp.array([0.25, 0.6, 3.5])
    np.testing.assert_allclose(jax.vmap(at)(times)[1], at(times[1]), atol=1e-14)


def test_at_is_differentiable_and_finite(x64):
    path = Trajectory.from_matrices(jnp.array([0.0, 1.0, 1.0]), jnp.asarray(matrices(3)))
    velocity = jax.jit(jax.jacfwd(lambda time: path.at(time).translation))
    step = 1e-6
    difference = (path.at(jnp.array(0.4 + step)).translation - path.at(jnp.array(0.4 - step)).translation) / (2 * step)
    np.testing.assert_allclose(velocity(jnp.array(0.4)), difference, rtol=1e-7)
    assert np.all(np.isfinite(velocity(jnp.array(1.0))))  # two stamps are equal there


def test_plane(dtype):
    path = Trajectory(
        jnp.asarray([0.0, 1.0], dtype), jax.vmap(SE2)(*jnp.asarray([[0.0, 2.0], [0.0, 0.0], [0.0, 0.4]], dtype))
    )
    assert path.positions.shape == (2, 2) and float(path.length()) == 2.0
    assert path.at(jnp.asarray(0.5, dtype)).theta.dtype == dtype
    np.testing.assert_allclose(path.at(jnp.asarray(0.5, dtype)).theta, 0.2, rtol=1e-6)
    half = interpolate(path[0], path[1], jnp.asarray(0.5, dtype))
    np.testing.assert_allclose(half.matrix(), path.at(jnp.asarray(0.5, dtype)).matrix(), atol=1e-6)


def test_mismatched_stacks_are_refused():
    stack = jax.vmap(SE3.exp)(jnp.zeros((3, 6)))
    with pytest.raises(ValueError, match="4 times came with poses of stack shape"):
        Trajectory(jnp.arange(4.0), stack)
