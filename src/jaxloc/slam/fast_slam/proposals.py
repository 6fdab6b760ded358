"""How a particle explains a reading, and from which density it draws its pose."""

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
    """One particle.

    Attributes:
        pose: T_world_robot.
        pending: covariance of what is not drawn yet: of the pose (right perturbation), and in a `FromBlock` of the
            landmarks too.
        known: its map.
    """

    pose: SE2
    pending: Float[Array, "d d"]
    known: Landmarks


class Look(eqx.Module):
    """A reading, and which landmarks look like it."""

    reading: RangeBearing
    candidates: Candidates


class Explained(eqx.Module):
    """A particle after a reading.

    Attributes:
        particle: with the reading.
        log_density: of the reading given all earlier ones.
        row: of the map that changed; -1 for none.
    """

    particle: Particle
    log_density: Float[Array, ""]
    row: Int[Array, ""]


class PathProposal(eqx.Module):
    """From which density new poses are drawn, and when."""

    @abstractmethod
    def num_pending(self, capacity: int) -> int:
        """Size of `Particle.pending` beside a map of some capacity."""

    @abstractmethod
    def draws_now(self, step: Int[Array, ""]) -> Bool[Array, ""] | None:
        """Whether `draw` is due before a step; None for never."""

    @abstractmethod
    def draw(self, particle: Particle, normal: Float[Array, " d"]) -> Particle:
        """A particle with nothing pending."""

    @abstractmethod
    def explain(
        self, landmarks: LandmarkFilter, particle: Particle, look: Look, normal: Float[Array, " d"]
    ) -> Explained:
        """A particle after a reading."""


class FromMotion(PathProposal):
    """FastSLAM 1: poses are drawn from the motion alone, and the reading weighs them."""

    def num_pending(self, capacity: int) -> int:
        """The pose."""
        return 3

    def draws_now(self, step: Int[Array, ""]) -> None:
        """Never: each reading draws."""

    def draw(self, particle: Particle, normal: Float[Array, " d"]) -> Particle:
        """As it is."""
        return particle

    def explain(
        self, landmarks: LandmarkFilter, particle: Particle, look: Look, normal: Float[Array, " d"]
    ) -> Explained:
        """Nothing of the motion is corrected before the draw."""
        return _draw_and_explain(landmarks, particle, look, normal, jnp.zeros_like(particle.pending))


class FromReading(PathProposal):
    """FastSLAM 2: poses are drawn from motion and reading together, so that a sharp sensor wastes no particles."""

    def num_pending(self, capacity: int) -> int:
        """The pose."""
        return 3

    def draws_now(self, step: Int[Array, ""]) -> None:
        """Never: each reading draws."""

    def draw(self, particle: Particle, normal: Float[Array, " d"]) -> Particle:
        """As it is."""
        return particle

    def explain(
        self, landmarks: LandmarkFilter, particle: Particle, look: Look, normal: Float[Array, " d"]
    ) -> Explained:
        """All of the motion is corrected before the draw."""
        return _draw_and_explain(landmarks, particle, look, normal, particle.pending)


class Verdict(eqx.Module):
    """What becomes of a reading.

    Attributes:
        corrects: it corrects its landmark.
        adds: it puts a landmark where it says, a new one or one that was contradicted too often.
        support: of the map after it.
    """

    corrects: Bool[Array, ""]
    adds: Bool[Array, ""]
    support: Int[Array, " k"]

    @staticmethod
    def of(found: Association, known: Landmarks) -> "Verdict":
        """By what a particle takes a reading for."""
        corrects = found.near & ~found.fresh
        distrusted = ~found.near & ~found.fresh & (known.support[found.row] <= 0)
        adds = (found.fresh | distrusted) & (found.row < known.seen.shape[0])
        change = jnp.where(adds, 1 - known.support[found.row], jnp.where(found.near, 1, -1))
        return Verdict(corrects, adds, known.support.at[found.row].add(change, mode="drop"))

    def conclude(
        self,
        choices: tuple[Particle, Particle, Particle],
        look: Look,
        found: Association,
        densities: tuple[Array, Array],
    ) -> Explained:
        """One of three particles: with the landmark added, corrected, or as it is.

        Args:
            choices: the three.
            look: the reading.
            found: its landmark.
            densities: log density of a reading of a known landmark, and the least there is.
        """
        chosen = jax.tree.map(lambda a, b, c: jnp.where(self.adds, a, jnp.where(self.corrects, b, c)), *choices)
        chosen = eqx.tree_at(lambda particle: particle.known.support, chosen, self.support)
        candidates = look.candidates
        density = jnp.where(self.corrects, densities[0] + candidates.log_ratios[found.row], candidates.log_new)
        row = jnp.where(self.adds | self.corrects, found.row, -1)
        return Explained(chosen, jnp.maximum(density, densities[1]), row)


def _draw_and_explain(
    landmarks: LandmarkFilter,
    particle: Particle,
    look: Look,
    normal: Float[Array, "3"],
    correctable: Float[Array, "3 3"],
) -> Explained:
    """The pose is drawn, given the part of its covariance that the reading may correct; then its map is corrected."""
    pose, pending, known, reading = particle.pose, particle.pending, particle.known, look.reading
    each = landmarks.predict_all(pose, known, reading)
    full = each.spread + matmul(matmul(each.by_pose, pending), each.by_pose.mT)
    found = associate(known, each.residual, full, reading.landmark, look.candidates)
    verdict, row = Verdict.of(found, known), found.row
    residual, jacobian = each.residual[row], each.by_pose[row]
    prior = jnp.where(verdict.corrects, correctable, 0.0)
    gain = solve(cholesky(full[row]), matmul(jacobian, prior)).T
    rest = pending - matmul(gain, matmul(jacobian, prior))
    drawn = retract(pose, matmul(gain, residual) + matmul(cholesky(0.5 * (rest + rest.T)), normal))
    # The reading as seen from the drawn pose.
    again = landmarks.predict(drawn, known.means[row], known.covariances[row], reading)
    early = jnp.any(prior != 0.0)
    density = log_density(jnp.where(early, residual, again.residual), jnp.where(early, full[row], again.spread))
    nothing = jnp.zeros_like(pending)
    added = Particle(drawn, nothing, landmarks.add(known, row, drawn, reading))
    corrected = Particle(drawn, nothing, landmarks.correct(known, row, again))
    choices = added, corrected, Particle(drawn, nothing, known)
    return verdict.conclude(choices, look, found, (density, landmarks.log_floor()))
