"""RALPH: curvature by straightening the road under many hypotheses, offset by matching profiles with templates."""

from jaxloc.lanes.ralph.estimate import LaneState, LaneThresholds, estimate
from jaxloc.lanes.ralph.match import Match, match_profile
from jaxloc.lanes.ralph.profile import (
    AbsoluteSteps,
    LaneFit,
    Profile,
    Sharpness,
    SmoothSteps,
    Straightened,
    normalize_rows,
    straighten,
    straightness,
)
from jaxloc.lanes.ralph.refine import Refined, TemplateResidual, refine
from jaxloc.lanes.ralph.search import Hypotheses, Straightest, find_straightest
from jaxloc.lanes.ralph.template import Adaptation, Blended, Fixed, Predictive, Template, blend, capture

__all__ = [
    "AbsoluteSteps",
    "Adaptation",
    "Blended",
    "Fixed",
    "Hypotheses",
    "LaneFit",
    "LaneState",
    "Match",
    "Predictive",
    "Profile",
    "Refined",
    "Sharpness",
    "SmoothSteps",
    "Straightened",
    "Straightest",
    "Template",
    "TemplateResidual",
    "LaneThresholds",
    "blend",
    "capture",
    "estimate",
    "find_straightest",
    "match_profile",
    "normalize_rows",
    "refine",
    "straighten",
    "straightness",
]
