"""Reader of contact problems described by a TOML file next to a mesh.

::

    mesh = "press.msh"         # beside this file; physical names as used below
    length_unit = "m"          # of coordinates in the mesh file only: "mm", "in", …
    plane = "strain"           # or "stress"
    contact = "nts"            # or "mortar"
    basis = "dual"             # multiplier basis of mortar; or "standard"
    steps = 10                 # load steps
    relin = 1                  # linearisations of the contact per step
    kinematics = "linear"      # or "finite": finite strain, with Newton's method
    material = "neo-hooke"     # for finite strain; or "svk", St. Venant-Kirchhoff
    units = { length = 2.0, force = 1e8 }   # m, N/m: scales of the QP, see below

    [[bodies]]                 # one entry per physical surface
    name = "beam"
    E = 200e9                  # Pa
    nu = 0.3

    [[supports]]
    boundary = "left"          # a physical curve; or point = a physical point
    fix = ["x", "y"]           # the components of the displacement that are zero

    [[loads]]
    boundary = "top"
    traction = [0.0, -1e6]     # Pa, that is N per m of boundary and m of thickness;
                               # or force = [0, -1e6]: total in N per m of thickness,
                               # spread evenly over the boundary. Points require force
    [[contacts]]
    slave = "arc"              # side whose nodes must not enter the master
    master = "bottom"
    friction = "coulomb"       # or "tresca" with a bound in Pa; law of this pair
    mu = 0.3
    reach = 0.1                # m, largest distance from the master at which a slave
                               # node has a contact row; optional, see below

    [[contacts]]
    slave = "foot"             # side against a rigid body, whose lengths are in m:
    rigid = { shape = "plane", point = [0, -1], normal = [0, 1] }
    # or { shape = "cylinder", centre = [0, -1], radius = 0.5 }; in 3D also
    # { shape = "cylinder", centre = [0, 0, -1], axis = [0, 1, 0], radius = 0.5 } or
    # { shape = "sphere", centre = [0, 0, -1], radius = 0.5 }

This file and all results are in SI units, irrespective of the length unit of the mesh:
E and tractions in Pa, forces in N/m, units.length and rigid bodies in m.

Rigid bodies do not move. The normal of a plane points towards the slave; normals and
axes may have any length. The centre of a cylinder is any point on its axis. Contact
with a rigid body has nodal rows even if ``contact = "mortar"``.

The default of reach is the larger extent of the two sides, or no limit for a rigid
body. Slave nodes beyond the border of the master by more than half a facet have no
contact row, nor do nodes whose row has no free component because of supports. Each pair
needs a node with a row.

In .inp files, bodies are element sets, boundaries are surfaces, element sets of facets
or node sets, and points are node sets. In .med files, bodies are groups of cells,
boundaries are groups of facets or nodes, and points are groups of nodes.

If the mesh has physical volumes, these are the bodies, and boundaries are physical
surfaces. Vectors then have three components, forces are in N, and a force on a boundary
is distributed uniformly over its area; `point` is a physical point or curve, whose
nodes share a force equally. Finite strain and ``plane = "stress"`` are not available
for volumes.

The keys from length_unit to units are optional. The values above are their defaults,
except for units: the default of units.length is the longest side of the bounding box of
the mesh, and that of units.force is the sum of |load| over the nodes. Bodies supported
by contact alone have no form dual-bounds. If neither supports nor friction prevent a
rigid motion along the contacts, linear kinematics require ``steps = 1`` and ``relin =
1``. A pair that sets no friction law has the law of the top-level keys friction, bound
and mu, whose default is no friction. With the top-level key ``loading = "static"``,
slip is measured from the undeformed state.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import InputError, checked
from mortarbench.harness.checked import located
from mortarbench.harness.errors import shown, unknown
from mortarbench.harness.files.reading import read_toml
from mortarbench.problems.contact.bodies import (
    ContactPair,
    UnassembledBodies,
    support_rows,
)
from mortarbench.problems.contact.friction import FrictionLaw, law_of
from mortarbench.problems.contact.rigid import (
    RigidBody,
    RigidCylinder,
    RigidPlane,
    RigidSphere,
)
from mortarbench.problems.contact.surface import current_surface
from mortarbench.problems.fem.elasticity import Material
from mortarbench.problems.fem.mesh import Mesh, Nodes, dofs_of, nodal_areas
from mortarbench.problems.fem.mesh_files.named import (
    FileMesh,
    NamedMesh,
    named_mesh,
    refine,
)
from mortarbench.problems.fem.mesh_files.reading import read_mesh_file
from mortarbench.problems.ranges import (
    CONTACT_STIFFNESS,
    LAW_PARAMETERS,
    LAWS,
    MAX_STEPS,
    METHODS,
    PLANES,
    SETTINGS,
    check_memory,
    physical,
)

_SIDES = ("slave", "master")
_PLACES = ("boundary", "point")
_LOADS = ("force", "traction")
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
_KEYS = (
    "mesh",
    "length_unit",
    *SETTINGS,
    "units",
    "bodies",
    "supports",
    "loads",
    "contacts",
)


def read_description(path: Path) -> dict[str, Any]:
    """Read the TOML file, and check its keys and settings.

    Raises
    ------
    InputError
        If a key or value is invalid. The message states the file and the key.

    """
    table = read_toml(path)
    with located(str(path)):
        checked.only_keys(table, _KEYS)
        for key in ("mesh", "bodies", "supports", "loads", "contacts"):
            if key not in table:
                raise InputError(f"{key} is missing")
        checked.text("mesh", table["mesh"])
        unit = checked.text("length_unit", table.get("length_unit", "m"))
        if unit not in LENGTH_UNITS:
            raise unknown("length_unit", unit, LENGTH_UNITS)
        for key in ("steps", "relin"):
            default = SETTINGS[key].default
            checked.at_least_one(key, table.get(key, default), MAX_STEPS)
        choices = (*METHODS, *PLANES, "kinematics", "material", *CONTACT_STIFFNESS)
        _check_choices(table, choices)
        for entry in checked.filled_list("contacts", table["contacts"]):
            checked.table("contacts", entry)
        _check_friction_values(table)
    return table


def read_bodies(path: Path, plane: Any, halvings: int = 0) -> UnassembledBodies:
    """Read the bodies of a TOML file and its mesh.

    halvings : number of uniform refinements of the mesh, with straight edges

    Raises
    ------
    InputError
        If an entry is invalid. The message states the file, the entry, the invalid name
        or value, and the expected one.

    """
    table = read_description(path)
    mesh_path = path.parent / table["mesh"]
    file = read_mesh_file(mesh_path)
    with located(str(path)):
        materials = _materials(table["bodies"], file)
    named = named_mesh(file, {file.set_of(name) for name in materials})
    if named.dim == 3 and halvings:
        raise InputError(
            f"{mesh_path}: halvings={halvings} with volumes is not built; expected "
            "halvings=0, and a finer mesh file"
        )
    refined = 2 * len(named.cells) * 4**halvings  # checked before refining
    check_memory(str(path), refined if named.dim == 2 else named.points.size)
    for _ in range(halvings):
        named = refine(named)
    unit = LENGTH_UNITS[table.get("length_unit", "m")]
    named = named._replace(points=named.points * unit)
    with located(str(path)):
        materials = {name: _material_of(materials, name, file) for name in named.surfaces}
        fixed = _each(table, "supports", lambda entry: _support(entry, named))
        loads = _each(table, "loads", lambda entry: _load(entry, named))
        held = np.unique(np.concatenate(fixed))
        _check_loads_act(table["loads"], loads, held)
        pairs = _each(table, "contacts", lambda entry: _pair(entry, named))
        _check_unique(table["contacts"])
        load: NDArray[np.float64] = np.sum(loads, axis=0)
        length, force = _units(table.get("units", {}), named, load)
    body = np.repeat(
        np.arange(len(named.surfaces)), [len(c) for c in named.surfaces.values()]
    )
    mesh = Mesh(named.points, named.cells, {})
    return UnassembledBodies(
        mesh=mesh,
        body=body,
        names=tuple(named.surfaces),
        materials=tuple(materials[name] for name in named.surfaces),
        plane=plane if named.dim == 2 else None,
        length=length,
        force=force,
        f=load.ravel() / force,
        pairs=tuple(pairs),
        B_D=support_rows(mesh, held),
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
    for i, entry in enumerate(checked.filled_list(key, table[key])):
        with located(f"{key}[{i}]"):
            values.append(read(checked.table("entry", entry)))
    return values


def _materials(entries: object, file: FileMesh) -> dict[str, Material]:
    materials: dict[str, Material] = {}

    def read(entry: dict[str, Any]) -> None:
        _keys(entry, ("name", "E", "nu"))
        name = checked.text("name", entry["name"])
        _check_known(file.words.body, file.set_of(name), file.body_names)
        if name in materials:
            raise InputError(f"body {name!r} is described twice; expected once")
        E, nu = physical("E", checked.positive("E", entry["E"])), entry["nu"]
        if not checked.is_number(nu) or not -1 < nu < 0.5:
            raise InputError(f"nu = {shown(nu)}; expected a number between -1 and 0.5")
        materials[name] = Material(E=E, nu=float(nu))

    _each({"bodies": entries}, "bodies", read)
    return materials


def _material_of(
    materials: Mapping[str, Material], body: str, file: FileMesh
) -> Material:
    """Return the material of a body, described by its name or that of its set."""
    for name in (body, file.set_of(body)):
        if name in materials:
            return materials[name]
    raise InputError(f"bodies: {file.words.body} {body!r} has no entry")


def _support(entry: dict[str, Any], named: NamedMesh) -> Nodes:
    """Return the displacement components fixed by a support."""
    checked.only_keys(entry, (*_PLACES, "fix"))
    nodes, _ = _place(entry, named, ("fix",))
    fix = checked.filled_list("fix", entry["fix"])
    axes = _AXES[: named.dim]
    for component in fix:
        if component not in axes:
            raise unknown("component", checked.text("fix", component), axes)
    return np.concatenate([dofs_of(nodes, named.dim, axes.index(c)) for c in fix])


def _load(entry: dict[str, Any], named: NamedMesh) -> NDArray[np.float64]:
    """Return the nodal forces (N, dim) of a load: N/m in 2D, N in 3D."""
    checked.only_keys(entry, (*_PLACES, *_LOADS))
    kinds = [kind for kind in _LOADS if kind in entry]
    if len(kinds) != 1:
        form = ", ".join(_AXES[: named.dim])
        raise InputError(f"expected either force or traction = [{form}]")
    vector = _vector(kinds[0], entry[kinds[0]], named.dim)
    nodes, facets = _place(entry, named, tuple(kinds))
    weights = np.zeros(len(named.points))
    if facets.size and named.dim == 3:  # ∫N_j over the boundary, m²
        nodes, weights[nodes] = nodal_areas(named.points, facets)
    elif facets.size:  # ∫N_j in 2D, m
        lengths = np.linalg.norm(np.diff(named.points[facets], axis=1)[:, 0], axis=1)
        np.add.at(weights, facets, lengths[:, None] / 2)
    elif kinds == ["traction"]:
        raise InputError(
            "traction acts on a point; expected traction on a boundary, or a force"
        )
    else:
        weights[nodes] = 1.0
    if kinds == ["force"]:
        weights /= weights.sum()
    return np.outer(weights, vector)


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


def _check_choices(entry: Mapping[str, Any], keys: Iterable[str]) -> None:
    """Raise InputError if a value is not allowed for the case key of the same name."""
    for key in keys:
        allowed = SETTINGS[key].values
        if key in entry and checked.text(key, entry[key]) not in allowed:
            raise unknown(f"value of {key}", entry[key], map(str, allowed))


def _check_friction_values(entry: Mapping[str, Any]) -> None:
    """Raise InputError if a friction key of an entry has an invalid value."""
    _check_choices(entry, ("friction", "loading"))
    for key, what in LAW_PARAMETERS.items():
        if key in entry and physical(key, entry[key]) < 0:
            raise InputError(f"{key} = {shown(entry[key])}; expected {what}")


def pair_laws(
    contacts: Sequence[Mapping[str, Any]], params: Mapping[str, Any]
) -> tuple[FrictionLaw, ...]:
    """Return the friction law of each pair, from its entry or from the case keys.

    Raises
    ------
    InputError
        If a parameter of a law is missing, or an entry contains a parameter that its
        law does not use.

    """
    return tuple(
        _each({"contacts": list(contacts)}, "contacts", lambda e: _law(e, params))
    )


def _law(entry: Mapping[str, Any], params: Mapping[str, Any]) -> FrictionLaw:
    _check_friction_values(entry)
    law = entry.get("friction", params["friction"])
    needed = LAWS[law]
    for key in LAW_PARAMETERS:
        if key in entry and key != needed:
            raise InputError(f"{key} is not used by friction {law!r}; expected none")
    keys = {"friction": law, "bound": 0.0, "mu": 0.0}
    if needed:
        keys[needed] = entry.get(needed, params[needed])
        if keys[needed] < 0:
            raise InputError(
                f"friction {law!r} needs {needed}, {LAW_PARAMETERS[needed]}"
            )
    return law_of(keys)


def _pair(entry: dict[str, Any], named: NamedMesh) -> ContactPair:
    """Return the contact pair that an entry describes."""
    checked.only_keys(entry, (*_SIDES, "rigid", "reach", "friction", *LAW_PARAMETERS))
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
            _check_faces(named.points, slave, entry["slave"], rigid)
        return ContactPair(slave, slave[:0], rigid, reach)
    if np.intersect1d(slave, sides["master"]).size:
        raise InputError(
            "slave and master share nodes; expected sides without common nodes"
        )
    return ContactPair(slave, sides["master"], reach=reach)


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


def _check_faces(
    points: NDArray[np.float64], slave: Nodes, name: str, rigid: RigidBody
) -> None:
    """Raise InputError if a slave side does not face a rigid body or is far from it."""
    side = current_surface(points, np.zeros(points.size), slave, "slave")
    gap, normal = rigid.gap(side.x[side.facets].mean(axis=1))
    if not (np.einsum("fx,fx->f", normal, side.normal) < 0).any():
        raise InputError(
            f"no part of slave {name!r} faces the rigid body; expected a plane whose "
            "normal points towards the slave, or a sphere or cylinder whose centre is "
            "in front of the slave"
        )
    extent = float(np.linalg.norm(np.ptp(points, axis=0)))
    if gap.min() > extent:
        raise InputError(
            f"the rigid body is {gap.min():.3g} m from slave {name!r}, farther than "
            f"the size {extent:.3g} m of the mesh; expected lengths in m for any "
            "length_unit"
        )


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
    entry: object, named: NamedMesh, load: NDArray[np.float64]
) -> tuple[float, float]:
    units = checked.table("units", entry)
    with located("units"):
        checked.only_keys(units, ("length", "force"))
        total = float(np.linalg.norm(load, axis=1).sum())
        if total == 0:
            raise InputError("all loads are zero; expected a load")
        extent = float(np.ptp(named.points, axis=0).max())
        return (
            physical("length", checked.positive("length", units.get("length", extent))),
            physical("force", checked.positive("force", units.get("force", total))),
        )


def _place(
    entry: dict[str, Any], named: NamedMesh, others: tuple[str, ...]
) -> tuple[Nodes, Nodes]:
    """Return the nodes of an entry's boundary or point, and the boundary's facets.

    For a point, the array of facets is empty.
    """
    where = [key for key in _PLACES if key in entry]
    if len(where) != 1:
        raise InputError("expected either boundary or point, with a name from the mesh")
    _keys(entry, (*where, *others))
    if where == ["point"]:
        name = _one_of(named.spots, named.words.point, entry, "point")
        return named.spots[name], np.zeros((0, 2), dtype=np.int64)
    name = _one_of(named.curves, named.words.boundary, entry, "boundary")
    facets = named.curves[name]
    return np.unique(facets), facets


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
    for key in keys:
        if key not in entry:
            raise InputError(f"{key} is missing")
