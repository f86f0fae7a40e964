"""The command `export`: write the QP of a case for other programs."""

from __future__ import annotations

from typing import Any

import mortarbench as mb
from mortarbench.registries import Registries


def export(registries: Registries, **arguments: Any) -> int:
    """Write the QP of a case to a file for other programs."""
    print(mb.export(**arguments, registries=registries))
    return 0
