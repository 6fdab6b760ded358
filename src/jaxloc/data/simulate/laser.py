"""Simulated building with a laser robot: exact map and ranges, noisy odometry.

Walls and furniture are rectangles along the axes, so that ranges are exact whatever the map's resolution.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64

from jaxloc.data.laser_log import LaserLog
from jaxloc.poses import SE2
from jaxloc.poses.planar import compose_poses, relative_poses
from jaxloc.sensors import OccupancyMap

_WALL, _DOOR, _CORRIDOR = 0.15, 1.0, 2.2
_STEP, _TURN = 0.25, 0.35
_MARGIN = 0.5


class Building(eqx.Module):
    """Building of rectangular obstacles, and a path between them.

    Args:
        boxes: "k 4" (x_low, y_low, x_high, y_high), m.
        waypoints: "w 2" corners of a path that hits none of them, m.
        size: extent in x and y, from the origin, m.
    """

    boxes: Float64[np.ndarray, "k 4"]
    waypoints: Float64[np.ndarray, "w 2"]
    size: tuple[float, float]

    def map(self, resolution: float = 0.05) -> OccupancyMap:
        """The map: cells are occupied whose center lies in a rectangle; those out of the building are unknown."""
        shape = [int(np.ceil((extent + 2.0 * _MARGIN) / resolution)) for extent in self.size]
        x, y = ((np.arange(count) + 0.5) * resolution - _MARGIN for count in shape)
        inside = (y[:, None] > 0) & (y[:, None] < self.size[1]) & (x[None, :] > 0) & (x[None, :] < self.size[0])
        probability = np.where(inside, 0.0, 0.5).astype(np.float32)
        for low_x, low_y, high_x, high_y in self.boxes:
            rows, columns = (y >= low_y) & (y <= high_y), (x >= low_x) & (x <= high_x)
            probability[np.ix_(rows, columns)] = 1.0
        return OccupancyMap(jnp.asarray(probability), resolution, SE2(-_MARGIN, -_MARGIN, 0.0))


class LaserDrive(eqx.Module):
    """A drive through a building.

    Args:
        building: where.
        log: what was recorded.
        truth: "n 3" true robot poses (x, y, heading) at the scans.
    """

    building: Building
    log: LaserLog
    truth: Float64[np.ndarray, "n 3"]


def make_building(seed: int = 0, *, num_rooms: int = 4) -> Building:
    """Makes a corridor with rooms of different sizes on both sides, all with some furniture.

    Args:
        seed: which building.
        num_rooms: on each side.

    Returns:
        The building. Its path visits every other room.

    Raises:
        ValueError: when there is to be no room.
    """
    if num_rooms < 1:
        raise ValueError(f"num_rooms is {num_rooms}; at least one is needed on each side.")
    rng = np.random.default_rng(seed)
    depths = rng.uniform(3.5, 5.0, 2)
    low, high = depths[0], depths[0] + _CORRIDOR
    widths = rng.uniform(3.0, 5.5, (2, num_rooms))
    widths *= widths.sum(axis=1).max() / widths.sum(axis=1, keepdims=True)
    length, height = float(widths[0].sum()), float(high + depths[1])
    half = 0.5 * _WALL
    boxes = [(0.0, 0.0, length, _WALL), (0.0, height - _WALL, length, height)]
    boxes += [(0.0, 0.0, _WALL, height), (length - _WALL, 0.0, length, height)]
    stops = []
    for side, (wall, floor, ceiling) in enumerate(((low, 0.0, low), (high, high, height))):
        edges = np.concatenate([[0.0], np.cumsum(widths[side])])
        boxes += [(edge - half, floor, edge + half, ceiling) for edge in edges[1:-1]]
        for room, (left, right) in enumerate(zip(edges[:-1], edges[1:], strict=True)):
            door = rng.uniform(left + 1.0, right - 1.0)
            jambs = door - _DOOR / 2, door + _DOOR / 2
            boxes += [(left, wall - half, jambs[0], wall + half), (jambs[1], wall - half, right, wall + half)]
            boxes += _furniture(rng, (left, floor, right, ceiling), door)
            if (room + side) % 2 == 0:
                stops.append((door, 0.5 * (floor + ceiling)))
    return Building(np.array(boxes), _path(stops, 0.5 * (low + high), length), (length, height))


def _furniture(rng: np.random.Generator, room: tuple[float, float, float, float], door: float) -> list[tuple]:
    """A few boxes along the side walls, clear of the way straight in from the door."""
    left, floor, right, ceiling = room
    boxes = []
    for at_left in (True, False):
        space = (door - left if at_left else right - door) - 0.8
        width, depth = rng.uniform(0.2, max(space, 0.25)), rng.uniform(0.4, 1.2)
        y = rng.uniform(floor + 0.3, ceiling - 0.3 - depth)
        x = left + _WALL if at_left else right - _WALL - width
        if rng.uniform() < 0.8:
            boxes.append((x, y, x + width, y + depth))
    return boxes


def _path(stops: list[tuple[float, float]], middle: float, length: float) -> Float64[np.ndarray, "w 2"]:
    points = [(1.0, middle)]
    for x, y in sorted(stops):
        points += [(x, middle), (x, y), (x, middle)]
    return np.array([*points, (length - 1.0, middle)])


def cast_rays(
    boxes: Float64[np.ndarray, "k 4"],
    poses: Float64[np.ndarray, "n 3"],
    angles: Float64[np.ndarray, " b"],
    reach: float,
) -> Float64[np.ndarray, "n b"]:
    """Exact ranges from poses to rectangles, by their slabs.

    Args:
        boxes: (x_low, y_low, x_high, y_high), m.
        poses: (x, y, heading) of the laser.
        angles: of the beams from its x axis, rad.
        reach: where nothing is, m.

    Returns:
        Ranges, m.

    References:
        Kay and Kajiya, "Ray tracing complex scenes", SIGGRAPH 1986.

    Example:
        >>> cast_rays(np.array([[2.0, -1.0, 3.0, 1.0]]), np.zeros((1, 3)), np.array([0.0, np.pi]), 8.0).tolist()
        [[2.0, 8.0]]
    """
    heading = poses[:, 2:] + angles[None, :]
    enter, leave = np.zeros((*heading.shape, len(boxes))), np.full((*heading.shape, len(boxes)), np.inf)
    for axis, direction in enumerate((np.cos(heading), np.sin(heading))):
        safe = np.where(np.abs(direction) < 1e-12, 1e-12, direction)[..., None]
        ends = [(boxes[:, axis + end] - poses[:, None, axis, None]) / safe for end in (0, 2)]
        enter, leave = np.maximum(enter, np.minimum(*ends)), np.minimum(leave, np.maximum(*ends))
    return np.minimum(np.where(enter <= leave, enter, np.inf).min(axis=2), reach)


def simulate_laser_drive(
    *,
    seed: int = 0,
    building: Building | None = None,
    num_beams: int = 180,
    noise: float = 0.02,
    clutter: float = 0.05,
    odometry_noise: tuple[float, float] = (0.05, 0.03),
    slip: float = 0.01,
    max_range: float = 20.0,
    mount: tuple[float, float, float] = (0.1, 0.0, 0.0),
) -> LaserDrive:
    """Simulates a drive through a building, a scan every quarter of a meter or third of a radian.

    Args:
        seed: of building and noise.
        building: where; that of the seed where not given.
        num_beams: over 180 degrees.
        noise: standard deviation of a range, m.
        clutter: probability that a beam ends at something that the map does not show.
        odometry_noise: m for a meter, and rad for a step and for a rad.
        slip: probability that spinning wheels count a step twice.
        max_range: where nothing is, m.
        mount: (x, y, heading) of the laser on the robot.

    Returns:
        The drive.

    Example:
        >>> drive = simulate_laser_drive(seed=1)
        >>> drive.log.ranges.shape == (len(drive.truth), 180)
        True
    """
    building = make_building(seed) if building is None else building
    rng = np.random.default_rng([seed, 1])
    truth = _drive(building.waypoints)
    angles = -0.5 * np.pi + np.pi / num_beams * np.arange(num_beams)
    lasers = compose_poses(truth, np.broadcast_to(np.array(mount), truth.shape))
    ranges = cast_rays(building.boxes, lasers, angles, max_range)
    seen = ranges < max_range
    ranges = np.where(seen, ranges + noise * rng.standard_normal(ranges.shape), ranges)
    blocked = rng.uniform(size=ranges.shape) < clutter
    ranges = np.where(blocked, ranges * rng.uniform(size=ranges.shape), ranges)
    log = LaserLog(
        name=f"building {seed}",
        times=np.arange(len(truth)) * 0.5,
        ranges=np.maximum(ranges, 0.02).astype(np.float32),
        odometry=_odometry(truth, rng, odometry_noise, slip),
        angle_min=-0.5 * np.pi,
        angle_increment=np.pi / num_beams,
        max_range=max_range,
        mount=mount,
    )
    return LaserDrive(building, log, truth)


def _drive(waypoints: Float64[np.ndarray, "w 2"]) -> Float64[np.ndarray, "n 3"]:
    """Poses along straight ways with turns on the spot between them."""
    poses, heading = [], None
    for start, end in zip(waypoints[:-1], waypoints[1:], strict=True):
        way = end - start
        wanted = np.arctan2(way[1], way[0])
        if heading is not None:
            turn = (wanted - heading + np.pi) % (2.0 * np.pi) - np.pi
            count = int(np.ceil(np.abs(turn) / _TURN))
            poses += [(*start, heading + turn * part / count) for part in range(1, count)]
        heading = wanted
        count = max(int(np.ceil(np.hypot(*way) / _STEP)), 1)
        poses += [(*(start + way * part / count), heading) for part in range(count)]
    return np.array(poses)


def _odometry(
    truth: Float64[np.ndarray, "n 3"], rng: np.random.Generator, noise: tuple[float, float], slip: float
) -> Float64[np.ndarray, "n 3"]:
    motions = relative_poses(truth[:-1], truth[1:])
    way, turn = np.hypot(motions[:, 0], motions[:, 1]), np.abs(motions[:, 2])
    motions[:, 0] *= 1.0 + noise[0] * rng.standard_normal(len(motions))
    motions[:, 0] += np.where(rng.uniform(size=len(motions)) < slip, 1.0, 0.0) * way
    motions[:, 2] += noise[1] * (turn + way) * rng.standard_normal(len(motions)) + 0.01 * way
    poses = [np.zeros((1, 3))]
    for motion in motions:
        poses.append(compose_poses(poses[-1], motion[None]))
    return np.concatenate(poses)
