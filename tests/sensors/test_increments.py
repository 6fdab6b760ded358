"""Dead reckoning by increments: noise adds up the same way however the path is cut."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxloc.poses import SE2, local, retract
from jaxloc.sensors import Increment, IncrementMotion


def step(dt, twist):
    return Increment(jnp.asarray(dt, float), SE2.exp(jnp.asarray(twist, float)))


def test_variances_are_those_of_the_formula(x64):
    motion = IncrementMotion(drive=0.1, side=0.2, idle=0.3, turn_drive=0.4, turn_turn=0.5, turn_idle=0.6)
    covariance = motion.covariance(SE2.identity(float), Increment(jnp.array(2.0), SE2(3.0, 4.0, -0.7)))
    expected = [0.01 * 5 + 0.09 * 2, 0.04 * 5 + 0.09 * 2, 0.16 * 5 + 0.25 * 0.7 + 0.36 * 2]
    np.testing.assert_allclose(covariance, np.diag(expected), rtol=1e-12)


def test_two_half_steps_err_as_one(x64):
    motion = IncrementMotion(turn_drive=0.0, turn_turn=0.0, turn_idle=0.0, side=0.05, drive=0.05)
    whole, half = step(2.0, [1.0, 0.0, 0.0]), step(1.0, [0.5, 0.0, 0.0])
    pose = SE2(0.3, 0.2, 0.4)
    middle, jacobian = motion.linearize(motion.move(pose, half), half)
    twice = jacobian @ motion.covariance(pose, half) @ jacobian.T + motion.covariance(middle, half)
    np.testing.assert_allclose(twice, motion.covariance(pose, whole), rtol=1e-12)


def test_jacobian_equals_differences(x64):
    motion, control, pose = IncrementMotion(), step(1.0, [1.0, 0.2, 0.5]), SE2(0.3, 0.2, 0.4)
    moved, jacobian = motion.linearize(pose, control)
    for i in range(3):
        delta = jnp.zeros(3).at[i].set(1e-6)
        ends = [local(moved, motion.move(retract(pose, sign * delta), control)) for sign in (1.0, -1.0)]
        np.testing.assert_allclose(jacobian[:, i], (ends[0] - ends[1]) / 2e-6, atol=1e-8)


def test_standing_still_has_finite_gradients(dtype):
    def total(x):
        control = Increment(jnp.ones((), dtype), SE2(x, 0.0 * x, 0.0 * x))
        return jnp.sum(IncrementMotion().covariance(SE2.identity(dtype), control))

    assert np.isfinite(jax.grad(total)(jnp.zeros((), dtype)))
