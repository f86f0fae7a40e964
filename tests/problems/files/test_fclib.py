"""FCLIB files: both loops, both forms, errors, independent readers."""

import h5py
import numpy as np
import pytest

import mortarbench as mb
from mortarbench.harness import InputError
from mortarbench.harness.files.reading import VARIABLE
from mortarbench.problems.files.fclib import read_fclib, to_contact
from mortarbench.problems.files.friction_cones import FrictionalContact
from tests.support.box_stack import (
    box_stack,
    global_arrays,
    local_arrays,
    triplets,
    write_boxes,
    write_datasets,
)

LOOPS = ("cones", "tresca")


def case_of(path, *parts):
    return mb.build("/".join([f"fclib:{path}", *parts]))


def one_contact(mu=0.5, push=1.0):
    """Return a problem with W = I and q = (−1, push, 0), solved by (1, −min(push, μ),
    0)."""
    return local_arrays(np.eye(3), np.array([-1.0, push, 0.0]), np.array([mu]))


IN_THE_PLANE = local_arrays(np.eye(2), np.array([-1.0, 2.0]), np.array([0.5]), dim=2)


@pytest.mark.parametrize("loop", LOOPS)
@pytest.mark.parametrize(
    ("arrays", "force", "state"),
    [
        (one_contact(push=2.0), [1, -0.5, 0], "slip"),
        (one_contact(push=0.3), [1, -0.3, 0], "stick"),
        (one_contact(mu=0.0), [1, 0, 0], "slip"),
        (IN_THE_PLANE, [1, -0.5], "slip"),
    ],
    ids=["slip", "stick", "smooth", "plane"],
)
def test_one_contact_has_the_force_of_coulombs_law(
    tmp_path, loop, arrays, force, state
):
    """The contact sticks if push ≤ μ; otherwise it slips with the force μ·1, without
    dilatancy."""
    write_datasets(tmp_path / "one.hdf5", arrays)
    case = case_of(tmp_path / "one.hdf5", f"loop={loop}")
    answer = mb.solve(case, "clarabel", 1e-10)
    quantities = case.quantities(answer.solution)

    assert case.recover(answer.solution) == pytest.approx(force, abs=1e-7)
    assert quantities["scaled_natural_map"] <= 1e-6
    assert quantities[state] == 1


@pytest.mark.parametrize(
    ("loop", "boxes", "seed"),
    [("tresca", 1, 0), pytest.param("cones", 2, 5, marks=pytest.mark.slow)],
)
def test_a_stack_of_boxes_is_solved_by_both_loops(tmp_path, loop, boxes, seed):
    """The rank of W is half its order, so that the forces are not unique."""
    write_boxes(tmp_path / "boxes.hdf5", boxes, seed=seed)
    case = case_of(tmp_path / "boxes.hdf5", f"loop={loop}")
    answer = mb.solve(case, "scs", 1e-8)
    quantities = case.quantities(answer.solution)

    assert answer.verdict is mb.Verdict.VERIFIED
    assert quantities["loop_natural_map"] <= 1e-9
    assert quantities["contacts"] == 4 * boxes
    assert quantities["slip"] + quantities["stick"] > 0
    rank = f"W has rank {6 * boxes} of {12 * boxes}"
    assert any(rank in remark for remark in case.remarks)
    if loop == "cones":
        assert quantities["scaled_natural_map"] <= 1e-6


def write_regular(path, contacts=3, mu=0.2, seed=0):
    """Write a problem with a positive definite W and a small μ; return W and q."""
    rng = np.random.default_rng(seed)
    n = 3 * contacts
    M = rng.standard_normal((n, n))
    W, q = M @ M.T / n + np.eye(n), rng.standard_normal(n)
    q[::3] = -np.abs(q[::3])
    write_datasets(path, local_arrays(W, q, np.full(contacts, mu)))
    return W, q


@pytest.mark.parametrize("seed", [0, 1])
def test_both_loops_have_the_same_forces_if_these_are_unique(tmp_path, seed):
    write_regular(tmp_path / "regular.hdf5", seed=seed)
    forces = []
    for loop in LOOPS:
        case = case_of(tmp_path / "regular.hdf5", f"loop={loop}")
        forces.append(case.recover(case.registries.reference(case.qp)))
    assert forces[0] == pytest.approx(forces[1], abs=1e-7)


