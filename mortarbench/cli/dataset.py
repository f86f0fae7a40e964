"""The commands on the public set: `dataset build`, `check`, `info`, `leaderboard`."""

from __future__ import annotations

from collections.abc import Sequence
from json import dumps
from typing import Annotated

from mortarbench import dataset
from mortarbench.harness.errors import say
from mortarbench.registries import Plugins, Registries


def build_dataset(
    _: Registries,
    *,
    out: Annotated[str, "DIR"],
    everything: Annotated[bool, "--all"] = False,
) -> int:
    """Build the public set of problems and sequences with proven optima.

    The core are about 60 problems, and all sequences. The same command continues an
    interrupted one.

    out : new folder, or one with a part of the set
    everything : also build the problems behind the core
    """
    print(dataset.build(out, everything=everything, progress=say))
    return 0


def check_dataset(_: Registries, folder: Annotated[str, "DIR"]) -> int:
    """Check the files of a public set, and prove its optima again.

    Exit code 1: a file is missing or was changed, or an optimum is not proven.

    folder : folder of `dataset build`
    """
    wrong = dataset.check(folder)
    print(*wrong or ["every file is unchanged, and every optimum is proven"], sep="\n")
    return 1 if wrong else 0


def dataset_info(_: Registries, *, json: bool = False) -> int:
    """Show what the public set contains.

    json : print JSON
    """
    found = dataset.info()
    lines = [f"{name:11} {count}" for name, count in found.items()]
    print(dumps(found) if json else "\n".join(lines))
    return 0


def leaderboard(
    registries: Registries,
    folder: Annotated[str, "DIR"],
    *,
    out: Annotated[str | None, "RUN"] = None,
    solvers: Annotated[Sequence[str], "--solver NAME"] = (),
    repeats: Annotated[int | None, "N"] = None,
    plugins: Plugins = (),
) -> int:
    """Measure solvers on the core and the sequences of the set, and rank them by class.

    The same command continues an interrupted one; with other solvers, it adds them.
    With other plug-ins, it needs another RUN.

    folder : folder of `dataset build`
    out : result folder; default: ``out/leaderboard``
    solvers : measure only these solvers
    repeats : number of repeats; default: 2
    plugins : Python files with more solvers
    """
    del plugins  # loaded by `main`
    report = dataset.leaderboard(
        folder,
        out=out,
        solvers=solvers,
        repeats=repeats,
        progress=True,
        registries=registries,
    )
    print(report)
    return 0
