"""Subpixel refinement of matched patches: Gauss-Newton with gain and bias, and a covariance for every point."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxloc._jit import filter_jit
from jaxloc.images.interpolation import AbstractInterpolation, Bilinear, inside_image
from jaxloc.images.patches import extract, slice_windows


class RefinedPoints(eqx.Module):
    """Refined positions of matched points in a second image.

    Attributes:
        uv: Refined pixels; the initial value where not ok (zero if that is off the image).
        residual: Root mean square of the gray-level difference after the fit of gain and bias.
        covariance: Of the refined coordinates, px^2: of both (d = 2), or of the column alone (d = 1, stereo).
        correlation: Normalized correlation of both patches, -1 to 1.
        ok: True where the refinement is valid.
    """

    uv: Float[Array, "n 2"]
    residual: Float[Array, " n"]
    covariance: Float[Array, "n d d"]
    correlation: Float[Array, " n"]
    ok: Bool[Array, " n"]

    @property
    def variance(self) -> Array:
        """Variance of the column, px^2."""
        return self.covariance[..., 0, 0]


class PatchRefinement(eqx.Module):
    """Options of the refinement of patches.

    Attributes:
        size: Odd side of a patch, px.
        reach: Greatest correction, px.
        num_steps: Gauss-Newton steps before the last, which is a Newton step.
        min_correlation: Least correlation of a valid result.
        least_sigma: Standard deviation of errors that the residual does not show (interpolation, slant), px.
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
    initial: Float[Array, "n 2"],
    *,
    options: PatchRefinement = PatchRefinement(),  # noqa: B008 (an immutable record)
) -> RefinedPoints:
    """Refines the columns of stereo matches in a rectified pair.

    Minimizes `sum (I_right(x + d) - g I_left(x) - b)^2` over the column of d, with gain g and bias b of every patch
    eliminated in closed form; each step costs one shift of a slice along its row. The derivative is the left patch's
    (inverse composition), so that the normal equations are formed once. Gradients are those of the solution, by the
    implicit function theorem; the initial value has none.

    Args:
        left: Left image, gray levels.
        right: Right image, of the same rectified pair.
        uv_left: Pixels in the left image.
        initial: Pixels in the right image, within `options.reach` px of the truth; only their columns are used.
        options: Patch size, reach, steps and thresholds.

    Returns:
        Refined pixels with the variance of the column, `s^2 / (g^2 sum I_u^2)` with s^2 the residual's mean square; add
        the variance of detector and scene if needed.

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
    return _refine_stereo(left, right, uv_left, initial, options)


def refine_translation(
    previous: Float[Array, "h w"],
    current: Float[Array, "h w"],
    uv_previous: Float[Array, "n 2"],
    initial: Float[Array, "n 2"],
    *,
    options: PatchRefinement = PatchRefinement(),  # noqa: B008 (an immutable record)
) -> RefinedPoints:
    """Refines matches between two images by pure translations of their patches.

    Minimizes `sum (I_current(x + d) - g I_previous(x) - b)^2` over both coordinates of d, with gain g and bias b of
    every patch eliminated in closed form (inverse composition). Gradients are those of the solution; the initial value
    has none.

    Args:
        previous: First image, gray levels.
        current: Second image.
        uv_previous: Pixels in the first image.
        initial: Pixels in the second image, within `options.reach` px of the truth.
        options: Patch size, reach, steps and thresholds.

    Returns:
        Refined pixels with covariance `s^2 / g^2 H^-1`, s^2 the residual's mean square and H the patch's structure
        matrix.

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
    return _refine_translation(previous, current, uv_previous, initial, options)


@filter_jit
def _refine_stereo(left, right, uv_left, initial, options: PatchRefinement) -> RefinedPoints:
    initial = jnp.stack([initial[:, 0], uv_left[:, 1]], axis=1)
    return _fit(right, _template(left, uv_left, 1, options), initial, 1, options)


@filter_jit
def _refine_translation(previous, current, uv_previous, initial, options: PatchRefinement) -> RefinedPoints:
    return _fit(current, _template(previous, uv_previous, 2, options), initial, 2, options)


