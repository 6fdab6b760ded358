"""T-44, T-88: KITTI's tracking files: what is read, what is refused, and that detections lie on labels."""

import numpy as np
import pytest

from jaxloc.data.io.errors import DataError
from jaxloc.data.tracking import kitti_tracking
from jaxloc.data.tracking.kitti_tracking import (
    read_calibration,
    read_camera_poses,
    read_detections,
    read_kitti_tracking,
    read_labels,
)

CAR = "{frame} {id} {type} 0 0 -1.5 10 20 30 40 1.5 1.6 4.0 {x} 1.0 20.0 0.5"
DETECTION = "{frame},2,10,20,30,40,{score},1.5,1.6,4.0,{x},1.0,20.0,0.5,-1.5"


def label(frame=0, id=3, type="Car", x=2.0):
    return CAR.format(frame=frame, id=id, type=type, x=x)


def detection(frame=0, score=1.0, x=2.0):
    return DETECTION.format(frame=frame, score=score, x=x)


@pytest.fixture
def write(tmp_path):
    def write(*lines):
        path = tmp_path / "0000.txt"
        path.write_text("\n".join(lines) + "\n")
        return path

    return write


def test_labels_by_frame_and_by_identity(write):
    ignored = "0 -1 DontCare -1 -1 -10 1 2 3 4 -1000 -1000 -1000 -10 -1 -1 -1"
    path = write(ignored, label(2, 5), label(0, 3), "", label(0, 5, "Van", x=4.0), label(0, 9, "Cyclist"))
    tracks = read_labels(path, types=("Car", "Van"))
    found = tracks.detections
    assert found.valid.tolist() == [[True, True], [False, False], [True, False]]
    assert tracks.ids.tolist() == [[3, 5], [-1, -1], [5, -1]]
    assert [found.names[kind] for kind in found.types[0]] == ["Car", "Van"] and found.types[1, 0] == -1
    np.testing.assert_array_equal(found.camera[0], [[2.0, 1.0, 20.0], [4.0, 1.0, 20.0]])
    np.testing.assert_array_equal(found.sizes[2, 0], [1.5, 1.6, 4.0])
    np.testing.assert_allclose(found.headings[0], [0.5, 0.5])
    np.testing.assert_allclose(found.times, [0.0, 0.1, 0.2])
    assert tracks.identities().tolist() == [3, 5]
    slots, there = tracks.slots()
    assert there.tolist() == [[True, False, False], [True, False, True]] and slots[1].tolist()[0] == 1
    assert tracks.by_identity(found.positions)[1, :, 0].tolist() == [4.0, 0.0, 2.0]


def test_positions_in_the_world(write):
    poses = np.tile(np.eye(4), (2, 1, 1))
    # A camera that looks to the right of the first one, 10 m ahead of it.
    poses[1, :3] = [[0.0, 0.0, 1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 10.0]]
    found = read_detections(write(detection(0), detection(1)), poses=poses)
    np.testing.assert_allclose(found.positions[0, 0], [2.0, 1.0, 20.0])
    np.testing.assert_allclose(found.positions[1, 0], [20.0, 1.0, 8.0])
    # Turned by the rotation about y that takes x to -z, which is a quarter turn in this sense of headings.
    assert found.headings[1, 0] - found.headings[0, 0] == pytest.approx(np.pi / 2)


def test_detections_keep_the_highest_scores_and_count_the_others(write):
    path = write(detection(1, 0.2), detection(1, 0.9), detection(1, "nan"), detection(1, 0.5), detection(3, x="inf"))
    found = read_detections(path, num_frames=6, capacity=2)
    assert found.valid.sum(axis=1).tolist() == [0, 2, 0, 0, 0, 0]
    assert found.scores[1].tolist() == [0.9, 0.5] and found.left_out.tolist() == [0, 2, 0, 1, 0, 0]
    assert np.isfinite(found.positions).all() and len(found) == 6
    assert found.select(found.scores > 0.7).valid.sum() == 1


def test_a_sequence_without_poses(tmp_path):
    calibration = "".join(f"P{i}: 700 0 30 0 0 700 20 0 0 0 1 0\n" for i in range(4)) + "R_rect: 1 0 0 0 1 0 0 0 1\n"
    for name, text in (
        ("calib", calibration + "".join(f"Tr_{name}: 1 0 0 0 0 1 0 0 0 0 1 0\n" for name in ("velo_cam", "imu_velo"))),
        ("label_02", label(4)),
        ("det_pointrcnn_Car", detection(1)),
    ):
        (tmp_path / name).mkdir()
        (tmp_path / name / "0000.txt").write_text(text)
    sequence = read_kitti_tracking(tmp_path, "0000")
    assert sequence.poses is None and len(sequence.detections) == len(sequence.truth.detections) == 5


