"""Functions that solve a case and verify the answer, or verify a given point."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout, suppress
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path
from sys import stderr
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from mortarbench.arguments import (
    ARCHIVES,
    GRIDS,
    PICTURES,
    check_output_file,
    check_scale,
    solver_options,
    tolerance,
)
from mortarbench.case import Case, as_case, build_case
from mortarbench.harness import (
    QP,
    Fields,
    Record,
    Residuals,
    Solution,
    Solver,
    Verdict,
    checked,
)
from mortarbench.harness.distributed.mpi import ranks_asked, too_few_parts
from mortarbench.harness.environment.environment import digest
from mortarbench.harness.errors import InputError
from mortarbench.harness.files.npz import write_mappable
from mortarbench.harness.files.store import POINT
from mortarbench.harness.names import assemble
from mortarbench.harness.processes.measurement import (
    measure_once,
    scratch_folder,
    single_worker,
)
from mortarbench.harness.processes.protocol import Source
from mortarbench.harness.processes.solver_file import write_solver
from mortarbench.harness.processes.termination import ended_by_signals
from mortarbench.harness.qp import Vector, numeric_vector
from mortarbench.harness.record import finite
from mortarbench.harness.registry import SolverSpec, check_solver, options_of, resolve
from mortarbench.harness.solution import History
from mortarbench.harness.verify.kkt import (
    Normality,
    allowed,
    kkt_residuals,
    normality,
    verdict,
)
from mortarbench.harness.verify.multipliers import with_multipliers
from mortarbench.harness.verify.verdicts import has_point, new_record, plain
from mortarbench.registries import TURN, Plugins, Registries, one_thread
from mortarbench.text import outcome, outcome_rows

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from numpy.typing import ArrayLike


#: Certified relative error in the energy norm above which `remarks` returns a remark on
#: a verified answer.
MAX_CERTIFIED_ERROR = 0.01
#: Largest sum of contact forces, relative to the sum of loads, at which bodies count as
#: not in contact. Interior-point methods return forces of about 1e-8 at open contacts;
#: forces at closed contacts are far larger.
MAX_OPEN_FORCE = 1e-6
TIME_LIMIT = 300.0  #: default time limit of `solve`, in s


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Answer:
    """Answer of a solver to a case, with the verdict of the harness."""

    case: Case
    record: Record  #: measurement, as in a line of a journal
    #: point and claim of the solver; None if its process ended without an answer
    solution: Solution | None
    spec: SolverSpec  #: name and options of the solver
    solver: str | Solver  #: name or object, as passed to `solve`
    defaults: Mapping[str, Any]  #: default options of the solver
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
        return self.solution is not None and has_point(self.solution)

    @property
    def normality(self) -> Normality | None:
        """Additional error measures for discs and cones.

        None if the QP has no such sets, the case has not been built in this process, or
        the solver returned no point.
        """
        if "family_case" not in vars(self.case) or not self.has_point:
            return None
        assert self.solution is not None
        with one_thread():
            qp = self.case.family_case.qp
            return normality(qp, self.solution, allowed(self.record.tol))

    def to_dict(self) -> dict[str, Any]:
        """Return the record, the history and the remarks as plain data.

        The values of `normality` are included unless it is None.
        """
        history = finite(plain(self.history))
        further = self.normality
        return {
            **json.loads(self.record.to_json()),
            **({} if further is None else finite(further._asdict())),
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
        from mortarbench.reports.figures.deformed import deformed_figure
        from mortarbench.reports.figures.maps import traction_maps
        from mortarbench.reports.figures.tractions import traction_figure
        from mortarbench.reports.render.saving import draw, save

        fields = self.fields()
        drawn = None if scale is None else check_scale(scale)
        figure = (
            deformed_figure(fields, drawn)
            if len(fields.cells)
            else traction_figure(fields) or traction_maps(fields)
        )
        if figure is None:
            raise InputError("no picture: the case has neither bodies nor tractions")
        if path is None:
            return draw(figure)
        return save(figure, check_output_file(path, PICTURES))

    def save(self, path: str | Path) -> Path:
        """Write x, y, z and z_box and, for bodies, displacements to an npz file.

        The displacements (N, dim) of the nodes at the reference positions `points`
        (N, dim) are in m.

        Raises
        ------
        InputError
            If the answer has no point, or the file cannot be written.

        """
        path = check_output_file(path, ARCHIVES)
        if self.solution is None or not self.has_point:
            raise InputError(f"{path}: {self.record.solver} returned no point")
        arrays = {name: getattr(self.solution, name) for name in POINT}
        if self.case.family_case.fields is not None:
            fields = self.fields()
            arrays |= {"points": fields.points, "displacements": fields.displacement}
        try:
            write_mappable(path, arrays)
        except OSError as e:
            raise InputError(f"{path}: cannot be written: {e.strerror}") from None
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

        path, fields = check_output_file(path, GRIDS), self.fields()
        if not len(fields.cells):
            raise InputError(f"{path}: {self.case.name} has no bodies to write")
        if path.suffix == ".vtu":
            write_vtu(fields, path)
            return path
        states, last = [], int(self.case.params.get("step", 1))
        for step in range(1, last):
            params = {**self.case.params, "step": step}
            case_id = assemble(self.case.id.family, params, self.case.form)
            earlier = solve(
                build_case(case_id, self.case.registries),
                self.solver,
                self.record.tol,
                options=self.spec.options,
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
        return "\n".join([outcome(self.record, self.defaults), *notes])

    def _repr_html_(self) -> str:
        rows = (
            f"<tr><th style='text-align:left'>{escape(name)}</th>"
            f"<td style='text-align:left'>{escape(value)}</td></tr>"
            for name, value in (
                *outcome_rows(self.record, self.defaults),
                *(("note", text) for text in self.remarks),
            )
        )
        return f"<table>{''.join(rows)}</table>"


def remarks(case: Case, record: Record, solution: Solution | None) -> tuple[str, ...]:
    """Return reasons to doubt a verified answer, one line each.

    Although the QP is solved, the certified bound may be large or infinite, or the
    model may be inadequate: no node or only one node is in contact, or displacements
    are too large for linear kinematics.
    """
    if record.status is not Verdict.VERIFIED or solution is None:
        return ()
    reasons = []
    bound = record.energy_bound
    if bound is not None and bound == np.inf:
        reasons.append(
            "the certificate does not bound the solver's error, because the "
            "displacements may be as small as rounding errors, or because a load may "
            "act on supports"
        )
    elif bound is not None and bound > MAX_CERTIFIED_ERROR:
        reasons.append(
            f"the solver's error is only certified to be at most {100 * bound:.2g} %; "
            "a smaller tolerance may give a smaller bound"
        )
    # An exception in a remark must not make the solve fail. Displacements may be
    # recovered by code of a plug-in, and if MPI ranks solved the QP, the case is not
    # built in this process.
    with suppress(Exception), one_thread():
        if _is_open(case, record, solution):
            reasons.append(
                "no node is in contact, so the answer is the same as without contact "
                "conditions; check the direction of the load and the initial gap"
            )
        elif _single_nodes(record):
            reasons.append(
                "a single node is in contact, so the computed pressure depends on the "
                "mesh width and grows on finer meshes; refine the mesh near the contact"
            )
        if record.quantities.get("undetermined_friction"):
            reasons.append(
                "friction forces are not unique: where supports or other contact rows "
                "prevent slip, other friction forces have the same displacements, so "
                "that sums such as friction_force depend on the solver; remove the "
                "friction or the supports along the contact"
            )
    with suppress(Exception), one_thread():
        reasons += _large_displacements(case, solution)
    return tuple(reasons)


def _of_input(case: Case) -> tuple[str, ...]:
    """Return the remarks on the input; () if only MPI ranks have built the case."""
    return case.remarks if "family_case" in vars(case) else ()


def _single_nodes(record: Record) -> bool:
    """Return True if a pair with several rows is in contact at a single node."""
    pairs = record.quantities.get("contacts", {}).values()
    return any(pair.get("active") == 1 for pair in pairs) and (
        record.quantities["contact_rows"] > len(pairs)
    )


def _is_open(case: Case, record: Record, solution: Solution) -> bool:
    """Return True if contact forces sum to at most `MAX_OPEN_FORCE` times the loads."""
    if not record.quantities.get("contact_rows"):
        return False
    if record.quantities.get("active") == 0:
        return True
    mechanics = case.family_case.mechanics if "family_case" in vars(case) else None
    if mechanics is None:
        return False
    normal = mechanics.to_primal(solution).z[: mechanics.primal.h.size]
    load = np.abs(mechanics.primal.q).sum()
    return bool(np.abs(normal).sum() <= MAX_OPEN_FORCE * load)


def _large_displacements(case: Case, solution: Solution) -> Iterator[str]:
    """Yield a remark if, in linear kinematics, a body moves by more than its size."""
    if "family_case" not in vars(case) or case.params.get("kinematics") == "finite":
        return
    mechanics = case.family_case.mechanics
    if mechanics is None or mechanics.grid is None:
        return
    grid, u = mechanics.grid, case.family_case.recover(solution)
    lengths = np.linalg.norm(u.reshape(grid.points.shape), axis=1)
    worst, text = 1.0, ""
    for body in np.unique(grid.bodies):
        nodes = np.unique(grid.cells[grid.bodies == body])
        size = float(np.ptp(grid.points[nodes], axis=0).max())
        if lengths[nodes].max() > worst * size:
            worst = float(lengths[nodes].max()) / size
            name = repr(mechanics.names[body]) if mechanics.names else str(body)
            text = (
                f"body {name} moves by up to {lengths[nodes].max():.3g} m, which "
                f"exceeds its size of {size:.3g} m; linear kinematics is valid only "
                "for small displacements: check the moduli, the loads and the supports"
            )
    if text:
        yield text


@TURN
@ended_by_signals()
def solve(
    case: Case | QP | str | object,
    solver: str | Solver,
    tol: float = 1e-8,
    *,
    options: Mapping[str, Any] | None = None,
    plugins: Plugins = (),
    ranks: int = 1,
    time_limit: float = TIME_LIMIT,
    **more: Any,
) -> Answer:
    """Run one solver on one case in a separate process, and verify its answer.

    A solver object is copied into that process by cloudpickle. The class of the object
    may be defined in a notebook, a script or a module. Its attributes must be
    picklable, which excludes open files, locks and handles of C libraries.

    Parameters
    ----------
    case : a case of `build`, its name, a QP, or a problem of qpsolvers or cvxpy
    solver : a name listed by `solvers`, or an object with the methods `declines` and
        `prepare`
    tol : requested relative KKT accuracy
    options : options of the solver that differ from its defaults. A solver with an
        option ``history`` records its iterations unless ``history = False`` is passed
    plugins : Python files with more solvers or families
    ranks : number of MPI processes that jointly solve the case
    time_limit : limit for the solve, in s
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
    tol = tolerance(tol)
    options = solver_options(options, more)
    check_solver(solver)
    problem = as_case(case, plugins)
    ranks_asked(ranks, "ranks")
    session = solver_session(
        solver,
        problem.registries,
        options,
        ranks=ranks,
        time_limit=checked.positive("time_limit", time_limit),
    )
    with session as answer:
        return answer(problem, tol)


