"""Stone Soup's GM-PHD filter on scans of ours."""

import datetime

import numpy as np
from stonesoup.hypothesiser.distance import DistanceHypothesiser
from stonesoup.hypothesiser.gaussianmixture import GaussianMixtureHypothesiser
from stonesoup.measures import Mahalanobis
from stonesoup.mixturereducer.gaussianmixture import GaussianMixtureReducer
from stonesoup.models.measurement.linear import LinearGaussian
from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
from stonesoup.predictor.kalman import KalmanPredictor
from stonesoup.types.detection import Detection
from stonesoup.types.state import TaggedWeightedGaussianState
from stonesoup.updater.kalman import KalmanUpdater
from stonesoup.updater.pointprocess import PHDUpdater

from jaxloc.data.simulate.targets import LinearScenario

_GATE = 3.72  # sigmas that 99.9 % of measurements in the plane pass
_ORDER = np.array([0, 2, 1, 3])  # its states are (x, vx, y, vy)


def run(scenario: LinearScenario, scans: list[np.ndarray]) -> float:
    """A pass over scans; the expected number of targets after the last."""
    kalman = KalmanUpdater(LinearGaussian(4, (0, 2), np.asarray(scenario.sensor.noise_covariance, float)))
    predictor = KalmanPredictor(CombinedLinearGaussianTransitionModel([ConstantVelocity(25.0)] * 2))
    pairs = DistanceHypothesiser(predictor, kalman, Mahalanobis(), missed_distance=_GATE)
    hypothesiser = GaussianMixtureHypothesiser(pairs, order_by_detection=True)
    updater = PHDUpdater(
        kalman,
        clutter_spatial_density=float(scenario.clutter_rate / scenario.clutter_volume),
        prob_detection=float(scenario.detection),
        prob_survival=float(scenario.survival),
    )
    reducer = GaussianMixtureReducer(prune_threshold=1e-5, merge_threshold=4.0, max_number_components=100)
    now, components = datetime.datetime(2000, 1, 1), []
    for scan in scans:
        now = now + datetime.timedelta(seconds=1)
        components = [*components, *_births(scenario, now)]
        seen = {Detection(z.reshape(-1, 1), timestamp=now, measurement_model=kalman.measurement_model) for z in scan}
        hypotheses = hypothesiser.hypothesise(components, seen, now)
        components = reducer.reduce(updater.update(hypotheses).components)
    return float(sum(component.weight for component in components))


def _births(scenario: LinearScenario, now: datetime.datetime) -> list[TaggedWeightedGaussianState]:
    covariance = np.asarray(scenario.birth_covariance, float)
    places = zip(np.asarray(scenario.birth_means, float), np.asarray(scenario.birth_weights, float), strict=True)
    return [
        TaggedWeightedGaussianState(mean[_ORDER].reshape(-1, 1), covariance, timestamp=now, weight=weight, tag="birth")
        for mean, weight in places
    ]
