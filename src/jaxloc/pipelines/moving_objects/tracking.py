"""Detection and tracking of moving objects from a moving stereo camera.

Outliers of the visual odometry are matched again by scene flow, grouped to objects with position and velocity, and
tracked in the world by a GM-PHD filter.
"""

from collections.abc import Iterable, Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxloc.beliefs import Gaussian, Mixture
from jaxloc.odometry import find_moving, group_points
from jaxloc.pipelines import odometry
from jaxloc.pipelines.moving_objects.object_filter import update_filter
from jaxloc.pipelines.moving_objects.options import Config
from jaxloc.pipelines.odometry import Evidence
from jaxloc.pipelines.odometry import Output as OdometryOutput
from jaxloc.pipelines.stopwatch import Stopwatch
from jaxloc.poses import SE3
from jaxloc.sensors import StereoRig
from jaxloc.solvers import RobustEstimate
from jaxloc.tracking import PhdState, Targets


class Track(eqx.Module):
    """A confirmed track in one frame.

    Attributes:
        label: number of the track.
        state: position (m) and velocity (m/s) in the world.
        covariance: of the state.
        weight: expected number of objects that it stands for.
        uv: position projected into the left image, px.
    """

    label: int
    state: np.ndarray
    covariance: np.ndarray
    weight: float
    uv: np.ndarray


class Output(eqx.Module):
    """Moving points, objects and tracks of one frame.

    Attributes:
        index: number of the frame, from 0.
        odometry: motion of the camera; its pose is the given one, where there is one.
        points: "n 2" pixels of moving points.
        objects: "k 6" measured position and velocity in the world.
        boxes: "k 4" their bounding boxes in the left image.
        tracks: the confirmed tracks in view.
        count: expected number of objects.
        timings: wall time by stage, s.
    """

    index: int
    odometry: OdometryOutput
    points: np.ndarray
    objects: np.ndarray
    boxes: np.ndarray
    tracks: tuple[Track, ...]
    count: float
    timings: dict[str, float]


class Confirmations(eqx.Module):
    """How often each track had a weight above 0.5.

    Attributes:
        labels: numbers of the tracks.
        counts: number of frames of each.
    """

    labels: Int[np.ndarray, " n"]
    counts: Int[np.ndarray, " n"]

    def select(
        self, targets: Targets, uv: np.ndarray, visible: np.ndarray, least: int
    ) -> tuple["Confirmations", tuple[Track, ...]]:
        """The counts after a frame, and the confirmed tracks in view; of components with one label the heaviest."""
        rows = jax.tree.map(np.asarray, targets)
        counts = dict(zip(self.labels.tolist(), self.counts.tolist(), strict=True))
        tracks: dict[int, Track] = {}
        for i in np.argsort(-rows.probabilities):
            label, weight = int(rows.labels[i]), float(rows.probabilities[i])
            if not (rows.valid[i] and visible[i]) or label in tracks:
                continue
            counts[label] = counts.get(label, 0) + (weight > 0.5)
            if counts[label] >= least:
                tracks[label] = Track(label, rows.means[i], rows.covariances[i], weight, uv[i])
        after = Confirmations(np.array(list(counts), np.int64), np.array(list(counts.values()), np.int64))
        return after, tuple(tracks.values())


class State(eqx.Module):
    """State of the pipeline between two frames.

    Attributes:
        config: options.
        odometry: state of the visual odometry.
        phd: state of the filter.
        confirmations: of the tracks.
        keyframe_pose: ``T_world_camera`` at the odometry's last keyframe, as it was given or estimated.
        keyframe_time: its stamp, s.
        pose: ``T_world_camera`` at the last frame.
        time: its stamp, s.
        index: number of the next frame.
    """

    config: Config
    odometry: odometry.State
    phd: PhdState
    confirmations: Confirmations
    keyframe_pose: SE3
    keyframe_time: float
    pose: SE3
    time: float
    index: int


def init(config: Config, rig: StereoRig) -> State:
    """The state before the first frame.

    Args:
        config: options.
        rig: the stereo rig.
    """
    one = jnp.ones((), jnp.int32)
    empty = Mixture.empty(config.capacity, jnp.zeros(6, jnp.float32))
    phd = PhdState(empty, jnp.zeros((), jnp.int32), one, jnp.ones((), jnp.float32))
    none = np.zeros(0, np.int64)
    camera = odometry.init(config.odometry, rig)
    return State(config, camera, phd, Confirmations(none, none), SE3.identity(), 0.0, SE3.identity(), 0.0, 0)


def step(state: State, frame: Any, *, pose: SE3 | None = None) -> tuple[State, Output]:
    """Estimates the motion of the camera and updates the tracks by the next frame.

    Args:
        state: from `init` or the last step.
        frame: record with ``time`` (s), ``left`` and ``right`` (rectified grayscale images).
        pose: ``T_world_camera``, if it is known exactly: in place of the odometry's, in every step.

    Returns:
        The next state, and the output of this frame; objects are measured from the second frame on.

    Raises:
        ValueError: an image is missing, no grayscale image of bytes or floats, or of another size than those before.

    References:
        Thesis figure 3.3 [T-68], section 5.4 [T-78], [T-79]; static and dynamic points [T-4].
    """
    camera, output, evidence = odometry.step_with_evidence(state.odometry, frame)
    state = eqx.tree_at(lambda s: s.odometry, state, camera)
    return update_tracks(state, output, evidence, pose=pose)


