"""The multi-target model that all trackers share: motion, detection, survival, clutter and births."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxloc.filters import Filter
from jaxloc.poses import SE3
from jaxloc.poses.lie_group import as_floats
from jaxloc.sensors import Pinhole
from jaxloc.tracking.models.birth import Birth, MeasuredBirth
from jaxloc.tracking.models.clutter import Clutter


class Detection(eqx.Module):
    """Interface of detection probabilities."""

    @abstractmethod
    def probability(self, state: Any) -> Float[Array, ""]:
        """Probability of detection of a target in a state."""


class ConstantDetection(Detection):
    """Constant probability of detection.

    Args:
        value: p_D.
    """

    value: Float[Array, ""]

    def __init__(self, value: Any):
        (self.value,) = as_floats(value)

    def probability(self, state: Any) -> Float[Array, ""]:
        """p_D."""
        del state
        return self.value


class FieldOfView(Detection):
    """Probability of detection inside the field of view of a camera, zero outside. States begin with a world position.

    Args:
        value: p_D in view.
        camera: intrinsics.
        pose: ``T_world_camera``.
        size: (width, height) of the image, px.
        farthest: largest depth of detections, m.
        nearest: least depth of detections, m.
    """

    value: Float[Array, ""]
    camera: Pinhole
    pose: SE3
    size: Float[Array, "2"]
    farthest: Float[Array, ""]
    nearest: Float[Array, ""]

    def __init__(self, value: Any, camera: Pinhole, pose: SE3, size: Any, *, farthest: Any, nearest: Any = 2.0):
        self.value, self.farthest, self.nearest = as_floats(value, farthest, nearest)
        self.size = jnp.stack(as_floats(*size))
        self.camera, self.pose = camera, pose

    def probability(self, state: Float[Array, " d"]) -> Float[Array, ""]:
        """p_D in view, else zero."""
        place = self.pose.inverse().apply(state[None, :3])
        ahead = (place[0, 2] > self.nearest) & (place[0, 2] < self.farthest)
        uv = self.camera.project(jnp.where(ahead, place, jnp.array([[0.0, 0.0, 1.0]], place.dtype)))[0]
        seen = ahead & jnp.all((uv >= 0.0) & (uv < self.size))
        return jnp.where(seen, self.value, 0.0)


class TargetModel(eqx.Module):
    """The assumptions of the standard multi-target model: independent targets, each measured at most once in a scan.

    Args:
        filter: the filter of one target, with motion and sensor model: a `KalmanFilter` for linear models,
            an `ExtendedKalmanFilter` (one iteration) or a `SigmaPointFilter`. Its own gate is not used. Some trackers
            take `InteractingMultipleModel` as well.
        detection: p_D, a number or a `Detection`.
        survival: p_S, probability that a target exists at the next scan.
        clutter: false measurements.
        birth: new targets.

    References:
        Mahler, "Multitarget Bayes filtering via first-order multitarget moments", IEEE TAES 2003 [T-62], [T-74].
    """

    filter: Filter
    detection: Detection
    survival: Float[Array, ""]
    clutter: Clutter
    birth: Birth

    def __init__(self, filter: Filter, *, detection: Any, survival: Any, clutter: Clutter, birth: Birth):
        self.filter, self.clutter, self.birth = filter, clutter, birth
        self.detection = detection if isinstance(detection, Detection) else ConstantDetection(detection)
        (self.survival,) = as_floats(survival)

    @property
    def usable(self) -> Bool[Array, ""]:
        """Whether survival is a probability, and rates are rates; updates are not ``ok`` where they are not."""
        rates = [self.clutter.rate, *([self.birth.rate] if isinstance(self.birth, MeasuredBirth) else [])]
        fine = [(rate >= 0.0) & jnp.isfinite(rate) for rate in rates]
        return is_probability(self.survival) & jnp.all(jnp.stack(fine))

    def survival_probability(self) -> Float[Array, ""]:
        """p_S within [0, 1]; one where it is NaN."""
        bound = jnp.where(self.survival < 0.0, 0.0, 1.0).astype(self.survival.dtype)
        return jnp.where(is_probability(self.survival), self.survival, bound)

    def detect(self, states: Any) -> tuple[Float[Array, " k"], Bool[Array, " k"]]:
        """p_D of stacked states, zero where it is no probability; and where it is one."""
        found = jax.vmap(self.detection.probability)(states)
        good = is_probability(found)
        return jnp.where(good, found, 0.0), good


def is_probability(value: Float[Array, "*k"]) -> Bool[Array, "*k"]:
    """Whether numbers are between 0 and 1.

    Example:
        >>> import jax.numpy as jnp
        >>> is_probability(jnp.array([0.5, 1.5, jnp.nan])).tolist()
        [True, False, False]
    """
    return (value >= 0.0) & (value <= 1.0)
