"""Pairs of matched features, one record a kind: whitened differences and their derivatives by the pose.

The residuals are described in `correspondences` [K-57].
"""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxloc._arguments import checked
from jaxloc._jit import filter_jit
from jaxloc._linalg import matmul
from jaxloc.beliefs.validity import positive
from jaxloc.poses import SE2, SE3
from jaxloc.solvers import Linearization


class Pairs(eqx.Module):
    """Pairs of one kind; points and directions are kept as "k n", items along the last axis.

    Attributes:
        whitening: one over the standard deviation; zero for masked pairs.
    """

    whitening: eqx.AbstractVar[Float[Array, " n"]]

    @abstractmethod
    def linearize(self, pose: SE2 | SE3) -> Linearization:
        """Whitened differences "c n" and their derivatives "d c n" along the tangent of the pose."""


class PointPoint(Pairs):
    """Point-to-point pairs: ``T s - t``.

    Args:
        source: "n k", m.
        target: "n k", m.
        sigma: standard deviation of a coordinate of the difference, m: a number or one a pair.
        valid: pairs that are used.
    """

    source: Float[Array, "k n"]
    target: Float[Array, "k n"]
    whitening: Float[Array, " n"]

    def __init__(self, source: Array, target: Array, *, sigma: Any = 1.0, valid: Any = None):
        self.source, self.target, self.whitening = _packed((source, target), sigma, valid)

    def linearize(self, pose: SE2 | SE3) -> Linearization:
        """The whole difference."""
        difference, slope = _moved(pose, self.source)
        return _whitened(difference - self.target, slope, self.whitening)


class PointLine(Pairs):
    """Point-to-line pairs: the part of ``T s - p`` across the line.

    Args:
        source: "n k", m.
        target: a point of each line, "n k", m.
        direction: along each line, "n k", of any length but zero.
        sigma: standard deviation of the distance, m: a number or one a pair.
        valid: pairs that are used; lines without direction never are.
    """

    source: Float[Array, "k n"]
    target: Float[Array, "k n"]
    direction: Float[Array, "k n"]
    whitening: Float[Array, " n"]

    def __init__(self, source: Array, target: Array, direction: Array, *, sigma: Any = 1.0, valid: Any = None):
        self.source, self.target, along, whitening = _packed((source, target, direction), sigma, valid)
        self.direction, self.whitening = _unit(along, whitening)

    def linearize(self, pose: SE2 | SE3) -> Linearization:
        """The part across the line."""
        moved, slope = _moved(pose, self.source)
        difference, slope = _across(self.direction, moved - self.target, slope)
        return _whitened(difference, slope, self.whitening)


class PointSegment(Pairs):
    """Point-to-segment pairs: the vector from the nearest point of the segment, which may be an end [K-63].

    Args:
        source: "n k", m.
        first: one end of each segment, "n k", m.
        second: the other; where it equals the first, the segment is a point.
        sigma: standard deviation of the distance, m: a number or one a pair.
        valid: pairs that are used.
    """

    source: Float[Array, "k n"]
    first: Float[Array, "k n"]
    second: Float[Array, "k n"]
    whitening: Float[Array, " n"]

    def __init__(self, source: Array, first: Array, second: Array, *, sigma: Any = 1.0, valid: Any = None):
        self.source, self.first, self.second, self.whitening = _packed((source, first, second), sigma, valid)

    def linearize(self, pose: SE2 | SE3) -> Linearization:
        """The part across the segment between its ends, the whole difference beyond them."""
        moved, slope = _moved(pose, self.source)
        along, fraction = _fraction(moved, self.first, self.second)
        clamped = jnp.clip(fraction, 0.0, 1.0)
        difference = moved - self.first - clamped[None, :] * along
        squared = jnp.sum(along**2, axis=0)
        between = (fraction > 0.0) & (fraction < 1.0) & (squared > 0.0)
        scale = jnp.where(between, 1.0 / jnp.where(between, squared, 1.0), 0.0)
        inner = jnp.sum(slope * along[None], axis=1, keepdims=True)
        return _whitened(difference, slope - along[None] * (inner * scale[None, None, :]), self.whitening)


