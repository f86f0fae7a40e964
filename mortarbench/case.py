"""A case by name, or a bare QP: its QP, and the way back to the physical problem."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.sparse import csc_array, csc_matrix

from mortarbench.arguments import EXPORTS, writable
from mortarbench.harness import QP, Fields, Matrix, Solution, plugin
from mortarbench.harness.errors import InputError, shown
from mortarbench.harness.names import CaseId, parse, unbuilt
from mortarbench.harness.verify.verdicts import plain
from mortarbench.registries import TURN, Plugins, Registries, known, one_thread

if TYPE_CHECKING:
    from mortarbench.harness import Mechanics, Vector


class Case(plugin.Case):
    """One QP of one problem, under its canonical name, built when first used."""

    def __init__(self, *, id: CaseId, registries: Registries) -> None:  # noqa: A002
        self.id = id  #: its name, in parts
        self.registries = registries  #: those that it is built with

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

    @cached_property
    def qp(self) -> QP:
        """The QP, non-dimensional: energy in SI = scale·objective + constant.

        Its matrices are of the types that other libraries take: ``scipy.sparse``
        ``csc_matrix`` with 32-bit indices, or dense arrays. P of a decomposed problem
        is an operator, whose matrix is ``P @ numpy.eye(n)``.
        """
        return self.made.qp.with_matrices(_exported)

    @property
    def scale(self) -> float:
        """Factor from the objective of the QP to an energy in SI."""
        return self.made.scale

    @property
    def constant(self) -> float:
        """Energy in SI where the objective of the QP is zero."""
        return self.made.constant

    @property
    def matrices(self) -> Mapping[str, Any]:
        """Matrices of a dual form in the notation of the paper."""
        return self.made.matrices

    @property
    def dualise_seconds(self) -> float | None:
        """Time to assemble a dual form, factorisation included; None for a primal."""
        return self.made.dualise_seconds

    @property
    def mechanics(self) -> Mechanics | None:
        """Mechanical problem that certificates use, or None."""
        return self.made.mechanics

    @property
    def unsettled(self) -> float:
        """Relative distance of the QP from the fixed point that it approximates."""
        return self.made.unsettled

    def recover(self, solution: Solution) -> Vector:
        """Compute the physical unknown of a point, SI."""
        return self.made.recover(solution)

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

    @TURN
    def quantities(self, solution: Solution) -> dict[str, Any]:
        """Evaluate the physical results of a point, SI: energy, tip, pressures, …."""
        return dict(plain(self.made.quantities(solution)))

    @TURN
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
        path = writable(path, EXPORTS)
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
                from mortarbench.harness.files.matfile import save_mat

                save_mat(path, self.qp, meta, self.made.matrices)
            case ".parquet":
                from mortarbench.harness.files.parquetfile import save_parquet

                save_parquet(path, self.qp, meta)
            case ".qps":
                from mortarbench.problems.files.qps import save_qps

                save_qps(path, self.qp, meta)
            case _:
                from mortarbench.harness.files.qpfile import save_qp

                save_qp(path, self.qp, meta)
        return path

    def __repr__(self) -> str:
        if "made" not in vars(self):
            return f"<Case {self.name}, not built>"
        sizes = ", ".join(f"{n} {what}" for what, n in self.made.qp.sizes.items())
        return f"<Case {self.name}: {sizes}>"


def _exported(M: Matrix) -> Matrix:
    """Return a sparse matrix as a `csc_matrix`, with 32-bit indices if they suffice."""
    M = csc_matrix(M)
    if max(M.nnz, *M.shape) < 2**31:
        narrow = (M.indices.astype(np.int32), M.indptr.astype(np.int32))
        M = csc_matrix((M.data, *narrow), shape=M.shape)
    M.sum_duplicates()
    return M


class GivenQP(plugin.Family):
    """A QP from a script, as a family of one problem."""

    name = "qp"
    defaults: Mapping[str, plugin.Value] = MappingProxyType({})
    forms = ("qp",)

    def __init__(self, qp: QP) -> None:
        self.qp = qp

    def build(
        self,
        form: str,
        params: Mapping[str, plugin.Value],
        reference: plugin.Reference,
    ) -> plugin.Case:
        """Return the QP as a case without physical results."""
        return plugin.Case(qp=self.qp, recover=lambda s: s.x, quantities=lambda _: {})


def as_case(problem: Case | QP | str, plugins: Plugins = ()) -> Case:
    """Return the case of a name, not built yet, or of a QP; a case as it is.

    plugins : Python files with more families or solvers

    Raises
    ------
    InputError
        When the problem is of another type, there is no such case, or a plug-in cannot
        be loaded.

    """
    match problem:
        case Case():
            files = problem.registries.missing(plugins)
            if not files:
                return problem
            registries = problem.registries.with_files(files)
            extended = Case(id=problem.id, registries=registries)
            if "made" in vars(problem):
                extended.__dict__["made"] = problem.made
            return extended
        case QP():
            # our own code multiplies sparse arrays, not matrices, which differ in `*`
            family = GivenQP(problem.with_matrices(csc_array))
            name = CaseId(family=family, name="qp", params={}, form="qp")
            return Case(id=name, registries=known(plugins))
        case str():
            registries = known(plugins)
            return Case(id=parse(problem, registries.families), registries=registries)
    hint = f"; a file is 'file:{problem}'" if isinstance(problem, Path) else ""
    raise InputError(
        f"case = {shown(problem)}; expected the name of a case, what build() returns, "
        f"or a QP{hint}"
    )


def export(case: Case | QP | str, path: str | Path, *, plugins: Plugins = ()) -> Path:
    """Write a QP for other people's solvers: .npz, .mat, .parquet or .qps.

    Parameters
    ----------
    case : a name, a case of `build`, or a QP
    path : of the file; its ending names the format
    plugins : Python files with more families

    Raises
    ------
    InputError
        When there is no such case, it cannot be built, the ending is none of these, the
        format has no place for the numbers, or the file cannot be written.

    """
    return as_case(case, plugins).save(path)


@TURN
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
