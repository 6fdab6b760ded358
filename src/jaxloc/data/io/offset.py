"""Offsets of frames whose coordinates are too large for the floating-point type, such as those of national grids."""

from collections.abc import Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64

from jaxloc.data.io.errors import DataError

_RESOLUTION = 1e-3  # m; coordinates are held at least so finely where an offset is chosen
_COARSEST = 1e-2  # m; coordinates held more coarsely are refused
_KILOMETER = 1e3


def choose_offset(positions: Float64[np.ndarray, "n d"]) -> Float64[np.ndarray, " d"]:
    """Chooses what to subtract from positions so that JAX's default floating-point type can hold them.

    Args:
        positions: "n d", m, in the order of the path.

    Returns:
        Zero where all positions are held to a millimeter (within 8 km of the origin in single precision); else the
        first position, rounded to whole kilometers, so that files of one place usually have the same offset.

    Example:
        >>> choose_offset(np.array([[448262.1, 5411932.4]])).tolist()
        [448000.0, 5412000.0]
    """
    if not len(positions) or np.abs(positions).max() * _spacing() <= _RESOLUTION:
        return np.zeros(positions.shape[1])
    # Adding zero turns a negative zero into zero.
    return np.round(positions[0] / _KILOMETER) * _KILOMETER + 0.0


def subtract_offset(
    path: Path | str, positions: Float64[np.ndarray, "n d"], offset: Sequence[float] | np.ndarray
) -> Float64[np.ndarray, "n d"]:
    """Positions in a frame at an offset.

    Args:
        path: the file, for the error.
        positions: "n d", m.
        offset: position of the new frame, of the same axes, m.

    Raises:
        DataError: the floating-point type cannot hold a result to a centimeter; the message names an offset that would.
        ValueError: the offset is not a finite vector of that length.
    """
    vector = np.asarray(offset, np.float64)
    if vector.shape != positions.shape[1:] or not np.isfinite(vector).all():
        raise ValueError(f"The offset is {offset}, must be {positions.shape[1]} finite numbers.")
    result = positions - vector
    sizes = np.abs(result).max(axis=1, initial=0.0)
    if sizes.max(initial=0.0) * _spacing() > _COARSEST:
        place = ", ".join(f"{value:.10g}" for value in positions[sizes.argmax()])
        near = ", ".join(f"{value:.10g}" for value in np.round(positions[0] / _KILOMETER) * _KILOMETER)
        text = f"position ({place}) m is too large to be held to a centimeter: read it with an offset such as ({near})"
        raise DataError(path, f"{text}, or set jax_enable_x64")
    return result


def _spacing() -> float:
    """Distance of neighboring numbers about one."""
    return float(jnp.finfo(jnp.result_type(float)).eps)
