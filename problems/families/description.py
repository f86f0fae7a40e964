"""Reader of contact problems described by a TOML file next to a mesh.

::

    mesh = "press.msh"         # beside this file; physical names as used below
    length_unit = "m"          # of coordinates in the mesh file only: "mm", "in", …
    plane = "strain"           # or "stress"
    contact = "nts"            # or "mortar"
    basis = "dual"             # multiplier basis of mortar; or "standard"
    steps = 10                 # load steps
    kinematics = "linear"      # or "finite": finite strain, with Newton's method
    material = "neo-hooke"     # for finite strain; or "svk", St. Venant-Kirchhoff
    gravity = [0.0, -9.81]     # m/s²; every body then needs a density
    units = { length = 2.0, force = 1e8 }   # m, N/m: scales of the QP, see below

    [[bodies]]                 # one entry per physical surface
    name = "beam"
    E = 200e9                  # Pa
    nu = 0.3
    density = 7850.0           # kg/m³

    [[supports]]
    boundary = "left"          # a physical curve; or point = a physical point
    fix = ["x", "y"]           # the components of the displacement that are zero; or
                               # "all", or "normal" on a boundary normal to an axis
    # or displacement = [1e-3, "free"]: prescribed components, m
    # or spring = 1e9: stiffness along the normal, N/m³

    [[loads]]
    boundary = "top"
    traction = [0.0, -1e6]     # Pa, that is N per m of boundary and m of thickness;
                               # or force = [0, -1e6]: total in N per m of thickness,
                               # spread evenly over the boundary. Points require force
    # or pressure = 1e6: Pa, along the normal, positive into the body

    [[contacts]]
    slave = "arc"              # side whose nodes must not enter the master
    master = "bottom"
    friction = "coulomb"       # or "tresca" with a bound in Pa; law of this pair
    mu = 0.3
    reach = 0.1                # m, largest distance from the master at which a slave
                               # node has a contact row; optional, see below
    adjust = 1e-5              # m: slave nodes within this distance of the master are
                               # moved onto it, without stress

    [[contacts]]
    slave = "foot"             # side against a rigid body, whose lengths are in m:
    rigid = { shape = "plane", point = [0, -1], normal = [0, 1] }
    # or { shape = "cylinder", centre = [0, -1], radius = 0.5 }; in 3D also
    # { shape = "cylinder", centre = [0, 0, -1], axis = [0, 1, 0], radius = 0.5 } or
    # { shape = "sphere", centre = [0, 0, -1], radius = 0.5 }

This file and all results are in SI units (m, N, Pa, kg, s); `length_unit` converts the
coordinates in the mesh file only. Loads, gravity and prescribed displacements grow in
`steps` equal steps. Normals are those of the mesh as it is read.

Rigid bodies do not move. The normal of a plane points towards the slave; normals and
axes may have any length. The centre of a cylinder is any point on its axis. Contact
with a rigid body has nodal rows even if ``contact = "mortar"``.

The default of reach is the larger extent of the two sides, or no limit for a rigid
body. Slave nodes more than nine tenths of a facet beyond the border of the master have
no contact row, nor do nodes whose row has no free component because of supports. Each
pair needs a node with a row.

In .inp files, bodies are element sets, boundaries are surfaces, element sets of facets
or node sets, and points are node sets. In .med files, bodies are groups of cells,
boundaries are groups of facets or nodes, and points are groups of nodes.

If the mesh has physical volumes, these are the bodies, and boundaries are physical
surfaces. Vectors then have three components, forces are in N, and a force on a boundary
is distributed uniformly over its area; `point` is a physical point or curve, whose
nodes share a force equally. Finite strain and ``plane = "stress"`` are not available
for volumes.

Loads and supports may be missing if other entries, or contact sides that overlap,
stress the bodies. The keys from length_unit to units are optional. The values above are
their defaults, except for gravity (none) and units: the default of units.length is the
longest side of the bounding box of the mesh, and that of units.force is the sum of
|load| over the nodes, or without loads the force at a strain of 0.1 % in the softest
body. Bodies supported by contact alone have no form dual-bounds. If neither supports
nor friction prevent a rigid motion along the contacts, linear kinematics require
``steps = 1``. A pair that sets no friction law has the law of the
top-level keys friction, bound and mu, whose default is no friction. With the top-level
key ``loading = "static"``, slip is measured from the undeformed state.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, vstack

from mortarbench.harness import InputError, Vector, checked
from mortarbench.harness.checked import located
from mortarbench.harness.errors import shown, unknown
from mortarbench.harness.files.reading import read_toml
from mortarbench.problems.contact.bodies import (
    ContactPair,
    Shape,
    UnassembledBodies,
    spring_rows,
)
from mortarbench.problems.contact.friction import FrictionLaw, law_of
from mortarbench.problems.contact.linearise import linearisation
from mortarbench.problems.contact.rigid import (
    RigidBody,
    RigidCylinder,
    RigidPlane,
    RigidSphere,
)
from mortarbench.problems.fem.elasticity import Material, nodal_masses
from mortarbench.problems.fem.mesh import Mesh, Nodes, dofs_of, facet_quadrature
from mortarbench.problems.fem.mesh_files.named import (
    FileMesh,
    NamedMesh,
    named_mesh,
    oriented,
)
from mortarbench.problems.fem.mesh_files.reading import read_mesh_file
from mortarbench.problems.keys import (
    LAW_PARAMETERS,
    LAWS,
    UNSET,
    check_memory,
    physical,
)

_SIDES = ("slave", "master")
_PLACES = ("boundary", "point")
_LOADS = ("force", "traction", "pressure")
_SUPPORTS = ("fix", "displacement", "spring")
#: largest angle in rad between normals of a plane boundary; positive, because
#: coordinates may be rounded
MAX_TILT = 1e-6
#: strain that defines the unit of force of problems without loads
UNIT_STRAIN = 1e-3
_AXES = ("x", "y", "z")
#: mapping from the dimension to the keys of each shape of rigid bodies; all keys except
#: radius are vectors
_RIGID: Mapping[int, Mapping[str, tuple[str, ...]]] = {
    2: {"plane": ("point", "normal"), "cylinder": ("centre", "radius")},
    3: {
        "plane": ("point", "normal"),
        "cylinder": ("centre", "axis", "radius"),
        "sphere": ("centre", "radius"),
    },
}
#: mapping from the name of a unit of length to its size in m
LENGTH_UNITS = {
    "m": 1.0,
    "cm": 1e-2,
    "mm": 1e-3,
    "um": 1e-6,
    "nm": 1e-9,
    "km": 1e3,
    "in": 0.0254,
    "ft": 0.3048,
}
#: smallest modulus without a remark, Pa. A smaller modulus indicates a material softer
#: than rubber, or a value that was mistakenly entered in MPa
MIN_PLAUSIBLE_E = 1e6
#: keys of the family that the file may also set, with their defaults
SETTINGS: Mapping[str, Any] = {
    "contact": "nts",
    "basis": "dual",
    "plane": "strain",
    "steps": 10,
    "friction": "none",
    "bound": UNSET,
    "mu": UNSET,
    "loading": "quasi-static",
    "kinematics": "linear",
    "material": "neo-hooke",
    "contact_stiffness": "none",
}
_KEYS = (
    "mesh",
    "length_unit",
    *SETTINGS,
    "gravity",
    "units",
    "bodies",
    "supports",
    "loads",
    "contacts",
)


def read_description(path: Path) -> dict[str, Any]:
    """Read the TOML file, and check its keys; the family checks `SETTINGS`.

    Raises
    ------
    InputError
        If a key or value is invalid. The message states the file and the key.

    """
    table = read_toml(path)
    with located(str(path)):
        checked.only_keys(table, _KEYS)
        for key in ("mesh", "bodies", "contacts"):
            if key not in table:
                raise InputError(f"{key} is missing")
        checked.text("mesh", table["mesh"])
        unit = checked.text("length_unit", table.get("length_unit", "m"))
        if unit not in LENGTH_UNITS:
            raise unknown("length_unit", unit, LENGTH_UNITS)
        for entry in checked.filled_list("contacts", table["contacts"]):
            checked.table("contacts", entry)
    return table


def read_bodies(path: Path, plane: Any) -> UnassembledBodies:
    """Read the bodies of a TOML file and its mesh.

    Raises
    ------
    InputError
        If an entry is invalid. The message states the file, the entry, the invalid name
        or value, and the expected one.

    """
    table = read_description(path)
    file = read_mesh_file(path.parent / table["mesh"])
    with located(str(path)):
        described = _described(table["bodies"], file)
    named = named_mesh(file, {file.set_of(name) for name in described})
    with located(str(path)):
        check_memory(named.points.size)
    unit = LENGTH_UNITS[table.get("length_unit", "m")]
    named = named._replace(points=named.points * unit)
    body = np.repeat(
        np.arange(len(named.surfaces)), [len(c) for c in named.surfaces.values()]
    )
    with located(str(path)):
        entries = [_entry_of(described, name, file) for name in named.surfaces]
        used = {*named.surfaces, *map(file.set_of, named.surfaces)}
        for name in described.keys() - used:
            raise unknown(file.words.body, name, used, where="bodies")
        supports = _each(table, "supports", lambda entry: _support(entry, named))
        held, moved = _prescribed(supports)
        pairs = _each(table, "contacts", lambda entry: _pair(entry, named))
        _check_unique(table["contacts"])
        named = _adjusted(table["contacts"], pairs, named)
        loads = _each(table, "loads", lambda entry: _load(entry, named))
        _check_loads_act(table.get("loads", []), loads, held)
        load: NDArray[np.float64] = np.sum(loads, axis=0) + np.zeros_like(named.points)
        load = load + _weight(table, entries, named, body)
        softest = min(entry["E"] for entry in entries)
        length, force = _units(table.get("units", {}), named, load, softest)
    mesh = Mesh(named.points, named.cells, {})
    lift = np.zeros(mesh.dofs)
    lift[held] = moved / length
    springs = [
        spring_rows(named.points, support.facets, support.spring)
        for support in supports
        if support.spring
    ]
    return UnassembledBodies(
        shape=Shape(mesh, body),
        names=tuple(named.surfaces),
        materials=tuple(Material(entry["E"], entry["nu"]) for entry in entries),
        plane=plane if named.dim == 2 else None,
        length=length,
        force=force,
        f=load.ravel() / force,
        pairs=tuple(pairs),
        fixed=held,
        piece=named.piece if np.bincount(named.piece).max() > 1 else None,
        lift=lift if lift.any() else None,
        springs=csr_array(vstack(springs)) * np.sqrt(length / force)
        if springs
        else None,
    )


def remarks(path: Path) -> tuple[str, ...]:
    """Return remarks on valid entries that may be mistakes.

    Remarks concern moduli that may not be in Pa, and two-pass contact: if each of two
    sides is the slave of the other, two sets of rows share the contact force.
    """
    table = read_description(path)
    soft = (
        f"{path}: bodies[{i}]: E = {E:g} Pa is softer than rubber; E is in Pa for any "
        f"length_unit: if {E:g} MPa is meant, write {1e6 * E:g}"
        for i, E in enumerate(body["E"] for body in table["bodies"])
        if E < MIN_PLAUSIBLE_E
    )
    sides = _sides(table["contacts"])
    two_passes = (
        f"{path}: contacts[{i}] is contacts[{sides.index((master, slave))}] "
        "with slave and master exchanged: both contacts share the force between the "
        "bodies, so that neither pressure is correct; remove one of the two contacts"
        for i, (slave, master) in enumerate(sides)
        if (master, slave) in sides[:i]
    )
    return (*soft, *two_passes)


def _each(
    table: Mapping[str, Any], key: str, read: Callable[[dict[str, Any]], Any]
) -> list[Any]:
    """Apply `read` to every table of a list; errors state the index of the entry."""
    values = []
    for i, entry in enumerate(checked.any_list(key, table.get(key, []))):
        with located(f"{key}[{i}]"):
            values.append(read(checked.table("entry", entry)))
    return values


def _described(entries: object, file: FileMesh) -> dict[str, dict[str, float]]:
    """Return E, nu and, where given, density by the names of bodies or their sets."""
    described: dict[str, dict[str, float]] = {}

    def read(entry: dict[str, Any]) -> None:
        checked.only_keys(entry, ("name", "E", "nu", "density"))
        _required(entry, ("name", "E", "nu"))
        name = checked.text("name", entry["name"])
        if file.set_of(name) not in file.body_names:
            raise unknown(file.words.body, name, file.body_names, where="name")
        if name in described:
            raise InputError(f"body {name!r} is described twice; expected once")
        nu = entry["nu"]
        if not checked.is_number(nu) or not -1 < nu < 0.5:
            raise InputError(f"nu = {shown(nu)}; expected a number between -1 and 0.5")
        described[name] = {"nu": float(nu)}
        for key in ("E", "density"):
            if key in entry:
                value = physical(key, checked.positive(key, entry[key]))
                described[name][key] = value

    _each({"bodies": checked.filled_list("bodies", entries)}, "bodies", read)
    return described


def _entry_of(
    described: Mapping[str, dict[str, float]], body: str, file: FileMesh
) -> dict[str, float]:
    """Return the entry of a body, which may have the name of the body or of its set."""
    for name in (body, file.set_of(body)):
        if name in described:
            return described[name]
    raise InputError(f"bodies: {file.words.body} {body!r} has no entry")


class _Support(NamedTuple):
    """Effect of a support."""

    component: Nodes  #: (k,) prescribed components
    value: Vector  #: (k,) their displacements, m
    facets: Nodes  #: facets of the boundary with springs
    spring: float = 0.0  #: stiffness of the springs, N/m³; 0: no springs


def _support(entry: dict[str, Any], named: NamedMesh) -> _Support:
    """Return the displacement components that a support prescribes, or its springs."""
    kind, nodes, facets = _place(entry, named, _SUPPORTS)
    value, dim, axes = entry[kind], named.dim, _AXES[: named.dim]
    if kind == "spring":
        stiffness = physical("spring", checked.positive("spring", value))
        return _Support(nodes[:0], np.zeros(0), _filled(facets, kind), stiffness)
    if kind == "displacement":
        free = [x in ("free", "null") for x in checked.filled_list(kind, value)]
        vector = _vector(
            kind, [0.0 if f else x for f, x in zip(free, value, strict=True)], dim
        )
        prescribed = {k: x for k, x in enumerate(vector) if not free[k]}
        if not prescribed:
            raise InputError("displacement: all components are free; expected a number")
    elif value == "normal":
        areas = facet_quadrature(named.points, _filled(facets, kind))[1]
        normals = areas / np.linalg.norm(areas, axis=2, keepdims=True)
        tilt = 1 - np.abs(normals).min(axis=(0, 1))
        if tilt.min() > MAX_TILT**2:
            raise InputError(
                'fix = "normal" on a boundary that is not normal to an axis is not '
                "built; expected a plane boundary along the axes, a stiff spring, or "
                f"fix = {list(axes)}"
            )
        prescribed = {int(tilt.argmin()): 0.0}
    else:
        fix = axes if value == "all" else checked.filled_list(kind, value)
        for component in fix:
            if component not in axes:
                raise unknown(
                    "component", checked.text(kind, component), (*axes, "all", "normal")
                )
        prescribed = {axes.index(component): 0.0 for component in fix}
    components = [dofs_of(nodes, dim, k) for k in prescribed]
    values = np.repeat(list(prescribed.values()), nodes.size)
    return _Support(np.concatenate(components), values, facets)


def _filled(facets: Nodes, key: str) -> Nodes:
    """Return facets; raise InputError if there are none, since the place is a point."""
    if not facets.size:
        raise InputError(
            f"{key} acts on a point; expected {key} on a boundary, or a force or other "
            "fixed components"
        )
    return facets


def _prescribed(supports: Sequence[_Support]) -> tuple[Nodes, Vector]:
    """Return the prescribed components (k,), ascending, and their displacements, m.

    Raises
    ------
    InputError
        If two supports prescribe different displacements of a component.

    """
    none = _Support(np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros(0, dtype=int))
    component, value = (
        np.concatenate([getattr(support, key) for support in (none, *supports)])
        for key in ("component", "value")
    )
    held, first, place = np.unique(component, return_index=True, return_inverse=True)
    if (differs := value != value[first][place]).any():
        k = int(differs.argmax())
        ends = np.cumsum([support.component.size for support in supports])
        raise InputError(
            f"supports[{int(np.searchsorted(ends, k, side='right'))}] prescribes "
            f"{value[k]:g} m for a component for which another support prescribes "
            f"{value[first][place][k]:g} m; expected one displacement per component"
        )
    return held, value[first]


def _load(entry: dict[str, Any], named: NamedMesh) -> NDArray[np.float64]:
    """Return the nodal forces (N, dim) of a load: N/m in 2D, N in 3D."""
    kind, nodes, facets = _place(entry, named, _LOADS)
    force = np.zeros_like(named.points)
    if kind == "pressure":
        if not checked.is_number(value := entry[kind]):
            raise InputError(f"pressure = {shown(value)}; expected a number, Pa")
        shapes, areas = facet_quadrature(named.points, _filled(facets, kind))
        pressure = physical(kind, value)
        np.add.at(force, facets, -pressure * np.einsum("qm,qkx->kmx", shapes, areas))
        return force
    vector = _vector(kind, entry[kind], named.dim)
    weights = np.zeros(len(named.points))
    if kind == "traction" or facets.size:  # ∫N_j over the boundary: m in 2D, m² in 3D
        shapes, areas = facet_quadrature(named.points, _filled(facets, kind))
        sizes = np.linalg.norm(areas, axis=2)
        np.add.at(weights, facets, np.einsum("qm,qk->km", shapes, sizes))
    else:
        weights[nodes] = 1.0
    if kind == "force":
        weights /= weights.sum()
    return np.outer(weights, vector)


def _weight(
    table: Mapping[str, Any],
    entries: Sequence[Mapping[str, float]],
    named: NamedMesh,
    body: NDArray[np.int64],
) -> NDArray[np.float64]:
    """Return the nodal forces (N, dim) of gravity."""
    if "gravity" not in table:
        return np.zeros_like(named.points)
    for name, entry in zip(named.surfaces, entries, strict=True):
        if "density" not in entry:
            raise InputError(f"bodies: {name!r} has no density, which gravity needs")
    density = np.array([entry["density"] for entry in entries])[body]
    masses = nodal_masses(Mesh(named.points, named.cells, {}), density)
    return np.outer(masses, _vector("gravity", table["gravity"], named.dim))


def _vector(key: str, value: object, dim: int) -> list[float]:
    """Return a vector of `dim` physical values from the entry `key`."""
    vector = checked.filled_list(key, value)
    if len(vector) != dim or not all(map(checked.is_number, vector)):
        count, form = {2: "two", 3: "three"}[dim], ", ".join(_AXES[:dim])
        raise InputError(f"{key} = {shown(vector)}; expected {count} numbers, [{form}]")
    return [physical(key, component) for component in vector]


def _check_loads_act(
    entries: Sequence[Mapping[str, Any]],
    loads: Sequence[NDArray[np.float64]],
    fixed: Nodes,
) -> None:
    """Raise InputError if supports fix all nodes of a load along one of its axes."""
    for i, (entry, load) in enumerate(zip(entries, loads, strict=True)):
        without_effect, dim = [], load.shape[1]
        for axis, name in enumerate(_AXES[:dim]):
            at = np.flatnonzero(load[:, axis])
            if at.size and np.isin(dofs_of(at, dim, axis), fixed).all():
                without_effect.append(name)
        if without_effect:
            where = entry.get("boundary", entry.get("point"))
            raise InputError(
                f"loads[{i}] acts on {where!r} in {' and '.join(without_effect)}, "
                "where a support fixes the displacement; expected a load on another "
                "side, or other fixed components"
            )


def pair_laws(
    contacts: Sequence[Mapping[str, Any]], general: Mapping[str, Any]
) -> tuple[FrictionLaw, ...]:
    """Return the friction law of each pair, from its entry or from `general`.

    general : keys `friction`, `bound` and `mu` of all pairs without their own

    Raises
    ------
    InputError
        If a parameter of a law is missing, or an entry contains a parameter that its
        law does not use.

    """
    return tuple(
        _each({"contacts": list(contacts)}, "contacts", lambda e: _law(e, general))
    )


def _law(entry: Mapping[str, Any], general: Mapping[str, Any]) -> FrictionLaw:
    law = checked.text("friction", entry.get("friction", general["friction"]))
    if law not in LAWS:
        raise unknown("value of friction", law, LAWS)
    needed = LAWS[law]
    for key in LAW_PARAMETERS:
        if key in entry and key != needed:
            raise InputError(f"{key} is not used by friction {law!r}; expected none")
    values = {key: entry.get(key, general[key]) for key in LAW_PARAMETERS}
    if needed and needed not in entry and values[needed] == UNSET:
        raise InputError(f"friction {law!r} needs {needed}, {LAW_PARAMETERS[needed]}")
    return law_of(law, **values)


def _pair(entry: dict[str, Any], named: NamedMesh) -> ContactPair:
    """Return the contact pair that an entry describes."""
    checked.only_keys(
        entry, (*_SIDES, "rigid", "reach", "adjust", "friction", *LAW_PARAMETERS)
    )
    if ("master" in entry) == ("rigid" in entry):
        raise InputError(f"expected either master (a {named.words.boundary}) or rigid")
    names = [side for side in _SIDES if side in entry]
    _keys({k: v for k, v in entry.items() if k in _SIDES}, tuple(names))
    sides = {}
    for side in names:
        name = _one_of(named.curves, named.words.boundary, entry, side)
        facets = named.curves[name]
        sides[side] = _chain(f"{side} {name!r}", facets) if named.dim == 2 else facets
    slave, reach = sides["slave"], None
    if "reach" in entry:
        reach = physical("reach", checked.positive("reach", entry["reach"]))
    if "rigid" in entry:
        with located("rigid"):
            rigid = _rigid(checked.table("rigid", entry["rigid"]), named.dim)
        return ContactPair(slave, slave[:0], rigid, reach)
    if np.intersect1d(slave, sides["master"]).size:
        raise InputError(
            "slave and master share nodes; expected sides without common nodes"
        )
    return ContactPair(slave, sides["master"], reach=reach)


def _adjusted(
    entries: Sequence[Mapping[str, Any]], pairs: Sequence[ContactPair], named: NamedMesh
) -> NamedMesh:
    """Move slave nodes onto their masters, if they are within `adjust`.

    Raises
    ------
    InputError
        If a cell folds.

    """
    points, dim = named.points.copy(), named.dim
    for i, (entry, pair) in enumerate(zip(entries, pairs, strict=True)):
        if "adjust" not in entry:
            continue
        with located(f"contacts[{i}]"):
            distance = physical("adjust", checked.positive("adjust", entry["adjust"]))
            mesh = Mesh(points, named.cells, {})
            sides = UnassembledBodies(
                shape=Shape(mesh, np.zeros(len(named.cells), dtype=np.int64)),
                names=("",),
                materials=(),
                plane=None,
                length=1.0,
                force=1.0,
                f=np.zeros(mesh.dofs),
                fixed=np.zeros(0, dtype=np.int64),
                pairs=(pair,),
            )
            rows = linearisation(sides, "nts", None)(np.zeros(points.size))
            near = np.abs(rows.c) <= distance
            nodes = pair.slave_nodes[rows.place[near]]
            at = dofs_of(nodes, dim).reshape(-1, dim)
            # the entries of B at the slave node point towards the master; they are not
            # a unit vector if a facet of the node extends beyond the master
            towards = rows.B[np.flatnonzero(near)[:, None], at].toarray()
            towards /= np.linalg.norm(towards, axis=1, keepdims=True)
            points[nodes] += rows.c[near][:, None] * towards
            if (oriented("adjust", points, named.cells) != named.cells).any():
                raise InputError("adjust: a cell folds; expected a smaller distance")
    return named._replace(points=points)


def _rigid(entry: dict[str, Any], dim: int) -> RigidBody:
    """Return the rigid body that an entry describes."""
    shapes = _RIGID[dim]
    if "shape" not in entry:
        raise InputError(f"shape is missing; expected {' or '.join(sorted(shapes))}")
    shape = checked.text("shape", entry["shape"])
    if shape not in shapes:
        raise unknown("shape", shape, shapes)
    _keys(entry, ("shape", *shapes[shape]))
    vectors = {
        key: tuple(_vector(key, entry[key], dim))
        for key in shapes[shape]
        if key != "radius"
    }
    for key in ("normal", "axis"):
        if key in vectors:
            size = float(np.linalg.norm(vectors[key]))
            if not size:
                raise InputError(f"{key} is zero; expected a direction")
            vectors[key] = tuple(x / size for x in vectors[key])
    if shape == "plane":
        return RigidPlane(vectors["point"], vectors["normal"])
    radius = physical("radius", checked.positive("radius", entry["radius"]))
    if "axis" in vectors:
        return RigidCylinder(vectors["centre"], vectors["axis"], radius)
    return RigidSphere(vectors["centre"], radius)  # in 2D a cylinder


def _sides(entries: list[dict[str, Any]]) -> list[tuple[str, str]]:
    """Return the names of slave and master of each contact.

    The name of a rigid master is the text of its description.
    """
    return [(e["slave"], e.get("master") or f"{e['rigid']}") for e in entries]


def _check_unique(entries: list[dict[str, str]]) -> None:
    """Raise InputError if a pair of sides is listed twice."""
    sides = _sides(entries)
    for i, (slave, master) in enumerate(sides):
        if (first := sides.index((slave, master))) < i:
            raise InputError(
                f"contacts[{i}] has the slave {slave!r} and the master {master!r} of "
                f"contacts[{first}]; expected every contact once"
            )


def _chain(where: str, edges: Nodes) -> Nodes:
    """Return the nodes (k + 1,) of the edges (k, 2), ordered as one open chain."""
    following = dict(edges.tolist())
    starts = np.setdiff1d(edges[:, 0], edges[:, 1])
    chain = starts[:1].tolist()
    while chain and chain[-1] in following:
        chain.append(following.pop(chain[-1]))
    if len(chain) != len(edges) + 1:
        fault = "is disconnected or has branches" if starts.size else "is closed"
        raise InputError(f"{where} {fault}; expected one open chain of edges")
    return np.array(chain, dtype=np.int64)


def _units(
    entry: object, named: NamedMesh, load: NDArray[np.float64], softest: float
) -> tuple[float, float]:
    """Return the units of length and force of the QP; `softest` is the smallest E."""
    units = checked.table("units", entry)
    with located("units"):
        checked.only_keys(units, ("length", "force"))
        extent = float(np.ptp(named.points, axis=0).max())
        total = float(np.linalg.norm(load, axis=1).sum())
        total = total or UNIT_STRAIN * softest * extent ** (named.dim - 1)
        return (
            physical("length", checked.positive("length", units.get("length", extent))),
            physical("force", checked.positive("force", units.get("force", total))),
        )


def _place(
    entry: dict[str, Any], named: NamedMesh, kinds: tuple[str, ...]
) -> tuple[str, Nodes, Nodes]:
    """Return the kind of an entry, its nodes, and the facets of its boundary.

    For a point, the array of facets is empty.

    kinds : keys of which the entry must have exactly one
    """
    checked.only_keys(entry, (*_PLACES, *kinds))
    where = [key for key in _PLACES if key in entry]
    if len(where) != 1:
        raise InputError("expected either boundary or point, with a name from the mesh")
    of = [key for key in kinds if key in entry]
    if len(of) != 1:
        raise InputError(f"expected one of {', '.join(kinds[:-1])} and {kinds[-1]}")
    if where == ["point"]:
        name = _one_of(named.spots, named.words.point, entry, "point")
        return of[0], named.spots[name], np.zeros((0, 2), dtype=np.int64)
    name = _one_of(named.curves, named.words.boundary, entry, "boundary")
    facets = named.curves[name]
    return of[0], np.unique(facets), facets


def _one_of(
    names: Collection[str], what: str, entry: Mapping[str, Any], key: str
) -> str:
    name = checked.text(key, entry[key])
    if name not in names:
        raise unknown(what, name, names, where=key)
    return name


def _keys(entry: Mapping[str, Any], keys: tuple[str, ...]) -> None:
    """Raise InputError unless the entry has exactly these keys."""
    checked.only_keys(entry, keys)
    _required(entry, keys)


def _required(entry: Mapping[str, Any], keys: tuple[str, ...]) -> None:
    """Raise InputError if a key is missing."""
    for key in keys:
        if key not in entry:
            raise InputError(f"{key} is missing")
