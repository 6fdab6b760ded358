"""The GM-PHD filter as a tracker: padding, capacity, labels, clutter rate, gradients, a published scenario."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxloc as jl

F = np.eye(4) + np.eye(4, k=2)
H = np.eye(2, 4)


def cv_noise(q):
    return q * np.kron(np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]]), np.eye(2))


def static_birth(dtype=jnp.float32, weights=(0.1, 0.1)):
    means = jnp.array([[-20.0, 0.0, 0.0, 0.0], [20.0, 10.0, 0.0, 0.0]], dtype)
    covariances = jnp.stack([10.0 * jnp.eye(4, dtype=dtype)] * 2)
    return jl.tracking.StaticBirth(jl.beliefs.Mixture(jnp.array(weights, dtype), means, covariances))


def make_filter(kind="linear", q=0.5, r=1.0, dtype=jnp.float32):
    motion = jl.filters.LinearMotion(jnp.asarray(F, dtype), q * jnp.asarray(cv_noise(1.0), dtype))
    sensor = jl.filters.LinearSensor(jnp.asarray(H, dtype), r**2 * jnp.eye(2, dtype=dtype))
    if kind == "linear":
        return jl.filters.KalmanFilter(motion, sensor)
    if kind == "extended":
        return jl.filters.ExtendedKalmanFilter(motion, sensor)
    return jl.filters.SigmaPointFilter(motion, sensor, jl.filters.Unscented(alpha=1.0, beta=2.0, kappa=2.0))


def make_phd(
    filt=None, *, detection=0.9, survival=0.95, rate=4.0, birth=None, dtype=jnp.float32, capacity=24, **options
):
    model = jl.tracking.TargetModel(
        make_filter(dtype=dtype) if filt is None else filt,
        detection=jnp.asarray(detection, dtype),
        survival=jnp.asarray(survival, dtype),
        clutter=jl.tracking.UniformClutter(jnp.asarray(rate, dtype), jnp.asarray(1e4, dtype)),
        birth=static_birth(dtype) if birth is None else birth,
    )
    return jl.tracking.GmPhd(model, capacity=capacity, **options)


@eqx.filter_jit
def step(phd, state, measurements, valid):
    return phd.update(phd.predict(state, None), measurements, valid)


def some_state(phd, dtype=jnp.float32):
    means = jnp.array([[0.0, 0.0, 1.0, 0.0], [5.0, -5.0, 0.0, 1.0], [-8.0, 4.0, 0.0, 0.0]], dtype)
    covariances = jnp.stack([jnp.eye(4, dtype=dtype)] * 3)
    return phd.init(jl.beliefs.Mixture(jnp.array([0.9, 0.8, 0.3], dtype), means, covariances))


SEEN = np.array([[1.2, 0.3], [5.1, -3.8], [30.0, 30.0], [7.0, 7.0]])


def assert_trees_close(first, second, tolerance):
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=tolerance), first, second)


@pytest.mark.parametrize("kind", ["extended", "unscented"])
@pytest.mark.usefixtures("x64")
def test_other_filters_equal_the_linear_one_on_linear_models(kind):
    found = []
    for name in ("linear", kind):
        phd = make_phd(make_filter(name, dtype=jnp.float64), dtype=jnp.float64)
        found.append(step(phd, some_state(phd, jnp.float64), jnp.asarray(SEEN), jnp.ones(4, bool)))
    assert_trees_close(*found, 1e-8)


def test_nonfinite_values_and_padding_are_absent():
    phd = make_phd()
    state, z = some_state(phd), jnp.asarray(SEEN, jnp.float32)
    masked = step(phd, state, z, jnp.array([True, True, False, False]))
    bad = step(phd, state, z.at[2, 0].set(jnp.nan).at[3].set(jnp.inf), jnp.ones(4, bool))
    assert_trees_close(masked, bad, 0.0)
    short = step(phd, state, z[:2], jnp.ones(2, bool))
    assert_trees_close(masked[0].mixture.weights, short[0].mixture.weights, 1e-6)
    assert_trees_close(masked[0].mixture.means, short[0].mixture.means, 1e-5)
    assert_trees_close(masked[1], short[1], 1e-5)


@pytest.mark.parametrize("shape", [(0, 2), (4, 2)], ids=["no room", "none valid"])
def test_no_detections_leave_the_missed(shape):
    phd = make_phd()
    state = some_state(phd)
    after, info = step(phd, state, jnp.zeros(shape), jnp.zeros(shape[0], bool))
    expected = 0.1 * (0.95 * 2.0 + 0.2)
    assert bool(info.ok) and float(info.count) == pytest.approx(expected, rel=1e-5)
    assert float(info.log_likelihood) == pytest.approx(-(9 * expected + 4.0), rel=1e-5)
    assert float(jnp.max(after.mixture.weights)) == pytest.approx(0.1 * 0.95 * 0.9, rel=1e-5)


@pytest.mark.slow
def test_what_finds_no_room_is_counted():
    """Both what merging leaves over, and what was too light to take part in it."""
    state = some_state(make_phd())
    z = jnp.asarray(np.random.default_rng(3).normal(scale=4.0, size=(12, 2)), jnp.float32)
    apart = jl.beliefs.MahalanobisDistance(0.0)
    everything = make_phd(capacity=200, closeness=apart)
    after, info = step(everything, everything.init(state.mixture), z, jnp.ones(12, bool))
    total = int(jnp.sum(after.mixture.valid))
    assert int(info.crowded) == 0 and total > 24
    for candidates in (None, 200):
        tight = make_phd(capacity=12, closeness=apart, candidates=candidates)
        small = tight.init(jl.beliefs.Mixture(*(leaf[:12] for leaf in jax.tree.leaves(state.mixture))))
        kept, info = step(tight, small, z, jnp.ones(12, bool))
        assert int(info.crowded) == total - 12
        np.testing.assert_allclose(kept.mixture.weights, after.mixture.weights[:12], atol=1e-6)


def test_too_large_a_prior_is_an_error():
    phd = make_phd(capacity=4)
    with pytest.raises(ValueError, match="keeps 4 components; the prior has 5"):
        phd.init(jl.beliefs.Mixture.empty(5, jnp.zeros(4)))


def test_extraction_copies_heavy_components():  # T-82
    means = jnp.arange(20.0).reshape(5, 4)
    covariances = jnp.stack([jnp.eye(4)] * 5)
    labels = jnp.arange(5, dtype=jnp.int32)
    mixture = jl.beliefs.Mixture(jnp.array([2.3, 0.4, 0.51, 0.0, 1.0]), means, covariances, labels)
    phd = make_phd(capacity=5, copies=True)
    found = phd.extract(phd.init(mixture))
    assert found.labels[found.valid].tolist() == [0, 0, 2, 4]
    phd = make_phd(capacity=5)
    once = phd.extract(phd.init(mixture))
    assert once.labels[once.valid].tolist() == [0, 2, 4]
    np.testing.assert_allclose(once.means[once.valid], np.asarray(means)[[0, 2, 4]])


def crossing(rng, scans=40, rate=4.0, detection=0.9):
    """Two targets on crossing lines among clutter: measurements in random order."""
    times = np.arange(float(scans))
    truth = np.stack([np.stack([times - 20, 0.5 * (times - 20)], 1), np.stack([20 - times, times / 2], 1)], axis=1)
    truth += np.array([[0.0, 0.0], [0.0, 4.0]])
    room = 14
    z, valid = rng.uniform(-50, 50, (scans, room, 2)), np.zeros((scans, room), bool)
    z[:, :2] = truth + rng.normal(size=truth.shape)
    valid[:, :2] = rng.uniform(size=(scans, 2)) < detection
    valid[:, 2:] = np.arange(room - 2)[None] < rng.poisson(rate, (scans, 1))
    order = np.argsort(rng.uniform(size=valid.shape), axis=1)
    return truth, np.take_along_axis(z, order[..., None], 1), np.take_along_axis(valid, order, 1)


@pytest.fixture(scope="module")
def tracked():
    truth, z, valid = crossing(np.random.default_rng(5))
    birth = static_birth(weights=(0.05, 0.05))
    phd = make_phd(birth=birth, capacity=40, detection=0.9, survival=0.99)
    prior = jl.beliefs.Mixture.empty(1, jnp.zeros(4))
    args = phd.init(prior), None, jnp.asarray(z, jnp.float32), jnp.asarray(valid)
    state, history = jl.filters.run(phd, *args, keep=lambda state: (phd.extract(state), state.mixture))
    return truth, phd, args, state, history


def test_labels_stay_with_their_targets(tracked):  # T-82
    truth, _, _, _, history = tracked
    targets, mixtures = history.states
    assert bool(jnp.all(history.infos.ok)) and int(jnp.max(history.infos.crowded)) == 0
    seen = [[], []]
    for t in range(6, 40):
        valid = np.asarray(targets.valid[t])
        labels, means = np.asarray(targets.labels[t])[valid], np.asarray(targets.means[t])[valid, :2]
        assert len(set(labels)) == len(labels)
        for k in range(2):
            near = np.linalg.norm(means - truth[t, k], axis=1) if len(means) else np.array([np.inf])
            if near.min() < 4.0:
                seen[k].append(int(labels[near.argmin()]))
    assert min(map(len, seen)) > 26
    assert len(set(seen[0])) == len(set(seen[1])) == 1 and seen[0][0] != seen[1][0]
    heavy = np.asarray(mixtures.weights) > 0.5
    for labels, there in zip(np.asarray(mixtures.labels), heavy, strict=True):
        assert len(set(labels[there])) == there.sum()


def test_run_is_its_steps(tracked):
    _, phd, args, _, history = tracked
    state = args[0]
    for t in range(4):
        state, info = step(phd, state, args[2][t], args[3][t])
    np.testing.assert_allclose(state.mixture.weights, history.states[1].weights[3], atol=1e-5)
    assert float(info.log_likelihood) == pytest.approx(float(history.infos.log_likelihood[3]), abs=1e-3)


def test_many_runs_at_once_are_a_loop(tracked):
    _, phd, (state, _, z, valid), _, history = tracked

    def one(z, valid):
        return jl.filters.run(phd, state, None, z, valid)[1].infos

    found = jax.jit(jax.vmap(one))(jnp.stack([z, z[::-1]]), jnp.stack([valid, valid[::-1]]))
    np.testing.assert_allclose(found.log_likelihood[0], history.infos.log_likelihood, atol=2e-3)
    np.testing.assert_allclose(found.count[0], history.infos.count, atol=2e-3)


@pytest.mark.parametrize("assumed", [2.0, 18.0])
def test_clutter_rate_is_found(assumed):
    rng = np.random.default_rng(8)
    z, valid = rng.uniform(-50, 50, (200, 14, 2)), np.arange(14)[None] < rng.poisson(5.0, (200, 1))
    phd = make_phd(rate=assumed, birth=static_birth(weights=(0.005, 0.005)), capacity=40, clutter_memory=50.0)
    state = phd.init(jl.beliefs.Mixture.empty(1, jnp.zeros(4)))
    state, _ = jl.filters.run(phd, state, None, jnp.asarray(z, jnp.float32), jnp.asarray(valid))
    recent = np.sum(valid * 0.98 ** np.arange(200)[::-1, None]) / np.sum(0.98 ** np.arange(200))
    assert float(state.clutter_scale) * assumed == pytest.approx(recent, rel=0.1)


def likelihood(parameters, z, valid):
    detection, rate, q, r = parameters
    filt = make_filter(q=q, r=r, dtype=jnp.float64)
    phd = make_phd(filt, detection=detection, rate=rate, dtype=jnp.float64, capacity=30, prune=1e-9)
    state = phd.init(jl.beliefs.Mixture.empty(1, jnp.zeros(4)))
    return jnp.sum(jl.filters.run(phd, state, None, z, valid)[1].infos.log_likelihood)


@pytest.mark.slow
@pytest.mark.usefixtures("x64")
def test_likelihood_has_the_gradient_of_finite_differences():
    _, z, valid = crossing(np.random.default_rng(2), scans=12)
    z, valid = jnp.asarray(z), jnp.asarray(valid)
    value = jnp.array([0.85, 5.0, 0.7, 1.2])
    steps = 1e-6 * jnp.concatenate([jnp.zeros((1, 4)), jnp.eye(4), -jnp.eye(4)])
    program = jax.jit(jax.vmap(jax.value_and_grad(likelihood), in_axes=(0, None, None)))
    values, gradients = program(value[None, :] + steps, z, valid)
    for k, slope in enumerate(np.asarray(gradients[0])):
        ends = values[1 + k], values[5 + k]
        numeric = float(ends[0] - ends[1]) / 2e-6
        assert slope == pytest.approx(numeric, rel=1e-3) and abs(slope) > 1e-3, k


def test_gradient_is_finite_where_there_is_nothing():
    def cost(detection):
        phd = make_phd(detection=detection, gate=0.99)
        after, info = phd.update(
            phd.predict(phd.init(jl.beliefs.Mixture.empty(1, jnp.zeros(4))), None),
            jnp.full((3, 2), jnp.nan),
            jnp.ones(3, bool),
        )
        return info.log_likelihood + after.mixture.mass + jnp.sum(after.mixture.covariances)

    assert bool(jnp.isfinite(jax.jit(jax.grad(cost))(jnp.array(0.9))))


@pytest.mark.slow
def test_published_scenario():  # T-74
    """Bounds far wider than those of the benchmark, which runs forty seeds."""
    scenario = jl.data.simulate.targets.LinearScenario(clutter_rate=10.0)
    model = jl.tracking.TargetModel(
        jl.filters.KalmanFilter(scenario.motion, scenario.sensor),
        detection=scenario.detection,
        survival=scenario.survival,
        clutter=jl.tracking.UniformClutter(scenario.clutter_rate, scenario.clutter_volume),
        birth=jl.tracking.StaticBirth(
            jl.beliefs.Mixture(scenario.birth_weights, scenario.birth_means, jnp.stack([scenario.birth_covariance] * 4))
        ),
    )
    phd = jl.tracking.GmPhd(model, capacity=60, gate=0.999, copies=True)

    def one(key):
        drive = jl.data.simulate.targets.simulate_targets(scenario, key=key)
        prior = jl.beliefs.Mixture.empty(1, jnp.zeros(4))
        _, history = jl.filters.run(phd, phd.init(prior), None, drive.measurements, drive.valid, keep=phd.extract)
        found = history.states
        distance = jax.vmap(lambda x, v, y, w: jl.evaluation.targets.ospa(x, v, y, w, cutoff=100.0).distance)
        return jnp.mean(distance(found.means[..., :2], found.valid, drive.truth[..., :2], drive.truth_valid))

    found = jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(0), 4))
    assert 11.0 < float(jnp.mean(found)) < 16.5
