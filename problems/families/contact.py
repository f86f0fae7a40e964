"""Base classes of families of elastic bodies: contact, and finite strain."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from functools import lru_cache, partial
from typing import Any, Self

from mortarbench.harness import (
    Case,
    Divided,
    Family,
    InputError,
    Reference,
    Solution,
)
from mortarbench.problems.contact.bodies import Bodies
from mortarbench.problems.contact.linearise import linearisation
from mortarbench.problems.duality.case_forms import case_of
from mortarbench.problems.duality.newton import Iteration, NewtonPath
from mortarbench.problems.duality.newton_case import newton_case, newton_path
from mortarbench.problems.duality.problem import Choice, ContactProblem
from mortarbench.problems.keys import (
    check_decomposition,
    check_friction,
    check_kinematics,
)

#: keys that select one of the QPs of a contact problem
_CHOICES = ("step", "feti", "parts", "glue")
#: keys that select one of the QPs of a path of Newton iterations
_ITERATIONS = ("step", "newton")


class NewtonFamily(Family):
    """A family of elastic bodies at finite strain, whose QPs are Newton iterations."""

    def __post_init__(self) -> None:
        """Check ranges, and that the load step exists."""
        super().__post_init__()
        p: Any = self
        if hasattr(p, "step") and p.step > p.steps:
            raise InputError(f"step={p.step} must be at most steps={p.steps}")

    @abstractmethod
    def newton_path(self, reference: Reference) -> NewtonPath:
        """Return the path of Newton iterations."""

    def newton_results(
        self, path: NewtonPath, at: Iteration, s: Solution
    ) -> Mapping[str, Any]:
        """Evaluate quantities of a Newton iteration beyond those of all bodies.

        s : solution of the primal problem
        """
        return {}

    def newton_case(self, form: str, reference: Reference) -> Case:
        """Return the case of the iteration that the keys `step` and `newton` select."""
        p: Any = self
        path = _cached_path(self.without(_ITERATIONS), reference)
        results = partial(self.newton_results, path)
        return newton_case(path, form, getattr(p, "step", 1), p.newton, results)

    def without(self, keys: tuple[str, ...]) -> Self:
        """Return the family with the defaults of some keys."""
        return self.with_keys(**{k: v for k, v in self.params.items() if k not in keys})


class ContactFamily(NewtonFamily):
    """A family of elastic bodies in contact, defined by a `ContactProblem`.

    A family with the key `kinematics` also defines `finite_bodies`, which returns the
    assembled bodies for finite strain, or `newton_path`.
    """

    def __post_init__(self) -> None:
        """Check the combinations of the keys that the family has."""
        super().__post_init__()
        if hasattr(self, "loading"):
            self.check_laws()
        if hasattr(self, "feti"):
            meaning = "the largest number of cells along the side of a subdomain"
            check_decomposition(self, "feti", meaning)
        if hasattr(self, "kinematics"):
            check_kinematics(self)

    def check_laws(self) -> None:
        """Check the friction keys."""
        check_friction(self)

    @abstractmethod
    def problem(self) -> ContactProblem:
        """Return the bodies with supports, loads, contact and quantities."""

    def newton_path(self, reference: Reference) -> NewtonPath:
        """Return the path of Newton iterations at finite strain."""
        p: Any = self
        bodies: Bodies = p.finite_bodies()
        return newton_path(
            bodies,
            linearisation(bodies, p.contact, p.basis),
            reference,
            material=p.material,
            contact=p.contact,
            stiffness=getattr(p, "contact_stiffness", "none"),
            steps=getattr(p, "steps", 1),
        )

    def contact_problem(self) -> ContactProblem:
        """Return the problem, which cases that differ in load step or cut share."""
        return _cached_problem(self.without(_CHOICES))

    def build(self, form: str, reference: Reference) -> Case:
        """Return the case in the form `form`."""
        if getattr(self, "kinematics", "linear") == "finite":
            return self.newton_case(form, reference)
        return case_of(self.contact_problem(), form, self.choice(form), reference)

    def choice(self, form: str) -> Choice:
        """Return the selection of a QP of the problem.

        Raises
        ------
        InputError
            If subdomains are requested in a form other than the dual.

        """
        key = "parts" if hasattr(self, "parts") else "feti"
        size = getattr(self, key, 0)
        if size and form != "dual":
            raise InputError(
                f"{key} with form {form} is not built; expected form dual, or no {key}"
            )
        return Choice(
            getattr(self, "step", 1), size, getattr(self, "glue", "orthonormal")
        )

    def divided(self, form: str) -> Divided | None:
        """Return the subdomains of a form, or None for undivided bodies."""
        if form != "dual" or not (choice := self.choice(form)).size:
            return None
        from mortarbench.problems.duality.decomposed import case_on_ranks, subdivided

        problem = self.contact_problem()
        count = subdivided(problem.bodies.shape, choice.size).count
        return Divided(count, partial(case_on_ranks, problem, choice))


@lru_cache(maxsize=4)
def _cached_problem(family: ContactFamily) -> ContactProblem:
    return family.problem()


@lru_cache(maxsize=4)
def _cached_path(family: NewtonFamily, reference: Reference) -> NewtonPath:
    return family.newton_path(reference)