class _Template(eqx.Module):
    """Patches with points along the last, fast axis, and the constant parts of their normal equations."""

    centered: Float[Array, "p q n"]
    energy: Float[Array, " n"]
    slopes: tuple[Float[Array, "p q n"], ...]
    gain_slopes: tuple[Float[Array, " n"], ...]
    inverse: tuple[tuple[Float[Array, " n"], ...], ...]
    kept_noise: Float[Array, " n"]
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
    # Rounding gives a constant patch a small energy, in proportion to its brightness.
    textured = energy > 1e-6 * options.size**2 * (mean * mean + 1e-6)
    energy = jnp.where(textured, energy, 1.0)
    slopes = [0.5 * (wide[1:-1, 2:] - wide[1:-1, :-2]), 0.5 * (wide[2:, 1:-1] - wide[:-2, 1:-1])][:unknowns]
    gain_slopes = [_dot(slope, centered) / energy for slope in slopes]
    slopes = [
        slope - slope.mean(axis=(0, 1))[None, None, :] - gain_slope[None, None, :] * centered
        for slope, gain_slope in zip(slopes, gain_slopes, strict=True)
    ]
    inverse, regular = _inverse([[_dot(a, b) for b in slopes] for a in slopes], energy)
    ok = patches.inside & textured & regular
    return _Template(centered, energy, tuple(slopes), tuple(gain_slopes), inverse, _kept_noise(uv, ok, options), ok)


def _kept_noise(uv, ok, options: PatchRefinement):
    return options.method.noise_gain(jnp.where(ok[:, None], uv - 0.5 * (options.size - 1), 0.0))


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


def _fit(image, template: _Template, initial, unknowns: int, options: PatchRefinement) -> RefinedPoints:
    """A fixed number of Gauss-Newton steps on all patches at once, and one Newton step that has the derivatives."""
    on_image = inside_image(initial, image.shape)
    initial = jnp.where(on_image[:, None], initial, 0.0)
    windows, base = _windows(image, initial, unknowns, options)
    frozen = lax.stop_gradient((template, windows))

    def advance(_, offset):
        step = jnp.clip(_regress(*frozen, offset, options)[2], -1.0, 1.0)
        return jnp.clip(offset - step, -options.reach, options.reach)

    first = lax.stop_gradient(initial[:, :unknowns] - base[:, :unknowns])
    offset = lax.fori_loop(0, options.num_steps, advance, first)
    inverse, _ = newton_inverse(lambda moved: _regress(*frozen, moved, options)[2], offset)
    step = _regress(template, windows, offset, options)[2]
    offset = offset - jnp.clip(jnp.sum(inverse * step[:, None, :], axis=2), -1.0, 1.0)
    patch, gain, last = _regress(template, windows, offset, options)
    uv = jnp.concatenate([base[:, :unknowns] + offset, initial[:, unknowns:]], axis=1)
    settled = jnp.all((jnp.abs(last) < 0.05) & (jnp.abs(offset) < options.reach), axis=1)
    return _validate(template, patch, gain, uv, initial, settled & on_image & template.ok, image.shape, options)


def _regress(template: _Template, windows, offset, options: PatchRefinement):
    """Regression of the shifted patches on template, bias and slopes: the patches, their gains and steps."""
    patch = _shift(windows, offset, options)
    along = [_dot(slope, patch) for slope in template.slopes]
    steps = [sum(w * x for w, x in zip(row, along, strict=True)) for row in template.inverse]
    gain = _dot(template.centered, patch) / template.energy
    gain = gain - sum(gain_slope * step for gain_slope, step in zip(template.gain_slopes, steps, strict=True))
    # A gain near zero would give a huge step.
    return patch, gain, jnp.stack(steps, axis=1) / jnp.maximum(gain, 0.25)[:, None]


