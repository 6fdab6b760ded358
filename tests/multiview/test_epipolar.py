"""Two views: conventions against OpenCV and projections, distances against their definitions."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxloc as jl
from jaxloc.multiview.epipolar import (
    RelativePose,
    coplanarity,
    epipolar_gate,
    epipolar_lines,
    epipoles,
    fundamental,
    sampson_distance,
    symmetric_distance,
)
from jaxloc.poses import SE3

POSE = (0.6, 0.1, 0.3, 0.05, -0.1, 0.15)


def cameras():
    return jl.sensors.Pinhole(500.0, 480.0, 320.0, 240.0, 2.0), jl.sensors.Pinhole(400.0, 410.0, 300.0, 250.0)


@pytest.fixture
def views(x64, rng):
    """Points seen twice, px, and the true pose."""
    pose = SE3.exp(jnp.array(POSE))
    points = jnp.asarray(np.column_stack([rng.uniform(-2, 2, (12, 2)), rng.uniform(4, 9, 12)]))
    return pose, cameras()[0].project(points), cameras()[1].project(pose.inverse().apply(points)), points


def test_rays_of_one_point_are_coplanar(views):
    pose, first, second, points = views
    essential = RelativePose.of(pose).essential()
    matrix = fundamental(essential, *cameras())
    np.testing.assert_allclose(coplanarity(matrix, first, second), 0.0, atol=1e-12)
    np.testing.assert_allclose(sampson_distance(matrix, first, second), 0.0, atol=1e-9)
    # The review's form, in the first frame: (P - T) . T x P = 0.
    t, points = np.asarray(pose.translation), np.asarray(points)
    assert np.abs(np.sum((points - t) * np.cross(t, points), axis=1)).max() < 1e-12


def test_essential_is_on_its_manifold(views):
    singular = np.linalg.svd(RelativePose.of(views[0]).essential(), compute_uv=False)
    np.testing.assert_allclose(singular, [1.0, 1.0, 0.0], atol=1e-12)


def test_equal_opencv(views, rng):
    pose, first, second, _ = views
    matrix = np.asarray(fundamental(RelativePose.of(pose).essential(), *cameras()))
    first, second = (np.asarray(p) + rng.normal(size=p.shape) for p in (first, second))
    lines = cv2.computeCorrespondEpilines(second.reshape(-1, 1, 2), 2, matrix.T)[:, 0]
    ours = np.asarray(epipolar_lines(jnp.asarray(matrix), jnp.asarray(second)))
    sign = np.sign(np.sum(lines * ours, axis=1, keepdims=True))
    np.testing.assert_allclose(ours, sign * lines, atol=1e-4)
    # OpenCV gives the squared distance, and wants x2^T F x1.
    both = zip(first, second, strict=True)
    squared = [cv2.sampsonDistance(np.append(a, 1), np.append(b, 1), matrix.T) for a, b in both]
    ours = sampson_distance(jnp.asarray(matrix), jnp.asarray(first), jnp.asarray(second))
    np.testing.assert_allclose(ours**2, squared, rtol=1e-9)


def test_sampson_is_the_least_move_to_first_order(views, rng):
    """Against the optimal correction of the pair."""
    pose, first, second, _ = views
    matrix = fundamental(RelativePose.of(pose).essential(), *cameras())
    first, second = (p + 0.5 * jnp.asarray(rng.normal(size=p.shape)) for p in (first, second))
    moved = jax.vmap(jl.multiview.triangulation.correct_pair, in_axes=(0, 0, None))(first, second, matrix)
    length = jnp.sqrt(jnp.sum((moved[0] - first) ** 2 + (moved[1] - second) ** 2, axis=1))
    np.testing.assert_allclose(jnp.abs(sampson_distance(matrix, first, second)), length, rtol=1e-2)
    both = symmetric_distance(matrix, first, second)
    lines = epipolar_lines(matrix, second), epipolar_lines(matrix.T, first)
    sides = zip((first, second), lines, strict=True)
    apart = [np.sum(np.column_stack([p, np.ones(12)]) * line, axis=1) for p, line in sides]
    np.testing.assert_allclose(both, np.hypot(*apart), rtol=1e-9)


def test_epipoles_are_the_other_cameras(views):  # T-20
    pose, _, _, points = views
    matrix = fundamental(RelativePose.of(pose).essential(), *cameras())
    first, second = epipoles(matrix)
    centers = pose.translation, pose.inverse().translation
    for found, camera, center in zip((first, second), cameras(), centers, strict=True):
        pixel = np.asarray(camera.matrix()) @ np.asarray(center)
        np.testing.assert_allclose(found[:2] / found[2], pixel[:2] / pixel[2], rtol=1e-6)
    # A point that nears the first camera slides along its line towards the epipole.
    ray = points[:1] / points[:1, 2:]
    near = jnp.concatenate([ray * depth for depth in (8.0, 2.0, 1.0, 0.7)])
    seen = cameras()[1].project(pose.inverse().apply(near))
    line = epipolar_lines(matrix.T, cameras()[0].project(ray))
    assert np.abs(np.column_stack([seen, np.ones(4)]) @ np.asarray(line[0])).max() < 1e-8


def test_gate_keeps_partners_and_drops_most(views):
    pose, first, second, _ = views
    matrix = fundamental(RelativePose.of(pose).essential(), *cameras())
    gate = np.asarray(epipolar_gate(matrix, first, second, band=2.0))
    assert np.diag(gate).all() and gate.sum() < 0.4 * gate.size
    pairs = [sampson_distance(matrix, first[i][None], second[j][None])[0] for i in range(12) for j in range(12)]
    np.testing.assert_array_equal(gate.ravel(), np.abs(np.array(pairs)) <= 2.0)


def test_tangent_of_a_relative_pose(views, rng):
    start, delta = RelativePose.of(views[0]), jnp.asarray(rng.uniform(-0.3, 0.3, 5))
    assert jl.poses.tangent_dimension(start) == 5
    np.testing.assert_allclose(jl.poses.local(start, jl.poses.retract(start, delta)), delta, atol=1e-12)


@pytest.mark.parametrize("matrix", [np.zeros((3, 3)), np.eye(3), np.outer([1, 2, 3], [0, 0, 0])])
def test_bad_matrices_stay_finite(dtype, matrix):
    points = jnp.zeros((3, 2), dtype)

    def total(m):
        lines, poles = epipolar_lines(m, points), epipoles(m)
        errors = sampson_distance(m, points, points), symmetric_distance(m, points, points)
        return sum(jnp.sum(x) for x in (lines, *poles, *errors))

    value, slope = jax.value_and_grad(total)(jnp.asarray(matrix, dtype))
    assert np.isfinite(value) and np.isfinite(slope).all()
