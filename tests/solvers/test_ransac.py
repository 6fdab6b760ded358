"""Consensus: K-60 and the worked example K-61."""

from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.poses import SE3
from jaxloc.solvers import Candidates, ransac, required_hypotheses
from jaxloc.solvers.ransac import sample_indices


def line(sample):
    run = sample[1, 0] - sample[0, 0]
    slope = (sample[1, 1] - sample[0, 1]) / jnp.where(run == 0, 1.0, run)
    return {"slope": slope, "offset": sample[0, 1] - slope * sample[0, 0]}


def line_or_flat(sample):
    fitted = line(sample)
    flat = {"slope": jnp.zeros_like(fitted["slope"]), "offset": sample[0, 1]}
    models = jax.tree.map(lambda a, b: jnp.stack([a, b]), fitted, flat)
    return Candidates(models, jnp.array([True, False]))


def distance(model, points):
    return jnp.abs(model["slope"] * points[:, 0] + model["offset"] - points[:, 1])


@pytest.fixture
def points(rng):
    """Forty points, half of them on y = 2 x + 1 with noise of 0.02."""
    x = rng.uniform(-5, 5, 40)
    y = np.where(np.arange(40) < 20, 2 * x + 1 + 0.02 * rng.normal(size=40), rng.uniform(-10, 10, 40))
    return np.stack([x, y], axis=1)


def search(points, seed=0, **changes):
    options = {"sample_size": 2, "threshold": 0.1, "hypotheses": 64, "key": jax.random.key(seed)} | changes
    return ransac(points, options.pop("fit", line), distance, **options)


def test_finds_the_model_among_half_outliers_for_every_seed(points):
    found = [search(jnp.asarray(points, jnp.float32), seed) for seed in range(20)]
    assert sum(abs(float(f.model["slope"]) - 2) < 0.1 and bool(f.ok) for f in found) == 20


def test_score_is_the_best_that_any_pair_of_points_reaches(points):
    """Against all 780 samples, fitted and scored in NumPy."""
    scores = []
    for i, j in combinations(range(40), 2):
        slope = (points[j, 1] - points[i, 1]) / (points[j, 0] - points[i, 0])
        r = np.abs(slope * (points[:, 0] - points[i, 0]) + points[i, 1] - points[:, 1]) / 0.1
        scores.append(np.minimum(r**2, 1).sum())
    found = search(jnp.asarray(points, jnp.float32), hypotheses=4000)
    assert float(found.score) == pytest.approx(min(scores), rel=1e-3)
    model = found.model
    r = np.abs(float(model["slope"]) * points[:, 0] + float(model["offset"]) - points[:, 1])
    assert (np.asarray(found.inliers) == (r < 0.1)).all()


def test_masked_points_are_as_good_as_absent(points):
    short = jnp.asarray(points, jnp.float32)
    padded = jnp.concatenate([short, jnp.full((10, 2), 3.0)])
    alone, among = search(short), search(padded, valid=jnp.arange(50) < 40)
    assert float(alone.score) == pytest.approx(float(among.score), rel=1e-6)
    assert not among.inliers[40:].any()


def test_only_valid_candidates_win(points):
    found = search(jnp.asarray(points, jnp.float32), fit=line_or_flat)
    assert abs(float(found.model["slope"]) - 2) < 0.1


def test_too_few_items_are_no_consensus():
    found = search(jnp.zeros((5, 2)), valid=jnp.array([True, False, False, False, False]))
    assert not found.ok and jnp.isfinite(found.score)
    with pytest.raises(ValueError, match="cannot be drawn"):
        search(jnp.zeros((1, 2)))


def test_samples_hold_distinct_valid_items_uniformly():
    valid = jnp.array([True, False, True, True, False, True, True])
    drawn = np.asarray(sample_indices(jax.random.key(3), valid, 3, 6000))
    assert np.asarray(valid)[drawn].all()
    assert (np.sort(drawn, axis=1)[:, 1:] != np.sort(drawn, axis=1)[:, :-1]).all()
    counts = np.bincount(drawn.ravel(), minlength=7)[np.asarray(valid)] / 6000
    assert np.allclose(counts, 3 / 5, atol=0.03)


def test_worked_example_of_sixteen_features():
    """K-61: 25 % is the chance with replacement; without, it is (8 * 7) / (16 * 15), a mean of 4.29 draws."""
    drawn = np.asarray(sample_indices(jax.random.key(0), jnp.ones(16, bool), 2, 40000))
    clean = (drawn < 8).all(axis=1)
    assert clean.mean() == pytest.approx(8 * 7 / (16 * 15), abs=0.01)
    waits = np.diff(np.flatnonzero(clean))
    assert waits.mean() == pytest.approx(4.286, abs=0.15)


@pytest.mark.parametrize(
    ("size", "count"), [(8, 1177), (7, 588), (6, 293), (5, 146), (4, 72), (3, 35), (2, 17), (1, 7)]
)
def test_required_hypotheses_are_those_of_the_tutorial(size, count):
    """Scaramuzza and Fraundorfer (2011): 1177, 587, 292, 145, 71, 35, 16, 7, there rounded down."""
    assert required_hypotheses(0.5, size) == count


@pytest.mark.parametrize("share", [0.0, 1.5, -0.2])
def test_required_hypotheses_refuse_what_is_no_share(share):
    with pytest.raises(ValueError, match="inlier_fraction"):
        required_hypotheses(share, 2)


def test_models_may_be_poses():
    def translation(sample):
        return SE3(SE3.identity().rotation, sample[0])

    def away(pose, data):
        return jnp.linalg.norm(data - pose.translation[None], axis=1)

    data = jnp.concatenate([jnp.ones((6, 3)), jnp.arange(12.0).reshape(4, 3) * 7])
    found = ransac(data, translation, away, sample_size=1, threshold=0.5, hypotheses=32, key=jax.random.key(1))
    assert found.model.translation.tolist() == [1.0, 1.0, 1.0]
    assert int(found.inliers.sum()) == 6
