"""Alignment by maximization of mutual information: Newton steps with analytic derivatives, from coarse to fine."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Num

from jaxloc import _linalg
from jaxloc import _tree as tree
from jaxloc._jit import filter_jit
from jaxloc._linalg import matmul
from jaxloc.alignment.lucas_kanade.pyramid_level import Frame
from jaxloc.alignment.mutual_information.density import Binning, joint_density, log_ratio, pixel_weights
from jaxloc.images.gradients import smooth
from jaxloc.images.interpolation import Bicubic, sample
from jaxloc.images.normalization import as_gray
from jaxloc.images.warps import Warp
from jaxloc.solvers import Estimate, Status
from jaxloc.solvers.estimate import guarded


class MutualInformation(eqx.Module):
    """Options of alignment by mutual information.

    Attributes:
        bins: number of bins of each image; fewer bins have wider splines, which bias the maximum where gray levels
            vary.
        blurs: standard deviations by which both images are smoothed, from coarse to fine, px; the last blur of half a
            pixel avoids the bias of interpolation towards whole pixels.
        max_steps: bound on the number of steps at each scale.
        tolerance: step length at convergence, px.
        min_coverage: least fraction of the template within the image.
        min_information: least mutual information of a valid result, nats.
        least_sigma: standard deviation of errors that noise does not explain, px: interpolation, and the difference
            between smoothing an image and smoothing that of another camera.
    """

    bins: int = eqx.field(static=True, default=32)
    blurs: tuple[float, ...] = eqx.field(static=True, default=(4.0, 2.0, 0.5))
    max_steps: int = eqx.field(static=True, default=30)
    tolerance: float = eqx.field(static=True, default=2e-3)
    min_coverage: float = eqx.field(static=True, default=0.5)
    min_information: float = eqx.field(static=True, default=0.1)
    least_sigma: float = eqx.field(static=True, default=0.03)


def align(
    image: Num[Array, "h w"] | Any,
    template: Num[Array, "p q"] | Any,
    warp: type[Warp],
    initial: Warp | None = None,
    *,
    method: MutualInformation = MutualInformation(),
    mask: Num[Array, "p q"] | Bool[Array, "p q"] | None = None,
) -> Estimate:
    """Finds the warp W of the greatest mutual information of ``image(W(x))`` and ``template(x)``.

    Maximizes from coarse to fine by damped Newton steps with analytic derivatives; negative eigenvalues of the
    curvature are reversed. The value has the derivatives of the solution (implicit function theorem).

    Args:
        image: gray levels; nan where unknown.
        template: gray levels; nan where unknown.
        warp: class of the warp: `Translation`, `Euclidean`, `Similarity`, `Affine` or `Homography`.
        initial: a warp of any class from template pixels to image pixels; the identity by default.
        method: bins, scales and limits.
        mask: weights of the template's pixels.

    Returns:
        Estimate of the warp; `cost` is minus the mutual information, nats. With n pixels on the image, n times the
        mutual information is the gain in log-likelihood of the (estimated) joint density over independence, if pixels
        were independent; `information` is minus its Hessian. The covariance (of ``W @ exp(d)``) is the inverse, and
        `least_sigma` in the mean over the template. It is conservative, not exact: blur and interpolation make pixels
        dependent and bias the maximum by some hundredths of a pixel. `ok` is False if the texture leaves a
        direction undetermined, the search did not converge, too little of the template lies within the image, or the
        mutual information is too small.

    Raises:
        ValueError: an image has not two axes, the mask has another shape, or there are too few bins.

    References:
        Viola and Wells, 1997; Dowson and Bowden, "Mutual information for Lucas-Kanade tracking (MILK)", PAMI 30(1),
        2008, for the Hessian [K-22, R-35, R-36].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> u, v = jnp.meshgrid(jnp.arange(70.0), jnp.arange(60.0))
        >>> scene = lambda u, v: 120 + 50 * jnp.sin(0.3 * u) * jnp.cos(0.25 * v) + 0.8 * u
        >>> image, template = 255 - scene(u, v), scene(u + 10.3, v + 8.6)[:40, :48]
        >>> initial = jl.images.Translation(jnp.array([9.0, 10.0]))
        >>> fit = jl.alignment.mutual_information.align(image, template, jl.images.Translation, initial)
        >>> bool(fit.ok), [round(x, 1) for x in fit.value.translation.tolist()]
        (True, [10.3, 8.6])
    """
    template = as_gray(template)
    image = as_gray(image, template.dtype)
    weight = pixel_weights(template, mask, method.bins)
    initial = warp.identity(template.dtype) if initial is None else warp.of(initial)
    initial = jax.tree.map(lambda leaf: leaf.astype(template.dtype), initial)
    return _align(image, template, weight, initial, method)


class _Scale(eqx.Module):
    """Both images at one scale; the image has a second channel that is above zero near unknown pixels."""

    channels: Float[Array, "h w 2"]
    shares: Float[Array, "b n"]
    u: Float[Array, " n"]
    v: Float[Array, " n"]
    weight: Float[Array, " n"]
    binning: Binning
    frame: Frame = eqx.field(static=True)

    def sample(self, u: Float[Array, " n"], v: Float[Array, " n"]) -> tuple[Array, Array]:
        """Gray levels of the image at normalized coordinates, and where they are known."""
        (center_u, center_v), radius = self.frame.center, self.frame.radius
        uv = jnp.stack([u * radius + center_u, v * radius + center_v], axis=1)
        read = sample(self.channels, uv, method=Bicubic())
        return read.values[:, 0], read.inside & (jnp.abs(read.values[:, 1]) < 1e-3)

    def weights(self, known: Bool[Array, " n"]) -> Float[Array, " n"]:
        return jnp.where(known, self.weight, 0.0)

    def coverage(self, known: Bool[Array, " n"]) -> Float[Array, ""]:
        total = jnp.sum(self.weight)
        return jnp.sum(self.weights(known)) / jnp.where(total > 0, total, 1.0)


class _Ascent(eqx.Module):
    """State of the search: a warp with value and derivatives."""

    warp: Warp
    information: Float[Array, ""]
    gradient: Float[Array, " d"]
    hessian: Float[Array, "d d"]
    damping: Float[Array, ""]
    moved: Float[Array, ""]
    count: Int[Array, ""]


def _scales(image: Array, template: Array, weight: Array, method: MutualInformation) -> list[_Scale]:
    """Both images at all blurs, the coarsest first."""
    frame, known, finite = Frame.of(template.shape), weight > 0, jnp.isfinite(image)
    image, template = _filled(image, finite), _filled(template, jnp.isfinite(template))
    v, u = jnp.meshgrid(*(jnp.arange(side, dtype=weight.dtype) for side in template.shape), indexing="ij")
    u, v = ((x.reshape(-1) - c) / frame.radius for x, c in ((u, frame.center[0]), (v, frame.center[1])))
    scales = []
    for sigma in method.blurs:
        channels = image, template, (~finite).astype(image.dtype)
        smoothed, target, missing = (smooth(x, sigma) if sigma > 0 else x for x in channels)
        # Along the border, smoothing used pixels extrapolated beyond it.
        margin = min(math.ceil(sigma), (min(template.shape) - 1) // 4)
        inner = jnp.pad(jnp.ones([side - 2 * margin for side in template.shape], weight.dtype), margin)
        shares = Binning.of(target, known, method.bins).weights(target.reshape(-1))
        binning = Binning.of(smoothed, jnp.ones(smoothed.shape, bool), method.bins)
        channels = jnp.stack([smoothed, missing], axis=-1)
        scales.append(_Scale(channels, shares, u, v, (weight * inner).reshape(-1), binning, frame))
    return scales


def _filled(image: Array, finite: Array) -> Array:
    mean = jnp.sum(jnp.where(finite, image, 0.0)) / jnp.maximum(jnp.sum(finite), 1).astype(image.dtype)
    return jnp.where(finite, image, mean)


def _evaluate(scale: _Scale, warp: Warp) -> tuple[Array, Array, Array, Array]:
    """Mutual information, its gradient, its Hessian without second derivatives of the image, and the coverage."""
    u, v = warp.map_components(scale.u, scale.v)

    def along(du: Array, dv: Array) -> tuple[Array, Array, Array]:
        return jax.jvp(scale.sample, (u, v), (du, dv), has_aux=True)

    one, zero = jnp.ones_like(u), jnp.zeros_like(u)
    directions = jnp.stack([one, zero]), jnp.stack([zero, one])
    values, (along_u, along_v), known = jax.vmap(along, out_axes=(None, 0, None))(*directions)
    moves = jax.vmap(lambda d: jax.jvp(lambda t: _moved(scale, warp, t), (jnp.zeros(warp.dof, u.dtype),), (d,))[1])
    by_u, by_v = moves(jnp.eye(warp.dof, dtype=u.dtype))
    slope = along_u[None] * by_u + along_v[None] * by_v
    weight = scale.weights(known)
    weight = weight / jnp.maximum(jnp.sum(weight), 1e-6)
    share, first, second = scale.binning.weights_with_derivatives(values)
    density = matmul(scale.shares * weight[None], share.T)
    ratio = log_ratio(density, conditional=True)
    expected = matmul(ratio.T, scale.shares)
    gradient = jnp.sum(slope * (weight * jnp.sum(expected * first, axis=0))[None], axis=1)
    change = jax.vmap(lambda row: matmul(scale.shares, (first * (row * weight)[None]).T))(slope)
    inverse = jnp.where(density > 1e-12, 1.0 / jnp.maximum(density, 1e-12), 0.0)
    marginal, margin_change = jnp.sum(density, axis=0), jnp.sum(change, axis=1)
    inverse_marginal = jnp.where(marginal > 1e-12, 1.0 / jnp.maximum(marginal, 1e-12), 0.0)
    flat = change.reshape(warp.dof, -1)
    hessian = matmul(flat * inverse.reshape(-1)[None], flat.T)
    hessian = hessian - matmul(margin_change * inverse_marginal[None], margin_change.T)
    hessian = hessian + matmul(slope * (weight * jnp.sum(expected * second, axis=0))[None], slope.T)
    return jnp.sum(density * log_ratio(density)), gradient, hessian, scale.coverage(known)


def _moved(scale: _Scale, warp: Warp, delta: Float[Array, " d"]) -> tuple[Array, Array]:
    return warp.retract(delta).map_components(scale.u, scale.v)


def _information(scale: _Scale, warp: Warp, delta: Float[Array, " d"]) -> Float[Array, ""]:
    """Mutual information of a warp moved by a tangent vector, by definition."""
    values, known = scale.sample(*_moved(scale, warp, delta))
    density = joint_density(scale.shares, scale.binning.weights(values), scale.weights(known))
    return jnp.sum(density * log_ratio(density))


def _climb(scale: _Scale, warp: Warp, method: MutualInformation) -> _Ascent:
    """Damped Newton steps at one scale: steps that decrease the information are rejected and shortened."""
    reach = 2.0 / scale.frame.radius
    tolerance = method.tolerance / scale.frame.radius

    zero, dof = jnp.zeros((), scale.u.dtype), warp.dof
    nothing = jnp.zeros(dof, zero.dtype), jnp.eye(dof, dtype=zero.dtype)
    # The first step is zero: it evaluates the initial warp.
    first = _Ascent(warp, zero - jnp.inf, *nothing, zero + 1e-2, zero + jnp.inf, jnp.zeros((), jnp.int32))

    def go_on(at: _Ascent) -> Bool[Array, ""]:
        return (at.count < method.max_steps) & (at.moved > tolerance) & (at.damping < 1e4)

    def advance(at: _Ascent) -> _Ascent:
        values, vectors = _linalg.eigh(at.hessian)
        sizes = jnp.maximum(jnp.abs(values), 1e-6 * jnp.max(jnp.abs(values)) + 1e-30)
        step = matmul(vectors, matmul(vectors.T, at.gradient) / (sizes + at.damping * jnp.max(sizes)))
        length = jnp.sqrt(jnp.sum(step * step) + 1e-30)
        step = step * jnp.minimum(1.0, reach / length)
        trial = at.warp.retract(step)
        information, gradient, hessian, coverage = _evaluate(scale, trial)
        first = at.count == 0
        better = first | ((information >= at.information) & (coverage >= 0.5 * method.min_coverage))
        moved = jnp.where(better | (length < tolerance), length, at.moved)
        moved = jnp.where(first, jnp.inf, moved)
        damping = jnp.where(better, jnp.where(first, at.damping, at.damping * 0.2), at.damping * 5.0)
        new = _Ascent(trial, information, gradient, hessian, damping, moved, at.count)
        old = _Ascent(at.warp, at.information, at.gradient, at.hessian, damping, moved, at.count)
        kept = tree.where(better, new, old)
        return eqx.tree_at(lambda a: a.count, kept, at.count + 1)

    return lax.while_loop(go_on, advance, first)


@filter_jit
def _align(image: Array, template: Array, weight: Array, initial: Warp, method: MutualInformation) -> Estimate:
    return guarded(jnp.array(True), lambda *given: _maximize(*given, method), image, template, weight, initial)


def _maximize(image: Array, template: Array, weight: Array, initial: Warp, method: MutualInformation) -> Estimate:
    finite = jnp.all(jnp.isfinite(initial.matrix()))
    safe = tree.where(finite, initial, type(initial).identity(image.dtype))
    frame = Frame.of(template.shape)
    warp = frame.normalize(lax.stop_gradient(safe))
    scales = _scales(image, template, weight, method)

    def climb(carry: tuple, scale: _Scale) -> tuple[tuple, None]:
        ascent = _climb(scale, carry[0], method)
        return (ascent.warp, ascent.moved, carry[2] + ascent.count), None

    # One compiled loop for all blurs.
    stack = jax.tree.map(lambda *leaves: jnp.stack(leaves), *lax.stop_gradient(scales))
    begin = (warp, jnp.zeros((), image.dtype), jnp.zeros((), jnp.int32))
    (warp, moved, count), _ = lax.scan(climb, begin, stack)
    return _conclude(scales[-1], warp, moved, count, finite, method)


def _conclude(scale: _Scale, warp: Warp, moved: Array, count: Array, finite: Array, method: MutualInformation):
    """Status, covariance, and one Newton step with the exact Hessian, which has the derivatives of the solution."""
    zero, frozen = jnp.zeros(warp.dof, scale.u.dtype), lax.stop_gradient(scale)
    curvature = -jax.hessian(lambda delta: _information(frozen, warp, delta))(zero)
    values = _linalg.eigh(jnp.where(jnp.isfinite(curvature), curvature, 0.0))[0]
    regular = (values[0] > 1e-5 * values[-1]) & (values[-1] > 1e-8) & jnp.all(jnp.isfinite(curvature))
    eye = jnp.eye(warp.dof, dtype=zero.dtype)
    inverse = _linalg.inverse(jnp.where(regular, curvature, eye))
    cost, gradient = jax.value_and_grad(lambda delta: -_information(scale, warp, delta))(zero)
    step = -matmul(inverse, gradient)
    known = frozen.sample(*warp.map_components(scale.u, scale.v))[1]
    covered = jnp.sum(scale.weights(known))
    near = jnp.max(jnp.abs(step)) < 0.2 / scale.frame.radius
    converged = near & (moved <= 10.0 * method.tolerance / scale.frame.radius)
    admissible = (scale.coverage(known) >= method.min_coverage) & (-cost >= method.min_information)
    status = jnp.asarray(int(Status.CONVERGED), jnp.int32)
    for failed, code in (
        (~converged, Status.MAX_STEPS),
        (~admissible, Status.INADMISSIBLE),
        (~regular, Status.RANK_DEFICIENT),
        (~finite, Status.NONFINITE),
    ):
        status = jnp.where(failed, int(code), status)
    ok = status == int(Status.CONVERGED)
    value = scale.frame.denormalize(warp.retract(jnp.where(ok, step, 0.0)))
    to_pixels = scale.frame.tangent_to_pixels(warp.dof, zero.dtype)
    pixels = jnp.maximum(covered, 1.0)
    scaled = inverse / pixels + _least_covariance(frozen, warp, method)
    covariance = matmul(to_pixels, matmul(jnp.where(regular, scaled, eye), to_pixels.T))
    from_pixels = _linalg.inverse(to_pixels)
    information = matmul(from_pixels.T, matmul(jnp.where(regular, curvature * pixels, 0.0 * eye), from_pixels))
    return Estimate(value, lax.stop_gradient(covariance), cost, ok, count, status, lax.stop_gradient(information))


def _least_covariance(scale: _Scale, warp: Warp, method: MutualInformation) -> Float[Array, "d d"]:
    """Covariance of a warp that moves the template's pixels by `least_sigma` in the mean, equally in all directions."""
    zero = jnp.zeros(warp.dof, scale.u.dtype)
    ways = jnp.concatenate(jax.jacfwd(lambda delta: _moved(scale, warp, delta))(zero)) * scale.frame.radius
    mean = matmul(ways.T, ways) / float(scale.u.shape[0])
    return _linalg.inverse(mean) * (method.least_sigma**2 * 2.0 / warp.dof)