def test_files_without_rows(write):
    found = read_detections(write(""), num_frames=3)
    assert found.valid.shape == (3, 0) and found.positions.shape == (3, 0, 3)
    tracks = read_labels(write(""))
    assert tracks.ids.shape == (0, 0) and tracks.by_identity(tracks.detections.scores).shape == (0, 0)
    assert read_labels(write(""), num_frames=2).slots()[1].shape == (0, 2)


@pytest.mark.parametrize(
    ("lines", "error"),
    [
        ([detection(), "0,2,3"], "0000.txt: line 2 has 3 numbers, needs 15"),
        ([detection(x="car")], "line 1 holds something that is no number"),
        ([detection(), detection(frame=-1)], "line 2: -1 is no frame number"),
        ([detection(frame="nan")], "line 1: nan is no frame number"),
        ([detection(frame=1e12)], "is no frame number"),
        ([detection(frame=0.5)], "0.5 is no frame number"),
        ([detection().replace(",2,", ",7,", 1)], "line 1: 7 is no class"),
        ([detection(frame=9)], "line 1: frame 9 is beyond the last of 5 frames"),
    ],
)
def test_broken_detections_are_named(write, lines, error):
    with pytest.raises(DataError, match=error):
        read_detections(write(*lines), num_frames=5)


@pytest.mark.parametrize(
    ("lines", "error"),
    [
        ([label(), label()[:-4]], "0000.txt: line 2 has 16 words, needs 17"),
        ([label(x="nan")], "line 1 holds a number that is not finite"),
        ([label(type="Boat")], "line 1: Boat is an unknown type of object"),
        ([label(id=-1)], "line 1: -1 is no identity"),
        ([label(), label(1), label()], "line 3: identity 3 occurs twice in frame 0"),
    ],
)
def test_broken_labels_are_named(write, lines, error):
    with pytest.raises(DataError, match=error):
        read_labels(write(*lines))


def test_other_refusals(write, tmp_path):
    with pytest.raises(DataError, match="no such file"):
        read_detections(tmp_path / "none.txt")
    with pytest.raises(ValueError, match="Boat"):
        read_labels(write(label()), types=("Boat",))
    with pytest.raises(DataError, match="2 frames, but there are 1 poses"):
        read_detections(write(detection(1)), poses=np.eye(4)[None])
    with pytest.raises(DataError, match="has no line P0:"):
        read_calibration(write("P1: " + "1 " * 12))
    with pytest.raises(DataError, match="line 1 has 2 numbers, needs 9"):
        read_calibration(write("R_rect 1 2"))
    with pytest.raises(DataError, match="row 1 is no pose"):
        read_camera_poses(write("1 " * 12))
    with pytest.raises(DataError, match="no such folder"):
        read_kitti_tracking(tmp_path / "none", "0000")


@pytest.mark.recordings
def test_detections_lie_on_the_labels(recordings):
    """The figures of the recording's README: most cars are found, within 0.2 m."""
    sequence = read_kitti_tracking(recordings / "kitti_tracking_dev", "0012")
    truth, found = sequence.truth, sequence.detections.select(sequence.detections.scores > 0.0)
    assert len(found) == len(truth.detections) == len(sequence.poses) == 78
    gaps = np.linalg.norm(truth.detections.positions[:, :, None] - found.positions[:, None], axis=-1)
    gaps = np.where(found.valid[:, None], gaps, np.inf).min(axis=2)[truth.detections.valid]
    assert np.mean(gaps < 2.0) > 0.85 and np.median(gaps) < 0.2
    # Boxes are where the calibration says: the middle of an object projects into its box.
    camera = truth.detections.camera[truth.detections.valid]
    middle = camera - np.array([0.0, 0.8, 0.0])
    pixels = np.column_stack([middle, np.ones(len(middle))]) @ sequence.calibration.projections[2].T
    pixels = pixels[:, :2] / pixels[:, 2:]
    boxes = truth.detections.boxes[truth.detections.valid]
    inside = ((pixels > boxes[:, :2] - 2) & (pixels < boxes[:, 2:] + 2)).all(axis=1)
    assert inside.mean() > 0.9
    assert np.linalg.det(sequence.calibration.rectification) == pytest.approx(1.0, abs=1e-4)


@pytest.mark.recordings
def test_all_sequences_are_read(recordings):
    folder = recordings / "kitti_tracking_dev"
    cars = 0
    for path in sorted((folder / "label_02").iterdir()):
        sequence = read_kitti_tracking(folder, path.stem, types=kitti_tracking.TYPES)
        assert not sequence.detections.left_out.any()
        cars += (sequence.truth.detections.types == 0).sum()
    assert cars == 6848
