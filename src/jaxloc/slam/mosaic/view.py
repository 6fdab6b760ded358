"""Rectified floor views: undistorted, vignetting removed, in metric coordinates."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Num

from jaxloc._jit import filter_jit
from jaxloc._linalg import matmul
from jaxloc.images.interpolation import AbstractInterpolation, Bicubic, sample_components
from jaxloc.images.normalization import as_gray
from jaxloc.sensors.ground_camera import GroundCamera
from jaxloc.slam.mosaic.raster import Raster
from jaxloc.solvers.cholesky import factor

_DARKEST = 0.05  # least usable illumination
_TAPER = 12.0  # pixels along the border of an image whose weight rises from zero


class Falloff(eqx.Module):
    """Vignetting model (strategy)."""

    @abstractmethod
    def shade(self, u: Float[Array, "*n"], v: Float[Array, "*n"], cosine: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Relative illumination at pixels with given cosine to the optical axis."""


class CosineFourth(Falloff):
    """Natural vignetting: ``cos^4`` of the angle to the optical axis."""

    def shade(self, u: Float[Array, "*n"], v: Float[Array, "*n"], cosine: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """``cos^4``."""
        del u, v
        return cosine**4


class RadialFalloff(Falloff):
    """Radial vignetting polynomial: ``exp(c1 r^2 + c2 r^4 + c3 r^6)``, r from the image center.

    Attributes:
        coefficients: c1, c2, c3.
        center: pixel (u, v) of the middle.
        radius: of r = 1, px.
    """

    coefficients: Float[Array, "3"]
    center: Float[Array, "2"]
    radius: Float[Array, ""]

    def shade(self, u: Float[Array, "*n"], v: Float[Array, "*n"], cosine: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Relative illumination; constant beyond twice the radius."""
        del cosine
        square = ((u - self.center[0]) ** 2 + (v - self.center[1]) ** 2) / self.radius**2
        square = jnp.minimum(square, 4.0)
        first, second, third = self.coefficients
        return jnp.exp(jnp.minimum(square * (first + square * (second + square * third)), 1.0))


@filter_jit
def fit_falloff(frames: Num[Array, "n h w"] | Any, *, black: Any = 0.0) -> RadialFalloff:
    """Estimates vignetting from images of many places, as what they have in common.

    Least squares of the logarithm of the mean image, each image brought to mean one before.

    Args:
        frames: images of an evenly lit floor; ten or more.
        black: gray level of darkness.

    Returns:
        The falloff; none where the images are black.

    References:
        [K-84].

    Example:
        >>> import jax.numpy as jnp
        >>> u, v = jnp.meshgrid(jnp.arange(41.0) - 20.0, jnp.arange(31.0) - 15.0)
        >>> fitted = fit_falloff((200.0 * jnp.exp(-0.4 * (u**2 + v**2) / 625.0))[None])
        >>> round(float(fitted.coefficients[0]), 2)
        -0.4
    """
    frames = jnp.asarray(frames)
    dtype = frames.dtype if jnp.issubdtype(frames.dtype, jnp.floating) else jnp.result_type(float)
    frames = frames.astype(dtype) - black
    known = jnp.isfinite(frames)
    light = jnp.where(known, frames, 0.0)
    each = jnp.sum(light, axis=(1, 2), keepdims=True) / jnp.maximum(
        jnp.sum(known.astype(dtype), axis=(1, 2), keepdims=True), 1.0
    )
    lit = known & (each > 1.0)
    even = jnp.where(lit, light / jnp.where(each > 1.0, each, 1.0), 0.0)
    mean = jnp.sum(even, axis=0) / jnp.maximum(jnp.sum(lit.astype(dtype), axis=0), 1.0)
    center = 0.5 * jnp.array([frames.shape[2] - 1, frames.shape[1] - 1], dtype)
    radius = jnp.sqrt(jnp.sum(center**2))
    u, v = jnp.meshgrid(*(jnp.arange(size, dtype=dtype) for size in frames.shape[:0:-1]))
    square = (((u - center[0]) ** 2 + (v - center[1]) ** 2) / radius**2).reshape(-1)
    usable = mean.reshape(-1) > _DARKEST
    terms = jnp.stack([jnp.ones_like(square), square, square**2, square**3]) * usable[None].astype(dtype)
    target = jnp.where(usable, jnp.log(jnp.where(usable, mean.reshape(-1), 1.0)), 0.0)
    fitted = factor(matmul(terms, terms.T)).solve(matmul(terms, target))
    return RadialFalloff(jnp.where(jnp.any(usable), fitted[1:], 0.0), center, radius)


class Patch(eqx.Module):
    """Patch of floor on a raster: one rectified image, or a mosaic.

    Attributes:
        values: gray levels without vignetting; zero where unknown.
        weight: weights, by the distance in pixels to the border of the image; zero where unknown.
        raster: where the pixels lie. In a stack of patches, one for all.
    """

    values: Float[Array, "*n p q"]
    weight: Float[Array, "*n p q"]
    raster: Raster

    @property
    def known(self) -> Bool[Array, "*n p q"]:
        """Mask of the known pixels."""
        return self.weight > 0

    def with_gaps(self) -> Float[Array, "*n p q"]:
        """The values, NaN where unknown."""
        return jnp.where(self.known, self.values, jnp.nan)


class Rectifier(eqx.Module):
    """Precomputed rectification maps: image coordinates and illumination of each raster pixel.

    Attributes:
        u: columns in the image.
        v: rows in the image.
        shade: part of the light that arrives; zero outside the field of view.
        black: gray level of darkness.
        raster: of the floor.
        interpolation: of images.
    """

    u: Float[Array, " n"]
    v: Float[Array, " n"]
    shade: Float[Array, " n"]
    black: Float[Array, ""]
    raster: Raster
    interpolation: AbstractInterpolation

    @filter_jit
    def rectify(self, image: Num[Array, "h w"] | Any) -> Patch:
        """The floor in an image: ``(image(u, v) - black) / shade`` [K-81, K-84].

        The weight is the light squared, for the noise left is that of the image over the light, and fades out along
        the borders of image and raster.

        Args:
            image: gray levels, bytes or numbers; pixels that are not finite are left out.

        Returns:
            The patch.
        """
        dtype, gaps = self.u.dtype, jnp.issubdtype(jnp.asarray(image).dtype, jnp.floating)
        image = as_gray(image, dtype)
        finite = jnp.isfinite(image)
        values, inside = sample_components(jnp.where(finite, image, 0.0), self.u, self.v, method=self.interpolation)
        border_u = jnp.minimum(self.u, image.shape[1] - 1 - self.u)
        border = jnp.minimum(border_u, jnp.minimum(self.v, image.shape[0] - 1 - self.v))
        border = jnp.minimum(border, _depth(self.raster.shape, dtype))
        known = inside & (self.shade > _DARKEST) & (border > 0)
        if gaps:
            holes = sample_components((~finite).astype(dtype), self.u, self.v, method=self.interpolation)[0]
            known = known & (jnp.abs(holes) < 1e-6)
        light = jnp.where(known, (values - self.black) / jnp.where(known, self.shade, 1.0), 0.0)
        weight = jnp.where(known, self.shade**2 * jnp.clip(border / _TAPER, 0.0, 1.0), 0.0)
        return Patch(light.reshape(self.raster.shape), weight.reshape(self.raster.shape), self.raster)

    @filter_jit
    def rectify_all(self, images: Num[Array, "n h w"] | Any) -> Patch:
        """The floor in many images: values and weights stacked, one raster for all."""

        def one(image: Array) -> tuple[Array, Array]:
            patch = self.rectify(image)
            return patch.values, patch.weight

        values, weight = lax.map(one, jnp.asarray(images))
        return Patch(values, weight, self.raster)


def _depth(shape: tuple[int, int], dtype: Any) -> Float[Array, " n"]:
    """How many pixels deep each lies in a raster, one along its border."""
    rows, columns = (np.minimum(np.arange(length), np.arange(length)[::-1]) + 1.0 for length in shape)
    return jnp.asarray(np.minimum(rows[:, None], columns[None]).reshape(-1), dtype)


class FloorView(eqx.Module):
    """Camera over a floor, and the raster to which its images are rectified.

    Attributes:
        ground: camera, lens, height and attitude.
        falloff: of its light.
        black: gray level of darkness.
        raster: in the camera's road frame (x to the top of the image, y to its left), m.
        interpolation: of images.
    """

    ground: GroundCamera
    falloff: Falloff
    black: Float[Array, ""]
    raster: Raster
    interpolation: AbstractInterpolation = Bicubic()

    @staticmethod
    def of(
        ground: GroundCamera,
        image_shape: tuple[int, int],
        *,
        shape: tuple[int, int] | None = None,
        resolution: Any = None,
        falloff: Falloff = CosineFourth(),
        black: Any = 0.0,
    ) -> "FloorView":
        """View of the whole image, or of a central part.

        Args:
            ground: downward camera.
            image_shape: rows and columns of its images.
            shape: rows (along y) and columns (along x) of the raster; by default as many as the image has.
            resolution: edge of a pixel, m; by default what a pixel in the middle of the image covers.
            falloff: of its light.
            black: gray level of darkness.

        Example:
            >>> import jax.numpy as jnp, jaxloc as jl
            >>> camera = jl.sensors.Pinhole(100.0, 100.0, 31.5, 23.5)
            >>> view = FloorView.of(jl.sensors.ground_camera.GroundCamera(camera, 0.02, pitch=jnp.pi / 2), (48, 64))
            >>> view.raster.shape, round(float(view.raster.resolution), 6)
            ((64, 48), 0.0002)
        """
        height = ground.height
        if resolution is None:
            resolution = height / jnp.sqrt(ground.camera.fx * ground.camera.fy)
        middle = [jnp.asarray([0.5 * (size - 1)], height.dtype) for size in image_shape[::-1]]
        center = jnp.concatenate(ground.to_ground_components(*middle))
        shape = (image_shape[1], image_shape[0]) if shape is None else shape
        return FloorView(ground, falloff, jnp.asarray(black, height.dtype), Raster.around(center, resolution, shape))

    def part(self, shape: tuple[int, int]) -> "FloorView":
        """View of a smaller central part, with the same pixels.

        Raises:
            ValueError: it is larger than the whole, or not as odd or even as it.
        """
        cut = [(whole - piece) // 2 for whole, piece in zip(self.raster.shape, shape, strict=True)]
        if min(cut) < 0 or any((w - p) % 2 for w, p in zip(self.raster.shape, shape, strict=True)):
            raise ValueError(
                f"FloorView.part: shape {shape} must be smaller than {self.raster.shape} by even numbers, 0 among them."
            )
        corner = self.raster.origin + self.raster.resolution * jnp.array(cut[::-1], self.raster.origin.dtype)
        return eqx.tree_at(lambda view: view.raster, self, Raster(corner, self.raster.resolution, shape))

    @filter_jit
    def rectifier(self) -> Rectifier:
        """Rectification maps, computed once for all images."""
        x, y = (axis.reshape(-1) for axis in self.raster.centers())
        u, v = self.ground.project_components(x, y)
        right, down, forward = self.ground.camera_components(x, y)
        cosine = jnp.clip(forward, 1e-9) / jnp.sqrt(right**2 + down**2 + forward**2)
        shade = jnp.where(self.ground.sees_components(x, y), self.falloff.shade(u, v, cosine), 0.0)
        return Rectifier(u, v, shade, self.black, self.raster, self.interpolation)

    def rectify(self, image: Num[Array, "h w"] | Any) -> Patch:
        """The floor in one image; differentiable in image, camera, height and falloff.

        Of many images, keep the `rectifier`: it does the greater part of the work once.
        """
        return self.rectifier().rectify(image)
