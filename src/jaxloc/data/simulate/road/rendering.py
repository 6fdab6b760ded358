"""Rendering of a road with lane markings, wheel tracks and shadows, with exact lane position.

The appearance of a road is a function of the arc length s and of the lateral position n (m to the left of the lane's
center). An image takes several rays a pixel to the ground; what they show is averaged over the ground that each of
them stands for, so that dashes and shadows far away do not alias.
"""

import dataclasses
from functools import lru_cache

import cv2
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32

from jaxloc._jit import filter_jit
from jaxloc.data.simulate.road.geometry import RoadGeometry, SmallAngles
from jaxloc.lanes.lane import Lane
from jaxloc.sensors.ground_camera import GroundCamera

_TILE = 256  # texels along an edge of a repeating texture
_OCTAVES = ((0.025, 0.6), (0.11, 0.6), (0.47, 0.45), (1.9, 0.3))  # size of a texel (m), share of the contrast
_SHADOW_STEP = 0.1  # of the table of shadows, m
_FARTHEST = 400.0  # ground beyond this range is rendered as at this range, m

Points = Float32[np.ndarray, " n"]


class Mark(eqx.Module):
    """A painted line along the lane.

    Args:
        left: of the lane's center, m.
        width: m.
        dash: painted length, m.
        gap: length between two dashes, m; 0 for a solid line.
        brightness: gray level of the paint.
        phase: way s at which a dash begins, m.
    """

    left: float
    width: float = 0.12
    dash: float = 3.0
    gap: float = 9.0
    brightness: float = 200.0
    phase: float = 0.0

    def cover(self, s: Points, n: Points, along: Points, across: Points) -> Points:
        """Painted share of rectangles of ground, ``along`` long and ``across`` wide (m), about points of the road."""
        low, high = n - 0.5 * across - self.left, n + 0.5 * across - self.left
        half = np.float32(0.5 * self.width)
        wide = np.maximum(np.minimum(high, half) - np.maximum(low, -half), 0.0) / across
        if self.gap <= 0.0:
            return wide
        begin, end = self._painted(s - 0.5 * along), self._painted(s + 0.5 * along)
        return wide * (end - begin) / along

    def _painted(self, s: Points) -> Points:
        """Painted length up to ``s``."""
        turns = (s - np.float32(self.phase)) / np.float32(self.dash + self.gap)
        whole = np.floor(turns)
        return whole * np.float32(self.dash) + np.minimum((turns - whole) * (self.dash + self.gap), self.dash)


class Streak(eqx.Module):
    """Soft stripe along the lane, such as a wheel track.

    Args:
        left: of the lane's center, m.
        sigma: half width, m.
        depth: gray levels by which it is darker.
        wander: standard deviation of its place along the road, m.
    """

    left: float
    sigma: float = 0.2
    depth: float = 14.0
    wander: float = 0.03

    def darken(self, s: Points, n: Points, across: Points) -> Points:
        """Gray levels to take away."""
        phase = np.float32(2.7 * self.left)
        sway = np.sin(s / 3.1 + phase) + np.sin(s / 7.7 + 2.0 * phase) + np.sin(s / 19.0 + 3.0 * phase)
        variance = np.float32(self.sigma**2) + across**2 / 12.0
        miss = n - np.float32(self.left) - np.float32(0.8 * self.wander) * sway
        return np.float32(self.depth * self.sigma) * np.exp(-0.5 * miss**2 / variance) / np.sqrt(variance)


class Shadows(eqx.Module):
    """Bands of shadow across the road, as of trees and bridges.

    Args:
        spacing: mean way from one to the next, m.
        length: mean length, m.
        gain: of the light in the shadow.
        edge: half width of its soft edges, m.
        skew: m along the road by m to the left.
    """

    spacing: float = 25.0
    length: float = 4.0
    gain: float = 0.5
    edge: float = 0.3
    skew: float = 0.3


class Change(eqx.Module):
    """Transition to another road.

    Args:
        road: what it turns into.
        start: way at which the change begins, m.
        length: over which both are blended, m: short for new asphalt, long for a slow drift.
    """

    road: "Road"
    start: float
    length: float = 0.1


