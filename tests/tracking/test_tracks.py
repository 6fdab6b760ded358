"""The track table: its logic, its room, and births of both kinds."""  # T-58, T-59

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

import jaxloc as jl
from jaxloc.tracking import likelihood_ratio, tracks


def make_model(birth=None, detection=0.9):
    eye = jnp.eye(2)
    filt = jl.filters.KalmanFilter(
        jl.filters.ConstantVelocity(0.1, axes=2), jl.filters.LinearSensor(jnp.eye(2, 4), 4.0 * eye)
    )
    birth = jl.tracking.PointBirth(0.2, 1e4, 4.0 * eye, jnp.ones(2)) if birth is None else birth
    clutter = jl.tracking.UniformClutter(2.0, 1e4)
    return jl.tracking.TargetModel(filt, detection=detection, survival=0.98, clutter=clutter, birth=birth)


def make_prior(weights):
    num = len(weights)
    means = jnp.arange(4.0 * num).reshape(num, 4)
    return jl.beliefs.Mixture(jnp.array(weights), means, jnp.stack([jnp.eye(4)] * num))


def table(existence, *, history=None, age=None, confirmed=None, capacity=None):
    """A table with given evidence."""
    num = len(existence)
    opened = tracks.open_tracks(make_model(), num, make_prior(existence), jl.tracking.ExistenceLogic(confirm=2.0))
    fields = {"history": history, "age": age, "confirmed": confirmed}
    for name, value in fields.items():
        if value is not None:
            opened = eqx.tree_at(lambda t, name=name: getattr(t, name), opened, jnp.asarray(value))
    return opened


def test_opening_fills_slots_and_numbers_tracks():
    opened = tracks.open_tracks(make_model(), 5, make_prior([0.95, 0.0, 1.5]), jl.tracking.ExistenceLogic())
    np.testing.assert_allclose(opened.existence, [0.95, 0.0, 1.0, 0.0, 0.0])
    assert opened.labels.tolist() == [0, -1, 1, -1, -1] and int(opened.num_labels) == 2
    assert opened.confirmed.tolist() == [True, False, True, False, False]
    np.testing.assert_allclose(opened.means()[2], [8.0, 9.0, 10.0, 11.0])


def test_opening_says_what_it_needs():
    logic = jl.tracking.ExistenceLogic()
    with pytest.raises(ValueError, match="example of a state"):
        tracks.open_tracks(make_model(), 5, None, logic)
    with pytest.raises(ValueError, match="2 slots"):
        tracks.open_tracks(make_model(), 2, make_prior([1.0, 1.0, 1.0]), logic)
    births = jl.tracking.StaticBirth(make_prior([0.1, 0.2]))
    assert tracks.open_tracks(make_model(births), 5, None, logic).existence.tolist() == [0.0] * 5


def test_prediction_moves_tracks_and_lets_some_leave():
    model, before = make_model(), table([1.0, 0.5])
    after = tracks.predict_tracks(model, before, jnp.array(2.0))
    np.testing.assert_allclose(after.existence, [0.98, 0.49], rtol=1e-6)
    mean = before.means()
    np.testing.assert_allclose(after.means()[:, :2], mean[:, :2] + 2.0 * mean[:, 2:], rtol=1e-6)
    assert int(after.step) == 1


def test_missed_detection_is_bayes_rule():
    r, p = np.random.default_rng(0).uniform(size=(2, 20))
    expected = r * (1 - p) / (r * (1 - p) + 1 - r)
    np.testing.assert_allclose(tracks.miss(jnp.asarray(r, jnp.float32), jnp.asarray(p, jnp.float32)), expected, 1e-4)
    assert float(tracks.miss(jnp.ones(1), jnp.ones(1))[0]) == 0.0


def test_existence_logic_confirms_and_deletes():
    logic = jl.tracking.ExistenceLogic(confirm=0.9, delete=0.01, report=0.5)
    many = table([0.95, 0.4, 0.005, 0.0], confirmed=[True, True, False, False])
    assert logic.confirms(many).tolist() == [True, False, False, False]
    assert logic.keeps(many).tolist() == [True, True, False, False]
    assert logic.reports(many).tolist() == [True, False, False, False]


def test_history_logic_confirms_and_deletes():
    logic = jl.tracking.HistoryLogic(hits=2, scans=3, misses=2)
    history, age = [0b101, 0b1001, 0b1, 0b100, 0b110, 0b10], [3, 4, 1, 9, 9, 2]
    many = table([0.5] * 6, history=history, age=age, confirmed=[False, False, False, True, True, False])
    assert logic.confirms(many).tolist() == [True, False, False, False, True, False]
    # Failed its probation; on probation; lost; still there; on probation.
    assert logic.keeps(many).tolist() == [True, False, True, False, True, True]
    with pytest.raises(ValueError, match="hits=4"):
        jl.tracking.HistoryLogic(hits=4, scans=3)


