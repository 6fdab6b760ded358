import builtins

import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.evaluation import plots
from jaxloc.poses import Trajectory


@pytest.fixture
def path():
    matrices = np.tile(np.eye(4), (12, 1, 1))
    matrices[:, 0, 3], matrices[:, 2, 3] = 0.1 * np.arange(12.0) ** 2, np.arange(12.0)
    return Trajectory.from_matrices(jnp.arange(12.0), jnp.asarray(matrices))


def drawn(figure):
    """Everything can be drawn; the axes of the figure."""
    figure.draw_without_rendering()
    return figure.axes[0]


def test_the_trajectory_is_drawn_from_above_with_its_ellipses(path):
    covariances = np.tile(np.diag([0.04, 1.0, 0.25, 1.0, 1.0, 1.0]), (12, 1, 1))
    axes = drawn(plots.draw_trajectory(path, path, covariances, num_ellipses=5))
    assert [line.get_label() for line in axes.lines[:2]] == ["truth", "estimate"]
    np.testing.assert_allclose(axes.lines[1].get_xdata(), path.positions[:, 0])
    np.testing.assert_allclose(axes.lines[1].get_ydata(), path.positions[:, 2])
    assert len(axes.patches) == 5
    ellipse = axes.patches[0]
    sizes = sorted((ellipse.get_width(), ellipse.get_height()))
    np.testing.assert_allclose(sizes, 2.0 * 2.4477 * np.array([0.2, 0.5]), rtol=1e-3)
    assert axes.get_aspect() == 1.0


def test_a_long_way_forward_is_drawn_to_the_right(path):
    axes = drawn(plots.draw_trajectory(path, axes=(2, 0)))
    np.testing.assert_allclose(axes.lines[0].get_xdata(), path.positions[:, 0])
    assert axes.get_xlabel() == "x (m)" and axes.yaxis_inverted()


def test_errors_are_drawn_inside_three_sigmas(path):
    covariances = np.tile(0.01 * np.eye(6), (12, 1, 1))
    axes = drawn(plots.draw_ellipses(path, covariances, path))
    assert len(axes.lines) == 3 and len(axes.collections) == 3
    np.testing.assert_allclose(axes.lines[0].get_ydata(), 0.0, atol=1e-6)
    np.testing.assert_allclose(drawn(plots.draw_ellipses(path, covariances)).lines[2].get_ydata(), 0.3)


def test_drift_matches_and_timings_are_drawn(rng):
    axes = drawn(plots.draw_drift(np.arange(5.0), np.ones(5)))
    assert axes.get_xlabel().endswith("(m)")
    places = rng.uniform(0, 30, (6, 2))
    image = rng.integers(0, 255, (30, 60), dtype=np.uint8)
    inlier = np.array([True, True, False, True, False, True])
    axes = drawn(plots.draw_matches(image, places, places + 1.0, inlier))
    labels = [text.get_text() for text in axes.get_legend().get_texts()]
    assert labels == ["agrees (4)", "rejected (2)"]
    drawn(plots.draw_matches(image, places[:0], places[:0], inlier[:0]))
    axes = drawn(plots.draw_timings({"detect": np.array([0.01, 0.02, 0.03]), "solve": np.array([0.001])}))
    np.testing.assert_allclose([bar.get_width() for bar in axes.patches], [1.0, 20.0])


def test_a_missing_matplotlib_is_explained(monkeypatch):
    original = builtins.__import__

    def refuse(name, *args, **kwargs):
        if name.startswith("matplotlib"):
            raise ImportError(name)
        return original(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(ImportError, match=r'pip install "jaxloc\[plot\]"'):
        plots.draw_drift(np.arange(3.0), np.zeros(3))
