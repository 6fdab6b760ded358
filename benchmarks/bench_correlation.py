"""Template search, phase correlation and mutual information beside OpenCV, on real images."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.metric import ACCURACY, TIME, Metric, quickest, versus
from jaxloc.alignment import correlation, mutual_information, phase_correlation
from jaxloc.images import Affine, Translation

_NAMES = ("camera", "brick", "astronaut", "gravel", "motorcycle_left")
_MAPS = {
    "inverted": lambda x: 255 - x,
    "gamma": lambda x: 255 * (np.clip(x, 0, 255) / 255) ** 2.2,
    "both": lambda x: 255 - 255 * (np.clip(x, 0, 255) / 255) ** 2.2,
}


def metrics(smoke: bool) -> Iterator[Metric]:
    repeats, names = (1, _NAMES[:1]) if smoke else (10, _NAMES)
    scenes = [_scene(name) for name in names]
    yield from _search(scenes[0], repeats)
    yield from _phase(scenes, repeats)
    yield from _similarity(scenes, 2 if smoke else 20, repeats)
    yield from _information(scenes, repeats)


def _scene(name: str) -> np.ndarray:
    import skimage.data

    image = cv2.imread(str(Path(skimage.data.__file__).with_name(f"{name}.png")), cv2.IMREAD_GRAYSCALE)
    return cv2.GaussianBlur(image.astype(float), (0, 0), 1.0)


def _moved(image: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Moved exactly (right, down), in the frequency domain."""
    v, u = np.meshgrid(*(np.fft.fftfreq(side) for side in image.shape), indexing="ij")
    return np.fft.ifft2(np.fft.fft2(image) * np.exp(-2j * np.pi * (u * shift[0] + v * shift[1]))).real


def _search(scene: np.ndarray, repeats: int) -> Iterator[Metric]:
    """A template of 64x64 in 376x1241."""
    image = cv2.resize(scene, (1241, 376)).astype(np.float32)
    template = image[150:214, 600:664].copy()
    arrays = jnp.asarray(image), jnp.asarray(template)
    ours = quickest(lambda: correlation.score_map(*arrays), repeats)
    theirs = quickest(lambda: cv2.matchTemplate(image, template, cv2.TM_CCOEFF_NORMED), repeats)
    yield Metric("correlation.score_map", 1e3 * ours.wall, "ms", "lower", TIME)
    yield from versus("correlation.score_map.vs_cv2", ours, theirs)
    whole = quickest(lambda: correlation.search(*arrays), repeats)
    yield Metric("correlation.search", 1e3 * whole.wall, "ms", "lower", TIME)


def _phase(scenes: list[np.ndarray], repeats: int) -> Iterator[Metric]:
    """Shifts of 256x256 images."""
    rng, errors, peers, window = np.random.default_rng(3), [], [], cv2.createHanningWindow((256, 256), cv2.CV_64F)
    for scene in scenes:
        for shift in rng.uniform(-20, 20, (4, 2)):
            pair = [view[100:356, 100:356] + rng.normal(size=(256, 256)) for view in (scene, _moved(scene, shift))]
            found = phase_correlation.translation(*(jnp.asarray(view, jnp.float32) for view in pair))
            errors.append(np.linalg.norm(np.asarray(found.value.translation) - shift))
            peers.append(np.linalg.norm(np.array(cv2.phaseCorrelate(*pair, window)[0]) - shift))
    yield Metric("correlation.phase.error", float(np.median(errors)), "px", "lower", ACCURACY)
    yield Metric("correlation.phase.error.worst", float(np.max(errors)), "px")
    yield Metric("correlation.phase.error.cv2", float(np.median(peers)), "px")
    single = [np.float32(view) for view in pair]
    arrays = [jnp.asarray(view) for view in single]
    ours = quickest(lambda: phase_correlation.translation(*arrays), repeats)
    theirs = quickest(lambda: cv2.phaseCorrelate(*single, np.float32(window)) and None, repeats)
    yield Metric("correlation.phase", 1e3 * ours.wall, "ms", "lower", TIME)
    yield from versus("correlation.phase.vs_cv2", ours, theirs)


def _corner_error(found: np.ndarray, truth: np.ndarray, shape: tuple[int, int]) -> float:
    rows, columns = (side - 1 for side in shape)
    corners = np.array([[0, 0, 1], [columns, 0, 1], [0, rows, 1], [columns, rows, 1]]).T
    return float(np.sqrt(np.mean(np.sum(((found - truth)[:2] @ corners) ** 2, axis=0))))


