"""Tracks from ready detections, on KITTI's cars and MOT15's pedestrians where they lie beside the checkout.

GOSPA of places in the world: c = 5 m, p = 2, alpha = 2, the mean over frames. HOTA by distance in space:
``1 - d / 2 m``. The peer is a plain Kalman filter (filterpy) with global nearest neighbor (SciPy's assignment): of all
its settings the best counts, over all sequences, of each figure its own.
"""

import itertools
from collections.abc import Iterator
from pathlib import Path
from time import perf_counter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from filterpy.kalman import KalmanFilter
from scipy.optimize import linear_sum_assignment

import jaxloc as jl
from benchmarks.metric import ACCURACY, REPOSITORY, TIME, Metric
from jaxloc.data.tracking import KittiTracking, LabeledTracks
from jaxloc.evaluation import consistency
from jaxloc.evaluation.targets.mot_metrics import BoxOverlap, Comparison, PointDistance, clear_mot, compare, hota, id_f1

_DATA = REPOSITORY.parent / "shared" / "data"
_SEQUENCES = ("0000", "0001", "0004", "0006", "0010", "0012", "0014", "0018")
_CUTOFF, _REACH, _MATCHED = 5.0, 2.0, 2.0
_LIVES = ((3, 1), (3, 3), (5, 2))  # frames in a row that confirm, frames without a detection that end
_GATES = (1.5, 3.0)
_CUT = (3, 3), 3.0  # a life, and the score that detections need: better than the plain peer, which has no scores

Rows = list[tuple[np.ndarray, np.ndarray]]  # identities and places of each frame


def metrics(smoke: bool) -> Iterator[Metric]:
    """Figures; the table of sequences is printed."""
    kitti, campus = _DATA / "kitti_tracking_dev", _DATA / "mot15_tud" / "TUD-Campus"
    if kitti.is_dir():
        names = _SEQUENCES[-3:-1] if smoke else _SEQUENCES
        yield from _kitti([jl.data.tracking.read_kitti_tracking(kitti, name) for name in names])
    if campus.is_dir():
        yield from _mot(campus)


def _kitti(sequences: list[KittiTracking]) -> Iterator[Metric]:
    pipeline = jl.pipelines.detection_tracking
    table, squared = {}, []
    for name, strategy in pipeline.STRATEGIES.items():
        config = pipeline.Config(strategy())
        runs = [_run(sequence, config) for sequence in sequences]
        table[name] = np.array([_score(s, _rows(tracked)) for s, (tracked, _) in zip(sequences, runs, strict=True)])
        if name == "gmphd":
            squared = [_nees(s, tracked) for s, (tracked, _) in zip(sequences, runs, strict=True)]
            frames, seconds = sum(len(t) for t, _ in runs), sum(time for _, time in runs)
            yield Metric("detections.kitti.frames_per_second", frames / seconds, "1/s", "higher", TIME)
    settings = [(*life, gate, 0.0) for life, gate in itertools.product(_LIVES, _GATES)]
    settings += [(*_CUT[0], gate, _CUT[1]) for gate in _GATES]
    peer = {
        setting: np.array([_score(sequence, _track_plainly(sequence, *setting)) for sequence in sequences])
        for setting in settings
    }
    plain = {setting: scores for setting, scores in peer.items() if setting[-1] == 0.0}
    for label, some in (("gnn_kalman", plain), ("gnn_kalman_cut", peer)):
        best_gospa = min(some, key=lambda s: some[s][:, 0].mean())
        best_hota = max(some, key=lambda s: some[s][:, 1].mean())
        print(f"# {label}: best GOSPA with (hits, misses, gate, least score) {best_gospa}, best HOTA with {best_hota}")
        table[label] = np.column_stack([some[best_gospa][:, 0], some[best_hota][:, 1]])
    _print(sequences, table)
    for name, scores in table.items():
        watched = ACCURACY if name == "gmphd" else None
        yield Metric(f"detections.kitti.{name}.gospa", float(scores[:, 0].mean()), "m", "lower", watched)
        yield Metric(f"detections.kitti.{name}.hota", float(scores[:, 1].mean()), "", "higher", watched)
    yield from _consistency(np.concatenate(squared))


