"""Covariance, status and derivatives of an alignment.

The solution is a root of the estimating equations ``g(W) = sum w J (image(W(x)) - ...) = 0``, whose J may be the
template's: not the derivative of a cost. So covariance and derivatives are those of a root: with ``S = dg/dW`` and
the images' noise propagated through g.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxloc import _linalg
from jaxloc._linalg import matmul
from jaxloc._xla import compute_once
from jaxloc.alignment.lucas_kanade.formulations import through
from jaxloc.alignment.lucas_kanade.interpolation_noise import noise_transfer
from jaxloc.alignment.lucas_kanade.normal_equations import Matching, Sums, gain_of, weigh, weight_slope
from jaxloc.alignment.lucas_kanade.options import LucasKanade
from jaxloc.alignment.lucas_kanade.pyramid_level import Frame, Level
from jaxloc.alignment.lucas_kanade.scales import Scaled
from jaxloc.beliefs.validity import positive
from jaxloc.images.warps import Warp
from jaxloc.solvers.cholesky import factor
from jaxloc.solvers.estimate import Status
from jaxloc.solvers.implicit_gradient import Equations


class AlignmentData(eqx.Module):
    """Images, weights, noise and options of an alignment.

    Attributes:
        image: gray levels.
        template: gray levels.
        weights: of the template's pixels.
        sigma: standard deviation of the image's noise, or None.
        frame: of the template.
        method: options.
    """

    image: Float[Array, "h w"]
    template: Float[Array, "p q"]
    weights: Float[Array, "p q"]
    sigma: Float[Array, ""] | None
    frame: Frame = eqx.field(static=True)
    method: LucasKanade

    @property
    def matching(self) -> Matching:
        """Options of the comparison."""
        method = self.method
        sigma = None if self.sigma is None else jnp.hypot(self.sigma, method.template_noise * self.sigma)
        return Matching(method.formulation, method.interpolation, method.loss, sigma)

    def levels(self) -> list[Level]:
        """Both images at all scales, the coarsest first."""
        return [self._level(scaled) for scaled in self.method.scales.of(self.image, self.template)]

    def finest(self) -> Level:
        """Both images at the last scale."""
        return self._level(self.method.scales.of(self.image, self.template)[-1])

    def _level(self, scaled: Scaled) -> Level:
        forwards = not self.method.formulation.inverse
        return Level.of(scaled, self.weights, self.frame, self.method.brightness, differentiate_image=forwards)


class Conclusion(eqx.Module):
    """Covariance and status of an alignment.

    Attributes:
        covariance: in the tangent of the warp of pixels.
        information: of the same tangent: the Gauss-Newton Hessian over the noise's variance.
        cost: sum of rho.
        ok: whether the estimate can be used.
        status: a `Status` code.
    """

    covariance: Float[Array, "d d"]
    information: Float[Array, "d d"]
    cost: Float[Array, ""]
    ok: Bool[Array, ""]
    status: Int[Array, ""]


def score(level: Level, warp: Warp, brightness: Float[Array, " k"], matching: Matching) -> Float[Array, " d"]:
    """The estimating equations: zero at the solution."""
    linear = matching.formulation.linearize(level, warp, matching.interpolation)
    weighted = weigh(level, linear, brightness, matching)
    return Sums.of(linear.steepest, level, weighted.difference, weighted.weight).gradient


def slope(level: Level, warp: Warp, brightness: Float[Array, " k"], matching: Matching) -> Float[Array, "d d"]:
    """Derivative of the score along the warp's tangent ``W @ exp(d)``.

    Exact for inverse formulations of least squares; for the others without second derivatives of the image, which are
    sensitive to noise.
    """
    linear = matching.formulation.linearize(level, warp, matching.interpolation)
    weighted = weigh(level, linear, brightness, matching)
    steepest, columns = linear.steepest, level.columns
    sums = Sums.of(steepest, level, weighted.difference, weighted.weight)
    projected = steepest - matmul(sums.steepest_brightness.T, columns)
    left = weighted.difference - matmul(sums.coefficients, columns)
    sampled = level.sample_with_interpolant_slope(warp, matching.interpolation)
    along = compute_once(lambda slope: through(warp, level, slope), sampled.slope)
    right, down = warp.jacobian_components(level.u, level.v)
    change = along[0][None] * right + along[1][None] * down
    weight = weighted.weight + left * weight_slope(level, weighted, matching)
    return matmul(projected * weight[None], change.T)


def exact_slope(level: Level, warp: Warp, brightness: Float[Array, " k"], matching: Matching) -> Float[Array, "d d"]:
    """Exact derivative of the score along the warp's tangent."""
    if matching.formulation.inverse and not level.correlating:
        return slope(level, warp, brightness, matching)
    zero = jnp.zeros(warp.dof, level.template.dtype)
    return jax.jacfwd(lambda delta: score(level, warp.retract(delta), brightness, matching))(zero)


