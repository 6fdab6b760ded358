import numpy as np
import pytest

from jaxloc.data.simulate.street.world import CAMERA_HEIGHT, Road, make_box, make_street


def test_the_road_is_the_integral_of_its_heading():
    road = Road(bend=0.25, period=160.0, begin=0.0, end=100.0)
    arcs = np.linspace(0.0, 90.0, 90001)
    x = np.trapezoid(np.sin(0.25 * np.sin(2 * np.pi * arcs / 160.0)), arcs)
    z = np.trapezoid(np.cos(0.25 * np.sin(2 * np.pi * arcs / 160.0)), arcs)
    pose = road.pose(90.0)
    np.testing.assert_allclose(pose[:3, 3], [x, CAMERA_HEIGHT, z], atol=1e-4)
    # Forward is the direction of travel, right is lateral, and a car that comes the other way looks back.
    ahead = road.pose(90.01)[:3, 3] - road.pose(89.99)[:3, 3]
    np.testing.assert_allclose(pose[:3, 2], ahead / np.linalg.norm(ahead), atol=1e-3)
    np.testing.assert_allclose(road.pose(90.0, 2.0)[:3, 3] - pose[:3, 3], 2.0 * pose[:3, 0], atol=1e-12)
    np.testing.assert_allclose(road.pose(90.0, turned=True)[:3, 2], -pose[:3, 2], atol=1e-12)
    np.testing.assert_allclose(road.pose(-5.0)[:3, 3][2], -5.0, atol=0.05)


def test_a_box_is_closed_and_its_sides_face_outwards(rng):
    size = np.array([1.8, 1.5, 4.3])
    box = make_box(tuple(size), 0, 1.0, rng)
    middle = np.array([0.0, -size[1] / 2.0, 0.0])
    centers = box.corner + 0.5 * (box.first + box.second)
    normals = np.cross(box.first, box.second)
    assert (np.sum(normals * (centers - middle), axis=1) > 0).all()
    areas = np.linalg.norm(normals, axis=1)
    expected = 2 * size[0] * size[1] + 2 * size[1] * size[2] + size[0] * size[2]
    assert areas.sum() == pytest.approx(expected)


def test_a_street_is_fixed_by_its_seed_and_movers_move():
    street, same, other = (make_street(seed, length=30.0, speed=10.0) for seed in (0, 0, 1))
    np.testing.assert_array_equal(street.fixed.corner, same.fixed.corner)
    assert street.fixed.corner.shape != other.fixed.corner.shape or not np.allclose(
        street.fixed.corner, other.fixed.corner
    )
    for mover in street.movers:
        now, then = mover.pose(street.road, 0.0), mover.pose(street.road, 1.0)
        travelled = np.linalg.norm(then[:3, 3] - now[:3, 3])
        assert travelled == pytest.approx(abs(mover.speed), rel=0.1)
        assert now[1, 3] == CAMERA_HEIGHT
