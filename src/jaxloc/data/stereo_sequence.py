"""Stereo sequence interface: a rig, time-stamped image pairs and, where known, the true path.

Host code: images are NumPy arrays, read on demand.
"""

from collections.abc import Iterator
from typing import Protocol, runtime_checkable

import equinox as eqx
import numpy as np
from jaxtyping import Float64, UInt8

from jaxloc.poses import Trajectory
from jaxloc.sensors import StereoRig


class StereoFrame(eqx.Module):
    """One pair of rectified grayscale images taken at the same instant.

    Args:
        time: s since the start of the recording.
        left: the left image, 0 to 255.
        right: the right image, of the same size.
    """

    time: float
    left: UInt8[np.ndarray, "h w"]
    right: UInt8[np.ndarray, "h w"]


@runtime_checkable
class StereoSequence(Protocol):
    """Stereo recording, real or simulated, with frames loaded on demand.

    ``truth`` holds the true poses ``T_world_camera`` of the left camera, one a frame, where they are known.
    """

    @property
    def name(self) -> str:
        """A short name for titles and logs."""
        ...

    @property
    def rig(self) -> StereoRig:
        """The rectified pair of cameras."""
        ...

    @property
    def times(self) -> Float64[np.ndarray, " n"]:
        """The stamp of every frame, s since the start of the recording, increasing."""
        ...

    @property
    def truth(self) -> Trajectory | None:
        """The true path of the left camera, where it is known."""
        ...

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> StereoFrame: ...

    def __iter__(self) -> Iterator[StereoFrame]: ...
