"""Floor mosaics: rasters, rectification, registration, blending and tracking against exact truth and peers."""

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.alignment.lucas_kanade import LucasKanade, Pyramid
from jaxloc.data.simulate import floor
from jaxloc.images.warps import Euclidean
from jaxloc.poses import SE2, compound
from jaxloc.poses.planar import compose_poses, relative_poses
from jaxloc.slam import mosaic
from jaxloc.slam.mosaic import CosineFourth, FloorView, Overlap, Patch, Raster, Squares

SHAPE, HEIGHT = (120, 160), 0.035
PIXEL = HEIGHT / 175.0


def planar(rows):
    return jax.vmap(SE2)(*jnp.asarray(rows, jnp.result_type(float)).T)


@pytest.fixture(scope="module")
def drive():
    """Images a tenth of their height apart, through a lens with k1 = -0.3."""
    return floor.drive_loop(5, num_frames=60, step=0.003, camera=floor.make_camera(SHAPE, height=HEIGHT))


@pytest.fixture(scope="module")
def rectifier(drive):
    falloff = mosaic.fit_falloff(drive.frames, black=6.0)
    return FloorView.of(drive.camera.ground, SHAPE, falloff=falloff, black=6.0).rectifier()


@pytest.fixture(scope="module")
def patches(drive, rectifier):
    return rectifier.rectify_all(drive.frames[:6])


@pytest.fixture(scope="module")
def world(drive, patches):
    """A mosaic of six images at their true poses."""
    poses = planar(drive.poses[:6])
    return mosaic.blend(patches, poses, mosaic.enclose(poses, patches.raster))


def one(patches, number):
    return Patch(patches.values[number], patches.weight[number], patches.raster)


def test_rasters_take_poses_to_warps_and_back(x64, rng):
    outer, inner = Raster(jnp.array([-1.0, 2.0]), 0.01, (50, 60)), Raster(jnp.array([0.3, -0.4]), 0.01, (20, 30))
    pose, points = SE2(0.4, 2.2, 0.7), jnp.asarray(rng.uniform(0, 20, (7, 2)))
    warp = outer.warp(pose, inner)
    np.testing.assert_allclose(warp.apply(points), outer.to_pixels(pose.apply(inner.to_meters(points))), atol=1e-10)
    np.testing.assert_allclose(outer.pose(warp, inner).matrix(), pose.matrix(), atol=1e-12)
    delta = jnp.asarray(rng.normal(size=3) * 1e-3)
    moved = outer.pose(warp.retract(delta), inner)
    np.testing.assert_allclose(pose.local(moved), inner.tangent_to_meters() @ delta, atol=1e-12)
    with pytest.raises(ValueError, match="shape is"):
        Raster(jnp.zeros(2), 1.0, (0, 3))


def test_rectified_pixels_are_those_of_opencv(drive, rectifier):
    """The lens and the homography of the floor by OpenCV's own functions."""
    x, y = (np.asarray(axis, np.float64).ravel() for axis in rectifier.raster.centers())
    points = np.column_stack([-y, -x, np.full_like(x, HEIGHT)])
    pinhole = drive.camera.ground.camera
    pixels, _ = cv2.projectPoints(
        points, np.zeros(3), np.zeros(3), np.asarray(pinhole.matrix(), np.float64), np.array([-0.3, 0, 0, 0.0])
    )
    np.testing.assert_allclose(rectifier.u, pixels[:, 0, 0], atol=2e-3)
    np.testing.assert_allclose(rectifier.v, pixels[:, 0, 1], atol=2e-3)


def test_shading_is_taken_out(drive):
    fitted = mosaic.fit_falloff(drive.frames, black=drive.camera.black)
    u, v = np.float32([79.5, 20.0, 0.0, 159.0]), np.float32([59.5, 20.0, 0.0, 119.0])
    np.testing.assert_allclose(
        fitted.shade(jnp.asarray(u), jnp.asarray(v), jnp.ones(4)), drive.camera.vignetting(u, v), rtol=0.06
    )
    np.testing.assert_allclose(CosineFourth().shade(jnp.ones(1), jnp.ones(1), jnp.array([0.5])), 0.0625)
    assert bool(jnp.all(mosaic.fit_falloff(jnp.zeros((2, *SHAPE))).coefficients == 0.0))


