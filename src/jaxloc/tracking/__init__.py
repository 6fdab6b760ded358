"""Multi-target tracking: GM-PHD, CPHD, GNN, PDA, JPDA and MHT filters, and the models they share."""

from jaxloc.tracking import cphd, gating, gmphd, gnn, interface, jpda, likelihood_ratio, mht, models, pda, tracks
from jaxloc.tracking.cphd import CphdState, GmCphd
from jaxloc.tracking.gmphd import GmPhd, PhdState, Spawning
from jaxloc.tracking.gnn import GlobalNearestNeighbor
from jaxloc.tracking.interface import Targets, Tracker, TrackerInfo
from jaxloc.tracking.jpda import BeliefPropagation, Exact, JointProbabilisticDataAssociation, Marginals
from jaxloc.tracking.mht import Hypotheses, MultipleHypothesisTracker
from jaxloc.tracking.models.birth import Birth, MeasuredBirth, PointBirth, StaticBirth
from jaxloc.tracking.models.clutter import Clutter, FrustumClutter, UniformClutter
from jaxloc.tracking.models.target import ConstantDetection, Detection, FieldOfView, TargetModel
from jaxloc.tracking.pda import Association, ProbabilisticDataAssociation
from jaxloc.tracking.tracks import ExistenceLogic, HistoryLogic, TrackLogic, Tracks

__all__ = [
    "Association",
    "BeliefPropagation",
    "Birth",
    "Clutter",
    "ConstantDetection",
    "HistoryLogic",
    "CphdState",
    "Detection",
    "Exact",
    "ExistenceLogic",
    "FieldOfView",
    "FrustumClutter",
    "GlobalNearestNeighbor",
    "GmCphd",
    "GmPhd",
    "Hypotheses",
    "JointProbabilisticDataAssociation",
    "TrackLogic",
    "Marginals",
    "MeasuredBirth",
    "MultipleHypothesisTracker",
    "PhdState",
    "PointBirth",
    "ProbabilisticDataAssociation",
    "Spawning",
    "StaticBirth",
    "TargetModel",
    "Targets",
    "Tracker",
    "TrackerInfo",
    "Tracks",
    "UniformClutter",
    "cphd",
    "gating",
    "gmphd",
    "gnn",
    "interface",
    "jpda",
    "likelihood_ratio",
    "mht",
    "models",
    "pda",
    "tracks",
]
