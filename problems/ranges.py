"""Declaration of the keys of families: defaults, ranges and conditions between keys.

A failed check raises InputError with one line that states the expected value.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from mortarbench.harness import InputError
from mortarbench.harness.checked import is_number
from mortarbench.harness.errors import shown
from mortarbench.harness.limits import CASE_VARIABLE, case_limit_mib

if TYPE_CHECKING:
    from mortarbench.harness import Value

CONTACT_FORMS = ("primal", "dual", "dual-bounds")
MIN_STRETCH = 0.1  #: smallest stretch of a body under pressure
#: smallest and largest magnitude of a physical value in SI units; within these limits,
#: products of several values neither overflow nor underflow
MIN_SIZE, MAX_SIZE = 1e-30, 1e30
MAX_STEPS = 10_000  #: largest number of load steps, and of linearisations per step
#: lower bound on the memory that K and its sparsity pattern take per displacement
#: component, MiB
COMPONENT_MIB = 1 / 1024


@dataclass(frozen=True, kw_only=True)
class Key:
    """One key of a family: its default and its allowed values."""

    default: Value
    least: int | None = None  #: smallest allowed integer; None for no limit
    most: int | None = None  #: largest allowed integer; None for no limit
    values: tuple[Value, ...] = ()  #: allowed values; empty if the key is not a choice
    is_size: bool = False  #: True if the value must be between MIN_SIZE and MAX_SIZE

    def with_default(self, default: Value) -> Key:
        """Return a copy of the key with a different default."""
        return replace(self, default=default)

    def check(self, family: str, key: str, params: Mapping[str, Value]) -> None:
        """Raise InputError unless the value of `key` is in its range."""
        if self.least is not None:
            at_least(self.least, family, params, (key,))
        if self.most is not None:
            at_most(self.most, family, params, (key,))
        if self.is_size:
            positive(family, params, (key,))
        if self.values:
            one_of(family, params, {key: self.values})


Keys = Mapping[str, Key]


def key(default: Value, least: int | None = None, most: int | None = None) -> Key:
    """Declare a key, optionally with a range of integers."""
    return Key(default=default, least=least, most=most)


def choice(*values: Value) -> Key:
    """Declare a key with a list of allowed values; the first is the default."""
    return Key(default=values[0], values=values)


def size(default: float) -> Key:
    """Declare a key with a positive physical value."""
    return Key(default=default, is_size=True)


def schema(**keys: Key) -> Keys:
    """Declare the keys of a family, in the order of canonical names.

    >>> defaults_of(schema(n=key(10, 1), law=choice("hertz", "cattaneo")))
    {'n': 10, 'law': 'hertz'}
    """
    return MappingProxyType(keys)


def defaults_of(keys: Keys) -> dict[str, Value]:
    """Return the default of every key."""
    return {name: key.default for name, key in keys.items()}


HALVINGS = key(0, 0, 30)
STEPS = key(10, 1, MAX_STEPS)
#: keys of the contact method; node-to-segment contact ignores `basis`
METHODS = schema(contact=choice("nts", "mortar"), basis=choice("dual", "standard"))
PLANES = schema(plane=choice("strain", "stress"))
#: key of the gluing rows, which join the copies of a node (`problems.feti.subdomains`)
GLUES = schema(glue=choice("orthonormal", "redundant"))
#: keys of a decomposition into subdomains; `feti` is the largest number of cells along
#: the side of a subdomain, H/h, or 0 for undivided bodies
DECOMPOSITION = schema(feti=key(0, 0), **GLUES)
DIMENSION = schema(dim=choice(2, 3))
#: mapping from a key to its only value that three-dimensional families support
PLANE_ONLY: Mapping[str, Value] = {"kinematics": "linear", "plane": "strain"}
#: mapping from a friction law to the key of its parameter; empty if the law has no
#: parameter
LAWS = {"none": "", "tresca": "bound", "coulomb": "mu"}
#: mapping from the parameter of a friction law to a description of its allowed values
LAW_PARAMETERS = {
    "bound": "a traction of 0 or more, Pa",
    "mu": "a coefficient of friction of 0 or more",
}
#: keys of friction; the default -1 means that bound or mu is not set
LAW_KEYS = schema(
    friction=choice(*LAWS),
    bound=key(-1.0),
    mu=key(-1.0),
    loading=choice("quasi-static", "static"),
)
FRICTION = schema(**LAW_KEYS, iterate=key(0, 0))
#: keys of large deformation; `newton` is the Newton iteration whose QP is returned, 0
#: for the last one
KINEMATICS = schema(
    kinematics=choice("linear", "finite"),
    material=choice("neo-hooke", "svk"),
    newton=key(0, 0),
)
#: key of the contact stiffness: `geometric` adds the second derivatives of the gaps to
#: the tangent
CONTACT_STIFFNESS = schema(contact_stiffness=choice("none", "geometric"))
#: mapping from a key to its only value that is supported with finite strain
LINEAR_ONLY: Mapping[str, Value] = {
    "feti": 0,
    "parts": 0,
    "friction": "none",
    "plane": "strain",
    "relin": 1,
}
#: keys of the family `bodies` that its TOML file may also set
SETTINGS = schema(
    **METHODS,
    **PLANES,
    steps=STEPS,
    relin=key(1, 1, MAX_STEPS),
    **LAW_KEYS,
    kinematics=KINEMATICS["kinematics"],
    material=KINEMATICS["material"],
    **CONTACT_STIFFNESS,
)


def at_least(
    least: int, family: str, params: Mapping[str, Value], keys: Iterable[str]
) -> None:
    """Raise InputError unless each of the integer `keys` is at least `least`."""
    for key in keys:
        if int(params[key]) < least:
            raise InputError(f"{family}: {key}={params[key]} must be at least {least}")


def at_most(
    most: int, family: str, params: Mapping[str, Value], keys: Iterable[str]
) -> None:
    """Raise InputError unless each of the integer `keys` is at most `most`."""
    for key in keys:
        if int(params[key]) > most:
            raise InputError(f"{family}: {key}={params[key]} must be at most {most}")


def positive(family: str, params: Mapping[str, Value], keys: Iterable[str]) -> None:
    """Raise InputError unless the real `keys` are between MIN_SIZE and MAX_SIZE.

    Products of several values outside this range may overflow or underflow.
    """
    for key in keys:
        if float(params[key]) <= 0:
            raise InputError(f"{family}: {key}={params[key]} must be positive")
        if not MIN_SIZE <= float(params[key]) <= MAX_SIZE:
            raise InputError(
                f"{family}: {key}={params[key]} must be between {MIN_SIZE:g} and "
                f"{MAX_SIZE:g}"
            )


def physical(where: str, value: Any) -> float:
    """Return a physical value in SI units as float.

    Raises
    ------
    InputError
        If the value is neither 0 nor of a magnitude between MIN_SIZE and MAX_SIZE. (For
        comparison, Young's modulus of steel is 2e11 Pa.)

    """
    if not is_number(value) or not (value == 0 or MIN_SIZE <= abs(value) <= MAX_SIZE):
        raise InputError(
            f"{where} = {shown(value)}; expected a number between {MIN_SIZE:g} and "
            f"{MAX_SIZE:g} in magnitude, or 0"
        )
    return float(value)


def check_memory(family: str, components: int) -> None:
    """Raise InputError if a case of this size would not fit into memory.

    components : lower bound on the number of displacement components; each requires at
        least 1 KiB (stiffness matrix and its sparsity pattern), and about 4 KiB
        including the factor
    """
    needed, limit = components * COMPONENT_MIB, case_limit_mib()
    if needed > limit:
        raise InputError(
            f"{family}: {components:.2g} displacement components take at "
            f"least {needed:.2g} MiB of memory; expected a mesh that fits into "
            f"{limit:.0f} MiB, or {CASE_VARIABLE} set to the memory available"
        )


def check_friction(
    family: str, params: Mapping[str, Value], *, elsewhere: bool = False
) -> None:
    """Raise InputError unless the friction keys are consistent.

    elsewhere : True if individual pairs may have their own friction laws
    """
    law = str(params["friction"])
    for key, allowed in LAW_PARAMETERS.items():
        value, default = float(params[key]), LAW_KEYS[key].default
        if key != LAWS[law] and value != default:
            (user,) = (other for other, needed in LAWS.items() if needed == key)
            raise InputError(
                f"{family}: {key}={value:g} is not used by friction={law}; expected "
                f"no {key}, or friction={user}"
            )
        if key == LAWS[law] and value == default and not elsewhere:
            raise InputError(f"{family}: friction={law} needs {key}, {allowed}")
        if value != default and not (value == 0 or MIN_SIZE <= value <= MAX_SIZE):
            raise InputError(f"{family}: {key}={value:g}; expected {allowed}")
    sets_loading = params["loading"] != LAW_KEYS["loading"].default
    if law == "none" and not elsewhere and sets_loading:
        raise InputError(
            f"{family}: loading={params['loading']} is not used by friction=none; "
            "expected no loading, or friction=tresca or friction=coulomb"
        )
    if law != "coulomb" and not elsewhere and params["iterate"]:
        raise InputError(
            f"{family}: iterate={params['iterate']} is not used by friction={law}; "
            "expected friction=coulomb, which is solved by iteration"
        )


def check_decomposition(
    family: str,
    params: Mapping[str, Value],
    *,
    key: str = "feti",
    what: str = "the largest number of cells along the side of a subdomain",
) -> None:
    """Raise InputError unless the keys of a decomposition are consistent.

    key : key that requests subdomains
    what : meaning of this key, for the message
    """
    for name, default in defaults_of(GLUES).items():
        if not params[key] and params.get(name, default) != default:
            raise InputError(
                f"{family}: {name}={params[name]} is not used by {key}=0, which "
                f"leaves bodies undivided; expected no {name}, or {key}, {what}"
            )


def other_decomposition(key: str, keys: Container[str]) -> str:
    """Return the message for an unknown key of a decomposition, or "" for other keys.

    keys : keys of the family
    """
    if key == "parts" and "feti" in keys:
        return (
            "feti and parts exclude each other, only bodies:PATH.toml takes parts; "
            "expected feti, the largest number of cells along the side of a subdomain"
        )
    if key == "feti" and "parts" in keys:
        return (
            "feti and parts exclude each other, as feti needs a structured grid; "
            "expected parts, the number of subdomains"
        )
    return ""


def check_kinematics(family: str, params: Mapping[str, Value]) -> None:
    """Raise InputError unless the keys of large deformation are consistent."""
    if params["kinematics"] == "linear":
        for key, default in defaults_of({**KINEMATICS, **CONTACT_STIFFNESS}).items():
            if params.get(key, default) != default:
                raise InputError(
                    f"{family}: {key}={params[key]} is not used by kinematics=linear; "
                    f"expected no {key}, or kinematics=finite"
                )
        return
    for key, allowed in LINEAR_ONLY.items():
        if params.get(key, allowed) != allowed:
            raise InputError(
                f"{family}: {key}={params[key]} with kinematics=finite is not built; "
                f"expected {key}={allowed}, or kinematics=linear"
            )
    if params.get("contact_stiffness") == "geometric" and params["contact"] != "nts":
        raise InputError(
            f"{family}: contact_stiffness=geometric with contact={params['contact']} "
            "is not built; expected contact=nts"
        )


def check_dimension(family: str, params: Mapping[str, Value]) -> None:
    """Raise InputError if dim=3 is combined with a value for plane problems only."""
    if params["dim"] == 3:
        check_plane_only(family, params, "dim=3")


def check_plane_only(family: str, params: Mapping[str, Value], space: str) -> None:
    """Raise InputError if a key has a value that 3D families do not support.

    space : the key and value that make the family three-dimensional, for the message
    """
    for key, only in PLANE_ONLY.items():
        if params.get(key, only) != only:
            raise InputError(
                f"{family}: {key}={params[key]} with {space} is not built; expected "
                f"{key}={only}, or a plane problem"
            )


def check_tangential(family: str, params: Mapping[str, Value]) -> None:
    """Raise InputError unless 0 < peak < 1 and |Q| ≤ peak.

    Q is the final tangential force and `peak` is the largest one before unloading, both
    relative to the limit of friction, μP.
    """
    Q, peak = float(params["Q"]), float(params["peak"])
    if not 0 < peak < 1:
        key = "Q" if peak == Q else "peak"
        raise InputError(
            f"{family}: {key}={params[key]} must be between 0 and 1, a fraction of μP"
        )
    if abs(Q) > peak:
        raise InputError(
            f"{family}: Q={params['Q']} must be between -peak and peak={params['peak']}"
        )


def one_of(
    family: str, params: Mapping[str, Value], known: Mapping[str, tuple[Value, ...]]
) -> None:
    """Raise InputError unless each key of `known` has one of its listed values."""
    for key, values in known.items():
        if params[key] not in values:
            raise InputError(
                f"{family}: {key}={params[key]!r} is unknown, expected "
                + " or ".join(map(repr, values))
            )


def check_dense_memory(family: str, n: int) -> None:
    """Raise InputError if a dense n × n matrix does not fit into memory."""
    needed, limit = 8 * n**2 / 2**20, case_limit_mib()
    if needed > limit:
        raise InputError(
            f"{family}: a full matrix of {n} rows takes {needed:.2g} MiB of memory; "
            f"expected a matrix that fits into {limit:.0f} MiB, or {CASE_VARIABLE} set "
            "to the memory available"
        )
