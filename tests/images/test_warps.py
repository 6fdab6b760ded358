"""Warps as groups [K-17, K-23, K-72]: SciPy's matrix functions and OpenCV's maps are the oracles."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from jaxloc.images.warps import Affine, Euclidean, Homography, Similarity, Translation, tangent_matrix
from jaxloc.poses import local, retract, tangent_labels
from jaxloc.poses.matrix_exponential import exponential_less_identity, logarithm

GROUPS = [Translation, Euclidean, Similarity, Affine, Homography]
SIZES = np.array([5.0, 5.0, 0.5, 0.3, 0.3, 0.3, 1e-3, 1e-3])


def tangent(rng, group, dtype=np.float64, scale=1.0):
    return jnp.asarray((scale * rng.normal(size=8) * SIZES)[: group.dof], dtype)


@pytest.mark.parametrize("group", GROUPS)
def test_exponential_equals_scipy(group, rng, dtype):
    delta = tangent(rng, group, dtype)
    expected = scipy.linalg.expm(np.asarray(tangent_matrix(delta), np.float64))
    matrix = np.asarray(group.exp(delta).matrix(), np.float64)
    assert group.exp(delta).matrix().dtype == dtype
    np.testing.assert_allclose(
        matrix / matrix[2, 2], expected / expected[2, 2], atol=3e-6 if dtype == np.float32 else 1e-12
    )


@pytest.mark.parametrize("group", GROUPS)
def test_logarithm_undoes_the_exponential(group, rng, dtype):
    delta = tangent(rng, group, dtype)
    np.testing.assert_allclose(group.exp(delta).log(), delta, atol=2e-5 if dtype == np.float32 else 1e-11)


@pytest.mark.parametrize("group", GROUPS)
def test_group_laws(group, rng, x64):
    a, b = (group.exp(tangent(rng, group)) for _ in range(2))
    points = jnp.asarray(rng.uniform(0, 50, (9, 2)))
    np.testing.assert_allclose((a @ b).apply(points), a.apply(b.apply(points)), atol=1e-9)
    np.testing.assert_allclose(a.inverse().apply(a.apply(points)), points, atol=1e-9)
    small = tangent(rng, group, scale=1e-2)
    np.testing.assert_allclose(
        (a @ group.exp(small)).apply(points), (group.exp(a.adjoint() @ small) @ a).apply(points), atol=1e-9
    )
    moved = retract({"warp": a}, small)
    np.testing.assert_allclose(local({"warp": a}, moved), small, atol=1e-10)
    assert len(tangent_labels(a)) == group.dof


@pytest.mark.slow
@pytest.mark.parametrize("group", GROUPS)
def test_jacobians_equal_autodiff(group, rng, x64):
    warp = group.exp(tangent(rng, group))
    points = jnp.asarray(rng.uniform(-30, 30, (7, 2)))
    zero = jnp.zeros(group.dof)
    at_identity = jax.jacfwd(lambda d: group.exp(d).apply(points))(zero)
    np.testing.assert_allclose(
        np.stack(group.jacobian_components(*points.T)), at_identity.transpose(1, 2, 0), atol=1e-9
    )
    additive = jax.jacfwd(lambda d: warp.add(d).apply(points))(zero)
    np.testing.assert_allclose(
        np.stack(warp.additive_jacobian_components(*points.T)), additive.transpose(1, 2, 0), atol=1e-8
    )


def test_homography_equals_opencv_and_hides_the_horizon(rng, x64):
    corners = np.array([[0, 0], [99, 0], [99, 79], [0, 79]], np.float32)
    seen = corners + rng.normal(size=(4, 2)).astype(np.float32) * 10
    matrix = cv2.getPerspectiveTransform(corners, seen)
    warp = Homography.from_matrix(jnp.asarray(-2.0 * matrix))
    np.testing.assert_allclose(warp.apply(jnp.asarray(corners, float)), seen, atol=1e-4)
    assert abs(np.linalg.det(warp.matrix()) - 1) < 1e-12
    steep = Homography.from_matrix(jnp.array([[1.0, 0, 0], [0, 1, 0], [0.1, 0, 1]]))
    behind = jnp.array([[-10.0, 0.0], [-20.0, 0.0]])
    assert np.all(np.asarray(steep.apply(behind)) < -1e5)
    assert np.all(np.isfinite(jax.jacrev(steep.apply)(behind)))


@pytest.mark.parametrize("smaller, larger", [(Translation, Affine), (Euclidean, Similarity), (Affine, Homography)])
def test_smaller_groups_are_members_of_larger_ones(smaller, larger, rng, x64):
    delta = tangent(rng, smaller)
    points = jnp.asarray(rng.uniform(0, 50, (5, 2)))
    padded = jnp.zeros(larger.dof).at[: smaller.dof].set(delta)
    np.testing.assert_allclose(larger.exp(padded).apply(points), smaller.exp(delta).apply(points), atol=1e-10)
    np.testing.assert_allclose(
        larger.of(smaller.exp(delta)).apply(points), smaller.exp(delta).apply(points), atol=1e-10
    )
    assert isinstance(smaller.exp(delta) @ larger.identity(), larger)


def test_stacks_are_batched(rng):
    deltas = jnp.asarray(rng.normal(size=(3, 8)) * SIZES * 0.1, jnp.float32)
    stack = jax.vmap(Homography.exp)(deltas)
    assert stack.batch_shape == (3,)
    np.testing.assert_allclose(stack.homogeneous[1], Homography.exp(deltas[1]).matrix(), atol=1e-6)
    assert retract(stack, jnp.zeros(24)).batch_shape == (3,)


def test_no_numbers_break_a_warp():
    flat = Homography.from_matrix(jnp.zeros((3, 3)))
    for values in (flat.matrix(), flat.inverse().matrix(), flat.apply(jnp.ones((1, 2)))):
        assert np.all(np.isfinite(values))
    assert np.all(np.isfinite(jax.grad(lambda m: Euclidean.from_matrix(m).matrix().sum())(jnp.zeros((3, 3)))))


def test_matrix_functions_equal_scipy(rng, x64):
    matrix = 0.7 * rng.normal(size=(3, 3))
    exponential = scipy.linalg.expm(matrix)
    np.testing.assert_allclose(exponential_less_identity(jnp.asarray(matrix)), exponential - np.eye(3), atol=1e-12)
    np.testing.assert_allclose(logarithm(jnp.asarray(exponential)), scipy.linalg.logm(exponential), atol=1e-11)
    slope = jax.jvp(exponential_less_identity, (jnp.asarray(matrix),), (jnp.eye(3),))[1]
    np.testing.assert_allclose(slope, exponential, atol=1e-11)
