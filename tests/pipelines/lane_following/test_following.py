"""Lane following on synthetic drives: detection, dark images, lost paint, unknown pitch."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import jaxloc as jl
from jaxloc.data.simulate.road.drive import Course, drive
from jaxloc.data.simulate.road.rendering import Road, render
from jaxloc.lanes import ralph
from jaxloc.lanes.ground_view import inverse_perspective
from jaxloc.pipelines.lane_following.following import Config, Frame, init, run, step
from jaxloc.pipelines.lane_following.pitch import estimate_pitch

SHAPE = (240, 320)
CONFIG = Config(sequence=True, interval=0.1)


class Image(eqx.Module):
    """The least that a reader gives."""

    gray: np.ndarray
    time: float | None = None


def camera(pitch=0.03, height=1.3):
    return jl.sensors.GroundCamera(jl.sensors.Pinhole(250.0, 250.0, 159.5, 100.0), height, pitch)


@pytest.fixture(scope="module")
def trip():
    return drive(Road(), camera(), 24, course=Course(interval=0.1), shape=SHAPE)


@pytest.fixture(scope="module")
def images(trip):
    return [Image(frame) for frame in trip.frames()]


@pytest.fixture(scope="module")
def outs(images):
    return list(run(images, CONFIG, camera()))


@pytest.mark.slow
def test_a_drive_is_followed_from_detection_on(trip, outs):
    assert [out.source for out in outs] == ["start"] + ["borders"] * 23 and all(out.ok for out in outs)
    errors = np.array([out.lane for out in outs])[:, :3] - trip.lanes[:, :3]
    assert (np.median(np.abs(errors), axis=0) < [0.02, 2e-3, 1.5e-4]).all()
    sigmas = np.array([np.sqrt(np.diag(out.covariance))[:3] for out in outs])
    assert np.mean(np.abs(errors) < 3.0 * sigmas) > 0.9
    assert np.median(np.abs([out.pitch for out in outs] - trip.pitches)) < 1e-3
    assert np.median(np.abs([out.width - 3.6 for out in outs])) < 0.05
    assert all(0.5 < out.confidence <= 1.0 for out in outs)


def test_borders_are_where_the_truth_projects_to(trip, outs):
    index = 15
    ground, lane, out = trip.camera(index), trip.lane(index), outs[15]
    x = jnp.linspace(2.0, 80.0, 8000)
    for side, columns in ((1.8, out.left), (-1.8, out.right)):
        u, v = (np.asarray(part)[::-1] for part in ground.project_components(x, lane.center(x) + side))
        np.testing.assert_allclose(columns, np.interp(out.rows, v, u), atol=2.0)
    assert out.rows[0] < 130 and out.rows[-1] == SHAPE[0] - 1


def test_the_warning_follows_from_the_lane(outs):
    for out in outs:
        offset, heading, curvature, _ = out.lane
        if np.isfinite(out.crossing):
            way = 20.0 * out.crossing
            place = offset + np.tan(heading) * way - 0.5 * curvature * way**2
            assert place == pytest.approx(out.crossing_side * (0.5 * out.width - 0.9), abs=1e-2)


@pytest.mark.slow
def test_dark_images_are_bridged_and_the_lane_detected_again(images):
    dark = [Image(np.zeros(SHAPE, np.float32))] * 7
    outs = list(run([*images[:5], *dark, *images[12:16]], CONFIG, camera()))
    night = outs[5:12]
    assert not any(out.ok for out in night) and all(out.source == "prediction" for out in night)
    assert all(out.confidence == 0.0 for out in night)
    sigma = [np.sqrt(out.covariance[0, 0]) for out in outs[4:12]]
    assert (np.diff(sigma) > 0.0).all(), "uncertainty grows"
    assert all(np.isfinite(out.lane).all() and np.isfinite(out.left).all() for out in night)
    assert abs(night[0].lane[0] - outs[4].lane[0]) < 0.05, "the state is predicted"
    assert outs[12].source == "start" and outs[13].source == "borders"


def test_a_uniform_image_shows_no_lane():
    (out,) = run([Image(np.full(SHAPE, 90.0, np.float32))], CONFIG, camera())
    assert not out.ok and out.confidence == 0.0 and np.sqrt(out.covariance[0, 0]) > 1.0


def test_images_that_are_no_sequence_are_processed_alone():
    lanes = [jl.lanes.Lane(offset, 0.0, 0.0) for offset in (0.5, -0.5)]
    images = [Image(render(Road(shadows=None), lane, camera(), shape=SHAPE)) for lane in lanes]
    outs = list(run(images, Config(), camera()))
    assert [out.source for out in outs] == ["start", "start"]
    np.testing.assert_allclose([out.lane[0] for out in outs], [0.5, -0.5], atol=0.05)


@pytest.mark.slow
def test_the_template_is_tracked_where_paint_ends():
    painted = Road(shadows=None)
    road = painted.followed_by(painted.without_marks(), 90.0, 1.0)
    trip = drive(road, camera(), 16, course=Course(interval=0.2, curvature=2e-4, pitch=0.0), shape=SHAPE, start=60.0)
    config = Config(sequence=True, interval=0.2, blend=0.3)
    outs = list(run([Image(frame) for frame in trip.frames()], config, camera()))
    late = [out for out in outs if out.source == "template"]
    assert outs[0].source == "start" and len(late) >= 3
    errors = [abs(out.lane[0] - trip.lanes[out.index, 0]) for out in late]
    assert np.median(errors) < 0.15


@pytest.mark.slow
def test_a_saved_template_detects_a_lane_without_paint():
    bare = drive(Road(shadows=None).without_marks(), camera(), 3, course=Course(interval=0.1, pitch=0.0), shape=SHAPE)
    state = init(CONFIG, camera(), SHAPE)
    view = inverse_perspective(camera(), jnp.asarray(bare.frame(0)), state.tracker.grid)
    truth = bare.lane(0)
    saved = ralph.capture(view, ralph.LaneFit(truth.offset, truth.heading, truth.curvature))
    outs = list(run([Image(bare.frame(i)) for i in (1, 2)], CONFIG, camera(), template=saved))
    assert outs[0].ok and outs[0].source == "start"
    assert abs(outs[0].lane[0] - bare.lanes[1, 0]) < 0.1


def test_an_unknown_pitch_is_estimated(images, trip):
    found = estimate_pitch([image.gray for image in images[:6]], camera(pitch=0.0))
    assert found.ok and abs(found.value - 0.03) < 0.005
    outs = list(run(images[:6], CONFIG, camera(pitch=0.0), pitch_known=False))
    assert all(out.ok for out in outs)
    assert abs(outs[-1].lane[0] - trip.lanes[5, 0]) < 0.05
    blank = estimate_pitch([np.zeros(SHAPE, np.float32)], camera(pitch=0.02))
    assert not blank.ok and blank.value == pytest.approx(0.02)


def test_a_restored_run_gives_the_same_numbers(images, check_resumed):
    frames = [*images[:4], *[Image(np.zeros(SHAPE, np.float32))] * 2, *images[6:9]]
    for at in (2, 5):
        check_resumed(lambda: init(CONFIG, camera(), SHAPE), step, frames, at)


def test_bad_input_is_refused():
    with pytest.raises(ValueError, match="lane_width is 0"):
        Config(lane_width=0.0)
    with pytest.raises(ValueError, match="speed is -1"):
        Config(speed=-1.0)
    with pytest.raises(ValueError, match="check its pitch and height"):
        init(Config(), camera(pitch=-0.6), SHAPE)
    with pytest.raises(ValueError, match="shape"):
        step(init(Config(), camera(), SHAPE), Image(np.zeros((3, 4), np.float32)))
    with pytest.raises(ValueError, match="not a color image"):
        step(init(Config(), camera(), SHAPE), Image(np.zeros((*SHAPE, 3), np.uint8)))
    assert isinstance(Image(np.zeros((3, 4))), Frame)