def test_the_global_form_is_the_same_problem(tmp_path):
    M, H, f, mu = box_stack()
    local = to_contact(local_arrays(H.T @ (H / M[:, None]), H.T @ (f / M), mu)).contact
    for rows_first in (False, True):
        arrays = global_arrays(M, H, f, mu, rows_first=rows_first)
        contact = to_contact(arrays).contact
        assert contact.W.toarray() == pytest.approx(local.W.toarray(), abs=1e-12)
        assert contact.q == pytest.approx(local.q, abs=1e-14)


def test_multipliers_of_equations_are_those_of_the_eliminated_problem():
    """Gᵀv + b = 0 becomes a local problem with V and R, which are then eliminated by a
    Schur complement."""
    M, H, f, mu = box_stack(2)
    rng = np.random.default_rng(1)
    G, b = rng.standard_normal((12, 2)), np.array([1e-3, 0.0])
    arrays = global_arrays(M, H, f, mu) | triplets("fclib_global/G", G)
    arrays["fclib_global/vectors/b"] = b
    inverse = np.diag(1 / M)
    local = local_arrays(H.T @ inverse @ H, H.T @ inverse @ f, mu)
    local |= triplets("fclib_local/V", H.T @ inverse @ G)
    local |= triplets("fclib_local/R", G.T @ inverse @ G)
    local["fclib_local/vectors/s"] = G.T @ inverse @ f + b
    one, two = to_contact(arrays).contact, to_contact(local).contact

    assert one.W.toarray() == pytest.approx(two.W.toarray(), abs=1e-12)
    assert one.q == pytest.approx(two.q, abs=1e-14)


def test_the_scaled_error_has_no_units_and_that_of_fclib_has():
    M, H, f, mu = box_stack()
    contact = to_contact(
        local_arrays(H.T @ (H / M[:, None]), H.T @ (f / M), mu)
    ).contact
    r = 1e-3 * np.random.default_rng(2).standard_normal(contact.q.size)
    other = contact.scaled(force=1e-3, velocity=10.0)
    none = np.zeros(0)

    scaled = [c.natural_map(x, none) for c, x in ((contact, r), (other, 1e3 * r))]
    assert scaled[0] == pytest.approx(scaled[1])
    units = [c.natural_map(x, none, 1.0) for c, x in ((contact, r), (other, 1e3 * r))]
    assert not 0.5 < units[0] / units[1] < 2


#: dataset of `one_contact`, its wrong content, and the message
WRONG = [
    ("vectors/mu_r", np.ones(1), "rolling friction is not supported; expected"),
    ("spacedim", np.array([4]), "spacedim is 4; expected 2 or 3"),
    ("vectors/mu", -np.ones(1), "vectors/mu contains -1; expected only numbers"),
    ("vectors/q", np.ones(4), "vectors/q has 4 entries; expected 3"),
    ("vectors/q", np.array([np.nan, 0, 0]), "vectors/q contains NaN or inf"),
    ("vectors/q", np.array(b"text"), "vectors/q is not numeric"),
    ("W/m", np.array([4]), r"W has shape \(4, 3\); expected \(3, 3\)"),
    ("W/i", np.array([0, 1, 7]), "W is not a matrix: its p, i and x do not"),
    ("W/nz", np.array([9]), "W is not a matrix: its p, i and x do not fit 3"),
    ("W/nz", np.array([-7]), "W is not a matrix"),
]
UNSYMMETRIC, INDEFINITE = np.eye(3) + np.diag([0, 1e-3], 1), np.diag([1.0, -0.1, 1])


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        (local_arrays(UNSYMMETRIC, np.ones(3), np.ones(1)),
         "the largest entry of W − Wᵀ is 0.001 of the largest entry of W"),
        (local_arrays(INDEFINITE, np.ones(3), np.ones(1)),
         "W has the negative eigenvalue -0.1"),
        ({"fclib_rolling/spacedim": np.array([5])}, "rolling friction is not support"),
        ({"solution/r": np.ones(3)}, "no FCLIB problem; expected one group"),
        *((one_contact() | {f"fclib_local/{name}": content}, message)
          for name, content, message in WRONG),
    ],
)  # fmt: skip
def test_invalid_and_nonconvex_problems_are_refused(tmp_path, arrays, message):
    path = tmp_path / "wrong.hdf5"
    write_datasets(path, arrays)
    with pytest.raises(InputError, match=message) as raised:
        case_of(path)
    assert "\n" not in str(raised.value)
    assert str(path) in str(raised.value)


