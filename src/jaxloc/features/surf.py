"""SURF features: blobs by box filters, orientations and descriptors by Haar wavelets, in JAX.

All filters use one integral image. OpenCV's standard wheel has no SURF.

References:
    Bay, Ess, Tuytelaars, Van Gool, "Speeded-up robust features (SURF)", CVIU 2008.
"""

from functools import partial

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxloc._jit import filter_jit
from jaxloc.features.keypoints import Descriptors, Keypoints
from jaxloc.features.scale_space.box_hessian import box_hessian, filter_scale, filter_sizes, max_octaves
from jaxloc.features.scale_space.extrema import ExtremumTest, find_extrema
from jaxloc.features.scale_space.orientation import disc_offsets, dominant_direction, normalize_rows, rotate_gradients
from jaxloc.features.scale_space.sampling import oriented_grid
from jaxloc.images.integral import filter_boxes

# In scales of the keypoint: radius of the orientation's neighborhood, standard deviation of its Gaussian; samples and
# cells along a side of the descriptor, standard deviation of its Gaussian.
_RADIUS, _SIGMA = 6, 2.0
_SAMPLES, _CELLS, _WINDOW = 20, 4, 3.3


class Surf(eqx.Module):
    """Options of SURF.

    Attributes:
        octaves: greatest number of octaves; fewer in small images.
        least_response: threshold of the determinant, as a fraction of 255^2.
        upright: orientation zero for all keypoints: for cameras that do not roll.
    """

    octaves: int = eqx.field(static=True, default=4)
    least_response: float = eqx.field(static=True, default=4e-4)
    upright: bool = eqx.field(static=True, default=False)


@filter_jit
def surf(image: Float[Array, "h w"], *, options: Surf = Surf(), capacity: int = 1000) -> tuple[Keypoints, Descriptors]:
    """SURF keypoints with scale, orientation and sign of the Laplacian, and their descriptors.

    Args:
        image: gray levels 0-255.
        options: octaves and thresholds.
        capacity: greatest number of keypoints, the strongest first.

    Returns:
        Keypoints (``size`` is the side of the box filter, 7.5 scales, and ``layer`` the sign of the Laplacian: 1 on
        dark blobs, -1 on bright ones; both as in OpenCV) and their descriptors of length one.

    References:
        Bay et al. 2008; thesis section 2.2.2 [T-36...T-40].

    Example:
        >>> import jax.numpy as jnp
        >>> u, v = jnp.meshgrid(jnp.arange(80.0), jnp.arange(80.0))
        >>> image = 60 + 120 * jnp.exp(-((u - 40.3) ** 2 + 1.3 * (v - 37.6) ** 2) / 18)
        >>> keypoints, descriptors = surf(image, capacity=4)
        >>> [round(float(x), 1) for x in keypoints.uv[0]], int(keypoints.layer[0]), descriptors.values.shape
        ([40.3, 37.6], -1, (4, 64))
    """
    image = jnp.where(jnp.isfinite(image), image, 0.0)
    uv, size, value, sign, valid = _strongest(image, options, capacity)
    angle = jnp.zeros_like(size)
    if not options.upright:
        direction = dominant_direction(*_haar_responses(image, uv, jnp.where(valid, filter_scale(size), 1.0)))
        angle = jnp.where(valid & direction.ok, direction.angle, 0.0)
    none = jnp.zeros(valid.shape, jnp.int32)
    keypoints = Keypoints(uv, size, angle, value, none, sign, valid, "surf")
    return keypoints, _describe(image, keypoints)


