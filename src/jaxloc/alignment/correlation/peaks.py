"""Peaks of a score surface: subpixel positions, curvature, and ratio of the two highest."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxloc._jit import filter_jit


class Peaks(eqx.Module):
    """The highest local maxima of a surface, the highest first.

    Attributes:
        uv: positions (right, down) on the surface, between its pixels; the pixel itself where not sharp.
        scores: heights, of the fitted parabola where sharp.
        valid: False in slots that no peak fills; these are zero.
        sharp: True where the peak lies inside the border and the Hessian is negative definite.
    """

    uv: Float[Array, "n 2"]
    scores: Float[Array, " n"]
    valid: Bool[Array, " n"]
    sharp: Bool[Array, " n"]

    @property
    def ratio(self) -> Float[Array, ""]:
        """Ratio of the second height to the first: near 1 the choice is ambiguous; 0 if there is one peak only."""
        if self.scores.shape[0] < 2:
            return jnp.zeros((), self.scores.dtype)
        known = self.valid[1] & (jnp.abs(self.scores[0]) > 0)
        return jnp.where(known, self.scores[1] / jnp.where(known, self.scores[0], 1.0), 0.0)


class Parabola(eqx.Module):
    """Quadratic model of a surface at a pixel.

    Attributes:
        offset: of its extremum from the pixel (right, down), zero where not sharp.
        height: there.
        hessian: its second derivatives.
        sharp: True if it is a maximum less than a pixel away.
    """

    offset: Float[Array, "2"]
    height: Float[Array, ""]
    hessian: Float[Array, "2 2"]
    sharp: Bool[Array, ""]


def fit_parabola(patch: Float[Array, "3 3"]) -> Parabola:
    """Fits ``s(d) = s(0) + g.d + d.H.d / 2`` by central differences and finds its maximum ``d = -H^-1 g``.

    Args:
        patch: a surface around one of its pixels.

    Returns:
        Extremum, height, Hessian and whether it is a maximum.

    References:
        Subpixel peaks [K-26].

    Example:
        >>> import jax.numpy as jnp
        >>> v, u = jnp.meshgrid(jnp.arange(-1.0, 2.0), jnp.arange(-1.0, 2.0), indexing="ij")
        >>> fit = fit_parabola(3.0 - (u - 0.25) ** 2 - (v + 0.125) ** 2)
        >>> fit.offset.tolist(), float(fit.height), bool(fit.sharp)
        ([0.25, -0.125], 3.0, True)
    """
    finite = jnp.all(jnp.isfinite(patch))
    patch = jnp.where(finite, patch, 0.0)
    center = patch[1, 1]
    slope = 0.5 * jnp.stack([patch[1, 2] - patch[1, 0], patch[2, 1] - patch[0, 1]])
    a = patch[1, 2] + patch[1, 0] - 2.0 * center
    c = patch[2, 1] + patch[0, 1] - 2.0 * center
    b = 0.25 * (patch[2, 2] + patch[0, 0] - patch[2, 0] - patch[0, 2])
    determinant = a * c - b * b
    rounding = 8.0 * float(jnp.finfo(patch.dtype).eps) * jnp.max(jnp.abs(patch))
    curved = finite & (a < -rounding) & (c < -rounding) & (determinant > 1e-3 * a * c)
    a, b, c = jnp.where(curved, a, -1.0), jnp.where(curved, b, 0.0), jnp.where(curved, c, -1.0)
    divisor = jnp.where(curved, determinant, 1.0)
    step = jnp.stack([b * slope[1] - c * slope[0], b * slope[0] - a * slope[1]]) / divisor
    sharp = curved & jnp.all(jnp.abs(step) < 1.0)
    offset = jnp.where(sharp, step, 0.0)
    hessian = jnp.stack([jnp.stack([a, b]), jnp.stack([b, c])])
    return Parabola(offset, center + 0.5 * jnp.sum(slope * offset), hessian, sharp)


def fit_parabola_at(surface: Float[Array, "p q"], row: Int[Array, ""], column: Int[Array, ""]) -> Parabola:
    """The quadratic model at a pixel of a surface; not sharp on the border.

    Example:
        >>> import jax.numpy as jnp
        >>> bool(fit_parabola_at(jnp.eye(4), jnp.array(0), jnp.array(0)).sharp)
        False
    """
    rows, columns = surface.shape
    padded = jnp.pad(surface, 1, mode="edge")
    fit = fit_parabola(lax.dynamic_slice(padded, (row, column), (3, 3)))
    inside = (row > 0) & (row < rows - 1) & (column > 0) & (column < columns - 1)
    center = surface[row, column]
    offset = jnp.where(inside, fit.offset, 0.0)
    return Parabola(offset, jnp.where(inside, fit.height, center), fit.hessian, fit.sharp & inside)


@filter_jit
def find_peaks(surface: Float[Array, "p q"], *, count: int = 4, separation: int = 3) -> Peaks:
    """Highest local maxima with a least distance from each other (non-maximum suppression).

    A pixel is a candidate if none of its eight neighbors is higher. The highest is kept, the square of ``separation``
    pixels to all sides is removed, and so on. Positions and heights are those of parabolas, differentiable in the
    surface.

    Args:
        surface: scores, higher is better (negate distances); non-finite pixels are no candidates.
        count: static number of slots.
        separation: least distance of two peaks along rows or columns, px.

    Returns:
        Peaks with positions on the surface, heights, `valid`, `sharp` and the ratio of the two highest.

    Raises:
        ValueError: count or separation is below one.

    References:
        Exhaustive search reports all peaks [K-26, K-93].

    Example:
        >>> import jax.numpy as jnp
        >>> surface = jnp.zeros((9, 9)).at[2, 3].set(5.0).at[2, 4].set(4.0).at[7, 7].set(2.0)
        >>> peaks = find_peaks(surface, count=2, separation=2)
        >>> peaks.uv.round().tolist(), round(float(peaks.scores[1]), 1)
        ([[3.0, 2.0], [7.0, 7.0]], 2.0)
    """
    if count < 1 or separation < 1:
        raise ValueError(f"find_peaks: count {count} and separation {separation} have to be at least 1.")
    if not surface.size:
        raise ValueError(f"find_peaks: a surface of shape {surface.shape} holds no value.")
    finite = jnp.isfinite(surface)
    safe = jnp.where(finite, surface, 0.0)
    left = _candidates(lax.stop_gradient(safe), finite)

    def select(left: Array, _: None) -> tuple[Array, tuple[Array, Array]]:
        index = jnp.argmax(left)
        row, column = index // surface.shape[1], index % surface.shape[1]
        return _suppress(left, row, column, separation), (index, left.reshape(-1)[index] > -jnp.inf)

    _, (index, valid) = lax.scan(select, left, None, length=count)
    row, column = index // surface.shape[1], index % surface.shape[1]
    fits = jax.vmap(lambda r, c: fit_parabola_at(safe, r, c))(row, column)
    uv = jnp.stack([column, row], axis=1).astype(surface.dtype) + fits.offset
    scores = jnp.where(valid, fits.height, 0.0)
    return Peaks(jnp.where(valid[:, None], uv, 0.0), scores, valid, fits.sharp & valid)


def _candidates(surface: Float[Array, "p q"], finite: Bool[Array, "p q"]) -> Float[Array, "p q"]:
    """The local maxima; minus infinity elsewhere."""
    surface = jnp.where(finite, surface, -jnp.inf)
    padded = jnp.pad(surface, ((1, 1), (0, 0)), constant_values=-jnp.inf)
    highest = jnp.maximum(jnp.maximum(padded[:-2], padded[1:-1]), padded[2:])
    padded = jnp.pad(highest, ((0, 0), (1, 1)), constant_values=-jnp.inf)
    highest = jnp.maximum(jnp.maximum(padded[:, :-2], padded[:, 1:-1]), padded[:, 2:])
    return jnp.where(surface >= highest, surface, -jnp.inf)


def _suppress(left: Array, row: Array, column: Array, reach: int) -> Array:
    rows = jnp.abs(jnp.arange(left.shape[0]) - row) <= reach
    columns = jnp.abs(jnp.arange(left.shape[1]) - column) <= reach
    return jnp.where(rows[:, None] & columns[None, :], -jnp.inf, left)
