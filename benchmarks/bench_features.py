"""The thesis's comparison of features: how many, how fast, how repeatable, how well matched; ours beside OpenCV's."""

from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import cKDTree
from skimage import data

from benchmarks.metric import ACCURACY, REPOSITORY, TIME, Metric, quickest, versus
from jaxloc.features import opencv
from jaxloc.features.akaze import akaze
from jaxloc.features.brief import brief, draw_tests, intensity_centroid
from jaxloc.features.fast import fast
from jaxloc.features.kaze import kaze
from jaxloc.features.keypoints import Descriptors, Keypoints
from jaxloc.features.match import match
from jaxloc.features.orb import orb
from jaxloc.features.select import cover_squares, coverage, select_by_grid
from jaxloc.features.sift import sift
from jaxloc.features.surf import laplacian_gate, surf

RECORDINGS = REPOSITORY.parent / "shared" / "data"
# Slots; a point is found again within so many pixels; ratio of the nearest distance to the next.
CAPACITY, NEAR, RATIO_OF_TWO, GRID = 1000, 2.5, 0.8, (6, 8)


class Feature(NamedTuple):
    """A detector with its descriptor, from an image of bytes to keypoints and descriptors."""

    run: Callable[[np.ndarray], tuple[Keypoints, Descriptors]]
    bits: float


class Pair(NamedTuple):
    """Two images, and the homography from the first to the second."""

    first: np.ndarray
    second: np.ndarray
    homography: np.ndarray


def metrics(smoke: bool) -> Iterator[Metric]:
    repeats = 1 if smoke else 5
    groups = pairs(smoke)
    for name, feature in features(smoke).items():
        yield from _feature(name, feature, groups, repeats)
    if not smoke:
        yield from _sign_gate(groups)
    yield from _sift_beside_opencv(picture("camera", smoke), repeats)
    yield from _spread(smoke)


def picture(name: str, smoke: bool) -> np.ndarray:
    image = getattr(data, name)()
    image = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return image[:192, 160:352] if smoke else image


def on_arrays(function: Callable, image: np.ndarray) -> tuple[Keypoints, Descriptors]:
    return function(jnp.asarray(image, jnp.float32))


def on_host(kind: opencv.AbstractDetector, image: np.ndarray) -> tuple[Keypoints, Descriptors]:
    """OpenCV's strongest keypoints, described by the same feature; FAST's by ORB."""
    keypoints = opencv.detect(kind, image, CAPACITY, (1, 1))
    return keypoints, opencv.describe(opencv.ORB() if isinstance(kind, opencv.FAST) else kind, image, keypoints)


@eqx.filter_jit
def fast_with_brief(image: jax.Array) -> tuple[Keypoints, Descriptors]:
    """FAST alone has no descriptor: directions and bits of one scale."""
    found = fast(image, threshold=20.0, capacity=CAPACITY)
    found = eqx.tree_at(lambda k: k.angle, found, intensity_centroid(image, found.uv))
    return found, brief(image, found, draw_tests(jax.random.key(0)))


def features(smoke: bool) -> dict[str, Feature]:
    """The six of the thesis, in JAX and from OpenCV's wheel where it has them."""
    ours = {
        "sift": (partial(sift, capacity=CAPACITY), 128 * 32.0),
        "surf": (partial(surf, capacity=CAPACITY), 64 * 32.0),
        "kaze": (partial(kaze, capacity=CAPACITY), 64 * 32.0),
        "akaze": (partial(akaze, capacity=CAPACITY), 486.0),
        "fast": (fast_with_brief, 256.0),
        "orb": (partial(orb, capacity=CAPACITY), 256.0),
    }
    peers = {
        "sift": opencv.SIFT(),
        "kaze": opencv.KAZE(threshold=1e-3),
        "akaze": opencv.AKAZE(threshold=1e-3),
        "fast": opencv.FAST(threshold=20),
        "orb": opencv.ORB(fast_threshold=20),
    }
    if smoke:
        ours = {name: ours[name] for name in ("surf", "akaze", "fast")}
        peers = {name: peers[name] for name in ("sift", "akaze")}
    found = {f"jax.{name}": Feature(partial(on_arrays, function), bits) for name, (function, bits) in ours.items()}
    lengths = {"sift": 128 * 32.0, "kaze": 64 * 32.0, "akaze": 486.0, "fast": 256.0, "orb": 256.0}
    return found | {f"cv2.{name}": Feature(partial(on_host, kind), lengths[name]) for name, kind in peers.items()}


