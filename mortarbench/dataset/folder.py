"""Folders of the public set: build, check and describe them."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from mortarbench.dataset.items import (
    BITS,
    CATALOGUE,
    HERE,
    Row,
    catalogue,
    certificate,
    objections,
    standard_qp,
    write_catalogue,
)
from mortarbench.harness import QP, InputError, checked
from mortarbench.harness.digest import hex_digest, pieces
from mortarbench.harness.files.durable import report_full_disk
from mortarbench.harness.files.qpfile import load_qp, save_qp
from mortarbench.harness.files.store import Arrays, read_arrays, write_arrays
from mortarbench.registries import one_thread

CHECKSUMS = "CHECKSUMS"
#: files that are copied into each folder; the set is complete without this package
COPIED = (
    "README.md", "LICENSE", "CITATION.cff", "contact_qpbenchmark.py",
    "selection.py", "candidates.toml",
)  # fmt: skip
#: further test sets: qpbenchmark loads the class that is named as the file
TEST_SETS = {
    "contact_every.py": "ContactEvery",
    "contact_dense.py": "ContactDense",
    "contact_strictly_convex.py": "ContactStrictlyConvex",
}


def build(
    out: str | Path,
    *,
    everything: bool = False,
    progress: Callable[[str], None] | None = None,
) -> Path:
    """Build the public set of problems and sequences in a folder, and return the path.

    The core are about 60 problems, and all sequences. Items that the folder contains
    already are not built again, so that the same call continues an interrupted one.

    out : new or empty folder, or one that contains a part of the set
    everything : also build the problems behind the core
    progress : called with a message for each item

    Raises
    ------
    InputError
        If the folder contains other files or cannot be written, or if items have other
        digits than those published, as with another version of a library.

    """
    folder = checked.path("out", out)
    if (
        folder.exists()
        and not (folder / CATALOGUE).is_file()
        and (not folder.is_dir() or any(folder.iterdir()))
    ):
        raise InputError(f"{folder} is not empty; expected a new or empty folder")
    rows = [r for r in catalogue() if everything or r["core"] == "yes" or r["sequence"]]
    differing = list[str]()
    with report_full_disk(folder if folder.exists() else folder.parent):
        folder.mkdir(parents=True, exist_ok=True)
        write_catalogue(folder, rows)
        for i, row in enumerate(rows, 1):
            path, proof = folder / row["path"], _certificate_path(folder, row)
            if not (_digest(path) == row["digest"] and proof.is_file()):
                if progress:
                    progress(f"{i}/{len(rows)} {row['name']}")
                with one_thread():
                    qp = _published(row)
                    proof.parent.mkdir(parents=True, exist_ok=True)
                    # before the problem, whose digest marks a finished item
                    write_arrays(proof, dict(certificate(row["kind"], qp)))
                    if _saved(row, qp, path) != row["digest"]:
                        differing.append(row["path"])
        for name in COPIED:
            shutil.copyfile(HERE / name, folder / name)
        for name, kind in TEST_SETS.items():
            text = f"from contact_qpbenchmark import {kind} as {kind}\n"
            (folder / name).write_text(text, "utf-8")
        names = [CATALOGUE, *COPIED, *TEST_SETS, *(row["path"] for row in rows)]
        lines = [f"{_digest(folder / name)}  {name}\n" for name in names]
        (folder / CHECKSUMS).write_text("".join(lines), "utf-8")
    if differing:
        raise InputError(
            f"{folder}: {len(differing)} of {len(rows)} items differ from those "
            f"published, first {differing[0]}; expected the versions of constraints.txt"
        )
    return folder


def check(folder: str | Path) -> tuple[str, ...]:
    """Check a folder of the set, and return what is wrong, a line for each item.

    Digests are compared, and every optimum, infeasibility and unboundedness is proven
    again from the problem and its certificate.

    Raises
    ------
    InputError
        If the folder has no catalogue.

    """
    path = checked.path("folder", folder)
    rows = catalogue(path)
    with one_thread():
        found = [f"{row['path']}: {text}" for row in rows for text in _wrong(path, row)]
    sums = path / CHECKSUMS
    lines = sums.read_text("utf-8").splitlines() if sums.is_file() else []
    for name in (CATALOGUE, *COPIED, *TEST_SETS):
        if f"{_digest(path / name)}  {name}" not in lines:
            found.append(f"{name}: missing, or changed since the build")
    return tuple(found)


def info() -> dict[str, Any]:
    """Return numbers of problems, sequences and classes of the published set."""
    rows = catalogue()
    single = [row for row in rows if not row["sequence"]]
    core = [row for row in single if row["core"] == "yes"]
    sizes = sorted(int(row["n"]) for row in rows)
    classes = ("dense", "strictly_convex", "shifted")
    return {
        "core": len(core),
        "problems": len(single),
        "families": dict(Counter(row["family"] for row in core)),
        "sequences": dict(Counter(r["family"] for r in rows if r["step"] == "1")),
        "steps": len(rows) - len(single),
        "kinds": dict(Counter(row["kind"] for row in single)),
        "variables": f"{sizes[0]} to {sizes[-1]}, median {sizes[len(sizes) // 2]}",
        "classes": {name: sum(r[name] == "yes" for r in rows) for name in classes},
    }


def store_problem(row: Row) -> str:
    """Build an item in a temporary folder, and return the digest of its file."""
    with TemporaryDirectory() as folder, one_thread():
        return _saved(row, _published(row), Path(folder, "item.npz"))


def _published(row: Row) -> QP:
    """Return the QP of an item, with the stored bits."""
    return standard_qp(row, _bits()[row["name"]])


def _saved(row: Row, qp: QP, path: Path) -> str:
    """Write the QP of an item to a file, and return the digest of the file."""
    meta = {k: row[k] for k in ("name", "case", "change", "kind", "optimum", "bound")}
    energy = {"scale": row["energy_scale"], "constant": row["energy_constant"]}
    path.parent.mkdir(parents=True, exist_ok=True)
    save_qp(path, qp, meta | {k: float(v) for k, v in energy.items() if v})
    return _digest(path)


@cache
def _bits() -> Arrays:
    """Return the stored bits of all items."""
    return read_arrays(HERE / BITS, ())


def _wrong(folder: Path, row: Row) -> Iterator[str]:
    """Yield what is wrong with an item."""
    path, proof = folder / row["path"], _certificate_path(folder, row)
    if not path.is_file() or not proof.is_file():
        yield "missing" if not path.is_file() else "its certificate is missing"
        return
    if (digest := _digest(path)) != row["digest"]:
        yield f"its digest is {digest[:12]}…, not {row['digest'][:12]}…"
        return
    try:
        qp, _ = load_qp(path)
        yield from objections(row, qp, read_arrays(proof, ()))
    except (InputError, ValueError, KeyError) as e:
        yield f"cannot be checked: {e}"


def _certificate_path(folder: Path, row: Row) -> Path:
    return folder / "certificates" / row["path"]


def _digest(path: Path) -> str:
    """Return the SHA-256 of a file; empty if there is none."""
    if not path.is_file():
        return ""
    with path.open("rb") as file:
        return hex_digest(pieces(file), 64)
