"""Build hook that compiles the .pyx modules and adds shared libraries to the package.

The libraries are placed beside their sources. Hatchling runs the hook whenever the
package is built or installed, also by `pip install -e`. If a .pyx file has changed,
`make setup` repeats the installation.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from hatchling.builders.hooks.plugin.interface import BuildHookInterface
from setuptools import Distribution, Extension

ROOT = Path(__file__).parents[1]
#: folder of sparse.pxd, which compiled modules of problems and solvers cimport
MAPS = ROOT / "harness" / "distributed"
FLAGS = ["-O3", "-fno-math-errno", "-fno-trapping-math", "-g0"]  #: flags of all modules
#: Further flags by module. Without contraction to fused multiply-adds, results have the
#: same digits on every machine.
MODULES = {
    "mortarbench.harness.distributed.sparse": [],
    # stiffness matrices and elimination orders must also be equal on every machine
    "mortarbench.problems.fem.kernels": ["-ffp-contract=off"],
    "mortarbench.problems.fem.ordering": ["-ffp-contract=off"],
    "mortarbench.problems.fem.elimination": ["-ffp-contract=off"],
    # sums may be reordered for vectorisation; inf and NaN keep their meaning
    "mortarbench.solvers.smalbe.compiled": ["-fassociative-math", "-fno-signed-zeros"],
}


def compiled() -> list[Path]:
    """Compile all modules, and return the paths of the shared libraries."""
    from Cython.Build import cythonize
    from setuptools.command.build_ext import build_ext

    with tempfile.TemporaryDirectory() as folder:
        extensions = cythonize(
            [_extension(name, flags) for name, flags in MODULES.items()],
            build_dir=folder,
            quiet=True,
        )
        command = build_ext(Distribution({"ext_modules": extensions}))
        command.build_temp, command.build_lib = folder, folder
        command.parallel = os.cpu_count()
        command.ensure_finalized()
        command.run()
        libraries = []
        for name in MODULES:
            library = Path(command.get_ext_fullpath(name))
            suffix = library.name.removeprefix(name.rpartition(".")[2])
            libraries.append(Path(shutil.move(library, _path(name, suffix))))
    return libraries


def _extension(name: str, flags: list[str]) -> Extension:
    source = Path(_path(name, ".pyx"))
    return Extension(
        name,
        [str(source)],
        depends=[
            str(p)
            for folder in (source.parent, MAPS)
            for p in folder.iterdir()
            if p.suffix in (".h", ".pxi", ".pxd")
        ],
        include_dirs=[str(source.parent), np.get_include()],
        extra_compile_args=FLAGS + flags,
    )


def _path(module: str, suffix: str) -> str:
    return str(ROOT.joinpath(*module.split("."))) + suffix


class Extensions(BuildHookInterface):  # type: ignore[type-arg]
    """Build hook of hatchling."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile the modules before hatchling collects the files of the package."""
        build_data["pure_python"], build_data["infer_tag"] = False, True
        build_data["artifacts"] += [
            str(library.relative_to(ROOT)) for library in compiled()
        ]
