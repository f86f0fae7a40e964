"""Solution of a case, with the verdict on the answer.

Modules that import numpy are imported when a case is solved, and not with this module,
so that the command `solve` prints its help and refuses wrong input at once.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import ExitStack, redirect_stdout
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from sys import stderr
from typing import TYPE_CHECKING, Annotated, Any

from mortarbench.case import Case, as_case
from mortarbench.harness import Record, Solver, Verdict, checked
from mortarbench.harness.distributed.mpi import ranks_asked, too_few_parts
from mortarbench.harness.errors import InputError, shown
from mortarbench.harness.names import assemble, family_name
from mortarbench.harness.processes.scratch import single_worker
from mortarbench.harness.processes.termination import ended_by_signals
from mortarbench.harness.record import finite
from mortarbench.harness.registry import (
    SolverSpec,
    check_name,
    check_solver,
    options_of,
    resolve,
)
from mortarbench.registries import (
    TURN,
    Plugins,
    Registries,
    defer_parts_of_numpy,
    load_registries,
    one_thread,
    with_history,
)
from mortarbench.text import outcome

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from mortarbench.harness import Fields, Residuals, Solution
    from mortarbench.harness.processes.supervisor import WorkerProcess
    from mortarbench.harness.solution import History

PICTURES = (".png", ".pdf", ".svg")  #: suffixes of pictures
GRIDS = (".vtu", ".pvd")  #: suffixes of ParaView files: one state, or all steps
ARCHIVES = (".npz",)  #: suffix of a written answer
MAX_SCALE = 1e9  #: largest absolute magnification of displacements in pictures
TIME_LIMIT = 300.0  #: default time limit of `solve`, in s


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Answer:
    """Answer of a solver to a case, with the verdict of the harness."""

    case: Case
    record: Record  #: measurement, as in a line of a journal
    #: point and claim of the solver; None if its process ended without an answer
    solution: Solution | None
    solver: str | Solver  #: name or object, as passed to `solve`
    options: Mapping[str, Any]  #: options, as passed to `solve`
    #: possible mistakes in the input, and reasons to doubt a verified answer, one line
    #: each
    remarks: tuple[str, ...] = ()

    @property
    def verdict(self) -> Verdict:
        """Verdict of the harness; an answer is verified regardless of the claim."""
        return self.record.status

    @property
    def residuals(self) -> Residuals | None:
        """Relative KKT residuals, evaluated by the harness; None without a point."""
        from mortarbench.harness import Residuals

        values: list[Any] = [getattr(self.record, name) for name in Residuals._fields]
        return None if None in values else Residuals(*values)

    @property
    def energy_bound(self) -> float | None:
        """Certified bound on the relative error in the energy norm; None if unknown."""
        return self.record.energy_bound

    @property
    def quantities(self) -> Mapping[str, Any]:
        """Physical results, in SI units."""
        return self.record.quantities

    @property
    def history(self) -> History:
        """History that the solver reports: columns with one row per iteration."""
        return {} if self.solution is None else self.solution.history

    @property
    def has_point(self) -> bool:
        """True if the solver returned a finite point."""
        from mortarbench.harness.verify.verdicts import has_point

        return self.solution is not None and has_point(self.solution)

    def to_dict(self) -> dict[str, Any]:
        """Return the record, the history and the remarks as plain data."""
        from mortarbench.harness.verify.verdicts import plain

        history = finite(plain(self.history))
        return {
            **json.loads(self.record.to_json()),
            "history": history,
            "remarks": [*self.remarks],
        }

    def fields(self) -> Fields:
        """Return the deformed bodies with their stresses and contact forces.

        Raises
        ------
        InputError
            If the case has no bodies, or the answer has no point.

        """
        if self.solution is None or not self.has_point:
            raise InputError(f"no picture: {self.record.solver} returned no point")
        return self.case.fields(self.solution)

    def plot(
        self, path: str | Path | None = None, *, scale: float | None = None
    ) -> Figure:
        """Draw the deformed bodies with their stresses, and each contact enlarged.

        For half-planes and half-spaces, which have no finite mesh, the contact
        tractions are drawn instead.

        Parameters
        ----------
        path : file to which the picture is also written: .png, .pdf or .svg
        scale : magnification of the displacements. None: 1 if the displacements are
            then visible, and otherwise a rounded factor, which the title states

        Raises
        ------
        InputError
            If the case has no bodies, the answer has no point, the file cannot be
            written, or `scale` is NaN or too large.

        Examples
        --------
        >>> import mortarbench as mb
        >>> answer = mb.solve("contact-patch/dual", "smalbe")
        >>> figure = answer.plot()

        """
        from mortarbench.reports.figures.bodies import fields_figure
        from mortarbench.reports.figures.style import save

        fields = self.fields()
        figure = fields_figure(fields, None if scale is None else check_scale(scale))
        if path is not None:
            save(figure, checked.output_file(path, PICTURES))
        return figure

    def save(self, path: str | Path) -> Path:
        """Write x, y, z and z_box and, for bodies, displacements to an npz file.

        The displacements (N, dim) of the nodes at the reference positions `points`
        (N, dim) are in m.

        Raises
        ------
        InputError
            If the answer has no point, or the file cannot be written.

        """
        import numpy as np

        from mortarbench.harness.files.durable import writing
        from mortarbench.harness.files.store import POINT

        path = checked.output_file(path, ARCHIVES)
        if self.solution is None or not self.has_point:
            raise InputError(f"{path}: {self.record.solver} returned no point")
        arrays = {name: getattr(self.solution, name) for name in POINT}
        if self.case.family_case.fields is not None:
            fields = self.fields()
            arrays |= {"points": fields.points, "displacements": fields.displacement}
        with writing(path) as file:
            np.savez(file, **arrays)
        return path

    def save_vtu(self, path: str | Path) -> Path:
        """Write the deformed bodies for ParaView: .vtu, or .pvd with all load steps.

        For a .pvd file, the same solver also solves the earlier load steps.

        Raises
        ------
        InputError
            If the case has no bodies, the answer or an earlier load step has no point,
            or the file cannot be written.

        """
        from mortarbench.reports.export.vtu import write_series, write_vtu

        path, fields = checked.output_file(path, GRIDS), self.fields()
        if not len(fields.cells):
            raise InputError(f"{path}: {self.case.name} has no bodies to write")
        if path.suffix == ".vtu":
            write_vtu(fields, path)
            return path
        states, last = [], int(self.case.params.get("step", 1))
        for step in range(1, last):
            params = {**self.case.params, "step": step}
            name, family = self.case.id.family_name, self.case.id.family
            case_id = assemble(name, family, params, self.case.form)
            earlier = solve(
                Case(id=case_id, registries=self.case.registries),
                self.solver,
                self.record.tol,
                options=self.options,
            )
            if not earlier.has_point:
                raise InputError(
                    f"{path}: the solver returned no point at step {step}; "
                    "expected FILE.vtu, which needs only the last step"
                )
            states.append((float(step), earlier.fields()))
        write_series([*states, (float(last), fields)], path)
        return path

    def __repr__(self) -> str:
        notes = (f"note: {text}" for text in self.remarks)
        return "\n".join([outcome(self.record, self.options), *notes])


@TURN
@ended_by_signals()
def solve(
    case: Annotated[object, "CASE"],
    solver: Annotated[str | Solver, "--solver NAME"],
    tol: Annotated[float, "T"] = 1e-8,
    *,
    options: Mapping[str, Any] | None = None,
    plugins: Plugins = (),
    ranks: Annotated[int, "--mpi --ranks N"] = 1,
    time_limit: Annotated[float, "SECONDS"] = TIME_LIMIT,
    registries: Registries | None = None,
    **more: Any,
) -> Answer:
    """Run one solver on one case in a separate process, and verify its answer.

    A solver object is copied into that process by cloudpickle. The class of the object
    may be defined in a notebook, a script or a module. Its attributes must be
    picklable, which excludes open files, locks and handles of C libraries.

    Parameters
    ----------
    case : FAMILY/key=value/…/FORM, such as beam-ring/Nr=4/Nh=3/dual; see docs/cases.md.
        In Python also a case of `build`, a QP, or a problem of qpsolvers or cvxpy
    solver : a name from `list solvers`. In Python also an object with the methods
        `declines` and `prepare`
    tol : requested relative KKT accuracy
    options : options of the solver that differ from its defaults; a text is converted
        to the type of the option. A solver with an option ``history`` records its
        iterations unless ``history = False`` is passed
    plugins : Python files with more solvers or families
    ranks : number of MPI processes that jointly solve the case; more than 1 only for
        cases that are decomposed into subdomains
    time_limit : limit for the solve in s
    registries : used for a name instead of built-in registries, installed plug-ins and
        `plugins`
    more : further options of the solver, as keyword arguments

    Raises
    ------
    InputError
        If there is no such case, solver or option, the case cannot be built, the
        solver cannot be copied, or `ranks` exceeds 1 and MPI is not installed.
    FaultError
        If something other than the solver prevents the measurement.

    Examples
    --------
    >>> import mortarbench as mb
    >>> answer = mb.solve("beam-ring/Nr=4/Nh=3/steps=1/dual", "osqp", tol=1e-6)
    >>> str(answer.verdict), max(answer.residuals) <= 1e-5
    ('verified', True)
    >>> str(mb.solve(answer.case, "osqp", max_iter=25).verdict)
    'iteration_limit'

    """
    tol = checked.tolerance(tol)
    requested = _merged(options, more)
    if not isinstance(solver, str):
        with checked.located("solver"):
            check_solver(solver)
    if not isinstance(case, str):
        case = as_case(case, plugins)
        registries = case.registries
    registries = load_registries(plugins, registries)
    if isinstance(case, str):
        family_name(case, registries.families)
    ranks_asked(ranks, "ranks")
    time_limit = checked.positive("time_limit", time_limit)
    if isinstance(solver, str):
        check_name(solver, registries.solvers)
        name, solvers = solver, registries.solvers
    else:
        name = type(solver).__name__
        solvers = {name: solver}
    spec = SolverSpec(name=name, label=name, options=requested).on(ranks)
    declined = ""
    if ranks > 1:
        named = as_case(case, registries=registries).id
        divided = named.family.divided(named.form)
        parts = 1 if divided is None else divided.subdomains
        declined = too_few_parts(parts, ranks) if parts < ranks else ""
    solution: Solution | None = None
    notes: tuple[str, ...] = ()
    with ExitStack() as stack:
        if not declined:
            command = partial(registries.worker_command, spec, records=True)
            copied = None
            if not isinstance(solver, str):
                copied = resolve(with_history(spec, solvers), solvers)
            # The worker imports its libraries while this process imports its own.
            worker = stack.enter_context(single_worker(command, copied))
        defer_parts_of_numpy()
        problem = as_case(case, registries=registries)

        from mortarbench.harness.environment.environment import digest
        from mortarbench.harness.verify.verdicts import new_record

        spec = with_history(spec, solvers)
        record = new_record(
            problem.id,
            spec,
            options=options_of(resolve(spec, solvers)),
            tol=tol,
            repeat=0,
            environment=digest(registries.environment()),
        )
        if declined:
            record = record.replace(status=Verdict.DECLINED, message=declined)
        else:
            own = isinstance(solver, str) and registries.hold_only_builtins()
            record, solution, notes = _measured(
                worker, problem, record, own, time_limit
            )
    return Answer(
        case=problem,
        record=record,
        solution=solution,
        solver=solver,
        options=requested,
        remarks=notes,
    )


def _measured(
    worker: WorkerProcess, problem: Case, record: Record, own: bool, time_limit: float
) -> tuple[Record, Solution | None, tuple[str, ...]]:
    """Measure once; return the record, the answer, and remarks."""
    from mortarbench.harness.processes.measurement import measure_once
    from mortarbench.verification import remarks

    # Code of a family may print, and standard output is reserved for the answer
    with one_thread(), redirect_stdout(stderr):
        record, solution = measure_once(
            worker,
            lambda: problem.family_case,
            record,
            own_code_only=own,
            time_limit=time_limit,
        )
        # remarks on the input are known only if this process has built the case
        notes = problem.remarks if "family_case" in vars(problem) else ()
        return record, solution, (*notes, *remarks(problem, record, solution))


def check_scale(scale: float) -> float:
    """Check a magnification of displacements, and return it.

    Raises
    ------
    InputError
        If `scale` is NaN or its absolute value exceeds `MAX_SCALE`.

    """
    if not abs(scale) <= MAX_SCALE:  # unlike `>`, this also rejects NaN
        raise InputError(
            f"scale = {scale:g}; expected a number of magnitude at most {MAX_SCALE:g}"
        )
    return scale


def _merged(options: object, more: Mapping[str, Any]) -> dict[str, Any]:
    """Merge the options of a solver from a mapping, or None, and from keywords."""
    options = {} if options is None else options
    if not isinstance(options, Mapping) or not all(isinstance(k, str) for k in options):
        raise InputError(
            f"options = {shown(options)}; expected a dict that maps names to values, "
            f"such as {{'max_iter': 50}}"
        )
    if twice := sorted(options.keys() & more.keys()):
        raise InputError(
            f"option {twice[0]!r} is given twice: in `options` and as a keyword"
        )
    return {**options, **more}
