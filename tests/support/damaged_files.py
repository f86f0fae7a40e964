"""Randomly damaged data files, which must be read or refused with an error message."""

import io
import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
from scipy.io import savemat
from scipy.sparse import csc_array, random_array

from mortarbench.harness import QP, Cones, Discs, InputError
from mortarbench.harness.files.matfile import save_mat
from mortarbench.harness.files.parquetfile import save_parquet
from mortarbench.harness.files.qpfile import save_qp
from mortarbench.problems import PROBLEMS
from mortarbench.problems.files.fclib import read_fclib
from tests.support.bounded import bounded
from tests.support.box_stack import local_arrays, write_boxes, write_datasets

EXTREMES = (
    0, 1, -1, 2**15, 2**31 - 1, -(2**31), 2**32 - 1, 2**40, 2**63 - 1, -(2**63),
    2**64 - 1, 10**9,
)  # fmt: skip
SENTINEL = "SENTINEL"  #: name of a file that a pickle would create
WORDS = (
    b"nan", b"inf", b"-inf", b"1e400", b"1_0", b"-1", b"0", b"99999999999999999999",
    b"\x00", b"\xff", b"\n", b" ", b"(", b"[" * 300, b"'", b"$End", b"-0.0", b"1e308",
)  # fmt: skip

QPS = b"""NAME          TINY
ROWS
 N  COST
 L  UPPER
 G  LOWER
 E  EQUAL
COLUMNS
    X1        COST      1.0   UPPER     1.0
    X1        EQUAL     2.0
    X2        COST     -1.0   LOWER     1.5
    X2        EQUAL     1.0
RHS
    RHS       COST     -3.0   UPPER     4.0
    RHS       LOWER     0.5   EQUAL     2.0
RANGES
    RNG       UPPER     2.5
BOUNDS
 UP BND       X1        4.0
 MI BND       X2
QUADOBJ
    X1        X1        2.0
    X1        X2       -0.5
    X2        X2        2.0
ENDATA
"""


