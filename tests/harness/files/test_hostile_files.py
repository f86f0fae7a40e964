"""Malicious data files are refused with one line, with little time and memory."""

import gzip
import io
import json
import os
import resource
import struct
import zipfile
import zlib

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.io import savemat
from scipy.sparse import csc_matrix

from mortarbench.harness import QP, InputError, no_rows
from mortarbench.harness.files.qpfile import load_qp, save_qp
from mortarbench.harness.files.reading import VARIABLE
from mortarbench.harness.operators import SerialisableOperator
from mortarbench.problems import PROBLEMS
from mortarbench.problems.fem.mesh_files.reading import read_msh
from tests.support.damaged_files import QPS, fuzz, tiny_qp

ADDRESS_SPACE = 2**29  #: additional bytes of address space for a refusal


def build(path):
    """Build the case of a file, as commands do."""
    family = PROBLEMS["file"]
    return family.with_keys(path=str(path)).build("qp", None)


@pytest.fixture
def cheaply():
    """Limit the additional address space of this process to `ADDRESS_SPACE`."""
    _, hard = before = resource.getrlimit(resource.RLIMIT_AS)
    with open("/proc/self/statm") as file:
        used = int(file.read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + ADDRESS_SPACE, hard))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)


# data that would execute code


def hostile(path, maker):
    """Write a QP whose P is an operator with the maker `maker`."""
    arrays = ["/bin/touch", str(path.parent / "SENTINEL")]
    operators = {maker: lambda arrays: lambda x: x}
    P = SerialisableOperator(
        2, maker, {"args": np.array(arrays), "d": np.ones(2)}, operators
    )
    qp = QP(
        P=P, q=np.ones(2), A=no_rows(2), b=np.zeros(0), G=no_rows(2), h=np.zeros(0),
        lb=np.zeros(2), ub=np.ones(2),
    )  # fmt: skip
    save_qp(path, qp, {"name": "hostile"}, serialised=True)


MAKERS = ("subprocess:call", "os:system", "builtins:print", "", "diagonal")


@pytest.mark.parametrize("maker", MAKERS)
def test_an_operator_in_a_file_is_refused_and_nothing_runs(tmp_path, command, maker):
    path = tmp_path / "a.npz"
    hostile(path, maker)
    for arguments in (
        ("solve", f"file:{path}", "--solver", "smalbe"),
        ("export", f"file:{path}", tmp_path / "out.mat"),
    ):
        code, out, err = command(*arguments)

        assert (code, out) == (2, "")
        assert "not an npz file of plain arrays" in err
        assert err.count("\n") == 1
    assert {p.name for p in tmp_path.iterdir()} == {"a.npz"}


@pytest.mark.parametrize("maker", MAKERS)
def test_a_file_can_name_only_functions_in_the_table(tmp_path, maker):
    hostile(tmp_path / "a.npz", maker)

    with pytest.raises(InputError, match=r"P is the operator .*; known: ours"):
        load_qp(tmp_path / "a.npz", operators={"ours": None})


# files that are not regular


@pytest.mark.parametrize(
    "suffix", ["", ".npz", ".mat", ".parquet", ".qps", ".msh", ".inp", ".med"]
)
@pytest.mark.parametrize("kind", ["zero", "pipe", "folder", "link to zero"])
def test_a_file_that_is_not_regular_is_refused_at_once(tmp_path, kind, suffix):
    path = tmp_path / f"a{suffix}"
    match kind:
        case "pipe":
            os.mkfifo(path)
        case "folder":
            path.mkdir()
        case "link to zero":
            path.symlink_to("/dev/zero")
        case "zero":
            path = "/dev/zero"
    read = read_msh if suffix in (".msh", ".inp", ".med") and kind != "zero" else build

    with pytest.raises(InputError, match=r": a (device|folder).*expected"):
        read(path)


@pytest.mark.parametrize(
    "name", ["a\0b.npz", "\ud800.npz", "x" * 5000 + ".npz", "\n.npz"]
)
def test_odd_names_are_refused_as_input(name):
    with pytest.raises(InputError):
        build(name)


