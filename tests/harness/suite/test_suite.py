"""Suites: content of their TOML, and messages for mistakes."""

import re
from dataclasses import dataclass, field
from typing import Annotated, ClassVar

import pytest

from mortarbench import problems, solvers
from mortarbench.harness import InputError, Range
from mortarbench.harness.plugin import Family
from mortarbench.harness.registry import SolverSpec
from mortarbench.harness.suite.solver_options import selected
from mortarbench.harness.suite.suite import load_suite
from tests.support import ROOT
from tests.support.refusals import refused


@dataclass(frozen=True)
class Method:
    max_iter: int = 200

    def declines(self, qp):
        return None

    def prepare(self, qp, tol):
        raise AssertionError("it is only named, never run")


@dataclass(frozen=True)
class Well(Family):
    forms: ClassVar = ("primal", "dual")

    n: Annotated[int, Range(1)] = 1
    m: int = 1
    kind: str = "soft"

    def build(self, form, reference):
        raise AssertionError("it is only named, never run")


@dataclass(frozen=True)
class Stored(Well):
    forms: ClassVar = ("qp",)
    path_suffix: ClassVar = ""

    path: str = ""


@dataclass(frozen=True)
class Tuned(Method):
    eps: float = 1e-4
    kind: str = "a"
    parts: list[int] = field(default_factory=list)


SOLVERS = {"osqp": Method(), "clarabel": Method(9), "other": Method(3)}
FAMILIES = {"well": Well()}

HEAD = 'name = "demo"\nsolvers = ["osqp"]\n'
BLOCK = '[[problems]]\nfamily = "well"\n'
MINIMAL = HEAD + BLOCK


@pytest.fixture
def load(tmp_path):
    def load(text, solvers=SOLVERS):
        path = tmp_path / "demo.toml"
        path.write_text(text)
        return load_suite(path, FAMILIES, solvers)

    return load


def names(suite):
    return [case.name for case in suite.cases.cold]


def test_a_suite_contains_the_values_of_the_file(load):
    suite = load(
        """
        name = "demo"
        tolerances = [1e-3, 1e-9]
        repeats = 7
        time_limit = 0.5
        memory_limit = 100
        solvers = ["osqp",
                   { name = "clarabel", label = "patient", options = { max_iter = 5 } }]
        [[problems]]
        family = "well"
        forms = ["dual"]
        params = { n = 2 }
        """
    )

    file = suite.file
    assert file.tolerances == (1e-3, 1e-9)
    assert (file.repeats, file.time_limit, file.memory_limit) == (7, 0.5, 100.0)
    assert suite.solvers[1] == SolverSpec(
        name="clarabel", label="patient", options={"max_iter": 5}
    )
    assert names(suite) == ["well/n=2/dual"]


def test_lists_span_a_grid_with_the_first_key_slowest(load):
    suite = load(
        MINIMAL + 'forms = ["dual"]\nparams = { m = [2, 3], kind = "hard", n = [4, 5] }'
    )

    assert [(c.params["m"], c.params["n"]) for c in suite.cases.cold] == [
        (2, 4), (2, 5), (3, 4), (3, 5)
    ]  # fmt: skip
    assert {c.params["kind"] for c in suite.cases.cold} == {"hard"}


def test_zipped_lists_vary_together_at_the_position_of_the_first(load):
    suite = load(
        MINIMAL
        + 'forms = ["dual"]\nzip = [["m", "n"]]\n'
        + 'params = { n = [2, 3], kind = ["soft", "hard"], m = [8, 9] }'
    )

    assert [tuple(c.params.values()) for c in suite.cases.cold] == [
        (2, 8, "soft"), (2, 8, "hard"), (3, 9, "soft"), (3, 9, "hard")
    ]  # fmt: skip


