"""T-65: CLEAR MOT, IDF1 and HOTA against trackeval, on random tracks and on a recording."""

import numpy as np
import pytest

from jaxloc.evaluation.targets import mot_metrics
from jaxloc.evaluation.targets.mot_metrics import BoxOverlap, PointDistance, clear_mot, compare, hota, id_f1, join


def random_tracks(seed, frames=30, people=6, tracks=9):
    """People who walk at random, and tracks of them that drift, break and swap."""
    rng = np.random.default_rng(seed)
    truth = np.cumsum(rng.standard_normal((frames, people, 2)), axis=0) * 0.5 + rng.uniform(0, 12, (1, people, 2))
    source = rng.integers(0, people, (1, tracks)) * np.ones((frames, 1), int)
    source[frames // 2 :, :2] = source[frames // 2 :, 1::-1]
    found = np.take_along_axis(truth, source[..., None], axis=1) + 0.6 * rng.standard_normal((frames, tracks, 2))
    truth_valid, valid = rng.uniform(size=(frames, people)) < 0.8, rng.uniform(size=(frames, tracks)) < 0.6
    truth_valid[3], valid[4], truth_valid[5], valid[5] = False, False, False, False
    names = rng.permutation(50)
    ids = [np.tile(names[part], (frames, 1)) for part in (slice(people), slice(people, people + tracks))]
    return truth, ids[0], truth_valid, found, ids[1], valid


def as_boxes(points, size=(2.0, 3.0)):
    return np.concatenate([points, points + np.array(size)], axis=-1)


def overlap(a, b):
    """Intersection over union by loops."""
    table = np.zeros((len(a), len(b)))
    for i, j in np.ndindex(table.shape):
        width = min(a[i][2], b[j][2]) - max(a[i][0], b[j][0])
        height = min(a[i][3], b[j][3]) - max(a[i][1], b[j][1])
        shared = max(width, 0.0) * max(height, 0.0)
        table[i, j] = shared / (np.prod(a[i][2:] - a[i][:2]) + np.prod(b[j][2:] - b[j][:2]) - shared)
    return table


def of_trackeval(truth, truth_ids, truth_valid, found, ids, valid, similarity):
    """Results of the three metrics, from trackeval's own form of the data."""
    metrics = pytest.importorskip("trackeval.metrics")
    number = [{name: k for k, name in enumerate(np.unique(i[v]))} for i, v in ((truth_ids, truth_valid), (ids, valid))]
    data = {
        "num_timesteps": len(truth),
        "num_gt_ids": len(number[0]),
        "num_tracker_ids": len(number[1]),
        "num_gt_dets": int(truth_valid.sum()),
        "num_tracker_dets": int(valid.sum()),
        "gt_ids": [np.array([number[0][k] for k in i[v]], int) for i, v in zip(truth_ids, truth_valid, strict=True)],
        "tracker_ids": [np.array([number[1][k] for k in i[v]], int) for i, v in zip(ids, valid, strict=True)],
        "similarity_scores": [
            similarity(a[v], b[w]) for a, v, b, w in zip(truth, truth_valid, found, valid, strict=True)
        ],
    }
    quiet = {"PRINT_CONFIG": False}
    found = metrics.HOTA(), metrics.CLEAR(quiet), metrics.Identity(quiet)
    return [metric.eval_sequence(data) for metric in found]


def check_equal(tracks, expected):
    ours, (theirs, clear, identity) = hota(tracks), expected
    for name, other in (("hota", "HOTA"), ("det_a", "DetA"), ("ass_a", "AssA"), ("loc_a", "LocA")):
        np.testing.assert_allclose(getattr(ours, name), theirs[other], atol=1e-9)
        assert float(getattr(ours.mean(), name)) == pytest.approx(np.mean(theirs[other]), abs=1e-9)
    ours = clear_mot(tracks)
    names = {
        "mota": "MOTA",
        "motp": "MOTP",
        "true_positives": "CLR_TP",
        "false_positives": "CLR_FP",
        "misses": "CLR_FN",
        "switches": "IDSW",
        "fragmentations": "Frag",
        "mostly_tracked": "MT",
        "mostly_lost": "ML",
    }
    for name, other in names.items():
        assert getattr(ours, name) == pytest.approx(clear[other], abs=1e-9), name
    ours = id_f1(tracks)
    for name, other in (("f1", "IDF1"), ("precision", "IDP"), ("recall", "IDR")):
        assert getattr(ours, name) == pytest.approx(identity[other], abs=1e-9)


@pytest.mark.parametrize("seed", range(6))
def test_random_boxes(seed):
    truth, truth_ids, truth_valid, found, ids, valid = random_tracks(seed)
    data = as_boxes(truth), truth_ids, truth_valid, as_boxes(found), ids, valid
    tracks = compare(*data, similarity=BoxOverlap())
    check_equal(tracks, of_trackeval(*data, overlap))


def test_points_in_space():
    data = random_tracks(11)
    tracks = compare(*data, similarity=PointDistance(2.0))

    def near(a, b):
        gaps = [[max(1.0 - np.hypot(*(p - q)) / 2.0, 0.0) for q in b] for p in a]
        return np.array(gaps).reshape(len(a), len(b))

    check_equal(tracks, of_trackeval(*data, near))
    assert clear_mot(tracks).switches > 0


def test_sequences_one_after_the_other():
    """As trackeval combines them."""
    metrics = pytest.importorskip("trackeval.metrics")
    data = [random_tracks(seed) for seed in (1, 2)]
    near = PointDistance(2.0).between
    results = [of_trackeval(*each, near) for each in data]
    quiet = {"PRINT_CONFIG": False}
    makers = metrics.HOTA(), metrics.CLEAR(quiet), metrics.Identity(quiet)
    combined = [
        maker.combine_sequences({str(k): result[place] for k, result in enumerate(results)})
        for place, maker in enumerate(makers)
    ]
    check_equal(join([compare(*each, similarity=PointDistance(2.0)) for each in data]), combined)


def test_nothing_there():
    truth, truth_ids, truth_valid, found, ids, valid = random_tracks(0)
    nobody = np.zeros_like(truth_valid)
    for data in (
        (truth, truth_ids, nobody, found, ids, valid),
        (truth, truth_ids, truth_valid, found, ids, np.zeros_like(valid)),
        (truth, truth_ids, nobody, found, ids, np.zeros_like(valid)),
    ):
        tracks = compare(*data, similarity=PointDistance(1.0))
        assert float(hota(tracks).mean().hota) == 0.0 and id_f1(tracks).f1 == 0.0
        assert clear_mot(tracks).true_positives == 0
    perfect = compare(truth, truth_ids, truth_valid, truth, truth_ids, truth_valid, similarity=PointDistance(1.0))
    assert float(hota(perfect).mean().hota) == pytest.approx(1.0) and clear_mot(perfect).mota == 1.0
    assert id_f1(perfect).f1 == 1.0


def test_bad_input():
    truth, truth_ids, truth_valid, found, ids, valid = random_tracks(0)
    found[~valid] = np.nan
    found[0, np.flatnonzero(valid[0])[0]] = np.inf
    tracks = compare(truth, truth_ids, truth_valid, found, ids, valid, similarity=PointDistance(1.0))
    assert np.isfinite(hota(tracks).hota).all()
    boxes = np.array([[0.0, 0.0, 0.0, 0.0], [0.0, 0.0, np.nan, 1.0], [0.0, 0.0, 1.0, 1.0]])
    np.testing.assert_array_equal(BoxOverlap().between(boxes, boxes), np.diag([0.0, 0.0, 1.0]))
    with pytest.raises(ValueError, match="twice in frame 0"):
        twice = np.zeros_like(ids)
        compare(truth, truth_ids, truth_valid, found, twice, np.ones_like(valid), similarity=PointDistance(1.0))


@pytest.mark.recordings
def test_a_recording(recordings):
    """The result file that comes with TUD-Campus."""
    sides = [padded(recordings / "mot15_tud" / "TUD-Campus" / name) for name in ("gt.txt", "test.txt")]
    data = (*sides[0], *sides[1])
    tracks = compare(*data, similarity=BoxOverlap())
    check_equal(tracks, of_trackeval(*data, overlap))
    assert isinstance(tracks, mot_metrics.Comparison) and 0.3 < float(hota(tracks).mean().hota) < 0.6


def padded(path):
    """Boxes, identities and mask of a file of 71 frames."""
    rows = np.loadtxt(path, delimiter=",")
    boxes, ids, valid = np.zeros((71, 10, 4)), np.zeros((71, 10), int), np.zeros((71, 10), bool)
    for row in rows:
        frame = int(row[0]) - 1
        slot = valid[frame].sum()
        boxes[frame, slot] = [row[2], row[3], row[2] + row[4], row[3] + row[5]]
        ids[frame, slot], valid[frame, slot] = row[1], True
    return boxes, ids, valid
