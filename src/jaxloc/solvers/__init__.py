"""How a residual is minimized, and how sure the answer is."""

from jaxloc.solvers import (
    assignment,
    closed_form,
    estimate,
    gauss_newton,
    graduated,
    least_squares,
    linear,
    problem,
    robust,
)
from jaxloc.solvers.assignment import Assignment, assign
from jaxloc.solvers.closed_form import PointAlignment, Similarity, align_points, align_scaled_points
from jaxloc.solvers.estimate import Estimate, Observability, Status
from jaxloc.solvers.gauss_newton import Dogleg, GaussNewton, LevenbergMarquardt, Solver
from jaxloc.solvers.graduated import solve_graduated
from jaxloc.solvers.least_squares import solve
from jaxloc.solvers.linear import Cholesky
from jaxloc.solvers.problem import FunctionProblem, Linearization, Problem
from jaxloc.solvers.ransac import Candidates, Consensus, ransac, required_hypotheses
from jaxloc.solvers.robust import Barron, Cauchy, GemanMcClure, Huber, Loss, Quadratic, Tukey

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
    "Quadratic",
    "Similarity",
    "Solver",
    "Status",
    "Tukey",
    "align_points",
    "align_scaled_points",
    "assign",
    "assignment",
    "closed_form",
    "estimate",
    "gauss_newton",
    "graduated",
    "least_squares",
    "linear",
    "problem",
    "ransac",
    "required_hypotheses",
    "robust",
    "solve",
    "solve_graduated",
]