class Touch:
    """Object that creates a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def object_array(value):
    """Return an array without dimensions that contains a Python object."""
    array = np.empty((), dtype=object)
    array[()] = value
    return array


def tiny_qp(dense=False):
    """Return a QP with equality rows, inequality rows and bounds."""
    rng = np.random.default_rng(7)
    P = random_array((6, 6), density=0.4, rng=rng)
    P = csc_array(P @ P.T + 2 * np.eye(6))
    return QP(
        P=P.toarray() if dense else P, q=rng.normal(size=6), A=csc_array(np.eye(6)[:1]),
        b=np.ones(1), G=csc_array(np.eye(6)[2:4]), h=np.ones(2),
        lb=np.array([-np.inf, -1.0] * 3), ub=np.array([np.inf, 2.0] * 3),
    )  # fmt: skip


def seeds(folder):
    """Return the contents of intact files, as a list for each file suffix."""
    qp, meta = tiny_qp(), {"name": "tiny", "scale": 2.0, "constant": 1.0}
    found = {kind: [] for kind in ("npz", "mat", "parquet", "qps")}

    def written(kind, write):
        path = folder / f"seed.{kind}"
        write(path)
        found[kind].append(path.read_bytes())

    over_sets = replace(
        tiny_qp(), lb=np.full(6, -np.inf), ub=np.full(6, np.inf),
        sets=(Discs([[0, 2], [4, 1]], [1.0, 0.0]), Cones([[3, 5]], [0.5])),
    )  # fmt: skip
    for each in (qp, tiny_qp(dense=True), over_sets):
        written("npz", lambda path, each=each: save_qp(path, each, meta))
        written("mat", lambda path, each=each: save_mat(path, each, meta, {}))
        written("parquet", lambda path, each=each: save_parquet(path, each, meta))
    with np.load(io.BytesIO(found["npz"][0])) as arrays:
        for save in (np.savez, np.savez_compressed):
            written("npz", lambda path, s=save, a=dict(arrays): s(path, **a))
    maros = {
        "P": qp.P, "q": qp.q, "A": csc_array(np.eye(6)), "l": -np.ones(6),
        "u": np.ones(6), "r": 3.0, "n": 6, "m": 6,
    }  # fmt: skip
    for form in ("4", "5"):
        written("mat", lambda path, f=form: savemat(path, maros, format=f))
    for compression in ("none", "gzip"):
        written("parquet", lambda path, c=compression: repacked(path, c))
    none = {"G": np.array(None), "h": np.array(None)}
    hostile = {"G": object_array(Touch(folder / SENTINEL))}
    for more in (none, hostile):
        plain = {"P": np.eye(2), "q": np.ones(2), **more}
        written("npz", lambda path, a=plain: np.savez(path, **a))
    found |= {"qps": [QPS], "hdf5": []}
    written("hdf5", lambda path: write_boxes(path, 1))
    one = local_arrays(np.eye(3), np.ones(3), np.ones(1))
    written("hdf5", lambda path: write_datasets(path, one))
    return found


def repacked(path, compression):
    """Rewrite a Parquet file with another compression."""
    pq.write_table(pq.ParquetFile(path).read(), path, compression=compression)


def flipped(rng, data, at, others):
    """Flip a bit."""
    return data[:at] + bytes([data[at] ^ (1 << rng.integers(0, 8))]) + data[at + 1 :]


def truncated(rng, data, at, others):
    """Cut off the end."""
    return data[:at]


def spliced(rng, data, at, others):
    """Overwrite bytes with a piece of another file."""
    other = others[rng.integers(0, len(others))]
    start = int(rng.integers(0, len(other)))
    return over(data, at, other[start : start + int(rng.integers(1, 200))])


def numbered(rng, data, at, others):
    """Overwrite bytes with an extreme integer, in a format of file headers."""
    value = EXTREMES[rng.integers(0, len(EXTREMES))] % 2**64
    return over(data, at, struct.pack("<Q", value)[: (2, 4, 8)[rng.integers(0, 3)]])


def worded(rng, data, at, others):
    """Insert an unusual word, or overwrite bytes with it."""
    word = WORDS[rng.integers(0, len(WORDS))]
    return over(data, at, word) if rng.random() < 0.5 else data[:at] + word + data[at:]


def refielded(rng, data, at, others):
    """Replace a field of a text file."""
    fields = data.split(b" ")
    fields[rng.integers(0, len(fields))] = WORDS[rng.integers(0, len(WORDS))]
    return b" ".join(fields)


def doubled(rng, data, at, others):
    """Repeat up to forty bytes."""
    return data[:at] + data[max(at - 40, 0) :]


def shortened(rng, data, at, others):
    """Delete some bytes."""
    return data[:at] + data[at + int(rng.integers(1, 40)) :]


def over(data, at, piece):
    """Overwrite the bytes at a position with `piece`."""
    return data[:at] + piece + data[at + len(piece) :]


DAMAGES = (
    flipped, truncated, spliced, numbered, worded, refielded, doubled, shortened
)  # fmt: skip


def damaged(rng, data, others):
    """Return `data` with damage at one to three positions."""
    for _ in range(rng.integers(1, 4)):
        if data:
            damage = DAMAGES[rng.integers(0, len(DAMAGES))]
            data = damage(rng, data, int(rng.integers(0, len(data))), others)
    return data


def read(path):
    """Read a file as commands do; return True if it contains a valid QP."""
    try:
        if path.suffix == ".hdf5":
            contact = read_fclib(path).contact
            assert contact.W.shape == (contact.q.size,) * 2
            return True
        family = PROBLEMS["file"]
        configured = family.with_keys(path=str(path))
        case = configured.build("qp", None)
    except InputError as e:
        text = str(e)
        assert "\n" not in text
        assert len(text) < 1000
        return False
    qp = case.qp
    x = np.ones(qp.q.size)
    with np.errstate(all="ignore"):
        qp.P @ x, qp.A @ x, qp.G @ x
    assert qp.P.shape == (qp.q.size, qp.q.size)
    json.dumps([case.scale, case.constant], allow_nan=False)
    return True


def fuzz(kind, count, seed, folder, seconds):
    """Read `count` damaged files of one format; return the number of accepted files."""
    rng = np.random.default_rng(seed)
    whole = seeds(folder)[kind]
    path = folder / f"damaged.{kind}"
    survived = 0
    for _ in range(count):
        data = damaged(rng, whole[rng.integers(0, len(whole))], whole)
        path.write_bytes(data)
        with bounded(seconds):
            survived += read(path)
    assert not (folder / SENTINEL).exists()
    return survived
