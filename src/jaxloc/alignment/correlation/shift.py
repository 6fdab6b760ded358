"""Least-squares refinement of a whole-pixel peak, with covariance and the derivatives of the solution."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxloc import _linalg
from jaxloc._linalg import matmul
from jaxloc.alignment.correlation.scores import NormalizedCorrelation, Pair, Score, SumOfSquares
from jaxloc.features.subpixel import newton_inverse
from jaxloc.images.gradients import central_difference
from jaxloc.images.interpolation import Bicubic
from jaxloc.images.patches import extract

_LEAST_SIGMA = 0.01  # interpolation error without noise, px
STEPS = 4


class Shift(eqx.Module):
    """A refined shift.

    Attributes:
        uv: of the template on the image, px.
        covariance: px^2.
        information: its inverse, zero where not regular.
        regular: True if the template's texture determines both directions.
        converged: True if the refinement converged near the peak.
    """

    uv: Float[Array, "2"]
    covariance: Float[Array, "2 2"]
    information: Float[Array, "2 2"]
    regular: Bool[Array, ""]
    converged: Bool[Array, ""]


class _Model(eqx.Module):
    """Linear model of a patch: gain and bias (to which the score is invariant) and the template's derivatives."""

    rows: Float[Array, "k n"]
    weight: Float[Array, " n"]
    base: Float[Array, " n"]
    inverse: Float[Array, "k k"]
    regular: Bool[Array, ""]
    fixed_gain: bool = eqx.field(static=True)
    shape: tuple[int, int] = eqx.field(static=True)

    def regress(self, patch: Float[Array, " n"]) -> tuple[Array, Array, Array]:
        """Step of the shift, gain, and weighted residual sum of squares."""
        target = patch - self.base
        found = matmul(self.inverse, matmul(self.rows, self.weight * target))
        residual = target - matmul(self.rows.T, found)
        gain = jnp.ones((), patch.dtype) if self.fixed_gain else found[0]
        step = -found[-2:] / jnp.maximum(gain, 0.05)
        return step, gain, jnp.sum(self.weight * residual * residual)


def refine_shift(pair: Pair, score: Score, peak: Float[Array, "2"], initial: Float[Array, "2"], sigma: Any) -> Shift:
    """Minimizes ``sum (I(x + t) - g T(x) - b)^2`` near a peak, with gain and bias as in the score.

    Gauss-Newton by the template's derivatives (inverse composition), then one Newton step that has the derivatives of
    the solution. The covariance is ``sigma^2 / g^2 H^-1`` with H the Gram matrix of the derivatives, gain and bias
    projected out, corrected for interpolated noise.

    Args:
        pair: image and template.
        score: `SumOfSquares` without gain and bias, `NormalizedCorrelation` with gain, `ZeroMeanCorrelation` with both.
        peak: the best whole shift.
        initial: the vertex of its quadratic model.
        sigma: the image's noise, or None to estimate it from the residual.

    Returns:
        The shift, its covariance and validity; the initial value where the template is flat.

    References:
        Baker and Matthews, "Lucas-Kanade 20 years on", 2004, sections 3.2 and 4.

    Example:
        >>> import jax.numpy as jnp
        >>> from jaxloc.alignment.correlation import Direct, SumOfSquares
        >>> u, v = jnp.meshgrid(jnp.arange(40.0), jnp.arange(40.0))
        >>> scene = lambda u, v: 50 * jnp.sin(0.4 * u) * jnp.cos(0.3 * v)
        >>> pair = Pair(scene(u, v), scene(u + 9.7, v + 8.2)[:20, :20], None, Direct())
        >>> peak = jnp.array([10.0, 8.0])
        >>> [round(x, 1) for x in refine_shift(pair, SumOfSquares(), peak, peak, None).uv.tolist()]
        [9.7, 8.2]
    """
    model, frozen = _model(pair, score), lax.stop_gradient(pair)
    frozen_model, peak, initial = lax.stop_gradient((model, peak, initial))

    def advance(_: Any, uv: Array) -> Array:
        return jnp.clip(uv + frozen_model.regress(_patch(frozen, uv))[0], peak - 1.0, peak + 1.0)

    uv = lax.fori_loop(0, STEPS, advance, initial)
    inverses, near = newton_inverse(lambda at: -frozen_model.regress(_patch(frozen, at[0]))[0][None], uv[None])
    inverse, near = lax.stop_gradient(inverses[0]), near[0]
    step, gain, squares = model.regress(_patch(pair, uv))
    step = matmul(inverse, step)
    regular = model.regular & (gain > 0)
    converged = near & jnp.all(jnp.abs(step) < 0.1) & jnp.all(jnp.abs(uv - peak) < 1.0)
    variance = _variance(model, uv, squares, sigma) / jnp.where(regular, jnp.maximum(gain, 0.05), 1.0) ** 2
    covariance, information = _covariance(model, uv, inverse, jnp.where(regular, variance, 0.0))
    covariance = jnp.where(regular, covariance, jnp.eye(2, dtype=step.dtype))
    information = jnp.where(regular, information, 0.0)
    return Shift(jnp.where(regular & converged, uv + step, initial), covariance, information, regular, converged)


