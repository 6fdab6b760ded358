"""Greedy reduction of mixtures against a plain loop, one component after another."""  # T-83, T-84, T-92

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxloc as jl

PRUNE = 1e-3


def random_mixture(rng, size=30, dim=3):
    """Clusters of components, a few of them light, a few slots empty."""
    centers = rng.normal(scale=4.0, size=(6, dim))
    means = centers[rng.integers(6, size=size)] + rng.normal(scale=0.7, size=(size, dim))
    roots = 0.4 * rng.normal(size=(size, dim, dim))
    weights = rng.uniform(0.01, 1.0, size) * np.where(rng.uniform(size=size) < 0.15, 1e-4, 1.0)
    weights[rng.uniform(size=size) < 0.1] = 0.0
    return weights, means, roots @ roots.swapaxes(-1, -2) + 0.3 * np.eye(dim)


def mahalanobis(means, covariances, i, j):
    delta = means[i] - means[j]
    return delta @ np.linalg.solve(covariances[i], delta)


def kullback_leibler(means, covariances, i, j):
    delta, inverse = means[i] - means[j], np.linalg.inv(covariances[j])
    volumes = np.log(np.linalg.det(covariances[j]) / np.linalg.det(covariances[i]))
    return 0.5 * (np.trace(inverse @ covariances[i]) + delta @ inverse @ delta - len(delta) + volumes)


def greedy(weights, means, covariances, distance, threshold, capacity):
    """Vo and Ma 2006, table II; labels are places."""
    left, parts = [k for k in range(len(weights)) if weights[k] >= PRUNE], []
    while left:
        lead = max(left, key=lambda k: weights[k])
        group = [k for k in left if k == lead or distance(means, covariances, k, lead) <= threshold]
        total = weights[group].sum()
        mean = weights[group] @ means[group] / total
        scatter = sum(
            weights[k] * (covariances[k] + np.outer(means[k] - mean, means[k] - mean)) for k in group
        )  # fmt: skip
        parts.append((total, mean, scatter / total, lead))
        left = [k for k in left if k not in group]
    return sorted(parts, key=lambda part: -part[0])[:capacity], max(len(parts) - capacity, 0)


@eqx.filter_jit
@eqx.filter_vmap(in_axes=(0, None))
def reduce_many(mixture, closeness):
    return jl.beliefs.reduce_mixture(mixture, 12, prune=PRUNE, closeness=closeness)


def stack(parts, labels):
    arrays = (jnp.asarray(np.stack(column)) for column in zip(*parts, strict=True))
    return jl.beliefs.Mixture(*arrays, jnp.tile(jnp.asarray(labels, jnp.int32), (len(parts), 1)))


@pytest.mark.parametrize(
    ("closeness", "distance"),
    [(jl.beliefs.MahalanobisDistance(4.0), mahalanobis), (jl.beliefs.KullbackLeibler(2.0), kullback_leibler)],
    ids=["mahalanobis", "kl"],
)
@pytest.mark.usefixtures("x64")
def test_merging_is_the_greedy_loop(rng, closeness, distance):
    parts = [random_mixture(rng) for _ in range(40)]
    found = reduce_many(stack(parts, np.arange(30)), closeness)
    merged = 0
    for number, (weights, means, covariances) in enumerate(parts):
        expected, crowded = greedy(weights, means, covariances, distance, closeness.threshold, 12)
        count = len(expected)
        mixture = jax.tree.map(lambda leaf, n=number: leaf[n], found.mixture)
        assert int(found.crowded[number]) == crowded and int(jnp.sum(mixture.valid)) == count
        for k, (weight, mean, covariance, lead) in enumerate(expected):
            assert float(mixture.weights[k]) == pytest.approx(weight, abs=1e-12)
            np.testing.assert_allclose(mixture.means[k], mean, atol=1e-10)
            np.testing.assert_allclose(mixture.covariances[k], covariance, atol=1e-10)
            assert int(mixture.labels[k]) == lead
        lost = weights.sum() - sum(part[0] for part in expected)
        assert float(found.lost[number]) == pytest.approx(lost, abs=1e-12)
        merged += np.sum(weights >= PRUNE) - count - crowded
    assert merged > 100


@pytest.mark.usefixtures("x64")
def test_merging_everything_keeps_the_moments(rng):
    weights, means, covariances = random_mixture(rng)
    mixture = jl.beliefs.Mixture(*map(jnp.asarray, (weights, means, covariances)))
    for closeness in (jl.beliefs.MahalanobisDistance(1e9), jl.beliefs.MahalanobisDistance(3.0)):
        found = jl.beliefs.reduce_mixture(mixture, 30, prune=0.0, closeness=closeness)
        before, after = mixture.gaussian(), found.mixture.gaussian()
        assert float(found.mixture.mass) == pytest.approx(weights.sum(), abs=1e-12)
        assert float(found.lost) == pytest.approx(0.0, abs=1e-12)
        np.testing.assert_allclose(after.mean, before.mean, atol=1e-10)
        np.testing.assert_allclose(after.covariance, before.covariance, atol=1e-9)
    one = jl.beliefs.reduce_mixture(mixture, 30, closeness=jl.beliefs.MahalanobisDistance(1e9))
    assert int(jnp.sum(one.mixture.valid)) == 1


