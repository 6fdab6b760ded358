"""Options of floor mosaics."""

import equinox as eqx


class OdometryNoise(eqx.Module):
    """Noise of the odometry; see `IncrementMotion`.

    Attributes:
        drive: standard deviation after 1 m of driving, along the path, m.
        side: the same perpendicular to it, m.
        idle: standard deviation of the position in each image interval, m.
        turn_drive: standard deviation of the heading after 1 m of driving, rad.
        turn_turn: the same after a turn of 1 rad, rad.
        turn_idle: standard deviation of the heading in each image interval, rad.
    """

    drive: float = 0.003
    side: float = 0.002
    idle: float = 0.0005
    turn_drive: float = 0.02
    turn_turn: float = 0.01
    turn_idle: float = 0.004


class Config(eqx.Module):
    """Options of the mosaic.

    Attributes:
        odometry: its noise; only used where covariances are not given.
        neighbors: number of preceding images that each image is registered with.
        closures: greatest number of loop closures of an image in a round.
        rounds: number of searches for loop closures, each with the poses of the last one.
        min_overlap: least predicted overlap of two images, as a fraction of the image.
        gate: probability that a correct registration passes, by the covariance of the odometry.
        kernel: scale of the robust kernel on registrations, in standard deviations.
        resolution: edge of a pixel of the mosaic, m; 0 for that of the images.
        black: gray level of darkness.
        tracking: fraction of the image's edges that is used to localize in the finished mosaic.
    """

    odometry: OdometryNoise = OdometryNoise()
    neighbors: int = 2
    closures: int = 2
    rounds: int = 2
    min_overlap: float = 0.3
    gate: float = 0.9999
    kernel: float = 6.0
    resolution: float = 0.0
    black: float = 0.0
    tracking: float = 0.5

    def __check_init__(self):
        for name, least in (("neighbors", 1), ("closures", 0), ("rounds", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"{name} is {getattr(self, name)}, must be at least {least}")
        for name in ("min_overlap", "gate", "tracking"):
            if not 0.0 < getattr(self, name) <= 1.0:
                raise ValueError(f"{name} is {getattr(self, name)}, must lie between 0 and 1")
        if self.kernel <= 0.0 or self.resolution < 0.0:
            raise ValueError("kernel must be positive and resolution not negative")
