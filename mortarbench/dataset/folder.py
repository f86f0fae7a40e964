"""Folders of the public set: build, check and describe them."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path

import pandas as pd

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
from mortarbench.harness import InputError, checked
from mortarbench.harness.digest import hex_digest, pieces
from mortarbench.harness.files.durable import report_full_disk
from mortarbench.harness.files.qpfile import load_qp, save_qp
from mortarbench.harness.files.store import read_arrays, write_arrays
from mortarbench.progress import ignore
from mortarbench.registries import one_thread

CHECKSUMS, CERTIFICATES = "CHECKSUMS", "certificates"
stored_bits = cache(partial(read_arrays, HERE / BITS, ()))  #: those of all items
TEST_SET = "contact_qpbenchmark.py"
#: Files that are copied into each folder, with their sources; the set is complete
#: without this package. qpbenchmark loads the class that is named as the file.
COPIED = {
    name: name
    for name in ("README.md", "LICENSE", "CITATION.cff", TEST_SET, "selection.py",
                 "candidates.toml")
} | {"contact_every.py": TEST_SET}  # fmt: skip


def build(
    out: str | Path,
    *,
    everything: bool = False,
    progress: Callable[[str], None] = ignore,
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
    is_new = not folder.exists() or (folder.is_dir() and not any(folder.iterdir()))
    if not is_new and not (folder / CATALOGUE).is_file():
        raise InputError(f"{folder} is not empty; expected a new or empty folder")
    rows = [r for r in catalogue() if everything or r["core"] == "yes" or r["sequence"]]
    differing = list[str]()
    with report_full_disk(folder if folder.exists() else folder.parent):
        folder.mkdir(parents=True, exist_ok=True)
        write_catalogue(folder, rows)
        for i, row in enumerate(rows, 1):
            path, proof = (folder / row["path"], folder / CERTIFICATES / row["path"])
            if _digest(path) == row["digest"] and proof.is_file():
                continue
            progress(f"{i}/{len(rows)} {row['name']}")
            if write_problem(row, path) != row["digest"]:
                differing.append(row["path"])
            proof.parent.mkdir(parents=True, exist_ok=True)
            with one_thread():
                write_arrays(proof, dict(certificate(row["kind"], load_qp(path)[0])))
        for name, source in COPIED.items():
            shutil.copyfile(HERE / source, folder / name)
        names = [CATALOGUE, *COPIED, *(row["path"] for row in rows)]
        lines = [f"{_digest(folder / name)}  {name}\n" for name in names]
        (folder / CHECKSUMS).write_text("".join(lines), "utf-8")
    if differing:
        raise InputError(
            f"{folder}: {len(differing)} of {len(rows)} items differ from those "
            f"published, first {differing[0]}; expected the versions of constraints.txt"
        )
    return folder


def check(folder: str | Path) -> tuple[str, ...]:
    """Check a folder of the set, and return what is wrong, a line for each file.

    Digests are compared, and every optimum, infeasibility and unboundedness is proven
    again from the problem and its certificate. All else in the catalogue is compared
    with the published one.

    Raises
    ------
    InputError
        If the folder has no catalogue.

    """
    path = checked.path("folder", folder)
    rows, sums = catalogue(path), path / CHECKSUMS
    lines = sums.read_text("utf-8", "replace").split() if sums.is_file() else []
    expected = dict(zip(lines[1::2], lines[::2], strict=False))
    expected |= {row["path"]: row["digest"] for row in rows}
    names = (CATALOGUE, *COPIED, *(row["path"] for row in rows))
    changed = [name for name in names if _digest(path / name) != expected.get(name)]
    found = [f"{name}: missing, or changed since the build" for name in changed]
    published = catalogue()
    with one_thread():
        for row in (row for row in rows if row["path"] not in changed):
            wrong = [*_unproven(path, row)]
            if not wrong and row not in published:
                wrong = ["its line of the catalogue is not the published one"]
            found += [f"{row['path']}: {text}" for text in wrong]
    return tuple(found)


def info() -> dict[str, int]:
    """Return numbers of problems, sequences and kinds of the published set."""
    table = pd.DataFrame(catalogue())
    single = table[table.sequence == ""]
    return {
        "core": int((single.core == "yes").sum()),
        "problems": len(single),
        "sequences": int((table.step == "1").sum()),
        "steps": len(table) - len(single),
        **single.kind.value_counts(sort=False).to_dict(),
    }


def write_problem(row: Row, path: Path) -> str:
    """Build the QP of an item and write it to a file, whose digest is returned."""
    meta = {k: row[k] for k in ("name", "case", "change", "kind", "optimum", "bound")}
    energy = {"scale": row["energy_scale"], "constant": row["energy_constant"]}
    path.parent.mkdir(parents=True, exist_ok=True)
    with one_thread():
        qp = standard_qp(row, stored_bits()[row["name"]])
        save_qp(path, qp, meta | {k: float(v) for k, v in energy.items() if v})
    return _digest(path)


def _unproven(folder: Path, row: Row) -> Iterator[str]:
    """Yield what is not proven of an item."""
    try:
        qp, _ = load_qp(folder / row["path"])
        proof = read_arrays(folder / CERTIFICATES / row["path"], ())
        yield from objections(row, qp, proof)
    except (InputError, ValueError, KeyError, ArithmeticError) as e:
        yield f"cannot be checked: {e}"


def _digest(path: Path) -> str:
    """Return the SHA-256 of a file; empty if there is none."""
    if not path.is_file():
        return ""
    with path.open("rb") as file:
        return hex_digest(pieces(file), 64)
