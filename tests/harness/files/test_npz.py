"""Mapped arrays, and operators that are stored as arrays."""

import numpy as np
import pytest
from scipy.sparse import csr_array

from mortarbench.harness import QP, InputError, Status, no_rows
from mortarbench.harness.files.mapped import ALIGNMENT, read_mapped, write_mapped
from mortarbench.harness.files.qpfile import load_qp, save_qp
from mortarbench.harness.operators import SerialisableOperator
from mortarbench.harness.verify.measure import measure

ARRAYS = {
    "vector": np.arange(5.0),
    "empty": np.zeros((0, 3)),
    "scalar": np.array(3.5),
    "text": np.array("λ ≥ 0"),
    "matrix": np.arange(12).reshape(3, 4).T,
    "a name that is λonger": np.ones(7, dtype=np.int32),
}


def test_mapping_yields_equal_arrays_of_which_changes_are_private(tmp_path):
    file = tmp_path / "a.qp"
    write_mapped(file, ARRAYS)
    before = file.read_bytes()
    views = read_mapped(file)

    assert list(views) == list(ARRAYS)
    for name, array in ARRAYS.items():
        np.testing.assert_array_equal(views[name], array)
        assert (views[name].dtype, views[name].shape) == (array.dtype, array.shape)
        assert views[name].ctypes.data % ALIGNMENT == 0 or not array.size
    views["vector"][:] = 99.0
    assert file.read_bytes() == before
    np.testing.assert_array_equal(read_mapped(file)["vector"], ARRAYS["vector"])


BUILT = []


def diagonal(arrays):
    """Return a function that multiplies by the diagonal matrix of the array d."""
    BUILT.append(1)
    d = arrays["d"]
    return lambda x: d[:, None] * x if x.ndim == 2 else d * x


MAKERS = {"diagonal": diagonal}


def operator_of(d):
    """Return a QP whose P is the operator diag(d)."""
    n = d.size
    P = SerialisableOperator(n, "diagonal", {"d": d}, MAKERS)
    return QP(
        P=P, q=-d, A=no_rows(n), b=np.zeros(0), G=no_rows(n),
        h=np.zeros(0), lb=np.full(n, -np.inf), ub=np.full(n, np.inf),
    )  # fmt: skip


@pytest.fixture
def operator_qp():
    """Return a QP with the operator diag(1, 2); BUILT records each build."""
    BUILT.clear()
    return operator_of(np.array([1.0, 2.0]))


def test_an_operator_travels_as_arrays_and_is_the_same_operator(operator_qp, tmp_path):
    save_qp(tmp_path / "qp.npz", operator_qp, {}, serialised=True)
    assert BUILT == []  # the operator is not assembled for writing
    qp, _ = load_qp(tmp_path / "qp.npz", operators=MAKERS)
    assert BUILT == []  # the operator is not built for reading

    np.testing.assert_array_equal(qp.P @ np.eye(2), np.diag([1.0, 2.0]))
    assert not qp.is_explicit


def test_an_exported_operator_is_written_as_a_matrix(operator_qp, tmp_path):
    save_qp(tmp_path / "qp.npz", operator_qp, {})
    qp, _ = load_qp(tmp_path / "qp.npz")

    np.testing.assert_array_equal(csr_array(qp.P).toarray(), np.diag([1.0, 2.0]))


def test_an_operator_is_built_anew_before_every_preparation(operator_qp):
    built_before_prepare = []

    class Looks:
        def declines(self, qp):
            return None

        def prepare(self, qp, tol):
            built_before_prepare.append(len(BUILT))
            return lambda: None

    for _ in range(2):
        s = measure(Looks(), operator_qp, 1e-6, once=True).solution
        assert s.status is Status.FAILED

    assert built_before_prepare == [1, 2]


def test_an_operator_too_large_for_a_matrix_is_written_only_as_arrays(
    tmp_path, monkeypatch
):
    monkeypatch.setenv("MORTARBENCH_MOST_MIB", "1")
    qp = operator_of(np.ones(400))  # 1.2 MiB

    save_qp(tmp_path / "qp.npz", qp, serialised=True)
    with pytest.raises(InputError, match="the operator P as a dense matrix of 400"):
        save_qp(tmp_path / "qp.npz", qp)