def test_ageing_shifts_bits():
    old = table([0.5, 0.5, 0.0], history=[0b1, 2**31 - 1, 0], age=[1, 40, 0])
    new = tracks.age_tracks(old, old.states, jnp.array([0.6, 0.3, 0.7]), jnp.array([True, False, True]))
    assert new.history.tolist()[:2] == [0b11, 2**31 - 2] and new.age.tolist()[:2] == [2, 41]
    np.testing.assert_allclose(new.existence, [0.6, 0.3, 0.0])


def test_full_table_keeps_the_strongest():
    logic = jl.tracking.ExistenceLogic(confirm=0.9, delete=0.01)
    old = table([0.6, 0.05, 0.3], confirmed=[False, True, False])
    states = jax.tree.map(lambda leaf: leaf[:2], old.states)
    new, crowded = tracks.manage_tracks(old, states, jnp.array([0.95, 0.2]), logic)
    # Confirmed ones come first, however weak; two of five find no room.
    assert int(crowded) == 2
    assert sorted(new.labels.tolist()) == [0, 1, 3] and int(new.num_labels) == 4
    np.testing.assert_allclose(np.sort(new.existence), [0.05, 0.6, 0.95], rtol=1e-6)
    none, crowded = tracks.manage_tracks(table([0.005] * 3), states, jnp.zeros(2), logic)
    assert int(crowded) == 0 and none.labels.tolist() == [-1] * 3 and not none.valid.any()


def test_births_from_a_mixture_against_scipy():
    births = jl.tracking.StaticBirth(make_prior([0.1, 0.3]))
    model = make_model(births)
    z = np.array([[0.5, 1.0], [4.0, 6.0], [40.0, 60.0]])
    newborn = eqx.filter_jit(likelihood_ratio.initiate)(
        model, table([0.0]), jnp.asarray(z, jnp.float32), jnp.array([True, True, False])
    )
    means, cov = np.asarray(births.intensity.means), 5.0 * np.eye(2)
    terms = np.array(
        [[w * 0.9 * multivariate_normal.pdf(p, m[:2], cov) for p in z] for w, m in zip([0.1, 0.3], means, strict=True)]
    )
    np.testing.assert_allclose(newborn.log_intensity[:2], np.log(terms.sum(axis=0))[:2], rtol=1e-4)
    assert float(newborn.log_intensity[2]) == -np.inf
    np.testing.assert_allclose(newborn.states.mean[:2, :2], means[:2, :2] + (z[:2] - means[:2, :2]) / 5.0, rtol=1e-5)
    assert float(newborn.expected) == pytest.approx(0.36, rel=1e-5)


def test_births_from_measurements_and_none():
    z, there = jnp.ones((2, 2)), jnp.array([True, False])
    newborn = eqx.filter_jit(likelihood_ratio.initiate)(make_model(), table([0.0]), z, there)
    assert float(newborn.log_intensity[0]) == pytest.approx(np.log(0.2 / 1e4), rel=1e-5)
    assert newborn.log_intensity[1] == -jnp.inf and float(newborn.expected) == pytest.approx(0.2)
    np.testing.assert_allclose(newborn.states.mean[0], [1.0, 1.0, 0.0, 0.0])
    none = eqx.filter_jit(likelihood_ratio.initiate)(make_model(jl.tracking.Birth()), table([0.0]), z, there)
    assert jnp.all(none.log_intensity == -jnp.inf) and float(none.expected) == 0.0


def test_odds_against_scipy():
    model, before = make_model(), table([0.8, 0.0])
    z = np.array([[1.0, 0.0], [np.nan, 0.0], [500.0, 0.0]], np.float32)
    seen = eqx.filter_jit(likelihood_ratio.compare_scan)(model, before, jnp.asarray(z), jnp.ones(3, bool), 0.999)
    assert seen.valid.tolist() == [True, False, True]
    density = multivariate_normal.pdf(z[0], before.means()[0, :2], 5.0 * np.eye(2))
    expected = np.log(0.8 * 0.9 * density / (2.2 / 1e4))
    assert float(seen.log_odds[0, 0]) == pytest.approx(expected, rel=1e-4)
    assert jnp.all(seen.log_odds[0, 1:] == -jnp.inf) and jnp.all(seen.log_odds[1] == -jnp.inf)
    np.testing.assert_allclose(np.exp(seen.log_missed), [0.28, 1.0], rtol=1e-5)
    np.testing.assert_allclose(seen.share, [0.2 / 2.2, 0.0, 0.2 / 2.2], rtol=1e-4)
    assert float(seen.base) == pytest.approx(2 * np.log(2.2 / 1e4) - 2.2, rel=1e-5)
