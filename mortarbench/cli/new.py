"""The command `new`: write a template for a solver, a problem or a suite."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

from mortarbench.harness.errors import InputError, say, shown
from mortarbench.registries import Registries

_TEMPLATES = Path(__file__).parents[1] / "templates"
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")
#: command to try next with the new file, by kind of the template
_NEXT = {
    "solver": "mortarbench test-solver {0} --plugin {0}.py",
    "problem": "mortarbench solve {0}/primal --solver clarabel --plugin {0}.py",
    "suite": "mortarbench run {0}.toml",
}


def new(
    registries: Registries,
    kind: Literal["solver", "problem", "suite"],
    name: Annotated[str, "NAME"],
) -> int:
    """Write a template for a solver, a problem or a suite to the working directory.

    The file passes all checks unchanged. Existing files are not overwritten.

    kind : kind of the template
    name : the file is NAME.py, or NAME.toml for a suite
    """
    if not _NAME.fullmatch(name):
        raise InputError(
            f"name {shown(name)}; expected letters, digits, '-' and '_', "
            "starting with a letter"
        )
    taken: Mapping[str, object] = {
        "solver": registries.solvers,
        "problem": registries.families,
        "suite": {path.stem: path for path in registries.suites.glob("*.toml")},
    }[kind]
    if name in taken:
        raise InputError(f"{kind} {name!r} exists already; expected another name")
    (template,) = _TEMPLATES.glob(f"{kind}.*")
    path = Path(f"{name}{template.suffix}")
    text = re.sub(r"\bNAME\b", name, template.read_text("utf-8"))
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        raise InputError(f"{path} exists already; expected another name") from None
    print(path)
    say(f"try it: {_NEXT[kind].format(name)}")
    return 0
