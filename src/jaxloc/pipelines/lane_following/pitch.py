"""Pitch of a camera over a road, from the vanishing point of straight lines along it."""

from collections.abc import Iterable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64

from jaxloc.features.opencv.backend import load, to_uint8
from jaxloc.sensors.ground_camera import GroundCamera

_MOST_LINES = 240
_NEAR = 0.008  # standard deviation of the distance of a line from the vanishing point, in focal lengths
_STEEPEST, _FLATTEST = 1.35, 0.25  # angles of lines against the horizon, rad: poles and shadows are ignored
_SHORTEST = 0.12  # least total length of the lines on each side, in focal lengths


class Pitch(eqx.Module):
    """An estimated pitch with its standard deviation.

    Attributes:
        value: rad, positive looks down.
        sigma: standard deviation, rad.
        support: fraction of the length of all lines that passes through the vanishing point.
        ok: whether lines of both sides agree; otherwise the value is the given pitch of the camera.
    """

    value: float
    sigma: float
    support: float
    ok: bool


def estimate_pitch(images: Iterable[np.ndarray], ground: GroundCamera, *, most: float = 0.3) -> Pitch:
    """Estimates the pitch of a camera by the vanishing point of straight lines along the road.

    Straight edges in the lower part of all images vote for the point that most of them pass, on both sides of it; a
    direction ``(a, b, 1)`` in the camera that the road's lines share is level when ``tan(pitch) = elevation``.

    Args:
        images: gray levels, of a mostly straight road.
        ground: the camera; its pitch is not used.
        most: greatest plausible pitch, rad.

    Returns:
        The pitch.

    References:
        C. Rother, "A new approach to vanishing point detection in architectural environments", 2002 (votes of
        segments by their length).

    Example:
        >>> import jaxloc as jl
        >>> from jaxloc.data.simulate.road.rendering import Road, render
        >>> camera = jl.sensors.Pinhole(250.0, 250.0, 159.5, 100.0)
        >>> seen = jl.sensors.GroundCamera(camera, height=1.3, pitch=0.05)
        >>> image = render(Road(), jl.lanes.Lane(0.3, 0.01, 0.0), seen, shape=(240, 320))
        >>> found = estimate_pitch([image], jl.sensors.GroundCamera(camera, height=1.3))
        >>> bool(abs(found.value - 0.05) < 0.005), found.ok
        (True, True)
    """
    level = eqx.tree_at(lambda g: g.pitch, ground, jnp.zeros_like(ground.pitch))
    lines = [_road_lines(image, level) for image in images]
    segments = np.concatenate([*lines, np.zeros((0, 4))])
    length = np.hypot(segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1])
    order = np.argsort(-length)[:_MOST_LINES]
    segments, length = segments[order], length[order]
    refused = Pitch(float(ground.pitch), 0.1, 0.0, False)
    left = np.flatnonzero(_slope(segments) < 0.0)
    right = np.flatnonzero(_slope(segments) > 0.0)
    if not len(left) or not len(right):
        return refused
    point, weight = _vote(segments, length, left, right, most)
    both = min(weight[left].sum(), weight[right].sum())
    if both < _SHORTEST or abs(point[1]) > most:
        return refused
    share = float(weight.sum() / length.sum())
    distance = _distances(segments, point)
    scatter = np.sqrt(np.sum(weight * distance**2) / np.sum(weight))
    sigma = float(np.clip(scatter / np.sqrt(max(weight.sum() / length.max() - 2.0, 1.0)), 0.002, 0.02))
    return Pitch(float(np.arctan(point[1])), sigma, share, True)


def _road_lines(image: np.ndarray, level: GroundCamera) -> Float64[np.ndarray, "n 4"]:
    """Straight edges: end points (left, up) in a pinhole camera without roll and pitch, in focal lengths."""
    cv2 = load()
    gray = to_uint8(image)
    rows, columns = gray.shape
    edges = cv2.Canny(cv2.GaussianBlur(gray, (5, 5), 0), 40, 120)
    edges[: int(0.45 * rows)] = 0
    found = cv2.HoughLinesP(edges, 1, np.pi / 360, 18, minLineLength=columns / 40, maxLineGap=columns / 160)
    if found is None:
        return np.zeros((0, 4))
    ends = found.reshape(-1, 4).astype(np.float64)
    parts: list[Any] = []
    for u, v in ((ends[:, 0], ends[:, 1]), (ends[:, 2], ends[:, 3])):
        camera = level.camera
        x, y = camera.normalize_components(jnp.asarray(u, camera.fx.dtype), jnp.asarray(v, camera.fx.dtype))
        axes = np.asarray(level.axes(), np.float64)
        road = axes @ np.stack([np.asarray(x), np.asarray(y), np.ones(len(u))])
        parts += [road[1] / road[0], road[2] / road[0]]
    lines = np.stack(parts, axis=1)
    angle = np.abs(np.arctan(_slope(lines)))
    return lines[(angle > _FLATTEST) & (angle < _STEEPEST)]


def _slope(lines: Float64[np.ndarray, "n 4"]) -> Float64[np.ndarray, " n"]:
    across = lines[:, 2] - lines[:, 0]
    return (lines[:, 3] - lines[:, 1]) / np.where(np.abs(across) > 1e-9, across, 1e-9)


def _vote(
    lines: Float64[np.ndarray, "n 4"], length: Float64[np.ndarray, " n"], left: Any, right: Any, most: float
) -> tuple[Float64[np.ndarray, "2"], Float64[np.ndarray, " n"]]:
    """The intersection of a left and a right line with the most votes, refined; and the weight of each line in it."""
    a = np.repeat(left, len(right))
    b = np.tile(right, len(left))
    slope, start = _slope(lines), lines[:, :2]
    height = start[:, 1] - slope * start[:, 0]
    x = (height[b] - height[a]) / (slope[a] - slope[b])
    points = np.stack([x, height[a] + slope[a] * x], axis=1)
    points = points[(np.abs(points[:, 1]) < most) & (np.abs(points[:, 0]) < 0.5)]
    if not len(points):
        return np.array([0.0, np.inf]), np.zeros(len(lines))
    points = points[:: max(1, len(points) // 4000)]
    far = (height - points[:, 1:] + slope * points[:, :1]) / np.hypot(1.0, slope)
    votes = np.exp(-0.5 * (far / _NEAR) ** 2) * length
    # Lines of one side alone do not determine the point: the weaker side counts.
    point = points[np.argmax(np.minimum(votes[:, left].sum(axis=1), votes[:, right].sum(axis=1)))]
    for _ in range(10):
        weight = length * np.exp(-0.5 * (_distances(lines, point) / _NEAR) ** 2)
        normal = np.stack([-slope, np.ones_like(slope)], axis=1) / np.hypot(1.0, slope)[:, None]
        system = normal.T @ (weight[:, None] * normal)
        point = np.linalg.solve(system, normal.T @ (weight * np.sum(normal * start, axis=1)))
    return point, weight


def _distances(lines: Float64[np.ndarray, "n 4"], point: np.ndarray) -> Float64[np.ndarray, " n"]:
    slope = _slope(lines)
    return (point[1] - lines[:, 1] - slope * (point[0] - lines[:, 0])) / np.hypot(1.0, slope)
