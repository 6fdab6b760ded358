"""Planar poses on the host."""

import numpy as np
import pytest

from jaxloc.poses.planar import compose_poses, dead_reckon, interpolate_poses, relative_poses


def test_motions_lead_from_pose_to_pose(rng):
    a, b = rng.uniform(-4, 4, (2, 50, 3))
    motions = relative_poses(a, b)
    again = compose_poses(a, motions)
    np.testing.assert_allclose(again[:, :2], b[:, :2], atol=1e-12)
    np.testing.assert_allclose(np.exp(1j * again[:, 2]), np.exp(1j * b[:, 2]), atol=1e-12)
    assert np.abs(motions[:, 2]).max() <= np.pi
    np.testing.assert_allclose(np.hypot(*motions[:, :2].T), np.hypot(*(b - a)[:, :2].T))


def test_dead_reckoning_follows_arcs():
    times, twists = np.array([0.0, 1.0, 3.0]), np.array([[1.0, 0.5], [2.0, -0.3], [0.0, 0.0]])
    at = np.array([-1.0, 0.5, 2.0, 9.0])
    fine = np.arange(0.0, 3.0, 1e-4)
    row = np.searchsorted(times, fine, side="right") - 1
    heading = np.r_[0.0, np.cumsum(twists[row, 1] * 1e-4)]
    x = np.r_[0.0, np.cumsum(twists[row, 0] * np.cos(heading[:-1]) * 1e-4)]
    y = np.r_[0.0, np.cumsum(twists[row, 0] * np.sin(heading[:-1]) * 1e-4)]
    steps = np.clip(np.round(at / 1e-4).astype(int), 0, len(fine))
    expected = np.stack([x[steps], y[steps], heading[steps]], axis=1)
    np.testing.assert_allclose(dead_reckon(times, twists, at), expected, atol=1e-3)


def test_headings_are_interpolated_the_short_way():
    poses = np.array([[0.0, 0.0, 3.1], [2.0, 0.0, -3.1]])
    middle = interpolate_poses(np.array([0.0, 1.0]), poses, np.array([0.5]))[0]
    assert middle[0] == 1.0 and np.cos(middle[2]) == pytest.approx(-1.0)
