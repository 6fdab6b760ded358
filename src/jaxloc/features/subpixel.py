"""Subpixel refinement of matched patches: brightness-proof Gauss-Newton with a covariance for every point."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxloc.images.interpolation import AbstractInterpolation, Bilinear, inside_image
from jaxloc.images.patches import extract, slice_windows


class RefinedColumns(eqx.Module):
    """Right-image positions of stereo matches.

    Attributes:
        uv: Refined pixels in the right image, in the row of the left point; the guess where not ok (zero if that is off
            the image).
        residual: Root mean square of the gray-level difference that gain and bias leave.
        variance: Variance of the column, px^2.
        correlation: Normalized correlation of both patches, -1 to 1.
        ok: True where the refinement may be trusted.
    """

    uv: Float[Array, "n 2"]
    residual: Float[Array, " n"]
    variance: Float[Array, " n"]
    correlation: Float[Array, " n"]
    ok: Bool[Array, " n"]


class RefinedPoints(eqx.Module):
    """Positions of matched points in a second image.

    Attributes:
        uv: Refined pixels in the second image; the guess where not ok (zero if that is off the image).
        residual: Root mean square of the gray-level difference that gain and bias leave.
        covariance: Covariance of `uv`, px^2.
        correlation: Normalized correlation of both patches, -1 to 1.
        ok: True where the refinement may be trusted.
    """

    uv: Float[Array, "n 2"]
    residual: Float[Array, " n"]
    covariance: Float[Array, "n 2 2"]
    correlation: Float[Array, " n"]
    ok: Bool[Array, " n"]


class PatchRefinement(eqx.Module):
    """How matched patches are refined.

    Attributes:
        size: Odd side of a patch, px.
        reach: Greatest correction, px.
        num_steps: Gauss-Newton steps before the last, which is a Newton step.
        min_correlation: Least correlation of a trusted result.
        least_sigma: Standard deviation of what the patch's noise does not show (interpolation, slanted surfaces), px.
        method: Interpolation of both images; `Bicubic()` costs twice the time and gains little.
    """

    size: int = eqx.field(static=True, default=11)
    reach: int = eqx.field(static=True, default=3)
    num_steps: int = eqx.field(static=True, default=4)
    min_correlation: float = eqx.field(static=True, default=0.8)
    least_sigma: float = eqx.field(static=True, default=0.02)
    method: AbstractInterpolation = Bilinear()


def refine_stereo(
    left: Float[Array, "h w"],
    right: Float[Array, "h w"],
    uv_left: Float[Array, "n 2"],
    uv_right: Float[Array, "n 2"],
    *,
    options: PatchRefinement = PatchRefinement(),  # noqa: B008 (an immutable record)
) -> RefinedColumns:
    """Refines the columns of stereo matches in a rectified pair.

    Minimizes `sum (I_right(x + d) - g I_left(x) - b)^2` over the column of d, with gain g and bias b of every patch
    eliminated in closed form; each step costs one shift of a slice along its row. The derivative is the left patch's
    (inverse composition), so that the normal equations are formed once. Gradients are those of the solution, by the
    implicit function theorem; the guess has none.

    Args:
        left: Left image, gray levels.
        right: Right image, of the same rectified pair.
        uv_left: Pixels in the left image.
        uv_right: Guesses in the right image, within `options.reach` px of the truth; only their columns are used.
        options: Patch size, reach, steps and trust.

    Returns:
        Refined pixels with residual, variance, correlation and trust. The variance is
        `s^2 / (g^2 sum I_u^2)` with s^2 the residual's mean square; add the spread of detector and scene if needed.

    References:
        Subpixel localization drives depth accuracy [T-10]; Baker and Matthews, "Lucas-Kanade 20 years on" (2004).

    Example:
        >>> import jax.numpy as jnp
        >>> u, v = jnp.meshgrid(jnp.arange(60.0), jnp.arange(40.0))
        >>> scene = lambda u: 100 + 50 * jnp.sin(0.5 * u) * jnp.cos(0.4 * v)
        >>> left, right = scene(u), 0.8 * scene(u + 4.3) + 9
        >>> found = refine_stereo(left, right, jnp.array([[30.0, 20.0]]), jnp.array([[25.0, 20.0]]))
        >>> round(float(found.uv[0, 0]), 1), bool(found.ok[0])
        (25.7, True)
    """
    return _refine_stereo(left, right, uv_left, uv_right, options)


def refine_translation(
    previous: Float[Array, "h w"],
    current: Float[Array, "h w"],
    uv_previous: Float[Array, "n 2"],
    uv_current: Float[Array, "n 2"],
    *,
    options: PatchRefinement = PatchRefinement(),  # noqa: B008 (an immutable record)
) -> RefinedPoints:
    """Refines where points of one image are seen in another, as pure translations of their patches.

    Minimizes `sum (I_current(x + d) - g I_previous(x) - b)^2` over both coordinates of d, with gain g and bias b of
    every patch eliminated in closed form (inverse composition). Gradients are those of the solution; the guess has
    none.

    Args:
        previous: First image, gray levels.
        current: Second image.
        uv_previous: Pixels in the first image.
        uv_current: Guesses in the second image, within `options.reach` px of the truth.
        options: Patch size, reach, steps and trust.

    Returns:
        Refined pixels with residual, covariance, correlation and trust. The covariance is `s^2 / g^2 H^-1` with s^2 the
        residual's mean square and H the patch's structure matrix.

    References:
        Baker and Matthews, "Lucas-Kanade 20 years on" (2004), sections 3.2 and 4.

    Example:
        >>> import jax.numpy as jnp
        >>> u, v = jnp.meshgrid(jnp.arange(60.0), jnp.arange(40.0))
        >>> scene = lambda du, dv: 100 + 50 * jnp.sin(0.5 * (u - du)) * jnp.cos(0.4 * (v - dv))
        >>> uv = jnp.array([[30.0, 20.0]])
        >>> found = refine_translation(scene(0.0, 0.0), scene(0.7, -0.4), uv, uv)
        >>> [round(x, 1) for x in found.uv[0].tolist()], bool(found.ok[0])
        ([30.7, 19.6], True)
    """
    return _refine_translation(previous, current, uv_previous, uv_current, options)


@eqx.filter_jit
def _refine_stereo(left, right, uv_left, uv_right, options: PatchRefinement) -> RefinedColumns:
    guess = jnp.stack([uv_right[:, 0], uv_left[:, 1]], axis=1)
    template = _template(left, uv_left, 1, options)
    fit = _fit(right, template, guess, 1, options)
    return RefinedColumns(fit.uv, fit.residual, fit.covariance[0][0], fit.correlation, fit.ok)


@eqx.filter_jit
def _refine_translation(previous, current, uv_previous, uv_current, options: PatchRefinement) -> RefinedPoints:
    template = _template(previous, uv_previous, 2, options)
    fit = _fit(current, template, uv_current, 2, options)
    covariance = jnp.stack([jnp.stack(row, axis=-1) for row in fit.covariance], axis=-2)
    return RefinedPoints(fit.uv, fit.residual, covariance, fit.correlation, fit.ok)


class _Template(eqx.Module):
    """Patches with points along the last, fast axis, and what Gauss-Newton needs of them once."""

    centered: Float[Array, "p q n"]
    energy: Float[Array, " n"]
    slopes: tuple[Float[Array, "p q n"], ...]
    leaks: tuple[Float[Array, " n"], ...]
    inverse: tuple[tuple[Float[Array, " n"], ...], ...]
    kept_noise: Float[Array, " n"]
    ok: Bool[Array, " n"]


class _Fit(eqx.Module):
    uv: Float[Array, "n 2"]
    residual: Float[Array, " n"]
    covariance: tuple[tuple[Float[Array, " n"], ...], ...]
    correlation: Float[Array, " n"]
    ok: Bool[Array, " n"]


def _dot(a: Float[Array, "p q n"], b: Float[Array, "p q n"]) -> Float[Array, " n"]:
    return jnp.sum(a * b, axis=(0, 1))


def _template(image, uv, unknowns: int, options: PatchRefinement) -> _Template:
    """Cuts the patches and projects gain and bias out of their derivatives."""
    patches = extract(image, uv, size=options.size + 2, method=options.method)
    wide = jnp.transpose(patches.values, (1, 2, 0))
    inner = wide[1:-1, 1:-1]
    mean = inner.mean(axis=(0, 1))
    centered = inner - mean[None, None, :]
    energy = _dot(centered, centered)
    # Rounding leaves a flat patch with a little energy, in proportion to its brightness.
    textured = energy > 1e-6 * options.size**2 * (mean * mean + 1e-6)
    energy = jnp.where(textured, energy, 1.0)
    slopes = [0.5 * (wide[1:-1, 2:] - wide[1:-1, :-2]), 0.5 * (wide[2:, 1:-1] - wide[:-2, 1:-1])][:unknowns]
    leaks = [_dot(slope, centered) / energy for slope in slopes]
    slopes = [
        slope - slope.mean(axis=(0, 1))[None, None, :] - leak[None, None, :] * centered
        for slope, leak in zip(slopes, leaks, strict=True)
    ]
    inverse, regular = _inverse([[_dot(a, b) for b in slopes] for a in slopes], energy)
    ok = patches.inside & textured & regular
    return _Template(centered, energy, tuple(slopes), tuple(leaks), inverse, _kept_noise(uv, ok, options), ok)


def _kept_noise(uv, ok, options: PatchRefinement):
    """Share of the pixels' noise variance that interpolation lets through: `sum w^2` along rows times columns."""
    corner = jnp.where(ok[:, None], uv - 0.5 * (options.size - 1), 0.0)
    return jnp.prod(sum(w * w for w in options.method.weights(corner - jnp.floor(corner))), axis=1)


