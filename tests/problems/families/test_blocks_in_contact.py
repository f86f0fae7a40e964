"""Pairs of blocks that overhang, share nodes or do not meet, compared with statics."""

import numpy as np
import pytest

from mortarbench.harness import InputError
from tests.support import cases
from tests.support.block_pairs import PRESSURE, block_pair
from tests.support.press import DISC, described

METHODS = ("contact=nts", "contact=mortar", "contact=mortar/basis=standard")
#: an upper block on a wider lower one, whose nodes are 1 m apart
NARROW = (((0.0, 10.0),), ((4.1, 4.9),), ((10, 2), (2, 2)))
#: two blocks of the same width, whose nodes do not match
EQUAL = (((0.0, 2.0),), ((0.0, 2.0),), ((4, 2), (6, 2)))


def solved(path, keys="contact=nts"):
    """Return the case, its solution and its quantities."""
    return cases.solved(f"bodies:{path}/{keys}/dual")


def forces(case, s):
    """Return positions, loads and contact forces (N, dim), and a mask of the upper
    nodes."""
    mechanics, primal = case.mechanics, case.mechanics.primal
    z = mechanics.to_primal(s).z[: primal.h.size]
    points = mechanics.grid.points
    upper = np.zeros(len(points), dtype=bool)
    upper[mechanics.grid.cells[mechanics.grid.bodies == 1]] = True
    load, contact = -primal.q.reshape(points.shape), -primal.G.T @ z
    return points, load, contact.reshape(points.shape), upper


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("keys", METHODS)
@pytest.mark.parametrize(
    ("x", "gap"),
    [(2.05, 0.0), (3.0, 0.0), (200.0, 0.0), (0.5, 200.0)],
    ids=["beside", "farther", "far", "above"],
)
def test_a_block_that_does_not_face_its_master_is_refused(tmp_path, dim, keys, x, gap):
    across = () if dim == 2 else ((0.0, 1.0),)
    cells = (5, *(2,) * (dim - 1)), (4, *(2,) * (dim - 1))
    path = block_pair(
        tmp_path, ((0.0, 2.0), *across), ((x, x + 1), *across), cells, gap=gap
    )
    with pytest.raises(
        InputError, match="contact upper on lower: no node of the slave"
    ):
        solved(path, keys)


def test_reach_selects_the_nodes_that_have_rows(tmp_path):
    """The upper block is 1 mm above the lower one."""
    for reach, rows in (("0.002", 7), ("0.0005", 0)):
        path = block_pair(tmp_path, *EQUAL, gap=1e-3, keys=f"reach = {reach}\n")
        if rows:
            assert solved(path)[2]["contact_rows"] == rows
        else:
            with pytest.raises(InputError, match="within reach"):
                solved(path)
    for reach in ("0", '"far"'):
        path = block_pair(tmp_path, *EQUAL, keys=f"reach = {reach}\n")
        with pytest.raises(InputError, match=r"contacts\[0\]: reach = "):
            solved(path)


@pytest.mark.parametrize("keys", METHODS)
@pytest.mark.parametrize("x", [1.6, 1.63, 1.9])
def test_a_block_whose_load_is_beyond_the_edge_of_its_table_topples(tmp_path, keys, x):
    """The table ends at 2 m, and the load acts at x + 0.5."""
    path = block_pair(tmp_path, ((0.0, 2.0),), ((x, x + 1),), ((20, 4), (10, 4)))
    with pytest.raises(InputError, match="nothing balances the moment of its load"):
        solved(path, keys)


@pytest.mark.parametrize("keys", METHODS)
def test_overhanging_nodes_lose_no_moment(tmp_path, keys):
    path = block_pair(tmp_path, ((0.0, 2.0),), ((1.43, 2.43),), ((20, 4), (10, 4)))
    case, s, values = solved(path, keys)
    points, load, force, upper = forces(case, s)
    total = load.sum(axis=0)[1]

    # all resultants act at x = 1.93
    for of_body, sign in ((upper, -1), (~upper, 1)):
        assert force[of_body].sum(axis=0)[1] == pytest.approx(sign * total, rel=1e-9)
        assert points[of_body, 0] @ force[of_body, 1] == pytest.approx(
            sign * 1.93 * total, rel=1e-9
        )
    pair = values["contacts"]["upper on lower"]
    # the pressure is normal to the deformed foot, which is inclined by 0.01 rad
    total = 2 * pair["half_width"] * pair["mean_pressure"]
    assert total == pytest.approx(PRESSURE, rel=1e-3)
    assert pair["half_width"] <= 0.57 / 2 + 1e-9


@pytest.mark.parametrize("keys", METHODS)
def test_a_wide_slave_has_the_pressure_of_a_narrow_one(tmp_path, keys):
    """The nodes of the lower block are beside the upper one, which is symmetric: both
    halves of its foot carry the same force whichever side is the slave."""
    narrow = solved(block_pair(tmp_path, *NARROW, height=5.0), keys)[2]
    path = block_pair(tmp_path, *NARROW, (("table", "foot"),), height=5.0)
    wide = solved(path, keys)[2]
    pair = wide["contacts"]["lower on upper"]

    assert wide["energy"] == pytest.approx(narrow["energy"], rel=1e-4)
    assert wide["contact_rows"] == 2
    assert pair["mean_pressure"] == pytest.approx(PRESSURE)
    assert pair["largest_pressure"] == pytest.approx(PRESSURE, rel=0.01)
    assert pair["half_width"] == pytest.approx(0.4)


