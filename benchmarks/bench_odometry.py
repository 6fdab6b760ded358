"""Stereo odometry: drift and consistency on simulated KITTI geometry, and the whole pipeline on a rendered street."""

from collections.abc import Iterator
from functools import partial
from importlib.util import find_spec

import cv2
import jax
import jax.numpy as jnp
import numpy as np

import jaxloc as jl
from benchmarks.metric import ACCURACY, RATIO, TIME, Metric, Timing, timed, versus
from jaxloc.evaluation import consistency
from jaxloc.evaluation.trajectories import kitti_drift

_NOISE = 0.5


def metrics(smoke: bool) -> Iterator[Metric]:
    yield from _simulated(num_seeds=1 if smoke else 3, num_frames=120 if smoke else 600)
    if find_spec("jaxloc.pipelines.odometry") is not None:
        yield from _street(num_frames=6 if smoke else 60)


def _simulated(num_seeds: int, num_frames: int) -> Iterator[Metric]:
    """300 matches a frame, 0.5 px of noise, a quarter of the matches wrong; drift as the KITTI benchmark has it."""
    rig = jl.data.simulate.stereo_points.kitti_rig()
    keys = jax.random.split(jax.random.key(0), num_seeds)
    drives = [jl.data.simulate_stereo_points(key=key, num_frames=num_frames) for key in keys]
    run = jax.jit(partial(_motions, rig))
    run(drives[0].pairs, keys[0])
    results = [
        timed(lambda drive=drive, key=key: run(drive.pairs, key)) for drive, key in zip(drives, keys, strict=True)
    ]
    peers = [timed(lambda drive=drive: _opencv_motions(rig, drive.pairs)) for drive in drives]
    ours = [_path_errors(estimates.value, drive) for (estimates, _), drive in zip(results, drives, strict=True)]
    theirs = [_path_errors(motions, drive) for (motions, _), drive in zip(peers, drives, strict=True)]
    for index, (name, unit) in enumerate((("drift", "%"), ("rotation", "deg/m"))):
        mine, peer = (float(np.mean([errors[index] for errors in side])) for side in (ours, theirs))
        yield Metric(f"odometry.simulated.{name}", mine, unit, "lower", ACCURACY)
        yield Metric(f"odometry.simulated.{name}.cv2", peer, unit)
        yield Metric(f"odometry.simulated.{name}.vs_cv2", peer / mine, "x", "higher", ACCURACY)
    for side, paths in (("", [e.value for e, _ in results]), (".cv2", [motions for motions, _ in peers])):
        percent = np.mean([_path_errors(p, drive, (100.0,))[0] for p, drive in zip(paths, drives, strict=True)])
        yield Metric(f"odometry.simulated.drift_100m{side}", float(percent), "%", "lower", None if side else ACCURACY)
    yield from _consistency([estimates for (estimates, _) in results], drives)
    total = _sum(took for _, took in results)
    yield Metric("odometry.simulated.motion", 1e3 * total.wall / (num_seeds * (num_frames - 1)), "ms", "lower", TIME)
    yield from versus("odometry.simulated.motion.vs_cv2", total, _sum(took for _, took in peers))


def _motions(rig: jl.sensors.StereoRig, pairs: jl.data.StereoPairs, key: jax.Array) -> jl.solvers.Estimate:
    """Motions of a drive, each started at the one before; the first at rest."""
    noise = _NOISE**2 * jnp.eye(3, dtype=rig.camera.fx.dtype)

    def step(previous: jl.poses.SE3, item: tuple) -> tuple:
        pair, key = item
        matches = jl.refinement.StereoMatches.of(pair.previous, pair.current, noise, noise, None)
        estimate = jl.odometry.visual_odometry.estimate_motion(rig, matches, previous, key=key).estimate
        return estimate.value, estimate

    keys = jax.random.split(key, pairs.previous.shape[0])
    return jax.lax.scan(step, jl.poses.SE3.identity(noise.dtype), (pairs, keys))[1]


def _opencv_motions(rig: jl.sensors.StereoRig, pairs: jl.data.StereoPairs) -> jl.poses.SE3:
    """The usual recipe: triangulate, PnP with consensus, refine the inliers."""
    matrix = np.asarray(rig.camera.matrix(), float)
    left, right, row = np.moveaxis(np.asarray(pairs.previous, float), -1, 0)
    usable = left - right > 0.1
    depth = matrix[0, 0] * float(rig.baseline) / np.where(usable, left - right, 1.0)
    points = np.stack([(left - matrix[0, 2]) / matrix[0, 0], (row - matrix[1, 2]) / matrix[1, 1], 0 * row + 1], axis=-1)
    points *= depth[..., None]
    pixels = np.asarray(pairs.current, float)[..., [0, 2]]
    cv2.setRNGSeed(0)
    motions = [_opencv_motion(p[ok], z[ok], matrix) for p, z, ok in zip(points, pixels, usable, strict=True)]
    return jax.vmap(jl.poses.SE3.from_matrix)(jnp.asarray(np.stack(motions), rig.camera.fx.dtype))


