"""Compare SMALBE with PERMON by products with F, and with other solvers by times."""

from dataclasses import replace
from functools import partial
from time import perf_counter

import numpy as np
import pytest
from scipy.linalg.blas import dsymv

import mortarbench as mb
from benchmarks.smalbe_costs import SUBDOMAINS, in_turn, timed
from mortarbench.harness import Status
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.problems import PROBLEMS
from mortarbench.solvers import SOLVERS
from mortarbench.solvers.reference.solve import reference_solution
from mortarbench.solvers.smalbe.compiled import Product
from tests.support.generated_bodies import generated_case

#: Numbers of products with F of PERMON 3.18 with its best settings, for tolerances 1e-6
#: and 1e-8, by Nr, Nh and step.
PERMON = {
    (4, 3, 1): (92, 112), (4, 3, 10): (109, 146),
    (12, 6, 5): (119, 169), (12, 6, 10): (144, 206),
    (30, 15, 1): (132, 204), (30, 15, 5): (129, 214), (30, 15, 10): (176, 255),
}  # fmt: skip
TOLERANCES = (1e-6, 1e-8)
SPARSE = (
    "journal-bearing/n=50/eccentricity=0.9", "journal-bearing/n=200/eccentricity=0.9",
    "journal-bearing/n=300", "string/n=1000", "string/n=10000", "torsion/n=30",
    "torsion/n=200", "obstacle/n=40", "obstacle/n=257/shape=hemisphere",
)  # fmt: skip
OURS = (
    "smalbe", "pdas", "projected-gradient",
)  # fmt: skip


def dual(Nr, Nh, step, form="dual"):
    family = PROBLEMS["beam-ring"]
    configured = family.with_keys(Nr=Nr, Nh=Nh, step=step)
    return configured.build(form, reference_solution).qp


def seconds(solver, qp, tol):
    start = perf_counter()
    solver.prepare(qp, tol)()
    return perf_counter() - start


def verifies(solver, qp, tol):
    if solver.declines(qp) is not None:
        return False
    try:
        return kkt_residuals(qp, solver.prepare(qp, tol)()).worst <= 10 * tol
    except ImportError:
        return False


def products(s):
    assert s.status is Status.SOLVED
    return s.counts["P_products"]


@pytest.mark.parametrize("name", [n for n in SOLVERS if n.startswith("smalbe")])
def test_products_with_F(note, name):
    """Report all products, including those for ‖F‖, the starting point and checks."""
    for (Nr, Nh, step), best in PERMON.items():
        cells = []
        for form in ("dual", "dual-bounds"):
            qp = dual(Nr, Nh, step, form)
            for tol in TOLERANCES:
                s = SOLVERS[name].prepare(qp, tol)()
                assert kkt_residuals(qp, s).worst <= 10 * tol
                cells.append(f"{s.counts['outer']}/{products(s)}")
        note(
            f"{name:18} {Nr},{Nh},{step:<3} dual {cells[0]:>7} {cells[1]:>7}   bounds "
            f"{cells[2]:>6} {cells[3]:>6}   PERMON's best {best[0]} {best[1]}"
        )


@pytest.mark.parametrize("tol", TOLERANCES)
def test_products_on_generated_bodies(note, tol):
    """Report products for 300 bodies, relative to the better of two presets.

    The presets follow the rules of PERMON and of ESPRESO.
    """
    ratios = []
    for seed in range(300):
        qp = generated_case(seed).qp
        spent = {}
        for name in ("smalbe", "smalbe-permon", "smalbe-espreso"):
            s = SOLVERS[name].prepare(qp, tol)()
            verified = kkt_residuals(qp, s).worst <= 10 * tol
            spent[name] = s.counts["P_products"] if verified else np.inf
        ratios.append(spent.pop("smalbe") / min(spent.values()))
    ratios = np.array(ratios)
    note(
        f"300 bodies at {tol:.0e}: {np.isfinite(ratios).sum()} verified, ratio median "
        f"{np.median(ratios):.2f}, at most 1.2 on {(ratios <= 1.2).mean():.1%}, "
        f"at most {ratios.max():.2f}"
    )


@pytest.mark.parametrize("preconditioner", ["diagonal", "lumped", "dirichlet"])
def test_products_with_other_preconditioners(note, preconditioner):
    """Report products and applications of preconditioners other than the default."""
    solver = replace(SOLVERS["smalbe"], preconditioner=preconditioner)
    for Nr, Nh, step in PERMON:
        cells = []
        for tol in TOLERANCES:
            s = solver.prepare(dual(Nr, Nh, step), tol)()
            cells.append(f"{products(s)} + {s.counts['preconditioner_applies']}")
        note(f"{preconditioner} {Nr},{Nh},{step} dual {cells[0]:>10} {cells[1]:>10}")


