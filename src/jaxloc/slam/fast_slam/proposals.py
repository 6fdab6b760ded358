"""Proposal distributions of FastSLAM: from the motion (1.0), or from motion and reading (2.0)."""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxloc._linalg import matmul
from jaxloc.beliefs.square_root import cholesky, solve
from jaxloc.poses import SE2, retract
from jaxloc.sensors.landmarks import RangeBearing
from jaxloc.slam.fast_slam.association import Association, Candidates, associate, log_density
from jaxloc.slam.fast_slam.landmark_filter import LandmarkFilter, Landmarks


class Particle(eqx.Module):
    """State of one particle.

    Attributes:
        pose: T_world_robot.
        pending: covariance of what is not drawn yet: of the pose (right perturbation), and in a `BlockProposal` of the
            landmarks too.
        known: its map.
    """

    pose: SE2
    pending: Float[Array, "d d"]
    known: Landmarks


class Observation(eqx.Module):
    """A reading and its candidate landmarks."""

    reading: RangeBearing
    candidates: Candidates


class ParticleUpdate(eqx.Module):
    """A particle after a reading: weight, association and pending density.

    Attributes:
        particle: with the reading.
        log_density: of the reading given all earlier ones.
        row: of the map that changed; -1 for none.
    """

    particle: Particle
    log_density: Float[Array, ""]
    row: Int[Array, ""]


class PathProposal(eqx.Module):
    """Proposal distribution of poses (strategy)."""

    @abstractmethod
    def num_pending(self, capacity: int) -> int:
        """Size of `Particle.pending` for a map of given capacity."""

    @abstractmethod
    def draws_now(self, step: Int[Array, ""]) -> Bool[Array, ""] | None:
        """Whether `draw` is due before a step; None for never."""

    @abstractmethod
    def draw(self, particle: Particle, normal: Float[Array, " d"]) -> Particle:
        """Draws the pending density."""

    @abstractmethod
    def update_particle(
        self, landmarks: LandmarkFilter, particle: Particle, observation: Observation, normal: Float[Array, " d"]
    ) -> ParticleUpdate:
        """A particle after a reading: weight, association and pending density."""


class _PerReadingProposal(PathProposal):
    """Proposal that draws poses at each reading."""

    @abstractmethod
    def correctable(self, pending: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
        """The part of the pending covariance of the pose that the reading corrects before the draw."""

    def num_pending(self, capacity: int) -> int:
        """The pose."""
        return 3

    def draws_now(self, step: Int[Array, ""]) -> None:
        """Never: each reading draws."""

    def draw(self, particle: Particle, normal: Float[Array, " d"]) -> Particle:
        """The particle unchanged."""
        return particle

    def update_particle(
        self, landmarks: LandmarkFilter, particle: Particle, observation: Observation, normal: Float[Array, " d"]
    ) -> ParticleUpdate:
        """Corrects the motion as far as `correctable`, draws the pose, and updates the map."""
        return _draw_and_update(landmarks, particle, observation, normal, self.correctable(particle.pending))


class MotionProposal(_PerReadingProposal):
    """FastSLAM 1.0 proposal: poses are drawn from the motion model and weighted by the reading."""

    def correctable(self, pending: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
        """Zero: the reading does not correct the motion."""
        return jnp.zeros_like(pending)


class MeasurementProposal(_PerReadingProposal):
    """FastSLAM 2.0 proposal: poses are drawn from motion and reading together, for accurate sensors."""

    def correctable(self, pending: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
        """All of the motion."""
        return pending


class Decision(eqx.Module):
    """Decision about a reading: landmark added, corrected, or reading ignored.

    Attributes:
        corrects: a known landmark is corrected.
        adds: a landmark is initialized by it, a new one or one that was contradicted too often.
        support: counters of the map after it.
    """

    corrects: Bool[Array, ""]
    adds: Bool[Array, ""]
    support: Int[Array, " k"]

    @staticmethod
    def of(found: Association, known: Landmarks) -> "Decision":
        """Decision by the association."""
        corrects = found.near & ~found.fresh
        distrusted = ~found.near & ~found.fresh & (known.support[found.row] <= 0)
        adds = (found.fresh | distrusted) & (found.row < known.seen.shape[0])
        change = jnp.where(adds, 1 - known.support[found.row], jnp.where(found.near, 1, -1))
        return Decision(corrects, adds, known.support.at[found.row].add(change, mode="drop"))

    def conclude(
        self,
        choices: tuple[Particle, Particle, Particle],
        observation: Observation,
        found: Association,
        densities: tuple[Array, Array],
    ) -> ParticleUpdate:
        """Selects among the three updated particles.

        Args:
            choices: the three.
            observation: the reading.
            found: its landmark.
            densities: log density of a reading of a known landmark, and the least there is.
        """
        chosen = jax.tree.map(lambda a, b, c: jnp.where(self.adds, a, jnp.where(self.corrects, b, c)), *choices)
        chosen = eqx.tree_at(lambda particle: particle.known.support, chosen, self.support)
        candidates = observation.candidates
        density = jnp.where(self.corrects, densities[0] + candidates.log_ratios[found.row], candidates.log_new)
        row = jnp.where(self.adds | self.corrects, found.row, -1)
        return ParticleUpdate(chosen, jnp.maximum(density, densities[1]), row)


def _draw_and_update(
    landmarks: LandmarkFilter,
    particle: Particle,
    observation: Observation,
    normal: Float[Array, "3"],
    correctable: Float[Array, "3 3"],
) -> ParticleUpdate:
    """The pose is drawn, given the part of its covariance that the reading may correct; then its map is corrected."""
    pose, pending, known, reading = particle.pose, particle.pending, particle.known, observation.reading
    each = landmarks.predict_all(pose, known, reading)
    full = each.covariance + matmul(matmul(each.by_pose, pending), each.by_pose.mT)
    found = associate(known, each.residual, full, reading.landmark, observation.candidates)
    decision, row = Decision.of(found, known), found.row
    residual, jacobian = each.residual[row], each.by_pose[row]
    prior = jnp.where(decision.corrects, correctable, 0.0)
    gain = solve(cholesky(full[row]), matmul(jacobian, prior)).T
    rest = pending - matmul(gain, matmul(jacobian, prior))
    drawn = retract(pose, matmul(gain, residual) + matmul(cholesky(0.5 * (rest + rest.T)), normal))
    # The predicted reading from the drawn pose.
    again = landmarks.predict(drawn, known.means[row], known.covariances[row], reading)
    early = jnp.any(prior != 0.0)
    density = log_density(jnp.where(early, residual, again.residual), jnp.where(early, full[row], again.covariance))
    none = jnp.zeros_like(pending)
    added = Particle(drawn, none, landmarks.add(known, row, drawn, reading))
    corrected = Particle(drawn, none, landmarks.correct(known, row, again))
    choices = added, corrected, Particle(drawn, none, known)
    return decision.conclude(choices, observation, found, (density, landmarks.log_floor()))
