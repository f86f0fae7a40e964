"""Shared by the tests of reports."""

from contextlib import contextmanager

import pytest


@pytest.fixture(scope="module")
def svg_only():
    """Factory: a context in which reports have their figures as SVG alone.

    That is what pages show; `test_convergence.py` and `figures/test_pictures.py` have
    all formats.
    """

    @contextmanager
    def context():
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("reports.render.saving.ENDINGS", (".svg",))
            yield

    return context
