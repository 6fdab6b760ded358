"""Scanline profiles: a straightened view of the road summed along the road."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxloc._jit import filter_jit
from jaxloc.images.interpolation import Bicubic
from jaxloc.lanes.ground_view import GroundView
from jaxloc.lanes.lane import Lane
from jaxloc.poses.lie_group import as_floats

_FEWEST = 0.4  # share of the positions of a row that must be seen for it to count; at a tenth more it counts in full


class LaneFit(eqx.Module):
    """Parameters of the search and the fit: a lane of constant curvature, and the camera's pitch.

    Args:
        offset: how far the vehicle is left of the lane's center, m.
        heading: of the vehicle against the lane, counter-clockwise, rad.
        curvature: of the lane, positive to the left, 1/m.
        pitch: pitch of the camera relative to that of the view, positive down, rad.
    """

    offset: Float[Array, ""]
    heading: Float[Array, ""]
    curvature: Float[Array, ""]
    pitch: Float[Array, ""]

    def __init__(self, offset: Any = 0.0, heading: Any = 0.0, curvature: Any = 0.0, pitch: Any = 0.0):
        self.offset, self.heading, self.curvature, self.pitch = as_floats(offset, heading, curvature, pitch)

    def lane(self) -> Lane:
        """The lane alone."""
        return Lane(self.offset, self.heading, self.curvature)


class Straightened(eqx.Module):
    """A view in coordinates of the lane: each row brought to zero mean and unit variance.

    Attributes:
        values: normalized gray levels; row by range, column by lateral position in the lane; zero where not seen.
        weight: 1 where visible, 0 where not, with a ramp between for continuity as a lane moves; 0 in a
            row with too few visible samples, or with a single gray level.
    """

    values: Float[Array, "rows columns"]
    weight: Float[Array, "rows columns"]

    def profile(self, rows: Float[Array, " rows"] | None = None) -> "Profile":
        """The scanline profile: the mean of the rows, which may have weights of their own [K-32, K-39]."""
        share = self.weight if rows is None else self.weight * rows[:, None]
        count = jnp.sum(share, axis=0)
        known = count > 0.0
        values = jnp.sum(share * self.values, axis=0) / jnp.where(known, count, 1.0)
        return Profile(jnp.where(known, values, 0.0), known)


class Profile(eqx.Module):
    """Normalized gray levels across the road.

    Attributes:
        values: by lateral position, from left to right; zero where unknown.
        known: where they are known.
    """

    values: Float[Array, " columns"]
    known: Bool[Array, " columns"]


def straighten(view: GroundView, fit: LaneFit, left: Float[Array, " columns"]) -> Straightened:
    """Shifts every row of a view so that the lane becomes straight, and takes the gain and bias of each row out.

    Args:
        view: the road from above.
        fit: lane and correction of the pitch.
        left: lateral positions in the lane, m to the left of its center.

    Returns:
        The rows, differentiable in view and fit.
    """
    values, weight = shift_rows(view, fit, left)
    return normalize_rows(values, weight)


def shift_rows(
    view: GroundView, fit: LaneFit, left: Float[Array, " columns"]
) -> tuple[Float[Array, "rows columns"], Float[Array, "rows columns"]]:
    """Gray levels of a view at lateral positions in the lane (cubic along rows), and weights of visible samples."""
    ahead, scale = view.true_range(fit.pitch)
    center = fit.lane().center(ahead)
    column = view.grid.column((left[None, :] + center[:, None]) / scale[:, None])
    size = view.image.shape[1]
    # An infinite or undefined place is one outside.
    inside = (column >= 1.0) & (column < size - 2.0)
    column = jnp.where(inside, column, 1.0)
    first = jnp.floor(jax.lax.stop_gradient(column)).astype(jnp.int32)
    fraction = column - first.astype(column.dtype)
    start = jnp.arange(view.image.shape[0], dtype=jnp.int32)[:, None] * size + first
    flat, safe = view.image.ravel(), _safe_columns(view.seen).astype(column.dtype).ravel()
    taps = enumerate(Bicubic().weights(fraction), start=-1)
    values = sum(w * flat.at[start + i].get(mode="promise_in_bounds") for i, w in taps)
    before, after = (safe.at[start + i].get(mode="promise_in_bounds") for i in (0, 1))
    weight = jnp.where(inside, (1.0 - fraction) * before + fraction * after, 0.0)
    return jnp.where(weight > 0.0, values, 0.0), weight


def _safe_columns(seen: Bool[Array, "rows columns"]) -> Bool[Array, "rows columns"]:
    """Positions two columns within what is seen: the support of cubic interpolation."""
    padded = jnp.pad(seen, ((0, 0), (2, 2)))
    return jnp.all(jnp.stack([padded[:, i : i + seen.shape[1]] for i in range(5)]), axis=0)


def normalize_rows(values: Float[Array, "rows columns"], weight: Float[Array, "rows columns"]) -> Straightened:
    """Rows normalized to zero mean and unit variance over visible samples, which cancels shadows across the road."""
    count = jnp.sum(weight, axis=1, keepdims=True)
    some = jnp.maximum(count, 1.0)
    centered = values - jnp.sum(weight * values, axis=1, keepdims=True) / some
    variance = jnp.sum(weight * centered**2, axis=1, keepdims=True) / some
    varied = variance > 1e-4
    gain = jax.lax.rsqrt(jnp.where(varied, variance, 1.0))
    enough = jnp.clip(10.0 * (count / values.shape[1] - _FEWEST), 0.0, 1.0)
    weight = jnp.where(varied, weight * enough, 0.0)
    return Straightened(jnp.where(weight > 0.0, centered * gain, 0.0), weight)


class Sharpness(eqx.Module):
    """Straightness score of a straightened view (strategy): a sharper profile is straighter [K-37]."""

    @abstractmethod
    def score(self, profile: Profile) -> Float[Array, ""]:
        """The higher, the straighter."""


class AbsoluteSteps(Sharpness):
    """The measure of the RALPH paper: the sum of absolute differences of neighbors, ``sum |P[i+1] - P[i]|``."""

    def score(self, profile: Profile) -> Float[Array, ""]:
        """The higher, the straighter."""
        return jnp.sum(jnp.abs(_steps(profile)))


class SmoothSteps(Sharpness):
    """A measure with derivatives everywhere: ``sum (sqrt(d^2 + e^2) - e)`` over differences ``d`` of neighbors.

    Args:
        edge: e, the difference below which a step counts by its square.
    """

    edge: Float[Array, ""]

    def __init__(self, edge: Any = 0.05):
        (self.edge,) = as_floats(edge)

    def score(self, profile: Profile) -> Float[Array, ""]:
        """The higher, the straighter."""
        edge = self.edge.astype(profile.values.dtype)
        return jnp.sum(jnp.sqrt(_steps(profile) ** 2 + edge**2) - edge)


def _steps(profile: Profile) -> Float[Array, " c"]:
    both = profile.known[1:] & profile.known[:-1]
    return jnp.where(both, profile.values[1:] - profile.values[:-1], 0.0)


@filter_jit
def straightness(view: GroundView, fit: LaneFit, *, sharpness: Sharpness = AbsoluteSteps()) -> Float[Array, ""]:
    """Straightness of the road under one hypothesis; for many, use ``jax.vmap`` [K-36], [K-37].

    Args:
        view: the road from above.
        fit: hypothesis; its offset moves the profile and changes its sharpness little.
        sharpness: measure of the summed profile.

    References:
        D. Pomerleau, "RALPH: rapidly adapting lateral position handler", Intelligent Vehicles 1995.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> ralph, grid = jl.lanes.ralph, jl.lanes.ground_view.GroundGrid.between(5.0, 50.0, 8.0)
        >>> y = grid.left[None, :] - 0.5 * 0.001 * grid.ahead[:, None] ** 2
        >>> bent = jl.lanes.ground_view.GroundView(100.0 * jnp.exp(-4.0 * y**2), y < 9.0, grid, jnp.array(1.3))
        >>> scores = [ralph.straightness(bent, ralph.LaneFit(curvature=c)) for c in (0.0, 0.001, 0.002)]
        >>> bool(scores[0] < scores[1] > scores[2])
        True
    """
    return sharpness.score(straighten(view, fit, view.grid.left).profile())
