"""Images of pallets [K-14, K-76]: the places of their edges and their gray levels against closed forms."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.data.simulate.pallet import PalletScene, make_camera, render_pallet
from jaxloc.poses import SE2
from jaxloc.refinement.pallet import edge_bearings, euro_long
from jaxloc.sensors import GroundCamera, Pinhole

SHAPE, FOCAL = (240, 480), 450.0
PLAIN = PalletScene(texture=0.0, noise=0.0, shading=0.0)


def camera_at(pitch=0.0):
    return GroundCamera(Pinhole(FOCAL, FOCAL, 239.5, 119.5), 0.35, pitch=pitch)


@pytest.mark.parametrize("pose", [(2.0, 0.2, 0.2), (1.5, -0.1, -0.3), (3.0, 0.0, 0.0)])
def test_edges_lie_where_the_model_says(pose):
    image = np.asarray(render_pallet(euro_long(), np.array(pose), camera_at(), shape=SHAPE, scene=PLAIN), float)
    bearings = np.asarray(edge_bearings(SE2(*pose), euro_long().edges(), FOCAL))
    for bearing, edge in zip(bearings, np.asarray(euro_long().edges()), strict=True):
        column = 239.5 - bearing
        row = round(119.5 + FOCAL * (0.35 - 0.072) / (pose[0] - np.sin(pose[2]) * edge))
        around = np.arange(int(column) - 5, int(column) + 7)
        slope = np.abs(np.gradient(image[row]))[around]
        assert abs(np.sum(slope * around) / np.sum(slope) - column) < 0.06


def test_gray_levels_are_those_of_the_scene():
    image = render_pallet(euro_long(), np.array([2.0, 0.0, 0.0]), camera_at(), shape=SHAPE, scene=PLAIN)
    rows = 119.5 + FOCAL * (0.35 - 0.03) / 2.0
    assert abs(float(image[round(rows), 239]) - PLAIN.wood) <= 1.0
    assert abs(float(image[round(rows), round(239.5 - FOCAL * 0.25 / 2.0)]) - PLAIN.hole) <= 12.0
    assert image[10, 10] == PLAIN.wall and image[-1, 5] == PLAIN.floor


def test_pitch_moves_rows_and_seed_fixes_everything():
    pose = np.array([2.0, 0.0, 0.0])
    level, down = (render_pallet(euro_long(), pose, camera_at(p), shape=SHAPE, scene=PLAIN) for p in (0.0, 0.1))
    rows = [np.flatnonzero(image[:, 239] > 0.5 * (PLAIN.wood + PLAIN.wall)).mean() for image in (level, down)]
    assert 40.0 < rows[0] - rows[1] < 55.0  # 0.1 rad of 450 px
    first, again, other = (render_pallet(None, pose, camera_at(), shape=SHAPE, seed=s) for s in (1, 1, 2))
    assert np.array_equal(first, again) and not np.array_equal(first, other) and first.dtype == np.uint8


def test_noise_and_shading_are_those_asked_for():
    scene = PalletScene(texture=0.0, noise=3.0, shading=0.5)
    image = np.asarray(render_pallet(None, np.zeros(3), camera_at(), shape=SHAPE, scene=scene), float)[:80]
    light = 1.0 + 0.5 * (0.5 - np.arange(480) / 480)
    np.testing.assert_allclose(image.mean(axis=0), PLAIN.wall * light, atol=1.5)
    assert abs(np.std(image - PLAIN.wall * light[None, :]) - 3.0) < 0.1


def test_the_default_camera_sees_a_pallet_at_two_meters():
    camera = make_camera()
    u, v = camera.project_components(jnp.array([2.0]), jnp.array([0.0]))
    assert 0 <= float(u[0]) <= 639 and 0 <= float(v[0]) <= 479
