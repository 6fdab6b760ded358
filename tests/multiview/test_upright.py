import jax
import jax.numpy as jnp
import numpy as np
import poselib
import pytest
from scipy.spatial.transform import Rotation

from jaxloc.multiview.upright import upright_p2p, upright_relative

absolute = jax.jit(jax.vmap(upright_p2p))
relative = jax.jit(jax.vmap(upright_relative))


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def scenes(count, points, seed=0):
    """Points before level cameras: seen by each, in the world, and the cameras' rotations and places."""
    rng = np.random.default_rng(seed)
    R = Rotation.from_rotvec(rng.uniform(-np.pi, np.pi, (count, 1)) * [0.0, 1.0, 0.0]).as_matrix()
    t = rng.normal(size=(count, 3))
    seen = np.concatenate([rng.uniform(-2, 2, (count, points, 2)), rng.uniform(2, 8, (count, points, 1))], axis=-1)
    return seen, np.einsum("nij,nkj->nki", R, seen) + t[:, None], R, t


def errors_of(found, R, t):
    turns, places = np.asarray(found.poses.rotation.rotation_matrix), np.asarray(found.poses.translation)
    worst = np.maximum(np.abs(turns - R[:, None]).max((2, 3)), np.abs(places - t[:, None]).max(2))
    return np.where(found.valid, worst, np.inf)


def pairs(count, seed=0):
    seen, points, R, t = scenes(count, 3, seed)
    # The first frame is the world, moved so that it sees the points too.
    rng = np.random.default_rng(seed + 1)
    turn = Rotation.from_rotvec(rng.uniform(-0.5, 0.5, (count, 1)) * [0.0, 1.0, 0.0]).as_matrix()
    step = unit(rng.normal(size=(count, 3)))
    second = np.einsum("nji,nkj->nki", turn, seen - step[:, None])
    return unit(seen), unit(second), turn, step


def test_absolute_pose(dtype):
    seen, points, R, t = scenes(2000, 2)
    found = absolute(jnp.asarray(unit(seen), dtype), jnp.asarray(points, dtype))
    best = errors_of(found, R, t).min(1)
    assert found.poses.translation.dtype == dtype
    assert (best < (1e-8 if dtype == np.float64 else 1e-2)).mean() > 0.99


def test_relative_pose(dtype):
    first, second, R, t = pairs(2000)
    found = relative(jnp.asarray(first, dtype), jnp.asarray(second, dtype))
    best = errors_of(found, R, t).min(1)
    assert found.poses.translation.dtype == dtype
    assert (best < (1e-6 if dtype == np.float64 else 1e-2)).mean() > (0.995 if dtype == np.float64 else 0.95)


def test_absolute_solutions_equal_poselib(x64):
    seen, points, _, _ = scenes(200, 2, seed=3)
    found = absolute(jnp.asarray(unit(seen)), jnp.asarray(points))
    for i in range(200):
        ours = np.asarray(found.poses.translation[i])[np.asarray(found.valid[i])]
        # PoseLib also keeps poses with points behind the camera.
        peers = [p for p in poselib.up2p(unit(seen)[i], points[i]) if np.all((points[i] @ p.R.T + p.t) * seen[i] > 0)]
        theirs = [-p.R.T @ p.t for p in peers]
        assert len(theirs) == len(ours) and all(np.abs(ours - place).max(1).min() < 1e-6 for place in theirs)


def test_relative_solutions_equal_poselib(x64):
    first, second, _, _ = pairs(200, seed=3)
    found = relative(jnp.asarray(first), jnp.asarray(second))
    missed = total = 0
    for i in range(200):
        ours = np.asarray(found.poses.rotation.rotation_matrix[i])[np.asarray(found.valid[i])]
        # PoseLib maps the first frame to the second and keeps solutions of either sign of translation.
        for peer in poselib.relpose_upright_3pt(first[i], second[i]):
            inside = peer.R @ first[i].T
            depths = [
                np.linalg.lstsq(np.stack([a, -b], 1), -peer.t, rcond=None)[0]
                for a, b in zip(inside.T, second[i], strict=True)
            ]
            if np.min(depths) <= 0:
                continue
            total += 1
            missed += not len(ours) or np.abs(ours - peer.R.T).max((1, 2)).min() > 1e-5
    assert total > 150 and missed <= 0.01 * total


@pytest.mark.parametrize("solver", [upright_p2p, upright_relative])
def test_gradients_equal_differences(x64, solver):
    if solver is upright_p2p:
        seen, points, R, t = scenes(1, 2, seed=5)
        arguments = jnp.asarray(unit(seen)[0]), jnp.asarray(points[0])
    else:
        first, second, R, t = pairs(1, seed=5)
        arguments = jnp.asarray(first[0]), jnp.asarray(second[0])
    found = jax.tree.map(lambda leaf: leaf[None], solver(*arguments))
    index = int(np.argmin(errors_of(found, R, t)))
    place = jax.jit(lambda a, b: solver(a, b).poses.translation[index])
    slopes = jax.jacrev(place, argnums=(0, 1))(*arguments)
    for which in range(2):
        shape = arguments[which].shape
        for step in 1e-6 * np.eye(int(np.prod(shape))).reshape(-1, *shape):
            ahead, back = ([a + s * step if k == which else a for k, a in enumerate(arguments)] for s in (1, -1))
            difference = (place(*ahead) - place(*back)) / 2e-6
            along = (slopes[which] * (step / 1e-6)[None]).sum((1, 2))
            np.testing.assert_allclose(along, difference, rtol=1e-5, atol=1e-6)


@pytest.mark.slow
def test_degenerate_sets_stay_finite(dtype):
    seen, points, _, _ = scenes(5, 2)
    rays = unit(seen)
    rays[0] = rays[0, :1]
    points[1] = points[1, :1]
    rays[2] = [[0.6, 0.0, 0.8], [-0.6, 0.0, 0.8]]
    points[3, :, ::2] = 1.0
    rays[4] = 0.0
    first, second, _, _ = pairs(5)
    second[0] = first[0]
    first[1], second[1] = first[1, :1], second[1, :1]
    first[2] = 0.0
    first[3, 2], second[3, 2] = first[3, 1], second[3, 1]
    for solve, one, two in ((absolute, rays, points), (relative, first, second)):
        one, two = jnp.asarray(one, dtype), jnp.asarray(two, dtype)
        poses, pull = jax.vjp(lambda a, b, s=solve: s(a, b).poses, one, two)
        slopes = pull(jax.tree.map(jnp.ones_like, poses))
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((poses, slopes)))
    assert not absolute(jnp.asarray(rays, dtype), jnp.asarray(points, dtype)).valid[1:].any()
    # Equal images (case 0) have solutions too, though not one translation.
    assert not relative(jnp.asarray(first, dtype), jnp.asarray(second, dtype)).valid[1:4].any()
