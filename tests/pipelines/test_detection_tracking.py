"""Tracks from ready detections: crossing cars, doubtful scores, leaving the view, and the recordings."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.data.tracking import read_kitti_tracking, read_mot_detections, read_mot_tracks
from jaxloc.evaluation import BoxOverlap, PointDistance, clear_mot, compare, hota
from jaxloc.pipelines import detection_tracking
from jaxloc.pipelines.detection_tracking import models
from jaxloc.pipelines.detection_tracking.tracking import Config, Phd, track

FRAMES, DT = 40, 0.1
DOUBTFUL = 2  # the slot of what is false in the same place again and again


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
    places[:, DOUBTFUL] = [8.0, 1.5, 30.0] + 0.08 * rng.standard_normal((FRAMES, 3))
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
            assert error @ np.linalg.solve(tracked.covariances[frame, slot], error) < 16.3  # 99.9 %
            np.testing.assert_allclose(tracked.velocities[frame, slot, 0], [2.0, -2.0][car], atol=1.0)
            assert tracked.slots[frame, slot] == car
    assert (np.linalg.eigvalsh(tracked.speed_covariances[tracked.valid]) > 0).all()
    # The one that is missed is not taken for another, whether it is spoken of or not.
    assert sorted(tracked.slots[12][tracked.valid[12]].tolist()) in ([1], [-1, 1])


def test_what_follows_does_not_change_what_was_said(street):
    _, places, scores, valid, times = street
    whole = track(places, scores, valid, times)
    part = track(places[:25], scores[:25], valid[:25], times[:25])
    np.testing.assert_array_equal(part.ids[part.valid], whole.ids[:25][whole.valid[:25]])
    np.testing.assert_allclose(part.places[part.valid], whole.places[:25][whole.valid[:25]], atol=1e-5)


def test_absent_and_bad_detections_count_nothing(street):
    _, places, scores, valid, times = street
    bad, more = places.copy(), valid.copy()
    bad[5, 3] = np.nan
    bad[13, 1], scores = np.inf, np.where(np.arange(4) == 3, np.nan, scores)  # what was masked, and all of slot 3
    clean = track(places, np.where(np.isnan(scores), 0.0, scores), valid & (np.arange(4) != 3), times)
    found = track(bad, scores, more, times)
    np.testing.assert_array_equal(found.ids, clean.ids)
    np.testing.assert_allclose(found.places, clean.places, atol=1e-5)
    assert np.isfinite(found.places).all()


def test_targets_out_of_view_are_not_spoken_of(street):
    _, places, scores, valid, times = street
    cameras = np.tile(np.eye(4), (FRAMES, 1, 1))
    cameras[25:, :3, :3] = np.diag([-1.0, 1.0, -1.0])  # it turns around
    there = valid & (np.arange(FRAMES) < 25)[:, None]
    found = track(places, scores, there, times, cameras=cameras)
    assert found.valid[24].sum() == 2 and not found.valid[25:].any()


def test_nothing_and_too_much(street):
    _, places, scores, valid, times = street
    silent = track(places, scores, np.zeros_like(valid), times)
    assert silent.valid.shape == (FRAMES, 0) and len(silent) == FRAMES
    assert track(places[:, :0], scores[:, :0], valid[:, :0], times).valid.shape == (FRAMES, 0)
    crowd = track(places, scores, valid, times, config=Config(Phd(), capacity=1))
    assert crowd.crowded.sum() > 0 and crowd.valid.sum(axis=1).max() <= 1


def test_bad_input_is_refused(street):
    _, places, scores, valid, times = street
    with pytest.raises(ValueError, match="3 or 4 entries; got 2"):
        track(places[..., :2], scores, valid, times)
    with pytest.raises(ValueError, match="backwards at frame 1"):
        track(places, scores, valid, times[::-1])
    with pytest.raises(ValueError, match="capacity is 0"):
        Config(capacity=0)
    with pytest.raises(ValueError, match="survival is 1.5"):
        Config(scene=dataclasses.replace(Config().scene, survival=1.5))
    with pytest.raises(ValueError, match="box is -1"):
        Config(noise=models.Noise(box=-1.0))


def test_scores_are_evidence():
    clutter = models.ScoredClutter(5.0, 100.0, 2.0)
    scores = jnp.linspace(0.0, 60.0, 6001)
    density = jnp.exp(jnp.stack([clutter.log_density(jnp.array([0.0, score])) for score in scores[::100]]))
    np.testing.assert_allclose(100.0 * np.trapezoid(density, scores[::100]), 1.0, rtol=0.03)
    detection = models.ScoredDetection(0.0, 0.4, 1)
    sure, doubtful = (float(detection.probability(jnp.array([0.0, score]))) for score in (12.0, 0.0))
    assert sure > 0.97 and doubtful == pytest.approx(0.5, abs=1e-6)


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
