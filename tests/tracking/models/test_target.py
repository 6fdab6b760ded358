"""The assumptions that trackers share."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxloc as jl


class Sight(jl.tracking.Detection):
    """Targets are seen within a range."""

    reach: jax.Array

    def probability(self, state):
        return jnp.where(jnp.linalg.norm(state[:2]) < self.reach, 0.9, 0.0)


def make_model(detection):
    filt = jl.filters.KalmanFilter(
        jl.filters.LinearMotion(jnp.eye(4), jnp.eye(4)), jl.filters.LinearSensor(jnp.eye(2, 4), jnp.eye(2))
    )
    clutter = jl.tracking.UniformClutter(1.0, 100.0)
    return jl.tracking.TargetModel(filt, detection=detection, survival=0.99, clutter=clutter, birth=jl.tracking.Birth())


@pytest.mark.parametrize("given", [0.9, jl.tracking.ConstantDetection(0.9)], ids=["number", "record"])
def test_numbers_become_records(given):
    model = make_model(given)
    assert isinstance(model.detection, jl.tracking.ConstantDetection)
    assert float(model.detection.probability(jnp.zeros(4))) == pytest.approx(0.9)
    assert model.survival.dtype == jnp.float32 and model.survival.shape == ()


@pytest.mark.slow
def test_targets_out_of_sight_are_not_missed():
    """Where nothing can be detected, nothing is learned of its absence."""
    phd = jl.tracking.GmPhd(make_model(Sight(jnp.array(10.0))), capacity=4)
    means = jnp.array([[0.0, 0.0, 0.0, 0.0], [50.0, 0.0, 0.0, 0.0]])
    mixture = jl.beliefs.Mixture(jnp.array([0.8, 0.7]), means, jnp.stack([jnp.eye(4)] * 2))
    after, info = phd.update(phd.init(mixture), jnp.zeros((1, 2)), jnp.zeros(1, bool))
    np.testing.assert_allclose(after.mixture.weights[:2], [0.7, 0.08], atol=1e-6)
    assert float(info.log_likelihood) == pytest.approx(-(0.72 + 1.0), abs=1e-5)
