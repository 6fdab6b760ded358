"""Detection of a pallet in an image, and its pose [K-14].

At each of several ranges, four edges of fork holes are selected by polarity and by the ratio of hole width to
separation, a pose is fitted to them, and the image is correlated with the front of each kind there. The edges of the
best candidate are measured again, each in its own rows, before the final pose.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int, Num

from jaxloc._arguments import checked
from jaxloc._jit import filter_jit
from jaxloc.poses import SE2
from jaxloc.refinement.pallet.edges import (
    LevelView,
    band_profile,
    best_candidate,
    edges_along,
    hole_band,
    level_view,
    summed,
)
from jaxloc.refinement.pallet.kinds import stack_types, type_correlation
from jaxloc.refinement.pallet.model import PalletType, pose_from_edges
from jaxloc.sensors import GroundCamera
from jaxloc.solvers import Estimate, Status
from jaxloc.solvers.estimate import guarded


class PalletSearch(eqx.Module):
    """Options of pallet detection.

    Attributes:
        nearest: range, m; static.
        farthest: range, m; static.
        ranges: number of ranges, evenly spaced in their inverse; static.
        edges: candidates of each polarity at a range; static.
        sigma: standard deviation of errors of edges beside their scatter, px: damaged wood, a camera not quite level.
        tolerance: greatest residual of four edges, px.
        least_strength: of an edge, gray levels a pixel.
        least_correlation: with the front of the kind.
    """

    nearest: float = eqx.field(static=True, default=0.8)
    farthest: float = eqx.field(static=True, default=5.0)
    ranges: int = eqx.field(static=True, default=32)
    edges: int = eqx.field(static=True, default=6)
    sigma: float = 0.01
    tolerance: float = 0.5
    least_strength: float = 2.0
    least_correlation: float = 0.7


class FoundPallet(eqx.Module):
    """Result of `detect_pallet`.

    Attributes:
        estimate: of ``T_ground_pallet``; ``ok`` is False where no pallet of the given kinds was found.
        kind: index of the kind that fits best.
        correlation: of the image with the front of each kind, each at the pose that fits it best.
        columns: of the four edges in the level view, px.
    """

    estimate: Estimate
    kind: Int[Array, ""]
    correlation: Float[Array, " m"]
    columns: Float[Array, "4"]


class _Proposal(eqx.Module):
    """The best pose of one kind."""

    pose: SE2
    columns: Float[Array, "4"]
    correlation: Float[Array, ""]


@filter_jit
@checked
def find_pallet(
    image: Num[Array, "h w"],
    camera: GroundCamera,
    types: tuple[PalletType, ...],
    *,
    search: PalletSearch = PalletSearch(),
) -> Estimate:
    """Pose of a pallet in an image.

    Args:
        image: gray levels of any dtype.
        camera: lens, height, pitch and roll.
        types: kinds of pallets.
        search: options.

    Returns:
        Estimate of the pose ``T_ground_pallet`` of the middle of its face on the ground: x forward, y left of the
        camera's foot, heading of the way forks go in. ``ok`` is False when there is no pallet of these kinds, or when
        detection is not certain. Derivatives by the image are those of the four edges that were found.

    Raises:
        ValueError: no types.

    References:
        KELLY 9.2.1.2.5 and 9.2.4.2.2 [K-14, K-74, K-75, K-76].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> from jaxloc.refinement.pallet import euro_long, find_pallet
        >>> camera = jl.sensors.GroundCamera(jl.sensors.Pinhole(60.0, 60.0, 39.5, 29.5), 0.5)
        >>> bool(find_pallet(jnp.zeros((60, 80)), camera, (euro_long(),)).ok)
        False
    """
    return detect_pallet(image, camera, types, search=search).estimate


@filter_jit
@checked
def detect_pallet(
    image: Num[Array, "h w"],
    camera: GroundCamera,
    types: tuple[PalletType, ...],
    *,
    search: PalletSearch = PalletSearch(),
) -> FoundPallet:
    """Detection of a pallet: pose, kind, correlations and edges.

    Args:
        image: gray levels of any dtype.
        camera: of the image.
        types: kinds of pallets.
        search: options.

    Returns:
        The result.

    Raises:
        ValueError: no types.
    """
    return guarded(jnp.array(True), _detect, image, camera, stack_types(types), search)


def _detect(image: Array, camera: GroundCamera, kinds: PalletType, search: PalletSearch) -> FoundPallet:
    view = level_view(image, camera)
    sums = summed(view.slope)
    fixed = lax.stop_gradient((view, sums))
    proposals = jax.vmap(lambda kind: _propose(*fixed, kind, search))(kinds)
    best = jnp.argmax(proposals.correlation)
    kind, proposal = (jax.tree.map(lambda leaf: leaf[best], tree) for tree in (kinds, proposals))
    edges = edges_along(view, sums, kind, proposal.columns, _distances(proposal.pose, kind))
    sigma = jnp.sqrt(edges.sigma**2 + search.sigma**2)
    estimate = _fit(view, kind, edges.columns, edges.strength > 0, sigma)
    correlation = type_correlation(lax.stop_gradient(view), kind, lax.stop_gradient(estimate.value))
    good = (correlation > search.least_correlation) & (edges.strength > search.least_strength)
    good = good & (jnp.sqrt(2.0 * estimate.cost) * sigma < search.tolerance)
    return FoundPallet(_rejected(estimate, good), best, proposals.correlation, edges.columns)


def _propose(view: LevelView, sums: Array, kind: PalletType, search: PalletSearch) -> _Proposal:
    """The pose of the highest correlation of one kind, among those of the best four edges at each range."""
    inverse = jnp.linspace(1.0 / search.nearest, 1.0 / search.farthest, search.ranges, dtype=sums.dtype)

    def at_range(x: Float[Array, ""]) -> _Proposal:
        band = hole_band(view, kind, x)
        profile = band_profile(sums, band[0], band[1])
        edges = kind.edges()
        found = best_candidate(profile, kind, view.focal * (edges[0] - edges[3]) / x, search.edges)
        # In units of the tolerance; the ranges are coarse, and their rows do not fit every edge exactly.
        fit = _fit(view, kind, found.columns, found.strength > 0, search.tolerance)
        # The rows of this range must be those of a pallet at this pose.
        agrees = jnp.abs(jnp.log(jnp.where(fit.ok, fit.value.x, 1.0) / x)) < 0.4
        plausible = fit.ok & agrees & (found.strength > search.least_strength) & (fit.cost < 12.5)
        correlation = type_correlation(view, kind, fit.value)
        return _Proposal(fit.value, found.columns, jnp.where(plausible, correlation, -1.0))

    proposals = jax.vmap(at_range)(1.0 / inverse)
    best = jnp.argmax(proposals.correlation)
    return jax.tree.map(lambda leaf: leaf[best], proposals)


def _fit(view: LevelView, kind: PalletType, columns: Float[Array, "4"], some: Array, sigma: Any) -> Estimate:
    """The pose from four edges; without edges that of a distant pallet, not ok."""
    separate = jnp.arange(4, dtype=columns.dtype)
    columns = jnp.where(some, columns, view.middle[0] + separate)
    valid = jnp.broadcast_to(some, (4,))
    return pose_from_edges(kind, view.middle[0] - columns, view.focal, sigma=sigma, valid=valid)


def _distances(pose: SE2, kind: PalletType) -> Float[Array, "4"]:
    """Distances of the edges along x, m, bounded below."""
    return jnp.maximum(pose.rotation.matrix()[0, 1] * kind.edges() + pose.x, 0.1)


def _rejected(estimate: Estimate, good: Array) -> Estimate:
    """The estimate, not ok where the condition is False."""
    ok = estimate.ok & good
    status = jnp.where(estimate.ok & ~good, int(Status.INADMISSIBLE), estimate.status).astype(estimate.status.dtype)
    return eqx.tree_at(lambda e: (e.ok, e.status), estimate, (ok, status))
