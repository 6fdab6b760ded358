"""Nonlinear least squares on manifolds, robust kernels, RANSAC, assignment and point alignment."""

from jaxloc.solvers import (
    assignment,
    cholesky,
    estimate,
    gauss_newton,
    graduated_nonconvexity,
    least_squares,
    point_alignment,
    problem,
    qr,
    robust_kernels,
)
from jaxloc.solvers.assignment import Assignment, assign
from jaxloc.solvers.cholesky import Cholesky
from jaxloc.solvers.estimate import Estimate, Observability, Status
from jaxloc.solvers.gauss_newton import Dogleg, GaussNewton, LevenbergMarquardt, Solver
from jaxloc.solvers.graduated_nonconvexity import solve_graduated
from jaxloc.solvers.least_squares import solve
from jaxloc.solvers.point_alignment import PointAlignment, Similarity, align_points, align_scaled_points
from jaxloc.solvers.problem import FunctionProblem, Linearization, Problem
from jaxloc.solvers.qr import QR
from jaxloc.solvers.ransac import Candidates, Consensus, RobustEstimate, ransac, required_hypotheses
from jaxloc.solvers.robust_kernels import Barron, Cauchy, GemanMcClure, Huber, Loss, Quadratic, Tukey

__all__ = [
    "Assignment",
    "Barron",
    "Candidates",
    "Cauchy",
    "Cholesky",
    "Consensus",
    "Dogleg",
    "Estimate",
    "FunctionProblem",
    "GaussNewton",
    "GemanMcClure",
    "Huber",
    "LevenbergMarquardt",
    "Linearization",
    "Loss",
    "Observability",
    "PointAlignment",
    "Problem",
    "QR",
    "Quadratic",
    "RobustEstimate",
    "Similarity",
    "Solver",
    "Status",
    "Tukey",
    "align_points",
    "align_scaled_points",
    "assign",
    "assignment",
    "cholesky",
    "estimate",
    "gauss_newton",
    "graduated_nonconvexity",
    "least_squares",
    "point_alignment",
    "problem",
    "qr",
    "ransac",
    "required_hypotheses",
    "robust_kernels",
    "solve",
    "solve_graduated",
]