def test_a_case_of_two_blocks_is_measured_once(load):
    assert names(load(MINIMAL + BLOCK + "params = { n = [1, 2] }")) == [
        "well/primal", "well/dual", "well/n=2/primal", "well/n=2/dual"
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "repeat = 3\n" + MINIMAL,
            "unknown key 'repeat'; did you mean 'repeats'? know",
        ),
        ("repeats = 0\n" + MINIMAL, "repeats = 0; expected an integer >= 1"),
        ("memory_limit = nan\n" + MINIMAL, "memory_limit = nan; expected a number > 0"),
        ("tolerances = 1e-6\n" + MINIMAL, "tolerances = 1e-06; expected a list"),
        (
            "tolerances = [1.0]\n" + MINIMAL,
            "tolerances[0] = 1.0; expected a number < 1.0",
        ),
        ("tolerances = [0.1, 0.1]\n" + MINIMAL, "tolerances = (0.1, 0.1); expected d"),
        (BLOCK, "name is missing"),
        (
            "name = 'a/b'\nsolvers = ['osqp']\n" + BLOCK,
            "name = 'a/b'; expected a folder name",
        ),
        ("name = 'a'\n" + BLOCK, "solvers is missing or empty"),
        ("name = 'a'\nsolvers = 'osqp'\n" + BLOCK, "solvers = 'osqp'; expected a list"),
        (HEAD, "problems is missing or empty"),
        (HEAD + "[[problems]]", "problems[0]: family is missing"),
        (
            MINIMAL + "form = []",
            "problems[0]: unknown key 'form'; did you mean 'forms'",
        ),
        (MINIMAL + "forms = ['duel']", "problems[0]: well: unknown form 'duel'; did y"),
        (MINIMAL + "params = { n = [] }", "problems[0]: params.n is empty; expected"),
        (MINIMAL + "params = { k = 1 }", "problems[0]: well: unknown key 'k'; "),
        (MINIMAL + "params = { n = 0 }", "problems[0]: well: n=0 must be at least 1"),
        (MINIMAL + BLOCK + "params = { n = [2, 0] }", "problems[1]: well: n=0 must be"),
        (
            MINIMAL + "zip = [['n', 'n']]\nparams = { n = [2, 3] }",
            "problems[0]: zip = [['n', 'n']]; expected groups of different keys",
        ),
        (
            MINIMAL + "zip = [['n', 'm']]\nparams = { n = [2, 3], m = [2, 3, 4] }",
            "problems[0]: zip = [['n', 'm']]; expected groups of different keys",
        ),
        (
            HEAD + "[[problems]]\nfamily = 'wall'",
            "problems[0]: unknown family 'wall'; did you mean 'well'? known: well",
        ),
    ],
)
def test_mistakes_are_reported_with_file_place_and_remedy(
    load, tmp_path, text, message
):
    with refused(start=f"{tmp_path / 'demo.toml'}: {message}"):
        load(text)


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ("'oskp'", "solvers[1]: unknown solver 'oskp'; did you mean 'osqp'? known: "),
        ("{ label = 'a' }", "solvers[1]: name is missing"),
        (
            "'osqp'",
            "solvers: label 'osqp' is used twice; expected different labels",
        ),
        (
            "{ name = 'clarabel', options = { max_itr = 9 } }",
            "solvers[1]: clarabel: unknown option 'max_itr'; did you mean 'max_iter'?",
        ),
    ],
)
def test_mistakes_in_solvers_are_reported_with_their_place(load, entry, message):
    with refused(f"demo.toml: {message}"):
        load(f"name = 'a'\nsolvers = ['osqp', {entry}]\n{BLOCK}")


@pytest.fixture
def demo(load):
    return load(
        "name = 'demo'\n"
        "solvers = ['osqp', { name = 'clarabel', label = 'patient' }]\n"
        "[[problems]]\nfamily = 'well'\nparams = { n = [2, 12] }\n"
    )


def test_solvers_are_chosen_by_label_or_added_by_name(demo):
    chosen = selected(demo.solvers, ["other", "patient", "other"], SOLVERS)

    assert [(s.name, s.label) for s in chosen] == [
        ("other", "other"), ("clarabel", "patient")
    ]  # fmt: skip
    with pytest.raises(InputError, match="unknown solver 'patent'; did you mean 'p"):
        selected(demo.solvers, ["patent"], SOLVERS)


def test_patterns_choose_cases_in_the_suite_s_order(demo):
    patterns = ["*/n=12/*", "well/n=2/dual", "*/n=12/dual"]
    chosen = demo.cases.selected(patterns).cold

    assert [case.name for case in chosen] == [
        "well/n=2/dual", "well/n=12/primal", "well/n=12/dual"
    ]  # fmt: skip


@pytest.mark.parametrize("pattern", ["well", "x*", "*/N=2/*", "well/n=2"])
def test_a_pattern_without_cases_is_refused(demo, pattern):
    with pytest.raises(InputError, match="matches none of the 4 cases of the suite"):
        demo.cases.selected(["*", pattern])


def shipped(name):
    path = ROOT / "suites" / f"{name}.toml"
    return load_suite(path, problems.PROBLEMS, solvers.SOLVERS)


