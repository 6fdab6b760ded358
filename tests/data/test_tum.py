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
