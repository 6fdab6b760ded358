"""Floor mosaics: accuracy of a loop of distorted images, tracking, and the update rate, beside OpenCV."""

from collections.abc import Iterator

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.metric import ACCURACY, TIME, Metric, quickest, timed, versus
from jaxloc.data.simulate import floor
from jaxloc.evaluation import update_rate
from jaxloc.pipelines import floor_mosaic
from jaxloc.poses import SE2
from jaxloc.poses.planar import compose_poses, relative_poses
from jaxloc.slam import mosaic


def metrics(smoke: bool) -> Iterator[Metric]:
    camera = floor.make_camera((160, 208), height=0.045) if smoke else floor.make_camera()
    frames = 24 if smoke else 60
    drive = floor.drive_loop(num_frames=frames, step=0.008 if smoke else 0.025, camera=camera)
    built, taken = timed(
        lambda: floor_mosaic.make_mosaic(
            drive.frames, drive.odometry, camera.ground, covariances=drive.covariances, initial=drive.poses[0]
        )
    )
    pixel = float(built.mosaic.raster.resolution)
    yield Metric("mosaic.make", taken.wall / frames, "s", "lower")
    yield from _loop(drive, built, pixel)
    yield from _pairs(drive, built, pixel, 3 if smoke else 20)
    yield from _tracking(drive, built, pixel, 4 if smoke else 30)
    yield from _update_rate()


def _loop(drive: floor.FloorDrive, built: floor_mosaic.FloorMosaic, pixel: float) -> Iterator[Metric]:
    """Errors of the path: at its end before the loop is closed, and everywhere after."""
    way = np.linalg.norm(np.diff(drive.poses[:, :2], axis=0), axis=1).sum()
    before = _distances(drive.poses, built.before_closure)[-1]
    after = _distances(drive.poses, built.poses)
    reckoned = _distances(drive.poses, drive.reckoned())[-1]
    yield Metric("mosaic.loop.odometry", 100.0 * reckoned / way, "% of path")
    yield Metric("mosaic.loop.before", 100.0 * before / way, "% of path", "lower", 0.5)
    yield Metric("mosaic.loop.after", after.max() / pixel, "px", "lower", 0.5)
    yield Metric("mosaic.left_out", len(built.left_out), "images", "lower", ACCURACY)


def _pairs(drive: floor.FloorDrive, built: floor_mosaic.FloorMosaic, pixel: float, count: int) -> Iterator[Metric]:
    """Image to image, beside OpenCV's ECC and phase correlation on the same rectified patches."""
    rectifier = built.view.rectifier()
    ours, ecc, phase = [], [], []
    for number in range(count):
        first, second = (rectifier.rectify(drive.frames[number + k]) for k in (0, 1))
        truth = relative_poses(drive.poses[number][None], drive.poses[number + 1][None])
        guess = SE2(*drive.odometry[number])
        found = mosaic.register(first, second, guess).estimate.value
        ours.append(_distances(truth, _rows(found))[0])
        start = np.asarray(first.raster.warp(guess, second.raster).matrix(), np.float32)
        pictures = [np.asarray(patch.values) for patch in (second, first)]
        masks = np.asarray(first.known, np.uint8) * 255
        ecc.append(_distances(truth, _opencv(first.raster, second.raster, _ecc(pictures, start, masks)))[0])
        shifted = _phase(pictures, start)
        phase.append(_distances(truth, _opencv(first.raster, second.raster, shifted))[0])
    for name, errors in (("", ours), (".cv2_ecc", ecc), (".cv2_phase", phase)):
        tolerance = ACCURACY if not name else None
        yield Metric(f"mosaic.pair.max{name}", max(errors) / pixel, "px", "lower", tolerance)
    mine = quickest(lambda: mosaic.register(first, second, guess).estimate.value)
    yield Metric("mosaic.pair", 1e3 * mine.wall, "ms", "lower", TIME)
    yield from versus("mosaic.pair.vs_cv2_ecc", mine, quickest(lambda: _ecc(pictures, start, masks) is None, 3))