# files that declare more data than they contain


def zeros(path, mib, method=zipfile.ZIP_DEFLATED):
    """Write an npz file whose vector q has the given MiB of zeros."""
    header = io.BytesIO()
    shape = {"descr": "<f8", "fortran_order": False, "shape": (mib * 2**17,)}
    np.lib.format.write_array_header_1_0(header, shape)
    with (
        zipfile.ZipFile(path, "w", method) as archive,
        archive.open("q.npy", "w", force_zip64=True) as member,
    ):
        member.write(header.getvalue())
        for _ in range(mib):
            member.write(bytes(2**20))


def mat_element(declared, content):
    """Return a .mat file of version 5 with one compressed variable."""
    text = b"MATLAB 5.0".ljust(124) + struct.pack("<H", 0x100) + b"IM"
    body = zlib.compress(struct.pack("<II", 14, declared) + content, 1)
    return text + struct.pack("<II", 15, len(body)) + body


def parquet_of_one_value(path, count):
    """Write a Parquet file with long lists of zeros, which occupy few bytes."""
    table = pa.table({
        name: pa.array([np.zeros(count)], pa.list_(pa.float64()))
        for name in ("P", "q", "G", "h", "A", "b", "lb", "ub")
    })  # fmt: skip
    pq.write_table(table, path, compression="zstd", use_dictionary=True)


def declared(name, values):
    """Return a test parameter with a writer of a tiny QP with replaced arrays.

    The value None omits an array.
    """

    def write(path):
        save_qp(path, tiny_qp(), {})
        with np.load(path) as stored:
            arrays = dict(stored)
        for key, value in values.items():
            arrays[key] = value
        np.savez(path, **{k: v for k, v in arrays.items() if v is not None})

    return pytest.param(write, name, id=name)


def header_only(text):
    """Return a writer of an npz file; q has the given header, and data of 8 bytes."""
    head = text.encode().ljust(117) + b"\n"
    member = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head + bytes(8)

    def write(path):
        save_qp(path, tiny_qp(), {})
        with zipfile.ZipFile(path) as archive:
            members = {n: archive.read(n) for n in archive.namelist()}
        with zipfile.ZipFile(path, "w") as archive:
            for name, content in {**members, "q.npy": member}.items():
                archive.writestr(name, content)

    return write


def header(shape="(1,)", descr="'<f8'"):
    return f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}"


def pickled(path):
    np.savez(path, q=np.array([object], dtype=object), allow_pickle=True)


def encrypted(path):
    save_qp(path, tiny_qp(), {})
    data = bytearray(path.read_bytes())
    data[data.index(b"PK\x01\x02") + 8] |= 1  # the flag in the central directory
    path.write_bytes(data)


def unknown_method(path):
    save_qp(path, tiny_qp(), {})
    data = bytearray(path.read_bytes())
    data[data.index(b"PK\x01\x02") + 10] = 97
    path.write_bytes(data)


def twice(path):
    save_qp(path, tiny_qp(), {})
    with pytest.warns(UserWarning, match="Duplicate"), zipfile.ZipFile(path, "a") as z:
        z.writestr("q.npy", z.read("q.npy"))


N = 10**9
HOSTILE_NPZ = [
    (encrypted, "not an npz file"),
    (unknown_method, "not an npz file"),
    (twice, "not an npz file"),
    (pickled, "q is a pickled Python object, which is never read; expected an arr"),
    (header_only(header(f"({N}, {N})")), "not an npz file"),
    (header_only(header("(-1,)")), "not an npz file"),
    (header_only(header("(2,)")), "not an npz file"),
    (header_only(header(descr="'|O'")), "is a pickled Python object"),
    (header_only(header(descr="[('a', '<f4'), ('b', '<f4')]")), "not an npz file"),
    (header_only("(" * 110), "not an npz file"),
    (header_only("x" * 60000), "not an npz file"),
]