@filter_jit
def describe_surf(image: Float[Array, "h w"], keypoints: Keypoints) -> Descriptors:
    """SURF descriptors of given keypoints with size and orientation.

    Haar responses on a grid of 20 x 20 samples, rotated and scaled with the keypoint, under a Gaussian, are summed in
    4 x 4 cells: ``sum d_u, sum d_v, sum |d_u|, sum |d_v|``.

    Args:
        image: gray levels.
        keypoints: `size` is 7.5 times the scale, the distance of two samples.

    Returns:
        64 numbers a keypoint, of length one; zero where not valid.

    References:
        Bay et al. 2008, section 4.2; thesis eq. 2.41 [T-39].

    Example:
        >>> import jax, jax.numpy as jnp
        >>> image = jax.random.uniform(jax.random.key(0), (64, 64), maxval=255.0)
        >>> found = describe_surf(image, Keypoints.from_uv(jnp.array([[30.0, 30.0]]), size=15.0))
        >>> found.values.shape, round(float(jnp.linalg.norm(found.values)), 3)
        ((1, 64), 1.0)
    """
    return _describe(jnp.where(jnp.isfinite(image), image, 0.0), keypoints)


@filter_jit
def laplacian_gate(first: Keypoints, second: Keypoints) -> Bool[Array, "n m"]:
    """Pairs of SURF keypoints whose signs of the Laplacian agree: both dark on bright, or both bright on dark.

    The sign is known from detection, so that about half of all candidates are excluded at no cost.

    Args:
        first: keypoints of `surf`.
        second: keypoints of `surf`.

    Returns:
        True where the pair may match: the `gate` of `features.match.match`.

    References:
        Bay et al. 2008, section 4.3 [T-40].

    Example:
        >>> import equinox as eqx, jax.numpy as jnp
        >>> points = Keypoints.from_uv(jnp.ones((2, 2)))
        >>> signed = eqx.tree_at(lambda k: k.layer, points, jnp.array([1, -1], jnp.int32))
        >>> laplacian_gate(signed, signed).tolist()
        [[True, False], [False, True]]
    """
    return first.layer[:, None] == second.layer[None, :]


def _strongest(image: Array, options: Surf, capacity: int) -> tuple[Array, Array, Array, Array, Array]:
    """Positions, sizes, responses, signs of the Laplacian and validity of the strongest blobs of all octaves."""
    least, parts = 255.0**2 * options.least_response, []
    for octave in range(max_octaves(image.shape, options.octaves)):
        found = box_hessian(image, octave=octave)
        # The largest filter lies within the image; a ridge of the determinant is no edge of the image.
        sizes = filter_sizes(octave)
        border = sizes[-1] // (2 * found.step) + 1
        test = ExtremumTest(least, edge_ratio=1e6, border=border, minima=False)
        blobs = find_extrema(found.determinant, test, capacity=capacity)
        at = jnp.round(lax.stop_gradient(blobs.place)).astype(jnp.int32)
        sign = jnp.where(found.trace[at[:, 0], at[:, 1], at[:, 2]] > 0, 1, -1).astype(jnp.int32)
        size = sizes[0] + (sizes[1] - sizes[0]) * blobs.place[:, 0]
        parts.append((found.step * blobs.place[:, :0:-1], size, blobs.value, sign, blobs.valid))
    uv, size, value, sign, valid = (jnp.concatenate(column) for column in zip(*parts, strict=True))
    _, best = lax.top_k(lax.stop_gradient(jnp.where(valid, value, -1.0)), capacity)
    valid, sign = valid[best], jnp.where(valid, sign, 0)[best]
    return uv[best], jnp.where(valid, size[best], 0.0), value[best], sign, valid


def _haar_responses(image: Array, uv: Float[Array, "n 2"], scale: Float[Array, " n"]) -> tuple[Array, Array]:
    """Haar responses on a disc of six scales about each keypoint, under a Gaussian."""
    columns, rows = (np.array(side) for side in disc_offsets(_RADIUS))
    weight = jnp.asarray(np.exp(-0.5 * (columns**2 + rows**2) / _SIGMA**2), scale.dtype)[None, :]
    across, down = (jnp.asarray(side, scale.dtype)[None, :] * scale[:, None] for side in (columns, rows))
    right, lower = _haar(image, uv[:, :1] + across, uv[:, 1:] + down, 2.0 * scale)
    return weight * right, weight * lower


