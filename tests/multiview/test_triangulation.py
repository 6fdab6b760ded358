import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares

import jaxloc as jl
from jaxloc.multiview.triangulation import correct_pair, midpoint, triangulate
from jaxloc.poses import SE3

CAMERA = (500.0, 500.0, 320.0, 240.0)
SIGMA = 0.5


def cameras(rng, count):
    """A camera that moves sideways and turns a little."""
    steps = np.column_stack(
        [np.linspace(0.0, 2.0, count), rng.uniform(-0.3, 0.3, (count, 2)), 0.05 * rng.normal(size=(count, 3))]
    )
    return jax.vmap(SE3.exp)(jnp.asarray(steps))


def project(poses, point):
    R, t = np.asarray(poses.rotation.rotation_matrix), np.asarray(poses.translation)
    local = np.einsum("nji,nj->ni", R, point - t)
    fx, fy, cx, cy = CAMERA
    return np.stack([fx * local[:, 0] / local[:, 2] + cx, fy * local[:, 1] / local[:, 2] + cy], axis=1)


@pytest.fixture
def scene(x64, rng):
    poses, point = cameras(rng, 5), np.array([0.8, -0.5, 6.0])
    return poses, point, project(poses, point)


def test_exact_pixels_meet_in_the_point(scene):
    poses, point, pixels = scene
    found = triangulate(jl.sensors.Pinhole(*CAMERA), poses, jnp.asarray(pixels))
    assert bool(found.ok)
    np.testing.assert_allclose(found.value, point, atol=1e-8)


def test_equals_scipys_minimum_and_its_covariance(scene, rng):
    poses, point, pixels = scene
    pixels = pixels + SIGMA * rng.normal(size=pixels.shape)
    found = triangulate(jl.sensors.Pinhole(*CAMERA), poses, jnp.asarray(pixels), sigma=SIGMA)
    theirs = least_squares(lambda x: ((project(poses, x) - pixels) / SIGMA).ravel(), point, xtol=1e-14)
    np.testing.assert_allclose(found.value, theirs.x, atol=1e-5)
    np.testing.assert_allclose(found.covariance, np.linalg.inv(theirs.jac.T @ theirs.jac), rtol=1e-4)


def test_consistency(scene, rng):
    poses, point, pixels = scene
    noisy = jnp.asarray(pixels + SIGMA * rng.normal(size=(400, *pixels.shape)))
    found = jax.jit(jax.vmap(lambda p: triangulate(jl.sensors.Pinhole(*CAMERA), poses, p, sigma=SIGMA)))(noisy)
    nees = jax.vmap(lambda f: f.gaussian().mahalanobis_squared(jnp.asarray(point)))(found)
    # Mean 3, standard deviation sqrt(6 / 400) = 0.12.
    assert bool(found.ok.all()) and 2.6 < nees.mean() < 3.4


def test_midpoint_is_nearest_to_all_rays(scene, rng):
    poses, _, _ = scene
    rays = rng.normal(size=(5, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    centers = np.asarray(poses.translation)

    def distances(x):
        return np.cross(rays, x - centers).ravel()

    theirs = least_squares(distances, np.zeros(3), xtol=1e-15, gtol=1e-15).x
    np.testing.assert_allclose(midpoint(jnp.asarray(centers), jnp.asarray(rays)), theirs, atol=1e-8)
    masked = midpoint(jnp.asarray(centers), jnp.asarray(rays).at[2].set(jnp.nan), valid=jnp.arange(5) != 2)
    absent = midpoint(jnp.asarray(np.delete(centers, 2, 0)), jnp.asarray(np.delete(rays, 2, 0)))
    np.testing.assert_allclose(masked, absent, atol=1e-12)


def test_corrected_pairs_equal_opencv(x64, rng):
    poses = cameras(rng, 2)
    first, second = (jax.tree.map(lambda leaf, i=i: leaf[i], poses) for i in (0, 1))
    K = np.array([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]])
    T = first.inverse() @ second
    x, y, z = np.asarray(T.translation)
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ np.asarray(T.rotation.matrix())
    F = np.linalg.inv(K).T @ essential @ np.linalg.inv(K)
    F /= np.linalg.norm(F)
    points = np.column_stack([rng.uniform(-1, 2, (20, 2)), rng.uniform(4, 8, 20)])
    pixels = np.stack([project(poses, point) for point in points]) + rng.normal(size=(20, 2, 2))
    ours = jax.vmap(correct_pair, in_axes=(0, 0, None))(
        jnp.asarray(pixels[:, 0]), jnp.asarray(pixels[:, 1]), jnp.asarray(F)
    )
    # OpenCV's convention is x2^T F x1 = 0.
    theirs = cv2.correctMatches(F.T, pixels[None, :, 0], pixels[None, :, 1])
    np.testing.assert_allclose(ours[0], theirs[0][0], atol=1e-3)
    np.testing.assert_allclose(ours[1], theirs[1][0], atol=1e-3)
    homogeneous = [np.column_stack([p, np.ones(20)]) for p in ours]
    assert np.abs(np.einsum("ni,ij,nj->n", homogeneous[0], F, homogeneous[1])).max() < 1e-10


def test_gradients_equal_differences(scene, rng):
    poses, _, pixels = scene
    pixels = jnp.asarray(pixels + SIGMA * rng.normal(size=pixels.shape))
    find = jax.jit(lambda p: triangulate(jl.sensors.Pinhole(*CAMERA), poses, p).value)
    slopes = jax.jit(jax.jacrev(find))(pixels)
    steps = 1e-4 * np.eye(10).reshape(10, 5, 2)
    differences = np.stack([(find(pixels + step) - find(pixels - step)) / 2e-4 for step in steps], axis=-1)
    np.testing.assert_allclose(slopes.reshape(3, 10), differences, rtol=1e-4, atol=1e-7)


@pytest.mark.slow
def test_bad_geometry_is_not_believed(dtype, rng):
    poses = jax.tree.map(lambda leaf: leaf.astype(dtype), cameras(rng, 5))
    still = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf[:1], leaf.shape), poses)
    camera = jl.sensors.Pinhole(*(jnp.asarray(v, dtype) for v in CAMERA))
    good = jnp.asarray(project(poses, np.array([0.8, -0.5, 6.0])), dtype)
    behind = jnp.asarray(project(poses, np.array([0.8, -0.5, -6.0])), dtype)
    cases = [
        (still, good),
        (poses, behind),
        (poses, jnp.full((5, 2), jnp.nan, dtype)),
        (poses, good.at[1:].set(jnp.inf)),
    ]
    together = jax.tree.map(lambda *leaves: jnp.stack(leaves), *cases)

    def point_of(case):
        found = triangulate(camera, *case)
        return jnp.sum(found.value), found

    (_, found), slopes = jax.jit(jax.vmap(jax.value_and_grad(point_of, has_aux=True, allow_int=True)))(together)
    assert not found.ok.any() and found.value.dtype == dtype
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((found, slopes)))
