"""Alignment of whole templates: Baker and Matthews's table, homographies beside OpenCV's ECC, covariance, gradients."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import map_coordinates, spline_filter

import jaxloc as jl
from benchmarks import baker_matthews as protocol
from benchmarks.metric import ACCURACY, RATIO, REPOSITORY, TIME, Metric, quickest, timed
from jaxloc.alignment import lucas_kanade as lk
from jaxloc.alignment import multi_start
from jaxloc.features import match, opencv
from jaxloc.images.warps import Homography, Translation

GRAF = REPOSITORY.parent / "shared" / "data" / "homography_graf"
SIZE, PLACE = 200, np.array([156.0, 140.0])
CORNERS = np.array([[0, 0], [SIZE - 1, 0], [SIZE - 1, SIZE - 1], [0, SIZE - 1]], np.float32)
H1TO3 = [[0.76285898, -0.29922929, 225.67123], [0.33443473, 1.0143901, -76.999973], [3.4663091e-4, -1.4364524e-5, 1.0]]
# Image, canonical points (3 for affine warps, 4 for homographies), formulation.
_TABLE = (
    ("takeo", 3, "inverse"),
    ("takeo", 3, "forwards"),
    ("denso", 3, "inverse"),
    ("denso", 3, "forwards"),
    ("takeo", 4, "inverse"),
)
COUNTS = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 1e-4)


def metrics(smoke: bool) -> Iterator[Metric]:
    if protocol.RECORDINGS.is_dir():
        yield from _table(20 if smoke else 1000, _TABLE[:1] if smoke else _TABLE)
        yield from _descents(20 if smoke else 400, 2 if smoke else None)
    yield from _homographies(2 if smoke else 40, 1 if smoke else 20)
    yield from _seeds(1 if smoke else 5)
    yield from _covariance(20 if smoke else 200)
    if GRAF.is_dir():
        yield from _graf(GRAF)


def _table(count: int, rows: tuple[tuple[str, int, str], ...]) -> Iterator[Metric]:
    """Per cent converged; the figures of an independent program, or the paper's, beside ours."""
    forms = {"inverse": lk.InverseCompositional(), "forwards": lk.ForwardsAdditive()}
    names = {"inverse": "inverse compositional", "forwards": "forwards additive"}
    for scene, points, form in rows:
        method, offsets = protocol.steps(14, formulation=forms[form]), protocol.offsets(count, points)
        ours = protocol.converged(protocol.recorded(scene), offsets, method)
        kind = "affine" if points == 3 else "homography"
        known = protocol.PUBLISHED.get("paper, homography" if points == 4 else f"{scene} {names[form]}")
        print(f"  {scene} {kind} {form:<9}", *(f"{x:6.1f}" for x in ours), flush=True)
        if known is not None:
            print(f"  {'published':<25}", *(f"{x:6.1f}" for x in known), flush=True)
            apart = float(np.abs(ours - np.array(known)).max())
            yield Metric(f"alignment.{scene}.{kind}.{form}.apart", apart, "points", "lower", 1.0)
        yield Metric(f"alignment.{scene}.{kind}.{form}.at_10", float(ours[-1]), "%", "equal", ACCURACY)
    coarse = protocol.steps(14, scales=lk.Blurred((4.0, 2.0, 0.0)))
    share = np.mean(protocol.errors(protocol.recorded("takeo"), protocol.offsets(count, 3), coarse, 10.0) <= 1.0)
    yield Metric("alignment.takeo.affine.blurred.at_10", 100.0 * float(share), "%", "higher", 0.03)


def _descents(count: int, first: int | None) -> Iterator[Metric]:
    """Convergence at 4 px by descent; the paper: 97, 97, Newton 88, diagonal 4, diagonal Newton 45, steepest 26."""
    descents = {
        "gauss_newton": lk.GaussNewtonStep(),
        "levenberg_marquardt": lk.LevenbergMarquardtStep(),
        "newton": lk.NewtonStep(),
        "newton_turned": lk.NewtonStep(-1.0),
        "diagonal": lk.DiagonalStep(),
        "diagonal_newton_turned": lk.DiagonalStep(-1.0),
        "steepest": lk.SteepestDescentStep(),
    }
    scene, offsets = protocol.recorded("takeo"), protocol.offsets(count, 3)
    # In the paper's coordinates, pixels from the corner, and in those of the template.
    for coordinates, normalized in (("pixels", False), ("normalized", True)):
        for name, descent in list(descents.items())[:first]:
            method = protocol.steps(14, descent=descent, normalized=normalized)
            share = 100.0 * np.mean(protocol.errors(scene, offsets, method, 4.0) <= 1.0)
            yield Metric(f"alignment.takeo.{coordinates}.{name}.at_4", float(share), "%", "equal", ACCURACY)


