"""Template matching: exhaustive search of a window with subpixel refinement and covariance.

It needs no initial value [K-24, K-26, K-93].
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Num

from jaxloc._jit import filter_jit
from jaxloc.alignment.correlation.peaks import find_peaks, fit_parabola_at
from jaxloc.alignment.correlation.scores import (
    Correlator,
    Direct,
    Fourier,
    Pair,
    Score,
    ZeroMeanCorrelation,
    unknown_places,
)
from jaxloc.alignment.correlation.shift import STEPS, refine_shift
from jaxloc.beliefs.validity import positive
from jaxloc.images.normalization import as_gray
from jaxloc.images.warps import Translation
from jaxloc.solvers import Estimate, Status
from jaxloc.solvers.estimate import guarded

_DIRECT_UP_TO = 32 * 32  # template pixels, above which Fourier transforms are faster


class Window(eqx.Module):
    """Search window: a part of an image.

    Attributes:
        corner: its first pixel (right, down), rounded; a window that exceeds the image is moved into it.
        size: static (rows, columns).
    """

    corner: Float[Array, "2"]
    size: tuple[int, int] = eqx.field(static=True)

    @staticmethod
    def around(prediction: Translation, template_shape: tuple[int, int], *, reach: int) -> "Window":
        """The window for a template within `reach` px of its predicted position.

        Example:
            >>> import jax.numpy as jnp, jaxloc as jl
            >>> Window.around(jl.images.Translation(jnp.array([9.0, 8.0])), (5, 7), reach=2).size
            (9, 11)
        """
        rows, columns = template_shape
        return Window(jnp.round(prediction.translation) - reach, (rows + 2 * reach, columns + 2 * reach))


def score_map(
    image: Num[Array, "h w"] | Any,
    template: Num[Array, "m n"] | Any,
    *,
    score: Score = ZeroMeanCorrelation(),
    by: Correlator | None = None,
    mask: Num[Array, "m n"] | Bool[Array, "m n"] | None = None,
) -> Float[Array, "p q"]:
    """Scores a template at every position of an image: ``s[v, u]`` compares ``template(x)`` with ``image(x + (u, v))``.

    Args:
        image: gray levels; positions that cover a non-finite pixel get the worst score.
        template: gray levels, no larger than the image.
        score: `SumOfSquares`, `NormalizedCorrelation` or `ZeroMeanCorrelation`.
        by: `Direct` or `Fourier`; by default the faster one for the template's size.
        mask: weights of the template's pixels, in [0, 1]; non-finite pixels get weight zero. Without a
            mask, they have the template's mean.

    Returns:
        The surface, of shape (h - m + 1, w - n + 1): `cv2.matchTemplate` with the same measure.

    Raises:
        ValueError: the template is larger than the image, or the mask has another shape.

    References:
        Correlation over a window [K-24]; invariance to brightness and contrast [K-22].

    Example:
        >>> import jax, jax.numpy as jnp
        >>> image = jax.random.uniform(jax.random.key(0), (40, 50))
        >>> surface = score_map(0.5 * image + 3.0, image[7:19, 11:23])
        >>> [int(i) for i in jnp.unravel_index(jnp.argmax(surface), surface.shape)], round(float(surface.max()), 3)
        ([7, 11], 1.0)
    """
    return _score_map(*_validate(image, template, mask, by), score)


def search(
    image: Num[Array, "h w"] | Any,
    template: Num[Array, "m n"] | Any,
    window: Window | None = None,
    *,
    score: Score = ZeroMeanCorrelation(),
    by: Correlator | None = None,
    mask: Num[Array, "m n"] | Bool[Array, "m n"] | None = None,
    sigma: Any = None,
    max_ratio: float = 0.8,
) -> Estimate:
    """Finds the shift t with ``image(x + t) ~ template(x)`` by exhaustive search and least-squares refinement.

    All whole shifts are scored; the best is refined from the vertex of its quadratic model by least squares,
    with the gain and bias to which the score is invariant; the value has the derivatives of the solution. Covariance:
    ``sigma^2 / gain^2 H^-1`` with ``H = sum [T_u T_v]^T [T_u T_v]``, half the Hessian of the sum of squares at the
    peak, brightness projected out; (0.01 px)^2 is added for interpolation.

    Args:
        image: gray levels.
        template: gray levels.
        window: the part of the image to search; all of it by default.
        score: `SumOfSquares`, `NormalizedCorrelation` or `ZeroMeanCorrelation`.
        by: `Direct` or `Fourier`; by default the faster one for the template's size.
        mask: weights of the template's pixels.
        sigma: standard deviation of the image's noise, gray levels; estimated from the residual if not given.
        max_ratio: threshold of ambiguity: greatest ratio of the best peak's misfit (sum of squares, or 1 - correlation)
            to that of the second peak.

    Returns:
        Estimate of a `Translation` from template to image pixels. `cost` is the misfit at the peak. `ok` is False
        for a flat template, a peak on the border of the window or without curvature (RANK_DEFICIENT), and an ambiguous
        one (INADMISSIBLE); the value is finite in any case.

    Raises:
        ValueError: the template is larger than the window or the window than the image, or the mask has another shape.

    References:
        [K-23, K-24, K-26].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> u, v = jnp.meshgrid(jnp.arange(60.0), jnp.arange(50.0))
        >>> scene = lambda u, v: 100 + 90 * jnp.exp(-((u - 30) ** 2 + (v - 25) ** 2 + 0.5 * u * v) / 300)
        >>> found = search(0.7 * scene(u, v) + 20, scene(u + 12.3, v + 9.6)[:32, :32])
        >>> bool(found.ok), [round(x, 1) for x in found.value.translation.tolist()]
        (True, [12.3, 9.6])
    """
    pair, finite = _validate(image, template, mask, by)
    if window is not None and any(n > m for n, m in zip(window.size, pair.image.shape, strict=True)):
        raise ValueError(f"search: a window of {window.size} does not fit an image of shape {pair.image.shape}.")
    if window is not None and any(n > m for n, m in zip(pair.template.shape, window.size, strict=True)):
        raise ValueError(f"search: a template of shape {pair.template.shape} does not fit a window of {window.size}.")
    sigma = None if sigma is None else jnp.asarray(sigma, pair.image.dtype)
    usable = jnp.array(True) if sigma is None else positive(sigma)
    return _search(usable, pair, finite, window, score, sigma, max_ratio)


def _validate(image: Any, template: Any, mask: Any, by: Correlator | None) -> tuple[Pair, Bool[Array, "h w"]]:
    """Finite floats of one dtype, and the mask of finite pixels."""
    template = as_gray(template)
    image = as_gray(image, template.dtype)
    if any(n > m for n, m in zip(template.shape, image.shape, strict=True)):
        raise ValueError(f"A template of shape {template.shape} is larger than the image of shape {image.shape}.")
    if mask is not None and mask.shape != template.shape:
        raise ValueError(f"A mask of shape {mask.shape} does not fit a template of shape {template.shape}.")
    if by is None:
        by = Direct() if template.size <= _DIRECT_UP_TO else Fourier()
    known, finite = jnp.isfinite(template), jnp.isfinite(image)
    mask = None if mask is None else jnp.where(known, jnp.asarray(mask).astype(template.dtype), 0.0)
    return Pair(_filled(image, finite), _filled(template, known), mask, by), finite


def _filled(image: Array, known: Array) -> Array:
    """Replaces unknown pixels by the mean."""
    count = jnp.maximum(jnp.sum(known), 1).astype(image.dtype)
    return jnp.where(known, image, jnp.sum(jnp.where(known, image, 0.0)) / count)


@filter_jit
def _score_map(pair: Pair, finite: Bool[Array, "h w"], score: Score) -> Float[Array, "p q"]:
    surface = score.surface(pair)
    return jnp.where(unknown_places(finite, pair.template.shape), score.worst(pair), surface)


@filter_jit
def _search(usable: Array, *given: Any) -> Estimate:
    return guarded(usable, _locate, *given)


def _locate(pair: Pair, finite: Array, window: Window | None, score: Score, sigma: Any, max_ratio: float) -> Estimate:
    corner, known = jnp.zeros(2, pair.image.dtype), jnp.asarray(True)
    if window is not None:
        pair, finite, corner, known = _cut(pair, finite, window)
    surface = _score_map(pair, finite, score)
    heights = -surface if score.best_is_least else surface
    peaks = find_peaks(lax.stop_gradient(heights), count=2, separation=max(2, min(pair.template.shape) // 4))
    index = jnp.argmax(heights)
    row, column = index // surface.shape[1], index % surface.shape[1]
    fit = fit_parabola_at(heights, row, column)
    peak = jnp.stack([column, row]).astype(corner.dtype)
    shift = refine_shift(pair, score, peak, peak + fit.offset, sigma)
    misfit = _misfit(fit.height, score)
    ambiguous = misfit + _rounding(pair, score) > max_ratio * _misfit(peaks.scores[1], score)
    status = jnp.asarray(int(Status.CONVERGED), jnp.int32)
    for failed, code in (
        (~shift.converged, Status.MAX_STEPS),
        (peaks.valid[1] & ambiguous, Status.INADMISSIBLE),
        (~(fit.sharp & shift.regular), Status.RANK_DEFICIENT),
        (~known, Status.NONFINITE),
    ):
        status = jnp.where(failed, int(code), status)
    steps, value = jnp.asarray(STEPS, jnp.int32), Translation(corner + shift.uv)
    return Estimate(value, shift.covariance, misfit, status == 0, steps, status, shift.information)


def _cut(pair: Pair, finite: Array, window: Window) -> tuple[Pair, Array, Array, Array]:
    """The window's part of the image, its actual corner, and whether the given corner was finite."""
    known = jnp.all(jnp.isfinite(window.corner))
    last = jnp.array([m - n for m, n in zip(pair.image.shape, window.size, strict=True)][::-1])
    wanted = jnp.round(jnp.where(known, lax.stop_gradient(window.corner), 0.0))
    corner = jnp.clip(wanted, 0, last.astype(wanted.dtype)).astype(jnp.int32)
    at = (corner[1], corner[0])
    image = lax.dynamic_slice(pair.image, at, window.size)
    finite = lax.dynamic_slice(finite, at, window.size)
    return Pair(image, pair.template, pair.mask, pair.by), finite, corner.astype(pair.image.dtype), known


def _misfit(height: Array, score: Score) -> Array:
    """Sum of squares, or one minus correlation."""
    return -height if score.best_is_least else 1.0 - height


def _rounding(pair: Pair, score: Score) -> Array:
    """Rounding error of a misfit."""
    scale = jnp.sum(pair.centered(pair.mean()).template ** 2) if score.best_is_least else jnp.ones((), pair.image.dtype)
    return 100.0 * float(jnp.finfo(pair.image.dtype).eps) * scale
