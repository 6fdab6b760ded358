import cv2
import jax
import jax.numpy as jnp
import numpy as np
import poselib
import pytest
from scipy.spatial.transform import Rotation

from jaxloc.multiview import p3p


def problems(n, seed=0, depth=(2.0, 10.0), reach=1.0):
    rng = np.random.default_rng(seed)
    R = Rotation.random(n, random_state=seed).as_matrix()
    t = 3.0 * rng.normal(size=(n, 3))
    z = rng.uniform(*depth, (n, 3))
    points = np.stack([z * rng.uniform(-reach, reach, (n, 3)), z * rng.uniform(-reach, reach, (n, 3)), z], -1)
    world = np.einsum("nij,nkj->nki", R, points) + t[:, None]
    return points / np.linalg.norm(points, axis=-1, keepdims=True), world, R, t


@pytest.fixture(scope="module")
def batch():
    return jax.jit(jax.vmap(p3p))


def errors_of(found, R, t):
    """Largest entry of the pose error of every candidate; infinite where it is no solution."""
    matrices = np.asarray(jax.vmap(jax.vmap(lambda pose: pose.matrix()))(found.poses))
    rotation = np.abs(matrices[..., :3, :3] - R[:, None]).max((2, 3))
    translation = np.abs(matrices[..., :3, 3] - t[:, None]).max(2)
    return np.where(found.valid, np.maximum(rotation, translation), np.inf)


def test_finds_the_true_pose(dtype, batch):
    rays, world, R, t = problems(10000)
    found = batch(jnp.asarray(rays, dtype), jnp.asarray(world, dtype))
    best = errors_of(found, R, t).min(1)
    assert found.poses.translation.dtype == dtype
    if dtype == np.float64:
        assert (best < 1e-6).all()
    else:  # Where two solutions nearly meet, half of the digits are left.
        assert (best < 1e-3).mean() >= 0.997


def test_narrow_field_of_view(x64, batch):
    rays, world, R, t = problems(2000, seed=5, depth=(30.0, 40.0), reach=0.05)
    assert (errors_of(batch(jnp.asarray(rays), jnp.asarray(world)), R, t).min(1) < 1e-4).mean() >= 0.995


def test_far_points_keep_their_digits(batch):
    """Sides of the triangle a fifteenth of the distance: in the textbook's equations a thousand times eps cancels."""
    rays, world, R, t = problems(2000, seed=5, depth=(30.0, 40.0), reach=0.05)
    best = errors_of(batch(jnp.asarray(rays, jnp.float32), jnp.asarray(world, jnp.float32)), R, t).min(1)
    assert np.quantile(best, 0.99) < 4e-4


def test_length_of_rays_does_not_count(x64, batch):
    rays, world, _, _ = problems(50, seed=6)
    lengths = np.random.default_rng(7).uniform(0.5, 2.0, (50, 3, 1))
    one, other = (batch(jnp.asarray(r), jnp.asarray(world)) for r in (rays, lengths * rays))
    assert np.array_equal(one.valid, other.valid)
    assert np.allclose(one.poses.translation, other.poses.translation, atol=1e-8)


def test_every_solution_explains_the_rays(x64, batch):
    rays, world, _, _ = problems(500, seed=1)
    found = batch(jnp.asarray(rays), jnp.asarray(world))
    matrices = np.asarray(jax.vmap(jax.vmap(lambda pose: pose.matrix()))(found.poses))
    R, t = matrices[..., :3, :3], matrices[..., :3, 3]
    seen = np.einsum("nkji,nkmj->nkmi", R, world[:, None] - t[:, :, None])
    seen /= np.linalg.norm(seen, axis=-1, keepdims=True)
    assert np.abs(seen - rays[:, None])[np.asarray(found.valid)].max() < 1e-9
    assert np.allclose(np.linalg.det(R), 1.0) and np.allclose(R @ np.swapaxes(R, -1, -2), np.eye(3))


