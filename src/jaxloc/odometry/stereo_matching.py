"""Front end of stereo odometry: matching between left and right and between frames, with subpixel covariance."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxloc._jit import filter_jit
from jaxloc.features import Descriptors, Keypoints, Matches, subpixel
from jaxloc.features.match import match, row_gate, window_gate
from jaxloc.poses import SE3
from jaxloc.refinement import StereoMatches
from jaxloc.sensors import StereoRig


class MatchingOptions(eqx.Module):
    """Options of stereo and temporal matching.

    Attributes:
        row_tolerance: rows by which a stereo match may be off, px.
        max_disparity: greatest disparity, px.
        max_distance: greatest Hamming distance of ORB descriptors, bits.
        ratio: greatest ratio of the nearest to the second nearest distance.
        window: how far a point may lie from where it is predicted, along each axis, px.
        max_matches: matches between frames that are refined and kept.
        sigma: standard deviation added to that of the patches: rectification, slanted surfaces, px.
        disparity_offset: added to measured disparities, px: what the calibration of the pair left over.
        patches: how patches are refined to subpixels.
    """

    row_tolerance: float = eqx.field(static=True, default=2.0)
    max_disparity: float = eqx.field(static=True, default=160.0)
    max_distance: float = eqx.field(static=True, default=80.0)
    ratio: float = eqx.field(static=True, default=0.95)
    window: float = eqx.field(static=True, default=40.0)
    max_matches: int = eqx.field(static=True, default=800)
    sigma: float = eqx.field(static=True, default=0.15)
    disparity_offset: float = eqx.field(static=True, default=0.0)
    patches: subpixel.PatchRefinement = subpixel.PatchRefinement()


class StereoFeatures(eqx.Module):
    """Features of a stereo frame: keypoints of the left image with their columns in the right one.

    Attributes:
        left: left image, gray levels.
        right: right image.
        descriptors: of the left keypoints.
        measured: (u_left, u_right, v), px; finite also where no stereo match was found.
        variance: of the disparity, px^2.
        has_depth: points with a stereo match.
    """

    left: Float[Array, "h w"]
    right: Float[Array, "h w"]
    descriptors: Descriptors
    measured: Float[Array, "n 3"]
    variance: Float[Array, " n"]
    has_depth: Bool[Array, " n"]


@filter_jit
def match_stereo(
    left: Float[Array, "h w"],
    right: Float[Array, "h w"],
    keypoints: tuple[Keypoints, Keypoints],
    descriptors: tuple[Descriptors, Descriptors],
    *,
    options: MatchingOptions = MatchingOptions(),
) -> StereoFeatures:
    """Matches keypoints of the left image in the right one and refines their columns to subpixels.

    Args:
        left: left image, gray levels.
        right: right image of the rectified pair.
        keypoints: of the left and of the right image.
        descriptors: of both.
        options: what counts as a match.

    Returns:
        The frame's features, one a left keypoint.

    References:
        Thesis sections 4.2 and 4.3: mutual match, row and disparity constraint, error of the set [T-11, T-71, T-72].
    """
    uv_left, uv_right = keypoints[0].uv, keypoints[1].uv
    gate = row_gate(uv_left, uv_right, tolerance=options.row_tolerance, disparity=(0.0, options.max_disparity))
    found = _match(descriptors[0], descriptors[1], gate, options)
    refined = subpixel.refine_stereo(left, right, uv_left, uv_right[found.index], options=options.patches)
    measured = jnp.stack([uv_left[:, 0], refined.uv[:, 0] - options.disparity_offset, uv_left[:, 1]], axis=1)
    has_depth = found.valid & refined.ok & (measured[:, 0] - measured[:, 1] > 0.5)
    variance = refined.variance + options.sigma**2
    return StereoFeatures(left, right, descriptors[0], measured, variance, has_depth)


@filter_jit
def match_frames(
    rig: StereoRig,
    reference: StereoFeatures,
    current: StereoFeatures,
    prediction: SE3,
    *,
    options: MatchingOptions = MatchingOptions(),
) -> StereoMatches:
    """Matches features of a reference frame in the current one and refines them to subpixels.

    A point is defined by its patch in the reference's left image, which is therefore exact there; in the current frame
    its place comes from that patch, and its disparity from the patch there.

    Args:
        rig: the stereo rig.
        reference: features of an earlier frame.
        current: features of this frame.
        prediction: initial value of ``T_reference_current``.
        options: what counts as a match.

    Returns:
        At most ``options.max_matches`` matches, with covariances of both measurements.
    """
    expected = rig.project(prediction.inverse().apply(rig.triangulate(reference.measured)))
    gate = window_gate(expected[:, jnp.array([0, 2])], current.measured[:, jnp.array([0, 2])], radius=options.window)
    found = _match(reference.descriptors, current.descriptors, gate & reference.has_depth[:, None], options)
    # Most slots are empty: only those with a match are refined.
    kept = jnp.argsort(~found.valid, stable=True)[: options.max_matches]
    partner, before = found.index[kept], reference.measured[kept]
    seen, known, expected = current.measured[partner], current.has_depth[partner], expected[kept]
    uv_reference = before[:, jnp.array([0, 2])]
    moved = subpixel.refine_translation(
        reference.left, current.left, uv_reference, seen[:, jnp.array([0, 2])], options=options.patches
    )
    disparity = jnp.where(known, seen[:, 0] - seen[:, 1], expected[:, 0] - expected[:, 1])
    expected = jnp.stack([moved.uv[:, 0] - disparity + options.disparity_offset, moved.uv[:, 1]], axis=1)
    beside = subpixel.refine_stereo(current.left, current.right, moved.uv, expected, options=options.patches)
    measured = jnp.stack([moved.uv[:, 0], beside.uv[:, 0] - options.disparity_offset, moved.uv[:, 1]], axis=1)
    valid = found.valid[kept] & moved.ok & beside.ok & (measured[:, 0] - measured[:, 1] > 0.5)
    return StereoMatches.of(
        before,
        measured,
        _reference_covariance(reference.variance[kept], options),
        _current_covariance(moved.covariance, beside.variance, options),
        valid,
    )


def _match(first: Descriptors, second: Descriptors, gate: Bool[Array, "n m"], options: MatchingOptions) -> Matches:
    return match(first, second, gate=gate, max_distance=options.max_distance, ratio=options.ratio)


def _reference_covariance(variance: Float[Array, " n"], options: MatchingOptions) -> Float[Array, "n 3 3"]:
    """Of (u_left, u_right, v) where the left place is exact but for what no patch shows."""
    own = jnp.full_like(variance, options.sigma**2)
    zero = jnp.zeros_like(variance)
    rows = ((own, own, zero), (own, own + variance, zero), (zero, zero, own))
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def _current_covariance(
    place: Float[Array, "n 2 2"], disparity: Float[Array, " n"], options: MatchingOptions
) -> Float[Array, "n 3 3"]:
    """Of (u_left, u_right, v): an error of the left place moves the right one along with it."""
    uu, uv, vv = place[:, 0, 0] + options.sigma**2, place[:, 0, 1], place[:, 1, 1] + options.sigma**2
    rows = ((uu, uu, uv), (uu, uu + disparity + options.sigma**2, uv), (uv, uv, vv))
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)