def _patch(pair: Pair, uv: Float[Array, "2"]) -> Float[Array, " n"]:
    rows, columns = pair.template.shape
    middle = 0.5 * jnp.array([columns - 1, rows - 1], dtype=uv.dtype)
    last = jnp.array([m - n for m, n in zip(pair.image.shape, (rows, columns), strict=True)][::-1], dtype=uv.dtype)
    inside = jnp.clip(uv, jnp.zeros_like(last), last)
    return extract(pair.image, (inside + middle)[None], size=(rows, columns), method=Bicubic()).values.reshape(-1)


def _model(pair: Pair, score: Score) -> _Model:
    template = pair.template
    slope = central_difference(template)
    # Differences at the border are one-sided.
    inner = jnp.pad(jnp.ones(tuple(side - 2 for side in template.shape), template.dtype), 1)
    weight = (inner if pair.mask is None else inner * pair.mask).reshape(-1)
    flat, one = template.reshape(-1), jnp.ones_like(template).reshape(-1)
    slopes = [slope.right.reshape(-1), slope.down.reshape(-1)]
    fixed = isinstance(score, SumOfSquares)
    if fixed:
        columns = slopes
    elif isinstance(score, NormalizedCorrelation):
        columns = [flat, *slopes]
    else:
        mean = jnp.sum(weight * flat) / jnp.maximum(jnp.sum(weight), 1.0)
        columns = [flat - mean, one, *slopes]
    rows = jnp.stack(columns)
    inverse, regular = _inverse(matmul(rows * weight[None], rows.T), jnp.sum(weight) * jnp.max(jnp.abs(flat)) ** 2)
    return _Model(rows, weight, flat if fixed else jnp.zeros_like(flat), inverse, regular, fixed, template.shape)


def _inverse(gram: Float[Array, "k k"], energy: Float[Array, ""]) -> tuple[Float[Array, "k k"], Bool[Array, ""]]:
    """Inverse of the normal matrix, computed with unit diagonal, and whether it is regular."""
    eye, diagonal = jnp.eye(gram.shape[0], dtype=gram.dtype), jnp.diagonal(gram)
    floor = (64.0 * float(jnp.finfo(gram.dtype).eps)) ** 2 * energy
    textured = jnp.all(diagonal > floor)
    scale = jnp.where(textured, 1.0 / jnp.sqrt(jnp.where(textured, diagonal, 1.0)), 1.0)
    scaled = jnp.where(textured, gram * scale[:, None] * scale[None, :], eye)
    regular = textured & (_linalg.eigh(lax.stop_gradient(scaled))[0][0] > 1e-3)
    inverse = _linalg.inverse(jnp.where(regular, scaled, eye)) * scale[:, None] * scale[None, :]
    return jnp.where(regular, inverse, eye), regular


def _variance(model: _Model, uv: Array, squares: Array, sigma: Any) -> Array:
    """Variance of the image's noise, corrected for interpolation."""
    if sigma is not None:
        return sigma**2
    dof = jnp.maximum(jnp.sum(model.weight) - model.rows.shape[0], 1.0)
    return squares / (dof * Bicubic().noise_gain(uv))


def _covariance(model: _Model, uv: Array, slope: Array, variance: Array) -> tuple[Array, Array]:
    """Covariance and information of independent noise propagated through interpolation, regression and Newton step."""
    weights = Bicubic().weights(uv - jnp.floor(uv))
    estimator = matmul(slope, matmul(model.inverse[-2:], model.rows * model.weight[None])).reshape(2, *model.shape)
    for axis, coordinate in ((1, 1), (2, 0)):
        estimator = _transpose_shift(estimator, [w[coordinate] for w in weights], axis)
    estimator = estimator.reshape(2, -1)
    covariance = variance * matmul(estimator, estimator.T) + _LEAST_SIGMA**2 * jnp.eye(2, dtype=uv.dtype)
    covariance = lax.stop_gradient(covariance)
    return covariance, _linalg.inverse(covariance)


def _transpose_shift(rows: Float[Array, "2 m n"], weights: list[Float[Array, ""]], axis: int) -> Float[Array, "2 p q"]:
    """Transpose of interpolation along an axis: weights of the image's pixels from those of interpolated ones."""
    extra = len(weights) - 1
    pads = [[(extra - k, k) if a == axis else (0, 0) for a in range(3)] for k in range(len(weights))]
    return sum(weight * jnp.pad(rows, pad) for weight, pad in zip(reversed(weights), pads, strict=True))