def _inverse(gram, energy):
    """Inverse of a symmetric matrix of one or two rows, and where it is well conditioned; 1 where it is not."""
    if len(gram) == 1:
        regular = gram[0][0] > 1e-5 * energy
        return ((1.0 / jnp.where(regular, gram[0][0], 1.0),),), regular
    (a, b), (_, c) = gram
    determinant = a * c - b * b
    regular = (a + c > 1e-5 * energy) & (determinant > 1e-4 * (a + c) ** 2)
    divisor = jnp.where(regular, determinant, 1.0)
    a, b, c = jnp.where(regular, a, 1.0), jnp.where(regular, b, 0.0), jnp.where(regular, c, 1.0)
    return ((c / divisor, -b / divisor), (-b / divisor, a / divisor)), regular


def _fit(image, template: _Template, guess, unknowns: int, options: PatchRefinement) -> _Fit:
    """Gauss-Newton on all patches at once, a fixed number of steps, and one Newton step that carries the gradient."""
    on_image = inside_image(guess, image.shape)
    guess = jnp.where(on_image[:, None], guess, 0.0)
    windows, base = _windows(image, guess, unknowns, options)
    frozen = lax.stop_gradient((template, windows))

    def advance(_, offset):
        step = jnp.clip(_regress(*frozen, offset, options)[2], -1.0, 1.0)
        return jnp.clip(offset - step, -options.reach, options.reach)

    start = lax.stop_gradient(guess[:, :unknowns] - base[:, :unknowns])
    offset = lax.fori_loop(0, options.num_steps, advance, start)
    # At the solution the step is zero, so that one Newton step has the gradient of the solution (implicit function
    # theorem): the loop need not be differentiated.
    slope = _slope(lambda moved: _regress(*frozen, moved, options)[2], offset)
    step = _regress(template, windows, offset, options)[2]
    offset = offset - jnp.clip(_divide(step, slope), -1.0, 1.0)
    patch, gain, last = _regress(template, windows, offset, options)
    uv = jnp.concatenate([base[:, :unknowns] + offset, guess[:, unknowns:]], axis=1)
    settled = jnp.all((jnp.abs(last) < 0.05) & (jnp.abs(offset) < options.reach), axis=1)
    return _judge(template, patch, gain, uv, guess, settled & on_image & template.ok, image.shape, options)


