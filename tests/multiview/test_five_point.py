"""Five points: the true pose among the candidates, and every solution that PoseLib finds."""

import jax
import jax.numpy as jnp
import numpy as np
import poselib
import pytest
from scipy.spatial.transform import Rotation

from jaxloc.multiview.epipolar import RelativePose
from jaxloc.multiview.five_point import decompose, facing, five_point
from jaxloc.poses import SE3


@pytest.fixture(scope="module")
def batch():
    return jax.jit(jax.vmap(five_point))


def cross(t):
    x, y, z = np.moveaxis(np.asarray(t), -1, 0)
    o = np.zeros_like(x)
    return np.stack([np.stack([o, -z, y], -1), np.stack([z, o, -x], -1), np.stack([-y, x, o], -1)], -2)


def problems(count=400, seed=0):
    rng = np.random.default_rng(seed)
    R = Rotation.from_rotvec(rng.uniform(-0.5, 0.5, (count, 3))).as_matrix()
    t = rng.normal(size=(count, 3))
    t /= np.linalg.norm(t, axis=1, keepdims=True)
    first = np.concatenate([rng.uniform(-3, 3, (count, 5, 2)), rng.uniform(3, 9, (count, 5, 1))], axis=2)
    second = np.einsum("nji,nkj->nki", R, first - t[:, None])
    unit = lambda v: v / np.linalg.norm(v, axis=-1, keepdims=True)  # noqa: E731
    return unit(first), unit(second), R, t


def misses(found, index, essential):
    """How far the nearest valid candidate is from an essential matrix, up to sign."""
    candidates = jax.vmap(jax.vmap(lambda pose: pose.essential()))(found.poses)
    candidates, valid = np.asarray(candidates)[index], np.asarray(found.valid)[index]
    apart = np.minimum(np.abs(candidates - essential).max((1, 2)), np.abs(candidates + essential).max((1, 2)))
    return np.where(valid, apart, np.inf).min()


@pytest.mark.slow
def test_the_true_pose_is_among_the_candidates(dtype, batch):
    first, second, R, t = problems()
    found = batch(jnp.asarray(first, dtype), jnp.asarray(second, dtype))
    turns = np.asarray(found.poses.rotation.rotation_matrix)
    places = np.asarray(found.poses.direction.vector)
    apart = np.maximum(np.abs(turns - R[:, None]).max((2, 3)), np.abs(places - t[:, None]).max(2))
    best = np.where(found.valid, apart, np.inf).min(1)
    assert turns.dtype == dtype
    assert (best < (1e-6 if dtype == np.float64 else 1e-2)).mean() > (0.99 if dtype == np.float64 else 0.9)


@pytest.mark.slow
def test_solutions_equal_poselib(x64, batch):
    first, second, _, _ = problems(seed=1)
    found = batch(jnp.asarray(first), jnp.asarray(second))
    missed = total = 0
    for i in range(100):
        for peer in poselib.relpose_5pt(first[i], second[i]):
            essential = (cross(peer.t / np.linalg.norm(peer.t)) @ peer.R).T
            missed += misses(found, i, essential) > 1e-4
            total += 1
    assert total > 200 and missed <= 0.015 * total


def test_decomposition(x64, rng):
    for _ in range(5):
        pose = RelativePose.of(SE3.exp(jnp.asarray(rng.normal(size=6))))
        points = rng.uniform(-1, 1, (20, 3)) + [0, 0, 4]
        found = decompose(-2.0 * pose.essential())
        np.testing.assert_allclose(np.abs(found.essential()), np.abs(pose.essential()), atol=1e-9)
        # Rays by their ends: in both frames the points need not lie ahead of the lens.
        rays = jnp.asarray(points), pose.pose().inverse().apply(jnp.asarray(points))
        chosen = facing(found, *rays)
        np.testing.assert_allclose(chosen.rotation.matrix(), pose.rotation.matrix(), atol=1e-9)
        np.testing.assert_allclose(chosen.direction.vector, pose.direction.vector, atol=1e-9)


def test_degenerate_samples_stay_finite(dtype):
    first, second, _, _ = problems(8)
    second[0] = first[0]
    first[1, 1:], second[1, 1:] = first[1, :1], second[1, :1]
    first[2], second[2] = 0.0, 0.0
    first[3] = np.nan
    first[4, 2], second[4, 2] = first[4, 1], second[4, 1]
    second[5] = np.inf
    batch = jax.jit(jax.vmap(five_point))
    found = batch(jnp.asarray(first, dtype), jnp.asarray(second, dtype))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))
    assert not np.asarray(found.valid)[1:4].any() and np.asarray(found.valid)[6:].any(1).all()
