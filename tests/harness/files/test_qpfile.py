import json
import pickle
import zipfile

import numpy as np
import pytest
import qpsolvers
from scipy.sparse import csc_array, csr_array
from scipy.sparse.linalg import aslinearoperator

from mortarbench.harness import QP, InputError, no_rows
from mortarbench.harness.files.qpfile import load_qp, save_qp
from tests.support.damaged_files import Touch, object_array
from tests.support.refusals import refused

P = np.array([[2.0, 1.0, 0.0], [1.0, 3.0, 0.0], [0.0, 0.0, 0.0]])


def make_qp(P, A=None):
    return QP(
        P=P, q=np.array([1.0, -2.0, 0.5]),
        A=no_rows(3) if A is None else A, b=np.zeros(0 if A is None else A.shape[0]),
        G=csr_array([[0.0, 1.0, -1.0]]), h=np.array([4.0]),
        lb=np.array([-np.inf, 0.0, -1.0]), ub=np.array([np.inf, np.inf, 1.0]),
    )  # fmt: skip


@pytest.fixture
def saved(tmp_path):
    """Write a valid file; return it with a function that damages one of its arrays."""
    path = tmp_path / "qp.npz"
    save_qp(path, make_qp(csr_array(P)), {"name": "three"})

    def spoil(**changes):
        with np.load(path) as stored:
            arrays = {k: stored[k] for k in stored.files} | changes
        np.savez(path, **{k: v for k, v in arrays.items() if v is not None})
        return path

    return spoil


@pytest.mark.parametrize("kind", [csr_array, csc_array, np.asarray, aslinearoperator])
def test_a_qp_survives_the_round_trip_in_every_storage(tmp_path, kind):
    qp = make_qp(kind(P))
    save_qp(tmp_path / "qp.npz", qp, {"name": "three"})
    loaded, meta = load_qp(tmp_path / "qp.npz")

    assert meta["name"] == "three"
    np.testing.assert_array_equal(loaded.P @ np.eye(3), P)
    np.testing.assert_array_equal(loaded.G.toarray(), qp.G.toarray())
    assert loaded.A.shape == (0, 3)
    for name in ("q", "b", "h", "lb", "ub"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(qp, name))


@pytest.mark.parametrize(
    ("kind", "dense"),
    [(csr_array, False), (np.asarray, True), (aslinearoperator, True)],
)
def test_dense_matrices_come_back_dense_and_sparse_ones_as_csc(tmp_path, kind, dense):
    save_qp(tmp_path / "qp.npz", make_qp(kind(P), A=np.ones((2, 3))), {})
    loaded, meta = load_qp(tmp_path / "qp.npz")

    assert meta["dense"] == (["P", "A"] if dense else ["A"])
    assert isinstance(loaded.P, np.ndarray if dense else csc_array)
    assert isinstance(loaded.A, np.ndarray)
    assert isinstance(loaded.G, csc_array)


def test_the_file_has_the_promised_format(saved):
    with np.load(saved(), allow_pickle=False) as stored:
        parts = {f"{M}_{part}" for M in "PGA" for part in
                 ("data", "indices", "indptr", "shape")}  # fmt: skip

        assert set(stored.files) == {"q", "h", "b", "lb", "ub", "meta"} | parts
        assert json.loads(str(stored["meta"]))["name"] == "three"
        # columns (2, 1), (1, 3) and an empty one; both triangles
        assert stored["P_data"].tolist() == [2, 1, 1, 3]
        assert stored["P_indices"].tolist() == [0, 1, 0, 1]
        assert stored["P_indptr"].tolist() == [0, 2, 4, 4]
        assert stored["P_shape"].tolist() == [3, 3]


