"""Particle filter: bootstrap, guided and auxiliary, with any resampling strategy, on any state."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.sharding import AxisType
from jaxtyping import Array, Bool, Float, Int, Key

from jaxloc import _tree as tree
from jaxloc._jit import filter_jit
from jaxloc.beliefs import Motion, Particles, Sensor, validity
from jaxloc.beliefs.kld_sampling import KLDSize
from jaxloc.beliefs.particles import NOTHING
from jaxloc.beliefs.resampling.strategies import Resampling, Systematic
from jaxloc.filters.interface import Filter, FilterState, Info
from jaxloc.filters.proposals import Bootstrap, MotionNoise, Observation, Proposal, Resampled, score
from jaxloc.poses import local, retract


class ParticleState(FilterState):
    """State of the particle filter.

    Attributes:
        particles: with normalized weights.
        ancestors: for each particle, the index of its ancestor before the last step.
        resampled: whether the last step resampled; if not, each is its own ancestor.
        noise: of the last prediction, for proposals that use the measurement.
        step: number of predictions so far.
    """

    particles: Particles
    ancestors: Int[Array, " n"]
    resampled: Bool[Array, ""]
    noise: MotionNoise | None
    step: Int[Array, ""]


class ParticleInfo(Info):
    """Diagnostics of an update of the particle filter.

    Attributes:
        log_likelihood: estimate for the measurement given all earlier ones; the exponential of their sum is an unbiased
            estimate of the likelihood. Where no particle has any, the logarithm of the least positive number.
        ok: whether any particle fits the measurement.
        ess: effective sample size after the update.
        resampled: whether this step resampled.
        count: number of particles in use.
    """

    log_likelihood: Float[Array, ""]
    ok: Bool[Array, ""]
    ess: Float[Array, ""]
    resampled: Bool[Array, ""]
    count: Int[Array, ""]


class ParticleFilter(Filter):
    """Particle filter (sequential importance resampling) of any `Motion` and `Sensor`.

    A step resamples (where the effective sample size is below the threshold), moves and weights the particles; states
    hold the weighted particles, from which estimates are best. Where no particle has a positive likelihood, `ok` is
    False, and the predicted particles are kept with equal weights and an inflated covariance.

    With the default strategies, gradients of the log likelihood with respect to the models have the expectation of the
    exact score, up to terms that vanish with the number of particles.

    Args:
        motion: transition density, sampled by `perturb`.
        sensor: measurement density, by `log_prob`.
        proposal: `Bootstrap()`, `Guided()` or `Auxiliary()`.
        resampling: `Systematic()`, `Stratified()`, `Multinomial()`, `Residual()`, `Soft()` or `OptimalTransport()`.
        ess_threshold: resample where the effective sample size is below this part of the particles: 1 for every step,
            0 for never.
        adaptive: number of particles after resampling (the others are masked); None keeps all.
        inflation: relative displacement r of the particles where none has a likelihood (see `inflate`).
        pathwise: gradient estimator of random steps. False: score function, with the particles held fixed; this needs
            `Motion.log_prob`, hence noise in all directions. True: pathwise (reparameterization), for any motion, with
            a far larger variance unless the proposal is guided. None: as the resampling strategy has it.

    References:
        Review section 3.1 [R-5, R-7, R-9, R-10]; Gordon, Salmond, Smith, 1993; Doucet and Johansen, "A tutorial on
        particle filtering and smoothing", 2011.

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> eye = jnp.eye(1)
        >>> motion, sensor = jl.filters.LinearMotion(eye, eye), jl.filters.LinearSensor(eye, eye)
        >>> filt = jl.filters.ParticleFilter(motion, sensor)
        >>> prior = jl.beliefs.Gaussian(jnp.zeros(1), eye)
        >>> state = filt.init(jl.beliefs.Particles.from_gaussian(prior, 1000, key=jax.random.key(0)))
        >>> measurements, valid = jnp.full((20, 1), 3.0), jnp.ones(20, bool)
        >>> state, history = jl.filters.run(filt, state, None, measurements, valid, key=jax.random.key(1))
        >>> bool(jnp.abs(state.particles.mean()[0] - 3.0) < 0.1), history.infos.ess.shape
        (True, (20,))
    """

    motion: Motion
    sensor: Sensor
    proposal: Proposal = Bootstrap()
    resampling: Resampling = Systematic()
    ess_threshold: float = eqx.field(static=True, default=0.5)
    adaptive: KLDSize | None = None
    inflation: float = eqx.field(static=True, default=0.25)
    pathwise: bool | None = eqx.field(static=True, default=None)

    def init(self, prior: Any) -> ParticleState:
        """The initial state.

        Args:
            prior: particles, such as `Particles.from_gaussian(gaussian, n, key=key)`. They may be sharded over devices
                (and stay so) along a mesh axis of the type `jax.sharding.AxisType.Auto`.

        Raises:
            TypeError: the prior is no `Particles`.
            ValueError: the particles are sharded along a mesh axis of the type `Explicit`.
        """
        if not isinstance(prior, Particles):
            raise TypeError(
                f"ParticleFilter.init got a {type(prior).__name__}; sample particles from it, for example by "
                "Particles.from_gaussian(prior, num_particles, key=key)."
            )
        _refuse_explicit(prior.log_weights)
        indices = jnp.arange(prior.size, dtype=jnp.int32)
        noise, zero = self.proposal.init_noise(prior.usable().values), jnp.zeros((), jnp.int32)
        return ParticleState(prior.usable().normalize(), indices, jnp.zeros((), bool), noise, zero)

    @filter_jit
    def predict(self, state: ParticleState, control: Any, *, key: Key[Array, ""] | None = None) -> ParticleState:
        """The particles one step ahead, resampled if needed.

        Non-finite entries of the control count as zero, or as no motion. A particle whose motion is not finite or
        overflows stays where it is.
        """
        if key is None:
            raise ValueError("A particle filter is random: predict and run need a key, such as jax.random.key(0).")
        return tree.protect(ParticleFilter._moved, self, state, validity.finite_or_neutral(control), key)[1]

    def _moved(self, state: ParticleState, control: Any, key: Array) -> tuple[Bool[Array, ""], ParticleState]:
        key_resample, key_move = jax.random.split(key)
        if self.proposal.resamples_with_measurement:
            choice = _unchanged(state.particles)
        else:
            choice = self.resample(state.particles, key=key_resample)
        drawn = self.proposal.draw(self.motion, choice.particles.values, control, key=key_move)
        ok, drawn = drawn.where_finite(choice.particles, self.proposal.init_noise(choice.particles.values))
        values, log_weights = drawn.values, choice.particles.log_weights
        if not self._pathwise:
            values, log_weights = lax.stop_gradient(values), log_weights + score(drawn.log_density)
        particles = Particles(values, log_weights, choice.particles.valid)
        return ok, ParticleState(particles, choice.ancestors, choice.resampled, drawn.noise, state.step + 1)

    @filter_jit
    def update(
        self, state: ParticleState, measurement: Any, valid: Bool[Array, "*m"], *, key: Key[Array, ""] | None = None
    ) -> tuple[ParticleState, ParticleInfo]:
        """The particles weighted by a measurement; only `Auxiliary` needs a key."""
        if key is None and self.proposal.resamples_with_measurement:
            raise ValueError("Auxiliary resamples in its update, which needs a key.")
        _, (after, info) = tree.protect(ParticleFilter._updated, self, state, measurement, valid, key)
        return after, tree.where(info.ok, info, tree.finite_or_zero(info))

    def _updated(
        self, state: ParticleState, measurement: Any, valid: Bool[Array, "*m"], key: Array | None
    ) -> tuple[Bool[Array, ""], tuple[ParticleState, ParticleInfo]]:
        observation = Observation(self.sensor, measurement, valid, self._pathwise)
        weighted = self.proposal.weigh(
            state.particles, state.noise, observation, lambda particles: self.resample(particles, key=key)
        )
        ok = weighted.particles.ok & tree.all_finite(weighted)
        particles = lax.cond(ok, lambda: weighted.particles.normalize(), lambda: self.inflate(state.particles))
        choice = weighted.choice or Resampled(state.particles, state.ancestors, state.resampled)
        after = ParticleState(particles, choice.ancestors, choice.resampled, weighted.noise, state.step)
        measured = jnp.any(valid)
        after = tree.where(measured & tree.all_finite(after), after, state)
        floor = math.log(float(jnp.finfo(particles.log_weights.dtype).tiny))
        likelihood = jnp.where(ok, weighted.particles.log_total, floor)
        info = ParticleInfo(
            log_likelihood=jnp.where(measured, likelihood, 0.0),
            ok=(ok | ~measured) & jnp.any(state.particles.valid),
            ess=after.particles.ess,
            resampled=after.resampled,
            count=after.particles.count,
        )
        return info.ok, (after, info)

    def resample(self, particles: Particles, *, key: Key[Array, ""]) -> Resampled:
        """Resamples where the effective sample size is below the threshold."""
        if self.ess_threshold <= 0.0:
            return _unchanged(particles)
        if self.ess_threshold >= 1.0:
            return self._draw(particles, key)
        needed = particles.ess < self.ess_threshold * particles.count.astype(particles.log_weights.dtype)
        return lax.cond(needed, lambda: self._draw(particles, key), lambda: _unchanged(particles))

    def inflate(self, particles: Particles) -> Particles:
        """Equally weighted particles with the same mean and an inflated covariance.

        ``x_i' = retract(x_i, -r local(x_i, x_j))`` with j half the stack away; variances are multiplied by ``1 + 2 r +
        2 r^2``.
        """
        shifted = jax.tree.map(lambda leaf: jnp.roll(leaf, particles.size // 2, axis=0), particles.values)
        both = particles.valid & jnp.roll(particles.valid, particles.size // 2)

        def away(value, other, valid):
            return retract(value, jnp.where(valid, -self.inflation * local(value, other), 0.0))

        values = jax.vmap(away)(particles.values, shifted, both)
        level = jnp.where(particles.valid, jnp.zeros_like(particles.log_weights), NOTHING)
        return Particles(values, level, particles.valid).normalize()

    @property
    def _pathwise(self) -> bool:
        return self.resampling.pathwise if self.pathwise is None else self.pathwise

    def _draw(self, particles: Particles, key: Array) -> Resampled:
        count = None
        if self.adaptive is not None:
            key, key_count = jax.random.split(key)
            full = Systematic().resample(particles, key=key_count).particles
            count = self.adaptive.count(full)
        drawn = self.resampling.resample(particles, key=key, count=count)
        return Resampled(drawn.particles, drawn.ancestors, jnp.ones((), bool))


def _unchanged(particles: Particles) -> Resampled:
    indices = jnp.arange(particles.size, dtype=jnp.int32)
    return Resampled(particles, indices, jnp.zeros((), bool))


def _refuse_explicit(array: Array) -> None:
    """Resampling moves particles between devices, which explicit sharding would require in all types."""
    types = getattr(getattr(jax.typeof(array).sharding, "mesh", None), "axis_types", ())
    if AxisType.Explicit in types:
        raise ValueError(
            "The particles are sharded over a mesh with explicit axes; make it with automatic ones: "
            "jax.make_mesh(shape, names, axis_types=(jax.sharding.AxisType.Auto,) * len(names))."
        )
