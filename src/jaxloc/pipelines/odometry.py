"""Stereo visual odometry: features, matches, motion between frames and the pose that follows from it.

Host code that drives the pure functions of `jaxloc.odometry`; features come from OpenCV's detectors.
"""

from collections.abc import Iterable, Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key

from jaxloc.beliefs import Gaussian, compounding
from jaxloc.features import Descriptors, opencv
from jaxloc.odometry import (
    MatchingOptions,
    MotionOptions,
    StereoFeatures,
    estimate_disparity_offset,
    estimate_motion,
    match_frames,
    match_stereo,
)
from jaxloc.pipelines.input_checks import check_stereo_images
from jaxloc.pipelines.stopwatch import Stopwatch
from jaxloc.poses import SE3
from jaxloc.refinement import StereoMatches
from jaxloc.sensors import StereoRig
from jaxloc.solvers import RobustEstimate


class Config(eqx.Module):
    """Options of stereo odometry.

    Attributes:
        detector: keypoint detector.
        capacity: number of keypoints in an image.
        grid: rows and columns of cells over which keypoints are evenly distributed.
        matching: options of stereo and temporal matching.
        motion: options of the robust motion estimate.
        keyframe_frames: greatest age of the keyframe that frames are matched with, in frames.
        keyframe_inliers: a keyframe with fewer inliers than this fraction of its first ones is replaced.
        lost_translation: standard deviation of a motion that had to be predicted, m.
        lost_rotation: the same, rad.
        seed: of the random samples of the motion estimate.
    """

    detector: opencv.AbstractDetector = opencv.ShiTomasi()
    capacity: int = 1600
    grid: tuple[int, int] = (6, 12)
    matching: MatchingOptions = MatchingOptions()
    motion: MotionOptions = MotionOptions()
    keyframe_frames: int = 1
    keyframe_inliers: float = 0.5
    lost_translation: float = 0.3
    lost_rotation: float = 0.03
    seed: int = 0


class Output(eqx.Module):
    """Pose and motion estimated at one frame.

    Attributes:
        time: stamp of the frame, s.
        pose: ``T_world_camera``; the world is the first camera's frame.
        covariance: of the pose, right tangent (translation, rotation); that of the first frame is zero.
        relative: motion ``T_previous_current`` since the previous frame.
        relative_covariance: of the motion, right tangent.
        ok: whether the motion was measured; otherwise it was predicted at constant velocity.
        num_inliers: number of matches that agree with the motion.
        num_matches: number of matches.
        timings: wall time by stage, s.
        uv_previous: "n 2" pixels of the matches in the keyframe's left image.
        uv_current: "n 2" the same in this frame's left image.
        inlier: "n" which matches agree with the motion.
    """

    time: float
    pose: SE3
    covariance: np.ndarray
    relative: SE3
    relative_covariance: np.ndarray
    ok: bool
    num_inliers: int
    num_matches: int
    timings: dict[str, float]
    uv_previous: np.ndarray
    uv_current: np.ndarray
    inlier: np.ndarray


class Evidence(eqx.Module):
    """Features and matches that a motion was estimated from.

    Attributes:
        reference: features of the keyframe.
        current: features of this frame.
        matches: between both.
        motion: of the camera from the keyframe to this frame.
        reference_time: stamp of the keyframe, s.
        age: number of frames since the keyframe.
    """

    reference: StereoFeatures
    current: StereoFeatures
    matches: StereoMatches
    motion: RobustEstimate
    reference_time: float
    age: int


class Keyframe(eqx.Module):
    """The frame that later frames are matched with.

    Attributes:
        features: of the frame.
        pose: ``T_world_keyframe``.
        to_last: ``T_keyframe_last`` of the last frame.
        time: stamp, s.
        age: number of frames since then.
        first_inliers: inliers of the first frame matched with it; 0 before.
    """

    features: StereoFeatures
    pose: Gaussian
    to_last: SE3
    time: float
    age: int
    first_inliers: int


class State(eqx.Module):
    """State of stereo odometry between two frames.

    Attributes:
        config: options.
        rig: the stereo rig.
        keyframe: the frame that the next one is matched with.
        motion: last motion ``T_previous_current``, which predicts the next one.
        key: of the random samples to come.
        shape: rows and columns of the images; (0, 0) before the first frame.
    """

    config: Config
    rig: StereoRig
    keyframe: Keyframe
    motion: SE3
    key: Key[Array, ""]
    shape: tuple[int, int]