def test_a_file_name_is_taken_as_it_is(tmp_path):
    save_qp(tmp_path / "qp.data", make_qp(csr_array(P)), {})

    assert [f.name for f in tmp_path.iterdir()] == ["qp.data"]


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"h": None, "G_indptr": None}, "'G_indptr' is missing"),
        ({"meta": np.array("[1]")}, "meta is not a JSON object"),
        ({"meta": np.array("{")}, "Expecting property name"),
        ({"P_indices": np.array([0, 1, 0, 7])}, "P is not a matrix in CSC parts"),
        ({"P_indices": np.array([0.0, 1, 0, 1])}, "must contain integers"),
        ({"P_indptr": np.array([0, 2])}, "P is not a matrix in CSC parts"),
        ({"P_shape": np.array([3])}, "P is not a matrix in CSC parts"),
    ],
)
def test_a_malformed_file_is_named_with_the_error(saved, changes, complaint):
    path = saved(**changes)

    with pytest.raises(InputError, match=complaint) as caught:
        load_qp(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_other_files_are_refused(tmp_path):
    text, single = (tmp_path / name for name in ("text", "one"))
    text.write_text("P = 1\n")
    with single.open("wb") as file:
        np.save(file, np.zeros(3))

    for path in (text, single):
        with pytest.raises(InputError, match="not an npz file of plain arrays"):
            load_qp(path)
    with pytest.raises(InputError, match="nowhere: No such file"):
        load_qp(tmp_path / "nowhere")


# files saved by NumPy


def plain(**changes):
    """Return arrays with constraints of every type."""
    arrays = {
        "P": np.diag([2.0, 3.0]), "q": np.ones(2), "G": np.ones((1, 2)), "h": [4.0],
        "A": np.array([[1, -1]]), "b": [0], "lb": [-np.inf, 0], "ub": [1.0, np.inf],
    }  # fmt: skip
    return {k: v for k, v in (arrays | changes).items() if v is not None}


@pytest.mark.parametrize("protocol", [3, 4])
def test_a_file_of_qpsolvers_may_contain_none(tmp_path, protocol):
    """Absent parts are pickled, in protocol 3 before NumPy 2."""
    qpsolvers.Problem(np.diag([2.0, 3.0]), np.ones(2), lb=np.zeros(2)).save(
        tmp_path / "a.npz"
    )
    with zipfile.ZipFile(tmp_path / "a.npz") as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    begin = members["G.npy"].index(b"\n") + 1
    assert pickle.loads(members["G.npy"][begin:]).item() is None
    none = members["G.npy"][:begin] + pickle.dumps(np.array(None), protocol)
    with zipfile.ZipFile(tmp_path / "b.npz", "w") as archive:
        for name, data in {**members, "G.npy": none}.items():
            archive.writestr(name, data)
    qp, _ = load_qp(tmp_path / "b.npz")

    assert (qp.P.tolist(), qp.q.tolist()) == ([[2, 0], [0, 3]], [1, 1])
    assert (qp.lb.tolist(), qp.ub.tolist()) == ([0, 0], [np.inf] * 2)
    assert qp.G.shape == qp.A.shape == (0, 2)


@pytest.mark.parametrize("value", [[1.0], [None], False])
def test_no_other_object_counts_as_none_and_none_is_unpickled(tmp_path, value):
    sentinel = tmp_path / "SENTINEL"
    for held in (value, Touch(sentinel)):
        np.savez(tmp_path / "a.npz", **plain(G=object_array(held)))
        with pytest.raises(InputError, match="G is a pickled Python object"):
            load_qp(tmp_path / "a.npz")
    assert not sentinel.exists()


def test_plain_arrays_are_a_qp(tmp_path):
    np.savez(tmp_path / "a.npz", **plain())
    qp, meta = load_qp(tmp_path / "a.npz")

    assert meta == {}
    for name, array in plain().items():
        assert isinstance(getattr(qp, name), np.ndarray)
        np.testing.assert_array_equal(getattr(qp, name), array)


def test_arrays_of_the_objective_alone_define_a_qp(tmp_path):
    np.savez_compressed(tmp_path / "a.npz", P=np.eye(3), q=np.zeros((3, 1)))
    qp, _ = load_qp(tmp_path / "a.npz")

    assert qp.sizes == {"variables": 3, "equalities": 0, "inequalities": 0, "bounds": 0}


def test_a_sparse_matrix_may_be_passed_as_its_arrays(tmp_path):
    M = csr_array(np.array([[2.0, 1.0], [1.0, 2.0]])).tocsc()
    parts = {f"P_{part}": getattr(M, part) for part in ("data", "indices", "indptr")}
    np.savez(tmp_path / "a.npz", **plain(P=None, P_shape=M.shape, **parts))
    qp, _ = load_qp(tmp_path / "a.npz")

    np.testing.assert_array_equal(qp.P.toarray(), M.toarray())
    assert isinstance(qp.G, np.ndarray)


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"h": None}, "h is missing, but G is present"),
        ({"Aeq": np.eye(2)}, "unknown array 'Aeq'; known: A, G, P, b, h, lb, q, ub"),
        (
            {"P": None, "P_data": np.ones(1)},
            "'P_indices' is missing",
        ),
        ({"P": np.ones(4)}, "P has shape (4,); expected two dimensions"),
        ({"h": np.array(["4"])}, "h is of type <U1; expected numbers"),
    ],
)
def test_plain_arrays_that_do_not_define_a_qp_are_refused(tmp_path, changes, complaint):
    np.savez(tmp_path / "a.npz", **plain(**changes))

    with refused(start=f"{tmp_path}/a.npz: {complaint}"):
        load_qp(tmp_path / "a.npz")


def test_a_file_that_cannot_be_written_is_named(tmp_path):
    with pytest.raises(InputError, match="cannot be written"):
        save_qp(tmp_path / "no" / "folder.npz", make_qp(csr_array(P)), {})
