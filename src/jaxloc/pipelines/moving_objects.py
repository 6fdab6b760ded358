"""Detection and tracking of moving objects from a moving stereo camera.

Odometry explains what stands still; points that it does not explain are matched again, grouped to objects with place
and velocity, and a GM-PHD filter follows these in the world.
"""

import time
from collections.abc import Iterable, Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxloc._linalg import matmul
from jaxloc.beliefs import Closeness, Gaussian, MahalanobisDistance, Mixture
from jaxloc.filters import ConstantVelocity, KalmanFilter
from jaxloc.odometry import FlowOptions, GroupOptions, MovingObjects, find_moving, group_points
from jaxloc.pipelines.odometry import Config as OdometryConfig
from jaxloc.pipelines.odometry import Evidence, steps_with_evidence
from jaxloc.pipelines.odometry import Step as OdometryStep
from jaxloc.poses import SE3
from jaxloc.sensors import MovingObject, MovingObjectSensor, StereoRig
from jaxloc.solvers import RobustEstimate
from jaxloc.tracking import FieldOfView, GmPhd, MeasuredBirth, PhdState, TargetModel, Targets, UniformClutter


class Config(eqx.Module):
    """Options of detection and tracking of moving objects.

    Attributes:
        odometry: how the motion of the camera is found.
        flow: which points move.
        group: which of them are one object.
        acceleration: spectral density of what objects do beside driving straight, m^2/s^3.
        detection: probability that an object in view is measured in a frame.
        survival: probability that an object is still there in the next frame.
        clutter_rate: expected number of false objects in a frame.
        birth_rate: expected number of new ones.
        sigma: standard deviation of a point's measurement, px.
        extent: standard deviation of the visible part's center in its object, m.
        capacity: components of the filter.
        merge: which components are merged.
        confirm_frames: a track is reported once it was believed in so many frames.
        keep_weight: a track that was reported still is while its weight is at least this.
    """

    odometry: OdometryConfig = OdometryConfig()
    flow: FlowOptions = FlowOptions()
    group: GroupOptions = GroupOptions()
    acceleration: float = 4.0
    detection: float = 0.6
    survival: float = 0.98
    clutter_rate: float = 1.0
    birth_rate: float = 0.3
    sigma: float = 0.4
    extent: float = 0.7
    capacity: int = 64
    merge: Closeness = MahalanobisDistance()
    confirm_frames: int = 2
    keep_weight: float = 0.15


class Track(eqx.Module):
    """An object in a frame.

    Attributes:
        label: number of the track.
        state: position (m) and velocity (m/s) in the world.
        covariance: of the state.
        weight: expected number of objects here.
        uv: where it is in the left image, px.
    """

    label: int
    state: np.ndarray
    covariance: np.ndarray
    weight: float
    uv: np.ndarray


class Step(eqx.Module):
    """What the pipeline says of one frame.

    Attributes:
        index: of the frame.
        odometry: the motion of the camera; its pose is that of the given poses, where there are any.
        points: "n 2" pixels of moving points.
        objects: "k 6" position and velocity in the world of what was measured.
        boxes: "k 4" of these in the left image.
        tracks: confirmed ones.
        count: expected number of objects.
        timings: seconds by stage.
    """

    index: int
    odometry: OdometryStep
    points: np.ndarray
    objects: np.ndarray
    boxes: np.ndarray
    tracks: tuple[Track, ...]
    count: float
    timings: dict[str, float]


class ObjectBirth(MeasuredBirth):
    """An object is born with its first measurement: place and velocity are both known from it.

    Attributes:
        rate: expected number of births in a frame.
        volume: of the measurement space, m^3 (m/s)^3.
        sensor: what gives the covariance of the measurement.
    """

    rate: Float[Array, ""]
    volume: Float[Array, ""]
    sensor: MovingObjectSensor

    def seed(self, measurement: MovingObject) -> Gaussian:
        """As measured."""
        state = jnp.concatenate([measurement.position, measurement.velocity])
        return Gaussian(state, self.sensor.covariance(state, measurement))