class AlignmentEquations(Equations):
    """The estimating equations as equations of the warp, for derivatives of the solution by the images.

    Attributes:
        data: the images.
        brightness: coefficients of its columns.
    """

    data: AlignmentData
    brightness: Float[Array, " k"]

    def residual(self, value: Warp) -> Float[Array, " d"]:
        """The score at the finest scale."""
        return score(self.data.finest(), value, jax.lax.stop_gradient(self.brightness), self.data.matching)

    def solve(self, value: Warp, right: Float[Array, " d"], ok: Bool[Array, ""]) -> Float[Array, " d"]:
        """By the exact derivative of the score."""
        matrix = exact_slope(self.data.finest(), value, self.brightness, self.data.matching)
        return _solve(matrix, right, ok)

    def move(self, value: Warp, delta: Float[Array, " d"]) -> Warp:
        """By the warp's own retraction."""
        return value.retract(delta)


def _solve(matrix: Float[Array, "d d"], vector: Float[Array, " d"], ok: Bool[Array, ""]) -> Float[Array, " d"]:
    safe = jnp.where(ok, matrix, jnp.eye(matrix.shape[0], dtype=matrix.dtype))
    return matmul(_linalg.inverse(safe), vector)


def conclude(
    data: AlignmentData, warp: Warp, brightness: Float[Array, " k"], moved: Float[Array, ""], finite: Bool[Array, ""]
) -> Conclusion:
    """Covariance and status of a solution at the finest scale.

    Args:
        data: the images.
        warp: the solution, in normalized coordinates.
        brightness: coefficients of its columns.
        moved: length of the last step, px.
        finite: whether the initial warp was.
    """
    level, matching, method = data.finest(), data.matching, data.method
    match = _Match.at(level, warp, brightness, matching)
    noise = _Noise.of(data, level, warp, match)
    bread = (exact_slope if level.correlating else slope)(level, warp, brightness, matching)
    deficient = factor(match.hessian).deficient | (level.contrast == 0) | ~jnp.all(jnp.isfinite(bread))
    admissible = (match.coverage >= method.min_coverage) & (match.gain > 0.1) & _upright(level, warp)
    admissible = admissible & (match.correlation >= method.min_correlation)
    converged = moved <= max(method.tolerance, 10.0 * _rounding(level))
    status = jnp.asarray(int(Status.CONVERGED))
    for failed, code in (
        (~converged, Status.MAX_STEPS),
        (~(jnp.array(True) if data.sigma is None else positive(data.sigma)), Status.INADMISSIBLE),
        (~admissible, Status.INADMISSIBLE),
        (deficient, Status.RANK_DEFICIENT),
        (~finite, Status.NONFINITE),
    ):
        status = jnp.where(failed, int(code), status)
    inverse = _linalg.inverse(jnp.where(deficient, jnp.eye(warp.dof, dtype=bread.dtype), bread))
    tangent = matmul(inverse, matmul(noise.of_score, inverse.T))
    ok = (status == int(Status.CONVERGED)) & jnp.all(jnp.isfinite(tangent))
    to_pixels = data.frame.tangent_to_pixels(warp.dof, bread.dtype)
    covariance = matmul(to_pixels, matmul(jnp.where(ok, tangent, jnp.eye(warp.dof, dtype=tangent.dtype)), to_pixels.T))
    from_pixels = _linalg.inverse(to_pixels)
    # In units of the template, whose contrast in the image is multiplied by the gain.
    contrast = match.gain**2 if method.formulation.inverse else jnp.ones_like(match.gain)
    information = matmul(from_pixels.T, matmul(match.hessian * contrast / noise.of_difference, from_pixels))
    rho = method.loss.rho(match.residual**2 / noise.of_difference)
    cost = jnp.sum(jnp.where(match.known, level.weight * rho, 0.0))
    return Conclusion(_finite(covariance), _finite(information), _finite(cost), ok, status)


