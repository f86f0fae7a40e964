"""Two PERMON's model problem, with the sizes of its table."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.io import loadmat
from scipy.linalg import block_diag
from scipy.sparse import issparse

from mortarbench.harness import Solution, Status
from mortarbench.harness.files.matfile import save_mat
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.problems.families.feti_models import Membranes, hat_integrals
from mortarbench.problems.fem.laplacian import grid_stiffness
from mortarbench.solvers.reference.solve import reference_solution
from mortarbench.solvers.smalbe.solver import SMALBE

#: (1/H, H/h) → numbers of torn unknowns, multipliers, contact rows and subdomains
TABLE = {
    (1, 8): (162, 18, 9, 2), (2, 4): (200, 56, 9, 8), (2, 8): (648, 104, 17, 8),
    (2, 16): (2312, 200, 33, 8), (4, 4): (800, 256, 17, 32),
    (4, 8): (2592, 480, 33, 32), (8, 4): (3200, 1088, 33, 128),
}  # fmt: skip
#: number of products with F for the best settings of PERMON 3.25 at tolerance 1e-6
PERMON = {
    (1, 8): 59, (2, 4): 56, (2, 8): 57, (2, 16): 66, (4, 4): 89,
    (4, 8): 97, (4, 16): 106, (8, 4): 90, (8, 8): 103, (12, 4): 100,
}  # fmt: skip


def built(form, **params):
    return Membranes(**params).build(form, reference_solution)


def solution(case):
    qp = case.qp
    if not qp.is_explicit:
        qp = replace(qp, P=qp.P @ np.eye(qp.q.size), A=qp.A.toarray())
    return reference_solution(qp)


@pytest.mark.parametrize("size", TABLE, ids=str)
def test_sizes_are_those_of_the_table(size):
    S, n = size
    case = built("dual", S=S, n=n)
    values = case.quantities(Solution.without_point(case.qp, Status.FAILED))
    names = ("torn_dofs", "multipliers", "contact_rows", "subdomains")

    assert tuple(values[name] for name in names) == TABLE[size]
    assert (case.qp.lb == 0).sum() == values["contact_rows"]
    assert values["kinds"] == 1
    assert values["explicit_subdomains"] == values["subdomains"]


def test_the_stiffness_is_exact_for_functions_of_the_element_space():
    """For u = 1, x, y and xy on the unit square, ∫|∇u|² is 0, 1, 1 and 2/3."""
    n = 5
    x = np.tile(np.linspace(0, 1, n + 1), n + 1)
    y = np.repeat(np.linspace(0, 1, n + 1), n + 1)
    U = np.stack([x**0, x, y, x * y], axis=1)

    assert np.diag(U.T @ (grid_stiffness((n, n)) @ U)) == pytest.approx(
        [0, 1, 1, 2 / 3]
    )


@pytest.mark.parametrize("n", [3, 4, 8])
def test_the_load_integrates_polynomials_of_the_first_degree(n):
    """The edge of the loaded strip may lie inside a cell."""
    y = np.linspace(0, 1, n + 1)
    share = hat_integrals(n, 0.75, 1.0)

    assert share.sum() == pytest.approx(0.25)
    assert share @ y == pytest.approx((1 - 0.75**2) / 2)


@pytest.mark.parametrize("glue", ["orthonormal", "redundant"])
def test_the_forms_have_one_solution_in_every_gluing(glue):
    dual, primal = built("dual", S=2, n=4, glue=glue), built("primal", S=2, n=4)
    s, s_primal = solution(dual), solution(primal)
    torn, whole = dual.quantities(s), primal.quantities(s_primal)

    assert dual.recover(s) == pytest.approx(primal.recover(s_primal), abs=1e-12)
    assert {name: torn[name] for name in whole} == pytest.approx(whole, rel=1e-9)
    energy = dual.scale * dual.qp.objective(s.x) + dual.constant
    assert energy == pytest.approx(whole["energy"], rel=1e-10)


def test_contact_supports_the_right_membrane_on_part_of_the_edge():
    """The contact force equals the load, ¼, and only a part of the edge is in
    contact."""
    case = built("dual", S=2, n=8)
    s = solution(case)
    values = case.quantities(s)

    assert values["contact_force"] == pytest.approx(0.25, rel=1e-10)
    assert 0 < values["active"] < values["contact_rows"]
    primal = built("primal", S=2, n=8).qp
    assert kkt_residuals(primal, case.mechanics.to_primal(s)).worst < 1e-9


@pytest.mark.parametrize(("size", "best"), PERMON.items(), ids=str)
def test_products_stay_below_those_of_the_best_settings_of_permon(size, best):
    S, n = size
    case = built("dual", S=S, n=n)
    s = SMALBE().prepare(case.qp, 1e-6)()

    assert kkt_residuals(case.qp, s).worst <= 1e-5
    assert s.counts["P_products"] < best
    assert s.counts["preconditioner_applies"] < best


def test_energies_fall_to_a_limit_as_the_mesh_is_refined():
    solutions = [solution(built("primal", S=1, n=n)) for n in (4, 8, 16, 32)]
    energies = [built("primal", S=1, n=n).qp.objective(s.x)
             for n, s in zip((4, 8, 16, 32), solutions, strict=True)]  # fmt: skip

    steps = -np.diff(energies)
    assert (steps > 0).all()
    assert (steps[1:] < 0.5 * steps[:-1]).all()


def test_the_mat_file_contains_the_dual_in_the_notation_of_the_paper(tmp_path):
    case = built("dual", S=2, n=2)
    save_mat(tmp_path / "m.mat", case.qp, {}, case.matrices)
    M = {
        name: M.toarray() if issparse(M) else M
        for name, M in loadmat(tmp_path / "m.mat").items()
        if name != "meta"
    }
    K = block_diag(*[grid_stiffness((2, 2)).toarray()] * 8)
    expected = M["B"] @ np.linalg.pinv(K) @ M["B"].T
    G = M["R"].T @ M["B"].T
    P = np.eye(len(expected)) - np.linalg.pinv(G) @ G

    assert G == pytest.approx(M["A"], abs=1e-14)
    assert M["F"] == pytest.approx(M["P"])
    assert P @ M["F"] @ P == pytest.approx(P @ expected @ P, abs=1e-12)
    assert M["d"] == pytest.approx(-M["q"])
