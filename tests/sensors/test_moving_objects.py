"""The measurement of a moving object: its covariance against that of simulated measurements."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxloc.poses import SE3
from jaxloc.sensors import MovingObject, MovingObjectSensor, Pinhole, StereoRig


def make_rig():
    return StereoRig(Pinhole(700.0, 700.0, 600.0, 180.0), 0.54)


def make(pose_covariance, **options):
    pose = SE3.from_euler(jnp.array([3.0, 0.0, 5.0]), 0.1, 0.3, -0.2)
    return MovingObjectSensor(make_rig(), pose, pose_covariance, 0.1, **options)


# T-72, T-79
def test_position_covariance_is_that_of_triangulated_points(x64, rng):
    covariance = np.diag([0.05, 0.02, 0.05, 0.002, 0.003, 0.001]) ** 2
    sensor = make(jnp.asarray(covariance), sigma=0.4, points=4.0, extent=0.5, slack=1.0)
    place = jnp.array([2.0, 0.5, 20.0])
    state = jnp.concatenate([sensor.pose.apply(place[None])[0], jnp.zeros(3)])
    seen = np.asarray(sensor.rig.project(place[None]))
    count = 20_000
    noisy = seen + rng.normal(0, 0.4 / 2.0, size=(count, 3))
    slips = jnp.asarray(rng.multivariate_normal(np.zeros(6), covariance, size=count))
    poses = jax.vmap(lambda slip: sensor.pose.retract(slip))(slips)
    points = jax.vmap(lambda pose, p: pose.apply(p[None])[0])(poses, sensor.rig.triangulate(jnp.asarray(noisy)))
    points = np.asarray(points) + rng.normal(0, 0.5, size=(count, 3))
    expected = np.cov(points.T)
    found = np.asarray(sensor.covariance(state, None))[:3, :3]
    np.testing.assert_allclose(found, expected, atol=0.05 * expected.max())


def test_velocity_shares_the_error_of_this_frame(x64):
    sensor = make(jnp.zeros((6, 6)), extent=0.0, slack=0.0)
    state = jnp.concatenate([sensor.pose.apply(jnp.array([[2.0, 0.5, 20.0]]))[0], jnp.array([1.0, 0.0, 2.0])])
    full = np.asarray(sensor.covariance(state, None))
    np.testing.assert_allclose(full[:3, 3:], full[:3, :3] / 0.1)
    np.testing.assert_allclose(full[3:, 3:], 4.0 * full[:3, :3] / 0.01)
    assert np.all(np.linalg.eigvalsh(full) > -1e-9 * full.max())


def test_expects_the_state_and_stays_finite_behind_the_camera(dtype):
    sensor = make(jnp.zeros((6, 6), dtype))
    state = jnp.asarray([3.0, 0.0, -20.0, 1.0, 2.0, 3.0], dtype)
    expected, jacobian = sensor.linearize(state, None)
    assert isinstance(expected, MovingObject)
    np.testing.assert_array_equal(jnp.concatenate([expected.position, expected.velocity]), state)
    np.testing.assert_array_equal(jacobian, np.eye(6))
    assert bool(jnp.isfinite(sensor.covariance(state, None)).all())