def _regress(template: _Template, windows, offset, options: PatchRefinement):
    """Regression of the shifted patches on template, bias and slopes: the patches, their gains and steps."""
    patch = _shift(windows, offset, options)
    along = [_dot(slope, patch) for slope in template.slopes]
    steps = [sum(w * x for w, x in zip(row, along, strict=True)) for row in template.inverse]
    gain = _dot(template.centered, patch) / template.energy
    gain = gain - sum(leak * step for leak, step in zip(template.leaks, steps, strict=True))
    # A step divided by a gain near zero would be thrown far away.
    return patch, gain, jnp.stack(steps, axis=1) / jnp.maximum(gain, 0.25)[:, None]


def _slope(step, offset):
    """Derivative of each point's step by its own offset, column by column."""
    unit = jnp.eye(offset.shape[1], dtype=offset.dtype)
    return [jax.jvp(step, (offset,), (jnp.broadcast_to(row[None, :], offset.shape),))[1] for row in unit]


def _divide(step, slope):
    """Solves `slope @ x = step` for each point; where the slope is far from the identity, x is the step itself."""
    if len(slope) == 1:
        (a,) = slope
        return step / jnp.where(a > 0.3, a, 1.0)
    (a, b), (c, d) = ((column[:, 0], column[:, 1]) for column in slope)
    determinant = a * d - b * c
    near = ((a + d > 0.6) & (determinant > 0.1))[:, None]
    solved = jnp.stack([d * step[:, 0] - c * step[:, 1], a * step[:, 1] - b * step[:, 0]], axis=1)
    return jnp.where(near, solved / jnp.where(near, determinant[:, None], 1.0), step)


