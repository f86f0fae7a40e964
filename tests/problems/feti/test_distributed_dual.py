"""Shares assembled by ranks from the keys of a case equal the QP of one process."""

import json
import os
import subprocess
import sys
from functools import cache

import numpy as np
import pytest

from mortarbench.harness.distributed import mpi
from mortarbench.harness.names import parse
from mortarbench.problems import PROBLEMS
from tests.support import ROOT, SUPPORT, press

pytestmark = pytest.mark.together

DISCS = "contact-patch/lower=4/upper=3/friction=tresca/bound=1e5/feti=2/dim=3/dual"
CASES = (
    "beam-ring/Nr=4/Nh=3/steps=1/feti=4/dual",
    "beam-ring/Nr=5/Nh=3/steps=1/feti=3/glue=redundant/friction=tresca/bound=1e5/dual",
    "contact-patch/feti=3/slave=upper/ratio=5/dual",
    "membranes/S=2/n=3/dual",
    "plate/Sx=3/Sy=2/n=3/ny=2/pattern=checkerboard/jump=10/load=edge/dual",
    "plate/Sx=3/Sy=3/n=3/ny=2/pattern=column/jump=10/supports=eliminated/dual",
    "plate/Sx=1/Sy=4/n=2/supports=eliminated/glue=redundant/dual",
    "beam-ring/Nr=4/Nh=3/steps=5/step=1/contact=mortar/feti=4/dual",
    "hertz-plane/n=1/feti=5/dual",
    "obstacle/n=11/shape=hemisphere/feti=4/dual",
    "hertz-cylinder/n=1/m=1/feti=5/friction=tresca/bound=1e5/slave=lower/dual",
    "cube-wall/n=4/feti=2/dual",
    "plate/Sx=2/Sy=2/n=2/pattern=checkerboard/jump=10/dim=3/Sz=2/dual",
    "contact-patch/lower=3/upper=2/feti=2/dim=3/distort=0.2/dual",
    DISCS,
)
#: cases of the default tests: each family of CASES, each gluing, friction, and
#: three-dimensional bodies
QUICK = (*CASES[1:4], CASES[5], *CASES[8:12], DISCS)
ALL_CASES = [
    pytest.param(case, marks=[pytest.mark.slow] * (case not in QUICK)) for case in CASES
]
#: small cases that depend on solutions of previous problems, at which contact is
#: linearised or from which the bound of Coulomb's law follows
LATER = (
    "beam-ring/Nr=1/Nh=1/steps=2/relin=2/friction=tresca/bound=1e6/feti=2/dual",
    "beam-ring/Nr=1/Nh=1/steps=2/relin=2/friction=coulomb/mu=0.3/feti=2/dual",
    "beam-ring/Nr=2/Nh=1/steps=2/loading=static/friction=coulomb/mu=0.3/iterate=2/"
    "contact=mortar/feti=2/dual",
    "contact-patch/ratio=5/friction=coulomb/mu=0.3/glue=redundant/feti=3/dual",
    "hertz-cylinder/n=1/m=1/friction=coulomb/mu=0.3/Q=0.2/peak=0.6/feti=9/dual",
    "greco/n=7/mu=0.4/iterate=2/feti=2/dual",
    "greco/n=4/dim=3/depth=2/feti=2/dual",
)
#: case in which an active set method alone cycles (`solvers.reference.operators`)
CIRCLES = (
    "beam-ring/Nr=1/Nh=3/radial=6/steps=2/relin=2/feti=7/contact=mortar/"
    "friction=coulomb/mu=0.3/loading=static/dual"
)
COUPLING_ROUNDING = 1e-14
SOLVED = 1e-10  #: accepted difference of two reference solutions


