"""Synthetic worlds that give the library's own records, with exact truth."""

from jaxloc.data.simulate import ceiling, floor, landmarks, laser, pallet, road, stereo_points, street, targets

__all__ = ["ceiling", "floor", "landmarks", "laser", "pallet", "road", "stereo_points", "street", "targets"]
