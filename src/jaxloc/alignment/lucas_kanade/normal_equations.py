"""Normal equations of alignment, with brightness eliminated and robust weights."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxloc._linalg import matmul
from jaxloc.alignment.lucas_kanade.formulations import Formulation, Linearized
from jaxloc.alignment.lucas_kanade.pyramid_level import Level
from jaxloc.images.interpolation import AbstractInterpolation
from jaxloc.images.warps import Warp
from jaxloc.solvers.cholesky import factor
from jaxloc.solvers.robust_kernels import Loss, Quadratic

_SCALE_SAMPLES = 1024  # sampled residuals for their scale, since sorting all costs more than the step


class Matching(eqx.Module):
    """Options of the comparison of two images.

    Attributes:
        formulation: which image is differentiated.
        interpolation: of the image.
        loss: kernel on residuals over their scale.
        sigma: scale of residuals, gray levels; None estimates it by the median of their absolute values.
    """

    formulation: Formulation
    interpolation: AbstractInterpolation
    loss: Loss
    sigma: Float[Array, ""] | None


class Equations(eqx.Module):
    """Normal equations at a warp, in normalized coordinates.

    Attributes:
        hessian: of half the weighted squared residual.
        gradient: its derivative.
        brightness: coefficients of the brightness columns.
        gain: contrast of the image over that of the template.
        mean_cost: half the weighted mean squared residual, gray levels squared; infinite where nothing is visible.
    """

    hessian: Float[Array, "d d"]
    gradient: Float[Array, " d"]
    brightness: Float[Array, " k"]
    gain: Float[Array, ""]
    mean_cost: Float[Array, ""]


class Weighted(eqx.Module):
    """Residuals of a comparison with their weights.

    Attributes:
        difference: image less template, where both are known.
        residual: difference less the brightness model.
        weight: of each pixel.
    """

    difference: Float[Array, " n"]
    residual: Float[Array, " n"]
    weight: Float[Array, " n"]


def weigh(level: Level, linear: Linearized, brightness: Float[Array, " k"], matching: Matching) -> Weighted:
    """Differences, residuals under given brightness, and their weights."""
    weight = jnp.where(linear.known, level.weight, 0.0)
    difference = jnp.where(weight > 0, linear.values - level.template, 0.0)
    residual = difference - matmul(brightness, level.columns)
    if isinstance(matching.loss, Quadratic):
        return Weighted(difference, residual, weight)
    scale = _scale(residual, weight) if matching.sigma is None else matching.sigma
    return Weighted(difference, residual, weight * matching.loss.weight((residual / scale) ** 2))


def weight_slope(level: Level, weighted: Weighted, matching: Matching) -> Float[Array, " n"]:
    """Derivative of each weight by its residual, at constant scale."""
    if isinstance(matching.loss, Quadratic):
        return jnp.zeros_like(weighted.residual)
    scale = _scale(weighted.residual, weighted.weight) if matching.sigma is None else matching.sigma
    squared = (weighted.residual / scale) ** 2
    fall = jax.jvp(matching.loss.weight, (squared,), (jnp.ones_like(squared),))[1]
    known = weighted.weight > 0
    return jnp.where(known, level.weight * fall * 2.0 * weighted.residual / scale**2, 0.0)


class Prepared(eqx.Module):
    """Precomputed parts of inverse formulations.

    Attributes:
        steepest: steepest descent images of the template.
        hessian: of the whole template, brightness eliminated; None with robust weights, which change in every step.
    """

    steepest: Float[Array, "d n"]
    hessian: Float[Array, "d d"] | None

    @staticmethod
    def of(level: Level, warp: Warp, matching: Matching) -> "Prepared | None":
        """The precomputed parts; None for forward formulations."""
        if not matching.formulation.inverse:
            return None
        right, down = warp.jacobian_components(level.u, level.v)
        steepest = level.slope[0][None] * right + level.slope[1][None] * down
        if not isinstance(matching.loss, Quadratic):
            return Prepared(steepest, None)
        sums = Sums.of(steepest, level, jnp.zeros_like(level.template), level.weight)
        return Prepared(steepest, sums.hessian(steepest, level.weight))


class Sums(eqx.Module):
    """Weighted products of steepest images, brightness columns and the difference, brightness eliminated from them.

    Attributes:
        by_columns: steepest images with columns.
        coefficients: of brightness in the difference.
        gradient: steepest images with the residual.
        squares: of the residual.
        steepest_brightness: coefficients of brightness in the steepest images.
    """

    by_columns: Float[Array, "d k"]
    coefficients: Float[Array, " k"]
    gradient: Float[Array, " d"]
    squares: Float[Array, ""]
    steepest_brightness: Float[Array, "k d"]

    @staticmethod
    def of(
        steepest: Float[Array, "d n"], level: Level, difference: Float[Array, " n"], weight: Float[Array, " n"]
    ) -> "Sums":
        """All sums, by one product with the steepest images and one among the others."""
        columns = level.columns
        k = columns.shape[0]
        others = jnp.concatenate([columns, difference[None]])
        weighted = (others * weight[None]).T
        outer, inner = matmul(steepest, weighted), matmul(others, weighted)
        if k == 0:
            return Sums(outer[:, :0], inner[0, :0], outer[:, 0], inner[0, 0], outer[:, :0].T)
        if level.correlating:
            return _correlating(outer, inner, level.contrast)
        solver = factor(inner[:k, :k])
        coefficients = solver.solve(inner[:k, k])
        steepest_brightness = jnp.stack([solver.solve(row) for row in outer[:, :k]], axis=1)
        gradient = outer[:, k] - matmul(outer[:, :k], coefficients)
        return Sums(
            outer[:, :k],
            coefficients,
            gradient,
            inner[k, k] - jnp.sum(inner[:k, k] * coefficients),
            steepest_brightness,
        )

    def hessian(self, steepest: Float[Array, "d n"], weight: Float[Array, " n"]) -> Float[Array, "d d"]:
        """Products of the steepest images with brightness projected out."""
        return matmul(steepest * weight[None], steepest.T) - matmul(self.by_columns, self.steepest_brightness)


def _correlating(outer: Float[Array, "d 3"], inner: Float[Array, "3 3"], deviation: Float[Array, ""]) -> Sums:
    """Sums for the greatest correlation: the template counts times ``|i|^2 / t i``, not ``t i / |t|^2``."""
    total = jnp.where(inner[1, 1] > 0, inner[1, 1], 1.0)
    mean = inner[1] / total
    about = inner - inner[:, 1][:, None] * mean[None, :]
    # The image is the difference plus the template.
    own = about[2, 2] + 2.0 * deviation * about[0, 2] + deviation**2 * about[0, 0]
    both = about[0, 2] + deviation * about[0, 0]
    alike = both > 1e-6 * own
    contrast = jnp.where(alike, own / jnp.where(alike, both, 1.0), deviation)
    by_template = contrast - deviation
    coefficients = jnp.stack([by_template, mean[2] - by_template * mean[0]])
    gradient = outer[:, 2] - matmul(outer[:, :2], coefficients)
    steepest_brightness = jnp.stack([jnp.zeros_like(outer[:, 1]), outer[:, 1] / total])
    energy = own * about[0, 0]
    unlike = 1.0 - jnp.where(alike, both * both / jnp.where(alike, energy, 1.0), 0.0)
    return Sums(outer[:, :2], coefficients, gradient, unlike * total * deviation**2, steepest_brightness)


def equations(
    level: Level,
    prepared: Prepared | None,
    warp: Warp,
    brightness: Float[Array, " k"],
    matching: Matching,
    *,
    second: float = 0.0,
) -> Equations:
    """Normal equations at a warp.

    Args:
        level: both images at one scale.
        prepared: parts that do not depend on the warp.
        warp: in normalized coordinates.
        brightness: coefficients for the residuals of the robust weights.
        matching: options of the comparison.
        second: factor of the second-order part of the Hessian.

    Returns:
        Equations in which brightness is eliminated. The Hessian of an inverse formulation without robust weights is
        that of the whole template, times the visible fraction.
    """
    linear = matching.formulation.linearize(level, warp, matching.interpolation)
    weighted = weigh(level, linear, brightness, matching)
    steepest = linear.steepest if prepared is None else prepared.steepest
    sums = Sums.of(steepest, level, weighted.difference, weighted.weight)
    gain = gain_of(level, sums.coefficients)
    total, full = jnp.sum(weighted.weight), jnp.sum(level.weight)
    if prepared is None or prepared.hessian is None:
        hessian = sums.hessian(steepest, weighted.weight)
    else:
        hessian = prepared.hessian * (total / jnp.where(full > 0, full, 1.0))
    if second:
        residual = weighted.difference - matmul(sums.coefficients, level.columns)
        sign = -1.0 / jnp.maximum(gain, 0.25) if matching.formulation.inverse else jnp.ones_like(gain)
        hessian = hessian + second * sign * _second_order(level, warp, linear, residual * weighted.weight, matching)
    visible = total > 0
    mean_cost = jnp.where(visible, 0.5 * sums.squares / jnp.where(visible, total, 1.0), jnp.inf)
    return Equations(hessian, sums.gradient, sums.coefficients, gain, mean_cost)


def gain_of(level: Level, coefficients: Float[Array, " k"]) -> Float[Array, ""]:
    """Contrast of the image over that of the template: one where brightness has no gain."""
    one = jnp.ones((), level.template.dtype)
    if coefficients.shape[0] < 2:
        return one
    textured = level.contrast > 0
    return one + jnp.where(textured, coefficients[0] / jnp.where(textured, level.contrast, 1.0), 0.0)


def _second_order(
    level: Level, warp: Warp, linear: Linearized, residual: Float[Array, " n"], matching: Matching
) -> Float[Array, "d d"]:
    """Sum of residuals times second derivatives of the differentiated image along the warp."""
    uu, uv, vv = matching.formulation.second(level, warp, matching.interpolation)
    along = uu[None] * linear.right + uv[None] * linear.down
    across = uv[None] * linear.right + vv[None] * linear.down
    by_image = matmul(linear.right * residual[None], along.T) + matmul(linear.down * residual[None], across.T)
    along_warp = matching.formulation.warp_curvature(level, warp, linear)
    return by_image + jnp.sum(along_warp * residual[None, None], axis=-1)


def _scale(residual: Float[Array, " n"], weight: Float[Array, " n"]) -> Float[Array, ""]:
    """Standard deviation by the median size of a sample of the residuals."""
    step = max(1, residual.shape[0] // _SCALE_SAMPLES)
    sizes, counts = lax.stop_gradient(jnp.abs(residual[::step])), weight[::step] > 0
    ordered = jnp.sort(jnp.where(counts, sizes, jnp.inf))
    middle = ordered[jnp.sum(counts) // 2]
    return jnp.maximum(1.4826 * jnp.where(jnp.isfinite(middle), middle, 1.0), 1e-3)


def zero_brightness(level: Level) -> Any:
    """Coefficients of unchanged brightness."""
    return jnp.zeros(level.columns.shape[0], level.template.dtype)
