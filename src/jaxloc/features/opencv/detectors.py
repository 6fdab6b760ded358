"""OpenCV's detectors and their options, as records; they run on the host."""

from abc import abstractmethod
from dataclasses import dataclass

import equinox as eqx
import numpy as np

from jaxloc.features.opencv.backend import create, load


@dataclass
class Candidates:
    """Detections on the host; fields other than position and response may stay in OpenCV's keypoints."""

    uv: np.ndarray
    response: np.ndarray
    size: float = 7.0
    keypoints: tuple | None = None


class AbstractDetector(eqx.Module):
    """A detector and its options."""

    @abstractmethod
    def find(self, pixels: np.ndarray, mask: np.ndarray | None, capacity: int) -> Candidates:
        """Detects candidates in an 8-bit image, more than `capacity` where possible."""


class AbstractFeature(AbstractDetector):
    """A detector that OpenCV pairs with a descriptor of the same name.

    Attributes:
        surplus: Candidates for each slot, so that all cells have some.
    """

    surplus: eqx.AbstractClassVar[int]

    @abstractmethod
    def extractor(self, count: int):
        """OpenCV's feature object."""

    def find(self, pixels: np.ndarray, mask: np.ndarray | None, capacity: int) -> Candidates:
        """Detects more keypoints than there are slots."""
        return from_opencv(self.extractor(self.surplus * capacity).detect(pixels, mask))


class ORB(AbstractFeature):
    """Oriented FAST corners over a pyramid; binary descriptors of 256 bits.

    Attributes:
        scale_factor: Ratio of neighboring pyramid levels.
        levels: Number of pyramid levels.
        fast_threshold: Least contrast of a corner, gray levels.
        patch_size: Side of the described patch, px; no keypoint is nearer to the border.

    References:
        Rublee et al., "ORB: an efficient alternative to SIFT or SURF" (2011).
    """

    surplus = 3
    scale_factor: float = eqx.field(static=True, default=1.2)
    levels: int = eqx.field(static=True, default=8)
    fast_threshold: int = eqx.field(static=True, default=12)
    patch_size: int = eqx.field(static=True, default=31)

    def extractor(self, count: int):
        """OpenCV's ORB."""
        return create(
            "ORB",
            nfeatures=count,
            scaleFactor=self.scale_factor,
            nlevels=self.levels,
            edgeThreshold=self.patch_size,
            patchSize=self.patch_size,
            fastThreshold=self.fast_threshold,
        )


class SIFT(AbstractFeature):
    """Extrema of the difference-of-Gaussians scale space; descriptors of 128 numbers.

    Attributes:
        octave_layers: Layers in each octave.
        contrast_threshold: Least contrast of an extremum, as in OpenCV.
        edge_threshold: Greatest ratio of principal curvatures.
        sigma: Blur of the first layer, px.

    References:
        Lowe, "Distinctive image features from scale-invariant keypoints" (2004).
    """

    surplus = 1
    octave_layers: int = eqx.field(static=True, default=3)
    contrast_threshold: float = eqx.field(static=True, default=0.03)
    edge_threshold: float = eqx.field(static=True, default=10.0)
    sigma: float = eqx.field(static=True, default=1.6)

    def extractor(self, count: int):
        """OpenCV's SIFT, which returns all it finds."""
        return create(
            "SIFT",
            nfeatures=0,
            nOctaveLayers=self.octave_layers,
            contrastThreshold=self.contrast_threshold,
            edgeThreshold=self.edge_threshold,
            sigma=self.sigma,
        )


class KAZE(AbstractFeature):
    """Hessian extrema of a nonlinear scale space; descriptors of 64 numbers (128 if extended).

    Attributes:
        threshold: Least detector response.
        octaves: Number of octaves.
        octave_layers: Layers in each octave.
        extended: Describe by 128 numbers.
        upright: Ignore the orientation.

    References:
        Alcantarilla et al., "KAZE features" (2012).
    """

    surplus = 1
    threshold: float = eqx.field(static=True, default=0.0005)
    octaves: int = eqx.field(static=True, default=4)
    octave_layers: int = eqx.field(static=True, default=4)
    extended: bool = eqx.field(static=True, default=False)
    upright: bool = eqx.field(static=True, default=False)

    def extractor(self, count: int):
        """OpenCV's KAZE, which returns all it finds."""
        return create(
            "KAZE",
            extended=self.extended,
            upright=self.upright,
            threshold=self.threshold,
            nOctaves=self.octaves,
            nOctaveLayers=self.octave_layers,
        )


class AKAZE(AbstractFeature):
    """KAZE by fast explicit diffusion; binary descriptors of 486 bits.

    Attributes:
        threshold: Least detector response.
        octaves: Number of octaves.
        octave_layers: Layers in each octave.

    References:
        Alcantarilla et al., "Fast explicit diffusion for accelerated features in nonlinear scale spaces" (2013).
    """

    surplus = 1
    threshold: float = eqx.field(static=True, default=0.0005)
    octaves: int = eqx.field(static=True, default=4)
    octave_layers: int = eqx.field(static=True, default=4)

    def extractor(self, count: int):
        """OpenCV's A-KAZE, which returns all it finds."""
        return create("AKAZE", threshold=self.threshold, nOctaves=self.octaves, nOctaveLayers=self.octave_layers)