def test_pixels_without_number_leave_holes(drive, rectifier):
    image = drive.frames[0].astype(np.float32)
    image[50:60, 70:90] = np.nan
    patch, whole = rectifier.rectify(image), rectifier.rectify(drive.frames[0])
    hole = np.asarray(whole.known & ~patch.known)
    assert 200 < hole.sum() < 500 and bool(jnp.all(jnp.isfinite(patch.values)))
    np.testing.assert_allclose(np.where(hole, 0.0, patch.values), np.where(hole, 0.0, whole.values), atol=1e-3)


def test_the_feature_jacobian_is_that_of_autodiff(x64, rng):
    """The printed slide lacks the heading: with it, the rows are those of the compound pose."""
    pose, points = SE2(0.3, -0.2, 0.8), jnp.asarray(rng.normal(size=(5, 2)))
    auto = jax.jacfwd(lambda p: SE2(p[0], p[1], p[2]).apply(points))(jnp.array([0.3, -0.2, 0.8]))
    found = mosaic.feature_jacobian(pose, points)
    np.testing.assert_allclose(found, auto, atol=1e-12)
    whole = compound.left_jacobian(pose, SE2(points[0, 0], points[0, 1], 0.4))
    np.testing.assert_allclose(found[0], whole[:2], atol=1e-12)


@eqx.filter_jit
def both_ways(problem, state):
    """Linearized in closed form and by autodiff."""
    return problem.linearize(state), super(type(problem), problem).linearize(state)


def test_poses_from_features(x64, rng):
    truth, points = SE2(0.02, -0.01, 0.4), jnp.asarray(rng.uniform(-0.05, 0.05, (12, 2)))
    seen = truth.apply(points) + 1e-4 * jnp.asarray(rng.normal(size=(12, 2)))
    valid = jnp.arange(12) < 10
    spoiled = jnp.where(valid[:, None], seen, jnp.nan)
    fit = mosaic.pose_from_features(spoiled, points, SE2(0.0, 0.0, 0.0), sigma=1e-4, valid=valid)
    a, b = np.asarray(seen[:10]), np.asarray(points[:10])
    u, _, vt = np.linalg.svd((b - b.mean(0)).T @ (a - a.mean(0)))
    rotation = vt.T @ np.diag([1.0, np.linalg.det(vt.T @ u.T)]) @ u.T
    np.testing.assert_allclose(fit.value.rotation.matrix(), rotation, atol=1e-8)
    np.testing.assert_allclose(fit.value.translation, a.mean(0) - rotation @ b.mean(0), atol=1e-9)
    problem = mosaic.FeaturePairs(spoiled.T, points.T, jnp.full(12, 1e-4), valid)
    problem = eqx.tree_at(lambda p: p.points_i, problem, jnp.where(valid[None], seen.T, 0.0))
    closed, auto = both_ways(problem, truth)
    np.testing.assert_allclose(closed.jacobian, auto.jacobian, atol=1e-6)
    assert not bool(mosaic.pose_from_features(seen, points, truth, valid=jnp.arange(12) < 1).ok)


@pytest.mark.slow
def test_registration_is_exact_to_a_twentieth_of_a_pixel(drive, patches):
    squared = []
    for number in range(5):
        truth = SE2(*relative_poses(drive.poses[number][None], drive.poses[number + 1][None])[0])
        found = mosaic.register(one(patches, number), one(patches, number + 1), SE2(*drive.odometry[number]))
        error = truth.local(found.estimate.value)
        assert bool(found.estimate.ok) and float(jnp.linalg.norm(error[:2])) < 0.05 * PIXEL
        assert abs(float(error[2])) * 80 < 0.1 and 0.7 < float(found.overlap.share) <= 1.0
        squared.append(float(error @ jnp.linalg.solve(found.estimate.covariance, error)))
    assert np.mean(squared) < 3 * 3
    # Exposures differ by what the overlap says.
    ratio = found.overlap.deviations[0] / found.overlap.deviations[1]
    assert float(ratio) == pytest.approx(drive.gains[4] / drive.gains[5], rel=0.03)


