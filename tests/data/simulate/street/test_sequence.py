import cv2
import numpy as np
import pytest

from jaxloc.data.simulate.street.sequence import simulate_street
from jaxloc.sensors import Pinhole, StereoRig

SIZE = (120, 384)


@pytest.fixture(scope="module")
def street():
    return simulate_street(num_frames=12, size=SIZE, noise=0.0)


def intrinsics(sequence):
    camera = sequence.rig.camera
    return tuple(float(value) for value in (camera.fx, camera.fy, camera.cx, camera.cy))


def warped(sequence, depth, image, destination_from_source):
    """The source view's pixels looked up in another image, and where they fall into it."""
    fx, fy, cx, cy = intrinsics(sequence)
    v, u = np.indices(depth.shape)
    z = np.where(np.isfinite(depth), depth, 1.0)
    points = np.stack([(u - cx) / fx * z, (v - cy) / fy * z, z], axis=-1)
    moved = points @ destination_from_source[:3, :3].T + destination_from_source[:3, 3]
    x = (fx * moved[..., 0] / moved[..., 2] + cx).astype(np.float32)
    y = (fy * moved[..., 1] / moved[..., 2] + cy).astype(np.float32)
    inside = np.isfinite(depth) & (x > 1) & (x < depth.shape[1] - 2) & (y > 1) & (y < depth.shape[0] - 2)
    return cv2.remap(image.astype(np.float32), x, y, cv2.INTER_CUBIC), inside


def test_the_right_image_is_the_left_one_moved_by_the_disparity(street):
    frame = street.render(4)
    right_from_left = np.eye(4)
    right_from_left[0, 3] = -float(street.rig.baseline)
    predicted, inside = warped(street, frame.depth, frame.stereo.right, right_from_left)
    error = np.abs(predicted - frame.stereo.left)[inside]
    # Most pixels agree to the rounding of gray values; those near edges and occlusions do not.
    assert np.median(error) < 1.5
    assert frame.stereo.left[inside].std() > 25.0


def test_the_next_image_is_the_warped_one_where_nothing_moves(street):
    now, then = street.render(4), street.render(5)
    motion = np.linalg.inv(street.matrices[5]) @ street.matrices[4]
    predicted, inside = warped(street, now.depth, then.stereo.left, motion)
    still = inside & (now.instances == 0) & (now.depth < 40.0)
    assert np.median(np.abs(predicted - now.stereo.left)[still]) < 4.0
    # With a wrong motion it is far off.
    wrong = motion.copy()
    wrong[2, 3] += 0.5
    predicted, inside = warped(street, now.depth, then.stereo.left, wrong)
    assert np.median(np.abs(predicted - now.stereo.left)[still & inside]) > 6.0


def test_poses_begin_at_the_identity_and_follow_the_speed(street):
    matrices = np.asarray(street.truth.matrices())
    np.testing.assert_allclose(matrices[0], np.eye(4), atol=1e-7)
    np.testing.assert_allclose(np.linalg.norm(np.diff(street.truth.positions, axis=0), axis=1), 1.0, atol=0.01)
    heading = np.arctan2(matrices[:, 0, 2], matrices[:, 2, 2])
    assert heading[-1] > 0.05
    np.testing.assert_allclose(matrices, street.matrices, atol=1e-5)


def test_moving_objects_are_where_their_pixels_are(street):
    frame = street.render(6)
    fx, fy, cx, cy = intrinsics(street)
    seen = 0
    for thing in street.objects:
        rows, columns = np.nonzero(frame.instances == thing.instance)
        if len(rows) < 20:
            continue
        seen += 1
        z = frame.depth[rows, columns].astype(np.float64)
        points = np.column_stack([(columns - cx) / fx * z, (rows - cy) / fy * z, z])
        world = points @ street.matrices[6][:3, :3].T + street.matrices[6][:3, 3]
        pose = thing.poses[6]
        local = (world - pose[:3, 3]) @ pose[:3, :3]
        width, height, length = thing.size
        assert (np.abs(local[:, 0]) < width / 2 + 0.05).all() and (np.abs(local[:, 2]) < length / 2 + 0.05).all()
        assert (local[:, 1] < 0.05).all() and (local[:, 1] > -height - 0.05).all()
    assert seen >= 2
    speeds = [np.linalg.norm(np.diff(thing.poses[:, :3, 3], axis=0), axis=1).mean() * 10.0 for thing in street.objects]
    assert max(speeds) > 8.0 and min(speeds) > 1.0


def test_frames_are_reproducible_and_noise_is_what_was_asked_for(street):
    noisy = simulate_street(num_frames=12, size=SIZE, noise=2.0)
    np.testing.assert_array_equal(noisy[3].left, noisy[3].left)
    difference = noisy[3].left.astype(float) - street[3].left
    assert np.std(difference[difference != 0]) == pytest.approx(2.0, abs=0.5)
    assert not np.array_equal(noisy[3].left, simulate_street(num_frames=12, size=SIZE, noise=2.0, seed=1)[3].left)


def test_exposure_changes_both_images_of_a_frame_alike(street):
    changed = simulate_street(num_frames=12, size=SIZE, noise=0.0, exposure=0.1)
    ratios = np.empty((4, 2))
    for index in range(4):
        for side, name in enumerate(("left", "right")):
            ratios[index, side] = getattr(changed[index], name).mean() / getattr(street[index], name).mean()
    np.testing.assert_allclose(ratios[:, 0], ratios[:, 1], atol=0.02)
    assert ratios.std() > 0.02


def test_a_sequence_is_one(street):
    assert len(street) == 12 and len(list(street)) == 12
    assert street[-1].time == pytest.approx(1.1)
    with pytest.raises(IndexError):
        street[12]
    with pytest.raises(ValueError, match="num_frames=0"):
        simulate_street(num_frames=0)
    rig = StereoRig(Pinhole(100.0, 100.0, 50.0, 30.0), 0.3)
    assert float(simulate_street(num_frames=1, size=(60, 100), rig=rig).rig.baseline) == pytest.approx(0.3)
