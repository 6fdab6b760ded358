"""Checks of the images that a pipeline is given, one at a time and possibly live."""

from typing import Any

import numpy as np

__all__ = ["check_image", "check_stereo_images"]


def check_image(image: Any, shape: tuple[int, int], name: str = "image") -> tuple[int, int]:
    """Checks that an image is grayscale, of gray levels 0 to 255, and of the size of those before it.

    Args:
        image: 2-D array of bytes or of floating-point numbers.
        shape: rows and columns of the images before; (0, 0) for the first one.
        name: of the image, for the message.

    Returns:
        Its rows and columns.

    Raises:
        ValueError: with what came and what is needed.

    Example:
        >>> check_image(np.zeros((4, 6, 3), np.uint8), (0, 0), "left image")
        Traceback (most recent call last):
        ValueError: The left image has shape (4, 6, 3): give a grayscale image (rows, columns), not a color image.
    """
    if image is None:
        raise ValueError(f"The {name} is missing.")
    pixels = np.asarray(image) if not hasattr(image, "dtype") else image
    if pixels.ndim != 2:
        hint = ", not a color image" if pixels.ndim == 3 else ""
        raise ValueError(f"The {name} has shape {tuple(pixels.shape)}: give a grayscale image (rows, columns){hint}.")
    if pixels.dtype != np.uint8 and not np.issubdtype(pixels.dtype, np.floating):
        raise ValueError(
            f"The {name} has dtype {pixels.dtype}: give gray levels 0 to 255 as uint8 or floating-point numbers "
            "(of 16-bit images, image / 257)."
        )
    size = (int(pixels.shape[0]), int(pixels.shape[1]))
    if 0 in size:
        raise ValueError(f"The {name} has shape {size}: it is empty.")
    if shape != (0, 0) and size != shape:
        raise ValueError(f"The {name} has shape {size}, but the images before it have {shape}: start anew with init.")
    return size


def check_stereo_images(frame: Any, shape: tuple[int, int]) -> tuple[int, int]:
    """Checks both images of a stereo frame, see `check_image`.

    Args:
        frame: record with ``left`` and ``right``.
        shape: rows and columns of the images before; (0, 0) for the first one.

    Returns:
        Rows and columns.

    Raises:
        ValueError: an image is missing, no grayscale image of bytes or floats, or of another size.
    """
    size = check_image(getattr(frame, "left", None), shape, "left image")
    return check_image(getattr(frame, "right", None), size, "right image")