def test_an_archive_that_expands_is_refused_before_it_is_read(
    tmp_path, monkeypatch, cheaply
):
    zeros(tmp_path / "a.npz", 16)
    assert (tmp_path / "a.npz").stat().st_size < 2**16
    monkeypatch.setenv(VARIABLE, "8")

    with pytest.raises(InputError, match=r"would take 16 MiB.*at most 8"):
        build(tmp_path / "a.npz")


@pytest.mark.parametrize("name", ["a.qps.gz", "a.mat.gz"])
def test_a_gzip_file_that_expands_is_refused_while_its_size_is_counted(
    tmp_path, monkeypatch, cheaply, name
):
    """The file expands to a gigabyte of zeros in several gzip members."""
    member = gzip.compress(bytes(2**24))
    (tmp_path / name).write_bytes(member * 64)
    assert (tmp_path / name).stat().st_size < 2**21
    monkeypatch.setenv(VARIABLE, "32")

    with pytest.raises(
        InputError, match=r"its expanded content would take more than 32 MiB"
    ):
        build(tmp_path / name)


@pytest.mark.parametrize("damage", [b"", b"no gzip", "cut", "checksum", "after"])
def test_a_damaged_gzip_file_is_refused(tmp_path, damage):
    whole = gzip.compress(QPS)
    damaged = {
        "cut": whole[:-20],
        "checksum": whole[:-8] + b"abcd" + whole[-4:],
        "after": whole + b"and more",
    }
    (tmp_path / "a.qps.gz").write_bytes(damaged.get(damage, damage))

    with pytest.raises(InputError) as e:
        build(tmp_path / "a.qps.gz")
    assert str(e.value) == (
        f"{tmp_path}/a.qps.gz: not a gzip file, or damaged; expected a QPS file, "
        "compressed"
    ) or (damage == b"" and "no ENDATA" in str(e.value))


@pytest.mark.parametrize(("write", "message"), HOSTILE_NPZ)
def test_a_hostile_archive_is_refused_before_it_is_read(
    tmp_path, cheaply, write, message
):
    write(tmp_path / "a.npz")

    with pytest.raises(InputError, match=message) as caught:
        build(tmp_path / "a.npz")
    assert "\n" not in str(caught.value)


def text(value):
    return np.array(json.dumps(value) if not isinstance(value, str) else value)


@pytest.mark.parametrize(
    ("write", "message"),
    [
        declared("A is not a matrix", {"A_indices": np.array([N])}),
        declared("A is not a matrix", {"A_shape": np.array([1, N])}),
        declared("b has 1 entries; expected 1099511627776", {
            "A_shape": np.array([2**40, 6])}),
        declared("A is not a matrix", {"A_indptr": np.zeros((7, 2), dtype=int)}),
        declared("indptr decreases", {
            "A_indptr": np.array([0, 1, -2**31, -1, 1, 1, 1], dtype=np.int32)}),
        declared("must contain integers", {"A_indices": np.array([0.5])}),
        declared("q is of type", {"q": np.array(["1"] * 6)}),
        declared("q is of type", {"q": np.ones(6, dtype=complex)}),
        declared("meta is not a JSON object", {"meta": text([])}),
        declared("nested too deeply", {"meta": text('{"a": ' + "[" * 10**5)}),
        declared("constant is not a finite", {"meta": text({"scale": 10**400})}),
        declared("constant is not a finite", {"meta": text('{"scale": NaN}')}),
        declared("Exceeds the limit", {"meta": text('{"scale": 1' + "0" * 5000 + "}")}),
        declared("dense is not a list", {"meta": text({"dense": [["P"]]})}),
        declared("A, dense and 1099511627776 × 6, would take", {
            "A_shape": np.array([2**40, 6]), "meta": text({"dense": ["A"]})}),
    ],
)  # fmt: skip
def test_numbers_that_define_no_qp_are_named(tmp_path, cheaply, write, message):
    write(tmp_path / "a.npz")

    with pytest.raises(InputError, match=message) as caught:
        build(tmp_path / "a.npz")
    assert len(str(caught.value)) < 500


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (mat_element(3 * 2**30, bytes(2**20)), "not a .mat file"),
        (mat_element(8, bytes(2**26)), "not a .mat file"),
        (mat_element(2**30, bytes(2**20)), "not a .mat file"),
        (mat_element(64, bytes(64))[:-7], "not a .mat file"),
        (mat_element(64, bytes(64))[:150] + b"damaged", "not a .mat file"),
        (b"\0" * 200, "not a .mat file|P is missing"),
    ],
)
def test_a_hostile_mat_file_is_refused_before_it_is_read(
    tmp_path, cheaply, data, message
):
    (tmp_path / "a.mat").write_bytes(data)

    with pytest.raises(InputError, match=message):
        build(tmp_path / "a.mat")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"q": np.array([[1.0, "a"]], dtype=object)}, "q is missing; expected a matr"),
        ({"q": np.ones(1) * 1j}, "q is missing; expected a matrix of numbers"),
        ({"q": {"a": 1}}, "q is missing; expected a matrix of numbers"),
        ({"q": np.ones((1, 1, 2))}, "q has shape .*; expected two dimensions"),
        ({"l": csc_matrix((2**31 - 1, 1))}, "would take 1638. MiB|would take"),
    ],
)
def test_a_mat_file_of_odd_numbers_is_named(tmp_path, cheaply, changes, message):
    maros = {"P": 1.0, "q": 1.0, "A": np.eye(1), "l": 0.0, "u": 1.0}
    savemat(tmp_path / "a.mat", maros | changes)

    with pytest.raises(InputError, match=message):
        build(tmp_path / "a.mat")


