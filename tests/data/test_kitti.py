"""T-44: the KITTI reader, and every way in which its input can be wrong."""

import shutil

import cv2
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.data import kitti
from jaxloc.data.io.errors import DataError
from jaxloc.poses import Trajectory

P0 = "P0: 700 0 30 0 0 700 20 0 0 0 1 0"
P1 = "P1: 700 0 30 -350 0 700 20 0 0 0 1 0"


def write_sequence(root, count=3, size=(40, 60), folders=("image_0", "image_1"), color=False):
    rng = np.random.default_rng(0)
    folder = root / "sequences" / "07"
    for name in folders:
        (folder / name).mkdir(parents=True)
        for index in range(count):
            shape = (*size, 3) if color else size
            cv2.imwrite(str(folder / name / f"{index:06d}.png"), rng.integers(0, 256, shape, dtype=np.uint8))
    (folder / "calib.txt").write_text(f"{P0}\n{P1}\nTr: 1 2 3\n")
    (folder / "times.txt").write_text("".join(f"{0.1 * index:e}\n" for index in range(count)))
    return folder


@pytest.fixture
def folder(tmp_path):
    return write_sequence(tmp_path)


def write_truth(folder, rows):
    path = folder.parent.parent / "poses" / "07.txt"
    path.parent.mkdir(exist_ok=True)
    path.write_text("".join(row + "\n" for row in rows))
    return path


def straight(count):
    """KITTI rows of poses one meter apart along z."""
    return [f"1.0 0 0 0 0 1 0 0 0 0 1 {z}" for z in range(count)]


def test_reads_a_sequence(folder, tmp_path):
    sequence = kitti.read_sequence(folder)
    assert sequence.name == "07" and len(sequence) == 3 and sequence.truth is None
    assert float(sequence.rig.baseline) == 0.5 and float(sequence.rig.camera.fx) == 700.0
    assert (float(sequence.rig.camera.cx), float(sequence.rig.camera.cy)) == (30.0, 20.0)
    frames = list(sequence)
    assert [frame.time for frame in frames] == pytest.approx([0.0, 0.1, 0.2])
    expected = cv2.imread(str(folder / "image_1" / "000002.png"), cv2.IMREAD_GRAYSCALE)
    np.testing.assert_array_equal(sequence[-1].right, expected)
    with pytest.raises(IndexError):
        sequence[3]
    done = []
    sequence.verify(done.append)
    assert done == [1, 2, 3]


def test_finds_true_poses_or_takes_the_given_ones(folder, tmp_path):
    write_truth(folder, straight(3))
    np.testing.assert_allclose(kitti.read_sequence(folder).truth.positions[:, 2], [0.0, 1.0, 2.0])
    other = tmp_path / "mine.txt"
    other.write_text("\n".join(straight(3)[::-1]))
    np.testing.assert_allclose(kitti.read_sequence(folder, other).truth.positions[:, 2], [2.0, 1.0, 0.0])


def test_color_folders_serve_where_gray_ones_are_missing(tmp_path):
    folder = write_sequence(tmp_path, folders=("image_2", "image_3"), color=True)
    # The left camera of the color pair stands 0.06 m from the origin of the rig.
    (folder / "calib.txt").write_text(
        P0.replace("P0", "P2").replace("30 0 0", "30 42 0") + "\n" + P1.replace("P1", "P3")
    )
    sequence = kitti.read_sequence(folder)
    assert float(sequence.rig.baseline) == pytest.approx(0.56)
    assert sequence[0].left.ndim == 2


def refused(folder, match, poses=None):
    with pytest.raises(DataError, match=match) as caught:
        kitti.read_sequence(folder, poses)
    assert "\n" not in str(caught.value)


def test_missing_parts_are_named(folder, tmp_path):
    refused(tmp_path / "nowhere", "nowhere: no such folder")
    refused(tmp_path, "has no image folders")
    refused(folder, "mine.txt: no such file", poses=tmp_path / "mine.txt")
    for name, match in (("times.txt", "times.txt: no such file"), ("calib.txt", "calib.txt: no such file")):
        (folder / name).rename(folder / "aside")
        refused(folder, match)
        (folder / "aside").rename(folder / name)
    (folder / "image_1" / "000001.png").unlink()
    refused(folder, r"image_1.000001.png: no such image")
    shutil.rmtree(folder / "image_1")
    refused(folder, "image_1: no such folder")


def test_an_empty_sequence_is_refused(tmp_path):
    refused(write_sequence(tmp_path, count=0), "image_0: empty sequence")


def test_sizes_that_differ_are_refused(folder):
    cv2.imwrite(str(folder / "image_1" / "000001.png"), np.zeros((40, 61), np.uint8))
    refused(folder, r"image_1.000001.png: is 61x40 px, but 000000.png is 60x40 px")