class Road(eqx.Module):
    """Appearance of a road: markings, streaks, shadows and noise.

    Args:
        marks: painted lines; by default dashes on the left border of a lane 3.6 m wide, and a solid right border.
        streaks: wheel tracks and oil.
        shadows: None for an overcast day.
        asphalt: its gray level.
        grain: standard deviation of the gray levels of asphalt seen from near.
        edges: where asphalt ends and grass begins, left and right, m to the left of the lane's center.
        grass: its gray level.
        change: another road that follows, or None.
        seed: of texture and shadows.

    Example:
        >>> from jaxloc.data.simulate.road.rendering import Road
        >>> len(Road().marks), len(Road().without_marks().marks)
        (2, 0)
    """

    marks: tuple[Mark, ...] = (Mark(1.8), Mark(-1.8, gap=0.0))
    streaks: tuple[Streak, ...] = (Streak(0.78), Streak(-0.74), Streak(0.05, sigma=0.12, depth=8.0))
    shadows: Shadows | None = Shadows()
    asphalt: float = 105.0
    grain: float = 7.0
    edges: tuple[float, float] = (5.9, -2.9)
    grass: float = 75.0
    change: Change | None = None
    seed: int = 0

    def without_marks(self) -> "Road":
        """The same road before it is painted."""
        return dataclasses.replace(self, marks=())

    def followed_by(self, road: "Road", start: float, length: float = 0.1) -> "Road":
        """This road, turning into another one."""
        return dataclasses.replace(self, change=Change(road, start, length))

    def shade(self, s: Points, n: Points, along: Points, across: Points) -> Points:
        """Gray levels of the road.

        Args:
            s: way along the road, m.
            n: m to the left of the lane's center.
            along: length of ground that each point stands for, m.
            across: its width, m.
        """
        light = self._paint(s, n, along, across)
        if self.shadows is not None:
            beside = np.clip(n, -30.0, 30.0)  # limits the table of shadows
            light *= _shadow_gain(self.shadows, self.seed, s + np.float32(self.shadows.skew) * beside, along)
        if self.change is None:
            return light
        share = np.clip((s - np.float32(self.change.start)) / np.float32(self.change.length), 0.0, 1.0)
        return (1.0 - share) * light + share * self.change.road.shade(s, n, along, across)

    def _paint(self, s: Points, n: Points, along: Points, across: Points) -> Points:
        texture = _texture(self.seed, s, n, along)
        left, right = self.edges
        inside = np.minimum(left - n, n - right) + 0.12 * np.sin(s / 1.7) * np.sin(s / 4.3)
        paved = np.clip(inside / (0.15 + across) + 0.5, 0.0, 1.0)
        ground = np.full_like(s, self.asphalt)
        for streak in self.streaks:
            ground -= streak.darken(s, n, across)
        for mark in self.marks:
            ground += mark.cover(s, n, along, across) * (np.float32(mark.brightness) - ground)
        return paved * (ground + self.grain * texture) + (1.0 - paved) * (self.grass + 2.5 * self.grain * texture)


def render(
    road: Road,
    lane: Lane,
    ground: GroundCamera,
    *,
    shape: tuple[int, int] = (480, 640),
    travelled: float = 0.0,
    noise: float = 1.5,
    seed: int = 0,
    geometry: RoadGeometry = SmallAngles(),
) -> Float32[np.ndarray, "h w"]:
    """An image of a road.

    Args:
        road: appearance of the road.
        lane: where the vehicle is in its lane, and how that bends.
        ground: the camera, with its lens, height, pitch and roll.
        shape: rows and columns.
        travelled: way s of the vehicle along the road, m.
        noise: standard deviation of a gray level of the sensor.
        seed: of that noise.
        geometry: how points of the ground get their place along and across the road.

    Returns:
        Gray levels, 0 to 255; sky above the horizon. The same arguments give the same image.

    Example:
        >>> import jaxloc as jl
        >>> from jaxloc.data.simulate.road.rendering import Road, render
        >>> ground = jl.sensors.GroundCamera(jl.sensors.Pinhole(60.0, 60.0, 39.5, 29.5), height=1.3, pitch=0.05)
        >>> image = render(Road(), jl.lanes.Lane(0.2, 0.0, 1e-3), ground, shape=(60, 80))
        >>> image.shape, bool(image[:20].mean() > image[40:].mean())  # the sky is brighter
        ((60, 80), True)
    """
    rays = 3
    total = np.zeros(shape, np.float32)
    offsets = (np.arange(rays, dtype=np.float32) + 0.5) / np.float32(rays) - np.float32(0.5)
    columns, rows = np.meshgrid(*(np.arange(size, dtype=np.float32) for size in shape[::-1]))
    sky = (215.0 - 40.0 * rows / shape[0]).ravel()
    for down in offsets:
        for right in offsets:
            pixels = jnp.asarray(columns.ravel() + right), jnp.asarray(rows.ravel() + down)
            x, y, meets = (np.array(part) for part in _look(ground, *pixels))
            light = np.where(meets, 0.0, sky).astype(np.float32)
            x, y = x[meets].astype(np.float32), y[meets].astype(np.float32)
            scale = np.minimum(1.0, np.float32(_FARTHEST) / np.maximum(x, 1.0))
            s, n = (np.asarray(part, np.float32) for part in geometry.place(lane, x * scale, y * scale))
            across = np.maximum(x, 0.5) / np.float32(rays * ground.camera.fx)
            along = (np.minimum(x, _FARTHEST) ** 2 + np.float32(ground.height) ** 2) / np.float32(
                rays * ground.camera.fy * ground.height
            )
            light[meets] = road.shade(s + np.float32(travelled), n, along, across)
            total += light.reshape(shape)
    image = total / np.float32(rays * rays)
    image += np.float32(noise) * np.random.default_rng([seed, 3]).standard_normal(shape, np.float32)
    return np.clip(image, 0.0, 255.0)


