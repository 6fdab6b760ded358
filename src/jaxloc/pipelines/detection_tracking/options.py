"""Options of tracking by detection: tracker, motion, measurement and confirmation of tracks."""

from abc import abstractmethod

import equinox as eqx

from jaxloc.beliefs import MahalanobisDistance
from jaxloc.pipelines.detection_tracking.models import MIN_EXISTENCE, Noise
from jaxloc.tracking import (
    ExistenceLogic,
    GlobalNearestNeighbor,
    GmPhd,
    JointProbabilisticDataAssociation,
    TargetModel,
    Tracker,
)


class Strategy(eqx.Module):
    """A tracker with its options."""

    @abstractmethod
    def tracker(self, model: TargetModel, capacity: int) -> Tracker:
        """The tracker."""


class Phd(Strategy):
    """Gaussian mixture PHD filter with labeled components.

    Attributes:
        merge: squared Mahalanobis distance below which components are merged.
        gate: probability that a target's own measurement passes the gate.
        prune: weight below which a component is dropped.
    """

    merge: float = 4.0
    gate: float = 0.9999
    prune: float = 1e-5

    def tracker(self, model: TargetModel, capacity: int) -> Tracker:
        """A `GmPhd`."""
        close = MahalanobisDistance(self.merge)
        return GmPhd(model, capacity, prune=self.prune, closeness=close, gate=self.gate)


class ExistenceStrategy(Strategy):
    """A tracker of single targets with probabilities of existence.

    Attributes:
        gate: probability that a target's own measurement passes the gate.
        delete: probability of existence below which a track is deleted.
    """

    gate: float = 0.9999
    delete: float = 1e-3

    def logic(self) -> ExistenceLogic:
        """When tracks are extracted and deleted."""
        return ExistenceLogic(confirm=MIN_EXISTENCE, delete=self.delete, report=MIN_EXISTENCE)


class Jpda(ExistenceStrategy):
    """Joint integrated probabilistic data association (JIPDA)."""

    def tracker(self, model: TargetModel, capacity: int) -> Tracker:
        """A `JointProbabilisticDataAssociation`, by belief propagation."""
        return JointProbabilisticDataAssociation(model, capacity, self.gate, self.logic())


class Gnn(ExistenceStrategy):
    """Global nearest neighbor: the most likely assignment in each frame."""

    def tracker(self, model: TargetModel, capacity: int) -> Tracker:
        """A `GlobalNearestNeighbor`."""
        return GlobalNearestNeighbor(model, capacity, self.gate, self.logic())


STRATEGIES = {"gmphd": Phd, "jpda": Jpda, "gnn": Gnn}


class TargetMotion(eqx.Module):
    """Motion of targets at nearly constant velocity, in m for positions and in px for boxes.

    Slow entries are the vertical position of an object, and width and height of a box.

    Attributes:
        acceleration: spectral density of the white-noise acceleration, m^2/s^3.
        slow_acceleration: the same of slow entries.
        score_drift: the same of the score.
        speed: standard deviation of a new target's velocity, m/s.
        slow_speed: the same of slow entries.
        score_rate: the same of the score.
    """

    acceleration: float = 2.0
    slow_acceleration: float = 0.25
    score_drift: float = 0.4
    speed: float = 10.0
    slow_speed: float = 0.5
    score_rate: float = 1.0


class Scene(eqx.Module):
    """Birth, clutter, detection and survival of targets.

    Attributes:
        birth_rate: expected number of new targets in a frame.
        clutter_rate: expected number of false detections in a frame.
        clutter_score: mean of their scores.
        volume: of the space of positions or boxes, m^3 or px^4.
        score_range: range of the scores of targets.
        survival: probability that a target exists in the next frame.
        out_of_view_survival: factor on it for targets out of view.
        half_view: tangent of half the camera's angle of view (positions only).
        detection_base: log odds of detection at a score of zero.
        detection_slope: their increase with the score.
        min_score: detections of lower scores are not used.
    """

    birth_rate: float = 0.3
    clutter_rate: float = 5.0
    clutter_score: float = 1.5
    volume: float = 2e4
    score_range: float = 15.0
    survival: float = 0.98
    out_of_view_survival: float = 0.5
    half_view: float = 0.86
    detection_base: float = 0.0
    detection_slope: float = 0.4
    min_score: float = 0.0


class Confirmation(eqx.Module):
    """When a track is confirmed, and a confirmed track reported.

    Attributes:
        existence: probability of existence that confirms a track,
        score: together with a score of at least this,
        frames: in so many frames.
        report_existence: least probability of existence of a confirmed track that is reported.
        report_score: least score of a confirmed track that is reported.
    """

    existence: float = 0.9
    score: float = 3.1
    frames: int = 1
    report_existence: float = 0.5
    report_score: float = 1.8

    def __check_init__(self):
        if self.frames < 1:
            raise ValueError(f"frames is {self.frames}, must be at least 1")


class Config(eqx.Module):
    """Options; the defaults suit cars by KITTI's cameras and PointRCNN's scores, `for_boxes` suits pedestrians.

    Attributes:
        strategy: the tracker.
        noise: of detections.
        motion: of targets.
        scene: birth, clutter, detection and survival of targets.
        confirmation: of tracks.
        capacity: number of tracks, or of components.
    """

    strategy: Strategy = Phd()
    noise: Noise = Noise()
    motion: TargetMotion = TargetMotion()
    scene: Scene = Scene()
    confirmation: Confirmation = Confirmation()
    capacity: int = 64

    def __check_init__(self):
        if self.capacity < 1:
            raise ValueError(f"capacity is {self.capacity}, must be at least 1")
        for part in (self.noise, self.motion, self.scene):
            for name, value in vars(part).items():
                if not (name in ("detection_base", "min_score") or value > 0):
                    raise ValueError(f"{name} is {value}, must be positive")
        for name in ("survival", "out_of_view_survival"):
            if not getattr(self.scene, name) <= 1:
                raise ValueError(f"{name} is {getattr(self.scene, name)}, must be at most 1")

    @staticmethod
    def for_boxes(strategy: Strategy | None = None) -> "Config":
        """Options for boxes of pedestrians, whose scores lie between 0 and 1.

        Args:
            strategy: the tracker.
        """
        return Config(
            Phd() if strategy is None else strategy,
            Noise(box=0.06, score=0.15),
            TargetMotion(400.0, 100.0, 0.02, 60.0, 15.0, 0.1),
            Scene(0.1, 1.0, 0.4, 1e9, 1.0, 0.99, 1.0, 1.0, -0.5, 1.0),
            Confirmation(existence=0.9, score=0.5, frames=2, report_existence=0.2, report_score=0.3),
        )
