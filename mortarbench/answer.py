"""One answer to one case: of a solver, measured in a process, or from elsewhere."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout, suppress
from dataclasses import dataclass, replace
from functools import partial
from html import escape
from pathlib import Path
from sys import stderr
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from mortarbench.arguments import (
    GRIDS,
    PICTURES,
    drawn_scale,
    solver_options,
    tolerance,
    writable,
)
from mortarbench.case import Case, as_case, built_case
from mortarbench.harness import QP, Fields, Record, Residuals, Solution, Solver, Verdict
from mortarbench.harness.distributed.mpi import ranks_asked
from mortarbench.harness.environment.environment import digest
from mortarbench.harness.errors import InputError
from mortarbench.harness.names import assemble, is_shared
from mortarbench.harness.processes.measurement import (
    measured_once,
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
from mortarbench.harness.verify.kkt import allowed, kkt_residuals, verdict
from mortarbench.harness.verify.multipliers import with_multipliers
from mortarbench.harness.verify.optimum import decided, proves
from mortarbench.harness.verify.verdicts import has_point, new_record, plain
from mortarbench.registries import TURN, Plugins, Registries, one_thread
from mortarbench.text import outcome, outcome_rows

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from numpy.typing import ArrayLike

    from mortarbench.harness.crossval.discretisation import Discretisation

LOOSE = 0.01  #: certified relative error above which a verified answer has a remark
#: sum of the contact forces, relative to that of the loads, up to which there is no
#: contact: interior points end at 1e-8 or so of their scale, a closed contact far above
UNFELT_FORCE = 1e-6


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Answer:
    """What a solver answered, and what we make of it."""

    case: Case
    record: Record  #: the measurement, as a line of a journal
    solution: Solution | None  #: point and claim; None where the process ended
    spec: SolverSpec
    solver: str | Solver  #: as given to `solve`: a name or an object
    defaults: Mapping[str, Any]  #: options that the solver has if none are given
    remarks: tuple[str, ...] = ()  #: reasons to doubt what is verified, a line each

    @property
    def verdict(self) -> Verdict:
        """Our judgement, whatever the solver claimed."""
        return self.record.verdict

    @property
    def residuals(self) -> Residuals | None:
        """Relative KKT residuals, evaluated by us; None where there is no point."""
        found: list[Any] = [getattr(self.record, name) for name in Residuals._fields]
        return None if None in found else Residuals(*found)

    @property
    def energy_bound(self) -> float | None:
        """Certified bound of the error, relative, in the energy norm; None: unknown."""
        return self.record.energy_bound

    @property
    def quantities(self) -> Mapping[str, Any]:
        """Physical results, SI."""
        return self.record.quantities

    @property
    def history(self) -> History:
        """What the solver told of its iterations: columns, a row per iteration."""
        return {} if self.solution is None else self.solution.history

    @property
    def has_point(self) -> bool:
        """Whether there is a point to look at."""
        return self.solution is not None and has_point(self.solution)

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON: the record, the history of the iterations, remarks."""
        history = finite(plain(self.history))
        return {
            **json.loads(self.record.to_json()),
            "history": history,
            "remarks": [*self.remarks],
        }

    def mesh_error(self, budget: float = 60.0) -> Discretisation:
        """Estimate the error of the mesh, to which that of the solver adds.

        Solves the case on finer meshes by the reference, not by the solver.

        budget : s; a mesh that would take longer than what is left is not begun
        """
        from mortarbench.harness.crossval.discretisation import discretisation_errors

        with TemporaryDirectory() as folder:
            (found,) = discretisation_errors(
                [self.case.id], self.case.registries.reference, Path(folder), budget
            )
        return found

    def fields(self) -> Fields:
        """Give the deformed bodies.

        Raises
        ------
        InputError
            When the case has no bodies, or the answer no point.

        """
        if self.solution is None or not self.has_point:
            raise InputError(f"no picture: {self.record.solver} returned no point")
        return self.case.fields(self.solution)

    def plot(
        self, path: str | Path | None = None, *, scale: float | None = None
    ) -> Figure:
        """Draw the deformed bodies with their stresses, and each contact enlarged.

        Of half planes, which have no ends, the tractions between them.

        path : of a file to write, too: .png, .pdf or .svg
        scale : of the displacement, as drawn; None: 1 where that can be seen, else a
            round factor that the title states

        Raises
        ------
        InputError
            As `fields`; when the file cannot be written, or the scale is no number.

        """
        from mortarbench.reports.figures.deformed import deformed_figure
        from mortarbench.reports.figures.tractions import traction_figure
        from mortarbench.reports.render.saving import draw, save

        fields = self.fields()
        drawn = None if scale is None else drawn_scale(scale)
        figure = (
            deformed_figure(fields, drawn)
            if len(fields.cells) else traction_figure(fields)
        )  # fmt: skip
        if figure is None:
            raise InputError("no bodies and no tractions: there is no picture")
        if path is not None:
            save(figure, writable(path, PICTURES))
        return draw(figure)

    def save_vtu(self, path: str | Path) -> Path:
        """Write the deformed bodies for ParaView: .vtu, or .pvd with all load steps.

        Raises
        ------
        InputError
            As `fields`; when the file cannot be written, or an earlier load step has
            no point.

        """
        from mortarbench.reports.export.vtu import write_series, write_vtu

        path, fields = writable(path, GRIDS), self.fields()
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
                built_case(case_id, self.case.registries),
                self.solver,
                self.record.tol,
                options=self.spec.options,
            )
            if not earlier.has_point:
                raise InputError(f"{path}: no point at step {step}; write a .vtu")
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
    """Return the reasons why a person may doubt a verified answer, a line each.

    The QP is solved; its certificate may bound little, and the QP may not be what was
    meant: no contact, or displacements that linear kinematics does not describe.
    """
    if record.verdict is not Verdict.VERIFIED or solution is None:
        return ()
    found = []
    bound = record.energy_bound
    if bound is not None and bound == np.inf:
        found.append(
            "the certificate does not bound the solver's error: the displacements may "
            "be as small as rounding, or a load may act on supports"
        )
    elif bound is not None and bound > LOOSE:
        found.append(
            f"the solver's error is certified to be at most {100 * bound:.2g} % only; "
            "a smaller tolerance may bound it better"
        )
    # on ranks nothing is built here; a plug-in's code may fail
    with suppress(Exception), one_thread():
        if _is_open(case, record, solution):
            found.append(
                "no node is in contact: the sides stay apart, and the answer is that "
                "of bodies without contact; see the direction of the load, and the gap"
            )
    with suppress(Exception), one_thread():
        found += _large_displacements(case, solution)
    return tuple(found)