@pytest.mark.parametrize("keys", METHODS)
def test_covered_areas_sum_to_the_contact_area_in_space(tmp_path, keys):
    """The slave is coarser than the master and extends beyond all its edges."""
    path = block_pair(
        tmp_path, ((0.0, 3.0), (0.0, 3.0)), ((0.7, 1.9), (0.6, 2.2)),
        ((3, 3, 2), (4, 4, 2)), (("table", "foot"),),
    )  # fmt: skip
    case, s, values = solved(path, keys)
    (side,) = case.fields(s).contacts
    pair = values["contacts"]["lower on upper"]

    assert pair["pressed_area"] == pytest.approx(1.2 * 1.6)
    assert pair["mean_pressure"] == pytest.approx(PRESSURE, rel=1e-6)
    # an elastic punch presses harder at its edges, but not several times as hard
    assert pair["largest_pressure"] <= 2.5 * PRESSURE
    pressing = side.nodes[side.pressure > 0]
    x, y, _ = case.mechanics.grid.points[pressing].T
    outside = np.maximum(np.maximum(0.7 - x, x - 1.9), np.maximum(0.6 - y, y - 2.2))
    assert outside.max() <= 0.75  # a node that is barely covered has no pressure


@pytest.mark.parametrize("keys", METHODS)
@pytest.mark.parametrize("masters", ["table", "both"])
@pytest.mark.parametrize("slave", ["foot", "table"])
def test_a_side_cut_in_two_has_the_forces_of_the_whole(tmp_path, keys, masters, slave):
    """The node at the cut belongs to both pairs; by symmetry, both carry 1 MN/m."""
    master = "table" if slave == "foot" else "foot"
    whole = solved(block_pair(tmp_path, *EQUAL, ((slave, master),)), keys)[2]
    pairs = tuple(
        (f"{slave} {half}", f"{master} {half}" if masters == "both" else master)
        for half in ("left", "right")
    )
    path = block_pair(tmp_path, *EQUAL, pairs, cut={"foot": 1.0, "table": 1.0})
    values = solved(path, keys)[2]
    largest = max(p["largest_pressure"] for p in whole["contacts"].values())

    assert values["energy"] == pytest.approx(whole["energy"], rel=1e-9)
    for pair in values["contacts"].values():
        assert abs(pair["force"]["upper"][1]) == pytest.approx(PRESSURE, rel=1e-7)
        assert pair["largest_pressure"] == pytest.approx(largest, rel=1e-5)
        assert pair["mean_pressure"] == pytest.approx(PRESSURE, rel=1e-6)
        assert pair["half_width"] == pytest.approx(0.5)


@pytest.mark.parametrize("contact", ["nts", "mortar"])
def test_a_row_without_a_free_component_is_dropped(tmp_path, contact):
    """Supports fix both ends of both sides, so that only the middle nodes can press.

    Each block is a spring of two cells under half of the load on its middle node, and
    the supports carry the other half; an upper spring carries the load to the middle.
    """
    fixed = '{ boundary = "ends", fix = ["x", "y"] },'
    path = block_pair(
        tmp_path, ((0.0, 2.0),), ((0.0, 2.0),), ((2, 1), (2, 1)), supports=fixed
    )
    case, _, values = solved(path, f"contact={contact}")
    (pair,) = values["contacts"].values()

    if contact == "nts":
        assert values["contact_rows"] == 1
        assert "2 of 3 contact rows were dropped" in case.remarks[-1]
    assert pair["force"]["lower"][1] == pytest.approx(-3e6 / 7, rel=1e-6)


def test_friction_between_supports_is_reported_as_not_unique(tmp_path):
    """Supports fix both sides along the contact, so that friction has no effect."""
    friction = 'friction = "coulomb"\nmu = 0.3\n'
    foot, table = (f'{{ boundary = "{s}", fix = ["x"] }},' for s in ("foot", "table"))
    path = block_pair(tmp_path, *EQUAL, keys=friction, supports=foot + table)
    assert solved(path)[2]["undetermined_friction"] == 7
    for supports in ("", foot, table):
        path = block_pair(tmp_path, *EQUAL, keys=friction, supports=supports)
        assert "undetermined_friction" not in solved(path)[2]


