"""Error estimates of a mesh from finer meshes, compared with exact errors.

The obstacle problems have exact solutions, so the true error of u_h is computed by
quadrature over the elements. The solution of the patch test is in every finite element
space.
"""

import json
from itertools import pairwise
from time import sleep
from types import SimpleNamespace

import numpy as np
import pytest

from mortarbench.harness import InputError
from mortarbench.harness.crossval.discretisation import (
    FILE,
    MAX_UNKNOWNS,
    Level,
    discretisation_errors,
    estimate_error,
    read_discretisation,
)
from mortarbench.harness.crossval.mesh_refinement import prolongation
from mortarbench.harness.crossval.references import reference_point
from mortarbench.harness.mechanics import Grid
from mortarbench.harness.names import assemble, completed, parse
from mortarbench.harness.plugin import as_family
from mortarbench.problems import PROBLEMS
from mortarbench.problems.fem.mesh import box
from mortarbench.problems.models.hertz import insert_midpoints
from mortarbench.problems.models.obstacle import (
    exact_energy,
    exact_height,
    obstacle_problem,
)
from mortarbench.reports.validation.report import mesh_table
from mortarbench.solvers.reference.solve import reference_solution
from tests.support import ROOT
from tests.support.gmsh_files import stacked_blocks


def levels(*distances, bound=1e-9):
    """Return levels of norm 2 with given distances between successive levels."""
    return [
        Level(case="box", unknowns=9, energy=-7.0, norm=2.0, bound=bound, distance=d)
        for d in (None, *distances)
    ]


def converging(error, rate, count):
    """Return levels with orthogonal errors, whose squares are ε², ε²/2^q, …."""
    squares = error**2 * 2.0 ** (-rate * np.arange(count))
    return levels(*np.sqrt(-np.diff(squares)))


def meshes(folder, *names, budget=1e9):
    return discretisation_errors(
        [parse(name, PROBLEMS) for name in names], reference_solution,
        folder, budget,
    )  # fmt: skip


def true_error(dim, n, folder):
    """Return ‖u − u_h‖ from Gauss quadrature on every cell, and ‖û‖."""
    problem = obstacle_problem(dim, n)
    case = PROBLEMS["obstacle"].build("primal", {"dim": dim, "n": n}, None)
    point = reference_point(case.mechanics, reference_solution, folder)
    u = (problem.lift + point.u).astype(float).reshape((n + 1,) * dim)
    h, (s, w) = 3 / n, np.polynomial.legendre.leggauss(6)
    s, w = (s + 1) / 2, w / 2
    corner = -1.5 + h * np.arange(n)
    x = (corner[:, None] + h * s).ravel()
    i, t, weight = np.repeat(np.arange(n), 6), np.tile(s, n), np.tile(w * h, n)
    if dim == 1:
        slopes = [(u[i + 1] - u[i]) / h]
        points = x[:, None]
    else:
        a, b = t[:, None], t
        I, J = i[:, None], i
        slopes = [
            ((u[I + 1, J] - u[I, J]) * (1 - b) + (u[I + 1, J + 1] - u[I, J + 1]) * b)
            / h,
            ((u[I, J + 1] - u[I, J]) * (1 - a) + (u[I + 1, J + 1] - u[I + 1, J]) * a)
            / h,
        ]
        points = np.stack(np.meshgrid(x, x, indexing="ij"), axis=-1).reshape(-1, 2)
        weight = np.outer(weight, weight).ravel()
    e = 1e-6 * np.eye(dim)
    exact = [(exact_height(points + d) - exact_height(points - d)) / 2e-6 for d in e]
    square = sum(
        (a - np.asarray(b).ravel()) ** 2 for a, b in zip(exact, slopes, strict=True)
    )
    return np.sqrt(weight @ square), point.norm


@pytest.mark.parametrize(
    ("dim", "n"),
    [
        (1, 15),
        pytest.param(1, 24, marks=pytest.mark.slow),
        (2, 8),
        pytest.param(2, 15, marks=pytest.mark.slow),
    ],
)
def test_the_estimate_approximates_the_error_of_string_and_membrane(tmp_path, dim, n):
    (found,) = meshes(tmp_path, f"obstacle/dim={dim}/n={n}/primal")
    error, norm = true_error(dim, n, tmp_path / "references")

    assert found.kind == "limit"
    assert found.rate == pytest.approx(2, abs=0.1)
    assert found.error == pytest.approx(error / norm, rel=0.03)
    assert found.change < found.error  # the next mesh also has an error


