"""Reading of HDF5 files within size limits, without links to other files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mortarbench.harness import InputError
from mortarbench.harness.files.datafile import parsing
from mortarbench.harness.files.reading import check_size, opened


@contextmanager
def opened_hdf5(path: Path, expected: str, copies: int) -> Iterator[Mapping[str, Any]]:
    """Open a file, and yield its groups and datasets by HDF5 path.

    Links, which may lead to other files, are not followed.

    Parameters
    ----------
    expected : description of the file, for messages
    copies : bound on the memory of derived tables, as a multiple of the size of all
        datasets

    Raises
    ------
    InputError
        If the file is not HDF5, damaged or too large, or refers to data in other
        files; or if the code in the context raises an exception.

    """
    import h5py  # imported here, because workers of solvers do not need HDF5

    nodes: dict[str, Any] = {}

    def add(name: Any, node: Any) -> None:
        if not isinstance(name, str):
            raise ValueError("a name is not UTF-8")
        nodes[name] = node

    wrong = f"damaged, or not {expected} in HDF5"
    with opened(path, expected) as stream:
        with parsing(path, wrong, 0):
            file = h5py.File(stream, "r")
            file.visititems(add)
            arrays = [node for node in nodes.values() if isinstance(node, h5py.Dataset)]
            size = copies * sum(node.size * node.dtype.itemsize for node in arrays)
            if any(node.external or node.is_virtual for node in arrays):
                raise InputError(
                    f"{path}: arrays in other files, which are not opened; expected "
                    "all data in this file"
                )
        check_size(f"{path}: its arrays", size)
        with parsing(path, wrong, size), file:
            yield nodes