class _Memory:
    """Which tracks have been believed in how often: what is not worth a place in the filter's state."""

    def __init__(self, config: Config):
        self.config = config
        self.believed: dict[int, int] = {}

    def confirm(self, targets: Targets, uv: np.ndarray, seen: np.ndarray) -> tuple[Track, ...]:
        """The tracks in view to report; of several components with one label the heaviest."""
        rows = jax.tree.map(np.asarray, targets)
        tracks: dict[int, Track] = {}
        for i in np.argsort(-rows.probabilities):
            label, weight = int(rows.labels[i]), float(rows.probabilities[i])
            if not (rows.valid[i] and seen[i]) or label in tracks:
                continue
            self.believed[label] = self.believed.get(label, 0) + (weight > 0.5)
            if self.believed[label] >= self.config.confirm_frames:
                tracks[label] = Track(label, rows.means[i], rows.covariances[i], weight, uv[i])
        return tuple(tracks.values())


def steps(
    frames: Iterable[Any], rig: StereoRig, config: Config | None = None, *, poses: SE3 | None = None
) -> Iterator[Step]:
    """Runs odometry and tracking, a step a frame.

    Args:
        frames: records with ``time`` (s), ``left`` and ``right`` (rectified gray images), in order.
        rig: the stereo rig.
        config: options.
        poses: ``T_world_camera`` of each frame, stacked, if they are known: exact ones; None for those of the odometry.

    Yields:
        A step for each frame; objects begin with the second.

    References:
        Thesis figure 3.3 [T-68], section 5.4 [T-78], [T-79]; static and dynamic points [T-4].
    """
    config = Config() if config is None else config
    yield from follow(steps_with_evidence(frames, rig, config.odometry), rig, config, poses=poses)


def follow(
    odometry: Iterable[tuple[OdometryStep, Evidence | None]],
    rig: StereoRig,
    config: Config | None = None,
    *,
    poses: SE3 | None = None,
) -> Iterator[Step]:
    """`steps` for an odometry that runs, or ran, already.

    Args:
        odometry: its steps with evidence.
        rig: the stereo rig.
        config: options.
        poses: as of `steps`.

    Yields:
        A step for each frame.
    """
    config = Config() if config is None else config
    state, memory, times = _start(config), _Memory(config), []
    for index, (step, found) in enumerate(odometry):
        times.append(step.time)
        pose = Gaussian(step.pose, jnp.asarray(step.covariance, step.pose.translation.dtype))
        if poses is not None:
            pose = _exact(jax.tree.map(lambda leaf, i=index: leaf[i], poses))
            step = eqx.tree_at(lambda s: (s.pose, s.covariance), step, (pose.mean, np.zeros((6, 6))))
        if found is None:
            yield Step(index, step, np.zeros((0, 2)), np.zeros((0, 6)), np.zeros((0, 4)), (), 0.0, step.timings)
            continue
        began = time.perf_counter()
        motion, age = found.motion, found.age
        if poses is not None:
            before = jax.tree.map(lambda leaf, i=index - age: leaf[i], poses)
            motion = _given(motion, before.inverse() @ pose.mean)
        span = jnp.asarray(step.time - times[index - age], jnp.float32)
        points = find_moving(rig, found.reference, found.current, found.matches, motion, span, options=config.flow)
        points = jax.block_until_ready(points)
        flowed = time.perf_counter()
        objects = jax.block_until_ready(group_points(points, options=config.group))
        grouped = time.perf_counter()
        size = (found.current.left.shape[1], found.current.left.shape[0])
        dt = jnp.asarray(step.time - times[index - 1], jnp.float32)
        usable = jnp.asarray(step.ok or poses is not None)
        result = _track(state, rig, pose, dt, span, objects, usable, size, config)
        state, targets, uv, seen, count, measured = jax.block_until_ready(result)
        tracks = memory.confirm(targets, np.asarray(uv), np.asarray(seen))
        done = time.perf_counter()
        spent = {"flow": flowed - began, "group": grouped - flowed, "filter": done - grouped}
        valid = np.asarray(objects.valid)
        yield Step(
            index,
            step,
            np.asarray(points.uv)[np.asarray(points.valid)],
            np.concatenate([np.asarray(measured.position), np.asarray(measured.velocity)], axis=1)[valid],
            np.asarray(objects.boxes)[valid],
            tracks,
            float(count),
            step.timings | spent,
        )


