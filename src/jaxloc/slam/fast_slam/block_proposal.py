"""Block proposal: poses are drawn once per block of steps; in between each particle is an EKF-SLAM."""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxloc._linalg import matmul
from jaxloc.beliefs.square_root import cholesky, solve
from jaxloc.poses import retract
from jaxloc.sensors.landmarks import RangeBearing, locate
from jaxloc.slam.fast_slam.association import associate, log_density
from jaxloc.slam.fast_slam.landmark_filter import LandmarkFilter, Landmarks, Prediction
from jaxloc.slam.fast_slam.proposals import Decision, Observation, Particle, ParticleUpdate, PathProposal


class BlockProposal(PathProposal):
    """Proposal that draws poses once per block, from the motion and all readings of the block.

    Where readings come often and are coarse beside the motion between them, the pose at each reading is drawn from
    poorly informed densities: most particles are then lost to noise that later readings contradict, and with them what
    was known of the path. Here nothing is drawn for a block of steps. Each particle meanwhile carries the joint
    covariance C of its pose and map, as EKF-SLAM does, beside the covariances P_j of its landmarks given the path. The
    difference is what the path alone makes uncertain::

        C = blockdiag(0, P_1, ..., P_k) + B,     B = cov(E[pose, map | path])

    At the end of a block that part is drawn, for the pose and all landmarks at once, and landmarks are again
    independent given the path. With blocks of one step this is `MeasurementProposal` to first order; a block as long
    as the drive makes each particle an EKF-SLAM. A step costs O(k^2) a particle, where the other proposals cost O(k).

    Under `jax.vmap` over several drives the draw is computed at each step, and kept at few: prefer `jax.lax.map`.

    Attributes:
        num_steps: in a block.

    Raises:
        ValueError: a block of no steps.

    References:
        Beevers and Huang, "Fixed-lag sampling strategies for particle filtering SLAM", ICRA 2007 (block proposals, by
        sampling of the states in a block; here they are integrated out); Doucet, Briers, Senecal, "Efficient block
        sampling strategies for sequential Monte Carlo methods", JCGS 2006; Bailey, Nieto, Nebot, "Consistency of the
        FastSLAM algorithm", ICRA 2006 [R-18, R-20].

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> slam = jl.slam.FastSlam(jl.sensors.IncrementMotion(), 0.1, 0.02, num_particles=10, capacity=4,
        ...     proposal=jl.slam.fast_slam.BlockProposal(50))
        >>> slam.init(jl.beliefs.Gaussian(jl.poses.SE2(0.0, 0.0, 0.0), 1e-6 * jnp.eye(3))).pending.shape
        (10, 11, 11)
    """

    num_steps: int = eqx.field(static=True)

    def __check_init__(self):
        if self.num_steps < 1:
            raise ValueError(f"A block has at least one step, not {self.num_steps}.")

    def num_pending(self, capacity: int) -> int:
        """Size of the joint state of pose and landmarks."""
        return 3 + 2 * capacity

    def draws_now(self, step: Int[Array, ""]) -> Bool[Array, ""]:
        """Whether a block ends before this step."""
        return (step % self.num_steps == 0) & (step > 0)

    def draw(self, particle: Particle, normal: Float[Array, " d"]) -> Particle:
        """Draws the pose, and moves the map by what is correlated with it."""
        known = particle.known
        given = _of_map(known)
        scale = jnp.sqrt(jnp.maximum(jnp.diagonal(particle.pending), float(jnp.finfo(given.dtype).tiny) ** 0.5))
        # Rounding leaves no landmark exactly as sure as its path: what is below it is zero.
        rounding = given.shape[0] * float(jnp.finfo(given.dtype).eps)
        correlation = (particle.pending - given) / scale[:, None] / scale[None, :]
        floor = jnp.diag(jnp.where(jnp.diagonal(particle.pending) > 0.0, rounding, 0.0).astype(given.dtype))
        move = scale * matmul(cholesky(0.5 * (correlation + correlation.T) + floor), normal)
        move = jnp.where(jnp.diagonal(particle.pending) > 0.0, move, 0.0)
        means = known.means + move[3:].reshape(-1, 2)
        moved = Landmarks(means, known.covariances, known.seen, known.support)
        return Particle(retract(particle.pose, move[:3]), given, moved)

    def update_particle(
        self, landmarks: LandmarkFilter, particle: Particle, observation: Observation, normal: Float[Array, " d"]
    ) -> ParticleUpdate:
        """One EKF-SLAM update of means and joint covariance, one FastSLAM update of the landmarks' own covariances."""
        del normal
        known, reading = particle.known, observation.reading
        each = landmarks.predict_all(particle.pose, known, reading)
        full = _innovation_covariances(each, particle.pending, landmarks.deviations)
        found = associate(known, each.residual, full, reading.landmark, observation.candidates)
        row = jnp.minimum(found.row, known.seen.shape[0] - 1)
        one = Prediction(each.residual[row], each.by_pose[row], each.by_landmark[row], each.covariance[row])
        corrected = _correct(landmarks, particle, row, one, full[row])
        choices = _add(landmarks, particle, row, reading), corrected, particle
        densities = log_density(one.residual, full[row]), landmarks.log_floor()
        return Decision.of(found, known).conclude(choices, observation, found, densities)


