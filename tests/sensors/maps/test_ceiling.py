import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from scipy.stats import norm

from jaxloc.poses import SE2
from jaxloc.sensors import CeilingMosaic, CeilingSensor


@pytest.fixture
def mosaic(rng):
    return CeilingMosaic(jnp.asarray(rng.uniform(size=(9, 12)), jnp.float32), 0.5, jnp.array([-1.0, 2.0]))


def test_brightness_equals_scipy(mosaic, rng):
    points = rng.uniform((-1.0, 2.0), (4.5, 6.0), size=(40, 2)).astype(np.float32)
    seen = mosaic.at(jnp.asarray(points))
    coordinates = np.stack([(points[:, 1] - 2.0) / 0.5, (points[:, 0] + 1.0) / 0.5])
    expected = map_coordinates(np.asarray(mosaic.brightness, float), coordinates, order=1, mode="nearest")
    assert np.allclose(seen.values, expected, atol=1e-5) and bool(jnp.all(seen.inside))
    assert np.allclose(mosaic.upper, [4.5, 6.0])


def test_log_density_is_the_mixture(mosaic):
    sensor = CeilingSensor(mosaic, 0.1, outlier=0.05, mount=jnp.array([0.3, -0.2]))
    pose = SE2(1.0, 4.0, 0.7)
    eye = np.array([1.0 + 0.3 * np.cos(0.7) + 0.2 * np.sin(0.7), 4.0 + 0.3 * np.sin(0.7) - 0.2 * np.cos(0.7)])
    mean = float(mosaic.at(jnp.asarray(eye[None], jnp.float32)).values[0])
    assert np.isclose(sensor.expect(pose, jnp.zeros(())), mean, atol=1e-5)
    for reading in (0.0, mean, 0.9):
        found = sensor.log_prob(pose, jnp.asarray(reading, jnp.float32), jnp.array(True))
        assert np.isclose(found, np.log(0.95 * norm.pdf(reading, mean, 0.1) + 0.05), atol=1e-4)


def test_likelihood_peaks_at_the_truth(mosaic):  # of many readings along a path
    sensor = CeilingSensor(mosaic, 0.05)
    path = np.stack([np.linspace(0.0, 3.5, 40), 4.0 + np.sin(np.linspace(0.0, 3.0, 40))], 1).astype(np.float32)
    readings = mosaic.at(jnp.asarray(path)).values

    @jax.jit
    def total(offset):
        def one(point, reading):
            return sensor.log_prob(SE2(point[0] + offset[0], point[1] + offset[1], 0.0), reading, jnp.array(True))

        return jnp.sum(jax.vmap(one)(jnp.asarray(path), readings))

    at = [
        float(total(jnp.array([dx, dy]))) for dx, dy in ((0.0, 0.0), (0.3, 0.0), (-0.3, 0.0), (0.0, 0.3), (0.0, -0.3))
    ]
    assert np.argmax(at) == 0 and at[0] > max(at[1:]) + 20.0


def test_nonfinite_readings_and_places(mosaic):
    sensor = CeilingSensor(mosaic, 0.1)
    there, far = SE2(0.0, 3.0, 0.0), SE2(99.0, 3.0, 0.0)
    yes, no = jnp.array(True), jnp.array(False)
    assert float(sensor.log_prob(there, jnp.array(jnp.nan), yes)) == 0.0
    assert float(sensor.log_prob(there, jnp.array(0.5), no)) == float(sensor.log_prob(far, jnp.array(0.5), no)) == 0.0
    assert float(sensor.log_prob(far, jnp.array(0.5), yes)) == -20.0
    for pose in (there, far, SE2(jnp.nan, 3.0, 0.0)):
        slope = jax.grad(lambda z, p=pose: sensor.log_prob(p, z, yes))(jnp.array(0.5))
        assert bool(jnp.isfinite(slope))
    slope = jax.grad(lambda x: sensor.log_prob(SE2(x, 3.1, 0.0), jnp.array(0.5), yes))(jnp.float32(0.1))
    step = [float(sensor.log_prob(SE2(jnp.float32(x), 3.1, 0.0), jnp.array(0.5), yes)) for x in (0.0, 0.2)]
    assert np.isclose(slope, (step[1] - step[0]) / 0.2, rtol=0.3)


def test_double_precision_stays(x64):
    mosaic = CeilingMosaic(jnp.zeros((3, 3)), 1.0, jnp.zeros(2))
    found = CeilingSensor(mosaic, 0.1).log_prob(SE2(1.0, 1.0, 0.0), jnp.asarray(0.1), jnp.array(True))
    assert found.dtype == np.float64