def _picture() -> np.ndarray:
    """The cameraman of scikit-image, or a rendered street where it is not installed."""
    try:
        import skimage.data
    except ImportError:
        return np.asarray(jl.data.simulate_street(num_frames=1, size=(512, 512))[0].left, float)
    return cv2.imread(str(Path(skimage.data.__file__).parent / "camera.png"), cv2.IMREAD_GRAYSCALE).astype(float)


def _moved(rng: np.random.Generator, sigma: float) -> tuple[np.ndarray, np.ndarray]:
    """Corners moved by noise, and the template that lies between them, by splines of order five."""
    corners = CORNERS + PLACE + rng.normal(size=(4, 2)) * sigma
    matrix = cv2.getPerspectiveTransform(CORNERS, corners.astype(np.float32))
    u, v = np.meshgrid(np.arange(SIZE), np.arange(SIZE))
    places = matrix @ np.stack([u.ravel(), v.ravel(), np.ones(SIZE**2)])
    right, down = places[:2] / places[2]
    coefficients = spline_filter(_picture(), order=5, mode="mirror")
    cut = map_coordinates(coefficients, [down, right], order=5, mode="mirror", prefilter=False)
    return corners, cut.reshape(SIZE, SIZE).astype(np.float32)


def _corner_error(matrix: np.ndarray, corners: np.ndarray) -> float:
    moved = cv2.perspectiveTransform(CORNERS[None].astype(float), np.asarray(matrix, float))[0]
    return float(np.sqrt(np.mean(np.sum((moved - corners) ** 2, axis=1))))


def _ecc(image: np.ndarray, template: np.ndarray) -> np.ndarray:
    """OpenCV's, which throws where it fails."""
    start = np.array([[1, 0, PLACE[0]], [0, 1, PLACE[1]], [0, 0, 1]], np.float32)
    try:
        return cv2.findTransformECC(template, image, start, cv2.MOTION_HOMOGRAPHY, COUNTS, None, 5)[1]
    except cv2.error:
        return np.full((3, 3), np.nan)


def _homographies(count: int, repeats: int) -> Iterator[Metric]:
    """A template of 200 x 200 px whose corners have moved by 2 and by 20 px."""
    picture, start = _picture(), Translation(jnp.asarray(PLACE, jnp.float32))
    for sigma in (2, 20):
        for exposure, gain, bias in (("", 1.0, 0.0), (".dark", 0.6, 30.0)):
            rng, key = np.random.default_rng(0), f"alignment.homography.{sigma}px{exposure}"
            image, errors, peer, ours_cpu, peer_cpu = (gain * picture + bias).astype(np.float32), [], [], [], []
            for _ in range(count):
                corners, template = _moved(rng, sigma)
                pictures = jnp.asarray(image), jnp.asarray(template)
                fit = lk.align(*pictures, Homography, start)
                errors.append(_corner_error(np.asarray(fit.value.matrix()), corners) if bool(fit.ok) else np.inf)
                best = min(timed(lambda: lk.align(*pictures, Homography, start))[1].cpu for _ in range(3))  # noqa: B023
                found, spent = timed(lambda: _ecc(image, template))  # noqa: B023
                peer.append(_corner_error(found, corners))
                ours_cpu.append(best)
                peer_cpu.append(spent.cpu)
            good = np.array(errors) < 1.0
            yield Metric(f"{key}.error", float(np.median(np.array(errors)[good])), "px", "lower", ACCURACY)
            yield Metric(f"{key}.converged", float(np.mean(good)), "share", "higher", 0.03)
            yield Metric(f"{key}.error.cv2", float(np.nanmedian(peer)), "px")
            yield Metric(f"{key}.converged.cv2", float(np.mean(np.array(peer) < 1.0)), "share", "higher")
            yield Metric(f"{key}.cpu", 1e3 * float(np.mean(ours_cpu)), "ms", "lower", TIME)
            yield Metric(f"{key}.vs_cv2.cpu", float(np.mean(peer_cpu) / np.mean(ours_cpu)), "x", "higher", RATIO)
    _, template = _moved(np.random.default_rng(0), 2)
    pictures = jnp.asarray(picture, jnp.float32), jnp.asarray(template)
    _, compiling = timed(lambda: lk.align(*pictures, Homography, start, method=lk.LucasKanade(max_steps=31)))
    yield Metric("alignment.homography.compile", compiling.wall, "s", "lower", TIME)
    forward = quickest(lambda: lk.align(*pictures, Homography, start), repeats)

    @jax.jit
    def slopes(image, template):
        def corner(image, template):
            return lk.align(image, template, Homography, start).value.apply(jnp.asarray(CORNERS))[0, 0]

        return jax.value_and_grad(corner, argnums=(0, 1))(image, template)

    backward = quickest(lambda: slopes(*pictures), repeats)
    yield Metric("alignment.homography.value_and_gradient", backward.cpu / forward.cpu, "forwards", "lower", RATIO)


