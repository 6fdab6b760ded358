"""Tracking by detection: tracks of objects in the world, or of boxes in images, from the outputs of a detector."""

import itertools
from collections.abc import Iterable, Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float64

from jaxloc._jit import filter_jit
from jaxloc.beliefs import Mixture
from jaxloc.filters import ConstantVelocity, History, KalmanFilter
from jaxloc.filters import run as run_filter
from jaxloc.pipelines.detection_tracking.confirmation import Identities, Output, Tracks, confirm, stack
from jaxloc.pipelines.detection_tracking.models import (
    BOX,
    POSITION,
    Control,
    DetectionSensor,
    Measurement,
    MovingCameraTracker,
    ScoredBirth,
    ScoredClutter,
    ScoredDetection,
)
from jaxloc.pipelines.detection_tracking.options import Config
from jaxloc.tracking import TargetModel

_FRAMES, _SLOTS = 128, 16  # frames of one scan, and multiples of detections: few sizes, since each is compiled


class Frame(eqx.Module):
    """Detections of one image.

    Attributes:
        time: stamp, s.
        places: (x, y, z) in the world, m, or boxes (center x, center y, width, height), px.
        scores: of the detector.
        valid: which detections there are; those with non-finite values are ignored.
        camera: T_world_camera (positions only).
    """

    time: float
    places: Float64[np.ndarray, "m d"]
    scores: Float64[np.ndarray, " m"]
    valid: Bool[np.ndarray, " m"]
    camera: Float64[np.ndarray, "4 4"]


class State(eqx.Module):
    """State of the tracking between two frames.

    Attributes:
        config: options.
        tracker: with its models.
        scene: state of the tracker.
        identities: of the tracks.
        time: stamp of the last frame, s.
        num_frames: number of frames so far.
    """

    config: Config
    tracker: MovingCameraTracker
    scene: Any
    identities: Identities
    time: float
    num_frames: int


def init(config: Config, *, dimension: int = POSITION - 1) -> State:
    """The state before the first frame.

    Args:
        config: options.
        dimension: entries of a place: 3 for positions in the world, 4 for boxes in images.

    Raises:
        ValueError: the dimension is neither.
    """
    if dimension not in (POSITION - 1, BOX - 1):
        raise ValueError(f"Places have 3 or 4 entries; got {dimension}.")
    tracker = make_tracker(config, dimension + 1)
    scene = tracker.init(Mixture.empty(1, jnp.zeros(2 * (dimension + 1), jnp.float32)))
    return State(config, tracker, scene, Identities.none(), 0.0, 0)


def step(state: State, frame: Frame) -> tuple[State, Output]:
    """Updates the tracks by the detections of the next frame.

    Args:
        state: from `init` or the last step.
        frame: detections; their number is padded to a multiple of 16, each of which is compiled once.

    Returns:
        The next state, and the reported tracks.

    Raises:
        ValueError: places have another dimension, or time goes backwards.
    """
    state, (output,) = _advance(state, [frame], 1)
    return state, output


def run(frames: Iterable[Frame], config: Config) -> Iterator[Output]:
    """Tracks over a recording: the numbers of `step`, by one compiled scan over each 128 frames.

    Args:
        frames: detections, in order.
        config: options.

    Yields:
        The tracks of each frame, from that and earlier frames only.

    Raises:
        ValueError: places have neither 3 nor 4 entries, or times go backwards.
    """
    source, state = iter(frames), None
    while chunk := list(itertools.islice(source, _FRAMES)):
        state = init(config, dimension=chunk[0].places.shape[1]) if state is None else state
        state, outputs = _advance(state, chunk, _FRAMES)
        yield from outputs


def track(
    places: Float64[np.ndarray, "t m d"],
    scores: Float64[np.ndarray, "t m"],
    valid: Bool[np.ndarray, "t m"],
    times: Float64[np.ndarray, " t"],
    *,
    cameras: Float64[np.ndarray, "t 4 4"] | None = None,
    config: Config | None = None,
) -> Tracks:
    """`run` over arrays, with the outputs as one table.

    Args:
        places: of detections: (x, y, z) in the world, m, or boxes (center x, center y, width, height), px.
        scores: of the detector.
        valid: which detections there are; those with non-finite values are ignored.
        times: of the frames, s.
        cameras: T_world_camera of each frame (positions only); the identity where not given.
        config: options.

    Returns:
        The tracks of each frame.

    Raises:
        ValueError: places have neither 3 nor 4 entries, or times go backwards.

    Example:
        >>> places = np.stack([np.arange(5.0), np.zeros(5), np.full(5, 20.0)], axis=1)[:, None]
        >>> found = track(places, np.full((5, 1), 10.0), np.ones((5, 1), bool), 0.1 * np.arange(5.0))
        >>> found.ids[:, 0].tolist()[-1], found.velocities[-1, 0].round().tolist()
        (1, [10.0, 0.0, 0.0])
    """
    frames = split_frames(places, scores, valid, times, cameras=cameras)
    return stack(run(frames, Config() if config is None else config))