def _opencv_motion(points: np.ndarray, pixels: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """``T_previous_current`` of points of the previous frame seen in the current one; no motion where it fails."""
    options = {"reprojectionError": 2.0, "iterationsCount": 200, "confidence": 0.999}
    found, rotation, translation, inliers = cv2.solvePnPRansac(points, pixels, matrix, None, **options)
    if not found or len(inliers) < 6:
        return np.eye(4)
    chosen = inliers[:, 0]
    rotation, translation = cv2.solvePnPRefineLM(points[chosen], pixels[chosen], matrix, None, rotation, translation)
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = cv2.Rodrigues(rotation)[0], translation[:, 0]
    return np.linalg.inv(motion)


def _path_errors(
    motions: jl.poses.SE3, drive: jl.data.StereoDrive, lengths: tuple[float, ...] | None = None
) -> tuple[float, float]:
    path = jl.poses.Trajectory(drive.truth.times, jl.poses.chain(drive.truth[0], motions))
    lengths = lengths or kitti_drift.fitting_lengths(float(drive.truth.length()))
    errors = kitti_drift.segment_errors(path, drive.truth, lengths=lengths)
    return float(errors.translation_percent()), float(errors.rotation_deg_per_meter())


def _consistency(estimates: list[jl.solvers.Estimate], drives: list[jl.data.StereoDrive]) -> Iterator[Metric]:
    """Do the motions' covariances say how wrong the motions are?"""
    squared = []
    for fits, drive in zip(estimates, drives, strict=True):
        gap = jax.vmap(lambda a, b: a.local(b))(fits.value, drive.pairs.motion)
        squared.append(jax.vmap(consistency.nees)(gap, fits.covariance))
    values = jax.tree.map(lambda *parts: jnp.concatenate(parts), *squared)
    yield Metric("odometry.simulated.nees", float(jnp.mean(values.values)), "of 6", "equal", ACCURACY)
    held = consistency.coverage(values, 6, probabilities=(0.95,))
    yield Metric("odometry.simulated.coverage95", float(held[0]), "share", "equal", 0.02)
    ok = jnp.concatenate([fits.ok for fits in estimates])
    yield Metric("odometry.simulated.ok", float(jnp.mean(ok)), "share", "higher", 0.01)


def _street(num_frames: int) -> Iterator[Metric]:
    """The pipeline from images to path; frames are rendered beforehand."""
    sequence = jl.data.simulate_street(num_frames=num_frames)
    frames = list(sequence)
    _pipeline(frames[:3], sequence.rig)  # compiles
    poses, ours = timed(lambda: _pipeline(frames, sequence.rig))
    peer_poses, peer = timed(lambda: _opencv_pipeline(frames, sequence.rig))
    yield Metric("odometry.street.frames_per_second", num_frames / ours.wall, "1/s", "higher", TIME)
    yield from versus("odometry.street.vs_cv2", ours, peer)
    for name, path in (("", poses), (".cv2", peer_poses)):
        estimate = jl.poses.Trajectory.from_matrices(
            sequence.truth.times, jnp.asarray(path, sequence.truth.times.dtype)
        )
        percent = float(kitti_drift.end_drift_percent(estimate, sequence.truth))
        yield Metric(f"odometry.street.drift{name}", percent, "%", "lower", None if name else RATIO)


def _pipeline(frames: list[jl.data.StereoFrame], rig: jl.sensors.StereoRig) -> np.ndarray:
    odometry = jl.pipelines.odometry
    return np.stack([np.asarray(step.pose.matrix()) for step in odometry.run(frames, odometry.Config(), rig)])


def _opencv_pipeline(frames: list[jl.data.StereoFrame], rig: jl.sensors.StereoRig) -> np.ndarray:
    """Corners, optical flow to the right image and to the next left one and back, and `_opencv_motion`."""
    matrix, baseline, poses = np.asarray(rig.camera.matrix(), float), float(rig.baseline), [np.eye(4)]
    focal, center = matrix[0, 0], matrix[:2, 2]
    for previous, current in zip(frames[:-1], frames[1:], strict=True):
        corners = cv2.goodFeaturesToTrack(previous.left, 600, 0.01, 8).reshape(-1, 1, 2)
        right, seen_right, _ = cv2.calcOpticalFlowPyrLK(previous.left, previous.right, corners, None)
        moved, seen, _ = cv2.calcOpticalFlowPyrLK(previous.left, current.left, corners, None)
        back, seen_back, _ = cv2.calcOpticalFlowPyrLK(current.left, previous.left, moved, None)
        here, right, there, back = (part.reshape(-1, 2).astype(float) for part in (corners, right, moved, back))
        kept = (seen_right & seen & seen_back).ravel().astype(bool)
        kept &= (np.abs(here[:, 1] - right[:, 1]) < 0.5) & (here[:, 0] - right[:, 0] > 1.0)
        kept &= np.linalg.norm(here - back, axis=1) < 0.5
        depth = focal * baseline / (here[kept, 0] - right[kept, 0])
        rays = np.column_stack([(here[kept] - center) / focal, np.ones(kept.sum())])
        motion = _opencv_motion(rays * depth[:, None], there[kept], matrix)
        poses.append(poses[-1] @ motion)
    return np.stack(poses)


def _sum(timings: Iterator[Timing]) -> Timing:
    return Timing(*(sum(part) for part in zip(*timings, strict=True)))
