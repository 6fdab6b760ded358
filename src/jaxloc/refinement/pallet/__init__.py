"""Pallet pose estimation from the vertical edges of its fork holes [K-14, K-74, K-75, K-76]."""

from jaxloc.refinement.pallet import edges, estimate, kinds, model
from jaxloc.refinement.pallet.edges import level_view
from jaxloc.refinement.pallet.estimate import FoundPallet, PalletSearch, detect_pallet, find_pallet
from jaxloc.refinement.pallet.kinds import correlate_types, face_template, stack_types, type_correlation
from jaxloc.refinement.pallet.model import (
    PalletEdges,
    PalletType,
    block_narrow,
    cross_ratio,
    edge_bearings,
    euro_long,
    euro_short,
    hole_ratio,
    pose_from_edges,
    printed_jacobian,
)

__all__ = [
    "FoundPallet",
    "PalletEdges",
    "PalletSearch",
    "PalletType",
    "block_narrow",
    "correlate_types",
    "cross_ratio",
    "detect_pallet",
    "edge_bearings",
    "edges",
    "estimate",
    "euro_long",
    "euro_short",
    "face_template",
    "find_pallet",
    "hole_ratio",
    "kinds",
    "level_view",
    "model",
    "pose_from_edges",
    "printed_jacobian",
    "stack_types",
    "type_correlation",
]
