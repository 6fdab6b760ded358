"""ATE and RPE against evo, another implementation, on made-up and on real trajectories."""

import gzip

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from evo.core import metrics
from evo.core.trajectory import PosePath3D
from scipy.spatial.transform import Rotation

from jaxloc.data import kitti, tum
from jaxloc.evaluation import trajectories
from jaxloc.evaluation.trajectories.alignment import NoAlignment, RigidAlignment, SimilarityAlignment
from jaxloc.evaluation.trajectories.ate import ate
from jaxloc.evaluation.trajectories.paths import synchronize
from jaxloc.evaluation.trajectories.rpe import Frames, Meters, rpe
from jaxloc.poses import Trajectory

COUNT = 60


def random_matrices(rng, count=COUNT):
    """A winding path, as 4x4 matrices."""
    matrices = np.tile(np.eye(4), (count, 1, 1))
    for index in range(1, count):
        step = np.eye(4)
        step[:3, :3] = Rotation.from_rotvec(0.1 * rng.standard_normal(3)).as_matrix()
        step[:3, 3] = [0.1 * rng.standard_normal(), 0.1 * rng.standard_normal(), 1.0 + 0.2 * rng.standard_normal()]
        matrices[index] = matrices[index - 1] @ step
    return matrices


def disturbed(rng, matrices):
    result = matrices.copy()
    for matrix in result:
        matrix[:3, :3] = matrix[:3, :3] @ Rotation.from_rotvec(0.02 * rng.standard_normal(3)).as_matrix()
        matrix[:3, 3] += 0.3 * rng.standard_normal(3)
    turn = np.eye(4)
    turn[:3, :3], turn[:3, 3] = Rotation.from_rotvec([0.3, -0.4, 0.5]).as_matrix(), [3.0, -2.0, 1.0]
    result = turn @ result
    result[:, :3, 3] *= 1.1
    return result


def as_trajectory(matrices):
    return Trajectory.from_matrices(jnp.arange(float(len(matrices))), jnp.asarray(matrices))


@pytest.fixture
def paths(rng):
    truth = random_matrices(rng)
    return disturbed(rng, truth), truth


ALIGNMENTS = {
    "none": (NoAlignment(), None),
    "rigid": (RigidAlignment(), dict(correct_scale=False)),
    "similarity": (SimilarityAlignment(), dict(correct_scale=True)),
}


def evo_ate(estimate, truth, options):
    reference, moved = PosePath3D(poses_se3=list(truth)), PosePath3D(poses_se3=list(estimate))
    if options is not None:
        moved.align(reference, **options)
    metric = metrics.APE(metrics.PoseRelation.translation_part)
    metric.process_data((reference, moved))
    return metric


def evo_rpe(estimate, truth, relation, **options):
    metric = metrics.RPE(relation, pairs_from_reference=True, **options)
    metric.process_data((PosePath3D(poses_se3=list(truth)), PosePath3D(poses_se3=list(estimate))))
    return metric.error


@pytest.mark.parametrize("name", ALIGNMENTS)
def test_ate_is_that_of_evo(paths, name, x64):
    alignment, options = ALIGNMENTS[name]
    expected = evo_ate(*paths, options)
    errors = ate(as_trajectory(paths[0]), as_trajectory(paths[1]), alignment=alignment)
    np.testing.assert_allclose(errors.values, expected.error, atol=1e-9)
    statistics = expected.get_all_statistics()
    for ours, theirs in (("rmse", "rmse"), ("mean", "mean"), ("median", "median"), ("largest", "max")):
        assert float(getattr(errors, ours)()) == pytest.approx(statistics[theirs], abs=1e-9)


SPACINGS = [
    (Frames(1), dict(delta=1, delta_unit=metrics.Unit.frames)),
    (Frames(7), dict(delta=7, delta_unit=metrics.Unit.frames, all_pairs=True)),
    (Frames(7, all_pairs=False), dict(delta=7, delta_unit=metrics.Unit.frames)),
    (Meters(5.0), dict(delta=5.0, delta_unit=metrics.Unit.meters)),
    (Meters(5.0, all_pairs=True), dict(delta=5.0, delta_unit=metrics.Unit.meters, all_pairs=True)),
]


