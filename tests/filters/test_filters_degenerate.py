"""Every filter of the room with degenerate numbers in every input: states and gradients are finite, `ok` shows it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import degenerate_lanes as lanes
import jaxloc as jl

F = jl.filters


class Distance(jl.beliefs.Sensor):
    """Distance from the origin, softened there."""

    noise: jax.Array

    def expect(self, state, measurement):
        return jnp.sqrt(jnp.sum(state[:2] ** 2) + 1.0)[None]

    def covariance(self, state, measurement):
        return self.noise[:1, :1]


def velocity(p):
    return F.ConstantVelocity(p["Q"][0, 0], axes=2)


def linear(p):
    return F.LinearSensor(jnp.eye(2, 4), p["R"])


def modes(p):
    noisy = F.LinearMotion(jnp.eye(4), p["Q"])
    return F.InteractingMultipleModel(
        (F.KalmanFilter(velocity(p), linear(p)), F.KalmanFilter(noisy, linear(p))), jnp.array([[0.9, 0.1], [0.1, 0.9]])
    )


GAUSSIAN = {
    "KalmanFilter": lambda p: F.KalmanFilter(velocity(p), linear(p)),
    "ExtendedKalmanFilter": lambda p: F.ExtendedKalmanFilter(velocity(p), Distance(p["R"]), iterations=2),
    "SigmaPointFilter": lambda p: F.SigmaPointFilter(velocity(p), Distance(p["R"])),
    "InformationFilter": lambda p: F.InformationFilter(velocity(p), linear(p)),
    "InteractingMultipleModel": modes,
    "SigmaPointFilter, cubature": lambda p: F.SigmaPointFilter(velocity(p), Distance(p["R"]), F.Cubature()),
    "KalmanFilter, gate": lambda p: F.KalmanFilter(velocity(p), linear(p), gate=0.999),
}
PROPOSALS = {
    "ParticleFilter": F.Bootstrap(),
    "ParticleFilter, guided": F.Guided(),
    "ParticleFilter, auxiliary": F.Auxiliary(),
    "ParticleFilter, auxiliary and guided": F.Auxiliary(guided=True),
}
# Grids hold no numbers but those of their own cells; Monte Carlo localization has a test of its own below.
OTHERS = {"HistogramFilter", "MonteCarloLocalization"}
BASE = {
    "mean": jnp.arange(4.0),
    "cov": jnp.eye(4),
    "dt": jnp.array(0.5),
    "Q": 0.1 * jnp.eye(4),
    "R": 0.2 * jnp.eye(2),
    "z": jnp.array([0.3, 1.2]),
    "valid": jnp.array(True),
}
UNSUPPORTED = lanes.unusable("mean", "cov") | {"cov=-1", "cov indefinite"}
SLOW = {*GAUSSIAN, *PROPOSALS} - {"KalmanFilter, gate"}


def test_every_filter_is_here():
    known = {name.split(",")[0] for name in (*GAUSSIAN, *PROPOSALS)} | OTHERS
    assert set(lanes.concrete(F, F.Filter)) == known


@pytest.mark.parametrize("name", [lanes.marked(name, SLOW) for name in GAUSSIAN])
def test_kalman_family(name):
    def step(p):
        filt = GAUSSIAN[name](p)
        state = filt.predict(filt.init(jl.beliefs.Gaussian(p["mean"], p["cov"])), p["dt"])
        state, info = filt.update(state, p["z"][:1] if "noise" in vars(filters_sensor(filt)) else p["z"], p["valid"])
        found = state.gaussian()
        return (state, info, found.mean, found.covariance), info.ok

    lanes.check_lanes(step, BASE, unsupported=UNSUPPORTED | {f"z={lanes.LARGEST:g}", "z=1e+30"}, matrices=("cov", "R"))


def filters_sensor(filt):
    return getattr(filt, "sensor", None) or filt.filters[0].sensor


@pytest.mark.parametrize("name", [lanes.marked(name, SLOW) for name in PROPOSALS])
def test_particle_filters(name):
    def step(p):
        motion = F.LinearMotion(jnp.eye(4), p["Q"]) if "guided" in name else velocity(p)
        filt = F.ParticleFilter(motion, Distance(p["R"]), PROPOSALS[name], ess_threshold=1.0)
        keys = jax.random.split(jax.random.key(0), 3)
        prior = jl.beliefs.Particles.from_gaussian(jl.beliefs.Gaussian(p["mean"], p["cov"]), 16, key=keys[0])
        state = filt.predict(filt.init(prior), p["dt"], key=keys[1])
        state, info = filt.update(state, p["z"][:1], p["valid"], key=keys[2])
        found = state.particles.gaussian()
        return (state, info, found.mean, found.covariance), info.ok

    bad = {"R=nan", "R=inf", "R=-inf", "R=-1", "z=1e+30", f"z={lanes.LARGEST:g}"}
    lanes.check_lanes(step, BASE, unsupported=UNSUPPORTED | bad, matrices=("cov",))


@pytest.mark.slow
def test_monte_carlo_localization():
    walls = jnp.zeros((40, 60)).at[:, 50].set(1.0).at[30].set(1.0)
    grid = jl.sensors.OccupancyMap(walls, 0.1, jl.poses.SE2.identity())
    sensor, space = jl.sensors.LikelihoodField(jl.sensors.DistanceField.of(grid)), grid.free_space()
    filt = F.MonteCarloLocalization(jl.sensors.OdometryMotion(), sensor, space)
    start = filt.init_globally(50, key=jax.random.key(0))

    @jax.jit
    @jax.vmap
    def step(x):
        state = filt.predict(start, jl.poses.SE2(x, 0.0, 0.0), key=jax.random.key(1))
        return filt.update(state, jl.sensors.LaserScan(jnp.full(30, 2.0), -1.5, 0.1), jnp.ones(30, bool))

    state, info = step(jnp.array([0.1, jnp.nan, jnp.inf, 1e30, lanes.LARGEST, 0.1]))
    assert np.isfinite(state.particles.values.translation).all() and np.isfinite(state.particles.log_weights).all()
    assert np.isfinite(info.place.pose.covariance).all() and bool(info.ok.all())
    np.testing.assert_array_equal(state.particles.values.translation[0], state.particles.values.translation[-1])


def test_information_filter_without_noise():
    """Only rounding is left of the likelihood: it is not reported."""
    motion = F.LinearMotion(jnp.eye(2), 0.1 * jnp.eye(2))
    given = []
    for noise in (1e-10, 0.0):
        filt = F.InformationFilter(motion, F.LinearSensor(jnp.eye(2), noise * jnp.eye(2)))
        state = filt.predict(filt.init(jl.beliefs.Gaussian(jnp.zeros(2), jnp.eye(2))), None)
        given.append(filt.update(state, jnp.array([0.3, 1.0]), jnp.array(True))[1])
    assert [bool(info.ok) for info in given] == [True, False]
    assert float(given[0].log_likelihood) == pytest.approx(
        -np.log(2 * np.pi) - np.log(1.1) - 0.5 * 1.09 / 1.1, abs=1e-3
    )
    assert float(given[1].log_likelihood) == 0.0


def test_an_increment_without_a_number_is_no_motion():
    motion = jl.sensors.IncrementMotion(turn_drive=0.02)
    filt = F.ExtendedKalmanFilter(motion, jl.sensors.RangeBearingSensor(jnp.array([[3.0, 0.0]]), 0.1, 0.03))
    state = filt.init(jl.beliefs.Gaussian(jl.poses.SE2(1.0, 2.0, 0.5), 1e-4 * jnp.eye(3)))
    broken = jl.sensors.Increment(jnp.array(1.0), jl.poses.SE2(0.1, 0.0, jnp.nan))
    moved = filt.predict(state, broken)
    np.testing.assert_allclose(moved.mean.matrix(), state.mean.matrix(), atol=1e-6)
