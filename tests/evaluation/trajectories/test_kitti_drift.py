"""The KITTI metric against a line by line NumPy transcription of its definition."""

import gzip

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxloc.data import kitti
from jaxloc.evaluation.trajectories import kitti_drift
from jaxloc.poses import Trajectory


def benchmark_errors(estimate, truth, lengths, step):
    """Mean translation (m/m) and rotation (rad/m) errors as the benchmark defines them."""
    distances = [0.0]
    for before, after in zip(truth, truth[1:], strict=False):
        distances.append(distances[-1] + np.linalg.norm(after[:3, 3] - before[:3, 3]))
    translations, rotations = [], []
    for first in range(0, len(truth), step):
        for length in lengths:
            last = next((i for i in range(first, len(truth)) if distances[i] > distances[first] + length), None)
            if last is None:
                continue
            true_motion = np.linalg.inv(truth[first]) @ truth[last]
            motion = np.linalg.inv(estimate[first]) @ estimate[last]
            error = np.linalg.inv(motion) @ true_motion
            rotations.append(np.arccos(np.clip(0.5 * (np.trace(error[:3, :3]) - 1.0), -1.0, 1.0)) / length)
            translations.append(np.linalg.norm(error[:3, 3]) / length)
    return np.mean(translations), np.mean(rotations), len(translations)


def winding_path(rng, count, noise):
    """True poses a meter apart, and dead reckoning from noisy motions."""
    truth, estimate = [np.eye(4)], [np.eye(4)]
    for index in range(count - 1):
        step = np.eye(4)
        step[:3, :3] = Rotation.from_rotvec([0.0, 0.02 * np.sin(0.05 * index), 0.0]).as_matrix()
        step[:3, 3] = [0.0, 0.0, 1.0 + 0.3 * np.sin(0.1 * index)]
        error = np.eye(4)
        error[:3, :3] = Rotation.from_rotvec(noise * rng.standard_normal(3)).as_matrix()
        error[:3, 3] = 10.0 * noise * rng.standard_normal(3)
        truth.append(truth[-1] @ step)
        estimate.append(estimate[-1] @ step @ error)
    return np.stack(estimate), np.stack(truth)


def as_trajectory(matrices):
    return Trajectory.from_matrices(jnp.arange(float(len(matrices))), jnp.asarray(matrices))


@pytest.mark.parametrize("lengths, step", [(kitti_drift.KITTI_LENGTHS, 10), ((5.0, 20.0, 400.0), 1)])
def test_segment_errors_are_those_of_the_benchmark(rng, lengths, step, x64):
    estimate, truth = winding_path(rng, 350, 1e-3)
    errors = kitti_drift.segment_errors(as_trajectory(estimate), as_trajectory(truth), lengths=lengths, step=step)
    translation, rotation, count = benchmark_errors(estimate, truth, lengths, step)
    assert int(errors.valid.sum()) == count > 10 and bool(errors.ok())
    assert float(errors.translation_percent()) == pytest.approx(100.0 * translation, rel=1e-9)
    assert float(errors.rotation_deg_per_meter()) == pytest.approx(np.degrees(rotation), rel=1e-6)
    single = [benchmark_errors(estimate, truth, (length,), step)[0] for length in lengths[:2]]
    np.testing.assert_allclose(errors.translation_percent_by_length()[:2], 100.0 * np.array(single), rtol=1e-9)
    assert float(errors.translation_percent_by_length()[-1]) == 0.0 or bool(errors.valid[:, -1].any())


def test_single_precision_is_accurate_and_dtypes_are_kept(rng, dtype):
    estimate, truth = winding_path(rng, 350, 1e-3)
    errors = kitti_drift.segment_errors(as_trajectory(estimate), as_trajectory(truth))
    translation, rotation, _ = benchmark_errors(estimate, truth, kitti_drift.KITTI_LENGTHS, 10)
    assert errors.translation.dtype == dtype and errors.lengths.dtype == dtype
    assert float(errors.translation_percent()) == pytest.approx(100.0 * translation, rel=1e-3)
    assert float(errors.rotation_deg_per_meter()) == pytest.approx(np.degrees(rotation), rel=1e-3)


