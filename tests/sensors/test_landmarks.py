"""Landmark sensors against closed forms, with gradients and the singular point at the landmark itself."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import linear_sum_assignment

from jaxloc.poses import SE2, SO2, retract
from jaxloc.sensors import RangeBearing, RangeBearingSensor
from jaxloc.sensors.landmarks import confusion, locate, locate_covariance, observe, polar_jacobian, sanitize

POSE = (1.0, -2.0, 0.7)


def reading_of(dtype, landmark=1, distance=2.0, bearing=0.3):
    return RangeBearing(jnp.asarray(distance, dtype), SO2.from_angle(jnp.asarray(bearing, dtype)), jnp.array(landmark))


def test_range_and_bearing_are_those_of_polar_coordinates(dtype, rng):
    landmarks = rng.normal(size=(4, 2)) * 5.0
    sensor = RangeBearingSensor(jnp.asarray(landmarks, dtype), 0.1, 0.02)
    pose = SE2(*(jnp.asarray(v, dtype) for v in POSE))
    for i, (x, y) in enumerate(landmarks):
        read = sensor.expect(pose, reading_of(dtype, i))
        bearing = np.arctan2(y - POSE[1], x - POSE[0]) - POSE[2]
        assert read.range.dtype == dtype
        np.testing.assert_allclose(read.range, np.hypot(x - POSE[0], y - POSE[1]), rtol=1e-5)
        np.testing.assert_allclose([read.bearing.cos, read.bearing.sin], [np.cos(bearing), np.sin(bearing)], atol=1e-5)
    np.testing.assert_allclose(sensor.covariance(pose, reading_of(dtype)), np.diag([0.01, 0.0004]), rtol=1e-5)


def test_a_mounted_sensor_reads_as_a_robot_that_stands_there(x64):
    landmarks, mount = jnp.array([[3.0, 1.0]]), SE2(0.2, 0.1, 0.5)
    mounted = RangeBearingSensor(landmarks, 0.1, 0.1, mount)
    plain = RangeBearingSensor(landmarks, 0.1, 0.1)
    reading, pose = reading_of(float, 0), SE2(*POSE)
    a, b = mounted.expect(pose, reading), plain.expect(pose @ mount, reading)
    np.testing.assert_allclose([a.range, a.bearing.angle()], [b.range, b.bearing.angle()], rtol=1e-12)


def test_jacobian_equals_differences(x64):
    sensor = RangeBearingSensor(jnp.array([[3.0, 1.0], [-1.0, 4.0]]), 0.1, 0.1, SE2(0.2, 0.1, 0.5))
    pose, reading, step = SE2(*POSE), reading_of(float, 1), 1e-6
    _, jacobian = sensor.linearize(pose, reading)

    def numbers(delta):
        read = sensor.expect(retract(pose, delta), reading)
        return np.array([read.range, read.bearing.angle()])

    for i in range(3):
        delta = jnp.zeros(3).at[i].set(step)
        np.testing.assert_allclose(jacobian[:, i], (numbers(delta) - numbers(-delta)) / (2 * step), atol=1e-8)


def test_locate_inverts_observe_with_its_covariance(x64, rng):
    pose, point = SE2(*POSE), jnp.array([4.0, 3.0])
    reading = observe(pose, point, jnp.array(0))
    np.testing.assert_allclose(locate(pose, reading), point, rtol=1e-12)
    deviations = jnp.array([0.02, 0.01])
    noise = jnp.asarray(rng.normal(size=(20_000, 2))) * deviations[None]
    points = jax.vmap(lambda n: locate(pose, retract(reading, n)))(noise)
    covariance = locate_covariance(pose, reading, deviations)
    np.testing.assert_allclose(np.cov(points.T), covariance, atol=0.05 * float(covariance.max()))
    # Its inverse, by the derivative of the polar coordinates in the sensor's frame.
    jacobian = polar_jacobian(reading) @ pose.rotation.matrix().T
    np.testing.assert_allclose(jacobian @ covariance @ jacobian.T, np.diag(deviations**2), atol=1e-12)


def test_at_the_landmark_all_is_finite(dtype):
    def total(x):
        read = observe(SE2(x, jnp.zeros((), dtype), jnp.zeros((), dtype)), jnp.zeros(2, dtype), jnp.array(0))
        return read.range + read.bearing.cos + read.bearing.sin

    value, slope = jax.value_and_grad(total)(jnp.zeros((), dtype))
    assert np.isfinite(value) and np.isfinite(slope)


def test_nonfinite_readings_are_masked():
    for distance, bearing in ((jnp.nan, 0.0), (jnp.inf, 0.0), (1.0, jnp.nan), (-1.0, 0.0)):
        safe, usable = sanitize(reading_of(jnp.float32, 2, distance, bearing), jnp.array(True))
        assert not usable and int(safe.landmark) == 2
        assert np.isfinite([safe.range, safe.bearing.cos, safe.bearing.sin]).all()
    assert bool(sanitize(reading_of(jnp.float32), jnp.array(True))[1])
    assert not bool(sanitize(reading_of(jnp.float32), jnp.array(False))[1])


def test_mixed_up_numbers_are_found(x64, rng):
    landmarks = jnp.asarray(rng.uniform(-5, 5, size=(5, 2)))
    sensor = RangeBearingSensor(landmarks, 0.1, 0.03)
    poses = jax.vmap(lambda p: SE2(p[0], p[1], p[2]))(jnp.asarray(rng.normal(size=(60, 3))))
    order, named = np.array([0, 3, 2, 1, 4]), jnp.asarray(rng.integers(0, 4, 60))  # number 4 is never read
    readings = jax.vmap(lambda p, i: observe(p, landmarks[i], i))(poses, named)
    mixed = jax.vmap(RangeBearing)(readings.range, readings.bearing, jnp.asarray(order)[named])
    costs = np.asarray(confusion(sensor, poses, mixed, jnp.ones(60, bool)))
    assert np.array_equal(linear_sum_assignment(costs)[1], np.argsort(order))
    assert (costs[4] == 20.0).all()
