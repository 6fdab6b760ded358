import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxloc.data import tum
from jaxloc.data.io.errors import DataError
from jaxloc.poses import Trajectory


def test_reads_what_scipy_says(tmp_path, rng, dtype):
    rotations = Rotation.random(30, rng=rng)
    positions = rng.standard_normal((30, 3))
    stamps = 1.3e9 + np.cumsum(rng.uniform(0.01, 0.1, 30))
    path = tmp_path / "t.txt"
    np.savetxt(path, np.column_stack([stamps, positions, rotations.as_quat()]), fmt="%.9f", header="time x y z q")
    stamped = tum.read_trajectory(path)
    assert stamped.start == pytest.approx(stamps[0], abs=1e-6)
    assert stamped.trajectory.times.dtype == dtype
    np.testing.assert_allclose(stamped.trajectory.times, stamps - stamps[0], atol=1e-5)
    np.testing.assert_allclose(stamped.trajectory.matrices()[:, :3, :3], rotations.as_matrix(), atol=1e-6)
    np.testing.assert_allclose(stamped.trajectory.positions, positions, atol=1e-6)


def test_paths_survive_a_round_trip_also_at_half_turns(tmp_path, rng, x64):
    vectors = np.concatenate([np.pi * np.eye(3), np.zeros((1, 3)), rng.standard_normal((20, 3))])
    matrices = np.tile(np.eye(4), (len(vectors), 1, 1))
    matrices[:, :3, :3] = Rotation.from_rotvec(vectors).as_matrix()
    path = Trajectory.from_matrices(0.1 * jnp.arange(1.0, len(vectors) + 1), jnp.asarray(matrices))
    tum.write_trajectory(tmp_path / "t.txt", path, start=1000.0)
    again = tum.read_trajectory(tmp_path / "t.txt", start=1000.0)
    np.testing.assert_allclose(again.trajectory.matrices(), matrices, atol=1e-8)
    np.testing.assert_allclose(again.trajectory.times, path.times, atol=1e-9)


@pytest.mark.parametrize(
    "text, match",
    [
        ("", "has no poses"),
        ("0 0 0 0 0 0 1", "line 1 has 7 numbers, needs 8"),
        ("0 0 0 0 0 0 0 0", "row 1: the quaternion has length 0"),
        ("0 0 0 0 0 0 0 1\n0 0 0 0 0 0 0 1", "do not increase"),
        ("0 0 nan 0 0 0 0 1", "not finite"),
    ],
)
def test_bad_files_are_refused(tmp_path, text, match):
    path = tmp_path / "t.txt"
    path.write_text(text)
    with pytest.raises(DataError, match=match):
        tum.read_trajectory(path)


def test_large_coordinates_keep_their_shape(tmp_path, rng):
    """A path in a national grid: what single precision would round to half a meter is taken off in double precision."""
    positions = np.array([448262.123, 5411932.456, 300.0]) + np.cumsum(rng.normal(0.0, 0.05, (50, 3)), axis=0)
    rows = np.column_stack([np.arange(50.0), positions, np.tile([0.0, 0.0, 0.0, 1.0], (50, 1))])
    path = tmp_path / "a.tum"
    np.savetxt(path, rows, fmt="%.9f")
    stamped = tum.read_trajectory(path)
    assert stamped.offset == (448000.0, 5412000.0, 0.0)
    found = np.asarray(stamped.trajectory.positions, np.float64) + np.array(stamped.offset)
    np.testing.assert_allclose(found, positions, atol=1e-4)
    np.testing.assert_allclose(tum.planar_poses(stamped)[1][:, :2], positions[:, :2], atol=1e-4)
    tum.write_trajectory(tmp_path / "b.tum", stamped.trajectory, offset=stamped.offset)
    np.testing.assert_allclose(np.loadtxt(tmp_path / "b.tum")[:, 1:4], positions, atol=1e-4)
    other = tum.read_trajectory(path, offset=(448000.0, 5411000.0, 0.0))
    np.testing.assert_allclose(other.trajectory.length(), stamped.trajectory.length(), rtol=1e-4)
    with pytest.raises(DataError, match="too large to be held to a centimeter: read it with an offset such as"):
        tum.read_trajectory(path, offset=(0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="must be 3 finite numbers"):
        tum.read_trajectory(path, offset=(0.0, np.nan, 0.0))


def test_small_coordinates_are_as_in_the_file(tmp_path):
    (tmp_path / "a.tum").write_text("0 1500 -7000 3 0 0 0 1\n1 1501 -7000 3 0 0 0 1\n")
    stamped = tum.read_trajectory(tmp_path / "a.tum")
    assert stamped.offset == (0.0, 0.0, 0.0)
    np.testing.assert_array_equal(stamped.trajectory.positions[0], [1500.0, -7000.0, 3.0])


def test_double_precision_needs_no_offset(tmp_path, x64):
    (tmp_path / "a.tum").write_text("0 448262.123 5411932.456 3 0 0 0 1\n")
    stamped = tum.read_trajectory(tmp_path / "a.tum")
    assert stamped.offset == (0.0, 0.0, 0.0)
    np.testing.assert_allclose(stamped.trajectory.positions[0], [448262.123, 5411932.456, 3.0], rtol=1e-12)
