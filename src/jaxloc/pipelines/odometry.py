"""Stereo odometry on recordings: detect, match, refine, estimate the motion, add it up.

Host code that drives the pure functions of `jaxloc.slam`; features come from OpenCV's detectors.
"""

import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key

from jaxloc.beliefs import Gaussian, compounding
from jaxloc.features import opencv
from jaxloc.odometry import (
    MatchingOptions,
    MotionOptions,
    StereoFeatures,
    estimate_disparity_offset,
    estimate_motion,
    match_frames,
    match_stereo,
)
from jaxloc.poses import SE3
from jaxloc.refinement import StereoMatches
from jaxloc.sensors import StereoRig
from jaxloc.solvers import RobustEstimate


class Config(eqx.Module):
    """Options of stereo odometry.

    Attributes:
        detector: what stands out in an image.
        capacity: keypoints of an image.
        grid: rows and columns of cells over which keypoints are spread.
        matching: what counts as the same point.
        motion: how a motion is found among matches.
        keyframe_frames: greatest age of the keyframe that frames are matched with.
        keyframe_inliers: a keyframe with fewer inliers than this share of its first ones is replaced.
        lost_translation: standard deviation of a motion that had to be predicted, m.
        lost_rotation: the same, rad.
        seed: of the random samples.
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


class Step(eqx.Module):
    """What odometry says of one frame.

    Attributes:
        time: stamp of the frame, s.
        pose: ``T_world_camera``; the world is the first camera's frame.
        covariance: of the pose, right tangent (translation, rotation); that of the first frame is zero.
        relative: motion ``T_previous_current`` since the frame before.
        relative_covariance: of the motion, right tangent.
        ok: whether the motion was measured; where not, it was predicted.
        num_inliers: matches that agree with the motion.
        num_matches: matches found.
        timings: seconds by stage.
        uv_previous: "n 2" pixels of the matches in the keyframe's left image.
        uv_current: "n 2" the same in this one.
        inlier: "n" which of them agree.
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
    """What a motion was found from.

    Attributes:
        reference: features of the frame that this one was matched with.
        current: features of this frame.
        matches: between both.
        motion: of the camera from the reference to this frame.
        age: how many frames ago the reference was.
    """

    reference: StereoFeatures
    current: StereoFeatures
    matches: StereoMatches
    motion: RobustEstimate
    age: int


class _Keyframe(eqx.Module):
    """The frame that others are matched with."""

    features: StereoFeatures
    pose: Gaussian
    to_last: SE3
    age: int
    first_inliers: int


class _Stopwatch:
    """Seconds by stage of one frame."""

    def __init__(self):
        self.seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start


def steps(frames: Iterable[Any], rig: StereoRig, config: Config | None = None) -> Iterator[Step]:
    """Runs stereo odometry, a step a frame.

    A frame that cannot be matched (dark, blank, too different) is no error: its step is not ``ok``, its motion is that
    of the frame before with a grown covariance, and the next frame is matched with the last good one.

    Args:
        frames: records with ``time`` (s), ``left`` and ``right`` (rectified gray images), in order.
        rig: the stereo rig.
        config: options.

    Yields:
        A step for each frame, the first included.

    References:
        KELLY 9.2.4.3.3 [K-86, K-87]; thesis figure 3.3 for the front end [T-68...T-71].
    """
    for step, _ in steps_with_evidence(frames, rig, config):
        yield step


def calibrate_disparity(frames: Iterable[Any], rig: StereoRig, config: Config | None = None) -> Gaussian:
    """What to add to the disparities of a recording so that near and far points move alike.

    Give it to `MatchingOptions.disparity_offset`. The motions of the frames vote, weighted by each vote's precision;
    the variance is that of the votes' spread.

    Args:
        frames: some of the recording's frames, in order; twenty are plenty.
        rig: the stereo rig.
        config: options.

    Returns:
        The offset, px, as a Gaussian over a vector of one.

    Raises:
        ValueError: no motion could be measured.
    """
    votes = []
    for step, found in steps_with_evidence(frames, rig, config):
        if found is not None and step.ok:
            estimate = estimate_disparity_offset(rig, found.matches, found.motion)
            votes += [(float(estimate.value[1]), float(estimate.covariance[6, 6]))] * bool(estimate.ok)
    if not votes:
        raise ValueError("No motion could be measured in these frames: the disparity offset stays unknown.")
    values, variances = np.array(votes).T
    weights = 1.0 / variances
    mean = float(np.sum(weights * values) / np.sum(weights))
    spread = float(np.sum(weights * (values - mean) ** 2) / np.sum(weights)) / max(len(votes) - 1, 1)
    variance = max(spread, float(1.0 / np.sum(weights)))
    return Gaussian(jnp.array([mean]), jnp.array([[variance]]))


