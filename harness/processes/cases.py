"""Cases that a worker builds and evaluates; the code of families runs here.

The requests and their answers are:

* ``{"build": NAME, "qp": PATH, "keep": N}`` builds the case and writes its QP to PATH.
  Answer: ``{"meta": {…}}``, the fields ``qp``, ``build_seconds`` and
  ``dualise_seconds`` of the record
* ``{"describe": NAME, "point": PATH, "fields": PATH or null, "keep": N}`` evaluates the
  point in the file ``point``. Answer: ``{"fields": {…}, "notes": […]}``, with the
  entries of the record that `harness.verify.verdicts.results_of` returns. If ``fields``
  is a path and the case defines a deformed state, this state is written to ``fields``

If a case cannot be built, the answer is ``{"unbuilt": REASON, "past_end": …}``;
``past_end`` is true if the case lies beyond the last problem of a sequence
(`PastEndError`). NAME is ``{"family": …, "params": {…}, "form": …, "name":
…}``; N is the number of cases to keep in memory. The map from a point to physical
quantities is code and cannot be stored in a file. A case whose QP is in the cache, but
which is not in memory, is therefore built again before a point is evaluated.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Any

from mortarbench.harness.errors import PastEndError
from mortarbench.harness.files.qpfile import save_qp
from mortarbench.harness.files.store import (
    digest_of,
    field_arrays,
    point_arrays,
    read_point,
    write_arrays,
)
from mortarbench.harness.names import CaseId, assemble, unbuilt
from mortarbench.harness.plugin import Case, Family, Reference
from mortarbench.harness.record import finite
from mortarbench.harness.solution import Status
from mortarbench.harness.verify.verdicts import note_of, results_of

#: The first dual case of a process is built again if its build took less than this
#: time, in s. Effects of first calls (page faults, caches, late imports) took 12 of the
#: 14 ms of dualising the smallest demo case, and imports alone may take a second.
#: Without a second build, the time of these effects would be charged to the dual form.
#: In a build of more than ten seconds, the effects are negligible, whereas a second
#: build would be expensive.
MAX_WARM_UP_SECONDS = 10.0


@dataclass(eq=False)
class Cases:
    """Cases of `families`, built with the injected `reference` solver."""

    families: Mapping[str, Family]
    reference: Reference
    #: cases in memory by canonical name, least recently used first
    _cases: dict[str, Case] = field(default_factory=dict)
    _build_seconds: float = 0.0  # duration of the last build, s
    _warm: bool = False  # True once a dual case has been built
    #: results and notes (see `results_of`) by case name and digest of the point, since
    #: most solvers return identical points in all repeats
    _results: dict[tuple[str, str], tuple[dict[str, Any], list[str]]] = field(
        default_factory=dict
    )

    def answer(self, request: dict[str, Any]) -> dict[str, Any]:
        """Answer one request; the reply reports failures of the family's code."""
        fields = request.get("build") or request["describe"]
        family = fields["family"]
        try:
            name = assemble(
                family, self.families[family], fields["params"], fields["form"]
            )
            case = self._case(name, request["keep"])
        except (Exception, SystemExit) as e:  # raised by code of the family
            return {
                "unbuilt": unbuilt(fields["name"], e),
                "past_end": isinstance(e, PastEndError),
            }
        if "build" in request:
            return self._write(case, name, Path(request["qp"]))
        return self._describe(case, name, request)

    def _describe(
        self, case: Case, name: CaseId, request: dict[str, Any]
    ) -> dict[str, Any]:
        s = read_point(Path(request["point"]), Status.SOLVED)
        key = name.name, digest_of(point_arrays(s))
        if key not in self._results:
            self._results[key] = results_of(case, s)
        results, texts = self._results[key]
        notes = [*filter(None, texts)]
        if request["fields"] is not None and case.fields is not None:
            try:
                fields = field_arrays(case.fields(s))
            except Exception as e:  # raised by code of the family; the record is kept
                notes.append(note_of("fields", e))
            else:
                write_arrays(Path(request["fields"]), fields)
        return {"fields": finite(results), "notes": notes}

    def _case(self, name: CaseId, keep: int) -> Case:
        case = self._cases.pop(name.name, None)
        # drop cases before the build, since two cases may not fit in memory
        while len(self._cases) >= keep:
            del self._cases[next(iter(self._cases))]
        if case is None:
            self._results.clear()
            case = self._build(name)
            if not self._warm and case.dualise_seconds is not None:
                self._warm = True
                if self._build_seconds < MAX_WARM_UP_SECONDS:
                    case = self._build(name)
        self._cases[name.name] = case
        return case

    def _build(self, name: CaseId) -> Case:
        start = perf_counter()
        case = name.build(self.reference)
        self._build_seconds = perf_counter() - start
        return case

    def _write(self, case: Case, name: CaseId, path: Path) -> dict[str, Any]:
        saved = save_qp(path, case.qp, {"name": name.name}, serialised=True)
        meta = {
            "qp": case.digest or saved,
            "build_seconds": self._build_seconds,
            "dualise_seconds": case.dualise_seconds,
        }
        return {"meta": meta}