def test_a_file_that_is_not_hdf5_is_refused(tmp_path, monkeypatch):
    (tmp_path / "text.hdf5").write_text("text")
    with pytest.raises(InputError, match="damaged, or not an FCLIB file"):
        case_of(tmp_path / "text.hdf5")
    whole = tmp_path / "whole.hdf5"
    write_boxes(whole)
    data = whole.read_bytes()
    (tmp_path / "half.hdf5").write_bytes(data[: len(data) // 2])
    with pytest.raises(InputError, match="damaged, or not an FCLIB file"):
        case_of(tmp_path / "half.hdf5")
    large = one_contact() | {"fclib_local/vectors/q": np.zeros(2**18)}
    write_datasets(tmp_path / "large.hdf5", large)
    monkeypatch.setenv(VARIABLE, "1")
    with pytest.raises(InputError, match=r"expected at most 1 \(set"):
        case_of(tmp_path / "large.hdf5")


def test_an_unknown_loop_is_refused(tmp_path):
    write_boxes(tmp_path / "boxes.hdf5")
    with pytest.raises(InputError, match="loop='newton' is unknown"):
        case_of(tmp_path / "boxes.hdf5", "loop=newton")


def test_a_stored_solution_that_is_a_dummy_is_named(tmp_path):
    arrays = one_contact()
    path = tmp_path / "a.hdf5"
    write_datasets(path, arrays | {"solution/r": np.zeros(3), "solution/u": np.ones(3)})
    assert any("a dummy" in remark for remark in case_of(path).remarks)
    write_datasets(path, arrays | {"solution/r": np.array([1.0, -0.5, 0])})
    assert case_of(path).remarks == ()


def test_an_asymmetry_of_rounding_is_removed():
    W = np.eye(3) + np.diag([0, 1e-12], 1)
    contact = to_contact(local_arrays(W, np.ones(3), np.ones(1))).contact
    assert isinstance(contact, FrictionalContact)
    assert abs(contact.W - contact.W.T).max() == 0


def test_a_suite_takes_a_pattern_and_is_replayed(tmp_path):
    for seed in range(2):
        write_regular(tmp_path / f"{seed}.hdf5", contacts=1, seed=seed)
    suite = {
        "name": "cones", "tolerances": [1e-6], "repeats": 1, "solvers": ["scs"],
        "problems": [
            {"family": "fclib", "forms": ["dual"],
             "params": {"path": str(tmp_path / "*.hdf5")}},
        ],
    }  # fmt: skip
    results = mb.run(suite, out=tmp_path / "out")
    assert results.df["status"].tolist() == ["verified"] * 2
    run_id = results.df["run_id"].iloc[0]
    assert mb.replay(tmp_path / "out", run_id).now.status is mb.Verdict.VERIFIED


def test_a_name_that_is_not_text_is_refused_in_one_line(tmp_path):
    """A damaged byte in the name of a group is not UTF-8."""
    path = tmp_path / "one.hdf5"
    write_datasets(path, one_contact())
    data = path.read_bytes()
    assert data.count(b"fclib_local") == 1
    path.write_bytes(data.replace(b"fclib_local", b"fclib_l\xffcal"))

    with pytest.raises(InputError, match=r"one\.hdf5: damaged, or not an FCLIB file"):
        read_fclib(path)


def test_data_in_another_file_are_not_read(tmp_path):
    path = tmp_path / "one.hdf5"
    write_datasets(path, one_contact())
    with h5py.File(path, "a") as file:
        del file["fclib_local/vectors/q"]
        file["fclib_local/vectors"].create_dataset(
            "q", (3,), dtype="f8", external="/etc/passwd"
        )

    with pytest.raises(InputError, match=r"one\.hdf5: arrays in other files"):
        read_fclib(path)
