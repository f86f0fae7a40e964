"""One solver on one case, once: its answer, measured in a process and judged."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass, replace
from functools import partial
from html import escape
from pathlib import Path
from sys import stderr
from typing import TYPE_CHECKING, Any

from harness import Fields, Record, Residuals, Solution, Verdict
from harness.distributed.mpi import ranks_asked
from harness.environment.environment import digest
from harness.errors import InputError
from harness.names import assemble, emitted_by_ranks, parse
from harness.processes.measurement import measured_once, single_worker
from harness.record import finite
from harness.registry import PluginFile, SolverSpec, options_of, resolve
from harness.solution import History
from harness.verify.verdicts import has_point, new_record, plain
from mortarbench.arguments import (
    GRIDS,
    PICTURES,
    drawn_scale,
    tolerance,
    writable,
)
from mortarbench.case import Case, built_case
from mortarbench.registries import Plugins, Registries, known, one_thread
from mortarbench.text import outcome, outcome_rows

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Answer:
    """What a solver answered, and what we make of it."""

    case: Case
    record: Record  #: the measurement, as a line of a journal
    solution: Solution | None  #: point and claim; None where the process ended
    spec: SolverSpec
    defaults: Mapping[str, Any]  #: options that the solver has if none are given

    @property
    def verdict(self) -> Verdict:
        """Our judgement, whatever the solver claimed."""
        return self.record.verdict

    @property
    def residuals(self) -> Residuals | None:
        """Relative KKT residuals, evaluated by us; None where there is no point."""
        r = self.record
        if r.primal is None or r.dual is None:
            return None
        if r.complementarity is None or r.gap is None:
            return None
        return Residuals(r.primal, r.dual, r.complementarity, r.gap)

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
        """Plain data for JSON: the record, and the history of the iterations."""
        history = finite(plain(self.history))
        return {**json.loads(self.record.to_json()), "history": history}

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

    def plot(self, path: str | Path | None = None, *, scale: float = 1.0) -> Figure:
        """Draw the deformed bodies with their stresses, and each contact enlarged.

        Of half planes, which have no ends, the tractions between them.

        path : of a file to write, too: .png, .pdf or .svg
        scale : of the displacement, as drawn

        Raises
        ------
        InputError
            As `fields`; when the file cannot be written, or the scale is no number.

        """
        from reports.figures.deformed import deformed_figure
        from reports.figures.tractions import traction_figure
        from reports.render.saving import draw, save

        fields, drawn = self.fields(), drawn_scale(scale)
        figure = (
            deformed_figure(fields, drawn)
            if len(fields.cells) else traction_figure(fields)
        )  # fmt: skip
        if figure is None:
            raise InputError("no bodies and no tractions: there is no picture")
        if path is not None:
            save(figure, writable(Path(path), PICTURES))
        return draw(figure)

    def save_vtu(self, path: str | Path) -> Path:
        """Write the deformed bodies for ParaView: .vtu, or .pvd with all load steps.

        Raises
        ------
        InputError
            As `fields`; when the file cannot be written, or an earlier load step has
            no point.

        """
        from reports.export.vtu import write_series, write_vtu

        path, fields = writable(Path(path), GRIDS), self.fields()
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
                self.spec.name,
                tol=self.record.tol,
                options=self.spec.options,
            )
            if not earlier.has_point:
                raise InputError(f"{path}: no point at step {step}; write a .vtu")
            states.append((float(step), earlier.fields()))
        write_series([*states, (float(last), fields)], path)
        return path

    def __repr__(self) -> str:
        return outcome(self.record, self.defaults)

    def _repr_html_(self) -> str:
        rows = (
            f"<tr><th style='text-align:left'>{escape(name)}</th>"
            f"<td style='text-align:left'>{escape(value)}</td></tr>"
            for name, value in outcome_rows(self.record, self.defaults)
        )
        return f"<table>{''.join(rows)}</table>"


def solve(
    case: Case | str,
    solver: str,
    *,
    tol: float = 1e-8,
    options: Mapping[str, Any] | None = None,
    plugins: Plugins = (),
    ranks: int = 1,
) -> Answer:
    """Run one solver on one case, once, in a process of its own, and judge its answer.

    Parameters
    ----------
    case : what `build` returned, or a name
    solver : a name of `solvers`
    tol : relative KKT accuracy asked for
    options : of the solver, that differ from its defaults. A solver that can tell of
        its iterations does, unless they say ``history = False``
    plugins : Python files with more solvers or families
    ranks : processes of MPI that solve it together

    Raises
    ------
    InputError
        When there is no such case, solver or option, or the case cannot be built; when
        ranks are asked for and there is no MPI.

    """
    tolerance(tol)
    if isinstance(case, str):
        registries = known(plugins)
        case = Case(id=parse(case, registries.families), registries=registries)
    else:
        registries = case.registries
        held = {file.resolved() for file in registries.files}
        asked = map(PluginFile.of, plugins)
        registries = registries.with_files(
            [file for file in asked if file.resolved() not in held]
        )
    ranks_asked(ranks, "ranks")
    with answers_of(solver, registries, options, ranks=ranks) as answer:
        return answer(case, tol)


@contextmanager
def answers_of(
    solver: str,
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
    given = dict(options or {})
    spec = SolverSpec(name=solver, label=solver, options=given).on(ranks)
    configured = resolve(spec, registries.solvers)
    plainly = SolverSpec(name=solver, label=solver)
    defaults = options_of(resolve(plainly, registries.solvers))
    if options_of(configured).get("history") is False and "history" not in given:
        # what telling costs is not at stake where nothing is compared
        defaults = {**defaults, "history": True}
        spec = replace(spec, options={**given, "history": True})
        configured = resolve(spec, registries.solvers)
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
        emits = ranks > 1 and emitted_by_ranks(case.id)
        with one_thread(), redirect_stdout(stderr):  # whatever the family prints
            record, solution = measured_once(
                worker, lambda: case.made, record, registries.reference,
                emits=emits, evaluates=emits and registries.hold_own_code_only(),
            )  # fmt: skip
        return Answer(
            case=case, record=record, solution=solution, spec=spec, defaults=defaults
        )

    command = registries.worker_command(spec)
    work = None
    if forks and ranks == 1:
        from harness.processes.worker import serve  # late: few need it here

        work = partial(serve, configured)
    with single_worker(command, work) as worker:
        yield answer
