"""Procedural gray textures that repeat, with prefiltered copies for every distance, packed into one image.

A texture is a sum of octaves of smooth noise, so that it shows corners at every scale. Far away, a pixel covers many
texels: each level of the pyramid halves the resolution by averaging (Williams 1983), and a look-up blends the two
levels nearest to the size of the pixel's footprint.
"""

import cv2
import equinox as eqx
import numpy as np
from jaxtyping import Float32, Int, UInt8

_NUM_LEVELS = 8


class TextureAtlas(eqx.Module):
    """Several square textures and their pyramids side by side in one image.

    Args:
        image: all levels of all textures, each with a border of one wrapped texel.
        size: texels along an edge at the finest level.
        rows: row of each level's first texel.
        columns: column of each texture's first texel.
    """

    image: UInt8[np.ndarray, "h w"]
    size: int = eqx.field(static=True)
    rows: Int[np.ndarray, " levels"]
    columns: Int[np.ndarray, " textures"]

    def sample(
        self,
        texture: Int[np.ndarray, " n"],
        u: Float32[np.ndarray, " n"],
        v: Float32[np.ndarray, " n"],
        footprint: Float32[np.ndarray, " n"],
    ) -> Float32[np.ndarray, " n"]:
        """Looks up gray values.

        Args:
            texture: which texture.
            u: horizontal position in tiles; the texture repeats with period one.
            v: vertical position in tiles.
            footprint: size of a pixel on the surface, in tiles.

        Returns:
            Gray values, 0 to 255, averaged over about a footprint.
        """
        level = np.log2(np.maximum(footprint * np.float32(self.size), np.float32(1.0)))
        level = np.minimum(level, np.float32(_NUM_LEVELS - 1.001))
        fine = level.astype(np.int32)
        fraction = level - fine.astype(np.float32)
        u, v = u - np.floor(u), v - np.floor(v)
        column = self.columns.astype(np.float32)[texture]
        near, far = self._bilinear(column, fine, u, v), self._bilinear(column, fine + 1, u, v)
        return near + fraction * (far - near)

    def _bilinear(self, column, level, u, v):
        size = np.ldexp(np.float32(self.size), -np.arange(_NUM_LEVELS)).astype(np.float32)[level]
        row = self.rows.astype(np.float32)[level]
        half = np.float32(0.5)
        # Maps of one row: OpenCV wants images.
        x, y = column + u * size - half, row + v * size - half
        width = 4096
        padded = -(-x.size // width) * width
        x, y = (np.resize(axis, padded).reshape(-1, width) for axis in (x, y))
        values = cv2.remap(self.image, x, y, cv2.INTER_LINEAR)
        return values.reshape(-1)[: u.size].astype(np.float32)


def pack_textures(textures: list[Float32[np.ndarray, "size size"]]) -> TextureAtlas:
    """Builds the pyramids and packs them.

    Args:
        textures: gray values, 0 to 255; all of one size, a power of two of at least 256.

    Returns:
        The atlas.
    """
    size = textures[0].shape[0]
    sizes = [size >> level for level in range(_NUM_LEVELS)]
    rows = np.cumsum([1] + [edge + 2 for edge in sizes[:-1]])
    columns = np.arange(len(textures)) * (size + 2) + 1
    image = np.zeros((sum(sizes) + 2 * _NUM_LEVELS, len(textures) * (size + 2)), np.uint8)
    for texture, column in zip(textures, columns, strict=True):
        for edge, row in zip(sizes, rows, strict=True):
            level = cv2.resize(texture, (edge, edge), interpolation=cv2.INTER_AREA)
            tile = np.pad(np.clip(np.rint(level), 0, 255).astype(np.uint8), 1, mode="wrap")
            image[row - 1 : row + edge + 1, column - 1 : column + edge + 1] = tile
    return TextureAtlas(image, size, rows, columns)


def make_noise(
    rng: np.random.Generator, size: int, *, coarsest: int = 8, persistence: float = 0.9
) -> Float32[np.ndarray, "size size"]:
    """Makes smooth noise of many octaves that repeats.

    Args:
        rng: random numbers.
        size: texels along an edge, a power of two.
        coarsest: blobs along an edge in the coarsest octave, a power of two.
        persistence: amplitude of an octave relative to the next coarser one.

    Returns:
        Noise of mean zero and standard deviation one.
    """
    total = np.zeros((size, size), np.float32)
    cells, amplitude = coarsest, 1.0
    while cells <= size // 2:
        grid = np.pad(rng.standard_normal((cells, cells)).astype(np.float32), 4, mode="wrap")
        scale = size // cells
        octave = cv2.resize(grid, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        margin = 4 * scale
        total += np.float32(amplitude) * octave[margin : margin + size, margin : margin + size]
        cells, amplitude = cells * 2, amplitude * persistence
    return (total - total.mean()) / total.std()


def make_street_textures(seed: int, size: int = 1024) -> TextureAtlas:
    """Makes the surfaces of a street: asphalt, two walls with windows, car body, paint.

    Args:
        seed: fixes them.
        size: texels along an edge.

    Returns:
        Five textures.
    """
    rng = np.random.default_rng(seed)
    asphalt = 95.0 + 26.0 * make_noise(rng, size)
    walls = [_wall(rng, size, tone) for tone in (125.0, 150.0)]
    body = 120.0 + 48.0 * make_noise(rng, size, coarsest=4)
    paint = 215.0 + 14.0 * make_noise(rng, size, coarsest=32)
    return pack_textures([asphalt, *walls, body, paint])


def _wall(rng: np.random.Generator, size: int, tone: float) -> Float32[np.ndarray, "size size"]:
    """A wall with windows at irregular places, light or dark."""
    wall = tone + 30.0 * make_noise(rng, size, coarsest=16)
    floors = 5
    for floor in range(floors):
        column = int(rng.integers(0, size // 8))
        while column < size - size // 10:
            width, height = rng.integers(size // 20, size // 9), rng.integers(size // 14, size // 8)
            row = floor * size // floors + int(rng.integers(size // 40, size // 20))
            pane = wall[row : row + height, column : column + width]
            pane *= 0.35
            pane += rng.uniform(-10.0, 110.0)
            column += int(width + rng.integers(size // 24, size // 7))
    return wall.astype(np.float32)