def test_empty_slots_are_not_crowded():
    """Also where nothing is pruned."""
    mixture = jl.beliefs.Mixture.empty(5, jnp.zeros(2))
    for prune in (0.0, 1e-5):
        found = jl.beliefs.reduce_mixture(mixture, 2, prune=prune)
        assert int(found.crowded) == 0 and float(found.lost) == 0.0 and not bool(jnp.any(found.mixture.valid))


def test_candidates_and_capacity_are_counted():
    means = 100.0 * jnp.arange(6.0)[:, None]
    mixture = jl.beliefs.Mixture(jnp.array([0.1, 0.6, 0.2, 0.5, 0.3, 1e-7]), means, jnp.ones((6, 1, 1)))
    for candidates, crowded in ((None, 3), (4, 3), (3, 3), (1, 4)):
        found = jl.beliefs.reduce_mixture(mixture, 2, candidates=candidates)
        assert int(found.crowded) == crowded
        kept = 0.6 if candidates == 1 else 1.1
        assert float(found.lost) == pytest.approx(1.7 - kept, abs=1e-6)
        assert found.mixture.capacity == 2
    roomy = jl.beliefs.reduce_mixture(mixture, 9)
    assert roomy.mixture.capacity == 9 and int(jnp.sum(roomy.mixture.valid)) == 5


@pytest.mark.usefixtures("x64")
def test_poses_merge_in_their_tangent_space():
    """Two close poses whose heading wraps are one between them; a far one stays."""
    headings = jnp.array([np.pi - 0.02, -np.pi + 0.04, 0.0])
    poses = jax.vmap(jl.poses.SE2)(jnp.array([1.0, 1.02, 1.0]), jnp.array([2.0, 2.0, 2.0]), headings)
    covariances = jnp.stack([jnp.diag(jnp.array([0.01, 0.04, 0.01]))] * 3)
    mixture = jl.beliefs.Mixture(jnp.array([0.6, 0.3, 0.2]), poses, covariances, jnp.array([7, 8, 9], jnp.int32))
    found = jl.beliefs.reduce_mixture(mixture, 3).mixture
    np.testing.assert_allclose(found.weights, [0.9, 0.2, 0.0], atol=1e-12)
    assert found.labels[:2].tolist() == [7, 9]
    best = jax.tree.map(lambda leaf: leaf[0], found.means)
    middle = jl.poses.SE2(1.0 + 0.02 / 3, 2.0, np.pi)
    np.testing.assert_allclose(jl.poses.local(middle, best), 0.0, atol=2e-4)
    # Two thirds at zero, a third at (-.02, 0, .06): the sign of x is that of the body's frame.
    delta = np.array([-0.02, 0.0, 0.06])
    expected = np.diag([0.01, 0.04, 0.01]) + 2 / 9 * np.outer(delta, delta)
    np.testing.assert_allclose(found.covariances[0], expected, atol=2e-4)
    for closeness in (jl.beliefs.MahalanobisDistance(), jl.beliefs.KullbackLeibler()):
        distances = np.asarray(closeness.distances(mixture))
        assert distances[0, 1] == pytest.approx(
            0.5 ** isinstance(closeness, jl.beliefs.KullbackLeibler) * (0.02**2 / 0.01 + 0.06**2 / 0.01), rel=0.05
        )


@pytest.mark.usefixtures("x64")
def test_gradient_is_that_of_the_moments(rng):
    weights, means, covariances = map(jnp.asarray, random_mixture(rng, 8))

    def value(weights, means, covariances):
        found = jl.beliefs.reduce_mixture(jl.beliefs.Mixture(weights, means, covariances), 6).mixture
        return jnp.sum(jnp.sin(found.means)) + jnp.sum(found.covariances**2) + jnp.sum(found.weights**2)

    program = jax.jit(jax.value_and_grad(value, argnums=(0, 1, 2)))
    gradient = program(weights, means, covariances)[1]
    assert all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in gradient)
    heavy = int(jnp.argmax(weights))
    ends = [program(weights.at[heavy].add(s), means, covariances)[0] for s in (1e-6, -1e-6)]
    assert float(gradient[0][heavy]) == pytest.approx(float(ends[0] - ends[1]) / 2e-6, rel=1e-5)
    ends = [program(weights, means.at[heavy, 0].add(s), covariances)[0] for s in (1e-6, -1e-6)]
    assert float(gradient[1][heavy, 0]) == pytest.approx(float(ends[0] - ends[1]) / 2e-6, rel=1e-5)


@pytest.mark.usefixtures("x64")
def test_many_at_once_are_a_loop(rng):
    closeness = jl.beliefs.MahalanobisDistance(4.0)
    stacked = stack([random_mixture(rng) for _ in range(40)], np.arange(30))
    found = reduce_many(stacked, closeness)
    for number in (0, 3):
        one = jax.tree.map(lambda leaf, n=number: leaf[n], stacked)
        alone = jl.beliefs.reduce_mixture(one, 12, prune=PRUNE, closeness=closeness)
        same = jax.tree.map(lambda a, b, n=number: bool(jnp.allclose(a[n], b, atol=1e-12)), found, alone)
        assert all(jax.tree.leaves(same))
