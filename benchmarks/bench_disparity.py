"""Stereo on the motorcycle of Middlebury, whose true disparity is known: points with covariance, and every pixel."""

from collections.abc import Iterator

import cv2
import jax.numpy as jnp
import numpy as np
from skimage import data

from benchmarks.metric import ACCURACY, TIME, Metric, quickest, versus
from jaxloc.features import opencv, subpixel
from jaxloc.features.match import match as match_descriptors
from jaxloc.features.match import row_gate
from jaxloc.features.opencv.describe import describe
from jaxloc.features.opencv.detectors import ORB, ShiTomasi
from jaxloc.multiview.disparity import SSD, ZNCC, BlockMatching, Census, DisparityMap, match, refine
from jaxloc.odometry.stereo_matching import MatchingOptions

_SIZE = 7


def metrics(smoke: bool) -> Iterator[Metric]:
    *colors, truth = data.stereo_motorcycle()
    left, right = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in colors)
    yield from _sparse(left, right, truth)
    yield from _dense(left, right, truth, 1 if smoke else 5)


def _sparse(left: np.ndarray, right: np.ndarray, truth: np.ndarray) -> Iterator[Metric]:
    """Corners matched by ORB's descriptors along rows, their columns refined."""
    points = [opencv.detect(ShiTomasi(), image, 3000) for image in (left, right)]
    words = [describe(ORB(), image, found) for image, found in zip((left, right), points, strict=True)]
    gate = row_gate(points[0].uv, points[1].uv, tolerance=2.0, disparity=(0.0, 100.0))
    pairs = match_descriptors(*words, gate=gate, ratio=0.9)
    pictures = [jnp.asarray(image, jnp.float32) for image in (left, right)]
    options = subpixel.PatchRefinement(size=_SIZE)
    found = subpixel.refine_stereo(*pictures, points[0].uv, points[1].uv[pairs.index], options=options)
    column, row = np.round(np.asarray(points[0].uv)).astype(int).T
    true = truth[np.clip(row, 0, truth.shape[0] - 1), np.clip(column, 0, truth.shape[1] - 1)]
    known = np.asarray(pairs.valid & found.ok) & np.isfinite(true) & (true > 0)
    error = (np.asarray(points[0].uv - found.uv)[:, 0] - true)[known]
    near = np.abs(error) < 1.0
    variance = np.asarray(found.variance)[known] + MatchingOptions().sigma ** 2
    yield Metric("disparity.sparse.matches", float(known.sum()), "matches", "higher", ACCURACY)
    yield Metric("disparity.sparse.within_1px", float(near.mean()), "share", "higher", ACCURACY)
    yield Metric("disparity.sparse.median", float(np.median(np.abs(error))), "px", "lower", ACCURACY)
    yield Metric("disparity.sparse.nees", float(np.mean(error[near] ** 2 / variance[near])), "of 1", "equal", 0.3)


def _figures(key: str, found: DisparityMap, truth: np.ndarray) -> Iterator[Metric]:
    known = np.isfinite(truth) & (truth > 0)
    shown = known & np.asarray(found.valid)
    error = np.abs(np.asarray(found.disparity) - truth)[shown]
    yield Metric(f"disparity.{key}.density", float(shown.sum() / known.sum()), "share", "higher", ACCURACY)
    yield Metric(f"disparity.{key}.bad2", 100.0 * float((error > 2).mean()), "%", "lower", ACCURACY)
    yield Metric(f"disparity.{key}.median", float(np.median(error)), "px", "lower", ACCURACY)


def _dense(left: np.ndarray, right: np.ndarray, truth: np.ndarray, repeats: int) -> Iterator[Metric]:
    pictures = [jnp.asarray(image, jnp.float32) for image in (left, right)]
    peer = quickest(lambda: match(left, right).disparity, repeats)
    semi_global = match(left, right)
    yield from _figures("cv2_sgbm", semi_global, truth)
    yield from _figures("cv2_sgbm.refined", refine(*pictures, semi_global), truth)
    took = quickest(lambda: refine(*pictures, semi_global).disparity, repeats)
    yield Metric("disparity.refine", 1e3 * took.wall, "ms", "lower", TIME)
    for cost in (Census(), ZNCC(), SSD()):
        matcher, key = BlockMatching(cost, size=_SIZE), type(cost).__name__.lower()
        yield from _figures(key, match(*pictures, matcher=matcher), truth)
        ours = quickest(lambda m=matcher: match(*pictures, matcher=m).disparity, repeats)
        yield Metric(f"disparity.{key}", 1e3 * ours.wall, "ms", "lower", TIME)
        yield from versus(f"disparity.{key}.vs_cv2_sgbm", ours, peer)
