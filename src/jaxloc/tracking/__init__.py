"""Many targets at once: who is there, where, and since when."""

from jaxloc.tracking import birth, clutter, contract, cphd, gating, gmphd, gnn, jpda, mht, model, pda, scan, tracks
from jaxloc.tracking.birth import Birth, MeasuredBirth, PointBirth, StaticBirth
from jaxloc.tracking.clutter import Clutter, FrustumClutter, UniformClutter
from jaxloc.tracking.contract import Targets, Tracker, TrackerInfo
from jaxloc.tracking.cphd import CphdState, GmCphd
from jaxloc.tracking.gmphd import GmPhd, PhdState, Spawning
from jaxloc.tracking.gnn import GlobalNearestNeighbor
from jaxloc.tracking.jpda import BeliefPropagation, Exact, JointProbabilisticDataAssociation, Marginals
from jaxloc.tracking.mht import Hypotheses, MultipleHypothesisTracker
from jaxloc.tracking.model import ConstantDetection, Detection, FieldOfView, TargetModel
from jaxloc.tracking.pda import Association, ProbabilisticDataAssociation
from jaxloc.tracking.tracks import CountLife, ExistenceLife, Life, Tracks

__all__ = [
    "Association",
    "BeliefPropagation",
    "Birth",
    "Clutter",
    "ConstantDetection",
    "CountLife",
    "CphdState",
    "Detection",
    "Exact",
    "ExistenceLife",
    "FieldOfView",
    "FrustumClutter",
    "GlobalNearestNeighbor",
    "GmCphd",
    "GmPhd",
    "Hypotheses",
    "JointProbabilisticDataAssociation",
    "Life",
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
    "birth",
    "clutter",
    "contract",
    "cphd",
    "gating",
    "gmphd",
    "gnn",
    "jpda",
    "mht",
    "model",
    "pda",
    "scan",
    "tracks",
]
