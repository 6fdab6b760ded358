"""Road coordinates of ground points: arc length and lateral distance, by the small-angle model or exactly."""

from abc import abstractmethod

import equinox as eqx
import numpy as np
from jaxtyping import Float32

from jaxloc.lanes.lane import Lane

_NODES = 6  # of the quadrature along a clothoid: exact to a micrometer for bends up to one radian
_STEPS = 5

Points = Float32[np.ndarray, " n"]


class RoadGeometry(eqx.Module):
    """Conversion of ground points to road coordinates (strategy)."""

    @abstractmethod
    def place(self, lane: Lane, x: Points, y: Points) -> tuple[Points, Points]:
        """Arc length along the lane from the vehicle, and lateral distance to the left of its center.

        Args:
            lane: where the vehicle is.
            x: m ahead.
            y: m to the left.

        Returns:
            s and n, m.
        """


class SmallAngles(RoadGeometry):
    """Small-angle model of the estimators: ``s = x``, ``n = y - center(x)``.

    Example:
        >>> import numpy as np, jaxloc as jl
        >>> from jaxloc.data.simulate.road.geometry import SmallAngles
        >>> x, y = np.array([50.0], np.float32), np.array([2.0], np.float32)
        >>> SmallAngles().place(jl.lanes.Lane(0.5, 0.0, 1e-3), x, y)[1].tolist()
        [1.25]
    """

    def place(self, lane: Lane, x: Points, y: Points) -> tuple[Points, Points]:
        """Distance ahead, and difference along the vehicle's y axis."""
        offset, slope, curvature, rate = _numbers(lane)
        bend = 0.5 * curvature + x * (rate / 6.0)
        return x, y - (x * (x * bend - slope) - offset)


class ExactClothoid(RoadGeometry):
    """The foot of the perpendicular on a true clothoid, ``theta(s) = curvature s + rate s^2 / 2``.

    With it, the error that the small-angle model makes can be measured.
    """

    def place(self, lane: Lane, x: Points, y: Points) -> tuple[Points, Points]:
        """Newton's iteration for the foot of the perpendicular."""
        offset, slope, curvature, rate = _numbers(lane)
        cosine = 1.0 / np.hypot(1.0, slope)
        along, left = cosine * (x - slope * y), np.float32(offset) + cosine * (slope * x + y)
        s = along.copy()
        for _ in range(_STEPS):
            angle, right, up = _follow(s, curvature, rate)
            ahead, aside = along - right, left - up
            n = aside * np.cos(angle) - ahead * np.sin(angle)
            missing = ahead * np.cos(angle) + aside * np.sin(angle)
            s = s + missing / np.maximum(1.0 - (curvature + rate * s) * n, 0.2)
        return s.astype(np.float32), n.astype(np.float32)


def _numbers(lane: Lane) -> list[np.float32]:
    """Offset, slope, curvature and rate."""
    return [np.float32(v) for v in (lane.offset, np.tan(float(lane.heading)), lane.curvature, lane.rate)]


def _follow(s: np.ndarray, curvature: np.float32, rate: np.float32) -> tuple[np.ndarray, ...]:
    """Direction and place of a clothoid after ``s``, by Gauss-Legendre quadrature of its direction."""
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    forward, left = np.zeros_like(s), np.zeros_like(s)
    for node, weight in zip(0.5 * (nodes + 1.0), 0.5 * weights, strict=True):
        part = np.float32(node) * s
        angle = part * (curvature + 0.5 * rate * part)
        forward += np.float32(weight) * np.cos(angle)
        left += np.float32(weight) * np.sin(angle)
    return s * (curvature + 0.5 * rate * s), s * forward, s * left
