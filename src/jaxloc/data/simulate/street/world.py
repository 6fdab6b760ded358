"""Simulated street: a winding road, houses, poles, parked and moving cars.

The world frame is that of the first camera: x right, y down, z forward, m. Things on the road stand at an arc length
along the lane in which the camera drives and at a lateral position, to the right of it.
"""

import equinox as eqx
import numpy as np
from jaxtyping import Float64

from jaxloc.data.simulate.street.rendering import Rectangles, join_rectangles

CAMERA_HEIGHT = 1.65
_ASPHALT, _WALL, _BODY, _PAINT = 0, 1, 3, 4
_STEP = 0.1


class Road(eqx.Module):
    """The lane of the camera: heading ``bend * sin(2 pi s / period)`` at the arc length s.

    Args:
        bend: largest heading away from the first one, rad.
        period: arc length of one left and right bend, m.
        begin: arc length at which the street begins, m.
        end: arc length at which it ends, m.
    """

    bend: float
    period: float
    begin: float
    end: float

    def heading(self, arc: float | np.ndarray) -> np.ndarray:
        """Heading to the right of the first one, rad."""
        return self.bend * np.sin(2.0 * np.pi * np.asarray(arc) / self.period)

    def pose(self, arc: float, lateral: float = 0.0, turned: bool = False) -> Float64[np.ndarray, "4 4"]:
        """The frame on the ground at a place of the road: z along it, or against it where turned."""
        grid = np.linspace(0.0, arc, max(int(abs(arc) / _STEP), 1) + 1)
        headings = self.heading(grid)
        position = [np.trapezoid(np.sin(headings), grid), CAMERA_HEIGHT, np.trapezoid(np.cos(headings), grid)]
        heading = headings[-1]
        pose = np.eye(4)
        pose[:3, :3] = rotation_y(heading + (np.pi if turned else 0.0))
        pose[:3, 3] = position + lateral * rotation_y(heading)[:, 0]
        return pose


class Mover(eqx.Module):
    """A box that drives along the road.

    Args:
        instance: its number in the instance images, from 1.
        size: width, height, length, m.
        arc: arc length at time zero, m.
        lateral: m to the right of the camera's lane.
        speed: m/s along the road; negative towards the camera.
        body: its sides, in its own frame (origin on the ground below its middle; x right, y down, z forward).
    """

    instance: int
    size: tuple[float, float, float]
    arc: float
    lateral: float
    speed: float
    body: Rectangles

    def pose(self, road: Road, time: float) -> Float64[np.ndarray, "4 4"]:
        """``T_world_box`` at a time, s."""
        return road.pose(self.arc + self.speed * time, self.lateral, turned=self.speed < 0)


class Street(eqx.Module):
    """All objects of a street.

    Args:
        road: where the camera drives.
        fixed: everything that stands still, in the world frame.
        movers: what drives.
    """

    road: Road
    fixed: Rectangles
    movers: tuple[Mover, ...]

    def rectangles(self, time: float) -> Rectangles:
        """Everything, in the world frame, at a time in s."""
        return join_rectangles([self.fixed, *(m.body.moved(m.pose(self.road, time)) for m in self.movers)])


def rotation_y(angle: float) -> Float64[np.ndarray, "3 3"]:
    """Rotation about the y axis (down): a positive angle turns z towards x, forward towards right.

    Args:
        angle: rad.

    Returns:
        The rotation matrix.
    """
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def make_box(
    size: tuple[float, float, float], texture: int, tile: float, rng: np.random.Generator, instance: int = 0
) -> Rectangles:
    """Makes the four sides and the top of a box that stands on the ground.

    Args:
        size: width, height, length, m.
        texture: which texture.
        tile: edge of one repetition of the texture, m.
        rng: random texture shifts and brightness.
        instance: the object's number; 0 is the background.

    Returns:
        Five rectangles; the origin is on the ground below the middle of the box.
    """
    width, height, length = size
    x, y, z = np.diag([width, height, length])
    base = np.array([-width / 2.0, -height, -length / 2.0])
    # The cross product of the edges points out of the box.
    corner = np.stack([base + x, base + z, base, base + x + z, base])
    first = np.stack([-x, x, z, -z, x])
    second = np.stack([y, y, y, y, z])
    tone = rng.uniform(0.75, 1.15)
    shade = tone * np.array([0.9, 0.9, 0.8, 1.0, 1.15])
    count = np.full(5, 1)
    return Rectangles(
        corner, first, second, texture * count, tile * np.ones(5), rng.uniform(size=(5, 2)), shade, instance * count
    )