class SegmentSegment(Pairs):
    """Segment-to-segment pairs: distances of both ends of the source from the line of the target.

    Args:
        source_first: one end of each source segment, "n k", m.
        source_second: the other.
        target_first: one end of each target segment, "n k", m.
        target_second: the other; the order of ends has no influence.
        sigma: standard deviation of the distance of an end, m: a number or one a pair.
        valid: pairs that are used; targets without length never are.
    """

    first: Float[Array, "k n"]
    second: Float[Array, "k n"]
    target: Float[Array, "k n"]
    direction: Float[Array, "k n"]
    whitening: Float[Array, " n"]

    def __init__(
        self,
        source_first: Array,
        source_second: Array,
        target_first: Array,
        target_second: Array,
        *,
        sigma: Any = 1.0,
        valid: Any = None,
    ):
        ends = (source_first, source_second, target_first, target_second)
        self.first, self.second, self.target, other, whitening = _packed(ends, sigma, valid)
        self.direction, self.whitening = _unit(other - self.target, whitening)

    def linearize(self, pose: SE2 | SE3) -> Linearization:
        """Both distances."""
        parts = []
        for end in (self.first, self.second):
            moved, slope = _moved(pose, end)
            parts.append(_across(self.direction, moved - self.target, slope))
        difference = jnp.concatenate([part[0] for part in parts])
        slope = jnp.concatenate([part[1] for part in parts], axis=1)
        return _whitened(difference, slope, self.whitening)


class LineLine(Pairs):
    """Line-to-line pairs: ``R d_s`` across ``d_t``, the sine of the angle between them, for either sign.

    Args:
        source: directions in the source frame, "n k", of any length but zero.
        target: directions in the target frame.
        sigma: standard deviation of the angle, rad: a number or one a pair.
        valid: pairs that are used; lines without direction never are.
    """

    source: Float[Array, "k n"]
    target: Float[Array, "k n"]
    whitening: Float[Array, " n"]

    def __init__(self, source: Array, target: Array, *, sigma: Any = 1.0, valid: Any = None):
        source, target, whitening = _packed((source, target), sigma, valid)
        self.source, whitening = _unit(source, whitening)
        self.target, self.whitening = _unit(target, whitening)

    def linearize(self, pose: SE2 | SE3) -> Linearization:
        """The part of the direction across."""
        moved, slope = _moved(pose, self.source)
        size = self.source.shape[0]
        rotated = moved - pose.translation[:, None]
        # Directions do not depend on translation.
        difference, slope = _across(self.target, rotated, slope.at[:size].set(0.0))
        return _whitened(difference, slope, self.whitening)


@filter_jit
@checked
def nearest_on_segment(
    points: Float[Array, "n k"], first: Float[Array, "n k"], second: Float[Array, "n k"]
) -> Float[Array, "n k"]:
    """Nearest point of each segment, its ends included, to a point.

    ``a + clip(v1 . v2 / v2 . v2, 0, 1) v2`` with ``v1 = x - a`` and ``v2 = b - a``. The lecture tests one end only.

    Args:
        points: "n 2" or "n 3", m.
        first: ends of the segments, m.
        second: the other ends; a segment without length is a point.

    Returns:
        The nearest points, m.

    References:
        KELLY 9.2.3.7, interpolated closest point [K-63].

    Example:
        >>> import jax.numpy as jnp
        >>> ends = jnp.array([[0.0, 0.0]]), jnp.array([[2.0, 0.0]])
        >>> nearest_on_segment(jnp.array([[1.0, 3.0]]), *ends).tolist()
        [[1.0, 0.0]]
    """
    along, fraction = _fraction(points.T, first.T, second.T)
    return (first.T + jnp.clip(fraction, 0.0, 1.0)[None, :] * along).T