def split_frames(
    places: Float64[np.ndarray, "t m d"],
    scores: Float64[np.ndarray, "t m"],
    valid: Bool[np.ndarray, "t m"],
    times: Float64[np.ndarray, " t"],
    *,
    cameras: Float64[np.ndarray, "t 4 4"] | None = None,
) -> Iterator[Frame]:
    """The frames of a recording held in arrays, see `track`."""
    cameras = np.tile(np.eye(4), (len(times), 1, 1)) if cameras is None else cameras
    for time, *values in zip(times, places, scores, valid, cameras, strict=True):
        yield Frame(float(time), *values)


def make_tracker(config: Config, size: int) -> MovingCameraTracker:
    """The tracker that the options name.

    Args:
        config: options.
        size: entries of a measurement, `POSITION` or `BOX`.
    """
    motion, scene = config.motion, config.scene
    slow = np.array([False, True, False] if size == POSITION else [False, False, True, True])
    drifts = [*np.where(slow, motion.slow_acceleration, motion.acceleration), motion.score_drift]
    rates = np.array([*np.where(slow, motion.slow_speed, motion.speed), motion.score_rate])
    noise = jax.tree.map(jnp.asarray, config.noise)
    sensor = DetectionSensor(noise, jnp.eye(4), size)
    model = TargetModel(
        KalmanFilter(ConstantVelocity(jnp.array(drifts, jnp.float32), axes=size), sensor),
        detection=ScoredDetection(scene.detection_base, scene.detection_slope, size - 1),
        survival=scene.survival,
        clutter=ScoredClutter(scene.clutter_rate, scene.volume, scene.clutter_score),
        birth=ScoredBirth(scene.birth_rate, scene.volume * scene.score_range, sensor, jnp.array(rates**2, jnp.float32)),
    )
    tracker = config.strategy.tracker(model, config.capacity)
    return MovingCameraTracker(tracker, scene.out_of_view_survival, scene.half_view if size == POSITION else None)


def _advance(state: State, frames: list[Frame], length: int) -> tuple[State, list[Output]]:
    """The tracker over some frames by one scan of a fixed length, then the confirmation frame by frame."""
    _check(state, frames)
    config, identities, outputs = state.config, state.identities, []
    used = [frame.valid & (frame.scores >= config.scene.min_score) for frame in frames]
    scene, history = _scan(state.tracker, state.scene, *_pad(state, frames, used, length))
    targets, dropped = jax.tree.map(np.asarray, (history.states, history.infos.crowded))
    for index, (frame, valid) in enumerate(zip(frames, used, strict=True)):
        one = jax.tree.map(lambda leaf, i=index: leaf[i], targets)
        identities, output = confirm(identities, one, frame.places, valid, frame.camera, config)
        outputs.append(eqx.tree_at(lambda o: o.num_dropped, output, int(dropped[index])))
    count = state.num_frames + len(frames)
    return State(config, state.tracker, scene, identities, frames[-1].time, count), outputs


def _check(state: State, frames: list[Frame]) -> None:
    dimension, time = state.tracker.inner.model.birth.sensor.size - 1, state.time
    for index, frame in enumerate(frames, start=state.num_frames):
        if frame.places.shape[1] != dimension:
            raise ValueError(f"Places have {dimension} entries; got {frame.places.shape[1]} at frame {index}.")
        if index and frame.time < time:
            raise ValueError(f"Times go backwards at frame {index}.")
        time = frame.time


def _pad(state: State, frames: list[Frame], used: list[np.ndarray], length: int) -> tuple[Any, ...]:
    """Controls, measurements, which of them are valid, and which frames there are."""
    count, dimension = len(frames), frames[0].places.shape[1]
    room = -(-max(*(len(frame.scores) for frame in frames), 1) // _SLOTS) * _SLOTS
    values, valid = np.zeros((length, room, dimension + 1)), np.zeros((length, room), bool)
    cameras, dt = np.zeros((length, 4, 4)), np.zeros(length)
    times = np.array([frame.time for frame in frames])
    dt[:count] = np.diff(times, prepend=state.time if state.num_frames else times[0])
    for index, (frame, usable) in enumerate(zip(frames, used, strict=True)):
        values[index, : len(usable)] = np.column_stack([frame.places, frame.scores])
        valid[index, : len(usable)], cameras[index] = usable, frame.camera
    poses = jnp.asarray(cameras, jnp.float32)
    measured = Measurement(jnp.asarray(values, jnp.float32), poses)
    active = jnp.asarray(np.arange(length) < count)
    return Control(jnp.asarray(dt, jnp.float32), poses), measured, jnp.asarray(valid), active


@filter_jit
def _scan(
    tracker: MovingCameraTracker,
    scene: Any,
    controls: Control,
    measured: Measurement,
    valid: Bool[Array, "t m"],
    active: Bool[Array, " t"],
) -> tuple[Any, History]:
    return run_filter(tracker, scene, controls, measured, valid, active=active, keep=tracker.extract)
