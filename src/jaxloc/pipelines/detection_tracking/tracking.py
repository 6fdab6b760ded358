"""Tracks from ready detections: of solids in the world, or of boxes in images.

One jitted scan over all frames, then a look at each track: it is spoken of once it was likely to be there, with a
high score, often enough. What is false again and again in the same place has low scores again and again, and is never
spoken of.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float64, Int64

from jaxloc.beliefs import Mixture
from jaxloc.filters import ConstantVelocity, History, KalmanFilter, run
from jaxloc.pipelines.detection_tracking.models import (
    BOX,
    NEAREST,
    SOLID,
    Frame,
    PlaceSensor,
    ScoredBirth,
    ScoredClutter,
    ScoredDetection,
    Step,
    WatchedTracker,
)
from jaxloc.pipelines.detection_tracking.options import (
    STRATEGIES,
    Belief,
    Config,
    Gnn,
    Jpda,
    Movement,
    Phd,
    Scene,
    Strategy,
)
from jaxloc.tracking import TargetModel, Targets

__all__ = [
    "STRATEGIES",
    "Belief",
    "Config",
    "Gnn",
    "Jpda",
    "Movement",
    "Phd",
    "Scene",
    "Strategy",
    "Tracked",
    "make_tracker",
    "track",
]

_SAME_SOLID, _SAME_BOX = 1.0, 0.5  # farthest that a track may lie from its detection: m, heights of the box
_FRAMES, _SLOTS = 128, 16  # sequences are padded to multiples of these, so that many share one program


class Tracked(eqx.Module):
    """Tracks that are spoken of, by frame, "t k"; the likeliest stand first.

    Attributes:
        valid: which slots hold one.
        ids: who it is, from 1 in the order in which they are first spoken of; -1 where not valid.
        places: (x, y, z) in the world, m; or (center x, center y, width, height), px.
        velocities: their rates, a second.
        covariances: of the places.
        speed_covariances: of the rates.
        existence: probability to be there (of a PHD filter, the weight).
        scores: as they are estimated.
        slots: of the detection it was measured as; -1 where it was missed.
        crowded: by frame: tracks or components that found no room.
    """

    valid: Bool[np.ndarray, "t k"]
    ids: Int64[np.ndarray, "t k"]
    places: Float64[np.ndarray, "t k d"]
    velocities: Float64[np.ndarray, "t k d"]
    covariances: Float64[np.ndarray, "t k d d"]
    speed_covariances: Float64[np.ndarray, "t k d d"]
    existence: Float64[np.ndarray, "t k"]
    scores: Float64[np.ndarray, "t k"]
    slots: Int64[np.ndarray, "t k"]
    crowded: Int64[np.ndarray, " t"]

    def __len__(self) -> int:
        return len(self.valid)


def track(
    places: Float64[np.ndarray, "t m d"],
    scores: Float64[np.ndarray, "t m"],
    valid: Bool[np.ndarray, "t m"],
    times: Float64[np.ndarray, " t"],
    *,
    cameras: Float64[np.ndarray, "t 4 4"] | None = None,
    config: Config | None = None,
) -> Tracked:
    """Tracks what a detector found.

    Args:
        places: of detections: (x, y, z) in the world, m, or boxes (center x, center y, width, height), px.
        scores: of the detector.
        valid: which detections there are; those with bad numbers count as absent.
        times: of the frames, s.
        cameras: T_world_camera of each frame (solids only); the identity where not given.
        config: options.

    Returns:
        The tracks of each frame, from that and earlier frames only.

    Raises:
        ValueError: when places have neither 3 nor 4 entries, or times go backwards.

    Example:
        >>> places = np.stack([np.arange(5.0), np.zeros(5), np.full(5, 20.0)], axis=1)[:, None]
        >>> found = track(places, np.full((5, 1), 10.0), np.ones((5, 1), bool), 0.1 * np.arange(5.0))
        >>> found.ids[:, 0].tolist()[-1], found.velocities[-1, 0].round().tolist()
        (1, [10.0, 0.0, 0.0])
    """
    if places.shape[2] not in (SOLID - 1, BOX - 1):
        raise ValueError(f"Places have 3 or 4 entries; got {places.shape[2]}.")
    if (np.diff(times) < 0).any():
        raise ValueError(f"Times go backwards at frame {int(np.argmax(np.diff(times) < 0)) + 1}.")
    config = Config() if config is None else config
    valid = valid & (scores >= config.scene.least_score)
    cameras = np.tile(np.eye(4), (len(times), 1, 1)) if cameras is None else cameras
    history = _filter(config, np.concatenate([places, scores[..., None]], axis=2), valid, times, cameras)
    return _speak(config, history, places, valid, cameras)


def make_tracker(config: Config, size: int) -> WatchedTracker:
    """The tracker that the options name.

    Args:
        config: options.
        size: entries of a measurement, `SOLID` or `BOX`.
    """
    movement, scene = config.movement, config.scene
    calm = np.array([False, True, False] if size == SOLID else [False, False, True, True])
    drifts = [*np.where(calm, movement.calm_acceleration, movement.acceleration), movement.score_drift]
    rates = np.array([*np.where(calm, movement.calm_speed, movement.speed), movement.score_rate])
    noise = jax.tree.map(jnp.asarray, config.noise)
    sensor = PlaceSensor(noise, jnp.eye(4), size)
    model = TargetModel(
        KalmanFilter(ConstantVelocity(jnp.array(drifts, jnp.float32), axes=size), sensor),
        detection=ScoredDetection(scene.detect_base, scene.detect_slope, size - 1),
        survival=scene.survival,
        clutter=ScoredClutter(scene.clutter, scene.volume, scene.clutter_score),
        birth=ScoredBirth(scene.births, scene.volume * scene.scores, sensor, jnp.array(rates**2, jnp.float32)),
    )
    tracker = config.strategy.tracker(model, config.capacity)
    return WatchedTracker(tracker, scene.stay, scene.half_view if size == SOLID else None)


def _filter(config: Config, values: np.ndarray, valid: np.ndarray, times: np.ndarray, cameras: np.ndarray) -> History:
    """The tracker over all frames."""
    count, room, size = values.shape
    frames, slots = -(-max(count, 1) // _FRAMES) * _FRAMES, -(-max(room, 1) // _SLOTS) * _SLOTS

    def pad(array: np.ndarray, *wanted: int) -> np.ndarray:
        return np.pad(
            array, [(0, n - array.shape[i]) for i, n in enumerate(wanted)] + [(0, 0)] * (array.ndim - len(wanted))
        )

    poses = jnp.asarray(pad(cameras, frames), jnp.float32)
    dt = jnp.asarray(pad(np.diff(times, prepend=times[:1]), frames), jnp.float32)
    seen = Frame(jnp.asarray(pad(values, frames, slots), jnp.float32), poses)
    there = jnp.asarray(pad(valid, frames, slots))
    active = jnp.asarray(np.arange(frames) < count)
    history = _scan(make_tracker(config, size), Step(dt, poses), seen, there, active)
    return jax.tree.map(lambda leaf: np.asarray(leaf)[:count], history)


@eqx.filter_jit
def _scan(
    tracker: WatchedTracker, steps: Step, seen: Frame, valid: Bool[Array, "t m"], active: Bool[Array, " t"]
) -> History:
    size = seen.values.shape[-1]
    state = tracker.init(Mixture.empty(1, jnp.zeros(2 * size, seen.values.dtype)))
    return run(tracker, state, steps, seen, valid, active=active, keep=tracker.extract)[1]


def _speak(config: Config, history: History, places: np.ndarray, valid: np.ndarray, cameras: np.ndarray) -> Tracked:
    """The tracks that deserve belief, frame by frame."""
    targets, size = history.states, places.shape[2]
    hits: dict[int, int] = {}
    numbers: dict[int, int] = {}
    rows = []
    for frame in range(len(places)):
        found = _of_frame(targets, frame)
        score = found.means[:, size]
        likely = (found.probabilities >= config.belief.confirm) & (score >= config.belief.surest)
        for label in found.labels[likely].tolist():
            hits[label] = hits.get(label, 0) + 1
        known = np.array([hits.get(label, 0) >= config.belief.hits for label in found.labels.tolist()], bool)
        shown = known & (found.probabilities >= config.belief.show) & (score >= config.belief.keep)
        if size == SOLID - 1:
            shown &= _seen(found.means[:, :3], cameras[frame], config.scene.half_view)
        chosen = jax.tree.map(lambda leaf, shown=shown: leaf[shown], found)
        known_as = [numbers.setdefault(label, len(numbers) + 1) for label in chosen.labels.tolist()]
        chosen = eqx.tree_at(lambda t: t.labels, chosen, np.array(known_as, np.int64))
        rows.append((chosen, _nearest(chosen.means[:, :size], places[frame], valid[frame])))
    return _table(rows, size, history.infos.crowded)


def _of_frame(targets: Targets, frame: int) -> Targets:
    """Each target once, the likeliest first: components of one label are one target."""
    found = jax.tree.map(lambda leaf: leaf[frame][targets.valid[frame]], targets)
    order = np.argsort(-found.probabilities, kind="stable")
    _, first, which = np.unique(found.labels[order], return_index=True, return_inverse=True)
    totals = np.bincount(which, found.probabilities[order], minlength=len(first)).astype(np.float32)
    ranks = np.argsort(first)
    once = jax.tree.map(lambda leaf: leaf[order][first[ranks]], found)
    return eqx.tree_at(lambda t: t.probabilities, once, totals[ranks])


def _seen(places: np.ndarray, camera: np.ndarray, half_view: float) -> np.ndarray:
    x, _, z = ((places - camera[:3, 3]) @ camera[:3, :3]).T
    return (z > NEAREST) & (np.abs(x) < half_view * z)


def _nearest(tracks: np.ndarray, places: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """The detection beside each track; -1 where there is none so close that it must be its own."""
    if not valid.any() or not len(tracks):
        return np.full(len(tracks), -1)
    center = slice(0, 2) if tracks.shape[1] == BOX - 1 else slice(0, 3)
    gaps = np.linalg.norm(tracks[:, None, center] - places[None, :, center], axis=2)
    gaps = np.where(valid[None] & np.isfinite(gaps), gaps, np.inf)
    limit = _SAME_BOX * tracks[:, 3] if tracks.shape[1] == BOX - 1 else np.full(len(tracks), _SAME_SOLID)
    return np.where(gaps.min(axis=1) <= limit, gaps.argmin(axis=1), -1)


def _table(rows: list[tuple[Targets, np.ndarray]], size: int, crowded: np.ndarray) -> Tracked:
    """Rows of frames, padded."""
    room = max((len(slots) for _, slots in rows), default=0)

    def stack(values: list[np.ndarray], fill: int = 0) -> np.ndarray:
        padded = [np.pad(v, [(0, room - len(v))] + [(0, 0)] * (v.ndim - 1), constant_values=fill) for v in values]
        return np.stack(padded)

    rates = slice(size + 1, 2 * size + 1)
    found = [targets for targets, _ in rows]
    floats = (
        [t.means[:, :size] for t in found],
        [t.means[:, rates] for t in found],
        [t.covariances[:, :size, :size] for t in found],
        [t.covariances[:, rates, rates] for t in found],
        [t.probabilities for t in found],
        [t.means[:, size] for t in found],
    )
    return Tracked(
        stack([np.ones(len(t.labels), bool) for t in found], False),
        stack([t.labels for t in found], -1),
        *(stack([v.astype(np.float64) for v in values]) for values in floats),
        stack([slots.astype(np.int64) for _, slots in rows], -1),
        crowded.astype(np.int64),
    )
