"""Options of detection and tracking of moving objects."""

import equinox as eqx

from jaxloc.beliefs import Closeness, MahalanobisDistance
from jaxloc.odometry import FlowOptions, GroupOptions
from jaxloc.pipelines.odometry import Config as OdometryConfig


class Config(eqx.Module):
    """Options of detection and tracking of moving objects.

    Attributes:
        odometry: options of the visual odometry.
        flow: options of the scene flow, which finds moving points.
        group: options of the grouping of moving points to objects.
        acceleration: spectral density of the white-noise acceleration of objects, m^2/s^3.
        detection: probability of detection of an object in view.
        survival: probability that an object exists in the next frame.
        clutter_rate: expected number of false objects in a frame.
        birth_rate: expected number of new objects in a frame.
        sigma: standard deviation of a point's measurement, px.
        extent: standard deviation of the visible part's center in its object, m.
        capacity: number of components of the filter.
        merge: criterion for merging components.
        confirm_frames: number of frames with a weight above 0.5 after which a track is confirmed.
        keep_weight: weight below which a confirmed track is not reported.
    """

    odometry: OdometryConfig = OdometryConfig()
    flow: FlowOptions = FlowOptions()
    group: GroupOptions = GroupOptions()
    acceleration: float = 4.0
    detection: float = 0.6
    survival: float = 0.98
    clutter_rate: float = 1.0
    birth_rate: float = 0.3
    sigma: float = 0.4
    extent: float = 0.7
    capacity: int = 64
    merge: Closeness = MahalanobisDistance()
    confirm_frames: int = 2
    keep_weight: float = 0.15