def run(frames: Iterable[Any], config: Config, rig: StereoRig, *, poses: SE3 | None = None) -> Iterator[Output]:
    """Runs the pipeline over a recording, see `step`.

    Args:
        frames: records with ``time``, ``left`` and ``right``, in order.
        config: options.
        rig: the stereo rig.
        poses: ``T_world_camera`` of each frame, stacked, if they are known exactly.

    Yields:
        An output for each frame.
    """
    state = init(config, rig)
    for index, frame in enumerate(frames):
        pose = None if poses is None else jax.tree.map(lambda leaf, i=index: leaf[i], poses)
        state, output = step(state, frame, pose=pose)
        yield output


def run_after_odometry(
    outputs: Iterable[tuple[OdometryOutput, Evidence | None]], config: Config, rig: StereoRig
) -> Iterator[Output]:
    """`run` over the outputs of an odometry that ran already.

    Args:
        outputs: of `odometry.run_with_evidence`.
        config: options.
        rig: the stereo rig.

    Yields:
        An output for each frame.
    """
    state = init(config, rig)
    for camera, evidence in outputs:
        state, output = update_tracks(state, camera, evidence)
        yield output


def update_tracks(
    state: State, camera: OdometryOutput, found: Evidence | None, *, pose: SE3 | None = None
) -> tuple[State, Output]:
    """`step` after its odometry: for an odometry that ran already.

    Args:
        state: from `init` or the last step.
        camera: output of the odometry.
        found: what it was estimated from.
        pose: as of `step`.

    Returns:
        The next state, and the output of this frame.
    """
    density = Gaussian(camera.pose, jnp.asarray(camera.covariance, camera.pose.translation.dtype))
    if pose is not None:
        density = Gaussian(pose, jnp.zeros((6, 6), pose.translation.dtype))
        camera = eqx.tree_at(lambda c: (c.pose, c.covariance), camera, (pose, np.zeros((6, 6))))
    if found is None:
        none, output = np.zeros((0, 2)), (np.zeros((0, 6)), np.zeros((0, 4)), (), 0.0)
        return _advance(state, camera, state.phd, state.confirmations, found), Output(
            state.index, camera, none, *output, camera.timings
        )
    watch = Stopwatch()
    with watch.stage("flow"):
        known = None if pose is None else _reference_pose(state, found).inverse() @ pose
        points, span = _find_moving(state, camera, found, known)
    with watch.stage("group"):
        objects = jax.block_until_ready(group_points(points, options=state.config.group))
    with watch.stage("filter"):
        usable = jnp.asarray(camera.ok or pose is not None)
        dt = jnp.asarray(camera.time - state.time, jnp.float32)
        size = (found.current.left.shape[1], found.current.left.shape[0])
        rig = state.odometry.rig
        result = update_filter(state.phd, rig, density, (dt, span), objects, usable, size, state.config)
        phd, targets, uv, visible, count, measured = jax.block_until_ready(result)
        confirmations, tracks = state.confirmations.select(
            targets, np.asarray(uv), np.asarray(visible), state.config.confirm_frames
        )
    valid = np.asarray(objects.valid)
    output = Output(
        state.index,
        camera,
        np.asarray(points.uv)[np.asarray(points.valid)],
        np.concatenate([np.asarray(measured.position), np.asarray(measured.velocity)], axis=1)[valid],
        np.asarray(objects.boxes)[valid],
        tracks,
        float(count),
        camera.timings | watch.seconds,
    )
    return _advance(state, camera, phd, confirmations, found), output


def _advance(
    state: State, camera: OdometryOutput, phd: PhdState, confirmations: Confirmations, found: Evidence | None
) -> State:
    """The state for the next frame."""
    keyframe = (camera.pose, camera.time) if found is None else (_reference_pose(state, found), found.reference_time)
    return State(state.config, state.odometry, phd, confirmations, *keyframe, camera.pose, camera.time, state.index + 1)


def _reference_pose(state: State, found: Evidence) -> SE3:
    """Pose of the frame that this one was matched with: the keyframe as before, or the last frame."""
    return state.keyframe_pose if found.reference_time == state.keyframe_time else state.pose


def _find_moving(
    state: State, camera: OdometryOutput, found: Evidence, known: SE3 | None
) -> tuple[Any, Float[Array, ""]]:
    """Points that move, and the time between the frames that they are matched in."""
    motion = found.motion if known is None else _replace_motion(found.motion, known)
    span = jnp.asarray(camera.time - found.reference_time, jnp.float32)
    rig, options = state.odometry.rig, state.config.flow
    points = find_moving(rig, found.reference, found.current, found.matches, motion, span, options=options)
    return jax.block_until_ready(points), span


def _replace_motion(motion: RobustEstimate, pose: SE3) -> RobustEstimate:
    """An exactly known motion in place of the one that was estimated."""
    zero = jnp.zeros_like(motion.estimate.covariance)
    return eqx.tree_at(lambda m: (m.estimate.value, m.estimate.covariance), motion, (pose, zero))