def _is_open(case: Case, record: Record, solution: Solution) -> bool:
    """Return True if no contact row presses, but for forces of rounding size."""
    if not record.quantities.get("contact_rows"):
        return False
    if record.quantities.get("active") == 0:
        return True
    mechanics = case.made.mechanics if "made" in vars(case) else None
    if mechanics is None:
        return False
    normal = mechanics.to_primal(solution).z[: mechanics.primal.h.size]
    load = np.abs(mechanics.primal.q).sum()
    return bool(np.abs(normal).sum() <= UNFELT_FORCE * load)


def _large_displacements(case: Case, solution: Solution) -> Iterator[str]:
    """Yield a remark if a body moves by more than its size, with linear kinematics."""
    if "made" not in vars(case) or case.params.get("kinematics") == "finite":
        return
    mechanics = case.made.mechanics
    if mechanics is None or mechanics.grid is None:
        return
    grid, u = mechanics.grid, case.made.recover(solution)
    if u.size != grid.points.size:
        return  # a height, as of membranes, is not a motion along the mesh
    moved = np.linalg.norm(u.reshape(grid.points.shape), axis=1)
    worst, text = 1.0, ""
    for body in np.unique(grid.bodies):
        nodes = np.unique(grid.cells[grid.bodies == body])
        size = float(np.ptp(grid.points[nodes], axis=0).max())
        if moved[nodes].max() > worst * size:
            worst = float(moved[nodes].max()) / size
            name = repr(mechanics.names[body]) if mechanics.names else str(body)
            text = (
                f"body {name} moves by up to {moved[nodes].max():.3g} m and is "
                f"{size:.3g} m large; linear kinematics describes small displacements: "
                "see the moduli, the loads and the supports"
            )
    if text:
        yield text


@TURN
@ended_by_signals()
def solve(
    case: Case | QP | str,
    solver: str | Solver,
    tol: float = 1e-8,
    *,
    options: Mapping[str, Any] | None = None,
    plugins: Plugins = (),
    ranks: int = 1,
    **more: Any,
) -> Answer:
    """Run one solver on one case, once, in a process of its own, and judge its answer.

    A solver that is an object is copied into that process by cloudpickle. Its class may
    stand in a notebook, a script or a module; what it refers to must allow pickling: no
    open files, locks or handles of a C library in its attributes.

    Parameters
    ----------
    case : a case of `build`, its name, or a QP
    solver : a name of `solvers`, or an object with the methods `declines` and `prepare`
    tol : relative KKT accuracy asked for
    options : of the solver, where they differ from its defaults. A solver that records
        its iterations does, unless they contain ``history = False``
    plugins : Python files with more solvers or families
    ranks : processes of MPI that solve it together
    more : further options of the solver

    Raises
    ------
    InputError
        When there is no such case, solver or option, the case cannot be built, or the
        solver cannot be copied; when ranks are asked for and there is no MPI.

    """
    tol = tolerance(tol)
    options = solver_options(options, more)
    check_solver(solver)
    problem = as_case(case, plugins)
    ranks_asked(ranks, "ranks")
    with answers_of(solver, problem.registries, options, ranks=ranks) as answer:
        return answer(problem, tol)


