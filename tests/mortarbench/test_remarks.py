"""Remarks printed with `verified` for two blocks whose displacements are known
analytically.

Each block has side 2 and Poisson's ratio zero. A pressure p causes the strain p/E, so
the upper end moves by 4p/E if the blocks are pressed together.
"""

import json

import numpy as np
import pytest

import mortarbench as mb
from mortarbench.cli.main import main
from mortarbench.harness import Verdict
from mortarbench.registries import Registries
from mortarbench.verification import remarks
from tests.support.gmsh_files import BLOCKS, stacked_blocks

pytestmark = pytest.mark.together

APART = (  # the upper block hangs from its top and is pulled upwards
    BLOCKS.replace('[[loads]]\nboundary = "top"', '[[loads]]\nboundary = "foot"')
    .replace("-1e6", "1e6")
    .replace("[[loads]]", '[[supports]]\nboundary = "top"\nfix = ["x", "y"]\n[[loads]]')
)


def solved(folder, form="dual", solver="smalbe", **given):
    return mb.solve(f"bodies:{stacked_blocks(folder, **given)}/{form}", solver)


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    return solved(tmp_path_factory.mktemp("blocks"))


def test_an_answer_as_expected_has_no_remarks(sound):
    assert sound.verdict is Verdict.VERIFIED
    assert sound.remarks == ()
    assert "note:" not in repr(sound)
    assert sound.to_dict()["remarks"] == []


@pytest.mark.parametrize(("pressure", "is_large"), [(0.4, False), (0.6, True)])
def test_displacements_larger_than_the_body_cause_a_remark(
    tmp_path, pressure, is_large
):
    """The displacement 4·0.6 exceeds the side 2, whereas 4·0.4 does not."""
    toml = BLOCKS.replace("-1e6", f"{-pressure * 1e9}")
    found = solved(tmp_path, toml=toml)

    assert found.verdict is Verdict.VERIFIED
    assert len(found.remarks) == is_large
    if is_large:
        (told,) = found.remarks
        assert told.startswith(
            "body 'upper' moves by up to 2.4 m, which exceeds its size of 2 m"
        )
        assert f"note: {told}" in repr(found).splitlines()
        assert found.to_dict()["remarks"] == [told]


@pytest.mark.parametrize(
    ("form", "solver"),
    [("dual", "smalbe"), ("primal", "clarabel"), ("dual-bounds", "osqp")],
)
def test_a_contact_that_never_closes_causes_a_remark(tmp_path, form, solver):
    """Interior-point solutions and iterates of OSQP contain contact forces of the size
    of rounding errors.
    """
    toml = APART.replace('boundary = "base"\nfix = ["y"]', 'boundary = "base"\n'
                         'fix = ["x", "y"]')  # fmt: skip
    found = solved(tmp_path, form, solver, toml=toml, gap=0.5)
    (told,) = found.remarks

    assert found.verdict is Verdict.VERIFIED
    assert told.startswith("no node is in contact, so the answer is the same")


@pytest.mark.parametrize(("overlap", "is_named"), [(0.01, False), (0.1, True)])
def test_bodies_that_overlap_before_any_load_cause_a_remark(
    tmp_path, overlap, is_named
):
    """An overlap of 0.1 is 5 % of the side 2 of each block."""
    case = mb.build(f"bodies:{stacked_blocks(tmp_path, gap=-overlap)}/dual")

    assert len(case.remarks) == is_named
    if is_named:
        assert "a slave node lies 0.1 m inside its master" in case.remarks[0]


def test_an_answer_has_the_remarks_on_the_input_too(tmp_path, command):
    """The blocks overlap, are softer than rubber and are compressed by 60 %."""
    toml = BLOCKS.replace("1e9", "1e4").replace("-1e6", "-6e3")
    case = f"bodies:{stacked_blocks(tmp_path, gap=-0.1, toml=toml)}/dual"
    answer = mb.solve(case, "smalbe")
    texts = (
        "softer than rubber",
        "softer than rubber",
        "lies 0.1 m inside",
        "moves by",
    )

    assert len(answer.remarks) == len(texts)
    for remark, text in zip(answer.remarks, texts, strict=True):
        assert text in remark
    _, out, _ = command("solve", case, "--solver", "smalbe", "--json")
    assert json.loads(out)["remarks"] == [*answer.remarks]


@pytest.mark.parametrize(
    ("bound", "told"),
    [
        (0.009, None),
        (0.83, "the solver's error is only certified to be at most 83 %;"),
        (np.inf, "the certificate does not bound the solver's error"),
    ],
)
def test_a_weak_certificate_causes_a_remark(sound, bound, told):
    record = sound.record.replace(energy_bound=bound)
    found = remarks(sound.case, record, sound.solution)

    assert [text.startswith(told) for text in found] == [True] * (told is not None)


def test_a_master_without_free_nodes_leaves_standard_output_to_results(tmp_path, capfd):
    """An empty matrix would make LAPACK print an error on standard output."""
    toml = BLOCKS + '[[supports]]\nboundary = "table"\nfix = ["x", "y"]\n'
    case = f"bodies:{stacked_blocks(tmp_path, toml=toml)}/dual"
    main(Registries(), ["solve", case, "--solver", "smalbe", "--json"])

    assert json.loads(capfd.readouterr().out)["status"] == "verified"