@pytest.mark.parametrize(
    ("dim", "least", "most"),
    [(1, 0.9, 1.0), pytest.param(2, 0.6, 0.7, marks=pytest.mark.slow)],
)
def test_energies_differ_from_the_error_if_boundary_values_change(
    tmp_path, dim, least, most
):
    """For dim 1, whose boundary consists of points, ‖u_h − u‖² ≤ 2(J_h − J) holds."""
    errors = [true_error(dim, n, tmp_path)[0] for n in (12, 24, 48)]

    assert np.log2(np.divide(errors[:-1], errors[1:])) == pytest.approx(1, abs=0.1)
    for n, error in zip((12, 24, 48), errors, strict=True):
        case = PROBLEMS["obstacle"].build("primal", {"dim": dim, "n": n}, None)
        point = reference_point(case.mechanics, reference_solution, tmp_path)
        excess = case.mechanics.energy(point.u) - exact_energy(dim)
        assert least <= error / np.sqrt(2 * excess) <= most + 1e-6


@pytest.mark.parametrize(
    "name",
    [
        "contact-patch", "obstacle",
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in ("hertz-plane", "hertz-cylinder")
        ),
    ],
)  # fmt: skip
def test_energies_of_mechanics_are_those_of_the_case(name):
    """The energy of the reference point equals the energy of the solution
    of each form.
    """
    family = PROBLEMS[name]
    for form in family.forms:
        case = family.build(form, completed(family, {}), reference_solution)
        point = reference_point(case.mechanics, reference_solution)
        s = reference_solution(case.qp)
        energy = case.scale * case.qp.objective(s.x) + case.constant
        assert case.mechanics.energy(point.u) == pytest.approx(energy, rel=1e-11)


def test_a_solution_in_the_element_space_has_only_rounding_errors(tmp_path):
    (found,) = meshes(tmp_path, "contact-patch/primal")

    assert found.kind == "rounding"
    assert found.change < 1e-13 < found.error < 1e-7
    assert found.rate is None
    assert found.levels[0].energy == pytest.approx(-45500, rel=1e-12)


def test_halving_removes_the_error_of_a_whole_cylinder_with_the_rate_of_its_elements(
    tmp_path,
):
    (found,) = meshes(tmp_path, "hertz-plane/n=4/dual")

    assert found.kind == "limit"
    assert found.rate == pytest.approx(2, abs=0.1)
    assert found.levels[1].case == "hertz-plane/n=4/halvings=1/primal"


def test_halved_cells_keep_every_node():
    x = np.array([0.0, 1, 3, 7])
    assert insert_midpoints(x, 0).tolist() == x.tolist()
    assert insert_midpoints(x, 2)[::4].tolist() == x.tolist()
    assert insert_midpoints(x, 1)[1::2].tolist() == [0.5, 2, 5]


def test_under_a_point_load_only_the_difference_to_the_next_mesh_is_stated(tmp_path):
    (found,) = meshes(tmp_path, "beam-ring/Nr=4/Nh=2/step=1/dual")

    assert found.kind == "change"
    assert found.error == found.change
    assert "point load" in found.note
    assert [x.unknowns for x in found.levels] == [580, 2052, 7684]
    assert found.levels[1].case == "beam-ring/Nr=8/Nh=4/step=1/primal"


@pytest.mark.parametrize("rate", [1.0, 1.5, 2.0])
def test_the_rate_and_the_error_of_a_sequence_that_has_them_are_found(rate):
    found = estimate_error("box", converging(0.6, rate, 3))

    assert found.rate == pytest.approx(rate)
    assert found.error == pytest.approx(0.6 / 2)


def test_two_meshes_yield_only_their_difference():
    found = estimate_error("box", levels(0.3), note="the next one would be too large")

    assert (found.kind, found.rate) == ("change", None)
    assert found.note == "the next one would be too large"
    assert found.error == found.change == pytest.approx(0.15)


def test_a_slowly_decreasing_difference_is_not_extrapolated():
    found = estimate_error("box", levels(0.3, 0.29))

    assert found.kind == "change"
    assert "slowly" in found.note