def _seeds(repeats: int) -> Iterator[Metric]:
    """64 starts against one."""
    corners, template = _moved(np.random.default_rng(0), 20)
    pictures, center = (jnp.asarray(_picture(), jnp.float32), jnp.asarray(template)), jnp.asarray(PLACE, jnp.float32)
    seeds = multi_start.translations_around(center, spacing=12.0, count=8)
    single = quickest(lambda: lk.align(*pictures, Homography, Translation(center)), repeats)
    many = quickest(lambda: multi_start.align(*pictures, Homography, seeds), repeats)
    fit = multi_start.align(*pictures, Homography, seeds)
    yield Metric("alignment.seeds64.error", _corner_error(np.asarray(fit.value.matrix()), corners), "px", "lower", 1.0)
    yield Metric("alignment.seeds64.cost.wall", many.wall / single.wall, "single starts", "lower")
    yield Metric("alignment.seeds64.cost.cpu", many.cpu / single.cpu, "single starts", "lower", RATIO)


def _covariance(count: int) -> Iterator[Metric]:
    """NEES of a homography over seeds of noise on both images."""
    rng, picture = np.random.default_rng(3), _picture()
    corners, template = _moved(rng, 2)
    truth = Homography.from_matrix(
        jnp.asarray(cv2.getPerspectiveTransform(CORNERS, corners.astype(np.float32)), jnp.float32)
    )
    method = lk.LucasKanade(interpolation=jl.images.Bicubic(), scales=lk.Pyramid(2))

    @jax.jit
    def squared(image, template):
        fit = lk.align(image, template, Homography, Translation(jnp.asarray(PLACE, jnp.float32)), method=method)
        return fit.gaussian().mahalanobis_squared(truth)

    for noise in (5.0, 15.0):
        values = [
            float(
                squared(
                    jnp.asarray(picture + noise * rng.normal(size=picture.shape), jnp.float32),
                    jnp.asarray(template + noise * rng.normal(size=template.shape), jnp.float32),
                )
            )
            for _ in range(count)
        ]
        yield Metric(f"alignment.homography.nees.noise{noise:.0f}", float(np.mean(values)), "of 8", "equal", ACCURACY)


def _graf(folder: Path) -> Iterator[Metric]:
    """Graffiti 1 to 3: features start, robust alignment ends."""
    first, third = (cv2.imread(str(folder / f"graf{i}.png"), cv2.IMREAD_GRAYSCALE) for i in (1, 3))
    kind = opencv.SIFT()
    keypoints = [opencv.detect(kind, image, 2000) for image in (first, third)]
    described = [opencv.describe(kind, image, each) for image, each in zip((first, third), keypoints, strict=True)]
    found = match.match(*described)
    used = np.flatnonzero(np.asarray(found.valid))
    uv = np.asarray(keypoints[0].uv)[used], np.asarray(keypoints[1].uv)[np.asarray(found.index)[used]]
    start, _ = cv2.findHomography(*uv, cv2.RANSAC, 3.0)
    fit = lk.align(
        third,
        first,
        Homography,
        Homography.from_matrix(jnp.asarray(start, jnp.float32)),
        method=lk.LucasKanade(loss=jl.solvers.Tukey()),
    )
    height, width = first.shape
    corners = np.array([[[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]]], float)
    truth = cv2.perspectiveTransform(corners, np.array(H1TO3))
    for name, matrix in (("start", start), ("error", np.asarray(fit.value.matrix(), float))):
        apart = np.linalg.norm(cv2.perspectiveTransform(corners, matrix) - truth, axis=-1)
        yield Metric(
            f"alignment.graf13.{name}", float(np.mean(apart)), "px", "lower", ACCURACY if name == "error" else None
        )
