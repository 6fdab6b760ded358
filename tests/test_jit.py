"""Compilation: numbers are traced, sizes and choices are not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxloc as jl
from jaxloc._jit import filter_jit


@pytest.fixture
def counted():
    """A compiled function and the list of what its options were at each trace."""
    traces = []

    @filter_jit
    def function(x, scale=1.0, *rest, reach: float = 1.0, limit: float | None = None, count: int = 2):
        traces.append((reach, limit, count))
        size = int(2 * reach) + count
        return scale * jnp.sum(x) + size + sum(rest)

    return function, traces


def test_new_numbers_compile_nothing(counted):
    function, traces = counted
    x = jnp.ones(3)
    assert [float(function(x, scale)) for scale in (0.5, 1.5, np.float64(2.5), np.float32(3.5))] == [
        5.5,
        8.5,
        11.5,
        14.5,
    ]
    assert [float(function(x, scale=scale)) for scale in (0.5, 1.5)] == [5.5, 8.5]
    # A NumPy scalar of another type has a trace of its own.
    assert len(traces) == 2


def test_sizes_stay_python_numbers(counted):
    function, traces = counted
    x = jnp.ones(3)
    assert [float(function(x, 1.0, reach=reach, limit=2.0)) for reach in (1.0, 2.0)] == [7.0, 9.0]
    assert [float(function(x, 1.0, count=count)) for count in (1, 2)] == [6.0, 7.0]
    assert all(isinstance(number, float | int) for trace in traces for number in trace if number is not None)


def test_numbers_take_the_precision_of_arrays(x64):
    double = filter_jit(lambda x, by: x * by)
    assert double(jnp.ones(2, jnp.float32), 2.5).dtype == jnp.float32
    assert double(jnp.ones(2), 2.5).dtype == jnp.float64


def test_methods():
    camera, points = jl.sensors.Pinhole(500.0, 500.0, 320.0, 240.0), jnp.array([[0.0, 0.0, 5.0]])
    assert camera.project(points).tolist() == [[320.0, 240.0]]
    with pytest.raises(ValueError, match="Pinhole.project: .* has shape"):
        camera.project(points[0])


def test_a_new_sigma_compiles_nothing(caplog):
    """The case that users met: seconds for each new standard deviation."""
    camera = jl.sensors.Pinhole(500.0, 500.0, 320.0, 240.0)
    points = jnp.array([[0.0, 0.0, 5.0], [1.0, 0.0, 6.0], [0.0, 1.0, 7.0], [1.0, 1.0, 5.0]])
    pixels, pose = camera.project(points), jl.poses.SE3.identity()
    first = jl.refinement.pnp.refine_pose(camera, points, pixels, pose, sigma=0.5)
    with jax.log_compiles():
        second = jl.refinement.pnp.refine_pose(camera, points, pixels, pose, sigma=1.0)
    assert not [record for record in caplog.records if "Compiling" in record.getMessage()]
    np.testing.assert_allclose(second.covariance, 4.0 * first.covariance, rtol=1e-3, atol=1e-9)


@pytest.mark.parametrize("kind", ["KalmanFilter", "ExtendedKalmanFilter", "InformationFilter"])
def test_filters_take_python_numbers(kind):
    """Without `jit` as well: a time step as users type it."""
    motion = jl.filters.ConstantVelocity(0.1, axes=2)
    filt = getattr(jl.filters, kind)(motion, jl.filters.LinearSensor(jnp.eye(2, 4), jnp.eye(2)))
    state = filt.init(jl.beliefs.Gaussian(jnp.arange(4.0), jnp.eye(4)))
    for ours, theirs in zip(*(jax.tree.leaves(filt.predict(state, dt)) for dt in (0.1, jnp.array(0.1))), strict=True):
        np.testing.assert_array_equal(ours, theirs)
