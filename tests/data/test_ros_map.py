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


@pytest.mark.parametrize(
    ("line", "resolution", "x"),
    [
        ("origin: [-1e+03, 2.5, 0]", 0.1, -1000.0),
        ("origin: ['-1.5', \"2.5\", 1e-05]", 0.1, -1.5),
        ("origin: [.5, 5., 0]", 0.1, 0.5),
        ("origin: [+010, 2, 0]", 0.1, 10.0),
        ("resolution: 5e-2", 0.05, -1.0),
        ("resolution: '0.05'", 0.05, -1.0),
        ("resolution: 5E-2 # m", 0.05, -1.0),
        ("negate: '0'", 0.1, -1.0),
        ("negate: false", 0.1, -1.0),
        ("occupied_thresh: 6.5e-1", 0.1, -1.0),
    ],
)
def test_numbers_as_ros_writes_them(folder, line, resolution, x):
    kept = [old for old in YAML.splitlines() if old.split(":")[0] != line.split(":")[0]]
    (folder / "m.yaml").write_bytes("\r\n".join([*kept, line]).encode("utf-16"))
    grid = ros_map.read_map(folder / "m.yaml")
    assert float(grid.resolution) == pytest.approx(resolution) and float(grid.origin.x) == pytest.approx(x)


@pytest.mark.parametrize(
    "word", ["1_000", "true", "0x10", "1:30", "2001-01-01", "1e39", "-nan", "1e400", "9" * 400, "~", "''"]
)
def test_words_that_are_no_numbers(folder, word):
    for old in ("-1.0", "0.1\n"):
        (folder / "m.yaml").write_text(YAML.replace(old, word + "\n" * old.endswith("\n"), 1))
        with pytest.raises(DataError, match="must be a finite number") as error:
            ros_map.read_map(folder / "m.yaml")
        assert len(str(error.value)) < 200 + len(str(folder))


def write_alpha(folder, mode, negate=0):
    """Opaque black and white, transparent black and white, half transparent black."""
    gray, alpha = np.array([[0, 254, 0, 254, 0]], np.uint8), np.array([[255, 255, 0, 0, 128]], np.uint8)
    cv2.imwrite(str(folder / "m.png"), np.dstack([gray, gray, gray, alpha]))
    (folder / "m.yaml").write_text(YAML.replace("negate: 0", f"negate: {negate}") + f"mode: {mode}\n")
    grid = ros_map.read_map(folder / "m.yaml")
    return np.asarray(grid.occupied)[0].tolist(), np.asarray(grid.free)[0].tolist()


def test_opacity_is_that_of_the_map_server(folder):
    """nav2's map_io.cpp: what is not opaque is unknown in scale, opacity is a color of trinary, and raw ignores it."""
    black, white = [True, False, False, False, False], [False, True, False, False, False]
    assert write_alpha(folder, "scale") == (black, white)
    assert write_alpha(folder, "scale", negate=1) == (white, black)
    # Means of all four: 63.75 (occupied), 254.25 (free), 0 (occupied), 190.5 and 32.
    assert write_alpha(folder, "trinary") == ([True, False, True, False, True], white)
    assert write_alpha(folder, "raw") == ([False] * 5, [True, False, True, False, True])


def test_images_of_16_bits(folder):
    cv2.imwrite(str(folder / "m.png"), np.array([[0, 65535, 52685]], np.uint16))
    grid = ros_map.read_map(folder / "m.yaml")
    np.testing.assert_allclose(grid.probability, [[1.0, 0.0, 1 - 52685 / 65535]], atol=1e-6)


def test_an_origin_of_a_national_grid(folder, tmp_path):
    """Single precision cannot hold the origin: an offset is taken off, or the map is refused."""
    cv2.imwrite(str(folder / "m.png"), np.full((4, 6), 255, np.uint8))
    text = (folder / "m.yaml").read_text()
    line = next(line for line in text.splitlines() if line.startswith("origin"))
    (folder / "m.yaml").write_text(text.replace(line, "origin: [448262.35, 5411932.65, 0.1]"))
    offset = ros_map.read_offset(folder / "m.yaml")
    assert offset.tolist() == [448000.0, 5412000.0]
    grid = ros_map.read_map(folder / "m.yaml", offset=offset)
    np.testing.assert_allclose(grid.origin.translation, [262.35, -67.35], atol=1e-4)
    ros_map.write_map(tmp_path / "again.yaml", grid, offset=offset)
    assert "origin: [448262.35, 5411932.65, 0.1" in (tmp_path / "again.yaml").read_text()
    with pytest.raises(DataError, match=r"m.yaml: position \(448262.35, 5411932.65\) m is too large"):
        ros_map.read_map(folder / "m.yaml")
