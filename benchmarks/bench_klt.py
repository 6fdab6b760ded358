"""Tracking points: exposure, precision, covariance and time beside OpenCV's pyramidal Lucas-Kanade."""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.metric import ACCURACY, RATIO, TIME, Metric, Timing, compiled, timed
from jaxloc.alignment.klt import Klt, Tracked, prepare, track, track_frames

WINDOW = {"winSize": (21, 21), "maxLevel": 3}
IMAGES = "camera", "brick", "astronaut", "motorcycle_left", "gravel", "grass"
EXPOSURES = (0.6, 30.0), (0.8, 10.0), (0.9, 5.0), (1.0, 0.0)
CAPACITY = 800


class Pair(NamedTuple):
    """Two views, and where a point of the first is in the second."""

    previous: np.ndarray
    current: np.ndarray
    matrix: np.ndarray

    def truth(self, uv: np.ndarray) -> np.ndarray:
        """Where points of the first view are in the second."""
        return uv @ self.matrix[:, :2].T + self.matrix[:, 2]


def metrics(smoke: bool) -> Iterator[Metric]:
    yield from _exposure(("camera",) if smoke else IMAGES)
    yield from _covariance(1 if smoke else 4)
    for count in (100,) if smoke else (1000, 3000, 10000):
        yield from _clean(count, 1 if smoke else 15)


def _moved(image: np.ndarray, gain: float, bias: float, noise: float, rng: np.random.Generator) -> Pair:
    """An image and the same turned, stretched and moved by about five pixels, otherwise exposed."""
    center = np.array(image.shape[::-1]) / 2
    linear = np.array([[1.006, -0.008], [0.009, 0.996]])
    matrix = np.c_[linear, np.array([2.6, -1.8]) + center - linear @ center]
    moved = cv2.warpAffine(
        image.astype(np.float32), matrix, image.shape[::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT
    )
    views = [image + noise * rng.normal(size=image.shape), gain * moved + bias + noise * rng.normal(size=image.shape)]
    return Pair(*(np.clip(np.round(view), 0, 255).astype(np.uint8) for view in views), matrix)


def _texture(rng: np.random.Generator, shape: tuple[int, int] = (376, 1241)) -> np.ndarray:
    """Noise of spectrum 1/f, smooth enough to be warped."""
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(shape[1]), np.fft.fftfreq(shape[0])))
    filtered = np.where(frequency > 0, 1 / np.maximum(frequency, 2e-3), 0) * np.exp(-((frequency / 0.25) ** 2))
    image = np.fft.ifft2(np.fft.fft2(rng.normal(size=shape)) * filtered).real
    return np.clip(128 + 45 * image / image.std(), 0, 255)


def _corners(image: np.ndarray) -> np.ndarray:
    uv = cv2.goodFeaturesToTrack(image, CAPACITY, 0.01, 7)[:, 0]
    far = np.array(image.shape[::-1]) - 25
    return uv[((uv > 25) & (uv < far)).all(axis=1)]


def _track(pair: Pair, uv: np.ndarray) -> tuple[Tracked, np.ndarray]:
    """Results of one fixed capacity, so that images of a size share a program, and their errors."""
    padded = np.full((max(CAPACITY, len(uv)), 2), np.nan, np.float32)
    padded[: len(uv)] = uv
    found = track(jnp.asarray(pair.previous), jnp.asarray(pair.current), jnp.asarray(padded))
    found = jax.tree.map(lambda x: x[: len(uv)], found)
    return found, np.asarray(found.points) - pair.truth(uv)


def _peer(pair: Pair, uv: np.ndarray) -> np.ndarray:
    return cv2.calcOpticalFlowPyrLK(pair.previous, pair.current, uv.astype(np.float32)[:, None], None, **WINDOW)[0]


