"""Residuals and certificates on several ranks, compared with one process."""

import json
import os
import subprocess
import sys
from functools import cache

import numpy as np
import pytest

from mortarbench.harness.distributed import mpi
from mortarbench.harness.distributed.vectors import DISTRIBUTED_DIGEST
from tests.support import ROOT, SUPPORT

pytestmark = pytest.mark.together

#: case in which some discs slip and others stick
SPACE = "greco/n=4/dim=3/depth=2/feti=2/dual"
#: case whose quantities are condition numbers
PLATE = "plate/Sx=4/Sy=2/n=4/dual"
HELD = (
    "beam-ring/Nr=4/Nh=3/steps=1/feti=4/dual",
    "beam-ring/Nr=5/Nh=3/steps=1/feti=3/glue=redundant/friction=tresca/bound=1e5/dual",
    "obstacle/n=10/shape=hemisphere/feti=3/dual",
    PLATE,
    "beam-ring/Nr=2/Nh=2/steps=1/friction=coulomb/mu=0.3/feti=3/dual",
    "greco/n=8/feti=3/dual",
    SPACE,
)
HELD_BY_CONTACT = "membranes/S=2/n=3/dual"
ELIMINATED = "plate/Sx=1/Sy=4/n=2/supports=eliminated/dual"
#: case with dependent rows at crosspoints
REDUNDANT = "plate/Sx=3/Sy=3/n=2/pattern=column/jump=10/glue=redundant/dual"
PATCH = "contact-patch/feti=3/dual"
HERTZ = "hertz-cylinder/n=2/m=3/feti=5/friction=tresca/bound=1e6/dual"
MINDLIN = "hertz-cylinder/n=1/m=1/feti=9/friction=coulomb/mu=0.3/Q=0.5/dual"
#: relative difference of bounds: ranks use the sum over subdomains, one process the
#: stored K
ROUNDING = 1e-4


#: cases that take several seconds on two ranks, or resemble a quick one
LONG = (HELD[0], *HELD[3:], HELD_BY_CONTACT, REDUNDANT, HERTZ, MINDLIN)
QUICK = tuple(
    case
    for case in (*HELD, HELD_BY_CONTACT, ELIMINATED, REDUNDANT, PATCH)
    if case not in LONG
)


def marked(*cases):
    """Mark the long ones among the cases as slow."""
    return [
        pytest.param(case, marks=[pytest.mark.slow] * (case in LONG)) for case in cases
    ]


SHORT = (8, 2, ("membranes/S=3/n=2/dual", "disc under rollers"))
#: modules that the default tests run on the same two ranks
BY_DEFAULT = (("evaluated_on_ranks", *QUICK), ("fooled_on_ranks", SHORT[0], *SHORT[2]))


def result(ranks, *program):
    """Return the result of a module of `tests.support` on several ranks."""
    same = ranks == 2 and program in BY_DEFAULT
    programs = BY_DEFAULT if same else (program,)
    return results(ranks, programs)[programs.index(program)]


