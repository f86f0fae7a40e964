"""Check for unbalanced loads, compared with statics and with a linear program."""

import numpy as np
import pytest
from scipy.optimize import linprog

from mortarbench.harness import InputError
from mortarbench.problems.contact.balance import check_balance
from mortarbench.problems.contact.bodies import ContactPair, assemble
from mortarbench.problems.contact.linearise import linearisation
from mortarbench.problems.fem.elasticity import Material
from mortarbench.problems.fem.mesh import join, prefixed, rectangle
from tests.support.refusals import refused


def blocks(*, fixed, forces, gap=0.0):
    """Return a block of 2 m × 1 m on a block of 4 m × 1 m, and their contact rows.

    The lower block covers (−2, −1) … (2, 0).

    fixed : tuples (body, side or corner, "x", "y" or "xy")
    forces : tuples (body, corner, [x, y]), with forces in N/m
    """
    lower = rectangle((-2.0, -1.0), (4.0, 1.0), (8, 2))
    upper = rectangle((-1.0, gap), (2.0, 1.0), (6, 3))
    mesh, body = join((prefixed(lower, "lower_"), prefixed(upper, "upper_")))
    sides = mesh.boundaries

    def nodes(body, place):
        first, _, second = place.partition(" ")
        side = sides[f"{body}_{first}"]
        return np.intersect1d(side, sides[f"{body}_{second}"]) if second else side

    load = np.zeros((len(mesh.points), 2))
    for b, corner, force in forces:
        load[nodes(b, corner)] += force
    fixed_dofs = [
        2 * nodes(b, place) + "xy".index(c) for b, place, axes in fixed for c in axes
    ]
    bodies = assemble(
        mesh, body, names=("lower", "upper"), materials=(Material(1e9, 0.3),) * 2,
        plane="strain", units=(4.0, 1e6), fixed=np.unique(np.concatenate(fixed_dofs)),
        load=load.ravel(),
        pairs=(ContactPair(sides["upper_bottom"], sides["lower_top"]),),
    )  # fmt: skip
    rows = linearisation(bodies, "nts", "dual")(np.zeros(mesh.dofs))
    return bodies, rows.B


SUPPORT = ("lower", "bottom", "xy")
DOWN = [("upper", "top left", [0, -1e6]), ("upper", "top right", [0, -1e6])]


def test_loads_that_press_down_within_the_support_are_balanced():
    for share in (0.5, 0.01, 0.99, 1.0):  # up to the edge of the support
        forces = [
            ("upper", "top left", [0, -2e6 * share]),
            ("upper", "top right", [0, -2e6 * (1 - share)]),
        ]
        check_balance(*blocks(fixed=[SUPPORT], forces=forces))


@pytest.mark.parametrize(
    ("fixed", "forces", "message"),
    [
        ([SUPPORT], [*DOWN, ("upper", "top left", [10, 0])],
         "body 'upper': nothing balances its load in x; expected a support"),
        ([SUPPORT], [("upper", "top left", [0, 5]), ("upper", "top right", [0, 5])],
         "body 'upper': nothing balances its load in y;"),
        ([SUPPORT], [("upper", "top left", [-3, 5])],
         "body 'upper': nothing balances the moment of its load;"),
        ([("lower", "bottom", "y")], [*DOWN, ("lower", "top left", [9, 0])],
         "body 'lower': nothing balances its load in x;"),
        ([SUPPORT], [*DOWN, ("upper", "top left", [0, 1.5e6])],
         "body 'upper': nothing balances the moment of its load;"),
        ([SUPPORT, ("upper", "bottom left", "xy")], [("upper", "bottom right", [0, 7])],
         "body 'upper': nothing balances the moment of its load;"),
        ([("upper", "top left", "xy"), ("upper", "top right", "y"),
          ("lower", "left", "x")], [("lower", "top left", [0, -9])],
         "body 'lower': nothing balances its load in y;"),
    ],
)  # fmt: skip
def test_an_unbalanced_load_is_refused_by_name(fixed, forces, message):
    with refused(start=message):
        check_balance(*blocks(fixed=fixed, forces=forces))


def test_bodies_that_can_only_move_together_are_all_named():
    """The lower block is pushed up against the upper block, and neither block has a
    support in y."""
    fixed = [("lower", "left", "x"), ("upper", "left", "x")]
    forces = [("lower", "bottom left", [0, 4]), ("lower", "bottom right", [0, 4])]
    with refused(start="bodies 'lower' and 'upper': nothing balances their load in y;"):
        check_balance(*blocks(fixed=fixed, forces=forces))


def test_supported_bodies_need_no_contact():
    bodies, rows = blocks(
        fixed=[SUPPORT, ("upper", "top", "xy")],
        forces=[("upper", "bottom left", [5, 5])],
    )
    check_balance(bodies, rows[:0])


@pytest.mark.parametrize("seed", range(40))
def test_loads_are_refused_if_and_only_if_they_do_work_on_a_free_motion(seed):
    """A linear program maximises fᵀr over rigid motions r with B_D r = 0 and B r ≤ 0
    whose coefficients in the basis R are at most 1 in magnitude."""
    rng = np.random.default_rng(seed)
    places = ("left", "bottom", "top", "right", "top left", "bottom right")
    fixed = [
        (b, places[rng.integers(6)], ("x", "y", "xy")[rng.integers(3)])
        for b in ("lower", "upper")
        for _ in range(rng.integers(1, 3))
    ]
    forces = [
        (b, f"{v} {h}", rng.integers(-3, 2, 2) * 1e6 * (rng.random(2) < 0.6))
        for b in ("lower", "upper")
        for v in ("top", "bottom")
        for h in ("left", "right")
    ]
    bodies, B = blocks(fixed=fixed, forces=forces)
    R = bodies.rigid
    program = linprog(
        -(R.T @ bodies.f), A_ub=B @ R, b_ub=np.zeros(B.shape[0]),
        A_eq=bodies.B_D @ R, b_eq=np.zeros(bodies.B_D.shape[0]), bounds=(-1, 1),
    )  # fmt: skip
    if -program.fun > 1e-4:
        with pytest.raises(InputError, match="nothing balances"):
            check_balance(bodies, B)
    else:
        check_balance(bodies, B)