def _warped(image: np.ndarray, homography: np.ndarray) -> Pair:
    size = image.shape[::-1]
    # A camera with half the pixels sees means of them.
    shrink = np.sqrt(abs(np.linalg.det(homography[:2, :2])))
    soft = cv2.GaussianBlur(image, (0, 0), 0.5 / shrink) if shrink < 0.8 else image
    return Pair(image, cv2.warpPerspective(soft, homography, size, flags=cv2.INTER_CUBIC), homography)


def pairs(smoke: bool) -> dict[str, list[Pair]]:
    """Images turned, scaled and seen from the side, and two real views of a wall."""
    image = picture("astronaut", smoke)
    height, width = image.shape
    center = 0.5 * np.array([width - 1.0, height - 1.0])

    def about_center(degrees: float = 0.0, scale: float = 1.0) -> Pair:
        rows = cv2.getRotationMatrix2D(tuple(center), degrees, scale)
        return _warped(image, np.vstack([rows, [0.0, 0.0, 1.0]]))

    def tilted(degrees: float) -> Pair:
        turn, _ = cv2.Rodrigues(np.array([0.0, np.radians(degrees), 0.0]))
        camera = np.array([[width, 0.0, center[0]], [0.0, width, center[1]], [0.0, 0.0, 1.0]])
        # A plane one unit ahead, around whose middle the camera goes.
        away = np.array([0.0, 0.0, 1.0]) - turn @ np.array([0.0, 0.0, 1.0])
        plane = camera @ (turn + np.outer(away, [0.0, 0.0, 1.0])) @ np.linalg.inv(camera)
        return _warped(image, plane / plane[2, 2])

    angles, scales, tilts = (
        ((30,), (0.7,), (30,)) if smoke else ((15, 30, 45, 60, 90), (0.5, 0.7, 1.4, 2.0), (20, 40, 55))
    )
    groups = {
        "rotation": [about_center(degrees=angle) for angle in angles],
        "scale": [about_center(scale=scale) for scale in scales],
        "viewpoint": [tilted(angle) for angle in tilts],
    }
    folder = RECORDINGS / "homography_graf"
    if folder.is_dir() and not smoke:
        first, second = (cv2.imread(str(folder / f"graf{k}.png"), cv2.IMREAD_GRAYSCALE) for k in (1, 3))
        file = cv2.FileStorage(str(folder / "H1to3p.xml"), cv2.FILE_STORAGE_READ)
        groups["graf"] = [Pair(first, second, file.getNode("H13").mat())]
    return groups


def _mapped(homography: np.ndarray, uv: np.ndarray) -> np.ndarray:
    return cv2.perspectiveTransform(uv[:, None].astype(np.float64), homography)[:, 0]


def compared(first: tuple, second: tuple, pair: Pair, gate: jax.Array | None = None) -> dict[str, float]:
    """Repeatability, and precision and recall of matches, among keypoints that both images show."""
    uv = [np.asarray(side[0].uv) for side in (first, second)]
    valid = [np.asarray(side[0].valid) for side in (first, second)]
    height, width = pair.second.shape
    there, back = _mapped(pair.homography, uv[0]), _mapped(np.linalg.inv(pair.homography), uv[1])
    seen = valid[0] & np.all((there >= 0) & (there <= [width - 1, height - 1]), axis=1)
    rows, columns = pair.first.shape
    seen_back = valid[1] & np.all((back >= 0) & (back <= [columns - 1, rows - 1]), axis=1)
    fewer = max(min(seen.sum(), seen_back.sum()), 1)
    if not seen.any() or not seen_back.any():
        return {"repeatability": 0.0, "precision": 0.0, "recall": 0.0}
    distance, _ = cKDTree(uv[1][seen_back]).query(there)
    again = seen & (distance < NEAR)
    matches = match(first[1], second[1], ratio=RATIO_OF_TWO, gate=gate)
    made = np.asarray(matches.valid) & seen
    right = made & (np.linalg.norm(there - uv[1][np.asarray(matches.index)], axis=1) < NEAR)
    return {
        "repeatability": min(again.sum() / fewer, 1.0),
        "precision": right.sum() / max(made.sum(), 1),
        "recall": right.sum() / max(again.sum(), 1),
    }