def test_a_path_that_is_too_short_has_no_errors_and_says_so(rng):
    estimate, truth = winding_path(rng, 20, 1e-3)
    errors = kitti_drift.segment_errors(as_trajectory(estimate), as_trajectory(truth))
    assert not bool(errors.ok()) and float(errors.translation_percent()) == 0.0
    assert float(errors.rotation_deg_per_meter()) == 0.0


def test_a_scale_error_of_two_percent_is_two_percent(x64):
    truth = np.tile(np.eye(4), (300, 1, 1))
    truth[:, 2, 3] = 1.001 * np.arange(300.0)
    estimate = truth.copy()
    estimate[:, 2, 3] *= 1.02
    paths = as_trajectory(estimate), as_trajectory(truth)
    assert float(kitti_drift.segment_errors(*paths).translation_percent()) == pytest.approx(2.0, rel=0.02)
    assert float(kitti_drift.end_drift_percent(*paths)) == pytest.approx(2.0)
    np.testing.assert_allclose(kitti_drift.drift_curve_percent(*paths)[1:], 2.0)
    # The frame in which the estimate starts does not matter.
    turn = np.eye(4)
    turn[:3, :3], turn[:3, 3] = Rotation.from_rotvec([0.1, 2.0, 0.3]).as_matrix(), [5.0, 6.0, 7.0]
    assert float(kitti_drift.end_drift_percent(as_trajectory(turn @ estimate), paths[1])) == pytest.approx(2.0)


def test_gradients_are_right_and_finite_where_nothing_is_wrong(rng, x64):
    estimate, truth = winding_path(rng, 60, 1e-3)
    for start in (estimate, truth, np.tile(np.eye(4), (60, 1, 1))):
        path, reference = as_trajectory(start), as_trajectory(truth)

        def loss(positions, path=path, reference=reference):
            moved = eqx.tree_at(lambda p: p.poses.translation, path, positions)
            errors = kitti_drift.segment_errors(moved, reference, lengths=(10.0, 20.0))
            return errors.translation_percent() + kitti_drift.end_drift_percent(moved, reference)

        gradient = jax.grad(loss)(path.positions)
        assert bool(jnp.all(jnp.isfinite(gradient)))
        if start is estimate:
            direction = jnp.asarray(rng.standard_normal((60, 3)))
            numeric = (loss(path.positions + 1e-5 * direction) - loss(path.positions - 1e-5 * direction)) / 2e-5
            assert float(jnp.sum(gradient * direction)) == pytest.approx(float(numeric), rel=1e-5)


def test_lengths_fit_the_path():
    assert kitti_drift.fitting_lengths(1000.0) == kitti_drift.KITTI_LENGTHS
    assert kitti_drift.fitting_lengths(350.0) == (100.0, 200.0, 300.0)
    assert kitti_drift.fitting_lengths(32.0)[-1] == 16.0 and len(kitti_drift.fitting_lengths(32.0)) == 8
    assert kitti_drift.fitting_lengths(0.0) == ()


@pytest.mark.recordings
def test_real_trajectories_give_the_benchmark_numbers(recordings, tmp_path, x64):
    paths = []
    for name in ("ORB", "gt"):
        source = recordings / "trajectories_evo" / f"KITTI_00_{name}.txt.gz"
        (tmp_path / name).write_bytes(gzip.decompress(source.read_bytes()))
        paths.append(kitti.read_poses(tmp_path / name))
    errors = kitti_drift.segment_errors(*paths)
    translation, rotation, count = benchmark_errors(
        *(np.asarray(p.matrices()) for p in paths), kitti_drift.KITTI_LENGTHS, 10
    )
    assert int(errors.valid.sum()) == count
    assert float(errors.translation_percent()) == pytest.approx(100.0 * translation, abs=1e-6)
    # The arc cosine of the definition magnifies the six digits that the files have.
    assert float(errors.rotation_deg_per_meter()) == pytest.approx(np.degrees(rotation), abs=1e-5)
