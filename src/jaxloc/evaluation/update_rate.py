"""Optimal update rate of image registration: random against systematic error.

Over a way L with an update every d there are L / d updates. Each brings a random error of standard deviation sigma,
independent of the others: together ``sqrt(sigma^2 L / d)``. Each also brings a systematic error, and if that grows with
the *square* of the displacement, ``k d^2`` (images that overlap less and lie further from the middle of the lens),
the errors add up to ``(L / d) k d^2 = k L d``. (Were it proportional to d, the sum would not depend on d at all.)

Kelly's curve is the *plain sum* of both, a standard deviation beside an offset; the root mean square over many drives
is their sum in *quadrature*, whose minimum lies at a spacing greater by the cube root of two.
"""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from jaxloc._jit import filter_jit
from jaxloc.poses.lie_group import as_floats


class Combination(eqx.Module):
    """Combination of random and systematic error (strategy)."""

    @abstractmethod
    def combine(self, deviation: Float[Array, "*n"], offset: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """The number."""

    @abstractmethod
    def best_spacing(self, sigma: Any, k: Any, way: Any) -> Float[Array, ""]:
        """Where ``combine(sqrt(sigma^2 L / d), k L d)`` is least."""


class PlainSum(Combination):
    """One standard deviation beside the offset: ``E = sqrt(sigma^2 L / d) + k L d`` [K-82]."""

    def combine(self, deviation: Float[Array, "*n"], offset: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """The sum."""
        return deviation + jnp.abs(offset)

    def best_spacing(self, sigma: Any, k: Any, way: Any) -> Float[Array, ""]:
        """``(sigma / (2 k sqrt(L)))^(2/3)``: where ``-sigma sqrt(L) / (2 d^(3/2)) + k L = 0``."""
        sigma, k, way = as_floats(sigma, k, way)
        return (sigma / (2.0 * k * jnp.sqrt(way))) ** (2.0 / 3.0)


class Quadrature(Combination):
    """The root mean square over many drives: ``E^2 = sigma^2 L / d + (k L d)^2``."""

    def combine(self, deviation: Float[Array, "*n"], offset: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """The root of the sum of squares."""
        return jnp.sqrt(deviation**2 + offset**2)

    def best_spacing(self, sigma: Any, k: Any, way: Any) -> Float[Array, ""]:
        """``(sigma^2 / (2 k^2 L))^(1/3)``."""
        sigma, k, way = as_floats(sigma, k, way)
        return (sigma**2 / (2.0 * k**2 * way)) ** (1.0 / 3.0)


@filter_jit
def expected_error(
    spacing: Float[Array, "*n"], *, sigma: Any, k: Any, way: Any, combination: Combination = PlainSum()
) -> Float[Array, "*n"]:
    """Expected error at the end of a path for an update spacing.

    Args:
        spacing: d, m.
        sigma: standard deviation of an update's random error, m.
        k: systematic error of an update over its squared displacement, 1/m.
        way: L, m.
        combination: `PlainSum` (Kelly's) or `Quadrature`.

    Returns:
        E(d), m.

    References:
        A. Kelly, *Mobile Robotics*, 9.2.4.3.2 [K-82].

    Example:
        >>> import jax.numpy as jnp
        >>> [round(float(e), 3) for e in expected_error(jnp.array([0.25, 1.0]), sigma=0.01, k=0.001, way=25.0)]
        [0.106, 0.075]
    """
    sigma, k, way = (jnp.asarray(value, spacing.dtype) for value in (sigma, k, way))
    return combination.combine(sigma * jnp.sqrt(way / spacing), k * way * spacing)


@filter_jit
def best_spacing(*, sigma: Any, k: Any, way: Any, combination: Combination = PlainSum()) -> Float[Array, ""]:
    """The spacing of updates with the least expected error.

    Args:
        sigma: standard deviation of an update's random error, m.
        k: systematic error of an update over its squared displacement, 1/m.
        way: L, m.
        combination: `PlainSum` or `Quadrature`.

    Returns:
        d*, m.

    References:
        [K-82].

    Example:
        >>> round(float(best_spacing(sigma=0.01, k=0.001, way=25.0)), 3)
        1.0
    """
    return combination.best_spacing(sigma, k, way)


class Drift(eqx.Module):
    """Errors at the end of simulated drives.

    Attributes:
        deviation: standard deviation of the error over the drives, m.
        offset: mean of the error, m.
    """

    deviation: Float[Array, "*n"]
    offset: Float[Array, "*n"]


@filter_jit
def simulate_drift(
    counts: Float[Array, " n"],
    *,
    sigma: Any,
    k: Any,
    way: Any,
    key: Key[Array, ""],
    most: int,
    runs: int = 2000,
) -> Drift:
    """Monte Carlo simulation of the error at the end of a path with periodic updates.

    Each update measures its displacement with a normal error and with a bias of k times the displacement squared; the
    measured displacements are added up.

    Args:
        counts: numbers of updates on the way, whole numbers: spacings of way / count.
        sigma: standard deviation of an update's random error, m.
        k: systematic error of an update over its squared displacement, 1/m.
        way: L, m.
        key: random key.
        most: greatest number of updates; static.
        runs: number of drives; static.

    Returns:
        Standard deviation and offset for each count.

    References:
        [K-82].

    Example:
        >>> import jax, jax.numpy as jnp
        >>> drift = simulate_drift(jnp.array([25.0]), sigma=0.01, k=0.002, way=25.0, key=jax.random.key(0), most=25)
        >>> round(float(drift.offset[0]), 2), round(float(drift.deviation[0]), 2)
        (0.05, 0.05)
    """
    sigma, k, way = (jnp.asarray(value, counts.dtype) for value in (sigma, k, way))

    def drives(count: Float[Array, ""], key: Key[Array, ""]) -> Drift:
        step = way / count

        def update(missed: Float[Array, " runs"], number: Array) -> tuple[Float[Array, " runs"], None]:
            noise = sigma * jax.random.normal(jax.random.fold_in(key, number), (runs,), counts.dtype)
            measured = step + k * step * step + noise
            # What is off is added up, and not the way, which would leave it few digits.
            return missed + jnp.where(number.astype(count.dtype) < count, measured - step, 0.0), None

        end, _ = jax.lax.scan(update, jnp.zeros(runs, counts.dtype), jnp.arange(most))
        return Drift(jnp.std(end), jnp.mean(end))

    return jax.lax.map(lambda pair: drives(*pair), (counts, jax.random.split(key, counts.shape[0])))


@filter_jit
def find_minimum(spacing: Float[Array, " n"], error: Float[Array, " n"]) -> Float[Array, ""]:
    """Minimum of a noisy error curve, by a cubic fit of the logarithms.

    Args:
        spacing: abscissas, positive, five or more, the minimum among them.
        error: positive.

    Returns:
        The spacing of the least error.

    Raises:
        ValueError: fewer than five spacings, or another number of errors.

    Example:
        >>> import jax.numpy as jnp
        >>> d = jnp.linspace(0.3, 3.0, 20)
        >>> round(float(find_minimum(d, 1.0 / jnp.sqrt(d) + 0.5 * d)), 1)
        1.0
    """
    if spacing.shape[0] < 5 or spacing.shape != error.shape:
        raise ValueError(f"A cubic fit needs five errors or more, one a spacing; got {error.shape} of {spacing.shape}.")
    place = jnp.log(spacing)
    middle, half = 0.5 * (jnp.max(place) + jnp.min(place)), 0.5 * (jnp.max(place) - jnp.min(place))
    coefficients = jnp.polyfit((place - middle) / half, jnp.log(error), 3)
    grid = jnp.linspace(-1.0, 1.0, 2001, dtype=spacing.dtype)
    return jnp.exp(middle + half * grid[jnp.argmin(jnp.polyval(coefficients, grid))])
