import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from jaxloc.beliefs import Motion
from jaxloc.filters import BodyTwist, ConstantAcceleration, ConstantVelocity, CoordinatedTurn, LinearMotion, TwistMotion
from jaxloc.poses import SE2, SE3


def discretize(order, axes, intensity, dt):
    """Transition and noise of a chain of integrators by Van Loan's matrix exponential."""
    size = order * axes
    drift, push = np.zeros((size, size)), np.zeros((size, size))
    drift[:-axes, axes:] = np.eye(size - axes)
    push[-axes:, -axes:] = np.diag(np.broadcast_to(intensity, axes))
    block = scipy.linalg.expm(dt * np.block([[-drift, push], [np.zeros((size, size)), drift.T]]))
    transition = block[size:, size:].T
    return transition, transition @ block[:size, size:]


# T-6
@pytest.mark.parametrize(
    ("motion", "order", "intensity"),
    [
        (lambda: ConstantVelocity(0.3, axes=3), 2, 0.3),
        (lambda: ConstantVelocity(jnp.array([0.3, 2.0])), 2, [0.3, 2.0]),
        (lambda: ConstantAcceleration(0.7), 3, 0.7),
    ],
)
def test_integrators_equal_van_loan(x64, rng, motion, order, intensity):
    motion, dt = motion(), 0.37
    transition, noise = discretize(order, motion.axes, intensity, dt)
    state = jnp.asarray(rng.normal(size=len(transition)))
    moved, jacobian = motion.linearize(state, jnp.array(dt))
    assert np.allclose(moved, transition @ state) and np.allclose(jacobian, transition)
    assert np.allclose(motion.covariance(state, jnp.array(dt)), noise)


def test_padding_is_held_at_zero():
    motion = ConstantVelocity(1.0, axes=2, padding=2)
    state, dt = jnp.arange(6.0), jnp.array(0.5)
    assert motion.move(state, dt).tolist() == [1.0, 2.5, 2.0, 3.0, 0.0, 0.0]
    assert not np.asarray(motion.covariance(state, dt))[4:].any()
    with pytest.raises(ValueError, match="moves states of 6 entries; it got 4"):
        motion.move(jnp.zeros(4), dt)


def test_linear_motion():
    motion = LinearMotion(2.0 * jnp.eye(2), jnp.eye(2), jnp.array([[1.0], [0.0]]))
    assert motion.move(jnp.ones(2), jnp.array([3.0])).tolist() == [5.0, 2.0]


def test_turn_is_a_circle_and_straight_at_rate_zero(x64):
    motion, state, dt = CoordinatedTurn(0.1, 0.2), np.array([1.0, 2.0, 3.0, 1.0]), 0.8

    def exact(rate):
        drift = np.zeros((4, 4))
        drift[:2, 2:] = np.eye(2)
        drift[2:, 2:] = [[0.0, -rate], [rate, 0.0]]
        return scipy.linalg.expm(dt * drift) @ state

    @jax.jit
    def everything(full):
        return *motion.linearize(full, jnp.array(dt)), jax.jacfwd(jax.jacrev(motion.move))(full, jnp.array(dt))

    for rate in (0.0, 1e-9, 1e-3, 1.0, -2.0):
        moved, jacobian, curvature = everything(jnp.asarray(np.append(state, rate)))
        assert np.allclose(moved[:4], exact(rate), atol=1e-12)
        assert np.allclose(jacobian[:4, 4], (exact(rate + 1e-5) - exact(rate - 1e-5)) / 2e-5, atol=1e-8)
        assert np.isfinite(curvature).all()
    noise = motion.covariance(jnp.zeros(5), jnp.array(dt))
    assert np.allclose(np.diag(noise)[2:], [0.08, 0.08, 0.16])


def hat(twist):
    """The matrix whose exponential a twist stands for."""
    if len(twist) == 3:
        v_x, v_y, w = twist
        return np.array([[0, -w, v_x], [w, 0, v_y], [0, 0, 0]])
    x, y, z, a, b, c = twist
    return np.array([[0, -c, b, x], [c, 0, -a, y], [-b, a, 0, z], [0, 0, 0, 0]])


@pytest.mark.parametrize("kind", [SE2, SE3])
def test_twist_motion(x64, rng, kind):
    size = kind.dof
    motion, pose = TwistMotion(jnp.eye(size)), kind.exp(jnp.asarray(rng.normal(size=size)))
    control = BodyTwist(jnp.asarray(rng.normal(size=size)), jnp.array(0.3))
    moved, jacobian = motion.linearize(pose, control)
    exact = scipy.linalg.expm(0.3 * hat(np.asarray(control.twist)))
    assert np.allclose(moved.matrix(), np.asarray(pose.matrix()) @ exact)
    # The closed form against automatic differentiation through the tangent spaces.
    general = jax.jit(lambda pose: Motion.linearize(motion, pose, control)[1])
    assert np.allclose(jacobian, general(pose), atol=1e-12)
    with pytest.raises(ValueError, match="takes a twist"):
        motion.linearize(pose, BodyTwist(jnp.zeros(2), jnp.array(1.0)))
