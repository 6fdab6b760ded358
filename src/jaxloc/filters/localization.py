"""Monte Carlo localization in a map: global localization, tracking, and recovery from kidnapping."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key

from jaxloc import _tree as tree
from jaxloc._jit import filter_jit
from jaxloc.beliefs import Gaussian, KLDSize, Motion, Particles, Sensor, validity
from jaxloc.beliefs.particles import finite_log_weights
from jaxloc.beliefs.resampling.indices import systematic
from jaxloc.beliefs.resampling.strategies import Resampling, Systematic
from jaxloc.filters.interface import Filter, FilterState, Info
from jaxloc.poses import SE2
from jaxloc.sensors.maps.occupancy_map import FreeSpace

_SLOTS = 4096  # of the hash table of coarse cells
_HALVINGS = 12


class Recovery(eqx.Module):
    """Injection of random poses after localization failures (augmented MCL).

    A fast and a slow running mean follow the fit of the measurements, their mean log likelihood. When the fast one
    falls below the slow one, a share of the particles is replaced by random poses: ``p = max(0, 1 - exp(fast - slow +
        tolerance))``, in nats per reading.

    Attributes:
        slow: weight of the newest fit in the slow mean.
        fast: the same in the fast mean.
        readings: number of independent readings in a measurement; the fit is the log likelihood over it.
        tolerance: by how much the fast mean may fall below the slow one as scenes change, in nats per reading.
        max_share: largest share of the particles that is replaced in one step.
        kidnapping: total weight of all random poses before their first measurement: the prior probability that the
            robot was kidnapped. With their share of the particles instead, one cluttered scan would suffice.

    References:
        Thrun, Burgard, Fox, *Probabilistic Robotics*, 2005, table 8.3 (there with likelihoods in place of their
        logarithms, which a single outlier beam would dominate).
    """

    slow: float = eqx.field(static=True, default=0.02)
    fast: float = eqx.field(static=True, default=0.3)
    readings: float = eqx.field(static=True, default=1.0)
    tolerance: float = eqx.field(static=True, default=0.3)
    max_share: float = eqx.field(static=True, default=0.9)
    kidnapping: float = eqx.field(static=True, default=0.01)

    def smooth(self, mean: Float[Array, "2"], fit: Float[Array, ""], seen: Int[Array, ""]) -> Float[Array, "2"]:
        """Both running means after one more fit; arithmetic means of the first few."""
        rates = jnp.maximum(jnp.array([self.slow, self.fast], mean.dtype), 1.0 / (seen.astype(mean.dtype) + 1.0))
        return mean + rates * (fit / self.readings - mean)

    def share(self, mean: Float[Array, "2"]) -> Float[Array, ""]:
        """The share of the particles to replace."""
        return jnp.clip(1.0 - jnp.exp(jnp.minimum(mean[1] - mean[0] + self.tolerance, 0.0)), 0.0, self.max_share)


class LocalizationState(FilterState):
    """State of Monte Carlo localization.

    Attributes:
        particles: poses ``T_world_robot``, with normalized weights.
        fit: slow and fast mean of the fit of measurements, nats per reading.
        inject: share of the particles that the next prediction replaces by random poses.
        seen: number of measurements so far.
        step: number of predictions so far.
    """

    particles: Particles
    fit: Float[Array, "2"]
    inject: Float[Array, ""]
    seen: Int[Array, ""]
    step: Int[Array, ""]

    def estimate(self, radius: float = 1.0, angle: float = 0.7) -> "Place":
        """The heaviest cluster of the particles (see `find_place`)."""
        return find_place(self.particles, radius=radius, angle=angle)


class Place(eqx.Module):
    """Pose estimate from the heaviest cluster of the particles.

    Attributes:
        pose: mean and covariance of the heaviest cluster.
        mass: its share of the weight: one without competing clusters, small during global localization.
    """

    pose: Gaussian
    mass: Float[Array, ""]


class LocalizationInfo(Info):
    """Diagnostics of an update of Monte Carlo localization.

    Attributes:
        log_likelihood: of the measurement given all earlier ones.
        ok: whether any particle has a positive likelihood.
        ess: effective sample size after the update.
        exponent: power of the likelihood (tempering) that keeps the effective sample size; one when tracking.
        inject: share of the particles that the next step replaces by random poses; zero when tracking.
        place: the estimate.
    """

    log_likelihood: Float[Array, ""]
    ok: Bool[Array, ""]
    ess: Float[Array, ""]
    exponent: Float[Array, ""]
    inject: Float[Array, ""]
    place: Place


class MonteCarloLocalization(Filter):
    """Monte Carlo localization (MCL): a particle filter over the poses of a robot in a map.

    Each step resamples where the effective sample size is low, replaces some particles by random poses where the fit of
    measurements has dropped, moves all by odometry and weights them by the sensor. A likelihood that would leave an
    effective sample size below `least_ess` is tempered: raised to the largest power below one that leaves as much, so
    that global localization does not depend on a single scan.

    Predict once for each measurement that is used, with the odometry since the last one that was used, and use
    measurements only after the robot has moved: repeated views from one pose are not independent.

    Args:
        motion: of the odometry, such as `OdometryMotion`, best with a probability of slipping.
        sensor: of scans, landmarks, ... in the map; only its `log_prob` is used.
        space: free space, from which random poses are sampled.
        resampling: strategy; `Systematic()`.
        ess_threshold: resample where the effective sample size is below this share of the particles.
        least_ess: smallest effective sample size after a measurement, as a share of the particles.
        recovery: injection of random poses; None for never.
        adaptive: number of particles after resampling (the others are masked); None keeps all. (Arrays keep their
            size; `resize` makes smaller ones.)

    References:
        Dellaert, Fox, Burgard, Thrun, "Monte Carlo localization for mobile robots", ICRA 1999 [R-11]; Thrun, Burgard,
        Fox, *Probabilistic Robotics*, 2005, chapter 8; Jasra, Stephens, Doucet, Tsagaris, "Inference for Levy-driven
        stochastic volatility models via adaptive sequential Monte Carlo", 2011, for the tempering.

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> walls = jnp.zeros((40, 60)).at[:, 50].set(1.0).at[30].set(1.0)
        >>> grid = jl.sensors.OccupancyMap(walls, 0.1, jl.poses.SE2.identity())
        >>> sensor = jl.sensors.LikelihoodField(jl.sensors.DistanceField.of(grid))
        >>> filt = jl.filters.MonteCarloLocalization(jl.sensors.OdometryMotion(), sensor, grid.free_space())
        >>> state = filt.init_globally(500, key=jax.random.key(0))
        >>> state = filt.predict(state, jl.poses.SE2(0.1, 0.0, 0.0), key=jax.random.key(1))
        >>> scan = jl.sensors.LaserScan(jnp.full(30, 2.0), -1.5, 0.1)
        >>> state, info = filt.update(state, scan, jnp.ones(30, bool))
        >>> bool(info.ok), bool(info.exponent < 1)
        (True, True)
    """

    motion: Motion
    sensor: Sensor
    space: FreeSpace
    resampling: Resampling = Systematic()
    ess_threshold: float = eqx.field(static=True, default=0.5)
    least_ess: float = eqx.field(static=True, default=0.01)
    recovery: Recovery | None = Recovery()
    adaptive: KLDSize | None = None

    def init(self, prior: Particles) -> LocalizationState:
        """The initial state, from particles over poses."""
        if not isinstance(prior, Particles):
            raise TypeError(
                f"MonteCarloLocalization.init got a {type(prior).__name__}; use init_near(gaussian, n, key=key), "
                "init_globally(n, key=key), or sample particles."
            )
        dtype, zero = prior.log_weights.dtype, jnp.zeros((), jnp.int32)
        return LocalizationState(prior.usable().normalize(), jnp.zeros(2, dtype), jnp.zeros((), dtype), zero, zero)

    @filter_jit
    def init_globally(self, num_particles: int, *, key: Key[Array, ""]) -> LocalizationState:
        """Particles evenly distributed over the free space and all headings [R-11]."""
        return self.init(Particles(self.space.sample_evenly(num_particles, key=key)))

    @filter_jit
    def init_near(self, pose: Gaussian, num_particles: int, *, key: Key[Array, ""]) -> LocalizationState:
        """Particles about a known pose."""
        return self.init(Particles.from_gaussian(pose, num_particles, key=key))

    @filter_jit
    def resize(self, state: LocalizationState, num_particles: int, *, key: Key[Array, ""]) -> LocalizationState:
        """The same density with more or fewer particles: few suffice once the pose is known."""
        indices = systematic(key, finite_log_weights(state.particles), num_particles)
        particles = Particles(state.particles.take(indices)).normalize()
        return LocalizationState(particles, state.fit, state.inject, state.seen, state.step)

    @filter_jit
    def predict(
        self, state: LocalizationState, control: Any, *, key: Key[Array, ""] | None = None
    ) -> LocalizationState:
        """The particles after a step of odometry, resampled and with random poses injected as needed.

        An increment that is not finite counts as no motion; a particle whose motion is not finite stays where it is.
        """
        if key is None:
            raise ValueError(
                "Monte Carlo localization is random: predict and run need a key such as jax.random.key(0)."
            )
        _, moved = tree.protect(MonteCarloLocalization._moved, self, state, validity.finite_or_neutral(control), key)
        return moved

    def _moved(self, state: LocalizationState, control: Any, key: Array) -> tuple[Bool[Array, ""], LocalizationState]:
        key_resample, key_move, key_inject = jax.random.split(key, 3)
        particles = self._resample(state, key_resample)
        shape = (particles.size, self.motion.noise_dimension(state.particles.best()))
        normal = jax.random.normal(key_move, shape, particles.log_weights.dtype)
        values = jax.vmap(lambda pose, n: self.motion.perturb(pose, control, n))(particles.values, normal)
        good = tree.slots_within_range(values)
        values = jax.vmap(tree.where)(good, values, particles.values)
        ok = jnp.all(good | ~particles.valid)
        particles = Particles(values, particles.log_weights, particles.valid)
        # Sampling random poses is expensive, and not needed when tracking.
        particles = lax.cond(
            state.inject > 0, lambda: self._inject(particles, state.inject, key_inject), lambda: particles
        )
        after = LocalizationState(particles, state.fit, jnp.zeros_like(state.inject), state.seen, state.step + 1)
        return ok, after

    @filter_jit
    def update(
        self, state: LocalizationState, measurement: Any, valid: Bool[Array, "*m"], *, key: Key[Array, ""] | None = None
    ) -> tuple[LocalizationState, LocalizationInfo]:
        """The particles weighted by a measurement.

        Where no particle has a positive likelihood, the particles are unchanged, ``ok`` is False, and the next
        prediction replaces half of them by random poses.
        """
        del key
        _, (after, info) = tree.protect(MonteCarloLocalization._updated, self, state, measurement, valid)
        return after, tree.where(info.ok, info, tree.finite_or_zero(info))

    def _updated(
        self, state: LocalizationState, measurement: Any, valid: Bool[Array, "*m"]
    ) -> tuple[Bool[Array, ""], tuple[LocalizationState, LocalizationInfo]]:
        before = state.particles
        there = jnp.any(valid)
        logs = jax.vmap(lambda pose: self.sensor.log_prob(pose, measurement, valid))(before.values)
        full = Particles(before.values, before.log_weights + logs, before.valid)
        ok = full.ok & there
        logs = jnp.where(jnp.isfinite(logs), logs, float(jnp.finfo(logs.dtype).min) * 1e-3)
        exponent = self._exponent(before, logs)
        weighted = Particles(before.values, before.log_weights + exponent * logs, before.valid).normalize()
        particles = tree.where(ok, weighted, before)
        fit, inject = self._follow(state, jnp.sum(jnp.where(weighted.weights > 0, weighted.weights * logs, 0.0)))
        after = LocalizationState(
            particles,
            jnp.where(ok, fit, state.fit),
            jnp.where(ok, inject, jnp.where(there, 0.5, state.inject)),
            state.seen + ok.astype(jnp.int32),
            state.step,
        )
        ok, likelihood = (ok | ~there) & jnp.any(before.valid), jnp.where(ok, full.log_total, 0.0)
        return ok, (after, self._describe(after, likelihood, ok, exponent))

    def _describe(self, after: LocalizationState, likelihood: Array, ok: Array, exponent: Array) -> LocalizationInfo:
        return LocalizationInfo(likelihood, ok, after.particles.ess, exponent, after.inject, after.estimate())

    def _follow(self, state: LocalizationState, fit: Array) -> tuple[Array, Array]:
        if self.recovery is None:
            return state.fit, jnp.zeros_like(state.inject)
        mean = self.recovery.smooth(state.fit, fit, state.seen)
        return mean, self.recovery.share(mean)

    def _exponent(self, particles: Particles, logs: Array) -> Array:
        """The largest power of the likelihood, at most one, that keeps the smallest effective sample size."""
        least = self.least_ess * particles.count.astype(logs.dtype)

        def enough(power):
            return Particles(particles.values, particles.log_weights + power * logs, particles.valid).ess >= least

        def halve(_, ends):
            low, high = ends
            middle = 0.5 * (low + high)
            good = enough(middle)
            return jnp.where(good, middle, low), jnp.where(good, high, middle)

        one = jnp.ones((), logs.dtype)
        return lax.cond(
            enough(one), lambda: one, lambda: lax.fori_loop(0, _HALVINGS, halve, (jnp.zeros_like(one), one))[0]
        )

    def _resample(self, state: LocalizationState, key: Array) -> Particles:
        particles = state.particles
        few = particles.ess < self.ess_threshold * particles.count.astype(particles.log_weights.dtype)
        return lax.cond(few | (state.inject > 0), lambda: self._draw(particles, key), lambda: particles)

    def _draw(self, particles: Particles, key: Array) -> Particles:
        count = None
        if self.adaptive is not None:
            key, key_count = jax.random.split(key)
            count = self.adaptive.count(Systematic().resample(particles, key=key_count).particles)
        return self.resampling.resample(particles, key=key, count=count).particles

    def _inject(self, particles: Particles, share: Array, key: Array) -> Particles:
        """Replaces a share of the particles by random poses of small weight."""
        key_choose, key_draw = jax.random.split(key)
        fresh = self.space.sample(particles.size, key=key_draw)
        chosen = jax.random.uniform(key_choose, (particles.size,), share.dtype) < share

        def swap(new, old):
            return jnp.where(chosen.reshape(-1, *(1,) * (old.ndim - 1)), new.astype(old.dtype), old)

        values = jax.tree.map(swap, fresh, particles.values)
        weight = 0.5 if self.recovery is None else self.recovery.kidnapping
        level = math.log(weight) - jnp.log(jnp.maximum(jnp.sum(chosen), 1).astype(share.dtype))
        return Particles(values, jnp.where(chosen, level, particles.log_weights), particles.valid | chosen).normalize()


@filter_jit
def find_place(
    particles: Particles, *, radius: float | Float[Array, ""] = 1.0, angle: float | Float[Array, ""] = 0.7
) -> Place:
    """The heaviest cluster of particles over planar poses, and its share of the weight.

    Weights are summed over a coarse grid of poses; the estimate is the mean of the particles near the mean of the
    heaviest cell.

    Args:
        particles: over `SE2`.
        radius: of a cluster in position, m.
        angle: of a cluster in heading, rad.

    Returns:
        Mean, covariance (tangent space of the mean) and mass of the cluster.

    References:
        Thrun, Burgard, Fox, *Probabilistic Robotics*, 2005, section 4.3.3 (density trees); Comaniciu and Meer, "Mean
        shift", PAMI 2002.

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> poses = jax.vmap(jl.poses.SE2)(jnp.array([0.2, 0.4, 9.0]), jnp.full(3, 0.5), jnp.zeros(3))
        >>> place = jl.filters.localization.find_place(jl.beliefs.Particles(poses))
        >>> [round(float(x), 3) for x in (place.pose.mean.x, place.mass)]
        [0.3, 0.667]
    """
    weights, poses = particles.weights, particles.values
    slots = _slots(poses, radius, angle)
    table = jnp.zeros(_SLOTS, weights.dtype).at[slots].add(weights, mode="promise_in_bounds")
    heaviest = jnp.argmax(table).astype(jnp.int32)
    inside = slots == heaviest
    seed = Particles(poses, jnp.where(inside, finite_log_weights(particles), -jnp.inf), particles.valid).best()
    center = _near(particles, _near(particles, seed, radius, angle).mean(), radius, angle)
    mass = jnp.sum(jnp.where(center.valid, weights, 0.0))
    pose = center.gaussian()
    floor = jnp.eye(3, dtype=weights.dtype) * 1e-10
    return Place(Gaussian(pose.mean, pose.covariance + floor), mass)


def _near(particles: Particles, center: SE2, radius: Any, angle: Any) -> Particles:
    """The particles of a cluster."""
    offset = particles.values.translation - center.translation[None, :]
    turn = jax.vmap(lambda rotation: center.rotation.inverse().compose(rotation).cos)(particles.values.rotation)
    near = (jnp.sum(offset**2, axis=1) < radius**2) & (turn > jnp.cos(jnp.asarray(angle, turn.dtype)))
    return Particles(particles.values, particles.log_weights, particles.valid & near)


def _slots(poses: SE2, radius: Any, angle: Any) -> Int[Array, " n"]:
    """Hash table slot of the coarse cell of each pose."""
    cells = jnp.floor(poses.translation / radius).astype(jnp.int32).astype(jnp.uint32)
    headings = jnp.arctan2(poses.rotation.sin, poses.rotation.cos) + math.pi
    turns = jnp.floor(headings / angle).astype(jnp.int32).astype(jnp.uint32)
    mixed = cells[:, 0] * jnp.uint32(73856093) ^ cells[:, 1] * jnp.uint32(19349663) ^ turns * jnp.uint32(83492791)
    return ((mixed >> jnp.uint32(7)) % jnp.uint32(_SLOTS)).astype(jnp.int32)
