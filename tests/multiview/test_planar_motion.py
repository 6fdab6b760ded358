"""Motion of a level camera from two rays: the truth and PoseLib's solver."""

import jax
import jax.numpy as jnp
import numpy as np
import poselib
import pytest

from jaxloc.multiview.planar_motion import planar_relative

COUNT = 300


def scenes(rng):
    """Rays of two points in both frames, headings of travel and turns."""
    points = np.stack(
        [rng.uniform(-3, 3, (COUNT, 2)), rng.uniform(-1.5, 1.5, (COUNT, 2)), rng.uniform(3, 9, (COUNT, 2))]
    )
    points = np.moveaxis(points, 0, -1)
    heading, turn = rng.uniform(-np.pi, np.pi, COUNT), rng.uniform(-0.5, 0.5, COUNT)
    cos, sin, zero, one = np.cos(turn), np.sin(turn), np.zeros(COUNT), np.ones(COUNT)
    R = np.moveaxis(np.array([[cos, zero, sin], [zero, one, zero], [-sin, zero, cos]]), -1, 0)
    t = np.column_stack([np.sin(heading), zero, np.cos(heading)])
    return points, (points - 0.5 * t[:, None]) @ R, R, t


@pytest.mark.parametrize("dtype", ["float32", "float64"], indirect=True)
def test_the_true_motion_is_among_them(dtype, rng):  # K-91
    first, second, R, t = scenes(rng)
    found = jax.jit(jax.vmap(planar_relative))(jnp.asarray(first, dtype), jnp.asarray(second, dtype))
    apart = np.abs(np.asarray(found.poses.rotation.rotation_matrix) - R[:, None]).max((2, 3))
    apart = np.maximum(apart, np.abs(np.asarray(found.poses.translation) - t[:, None]).max(2))
    best = np.where(np.asarray(found.valid), apart, np.inf).min(1)
    assert np.mean(best < (1e-6 if dtype == np.float64 else 1e-3)) > (0.999 if dtype == np.float64 else 0.98)


def test_equal_poselib(x64, rng):
    """Both solutions; PoseLib's motion is the inverse of ours, and it also keeps those behind the cameras."""
    first, second, _, _ = scenes(rng)
    found = jax.jit(jax.vmap(planar_relative))(jnp.asarray(first), jnp.asarray(second))
    checked = 0
    for i in range(COUNT):
        units = [list(p / np.linalg.norm(p, axis=1, keepdims=True)) for p in (first[i], second[i])]
        theirs = [np.asarray(pose.R).T for pose in poselib.relpose_upright_planar_2pt(*units)]
        for j in np.flatnonzero(found.valid[i]):
            ours = np.asarray(found.poses.rotation.rotation_matrix[i, j])
            assert min(np.abs(ours - R).max() for R in theirs) < 1e-6
            checked += 1
    assert checked >= COUNT


def test_derivative(x64, rng):
    first, second, _, t = (jnp.asarray(x[0]) for x in scenes(rng))
    change = jnp.asarray(rng.normal(size=second.shape))

    def direction(step):
        found = planar_relative(first, second + step * change)
        best = jnp.argmax(jnp.where(found.valid, jnp.sum(found.poses.translation * t[None], axis=1), -2.0))
        return found.poses.translation[best]

    slope = jax.jvp(direction, (0.0,), (1.0,))[1]
    np.testing.assert_allclose(slope, (direction(1e-6) - direction(-1e-6)) / 2e-6, rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize("kind", ["still", "same", "horizon", "zero", "nan"])
def test_what_says_nothing_of_the_motion(dtype, rng, kind):
    first, second, _, _ = (np.array(x[0]) for x in scenes(rng))
    if kind == "still":
        second = first.copy()
    if kind == "same":
        first[1], second[1] = first[0], second[0]
    if kind == "horizon":
        first[0, 1] = second[0, 1] = 0.0
    if kind == "zero":
        first[0] = 0.0
    if kind == "nan":
        second[1, 2] = np.nan

    def total(rays):
        found = planar_relative(jnp.asarray(first, dtype), rays)
        return jnp.sum(found.poses.translation), found

    slope, found = jax.grad(total, has_aux=True)(jnp.asarray(second, dtype))
    assert not found.valid.any() and np.isfinite(slope).all()
    assert np.isfinite(found.poses.translation).all() and np.isfinite(found.poses.rotation.rotation_matrix).all()