def init(config: Config, rig: StereoRig) -> State:
    """The state before the first frame.

    Args:
        config: options.
        rig: the stereo rig.
    """
    keyframe = _new_keyframe(_no_features(), _exact(SE3.identity()), 0.0)
    return State(config, rig, keyframe, SE3.identity(), jax.random.key(config.seed), (0, 0))


def step(state: State, frame: Any) -> tuple[State, Output]:
    """Estimates the pose of the next frame.

    A frame that cannot be matched (dark, blank, too different) is no error: its output is not ``ok``, its motion is
    predicted at constant velocity with a grown covariance, and the next frame is matched with the last usable one.

    Args:
        state: from `init` or the last step.
        frame: record with ``time`` (s), ``left`` and ``right`` (rectified grayscale images).

    Returns:
        The next state, and the output of this frame.

    Raises:
        ValueError: an image is missing, no grayscale image of bytes or floats, or of another size than those before.

    References:
        KELLY 9.2.4.3.3 [K-86, K-87]; thesis figure 3.3 for the front end [T-68...T-71].
    """
    state, output, _ = step_with_evidence(state, frame)
    return state, output


def run(frames: Iterable[Any], config: Config, rig: StereoRig) -> Iterator[Output]:
    """Runs stereo odometry over a recording, see `step`.

    Args:
        frames: records with ``time``, ``left`` and ``right``, in order.
        config: options.
        rig: the stereo rig.

    Yields:
        An output for each frame, the first included.
    """
    for output, _ in run_with_evidence(frames, config, rig):
        yield output


def run_with_evidence(
    frames: Iterable[Any], config: Config, rig: StereoRig
) -> Iterator[tuple[Output, Evidence | None]]:
    """`run`, each output with the matches it was estimated from: None for the first."""
    state = init(config, rig)
    for frame in frames:
        state, output, evidence = step_with_evidence(state, frame)
        yield output, evidence


def step_with_evidence(state: State, frame: Any) -> tuple[State, Output, Evidence | None]:
    """`step`, with the matches that the output was estimated from: None for the first frame."""
    config, rig, keyframe = state.config, state.rig, state.keyframe
    shape, watch = check_stereo_images(frame, state.shape), Stopwatch()
    features = _extract(frame, config, watch)
    if state.shape == (0, 0):
        keyframe = _new_keyframe(features, keyframe.pose, float(frame.time))
        first = State(config, rig, keyframe, state.motion, state.key, shape)
        return first, _first_output(frame, keyframe.pose, watch), None
    key, key_motion = jax.random.split(state.key)
    prediction = keyframe.to_last @ state.motion
    matches, found = _measure(state, features, prediction, key_motion, watch)
    ok = bool(found.estimate.ok)
    with watch.stage("pose"):
        to_current = found.estimate.gaussian() if ok else _predicted(prediction, keyframe.age + 1, config)
        pose = compounding.compose(keyframe.pose, to_current)
        relative = compounding.compose(_exact(keyframe.to_last.inverse()), to_current)
    output = _output(frame, pose, relative, matches, found, ok, watch)
    evidence = Evidence(keyframe.features, features, matches, found, keyframe.time, keyframe.age + 1)
    keyframe = _next_keyframe(keyframe, features, pose, to_current.mean, output, config)
    return State(config, rig, keyframe, relative.mean, key, shape), output, evidence


def calibrate_disparity(frames: Iterable[Any], rig: StereoRig, config: Config | None = None) -> Gaussian:
    """Estimates the constant error of a recording's disparities, so that near and far points agree on the motion.

    Give the result to `MatchingOptions.disparity_offset`. It is the mean of the estimates from each pair of frames,
    weighted by their precision; its variance is the larger of the propagated one and the variance of the mean
    estimated from their scatter.

    Args:
        frames: some of the recording's frames, in order; twenty are plenty.
        rig: the stereo rig.
        config: options.

    Returns:
        The offset to add, px, as a Gaussian over a vector of one.

    Raises:
        ValueError: no motion could be measured.
    """
    estimates = []
    for output, found in run_with_evidence(frames, Config() if config is None else config, rig):
        if found is not None and output.ok:
            estimate = estimate_disparity_offset(rig, found.matches, found.motion)
            estimates += [(float(estimate.value[1]), float(estimate.covariance[6, 6]))] * bool(estimate.ok)
    if not estimates:
        raise ValueError("No motion could be measured in these frames: the disparity offset stays unknown.")
    values, variances = np.array(estimates).T
    weights = 1.0 / variances
    mean = float(np.sum(weights * values) / np.sum(weights))
    scatter = float(np.sum(weights * (values - mean) ** 2) / np.sum(weights)) / max(len(estimates) - 1, 1)
    variance = max(scatter, float(1.0 / np.sum(weights)))
    return Gaussian(jnp.array([mean]), jnp.array([[variance]]))


