"""The experiment of "Lucas-Kanade 20 years on": how often alignment converges from how far.

Canonical points of a template are perturbed by noise of 1 to 10 px, the template is cut from the image by the warp that
takes its points there, and the search starts at the unperturbed place plus half a pixel. A run has converged when its
points end within 1 px (root mean square of their coordinates) of the perturbed ones after 14 steps.
"""

from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.io import loadmat

from benchmarks.metric import REPOSITORY
from jaxloc.alignment import lucas_kanade as lk
from jaxloc.images.interpolation import sample
from jaxloc.images.warps import Affine, Homography, Translation, Warp

RECORDINGS = REPOSITORY.parent / "shared" / "data" / "lk20"
SIGMAS = tuple(range(1, 11))

# First 1000 perturbations, each sigma: figures of an independent NumPy program on the same data, and of the paper.
PUBLISHED = {
    "takeo inverse compositional": (100, 100, 99.6, 97.1, 90.8, 81.5, 70.2, 59.0, 48.2, 39.8),
    "takeo forwards additive": (100, 100, 99.9, 98.4, 92.3, 82.0, 70.1, 60.1, 48.2, 37.5),
    "denso inverse compositional": (100, 99.9, 95.9, 85.8, 67.9, 51.0, 35.6, 23.5, 16.3, 11.0),
    "paper, homography": (100, 100, 100, 98, 92, 81, 69, 58, 46, 37),
    "paper, Newton": (100, 100, 97, 88, 72, 55, 39, 29, 22, 16),
}


class Scene(NamedTuple):
    """An image with the place of its template.

    Attributes:
        image: gray levels.
        corner: (column, row) of the template's first pixel.
        size: (columns, rows) of the template.
    """

    image: np.ndarray
    corner: tuple[int, int]
    size: tuple[int, int]


def recorded(name: str, folder: Path = RECORDINGS) -> Scene:
    """One of the authors' images: "takeo" or "denso"."""
    record = loadmat(folder / f"{name}.mat")["tdata"][0, 0]
    left, top, right, bottom = (int(x) - 1 for x in np.ravel(record["tmplt"]))
    return Scene(np.asarray(record["img"], np.float32), (left, top), (right - left + 1, bottom - top + 1))


def offsets(count: int, points: int, folder: Path = RECORDINGS) -> np.ndarray:
    """The authors' perturbations of 3 or 4 points, of unit variance: count x points x 2."""
    name = "affine_pt_offset" if points == 3 else "homo_pt_offset"
    values = next(v for v in loadmat(folder / f"{name}.mat").values() if isinstance(v, np.ndarray) and v.ndim == 2)
    return np.asarray(values[:count], np.float32).reshape(-1, points, 2)


def canonical(scene: Scene, points: int) -> np.ndarray:
    """Points of the template, in its own pixels."""
    right, bottom = scene.size[0] - 1.0, scene.size[1] - 1.0
    if points == 3:
        # The third one lies where the authors' one-based pixels have put it.
        return np.array([[0.0, 0.0], [right, 0.0], [scene.size[0] / 2 - 1, bottom]], np.float32)
    return np.array([[0.0, 0.0], [right, 0.0], [right, bottom], [0.0, bottom]], np.float32)


def through(points: Float[Array, "k 2"], targets: Float[Array, "k 2"]) -> Warp:
    """The affine warp of three points, or the homography of four."""
    one, zero = jnp.ones_like(points[:, 0]), jnp.zeros_like(points[:, 0])
    u, v = points[:, 0], points[:, 1]
    if points.shape[0] == 3:
        rows = jnp.linalg.solve(jnp.stack([u, v, one], axis=1), targets)
        return Affine.from_matrix(jnp.concatenate([rows.T, jnp.array([[0.0, 0.0, 1.0]])]))
    first = [jnp.stack([u, v, one, zero, zero, zero, -u * targets[:, 0], -v * targets[:, 0]], axis=1)]
    second = [jnp.stack([zero, zero, zero, u, v, one, -u * targets[:, 1], -v * targets[:, 1]], axis=1)]
    entries = jnp.linalg.solve(jnp.concatenate(first + second), jnp.concatenate([targets[:, 0], targets[:, 1]]))
    return Homography.from_matrix(jnp.append(entries, 1.0).reshape(3, 3))


class Trial(eqx.Module):
    """One image, its template's place and points."""

    image: Float[Array, "h w"]
    start: Float[Array, "2"]
    points: Float[Array, "k 2"]
    size: tuple[int, int] = eqx.field(static=True)

    def error(self, targets: Float[Array, "k 2"], noise: Float[Array, "p q"], method: lk.LucasKanade) -> Array:
        """Root mean square error of the points' coordinates (px) after an alignment."""
        truth = through(self.points, targets)
        # One pixel more on every side: alignment takes no one-sided differences along the border.
        u, v = jnp.meshgrid(*(jnp.arange(-1.0, side + 1.0) for side in self.size))
        places = truth.apply(jnp.stack([u.reshape(-1), v.reshape(-1)], axis=1))
        template = sample(self.image, places).values.reshape(self.size[1] + 2, self.size[0] + 2) + noise
        outwards = Translation(-jnp.ones(2))
        initial = type(truth).of(Translation(self.start) @ outwards)
        found = lk.align(self.image, template, type(truth), initial, method=method).value @ outwards.inverse()
        return jnp.sqrt(jnp.mean((found.apply(self.points) - targets) ** 2))


def steps(number: int, **choices: object) -> lk.LucasKanade:
    """The paper's settings: gray levels unchanged, full size, a fixed number of steps."""
    settled = {"brightness": lk.Unchanged(), "scales": lk.FullSize(), "max_steps": number, "tolerance": 0.0}
    return lk.LucasKanade(**{**settled, **choices})


@eqx.filter_jit
def _errors(trial: Trial, targets: Array, noise: Array, method: lk.LucasKanade) -> Array:
    return jax.lax.map(lambda each: trial.error(each[0], each[1], method), (targets, noise), batch_size=50)


def errors(
    scene: Scene, offsets: np.ndarray, method: lk.LucasKanade, sigma: float, noise: float = 0.0, seed: int = 0
) -> np.ndarray:
    """Final error of each run, px."""
    points = canonical(scene, offsets.shape[1])
    place = np.asarray(scene.corner, np.float32)
    targets = jnp.asarray(points[None] + place + sigma * offsets)
    trial = Trial(jnp.asarray(scene.image), jnp.asarray(place + 0.5), jnp.asarray(points), scene.size)
    size = scene.size[1] + 2, scene.size[0] + 2
    grain = noise * np.random.default_rng(seed).normal(size=(len(offsets), *size))
    return np.asarray(_errors(trial, targets, jnp.asarray(grain, jnp.float32), method))


def converged(scene: Scene, offsets: np.ndarray, method: lk.LucasKanade, noise: float = 0.0) -> np.ndarray:
    """Per cent of runs that end within 1 px, for each of the ten sigmas."""
    return np.array([100.0 * np.mean(errors(scene, offsets, method, s, noise) <= 1.0) for s in SIGMAS])
