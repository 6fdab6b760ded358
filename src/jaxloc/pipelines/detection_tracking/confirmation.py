"""Confirmation of tracks and their identities, frame by frame on the host.

A track is confirmed once its existence was likely, with a high score, often enough. A false object that is detected
again and again at the same position has low scores and is never confirmed.
"""

from collections.abc import Iterable

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float64, Int64

from jaxloc.pipelines.detection_tracking.models import BOX, MIN_DEPTH, POSITION
from jaxloc.pipelines.detection_tracking.options import Config
from jaxloc.tracking import Targets

_SAME_POSITION, _SAME_BOX = 1.0, 0.5  # greatest distance of a track from its detection: m, heights of the box


class Output(eqx.Module):
    """Reported tracks of one frame, the most likely first.

    Attributes:
        ids: numbers of the tracks, from 1 in the order in which they are first reported.
        places: (x, y, z) in the world, m; or (center x, center y, width, height), px.
        velocities: their rates, 1/s.
        covariances: of the places.
        velocity_covariances: of the rates.
        existence: probability of existence (of a PHD filter, the weight).
        scores: estimated scores.
        detections: index of the nearest detection, which it was measured by; -1 where it was missed.
        num_dropped: tracks or components that exceeded the capacity.
    """

    ids: Int64[np.ndarray, " k"]
    places: Float64[np.ndarray, "k d"]
    velocities: Float64[np.ndarray, "k d"]
    covariances: Float64[np.ndarray, "k d d"]
    velocity_covariances: Float64[np.ndarray, "k d d"]
    existence: Float64[np.ndarray, " k"]
    scores: Float64[np.ndarray, " k"]
    detections: Int64[np.ndarray, " k"]
    num_dropped: int

    def __len__(self) -> int:
        return len(self.ids)


class Tracks(eqx.Module):
    """Outputs of several frames, padded to a table "t k".

    Attributes:
        valid: which slots hold a track.
        ids: see `Output`; -1 where not valid.
        places: zero where not valid, as all that follow.
        velocities: rates.
        covariances: of the places.
        velocity_covariances: of the rates.
        existence: probability of existence.
        scores: estimated scores.
        detections: index of the detection; -1 where missed.
        num_dropped: by frame: tracks or components that exceeded the capacity.
    """

    valid: Bool[np.ndarray, "t k"]
    ids: Int64[np.ndarray, "t k"]
    places: Float64[np.ndarray, "t k d"]
    velocities: Float64[np.ndarray, "t k d"]
    covariances: Float64[np.ndarray, "t k d d"]
    velocity_covariances: Float64[np.ndarray, "t k d d"]
    existence: Float64[np.ndarray, "t k"]
    scores: Float64[np.ndarray, "t k"]
    detections: Int64[np.ndarray, "t k"]
    num_dropped: Int64[np.ndarray, " t"]

    def __len__(self) -> int:
        return len(self.valid)


class Identities(eqx.Module):
    """What is remembered of each label of the tracker.

    Attributes:
        labels: of the tracker.
        hits: number of frames in which it was likely, with a high score.
        ids: number under which it is reported; 0 where it never was.
    """

    labels: Int64[np.ndarray, " n"]
    hits: Int64[np.ndarray, " n"]
    ids: Int64[np.ndarray, " n"]

    @staticmethod
    def none() -> "Identities":
        """Before the first frame."""
        return Identities(*(np.zeros(0, np.int64) for _ in range(3)))

    def counted(self, labels: np.ndarray, add: Int64[np.ndarray, " k"]) -> "Identities":
        """With hits added to some labels, and new labels appended."""
        hits = dict(zip(self.labels.tolist(), self.hits.tolist(), strict=True))
        ids = dict(zip(self.labels.tolist(), self.ids.tolist(), strict=True))
        for label, count in zip(labels.tolist(), add.tolist(), strict=True):
            hits[label] = hits.get(label, 0) + count
        table = [(label, count, ids.get(label, 0)) for label, count in hits.items() if count]
        return Identities(*np.array(table, np.int64).reshape(-1, 3).T)

    def numbered(self, labels: np.ndarray) -> "Identities":
        """With a number for each of some labels."""
        ids, last = self.ids.copy(), int(self.ids.max(initial=0))
        for label in labels.tolist():
            slot = int(np.flatnonzero(self.labels == label)[0])
            if not ids[slot]:
                last += 1
                ids[slot] = last
        return Identities(self.labels, self.hits, ids)

    def of(self, labels: np.ndarray, values: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " k"]:
        """Values by label; zero for labels that are not in the table."""
        found = dict(zip(self.labels.tolist(), values.tolist(), strict=True))
        return np.array([found.get(label, 0) for label in labels.tolist()], np.int64)