@pytest.mark.parametrize(("Nr", "Nh"), [(4, 3), (12, 6), (30, 15)])
@pytest.mark.parametrize("form", ["dual", "dual-bounds"])
def test_products_of_a_load_path(note, form, Nr, Nh):
    qps = [dual(Nr, Nh, step, form) for step in range(1, 11)]
    solver = SOLVERS["smalbe"]
    for tol in TOLERANCES:
        prepare = solver.chain(tol)
        warm = [products(prepare(qp)()) for qp in qps]
        cold = [products(solver.prepare(qp, tol)()) for qp in qps]
        note(
            f"path {Nr},{Nh} {form:11} {tol:.0e}: "
            f"warm {np.mean(warm):.1f} a step ({warm[0]} at the first), "
            f"cold {np.mean(cold):.1f}"
        )


@pytest.mark.parametrize(
    ("Nr", "Nh"), [(12, 6), (24, 12), (30, 15), (60, 30), (130, 65)]
)
@pytest.mark.parametrize("form", ["dual", "dual-bounds"])
def test_time_to_a_verified_answer(race, note, form, Nr, Nh):
    """Compare our solvers with the three fastest others that are verified at 1e-6."""
    qp, tol = dual(Nr, Nh, 10, form), 1e-6
    least = {
        name: min(seconds(solver, qp, tol) for _ in range(3))
        for name, solver in SOLVERS.items()
        if not name.endswith("*") and verifies(solver, qp, tol)
    }
    ours = [name for name in OURS if name in least]
    generic = [n for n in least if n not in ours and not n.startswith("smalbe")]
    foreign = sorted(generic, key=least.get)[:3]
    medians = race(
        rounds=9,
        **{
            name: partial(seconds, SOLVERS[name], qp, tol) for name in (*ours, *foreign)
        },
    )
    fastest = min(foreign, key=medians.__getitem__)
    best = min(ours, key=medians.__getitem__)
    ratio = {name: medians[name] / medians[fastest] for name in ("smalbe", best)}
    note(
        f"{form} m={qp.q.size}: fastest generic {fastest} "
        f"{1e3 * medians[fastest]:.2f} ms; smalbe × {ratio['smalbe']:.2f}, "
        f"our fastest {best} × {ratio[best]:.2f}"
    )


@pytest.mark.parametrize(
    ("Nr", "Nh"), [(12, 6), (12, 7), (30, 15), (60, 30), (130, 65)]
)
@pytest.mark.parametrize("form", ["dual", "dual-bounds"])
def test_time_of_a_solve_relative_to_its_products(race, note, form, Nr, Nh):
    """Compare the time of a solve with 1.5·T + 100 µs; its products take the time T."""
    qp, tol, solver = dual(Nr, Nh, 5, form), 1e-6, SOLVERS["smalbe"]
    v, P, blas = np.ones(qp.q.size), Product(qp.P, qp.q.size), np.asarray(qp.P).T
    ready = []

    def solve():
        return ready.pop()()

    def repeated(f):
        return lambda: [f() for _ in range(20)]

    before = solver.prepare(qp, tol)
    prepared = _prepare_products(solver, qp, tol)
    spent = products(before()) - prepared
    ready.extend(solver.prepare(qp, tol) for _ in range(40))
    medians = race(
        rounds=15,
        ours=repeated(lambda: P(v)),
        dsymv=repeated(lambda: dsymv(1.0, blas, v, lower=1)),
        prepare=lambda: solver.prepare(qp, tol),
        solve=solve,
    )
    product = min(medians["ours"], medians["dsymv"]) / 20
    most = 1.5 * spent * product + 100e-6
    note(
        f"{form} m={qp.q.size}: prepare {1e6 * medians['prepare']:.0f} µs, solve "
        f"{1e6 * medians['solve']:.0f} µs of at most {1e6 * most:.0f} for {spent} "
        f"products of {1e6 * product:.1f} µs"
    )


def _prepare_products(solver, qp, tol):
    """Return the number of products in `prepare`.

    The number is obtained from the counts of a solve that is stopped at once.
    """
    stopped = replace(solver, max_steps=1)
    s = stopped.prepare(qp, tol)()
    # subtract the products of the steps, of the starting point and of the residuals
    return s.counts["P_products"] - s.iterations - 2


