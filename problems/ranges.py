"""Checks of the keys of a family, with the one line that says what would be right."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

from harness import InputError
from harness.checked import is_number
from harness.errors import shown
from harness.limits import CASE_VARIABLE, case_limit_mib

if TYPE_CHECKING:
    from harness import Value

CONTACT_FORMS = ("primal", "dual", "dual-bounds")
#: values of the keys that choose the method; node-to-segment takes no notice of basis
METHODS = {"contact": ("nts", "mortar"), "basis": ("dual", "standard")}
PLANES = {"plane": ("strain", "stress")}
#: what the name of a case of bodies may set, with the value where its file says nothing
SETTINGS: Mapping[str, Value] = {
    "contact": "nts", "basis": "dual", "plane": "strain", "steps": 10, "relin": 1
}  # fmt: skip
LEAST, MOST = 1e-30, 1e30  #: sizes of physical values, SI
MOST_STEPS = 10_000  #: load steps, linearisations, halvings of a mesh: of each
COMPONENT_MIB = 1 / 1024  #: that a displacement component takes at the very least


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


def fits_dense(family: str, n: int) -> None:
    """Raise InputError for a full matrix of n² numbers that cannot fit into memory."""
    needed, limit = 8 * n**2 / 2**20, case_limit_mib()
    if needed > limit:
        raise InputError(
            f"{family}: a full matrix of {n} rows takes {needed:.2g} MiB of memory; "
            f"expected one that fits into {limit:.0f} MiB, or {CASE_VARIABLE} set to "
            "what there is"
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