def _of_map(known: Landmarks) -> Float[Array, "d d"]:
    """Covariance of pose and map given the path."""
    count, dtype = known.seen.shape[0], known.means.dtype
    own = jnp.eye(count, dtype=dtype)[:, None, :, None] * known.covariances[:, :, None, :]
    return jnp.zeros((3 + 2 * count, 3 + 2 * count), dtype).at[3:, 3:].set(own.reshape(2 * count, 2 * count))


def _innovation_covariances(
    each: Prediction, pending: Float[Array, "d d"], deviations: Float[Array, "2"]
) -> Float[Array, "k 2 2"]:
    """Covariance of the residual of each row by pose and landmark together."""
    count = each.residual.shape[0]
    rows = pending[3:].reshape(count, 2, -1)
    index = jnp.arange(count, dtype=jnp.int32)
    own = rows.reshape(count, 2, 3 + 2 * count)[:, :, 3:].reshape(count, 2, count, 2)[index, :, index]
    pose = matmul(matmul(each.by_pose, pending[None, :3, :3]), each.by_pose.mT)
    mixed = matmul(matmul(each.by_landmark, rows[:, :, :3]), each.by_pose.mT)
    landmark = matmul(matmul(each.by_landmark, own), each.by_landmark.mT)
    return pose + mixed + mixed.mT + landmark + jnp.diag(deviations**2)[None]


def _correct(
    landmarks: LandmarkFilter, particle: Particle, row: Array, seen: Prediction, covariance: Float[Array, "2 2"]
) -> Particle:
    known, pending = particle.known, particle.pending
    rows = lax.dynamic_slice_in_dim(pending, 3 + 2 * row, 2, axis=0)
    image = matmul(seen.by_pose, pending[:3]) + matmul(seen.by_landmark, rows)
    gain = solve(cholesky(covariance), image).T
    left = pending - matmul(gain, image)
    column = lax.dynamic_slice_in_dim(left, 3 + 2 * row, 2, axis=1)
    back = matmul(left[:, :3], seen.by_pose.T) + matmul(column, seen.by_landmark.T)
    joseph = left - matmul(back, gain.T) + matmul(gain * landmarks.deviations[None] ** 2, gain.T)
    move = matmul(gain, seen.residual)
    own = landmarks.correct(known, row, seen).covariances
    moved = Landmarks(known.means + move[3:].reshape(-1, 2), own, known.seen, known.support)
    return Particle(retract(particle.pose, move[:3]), 0.5 * (joseph + joseph.T), moved)


def _add(landmarks: LandmarkFilter, particle: Particle, row: Array, reading: RangeBearing) -> Particle:
    pose, pending = particle.pose, particle.pending
    added = landmarks.add(particle.known, row, pose, reading)
    inside = pose.inverse().apply(locate(pose @ landmarks.mount, reading)[None])[0]
    lever = jnp.stack([-inside[1], inside[0]])[:, None]
    by_pose = matmul(pose.rotation.matrix(), jnp.concatenate([jnp.eye(2, dtype=lever.dtype), lever], axis=1))
    cross = matmul(by_pose, pending[:3])
    start, zero = 3 + 2 * row, jnp.zeros_like(row)
    joint = lax.dynamic_update_slice(pending, cross, (start, zero))
    joint = lax.dynamic_update_slice(joint, cross.T, (zero, start))
    own = matmul(cross[:, :3], by_pose.T) + added.covariances[row]
    return Particle(pose, lax.dynamic_update_slice(joint, own, (start, start)), added)
