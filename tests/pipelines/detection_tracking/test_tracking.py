"""Tracking by detection: crossing cars, low scores, leaving the view, and the recordings."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2

from jaxloc.data.tracking import read_kitti_tracking, read_mot_detections, read_mot_tracks
from jaxloc.evaluation import BoxOverlap, PointDistance, clear_mot, compare, hota
from jaxloc.pipelines import detection_tracking
from jaxloc.pipelines.detection_tracking import Config, Phd, models, track

FRAMES, DT = 40, 0.1
VELOCITIES = np.array([[2.0, 0.0, 1.0], [-2.0, 0.0, 0.5]])
FALSE = 2  # the slot of a false object that is detected again and again at the same position


@pytest.fixture(scope="module")
def street():
    """Two cars that pass each other, a false object of low scores, one more false detection in each frame."""
    rng = np.random.default_rng(0)
    times = DT * np.arange(FRAMES)
    truth = np.zeros((FRAMES, 2, 3))
    truth[:, 0] = np.stack([-4.0 + 2.0 * times, np.full(FRAMES, 1.5), 20.0 + 1.0 * times], axis=1)
    truth[:, 1] = np.stack([4.0 - 2.0 * times, np.full(FRAMES, 1.5), 26.0 + 0.5 * times], axis=1)
    places = np.zeros((FRAMES, 4, 3))
    places[:, :2] = truth + 0.08 * rng.standard_normal(truth.shape)
    places[:, FALSE] = [8.0, 1.5, 30.0] + 0.08 * rng.standard_normal((FRAMES, 3))
    places[:, 3] = np.stack([rng.uniform(-20, 20, FRAMES), np.full(FRAMES, 1.5), rng.uniform(30, 60, FRAMES)], axis=1)
    scores = np.tile([10.0, 9.0, 0.8, 0.5], (FRAMES, 1)) + 0.3 * rng.standard_normal((FRAMES, 4))
    valid = np.ones((FRAMES, 4), bool)
    valid[[12, 13, 27], [0, 1, 0]] = False  # missed
    return truth, places, scores, valid, times


@pytest.fixture(scope="module", params=["gmphd", "jpda"])
def tracked(request, street):
    _, places, scores, valid, times = street
    config = Config(detection_tracking.STRATEGIES[request.param]())
    return track(places, scores, valid, times, config=config)


@pytest.mark.slow
def test_each_car_is_one_track(street, tracked):
    truth = street[0]
    assert np.unique(tracked.ids[tracked.valid]).tolist() == [1, 2]
    seen = street[3][:, :2].sum(axis=1)
    assert (tracked.valid.sum(axis=1) >= seen)[8:].all()
    found = hota(
        compare(
            truth,
            np.tile([0, 1], (FRAMES, 1)),
            np.ones((FRAMES, 2), bool),
            tracked.places,
            tracked.ids,
            tracked.valid,
            similarity=PointDistance(2.0),
        )
    ).mean()
    assert found.hota > 0.9 and found.ass_a > 0.9


def test_states_are_right_within_their_sigmas(street, tracked):
    truth = street[0]
    for frame in (20, 39):
        for slot in range(2):
            car = int(np.abs(truth[frame] - tracked.places[frame, slot]).sum(axis=1).argmin())
            error = tracked.places[frame, slot] - truth[frame, car]
            assert error @ np.linalg.solve(tracked.covariances[frame, slot], error) < chi2.ppf(0.999, 3)
            error = tracked.velocities[frame, slot] - VELOCITIES[car]
            assert error @ np.linalg.solve(tracked.velocity_covariances[frame, slot], error) < chi2.ppf(0.999, 3)
            assert abs(error[0]) < 1.0
            assert tracked.detections[frame, slot] == car
    assert (np.linalg.eigvalsh(tracked.velocity_covariances[tracked.valid]) > 0).all()
    # The car that is missed is not assigned to another detection, whether its track is reported or not.
    assert set(tracked.detections[12][tracked.valid[12]].tolist()) - {-1} == {1}


def test_later_frames_do_not_change_earlier_outputs(street):
    _, places, scores, valid, times = street
    whole = track(places, scores, valid, times)
    part = track(places[:25], scores[:25], valid[:25], times[:25])
    np.testing.assert_array_equal(part.ids[part.valid], whole.ids[:25][whole.valid[:25]])
    np.testing.assert_allclose(part.places[part.valid], whole.places[:25][whole.valid[:25]], atol=1e-5)


def test_absent_and_non_finite_detections_are_ignored(street):
    _, places, scores, valid, times = street
    bad, more = places.copy(), valid.copy()
    bad[5, 3] = np.nan
    bad[13, 1], scores = np.inf, np.where(np.arange(4) == 3, np.nan, scores)  # what was masked, and all of slot 3
    clean = track(places, np.where(np.isnan(scores), 0.0, scores), valid & (np.arange(4) != 3), times)
    found = track(bad, scores, more, times)
    np.testing.assert_array_equal(found.ids, clean.ids)
    np.testing.assert_allclose(found.places, clean.places, atol=1e-5)
    assert np.isfinite(found.places).all()


def test_targets_out_of_view_are_not_reported(street):
    _, places, scores, valid, times = street
    cameras = np.tile(np.eye(4), (FRAMES, 1, 1))
    cameras[25:, :3, :3] = np.diag([-1.0, 1.0, -1.0])  # it turns around
    there = valid & (np.arange(FRAMES) < 25)[:, None]
    found = track(places, scores, there, times, cameras=cameras)
    assert found.valid[24].sum() == 2 and not found.valid[25:].any()


def test_no_detections_and_too_many(street):
    _, places, scores, valid, times = street
    none = track(places, scores, np.zeros_like(valid), times)
    assert none.valid.shape == (FRAMES, 0) and len(none) == FRAMES
    assert track(places[:, :0], scores[:, :0], valid[:, :0], times).valid.shape == (FRAMES, 0)
    crowd = track(places, scores, valid, times, config=Config(Phd(), capacity=1))
    assert crowd.num_dropped.sum() > 0 and crowd.valid.sum(axis=1).max() <= 1


@pytest.mark.slow
@pytest.mark.parametrize("name", ["gmphd", "jpda", "gnn"])
def test_steps_give_the_numbers_of_a_run(street, check_resumed, name):
    """Saved after a miss, before the next one."""
    _, *arrays = street
    config = Config(detection_tracking.STRATEGIES[name]())
    frames = list(detection_tracking.split_frames(*arrays))[:30]
    outs, _ = check_resumed(lambda: detection_tracking.init(config), detection_tracking.step, frames, 14)
    for one, other in zip(outs, detection_tracking.run(frames, config), strict=True):
        np.testing.assert_array_equal(one.ids, other.ids)
        np.testing.assert_array_equal(one.detections, other.detections)
        np.testing.assert_allclose(one.places, other.places, atol=1e-5)
        np.testing.assert_allclose(one.covariances, other.covariances, atol=1e-5)


def test_a_run_over_more_frames_than_one_scan(street):
    """150 frames are two scans: an identity and its velocity go on from the first to the second."""
    places = np.stack([0.1 * np.arange(150.0), np.full(150, 1.5), np.full(150, 30.0)], axis=1)[:, None]
    found = track(places, np.full((150, 1), 10.0), np.ones((150, 1), bool), DT * np.arange(150))
    assert found.ids[2:, 0].tolist() == [1] * 148
    np.testing.assert_allclose(found.velocities[126:131, 0, 0], 1.0, atol=0.01)


def test_bad_input_is_refused(street):
    _, places, scores, valid, times = street
    with pytest.raises(ValueError, match="3 or 4 entries; got 2"):
        track(places[..., :2], scores, valid, times)
    with pytest.raises(ValueError, match="backwards at frame 1"):
        track(places, scores, valid, times[::-1])
    with pytest.raises(ValueError, match="3 or 4 entries; got 2"):
        detection_tracking.init(Config(), dimension=2)
    with pytest.raises(ValueError, match="frames is 0"):
        detection_tracking.Confirmation(frames=0)
    with pytest.raises(ValueError, match="capacity is 0"):
        Config(capacity=0)
    with pytest.raises(ValueError, match="survival is 1.5"):
        Config(scene=dataclasses.replace(Config().scene, survival=1.5))
    with pytest.raises(ValueError, match="box is -1"):
        Config(noise=models.Noise(box=-1.0))


def test_models_of_scores():
    clutter = models.ScoredClutter(5.0, 100.0, 2.0)
    scores = jnp.linspace(0.0, 60.0, 6001)
    density = jnp.exp(jax.vmap(lambda score: clutter.log_density(jnp.stack([score, score])))(scores))
    np.testing.assert_allclose(100.0 * np.trapezoid(density, scores), 1.0, rtol=1e-4)
    detection = models.ScoredDetection(0.0, 0.4, 1)
    high, low = (float(detection.probability(jnp.array([0.0, score]))) for score in (12.0, 0.0))
    assert high > 0.97 and low == pytest.approx(0.5, abs=1e-6)


@pytest.mark.recordings
def test_cars_of_kitti(recordings):
    sequence = read_kitti_tracking(recordings / "kitti_tracking_dev", "0012")
    found, truth = sequence.detections, sequence.truth
    tracked = track(found.positions, found.scores, found.valid, found.times, cameras=sequence.poses)
    there = truth.detections
    pairs = compare(
        there.positions,
        truth.ids,
        there.valid,
        tracked.places,
        tracked.ids,
        tracked.valid,
        similarity=PointDistance(2.0),
    )
    assert hota(pairs).mean().hota > 0.6 and clear_mot(pairs).switches <= 1


@pytest.mark.recordings
def test_pedestrians_of_mot(recordings):
    folder = recordings / "mot15_tud" / "TUD-Campus"
    found, truth = read_mot_detections(folder / "det.txt"), read_mot_tracks(folder / "gt.txt")
    low, high = found.boxes[..., :2], found.boxes[..., 2:]
    places = np.concatenate([0.5 * (low + high), high - low], axis=2)
    tracked = track(places, found.scores, found.valid, found.times, config=Config.for_boxes())
    center, sides = tracked.places[..., :2], tracked.places[..., 2:]
    boxes = np.concatenate([center - 0.5 * sides, center + 0.5 * sides], axis=2)
    there = truth.detections
    pairs = compare(there.boxes, truth.ids, there.valid, boxes, tracked.ids, tracked.valid, similarity=BoxOverlap())
    assert hota(pairs).mean().hota > 0.48 and clear_mot(pairs).mota > 0.53
