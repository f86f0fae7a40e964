"""Family `fclib`, problems from FCLIB files; see `problems.files.fclib`."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from mortarbench.harness.errors import unknown
from mortarbench.problems.families.from_file import FromFile
from mortarbench.problems.ranges import at_least

if TYPE_CHECKING:
    from mortarbench.harness import Case, Reference, Solution, Value


class Fclib(FromFile):
    """Contacts with Coulomb friction from FCLIB files, ``fclib:PATH.hdf5``.

    Coulomb's law is solved by a sequence of convex problems, with fixed cones or fixed
    discs according to the key `loop`. The QP is the last one, whose solution satisfies
    Coulomb's law, or problem number `iterate` if `iterate` is not 0. The digest of the
    file is a parameter of the case.
    """

    name = "fclib"
    path_suffix = ".hdf5"
    defaults: Mapping[str, Value] = MappingProxyType(
        {"path": "", "loop": "cones", "iterate": 0, "sha256": ""}
    )
    forms = ("dual",)

    def check(self, params: Mapping[str, Value]) -> None:
        """Raise InputError unless the keys are in range and the file exists."""
        loops = ("cones", "tresca")
        if params["loop"] not in loops:
            raise unknown("loop", str(params["loop"]), loops, where=self.name)
        at_least(0, self.name, params, ["iterate"])
        super().check(params)

    def build(
        self, form: str, params: Mapping[str, Value], reference: Reference
    ) -> Case:
        """Return the case of one convex problem, scaled by max W_ii and max |q_i|.

        Raises
        ------
        InputError
            If the file is damaged, its problem is not convex, or the sequence of convex
            problems does not converge.
        PastEndError
            If the sequence has fewer problems than `iterate`.

        """
        import numpy as np

        from mortarbench.harness import Case
        from mortarbench.harness.checked import located
        from mortarbench.harness.errors import PastEndError
        from mortarbench.problems.files.fclib import read_fclib
        from mortarbench.problems.files.friction_cones import coulomb_steps, states

        p: Any = params
        path = self._located(params)
        file = read_fclib(path)
        speed = float(np.abs(file.contact.q).max(initial=0.0)) or 1.0
        largest = float(file.contact.W.diagonal().max(initial=0.0)) or 1.0
        force = speed / largest
        contact = file.contact.scaled(force, speed)
        with located(str(path)):
            contact.check_convex()
            steps = coulomb_steps(contact, p["loop"], reference, p["iterate"])
        if p["iterate"] > len(steps):
            raise PastEndError(
                f"iterate={p['iterate']}: loop={p['loop']} has only {len(steps)} "
                f"iterates; expected at most {len(steps)}, or 0 for the last"
            )
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
