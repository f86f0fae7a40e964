"""Family `fclib`, problems from FCLIB files; see `problems.files.fclib`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

import numpy as np

from mortarbench.harness import Case, Reference, Solution
from mortarbench.harness.checked import located
from mortarbench.harness.keys import DERIVED
from mortarbench.problems.families.from_file import FromFile
from mortarbench.problems.files.fclib import read_fclib
from mortarbench.problems.files.friction_cones import coulomb_steps, states


@dataclass(frozen=True, kw_only=True)
class Fclib(FromFile):
    """Contacts with Coulomb friction from FCLIB files, ``fclib:PATH.hdf5``.

    Coulomb's law is solved by a sequence of convex problems, with fixed cones or fixed
    discs according to the key `loop`. The QP is the last one, whose solution satisfies
    Coulomb's law. The digest of the file is a key of the case.
    """

    forms: ClassVar = ("dual",)
    path_suffix: ClassVar = ".hdf5"

    path: Annotated[str, "path of the file"] = ""
    loop: Annotated[
        Literal["cones", "tresca"], "convex problems with fixed cones or fixed discs"
    ] = "cones"
    sha256: Annotated[str, "digest of the file"] = DERIVED

    def build(self, form: str, reference: Reference) -> Case:
        """Return the case of the last convex problem, scaled by max W_ii and max |q_i|.

        Raises
        ------
        InputError
            If the file is damaged, its problem is not convex, or the sequence of convex
            problems does not converge.

        """
        path = self.located()
        file = read_fclib(path)
        speed = float(np.abs(file.contact.q).max(initial=0.0)) or 1.0
        largest = float(file.contact.W.diagonal().max(initial=0.0)) or 1.0
        force = speed / largest
        contact = file.contact.scaled(force, speed)
        with located(str(path)):
            contact.check_convex()
            steps = coulomb_steps(contact, self.loop, reference)
        remarks = []
        if (rank := contact.rank) is not None and rank < contact.q.size:
            remarks.append(
                f"W has rank {rank} of {contact.q.size}, so forces may not be unique"
            )
        stored = file.stored
        quantities: dict[str, Any] = {
            "contacts": contact.mu.size,
            "problems": len(steps),
            "loop_natural_map": steps[-1].error,
        }
        if stored is not None:
            error = contact.natural_map(stored / force, file.multipliers / speed)
            quantities |= {"stored_natural_map": error}
            if error > DUMMY:
                remarks.append(
                    "the scaled natural map of the stored solution is "
                    f"{error:.2g}, so the stored solution is a dummy"
                )

        def evaluate(s: Solution) -> dict[str, Any]:
            state = states(contact, s.x)
            counts = {k: int((state == k).sum()) for k in ("stick", "slip", "open")}
            return {
                **quantities,
                **counts,
                "natural_map": contact.natural_map(s.x, s.y, force / speed),
                "scaled_natural_map": contact.natural_map(s.x, s.y),
            }

        return Case(
            qp=steps[-1].qp,
            recover=lambda s: force * s.x,
            quantities=evaluate,
            scale=force * speed,
            remarks=tuple(remarks),
        )


#: stored forces r with a larger scaled natural map (a residual of Coulomb's law) count
#: as placeholders rather than solutions; for r = 0 the map is about 1
DUMMY = 0.1