def build_tracker(
    rig: StereoRig, pose: Gaussian, span: Float[Array, ""], size: tuple[int, int], config: Config
) -> GmPhd:
    """The filter at a frame: what is seen, and how well, depends on where the camera is.

    Args:
        rig: the stereo rig.
        pose: of the left camera in the world.
        span: time between the frames that velocities are measured in, s.
        size: (width, height) of the images, px.
        config: options.
    """
    sensor = MovingObjectSensor(
        rig,
        pose.mean,
        pose.covariance,
        span,
        sigma=config.sigma,
        points=config.group.fewest_points,
        extent=config.extent,
    )
    volume = jnp.asarray(_volume(config.flow, size), span.dtype) / rig.camera.fx
    model = TargetModel(
        KalmanFilter(ConstantVelocity(config.acceleration, axes=3), sensor),
        detection=FieldOfView(config.detection, rig.camera, pose.mean, size, farthest=config.flow.farthest),
        survival=config.survival,
        clutter=UniformClutter(config.clutter_rate, volume),
        birth=ObjectBirth(jnp.asarray(config.birth_rate, span.dtype), volume, sensor),
    )
    return GmPhd(model, capacity=config.capacity, closeness=config.merge, gate=0.999, extraction=config.keep_weight)


@eqx.filter_jit
def _track(
    state: PhdState,
    rig: StereoRig,
    pose: Gaussian,
    dt: Float[Array, ""],
    span: Float[Array, ""],
    objects: MovingObjects,
    usable: Any,
    size: tuple[int, int],
    config: Config,
) -> tuple[PhdState, Targets, Float[Array, "k 2"], Bool[Array, " k"], Float[Array, ""], MovingObject]:
    """A step of the filter: its state, the targets, where in the image and if in view, how many, what was measured."""
    turned = matmul(objects.velocities, pose.mean.rotation.matrix().T)
    measured = jax.vmap(MovingObject)(pose.mean.apply(objects.positions), turned)
    tracker = build_tracker(rig, pose, span, size, config)
    state, info = tracker.update(tracker.predict(state, dt), measured, objects.valid & usable)
    targets = tracker.extract(state)
    places = pose.mean.inverse().apply(targets.means[:, :3])
    safe = jnp.where((places[:, 2] > 0.5)[:, None], places, jnp.array([[0.0, 0.0, 1.0]], places.dtype))
    seen = jax.vmap(tracker.model.detection.probability)(targets.means) > 0.0
    return state, targets, rig.camera.project(safe), seen, info.count, measured


def _start(config: Config) -> PhdState:
    """Nobody is there yet."""
    nobody = Mixture.empty(config.capacity, jnp.zeros(6, jnp.float32))
    return PhdState(nobody, jnp.zeros((), jnp.int32), _first_label(), jnp.ones((), jnp.float32))


def _first_label() -> Int[Array, ""]:
    return jnp.ones((), jnp.int32)


def _exact(pose: SE3) -> Gaussian:
    return Gaussian(pose, jnp.zeros((6, 6), pose.translation.dtype))


def _given(motion: RobustEstimate, pose: SE3) -> RobustEstimate:
    """A motion known otherwise, in place of the one that was estimated."""
    zero = jnp.zeros_like(motion.estimate.covariance)
    return eqx.tree_at(lambda m: (m.estimate.value, m.estimate.covariance), motion, (pose, zero))


def _volume(flow: FlowOptions, size: tuple[int, int]) -> float:
    """Times the focal length: of places in view, 4 m high, and of velocities within the limit, 4 m/s up or down."""
    width, _ = size
    return 0.5 * flow.farthest**2 * width * 4.0 * (2.0 * flow.fastest) ** 2 * 8.0
