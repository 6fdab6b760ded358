"""The front end on images whose truth is known: T-11, T-71, T-72."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.beliefs import chi2_quantile
from jaxloc.data import simulate_street
from jaxloc.features import opencv
from jaxloc.odometry import match_frames, match_stereo


@pytest.fixture(scope="module")
def street():
    """Two frames of the synthetic street, four frames apart in truth known to the float."""
    sequence = simulate_street(num_frames=3, seed=3)
    return sequence, [observe(sequence[i]) for i in (0, 1)]


def observe(frame):
    images = (frame.left, frame.right)
    keypoints = tuple(opencv.detect(opencv.ShiTomasi(), image, 600, (6, 10)) for image in images)
    descriptors = tuple(opencv.describe(opencv.ORB(), i, k) for i, k in zip(images, keypoints, strict=True))
    gray = [jnp.asarray(image.astype(np.float32)) for image in images]
    return match_stereo(*gray, keypoints, descriptors)


def test_disparities_are_those_of_the_true_depth(street):
    sequence, (first, _) = street
    depth = np.asarray(sequence.render(0).depth)
    measured, valid = np.asarray(first.measured), np.asarray(first.has_depth)
    pixel = np.round(measured[valid][:, [0, 2]]).astype(int)
    true = float(sequence.rig.camera.fx * sequence.rig.baseline) / depth[pixel[:, 1], pixel[:, 0]]
    error = measured[valid][:, 0] - measured[valid][:, 1] - true
    assert valid.sum() > 100
    assert np.median(np.abs(error)) < 0.15
    assert (np.abs(error) < 1.0).mean() > 0.9


def test_matches_agree_with_the_true_motion_within_their_covariance(street):
    sequence, (first, second) = street
    truth = sequence.truth
    motion = truth[0].inverse() @ truth[1]
    matches = match_frames(sequence.rig, first, second, motion)
    moved = sequence.rig.project(motion.inverse().apply(sequence.rig.triangulate(matches.previous)))
    error = np.asarray(matches.current - moved)[np.asarray(matches.valid)]
    assert len(error) > 60
    assert np.median(np.abs(error)) < 0.3
    # The current measurement's part of the covariance alone covers most of the spread.
    covariance = np.asarray(matches.covariance_current + matches.covariance_previous)[np.asarray(matches.valid)]
    squared = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)
    assert (squared < float(chi2_quantile(0.999, 3))).mean() > 0.75


def test_blank_pictures_give_no_features(street):
    sequence, (first, _) = street
    frame = sequence[0]
    blank = type(frame)(time=0.0, left=np.zeros_like(frame.left), right=np.zeros_like(frame.right))
    nothing = observe(blank)
    assert not nothing.has_depth.any()
    matches = match_frames(sequence.rig, first, nothing, sequence.truth[0])
    assert not matches.valid.any()
    for leaf in (matches.previous, matches.current, matches.covariance_previous, matches.covariance_current):
        assert bool(jnp.all(jnp.isfinite(leaf)))
