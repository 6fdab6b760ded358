"""Drives of targets that come and go, from whose measurements a tracker's parameters can be learned.

A PHD filter forgets a target that it misses once: where targets stay for ever, the likeliest detection probability is
too small. Here they stay for a few scans, and appear as a Poisson process, as the filter assumes.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

import jaxloc as jl
from jaxloc.beliefs import MahalanobisDistance, Mixture
from jaxloc.filters import KalmanFilter, LinearMotion, LinearSensor, run
from jaxloc.tracking import GmPhd, StaticBirth, TargetModel, UniformClutter

_HALF, _SLOTS, _ROOM = 40.0, 16, 36  # m of half a side, targets at a time, measurements of a scan
_SURVIVAL, _BIRTHS = 0.85, 1.0


class Parameters(eqx.Module):
    """What is learned.

    Attributes:
        detection: p_D.
        clutter_rate: expected number of false measurements in a scan.
        acceleration: spectral density q of the noise of velocities, m^2/s^3.
        deviation: r, of a measured coordinate, m.
    """

    detection: Float[Array, ""]
    clutter_rate: Float[Array, ""]
    acceleration: Float[Array, ""]
    deviation: Float[Array, ""]

    def free(self) -> Float[Array, "4"]:
        """As numbers without bounds."""
        odds = jnp.log(self.detection) - jnp.log1p(-self.detection)
        return jnp.stack([odds, *jnp.log(jnp.stack([self.clutter_rate, self.acceleration, self.deviation]))])

    @staticmethod
    def of(free: Float[Array, "4"]) -> "Parameters":
        """From numbers without bounds."""
        return Parameters(jax.nn.sigmoid(free[0]), *jnp.exp(free[1:]))

    def filter(self) -> KalmanFilter:
        """Of one target, in steps of a second."""
        walk = jl.filters.ConstantVelocity(self.acceleration)
        moved = walk.linearize(jnp.zeros(4), jnp.ones(()))[1]
        noise = walk.covariance(jnp.zeros(4), jnp.ones(()))
        return KalmanFilter(LinearMotion(moved, noise), LinearSensor(jnp.eye(2, 4), self.deviation**2 * jnp.eye(2)))

    def tracker(self) -> GmPhd:
        """Of targets that appear around the middle."""
        clutter = UniformClutter(self.clutter_rate, 4.0 * _HALF**2)
        model = TargetModel(
            self.filter(),
            detection=self.detection,
            survival=_SURVIVAL,
            clutter=clutter,
            birth=StaticBirth(births()),
        )
        # Merging widens components, which would be taken for less noise: only those that are nearly the same merge.
        return GmPhd(model, capacity=30, candidates=60, closeness=MahalanobisDistance(0.5))


def truth() -> Parameters:
    """What drives are made with."""
    return Parameters(jnp.array(0.95), jnp.array(6.0), jnp.array(1.0), jnp.array(1.0))


def guess() -> Parameters:
    """Wrong by a factor of two."""
    return Parameters(jnp.array(0.7), jnp.array(12.0), jnp.array(2.0), jnp.array(0.5))


def births() -> Mixture:
    """Around the middle, at walking speed."""
    return Mixture(jnp.array([_BIRTHS]), jnp.zeros((1, 4)), jnp.diag(jnp.array([225.0, 225.0, 1.0, 1.0]))[None])


def simulate(key: Key[Array, ""], scans: int) -> tuple[Float[Array, "t m 2"], Bool[Array, "t m"]]:
    """Measurements of a drive by the true parameters, from nobody on."""
    true = truth()
    filt, spread = true.filter(), jnp.sqrt(jnp.diagonal(births().covariances[0]))

    def scan(carried, k):
        states, alive = carried
        moving, living, born, starting, seeing, noise, count, place = jax.random.split(k, 8)
        states = jax.vmap(lambda state, k: filt.motion.sample(state, None, key=k))(
            states, jax.random.split(moving, _SLOTS)
        )
        alive = alive & (jax.random.uniform(living, (_SLOTS,)) < _SURVIVAL)
        new = ~alive & (jnp.cumsum(~alive) <= jax.random.poisson(born, _BIRTHS))
        states = jnp.where(new[:, None], spread[None] * jax.random.normal(starting, (_SLOTS, 4)), states)
        alive = alive | new
        z = states[:, :2] + true.deviation * jax.random.normal(noise, (_SLOTS, 2))
        seen = alive & (jax.random.uniform(seeing, (_SLOTS,)) < true.detection)
        false = jax.random.uniform(place, (_ROOM - _SLOTS, 2), minval=-_HALF, maxval=_HALF)
        there = jnp.arange(_ROOM - _SLOTS) < jax.random.poisson(count, true.clutter_rate)
        return (states, alive), (jnp.concatenate([z, false]), jnp.concatenate([seen, there]))

    start = jnp.zeros((_SLOTS, 4)), jnp.zeros(_SLOTS, bool)
    return jax.lax.scan(scan, start, jax.random.split(key, scans))[1]


def cost(free: Float[Array, "4"], drives: tuple[Any, Any]) -> Float[Array, ""]:
    """Negative predictive log-likelihood of a measurement, over all drives."""
    tracker = Parameters.of(free).tracker()
    state = tracker.init(Mixture.empty(1, jnp.zeros(4)))

    def one(measurements, valid):
        _, history = run(tracker, state, None, measurements, valid, keep=lambda state: None)
        return jnp.sum(history.infos.log_likelihood)

    return -jnp.sum(jax.vmap(one)(*drives)) / jnp.sum(drives[1])


def learn(drives: tuple[Any, Any], steps: int, rate: float = 0.25) -> list[Float[Array, "4"]]:
    """Adam on the cost, from the guess; the parameters after each step."""
    slope = jax.jit(jax.grad(cost))
    free = guess().free()
    first, second, path = jnp.zeros(4), jnp.zeros(4), [free]
    for step in range(1, steps + 1):
        gradient = slope(free, drives)
        first, second = 0.9 * first + 0.1 * gradient, 0.99 * second + 0.01 * gradient**2
        size = rate * 0.5 * (1.0 + jnp.cos(jnp.pi * step / steps))
        free = free - size * (first / (1 - 0.9**step)) / (jnp.sqrt(second / (1 - 0.99**step)) + 1e-8)
        path.append(free)
    return path
