"""Multi-object tracking metrics: CLEAR MOT, IDF1 and HOTA.

Host code in double precision: ragged frames come in, a few numbers go out.

References:
    Bernardin and Stiefelhagen, "Evaluating multiple object tracking performance: the CLEAR MOT metrics", 2008.
    Ristani et al., "Performance measures and a data set for multi-target, multi-camera tracking", ECCV-W 2016.
    Luiten et al., "HOTA: a higher order metric for evaluating multi-object tracking", IJCV 2021.
"""

from abc import abstractmethod
from collections.abc import Iterator, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Float64, Int, Int64

from jaxloc.solvers import assign

_EPSILON = float(np.finfo(np.float64).eps)
_CONTINUED = 1000.0  # worth of a pair that goes on from the frame before, above any similarity


class Similarity(eqx.Module):
    """Similarity of two objects in [0, 1] (strategy)."""

    @abstractmethod
    def between(self, truth: Float[np.ndarray, "n d"], found: Float[np.ndarray, "k d"]) -> Float64[np.ndarray, "n k"]:
        """Similarity of each pair; zero where non-finite."""


class BoxOverlap(Similarity):
    """Intersection over union of boxes (left, top, right, bottom).

    Example:
        >>> boxes = np.array([[0.0, 0.0, 2.0, 2.0], [1.0, 0.0, 3.0, 2.0]])
        >>> BoxOverlap().between(boxes, boxes).round(3).tolist()
        [[1.0, 0.333], [0.333, 1.0]]
    """

    def between(self, truth: Float[np.ndarray, "n 4"], found: Float[np.ndarray, "k 4"]) -> Float64[np.ndarray, "n k"]:
        """Intersection over union."""
        one, other = truth.astype(np.float64)[:, None], found.astype(np.float64)[None]
        sides = np.minimum(one[..., 2:], other[..., 2:]) - np.maximum(one[..., :2], other[..., :2])
        shared = np.prod(np.maximum(sides, 0.0), axis=-1)
        areas = [np.prod(np.maximum(boxes[..., 2:] - boxes[..., :2], 0.0), axis=-1) for boxes in (one, other)]
        union = areas[0] + areas[1] - shared
        good = np.isfinite(union) & (union > 0)
        return np.where(good, shared / np.where(good, union, 1.0), 0.0)


class PointDistance(Similarity):
    """``max(0, 1 - d / c)`` of the distance of two points.

    Args:
        cutoff: c, m.

    Example:
        >>> PointDistance(2.0).between(np.zeros((1, 3)), np.array([[0.5, 0.0, 0.0], [9.0, 0.0, 0.0]])).tolist()
        [[0.75, 0.0]]
    """

    cutoff: float

    def between(self, truth: Float[np.ndarray, "n d"], found: Float[np.ndarray, "k d"]) -> Float64[np.ndarray, "n k"]:
        """One minus the distance in cutoffs."""
        distance = np.linalg.norm(truth.astype(np.float64)[:, None] - found.astype(np.float64)[None], axis=-1)
        return np.where(np.isfinite(distance), np.maximum(1.0 - distance / self.cutoff, 0.0), 0.0)


class Comparison(eqx.Module):
    """True and estimated tracks, frame by frame; made by `compare`.

    Attributes:
        truth_ids: who is there in each frame, as numbers from 0.
        ids: whom the tracker sees, as numbers from 0.
        similarity: of each pair in the frame.
        num_truth: how many identities there are.
        num_found: how many the tracker gave.
    """

    truth_ids: tuple[Int64[np.ndarray, " _n"], ...]
    ids: tuple[Int64[np.ndarray, " _k"], ...]
    similarity: tuple[Float64[np.ndarray, "_n _k"], ...]
    num_truth: int
    num_found: int

    def __iter__(self) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        return zip(self.truth_ids, self.ids, self.similarity, strict=True)

    def counts(self) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " k"]]:
        """Number of frames in which each identity is present."""
        sides = (self.truth_ids, self.num_truth), (self.ids, self.num_found)
        empty = np.zeros(0, np.int64)
        one, other = (np.bincount(np.concatenate([empty, *ids]), minlength=n).astype(np.float64) for ids, n in sides)
        return one, other


class ClearMot(eqx.Module):
    """CLEAR MOT.

    Attributes:
        mota: one minus false positives, misses and switches in true detections; zero where there are none.
        motp: mean similarity of the matches.
        true_positives: matches.
        false_positives: estimates without a match.
        misses: true detections without a match.
        switches: how often an identity is matched to another track than the last time.
        fragmentations: how often a track of an identity is interrupted.
        mostly_tracked: identities matched in more than 80 % of their frames.
        mostly_lost: identities matched in less than 20 %.
    """

    mota: float
    motp: float
    true_positives: int
    false_positives: int
    misses: int
    switches: int
    fragmentations: int
    mostly_tracked: int
    mostly_lost: int