def _judge(template: _Template, patch, gain, uv, guess, ok, shape, options: PatchRefinement) -> _Fit:
    """Residual, covariance and trust of the final positions."""
    centered = patch - patch.mean(axis=(0, 1))[None, None, :]
    left_over = centered - gain[None, None, :] * template.centered
    squares, energy = _dot(left_over, left_over), _dot(centered, centered)
    pixels, unknowns = options.size**2, len(template.slopes)
    # Interpolated noise is smaller but correlated; on the (smooth) slopes it weighs as much as before interpolation.
    kept = gain * gain * template.kept_noise + _kept_noise(uv, ok, options)
    noise = squares / (pixels - 2 - unknowns) * (1.0 + gain * gain) / jnp.maximum(kept, 0.05)
    scale = energy * template.energy
    correlation = _dot(centered, template.centered) / jnp.sqrt(jnp.where(scale > 0, scale, 1.0))
    half = 0.5 * (options.size - 1)
    inside = inside_image(uv - half, shape) & inside_image(uv + half, shape)
    ok = ok & inside & (gain > 0.25) & (gain < 4.0) & (correlation >= options.min_correlation)
    weight = noise / jnp.where(ok, gain * gain, 1.0)
    floor = options.least_sigma**2
    covariance = tuple(
        tuple(jnp.where(ok, weight * w + floor * (i == j), float(i == j)) for j, w in enumerate(row))
        for i, row in enumerate(template.inverse)
    )
    # The root of a perfect match's zero has no gradient; zero is taken there.
    some = ok & (squares > 0)
    residual = jnp.where(some, jnp.sqrt(jnp.where(some, squares / pixels, 1.0)), 0.0)
    uv = jnp.where(ok[:, None], uv, guess)
    return _Fit(uv, residual, covariance, jnp.where(ok, correlation, 0.0), ok)


def _windows(image, guess, unknowns: int, options: PatchRefinement):
    """Slices with room to move, points last, and the pixel about which each can move."""
    method, half, reach = options.method, options.size // 2, options.reach
    margin = half + reach + method.taps
    padded = jnp.pad(image, margin, mode="edge")
    room = 2 * reach + method.taps - 1
    column = jnp.round(guess[:, 0])
    row = jnp.round(guess[:, 1]) if unknowns == 2 else jnp.floor(guess[:, 1])
    base = jnp.stack([column, row], axis=1)
    back = jnp.array([half + reach, half + (reach if unknowns == 2 else 0)], dtype=jnp.int32) - method.first
    corner = base.astype(jnp.int32) - back[None, :] + margin
    rows = options.size + (room if unknowns == 2 else method.taps - 1)
    windows = jnp.transpose(slice_windows(padded, corner, (rows, options.size + room)), (1, 2, 0))
    if unknowns == 1:
        weights = method.weights((guess[:, 1] - row).astype(image.dtype))
        windows = sum(w[None, None, :] * windows[k : k + options.size] for k, w in enumerate(weights))
    return windows, base


def _shift(windows, offset, options: PatchRefinement):
    """Patches at `offset` from the windows' centers: slices that do not move, with weights that do."""
    if offset.shape[1] == 2:
        weights = _moving_weights(offset[:, 1], options)
        windows = sum(w[None, None, :] * windows[k : k + options.size] for k, w in enumerate(weights))
    weights = _moving_weights(offset[:, 0], options)
    return sum(w[None, None, :] * windows[:, k : k + options.size] for k, w in enumerate(weights))


def _moving_weights(offset, options: PatchRefinement):
    """Weights of all pixels that a patch may need within reach; only `taps` of them are not zero."""
    whole = jnp.floor(offset)
    near = options.method.weights(offset - whole)
    start = whole.astype(jnp.int32) + options.reach
    count = 2 * options.reach + options.method.taps
    return [sum(jnp.where(start == k - tap, weight, 0.0) for tap, weight in enumerate(near)) for k in range(count)]
