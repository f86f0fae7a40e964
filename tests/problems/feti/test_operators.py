"""F = B K⁺Bᵀ by kinds and its preconditioners, against their dense definitions."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import block_diag
from scipy.sparse import csr_array

from harness.files.qpfile import load_qp, save_qp
from harness.operators import Preconditioned, SerialisableOperator
from problems import OPERATORS
from problems.feti.gluing import glue
from problems.feti.local import kernel, subdomains
from problems.feti.operators import DualOperator, dual_operator
from problems.feti.tearing import blocks, decompose
from problems.feti.torn import Kind, Torn
from problems.fem.mesh import rectangle
from tests.support.qps import random_qp  # placeholder
