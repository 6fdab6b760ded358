"""Odometry as motion: samples against covariance and density, slips, wheels on arcs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate

from jaxloc.poses import SE2, local, retract
from jaxloc.sensors import DifferentialDrive, OdometryMotion
from jaxloc.sensors.odometer import falls_below, split_motion


def draw(motion, pose, control, count=20_000):
    normal = jax.random.normal(jax.random.key(0), (count, motion.noise_dimension(pose)), pose.translation.dtype)
    moved = motion.move(pose, control)
    return np.asarray(jax.jit(jax.vmap(lambda n: local(moved, motion.perturb(pose, control, n))))(normal), np.float64)


@pytest.mark.parametrize("control", [(1.0, 0.2, 0.5), (-0.8, 0.1, -0.2), (0.001, 0.0, 0.7), (0.0, 0.0, 0.0)])
def test_motions_split_and_join(control, dtype):
    first, way, second = (float(part) for part in split_motion(SE2(*(jnp.asarray(c, dtype) for c in control))))
    assert abs(first) <= np.pi / 2 + 1e-6 and (way < 0) == (control[0] < 0)
    joined = (way * np.cos(first), way * np.sin(first), first + second)
    np.testing.assert_allclose(joined, control, atol=1e-5 if abs(control[0]) > 0.01 else 2e-3)


@pytest.mark.parametrize("control", [(1.0, 0.1, 0.3), (-0.7, 0.1, 0.1)])
def test_samples_have_the_covariance(control):
    motion = OdometryMotion(turn_turn=0.05, turn_drive=0.02, drive_drive=0.03, drive_turn=0.02)
    pose, control = SE2(3.0, -1.0, 2.0), SE2(*control)
    noise = draw(motion, pose, control)
    expected = np.asarray(motion.covariance(pose, control))
    np.testing.assert_allclose(np.cov(noise.T), expected, atol=0.05 * expected.diagonal().max())
    np.testing.assert_allclose(noise.mean(axis=0), 0.0, atol=3e-3)


def test_slips_have_the_covariance_and_the_odds(x64):
    motion = OdometryMotion(slip=0.2, slip_scale=2.0, dtype=jnp.float64)
    pose, control = SE2(0.0, jnp.asarray(0.0), 0.0), SE2(jnp.asarray(0.5), 0.0, 0.1)
    noise = draw(motion, pose, control)
    assert np.mean(np.abs(noise[:, 0]) > 0.3) == pytest.approx(0.2 * 0.76, abs=0.01)
    expected = np.asarray(motion.covariance(pose, control))
    assert np.cov(noise.T)[0, 0] == pytest.approx(expected[0, 0], rel=0.05)
    normals = jax.random.normal(jax.random.key(2), (50_000,))
    assert float(falls_below(normals, jnp.asarray(0.1)).mean()) == pytest.approx(0.1, abs=0.004)
    assert not falls_below(normals, jnp.asarray(0.0)).any() and falls_below(normals, jnp.asarray(1.0)).all()


def test_the_density_sums_to_one_and_has_the_tails(x64):
    motion = OdometryMotion(slip=0.1, slip_scale=1.0, dtype=jnp.float64)
    pose, control = SE2(0.0, jnp.asarray(0.0), 0.0), SE2(jnp.asarray(0.5), 0.0, 0.0)
    density = jax.jit(
        jax.vmap(lambda d: jnp.exp(motion.log_prob(pose, control, retract(motion.move(pose, control), d))))
    )
    x, y, turn = np.linspace(-2.5, 2.5, 401), np.linspace(-0.3, 0.3, 31), np.linspace(-0.5, 0.5, 41)
    points = np.stack(np.meshgrid(x, y, turn, indexing="ij"), -1)
    values = np.asarray(density(jnp.asarray(points.reshape(-1, 3)))).reshape(points.shape[:3])
    total = integrate.simpson(integrate.simpson(integrate.simpson(values, x=turn), x=y), x=x)
    assert total == pytest.approx(1.0, abs=0.02)
    along = integrate.simpson(integrate.simpson(values, x=turn), x=y)
    assert integrate.simpson(along[x < -0.5], x=x[x < -0.5]) == pytest.approx(0.1 * 0.16, rel=0.05)


def test_rest_is_harmless():
    motion = OdometryMotion(slip=0.1)
    pose, still = SE2(1.0, 2.0, 0.5), SE2(0.0, 0.0, 0.0)

    def through(values):
        control = SE2(values[0], values[1], values[2])
        moved = motion.perturb(pose, control, jnp.array([0.3, -1.0, 0.2, 0.0]))
        return jnp.sum(local(pose, moved)) + motion.log_prob(pose, control, moved)

    value, slope = jax.jit(jax.value_and_grad(through))(jnp.zeros(3))
    assert np.isfinite(value) and np.isfinite(slope).all()
    np.testing.assert_allclose(local(pose, motion.move(pose, still)), 0.0, atol=1e-6)
    exact = motion.perturb(pose, SE2(0.004, 0.003, 0.1), jnp.array([0.0, 0.0, 0.0, 5.0]))
    np.testing.assert_allclose(local(pose @ SE2(0.004, 0.003, 0.1), exact), 0.0, atol=1e-6)


def test_wheels_drive_arcs(dtype):
    drive = DifferentialDrive(jnp.asarray(0.4, dtype), dtype=dtype)
    pose = SE2(jnp.asarray(0.0, dtype), 0.0, 0.0)
    # A quarter of a circle of radius 1 m about (0, 1).
    control = jnp.asarray([(1.0 - 0.2) * np.pi / 2, (1.0 + 0.2) * np.pi / 2], dtype)
    moved = drive.move(pose, control)
    assert moved.translation.dtype == dtype
    np.testing.assert_allclose([moved.x, moved.y, moved.theta], [1.0, 1.0, np.pi / 2], atol=1e-5)
    straight = drive.move(pose, jnp.asarray([2.0, 2.0], dtype))
    np.testing.assert_allclose(straight.translation, [2.0, 0.0], atol=1e-6)


def test_wheel_noise_has_the_covariance():
    drive = DifferentialDrive(0.4)
    pose, control = SE2(1.0, 1.0, 1.0), jnp.array([0.9, 1.1])
    expected = np.asarray(drive.covariance(pose, control))
    np.testing.assert_allclose(np.cov(draw(drive, pose, control).T), expected, atol=0.05 * expected.max())