def confirm(
    identities: Identities, targets: Targets, places: np.ndarray, valid: np.ndarray, camera: np.ndarray, config: Config
) -> tuple[Identities, Output]:
    """Selects the confirmed tracks of a frame.

    Args:
        identities: after the last frame.
        targets: of the tracker.
        places: of the frame's detections.
        valid: which detections there are.
        camera: T_world_camera.
        config: options.

    Returns:
        The identities after this frame, and the tracks; `Output.num_dropped` is zero.
    """
    options, size = config.confirmation, places.shape[1]
    found = _merge_labels(targets)
    score = found.means[:, size]
    likely = (found.probabilities >= options.existence) & (score >= options.score)
    identities = identities.counted(found.labels, likely.astype(np.int64))
    confirmed = identities.of(found.labels, identities.hits) >= options.frames
    reported = confirmed & (found.probabilities >= options.report_existence) & (score >= options.report_score)
    if size == POSITION - 1:
        reported &= _in_view(found.means[:, :3], camera, config.scene.half_view)
    chosen = jax.tree.map(lambda leaf: leaf[reported], found)
    identities = identities.numbered(chosen.labels)
    ids = identities.of(chosen.labels, identities.ids)
    detections = _nearest(chosen.means[:, :size], places, valid).astype(np.int64)
    rates = slice(size + 1, 2 * size + 1)
    values = (
        chosen.means[:, :size],
        chosen.means[:, rates],
        chosen.covariances[:, :size, :size],
        chosen.covariances[:, rates, rates],
        chosen.probabilities,
        chosen.means[:, size],
    )
    return identities, Output(ids, *(value.astype(np.float64) for value in values), detections, 0)


def stack(outputs: Iterable[Output]) -> Tracks:
    """Puts the outputs of several frames into one table.

    Args:
        outputs: of one or more frames.
    """
    rows = list(outputs)
    room = max((len(row) for row in rows), default=0)

    def table(name: str, fill: int = 0) -> np.ndarray:
        values = [getattr(row, name) for row in rows]
        return np.stack(
            [np.pad(v, [(0, room - len(v))] + [(0, 0)] * (v.ndim - 1), constant_values=fill) for v in values]
        )

    floats = ("places", "velocities", "covariances", "velocity_covariances", "existence", "scores")
    return Tracks(
        np.arange(room)[None] < np.array([len(row) for row in rows])[:, None],
        table("ids", -1),
        *(table(name) for name in floats),
        table("detections", -1),
        np.array([row.num_dropped for row in rows], np.int64),
    )


def _merge_labels(targets: Targets) -> Targets:
    """Each target once, the most likely first: components of one label are one target."""
    found = jax.tree.map(lambda leaf: leaf[targets.valid], targets)
    order = np.argsort(-found.probabilities, kind="stable")
    _, first, which = np.unique(found.labels[order], return_index=True, return_inverse=True)
    totals = np.bincount(which, found.probabilities[order], minlength=len(first)).astype(np.float32)
    ranks = np.argsort(first)
    once = jax.tree.map(lambda leaf: leaf[order][first[ranks]], found)
    return eqx.tree_at(lambda t: t.probabilities, once, totals[ranks])


def _in_view(places: np.ndarray, camera: np.ndarray, half_view: float) -> np.ndarray:
    x, _, z = ((places - camera[:3, 3]) @ camera[:3, :3]).T
    return (z > MIN_DEPTH) & (np.abs(x) < half_view * z)


def _nearest(tracks: np.ndarray, places: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """The nearest detection of each track; -1 where none lies within the greatest distance."""
    if not valid.any() or not len(tracks):
        return np.full(len(tracks), -1)
    center = slice(0, 2) if tracks.shape[1] == BOX - 1 else slice(0, 3)
    gaps = np.linalg.norm(tracks[:, None, center] - places[None, :, center], axis=2)
    gaps = np.where(valid[None] & np.isfinite(gaps), gaps, np.inf)
    limit = _SAME_BOX * tracks[:, 3] if tracks.shape[1] == BOX - 1 else np.full(len(tracks), _SAME_POSITION)
    return np.where(gaps.min(axis=1) <= limit, gaps.argmin(axis=1), -1)
