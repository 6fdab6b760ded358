"""RALPH: the lane by straightening the road under many hypotheses, and by what it looks like across."""

from jaxloc.alignment.ralph.estimate import LaneState, Trust, estimate
from jaxloc.alignment.ralph.match import Match, match_profile
from jaxloc.alignment.ralph.profile import (
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
from jaxloc.alignment.ralph.refine import Refined, TemplateResidual, refine
from jaxloc.alignment.ralph.search import Hypotheses, Straightest, find_straightest
from jaxloc.alignment.ralph.template import Adaptation, Blended, Fixed, Predictive, Template, blend, capture

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
    "Trust",
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
