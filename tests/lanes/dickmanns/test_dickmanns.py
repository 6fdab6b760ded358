"""Windows, edges, and the clothoid in a filter, against images whose truth is known."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxloc as jl
from jaxloc.beliefs import Gaussian
from jaxloc.data.simulate.road.drive import Course, drive
from jaxloc.data.simulate.road.rendering import Mark, Road, render
from jaxloc.filters import ExtendedKalmanFilter
from jaxloc.lanes.dickmanns import (
    BorderSensor,
    LaneMotion,
    LightStripe,
    Ride,
    RoadState,
    SingleEdge,
    Windows,
    find_edge,
    measure,
    sum_columns,
)
from jaxloc.lanes.lane import Lane

SHAPE = (240, 320)
SIGMAS = np.array([0.3, 0.01, 4e-4, 5e-6, 0.1, 0.005])


def camera(lens=None, roll=0.0):
    pinhole = jl.sensors.Pinhole(250.0, 250.0, 159.5, 100.0, lens=lens)
    return jl.sensors.GroundCamera(pinhole, 1.3, 0.03, roll)


def prior():
    return Gaussian(RoadState(Lane(0.0, 0.0, 0.0)), jnp.diag(jnp.array(SIGMAS**2)))


def stripe(place, columns=61, reach=0.6, width=0.12):
    """Exact means over the samples of a light stripe."""
    left, half = np.linspace(reach, -reach, columns), reach / (columns - 1)
    low, high = np.maximum(left - half, place - width / 2), np.minimum(left + half, place + width / 2)
    return 80.0 + 60.0 * np.maximum(high - low, 0.0) / (2 * half)


@pytest.mark.parametrize("place", [0.0, 0.137, -0.251])
def test_the_middle_of_a_stripe_to_a_fraction_of_a_sample(x64, place):
    edge = find_edge(jnp.array(stripe(place)), jnp.array(1.0), jnp.array(0.6))
    assert float(edge.place) == pytest.approx(place, abs=1e-3) and bool(edge.ok)
    assert float(edge.contrast) == pytest.approx(60.0, rel=0.1)
    dark = find_edge(jnp.array(160.0 - stripe(place)), jnp.array(1.0), jnp.array(0.6))
    assert abs(float(dark.place) - place) > 0.05, "a dark stripe is no mark"
    away = find_edge(jnp.array(stripe(place)), jnp.array(1.0), jnp.array(0.6), within=jnp.array(0.05))
    assert bool(away.ok) == (place == 0.0)


def test_single_edges_have_a_polarity(x64):
    left = np.linspace(0.6, -0.6, 61)
    step = 50.0 + 40.0 * np.clip((0.1 - left) / 0.02 + 0.5, 0.0, 1.0)  # lighter to the right of 0.1
    edge = find_edge(jnp.array(step), jnp.array(1.0), jnp.array(0.6), detector=SingleEdge(rising=True))
    assert float(edge.place) == pytest.approx(0.1, abs=2e-3) and float(edge.contrast) == pytest.approx(40.0, rel=0.05)
    other = find_edge(jnp.array(step), jnp.array(1.0), jnp.array(0.6), detector=SingleEdge(rising=False))
    assert not bool(other.ok) or float(other.contrast) < 1.0


def test_the_variance_of_an_edge_is_that_of_many_noisy_ones(x64, rng):
    profiles = jnp.array(stripe(0.04) + 3.0 * rng.standard_normal((2000, 61)))
    edges = jax.vmap(lambda p: find_edge(p, jnp.array(9.0), jnp.array(0.6)))(profiles)
    assert bool(jnp.all(edges.ok))
    assert float(jnp.var(edges.place)) == pytest.approx(float(jnp.mean(edges.variance)), rel=0.15)


def test_the_signal_to_noise_ratio_grows_with_the_root_of_the_rows(rng):
    """[K-32]: of a flat road with a mark under white noise, by windows of more and more rows."""
    ratio = []
    road = Road(marks=(Mark(1.8, gap=0.0), Mark(-1.8, gap=0.0)), streaks=(), shadows=None, grain=0.0)
    clean = render(road, Lane(0.0, 0.0, 0.0), camera(), shape=SHAPE, noise=0.0)
    image = jnp.asarray(clean + 12.0 * rng.standard_normal(SHAPE).astype(np.float32))
    for rows in (4, 16):
        sums = sum_columns(image, camera(), RoadState(Lane(0.0, 0.0, 0.0)), Windows(6.0, 12.0, 0.6, count=3, rows=rows))
        inner = np.asarray(sums.profile)[:, 25:36] - np.median(np.asarray(sums.profile), axis=1, keepdims=True)
        ratio.append(np.median(inner.max(axis=1) / np.sqrt(np.asarray(sums.variance))))
    assert ratio[1] / ratio[0] == pytest.approx(2.0, rel=0.25)


def test_sums_along_the_edge_are_sharper_than_upright_ones():
    """[K-31]: shearing the window to the border gives a sharper profile than not doing so."""
    image = jnp.asarray(render(Road(shadows=None), Lane(0.0, 0.0, 0.0), camera(), shape=SHAPE))
    states = [RoadState(Lane(0.0, heading, 0.0)) for heading in (0.0, 0.03)]
    peak = [float(jnp.max(sum_columns(image, camera(), s).profile[16])) for s in states]
    assert peak[0] > peak[1]


@pytest.mark.slow
@pytest.mark.parametrize("lens, roll", [(None, 0.0), ((-0.2, 0.03, 0.0, 0.0), 0.02)])
def test_the_sensor_tells_where_borders_cross_rows(x64, lens, roll):
    ground, state = (
        camera(lens and jl.sensors.BrownConrady(lens), roll),
        RoadState(Lane(0.2, 0.01, 1e-3, 1e-5), 3.5, 0.004),
    )
    turned = jl.sensors.GroundCamera(ground.camera, 1.3, 0.034, roll)
    x, sides = jnp.array([7.0, 15.0, 40.0]), jnp.array([1.0, -1.0, 1.0])
    columns, rows = turned.project_components(x, state.border(x, sides))
    sensor = BorderSensor(ground, rows, 1.2 * x, sides, jnp.ones(3))
    np.testing.assert_allclose(sensor.expect(state, columns), columns, atol=1e-5)
    _, jacobian = sensor.linearize(state, columns)
    for i, step in enumerate((1e-5, 1e-6, 1e-8, 1e-9, 1e-5, 1e-7)):
        up, down = (sensor.expect(jl.poses.retract(state, s * step * jnp.eye(6)[i]), columns) for s in (1.0, -1.0))
        np.testing.assert_allclose(jacobian[:, i], (up - down) / (2 * step), rtol=1e-3, atol=1e-4)


def test_the_motion_follows_the_road(x64):
    motion, state = LaneMotion(straighten=1e9), RoadState(Lane(0.1, 0.01, 1e-3, 2e-6), 3.6, 0.002)
    known = motion.move(state, Ride(0.1, 20.0, 0.03))
    expected = state.lane.advance(jnp.array(2.0), jnp.array(0.003))
    np.testing.assert_allclose(jax.tree.leaves(known.lane), jax.tree.leaves(expected))
    unknown = motion.move(state, Ride(0.1, 20.0, 0.5, False))
    assert float(unknown.lane.heading) == pytest.approx(0.01), "it is taken to follow the lane"
    assert 0.0 < float(known.pitch) < 0.002
    covariance = np.asarray(motion.covariance(state, Ride(0.1, 20.0)))
    assert (np.diag(covariance) > 0.0).all() and np.allclose(covariance, np.diag(np.diag(covariance)))


@eqx.filter_jit
def step(state, image, ride, first):
    """An image through the filter."""
    idle = ExtendedKalmanFilter(LaneMotion(), BorderSensor(camera(), *[jnp.zeros(1)] * 4))
    predicted = jax.tree.map(lambda a, b: jnp.where(first, a, b), state, idle.predict(state, ride))
    borders = measure(image, camera(), predicted.gaussian())
    return *ExtendedKalmanFilter(LaneMotion(), borders.sensor).update(
        predicted, borders.columns, borders.found
    ), borders


def start():
    return ExtendedKalmanFilter(LaneMotion(), BorderSensor(camera(), *[jnp.zeros(1)] * 4)).init(prior())


@pytest.mark.slow
def test_the_filter_follows_a_drive():
    trip, state, errors, z = drive(Road(), camera(), 16, course=Course(interval=0.1), shape=SHAPE), start(), [], []
    for index in range(len(trip)):
        rate = float(trip.yaw_rates[index - 1]) if index else 0.0
        state, info, _ = step(state, jnp.asarray(trip.frame(index)), Ride(0.1, 20.0, rate), jnp.array(index == 0))
        assert bool(info.ok)
        found = [float(leaf) for leaf in jax.tree.leaves(state.mean.lane)]
        errors.append(np.abs(np.array(found) - trip.lanes[index])[:3])
        z.append(errors[-1] / np.sqrt(np.diag(state.covariance))[:3])
    assert (np.median(errors[4:], axis=0) < [0.02, 2e-3, 1.5e-4]).all()
    assert np.mean(np.array(z) < 3.0) > 0.95


@pytest.mark.parametrize("level", [0.0, np.nan])
def test_a_night_picture_finds_nothing_and_uncertainty_grows(level):
    before = start()
    state, _, borders = step(before, jnp.full(SHAPE, level, jnp.float32), Ride(0.1, 20.0), jnp.array(False))
    assert not bool(jnp.any(borders.found))
    assert (np.diag(state.covariance)[:2] > np.diag(before.covariance)[:2]).all()
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((state, borders)))


def test_derivatives_by_the_picture(x64):
    image = jnp.asarray(render(Road(shadows=None), Lane(0.1, 0.0, 0.0), camera(), shape=SHAPE), jnp.float64)
    direction = jnp.asarray(np.random.default_rng(1).standard_normal(SHAPE))

    def total(t, base):
        borders = measure(base + t * direction, camera(), prior())
        return jnp.sum(jnp.where(borders.found, borders.columns, 0.0))

    slope = jax.jit(jax.grad(total))(0.0, image)
    assert float(slope) == pytest.approx(float(total(1e-4, image) - total(-1e-4, image)) / 2e-4, rel=1e-3)
    assert np.isfinite(jax.jit(jax.grad(total))(0.0, 0.0 * image))


def test_bad_options_are_refused():
    with pytest.raises(ValueError, match="columns=60"):
        Windows(columns=60)
    assert LightStripe().kernel(jnp.linspace(-0.3, 0.3, 31)).shape == (31,)
