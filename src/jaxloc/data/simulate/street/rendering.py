"""Renderer of textured rectangles with a depth buffer.

A rectangle is ``corner + a * first + b * second`` with a and b in [0, 1]. Seen from a pinhole camera its inverse
depth is affine in the pixel, and so are a and b divided by the depth: a handful of array operations on the rectangle's
bounding box decide which pixels it covers and wins.
"""

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int, Int32

from jaxloc.data.simulate.street.textures import TextureAtlas

_NEAR = 0.3


class Rectangles(eqx.Module):
    """Textured rectangles in one frame.

    Args:
        corner: m.
        first: the edge along which the texture's columns run, m.
        second: the edge along which its rows run, m.
        texture: which texture.
        tile: edge of one repetition of the texture, m.
        offset: shift of the texture, in tiles.
        shade: brightness factor.
        instance: which object; 0 is the background.
    """

    corner: Float64[np.ndarray, "n 3"]
    first: Float64[np.ndarray, "n 3"]
    second: Float64[np.ndarray, "n 3"]
    texture: Int[np.ndarray, " n"]
    tile: Float64[np.ndarray, " n"]
    offset: Float64[np.ndarray, "n 2"]
    shade: Float64[np.ndarray, " n"]
    instance: Int[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.corner)

    def moved(self, pose: Float64[np.ndarray, "4 4"]) -> "Rectangles":
        """The same rectangles in the outer frame of a pose."""
        rotation, translation = pose[:3, :3], pose[:3, 3]
        return Rectangles(
            self.corner @ rotation.T + translation,
            self.first @ rotation.T,
            self.second @ rotation.T,
            self.texture,
            self.tile,
            self.offset,
            self.shade,
            self.instance,
        )


def join_rectangles(groups: list[Rectangles]) -> Rectangles:
    """Puts groups of rectangles of one frame together.

    Args:
        groups: at least one.

    Returns:
        All of them.
    """
    names = ("corner", "first", "second", "texture", "tile", "offset", "shade", "instance")
    return Rectangles(*(np.concatenate([getattr(group, name) for group in groups]) for name in names))


