"""Edges of a gray-level profile: peaks of a smoothed derivative, with their variance."""

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxloc._jit import filter_jit


class EdgeDetector(eqx.Module):
    """Edge detector (strategy): a kernel correlated with the profile, whose greatest response is the border."""

    @abstractmethod
    def kernel(self, offsets: Float[Array, " k"]) -> Float[Array, " k"]:
        """Weights by distance to the right of the border, m; their sum is zero."""

    @abstractmethod
    def contrast(self, kernel: Float[Array, " k"], offsets: Float[Array, " k"]) -> Float[Array, ""]:
        """Response to an edge of one gray level."""


class LightStripe(EdgeDetector):
    """The middle of a painted mark: a rising edge to its left and a falling one to its right, from left to right.

    Args:
        width: of the mark, m.
        sigma: smoothing, m.
    """

    width: float = 0.13
    sigma: float = 0.05

    def kernel(self, offsets: Float[Array, " k"]) -> Float[Array, " k"]:
        """Difference of two smoothed derivatives, half a width to either side."""
        half = 0.5 * self.width
        return _slope(offsets + half, self.sigma) - _slope(offsets - half, self.sigma)

    def contrast(self, kernel: Float[Array, " k"], offsets: Float[Array, " k"]) -> Float[Array, ""]:
        """Response to a stripe."""
        return jnp.sum(jnp.where(jnp.abs(offsets) <= 0.5 * self.width, kernel, 0.0))


class SingleEdge(EdgeDetector):
    """One edge, as of a road against grass.

    Args:
        rising: whether the right side is lighter.
        sigma: smoothing, m.
    """

    rising: bool = True
    sigma: float = 0.08

    def kernel(self, offsets: Float[Array, " k"]) -> Float[Array, " k"]:
        """A smoothed derivative."""
        return _slope(offsets, self.sigma) * (1.0 if self.rising else -1.0)

    def contrast(self, kernel: Float[Array, " k"], offsets: Float[Array, " k"]) -> Float[Array, ""]:
        """Response to a step."""
        return jnp.sum(jnp.abs(kernel)) * 0.5


def _slope(offsets: Float[Array, " k"], sigma: float) -> Float[Array, " k"]:
    """Weights of a derivative by correlation: the lighter the right side, the greater."""
    return offsets * jnp.exp(-0.5 * (offsets / sigma) ** 2)


class Edge(eqx.Module):
    """Position of an edge in a profile.

    Attributes:
        place: distance to the left of the middle of the profile, m.
        variance: of that, m^2: noise of the response's slope over its bend.
        contrast: of the edge, gray levels.
        snr: response against its own standard deviation.
        ok: whether there is a peak inside the profile.
    """

    place: Float[Array, ""]
    variance: Float[Array, ""]
    contrast: Float[Array, ""]
    snr: Float[Array, ""]
    ok: Bool[Array, ""]


@filter_jit
def find_edge(
    profile: Float[Array, " columns"],
    variance: Float[Array, ""],
    reach: Float[Array, ""],
    *,
    within: Float[Array, ""] | None = None,
    detector: EdgeDetector = LightStripe(),
) -> Edge:
    """Finds the strongest edge of a profile to a fraction of a sample.

    The response ``r = k * p`` peaks at the border; a parabola gives the fraction. Noise moves the peak by
    ``var = var(r') / r''^2`` [K-31].

    Args:
        profile: means of gray levels, from left to right.
        variance: of a mean; they are taken to be independent.
        reach: lateral distance from the middle of the profile to its ends, m.
        within: only peaks no farther from the middle count, m; all by default.
        detector: what an edge is.

    Returns:
        The edge.

    References:
        Dickmanns and Mysliwetz (1992) [K-31]; J. Canny, "A computational approach to edge detection", PAMI 1986, eq. 7
        (localization of an edge).

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> left = jnp.linspace(0.6, -0.6, 61)
        >>> profile = jnp.where(jnp.abs(left - 0.2) < 0.061, 130.0, 80.0)
        >>> edge = jl.lanes.dickmanns.find_edge(profile, jnp.array(1.0), jnp.array(0.6))
        >>> round(float(edge.place), 2), bool(edge.ok)
        (0.2, True)
    """
    columns, dtype = profile.shape[0], profile.dtype
    spacing = 2.0 * reach / (columns - 1)
    half = columns // 4
    offsets = spacing * jnp.arange(-half, half + 1, dtype=dtype)
    kernel = detector.kernel(offsets)
    kernel = kernel - jnp.mean(kernel)
    response = jnp.correlate(profile - jnp.mean(profile), kernel, mode="valid", precision="highest")
    places = spacing * (0.5 * (response.shape[0] - 1) - jnp.arange(response.shape[0], dtype=dtype))
    allowed = jnp.abs(places) <= (jnp.inf if within is None else within)
    best = jnp.argmax(jnp.where(allowed, response, -jnp.inf))
    middle = jnp.clip(best, 1, response.shape[0] - 2)
    before, peak, after = response[middle - 1], response[middle], response[middle + 1]
    bend = 2.0 * peak - before - after
    peaked = (bend > 1e-12 * jnp.abs(peak) + 1e-20) & (peak >= before) & (peak >= after)
    bend = jnp.where(peaked, bend, 1.0)
    slope = 0.5 * (kernel[2:] - kernel[:-2])
    noise = jnp.maximum(variance, jnp.finfo(dtype).tiny)
    place = places[middle] - spacing * jnp.clip(0.5 * (after - before) / bend, -0.5, 0.5)
    variance = spacing**2 * noise * jnp.sum(slope**2) / bend**2
    scale = jnp.maximum(detector.contrast(kernel, offsets), 1e-20)
    deviation = jnp.sqrt(noise * jnp.sum(kernel**2))
    ok = peaked & (middle == best) & jnp.isfinite(place) & jnp.isfinite(variance)
    place, variance = jnp.where(ok, place, 0.0), jnp.where(ok, variance, 1.0)
    return Edge(place, variance, jnp.where(ok, peak / scale, 0.0), jnp.where(ok, peak / deviation, 0.0), ok)