def _exposure(names: tuple[str, ...]) -> Iterator[Metric]:
    """The worst of all images and exposures: wrong by more than a pixel, and how precise the rest."""
    import skimage.data

    folder, rng, rows = Path(skimage.data.__file__).parent, np.random.default_rng(0), []
    for name in names:
        image = cv2.imread(str(folder / f"{name}.png"), cv2.IMREAD_GRAYSCALE)
        for gain, bias in EXPOSURES:
            pair = _moved(image, gain, bias, 2.0, rng)
            uv = _corners(pair.previous)
            found, error = _track(pair, uv)
            ok, distance = np.asarray(found.ok), np.linalg.norm(error, axis=1)
            peer = np.linalg.norm(_peer(pair, uv)[:, 0] - pair.truth(uv), axis=1)
            wrong = (distance > 1)[ok].mean(), (distance > 1).mean(), (peer > 1).mean()
            rows.append([ok.mean(), *wrong, np.median(distance[ok]), np.median(peer), _spread(found, error).mean()])
    ok, wrong, wrong_of_all, wrong_peer, median, median_peer, nees = np.array(rows).T
    yield Metric("klt.exposure.ok", ok.min(), "share", "higher", 0.03)
    yield Metric("klt.exposure.wrong", wrong.max(), "share", "lower", ACCURACY)
    yield Metric("klt.exposure.wrong_of_all", wrong_of_all.max(), "share", "lower", 0.5)
    yield Metric("klt.exposure.wrong.cv2", wrong_peer.max(), "share")
    yield Metric("klt.exposure.median", median.max(), "px", "lower", ACCURACY)
    yield Metric("klt.exposure.median.cv2", median_peer.max(), "px")
    yield Metric("klt.exposure.nees", nees.mean(), "of 1")
    yield Metric("klt.exposure.nees.worst", nees.max(), "of 1")


def _spread(found: Tracked, error: np.ndarray) -> np.ndarray:
    """Squared errors in sigmas, per coordinate."""
    ok = np.asarray(found.ok)
    return np.einsum("ni,nij,nj->n", error, np.linalg.inv(np.asarray(found.covariance)), error)[ok] / 2


def _covariance(seeds: int) -> Iterator[Metric]:
    """Whether errors on noisy synthetic pairs are as large as the covariances say."""
    squared = []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        pair = _moved(_texture(rng), 0.8, 10.0, 4.0, rng)
        squared.append(_spread(*_track(pair, rng.uniform(25, np.array([1215, 350]), (CAPACITY, 2)))))
    yield Metric("klt.nees", np.concatenate(squared).mean(), "of 1", "equal", 0.2)
    yield Metric("klt.nees.median", np.median(np.concatenate(squared)), "of 0.69")


def _clean(count: int, repeats: int) -> Iterator[Metric]:
    """Precision and time on clean images, both sides from bytes to points, their calls alternating."""
    rng = np.random.default_rng(1)
    pair = _moved(_texture(rng), 1.0, 0.0, 0.0, rng)
    uv = rng.uniform(25, np.array([1215, 350]), (count, 2)).astype(np.float32)
    inputs = jnp.asarray(pair.previous), jnp.asarray(pair.current), jnp.asarray(uv)
    error = np.linalg.norm(np.asarray(track(*inputs).points) - pair.truth(uv), axis=1)
    peer = np.linalg.norm(_peer(pair, uv)[:, 0] - pair.truth(uv), axis=1)
    key = f"klt.{count}"
    yield Metric(f"{key}.median", np.median(error), "px", "lower", ACCURACY)
    yield Metric(f"{key}.median.cv2", np.median(peer), "px")
    kept, both_ways = prepare(inputs[0]), Klt(max_forward_backward=1.0)
    ours, following, checked, theirs = _alternate(
        repeats,
        lambda: track(*inputs).points,
        lambda: track_frames(kept, prepare(inputs[1]), inputs[2]).points,
        lambda: track(*inputs, options=both_ways).points,
        lambda: _peer(pair, uv),
    )
    yield Metric(key, 1e3 * ours.wall, "ms", "lower", TIME)
    yield Metric(f"{key}.video", 1e3 * following.wall, "ms", "lower", TIME)
    yield Metric(f"{key}.forward_backward", 1e3 * checked.wall, "ms")
    yield Metric(f"{key}.cv2", 1e3 * theirs.wall, "ms")
    yield Metric(f"{key}.over_cv2.wall", ours.wall / theirs.wall, "x")
    yield Metric(f"{key}.over_cv2.cpu", ours.cpu / max(theirs.cpu, 1e-9), "x", "lower", RATIO)
    if count <= 1000:
        yield Metric(f"{key}.compile", compiled(lambda *x: track(*x), *inputs)[1].wall, "s", "lower", TIME)


def _alternate(repeats: int, *calls) -> list[Timing]:
    """The least time of each call, all of them in turn so that a busy machine slows them alike."""
    for call in calls:
        jax.block_until_ready(call())
    runs = [[timed(call)[1] for call in calls] for _ in range(repeats)]
    return [Timing(min(run.wall for run in each), min(run.cpu for run in each)) for each in zip(*runs, strict=True)]