def emitted(ranks, cases):
    """Compare QPs emitted on several ranks with QPs of one process, by case."""
    done = subprocess.run(
        [
            mpi.mpiexec(), "-n", str(ranks), sys.executable, "-m", "mpi4py",
            str(SUPPORT / "emitted_on_ranks.py"), *cases,
        ],
        cwd=ROOT, capture_output=True, text=True, env=os.environ | {"PYTHONPATH": "."},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.fixture(scope="module")
def described(tmp_path_factory):
    """Return case names of user-defined bodies in subdomains, by topic."""
    path = press.described(tmp_path_factory.mktemp("press"))
    name = f"bodies:{path}/parts=8"
    return {
        "first": f"{name}/step=1/dual",
        "friction": f"{name}/steps=1/friction=tresca/bound=1e7/glue=redundant/dual",
        "coulomb": f"{name}/steps=1/friction=coulomb/mu=0.2/dual",
        "whole": f"bodies:{path}/steps=1/dual",
    }


def test_undecomposed_bodies_are_emitted_by_one_process(described):
    case = parse(described["whole"], PROBLEMS)

    assert case.family.emission(case.form, case.params) is None


@pytest.mark.slow
def test_ranks_iterate_coulomb_s_law_for_bodies_held_by_contact(described):
    for case in emitted(2, [described["coulomb"]]).values():
        assert case["entries"][0] == case["entries"][1]
        assert max(*case["errors"].values(), *case["bounds"]) < SOLVED, case


@pytest.fixture(
    scope="module",
    params=[2, *(pytest.param(n, marks=pytest.mark.slow) for n in (1, 4))],
)
def found(request, described):
    """Return a function from a case to the differences between distributed QPs and
    QPs of one process.
    """
    quick = (*QUICK, described["friction"])
    other = (*(case for case in CASES if case not in QUICK), described["first"])
    differences = cache(lambda cases: emitted(request.param, cases))
    return lambda case: differences(quick if case in quick else other)[case]


@pytest.mark.parametrize(
    "what", ["friction", pytest.param("first", marks=pytest.mark.slow)]
)
def test_ranks_assemble_their_parts_of_a_mesh_that_all_read(found, described, what):
    of = found(described[what])
    assert of["sizes"][0] == of["sizes"][1]
    assert of["entries"][0] == of["entries"][1]
    assert max(*of["errors"].values(), *of["bounds"]) < COUPLING_ROUNDING
    assert set(of["owners"]) == {1}
    assert of["torn"] == 0


@pytest.mark.parametrize("case", ALL_CASES)
def test_shares_are_the_qp_of_one_process_row_by_row(found, case):
    of = found(case)
    assert of["sizes"][0] == of["sizes"][1]
    assert of["entries"][0] == of["entries"][1]
    assert max(of["errors"].values()) < COUPLING_ROUNDING, of["errors"]
    assert max(of["bounds"]) < COUPLING_ROUNDING


@pytest.mark.parametrize("case", ALL_CASES)
def test_a_class_on_several_ranks_is_factorised_by_one_rank(found, case):
    of = found(case)
    assert sorted(of["factorised"]) == sorted(set(of["formed"]))


@pytest.mark.slow
@pytest.mark.parametrize("ranks", [1, 2])
def test_problems_after_solutions_equal_those_of_one_process(ranks):
    for name, of in emitted(ranks, LATER).items():
        assert of["sizes"][0] == of["sizes"][1]
        assert of["entries"][0] == of["entries"][1]
        assert of["discs"][0] == of["discs"][1]
        errors = *of["errors"].values(), *of["bounds"], of["radii"]
        assert max(errors) < SOLVED, (name, of)


def test_every_disc_has_one_owner(found):
    """Together, the ranks store the 16 discs of a single process, with equal indices,
    and with radii that are equal up to rounding."""
    of = found(DISCS)
    assert of["discs"][0] == of["discs"][1]
    assert len(of["discs"][0]) == 16
    assert of["radii"] < COUPLING_ROUNDING


@pytest.mark.slow
@pytest.mark.parametrize("ranks", [1, 2])
def test_the_reference_over_ranks_does_not_cycle(ranks):
    (of,) = emitted(ranks, [CIRCLES]).values()

    assert max(*of["errors"].values(), *of["bounds"]) < SOLVED, of


@pytest.mark.parametrize("case", ALL_CASES)
def test_every_row_has_one_owner_and_every_torn_unknown_one_rank(found, case):
    of = found(case)
    assert set(of["owners"]) == {1}
    assert len(of["owners"]) == of["sizes"][1][0]
    assert of["torn"] == 0


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_no_choice_of_keys_is_emitted_as_another_qp(seed):
    for case, of in emitted(
        2 + seed % 2, generated(np.random.default_rng(seed))
    ).items():
        assert of["sizes"][0] == of["sizes"][1], case
        assert max(*of["errors"].values(), *of["bounds"]) < COUPLING_ROUNDING, case
        assert set(of["owners"]) == {1}, case
        assert of["torn"] == 0, case


def generated(rng, count=8):
    """Yield names of small cases with blocks of all shapes and at least three
    subdomains."""
    for _ in range(count):
        glue = rng.choice(["orthonormal", "redundant"])
        law = rng.choice(["", "/friction=tresca/bound=1e5"])
        contact = rng.choice(["nts", "mortar"])
        method = f"glue={glue}/contact={contact}{law}/dual"
        n = rng.integers(1, 8, size=8)
        yield (
            f"beam-ring/Nr={n[0]}/Nh={n[1] % 4 + 1}/radial={n[2]}/steps=1/feti={n[3]}/"
            f"{method}"
        )
        yield (
            f"contact-patch/lower={n[4] + 3}/upper={n[5] + 3}/feti={n[6] % 3 + 1}/"
            f"slave={rng.choice(['upper', 'lower'])}/{method}"
        )
        yield (
            f"plate/Sx={n[0] % 3 + 1}/Sy={n[1] % 2 + 3}/n={n[2] % 4 + 1}/ny={n[3] % 4}/"
            f"pattern={rng.choice(['checkerboard', 'column'])}/jump=100/"
            f"load={rng.choice(['point', 'edge', 'nodal'])}/glue={glue}/"
            f"supports={rng.choice(['rows', 'eliminated'])}/dual"
        )
        yield f"membranes/S={n[4] % 3 + 2}/n={n[5] % 4 + 1}/glue={glue}/dual"
        yield (
            f"obstacle/n={n[4] + 6}/shape={rng.choice(['flat', 'hemisphere'])}/"
            f"feti={n[5] % 3 + 2}/glue={glue}/dual"
        )
        yield f"hertz-plane/n={n[0] % 3 + 1}/feti={n[1] % 4 + 2}/glue={glue}/dual"
        yield (
            f"hertz-cylinder/n={n[2] % 3 + 1}/m={n[3] % 3 + 1}/feti={n[4] + 3}/"
            f"ratio={n[5]}/slave={rng.choice(['upper', 'lower'])}/{method}"
        )


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_no_choice_of_keys_has_another_fixed_point_of_coulomb_s_law(seed):
    for case, of in emitted(
        1 + seed % 2, generated_with_coulomb_s_law(np.random.default_rng(seed))
    ).items():
        assert of["sizes"][0] == of["sizes"][1], case
        assert max(*of["errors"].values(), *of["bounds"]) < SOLVED, (case, of)
        assert set(of["owners"]) == {1}, case
        assert of["torn"] == 0, case


def generated_with_coulomb_s_law(rng, count=3):
    """Yield names of small cases with enough subdomains for two ranks.

    Cylinders without Q are not included: supports fix the central node of both bodies,
    so that its friction force is not unique.
    """
    for _ in range(count):
        method = (
            f"glue={rng.choice(['orthonormal', 'redundant'])}/"
            f"contact={rng.choice(['nts', 'mortar'])}/"
            f"loading={rng.choice(['quasi-static', 'static'])}/"
            f"friction=coulomb/mu={rng.choice([0.05, 0.3, 0.6])}/dual"
        )
        n = rng.integers(1, 8, size=8)
        yield (
            f"beam-ring/Nr={n[0] % 3 + 1}/Nh={n[1] % 2 + 1}/radial={n[2]}/feti={n[3]}/"
            f"steps={n[4] % 2 + 1}/relin={n[5] % 2 + 1}/{method}"
        )
        yield (
            f"contact-patch/lower={n[4] + 3}/upper={n[5] + 3}/feti={n[6] % 3 + 1}/"
            f"slave={rng.choice(['upper', 'lower'])}/{method}"
        )
        yield (
            f"hertz-cylinder/n=1/m={n[3] % 2 + 1}/feti={n[4] + 8}/"
            f"slave={rng.choice(['upper', 'lower'])}/Q={rng.choice([0.3, 0.7])}/"
            f"{method}"
        )
        mu = rng.choice([0, 0.4, 1])
        yield f"greco/n={n[7] + 4}/mu={mu}/feti={n[0] % 3 + 1}/dual"


@pytest.mark.parametrize(
    "name",
    [
        "beam-ring/steps=1/dual", "beam-ring/steps=1/feti=4/primal",
        "beam-ring/kinematics=finite/steps=1/dual",
        "plate/primal", "hertz-plane/dual",
        "obstacle/dim=1/feti=5/dual",
    ],
)  # fmt: skip
def test_cases_without_subdomains_are_emitted_by_one_process(name):
    case = parse(name, PROBLEMS)

    assert case.family.emission(case.form, case.params) is None
