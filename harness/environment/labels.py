"""Readable names of entries of an environment, and descriptions of differences."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from mortarbench.harness.errors import shortened

#: tuple of dotted key, value before the change, and value after the change
Difference = tuple[str, Any, Any]

_MAX_VALUE_CHARACTERS = 48
_MAX_LISTED = 3  #: largest number of differences that are described in words

_NAMES = {
    "machine.cpu": "processor",
    "machine.physical_cores": "physical cores",
    "machine.logical_cores": "logical cores",
    "machine.usable_cores": "usable cores",
    "machine.cpu_limit": "cores that the container may use",
    "machine.memory_mib": "memory in MiB",
    "machine.architecture": "architecture",
    "machine.system": "operating system",
    "machine.kernel": "kernel",
    "machine.libc": "C library",
    "machine.virtual": "virtual machine",
    "machine.governor": "frequency governor",
    "machine.turbo": "turbo frequencies",
    "machine.smt": "hyper-threading",
    "machine.shared_by_workers": "Dask workers that share the machine",
    "source": "the checkout that mortarbench runs from",
    "source.commit": "commit of mortarbench",
    "source.dirty": "code that differs from the commit",
    "source.changes": "digest of that code",
    "plugins": "plug-ins",
    "threads.pools": "libraries with threads",
    "cholmod.version": "version of CHOLMOD",
    "cholmod.blas": "BLAS used by CHOLMOD",
}
_GROUPS = {
    "versions.": "version of {}",
    "plugins.": "content of the plug-in {}",
    "threads.variables.": "the variable {}",
}


def named(key: str) -> str:
    """Return the readable name of an entry of an environment.

    >>> named("versions.numpy")
    'version of numpy'

    """
    for group, text in _GROUPS.items():
        if key.startswith(group):
            return text.format(key.removeprefix(group))
    return _NAMES.get(key, key)


def in_words(changes: Iterable[Difference], one: str, other: str) -> str:
    """Describe the first few differences in words, and count the remaining ones.

    changes : differences between two environments
    one, other : words for the two environments, such as "then" and "now"

    >>> in_words([("machine.kernel", "6.1", "6.2")], "then", "now")
    'kernel: 6.1 then, 6.2 now'

    """
    texts = [
        f"{named(key)}: {_shown(a)} {one}, {_shown(b)} {other}"
        if _is_short(a) and _is_short(b)
        else f"other {named(key)}"
        for key, a, b in changes
    ]
    rest = [f"and {len(texts) - _MAX_LISTED} more"] * (len(texts) > _MAX_LISTED)
    return "; ".join([*texts[:_MAX_LISTED], *rest])


def _is_short(value: Any) -> bool:
    return not isinstance(value, Mapping | list | tuple)


def _shown(value: Any) -> str:
    match value:
        case None:
            return "none"
        case bool():
            return "yes" if value else "no"
        case _:
            return shortened(str(value), _MAX_VALUE_CHARACTERS)
