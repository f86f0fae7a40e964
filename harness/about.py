"""What a solver's author tells about it, for lists and for documents."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec


@dataclass(frozen=True, kw_only=True)
class About:
    """The descriptive facts of a solver, kept with its adapter.

    A solver may have one as its attribute ``about``. Texts are Markdown, a sentence or
    two each. The tolerance mapping is no part of it: it is in the class's docstring.
    """

    title: str
    method: str  #: the class of methods, e.g. "interior point"
    licence: str
    linear_solver: str  #: what solves its linear systems
    phases: str  #: what is timed as preparing and what as solving
    package: str = ""  #: to install, with a module of the same name unless given below
    module: str = ""  #: to import, where its name differs
    sequence: str = ""  #: what it carries from one QP to the next; empty: nothing
    limits: tuple[str, ...] = ()  #: known limits found here, each with its evidence

    @property
    def missing(self) -> str | None:
        """Say what to install, or None if the library can be imported."""
        module = self.module or self.package
        if not module or find_spec(module) is not None:
            return None
        return f"not installed: {module} (pip install {self.package})"
