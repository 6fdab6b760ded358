"""Transfer of image noise through interpolation, to the residual and to the solution of an alignment.

Interpolated noise has a smaller variance than that of the pixels and is correlated between neighbors. The residual has
the smaller variance; weighted sums along smooth derivatives include the correlation and have nearly the full variance.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxloc.alignment.lucas_kanade.pyramid_level import Level
from jaxloc.images.interpolation import AbstractInterpolation
from jaxloc.images.warps import Warp

_SAMPLES, _REACH = 48, 2  # sampled pixels a side, and reach of the correlation


class NoiseTransfer(eqx.Module):
    """Ratios of variances to that of the image's noise.

    Attributes:
        residual: of an interpolated pixel.
        solution: of a weighted sum along the template's derivatives, relative to independent pixels.
    """

    residual: Float[Array, ""]
    solution: Float[Array, ""]


def noise_transfer(
    level: Level, warp: Warp, method: AbstractInterpolation, weight: Float[Array, " n"]
) -> NoiseTransfer:
    """Both ratios on a grid of the template's pixels: ``sum_l c(x, l) J(x) J(x + l)`` with the correlations c."""
    rows, columns = level.shape
    reach = min(_REACH, (min(rows, columns) - 1) // 2)
    places = jnp.stack([place.reshape(rows, columns) for place in level.pixels(warp)])
    slopes = (level.slope * weight[None]).reshape(2, rows, columns)
    here = _Shifted.of(places, slopes, (0, 0), reach, method)
    own = here.correlation(here)
    total = 0.0
    for down in range(-reach, reach + 1):
        for right in range(-reach, reach + 1):
            there = _Shifted.of(places, slopes, (down, right), reach, method)
            total = total + jnp.sum(here.correlation(there)[None] * here.slopes * there.slopes)
    energy = jnp.sum(here.slopes * here.slopes)
    textured = energy > 0
    part = jnp.where(textured, total / jnp.where(textured, energy, 1.0), 1.0)
    return NoiseTransfer(jnp.maximum(jnp.mean(own), 0.05), jnp.clip(part, 0.05, 25.0))


class _Shifted(eqx.Module):
    """Pixels of the grid shifted by a lag: interpolated image pixels with their weights, and the template's slopes."""

    columns: Float[Array, "a b"]
    rows: Float[Array, "a b"]
    weights_u: tuple[Float[Array, "a b"], ...]
    weights_v: tuple[Float[Array, "a b"], ...]
    slopes: Float[Array, "2 a b"]

    @staticmethod
    def of(
        places: Float[Array, "2 p q"],
        slopes: Float[Array, "2 p q"],
        lag: tuple[int, int],
        reach: int,
        method: AbstractInterpolation,
    ) -> "_Shifted":
        down, right = (slice(reach + at, size - reach + at) for at, size in zip(lag, places.shape[1:], strict=True))
        step_v, step_u = (max(1, size // _SAMPLES) for size in places.shape[1:])
        u, v = places[:, down, right][:, ::step_v, ::step_u]
        floor_u, floor_v = jnp.floor(u), jnp.floor(v)
        near = slopes[:, down, right][:, ::step_v, ::step_u]
        return _Shifted(floor_u, floor_v, method.weights(u - floor_u), method.weights(v - floor_v), near)

    def correlation(self, other: "_Shifted") -> Float[Array, "a b"]:
        """Sum of products of both interpolation weights over the image's pixels."""
        along = _overlap(self.columns, self.weights_u, other.columns, other.weights_u)
        return along * _overlap(self.rows, self.weights_v, other.rows, other.weights_v)


def _overlap(first: Array, weights: tuple[Array, ...], second: Array, others: tuple[Array, ...]) -> Float[Array, "a b"]:
    offset = second - first
    total = jnp.zeros_like(first)
    for k, weight in enumerate(weights):
        for m, other in enumerate(others):
            total = total + jnp.where(offset == k - m, weight * other, 0.0)
    return total
