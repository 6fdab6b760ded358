"""GM-PHD filter of moving objects that a stereo camera measures: birth, clutter, field of view, and its update."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxloc._jit import filter_jit
from jaxloc._linalg import matmul
from jaxloc.beliefs import Gaussian
from jaxloc.filters import ConstantVelocity, KalmanFilter
from jaxloc.odometry import FlowOptions, MovingObjects
from jaxloc.pipelines.moving_objects.options import Config
from jaxloc.sensors import MovingObject, MovingObjectSensor, StereoRig
from jaxloc.tracking import FieldOfView, GmPhd, MeasuredBirth, PhdState, TargetModel, Targets, UniformClutter


class ObjectBirth(MeasuredBirth):
    """Birth of a target from its first measurement, which gives both position and velocity.

    Attributes:
        rate: expected number of births in a frame.
        volume: of the measurement space, m^3 (m/s)^3.
        sensor: gives the covariance of the measurement.
    """

    rate: Float[Array, ""]
    volume: Float[Array, ""]
    sensor: MovingObjectSensor

    def seed(self, measurement: MovingObject) -> Gaussian:
        """The measured state with the covariance of the measurement."""
        state = jnp.concatenate([measurement.position, measurement.velocity])
        return Gaussian(state, self.sensor.covariance(state, measurement))


def build_tracker(
    rig: StereoRig, pose: Gaussian, span: Float[Array, ""], size: tuple[int, int], config: Config
) -> GmPhd:
    """The GM-PHD filter at a frame: field of view and measurement noise depend on the pose of the camera.

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


@filter_jit
def update_filter(
    state: PhdState,
    rig: StereoRig,
    pose: Gaussian,
    times: tuple[Float[Array, ""], Float[Array, ""]],
    objects: MovingObjects,
    usable: Any,
    size: tuple[int, int],
    config: Config,
) -> tuple[PhdState, Targets, Float[Array, "k 2"], Bool[Array, " k"], Float[Array, ""], MovingObject]:
    """A step of the filter.

    Args:
        state: of the filter.
        rig: the stereo rig.
        pose: of the left camera in the world.
        times: since the last frame, and between the frames that velocities are measured in, s.
        objects: measured, in the frame of the camera.
        usable: whether the pose is known, so that objects count.
        size: (width, height) of the images, px.
        config: options.

    Returns:
        The next state, the targets, their pixels and visibility, the expected number of objects, and the measurements
        in the world.
    """
    dt, span = times
    turned = matmul(objects.velocities, pose.mean.rotation.matrix().T)
    measured = jax.vmap(MovingObject)(pose.mean.apply(objects.positions), turned)
    tracker = build_tracker(rig, pose, span, size, config)
    state, info = tracker.update(tracker.predict(state, dt), measured, objects.valid & usable)
    targets = tracker.extract(state)
    places = pose.mean.inverse().apply(targets.means[:, :3])
    safe = jnp.where((places[:, 2] > 0.5)[:, None], places, jnp.array([[0.0, 0.0, 1.0]], places.dtype))
    visible = jax.vmap(tracker.model.detection.probability)(targets.means) > 0.0
    return state, targets, rig.camera.project(safe), visible, info.count, measured


def _volume(flow: FlowOptions, size: tuple[int, int]) -> float:
    """Volume of the measurement space, times the focal length.

    Positions in view and 4 m high, times velocities within the limit and 4 m/s up or down.
    """
    width, _ = size
    return 0.5 * flow.farthest**2 * width * 4.0 * (2.0 * flow.fastest) ** 2 * 8.0
