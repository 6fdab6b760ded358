"""Landmark filters of one particle: a planar Kalman filter per landmark, given the path [R-20]."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxloc._linalg import matmul
from jaxloc.beliefs.square_root import cholesky, solve
from jaxloc.poses import SE2
from jaxloc.sensors.landmarks import RangeBearing, locate, locate_covariance, observe, polar_jacobian

LIKELY = 0.999  # probability of the gate


class Landmarks(eqx.Module):
    """The map of one particle, of fixed capacity.

    Attributes:
        means: "k 2" in the world, m.
        covariances: "k 2 2" given the particle's path, m^2.
        seen: which there are.
        support: readings of each that agreed less those that did not.
    """

    means: Float[Array, "k 2"]
    covariances: Float[Array, "k 2 2"]
    seen: Bool[Array, " k"]
    support: Int[Array, " k"]

    @staticmethod
    def empty(capacity: int, dtype: Any) -> "Landmarks":
        """An empty map."""
        means, covariances = jnp.zeros((capacity, 2), dtype), jnp.zeros((capacity, 2, 2), dtype)
        return Landmarks(means, covariances, jnp.zeros(capacity, bool), jnp.zeros(capacity, jnp.int32))


class Prediction(eqx.Module):
    """Predicted reading of one landmark, or stacked of all.

    Attributes:
        residual: (range, bearing) measured minus expected, m and rad.
        by_pose: its derivative by the pose (right perturbation).
        by_landmark: its derivative by the landmark, in the world.
        covariance: of the residual given the pose.
    """

    residual: Float[Array, "2"]
    by_pose: Float[Array, "2 3"]
    by_landmark: Float[Array, "2 2"]
    covariance: Float[Array, "2 2"]


class LandmarkFilter(eqx.Module):
    """Kalman filter of a landmark by range and bearing from a known pose.

    Attributes:
        deviations: standard deviations of range (m) and bearing (rad).
        mount: T_robot_sensor.

    References:
        Montemerlo et al., "FastSLAM", AAAI 2002, section 3.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> from jaxloc.slam.fast_slam import LandmarkFilter, Landmarks
        >>> landmarks = LandmarkFilter(jnp.array([0.1, 0.02]), jl.poses.SE2(0.0, 0.0, 0.0))
        >>> reading = jl.sensors.RangeBearing(jnp.array(5.0), jl.poses.SO2.identity(), jnp.array(0))
        >>> known = landmarks.add(Landmarks.empty(1, jnp.float32), 0, jl.poses.SE2(1.0, 0.0, 0.0), reading)
        >>> known.means.tolist()
        [[6.0, 0.0]]
    """

    deviations: Float[Array, "2"]
    mount: SE2

    def log_floor(self) -> Float[Array, ""]:
        """Log density of a reading of no known landmark, uniform and equal for all particles."""
        positive = (self.deviations > 0.0) & jnp.isfinite(self.deviations)
        logs = jnp.log(jnp.where(positive, self.deviations, 1.0))
        return math.log1p(-LIKELY) - jnp.sum(logs) - math.log(2.0 * math.pi)

    def predict(
        self, pose: SE2, mean: Float[Array, "2"], covariance: Float[Array, "2 2"], reading: RangeBearing
    ) -> Prediction:
        """Predicted reading of one landmark from a pose T_world_robot."""
        sensor = pose @ self.mount
        expected = observe(sensor, mean, reading.landmark)
        residual = jnp.concatenate([(reading.range - expected.range)[None], expected.bearing.local(reading.bearing)])
        polar = polar_jacobian(expected)
        by_landmark = matmul(polar, sensor.rotation.matrix().T)
        # d(landmark in the robot's frame) = -(translation + theta x landmark)
        inside = pose.inverse().apply(mean[None])[0]
        lever = jnp.stack([inside[1], -inside[0]])
        moves = jnp.concatenate([-jnp.eye(2, dtype=mean.dtype), lever[:, None]], axis=1)
        by_pose = matmul(matmul(polar, self.mount.rotation.matrix().T), moves)
        expected = matmul(matmul(by_landmark, covariance), by_landmark.T) + jnp.diag(self.deviations**2)
        return Prediction(residual, by_pose, by_landmark, expected)

    def predict_all(self, pose: SE2, known: Landmarks, reading: RangeBearing) -> Prediction:
        """Predicted readings of all landmarks, stacked."""

        def one(mean, covariance):
            return self.predict(pose, mean, covariance, reading)

        return jax.vmap(one)(known.means, known.covariances)

    def correct(self, known: Landmarks, row: Int[Array, ""], seen: Prediction) -> Landmarks:
        """The map corrected by a reading of one landmark; unchanged for an index beyond its end."""
        covariance = known.covariances[row]
        gain = solve(cholesky(seen.covariance), matmul(seen.by_landmark, covariance)).T
        rest = jnp.eye(2, dtype=gain.dtype) - matmul(gain, seen.by_landmark)
        joseph = matmul(matmul(rest, covariance), rest.T) + matmul(gain * self.deviations[None] ** 2, gain.T)
        means = known.means.at[row].add(matmul(gain, seen.residual), mode="drop")
        covariances = known.covariances.at[row].set(joseph, mode="drop")
        return Landmarks(means, covariances, known.seen, known.support)

    def add(self, known: Landmarks, row: Any, pose: SE2, reading: RangeBearing) -> Landmarks:
        """The map with a landmark initialized from a reading; unchanged for an index beyond its end."""
        sensor = pose @ self.mount
        covariance = locate_covariance(sensor, reading, self.deviations)
        means = known.means.at[row].set(locate(sensor, reading), mode="drop")
        covariances = known.covariances.at[row].set(covariance, mode="drop")
        return Landmarks(means, covariances, known.seen.at[row].set(True, mode="drop"), known.support)
