"""The examples of docs/python.md, run from top to bottom in an empty folder, print the
output shown.
"""

import doctest
import re

import pytest

from tests.support import ROOT


@pytest.mark.slow
def test_the_output_on_the_page_is_the_actual_output(tmp_path, monkeypatch, capsys):
    """The examples run in their order."""
    page = (ROOT / "docs" / "python.md").read_text("utf-8")
    examples = "\n".join(re.findall(r"```pycon\n(.*?)```", page, re.S))
    test = doctest.DocTestParser().get_doctest(examples, {}, "python.md", None, 0)
    monkeypatch.chdir(tmp_path)

    result = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(test)

    assert result.failed == 0, capsys.readouterr().out
    assert result.attempted > 30
