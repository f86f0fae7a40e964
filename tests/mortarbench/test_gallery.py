"""The notebooks of docs/gallery run unchanged and show what their text states.

Slow tests run four notebooks, each in its own kernel in an empty folder, and the code
of `own-solver` and `stick-and-slip` without a kernel. By default, only the code of
`own-steps` and `textbook` runs.
"""

import json
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from tests.support import ROOT
from tests.support.fork_server import INSTALL

GALLERY = ROOT / "docs" / "gallery"


def read(name):
    import nbformat  # slow; test collection does not need it

    notebook = nbformat.read(GALLERY / f"{name}.ipynb", as_version=4)
    nbformat.validate(notebook)
    return notebook


@pytest.fixture
def execute(tmp_path, monkeypatch):
    """Run a notebook; return the values of expressions at its end."""
    for name in ("IPYTHONDIR", "JUPYTER_CONFIG_DIR", "JUPYTER_RUNTIME_DIR"):
        monkeypatch.setenv(name, str(tmp_path / name.lower()))
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "1")
    folder = tmp_path / "work"
    folder.mkdir()

    def run(name, *expressions):
        from nbclient import NotebookClient
        from nbformat.v4 import new_code_cell

        notebook = read(name)
        told = f"import json; print(json.dumps([{','.join(expressions)}]))"
        end = new_code_cell(told)
        notebook.cells.insert(0, new_code_cell(INSTALL))
        notebook.cells.append(end)
        client = NotebookClient(
            notebook,
            timeout=300,
            resources={"metadata": {"path": str(folder)}},
        )
        client.execute()
        return json.loads(end.outputs[0].text), kinds(notebook.cells[1:-1])

    return run


def kinds(cells):
    """Count the outputs of cells by their richest format."""
    outputs = [o for c in cells for o in c.get("outputs", []) if "data" in o]
    return Counter(
        next(
            kind for kind in ("image/png", "text/html", "text/plain") if kind in o.data
        )
        for o in outputs
    )


def test_notebooks_are_stored_without_outputs():
    for path in GALLERY.glob("*.ipynb"):
        notebook = read(path.stem)
        code = [cell for cell in notebook.cells if cell.cell_type == "code"]
        assert not any(cell.outputs or cell.execution_count for cell in code), path


@pytest.mark.slow
def test_a_first_comparison(execute):
    """All answers are verified; at each tolerance, the errors on dual forms differ by a
    factor of at least five, and all errors are below √tol.
    """
    (statuses, spread, worst), shown = execute(
        "first-comparison",
        "sorted(results.df.status.unique())",
        "(errors.loc['dual'].max() / errors.loc['dual'].min()).min()",
        "max(errors[tol].max() / tol**0.5 for tol in errors)",
    )
    assert statuses == ["declined", "verified"]
    assert spread > 5
    assert worst < 1
    assert shown["image/png"] == 2


@pytest.fixture
def run_code(tmp_path, monkeypatch):
    """Run the code of a notebook without a kernel; return its variables.

    The function takes the name of a notebook, and texts that replace others.
    """
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")

    def run(name, replacements=()):
        variables = {}
        for cell in read(name).cells:
            magic, _, text = cell.source.partition("\n")
            if magic.startswith("%%writefile "):
                for old, new in replacements:
                    text = text.replace(old, new)
                Path(magic.split()[1]).write_text(text)
            elif cell.cell_type == "code":
                exec(cell.source, variables)
        return variables

    return run


def test_the_code_of_your_own_steps(run_code):
    """SSOR saves products; on the string, an additional projected step saves more.

    With the rule that increases the objective, fallbacks replace all expansions.
    """
    found = run_code("own-steps")
    products, counts = found["counts"].P_products, found["counts"]
    bearing, string = found["cases"]
    uphill = found["uphill"]

    assert set(counts.verdict) == {"verified"}
    assert products[bearing, "ssor"] < products[bearing, "textbook"] / 10
    assert products[string, "ssor-projected"] < products[string, "ssor"]
    assert products[string, "ssor"] < products[string, "textbook"] / 4
    assert str(uphill.verdict) == "verified"
    assert uphill.solution.counts["fallback"] > 0
    assert "expansion" not in uphill.solution.counts
    found["plt"].close("all")


def test_the_code_of_the_textbook(run_code):
    """The estimate of the norm agrees with the largest eigenvalue, no inner step
    increases the cost, and all rules lead to the same answer.
    """
    found = run_code("textbook")
    inner, outer, answers = found["inner"], found["outer"], found["answers"]

    assert found["N"] == pytest.approx(found["exact"], rel=1e-3)
    assert np.linalg.eigvalsh(found["H"])[-1] == pytest.approx(1, rel=1e-3)
    assert found["run"].steps == "".join(inner.step)
    assert (np.diff(inner.cost) <= 1e-12).all()
    assert outer.active.iloc[-1] == (found["answer"].solution.x == found["qp"].lb).sum()
    for answer in answers.values():
        assert str(answer.verdict) == "verified"
        assert answer.solution.x == pytest.approx(
            found["force"], abs=2e-5 * np.abs(found["force"]).max()
        )
    found["plt"].close("all")


@pytest.mark.slow
def test_the_code_of_your_own_solver(run_code):
    """The gradient method reduces the error by the factor 1 − 1/κ per step, and some of
    its claims are refuted.

    Verdicts do not depend on repeats, so only one of the three repeats is measured.
    """
    found = run_code("own-solver", [("repeats = 3", "repeats = 1")])
    plain, moves, df = found["rates"]["plain"], found["moves"], found["results"].df

    assert moves[-1] / moves[-2] == pytest.approx(plain, rel=1e-3)
    assert set(df[df.status == "inaccurate"].solver) == {"momentum", "plain"}
    assert set(found["checks"].grade) == {"decline", "pass"}
    assert found["done"].returncode == 0
    found["plt"].close("all")


@pytest.mark.slow
def test_your_own_bodies(execute):
    """With mesh refinement, mortar pressures converge to those of Hertz; nodal
    pressures do not.
    """
    (rows,), shown = execute("own-bodies", "rows")
    off = {
        (row["contact"], row["cells per half width"]): abs(row["largest pressure"])
        for row in rows
    }
    l2 = {(r["contact"], r["cells per half width"]): r["pressure, L2"] for r in rows}

    assert {row["verdict"] for row in rows} == {"verified"}
    assert all(abs(row["total force"]) < 1e-8 for row in rows)
    assert off["mortar", 30] < 0.005
    assert l2["mortar", 30] < l2["mortar", 10] / 3
    assert off["nts", 30] > 0.02
    assert shown["image/png"] == 2


@pytest.mark.slow
def test_the_code_of_stick_and_slip(run_code):
    """Stick radii are too large by a fraction of a cell; for ν > 0 the slip directions
    diverge.
    """
    found = run_code("stick-and-slip")
    errors, angles = found["errors"], found["angles"]

    assert str(found["answer"].verdict) == "verified"
    assert (errors[128] > 0).all()
    assert (errors[128] < 0.004).all()
    assert np.abs(errors[32]).max() > 2 * errors[128].max()
    assert np.abs(angles[0.0]).max() < 1e-4
    assert np.abs(angles[0.3]).max() < np.abs(angles[0.45]).max()
    found["plt"].close("all")
