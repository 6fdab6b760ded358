"""Points that move, on features whose motion is known: two cars and a wall in front of a camera that drives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.features import Descriptors
from jaxloc.odometry import StereoFeatures, find_moving, group_points
from jaxloc.poses import SE3
from jaxloc.refinement import StereoMatches
from jaxloc.sensors import Pinhole, StereoRig
from jaxloc.solvers import Estimate, RobustEstimate

DT = 0.1
RIG = StereoRig(Pinhole(400.0, 400.0, 200.0, 100.0), 0.5)
SHAPE = (200, 400)
MOTION = np.array([0.0, 0.0, 1.0])  # the camera drives 1 m forward


def splat(image, uv, patterns):
    """Draws each pattern around the nearest pixel."""
    for (u, v), pattern in zip(np.round(uv).astype(int), patterns, strict=True):
        h, w = np.array(pattern.shape) // 2
        image[v - h : v + h + 1, u - w : u + w + 1] = pattern


def features(points, patterns):
    seen = np.array(RIG.project(jnp.asarray(points, jnp.float32)))
    image = np.full(SHAPE, 100.0, np.float32)
    splat(image, seen[:, [0, 2]], patterns)
    seen[:, [0, 2]] = np.round(seen[:, [0, 2]])
    seen[:, 1] = seen[:, 0] - RIG.camera.fx * RIG.baseline / points[:, 2]
    count = len(points)
    empty = Descriptors(jnp.zeros((count, 32), jnp.uint8), jnp.ones(count, bool))
    ones = jnp.ones(count, jnp.float32)
    return StereoFeatures(
        jnp.asarray(image), jnp.asarray(image), empty, jnp.asarray(seen), 0.01 * ones, jnp.ones(count, bool)
    )


@pytest.fixture(scope="module")
def scene():
    rng = np.random.default_rng(0)
    wall = np.array([[x, y, 30.0] for x in (-10, -6, -2, 2, 6, 10) for y in (-3.0, 3.0)])
    crossing = np.array([[-3.0, 0.0, 15.0], [-2.2, 0.6, 15.0], [-1.4, 0.0, 15.0], [-0.6, 0.6, 15.0]])
    oncoming = np.array([[3.0, 0.0, 20.0], [4.0, 0.7, 20.0], [5.0, 0.0, 20.0]])
    before = np.concatenate([wall, crossing, oncoming])
    speeds = np.concatenate([np.zeros((12, 3)), np.tile([10.0, 0, 0], (4, 1)), np.tile([0, 0, -15.0], (3, 1))])
    after = before + DT * speeds - MOTION[None, :]
    patterns = rng.uniform(0, 255, size=(len(before), 9, 13)).astype(np.float32)
    previous, current = features(before, patterns), features(after, patterns)
    estimate = Estimate(
        SE3.from_matrix(jnp.asarray(np.r_[np.c_[np.eye(3), MOTION], [[0, 0, 0, 1]]], jnp.float32)),
        1e-6 * jnp.eye(6),
        cost=jnp.zeros(()),
        ok=jnp.array(True),
        num_steps=jnp.zeros((), jnp.int32),
        status=jnp.zeros((), jnp.int32),
        information=1e6 * jnp.eye(6),
    )
    # Odometry explains half of the wall.
    inlier = jnp.arange(len(before)) < 6
    matches = StereoMatches.of(previous.measured, current.measured, None, None, inlier)
    return previous, current, matches, RobustEstimate(estimate, inlier), after


# T-4, T-78
def test_cars_move_and_walls_do_not(scene):
    previous, current, matches, motion, after = scene
    found = find_moving(RIG, previous, current, matches, motion, jnp.array(DT))
    valid = np.asarray(found.valid)
    assert valid.sum() == 7
    uv = np.asarray(found.uv)[valid]
    expected = np.asarray(current.measured)[12:, [0, 2]]
    np.testing.assert_allclose(uv[np.lexsort(uv.T)], expected[np.lexsort(expected.T)])
    cars = np.asarray(found.positions)[valid]
    nearest = np.argmin(np.linalg.norm(cars[:, None] - after[None], axis=-1), axis=1)
    speeds = np.where((nearest < 16)[:, None], [[10.0, 0.0, 0.0]], [[0.0, 0.0, -15.0]])
    errors = np.asarray(found.velocities)[valid] - speeds
    sigmas = np.sqrt(np.diagonal(np.asarray(found.velocity_covariances)[valid], axis1=1, axis2=2))
    assert np.all(np.abs(errors) < 4.0 * sigmas)


# T-12, B.7
def test_points_of_a_car_become_one_object(scene):
    previous, current, matches, motion, after = scene
    objects = group_points(find_moving(RIG, previous, current, matches, motion, jnp.array(DT)))
    valid = np.asarray(objects.valid)
    assert np.asarray(objects.counts)[valid].tolist() == [4, 3]
    centers = np.array([after[12:16].mean(axis=0), after[16:].mean(axis=0)])
    np.testing.assert_allclose(np.asarray(objects.positions)[valid], centers, atol=0.3)
    boxes, uv = np.asarray(objects.boxes)[valid], np.asarray(current.measured)[12:, [0, 2]]
    np.testing.assert_allclose(boxes[0], [*uv[:4].min(axis=0), *uv[:4].max(axis=0)])
    spread = np.asarray(objects.position_covariances)[valid]
    assert np.all(np.linalg.eigvalsh(spread) > 0)


def test_nothing_to_see(scene):
    previous, current, matches, motion, _ = scene
    blind = jax.tree.map(lambda leaf: leaf, current)
    blind = StereoFeatures(
        blind.left, blind.right, blind.descriptors, blind.measured, blind.variance, jnp.zeros_like(blind.has_depth)
    )
    found = find_moving(RIG, previous, blind, matches, motion, jnp.array(DT))
    objects = group_points(found)
    assert not found.valid.any() and not objects.valid.any()
    assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves((found, objects)))
