import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxloc as jl
from jaxloc.poses import Direction, local, retract, tangent_dimension, tangent_labels


def directions(rng, count, dtype=np.float64):
    vectors = rng.normal(size=(count, 3))
    vectors = np.concatenate([vectors / np.linalg.norm(vectors, axis=1, keepdims=True), np.eye(3), -np.eye(3)])
    return jax.vmap(Direction)(jnp.asarray(vectors, dtype))


def test_basis_is_orthonormal_and_right_handed(x64, rng):
    stack = directions(rng, 50)
    frames = np.concatenate([jax.vmap(Direction.basis)(stack), np.asarray(stack.vector)[..., None]], axis=-1)
    np.testing.assert_allclose(np.swapaxes(frames, 1, 2) @ frames, np.broadcast_to(np.eye(3), frames.shape), atol=1e-15)
    np.testing.assert_allclose(np.linalg.det(frames), 1.0)


def test_retract_is_a_rotation_about_the_normal_of_the_tangent(x64, rng):
    stack = directions(rng, 50)
    deltas = rng.uniform(-2.0, 2.0, (len(stack.vector), 2))
    moved = jax.vmap(Direction.retract)(stack, jnp.asarray(deltas))
    tangents = np.einsum("nij,nj->ni", jax.vmap(Direction.basis)(stack), deltas)
    expected = Rotation.from_rotvec(np.cross(stack.vector, tangents)).apply(np.array(stack.vector))
    np.testing.assert_allclose(moved.vector, expected, atol=1e-14)


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-4, 0.09, 0.11, 1.0, 3.0])
def test_local_undoes_retract(dtype, rng, size):
    stack = directions(rng, 20, dtype)
    turns = rng.normal(size=(len(stack.vector), 2))
    deltas = jnp.asarray(size * turns / np.linalg.norm(turns, axis=1, keepdims=True), dtype)
    back = jax.jit(jax.vmap(lambda a, d: a.local(a.retract(d))))(stack, deltas)
    assert back.dtype == dtype
    np.testing.assert_allclose(back, deltas, rtol=0, atol=1e-14 if dtype == np.float64 else 3e-6)


def test_moves_within_pytrees(x64, rng):
    value = {"direction": directions(rng, 2), "scale": jnp.array(1.0)}
    assert tangent_dimension(value) == 17
    assert tangent_labels(value)[:2] == ("direction[0].first tangent", "direction[0].second tangent")
    delta = jnp.asarray(rng.uniform(-0.5, 0.5, 17))
    np.testing.assert_allclose(local(value, retract(value, delta)), delta, atol=1e-14)
    assert not jl.poses.is_flat(value)


def test_derivatives(x64, rng):
    base = directions(rng, 1)
    base = jax.tree.map(lambda leaf: leaf[0], base)
    for delta in (jnp.zeros(2), jnp.array([0.3, -0.2]), jnp.array([0.05, 0.0])):
        trip = lambda d: base.local(base.retract(d))  # noqa: E731
        np.testing.assert_allclose(jax.jacrev(trip)(delta), np.eye(2), atol=1e-12)
        moved = lambda d: base.retract(d).vector  # noqa: E731
        steps = 1e-6 * np.eye(2)
        slopes = [(moved(delta + step) - moved(delta - step)) / 2e-6 for step in steps]
        np.testing.assert_allclose(jax.jacfwd(moved)(delta), np.stack(slopes, axis=1), atol=1e-9)


def test_lengths_stay_one_over_many_moves():
    def turn(direction, delta):
        return direction.retract(delta), None

    deltas = 0.3 * jax.random.normal(jax.random.key(0), (10_000, 2))
    end, _ = jax.lax.scan(turn, Direction.from_vector(jnp.array([1.0, 2.0, 3.0])), deltas)
    np.testing.assert_allclose(np.linalg.norm(end.vector), 1.0, atol=2e-7)


DEGENERATE = [[0.0, 0.0, 0.0], [np.nan, 1.0, 0.0], [np.inf, 0.0, 0.0], [1e-30, 0.0, 0.0], [1e30] * 3]


@pytest.mark.parametrize("vector", DEGENERATE)
def test_degenerate_and_extreme_vectors(vector):
    value, slope = jax.value_and_grad(lambda v: Direction.from_vector(v).vector[0])(jnp.array(vector, jnp.float32))
    assert np.isfinite(value) and np.all(np.isfinite(slope))


def test_the_opposite_is_half_a_turn_away():
    ahead, behind = (Direction(jnp.array([0.0, 0.0, z])) for z in (1.0, -1.0))
    np.testing.assert_allclose(jnp.linalg.norm(ahead.local(behind)), np.pi, rtol=1e-6)
    slope = jax.jacfwd(lambda v: ahead.local(Direction(v)))(behind.vector)
    assert np.all(np.isfinite(slope))


def test_a_solver_fits_a_direction(x64, rng):
    """The mean of unit vectors, which has a closed form."""
    vectors = rng.normal(size=(30, 3)) * 0.2 + np.array([0.2, -0.5, 0.8])
    vectors = jnp.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
    fit = jl.solvers.solve(
        jl.solvers.FunctionProblem(_misses, vectors), Direction.from_vector(jnp.array([0.0, 0.0, 1.0]))
    )
    mean = np.sum(vectors, axis=0)
    np.testing.assert_allclose(fit.value.vector, mean / np.linalg.norm(mean), atol=1e-7)
    assert fit.covariance.shape == (2, 2)


def _misses(direction, vectors):
    return (direction.vector[None, :] - vectors).T
