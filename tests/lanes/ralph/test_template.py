"""Templates of RALPH along a drive: the road changes, and what is known of it follows or does not [K-42...K-44]."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxloc as jl
from jaxloc.data.simulate.road.drive import Course, drive
from jaxloc.data.simulate.road.rendering import Road, Streak
from jaxloc.lanes import ralph
from jaxloc.lanes.ground_view import GroundGrid, inverse_perspective

pytestmark = pytest.mark.heavy

SHAPE = (240, 320)
GROUND = jl.sensors.GroundCamera(jl.sensors.Pinhole(300.0, 300.0, 159.5, 99.5), 1.3, 0.03)
ROAD = Road()
FOREIGN = Road(
    marks=(),
    streaks=(Streak(1.35, 0.15, 25.0), Streak(-0.2, 0.3, -20.0), Streak(-1.25, 0.2, 20.0)),
    seed=5,
    edges=(4.4, -3.6),
    grass=130.0,
)


def follow(trip, views, adaptation):
    """How far the offset is off at each image of a drive, and whether the lane was believed.

    The vehicle's odometry carries the lane from image to image, also where the road looks like nothing known.
    """
    fit, errors, believed = ralph.LaneFit(*trip.lanes[0, :3]), [], []
    template = ralph.capture(views[0], fit)
    interval = trip.times[1] - trip.times[0]
    for view, lane, speed, yaw_rate in zip(views, trip.lanes, trip.speeds, trip.yaw_rates, strict=True):
        tried = ralph.Hypotheses.around(fit, curvature=4e-4, heading=0.012, pitch=0.006, offset=0.4, counts=(9, 7, 5))
        found = ralph.estimate(view, template, hypotheses=tried)
        value = found.estimate.value
        # A lane does not jump: what is far from the prediction belongs to something else.
        near = (abs(value.offset - fit.offset) < 0.15) & (abs(value.heading - fit.heading) < 0.01)
        ok = found.ok & near
        fit = jax.tree.map(lambda new, old, ok=ok: jnp.where(ok, new, old), value, fit)
        template = adaptation.adapt(template, view, fit, jnp.array(True))
        errors.append(float(fit.offset) - lane[0])
        believed.append(bool(ok))
        later = fit.lane().advance(jnp.float32(speed * interval), jnp.float32(yaw_rate * interval))
        fit = ralph.LaneFit(later.offset, later.heading, later.curvature, fit.pitch)
    return np.abs(errors), np.array(believed)


@pytest.mark.slow
def test_templates_follow_a_road_that_changes():
    """K-42 to K-44: another surface comes from ahead; a fixed template is lost, others keep the lane to some dm."""
    road = dataclasses.replace(ROAD, shadows=None).followed_by(dataclasses.replace(FOREIGN, shadows=None), 40.0)
    trip = drive(road, GROUND, 60, course=Course(speed=20.0, interval=0.1), shape=SHAPE)
    views = [inverse_perspective(GROUND, jnp.asarray(picture), GroundGrid.for_speed(15.0)) for picture in trip.frames()]
    kinds = (ralph.Fixed(), ralph.Blended(0.1), ralph.Predictive())
    fixed, blended, predictive = (follow(trip, views, kind) for kind in kinds)
    assert not fixed[1][-10:].any()
    for errors, believed in (blended, predictive):
        assert believed[-10:].mean() >= 0.4 and np.median(errors[-10:]) < 0.3
