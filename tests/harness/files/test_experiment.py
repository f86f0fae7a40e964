"""Tests of the stored data of an experiment."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from mortarbench.harness.errors import InputError
from mortarbench.harness.files.experiment import load_experiment


@pytest.mark.parametrize("lost", ["setting", "tables", "states"])
def test_a_setting_without_an_entry_is_refused(tmp_path: Path, lost: str) -> None:
    index = {"setting": {}, "tables": [], "states": {}}
    del index[lost]
    (tmp_path / "setting.json").write_text(json.dumps(index))
    with pytest.raises(InputError, match="not the setting of an experiment"):
        load_experiment(tmp_path)
