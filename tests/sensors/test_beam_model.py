"""The beam model: derivatives of expected ranges, a density that sums to one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate

from jaxloc.poses import SE2
from jaxloc.sensors import BeamModel, LaserScan


def test_expected_ranges_have_the_derivatives_of_the_walls(x64, make_field):
    # Facing a flat wall at 30 degrees: d range / d x = -1 / cos for the beam, and so on.
    field = make_field(jnp.float64, ceiling=5.0)
    sensor = BeamModel(field)
    angle = jnp.pi / 6
    scan = LaserScan(jnp.ones(1), 0.0, 0.1)
    pose = SE2(jnp.asarray(4.0), 2.0, angle)
    expected, jacobian = jax.jit(lambda pose: sensor.linearize(pose, scan))(pose)
    length = (5.8 - 4.0) / np.cos(angle)
    assert float(expected.ranges[0]) == pytest.approx(length, abs=2e-3)
    # Right tangent: forward shortens the range by one; sideways by tan; turning by range times tan.
    np.testing.assert_allclose(jacobian[0], [-1.0, np.tan(angle), length * np.tan(angle)], atol=2e-2)


def test_the_beam_density_sums_to_one(make_field):
    sensor = BeamModel(make_field(ceiling=5.0), max_range=5.0, sigma=0.05)
    pose = SE2(3.0, 2.0, 0.0)

    @jax.jit
    @jax.vmap
    def density(reading):
        return jnp.exp(sensor.log_prob(pose, LaserScan(reading[None], 0.0, 0.1), jnp.array(True)))

    readings = np.linspace(0.0015, 4.9999, 20_001)
    below = integrate.simpson(np.asarray(density(jnp.asarray(readings, jnp.float32))), x=readings)
    at_limit = float(density(jnp.array([5.0]))[0])
    assert below + at_limit == pytest.approx(1.0, abs=5e-3)
    assert at_limit == pytest.approx(0.05, abs=1e-3)
    near, wall, beyond = density(jnp.array([1.0, 2.8, 4.0]))
    assert wall > 4 and near > beyond
