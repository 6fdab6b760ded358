"""The synthetic road: marks lie where the projection says, truth and motion agree, nothing aliases."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import jaxloc as jl
from jaxloc.data.simulate.road.drive import Course, drive
from jaxloc.data.simulate.road.geometry import ExactClothoid, SmallAngles
from jaxloc.data.simulate.road.rendering import Mark, Road, Shadows, render

SHAPE = (120, 160)
PLAIN = Road(marks=(Mark(1.8, gap=0.0), Mark(-1.8, gap=0.0)), streaks=(), shadows=None, grain=0.0)


def camera(lens=None, **angles):
    pinhole = jl.sensors.Pinhole(130.0, 130.0, 79.5, 50.0, lens=lens)
    return jl.sensors.GroundCamera(pinhole, 1.3, **({"pitch": 0.04} | angles))


def light_column(row, low, high):
    """Center of the light above the asphalt between two columns."""
    columns = np.arange(int(np.ceil(low)), int(high) + 1)
    weight = np.maximum(row[columns] - 106.0, 0.0)
    return float((weight * columns).sum() / weight.sum())


@pytest.mark.parametrize(
    "lane, ground",
    [
        (jl.lanes.Lane(0.3, 0.01, 2e-3), camera()),
        (jl.lanes.Lane(-0.2, -0.02, -1e-3, 2e-5), camera(roll=0.03)),
        (jl.lanes.Lane(0.1, 0.0, 0.0), camera(jl.sensors.BrownConrady((-0.2, 0.05, 0.0, 0.0)))),
    ],
)
def test_marks_lie_where_the_projection_says(lane, ground):
    image = render(PLAIN, lane, ground, shape=SHAPE, noise=0.0)
    # The border as a curve in the image, and its column in some rows.
    x = jnp.linspace(2.0, 40.0, 4000)
    for side in (1.8, -1.8):
        border = lane.center(x) + side
        u, v = (np.asarray(part) for part in ground.project_components(x, border))
        for row in (70, 80, 90):
            column = np.interp(row, v[::-1], u[::-1])
            if 6 < column < SHAPE[1] - 7:
                assert abs(light_column(image[row], column - 5, column + 5) - column) < 0.15


def test_exact_geometry_is_that_of_a_circle():
    # On a circle the distance to the center line is a difference of radii.
    lane, radius = jl.lanes.Lane(0.4, 0.05, 4e-3), 250.0
    x, y = np.array([5.0, 30.0, 80.0], np.float32), np.array([1.0, -2.0, 12.0], np.float32)
    turned = np.exp(0.05j) * (x + 1j * y) + 0.4j - 1j * radius
    s, n = ExactClothoid().place(lane, x, y)
    np.testing.assert_allclose(n, radius - np.abs(turned), atol=2e-4)
    np.testing.assert_allclose(s, radius * (np.angle(turned) + np.pi / 2), atol=2e-3)


def test_exact_geometry_of_a_clothoid_agrees_with_dense_integration():
    lane, s = jl.lanes.Lane(0.0, 0.0, 1e-3, 4e-5), np.linspace(0.0, 100.0, 100_001)
    angle = 1e-3 * s + 2e-5 * s**2
    step = (np.exp(1j * angle[1:]) + np.exp(1j * angle[:-1])) * 0.5 * (s[1] - s[0])
    center = np.concatenate([[0.0], np.cumsum(step)])
    point = (center + 1.5j * np.exp(1j * angle))[[20_000, 70_000]]
    found = ExactClothoid().place(lane, point.real.astype(np.float32), point.imag.astype(np.float32))
    np.testing.assert_allclose(found, [[20.0, 70.0], [1.5, 1.5]], atol=1e-3)


def test_small_angles_are_near_the_exact_geometry():
    lane = jl.lanes.Lane(0.3, 0.01, 1e-3)
    x, y = np.array([5.0, 20.0, 50.0], np.float32), np.array([0.5, -1.0, 2.0], np.float32)
    simple, exact = (np.stack(g.place(lane, x, y)) for g in (SmallAngles(), ExactClothoid()))
    assert np.abs(simple - exact)[1].max() < 0.01 and np.abs(simple - exact)[0].max() < 0.2


def test_dashes_cover_their_share_at_any_distance():
    mark, s = Mark(0.0, dash=3.0, gap=9.0), np.linspace(0.0, 120.0, 4801)[:-1].astype(np.float32)
    for along in (0.01, 5.0, 40.0):
        cover = mark.cover(s, np.zeros_like(s), np.full_like(s, along), np.full_like(s, 0.05))
        assert cover.mean() == pytest.approx(0.25, abs=2e-3)
    assert np.ptp(cover) < 0.15, "far away dashes become a gray line"


def test_shadows_darken_stretches_of_the_road():
    s, ones = np.linspace(0.0, 500.0, 20_001).astype(np.float32), np.ones(20_001, np.float32)
    road = Road(marks=(), streaks=(), grain=0.0, shadows=Shadows(spacing=25.0, length=4.0, gain=0.5))
    gray = road.shade(s, 0.0 * s, 0.02 * ones, 0.02 * ones)
    assert gray.max() == pytest.approx(105.0, abs=0.1) and gray.min() < 55.0
    assert 0.08 < np.mean(gray < 80.0) < 0.25
    blurred = road.shade(s, 0.0 * s, 200.0 * ones, 0.02 * ones)
    assert np.ptp(blurred) < 0.25 * np.ptp(gray)


def test_pictures_are_deterministic_and_marks_can_be_left_out():
    lane, ground = jl.lanes.Lane(0.0, 0.0, 0.0), camera()
    first, again, bare = (render(r, lane, ground, shape=SHAPE) for r in (Road(), Road(), Road().without_marks()))
    np.testing.assert_array_equal(first, again)
    assert first.dtype == np.float32 and first.min() >= 0.0 and first.max() <= 255.0
    assert first[60:].max() > 150.0 > bare[60:].max()
    other = render(Road(seed=1), lane, ground, shape=SHAPE)
    assert np.abs(other - first)[60:].mean() > 3.0


def test_a_road_turns_into_another():
    new = Road(asphalt=60.0, marks=(), streaks=(), shadows=None, grain=0.0)
    road = Road(marks=(), streaks=(), shadows=None, grain=0.0)
    s, thin = np.array([0.0, 99.0, 110.0, 121.0, 300.0], np.float32), np.full(5, 0.01, np.float32)
    slow = road.followed_by(new, 100.0, 20.0).shade(s, 0.0 * s, thin, thin)
    np.testing.assert_allclose(slow, [105.0, 105.0, 82.5, 60.0, 60.0], atol=0.1)
    assert road.followed_by(new, 100.0).shade(s, 0.0 * s, thin, thin)[2] == pytest.approx(60.0, abs=0.1)


def test_the_truth_of_a_drive_agrees_with_its_motion():
    trip = drive(Road(), camera(), 200, course=Course(speed=25.0, interval=0.02), shape=SHAPE)
    advance = eqx.filter_jit(jl.lanes.Lane.advance)
    for index in range(0, 199, 20):
        moved = advance(trip.lane(index), jnp.array(25.0 * 0.02), jnp.array(0.02 * float(trip.yaw_rates[index])))
        found = [float(v) for v in (moved.offset, moved.heading, moved.curvature)]
        np.testing.assert_allclose(found, trip.lanes[index + 1, :3], atol=2e-4)
    assert len(trip) == 200 and np.ptp(trip.pitches) > 0.005
    assert trip.frame(3).shape == SHAPE and not np.array_equal(trip.frame(3), trip.frame(4))
    assert float(trip.camera(7).pitch) == pytest.approx(trip.pitches[7])
