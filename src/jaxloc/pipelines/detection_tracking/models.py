"""What trackers assume of ready detections: how they err and score, where targets appear, and when they leave.

A measurement is a place and the detector's score, one vector: (x, y, z, score) of a solid in the world, or (center x,
center y, width, height, score) of a box in an image. The state of a target is that and its rates.
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

SOLID, BOX = 4, 5  # entries of a measurement
LEAST = 0.02  # existence of targets that are looked at
NEAREST = 1.0  # depth that a camera sees from, m
_ALWAYS, _NEVER = 0.99, 0.01  # no detector is surer of itself


class Noise(eqx.Module):
    """How detections err: standard deviations.

    Attributes:
        across: of a solid's place across the camera's axis, m.
        depth: along it, m.
        growth_across: more across for each m of depth.
        growth_depth: more along for each m of depth.
        box: of a box's center and sides, as a part of its height.
        score: of the score about its mean.
    """

    across: float = 0.05
    depth: float = 0.06
    growth_across: float = 0.0012
    growth_depth: float = 0.003
    box: float = 0.05
    score: float = 1.2


class Frame(eqx.Module):
    """What a detector made of an image.

    Attributes:
        values: measurements.
        camera: T_world_camera.
    """

    values: Float[Array, "*t m z"]
    camera: Float[Array, "*t 4 4"]


class Step(eqx.Module):
    """From one image to the next.

    Attributes:
        dt: s.
        camera: T_world_camera of the next one.
    """

    dt: Float[Array, "*t"]
    camera: Float[Array, "*t 4 4"]


class PlaceSensor(Sensor):
    """The first entries of the state: solids err more the farther they are, boxes the larger they are.

    Args:
        noise: standard deviations.
        camera: T_world_camera.
        size: entries of a measurement.

    Example:
        >>> sensor = PlaceSensor(Noise(across=0.1, depth=0.2, growth_depth=0.01, score=2.0), jnp.eye(4), SOLID)
        >>> sigmas = jnp.sqrt(jnp.diag(sensor.covariance(jnp.array([0.0, 0, 80, 5, 0, 0, 0, 0]), None)))
        >>> [round(float(sigma), 3) for sigma in sigmas]
        [0.196, 0.196, 1.0, 2.0]
    """

    noise: Noise
    camera: Float[Array, "4 4"]
    size: int = eqx.field(static=True)

    def expect(self, state: Float[Array, " d"], measurement: Any) -> Float[Array, " z"]:
        """The place and the score."""
        del measurement
        return state[: self.size]

    def linearize(self, state: Float[Array, " d"], measurement: Any) -> tuple[Float[Array, " z"], Float[Array, "z d"]]:
        """The same, and that the sensor is linear."""
        return self.expect(state, measurement), jnp.eye(self.size, state.shape[0], dtype=state.dtype)

    def covariance(self, state: Float[Array, " d"], measurement: Any) -> Float[Array, "z z"]:
        """Of a place, by its depth or its height."""
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
    """False detections anywhere, the fewer the surer: scores above zero are distributed exponentially.

    Args:
        rate: expected number in a frame.
        volume: of the places.
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
    """Targets of high scores are seldom missed: ``p_D`` is logistic in the score.

    Args:
        base: log odds of detection at a score of zero.
        slope: how they grow with the score.
        place: of the score in the state.
    """

    base: Float[Array, ""]
    slope: Float[Array, ""]
    place: int = eqx.field(static=True)

    def __init__(self, base: Any, slope: Any, place: int):
        (self.base, self.slope), self.place = as_floats(base, slope), place

    def probability(self, state: Float[Array, " d"]) -> Float[Array, ""]:
        """Between 0.01 and 0.99."""
        return _NEVER + (_ALWAYS - _NEVER) * jax.nn.sigmoid(self.base + self.slope * state[self.place])


class ScoredBirth(MeasuredBirth):
    """Targets appear anywhere with any score, and rates about zero.

    Args:
        rate: expected number in a frame.
        volume: of places times scores.
        sensor: for the noise of the first measurement.
        variances: of the rates.
    """

    rate: Float[Array, ""]
    volume: Float[Array, ""]
    sensor: PlaceSensor
    variances: Float[Array, " r"]

    def __init__(self, rate: Any, volume: Any, sensor: PlaceSensor, variances: Any):
        self.rate, self.volume = as_floats(rate, volume)
        self.sensor, self.variances = sensor, variances

    def seed(self, measurement: Float[Array, " z"]) -> Gaussian:
        """The measurement, and rates that are unknown."""
        mean = jnp.concatenate([measurement, jnp.zeros_like(self.variances)])
        noise = self.sensor.covariance(mean, measurement)
        return Gaussian(mean, jax.scipy.linalg.block_diag(noise, jnp.diag(self.variances)))


class WatchedTracker(Tracker):
    """A tracker with a camera that moves: targets out of its view are likely to be gone.

    Its controls are `Step` records, and its measurements `Frame` records.

    Args:
        inner: the tracker, of a model with a `PlaceSensor` and `ScoredBirth`.
        stay: survival of targets that are out of view, on top of the model's.
        half_view: tangent of the half angle of view; None where targets are never out of view.
    """

    inner: Tracker
    stay: float = eqx.field(static=True)
    half_view: float | None = eqx.field(static=True)

    def init(self, prior: Any) -> Any:
        """The inner tracker's state."""
        return self.inner.init(prior)

    def predict(self, state: Any, control: Step, *, key: Key[Array, ""] | None = None) -> Any:
        """Every target one step later, with doubts about those that went out of view."""
        state = self.inner.predict(state, control.dt, key=key)
        if self.half_view is None:
            return state
        if isinstance(state, PhdState):
            means, where = state.mixture.means, lambda s: s.mixture.weights
        else:
            means, where = state.means(), lambda s: s.existence
        factor = jnp.where(is_in_view(means[:, :3], control.camera, self.half_view), 1.0, self.stay)
        return eqx.tree_at(where, state, where(state) * factor)

    def update(
        self, state: Any, measurement: Frame, valid: Bool[Array, " m"], *, key: Key[Array, ""] | None = None
    ) -> tuple[Any, TrackerInfo]:
        """The targets given a frame, seen from where its camera is."""

        def cameras(tracker: Any) -> tuple:
            return tracker.model.filter.sensor.camera, tracker.model.birth.sensor.camera

        inner = eqx.tree_at(cameras, self.inner, (measurement.camera, measurement.camera))
        return inner.update(state, measurement.values, valid, key=key)

    def extract(self, state: Any) -> Targets:
        """All targets that are not quite unlikely; those of a PHD filter may share a label."""
        if isinstance(state, PhdState):
            return replace(self.inner, extraction=LEAST).extract(state)
        return self.inner.extract(state)


def is_in_view(places: Float[Array, "k 3"], camera: Float[Array, "4 4"], half_view: float) -> Bool[Array, " k"]:
    """Which places in the world a camera sees, sideways.

    Args:
        places: in the world.
        camera: T_world_camera.
        half_view: tangent of the half angle of view.

    Example:
        >>> is_in_view(jnp.array([[0.0, 0, 9], [9, 0, 9], [0, 0, -9]]), jnp.eye(4), 0.9).tolist()
        [True, False, False]
    """
    seen = matmul(places - camera[None, :3, 3].astype(places.dtype), camera[:3, :3].astype(places.dtype))
    return (seen[:, 2] > NEAREST) & (jnp.abs(seen[:, 0]) < half_view * jnp.maximum(seen[:, 2], 0.0))
