"""Measurement, detection, clutter, birth and survival models of trackers whose input are a detector's outputs.

A measurement is one vector: (x, y, z, score) of an object in the world, or (center x, center y, width, height, score)
of a box in an image. The state of a target is these values and their rates.
"""

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from jaxloc._linalg import matmul
from jaxloc.beliefs import Gaussian, Sensor
from jaxloc.poses.lie_group import as_floats
from jaxloc.tracking import Clutter, Detection, MeasuredBirth, PhdState, Targets, Tracker, TrackerInfo

POSITION, BOX = 4, 5  # entries of a measurement
MIN_EXISTENCE = 0.02  # of targets that are extracted
MIN_DEPTH = 1.0  # of the field of view, m
_MAX_DETECTION, _MIN_DETECTION = 0.99, 0.01


class Noise(eqx.Module):
    """Standard deviations of detections.

    Attributes:
        across: of an object's position perpendicular to the camera's axis, m.
        depth: along it, m.
        growth_across: increase of `across` for each m of depth.
        growth_depth: increase of `depth` for each m of depth.
        box: of a box's center and sides, as a fraction of its height.
        score: of the score about its mean.
    """

    across: float = 0.05
    depth: float = 0.06
    growth_across: float = 0.0012
    growth_depth: float = 0.003
    box: float = 0.05
    score: float = 1.2


class Measurement(eqx.Module):
    """Detections of one image, as the tracker takes them.

    Attributes:
        values: measurement vectors.
        camera: T_world_camera.
    """

    values: Float[Array, "*t m z"]
    camera: Float[Array, "*t 4 4"]


class Control(eqx.Module):
    """Time and camera motion from one image to the next.

    Attributes:
        dt: s.
        camera: T_world_camera of the next image.
    """

    dt: Float[Array, "*t"]
    camera: Float[Array, "*t 4 4"]


class DetectionSensor(Sensor):
    """Measurement of the first entries of the state, with noise that grows with depth or with the size of the box.

    Args:
        noise: standard deviations.
        camera: T_world_camera.
        size: entries of a measurement.

    Example:
        >>> sensor = DetectionSensor(Noise(across=0.1, depth=0.2, growth_depth=0.01, score=2.0), jnp.eye(4), POSITION)
        >>> sigmas = jnp.sqrt(jnp.diag(sensor.covariance(jnp.array([0.0, 0, 80, 5, 0, 0, 0, 0]), None)))
        >>> [round(float(sigma), 3) for sigma in sigmas]
        [0.196, 0.196, 1.0, 2.0]
    """

    noise: Noise
    camera: Float[Array, "4 4"]
    size: int = eqx.field(static=True)

    def expect(self, state: Float[Array, " d"], measurement: Any) -> Float[Array, " z"]:
        """Position and score."""
        del measurement
        return state[: self.size]

    def linearize(self, state: Float[Array, " d"], measurement: Any) -> tuple[Float[Array, " z"], Float[Array, "z d"]]:
        """Expected measurement and its constant Jacobian."""
        return self.expect(state, measurement), jnp.eye(self.size, state.shape[0], dtype=state.dtype)

    def covariance(self, state: Float[Array, " d"], measurement: Any) -> Float[Array, "z z"]:
        """Covariance of the noise, by the depth of the object or the height of the box."""
        del measurement
        noise, camera = self.noise, self.camera.astype(state.dtype)
        if self.size == BOX:
            sigmas = (
                jnp.full(self.size, noise.score, state.dtype).at[: self.size - 1].set(noise.box * jnp.abs(state[3]))
            )
            return jnp.diag(sigmas**2)
        axis = camera[:3, 2]
        depth = jnp.maximum(jnp.sum(axis * (state[:3] - camera[:3, 3])), 0.0)
        across = (noise.across + noise.growth_across * depth) ** 2
        along = (noise.depth + noise.growth_depth * depth) ** 2
        place = across * jnp.eye(3, dtype=state.dtype) + (along - across) * axis[:, None] * axis[None, :]
        return jax.scipy.linalg.block_diag(place, jnp.full((1, 1), noise.score**2, state.dtype))


class ScoredClutter(Clutter):
    """Uniformly distributed false detections with exponentially distributed positive scores.

    Args:
        rate: expected number in a frame.
        volume: of the space of positions or boxes.
        scale: mean of their scores.
    """

    rate: Float[Array, ""]
    volume: Float[Array, ""]
    scale: Float[Array, ""]

    def __init__(self, rate: Any, volume: Any, scale: Any):
        self.rate, self.volume, self.scale = as_floats(rate, volume, scale)

    def log_density(self, measurement: Float[Array, " z"]) -> Float[Array, ""]:
        """``- log V - s / scale - log scale``."""
        return -jnp.log(self.volume) - measurement[-1] / self.scale - jnp.log(self.scale)