class IdF1(eqx.Module):
    """IDF1 with identity precision and recall.

    Attributes:
        f1: of precision and recall.
        precision: matched among estimates, where each identity keeps one track.
        recall: matched among true detections.
    """

    f1: float
    precision: float
    recall: float


class Hota(eqx.Module):
    """HOTA and its parts, for each threshold of similarity or on average.

    Attributes:
        hota: geometric mean of the accuracies of detection and association.
        det_a: accuracy of detection.
        ass_a: accuracy of association.
        loc_a: mean similarity of the matches.
    """

    hota: Float64[np.ndarray, "*alpha"]
    det_a: Float64[np.ndarray, "*alpha"]
    ass_a: Float64[np.ndarray, "*alpha"]
    loc_a: Float64[np.ndarray, "*alpha"]

    def mean(self) -> "Hota":
        """The average over thresholds, the figures that are quoted."""
        return Hota(*(np.asarray(values.mean()) for values in (self.hota, self.det_a, self.ass_a, self.loc_a)))


def compare(
    truth: Float[np.ndarray, "t n d"],
    truth_ids: Int[np.ndarray, "t n"],
    truth_valid: Bool[np.ndarray, "t n"],
    found: Float[np.ndarray, "t k d"],
    ids: Int[np.ndarray, "t k"],
    valid: Bool[np.ndarray, "t k"],
    *,
    similarity: Similarity,
) -> Comparison:
    """Compares padded tracks, frame by frame.

    Args:
        truth: true boxes or positions.
        truth_ids: whose they are.
        truth_valid: which there are.
        found: estimated ones, of as many frames.
        ids: the tracks they are of.
        valid: which there are.
        similarity: of two objects.

    Returns:
        What the metrics need.

    Raises:
        ValueError: when an identity is there twice in a frame.

    Example:
        >>> here, ids = np.ones((3, 1), bool), np.zeros((3, 1), int)
        >>> tracks = compare(np.zeros((3, 1, 2)), ids, here, np.zeros((3, 1, 2)), np.array([[4], [4], [7]]), here,
        ...                  similarity=PointDistance(2.0))
        >>> clear_mot(tracks).switches, float(hota(tracks).mean().hota.round(3)), round(id_f1(tracks).f1, 3)
        (1, 0.745, 0.667)
    """
    one, num_truth = _renumber(truth_ids, truth_valid)
    other, num_found = _renumber(ids, valid)
    frames = zip(truth, truth_valid, found, valid, strict=True)
    return Comparison(one, other, tuple(similarity.between(a[v], b[w]) for a, v, b, w in frames), num_truth, num_found)


def join(comparisons: Sequence[Comparison]) -> Comparison:
    """Concatenates sequences with separate identities, for metrics of a whole benchmark.

    Example:
        >>> one = np.zeros(1, np.int64)
        >>> tracks = Comparison((one,), (one,), (np.ones((1, 1)),), 1, 1)
        >>> join([tracks, tracks]).truth_ids[1].tolist(), clear_mot(join([tracks, tracks])).true_positives
        ([1], 2)
    """
    truth_ids, ids, similarity, num_truth, num_found = [], [], [], 0, 0
    for tracks in comparisons:
        truth_ids += [frame + num_truth for frame in tracks.truth_ids]
        ids += [frame + num_found for frame in tracks.ids]
        similarity += tracks.similarity
        num_truth, num_found = num_truth + tracks.num_truth, num_found + tracks.num_found
    return Comparison(tuple(truth_ids), tuple(ids), tuple(similarity), num_truth, num_found)


def clear_mot(tracks: Comparison, *, threshold: float = 0.5) -> ClearMot:
    """CLEAR MOT: in each frame, matches of the frame before go on where they can; the others are the most similar.

    Where reference implementations differ, this follows TrackEval's results of one sequence: a frame without truth or
    without estimates interrupts no track (py-motmetrics counts an interruption in the latter), only matches of the
    frame before are preferred (py-motmetrics: the last match, however long ago), and MOTA is zero without any truth
    (py-motmetrics: minus infinity; TrackEval's total of several such sequences: minus the false positives).

    Args:
        tracks: true and estimated ones.
        threshold: least similarity of a match.

    Returns:
        The counts and ratios.

    References:
        Bernardin and Stiefelhagen 2008, section 2. [T-65]
    """
    none = np.full(tracks.num_truth, -1)
    last, before = none.copy(), none.copy()
    matched, pieces = np.zeros(tracks.num_truth), np.zeros(tracks.num_truth, np.int64)
    switches, total = 0, 0.0
    for truth_ids, ids, similarity in tracks:
        if not similarity.size:
            continue
        near = similarity >= threshold - _EPSILON
        goes_on = ids[None] == before[truth_ids][:, None]
        rows, columns = _best_pairs(np.where(near, _CONTINUED * goes_on + similarity, 0.0))
        who, track = truth_ids[rows], ids[columns]
        switches += int(((last[who] >= 0) & (last[who] != track)).sum())
        now = none.copy()
        now[who] = last[who] = track
        pieces += (before < 0) & (now >= 0)
        before = now
        matched[who] += 1
        total += similarity[rows, columns].sum()
    counts, found = tracks.counts()
    hits, size = int(matched.sum()), int(counts.sum())
    false = int(found.sum()) - hits
    covered = matched / np.maximum(counts, 1.0)
    return ClearMot(
        mota=(hits - false - switches) / size if size else 0.0,
        motp=float(total) / max(hits, 1),
        true_positives=hits,
        false_positives=false,
        misses=size - hits,
        switches=switches,
        fragmentations=int(np.maximum(pieces - 1, 0).sum()),
        mostly_tracked=int((covered > 0.8).sum()),
        mostly_lost=int((covered < 0.2).sum()),
    )