@pytest.mark.slow
def test_squares_find_what_derivatives_do_not(drive, patches):
    truth = SE2(*relative_poses(drive.poses[0][None], drive.poses[1][None])[0])
    guess = truth @ SE2(12 * PIXEL, -9 * PIXEL, 0.02)
    found = mosaic.register_squares(one(patches, 0), one(patches, 1), guess, squares=Squares(21, 3, 20))
    error = truth.local(found.value)
    assert bool(found.ok) and float(jnp.linalg.norm(error[:2])) < 0.5 * PIXEL
    flat = Patch(jnp.full((160, 120), 50.0), jnp.ones((160, 120)), patches.raster)
    assert not bool(mosaic.register_squares(flat, one(patches, 1), guess, squares=Squares(21, 3, 20)).ok)
    with pytest.raises(ValueError, match="hold no 9 squares"):
        mosaic.register_squares(flat, flat, guess, squares=Squares(33, 9, 60))


def test_exposures_are_balanced():
    gains, biases = np.array([1.0, 1.2, 0.8, 1.1]), np.array([0.0, 5.0, -3.0, 2.0])
    pairs = np.array([[0, 1], [1, 2], [0, 2], [0, 0]])
    scene, spread = np.array([100.0, 120.0, 90.0, 1.0]), np.array([20.0, 15.0, 25.0, 1.0])
    overlap = Overlap(
        jnp.ones(4),
        jnp.asarray(gains[pairs] * scene[:, None] + biases[pairs], jnp.float32),
        jnp.asarray(gains[pairs] * spread[:, None], jnp.float32),
    )
    found = mosaic.balance(jnp.asarray(pairs[:, 0]), jnp.asarray(pairs[:, 1]), overlap, jnp.arange(4) < 3, count=4)
    ratio = np.asarray(found.gain)[:3] / gains[:3]
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-3)
    shift = (np.asarray(found.bias) - biases)[:3] / np.asarray(found.gain)[:3]
    np.testing.assert_allclose(shift, shift[0], atol=0.05)
    assert float(found.gain[3]) == 1.0 and float(found.bias[3]) == 0.0


def test_the_blend_is_the_floor(drive, world):
    known = np.asarray(world.weight) > 0.5
    x, y = (np.asarray(axis, np.float64)[known] for axis in world.raster.centers())
    map_u, map_v = ((axis - low) / drive.floor.resolution for axis, low in zip((x, y), drive.floor.origin, strict=True))
    truth = cv2.remap(
        drive.floor.texture,
        map_u[None].astype(np.float32)[:, :30000],
        map_v[None].astype(np.float32)[:, :30000],
        cv2.INTER_CUBIC,
    )[0]
    values = np.asarray(world.values)[known][:30000]
    assert np.corrcoef(truth, values)[0, 1] > 0.98
    assert bool(jnp.all(jnp.where(world.known, 0.0, world.values) == 0.0))


def test_unused_patches_and_holes_leave_no_trace(patches, world, drive):
    poses = planar(drive.poses[:6])
    used = jnp.array([True, True, True, False, False, False])
    part = mosaic.blend(patches, poses, world.raster, used=used)
    spoiled = Patch(patches.values.at[3:].set(1e6), patches.weight, patches.raster)
    np.testing.assert_array_equal(mosaic.blend(spoiled, poses, world.raster, used=used).values, part.values)
    holed = patches.weight.at[:, 60:70, 40:50].set(0.0)
    holes = Patch(jnp.where(holed > 0, patches.values, 0.0), holed, patches.raster)
    again = mosaic.blend(holes, poses, world.raster, used=used)
    both = np.asarray(again.known & part.known)
    assert float(jnp.sum(again.weight)) < 0.99 * float(jnp.sum(part.weight))
    assert np.percentile(np.abs(np.asarray(again.values - part.values)[both]), 99.9) < 40.0


def off(pose, pixels=(3.0, -2.0), heading=0.01):
    return compose_poses(pose[None], np.array([[pixels[0] * PIXEL, pixels[1] * PIXEL, heading]]))[0]


def test_tracking_in_the_mosaic(drive, rectifier, world):
    rng = np.random.default_rng(8)
    photographer = floor.Photographer(drive.floor, drive.camera)
    for number in (1, 3):
        truth = off(drive.poses[number], (7.0, 4.0), 0.1)
        image = photographer.take(truth, gain=0.9, rng=rng)
        found = mosaic.track(world, image, SE2(*off(truth)), view=rectifier)
        error = SE2(*truth).local(found.value)
        assert bool(found.ok) and float(jnp.linalg.norm(error[:2])) < 0.1 * PIXEL
        assert float(error @ jnp.linalg.solve(found.covariance, error)) < 30.0


