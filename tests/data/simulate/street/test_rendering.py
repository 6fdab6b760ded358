"""Rendered depth against rays cast one by one, rendered gray values against the true warp between two views."""

import numpy as np
import pytest

from jaxloc.data.simulate.street.rendering import Intrinsics, Rectangles, render
from jaxloc.data.simulate.street.textures import make_noise, make_street_textures
from jaxloc.data.simulate.street.world import make_box, make_street, rotation_y

CAMERA = Intrinsics(70.0, 75.0, 39.2, 24.7, 50, 80)


@pytest.fixture(scope="module")
def atlas():
    return make_street_textures(0, size=256)


def cast(rectangles, rays):
    """Depth and index of the nearest rectangle along each ray, by solving a 3x3 system for each."""
    best = np.full(len(rays), np.inf)
    winner = np.full(len(rays), -1)
    for k in range(len(rectangles)):
        for i, ray in enumerate(rays):
            system = np.column_stack([ray, -rectangles.first[k], -rectangles.second[k]])
            if abs(np.linalg.det(system)) < 1e-12:
                continue
            z, a, b = np.linalg.solve(system, rectangles.corner[k])
            facing = np.cross(rectangles.first[k], rectangles.second[k]) @ ray < 0
            if facing and 0 < z < best[i] and 0 <= a <= 1 and 0 <= b <= 1:
                best[i], winner[i] = z, k
    return best, winner


def test_depth_and_instances_match_ray_casting(atlas, rng):
    box = make_box((2.0, 1.5, 4.0), 3, 4.0, rng, instance=7)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_y(0.5), [1.0, 1.6, 9.0]
    street = make_street(0, length=5.0, speed=5.0)
    # Some near things of the street, one of them partly behind the camera.
    near = np.flatnonzero(np.abs(street.fixed.corner[:, 2]) < 12.0)[:40]
    pieces = [box.moved(pose), Rectangles(*(getattr(street.fixed, n)[near] for n in box.__dataclass_fields__))]
    scene = Rectangles(*(np.concatenate([getattr(p, n) for p in pieces]) for n in box.__dataclass_fields__))
    seen = render(scene, atlas, CAMERA, np.eye(4))
    columns, rows = rng.integers(0, 80, 250), rng.integers(0, 50, 250)
    rays = np.column_stack([(columns - CAMERA.cx) / CAMERA.fx, (rows - CAMERA.cy) / CAMERA.fy, np.ones(250)])
    depth, winner = cast(scene, rays)
    rendered = seen.depth[rows, columns]
    # A ray through an edge may fall to either side of it.
    agree = np.isclose(rendered, depth, rtol=1e-4) | (np.isinf(rendered) & np.isinf(depth))
    assert agree.mean() > 0.98
    instance = np.where(winner >= 0, scene.instance[winner], 0)
    assert (seen.instances[rows, columns] == instance).mean() > 0.98
    assert np.isfinite(seen.image).all() and np.isinf(depth).any() and (instance == 7).any()


def test_a_rectangle_seen_from_behind_is_not_drawn(atlas):
    wall = Rectangles(
        np.array([[-50.0, -50.0, 10.0]]),
        np.array([[100.0, 0.0, 0.0]]),
        np.array([[0.0, 100.0, 0.0]]),
        np.array([0]),
        np.array([4.0]),
        np.zeros((1, 2)),
        np.ones(1),
        np.array([3]),
    )
    assert np.isinf(render(wall, atlas, CAMERA, np.eye(4)).depth).all()
    turned = np.diag([-1.0, 1.0, -1.0, 1.0])
    turned[2, 3] = 20.0
    seen = render(wall.moved(turned), atlas, CAMERA, np.eye(4))
    np.testing.assert_allclose(seen.depth, 10.0, rtol=1e-5)
    assert (seen.instances == 3).all()


def test_textures_repeat_and_lose_contrast_with_the_footprint(atlas, rng):
    count = 4000
    texture = np.full(count, 1)
    u, v = rng.uniform(size=(2, count)).astype(np.float32)
    small, large = np.full(count, 1e-3, np.float32), np.full(count, 0.3, np.float32)
    fine = atlas.sample(texture, u, v, small)
    np.testing.assert_allclose(atlas.sample(texture, u + 3.0, v - 2.0, small), fine, atol=1.1)
    coarse = atlas.sample(texture, u, v, large)
    assert coarse.std() < 0.6 * fine.std()
    assert abs(coarse.mean() - fine.mean()) < 2.0
    # At the finest level a look-up at a texel's center is the texel.
    row, column = atlas.rows[0], atlas.columns[1]
    center = atlas.sample(texture[:1], np.float32([10.5 / 256]), np.float32([20.5 / 256]), small[:1])
    np.testing.assert_allclose(center, atlas.image[row + 20, column + 10], atol=0.6)


def test_noise_repeats_without_a_seam(rng):
    noise = make_noise(rng, 256)
    assert abs(noise.mean()) < 1e-5 and noise.std() == pytest.approx(1.0, abs=1e-4)
    seam, inside = np.abs(noise[:, 0] - noise[:, -1]).mean(), np.abs(np.diff(noise, axis=1)).mean()
    assert seam < 1.5 * inside
