"""Fixed-size sets of keypoints, descriptors and matches."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt8


class Keypoints(eqx.Module):
    """A fixed-size set of interest points of an image; empty slots hold zeros.

    Attributes:
        uv: Pixel coordinates (right, down), centers at integers.
        size: Diameter of the neighborhood, px.
        angle: Orientation in rad, from the right axis towards down; 0 where the detector gives none.
        response: Strength, in units of its detector.
        octave: The detector's own pyramid level (OpenCV's packed form), used by `opencv.describe` only.
        layer: The detector's own class number (KAZE's evolution level), used by `opencv.describe` only.
        valid: False in empty slots.
        detector: Name of the detector; a descriptor of the same name may use octave and layer.
    """

    uv: Float[Array, "n 2"]
    size: Float[Array, " n"]
    angle: Float[Array, " n"]
    response: Float[Array, " n"]
    octave: Int[Array, " n"]
    layer: Int[Array, " n"]
    valid: Bool[Array, " n"]
    detector: str = eqx.field(static=True, default="")

    @classmethod
    def from_uv(
        cls, uv: Float[Array, "n 2"], valid: Bool[Array, " n"] | None = None, *, size: float = 7.0
    ) -> "Keypoints":
        """Keypoints at given pixels, upright and of one size, for example to describe tracked points.

        Example:
            >>> import jax.numpy as jnp
            >>> Keypoints.from_uv(jnp.ones((3, 2))).valid.tolist()
            [True, True, True]
        """
        n = uv.shape[0]
        valid = jnp.ones(n, dtype=bool) if valid is None else valid
        zeros, none = jnp.zeros(n, dtype=uv.dtype), jnp.zeros(n, dtype=jnp.int32)
        return cls(jnp.where(valid[:, None], uv, 0.0), zeros + size, zeros, zeros, none, none, valid)


class Descriptors(eqx.Module):
    """Descriptors in the order of their keypoints.

    Attributes:
        values: One row a keypoint: numbers (compared by Euclidean distance) or packed bits (by Hamming distance);
            zeros where not valid.
        valid: False in empty slots and where the descriptor's neighborhood leaves the image.
    """

    values: Float[Array, "n d"] | UInt8[Array, "n d"]
    valid: Bool[Array, " n"]


class Nearest(eqx.Module):
    """The nearest candidate of each point among the descriptors of another image.

    Attributes:
        index: The candidate; 0 where none is allowed.
        distance: Its distance; 0 where none is allowed.
        second: Distance of the second nearest allowed candidate, infinite where there is none.
        found: True where any candidate is allowed.
    """

    index: Int[Array, " n"]
    distance: Float[Array, " n"]
    second: Float[Array, " n"]
    found: Bool[Array, " n"]


class Matches(eqx.Module):
    """For each point of a first set its match in a second.

    Attributes:
        index: The matched point of the second set; 0 where not valid.
        distance: Distance of the descriptors; 0 where not valid.
        valid: True where the point has a match.
    """

    index: Int[Array, " n"]
    distance: Float[Array, " n"]
    valid: Bool[Array, " n"]