@pytest.mark.parametrize(
    "keys",
    [
        *METHODS,
        *(pytest.param(f"{k}/parts=4", marks=pytest.mark.slow) for k in METHODS),
    ],
)
def test_a_disc_that_can_roll_is_pressed_like_one_that_cannot(tmp_path, keys):
    """Hertz: 2.71 GPa; without a support, the displacement is that of least motion."""
    path = described(tmp_path)
    case, s, held = solved(path, keys.partition("/parts")[0])
    moved = case.recover(s)
    path.write_text(DISC.replace('[[supports]]\npoint = "axis"\nfix = ["x"]\n', ""))
    case, s, values = solved(path, keys)

    assert abs(case.recover(s)).max() <= 1.01 * abs(moved).max()
    for name, pair in values["contacts"].items():
        expected = held["contacts"][name]["largest_pressure"]
        assert pair["largest_pressure"] == pytest.approx(expected, rel=1e-3)
        assert pair["largest_pressure"] == pytest.approx(2.71e9, rel=0.02)
        assert pair["smallest_gap"] == pytest.approx(0, abs=1e-10)


class RandomPair:
    """Two random blocks: overhanging or not, with or without a gap, either one the
    slave, and the slave side cut in two or not."""

    def __init__(self, seed):
        rng = np.random.default_rng(seed)
        axes = 1 + seed % 2
        lower, upper = rng.uniform(1, 2, axes), rng.uniform(0.4, 1.6, axes)
        start = [
            rng.uniform(-0.3 * b, max(a - 0.7 * b, -0.3 * b))
            for a, b in zip(lower, upper, strict=True)
        ]
        self.cells = [
            (*map(int, rng.integers(2, 9 - 3 * (axes - 1), axes)), 2) for _ in range(2)
        ]
        self.lower = tuple((0.0, a) for a in lower)
        self.upper = tuple((x, x + b) for x, b in zip(start, upper, strict=True))
        self.gap = float(rng.choice([0.0, rng.uniform(0, 1e-3)]))
        self.moduli = tuple(float(E) for E in 10 ** rng.uniform(8, 10, 2))
        slave, master = ("foot", "table") if rng.random() < 0.5 else ("table", "foot")
        self.contacts, self.cut = ((slave, master),), None
        if rng.random() < 0.4:
            middle = np.clip([self.lower[0], self.upper[0]], 0, lower[0]).mean(axis=1)
            self.cut = {slave: float(middle[1])}
            self.contacts = tuple((f"{slave} {h}", master) for h in ("left", "right"))
        self.load = PRESSURE * float(np.prod(upper))

    def solved(self, folder, keys):
        """Return the elastic energy, after checks of equilibrium; or the refusal."""
        path = block_pair(
            folder, self.lower, self.upper, self.cells, self.contacts,
            gap=self.gap, moduli=self.moduli, cut=self.cut,
        )  # fmt: skip
        try:
            case, s, values = solved(path, keys)
        except InputError as refusal:
            return str(refusal)
        points, load, force, upper = forces(case, s)
        force *= self.load / np.abs(load.sum(axis=0)[-1])
        total = np.zeros(points.shape[1])
        total[-1] = self.load
        assert abs(force[upper].sum(axis=0) - total).max() <= 1e-9 * self.load
        assert abs(force[~upper].sum(axis=0) + total).max() <= 1e-9 * self.load
        if points.shape[1] == 2:
            moments = points[:, 0] * force[:, 1] - points[:, 1] * force[:, 0]
        else:
            moments = np.cross(points, force)
        assert np.abs(moments.sum(axis=0)).max() <= 1e-9 * self.load
        pressing = sum(
            (side.pressure * side.length).sum() for side in case.fields(s).contacts
        )
        assert pressing == pytest.approx(self.load, rel=1e-2)
        return values["energy"] + self.load * self.gap


def energies(seeds, folder):
    """Return the elastic energies (k, 3) of the METHODS, and refusals."""
    found, refusals = [], []
    for seed in seeds:
        values = [RandomPair(seed).solved(folder, keys) for keys in METHODS]
        texts = [value for value in values if isinstance(value, str)]
        if texts:
            refusals.append(texts[0])
        else:
            found.append((seed, *values))
    return np.array(found), refusals


def test_random_pairs_are_in_equilibrium(tmp_path):
    found, refusals = energies(range(1, 7), tmp_path)
    _, nodal, dual, standard = found.T

    assert not refusals
    assert nodal == pytest.approx(dual, rel=0.2)
    assert standard == pytest.approx(dual, rel=0.2)


@pytest.mark.slow
def test_nodal_contact_of_random_pairs_is_as_accurate_as_the_mesh(tmp_path):
    """At most a tenth of the pairs is refused, because they would topple. For nine
    tenths of the others, the elastic energies of nodal and mortar contact differ by
    less than the energy of mortar contact changes if all cells are halved."""
    found, refusals = energies(range(60), tmp_path)
    assert len(refusals) <= 6
    assert all("nothing balances the moment" in text for text in refusals)
    changes = []
    for seed, _, dual, _ in found:
        pair = RandomPair(int(seed))
        pair.cells = [tuple(2 * n for n in cells) for cells in pair.cells]
        changes.append(pair.solved(tmp_path, METHODS[1]) - dual)
    _, nodal, dual, standard = found.T

    assert (np.abs(nodal - dual) <= np.abs(changes)).mean() >= 0.9
    assert nodal == pytest.approx(dual, rel=0.2)
    assert standard == pytest.approx(dual, rel=0.1)