@contextmanager
def solver_session(
    solver: str | Solver,
    registries: Registries,
    options: Mapping[str, Any] | None = None,
    *,
    ranks: int = 1,
    time_limit: float = TIME_LIMIT,
) -> Iterator[Callable[[Case, float], Answer]]:
    """Start a solver process; yield a function that solves a case to a tolerance.

    solver, options, ranks, time_limit : see `solve`
    registries : registries that contain the solver; the process loads the same plug-ins

    Raises
    ------
    InputError
        If there is no such solver or option.

    """
    requested = solver_options(options)
    if isinstance(solver, str):
        name, solvers = solver, registries.solvers
    else:
        name = type(solver).__name__
        solvers = {name: solver}
    spec = SolverSpec(name=name, label=name, options=requested).on(ranks)
    configured = resolve(spec, solvers)
    defaults = options_of(resolve(SolverSpec(name=name, label=name), solvers))
    if options_of(configured).get("history") is False and "history" not in requested:
        # Recording the history slows down the solver, but times of single solves are
        # not used in comparisons.
        defaults = {**defaults, "history": True}
        spec = replace(spec, options={**requested, "history": True})
        configured = resolve(spec, solvers)
    environment = digest(registries.environment())

    def answer(case: Case, tol: float) -> Answer:
        record = new_record(
            case.id,
            spec,
            options=options_of(configured),
            tol=tol,
            repeat=0,
            environment=environment,
        )
        source = Source.FILE
        if ranks > 1:
            ours = registries.hold_only_builtins()
            source = Source.RANKS if ours else Source.SHARES
            parts = case.id.family.subdomains(case.id.form, case.id.params)
            if parts < ranks:
                record = record.replace(
                    status=Verdict.DECLINED, message=too_few_parts(parts, ranks)
                )
                return Answer(
                    case=case,
                    record=record,
                    solution=None,
                    spec=spec,
                    solver=solver,
                    defaults=defaults,
                )
        # Code of a family may print, and standard output is reserved for the answer.
        with one_thread(), redirect_stdout(stderr):
            record, solution = measure_once(
                worker,
                lambda: case.family_case,
                record,
                registries.reference,
                source=source,
                time_limit=time_limit,
            )
        return Answer(
            case=case,
            record=record,
            solution=solution,
            spec=spec,
            solver=solver,
            defaults=defaults,
            remarks=(*_of_input(case), *remarks(case, record, solution)),
        )

    with scratch_folder() as scratch:
        copy = None if isinstance(solver, str) else scratch / "solver.pickle"
        if copy is not None:
            write_solver(copy, configured)
        with single_worker(registries.worker_command(spec, copy)) as worker:
            yield answer


