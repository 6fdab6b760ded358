"""Camera models of calibration: free parameters of pinhole and lens, and their scaling for the solver."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxloc._arguments import checked
from jaxloc._linalg import matmul
from jaxloc.sensors import BrownConrady, KannalaBrandt, Pinhole
from jaxloc.sensors.lenses import Lens

_PINHOLE = ("fx", "fy", "cx", "cy", "skew")


class LensModel(eqx.Module):
    """Lens model of a camera and its free coefficients; the others are zero."""

    @abstractmethod
    def names(self) -> tuple[str, ...]:
        """All coefficients, in the order of the lens."""

    @abstractmethod
    def free(self) -> tuple[str, ...]:
        """Free coefficients."""

    @abstractmethod
    def make(self, coefficients: Float[Array, " c"]) -> Lens | None:
        """The lens with these coefficients."""


class NoLens(LensModel):
    """An ideal pinhole."""

    def names(self) -> tuple[str, ...]:
        """No coefficients."""
        return ()

    def free(self) -> tuple[str, ...]:
        """No coefficients."""
        return ()

    @checked
    def make(self, coefficients: Float[Array, " c"]) -> Lens | None:
        """No lens."""
        del coefficients
        return None


class BrownConradyModel(LensModel):
    """Radial and tangential distortion, `BrownConrady`.

    Attributes:
        radial: number of free radial coefficients: 0 to 3, or 6 for the rational model.
        tangential: whether the two tangential coefficients are free.
    """

    radial: int = eqx.field(static=True, default=3)
    tangential: bool = eqx.field(static=True, default=True)

    def __check_init__(self) -> None:
        if self.radial not in (0, 1, 2, 3, 6):
            raise ValueError(f"BrownConradyModel got radial={self.radial}; it must be 0, 1, 2, 3, or 6 (rational).")

    def names(self) -> tuple[str, ...]:
        """Five, or eight of the rational model, in OpenCV's order."""
        return ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")[: 8 if self.radial == 6 else 5]

    def free(self) -> tuple[str, ...]:
        """Free coefficients."""
        radial = tuple(f"k{i + 1}" for i in range(self.radial))
        return tuple(n for n in self.names() if n in radial or (self.tangential and n[0] == "p"))

    @checked
    def make(self, coefficients: Float[Array, " c"]) -> Lens | None:
        """The lens with these coefficients."""
        return BrownConrady(coefficients)


class Fisheye(LensModel):
    """Fisheye lens, `KannalaBrandt`.

    Attributes:
        radial: number of free coefficients, up to four.
    """

    radial: int = eqx.field(static=True, default=4)

    def __check_init__(self) -> None:
        if not 0 <= self.radial <= 4:
            raise ValueError(f"Fisheye got radial={self.radial}; it must be 0 to 4.")

    def names(self) -> tuple[str, ...]:
        """Four."""
        return ("k1", "k2", "k3", "k4")

    def free(self) -> tuple[str, ...]:
        """The first ones."""
        return self.names()[: self.radial]

    @checked
    def make(self, coefficients: Float[Array, " c"]) -> Lens | None:
        """The lens with these coefficients."""
        return KannalaBrandt(coefficients)


class Intrinsics(eqx.Module):
    """Free parameters of a camera.

    Attributes:
        lens: `BrownConradyModel`, `Fisheye` or `NoLens`.
        square_pixels: one focal length for rows and columns.
        principal_point: whether it is free; otherwise it is the center of the images.
        skew: whether it is free; otherwise it is zero.

    Example:
        >>> Intrinsics(BrownConradyModel(radial=2, tangential=False), square_pixels=True).free()
        ('f', 'cx', 'cy', 'k1', 'k2')
    """

    lens: LensModel = BrownConradyModel()
    square_pixels: bool = eqx.field(static=True, default=False)
    principal_point: bool = eqx.field(static=True, default=True)
    skew: bool = eqx.field(static=True, default=False)

    def names(self) -> tuple[str, ...]:
        """All parameters in the order of the tangent of a `Pinhole`: focal lengths, principal point, skew, lens."""
        return (*_PINHOLE, *self.lens.names())

    def free_pinhole(self) -> tuple[str, ...]:
        """Free pinhole parameters; ``f`` is both focal lengths."""
        focal = ("f",) if self.square_pixels else ("fx", "fy")
        center = ("cx", "cy") if self.principal_point else ()
        return (*focal, *center, *(("skew",) if self.skew else ()))

    def free(self) -> tuple[str, ...]:
        """All free parameters."""
        return (*self.free_pinhole(), *self.lens.free())


class Parametrization(eqx.Module):
    """The camera as a linear function of scaled unknowns of the order of one.

    ``parameters = offset + basis @ unknowns``: lengths are in units of ``scale`` px, so that single precision resolves
    steps of focal lengths and of lens coefficients.

    Attributes:
        intrinsics: free parameters.
        offset: parameters for zero unknowns: the values of the fixed ones.
        scale: px.
    """

    intrinsics: Intrinsics
    offset: Float[Array, " p"]
    scale: Float[Array, ""]

    @staticmethod
    @checked
    def of(intrinsics: Intrinsics, center: Float[Array, "2"], scale: Float[Array, ""]) -> "Parametrization":
        """Of images with this center (px), and this extent from it (px)."""
        offset = jnp.zeros(len(intrinsics.names()), center.dtype).at[2:4].set(center)
        return Parametrization(intrinsics, offset, scale)

    def basis(self) -> Float[Array, "p u"]:
        """Derivative of the parameters by the unknowns."""
        names, free = self.intrinsics.names(), self.intrinsics.free()
        pattern = np.zeros((len(names), len(free)))
        for column, name in enumerate(free):
            for row in ("fx", "fy") if name == "f" else (name,):
                pattern[names.index(row), column] = 1.0
        pixels = np.arange(len(names)) < len(_PINHOLE)
        units = jnp.where(jnp.asarray(pixels), self.scale, 1.0)
        return jnp.asarray(pattern, self.scale.dtype) * units[:, None]

    @checked
    def camera(self, unknowns: Float[Array, " u"]) -> Pinhole:
        """The camera."""
        values = self.offset + matmul(self.basis(), unknowns)
        return Pinhole(*(values[i] for i in range(5)), self.intrinsics.lens.make(values[5:]))

    @checked
    def initial(self, focal: Float[Array, "2"], center: Float[Array, "2"]) -> Float[Array, " u"]:
        """Unknowns of a camera without lens distortion."""
        fx, fy = focal[0] / self.scale, focal[1] / self.scale
        moved = (center - self.offset[2:4]) / self.scale
        known: dict[str, Any] = {"f": jnp.sqrt(fx * fy), "fx": fx, "fy": fy, "cx": moved[0], "cy": moved[1]}
        return jnp.stack([known.get(name, jnp.zeros_like(fx)) for name in self.intrinsics.free()])