def test_an_increasing_difference_is_not_reported_as_decreasing():
    """The second halving changes the solution 2^1.45 = 2.73 times as much
    as the first.
    """
    found = estimate_error("box", levels(0.1, 0.1 * 2**1.45))

    assert (found.kind, found.error) == ("change", found.change)
    assert "does not decrease" in found.note
    assert "2.73 times" in found.note
    assert "slowly" not in str(found)


def test_differences_below_the_reference_error_are_no_discretisation_error():
    found = estimate_error("box", levels(1e-3, bound=1e-2))

    assert found.kind == "rounding"
    assert found.error >= 1e-2


@pytest.mark.parametrize(
    ("name", "keys"),
    [
        ("obstacle", {}), ("contact-patch", {}), ("beam-ring", {}),
        ("hertz-cylinder", {}), ("cube-wall", dict(n=2)),
        ("contact-patch", dict(dim=3, lower=4, upper=2)),
        ("beam-ring", dict(Nr=1, Nh=1, depth=1, sides="plane-strain")),
        *(
            pytest.param(
                "beam-ring", dict(Nr=2, Nh=2, **keys), marks=pytest.mark.slow
            )
            for keys in (dict(depth=1), dict(depth=2, sides="plane-strain"))
        ),
    ],
)  # fmt: skip
def test_halved_cells_reproduce_the_bilinear_function_of_the_cells(name, keys):
    """The meshes of the families include curved sides, triangles and hexahedra."""
    family = PROBLEMS[name]
    params = completed(family, keys)
    grids = [
        family.build("primal", p, reference_solution).mechanics.grid
        for p in (params, family.refined(params))
    ]
    P = prolongation(*grids)
    straight = (abs(P @ grids[0].points - grids[1].points) < 1e-9).all(axis=1)

    assert P.shape == (len(grids[1].points), len(grids[0].points))
    assert P.sum(axis=1) == pytest.approx(1, rel=1e-15)
    assert straight.all() or name in ("beam-ring", "hertz-cylinder")
    assert straight.sum() >= len(grids[0].points)


def test_meshes_that_are_not_halved_are_refused():
    family = PROBLEMS["obstacle"]
    grids = [
        family.build("primal", {"dim": 2, "n": n}, None).mechanics.grid
        for n in (4, 6, 8, 16)
    ]
    for other in (grids[1], grids[3], grids[0]):
        with pytest.raises(ValueError, match="every cell halved"):
            prolongation(grids[0], other)
    assert prolongation(grids[0], grids[2]).shape == (81, 25)


def test_a_family_whose_finer_mesh_is_not_nested_gets_one_line(tmp_path):
    """Blocks of 3 and 2 cells have ⌈n/2⌉ rows of cells, which 6 and 4 do not double."""
    (found,) = meshes(tmp_path, "contact-patch/lower=3/upper=2/primal")

    assert found.error is None
    assert "is not the coarser mesh with every cell halved" in str(found)
    assert "could not be built" not in str(found)


def test_forms_of_one_physical_case_have_one_entry_in_the_file(tmp_path):
    names = ("obstacle/n=4/primal", "obstacle/n=4/dual-bounds", "obstacle/n=6/primal")
    found = meshes(tmp_path, *names)

    assert [d.case for d in found] == ["obstacle/n=4", "obstacle/n=6"]
    assert list(read_discretisation(tmp_path).values()) == found
    assert len(list((tmp_path / "references").iterdir())) == 6


def test_an_unavailable_error_has_a_reason(tmp_path):
    broken = replace_build(PROBLEMS["obstacle"], ArithmeticError("it is Monday"))
    bare = SimpleNamespace(
        name="bare", defaults={}, forms=("primal",), build=PROBLEMS["obstacle"].build
    )
    cases = [assemble(family, {}, "primal") for family in (broken, as_family(bare))]
    found = discretisation_errors(cases, reference_solution, tmp_path, 1e9)
    large = meshes(tmp_path, "obstacle/n=300/primal")
    late = meshes(tmp_path, "obstacle/primal", budget=-1.0)

    assert {d.kind for d in (*found, *large, *late)} == {"unknown"}
    assert "it is Monday" in found[0].note
    assert "bare offers no refined mesh" in found[1].note
    assert f"{MAX_UNKNOWNS:,}" in large[0].note
    assert "time" in late[0].note
    assert late[0].levels == large[0].levels == ()


