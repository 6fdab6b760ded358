"""Brightness models of two aligned images, whose coefficients are eliminated from the normal equations."""

from abc import abstractmethod
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


class Brightness(eqx.Module):
    """A linear model ``image = template + sum c_k B_k`` of exposure; the c_k are eliminated in closed form."""

    correlating: eqx.AbstractClassVar[bool]

    @abstractmethod
    def columns(self, template: Float[Array, " n"]) -> Float[Array, "k n"]:
        """The images B_k, given the template with zero mean and unit variance."""


class Unchanged(Brightness):
    """Equal gray levels: sum of squared differences."""

    correlating: ClassVar[bool] = False

    def columns(self, template: Float[Array, " n"]) -> Float[Array, "0 n"]:
        """None."""
        return jnp.zeros((0, template.shape[0]), template.dtype)


class Bias(Brightness):
    """A constant offset of all gray levels."""

    correlating: ClassVar[bool] = False

    def columns(self, template: Float[Array, " n"]) -> Float[Array, "1 n"]:
        """A constant."""
        return jnp.ones_like(template)[None]


class GainBias(Brightness):
    """Gain and bias by least squares.

    References:
        Baker, Gross, Matthews, "Lucas-Kanade 20 years on: part 3", 2003, section 3.3 (project-out) [K-22].
    """

    correlating: ClassVar[bool] = False

    def columns(self, template: Float[Array, " n"]) -> Float[Array, "2 n"]:
        """The template and a constant."""
        return jnp.stack([template, jnp.ones_like(template)])


class Correlation(Brightness):
    """Gain and bias by the greatest zero-mean normalized correlation (ECC).

    Least squares with a gain is biased towards image regions of low contrast, where residuals are small; the
    correlation is not.

    References:
        Evangelidis and Psarakis, "Parametric image alignment using enhanced correlation coefficient maximization",
        T-PAMI 30(10), 2008, eq. 12 and 20.
    """

    correlating: ClassVar[bool] = True

    def columns(self, template: Float[Array, " n"]) -> Float[Array, "2 n"]:
        """The template and a constant."""
        return jnp.stack([template, jnp.ones_like(template)])