def test_tracking_knows_when_it_is_lost(drive, rectifier, world):
    guess, frame = SE2(*drive.poses[2]), drive.frames[2]
    bad = {
        "off the mosaic": (frame, SE2(5.0, 5.0, 0.0)),
        "blank": (np.full(SHAPE, 90, np.uint8), guess),
        "dark": (np.zeros(SHAPE, np.uint8), guess),
        "noise": (np.random.default_rng(0).integers(0, 255, SHAPE).astype(np.uint8), guess),
        "no number": (frame, SE2(jnp.nan, 0.0, 0.0)),
    }
    for name, (image, pose) in bad.items():
        found = mosaic.track(world, image, pose, view=rectifier)
        assert not bool(found.ok), name
        assert all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(found)), name
    nothing = mosaic.track(world, np.full(SHAPE, np.nan, np.float32), guess, view=rectifier)
    assert not bool(nothing.ok) and bool(jnp.all(jnp.isfinite(nothing.covariance)))


def test_one_program_serves_all_poses(drive, rectifier, world):
    traces = []

    @eqx.filter_jit
    def step(image, pose):
        traces.append(1)
        return mosaic.track(world, image, pose, view=rectifier).value.translation

    eager = mosaic.track(world, drive.frames[1], SE2(*off(drive.poses[1])), view=rectifier).value.translation
    for number in (1, 2, 4):
        found = step(jnp.asarray(drive.frames[number]), SE2(*off(drive.poses[number])))
        if number == 1:
            np.testing.assert_allclose(found, eager, atol=2e-8)
    assert len(traces) == 1


@pytest.mark.slow
def test_gradients_of_the_tracked_pose(x64, drive):
    """By the image and by the height of the camera, against central differences."""
    ground = jax.tree.map(lambda leaf: leaf.astype(jnp.float64), drive.camera.ground)
    view = FloorView.of(ground, SHAPE, shape=(80, 80), resolution=PIXEL, black=6.0)
    rectifier = view.rectifier()
    patches = rectifier.rectify_all(jnp.asarray(drive.frames[:2], jnp.float64))
    poses = planar(drive.poses[:2])
    world = mosaic.blend(patches, poses, mosaic.enclose(poses, patches.raster))
    u, v = np.meshgrid(np.arange(160.0), np.arange(120.0))
    image, ripple = jnp.asarray(drive.frames[1], jnp.float64), jnp.asarray(10.0 * np.sin(0.2 * u) * np.cos(0.15 * v))
    method = LucasKanade(scales=Pyramid(2), max_steps=60, tolerance=1e-9)

    def place(x):
        camera = eqx.tree_at(lambda r: r.ground.height, view, view.ground.height * (1.0 + x[1]))
        guess = SE2(*off(drive.poses[1], (0.5, 0.5), 0.002))
        found = mosaic.track(world, image + x[0] * ripple, guess, view=camera, method=method)
        return jnp.stack([found.value.x / PIXEL, found.value.y / PIXEL, 50.0 * found.value.theta])

    jitted, step = jax.jit(place), 1e-4
    auto = jax.jit(jax.jacfwd(place))(jnp.zeros(2))
    for axis in range(2):
        e = jnp.zeros(2).at[axis].set(step)
        numeric = (jitted(e) - jitted(-e)) / (2 * step)
        np.testing.assert_allclose(auto[:, axis], numeric, rtol=2e-3, atol=2e-3 * float(jnp.max(jnp.abs(numeric))))


def test_dtype_is_kept(dtype):
    raster = Raster(jnp.zeros(2, dtype), 0.1, (30, 30))
    assert raster.warp(SE2.identity(dtype), raster).matrix().dtype == dtype
    assert isinstance(raster.warp(SE2.identity(dtype), raster), Euclidean)
    patches = Patch(jnp.ones((2, 30, 30), dtype), jnp.ones((2, 30, 30), dtype), raster)
    poses = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), SE2.identity(dtype))
    assert mosaic.blend(patches, poses, raster).values.dtype == dtype
    assert mosaic.fit_falloff(jnp.ones((1, 8, 8), dtype)).coefficients.dtype == dtype
    assert (
        mosaic.pose_from_features(
            jnp.eye(2, dtype=dtype), jnp.eye(2, dtype=dtype), SE2.identity(dtype)
        ).covariance.dtype
        == dtype
    )