def test_a_mesh_whose_solve_would_exceed_the_budget_is_skipped(tmp_path):
    """The first mesh takes at least 0.05 s; the expected time of the next mesh exceeds
    the rest of the budget.
    """
    obstacle = PROBLEMS["obstacle"]

    def build(*given):
        sleep(0.05)
        return obstacle.build(*given)

    slow = SimpleNamespace(
        name="obstacle", defaults=obstacle.defaults, forms=obstacle.forms,
        refined=obstacle.refined, build=build,
    )  # fmt: skip
    (found,) = discretisation_errors(
        [assemble(as_family(slow), {"n": 4}, "primal")],
        reference_solution, tmp_path, 0.4,
    )  # fmt: skip

    assert found.kind == "unknown"
    assert "more than the remaining time" in found.note
    assert len(found.levels) <= 1


def test_a_smaller_budget_keeps_earlier_results(tmp_path):
    name = "obstacle/dim=1/n=4/primal"
    known = meshes(tmp_path, name)

    assert known[0].error is not None
    assert meshes(tmp_path, name, "obstacle/n=6/primal", budget=0.0)[0] == known[0]
    assert read_discretisation(tmp_path)["obstacle/dim=1/n=4"] == known[0]


def test_results_for_other_parameters_or_meshes_are_removed(tmp_path):
    """A stored estimate with another value of an omitted parameter is discarded."""
    name = "obstacle/dim=1/n=4/primal"
    meshes(tmp_path, name)
    data = json.loads((tmp_path / FILE).read_text())
    data["cases"][0]["params"]["n"] = 5
    (tmp_path / FILE).write_text(json.dumps(data))

    assert meshes(tmp_path, name, budget=0.0)[0].error is None


def test_a_reason_other_than_time_replaces_earlier_results(tmp_path):
    name = "obstacle/dim=1/n=4/primal"
    meshes(tmp_path, name)
    broken = {"obstacle": replace_build(PROBLEMS["obstacle"], OSError("no longer"))}
    (found,) = discretisation_errors(
        [parse(name, broken)], reference_solution, tmp_path, 1e9
    )

    assert (found.error, "no longer" in found.note) == (None, True)


def replace_build(family, error):
    def build(*_):
        raise error

    return as_family(SimpleNamespace(
        name=family.name, defaults=family.defaults, forms=family.forms, build=build,
        refined=family.refined,
    ))  # fmt: skip


@pytest.mark.parametrize(
    "text", ["{", "[]", '{"schema": 2, "cases": []}', '{"schema": 1, "cases": [{}]}']
)
def test_a_damaged_file_is_refused_in_one_line(tmp_path, text):
    (tmp_path / FILE).write_text(text)
    with pytest.raises(InputError, match=FILE) as e:
        read_discretisation(tmp_path)
    assert "\n" not in str(e.value)


def test_a_folder_without_the_file_yields_no_errors(tmp_path):
    assert read_discretisation(tmp_path) == {}


def test_the_file_is_plain_data(tmp_path):
    (found,) = meshes(tmp_path, "obstacle/n=4/primal")
    (row,) = json.loads((tmp_path / FILE).read_text())["cases"]

    assert row["case"] == "obstacle/n=4"
    assert row["error"] == found.error


def test_tresca_on_flat_sides_has_an_error_and_other_friction_a_reason(tmp_path):
    """The squared coarse error is the sum of the squares of the change and the fine
    error.
    """
    name = (
        "contact-patch/lower={0}/upper={0}/ratio=0.1/friction=tresca/bound=1e5/primal"
    )
    coarse, fine = (meshes(tmp_path, name.format(n))[0] for n in (4, 8))
    curved, coulomb = meshes(
        tmp_path, "beam-ring/Nr=2/Nh=1/steps=1/friction=tresca/bound=1e6/primal",
        "contact-patch/ratio=0.1/friction=coulomb/mu=0.2/primal",
    )  # fmt: skip

    assert coarse.kind == fine.kind == "limit"
    whole = np.hypot(coarse.change, fine.error * fine.levels[0].norm
                     / coarse.levels[0].norm)  # fmt: skip
    assert coarse.error == pytest.approx(whole, rel=0.1)
    assert "refinement of curved sides" in curved.note
    assert "compare answers with lower=" in coulomb.note
    assert curved.kind == coulomb.kind == "unknown"


PUNCH = "bodies:suites/crossval/punch.toml"