class Intrinsics(eqx.Module):
    """A pinhole camera as plain numbers.

    Args:
        fx: px.
        fy: px.
        cx: px.
        cy: px.
        height: of the image, px.
        width: of the image, px.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    height: int
    width: int


class Rendering(eqx.Module):
    """What a camera sees.

    Args:
        image: gray values before noise and exposure, 0 to 255.
        depth: along the optical axis, m; infinite in the sky.
        instances: which object each pixel shows; 0 is the background.
    """

    image: Float32[np.ndarray, "h w"]
    depth: Float32[np.ndarray, "h w"]
    instances: Int32[np.ndarray, "h w"]


def render(
    rectangles: Rectangles, atlas: TextureAtlas, camera: Intrinsics, camera_from_world: Float64[np.ndarray, "4 4"]
) -> Rendering:
    """Renders rectangles.

    Args:
        rectangles: in the world frame.
        atlas: their textures.
        camera: the camera.
        camera_from_world: ``T_camera_world``.

    Returns:
        The image, its depth and the objects seen.
    """
    seen = rectangles.moved(camera_from_world)
    normals = np.cross(seen.first, seen.second)
    heights = np.sum(normals * seen.corner, axis=1)
    buffer = _Buffer(camera)
    for index in _candidates(seen, heights, camera).tolist():
        buffer.draw(index, seen.corner[index], seen.first[index], seen.second[index], normals[index] / heights[index])
    image = _sky(camera)
    drawn = buffer.index >= 0
    if drawn.any():
        image[drawn] = _shade(seen, atlas, camera, buffer, drawn)
    with np.errstate(divide="ignore"):
        depth = np.float32(1.0) / buffer.inverse_depth
    instances = np.where(drawn, rectangles.instance[buffer.index], 0).astype(np.int32)
    return Rendering(image, depth, instances)


def _candidates(seen: Rectangles, heights: np.ndarray, camera: Intrinsics) -> Int[np.ndarray, " k"]:
    """Rectangles that face the camera and may lie in its field of view."""
    first, second = seen.first[:, None], seen.second[:, None]
    steps = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    corners = seen.corner[:, None] + steps[:, :1] * first + steps[:, 1:] * second
    x, y, z = np.moveaxis(corners, -1, 0)
    outside = (z < _NEAR).all(axis=1)
    for position, focal, center, size in (
        (x, camera.fx, camera.cx, camera.width),
        (y, camera.fy, camera.cy, camera.height),
    ):
        outside |= (focal * position + center * z < 0.0).all(axis=1)
        outside |= (focal * position + (center - size + 1.0) * z > 0.0).all(axis=1)
    return np.flatnonzero(~outside & (heights < -1e-9))


class _Buffer:
    """What is nearest in each pixel so far: the rectangle and the place on it."""

    def __init__(self, camera: Intrinsics):
        shape = (camera.height, camera.width)
        self.camera = camera
        self.x = ((np.arange(camera.width) - camera.cx) / camera.fx).astype(np.float32)
        self.y = ((np.arange(camera.height) - camera.cy) / camera.fy).astype(np.float32)
        self.inverse_depth = np.zeros(shape, np.float32)
        self.index = np.full(shape, -1, np.int32)
        self.a = np.zeros(shape, np.float32)
        self.b = np.zeros(shape, np.float32)

    def draw(self, index: int, corner: np.ndarray, first: np.ndarray, second: np.ndarray, plane: np.ndarray) -> None:
        """Draws one rectangle given in the camera frame, on the plane ``plane . x = 1``."""
        box = self._bounding_box(corner, first, second)
        if box is None:
            return
        rows, columns = box
        x, y = self.x[columns], self.y[rows, None]
        inverse_depth = _affine(plane, x, y)
        nearer = inverse_depth > np.maximum(self.inverse_depth[rows, columns], np.float32(1e-6))
        depth = np.float32(1.0) / np.where(nearer, inverse_depth, np.float32(1.0))
        wins, places = nearer, []
        for edge in (first, second):
            dual = edge / (edge @ edge)
            place = depth * _affine(dual, x, y) - np.float32(dual @ corner)
            wins = wins & (place >= 0.0) & (place <= 1.0)
            places.append(place)
        self._keep(index, rows, columns, wins, inverse_depth, places)

    def _keep(self, index, rows, columns, wins: Bool[np.ndarray, "h w"], inverse_depth, places) -> None:
        np.copyto(self.inverse_depth[rows, columns], inverse_depth, where=wins)
        np.copyto(self.a[rows, columns], places[0], where=wins)
        np.copyto(self.b[rows, columns], places[1], where=wins)
        np.copyto(self.index[rows, columns], np.int32(index), where=wins)

    def _bounding_box(self, corner, first, second) -> tuple[slice, slice] | None:
        """Rows and columns that the rectangle may cover, after it is cut off in front of the camera."""
        corners = np.stack([corner, corner + first, corner + first + second, corner + second])
        following = np.roll(corners, -1, axis=0)
        crosses = (corners[:, 2] < _NEAR) != (following[:, 2] < _NEAR)
        a, b = corners[crosses], following[crosses]
        cut = a + ((_NEAR - a[:, 2]) / (b[:, 2] - a[:, 2]))[:, None] * (b - a)
        points = np.concatenate([corners[corners[:, 2] >= _NEAR], cut])
        if not len(points):
            return None
        camera = self.camera
        columns = camera.fx * points[:, 0] / points[:, 2] + camera.cx
        rows = camera.fy * points[:, 1] / points[:, 2] + camera.cy
        left, right = max(int(np.floor(columns.min())), 0), min(int(np.ceil(columns.max())) + 1, camera.width)
        top, bottom = max(int(np.floor(rows.min())), 0), min(int(np.ceil(rows.max())) + 1, camera.height)
        if left >= right or top >= bottom:
            return None
        return slice(top, bottom), slice(left, right)


def _affine(vector: np.ndarray, x: np.ndarray, y: np.ndarray) -> Float32[np.ndarray, "h w"]:
    """``vector . (x, y, 1)`` for every ray."""
    vector = vector.astype(np.float32)
    return (vector[0] * x) + (vector[1] * y + vector[2])


def _shade(seen: Rectangles, atlas: TextureAtlas, camera: Intrinsics, buffer: _Buffer, drawn) -> np.ndarray:
    """Gray values of the pixels that show a rectangle."""
    index = buffer.index[drawn]
    rows, columns = np.nonzero(drawn)
    depth = np.float32(1.0) / buffer.inverse_depth[drawn]
    first_length = np.linalg.norm(seen.first, axis=1)
    second_length = np.linalg.norm(seen.second, axis=1)
    normal = np.cross(seen.first, seen.second) / (first_length * second_length)[:, None]
    distance = np.abs(np.sum(normal * seen.corner, axis=1))
    table = np.stack(
        [first_length / seen.tile, second_length / seen.tile, *seen.offset.T, 1.0 / seen.tile, distance, seen.shade]
    ).astype(np.float32)
    along, down, shift_u, shift_v, per_tile, distance, shade = table[:, index]
    ray_squared = buffer.x[columns] ** 2 + buffer.y[rows] ** 2 + np.float32(1.0)
    # A pixel is depth/f wide on a surface seen head on; on a slanted one it is longer by one over the cosine.
    across = depth / np.float32(camera.fx)
    slant = np.clip(depth * np.sqrt(ray_squared) / np.maximum(distance, np.float32(1e-6)), 1.0, 16.0)
    footprint = across * slant ** np.float32(0.75) * per_tile
    u, v = buffer.a[drawn] * along + shift_u, buffer.b[drawn] * down + shift_v
    return atlas.sample(seen.texture[index], u, v, footprint) * shade


def _sky(camera: Intrinsics) -> Float32[np.ndarray, "h w"]:
    """A sky that grows brighter towards the horizon."""
    ramp = np.linspace(175.0, 225.0, camera.height, dtype=np.float32)
    return np.repeat(ramp[:, None], camera.width, axis=1)