@filter_jit
def _look(
    ground: GroundCamera, u: Float[Array, " n"], v: Float[Array, " n"]
) -> tuple[Float[Array, " n"], Float[Array, " n"], Bool[Array, " n"]]:
    u, v = (part.astype(ground.height.dtype) for part in (u, v))
    x, y = ground.to_ground_components(u, v)
    return x, y, ground.meets_ground_components(u, v) & (x > 0.0)


def _texture(seed: int, s: Points, n: Points, along: Points) -> Points:
    """Noise of unit variance near by, with less contrast the more ground a point stands for."""
    total = np.zeros_like(s)
    for number, (size, share) in enumerate(_OCTAVES):
        u, v = s / np.float32(size * _TILE), n / np.float32(size * _TILE)
        u, v = _TILE * (u - np.floor(u)), _TILE * (v - np.floor(v))
        contrast = np.float32(share) / np.sqrt(1.0 + along / np.float32(size))
        total += contrast * _remap(_tile(seed, number), u, v)
    return total


@lru_cache(maxsize=16)
def _tile(seed: int, number: int) -> Float32[np.ndarray, "a b"]:
    tile = np.random.default_rng([seed, 1, number]).standard_normal((_TILE, _TILE), np.float32)
    return 1.5 * np.pad(tile, ((0, 1), (0, 1)), mode="wrap")  # interpolation takes a third of the contrast


def _remap(tile: Float32[np.ndarray, "a b"], u: Points, v: Points) -> Points:
    """Bilinear values of an image at any number of places: OpenCV wants them as an image that is not too long."""
    places = [np.pad(part, (0, -part.size % 1024)).reshape(-1, 1024) for part in (u, v)]
    return cv2.remap(tile, *places, cv2.INTER_LINEAR).reshape(-1)[: u.size]


def _shadow_gain(shadows: Shadows, seed: int, s: Points, along: Points) -> Points:
    """Light at stretches of the road: the integral of the bands over each stretch, by a table."""
    if not s.size:
        return s
    low, high = float(np.min(s - along)) - 1.0, float(np.max(s + along)) + 1.0
    table = np.arange(low, high + _SHADOW_STEP, _SHADOW_STEP)
    gain = np.ones_like(table)
    for cell in range(int(low // shadows.spacing) - 1, int(high // shadows.spacing) + 2):
        rng = np.random.default_rng([seed, 2, cell % 2**32])
        begin = (cell + rng.uniform()) * shadows.spacing
        end = begin + shadows.length * rng.uniform(0.5, 1.5)
        inside = 0.5 * (np.tanh((table - begin) / shadows.edge) - np.tanh((table - end) / shadows.edge))
        gain *= 1.0 - (1.0 - shadows.gain) * inside
    integral = np.concatenate([[0.0], np.cumsum(gain)]) * _SHADOW_STEP
    knots = low - 0.5 * _SHADOW_STEP + _SHADOW_STEP * np.arange(len(integral))
    width = np.maximum(along, np.float32(_SHADOW_STEP)).astype(np.float64)
    begin, end = (np.interp(s + side * width, knots, integral) for side in (-0.5, 0.5))
    return ((end - begin) / width).astype(np.float32)
