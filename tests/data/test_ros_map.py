"""Maps of the ROS map server: conventions, round trip, and what is refused."""

import cv2
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.data import DataError, ros_map
from jaxloc.poses import SE2
from jaxloc.sensors import OccupancyMap

YAML = "image: m.png\nresolution: 0.1\norigin: [-1.0, 2.0, 0.0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"


@pytest.fixture
def folder(tmp_path):
    image = np.full((4, 6), 254, np.uint8)
    image[0, 0] = 0  # the top left pixel: the largest y, the smallest x
    image[3, 5] = 205
    cv2.imwrite(str(tmp_path / "m.png"), image)
    (tmp_path / "m.yaml").write_text(YAML)
    return tmp_path


def test_the_first_row_of_the_image_is_the_top(folder):
    grid = ros_map.read_map(folder / "m.yaml")
    assert grid.probability.shape == (4, 6) and grid.probability.dtype == jnp.float32
    assert np.argwhere(np.asarray(grid.occupied)).tolist() == [[3, 0]]
    assert int(grid.free.sum()) == 22 and not grid.free[0, 5]
    # The wall's center: x = -1 + half a cell, y = 2 + three and a half.
    np.testing.assert_allclose(grid.to_world(jnp.array([[0.0, 3.0]]))[0], [-0.95, 2.35], atol=1e-6)


@pytest.mark.parametrize("extra, occupied", [("negate: 1\n", 22), ("mode: scale\n", 1), ("mode: raw\n", 0)])
def test_modes(folder, extra, occupied):
    lines = [line for line in YAML.splitlines() if not line.startswith(extra.split(":")[0])]
    (folder / "m.yaml").write_text("\n".join(lines) + "\n" + extra)
    # Negated, gray 205 is occupied too (0.8); raw, all above 100 is unknown and 0 is free.
    assert int(ros_map.read_map(folder / "m.yaml").occupied.sum()) in (occupied, occupied + 1)


def test_maps_make_the_round_trip(tmp_path, rng):
    probability = rng.choice([0.0, 0.5, 1.0], (7, 9)).astype(np.float32)
    grid = OccupancyMap(jnp.asarray(probability), 0.05, SE2(1.0, -2.0, 0.5))
    ros_map.write_map(tmp_path / "b.yaml", grid)
    again = ros_map.read_map(tmp_path / "b.yaml")
    np.testing.assert_array_equal(again.occupied, grid.occupied)
    np.testing.assert_array_equal(again.free, grid.free)
    assert float(again.resolution) == pytest.approx(0.05) and float(again.origin.theta) == pytest.approx(0.5)
    np.testing.assert_allclose(again.origin.translation, [1.0, -2.0])


def test_color_images(folder):
    image = np.full((4, 6, 4), 255, np.uint8)
    image[1, 2] = (0, 0, 0, 255)
    cv2.imwrite(str(folder / "m.png"), image)
    assert np.argwhere(np.asarray(ros_map.read_map(folder / "m.yaml").occupied)).tolist() == [[2, 2]]


@pytest.mark.parametrize(
    "old, new, match",
    [
        ("m.png", "other.png", r"other.png: no such image"),
        ("m.png", "m.yaml", r"m.yaml: is no image"),
        ("image: m.png\n", "", r"m.yaml: has no image"),
        ("resolution: 0.1", "resolution: 0", r"resolution is 0, must be positive"),
        ("resolution: 0.1", "resolution: -1", r"resolution is -1, must be positive"),
        ("resolution: 0.1", "resolution: .nan", r"resolution is nan, must be a finite number"),
        ("resolution: 0.1", "resolution: fine", r"resolution is 'fine', must be a finite number"),
        ("resolution: 0.1\n", "", r"resolution is None"),
        ("[-1.0, 2.0, 0.0]", "[-1.0]", r"origin is \[-1.0\], must be \[x, y, heading\]"),
        ("[-1.0, 2.0, 0.0]", "[-1.0, .inf, 0.0]", r"origin is inf"),
        ("[-1.0, 2.0, 0.0]", "here", r"origin is 'here'"),
        ("0.65", "0.1", r"free_thresh < occupied_thresh"),
        ("negate: 0", "negate: 7", r"negate is 7, must be 0 or 1"),
        ("negate: 0", "mode: other", r"mode is 'other'"),
        (YAML, "[1, 2]", r"is no map"),
        (YAML, "a: [", r"no valid YAML"),
        (YAML, "", r"is no map"),
    ],
)
def test_bad_maps_are_refused(folder, old, new, match):
    (folder / "m.yaml").write_text(YAML.replace(old, new))
    with pytest.raises(DataError, match=match) as error:
        ros_map.read_map(folder / "m.yaml")
    assert "\n" not in str(error.value)


def test_missing_and_damaged_files(folder):
    with pytest.raises(DataError, match="no such file"):
        ros_map.read_map(folder / "none.yaml")
    (folder / "m.png").write_bytes((folder / "m.png").read_bytes()[:40])
    with pytest.raises(DataError, match="is no image"):
        ros_map.read_map(folder / "m.yaml")
    (folder / "m.png").write_bytes(b"")
    with pytest.raises(DataError, match="is no image"):
        ros_map.read_map(folder / "m.yaml")
