"""Simulated ceiling with lamps and skylights, and drives of an upward-looking robot below it."""

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxloc.poses import SE2
from jaxloc.sensors import CeilingMosaic

_COFFER = 2.4  # m
_MARGIN = 3.0  # between walls and the robot, m


class CeilingDrive(eqx.Module):
    """A drive below a ceiling.

    Attributes:
        poses: true poses ``T_world_robot``, stacked along "t", one after each step.
        odometry: what the wheels report of each step, ``T_before_after``.
        brightness: what the pixel reads after each step, in [0, 1].
        start: the true pose before the first step.
    """

    poses: SE2
    odometry: SE2
    brightness: Float[Array, " t"]
    start: SE2


def make_ceiling(seed: int = 0, *, width: float = 60.0, height: float = 40.0, resolution: float = 0.1) -> CeilingMosaic:
    """A ceiling of rooms: coffers of unlike tone, rows of lamps, skylights, stains and uneven light.

    Args:
        seed: fixes it.
        width: extent along x, m.
        height: extent along y, m.
        resolution: edge of a pixel, m.

    Returns:
        The mosaic, in float32.

    Example:
        >>> from jaxloc.data.simulate.ceiling import make_ceiling
        >>> make_ceiling(width=12.0, height=8.0, resolution=0.2).brightness.shape
        (41, 61)
    """
    rng = np.random.default_rng(seed)
    rows, columns = round(height / resolution) + 1, round(width / resolution) + 1
    y, x = np.mgrid[:rows, :columns].astype(np.float32) * np.float32(resolution)
    cell_x, cell_y = (x // _COFFER).astype(int), (y // _COFFER).astype(int)
    tones = rng.normal(0.45, 0.09, size=(cell_y.max() + 1, cell_x.max() + 1)).astype(np.float32)
    image = tones[cell_y, cell_x]
    within_x, within_y = x % _COFFER, y % _COFFER
    beams = (within_x < 0.3) | (within_y < 0.3)
    image = np.where(beams, image - 0.2, image)
    for _ in range(round(width * height / 40.0)):
        _add_lamp(image, x, y, rng)
    for _ in range(round(width * height / 200.0)):
        left, low = rng.uniform(0.0, width), rng.uniform(0.0, height)
        wide, deep = rng.uniform(1.5, 5.0, size=2)
        image[(x > left) & (x < left + wide) & (y > low) & (y < low + deep)] += rng.uniform(0.15, 0.4)
    light = cv2.GaussianBlur(rng.normal(size=image.shape).astype(np.float32), (0, 0), 4.0 / resolution)
    stains = cv2.GaussianBlur(rng.normal(size=image.shape).astype(np.float32), (0, 0), 0.4 / resolution)
    image = image + 0.06 * light / light.std() + 0.04 * stains / stains.std()
    image = np.clip(cv2.GaussianBlur(image, (0, 0), 1.0), 0.0, 1.0)
    return CeilingMosaic(jnp.asarray(image, jnp.float32), resolution, jnp.zeros(2, jnp.float32))


def drive_below(
    mosaic: CeilingMosaic,
    seed: int = 0,
    *,
    distance: float = 200.0,
    step: float = 0.25,
    noise: float = 0.03,
) -> CeilingDrive:
    """Drives from place to place along smooth curves, with drifting odometry.

    Each step, the wheels report the distance with an error of 3 % and the turn with one of 0.02 rad a root meter and
    3 %; the pixel reads with noise, and once in a hundred times something else.

    Args:
        mosaic: above.
        seed: fixes the path and all noise.
        distance: in all, m.
        step: between readings, m.
        noise: standard deviation of the reading.

    Returns:
        The drive.

    Example:
        >>> from jaxloc.data.simulate.ceiling import drive_below, make_ceiling
        >>> drive = drive_below(make_ceiling(width=20.0, height=12.0), distance=10.0)
        >>> drive.brightness.shape, drive.odometry.translation.shape
        ((40,), (40, 2))
    """
    rng = np.random.default_rng(seed)
    count = round(distance / step)
    low, high = np.asarray(mosaic.origin, float) + _MARGIN, np.asarray(mosaic.upper, float) - _MARGIN
    path = _wander(rng, count, step, low, high)
    turns = np.diff(path[:, 2])
    read = step * (1.0 + 0.03 * rng.normal(size=count))
    read_turns = turns * (1.0 + 0.03 * rng.normal(size=count)) + 0.02 * np.sqrt(step) * rng.normal(size=count)
    values = np.asarray(mosaic.at(jnp.asarray(path[1:, :2], jnp.float32)).values, float)
    values = values + noise * rng.normal(size=count)
    values = np.where(rng.uniform(size=count) < 0.01, rng.uniform(size=count), values)
    odometry = _planar(read * np.cos(0.5 * read_turns), read * np.sin(0.5 * read_turns), read_turns)
    return CeilingDrive(
        poses=_planar(*path[1:].T),
        odometry=odometry,
        brightness=jnp.asarray(np.clip(values, 0.0, 1.0), jnp.float32),
        start=SE2(*path[0].astype(np.float32)),
    )


def _planar(x: np.ndarray, y: np.ndarray, theta: np.ndarray) -> SE2:
    return jax.vmap(SE2)(*(jnp.asarray(axis, jnp.float32) for axis in (x, y, theta)))


def _add_lamp(image: np.ndarray, x: np.ndarray, y: np.ndarray, rng: np.random.Generator) -> None:
    """A round lamp, brighter than the ceiling, with a soft halo."""
    center = rng.uniform((0.0, 0.0), (x.max(), y.max()))
    distance = np.hypot(x - center[0], y - center[1])
    radius = rng.uniform(0.15, 0.4)
    image += np.float32(rng.uniform(0.2, 0.55)) * np.exp(-0.5 * np.maximum(distance - radius, 0.0) ** 2 / 0.3**2)


def _wander(rng: np.random.Generator, count: int, step: float, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Poses (x, y, heading) of a robot that steers towards one random place after another, at most 1 rad a meter."""
    position, heading = rng.uniform(low, high), rng.uniform(-np.pi, np.pi)
    goal, path = rng.uniform(low, high), []
    path.append((*position, heading))
    for _ in range(count):
        while np.hypot(*(goal - position)) < 2.0:
            goal = rng.uniform(low, high)
        bearing = np.arctan2(*(goal - position)[::-1]) - heading
        turn = np.clip((bearing + np.pi) % (2.0 * np.pi) - np.pi, -step, step)
        position = position + step * np.array([np.cos(heading + 0.5 * turn), np.sin(heading + 0.5 * turn)])
        heading = heading + turn
        path.append((*position, heading))
    return np.array(path)