@contextmanager
def answers_of(
    solver: str | Solver,
    registries: Registries,
    options: Mapping[str, Any] | None = None,
    *,
    forks: bool = False,
    ranks: int = 1,
) -> Iterator[Callable[[Case, float], Answer]]:
    """Give what has a solver solve a case to a tolerance, in a process of its own.

    solver, options : as of `solve`
    ranks : as of `solve`
    forks : whether that process may be a fork of this one, made now, if that is safe;
        see `harness.processes.forking`

    Raises
    ------
    InputError
        When there is no such solver or option.

    """
    given = solver_options(options)
    if isinstance(solver, str):
        name, solvers = solver, registries.solvers
    else:
        name = type(solver).__name__
        solvers = {name: solver}
    spec = SolverSpec(name=name, label=name, options=given).on(ranks)
    configured = resolve(spec, solvers)
    defaults = options_of(resolve(SolverSpec(name=name, label=name), solvers))
    if options_of(configured).get("history") is False and "history" not in given:
        # what telling costs is not at stake where nothing is compared
        defaults = {**defaults, "history": True}
        spec = replace(spec, options={**given, "history": True})
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
        if ranks > 1 and is_shared(case.id):
            ours = registries.hold_own_code_only()
            source = Source.RANKS if ours else Source.SHARES
        with one_thread(), redirect_stdout(stderr):  # whatever the family prints
            record, solution = measured_once(
                worker, lambda: case.made, record, registries.reference,
                source=source,
            )  # fmt: skip
        return Answer(
            case=case, record=record, solution=solution, spec=spec, solver=solver,
            defaults=defaults, remarks=remarks(case, record, solution),
        )  # fmt: skip

    work = None
    if forks and ranks == 1:
        from mortarbench.harness.processes.worker import serve  # late: few need it here

        work = partial(serve, configured)
    with scratch_folder() as scratch:
        copy = None if isinstance(solver, str) else scratch / "solver.pickle"
        if copy is not None:
            write_solver(copy, configured)
        with single_worker(registries.worker_command(spec, copy), work) as worker:
            yield answer


class Multipliers(NamedTuple):
    """Multipliers in the sign convention of `QP`: P x + q + Aᵀy + Gᵀz + z_box = 0."""

    y: Vector  #: (m,) of A x = b
    z: Vector  #: (p,) of G x ≤ h
    z_box: Vector  #: (n,) of the bounds


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Verification:
    """A judgement on a point from elsewhere."""

    verdict: Verdict  #: `verified`, or `inaccurate` or `wrong` where it is refuted
    residuals: Residuals  #: relative KKT residuals
    multipliers: Multipliers  #: as given; where left out, the best ones
    objective: float  #: ½xᵀPx + qᵀx
    optimum_error: float | None  #: against a proven optimum, where that decided
    tol: float  #: verified means every residual ≤ 10·tol, or as a proven optimum says

    def __repr__(self) -> str:
        if self.optimum_error is not None:
            found = f"off the proven optimum by {self.optimum_error:.2g}"
        else:
            values = self.residuals._asdict().items()
            found = ", ".join(f"{name} {value:.2g}" for name, value in values)
        return f"<{self.verdict}: {found}; allowed {allowed(self.tol):.2g}>"


def verify(
    qp: QP | Case | str,
    x: ArrayLike,
    y: ArrayLike | None = None,
    z: ArrayLike | None = None,
    z_box: ArrayLike | None = None,
    tol: float = 1e-8,
) -> Verification:
    """Judge a point from elsewhere by its KKT residuals, as answers of solvers are.

    Multipliers that are left out are computed by nonnegative least squares on the
    active rows and bounds, see `harness.verify.multipliers`. Residuals that they leave
    show that the point is not optimal to that accuracy.

    Parameters
    ----------
    qp : a QP, a case of `build`, or its name
    x : (n,) the point
    y, z, z_box : multipliers of A x = b, G x ≤ h and the bounds, where known
    tol : relative KKT accuracy; verified means that every residual is within 10·tol,
        or for small QPs the error against a proven optimum

    Raises
    ------
    InputError
        When a vector does not fit the QP, or there are too many multipliers to compute.

    """
    tol = tolerance(tol)
    case = as_case(qp)
    problem = case.made.qp
    sizes = {"x": problem.q, "y": problem.b, "z": problem.h, "z_box": problem.q}
    given = {"x": x, "y": y, "z": z, "z_box": z_box}
    known = {
        name: numeric_vector(name, v, sizes[name].size)
        for name, v in given.items()
        if v is not None or name == "x"
    }
    with one_thread():
        s = with_multipliers(problem, **known)
        with np.errstate(all="ignore"):  # a point may hold NaN or 1e300
            residuals, objective = kkt_residuals(problem, s), problem.objective(s.x)
        error = decided(problem, s, residuals, tol, proves(case.registries.reference))
    return Verification(
        verdict=verdict(s.status, residuals, tol, error=error),
        residuals=residuals,
        multipliers=Multipliers(s.y, s.z, s.z_box),
        objective=objective,
        optimum_error=error,
        tol=tol,
    )
