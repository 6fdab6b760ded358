"""Consistency of covariances: NEES, NIS and coverage, against the chi-square distribution.

References:
    Bar-Shalom, Li and Kirubarajan, *Estimation with Applications to Tracking and Navigation*, 2001, section 5.4.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxloc import _linalg
from jaxloc._jit import filter_jit
from jaxloc.beliefs import chi2_cdf, chi2_quantile
from jaxloc.poses import Trajectory


class SquaredErrors(eqx.Module):
    """Squared errors in units of the covariance.

    Args:
        values: chi-square distributed where the estimator is consistent; zero where not ok.
        ok: whether the covariance was positive definite and everything finite.
    """

    values: Float[Array, "*s"]
    ok: Bool[Array, "*s"]


class Interval(eqx.Module):
    """An interval.

    Args:
        lower: its lower end.
        upper: its upper end.
    """

    lower: Float[Array, "*s"]
    upper: Float[Array, "*s"]


class Calibration(eqx.Module):
    """Distribution of squared errors compared with chi-square.

    Attributes:
        edges: of the histogram's bins.
        density: of the values that are ok; those beyond the last edge are in no bin.
        expected: density of chi-square in the same bins.
        distance: of Kolmogorov and Smirnov: largest difference of the two cumulative distributions.
        coverage: fraction of the values inside the confidence ellipsoids.
        count: how many values are ok.
    """

    edges: Float[Array, " e"]
    density: Float[Array, " b"]
    expected: Float[Array, " b"]
    distance: Float[Array, ""]
    coverage: Float[Array, " k"]
    count: Int[Array, ""]


@filter_jit
def nees(error: Float[Array, " d"], covariance: Float[Array, "d d"]) -> SquaredErrors:
    """Normalized estimation error squared: ``e^T P^-1 e``.

    Args:
        error: tangent from the estimate to the truth.
        covariance: of the estimate, in the same tangent space.

    Returns:
        One value, chi-square distributed with d degrees of freedom when the estimator is consistent.

    References:
        Bar-Shalom et al. 2001, eq. 5.4.2-7. [T-56]

    Example:
        >>> float(nees(jnp.array([1.0, 2.0]), jnp.diag(jnp.array([1.0, 4.0]))).values)
        2.0
    """
    finite = jnp.all(jnp.isfinite(error)) & jnp.all(jnp.isfinite(covariance))
    eye = jnp.eye(error.shape[0], dtype=error.dtype)
    root, definite = _linalg.first_cholesky(jnp.where(finite, covariance, eye)[None])
    ok = finite & definite
    whitened = _linalg.solve_lower(root, jnp.where(ok, error, 0.0))
    return SquaredErrors(jnp.sum(whitened**2), ok)


@filter_jit
def nis(innovation: Float[Array, " d"], covariance: Float[Array, "d d"]) -> SquaredErrors:
    """Normalized innovation squared: ``v^T S^-1 v``, which needs no truth.

    Args:
        innovation: measurement minus its prediction.
        covariance: of the innovation.

    Returns:
        One value, chi-square distributed with d degrees of freedom when the filter is consistent.

    References:
        Bar-Shalom et al. 2001, eq. 5.4.2-9. [T-56]

    Example:
        >>> float(nis(jnp.array([2.0]), jnp.array([[4.0]])).values)
        1.0
    """
    return nees(innovation, covariance)


@filter_jit
def trajectory_nees(estimate: Trajectory, covariances: Float[Array, "n d d"], truth: Trajectory) -> SquaredErrors:
    """:func:`nees` of every pose of a path, in the right tangent space of the estimate.

    Args:
        estimate: the estimated path.
        covariances: of the poses ``T exp(d)``, translation first.
        truth: the true path, pose by pose.

    Returns:
        A value for each pose; not ok where the covariance is singular, as it is at a start that is known.

    Example:
        >>> import jaxloc as jl
        >>> path = jl.data.simulate.stereo_points.simulate_drive(3, key=jax.random.key(0))
        >>> trajectory_nees(path, jnp.tile(jnp.eye(6), (3, 1, 1)), path).ok.tolist()
        [True, True, True]
    """
    errors = jax.vmap(lambda a, b: a.local(b))(estimate.poses, truth.poses)
    return jax.vmap(nees)(errors, covariances)


@filter_jit
def mean_bounds(degrees_of_freedom: int, num_values: int, *, confidence: float | Float[Array, ""] = 0.95) -> Interval:
    """Confidence interval of the mean of independent NEES or NIS values of a consistent estimator.

    Args:
        degrees_of_freedom: of one value.
        num_values: how many are averaged.
        confidence: probability of the interval; both tails are equally likely.

    Returns:
        The interval.

    References:
        Bar-Shalom et al. 2001, eq. 5.4.2-13.

    Example:
        >>> bounds = mean_bounds(4, 50)
        >>> round(float(bounds.lower), 2), round(float(bounds.upper), 2)
        (3.25, 4.82)
    """
    tail = 0.5 * (1.0 - jnp.asarray(confidence, dtype=float))
    dof = float(degrees_of_freedom * num_values)
    return Interval(chi2_quantile(tail, dof) / num_values, chi2_quantile(1.0 - tail, dof) / num_values)


@filter_jit
def coverage(
    squared: SquaredErrors, degrees_of_freedom: int, *, probabilities: tuple[float, ...] = (0.5, 0.9, 0.95)
) -> Float[Array, " k"]:
    """Fraction of true values inside the estimator's confidence ellipsoids.

    Args:
        squared: NEES values.
        degrees_of_freedom: of one value.
        probabilities: of the ellipsoids.

    Returns:
        Fractions, equal to the probabilities when the estimator is consistent; zero where no value is ok.

    Example:
        >>> values = SquaredErrors(jnp.array([0.1, 2.0, 30.0]), jnp.ones(3, bool))
        >>> coverage(values, 2, probabilities=(0.5, 0.9)).tolist() == [jnp.float32(1 / 3), jnp.float32(2 / 3)]
        True
    """
    values, ok = squared.values.ravel(), squared.ok.ravel()
    limits = chi2_quantile(jnp.array(probabilities, values.dtype), degrees_of_freedom)
    inside = (values[None] <= limits[:, None]) & ok[None]
    return jnp.sum(inside, axis=1).astype(values.dtype) / jnp.maximum(jnp.sum(ok), 1).astype(values.dtype)


@filter_jit
def calibration(
    squared: SquaredErrors,
    degrees_of_freedom: int,
    *,
    num_bins: int = 20,
    probabilities: tuple[float, ...] = (0.5, 0.9, 0.95),
) -> Calibration:
    """Calibration of squared errors: their distribution against chi-square.

    Args:
        squared: NEES values, such as those of positions: ``jax.vmap(nees)(errors, covariances)``.
        degrees_of_freedom: of one value.
        num_bins: of the histogram, which ends at chi-square's quantile of 99.9 %.
        probabilities: of the ellipsoids.

    Returns:
        Histogram, distance and coverage; the distance is one, and all else zero, where no value is ok.

    References:
        Bar-Shalom et al. 2001, section 5.4.2. [T-89], [T-90]

    Example:
        >>> values = jnp.sum(jax.random.normal(jax.random.key(0), (1000, 3)) ** 2, axis=1)
        >>> fit = calibration(SquaredErrors(values, jnp.ones(1000, bool)), 3)
        >>> bool(fit.distance < 0.05), bool(abs(fit.coverage[1] - 0.9) < 0.03)
        (True, True)
    """
    values, ok = squared.values.ravel(), squared.ok.ravel()
    dtype = values.dtype
    count = jnp.sum(ok, dtype=jnp.int32)
    size = jnp.maximum(count, 1).astype(dtype)
    ordered = jnp.sort(jnp.where(ok, values, jnp.inf))
    rank = jnp.arange(values.shape[0], dtype=jnp.int32)
    below = chi2_cdf(jnp.where(rank < count, ordered, 0.0), degrees_of_freedom)
    step = rank.astype(dtype) / size
    gaps = jnp.maximum(step + 1.0 / size - below, below - step)
    distance = jnp.max(jnp.where(rank < count, gaps, 0.0), initial=0.0)

    last = chi2_quantile(jnp.array(0.999, dtype), degrees_of_freedom)
    edges = jnp.linspace(0.0, 1.0, num_bins + 1, dtype=dtype) * last
    width = last / num_bins
    upto = jnp.searchsorted(ordered, edges).astype(dtype)
    return Calibration(
        edges,
        jnp.diff(upto) / (size * width),
        jnp.diff(chi2_cdf(edges, degrees_of_freedom)) / width,
        jnp.where(count > 0, distance, 1.0),
        coverage(squared, degrees_of_freedom, probabilities=probabilities),
        count,
    )
