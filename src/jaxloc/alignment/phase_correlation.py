"""Phase correlation: translation, rotation and scale between whole images, without an initial value.

A translation changes the phases of a spectrum and not its amplitude [R-33]; rotation and scale of an image rotate
and scale the amplitude, and become translations in log-polar coordinates [R-34].
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Num

from jaxloc import _linalg
from jaxloc._jit import filter_jit
from jaxloc._linalg import matmul
from jaxloc.alignment.correlation.peaks import find_peaks
from jaxloc.images.interpolation import Bicubic, sample
from jaxloc.images.normalization import as_gray
from jaxloc.images.spectrum import LogPolar, amplitude, hann
from jaxloc.images.warps import Similarity, Translation
from jaxloc.solvers import Estimate, Status

_LEAST_HEIGHT = 6.0  # of a valid peak, in standard deviations of the surface of unrelated images
_NEWTON_STEPS = 4


class _Peak(eqx.Module):
    """Peak of the phase correlation of two images.

    Attributes:
        uv: current from previous, px.
        covariance: px^2.
        information: its inverse.
        height: of the peak, 1 for equal images.
        ok: True if it is significant and distinct.
    """

    uv: Float[Array, "2"]
    covariance: Float[Array, "2 2"]
    information: Float[Array, "2 2"]
    height: Float[Array, ""]
    ok: Bool[Array, ""]


@filter_jit
def translation(
    previous: Num[Array, "h w"] | Any, current: Num[Array, "h w"] | Any, *, bandwidth: float = 0.25
) -> Estimate:
    """Translation between two images by phase correlation: ``current(x + t) ~ previous(x)``.

    With the cross-spectrum ``R = conj(F_previous) F_current`` of the images under Hann windows,
    ``c(t) = sum_f w(f) R(f) / |R(f)| exp(2 pi i f.t)`` has a sharp peak. w is a Gaussian low-pass. The highest pixel is
    refined by Newton steps on this trigonometric sum itself; the last one has the derivatives of the solution.

    Args:
        previous: gray levels.
        current: gray levels, of the same shape.
        bandwidth: standard deviation of w, cycles per pixel.

    Returns:
        Estimate of a `Translation` from previous to current pixels, at most half an image. `cost` is one minus the
        peak's height; the covariance follows from the scatter of phases about their plane. `ok` is False where no peak
        is significant: flat or unrelated images.

    Raises:
        ValueError: shapes differ.

    References:
        Kuglin and Hines, 1975; Guizar-Sicairos et al., 2008, for the refined peak [K-26, R-33].

    Example:
        >>> import jax, jax.numpy as jnp
        >>> from jaxloc.images.gradients import smooth
        >>> scene = smooth(jax.random.normal(jax.random.key(0), (80, 90)), 2.0)
        >>> found = translation(scene[8:72, 8:72], scene[5:69, 12:76])
        >>> found.value.translation.round().tolist(), bool(found.ok)
        ([-4.0, 3.0], True)
    """
    previous, current, finite = _same_shape(previous, current)
    peak = _correlate(_windowed(previous), _windowed(current), bandwidth)
    return _estimate(Translation(peak.uv), peak.covariance, peak.information, peak.height, peak.ok, finite)


@filter_jit
def similarity(
    image: Num[Array, "h w"] | Any,
    template: Num[Array, "h w"] | Any,
    *,
    sampling: LogPolar = LogPolar(),
    bandwidth: float = 0.25,
    rounds: int = 2,
) -> Estimate:
    """Rotation, scale and translation between two images: ``image(W(x)) ~ template(x)`` (Fourier-Mellin).

    The amplitudes of both spectra, high-pass filtered and in logarithmic polar coordinates, are phase-correlated:
    their shift is rotation, up to half a turn, and the logarithm of scale. Both half turns are undone and the images
    phase-correlated; the higher peak decides. A second round starts from the result of the first, so that both windows
    show the same part of the scene.

    Args:
        image: gray levels.
        template: gray levels, of the same shape.
        sampling: of the spectrum.
        bandwidth: of the phase correlation of the images, cycles per pixel.
        rounds: static number of rounds.

    Returns:
        Estimate of a `Similarity` from template to image pixels, for scales between about 0.6 and 1.6. `cost` is one
        minus the height of the last peak; the covariance, of ``W @ exp(d)``, takes rotation and scale, found apart from
        the shift, as independent of it. `ok` is False where no peak is significant.

    Raises:
        ValueError: shapes differ, or there is no round.

    References:
        Reddy and Chatterji, "An FFT-based technique for translation, rotation, and scale-invariant image registration",
        1996 [R-33, R-34].

    Example:
        >>> import jax, jax.numpy as jnp
        >>> from jaxloc.images.gradients import smooth
        >>> scene = smooth(jax.random.normal(jax.random.key(0), (96, 96)), 2.0)
        >>> found = jax.jit(similarity)(jnp.rot90(scene), scene)
        >>> bool(found.ok), round(float(jnp.abs(found.value.log()[2])), 2)
        (True, 1.57)
    """
    if rounds < 1:
        raise ValueError(f"similarity: {rounds} rounds; at least one is needed.")
    template, image, finite = _same_shape(template, image)
    warp, ok = Similarity.identity(image.dtype), jnp.asarray(True)
    polar_template = sampling.sample(amplitude(_windowed(template)))
    for number in range(rounds):
        rotation, turn = _rotation_scale(image, warp, polar_template, sampling)
        candidates = [
            warp @ _about_center(d, image.shape) for d in (rotation, rotation + jnp.array([jnp.pi, 0.0], image.dtype))
        ]
        # The second round only refines.
        candidates = candidates if number == 0 else candidates[:1]
        peaks = [_shift(image, template, candidate, bandwidth) for candidate in candidates]
        warps = [
            candidate @ Similarity.of(Translation(peak.uv)) for candidate, peak in zip(candidates, peaks, strict=True)
        ]
        best = jnp.argmax(jnp.stack([peak.height for peak in peaks]))
        warp, peak = _choose(best, warps), _choose(best, peaks)
        ok = ok & turn.ok & peak.ok
    covariance, information = _joint(turn, peak, sampling, image.shape)
    return _estimate(warp, covariance, information, peak.height, ok, finite)


def _choose(index: Array, records: list) -> Any:
    return jax.tree.map(lambda *leaves: jnp.stack(leaves)[index], *records)


def _same_shape(a: Any, b: Any) -> tuple[Array, Array, Bool[Array, ""]]:
    """Finite floats of one dtype, and whether both images have finite pixels."""
    a = as_gray(a)
    b = as_gray(b, a.dtype)
    if a.shape != b.shape:
        raise ValueError(f"Phase correlation needs images of one shape; got {a.shape} and {b.shape}.")
    known = [jnp.isfinite(x) for x in (a, b)]
    return _filled(a, known[0]), _filled(b, known[1]), jnp.any(known[0]) & jnp.any(known[1])


def _filled(image: Array, finite: Array) -> Array:
    count = jnp.maximum(jnp.sum(finite), 1).astype(image.dtype)
    return jnp.where(finite, image, jnp.sum(jnp.where(finite, image, 0.0)) / count)


def _windowed(image: Float[Array, "h w"]) -> Float[Array, "h w"]:
    window = hann(image.shape, image.dtype)
    return window * (image - jnp.sum(window * image) / jnp.sum(window))


def _phases(a: Float[Array, "h w"], b: Float[Array, "h w"], bandwidth: float) -> tuple[Array, Array]:
    """The weighted phase factors of the cross-spectrum, real and imaginary part, and the weights."""
    spectrum = jnp.conj(jnp.fft.fft2(a)) * jnp.fft.fft2(b)
    real, imaginary = spectrum.real, spectrum.imag
    power = real * real + imaginary * imaginary
    floor = (1e3 * float(jnp.finfo(a.dtype).eps)) ** 2 * jnp.max(power)
    known = lax.stop_gradient(power > floor)
    size = jnp.sqrt(jnp.where(known, power, 1.0))
    u, v = _frequencies(a.shape, a.dtype)
    weight = jnp.exp(-0.5 * (u[None, :] ** 2 + v[:, None] ** 2) / bandwidth**2)
    weight = weight / jnp.sum(weight)
    factors = jnp.stack([jnp.where(known, real / size, 0.0), jnp.where(known, imaginary / size, 0.0)])
    return factors * weight[None], weight


def _frequencies(shape: tuple[int, int], dtype: Any) -> tuple[Array, Array]:
    return jnp.fft.fftfreq(shape[1], dtype=dtype), jnp.fft.fftfreq(shape[0], dtype=dtype)


def _moments(factors: Float[Array, "2 h w"], uv: Float[Array, "2"]) -> tuple[Array, Array, Array]:
    """The correlation at a shift, its gradient and Hessian."""
    u, v = _frequencies(factors.shape[1:], factors.dtype)
    angle = 2 * jnp.pi * (uv[0] * u[None, :] + uv[1] * v[:, None])
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    real, imaginary = factors[0] * cos - factors[1] * sin, factors[0] * sin + factors[1] * cos
    u, v = 2 * jnp.pi * u, 2 * jnp.pi * v
    columns, rows = jnp.sum(imaginary, axis=0), jnp.sum(imaginary, axis=1)
    gradient = -jnp.stack([jnp.sum(u * columns), jnp.sum(v * rows)])
    both = jnp.sum(v * jnp.sum(real * u[None, :], axis=1))
    along = jnp.sum(u * u * jnp.sum(real, axis=0)), jnp.sum(v * v * jnp.sum(real, axis=1))
    hessian = -jnp.stack([jnp.stack([along[0], both]), jnp.stack([both, along[1]])])
    return jnp.sum(real), gradient, hessian


def _correlate(a: Float[Array, "h w"], b: Float[Array, "h w"], bandwidth: float) -> _Peak:
    """The peak of the phase correlation of two windowed images."""
    factors, weight = _phases(a, b, bandwidth)
    frozen, shape = lax.stop_gradient(factors), jnp.array(a.shape[::-1])
    surface = jnp.fft.ifft2(lax.complex(frozen[0], frozen[1])).real * a.size
    best = jnp.argmax(surface)
    whole = jnp.stack([best % a.shape[1], best // a.shape[1]])
    whole = jnp.where(whole > shape // 2, whole - shape, whole).astype(a.dtype)

    def advance(_: Any, uv: Array) -> Array:
        _, gradient, hessian = _moments(frozen, uv)
        return jnp.clip(uv + _newton(gradient, hessian)[0], whole - 1.0, whole + 1.0)

    uv = lax.fori_loop(0, _NEWTON_STEPS, advance, whole)
    height, gradient, hessian = _moments(factors, uv)
    step, curved = _newton(gradient, lax.stop_gradient(hessian))
    # The surface is periodic: with the best pixel in the middle, no peak is cut at the border.
    around = jnp.roll(surface, (shape // 2)[::-1] - jnp.stack([best // a.shape[1], best % a.shape[1]]), (0, 1))
    second = find_peaks(around, count=2, separation=3).scores[1]
    noise = jnp.sqrt(jnp.sum(weight**2))
    ok = curved & (height > _LEAST_HEIGHT * noise) & (second < 0.8 * height) & jnp.all(jnp.abs(uv - whole) < 1.0)
    covariance, information = _scatter(frozen, uv, hessian, ok)
    return _Peak(uv + jnp.where(ok, step, 0.0), covariance, information, height, ok)


def _newton(gradient: Float[Array, "2"], hessian: Float[Array, "2 2"]) -> tuple[Array, Array]:
    """Newton step to a maximum, and whether the Hessian is negative definite."""
    determinant = hessian[0, 0] * hessian[1, 1] - hessian[0, 1] ** 2
    curved = (hessian[0, 0] < 0) & (determinant > 1e-3 * hessian[0, 0] * hessian[1, 1]) & (determinant > 0)
    inverse = _linalg.inverse(jnp.where(curved, hessian, -jnp.eye(2, dtype=hessian.dtype)))
    return jnp.where(curved, -matmul(inverse, gradient), 0.0), curved


def _scatter(factors: Array, uv: Array, hessian: Array, ok: Array) -> tuple[Array, Array]:
    """Covariance ``H^-1 M H^-1`` with M the sum of squares of each frequency's part of the gradient, and its inverse.

    Doubled, as frequencies come in pairs of one phase, and multiplied by the correlation due to the Hann windows.
    """
    u, v = _frequencies(factors.shape[1:], factors.dtype)
    angle = 2 * jnp.pi * (uv[0] * u[None, :] + uv[1] * v[:, None])
    imaginary = factors[0] * jnp.sin(angle) + factors[1] * jnp.cos(angle)
    u, v, squares = 2 * jnp.pi * u, 2 * jnp.pi * v, imaginary**2
    both = jnp.sum(v * jnp.sum(squares * u[None, :], axis=1))
    along = jnp.sum(u * u * jnp.sum(squares, axis=0)), jnp.sum(v * v * jnp.sum(squares, axis=1))
    window = (35.0 / 18.0) ** 2
    meat = 2.0 * window * jnp.stack([jnp.stack([along[0], both]), jnp.stack([both, along[1]])])
    eye = jnp.eye(2, dtype=uv.dtype)
    inverse = _linalg.inverse(jnp.where(ok, lax.stop_gradient(hessian), eye))
    covariance = jnp.where(ok, matmul(inverse, matmul(meat, inverse)) + 1e-4 * eye, eye)
    covariance = lax.stop_gradient(covariance)
    return covariance, jnp.where(ok, _linalg.inverse(covariance), 0.0 * eye)


def _about_center(rotation_scale: Float[Array, "2"], shape: tuple[int, int]) -> Similarity:
    """A rotation and a change of scale (its logarithm) about the image's center."""
    center = _center(shape, rotation_scale.dtype)
    zero = jnp.zeros((), rotation_scale.dtype)
    inner = Similarity.exp(jnp.stack([zero, zero, rotation_scale[0], rotation_scale[1]]))
    return Similarity.of(Translation(center) @ inner @ Translation(-center))


