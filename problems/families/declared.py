"""Base classes of families that declare their keys and the functions of a model."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from importlib import import_module
from inspect import signature
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar

from mortarbench.harness import Family, InputError
from mortarbench.problems.ranges import (
    Keys,
    check_decomposition,
    check_dimension,
    check_friction,
    check_kinematics,
    defaults_of,
    other_decomposition,
)

if TYPE_CHECKING:
    from mortarbench.harness import (
        Case,
        CaseOnRanks,
        Reference,
        ReferenceOfOperator,
        Value,
    )
    from mortarbench.harness.distributed.comm import Comm
    from mortarbench.problems.duality.problem import ContactProblem


class DeclaredFamily(Family):
    """A family with declared keys, whose models are imported on demand.

    Attributes
    ----------
    keys : keys in the order of canonical names
    model : "MODULE.FUNCTION" of `problems.models` that returns the case. The parameters
        of the function may be form, params, reference and individual keys. If the
        family has subdomains, MODULE.in_subdomains returns the decomposed problem, and
        MODULE.decomposed_case the case of its dual
    conditions : mapping from a key to a check that involves several keys; the check
        applies if the family declares the key

    """

    keys: ClassVar[Keys] = MappingProxyType({})
    model: ClassVar[str]
    conditions: ClassVar[Mapping[str, Callable[[str, Mapping[str, Value]], None]]] = {
        "friction": check_friction,
        "feti": check_decomposition,
        "kinematics": check_kinematics,
        "dim": check_dimension,
    }

    def __init_subclass__(cls) -> None:
        """Set the defaults of the class from its keys."""
        cls.defaults = MappingProxyType(defaults_of(cls.keys))

    def check(self, params: Mapping[str, Value]) -> None:
        """Raise InputError unless every key is in its range."""
        p: Any = params
        for name, key in self.keys.items():
            key.check(self.name, name, params)
        if p.get("step", 0) > p.get("steps", 0):
            raise InputError(
                f"{self.name}: step={p['step']} must be at most steps={p['steps']}"
            )
        for name, check in self.conditions.items():
            if name in params:
                check(self.name, params)

    def instead_of(self, key: str) -> str:
        """Return the message for a key that the decomposition excludes, or ""."""
        return other_decomposition(key, self.keys)

    def is_divided(self, params: Mapping[str, Value]) -> bool:
        """Return True if bodies are decomposed and kinematics are linear."""
        size = params.get("feti") or params.get("parts")
        return bool(size) and params.get("kinematics") != "finite"

    def subdomains(self, form: str, params: Mapping[str, Value]) -> int:
        """Return the number of subdomains, or 1 for undivided bodies."""
        if form != "dual" or not self.is_divided(params):
            return 1
        return self.parts(params)

    def parts(self, params: Mapping[str, Value]) -> int:
        """Return the number of subdomains of decomposed bodies."""
        module = self.model.partition(".")[0]
        return int(_model(f"{module}.in_subdomains")(params).layout.count)

    def on_ranks(
        self, form: str, params: Mapping[str, Value]
    ) -> Callable[[Comm, ReferenceOfOperator], CaseOnRanks] | None:
        """Return a function that builds the case on several ranks, or None."""
        if form != "dual" or not self.is_divided(params):
            return None
        return lambda comm, reference: self.built_on(comm, params, reference)

    def built_on(
        self, comm: Comm, params: Mapping[str, Value], reference: ReferenceOfOperator
    ) -> CaseOnRanks:
        """Build the dual of decomposed bodies (all ranks call this together)."""
        del reference
        from mortarbench.harness import CaseOnRanks
        from mortarbench.problems.feti.served import Served
        from mortarbench.problems.feti.subdomains import TornBodies

        module = self.model.partition(".")[0]
        served = Served(TornBodies(_model(f"{module}.in_subdomains")(params), comm))
        case = _model(f"{module}.decomposed_case")
        return CaseOnRanks(served, partial(case, params, served))

    def build(
        self, form: str, params: Mapping[str, Value], reference: Reference
    ) -> Case:
        """Return the case in the form `form`."""
        params = self.complete(params)
        self.check(params)
        emit = _model(self.model)
        arguments = {**params, "form": form, "params": params, "reference": reference}
        case: Case = emit(
            **{name: arguments[name] for name in signature(emit).parameters}
        )
        return case


class ContactFamily(DeclaredFamily):
    """A family of elastic bodies in contact, defined by a `ContactProblem`.

    Attributes
    ----------
    problem : "MODULE.FUNCTION" of `problems.models` that returns the `ContactProblem`
        for a mapping that contains all keys
    model : "MODULE.FUNCTION" of `problems.models` that returns the case of a Newton
        iteration if kinematics=finite; empty if the family has no such cases

    """

    problem: ClassVar[str]
    model = ""

    def contact_problem(self, params: Mapping[str, Value]) -> ContactProblem:
        """Return the contact problem for `params`, which must contain all keys."""
        problem: ContactProblem = _model(self.problem)(params)
        return problem

    def build(
        self, form: str, params: Mapping[str, Value], reference: Reference
    ) -> Case:
        """Return the case in the form `form`."""
        params = self.complete(params)
        if params.get("kinematics") == "finite":
            return super().build(form, params, reference)
        self.check(params)
        from mortarbench.problems.duality.case_forms import case_of
        from mortarbench.problems.duality.problem import qp_choice

        choice = qp_choice(form, params)
        return case_of(self.contact_problem(params), form, choice, reference)

    def built_on(
        self, comm: Comm, params: Mapping[str, Value], reference: ReferenceOfOperator
    ) -> CaseOnRanks:
        """Build the dual of decomposed bodies (all ranks call this together)."""
        from mortarbench.problems.duality.decomposed import case_on_ranks
        from mortarbench.problems.duality.problem import qp_choice

        self.check(params)
        choice = qp_choice("dual", params)
        return case_on_ranks(comm, self.contact_problem(params), choice, reference)

    def parts(self, params: Mapping[str, Value]) -> int:
        """Return the number of subdomains of decomposed bodies."""
        from mortarbench.problems.duality.decomposed import cached_layout
        from mortarbench.problems.duality.problem import qp_choice

        size = qp_choice("dual", params).size
        return cached_layout(self.contact_problem(params).bodies, size).count


def _model(place: str) -> Callable[..., Any]:
    """Import the function "MODULE.FUNCTION" of `problems.models`."""
    module, _, name = place.rpartition(".")
    function = getattr(import_module(f"mortarbench.problems.models.{module}"), name)
    return function  # type: ignore[no-any-return]