def newton_inverse(
    step: Callable[[Array], Array], offset: Float[Array, "n d"]
) -> tuple[Float[Array, "n d d"], Bool[Array, " n"]]:
    """Inverse derivative of Gauss-Newton steps by the offsets that they correct, for one last Newton step.

    At the solution the step is zero: ``offset - inverse @ step(offset)`` has the derivatives of the solution (implicit
    function theorem), so that the iterations before it need not be differentiated.

    Args:
        step: steps "n d" that are subtracted from the offsets, each a function of its own offset; d is 1 or 2.
        offset: where the iterations ended.

    Returns:
        The inverses, and where the derivatives are near enough to the identity; the identity elsewhere.

    Example:
        >>> import jax.numpy as jnp
        >>> inverse, regular = newton_inverse(lambda x: 2.0 * (x - 3.0), jnp.ones((1, 2)))
        >>> jnp.abs(inverse).tolist(), regular.tolist()
        ([[[0.5, 0.0], [0.0, 0.5]]], [True])
    """
    unit = jnp.eye(offset.shape[1], dtype=offset.dtype)
    columns = [jax.jvp(step, (offset,), (jnp.broadcast_to(row[None, :], offset.shape),))[1] for row in unit]
    if len(columns) == 1:
        regular = columns[0][:, 0] > 0.3
        return 1.0 / jnp.where(regular, columns[0][:, 0], 1.0)[:, None, None], regular
    (a, b), (c, d) = ((column[:, 0], column[:, 1]) for column in columns)
    determinant = a * d - b * c
    regular = (a + d > 0.6) & (determinant > 0.1)
    adjugate = jnp.stack([jnp.stack([d, -c], axis=1), jnp.stack([-b, a], axis=1)], axis=1)
    inverse = adjugate / jnp.where(regular, determinant, 1.0)[:, None, None]
    return jnp.where(regular[:, None, None], inverse, unit[None]), regular


def _validate(template: _Template, patch, gain, uv, initial, ok, shape, options: PatchRefinement) -> RefinedPoints:
    """Residual, covariance and validity of the final positions."""
    centered = patch - patch.mean(axis=(0, 1))[None, None, :]
    difference = centered - gain[None, None, :] * template.centered
    squares, energy = _dot(difference, difference), _dot(centered, centered)
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
    covariance = [
        jnp.stack([jnp.where(ok, weight * w + floor * (i == j), float(i == j)) for j, w in enumerate(row)], axis=1)
        for i, row in enumerate(template.inverse)
    ]
    # The root of a perfect match's zero has no gradient; zero is used there.
    some = ok & (squares > 0)
    residual = jnp.where(some, jnp.sqrt(jnp.where(some, squares / pixels, 1.0)), 0.0)
    uv = jnp.where(ok[:, None], uv, initial)
    return RefinedPoints(uv, residual, jnp.stack(covariance, axis=1), jnp.where(ok, correlation, 0.0), ok)


def _windows(image, initial, unknowns: int, options: PatchRefinement):
    """Slices with a margin for the search, points last, and the pixel in the middle of each."""
    method, half, reach = options.method, options.size // 2, options.reach
    margin = half + reach + method.taps
    padded = jnp.pad(image, margin, mode="edge")
    extent = 2 * reach + method.taps - 1
    column = jnp.round(initial[:, 0])
    row = jnp.round(initial[:, 1]) if unknowns == 2 else jnp.floor(initial[:, 1])
    base = jnp.stack([column, row], axis=1)
    back = jnp.array([half + reach, half + (reach if unknowns == 2 else 0)], dtype=jnp.int32) - method.first
    corner = base.astype(jnp.int32) - back[None, :] + margin
    rows = options.size + (extent if unknowns == 2 else method.taps - 1)
    windows = jnp.transpose(slice_windows(padded, corner, (rows, options.size + extent)), (1, 2, 0))
    if unknowns == 1:
        weights = method.weights((initial[:, 1] - row).astype(image.dtype))
        windows = sum(w[None, None, :] * windows[k : k + options.size] for k, w in enumerate(weights))
    return windows, base


def _shift(windows, offset, options: PatchRefinement):
    """Patches at `offset` from the windows' centers: fixed slices with weights that depend on the offset."""
    if offset.shape[1] == 2:
        weights = _moving_weights(offset[:, 1], options)
        windows = sum(w[None, None, :] * windows[k : k + options.size] for k, w in enumerate(weights))
    weights = _moving_weights(offset[:, 0], options)
    return sum(w[None, None, :] * windows[:, k : k + options.size] for k, w in enumerate(weights))


def _moving_weights(offset, options: PatchRefinement):
    """Weights of all pixels that a patch may need within reach; only `taps` of them are not zero."""
    whole = jnp.floor(offset)
    near = options.method.weights(offset - whole)
    index = whole.astype(jnp.int32) + options.reach
    count = 2 * options.reach + options.method.taps
    return [sum(jnp.where(index == k - tap, weight, 0.0) for tap, weight in enumerate(near)) for k in range(count)]
