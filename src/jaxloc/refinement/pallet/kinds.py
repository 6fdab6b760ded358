"""Classification of pallets by correlation with rendered templates of the fronts [K-75]."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxloc._arguments import checked
from jaxloc._jit import filter_jit
from jaxloc.images.interpolation import sample
from jaxloc.images.normalization import standardize
from jaxloc.poses import SE2
from jaxloc.refinement.pallet.edges import LevelView
from jaxloc.refinement.pallet.model import PalletType

_ROWS, _COLUMNS = 24, 128
_MARGIN = 1.08  # width of the template over that of the face, to include the background beside it


@filter_jit
@checked
def face_template(kind: PalletType) -> Float[Array, "24 128"]:
    """Template of the front of a pallet: one for wood, zero in the holes and beside the face.

    Example:
        >>> from jaxloc.refinement.pallet import euro_long, face_template
        >>> face_template(euro_long()).shape
        (24, 128)
    """
    along, level = _grid(kind)
    edges, half = kind.edges(), 0.5 * kind.face_width
    in_hole = ((along < edges[0]) & (along > edges[1])) | ((along < edges[2]) & (along > edges[3]))
    open_rows = (level > kind.hole_bottom) & (level < kind.hole_bottom + kind.hole_height)
    wood = (jnp.abs(along) < half)[None, :] & ~(in_hole[None, :] & open_rows[:, None])
    return jnp.where(wood, 1.0, 0.0).astype(kind.hole_width.dtype)


@filter_jit
@checked
def view_face(view: LevelView, kind: PalletType, pose: SE2) -> Float[Array, "24 128"]:
    """The image at the face of a pallet with a given pose, sampled along the face.

    Args:
        view: the image.
        kind: of pallet.
        pose: ``T_ground_pallet``.

    Returns:
        Gray levels, nan where the face is not in the image.
    """
    along, level = _grid(kind)
    rotation = pose.rotation.matrix()
    x, y = (rotation[i, 1] * along + pose.translation[i] for i in range(2))
    in_front = x > 0.05
    x, y = jnp.where(in_front, x, 1.0), jnp.where(in_front, y, 0.0)
    u = jnp.broadcast_to((view.middle[0] - view.focal * y / x)[None, :], (_ROWS, _COLUMNS))
    v = view.rows(*(jnp.broadcast_to(c, u.shape) for c in (level[:, None], x[None, :])))
    read = sample(view.image, jnp.stack([u.reshape(-1), v.reshape(-1)], axis=1))
    visible = (read.inside & jnp.broadcast_to(in_front[None, :], u.shape).reshape(-1)).reshape(u.shape)
    return jnp.where(visible, read.values.reshape(u.shape), jnp.nan)


@filter_jit
@checked
def type_correlation(view: LevelView, kind: PalletType, pose: SE2) -> Float[Array, ""]:
    """Normalized correlation of the image at a pose with the template of a kind.

    Args:
        view: the image.
        kind: of pallet.
        pose: ``T_ground_pallet``.

    Returns:
        In [-1, 1]; zero where less than four fifths of the face is in the image.

    References:
        KELLY 9.2.4.2.2, templates correlated to identify the type [K-75].
    """
    face = view_face(view, kind, pose)
    visible = jnp.isfinite(face)
    template = face_template(kind).astype(face.dtype)
    count = jnp.maximum(jnp.sum(visible), 1).astype(face.dtype)
    a = standardize(jnp.where(visible, face, 0.0), valid=visible)
    b = standardize(template, valid=visible)
    return jnp.where(jnp.mean(visible.astype(face.dtype)) > 0.8, jnp.sum(a * b) / count, 0.0)


@filter_jit
@checked
def correlate_types(view: LevelView, kinds: PalletType, pose: SE2) -> Float[Array, " m"]:
    """`type_correlation` with each kind of a bank at one pose.

    Args:
        view: the image.
        kinds: a stack, as `stack_types` makes it.
        pose: ``T_ground_pallet``.

    Returns:
        One correlation a kind.
    """
    return jax.vmap(lambda kind: type_correlation(view, kind, pose))(kinds)


def stack_types(kinds: tuple[PalletType, ...]) -> PalletType:
    """Kinds of pallets as one record with a leading axis.

    Raises:
        ValueError: there are none.
    """
    if not kinds:
        raise ValueError("No pallet types: give a tuple with at least one.")
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *kinds)


def _grid(kind: PalletType) -> tuple[Float[Array, "128"], Float[Array, "24"]]:
    """Positions along the face, from left to right, and heights, from above."""
    dtype = kind.hole_width.dtype
    right = (jnp.arange(_COLUMNS, dtype=dtype) + 0.5) / _COLUMNS
    down = (jnp.arange(_ROWS, dtype=dtype) + 0.5) / _ROWS
    return _MARGIN * kind.face_width * (0.5 - right), kind.face_height * (1.0 - down)
