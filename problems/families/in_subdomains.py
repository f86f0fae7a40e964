"""Families of which ranks of MPI can emit the dual, each its own subdomains."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import TYPE_CHECKING, Any, ClassVar

from mortarbench.harness import Family
from mortarbench.problems.ranges import divided

if TYPE_CHECKING:
    from mortarbench.harness import Case, Reference, ReferenceOverRanks, Value
    from mortarbench.harness.distributed.vectors import Emitted, Ranks
    from mortarbench.problems.duality.problem import ContactProblem


class InSubdomains(Family):
    """A family of bodies in subdomains that ranks can make without the whole."""

    def is_divided(self, params: Mapping[str, Value]) -> bool:
        """Whether the dual has subdomains, and ranks can make all that it needs."""
        return divided(params)

    @abstractmethod
    def emitted(
        self, params: Mapping[str, Value], ranks: Ranks, reference: ReferenceOverRanks
    ) -> Emitted:
        """Make this rank's share of the dual; called by all ranks."""

    def emission(
        self, form: str, params: Mapping[str, Value]
    ) -> Callable[[Ranks, ReferenceOverRanks], Emitted] | None:
        """Return what has each rank make its share; None where one process must."""
        if form != "dual" or not self.is_divided(params):
            return None
        return lambda ranks, reference: self.emitted(params, ranks, reference)


class ContactFamily(InSubdomains):
    """A family of elastic bodies in contact, which states its problem once.

    A module of `problems.models` has it: its `problem` of the keys, and where bodies
    can be hyperelastic, its `newton_step`. It is imported when something is built.
    """

    model: ClassVar[str]  #: name of the module
    stated_by: ClassVar[str] = "problem"  #: function of the module

    def build(
        self, form: str, params: Mapping[str, Value], reference: Reference
    ) -> Case:
        """Emit the QP in one form."""
        params = self.complete(params)
        self.check(params)
        if params.get("kinematics") == "finite":
            case: Case = self._module.newton_step(form, params, reference)
            return case
        from mortarbench.problems.duality.case_forms import case_of
        from mortarbench.problems.duality.problem import chosen

        choice = chosen(form, params)
        return case_of(self.stated(params), form, choice, reference)

    def emitted(
        self, params: Mapping[str, Value], ranks: Ranks, reference: ReferenceOverRanks
    ) -> Emitted:
        """Make this rank's share of the dual; called by all ranks."""
        from mortarbench.problems.duality.divided import emitted_by
        from mortarbench.problems.duality.problem import chosen

        choice = chosen("dual", params)
        return emitted_by(ranks, self.stated(params), choice, reference)

    def stated(self, params: Mapping[str, Value]) -> ContactProblem:
        """State the problem that complete keys are of."""
        problem: ContactProblem = getattr(self._module, self.stated_by)(params)
        return problem

    @property
    def _module(self) -> Any:
        return import_module(f"mortarbench.problems.models.{self.model}")