def id_f1(tracks: Comparison, *, threshold: float = 0.5) -> IdF1:
    """IDF1: the best one-to-one assignment of identities to tracks over the whole sequence.

    Args:
        tracks: true and estimated ones.
        threshold: least similarity of a match.

    Returns:
        F1, precision and recall; zero where there is nothing.

    References:
        Ristani et al. 2016, section 3. [T-65]
    """
    shared = np.zeros((tracks.num_truth, tracks.num_found))
    for truth_ids, ids, similarity in tracks:
        shared[np.ix_(truth_ids, ids)] += similarity >= threshold
    hits = shared[_best_pairs(shared)].sum()
    size, found = (side.sum() for side in tracks.counts())
    return IdF1(*(float(hits / max(number, 1.0)) for number in (0.5 * (size + found), found, size)))


def hota(tracks: Comparison) -> Hota:
    """HOTA at the thresholds 0.05, 0.10 ... 0.95 of similarity.

    Args:
        tracks: true and estimated ones.

    Returns:
        One value for each threshold; see `Hota.mean`.

    References:
        Luiten et al. 2021, eq. 14-27. [T-65]
    """
    alphas = np.arange(0.05, 0.99, 0.05)
    counts, found = tracks.counts()
    alignment = _alignment(tracks)
    matches = np.zeros((len(alphas), tracks.num_truth, tracks.num_found))
    total = np.zeros(len(alphas))
    for truth_ids, ids, similarity in tracks:
        if not similarity.size:
            continue
        rows, columns = _best_pairs(alignment[np.ix_(truth_ids, ids)] * similarity)
        values = similarity[rows, columns]
        near = values[None] >= alphas[:, None] - _EPSILON
        matches[:, truth_ids[rows], ids[columns]] += near
        total += (near * values).sum(axis=1)
    hits = matches.sum(axis=(1, 2))
    whole = counts[:, None] + found[None]
    association = (matches * (matches / np.maximum(whole - matches, 1.0))).sum(axis=(1, 2)) / np.maximum(hits, 1.0)
    detection = hits / np.maximum(counts.sum() + found.sum() - hits, 1.0)
    localization = np.where(hits > 0, total / np.maximum(hits, 1.0), 1.0)
    return Hota(np.sqrt(detection * association), detection, association, localization)


def _alignment(tracks: Comparison) -> Float64[np.ndarray, "n k"]:
    """How well each identity and each track go together over the sequence (Jaccard), before any matching."""
    shared = np.zeros((tracks.num_truth, tracks.num_found))
    for truth_ids, ids, similarity in tracks:
        either = similarity.sum(axis=0)[None] + similarity.sum(axis=1)[:, None] - similarity
        some = either > _EPSILON
        shared[np.ix_(truth_ids, ids)] += np.where(some, similarity / np.where(some, either, 1.0), 0.0)
    counts, found = tracks.counts()
    return shared / np.maximum(counts[:, None] + found[None] - shared, _EPSILON)


def _best_pairs(worth: Float64[np.ndarray, "n k"]) -> tuple[Int64[np.ndarray, " p"], Int64[np.ndarray, " p"]]:
    """The one-to-one pairs that are worth most together; pairs worth nothing are none."""
    # A few padded sizes serve all frames with one program each.
    padded = np.zeros([max(8, 1 << (size - 1).bit_length()) for size in worth.shape])
    padded[: worth.shape[0], : worth.shape[1]] = worth
    with jax.enable_x64(True):
        costs = jnp.asarray(-padded)
        columns = np.asarray(assign(costs, costs < 0, unassigned=jnp.zeros_like(costs[:, 0])).columns, np.int64)
    rows = np.flatnonzero(columns >= 0)
    return rows, columns[rows]


def _renumber(ids: Int[np.ndarray, "t n"], valid: Bool[np.ndarray, "t n"]) -> tuple[tuple[np.ndarray, ...], int]:
    """Identities as numbers from 0, frame by frame, and how many there are."""
    names = np.unique(ids[valid])
    frames = tuple(np.searchsorted(names, row[here]) for row, here in zip(ids, valid, strict=True))
    for number, frame in enumerate(frames):
        if len(np.unique(frame)) < len(frame):
            raise ValueError(f"An identity is there twice in frame {number}: {sorted(names[frame].tolist())}.")
    return frames, len(names)
