"""Pixels: keypoints, descriptor matching and subpixel refinement beside OpenCV."""

from collections.abc import Iterator

import cv2
import jax
import jax.numpy as jnp
import numpy as np

import jaxloc as jl
from benchmarks.metric import ACCURACY, TIME, Metric, quickest, versus
from jaxloc.features import match, opencv, subpixel


def metrics(smoke: bool) -> Iterator[Metric]:
    repeats = 1 if smoke else 10
    frame = jl.data.simulate_street(num_frames=1, size=(200, 640) if smoke else (376, 1241))[0]
    yield from _detect(frame.left, repeats)
    yield from _match(frame, 100 if smoke else 1000, repeats)
    yield from _subpixel(50 if smoke else 500, repeats)


def _detect(image: np.ndarray, repeats: int) -> Iterator[Metric]:
    """Evenly spread keypoints against the strongest ones of the same detector."""
    ours = quickest(lambda: opencv.detect(opencv.ORB(), image).uv, repeats)
    orb = cv2.ORB_create(nfeatures=3000, fastThreshold=12)
    yield Metric("images.detect", 1e3 * ours.wall, "ms", "lower", TIME)
    yield from versus("images.detect.vs_cv2", ours, quickest(lambda: orb.detect(image) and None, repeats))
    keypoints = opencv.detect(opencv.ORB(), image)
    uv = np.asarray(keypoints.uv)[np.asarray(keypoints.valid)]
    cells = np.unique((uv / np.array(image.shape[::-1]) * np.array([8, 6])).astype(int), axis=0)
    yield Metric("images.detect.cells", len(cells) / 48, "share", "higher", ACCURACY)


def _match(frame: jl.data.StereoFrame, capacity: int, repeats: int) -> Iterator[Metric]:
    """Mutual nearest neighbors of binary descriptors of a stereo pair."""
    kind, described = opencv.ORB(), []
    for image in (frame.left, frame.right):
        described.append(opencv.describe(kind, image, opencv.detect(kind, image, capacity)))
    ours = quickest(lambda: match.match(*described).index, repeats)
    yield Metric("images.match", 1e3 * ours.wall, "ms", "lower", TIME)
    values = [np.asarray(side.values)[np.asarray(side.valid)] for side in described]
    peer = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
    yield from versus("images.match.vs_cv2", ours, quickest(lambda: peer.match(*values) and None, repeats))
    found = match.match(*described)
    kept = [np.flatnonzero(np.asarray(side.valid)) for side in described]
    pairs = {(int(kept[0][m.queryIdx]), int(kept[1][m.trainIdx])) for m in peer.match(*values)}
    ours_too = {(i, int(j)) for i, j in enumerate(found.index.tolist()) if bool(found.valid[i])}
    yield Metric("images.match.agreement", len(pairs & ours_too) / max(len(pairs), 1), "share", "higher", 0.01)


def _subpixel(count: int, repeats: int) -> Iterator[Metric]:
    """Points of an image that was moved exactly, in the frequency domain, with noise of one gray level."""
    rng = np.random.default_rng(8)
    shift = np.array([0.37, -0.61])
    first, second = _moved_pair(rng, shift)
    uv = rng.uniform(30, np.array(first.shape[::-1]) - 30, (count, 2))
    guess = uv + shift + rng.uniform(-1.0, 1.0, (count, 2))
    images = jnp.asarray(first, jnp.float32), jnp.asarray(second, jnp.float32)
    points = jnp.asarray(uv, jnp.float32), jnp.asarray(guess, jnp.float32)
    found = subpixel.refine_translation(*images, *points)
    error = (np.asarray(found.uv) - uv - shift)[np.asarray(found.ok)]
    ours = quickest(lambda: subpixel.refine_translation(*images, *points).uv, repeats)
    yield Metric("images.subpixel.ok", float(jnp.mean(found.ok)), "share", "higher", 0.02)
    yield Metric("images.subpixel.rmse", float(np.sqrt(np.mean(error**2))), "px", "lower", ACCURACY)
    squared = jax.vmap(lambda e, s: e @ jnp.linalg.solve(s, e))(jnp.asarray(error), found.covariance[found.ok])
    yield Metric("images.subpixel.nees", float(jnp.mean(squared)), "of 2", "equal", ACCURACY)
    yield Metric("images.subpixel", 1e6 * ours.wall / count, "us", "lower", TIME)
    bytes_, places = [image.round().astype(np.uint8) for image in (first, second)], uv.astype(np.float32)
    window = {"winSize": (11, 11), "maxLevel": 0, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW}

    def peer() -> np.ndarray:
        return cv2.calcOpticalFlowPyrLK(*bytes_, places[:, None], guess.astype(np.float32)[:, None].copy(), **window)[0]

    theirs = peer()[:, 0] - uv - shift
    yield Metric("images.subpixel.rmse.cv2", float(np.sqrt(np.mean(theirs**2))), "px")
    yield from versus("images.subpixel.vs_cv2", ours, quickest(peer, repeats))


def _moved_pair(rng: np.random.Generator, shift: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two noisy views of a smooth periodic texture, the second moved by ``shift`` (right, down)."""
    shape = (300, 400)
    v, u = np.meshgrid(np.fft.fftfreq(shape[0]), np.fft.fftfreq(shape[1]), indexing="ij")
    spectrum = np.fft.fft2(rng.normal(size=shape)) * np.exp(-0.5 * (u**2 + v**2) / 0.06**2)
    views = []
    for amount in (np.zeros(2), shift):
        phase = np.exp(-2j * np.pi * (u * amount[0] + v * amount[1]))
        views.append(np.fft.ifft2(spectrum * phase).real)
    scale = 30.0 / views[0].std()
    return tuple(np.clip(128.0 + scale * view + rng.normal(size=shape), 0, 255) for view in views)
