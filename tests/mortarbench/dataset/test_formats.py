"""One problem through every format: independent readers find the same objective."""

import clarabel
import highspy
import numpy as np
import pytest
import qoco
from scipy.io import loadmat
from scipy.sparse import csc_array, csc_matrix, tril, triu

import mortarbench as mb
from tests.support.cbf import read_cbf


def qp_with(sets=(), ub=None):
    """Return a positive definite QP with rows of each kind, and bounds."""
    P = np.diag([4.0, 3.0, 2.0, 5.0]) + np.diag([-1.0, 0.5, 0.25], 1)
    return mb.QP.from_arrays(
        csc_array(P + np.triu(P, 1).T), [-1.0, 1 / 3, -0.5, 2.0],
        G=[[1.0, 1.0, 0.0, 0.0]], h=[0.2], A=[[0.0, 1.0, -1.0, 0.0]], b=[-0.1],
        ub=ub, sets=sets,
    )  # fmt: skip


BOX = qp_with(ub=[0.15, np.inf, np.inf, np.inf])
DISC = qp_with(sets=[mb.Discs([[0, 3]], [0.25])])


def optimum(qp):
    answer = mb.solve(qp, "clarabel", 1e-11)
    assert answer.verdict == "verified"
    return answer.record.objective, answer.solution.x


@pytest.mark.parametrize("qp", [BOX, DISC], ids=["box", "disc"])
def test_clarabel_solves_its_file_to_the_same_objective(qp, tmp_path):
    path = mb.export(qp, tmp_path / "one.json")
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-12
    solved = clarabel.load_from_file(str(path), settings).solve()
    assert solved.obj_val == pytest.approx(optimum(qp)[0], abs=1e-10)


def setup_of_bin(path):
    """Return the arguments of QOCO's `setup` from a file, by its documented layout."""
    data, at = path.read_bytes(), 0

    def read(kind, count):
        nonlocal at
        at += count * np.dtype(kind).itemsize
        return np.frombuffer(data, kind, count, at - count * np.dtype(kind).itemsize)

    n, m, p, linear, cones, *entries = read("<i4", 8)
    c, b, h, q = read("<f8", n), read("<f8", p), read("<f8", m), read("<i4", cones)
    matrices = []
    for rows, count in zip((n, p, m), entries, strict=True):
        values, place = read("<f8", count), read("<i4", count)
        columns = (values, place, read("<i4", n + 1))
        matrices.append(csc_matrix(columns, shape=(rows, n)) if rows else None)
    assert at == len(data)
    P, A, G = matrices
    return n, m, p, P + triu(P, 1).T, c, A, b, G, h, linear, cones, q


@pytest.mark.parametrize("qp", [BOX, DISC], ids=["box", "disc"])
def test_qoco_solves_its_file_and_dumps_the_same_bytes(qp, tmp_path):
    path, solver = mb.export(qp, tmp_path / "one.bin"), qoco.QOCO()
    again = tmp_path / "again.bin"
    tight = dict.fromkeys(["abstol", "reltol"], 1e-12)
    solver.setup(*setup_of_bin(path), **tight, verbose=0, dump_problem=str(again))
    assert again.read_bytes() == path.read_bytes()
    assert solver.solve().obj == pytest.approx(optimum(qp)[0], abs=1e-10)


def test_highs_reads_qps_with_the_same_objective(tmp_path):
    value, x = optimum(BOX)
    highs = highspy.Highs()
    highs.setOptionValue("output_flag", False)
    path = mb.export(BOX, tmp_path / "one.qps").rename(tmp_path / "one.mps")
    assert highs.readModel(str(path)) == highspy.HighsStatus.kOk
    model = highs.getModel()
    h = model.hessian_
    lower = csc_array((h.value_, h.index_, h.start_), shape=(4, 4))
    P = lower + tril(lower, -1).T
    assert 0.5 * x @ P @ x + model.lp_.col_cost_ @ x == pytest.approx(value, abs=1e-10)
    highs.run()
    assert highs.getInfo().objective_function_value == pytest.approx(value, abs=1e-6)


def test_scipy_and_numpy_read_the_same_objective(tmp_path):
    value, x = optimum(BOX)
    mat = loadmat(mb.export(BOX, tmp_path / "one.mat"))
    assert 0.5 * x @ (mat["P"] @ x) + mat["q"].ravel() @ x == pytest.approx(
        value, abs=1e-10
    )
    with np.load(mb.export(BOX, tmp_path / "one.npz")) as npz:
        P = csc_array(
            (npz["P_data"], npz["P_indices"], npz["P_indptr"]), shape=npz["P_shape"]
        )
        assert 0.5 * x @ (P @ x) + npz["q"] @ x == pytest.approx(value, abs=1e-10)


@pytest.mark.parametrize("qp", [BOX, DISC], ids=["box", "disc"])
def test_a_reader_of_cbf_finds_the_same_objective_and_feasible_point(qp, tmp_path):
    """The reader follows the format alone; t is the quadratic term at the optimum."""
    value, x = optimum(qp)
    problem = read_cbf(mb.export(qp, tmp_path / "one.cbf"))
    t = 0.5 * x @ (qp.P @ x)
    point = np.append(x, t)
    assert problem.cost @ point == pytest.approx(value, abs=1e-10)
    assert problem.violation(point) < 1e-8
    assert problem.violation(np.append(x, t - 1e-3)) > 1e-4
    outside = problem.violation(np.append(3 * x, 9 * t))
    assert outside > 1e-2


def test_clarabel_solves_the_cone_problem_of_cbf_to_the_same_objective(tmp_path):
    problem = read_cbf(mb.export(DISC, tmp_path / "one.cbf"))
    P, q, A, b, cones = problem.for_clarabel()
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-12
    solved = clarabel.DefaultSolver(P, q, A, b, cones, settings).solve()
    assert solved.obj_val == pytest.approx(optimum(DISC)[0], abs=1e-10)


def test_a_singular_problem_is_refused_for_cbf_in_one_line(tmp_path):
    qp = mb.QP.from_arrays([[1.0, -1.0], [-1.0, 1.0]], [0.0, 0.0], lb=[0.0, 0.0])
    with pytest.raises(mb.InputError, match="P is singular; expected a positive"):
        mb.export(qp, tmp_path / "one.cbf")
    assert not (tmp_path / "one.cbf").exists()
