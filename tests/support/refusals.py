"""Refusals of wrong input."""

from contextlib import contextmanager

import pytest

from mortarbench.harness import InputError


@contextmanager
def refused(message="", *, start=""):
    """Expect an `InputError` of one line that contains or starts with a message."""
    with pytest.raises(InputError) as e:
        yield
    text = str(e.value)
    assert text.startswith(start)
    assert message in text
    assert "\n" not in text