@pytest.mark.parametrize("spacing, options", SPACINGS)
def test_rpe_is_that_of_evo(paths, spacing, options, x64):
    errors = rpe(as_trajectory(paths[0]), as_trajectory(paths[1]), spacing=spacing)
    for ours, relation in (
        (errors.translation, metrics.PoseRelation.translation_part),
        (errors.rotation, metrics.PoseRelation.rotation_angle_rad),
    ):
        expected = evo_rpe(*paths, relation, **options)
        np.testing.assert_allclose(ours.values[ours.valid], expected, atol=1e-9)
        assert int(ours.count()) == len(expected) > 3


def test_dtypes_are_kept_and_single_precision_is_accurate(paths, dtype):
    estimate, truth = (as_trajectory(matrices) for matrices in paths)
    errors, relative = ate(estimate, truth), rpe(estimate, truth)
    assert errors.values.dtype == dtype and relative.rotation.values.dtype == dtype
    tolerance = 1e-4 if dtype == np.float32 else 1e-9
    np.testing.assert_allclose(errors.values, evo_ate(*paths, dict(correct_scale=False)).error, atol=tolerance)
    expected = evo_rpe(*paths, metrics.PoseRelation.rotation_angle_rad, delta=1, delta_unit=metrics.Unit.frames)
    np.testing.assert_allclose(relative.rotation.values, expected, atol=tolerance)


def test_poses_that_do_not_count_are_as_if_absent(paths, x64):
    valid = np.arange(COUNT) % 3 != 0
    broken = paths[0].copy()
    broken[~valid, :3, 3] = np.nan
    errors = ate(as_trajectory(broken), as_trajectory(paths[1]), valid=jnp.asarray(valid))
    absent = ate(as_trajectory(paths[0][valid]), as_trajectory(paths[1][valid]))
    np.testing.assert_allclose(errors.values[valid], absent.values, atol=1e-9)
    for name in ("rmse", "mean", "median", "largest"):
        assert float(getattr(errors, name)()) == pytest.approx(float(getattr(absent, name)()))
    none = ate(as_trajectory(broken), as_trajectory(paths[1]), valid=jnp.zeros(COUNT, bool))
    assert all(float(getattr(none, name)()) == 0.0 for name in ("rmse", "mean", "median", "largest"))


@pytest.mark.parametrize("name", ALIGNMENTS)
def test_the_gradient_of_the_rmse_is_exact_also_through_the_alignment(paths, name, x64):
    estimate, truth = (as_trajectory(matrices[:12]) for matrices in paths)
    alignment = ALIGNMENTS[name][0]

    def loss(positions):
        moved = eqx.tree_at(lambda path: path.poses.translation, estimate, positions)
        return ate(moved, truth, alignment=alignment).rmse()

    positions = estimate.positions
    gradient = jax.grad(loss)(positions)
    direction = jax.random.normal(jax.random.key(0), positions.shape)
    numeric = (loss(positions + 1e-5 * direction) - loss(positions - 1e-5 * direction)) / 2e-5
    assert float(jnp.sum(gradient * direction)) == pytest.approx(float(numeric), rel=1e-6)


def test_identical_standing_and_straight_paths_give_finite_values_and_gradients(x64):
    straight = np.tile(np.eye(4), (10, 1, 1))
    straight[:, 2, 3] = np.arange(10.0)
    for matrices in (straight, np.tile(np.eye(4), (10, 1, 1))):
        path = as_trajectory(matrices)

        def loss(positions, path=path):
            moved = eqx.tree_at(lambda p: p.poses.translation, path, positions)
            relative = rpe(moved, path, spacing=Meters(2.0))
            total = ate(moved, path, alignment=SimilarityAlignment()).rmse()
            return total + relative.translation.rmse() + relative.rotation.mean()

        value, gradient = jax.value_and_grad(loss)(path.positions)
        assert float(value) == pytest.approx(0.0, abs=1e-12)
        assert bool(jnp.all(jnp.isfinite(gradient)))


def test_batches_of_paths_are_vmapped(paths, x64):
    estimate, truth = (as_trajectory(matrices) for matrices in paths)
    stack = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), estimate)
    values = jax.vmap(lambda path: ate(path, truth).rmse())(stack)
    np.testing.assert_allclose(values, float(ate(estimate, truth).rmse()), rtol=1e-12)