@cache
def results(ranks, programs):
    """Run programs on the same ranks; return their results."""
    done = subprocess.run(
        [
            mpi.mpiexec(), "-n", str(ranks), sys.executable, "-m", "mpi4py",
            str(SUPPORT / "programs_on_ranks.py"), json.dumps(programs),
        ],
        cwd=ROOT, capture_output=True, text=True, env=os.environ | {"PYTHONPATH": "."},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def evaluated(ranks, cases):
    """Return evaluations of the same answers on several ranks and in one process."""
    return result(ranks, "evaluated_on_ranks", *cases)


@pytest.fixture(params=[2, *(pytest.param(n, marks=pytest.mark.slow) for n in (1, 4))])
def ranks(request):
    """Return the number of ranks."""
    return request.param


@pytest.fixture
def found(ranks):
    """Return a function that evaluates the answers to a case on several ranks."""
    return lambda case: evaluated(ranks, LONG if case in LONG else QUICK)[case]


@pytest.mark.parametrize(
    "case", marked(*HELD, HELD_BY_CONTACT, ELIMINATED, HERTZ, MINDLIN)
)
def test_residuals_by_ranks_are_those_of_one_process(found, case):
    for answer in found(case):
        one = answer["by_one"]["values"]

        assert answer["by_ranks"]["values"] == pytest.approx(one, rel=1e-6, abs=1e-12)


@pytest.mark.parametrize("case", marked(*HELD, HELD_BY_CONTACT, PATCH))
def test_a_wrong_answer_is_refuted_by_ranks(found, case):
    *sound, wrong = (answer["by_ranks"]["values"] for answer in found(case))

    assert max(wrong["primal"], wrong["dual"]) > 1e-4
    assert max(sound[-1]["primal"], sound[-1]["dual"]) < 1e-5


@pytest.mark.parametrize("case", marked(*HELD))
def test_certificates_by_ranks_are_those_of_one_process(found, case):
    for answer in found(case):
        bounds, one = answer["by_ranks"]["bounds"], answer["by_one"]

        assert answer["same"]
        # ranks bound the rounding of any assembled K, one process evaluates its own K
        assert bounds["energy_bound"] == pytest.approx(
            one["bound"], rel=ROUNDING, abs=1e-10
        )
        assert bounds["certificate"] == pytest.approx(
            one["parts"], rel=ROUNDING, abs=1e-10
        )


@pytest.mark.parametrize("case", marked(HELD_BY_CONTACT, PATCH, HERTZ, MINDLIN))
def test_certificates_of_bodies_held_by_contact_are_those_of_one_process(found, case):
    for answer in found(case):
        bounds, one = answer["by_ranks"]["bounds"], answer["by_one"]

        assert answer["same"]
        # û is moved out of the other body by rounding errors, which affect terms below
        # 1e-8
        assert bounds["energy_bound"] == pytest.approx(
            one["bound"], rel=ROUNDING, abs=1e-11
        )
        assert bounds["certificate"] == pytest.approx(
            one["parts"], rel=ROUNDING, abs=1e-10
        )


def test_eliminated_supports_are_certified_in_floating_subdomains(found):
    for answer in found(ELIMINATED):
        # one process uses the undivided body, whose u_λ is the nearest to û
        bound, least = answer["by_ranks"]["bounds"], answer["by_one"]["bound"]

        assert answer["same"]
        assert answer["by_ranks"]["notes"] == []
        assert (1 - ROUNDING) * least <= bound["energy_bound"] <= 2 * least < 1


@pytest.mark.parametrize(
    "case",
    marked(*(c for c in HELD if c != PLATE), HELD_BY_CONTACT, PATCH, HERTZ, MINDLIN),
)
def test_quantities_by_ranks_are_those_of_one_process(found, case):
    for answer in found(case):
        by_ranks, by_one = quantities_of_both(answer)

        assert list(by_ranks) == list(by_one)
        for name, value in by_one.items():
            # the gap of a node in contact is zero up to rounding
            least = 1e-15 if name.endswith("smallest_gap") else 1e-6
            assert by_ranks[name] == pytest.approx(value, rel=1e-9, abs=least), name


@pytest.mark.parametrize("case", marked(PLATE, ELIMINATED, REDUNDANT))
def test_condition_numbers_by_ranks_are_those_of_one_process(found, case):
    for answer in found(case):
        by_ranks, by_one = quantities_of_both(answer)

        assert list(by_ranks) == list(by_one)
        for name, value in by_one.items():
            error = by_one.get(f"{name}_error", 0) + by_ranks.get(f"{name}_error", 0)
            least = 1e-9 if not name.endswith("_error") else 1e-5 * by_one[name[:-6]]
            assert by_ranks[name] == pytest.approx(
                value, rel=1e-9, abs=max(error, least)
            ), name


def test_an_exact_solution_is_recovered_across_subdomains(found):
    """In the patch test, the stress is uniaxial; each body has several subdomains."""
    answer = found(PATCH)[-2]["by_ranks"]["quantities"]
    # plane strain, ν = 0.3: σ_z = −0.3p, and σ_vM = √(1 − ν + ν²)·p
    exact = (1 - 0.3 + 0.3**2) ** 0.5 * 1e6

    assert answer["stress_error"] < 1e-5
    for largest in answer["max_von_mises"].values():
        assert largest == pytest.approx(exact, rel=1e-5)


@pytest.mark.parametrize(
    "case", marked(*HELD, HELD_BY_CONTACT, ELIMINATED, PATCH, HERTZ)
)
def test_sizes_are_those_of_the_whole(found, case):
    for answer in found(case):
        assert answer["sizes"][0] == answer["sizes"][1]


def test_digests_depend_on_the_qp_and_not_on_the_number_of_ranks(ranks):
    digests = [answers[0]["digests"] for answers in evaluated(ranks, QUICK).values()]

    assert all(by_ranks == by_one for by_ranks, by_one in digests)
    assert len({digest for digest, _ in digests}) == len(QUICK)
    assert all(digest.startswith(DISTRIBUTED_DIGEST) for digest, _ in digests)


SEARCHED = (
    HELD[0], "membranes/S=3/n=2/dual", "contact-patch/ratio=0.1/feti=3/dual",
    "contact-patch/ratio=0.1/friction=coulomb/mu=0.2/feti=3/dual", MINDLIN, SPACE,
    "sliding disc", "disc under rollers", "tilted disc", "soft disc",
)  # fmt: skip


def searched(count, ranks, names):
    """Return faults that a search on several ranks finds, and reasons of refusals."""
    return result(ranks, "fooled_on_ranks", count, *names)


@pytest.mark.parametrize(
    ("count", "ranks", "names"),
    [
        SHORT,
        pytest.param(8, 4, SHORT[-1], marks=pytest.mark.slow),
        *(pytest.param(60, n, SEARCHED, marks=pytest.mark.slow) for n in (2, 3)),
    ],
)
def test_no_answer_is_found_whose_error_exceeds_the_bound_of_ranks(count, ranks, names):
    for found in searched(count, ranks, names)["searches"].values():
        assert found["faults"] == []
        assert len(found["sharp"]) == count
        assert np.median(found["sharp"]) < 2


def test_an_unbalanced_load_is_refused_with_the_message_of_one_process():
    pushed, lifted = searched(*SHORT)["refusals"]

    assert pushed[0] == pushed[1]
    assert lifted[0] == lifted[1]
    assert "nothing balances the load of body upper along x" in pushed[0]
    assert "only tensile contact forces" in lifted[0]


def quantities_of_both(answer):
    """Return the numbers from ranks and from one process, without the memory of blocks.

    The memory differs, since each rank stores separate blocks of its classes.
    """
    both = [flat(answer[one]["quantities"]) for one in ("by_ranks", "by_one")]
    for found in both:
        del found["/explicit_mib"]
    return both


def flat(quantities, prefix=""):
    """Return numbers by their paths in nested tables and lists."""
    match quantities:
        case dict():
            items = quantities.items()
        case list():
            items = enumerate(quantities)
        case _:
            return {prefix: quantities}
    return {k: v for key, q in items for k, v in flat(q, f"{prefix}/{key}").items()}