def _feature(name: str, feature: Feature, groups: dict[str, list[Pair]], repeats: int) -> Iterator[Metric]:
    """A row of the table."""
    key, image = f"features.{name}", groups["rotation"][0].first
    known = {id(image): feature.run(image)}
    yield Metric(f"{key}.keypoints", float(known[id(image)][0].valid.sum()), "points", "equal", ACCURACY)
    yield Metric(f"{key}.bits", feature.bits, "bits a descriptor", "lower", ACCURACY)
    took = quickest(lambda: feature.run(image)[1].values, repeats)
    yield Metric(f"{key}.time", 1e3 * took.wall, "ms an image", "lower", TIME)
    for group, members in groups.items():
        figures = []
        for pair in members:
            if id(pair.first) not in known:
                known[id(pair.first)] = feature.run(pair.first)
            figures.append(compared(known[id(pair.first)], feature.run(pair.second), pair))
        for figure in figures[0]:
            mean = float(np.mean([f[figure] for f in figures]))
            yield Metric(f"{key}.{group}.{figure}", mean, "share", "higher", ACCURACY)


def _sign_gate(groups: dict[str, list[Pair]]) -> Iterator[Metric]:
    """What the sign of the Laplacian leaves of SURF's candidates, and of its right matches."""
    pair = groups["rotation"][1]
    found = [on_arrays(partial(surf, capacity=CAPACITY), image) for image in (pair.first, pair.second)]
    gate = laplacian_gate(found[0][0], found[1][0])
    both = found[0][0].valid[:, None] & found[1][0].valid[None, :]
    yield Metric("features.sign_gate.candidates", float((gate & both).sum() / both.sum()), "share", "lower", ACCURACY)
    plain, gated = (compared(*found, pair, gate=g)["recall"] for g in (None, gate))
    yield Metric("features.sign_gate.recall", gated / plain, "of that without it", "higher", 0.02)


def _sift_beside_opencv(image: np.ndarray, repeats: int) -> Iterator[Metric]:
    """Share of OpenCV's keypoints that ours finds within a pixel, and both times."""
    peer = cv2.SIFT_create(0, 3, 0.04, 10, 1.6, cv2.CV_32F, True)
    run = partial(sift, capacity=1500)
    theirs = np.array([k.pt for k in peer.detect(image)])
    keypoints, _ = on_arrays(run, image)
    distance, _ = cKDTree(np.asarray(keypoints.uv)[np.asarray(keypoints.valid)]).query(theirs)
    yield Metric("features.sift.within_1px_of_cv2", float(np.mean(distance < 1.0)), "share", "higher", 0.01)
    ours = quickest(lambda: on_arrays(run, image)[1].values, repeats)
    yield from versus("features.sift.vs_cv2", ours, quickest(lambda: peer.detectAndCompute(image, None)[1], repeats))


def frames(smoke: bool) -> list[np.ndarray]:
    """Real frames of a street, evenly over the recording; none where it is absent."""
    paths = sorted((RECORDINGS / "kitti_odometry" / "sequences").glob("*/image_0/*.png"))
    paths = paths[:: max(len(paths) // 8, 1)][: 1 if smoke else 8]
    return [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in paths]


def _spread(smoke: bool) -> Iterator[Metric]:
    """Share of 8 x 6 cells that hold one of 200 corners: the strongest, cells in turns, and squares kept free."""
    filled = {"strongest": [], "grid": [], "squares": []}
    for image in frames(smoke):
        found = fast(jnp.asarray(image, jnp.float32), threshold=10.0, capacity=4000)
        options = {"shape": image.shape, "capacity": 200}
        turns = select_by_grid(found.uv, found.response, found.valid, grid=GRID, **options)
        squares = cover_squares(found.uv, found.response, found.valid, **options)
        chosen = {"strongest": (found.uv[:200], found.valid[:200])}
        chosen |= {k: (found.uv[s.index], s.valid) for k, s in (("grid", turns), ("squares", squares))}
        for name, (uv, valid) in chosen.items():
            filled[name].append(float(coverage(uv, valid, shape=image.shape, grid=GRID).filled))
    for name, shares in filled.items():
        if shares:
            yield Metric(f"features.spread.{name}", float(np.mean(shares)), "share of cells", "higher", ACCURACY)
