"""Families that are declared: by their keys, and by functions of their models."""

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
    check_friction,
    check_kinematics,
    defaults_of,
    double,
    refuse_finite_strain,
)

if TYPE_CHECKING:
    from mortarbench.harness import Case, Reference, ReferenceOverRanks, Value
    from mortarbench.harness.distributed.vectors import DistributedQP, Ranks
    from mortarbench.problems.duality.problem import ContactProblem


class DeclaredFamily(Family):
    """A family with declared keys, whose models are imported when they are needed.

    Attributes
    ----------
    keys : in the order of canonical names
    model : "MODULE.FUNCTION" of `problems.models`, which emits the QP. Its parameters
        are some of form, params and reference, and single keys
    subdomains : module of `problems.models` whose `in_subdomains` describes the dual
        that ranks emit, and whose `results` say what they found; empty: one process
        emits it
    cells : keys that halving every cell doubles, where no key counts halvings
    conditions : checks of several keys, by the key that asks for each

    """

    keys: ClassVar[Keys] = MappingProxyType({})
    model: ClassVar[str]
    subdomains: ClassVar[str] = ""
    cells: ClassVar[tuple[str, ...]] = ()
    conditions: ClassVar[Mapping[str, Callable[[str, Mapping[str, Value]], None]]] = {
        "friction": check_friction,
        "feti": check_decomposition,
        "kinematics": check_kinematics,
    }

    def __init_subclass__(cls) -> None:
        """Take the defaults from the keys."""
        cls.defaults = MappingProxyType(defaults_of(cls.keys))

    def check(self, params: Mapping[str, Value]) -> None:
        """Raise InputError unless every key is in its range."""
        p: Any = params
        for name, key in self.keys.items():
            key.check(self.name, name, params)
        if p.get("step", 0) > p.get("steps", 0):
            raise InputError(
                f"{self.name}: step={p['step']} must be in 1..steps={p['steps']}"
            )
        for name, check in self.conditions.items():
            if name in params:
                check(self.name, params)

    def refined(self, params: Mapping[str, Value]) -> Mapping[str, Value] | None:
        """Return the case with every cell halved; arcs are other polygons then.

        At finite strain there is none: the QP of another mesh is linearised at another
        state.
        """
        if "kinematics" in params:
            refuse_finite_strain(self.name, params)
        if "halvings" in params:
            return {**params, "halvings": int(params["halvings"]) + 1}
        return {**params, **double(params, *self.cells)} if self.cells else None

    def is_divided(self, params: Mapping[str, Value]) -> bool:
        """Return True if bodies are in subdomains, and need no Newton's method."""
        cut = params.get("feti") or params.get("parts")
        return bool(cut) and params.get("kinematics") != "finite"

    def emission(
        self, form: str, params: Mapping[str, Value]
    ) -> Callable[[Ranks, ReferenceOverRanks], DistributedQP] | None:
        """Return what has each rank make its share; None where one process must."""
        if form != "dual" or not self.is_divided(params):
            return None
        return lambda ranks, reference: self.emitted(params, ranks, reference)

    def emitted(
        self, params: Mapping[str, Value], ranks: Ranks, reference: ReferenceOverRanks
    ) -> DistributedQP:
        """Emit this rank's share of the dual; called by all ranks."""
        from mortarbench.problems.feti.distributed_dual import distributed_qp, dual_on

        del reference
        dual = dual_on(_model(f"{self.subdomains}.in_subdomains")(params), ranks)
        return distributed_qp(dual, _model(f"{self.subdomains}.results")(params, dual))

    def build(
        self, form: str, params: Mapping[str, Value], reference: Reference
    ) -> Case:
        """Emit the QP in one form."""
        params = self.complete(params)
        self.check(params)
        emit = _model(self.model)
        known = {**params, "form": form, "params": params, "reference": reference}
        case: Case = emit(**{name: known[name] for name in signature(emit).parameters})
        return case


class ContactFamily(DeclaredFamily):
    """A family of elastic bodies in contact, which states its problem once.

    Attributes
    ----------
    problem : "MODULE.FUNCTION" of `problems.models`, from params to a `ContactProblem`
    model : alike, emits the QP of a Newton iteration where kinematics=finite

    """

    problem: ClassVar[str]
    model = ""

    def stated(self, params: Mapping[str, Value]) -> ContactProblem:
        """State the problem that complete keys are of."""
        found: ContactProblem = _model(self.problem)(params)
        return found

    def build(
        self, form: str, params: Mapping[str, Value], reference: Reference
    ) -> Case:
        """Emit the QP in one form."""
        params = self.complete(params)
        if params.get("kinematics") == "finite":
            return super().build(form, params, reference)
        self.check(params)
        from mortarbench.problems.duality.case_forms import case_of
        from mortarbench.problems.duality.problem import qp_choice

        choice = qp_choice(form, params)
        return case_of(self.stated(params), form, choice, reference)

    def emitted(
        self, params: Mapping[str, Value], ranks: Ranks, reference: ReferenceOverRanks
    ) -> DistributedQP:
        """Emit this rank's share of the dual; called by all ranks."""
        from mortarbench.problems.duality.decomposed import distributed_qp_of
        from mortarbench.problems.duality.problem import qp_choice

        self.check(params)
        choice = qp_choice("dual", params)
        return distributed_qp_of(ranks, self.stated(params), choice, reference)


def _model(place: str) -> Callable[..., Any]:
    """Import a function of `problems.models`."""
    module, _, function = place.partition(".")
    found = getattr(import_module(f"mortarbench.problems.models.{module}"), function)
    return found  # type: ignore[no-any-return]