def _run(sequence: KittiTracking, config: Any) -> tuple[Any, float]:
    """The tracks, and the seconds that they took once compiled."""
    pipeline, found = jl.pipelines.detection_tracking, sequence.detections
    for _ in range(2):
        start = perf_counter()
        tracked = pipeline.track(
            found.positions, found.scores, found.valid, found.times, cameras=sequence.poses, config=config
        )
        seconds = perf_counter() - start
    return tracked, seconds


def _rows(tracked: Any) -> Rows:
    return [(ids[v], places[v]) for ids, places, v in zip(tracked.ids, tracked.places, tracked.valid, strict=True)]


def _score(sequence: KittiTracking, rows: Rows) -> tuple[float, float]:
    """GOSPA and HOTA."""
    truth = sequence.truth.detections
    shape = len(rows), max(16, max(len(ids) for ids, _ in rows))
    places, ids, valid = np.zeros((*shape, 3)), np.zeros(shape, int), np.zeros(shape, bool)
    for frame, (who, where) in enumerate(rows):
        places[frame, : len(who)], ids[frame, : len(who)], valid[frame, : len(who)] = where, who, True
    sets = (jnp.asarray(array, float if array.ndim == 3 else bool) for array in (places, valid))
    true = (jnp.asarray(array, float if array.ndim == 3 else bool) for array in (truth.positions, truth.valid))
    distance = _gospa(*sets, *true)
    pairs = compare(
        truth.positions, sequence.truth.ids, truth.valid, places, ids, valid, similarity=PointDistance(_REACH)
    )
    return float(distance.mean()), float(hota(pairs).mean().hota)


@jax.jit
def _gospa(x: Any, valid_x: Any, y: Any, valid_y: Any) -> Any:
    return jax.vmap(lambda *sets: jl.evaluation.gospa(*sets, cutoff=_CUTOFF))(x, valid_x, y, valid_y).distance


def _track_plainly(sequence: KittiTracking, hits: int, misses: int, gate: float, cut: float) -> Rows:
    """Kalman filters at constant velocity, the nearest neighbors of all, and counts for a life."""
    found, tracks, born, rows = sequence.detections, [], 0, []
    for frame in range(len(found)):
        seen = found.positions[frame][found.valid[frame] & (found.scores[frame] >= cut)]
        for track in tracks:
            track["filter"].predict()
        pairs = _pairs(np.array([track["filter"].x[:3, 0] for track in tracks]).reshape(-1, 3), seen, gate)
        for number, track in enumerate(tracks):
            if number in pairs:
                track["filter"].update(seen[pairs[number]][:, None])
                track["hits"], track["misses"] = track["hits"] + 1, 0
            else:
                track["misses"] += 1
            track["confirmed"] |= track["hits"] >= hits
        tracks = [track for track in tracks if track["misses"] <= (misses if track["confirmed"] else 0)]
        for number in set(range(len(seen))) - set(pairs.values()):
            tracks.append({"filter": _filter(seen[number]), "hits": 1, "misses": 0, "confirmed": False, "id": born})
            born += 1
        shown = [track for track in tracks if track["confirmed"] and track["misses"] == 0]
        places = np.array([track["filter"].x[:3, 0] for track in shown]).reshape(-1, 3)
        rows.append((np.array([track["id"] for track in shown], int), places))
    return rows


def _pairs(tracks: np.ndarray, seen: np.ndarray, gate: float) -> dict[int, int]:
    distances = np.linalg.norm(tracks[:, None] - seen[None], axis=2)
    rows, columns = linear_sum_assignment(np.where(distances < gate, distances, 1e3))
    return {int(i): int(j) for i, j in zip(rows, columns, strict=True) if distances[i, j] < gate}