def _flat(pose: np.ndarray, width: float, length: float, height: float, texture: int, tile: float) -> Rectangles:
    """A rectangle that lies on the road."""
    flat = Rectangles(
        np.array([[-width / 2.0, -height, -length / 2.0]]),
        np.array([[width, 0.0, 0.0]]),
        np.array([[0.0, 0.0, length]]),
        np.array([texture]),
        np.array([tile]),
        np.zeros((1, 2)),
        np.ones(1),
        np.zeros(1, int),
    )
    return flat.moved(pose)


def _houses(road: Road, rng: np.random.Generator) -> list[Rectangles]:
    houses = []
    for side, distance in ((1.0, 8.0), (-1.0, 12.0)):
        arc = road.begin
        while arc < road.end:
            length, height, depth = rng.uniform(9.0, 15.0), rng.uniform(5.0, 10.0), 6.0
            lateral = side * (distance + rng.uniform(0.0, 2.0) + depth / 2.0)
            box = make_box((depth, height, length), _WALL + int(rng.integers(2)), 14.0, rng)
            houses.append(box.moved(road.pose(arc + length / 2.0, lateral)))
            arc += length + rng.uniform(0.5, 4.0)
    return houses


def _parked(road: Road, rng: np.random.Generator) -> list[Rectangles]:
    parked = []
    for lateral, chance in ((3.4, 0.55), (-7.2, 0.6)):
        for arc in np.arange(road.begin, road.end, 6.5):
            if rng.uniform() < chance:
                size = (rng.uniform(1.6, 1.9), rng.uniform(1.4, 2.2), rng.uniform(3.8, 5.0))
                place = road.pose(arc + rng.uniform(-0.5, 0.5), lateral + rng.uniform(-0.15, 0.15))
                parked.append(make_box(size, _BODY, 5.0, rng).moved(place))
    return parked


def _furniture(road: Road, rng: np.random.Generator) -> list[Rectangles]:
    """Poles, and the dashed line between the lanes."""
    things = []
    for arc in np.arange(road.begin, road.end, 17.0):
        for lateral in (5.4, -9.4):
            pole = make_box((0.16, 6.0, 0.16), _BODY, 4.0, rng)
            things.append(pole.moved(road.pose(arc + rng.uniform(-3.0, 3.0), lateral)))
    for arc in np.arange(road.begin, road.end, 8.0):
        things.append(_flat(road.pose(arc, -1.9), 0.14, 3.0, 0.01, _PAINT, 4.0))
    return things


def _movers(rng: np.random.Generator, speed: float) -> tuple[Mover, ...]:
    """A car ahead in the same lane, three that come towards the camera, someone on the pavement."""
    car = (1.8, 1.5, 4.3)
    plans = (
        (car, 16.0, 0.0, 0.95 * speed),
        (car, 45.0, -3.7, -0.8 * speed),
        ((1.9, 2.1, 5.0), 80.0, -3.7, -0.9 * speed),
        (car, 115.0, -3.7, -speed),
        ((0.5, 1.75, 0.4), 22.0, 6.2, 1.4),
    )
    return tuple(
        Mover(number, size, arc, lateral, velocity, make_box(size, _BODY, 3.0, rng, instance=number))
        for number, (size, arc, lateral, velocity) in enumerate(plans, start=1)
    )


def make_street(seed: int, *, length: float, speed: float) -> Street:
    """Lays out a street.

    Args:
        seed: fixes where everything stands.
        length: how far the camera will drive, m.
        speed: how fast it will drive, m/s; the others drive about as fast.

    Returns:
        The street.

    Example:
        >>> street = make_street(0, length=20.0, speed=10.0)
        >>> len(street.movers), bool(street.rectangles(0.0).instance.max() == 5)
        (5, True)
    """
    rng = np.random.default_rng(seed)
    road = Road(bend=0.25, period=160.0, begin=-12.0, end=length + 110.0)
    middle = np.eye(4)
    middle[:3, 3] = [0.0, CAMERA_HEIGHT, road.end / 2.0]
    ground = _flat(middle, 700.0, road.end + 500.0, 0.0, _ASPHALT, 12.0)
    fixed = [ground, *_houses(road, rng), *_parked(road, rng), *_furniture(road, rng)]
    return Street(road, join_rectangles(fixed), _movers(rng, speed))
