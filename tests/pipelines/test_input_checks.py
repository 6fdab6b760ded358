"""Checks of images that pipelines are given."""

import types

import numpy as np
import pytest

from jaxloc.pipelines.input_checks import check_image, check_stereo_images

GRAY = np.zeros((4, 6), np.uint8)


@pytest.mark.parametrize("image", [GRAY, GRAY.astype(np.float32), GRAY.astype(np.float64)])
def test_gray_levels_pass(image):
    assert check_image(image, (0, 0)) == (4, 6) and check_image(image, (4, 6)) == (4, 6)


@pytest.mark.parametrize(
    "image, match",
    [
        (None, "left image is missing"),
        (np.zeros((4, 6, 3), np.uint8), "not a color image"),
        (np.zeros(4, np.uint8), r"shape \(4,\): give a grayscale image"),
        (GRAY.astype(np.uint16), r"dtype uint16: .* image / 257"),
        (GRAY.astype(bool), "dtype bool"),
        (np.zeros((0, 6), np.uint8), "is empty"),
        (np.zeros((4, 7), np.uint8), r"shape \(4, 7\), but the images before it have \(4, 6\)"),
    ],
)
def test_other_images_are_refused(image, match):
    with pytest.raises(ValueError, match=match):
        check_image(image, (4, 6), "left image")


def test_both_images_of_a_pair():
    assert check_stereo_images(types.SimpleNamespace(left=GRAY, right=GRAY), (0, 0)) == (4, 6)
    with pytest.raises(ValueError, match="right image is missing"):
        check_stereo_images(types.SimpleNamespace(left=GRAY, right=None), (0, 0))
    with pytest.raises(ValueError, match="left image is missing"):
        check_stereo_images(object(), (0, 0))
    with pytest.raises(ValueError, match=r"right image has shape \(4, 5\)"):
        check_stereo_images(types.SimpleNamespace(left=GRAY, right=GRAY[:, :5]), (0, 0))