def _filter(place: np.ndarray, dt: float = 0.1, noise: float = 0.3) -> KalmanFilter:
    eye = np.eye(3)
    kalman = KalmanFilter(6, 3)
    kalman.x[:3, 0] = place
    kalman.F = np.block([[eye, dt * eye], [0 * eye, eye]])
    kalman.H = np.eye(3, 6)
    kalman.P = np.diag([noise**2] * 3 + [100.0] * 3)
    kalman.R = noise**2 * eye
    kalman.Q = np.block([[dt**3 / 3 * eye, dt**2 / 2 * eye], [dt**2 / 2 * eye, dt * eye]])
    return kalman


def _print(sequences: list[KittiTracking], table: dict[str, np.ndarray]) -> None:
    """A row for each sequence, GOSPA and HOTA of each tracker."""
    print("# GOSPA (m) / HOTA" + "".join(f"{name:>19}" for name in table))
    for row, sequence in enumerate(sequences):
        cells = "".join(f"{scores[row, 0]:>11.3f} / {scores[row, 1]:.3f}" for scores in table.values())
        print(f"# {sequence.name:<16}{cells}", flush=True)


def _nees(sequence: KittiTracking, tracked: Any) -> np.ndarray:
    """Squared errors in their own covariances, of tracks within 2 m of a true car."""
    truth, values = sequence.truth.detections, []
    for frame in range(len(tracked)):
        mine, true = tracked.valid[frame], truth.positions[frame][truth.valid[frame]]
        places, covariances = tracked.places[frame][mine], tracked.covariances[frame][mine]
        for i, j in _pairs(places, true, _MATCHED).items():
            error = places[i] - true[j]
            values.append(error @ np.linalg.solve(covariances[i], error))
    return np.array(values)


def _consistency(squared: np.ndarray) -> Iterator[Metric]:
    """T-90: errors of places beside chi-square with 3 degrees of freedom."""
    values = jnp.asarray(squared, float)
    fit = consistency.calibration(consistency.SquaredErrors(values, jnp.ones(values.shape, bool)), 3)
    print("# NEES: bin, density, chi-square")
    for edge, density, expected in zip(fit.edges, fit.density, fit.expected, strict=False):
        print(f"#   {float(edge):6.2f} {float(density):.3f} {float(expected):.3f}")
    yield Metric("detections.kitti.nees.mean", float(values.mean()), "", "equal")
    yield Metric("detections.kitti.nees.ks_distance", float(fit.distance), "", "lower", 2 * ACCURACY)
    for probability, share in zip((50, 90, 95), fit.coverage, strict=True):
        yield Metric(f"detections.kitti.nees.coverage_{probability}", float(share), "", "equal", ACCURACY)


def _mot(folder: Path) -> Iterator[Metric]:
    """Pedestrians in images, by overlap of boxes."""
    pipeline = jl.pipelines.detection_tracking
    truth = jl.data.tracking.read_mot_tracks(folder / "gt.txt")
    found = jl.data.tracking.read_mot_detections(folder / "det.txt", num_frames=len(truth.detections))
    low, high = found.boxes[..., :2], found.boxes[..., 2:]
    places = np.concatenate([0.5 * (low + high), high - low], axis=2)
    for name, strategy in pipeline.STRATEGIES.items():
        config = pipeline.Config.for_boxes(strategy())
        tracked = pipeline.track(places, found.scores, found.valid, found.times, config=config)
        pairs = _overlaps(truth, tracked)
        watched = ACCURACY if name == "gmphd" else None
        key = f"detections.mot15_campus.{name}"
        yield Metric(f"{key}.hota", float(hota(pairs).mean().hota), "", "higher", watched)
        yield Metric(f"{key}.mota", clear_mot(pairs).mota, "", "higher", watched)
        yield Metric(f"{key}.idf1", id_f1(pairs).f1, "", "higher", watched)


def _overlaps(truth: LabeledTracks, tracked: Any) -> Comparison:
    center, sides = tracked.places[..., :2], tracked.places[..., 2:]
    boxes = np.concatenate([center - 0.5 * sides, center + 0.5 * sides], axis=2)
    there = truth.detections
    return compare(there.boxes, truth.ids, there.valid, boxes, tracked.ids, tracked.valid, similarity=BoxOverlap())
