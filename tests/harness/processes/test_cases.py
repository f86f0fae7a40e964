"""Cache of built cases on disk: look-up, sharing and damage."""

import json
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from mortarbench.harness.processes.case_folder import find_or_build


def name(**params):
    return ["f", params, "p"]


@pytest.fixture
def get(tmp_path):
    """Return a function that looks up a case; its ``made`` lists the built cases."""

    def get(case, *, environment="here", content=b"content", slowly=0.0):
        def make(path):
            get.made.append(case)
            time.sleep(slowly)
            path.write_bytes(content)
            return {"scale": 2.0}

        return find_or_build(tmp_path / "cases", [*case, environment], make)

    get.made = []
    return get


def test_a_case_is_built_once_and_reused(get):
    first, second = get(name(n=1)), get(name(n=1))

    assert first == second
    assert first.qp.read_bytes() == b"content"
    assert first.meta == {"scale": 2.0}
    assert len(get.made) == 1


def test_one_of_many_concurrent_callers_builds(get):
    # file locks belong to open files, so threads compete for them like processes
    with ThreadPoolExecutor(8) as pool:
        entries = list(pool.map(lambda _: get(name(n=1), slowly=0.1), range(8)))

    assert len({e.digest for e in entries}) == len(get.made) == 1


@pytest.mark.parametrize("damage", ["content", "index", "truncated index", "missing"])
def test_a_damaged_entry_is_built_again(get, damage):
    path = get(name(n=1)).qp
    (index,) = path.parent.glob("*.json")
    match damage:
        case "content":
            path.write_bytes(b"Content")
        case "index":
            index.write_text(json.dumps({"digest": 3}))
        case "truncated index":
            index.write_text(index.read_text()[:-9])
        case _:
            path.unlink()

    assert get(name(n=1)).qp.read_bytes() == b"content"
    assert len(get.made) == 2


def test_a_build_that_fails_leaves_no_entry(get, tmp_path):
    def fails(path):
        path.write_bytes(b"half")
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        find_or_build(tmp_path / "cases", [*name(n=1), "here"], fails)

    assert {p.suffix for p in (tmp_path / "cases").iterdir()} == {".lock"}
    assert get(name(n=1)).qp.read_bytes() == b"content"


@pytest.mark.parametrize("change", ["digest", "meta"])
def test_an_entry_that_was_changed_is_built_again(get, change):
    first, other = get(name(n=1)), get(name(n=2), content=b"other")
    index = next(
        path
        for path in first.qp.parent.glob("*.json")
        if json.loads(path.read_text())["digest"] == first.digest
    )
    row = json.loads(index.read_text())
    row[change] = other.digest if change == "digest" else {"scale": 3.0}
    index.write_text(json.dumps(row))

    assert get(name(n=1)) == first
    assert len(get.made) == 3
