"""Import of OpenCV on first use, its feature factories, and conversion of images to 8 bits."""

from types import ModuleType

import numpy as np
from jaxtyping import Array, Num


def load() -> ModuleType:
    """Imports OpenCV.

    Raises:
        ImportError: OpenCV is not installed.

    Example:
        >>> load().__name__
        'cv2'
    """
    try:
        import cv2
    except ImportError as error:
        raise ImportError(
            "Detecting and describing features needs OpenCV: pip install opencv-python-headless"
        ) from error
    return cv2


def create(name: str, **options):
    """Makes the OpenCV feature `name`, for example `ORB`, from `cv2` or, since OpenCV 5, from `cv2.xfeatures2d`.

    Raises:
        ImportError: This build of OpenCV lacks the feature.

    Example:
        >>> create("ORB", nfeatures=10).getMaxFeatures()
        10
    """
    cv2 = load()
    for module in (cv2, getattr(cv2, "xfeatures2d", None)):
        maker = getattr(module, f"{name}_create", None)
        if maker is not None:
            return maker(**options)
    raise ImportError(
        f"{name} is missing from this OpenCV ({cv2.__version__}); it left the standard wheel in 5.0. "
        "Install opencv-python-headless<5, or opencv-contrib-python-headless>=5 in its place."
    )


def to_uint8(image: Num[np.ndarray | Array, "h w"]) -> np.ndarray:
    """Converts a grayscale image to contiguous 8-bit values, the input of OpenCV's feature detectors.

    Args:
        image: uint8 is unchanged; other types are gray levels 0-255, or 0-1 if no value exceeds 1.

    Example:
        >>> import numpy as np
        >>> to_uint8(np.array([[0.0, 127.6, 300.0]])).tolist()
        [[0, 128, 255]]
    """
    pixels = np.asarray(image)
    if pixels.dtype == np.uint8:
        return np.ascontiguousarray(pixels)
    pixels = np.nan_to_num(pixels.astype(np.float32), posinf=255.0)
    scale = 255.0 if pixels.size and pixels.max() <= 1.0 else 1.0
    return np.clip(np.rint(pixels * scale), 0, 255).astype(np.uint8)