def test_the_error_of_a_mesh_from_gmsh_is_its_distance_to_a_far_finer_one(
    tmp_path, monkeypatch
):
    """Four halvings approximate the limit; their error is about a tenth of the
    coarse error.
    """
    monkeypatch.chdir(ROOT)
    (found,) = meshes(tmp_path, f"{PUNCH}/dual")
    grids, points = [], []
    for k in range(5):
        case = parse(f"{PUNCH}/halvings={k}/primal", PROBLEMS).build(reference_solution)
        mechanics = case.mechanics
        grids.append(mechanics.grid)
        points.append(reference_point(mechanics, reference_solution).u)
    u = points[0] + grids[0].lift
    for coarse, fine in pairwise(grids):
        u = (prolongation(coarse, fine) @ u.reshape(-1, 2)).ravel()
    distance = mechanics.norm(points[-1] + grids[-1].lift - u)

    assert found.kind == "limit"
    whole = found.error * found.levels[0].norm / np.sqrt(abs(mechanics.scale))
    assert whole == pytest.approx(float(distance), rel=0.1)


def test_parts_of_bodies_have_the_error_of_the_whole(tmp_path, monkeypatch):
    monkeypatch.chdir(ROOT)
    whole, torn = meshes(tmp_path, f"{PUNCH}/primal", f"{PUNCH}/parts=4/dual")

    assert torn.error == pytest.approx(whole.error, rel=1e-6)


@pytest.mark.parametrize(
    ("key", "reason"),
    [
        ("kinematics=finite", "expected kinematics=linear"),
        ("friction=coulomb/mu=0.3", "compare answers with halvings=0, 1 and 2"),
    ],
)
def test_bodies_without_an_error_of_the_mesh_have_a_reason(
    tmp_path, monkeypatch, key, reason
):
    monkeypatch.chdir(ROOT)
    (found,) = meshes(tmp_path, f"{PUNCH}/{key}/dual")

    assert found.kind == "unknown"
    assert reason in found.note


@pytest.mark.parametrize(("sag", "is_arc"), [(0.0, False), (0.05, True)])
def test_the_error_of_bodies_with_arcs_is_that_of_their_chords(tmp_path, sag, is_arc):
    """Two blocks; the lower side of the upper block is an arc or straight."""
    path = stacked_blocks(tmp_path, gap=2 * sag, sag=sag)
    (found,) = meshes(tmp_path, f"bodies:{path}/dual")

    assert found.error is not None
    assert ("corners between chords of an arc remain" in str(found)) is is_arc
    assert (
        "for pressures, generate a finer mesh" in mesh_table([found]).rows[0][-1].text
    ) is is_arc


def test_trilinear_interpolation_of_hexahedra_does_not_depend_on_numbering():
    """x + yz − xyz is trilinear on a box; the nodes of the fine mesh are renumbered."""

    def grid(divisions, order=slice(None)):
        mesh = box((0.0, 0.0, 0.0), (2.0, 1.0, 1.5), divisions)
        number = np.arange(len(mesh.points))[order]
        place = np.argsort(number)
        bodies = np.zeros(len(mesh.cells), dtype=np.int64)
        return Grid(mesh.points[number], place[mesh.cells], bodies, np.zeros(mesh.dofs))

    coarse, rng = grid((2, 1, 3)), np.random.default_rng(4)
    fine = grid((4, 2, 6), rng.permutation(5 * 3 * 7))
    P = prolongation(coarse, fine)
    at = [
        x + y * z - x * y * z for x, y, z in (coarse.points.T, fine.points.T)
    ]  # fmt: skip

    assert P.shape == (105, 24)
    assert P @ at[0] == pytest.approx(at[1], abs=1e-14)
    assert P @ coarse.points == pytest.approx(fine.points, abs=1e-14)
    with pytest.raises(ValueError, match="every cell halved"):
        prolongation(coarse, grid((4, 1, 6)))


def test_the_error_of_a_mesh_in_3d_falls_with_the_cell_size(tmp_path):
    """Singularities at the clamped edges reduce the rate below first order."""
    found = meshes(tmp_path, "cube-wall/n=1/dual-bounds", "cube-wall/n=2/dual-bounds")
    errors = [one.change for one in found]

    assert [len(one.levels) for one in found] == [3, 3]
    assert all(one.kind == "limit" for one in found)
    assert 0 < errors[1] < errors[0] < 0.5
