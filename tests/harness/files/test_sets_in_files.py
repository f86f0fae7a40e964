"""Discs and cones in files: round trips, and refusal of incomplete sets."""

import numpy as np
import pandas as pd
import pytest
from scipy.io import loadmat, savemat

import mortarbench as mb
from mortarbench.harness.files.qpfile import qp_digest

N = 8
SETS = {
    "discs": (mb.Discs([[1, 4], [6, 2]], [2.0, 0.5]),),
    "one disc": (mb.Discs([[3, 2, 1]], [1.0]),),
    "discs and cones": (
        mb.Discs([[2, 3], [5, 4]], [1e-300, 0]), mb.Cones([[0, 1]], [0.3]),
    ),
    "two kinds of discs": (
        mb.Discs([[5, 1, 2]], [1 / 3]), mb.Discs([[3, 4]], [0.5]),
        mb.Cones([[0, 7]], [1e300]),
    ),
    "three kinds of cones": (
        mb.Cones([[0, 1, 2]], [1.0]), mb.Cones([[5, 3]], [0.5]),
        mb.Cones([[7, 6]], [0.0]),
    ),
}  # fmt: skip


def qp_over(*sets):
    rng = np.random.default_rng(1)
    M = rng.standard_normal((N, N))
    return mb.QP.from_arrays(M @ M.T, M[0], G=M[:2], h=[1, 1], sets=sets)


def arrays_of(qp):
    return [
        (type(one), name, array.dtype, array.tolist())
        for one in qp.sets[1:]
        for name, array in one.arrays().items()
    ]


@pytest.mark.parametrize(
    ("suffix", "name"),
    [
        pytest.param(
            s, n, marks=[pytest.mark.slow] * (s == "parquet" and n != "discs and cones")
        )
        for s in ("npz", "mat", "parquet")
        for n in SETS
    ],
)
def test_a_qp_over_sets_is_the_same_after_writing(tmp_path, suffix, name):
    qp = qp_over(*SETS[name])
    path = mb.export(qp, tmp_path / f"qp.{suffix}")
    back = mb.build(f"file:{path}").qp

    assert arrays_of(back) == arrays_of(qp)
    assert qp_digest(back) == qp_digest(qp)
    assert back.sizes == qp.sizes


def test_digests_distinguish_sets():
    """A different radius, index, class or order within a block defines a different
    problem; the order of the sets does not.
    """
    discs, cones = mb.Discs([[1, 4], [6, 2]], [2.0, 0.5]), mb.Cones([[0, 5]], [0.5])
    one = qp_digest(qp_over(discs, cones))
    assert qp_digest(qp_over(cones, discs)) == one
    others = [
        qp_over(discs), qp_over(cones), qp_over(),
        qp_over(mb.Discs(discs.index, [2.0, np.nextafter(0.5, 1)]), cones),
        qp_over(mb.Discs([[1, 4], [6, 3]], discs.radius), cones),
        qp_over(discs, mb.Cones([[5, 0]], [0.5])),
        qp_over(mb.Discs([[0, 5]], [0.5]), mb.Cones(discs.index, discs.radius)),
    ]  # fmt: skip
    assert len({one, *map(qp_digest, others)}) == 1 + len(others)


def test_arrays_saved_by_numpy_alone_are_read(tmp_path):
    qp = qp_over(*SETS["discs"])
    path = tmp_path / "plain.npz"
    arrays = {name: getattr(qp, name) for name in ("P", "q", "G", "h")}
    np.savez(path, **arrays, disc_index=[[1, 4], [6, 2]], disc_radius=[2, 0.5])
    assert arrays_of(mb.build(f"file:{path}").qp) == arrays_of(qp)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("disc_radius", None, "disc_radius is missing, but disc_index is present"),
        ("disc2_index", None, "disc2_index is missing, but disc2_radius is present"),
        ("disc4_index", [5], "disc4_index belongs to no set; expected disc_index"),
        ("disc_radius", [1.0, 2.0], r"Discs: radius has shape \(2,\); expected \(1,\)"),
        ("cone_index", [[3, 7]], "variable 3 is in two sets"),
    ],
)
def test_files_with_broken_sets_are_refused_in_one_line(tmp_path, name, value, message):
    path = mb.export(qp_over(*SETS["two kinds of discs"]), tmp_path / "qp.npz")
    arrays = dict(np.load(path)) | {name: value}
    np.savez(path, **{k: np.array(v) for k, v in arrays.items() if v is not None})
    with pytest.raises(mb.InputError, match=message) as e:
        mb.build(f"file:{path}")
    assert "\n" not in str(e.value)
    assert str(path) in str(e.value)


def test_mat_and_parquet_with_broken_sets_are_refused(tmp_path):
    qp = qp_over(*SETS["two kinds of discs"])
    path = mb.export(qp, tmp_path / "qp.mat")
    arrays = {k: v for k, v in loadmat(path).items() if k[0] != "_"}
    savemat(path, arrays | {"disc_index": "text"})
    with pytest.raises(
        mb.InputError, match=r"qp\.mat: Discs: index is of type <U4; expected an"
    ):
        mb.build(f"file:{path}")
    path = mb.export(qp, tmp_path / "qp.parquet")
    frame = pd.read_parquet(path)
    for name, value, message in (
        (
            "disc_index",
            None,
            "qp.parquet: disc_index is missing, but disc_radius is present",
        ),
        ("cone_slope", ["steep"], "qp.parquet: cone_slope is not a list of numbers"),
    ):
        frame.assign(**{name: [value]}).to_parquet(path)
        with pytest.raises(mb.InputError, match=message):
            mb.build(f"file:{path}")


def test_qps_files_cannot_store_sets(tmp_path):
    with pytest.raises(mb.InputError, match="QPS cannot store Discs; expect"):
        mb.export(qp_over(*SETS["discs"]), tmp_path / "qp.qps")
    assert not [*tmp_path.iterdir()]
