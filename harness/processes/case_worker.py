"""The process that builds cases: the code of families, away from what counts.

It answers the requests of `harness.processes.protocol` with these of its own:

* ``{"build": NAME, "qp": PATH, "keep": N}``: it builds the case, writes its QP to PATH
  and says ``{"event": "done", "meta": {…}}``, with the digest of its numbers
* ``{"describe": NAME, "point": PATH, "fields": PATH or null, "keep": N}``: what a
  point means: ``{"event": "done", "quantities": {…}, "bounds": {…}, "notes": […]}``
  with bounds of its error, and the deformed state in ``fields`` where there is one
* ``{"shared": NAME}``: whether ranks can emit the QP of a case themselves, which is not
  built: ``{"event": "done", "shared": …}``
* ``{"solve": PATH, "point": PATH}``: the reference solve of the QP in the first file,
  for verdicts that residuals cannot give; it writes a point to the second, and says
  ``{"event": "done", "found": true}``, or false where it finds none

or to the first two ``{"event": "done", "unbuilt": REASON, "trace": TEXT, "past_end":
…}``, the last true where a sequence has fewer problems (`PastEndError`); where NAME is
``{"family": …, "params": {…}, "form": …, "name": …}`` and N the number of cases that
are to stay in memory. What leads back from a point to the bodies is code, which no file
can hold: a case that is on file is built again when a point of it comes.
"""

from __future__ import annotations

import traceback
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from mortarbench.harness.errors import PastEndError
from mortarbench.harness.files.qpfile import load_qp, save_qp
from mortarbench.harness.files.store import (
    digest_of,
    field_arrays,
    point_arrays,
    read_point,
    write_arrays,
    write_point,
)
from mortarbench.harness.names import CaseId, is_shared, unbuilt
from mortarbench.harness.operators import NO_MAKERS, Maker
from mortarbench.harness.plugin import Case, Family, Reference
from mortarbench.harness.processes.protocol import Events, answer_requests
from mortarbench.harness.record import finite
from mortarbench.harness.solution import Solution, Status
from mortarbench.harness.verify.verdicts import certified, note_of, plain, quantities_of

MAX_STORED_BOUNDS = 10_000  #: points whose bounds are kept
#: s; the first dual case of a process is built twice where building took less. First
#: calls (pages, caches, late imports) took 12 of the 14 ms of dualising the smallest
#: demo case, and would be charged to its form. Importing alone may take a second. After
#: ten seconds of building, such milliseconds do not matter, and building twice would.
MAX_WARM_UP_SECONDS = 10.0


@dataclass(eq=False)
class CaseWorker:
    """Builds cases of `families`, with the injected `reference` solve."""

    families: Mapping[str, Family]
    reference: Reference
    operators: Mapping[str, Maker] = field(default_factory=lambda: NO_MAKERS)
    #: by canonical name, the last one used last
    _cases: dict[str, Case] = field(default_factory=dict)
    _build_seconds: float = 0.0  # of the last case that was built
    _warm: bool = False  # whether a dual case has been built
    #: certified
    _bounds: dict[tuple[str, str], tuple[dict[str, Any], str]] = field(
        default_factory=dict
    )

    def answer(self, request: dict[str, Any]) -> dict[str, Any]:
        """Answer one request, whatever the family's code does."""
        if "solve" in request:
            return self._solve(Path(request["solve"]), Path(request["point"]))
        asked = request.get("build") or request.get("describe") or request["shared"]
        name = CaseId(**{**asked, "family": self.families[asked["family"]]})
        if "shared" in request:
            return {"shared": is_shared(name)}
        try:
            case = self._case(name, request["keep"])
        except (Exception, SystemExit) as e:  # the family's code
            return {
                "unbuilt": unbuilt(name, e),
                "trace": traceback.format_exc(),
                "past_end": isinstance(e, PastEndError),
            }
        if "build" in request:
            return self._write(case, name, Path(request["qp"]))
        return self._describe(case, name, request)

    def _describe(
        self, case: Case, name: CaseId, request: dict[str, Any]
    ) -> dict[str, Any]:
        s = read_point(Path(request["point"]), Status.SOLVED)
        start = perf_counter()
        quantities, note = quantities_of(case, s)
        seconds = perf_counter() - start
        bounds, objection = self._certify(case, name, s)
        notes = [text for text in (note, objection) if text]
        if request["fields"] is not None and case.fields is not None:
            try:
                fields = field_arrays(case.fields(s))
            except Exception as e:  # the family's code; it must not lose the record
                notes.append(note_of("fields", e))
            else:
                write_arrays(Path(request["fields"]), fields)
        return {
            "quantities": quantities,
            "bounds": finite(bounds),
            "notes": notes,
            "seconds": seconds,
        }

    def _certify(
        self, case: Case, name: CaseId, s: Solution
    ) -> tuple[dict[str, Any], str]:
        """Bound the error of a point; one that came before is not certified again.

        Most solvers give the same digits at each repeat. Only the first takes time, and
        only its record has a `certify_seconds`.
        """
        key = name.name, digest_of(point_arrays(s))
        if key in self._bounds:
            bounds, objection = self._bounds[key]
            return {
                k: v for k, v in bounds.items() if k != "certify_seconds"
            }, objection
        while len(self._bounds) >= MAX_STORED_BOUNDS:
            del self._bounds[next(iter(self._bounds))]
        self._bounds[key] = certified(case, s)
        return self._bounds[key]

    def _solve(self, qp: Path, point: Path) -> dict[str, Any]:
        try:
            write_point(point, self.reference(load_qp(qp, operators=self.operators)[0]))
        except (ArithmeticError, ValueError, np.linalg.LinAlgError):
            return {"found": False}
        return {"found": True}

    def _case(self, name: CaseId, keep: int) -> Case:
        case = self._cases.pop(name.name, None)
        while len(self._cases) >= keep:  # before building: two may be too large
            del self._cases[next(iter(self._cases))]
        if case is None:
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
        meta = {
            "name": name.name,
            "scale": case.scale,
            "constant": case.constant,
        }
        digest = save_qp(path, case.qp, plain(meta), serialised=True)
        seconds = {
            "build_seconds": self._build_seconds,
            "dualise_seconds": case.dualise_seconds,
            "unsettled": case.unsettled,
        }
        return {"meta": {**meta, **seconds, "qp": digest}}


def serve(worker: CaseWorker, request_fd: int, reply_fd: int) -> None:
    """Answer requests until there are no more."""

    def handle(request: dict[str, Any], events: Events) -> dict[str, Any]:
        events.start()
        return worker.answer(request)

    answer_requests(handle, lambda: None, request_fd, reply_fd)