def test_solutions_equal_poselib_and_opencv(x64, batch):
    rays, world, _, _ = problems(200, seed=2)
    found = batch(jnp.asarray(rays), jnp.asarray(world))
    translations, valid = np.asarray(found.poses.translation), np.asarray(found.valid)
    for i in range(200):
        ours = translations[i][valid[i]]
        centers = np.array([-p.R.T @ p.t for p in poselib.p3p(rays[i], world[i])])
        assert len(ours) == len(centers)
        assert all(np.abs(ours - center).max(1).min() < 1e-5 for center in centers)
        pixels = np.ascontiguousarray((rays[i] / rays[i][:, 2:])[:, :2])
        _, rotations, shifts = cv2.solveP3P(world[i], pixels, np.eye(3), None, cv2.SOLVEPNP_P3P)
        for rotation, shift in zip(rotations, shifts, strict=True):
            center = -cv2.Rodrigues(rotation)[0].T @ shift[:, 0]
            assert np.abs(ours - center).max(1).min() < 1e-3


@pytest.mark.slow
def test_degenerate_problems_stay_finite(dtype, batch):
    rays, world, _, _ = problems(8, seed=3)
    cases = np.broadcast_to(world[:1], (8, 3, 3)).copy()
    rays = np.broadcast_to(rays[:1], (8, 3, 3)).copy()
    cases[0] = 0.0  # one point
    cases[1, 1] = cases[1, 0]  # two points
    cases[2, 2] = 0.5 * (cases[2, 0] + cases[2, 1])  # a line
    rays[3] = rays[3, :1]  # one ray
    rays[4] = 0.0
    rays[5, 2] = -rays[5, 1]
    cases[6] *= 1e-6
    cases[7] *= 1e4
    arrays = jnp.asarray(rays, dtype), jnp.asarray(cases, dtype)

    @jax.jit
    def value_and_pull(rays, world):
        found, pull = jax.vjp(lambda r, x: batch(r, x).poses, rays, world)
        return found, pull(jax.tree.map(jnp.ones_like, found)), batch(rays, world).valid

    found, gradient, valid = value_and_pull(*arrays)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((found, gradient)))
    valid = np.asarray(valid)
    assert not valid[:5].any() and valid[6:].any(1).all()


def test_gradients_equal_differences(x64):
    rays, world, R, t = problems(1, seed=4)
    rays, world = jnp.asarray(rays[0]), jnp.asarray(world[0])
    index = int(np.argmin(errors_of(jax.tree.map(lambda leaf: leaf[None], p3p(rays, world)), R, t)))

    def center(both):
        return p3p(both[0], both[1]).poses.translation[index]

    both, steps = jnp.stack([rays, world])[None], 1e-6 * jnp.eye(18).reshape(18, 2, 3, 3)
    forward = jax.jit(jax.jacfwd(center))(both[0]).reshape(3, 18)
    reverse = jax.jit(jax.jacrev(center))(both[0]).reshape(3, 18)
    ahead, back = jax.jit(jax.vmap(center))(jnp.concatenate([both + steps, both - steps])).reshape(2, 18, 3)
    assert np.allclose(forward, (ahead - back).T / 2e-6, rtol=1e-5, atol=1e-6)
    assert np.allclose(forward, reverse, atol=1e-9)


def test_vmap_equals_single(dtype, batch):
    rays, world, _, _ = problems(10000)
    rays, world = jnp.asarray(rays, dtype), jnp.asarray(world, dtype)
    together = batch(rays, world)
    alone = p3p(rays[0], world[0])
    tolerance = 1e-3 if dtype == np.float32 else 1e-9
    assert np.array_equal(alone.valid, together.valid[0])
    shown = np.asarray(alone.valid)[:, None].astype(dtype)
    assert np.allclose(alone.poses.translation * shown, together.poses.translation[0] * shown, atol=tolerance)
