"""Simulated images of a pallet on a floor before a wall, with ground truth.

Every pixel is the intersection of one ray with the face of the pallet, the floor or the wall. Rims of the holes and of
the face are blurred by a Gaussian in the image, in closed form, so that edges are exact to a small fraction of a pixel.
"""

import cv2
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import erf
from jaxtyping import Float64, UInt8

from jaxloc.refinement.pallet import PalletType
from jaxloc.sensors import GroundCamera, Pinhole


class PalletScene(eqx.Module):
    """Scene parameters beside the pose of the pallet.

    Args:
        wood: gray level of the face.
        hole: gray level in the holes; they are a third darker above than below.
        floor: gray level of the floor.
        wall: gray level of the wall.
        wall_range: distance of the wall, m.
        texture: standard deviation of the grain on all surfaces, gray levels.
        blur: standard deviation of the blur of edges, px.
        shading: relative fall of the light from left to right over the image.
        noise: standard deviation of a gray level.
    """

    wood: float = 165.0
    hole: float = 35.0
    floor: float = 95.0
    wall: float = 120.0
    wall_range: float = 9.0
    texture: float = 6.0
    blur: float = 0.9
    shading: float = 0.25
    noise: float = 2.0


def make_camera(
    shape: tuple[int, int] = (480, 640), *, focal: float = 600.0, height: float = 0.6, pitch: float = 0.0
) -> GroundCamera:
    """A level camera of 640 x 480 pixels at 0.6 m over the floor.

    Args:
        shape: rows and columns.
        focal: px.
        height: m.
        pitch: below the horizontal, rad.

    Returns:
        The camera.

    Example:
        >>> float(make_camera().height) > 0.5
        True
    """
    pinhole = Pinhole(focal, focal, 0.5 * (shape[1] - 1), 0.5 * (shape[0] - 1))
    return GroundCamera(pinhole, height, pitch=pitch)


def render_pallet(
    kind: PalletType | None,
    pose: Float64[np.ndarray, "3"],
    camera: GroundCamera,
    *,
    shape: tuple[int, int] = (480, 640),
    scene: PalletScene = PalletScene(),
    seed: int = 0,
) -> UInt8[np.ndarray, "h w"]:
    """An image of a pallet.

    Args:
        kind: of pallet; None for an image without one.
        pose: (x, y, heading) of the pallet in the ground frame of the camera, m and rad.
        camera: level, or with pitch, roll and lens.
        shape: rows and columns.
        scene: brightness, blur and noise.
        seed: fixes grain and noise.

    Returns:
        Gray levels.

    Example:
        >>> from jaxloc.data.simulate.pallet import make_camera, render_pallet
        >>> from jaxloc.refinement.pallet import euro_long
        >>> render_pallet(euro_long(), np.array([2.0, 0.1, 0.05]), make_camera()).shape
        (480, 640)
    """
    rng = np.random.default_rng(seed)
    rays = _rays(camera, shape)
    image = _surroundings(rays, float(camera.height), scene, rng)
    if kind is not None:
        image = _draw(image, kind, pose, rays, float(camera.height), scene, rng)
    light = 1.0 + scene.shading * (0.5 - np.arange(shape[1]) / shape[1])
    image = image * light[None, :] + scene.noise * rng.standard_normal(shape)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def _rays(camera: GroundCamera, shape: tuple[int, int]) -> Float64[np.ndarray, "3 h w"]:
    """Directions of the pixels in the ground frame, x forward, y left, z up."""
    u, v = jnp.meshgrid(*(jnp.arange(size, dtype=camera.camera.fx.dtype) for size in shape[::-1]))
    x, y = (np.asarray(c, float) for c in camera.camera.normalize_components(u, v))
    return np.einsum("ij,jhw->ihw", np.asarray(camera.axes(), float), np.stack([x, y, np.ones_like(x)]))


def _surroundings(rays, height: float, scene: PalletScene, rng: np.random.Generator) -> Float64[np.ndarray, "h w"]:
    """Floor and wall."""
    down = np.minimum(rays[2], -1e-6)
    ahead = np.maximum(rays[0], 1e-6)
    reach = np.where(rays[2] < 0, -height / down, np.inf)
    on_floor = reach * rays[0] < scene.wall_range
    reach = np.where(on_floor, reach, scene.wall_range / ahead)
    first = np.where(on_floor, reach * rays[0], height + reach * rays[2])
    grain = _grain(rng, first, reach * rays[1])
    return np.where(on_floor, scene.floor, scene.wall) + scene.texture * grain


def _draw(
    image, kind: PalletType, pose, rays, height: float, scene: PalletScene, rng: np.random.Generator
) -> Float64[np.ndarray, "h w"]:
    """The face over the image, with its shadow on the floor left out: only edges of the face remain."""
    along, level, ahead = _on_face(pose, rays, height)

    def cover(value: np.ndarray, rim: float) -> np.ndarray:
        """Part of the blurred pixel where a coordinate of the face is above a rim."""
        down, right = np.gradient(value)
        size = np.maximum(np.hypot(right, down), 1e-9)
        pixels = (value - rim) / (scene.blur * size)
        return 0.5 * (1.0 + np.asarray(erf(jnp.asarray(np.sqrt(0.5) * pixels, jnp.float32)), float))

    def between(value: np.ndarray, low: float, high: float) -> np.ndarray:
        return cover(value, low) * (1.0 - cover(value, high))

    sizes = {name: float(getattr(kind, name)) for name in ("face_width", "face_height", "hole_bottom", "hole_height")}
    edges = np.asarray(kind.edges(), float)
    half = 0.5 * sizes["face_width"]
    face = between(along, -half, half) * between(level, 0.0, sizes["face_height"]) * ahead
    sides = between(along, edges[1], edges[0]) + between(along, edges[3], edges[2])
    holes = sides * between(level, sizes["hole_bottom"], sizes["hole_bottom"] + sizes["hole_height"])
    depth = np.clip((level - sizes["hole_bottom"]) / sizes["hole_height"], 0.0, 1.0)
    dark = scene.hole * (1.0 - 0.33 * depth)
    wood = scene.wood + scene.texture * _grain(rng, along, 4.0 * level)
    return image * (1.0 - face) + face * (wood * (1.0 - holes) + dark * holes)


def _on_face(pose, rays, height: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where rays meet the plane of the face: left along it and up from the ground, m; and whether that is ahead."""
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    toward = cos * rays[0] + sin * rays[1]
    ahead = toward > 1e-3
    reach = (cos * pose[0] + sin * pose[1]) / np.where(ahead, toward, 1.0)
    along = -sin * (reach * rays[0] - pose[0]) + cos * (reach * rays[1] - pose[1])
    return along, height + reach * rays[2], ahead


def _grain(rng: np.random.Generator, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Smooth noise of deviation one over a plane, of blobs of some centimeters."""
    noise = np.pad(rng.standard_normal((256, 256)).astype(np.float32), 8, mode="wrap")
    tile = cv2.GaussianBlur(noise, (0, 0), 1.5)[8:-8, 8:-8]
    tile = (tile - tile.mean()) / tile.std()
    u, v = (np.mod(c / 0.02, 256.0).astype(np.float32) for c in (x, y))
    return cv2.remap(tile, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP).astype(float)
