"""T-88: boxes of the MOT challenge, read and written."""

import numpy as np
import pytest

from jaxloc.data.io.errors import DataError
from jaxloc.data.tracking import read_mot_detections, read_mot_tracks, write_mot


@pytest.fixture
def write(tmp_path):
    def write(text):
        path = tmp_path / "det.txt"
        path.write_text(text)
        return path

    return write


def test_detections(write):
    path = write(
        "3,-1,10,20,5,6,0.5,-1,-1,-1\n1 -1 1 2 3 4 0.2\n\n1,-1,1,2,3,4,nan\n1,-1,1,2,0,4,0.9\n1,-1,9,9,1,1,0.7\n"
    )
    found = read_mot_detections(path)
    assert found.frames.tolist() == [1, 2, 3] and found.valid.sum(axis=1).tolist() == [2, 0, 1]
    assert found.left_out.tolist() == [2, 0, 0] and found.scores[0].tolist() == [0.7, 0.2]
    assert found.boxes[2, 0].tolist() == [10.0, 20.0, 15.0, 26.0] and found.positions is None
    np.testing.assert_allclose(found.times, [0.0, 0.04, 0.08])


def test_tracks_written_are_read_again(write, tmp_path):
    path = write("1,7,10,20,5,6,1,-1,-1,-1\n1,8,1,2,3,4,0,1,0.5\n2,8,1.5,2,3,4.25,1,1,0.5\n")
    tracks = read_mot_tracks(path, num_frames=4)
    assert tracks.ids.tolist() == [[7], [8], [-1], [-1]]
    write_mot(tmp_path / "out.txt", tracks)
    again = read_mot_tracks(tmp_path / "out.txt", num_frames=4)
    np.testing.assert_array_equal(again.ids, tracks.ids)
    np.testing.assert_array_equal(again.detections.boxes, tracks.detections.boxes)


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("1,-1,1,2,3,4\n", "det.txt: line 1 has 6 numbers, needs 7 to 10"),
        ("1,1,1,2,3,4,1\nx,1,1,2,3,4,1\n", "line 2 holds something that is no number"),
        ("0,1,1,2,3,4,1\n", "line 1: 0 is no frame number"),
        ("1,-1,1,2,3,4,1\n", "line 1: -1 is no identity"),
        ("1,nan,1,2,3,4,1\n", "line 1: nan is no identity"),
        ("1,1,1,2,0,4,1\n", "line 1 holds .* box without area"),
        ("\n1,1,inf,2,3,4,1\n", "line 2 holds a number that is not finite"),
        ("1,1,1,2,3,4,1\n1,1,5,2,3,4,1\n", "line 2: identity 1 occurs twice in frame 1"),
    ],
)
def test_broken_lines_are_named(write, text, error):
    with pytest.raises(DataError, match=error):
        read_mot_tracks(write(text))


@pytest.mark.recordings
def test_a_recording(recordings):
    folder = recordings / "mot15_tud" / "TUD-Campus"
    found, truth = read_mot_detections(folder / "det.txt"), read_mot_tracks(folder / "gt.txt")
    assert len(found) == len(truth.detections) == 71
    assert found.valid.sum() == 321 - found.left_out.sum() and truth.detections.valid.sum() == 359
    assert len(truth.identities()) == 8
    # Results of a tracker score -1.
    assert read_mot_tracks(folder / "test.txt").detections.valid.sum() == 222


def scored(*scores):
    return "".join(f"{frame},-1,1,2,3,4,{score},-1,-1,-1\n" for frame, score in enumerate(scores, start=1))


@pytest.mark.parametrize(
    ("scores", "wanted"),
    [
        ((-1, -1), [1.0, 1.0]),
        ((-1, 0.5), [1.0, 0.5]),
        ((80.5, 20), [0.805, 0.2]),
        ((100, -1), [1.0, 1.0]),
        ((7, 7, 7), [1.0, 1.0, 1.0]),
        ((1.0005, 0.25), [1.0, 0.25]),
        ((0, 1), [0.0, 1.0]),
        (("nan", 90.0, 20.0), [0.0, 0.9, 0.2]),
    ],
)
def test_scores_are_probabilities(write, scores, wanted):
    found = read_mot_detections(write(scored(*scores)))
    np.testing.assert_allclose(found.scores[:, 0], wanted)


@pytest.mark.parametrize("scores", [(-2.5, 0.3), (0.5, 3.0), (150, 20), (-1, -0.5, 0.5)])
def test_raw_scores_are_named(write, scores):
    with pytest.raises(DataError, match=r"det.txt: scores lie between .* must lie in 0..1"):
        read_mot_detections(write(scored(*scores)))


def test_a_late_frame_does_not_fill_the_memory(write):
    with pytest.raises(DataError, match="line 61: 999999 frames of up to 60 rows are too many for 61 rows"):
        read_mot_detections(write("1,-1,1,2,3,4,0.5\n" * 60 + "999999,-1,1,2,3,4,0.5\n"))
    with pytest.raises(DataError, match="line 1: 1e.06 is no frame number"):
        read_mot_detections(write("1000000,-1,1,2,3,4,0.5\n"))
