"""Half-spaces, compared with quadrature, Hertz, Cattaneo and Mindlin."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import quad

from mortarbench.harness import InputError, Solution, Status
from mortarbench.harness.files.qpfile import load_qp, save_qp
from mortarbench.harness.names import parse
from mortarbench.harness.operators import assembled
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.problems import OPERATORS, PROBLEMS
from mortarbench.problems.families.half_space.cases import HalfSpace
from mortarbench.problems.families.half_space.influence import (
    Influence,
    cell_integrals,
    influence_operator,
)
from mortarbench.problems.families.half_space.point_contact import (
    PointContact,
    ShearedPointContact,
)
from mortarbench.problems.families.half_space.rough_surface import (
    LONGEST,
    SHORTEST,
    rough_surface,
)
from mortarbench.solvers.adapters.clarabel_ import Clarabel
from mortarbench.solvers.baselines.projected_gradient import ProjectedGradient
from mortarbench.solvers.reference.solve import reference_solution
from mortarbench.solvers.smalbe.solver import SMALBE

FAMILY = HalfSpace()
TOL = 1e-9
#: heights of seed 0 on a grid of 64 × 64 cells, in units of 2⁻²⁰
DIGITS = [-709804, 398888, 15161]
EXACT = PointContact(100.0, 4e-3, 1e11)


def built(**keys):
    return FAMILY.with_keys(**keys).build("dual", reference_solution)


def result(solver=None, **keys):
    case = built(**keys)
    qp = case.qp
    if isinstance(solver, Clarabel):  # takes matrices only
        qp = replace(qp, P=assembled(qp.P))
    s = (solver or SMALBE()).prepare(qp, TOL)()
    assert kkt_residuals(case.qp, s).worst <= 10 * TOL
    return case.quantities(s)


def disc(n, share=1.0):
    """Return the cells of an n × n grid whose centres are inside a circle."""
    places = np.argwhere(np.ones((n, n), dtype=bool))
    return places[np.hypot(*(places - (n - 1) / 2).T) < share * n / 2]


def dense(cells, h, nu=None):
    """Return F as a dense matrix, assembled from the cell integrals."""
    m = int(cells.max()) + 1
    I = cell_integrals(m, m)
    lag = cells[:, None] - cells[None]
    xx, yy, xy = (K[tuple(np.abs(lag).transpose(2, 0, 1))] for K in I)
    if nu is None:
        return (xx + yy) / h
    xy = xy * np.sign(lag).prod(axis=2)
    blocks = [[(1 - nu) * (xx + yy) + nu * xx, nu * xy],
              [nu * xy, (1 - nu) * (xx + yy) + nu * yy]]  # fmt: skip
    n = 2 * len(cells)
    return np.array(blocks).transpose(2, 0, 3, 1).reshape(n, n) / h


INTEGRANDS = {
    "xx": lambda x, y: x**2 / np.hypot(x, y) ** 3,
    "yy": lambda x, y: y**2 / np.hypot(x, y) ** 3,
    "xy": lambda x, y: x * y / np.hypot(x, y) ** 3,
}


@pytest.mark.parametrize("name", INTEGRANDS)
def test_the_integrals_over_cells_are_those_of_gauss_quadrature(name):
    """At distance zero, the integrand is f(1, t)/x on rays y = tx, so that an integral
    over t remains."""
    f, I = INTEGRANDS[name], getattr(cell_integrals(300, 300), name)
    t, w = np.polynomial.legendre.leggauss(60)

    for i, j in ((1, 0), (0, 1), (1, 1), (3, 2), (40, 7), (0, 299), (299, 299)):
        value = np.einsum("i,j,ij", w, w, f(i + t[:, None] / 2, j + t / 2)) / 4
        assert I[i, j] == pytest.approx(value, rel=1e-8, abs=1e-12)
    if name == "xy":
        assert abs(I[0, 0]) < 1e-14
    else:
        rays = 2 * (f(1, (1 + t) / 2) + f((1 + t) / 2, 1)) @ w / 2
        assert I[0, 0] == pytest.approx(rays, rel=1e-13)


@pytest.mark.parametrize("nu", [None, 0.0, 0.3, 0.5])
@pytest.mark.parametrize("cells", [disc(7), disc(12)[5:60:2], disc(9)[:, ::-1][:40]])
def test_the_product_by_transforms_is_that_of_the_matrix(cells, nu):
    F, h = influence_operator(cells, 0.1, nu), 0.1
    matrix = dense(cells, h, nu)

    X = np.random.default_rng(7).standard_normal((F.shape[0], 3))
    assert F @ X == pytest.approx(matrix @ X, rel=1e-12, abs=1e-11)
    assert F @ X[:, 0] == pytest.approx(matrix @ X[:, 0], rel=1e-12, abs=1e-11)
    assert F.diagonal() == pytest.approx(np.diag(matrix), rel=1e-14)
    assert matrix == pytest.approx(matrix.T, rel=1e-13)


def test_no_eigenvalue_is_less_than_the_bound_and_the_bound_is_sharp():
    """The grids have random shapes, with and without holes, and various Poisson's
    ratios; on large grids without holes, the bound exceeds 85 % of the eigenvalue."""
    rng, ratios = np.random.default_rng(11), []
    for trial in range(60):
        shape = rng.integers(1, 13, size=2)
        places = np.argwhere(np.ones(shape, dtype=bool))
        cells = places[rng.random(len(places)) < rng.choice([0.3, 1.0])]
        if not len(cells):
            continue
        nu = [None, 0.0, 0.5, rng.uniform(0, 0.5)][trial % 4]
        least = np.linalg.eigvalsh(dense(cells, 0.2, nu))[0]
        bound = Influence(cells, 0.2, nu).least_eigenvalue
        assert 0 < bound <= least
        if len(cells) == len(places) > 50:
            ratios.append(bound / least)
    assert len(ratios) > 8
    assert min(ratios) > 0.85


def test_the_bound_is_almost_independent_of_the_size_of_the_grid():
    bounds = [Influence(disc(n), 1.0, 0.3).least_eigenvalue for n in (16, 64, 200)]
    assert bounds == pytest.approx([1.55066] * 3, rel=1e-4)


@pytest.mark.parametrize("n", [1, 2, 9, pytest.param(20, marks=pytest.mark.slow)])
def test_the_preconditioner_is_positive_and_close_to_the_inverse(n):
    F = influence_operator(np.argwhere(np.ones((n, n), dtype=bool)), 0.1).build()
    matrix, M = F(np.eye(n * n)), F.preconditioner("dirichlet", "stiffness")
    approximate = M(np.eye(n * n))

    assert approximate == pytest.approx(approximate.T, abs=1e-12)
    assert np.linalg.eigvalsh(approximate)[0] > 0
    ratios = np.linalg.eigvals(approximate @ matrix).real
    assert ratios.max() / ratios.min() < 4
    with pytest.raises(ValueError, match="known: 'dirichlet'"):
        F.preconditioner("lumped", "stiffness")


@pytest.mark.parametrize("law", ["hertz", "rough"])
def test_the_preconditioner_saves_at_least_thirty_percent_of_the_products(law):
    qp = built(n=128, law=law).qp
    with_it, without = (
        SMALBE(preconditioner=kind).prepare(qp, TOL)() for kind in ("auto", "model")
    )
    assert with_it.counts["P_products"] < 0.7 * without.counts["P_products"]
    assert with_it.x == pytest.approx(without.x, abs=1e-6 * without.x.max())


def test_a_solver_s_process_builds_the_same_operator_from_a_file(tmp_path):
    for keys in (dict(n=6), dict(n=6, law="mindlin")):
        qp = built(**keys).qp
        save_qp(tmp_path / "qp.npz", qp, serialised=True)
        loaded, _ = load_qp(tmp_path / "qp.npz", operators=OPERATORS)
        x = np.linspace(-1, 1, qp.q.size)
        assert (loaded.P @ x == qp.P @ x).all()
        assert len(loaded.sets) == len(qp.sets)


def test_exact_tractions_add_up_to_their_forces():
    def total(traction):
        def ring(r):
            return 2 * np.pi * r * float(traction(np.array([r]))[0])

        edges = (0, sheared.c, EXACT.a)
        return sum(quad(ring, *ends, epsrel=1e-10)[0] for ends in pairwise(edges))

    for Q in (0.1, 0.5, 0.9):
        sheared = ShearedPointContact(EXACT, 0.3, 0.2, Q)
        assert total(EXACT.pressure) == pytest.approx(EXACT.P, rel=1e-8)
        assert total(sheared.traction) == pytest.approx(Q * 0.3 * EXACT.P, rel=1e-8)
        assert sheared.c / EXACT.a == pytest.approx((1 - Q) ** (1 / 3))


def test_exact_tractions_cause_the_exact_displacements():
    """Hertz's pressure causes δ_n − r²/2R in the contact; Mindlin's traction (ν = 0)
    causes δ in the stick zone."""
    n, h = 200, 2 / 200
    cells = disc(n)
    r = np.hypot(*((cells - (n - 1) / 2) * h).T)
    P, a = EXACT.P, EXACT.a
    force = EXACT.pressure(a * r) * (a * h) ** 2 / P
    u = influence_operator(cells, h) @ force
    length = P / (np.pi * EXACT.E_star * a)
    profile = (EXACT.approach - (a * r) ** 2 / (2 * EXACT.R)) / length
    inside = r < 0.95
    assert u[inside] == pytest.approx(profile[inside], rel=2e-3)

    sheared = ShearedPointContact(EXACT, 0.3, 0.0, 0.6)
    shear = sheared.traction(a * r) * (a * h) ** 2 / P
    u = influence_operator(cells, h, 0.0) @ np.column_stack([shear, 0 * shear]).ravel()
    delta = sheared.displacement * np.pi * sheared.G * a / P
    sticks = r < 0.95 * sheared.c / a
    assert u[::2][sticks] == pytest.approx(delta, rel=1e-3)
    assert abs(u[1::2]).max() < 1e-12


def test_errors_of_hertz_s_contact_decrease_with_the_square_of_the_cells():
    errors = [result(n=n) for n in (16, 32, 64, 128)]

    for name, most in (("energy_error", 4e-5), ("p_max_error", 7e-5)):
        values = np.abs([e[name] for e in errors])
        orders = np.log2(values[:-1] / values[1:])
        assert values[-1] < most
        assert ((orders > 1.6) & (orders < 2.4)).all()
    assert abs(errors[-1]["force_error"]) < 3e-5
    assert abs(errors[-1]["contact_radius_error"]) < 3e-3
    assert errors[-1]["pressure_l2_error"] < 4e-3


def test_mindlin_s_problem_has_one_disc_for_each_cell_in_contact():
    counts = [built(n=n, law="mindlin").qp.q.size // 2 for n in (12, 64, 256, 512)]
    assert counts == [88, 2608, 41684, 166740]


@pytest.mark.parametrize(
    ("n", "nu", "Q", "c_over_a", "error"),
    [
        (64, 0.0, 0.5, 0.0069, 2e-4),
        (64, 0.0, 0.9, 0.0059, 2e-4),
        (64, 0.3, 0.5, 0.0069, 6e-4),
        *(pytest.param(256, 0.0, Q, error, 1e-4, marks=pytest.mark.slow)
          for Q, error in ((0.1, 0.0009), (0.3, 0.0009), (0.5, 0.0016), (0.7, 0.0018),
                           (0.9, 0.0028))),
        pytest.param(256, 0.3, 0.5, 0.00122, 4e-4, marks=pytest.mark.slow),
    ],
)  # fmt: skip
def test_the_stick_radius_is_that_of_cattaneo_and_mindlin(n, nu, Q, c_over_a, error):
    """The reference solution is exact for ν = 0 only; for ν = 0.3, its resultant has an
    error of about 3e-4."""
    got = result(ProjectedGradient(), n=n, law="mindlin", nu=nu, Q=Q)

    assert abs(got["c_over_a_error"]) < c_over_a
    assert abs(got["force_error"]) < error
    assert abs(got["transverse_force"]) < 1e-8 * got["tangential_force"]
    assert got["shear_l2_error"] < (0.04 if nu else 0.011 if Q > 0.1 else 0.03)
    assert got["stick"] + got["slip"] == got["cells"]


def test_coulomb_s_bounds_are_mu_times_the_pressure_of_the_normal_problem():
    normal = result(n=16)
    case = built(n=16, friction="coulomb", nu=0.2, Q=0.4)
    (discs,) = case.qp.sets[1:]

    assert discs.radius.size == normal["active"]
    assert discs.radius.sum() * 100 == pytest.approx(normal["multiplier_sum"], 1e-7)
    got = result(Clarabel(), n=16, friction="coulomb", nu=0.2, Q=0.4)
    mindlin = result(Clarabel(), n=16, law="mindlin", nu=0.2, Q=0.4)
    for name in ("tangential_force", "energy", "displacement"):
        assert got[name] == pytest.approx(mindlin[name], rel=0.02)


@pytest.mark.parametrize("nu", [0.0, 0.3])
def test_a_disc_that_hardly_slips_is_as_stiff_as_a_rigid_punch(nu):
    """The key Q prescribes δ = Q(2 − ν)/(4Ga), the displacement of a rigid punch."""
    keys = dict(friction="tresca", bound=1e8, Q=0.02)
    got = result(Clarabel(), n=16, nu=nu, **keys)

    unit = 1e8 * np.pi * got["contact_radius"] ** 2
    assert got["tangential_force"] / unit == pytest.approx(0.02, rel=0.03)
    assert got["stick"] > 0.8 * got["cells"]
    assert got["open"] == 0


def test_results_of_a_given_point_are_sums_in_newtons_and_metres():
    """For a rigid disc (Johnson, Section 3.7), δ = (2 − ν)Q/(4Ga); the key Q is the
    fraction of bound·πa²."""
    case = built(n=12, friction="tresca", bound=2e8, nu=0.2, Q=0.3)
    k, length = case.qp.q.size // 2, np.cbrt(0.75 * 100 * 4e-3 / (100e9 / 0.96))
    unit, G = 2e8 * np.pi * length**2, 200e9 / 2.4
    x = np.tile([0.01, -0.003], k)
    z_box = np.tile([0.3, 0.4], k)
    s = Solution(
        status=Status.SOLVED, x=x, y=np.zeros(0), z=np.zeros(0), z_box=z_box
    )  # fmt: skip
    got, (discs,) = case.quantities(s), case.qp.sets[1:]

    assert discs.radius.sum() == pytest.approx(1, rel=0.05)
    assert got["displacement"] == pytest.approx(0.3 * unit * 1.8 / (4 * length * G))
    assert got["tangential_force"] == pytest.approx(0.01 * k * unit)
    assert got["transverse_force"] == pytest.approx(-0.003 * k * unit)
    work = 0.5 * discs.radius.sum() * unit**2 / (np.pi * G * length)
    assert got["dissipation"] == pytest.approx(work)
    assert case.recover(s) == pytest.approx(case.qp.P @ x * unit / (np.pi * G * length))


@pytest.mark.parametrize("keys", [dict(), dict(law="mindlin")])
def test_the_objective_is_minus_the_energy_with_the_work_of_friction(keys):
    case = built(n=16, **keys)
    s = ProjectedGradient().prepare(case.qp, TOL)()
    got = case.quantities(s)

    total = case.scale * case.qp.objective(s.x) + case.constant
    assert total == pytest.approx(got["energy"] + got.get("dissipation", 0), rel=1e-6)


def test_cells_in_contact_are_counted_relative_to_the_largest_force():
    case = built(n=16)
    s = SMALBE().prepare(case.qp, TOL)()
    small = replace(s, x=1e-5 * s.x)
    assert case.quantities(small)["active"] == case.quantities(s)["active"]
    side = case.fields(s).contacts[0]
    a = side.exact[side.exact[:, 1] > 0, 0].max()
    assert side.exact[-1, 0] == pytest.approx(a / 0.9, rel=2e-3)
    assert side.force.sum(axis=0)[2] == pytest.approx(100, rel=2e-3)
    assert side.gap[s.x > 0] == pytest.approx(0, abs=1e-9 * a)
    assert side.gap[0] > 0.01 * a**2 / 4e-3


def test_tresca_s_problem_does_not_depend_on_the_unit_of_its_bound():
    one, other = (built(n=8, friction="tresca", bound=bound).qp for bound in (1.0, 1e9))
    assert (one.q == other.q).all()
    assert (one.sets[1].radius == other.sets[1].radius).all()


def test_heights_for_a_seed_are_the_same_on_every_machine():
    x = (np.arange(64) + 0.5) / 64
    z = rough_surface(x, 0.8, 0)

    assert (z * 2**20 == np.round(z * 2**20)).all()
    assert DIGITS == [int(z[i, j] * 2**20) for i, j in ((0, 0), (17, 40), (63, 5))]
    assert (rough_surface(x, 0.8, 1) != z).mean() > 0.99


def test_the_spectrum_of_heights_has_the_hurst_exponent():
    """On a grid that resolves the waves, they are orthogonal, and A_k ∝
    |k|^−(1 + H)."""
    n, hurst = 128, 0.7
    z = rough_surface(np.arange(n) / n, hurst, 3)
    amplitudes = np.abs(np.fft.fft2(z)) / n**2
    k = np.fft.fftfreq(n, 1 / n)
    length = np.hypot(k[:, None], k)
    used = (length >= LONGEST) & (length <= SHORTEST)

    assert (z**2).mean() == pytest.approx(1, rel=1e-6)
    assert amplitudes[~used].max() < 1e-7
    scaled = amplitudes[used] * length[used] ** (1 + hurst)
    assert scaled == pytest.approx(scaled[0], rel=1e-3)


def test_a_rough_surface_does_not_depend_on_the_grid():
    coarse, fine = (rough_surface(np.arange(n) / n, 0.8, 5) for n in (64, 128))
    assert fine[::2, ::2] == pytest.approx(coarse, abs=2e-6)


def test_rough_spheres_touch_on_less_area_under_higher_pressure():
    smooth, rough = result(n=64), result(n=64, law="rough", seed=2)

    assert rough["active"] < 0.9 * smooth["active"]
    assert rough["p_max"] > 2 * smooth["p_max"]
    assert rough["multiplier_sum"] == pytest.approx(smooth["multiplier_sum"], rel=0.05)
    assert "p_max_error" not in rough


def test_a_grid_that_does_not_fit_into_memory_is_refused(monkeypatch):
    monkeypatch.setenv("MORTARBENCH_CASE_MIB", "100")
    with pytest.raises(InputError, match="600 × 600 cells takes"):
        FAMILY.with_keys(n=600)


def test_the_canonical_name_lists_keys_in_the_order_of_the_family():
    name = parse("half-space/Q=0.3/law=mindlin/nu=0/dual", PROBLEMS).name
    assert name == "half-space/law=mindlin/nu=0.0/Q=0.3/dual"