class ScoredDetection(Detection):
    """Probability of detection as a logistic function of the target's score.

    Args:
        base: log odds of detection at a score of zero.
        slope: increase of the log odds with the score.
        index: of the score in the state.
    """

    base: Float[Array, ""]
    slope: Float[Array, ""]
    index: int = eqx.field(static=True)

    def __init__(self, base: Any, slope: Any, index: int):
        (self.base, self.slope), self.index = as_floats(base, slope), index

    def probability(self, state: Float[Array, " d"]) -> Float[Array, ""]:
        """Between 0.01 and 0.99."""
        odds = self.base + self.slope * state[self.index]
        return _MIN_DETECTION + (_MAX_DETECTION - _MIN_DETECTION) * jax.nn.sigmoid(odds)


class ScoredBirth(MeasuredBirth):
    """Births uniformly distributed over positions and scores, with normally distributed rates of zero mean.

    Args:
        rate: expected number in a frame.
        volume: of the space of positions or boxes, times the range of scores.
        sensor: gives the noise of the first measurement.
        variances: of the rates.
    """

    rate: Float[Array, ""]
    volume: Float[Array, ""]
    sensor: DetectionSensor
    variances: Float[Array, " r"]

    def __init__(self, rate: Any, volume: Any, sensor: DetectionSensor, variances: Any):
        self.rate, self.volume = as_floats(rate, volume)
        self.sensor, self.variances = sensor, variances

    def seed(self, measurement: Float[Array, " z"]) -> Gaussian:
        """The measurement with its noise, and rates of zero mean."""
        mean = jnp.concatenate([measurement, jnp.zeros_like(self.variances)])
        noise = self.sensor.covariance(mean, measurement)
        return Gaussian(mean, jax.scipy.linalg.block_diag(noise, jnp.diag(self.variances)))


class MovingCameraTracker(Tracker):
    """A tracker of targets seen by a moving camera: survival is less likely out of its view.

    Its controls are `Control` records, and its measurements `Measurement` records.

    Args:
        inner: the tracker, of a model with a `DetectionSensor` and `ScoredBirth`.
        survival: factor on the survival probability of targets that are out of view.
        half_view: tangent of the half angle of view; None where targets are never out of view.
    """

    inner: Tracker
    survival: float = eqx.field(static=True)
    half_view: float | None = eqx.field(static=True)

    def init(self, prior: Any) -> Any:
        """The inner tracker's state."""
        return self.inner.init(prior)

    def predict(self, state: Any, control: Control, *, key: Key[Array, ""] | None = None) -> Any:
        """Targets one step later, with reduced existence of those out of view."""
        state = self.inner.predict(state, control.dt, key=key)
        if self.half_view is None:
            return state
        if isinstance(state, PhdState):
            means, where = state.mixture.means, lambda s: s.mixture.weights
        else:
            means, where = state.means(), lambda s: s.existence
        factor = jnp.where(is_in_view(means[:, :3], control.camera, self.half_view), 1.0, self.survival)
        return eqx.tree_at(where, state, where(state) * factor)

    def update(
        self, state: Any, measurement: Measurement, valid: Bool[Array, " m"], *, key: Key[Array, ""] | None = None
    ) -> tuple[Any, TrackerInfo]:
        """Targets given the detections of an image, with noise by the pose of its camera."""

        def cameras(tracker: Any) -> tuple:
            return tracker.model.filter.sensor.camera, tracker.model.birth.sensor.camera

        inner = eqx.tree_at(cameras, self.inner, (measurement.camera, measurement.camera))
        return inner.update(state, measurement.values, valid, key=key)

    def extract(self, state: Any) -> Targets:
        """Targets with an existence of at least `MIN_EXISTENCE`; components of a PHD filter may share a label."""
        if isinstance(state, PhdState):  # its own threshold also decides which labels are kept apart
            return replace(self.inner, extraction=MIN_EXISTENCE).extract(state)
        return self.inner.extract(state)


def is_in_view(places: Float[Array, "k 3"], camera: Float[Array, "4 4"], half_view: float) -> Bool[Array, " k"]:
    """Which positions lie in a camera's horizontal field of view.

    Args:
        places: positions in the world.
        camera: T_world_camera.
        half_view: tangent of the half angle of view.

    Example:
        >>> is_in_view(jnp.array([[0.0, 0, 9], [9, 0, 9], [0, 0, -9]]), jnp.eye(4), 0.9).tolist()
        [True, False, False]
    """
    in_camera = matmul(places - camera[None, :3, 3].astype(places.dtype), camera[:3, :3].astype(places.dtype))
    x, z = in_camera[:, 0], in_camera[:, 2]
    return (z > MIN_DEPTH) & (jnp.abs(x) < half_view * jnp.maximum(z, 0.0))
