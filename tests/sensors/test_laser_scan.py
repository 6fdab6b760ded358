"""Laser scans: directions of thinned scans, masked beams."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.poses import SE2, retract
from jaxloc.sensors import BeamModel, LaserScan, LikelihoodField


def test_thinned_scans_keep_their_directions():
    scan = LaserScan(jnp.arange(180.0), -0.5 * np.pi, np.pi / 180)
    thin = scan.thin(60)
    assert thin.ranges.shape == (60,)
    np.testing.assert_allclose(thin.angles, scan.angles[1::3], atol=1e-6)
    assert scan.thin(1000).ranges.shape == (180,) and scan.thin(1).ranges.tolist() == [90.0]
    stack = LaserScan(jnp.zeros((4, 180)), 0.0, 0.1).thin(7)
    assert stack.ranges.shape == (4, 7)
    with pytest.raises(ValueError, match="at least one"):
        scan.thin(0)


@pytest.mark.slow
@pytest.mark.parametrize("make", [LikelihoodField, BeamModel])
def test_masked_beams_equal_absent_ones_and_empty_scans_have_no_influence(make, make_field):
    sensor = make(make_field(), max_range=6.0)
    pose = SE2(3.0, 2.5, 0.4)
    bad = LaserScan(jnp.array([1.0, jnp.nan, 2.0, -jnp.inf, 0.0]), 0.0, 0.1)
    mask = jnp.array([True, True, False, True, True])
    alone = sensor.log_prob(pose, LaserScan(jnp.array([1.0]), 0.0, 0.1), jnp.array(True))
    function = jax.jit(jax.value_and_grad(lambda d, mask: sensor.log_prob(retract(pose, d), bad, mask)))
    value, slope = function(jnp.zeros(3), mask)
    assert float(value) == pytest.approx(float(alone), abs=1e-5) and np.isfinite(slope).all()
    nothing, slope = function(jnp.zeros(3), jnp.zeros(5, bool))
    assert float(nothing) == 0.0 and not np.any(slope)
