"""The case of a stored measurement, built again."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from mortarbench.harness.distributed.vectors import EMITTED
from mortarbench.harness.errors import InputError
from mortarbench.harness.files.qpfile import qp_digest
from mortarbench.harness.names import assemble, unbuilt
from mortarbench.harness.plugin import Case, Family, Reference
from mortarbench.harness.record import Record
from mortarbench.harness.results.folder import environment_of
from mortarbench.harness.results.stored_run import plugins_needed


def rebuild(
    r: Record, folder: Path, families: Mapping[str, Family], reference: Reference
) -> Case:
    """Build the case of a record.

    Raises
    ------
    InputError
        When its family is not known, or fails, or builds another QP than then. What
        ranks have emitted is not compared: the whole has another digest.

    """
    if r.family not in families:
        try:
            needs = plugins_needed(environment_of(folder, r.environment))
        except InputError:
            needs = ""
        raise InputError(f"unknown family {r.family!r}{needs}")
    name = assemble(families[r.family], r.params, r.form)
    try:
        case = name.build(reference)
    except (Exception, SystemExit) as e:  # the family's code
        raise InputError(unbuilt(r.case, e)) from None
    if r.qp is None or r.qp.startswith(EMITTED):
        return case
    if (now := qp_digest(case.qp, serialised=True)) != r.qp:
        raise InputError(
            f"its QP has the digest {now} now, {r.qp} when it was measured; expected "
            "the same version of the code, of its libraries and of plug-ins"
        )
    return case
