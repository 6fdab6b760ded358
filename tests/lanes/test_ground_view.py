import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxloc as jl
from jaxloc.lanes.ground_view import GroundGrid, inverse_perspective

SHAPE = (120, 160)
LENS = jl.sensors.BrownConrady


def ground(pitch=0.06, roll=0.0, lens=None, dtype=None):
    made = jl.sensors.GroundCamera(jl.sensors.Pinhole(150.0, 150.0, 79.5, 49.5, lens=lens), 1.3, pitch, roll)
    return made if dtype is None else jax.tree.map(lambda leaf: leaf.astype(dtype), made)


def smooth_picture(seed=0):
    noise = np.random.default_rng(seed).normal(size=SHAPE).astype(np.float32)
    return 100.0 + 200.0 * cv2.GaussianBlur(noise, (0, 0), 5.0)


GRID = GroundGrid.between(4.0, 30.0, 6.0, rows=24, columns=48)


def test_view_is_the_warp_of_opencv():
    """Against OpenCV's perspective warp by our homography (itself tested against its projection)."""
    picture = smooth_picture()
    to_pixel = np.array(ground().homography(), np.float64)
    view = inverse_perspective(ground(), jnp.asarray(picture), GRID)
    expected = np.zeros(view.image.shape)
    # Four rays a column, so that narrow marks do not alias.
    for place, weight in ((0.75, 1), (0.25, 3), (-0.25, 3), (-0.75, 1)):
        x, y = np.meshgrid(np.array(GRID.ahead), np.array(GRID.left + place * GRID.spacing), indexing="ij")
        u, v, w = to_pixel @ np.stack([x, y, np.ones_like(x)]).reshape(3, -1)
        maps = [(part / w).reshape(x.shape).astype(np.float32) for part in (u, v)]
        expected += weight / 8 * cv2.remap(picture, *maps, cv2.INTER_LINEAR)
    seen = np.array(view.seen)
    seen[:, [0, -1]] = False  # the outermost columns repeat their own rays
    assert seen.mean() > 0.7
    np.testing.assert_allclose(np.array(view.image)[seen], expected[seen], atol=0.3)


def test_every_row_shows_the_same_width_of_ground():
    """K-34: the trapezoid is narrow far away in the image, and equally wide on the road."""
    grid = GroundGrid.for_speed(25.0, rows=8, columns=16)
    u = [ground().project_components(jnp.full(2, x), grid.left[jnp.array([0, -1])])[0] for x in grid.ahead]
    widths = np.array([float(row[1] - row[0]) for row in u])
    np.testing.assert_allclose(widths * np.array(grid.ahead + 1.3 * np.tan(0.06)) / np.cos(0.06), 150 * 9.6, rtol=0.01)
    assert np.all(np.diff(grid.ahead) > 0)
    assert float(grid.column(grid.left)[5]) == pytest.approx(5.0, abs=1e-4)


def test_faster_looks_farther_without_a_new_program():
    traces = []

    @jax.jit
    def view(speed, picture):
        traces.append(None)
        return inverse_perspective(ground(), picture, GroundGrid.for_speed(speed, rows=8, columns=16)).grid.ahead

    slow, fast = (view(jnp.array(speed), jnp.asarray(smooth_picture())) for speed in (5.0, 30.0))
    assert fast[0] > slow[0] and fast[-1] > slow[-1] and len(traces) == 1


@pytest.mark.parametrize("roll, lens", [(0.0, None), (0.04, (-0.2, 0.05, 0.0, 0.0))])
def test_a_wrong_pitch_moves_rows_as_a_whole(x64, roll, lens):
    """The same pixel, seen by the camera as it is: exact with any roll and lens."""
    change = 0.01
    made = ground(0.06, roll, None if lens is None else LENS(jnp.array(lens)))
    grid = GroundGrid.between(4.0, 30.0, 6.0, rows=6, columns=8)
    view = inverse_perspective(made, jnp.asarray(smooth_picture(), jnp.float64), grid)
    ahead, scale = view.true_range(jnp.array(change))
    x, y = jnp.broadcast_to(grid.ahead[:, None], (6, 8)), jnp.broadcast_to(grid.left, (6, 8))
    true = eqx.tree_at(lambda g: g.pitch, made, made.pitch + change)
    there = true.to_ground_components(*made.project_components(x, y))
    np.testing.assert_allclose(there[0], np.broadcast_to(ahead[:, None], (6, 8)), rtol=1e-6)
    np.testing.assert_allclose(there[1], scale[:, None] * y, rtol=1e-6)


