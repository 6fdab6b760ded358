"""Monte Carlo localization in a map: global start, tracking, and recovery of a robot that got lost."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key

from jaxloc import _tree as tree
from jaxloc.beliefs import Gaussian, KLDSize, Motion, Particles, Sensor
from jaxloc.beliefs.particles import finite_log_weights
from jaxloc.beliefs.resampling.indices import systematic
from jaxloc.beliefs.resampling.strategies import Resampling, Systematic
from jaxloc.filters.interface import Filter, FilterState, Info
from jaxloc.poses import SE2
from jaxloc.sensors.maps.occupancy_map import FreeSpace

_SLOTS = 4096  # of the table in which poses are counted by place
_HALVINGS = 12


class Recovery(eqx.Module):
    """When to doubt that the robot is where the cloud is: augmented MCL.

    Two running means follow how well scans fit, a quick and a slow one. When the quick one falls behind, that part of
    the cloud is replaced by random poses: ``p = max(0, 1 - exp(fast - slow + tolerance))``, in nats a reading.

    Attributes:
        slow: weight of the newest fit in the slow mean.
        fast: the same in the quick mean.
        readings: how many independent readings a measurement holds; the fit is the log likelihood over these.
        tolerance: by how much the quick mean may fall behind as scenes change, in nats a reading.
        most: largest part of the cloud that is replaced in one step.
        doubt: weight of all random poses together before they are compared with a scan: the probability that the robot
            was carried away. With their share of the cloud instead, one cluttered scan would be enough to believe them.

    References:
        Thrun, Burgard, Fox, *Probabilistic Robotics*, 2005, table 8.3 (there with likelihoods in place of their
        logarithms, which one bad beam of many would decide).
    """

    slow: float = eqx.field(static=True, default=0.02)
    fast: float = eqx.field(static=True, default=0.3)
    readings: float = eqx.field(static=True, default=1.0)
    tolerance: float = eqx.field(static=True, default=0.3)
    most: float = eqx.field(static=True, default=0.9)
    doubt: float = eqx.field(static=True, default=0.01)

    def follow(self, mean: Float[Array, "2"], fit: Float[Array, ""], seen: Int[Array, ""]) -> Float[Array, "2"]:
        """Both running means after one more fit; plain means while there are few."""
        rates = jnp.maximum(jnp.array([self.slow, self.fast], mean.dtype), 1.0 / (seen.astype(mean.dtype) + 1.0))
        return mean + rates * (fit / self.readings - mean)

    def share(self, mean: Float[Array, "2"]) -> Float[Array, ""]:
        """The part of the cloud to replace."""
        return jnp.clip(1.0 - jnp.exp(jnp.minimum(mean[1] - mean[0] + self.tolerance, 0.0)), 0.0, self.most)


class LocalizationState(FilterState):
    """What the next step of Monte Carlo localization needs.

    Attributes:
        particles: poses ``T_world_robot``, with weights that sum to one.
        fit: slow and quick mean of how well scans fit, nats a reading.
        inject: part of the cloud that the next prediction replaces by random poses.
        seen: how many measurements there were.
        step: how many predictions led here.
    """

    particles: Particles
    fit: Float[Array, "2"]
    inject: Float[Array, ""]
    seen: Int[Array, ""]
    step: Int[Array, ""]

    def estimate(self, radius: float = 1.0, angle: float = 0.7) -> "Place":
        """The heaviest cluster of the cloud (see `find_place`)."""
        return find_place(self.particles, radius=radius, angle=angle)


class Place(eqx.Module):
    """Where a cloud says that the robot is.

    Attributes:
        pose: mean and covariance of the heaviest cluster.
        mass: its part of the weight: one where there is no other place, small where nothing is known yet.
    """

    pose: Gaussian
    mass: Float[Array, ""]


class LocalizationInfo(Info):
    """What an update of Monte Carlo localization says.

    Attributes:
        log_likelihood: of the measurement given all earlier ones.
        ok: whether any particle fits the measurement.
        ess: effective sample size after the update.
        exponent: to which power the likelihood was taken so that enough particles keep weight; one when tracking.
        inject: part of the cloud that the next step replaces by random poses; zero while all is well.
        place: the estimate.
    """

    log_likelihood: Float[Array, ""]
    ok: Bool[Array, ""]
    ess: Float[Array, ""]
    exponent: Float[Array, ""]
    inject: Float[Array, ""]
    place: Place


class MonteCarloLocalization(Filter):
    """Particles over the poses of a robot in a map, from anywhere to a few centimeters.

    Each step resamples where few particles carry weight, replaces some by random poses where scans fit worse than they
    used to, moves all by odometry and weighs them by the sensor. A likelihood that would leave less than `least_ess` of
    the cloud is taken to the largest power below one that leaves as much: a global start then does not bet on one scan.

    Predict once for each measurement that is used, with the odometry since the last one that was, and use measurements
    only after the robot has moved: the same view twice is not twice the evidence.

    Args:
        motion: of the odometry, such as `OdometryMotion`, best with a probability of slipping.
        sensor: of scans, landmarks, ... in the map; only its `log_prob` is used.
        space: where random poses are drawn.
        resampling: strategy; `Systematic()`.
        ess_threshold: resample below this part of the particles.
        least_ess: part of the particles that a measurement leaves at least.
        recovery: when to draw random poses; None for never.
        adaptive: masks particles that are not needed when it resamples; None keeps all. (Arrays keep their size;
            `resize` makes smaller ones.)

    References:
        Dellaert, Fox, Burgard, Thrun, "Monte Carlo localization for mobile robots", ICRA 1999 [R-11]; Thrun, Burgard,
        Fox, *Probabilistic Robotics*, 2005, chapter 8; Jasra, Stephens, Doucet, Tsagaris, "Inference for Levy-driven
        stochastic volatility models via adaptive sequential Monte Carlo", 2011, for the power.

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> walls = jnp.zeros((40, 60)).at[:, 50].set(1.0).at[30].set(1.0)
        >>> grid = jl.sensors.OccupancyMap(walls, 0.1, jl.poses.SE2.identity())
        >>> sensor = jl.sensors.LikelihoodField(jl.sensors.DistanceField.of(grid))
        >>> filt = jl.filters.MonteCarloLocalization(jl.sensors.OdometryMotion(), sensor, grid.free_space())
        >>> state = filt.start_globally(500, key=jax.random.key(0))
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
        """The state before any data, from particles over poses."""
        if not isinstance(prior, Particles):
            raise TypeError(
                f"MonteCarloLocalization.init got a {type(prior).__name__}; use start_near(gaussian, n, key=key), "
                "start_globally(n, key=key), or draw particles."
            )
        dtype, zero = prior.log_weights.dtype, jnp.zeros((), jnp.int32)
        return LocalizationState(prior.normalize(), jnp.zeros(2, dtype), jnp.zeros((), dtype), zero, zero)

    @eqx.filter_jit
    def start_globally(self, num_particles: int, *, key: Key[Array, ""]) -> LocalizationState:
        """A cloud spread evenly over the free space and all headings [R-11]."""
        return self.init(Particles(self.space.spread(num_particles, key=key)))

    @eqx.filter_jit
    def start_near(self, pose: Gaussian, num_particles: int, *, key: Key[Array, ""]) -> LocalizationState:
        """A cloud about a known pose."""
        return self.init(Particles.from_gaussian(pose, num_particles, key=key))

    @eqx.filter_jit
    def resize(self, state: LocalizationState, num_particles: int, *, key: Key[Array, ""]) -> LocalizationState:
        """The same belief with more or fewer particles: few are enough once the place is known."""
        indices = systematic(key, finite_log_weights(state.particles), num_particles)
        particles = Particles(state.particles.take(indices)).normalize()
        return LocalizationState(particles, state.fit, state.inject, state.seen, state.step)

    @eqx.filter_jit
    def predict(
        self, state: LocalizationState, control: Any, *, key: Key[Array, ""] | None = None
    ) -> LocalizationState:
        """The cloud after a step of odometry, resampled and refreshed by random poses as needed."""
        if key is None:
            raise ValueError("Monte Carlo localization draws: predict and run need a key, such as jax.random.key(0).")
        key_resample, key_move, key_inject = jax.random.split(key, 3)
        particles = self._resample(state, key_resample)
        shape = (particles.size, self.motion.noise_dimension(state.particles.best()))
        normal = jax.random.normal(key_move, shape, particles.log_weights.dtype)
        values = jax.vmap(lambda pose, n: self.motion.perturb(pose, control, n))(particles.values, normal)
        particles = Particles(values, particles.log_weights, particles.valid)
        # Drawing random poses is dear, and a robot that knows its place needs none.
        particles = lax.cond(
            state.inject > 0, lambda: self._inject(particles, state.inject, key_inject), lambda: particles
        )
        return LocalizationState(particles, state.fit, jnp.zeros_like(state.inject), state.seen, state.step + 1)

    @eqx.filter_jit
    def update(
        self, state: LocalizationState, measurement: Any, valid: Bool[Array, "*m"], *, key: Key[Array, ""] | None = None
    ) -> tuple[LocalizationState, LocalizationInfo]:
        """The cloud weighed by a measurement.

        Where no particle fits it at all, the cloud stays as it was, ``ok`` is False, and the next prediction replaces
        half of it by random poses.
        """
        del key
        before = state.particles
        there = jnp.any(valid)
        logs = jax.vmap(lambda pose: self.sensor.log_prob(pose, measurement, valid))(before.values)
        full = Particles(before.values, before.log_weights + logs, before.valid)
        ok = full.ok & there
        logs = jnp.where(jnp.isfinite(logs), logs, float(jnp.finfo(logs.dtype).min) * 1e-3)
        exponent = self._exponent(before, logs)
        weighed = Particles(before.values, before.log_weights + exponent * logs, before.valid).normalize()
        particles = tree.where(ok, weighed, before)
        fit, inject = self._follow(state, jnp.sum(jnp.where(weighed.weights > 0, weighed.weights * logs, 0.0)))
        after = LocalizationState(
            particles,
            jnp.where(ok, fit, state.fit),
            jnp.where(ok, inject, jnp.where(there, 0.5, state.inject)),
            state.seen + ok.astype(jnp.int32),
            state.step,
        )
        return after, self._describe(after, jnp.where(ok, full.log_total, 0.0), ok | ~there, exponent)

    def _describe(self, after: LocalizationState, likelihood: Array, ok: Array, exponent: Array) -> LocalizationInfo:
        return LocalizationInfo(likelihood, ok, after.particles.ess, exponent, after.inject, after.estimate())

    def _follow(self, state: LocalizationState, fit: Array) -> tuple[Array, Array]:
        if self.recovery is None:
            return state.fit, jnp.zeros_like(state.inject)
        mean = self.recovery.follow(state.fit, fit, state.seen)
        return mean, self.recovery.share(mean)

    def _exponent(self, particles: Particles, logs: Array) -> Array:
        """The largest power of the likelihood, at most one, that leaves the effective sample size that is asked for."""
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
        """Random poses in place of a part of the cloud, with little weight before they have seen a scan."""
        key_choose, key_draw = jax.random.split(key)
        fresh = self.space.sample(particles.size, key=key_draw)
        chosen = jax.random.uniform(key_choose, (particles.size,), share.dtype) < share

        def swap(new, old):
            return jnp.where(chosen.reshape(-1, *(1,) * (old.ndim - 1)), new.astype(old.dtype), old)

        values = jax.tree.map(swap, fresh, particles.values)
        doubt = 0.5 if self.recovery is None else self.recovery.doubt
        level = math.log(doubt) - jnp.log(jnp.maximum(jnp.sum(chosen), 1).astype(share.dtype))
        return Particles(values, jnp.where(chosen, level, particles.log_weights), particles.valid | chosen).normalize()


@eqx.filter_jit
def find_place(
    particles: Particles, *, radius: float | Float[Array, ""] = 1.0, angle: float | Float[Array, ""] = 0.7
) -> Place:
    """The heaviest cluster of a cloud of planar poses, and how much of the weight it holds.

    Poses are counted by place in a coarse grid; the mean of those near the heaviest cell's own mean is the estimate.

    Args:
        particles: over `SE2`.
        radius: of a cluster, m.
        angle: the same for headings, rad.

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
    """A slot for the coarse cell of each pose."""
    cells = jnp.floor(poses.translation / radius).astype(jnp.int32).astype(jnp.uint32)
    headings = jnp.arctan2(poses.rotation.sin, poses.rotation.cos) + math.pi
    turns = jnp.floor(headings / angle).astype(jnp.int32).astype(jnp.uint32)
    mixed = cells[:, 0] * jnp.uint32(73856093) ^ cells[:, 1] * jnp.uint32(19349663) ^ turns * jnp.uint32(83492791)
    return ((mixed >> jnp.uint32(7)) % jnp.uint32(_SLOTS)).astype(jnp.int32)
