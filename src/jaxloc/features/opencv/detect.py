"""Keypoint detection by OpenCV on the host, evenly distributed over a grid and padded to a fixed size."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Num

from jaxloc.features.keypoints import Keypoints
from jaxloc.features.opencv.backend import to_uint8
from jaxloc.features.opencv.detectors import AbstractDetector, Candidates, from_opencv


def detect(
    kind: AbstractDetector,
    image: Num[np.ndarray | Array, "h w"],
    capacity: int = 1000,
    grid: tuple[int, int] = (6, 8),
    *,
    mask: Bool[np.ndarray | Array, "_ _"] | None = None,
) -> Keypoints:
    """Detects keypoints, evenly distributed over the image (runs on the host, not under `jit`).

    Candidates are taken in rounds over the cells of the grid, the strongest remaining one of each cell, until the
    capacity is used: full cells make up for empty ones, and the first slots are distributed as evenly as all of them.

    Args:
        kind: The detector: `ORB()`, `SIFT()`, `FAST()`, `Harris()`, `ShiTomasi()`, `KAZE()` or `AKAZE()`.
        image: Grayscale image: uint8, or other types as gray levels 0-255 (0-1 if no value exceeds 1).
        capacity: Number of slots.
        grid: Cells as (rows, columns); `(1, 1)` takes the strongest of the whole image.
        mask: True where keypoints may lie.

    Returns:
        `capacity` slots, the used ones first; none is valid in a flat image. float32.

    Raises:
        ImportError: This OpenCV lacks the detector (KAZE and A-KAZE since 5.0).
        ValueError: Capacity or grid is not positive, or the mask has another shape.

    References:
        Even distribution of features by a grid [T-70].

    Example:
        >>> import numpy as np
        >>> from jaxloc.features.opencv import ShiTomasi
        >>> image = np.zeros((60, 80), np.uint8)
        >>> image[20:40, 30:50] = 200
        >>> keypoints = detect(ShiTomasi(), image, capacity=8)
        >>> int(keypoints.valid.sum()), keypoints.uv.shape
        (4, (8, 2))
    """
    if capacity < 1 or min(grid) < 1:
        raise ValueError(f"detect: capacity {capacity} and grid {grid} must be positive.")
    if mask is not None and tuple(mask.shape) != tuple(image.shape):
        raise ValueError(f"detect: the mask has shape {mask.shape}, the image {image.shape}; give one value a pixel.")
    pixels = to_uint8(image)
    # Some detectors of OpenCV raise on images of a few pixels, none finds anything there.
    if min(pixels.shape) < 3:
        found = from_opencv(())
    else:
        found = kind.find(pixels, None if mask is None else np.asarray(mask).astype(np.uint8), capacity)
    kept = _order_by_cell_rank(found.uv, found.response, pixels.shape, grid)[:capacity]
    return _pack(found, kept, capacity, type(kind).__name__)


def _order_by_cell_rank(
    uv: np.ndarray, response: np.ndarray, shape: tuple[int, int], grid: tuple[int, int]
) -> np.ndarray:
    """Order of the candidates by rank within their cells, then by response."""
    row = np.clip(uv[:, 1] * (grid[0] / shape[0]), 0, grid[0] - 1).astype(np.int64)
    column = np.clip(uv[:, 0] * (grid[1] / shape[1]), 0, grid[1] - 1).astype(np.int64)
    by_response = np.argsort(-response, kind="stable")
    cell = (row * grid[1] + column)[by_response]
    by_cell = np.argsort(cell, kind="stable")
    counts = np.bincount(cell, minlength=grid[0] * grid[1])
    rank = np.empty(len(cell), np.int64)
    rank[by_cell] = np.arange(len(cell)) - np.repeat(np.cumsum(counts) - counts, counts)
    return by_response[np.argsort(rank, kind="stable")]


def _pack(found: Candidates, kept: np.ndarray, capacity: int, detector: str) -> Keypoints:
    """The kept candidates as arrays, padded with zeros to the capacity."""

    def pad(values, dtype=np.float32):
        column = np.zeros((capacity, *np.shape(values)[1:]), dtype)
        column[: len(kept)] = values
        return jnp.asarray(column)

    zeros = np.zeros(len(kept))
    size, angle, octave, layer = zeros + found.size, zeros, zeros, zeros
    if found.keypoints is not None and len(kept):
        picked = [found.keypoints[index] for index in kept.tolist()]
        fields = [(key.size, key.angle, key.octave, key.class_id) for key in picked]
        size, angle, octave, layer = np.array(fields).T
    return Keypoints(
        uv=pad(found.uv[kept]),
        size=pad(size),
        # OpenCV's mark for "no orientation" is -1 degree.
        angle=pad(np.deg2rad(np.maximum(angle, 0.0))),
        response=pad(found.response[kept]),
        octave=pad(octave, np.int32),
        layer=pad(layer, np.int32),
        valid=pad(np.ones(len(kept), bool), bool),
        detector=detector,
    )
