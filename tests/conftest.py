"""Shared generators of QPs whose solution is known by construction."""

from collections.abc import Callable

import pytest

from harness import QP, Solution
from harness.planted import planted as drawn


@pytest.fixture(scope="session", autouse=True)
def state(tmp_path_factory):
    """The key that signs built cases lies elsewhere than that of the user."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        yield


@pytest.fixture
def planted() -> Callable[..., tuple[QP, Solution]]:
    """Factory: ``planted(shape, seed=…, dense=False, n=20)``, see `harness.planted`."""
    return drawn