class _Match(eqx.Module):
    """The comparison at the solution, with estimated brightness."""

    hessian: Float[Array, "d d"]
    steepest: Float[Array, "d n"]
    weight: Float[Array, " n"]
    residual: Float[Array, " n"]
    known: Bool[Array, " n"]
    squares: Float[Array, ""]
    gain: Float[Array, ""]
    correlation: Float[Array, ""]
    coverage: Float[Array, ""]

    @staticmethod
    def at(level: Level, warp: Warp, brightness: Float[Array, " k"], matching: Matching) -> "_Match":
        linear = matching.formulation.linearize(level, warp, matching.interpolation)
        weighted = weigh(level, linear, brightness, matching)
        weight, columns = weighted.weight, level.columns
        sums = Sums.of(linear.steepest, level, weighted.difference, weight)
        steepest = (linear.steepest - matmul(sums.steepest_brightness.T, columns)) * weight[None]
        residual = weighted.difference - matmul(sums.coefficients, columns)
        total, known = jnp.sum(level.weight), weight > 0
        coverage = jnp.sum(jnp.where(linear.known, level.weight, 0.0)) / jnp.where(total > 0, total, 1.0)
        return _Match(
            sums.hessian(linear.steepest, weight),
            steepest,
            weight,
            residual,
            known,
            sums.squares,
            gain_of(level, sums.coefficients),
            _correlation(linear.values, level.template, weight),
            coverage,
        )


class _Noise(eqx.Module):
    """Variances: of a difference of both images' pixels, and of the score."""

    of_difference: Float[Array, ""]
    of_score: Float[Array, "d d"]

    @staticmethod
    def of(data: AlignmentData, level: Level, warp: Warp, match: _Match) -> "_Noise":
        transfer = noise_transfer(level, warp, data.method.interpolation, match.weight)
        template_part = (match.gain * data.method.template_noise) ** 2
        if data.sigma is None:
            total, count = jnp.sum(match.weight), jnp.sum(match.known).astype(match.weight.dtype)
            spare = jnp.maximum(count - (warp.dof + level.columns.shape[0]), 1.0) / jnp.maximum(count, 1.0)
            mean = jnp.maximum(match.squares, 0.0) / jnp.where(total > 0, total * spare, 1.0)
            variance = mean / (transfer.residual + template_part)
        else:
            variance = data.sigma**2
        # The variance of equal images is that of rounding.
        variance = jnp.maximum(variance, (level.contrast * jnp.finfo(match.weight.dtype).eps) ** 2 + 1e-12)
        score_part = variance * (transfer.solution + template_part)
        return _Noise(variance * (1.0 + template_part), score_part * matmul(match.steepest, match.steepest.T))


def _correlation(first: Float[Array, " n"], second: Float[Array, " n"], weight: Float[Array, " n"]) -> Float[Array, ""]:
    total = jnp.sum(weight)
    total = jnp.where(total > 0, total, 1.0)
    a = first - jnp.sum(weight * first) / total
    b = second - jnp.sum(weight * second) / total
    scale = jnp.sum(weight * a * a) * jnp.sum(weight * b * b)
    return jnp.where(scale > 0, jnp.sum(weight * a * b) / jnp.sqrt(jnp.where(scale > 0, scale, 1.0)), 0.0)


def _upright(level: Level, warp: Warp) -> Bool[Array, ""]:
    """Whether the template's corners keep their order: the template is neither folded nor mirrored."""
    u = jnp.stack([level.u[0], level.u[-1], level.u[-1], level.u[0]])
    v = jnp.stack([level.v[0], level.v[0], level.v[-1], level.v[-1]])
    right, down = warp.map_components(u, v)
    along, across = jnp.roll(right, -1) - right, jnp.roll(down, -1) - down
    turns = along * jnp.roll(across, -1) - across * jnp.roll(along, -1)
    return jnp.all(turns > 0) & jnp.all(jnp.abs(right) < 1e5)


def _rounding(level: Level) -> float:
    """Resolution of positions in the dtype, px."""
    return float(jnp.finfo(level.template.dtype).eps) * 4.0 * max(level.frame.radius, *level.image.shape)


def _finite(values: Array) -> Array:
    return jnp.where(jnp.isfinite(values), values, 0.0)