def _similarity(scenes: list[np.ndarray], count: int, repeats: int) -> Iterator[Metric]:
    """Any rotation, scales of 0.7 to 1.4, shifts up to 15 px, of 256x256 images."""
    rng, errors, oks, center = np.random.default_rng(4), [], [], np.array([127.5, 127.5])
    for scene in scenes:
        for _ in range(count):
            angle, scale = rng.uniform(-np.pi, np.pi), np.exp(rng.uniform(np.log(0.7), np.log(1.4)))
            warp = np.eye(3)
            warp[:2, :2] = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
            warp[:2, 2] = center + rng.uniform(-15, 15, 2) - warp[:2, :2] @ center
            back = np.linalg.inv(warp)[:2]
            back[:, 2] += 110
            flags, border = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP, cv2.BORDER_REFLECT
            image = cv2.warpAffine(scene, back, (256, 256), flags=flags, borderMode=border)
            views = [jnp.asarray(view, jnp.float32) for view in (image, scene[110:366, 110:366])]
            found = phase_correlation.similarity(*views)
            oks.append(bool(found.ok))
            errors.append(_corner_error(np.asarray(found.value.matrix()), warp, (256, 256)))
    yield Metric("correlation.similarity.error", float(np.median(errors)), "px", "lower", ACCURACY)
    yield Metric("correlation.similarity.right", float(np.mean(np.array(errors) < 1.0)), "share", "higher", 0.02)
    yield Metric("correlation.similarity.ok", float(np.mean(oks)), "share", "higher", 0.02)
    yield Metric(
        "correlation.similarity",
        1e3 * quickest(lambda: phase_correlation.similarity(*views), repeats).wall,
        "ms",
        "lower",
        TIME,
    )


def _information(scenes: list[np.ndarray], repeats: int) -> Iterator[Metric]:
    """Affine warps, starts 5 px off, gray levels inverted, bent by gamma 2.2, or both, noise 2; ECC beside it."""
    rng, shape = np.random.default_rng(5), (100, 110)
    errors: dict[str, list[float]] = {key: [] for kind in _MAPS for key in (kind, f"{kind}.ecc")}
    for scene in scenes:
        scene = scene[100:300, 100:330]
        for kind, changed in _MAPS.items():
            warp = np.eye(3)
            warp[:2] += np.concatenate([0.03 * rng.normal(size=(2, 2)), [[60.3], [50.6]]], axis=1)
            flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
            template = cv2.warpAffine(scene, warp[:2], shape[::-1], flags=flags) + 2 * rng.normal(size=shape)
            image, start = changed(scene) + 2 * rng.normal(size=scene.shape), warp[:2, 2] + [3.5, -3.5]
            views = [jnp.asarray(view, jnp.float32) for view in (image, template)]
            begin = Translation(jnp.asarray(start, jnp.float32))
            found = mutual_information.align(*views, Affine, begin)
            errors[kind].append(_corner_error(np.asarray(found.value.matrix()), warp, shape))
            errors[f"{kind}.ecc"].append(_corner_error(_ecc(image, template, start), warp, shape))
    for key, values in errors.items():
        within = np.array(values) < 0.1
        yield Metric(f"correlation.information.{key}.error", float(np.median(values)), "px")
        tolerance = None if key.endswith("ecc") else 0.02
        yield Metric(f"correlation.information.{key}.within", float(np.mean(within)), "share", "higher", tolerance)
    ours = quickest(lambda: jax.tree.leaves(mutual_information.align(*views, Affine, begin)), repeats)
    yield Metric("correlation.information", 1e3 * ours.wall, "ms", "lower", TIME)


def _ecc(image: np.ndarray, template: np.ndarray, start: np.ndarray) -> np.ndarray:
    """OpenCV's alignment from the same start; the start where it gives up."""
    begin = np.float32([[1, 0, start[0]], [0, 1, start[1]]])
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-6)
    try:
        views = np.float32(template), np.float32(image)
        found = cv2.findTransformECC(*views, begin.copy(), cv2.MOTION_AFFINE, criteria, None, 5)[1]
    except cv2.error:
        found = begin
    return np.vstack([found, [0, 0, 1]])