class FAST(AbstractDetector):
    """Segment-test corners at one scale; the fastest detector.

    Attributes:
        threshold: Least contrast between the center and its circle, gray levels.

    References:
        Rosten and Drummond, "Machine learning for high-speed corner detection" (2006).
    """

    threshold: int = eqx.field(static=True, default=10)

    def find(self, pixels: np.ndarray, mask: np.ndarray | None, capacity: int) -> Candidates:
        """Finds all corners that are maximal among their neighbors."""
        found = create("FastFeatureDetector", threshold=self.threshold).detect(pixels, mask)
        candidates = from_opencv(found)
        # All corners have the same size, angle and octave.
        return Candidates(candidates.uv, candidates.response)


class AbstractCorner(AbstractDetector):
    """Local maxima of a corner response, with subpixel refinement."""

    block_size: eqx.AbstractVar[int]
    quality: eqx.AbstractVar[float]
    radius: eqx.AbstractVar[int]

    @abstractmethod
    def response(self, pixels: np.ndarray) -> np.ndarray:
        """The corner response of every pixel."""

    def find(self, pixels: np.ndarray, mask: np.ndarray | None, capacity: int) -> Candidates:
        """Finds the maxima within `radius` that exceed `quality` times the greatest response."""
        response = self.response(pixels)
        side = 2 * self.radius + 1
        peak = response >= load().dilate(response, np.ones((side, side), np.uint8))
        peak &= response > max(self.quality * float(response.max()), 1e-12)
        peak[[0, -1]] = peak[:, [0, -1]] = False
        if mask is not None:
            peak &= mask > 0
        # Ten times as fast as np.nonzero, which fills two index arrays.
        rows, columns = np.divmod(np.flatnonzero(peak), peak.shape[1])
        offset = _parabola_offsets(response, rows, columns)
        uv = np.stack([columns, rows], axis=1).astype(np.float32) + offset
        return Candidates(uv, response[rows, columns], size=float(self.block_size))


class Harris(AbstractCorner):
    """Maxima of Harris's response `|M| - k tr(M)^2`.

    Attributes:
        k: Weight of the trace; 0.04 to 0.15.
        block_size: Side of the window that M is averaged over, px.
        quality: Least response as a fraction of the greatest.
        radius: No other corner within this many pixels.

    References:
        Harris and Stephens, "A combined corner and edge detector" (1988); [T-25].
    """

    k: float = eqx.field(static=True, default=0.05)
    block_size: int = eqx.field(static=True, default=3)
    quality: float = eqx.field(static=True, default=1e-5)
    radius: int = eqx.field(static=True, default=2)

    def response(self, pixels: np.ndarray) -> np.ndarray:
        """`cv2.cornerHarris` with Sobel's 3x3 kernel."""
        return load().cornerHarris(pixels, self.block_size, 3, self.k)


class ShiTomasi(AbstractCorner):
    """Maxima of the smaller eigenvalue of the structure tensor (good features to track).

    Attributes:
        block_size: Side of the window that the tensor is averaged over, px.
        quality: Least response as a fraction of the greatest.
        radius: No other corner within this many pixels.

    References:
        Shi and Tomasi, "Good features to track" (1994); [T-26].
    """

    block_size: int = eqx.field(static=True, default=3)
    quality: float = eqx.field(static=True, default=2e-3)
    radius: int = eqx.field(static=True, default=2)

    def response(self, pixels: np.ndarray) -> np.ndarray:
        """`cv2.cornerMinEigenVal` with Sobel's 3x3 kernel."""
        return load().cornerMinEigenVal(pixels, self.block_size, ksize=3)


def from_opencv(keypoints) -> Candidates:
    """OpenCV's keypoints as candidates.

    Example:
        >>> from_opencv(()).uv.shape
        (0, 2)
    """
    if not len(keypoints):
        return Candidates(np.zeros((0, 2), np.float32), np.zeros(0, np.float32))
    response = np.array([keypoint.response for keypoint in keypoints], np.float32)
    return Candidates(load().KeyPoint_convert(keypoints), response, keypoints=keypoints)


def _parabola_offsets(response: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Offsets of the vertex of a parabola through three responses along rows and columns, at most half a pixel."""
    center = response[rows, columns]
    offsets = []
    for down, right in ((0, 1), (1, 0)):
        before, after = response[rows - down, columns - right], response[rows + down, columns + right]
        curvature = np.maximum(2.0 * center - before - after, 1e-30)
        offsets.append(np.clip(0.5 * (after - before) / curvature, -0.5, 0.5))
    return np.stack(offsets, axis=1).astype(np.float32)
