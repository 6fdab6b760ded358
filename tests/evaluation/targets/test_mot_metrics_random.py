"""Tracking metrics on many small random scenes, with empty frames and sides, against three other implementations."""

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from jaxloc.evaluation.targets.mot_metrics import Comparison, clear_mot, hota, id_f1

FEW, MANY = 150, 1000
CLEAR = {
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
IDENTITY = {"f1": "IDF1", "precision": "IDP", "recall": "IDR"}
HOTA = {"hota": "HOTA", "det_a": "DetA", "ass_a": "AssA", "loc_a": "LocA"}


def in_numbers(frames):
    """Identities as numbers from 0."""
    names = np.unique(np.concatenate([np.zeros(0, int), *frames]))
    return tuple(np.searchsorted(names, frame) for frame in frames), len(names)


def scene(seed, unambiguous=False):
    """Up to five objects and five tracks in up to eight frames; similarities without ties."""
    rng = np.random.default_rng(seed)
    frames, objects, tracks = rng.integers(1, 9), rng.integers(0, 6), rng.integers(0, 6)
    sides = []
    for size, share in zip((objects, tracks), rng.choice([0.0, 0.3, 0.7, 1.0], 2, p=[0.1, 0.2, 0.4, 0.3]), strict=True):
        here = rng.uniform(size=(frames, size)) < share
        here[rng.integers(frames, size=rng.integers(0, 3))] = False
        sides.append([np.flatnonzero(row) for row in here])
    similarity = rng.uniform(size=(frames, objects, tracks))
    similarity *= rng.uniform(size=similarity.shape) < rng.choice([0.0, 0.3, 0.8, 1.0])
    if unambiguous:
        kept = np.zeros_like(similarity)
        for frame in range(frames):
            pairs = zip(rng.permutation(objects), rng.permutation(tracks), strict=False)
            for pair in pairs:
                kept[frame][pair] = similarity[frame][pair]
        similarity = kept
    shown = tuple(table[np.ix_(*pair)] for table, *pair in zip(similarity, *sides, strict=True))
    (truth_ids, num_truth), (ids, num_found) = (in_numbers(side) for side in sides)
    return Comparison(truth_ids, ids, shown, num_truth, num_found)


def of_trackeval(tracks):
    metrics = pytest.importorskip("trackeval.metrics")
    data = {
        "num_timesteps": len(tracks.ids),
        "num_gt_ids": tracks.num_truth,
        "num_tracker_ids": tracks.num_found,
        "num_gt_dets": sum(len(frame) for frame in tracks.truth_ids),
        "num_tracker_dets": sum(len(frame) for frame in tracks.ids),
        "gt_ids": list(tracks.truth_ids),
        "tracker_ids": list(tracks.ids),
        "similarity_scores": list(tracks.similarity),
    }
    quiet = {"PRINT_CONFIG": False}
    makers = metrics.HOTA(), metrics.CLEAR(quiet), metrics.Identity(quiet)
    return {name: value for maker in makers for name, value in maker.eval_sequence(data).items()}


def assigned(worth):
    rows, columns = linear_sum_assignment(-worth)
    return [(i, j) for i, j in zip(rows, columns, strict=True) if worth[i, j] > 0]


def by_loops(tracks):
    """The definitions, one event at a time."""
    frames = [
        {(i, j): s[a, b] for a, i in enumerate(one) for b, j in enumerate(other)} for one, other, s in tracks if s.size
    ]
    sizes = [sum(len(frame) for frame in side) for side in (tracks.truth_ids, tracks.ids)]
    last, before, history = {}, {}, {i: [] for i in range(tracks.num_truth)}
    hits, switches, total = 0, 0, 0.0
    for frame in frames:
        worth = np.zeros((tracks.num_truth, tracks.num_found))
        for (i, j), value in frame.items():
            worth[i, j] = (value + 1000.0 * (before.get(i) == j)) * (value >= 0.5)
        before = dict(assigned(worth))
        switches += sum(last.get(i, j) != j for i, j in before.items())
        total += sum(frame[pair] for pair in before.items())
        hits, last = hits + len(before), {**last, **before}
        for i, past in history.items():
            past.append(i in before)
    seen = [sum(i in frame for frame in tracks.truth_ids) for i in history]
    shares = [sum(past) / count for past, count in zip(history.values(), seen, strict=True)]
    starts = [
        sum(now and not then for then, now in zip([False, *past], past, strict=False)) for past in history.values()
    ]
    common = np.zeros((tracks.num_truth, tracks.num_found))
    for frame in frames:
        for pair, value in frame.items():
            common[pair] += value >= 0.5
    identical = sum(common[pair] for pair in assigned(common))
    misses, false = sizes[0] - hits, sizes[1] - hits
    return {
        "MOTA": 1.0 - (misses + false + switches) / sizes[0] if sizes[0] else 0.0,
        "MOTP": total / hits if hits else 0.0,
        "CLR_TP": hits,
        "CLR_FP": false,
        "CLR_FN": misses,
        "IDSW": switches,
        "Frag": sum(max(count - 1, 0) for count in starts),
        "MT": sum(share > 0.8 for share in shares),
        "ML": sum(share < 0.2 for share in shares),
        "IDF1": identical / (0.5 * sum(sizes)) if sum(sizes) else 0.0,
        "IDP": identical / sizes[1] if sizes[1] else 0.0,
        "IDR": identical / sizes[0] if sizes[0] else 0.0,
    }


def check(tracks, expected, seed):
    for ours, names in ((clear_mot(tracks), CLEAR), (id_f1(tracks), IDENTITY), (hota(tracks), HOTA)):
        for name, other in names.items():
            if other in expected:
                np.testing.assert_allclose(getattr(ours, name), expected[other], atol=1e-9, err_msg=f"{other}, {seed}")


def test_definitions():
    for seed in range(FEW):
        tracks = scene(seed)
        check(tracks, by_loops(tracks), seed)


@pytest.mark.parametrize("count", [FEW, pytest.param(MANY, marks=pytest.mark.slow)])
def test_trackeval(count):
    pytest.importorskip("trackeval.metrics")
    for seed in range(count):
        tracks = scene(seed)
        expected = of_trackeval(tracks)
        check(tracks, expected, seed)
        check(tracks, {name: value for name, value in by_loops(tracks).items() if name in expected}, seed)


@pytest.mark.parametrize("count", [30, pytest.param(MANY, marks=pytest.mark.slow)])
@pytest.mark.filterwarnings("ignore")
def test_py_motmetrics(count):
    """Where its definitions are those of TrackEval: pairs that leave no choice, and ratios of something."""
    motmetrics = pytest.importorskip("motmetrics")
    names = {
        "num_switches": "IDSW",
        "mostly_tracked": "MT",
        "mostly_lost": "ML",
        "num_misses": "CLR_FN",
        "num_false_positives": "CLR_FP",
        "mota": "MOTA",
        "idf1": "IDF1",
        "idp": "IDP",
        "idr": "IDR",
    }
    for seed in range(count):
        tracks = scene(seed, unambiguous=True)
        events = motmetrics.MOTAccumulator(auto_id=True)
        for truth_ids, ids, similarity in tracks:
            gaps = np.where(similarity >= 0.5, 1.0 - similarity, np.nan)
            events.update(list(truth_ids), list(ids + tracks.num_truth), gaps)
        found = motmetrics.metrics.create().compute(events, metrics=[*names]).iloc[0]
        check(tracks, {other: found[name] for name, other in names.items() if np.isfinite(found[name])}, seed)


def test_an_empty_side_gives_finite_ratios():
    """False estimates without any truth: the ratios are zero, as TrackEval's."""
    ids = (np.arange(3), np.arange(2))
    tracks = Comparison((np.zeros(0, int),) * 2, ids, (np.zeros((0, 3)), np.zeros((0, 2))), 0, 3)
    found = clear_mot(tracks)
    assert (found.mota, found.motp, found.false_positives) == (0.0, 0.0, 5)
    check(tracks, by_loops(tracks), "empty truth")