class Multipliers(NamedTuple):
    """Multipliers with the signs of P x + q + Aᵀy + Gᵀz + z_box = 0, as in `QP`."""

    y: Vector  #: (m,) multipliers of A x = b
    z: Vector  #: (p,) multipliers of G x ≤ h
    z_box: Vector  #: (n,) multipliers of the bounds


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Verification:
    """Verdict of `verify` on a point."""

    verdict: Verdict  #: `verified` or, if the point is refuted, `inaccurate` or `wrong`
    residuals: Residuals  #: relative KKT residuals
    #: multipliers passed to `verify`; those left out are computed
    multipliers: Multipliers
    objective: float  #: ½xᵀPx + qᵀx
    #: additional error measures for discs and cones; None if the QP has no such sets
    normality: Normality | None
    tol: float  #: relative KKT accuracy, as passed to `verify`

    def __repr__(self) -> str:
        values = self.residuals._asdict().items()
        error = ", ".join(f"{name} {value:.2g}" for name, value in values)
        return f"<{self.verdict}: {error}; allowed {allowed(self.tol):.2g}>"


def verify(
    qp: QP | Case | str | object,
    x: ArrayLike,
    y: ArrayLike | None = None,
    z: ArrayLike | None = None,
    z_box: ArrayLike | None = None,
    tol: float = 1e-8,
) -> Verification:
    """Verify a point by its KKT residuals, as the harness verifies answers of solvers.

    Multipliers that are left out minimise the residuals in a linear program over the
    nearly active rows, bounds and sets, see `harness.verify.multipliers`. If the
    residuals are large even with these multipliers, the point is refuted.

    Parameters
    ----------
    qp : a QP, a case of `build`, its name, or a problem of qpsolvers or cvxpy
    x : (n,) point
    y, z, z_box : multipliers of A x = b, G x ≤ h and the bounds, if known
    tol : relative KKT accuracy; a point is verified if every residual is at most
        10·tol (and at most 0.1), see docs/verdicts.md

    Raises
    ------
    InputError
        If the size of a vector does not match the QP, or multipliers are left out and
        the QP is too large to compute them.

    Examples
    --------
    >>> import mortarbench as mb
    >>> qp = mb.QP.from_arrays([[2.0, 0.0], [0.0, 2.0]], [-2.0, 2.0], lb=[0.0, 0.0])
    >>> str(mb.verify(qp, [1.0, 0.0]).verdict), str(mb.verify(qp, [0.9, 0.0]).verdict)
    ('verified', 'wrong')

    """
    tol = tolerance(tol)
    case = as_case(qp)
    problem = case.family_case.qp
    sizes = {"x": problem.q, "y": problem.b, "z": problem.h, "z_box": problem.q}
    arguments = {"x": x, "y": y, "z": z, "z_box": z_box}
    vectors = {
        name: numeric_vector(name, v, sizes[name].size)
        for name, v in arguments.items()
        if v is not None or name == "x"
    }
    with one_thread():
        s = with_multipliers(problem, **vectors)
        with np.errstate(all="ignore"):  # x may contain NaN or 1e300
            residuals, objective = kkt_residuals(problem, s), problem.objective(s.x)
    return Verification(
        verdict=verdict(s.status, residuals, tol),
        residuals=residuals,
        multipliers=Multipliers(s.y, s.z, s.z_box),
        objective=objective,
        normality=normality(problem, s, allowed(tol)),
        tol=tol,
    )