def _describe(image: Array, keypoints: Keypoints) -> Descriptors:
    scale = jnp.where(keypoints.valid, jnp.maximum(filter_scale(keypoints.size), 0.5), 1.0)
    side = np.arange(_SAMPLES) - 0.5 * (_SAMPLES - 1)
    rows, columns = (axis.reshape(-1) for axis in np.meshgrid(side, side, indexing="ij"))
    u, v = oriented_grid(keypoints.uv, keypoints.angle, scale, columns, rows)
    along, across = rotate_gradients(*_haar(image, u, v, scale), keypoints.angle)
    window = jnp.asarray(np.exp(-0.5 * (columns**2 + rows**2) / _WINDOW**2), scale.dtype)[None, :]
    along, across = window * along, window * across
    cell = np.arange(_SAMPLES) // (_SAMPLES // _CELLS)
    member = (cell[:, None] == np.arange(_CELLS)[None, :]).astype(float)
    cells = jnp.asarray(np.kron(member, member), scale.dtype)
    sums = [part @ cells for part in (along, across, jnp.abs(along), jnp.abs(across))]
    values = normalize_rows(jnp.stack(sums, axis=2).reshape(len(scale), -1))
    valid = keypoints.valid & (jnp.sum(sums[2] + sums[3], axis=1) > 0)
    return Descriptors(jnp.where(valid[:, None], values, 0.0), valid)


def _haar(image: Array, u: Float[Array, "n k"], v: Float[Array, "n k"], half: Float[Array, " n"]) -> tuple:
    """Haar wavelets: differences of the halves of a square, right less left and lower less upper; zero outside.

    The width is a whole number of pixels; between whole pixels the responses are interpolated.
    """
    height, width = image.shape
    reach = jnp.clip(jnp.round(lax.stop_gradient(half)), 1.0, 0.5 * min(height, width)).astype(jnp.int32)[:, None]
    # Entry i of the integral image is the edge before pixel i.
    column, row = jnp.floor(lax.stop_gradient(u) + 0.5), jnp.floor(lax.stop_gradient(v) + 0.5)
    part_u, part_v = u + 0.5 - column, v + 0.5 - row
    column, row = column.astype(jnp.int32), row.astype(jnp.int32)
    inside = (column >= reach) & (row >= reach) & (column + reach < width) & (row + reach < height)
    column, row = jnp.where(inside, column, reach), jnp.where(inside, row, reach)
    read = partial(_differences, width=width)
    right, down = filter_boxes(read, min(height, width) ** 2, image, row * width + column, reach)
    shares = jnp.stack(
        [(1.0 - part_v) * (1.0 - part_u), (1.0 - part_v) * part_u, part_v * (1.0 - part_u), part_v * part_u], axis=2
    )
    shares = jnp.where(inside[:, :, None], shares, 0.0)
    area = (2 * reach * reach).astype(u.dtype)
    return jnp.sum(right * shares, axis=2) / area, jnp.sum(down * shares, axis=2) / area


def _differences(
    sums: Array, middle: Int[Array, "n k"], reach: Int[Array, "n 1"], *, width: int
) -> tuple[Array, Array]:
    """Haar sums about four neighboring places, gathered as rows of four numbers."""
    four = jnp.stack([sums[:-1, :-1], sums[:-1, 1:], sums[1:, :-1], sums[1:, 1:]], axis=2).reshape(-1, 4)
    corner = {(a, b): four[middle + (a * width + b) * reach] for a in (-1, 0, 1) for b in (-1, 0, 1) if a or b}
    left, middle, right = (corner[1, b] - corner[-1, b] for b in (-1, 0, 1))
    above, center, below = (corner[a, 1] - corner[a, -1] for a in (-1, 0, 1))
    return right + left - 2 * middle, below + above - 2 * center
