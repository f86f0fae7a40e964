"""One case: its QP, and the way back from a point to the physical problem."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from harness import QP, Fields, Solution, plugin
from harness.errors import InputError
from harness.names import CaseId, parse, unbuilt
from harness.verify.verdicts import plain
from mortarbench.arguments import EXPORTS, writable
from mortarbench.registries import Plugins, Registries, known, one_thread


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Case:
    """One QP of one problem, under its canonical name."""

    id: CaseId  #: its name, in parts
    registries: Registries  #: those that it is built with

    @cached_property
    def made(self) -> plugin.Case:
        """What the family makes, once it is asked for.

        Raises
        ------
        InputError
            As `build`.

        """
        origin = self.registries.origins.get(self.id.family.name)
        try:
            with one_thread():
                return self.id.build(self.registries.reference)
        except InputError:
            raise
        except (Exception, SystemExit) as e:
            if origin is None and not isinstance(e, MemoryError):
                raise
            text = unbuilt(self.id, e)
            raise InputError(f"{origin}: {text}" if origin else text) from e

    @property
    def name(self) -> str:
        """FAMILY/key=value/…/FORM, without keys that others imply."""
        return self.id.name

    @property
    def qp(self) -> QP:
        """The QP, non-dimensional: energy in SI = scale·objective + constant."""
        return self.made.qp

    @property
    def params(self) -> Mapping[str, plugin.Value]:
        """Every key of the name with its value, defaults included."""
        return self.id.params

    @property
    def form(self) -> str:
        """Which of the equivalent QPs of the problem this is: primal, dual, …."""
        return self.id.form

    @property
    def remarks(self) -> tuple[str, ...]:
        """What may be wrong with the input, a line each: moduli of odd sizes."""
        return self.made.remarks

    def quantities(self, solution: Solution) -> dict[str, Any]:
        """Evaluate the physical results of a point, SI: energy, tip, pressures, …."""
        return dict(plain(self.made.quantities(solution)))

    def fields(self, solution: Solution) -> Fields:
        """Give the deformed bodies of a point, with stresses and contact forces, SI.

        Raises
        ------
        InputError
            When the case has no bodies.

        """
        if self.made.fields is None:
            raise InputError(f"{self.name} has no bodies to draw")
        return self.made.fields(solution)

    def save(self, path: str | Path) -> Path:
        """Write the QP for other people's solvers: .npz, .mat, .parquet or .qps.

        Raises
        ------
        InputError
            When the ending is none of these, the format has no place for the numbers,
            or the file cannot be written.

        """
        path = writable(Path(path), EXPORTS)
        meta = plain(
            {
                "name": self.name,
                "family": self.id.family.name,
                "params": self.params,
                "form": self.form,
                "units": "non-dimensional; energy in SI = scale * objective + constant",
                "scale": self.made.scale,
                "constant": self.made.constant,
            }
        )
        match path.suffix:
            case ".mat":
                from harness.files.matfile import save_mat

                save_mat(path, self.qp, meta, self.made.matrices)
            case ".parquet":
                from harness.files.parquetfile import save_parquet

                save_parquet(path, self.qp, meta)
            case ".qps":
                from problems.files.qps import save_qps

                save_qps(path, self.qp, meta)
            case _:
                from harness.files.qpfile import save_qp

                save_qp(path, self.qp, meta)
        return path

    def __repr__(self) -> str:
        if "made" not in vars(self):
            return f"<Case {self.name}, not built>"
        sizes = ", ".join(f"{n} {what}" for what, n in self.qp.sizes.items())
        return f"<Case {self.name}: {sizes}>"


def build(name: str, *, plugins: Plugins = ()) -> Case:
    """Build the case of a name, such as ``beam-ring/Nr=4/Nh=3/steps=1/dual``.

    plugins : Python files with more families

    Raises
    ------
    InputError
        When there is no such case, or it cannot be built.

    """
    registries = known(plugins)
    return built_case(parse(name, registries.families), registries)


def built_case(case: CaseId, registries: Registries) -> Case:
    """Build a case; what a plug-in or too little memory prevents is no fault of ours.

    Raises
    ------
    InputError
        For both, and what the family itself refuses.

    """
    found = Case(id=case, registries=registries)
    _ = found.made
    return found
