"""Table of tracks: one row for each confirmed track and frame.

``frame,id,x,y,z,vx,vy,vz,var_x,var_y,var_z,u,v``: position (m) and velocity (m/s) in the world, the frame of the first
camera, variances of the position (m^2), and the position in the left image (px). Of boxes in images x and y are the
center of the box in px, and z, vz and var_z are empty; u and v are empty where they are not known.
"""

from collections.abc import Sequence

import numpy as np

HEADER = "frame,id,x,y,z,vx,vy,vz,var_x,var_y,var_z,u,v"


def format_track(
    frame: int,
    identity: int,
    position: Sequence[float] | np.ndarray,
    velocity: Sequence[float] | np.ndarray,
    variances: Sequence[float] | np.ndarray,
    uv: Sequence[float] | np.ndarray = (),
) -> str:
    """Formats a row of the table.

    Args:
        frame: number of the frame.
        identity: number of the track.
        position: 3 numbers in the world, or 2 in the image.
        velocity: as many.
        variances: of the position, as many.
        uv: position in the image; empty where not known.

    Returns:
        The row, without the end of the line.

    Raises:
        ValueError: a vector has another number of entries.

    Example:
        >>> format_track(3, 1, [1.0, 2.0, 30.0], [0.0, 0.0, -5.0], [0.01, 0.01, 0.25], [320.0, 240.5])
        '3,1,1,2,30,0,0,-5,0.01,0.01,0.25,320,240.5'
        >>> format_track(3, 1, [1.0, 2.0], [0.0, 0.5], [4.0, 4.0])
        '3,1,1,2,,0,0.5,,4,4,,,'
    """
    size = len(position)
    if size not in (2, 3) or len(velocity) != size or len(variances) != size or len(uv) not in (0, 2):
        lengths = [len(values) for values in (position, velocity, variances, uv)]
        raise ValueError(f"Give 3 (or 2) numbers of position, velocity and variances, and 2 or no pixels: {lengths}")
    words = [str(frame), str(identity)]
    # Six digits, but a millimeter of coordinates of a kilometer and more.
    texts = [[f"{value:.3f}" if abs(value) >= 1000.0 else f"{value:.6g}" for value in position]]
    texts += [[f"{value:.6g}" for value in values] for values in (velocity, variances)]
    for text in texts:
        words += text + [""] * (3 - size)
    return ",".join([*words, *([f"{value:.6g}" for value in uv] or ["", ""])])