def test_what_is_not_in_the_picture_is_not_seen():
    picture = smooth_picture()
    whole = inverse_perspective(ground(), jnp.asarray(picture), GRID)
    broken = picture.copy()
    broken[72:78, 70:90] = np.nan
    view = inverse_perspective(ground(), jnp.asarray(broken), GRID)
    lost = np.array(whole.seen & ~view.seen)
    assert 0 < lost.sum() < 200 and bool(jnp.all(jnp.isfinite(view.image)))
    kept = np.array(view.seen)
    np.testing.assert_array_equal(np.array(view.image)[kept], np.array(whole.image)[kept])
    up = inverse_perspective(ground(pitch=-0.9), jnp.asarray(picture), GRID)
    assert not bool(up.seen.any()) and bool(jnp.all(up.image == 0.0))
    lost = inverse_perspective(ground(pitch=np.nan), jnp.asarray(picture), GRID)
    assert not bool(lost.seen.any()) and bool(jnp.all(jnp.isfinite(lost.image)))


def test_bytes_are_taken_and_shapes_are_checked():
    levels = np.clip(smooth_picture(), 0, 255).astype(np.uint8)
    view = inverse_perspective(ground(), jnp.asarray(levels), GRID)
    same = inverse_perspective(ground(), jnp.asarray(levels, jnp.float32), GRID)
    np.testing.assert_allclose(view.image, same.image, rtol=1e-5)
    with pytest.raises(ValueError, match="at least 2 and 4"):
        GroundGrid.between(5.0, 20.0, 6.0, rows=1, columns=8)


def test_coarser_views_keep_smooth_pictures_and_places():
    view = inverse_perspective(ground(), jnp.asarray(smooth_picture()), GRID)
    half = view.coarser()
    assert half.image.shape == (12, 24)
    np.testing.assert_allclose(half.grid.left, 0.5 * (GRID.left[::2] + GRID.left[1::2]), atol=1e-5)
    kernel = np.array([1.0, 3.0, 3.0, 1.0]) / 8.0
    expected = np.stack([np.convolve(row, kernel, "valid")[1::2] for row in np.array(view.image)[::2]])
    inner = np.array(half.seen)[:, 1:-1]
    np.testing.assert_allclose(np.array(half.image)[:, 1:-1][inner], expected[inner], rtol=1e-5)


def test_gradients_by_picture_and_pitch(x64):
    picture = jnp.asarray(smooth_picture(), jnp.float64)
    weights = jnp.asarray(np.random.default_rng(1).normal(size=(24, 48)))
    grid = GroundGrid.between(4.0, 30.0, 3.0, rows=24, columns=48)

    def total(picture, pitch):
        made = eqx.tree_at(lambda g: g.pitch, ground(), pitch)
        return jnp.sum(weights * inverse_perspective(made, picture, grid).image)

    pitch = jnp.array(0.06)
    by_picture, by_pitch = jax.grad(total, argnums=(0, 1))(picture, pitch)
    direction, step = jnp.asarray(smooth_picture(1), jnp.float64), 1e-6
    slope = (total(picture + step * direction, pitch) - total(picture - step * direction, pitch)) / (2 * step)
    np.testing.assert_allclose(jnp.sum(by_picture * direction), slope, rtol=1e-6)
    slope = (total(picture, pitch + step) - total(picture, pitch - step)) / (2 * step)
    np.testing.assert_allclose(by_pitch, slope, rtol=1e-4)


def test_dtype_is_kept(dtype):
    view = inverse_perspective(
        ground(dtype=dtype), jnp.asarray(smooth_picture(), dtype), jax.tree.map(lambda g: g.astype(dtype), GRID)
    )
    assert view.image.dtype == view.height.dtype == dtype
