"""Range sensors with bias and scale."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.poses import SE2, local
from jaxloc.sensors import Increment, IncrementMotion, Range, RangeSensor, RangingMotion, RangingState

BEACONS = [[3.0, 4.0], [-2.0, 0.5]]


def reading(index, dtype=float):
    return Range(jnp.asarray(1.0, dtype), jnp.array(index))


def test_ranges_are_scaled_and_shifted(dtype):
    sensor = RangeSensor(jnp.asarray(BEACONS, dtype), 0.5)
    pose = SE2(*jnp.asarray([1.0, 1.0, 0.3], dtype))
    state = RangingState(pose, jnp.asarray(0.7, dtype), jnp.asarray(0.05, dtype))
    for index, (x, y) in enumerate(BEACONS):
        distance = np.hypot(x - 1.0, y - 1.0)
        np.testing.assert_allclose(sensor.expect(pose, reading(index)).range, distance, rtol=1e-6)
        read = sensor.expect(state, reading(index)).range
        assert read.dtype == dtype
        np.testing.assert_allclose(read, 1.05 * distance + 0.7, rtol=1e-6)


def test_jacobian_by_pose_bias_and_scale(x64):
    sensor = RangeSensor(jnp.array(BEACONS), 0.5)
    pose = SE2(1.0, 1.0, 0.3)
    _, jacobian = sensor.linearize(RangingState(pose, jnp.array(0.7), jnp.array(0.05)), reading(0))
    away = np.array([1.0 - 3.0, 1.0 - 4.0])
    by_position = 1.05 * away / np.linalg.norm(away) @ np.asarray(pose.rotation.matrix())
    np.testing.assert_allclose(jacobian[0], [*by_position, 0.0, 1.0, np.linalg.norm(away)], rtol=1e-9, atol=1e-12)


def test_bias_and_scale_wander_beside_the_pose(x64):
    inner = IncrementMotion()
    motion = RangingMotion(inner, 0.1, 0.01)
    state = RangingState(SE2(0.0, 0.0, 0.0), jnp.array(0.7), jnp.array(0.05))
    control = Increment(jnp.array(4.0), SE2(1.0, 0.0, 0.2))
    moved = motion.move(state, control)
    np.testing.assert_allclose(local(moved.pose, state.pose @ control.motion), 0.0, atol=1e-12)
    assert (float(moved.bias), float(moved.scale)) == pytest.approx((0.7, 0.05))
    covariance = motion.covariance(state, control)
    np.testing.assert_allclose(covariance[:3, :3], inner.covariance(state.pose, control))
    np.testing.assert_allclose(covariance[3:, 3:], np.diag([0.04, 4e-4]))