def _ecc(pictures: list[np.ndarray], start: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """OpenCV's warp of rotation and shift, from the second patch to the first."""
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 100, 1e-7)
    return cv2.findTransformECC(*pictures, start[:2].copy(), cv2.MOTION_EUCLIDEAN, stop, mask, 5)[1]


def _phase(pictures: list[np.ndarray], start: np.ndarray) -> np.ndarray:
    """The shift that is left when the first patch is turned as predicted."""
    second, first = pictures
    turned = cv2.warpAffine(first, start[:2], second.shape[::-1], flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    (right, down), _ = cv2.phaseCorrelate(second, turned, cv2.createHanningWindow(second.shape[::-1], cv2.CV_32F))
    found = start[:2].astype(float)
    found[:, 2] += found[:, :2] @ np.array([right, down])
    return found


def _opencv(first: mosaic.Raster, second: mosaic.Raster, warp: np.ndarray) -> np.ndarray:
    """The pose of a warp of pixels, in double precision."""
    resolution, middle = float(first.resolution), np.asarray(second.origin, float)
    shift = np.asarray(first.origin, float) + resolution * warp[:, 2] - warp[:, :2] @ middle
    return np.array([[*shift, np.arctan2(warp[1, 0], warp[0, 0])]])


def _tracking(drive: floor.FloorDrive, built: floor_mosaic.FloorMosaic, pixel: float, count: int) -> Iterator[Metric]:
    """Places beside the path, seen with another exposure, from predictions that are some pixels off."""
    rng = np.random.default_rng(5)
    photographer = floor.Photographer(drive.floor, drive.camera)
    truth = compose_poses(drive.poses[:count], rng.normal(size=(count, 3)) * np.array([20 * pixel, 20 * pixel, 0.1]))
    images = [photographer.take(pose, gain=1.1, rng=rng) for pose in truth]
    starts = compose_poses(truth, rng.normal(size=(count, 3)) * np.array([5 * pixel, 5 * pixel, 0.01]))
    rectifier = floor_mosaic.tracking_rectifier(built.view, floor_mosaic.Config())
    guesses = [SE2(*start) for start in starts]
    found = [
        mosaic.track(built.mosaic, image, start, view=rectifier) for image, start in zip(images, guesses, strict=True)
    ]
    errors = _distances(truth, np.concatenate([_rows(fit.value) for fit in found]))
    yield Metric("mosaic.track.ok", float(np.mean([bool(fit.ok) for fit in found])), "share", "higher", 0.01)
    yield Metric("mosaic.track.max", 1e3 * errors.max(), "mm", "lower", 0.5)
    each = [
        timed(lambda image=image, start=start: mosaic.track(built.mosaic, image, start, view=rectifier))[1].wall
        for image, start in zip(images, guesses, strict=True)
    ]
    yield Metric("mosaic.track.rate", 1.0 / float(np.median(each)), "1/s", "higher", TIME)


def _update_rate() -> Iterator[Metric]:
    """The spacing of updates that simulated drives end best with, over that of the formula."""
    sigma, k, way = 2e-3, 3e-4, 25.0
    counts = np.unique(np.rint(way / np.geomspace(0.45, 3.6, 18)))
    drift = update_rate.simulate_drift(
        jnp.asarray(counts, jnp.float32), sigma=sigma, k=k, way=way, key=jax.random.key(1), most=int(counts[-1])
    )
    for name, combination in (("plain", update_rate.PlainSum()), ("quadrature", update_rate.Quadrature())):
        found = update_rate.find_minimum(
            jnp.asarray(way / counts, jnp.float32), combination.combine(drift.deviation, drift.offset)
        )
        best = update_rate.best_spacing(sigma=sigma, k=k, way=way, combination=combination)
        yield Metric(f"mosaic.update_rate.{name}", float(found / best), "of formula", "equal", ACCURACY)


def _distances(truth: np.ndarray, found: np.ndarray) -> np.ndarray:
    return np.linalg.norm(relative_poses(truth, found)[:, :2], axis=1)


def _rows(pose: SE2) -> np.ndarray:
    return np.array([[float(pose.x), float(pose.y), float(pose.theta)]])