def test_a_parquet_file_that_expands_is_refused_before_it_is_read(
    tmp_path, monkeypatch
):
    parquet_of_one_value(tmp_path / "a.parquet", 2**20)
    assert (tmp_path / "a.parquet").stat().st_size < 2**16
    monkeypatch.setenv(VARIABLE, "32")

    with pytest.raises(InputError, match="would take more than 32 MiB of memory"):
        build(tmp_path / "a.parquet")


def test_a_file_above_the_limit_is_not_even_digested(tmp_path):
    with (tmp_path / "a.qps").open("wb") as file:
        file.truncate(2**40)  # a sparse file

    with pytest.raises(InputError, match="the file would take 1048576 MiB"):
        build(tmp_path / "a.qps")


# QPS


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"1.5", b"1_5", "'1_5' is not a number"),
        (b"1.5", b"1e400", "'1e400' exceeds"),
        (b"1.5", b"inf", "'inf' is not a finite number"),
        (b"1.5", b"nan", "'nan' is not a number"),
        (b"1.5", "\u0661".encode(), "is not a number"),
        (b"-3.0", b"inf", "constant of the objective is infinite"),
        (b"2.5", b"-1e999", "'-1e999' exceeds"),
        (b" UP BND", b" UP" * 10**5 + b" BND", "line 18"),
        (b"QUADOBJ", b"Q" * 10**6, "line 20: unknown section 'QQQ"),
        (b" N  COST", b"", "not among ROWS|no row of type N"),
    ],
)
def test_a_hostile_qps_text_is_refused_with_its_line(tmp_path, old, new, message):
    (tmp_path / "a.qps").write_bytes(QPS.replace(old, new, 1))

    with pytest.raises(InputError, match=message) as caught:
        build(tmp_path / "a.qps")
    assert len(str(caught.value)) < 700


# random damage; of meshes, in problems/fem/test_damaged_meshes.py

KINDS = ("npz", "mat", "parquet", "qps", "hdf5")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("count", [30, pytest.param(500, marks=pytest.mark.slow)])
def test_no_damaged_file_causes_a_crash_or_hang_or_runs_code(tmp_path, kind, count):
    survived = fuzz(kind, count, 12, tmp_path, seconds=120)

    # some files survive the damage, others do not
    assert count < 500 or 0 < survived < count / 2