def _packed(features: tuple[Array, ...], sigma: Any, valid: Bool[Array, " n"] | None) -> tuple[Array, ...]:
    """Features as "k n" with non-finite values replaced, and the whitening, zero for masked pairs."""
    shapes = {feature.shape for feature in features}
    if len(shapes) > 1 or len(features[0].shape) != 2 or features[0].shape[1] not in {2, 3}:
        raise ValueError(f"Features of a pair have one shape, (n, 2) or (n, 3); these have {sorted(shapes)}.")
    dtype = features[0].dtype
    sigmas = jnp.broadcast_to(jnp.asarray(sigma, dtype), features[0].shape[:1])
    usable = positive(sigmas)
    usable = usable if valid is None else usable & valid
    for feature in features:
        usable = usable & jnp.all(jnp.isfinite(feature), axis=1)
    whitening = jnp.where(usable, 1.0 / jnp.where(usable, sigmas, 1.0), 0.0)
    return (*(jnp.where(usable[None, :], feature.T, 0.0) for feature in features), whitening)


def _unit(
    vectors: Float[Array, "k n"], whitening: Float[Array, " n"]
) -> tuple[Float[Array, "k n"], Float[Array, " n"]]:
    """Vectors of length one; the whitening of those without length becomes zero."""
    squared = jnp.sum(vectors**2, axis=0)
    some = squared > float(jnp.finfo(vectors.dtype).tiny)
    inverse = jnp.where(some, 1.0 / jnp.sqrt(jnp.where(some, squared, 1.0)), 0.0)
    return vectors * inverse[None, :], jnp.where(some, whitening, 0.0)


def _moved(pose: SE2 | SE3, points: Float[Array, "k n"]) -> tuple[Float[Array, "k n"], Float[Array, "d k n"]]:
    """Points in the target frame, and their derivatives by ``T exp(v, w)``, ``R (v + w x s)``."""
    rotation = pose.rotation.matrix()
    size, count = points.shape
    shifts = jnp.broadcast_to(rotation.T[:, :, None], (size, size, count))
    zero = jnp.zeros_like(points[0])
    if size == 2:
        turns = [jnp.stack([-points[1], points[0]])]
    else:
        x, y, z = points
        turns = [jnp.stack([zero, -z, y]), jnp.stack([z, zero, -x]), jnp.stack([-y, x, zero])]
    rotated = jnp.stack([matmul(rotation, turn) for turn in turns])
    return matmul(rotation, points) + pose.translation[:, None], jnp.concatenate([shifts, rotated])


def _across(
    direction: Float[Array, "k n"], difference: Float[Array, "k n"], slope: Float[Array, "d k n"]
) -> tuple[Float[Array, "k n"], Float[Array, "d k n"]]:
    """A difference and its derivatives less their parts along a unit vector."""
    along = jnp.sum(direction * difference, axis=0, keepdims=True)
    slopes = jnp.sum(direction[None] * slope, axis=1, keepdims=True)
    return difference - direction * along, slope - direction[None] * slopes


def _whitened(difference: Float[Array, "c n"], slope: Float[Array, "d c n"], whitening: Array) -> Linearization:
    return Linearization(difference * whitening[None, :], slope * whitening[None, None, :])


def _fraction(
    points: Float[Array, "k n"], first: Float[Array, "k n"], second: Float[Array, "k n"]
) -> tuple[Float[Array, "k n"], Float[Array, " n"]]:
    """The segment as a vector, and the position of a projected point: 0 at the first end, 1 at the second."""
    along = second - first
    squared = jnp.sum(along**2, axis=0)
    some = squared > float(jnp.finfo(points.dtype).tiny)
    return along, jnp.where(some, jnp.sum(along * (points - first), axis=0) / jnp.where(some, squared, 1.0), 0.0)