def test_a_truncated_image_is_refused_before_anything_is_decoded(folder):
    path = folder / "image_0" / "000002.png"
    path.write_bytes(path.read_bytes()[:-20])
    refused(folder, r"000002.png: truncated PNG image")


def test_an_image_damaged_inside_is_found_by_verify(folder):
    path = folder / "image_1" / "000002.png"
    data = bytearray(path.read_bytes())
    data[200] ^= 1
    path.write_bytes(bytes(data))
    sequence = kitti.read_sequence(folder)
    with pytest.raises(DataError, match=r"image_1.000002.png: damaged"):
        sequence.verify()


@pytest.mark.parametrize(
    "text, match",
    [
        (P0, "has no line P1:"),
        (P1, "has no line P0:"),
        (f"{P0}\n{P1} 5", "line 2 has 13 numbers, needs 12"),
        (f"{P0}\n{P1}".replace("-350", "nan"), "line 2 holds a number that is not finite"),
        (f"{P0}\n{P1}".replace("-350", "x"), "line 2 holds something that is no number"),
        (f"{P0}\n{P1}".replace("-350", "350"), "baseline .* is -0.5 m, must be positive"),
        (f"{P0}\n{P1}".replace("-350", "0"), "must be positive"),
        (f"{P0}\n{P1}".replace("700", "-700"), "focal lengths"),
        (f"{P0}\n{P1}".replace("P1: 700", "P1: 710"), "rectified pair"),
        (f"{P0.replace('P0: 700 0', 'P0: 700 5')}\n{P1}", "rectified pair"),
    ],
)
def test_a_bad_calibration_is_refused(folder, text, match):
    (folder / "calib.txt").write_text(text)
    refused(folder, f"calib.txt: .*{match}")


@pytest.mark.parametrize(
    "text, match",
    [
        ("0\n0.1\n", "has 2 times for 3 images"),
        ("0\n0.1\n0.2\n0.3\n", "has 4 times for 3 images"),
        ("0\n0.1\ninf\n", "not finite"),
        ("0\n0.2\n0.1\n", "do not increase"),
        ("0\n0.1 7\n0.2\n", "line 2 has 2 numbers"),
        ("", "has 0 times"),
    ],
)
def test_bad_times_are_refused(folder, text, match):
    (folder / "times.txt").write_text(text)
    refused(folder, f"times.txt: .*{match}")


def test_bad_poses_are_refused(folder):
    write_truth(folder, straight(2))
    refused(folder, "07.txt: has 2 poses for 3 frames")
    write_truth(folder, [*straight(2), straight(1)[0].replace("1.0", "2.0")])
    refused(folder, "row 3 is no pose")
    write_truth(folder, [])
    refused(folder, "has no poses")
    write_truth(folder, straight(3)).write_bytes(b"\xff\xfe\x00\xd8")
    refused(folder, "is no text file")


def test_poses_survive_a_round_trip(tmp_path, rng, dtype):
    from scipy.spatial.transform import Rotation

    matrices = np.tile(np.eye(4), (20, 1, 1))
    matrices[:, :3, :3] = Rotation.random(20, rng=rng).as_matrix()
    matrices[:, :3, 3] = 100.0 * rng.standard_normal((20, 3))
    path = Trajectory.from_matrices(jnp.arange(20.0), jnp.asarray(matrices))
    kitti.write_poses(tmp_path / "p.txt", path)
    again = kitti.read_poses(tmp_path / "p.txt")
    assert again.times.dtype == dtype and again.positions.dtype == dtype
    np.testing.assert_allclose(again.matrices(), path.matrices(), rtol=1e-6, atol=1e-7)
    # The format is that of np.savetxt of the upper three rows.
    np.testing.assert_allclose(np.loadtxt(tmp_path / "p.txt").reshape(-1, 3, 4), path.matrices()[:, :3], atol=1e-6)


@pytest.mark.recordings
def test_reads_real_sequences(recordings):
    sequence = kitti.read_sequence(recordings / "kitti_odometry" / "sequences" / "06")
    assert len(sequence) == 31 and len(sequence.truth) == 31
    assert sequence[0].left.shape == (370, 1226)
    assert float(sequence.rig.baseline) == pytest.approx(0.5371506, abs=1e-6)
    assert float(sequence.truth.length()) == pytest.approx(36.0, abs=1.0)
    sequence.verify()


def test_poses_in_a_national_grid(tmp_path):
    place = np.array([448262.123, 5411932.456, 300.0])
    rows = [" ".join(f"{v:.4f}" for v in np.column_stack([np.eye(3), place + [k, 0.0, 0.0]]).ravel()) for k in range(3)]
    (tmp_path / "p.txt").write_text("\n".join(rows) + "\n")
    with pytest.raises(DataError, match="read it with an offset such as"):
        kitti.read_poses(tmp_path / "p.txt")
    path = kitti.read_poses(tmp_path / "p.txt", offset=place.tolist())
    np.testing.assert_allclose(path.positions, [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]], atol=1e-6)
