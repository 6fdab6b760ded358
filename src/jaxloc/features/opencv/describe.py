"""Feature descriptors by OpenCV on the host, in the order of the keypoints."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Num

from jaxloc.features.keypoints import Descriptors, Keypoints
from jaxloc.features.opencv.backend import load, to_uint8
from jaxloc.features.opencv.detectors import AbstractFeature


def describe(kind: AbstractFeature, image: Num[np.ndarray | Array, "h w"], keypoints: Keypoints) -> Descriptors:
    """Describes the neighborhood of each keypoint (runs on the host, not under `jit`).

    Keypoints of any detector may be described by any descriptor; scale is only used where both have the same name.
    ORB and SIFT use the keypoints' orientation (0 where a detector gives none); KAZE and A-KAZE measure their own.

    Args:
        kind: The descriptor: `ORB()`, `SIFT()`, `KAZE()` or `AKAZE()`.
        image: Grayscale image: uint8, or other types as gray levels 0-255 (0-1 if no value exceeds 1).
        keypoints: Of the image.

    Returns:
        One descriptor a keypoint: float32 numbers for SIFT and KAZE, packed bits (uint8) for ORB and A-KAZE. A keypoint
        whose neighborhood leaves the image (OpenCV drops those) keeps its slot and is not valid.

    Raises:
        ImportError: This OpenCV lacks the descriptor (KAZE and A-KAZE since 5.0).

    Example:
        >>> import numpy as np
        >>> from jaxloc.features.opencv import ORB, detect
        >>> image = np.random.default_rng(0).integers(0, 255, (120, 160), dtype=np.uint8)
        >>> keypoints = detect(ORB(), image, capacity=20)
        >>> describe(ORB(), image, keypoints).values.shape
        (20, 32)
    """
    pixels = to_uint8(image)
    capacity = keypoints.valid.shape[0]
    extractor = kind.extractor(capacity)
    binary = extractor.descriptorType() == load().CV_8U
    values = np.zeros((capacity, extractor.descriptorSize()), np.uint8 if binary else np.float32)
    valid = np.zeros(capacity, bool)
    slots = np.flatnonzero(np.asarray(keypoints.valid) & _inside(np.asarray(keypoints.uv), pixels.shape))
    if len(slots) and min(pixels.shape) >= 3:
        rows, kept = _compute(kind, extractor, pixels, keypoints, slots)
        finite = np.isfinite(rows).all(axis=1)
        rows, kept = rows[finite], kept[finite]
        values[kept], valid[kept] = rows, True
    return Descriptors(jnp.asarray(values), jnp.asarray(valid))


def _inside(uv: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    return np.all((uv >= 0) & (uv <= np.array([shape[1] - 1, shape[0] - 1])), axis=1)


def _compute(kind: AbstractFeature, extractor, pixels: np.ndarray, keypoints: Keypoints, slots: np.ndarray):
    """Rows of descriptors and the slots they belong to."""
    native = keypoints.detector == type(kind).__name__
    uv = np.asarray(keypoints.uv)[slots].astype(float)
    octave = np.asarray(keypoints.octave)[slots] if native else np.zeros(len(slots), int)
    # A-KAZE and KAZE read their scale level from the class number and drop nothing; ORB drops what is near the
    # border and keeps the class number, which holds the slot.
    levels = type(kind).__name__ in ("KAZE", "AKAZE")
    # The lowest level of KAZE has no derivatives: descriptors of it are NaN.
    layer = np.asarray(keypoints.layer)[slots] if native else np.full(len(slots), int(type(kind).__name__ == "KAZE"))
    columns = (
        uv[:, 0],
        uv[:, 1],
        np.asarray(keypoints.size)[slots].astype(float),
        np.rad2deg(np.asarray(keypoints.angle)[slots].astype(float)),
        np.asarray(keypoints.response)[slots].astype(float),
        octave,
        layer if levels else slots,
    )
    points = list(map(load().KeyPoint, *(column.tolist() for column in columns)))
    points, rows = extractor.compute(pixels, points)
    kept = slots if levels else np.array([point.class_id for point in points], int)
    if rows is None:
        return np.zeros((0, extractor.descriptorSize())), np.zeros(0, int)
    return rows, kept
