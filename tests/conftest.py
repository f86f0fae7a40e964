"""Shared generators of QPs whose solution is known by construction."""

from collections.abc import Callable

import pytest

from harness import QP, Solution
from harness.planted import planted as drawn


@pytest.fixture
def planted() -> Callable[..., tuple[QP, Solution]]:
    """Factory: ``planted(shape, seed=…, dense=False, n=20)``, see `harness.planted`."""
    return drawn
