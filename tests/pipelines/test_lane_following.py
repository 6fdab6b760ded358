"""Lane following on synthetic drives: start, night, lost paint, unknown pitch."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import jaxloc as jl
from jaxloc.data.simulate.road.drive import Course, drive
from jaxloc.data.simulate.road.rendering import Road, render
from jaxloc.lanes import ralph
from jaxloc.lanes.ground_view import look
from jaxloc.pipelines.lane_following.following import Config, Frame, LaneFollower, follow
from jaxloc.pipelines.lane_following.pitch import estimate_pitch

SHAPE = (240, 320)
CONFIG = Config(sequence=True, interval=0.1)


class Picture(eqx.Module):
    """What a reader gives, and no more."""

    gray: np.ndarray
    time: float | None = None


def camera(pitch=0.03, height=1.3):
    return jl.sensors.GroundCamera(jl.sensors.Pinhole(250.0, 250.0, 159.5, 100.0), height, pitch)


@pytest.fixture(scope="module")
def trip():
    return drive(Road(), camera(), 24, course=Course(interval=0.1), shape=SHAPE)


@pytest.fixture(scope="module")
def pictures(trip):
    return [Picture(frame) for frame in trip.frames()]


@pytest.fixture(scope="module")
def steps(pictures):
    return list(follow(pictures, camera(), CONFIG))


def test_it_follows_a_drive_from_nothing(trip, steps):
    assert [step.source for step in steps] == ["start"] + ["borders"] * 23 and all(step.ok for step in steps)
    errors = np.array([step.lane for step in steps])[:, :3] - trip.lanes[:, :3]
    assert (np.median(np.abs(errors), axis=0) < [0.02, 2e-3, 1.5e-4]).all()
    sigmas = np.array([np.sqrt(np.diag(step.covariance))[:3] for step in steps])
    assert np.mean(np.abs(errors) < 3.0 * sigmas) > 0.9
    assert np.median(np.abs([step.pitch for step in steps] - trip.pitches)) < 1e-3
    assert np.median(np.abs([step.width - 3.6 for step in steps])) < 0.05
    assert all(0.5 < step.confidence <= 1.0 for step in steps)


def test_borders_are_where_the_truth_projects_to(trip, steps):
    index = 15
    ground, lane, step = trip.camera(index), trip.lane(index), steps[15]
    x = jnp.linspace(2.0, 80.0, 8000)
    for side, columns in ((1.8, step.left), (-1.8, step.right)):
        u, v = (np.asarray(part)[::-1] for part in ground.project_components(x, lane.center(x) + side))
        np.testing.assert_allclose(columns, np.interp(step.rows, v, u), atol=2.0)
    assert step.rows[0] < 130 and step.rows[-1] == SHAPE[0] - 1


def test_the_warning_follows_from_the_lane(steps):
    for step in steps:
        offset, heading, curvature, _ = step.lane
        if np.isfinite(step.crossing):
            way = 20.0 * step.crossing
            place = offset + np.tan(heading) * way - 0.5 * curvature * way**2
            assert place == pytest.approx(step.crossing_side * (0.5 * step.width - 0.9), abs=1e-2)


def test_a_night_is_bridged_and_the_lane_found_again(pictures):
    dark = [Picture(np.zeros(SHAPE, np.float32))] * 7
    steps = list(follow([*pictures[:5], *dark, *pictures[12:16]], camera(), CONFIG))
    night = steps[5:12]
    assert not any(step.ok for step in night) and all(step.source == "prediction" for step in night)
    assert all(step.confidence == 0.0 for step in night)
    sigma = [np.sqrt(step.covariance[0, 0]) for step in steps[4:12]]
    assert (np.diff(sigma) > 0.0).all(), "uncertainty grows"
    assert all(np.isfinite(step.lane).all() and np.isfinite(step.left).all() for step in night)
    assert abs(night[0].lane[0] - steps[4].lane[0]) < 0.05, "the state is predicted"
    assert steps[12].source == "start" and steps[13].source == "borders"


def test_nothing_at_all_is_no_lane():
    (step,) = follow([Picture(np.full(SHAPE, 90.0, np.float32))], camera(), CONFIG)
    assert not step.ok and step.confidence == 0.0 and np.sqrt(step.covariance[0, 0]) > 1.0


def test_pictures_that_are_no_sequence_stand_for_themselves():
    lanes = [jl.lanes.Lane(offset, 0.0, 0.0) for offset in (0.5, -0.5)]
    pictures = [Picture(render(Road(shadows=None), lane, camera(), shape=SHAPE)) for lane in lanes]
    steps = list(follow(pictures, camera(), Config()))
    assert [step.source for step in steps] == ["start", "start"]
    np.testing.assert_allclose([step.lane[0] for step in steps], [0.5, -0.5], atol=0.05)


def test_where_paint_ends_the_look_of_the_road_goes_on():
    painted = Road(shadows=None)
    road = painted.followed_by(painted.without_marks(), 90.0, 1.0)
    trip = drive(road, camera(), 16, course=Course(interval=0.2, curvature=2e-4, pitch=0.0), shape=SHAPE, start=60.0)
    config = Config(sequence=True, interval=0.2, blend=0.3)
    steps = list(follow([Picture(frame) for frame in trip.frames()], camera(), config))
    late = [step for step in steps if step.source == "template"]
    assert steps[0].source == "start" and len(late) >= 3
    errors = [abs(step.lane[0] - trip.lanes[step.index, 0]) for step in late]
    assert np.median(errors) < 0.15


def test_a_saved_template_starts_without_paint():
    bare = drive(Road(shadows=None).without_marks(), camera(), 3, course=Course(interval=0.1, pitch=0.0), shape=SHAPE)
    follower = LaneFollower(camera(), SHAPE, CONFIG)
    view = look(camera(), jnp.asarray(bare.frame(0)), follower._tracker.grid)
    truth = bare.lane(0)
    saved = ralph.capture(view, ralph.LaneFit(truth.offset, truth.heading, truth.curvature))
    steps = list(follow([Picture(bare.frame(i)) for i in (1, 2)], camera(), CONFIG, template=saved))
    assert steps[0].ok and steps[0].source == "start"
    assert abs(steps[0].lane[0] - bare.lanes[1, 0]) < 0.1


def test_an_unknown_pitch_is_estimated(pictures, trip):
    found = estimate_pitch([picture.gray for picture in pictures[:6]], camera(pitch=0.0))
    assert found.ok and abs(found.value - 0.03) < 0.005
    steps = list(follow(pictures[:6], camera(pitch=0.0), CONFIG, pitch_known=False))
    assert all(step.ok for step in steps)
    assert abs(steps[-1].lane[0] - trip.lanes[5, 0]) < 0.05
    blank = estimate_pitch([np.zeros(SHAPE, np.float32)], camera(pitch=0.02))
    assert not blank.ok and blank.value == pytest.approx(0.02)


def test_bad_input_is_refused():
    with pytest.raises(ValueError, match="lane_width is 0"):
        Config(lane_width=0.0)
    with pytest.raises(ValueError, match="speed is -1"):
        Config(speed=-1.0)
    with pytest.raises(ValueError, match="check its pitch and height"):
        LaneFollower(camera(pitch=-0.6), SHAPE)
    with pytest.raises(ValueError, match="shape"):
        LaneFollower(camera(), SHAPE).follow(Picture(np.zeros((3, 4), np.float32)))
    assert isinstance(Picture(np.zeros((3, 4))), Frame)
