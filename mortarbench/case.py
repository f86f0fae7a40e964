"""Cases: QPs with functions that recover physical results."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from mortarbench.harness import checked, plugin
from mortarbench.harness.errors import InputError, shown
from mortarbench.harness.keys import Value
from mortarbench.harness.names import CaseId, parse, unbuilt
from mortarbench.registries import (
    TURN,
    Plugins,
    Registries,
    load_registries,
    one_thread,
)

if TYPE_CHECKING:
    from mortarbench.harness import QP, Fields, Mechanics, Solution, Vector


EXPORTS = (
    ".npz",
    ".mat",
    ".parquet",
    ".qps",
    ".json",
    ".bin",
    ".cbf",
)  #: suffixes of exported QPs


class Case(plugin.Case):
    """QP with functions that recover physical results; the QP is built at first use."""

    def __init__(self, *, id: CaseId, registries: Registries) -> None:  # noqa: A002
        self.id = id  #: family, parameters and form
        self.registries = registries  #: families and reference solver for the build

    @cached_property
    def family_case(self) -> plugin.Case:
        """Result of `Family.build`, computed on first access.

        Raises
        ------
        InputError
            If the case cannot be built.

        """
        origin = self.registries.origins.get(self.id.family_name)
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
        """Canonical name FAMILY/key=value/…/FORM, without keys that can be omitted."""
        return self.id.name

    @cached_property
    def qp(self) -> QP:
        """Non-dimensional QP; its energy in SI units is scale · objective + constant.

        The matrices have the types that solvers receive in a run: ``scipy.sparse``
        ``csc_array`` with 32-bit indices if these suffice, or dense arrays. P may also
        be an operator, as for a decomposed problem; its matrix is ``P @ numpy.eye(n)``.
        """
        return self.family_case.qp

    @property
    def scale(self) -> float:
        """Factor in energy = scale · objective + constant, in SI units."""
        return self.family_case.scale

    @property
    def constant(self) -> float:
        """Constant c of energy = scale · objective + c, in SI units."""
        return self.family_case.constant

    @property
    def matrices(self) -> Mapping[str, Any]:
        """Matrices of a dual form by their names in the paper."""
        return self.family_case.matrices

    @property
    def dualise_seconds(self) -> float | None:
        """Time to factorise and assemble a dual form, in s; None if not recorded."""
        return self.family_case.dualise_seconds

    @property
    def mechanics(self) -> Mechanics | None:
        """Mechanical problem from which error bounds are computed, or None."""
        return self.family_case.mechanics

    def recover(self, solution: Solution) -> Vector:
        """Recover the physical unknown, such as displacements, in SI units."""
        return self.family_case.recover(solution)

    @property
    def params(self) -> Mapping[str, Value]:
        """Values of all keys of the family, including defaults."""
        return self.id.params

    @property
    def form(self) -> str:
        """Formulation of the problem as a QP, such as ``primal`` or ``dual``."""
        return self.id.form

    @property
    def remarks(self) -> tuple[str, ...]:
        """Possible mistakes in the input, such as unusual moduli, one line each."""
        return self.family_case.remarks

    @TURN
    def quantities(self, solution: Solution) -> dict[str, Any]:
        """Return physical results of a solution, such as its energy, in SI units."""
        from mortarbench.harness.verify.verdicts import plain

        return dict(plain(self.family_case.quantities(solution)))

    @TURN
    def fields(self, solution: Solution) -> Fields:
        """Return the deformed bodies with stresses and contact forces, in SI units.

        Raises
        ------
        InputError
            If the case has no bodies.

        """
        if self.family_case.fields is None:
            raise InputError(f"{self.name} has no bodies to draw")
        return self.family_case.fields(solution)

    def save(self, path: str | Path) -> Path:
        """Write the QP to a file for other programs; see `export`.

        Raises
        ------
        InputError
            If the suffix is unknown, the format cannot store the QP, or the file cannot
            be written.

        """
        path = checked.output_file(path, EXPORTS)
        from mortarbench.harness.verify.verdicts import plain

        meta = plain(
            {
                "name": self.name,
                "family": self.id.family_name,
                "params": self.params,
                "form": self.form,
                "units": "non-dimensional; energy in SI = scale * objective + constant",
                "scale": self.family_case.scale,
                "constant": self.family_case.constant,
            }
        )
        match path.suffix:
            case ".mat":
                from mortarbench.harness.files.matfile import save_mat

                save_mat(path, self.qp, meta, self.family_case.matrices)
            case ".parquet":
                from mortarbench.harness.files.parquetfile import save_parquet

                save_parquet(path, self.qp, meta)
            case ".qps":
                from mortarbench.problems.files.qps import save_qps

                save_qps(path, self.qp, meta)
            case ".json" | ".bin" | ".cbf" as suffix:
                from mortarbench.solvers.common.conic_files import WRITERS

                WRITERS[suffix](path, self.qp)
            case _:
                from mortarbench.harness.files.qpfile import save_qp

                save_qp(path, self.qp, meta)
        return path

    def __repr__(self) -> str:
        if "family_case" not in vars(self):
            return f"<Case {self.name}, not built>"
        sizes = ", ".join(
            f"{n} {what}" for what, n in self.family_case.qp.sizes.items()
        )
        return f"<Case {self.name}: {sizes}>"


@dataclass(frozen=True)
class BareQP(plugin.Family):
    """Family of a single problem: a QP that was passed as an object."""

    forms: ClassVar = ("qp",)

    qp: Any = field(compare=False)  #: a `QP`; its import loads numpy

    def build(self, form: str, reference: plugin.Reference) -> plugin.Case:
        """Return the QP as a case without physical results."""
        return plugin.Case(qp=self.qp, recover=lambda s: s.x, quantities=lambda _: {})


def as_case(
    problem: Case | QP | str | object,
    plugins: Plugins = (),
    registries: Registries | None = None,
) -> Case:
    """Return the unbuilt case for a name, a QP, or a problem of qpsolvers or cvxpy.

    If `problem` is a case, the same case is returned, unless `plugins` contains files
    that its registries have not loaded.

    plugins : Python files with more families or solvers
    registries : used for a name instead of built-in registries, installed plug-ins and
        `plugins`

    Raises
    ------
    InputError
        If `problem` has another type, there is no such case, or a plug-in cannot be
        loaded.

    """
    if isinstance(problem, str):
        registries = load_registries(plugins, registries)
        return Case(id=parse(problem, registries.families), registries=registries)
    if isinstance(problem, Case):
        registries = problem.registries.with_files(plugins)
        if registries is problem.registries:
            return problem
        extended = Case(id=problem.id, registries=registries)
        if "family_case" in vars(problem):
            extended.__dict__["family_case"] = problem.family_case
        return extended
    from mortarbench.harness import QP

    if isinstance(problem, QP):
        name = CaseId(family=BareQP(problem), name="qp", form="qp")
        return Case(id=name, registries=load_registries(plugins))
    # attributes are tested, since an import of qpsolvers takes a second
    if hasattr(problem, "get_problem_data"):
        return as_case(QP.from_cvxpy(problem), plugins)
    if all(hasattr(problem, name) for name in ("P", "q", "G", "h", "A", "b")):
        return as_case(QP.from_qpsolvers(problem), plugins)
    hint = f"; write 'file:{problem}' for a file" if isinstance(problem, Path) else ""
    raise InputError(
        f"case = {shown(problem)}; expected the name of a case, the result of "
        f"build(), a QP, or a problem of qpsolvers or cvxpy{hint}"
    )


def export(
    case: Annotated[object, "CASE"],
    path: Annotated[str | Path, "FILE.npz|mat|parquet|qps|json|bin|cbf"],
    *,
    plugins: Plugins = (),
    registries: Registries | None = None,
) -> Path:
    """Write a QP to a file for other programs, in one of seven formats.

    Parameters
    ----------
    case : FAMILY/key=value/…/FORM, such as beam-ring/Nr=4/Nh=3/dual; see docs/cases.md.
        In Python also a case of `build`, a QP, or a problem of qpsolvers or cvxpy
    path : file to write; the suffix selects the format: npz (NumPy), mat (MATLAB,
        Octave), parquet (qpbenchmark), qps, json (Clarabel), bin (QOCO), or cbf (CBLIB)
    plugins : Python files with more families
    registries : used for a name instead of built-in registries, installed plug-ins and
        `plugins`

    Raises
    ------
    InputError
        If there is no such case, the case cannot be built, the suffix is unknown, the
        format cannot store the QP, or the file cannot be written.

    Examples
    --------
    >>> import mortarbench as mb
    >>> mb.export("contact-patch/dual", "patch.npz").name
    'patch.npz'

    """
    return as_case(case, plugins, registries).save(path)


@TURN
def build(name: str, *, plugins: Plugins = ()) -> Case:
    """Build the case with a name such as ``beam-ring/Nr=4/Nh=3/steps=1/dual``.

    plugins : Python files with more families

    Raises
    ------
    InputError
        If there is no such case, or the case cannot be built.

    Examples
    --------
    >>> import mortarbench as mb
    >>> case = mb.build("beam-ring/Nr=4/Nh=3/steps=1/dual")
    >>> case.form, case.params["Nr"], case.qp.P.shape == (case.qp.q.size,) * 2
    ('dual', 4, True)

    """
    case = as_case(name, plugins)
    _ = case.family_case
    return case
