"""Time to line crossing against a vehicle that is driven there step by step."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxloc as jl
from jaxloc.lanes.departure import time_to_line_crossing
from jaxloc.lanes.lane import Lane


def drive_straight(offset, heading, curvature, speed, room=0.9):
    """Positions against the lane, meter by millimeter."""
    x = np.arange(0.0, 200.0, 1e-3)
    place = offset + np.tan(heading) * x - 0.5 * curvature * x**2
    out = np.flatnonzero(np.abs(place) >= room)
    return (x[out[0]] / speed, np.sign(place[out[0]])) if len(out) else (np.inf, 0.0)


@pytest.mark.parametrize(
    "offset, heading, curvature",
    [(0.3, 0.01, 0.0), (0.3, -0.01, 0.0), (-0.2, 0.0, 1e-3), (0.1, 0.02, 2e-3), (0.0, 0.004, 4e-5), (0.2, 0.0, 0.0)],
)
def test_it_is_the_time_of_a_simulated_drive(x64, offset, heading, curvature):
    found = time_to_line_crossing(Lane(offset, heading, curvature), 3.6, 1.8, 20.0)
    time, side = drive_straight(offset, heading, curvature, 20.0)
    assert float(found.time) == pytest.approx(time, abs=1e-4) and float(found.side) == side and bool(found.inside)


def test_on_a_line_and_at_rest():
    over = time_to_line_crossing(Lane(-1.2, 0.0, 0.0), 3.6, 1.8, 20.0)
    assert float(over.time) == 0.0 and float(over.side) == -1.0 and not bool(over.inside)
    still = time_to_line_crossing(Lane(0.5, 0.1, 0.0), 3.6, 1.8, 0.0)
    assert np.isinf(float(still.time)) and float(still.side) == 0.0


def test_derivatives_and_batches(x64):
    def time(offset, heading, curvature):
        return time_to_line_crossing(Lane(offset, heading, curvature), 3.6, 1.8, 20.0).time

    at = (0.3, 0.01, 2e-4)
    found = jax.grad(time, argnums=(0, 1, 2))(*map(jnp.array, at))
    for i, step in enumerate((1e-5, 1e-7, 1e-9)):
        up, down = (time(*[jnp.array(v + s * step * (i == j)) for j, v in enumerate(at)]) for s in (1, -1))
        assert float(found[i]) == pytest.approx(float(up - down) / (2 * step), rel=1e-3)
    nothing = jax.grad(time, argnums=(0, 1, 2))(*map(jnp.array, (0.0, 0.0, 0.0)))
    assert np.isfinite(nothing).all()
    headings = jnp.array([0.01, -0.02])
    batch = jax.vmap(lambda h: jl.lanes.departure.time_to_line_crossing(Lane(0.0, h, 0.0)).time)(headings)
    np.testing.assert_allclose(batch, [4.5, 2.25], rtol=1e-3)
