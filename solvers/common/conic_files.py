"""Files of conic solvers: Clarabel's JSON, QOCO's `.bin`, and CBF.

All contain the rows of `to_cone`. Discs and cones are second-order cones in them.

References: https://clarabel.org; the layout of `.bin` in the folder `benchmarks` of
https://github.com/qoco-org/qoco; H. A. Friberg, CBLIB 2014: a benchmark library for
conic mixed-integer and continuous optimization, Math. Program. Comput. 8 (2016), and
its description of the Conic Benchmark Format (CBF), version 1.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import coo_array, csc_array, triu

from mortarbench.harness import QP, InputError, Matrix
from mortarbench.harness.files.durable import replacing
from mortarbench.harness.files.qpfile import explicit_matrices
from mortarbench.solvers.common.conversion import csc, to_cone


def save_clarabel(path: Path, qp: QP) -> None:
    """Write a QP as JSON that ``clarabel.load_from_file`` reads."""
    form = to_cone(qp)
    cones = [("ZeroConeT", form.equalities), ("NonnegativeConeT", form.inequalities)]
    cones += [("SecondOrderConeT", size) for size in form.cones.tolist()]
    data = {
        "P": _by_columns(triu(csc(explicit_matrices(qp)[0]["P"]))),
        "q": qp.q.tolist(),
        "A": _by_columns(form.rows),
        "b": form.rhs.tolist(),
        "cones": [{kind: size} for kind, size in cones if size],
    }
    _write(path, json.dumps(data))


def save_qoco(path: Path, qp: QP) -> None:
    """Write a QP as `.bin` of QOCO: sizes, vectors, and the columns of P, A and G."""
    form = to_cone(qp)
    m = form.equalities
    P = csc(triu(csc(explicit_matrices(qp)[0]["P"])))
    matrices = [P, csc(form.rows[:m]), csc(form.rows[m:])]
    sizes = [qp.q.size, form.rhs.size - m, m, form.inequalities, form.cones.size]
    with replacing(path) as file:
        for size in sizes + [M.nnz for M in matrices]:
            file.write(np.int32(size).tobytes())
        for vector in qp.q, form.rhs[:m], form.rhs[m:], form.cones.astype(np.int32):
            file.write(vector.tobytes())
        for M in matrices:
            for part in M.data, M.indices.astype(np.int32), M.indptr.astype(np.int32):
                file.write(part.tobytes())


def save_cbf(path: Path, qp: QP) -> None:
    """Write a QP as CBF, with its quadratic term as a rotated cone.

    With P = LLᵀ, a further variable t ≥ ½‖Lᵀx‖² is minimised: (t, 1, Lᵀx) is in the
    rotated cone 2·t·1 ≥ ‖Lᵀx‖².

    Raises
    ------
    InputError
        If P has no Cholesky factor.

    """
    _write(path, "".join(f"{line}\n" for line in _cbf_lines(qp)))


def _cbf_lines(qp: QP) -> Iterator[str]:
    form, n, L = to_cone(qp), qp.q.size, _root(explicit_matrices(qp)[0]["P"])
    linear, sizes = form.rhs.size, [form.equalities, form.inequalities, *form.cones]
    names = ["L=", "L+"] + ["Q"] * form.cones.size
    cones = [(name, size) for name, size in zip(names, sizes, strict=True) if size]
    yield from ("VER", "1", "", "OBJSENSE", "MIN", "")
    yield from ("VAR", f"{n + 1} 1", f"F {n + 1}", "")
    yield from ("CON", f"{linear + 2 + n} {len(cones) + 1}")
    yield from (f"{name} {size}" for name, size in cones)
    yield from (f"QR {n + 2}", "")
    yield from _entries("OBJACOORD", (np.arange(n + 1),), np.append(qp.q, 1.0))
    rows, root = coo_array(-form.rows), coo_array(L.T)
    places = (
        np.concatenate([rows.coords[0], [linear], linear + 2 + root.coords[0]]),
        np.concatenate([rows.coords[1], [n], root.coords[1]]),
    )
    yield from _entries("ACOORD", places, np.concatenate([rows.data, [1.0], root.data]))
    yield from _entries(
        "BCOORD", (np.arange(linear + 2),), np.concatenate([form.rhs, [0.0, 1.0]])
    )


def _root(P: Matrix) -> csc_array:
    """Return L with P = LLᵀ; its columns are those of a permuted Cholesky factor."""
    from sksparse.cholmod import CholmodNotPositiveDefiniteError, cholesky

    try:
        factor = cholesky(csc(P))
        L, order = csc_array(factor.L()), factor.P()
    except CholmodNotPositiveDefiniteError:
        raise InputError(
            "P is singular; expected a positive definite P = LLᵀ for CBF, which has no "
            "quadratic objective"
        ) from None
    return csc_array(L[np.argsort(order)])


def _entries(section: str, places: tuple[Any, ...], values: Any) -> Iterator[str]:
    """Yield the lines of a section with coordinates; zeros are left out."""
    kept = np.flatnonzero(values)
    yield from (section, f"{kept.size}")
    for k in kept:
        yield " ".join([*(f"{index[k]}" for index in places), repr(float(values[k]))])
    yield ""


def _by_columns(M: Any) -> dict[str, Any]:
    M = csc(M)
    parts = {"colptr": M.indptr, "rowval": M.indices, "nzval": M.data}
    m, n = M.shape
    return {"m": m, "n": n} | {name: part.tolist() for name, part in parts.items()}


def _write(path: Path, text: str) -> None:
    with replacing(path) as file:
        file.write(text.encode())


#: function that writes the files with a suffix
WRITERS = {".json": save_clarabel, ".bin": save_qoco, ".cbf": save_cbf}