def test_rotation_angle_is_accurate_near_zero_and_at_a_half_turn(dtype):
    angles = np.array([0.0, 1e-6, 1e-3, 0.5, 3.0, np.pi])
    matrices = Rotation.from_rotvec(angles[:, None] * np.array([[0.6, 0.0, 0.8]])).as_matrix()
    actual = jax.vmap(trajectories.rotation_angle)(jnp.asarray(matrices))
    np.testing.assert_allclose(actual, angles, rtol=1e-5, atol=1e-7)


def test_different_lengths_are_refused(paths):
    with pytest.raises(ValueError, match="60 poses and the truth 59"):
        ate(as_trajectory(paths[0]), as_trajectory(paths[1][:-1]))


def test_synchronize_pairs_nearest_times_in_both_orders(x64):
    def path(times):
        matrices = np.tile(np.eye(4), (len(times), 1, 1))
        matrices[:, 0, 3] = times
        return Trajectory.from_matrices(jnp.asarray(times), jnp.asarray(matrices))

    dense, sparse = path(0.1 * np.arange(20)), path(np.array([0.004, 0.512, 0.55, 1.898, 5.0]))
    first, second = synchronize(sparse, dense, max_difference=0.02)
    np.testing.assert_allclose(first.times, [0.004, 0.512, 1.898])
    np.testing.assert_allclose(second.times, [0.0, 0.5, 1.9])
    second, first = synchronize(dense, sparse, max_difference=0.02)
    np.testing.assert_allclose(first.positions[:, 0], [0.004, 0.512, 1.898])
    with pytest.raises(ValueError, match="same stamp"):
        synchronize(path(np.array([100.0])), dense)


def unpacked(source, folder):
    target = folder / source.name.removesuffix(".gz")
    target.write_bytes(gzip.decompress(source.read_bytes()))
    return target


@pytest.mark.recordings
def test_real_kitti_trajectories_give_evos_numbers(recordings, tmp_path, x64):
    folder = recordings / "trajectories_evo"
    files = [unpacked(folder / f"KITTI_00_{name}.txt.gz", tmp_path) for name in ("gt", "ORB")]
    truth, estimate = (kitti.read_poses(file) for file in files)
    matrices = [np.asarray(path.matrices()) for path in (estimate, truth)]
    for alignment, options in ALIGNMENTS.values():
        expected = evo_ate(*matrices, options).get_all_statistics()["rmse"]
        assert float(ate(estimate, truth, alignment=alignment).rmse()) == pytest.approx(expected, abs=1e-6)
    for spacing, options in (SPACINGS[0], (Meters(100.0), dict(delta=100.0, delta_unit=metrics.Unit.meters))):
        errors = rpe(estimate, truth, spacing=spacing)
        expected = evo_rpe(*matrices, metrics.PoseRelation.translation_part, **options)
        np.testing.assert_allclose(errors.translation.values[errors.translation.valid], expected, atol=1e-6)
        # The files print six digits: their matrices are rotations only to that.
        expected = evo_rpe(*matrices, metrics.PoseRelation.rotation_angle_rad, **options)
        np.testing.assert_allclose(errors.rotation.values[errors.rotation.valid], expected, atol=1e-6)


@pytest.mark.recordings
def test_real_tum_trajectories_give_evos_numbers(recordings, tmp_path, x64):
    from evo.core import sync
    from evo.tools import file_interface

    names = ("rgbdslam_drift", "groundtruth")
    files = [unpacked(recordings / "trajectories_evo" / f"freiburg1_xyz-{name}.txt.gz", tmp_path) for name in names]
    reference, moved = (file_interface.read_tum_trajectory_file(str(file)) for file in files[::-1])
    reference, moved = sync.associate_trajectories(reference, moved, max_diff=0.01)
    estimate, truth = (tum.read_trajectory(file, start=1305031098.0).trajectory for file in files)
    estimate, truth = synchronize(estimate, truth, max_difference=0.01)
    assert len(estimate) == moved.num_poses
    expected = evo_rpe(moved.poses_se3, reference.poses_se3, metrics.PoseRelation.translation_part, **SPACINGS[0][1])
    np.testing.assert_allclose(rpe(estimate, truth).translation.values, expected, atol=1e-6)
    for alignment, options in ALIGNMENTS.values():
        expected = evo_ate(moved.poses_se3, reference.poses_se3, options).get_all_statistics()["rmse"]
        assert float(ate(estimate, truth, alignment=alignment).rmse()) == pytest.approx(expected, abs=1e-6)
