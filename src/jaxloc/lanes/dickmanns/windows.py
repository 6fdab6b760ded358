"""Windows along predicted lane borders, sheared to the border's direction, and the sums along it."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Num

from jaxloc._jit import filter_jit
from jaxloc.images.interpolation import Bilinear, sample_components
from jaxloc.images.normalization import as_gray
from jaxloc.lanes.dickmanns.model import RoadState
from jaxloc.poses.lie_group import as_floats
from jaxloc.sensors.ground_camera import GroundCamera


class Windows(eqx.Module):
    """Layout of the measurement windows along the borders.

    Args:
        near: range of the first window, m.
        far: range of the last one, m.
        reach: how far to either side of the prediction, m.
        count: windows along each border; static.
        rows: of samples in a window, along the border; static.
        columns: of samples, across it; static and odd.
    """

    near: Float[Array, ""]
    far: Float[Array, ""]
    reach: Float[Array, ""]
    count: int = eqx.field(static=True)
    rows: int = eqx.field(static=True)
    columns: int = eqx.field(static=True)

    def __init__(
        self, near: Any = 6.0, far: Any = 45.0, reach: Any = 0.9, *, count: int = 12, rows: int = 12, columns: int = 61
    ):
        self.near, self.far, self.reach = as_floats(near, far, reach)
        if count < 2 or rows < 2 or columns < 9 or columns % 2 == 0:
            got = f"count={count}, rows={rows}, columns={columns}"
            raise ValueError(f"Windows got {got}; it needs at least 2, 2 and an odd number of at least 9.")
        self.count, self.rows, self.columns = count, rows, columns

    def ranges(self) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        """Ranges of the middles of all windows (left border first), m, and their lengths along the road, m."""
        steps = jnp.linspace(0.0, 1.0, self.count, dtype=self.near.dtype)
        ratio = self.far / self.near
        ahead = self.near * ratio**steps
        length = ahead * jnp.log(ratio) / (self.count - 1)
        return jnp.tile(ahead, 2), jnp.tile(length, 2)

    def sides(self) -> Float[Array, " n"]:
        """1 for the windows of the left border, -1 for those of the right one."""
        return jnp.repeat(jnp.array([1.0, -1.0], self.near.dtype), self.count)

    def across(self) -> Float[Array, " columns"]:
        """Lateral positions of the samples against the prediction, from left to right, m."""
        return self.reach * jnp.linspace(1.0, -1.0, self.columns, dtype=self.near.dtype)


class ColumnSums(eqx.Module):
    """Gray levels summed along the predicted border.

    Attributes:
        profile: means by window and lateral position, from left to right.
        variance: of a mean, by window.
        seen: whether all of the window is in the image.
    """

    profile: Float[Array, "n columns"]
    variance: Float[Array, " n"]
    seen: Bool[Array, " n"]


@filter_jit
def sum_columns(
    image: Num[Array, "h w"] | Any, ground: GroundCamera, state: RoadState, windows: Windows | None = None
) -> ColumnSums:
    """Sums gray levels along the predicted direction of the borders: what is constant grows, what is random cancels.

    The samples of a window lie on parallels to the predicted border on the ground, so that they follow its direction in
    the image, its bend, and the perspective.

    Args:
        image: gray levels.
        ground: the camera with its mean pitch.
        state: predicted.
        windows: where to read; `Windows()` by default.

    Returns:
        Means instead of sums, and how well each is known: the rows' own means are taken out first, so that a shadow
        across the road is no noise.

    References:
        Dickmanns and Mysliwetz (1992) [K-31], [K-32]: the signal-to-noise ratio grows with the root of the rows.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> dickmanns = jl.lanes.dickmanns
        >>> ground = jl.sensors.GroundCamera(jl.sensors.Pinhole(500.0, 500.0, 320.0, 240.0), height=1.5)
        >>> state = dickmanns.RoadState(jl.lanes.Lane(0.0, 0.0, 0.0))
        >>> sums = dickmanns.sum_columns(jnp.full((480, 640), 9.0), ground, state)
        >>> sums.profile.shape, float(sums.profile[5, 30])
        ((24, 61), 9.0)
    """
    windows = Windows() if windows is None else windows
    pixels = as_gray(image)
    finite = jnp.isfinite(pixels)
    pixels = jnp.where(finite, pixels, 0.0)
    state_camera, (ahead, length) = state.camera(ground), windows.ranges()
    part = (jnp.arange(windows.rows, dtype=ahead.dtype) + 0.5) / windows.rows - 0.5
    x = ahead[:, None] + part[None, :] * length[:, None]
    border = state.border(x, jnp.broadcast_to(windows.sides()[:, None], x.shape))
    y = border[:, :, None] + windows.across()[None, None, :]
    x = jnp.broadcast_to(x[:, :, None], y.shape)
    u, v = (part.ravel().astype(pixels.dtype) for part in state_camera.project_components(x, y))
    values, inside = sample_components(pixels, u, v, method=Bilinear())
    share, _ = sample_components(finite.astype(pixels.dtype), u, v, method=Bilinear())
    seen = (inside & (share > 0.999)).reshape(x.shape) & state_camera.sees_components(x, y)
    return _average(jnp.where(seen, values.reshape(x.shape), 0.0), jnp.all(seen, axis=(1, 2)))


def _average(values: Float[Array, "n rows columns"], seen: Bool[Array, " n"]) -> ColumnSums:
    profile = jnp.mean(values, axis=1)
    level = jnp.mean(values, axis=2, keepdims=True)
    rest = values - level - (profile - jnp.mean(profile, axis=1, keepdims=True))[:, None, :]
    freedom = values.shape[1] * (values.shape[1] - 1) * (values.shape[2] - 1)
    return ColumnSums(profile, jnp.sum(rest**2, axis=(1, 2)) / freedom, seen)