def _measure(
    state: State, features: StereoFeatures, prediction: SE3, key: Key[Array, ""], watch: Stopwatch
) -> tuple[StereoMatches, RobustEstimate]:
    """Matches with the keyframe and the motion since then."""
    rig, config, reference = state.rig, state.config, state.keyframe.features
    with watch.stage("track"):
        matches = match_frames(rig, reference, features, prediction, options=config.matching)
        matches = jax.block_until_ready(matches)
    with watch.stage("motion"):
        found = estimate_motion(rig, matches, prediction, key=key, options=config.motion)
        return matches, jax.block_until_ready(found)


def _extract(frame: Any, config: Config, watch: Stopwatch) -> StereoFeatures:
    """Keypoints and descriptors of both images, matched between them."""
    images = (frame.left, frame.right)
    with watch.stage("detect"):
        keypoints = tuple(opencv.detect(config.detector, image, config.capacity, config.grid) for image in images)
    with watch.stage("describe"):
        descriptors = tuple(opencv.describe(opencv.ORB(), image, k) for image, k in zip(images, keypoints, strict=True))
    with watch.stage("stereo"):
        gray = [jnp.asarray(np.asarray(image, dtype=np.float32)) for image in images]
        return jax.block_until_ready(match_stereo(*gray, keypoints, descriptors, options=config.matching))


def _no_features() -> StereoFeatures:
    """Features of an empty image."""
    image, none = jnp.zeros((0, 0), jnp.float32), jnp.zeros(0, bool)
    descriptors = Descriptors(jnp.zeros((0, 32), jnp.uint8), none)
    return StereoFeatures(image, image, descriptors, jnp.zeros((0, 3), jnp.float32), jnp.zeros(0, jnp.float32), none)


def _exact(pose: SE3) -> Gaussian:
    return Gaussian(pose, jnp.zeros((6, 6), pose.translation.dtype))


def _predicted(prediction: SE3, frames: int, config: Config) -> Gaussian:
    """A motion that could not be measured: its standard deviation grows with the number of frames that it bridges."""
    sigmas = np.repeat([config.lost_translation, config.lost_rotation], 3) * frames
    return Gaussian(prediction, jnp.diag(jnp.asarray(sigmas**2, prediction.translation.dtype)))


def _new_keyframe(features: StereoFeatures, pose: Gaussian, time: float) -> Keyframe:
    return Keyframe(features, pose, SE3.identity(pose.mean.translation.dtype), time, 0, 0)


def _next_keyframe(
    keyframe: Keyframe, features: StereoFeatures, pose: Gaussian, to_current: SE3, output: Output, config: Config
) -> Keyframe:
    """The keyframe for the next frame: replaced when it is old or has lost inliers, if this frame has enough points."""
    age = keyframe.age + 1
    usable = int(features.has_depth.sum()) >= config.motion.min_inliers
    first = keyframe.first_inliers or output.num_inliers
    outdated = age >= config.keyframe_frames or output.num_inliers < config.keyframe_inliers * first
    # After a frame without motion the old keyframe is tried some more times before it is given up.
    replace = usable and (outdated if output.ok else age >= config.keyframe_frames + 5)
    if replace:
        return _new_keyframe(features, pose, output.time)
    return Keyframe(keyframe.features, keyframe.pose, to_current, keyframe.time, age, first)


def _first_output(frame: Any, pose: Gaussian, watch: Stopwatch) -> Output:
    none, zero = np.zeros((0, 2)), np.zeros((6, 6))
    identity, no_match = SE3.identity(), np.zeros(0, bool)
    return Output(float(frame.time), pose.mean, zero, identity, zero, True, 0, 0, watch.seconds, none, none, no_match)


def _output(
    frame: Any, pose: Gaussian, relative: Gaussian, matches: Any, found: RobustEstimate, ok: bool, watch: Stopwatch
) -> Output:
    valid, inlier = np.asarray(matches.valid), np.asarray(found.inliers)
    return Output(
        time=float(frame.time),
        pose=pose.mean,
        covariance=np.asarray(pose.covariance),
        relative=relative.mean,
        relative_covariance=np.asarray(relative.covariance),
        ok=ok,
        num_inliers=int(inlier.sum()),
        num_matches=int(valid.sum()),
        timings=watch.seconds,
        uv_previous=np.asarray(matches.previous)[valid][:, [0, 2]],
        uv_current=np.asarray(matches.current)[valid][:, [0, 2]],
        inlier=inlier[valid],
    )
