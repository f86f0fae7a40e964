"""Base classes of families that declare their keys and the functions of a model."""

from __future__ import annotations

from collections.abc import Callable, Mapping
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
    double,
    other_decomposition,
    refuse_finite_strain,
)

if TYPE_CHECKING:
    from mortarbench.harness import Case, Reference, ReferenceOverRanks, Value
    from mortarbench.harness.distributed.vectors import DistributedQP, Ranks
    from mortarbench.problems.duality.problem import ContactProblem


class DeclaredFamily(Family):
    """A family with declared keys, whose models are imported on demand.

    Attributes
    ----------
    keys : keys in the order of canonical names
    model : "MODULE.FUNCTION" of `problems.models` that returns the case. The parameters
        of the function may be form, params, reference and individual keys
    subdomains : module of `problems.models` whose `in_subdomains` returns the
        decomposed problem and whose `results` returns a function that evaluates
        solutions on ranks; empty if the family has no such module
    cells : keys that are numbers of cells; refinement doubles the values unless there
        is a key `halvings`
    conditions : mapping from a key to a check that involves several keys; the check
        applies if the family declares the key

    """

    keys: ClassVar[Keys] = MappingProxyType({})
    model: ClassVar[str]
    subdomains: ClassVar[str] = ""
    cells: ClassVar[tuple[str, ...]] = ()
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

    def refined(self, params: Mapping[str, Value]) -> Mapping[str, Value] | None:
        """Return the keys of the case with half the mesh size.

        Return None if the family declares neither a key `halvings` nor `cells`.
        Refinement may change the polygons that approximate arcs.

        Raises
        ------
        InputError
            If the strain is finite, see `refuse_finite_strain`.

        """
        if "kinematics" in params:
            refuse_finite_strain(self.name, params)
        if "halvings" in params:
            return {**params, "halvings": int(params["halvings"]) + 1}
        return {**params, **double(params, *self.cells)} if self.cells else None

    def is_divided(self, params: Mapping[str, Value]) -> bool:
        """Return True if bodies are decomposed and kinematics are linear."""
        size = params.get("feti") or params.get("parts")
        return bool(size) and params.get("kinematics") != "finite"

    def emission(
        self, form: str, params: Mapping[str, Value]
    ) -> Callable[[Ranks, ReferenceOverRanks], DistributedQP] | None:
        """Return a function that assembles the local part of the dual on a rank.

        Return None if one process must assemble the whole case.
        """
        if form != "dual" or not self.is_divided(params):
            return None
        return lambda ranks, reference: self.emitted(params, ranks, reference)

    def emitted(
        self, params: Mapping[str, Value], ranks: Ranks, reference: ReferenceOverRanks
    ) -> DistributedQP:
        """Return the local part of the dual on this rank (collective call)."""
        from mortarbench.problems.feti.distributed_dual import distributed_qp, dual_on

        del reference
        dual = dual_on(_model(f"{self.subdomains}.in_subdomains")(params), ranks)
        return distributed_qp(dual, _model(f"{self.subdomains}.results")(params, dual))

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

    def emitted(
        self, params: Mapping[str, Value], ranks: Ranks, reference: ReferenceOverRanks
    ) -> DistributedQP:
        """Return the local part of the dual on this rank (collective call)."""
        from mortarbench.problems.duality.decomposed import distributed_qp_of
        from mortarbench.problems.duality.problem import qp_choice

        self.check(params)
        choice = qp_choice("dual", params)
        return distributed_qp_of(ranks, self.contact_problem(params), choice, reference)


def _model(place: str) -> Callable[..., Any]:
    """Import the function "MODULE.FUNCTION" of `problems.models`."""
    module, _, name = place.rpartition(".")
    function = getattr(import_module(f"mortarbench.problems.models.{module}"), name)
    return function  # type: ignore[no-any-return]