def folder_of_files(folder, monkeypatch, *, here=True):
    """Write some files, and change to `folder` or to its subfolder `elsewhere`."""
    (folder / "set" / "more.qps").mkdir(parents=True)
    (folder / "elsewhere").mkdir()
    for name in ("b.qps", "a.qps", "c[1].qps", "d.txt", "more.qps/e.qps"):
        (folder / "set" / name).write_text("")
    monkeypatch.chdir(folder if here else folder / "elsewhere")


def patterned(folder, path):
    (folder / "s.toml").write_text(
        HEAD + f'[[problems]]\nfamily = "stored"\nparams = {{ path = {path} }}\n'
    )
    families = {"stored": Stored()}
    return [
        c.params["path"]
        for c in load_suite(folder / "s.toml", families, SOLVERS).cases.cold
    ]


@pytest.mark.parametrize(
    ("path", "expected"),
    [
        ('"set/*.qps"', ["set/a.qps", "set/b.qps", "set/c[1].qps"]),
        ('["set/b*", "set/[a-b].qps"]', ["set/b.qps", "set/a.qps"]),
        ('"set/c[1].qps"', ["set/c[1].qps"]),
        ('"set/?.txt"', ["set/d.txt"]),
        ('"set/*/*.qps"', ["set/more.qps/e.qps"]),
    ],
)
def test_a_pattern_of_paths_is_the_files_that_match_sorted(
    tmp_path, monkeypatch, path, expected
):
    folder_of_files(tmp_path, monkeypatch)

    assert patterned(tmp_path, path) == expected


def test_a_pattern_is_also_searched_beside_the_suite(tmp_path, monkeypatch):
    folder_of_files(tmp_path, monkeypatch, here=False)

    assert patterned(tmp_path, '"set/[ab].qps"') == ["../set/a.qps", "../set/b.qps"]


def test_a_pattern_without_files_is_refused(tmp_path, monkeypatch):
    folder_of_files(tmp_path, monkeypatch)

    with pytest.raises(InputError) as e:
        patterned(tmp_path, '["set/a.qps", "set/*.npz"]')
    assert str(e.value) == (
        f"{tmp_path}/s.toml: problems[0]: params.path = 'set/*.npz' matches no file; "
        "expected a pattern relative to the working directory or to the folder of "
        "the suite"
    )


def test_a_sequence_may_run_along_zipped_keys():
    paths = shipped("finite-strain").cases

    assert len(paths.cold) == 80
    assert [
        [(c.params["step"], c.params["newton"]) for c in s] for s in paths.sequences
    ] == [[(step, newton) for step in range(1, 11) for newton in range(1, 5)]] * 2


@pytest.mark.parametrize("key", ["'dim'", "'m'"])
def test_a_sequence_along_no_list_is_refused(tmp_path, key):
    file = tmp_path / "s.toml"
    file.write_text(
        "name = 's'\nsolvers = ['smalbe']\n[[problems]]\nfamily = 'obstacle'\n"
        f"sequence = {key}\nparams = {{ dim = 2, n = [4, 8] }}\n"
    )
    with pytest.raises(InputError, match=r"problems\[0\]: sequence = "):
        load_suite(file, problems.PROBLEMS, solvers.SOLVERS)


def test_a_list_among_the_options_spans_a_grid_of_labelled_solvers(load):
    suite = load(
        'name = "demo"\nsolvers = ["osqp", { name = "other", label = "mine", '
        'options = { max_iter = [5, 6], eps = [1e-3, 1e-6], kind = "a" } }]\n' + BLOCK,
        SOLVERS | {"other": Tuned()},
    )

    assert [(s.label, s.options) for s in suite.solvers] == [
        ("osqp", {}),
        *(
            (
                f"mine max_iter={n} eps={eps}",
                {"kind": "a", "max_iter": n, "eps": eps},
            )
            for n in (5, 6)
            for eps in (0.001, 1e-06)
        ),
    ]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("max_iter = [5, 5]", "label 'osqp max_iter=5' is used twice"),
        ("max_iter = []", "options span 0 variants of osqp; expected 1 to 1000"),
        ("max_iter = [5, 'x']", "osqp: max_iter = 'x'; expected an integer"),
        ("max_itr = [5, 6]", "unknown option 'max_itr'; did you mean 'max_iter'?"),
    ],
)
def test_a_wrong_grid_of_options_is_refused(load, options, message):
    text = f"solvers = [{{ name = 'osqp', options = {{ {options} }} }}]\n"
    with pytest.raises(InputError, match=re.escape(message)):
        load(f'name = "demo"\n{text}{BLOCK}')
