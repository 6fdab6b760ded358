"""Every tracker with degenerate numbers in every input: states and gradients are finite, `ok` shows it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import degenerate_lanes as lanes
import jaxloc as jl

T, F = jl.tracking, jl.filters


def model(p, static=False):
    filt = F.KalmanFilter(F.ConstantVelocity(p["q"], axes=2), F.LinearSensor(jnp.eye(2, 4), p["R"]))
    places = jl.beliefs.Mixture(p["birth"][None], jnp.zeros((1, 4)), 100.0 * jnp.eye(4)[None])
    birth = T.StaticBirth(places) if static else T.PointBirth(p["birth"], 1e4, jnp.eye(2), jnp.ones(2))
    clutter = T.UniformClutter(p["rate"], 1e4)
    return T.TargetModel(filt, detection=p["detection"], survival=p["survival"], clutter=clutter, birth=birth)


TRACKERS = {
    "GmPhd": lambda p: T.GmPhd(model(p), 6),
    "GmCphd": lambda p: T.GmCphd(T.GmPhd(model(p, static=True), 6), max_targets=6),
    "GlobalNearestNeighbor": lambda p: T.GlobalNearestNeighbor(model(p), 6),
    "ProbabilisticDataAssociation": lambda p: T.ProbabilisticDataAssociation(model(p), 6),
    "JointProbabilisticDataAssociation": lambda p: T.JointProbabilisticDataAssociation(model(p), 6),
    "MultipleHypothesisTracker": lambda p: T.MultipleHypothesisTracker(
        model(p), leaves=12, tracks=4, hypotheses=3, beam=6
    ),
}
BASE = {
    "mean": jnp.array([[1.0, 2.0, 0.3, 0.1]]),
    "cov": jnp.eye(4),
    "q": jnp.array(0.1),
    "R": jnp.eye(2),
    "detection": jnp.array(0.9),
    "survival": jnp.array(0.99),
    "rate": jnp.array(0.1),
    "birth": jnp.array(0.1),
    "dt": jnp.array(1.0),
    "z": jnp.array([[1.2, 2.1], [30.0, 5.0], [0.0, 0.0]]),
    "valid": jnp.array([True, True, False]),
}


def test_every_tracker_is_here():
    assert set(lanes.concrete(T, T.Tracker)) == set(TRACKERS)


@pytest.mark.slow
@pytest.mark.parametrize("name", TRACKERS)
def test_steps(name):
    def step(p):
        tracker = TRACKERS[name](p)
        state = tracker.init(jl.beliefs.Mixture(jnp.array([0.8]), p["mean"], p["cov"][None]))
        state, info = tracker.update(tracker.predict(state, p["dt"]), p["z"], p["valid"])
        state, again = tracker.update(tracker.predict(state, jnp.array(1.0)), BASE["z"], BASE["valid"])
        return (state, info, again, tracker.extract(state)), info.ok & again.ok

    bad = lanes.unusable("R", "survival", "detection") | {"R=-1", "R indefinite", "survival=-1", "detection=-1"}
    bad |= {"rate=nan", "rate=inf", "rate=-1", "survival=1e+07", "detection=1e+07"}
    lanes.check_lanes(step, BASE, unsupported=bad, matrices=("cov", "R"))


@pytest.mark.slow
@pytest.mark.parametrize("name", TRACKERS)
def test_a_sentinel_is_an_absent_measurement(name):
    """One reading of a target with a huge number or NaN: both targets are there some scans later."""
    parameters = BASE | {"q": jnp.array(0.1)}
    tracker = TRACKERS[name](parameters)
    times = jnp.arange(9.0)
    scans = jnp.stack([jnp.stack([times, 0 * times], -1), jnp.stack([30.0 - times, 0 * times + 5.0], -1)], axis=1)

    @jax.jit
    @jax.vmap
    def run(value):
        given = scans.at[4, 0].set(value)
        state = tracker.init(jl.beliefs.Mixture.empty(1, jnp.zeros(4)))
        there = jnp.ones((9, 2), bool)
        _, history = F.run(tracker, state, jnp.ones(9), given, there, keep=lambda s: jnp.sum(tracker.extract(s).valid))
        return history.states, history.infos.ok

    counts, ok = run(jnp.array([jnp.nan, jnp.inf, 1e18, 1e20, 1e30, lanes.LARGEST]))
    assert ok.all()
    np.testing.assert_array_equal(counts[:, -1], 2)


def test_huge_and_nonfinite_measurements_are_absent():
    given = jnp.array([[1.0, 2.0], [jnp.nan, 0.0], [1e20, 1.0], [lanes.LARGEST, 0.0], [3.0, 4.0]])
    usable = T.gating.usable_measurements(given, jnp.ones(5, bool).at[4].set(False))
    assert usable.tolist() == [True, False, False, False, False]
    np.testing.assert_array_equal(T.gating.safe_measurements(given, usable)[1:], 0.0)


@pytest.mark.slow
def test_cphd_has_finite_derivatives_with_empty_slots():
    scans = jnp.array([[[0.0, 0.0], [3.0, 0.0], [7.0, 7.0]]]).repeat(3, axis=0)

    @jax.jit
    @jax.vmap
    def slope(valid):
        def total(rate):
            tracker = TRACKERS["GmCphd"](BASE | {"rate": rate})
            state = tracker.init(jl.beliefs.Mixture.empty(1, jnp.zeros(4)))
            return F.run(tracker, state, jnp.ones(3), scans, valid)[1].infos.log_likelihood.sum()

        near = (total(5.05) - total(4.95)) / 0.1
        return jax.grad(total)(5.0), near

    all_there = jnp.ones((3, 3), bool)
    exact, near = slope(jnp.stack([all_there, all_there.at[1, 2].set(False), all_there.at[:, 1:].set(False)]))
    np.testing.assert_allclose(exact, near, rtol=0.02, atol=2e-3)
