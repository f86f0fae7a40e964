"""Keys of families, declared: defaults, ranges, and conditions between several keys.

Every check raises InputError with the one line that says what would be right.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
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
SHORTEST = 0.1  #: stretch that a body is pressed to
LEAST, MOST = 1e-30, 1e30  #: sizes of physical values, SI
MOST_STEPS = 10_000  #: load steps, linearisations, halvings of a mesh: of each
COMPONENT_MIB = 1 / 1024  #: that a displacement component takes at the very least


@dataclass(frozen=True, kw_only=True)
class Key:
    """One key of a family: its default, and the values that it may have."""

    default: Value
    least: int | None = None
    most: int | None = None
    values: tuple[Value, ...] = ()  #: all that it may have; empty: no such list
    is_size: bool = False  #: positive, and of a usual size in SI units

    def replace(self, default: Value) -> Key:
        """Return the same key with another default."""
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
    """Declare a key with a range of integers, or none."""
    return Key(default=default, least=least, most=most)


def choice(*values: Value) -> Key:
    """Declare a key with a list of values, of which the first is the default."""
    return Key(default=values[0], values=values)


def size(default: float) -> Key:
    """Declare a key that is a physical size."""
    return Key(default=default, is_size=True)


def declared(**keys: Key) -> Keys:
    """Declare the keys of a family, in the order of canonical names."""
    return MappingProxyType(keys)


def defaults_of(keys: Keys) -> dict[str, Value]:
    """Return the default of every key."""
    return {name: key.default for name, key in keys.items()}


HALVINGS = key(0, 0, 30)
STEPS = key(10, 1, MOST_STEPS)
#: the keys that choose the method; node-to-segment takes no notice of basis
METHODS = declared(contact=choice("nts", "mortar"), basis=choice("dual", "standard"))
PLANES = declared(plane=choice("strain", "stress"))
#: how copies of a node are held together, `problems.feti.gluing`
GLUES = declared(glue=choice("orthonormal", "chain", "redundant"))
#: the keys of bodies in subdomains: H/h, 0 for one piece per body, and `GLUES`
DECOMPOSITION = declared(feti=key(0, 0), **GLUES)
#: the laws of friction, each with the key that it needs
LAWS = {"none": "", "tresca": "bound", "coulomb": "mu"}
NEEDED = {
    "bound": "a traction of 0 or more, Pa",
    "mu": "a coefficient of friction of 0 or more",
}
#: the keys of friction; -1 is no bound and no mu
LAW = declared(
    friction=choice(*LAWS),
    bound=key(-1.0),
    mu=key(-1.0),
    loading=choice("quasi-static", "static"),
)
FRICTION = declared(**LAW, iterate=key(0, 0))
#: the keys of large deformation; newton: 0 is the last iteration
KINEMATICS = declared(
    kinematics=choice("linear", "finite"),
    material=choice("neo-hooke", "svk"),
    newton=key(0, 0),
)
#: whether second derivatives of the gaps join the tangent
CONTACT_STIFFNESS = declared(contact_stiffness=choice("none", "geometric"))
#: what is not built at finite strain, where a family has the key
LINEAR_ONLY: Mapping[str, Value] = {
    "feti": 0, "parts": 0, "friction": "none", "plane": "strain", "relin": 1
}  # fmt: skip
#: what the name of a case of bodies may set, with the value where its file says nothing
SETTINGS = declared(
    **METHODS,
    **PLANES,
    steps=STEPS,
    relin=key(1, 1, MOST_STEPS),
    **LAW,
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
    """Raise InputError unless each of the real `keys` is positive and of a usual size.

    Products of several values beyond that would be no numbers any more.
    """
    for key in keys:
        if float(params[key]) <= 0:
            raise InputError(f"{family}: {key}={params[key]} must be positive")
        if not LEAST <= float(params[key]) <= MOST:
            raise InputError(
                f"{family}: {key}={params[key]} must be between {LEAST:g} and {MOST:g}"
            )


def physical(where: str, value: Any) -> float:
    """Take a number whose products with others stay numbers, in SI units.

    Zero, or between 1e-30 and 1e30 in size: Young's modulus of steel is 2e11 Pa.
    """
    if not is_number(value) or not (value == 0 or LEAST <= abs(value) <= MOST):
        raise InputError(
            f"{where} = {shown(value)}; expected a number between {LEAST:g} and "
            f"{MOST:g} in size, or 0"
        )
    return float(value)


def fits(family: str, components: int) -> None:
    """Raise InputError for a case that cannot fit into memory, before it is built.

    components : of the displacement, or fewer; each takes 1 KiB at the very least (the
        stiffness matrix and its pattern), with a factor about 4 KiB
    """
    needed, limit = components * COMPONENT_MIB, case_limit_mib()
    if needed > limit:
        raise InputError(
            f"{family}: {components:.2g} components of the displacement take "
            f"{needed:.2g} MiB of memory at least; expected a mesh that fits into "
            f"{limit:.0f} MiB, or {CASE_VARIABLE} set to what there is"
        )


def check_friction(
    family: str, params: Mapping[str, Value], *, elsewhere: bool = False
) -> None:
    """Raise InputError unless the keys of friction fit together.

    elsewhere : whether pairs of sides may have laws of their own
    """
    law = str(params["friction"])
    for key, what in NEEDED.items():
        value, default = float(params[key]), LAW[key].default
        if key != LAWS[law] and value != default:
            (user,) = (other for other, needed in LAWS.items() if needed == key)
            raise InputError(
                f"{family}: {key}={value:g} is not used by friction={law}; expected "
                f"no {key}, or friction={user}"
            )
        if key == LAWS[law] and value == default and not elsewhere:
            raise InputError(f"{family}: friction={law} needs {key}, {what}")
        if value != default and not (value == 0 or LEAST <= value <= MOST):
            raise InputError(f"{family}: {key}={value:g}; expected {what}")
    unused = params["loading"] != LAW["loading"].default
    if law == "none" and not elsewhere and unused:
        raise InputError(
            f"{family}: loading={params['loading']} is not used by friction=none; "
            "expected no loading, or friction=tresca or friction=coulomb"
        )
    if law != "coulomb" and not elsewhere and params["iterate"]:
        raise InputError(
            f"{family}: iterate={params['iterate']} is not used by friction={law}; "
            "expected friction=coulomb, whose fixed point has iterates"
        )


def check_decomposition(
    family: str,
    params: Mapping[str, Value],
    *,
    key: str = "feti",
    what: str = "the most cells along a subdomain's side",
) -> None:
    """Raise InputError unless the keys of subdomains fit together.

    key, what : that asks for subdomains, and what it is the number of
    """
    if not params[key] and params["glue"] != GLUES["glue"].default:
        raise InputError(
            f"{family}: glue={params['glue']} is not used by {key}=0, one piece per "
            f"body; expected no glue, or {key}, {what}"
        )


def check_kinematics(family: str, params: Mapping[str, Value]) -> None:
    """Raise InputError unless the keys of large deformation fit together."""
    if params["kinematics"] == "linear":
        for key, default in defaults_of({**KINEMATICS, **CONTACT_STIFFNESS}).items():
            if params.get(key, default) != default:
                raise InputError(
                    f"{family}: {key}={params[key]} is not used by kinematics=linear; "
                    f"expected no {key}, or kinematics=finite"
                )
        return
    for key, built in LINEAR_ONLY.items():
        if params.get(key, built) != built:
            raise InputError(
                f"{family}: {key}={params[key]} with kinematics=finite is not built; "
                f"expected {key}={built}, or kinematics=linear"
            )
    if params.get("contact_stiffness") == "geometric" and params["contact"] != "nts":
        raise InputError(
            f"{family}: contact_stiffness=geometric with contact={params['contact']} "
            "is not built; expected contact=nts"
        )


def without_friction(family: str, params: Mapping[str, Value]) -> None:
    """Raise InputError where there is friction on sides that halving bends."""
    if params["friction"] != "none":
        raise InputError(
            f"{family}: friction={params['friction']} on curved sides, whose slip is "
            "another on finer meshes; expected friction=tresca on flat sides"
        )


def one_state(family: str, params: Mapping[str, Value]) -> None:
    """Raise InputError at finite strain, whose QPs are linearised at their own states.

    The QP of the next finer mesh belongs to another state, so that the distance of the
    two solutions is not the error of either mesh.
    """
    if params["kinematics"] == "finite":
        raise InputError(
            f"{family}: the error of the mesh with kinematics=finite is not built; "
            "expected kinematics=linear"
        )


def minimised(family: str, laws: Iterable[str], meshes: str) -> None:
    """Raise InputError where a law is Coulomb's, whose solutions minimise nothing.

    meshes : keys with values whose answers may be compared instead
    """
    if "coulomb" in laws:
        raise InputError(
            f"{family}: friction=coulomb minimises no energy on any mesh, so that "
            f"there is no error in its norm; compare answers with {meshes}"
        )


def tangential(family: str, params: Mapping[str, Value]) -> None:
    """Raise InputError unless 0 < peak < 1 and |Q| ≤ peak: parts of μP, no sliding."""
    Q, peak = float(params["Q"]), float(params["peak"])
    if not 0 < peak < 1:
        key = "Q" if peak == Q else "peak"
        raise InputError(
            f"{family}: {key}={params[key]} must be between 0 and 1, a part of μP"
        )
    if abs(Q) > peak:
        raise InputError(
            f"{family}: Q={params['Q']} must be between -peak and peak={params['peak']}"
        )


def one_of(
    family: str, params: Mapping[str, Value], known: Mapping[str, tuple[Value, ...]]
) -> None:
    """Raise InputError unless each key of `known` has one of its values."""
    for key, values in known.items():
        if params[key] not in values:
            raise InputError(
                f"{family}: {key}={params[key]!r} is unknown, expected "
                + " or ".join(map(repr, values))
            )


def doubled(params: Mapping[str, Value], *keys: str) -> dict[str, Value]:
    """Return the integer `keys`, numbers of cells, twice as large."""
    return {key: 2 * int(params[key]) for key in keys}


def fits_dense(family: str, n: int) -> None:
    """Raise InputError for a full matrix of n² numbers that cannot fit into memory."""
    needed, limit = 8 * n**2 / 2**20, case_limit_mib()
    if needed > limit:
        raise InputError(
            f"{family}: a full matrix of {n} rows takes {needed:.2g} MiB of memory; "
            f"expected one that fits into {limit:.0f} MiB, or {CASE_VARIABLE} set to "
            "what there is"
        )