@pytest.mark.parametrize("case", SUBDOMAINS)
def test_bodies_in_subdomains(race, note, case):
    """Compare a solve with its products and applications of the preconditioner M.

    An earlier solve has assembled the blocks of the operator.
    """
    qp, tol, solver = mb.build(case).qp, 1e-6, SOLVERS["smalbe"]
    s, v = solver.prepare(qp, tol)(), np.ones(qp.q.size)
    P, M = Product(qp.P, v.size), qp.P.build().preconditioner("dirichlet", "stiffness")
    applies = s.counts["preconditioner_applies"]
    medians = race(
        rounds=15, smalbe=partial(seconds, solver, qp, tol),
        products=lambda: [P(v) for _ in range(products(s))],
        applies=lambda: [M(v) for _ in range(applies)],
    )  # fmt: skip
    stored = medians["products"] + medians["applies"]
    assert kkt_residuals(qp, s).worst <= tol
    note(
        f"{case} m={v.size}: {1e3 * medians['smalbe']:.2f} ms, {products(s)} products "
        f"and {applies} applications of M × {medians['smalbe'] / stored:.1f}"
    )


ZOO = {
    "journal-bearing": {"n": 300},
    "obstacle": {"dim": 2, "n": 257, "shape": "hemisphere"},
    "torsion": {"n": 100},
    "string": {"n": 10_000},
}


@pytest.mark.parametrize("name", ZOO)
def test_large_sparse_problems(race, note, name):
    """Compare solvers at 1e-6.

    Also compare the time of `smalbe` per product with the time of one product and five
    vector operations.
    """
    family = PROBLEMS[name]
    form = family.forms[0]
    qp = family.with_keys(**ZOO[name]).build(form, reference_solution).qp
    n, tol = qp.q.size, 1e-6
    fleet = [
        f for f in ("smalbe", "smalbe-permon", "smalbe-espreso", "osqp", "clarabel",
                    "piqp", "pdas") if verifies(SOLVERS[f], qp, tol)
    ]  # fmt: skip
    P, v, w = Product(qp.P, n), np.ones(n), np.ones(n)

    def passes():
        for _ in range(5):
            np.add(v, w, out=w)

    medians = race(
        rounds=3, product=lambda: P(v), passes=passes,
        **{f: partial(seconds, SOLVERS[f], qp, tol) for f in fleet},
    )  # fmt: skip
    spent = {
        f: SOLVERS[f].prepare(qp, tol)().counts.get("P_products")
        for f in fleet
        if f.startswith("smalbe")
    }
    unit = medians["product"] + medians["passes"]
    step = medians["smalbe"] / spent["smalbe"] / unit
    times = ", ".join(
        f"{f} {medians[f]:.2f} s" + (f" ({spent[f]})" if f in spent else "")
        for f in fleet
    )
    note(f"{name} n={n}: {times}; a product with its step × {step:.2f}")


@pytest.mark.parametrize("name", SPARSE)
def test_sparse_problems_with_bounds(note, name):
    """Compare processor times at 1e-6 with and without incomplete factors."""
    qp, tol = mb.build(f"{name}/primal").qp, 1e-6
    plain = replace(SOLVERS["smalbe"], preconditioner="model")
    solvers = {"smalbe": SOLVERS["smalbe"], "plain": plain}
    spent = {f: products(s.prepare(qp, tol)()) for f, s in solvers.items()}
    times = in_turn(
        5 if qp.q.size > 20_000 else 30,
        **{f: timed(lambda s=s: s.prepare(qp, tol)()) for f, s in solvers.items()},
    )
    ms = {f: 1e3 * typical for f, (typical, _) in times.items()}
    note(
        f"{name}: {spent['smalbe']} products, {ms['smalbe']:.3g} ms; without "
        f"a factor {spent['plain']}, {ms['plain']:.3g} ms; × "
        f"{ms['smalbe'] / ms['plain']:.2f}"
    )


@pytest.mark.parametrize(("Nr", "Nh"), [(6, 3), (12, 6), (12, 7), (24, 12)])
def test_small_duals_with_bounds_only(note, Nr, Nh):
    """Report processor times at 1e-6, and the ratio of preparing to solving time."""
    qp, tol, solver = dual(Nr, Nh, 5, "dual-bounds"), 1e-6, SOLVERS["smalbe"]
    ready = []
    spent = products(solver.prepare(qp, tol)())
    times = in_turn(
        600,
        prepare=timed(lambda: ready.append(solver.prepare(qp, tol))),
        solve=timed(lambda: ready.pop()()),
        whole=timed(lambda: solver.prepare(qp, tol)()),
    )
    us = {f: 1e6 * fast for f, (_, fast) in times.items()}
    note(
        f"dual-bounds m={qp.q.size}: {spent} products, fastest tenth {us['whole']:.1f} "
        f"µs; prepare {us['prepare']:.1f} µs, solve {us['solve']:.1f} µs, "
        f"prepare/solve {us['prepare'] / us['solve']:.2f}"
    )