def steps_with_evidence(
    frames: Iterable[Any], rig: StereoRig, config: Config | None = None
) -> Iterator[tuple[Step, Evidence | None]]:
    """`steps`, each with what it was found from: None for the first."""
    config = Config() if config is None else config
    keys = _keys(config.seed)
    keyframe: _Keyframe | None = None
    motion = SE3.identity()
    for frame in frames:
        watch = _Stopwatch()
        features = _observe(frame, config, watch)
        if keyframe is None:
            origin = _known(SE3.identity())
            keyframe = _new_keyframe(features, origin)
            yield _first_step(frame, origin, watch), None
            continue
        prediction = keyframe.to_last @ motion
        matches, found = _measure(rig, keyframe, features, prediction, next(keys), config, watch)
        ok = bool(found.estimate.ok)
        with watch.stage("pose"):
            to_current = found.estimate.gaussian() if ok else _predicted(prediction, keyframe.age + 1, config)
            pose = compounding.compose(keyframe.pose, to_current)
            relative = compounding.compose(_known(keyframe.to_last.inverse()), to_current)
        step = _step(frame, pose, relative, matches, found, ok, watch)
        evidence = Evidence(keyframe.features, features, matches, found, keyframe.age + 1)
        keyframe = _next_keyframe(keyframe, features, pose, to_current.mean, step, config)
        motion = relative.mean
        yield step, evidence


def _measure(
    rig: StereoRig,
    keyframe: _Keyframe,
    features: StereoFeatures,
    prediction: SE3,
    key: Key[Array, ""],
    config: Config,
    watch: _Stopwatch,
) -> tuple[StereoMatches, RobustEstimate]:
    """Matches with the keyframe and the motion since then."""
    with watch.stage("track"):
        matches = match_frames(rig, keyframe.features, features, prediction, options=config.matching)
        matches = jax.block_until_ready(matches)
    with watch.stage("motion"):
        found = estimate_motion(rig, matches, prediction, key=key, options=config.motion)
        return matches, jax.block_until_ready(found)


def _keys(seed: int) -> Iterator[Array]:
    key = jax.random.key(seed)
    while True:
        key, use = jax.random.split(key)
        yield use


def _observe(frame: Any, config: Config, watch: _Stopwatch) -> StereoFeatures:
    """Keypoints and descriptors of both images, matched between them."""
    images = (frame.left, frame.right)
    with watch.stage("detect"):
        keypoints = tuple(opencv.detect(config.detector, image, config.capacity, config.grid) for image in images)
    with watch.stage("describe"):
        descriptors = tuple(opencv.describe(opencv.ORB(), image, k) for image, k in zip(images, keypoints, strict=True))
    with watch.stage("stereo"):
        gray = [jnp.asarray(np.asarray(image, dtype=np.float32)) for image in images]
        return jax.block_until_ready(match_stereo(*gray, keypoints, descriptors, options=config.matching))


def _known(pose: SE3) -> Gaussian:
    return Gaussian(pose, jnp.zeros((6, 6), pose.translation.dtype))


def _predicted(prediction: SE3, frames: int, config: Config) -> Gaussian:
    """A motion that could not be measured: its covariance grows with every frame that it bridges."""
    sigmas = np.repeat([config.lost_translation, config.lost_rotation], 3) * frames
    return Gaussian(prediction, jnp.diag(jnp.asarray(sigmas**2, prediction.translation.dtype)))


def _new_keyframe(features: StereoFeatures, pose: Gaussian) -> _Keyframe:
    return _Keyframe(features, pose, SE3.identity(pose.mean.translation.dtype), 0, 0)


def _next_keyframe(
    keyframe: _Keyframe, features: StereoFeatures, pose: Gaussian, to_current: SE3, step: Step, config: Config
) -> _Keyframe:
    """The keyframe for the frame to come: the same while it is young and well seen, or while there is none better."""
    age = keyframe.age + 1
    usable = int(features.has_depth.sum()) >= config.motion.min_inliers
    first = keyframe.first_inliers or step.num_inliers
    worn = age >= config.keyframe_frames or step.num_inliers < config.keyframe_inliers * first
    # After a frame without motion the old keyframe gets another chance, but not for ever.
    replace = usable and (worn if step.ok else age >= config.keyframe_frames + 5)
    if replace:
        return _new_keyframe(features, pose)
    return _Keyframe(keyframe.features, keyframe.pose, to_current, age, first)


def _first_step(frame: Any, pose: Gaussian, watch: _Stopwatch) -> Step:
    none, zero = np.zeros((0, 2)), np.zeros((6, 6))
    return Step(
        float(frame.time),
        pose.mean,
        zero,
        SE3.identity(),
        zero,
        True,
        0,
        0,
        watch.seconds,
        none,
        none,
        np.zeros(0, bool),
    )


def _step(
    frame: Any, pose: Gaussian, relative: Gaussian, matches: Any, found: RobustEstimate, ok: bool, watch: _Stopwatch
) -> Step:
    valid, inlier = np.asarray(matches.valid), np.asarray(found.inliers)
    return Step(
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
