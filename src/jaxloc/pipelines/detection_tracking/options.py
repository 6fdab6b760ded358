"""Options of tracking by detections: which tracker, how targets move and are seen, when tracks are spoken of."""

from abc import abstractmethod

import equinox as eqx

from jaxloc.beliefs import MahalanobisDistance
from jaxloc.pipelines.detection_tracking.models import LEAST, Noise
from jaxloc.tracking import (
    ExistenceLogic,
    GlobalNearestNeighbor,
    GmPhd,
    JointProbabilisticDataAssociation,
    TargetModel,
    Tracker,
)


class Strategy(eqx.Module):
    """Which tracker is used, with its options."""

    @abstractmethod
    def tracker(self, model: TargetModel, capacity: int) -> Tracker:
        """The tracker."""


class Phd(Strategy):
    """The Gaussian mixture PHD filter, with the labels of components as identities.

    Attributes:
        merge: squared Mahalanobis distance below which components are one.
        gate: probability that a target's own measurement passes.
        prune: weight below which a component is dropped.
    """

    merge: float = 4.0
    gate: float = 0.9999
    prune: float = 1e-5

    def tracker(self, model: TargetModel, capacity: int) -> Tracker:
        """A `GmPhd`."""
        close = MahalanobisDistance(self.merge)
        return GmPhd(model, capacity, prune=self.prune, closeness=close, gate=self.gate)


class Jpda(Strategy):
    """Joint integrated probabilistic data association.

    Attributes:
        gate: probability that a target's own measurement passes.
        delete: existence below which a track ends.
    """

    gate: float = 0.9999
    delete: float = 1e-3

    def tracker(self, model: TargetModel, capacity: int) -> Tracker:
        """A `JointProbabilisticDataAssociation`, by belief propagation."""
        logic = ExistenceLogic(confirm=LEAST, delete=self.delete, report=LEAST)
        return JointProbabilisticDataAssociation(model, capacity, self.gate, logic)


class Gnn(Strategy):
    """The one best assignment in each frame.

    Attributes:
        gate: probability that a target's own measurement passes.
        delete: existence below which a track ends.
    """

    gate: float = 0.9999
    delete: float = 1e-3

    def tracker(self, model: TargetModel, capacity: int) -> Tracker:
        """A `GlobalNearestNeighbor`."""
        logic = ExistenceLogic(confirm=LEAST, delete=self.delete, report=LEAST)
        return GlobalNearestNeighbor(model, capacity, self.gate, logic)


STRATEGIES = {"gmphd": Phd, "jpda": Jpda, "gnn": Gnn}


class Movement(eqx.Module):
    """How targets move, in m for solids and in px for boxes. What is calm: the height of a solid, the sides of a box.

    Attributes:
        acceleration: spectral density, m^2/s^3.
        calm_acceleration: the same of what is calm.
        score_drift: the same of the score.
        speed: standard deviation of a new target's velocity, m/s.
        calm_speed: the same of what is calm.
        score_rate: the same of the score.
    """

    acceleration: float = 2.0
    calm_acceleration: float = 0.25
    score_drift: float = 0.4
    speed: float = 10.0
    calm_speed: float = 0.5
    score_rate: float = 1.0


class Scene(eqx.Module):
    """How many there are, and what is seen of them.

    Attributes:
        births: expected number of new targets in a frame.
        clutter: expected number of false detections in a frame.
        clutter_score: mean of their scores.
        volume: of the places that the detector looks at, m^3 or px^4.
        scores: range of the scores of targets.
        survival: probability that a target is still there in the next frame.
        stay: the same, on top of it, of a target that is out of view.
        half_view: tangent of half the camera's angle of view (solids only).
        detect_base: log odds that a target whose score is zero is detected,
        detect_slope: and how they grow with the score.
        least_score: detections of lower scores are not used.
    """

    births: float = 0.3
    clutter: float = 5.0
    clutter_score: float = 1.5
    volume: float = 2e4
    scores: float = 15.0
    survival: float = 0.98
    stay: float = 0.5
    half_view: float = 0.86
    detect_base: float = 0.0
    detect_slope: float = 0.4
    least_score: float = 0.0


class Belief(eqx.Module):
    """When a track is spoken of.

    Attributes:
        confirm: it was so likely to be there,
        surest: with so high a score,
        hits: in so many frames,
        show: and is still as likely as this,
        keep: with a score not below this.
    """

    confirm: float = 0.9
    surest: float = 3.1
    hits: int = 1
    show: float = 0.5
    keep: float = 1.8


class Config(eqx.Module):
    """Options; the defaults suit cars by KITTI's cameras and PointRCNN's scores, `for_boxes` suits pedestrians.

    Attributes:
        strategy: which tracker.
        noise: how detections err.
        movement: how targets move.
        scene: how many there are, and what is seen of them.
        belief: when a track is spoken of.
        capacity: room for tracks, or components.
    """

    strategy: Strategy = Phd()
    noise: Noise = Noise()
    movement: Movement = Movement()
    scene: Scene = Scene()
    belief: Belief = Belief()
    capacity: int = 64

    def __check_init__(self):
        if self.capacity < 1:
            raise ValueError(f"capacity is {self.capacity}, must be at least 1")
        for part in (self.noise, self.movement, self.scene):
            for name, value in vars(part).items():
                if not (name in ("detect_base", "least_score") or value > 0):
                    raise ValueError(f"{name} is {value}, must be positive")
        for name in ("survival", "stay"):
            if not getattr(self.scene, name) <= 1:
                raise ValueError(f"{name} is {getattr(self.scene, name)}, must be at most 1")

    @staticmethod
    def for_boxes(strategy: Strategy | None = None) -> "Config":
        """Options for boxes of pedestrians, whose scores lie between 0 and 1.

        Args:
            strategy: which tracker.
        """
        return Config(
            Phd() if strategy is None else strategy,
            Noise(box=0.06, score=0.15),
            Movement(400.0, 100.0, 0.02, 60.0, 15.0, 0.1),
            Scene(0.1, 1.0, 0.4, 1e9, 1.0, 0.99, 1.0, 1.0, -0.5, 1.0),
            Belief(confirm=0.9, surest=0.5, hits=2, show=0.2, keep=0.3),
        )
