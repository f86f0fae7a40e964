"""Keys that several families share, and checks that involve several keys.

The annotations contain type, range and help text of a key (`harness.keys`). A failed
check raises InputError with one line that states the expected value.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal, TypeAlias

from mortarbench.harness import InputError
from mortarbench.harness.checked import is_number
from mortarbench.harness.errors import shown
from mortarbench.harness.keys import Range
from mortarbench.harness.limits import CASE_VARIABLE, case_limit_mib

CONTACT_FORMS = ("primal", "dual", "dual-bounds")
MIN_STRETCH = 0.1  #: smallest stretch of a body under pressure
#: smallest and largest magnitude of a physical value in SI units; within these limits,
#: products of several values neither overflow nor underflow
MIN_SIZE, MAX_SIZE = 1e-30, 1e30
MAX_STEPS = 10_000  #: largest number of load steps, and of linearisations per step
#: lower bound on the memory that K and its sparsity pattern take per displacement
#: component, MiB
COMPONENT_MIB = 1 / 1024
POSITIVE = Range(MIN_SIZE, MAX_SIZE)  #: range of positive physical values

Steps: TypeAlias = Annotated[int, Range(1, MAX_STEPS), "number of load steps"]
Step: TypeAlias = Annotated[int, Range(1), "load step of the QP; default: the last"]
Halvings: TypeAlias = Annotated[int, Range(0, 30), "bisections of all cells"]
Method: TypeAlias = Annotated[
    Literal["nts", "mortar"], "contact method: node to segment, or mortar"
]
Basis: TypeAlias = Annotated[
    Literal["dual", "standard"], "multipliers of mortar contact"
]
PlaneState: TypeAlias = Annotated[
    Literal["strain", "stress"], "plane strain or plane stress"
]
Dimension: TypeAlias = Annotated[Literal[2, 3], "dimension of space"]
Feti: TypeAlias = Annotated[
    int,
    Range(0),
    "largest number of cells along the side of a subdomain; 0: undivided bodies",
]
#: see `problems.feti.subdomains`
Glue: TypeAlias = Annotated[
    Literal["orthonormal", "redundant"], "rows that join the copies of a node"
]
Law: TypeAlias = Annotated[Literal["none", "tresca", "coulomb"], "friction law"]
Bound: TypeAlias = Annotated[float, "Tresca: largest shear traction, Pa; -1: not set"]
Mu: TypeAlias = Annotated[float, "Coulomb: coefficient of friction; -1: not set"]
Loading: TypeAlias = Annotated[
    Literal["quasi-static", "static"],
    "slip from the preceding load step, or from the undeformed state",
]
Kinematics: TypeAlias = Annotated[Literal["linear", "finite"], "small or finite strain"]
MaterialLaw: TypeAlias = Annotated[
    Literal["neo-hooke", "svk"], "material at finite strain"
]
Newton: TypeAlias = Annotated[
    int, Range(0), "Newton iteration of the QP, 1, 2, …; 0: the last"
]
#: `geometric` adds the second derivatives of the gaps to the tangent
ContactStiffness: TypeAlias = Annotated[
    Literal["none", "geometric"], "contact stiffness at finite strain"
]

#: mapping from a friction law to the key of its parameter; empty if the law has no
#: parameter
LAWS = {"none": "", "tresca": "bound", "coulomb": "mu"}
#: mapping from the parameter of a friction law to a description of its allowed values
LAW_PARAMETERS = {
    "bound": "a traction of 0 or more, Pa",
    "mu": "a coefficient of friction of 0 or more",
}
UNSET = -1.0  #: default of the parameters of friction laws
#: mapping from a key to its only value that is supported in 3D
PLANE_ONLY: Mapping[str, Any] = {"kinematics": "linear", "plane": "strain"}
#: mapping from a key to its only value that is supported with finite strain
LINEAR_ONLY: Mapping[str, Any] = {
    "feti": 0,
    "parts": 0,
    "friction": "none",
    "plane": "strain",
    "relin": 1,
}
#: mapping from a key that only finite strain uses to its default
FINITE_ONLY: Mapping[str, Any] = {
    "material": "neo-hooke",
    "newton": 0,
    "contact_stiffness": "none",
}


def refuse_unused(family: Any, key: str, user: str, remedy: str) -> None:
    """Raise InputError if a key that has no effect is not at its default.

    user : key and value that do not use the key
    remedy : values for which the key has an effect
    """
    value = getattr(family, key)
    if value != getattr(type(family), key):
        raise InputError(
            f"{key}={value} is not used by {user}; expected no {key}, or {remedy}"
        )


def physical(where: str, value: Any) -> float:
    """Return a physical value in SI units as float.

    Raises
    ------
    InputError
        If the value is neither 0 nor of a magnitude between MIN_SIZE and MAX_SIZE. (For
        comparison, Young's modulus of steel is 2e11 Pa.)

    """
    if not is_number(value) or not (value == 0 or abs(value) in POSITIVE):
        raise InputError(
            f"{where} = {shown(value)}; expected a number between {MIN_SIZE:g} and "
            f"{MAX_SIZE:g} in magnitude, or 0"
        )
    return float(value)


def check_memory(components: int) -> None:
    """Raise InputError if a case of this size would not fit into memory.

    components : lower bound on the number of displacement components; each requires at
        least 1 KiB (stiffness matrix and its sparsity pattern), and about 4 KiB
        including the factor
    """
    what = f"{components:.2g} displacement components take at least"
    check_fits(what, components * COMPONENT_MIB, "a mesh")


def check_fits(what: str, needed: float, smaller: str) -> None:
    """Raise InputError if a case needs more memory than there is.

    Parameters
    ----------
    what : beginning of the message, which the memory follows
    needed : memory, MiB
    smaller : what should fit into memory instead, for the message

    """
    if needed > (limit := case_limit_mib()):
        raise InputError(
            f"{what} {needed:.2g} MiB of memory; expected {smaller} that fits into "
            f"{limit:.0f} MiB, or {CASE_VARIABLE} set to the memory available"
        )


def check_friction(family: Any, *, elsewhere: bool = False) -> None:
    """Raise InputError unless the friction keys are consistent.

    elsewhere : True if individual pairs may have their own friction laws
    """
    law = family.friction
    for key, allowed in LAW_PARAMETERS.items():
        value = getattr(family, key)
        if key != LAWS[law] and value != UNSET:
            (user,) = (other for other, needed in LAWS.items() if needed == key)
            raise InputError(
                f"{key}={value:g} is not used by friction={law}; expected no {key}, or "
                f"friction={user}"
            )
        if key == LAWS[law] and value == UNSET and not elsewhere:
            raise InputError(f"friction={law} needs {key}, {allowed}")
        if value not in (UNSET, 0) and value not in POSITIVE:
            raise InputError(f"{key}={value:g}; expected {allowed}")
    if law == "none" and not elsewhere and family.loading != "quasi-static":
        raise InputError(
            f"loading={family.loading} is not used by friction=none; expected no "
            "loading, or friction=tresca or friction=coulomb"
        )


def check_decomposition(family: Any, key: str, meaning: str) -> None:
    """Raise InputError unless the keys of a decomposition are consistent.

    key, meaning : key that requests subdomains, and its meaning for the message
    """
    if not getattr(family, key):
        undivided = f"{key}=0, which leaves bodies undivided"
        refuse_unused(family, "glue", undivided, f"{key}, {meaning}")


def check_kinematics(family: Any) -> None:
    """Raise InputError unless the keys of large deformation are consistent."""
    if family.kinematics == "linear":
        for key, default in FINITE_ONLY.items():
            if (value := getattr(family, key, default)) != default:
                raise InputError(
                    f"{key}={value} is not used by kinematics=linear; expected no "
                    f"{key}, or kinematics=finite"
                )
        return
    refuse_unbuilt(family, LINEAR_ONLY, "kinematics=finite", "kinematics=linear")
    if (
        getattr(family, "contact_stiffness", "none") == "geometric"
        and family.contact != "nts"
    ):
        raise InputError(
            f"contact_stiffness=geometric with contact={family.contact} is not built; "
            "expected contact=nts"
        )


def refuse_unbuilt(
    family: Any, only: Mapping[str, Any], user: str, remedy: str
) -> None:
    """Raise InputError if a key has a value that is not built.

    only : the only value that is built, by key
    user, remedy : key and value with which others are not built, and the alternative
    """
    for key, built in only.items():
        if (value := getattr(family, key, built)) != built:
            raise InputError(
                f"{key}={value} with {user} is not built; expected {key}={built}, or "
                f"{remedy}"
            )


def check_tangential(Q: float) -> None:
    """Raise InputError unless 0 < Q < 1, a tangential force in units of its limit."""
    if not 0 < Q < 1:
        raise InputError(
            f"Q={Q} must be between 0 and 1, a fraction of the limit of friction"
        )
