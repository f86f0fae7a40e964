"""The contract between problems, solvers and reports, and the clock."""

from harness.errors import InputError
from harness.limits import memory_limit_mib, too_large
from harness.mechanics import Grid, Mechanics
from harness.plugin import (
    About,
    Case,
    Chained,
    Family,
    Fields,
    Reference,
    Solver,
    Value,
)
from harness.qp import QP, Matrix, Structure, Vector, no_rows
from harness.record import Record, Verdict
from harness.solution import Solution, Status
from harness.verify.certificate import Certificate, UncertifiableError, certify
from harness.verify.kkt import Residuals, kkt_residuals, verdict

__all__ = [
    "QP",
    "About",
    "Case",
    "Certificate",
    "Chained",
    "Family",
    "Fields",
    "Grid",
    "InputError",
    "Matrix",
    "Mechanics",
    "Record",
    "Reference",
    "Residuals",
    "Solution",
    "Solver",
    "Status",
    "Structure",
    "UncertifiableError",
    "Value",
    "Vector",
    "Verdict",
    "certify",
    "kkt_residuals",
    "memory_limit_mib",
    "no_rows",
    "too_large",
    "verdict",
]
