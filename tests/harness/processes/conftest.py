"""In this room processes start as those of users do."""

import pytest


@pytest.fixture(scope="module", autouse=True)
def how_processes_start():
    """By interpreters of their own."""