def _center(shape: tuple[int, int], dtype: Any) -> Float[Array, "2"]:
    return 0.5 * jnp.array([shape[1] - 1, shape[0] - 1], dtype=dtype)


def _warped(image: Float[Array, "h w"], warp: Similarity) -> Float[Array, "h w"]:
    """The warped image: windowed, and blank outside."""
    v, u = jnp.meshgrid(*(jnp.arange(side, dtype=image.dtype) for side in image.shape), indexing="ij")
    right, down = warp.map_components(u.reshape(-1), v.reshape(-1))
    read = sample(image - jnp.mean(image), jnp.stack([right, down], axis=1), method=Bicubic())
    return _windowed(read.values.reshape(image.shape))


def _rotation_scale(image: Array, warp: Similarity, polar_template: Array, sampling: LogPolar) -> tuple[Array, _Peak]:
    """Remaining rotation and log-scale between the warped image and the template."""
    polar = sampling.sample(amplitude(_warped(image, warp)))
    peak = _correlate(sampling.tapered(polar_template), sampling.tapered(polar), 0.15)
    # Scaling an image by s scales its spectrum by 1/s.
    return sampling.turn(peak.uv), peak


def _shift(image: Array, template: Array, warp: Similarity, bandwidth: float) -> _Peak:
    return _correlate(_windowed(template), _warped(image, warp), bandwidth)


def _joint(turn: _Peak, shift: _Peak, sampling: LogPolar, shape: tuple[int, int]) -> tuple[Array, Array]:
    """Covariance and information of the warp's tangent at the template's origin."""
    zero = jnp.zeros((2, 2), shift.covariance.dtype)
    scale = sampling.steps(shift.covariance.dtype)
    rotated = turn.covariance[::-1, ::-1] * scale[:, None] * scale[None, :]
    centered = jnp.block([[shift.covariance, zero], [zero, rotated]])
    adjoint = Similarity.of(Translation(_center(shape, zero.dtype))).adjoint()
    covariance = matmul(adjoint, matmul(centered, adjoint.T))
    return covariance, _linalg.inverse(covariance)


def _estimate(value: Any, covariance: Array, information: Array, height: Array, ok: Array, finite: Array) -> Estimate:
    status = jnp.where(ok, jnp.int32(Status.CONVERGED), jnp.int32(Status.INADMISSIBLE))
    status = jnp.where(finite, status, int(Status.NONFINITE))
    steps = jnp.asarray(_NEWTON_STEPS, jnp.int32)
    return Estimate(value, covariance, 1.0 - height, ok & finite, steps, status, information)
